"""What noise does to each pixel's phasor before the filter: the deviations of its phase and of its amplitude."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from scipy import special

from scenes.sensor.amcw.exposure import Exposure
from scenes.sensor.normals import FAST

SMALLEST = 1e-12


class Light(NamedTuple):
    """Each pixel before the filter, all (f, n) float64: ``phasor`` of length 1; ``amplitude`` without noise and
    ``bright``, its mean with it, times the gains; ``turn``: deviation of the phase in radians; ``swell``: that of the
    amplitude, over the amplitude."""

    phasor: np.ndarray
    amplitude: np.ndarray
    bright: np.ndarray
    turn: np.ndarray
    swell: np.ndarray


def light_of_samples(exposure: Exposure, knee: float, gains: np.ndarray) -> Light:
    """The light of an exposure, ``gains`` (f,) those of the amplitudes.

    Each sample has its own variance: the exposure's, and step^2/12 of the converter's rounding.
    """
    frequencies, phases, n = exposure.means.shape
    angle = 2 * np.pi * np.arange(phases) / phases
    phasor = np.empty((frequencies, n), complex)
    size, across, along = (np.empty((frequencies, n)) for _ in range(3))
    _moments(exposure.means, exposure.sigma, knee, np.cos(angle), np.sin(angle), phasor, size, across, along)
    scale = gains.astype(float)[:, None] * 2.0 / phases
    bright = np.sqrt(size**2 + across**2)
    near = size < 10 * along
    bright[near] = _rice_mean(size[near], np.sqrt((across[near] ** 2 + along[near] ** 2) / 2))
    return Light(phasor, scale * size, scale * bright, across / size, along / size)


def _rice_mean(size: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Mean length of a vector of length ``size`` plus normals of a deviation in both directions."""
    x = (size / np.maximum(deviation, SMALLEST)) ** 2 / 4
    return np.asarray(deviation * np.sqrt(np.pi / 2) * ((1 + 2 * x) * special.ive(0, x) + 2 * x * special.ive(1, x)))


@numba.njit(**FAST)
def _moments(means, sigma, knee, cosines, sines, phasor, size, across, along):  # type: ignore[no-untyped-def]
    """Direction and length of each pixel's phasor, and its deviations across and along that direction."""
    frequencies, phases, n = means.shape
    for f in range(frequencies):
        for i in range(n):
            re, im = 0.0, 0.0
            for k in range(phases):
                re += cosines[k] * means[f, k, i]
                im += sines[k] * means[f, k, i]
            length = np.sqrt(re * re + im * im)
            if length > SMALLEST:
                re /= length
                im /= length
            else:
                # no light has no direction: any will do
                re, im, length = 1.0, 0.0, SMALLEST
            over, beside = 0.0, 0.0
            for k in range(phases):
                step = converter_step(abs(means[f, k, i]) / knee)
                variance = np.float64(sigma[i]) ** 2 + step * step / 12.0
                over += variance * (re * sines[k] - im * cosines[k]) ** 2
                beside += variance * (re * cosines[k] + im * sines[k]) ** 2
            phasor[f, i] = complex(re, im)
            size[f, i] = length
            across[f, i] = np.sqrt(over)
            along[f, i] = np.sqrt(beside)


@numba.njit(**FAST)
def converter_step(knees: float) -> float:
    """The companding converter's step, in its units, at a sample of so many knees."""
    step = 1.0
    while 2.0 * step <= knees:
        step *= 2.0
    return step
