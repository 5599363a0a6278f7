"""The engine's filter to first order in the noise: the mean of each pixel, and its change by
noise.

The filtered phasor of a pixel is a sum over its window,

    S = sum_j s_j F(t_j),    F(t) = exp(i t - c (1 - cos t)),

with s_j the neighbour's weight by distance (times its amplitude, if phasors count by amplitude),
t_j its phase minus the centre's, and c the filter's concentration. Noise acts in three ways:

* A neighbour's phase is normal of variance v about its mean. In the mean, F acts as
  F + v F''/2 + v^2 F''''/8, and its derivatives F' and F'' likewise. To first order, its noise x
  changes S by x E[F'] (Stein: E[f(x) x] = E[f'(x)] E[x^2]), so it changes the phase arg S by
  x Im(E[F'] / S).
* The centre's noise is in all differences t_j. The mean over it is taken last, of arg S, by the
  three nodes of Gauss and Hermite: 0 (weight 2/3) and +-sqrt(3) deviations (weight 1/6 each). By
  it, the centre's own noise counts for more than its weight, by some c s^2 of the window's sum with
  phase noise s, and a neighbour's for less by c s^2.
* Terms of second and third order are estimated; where they are large, frames must be drawn.

`linearised` is the door. `scenes.sensor.amcw.linear_reference` has the same for one pixel, in
NumPy and double precision. The compiled functions handle `ABREAST` pixels at once, side by side in
one flat array, so that each inner loop is over one row of it and is vectorised."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from scenes.sensor.amcw.kernels import FilterSettings
from scenes.sensor.amcw.light import NEVER_ZERO, SMALLEST, Light
from scenes.sensor.common.normals import FAST

# a limit so far away counts as never met: 3e-6 a frame for pixels just that far off
DEVIATIONS = 4.5
# most variance not of first order: it is then right to 1 %; beyond, frames are simulated
MOST_HIGHER = 0.025
# phase noise in radians above which a pixel's phase is not a normal about its mean
LARGEST_NORMAL = 0.35
# limit of the phase noise in radians, which would be too large for float32 where there is no light
LARGEST_PHASE_NOISE = 1e3
f4 = np.float32
REACH = f4(DEVIATIONS)
SQRT_3 = f4(np.sqrt(3.0))
SIXTEENTH = f4(1 / 16)
SIXTH = f4(1 / 6)
FACTORIAL_4 = f4(1 / 24)
FACTORIAL_5 = f4(1 / 120)
FACTORIAL_6 = f4(1 / 720)
QUARTER = f4(0.25)
HALF = f4(0.5)
ZERO = f4(0)
ONE = f4(1)
TWO = f4(2)
THREE = f4(3)
FOUR = f4(4)
FIVE = f4(5)
SIX = f4(6)
TEN = f4(10)


class Filtered(NamedTuple):
    """Each pixel after the filter, at f frequencies and n pixels.

    The edge sum is the sum over neighbours of (1 - cos t)/2.
    """

    phasor: np.ndarray
    """(f, n) complex64: direction of the mean phasor, of length 1."""
    amplitude: np.ndarray
    """(f, n) float32: mean amplitude."""
    phase_noise: np.ndarray
    """(f, n) float32: deviation of the phase in radians."""
    amplitude_noise: np.ndarray
    """(f, n) float32: deviation of the amplitude."""
    higher_share: np.ndarray
    """(f, n) float32: share of the phase's variance that is not of first order; infinite if
    neighbours are too noisy, or if it is uncertain whether they count."""
    edge: np.ndarray
    """(f, n) float32: mean of the edge sum, with neighbours of which it is uncertain whether they
    count; infinite if unknown."""
    edge_noise: np.ndarray
    """(f, n) float32: its deviation; infinite if unknown."""


class Moves(NamedTuple):
    """Changes of m pixels by one deviation of the noise of each of their k neighbours, at f
    frequencies."""

    phase: np.ndarray
    """(f, m, k) float32: of the phase, in radians, by the neighbour's phase."""
    amplitude: np.ndarray
    """(f, m, k) float32: of the amplitude, by the neighbour's amplitude; changes by its phase are
    added as if they were by its amplitude, with the sign of the larger."""


