"""Disagreement of views of one surface beyond noise: the random effects of their errors, estimated from the views.

View i measures a cell's height as h + e_i + f(p_i) + g_i: e_i is the noise that the sensor's law and the registration's
covariance explain; f the camera's fixed pattern, which belongs to the *pixel* p_i that looks at the cell and which all
views share whose pixels there are the same or near; g_i what is fixed for a view and cell alone (wiggling, multipath,
what a registration does not know of itself). Half the mean square difference of two views, as a function of how far
apart p_i and p_j lie on the sensor, is then

    noise + var g + var f (1 - exp(-(|p_i - p_j| / length)^exponent)),

a variogram with nugget and sill (Matheron 1963; Cressie 1993), fitted here to medians, because at damage views differ
for another reason: they see different parts of it. With independent views (all far apart) var f + var g is the tau^2 of
a random-effects meta-analysis. Views that turn about the target's middle look at it through the same pixels, and no
number of them averages the pattern out there: the covariance says so where a single tau^2 would not.

Not modelled: errors that all views share in all pixels, which no number of views shows; a pattern that is not the same
all over the sensor. Where views are no farther apart than the pattern is long, its sill is an extrapolation.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

CELLS = 2000
"""Cells from which the variogram is read, evenly taken."""
CLASSES, PER_CLASS = 12, 100
"""Classes of distance on the sensor with equal numbers of pairs, and the least number worth a median."""
LENGTHS = 24
"""Trial lengths, geometric from a pixel to the largest distance between views: a longer pattern is not seen as one."""
EXPONENTS = (1.0, 1.5, 2.0)
"""A camera that filters its image smooths its pattern over a few pixels: the law is then flat at first (2), not
pointed (1)."""
MEDIAN_SQUARE = 0.45494
"""Median of the square of a standard normal deviate."""
MEDIAN_ERROR = 2.33
"""Standard error of the median of n such squares, as a part of it, times the root of n."""


@dataclass(frozen=True)
class BetweenViews:
    """``own_m2``: variance of what is fixed for a view and cell alone; ``pattern_m2``: of the fixed pattern, with
    covariance exp(-(distance / ``length_px``)^``exponent``) between pixels. ``noise_share``: part of the variance that
    the sensor's law states that is noise; below 1 only where the law was read off a single frame, whose surface shows
    noise and pattern together."""

    own_m2: float = 0.0
    pattern_m2: float = 0.0
    length_px: float = 1.0
    exponent: float = 1.0
    noise_share: float = 1.0


def between_views(
    heights: np.ndarray, sensor: np.ndarray, other: np.ndarray, looks_px: np.ndarray, repeated: bool
) -> BetweenViews:
    """Estimate it from heights (k, h, w), NaN where a view has none, with variances that the ``sensor`` and ``other``
    (lens, registration) explain, and the direction ``looks_px`` (k, h, w, 2) in which each view sees each cell, in
    pixels.

    ``repeated``: the sensor's variances come from repeated frames. All zero with one view or too little overlap.
    """
    parts = _pairs(heights, sensor, other, looks_px)
    if parts is None:
        return BetweenViews()
    distance, half_square, of_sensor, of_other = _classes(*parts)
    # the k (k - 1) / 2 differences of k views hold k - 1 independent ones
    independent = 2.0 / len(heights) * len(parts[0]) / len(distance)
    error = half_square * MEDIAN_ERROR / np.sqrt(independent)
    left = half_square - of_other - (of_sensor if repeated else 0.0)
    first = np.ones_like(distance) if repeated else of_sensor
    level, pattern, length, exponent = _law(first, distance, left, error, repeated)
    if repeated:
        return BetweenViews(level, pattern, length, exponent)
    return BetweenViews(0.0, pattern, length, exponent, min(max(level, 0.01), 1.0))


def _pairs(
    heights: np.ndarray, sensor: np.ndarray, other: np.ndarray, looks_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """(n,) over pairs of views and some cells that both see: distance on the sensor, square difference, and the means
    of the two variances; None where there are too few."""
    views = len(heights)
    flat = heights.reshape(views, -1)
    several = np.flatnonzero(np.isfinite(flat).sum(axis=0) >= 2)
    some = several[:: max(1, len(several) // CELLS)]
    flat, sensor, other = flat[:, some], sensor.reshape(views, -1)[:, some], other.reshape(views, -1)[:, some]
    looks = looks_px.reshape(views, -1, 2)[:, some]
    found = []
    for i, j in combinations(range(views), 2):
        both = np.isfinite(flat[i]) & np.isfinite(flat[j])
        apart = looks[i, both] - looks[j, both]
        mean_sensor, mean_other = (0.5 * (v[i, both] + v[j, both]) for v in (sensor, other))
        difference = flat[i, both] - flat[j, both]
        found.append(np.stack([np.hypot(apart[:, 0], apart[:, 1]), difference**2, mean_sensor, mean_other]))
    if sum(part.shape[1] for part in found) < PER_CLASS:
        return None
    distance, square, mean_sensor, mean_other = np.concatenate(found, axis=1)
    return distance, square, mean_sensor, mean_other


def _classes(
    distance: np.ndarray, square: np.ndarray, sensor: np.ndarray, other: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The same by classes of distance, (c,) each; the square as half of a robust mean square."""
    number = min(CLASSES, max(1, len(distance) // PER_CLASS))
    parts = np.array_split(np.argsort(distance, kind="stable"), number)
    middle, squares, by_sensor, by_other = (
        np.array([np.median(values[part]) for part in parts]) for values in (distance, square, sensor, other)
    )
    return middle, np.maximum(0.5 * squares / MEDIAN_SQUARE, 1e-16), by_sensor, by_other


def _law(
    first: np.ndarray, distance: np.ndarray, left: np.ndarray, error: np.ndarray, may_vanish: bool
) -> tuple[float, float, float, float]:
    """(factor of ``first``, sill, length, exponent) of the law that explains ``left`` (c,), known to ``error``: of
    nothing at all (where it ``may_vanish``), ``first`` alone, and both terms that with the least chi square plus
    Schwarz's penalty.

    Without the penalty a chance slope of the variogram, stretched to a length that the views do not reach, would pass
    for a pattern that all of them share.
    """
    penalty = float(np.log(max(len(distance), 2)))
    known = left / error
    best = (float(known @ known), 0.0, 0.0, 1.0, 1.0)
    alone, level, _ = _fit(first, np.zeros_like(first), known, error)
    if not may_vanish or alone + penalty < best[0]:
        best = (alone + penalty, level, 0.0, 1.0, 1.0)
    for exponent, length in product(EXPONENTS, np.geomspace(1.0, max(1.0, float(distance.max())), LENGTHS)):
        both, level, sill = _fit(first, 1.0 - np.exp(-((distance / length) ** exponent)), known, error)
        if both + 4.0 * penalty < best[0]:
            best = (both + 4.0 * penalty, level, sill, float(length), exponent)
    return best[1:]


def _fit(first: np.ndarray, second: np.ndarray, known: np.ndarray, error: np.ndarray) -> tuple[float, float, float]:
    """(chi square, factor of ``first``, factor of ``second``), neither negative."""
    from scipy.optimize import nnls

    (level, sill), misfit = nnls(np.column_stack([first, second]) / error[:, None], known)
    return float(misfit) ** 2, float(level), float(sill)
