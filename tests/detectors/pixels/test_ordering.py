"""The order of pixels is that of NumPy's stable sort."""

import numpy as np
import pytest

from detectors.pixels.ordering import falling_order, rising_order

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
