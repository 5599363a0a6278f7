"""POD from hits and misses: the handbook's digits, a second oracle, theory and coverage."""

from __future__ import annotations

import csv
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize, stats

from harness.evaluation.pod import hit_miss
from harness.evaluation.pod.curve import LINKS, HitsAndMisses, link_cdf, link_ppf, profile
from harness.evaluation.pod.hit_miss import (
    _metric_root,
    _rising_curves,
    _search,
    band,
    bound,
    choose_model,
    criterion,
    fit_hit_miss,
    floor_ceiling_tests,
    rows_of_target,
    value_and_gradient,
)
from harness.vocabulary.errors import UserError


def columns(path: Path, *names: str) -> list[np.ndarray]:
    """Columns of one of the handbook's examples."""
    with path.open(encoding="utf-8-sig") as file:
        rows = [row for row in csv.DictReader(file) if row[names[0]]]
    return [np.array([float(row[name]) for row in rows]) for name in names]


@pytest.fixture
def example3(shared_data: Path) -> list[np.ndarray]:
    return columns(shared_data / "pod" / "example3_hitmiss.csv", "length.inch", "hit.miss")


@pytest.fixture
def example4(shared_data: Path) -> list[np.ndarray]:
    return columns(shared_data / "pod" / "example4_hitmiss.csv", "inches", "hit.miss")


