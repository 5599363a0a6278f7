"""Boards drawn again: targets of rows, weights, crossings of curves, rates of false calls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from harness.evaluation.intervals import percentiles
from harness.evaluation.pod.curve import CELLS, PodCurve
from harness.evaluation.pod.hit_miss import fit_hit_miss
from harness.evaluation.study.boards import (
    Targets,
    crossings,
    design_effect,
    refitted_sizes,
    targets_of,
    units_effect,
    weights_in_blocks,
)
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import Unflawed
from tests.support.synthetic_study import SetUp, Study, study_record

CURVE = PodCurve("logit", False, 5.0, 1.0, np.zeros((2, 2)))


def targets(size_mm: np.ndarray, hits: np.ndarray, boards: int = 4) -> Targets:
    board = np.arange(len(size_mm)) % boards
    return Targets(board, size_mm, hits.astype(float), np.ones(len(size_mm)))


def test_rows_of_one_damage_are_one_target() -> None:
    joined = targets_of(
        board=np.array([7, 3, 7, 3, 7]),
        hole=np.array(["a", "a", "b", "a", "a"]),
        size_mm=np.array([1.0, 2.0, 3.0, 2.0, 1.0]),
        hit=np.array([True, False, True, True, True]),
    )
    assert joined.board.tolist() == [3, 7, 7]
    assert joined.size_mm.tolist() == [2.0, 1.0, 3.0]
    assert joined.hits.tolist() == [1.0, 2.0, 1.0]
    assert joined.inspections.tolist() == [2.0, 2.0, 1.0]
    assert joined.unit is None


def test_curves_cross_a_probability_only_if_they_rise() -> None:
    b = np.array([[-2.0, 0.5], [1.0, 0.0], [1.0, -2.0], [0.0, 4.0]])
    sizes = crossings(b, "logit", (0.5, 0.9))
    logit = np.log(9.0)
    assert sizes[0].tolist() == [4.0, np.inf, np.inf, 0.0]
    assert sizes[1].tolist() == pytest.approx([(logit + 2.0) / 0.5, np.inf, np.inf, logit / 4.0])


def test_blocks_hold_as_many_draws_as_the_memory_allows() -> None:
    board = np.arange(CELLS // 10) % 5
    sizes = [weights.shape for (weights,) in weights_in_blocks(25, (board, "damaged"))]
    assert [draws for draws, _ in sizes] == [10, 10, 5]
    (nothing,) = next(iter(weights_in_blocks(3, (np.zeros(0, int), "damaged"))))
    assert nothing.shape == (3, 0)


def test_refitted_sizes_without_an_overlap() -> None:
    """All found: the smallest size. Nothing found: no size."""
    size_mm = np.linspace(2.0, 9.0, 12)
    refitted = refitted_sizes(targets(size_mm, np.ones(12)), CURVE, (0.5, 0.9), 5)
    assert refitted == pytest.approx(2.0)
    missed = refitted_sizes(targets(size_mm, np.zeros(12)), CURVE, (0.5, 0.9), 5)
    assert np.isinf(missed).all()
    logarithmic = PodCurve("logit", True, 1.5, 0.3, np.zeros((2, 2)))
    refitted = refitted_sizes(targets(size_mm, np.ones(12)), logarithmic, (0.9,), 5)
    assert refitted == pytest.approx(2.0)


def test_units_are_resampled_beside_boards() -> None:
    rng = np.random.default_rng(1)
    size_mm = np.tile(np.linspace(1.0, 9.0, 30), 2)
    hits = (rng.random(60) < 1 / (1 + np.exp(5.0 - size_mm))).astype(float)
    board = np.arange(60) % 6
    unit = np.arange(60) % 2
    rows = Targets(board, size_mm, hits, np.ones(60), unit)
    drawn = refitted_sizes(rows, CURVE, (0.5,), 4)[0]
    blocks = weights_in_blocks(4, (board, "damaged"), (unit, "units"))
    of_boards, of_units = next(iter(blocks))
    weight = (of_boards * of_units).astype(int)
    for draw in range(4):
        again = np.repeat(np.arange(60), weight[draw])
        if hits[again].min() == hits[again].max():
            continue
        fit = fit_hit_miss(size_mm[again], hits[again])
        assert drawn[draw] == pytest.approx(fit.curve.size_at(0.5), rel=1e-5)


@pytest.mark.parametrize("log_size", [False, True])
def test_a_design_effect_by_hand(log_size: bool) -> None:
    """Sandwich variances of the size x_p = (level - b0) / b1 with boards and with damages as
    units, from the scores of a logit and its information."""
    rng = np.random.default_rng(3)
    size_mm = rng.uniform(2.0, 9.0, 24)
    inspections = 1.0 + np.arange(24) % 3
    hits = rng.binomial(inspections.astype(int), 1 / (1 + np.exp(5.5 - size_mm))).astype(float)
    board = np.arange(24) % 6
    x = np.log(size_mm) if log_size else size_mm
    mu = np.log(5.4) if log_size else 5.4
    sigma = 0.2 if log_size else 0.9
    curve = PodCurve("logit", log_size, mu, sigma, np.zeros((2, 2)))
    p = stats.logistic.cdf((x - mu) / sigma)
    design = np.column_stack([np.ones(24), x])
    scores = design * (hits - inspections * p)[:, None]
    information = design.T @ ((inspections * p * (1 - p))[:, None] * design)
    level = np.log(0.8 / 0.2)
    slope = 1 / sigma
    by_b = np.array([-1 / slope, -(level + mu / sigma) / slope**2])
    influence = scores @ np.linalg.solve(information, by_b)
    sums = np.array([influence[board == number].sum() for number in range(6)])
    expected = ((sums**2).sum() * 6 / 5) / ((influence**2).sum() * 24 / 23)
    rows = Targets(board, size_mm, hits, inspections)
    assert design_effect(rows, curve, 0.8) == pytest.approx(expected, rel=1e-9)


def test_a_design_effect_needs_two_boards() -> None:
    size_mm = np.array([3.0, 5.0, 7.0])
    hits = np.array([0.0, 1.0, 1.0])
    assert np.isnan(design_effect(targets(size_mm, hits, boards=1), CURVE, 0.9))
    assert np.isfinite(design_effect(targets(size_mm, hits, boards=2), CURVE, 0.9))
    assert np.isnan(design_effect(targets(size_mm[:2], hits[:2], boards=2), CURVE, 0.9))


def test_rates_of_false_calls_are_resampled_by_board() -> None:
    record = study_record(Study(boards=6, hole_free_boards=0)).set_ups[0]
    runs = Unflawed(
        board=np.array([1, 1, 2]),
        repeat=np.array([0, 1, 0]),
        calls=np.array([2, 1, 5]),
        area_m2=np.array([0.25, 0.25, 0.5]),
    )
    limit = limit_of(replace(record, unflawed=runs, beside=runs), draws=40)
    assert limit.false_calls.rate_per_m2 == 8.0
    assert (limit.beside.calls, limit.beside.area_m2) == (8, 1.0)
    (weights,) = next(iter(weights_in_blocks(40, (runs.board, "hole-free"))))
    rates = (weights @ runs.calls) / (weights @ runs.area_m2)
    expected = percentiles(rates)
    assert expected.low == 6.0
    assert limit.false_calls_interval_per_m2 == expected
    one_board = replace(runs, board=np.array([1, 1, 1]), repeat=np.arange(3))
    limit = limit_of(replace(record, unflawed=one_board), draws=40)
    assert limit.false_calls.calls == 8
    assert not limit.false_calls_interval_per_m2.known


def test_a_limit_over_boards_is_wider_by_a_tenth_where_boards_matter() -> None:
    limit = limit_of(study_record(Study((SetUp(),), boards=12)).set_ups[0], draws=20)
    value = limit.a90_95.value

    def matters(factor: float, effect: float) -> bool:
        over_boards = replace(limit.over_boards, value=factor * value)
        return replace(limit, over_boards=over_boards, design_effect=effect).boards_matter

    assert matters(1.11, 2.0)
    assert not matters(1.09, 2.0)
    assert not matters(1.11, 0.9)
    assert not matters(1.11, np.nan)


def test_the_effect_of_units_is_one_plus_what_they_add_to_the_boards_variance() -> None:
    """Four units, of which each finds half as much as the next; no combination of board and unit
    has two damages, so that its influences are the rows'."""
    random = np.random.default_rng(6)
    board = np.repeat(np.arange(30), 4)
    unit = np.tile(np.arange(4), 30)
    size_mm = np.repeat(random.uniform(1.0, 11.0, 30), 4)
    hit = random.random(120) < CURVE.pod(size_mm + 0.8 * (unit - 1.5))
    rows = Targets(
        board=board, size_mm=size_mm, hits=hit.astype(float), inspections=np.ones(120), unit=unit
    )
    # by hand, for a logit curve of sizes
    chance = CURVE.pod(size_mm)
    design = np.column_stack([np.ones(120), size_mm])
    information = design.T @ ((chance * (1 - chance))[:, None] * design)
    at_half = np.array([1.0, CURVE.size_at(0.5)])
    influence = design @ np.linalg.solve(information, at_half) * (hit - chance)
    of_boards = (influence.reshape(30, 4).sum(axis=1) ** 2).sum() * 30 / 29
    of_units = (influence.reshape(30, 4).sum(axis=0) ** 2).sum() * 4 / 3
    of_rows = (influence**2).sum() * 120 / 119
    expected = 1 + (of_units - of_rows) / of_boards
    assert expected > 1.5
    assert units_effect(rows, CURVE, 0.5) == pytest.approx(expected, rel=1e-9)
    assert units_effect(replace(rows, board=np.zeros(120, int)), CURVE, 0.5) == 1.0
    assert units_effect(replace(rows, unit=np.zeros(120, int)), CURVE, 0.5) == 1.0


def test_draws_below_zero_are_zero() -> None:
    """A curve that hardly rises reaches 50 % at a size below 0 in some draws."""
    record = study_record(Study((SetUp(a50_mm=-3.0, width_mm=4.0),), boards=8)).set_ups[0]
    limit = limit_of(record, draws=40)
    assert limit.a50_mm < 0.0
    assert limit.a50_interval_mm.low == 0.0
    assert limit.a90_draws_mm.min() >= 0.0
