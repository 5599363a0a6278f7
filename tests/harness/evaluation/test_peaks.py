"""Thresholds from the strongest findings of hole-free boards."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special, stats

from harness.evaluation.intervals import threshold_for_rate
from harness.evaluation.peaks import (
    LEVEL,
    ScoreTail,
    _sandwich,
    fitted_tail,
    is_uneven,
    threshold_from_peaks,
)
from harness.vocabulary.errors import UserError

AREA_M2 = 0.054
PLACES = 2000


def boards(number: int, seed: int, highest: int = 10) -> list[list[float]]:
    """The strongest of `PLACES` independent Gaussian scores, of either sign, of each board."""
    scores = np.abs(np.random.default_rng(seed).standard_normal((number, PLACES)))
    return (-np.sort(-scores, axis=1)[:, :highest]).tolist()


def true_rate(threshold: float) -> float:
    return float(PLACES * 2 * special.ndtr(-threshold) / AREA_M2)


@pytest.mark.parametrize("shape", [-0.2, 0.0, 0.3])
def test_scores_and_counts_of_a_tail_invert_each_other(shape: float) -> None:
    tail = ScoreTail(location=16.0, log_scale=np.log(2.0), shape=shape, covariance=np.zeros((3, 3)))
    assert tail.score_at(1.0) == pytest.approx(4.0)
    for count in (0.05, 0.5, 3.0):
        score = tail.score_at(count)
        assert tail.log_count(score) == pytest.approx(np.log(count))
        slope = (tail.log_count(score + 1e-5) - tail.log_count(score - 1e-5)) / 2e-5
        assert tail.hazard(score) == pytest.approx(-slope, rel=1e-5)
    assert tail.error_of_log_count(5.0) == 0.0


def test_the_error_of_the_count_is_by_the_delta_method() -> None:
    """Without a shape ln count = -(t^2 - place) / scale: 1 / scale by the place."""
    tail = ScoreTail(16.0, np.log(2.0), 0.0, np.diag([0.09, 0.0, 0.0]))
    assert tail.error_of_log_count(5.0) == pytest.approx(0.3 / 2.0)
    tail = ScoreTail(16.0, np.log(2.0), 0.0, np.diag([0.0, 0.01, 0.0]))
    assert tail.error_of_log_count(5.0) == pytest.approx(0.1 * 9.0 / 2.0, rel=1e-6)


def test_gaussian_scores_give_the_wanted_rate_and_an_interval_that_covers_it() -> None:
    """40 calibrations of 60 boards. Coverage 0.93 (0.04 is a standard error); the rate scatters
    less than by order statistics, and so does the threshold."""
    thresholds = []
    by_order = []
    covered = []
    for seed in range(40):
        peaks = boards(60, seed)
        threshold = threshold_from_peaks(peaks, AREA_M2, 1.0)
        assert threshold.method == "tail of the strongest findings"
        rate = true_rate(threshold.value)
        covered.append(threshold.interval_per_m2.low <= rate <= threshold.interval_per_m2.high)
        thresholds.append(threshold)
        by_order.append(threshold_for_rate([scores[0] for scores in peaks], AREA_M2, 1.0).value)
    values = np.array([threshold.value for threshold in thresholds])
    errors = np.array([threshold.error for threshold in thresholds])
    assert np.mean([true_rate(value) for value in values]) == pytest.approx(1.05, abs=0.2)
    assert np.mean(covered) >= 0.85
    assert errors.mean() == pytest.approx(values.std(), rel=0.25)
    assert values.std() < 0.85 * np.std(by_order)


def test_scores_that_contradict_the_tail_are_set_by_order_statistics() -> None:
    """Every second board has one place at 20 deviations, and nothing between: the third highest of
    60 decides, which a new board exceeds with probability 3 / 61."""
    peaks = boards(60, seed=1)
    for number in range(0, 60, 2):
        peaks[number] = [20.0 + 0.01 * number, *peaks[number][:-1]]
    assert fitted_tail(peaks) is None
    threshold = threshold_from_peaks(peaks, AREA_M2, 1.0)
    assert threshold.method == "order statistics"
    assert threshold.value == pytest.approx(20.54)
    assert threshold.interval_per_m2.low == pytest.approx(0.19, abs=0.01)
    assert threshold.interval_per_m2.high == pytest.approx(2.2, abs=0.1)
    assert threshold.error > 0


def test_the_error_of_order_statistics_is_a_quarter_of_four_standard_errors() -> None:
    """Single scores in steps of 0.1, of which eight of 100 may be exceeded: their number has a
    standard error of 3, so that scores with two errors more and fewer above lie 1.2 apart."""
    peaks = [[5.0 + 0.1 * number] for number in range(100)]
    rate_per_m2 = -np.log(1 - 9.5 / 101) / AREA_M2
    threshold = threshold_from_peaks(peaks, AREA_M2, rate_per_m2)
    assert threshold.method == "order statistics"
    assert threshold.value == pytest.approx(5.0 + 0.1 * 91)
    assert threshold.error == pytest.approx(0.3)
    low, high = stats.beta.ppf([0.025, 0.975], 9, 92)
    assert threshold.interval_per_m2.low == pytest.approx(-np.log(1 - low) / AREA_M2)
    assert threshold.interval_per_m2.high == pytest.approx(-np.log(1 - high) / AREA_M2)


def test_the_covariance_of_a_mean_is_that_of_boards_over_their_number() -> None:
    """A likelihood whose maximum is the mean of the boards' numbers."""
    numbers = np.random.default_rng(4).normal([1.0, 2.0, 3.0], [0.1, 0.2, 0.3], (7, 3))

    def of_boards(parameters: np.ndarray) -> np.ndarray:
        return -0.5 * ((parameters - numbers) ** 2).sum(axis=1)

    covariance = _sandwich(of_boards, numbers.mean(axis=0))
    np.testing.assert_allclose(covariance, np.cov(numbers.T) / 7, rtol=1e-6, atol=1e-12)


