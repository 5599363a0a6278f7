"""The model of a blurred hole and its fit (`detectors.findings.hole_model`), written plainly: the
picture from points between pixels, the fit by SciPy, the covariance in dense matrices."""

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from detectors.findings.drilled import NODES, WEIGHTS
from detectors.findings.hole_patch import WALL_PRIOR, HolePatch
from detectors.findings.shapes import Shape

FINER = 8  # points along each axis of a pixel
MARGIN_PX = 4  # half of the widest blur, and more
STEPS = 201  # depths that a line of sight is tried at

Start = tuple[float, float, float, float, float]
Draw = Callable[[HolePatch, np.ndarray], np.ndarray]


def picture(patch: HolePatch, hole: np.ndarray) -> np.ndarray:
    """Return the residual (h, w), without offset, of a hole (5,): u, v, radius, depth, wall.

    It is the mean over the blur's rectangle of the sum of layers. A layer at the depth t along the
    normal counts with its weight at the points d from the centre that lie in four circles, where
    |d| is the length on the surface, s = 1 / (1 + t * shrinking) and e the depth that is lit:

        |d| < radius                                        the mouth, seen
        |d - t * drift * s| < radius * s                    the circle at t, seen
        |d + e / (e + height) * beam| < radius              the mouth, lit
        |d - t * drift * s + b * beam| < radius * s         the circle at t, lit

    with b = (e - t) / (e - t + height)."""
    u, v, radius, depth, wall = hole
    columns, across = _fine(patch.used.shape[1], patch.blur_px[0])
    rows, down = _fine(patch.used.shape[0], patch.blur_px[1])
    offset = np.stack(np.meshgrid(columns - u, rows - v), axis=-1)

    def within(shift: np.ndarray, radius_m: float) -> np.ndarray:
        from_centre = offset - shift
        return np.einsum("...i,ij,...j", from_centre, patch.metric_m2, from_centre) < radius_m**2

    total = np.zeros(offset.shape[:2])
    for cosine, drift_u, drift_v, shrinking, beam_u, beam_v, height, share in patch.sights:
        drift = np.array([drift_u, drift_v])
        beam = np.array([beam_u, beam_v])
        deepest = depth * cosine
        length = max(wall * deepest, 0.0)
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            t = length * node
            lit = t if node < 1.0 else max(deepest, 0.0)
            thick = length * weight if node < 1.0 else deepest - length
            scale = 1.0 / (1.0 + t * shrinking)
            is_seen = within(np.zeros(2), radius) & within(t * drift * scale, radius * scale)
            below = (lit - t) / (lit - t + height)
            entered = within(-lit / (lit + height) * beam, radius)
            passed = within(t * drift * scale - below * beam, radius * scale)
            total += share / cosine * thick * (is_seen & entered & passed)
    return down @ total @ across.T


def relief(patch: HolePatch, numbers: np.ndarray, shape: Shape) -> np.ndarray:
    """Return the residual (h, w), without offset, of a cap, a bowl or a slot with ``numbers`` (7,)
    as `detectors.findings.shapes` has them, seen by one viewpoint.

    A line of sight that meets the surface at the place p is at p - t * drift at the depth t along
    the normal. It sees the first of `STEPS` equal depths that is not above the relief there."""
    u, v, radius, depth, _, stretch, angle = numbers
    columns, across = _fine(patch.used.shape[1], patch.blur_px[0])
    rows, down = _fine(patch.used.shape[0], patch.blur_px[1])
    offset_px = np.stack(np.meshgrid(columns - u, rows - v), axis=-1)
    # the surface's axes: along the rows, and at right angles to it
    metric = patch.metric_m2
    to_surface = np.linalg.cholesky(metric)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    cosine, drift_u, drift_v = patch.sights[0, :3]
    deepest = depth * cosine
    places_m = offset_px @ to_surface @ turn
    drift = np.array([drift_u, drift_v]) @ to_surface @ turn
    sees = np.full(places_m.shape[:2], np.nan)
    for t in np.linspace(0.0, deepest, STEPS):
        there_m = places_m - t * drift
        height_m = _height_m(there_m, radius, deepest, stretch, shape)
        is_met = np.isnan(sees) & (np.abs(height_m) <= abs(t))
        sees[is_met] = t
    return down @ (sees / cosine) @ across.T


