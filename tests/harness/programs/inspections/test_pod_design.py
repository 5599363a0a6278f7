"""False calls against exact laws and by simulation; planning a study."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from harness.evaluation.intervals import (
    false_call_rate,
    threshold_for_rate,
)
from harness.evaluation.pod.averaged import ModelAverage
from harness.evaluation.pod.curve import LINKS, PodCurve
from harness.evaluation.pod.hit_miss import choose_model, near_models
from harness.programs.inspections.design_statistics import (
    StudyPlan,
    curve_through,
    design,
    even_sizes,
    hole_free,
    recommend,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.seeds import random_stream

GUESS = PodCurve("logit", False, 10.0, 2.0, np.zeros((2, 2)))


def test_rate_per_area_by_poisson() -> None:
    three = false_call_rate(3, 1.5)
    assert three.rate_per_m2 == 2.0
    assert stats.poisson.cdf(3, three.interval_per_m2.high * 1.5) == pytest.approx(0.025, rel=1e-9)
    assert stats.poisson.sf(2, three.interval_per_m2.low * 1.5) == pytest.approx(0.025, rel=1e-9)


def test_threshold_of_a_hundred_runs_by_hand() -> None:
    """99 runs, wanted P(call) = 1 - exp(-0.07) = 0.0676: six of a hundred may lie above, so five
    of the 99 do."""
    threshold = threshold_for_rate(
        np.random.default_rng(3).permutation(99.0 * np.arange(99)), 0.07, 1.0
    )
    assert (threshold.value, threshold.calling_runs, threshold.runs) == (99.0 * 93, 5, 99)
    assert threshold.rate_per_m2 == pytest.approx(-np.log(0.94) / 0.07)
    assert threshold.upper_per_m2 == pytest.approx(-np.log1p(-stats.beta.ppf(0.95, 6, 94)) / 0.07)


def test_threshold_keeps_the_rate_on_new_runs() -> None:
    """Calls on boards are Poisson with rate 6 per m2 at score > 0 and exponential scores: rate(t)
    = 6 exp(-t). Over 300 calibrations the mean probability of a call on a new run is (k + 1) / (n
    + 1); normal limits, alpha = 0.001."""
    rng = np.random.default_rng(4)
    area = 0.07
    runs = 40
    probability = []
    wanted = []
    for _ in range(300):
        highest = [
            rng.exponential(size=count).max(initial=-np.inf)
            for count in rng.poisson(6 * area, runs)
        ]
        threshold = threshold_for_rate(highest, area, 1.0)
        probability.append(-np.expm1(-6 * np.exp(-max(threshold.value, 0.0)) * area))
        wanted.append(-np.expm1(-threshold.rate_per_m2 * area))
    assert np.allclose(wanted, 2 / 41)
    error = np.std(probability) / np.sqrt(300)
    assert abs(np.mean(probability) - 2 / 41) < 3.3 * error


def test_runs_without_findings_and_ties() -> None:
    silent = threshold_for_rate([-np.inf] * 95 + [1.0] * 5, 0.07, 1.0)
    assert (silent.value, silent.calling_runs) == (-np.inf, 5)
    tied = threshold_for_rate([2.0] * 100, 0.07, 1.0)
    assert (tied.value, tied.calling_runs) == (2.0, 0)


def test_too_few_runs_says_how_many() -> None:
    with pytest.raises(UserError, match="at least 14 runs"):
        threshold_for_rate(np.arange(13.0), 0.07, 1.0)
    assert threshold_for_rate(np.arange(14.0), 0.07, 1.0).calling_runs == 0


def test_places_of_sizes() -> None:
    assert even_sizes(4, (0, 40)).tolist() == [5.0, 15.0, 25.0, 35.0]


def test_more_targets_demonstrate_smaller_sizes() -> None:
    few_targets, many_targets = design(GUESS, (30, 120), (1, 80), studies=40)
    assert few_targets.true_size == many_targets.true_size == pytest.approx(10 + 2 * np.log(9))
    assert many_targets.low <= many_targets.bound <= many_targets.high
    assert many_targets.bound < few_targets.bound


def test_a_plan_is_repeatable_and_independent_of_its_company() -> None:
    alone = design(GUESS, (20,), (1, 40), studies=10, seed=3)[0]
    among = design(GUESS, (16, 20), (1, 40), studies=10, seed=3)[1]
    assert (alone.bound, alone.low, alone.high) == (among.bound, among.low, among.high)


def test_studies_far_from_the_rise_demonstrate_nothing() -> None:
    plan = design(GUESS, (20,), (30, 60), studies=20)[0]
    assert plan.bound == np.inf
    assert plan.demonstrated < 0.5


def test_mistakes_of_the_user() -> None:
    with pytest.raises(UserError, match="area above 0"):
        false_call_rate(1, 0.0)
    with pytest.raises(UserError, match="highest score is a number"):
        threshold_for_rate([np.nan, 1.0], 1.0, 1.0)


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("log_size", [False, True])
def test_a_guess_goes_through_its_two_sizes(link: str, log_size: bool) -> None:
    curve = curve_through(3.0, 5.0, link, log_size=log_size)
    assert curve.pod(np.array([3.0, 5.0])) == pytest.approx([0.5, 0.9])
    assert (curve.link, curve.log_size) == (link, log_size)
    assert np.array_equal(curve.covariance, np.zeros((2, 2)))
    for a50, a90 in ((5.0, 5.0), (5.0, 3.0), (0.0, 3.0), (3.0, np.inf)):
        with pytest.raises(UserError, match="must grow with size"):
            curve_through(a50, a90)


def test_the_plan_is_that_of_its_simulated_studies() -> None:
    """Twenty studies by hand: their bounds, of which the 2nd, 10th and 18th are told."""
    guess = curve_through(3.0, 5.0)
    (plan,) = design(guess, [40], (1.0, 9.0), studies=20, seed=3)
    sizes = 1.0 + 8.0 * (np.arange(40) + 0.5) / 40
    assert plan.sizes == pytest.approx(sizes)
    luck = random_stream(3, "pod design", 40, "uniform").random((20, 40))
    bounds = []
    for hits in luck < guess.pod(sizes):
        bounds.append(ModelAverage(near_models(choose_model(sizes, hits))).bound().value)
    ordered = np.sort(bounds)
    assert (plan.low, plan.bound, plan.high) == pytest.approx(tuple(ordered[[1, 9, 17]]))
    assert plan.demonstrated == np.isfinite(bounds).mean()
    assert plan.true_size == pytest.approx(5.0)
    assert (plan.targets, plan.studies) == (40, 20)


def a_plan(targets: int, high: float) -> StudyPlan:
    return StudyPlan(targets, 20, 5.0, high, high, high, 1.0, np.zeros(0))


def test_the_fewest_targets_that_show_the_goal_are_recommended() -> None:
    """With at least the 60 targets of the handbook, if any plan has them."""
    plans = [a_plan(120, 6.0), a_plan(40, 6.5), a_plan(60, 7.0), a_plan(80, 6.5)]
    assert recommend(plans) == (plans[2], None)
    assert recommend(plans, 7.0) == (plans[2], True)
    assert recommend(plans, 6.9) == (plans[3], True)
    assert recommend(plans, 6.0) == (plans[0], True)
    assert recommend(plans, 5.9) == (plans[0], False)
    too_few = [a_plan(20, 6.0), a_plan(30, 7.0)]
    assert recommend(too_few) == (too_few[1], None)
    assert recommend(too_few, 6.0) == (too_few[1], False)


def test_hole_free_boards_by_hand() -> None:
    """At 2 false calls per m2 on boards of 0.1 m2, 18 % of boards call: 5.5 scores and one more
    space between them are needed, so 5; and exp(-2 A) = 5 % gives A = 1.498 m2, 15 boards."""
    need = hole_free(2.0, 0.1)
    assert need.calibration_boards == 5
    assert need.silent_m2 == pytest.approx(np.log(20.0) / 2.0)
    assert need.silent_boards == 15
    # the highest of five scores: a sixth of boards call
    assert need.expected_per_m2 == pytest.approx(-np.log(1 - 1 / 6) / 0.1, rel=0.2)
    assert need.upper_per_m2 > need.expected_per_m2
    exact = hole_free(float(-np.log(0.8)), 1.0)
    assert exact.calibration_boards == 4
    for wrong in ((0.0, 0.1), (2.0, 0.0), (np.inf, 0.1)):
        with pytest.raises(UserError, match="false calls per m2 on boards"):
            hole_free(*wrong)