def test_many_boards_show_a_heavy_tail_whatever_was_expected() -> None:
    """Squares with a Pareto tail of shape 0.3, three deviations from what the penalty expects:
    2,000 boards of ten scores outweigh it."""
    random = np.random.default_rng(5)
    counts = np.cumsum(random.exponential(size=(2000, 10)), axis=1)
    squares = 16.0 + 2.0 * np.expm1(-0.3 * np.log(counts)) / 0.3
    tail = fitted_tail(np.sqrt(squares).tolist())
    assert tail is not None
    assert tail.shape == pytest.approx(0.3, abs=0.03)
    assert tail.location == pytest.approx(16.0, abs=0.2)
    assert np.exp(tail.log_scale) == pytest.approx(2.0, rel=0.05)


def test_few_boards_or_scores_have_no_tail() -> None:
    assert fitted_tail(boards(11, seed=1)) is None
    assert fitted_tail(boards(12, seed=1)) is not None
    assert fitted_tail(boards(60, seed=1, highest=3)) is None
    assert fitted_tail([[0.0] * 10] * 60) is None


def test_too_few_boards_for_the_rate_are_refused() -> None:
    with pytest.raises(UserError, match="too few for a rate of"):
        threshold_from_peaks(boards(60, seed=1), AREA_M2, 0.1)


def test_values_are_uneven_as_kolmogorovs_test_says() -> None:
    """Values crowded more and more towards 1, so that p-values lie on both sides of the level."""
    even = np.random.default_rng(3).random(40)
    answers = []
    for power in np.geomspace(0.3, 1.0, 60):
        values = even**power
        expected = stats.kstest(values, "uniform").pvalue < LEVEL
        assert is_uneven(values) == expected
        assert is_uneven(1.0 - values) == expected
        answers.append(bool(expected))
    assert 10 < sum(answers) < 50
