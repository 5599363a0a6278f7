"""The viewpoint of a damage: where the camera and the light source stand, reduced to what moves in
the image."""

import math

import numpy as np


def normal_of(per_px_m: np.ndarray) -> np.ndarray:
    """Return the vector product (3,) of a surface's derivatives by u and v (2, 3)."""
    (ax, ay, az), (bx, by, bz) = per_px_m.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def sight(
    centre_m: np.ndarray,
    per_px_m: np.ndarray,
    emitter_m: np.ndarray,
    share: float = 1.0,
) -> np.ndarray:
    """Return the viewpoint (8,) of a hole, reduced to what moves in the image.

    A circle at depth h along the normal has the image of the same circle on the surface, moved by
    h * drift / (1 + h * shrinking) and divided by that divisor. Light from depth h entered beam *
    h / (h + height) away from it.

    Args:
        centre_m: (3,), the surface's point at the hole, camera frame.
        per_px_m: (2, 3), its derivatives by u and v.
        emitter_m: (3,), the light source, camera frame.
        share: of the image that this viewpoint contributes.

    Returns:
        the cosine between ray and normal, times the ray's length per z; the drift along u and v;
        the shrinking; the beam along u and v; the emitter's height; and the share."""
    normal = normal_of(per_px_m)
    normal = normal / math.copysign(math.hypot(*normal), normal @ centre_m)
    ray = centre_m / centre_m[2]
    z = centre_m[2]
    slopes_per_px = ((per_px_m - np.outer(per_px_m[:, 2], ray)) / z)[:, :2].T
    drift = np.linalg.solve(slopes_per_px, (normal - normal[2] * ray)[:2]) / z
    distance = normal @ centre_m
    before = normal @ emitter_m
    # the offset in the surface's plane by least squares
    aside_m = emitter_m - centre_m * before / distance
    beam = np.linalg.solve(per_px_m @ per_px_m.T, per_px_m @ aside_m)
    return np.array([normal @ ray, *drift, normal[2] / z, *beam, distance - before, share])


def straight_sight(per_px_m: np.ndarray) -> np.ndarray:
    """Return the viewpoint (8,) of a parallel projection of unknown origin: view and light are
    along z."""
    normal = normal_of(per_px_m)
    normal = normal / math.copysign(math.hypot(*normal), normal[2])
    drift = np.linalg.solve(per_px_m[:, :2].T, normal[:2])
    return np.array([normal[2], *drift, 0.0, 0.0, 0.0, 1.0, 1.0])
