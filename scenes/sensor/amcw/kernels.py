"""Compiled inner loops of the continuous-wave imager up to the filtered phasor: exposure and
phase-space filter. The filter serves a full image, or strips of listed pixels. Single-threaded,
float32."""

from typing import Any, NamedTuple

import numba
import numpy as np

from scenes.sensor.common.normals import FAST, bits_float, float_bits, fma

f4 = np.float32
ZERO = f4(0)
HALF = f4(0.5)
ONE = f4(1)
THIRD_FACTORIAL = f4(1 / 6)
FOURTH_FACTORIAL = f4(1 / 24)
SMALLEST = f4(1e-30)
NO_CONCENTRATION = f4(2.0**-40)  # so small that all weights are 1
# amplitude beyond the border and of saturated pixels: below every floor, so always dropped
OUTSIDE = f4(-1)
EXPONENT_BITS = np.uint32(0x7F800000)  # of a float32: the number without its mantissa

# longest padded row of an image; a power of two would share cache lines, up to 4 times as slow
STRIDE = 2128
LENGTH = 512  # columns of strips that are filtered together, which stay in the processor's cache
TOGETHER = 5  # neighbours that are summed in one pass, which holds the sums in registers


class FilterSettings(NamedTuple):
    """Settings of the joint bilateral filter, float32 in its kernels. A centre not brighter than
    ``dim`` weights all neighbours by distance alone."""

    space: np.ndarray
    """(side, side): weights by distance."""
    concentration: Any
    """c of the weight exp(-c (1 - cos dphi)) by the phase difference."""
    dim: Any
    """Amplitude in units up to which a pixel is dim."""
    drop_dim: bool
    """True if a brighter centre drops neighbours below ``dim``."""
    dim_edges: bool
    """True if neighbours below ``dim`` that are kept count in the edge sum."""
    by_amplitude: bool
    """True if phasors also count by amplitude."""


# ---------------------------------------------------------------- exposure


@numba.njit(**FAST)
def expose(  # type: ignore[no-untyped-def]
    means,
    sigma,
    limit,
    normals,
    knee,
    gains,
    cosines,
    sines,
    unit,
    amplitude,
    saturated,
):
    """Convert samples to unit phasors and amplitudes.

    The difference of two wells, with Poisson shot noise and read noise of both, is approximated by
    a normal, clipped at the limit, then companded. A pixel with a saturated sample has no phasor.

    Args:
        means, sigma, limit: as in `exposure.AmcwExposure`.
        normals: (f, k, n) standard normals.
        knee: largest sample of unit steps, halved.
        gains: (f,) that multiply the amplitudes.
        cosines, sines: (k,) of the phase steps.
        unit: (2, f, n) real and imaginary parts; written.
        amplitude: (f, n); written.
        saturated: (n,) uint8; written.
    """
    n_frequencies, n_phases, n = means.shape
    per_knee = ONE / knee
    saturated[:] = 0
    for f in range(n_frequencies):
        re = unit[0, f]
        im = unit[1, f]
        length = amplitude[f]
        scale = gains[f] * f4(2.0) / f4(n_phases)
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
                step = max(bits_float(word & EXPONENT_BITS), ONE)
                code = step * np.floor(size / step + HALF)
                sample = code if sample >= ZERO else -code
                re[i] += c * sample
                im[i] += s * sample
        for i in range(n):
            size = np.sqrt(re[i] * re[i] + im[i] * im[i])
            inverse = ONE / size if size > ZERO else ZERO
            re[i] *= inverse
            im[i] *= inverse
            length[i] = scale * size
    for i in range(n):
        if saturated[i]:
            unit[:, :, i] = ZERO
            amplitude[:, i] = OUTSIDE


# ---------------------------------------------------------------- the joint bilateral filter