def simulated(
    targets: int,
    seed: int,
    floor: float = 0.0,
    ceiling: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of 0.5 to 10 mm and hits of a logistic curve at 4 mm with sigma 0.8 mm."""
    sizes = np.linspace(0.5, 10.0, targets)
    chance = floor + (ceiling - floor) * link_cdf("logit", (sizes - 4.0) / 0.8)
    return sizes, np.random.default_rng(seed).random(targets) < chance


def standardised(
    sizes: np.ndarray,
    hits: np.ndarray,
    link: str,
) -> HitsAndMisses:
    design = np.column_stack([np.ones_like(sizes), (sizes - sizes.mean()) / sizes.std()])
    return HitsAndMisses(design, hits.astype(float), 1.0 - hits, link)


# the handbook's worked examples


def test_example_3_gives_the_handbooks_digits(example3: list[np.ndarray]) -> None:
    fit = fit_hit_miss(*example3)
    assert fit.n == 134
    assert fit.hits == 92
    assert fit.method == "ML"
    assert fit.notes == ()
    assert fit.b0 == pytest.approx(-4.5974, abs=5e-5)
    assert fit.b1 == pytest.approx(39.765, abs=5e-4)
    # The handbook's standard errors are of its last but one iteration: 0.87755 and 6.9528.
    assert np.sqrt(np.diag(fit.covariance)) == pytest.approx([0.87755, 6.9528], rel=2e-4)
    assert fit.curve.size_at(0.5) == pytest.approx(0.1156, abs=5e-5)
    assert fit.curve.size_at(0.9) == pytest.approx(0.1709, abs=5e-5)
    assert bound(fit).value == pytest.approx(0.1974, abs=5e-5)
    assert round(fit.deviance) == 77
    assert round(fit.null_deviance) == 167


def test_targets_inspected_unequally_often_count_once_each(example3: list[np.ndarray]) -> None:
    """Rows of every third target three times: the same curve and bound as of each once."""
    size, hit = example3
    times = np.where(np.arange(len(size)) % 3 == 0, 3, 1)
    once = fit_hit_miss(size, hit)
    often = fit_hit_miss(
        *(np.repeat(column, times) for column in (size, hit)),
        inspections=np.repeat(np.arange(len(size)), times),
    )
    assert often.targets == len(size)
    assert often.n == times.sum()
    assert "1 to 3 inspections per target" in often.notes[-1]
    assert (often.curve.mu, often.curve.sigma) == pytest.approx(
        (once.curve.mu, once.curve.sigma), rel=1e-5
    )
    assert often.covariance == pytest.approx(once.covariance, rel=1e-4)
    assert bound(often).value == pytest.approx(bound(once).value, rel=1e-5)


def test_example_3_over_the_logarithm(example3: list[np.ndarray]) -> None:
    fit = fit_hit_miss(*example3, log_size=True)
    assert bound(fit).value == pytest.approx(0.2106, abs=5e-5)
    assert round(fit.deviance) == 80


def test_example_4_by_complementary_log_log(example4: list[np.ndarray]) -> None:
    fit = fit_hit_miss(*example4, link="cloglog")
    assert fit.n == 100
    assert fit.hits == 61
    assert fit.curve.mu == pytest.approx(0.0975, rel=0.01)
    assert float(fit.curve.pod(np.array(fit.curve.mu))) == pytest.approx(
        1.0 - np.exp(-1.0), abs=1e-12
    )
    assert fit.curve.size_at(0.9) == pytest.approx(0.1315, rel=0.01)
    assert bound(fit).value == pytest.approx(0.1553, rel=0.01)
    assert choose_model(*example4)[0].curve.link == "cloglog"


def test_models_are_chosen_by_deviance_and_not_by_their_limits(example3: list[np.ndarray]) -> None:
    fits = choose_model(*example3)
    assert sorted((fit.curve.link, fit.curve.log_size) for fit in fits) == sorted(
        (link, log) for link in LINKS for log in (False, True)
    )
    deviances = [fit.deviance for fit in fits]
    assert deviances == sorted(deviances)
    assert {fit.curve.log_size for fit in choose_model(example3[0] - 0.1, example3[1])} == {False}


@pytest.mark.parametrize("link", LINKS)
def test_statsmodels_agrees(link: str) -> None:
    models = pytest.importorskip("statsmodels.api")
    names = {"logit": "Logit", "probit": "Probit", "cloglog": "CLogLog", "loglog": "LogLog"}
    family = models.families.Binomial(getattr(models.families.links, names[link])())
    sizes, hits = simulated(80, seed=3)
    expected = models.GLM(hits, models.add_constant(sizes), family=family).fit(
        tol=1e-12, maxiter=500
    )
    fit = fit_hit_miss(sizes, hits, link=link)
    assert [fit.b0, fit.b1] == pytest.approx(expected.params, rel=1e-6)
    assert fit.covariance == pytest.approx(expected.cov_params(), rel=1e-5)
    assert fit.deviance == pytest.approx(expected.deviance, rel=1e-10)


@pytest.mark.parametrize("log_size", [False, True])
def test_the_covariance_of_a_curve_is_by_the_delta_method(log_size: bool) -> None:
    """Numeric slopes of mu = -b0 / b1 and sigma = 1 / b1."""
    fit = fit_hit_miss(*simulated(60, seed=5), log_size=log_size)

    def curve(b: np.ndarray) -> np.ndarray:
        return np.array([-b[0] / b[1], 1 / b[1]])

    b = np.array([fit.b0, fit.b1])
    assert curve(b) == pytest.approx([fit.curve.mu, fit.curve.sigma])
    step = 1e-6 * np.eye(2)
    slopes = np.stack([(curve(b + h) - curve(b - h)) / 2e-6 for h in step], axis=1)
    expected = slopes @ fit.covariance @ slopes.T
    assert fit.curve.covariance == pytest.approx(expected, rel=1e-5)


def test_notes_tell_separation_and_inspections() -> None:
    sizes = np.arange(1.0, 9.0)
    overlapping = np.array([0, 0, 1, 0, 0, 1, 1, 1])
    assert fit_hit_miss(sizes, overlapping).notes == ()
    (separated,) = fit_hit_miss(sizes, sizes > 4).notes
    assert "separation" in separated


# bounds


def test_the_criterion_is_the_handbooks() -> None:
    assert criterion(0.95) == pytest.approx(3.841, abs=5e-4)


@pytest.mark.parametrize("link", LINKS)
def test_the_bound_is_the_largest_a90_of_the_likelihood_ratio_set(link: str) -> None:
    sizes, hits = simulated(60, seed=5)
    fit = fit_hit_miss(sizes, hits, link=link)
    limit = bound(fit).value
    level = float(link_ppf(link, np.array(0.9)))
    slopes = np.geomspace(1e-4, 20.0, 20_000)[:, None]

    def ratio(a90: float) -> float:
        p = np.clip(link_cdf(link, level + slopes * (sizes - a90)), 1e-300, 1.0 - 1e-16)
        return 2.0 * (
            fit.log_likelihood - float(np.log(np.where(hits, p, 1.0 - p)).sum(axis=1).max())
        )

    assert ratio(limit * (1.0 - 1e-4)) < 3.841458821 < ratio(limit * (1.0 + 1e-4))
    assert all(ratio(limit * farther) > 3.841458821 for farther in (1.01, 1.1, 1.5, 3.0, 30.0))


@pytest.mark.parametrize("log_size", [False, True])
def test_the_band_crosses_ninety_per_cent_at_the_bound(log_size: bool) -> None:
    fit = fit_hit_miss(*simulated(60, seed=5), log_size=log_size)
    limit = bound(fit).value
    lower, upper = band(fit, np.array([limit, 2.0, 4.0, 9.0]))
    assert lower[0] == pytest.approx(0.9, abs=1e-4)
    middle = fit.curve.pod(np.array([limit, 2.0, 4.0, 9.0]))
    assert (lower < middle).all()
    assert (middle < upper).all()


@pytest.mark.parametrize("link", LINKS)
def test_the_band_of_a_small_study_holds_all_curves_of_the_likelihood_ratio_set(link: str) -> None:
    """18 targets: the set reaches further than two standard errors on one side."""
    sizes, hits = simulated(18, seed=3)
    fit = fit_hit_miss(sizes, hits, link=link)
    intercepts = np.linspace(-20.0, 40.0, 241)
    slopes = np.geomspace(0.2, 80.0, 120)
    grid = np.stack(np.meshgrid(intercepts, slopes, indexing="ij"), axis=-1).reshape(-1, 2)
    top = float(fit.data.value(fit.maximum))
    inside = grid[2.0 * (top - fit.data.value(grid)) <= criterion(0.95)]
    at_mm = np.array([2.5, 3.5, 4.5, 6.0])
    predictors = inside[:, :1] + inside[:, 1:] * (at_mm - fit.centre) / fit.spread
    low, high = band(fit, at_mm)
    assert low == pytest.approx(link_cdf(link, predictors.min(axis=0)), abs=0.02)
    assert high == pytest.approx(link_cdf(link, predictors.max(axis=0)), abs=0.02)


def test_rows_of_a_target_are_counted_wherever_they_stand() -> None:
    sizes = np.array([1.0, 2.0, 1.0, 3.0, 1.0])
    assert rows_of_target(sizes, ["a", "b", "a", "c", "a"]).tolist() == [3, 1, 3, 1, 3]
    assert rows_of_target(sizes, [7, 8, 7, 9, 7]).tolist() == [3, 1, 3, 1, 3]
    assert rows_of_target(sizes, None).tolist() == [1] * 5


def test_a_band_in_blocks_of_curves_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory for less than one curve is memory for one curve at a time."""
    fit = fit_hit_miss(*simulated(60, seed=5))
    at_mm = np.array([2.5, 4.0, 6.0])
    complete = band(fit, at_mm)
    for cells in (59, 200):
        monkeypatch.setattr(hit_miss, "CELLS", cells)
        for level, expected in zip(band(fit, at_mm), complete, strict=True):
            assert level == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("repeats", [1.0, 4.0])
def test_rays_are_scaled_by_the_covariance_in_standardised_sizes(repeats: float) -> None:
    """b0' = b0 + b1 centre and b1' = b1 spread. Of a singular covariance, the root spans both
    directions, the other with 1 % of the largest deviation."""
    fit = replace(fit_hit_miss(*simulated(60, seed=5)), repeats=repeats)
    scale = np.array([[1.0, fit.centre], [0.0, fit.spread]])
    root = _metric_root(fit)
    assert root @ root.T == pytest.approx(scale @ fit.covariance @ scale.T / repeats)
    flat = replace(fit, centre=0.0, spread=1.0, covariance=repeats * np.diag([0.0, 4.0]))
    root = _metric_root(flat)
    assert root @ root.T == pytest.approx(np.diag([4e-4, 4.0]))
    root = _metric_root(replace(flat, covariance=np.zeros((2, 2))))
    assert root @ root.T == pytest.approx(1e-12 * np.eye(2))


def test_a_weak_study_demonstrates_nothing_and_says_why() -> None:
    sizes = np.tile(np.arange(1.0, 7.0), 2)
    hits = np.array([0, 1, 0, 1, 0, 1, 1, 0, 0, 1, 1, 1])
    fit = fit_hit_miss(sizes, hits)
    limit = bound(fit)
    assert limit.value == np.inf
    assert not limit.demonstrated
    assert limit.why.startswith("not demonstrated: ")


def test_the_bound_is_infinite_exactly_where_a_flat_curve_is_within_the_criterion() -> None:
    sizes = np.tile(np.arange(1.0, 7.0), 3)
    hits = np.array([0, 0, 0, 1, 1, 1, 0, 0, 1, 0, 1, 1, 0, 1, 0, 1, 0, 1])
    fit = fit_hit_miss(sizes, hits)
    confidence = float(stats.chi2.cdf(fit.null_deviance - fit.deviance, 1))
    assert bound(fit, confidence=confidence - 1e-4).demonstrated
    assert not bound(fit, confidence=confidence + 1e-4).demonstrated


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), scale=st.floats(1e-3, 1e3))
def test_a_bound_carries_the_unit_of_the_sizes(seed: int, scale: float) -> None:
    sizes, hits = simulated(50, seed)
    limit = bound(fit_hit_miss(sizes * 1.0, hits)).value
    scaled = bound(fit_hit_miss(sizes * scale, hits)).value
    assert scaled == pytest.approx(limit * scale, rel=1e-6)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), pod=st.floats(0.5, 0.95))