def _height_m(
    places_m: np.ndarray,
    radius_m: float,
    deepest_m: float,
    stretch: float,
    shape: Shape,
) -> np.ndarray:
    """Return the depth of a shape along the normal at places (h, w, 2) in its own axes."""
    along_m, across_m = np.moveaxis(places_m, -1, 0)
    if shape == "slot":
        inside = (np.abs(across_m) < radius_m) & (np.abs(along_m) < radius_m * math.exp(stretch))
        return deepest_m * inside
    share = np.minimum(np.hypot(along_m, across_m) / radius_m, 1.0)
    if shape == "bowl":
        return deepest_m * 0.5 * (1.0 + np.cos(np.pi * share))
    deep_m = min(abs(deepest_m), radius_m)
    ball_m = (radius_m**2 + deep_m**2) / (2.0 * deep_m)
    above_m = np.sqrt(ball_m**2 - (share * radius_m) ** 2) - (ball_m - deep_m)
    return deepest_m / deep_m * above_m


def _fine(length: int, blur_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (n,) between the pixels of an axis, and their weights (length, n) in the
    mean over the blur around each pixel."""
    positions = (np.arange((length + 2 * MARGIN_PX) * FINER) + 0.5) / FINER - MARGIN_PX - 0.5
    inside = np.abs(positions - np.arange(length)[:, None]) < blur_px / 2
    return positions, inside / (FINER * blur_px)


def fitted(
    patch: HolePatch,
    start: Start,
    draw: Draw = picture,
) -> tuple[np.ndarray, float, bool]:
    """Return the hole (5,), the offset, and whether SciPy's descent has converged, with the least
    sum of squares of the used pixels' residuals and of the prior's misfit, weight * (wall - 0.5).
    ``draw``: the picture of a hole; a fast one saves minutes."""
    u, v, radius_m, depth_m, offset_m = start
    used_m = patch.residual_m[patch.used]

    def misfit(q: np.ndarray) -> np.ndarray:
        hole = hole_of(q)
        prior = patch.prior_weight * (hole[4] - WALL_PRIOR[0])
        return np.append(draw(patch, hole)[patch.used] + q[4] - used_m, prior)

    def jacobian(q: np.ndarray) -> np.ndarray:
        hole = hole_of(q)
        slopes = []
        for step in np.diag([1e-3, 1e-3, 1e-6, 1e-6, 1e-3]):
            change = draw(patch, hole + step / 2) - draw(patch, hole - step / 2)
            slopes.append(change[patch.used] / step.max())
        bend = 0.5 * math.pi * math.sin(math.pi * q[5])
        by_log_radius = hole[2] * slopes[2] - 2.0 * hole[3] * slopes[3]
        by_volume = slopes[3] / hole[2] ** 2
        offset = np.ones(len(used_m))
        rows = np.stack(
            [slopes[0], slopes[1], by_log_radius, by_volume, offset, slopes[4] * bend], axis=1
        )
        return np.vstack([rows, [0.0, 0.0, 0.0, 0.0, 0.0, patch.prior_weight * bend]])

    begin = [u, v, math.log(radius_m), depth_m * radius_m**2, offset_m, WALL_PRIOR[0]]
    limits = {"xtol": 1e-9, "ftol": 1e-9, "gtol": 1e-12, "max_nfev": 500}
    descent = least_squares(misfit, begin, jacobian, method="lm", x_scale="jac", **limits)
    return hole_of(descent.x), float(descent.x[4]), bool(descent.success)


def hole_of(q: np.ndarray) -> np.ndarray:
    """Return the hole (5,) of q = (u, v, ln radius, depth * radius^2, offset, x): the wall is
    sin^2(pi x / 2)."""
    radius = math.exp(q[2])
    return np.array([q[0], q[1], radius, q[3] / radius**2, math.sin(0.5 * math.pi * q[5]) ** 2])


def sandwich(
    patch: HolePatch,
    derivatives: np.ndarray,
    square_m2: float,
) -> np.ndarray:
    """Return the covariance (6, 6) A^-1 (s^2 J' C J + p^2 W) A^-1 with A = J' J + W and s^2 =
    square / (n - trace(A^-1 J' C J)), where C (n, n) is the correlation of pixels that share
    samples of a square filter. ``derivatives``: J' (6, n)."""
    lags = np.abs(np.argwhere(patch.used)[:, None] - np.argwhere(patch.used))
    side_v = round(patch.blur_px[1])
    side_u = round(patch.blur_px[0])
    shared = np.maximum(side_v - lags[..., 0], 0) * np.maximum(side_u - lags[..., 1], 0)
    meat = derivatives @ (shared / (side_u * side_v)) @ derivatives.T
    prior = np.zeros((6, 6))
    prior[5, 5] = patch.prior_weight**2
    inverse = np.linalg.inv(derivatives @ derivatives.T + prior)
    variance = square_m2 / (derivatives.shape[1] - np.trace(inverse @ meat))
    prior_variance = patch.noise_m**2 * patch.blur_px[0] * patch.blur_px[1]
    return inverse @ (variance * meat + prior_variance * prior) @ inverse
