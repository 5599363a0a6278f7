"""The continuous-wave imager's engine after its filter: unwrap, fuse, gate, round. Compiled loops,
float32."""

import math
from typing import Any, NamedTuple

import numba
import numpy as np

from harness.vocabulary.geometry import Reason
from scenes.sensor.amcw.facts import UnwrapTable
from scenes.sensor.normals import FAST

f4 = np.float32
HALF = f4(0.5)
ONE = f4(1)
TWO = f4(2)
FOUR = f4(4)
INFINITE = f4(np.inf)
NAN = f4(np.nan)
PI = f4(math.pi)
HALF_PI = f4(0.5 * math.pi)
TWO_PI = f4(2.0 * math.pi)
ATAN = tuple(map(f4, (-0.0040540580, 0.0218612288, -0.0559098861, 0.0964200441)))
ATAN += tuple(map(f4, (-0.1390853351, 0.1994653599, -0.3332985605, 0.9999993329)))
"""Minimax odd polynomial of the arctangent on 0..1, highest power first (Remez, |error| < 1.2e-7
rad)."""
BLOCK = 1024
VALID, SATURATED, OUTSIDE_MASK = map(
    np.int32, (Reason.VALID, Reason.SATURATED, Reason.OUTSIDE_MASK)
)
LOW_AMPLITUDE, LOW_REFLECTIVITY = map(np.int32, (Reason.LOW_AMPLITUDE, Reason.LOW_REFLECTIVITY))
AMPLITUDE_RATIO, UNWRAP = map(np.int32, (Reason.AMPLITUDE_RATIO, Reason.UNWRAP))
EDGE, OUT_OF_RANGE = map(np.int32, (Reason.EDGE, Reason.OUT_OF_RANGE))


class Gates(NamedTuple):
    """Limits of the engine, all float32; a gate that a camera lacks is infinite or 0. ``edge``:
    sum of (1 - cos dphi)/2, in the mean of the frequencies if ``edge_mean`` is 1, else in any.
    Residual limit in turns: ``residual``, or ``residual_scale`` A^``residual_slope`` of the
    greatest amplitude A, within ``residual`` and ``residual_most``. ``ratio``: (greatest - least)
    / greatest amplitude. ``least`` amplitude and ``total`` in units, ``reflectivity`` in units
    m^2. Range counts along the optical axis if ``axial`` is 1, else along the ray."""

    edge: np.float32
    edge_mean: np.float32
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
    """The settings of `scenes.sensor.amcw.facts.FlyingPixelFacts` in metres and units, float32."""

    relative_deviation: np.float32
    least_mean: np.float32
    near_m: np.float32
    far_m: np.float32
    most_m: np.float32


class DepthEngine(NamedTuple):
    """The gates and tables that are applied after the filter. ``geometry`` (3, n), of each pixel's
    unit ray u and the emitter at e: u.e, e.e, u_z. ``outside_mask`` (n,) bool: pixels outside the
    emitter's polygon."""

    geometry: np.ndarray
    outside_mask: np.ndarray
    lattice: UnwrapTable
    gates: Gates
    flying: FlyingGate | None


@numba.njit(inline="always", **FAST)
def turns(re: np.float32, im: np.float32) -> np.float32:
    """Return the phase of (re, im) in turns, 0 <= t < 1; polynomial arctangent, error below 2e-7
    turns."""
    ax = abs(re)
    ay = abs(im)
    big = max(ax, ay)
    q = min(ax, ay) / big if big > f4(0) else f4(0)
    s = q * q
    p = ((ATAN[0] * s + ATAN[1]) * s + ATAN[2]) * s + ATAN[3]
    p = (((p * s + ATAN[4]) * s + ATAN[5]) * s + ATAN[6]) * s + ATAN[7]
    a = p * q
    a = HALF_PI - a if ay > ax else a
    a = PI - a if re < f4(0) else a
    t = a / TWO_PI
    t = ONE - t if im < f4(0) else t
    return t - ONE if t >= ONE else t