def unknown_filtered(frequencies: int, n: int) -> Filtered:
    """Return n pixels with unknown values."""
    shape = (frequencies, n)
    return Filtered(
        phasor=np.ones(shape, np.complex64),
        amplitude=np.zeros(shape, f4),
        phase_noise=np.full(shape, np.inf, f4),
        amplitude_noise=np.full(shape, np.inf, f4),
        higher_share=np.full(shape, np.inf, f4),
        edge=np.full(shape, np.inf, f4),
        edge_noise=np.full(shape, np.inf, f4),
    )


def linearised(
    pixels: np.ndarray,
    light: Light,
    window: FilterSettings,
    shape: tuple[int, int],
    filtered: Filtered,
) -> Moves:
    """Fill ``filtered`` at some pixels of a view, and return how each neighbour's noise moves
    them. A pixel at which noise of one frequency is not of first order stays unknown at the
    frequencies that follow, as its frames are simulated whatever they are.

    Args:
        pixels: (m,) flat indices.
        light: of the whole view, n pixels.
        window: the filter's settings, with a window of k pixels.
        shape: (h, w) of the view.
        filtered: of the whole view; written at ``pixels``.
    """
    shape_of_moves = (len(light.phase_noise), len(pixels), window.space.size)
    moves = Moves(np.zeros(shape_of_moves, f4), np.zeros(shape_of_moves, f4))
    chosen = np.arange(len(pixels))
    for f in range(len(light.phase_noise)):
        light_of_frequency = Light._make(part[f] for part in light)
        filtered_of_frequency = Filtered._make(part[f] for part in filtered)
        _linearise(
            pixels,
            chosen,
            light_of_frequency,
            window,
            shape,
            filtered_of_frequency,
            moves.phase[f],
            moves.amplitude[f],
        )
        chosen = chosen[filtered.higher_share[f, pixels[chosen]] <= MOST_HIGHER]
    return moves


# ---------------------------------------------------------------- layout of the flat arrays

ABREAST = 32  # pixels that a loop does side by side, in vector registers
ROW = np.uint64(ABREAST)  # indices are unsigned: the compiler gathers by signed ones

# Values of a neighbour, each a row for `ABREAST` pixels. A neighbour's values begin at its slot; a
# complex value has its imaginary part one row behind its real part.
DIRECTION = ROW * 0  # complex: exp(i t) of the phase minus the centre's
AMPLITUDE = ROW * 2  # as in `Light`
MEAN_AMPLITUDE = ROW * 3  # as in `Light`
PHASE_NOISE = ROW * 4  # as in `Light`
AMPLITUDE_NOISE = ROW * 5  # deviation of the amplitude
SPACE = ROW * 6  # s_j: weight by distance, 0 if the neighbour does not count
WEIGHT = ROW * 7  # weight in the filter: s_j exp(-c (1 - cos t))
FIRST = ROW * 8  # complex: s_j E[F'], then over S
SECOND = ROW * 10  # complex: s_j E[F'']
MOVE = ROW * 12  # change of arg S by the neighbour's phase
VALUES = ROW * 13  # from one slot to the next

# Values of a pixel, each a row.
CONCENTRATION = ROW * 0  # c, or 0 if the centre is dim
LIT = ROW * 1  # 1 if the centre is certainly bright
CERTAIN = ROW * 2  # 1 if it is certain which neighbours count
LARGEST_NOISE = ROW * 3  # largest phase noise of the neighbours that count
FITS = ROW * 4  # above 0 if the linear model holds
SUMS = tuple(ROW * row for row in range(5, 16))
"""Rows for sums over the window, which each function names for itself."""
END = ROW * 16


# ---------------------------------------------------------------- one frequency, all pixels


