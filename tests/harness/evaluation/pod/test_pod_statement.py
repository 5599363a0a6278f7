"""Statements on inspections: tests of floor and ceiling, bounds of near models, false positives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from harness.evaluation.pod import statement
from harness.evaluation.pod.ahat import ahat_bound, choose_axes, diagnose
from harness.evaluation.pod.averaged import ModelAverage
from harness.evaluation.pod.curve import link_cdf
from harness.evaluation.pod.hit_miss import (
    _search,
    band,
    bound,
    choose_model,
    fit_hit_miss,
    floor_ceiling_tests,
    near_models,
)
from harness.evaluation.pod.inspections import Inspections
from harness.evaluation.pod.statement import drawn_sizes, false_positives, state_hits, state_signals


def inspections(
    size: np.ndarray,
    response: np.ndarray,
    **columns: object,
) -> Inspections:
    return Inspections(
        path=Path("table.csv"),
        size_column="size",
        response_column="hit",
        size=size,
        response=np.asarray(response, float),
        target=None,
        line=np.arange(len(size)),
        **columns,  # type: ignore[arg-type]
    )


def hits_of(
    targets: int,
    seed: int,
    floor: float = 0.0,
    ceiling: float = 1.0,
) -> Inspections:
    """Sizes of 0.5 to 10 mm and hits of a logistic curve at 4 mm with sigma 0.8 mm."""
    size = np.linspace(0.5, 10.0, targets)
    chance = floor + (ceiling - floor) * link_cdf("logit", (size - 4.0) / 0.8)
    return inspections(size, np.random.default_rng(seed).random(targets) < chance)


def signals_of(seed: int, **columns: object) -> Inspections:
    """60 sizes and signals 0.5 + 1.2 size + 0.7 normal."""
    rng = np.random.default_rng(seed)
    size = rng.uniform(1.0, 9.0, 60)
    return inspections(size, 0.5 + 1.2 * size + 0.7 * rng.normal(size=60), **columns)


NEAR_SEED = 7  # four of the eight models fit about equally well

# floor and ceiling


@pytest.mark.parametrize("repeats", [1, 3])
def test_p_values_are_those_of_the_mixtures_at_the_boundary(repeats: int) -> None:
    """1/2 chi2(1) for a floor or a ceiling, 1/2 chi2(1) + 1/4 chi2(2) for both (Self and Liang
    1987); three equal rows of a target count as one."""
    read = hits_of(60, 5, 0.05, 0.95)
    fit = fit_hit_miss(
        np.repeat(read.size, repeats),
        np.repeat(read.response, repeats),
        inspections=np.repeat(np.arange(60), repeats),
    )
    floor, ceiling, floor_and_ceiling = floor_ceiling_tests(fit)
    plain = np.append(fit.maximum, [0.0, 1.0])
    low = (0.0, 0.5)
    high = (0.5, 1.0)
    for test, floors, ceilings in ((floor, low, (1.0, 1.0)), (ceiling, (0.0, 0.0), high)):
        likeliest, value = _search(fit.data, plain, floors, ceilings)
        ratio = 2.0 * (value - fit.log_likelihood) / repeats
        assert test.p_value == pytest.approx(0.5 * stats.chi2.sf(ratio, 1), rel=1e-9)
        assert [test.floor, test.ceiling] == likeliest[2:].tolist()
    _, value = _search(fit.data, plain, low, high)
    ratio = 2.0 * (value - fit.log_likelihood) / repeats
    mixture = 0.5 * stats.chi2.sf(ratio, 1) + 0.25 * stats.chi2.sf(ratio, 2)
    assert ratio > 0.5
    assert floor_and_ceiling.p_value == pytest.approx(mixture, rel=1e-9)
    assert [test.beyond for test in (floor, ceiling, floor_and_ceiling)] == [
        "floor",
        "ceiling",
        "both",
    ]


def _columns(read: Inspections) -> tuple[np.ndarray, np.ndarray]:
    return read.size, read.response


@pytest.mark.parametrize("ends", [(0.0, 1.0), (0.0, 0.85), (0.2, 1.0)])
def test_what_is_left_out_is_not_needed(ends: tuple[float, float]) -> None:
    """One test suffices where it already excludes a floor and a ceiling; else all are made."""
    left_out = 0
    for seed in range(3):
        read = hits_of(80, seed, *ends)
        fit = fit_hit_miss(*_columns(read))
        tests = floor_ceiling_tests(fit)
        fewer = floor_ceiling_tests(fit, each=False)
        if len(fewer) == 1:
            assert fewer == tests[2:] and not any(test.needed for test in tests)
            left_out += 1
        else:
            assert fewer == tests
    assert left_out >= 1 if ends == (0.0, 1.0) else left_out < 3


def test_separated_data_have_no_test() -> None:
    size = np.arange(1.0, 13.0)
    assert floor_ceiling_tests(fit_hit_miss(size, size > 6)) == ()


def test_a_floor_that_the_data_suggest_is_doubted() -> None:
    read = hits_of(300, 3, floor=0.25)
    stated = state_hits(read, link="logit", log_size=False)
    subject, p_value, reading = stated.tests[0]
    assert subject == "a floor: hits by chance at any size"
    assert p_value < 0.01
    assert reading.startswith("needed (floor 0.217, ceiling 1.000)")
    (doubt,) = [note for note in stated.doubts if note.endswith("do not trust its limit")]
    assert "the data suggest" in doubt
    assert stated.doubts[-1] == doubt
    assert state_hits(read, tested=False).tests == ()


# hits and misses


def test_bound_and_band_are_those_of_the_average_of_near_models() -> None:
    read = hits_of(60, NEAR_SEED)
    stated = state_hits(read, unit="mm")
    tried = choose_model(read.size, read.response)
    near_fits = near_models(tried)
    assert 1 < len(near_fits) < len(tried)
    assert [fit.deviance for fit in stated.fits] == [fit.deviance for fit in near_fits]
    average = ModelAverage(near_fits)
    assert stated.bound == average.bound()
    assert stated.bound.method == "average over models"
    assert stated.a50 == near_fits[0].curve.size_at(0.5)
    assert stated.a90 == near_fits[0].curve.size_at(0.9)
    low, high = stated.band
    average_low, average_high = average.band(stated.sizes)
    assert np.array_equal(low, average_low)
    assert np.array_equal(high, average_high)
    deviances = [fit.deviance for fit in near_fits]
    assert [row.in_bound for row in stated.models] == [fit.deviance in deviances for fit in tried]
    assert [row.chosen for row in stated.models] == [True] + 7 * [False]
    assert stated.counts == f"60 inspections of 60 targets, {int(read.response.sum())} hits"


def test_a_stated_model_has_the_handbooks_bound_and_band() -> None:
    read = hits_of(60, NEAR_SEED)
    stated = state_hits(read, link="probit", log_size=True, tested=False)
    fit = fit_hit_miss(read.size, read.response, link="probit", log_size=True)
    assert stated.average is None
    assert stated.bound == bound(fit)
    assert stated.bound.method == "likelihood ratio"
    low, high = stated.band
    fit_low, fit_high = band(fit, stated.sizes)
    assert np.array_equal(low, fit_low)
    assert np.array_equal(high, fit_high)


def test_near_models_are_within_two_of_the_least_deviance_per_inspection() -> None:
    fit = fit_hit_miss(*_columns(hits_of(60, 5)))
    worse = [replace(fit, deviance=fit.deviance + excess) for excess in (1.999, 2.001)]
    assert near_models([fit, *worse]) == (fit, worse[0])
    thrice = [replace(worse_fit, repeats=3.0) for worse_fit in (fit, *worse)]
    assert len(near_models(thrice)) == 3


def test_the_numbers_of_a_fit_are_named() -> None:
    read = hits_of(60, 5)
    stated = state_hits(read, link="probit", log_size=True, tested=False)
    fit = fit_hit_miss(read.size, read.response, link="probit", log_size=True)
    error_of_b0, error_of_b1 = np.sqrt(np.diag(fit.covariance))
    assert stated.numbers == {
        "b0": fit.b0,
        "b0's standard error": pytest.approx(error_of_b0),
        "b1": fit.b1,
        "b1's standard error": pytest.approx(error_of_b1),
        "mu": fit.curve.mu,
        "sigma": fit.curve.sigma,
        "deviance": fit.deviance,
        "deviance of a constant": fit.null_deviance,
        "log likelihood": fit.log_likelihood,
        "inspections": 60.0,
        "targets": 60.0,
        "hits": read.response.sum(),
    }
    rate = read.response.mean()
    constant = -2 * 60 * (rate * np.log(rate) + (1 - rate) * np.log(1 - rate))
    assert fit.null_deviance == pytest.approx(constant, rel=1e-12)
    assert fit.deviance == -2 * fit.log_likelihood
    assert stated.model == "probit, ln size"


def test_models_that_differ_are_warned_of() -> None:
    """With one inspection per target, models within 2 of the least deviance are compared."""
    stated = state_hits(hits_of(60, 5), tested=False)
    first = stated.models[0]

    def doubts(value: float, deviance: float) -> list[str]:
        second = replace(
            first, deviance=first.deviance + deviance, bound=replace(first.bound, value=value)
        )
        compared = replace(stated)
        vars(compared)["models"] = (first, second)  # in place of what it would compute
        return compared.doubts

    limit = first.bound.value
    assert doubts(1.049 * limit, 1.9) == []
    (words,) = doubts(1.051 * limit, 1.9)
    assert words == (
        "2 models fit about equally well, and their a90/95 differ: "
        f"{limit:.3g} to {1.051 * limit:.3g}"
    )
    assert doubts(1.051 * limit, 2.1) == []
    assert doubts(np.inf, 1.9)[0].endswith("to not demonstrated")


def test_small_studies_are_noted() -> None:
    small_study = state_hits(hits_of(59, 5), tested=False)
    assert small_study.notes[0] == "59 independent targets; MIL-HDBK-1823A asks for at least 60"
    assert state_hits(hits_of(60, 5), tested=False).notes == ()


def test_a_bound_beyond_all_sizes_is_noted() -> None:
    """Without sizes above 6.5 mm, the curve alone says where 90 % are found."""
    read = hits_of(100, 5)
    small = read.size < 6.5
    beyond = state_hits(inspections(read.size[small], read.response[small]), tested=False)
    assert beyond.bound.demonstrated
    assert beyond.bound.value > 6.5
    (note,) = beyond.notes
    assert (
        note == f"a90/95 = {beyond.bound.value:.3g} lies beyond the largest size inspected, 6.449"
    )


# signals


def test_signals_are_stated_by_the_fit_of_least_deviance() -> None:
    read = signals_of(1)
    stated = state_signals(read, decision=4.0, left=2.0, right=9.0)
    fit = choose_axes(read.size, read.response, decision=4.0, left=2.0, right=9.0)[0]
    assert stated.bound == ahat_bound(fit)
    assert stated.signal is not None
    assert stated.signal.deviance == fit.deviance == min(row.deviance for row in stated.models)
    assert stated.numbers["variance of mu"] == fit.curve.covariance[0, 0]
    assert stated.numbers["covariance of mu, sigma"] == fit.curve.covariance[0, 1]
    assert stated.numbers["variance of sigma"] == fit.curve.covariance[1, 1]
    assert stated.numbers["signals at or below --left"] == (read.response <= 2.0).sum() > 0
    assert stated.numbers["signals at or above --right"] == (read.response >= 9.0).sum() > 0
    assert [p for _, p, _ in stated.tests] == [test.p_value for test in diagnose(fit)]
    for _, p, reading in stated.tests:
        assert reading == ("doubtful at 5%" if p < 0.05 else "not rejected at 5%")
    assert stated.counts == "60 inspections of 60 targets"


def test_axes_can_be_restricted() -> None:
    stated = state_signals(signals_of(1), decision=4.0, log_size=True, log_signal=False)
    assert stated.model == "signal against ln size"
    assert [row.chosen for row in stated.models].count(True) == 1


# false positives


def test_false_positives_of_hits_by_clopper_and_pearson() -> None:
    sites = np.array([1.0, 0.0, 0.0, 1.0] + 6 * [0.0])
    numbers = false_positives(inspections(np.ones(3), np.ones(3), unflawed=sites))
    assert numbers == {
        "unflawed sites": 10.0,
        "false positives": 2.0,
        "PFP": 0.2,
        "PFP's 95 % upper bound": pytest.approx(stats.beta.ppf(0.95, 3, 8)),
    }
    all_called = false_positives(inspections(np.ones(3), np.ones(3), unflawed=np.ones(4)))
    assert all_called["PFP's 95 % upper bound"] == 1.0
    assert false_positives(inspections(np.ones(3), np.ones(3))) == {}


@pytest.mark.parametrize("log_signal", [False, True])
def test_false_positives_by_the_normal_law_of_noise(log_signal: bool) -> None:
    sites = np.exp(np.random.default_rng(3).normal(0.0, 0.5, 40))
    read = signals_of(1, unflawed=sites)
    stated = state_signals(read, decision=4.0, log_size=False, log_signal=log_signal)
    noise = np.log(sites) if log_signal else sites
    decision = np.log(4.0) if log_signal else 4.0
    expected = stats.norm.sf(decision, noise.mean(), noise.std())
    numbers = false_positives(read, stated.signal)
    assert numbers["PFP by the noise's normal law"] == pytest.approx(expected, rel=1e-6)
    assert numbers["false positives"] == (sites > 4.0).sum()


def test_noise_at_the_floor_is_censored_and_little_noise_is_not_fitted() -> None:
    rng = np.random.default_rng(3)
    sites = rng.normal(1.0, 1.0, 300)
    read = signals_of(1, unflawed=np.maximum(sites, 0.8))
    stated = state_signals(read, decision=4.0, left=0.8, log_size=False, log_signal=False)
    law = false_positives(read, stated.signal)["PFP by the noise's normal law"]
    censored = stats.CensoredData(sites[sites > 0.8], left=np.full((sites <= 0.8).sum(), 0.8))
    mean, std = stats.norm.fit(censored)
    assert law == pytest.approx(stats.norm.sf(4.0, mean, std), rel=1e-6)
    assert mean == pytest.approx(1.0, abs=0.3)
    for count, is_fitted in ((4, False), (5, True)):
        few_sites = replace(read, unflawed=np.arange(1.0, 1.0 + count))
        numbers = false_positives(few_sites, stated.signal)
        assert ("PFP by the noise's normal law" in numbers) is is_fitted
    negative = replace(read, unflawed=np.linspace(-1.0, 3.0, 20))
    logarithmic = state_signals(read, decision=4.0, log_size=False, log_signal=True).signal
    assert "PFP by the noise's normal law" not in false_positives(negative, logarithmic)


# sizes that are drawn


@pytest.mark.parametrize(
    ("size", "log_size", "marks", "ends"),
    [
        ([1.0, 6.0], False, (), (0.8, 6.2)),
        ([0.1, 5.1], False, (), (0.0, 5.3)),
        ([-1.0, 4.0], False, (), (-1.2, 4.2)),
        ([1.0, 6.0], False, (11.0, 12.5, np.inf), (0.6, 11.4)),
        ([1.0, 6.0], False, (5.0,), (0.8, 6.2)),
        ([1.0, 6.0], True, (), (6.0**-0.04, 6.0**1.04)),
    ],
)
def test_sizes_are_drawn_a_little_beyond_those_inspected(
    size: list[float],
    log_size: bool,
    marks: tuple[float, ...],
    ends: tuple[float, float],
) -> None:
    sizes = drawn_sizes(np.array(size), log_size, marks)
    assert (sizes[0], sizes[-1]) == pytest.approx(ends, abs=1e-12)
    assert len(sizes) == statement.DRAWN
    steps = np.diff(np.log(sizes) if log_size else sizes)
    assert steps == pytest.approx(steps[0])


# plain data


def test_a_statement_as_plain_data() -> None:
    stated = state_hits(hits_of(60, 5), unit="mm", tested=True)
    data = stated.to_data()
    assert data["a90_95"] == {
        "pod": 0.9,
        "confidence": 0.95,
        "method": "average over models",
        "demonstrated": True,
        "why": "",
        "size": stated.bound.value,
    }
    assert data["a50"] == stated.a50
    assert data["a90"] == stated.a90
    assert data["curve"]["mu"] == stated.curve.mu
    assert data["curve"]["covariance_mu_sigma"] == stated.curve.covariance.tolist()
    assert [row["in_a90_95"] for row in data["models"]] == [row.in_bound for row in stated.models]
    assert data["hits"] == int(stated.read.response.sum())
    assert data["inspections"] == 60
    assert [test["p"] for test in data["tests"]] == [p for _, p, _ in stated.tests]