def test_bounds_grow_with_confidence_and_pod_and_lie_over_the_estimate(
    seed: int, pod: float
) -> None:
    fit = fit_hit_miss(*simulated(60, seed))
    limits = [bound(fit, pod, confidence).value for confidence in (0.6, 0.8, 0.95)]
    assert fit.curve.size_at(pod) < limits[0] < limits[1] < limits[2]
    assert bound(fit, pod + 0.04).value > limits[2]


# repeats


@pytest.mark.parametrize("seed", [0, 1])
def test_repeats_that_all_agree_say_no_more_than_one_inspection(seed: int) -> None:
    sizes, hits = simulated(30, seed)
    once = fit_hit_miss(sizes, hits)
    names = np.repeat(np.arange(30), 50)
    often = fit_hit_miss(np.repeat(sizes, 50), np.repeat(hits, 50), inspections=names)
    assert often.n == 1500
    assert often.targets == 30
    assert often.repeats == 50.0
    assert often.covariance == pytest.approx(once.covariance, rel=1e-6)
    assert bound(often).value == pytest.approx(bound(once).value, rel=1e-6)
    wrong = bound(fit_hit_miss(np.repeat(sizes, 50), np.repeat(hits, 50)))
    assert wrong.value < bound(once).value
    assert "1500 inspections of 30 targets count as 30" in often.notes[-1]


