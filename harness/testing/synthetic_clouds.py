"""Small synthetic clouds with known damage for tests of detectors (`harness.testing`)."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from harness.vocabulary.geometry import Cloud, Lens, Reason, Region, rays_of

SHAPE = (90, 120)  # rows and columns: 126 by 168 mm at 0.7 m
DISTANCE_M = 0.7
NOISE_M = 3e-4
FRAMES = 20
LENS = Lens(SHAPE[1], SHAPE[0], 500.0, 500.0, 59.5, 44.5)
DAMAGE = ((-0.04, -0.02, 0.010, 0.012), (0.03, 0.02, 0.007, 0.008), (0.05, -0.03, 0.008, -0.006))
"""Two holes and a bump: x, y and radius on the face, and depth behind it (negative: in front of
it), metres."""


def synthetic_clouds() -> tuple[Cloud, ...]:
    """Return a tilted plane, a cylinder's face, and a tilted plane with missing pixels, each with
    `DAMAGE`."""
    return plane(seed=1), cylinder(seed=2), with_gaps(plane(seed=3), seed=4)


def plane(
    seed: int, tilt: float = 0.1, damage: Sequence[tuple[float, float, float, float]] = DAMAGE
) -> Cloud:
    """Return a plane whose z grows by ``tilt`` metres per metre in x."""
    return _seen(seed, lambda x, y: DISTANCE_M + tilt * x, damage)


def cylinder(seed: int, radius_m: float = 0.5) -> Cloud:
    """Return the convex face of a cylinder about the y axis."""
    return _seen(seed, lambda x, y: DISTANCE_M + radius_m - np.sqrt(radius_m**2 - x**2))


def with_gaps(cloud: Cloud, seed: int) -> Cloud:
    """Return the cloud without 5 % of its pixels, a block of them, and its last column."""
    gone = np.random.default_rng(seed).random(cloud.valid.shape) < 0.05
    gone[10:14, 20:26] = True
    gone[:, -1] = True
    return without(cloud, gone)


def without(cloud: Cloud, gone: np.ndarray) -> Cloud:
    """Return the cloud without range at the pixels ``gone`` (h, w) bool."""
    return replace(
        cloud,
        points_m=np.where(gone[..., None], np.nan, cloud.points_m),
        reason=np.where(gone, Reason.NO_RETURN, cloud.reason).astype(np.uint8),
        count=np.where(gone, 0, cloud.count),
        variance_m2=np.where(gone, np.nan, cloud.variance_m2),
    )


def _seen(
    seed: int,
    face: Callable[[np.ndarray, np.ndarray], np.ndarray],
    damage: Sequence[tuple[float, float, float, float]] = DAMAGE,
) -> Cloud:
    slopes = LENS.region_slopes(LENS.whole)
    z = np.full(SHAPE, DISTANCE_M)
    # the ray meets the face where z = face(z * slopes); the iteration converges because the slopes
    # are small
    for _ in range(60):
        z = face(slopes[..., 0] * z, slopes[..., 1] * z)
    x = slopes[..., 0] * z
    y = slopes[..., 1] * z
    for centre_x, centre_y, radius, depth in damage:
        z = z + depth * (np.hypot(x - centre_x, y - centre_y) < radius)
    z = z + NOISE_M * np.random.default_rng(seed).standard_normal(SHAPE)
    points = rays_of(slopes) * z[..., None]
    flat = np.zeros(SHAPE, dtype=np.uint8)
    return Cloud(
        points_m=points,
        reason=flat,
        count=flat.astype(np.int64) + FRAMES,
        variance_m2=np.full(SHAPE, FRAMES * NOISE_M**2),
        region=Region(0, SHAPE[0], 0, SHAPE[1]),
        z_step_m=0.0,
        n_frames=FRAMES,
        lens=LENS,
    )
