"""The engine's filter to first order in the noise: the mean of each pixel, and its change by noise.

Before the filter, noise turns a pixel's phasor and changes its amplitude (`Light`). The filtered phasor S is a sum over
the window of s F(t), F = exp(i t - c (1 - cos t)), t = the neighbour's phase minus its own. Noise of a neighbour turns
t by a normal of variance v, so F acts as F + v F''/2 in the mean and, to first order, by its derivative F' + v F'''/2
(Stein: E[f(x) x] = E[f'(x)] E[x^2]). The centre's noise is in all differences; the mean over it is taken last, of arg
S, by three nodes. On a face with phase noise s, the centre's own noise counts for more than its weight, by some c s^2
of the window's sum, and a neighbour's for less by c s^2. Terms of second and third order are estimated."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numba
import numpy as np
from scipy import special

from scenes.sensor.amcw.kernels import FilterSettings
from scenes.sensor.normals import FAST

if TYPE_CHECKING:
    from scenes.sensor.amcw.imager import AmcwExposure

DEVIATIONS = 4.5  # a limit so far away counts as never met: 3e-6 a frame for pixels just that far off
NOISY = 0.35  # phase noise in radians above which a pixel's phase is not a normal about its mean
LITTLE = 0.004  # c s^2 below which (c s^2)^2 is negligible (phase noise of 0.033 rad); this halves the work
SMALLEST = 1e-12


class Light(NamedTuple):
    """Each pixel before the filter, all (f, n) float64. ``phasor``: of length 1. ``amplitude``: without noise;
    ``bright``: with it. ``turn``: deviation of the phase in radians. ``swell``: that of the amplitude, over it."""

    phasor: np.ndarray
    amplitude: np.ndarray
    bright: np.ndarray
    turn: np.ndarray
    swell: np.ndarray


class Near(NamedTuple):
    """A pixel's window, (k,) each. ``at``: flat indices. ``between``: exp(i t) of their phases minus its own.
    ``weight``: in the filter, without noise. ``slopes``, ``bends``: room for derivatives. ``kept``, ``others``: indices
    of the neighbours that count, with and without the centre. ``c``: the concentration that holds here."""

    space: np.ndarray
    at: np.ndarray
    between: np.ndarray
    weight: np.ndarray
    slopes: np.ndarray
    bends: np.ndarray
    kept: np.ndarray
    others: np.ndarray
    c: float


class Filtered(NamedTuple):
    """Each pixel after the filter, (f, n) float64: mean ``phasor`` (complex, length 1) and ``amplitude``; ``turned``
    and ``spread``: deviations of the phase in radians and of the amplitude. ``left_out``: share of the phase's variance
    that is not of first order; infinite if neighbours are too noisy, or if it is uncertain whether they count.
    ``edge``, ``edge_spread``: mean and deviation of the sum over neighbours of (1 - cos)/2, with those of which it is
    uncertain whether they count; infinite if unknown. ``edge_least``, ``edge_loose``: the same without those; if
    unknown, a lower bound of the mean and a bound of the deviation that hold at any noise."""

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
    """Return n pixels with unknown values."""
    start = (1.0 + 0.0j, 0.0, np.inf, np.inf, np.inf, np.inf, np.inf, 0.0, np.inf)
    return Filtered(*(np.full((frequencies, n), value) for value in start))


def light_of_samples(exposure: AmcwExposure, knee: float, gains: np.ndarray) -> Light:
    """Return the light of an exposure. Each sample has its own variance, plus step^2/12 by the converter's rounding."""
    frequencies, phases, n = exposure.means.shape
    angle = 2 * np.pi * np.arange(phases) / phases
    phasor = np.empty((frequencies, n), complex)
    size, across, along = (np.empty((frequencies, n)) for _ in range(3))
    _moments(exposure.means, exposure.sigma, knee, np.cos(angle), np.sin(angle), phasor, size, across, along)
    scale = gains.astype(float)[:, None] * 2.0 / phases
    bright = np.sqrt(size**2 + across**2)
    # the mean length of a vector plus normals of equal deviation in both directions (Rice)
    near = size < 10 * along
    deviation = np.sqrt((across[near] ** 2 + along[near] ** 2) / 2)
    x = (size[near] / np.maximum(deviation, SMALLEST)) ** 2 / 4
    bright[near] = deviation * np.sqrt(np.pi / 2) * ((1 + 2 * x) * special.ive(0, x) + 2 * x * special.ive(1, x))
    return Light(phasor, scale * size, scale * bright, across / size, along / size)


