"""Intervals against SciPy, printed tables and their own coverage."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from harness.evaluation import intervals
from harness.evaluation.intervals import Interval


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 200).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_proportions_equal_scipys(case: tuple[int, int]) -> None:
    k, n = case
    test = stats.binomtest(k, n)
    for ours, method in ((intervals.wilson, "wilson"), (intervals.clopper_pearson, "exact")):
        low, high = ours(k, n)
        theirs = test.proportion_ci(0.95, method=method)
        assert low == pytest.approx(theirs.low, abs=1e-12)
        assert high == pytest.approx(theirs.high, abs=1e-12)


def test_proportions_are_elementwise_and_unknown_without_trials() -> None:
    low, high = intervals.wilson([0, 25, 50, 0], [50, 50, 50, 0])
    np.testing.assert_allclose(low[:3], [0, 0.36644, 0.92865], atol=1e-5)
    np.testing.assert_allclose(high[:3], [0.07135, 0.63356, 1], atol=1e-5)
    assert np.isnan(low[3])
    assert np.isnan(high[3])
    assert np.isnan(intervals.clopper_pearson(0, 0)).all()


def test_poisson_rates_equal_garwoods_table() -> None:
    low, high = intervals.poisson_rate([0, 1, 10], [1, 1, 1])
    np.testing.assert_allclose(low, [0, 0.0253, 4.7954], atol=1e-4)
    np.testing.assert_allclose(high, [3.6889, 5.5716, 18.3904], atol=1e-4)
    assert intervals.poisson_rate(1, 50)[1] == pytest.approx(5.5716 / 50, abs=1e-5)


def test_mean_of_four_by_hand() -> None:
    # mean 2.5, std 1.290994, t(0.975, 3) = 3.182446: half width 2.054261
    low, high = intervals.mean_t(2.5, np.std([1, 2, 3, 4], ddof=1), 4)
    assert (low, high) == (pytest.approx(0.445739, abs=1e-6), pytest.approx(4.554261, abs=1e-6))
    assert np.isnan(intervals.mean_t(1.0, np.nan, 1)).all()


def test_difference_of_means_equals_scipys_welch_and_is_a_point_without_scatter() -> None:
    rng = np.random.default_rng(3)
    a = rng.normal(2, 1, 12)
    b = rng.normal(0, 3, 30)
    theirs = stats.ttest_ind(a, b, equal_var=False).confidence_interval(0.95)
    ours = intervals.mean_difference(a, b)
    assert (ours.low, ours.high) == (pytest.approx(theirs.low), pytest.approx(theirs.high))
    assert intervals.mean_difference([2.0, 2.0], [0.5, 0.5]) == Interval(1.5, 1.5)
    assert not intervals.mean_difference([2.0], [0.5, 0.5]).known


def test_standardised_bias_without_scatter_is_exact() -> None:
    assert intervals.standardised_bias(0.0, 0.0, 50) == Interval(0, 0)
    assert intervals.standardised_bias(-0.1, 0.0, 50) == Interval(-np.inf, -np.inf)
    assert not intervals.standardised_bias(0.1, 1.0, 1).known
    assert not intervals.standardised_bias(0.1, np.nan, 9).known


def test_standardised_bias_covers() -> None:
    """2000 samples of 50 at a true ratio of 1: coverage 0.95 within 4 binomial standard errors
    (alpha 6e-5)."""
    samples = np.random.default_rng(5).normal(1.0, 1.0, (2000, 50))
    spans = [intervals.standardised_bias(s.mean(), s.std(ddof=1), 50) for s in samples]
    covered = np.mean([span.low <= 1 <= span.high for span in spans])
    assert abs(covered - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 2000)


def test_bootstrap_covers_a_mean() -> None:
    """400 samples of 50: the percentile interval of a mean covers between 0.90 and 0.99 (expected
    0.94; alpha 1e-3)."""
    samples = np.random.default_rng(6).normal(0.0, 1.0, (400, 50))
    spans = [
        intervals.bootstrap(lambda i, s=s: s[i].mean(axis=1), 50, resamples=400) for s in samples
    ]
    covered = np.mean([span.low <= 0 <= span.high for span in spans])
    assert 0.90 <= covered <= 0.99


def test_bootstrap_is_repeatable_and_honest_about_nothing() -> None:
    values = np.random.default_rng(7).normal(size=20)
    first, second = (intervals.bootstrap(lambda i: values[i].mean(axis=1), 20) for _ in range(2))
    assert first == second
    assert first.low < values.mean() < first.high
    assert not intervals.bootstrap(lambda i: values[i].mean(axis=1), 1).known
    assert not intervals.bootstrap(lambda i: np.full(len(i), np.nan), 20).known


def test_an_unknown_interval_decides_nothing() -> None:
    unknown = intervals.UNKNOWN
    assert not (unknown.known or unknown.above(0) or unknown.below(0) or unknown.within(-1, 1))
    assert Interval(1, 2).above(0.9)
    assert not Interval(1, 2).above(1)
    assert Interval(1, 2).within(1, 2)
    assert Interval(1, 2).below(2.1)
