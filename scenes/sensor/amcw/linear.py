"""The engine's filter to first order in the noise: the mean of each pixel, and its change by
noise.

Before the filter, noise turns a pixel's phasor and changes its amplitude (`Light`). The filtered
phasor S is a sum over the window of s F(t), F = exp(i t - c (1 - cos t)), t = the neighbour's
phase minus its own. Noise of a neighbour turns t by a normal of variance v, so F acts as F + v
F''/2 in the mean and, to first order, by its derivative F' + v F'''/2 (Stein: E[f(x) x] = E[f'(x)]
E[x^2]). The centre's noise is in all differences; the mean over it is taken last, of arg S, by
three nodes. On a face with phase noise s, the centre's own noise counts for more than its weight,
by some c s^2 of the window's sum, and a neighbour's for less by c s^2. Terms of second and third
order are estimated."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numba
import numpy as np
from scipy import special

from scenes.sensor.amcw.kernels import FilterSettings
from scenes.sensor.normals import FAST

if TYPE_CHECKING:
    from scenes.sensor.amcw.imager import AmcwExposure

DEVIATIONS = (
    4.5  # a limit so far away counts as never met: 3e-6 a frame for pixels just that far off
)
NOISY = 0.35  # phase noise in radians above which a pixel's phase is not a normal about its mean
SMALLEST = 1e-12
# limit of the phase noise in radians, which would be too large for float32 where there is no light
MOST_TURN = 1e3
f4 = np.float32
LEAST = f4(SMALLEST)
REACH = f4(DEVIATIONS)
SQRT_3 = f4(np.sqrt(3.0))
ZERO = f4(0)
QUARTER = f4(0.25)
HALF = f4(0.5)
ONE = f4(1)
TWO = f4(2)
THREE = f4(3)
FOUR = f4(4)
FIVE = f4(5)
SIX = f4(6)
TEN = f4(10)


class Light(NamedTuple):
    """Each pixel before the filter, all (f, n) float32. ``phasor``: complex, of length 1.
    ``amplitude``: without noise; ``bright``: with it. ``turn``: deviation of the phase in radians.
    ``swell``: that of the amplitude, over it."""

    phasor: np.ndarray
    amplitude: np.ndarray
    bright: np.ndarray
    turn: np.ndarray
    swell: np.ndarray


class Filtered(NamedTuple):
    """Each pixel after the filter, (f, n) float32: mean ``phasor`` (complex, length 1) and
    ``amplitude``; ``turned`` and ``spread``: deviations of the phase in radians and of the
    amplitude. ``left_out``: share of the phase's variance that is not of first order; infinite if
    neighbours are too noisy, or if it is uncertain whether they count. ``edge``, ``edge_spread``:
    mean and deviation of the sum over neighbours of (1 - cos)/2, with those of which it is
    uncertain whether they count; infinite if unknown. ``edge_least``, ``edge_loose``: the same
    without those; if unknown, a lower bound of the mean and a bound of the deviation that hold at
    any noise."""

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
    shape = (frequencies, n)
    start = (0.0, np.inf, np.inf, np.inf, np.inf, np.inf, 0.0, np.inf)
    return Filtered(np.ones(shape, np.complex64), *(np.full(shape, value, f4) for value in start))


LENGTHS = np.linspace(0.0, 15.0, 1501)
RICE = np.sqrt(np.pi / 2) * (
    (1 + LENGTHS**2 / 2) * special.ive(0, LENGTHS**2 / 4)
    + LENGTHS**2 / 2 * special.ive(1, LENGTHS**2 / 4)
)
"""Mean length, by Rice, of a vector of `LENGTHS` plus normals of deviation 1 both ways; 1e-5
between them."""
ABREAST = 32  # pixels that a loop does side by side, in vector registers
W = np.uint64(ABREAST)
BETWEEN = W * np.uint64(0)
AMPLITUDE = W * np.uint64(2)
BRIGHT = W * np.uint64(3)
TURN = W * np.uint64(4)
SWAY = W * np.uint64(5)
SIZE = W * np.uint64(6)
WEIGHT = W * np.uint64(7)
SLOPE = W * np.uint64(8)
BEND = W * np.uint64(10)
MOVED = W * np.uint64(12)
FIELDS = W * np.uint64(13)
"""Places of a neighbour's values in the room of `_linearise`, each for `ABREAST` pixels, an
imaginary part `W` behind its real part. exp(i t) of the neighbour's phase minus the centre's; its
`Light`, and its amplitude's deviation; its weight by distance, 0 if it does not count, and its
weight in the filter; its part in the sum, differentiated by its phase once and twice; the change
of the sum's phase."""
C, LIT, SURE, NOISE, FIT, *ROWS_LEFT = (W * np.uint64(row) for row in range(16))
ROWS = tuple(ROWS_LEFT)
"""Places of a pixel's values: the concentration, 0 if the centre is dim; whether the centre is
bright; whether it is certain which neighbours count; the largest phase noise; whether the linear
model holds; and room for sums."""


