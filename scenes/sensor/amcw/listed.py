"""Frames of the imager at some pixels only, with all of its chain: what `AmcwImager.frame` does, on a list."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from scipy import ndimage

from scenes.sensor.amcw import ranging
from scenes.sensor.amcw.kernels import exp_of_sixteenth
from scenes.sensor.amcw.linear_frames import LANES
from scenes.sensor.normals import FAST

f4 = np.float32


class Listed(NamedTuple):
    """Which pixels to simulate, by flat indices and by places in them.

    ``halo`` (g,): pixels whose light is needed; ``range`` (m,): those that get a range; ``wanted`` (p,): places in
    ``range`` of those whose verdict is wanted. ``window`` (m, k): places in ``halo`` of each range's window; ``near``
    (p, 9): places in ``range`` of the neighbours of each wanted one; -1 for none.
    """

    halo: np.ndarray
    range: np.ndarray
    wanted: np.ndarray
    window: np.ndarray
    near: np.ndarray


def list_pixels(wanted: np.ndarray, shape: tuple[int, int], side: int, flying: bool) -> Listed:
    """The list for pixels ``wanted`` (h, w) bool and a filter window of ``side``; ``flying``: whether the engine looks
    at the finished image's neighbours."""
    ranges = _grown(wanted, 1) if flying else wanted
    halo = _grown(ranges, side // 2)
    at_range, at_halo = (_places(mask) for mask in (ranges, halo))
    place = np.flatnonzero(ranges)
    return Listed(
        np.flatnonzero(halo),
        place,
        at_range.ravel()[np.flatnonzero(wanted)],
        _around(place, at_halo, side),
        _around(np.flatnonzero(wanted), at_range, 3),
    )


def _grown(mask: np.ndarray, by: int) -> np.ndarray:
    return np.asarray(ndimage.binary_dilation(mask, np.ones((2 * by + 1,) * 2, bool)))


def _places(mask: np.ndarray) -> np.ndarray:
    """(h, w) int32: the how-many-th of ``mask`` each pixel is, -1 where it is none."""
    places = np.full(mask.shape, -1, np.int32)
    places[mask] = np.arange(mask.sum())
    return places


def _around(pixels: np.ndarray, places: np.ndarray, side: int) -> np.ndarray:
    """(m, side^2): places of the windows of flat ``pixels``, row by row; -1 beyond the border."""
    half = side // 2
    padded = np.pad(places, half, constant_values=-1)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    return np.ascontiguousarray(windows.reshape(-1, side * side)[pixels])


BLOCK = 3 * LANES
"""Of one pixel and frequency, re, im and amplitude of all frames."""


@numba.njit(**FAST)
def noisy_phasors(
    phasor: np.ndarray,
    amplitude: np.ndarray,
    turn: np.ndarray,
    swell: np.ndarray,
    normals: np.ndarray,
    planes: np.ndarray,
) -> None:
    """Phasors of pixels (f, g) with noise across and along each from ``normals`` (g, f, 2, lanes) into ``planes``
    (g, f, 3 lanes): re and im of length 1, and amplitude."""
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
                inverse = np.float32(1) / max(length, np.float32(1e-30))
                out[t] = (c * along - s * across) * inverse
                out[p1 + t] = (s * along + c * across) * inverse
                out[p2 + t] = length


@numba.njit(**FAST)
def _add_frames(planes, start, neighbour_start, space, by_amplitude, total):  # type: ignore[no-untyped-def]
    """`kernels._add_neighbour` for `LANES` frames of one pixel: of flat ``planes`` the blocks at two starts; ``total``
    has planes re, im, amplitude, weight, gap, and as input a sixteenth of the concentration and the floor."""
    centre = np.uint64(start)
    neighbour = np.uint64(neighbour_start)
    p1 = np.uint64(LANES)
    p2 = np.uint64(2 * LANES)
    p3 = np.uint64(3 * LANES)
    p4 = np.uint64(4 * LANES)
    p5 = np.uint64(5 * LANES)
    p6 = np.uint64(6 * LANES)
    for x in range(np.uint64(LANES)):
        r = planes[neighbour + x]
        i = planes[neighbour + p1 + x]
        amplitude = planes[neighbour + p2 + x]
        gap = np.float32(1) - (planes[centre + x] * r + planes[centre + p1 + x] * i)
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
def filter_listed(
    planes: np.ndarray,
    window: np.ndarray,
    space: np.ndarray,
    concentration: np.float32,
    dim: np.float32,
    drop_dim: bool,
    by_amplitude: bool,
    filtered: np.ndarray,
    edge: np.ndarray,
) -> None:
    """`kernels.joint_bilateral` on listed pixels: ``planes`` (g, f, 3 lanes) of `noisy_phasors`, ``window`` (m, k)
    places among them. Writes ``filtered`` (f, 3, m, lanes) and ``edge`` (f, m, lanes)."""
    n_frequencies, _, m, _ = filtered.shape
    flat = planes.reshape(planes.size)
    k = window.shape[1]
    total = np.empty(7 * LANES, np.float32)
    for p in range(m):
        for f in range(n_frequencies):
            centre = (window[p, k // 2] * n_frequencies + f) * BLOCK
            for t in range(5 * LANES):
                total[t] = np.float32(0)
            for t in range(LANES):
                bright = flat[centre + 2 * LANES + t] > dim
                total[5 * LANES + t] = concentration / np.float32(16) if bright else np.float32(0)
                total[6 * LANES + t] = dim if bright and drop_dim else np.float32(0)
            for q in range(k):
                if window[p, q] >= 0:
                    neighbour = (window[p, q] * n_frequencies + f) * BLOCK
                    _add_frames(flat, centre, neighbour, space.flat[q], by_amplitude, total)
            for t in range(LANES):
                a, b = total[t], total[LANES + t]
                size = np.sqrt(a * a + b * b) if by_amplitude else total[2 * LANES + t]
                filtered[f, 0, p, t] = a
                filtered[f, 1, p, t] = b
                filtered[f, 2, p, t] = size / max(total[3 * LANES + t], np.float32(1e-30))
                edge[f, p, t] = np.float32(0.5) * total[4 * LANES + t]


@numba.njit(**FAST)
def gate_flying_listed(
    z_m: np.ndarray,
    total: np.ndarray,
    reason: np.ndarray,
    wanted: np.ndarray,
    near: np.ndarray,
    gate: ranging.FlyingGate,
    flying: np.ndarray,
) -> None:
    """`ranging.gate_flying_pixels` on listed pixels: ``z_m``, ``total`` and ``reason`` (m, t); ``flying`` (p, t)."""
    window = np.empty(9, np.float32)
    for p in range(wanted.size):
        i = wanted[p]
        for t in range(z_m.shape[1]):
            flying[p, t] = False
            if reason[i, t] != ranging.VALID:
                continue
            z = z_m[i, t]
            nearest, farthest, size = z, z, 0
            for j in near[p]:
                if j < 0:
                    continue
                window[size] = total[j, t]
                size += 1
                code = reason[j, t]
                if code == ranging.VALID or code == ranging.OUT_OF_RANGE or code == ranging.LOW_REFLECTIVITY:
                    nearest = min(nearest, z_m[j, t])
                    farthest = max(farthest, z_m[j, t])
            between = z - nearest > gate.near_m and farthest - z > gate.far_m
            if between and max(z - nearest, farthest - z) > gate.most_m:
                sample = window[:size]
                flying[p, t] = sample.std() >= gate.relative_deviation * max(sample.mean(), gate.least_mean)


@numba.njit(**FAST)
def add_listed(
    z_m: np.ndarray,
    reason: np.ndarray,
    strength: np.ndarray,
    flying: np.ndarray,
    wanted: np.ndarray,
    counted: np.ndarray,
    n_frequencies: int,
    step_m: np.float32,
    base: np.ndarray,
    count: np.ndarray,
    total: np.ndarray,
    squares: np.ndarray,
    amplitude: np.ndarray,
    reasons: np.ndarray,
) -> None:
    """Add the frames that are ``counted`` (t,) of listed pixels to sums (p,), and to ``reasons`` (r, p).

    ``z_m``, ``reason``, ``strength`` (sum of amplitudes) (m, t), of which ``wanted`` (p,) count; ``flying`` (p, t):
    gated on the finished image. z is rounded to whole steps, less ``base`` (p,).
    """
    share = 1.0 / n_frequencies
    for p in range(wanted.size):
        for t in range(counted.size):
            if counted[t] == np.float32(0):
                continue
            code = np.uint8(ranging.EDGE) if flying[p, t] else reason[wanted[p], t]
            reasons[code, p] += 1
            if code == ranging.VALID:
                steps = np.floor(z_m[wanted[p], t] / step_m + np.float32(0.5)) - base[p]
                count[p] += 1
                total[p] += steps
                squares[p] += steps * steps
                amplitude[p] += strength[wanted[p], t] * share
