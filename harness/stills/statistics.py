"""Statistics of stacks of frames of a static scene, real or simulated: planes, noise, fixed
pattern, depth steps.

A plane z = d + sx x + sy y is exactly linear in 1/z over the rays' slopes: 1/z = (1 - sx X - sy Y)
/ d. A stack is ``z_m`` (n, h, w) of a static scene, NaN where a frame has no range. ``where`` (h,
w) bool selects pixels; of these, the pixels count that have a range in at least half of the frames
and in at least two."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage, special

from harness.evaluation.intervals import UNKNOWN, UPPER, Interval, mean_t, wilson
from harness.vocabulary.geometry import MM
from harness.vocabulary.seeds import random_stream
from scenes.closed_form import Plane

GROUPS = 10


@dataclass(frozen=True)
class Reading:
    """A value and its two-sided 95 % interval (unknown without repeats); NaN without data."""

    value: float
    interval: Interval = UNKNOWN


NOTHING = Reading(float("nan"))


def jackknifed(frames: np.ndarray, statistic: Callable[[np.ndarray], float]) -> Reading:
    """Return ``statistic`` of ``frames`` (n, ...), which must be independent, with Student's
    interval from the delete-a-group jackknife over frames; unknown below 4 frames. Source: Efron
    and Tibshirani 1993, chapter 11."""
    value = float(statistic(frames))
    g = min(GROUPS, len(frames) // 2)
    if g < 2 or not np.isfinite(value):
        return Reading(value)
    number = np.arange(len(frames)) % g
    without = np.array([statistic(frames[number != group]) for group in range(g)])
    half = float(special.stdtrit(g - 1, UPPER) * np.sqrt((g - 1) * without.var()))
    return Reading(value, Interval(value - half, value + half) if np.isfinite(half) else UNKNOWN)


def mean_of(values: ArrayLike) -> Reading:
    """Return the mean of independent values with Student's interval; NaN values are left out."""
    valid = np.asarray(values, float)
    valid = valid[np.isfinite(valid)]
    if valid.size < 2:
        return Reading(float(valid[0])) if valid.size else NOTHING
    low, high = mean_t(valid.mean(), valid.std(ddof=1), valid.size)
    return Reading(float(valid.mean()), Interval(float(low), float(high)))


def share_of(hits: np.ndarray, pixels_each: float) -> Reading:
    """Return the share of true ``hits`` with Wilson's interval; ``pixels_each`` neighbours count
    as a single pixel."""
    trials = hits.size / pixels_each
    low, high = wilson(hits.mean() * trials, trials)
    return Reading(float(hits.mean()), Interval(float(low), float(high)))


BISQUARE = 4.685  # Tukey's constant, which gives an efficiency of 95 % for normal errors
CANDIDATES = 400
TRIPLE_PX = 40
SCREENED = 4000
"""Number of planes tried in each round, distance between the three points of each, and pixels that
judge it."""
GROWN = 2.0
MOST_PLANES = 6


