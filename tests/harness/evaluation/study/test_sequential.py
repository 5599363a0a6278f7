"""Batches of boards until a90 is as precise as wanted."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from pydantic import TypeAdapter

from harness.evaluation.intervals import UNKNOWN, Interval
from harness.evaluation.pod.averaged import WeightedCurves
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
    """A limit with the intervals that a rule reads, and curves whose a50 and a90 lie in them."""

    def __init__(self, a50: tuple[float, float], a90: tuple[float, float], label: str = "one"):
        self.a50_interval_mm = Interval(low=a50[0], high=a50[1])
        self.a90_interval_mm = Interval(low=a90[0], high=a90[1])
        self.a50_mm = sum(a50) / 2
        self.a90_mm = sum(a90) / 2
        average = SimpleNamespace(curves=curves_between(a50, a90))
        self.statement: Any = SimpleNamespace(average=average)
        self.is_at_most = False
        self.why = ""
        self.record = SimpleNamespace(label=label)


def curves_between(a50: tuple[float, float], a90: tuple[float, float]) -> WeightedCurves:
    """Logistic curves through pairs of a50 and a90, with normal weights of which 95 % lie in the
    intervals."""
    steps = np.linspace(-3.0, 3.0, 13)
    pairs = np.stack(np.meshgrid(steps, steps)).reshape(2, -1)
    first, second = pairs
    weight = np.exp(-0.5 * (first**2 + second**2))
    a50_mm = np.mean(a50) + first * np.ptp(a50) / 3.92
    a90_mm = np.mean(a90) + second * np.ptp(a90) / 3.92
    return WeightedCurves(
        links=("logit",),
        log_sizes=(False,),
        model=np.zeros(len(first), int),
        mu=a50_mm,
        sigma=np.maximum(a90_mm - a50_mm, 0.01) / np.log(9.0),
        weight=weight / weight.sum(),
    )


def after(design: BoardDesign, *stubs: Stub) -> BoardDesign:
    return next_design(design, cast("list[SetUpLimit]", list(stubs)))


def all_found() -> Stub:
    stub = Stub((2.0, 2.0), (2.0, 2.0), "easy")
    stub.statement = None
    stub.is_at_most = True
    return stub


WIDE = Stub((4.0, 5.0), (6.0, 8.0))
NARROW = Stub((10.0, 10.1), (11.0, 11.2), "narrow")


def test_the_sizes_narrow_the_interval_of_a90_and_are_shared_out_among_boards():
    sizes_mm = np.array(after(START, WIDE).chosen_mm)
    assert sizes_mm.shape[1] == 6
    assert (np.diff(sizes_mm, axis=1) >= 0).all()
    assert ((sizes_mm > 6.0) & (sizes_mm < 8.0)).all()
    assert (np.round(sizes_mm, 3) == sizes_mm).all()
    for_two_mm = np.array(after(START, WIDE, Stub((8.0, 9.0), (10.0, 12.0), "alike")).chosen_mm)
    assert (for_two_mm[:, 0] < 8.0).all()
    assert (for_two_mm[:, -1] > 9.0).all()


def test_the_first_boards_have_no_chosen_sizes():
    design = after(START, WIDE)
    assert design.boards == FIRST_BOARDS + len(design.chosen_mm)
    assert design.sizes_mm(FIRST_BOARDS - 1) is None
    assert design.sizes_mm(FIRST_BOARDS) == design.chosen_mm[0]


def test_the_set_up_farthest_from_its_precision_is_served():
    far = Stub((8.0, 8.5), (9.0, 13.0), "far")
    sizes_mm = np.ravel(after(START, WIDE, far, NARROW).chosen_mm)
    assert np.mean(sizes_mm > 8.5) > 0.7
    alike = Stub((8.0, 9.0), (10.0, 12.0), "alike")
    sizes_mm = np.ravel(after(START, WIDE, alike).chosen_mm)
    assert 0.3 < np.mean(sizes_mm < 8.0) < 0.7


def test_unbounded_and_unknown_intervals_stay_within_the_range():
    open_ended = Stub((-3.0, 1.0), (10.0, 20.0))
    open_ended.a90_interval_mm = Interval(10.0, np.inf)
    unknown = Stub((4.0, 5.0), (6.0, 8.0))
    unknown.a90_interval_mm = UNKNOWN
    sizes_mm = np.ravel(after(START, open_ended, unknown).chosen_mm)
    assert sizes_mm.min() >= 2.0
    assert sizes_mm.max() <= 12.0


def test_a_batch_is_as_large_as_the_width_asks_for():
    twelve = replace(START, chosen_mm=((3.0,) * 6,) * 6)

    def boards(*stubs: Stub) -> int:
        return len(after(twelve, *stubs).chosen_mm) - 6

    assert boards(Stub((4.0, 5.0), (6.0, 6.51))) == LEAST_BATCH
    assert LEAST_BATCH < boards(Stub((4.0, 5.0), (6.0, 6.75))) < 12
    # of several set-ups, the widest asks for most
    hardly_wide = Stub((4.0, 5.0), (6.0, 6.51))
    assert boards(hardly_wide, Stub((8.0, 9.0), (10.0, 11.0), "other")) > LEAST_BATCH
    assert boards(WIDE) == 6
    thirty = replace(START, chosen_mm=((3.0,) * 6,) * 24)
    assert after(thirty, hardly_wide).boards == 36
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