@numba.njit(**FAST)
def _phases(re: np.ndarray, im: np.ndarray, out: np.ndarray) -> None:
    for i in range(np.uint64(re.size)):
        out[i] = turns(re[i], im[i])


@numba.njit(**FAST)
def _add_scaled(scale: np.float32, plane: np.ndarray, total: np.ndarray) -> None:
    for i in range(np.uint64(total.size)):
        total[i] += scale * plane[i]


@numba.njit(**FAST)
def half_path(
    turn: np.ndarray, n: int, lattice: UnwrapTable, half: np.ndarray, residual2: np.ndarray
) -> None:
    """Convert wrapped phases (f, >= n) in turns, unwrapped in place, to half the light's path (n,)
    in metres, with the squared lattice residual (n,) in turns^2, infinite if no wrap counts fit.
    """
    n_frequencies = turn.shape[0]
    key = np.zeros(n, np.int32)
    sums = np.empty(n, np.float32)
    for row in range(n_frequencies - 1):
        sums[:] = f4(0)
        for f in range(n_frequencies):
            _add_scaled(lattice.combination[row, f], turn[f, :n], sums)
        # another whole number of each pixel's key; -1 if the key is not in the table
        size = lattice.sizes[row]
        offset = lattice.offset[row]
        for i in range(np.uint64(n)):
            digit = offset - np.int32(np.floor(sums[i] + HALF))
            outside = (digit < np.int32(0)) | (digit >= size) | (key[i] < np.int32(0))
            key[i] = np.int32(-1) if outside else key[i] * size + digit
    half[:] = f4(0)
    common = np.zeros(n, np.float32)
    norm = (lattice.lattice * lattice.lattice).sum()
    first_wraps = lattice.wraps[0]
    for i in range(n):
        unknown = key[i] < 0 or first_wraps[key[i]] < f4(0)
        residual2[i] = INFINITE if unknown else f4(0)
        key[i] = np.int32(0) if unknown else key[i]
    for f in range(n_frequencies):
        wraps = lattice.wraps[f]
        ours = turn[f, :n]
        for i in range(np.uint64(n)):
            ours[i] += wraps[np.uint64(key[i])]
        _add_scaled(lattice.metres_per_turn[f], ours, half)
        _add_scaled(lattice.lattice[f] / norm, ours, common)
    for f in range(n_frequencies):
        ours = turn[f, :n]
        m = lattice.lattice[f]
        for i in range(np.uint64(n)):
            r = ours[i] - m * common[i]
            residual2[i] += r * r


class GateInputs(NamedTuple):
    """Quantities of a pixel for the gates: amplitudes; the squared lattice residual, infinite if
    no wrap counts fit; range, and the limited range, along ray or axis. If noise leaves an
    interval, each gate gets its worse (or better) end; hence ``greatest`` beside ``brightest``,
    and ``low`` beside ``high``."""

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
def residual_limit(gates, brightest):  # type: ignore[no-untyped-def]
    """Return the largest lattice residual in turns of a pixel with a greatest amplitude
    ``brightest``."""
    if gates.residual_slope == f4(0):
        return gates.residual
    by_amplitude = gates.residual_scale * np.exp(gates.residual_slope * np.log(brightest))
    return min(gates.residual_most, max(gates.residual, np.float32(by_amplitude)))


@numba.njit(inline="always", **FAST)
def first_failed(gates, limit, at):  # type: ignore[no-untyped-def]
    """Return the code of the first gate that a pixel with a `residual_limit` fails, or VALID: the
    table of gates."""
    # the first gate that fails gives the reason, so gates are tried from the last to the first
    code = LOW_REFLECTIVITY if at.total * at.range_m * at.range_m < gates.reflectivity else VALID
    code = code if (at.low_m >= gates.nearest_m) & (at.high_m <= gates.farthest_m) else OUT_OF_RANGE
    # an infinite residual means that no wrap counts fit: no gate may pass it
    code = code if (at.residual2 < INFINITE) & (at.residual2 <= limit * limit) else UNWRAP
    code = AMPLITUDE_RATIO if at.greatest - at.least > gates.ratio * at.greatest else code
    code = EDGE if at.edge >= gates.edge else code
    return LOW_AMPLITUDE if (at.least < gates.least) | (at.total < gates.total) else code


