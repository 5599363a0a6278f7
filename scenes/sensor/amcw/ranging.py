"""The continuous-wave imager's engine after its filter: unwrap, fuse, gate, round. Compiled loops,
float32."""

import math
from typing import Any, NamedTuple

import numba
import numpy as np

from harness.vocabulary.geometry import Reason
from scenes.sensor.amcw.facts import UnwrapTable
from scenes.sensor.common.normals import FAST

f4 = np.float32
ZERO = f4(0)
HALF = f4(0.5)
ONE = f4(1)
TWO = f4(2)
FOUR = f4(4)
INFINITE = f4(np.inf)
NAN = f4(np.nan)
PI = f4(math.pi)
HALF_PI = f4(0.5 * math.pi)
TWO_PI = f4(2.0 * math.pi)
ATAN = (
    f4(-0.0040540580),
    f4(0.0218612288),
    f4(-0.0559098861),
    f4(0.0964200441),
    f4(-0.1390853351),
    f4(0.1994653599),
    f4(-0.3332985605),
    f4(0.9999993329),
)
"""Minimax odd polynomial of the arctangent on 0..1, highest power first (Remez, |error| < 1.2e-7
rad)."""
VALID = np.int32(Reason.VALID)
SATURATED = np.int32(Reason.SATURATED)
OUTSIDE_MASK = np.int32(Reason.OUTSIDE_MASK)
LOW_AMPLITUDE = np.int32(Reason.LOW_AMPLITUDE)
LOW_REFLECTIVITY = np.int32(Reason.LOW_REFLECTIVITY)
AMPLITUDE_RATIO = np.int32(Reason.AMPLITUDE_RATIO)
UNWRAP = np.int32(Reason.UNWRAP)
EDGE = np.int32(Reason.EDGE)
OUT_OF_RANGE = np.int32(Reason.OUT_OF_RANGE)


class Gates(NamedTuple):
    """Limits of the engine; a gate that a camera lacks is infinite or 0."""

    edge: np.float32
    """Largest edge sum: (1 - cos dphi)/2, summed over the window."""
    edge_mean: np.float32
    """1: that of the frequencies' mean counts; 0: that of any frequency."""
    residual: np.float32
    """Least limit of the lattice residual, in turns."""
    residual_most: np.float32
    """Greatest limit of the lattice residual, in turns."""
    residual_scale: np.float32
    """The limit between them is this times A^``residual_slope``, A the greatest amplitude."""
    residual_slope: np.float32
    """0: the limit is ``residual``."""
    ratio: np.float32
    """Largest (greatest - least) / greatest amplitude of the frequencies."""
    least: np.float32
    """Smallest amplitude of any frequency, in units."""
    total: np.float32
    """Smallest sum of the frequencies' amplitudes, in units."""
    reflectivity: np.float32
    """Smallest sum of amplitudes times squared range, in units m^2."""
    nearest_m: np.float32
    """Smallest range."""
    farthest_m: np.float32
    """Greatest range."""
    axial: np.float32
    """1: range counts along the optical axis; 0: along the ray."""


class FlyingGate(NamedTuple):
    """The settings of `scenes.sensor.amcw.facts.FlyingPixelFacts` in metres and units."""

    relative_deviation: np.float32
    """Smallest deviation of the window's amplitudes over their mean."""
    least_mean: np.float32
    """Smallest mean that the deviation is compared with, in units."""
    near_m: np.float32
    """A neighbour must reach more than that nearer."""
    far_m: np.float32
    """Another must reach more than that farther."""
    most_m: np.float32
    """Either must exceed that."""


class DepthEngine(NamedTuple):
    """The gates and tables that are applied after the filter."""

    geometry: np.ndarray
    """(3, n) float32: u.e, e.e and u_z of each pixel's unit ray u and the emitter at e, metres."""
    outside_mask: np.ndarray
    """(n,) bool: pixels outside the emitter's polygon."""
    lattice: UnwrapTable
    """Tables that unwrap the phases."""
    gates: Gates
    """Gates of single pixels."""
    flying: FlyingGate | None
    """Gate on the finished image; None for cameras without it."""


class GateInputs(NamedTuple):
    """Quantities of a pixel for the gates. If noise leaves an interval, each gate gets its worse
    (or better) end; hence ``greatest`` beside ``brightest``, and ``low_m`` beside ``high_m``."""

    edge: Any
    """Edge sum."""
    least: Any
    """Least amplitude of the frequencies."""
    greatest: Any
    """Greatest amplitude, for the ratio."""
    total: Any
    """Sum of the amplitudes."""
    residual2: Any
    """Squared lattice residual in turns^2, infinite if no wrap counts fit."""
    brightest: Any
    """Greatest amplitude, for the residual's limit."""
    range_m: Any
    """Range along the ray."""
    low_m: Any
    """Range along ray or axis, for the smallest range."""
    high_m: Any
    """The same, for the greatest range."""