@numba.njit(**FAST)
def _linearise(  # type: ignore[no-untyped-def]
    pixels,
    chosen,
    light,
    window,
    shape,
    filtered,
    moves,
    amplitude_moves,
):
    """Do the work of `linearised` for one frequency and the ``chosen`` (c,) indices of pixels;
    arrays have no first axis."""
    k = window.space.size
    middle = k // 2
    by_amplitude = window.by_amplitude
    values = np.empty(np.uint64(k) * VALUES, f4)
    sums = np.empty(END, f4)
    centre = np.uint64(middle) * VALUES
    neighbours = np.array([np.uint64(q) * VALUES for q in range(k) if q != middle], np.uint64)
    batch = np.empty(ABREAST, np.int64)
    for start in range(0, chosen.size, ABREAST):
        # the last batch may have fewer pixels: it repeats the last one
        for x in range(ABREAST):
            batch[x] = pixels[chosen[min(start + x, chosen.size - 1)]]
        rows = chosen[start : start + ABREAST]
        written = batch[: rows.size]
        _gather(
            batch,
            light,
            window.space,
            shape,
            values,
        )
        _choose_neighbours(window, centre, neighbours, values, sums)
        _write_edges(
            written,
            window,
            centre,
            neighbours,
            values,
            sums,
            filtered,
        )
        _write_amplitudes(
            written,
            light.phasor,
            by_amplitude,
            centre,
            neighbours,
            values,
            sums,
            filtered,
            rows,
            amplitude_moves,
        )
        if sums[FITS : FITS + ROW].max() > ZERO:
            _write_mean_phasors(
                written,
                light.phasor,
                by_amplitude,
                centre,
                neighbours,
                values,
                sums,
                filtered,
            )
            _write_phase_noise(
                written,
                by_amplitude,
                centre,
                neighbours,
                values,
                sums,
                filtered,
                rows,
                moves,
            )


@numba.njit(**FAST)
def _gather(  # type: ignore[no-untyped-def]
    batch,
    light,
    space,
    shape,
    values,
):
    """Fill ``values`` with the windows of the pixels in ``batch`` (`ABREAST`,)."""
    h, w = shape
    side = space.shape[0]
    half = side // 2
    for x in range(batch.size):
        i = batch[x]
        slot = np.uint64(x)
        first_row = i // w - half
        first_column = i % w - half
        for dy in range(side):
            for dx in range(side):
                row = first_row + dy
                column = first_column + dx
                inside = (row >= 0) & (row < h) & (column >= 0) & (column < w)
                j = row * w + column if inside else i
                direction = light.phasor[j] * light.phasor[i].conjugate()
                _put(values, slot + DIRECTION, direction.real, direction.imag)
                values[slot + AMPLITUDE] = light.amplitude[j]
                values[slot + MEAN_AMPLITUDE] = light.mean_amplitude[j]
                values[slot + PHASE_NOISE] = min(light.phase_noise[j], LARGEST_PHASE_NOISE)
                values[slot + AMPLITUDE_NOISE] = light.amplitude[j] * light.relative_noise[j]
                values[slot + SPACE] = space[dy, dx] if inside else ZERO
                values[slot + MOVE] = ZERO
                slot += VALUES


# ---------------------------------------------------------------- which neighbours count


