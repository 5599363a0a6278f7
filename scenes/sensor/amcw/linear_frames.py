"""A frame of the pixels whose z is linear in the noise: moving sums of one normal per pixel.

In a frame displaced by e steps, with u_j the normal of pixel j (times its noise) and v_j another,
z in steps of the output and the amplitude are

    even pixels:    floor(z + p e + a sum_j w_j u_j + b u_centre + 1/2)
    uneven pixels:  floor(z + p e + sum_j m_j u_j + 1/2)
    even pixels' amplitude:    A + d sum_j w_j v_j / sqrt(sum_j w_j^2)
    uneven pixels' amplitude:  A + sum_j q_j v_j

with p the change of z by half path, w the weights by distance, and a, b, m, q, A and d of the
pixel.
`draw_linear_frame` is the door; `scenes.sensor.amcw.linear_frames_reference` has the same in
NumPy."""

from typing import NamedTuple

import numba
import numpy as np

from scenes.sensor.common.normals import FAST

f4 = np.float32
ZERO = f4(0)
HALF = f4(0.5)
TOGETHER = 5  # values that are summed in one pass
# indices are unsigned: the compiler gathers by signed ones
ONE = np.uint64(1)
TWO = np.uint64(2)
THREE = np.uint64(3)
FOUR = np.uint64(4)


class Linear(NamedTuple):
    """The n pixels of a view, with z in steps of the output."""

    noise: np.ndarray
    """(n,) float32: one deviation of a pixel's noise, in any unit."""
    base: np.ndarray
    """(n,) float32: a whole number near the mean of z."""
    z: np.ndarray
    """(n,) float32: the mean of z minus ``base``; NaN at pixels that are not linear."""
    by_path: np.ndarray
    """(n,) float32: change of z per step of half path."""
    by_neighbour: np.ndarray
    """(n,) float32: change of an even pixel's z by a neighbour's noise at weight 1."""
    by_centre: np.ndarray
    """(n,) float32: that by its own noise, beyond its weight's part."""
    uneven: np.ndarray
    """(m,): flat indices of the uneven pixels, ascending."""
    moves: np.ndarray
    """(m, side^2) float32: change of an uneven pixel's z by each neighbour's noise."""
    amplitude_moves: np.ndarray
    """(m, side^2) float32: change of its amplitude by each neighbour's amplitude noise."""
    taps: np.ndarray
    """(side,) float32: symmetric weights by distance along a row."""
    amplitude: np.ndarray
    """(n,) float32: mean amplitude."""
    amplitude_noise: np.ndarray
    """(n,) float32: its deviation."""

    @property
    def is_linear(self) -> np.ndarray:
        """(n,) bool: the pixels that are linear in the noise."""
        return np.isfinite(self.z)


@numba.njit(**FAST)
def draw_linear_frame(  # type: ignore[no-untyped-def]
    shape,
    linear,
    normals,
    error,
    step_m,
    z_m,
    amplitude,
):
    """Draw a frame of the even and uneven pixels.

    Args:
        shape: (h, w) of the view, n pixels.
        linear: the pixels.
        normals: (2, n) float32, standard normals of each pixel's phase and amplitude.
        error: displacement of the frame in steps of half path.
        step_m: the output's step.
        z_m: (n,) float32; written, NaN at pixels that are not linear.
        amplitude: (n,) float32; written.
    """
    h, w = shape
    side = linear.taps.size
    half = side // 2
    width = w + 2 * half
    # pictures with a border of zeros, flat
    noise = np.zeros((h + 2 * half) * width, f4)
    length_noise = np.zeros(noise.size, f4)
    for y in range(h):
        row = slice(y * w, (y + 1) * w)
        start = (y + half) * width + half
        _multiply(linear.noise[row], normals[0, row], noise[start : start + w])
        length_noise[start : start + w] = normals[1, row]

    # row by row, so that what is read again is still in the processor's innermost cache
    unit_taps = linear.taps / np.sqrt((linear.taps * linear.taps).sum())
    down = np.empty(width, f4)
    sums = np.empty(w, f4)
    m = 0
    for y in range(h):
        row = slice(y * w, (y + 1) * w)
        centre = (y + half) * width + half
        # the amplitude of all pixels as if they were even, then that of the others
        _sum_over(length_noise, y * width, width, unit_taps, down)
        _sum_over(down, 0, 1, unit_taps, sums)
        _move_amplitude(linear.amplitude[row], linear.amplitude_noise[row], sums, amplitude[row])
        # z, to which an uneven pixel's ``by_neighbour`` and ``by_centre`` of 0 add nothing
        _sum_over(noise, y * width, width, linear.taps, down)
        _sum_over(down, 0, 1, linear.taps, sums)
        _displace(linear.z[row], linear.by_path[row], error, z_m[row])
        _move_z(
            linear.by_neighbour[row],
            sums,
            linear.by_centre[row],
            noise[centre : centre + w],
            z_m[row],
        )
        while m < linear.uneven.size and linear.uneven[m] < (y + 1) * w:
            i = linear.uneven[m]
            start = y * width + i - y * w
            change = _window_sum(length_noise, start, width, side, linear.amplitude_moves[m])
            amplitude[i] = linear.amplitude[i] + change
            z_m[i] += _window_sum(noise, start, width, side, linear.moves[m])
            m += 1
        _round(linear.base[row], step_m, z_m[row])


