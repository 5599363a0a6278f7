"""The next size: the expected variance of a90, and the size that makes it least."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.evaluation.pod.averaged import WeightedCurves
from harness.evaluation.study.next_sizes import (
    CANDIDATES,
    WIDEST,
    ExpectedWidth,
    candidates_mm,
    even_candidate,
)

RANGE_MM = (2.0, 12.0)


def curves(count: int = 9) -> WeightedCurves:
    """Curves of two links about 6 mm, all of which have a90 within the range."""
    random = np.random.default_rng(5)
    weight = random.random(count)
    return WeightedCurves(
        links=("logit", "cloglog"),
        log_sizes=(False, True),
        model=np.arange(count) % 2,
        mu=np.where(np.arange(count) % 2, np.log(7.0), 6.0) + 0.1 * random.standard_normal(count),
        sigma=np.where(np.arange(count) % 2, 0.1, 0.5) * (1 + random.random(count)),
        weight=weight / weight.sum(),
    )


def width(excess: float = 2.0, of: WeightedCurves | None = None) -> ExpectedWidth:
    statement = SimpleNamespace(average=SimpleNamespace(curves=of or curves()))
    limit: Any = SimpleNamespace(statement=statement)
    return ExpectedWidth(limit, RANGE_MM, excess)


def variance(values: np.ndarray, weight: np.ndarray) -> float:
    weight = weight / weight.sum()
    return float(weight @ values**2 - (weight @ values) ** 2)


@pytest.mark.parametrize("candidate", [10, 50, 60, 70])
def test_after_one_damage_the_variance_is_bayes(candidate: int) -> None:
    """The mean, over hit and miss, of the variance of a90 under the weights after the outcome."""
    weighted = curves()
    a90_mm = weighted.sizes_at(0.9)
    pods = weighted.pods(candidates_mm(RANGE_MM)[candidate])
    after = 0.0
    for likelihood in (pods, 1.0 - pods):
        chance = float(weighted.weight @ likelihood)
        after += chance * variance(a90_mm, weighted.weight * likelihood)
    expected = width()
    assert expected.excess == 2.0
    expected.add(candidate)
    ratio = after / variance(a90_mm, weighted.weight)
    assert expected.excess == pytest.approx(2.0 * np.sqrt(ratio), rel=1e-9)


def test_after_several_damages_the_variance_is_that_of_a_regression_on_their_outcomes() -> None:
    weighted = curves()
    chosen = [40, 55, 55, 62]
    a90_mm = weighted.sizes_at(0.9)
    pods = np.array([weighted.pods(candidates_mm(RANGE_MM)[k]) for k in chosen])
    together = np.cov(np.vstack([a90_mm, pods]), aweights=weighted.weight, ddof=0)
    of_outcomes = together[1:, 1:] + np.diag((pods * (1.0 - pods)) @ weighted.weight)
    with_a90 = together[0, 1:]
    after = together[0, 0] - with_a90 @ np.linalg.solve(of_outcomes, with_a90)
    expected = width()
    for candidate in chosen:
        expected.add(candidate)
    assert expected.excess == pytest.approx(2.0 * np.sqrt(after / together[0, 0]), rel=1e-9)


def test_the_best_size_is_the_best_of_all_candidates() -> None:
    after = []
    for candidate in range(CANDIDATES):
        expected = width()
        expected.add(37)
        expected.add(candidate)
        after.append(expected.excess)
    expected = width()
    expected.add(37)
    assert expected.best() == int(np.argmin(after))


def test_of_curves_that_are_only_shifted_the_best_size_is_within_the_rise() -> None:
    shifted = WeightedCurves(
        links=("logit",),
        log_sizes=(False,),
        model=np.zeros(21, int),
        mu=np.linspace(5.9, 6.1, 21),
        sigma=np.full(21, 0.3),
        weight=np.full(21, 1 / 21),
    )
    # the slope of the POD over the deviation of the outcome is greatest at the middle
    assert candidates_mm(RANGE_MM)[width(of=shifted).best()] == pytest.approx(6.0, abs=0.1)


def test_sizes_beyond_the_range_count_as_its_end() -> None:
    """Curves whose a90 differ beyond the range only are not told from each other."""
    flat = WeightedCurves(
        links=("logit",),
        log_sizes=(False,),
        model=np.zeros(3, int),
        mu=np.array([6.0, 12.0, 12.0]),
        sigma=np.array([0.5, 3.0, 300.0]),
        weight=np.array([0.5, 0.25, 0.25]),
    )
    assert 7.0 < candidates_mm(RANGE_MM)[width(of=flat).best()] < 9.0


def test_an_interval_without_an_end_counts_as_wide() -> None:
    assert width(excess=np.inf).excess == WIDEST


def test_even_candidates_are_spread_over_the_range() -> None:
    chosen = np.sort([even_candidate(number) for number in range(100, 150)])
    assert np.diff(chosen).max() <= 2 * CANDIDATES / 50 + 1
    assert chosen[0] < 5
    assert chosen[-1] > CANDIDATES - 6
