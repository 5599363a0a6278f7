"""Compiled inner loops of the continuous-wave imager: exposure, phase-space filter. One core, float32, no allocation.

Numba, because on one core it does a frame of 30,000 pixels in a few milliseconds; tests/benchmarks/bench_sensor.py
compares it with Dr.Jit and NumPy.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numba.extending import intrinsic

from harness.vocabulary.capture import Reason

FAST: Any = {"cache": True, "fastmath": {"contract", "reassoc", "arcp", "nsz"}, "error_model": "numpy", "nogil": True}
"""No assumption of finiteness: an unlit pixel may divide by zero and is gated out later."""

TWO_PI = np.float32(2.0 * math.pi)


@numba.njit(**FAST)
def normals_from_bits(bits: np.ndarray, out: np.ndarray) -> None:
    """Standard normals (2 n,) float32 from uniform 32-bit words (2 n,), by Box and Muller's transform.

    Elementary functions are short polynomials so that the loop becomes vector code: a third of the time of NumPy's
    ziggurat. Relative error below 1e-5; 2^-25 as the least uniform number ends the tails at 5.9 deviations.
    """
    n = np.uint64(out.size // 2)
    for i in range(n):
        # the upper 24 bits of a word fill a float32 exactly
        u = (np.float32(bits[i] >> np.uint32(8)) + np.float32(0.5)) * np.float32(2.0**-24)
        v = np.float32(bits[n + i] >> np.uint32(8)) * np.float32(2.0**-24)
        radius = np.sqrt(np.float32(-2) * _log(u))
        sine, cosine = _sincos_turns(v)
        out[i] = radius * cosine
        out[n + i] = radius * sine


@numba.njit(inline="always", **FAST)
def _log(u):  # type: ignore[no-untyped-def]
    """Natural logarithm of a positive float32: exponent from the bits, mantissa by an atanh series."""
    word: Any = _float_bits(u)  # type: ignore[call-arg]
    exponent = np.int32(word >> np.uint32(23)) - np.int32(127)
    mantissa = _bits_float((word & np.uint32(0x007FFFFF)) | np.uint32(0x3F800000))
    big = mantissa > np.float32(1.41421356)
    mantissa = mantissa * np.float32(0.5) if big else mantissa
    exponent = exponent + np.int32(1) if big else exponent
    q = (mantissa - np.float32(1)) / (mantissa + np.float32(1))
    s = q * q
    series = np.float32(2 / 3) + s * (np.float32(2 / 5) + s * (np.float32(2 / 7) + s * np.float32(2 / 9)))
    return np.float32(exponent) * np.float32(0.69314718) + q * (np.float32(2) + s * series)


@numba.njit(inline="always", **FAST)
def _sincos_turns(v):  # type: ignore[no-untyped-def]
    """Sine and cosine of v turns, 0 <= v < 1: reduced to an eighth of a turn, Taylor to x^7 and x^8 (error 4e-7)."""
    quarter = np.floor(v * np.float32(4) + np.float32(0.5))
    x = (v - quarter * np.float32(0.25)) * TWO_PI
    x2 = x * x
    sine = x * (np.float32(1) + x2 * (np.float32(-1 / 6) + x2 * (np.float32(1 / 120) + x2 * np.float32(-1 / 5040))))
    cosine = np.float32(1) + x2 * (
        np.float32(-0.5) + x2 * (np.float32(1 / 24) + x2 * (np.float32(-1 / 720) + x2 * np.float32(1 / 40320)))
    )
    k = np.int32(quarter)
    odd = (k & np.int32(1)) == np.int32(1)
    a = cosine if odd else sine
    b = sine if odd else cosine
    a = -a if (k & np.int32(2)) != np.int32(0) else a
    b = -b if ((k + np.int32(1)) & np.int32(2)) != np.int32(0) else b
    return a, b


@intrinsic
def _float_bits(context, value):  # type: ignore[no-untyped-def]
    """The bits of a float32 as a uint32."""

    def build(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.bitcast(args[0], context.get_value_type(numba.types.uint32))

    return numba.types.uint32(numba.types.float32), build


@intrinsic
def _bits_float(context, value):  # type: ignore[no-untyped-def]
    """The float32 whose bits are a uint32."""

    def build(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.bitcast(args[0], context.get_value_type(numba.types.float32))

    return numba.types.float32(numba.types.uint32), build


@numba.njit(**FAST)
def expose(
    means: np.ndarray,
    sigma: np.ndarray,
    normals: np.ndarray,
    knee: np.float32,
    full_scale: np.float32,
    cosines: np.ndarray,
    sines: np.ndarray,
    unit: np.ndarray,
    amplitude: np.ndarray,
    saturated: np.ndarray,
) -> None:
    """Samples to unit phasors and amplitudes.

    ``means`` (f, k, n) noise-free samples and ``sigma`` (n,) their deviation, in converter units; ``normals`` (f, k, n)
    standard normals. Writes ``unit`` (2, f, n), ``amplitude`` (f, n) and ``saturated`` (n,).
    Each sample is the difference of two wells: Poisson shot noise of both and two read noises, as a normal (beyond
    20 electrons a difference of Poissons is one to 1e-3 in distribution), then companded.
    """
    n_frequencies, n_phases, n = means.shape
    scale = np.float32(2.0) / np.float32(n_phases)
    saturated[:] = 0
    for f in range(n_frequencies):
        re = unit[0, f]
        im = unit[1, f]
        amp = amplitude[f]
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
                saturated[i] |= np.uint8(size > full_scale)
                # the companding step doubles with each octave above twice the knee: 2 at 2 knees, 4 at 4 knees ...
                step = np.float32(1)
                octave = knee * np.float32(2)
                for _ in range(6):
                    step = np.float32(2) * step if size >= octave else step
                    octave *= np.float32(2)
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


STRIDE = 2128
"""Longest padded row; not a power of two, whose multiples share the cache's lines (a factor of 4 in time where memory
lands badly). A compile-time constant: the compiler turns a loop into vector code only where it can see that
the few arrays in it do not overlap, which it does for planes a constant apart."""


@numba.njit(**FAST)
def _add_neighbour(
    row: np.ndarray, start: int, neighbour_start: int, length: int, rate: np.float32, dim: np.float32, total: np.ndarray
) -> None:
    """Add one neighbour of each pixel of a row to ``total``: planes re, im, amplitude, weight, cos dphi.

    Indices are unsigned: a signed one might count from the end, and the compiler would gather element by element.
    """
    centre = np.uint64(start)
    neighbour = np.uint64(neighbour_start)
    p1 = np.uint64(STRIDE)
    p2 = np.uint64(2 * STRIDE)
    p3 = np.uint64(3 * STRIDE)
    p4 = np.uint64(4 * STRIDE)
    for x in range(np.uint64(length)):
        r = row[neighbour + x]
        i = row[neighbour + p1 + x]
        cosine = row[centre + x] * r + row[centre + p1 + x] * i
        # exp(t) = (exp(t/16))^16 with five terms of the series: |t/16| <= 0.46, relative error below 2e-4 at the
        # smallest weight (7e-4) and below 1e-6 where the weight exceeds 0.1
        t = rate * (cosine - np.float32(1))
        e = np.float32(1 / 24) + t * np.float32(1 / 120)
        e = np.float32(1 / 6) + t * e
        e = np.float32(0.5) + t * e
        e = np.float32(1) + t * e
        e = np.float32(1) + t * e
        e = e * e
        e = e * e
        e = e * e
        e = e * e
        e = e if row[centre + p2 + x] > dim else np.float32(1)
        total[x] += e * r
        total[p1 + x] += e * i
        total[p2 + x] += e * row[neighbour + p2 + x]
        total[p3 + x] += e
        total[p4 + x] += cosine


@numba.njit(**FAST)
def joint_bilateral(
    unit: np.ndarray,
    amplitude: np.ndarray,
    half: int,
    concentration: np.float32,
    dim: np.float32,
    filtered: np.ndarray,
    edge: np.ndarray,
) -> None:
    """Joint bilateral filter on the unit phasors of one frequency.

    ``unit`` (2, h, w), ``amplitude`` (h, w). Weight of a neighbour: exp(-concentration (1 - cos dphi)), 1 where the
    centre is not brighter than ``dim``. Writes ``filtered`` (3, h, w): phasor (re, im; any length) and mean amplitude,
    and ``edge`` (h, w): the sum over the window of (1 - cos dphi)/2. The window is clipped at the border: beyond it
    stand phasors of length 0, whose part in the sums of weights is known and taken off again.
    """
    h, w = amplitude.shape
    rate = np.float32(concentration / 16.0)
    side = 2 * half + 1
    rows = np.zeros(3 * side * STRIDE, np.float32)
    total = np.empty(5 * STRIDE, np.float32)
    outside_weight = np.float32(math.exp(-concentration))
    for y in range(h):
        for dy in range(-half, half + 1):
            base = 3 * (dy + half) * STRIDE
            if 0 <= y + dy < h:
                rows[base + half : base + half + w] = unit[0, y + dy]
                rows[base + STRIDE + half : base + STRIDE + half + w] = unit[1, y + dy]
                rows[base + 2 * STRIDE + half : base + 2 * STRIDE + half + w] = amplitude[y + dy]
            else:
                rows[base : base + 3 * STRIDE] = np.float32(0)
        total[:] = np.float32(0)
        centre = 3 * half * STRIDE + half
        for dy in range(-half, half + 1):
            for dx in range(-half, half + 1):
                _add_neighbour(rows, centre, 3 * (dy + half) * STRIDE + half + dx, w, rate, dim, total)
        tall = min(half, y) + min(half, h - 1 - y) + 1
        for x in range(w):
            inside = np.float32(tall * (min(half, x) + min(half, w - 1 - x) + 1))
            outside = np.float32(side * side) - inside
            lost = outside * (outside_weight if amplitude[y, x] > dim else np.float32(1))
            filtered[0, y, x] = total[x]
            filtered[1, y, x] = total[STRIDE + x]
            filtered[2, y, x] = total[2 * STRIDE + x] / (total[3 * STRIDE + x] - lost)
            edge[y, x] = np.float32(0.5) * (inside - total[4 * STRIDE + x])


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


@numba.njit(inline="always", **FAST)
def _half_path(t0, t1, t2, combination, wraps, rows, columns, offset, metres_per_turn, m):  # type: ignore[no-untyped-def]
    """Half the light's path in metres and the squared lattice residual in turns^2; residual infinite where no wrap
    counts fit. ``wraps`` (3, rows * columns) and the rest are from `scenes.sensor.amcw.unwrap`."""
    ka = -np.floor(combination[0, 0] * t0 + combination[0, 1] * t1 + combination[0, 2] * t2 + np.float32(0.5))
    kb = -np.floor(combination[1, 0] * t0 + combination[1, 1] * t1 + combination[1, 2] * t2 + np.float32(0.5))
    a = np.int32(ka) + np.int32(offset[0])
    b = np.int32(kb) + np.int32(offset[1])
    outside = (a < np.int32(0)) | (a >= np.int32(rows)) | (b < np.int32(0)) | (b >= np.int32(columns))
    index = np.uint64(np.int32(0)) if outside else np.uint64(a * np.int32(columns) + b)
    n0 = wraps[0, index]
    u0 = t0 + n0
    u1 = t1 + wraps[1, index]
    u2 = t2 + wraps[2, index]
    half = metres_per_turn[0] * u0 + metres_per_turn[1] * u1 + metres_per_turn[2] * u2
    common = (m[0] * u0 + m[1] * u1 + m[2] * u2) / (m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    r0 = u0 - m[0] * common
    r1 = u1 - m[1] * common
    r2 = u2 - m[2] * common
    unknown = outside | (n0 < np.float32(0))
    return half, np.float32(np.inf) if unknown else r0 * r0 + r1 * r1 + r2 * r2


@numba.njit(**FAST)
def _phases(re: np.ndarray, im: np.ndarray, out: np.ndarray) -> None:
    for i in range(np.uint64(out.size)):
        out[i] = turns(re[i], im[i])


@numba.njit(**FAST)
def range_and_gates(
    filtered: np.ndarray,
    edge: np.ndarray,
    saturated: np.ndarray,
    geometry: np.ndarray,
    outside_mask: np.ndarray,
    tables: tuple,
    gates: tuple,
    error_m: np.float32,
    z_m: np.ndarray,
    reason: np.ndarray,
    strength: np.ndarray,
) -> None:
    """Filtered phasors (3, 3, n) to z in metres, rounded, with the first gate that each pixel fails.

    Half the path s of light from the emitter at e by the point at range r along the unit ray u is
    (r + |r u - e|)/2, so r = (4 s^2 - e.e) / (4 s - 2 u.e). ``geometry`` (3, n) is u.e, e.e, u_z. ``gates``: edge sum,
    squared lattice residual, amplitude ratio, least amplitude, least 2/3 sum, least sum times range^2 (units m^2),
    least range, greatest range, rounding step (m). ``error_m`` is added to half the path in every pixel.
    """
    combination, wraps, rows, columns, offset, metres_per_turn, lattice = tables
    g0, g1, g2, g3, g4, g5, g6, g7, g8 = gates
    # Phases in a loop of their own, where few arrays let the compiler make vector code of the arctangent.
    phase = np.empty((3, z_m.size), np.float32)
    for f in range(3):
        _phases(filtered[f, 0], filtered[f, 1], phase[f])
    n = np.uint64(z_m.size)
    for i in range(n):
        t0 = phase[0, i]
        t1 = phase[1, i]
        t2 = phase[2, i]
        a0 = filtered[0, 2, i]
        a1 = filtered[1, 2, i]
        a2 = filtered[2, 2, i]
        total = a0 + a1 + a2
        least = min(a0, min(a1, a2))
        greatest = max(a0, max(a1, a2))
        amplitude = total * np.float32(2.0 / 3.0)
        half, residual2 = _half_path(t0, t1, t2, combination, wraps, rows, columns, offset, metres_per_turn, lattice)
        half += error_m
        range_m = (np.float32(4) * half * half - geometry[1, i]) / (
            np.float32(4) * half - np.float32(2) * geometry[0, i]
        )
        steepest = max(edge[0, i], max(edge[1, i], edge[2, i]))
        # The first gate that fails names the reason, so gates are tried from the last to the first.
        code = np.int32(VALID)
        code = np.int32(LOW_REFLECTIVITY) if total * range_m * range_m < g5 else code
        code = code if (range_m >= g6) & (range_m <= g7) else np.int32(OUT_OF_RANGE)
        code = code if residual2 <= g1 else np.int32(UNWRAP)
        code = np.int32(AMPLITUDE_RATIO) if greatest - least > g2 * greatest else code
        code = np.int32(EDGE) if steepest >= g0 else code
        code = np.int32(LOW_AMPLITUDE) if (least < g3) | (amplitude < g4) else code
        code = np.int32(SATURATED) if saturated[i] != np.uint8(0) else code
        code = np.int32(OUTSIDE_MASK) if outside_mask[i] else code
        strength[i] = amplitude
        reason[i] = np.uint8(code)
        rounded = np.floor(range_m * geometry[2, i] / g8 + np.float32(0.5)) * g8
        z_m[i] = rounded if code == np.int32(VALID) else np.float32(np.nan)
