"""The continuous-wave imager's engine after its filter: unwrap, fuse, gate, round.

Compiled loops for one core, float32, in blocks of pixels that stay in the nearest cache, a few arrays a loop so that
most are vector code.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np

from harness.vocabulary.capture import Reason
from scenes.sensor.amcw.unwrap import Lattice
from scenes.sensor.normals import FAST

TWO_PI = np.float32(2.0 * math.pi)
BLOCK = 1024

VALID, SATURATED, LOW_AMPLITUDE, AMPLITUDE_RATIO, UNWRAP, EDGE, OUT_OF_RANGE, OUTSIDE_MASK, LOW_REFLECTIVITY = (
    int(reason)
    for reason in (
        Reason.VALID, Reason.SATURATED, Reason.LOW_AMPLITUDE, Reason.AMPLITUDE_RATIO, Reason.UNWRAP, Reason.EDGE,
        Reason.OUT_OF_RANGE, Reason.OUTSIDE_MASK, Reason.LOW_REFLECTIVITY,
    )
)  # fmt: skip


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
    """Return the phase of (re, im) in turns, 0 <= t < 1; polynomial arctangent, error below 2e-7 turns."""
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
def half_path(turn: np.ndarray, n: int, lattice: Lattice, half: np.ndarray, residual2: np.ndarray) -> None:
    """Convert wrapped phases (f, >= n) in turns to half the light's path (n,) in metres, with the squared lattice
    residual (n,) in turns^2, infinite where no wrap counts fit. Unwraps the first n columns of ``turn`` in place."""
    n_frequencies = turn.shape[0]
    key = np.zeros(n, np.int32)
    sums = np.empty(n, np.float32)
    for row in range(n_frequencies - 1):
        sums[:] = np.float32(0)
        for f in range(n_frequencies):
            _add_scaled(lattice.combination[row, f], turn[f, :n], sums)
        # one more whole number of the key of each pixel, -1 where it names no entry of the table
        size, offset = lattice.sizes[row], lattice.offset[row]
        for i in range(np.uint64(n)):
            digit = offset - np.int32(np.floor(sums[i] + np.float32(0.5)))
            outside = (digit < np.int32(0)) | (digit >= size) | (key[i] < np.int32(0))
            key[i] = np.int32(-1) if outside else key[i] * size + digit
    half[:] = np.float32(0)
    common = np.zeros(n, np.float32)
    norm = (lattice.lattice * lattice.lattice).sum()
    first_wraps = lattice.wraps[0]
    for i in range(n):
        unknown = key[i] < 0 or first_wraps[key[i]] < np.float32(0)
        residual2[i] = np.float32(np.inf) if unknown else np.float32(0)
        key[i] = np.int32(0) if unknown else key[i]
    for f in range(n_frequencies):
        wraps, ours = lattice.wraps[f], turn[f, :n]
        for i in range(np.uint64(n)):
            ours[i] += wraps[np.uint64(key[i])]
        _add_scaled(lattice.metres_per_turn[f], ours, half)
        _add_scaled(lattice.lattice[f] / norm, ours, common)
    for f in range(n_frequencies):
        ours, m = turn[f, :n], lattice.lattice[f]
        for i in range(np.uint64(n)):
            r = ours[i] - m * common[i]
            residual2[i] += r * r


class GateInputs(NamedTuple):
    """Quantities of a pixel that the gates look at: the steepest ``edge`` sum; ``least``, ``greatest`` and ``total``
    amplitude; the squared lattice residual, infinite where no wrap counts fit, and the ``brightest`` amplitude, on
    which its limit hangs; range, and what is limited, along the ray or the axis.

    A frame has each quantity once. Where noise leaves an interval, each gate is given the end that is worse for it (or
    better), hence ``greatest`` beside ``brightest`` and ``low`` beside ``high``.
    """

    edge: Any
    least: Any
    greatest: Any
    total: Any
    residual2: Any
    brightest: Any
    range_m: Any
    low_m: Any
    high_m: Any


@numba.njit(inline="always", **FAST)
def first_failed(gates, at):  # type: ignore[no-untyped-def]
    """Return the code of the first gate that a pixel fails, VALID where it passes all: the engine's table of gates."""
    limit = gates.residual
    if gates.residual_slope != np.float32(0):
        by_amplitude = gates.residual_scale * np.exp(gates.residual_slope * np.log(at.brightest))
        limit = min(gates.residual_most, max(limit, np.float32(by_amplitude)))
    # The first gate that fails names the reason, so gates are tried from the last to the first.
    code = np.int32(VALID)
    code = np.int32(LOW_REFLECTIVITY) if at.total * at.range_m * at.range_m < gates.reflectivity else code
    code = code if (at.low_m >= gates.nearest_m) & (at.high_m <= gates.farthest_m) else np.int32(OUT_OF_RANGE)
    # an infinite residual says that no wrap counts fit: no gate may let it through
    fits = (at.residual2 < np.float32(np.inf)) & (at.residual2 <= limit * limit)
    code = code if fits else np.int32(UNWRAP)
    code = np.int32(AMPLITUDE_RATIO) if at.greatest - at.least > gates.ratio * at.greatest else code
    code = np.int32(EDGE) if at.edge >= gates.edge else code
    return np.int32(LOW_AMPLITUDE) if (at.least < gates.least) | (at.total < gates.total) else code


