"""Temporal noise of a stack of frames: its deviation, and how alike neighbouring pixels are.

A stack is ``z_m`` (n, h, w) of a static scene, NaN where a frame has no range; ``where`` (h, w) bool names the pixels
that count. A pixel counts where at least half of the frames, and at least two, have a range.
"""

from __future__ import annotations

import numpy as np

LAGS = 5


def often_valid(z_m: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(h, w) bool: the pixels of ``where`` that count."""
    return where & (np.isfinite(z_m).sum(axis=0) >= max(2, len(z_m) / 2))


def temporal_sigma_m(z_m: np.ndarray, where: np.ndarray) -> float:
    """Standard deviation over frames (n - 1), rms over the pixels that count; NaN where none does."""
    use = often_valid(z_m, where)
    return float(np.sqrt(np.nanvar(z_m[:, use], axis=0, ddof=1).mean())) if use.any() else float("nan")


def deviations(z_m: np.ndarray, where: np.ndarray, keep_jitter: bool) -> np.ndarray:
    """(n, h, w) deviations from each pixel's mean; without what a frame's pixels have in common unless kept.

    0 at pixels that do not count, NaN where a frame has no range.
    """
    use = often_valid(z_m, where)
    d = np.zeros_like(z_m)
    d[:, use] = z_m[:, use] - np.nanmean(z_m[:, use], axis=0)
    if not keep_jitter and use.any():
        d[:, use] -= np.nanmean(d[:, use], axis=1)[:, None]
    return d


def covariance(d: np.ndarray, where: np.ndarray, lag: int, axis: int) -> tuple[float, float]:
    """(mean product of pixels ``lag`` apart along x (0) or y (1), their mean square) over pairs inside ``where``."""
    return lagged(d, where, *((lag, 0) if axis == 0 else (0, lag)))


def lagged(d: np.ndarray, where: np.ndarray, lag_x: int, lag_y: int) -> tuple[float, float]:
    """(mean product, mean square) of pairs of pixels (lag_x, lag_y) apart, both inside ``where``; NaN without pairs."""
    h, w = where.shape
    first, second = (slice(h - lag_y), slice(w - lag_x)), (slice(lag_y, h), slice(lag_x, w))
    both = where[first] & where[second]
    if not both.any():
        return float("nan"), float("nan")
    a, b = d[..., *first][..., both], d[..., *second][..., both]
    pair = np.isfinite(a) & np.isfinite(b)
    return float((a * b)[pair].mean()), float(((a**2)[pair].mean() + (b**2)[pair].mean()) / 2)


def correlation(d: np.ndarray, where: np.ndarray, lags: int = LAGS) -> np.ndarray:
    """(x and y, lags 1 to ``lags``) correlation of the temporal noise; NaN where there is none."""
    pairs = [[covariance(d, where, lag, axis) for lag in range(1, lags + 1)] for axis in (0, 1)]
    return np.array([[product / square if square > 0 else np.nan for product, square in row] for row in pairs])


def correlation_at(z_m: np.ndarray, where: np.ndarray, lag_x: int, lag_y: int) -> float:
    """Correlation of the temporal noise of pixels (lag_x, lag_y) apart, with what a whole frame has in common."""
    use = often_valid(z_m, where)
    if not use.any():
        return float("nan")
    product, square = lagged(deviations(z_m, use, keep_jitter=True), use, lag_x, lag_y)
    return product / square if square > 0 else float("nan")
