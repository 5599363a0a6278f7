"""Each pixel's light before the filter: mean phasor, and how noise turns and lengthens it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from scipy import special

from scenes.sensor.amcw.exposure import AmcwExposure
from scenes.sensor.common.normals import FAST, bits_float, float_bits

f4 = np.float32
ZERO = f4(0)
ONE = f4(1)
TWELVE = f4(12)
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
    angle = 2 * np.pi * np.arange(phases) / phases
    shape = (len(gains), exposure.sigma.size)
    light = Light(
        phasor=np.empty(shape, np.complex64),
        amplitude=np.empty(shape, f4),
        mean_amplitude=np.empty(shape, f4),
        phase_noise=np.empty(shape, f4),
        relative_noise=np.empty(shape, f4),
    )
    for f, means in enumerate(exposure.means):
        _write_light(
            means,
            exposure.sigma,
            f4(knee),
            np.cos(angle).astype(f4),
            np.sin(angle).astype(f4),
            f4(gains[f] * f4(2 / phases)),
            Light._make(part[f] for part in light),
        )
    light.mean_amplitude[:] = light.amplitude * np.sqrt(f4(1) + light.phase_noise**2)
    noisy = light.relative_noise > NOISY_AMPLITUDE
    light.mean_amplitude[noisy] = _mean_by_rice(
        light.amplitude[noisy], light.phase_noise[noisy], light.relative_noise[noisy]
    )
    return light


@numba.njit(**FAST)
def _write_light(  # type: ignore[no-untyped-def]
    means,
    sigma,
    knee,
    cosines,
    sines,
    scale,
    light,
):
    """Write one frequency's ``light``, but its mean amplitude.
    `scenes.sensor.amcw.light_reference` has the same in NumPy.

    Args:
        means, sigma: (k, n) and (n,), as in `exposure.AmcwExposure`.
        knee: largest sample of unit steps, halved.
        cosines, sines: (k,) of the phase steps.
        scale: amplitude in converter units over the length of the sum of samples.
        light: of this frequency, (n,) each; written.
    """
    n = sigma.size
    re = np.zeros(n, f4)
    im = np.zeros(n, f4)
    for k in range(len(means)):
        _add_scaled(cosines[k], means[k], re)
        _add_scaled(sines[k], means[k], im)
    # direction and length of the phasor; without light there is no direction: any will do
    length = np.empty(n, f4)
    for i in range(np.uint64(n)):
        size = max(np.sqrt(re[i] * re[i] + im[i] * im[i]), NEVER_ZERO)
        lit = size > NEVER_ZERO
        re[i] = re[i] / size if lit else ONE
        im[i] = im[i] / size if lit else ZERO
        length[i] = size
    # variances across and along that direction
    across = np.zeros(n, f4)
    along = np.zeros(n, f4)
    for k in range(len(means)):
        _add_variances(means[k], sigma, knee, re, im, cosines[k], sines[k], across, along)
    for i in range(n):
        light.phasor[i] = complex(re[i], im[i])
        light.amplitude[i] = scale * length[i]
        light.phase_noise[i] = np.sqrt(across[i]) / length[i]
        light.relative_noise[i] = np.sqrt(along[i]) / length[i]


@numba.njit(**FAST)
def _add_scaled(scale, values, total):  # type: ignore[no-untyped-def]
    """Add ``scale`` times the values (n,) to their ``total`` (n,)."""
    for i in range(np.uint64(total.size)):
        total[i] += values[i] * scale


@numba.njit(**FAST)
def _add_variances(  # type: ignore[no-untyped-def]
    samples,
    sigma,
    knee,
    re,
    im,
    cosine,
    sine,
    across,
    along,
):
    """Add the variances (n,) that the noise of one phase step's ``samples`` (n,) has ``across`` and
    ``along`` phasors of direction (``re``, ``im``)."""
    for i in range(np.uint64(samples.size)):
        # the converter's step is the power of two at or below the sample over the knee, at least 1
        word: Any = float_bits(abs(samples[i]) / knee)
        step = max(bits_float(word & EXPONENT_BITS), ONE)
        variance = sigma[i] * sigma[i] + step * step / TWELVE
        sideways = re[i] * sine - im[i] * cosine
        forward = re[i] * cosine + im[i] * sine
        across[i] += variance * (sideways * sideways)
        along[i] += variance * (forward * forward)


def _mean_by_rice(
    amplitude: np.ndarray, phase_noise: np.ndarray, relative_noise: np.ndarray
) -> np.ndarray:
    """Return the mean length (n,) of phasors whose noise is taken as equal both ways."""
    deviation = amplitude * np.sqrt((phase_noise**2 + relative_noise**2) / 2)
    ratio = amplitude / np.maximum(deviation, SMALLEST)
    return np.asarray(deviation * np.interp(ratio, LENGTHS, RICE))
