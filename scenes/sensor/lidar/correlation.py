"""The correlation of a return with the transmitted code: from its spectrum to its two strongest peaks.

A code of period T correlates to a pulse that repeats with T, so its spectrum stands on the lines k / T. The view's
phasors on that comb are the spectrum H of all paths of light within a beam, hence with weights W of the pulse
c(t) = sum_k W_k Re(H_k exp(-2 pi i k t / T)) / sum_k W_k, whose single return of light a is a pulse of height a.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from scenes.sensor.normals import IN_DOUBLE

SAMPLES_PER_LINE = 4
"""Samples of the correlation in a period, per spectral line; two would just hold it, four miss no peak."""
NEWTON_STEPS = 4
"""Steps from a sample's parabola: three converge to 1e-7 of a sample even where two pulses are about to part."""
NO_PEAK = -1e9
"""Stand-in for the height of a peak that does not exist."""


@dataclass(frozen=True)
class Peaks:
    """The two strongest peaks of n correlations, the stronger first; all (2, n) float64.

    ``delay``: in periods, 0..1. ``height``: as the correlation's, `NO_PEAK` where there is none.
    ``curvature``: minus the second derivative by angle 2 pi t / T at the peak, over the height's unit.
    """

    delay: np.ndarray
    height: np.ndarray
    curvature: np.ndarray


def strongest_peaks(phasor: np.ndarray, weights: np.ndarray) -> Peaks:
    """Find peaks of correlations with phasors (K, n) on lines 1..K of the comb and the pulse's ``weights`` (K,)."""
    lines, n = phasor.shape
    spectrum = np.empty((n, 2 * lines), np.float32)
    scaled = (phasor * (weights / weights.sum())[:, None].astype(np.float32)).T
    spectrum[:, :lines] = scaled.real
    spectrum[:, lines:] = scaled.imag
    # cosines and sines of the lines at the samples of one period, (2 K, M)
    samples = SAMPLES_PER_LINE * lines
    angle = 2 * np.pi * np.outer(np.arange(1, lines + 1), np.arange(samples)) / samples
    waves = np.concatenate([np.cos(angle), np.sin(angle)]).astype(np.float32)
    out = np.empty((3, 2, n))
    _peaks(spectrum @ waves, spectrum, *out)
    return Peaks(*out)


@numba.njit(**IN_DOUBLE)
def _derivatives(spectrum: np.ndarray, angle: float) -> tuple[float, float, float]:
    """Return the correlation with ``spectrum`` (2 K,) at an angle, its first and its second derivative by angle."""
    lines = spectrum.size // 2
    step_re, step_im = np.cos(angle), np.sin(angle)
    re, im = 1.0, 0.0
    value, slope, bend = 0.0, 0.0, 0.0
    for k in range(lines):
        re, im = re * step_re - im * step_im, re * step_im + im * step_re
        a, b = spectrum[k], spectrum[lines + k]
        even = a * re + b * im
        order = k + 1.0
        value += even
        slope += order * (b * re - a * im)
        bend -= order * order * even
    return value, slope, bend


@numba.njit(**IN_DOUBLE)
def _refined(spectrum: np.ndarray, start: float, spacing: float) -> tuple[float, float, float]:
    """Return (angle, height, curvature) of the peak beside the sample at ``start``, within one sample of it."""
    angle = start
    for _ in range(NEWTON_STEPS):
        _, slope, bend = _derivatives(spectrum, angle)
        # where two pulses merge the curve may be hollow beside its peak: then climb by half a sample
        step = -slope / bend if bend < 0.0 else np.sign(slope) * 0.5 * spacing
        angle = min(max(angle + step, start - spacing), start + spacing)
    value, _, bend = _derivatives(spectrum, angle)
    return angle, value, -bend


@numba.njit(**IN_DOUBLE)
def _peaks(
    samples: np.ndarray, spectrum: np.ndarray, delay: np.ndarray, height: np.ndarray, curvature: np.ndarray
) -> None:
    """Find peaks among ``samples`` (n, M) and refine them on ``spectrum`` (n, 2 K); outputs (2, n)."""
    n, m = samples.shape
    spacing = 2.0 * np.pi / m
    for i in range(n):
        row = samples[i]
        first, second = -1, -1
        for j in range(m):
            y = row[j]
            if y > 0.0 and y > row[j - 1] and y >= row[j + 1 if j + 1 < m else 0]:
                if first < 0 or y > row[first]:
                    first, second = j, first
                elif second < 0 or y > row[second]:
                    second = j
        for rank in range(2):
            at = first if rank == 0 else second
            angle, top, bend = 0.0, NO_PEAK, 1.0
            if at >= 0:
                angle, top, bend = _refined(spectrum[i], at * spacing, spacing)
            delay[rank, i] = (angle / (2.0 * np.pi)) % 1.0
            height[rank, i] = top
            curvature[rank, i] = bend
        if height[1, i] > height[0, i]:
            for out in (delay, height, curvature):
                out[0, i], out[1, i] = out[1, i], out[0, i]