@numba.njit(**FAST)
def _choose_neighbours(window, centre, neighbours, values, sums):  # type: ignore[no-untyped-def]
    """Find which neighbours count, their weights, whether that is `CERTAIN`, and whether the
    linear model `FITS`: certain, and not too noisy."""
    dim = window.dim
    drop_dim = window.drop_dim
    for x in range(ROW):
        reach = REACH * values[centre + AMPLITUDE_NOISE + x]
        always_lit = values[centre + AMPLITUDE + x] - reach > dim
        never_lit = values[centre + MEAN_AMPLITUDE + x] + reach < dim
        decided = always_lit | never_lit
        sums[LIT + x] = ONE if always_lit else ZERO
        sums[CONCENTRATION + x] = window.concentration if always_lit else ZERO
        sums[CERTAIN + x] = ONE if decided | (not drop_dim) else ZERO
        sums[LARGEST_NOISE + x] = values[centre + PHASE_NOISE + x]
        sums[FITS + x] = ONE if decided else ZERO
        values[centre + WEIGHT + x] = values[centre + SPACE + x]
    for slot in neighbours:
        for x in range(ROW):
            reach = REACH * values[slot + AMPLITUDE_NOISE + x]
            space = values[slot + SPACE + x]
            if drop_dim:
                lit = sums[LIT + x] > ZERO
                never_counts = lit & (values[slot + MEAN_AMPLITUDE + x] + reach < dim)
                space = ZERO if never_counts else space
                may_be_dim = values[slot + AMPLITUDE + x] - reach <= dim
                doubtful = lit & (space > ZERO) & may_be_dim
                sums[CERTAIN + x] = ZERO if doubtful else sums[CERTAIN + x]
                values[slot + SPACE + x] = space
            # -c (1 - cos t)
            exponent = sums[CONCENTRATION + x] * (values[slot + DIRECTION + x] - ONE)
            values[slot + WEIGHT + x] = space * _exp(exponent)
            noise = values[slot + PHASE_NOISE + x] if space > ZERO else ZERO
            sums[LARGEST_NOISE + x] = max(sums[LARGEST_NOISE + x], noise)
    for x in range(ROW):
        fits = sums[FITS + x] * sums[CERTAIN + x]
        sums[FITS + x] = fits if sums[LARGEST_NOISE + x] <= f4(LARGEST_NORMAL) else ZERO


@numba.njit(inline="always", **FAST)
def _exp(x):  # type: ignore[no-untyped-def]
    """Return the exponential of -8 <= x <= 0, to 2e-5 of its value: the sixteenth power of a
    series."""
    t = x * SIXTEENTH
    e = FACTORIAL_5 + t * FACTORIAL_6
    e = FACTORIAL_4 + t * e
    e = SIXTH + t * e
    e = HALF + t * e
    e = ONE + t * e
    e = ONE + t * e
    e = e * e
    e = e * e
    e = e * e
    return e * e


# ---------------------------------------------------------------- the edge sum


@numba.njit(**FAST)
def _write_edges(  # type: ignore[no-untyped-def]
    written,
    window,
    centre,
    neighbours,
    values,
    sums,
    filtered,
):
    """Write the edge sum's mean and deviation."""
    dim = window.dim
    dim_edges = window.dim_edges
    mean = SUMS[0]
    variance = SUMS[1]
    sines = SUMS[2]  # sum of sin t / 2: derivative by the centre's phase
    cosines = SUMS[3]  # sum of cos t / 4: half the second derivative
    sums[mean : cosines + ROW] = ZERO
    for slot in neighbours:
        for x in range(ROW):
            noise = values[slot + PHASE_NOISE + x]
            centre_noise = values[centre + PHASE_NOISE + x]
            re = values[slot + DIRECTION + x]
            im = values[slot + DIRECTION + ROW + x]
            reach = REACH * values[slot + AMPLITUDE_NOISE + x]
            may_be_lit = values[slot + MEAN_AMPLITUDE + x] + reach >= dim
            counts = (values[slot + SPACE + x] > ZERO) & (dim_edges | may_be_lit)
            counted = ONE if counts else ZERO
            noise2 = noise * noise
            centre2 = centre_noise * centre_noise
            shortened = max(ONE - HALF * (noise2 + centre2), ZERO)
            sums[mean + x] += counted * HALF * (ONE - re * shortened)
            sums[sines + x] += counted * HALF * im
            sums[cosines + x] += counted * QUARTER * re
            first = HALF * im * noise
            second = QUARTER * re
            sums[variance + x] += counted * (
                first * first + second * second * TWO * noise2 * (noise2 + TWO * centre2)
            )
    for x in range(written.size):
        i = written[x]
        centre_noise = values[centre + PHASE_NOISE + x]
        deviation = np.sqrt(
            sums[variance + x]
            + (sums[sines + x] * centre_noise) ** 2
            + 2.0 * (sums[cosines + x] * centre_noise * centre_noise) ** 2
        )
        known = (sums[LARGEST_NOISE + x] <= LARGEST_NORMAL) & (sums[CERTAIN + x] > ZERO)
        filtered.edge[i] = sums[mean + x] if known else np.inf
        filtered.edge_noise[i] = deviation if known else np.inf


