"""Wood grain: a seeded pattern of dark lines and fibres along x; look-up of a texture (see `scenes.target.mesh`)."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, zoom
from scipy.optimize import brentq

from harness.vocabulary.seeds import random_stream
from scenes.target.custom import MaterialConfig

TEXEL_MM = 0.6
"""Finer than a pixel's footprint (1.4 mm at 0.7 m for the finest camera in view), coarse enough to make in 40 ms."""
MAX_TEXELS = 4096
"""Most texels along a side: a board of metres gets coarser texels instead of gigabytes."""
LINE_WEIGHT, FIBRE_WEIGHT = 0.8, 0.6
"""Amplitudes of growth lines and fibres in the pattern (their squares add to 1). A guess."""
WANDER_MM, WANDER_ACROSS_MM, WANDER_ALONG_MM = 6.0, 60.0, 240.0
"""Wander of growth lines (standard deviation), and its lengths across and along x. A guess."""
FIBRE_LENGTH_MM, FIBRE_WIDTH_MM = 12.0, 0.5
"""Correlation lengths of the fibres along and across x. A guess."""


def grain(material: MaterialConfig, width_mm: float, height_mm: float) -> np.ndarray:
    """Return the grain of a board's face: (rows, columns) float64 with mean 0 and standard deviation 1.

    Not modelled: knots, seams of the veneer, gloss, a contrast that depends on the wavelength.
    """
    texel_mm = max(TEXEL_MM, width_mm / MAX_TEXELS, height_mm / MAX_TEXELS)
    rows, columns = (max(2, round(size / texel_mm)) for size in (height_mm, width_mm))
    stream = random_stream(material.grain_seed, "grain")
    wander = _wander(stream, (rows, columns), texel_mm)
    across_mm = (np.arange(rows)[:, None] + 0.5) * texel_mm + WANDER_MM * wander
    turns = across_mm / material.grain_period_mm + stream.uniform()
    # Late wood: a thin dark line at the end of each ring, after a slow fall.
    lines = -((turns % 1.0) ** 3)
    fibres = _smooth_noise(stream, (rows, columns), texel_mm, FIBRE_WIDTH_MM, FIBRE_LENGTH_MM)
    return _normalised(LINE_WEIGHT * _normalised(lines) + FIBRE_WEIGHT * fibres)


def reflectance(pattern: np.ndarray, mean: float, contrast: float) -> np.ndarray:
    """Return albedo (rows, columns) float32 with exactly this mean: mean (1 + contrast pattern), clipped to 0..1.

    Where clipping would move the mean, the pattern is lifted to bring it back; the contrast then falls short.
    """
    raw = mean * (1 + contrast * pattern)

    def excess(lift: float) -> float:
        return float(np.clip(raw + lift, 0.0, 1.0).mean()) - mean

    lift = 0.0 if raw.min() >= 0.0 and raw.max() <= 1.0 else float(brentq(excess, -2.0, 2.0, xtol=1e-9))
    return np.clip(raw + lift, 0.0, 1.0).astype(np.float32)


def look_up(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return bilinear values (...[, channels]) of a texture (rows, columns[, channels]) at ``uv`` (..., 2)."""
    rows, columns = texture.shape[:2]
    places = np.stack([uv[..., 1] * rows - 0.5, uv[..., 0] * columns - 0.5])
    channels = texture.reshape(rows, columns, -1)
    values = [map_coordinates(channels[..., i], places, order=1, mode="nearest") for i in range(channels.shape[2])]
    return np.stack(values, axis=-1) if texture.ndim == 3 else values[0]


def _wander(stream: np.random.Generator, shape: tuple[int, int], texel_mm: float) -> np.ndarray:
    """Draw a slow random field, mean 0 and deviation 1: coarse noise through a cubic spline."""
    knots = [2 + round(n * texel_mm / s) for n, s in zip(shape, (WANDER_ACROSS_MM, WANDER_ALONG_MM), strict=True)]
    coarse = stream.standard_normal(knots)
    return _normalised(zoom(coarse, [n / k for n, k in zip(shape, knots, strict=True)], order=3, mode="nearest"))


def _smooth_noise(
    stream: np.random.Generator, shape: tuple[int, int], texel_mm: float, across_mm: float, along_mm: float
) -> np.ndarray:
    """Draw Gaussian noise filtered to correlation lengths across (rows) and along (columns), mean 0 and deviation 1."""
    noise = stream.standard_normal(shape, dtype=np.float32)
    return _normalised(
        gaussian_filter(noise, (across_mm / texel_mm, along_mm / texel_mm), mode="reflect", truncate=3.0)
    )


def _normalised(values: np.ndarray) -> np.ndarray:
    centred = np.asarray(values, float) - np.mean(values, dtype=float)
    return centred / max(float(centred.std()), 1e-12)
