"""What noise leaves of a pixel after the engine's filter: its edge sum and its amplitude, with their bounds."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from scenes.sensor.amcw.light_noise import SMALLEST
from scenes.sensor.normals import FAST

DEVIATIONS = 5.5
"""What is this many deviations from a limit never meets it: 2e-8 a frame, and few pixels are just so far from one."""
NOISY = 0.35
"""Phase noise in radians above which a pixel's phase is no longer a normal about its mean."""


class Near(NamedTuple):
    """Room for a pixel's window, (k,): ``at``: flat indices of the neighbours that count, -1 of others; ``between``:
    exp(i t) of their phases less its own; ``weight`` in the filter, without noise."""

    at: np.ndarray
    between: np.ndarray
    weight: np.ndarray


class Filtered(NamedTuple):
    """Each pixel after the filter, (f, n) float64.

    ``phasor`` (complex, length 1) and ``amplitude`` in the mean, ``turned`` and ``spread``: deviations of the phase in
    radians and of the amplitude. ``left_out``: share of the phase's variance that is not of first order; infinite where
    neighbours are too noisy, or may or may not count. ``edge``, ``edge_spread``: mean and deviation of the sum over
    neighbours of (1 - cos)/2, infinite where unknown. ``edge_least``: what the mean is at least, whatever the centre's
    noise does, and ``edge_loose``, a bound of its deviation then: right at any noise.
    """

    phasor: np.ndarray
    amplitude: np.ndarray
    turned: np.ndarray
    spread: np.ndarray
    left_out: np.ndarray
    edge: np.ndarray
    edge_spread: np.ndarray
    edge_least: np.ndarray
    edge_loose: np.ndarray


def unknown_filtered(frequencies: int, n: int) -> Filtered:
    """n pixels of which nothing is known."""
    start = (1.0, 0.0, np.inf, np.inf, np.inf, np.inf, np.inf, 0.0, np.inf)
    kinds = (complex,) + (float,) * 8
    return Filtered(*(np.full((frequencies, n), value, kind) for value, kind in zip(start, kinds, strict=True)))


@numba.njit(**FAST)
def edge_of(i, light, near, out):  # type: ignore[no-untyped-def]
    """The edge sum's mean, deviation and bounds; whether a pixel of the window is too noisy for the former."""
    own = light.turn[i]
    noisy = own > NOISY
    kept = 0
    mean, variance, sines, cosines = 0.0, 0.0, 0.0, 0.0
    longest, loose = 0.0j, 0.0
    for q in range(near.at.size):
        j = near.at[q]
        if j < 0 or j == i:
            continue
        kept += 1
        turn = light.turn[j]
        noisy = noisy or turn > NOISY
        between = near.between[q]
        shrunk = 1.0 - 0.5 * (turn * turn + own * own)
        mean += 0.5 * (1.0 - between.real * max(shrunk, 0.0))
        sines += 0.5 * between.imag
        cosines += 0.25 * between.real
        variance += (0.5 * between.imag * turn) ** 2
        variance += (0.25 * between.real) ** 2 * (2.0 * turn * turn * (turn * turn + 2.0 * own * own))
        # a phase's mean resultant length is concave in 1 / turn, so its slope at 0, sqrt(pi / 8), bounds it
        longest += between * min(1.0, 0.6267 / max(turn, 1e-9))
        # of any phase (1 - cos)/2 scatters no wider than that of an even one, 1/8; of a known one by half its noise
        loose += min(0.125, 0.25 * turn * turn) if turn < NOISY else 0.125
    out.edge[i] = mean
    out.edge_spread[i] = np.sqrt(variance + (sines * own) ** 2 + 2.0 * (cosines * own * own) ** 2)
    # the centre's own noise turns it at most as far as that, and where it is large anywhere
    away = max(abs(np.angle(longest)) - DEVIATIONS * own, 0.0) if own < NOISY else 0.0
    out.edge_least[i] = 0.5 * (kept - abs(longest) * np.cos(away))
    out.edge_loose[i] = np.sqrt(loose)
    return noisy


@numba.njit(**FAST)
def amplitude_of(i, light, by_amplitude, c, near, out):  # type: ignore[no-untyped-def]
    """The filtered amplitude and its deviation; the filtered phasor where noise leaves the phases alone."""
    total = 0.0j
    weights, amplitudes, spread = 0.0, 0.0, 0.0
    for q in range(near.at.size):
        j = near.at[q]
        if j < 0:
            continue
        between = near.between[q]
        variance = 0.0 if j == i else light.turn[j] ** 2 + light.turn[i] ** 2
        curved = (c * between.imag) ** 2 - c * between.real
        weight = near.weight[q]
        mean = weight * (1.0 + 0.5 * min(variance, 0.25) * curved)
        weights += mean
        amplitudes += mean * light.bright[j]
        # noise across makes a phasor longer by what it takes of its mean
        total += mean * light.amplitude[j] * between
        spread += (mean * light.amplitude[j] * light.swell[j]) ** 2
    weights = max(weights, SMALLEST)
    out.amplitude[i] = (abs(total) if by_amplitude else amplitudes) / weights
    out.phasor[i] = total * light.phasor[i] / max(abs(total), SMALLEST)
    spread += _swaying(i, light, by_amplitude, c, near, total, out.amplitude[i])
    out.spread[i] = np.sqrt(spread) / weights


@numba.njit(**FAST)
def _swaying(i, light, by_amplitude, c, near, total, amplitude):  # type: ignore[no-untyped-def]
    """Variance of the filtered amplitude, times the weights' sum squared, by the noise of phases: it changes weights,
    and how phasors add up."""
    along = total.conjugate() / max(abs(total), SMALLEST)
    common, variance = 0.0, 0.0
    for q in range(near.at.size):
        j = near.at[q]
        if j < 0 or j == i:
            continue
        between = near.between[q]
        weight = near.weight[q]
        change = -c * between.imag * weight * (light.bright[j] - amplitude)
        if by_amplitude:
            value = weight * light.amplitude[j] * between * complex(-c * between.imag, 1.0)
            change = (along * value).real + c * between.imag * weight * amplitude
        variance += (change * min(light.turn[j], 0.5)) ** 2
        common += change
    return variance + (common * min(light.turn[i], 0.5)) ** 2