@numba.njit(inline="always", **FAST)
def _with_neighbour(  # type: ignore[no-untyped-def]
    planes,
    index,
    weight,
    centre,
    by_amplitude,
    sums,
):
    """Return the sums over a window with one neighbour more.

    Args:
        planes: flat, with re, im and amplitude `STRIDE` apart.
        index: of the neighbour.
        weight: by distance.
        centre: c/16 times re and im of the centre, -c/16, the least amplitude of a neighbour, and
            that of one that counts in the edge sum.
        by_amplitude: as in `FilterSettings`.
        sums: re, im, amplitude, weight, and c/16 times minus the gaps 1 - cos dphi.
    """
    re, im, minus_scale, least, least_of_edge = centre
    r = planes[index]
    i = planes[index + np.uint64(STRIDE)]
    amplitude = planes[index + np.uint64(2 * STRIDE)]
    # -c/16 (1 - cos dphi)
    t = fma(re, r, fma(im, i, minus_scale))
    # exp(16 t) as the sixteenth power of a series: for -0.46 <= t <= 0 the relative error is below
    # 3e-3 at the smallest value (7e-4), and below 1e-5 where the value exceeds 0.1
    e = fma(t, fma(t, fma(t, fma(t, FOURTH_FACTORIAL, THIRD_FACTORIAL), HALF), ONE), ONE)
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    e = weight * e if amplitude >= least else ZERO
    carried = e * amplitude
    v = carried if by_amplitude else e
    gap = t if amplitude >= least_of_edge else ZERO
    return (
        fma(v, r, sums[0]),
        fma(v, i, sums[1]),
        sums[2] + carried,
        sums[3] + e,
        sums[4] + gap,
    )


@numba.njit(**FAST)
def _filter_window(  # type: ignore[no-untyped-def]
    planes,
    centre,
    starts,
    space,
    length,
    settings,
    total,
    filtered,
    edge,
):
    """Filter pixels side by side. Indices are unsigned: the compiler gathers by signed ones. The
    compiler makes a slower loop of the same statements in several functions, by a third.

    Args:
        planes: flat, with re, im and amplitude `STRIDE` apart.
        centre: start of the values.
        starts: (k,) starts of their neighbours, k a multiple of `TOGETHER`.
        space: (k,) weights of the neighbours by distance.
        length: number of values.
        settings: the `FilterSettings`.
        total: room for five planes.
        filtered: (3, length); written.
        edge: (length,); written.
    """
    dim = settings.dim
    by_amplitude = settings.by_amplitude
    im_plane = np.uint64(STRIDE)
    amplitude_plane = np.uint64(2 * STRIDE)
    weight_plane = np.uint64(3 * STRIDE)
    gap_plane = np.uint64(4 * STRIDE)
    middle = np.uint64(centre)
    scale_of_bright = max(settings.concentration / f4(16), NO_CONCENTRATION)
    least_of_bright = dim if settings.drop_dim else ZERO
    least_of_edge = ZERO if settings.dim_edges else dim
    for x in range(np.uint64(length)):
        total[x] = ZERO
        total[im_plane + x] = ZERO
        total[amplitude_plane + x] = ZERO
        total[weight_plane + x] = ZERO
        total[gap_plane + x] = ZERO
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
            bright = planes[middle + amplitude_plane + x] > dim
            scale = scale_of_bright if bright else NO_CONCENTRATION
            least = least_of_bright if bright else ZERO
            re = scale * planes[middle + x]
            im = scale * planes[middle + im_plane + x]
            pixel = (re, im, -scale, least, max(least, least_of_edge))
            sums = (
                total[x],
                total[im_plane + x],
                total[amplitude_plane + x],
                total[weight_plane + x],
                total[gap_plane + x],
            )
            sums = _with_neighbour(planes, s1 + x, w1, pixel, by_amplitude, sums)
            sums = _with_neighbour(planes, s2 + x, w2, pixel, by_amplitude, sums)
            sums = _with_neighbour(planes, s3 + x, w3, pixel, by_amplitude, sums)
            sums = _with_neighbour(planes, s4 + x, w4, pixel, by_amplitude, sums)
            sums = _with_neighbour(planes, s5 + x, w5, pixel, by_amplitude, sums)
            total[x] = sums[0]
            total[im_plane + x] = sums[1]
            total[amplitude_plane + x] = sums[2]
            total[weight_plane + x] = sums[3]
            total[gap_plane + x] = sums[4]
    for x in range(np.uint64(length)):
        re = total[x]
        im = total[im_plane + x]
        size = np.sqrt(re * re + im * im) if by_amplitude else total[amplitude_plane + x]
        filtered[0, x] = re
        filtered[1, x] = im
        # nothing is kept if the whole window is saturated
        filtered[2, x] = size / max(total[weight_plane + x], SMALLEST)
        bright = planes[middle + amplitude_plane + x] > dim
        scale = scale_of_bright if bright else NO_CONCENTRATION
        edge[x] = -HALF * total[gap_plane + x] / scale


