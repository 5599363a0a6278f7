"""Standard normals for the cameras' noise, vectorised, from a generator's raw words;
single-threaded, float32."""

import math
from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

FAST: Any = {"cache": True, "fastmath": {"nsz"}, "error_model": "numpy", "nogil": True}
"""Compiler options of all camera kernels: operations are neither reordered nor fused, so that
every processor gives the same bits. Values may be infinite: an unlit pixel may divide by zero and
is gated out later."""
# of whole numbers that float32 holds: exact in any order
EXACT_SUMS: Any = {**FAST, "fastmath": {"nsz", "reassoc"}}
IN_DOUBLE: Any = {**FAST, "fastmath": {"contract", "reassoc", "arcp", "nsz"}}
"""The same for float64 sums that are rounded to float32 afterwards; their order changes a range by
1e-13 m."""
TWO_PI = np.float32(2.0 * math.pi)


@numba.njit(**FAST)
def normals_from_bits(bits: np.ndarray, out: np.ndarray) -> None:
    """Write standard normals (2 n,) float32 from uniform words (2 n,) by Box and Muller, to 1e-5
    and 5.9 deviations."""
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
def normal_pair(word):  # type: ignore[no-untyped-def]
    """Return two standard normals from a uniform word of 32 bits: from 65,536 radii, up to 4.9,
    and as many angles."""
    u = (np.float32(word & np.uint32(0xFFFF)) + np.float32(0.5)) * np.float32(2.0**-16)
    radius = np.sqrt(np.float32(-2) * _log(u))
    sine, cosine = _sincos_turns(np.float32(word >> np.uint32(16)) * np.float32(2.0**-16))
    return radius * cosine, radius * sine


@numba.njit(inline="always", **FAST)
def _log(u):  # type: ignore[no-untyped-def]
    """Return the natural logarithm of a positive float32: exponent from its bits, mantissa by an
    atanh series."""
    word: Any = float_bits(u)
    exponent = np.int32(word >> np.uint32(23)) - np.int32(127)
    mantissa = bits_float((word & np.uint32(0x007FFFFF)) | np.uint32(0x3F800000))
    big = mantissa > np.float32(1.41421356)
    mantissa = mantissa * np.float32(0.5) if big else mantissa
    exponent = exponent + np.int32(1) if big else exponent
    q = (mantissa - np.float32(1)) / (mantissa + np.float32(1))
    s = q * q
    series = np.float32(2 / 3) + s * (
        np.float32(2 / 5) + s * (np.float32(2 / 7) + s * np.float32(2 / 9))
    )
    return np.float32(exponent) * np.float32(0.69314718) + q * (np.float32(2) + s * series)


@numba.njit(inline="always", **FAST)
def _sincos_turns(v):  # type: ignore[no-untyped-def]
    """Return sine and cosine of v turns, 0 <= v < 1."""
    quarter = np.floor(v * np.float32(4) + np.float32(0.5))
    x = (v - quarter * np.float32(0.25)) * TWO_PI
    x2 = x * x
    sine = x * (
        np.float32(1)
        + x2 * (np.float32(-1 / 6) + x2 * (np.float32(1 / 120) + x2 * np.float32(-1 / 5040)))
    )
    series = np.float32(1 / 24) + x2 * (np.float32(-1 / 720) + x2 * np.float32(1 / 40320))
    cosine = np.float32(1) + x2 * (np.float32(-0.5) + x2 * series)
    k = np.int32(quarter)
    odd = (k & np.int32(1)) == np.int32(1)
    a = cosine if odd else sine
    b = sine if odd else cosine
    a = -a if (k & np.int32(2)) != np.int32(0) else a
    b = -b if ((k + np.int32(1)) & np.int32(2)) != np.int32(0) else b
    return a, b


def _bits(source: Any, target: Any) -> Any:
    """Return a compiled function that reinterprets the bits of a number of one type as another
    type."""

    def generate(context, builder, _, args):  # type: ignore[no-untyped-def]
        return builder.bitcast(args[0], context.get_value_type(target))

    def cast(context, value):  # type: ignore[no-untyped-def]
        return target(source), generate

    return intrinsic(cast)


float_bits = _bits(types.float32, types.uint32)
bits_float = _bits(types.uint32, types.float32)


def _generate_fused(context: Any, builder: Any, _: Any, args: Any) -> Any:
    a, b, c = args
    return builder.fma(a, b, c)


def _fused(context: Any, a: Any, b: Any, c: Any) -> Any:
    return types.float32(types.float32, types.float32, types.float32), _generate_fused


fma: Any = intrinsic(_fused)
"""a b + c of float32, rounded once: the same bits on every processor, in one operation on most."""


def standard_normals(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draw standard normals (shape) float32 from the generator's raw words; an odd count uses half
    a word more."""
    count = math.prod(shape)
    even = count + count % 2
    out = np.empty(even, np.float32)
    normals_from_bits(rng.bit_generator.random_raw(even // 2).view(np.uint32), out)
    return out[:count].reshape(shape)
