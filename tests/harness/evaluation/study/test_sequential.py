"""Batches of boards until a90 is as precise as wanted."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from pydantic import TypeAdapter

from harness.evaluation.intervals import UNKNOWN, Interval
from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.record import BoardDesign
from harness.evaluation.study.sequential import (
    FIRST_BOARDS,
    LEAST_BATCH,
    first_design,
    next_design,
)
from harness.experiment.checks import LEAST_BOARDS
from tests.support.synthetic_study import SetUp, Study, study_record

START = first_design(
    damage="",
    range_mm=(2.0, 12.0),
    per_board=6,
    most_boards=40,
    a90_mm=0.5,
    a90_percent=None,
)


class Stub:
    """A limit with the intervals that a rule reads."""

    def __init__(self, a50: tuple[float, float], a90: tuple[float, float], label: str = "one"):
        self.a50_interval_mm = Interval(low=a50[0], high=a50[1])
        self.a90_interval_mm = Interval(low=a90[0], high=a90[1])
        self.a50_mm = sum(a50) / 2
        self.a90_mm = sum(a90) / 2
        self.statement: Any = "a curve"
        self.is_at_most = False
        self.why = ""
        self.record = type("Record", (), {"label": label})()


def after(design: BoardDesign, *stubs: Stub) -> BoardDesign:
    return next_design(design, cast("list[SetUpLimit]", list(stubs)))


def all_found() -> Stub:
    stub = Stub((2.0, 2.0), (2.0, 2.0), "easy")
    stub.statement = None
    stub.is_at_most = True
    return stub


WIDE = Stub((4.0, 5.0), (6.0, 8.0))
NARROW = Stub((10.0, 10.1), (11.0, 11.2), "narrow")


def test_a_third_of_the_sizes_lies_about_a50_and_two_thirds_about_a90():
    design = after(START, WIDE)
    sizes_mm = np.array(design.chosen_mm)
    assert sizes_mm.shape[1] == 6
    assert (np.diff(sizes_mm, axis=1) >= 0).all()
    about_a50 = (sizes_mm >= 4.25) & (sizes_mm <= 4.75)
    about_a90 = (sizes_mm >= 6.5) & (sizes_mm <= 7.5)
    assert (about_a50.sum(axis=1) == 2).all()
    assert (about_a90.sum(axis=1) == 4).all()
    # spread over the inner halves of the intervals
    assert np.ptp(sizes_mm[about_a50]) > 0.35
    assert np.ptp(sizes_mm[about_a90]) > 0.7
    assert (np.round(sizes_mm, 3) == sizes_mm).all()


def test_the_first_boards_have_no_chosen_sizes():
    design = after(START, WIDE)
    assert design.boards == FIRST_BOARDS + len(design.chosen_mm)
    assert design.sizes_mm(FIRST_BOARDS - 1) is None
    assert design.sizes_mm(FIRST_BOARDS) == design.chosen_mm[0]


def test_set_ups_that_are_still_wide_share_the_boards():
    second = Stub((8.0, 8.5), (9.0, 10.0), "other")
    sizes_mm = np.ravel(after(START, WIDE, second, NARROW).chosen_mm)
    assert np.mean(sizes_mm < 7.51) == pytest.approx(0.5)
    assert np.mean((sizes_mm > 8.1) & (sizes_mm < 9.8)) == pytest.approx(0.5)


def test_unbounded_and_unknown_intervals_stay_within_the_range():
    open_ended = Stub((-3.0, 1.0), (10.0, np.inf))
    open_ended.a90_mm = 11.0
    sizes_mm = np.ravel(after(START, open_ended).chosen_mm)
    assert sizes_mm.min() == 2.0
    assert 11.0 < sizes_mm.max() <= 11.5
    unknown = Stub((4.0, 5.0), (UNKNOWN.low, UNKNOWN.high))
    assert np.isfinite(np.ravel(after(START, unknown).chosen_mm)).all()


def test_a_batch_is_as_large_as_the_width_asks_for():
    twelve = replace(START, chosen_mm=((3.0,) * 6,) * 6)
    # boards needed: 12 (width / 0.5)^2
    assert len(after(twelve, Stub((4.0, 5.0), (6.0, 6.6))).chosen_mm) - 6 == 6
    assert len(after(twelve, Stub((4.0, 5.0), (6.0, 6.59))).chosen_mm) - 6 == 5
    assert len(after(twelve, Stub((4.0, 5.0), (6.0, 6.51))).chosen_mm) - 6 == LEAST_BATCH
    # of several set-ups, the widest asks for most
    two_wide = (Stub((4.0, 5.0), (6.0, 6.51)), Stub((8.0, 8.5), (9.0, 9.6), "other"))
    assert len(after(twelve, *two_wide).chosen_mm) - 6 == 6
    few_left = replace(twelve, most_boards=14)
    assert after(few_left, WIDE).boards == 14


def test_it_ends_when_all_intervals_are_narrow_but_never_with_the_first_boards():
    second = after(START, NARROW)
    assert not second.reason
    assert second.boards == LEAST_BOARDS == FIRST_BOARDS + LEAST_BATCH
    ended = after(second, NARROW)
    assert ended.is_reached
    assert ended.boards == second.boards
    assert ended.reason == "every interval of a90 is at most 0.5 mm wide"
    assert not after(second, NARROW, WIDE).reason
    assert ended.outcome == "a90 wanted to 0.5 mm, reached with 10 boards"


def test_the_largest_number_of_boards_is_an_honest_end():
    full = replace(START, chosen_mm=((3.0,) * 6,) * 34)
    hardly_wide = Stub((4.0, 5.0), (6.0, 6.6), "another")
    ended = after(full, hardly_wide, WIDE, NARROW)
    assert not ended.is_reached
    assert "all 40 boards" in ended.reason
    assert "a90 of one is 6 to 8 mm" in ended.reason
    assert "not reached with 40 boards" in ended.outcome
    assert after(full, NARROW).is_reached


def test_percent_is_of_a90():
    in_percent = replace(START, a90_mm=None, a90_percent=10.0, chosen_mm=((3.0,) * 6,) * 6)
    assert in_percent.wanted == "10 %"
    assert after(in_percent, Stub((4.0, 5.0), (9.6, 10.4))).is_reached
    assert not after(in_percent, Stub((4.0, 5.0), (4.8, 5.4))).reason


def test_a_set_up_without_a_curve_is_waited_for_and_then_named():
    waiting = after(START, all_found())
    # over the whole range
    assert np.ptp(np.ravel(waiting.chosen_mm)) > 8.0
    twelve = replace(START, chosen_mm=((3.0,) * 6,) * 6)
    ended = after(twelve, all_found(), NARROW)
    assert not ended.is_reached
    assert ended.reason == "easy has no curve: all damages were found"
    # the others go on
    assert not after(twelve, all_found(), WIDE).reason
    assert after(START).reason == "no damaged board was judged"


def test_a_design_survives_json():
    design = after(START, WIDE)
    adapter = TypeAdapter(BoardDesign)
    text = json.dumps(adapter.dump_python(design, mode="json"))
    assert adapter.validate_python(json.loads(text)) == design


def test_chosen_sizes_quote_the_bound_over_boards():
    (record,) = study_record(Study(boards=30, set_ups=(SetUp(boards_mm=1.5),))).set_ups
    plain = limit_of(record, draws=20)
    chosen = limit_of(replace(record, sizes_chosen=True), draws=20)
    assert plain.over_boards.value > plain.a90_95.value
    assert chosen.a90_95.value == plain.over_boards.value
