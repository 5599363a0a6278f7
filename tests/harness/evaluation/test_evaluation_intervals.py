"""Intervals against SciPy, printed tables and their own coverage."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from harness.evaluation import intervals
from harness.evaluation.intervals import (
    Interval,
    false_call_rate,
    percentiles,
    threshold_for_rate,
)
from harness.vocabulary.errors import UserError


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
    assert low == pytest.approx(0.445739, abs=1e-6)
    assert high == pytest.approx(4.554261, abs=1e-6)
    assert np.isnan(intervals.mean_t(1.0, np.nan, 1)).all()


def test_difference_of_means_equals_scipys_welch_and_is_a_point_without_scatter() -> None:
    rng = np.random.default_rng(3)
    a = rng.normal(2, 1, 12)
    b = rng.normal(0, 3, 30)
    theirs = stats.ttest_ind(a, b, equal_var=False).confidence_interval(0.95)
    ours = intervals.mean_difference(a, b)
    assert ours.low == pytest.approx(theirs.low)
    assert ours.high == pytest.approx(theirs.high)
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
    first = intervals.bootstrap(lambda i: values[i].mean(axis=1), 20)
    second = intervals.bootstrap(lambda i: values[i].mean(axis=1), 20)
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


def test_an_interval_is_over_a_value_not_over_it_or_open() -> None:
    assert Interval(1, 2).over(0.5) is True
    assert Interval(1, 2).over(1.0) is None
    assert Interval(1, 2).over(2.0) is False
    assert Interval(1, 2).over(3.0) is False
    assert intervals.UNKNOWN.over(0.0) is None
    assert not Interval(1, 2).within(1.1, 2)
    assert not Interval(1, 2).within(1, 1.9)
    assert not Interval(np.nan, 2.0).known


def test_a_poisson_rate_without_exposure_is_unknown() -> None:
    low, high = intervals.poisson_rate([1, 0], [0.0, 2.0])
    assert np.isnan(low[0])
    assert np.isnan(high[0])
    assert low[1] == 0.0
    assert high[1] == pytest.approx(3.6889 / 2, abs=1e-4)


def test_a_mean_of_two_values_has_an_interval() -> None:
    """t(0.975, 1) = 12.7062."""
    low, high = intervals.mean_t([0.0, 0.0], [1.0, 1.0], [2, 1])
    assert high[0] == -low[0] == pytest.approx(12.7062 / np.sqrt(2), abs=1e-4)
    assert np.isnan(low[1])


def test_a_standardised_bias_by_hand() -> None:
    """0.5 with 8 values: standard error sqrt(1/8 + 0.25/16)."""
    interval = intervals.standardised_bias(-1.0, 2.0, 8)
    half = 1.959964 * np.sqrt(1 / 8 + 0.25 / 16)
    assert interval.low == pytest.approx(-0.5 - half, abs=1e-6)
    assert interval.high == pytest.approx(-0.5 + half, abs=1e-6)
    assert intervals.standardised_bias(0.1, 1.0, 2).known
    assert not intervals.standardised_bias(np.inf, 1.0, 9).known


def test_two_equal_samples_that_differ_within_have_no_point() -> None:
    assert intervals.mean_difference([1.0, 2.0], [1.4, 1.6]).low < 0.0


def test_percentiles_are_order_statistics() -> None:
    draws = np.random.default_rng(1).permutation(np.arange(1.0, 211.0))
    assert percentiles(draws) == Interval(6.0, 205.0)
    assert percentiles(draws, 0.9) == Interval(11.0, 200.0)
    half_nan = np.array([1.0, 2.0, np.nan, np.nan])
    assert percentiles(half_nan) == Interval(1.0, 2.0)
    assert not percentiles(np.append(half_nan, np.nan)).known
    assert not percentiles(np.array([1.0])).known


def test_the_bootstrap_draws_indices_with_a_fixed_seed() -> None:
    indices = np.random.default_rng(0).integers(0, 7, size=(2000, 7))
    means = indices.mean(axis=1)
    assert intervals.bootstrap(lambda drawn: drawn.mean(axis=1), 7) == percentiles(means)


def test_false_calls_per_area() -> None:
    rate = false_call_rate(3, 1.5)
    assert rate.rate_per_m2 == 2.0
    assert rate.calls == 3
    assert rate.area_m2 == 1.5
    assert stats.poisson.cdf(3, rate.interval_per_m2.high * 1.5) == pytest.approx(0.025, rel=1e-9)
    assert stats.poisson.sf(2, rate.interval_per_m2.low * 1.5) == pytest.approx(0.025, rel=1e-9)
    assert false_call_rate(0, 2.0).rate_per_m2 == 0.0
    for calls, area in ((-1, 1.0), (1, 0.0), (1, -1.0), (1, np.nan)):
        with pytest.raises(UserError, match="false calls on"):
            false_call_rate(calls, area)


@pytest.mark.parametrize(
    ("runs", "above"),
    [(99, 5), (40, 1), (14, 0)],
)
def test_a_threshold_is_the_lowest_score_that_keeps_to_the_rate(runs: int, above: int) -> None:
    """Wanted P(call) = 1 - exp(-0.07) = 0.0676: (above + 1) / (runs + 1) is the largest below."""
    scores = np.random.default_rng(3).permutation(99.0 * np.arange(runs))
    threshold = threshold_for_rate(scores, 0.07, 1.0)
    assert (above + 1) / (runs + 1) <= -np.expm1(-0.07) < (above + 2) / (runs + 1)
    assert threshold.value == 99.0 * (runs - 1 - above)
    assert threshold.calling_runs == above
    assert threshold.runs == runs
    assert threshold.confidence == 0.95
    share = (above + 1) / (runs + 1)
    assert threshold.rate_per_m2 == pytest.approx(-np.log(1 - share) / 0.07)
    bound = stats.beta.ppf(0.95, above + 1, runs - above)
    assert threshold.upper_per_m2 == pytest.approx(-np.log1p(-bound) / 0.07)


def test_a_rate_that_is_met_exactly_is_met() -> None:
    """(n + 1) P(call) is a whole number: 3 of 20, from a rate of -ln(0.85)."""
    rate = -float(np.log(0.85))
    assert threshold_for_rate(np.arange(19.0), 1.0, rate).calling_runs == 2
    # so high a rate that every finding may be a call
    assert threshold_for_rate(np.arange(5.0), 1.0, 9.0).value == 0.0


def test_thresholds_that_cannot_be_set_are_refused() -> None:
    with pytest.raises(UserError, match=r"13 hole-free runs of 0\.07 m² are too few") as caught:
        threshold_for_rate(np.arange(13.0), 0.07, 1.0)
    assert caught.value.legal == "at least 14 runs"
    for area, rate in ((0.0, 1.0), (0.07, 0.0)):
        with pytest.raises(UserError, match="wanted rate"):
            threshold_for_rate(np.arange(99.0), area, rate)
    for score in (np.nan, np.inf):
        with pytest.raises(UserError, match="not every highest score"):
            threshold_for_rate([1.0, score], 1.0, 1.0)
    tied = threshold_for_rate([2.0] * 100, 0.07, 1.0)
    assert tied.value == 2.0
    assert tied.calling_runs == 0
    silent = threshold_for_rate([-np.inf] * 95 + [1.0] * 5, 0.07, 1.0)
    assert silent.value == -np.inf
    assert silent.calling_runs == 5
