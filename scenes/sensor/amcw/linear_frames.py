"""Frames of the imager to first order in its noise: a number for each pixel and frame, summed and rounded in one loop.

Where the mean of a frame's z and the pull of each neighbour's noise on it are known (`scenes.sensor.amcw.linear`), z is
a moving sum of one normal a pixel: whatever the frequencies and taps, only one combination of a pixel's noise reaches
z. The rounding to the output's step is done in each frame, as it hangs on the noise and is shared by neighbours.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from scenes.sensor.amcw.kernels import LANES
from scenes.sensor.normals import EXACT_SUMS, FAST

f4 = np.float32
NONE, EVEN, UNEVEN = 0, 1, 2


class Linear(NamedTuple):
    """Pixels of a view, (n,) float32 but for ``kind`` (uint8) and ``row`` (int32); z in steps of the output.

    ``noise``: what one deviation of a pixel's noise is, in any unit (of length for unit phasors). ``z``: the mean less
    ``base``, a whole number. ``by_path``: by how much a step of half path moves z. Of EVEN pixels ``each``: by how much
    a neighbour's noise moves z at weight 1, ``more``: and the centre's own beyond its weight's part. Of UNEVEN pixels
    ``row`` in ``moved`` (m, k): the same by each neighbour. ``taps`` (side,): weights by distance along a row,
    the same to both sides.
    """

    kind: np.ndarray
    noise: np.ndarray
    base: np.ndarray
    z: np.ndarray
    by_path: np.ndarray
    each: np.ndarray
    more: np.ndarray
    row: np.ndarray
    moved: np.ndarray
    taps: np.ndarray


def _bend() -> tuple[float, float]:
    """Return (b, scale): u = scale v (1 + b v^2) of an even v in -1..1 at 256 levels has variance 1 and a normal's
    kurtosis.

    Sums of nine or more of them are normal to 1e-4 at 4 deviations, with a byte of randomness each.
    """
    v = (np.arange(-128, 128) + 0.5) / 128
    low, high = 1.0, 6.0
    for _ in range(60):
        middle = (low + high) / 2
        u = v * (1 + middle * v**2)
        low, high = (middle, high) if (u**4).mean() < 3 * (u**2).mean() ** 2 else (low, middle)
    return low, float(1 / np.sqrt((v**2 * (1 + low * v**2) ** 2).mean()))


BEND, SCALE = _bend()


@numba.njit(**FAST)
def _noise_row(y, words, given, given_at, noise, w, half, row):  # type: ignore[no-untyped-def]
    """Write noise of picture row y into ``row`` ((w + 2 half) lanes,), zeros beside the picture."""
    bend, centre, size = f4(BEND), f4(0.5 / 128), f4(1 / 128)
    for x in range(w):
        i = y * w + x
        start, first = np.uint64((x + half) * LANES), np.uint64(i * LANES)
        if given_at[i] >= 0:
            for t in range(LANES):
                row[start + np.uint64(t)] = noise[i] * given[given_at[i], t]
        else:
            deviation = noise[i] * f4(SCALE)
            for t in range(np.uint64(LANES)):
                v = f4(words[first + t]) * size + centre
                row[start + t] = deviation * v * (f4(1) + bend * v * v)


@numba.njit(**FAST)
def _begin_sum(source, tap, shift, length, total):  # type: ignore[no-untyped-def]
    for k in range(np.uint64(length)):
        total[k] = tap * source[np.uint64(shift) + k]


@numba.njit(**FAST)
def _pair_sum(above, below, tap, shift, other_shift, length, total):  # type: ignore[no-untyped-def]
    for k in range(np.uint64(length)):
        total[k] += tap * (above[np.uint64(shift) + k] + below[np.uint64(other_shift) + k])


@numba.njit(**FAST)
def _window_sums(rows, blank, y, h, taps, w, down, across):  # type: ignore[no-untyped-def]
    """Write weighted sums over the window of each pixel of picture row y, (w lanes,), into ``across``."""
    side = taps.size
    half = side // 2
    length = w * LANES
    _begin_sum(rows[y % side], taps[half], 0, down.size, down)
    for d in range(1, half + 1):
        above = rows[(y - d) % side] if y - d >= 0 else blank
        below = rows[(y + d) % side] if y + d < h else blank
        _pair_sum(above, below, taps[half - d], 0, 0, down.size, down)
    _begin_sum(down, taps[half], half * LANES, length, across)
    for d in range(1, half + 1):
        _pair_sum(down, down, taps[half - d], (half - d) * LANES, (half + d) * LANES, length, across)


@numba.njit(**FAST)
def _round(z, by_path, errors, each, moved, start, more, own, own_start, rounded):  # type: ignore[no-untyped-def]
    half = f4(0.5)
    for t in range(np.uint64(LANES)):
        noise = each * moved[np.uint64(start) + t] + more * own[np.uint64(own_start) + t]
        rounded[t] = np.floor(z + by_path * errors[t] + noise + half)


@numba.njit(**EXACT_SUMS)
def _sums_of(rounded, counted):  # type: ignore[no-untyped-def]
    """Return sums of z and z^2 over the frames that are ``counted`` (lanes,) 0 or 1: whole numbers, below 2^24."""
    total, squares = f4(0), f4(0)
    for t in range(np.uint64(LANES)):
        r = counted[t] * rounded[t]
        total += r
        squares += r * r
    return total, squares


@numba.njit(**FAST)
def add_linear_frames(  # type: ignore[no-untyped-def]
    shape, linear, words, given, given_at, errors, counted, total, squares
):
    """Add `LANES` frames at the EVEN and UNEVEN pixels of ``linear``: z less base, and its square, in steps, (n,).

    ``words`` (n lanes,) int8: random bytes. ``given`` (g, lanes): standard normals that stand for them at the pixels
    where ``given_at`` (n,) is not -1, so that pixels simulated otherwise share their noise. ``errors`` (lanes,): what
    each frame is displaced by, in steps of half path; ``counted`` (lanes,): 1 for frames that count, 0 for others.
    """
    h, w = shape
    side = linear.taps.size
    half = side // 2
    width = (w + 2 * half) * LANES
    rows = np.zeros((side, width), np.float32)
    blank, down, across = np.zeros(width, np.float32), np.empty(width, np.float32), np.empty(w * LANES, np.float32)
    sums, rounded = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    for y in range(min(half, h)):
        _noise_row(y, words, given, given_at, linear.noise, w, half, rows[y % side])
    for y in range(h):
        if y + half < h:
            _noise_row(y + half, words, given, given_at, linear.noise, w, half, rows[(y + half) % side])
        _window_sums(rows, blank, y, h, linear.taps, w, down, across)
        own = rows[y % side]
        for x in range(w):
            i = y * w + x
            if linear.kind[i] == EVEN:
                start, mine = x * LANES, (x + half) * LANES
                z, by_path, each, more = linear.z[i], linear.by_path[i], linear.each[i], linear.more[i]
                _round(z, by_path, errors, each, across, start, more, own, mine, rounded)
            elif linear.kind[i] == UNEVEN:
                sums[:] = f4(0)
                for q in range(side * side):
                    pull = linear.moved[linear.row[i], q]
                    if pull != f4(0):
                        source, first = rows[(y + q // side - half) % side], np.uint64((x + q % side) * LANES)
                        for t in range(np.uint64(LANES)):
                            sums[t] += pull * source[first + t]
                _round(linear.z[i], linear.by_path[i], errors, f4(1), sums, 0, f4(0), sums, 0, rounded)
            else:
                continue
            a, b = _sums_of(rounded, counted)
            total[i] += a
            squares[i] += b


@numba.njit(**EXACT_SUMS)
def add_bytes(words: np.ndarray, counted: np.ndarray, total: np.ndarray) -> None:
    """Add to ``total`` (n,) the bytes ``words`` (n lanes,) int8 of the frames that count, as numbers of variance 1."""
    scale = f4(1 / np.sqrt((256.0**2 - 1) / 12))
    for i in range(total.size):
        sum_of_all = f4(0)
        for t in range(np.uint64(LANES)):
            sum_of_all += counted[t] * (f4(words[np.uint64(i * LANES) + t]) + f4(0.5))
        total[i] += scale * sum_of_all