# ---------------------------------------------------------------- phases to half the path


@numba.njit(inline="always", **FAST)
def turns(re: np.float32, im: np.float32) -> np.float32:
    """Return the phase of (re, im) in turns, 0 <= t < 1; polynomial arctangent, error below 2e-7
    turns."""
    ax = abs(re)
    ay = abs(im)
    big = max(ax, ay)
    q = min(ax, ay) / big if big > ZERO else ZERO
    s = q * q
    p = ((ATAN[0] * s + ATAN[1]) * s + ATAN[2]) * s + ATAN[3]
    p = (((p * s + ATAN[4]) * s + ATAN[5]) * s + ATAN[6]) * s + ATAN[7]
    a = p * q
    a = HALF_PI - a if ay > ax else a
    a = PI - a if re < ZERO else a
    t = a / TWO_PI
    t = ONE - t if im < ZERO else t
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
    """Convert wrapped phases to half the light's path.

    Args:
        turn: (f, n or more) phases in turns; unwrapped in place.
        n: number of pixels.
        lattice: the camera's table.
        half: (n,) half the path in metres; written.
        residual2: (n,) squared lattice residual in turns^2, infinite if no wrap counts fit;
            written.
    """
    key = np.zeros(n, np.int32)
    _find_keys(turn, lattice, key)
    first_wraps = lattice.wraps[0]
    for i in range(n):
        unknown = key[i] < 0 or first_wraps[key[i]] < ZERO
        residual2[i] = INFINITE if unknown else ZERO
        key[i] = np.int32(0) if unknown else key[i]
    # half path, and the common turns that the phases of all frequencies should have
    n_frequencies = turn.shape[0]
    norm = (lattice.lattice * lattice.lattice).sum()
    half[:] = ZERO
    common = np.zeros(n, np.float32)
    for f in range(n_frequencies):
        wraps = lattice.wraps[f]
        unwrapped = turn[f, :n]
        for i in range(np.uint64(n)):
            unwrapped[i] += wraps[np.uint64(key[i])]
        _add_scaled(lattice.metres_per_turn[f], unwrapped, half)
        _add_scaled(lattice.lattice[f] / norm, unwrapped, common)
    for f in range(n_frequencies):
        unwrapped = turn[f, :n]
        m = lattice.lattice[f]
        for i in range(np.uint64(n)):
            r = unwrapped[i] - m * common[i]
            residual2[i] += r * r


@numba.njit(**FAST)
def _find_keys(turn, lattice, key):  # type: ignore[no-untyped-def]
    """Write each pixel's ``key`` (n,) to the table of wrap counts, -1 if it is not in the table."""
    n = key.size
    sums = np.empty(n, np.float32)
    n_frequencies = turn.shape[0]
    for row in range(n_frequencies - 1):
        sums[:] = ZERO
        for f in range(n_frequencies):
            _add_scaled(lattice.combination[row, f], turn[f, :n], sums)
        # the combination of whole turns is a whole number, which is the key's next digit
        size = lattice.sizes[row]
        offset = lattice.offset[row]
        for i in range(np.uint64(n)):
            digit = offset - np.int32(np.floor(sums[i] + HALF))
            outside = (digit < np.int32(0)) | (digit >= size) | (key[i] < np.int32(0))
            key[i] = np.int32(-1) if outside else key[i] * size + digit


# ---------------------------------------------------------------- the table of gates


@numba.njit(inline="always", **FAST)
def residual_limit(gates, brightest):  # type: ignore[no-untyped-def]
    """Return the largest lattice residual in turns of a pixel with a greatest amplitude
    ``brightest``."""
    if gates.residual_slope == ZERO:
        return gates.residual
    by_amplitude = gates.residual_scale * np.exp(gates.residual_slope * np.log(brightest))
    return min(gates.residual_most, max(gates.residual, np.float32(by_amplitude)))


@numba.njit(inline="always", **FAST)
def first_failed(gates, limit, pixel):  # type: ignore[no-untyped-def]
    """Return the code of the first gate that a pixel with a `residual_limit` fails, or VALID: the
    table of gates."""
    # the first gate that fails gives the reason, so gates are tried from the last to the first
    reflectivity = pixel.total * pixel.range_m * pixel.range_m
    code = LOW_REFLECTIVITY if reflectivity < gates.reflectivity else VALID
    in_range = (pixel.low_m >= gates.nearest_m) & (pixel.high_m <= gates.farthest_m)
    code = code if in_range else OUT_OF_RANGE
    # an infinite residual means that no wrap counts fit: no gate may pass it
    unwrapped = (pixel.residual2 < INFINITE) & (pixel.residual2 <= limit * limit)
    code = code if unwrapped else UNWRAP
    code = AMPLITUDE_RATIO if pixel.greatest - pixel.least > gates.ratio * pixel.greatest else code
    code = EDGE if pixel.edge >= gates.edge else code
    return LOW_AMPLITUDE if (pixel.least < gates.least) | (pixel.total < gates.total) else code