@numba.njit(**FAST)
def _sum_over(values, start, stride, taps, total):  # type: ignore[no-untyped-def]
    """Write into ``total`` (n,) the sum of n values from ``start``, from ``stride`` later and so
    on, times the taps (5 k,)."""
    for q in range(0, taps.size, TOGETHER):
        s1 = np.uint64(start + q * stride)
        s2 = s1 + np.uint64(stride)
        s3 = s2 + np.uint64(stride)
        s4 = s3 + np.uint64(stride)
        s5 = s4 + np.uint64(stride)
        a = taps[q]
        b = taps[q + 1]
        c = taps[q + 2]
        d = taps[q + 3]
        e = taps[q + 4]
        for x in range(np.uint64(total.size)):
            before = total[x] if q else ZERO
            first = a * values[s1 + x] + b * values[s2 + x] + c * values[s3 + x]
            total[x] = before + first + d * values[s4 + x] + e * values[s5 + x]


@numba.njit(inline="always", **FAST)
def _window_sum(values, start, width, side, factors):  # type: ignore[no-untyped-def]
    """Return the sum of values, flat, over the window (side, side) that begins at ``start`` of a
    picture of ``width``, times the factors (side^2,)."""
    total = ZERO
    for row in range(side):
        for column in range(0, side, TOGETHER):
            s = np.uint64(start + row * width + column)
            q = np.uint64(row * side + column)
            first = factors[q] * values[s] + factors[q + TWO] * values[s + TWO]
            second = factors[q + ONE] * values[s + ONE] + factors[q + THREE] * values[s + THREE]
            total += first + second + factors[q + FOUR] * values[s + FOUR]
    return total


@numba.njit(**FAST)
def _multiply(factors, values, products):  # type: ignore[no-untyped-def]
    """Write the ``products`` of factors and values, (n,) each."""
    for x in range(np.uint64(products.size)):
        products[x] = factors[x] * values[x]


@numba.njit(**FAST)
def _move_amplitude(mean, deviation, change, amplitude):  # type: ignore[no-untyped-def]
    """Write the ``amplitude`` of n pixels, (n,) each: its mean and so many deviations."""
    for x in range(np.uint64(amplitude.size)):
        amplitude[x] = mean[x] + deviation[x] * change[x]


@numba.njit(**FAST)
def _displace(mean, by_path, error, z):  # type: ignore[no-untyped-def]
    """Write z (n,) without noise of a frame that is displaced by ``error`` steps."""
    for x in range(np.uint64(z.size)):
        z[x] = mean[x] + error * by_path[x]


@numba.njit(**FAST)
def _move_z(by_neighbour, sums, by_centre, noise, z):  # type: ignore[no-untyped-def]
    """Add to z what noise changes, by the ``sums`` of windows and the pixels' own, (n,) each."""
    for x in range(np.uint64(z.size)):
        z[x] = z[x] + by_neighbour[x] * sums[x] + by_centre[x] * noise[x]


@numba.njit(**FAST)
def _round(base, step_m, z):  # type: ignore[no-untyped-def]
    """Round z (n,) minus ``base``, in steps, and convert it to metres."""
    for x in range(np.uint64(z.size)):
        z[x] = (base[x] + np.floor(z[x] + HALF)) * step_m