@numba.njit(**FAST)
def _moments(means, sigma, knee, cosines, sines, phasor, size, across, along):  # type: ignore[no-untyped-def]
    """Write direction and length of each pixel's phasor, and its deviations across and along that direction."""
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
            else:  # without light there is no direction: any will do
                re, im, length = 1.0, 0.0, SMALLEST
            over, beside = 0.0, 0.0
            for k in range(phases):
                # the companding converter's step at a sample, in knees
                knees, step = abs(means[f, k, i]) / knee, 1.0
                while 2.0 * step <= knees:
                    step *= 2.0
                variance = np.float64(sigma[i]) ** 2 + step * step / 12.0
                over += variance * (re * sines[k] - im * cosines[k]) ** 2
                beside += variance * (re * cosines[k] + im * sines[k]) ** 2
            phasor[f, i] = complex(re, im)
            size[f, i] = length
            across[f, i] = np.sqrt(over)
            along[f, i] = np.sqrt(beside)


def linearised(
    pixels: np.ndarray,
    light: Light,
    window: FilterSettings,
    shape: tuple[int, int],
    wild: np.ndarray,
    lost: np.ndarray,
    out: Filtered,
) -> np.ndarray:
    """Fill ``out`` at the ``pixels`` (m,) of a view of ``shape``. Return (f, m, k): the change of a pixel's phase, in
    radians, by one deviation of each neighbour's noise. ``window``: the filter, in float64. ``wild`` and ``lost`` (n,)
    bool: pixels whose samples may saturate, and those where they always do."""
    moved = np.zeros((len(light.turn), len(pixels), window.space.size))
    for f, plane in enumerate(moved):
        ours, theirs = Light(*(part[f] for part in light)), Filtered(*(part[f] for part in out))
        _linearise(pixels, ours, window, shape, wild, lost, theirs, plane)
    return moved


@numba.njit(**FAST)
def _linearise(pixels, light, window, shape, wild, lost, out, moved):  # type: ignore[no-untyped-def]
    """Do the work of `linearised` for one frequency; arrays have no first axis."""
    k, space = window.space.size, window.space.ravel()
    (at, kept, others), weight, between = np.empty((3, k), np.int64), np.empty(k), np.empty(k, np.complex128)
    room = Near(space, at, between, weight, np.empty_like(between), np.empty_like(between), kept, others, 0.0)
    for row in range(pixels.size):
        i = pixels[row]
        near, sure, rule_known = _look_around(i, light, window, shape, wild, lost, room)
        noisy, edge_known = _edge_of(i, light, window, near, out)
        _amplitude_of(i, light, window.by_amplitude, near, out)
        out.turned[i] = np.inf
        out.left_out[i] = np.inf
        if sure and rule_known and not (noisy or lost[i]):
            _moves_of(i, light, window.by_amplitude, near, out, moved[row])
            _rest_of(i, light, window.by_amplitude, near, out, moved[row])
        if lost[i] or not (sure and edge_known):
            out.edge[i] = np.inf
            out.edge_spread[i] = np.inf
        if not sure:
            out.edge_least[i] = 0.0


@numba.njit(**FAST)
def _look_around(i, light, window, shape, wild, lost, near):  # type: ignore[no-untyped-def]
    """Return the window, and whether it is certain which neighbours count and if the centre is bright."""
    h, w = shape
    side = window.space.shape[0]
    half = side // 2
    y, x = i // w, i % w
    reach = DEVIATIONS * light.amplitude[i] * light.swell[i]
    is_bright = light.amplitude[i] - reach > window.dim
    rule_known = is_bright or light.bright[i] + reach < window.dim
    sure = not wild[i] and (rule_known or not window.drop_dim)
    c, kept, others = window.concentration if is_bright else 0.0, 0, 0
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
        near.weight[q] = near.space[q] * (np.exp(c * (between.real - 1.0)) if j != i else 1.0)
        near.kept[kept], near.others[others] = q, q
        kept, others = kept + 1, others + (j != i)
    room = near.space, near.at, near.between, near.weight, near.slopes, near.bends
    return Near(*room, near.kept[:kept], near.others[:others], c), sure, rule_known


