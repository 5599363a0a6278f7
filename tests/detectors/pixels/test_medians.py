"""Medians are those of NumPy."""

import numpy as np
import pytest

from detectors.pixels.medians import group_medians, row_medians
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


@pytest.mark.parametrize("count", [1, 2, 3, 4, 49, 50])
def test_medians_of_groups_with_equal_values_are_exact(count: int) -> None:
    """Also of sorted values and of values in falling order."""
    rounded = np.round(RANDOM.standard_normal((30, count)), 1)
    rounded[0].sort()
    rounded[1] = -np.sort(-rounded[1])
    group = np.repeat(np.arange(30), count)
    medians, deviations = group_medians(rounded.ravel(), group, 30)
    np.testing.assert_array_equal(medians, np.median(rounded, axis=1))
    off = np.abs(rounded - medians[:, None])
    np.testing.assert_array_equal(deviations, np.median(off, axis=1) / 0.6745)
