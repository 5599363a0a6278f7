"""Frames of the pixels whose z is linear in the noise: a moving sum of one normal per pixel.

In a frame displaced by e steps, with u_j the normal of pixel j (times its noise), z in steps of
the output is

    even pixels:    floor(z + p e + a sum_j w_j u_j + b u_centre + 1/2)
    uneven pixels:  floor(z + p e + sum_j m_j u_j + 1/2)

with p the change of z by half path, w the weights by distance, and a, b and m of the pixel.
`add_linear_frames` is the door; `scenes.sensor.amcw.linear_frames_reference` has the same in
NumPy. Normals come from random bytes; `LANES` frames of a pixel stand side by side."""

from typing import NamedTuple

import numba
import numpy as np

from scenes.sensor.amcw.kernels import LANES
from scenes.sensor.common.normals import EXACT_SUMS, FAST

f4 = np.float32
# kinds of pixels
NONE = 0
EVEN = 1
UNEVEN = 2

# SCALE v (1 + BEND v^2) of 256 evenly spaced v in -1..1 has variance 1 and a normal's kurtosis
BEND = 2.9117528287640084
SCALE = 0.6075658039822274
TOGETHER = 5  # values that are summed in one pass


class Linear(NamedTuple):
    """The n pixels of a view, with z in steps of the output. Windows have an odd multiple of
    `TOGETHER` as their side, with zeros around a smaller one."""

    kind: np.ndarray
    """(n,) uint8: `NONE`, `EVEN` or `UNEVEN`."""
    noise: np.ndarray
    """(n,) float32: one deviation of a pixel's noise, in any unit."""
    base: np.ndarray
    """(n,) float32: a whole number near the mean of z."""
    z: np.ndarray
    """(n,) float32: the mean of z minus ``base``."""
    by_path: np.ndarray
    """(n,) float32: change of z per step of half path."""
    by_neighbour: np.ndarray
    """(n,) float32: change of an even pixel's z by a neighbour's noise at weight 1."""
    by_centre: np.ndarray
    """(n,) float32: that by its own noise, beyond its weight's part."""
    row: np.ndarray
    """(n,) int32: an uneven pixel's row in ``moves``."""
    moves: np.ndarray
    """(m, side^2) float32: change of an uneven pixel's z by each neighbour's noise."""
    taps: np.ndarray
    """(side,) float32: symmetric weights by distance along a row."""


class SharedNoise(NamedTuple):
    """Normals that replace those from random bytes, so that pixels that are simulated in another
    way share their noise."""

    normals: np.ndarray
    """(g, lanes) float32."""
    row: np.ndarray
    """(n,) int32: a pixel's row in ``normals``, -1 for none."""