@numba.njit(**FAST)
def _edge_of(i, light, window, near, out):  # type: ignore[no-untyped-def]
    """Write the edge sum's mean, deviation and bounds. Return whether the window is too noisy for mean and deviation,
    and whether they are right: no neighbour counts, or none is too noisy."""
    own = light.turn[i]
    noisy = own > NOISY
    mean, variance, sines, cosines = 0.0, 0.0, 0.0, 0.0
    longest, loose = 0.0j, 0.0
    counted, doubtful = 0, 0
    for q in near.others:
        j, between = near.at[q], near.between[q]
        turn = light.turn[j]
        noisy = noisy or turn > NOISY
        reach = 0.0 if window.dim_edges else DEVIATIONS * light.amplitude[j] * light.swell[j]
        if not window.dim_edges and light.bright[j] + reach < window.dim:
            continue
        shrunk = 1.0 - 0.5 * (turn * turn + own * own)
        mean += 0.5 * (1.0 - between.real * max(shrunk, 0.0))
        sines += 0.5 * between.imag
        cosines += 0.25 * between.real
        variance += (0.5 * between.imag * turn) ** 2
        variance += (0.25 * between.real) ** 2 * (2.0 * turn * turn * (turn * turn + 2.0 * own * own))
        if not window.dim_edges and light.amplitude[j] - reach <= window.dim:
            doubtful += 1
            continue
        counted += 1
        # a phase's mean resultant length is concave in 1 / turn, so its slope at 0, sqrt(pi / 8), bounds it
        longest += between * min(1.0, 0.6267 / max(turn, 1e-9))
        # (1 - cos)/2 of any phase scatters no more than that of a uniform one, 1/8; of a known phase, by half its noise
        loose += min(0.125, 0.25 * turn * turn) if turn < NOISY else 0.125
    out.edge[i] = mean
    out.edge_spread[i] = np.sqrt(variance + (sines * own) ** 2 + 2.0 * (cosines * own * own) ** 2)
    known = counted + doubtful == 0 or not noisy
    # the centre's own noise turns it at most that far or, where that is large, to any angle
    away = max(abs(np.angle(longest)) - DEVIATIONS * own, 0.0) if own < NOISY else 0.0
    exact = known and doubtful == 0
    out.edge_least[i] = mean if exact else 0.5 * (counted - abs(longest) * np.cos(away))
    out.edge_loose[i] = out.edge_spread[i] if exact else np.sqrt(loose)
    return noisy, known


@numba.njit(**FAST)
def _amplitude_of(i, light, by_amplitude, near, out):  # type: ignore[no-untyped-def]
    """Write the filtered amplitude and its deviation, and the filtered phasor if noise leaves the phases unchanged."""
    total, c = 0.0j, near.c
    weights, amplitudes, spread = 0.0, 0.0, 0.0
    for q in near.kept:
        j, between = near.at[q], near.between[q]
        variance = 0.0 if j == i else light.turn[j] ** 2 + light.turn[i] ** 2
        curved = (c * between.imag) ** 2 - c * between.real
        mean = near.weight[q] * (1.0 + 0.5 * min(variance, 0.25) * curved)
        weights += mean
        amplitudes += mean * light.bright[j]
        # noise across lengthens a phasor by what it takes from its mean
        total += mean * light.amplitude[j] * between
        spread += (mean * light.amplitude[j] * light.swell[j]) ** 2
    weights = max(weights, SMALLEST)
    out.amplitude[i] = (abs(total) if by_amplitude else amplitudes) / weights
    out.phasor[i] = total * light.phasor[i] / max(abs(total), SMALLEST)
    # noise of phases changes weights and how phasors add up: its variance, times the squared sum of weights
    along = total.conjugate() / max(abs(total), SMALLEST)
    common = 0.0
    for q in near.others:
        j, between, weight = near.at[q], near.between[q], near.weight[q]
        change = -c * between.imag * weight * (light.bright[j] - out.amplitude[i])
        if by_amplitude:
            value = weight * light.amplitude[j] * between * complex(-c * between.imag, 1.0)
            change = (along * value).real + c * between.imag * weight * out.amplitude[i]
        spread += (change * min(light.turn[j], 0.5)) ** 2
        common += change
    out.spread[i] = np.sqrt(spread + (common * min(light.turn[i], 0.5)) ** 2) / weights


