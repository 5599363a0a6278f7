"""The seam: what the render hands to the sensor. Slow to make, cached by content; all after it is NumPy and cheap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.vocabulary.geometry import Region


@dataclass(frozen=True)
class NoiseFreeView:
    """Noise-free light of one view on a region of the sensor.

    ``phasor`` (f, h, w) complex64 (its rounding turns 200 MHz by 10 nm): per modulation frequency the light of all
    paths, sum over paths of a * exp(+i 2 pi f L / c), L the full path length; amplitudes in units of an
    unoccluded albedo-1 Lambertian plane facing emitter and camera at 1 m on the axis (=1).
    ``phasor_direct`` (f, h, w): the part without interreflection. ``intensity`` (h, w): the same sum at frequency 0.
    ``indirect_noise_m`` (h, w): one standard deviation of range that the Monte Carlo part leaves in a pixel.
    ``range_m`` (h, w): true distance from the lens along the pixel's central ray, NaN where it meets nothing.
    ``surface`` (h, w) int16: index into ``surface_names`` at the central ray, -1 for nothing.
    ``coverage`` (h, w): fraction of the footprint on the central ray's surface. ``rgb`` (h, w, 3) float32 albedo, 0..1.
    ``slopes`` (h, w, 2): x/z and y/z of the central rays.
    """

    region: Region
    frequencies_hz: tuple[float, ...]
    phasor: np.ndarray
    phasor_direct: np.ndarray
    intensity: np.ndarray
    indirect_noise_m: np.ndarray
    range_m: np.ndarray
    surface: np.ndarray
    surface_names: tuple[str, ...]
    coverage: np.ndarray
    rgb: np.ndarray
    slopes: np.ndarray
    seconds: float
    variant: str