@numba.njit(**FAST)
def add_linear_frames(  # type: ignore[no-untyped-def]
    shape,
    linear,
    words,
    shared,
    errors,
    counted,
    total,
    squares,
):
    """Add `LANES` frames of the even and uneven pixels to sums of z and of its square.

    Args:
        shape: (h, w) of the view, n pixels.
        linear: the pixels.
        words: (n lanes,) int8, random bytes.
        shared: normals of pixels that do not take theirs from ``words``.
        errors: (lanes,) float32, displacements of the frames in steps of half path.
        counted: (k, lanes) float32, 1 for the frames that each of k sums counts, else 0.
        total: (k, n) sums of z minus base, in steps; added to.
        squares: (k, n) sums of its square; added to.
    """
    h, w = shape
    side = linear.taps.size
    half = side // 2
    width = (w + 2 * half) * LANES
    # noise of the picture rows of a window, and a last row for what is beyond the picture
    rows = np.zeros((side + 1, width), f4)
    noise = rows.reshape(rows.size)
    down = np.empty(width, f4)  # its sums along columns
    across = np.empty(w * LANES, f4)  # its sums over windows
    row_starts = np.empty(side, np.int64)
    column_starts = np.arange(side) * LANES
    window_starts = np.empty(side * side, np.int64)
    moved = np.empty(LANES, f4)
    rounded = np.empty(LANES, f4)
    for y in range(-half, h):
        below = y + half
        if below < h:
            _draw_row(
                below,
                words,
                shared,
                linear.noise,
                w,
                half,
                rows[below % side],
            )
        if y < 0:
            continue
        for q in range(side):
            picture_row = y + q - half
            inside = 0 <= picture_row < h
            row_starts[q] = (picture_row % side if inside else side) * width
        _sum_over(noise, row_starts, linear.taps, down)
        _sum_over(down, column_starts, linear.taps, across)
        for x in range(w):
            i = y * w + x
            z = linear.z[i]
            by_path = linear.by_path[i]
            if linear.kind[i] == EVEN:
                centre = row_starts[half] + (x + half) * LANES
                a = linear.by_neighbour[i]
                b = linear.by_centre[i]
                _round(
                    z,
                    by_path,
                    errors,
                    a,
                    across,
                    x * LANES,
                    b,
                    noise,
                    centre,
                    rounded,
                )
            elif linear.kind[i] == UNEVEN:
                for q in range(side * side):
                    window_starts[q] = row_starts[q // side] + (x + q % side) * LANES
                _sum_over(noise, window_starts, linear.moves[linear.row[i]], moved)
                _round(
                    z,
                    by_path,
                    errors,
                    f4(1),
                    moved,
                    0,
                    f4(0),
                    moved,
                    0,
                    rounded,
                )
            else:
                continue
            for part in range(len(counted)):
                part_total, part_squares = _sums_of(rounded, counted[part])
                total[part, i] += part_total
                squares[part, i] += part_squares


@numba.njit(**FAST)
def _draw_row(  # type: ignore[no-untyped-def]
    y,
    words,
    shared,
    noise,
    w,
    half,
    row,
):
    """Write the noise of picture row y into ``row`` ((w + 2 half) lanes,), with zeros beside the
    picture."""
    bend = f4(BEND)
    centre = f4(0.5 / 128)
    size = f4(1 / 128)
    for x in range(w):
        i = y * w + x
        start = np.uint64((x + half) * LANES)
        first = np.uint64(i * LANES)
        if shared.row[i] >= 0:
            for t in range(LANES):
                row[start + np.uint64(t)] = noise[i] * shared.normals[shared.row[i], t]
        else:
            deviation = noise[i] * f4(SCALE)
            for t in range(np.uint64(LANES)):
                v = f4(words[first + t]) * size + centre
                row[start + t] = deviation * v * (f4(1) + bend * v * v)


@numba.njit(**FAST)
def _sum_over(values, starts, taps, total):  # type: ignore[no-untyped-def]
    """Write into ``total`` (n,) the sum of n values from each of ``starts`` (5 k,) on, times its
    tap."""
    for q in range(0, taps.size, TOGETHER):
        s1 = np.uint64(starts[q])
        s2 = np.uint64(starts[q + 1])
        s3 = np.uint64(starts[q + 2])
        s4 = np.uint64(starts[q + 3])
        s5 = np.uint64(starts[q + 4])
        a = taps[q]
        b = taps[q + 1]
        c = taps[q + 2]
        d = taps[q + 3]
        e = taps[q + 4]
        for k in range(np.uint64(total.size)):
            before = total[k] if q else f4(0)
            first = a * values[s1 + k] + b * values[s2 + k] + c * values[s3 + k]
            total[k] = before + first + d * values[s4 + k] + e * values[s5 + k]


@numba.njit(**FAST)
def _round(  # type: ignore[no-untyped-def]
    z,
    by_path,
    errors,
    by_sum,
    sums,
    sums_start,
    by_centre,
    noise,
    noise_start,
    rounded,
):
    """Write z (lanes,) of one pixel, in whole steps."""
    half = f4(0.5)
    for t in range(np.uint64(LANES)):
        of_sum = by_sum * sums[np.uint64(sums_start) + t]
        moved = of_sum + by_centre * noise[np.uint64(noise_start) + t]
        rounded[t] = np.floor(z + by_path * errors[t] + moved + half)


@numba.njit(**EXACT_SUMS)
def _sums_of(rounded, counted):  # type: ignore[no-untyped-def]
    """Return sums of z and z^2 over the frames whose ``counted`` (lanes,) is 1, not 0: whole
    numbers, below 2^24."""
    total = f4(0)
    squares = f4(0)
    for t in range(np.uint64(LANES)):
        r = counted[t] * rounded[t]
        total += r
        squares += r * r
    return total, squares