def test_a_target_with_two_sizes_is_refused() -> None:
    with pytest.raises(UserError, match="target b has more than one size"):
        fit_hit_miss([1, 2, 3, 4], [0, 1, 0, 1], inspections=["a", "b", "b", "c"])
    with pytest.raises(UserError, match="3 target names for 4 rows"):
        fit_hit_miss([1, 2, 3, 4], [0, 1, 0, 1], inspections=["a", "b", "c"])


# separation


def test_complete_separation_is_fitted_by_firths_penalty() -> None:
    sizes = np.arange(1.0, 13.0)
    fit = fit_hit_miss(sizes, sizes > 6)
    assert fit.method == "Firth"
    assert "separation" in fit.notes[0]
    # Firth's modified score for the logit: sum of (y - p + h (1/2 - p)) (1, x) = 0, h the
    # leverages.
    design = np.column_stack([np.ones(12), sizes])
    p = link_cdf("logit", design @ [fit.b0, fit.b1])
    weight = p * (1.0 - p)
    leverage = weight * np.einsum("ij,jk,ik->i", design, fit.covariance, design)
    score = design.T @ ((sizes > 6) - p + leverage * (0.5 - p))
    assert score == pytest.approx([0.0, 0.0], abs=1e-6)
    assert leverage.sum() == pytest.approx(2.0)
    assert fit.curve.mu == pytest.approx(6.5, abs=1e-6)


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("log_size", [False, True])
def test_separated_data_have_finite_curves_and_honest_bounds(link: str, log_size: bool) -> None:
    sizes = np.arange(1.0, 13.0)
    fit = fit_hit_miss(sizes, sizes > 6, link=link, log_size=log_size)
    assert 5.0 < fit.curve.size_at(0.5) < 8.0
    limit = bound(fit).value
    # Six hits in a row alone show no more than POD 0.5^(1/6) of 60 % at 95 %: no 90 % just above
    # the largest miss.
    assert limit > max(9.0, fit.curve.size_at(0.9))


