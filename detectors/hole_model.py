"""The image of a hole through a camera that averages over a square of pixels: forward model, fit, standard errors.

A disc of one depth on a locally plane surface, seen through the pixel's aperture and a filter that averages
``blur_px`` x ``blur_px`` pixels: a unit pixel convolved with that comb is a square of side ``blur_px``. The residual
at a pixel is depth times the part of the square around it that the disc covers, plus a constant.

Not modelled: the shadow and parallax of the walls, light between them, a floor that is not flat, the loss of weight of
deep neighbours in a bilateral filter (linear up to some 50 mm for the Azure Kinect).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np

STRIPS = 64
"""Strips that stand for the disc: the coverage is exact in total, and in each pixel within 0.001 for a blur of 3 or 5
pixels, 0.01 for none."""
PARAMETERS = 5
"""u, v, radius, depth, offset."""


@dataclass(frozen=True)
class Patch:
    """Residuals around one detection. ``residual_m`` (h, w), ``used`` (h, w) bool; pixel (0, 0) is the patch's corner.

    ``metric_m2`` (2, 2): squared length on the surface of a pixel offset (du, dv) is its quadratic form.
    """

    residual_m: np.ndarray
    used: np.ndarray
    metric_m2: np.ndarray
    blur_px: int


@dataclass(frozen=True)
class HoleFit:
    """``u_px``, ``v_px`` in the patch; ``covariance`` (5, 5) of (u, v, radius, depth, offset) in px and metres."""

    u_px: float
    v_px: float
    radius_m: float
    depth_m: float
    offset_m: float
    covariance: np.ndarray
    converged: bool


@numba.njit(cache=True, nogil=True)
def _overlaps(
    low: np.ndarray, high: np.ndarray, d_low: np.ndarray, d_high: np.ndarray, n: int, half: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Length of [low, high] inside [c - half, c + half] for c = 0..n-1, its derivative by a common shift and by R.

    All (s, n); ``d_low`` and ``d_high`` are the ends' derivatives by R.
    """
    strips = len(low)
    length = np.zeros((strips, n))
    by_shift = np.zeros((strips, n))
    by_radius = np.zeros((strips, n))
    for s in range(strips):
        first = max(0, int(np.ceil(low[s] - half)))
        last = min(n - 1, int(np.floor(high[s] + half)))
        for c in range(first, last + 1):
            low_inside = low[s] > c - half
            high_inside = high[s] < c + half
            end = high[s] if high_inside else c + half
            start = low[s] if low_inside else c - half
            length[s, c] = max(end - start, 0.0)
            by_shift[s, c] = (1.0 if high_inside else 0.0) - (1.0 if low_inside else 0.0)
            by_radius[s, c] = (d_high[s] if high_inside else 0.0) - (d_low[s] if low_inside else 0.0)
    return length, by_shift, by_radius


def _unit_strips() -> tuple[np.ndarray, np.ndarray]:
    """Edges (s + 1,) and mean half-chords (s,) of strips across a unit disc, narrow where the chord changes fast."""
    theta = np.linspace(-np.pi / 2, np.pi / 2, STRIPS + 1)
    edges = np.sin(theta)
    areas = np.diff(theta / 2 + np.sin(2 * theta) / 4)
    return edges, areas / np.diff(edges)


EDGES, HALF_CHORDS = _unit_strips()


def blurred_disc(
    shape: tuple[int, int], u: float, v: float, radius_m: float, metric_m2: np.ndarray, blur_px: int
) -> tuple[np.ndarray, np.ndarray]:
    """Covered part of the square around each pixel, (h, w) in 0..1, and its derivatives (3, h, w) by u, v, radius.

    The disc is an ellipse in pixels: the set where the metric's form of the offset from (u, v) is below radius^2.
    """
    h, w = shape
    g11, g12, g22 = metric_m2[0, 0], metric_m2[0, 1], metric_m2[1, 1]
    height = np.sqrt(g11 / (g11 * g22 - g12 * g12))
    chords = HALF_CHORDS / np.sqrt(g11)
    drift = -g12 / g11 * height * 0.5 * (EDGES[1:] + EDGES[:-1])
    half = 0.5 * blur_px
    left, right = drift - chords, drift + chords
    across, across_u, across_r = _overlaps(u + radius_m * left, u + radius_m * right, left, right, w, half)
    low, high = height * EDGES[:-1], height * EDGES[1:]
    along, along_v, along_r = _overlaps(v + radius_m * low, v + radius_m * high, low, high, h, half)
    part = 1.0 / blur_px**2
    by_u, by_v = along.T @ across_u, along_v.T @ across
    by_radius = along.T @ across_r + along_r.T @ across
    return along.T @ across * part, np.stack([by_u, by_v, by_radius]) * part


