"""Sums of phasors over sub-rays, for a few frequencies of any kind or a comb of many."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from harness.vocabulary.units import SPEED_OF_LIGHT_AIR

FAST: Any = {"cache": True, "fastmath": {"contract", "reassoc", "nsz"}, "nogil": True}
COMB_TOLERANCE = 1e-9
"""Relative to the highest frequency: how evenly spaced a comb must be to be summed by a recurrence."""


def wave_numbers(frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """(f,) 2 pi f / c in rad per metre of full path, for the speed of light in air."""
    return 2 * np.pi * np.array(frequencies_hz, float) / SPEED_OF_LIGHT_AIR


def comb_step(frequencies_hz: tuple[float, ...]) -> float | None:
    """Spacing in Hz of four or more evenly spaced frequencies; None for other lists."""
    if len(frequencies_hz) < 4:
        return None
    steps = np.diff(frequencies_hz)
    even = np.abs(steps - steps.mean()).max() <= COMB_TOLERANCE * max(frequencies_hz)
    return float(steps.mean()) if even else None


def phasor_sums(amplitude: np.ndarray, path_m: np.ndarray, frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """Mean over sub-rays of a exp(i 2 pi f L / c): (f, n) complex128 from amplitudes and paths (n, m).

    A comb is summed by multiplying with the phasor of its spacing: rounding grows to 1e-14 over 100 lines.
    """
    waves = wave_numbers(frequencies_hz)
    out = np.empty((len(waves), len(path_m)), np.complex128)
    amplitude, path_m = np.ascontiguousarray(amplitude, float), np.ascontiguousarray(path_m, float)
    step = comb_step(frequencies_hz)
    if step is None:
        _sum_list(amplitude, path_m, waves, out)
    else:
        _sum_comb(amplitude, path_m, float(waves[0]), float(wave_numbers((step,))[0]), out)
    return out


@numba.njit(**FAST)
def _sum_list(amplitude: np.ndarray, path_m: np.ndarray, waves: np.ndarray, out: np.ndarray) -> None:
    n, m = path_m.shape
    for i in range(n):
        for k in range(waves.size):
            re = im = 0.0
            for j in range(m):
                phase = waves[k] * path_m[i, j]
                re += amplitude[i, j] * np.cos(phase)
                im += amplitude[i, j] * np.sin(phase)
            out[k, i] = complex(re / m, im / m)


@numba.njit(**FAST)
def _sum_comb(amplitude: np.ndarray, path_m: np.ndarray, first: float, step: float, out: np.ndarray) -> None:
    n, m = path_m.shape
    re, im, cosine, sine = np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    for i in range(n):
        for j in range(m):
            re[j] = amplitude[i, j] * np.cos(first * path_m[i, j])
            im[j] = amplitude[i, j] * np.sin(first * path_m[i, j])
            cosine[j], sine[j] = np.cos(step * path_m[i, j]), np.sin(step * path_m[i, j])
        for k in range(out.shape[0]):
            sum_re = sum_im = 0.0
            for j in range(m):
                sum_re += re[j]
                sum_im += im[j]
                turned = re[j] * cosine[j] - im[j] * sine[j]
                im[j] = re[j] * sine[j] + im[j] * cosine[j]
                re[j] = turned
            out[k, i] = complex(sum_re / m, sum_im / m)