@pytest.mark.parametrize(
    ("hits", "separated"),
    [
        ([0, 0, 0, 1, 1, 1], True),
        ([0, 0, 1, 0, 1, 1], False),
    ],
)
def test_separation_is_told_from_overlap(hits: list[int], separated: bool) -> None:
    assert (fit_hit_miss([1, 2, 3, 4, 5, 6], hits).method == "Firth") is separated


@pytest.mark.parametrize(
    ("link", "seed", "n"),
    [("cloglog", 28, 55), ("cloglog", 29, 75), ("loglog", 49, 9), ("logit", 28, 55)],
)
def test_of_several_penalised_maxima_the_highest_is_taken(
    link: str,
    seed: int,
    n: int,
) -> None:
    """Compared with a fine grid of places and slopes, on data of which single starts end in lower
    maxima."""
    rng = np.random.default_rng(seed)
    assert rng.integers(6, 80) == n
    sizes = rng.choice(rng.uniform(2, 14, n), n) if seed % 2 else rng.uniform(2, 14, n)
    fit = fit_hit_miss(sizes, sizes > rng.uniform(4, 10), link=link)
    assert fit.method == "Firth"
    b0 = fit.b0 + fit.b1 * fit.centre
    b1 = fit.b1 * fit.spread
    is_hit = fit.data.hits > 0
    below = fit.data.z[~is_hit].max()
    above = fit.data.z[is_hit].min()
    slopes = np.geomspace(0.2, 3000, 120)[:, None]
    middles = np.linspace(below - 1, above + 1, 200)
    values = fit.data.value(np.stack([-slopes * middles, slopes + 0 * middles], axis=-1))
    assert float(fit.data.value(np.array([b0, b1]))) >= values.max()


def test_quasi_complete_separation_is_separation() -> None:
    assert fit_hit_miss([1, 2, 3, 3, 4, 5], [0, 0, 0, 1, 1, 1]).method == "Firth"


# floor and ceiling


def test_floor_and_ceiling_are_found_where_they_are() -> None:
    sizes, hits = simulated(1500, seed=2, floor=0.15, ceiling=0.85)
    test = floor_ceiling_tests(fit_hit_miss(sizes, hits))[-1]
    assert test.needed
    assert test.p_value < 1e-9
    assert test.beyond == "both"
    # 4 standard errors of a rate of 0.15 over the 300 targets or more at either end: 0.08.
    assert test.floor == pytest.approx(0.15, abs=0.08)
    assert test.ceiling == pytest.approx(0.85, abs=0.08)


@pytest.mark.parametrize("seed", [5, 13])
def test_the_search_finds_the_best_of_many_random_starts(seed: int) -> None:
    sizes, hits = simulated(60, seed, floor=0.1, ceiling=0.9)
    data = standardised(sizes, hits, "logit")
    random = np.random.default_rng(0)
    starts = random.uniform([-5.0, 0.5, 0.0, 0.6], [5.0, 30.0, 0.4, 1.0], (25, 4))
    losses = [
        optimize.minimize(
            lambda curve: tuple(-part for part in value_and_gradient(data, curve)),
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=((-1e4, 1e4), (1e-6, 1e3), (0.0, 0.5), (0.5, 1.0)),
        ).fun
        for start in starts
    ]
    plain = fit_hit_miss(sizes, hits).maximum
    likelihood = _search(data, plain, (0.0, 0.5), (0.5, 1.0))[1]
    assert -likelihood <= min(losses) + 5e-5


