"""The target's own colour, pixel by pixel, and the pixels that stand apart from it.

Colour enters as chromaticity, which uneven light leaves alone and light of another colour shifts. A smooth polynomial
over the target, fitted robustly, follows the shift; the scatter of what is left (minimum covariance determinant,
Rousseeuw 1985, by concentration steps from one fixed start) says how far the target's own colour strays; and the
threshold is extrapolated from the scatter's own tail to a stated rate of false pixels. Marks may cover a quarter of the
target. Not modelled: shadows with hard edges, whose indirect light has another colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

FALSE_RATE = 1e-5
"""Share of the target's own pixels that the extrapolated tail puts beyond the threshold. In a light that falls by three
a Gaussian scatter of the counts gives ten times as many, Laplace's a hundred times: one pixel in a thousand, which is
no mark, because a mark has nine that touch."""
DEGREE = 2
"""Degree of the polynomial: one lamp's fall-off over a board, or two lamps of different colour, bend once."""
SAMPLE = 4096
"""Pixels of the fit: a coefficient's standard error is then a sixtieth of the scatter."""
STEPS = 6
"""Steps of reweighting: the scatter has then settled to 3 %."""
CORE = 0.6
"""Share of the pixels that the scatter rests on."""
CORE_SHRINKS = {1: 0.2146, 2: 0.3891}
"""Variance of the innermost `CORE` of a Gaussian in one and two dimensions: F_(p+2)(q) / `CORE` with F_p(q) = `CORE`, F
the chi-squared distribution."""
GAUSSIAN_LIMITS = {1: 4.4172, 2: 4.7985}
"""Distances that `FALSE_RATE` of a Gaussian's exceed, in one and two dimensions."""
NEARBY_PX = 16
"""Reach to which a camera smears colour: JPEG and video keep one colour for two by two pixels, in blocks of eight of
these."""
TAIL = (0.4, 0.7)
"""Quantiles from which the tail is extrapolated; those above may be marks."""


def chromaticity(rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return shares (n, 2) of red and of blue in the sum of the channels, and the variance (n,) that rounding to whole
    counts gives each of them, of colours (n, 3) uint8. Half a count is added, so that black has a share."""
    counts = rgb.astype(np.float64) + 0.5
    total = counts.sum(axis=1)
    return counts[:, [0, 2]] / total[:, None], 1.0 / 12.0 / total**2


def lightness(rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the logarithm (n, 1) of the mean of the channels and the variance (n,) that rounding gives it; see
    `chromaticity`."""
    mean = rgb.astype(np.float64).mean(axis=1) + 0.5
    return np.log(mean)[:, None], 1.0 / 36.0 / mean**2


@dataclass(frozen=True)
class Apart:
    """Distance of pixels from the target's own colour: ``contrast`` (n,) in deviations of its scatter, and ``margin``
    (n,) in units of the threshold, which is wider for dark pixels."""

    contrast: np.ndarray
    margin: np.ndarray


def stand_out(features: np.ndarray, rounding: np.ndarray, xy: np.ndarray) -> Apart:
    """Find the pixels that stand apart from the rest.

    ``features`` (n, p), p 1 or 2; ``rounding`` (n,) their variance from the whole counts, which dark pixels have more
    of: whatever noise the counts have is taken to grow as it does. ``xy`` (n, 2): any smooth co-ordinates.
    """
    stride = max(1, len(features) // SAMPLE)
    basis = _polynomials(xy)
    backdrop = basis @ _smooth(basis[::stride], features[::stride])
    offset = features - backdrop
    darkness = np.sqrt(np.maximum(rounding / np.median(rounding), 1.0))
    scatter = _scatter((offset / darkness[:, None])[::stride]) + np.median(rounding) * np.eye(features.shape[1])
    contrast = np.sqrt(np.einsum("ni,ij,nj->n", offset, np.linalg.inv(scatter), offset))
    distance = contrast / darkness
    return Apart(contrast, distance / _threshold(distance[::stride], features.shape[1]))


def above_half(chosen: np.ndarray, contrast: np.ndarray) -> np.ndarray:
    """Return (h, w) bool: of the ``chosen`` pixels those whose contrast is more than half of the greatest nearby, so
    that a group ends where its edge is half way, and what a camera smears around it is not taken for more. The greatest
    is that of a pixel with its eight neighbours, by their median."""
    beyond = np.where(chosen, contrast, 0.0).astype(np.float32)
    side = 2 * NEARBY_PX + 1
    greatest = cv2.dilate(cv2.medianBlur(beyond, 3), np.ones((side, side), np.uint8))
    kept: np.ndarray = chosen & (beyond > 0.5 * greatest)
    return kept


def _polynomials(xy: np.ndarray) -> np.ndarray:
    low, high = xy.min(axis=0), xy.max(axis=0)
    x, y = ((xy - (low + high) / 2) / np.maximum((high - low) / 2, 1e-12)).T
    return np.stack([x**i * y**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=1)


def _smooth(basis: np.ndarray, features: np.ndarray) -> np.ndarray:
    """Return coefficients (terms, p) by iterated bisquare weights from the median, one weight a pixel."""
    coefficients = np.zeros((basis.shape[1], features.shape[1]))
    coefficients[0] = np.median(features, axis=0)
    for _ in range(STEPS):
        residuals = features - basis @ coefficients
        scale = np.maximum(np.median(np.abs(residuals), axis=0) / 0.6745, 1e-4)
        square = ((residuals / (4.685 * scale)) ** 2).max(axis=1)
        weight = np.where(square < 1.0, (1.0 - square) ** 2, 0.0)
        gram = (basis * weight[:, None]).T @ basis
        coefficients = np.linalg.lstsq(gram, (basis * weight[:, None]).T @ features, rcond=1e-9)[0]
    return coefficients


def _scatter(apart: np.ndarray) -> np.ndarray:
    """Return the covariance (p, p) of the bulk about the backdrop, as of a Gaussian whose innermost part it is."""
    p = apart.shape[1]
    covariance = np.diag(np.maximum(np.median(np.abs(apart), axis=0) / 0.6745, 1e-6) ** 2)
    for _ in range(STEPS):
        square = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(covariance), apart)
        core = apart[square <= np.quantile(square, CORE)]
        covariance = core.T @ core / len(core) / CORE_SHRINKS[p] + 1e-12 * np.eye(p)
    return covariance


def _threshold(distance: np.ndarray, p: int) -> float:
    """Return the distance that `FALSE_RATE` of the target's own pixels exceed: a Weibull tail through the quantiles
    `TAIL`, between a Gaussian's (shape 2 in two dimensions) and an exponential one (shape 1), and never below the
    Gaussian's.
    """
    middle, outer = np.quantile(distance, TAIL)
    logs = [-np.log(1.0 - share) for share in TAIL]
    shape = np.log(logs[1] / logs[0]) / np.log(outer / middle) if 0 < middle < outer else 2.0
    tail = outer * (-np.log(FALSE_RATE) / logs[1]) ** (1.0 / float(np.clip(shape, 1.0, 2.0)))
    return float(max(tail, GAUSSIAN_LIMITS[p]))