@numba.njit(**FAST)
def first_failed_each(gates, at):  # type: ignore[no-untyped-def]
    """Return `first_failed` of n pixels (n,); each field of ``at`` is an array (n,)."""
    codes = np.empty(at.edge.size, np.uint8)
    for i in range(codes.size):
        here = GateInputs(
            at.edge[i], at.least[i], at.greatest[i], at.total[i], at.residual2[i], at.brightest[i], at.range_m[i],
            at.low_m[i], at.high_m[i],
        )  # fmt: skip
        codes[i] = first_failed(gates, residual_limit(gates, here.brightest), here)
    return codes


def ranges_of(
    filtered: np.ndarray,
    edge: np.ndarray,
    saturated: np.ndarray,
    engine: DepthEngine,
    errors_m: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Convert filtered phasors (f, 3, n) and edge sums (f, n) to z in metres (of invalid pixels
    too), the first gate that each pixel fails, and the sum of amplitudes, (n,) each. ``errors_m``
    (n,) is added to half the path."""
    n = len(errors_m)
    out = np.empty(n, f4), np.empty(n, np.uint8), np.empty(n, f4)
    _range_and_gates(filtered, edge, saturated, *engine[:4], errors_m.astype(f4), *out)
    return out


@numba.njit(**FAST)
def _range_and_gates(  # type: ignore[no-untyped-def]
    filtered, edge, saturated, geometry, outside_mask, lattice, gates, errors_m, z_m, reason, total
):
    """Run `ranges_of`: r = (4 s^2 - e.e) / (4 s - 2 u.e) of half the path s by the emitter at e,
    along u."""
    n_frequencies, _, n = filtered.shape
    turn = np.empty((n_frequencies, BLOCK), np.float32)
    # loops over one array are vectorised, as no other can overlap it
    block = np.zeros((CODE + 1, BLOCK), np.float32)
    for start in range(0, n, BLOCK):
        length = min(BLOCK, n - start)
        these = slice(start, start + length)
        for f in range(n_frequencies):
            _phases(filtered[f, 0, these], filtered[f, 1, these], turn[f])
            block[AMPLITUDE, :length], block[GAP, :length] = filtered[f, 2, these], edge[f, these]
            _fold(block.reshape(block.size), f == 0)
        half_path(turn, length, lattice, block[HALF_PATH, :length], block[RESIDUAL, :length])
        block[ERROR, :length] = errors_m[these]
        block[ALONG : ALONG + 3, :length] = geometry[:, these]
        block[LIMIT] = least = min(gates.residual, gates.residual_most)
        for i in range(length if gates.residual_slope != f4(0) else 0):
            # no limit is lower than the least
            if block[RESIDUAL, i] > least * least:
                block[LIMIT, i] = residual_limit(gates, block[GREATEST, i])
        _judge(block.reshape(block.size), gates, f4(n_frequencies))
        total[these], z_m[these] = block[TOTAL, :length], block[RANGE, :length]
        _reasons(block[CODE, :length], saturated[these], outside_mask[these], reason[these])


(
    AMPLITUDE,
    GAP,
    LEAST,
    GREATEST,
    TOTAL,
    STEEPEST,
    STEPS,
    HALF_PATH,
    RESIDUAL,
    ERROR,
    ALONG,
    EMITTER,
    COSINE,
) = range(13)
LIMIT = 13
RANGE = 14
CODE = 15
"""Rows of a block: the first two of a frequency, five of all frequencies; the two before the last
of `DepthEngine`."""


@numba.njit(**FAST)
def _fold(block, first):  # type: ignore[no-untyped-def]
    """Take another frequency's amplitude and edge sum into the extremes and sums over the
    frequencies."""
    for i in range(np.uint64(BLOCK)):
        a = block[AMPLITUDE * BLOCK + i]
        e = block[GAP * BLOCK + i]
        least = block[LEAST * BLOCK + i]
        greatest = block[GREATEST * BLOCK + i]
        steepest = block[STEEPEST * BLOCK + i]
        block[LEAST * BLOCK + i] = a if first or a < least else least
        block[GREATEST * BLOCK + i] = a if first or a > greatest else greatest
        block[STEEPEST * BLOCK + i] = e if first or e > steepest else steepest
        block[TOTAL * BLOCK + i] = a if first else block[TOTAL * BLOCK + i] + a
        block[STEPS * BLOCK + i] = e if first else block[STEPS * BLOCK + i] + e


@numba.njit(**FAST)
def _judge(block, gates, n_frequencies):  # type: ignore[no-untyped-def]
    """Fill the rows of z and of the code of the first gate that fails."""
    for i in range(np.uint64(BLOCK)):
        mean = block[STEPS * BLOCK + i] / n_frequencies
        edge = mean if gates.edge_mean > f4(0) else block[STEEPEST * BLOCK + i]
        path = block[HALF_PATH * BLOCK + i] + block[ERROR * BLOCK + i]
        ratio = FOUR * path - TWO * block[ALONG * BLOCK + i]
        range_m = (FOUR * path * path - block[EMITTER * BLOCK + i]) / ratio
        z = range_m * block[COSINE * BLOCK + i]
        limited = z if gates.axial > f4(0) else range_m
        least = block[LEAST * BLOCK + i]
        greatest = block[GREATEST * BLOCK + i]
        total = block[TOTAL * BLOCK + i]
        r2 = block[RESIDUAL * BLOCK + i]
        at = GateInputs(edge, least, greatest, total, r2, greatest, range_m, limited, limited)
        block[CODE * BLOCK + i] = f4(first_failed(gates, block[LIMIT * BLOCK + i], at))
        block[RANGE * BLOCK + i] = z


@numba.njit(**FAST)
def _reasons(code, saturated, outside_mask, reason):  # type: ignore[no-untyped-def]
    for i in range(np.uint64(reason.size)):
        why = SATURATED if saturated[i] != np.uint8(0) else np.int32(code[i])
        reason[i] = np.uint8(OUTSIDE_MASK if outside_mask[i] else why)


@numba.njit(**FAST)
def find_flying(z_m, total, reason, pixels, near, gate, flying):  # type: ignore[no-untyped-def]
    """Find pixels between a nearer and a farther surface in the finished image. ``z_m``, ``total``
    and ``reason`` (m, t): t frames of m pixels. ``pixels`` (p,): those to check. ``near`` (p, 9):
    their neighbours and themselves, -1 for none. Writes ``flying`` (p, t) bool. Neighbours whose
    phases fit a distance count, even out of range."""
    window = np.empty(9, np.float32)
    for p in range(pixels.size):
        i = pixels[p]
        for t in range(z_m.shape[1]):
            flying[p, t] = False
            if reason[i, t] != VALID:
                continue
            z = z_m[i, t]
            nearest = z
            farthest = z
            size = 0
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
                # amplitudes scatter by at least the gate's share of their mean
                flying[p, t] = sample.std() >= gate.relative_deviation * max(
                    sample.mean(), gate.least_mean
                )


@numba.njit(**FAST)
def round_valid(z_m: np.ndarray, reason: np.ndarray, step_m: np.float32) -> None:
    """Round z (n,) to the output's step, NaN where ``reason`` (n,) is not VALID; in place."""
    for i in range(np.uint64(z_m.size)):
        rounded = np.floor(z_m[i] / step_m + HALF) * step_m
        z_m[i] = rounded if reason[i] == np.uint8(VALID) else NAN
