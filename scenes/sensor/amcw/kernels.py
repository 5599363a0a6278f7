"""Compiled inner loops of the continuous-wave imager up to the filtered phasor: exposure and
phase-space filter. The filter serves a full image, or a list of pixels with `LANES` frames done
together. Single-threaded, float32."""

from typing import Any, NamedTuple

import numba
import numpy as np

from scenes.sensor.normals import FAST, bits_float, float_bits, fma, normal_pair

f4 = np.float32
ZERO = f4(0)
HALF = f4(0.5)
ONE = f4(1)
C3 = f4(1 / 6)
C4 = f4(1 / 24)
# TINY: a concentration so small that all weights are 1
SMALLEST = f4(1e-30)
TINY = f4(2.0**-40)
OUTSIDE = f4(
    -1
)  # amplitude beyond the border and of saturated pixels: below every floor, so always dropped

# longest padded row of an image; a power of two would share cache lines, up to 4 times as slow
STRIDE = 2128
# frames of a listed pixel that are drawn together; loops over 8 n frames are vectorised from n = 4
# on
LANES = 56
BESIDE = (
    STRIDE // LANES
)  # listed pixels whose frames stand side by side, like the pixels of one row


@numba.njit(**FAST)
def expose(  # type: ignore[no-untyped-def]
    means, sigma, limit, normals, knee, gains, cosines, sines, unit, amplitude, saturated
):
    """Convert samples to unit phasors and amplitudes. Inputs: the fields of `imager.AmcwExposure`,
    ``normals`` (f, k, n), ``gains`` (f,), ``cosines`` and ``sines`` (k,) of the phases. Writes
    ``unit`` (2, f, n), ``amplitude`` (f, n) and ``saturated`` (n,). The difference of two wells,
    with Poisson shot noise and read noise of both, is approximated by a normal, clipped at the
    limit, then companded. A pixel with a saturated sample has no phasor."""
    n_frequencies, n_phases, n = means.shape
    per_knee = ONE / knee
    saturated[:] = 0
    for f in range(n_frequencies):
        re = unit[0, f]
        im = unit[1, f]
        amp = amplitude[f]
        scale = gains[f] * np.float32(2.0) / np.float32(n_phases)
        re[:] = ZERO
        im[:] = ZERO
        for k in range(n_phases):
            c = cosines[k]
            s = sines[k]
            mean = means[f, k]
            normal = normals[f, k]
            for i in range(n):
                sample = mean[i] + sigma[i] * normal[i]
                size = abs(sample)
                saturated[i] |= np.uint8(size > limit[i])
                size = min(size, limit[i])
                # the step is the power of two at or below size / knee, 1 below the knee: the bits
                # without the mantissa
                word: Any = float_bits(size * per_knee)
                step = max(bits_float(word & np.uint32(0x7F800000)), ONE)
                code = step * np.floor(size / step + HALF)
                sample = code if sample >= ZERO else -code
                re[i] += c * sample
                im[i] += s * sample
        for i in range(n):
            a = np.sqrt(re[i] * re[i] + im[i] * im[i])
            inverse = ONE / a if a > ZERO else ZERO
            re[i] *= inverse
            im[i] *= inverse
            amp[i] = scale * a
    for i in range(n):
        if saturated[i]:
            unit[:, :, i] = ZERO
            amplitude[:, i] = OUTSIDE


