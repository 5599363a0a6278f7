"""The fixed pattern of a plane: what stays of a stack's average after a smooth surface and the noise are taken off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize

from harness.scorecard.planes import robust_inverse_fit
from harness.scorecard.temporal import covariance, deviations

SURFACE_DEGREE = 5
WINDOW_PX = 5
"""Up to this lag the part that is white before the Azure Kinect's filter window shows as a triangle."""


@dataclass(frozen=True)
class FixedPattern:
    """What stays of a wall's average after a smooth surface and the temporal noise are taken off.

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
    basis = _surface_basis(slopes[where])
    coefficients, counts = robust_inverse_fit(basis, average)
    good = np.zeros_like(where)
    good[where] = counts
    residual = np.zeros(where.shape)
    residual[where] = average - 1 / (basis @ coefficients)
    residual[good] -= residual[good].mean()
    noise = deviations(z_m, good, keep_jitter=False)
    # Deviations from a mean of n frames have (n - 1)/n of the variance, the mean 1/n: together 1/(n - 1).
    left = np.array(
        [
            [
                covariance(residual[None], good, k, a)[0] - covariance(noise, good, k, a)[0] / (len(z_m) - 1)
                for a in (0, 1)
            ]
            for k in range(lags + 1)
        ]
    ).mean(axis=1)
    return FixedPattern(float(np.sqrt(max(left[0], 0))), _gaussian_length(left[:13]), _pixel_part(left), left)


def _surface_basis(slopes: np.ndarray) -> np.ndarray:
    """Legendre products up to total degree 5 over the slopes (n, 2), scaled to -1..1."""
    middle, half = slopes.mean(axis=0), np.ptp(slopes, axis=0) / 2
    x, y = ((slopes - middle) / half).T
    basis = np.polynomial.legendre.legvander2d(x, y, (SURFACE_DEGREE, SURFACE_DEGREE))
    i, j = np.divmod(np.arange(basis.shape[1]), SURFACE_DEGREE + 1)
    return np.asarray(basis[:, i + j <= SURFACE_DEGREE])


def _gaussian_length(c: np.ndarray) -> float:
    if not c[0] > 0:
        return float("nan")
    k = np.arange(c.size)
    found = optimize.least_squares(lambda p: p[0] * np.exp(-(k**2) / (2 * p[1] ** 2)) - c / c[0], [1.0, 5.0])
    return float(abs(found.x[1]))


def _pixel_part(c: np.ndarray) -> float:
    """c(0) - c(k) = p^2 k/5 + q k^2 - r k^4 up to the window: white noise makes the line, a smooth field the rest."""
    k = np.arange(1.0, WINDOW_PX + 1)
    rows = np.column_stack([k / WINDOW_PX, k**2, k**4])
    white, *_ = np.linalg.lstsq(rows, c[0] - c[1 : WINDOW_PX + 1], rcond=None)[0]
    return float(np.sign(white) * np.sqrt(abs(white)))
