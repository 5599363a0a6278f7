"""Several views' heights of one cell to one height with its variance."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from detectors.mapping.between_views import BetweenViews

GATE_SIGMAS = 5.0
"""An observation so many deviations from the median of at least three views is an outlier."""


@dataclass(frozen=True)
class Combined:
    """Values of each cell, (h, w): ``height_m``, ``variance_m2`` of an intact surface's height, ``temporal_m2`` the
    part of it that more frames would lessen, ``spread_m2`` the views' sample variance (NaN below two views). ``used``
    (k, h, w) bool: views that count; ``shares`` (k, h, w): their weights, which sum to 1. ``rejected``: outliers."""

    height_m: np.ndarray
    variance_m2: np.ndarray
    temporal_m2: np.ndarray
    spread_m2: np.ndarray
    used: np.ndarray
    shares: np.ndarray
    rejected: int


def combine(
    heights: np.ndarray, sensor: np.ndarray, other: np.ndarray, looks_px: np.ndarray, between: BetweenViews
) -> Combined:
    """The cells' heights from views' (k, h, w); arguments as of `detectors.mapping.between_views.between_views`.

    The weight of a view is the inverse of its own variance, fixed errors included; the variance of the mean takes the
    covariance of views into account whose pixels lie near one another. (The weights that would be best under that
    covariance can be negative, which a hole seen by some views only does not forgive.)

    Rejected is an observation more than `GATE_SIGMAS` deviations (its own, or the robust spread of the views, if that
    is larger) from the median of at least three views, where it cannot be damage: as far before the fitted surface,
    where it would have been in the others' way; or behind, but alone among its own neighbours, as a flying pixel is and
    nothing that has passed a camera's filter. A hole stays that few views see into, and its wall that few views see.
    """
    temporal = between.noise_share * sensor
    whole = temporal + other + between.own_m2 + between.pattern_m2
    rejected = _outliers(heights, whole)
    used = np.isfinite(heights) & ~rejected
    weights = np.where(used, 1.0 / whole, 0.0)
    n = used.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = np.nan_to_num(weights / weights.sum(axis=0))
        values = np.where(used, heights, 0.0)
        plain = values.sum(axis=0) / n
        spread = np.where(used, (heights - plain) ** 2, 0.0).sum(axis=0) / (n - 1)
    alone = (shares**2 * np.where(used, temporal + other + between.own_m2, 0.0)).sum(axis=0)
    common = np.zeros(n.shape)
    if between.pattern_m2 > 0:
        looks = np.ascontiguousarray(looks_px)
        common = between.pattern_m2 * _shared(shares, looks, between.length_px, between.exponent)
    return Combined(
        height_m=np.where(n > 0, (shares * values).sum(axis=0), np.nan),
        variance_m2=np.where(n > 0, alone + common, np.nan),
        temporal_m2=np.where(n > 0, (shares**2 * np.where(used, temporal, 0.0)).sum(axis=0), np.nan),
        spread_m2=np.where(n > 1, spread, np.nan),
        used=used,
        shares=shares,
        rejected=int(rejected.sum()),
    )


@numba.njit(cache=True, nogil=True)
def _shared(shares: np.ndarray, looks_px: np.ndarray, length_px: float, exponent: float) -> np.ndarray:
    """(h, w): sum over pairs of views of the product of their shares and their pattern's correlation."""
    views, h, w = shares.shape
    total = np.zeros((h, w))
    for i in range(views):
        for row in range(h):
            for column in range(w):
                total[row, column] += shares[i, row, column] ** 2
        for j in range(i):
            for row in range(h):
                for column in range(w):
                    both = shares[i, row, column] * shares[j, row, column]
                    if both > 0.0:
                        du = looks_px[i, row, column, 0] - looks_px[j, row, column, 0]
                        dv = looks_px[i, row, column, 1] - looks_px[j, row, column, 1]
                        apart = (du * du + dv * dv) / length_px**2
                        total[row, column] += 2.0 * both * np.exp(-(apart ** (0.5 * exponent)))
    return total


@numba.njit(cache=True, nogil=True)
def _outliers(heights: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """(k, h, w) bool, by the rule of `combine`."""
    views, h, w = heights.shape
    rejected = np.zeros((views, h, w), dtype=np.bool_)
    values, apart = np.empty(views), np.empty(views)
    for row in range(h):
        for column in range(w):
            n = 0
            for k in range(views):
                if np.isfinite(heights[k, row, column]):
                    values[n] = heights[k, row, column]
                    n += 1
            if n < 3:
                continue
            middle = np.median(values[:n])
            for i in range(n):
                apart[i] = abs(values[i] - middle)
            robust = 1.4826 * np.median(apart[:n])
            for k in range(views):
                deviation = heights[k, row, column] - middle
                limit = GATE_SIGMAS * max(robust, np.sqrt(variances[k, row, column]))
                if abs(deviation) > limit:
                    before = deviation < 0.0 and heights[k, row, column] < -limit
                    alone = deviation > 0.0 and _alone(heights[k], row, column, limit)
                    rejected[k, row, column] = before or alone
    return rejected


@numba.njit(cache=True, nogil=True)
def _alone(heights: np.ndarray, row: int, column: int, limit: float) -> bool:
    """Return True if a cell lies farther than the limit behind the median of itself and its eight neighbours."""
    h, w = heights.shape
    near = np.empty(9)
    n = 0
    for r in range(max(0, row - 1), min(h, row + 2)):
        for c in range(max(0, column - 1), min(w, column + 2)):
            if np.isfinite(heights[r, c]):
                near[n] = heights[r, c]
                n += 1
    return bool(heights[row, column] - np.median(near[:n]) > limit)