@numba.njit(inline="always", **FAST)
def _turned(c, between, v):  # type: ignore[no-untyped-def]
    """Return F, F' and F'' at the angle t whose exp(i t) is ``between``."""
    cosine = c * between.real
    sine = c * between.imag
    value = np.exp(cosine - c) * between
    # derivatives of ln F: g, then -cosine, sine, cosine, -sine
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
def _moves_of(i, light, by_amplitude, near, out, moved):  # type: ignore[no-untyped-def]
    """Write the mean phasor, and into ``moved`` (k,) the change of its phase by each neighbour's phase."""
    own = light.turn[i]
    little = near.c * own * own < LITTLE
    far = own if little else np.sqrt(3.0) * own
    phasor = 0.0j
    for node in range(2 if little else 3):
        away = far if node == 0 else (-far if node == 1 else 0.0)
        share = 0.5 if little else (2.0 / 3.0 if node == 2 else 1.0 / 6.0)
        turn = complex(np.cos(away), np.sin(away))
        total = 0.0j
        for q in near.kept:
            j, size = near.at[q], near.space[q]
            if by_amplitude:
                # a phasor with noise across is longer: only with that does a cos t keep its mean
                size *= light.amplitude[j] * (1.0 + 0.5 * light.turn[j] ** 2)
            if j == i:
                total += size
                continue
            value, first, second = _turned(near.c, near.between[q] * turn.conjugate(), light.turn[j] ** 2)
            total += size * value
            near.slopes[q] = size * first
            near.bends[q] = size * second
        inverse = _inverse(total)
        squares = 0.0j
        for q in near.others:
            step = near.slopes[q] * inverse * light.turn[near.at[q]]
            squares += step * step
        for q in near.others:
            # E[d arg S], with S and its derivative moving together: d^3 ln S has 2 S'^3 / S^3 and -3 S' S'' / S^2
            own_turn = light.turn[near.at[q]]
            slope = near.slopes[q] * inverse
            slope *= 1.0 + squares - near.bends[q] * inverse * own_turn**2
            moved[q] += share * slope.imag * own_turn
        # E[arg S] = arg E[S] - Im(E[dS^2] / S^2) / 2
        phasor += share * total * abs(inverse) * turn * complex(1.0, -0.5 * squares.imag)
    out.phasor[i] = phasor * light.phasor[i] / max(abs(phasor), SMALLEST)


@numba.njit(**FAST)
def _rest_of(i, light, by_amplitude, near, out, moved):  # type: ignore[no-untyped-def]
    """Write the phase's deviation, and the share of its variance that is not of first order in phases."""
    own2, c, values = light.turn[i] * light.turn[i], near.c, near.slopes
    total = 0.0j
    for q in near.kept:
        values[q] = near.weight[q] * (light.amplitude[near.at[q]] if by_amplitude else 1.0) * near.between[q]
        total += values[q]
    inverse = _inverse(total)
    common, bends, rest, variance = 0.0, 0.0, 0.0, 0.0
    for q in near.others:
        j, value = near.at[q], values[q] * inverse
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
    # terms of higher order depend most on the centre, which is in all differences
    centre2 = (1.0 - common) * (1.0 - common) * own2 + rest
    moved[near.at.size // 2] = np.sqrt(centre2)
    out.turned[i] = np.sqrt(variance + centre2)
    if by_amplitude:
        # noise across a mean phasor lengthens it
        out.amplitude[i] *= 1.0 + 0.5 * (variance + centre2)
    out.left_out[i] = rest / max(variance + centre2, SMALLEST)


@numba.njit(inline="always", **FAST)
def _inverse(z):  # type: ignore[no-untyped-def]
    """Return 1 / z, 0 where z is 0."""
    return z.conjugate() / max(z.real * z.real + z.imag * z.imag, SMALLEST**2)