@numba.njit(**FAST)
def _padded(space):  # type: ignore[no-untyped-def]
    """Return the weights of a window, flat, with zeros up to a multiple of `TOGETHER`."""
    weights = np.zeros((space.size + TOGETHER - 1) // TOGETHER * TOGETHER, np.float32)
    weights[: space.size] = space.ravel()
    return weights


@numba.njit(**FAST)
def filter_image(unit, amplitude, settings, filtered, edge):  # type: ignore[no-untyped-def]
    """Filter the phasors of one frequency, with weights space exp(-concentration (1 - cos dphi));
    the window is clipped at the border. `filter_reference.filtered_pixel` has the same in NumPy.

    Args:
        unit: (2, h, w) real and imaginary parts of unit phasors.
        amplitude: (h, w).
        settings: the `FilterSettings`.
        filtered: (3, h, w) real and imaginary part (of any length), and amplitude; written.
        edge: (h, w) sum over kept neighbours of (1 - cos dphi)/2; written.
    """
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
        below = y + half
        re = 3 * (below % side) * STRIDE + half
        im = re + STRIDE
        size = re + 2 * STRIDE
        if below < h:
            rows[re : re + w] = unit[0, below]
            rows[im : im + w] = unit[1, below]
            rows[size : size + w] = amplitude[below]
        else:
            rows[size : size + w] = OUTSIDE
        if y < 0:
            continue
        for q in range(side * side):
            starts[q] = 3 * ((below + 1 + q // side) % side) * STRIDE + q % side
        centre = 3 * (y % side) * STRIDE + half
        _filter_window(
            rows,
            centre,
            starts,
            space,
            w,
            settings,
            total,
            filtered[:, y],
            edge[y],
        )


@numba.njit(**FAST)
def filter_strips(  # type: ignore[no-untyped-def]
    unit,
    amplitude,
    strips,
    turned,
    settings,
    filtered,
    edge,
):
    """Filter windows in strips as `filter_image` does, neighbour by neighbour in the same order.

    Args:
        unit: (2, f, g) real and imaginary parts of unit phasors.
        amplitude: (f, g).
        strips: (side, s) indices of pixels; a window begins at each of the first s - side + 1
            columns.
        turned: first column of windows whose columns are rows of the picture.
        settings: the `FilterSettings`.
        filtered: (f, 3, s - side + 1) as in `filter_image`; written, without meaning where the
            columns are not neighbours in the picture.
        edge: (f, s - side + 1); written.
    """
    n_frequencies = len(amplitude)
    side = len(strips)
    half = side // 2
    # the last row stays outside, for the neighbours that fill up the list
    rows = np.zeros(3 * (side + 1) * STRIDE, np.float32)
    rows[(3 * side + 2) * STRIDE :] = OUTSIDE
    space = _padded(settings.space)
    starts = np.full(space.size, np.uint64(3 * side * STRIDE))
    total = np.empty(5 * STRIDE, np.float32)
    first = 0
    last = 0
    while last < edge.shape[1]:
        first = last
        is_turned = first >= turned
        last = min(first + LENGTH, edge.shape[1] if is_turned else min(turned, edge.shape[1]))
        for q in range(side * side):
            row = q % side if is_turned else q // side
            column = q // side if is_turned else q % side
            starts[q] = 3 * row * STRIDE + column
        for f in range(n_frequencies):
            for row in range(side):
                _gather(
                    unit[0, f],
                    unit[1, f],
                    amplitude[f],
                    strips[row, first : last + 2 * half],
                    rows[3 * row * STRIDE :],
                )
            _filter_window(
                rows,
                3 * half * STRIDE + half,
                starts,
                space,
                last - first,
                settings,
                total,
                filtered[f, :, first:last],
                edge[f, first:last],
            )


@numba.njit(**FAST)
def _gather(re, im, amplitude, indices, row):  # type: ignore[no-untyped-def]
    """Write the pixels at ``indices`` into a row of planes, `STRIDE` apart."""
    im_plane = np.uint64(STRIDE)
    amplitude_plane = np.uint64(2 * STRIDE)
    for x in range(np.uint64(indices.size)):
        i = np.uint64(indices[x])
        row[x] = re[i]
        row[im_plane + x] = im[i]
        row[amplitude_plane + x] = amplitude[i]