# ---------------------------------------------------------------- the amplitude


@numba.njit(**FAST)
def _write_amplitudes(  # type: ignore[no-untyped-def]
    written,
    phasor,
    by_amplitude,
    centre,
    neighbours,
    values,
    sums,
    filtered,
    rows,
    moves,
):
    """Write the filtered amplitude, its deviation and, into these ``rows`` of ``moves`` (m, k), its
    moves, and the filtered phasor if noise leaves the phases unchanged."""
    weights = SUMS[0]
    amplitudes = SUMS[1]
    variance = SUMS[2]
    by_centre = SUMS[3]  # change of the sum of amplitudes by the centre's phase
    length = SUMS[4]
    total = SUMS[5]  # complex: sum of weighted phasors
    for x in range(ROW):
        weight = values[centre + WEIGHT + x]
        sums[weights + x] = weight
        sums[amplitudes + x] = weight * values[centre + MEAN_AMPLITUDE + x]
        sums[variance + x] = (weight * values[centre + AMPLITUDE_NOISE + x]) ** 2
        sums[by_centre + x] = ZERO
        _put(sums, total + x, weight * values[centre + AMPLITUDE + x], ZERO)
    for slot in neighbours:
        for x in range(ROW):
            c = sums[CONCENTRATION + x]
            noise = values[slot + PHASE_NOISE + x]
            centre_noise = values[centre + PHASE_NOISE + x]
            re = values[slot + DIRECTION + x]
            im = values[slot + DIRECTION + ROW + x]
            # the mean of exp(-c (1 - cos t)) over the noise of t
            noise2 = min(noise * noise + centre_noise * centre_noise, QUARTER)
            weight = values[slot + WEIGHT + x] * (ONE + HALF * noise2 * (c * im * c * im - c * re))
            sums[weights + x] += weight
            sums[amplitudes + x] += weight * values[slot + MEAN_AMPLITUDE + x]
            # noise across lengthens a phasor by what it takes from its mean
            size = weight * values[slot + AMPLITUDE + x]
            _add(sums, total + x, size * re, size * im)
            by_length = weight * values[slot + AMPLITUDE_NOISE + x]
            sums[variance + x] += by_length * by_length
            values[slot + FIRST + x] = by_length
    for x in range(ROW):
        size = np.sqrt(_squared(_complex_at(sums, total + x)))
        weight_sum = max(sums[weights + x], NEVER_ZERO)
        sums[length + x] = max(size, NEVER_ZERO)
        sums[weights + x] = weight_sum
        sums[amplitudes + x] = (size if by_amplitude else sums[amplitudes + x]) / weight_sum
    # noise of phases changes weights and how phasors add up: its variance, times the squared sum
    # of weights
    for slot in neighbours:
        for x in range(ROW):
            re = values[slot + DIRECTION + x]
            im = values[slot + DIRECTION + ROW + x]
            weight = values[slot + WEIGHT + x]
            slope = sums[CONCENTRATION + x] * im  # minus the derivative of the weight, over it
            amplitude = sums[amplitudes + x]
            if by_amplitude:
                along = sums[total + ROW + x] * (re - slope * im) - sums[total + x] * (
                    slope * re + im
                )
                change = weight * (
                    values[slot + AMPLITUDE + x] * along / sums[length + x] + slope * amplitude
                )
            else:
                change = slope * weight * (amplitude - values[slot + MEAN_AMPLITUDE + x])
            by_phase = change * min(values[slot + PHASE_NOISE + x], HALF)
            sums[variance + x] += by_phase * by_phase
            sums[by_centre + x] += change
            by_length = values[slot + FIRST + x]
            size = np.sqrt(by_length * by_length + by_phase * by_phase)
            values[slot + FIRST + x] = size if by_length + by_phase > ZERO else -size
    for x in range(written.size):
        i = written[x]
        of_centre = sums[by_centre + x] * min(values[centre + PHASE_NOISE + x], HALF)
        filtered.amplitude[i] = sums[amplitudes + x]
        filtered.phasor[i] = _complex_at(sums, total + x) * phasor[i] / sums[length + x]
        filtered.amplitude_noise[i] = (
            np.sqrt(sums[variance + x] + of_centre * of_centre) / sums[weights + x]
        )
        by_length = values[centre + WEIGHT + x] * values[centre + AMPLITUDE_NOISE + x]
        size = np.sqrt(by_length * by_length + of_centre * of_centre)
        values[centre + FIRST + x] = size if by_length + of_centre > ZERO else -size
        for q in range(neighbours.size + 1):
            move = values[np.uint64(q) * VALUES + FIRST + np.uint64(x)]
            moves[rows[x], q] = move / sums[weights + x]