@numba.njit(**FAST)
def first_failed_each(gates, inputs):  # type: ignore[no-untyped-def]
    """Return `first_failed` of n pixels (n,); each field of ``inputs`` is an array (n,)."""
    codes = np.empty(inputs.edge.size, np.uint8)
    for i in range(codes.size):
        pixel = GateInputs(
            edge=inputs.edge[i],
            least=inputs.least[i],
            greatest=inputs.greatest[i],
            total=inputs.total[i],
            residual2=inputs.residual2[i],
            brightest=inputs.brightest[i],
            range_m=inputs.range_m[i],
            low_m=inputs.low_m[i],
            high_m=inputs.high_m[i],
        )
        codes[i] = first_failed(gates, residual_limit(gates, pixel.brightest), pixel)
    return codes


# ---------------------------------------------------------------- filtered phasors to ranges

BLOCK = 1024  # pixels of a block, which stays in the processor's cache
# rows of a block: a frequency's
AMPLITUDE = 0
GAP = 1
# those of all frequencies
LEAST = 2
GREATEST = 3
TOTAL = 4
STEEPEST = 5
STEPS = 6
HALF_PATH = 7
RESIDUAL = 8
# those of `DepthEngine.geometry`
ALONG = 9
EMITTER = 10
COSINE = 11
# results
LIMIT = 12
RANGE = 13
CODE = 14
ROWS = 15


