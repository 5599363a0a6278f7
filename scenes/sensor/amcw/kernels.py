"""Compiled inner loops of the continuous-wave imager up to the filtered phasor: exposure and phase-space filter. The
filter serves a full image, or a list of pixels with `LANES` frames done together. Single-threaded, float32."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

from scenes.sensor.normals import FAST, bits_float, float_bits

f4 = np.float32
ZERO, HALF, ONE = f4(0), f4(0.5), f4(1)
C2, C3, C4, C5 = HALF, f4(1 / 6), f4(1 / 24), f4(1 / 120)
SMALLEST = f4(1e-30)
OUTSIDE = f4(-1)  # amplitude beyond the border and of saturated pixels: below every floor, so always dropped

STRIDE = 2128  # longest padded row of an image; a power of two would share cache lines, up to 4 times as slow
LANES = 56  # frames of a listed pixel that are drawn together; loops over 8 n frames are vectorised from n = 4 on
BLOCK = 3 * LANES  # numbers of one listed pixel and frequency: re, im and amplitude of all frames


@numba.njit(**FAST)
def expose(  # type: ignore[no-untyped-def]
    means, sigma, limit, normals, knee, gains, cosines, sines, unit, amplitude, saturated
):
    """Convert samples to unit phasors and amplitudes. Inputs: the fields of `imager.AmcwExposure`, ``normals`` (f, k,
    n), ``gains`` (f,), ``cosines`` and ``sines`` (k,) of the phases. Writes ``unit`` (2, f, n), ``amplitude`` (f, n)
    and ``saturated`` (n,). The difference of two wells, with Poisson shot noise and read noise of both, is approximated
    by a normal, clipped at the limit, then companded. A pixel with a saturated sample has no phasor."""
    n_frequencies, n_phases, n = means.shape
    per_knee = ONE / knee
    saturated[:] = 0
    for f in range(n_frequencies):
        re, im, amp = unit[0, f], unit[1, f], amplitude[f]
        scale = gains[f] * np.float32(2.0) / np.float32(n_phases)
        re[:] = ZERO
        im[:] = ZERO
        for k in range(n_phases):
            c, s, mean, normal = cosines[k], sines[k], means[f, k], normals[f, k]
            for i in range(n):
                sample = mean[i] + sigma[i] * normal[i]
                size = abs(sample)
                saturated[i] |= np.uint8(size > limit[i])
                size = min(size, limit[i])
                # the step is the power of two at or below size / knee, 1 below the knee: the bits without the mantissa
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


@numba.njit(**FAST)
def noisy_phasors(phasor, amplitude, turn, swell, normals, planes):  # type: ignore[no-untyped-def]
    """Write phasors (f, g) with noise of ``normals`` (g, f, 2, lanes) into ``planes`` (g, f, 3 lanes): re, im, size."""
    g, n_frequencies, _, _ = normals.shape
    p1, p2 = np.uint64(LANES), np.uint64(2 * LANES)
    for j in range(g):
        for f in range(n_frequencies):
            c, s = np.float32(phasor[f, j].real), np.float32(phasor[f, j].imag)
            size = np.float32(amplitude[f, j])
            over = np.float32(amplitude[f, j] * turn[f, j])
            beside = np.float32(amplitude[f, j] * swell[f, j])
            out = planes[j, f]
            for t in range(np.uint64(LANES)):
                along = size + beside * normals[j, f, 0, t]
                across = over * normals[j, f, 1, t]
                length = np.sqrt(along * along + across * across)
                inverse = ONE / max(length, SMALLEST)
                out[t] = (c * along - s * across) * inverse
                out[p1 + t] = (s * along + c * across) * inverse
                out[p2 + t] = length


def _filter_of(stride: int) -> Any:
    """Compile the filter of one window for ``stride`` values side by side: pixels of a row, or frames of a pixel."""

    @numba.njit(**FAST)
    def filter_window(planes, centre, starts, length, settings, total, filtered, edge):  # type: ignore[no-untyped-def]
        """Filter ``length`` values. ``planes``: flat, with re, im and amplitude ``stride`` apart. ``centre``,
        ``starts`` (k,): start of the values and of their neighbours, -1 for none. ``total``: room for 7 planes. Writes
        ``filtered`` (3, length) and ``edge`` (length,). Indices are unsigned: the compiler gathers by signed ones."""
        weights, concentration, dim, drop_dim, dim_edges, by_amplitude = settings
        space = weights.ravel()
        p1, p2, p3, p4 = np.uint64(stride), np.uint64(2 * stride), np.uint64(3 * stride), np.uint64(4 * stride)
        p5, p6 = np.uint64(5 * stride), np.uint64(6 * stride)
        middle = np.uint64(centre)
        # planes of ``total``: re, im, amplitude, weight, gap; a sixteenth of the concentration; the least amplitude of
        # a neighbour that counts
        for x in range(np.uint64(length)):
            bright = planes[middle + p2 + x] > dim
            total[x], total[p1 + x], total[p2 + x], total[p3 + x], total[p4 + x] = ZERO, ZERO, ZERO, ZERO, ZERO
            total[p5 + x] = concentration / f4(16) if bright else ZERO
            total[p6 + x] = dim if bright and drop_dim else ZERO
        for q in range(starts.size):
            if starts[q] < 0:
                continue
            neighbour = np.uint64(starts[q])
            weight = space[q]
            for x in range(np.uint64(length)):
                r = planes[neighbour + x]
                i = planes[neighbour + p1 + x]
                amplitude = planes[neighbour + p2 + x]
                gap = ONE - (planes[middle + x] * r + planes[middle + p1 + x] * i)
                # exp(16 t) as the sixteenth power of five terms of the series: for -0.46 <= t <= 0 the relative error
                # is below 2e-4 at the smallest value (7e-4), and below 1e-6 where the value exceeds 0.1
                t = -total[p5 + x] * gap
                e = ONE + t * (ONE + t * (C2 + t * (C3 + t * (C4 + t * C5))))
                e = e * e
                e = e * e
                e = e * e
                e = e * e
                kept = amplitude >= total[p6 + x]
                e = weight * e if kept else ZERO
                a = e * amplitude
                v = a if by_amplitude else e
                total[x] += v * r
                total[p1 + x] += v * i
                total[p2 + x] += a
                total[p3 + x] += e
                total[p4 + x] += gap if kept and (dim_edges or amplitude >= dim) else ZERO
        for x in range(np.uint64(length)):
            a = total[x]
            b = total[p1 + x]
            size = np.sqrt(a * a + b * b) if by_amplitude else total[p2 + x]
            filtered[0, x] = a
            filtered[1, x] = b
            # nothing is kept if the whole window is saturated
            filtered[2, x] = size / max(total[p3 + x], SMALLEST)
            edge[x] = HALF * total[p4 + x]

    return filter_window


_filter_row, _filter_frames = _filter_of(STRIDE), _filter_of(LANES)


class FilterSettings(NamedTuple):
    """Settings of the joint bilateral filter, float32 in its kernels. ``space`` (k, k): weights by distance. A centre
    not brighter than ``dim`` weights all neighbours by distance alone; if ``drop_dim``, a brighter one drops neighbours
    below ``dim``, which count in the edge sum if ``dim_edges``. ``by_amplitude``: phasors also count by amplitude."""

    space: np.ndarray
    concentration: Any
    dim: Any
    drop_dim: bool
    dim_edges: bool
    by_amplitude: bool


@numba.njit(**FAST)
def filter_image(unit, amplitude, settings, filtered, edge):  # type: ignore[no-untyped-def]
    """Filter the phasors of one frequency, ``unit`` (2, h, w) and ``amplitude`` (h, w), with weights space
    exp(-concentration (1 - cos dphi)); the window is clipped at the border. Writes ``filtered`` (3, h, w): phasor (re,
    im; any length) and amplitude, and ``edge`` (h, w): the sum over kept neighbours of (1 - cos dphi)/2."""
    h, w = amplitude.shape
    side = settings.space.shape[0]
    half = side // 2
    rows = np.zeros(3 * side * STRIDE, np.float32)
    starts = np.empty(side * side, np.int64)
    for dy in range(side):
        rows[(3 * dy + 2) * STRIDE : (3 * dy + 3) * STRIDE] = OUTSIDE
        for dx in range(side):
            starts[dy * side + dx] = 3 * dy * STRIDE + dx
    total = np.empty(7 * STRIDE, np.float32)
    for y in range(h):
        for dy in range(-half, half + 1):
            re = 3 * (dy + half) * STRIDE + half
            im = re + STRIDE
            amp = im + STRIDE
            if 0 <= y + dy < h:
                # beside the picture, the initial zeros and ``OUTSIDE`` remain
                rows[re : re + w] = unit[0, y + dy]
                rows[im : im + w] = unit[1, y + dy]
                rows[amp : amp + w] = amplitude[y + dy]
            else:
                rows[amp : amp + w] = OUTSIDE
        centre = 3 * half * STRIDE + half
        _filter_row(rows, centre, starts, w, settings, total, filtered[:, y], edge[y])


@numba.njit(**FAST)
def filter_listed(planes, window, settings, filtered, edge):  # type: ignore[no-untyped-def]
    """Filter listed pixels as `filter_image` does. ``planes`` (g, f, 3 lanes): from `noisy_phasors`. ``window`` (m, k):
    indices into them, -1 for none. Writes ``filtered`` (f, 3, m, lanes) and ``edge`` (f, m, lanes)."""
    n_frequencies, _, m, _ = filtered.shape
    flat = planes.reshape(planes.size)
    k = window.shape[1]
    starts = np.empty(k, np.int64)
    total = np.empty(7 * LANES, np.float32)
    for p in range(m):
        for f in range(n_frequencies):
            for q in range(k):
                starts[q] = (window[p, q] * n_frequencies + f) * BLOCK if window[p, q] >= 0 else -1
            centre = starts[k // 2]
            _filter_frames(flat, centre, starts, LANES, settings, total, filtered[f, :, p], edge[f, p])
