"""Sizes over clusters: the curve over clusters, its likelihood, and what clusters do to ends."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from harness.evaluation.intervals import UPPER
from harness.evaluation.pod import clustered
from harness.evaluation.pod.averaged import ModelAverage, log_weights
from harness.evaluation.pod.clustered import ClusterAverage, _curves_of, _level
from harness.evaluation.pod.curve import LINKS, link_cdf, link_ppf
from harness.evaluation.pod.hit_miss import choose_model, fit_hit_miss, near_models


@dataclass(frozen=True)
class Curve:
    """A curve over clusters, in standardised sizes."""

    mu: float
    sigma: float
    step: int


def study(
    shift_mm: float, boards: int = 12, holes: int = 8, seed: int = 1, link: str = ""
) -> tuple[ModelAverage, np.ndarray]:
    """The average of simulated hits on boards whose a50 differ, or the one model with a ``link``,
    and the board of each."""
    random = np.random.default_rng(seed)
    board = np.repeat(np.arange(boards), holes)
    size_mm = random.permutation(np.linspace(1.0, 14.0, boards * holes))
    middle_mm = 6.0 + shift_mm * random.standard_normal(boards)[board]
    hit = random.random(len(board)) < link_cdf("logit", (size_mm - middle_mm) / 0.8)
    if link:
        return ModelAverage((fit_hit_miss(size_mm, hit, link=link),)), board
    return ModelAverage(near_models(choose_model(size_mm, hit))), board


@pytest.mark.parametrize("step", [0, 2, clustered.STEPS - 1])
@pytest.mark.parametrize("link", LINKS)
def test_the_curve_over_clusters_is_the_mean_over_shifts(link: str, step: int) -> None:
    """Its width, a standard deviation of shifts and curve together, is 1 for all shares."""
    width = clustered.RATIO**-step
    shifts = np.linspace(-8.0, 8.0, 4001)
    density = stats.norm.pdf(shifts) / stats.norm.pdf(shifts).sum()
    deviation = clustered.DEVIATIONS[link] * np.sqrt(1 - width**2)
    for pod in (0.5, 0.9):
        pods = link_cdf(link, (_level(link, pod, step) - deviation * shifts) / width)
        assert density @ pods == pytest.approx(pod, abs=2e-4)


def test_of_a_normal_curve_the_curve_over_clusters_is_normal_with_the_same_width() -> None:
    for step in range(clustered.STEPS):
        assert _level("probit", 0.9, step) == pytest.approx(stats.norm.ppf(0.9), abs=1e-3)


def log_likelihood_of(average: ModelAverage, board: np.ndarray, curve: Curve) -> float:
    """The logarithm of the product over boards of means over 2,001 shifts."""
    fit = average.fits[0]
    shift = np.linspace(-6.0, 6.0, 2001)
    density = stats.norm.pdf(shift) / stats.norm.pdf(shift).sum()
    width = clustered.RATIO**-curve.step
    deviation = clustered.DEVIATIONS[fit.curve.link] * np.sqrt(1 - width**2) * curve.sigma
    total = 0.0
    for number in np.unique(board):
        rows = board == number
        beyond = fit.data.z[rows, None] - curve.mu - deviation * shift
        pods = link_cdf(fit.curve.link, beyond / (width * curve.sigma))
        outcomes = np.where(fit.data.hits[rows, None] > 0, pods, 1 - pods)
        total += float(np.log(density @ outcomes.prod(axis=0)))
    return total


@pytest.mark.parametrize("link", LINKS)
def test_the_likelihood_is_the_product_over_clusters_of_means_over_shifts(link: str) -> None:
    """The weights of the likeliest curve of each share differ as their likelihoods do."""
    average, board = study(1.0, link=link)
    fit = average.fits[0]
    low, high = link_ppf(fit.curve.link, np.array([0.1, 0.9]))
    curves = _curves_of(average, 0, board, 1.0)
    shares = clustered._share_weights()
    excess = []
    for step in range(clustered.STEPS - 1):
        of_step = np.flatnonzero(curves.step == step)
        number = of_step[np.argmax(curves.log_weight[of_step])]
        curve = Curve(float(curves.mu[number]), float(curves.sigma[number]), step)
        width = np.array([curve.sigma * (high - low) / np.ptp(fit.data.z)])
        prior = float(log_weights(width, fit.targets)[0] + np.log(shares[step]))
        log_likelihood = log_likelihood_of(average, board, curve)
        excess.append(float(curves.log_weight[number]) - log_likelihood - prior)
    assert np.ptp(excess) < 0.03


def test_shares_of_shifts_have_an_even_weight_from_0_to_1() -> None:
    weights = clustered._share_weights()
    assert weights.sum() == pytest.approx(1.0)
    first = clustered.SHARES[1] / 2
    assert weights[0] == pytest.approx(first)
    assert weights[-1] == pytest.approx(1 - clustered.SHARES[-2:].mean())


def test_boards_that_differ_make_intervals_wider_and_others_hardly() -> None:
    for shift_mm, least, largest in ((0.0, 0.9, 1.25), (2.5, 1.25, 3.0)):
        average, board = study(shift_mm)
        over_boards = ClusterAverage(average, board)
        single = ClusterAverage(average, np.zeros(len(board), int))
        for pod in (0.5, 0.9):
            interval = over_boards.interval(pod)
            without = single.interval(pod)
            ratio = (interval.high - interval.low) / (without.high - without.low)
            assert least < ratio < largest


def test_a_single_cluster_counts_as_none() -> None:
    average, board = study(0.0)
    single = ClusterAverage(average, np.zeros(len(board), int))
    curves = average.curves
    order = np.argsort(curves.sizes_at(0.9))
    below = np.cumsum(curves.weight[order])
    for share in (0.025, 0.5, 0.975):
        expected = curves.sizes_at(0.9)[order][np.searchsorted(below, share)]
        assert single.quantile(0.9, share) == pytest.approx(expected, rel=0.01)


def test_an_interval_leaves_two_and_a_half_percent_beyond_each_end() -> None:
    average, board = study(1.0)
    over_boards = ClusterAverage(average, board)
    interval = over_boards.interval(0.9)
    assert UPPER == 0.975
    assert interval.low == over_boards.quantile(0.9, 0.025)
    assert interval.high == over_boards.quantile(0.9, 0.975)
    assert interval.low < average.fits[0].curve.size_at(0.9) < interval.high


def test_repeats_that_all_agree_change_nothing() -> None:
    random = np.random.default_rng(2)
    board = np.repeat(np.arange(8), 6)
    size_mm = random.uniform(1.0, 14.0, 48)
    hit = random.random(48) < link_cdf("logit", (size_mm - 6.0) / 0.8)
    once = ModelAverage(near_models(choose_model(size_mm, hit)))
    again = np.repeat(np.arange(48), 3)
    fits = choose_model(size_mm[again], hit[again], inspections=again)
    thrice = ModelAverage(near_models(fits))
    first = ClusterAverage(once, board).interval(0.9)
    second = ClusterAverage(thrice, board[again]).interval(0.9)
    assert second.low == pytest.approx(first.low, rel=2e-3)
    assert second.high == pytest.approx(first.high, rel=2e-3)


def test_a_further_effect_widens_the_interval_by_its_root() -> None:
    average, board = study(0.0, boards=40)
    plain = ClusterAverage(average, board)
    interval = plain.interval(0.9)
    wider = replace(plain, effect=2.0).interval(0.9)
    ratio = (wider.high - wider.low) / (interval.high - interval.low)
    assert ratio == pytest.approx(np.sqrt(2.0), rel=0.1)


def test_the_bound_is_at_least_that_without_clusters() -> None:
    average, board = study(0.0, boards=30)
    bound = ClusterAverage(average, board).bound()
    assert bound.value >= average.bound().value
    assert (bound.pod, bound.confidence, bound.method) == (0.9, 0.95, clustered.METHOD)
    differing, boards = study(2.5, boards=30)
    assert ClusterAverage(differing, boards).bound().value > 1.03 * differing.bound().value


def test_nothing_is_demonstrated_where_a_constant_probability_is_not_rejected() -> None:
    sizes = np.tile(np.arange(1.0, 7.0), 2)
    hits = np.array([0, 1, 0, 1, 0, 1, 1, 0, 0, 1, 1, 1])
    average = ModelAverage(near_models(choose_model(sizes, hits)))
    over_boards = ClusterAverage(average, np.repeat([1, 2], 6))
    assert over_boards.bound() == average.bound()
    assert over_boards.interval(0.5).high == np.inf
    assert np.isfinite(over_boards.interval(0.5).low)


@pytest.mark.slow
def test_intervals_cover_where_boards_differ() -> None:
    """80 studies of 20 boards that differ by 2 mm: 95 % with a standard error of 2.4 %."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    sizes = np.linspace(5.0, 14.0, 9001)
    pods = link_cdf("logit", (sizes[:, None] - 6.0 - 2.0 * nodes) / 0.8) @ weights / weights.sum()
    true_mm = float(np.interp(0.9, pods, sizes))
    covered = []
    for seed in range(80):
        average, board = study(2.0, boards=20, seed=100 + seed)
        interval = ClusterAverage(average, board).interval(0.9)
        covered.append(interval.low <= true_mm <= interval.high)
    assert np.mean(covered) >= 0.88