@pytest.mark.parametrize(("seed", "repeats"), [(12, 1), (8, 3), (13, 1)])
def test_p_values_of_floor_and_ceiling_are_those_of_the_mixtures(seed: int, repeats: int) -> None:
    """The likeliest four-parameter curves by a search of their own; repeats of a target that all
    agree change nothing."""
    sizes, hits = simulated(120, seed, floor=0.1, ceiling=0.88)
    names = np.repeat(np.arange(120), repeats)
    fit = fit_hit_miss(np.repeat(sizes, repeats), np.repeat(hits, repeats), inspections=names)
    data = standardised(sizes, hits, "logit")
    ranges = {
        "floor": ((0.0, 0.5), (1.0, 1.0)),
        "ceiling": ((0.0, 0.0), (0.5, 1.0)),
        "both": ((0.0, 0.5), (0.5, 1.0)),
    }
    needed = []
    for test in floor_ceiling_tests(fit):
        floor, ceiling = ranges[test.beyond]
        losses = []
        for start in product((-1.0, 0.0, 1.0), (2.0, 10.0, 50.0), (0.0, 0.1), (0.9, 1.0)):
            begin = np.array(start)
            begin[0] *= begin[1]
            begin[2:] = np.clip(begin[2:], [floor[0], ceiling[0]], [floor[1], ceiling[1]])
            end = optimize.minimize(
                lambda curve: tuple(-part for part in value_and_gradient(data, curve)),
                begin,
                jac=True,
                method="L-BFGS-B",
                bounds=((-1e3, 1e3), (1e-6, 1e3), floor, ceiling),
                options={"ftol": 1e-14, "gtol": 1e-9},
            )
            losses.append(end.fun)
        statistic = 2 * (-min(losses) - fit.log_likelihood / repeats)
        tail_of_one, two = stats.chi2.sf(statistic, [1, 2])
        expected = 0.5 * tail_of_one + 0.25 * two if test.beyond == "both" else 0.5 * tail_of_one
        if statistic < 1e-6:  # neither fits better
            expected = 1.0
        else:
            needed.append(test.beyond)
        assert test.p_value == pytest.approx(expected, rel=2e-3)
    assert needed == {12: ["floor", "both"]}.get(seed, ["ceiling", "both"])


def test_rising_curves_cover_quantiles_the_middle_and_steps() -> None:
    """Four widths about 16 quantiles and about the plain curve's middle, and a step between
    neighbours that rises by 6 from one to the other; none is steeper than a thousand."""
    z = np.array([0.0, 1.0, 3.0, 3.001, 1.0])
    curves = _rising_curves(z, np.array([-5.0, 2.0]))
    assert len(curves) == 17 * 4 + 3
    slopes = curves[:, 1]
    middles = -curves[:, 0] / np.array([*np.tile([2.0, 6.0, 24.0, 100.0], 17), 6.0, 3.0, 6000.0])
    quantiles = np.quantile(z, np.linspace(0.04, 0.96, 16))
    assert middles[:64:4] == pytest.approx(quantiles)
    assert middles[64:68] == pytest.approx([2.5] * 4)
    assert slopes[:8].tolist() == [2.0, 6.0, 24.0, 100.0] * 2
    assert middles[68:] == pytest.approx([0.5, 2.0, 3.0005])
    assert slopes[68:].tolist() == [6.0, 3.0, 1000.0]


@pytest.mark.slow
def test_floor_is_seldom_found_where_there_is_none() -> None:
    # Size of the test, alpha 5 %: 80 studies, binomial; 11 rejections or more have a chance of 0.3
    # %.
    rejected = sum(
        floor_ceiling_tests(fit_hit_miss(*simulated(80, seed)))[0].needed for seed in range(80)
    )
    assert rejected <= 10


def test_ceiling_of_one_adds_nothing_and_the_boundary_has_half_the_probability() -> None:
    sizes, hits = simulated(80, seed=6)
    hits = hits | (sizes > 6)
    test = floor_ceiling_tests(fit_hit_miss(sizes, hits))[1]
    assert test.beyond == "ceiling"
    assert test.p_value == 1.0
    assert test.needed is False