@numba.njit(inline="always", **FAST)
def _place(j, f, n_frequencies):  # type: ignore[no-untyped-def]
    """Return where the frames of listed pixel j stand in planes (rows, f, 3, stride), with
    `BESIDE` pixels a row."""
    return (j // BESIDE * n_frequencies + f) * 3 * STRIDE + j % BESIDE * LANES


@numba.njit(**FAST)
def noisy_phasors(phasor, amplitude, turn, swell, shares, words, planes, noise):  # type: ignore[no-untyped-def]
    """Write phasors (f, g) with noise of random ``words`` (g, f, lanes) uint32 into ``planes``
    (rows, f, 3, stride), at `_place` re, im, size; and into ``noise`` (g, lanes) the sum of the
    phases' normals by ``shares`` (g, f)."""
    g, n_frequencies, _ = words.shape
    noise[:] = ZERO
    flat = planes.reshape(planes.size)
    p1 = np.uint64(STRIDE)
    p2 = np.uint64(2 * STRIDE)
    for j in range(g):
        for f in range(n_frequencies):
            c = np.float32(phasor[f, j].real)
            s = np.float32(phasor[f, j].imag)
            share = shares[j, f]
            size = np.float32(amplitude[f, j])
            over = np.float32(amplitude[f, j] * turn[f, j])
            beside = np.float32(amplitude[f, j] * swell[f, j])
            start = np.uint64(_place(j, f, n_frequencies))
            for t in range(np.uint64(LANES)):
                first, second = normal_pair(words[j, f, t])
                along = size + beside * first
                across = over * second
                length = np.sqrt(along * along + across * across)
                inverse = ONE / max(length, SMALLEST)
                flat[start + t] = (c * along - s * across) * inverse
                flat[start + p1 + t] = (s * along + c * across) * inverse
                flat[start + p2 + t] = length
                noise[j, t] += share * second


TOGETHER = 5  # neighbours that are summed in one pass, which holds the sums in registers


@numba.njit(inline="always", **FAST)
def _with_neighbour(planes, at, p1, p2, weight, centre, by_amplitude, sums):  # type: ignore[no-untyped-def]
    """Return the sums over a window with one neighbour more: re, im, amplitude, weight, and minus
    the scaled gaps."""
    re, im, minus_scale, least, least_of_edge = centre
    r = planes[at]
    i = planes[at + p1]
    amplitude = planes[at + p2]
    t = fma(re, r, fma(im, i, minus_scale))
    # exp(16 t) as the sixteenth power of a series: for -0.46 <= t <= 0 the relative error is below
    # 3e-3 at the smallest value (7e-4), and below 1e-5 where the value exceeds 0.1
    e = fma(t, fma(t, fma(t, fma(t, C4, C3), HALF), ONE), ONE)
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    e = weight * e if amplitude >= least else ZERO
    a = e * amplitude
    v = a if by_amplitude else e
    gap = t if amplitude >= least_of_edge else ZERO
    return fma(v, r, sums[0]), fma(v, i, sums[1]), sums[2] + a, sums[3] + e, sums[4] + gap


class FilterSettings(NamedTuple):
    """Settings of the joint bilateral filter, float32 in its kernels. ``space`` (k, k): weights by
    distance. A centre not brighter than ``dim`` weights all neighbours by distance alone; if
    ``drop_dim``, a brighter one drops neighbours below ``dim``, which count in the edge sum if
    ``dim_edges``. ``by_amplitude``: phasors also count by amplitude."""

    space: np.ndarray
    concentration: Any
    dim: Any
    drop_dim: bool
    dim_edges: bool
    by_amplitude: bool


@numba.njit(**FAST)
def _filter_window(planes, centre, starts, space, length, settings, total, filtered, edge):  # type: ignore[no-untyped-def]
    """Filter ``length`` values side by side: pixels of a row, or frames of a pixel. ``planes``:
    flat, with re, im and amplitude `STRIDE` apart. ``centre``, ``starts`` (k,): start of the
    values and of their neighbours, of weights ``space`` (k,), k a multiple of `TOGETHER`.
    ``total``: room for 5 planes. Writes ``filtered`` (3, length) and ``edge`` (length,). Indices
    are unsigned: the compiler gathers by signed ones."""
    _, concentration, dim, drop_dim, dim_edges, by_amplitude = settings
    p1 = np.uint64(STRIDE)
    p2 = np.uint64(2 * STRIDE)
    p3 = np.uint64(3 * STRIDE)
    p4 = np.uint64(4 * STRIDE)
    middle = np.uint64(centre)
    of_bright = max(concentration / f4(16), TINY)
    least_of_bright = dim if drop_dim else ZERO
    edge_of_any = ZERO if dim_edges else dim
    for x in range(np.uint64(length)):
        total[x], total[p1 + x], total[p2 + x], total[p3 + x], total[p4 + x] = (
            ZERO,
            ZERO,
            ZERO,
            ZERO,
            ZERO,
        )
    for q in range(0, starts.size, TOGETHER):
        s1 = starts[q]
        s2 = starts[q + 1]
        s3 = starts[q + 2]
        s4 = starts[q + 3]
        s5 = starts[q + 4]
        w1 = space[q]
        w2 = space[q + 1]
        w3 = space[q + 2]
        w4 = space[q + 3]
        w5 = space[q + 4]
        for x in range(np.uint64(length)):
            bright = planes[middle + p2 + x] > dim
            scale = of_bright if bright else TINY
            least = least_of_bright if bright else ZERO
            re = scale * planes[middle + x]
            im = scale * planes[middle + p1 + x]
            own = (re, im, -scale, least, max(least, edge_of_any))
            sums = (total[x], total[p1 + x], total[p2 + x], total[p3 + x], total[p4 + x])
            sums = _with_neighbour(planes, s1 + x, p1, p2, w1, own, by_amplitude, sums)
            sums = _with_neighbour(planes, s2 + x, p1, p2, w2, own, by_amplitude, sums)
            sums = _with_neighbour(planes, s3 + x, p1, p2, w3, own, by_amplitude, sums)
            sums = _with_neighbour(planes, s4 + x, p1, p2, w4, own, by_amplitude, sums)
            sums = _with_neighbour(planes, s5 + x, p1, p2, w5, own, by_amplitude, sums)
            total[x], total[p1 + x], total[p2 + x], total[p3 + x], total[p4 + x] = sums
    for x in range(np.uint64(length)):
        a = total[x]
        b = total[p1 + x]
        size = np.sqrt(a * a + b * b) if by_amplitude else total[p2 + x]
        filtered[0, x] = a
        filtered[1, x] = b
        # nothing is kept if the whole window is saturated
        filtered[2, x] = size / max(total[p3 + x], SMALLEST)
        edge[x] = -HALF * total[p4 + x] / (of_bright if planes[middle + p2 + x] > dim else TINY)


@numba.njit(**FAST)
def _padded(space):  # type: ignore[no-untyped-def]
    """Return the weights of a window, flat, with zeros up to a multiple of `TOGETHER`."""
    weights = np.zeros((space.size + TOGETHER - 1) // TOGETHER * TOGETHER, np.float32)
    weights[: space.size] = space.ravel()
    return weights


@numba.njit(**FAST)
def filter_image(unit, amplitude, settings, filtered, edge):  # type: ignore[no-untyped-def]
    """Filter the phasors of one frequency, ``unit`` (2, h, w) and ``amplitude`` (h, w), with
    weights space exp(-concentration (1 - cos dphi)); the window is clipped at the border. Writes
    ``filtered`` (3, h, w): phasor (re, im; any length) and amplitude, and ``edge`` (h, w): the sum
    over kept neighbours of (1 - cos dphi)/2."""
    h, w = amplitude.shape
    side = settings.space.shape[0]
    half = side // 2
    # the last row stays outside, and so do the neighbours that fill up the list
    rows = np.zeros(3 * (side + 1) * STRIDE, np.float32)
    space = _padded(settings.space)
    starts = np.full(space.size, np.uint64(3 * side * STRIDE))
    for row in range(side + 1):
        rows[(3 * row + 2) * STRIDE : (3 * row + 3) * STRIDE] = OUTSIDE
    total = np.empty(5 * STRIDE, np.float32)
    for y in range(-half, h):
        # picture row y is row y modulo ``side``; beside the picture, the initial zeros and
        # ``OUTSIDE`` remain
        re = 3 * ((y + half) % side) * STRIDE + half
        if y + half < h:
            rows[re : re + w] = unit[0, y + half]
            rows[re + STRIDE : re + STRIDE + w] = unit[1, y + half]
            rows[re + 2 * STRIDE : re + 2 * STRIDE + w] = amplitude[y + half]
        else:
            rows[re + 2 * STRIDE : re + 2 * STRIDE + w] = OUTSIDE
        for q in range(side * side if y >= 0 else 0):
            starts[q] = 3 * ((y + half + 1 + q // side) % side) * STRIDE + q % side
        if y >= 0:
            centre = 3 * (y % side) * STRIDE + half
            _filter_window(rows, centre, starts, space, w, settings, total, filtered[:, y], edge[y])


@numba.njit(**FAST)
def filter_listed(planes, window, settings, filtered, edge):  # type: ignore[no-untyped-def]
    """Filter listed pixels as `filter_image` does. ``planes`` (rows + 1, f, 3, stride): from
    `noisy_phasors`; the last row is overwritten. ``window`` (m, k): indices of its pixels, -1 for
    none. Writes ``filtered`` (f, 3, m, lanes) and ``edge`` (f, m, lanes)."""
    n_frequencies, _, m, _ = filtered.shape
    planes[-1] = OUTSIDE
    flat = planes.reshape(planes.size)
    space = _padded(settings.space)
    k = window.shape[1]
    none = (len(planes) - 1) * n_frequencies * 3 * STRIDE
    total = np.empty(5 * STRIDE, np.float32)
    starts = np.full(space.size, np.uint64(none))
    for p in range(m):
        for f in range(n_frequencies):
            for q in range(k):
                starts[q] = _place(window[p, q], f, n_frequencies) if window[p, q] >= 0 else none
            out = filtered[f, :, p], edge[f, p]
            _filter_window(flat, starts[k // 2], starts, space, LANES, settings, total, *out)
