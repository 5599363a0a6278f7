"""Noise of a stack of frames: its deviation over time, its correlation between pixels, and the fixed pattern.

A stack is ``z_m`` (n, h, w) of a static scene, NaN where a frame has no range; ``where`` (h, w) bool names the pixels
that count. A pixel counts where at least half of the frames, and at least two, have a range.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize

from harness.scorecard.planes import robust_inverse_fit

LAGS = 5
SURFACE_DEGREE = 5
WINDOW_PX = 5
"""Up to this lag the part that is white before the Azure Kinect's filter window shows as a triangle."""


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


def covariance(d: np.ndarray, where: np.ndarray, lag_x: int, lag_y: int) -> tuple[float, float]:
    """(mean product, mean square) of pairs of pixels (lag_x, lag_y) apart, both inside ``where``; NaN without pairs."""
    h, w = where.shape
    first, second = (slice(h - lag_y), slice(w - lag_x)), (slice(lag_y, h), slice(lag_x, w))
    both = where[first] & where[second]
    if not both.any():
        return float("nan"), float("nan")
    a, b = d[..., *first][..., both], d[..., *second][..., both]
    pair = np.isfinite(a) & np.isfinite(b)
    return float((a * b)[pair].mean()), float(((a**2)[pair].mean() + (b**2)[pair].mean()) / 2)


def correlation(d: np.ndarray, where: np.ndarray, lag_x: int, lag_y: int) -> float:
    """Correlation of deviations of pixels (lag_x, lag_y) apart; NaN where there is none."""
    product, square = covariance(d, where, lag_x, lag_y)
    return product / square if square > 0 else float("nan")


def correlation_at(z_m: np.ndarray, where: np.ndarray, lag_x: int, lag_y: int) -> float:
    """Correlation of the temporal noise of pixels (lag_x, lag_y) apart, with what a whole frame has in common."""
    use = often_valid(z_m, where)
    return correlation(deviations(z_m, use, keep_jitter=True), use, lag_x, lag_y) if use.any() else float("nan")


@dataclass(frozen=True)
class FixedPattern:
    """The part of a wall's average that stays after a smooth surface and the temporal noise are taken off.

    ``std_m``; ``length_px`` of a Gaussian autocorrelation exp(-k^2 / 2 l^2) over lags 0 to 12; ``pixel_m``: the part
    that is white before the engine's window of 5, told by its triangle up to lag 5; ``covariance_m2`` (lags 0..20).
    """

    std_m: float
    length_px: float
    pixel_m: float
    covariance_m2: np.ndarray


def fixed_pattern(z_m: np.ndarray, where: np.ndarray, slopes: np.ndarray, lags: int = 20) -> FixedPattern:
    """The fixed pattern of a wall: average, minus a robust surface of degree 5 in 1/z, minus left temporal noise.

    ``z_m`` (n, h, w), every pixel of ``where`` valid in every frame; ``slopes`` (h, w, 2).
    """
    average = z_m.mean(axis=0)[where]
    # Legendre products up to total degree 5 over the slopes, scaled to -1..1
    middle, half = slopes[where].mean(axis=0), np.ptp(slopes[where], axis=0) / 2
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
        # deviations from a mean of n frames have (n - 1)/n of the variance, the mean 1/n: together 1/(n - 1)
        of_noise = covariance(noise, good, lag_x, lag_y)[0] / (len(z_m) - 1)
        return covariance(residual[None], good, lag_x, lag_y)[0] - of_noise

    left = np.array([[left_at(k, 0), left_at(0, k)] for k in range(lags + 1)]).mean(axis=1)
    length = float("nan")
    if left[0] > 0:
        lag, relative = np.arange(13), left[:13] / left[0]
        found = optimize.least_squares(lambda p: p[0] * np.exp(-(lag**2) / (2 * p[1] ** 2)) - relative, [1.0, 5.0])
        length = float(abs(found.x[1]))
    # c(0) - c(k) = p^2 k/5 + q k^2 - r k^4 up to the window: white noise makes the line, a smooth field the rest
    k = np.arange(1.0, WINDOW_PX + 1)
    rows = np.column_stack([k / WINDOW_PX, k**2, k**4])
    white, *_ = np.linalg.lstsq(rows, left[0] - left[1 : WINDOW_PX + 1], rcond=None)[0]
    pixel = float(np.sign(white) * np.sqrt(abs(white)))
    return FixedPattern(float(np.sqrt(max(left[0], 0))), length, pixel, left)