def robust_inverse_fit(basis: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return coefficients c of 1/z = basis c, and which points count, by Tukey's bisquare on
    residuals of z."""
    weight = np.ones_like(z)
    for _ in range(15):
        # an error of z is z^2 times an error of 1/z
        row = weight * z**4
        coefficients = np.linalg.lstsq(
            basis.T @ (basis * row[:, None]), basis.T @ (row / z), rcond=None
        )[0]
        residual = z - 1 / (basis @ coefficients)
        # the median is 0 for exact data; a micrometre counts as exact
        u = residual / (BISQUARE * max(1.4826 * float(np.median(np.abs(residual))), 1e-6))
        weight = np.where(np.abs(u) < 1, (1 - u**2) ** 2, 0.0)
    return coefficients, weight > 0


def _with_ones(slopes: np.ndarray) -> np.ndarray:
    return np.concatenate([np.ones((*slopes.shape[:-1], 1)), slopes], axis=-1)


def fit_plane(z_m: np.ndarray, slopes: np.ndarray) -> Plane:
    """Return the plane through points of z (n,) on rays with ``slopes`` (n, 2), robust against a
    minority."""
    (a, b, c), _ = robust_inverse_fit(_with_ones(slopes), z_m)
    return Plane(float(1 / a), float(-b / a), float(-c / a))


def find_planes(
    z_m: np.ndarray, slopes: np.ndarray, tolerance_m: float, least_px: int
) -> list[tuple[Plane, np.ndarray]]:
    """Return the planes of a depth image with the connected pixels (h, w) bool of each, largest
    first, by RANSAC. ``z_m`` (h, w) is NaN where unknown. Points within ``tolerance_m`` of a plane
    belong to it, and connected points up to `GROWN` times as far. Planes with fewer than
    ``least_px`` pixels are left out. Equal images give equal planes."""
    basis = _with_ones(slopes)
    free = np.isfinite(z_m) & np.isfinite(slopes).all(axis=-1)
    planes: list[tuple[Plane, np.ndarray]] = []
    while len(planes) < MOST_PLANES and free.sum() >= least_px:
        inverse = _best_candidate(z_m, basis, free, tolerance_m, len(planes))
        for _ in range(3):
            mask = free & (_distance_m(inverse, basis, z_m) < tolerance_m)
            if mask.sum() < 3:
                break
            inverse = robust_inverse_fit(basis[mask], z_m[mask])[0]
        labels, _ = ndimage.label(free & (_distance_m(inverse, basis, z_m) < GROWN * tolerance_m))
        sizes = np.bincount(labels[mask & (labels > 0)], minlength=1)
        mask = labels == sizes.argmax() if sizes.any() else np.zeros_like(free)
        if mask.sum() < least_px:
            break
        planes.append((fit_plane(z_m[mask], slopes[mask]), mask))
        free = free & ~mask
    return sorted(planes, key=lambda plane_and_mask: -int(plane_and_mask[1].sum()))


def _best_candidate(
    z_m: np.ndarray, basis: np.ndarray, free: np.ndarray, tolerance_m: float, number: int
) -> np.ndarray:
    """Return the coefficients (3,) of 1/z of the plane through three close points that has most
    screened pixels."""
    rng = random_stream(0, "planes", number)
    points = np.argwhere(free)
    shift = rng.integers(-TRIPLE_PX, TRIPLE_PX + 1, (CANDIDATES, 3, 2))
    shift[:, 0] = 0
    sample = np.clip(
        points[rng.integers(0, len(points), CANDIDATES)][:, None] + shift,
        0,
        np.array(free.shape) - 1,
    )
    rays = basis[sample[..., 0], sample[..., 1]]
    z = z_m[sample[..., 0], sample[..., 1]]
    usable = free[sample[..., 0], sample[..., 1]].all(axis=1)
    usable[usable] = np.abs(np.linalg.det(rays[usable])) > 1e-8
    if not usable.any():
        return np.array([1 / np.nanmedian(z_m[free]), 0.0, 0.0])
    candidates = np.linalg.solve(rays[usable], 1 / z[usable][..., None])[..., 0]
    row, column = points[rng.integers(0, len(points), SCREENED)].T
    is_close = (
        _distance_m(candidates[:, None, :], basis[row, column], z_m[row, column]) < tolerance_m
    )
    return np.asarray(candidates[int(is_close.sum(axis=1).argmax())])


def _distance_m(inverse: np.ndarray, basis: np.ndarray, z_m: np.ndarray) -> np.ndarray:
    """Return the distance of points from the plane with coefficients ``inverse`` (..., 3) of 1/z;
    infinite for NaN."""
    with np.errstate(invalid="ignore"):
        distance = np.abs(z_m * (inverse * basis).sum(axis=-1) - 1) / np.linalg.norm(
            inverse, axis=-1
        )
    return np.nan_to_num(distance, nan=np.inf)


LAGS = 5
SURFACE_DEGREE = 5


def often_valid(z_m: np.ndarray, where: np.ndarray | bool) -> np.ndarray:
    """Return the pixels of ``where`` that count, (h, w) bool."""
    return where & (np.isfinite(z_m).sum(axis=0) >= max(2, len(z_m) / 2))


def temporal_sigma_m(z_m: np.ndarray, where: np.ndarray | bool = True) -> float:
    """Return the standard deviation over frames (n - 1), as an rms over the pixels that count; NaN
    if none does."""
    use = often_valid(z_m, where)
    return (
        float(np.sqrt(np.nanvar(z_m[:, use], axis=0, ddof=1).mean())) if use.any() else float("nan")
    )


def deviations(z_m: np.ndarray, where: np.ndarray | bool, keep_jitter: bool) -> np.ndarray:
    """Return deviations (n, h, w) from pixel means (minus each frame's mean unless kept), 0 for
    other pixels."""
    use = often_valid(z_m, where)
    d = np.zeros_like(z_m)
    d[:, use] = z_m[:, use] - np.nanmean(z_m[:, use], axis=0)
    if not keep_jitter and use.any():
        d[:, use] -= np.nanmean(d[:, use], axis=1)[:, None]
    return d


def covariance(d: np.ndarray, where: np.ndarray, lag_x: int, lag_y: int) -> tuple[float, float]:
    """Return (mean product, mean square) over pairs of pixels (lag_x, lag_y) apart in ``where``;
    NaN without pairs."""
    h, w = where.shape
    first = (slice(h - lag_y), slice(w - lag_x))
    second = (slice(lag_y, h), slice(lag_x, w))
    valid_pairs = where[first] & where[second]
    a = d[..., *first][..., valid_pairs]
    b = d[..., *second][..., valid_pairs]
    pair = np.isfinite(a) & np.isfinite(b)
    if not pair.any():
        return float("nan"), float("nan")
    return float((a * b)[pair].mean()), float(((a**2)[pair].mean() + (b**2)[pair].mean()) / 2)


def correlation(d: np.ndarray, where: np.ndarray, lag_x: int, lag_y: int) -> float:
    """Return the correlation of deviations of pixels (lag_x, lag_y) apart; NaN if there is
    none."""
    product, square = covariance(d, where, lag_x, lag_y)
    return product / square if square > 0 else float("nan")


def correlation_at(z_m: np.ndarray, where: np.ndarray | bool, lag_x: int, lag_y: int) -> float:
    """Return the correlation of temporal noise of pixels (lag_x, lag_y) apart, including
    whole-frame displacement."""
    return correlation(
        deviations(z_m, where, keep_jitter=True), often_valid(z_m, where), lag_x, lag_y
    )


@dataclass(frozen=True)
class FixedPattern:
    """The error of a wall's average beyond a smooth surface and noise: ``std_m``,
    ``covariance_m2`` at lags 0..20."""

    std_m: float
    covariance_m2: np.ndarray


def fixed_pattern(
    z_m: np.ndarray, where: np.ndarray, slopes: np.ndarray, lags: int = 20
) -> FixedPattern:
    """Return the fixed pattern of a wall: the average minus a robust surface of degree 5 in 1/z,
    without the remaining temporal noise. ``z_m`` (n, h, w) must be valid in every frame at every
    pixel of ``where``; ``slopes`` (h, w, 2)."""
    average = z_m.mean(axis=0)[where]
    # Legendre products up to total degree 5 over the slopes, scaled to -1..1
    middle = slopes[where].mean(axis=0)
    half = np.ptp(slopes[where], axis=0) / 2
    x, y = ((slopes[where] - middle) / half).T
    basis = np.polynomial.legendre.legvander2d(x, y, (SURFACE_DEGREE, SURFACE_DEGREE))
    i, j = np.divmod(np.arange(basis.shape[1]), SURFACE_DEGREE + 1)
    basis = np.asarray(basis[:, i + j <= SURFACE_DEGREE])
    coefficients, counts = robust_inverse_fit(basis, average)
    good = np.zeros_like(where)
    good[where] = counts
    residual = np.zeros(where.shape)
    residual[where] = average - 1 / (basis @ coefficients)
    residual[good] -= residual[good].mean()
    noise = deviations(z_m, good, keep_jitter=False)

    def left_at(lag_x: int, lag_y: int) -> float:
        # deviations from a mean of n frames have (n - 1)/n of the variance and the mean has 1/n: a
        # ratio of 1/(n - 1)
        of_noise = covariance(noise, good, lag_x, lag_y)[0] / (len(z_m) - 1)
        return covariance(residual[None], good, lag_x, lag_y)[0] - of_noise

    correlation_left = np.array([[left_at(k, 0), left_at(0, k)] for k in range(lags + 1)]).mean(
        axis=1
    )
    return FixedPattern(float(np.sqrt(max(correlation_left[0], 0))), correlation_left)


TOLERANCE_SIGMAS = 4.0
# a point of a surface lies within four standard deviations of noise plus a tenth of the step
TOLERANCE_STEP = 0.1
LEAST_TOLERANCE_M = 0.5 * MM
MOST_OF_STEP = 0.45
FLAT_PX = 8.0  # distance from an edge beyond which the camera's filter sees a single surface


def on_surface_tolerance_m(sigma_m: float, step_m: float) -> float:
    """Return the distance within which a range belongs to a surface; NaN if noise hides the step,
    since a tolerance of more than `MOST_OF_STEP` of the step would join the surfaces."""
    noise = TOLERANCE_SIGMAS * sigma_m if np.isfinite(sigma_m) else 0.0
    tolerance_m = max(noise, TOLERANCE_STEP * step_m, LEAST_TOLERANCE_M)
    return tolerance_m if tolerance_m <= MOST_OF_STEP * step_m else float("nan")


def edge_widths(
    z_m: np.ndarray,
    front_z_m: np.ndarray,
    back_z_m: np.ndarray,
    from_edge_px: np.ndarray,
    tolerance_m: float,
    reach_px: float,
    across: int,
) -> dict[str, np.ndarray]:
    """Return widths (n,) in pixels within ``reach_px`` of an edge that lines of pixels along the
    axis ``across`` cross, for each of the frames (n, h, w): the ``gap`` without a range, the
    ``flying`` pixels with a range off both surfaces, and the share of lines ``with_flying``
    pixels. All but the gap are NaN if noise hides the step. ``front_z_m`` and ``back_z_m`` (h, w)
    are z along each ray; ``from_edge_px`` (h, w) is negative in front, NaN for excluded pixels."""
    within_reach = np.abs(from_edge_px) <= reach_px
    z = z_m[:, within_reach]
    on_surface = np.any(
        [np.abs(z - surface[within_reach]) <= tolerance_m for surface in (front_z_m, back_z_m)],
        axis=0,
    )
    lines = np.asarray(within_reach.any(axis=across - 1))
    flying = np.zeros(z_m.shape, bool)
    flying[:, within_reach] = np.isfinite(z) & ~on_surface
    readings = {
        "gap": (~np.isfinite(z)).sum(axis=1) / lines.sum(),
        "flying": flying.sum(axis=(1, 2)) / lines.sum(),
    }
    readings["with_flying"] = np.asarray(flying.any(axis=across))[:, lines].mean(axis=1)
    unknown = np.full(len(z_m), np.nan)
    return {
        name: unknown if np.isnan(tolerance_m) and name != "gap" else reading
        for name, reading in readings.items()
    }