def test_gradient_of_the_bounded_likelihood() -> None:
    sizes, hits = simulated(60, seed=1, floor=0.1, ceiling=0.9)
    data = standardised(sizes, hits, "probit")
    curve = np.array([0.3, 1.7, 0.12, 0.93])
    numeric = optimize.approx_fprime(curve, lambda point: value_and_gradient(data, point)[0], 1e-7)
    assert value_and_gradient(data, curve)[1] == pytest.approx(numeric, rel=1e-4)


# coverage


@pytest.mark.slow
def test_coverage_of_the_default_is_its_name() -> None:
    """300 studies of the true model: Monte Carlo standard error 1.3 % at 95 %; 0.91 to 0.99 is 3 of
    them on either side."""
    a90_mm = 4.0 + 0.8 * np.log(9.0)
    above = [bound(fit_hit_miss(*simulated(60, seed))).value >= a90_mm for seed in range(300)]
    assert 0.91 <= np.mean(above) <= 0.99


# refusals


def test_a_chance_that_falls_with_size_is_refused() -> None:
    sizes, hits = simulated(60, seed=1)
    for wrong in (~hits, sizes < 5):
        with pytest.raises(UserError, match="does not grow with size"):
            fit_hit_miss(sizes, wrong)


@pytest.mark.parametrize(
    ("sizes", "hits", "more", "message"),
    [
        ([1, 2, 3], [0, 1, 2], {}, "hit 2 is 2"),
        ([1, 2, 3], [0, 1], {}, "differ in shape"),
        ([1, 2, 3], [1, 1, 1], {}, "every target was found"),
        ([1, 2, 3], [0, 0, 0], {}, "every target was missed"),
        ([2, 2, 2], [0, 1, 0], {}, "all sizes are 2"),
        ([0, 1, 2], [0, 1, 1], {"log_size": True}, "size 0 has no logarithm"),
        ([1, np.nan, 2], [0, 1, 1], {}, "size 1 is not a finite number"),
        ([1, 2, 3], [0, 1, 1], {"link": "cauchit"}, "link 'cauchit' is not known"),
    ],
)
def test_data_that_cannot_be_fitted_are_refused(
    sizes: list[float],
    hits: list[float],
    more: dict[str, object],
    message: str,
) -> None:
    with pytest.raises(UserError, match=message):
        fit_hit_miss(sizes, hits, **more)  # type: ignore[arg-type]


def test_bounds_that_do_not_exist_are_refused() -> None:
    fit = fit_hit_miss(*simulated(60, seed=1))
    for arguments, message in (
        ({"pod": 1.0}, "POD 1 is out of range"),
        ({"confidence": 0.5}, "confidence 0.5 is out of range"),
    ):
        with pytest.raises(UserError, match=message):
            bound(fit, **arguments)


def test_a_bound_far_beyond_all_sizes_is_where_the_ratio_says():
    """Three hits of 72, which hardly grow with size: far out, plain Newton steps end where all
    chances round to 0."""
    size = np.repeat(np.linspace(11.0, 36.0, 24), 3)
    hit = np.isin(np.arange(72), (53, 64, 71)).astype(float)
    for log_size in (True, False):
        fit = fit_hit_miss(size, hit, link="cloglog", log_size=log_size)
        limit = bound(fit)
        top = float(fit.data.value(fit.maximum))
        level = float(link_ppf("cloglog", np.array(0.9)))
        slopes = np.geomspace(1e-4, 10.0, 4000)
        for far in (4.0, 32.0, 64.0, 200.0):
            largest = fit.data.value(np.stack([level - slopes * far, slopes], axis=-1)).max()
            assert profile(fit.data, far, level, 1.0)[0] == pytest.approx(largest, abs=1e-3)
        if limit.demonstrated:
            z = ((np.log(limit.value) if log_size else limit.value) - fit.centre) / fit.spread
            assert 2.0 * (top - profile(fit.data, z, level, 0.1)[0]) == pytest.approx(
                criterion(0.95), abs=1e-6
            )
