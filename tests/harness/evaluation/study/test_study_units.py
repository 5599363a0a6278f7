"""Limits over units: each unit's own fit, and the prediction of a new unit by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from harness.evaluation.pod.curve import Bound
from harness.evaluation.pod.hit_miss import bound, fit_hit_miss
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.units import METHOD, over_units
from tests.support.synthetic_study import Study, study_record

A50_MM = np.array([3.5, 4.0, 5.0])
SIZES_MM = np.linspace(1.0, 9.0, 40)
SIZE_MM = np.tile(SIZES_MM, 3)
TARGET = np.tile(np.arange(40).astype(str), 3)
UNIT = np.repeat(np.arange(3), 40)


def hits_of_units() -> np.ndarray:
    """Hits of three units whose a50 differ."""
    rng = np.random.default_rng(4)
    chance = 1 / (1 + np.exp(-(SIZE_MM - A50_MM[UNIT]) / 0.7))
    return rng.random(120) < chance


def test_a_new_unit_by_hand() -> None:
    hit = hits_of_units()
    curve = fit_hit_miss(SIZE_MM, hit, link="probit", inspections=TARGET).curve
    limit = Bound(0.9, 0.95, "likelihood ratio", 1.1 * curve.size_at(0.9))
    judged = over_units(SIZE_MM, hit, TARGET, UNIT, curve, limit)
    fits = [fit_hit_miss(SIZES_MM, hit[unit == UNIT], link="probit") for unit in range(3)]
    a90_mm = np.array([fit.curve.size_at(0.9) for fit in fits])
    assert judged.units == 3
    assert judged.a90_mm.tolist() == a90_mm.tolist()
    assert judged.a90_95_mm.tolist() == [bound(fit).value for fit in fits]
    spread = np.log(a90_mm).std(ddof=1)
    assert judged.spread == pytest.approx(spread, rel=1e-12)
    # t(0.95, 2) = 2.919986
    margin = 2.919986 * spread * np.sqrt(4 / 3)
    expected = curve.size_at(0.9) * np.exp(np.hypot(np.log(1.1), margin))
    assert stats.t.ppf(0.95, 2) == pytest.approx(2.919986, abs=1e-6)
    assert judged.new_unit.value == pytest.approx(expected, rel=1e-6)
    assert judged.new_unit.why == ""
    assert judged.new_unit.pod == 0.9
    assert judged.new_unit.confidence == 0.95


def test_a_unit_that_found_everything_cannot_be_compared() -> None:
    hit = hits_of_units() | (UNIT == 1)
    curve = fit_hit_miss(SIZE_MM, hit, inspections=TARGET).curve
    judged = over_units(SIZE_MM, hit, TARGET, UNIT, curve, Bound(0.9, 0.95, "", 7.0))
    assert np.isinf(judged.a90_mm).tolist() == [False, True, False]
    assert np.isinf(judged.a90_95_mm).tolist() == [False, True, False]
    assert judged.spread == np.inf
    assert not judged.new_unit.demonstrated
    assert "a unit found every damage or none" in judged.new_unit.why
    assert (judged.new_unit.pod, judged.new_unit.confidence) == (0.9, 0.95)
    assert judged.new_unit.method == METHOD


def test_without_a_limit_over_boards_there_is_none_of_a_new_unit() -> None:
    hit = hits_of_units()
    curve = fit_hit_miss(SIZE_MM, hit, inspections=TARGET).curve
    nothing = Bound(0.9, 0.95, "", np.inf, "not demonstrated: a reason")
    judged = over_units(SIZE_MM, hit, TARGET, UNIT, curve, nothing)
    assert judged.new_unit.value == np.inf
    assert judged.new_unit.why == "not demonstrated: a reason"
    assert (judged.new_unit.pod, judged.new_unit.confidence) == (0.9, 0.95)
    assert judged.new_unit.method == METHOD
    assert np.isfinite(judged.spread)


def test_a_study_of_several_units_is_judged_by_unit() -> None:
    """Repeat r shows unit r modulo 3; draws and interval contain units as well as boards."""
    record = study_record(Study(boards=15, hole_free_boards=0, repeats=3)).set_ups[0]
    single_unit = limit_of(record, draws=60)
    limit = limit_of(replace(record, units=3), draws=60)
    inspected = record.inspected
    assert single_unit.over_units is None
    assert limit.over_units is not None
    for unit in range(3):
        rows = inspected.repeat == unit
        curve = limit.statement.curve
        fit = fit_hit_miss(
            inspected.diameter_mm[rows],
            inspected.hit[rows],
            link=curve.link,
            log_size=curve.log_size,
        )
        assert limit.over_units.a90_mm[unit] == pytest.approx(fit.curve.size_at(0.9), rel=1e-9)
    assert limit.a90_95 == single_unit.a90_95
    assert limit.over_units.new_unit.value > limit.over_boards.value
    assert limit.a90_interval_mm.low <= single_unit.a90_interval_mm.low
    assert limit.a90_interval_mm.high >= single_unit.a90_interval_mm.high
    assert not np.array_equal(limit.a90_draws_mm, single_unit.a90_draws_mm)