@numba.njit(**FAST)
def first_failed_each(gates, at):  # type: ignore[no-untyped-def]
    """Return `first_failed` of n pixels (n,); each field of ``at`` is an array (n,)."""
    codes = np.empty(at.edge.size, np.uint8)
    for i in range(codes.size):
        here = GateInputs(
            at.edge[i], at.least[i], at.greatest[i], at.total[i], at.residual2[i], at.brightest[i], at.range_m[i],
            at.low_m[i], at.high_m[i],
        )  # fmt: skip
        codes[i] = first_failed(gates, here)
    return codes


@numba.njit(**FAST)
def range_and_gates(  # type: ignore[no-untyped-def]
    filtered, edge, saturated, geometry, outside_mask, lattice, gates, errors_m, z_m, reason, total
):
    """Convert filtered phasors (f, 3, n) to z in metres, with the first gate that each pixel fails and the sum of
    amplitudes.

    Half the path s of light from the emitter at e by the point at range r along the unit ray u is
    (r + |r u - e|)/2, so r = (4 s^2 - e.e) / (4 s - 2 u.e). ``geometry`` (3, n) is u.e, e.e, u_z. ``errors_m`` (n,) is
    added to half the path. z is written for invalid pixels too.
    """
    n_frequencies, _, n = filtered.shape
    turn = np.empty((n_frequencies, BLOCK), np.float32)
    half = np.empty(BLOCK, np.float32)
    residual2 = np.empty(BLOCK, np.float32)
    for start in range(0, n, BLOCK):
        length = min(BLOCK, n - start)
        for f in range(n_frequencies):
            _phases(filtered[f, 0, start : start + length], filtered[f, 1, start : start + length], turn[f])
        half_path(turn, length, lattice, half[:length], residual2[:length])
        for i in range(start, start + length):
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
            at = GateInputs(
                steepest, least, greatest, sum_of_all, residual2[i - start], greatest, range_m, limited, limited
            )
            code = first_failed(gates, at)
            code = np.int32(SATURATED) if saturated[i] != np.uint8(0) else code
            code = np.int32(OUTSIDE_MASK) if outside_mask[i] else code
            total[i] = sum_of_all
            reason[i] = np.uint8(code)
            z_m[i] = z


@numba.njit(**FAST)
def find_flying(  # type: ignore[no-untyped-def]
    z_m, total, reason, pixels, near, gate, flying
):
    """Find pixels between a nearer and a farther surface, on the finished image.

    ``z_m``, ``total`` and ``reason`` (m, t): t frames of m pixels. ``pixels`` (p,): those in question; ``near`` (p, 9):
    their neighbours and themselves, -1 for none. Writes ``flying`` (p, t) bool. Neighbours whose phases fit a distance
    count, even out of range.
    """
    window = np.empty(9, np.float32)
    for p in range(pixels.size):
        i = pixels[p]
        for t in range(z_m.shape[1]):
            flying[p, t] = False
            if reason[i, t] != VALID:
                continue
            z = z_m[i, t]
            nearest, farthest, size = z, z, 0
            for j in near[p]:
                if j < 0:
                    continue
                window[size] = total[j, t]
                size += 1
                code = reason[j, t]
                if code in (VALID, OUT_OF_RANGE, LOW_REFLECTIVITY):
                    nearest = min(nearest, z_m[j, t])
                    farthest = max(farthest, z_m[j, t])
            between = z - nearest > gate.near_m and farthest - z > gate.far_m
            if between and max(z - nearest, farthest - z) > gate.most_m:
                sample = window[:size]
                # amplitudes scatter by the gate's share of their mean
                flying[p, t] = sample.std() >= gate.relative_deviation * max(sample.mean(), gate.least_mean)


@numba.njit(**FAST)
def round_valid(z_m: np.ndarray, reason: np.ndarray, step_m: np.float32) -> None:
    """Round z (n,) to the output's step, NaN where ``reason`` (n,) is not VALID; in place."""
    for i in range(np.uint64(z_m.size)):
        rounded = np.floor(z_m[i] / step_m + np.float32(0.5)) * step_m
        z_m[i] = rounded if reason[i] == np.uint8(VALID) else np.float32(np.nan)
