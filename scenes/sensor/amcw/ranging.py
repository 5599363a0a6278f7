"""Compiled inner loops of the continuous-wave imager's engine after its filter: unwrap, fuse, gate, round.

One core, float32, in blocks of pixels that stay in the nearest cache, a few arrays a loop so that most are vector code.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from harness.vocabulary.capture import Reason
from scenes.sensor.amcw.unwrap import Lattice
from scenes.sensor.normals import FAST

TWO_PI = np.float32(2.0 * math.pi)
BLOCK = 1024

VALID, SATURATED, LOW_AMPLITUDE, AMPLITUDE_RATIO, UNWRAP, EDGE, OUT_OF_RANGE, OUTSIDE_MASK, LOW_REFLECTIVITY = (
    int(Reason[name])
    for name in (
        "VALID",
        "SATURATED",
        "LOW_AMPLITUDE",
        "AMPLITUDE_RATIO",
        "UNWRAP",
        "EDGE",
        "OUT_OF_RANGE",
        "OUTSIDE_MASK",
        "LOW_REFLECTIVITY",
    )
)


class Gates(NamedTuple):
    """Limits of the engine, all float32; a gate that a camera lacks is infinite or 0.

    ``edge``: sum of (1 - cos dphi)/2. Residual limit in turns: ``residual``, or ``residual_scale`` A^``residual_slope``
    of the brightest frequency's amplitude A within ``residual`` and ``residual_most``. ``ratio``: (greatest - least) /
    greatest amplitude. ``least`` amplitude and ``total`` of amplitudes in units, ``reflectivity`` in units m^2.
    ``nearest_m`` and ``farthest_m``, along the optical axis where ``axial`` is 1, along the ray where it is 0.
    """

    edge: np.float32
    residual: np.float32
    residual_most: np.float32
    residual_scale: np.float32
    residual_slope: np.float32
    ratio: np.float32
    least: np.float32
    total: np.float32
    reflectivity: np.float32
    nearest_m: np.float32
    farthest_m: np.float32
    axial: np.float32


class FlyingGate(NamedTuple):
    """`scenes.sensor.amcw.facts.FlyingPixelFacts` in metres and units, float32."""

    relative_deviation: np.float32
    least_mean: np.float32
    near_m: np.float32
    far_m: np.float32
    most_m: np.float32


@numba.njit(inline="always", **FAST)
def turns(re: np.float32, im: np.float32) -> np.float32:
    """Phase of (re, im) in turns, 0 <= t < 1; polynomial arctangent, error below 2e-7 turns."""
    ax = abs(re)
    ay = abs(im)
    big = max(ax, ay)
    q = min(ax, ay) / big if big > np.float32(0) else np.float32(0)
    s = q * q
    # minimax odd polynomial of atan on 0..1, degree 15 (Remez, |error| < 1.2e-7 rad)
    p = np.float32(-0.0040540580)
    p = p * s + np.float32(0.0218612288)
    p = p * s + np.float32(-0.0559098861)
    p = p * s + np.float32(0.0964200441)
    p = p * s + np.float32(-0.1390853351)
    p = p * s + np.float32(0.1994653599)
    p = p * s + np.float32(-0.3332985605)
    p = p * s + np.float32(0.9999993329)
    a = p * q
    a = np.float32(0.5 * math.pi) - a if ay > ax else a
    a = np.float32(math.pi) - a if re < np.float32(0) else a
    t = a / TWO_PI
    t = np.float32(1) - t if im < np.float32(0) else t
    return t - np.float32(1) if t >= np.float32(1) else t


@numba.njit(**FAST)
def _phases(re: np.ndarray, im: np.ndarray, out: np.ndarray) -> None:
    for i in range(np.uint64(re.size)):
        out[i] = turns(re[i], im[i])


@numba.njit(**FAST)
def _add_scaled(scale: np.float32, plane: np.ndarray, total: np.ndarray) -> None:
    for i in range(np.uint64(total.size)):
        total[i] += scale * plane[i]


@numba.njit(**FAST)
def _add_wraps(wraps: np.ndarray, key: np.ndarray, turn: np.ndarray) -> None:
    for i in range(np.uint64(turn.size)):
        turn[i] += wraps[np.uint64(key[i])]


@numba.njit(**FAST)
def _add_square(turn: np.ndarray, m: np.float32, common: np.ndarray, total: np.ndarray) -> None:
    for i in range(np.uint64(turn.size)):
        r = turn[i] - m * common[i]
        total[i] += r * r


@numba.njit(**FAST)
def _add_digit(sums: np.ndarray, size: np.int32, offset: np.int32, key: np.ndarray) -> None:
    """One more whole number of the key of each pixel, -1 where it names no entry of the table."""
    for i in range(np.uint64(key.size)):
        digit = offset - np.int32(np.floor(sums[i] + np.float32(0.5)))
        outside = (digit < np.int32(0)) | (digit >= size) | (key[i] < np.int32(0))
        key[i] = np.int32(-1) if outside else key[i] * size + digit


@numba.njit(**FAST)
def half_path(turn: np.ndarray, n: int, lattice: Lattice, half: np.ndarray, residual2: np.ndarray) -> None:
    """Wrapped phases (f, >= n) in turns to half the light's path (n,) in metres, and the squared lattice residual (n,)
    in turns^2, infinite where no wrap counts fit. The first n columns of ``turn`` are unwrapped in place."""
    n_frequencies = turn.shape[0]
    key = np.zeros(n, np.int32)
    sums = np.empty(n, np.float32)
    for row in range(n_frequencies - 1):
        sums[:] = np.float32(0)
        for f in range(n_frequencies):
            _add_scaled(lattice.combination[row, f], turn[f, :n], sums)
        _add_digit(sums, lattice.sizes[row], lattice.offset[row], key)
    half[:] = np.float32(0)
    common = np.zeros(n, np.float32)
    norm = (lattice.lattice * lattice.lattice).sum()
    first_wraps = lattice.wraps[0]
    for i in range(n):
        unknown = key[i] < 0 or first_wraps[key[i]] < np.float32(0)
        residual2[i] = np.float32(np.inf) if unknown else np.float32(0)
        key[i] = np.int32(0) if unknown else key[i]
    for f in range(n_frequencies):
        _add_wraps(lattice.wraps[f], key, turn[f, :n])
        _add_scaled(lattice.metres_per_turn[f], turn[f, :n], half)
        _add_scaled(lattice.lattice[f] / norm, turn[f, :n], common)
    for f in range(n_frequencies):
        _add_square(turn[f, :n], lattice.lattice[f], common, residual2)


@numba.njit(inline="always", **FAST)
def _residual_limit2(gates: Gates, greatest: np.float32) -> np.float32:
    """The squared lattice residual in turns^2 that a pixel of that amplitude may have."""
    limit = gates.residual
    if gates.residual_slope != np.float32(0):
        by_amplitude = gates.residual_scale * np.exp(gates.residual_slope * np.log(greatest))
        limit = min(gates.residual_most, max(limit, np.float32(by_amplitude)))
    return limit * limit


@numba.njit(**FAST)
def _gate(  # type: ignore[no-untyped-def]
    start, stop, filtered, edge, saturated, geometry, outside_mask, gates, half, residual2, errors_m, z_m, reason, total
):
    """Pixels ``start`` to ``stop`` of `range_and_gates`; ``half`` and ``residual2`` of these from `half_path`."""
    n_frequencies = filtered.shape[0]
    for i in range(start, stop):
        least = filtered[0, 2, i]
        greatest = least
        sum_of_all = least
        steepest = edge[0, i]
        for f in range(1, n_frequencies):
            a = filtered[f, 2, i]
            least = min(least, a)
            greatest = max(greatest, a)
            sum_of_all += a
            steepest = max(steepest, edge[f, i])
        path = half[i - start] + errors_m[i]
        range_m = (np.float32(4) * path * path - geometry[1, i]) / (
            np.float32(4) * path - np.float32(2) * geometry[0, i]
        )
        z = range_m * geometry[2, i]
        limited = z if gates.axial > np.float32(0) else range_m
        # The first gate that fails names the reason, so gates are tried from the last to the first.
        code = np.int32(VALID)
        code = np.int32(LOW_REFLECTIVITY) if sum_of_all * range_m * range_m < gates.reflectivity else code
        code = code if (limited >= gates.nearest_m) & (limited <= gates.farthest_m) else np.int32(OUT_OF_RANGE)
        # an infinite residual says that no wrap counts fit: no gate may let it through
        known = residual2[i - start] < np.float32(np.inf)
        fits = known & (residual2[i - start] <= _residual_limit2(gates, greatest))
        code = code if fits else np.int32(UNWRAP)
        code = np.int32(AMPLITUDE_RATIO) if greatest - least > gates.ratio * greatest else code
        code = np.int32(EDGE) if steepest >= gates.edge else code
        code = np.int32(LOW_AMPLITUDE) if (least < gates.least) | (sum_of_all < gates.total) else code
        code = np.int32(SATURATED) if saturated[i] != np.uint8(0) else code
        code = np.int32(OUTSIDE_MASK) if outside_mask[i] else code
        total[i] = sum_of_all
        reason[i] = np.uint8(code)
        z_m[i] = z


@numba.njit(**FAST)
def range_and_gates(
    filtered: np.ndarray,
    edge: np.ndarray,
    saturated: np.ndarray,
    geometry: np.ndarray,
    outside_mask: np.ndarray,
    lattice: Lattice,
    gates: Gates,
    errors_m: np.ndarray,
    z_m: np.ndarray,
    reason: np.ndarray,
    total: np.ndarray,
) -> None:
    """Filtered phasors (f, 3, n) to z in metres, with the first gate that each pixel fails and the sum of amplitudes.

    Half the path s of light from the emitter at e by the point at range r along the unit ray u is
    (r + |r u - e|)/2, so r = (4 s^2 - e.e) / (4 s - 2 u.e). ``geometry`` (3, n) is u.e, e.e, u_z. ``errors_m`` (n,) is
    added to half the path. z is written for invalid pixels too.
    """
    n_frequencies, _, n = filtered.shape
    turn = np.empty((n_frequencies, BLOCK), np.float32)
    half = np.empty(BLOCK, np.float32)
    residual2 = np.empty(BLOCK, np.float32)
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        length = stop - start
        for f in range(n_frequencies):
            _phases(filtered[f, 0, start:stop], filtered[f, 1, start:stop], turn[f])
        half_path(turn, length, lattice, half[:length], residual2[:length])
        _gate(
            start,
            stop,
            filtered,
            edge,
            saturated,
            geometry,
            outside_mask,
            gates,
            half,
            residual2,
            errors_m,
            z_m,
            reason,
            total,
        )


@numba.njit(**FAST)
def gate_flying_pixels(z_m: np.ndarray, total: np.ndarray, reason: np.ndarray, gate: FlyingGate) -> None:
    """Mark pixels between a nearer and a farther surface as EDGE in ``reason`` (h, w), from ``z_m`` and ``total``
    (h, w) of all pixels. Neighbours whose phases fit a distance count, even out of range; the window is clipped."""
    h, w = z_m.shape
    # a pixel that this gate marks still counts as a neighbour of the next ones
    measured = (reason == VALID) | (reason == OUT_OF_RANGE) | (reason == LOW_REFLECTIVITY)
    for y in range(h):
        for x in range(w):
            if reason[y, x] != VALID:
                continue
            z = z_m[y, x]
            nearest = z
            farthest = z
            for v in range(max(y - 1, 0), min(y + 2, h)):
                for u in range(max(x - 1, 0), min(x + 2, w)):
                    if measured[v, u]:
                        nearest = min(nearest, z_m[v, u])
                        farthest = max(farthest, z_m[v, u])
            between = z - nearest > gate.near_m and farthest - z > gate.far_m
            if between and max(z - nearest, farthest - z) > gate.most_m and _uneven(total, y, x, gate):
                reason[y, x] = EDGE


@numba.njit(**FAST)
def _uneven(total: np.ndarray, y: int, x: int, gate: FlyingGate) -> bool:
    """Whether amplitudes scatter by the gate's share of their mean over the 3x3 window of a pixel."""
    h, w = total.shape
    window = total[max(y - 1, 0) : min(y + 2, h), max(x - 1, 0) : min(x + 2, w)]
    return window.std() >= gate.relative_deviation * max(window.mean(), gate.least_mean)


@numba.njit(**FAST)
def round_valid(z_m: np.ndarray, reason: np.ndarray, step_m: np.float32) -> None:
    """Round z (n,) to the output's step, NaN where ``reason`` (n,) is not VALID; in place."""
    for i in range(np.uint64(z_m.size)):
        rounded = np.floor(z_m[i] / step_m + np.float32(0.5)) * step_m
        z_m[i] = rounded if reason[i] == np.uint8(VALID) else np.float32(np.nan)
