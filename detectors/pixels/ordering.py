"""The order of pixels by their scores and by other keys, as NumPy's stable sort gives it, in a
quarter of the time for 30,000 pixels; and values of stated ranks, as NumPy's partition gives them,
in a sixth."""

import math
from typing import Any

import numba
import numpy as np

DIGIT_BITS = 11  # of a key that one pass sorts by: six passes, whose counts stay in the caches
KEY_BITS = 64
LEAST_SAMPLED = 4000  # fewest values of which a sample is taken first
SAMPLE = 500
SAMPLE_MARGIN = 2.0
"""Margin, in roots of the sample's size, on either side of a rank in the sample: at least four
standard deviations of the rank of a random sample's value."""


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


def values_at_ranks(values: np.ndarray, first: int, second: int) -> tuple[Any, Any]:
    """Return the values of two ranks next to each other, from 0, of numbers (n,) without NaN:
    ``np.sort(values)[[first, second]]``.

    An even sample tells between which two values they lie, so that only the values in between are
    sorted. If the sample misleads, all are."""
    count = len(values)
    before = 0
    among = values
    if count >= LEAST_SAMPLED and values.dtype.kind == "f":
        sample = np.sort(values[:: count // SAMPLE])
        place = first / count * len(sample)
        margin = SAMPLE_MARGIN * math.sqrt(len(sample))
        low = sample[max(int(place - margin), 0)]
        high = sample[min(int(place + margin) + 1, len(sample) - 1)]
        below, between = _between(np.ascontiguousarray(values), low, high)
        if below <= first and second < below + len(between):
            before = below
            among = between
    # for two ranks, NumPy takes a third of the time that it takes for one
    ordered = np.partition(among, (first - before, second - before))
    return ordered[first - before], ordered[second - before]


@numba.njit(cache=True, nogil=True)
def _between(values: np.ndarray, low: float, high: float) -> tuple[int, np.ndarray]:
    """Return how many values (n,) are less than ``low``, and those from ``low`` to ``high``."""
    between = np.empty_like(values)
    below = 0
    count = 0
    for i in range(len(values)):
        value = values[i]
        below += value < low
        between[count] = value  # overwritten by the next one unless it counts
        count += (value >= low) & (value <= high)
    return below, between[:count]