def fit_hole(patch: Patch, u: float, v: float, radius_m: float, depth_m: float, offset_m: float) -> HoleFit:
    """Least squares from a start, by Levenberg and Marquardt (MINPACK), with `sandwich_covariance`.

    Fitted are (u, v, ln radius, depth * radius^2, offset): the last but one is the hole's volume, which the blur keeps,
    so that a hole smaller than the blur still has one well-determined direction for each parameter but its radius.
    """
    from scipy.optimize import least_squares

    model = _Model(patch)
    start = np.array([u, v, np.log(radius_m), depth_m * radius_m**2, offset_m])
    scales = np.array([1.0, 1.0, 0.3, 0.3 * abs(start[3]) + 1e-12, 0.1 * abs(depth_m) + 1e-6])
    found = least_squares(
        lambda q: model.misfit(q * scales),
        start / scales,
        lambda q: model.jacobian(q * scales) * scales,
        method="lm",
        max_nfev=60,
        xtol=1e-6,
        ftol=1e-7,
        gtol=1e-12,
    )
    u, v, log_radius, volume, offset = found.x * scales
    radius = float(np.exp(log_radius))
    depth = float(volume / radius**2)
    covariance = sandwich_covariance(patch, u, v, radius, depth, offset)
    return HoleFit(float(u), float(v), radius, depth, float(offset), covariance, bool(found.success))


class _Model:
    """Misfit and Jacobian of one patch; MINPACK asks for both at the same place, which is computed once."""

    def __init__(self, patch: Patch) -> None:
        self._patch = patch
        self._data = patch.residual_m[patch.used]
        self._at: np.ndarray | None = None
        self._misfit = np.empty(0)
        self._jacobian = np.empty((0, 0))

    def misfit(self, q: np.ndarray) -> np.ndarray:
        self._evaluate(q)
        return self._misfit

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        self._evaluate(q)
        return self._jacobian

    def _evaluate(self, q: np.ndarray) -> None:
        if self._at is not None and np.array_equal(q, self._at):
            return
        patch = self._patch
        h, w = patch.used.shape
        # keeps a wild trial step finite: no disc is larger than ten patches
        radius = float(np.exp(np.clip(q[2], -20.0, np.log(10.0 * (h + w) * np.sqrt(patch.metric_m2.max())))))
        centre = np.clip(q[:2], -10.0 * w, 10.0 * w)
        disc, by = blurred_disc((h, w), centre[0], centre[1], radius, patch.metric_m2, patch.blur_px)
        depth = q[3] / radius**2
        disc, by_u, by_v, by_radius = disc[patch.used], *(b[patch.used] for b in by)
        self._misfit = depth * disc + q[4] - self._data
        by_log = depth * (radius * by_radius - 2.0 * disc)
        self._jacobian = np.column_stack([depth * by_u, depth * by_v, by_log, disc / radius**2, np.ones_like(disc)])
        self._at = q.copy()


def sandwich_covariance(
    patch: Patch, u: float, v: float, radius_m: float, depth_m: float, offset_m: float
) -> np.ndarray:
    """(5, 5) covariance of (u, v, radius, depth, offset) of the plain least-squares fit under correlated noise.

    The noise is white noise through the same square filter, so its correlation is C = B B' / blur^2 with B the sum over
    blur x blur pixels, and cov = s^2 A^-1 (J' C J) A^-1 with A = J' J. The variance s^2 of one pixel comes from the
    misfit: E[misfit' misfit] = s^2 (n - trace(A^-1 J' C J)); so what the model does not describe counts as noise.
    NaN where the fit determines no variance.
    """
    h, w = patch.used.shape
    disc, by = blurred_disc((h, w), u, v, radius_m, patch.metric_m2, patch.blur_px)
    columns = np.stack([depth_m * by[0], depth_m * by[1], depth_m * by[2], disc, np.ones((h, w))], axis=-1)
    columns *= patch.used[..., None]
    flat = columns.reshape(-1, PARAMETERS)
    pad = patch.blur_px - 1
    padded = np.pad(columns, ((pad, pad), (pad, pad), (0, 0)))
    summed = cv2.boxFilter(
        padded, -1, (patch.blur_px, patch.blur_px), normalize=False, borderType=cv2.BORDER_CONSTANT
    ).reshape(-1, PARAMETERS)
    try:
        bread = np.linalg.inv(flat.T @ flat)
    except np.linalg.LinAlgError:
        return np.full((PARAMETERS, PARAMETERS), np.nan)
    meat = summed.T @ summed / patch.blur_px**2
    freedom = int(patch.used.sum()) - float(np.trace(bread @ meat))
    misfit = (depth_m * disc + offset_m - patch.residual_m)[patch.used]
    if freedom <= 0:
        return np.full((PARAMETERS, PARAMETERS), np.nan)
    return float(misfit @ misfit) / freedom * (bread @ meat @ bread)
