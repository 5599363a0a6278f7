"""Standard normals for the cameras' noise, vectorised; single-threaded, float32.

A generator's raw words are the states of `LANES` small generators, xoshiro128++ (Blackman and
Vigna 2021), which run side by side and take a quarter of the generator's own time for a word.
`standard_normals` is the door."""

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
IN_DOUBLE: Any = {**FAST, "fastmath": {"contract", "reassoc", "arcp", "nsz"}}
"""The same for float64 sums that are rounded to float32 afterwards; their order changes a range by
1e-13 m."""
f4 = np.float32
TWO_PI = f4(2.0 * math.pi)
LOG_2 = f4(0.69314718)
ROOT_2 = f4(1.41421356)
PER_WORD_OF_24 = f4(2.0**-24)
MINUS_TWO = f4(-2)
QUARTER = f4(0.25)
HALF = f4(0.5)
ONE = f4(1)
TWO = f4(2)
FOUR = f4(4)
# coefficients of the series of 2 atanh, sine and cosine, by their powers
ATANH_3 = f4(2 / 3)
ATANH_5 = f4(2 / 5)
ATANH_7 = f4(2 / 7)
ATANH_9 = f4(2 / 9)
SINE_3 = f4(-1 / 6)
SINE_5 = f4(1 / 120)
SINE_7 = f4(-1 / 5040)
COSINE_2 = f4(-0.5)
COSINE_4 = f4(1 / 24)
COSINE_6 = f4(-1 / 720)
COSINE_8 = f4(1 / 40320)
# of the bits of a float32
EXPONENT_SHIFT = np.uint32(23)
EXPONENT_OF_ONE = np.int32(127)
MANTISSA_BITS = np.uint32(0x007FFFFF)
BITS_OF_ONE = np.uint32(0x3F800000)
# of a word of 32 bits
LOWER_SHIFT = np.uint32(8)
LANES = 64  # generators side by side, whose states stay in the processor's innermost cache
BLOCK = 1024  # pairs of normals whose words are drawn together; a multiple of `LANES`
# xoshiro128++: its shift, and its rotations to the left and back
SHIFT_9 = np.uint32(9)
LEFT_7 = np.uint32(7)
BACK_7 = np.uint32(25)
LEFT_11 = np.uint32(11)
BACK_11 = np.uint32(21)
# where the four words of the states begin; indices are unsigned: the compiler gathers by signed
# ones
STATE_0 = np.uint64(0)
STATE_1 = np.uint64(LANES)
STATE_2 = np.uint64(2 * LANES)
STATE_3 = np.uint64(3 * LANES)
# whole numbers
INT_0 = np.int32(0)
INT_1 = np.int32(1)
INT_2 = np.int32(2)


@numba.njit(**FAST)
def fill_words(states: np.ndarray, words: np.ndarray) -> None:
    """Write uniform words (k LANES,) uint32: the next k of each lane, lane after lane.

    Args:
        states: (4 LANES,) uint32, the first words of all lanes' states, the second ones and so on;
            moved on.
        words: written.
    """
    for start in range(STATE_0, np.uint64(words.size), STATE_1):
        for lane in range(STATE_1):
            s0 = states[STATE_0 + lane]
            s1 = states[STATE_1 + lane]
            s2 = states[STATE_2 + lane]
            s3 = states[STATE_3 + lane]
            total = np.uint32(s0 + s3)  # Numba adds in 64 bits
            words[start + lane] = ((total << LEFT_7) | (total >> BACK_7)) + s0
            shifted = s1 << SHIFT_9
            s2 ^= s0
            s3 ^= s1
            s1 ^= s2
            s0 ^= s3
            s2 ^= shifted
            states[STATE_0 + lane] = s0
            states[STATE_1 + lane] = s1
            states[STATE_2 + lane] = s2
            states[STATE_3 + lane] = (s3 << LEFT_11) | (s3 >> BACK_11)


@numba.njit(**FAST)
def normals_from_words(  # type: ignore[no-untyped-def]
    radius_words,
    angle_words,
    cosines,
    sines,
):
    """Write standard normals, ``cosines`` and ``sines`` (n,) float32, from uniform words (n,) each
    by Box and Muller, to 1e-5 and 5.9 deviations."""
    for i in range(np.uint64(cosines.size)):
        # the upper 24 bits of a word fill a float32 exactly
        u = (f4(radius_words[i] >> LOWER_SHIFT) + HALF) * PER_WORD_OF_24
        v = f4(angle_words[i] >> LOWER_SHIFT) * PER_WORD_OF_24
        radius = np.sqrt(MINUS_TWO * _log(u))
        sine, cosine = _sincos_turns(v)
        cosines[i] = radius * cosine
        sines[i] = radius * sine


@numba.njit(**FAST)
def _fill_normals(states, normals):  # type: ignore[no-untyped-def]
    """Write standard ``normals`` (2 n,) from the ``states`` of `fill_words`; those n apart are a
    pair."""
    n = normals.size // 2
    words = np.empty(2 * BLOCK, np.uint32)
    for start in range(0, n, BLOCK):
        size = min(BLOCK, n - start)
        fill_words(states, words)
        normals_from_words(
            words[:size],
            words[BLOCK : BLOCK + size],
            normals[start : start + size],
            normals[n + start : n + start + size],
        )


@numba.njit(inline="always", **FAST)
def _log(u):  # type: ignore[no-untyped-def]
    """Return the natural logarithm of a positive float32: exponent from its bits, mantissa by an
    atanh series."""
    word: Any = float_bits(u)
    exponent = np.int32(word >> EXPONENT_SHIFT) - EXPONENT_OF_ONE
    mantissa = bits_float((word & MANTISSA_BITS) | BITS_OF_ONE)
    big = mantissa > ROOT_2
    mantissa = mantissa * HALF if big else mantissa
    exponent = exponent + INT_1 if big else exponent
    q = (mantissa - ONE) / (mantissa + ONE)
    s = q * q
    series = ATANH_7 + s * ATANH_9
    series = ATANH_5 + s * series
    series = ATANH_3 + s * series
    return f4(exponent) * LOG_2 + q * (TWO + s * series)


@numba.njit(inline="always", **FAST)
def _sincos_turns(v):  # type: ignore[no-untyped-def]
    """Return sine and cosine of v turns, 0 <= v < 1."""
    quarter = np.floor(v * FOUR + HALF)
    x = (v - quarter * QUARTER) * TWO_PI
    x2 = x * x
    series = SINE_5 + x2 * SINE_7
    series = SINE_3 + x2 * series
    sine = x * (ONE + x2 * series)
    series = COSINE_6 + x2 * COSINE_8
    series = COSINE_4 + x2 * series
    series = COSINE_2 + x2 * series
    cosine = ONE + x2 * series
    # a quarter of a turn swaps both, half a turn changes their signs
    k = np.int32(quarter)
    odd = (k & INT_1) == INT_1
    a = cosine if odd else sine
    b = sine if odd else cosine
    a = -a if (k & INT_2) != INT_0 else a
    b = -b if ((k + INT_1) & INT_2) != INT_0 else b
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
    """Draw standard normals (shape) float32. The generator's raw words seed the lanes."""
    count = math.prod(shape)
    normals = np.empty(count + count % 2, np.float32)
    states = rng.bit_generator.random_raw(2 * LANES).view(np.uint32)
    _fill_normals(states, normals)
    return normals[:count].reshape(shape)
