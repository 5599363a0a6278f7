"""Frames of a simulated unit as arrays, the truth beside them, and how their noise correlates."""

from __future__ import annotations

import numpy as np

from harness.vocabulary.geometry import Frame
from scenes.sensor.source import SimulatedUnit


def first_frame(unit: SimulatedUnit) -> Frame:
    return next(iter(unit.capture(1, 1).frames()))


def z_of(unit: SimulatedUnit, count: int = 1, seed: int = 1) -> np.ndarray:
    """z (count, h, w) in metres."""
    frames = unit.capture(count, seed).frames()
    return np.stack([frame.z_m for frame in frames]).astype(float)


def stretch_of(unit: SimulatedUnit) -> np.ndarray:
    """(h, w): range along the ray by distance along the axis."""
    slopes = unit.view.slopes[unit.cut]
    return np.sqrt(1 + (slopes**2).sum(axis=-1))


def true_z_m(unit: SimulatedUnit) -> np.ndarray:
    """z (h, w) of the view's central rays."""
    return unit.view.range_m[unit.cut] / stretch_of(unit)


def noise_of(z: np.ndarray) -> np.ndarray:
    """z (count, h, w) minus its mean over the frames."""
    return z - z.mean(axis=0)


def correlation(noise: np.ndarray, down: int, across: int) -> float:
    """Correlation of noise (count, h, w) with that of pixels so many rows and columns away."""
    h, w = noise.shape[1:]
    products = noise[:, down:, across:] * noise[:, : h - down, : w - across]
    return float(products.mean() / (noise**2).mean())
