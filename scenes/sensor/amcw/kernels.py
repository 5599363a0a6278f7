"""Compiled inner loops of the continuous-wave imager up to the filtered phasor: exposure, phase-space filter.

One core, float32. Numba, because on one core it does a frame of 30,000 pixels in a few milliseconds;
tests/benchmarks/bench_sensor.py compares it with Dr.Jit and NumPy.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from scenes.sensor.normals import FAST, bits_float, float_bits

OUTSIDE = np.float32(-1)
"""The amplitude of what is beyond the border or saturated: below every floor, so that it is always dropped."""


@numba.njit(**FAST)
def expose(
    means: np.ndarray,
    sigma: np.ndarray,
    limit: np.ndarray,
    normals: np.ndarray,
    knee: np.float32,
    gains: np.ndarray,
    cosines: np.ndarray,
    sines: np.ndarray,
    unit: np.ndarray,
    amplitude: np.ndarray,
    saturated: np.ndarray,
) -> None:
    """Samples to unit phasors and amplitudes.

    ``means`` (f, k, n) noise-free samples, ``sigma`` (n,) their deviation and ``limit`` (n,) the largest that fits, in
    converter units; ``normals`` (f, k, n) standard normals; ``gains`` (f,) of the amplitudes; ``cosines`` and ``sines``
    (k,) of the phases. Writes ``unit`` (2, f, n), ``amplitude`` (f, n) and ``saturated`` (n,).
    Each sample is the difference of two wells: Poisson shot noise of both and two read noises, as a normal (beyond
    20 electrons a difference of Poissons is one to 1e-3 in distribution), cut off at the limit, then companded. A pixel
    with a saturated sample has no phasor, so that the filter takes nothing from it.
    """
    n_frequencies, n_phases, n = means.shape
    per_knee = np.float32(1) / knee
    saturated[:] = 0
    for f in range(n_frequencies):
        re = unit[0, f]
        im = unit[1, f]
        amp = amplitude[f]
        scale = gains[f] * np.float32(2.0) / np.float32(n_phases)
        for i in range(n):
            re[i] = np.float32(0)
            im[i] = np.float32(0)
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
                # the step is the power of two at or below size / knee, and 1 below the knee: the bits without mantissa
                word: Any = float_bits(size * per_knee)  # type: ignore[call-arg]
                step = max(bits_float(word & np.uint32(0x7F800000)), np.float32(1))
                code = step * np.floor(size / step + np.float32(0.5))
                sample = code if sample >= np.float32(0) else -code
                re[i] += c * sample
                im[i] += s * sample
        for i in range(n):
            a = np.sqrt(re[i] * re[i] + im[i] * im[i])
            inverse = np.float32(1) / a if a > np.float32(0) else np.float32(0)
            re[i] *= inverse
            im[i] *= inverse
            amp[i] = scale * a
    for i in range(n):
        if saturated[i]:
            unit[:, :, i] = np.float32(0)
            amplitude[:, i] = OUTSIDE


STRIDE = 2128
"""Longest padded row; not a power of two, whose multiples share the cache's lines (a factor of 4 in time where memory
lands badly). A compile-time constant: the compiler turns a loop into vector code only where it can see that
the few arrays in it do not overlap, which it does for planes a constant apart."""


@numba.njit(inline="always", **FAST)
def exp_of_sixteenth(t):  # type: ignore[no-untyped-def]
    """exp(16 t) as the sixteenth power of five terms of the series: for -0.46 <= t <= 0 the relative error is below
    2e-4 at the smallest value (7e-4), and below 1e-6 where the value exceeds 0.1."""
    e = np.float32(1 / 24) + t * np.float32(1 / 120)
    e = np.float32(1 / 6) + t * e
    e = np.float32(0.5) + t * e
    e = np.float32(1) + t * e
    e = np.float32(1) + t * e
    e = e * e
    e = e * e
    e = e * e
    return e * e


@numba.njit(**FAST)
def _add_neighbour(
    row: np.ndarray,
    start: int,
    neighbour_start: int,
    length: int,
    space: np.float32,
    by_amplitude: bool,
    total: np.ndarray,
) -> None:
    """Add one neighbour of each pixel of a row to ``total``: planes re, im, amplitude, weight, gap, rate, floor.

    The last two are input: a sixteenth of the concentration, and the least amplitude of a neighbour that counts.
    ``space`` is the weight by distance; ``by_amplitude``: whether phasors count by their amplitude as well.
    Indices are unsigned: a signed one might count from the end, and the compiler would gather element by element.
    """
    centre = np.uint64(start)
    neighbour = np.uint64(neighbour_start)
    p1 = np.uint64(STRIDE)
    p2 = np.uint64(2 * STRIDE)
    p3 = np.uint64(3 * STRIDE)
    p4 = np.uint64(4 * STRIDE)
    p5 = np.uint64(5 * STRIDE)
    p6 = np.uint64(6 * STRIDE)
    for x in range(np.uint64(length)):
        r = row[neighbour + x]
        i = row[neighbour + p1 + x]
        amplitude = row[neighbour + p2 + x]
        gap = np.float32(1) - (row[centre + x] * r + row[centre + p1 + x] * i)
        e = exp_of_sixteenth(-total[p5 + x] * gap)
        kept = amplitude >= total[p6 + x]
        e = space * e if kept else np.float32(0)
        a = e * amplitude
        v = a if by_amplitude else e
        total[x] += v * r
        total[p1 + x] += v * i
        total[p2 + x] += a
        total[p3 + x] += e
        total[p4 + x] += gap if kept else np.float32(0)


@numba.njit(**FAST)
def joint_bilateral(
    unit: np.ndarray,
    amplitude: np.ndarray,
    space: np.ndarray,
    concentration: np.float32,
    dim: np.float32,
    drop_dim: bool,
    by_amplitude: bool,
    filtered: np.ndarray,
    edge: np.ndarray,
) -> None:
    """Joint bilateral filter on the phasors of one frequency.

    ``unit`` (2, h, w), ``amplitude`` (h, w), ``space`` (2 k + 1, 2 k + 1) weights by distance. Weight of a neighbour:
    space exp(-concentration (1 - cos dphi)). A centre not brighter than ``dim`` takes all by ``space`` alone; a
    brighter one drops neighbours below ``dim`` where ``drop_dim``. Writes ``filtered`` (3, h, w): phasor (re, im; any
    length) and amplitude, and ``edge`` (h, w): the sum over kept neighbours of (1 - cos dphi)/2.
    Unit phasors are averaged, and their amplitudes beside them; ``by_amplitude`` the phasors themselves are, and the
    amplitude is the length of their mean. The window is clipped at the border.
    """
    h, w = amplitude.shape
    side = space.shape[0]
    half = side // 2
    rows = np.zeros(3 * side * STRIDE, np.float32)
    for dy in range(side):
        rows[(3 * dy + 2) * STRIDE : (3 * dy + 3) * STRIDE] = OUTSIDE
    total = np.empty(7 * STRIDE, np.float32)
    for y in range(h):
        for dy in range(-half, half + 1):
            re = 3 * (dy + half) * STRIDE
            im = re + STRIDE
            amp = im + STRIDE
            if 0 <= y + dy < h:
                # to the left and right of the picture stand the zeros and ``OUTSIDE`` of the start
                rows[re + half : re + half + w] = unit[0, y + dy]
                rows[im + half : im + half + w] = unit[1, y + dy]
                rows[amp + half : amp + half + w] = amplitude[y + dy]
            else:
                rows[amp + half : amp + half + w] = OUTSIDE
        for plane in range(5):
            total[plane * STRIDE : plane * STRIDE + w] = np.float32(0)
        for x in range(w):
            bright = amplitude[y, x] > dim
            total[5 * STRIDE + x] = concentration / np.float32(16) if bright else np.float32(0)
            total[6 * STRIDE + x] = dim if bright and drop_dim else np.float32(0)
        centre = 3 * half * STRIDE + half
        for dy in range(side):
            for dx in range(side):
                _add_neighbour(rows, centre, 3 * dy * STRIDE + dx, w, space[dy, dx], by_amplitude, total)
        for x in range(w):
            a = total[x]
            b = total[STRIDE + x]
            size = np.sqrt(a * a + b * b) if by_amplitude else total[2 * STRIDE + x]
            filtered[0, y, x] = a
            filtered[1, y, x] = b
            # nothing is kept where the whole window is saturated
            filtered[2, y, x] = size / max(total[3 * STRIDE + x], np.float32(1e-30))
            edge[y, x] = np.float32(0.5) * total[4 * STRIDE + x]
