"""The tail of noise: its closed form, the weights of its exponents, and the interval of counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import poisson

from detectors.findings.tails import (
    DRAWS,
    EXPONENTS,
    PRIOR,
    Laws,
    Tail,
    _count_reaching,
    counts_of,
)


def test_the_interval_of_counts_is_poissons_where_the_law_is_known() -> None:
    """Quantiles of the Poisson law, from its tables; of a mixture, the smaller expectation decides
    the lower end and the larger one the upper."""
    ends = {0.01: (0, 0), 1.0: (0, 3), 10.0: (4, 17), 300.0: (267, 334)}
    for expected, (fewest, most) in ends.items():
        certain = np.array([expected, expected])
        assert _count_reaching(0.025, certain) == fewest
        assert _count_reaching(0.975, certain) == most
    either = np.array([1.0, 10.0])
    # half of the probability is each law's: 2.5 % of all are 5 % of one
    assert _count_reaching(0.025, either) == 0
    assert _count_reaching(0.975, either) == poisson.ppf(0.95, 10.0)


def test_the_interval_holds_the_truth() -> None:
    """Peaks whose tail is known: exponential in the square of the score. Its expectation lies
    within the central 95 % of the laws that the peaks allow."""
    inside_count = 0
    expected = []
    captures = 150
    for seed in range(captures):
        random = np.random.default_rng([5, seed])
        peaks = np.sqrt(9.0 + 2.0 * random.exponential(size=random.poisson(50)))
        tail = Tail.of(peaks, 3.0)
        threshold = tail.threshold(0.5)
        true = 50.0 * np.exp(-(threshold**2 - 9.0) / 2.0)
        low, high = np.quantile(tail.laws(DRAWS).expected(threshold), (0.025, 0.975))
        inside_count += low < true < high
        expected.append(true)
    # an interval over exponents that are not this one's is wider than it need be
    assert inside_count / captures > 0.90
    assert 0.5 / 1.5 < np.mean(expected) < 0.5 * 1.5


def test_a_tail_of_normal_peaks_is_the_closed_form() -> None:
    """One exponent alone: the expected number is n (1 + E / S)^-(n + 10) with E and S of the excess
    f^2 ((r^2 - 1) / 2 - ln r / f^2) of ratios r to the floor f."""
    floor = 3.0
    peaks = np.array([3.2, 3.4, 3.5, 4.1, 3.05, 3.3, 3.9, 3.6])

    def excess(scores: np.ndarray) -> np.ndarray:
        ratios = scores / floor
        return floor**2 * ((ratios**2 - 1) / 2 - np.log(ratios) / floor**2)

    tail = Tail.of(peaks, floor)
    normal = replace(tail, weights=np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]))
    total = excess(peaks).sum() + 10.0
    expected = 8 * (1 + excess(np.array([5.0]))[0] / total) ** -18.0
    assert normal.expected(5.0) == pytest.approx(expected, rel=1e-12)
    assert normal.expected(normal.threshold(0.3)) == pytest.approx(0.3, rel=1e-9)
    assert tail.weights.sum() == pytest.approx(1.0)
    # as many as there are, or more, are expected at the floor
    assert tail.threshold(8.0) == tail.threshold(20.0) == floor


def test_the_exponents_are_weighed_by_their_likelihood() -> None:
    """The marginal likelihood of the excesses E_i of n peaks, whose scale has a Gamma prior of ten
    peaks: product of dE_i/ds over (10 + sum E_i)^(n + 10)."""
    floor = 4.0
    peaks = 4.0 + np.random.default_rng(3).exponential(0.8, 40)
    ratios = peaks / floor
    logs = []
    for exponent in EXPONENTS:
        power = np.log(ratios) if exponent == 0 else (ratios**exponent - 1) / exponent
        total = 10.0 + (floor**2 * (power - np.log(ratios) / floor**2)).sum()
        slope = ratios ** (exponent - 1) - 1 / floor**2 / ratios
        logs.append(np.log(slope).sum() - 50 * np.log(total))
    weights = PRIOR * np.exp(np.array(logs) - max(logs))
    np.testing.assert_allclose(
        Tail.of(peaks, floor).weights,
        weights / weights.sum(),
        rtol=1e-9,
    )


def test_the_prior_weights_of_exponents_are_probabilities() -> None:
    assert PRIOR.sum() == pytest.approx(1.0, abs=1e-12)
    assert (PRIOR > 0).all()
    assert len(PRIOR) == len(EXPONENTS)
    # averages of a camera's noise are near normal
    assert PRIOR[:2].sum() > 0.8


def test_the_density_of_calls_is_minus_the_slope_of_their_number() -> None:
    exponents = np.array(EXPONENTS)
    laws = Laws(
        floor=3.0,
        exponents=exponents,
        numbers=np.linspace(5.0, 50.0, len(exponents)),
        rates=np.linspace(0.6, 1.4, len(exponents)),
        scale=1.3,
    )
    scores = np.array([4.2, 5.0, 7.5])
    step = 1e-5
    slopes = []
    for score in scores:
        slopes.append((laws.expected(score - step) - laws.expected(score + step)) / (2.0 * step))
    assert laws.densities(scores) == pytest.approx(np.transpose(slopes), rel=1e-6)
    # at the floor, all calls lie above
    assert laws.expected(3.0 * 1.3) == pytest.approx(laws.numbers)


def test_counts_are_those_of_both_sides_of_the_surface() -> None:
    """Twenty thousand peaks leave little doubt about their law: where five are expected on one
    side, the number on both is Poisson with a mean of 10, of which 95 % lie from 4 to 17."""
    peaks = 3.0 + np.random.default_rng(2).exponential(0.3, 20_000)
    tail = Tail.of(peaks, 3.0)
    threshold = tail.threshold(5.0)
    assert counts_of({"plain": tail}, threshold) == (4.0, 17.0)
    # laws of two places add up
    beside = Tail.of(peaks, 3.0)
    ends = counts_of({"plain": tail, "at marks": beside}, threshold)
    assert ends == pytest.approx(poisson.ppf([0.025, 0.975], 20.0).tolist(), abs=1)