def light_of_samples(exposure: AmcwExposure, knee: float, gains: np.ndarray) -> Light:
    """Return the light of an exposure. Each sample has its own variance, plus step^2/12 by the
    converter's rounding."""
    phases = exposure.means.shape[1]
    angle = 2 * np.pi * np.arange(phases)[:, None] / phases
    cosines = np.cos(angle).astype(f4)
    sines = np.sin(angle).astype(f4)
    shape = (len(gains), exposure.sigma.size)
    light = Light(np.empty(shape, np.complex64), *(np.empty(shape, f4) for _ in range(4)))
    for f, means in enumerate(exposure.means):
        # the companding converter's step at a sample, in knees: its bits without the mantissa
        step = np.maximum(
            (np.abs(means / f4(knee)).view(np.uint32) & np.uint32(0x7F800000)).view(f4), ONE
        )
        variance = exposure.sigma**2 + step**2 / 12
        # direction and length of the phasor; without light there is no direction: any will do
        re = (means * cosines).sum(axis=0)
        im = (means * sines).sum(axis=0)
        size = np.maximum(np.sqrt(re * re + im * im), LEAST)
        re = np.where(size > LEAST, re / size, ONE)
        im = np.where(size > LEAST, im / size, ZERO)
        light.phasor[f].real, light.phasor[f].imag = re, im
        light.amplitude[f] = gains[f] * f4(2 / phases) * size
        # deviations across and along that direction
        light.turn[f] = np.sqrt((variance * (re * sines - im * cosines) ** 2).sum(axis=0)) / size
        light.swell[f] = np.sqrt((variance * (re * cosines + im * sines) ** 2).sum(axis=0)) / size
    light.bright[:] = light.amplitude * np.sqrt(ONE + light.turn**2)
    near = light.swell > 0.1
    deviation = light.amplitude[near] * np.sqrt(
        (light.turn[near] ** 2 + light.swell[near] ** 2) / 2
    )
    light.bright[near] = deviation * np.interp(
        light.amplitude[near] / np.maximum(deviation, SMALLEST), LENGTHS, RICE
    )
    return light


def linearised(
    pixels: np.ndarray,
    light: Light,
    window: FilterSettings,
    shape: tuple[int, int],
    lost: np.ndarray,
    out: Filtered,
) -> np.ndarray:
    """Fill ``out`` at the ``pixels`` (m,) of a view of ``shape``. None of them is ``lost`` (n,)
    bool: always saturated. Return (f, m, k) float32: the change of a pixel's phase, in radians, by
    one deviation of each neighbour's noise."""
    moved = np.zeros((len(light.turn), len(pixels), window.space.size), f4)
    for f, plane in enumerate(moved):
        ours = Light(*(part[f] for part in light))
        theirs = Filtered(*(part[f] for part in out))
        _linearise(pixels, ours, window, shape, lost, theirs, plane)
    return moved


