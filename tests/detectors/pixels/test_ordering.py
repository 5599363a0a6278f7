"""The order of pixels is that of NumPy's stable sort, and so are the values of ranks."""

import numpy as np
import pytest

from detectors.pixels import ordering
from detectors.pixels.ordering import falling_order, rising_order, values_at_ranks

RANDOM = np.random.default_rng(0)
SCORES = {
    "scores": np.abs(RANDOM.standard_normal(3000)),
    "many equal ones": np.round(RANDOM.standard_normal(3000), 1),
    "all equal": np.full(7, 2.5),
    "zeros of both signs": np.array([0.0, -0.0, 1.0, -1.0, 0.0, -np.inf, np.inf]),
    "single precision": RANDOM.standard_normal(300).astype(np.float32),
    "none": np.zeros(0),
}


@pytest.mark.parametrize("name", SCORES)
def test_scores_fall(name: str) -> None:
    values = SCORES[name]
    np.testing.assert_array_equal(falling_order(values), np.argsort(-values, kind="stable"))


def test_keys_rise() -> None:
    keys = RANDOM.integers(0, 1 << 62, 3000)
    keys[::3] = keys[0]
    keys[1::7] >>= 40
    np.testing.assert_array_equal(rising_order(keys), np.argsort(keys, kind="stable"))


COUNT = 20_000
EVERY = COUNT // ordering.SAMPLE
MANY = {
    "random": RANDOM.standard_normal(COUNT),
    "sorted": np.sort(RANDOM.standard_normal(COUNT)),
    "many equal ones": np.round(RANDOM.standard_normal(COUNT), 1),
    "single precision": RANDOM.standard_normal(COUNT).astype(np.float32),
    "whole numbers": RANDOM.integers(0, 50, COUNT),
    "infinite ones": np.where(RANDOM.random(COUNT) < 0.3, np.inf, RANDOM.standard_normal(COUNT)),
    "every second one of an array": RANDOM.standard_normal(2 * COUNT)[::2],
    # the sample sees the largest of each group only
    "a sample that misleads": np.sort(RANDOM.standard_normal((ordering.SAMPLE, EVERY)))[
        :, ::-1
    ].ravel(),
    "few": RANDOM.standard_normal(11),
}


@pytest.mark.parametrize("name", MANY)
def test_values_of_ranks_are_those_of_the_sorted_values(name: str) -> None:
    values = MANY[name]
    ordered = np.sort(values)
    last = len(values) - 1
    for first in (0, last // 4, last // 2, 9 * last // 10, last - 1):
        found = values_at_ranks(values, first, first + 1)
        np.testing.assert_array_equal(found, ordered[[first, first + 1]])
        assert found[0].dtype == values.dtype


def test_only_values_between_two_of_the_sample_are_sorted() -> None:
    below, between = ordering._between(np.array([4.0, 1.0, 3.0, 0.5, 2.0, 5.0]), 1.0, 3.0)
    assert below == 1
    assert between.tolist() == [1.0, 3.0, 2.0]