# ---------------------------------------------------------------- complex numbers in rows


@numba.njit(inline="always", **FAST)
def _complex_at(values, index):  # type: ignore[no-untyped-def]
    return complex(values[index], values[index + ROW])


@numba.njit(inline="always", **FAST)
def _put(values, index, re, im):  # type: ignore[no-untyped-def]
    values[index] = re
    values[index + ROW] = im


@numba.njit(inline="always", **FAST)
def _add(values, index, re, im):  # type: ignore[no-untyped-def]
    values[index] += re
    values[index + ROW] += im


@numba.njit(inline="always", **FAST)
def _squared(z):  # type: ignore[no-untyped-def]
    return z.real * z.real + z.imag * z.imag


@numba.njit(inline="always", **FAST)
def _invert(values, source, target):  # type: ignore[no-untyped-def]
    """Write 1 / z of the number at ``source`` to ``target``, 0 where z is 0."""
    re = values[source]
    im = values[source + ROW]
    size = ONE / max(re * re + im * im, NEVER_ZERO * NEVER_ZERO)
    _put(values, target, re * size, -im * size)


# ---------------------------------------------------------------- the phase


@numba.njit(inline="always", **FAST)
def _mean_derivatives(c, direction, v):  # type: ignore[no-untyped-def]
    """Return the means of F, F' and F'' at the angle t whose exp(i t) is ``direction``, over
    noise of t of variance ``v``. With g = i - c sin t, the first derivative of ln F, and further
    ones -c cos t, c sin t, c cos t, -c sin t."""
    cosine = c * direction.real
    sine = c * direction.imag
    g = complex(-sine, ONE)
    g2 = complex(sine * sine - ONE, -TWO * sine)
    # F'', F''', F'''' and F''''' over F
    second = g2 - cosine
    third = g * (g2 - THREE * cosine) + sine
    fourth = g2 * (g2 - SIX * cosine) + complex(
        cosine * (THREE * cosine + ONE) - FOUR * sine * sine, FOUR * sine
    )
    fifth = g * (g2 * (g2 - TEN * cosine) + FIVE * cosine * (THREE * cosine + ONE))
    fifth += complex(TEN * sine * (g2.real - cosine) - sine, -TEN * TWO * sine * sine)
    half = HALF * v
    e = _exp(cosine - c)
    value = complex(e * direction.real, e * direction.imag)
    mean = value * (ONE + half * (second + HALF * half * fourth))
    mean_first = value * (g + half * (third + HALF * half * fifth))
    mean_second = value * (second + half * fourth)
    return mean, mean_first, mean_second