@numba.njit(**FAST)
def _linearise(pixels, light, window, shape, lost, out, moved):  # type: ignore[no-untyped-def]
    """Do the work of `linearised` for one frequency; arrays have no first axis."""
    k = window.space.size
    of_pixels = np.empty(ABREAST, np.int64)
    by_amplitude = window.by_amplitude
    room = np.empty(np.uint64(k) * FIELDS, f4)
    sums = np.empty(ROWS[-1] + W, f4)
    middle = np.uint64(k // 2) * FIELDS
    others = np.array([np.uint64(q) * FIELDS for q in range(k) if q != k // 2], np.uint64)
    for start in range(0, pixels.size, ABREAST):
        # the last loop may have fewer pixels: it repeats the last one
        at = of_pixels[: min(ABREAST, pixels.size - start)]
        for x in range(ABREAST):
            of_pixels[x] = pixels[min(start + x, pixels.size - 1)]
        _gather(of_pixels, light, window.space, shape, lost, room)
        _look_around(window, middle, others, room, sums)
        _edge_of(at, window, middle, others, room, sums, out)
        _amplitude_of(at, light.phasor, by_amplitude, middle, others, room, sums, out)
        if sums[FIT : FIT + W].max() > ZERO:
            _moves_of(at, light.phasor, by_amplitude, middle, others, room, sums, out)
            _rest_of(
                at, by_amplitude, middle, others, room, sums, out, moved[start : start + ABREAST]
            )


@numba.njit(**FAST)
def _gather(at, light, space, shape, lost, room):  # type: ignore[no-untyped-def]
    """Fill the room with the windows of pixels ``at`` (`ABREAST`,)."""
    (h, w), side = shape, space.shape[0]
    half = side // 2
    for x in range(at.size):
        i = at[x]
        place = np.uint64(x)
        top = i // w - half
        left = i % w - half
        for dy in range(side):
            for dx in range(side):
                row = top + dy
                column = left + dx
                inside = (row >= 0) & (row < h) & (column >= 0) & (column < w)
                j = row * w + column if inside else i
                between = light.phasor[j] * light.phasor[i].conjugate()
                room[place + BETWEEN] = between.real
                room[place + BETWEEN + W] = between.imag
                room[place + AMPLITUDE] = light.amplitude[j]
                room[place + BRIGHT] = light.bright[j]
                room[place + TURN] = min(light.turn[j], MOST_TURN)
                room[place + SWAY] = light.amplitude[j] * light.swell[j]
                room[place + SIZE] = space[dy, dx] if inside and not lost[j] else ZERO
                room[place + MOVED] = ZERO
                place += FIELDS


@numba.njit(**FAST)
def _look_around(window, middle, others, room, sums):  # type: ignore[no-untyped-def]
    """Find which neighbours count, their weights, whether that is certain (`SURE`), and whether
    the linear model holds (`FIT`): certain, and not too noisy."""
    dim = window.dim
    drop_dim = window.drop_dim
    for x in range(W):
        reach = REACH * room[middle + SWAY + x]
        amplitude = room[middle + AMPLITUDE + x]
        lit = amplitude - reach > dim
        known = lit | (room[middle + BRIGHT + x] + reach < dim)
        sums[LIT + x] = ONE if lit else ZERO
        sums[C + x] = window.concentration if lit else ZERO
        sums[SURE + x] = ONE if known | (not drop_dim) else ZERO
        sums[NOISE + x] = room[middle + TURN + x]
        sums[FIT + x] = ONE if known else ZERO
        room[middle + WEIGHT + x] = room[middle + SIZE + x]
    for place in others:
        for x in range(W):
            reach = REACH * room[place + SWAY + x]
            size = room[place + SIZE + x]
            if drop_dim:
                lit = sums[LIT + x] > ZERO
                size = ZERO if lit & (room[place + BRIGHT + x] + reach < dim) else size
                doubtful = lit & (size > ZERO) & (room[place + AMPLITUDE + x] - reach <= dim)
                sums[SURE + x] = ZERO if doubtful else sums[SURE + x]
                room[place + SIZE + x] = size
            room[place + WEIGHT + x] = size * _exp(sums[C + x] * (room[place + BETWEEN + x] - ONE))
            sums[NOISE + x] = max(sums[NOISE + x], room[place + TURN + x] if size > ZERO else ZERO)
    for x in range(W):
        sums[FIT + x] = sums[FIT + x] * sums[SURE + x] if sums[NOISE + x] <= f4(NOISY) else ZERO


@numba.njit(inline="always", **FAST)
def _exp(x):  # type: ignore[no-untyped-def]
    """Return the exponential of -8 <= x <= 0, to 2e-5 of its value: the sixteenth power of a
    series."""
    t = x * f4(1 / 16)
    e = ONE + t * (
        ONE + t * (HALF + t * (f4(1 / 6) + t * (f4(1 / 24) + t * (f4(1 / 120) + t * f4(1 / 720)))))
    )
    e = e * e
    e = e * e
    e = e * e
    return e * e


@numba.njit(**FAST)
def _edge_of(at, window, middle, others, room, sums, out):  # type: ignore[no-untyped-def]
    """Write the edge sum's mean, deviation and bounds."""
    dim = window.dim
    dim_edges = window.dim_edges
    mean, variance, sines, cosines, loose, counted, doubtful, longest = ROWS[:8]
    sums[mean : longest + W + W] = ZERO
    for place in others:
        for x in range(W):
            turn = room[place + TURN + x]
            own = room[middle + TURN + x]
            re = room[place + BETWEEN + x]
            im = room[place + BETWEEN + W + x]
            reach = REACH * room[place + SWAY + x]
            counts = (room[place + SIZE + x] > ZERO) & (
                dim_edges | (room[place + BRIGHT + x] + reach >= dim)
            )
            certain = counts & (dim_edges | (room[place + AMPLITUDE + x] - reach > dim))
            one = ONE if counts else ZERO
            sure = ONE if certain else ZERO
            turn2 = turn * turn
            own2 = own * own
            sums[mean + x] += one * HALF * (ONE - re * max(ONE - HALF * (turn2 + own2), ZERO))
            sums[sines + x] += one * HALF * im
            sums[cosines + x] += one * QUARTER * re
            across = HALF * im * turn
            along = QUARTER * re
            sums[variance + x] += one * (
                across * across + along * along * TWO * turn2 * (turn2 + TWO * own2)
            )
            sums[doubtful + x] += one - sure
            sums[counted + x] += sure
            # a phase's mean resultant length is concave in 1 / turn, so its slope at 0, sqrt(pi /
            # 8), bounds it
            length = sure * min(ONE, f4(0.6267) / max(turn, f4(1e-9)))
            sums[longest + x] += re * length
            sums[longest + W + x] += im * length
            # (1 - cos)/2 of any phase scatters no more than that of a uniform one, 1/8; of a known
            # phase, by half its noise
            sums[loose + x] += sure * (QUARTER * turn2 if turn < f4(NOISY) else f4(0.125))
    for x in range(at.size):
        i = at[x]
        own = room[middle + TURN + x]
        doubt = sums[doubtful + x]
        spread = np.sqrt(
            sums[variance + x]
            + (sums[sines + x] * own) ** 2
            + 2.0 * (sums[cosines + x] * own * own) ** 2
        )
        # ``edge`` and its deviation are right if no neighbour counts, or none is too noisy
        known = sums[counted + x] + doubt == 0 or sums[NOISE + x] <= NOISY
        sure = sums[SURE + x] > 0
        out.edge[i] = sums[mean + x] if known and sure else np.inf
        out.edge_spread[i] = spread if known and sure else np.inf
        if known and doubt == 0:
            out.edge_least[i], out.edge_loose[i] = sums[mean + x], spread
        else:
            # the centre's own noise turns it at most that far or, where that is large, to any
            # angle
            re = sums[longest + x]
            im = sums[longest + W + x]
            away = max(abs(np.arctan2(im, re)) - DEVIATIONS * own, 0.0) if own < NOISY else 0.0
            out.edge_least[i] = 0.5 * (
                sums[counted + x] - np.sqrt(re * re + im * im) * np.cos(away)
            )
            out.edge_loose[i] = np.sqrt(sums[loose + x])
        if not sure:
            out.edge_least[i] = 0.0


@numba.njit(**FAST)
def _amplitude_of(at, phasor, by_amplitude, middle, others, room, sums, out):  # type: ignore[no-untyped-def]
    """Write the filtered amplitude and its deviation, and the filtered phasor if noise leaves the
    phases unchanged."""
    weights, amplitudes, spread, common, size, total = ROWS[:6]
    for x in range(W):
        weight = room[middle + WEIGHT + x]
        sums[weights + x], sums[amplitudes + x] = weight, weight * room[middle + BRIGHT + x]
        sums[spread + x], sums[common + x] = (weight * room[middle + SWAY + x]) ** 2, ZERO
        _put(sums, total + x, complex(weight * room[middle + AMPLITUDE + x], ZERO))
    for place in others:
        for x in range(W):
            c = sums[C + x]
            turn = room[place + TURN + x]
            own = room[middle + TURN + x]
            re = room[place + BETWEEN + x]
            im = room[place + BETWEEN + W + x]
            variance = min(turn * turn + own * own, QUARTER)
            mean = room[place + WEIGHT + x] * (ONE + HALF * variance * (c * im * c * im - c * re))
            sums[weights + x] += mean
            sums[amplitudes + x] += mean * room[place + BRIGHT + x]
            # noise across lengthens a phasor by what it takes from its mean
            sums[total + x] += mean * room[place + AMPLITUDE + x] * re
            sums[total + W + x] += mean * room[place + AMPLITUDE + x] * im
            sums[spread + x] += (mean * room[place + SWAY + x]) ** 2
    for x in range(W):
        length = np.sqrt(_power(_at(sums, total + x)))
        whole = max(sums[weights + x], LEAST)
        sums[size + x], sums[weights + x] = max(length, LEAST), whole
        sums[amplitudes + x] = (length if by_amplitude else sums[amplitudes + x]) / whole
    # noise of phases changes weights and how phasors add up: its variance, times the squared sum
    # of weights
    for place in others:
        for x in range(W):
            re = room[place + BETWEEN + x]
            im = room[place + BETWEEN + W + x]
            weight = room[place + WEIGHT + x]
            slope = sums[C + x] * im
            amplitude = sums[amplitudes + x]
            if by_amplitude:
                along = sums[total + W + x] * (re - slope * im) - sums[total + x] * (
                    slope * re + im
                )
                change = weight * (
                    room[place + AMPLITUDE + x] * along / sums[size + x] + slope * amplitude
                )
            else:
                change = slope * weight * (amplitude - room[place + BRIGHT + x])
            sums[spread + x] += (change * min(room[place + TURN + x], HALF)) ** 2
            sums[common + x] += change
    for x in range(at.size):
        i = at[x]
        own = sums[common + x] * min(room[middle + TURN + x], HALF)
        out.amplitude[i] = sums[amplitudes + x]
        out.phasor[i] = _at(sums, total + x) * phasor[i] / sums[size + x]
        out.spread[i] = np.sqrt(sums[spread + x] + own * own) / sums[weights + x]


@numba.njit(inline="always", **FAST)
def _at(values, place):  # type: ignore[no-untyped-def]
    return complex(values[place], values[place + W])


@numba.njit(inline="always", **FAST)
def _put(values, place, z):  # type: ignore[no-untyped-def]
    values[place], values[place + W] = z.real, z.imag


@numba.njit(inline="always", **FAST)
def _power(z):  # type: ignore[no-untyped-def]
    return z.real * z.real + z.imag * z.imag


@numba.njit(inline="always", **FAST)
def _inverse(z):  # type: ignore[no-untyped-def]
    """Return 1 / z, 0 where z is 0."""
    size = ONE / max(_power(z), LEAST * LEAST)
    return complex(z.real * size, -z.imag * size)


@numba.njit(inline="always", **FAST)
def _turned(c, between, v):  # type: ignore[no-untyped-def]
    """Return F, F' and F'' at the angle t whose exp(i t) is ``between``."""
    cosine = c * between.real
    sine = c * between.imag
    # derivatives of ln F: g, then -cosine, sine, cosine, -sine
    g = complex(-sine, ONE)
    g2 = complex(sine * sine - ONE, -TWO * sine)
    half = HALF * v
    second = g2 - cosine
    third = g * (g2 - THREE * cosine) + sine
    fourth = g2 * (g2 - SIX * cosine) + complex(
        cosine * (THREE * cosine + ONE) - FOUR * sine * sine, FOUR * sine
    )
    fifth = g * (g2 * (g2 - TEN * cosine) + FIVE * cosine * (THREE * cosine + ONE))
    fifth += complex(TEN * sine * (g2.real - cosine) - sine, -TEN * TWO * sine * sine)
    e = _exp(cosine - c)
    value = complex(e * between.real, e * between.imag)
    mean = ONE + half * (second + HALF * half * fourth)
    return (
        value * mean,
        value * (g + half * (third + HALF * half * fifth)),
        value * (second + half * fourth),
    )


@numba.njit(**FAST)
def _moves_of(at, phasor, by_amplitude, middle, others, room, sums, out):  # type: ignore[no-untyped-def]
    """Write the mean phasor, and into the room the change of its phase by each neighbour's phase."""
    node, inverse, squares, total, mean = ROWS[:10:2]
    if by_amplitude:
        # a phasor with noise across is longer: only with that does a cos t keep its mean
        for q in range(others.size + 1):
            place = np.uint64(q) * FIELDS
            for x in range(W):
                room[place + SIZE + x] *= room[place + AMPLITUDE + x] * (
                    ONE + HALF * room[place + TURN + x] ** 2
                )
    sums[mean : mean + W + W] = ZERO
    for number in range(3):
        # without the centre's noise, then sqrt(3) deviations of it either way
        share = f4(1 / 6) if number else f4(2 / 3)
        for x in range(W):
            away = SQRT_3 * room[middle + TURN + x]
            turn = (
                _at(sums, node + x).conjugate()
                if number == 2
                else complex(np.cos(away), np.sin(away))
            )
            _put(sums, node + x, turn if number else complex(ONE, ZERO))
            _put(sums, total + x, complex(room[middle + SIZE + x], ZERO))
        sums[squares : squares + W + W] = ZERO
        for place in others:
            for x in range(W):
                turn = room[place + TURN + x]
                size = room[place + SIZE + x]
                between = _at(room, place + BETWEEN + x) * complex(
                    sums[node + x], -sums[node + W + x]
                )
                value, slope, bend = _turned(sums[C + x], between, turn * turn)
                sums[total + x] += size * value.real
                sums[total + W + x] += size * value.imag
                room[place + SLOPE + x], room[place + SLOPE + W + x] = (
                    size * slope.real,
                    size * slope.imag,
                )
                room[place + BEND + x], room[place + BEND + W + x] = (
                    size * bend.real,
                    size * bend.imag,
                )
        for x in range(W):
            _put(sums, inverse + x, _inverse(_at(sums, total + x)))
        for place in others:
            for x in range(W):
                slope = _at(room, place + SLOPE + x) * _at(sums, inverse + x)
                turn2 = room[place + TURN + x] ** 2
                _put(room, place + SLOPE + x, slope)
                sums[squares + x] += turn2 * (slope.real * slope.real - slope.imag * slope.imag)
                sums[squares + W + x] += turn2 * TWO * slope.real * slope.imag
        for place in others:
            for x in range(W):
                # E[d arg S], with S and its derivative moving together: d^3 ln S has 2 S'^3 / S^3
                # and -3 S' S'' / S^2
                bend = _at(room, place + BEND + x) * _at(sums, inverse + x)
                turn2 = room[place + TURN + x] ** 2
                more = complex(
                    ONE + sums[squares + x] - turn2 * bend.real,
                    sums[squares + W + x] - turn2 * bend.imag,
                )
                room[place + MOVED + x] += share * (_at(room, place + SLOPE + x) * more).imag
        for x in range(W):
            # E[arg S] = arg E[S] - Im(E[dS^2] / S^2) / 2
            whole = _at(sums, total + x)
            less = complex(ONE, -HALF * sums[squares + W + x])
            size = share / max(np.sqrt(_power(whole)), LEAST)
            turned = whole * less * _at(sums, node + x)
            sums[mean + x] += size * turned.real
            sums[mean + W + x] += size * turned.imag
    for x in range(at.size):
        if sums[FIT + x] > ZERO:
            whole = _at(sums, mean + x)
            out.phasor[at[x]] = whole * phasor[at[x]] / max(np.sqrt(_power(whole)), LEAST)


@numba.njit(**FAST)
def _rest_of(at, by_amplitude, middle, others, room, sums, out, moved):  # type: ignore[no-untyped-def]
    """Write the phase's deviation, the share of its variance that is not of first order in phases,
    and its changes."""
    inverse, _, total, _, common, bends, rest, variance = ROWS[:8]
    for x in range(W):
        longer = room[middle + AMPLITUDE + x] if by_amplitude else ONE
        _put(sums, total + x, complex(room[middle + WEIGHT + x] * longer, ZERO))
    for place in others:
        for x in range(W):
            size = room[place + WEIGHT + x] * (room[place + AMPLITUDE + x] if by_amplitude else ONE)
            sums[total + x] += size * room[place + BETWEEN + x]
            sums[total + W + x] += size * room[place + BETWEEN + W + x]
    for x in range(W):
        _put(sums, inverse + x, _inverse(_at(sums, total + x)))
    sums[common : variance + W] = ZERO
    for place in others:
        for x in range(W):
            c = sums[C + x]
            turn2 = room[place + TURN + x] ** 2
            own2 = room[middle + TURN + x] ** 2
            cosine = c * room[place + BETWEEN + x]
            s = c * room[place + BETWEEN + W + x]
            here = _at(room, place + BETWEEN + x) * _at(sums, inverse + x)
            longer = room[place + AMPLITUDE + x] if by_amplitude else ONE
            weight = room[place + WEIGHT + x]
            size = weight * longer
            ss = s * s
            bend = size * (here.imag * (ss - ONE - cosine) - here.real * TWO * s)
            third = here.real * (THREE * (ss - cosine) - ONE) + here.imag * s * (
                FOUR + THREE * cosine - ss
            )
            sums[bends + x] += bend
            higher = (size * third) ** 2 * f4(1 / 6) * turn2 * (turn2 + THREE * own2)
            sums[rest + x] += turn2 * (bend * bend * (HALF * turn2 + own2) + higher)
            change = room[place + MOVED + x]
            sums[common + x] += change
            swollen = weight * here.imag * room[place + SWAY + x] if by_amplitude else ZERO
            squared = change * change * turn2 + swollen * swollen
            room[place + MOVED + x] = np.copysign(np.sqrt(squared), change)
            sums[variance + x] += squared
    for x in range(at.size):
        if sums[FIT + x] == ZERO:
            continue
        i = at[x]
        own2 = room[middle + TURN + x] ** 2
        # terms of higher order depend most on the centre, which is in all differences
        higher = sums[rest + x] + 0.5 * (sums[bends + x] * own2) ** 2
        centre2 = (1.0 - sums[common + x]) ** 2 * own2 + higher
        room[middle + MOVED + x] = np.sqrt(centre2)
        for q in range(others.size + 1):
            moved[x, q] = room[np.uint64(q) * FIELDS + MOVED + np.uint64(x)]
        both = sums[variance + x] + centre2
        out.turned[i], out.left_out[i] = np.sqrt(both), higher / max(both, SMALLEST)
        if by_amplitude:
            # noise across a mean phasor lengthens it
            out.amplitude[i] *= 1.0 + 0.5 * both