def ranges_of(
    filtered: np.ndarray,
    edge: np.ndarray,
    saturated: np.ndarray,
    engine: DepthEngine,
    error_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Convert filtered phasors to ranges.

    Args:
        filtered: (f, 3, n) float32, real and imaginary part and amplitude.
        edge: (f, n) float32, edge sums.
        saturated: (n,) uint8.
        engine: the engine of these pixels.
        error_m: added to half the path.

    Returns:
        z in metres (of invalid pixels too), the code of the first gate that each pixel fails, and
        the sum of amplitudes, (n,) each.
    """
    n = saturated.size
    z_m = np.empty(n, f4)
    reason = np.empty(n, np.uint8)
    total = np.empty(n, f4)
    _range_and_gates(
        filtered,
        edge,
        saturated,
        engine.geometry,
        engine.outside_mask,
        engine.lattice,
        engine.gates,
        f4(error_m),
        z_m,
        reason,
        total,
    )
    return z_m, reason, total


@numba.njit(**FAST)
def _range_and_gates(  # type: ignore[no-untyped-def]
    filtered,
    edge,
    saturated,
    geometry,
    outside_mask,
    lattice,
    gates,
    error_m,
    z_m,
    reason,
    total,
):
    """Run `ranges_of`: r = (4 s^2 - e.e) / (4 s - 2 u.e) of half the path s by the emitter at e,
    along u."""
    n_frequencies, _, n = filtered.shape
    turn = np.empty((n_frequencies, BLOCK), np.float32)
    # loops over one array are vectorised, as no other can overlap it
    block = np.zeros((ROWS, BLOCK), np.float32)
    flat = block.reshape(block.size)
    least_limit = min(gates.residual, gates.residual_most)
    for start in range(0, n, BLOCK):
        length = min(BLOCK, n - start)
        these = slice(start, start + length)
        for f in range(n_frequencies):
            _phases(filtered[f, 0, these], filtered[f, 1, these], turn[f])
            block[AMPLITUDE, :length] = filtered[f, 2, these]
            block[GAP, :length] = edge[f, these]
            _fold(flat, f == 0)
        half_path(turn, length, lattice, block[HALF_PATH, :length], block[RESIDUAL, :length])
        block[ALONG : COSINE + 1, :length] = geometry[:, these]
        block[LIMIT] = least_limit
        if gates.residual_slope != ZERO:
            for i in range(length):
                # no limit is lower than the least
                if block[RESIDUAL, i] > least_limit * least_limit:
                    block[LIMIT, i] = residual_limit(gates, block[GREATEST, i])
        _judge(flat, gates, f4(n_frequencies), error_m)
        total[these] = block[TOTAL, :length]
        z_m[these] = block[RANGE, :length]
        _reasons(block[CODE, :length], saturated[these], outside_mask[these], reason[these])


@numba.njit(**FAST)
def _fold(block, first):  # type: ignore[no-untyped-def]
    """Take another frequency's amplitude and edge sum into the extremes and sums over the
    frequencies."""
    for i in range(np.uint64(BLOCK)):
        amplitude = block[AMPLITUDE * BLOCK + i]
        edge = block[GAP * BLOCK + i]
        least = block[LEAST * BLOCK + i]
        greatest = block[GREATEST * BLOCK + i]
        steepest = block[STEEPEST * BLOCK + i]
        block[LEAST * BLOCK + i] = amplitude if first or amplitude < least else least
        block[GREATEST * BLOCK + i] = amplitude if first or amplitude > greatest else greatest
        block[STEEPEST * BLOCK + i] = edge if first or edge > steepest else steepest
        block[TOTAL * BLOCK + i] = amplitude if first else block[TOTAL * BLOCK + i] + amplitude
        block[STEPS * BLOCK + i] = edge if first else block[STEPS * BLOCK + i] + edge


@numba.njit(**FAST)
def _judge(block, gates, n_frequencies, error_m):  # type: ignore[no-untyped-def]
    """Fill the rows of z and of the code of the first gate that fails."""
    for i in range(np.uint64(BLOCK)):
        mean = block[STEPS * BLOCK + i] / n_frequencies
        edge = mean if gates.edge_mean > ZERO else block[STEEPEST * BLOCK + i]
        path = block[HALF_PATH * BLOCK + i] + error_m
        ratio = FOUR * path - TWO * block[ALONG * BLOCK + i]
        range_m = (FOUR * path * path - block[EMITTER * BLOCK + i]) / ratio
        z = range_m * block[COSINE * BLOCK + i]
        limited = z if gates.axial > ZERO else range_m
        least = block[LEAST * BLOCK + i]
        greatest = block[GREATEST * BLOCK + i]
        total = block[TOTAL * BLOCK + i]
        residual2 = block[RESIDUAL * BLOCK + i]
        pixel = GateInputs(
            edge=edge,
            least=least,
            greatest=greatest,
            total=total,
            residual2=residual2,
            brightest=greatest,
            range_m=range_m,
            low_m=limited,
            high_m=limited,
        )
        block[CODE * BLOCK + i] = f4(first_failed(gates, block[LIMIT * BLOCK + i], pixel))
        block[RANGE * BLOCK + i] = z


@numba.njit(**FAST)
def _reasons(code, saturated, outside_mask, reason):  # type: ignore[no-untyped-def]
    for i in range(np.uint64(reason.size)):
        inside = SATURATED if saturated[i] != np.uint8(0) else np.int32(code[i])
        reason[i] = np.uint8(OUTSIDE_MASK if outside_mask[i] else inside)


# ---------------------------------------------------------------- the finished image


@numba.njit(**FAST)
def find_flying(  # type: ignore[no-untyped-def]
    z_m,
    total,
    reason,
    neighbours,
    gate,
):
    """Find pixels (n,) bool between a nearer and a farther surface in the finished image.
    Neighbours whose phases fit a distance count, even out of range.

    Args:
        z_m, total, reason: (n,) from `ranges_of`.
        neighbours: (n, 9) indices of each pixel's neighbours and itself, -1 for none.
        gate: the `FlyingGate`.
    """
    flying = np.zeros(reason.size, np.bool_)
    window = np.empty(9, np.float32)
    for i in range(reason.size):
        if reason[i] != VALID:
            continue
        nearest = z_m[i]
        farthest = z_m[i]
        size = 0
        for j in neighbours[i]:
            if j < 0:
                continue
            window[size] = total[j]
            size += 1
            if reason[j] in (VALID, OUT_OF_RANGE, LOW_REFLECTIVITY):
                nearest = min(nearest, z_m[j])
                farthest = max(farthest, z_m[j])
        before = z_m[i] - nearest
        behind = farthest - z_m[i]
        between = before > gate.near_m and behind > gate.far_m
        if between and max(before, behind) > gate.most_m:
            # amplitudes scatter by at least the gate's share of their mean
            sample = window[:size]
            mean = max(sample.mean(), gate.least_mean)
            flying[i] = sample.std() >= gate.relative_deviation * mean
    return flying


@numba.njit(**FAST)
def round_valid(z_m: np.ndarray, reason: np.ndarray, step_m: np.float32) -> None:
    """Round z (n,) to the output's step, NaN where ``reason`` (n,) is not VALID; in place."""
    for i in range(np.uint64(z_m.size)):
        rounded = np.floor(z_m[i] / step_m + HALF) * step_m
        z_m[i] = rounded if reason[i] == np.uint8(VALID) else NAN