@numba.njit(**FAST)
def _write_mean_phasors(  # type: ignore[no-untyped-def]
    written,
    phasor,
    by_amplitude,
    centre,
    neighbours,
    values,
    sums,
    filtered,
):
    """Write the mean phasor, and into ``values`` the `MOVE` of its phase by each neighbour's
    phase."""
    node = SUMS[0]  # complex: exp(i a) of the centre's noise a
    inverse = SUMS[2]  # complex: 1 / S
    squares = SUMS[4]  # complex: sum of v (E[F'] / S)^2
    total = SUMS[6]  # complex: S
    mean = SUMS[8]  # complex: mean of exp(i arg S) over the nodes
    if by_amplitude:
        # a phasor with noise across is longer: only with that does a cos t keep its mean
        for q in range(neighbours.size + 1):
            slot = np.uint64(q) * VALUES
            for x in range(ROW):
                values[slot + SPACE + x] *= values[slot + AMPLITUDE + x] * (
                    ONE + HALF * values[slot + PHASE_NOISE + x] ** 2
                )
    sums[mean : mean + ROW + ROW] = ZERO
    for number in range(3):
        # without the centre's noise, then sqrt(3) deviations of it either way
        share = SIXTH if number else f4(2 / 3)
        for x in range(ROW):
            angle = SQRT_3 * values[centre + PHASE_NOISE + x]
            if number == 0:
                turn = complex(ONE, ZERO)
            elif number == 1:
                turn = complex(np.cos(angle), np.sin(angle))
            else:
                turn = _complex_at(sums, node + x).conjugate()
            _put(sums, node + x, turn.real, turn.imag)
            _put(sums, total + x, values[centre + SPACE + x], ZERO)
        sums[squares : squares + ROW + ROW] = ZERO
        # S, and each neighbour's derivatives
        for slot in neighbours:
            for x in range(ROW):
                noise = values[slot + PHASE_NOISE + x]
                space = values[slot + SPACE + x]
                turn_back = _complex_at(sums, node + x).conjugate()
                direction = _complex_at(values, slot + DIRECTION + x) * turn_back
                value, first, second = _mean_derivatives(
                    sums[CONCENTRATION + x], direction, noise * noise
                )
                _add(sums, total + x, space * value.real, space * value.imag)
                _put(values, slot + FIRST + x, space * first.real, space * first.imag)
                _put(values, slot + SECOND + x, space * second.real, space * second.imag)
        for x in range(ROW):
            _invert(sums, total + x, inverse + x)
        # E[dS^2] / S^2
        for slot in neighbours:
            for x in range(ROW):
                first = _complex_at(values, slot + FIRST + x) * _complex_at(sums, inverse + x)
                noise2 = values[slot + PHASE_NOISE + x] ** 2
                re = first.real
                im = first.imag
                _put(values, slot + FIRST + x, re, im)
                _add(sums, squares + x, noise2 * (re * re - im * im), noise2 * TWO * re * im)
        # E[d arg S], with S and its derivative moving together: d^3 ln S has 2 S'^3 / S^3 and
        # -3 S' S'' / S^2
        for slot in neighbours:
            for x in range(ROW):
                second = _complex_at(values, slot + SECOND + x) * _complex_at(sums, inverse + x)
                noise2 = values[slot + PHASE_NOISE + x] ** 2
                together = complex(
                    ONE + sums[squares + x] - noise2 * second.real,
                    sums[squares + ROW + x] - noise2 * second.imag,
                )
                first = _complex_at(values, slot + FIRST + x)
                values[slot + MOVE + x] += share * (first * together).imag
        # E[arg S] = arg E[S] - Im(E[dS^2] / S^2) / 2
        for x in range(ROW):
            phasor_sum = _complex_at(sums, total + x)
            correction = complex(ONE, -HALF * sums[squares + ROW + x])
            size = share / max(np.sqrt(_squared(phasor_sum)), NEVER_ZERO)
            turned = phasor_sum * correction * _complex_at(sums, node + x)
            _add(sums, mean + x, size * turned.real, size * turned.imag)
    for x in range(written.size):
        if sums[FITS + x] > ZERO:
            i = written[x]
            mean_phasor = _complex_at(sums, mean + x)
            filtered.phasor[i] = (
                mean_phasor * phasor[i] / max(np.sqrt(_squared(mean_phasor)), NEVER_ZERO)
            )


