"""Medians are those of NumPy."""

import numpy as np
import pytest

from detectors.pixels.medians import row_medians
from detectors.pixels.noise import median_of

RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 200, 201])
def test_the_median_of_odd_and_even_numbers(count: int) -> None:
    values = RANDOM.standard_normal(count)
    assert median_of(values) == np.median(values)


def test_medians_of_rows_leave_out_what_is_unknown() -> None:
    rows = RANDOM.standard_normal((40, 49))
    rows[RANDOM.random(rows.shape) < 0.4] = np.nan
    rows[7, 1:] = np.nan
    np.testing.assert_array_equal(row_medians(rows), np.nanmedian(rows, axis=1))
    rows[7] = np.inf
    assert np.isnan(row_medians(rows)[7])
