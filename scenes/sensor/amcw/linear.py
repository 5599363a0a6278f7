"""The engine's filter to first order in the noise: what each pixel gives in the mean, and how far noise moves it.

A pixel's filtered phasor S is a sum over its window of s F(t), F = exp(i t - c (1 - cos t)), t = the neighbour's phase
less its own. Noise of a neighbour turns t by a normal of variance v, so F acts as F + v F''/2 in the mean and, to first
order, by its derivative F' + v F'''/2 (Stein: E[f(x) x] = E[f'(x)] E[x^2]). The centre's noise is in all differences:
over it the mean is taken last, of arg S, by three nodes. On a face of phase noise s the centre's own noise so counts
more than by its weight, by some c s^2 of the window's sum, and a neighbour's less by c s^2.
What is left out, of second and third order, is estimated beside it; a pixel where it counts is not for this module.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from scenes.sensor.amcw.filtered import DEVIATIONS, Filtered, Near, amplitude_of, edge_of
from scenes.sensor.amcw.light_noise import SMALLEST, Light
from scenes.sensor.normals import FAST

LITTLE = 0.004
"""c s^2 below which (c s^2)^2 does not matter (phase noise of 0.033 rad): half the work."""


class Window(NamedTuple):
    """The filter, as `kernels.joint_bilateral` has it; ``flat`` (k,): its ``space``, row by row."""

    space: np.ndarray
    flat: np.ndarray
    concentration: float
    dim: float
    drop_dim: bool
    by_amplitude: bool


def linearised(
    pixels: np.ndarray,
    light: Light,
    window: Window,
    shape: tuple[int, int],
    wild: np.ndarray,
    lost: np.ndarray,
    out: Filtered,
) -> np.ndarray:
    """Fill ``out`` at the ``pixels`` (m,) of a view of ``shape``; (f, m, k): by how many radians one deviation of each
    neighbour's noise moves a pixel's phase.

    ``wild`` and ``lost`` (n,) bool: pixels whose samples may saturate, and those where they always do. A neighbour's
    phase and amplitude are independent, so what both do is put together in squares.
    """
    moved = np.zeros((len(light.turn), len(pixels), window.space.size))
    for f, plane in enumerate(moved):
        ours, theirs = Light(*(part[f] for part in light)), Filtered(*(part[f] for part in out))
        _linearise(pixels, ours, window, shape, wild, lost, theirs, plane)
    return moved


@numba.njit(inline="always", **FAST)
def _turned(c, between, v):  # type: ignore[no-untyped-def]
    """F, F' and F'' at an angle whose exp(i t) is ``between``, in the mean over a normal of the angle of variance v:
    the first two to v^2."""
    cosine = c * between.real
    sine = c * between.imag
    value = np.exp(cosine - c) * between
    # of ln F: g, and its derivatives -cosine, sine, cosine, -sine
    g = complex(-sine, 1.0)
    g2 = g * g
    second = g2 - cosine
    third = g * (g2 - 3.0 * cosine) + sine
    if c * v < LITTLE:
        return value * (1.0 + 0.5 * v * second), value * (g + 0.5 * v * third), value * second
    fourth = g2 * (g2 - 6.0 * cosine) + 4.0 * g * sine + 3.0 * cosine * cosine + cosine
    fifth = g * (g2 * (g2 - 10.0 * cosine) + 15.0 * cosine * cosine + 5.0 * cosine)
    fifth += 10.0 * sine * (g2 - cosine) - sine
    mean = value * (1.0 + 0.5 * v * (second + 0.25 * v * fourth))
    first = value * (g + 0.5 * v * (third + 0.25 * v * fifth))
    return mean, first, value * (second + 0.5 * v * fourth)


@numba.njit(**FAST)
def _look_around(i, light, window, shape, wild, lost, near):  # type: ignore[no-untyped-def]
    """Fill ``near``; whether it is sure which neighbours count, whether it is sure if the centre is bright, and the
    concentration that then holds."""
    h, w = shape
    side = window.space.shape[0]
    half = side // 2
    y, x = i // w, i % w
    reach = DEVIATIONS * light.amplitude[i] * light.swell[i]
    is_bright = light.amplitude[i] - reach > window.dim
    rule_known = is_bright or light.bright[i] + reach < window.dim
    sure = not wild[i] and (rule_known or not window.drop_dim)
    c = window.concentration if is_bright else 0.0
    for q in range(side * side):
        near.at[q] = -1
        v, u = y + q // side - half, x + q % side - half
        if v < 0 or v >= h or u < 0 or u >= w:
            continue
        j = v * w + u
        sure = sure and not wild[j]
        if lost[j]:
            continue
        if window.drop_dim and is_bright and j != i:
            reach = DEVIATIONS * light.amplitude[j] * light.swell[j]
            if light.bright[j] + reach < window.dim:
                continue
            sure = sure and light.amplitude[j] - reach > window.dim
        between = light.phasor[j] * light.phasor[i].conjugate()
        near.at[q] = j
        near.between[q] = between
        near.weight[q] = window.flat[q] * (np.exp(c * (between.real - 1.0)) if j != i else 1.0)
    return sure, rule_known, c


@numba.njit(**FAST)
def _linearise(pixels, light, window, shape, wild, lost, out, moved):  # type: ignore[no-untyped-def]
    """`linearised` for one frequency: all without their first axis."""
    k = window.flat.size
    near = Near(np.empty(k, np.int64), np.empty(k, np.complex128), np.empty(k))
    slopes, bends = np.empty(k, np.complex128), np.empty(k, np.complex128)
    for row in range(pixels.size):
        i = pixels[row]
        sure, rule_known, c = _look_around(i, light, window, shape, wild, lost, near)
        noisy = edge_of(i, light, near, out)
        amplitude_of(i, light, window.by_amplitude, c, near, out)
        known = sure and rule_known and not (noisy or lost[i])
        out.turned[i] = np.inf
        out.left_out[i] = np.inf
        if known:
            _moves_of(i, light, window, c, near, slopes, bends, out, moved[row])
            _rest_of(i, light, window.by_amplitude, c, near, slopes, out, moved[row])
        if lost[i] or noisy or not sure:
            out.edge[i] = np.inf
            out.edge_spread[i] = np.inf
        if not sure:
            out.edge_least[i] = 0.0


@numba.njit(**FAST)
def _moves_of(i, light, window, c, near, slopes, bends, out, moved):  # type: ignore[no-untyped-def]
    """The mean phasor, and into ``moved`` (k,) how far each neighbour's phase moves its.

    The centre's noise is in all differences, so the mean is taken over it last, by Gauss and Hermite's three nodes, of
    little noise by two.
    """
    own = light.turn[i]
    little = c * own * own < LITTLE
    far = own if little else np.sqrt(3.0) * own
    phasor = 0.0j
    for node in range(2 if little else 3):
        away = far if node == 0 else (-far if node == 1 else 0.0)
        share = 0.5 if little else (2.0 / 3.0 if node == 2 else 1.0 / 6.0)
        turn = complex(np.cos(away), np.sin(away))
        total = 0.0j
        for q in range(near.at.size):
            j = near.at[q]
            if j < 0:
                continue
            size = window.flat[q]
            if window.by_amplitude:
                # a phasor with noise across is longer: a cos t keeps its mean only with that
                size *= light.amplitude[j] * (1.0 + 0.5 * light.turn[j] ** 2)
            if j == i:
                total += size
                continue
            value, first, second = _turned(c, near.between[q] * turn.conjugate(), light.turn[j] ** 2)
            total += size * value
            slopes[q] = size * first
            bends[q] = size * second
        inverse = _inverse(total)
        squares = 0.0j
        for q in range(near.at.size):
            j = near.at[q]
            if j >= 0 and j != i:
                step = slopes[q] * inverse * light.turn[j]
                squares += step * step
        for q in range(near.at.size):
            j = near.at[q]
            if j < 0 or j == i:
                continue
            # E[d arg S], S and its derivative moving together: d^3 ln S has 2 S'^3 / S^3 and -3 S' S'' / S^2
            slope = slopes[q] * inverse
            slope *= 1.0 + squares - bends[q] * inverse * light.turn[j] ** 2
            moved[q] += share * slope.imag * light.turn[j]
        # E[arg S] = arg E[S] - Im(E[dS^2] / S^2) / 2
        phasor += share * total * abs(inverse) * turn * complex(1.0, -0.5 * squares.imag)
    out.phasor[i] = phasor * light.phasor[i] / max(abs(phasor), SMALLEST)


@numba.njit(**FAST)
def _rest_of(i, light, by_amplitude, c, near, values, out, moved):  # type: ignore[no-untyped-def]
    """The phase's deviation, and the share of its variance that is not of first order in phases; puts what the centre
    and amplitudes do into ``moved``. ``values`` (k,) is room."""
    own2 = light.turn[i] * light.turn[i]
    total = 0.0j
    for q in range(near.at.size):
        j = near.at[q]
        if j >= 0:
            values[q] = near.weight[q] * (light.amplitude[j] if by_amplitude else 1.0) * near.between[q]
            total += values[q]
    inverse = _inverse(total)
    common, bends, rest, variance = 0.0, 0.0, 0.0, 0.0
    for q in range(near.at.size):
        j = near.at[q]
        if j < 0 or j == i:
            continue
        value = values[q] * inverse
        turn2 = light.turn[j] * light.turn[j]
        cosine, g = c * near.between[q].real, complex(-c * near.between[q].imag, 1.0)
        bend = (value * (g * g - cosine)).imag
        third = (value * (g * (g * g - 3.0 * cosine) - g.real)).imag
        bends += bend
        rest += bend * bend * turn2 * (0.5 * turn2 + own2)
        rest += third * third * turn2 * turn2 * (turn2 + 3.0 * own2) / 6.0
        common += moved[q] / max(light.turn[j], SMALLEST)
        if by_amplitude:
            swollen = value.imag * light.swell[j]
            moved[q] = np.copysign(np.sqrt(moved[q] * moved[q] + swollen * swollen), moved[q])
        variance += moved[q] * moved[q]
    rest += 0.5 * bends * bends * own2 * own2
    # what is of higher order hangs on the centre most, being in all differences
    centre2 = (1.0 - common) * (1.0 - common) * own2 + rest
    moved[near.at.size // 2] = np.sqrt(centre2)
    out.turned[i] = np.sqrt(variance + centre2)
    if by_amplitude:
        # noise across a mean phasor makes it longer
        out.amplitude[i] *= 1.0 + 0.5 * (variance + centre2)
    out.left_out[i] = rest / max(variance + centre2, SMALLEST)


@numba.njit(inline="always", **FAST)
def _inverse(z):  # type: ignore[no-untyped-def]
    """1 / z, 0 where z is."""
    return z.conjugate() / max(z.real * z.real + z.imag * z.imag, SMALLEST**2)