@numba.njit(**FAST)
def _write_phase_noise(  # type: ignore[no-untyped-def]
    written,
    by_amplitude,
    centre,
    neighbours,
    values,
    sums,
    filtered,
    rows,
    moves,
):
    """Write the phase's deviation, the share of its variance that is not of first order in phases,
    and, into these ``rows`` of ``moves`` (m, k), its moves by each neighbour's noise."""
    inverse = SUMS[0]  # complex: 1 / S without noise
    total = SUMS[2]  # complex: S without noise
    by_neighbours = SUMS[4]  # sum of moves
    bends = SUMS[5]  # sum of the second derivatives of arg S
    higher_variance = SUMS[6]
    variance = SUMS[7]
    for x in range(ROW):
        amplitude = values[centre + AMPLITUDE + x] if by_amplitude else ONE
        _put(sums, total + x, values[centre + WEIGHT + x] * amplitude, ZERO)
    for slot in neighbours:
        for x in range(ROW):
            amplitude = values[slot + AMPLITUDE + x] if by_amplitude else ONE
            size = values[slot + WEIGHT + x] * amplitude
            direction = _complex_at(values, slot + DIRECTION + x)
            _add(sums, total + x, size * direction.real, size * direction.imag)
    for x in range(ROW):
        _invert(sums, total + x, inverse + x)
    sums[by_neighbours : variance + ROW] = ZERO
    for slot in neighbours:
        for x in range(ROW):
            c = sums[CONCENTRATION + x]
            noise2 = values[slot + PHASE_NOISE + x] ** 2
            centre2 = values[centre + PHASE_NOISE + x] ** 2
            cosine = c * values[slot + DIRECTION + x]
            sine = c * values[slot + DIRECTION + ROW + x]
            sine2 = sine * sine
            part = _complex_at(values, slot + DIRECTION + x) * _complex_at(sums, inverse + x)
            amplitude = values[slot + AMPLITUDE + x] if by_amplitude else ONE
            weight = values[slot + WEIGHT + x]
            size = weight * amplitude
            # imaginary parts of F'' / S and F''' / S
            second = size * (part.imag * (sine2 - ONE - cosine) - part.real * TWO * sine)
            third = part.real * (THREE * (sine2 - cosine) - ONE) + part.imag * sine * (
                FOUR + THREE * cosine - sine2
            )
            sums[bends + x] += second
            of_third = (size * third) ** 2 * SIXTH * noise2 * (noise2 + THREE * centre2)
            sums[higher_variance + x] += noise2 * (
                second * second * (HALF * noise2 + centre2) + of_third
            )
            move = values[slot + MOVE + x]
            sums[by_neighbours + x] += move
            by_length = ZERO
            if by_amplitude:
                by_length = weight * part.imag * values[slot + AMPLITUDE_NOISE + x]
            squared = move * move * noise2 + by_length * by_length
            values[slot + MOVE + x] = np.copysign(np.sqrt(squared), move)
            sums[variance + x] += squared
    for x in range(written.size):
        if sums[FITS + x] == ZERO:
            continue
        i = written[x]
        centre2 = values[centre + PHASE_NOISE + x] ** 2
        # terms of higher order depend most on the centre, which is in all differences
        higher = sums[higher_variance + x] + 0.5 * (sums[bends + x] * centre2) ** 2
        by_centre2 = (1.0 - sums[by_neighbours + x]) ** 2 * centre2 + higher
        values[centre + MOVE + x] = np.sqrt(by_centre2)
        for q in range(neighbours.size + 1):
            moves[rows[x], q] = values[np.uint64(q) * VALUES + MOVE + np.uint64(x)]
        total_variance = sums[variance + x] + by_centre2
        filtered.phase_noise[i] = np.sqrt(total_variance)
        filtered.higher_share[i] = higher / max(total_variance, SMALLEST)
        if by_amplitude:
            # noise across a mean phasor lengthens it
            filtered.amplitude[i] *= 1.0 + 0.5 * total_variance
