"""Each pixel's light before the filter: mean phasor, and how noise turns and lengthens it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

from scenes.sensor.amcw.exposure import AmcwExposure

f4 = np.float32
SMALLEST = 1e-12
NEVER_ZERO = f4(SMALLEST)
NOISY_AMPLITUDE = 0.1  # relative noise from which the mean amplitude is computed by Rice's formula
EXPONENT_BITS = np.uint32(0x7F800000)  # of a float32: the number without its mantissa

LENGTHS = np.linspace(0.0, 15.0, 1501)
RICE = np.sqrt(np.pi / 2) * (
    (1 + LENGTHS**2 / 2) * special.ive(0, LENGTHS**2 / 4)
    + LENGTHS**2 / 2 * special.ive(1, LENGTHS**2 / 4)
)
"""Mean length, by Rice, of a vector of `LENGTHS` plus normals of deviation 1 both ways; 1e-5
between them."""


class Light(NamedTuple):
    """Each pixel before the filter, at f frequencies and n pixels."""

    phasor: np.ndarray
    """(f, n) complex64: direction of the mean phasor, of length 1."""
    amplitude: np.ndarray
    """(f, n) float32: length of the mean phasor times the gain, in converter units."""
    mean_amplitude: np.ndarray
    """(f, n) float32: mean of the noisy amplitude, which noise across the phasor lengthens."""
    phase_noise: np.ndarray
    """(f, n) float32: deviation of the phase in radians."""
    relative_noise: np.ndarray
    """(f, n) float32: deviation of the amplitude over the amplitude."""


def light_of_samples(exposure: AmcwExposure, knee: float, gains: np.ndarray) -> Light:
    """Return the light of an exposure. Each sample has its own variance, plus step^2/12 by the
    converter's rounding."""
    phases = exposure.means.shape[1]
    angle = 2 * np.pi * np.arange(phases)[:, None] / phases
    cosines = np.cos(angle).astype(f4)
    sines = np.sin(angle).astype(f4)
    shape = (len(gains), exposure.sigma.size)
    light = Light(
        phasor=np.empty(shape, np.complex64),
        amplitude=np.empty(shape, f4),
        mean_amplitude=np.empty(shape, f4),
        phase_noise=np.empty(shape, f4),
        relative_noise=np.empty(shape, f4),
    )
    for f, means in enumerate(exposure.means):
        variance = exposure.sigma**2 + _converter_step(means, knee) ** 2 / 12
        # direction and length of the phasor; without light there is no direction: any will do
        re = (means * cosines).sum(axis=0)
        im = (means * sines).sum(axis=0)
        length = np.maximum(np.sqrt(re * re + im * im), NEVER_ZERO)
        re = np.where(length > NEVER_ZERO, re / length, f4(1))
        im = np.where(length > NEVER_ZERO, im / length, f4(0))
        light.phasor[f].real = re
        light.phasor[f].imag = im
        light.amplitude[f] = gains[f] * f4(2 / phases) * length
        # deviations across and along that direction
        across = (variance * (re * sines - im * cosines) ** 2).sum(axis=0)
        along = (variance * (re * cosines + im * sines) ** 2).sum(axis=0)
        light.phase_noise[f] = np.sqrt(across) / length
        light.relative_noise[f] = np.sqrt(along) / length
    light.mean_amplitude[:] = light.amplitude * np.sqrt(f4(1) + light.phase_noise**2)
    noisy = light.relative_noise > NOISY_AMPLITUDE
    light.mean_amplitude[noisy] = _mean_by_rice(
        light.amplitude[noisy], light.phase_noise[noisy], light.relative_noise[noisy]
    )
    return light


def _converter_step(samples: np.ndarray, knee: float) -> np.ndarray:
    """Return the companding converter's step at each sample: the power of two at or below the
    sample over the knee, at least 1."""
    octave = (np.abs(samples / f4(knee)).view(np.uint32) & EXPONENT_BITS).view(f4)
    return np.maximum(octave, f4(1))


def _mean_by_rice(
    amplitude: np.ndarray, phase_noise: np.ndarray, relative_noise: np.ndarray
) -> np.ndarray:
    """Return the mean length (n,) of phasors whose noise is taken as equal both ways."""
    deviation = amplitude * np.sqrt((phase_noise**2 + relative_noise**2) / 2)
    ratio = amplitude / np.maximum(deviation, SMALLEST)
    return np.asarray(deviation * np.interp(ratio, LENGTHS, RICE))
