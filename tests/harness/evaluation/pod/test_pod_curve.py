"""Links, likelihoods and their maxima against SciPy's distributions and numeric derivatives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import optimize, stats

from harness.evaluation.pod import curve as curves
from harness.evaluation.pod.curve import (
    LARGEST_PREDICTOR,
    LINKS,
    Bound,
    HitsAndMisses,
    PodCurve,
    ascend,
    flat_maximum,
    link_cdf,
    link_ppf,
    logs_of_link,
    maxima,
    penalised_maxima,
    profile,
    slopes_of_link,
)

LAWS = {
    "logit": stats.logistic,
    "probit": stats.norm,
    "cloglog": stats.gumbel_l,
    "loglog": stats.gumbel_r,
}
PREDICTORS = np.array([-4.0, -1.3, -0.2, 0.0, 0.4, 1.1, 2.5])
SIZES = np.linspace(-1.5, 1.8, 9)
HITS = np.array([0.0, 0.0, 1.0, 0.0, 2.0, 0.0, 1.0, 1.0, 3.0])
MISSES = np.array([1.0, 2.0, 0.0, 1.0, 1.0, 1.0, 0.0, 1.0, 0.0])


def data_of(
    link: str,
    penalty: float | None = None,
    offset: float = 0.0,
) -> HitsAndMisses:
    """One study of nine sizes, of which hits and misses overlap."""
    design = np.column_stack([np.ones_like(SIZES), SIZES])
    return HitsAndMisses(design, HITS, MISSES, link, penalty, offset)


def studies_of(data: HitsAndMisses) -> HitsAndMisses:
    """The study and its mirror image, as two studies."""
    penalty = None if data.penalty is None else np.array([data.penalty, data.penalty])
    hits = np.stack([data.hits, data.misses[::-1]])
    misses = np.stack([data.misses, data.hits[::-1]])
    return replace(data, hits=hits, misses=misses, penalty=penalty)


def separated(link: str) -> HitsAndMisses:
    """All misses below all hits."""
    hits = (SIZES > 0.1).astype(float)
    return replace(data_of(link, 1.0), hits=hits[None], misses=1.0 - hits[None])


@pytest.mark.parametrize("link", LINKS)
def test_links_are_the_laws_of_their_names(link: str) -> None:
    law = LAWS[link]
    assert link_cdf(link, PREDICTORS) == pytest.approx(law.cdf(PREDICTORS), rel=1e-12)
    shares = np.array([0.01, 0.3, 0.5, 0.9])
    assert link_ppf(link, shares) == pytest.approx(law.ppf(shares), rel=1e-12)


@pytest.mark.parametrize("link", LINKS)
def test_logarithms_are_accurate_in_both_tails(link: str) -> None:
    law = LAWS[link]
    far = np.array([-30.0, -6.0, -1.0, 0.5, 3.0])
    log_hit, log_miss, log_density = logs_of_link(link, far)
    assert log_hit == pytest.approx(law.logcdf(far), rel=1e-9)
    assert log_miss == pytest.approx(law.logsf(far), rel=1e-9)
    assert log_density == pytest.approx(law.logpdf(far), rel=1e-9)


@pytest.mark.parametrize("link", LINKS)
def test_predictors_are_limited_on_both_sides(link: str) -> None:
    for sign in (-1.0, 1.0):
        limit = np.array([sign * LARGEST_PREDICTOR])
        beyond = 3.0 * limit
        assert np.array_equal(logs_of_link(link, beyond), logs_of_link(link, limit))
        assert np.array_equal(slopes_of_link(link, beyond), slopes_of_link(link, limit))


@pytest.mark.parametrize("link", LINKS)
def test_slopes_are_the_derivatives_of_the_logarithms(link: str) -> None:
    step = 1e-5
    above = logs_of_link(link, PREDICTORS + step)
    below = logs_of_link(link, PREDICTORS - step)
    by_hit, by_miss, by_density = (np.array(above) - np.array(below)) / (2 * step)
    up, down, bend = slopes_of_link(link, PREDICTORS)
    assert up == pytest.approx(by_hit, rel=1e-7, abs=1e-8)
    assert down == pytest.approx(-by_miss, rel=1e-7, abs=1e-8)
    assert bend == pytest.approx(by_density, rel=1e-7, abs=1e-8)


@pytest.mark.parametrize("link", LINKS)
def test_the_likelihood_is_the_sum_over_hits_and_misses(link: str) -> None:
    b = np.array([0.3, 1.4])
    law = LAWS[link]
    predictor = 0.3 + 1.4 * SIZES + 0.2
    expected = HITS @ law.logcdf(predictor) + MISSES @ law.logsf(predictor)
    data = data_of(link, offset=0.2)
    assert data.value(b) == pytest.approx(expected, rel=1e-12)
    several = data.value(np.stack([b, b + 0.5]))
    values = [float(data.value(b)), float(data.value(b + 0.5))]
    assert several.tolist() == pytest.approx(values, rel=1e-13)


@pytest.mark.parametrize("link", LINKS)
def test_the_penalty_is_half_the_logarithm_of_the_information(link: str) -> None:
    b = np.array([0.3, 1.4])
    law = LAWS[link]
    predictor = 0.3 + 1.4 * SIZES
    weight = law.pdf(predictor) ** 2 / (law.cdf(predictor) * law.sf(predictor))
    design = np.column_stack([np.ones_like(SIZES), SIZES])
    information = design.T @ (((HITS + MISSES) * weight)[:, None] * design)
    expected = data_of(link).value(b) + 3.0 * 0.5 * np.log(np.linalg.det(information))
    assert data_of(link, 3.0).value(b) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("link", LINKS)
def test_rows_of_one_outcome_count_as_those_of_both(link: str) -> None:
    """Values and steps of several studies, of which some rows are never hit or never missed, are
    those by the logarithms and slopes of both outcomes, to the last bit."""
    data = studies_of(data_of(link))
    data = replace(data, hits=data.hits * (SIZES > -1.0), misses=data.misses * (SIZES < 1.0))
    b = np.array([[0.3, 1.4], [-0.2, 3.0]])
    predictor = b @ data.design.T
    log_hit, log_miss, _ = logs_of_link(link, predictor)
    expected = (data.hits * log_hit + data.misses * log_miss).sum(axis=1)
    value, step = data.climb(b, np.arange(2))
    assert value.tolist() == expected.tolist()
    assert data.value(b).tolist() == expected.tolist()

    up, down, bend = slopes_of_link(link, predictor)
    of_hits = data.hits * up * np.maximum(up - bend, 0.0)
    of_misses = data.misses * down * np.maximum(down + bend, 0.0)
    gradient = (data.hits * up - data.misses * down) @ data.design
    weighted = (of_hits + of_misses)[:, :, None] * data.design
    information = weighted.transpose(0, 2, 1) @ data.design
    newton = np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
    assert step == pytest.approx(newton, rel=1e-9)


def numeric_gradient(data: HitsAndMisses, b: np.ndarray) -> np.ndarray:
    step = 1e-5 * np.eye(len(b))
    return np.array([(data.value(b + h) - data.value(b - h)) / 2e-5 for h in step])


def numeric_hessian(data: HitsAndMisses, b: np.ndarray) -> np.ndarray:
    step = 1e-4 * np.eye(len(b))
    rows = [(numeric_gradient(data, b + h) - numeric_gradient(data, b - h)) / 2e-4 for h in step]
    return np.array(rows)


@pytest.mark.parametrize("link", LINKS)
def test_a_step_is_newtons(link: str) -> None:
    b = np.array([0.2, 0.9])
    data = data_of(link, offset=0.1)
    step = studies_of(data).step(np.stack([b, -b]))[0]
    expected = np.linalg.solve(-numeric_hessian(data, b), numeric_gradient(data, b))
    assert step == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("link", LINKS)
def test_a_step_of_a_single_coefficient_is_newtons(link: str) -> None:
    data = replace(data_of(link), design=SIZES[:, None] - 0.3)
    b = np.array([0.7])
    study = replace(data, hits=data.hits[None], misses=data.misses[None])
    expected = numeric_gradient(data, b) / -numeric_hessian(data, b)[0]
    assert study.step(b[None])[0] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("penalty", [1.0, 3.0])
def test_a_penalised_step_is_scoring_of_the_penalised_likelihood(link: str, penalty: float) -> None:
    b = np.array([0.2, 0.9])
    data = data_of(link, penalty)
    up, down, _ = slopes_of_link(link, data.design @ b)
    information = data.design.T @ (((HITS + MISSES) * up * down)[:, None] * data.design)
    expected = np.linalg.solve(information, numeric_gradient(data, b))
    step = studies_of(data).step(np.stack([b, -b]))[0]
    assert step == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("link", LINKS)
def test_maxima_have_no_slope_whatever_the_start(link: str) -> None:
    data = data_of(link)
    studies = studies_of(data)
    b = maxima(studies, np.array([0.0, 0.0]))
    assert numeric_gradient(data, b[0]) == pytest.approx([0.0, 0.0], abs=1e-6)
    again = maxima(studies, np.array([6.0, 9.0]))
    assert again == pytest.approx(b, rel=1e-5)


@pytest.mark.parametrize("link", LINKS)
def test_plain_steps_reach_the_maximum_of_data_that_overlap(
    link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only studies without overlap are searched again, from the start."""
    searched = []

    def search(climb: Any, start: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        searched.append(start.tolist())
        return ascend(climb, start, tolerance)

    monkeypatch.setattr(curves, "ascend", search)
    maxima(studies_of(data_of(link)), np.array([0.0, 0.5]))
    assert searched == [[]]
    combined = replace(
        studies_of(data_of(link)),
        hits=np.stack([HITS, (SIZES > 0.1).astype(float)]),
        misses=np.stack([MISSES, (SIZES <= 0.1).astype(float)]),
    )
    b = maxima(combined, np.array([0.0, 0.5]))
    assert searched[1] in ([], [[0.0, 0.5]])
    assert b[0] == pytest.approx(maxima(studies_of(data_of(link)), np.array([0.0, 0.5]))[0])


@pytest.mark.parametrize("link", LINKS)
def test_penalised_maxima_have_no_slope(link: str) -> None:
    data = separated(link)
    (b,) = penalised_maxima(data, 1e-9)
    study = replace(data, hits=data.hits[0], misses=data.misses[0])
    assert numeric_gradient(study, b) == pytest.approx([0.0, 0.0], abs=1e-5)
    assert b[1] > 0


def test_chosen_studies_keep_their_penalty() -> None:
    data = replace(studies_of(data_of("logit")), penalty=np.array([1.0, 4.0]))
    second = data.select(np.array([1]))
    assert second.penalty.tolist() == [4.0]
    assert second.hits.tolist() == [data.hits[1].tolist()]
    assert second.misses.tolist() == [data.misses[1].tolist()]
    b = np.array([[0.1, 0.5], [0.3, 0.7]])
    value, step = data.climb(b[1:], np.array([1]))
    assert value[0] == data.value(b)[1]
    assert step[0] == pytest.approx(data.step(b)[1], rel=1e-12)


def test_an_ascent_halves_steps_that_go_too_far() -> None:
    """Steps of -3 x overshoot the maximum of -x^2; half of them end nearer to it."""
    tried = []

    def value_and_step(b: np.ndarray, problems: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        tried.append((b[:, 0].tolist(), problems.tolist()))
        return -((b[:, 0]) ** 2), -3.0 * b

    b, best = ascend(value_and_step, np.array([[1.0], [0.0]]), 1e-6)
    assert b[:, 0] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert best == pytest.approx([0.0, 0.0], abs=1e-10)
    # the second problem is at its maximum and is not tried again
    assert tried[:3] == [([1.0, 0.0], [0, 1]), ([-2.0], [0]), ([-0.5], [0])]


def test_an_ascent_without_a_maximum_ends() -> None:
    b, best = ascend(lambda b, _: (b[:, 0], np.ones_like(b)), np.array([[0.0]]))
    assert b[0, 0] == best[0] == 200.0


@pytest.mark.parametrize("link", LINKS)
def test_a_profile_is_the_largest_likelihood_of_curves_through_a_point(link: str) -> None:
    data = data_of(link)
    for z0, level in ((0.8, 1.2), (3.0, 1.2), (20.0, 0.4)):
        least = optimize.minimize_scalar(
            lambda slope, z0=z0, level=level: -data.value(np.array([level - slope * z0, slope])),
            bounds=(0.0, 20.0),
            method="bounded",
            options={"xatol": 1e-10},
        )
        value, slope = profile(data, z0, level)
        assert value == pytest.approx(-least.fun, abs=1e-7)
        assert slope == pytest.approx(least.x, abs=1e-4)


def test_a_profile_has_no_falling_curve() -> None:
    """Through a high point below all sizes the likeliest curve falls: the flat one is taken."""
    data = data_of("logit")
    value, slope = profile(data, -2.0, 1.0)
    assert slope == 0.0
    assert value == pytest.approx(data.value(np.array([1.0, 0.0])), rel=1e-12)


@pytest.mark.parametrize("link", LINKS)
def test_a_penalised_profile_is_that_of_a_fine_grid(link: str) -> None:
    several = separated(link)
    data = replace(several, hits=several.hits[0], misses=several.misses[0])
    z0 = 0.6
    level = 1.1
    slopes = np.geomspace(1e-6, 1e3, 200_000)
    values = data.value(np.stack([level - slopes * z0, slopes], axis=-1))
    value, slope = profile(data, z0, level, 0.7)
    assert value == pytest.approx(values.max(), abs=1e-6)
    assert slope == 0.7


@pytest.mark.parametrize("link", LINKS)
def test_the_likeliest_flat_curve_has_the_rate_of_hits_or_the_highest_level(link: str) -> None:
    data = data_of(link)
    rate = HITS.sum() / (HITS + MISSES).sum()
    by_rate = HITS.sum() * np.log(rate) + MISSES.sum() * np.log(1 - rate)
    assert flat_maximum(data, 5.0) == pytest.approx(by_rate, rel=1e-12)
    low = float(link_ppf(link, rate)) - 1.0
    expected = data.value(np.array([low, 0.0]))
    assert flat_maximum(data, low) == pytest.approx(expected, rel=1e-12)
    assert expected < by_rate


@pytest.mark.parametrize("highest", [-0.5, 3.0])
def test_the_likeliest_penalised_flat_curve_is_that_of_a_fine_grid(highest: float) -> None:
    data = data_of("probit", 1.0)
    levels = np.linspace(highest - 12.0, highest, 200_001)
    values = data.value(np.stack([levels, 0.0 * levels], axis=-1))
    assert flat_maximum(data, highest) == pytest.approx(values.max(), abs=1e-7)


@pytest.mark.parametrize("log_size", [False, True])
def test_sizes_and_probabilities_of_a_curve_are_inverse(log_size: bool) -> None:
    curve = PodCurve("loglog", log_size, 1.5, 0.4, np.eye(2))
    size = curve.size_at(0.9)
    x = 1.5 + 0.4 * stats.gumbel_r.ppf(0.9)
    assert size == pytest.approx(np.exp(x) if log_size else x, rel=1e-12)
    assert float(curve.pod(np.array(size))) == pytest.approx(0.9, rel=1e-12)


def test_a_bound_is_demonstrated_if_it_is_finite() -> None:
    assert Bound(0.9, 0.95, "method", 4.0).demonstrated
    assert not Bound(0.9, 0.95, "method", np.inf, "why").demonstrated
