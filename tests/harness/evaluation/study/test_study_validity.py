"""Sentences on what the limits of a study hold for: each rule at its boundary."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from harness.evaluation.intervals import UNKNOWN
from harness.evaluation.pod.curve import PodCurve
from harness.evaluation.study.curves import ChanceHits
from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.result import conditions_of, validity_of
from tests.support.synthetic_study import SetUp, Study, study_record

STUDY = Study((SetUp(), SetUp(frames=10, a50_mm=4.5)), boards=15, hole_free_boards=6)
RECORD = study_record(STUDY)
DEPARTURES = "Departures from MIL-HDBK-1823A"


@pytest.fixture(scope="module")
def two() -> list[SetUpLimit]:
    return [limit_of(set_up, draws=20) for set_up in RECORD.set_ups]


def chance(sites: int) -> ChanceHits:
    return ChanceHits(0.1, 9, 0.1, sites, 0.1, UNKNOWN)


def sections(limits: list[SetUpLimit], facts: dict[str, Any] | None = None, **changes: Any) -> dict:
    record = replace(RECORD, **changes)
    return dict(validity_of(record, limits, [None] * len(limits), facts or {}))


def departures(
    limits: list[SetUpLimit], chances: list[ChanceHits | None] | None = None, **facts: Any
) -> str:
    pairs = chances or [None] * len(limits)
    return " ".join(dict(validity_of(RECORD, limits, pairs, facts)).get(DEPARTURES, ()))


def with_record(limit: SetUpLimit, **changes: Any) -> SetUpLimit:
    return replace(limit, record=replace(limit.record, **changes))


def test_what_was_inspected_is_said_once_if_all_set_ups_share_it(two: list[SetUpLimit]) -> None:
    facts = {"sweep": {"capture.frames": [1, 10]}}
    assert sections(two, facts)["What was inspected"] == (
        "120 damages on 15 boards, 1 to 14 mm in diameter and 5 mm deep.",
        "Varied: frames 1; frames 10.",
    )
    fewer = replace(two[1], targets=60)
    assert sections([two[0], fewer])["What was inspected"] == (
        "1 frame: 120 damages on 15 boards, 1 to 14 mm in diameter and 5 mm deep.",
        "10 frames: 60 damages on 15 boards, 1 to 14 mm in diameter and 5 mm deep, "
        "each inspected 2 times with new noise.",
    )


def test_the_rule_for_a_hit(two: list[SetUpLimit]) -> None:
    (rule,) = sections(two)["What counts as a hit"]
    assert rule.startswith(
        "A damage is hit where the centre of a finding lies within 15 mm of its own (closest"
    )
    at_radius = [replace(two[0], largest_mm=30.0)]
    assert len(sections(at_radius)["What counts as a hit"]) == 1
    beyond = sections([replace(two[0], largest_mm=30.1)])["What counts as a hit"]
    assert beyond[1] == "The largest damages, up to 30.1 mm, reach beyond that radius."
    overlap = sections(two, hit_overlap=0.25)["What counts as a hit"]
    assert "or at least 25 % of a finding's pixels lie on it" in overlap[0]
    assert overlap[1].startswith("Further findings that lie on a damage")
    assert overlap[2].startswith("Chance hits are counted by centres alone")


def test_departures_of_a_plain_study(two: list[SetUpLimit]) -> None:
    text = departures(two)
    assert text == (
        "Targets share boards, 8 per board. a90/95 takes them as independent; the bound with "
        "their design effect stands beside it (Rao and Scott 1984). Other calibration boards "
        "would give another threshold; no interval here includes this scatter. The same data "
        "chose the model: a90/95 is the largest over models whose deviance is at most 2 above the least. "
        "2 limits are stated; each interval holds for one limit, not for all jointly."
    )


def test_departures_begin_at_their_boundaries(two: list[SetUpLimit]) -> None:
    limit = two[0]

    def of_one(**changes: Any) -> str:
        return departures([replace(limit, **changes)])

    assert "limits are stated" not in of_one()
    assert "Targets share boards, 1.07 per board" in of_one(targets=16)
    assert "share boards" not in of_one(targets=15)
    assert "share boards" not in of_one(boards=0)
    assert "more than once" in of_one(inspections=121)
    assert "more than once" not in of_one(inspections=120)
    assert "2 units of the camera inspected" in departures([with_record(limit, units=2)])
    assert "units of the camera" not in of_one()
    assert "Other calibration boards" in departures([with_record(limit, calibration_runs=1)])
    assert "Other calibration boards" not in departures([with_record(limit, calibration_runs=0)])
    assert "Failed trials (2)" in departures([with_record(limit, failed=2)])
    assert "simulated" in departures(two, source={"kind": "simulated"})
    assert "simulated" not in departures(two, source={"kind": "recorded"})


def test_unflawed_places_should_be_three_for_each_damage(two: list[SetUpLimit]) -> None:
    assert "Unflawed places" not in departures(two[:1], [chance(360)])
    text = departures(two[:1], [chance(359)])
    assert "Unflawed places for each damage: 2.99; the handbook asks for 3." in text
    fewer = departures(two, [chance(360), chance(120)])
    assert "Unflawed places for each damage: 1; the" in fewer


def test_sizes_should_reach_beyond_the_rise(two: list[SetUpLimit]) -> None:
    """Sizes of 1 to 14 mm: POD at both ends is told from 5 % and 95 %."""
    limit = two[0]
    assert limit.statement is not None
    fit = limit.statement.fits[0]

    def text(mu: float, sigma: float) -> str:
        curve = PodCurve("probit", False, mu, sigma, np.eye(2))
        fits = (replace(fit, curve=curve),)
        return departures([replace(limit, statement=replace(limit.statement, fits=fits))])

    # 5 % at 1 mm: mu = 1 + 1.645 sigma; 95 % at 14 mm: mu = 14 - 1.645 sigma
    assert "smallest size" not in text(1.0 + 1.65, 1.0)
    assert "1 frame: the smallest size inspected is found with a POD of 5.3 %." in text(2.62, 1.0)
    assert "largest size" not in text(14.0 - 1.65, 1.0)
    assert "1 frame: the largest size inspected is found with a POD of 94 %." in text(12.45, 1.0)


def test_a_study_that_found_everything_names_its_rule(two: list[SetUpLimit]) -> None:
    record = replace(
        two[0].record, inspected=replace(two[0].record.inspected, hit=np.ones(120, bool))
    )
    limit = limit_of(record, draws=5)
    text = departures([limit])
    assert "a90/95 is then the 29th smallest size" in text
    assert "The same data chose the model" not in text
    assert "29th" not in departures(two)


def test_what_is_not_included(two: list[SetUpLimit]) -> None:
    facts = {"source": {"kind": "simulated", "camera": {"name": "x"}, "target": {"name": "drawn"}}}
    missing = "What is not included"
    everything = sections(two, facts)[missing]
    starts = [sentence.split()[0] for sentence in everything]
    assert starts == ["An", "Damage", "Translucency,", "Other", "Boards"]
    assert everything[1].endswith("or several kinds on one board.")
    several = [with_record(limit, units=3) for limit in two]
    assert len(sections(several, facts)[missing]) == 4
    swept = {**facts, "sweep": {"source.camera.unit_seed": [1, 2]}}
    assert len(sections(two, swept)[missing]) == 4
    assert len(sections([replace(two[0], boards=0)], {})[missing]) == 1
    assert len(sections(two, {})[missing]) == 2


def test_measured_captures_bring_their_own_sentences(two: list[SetUpLimit]) -> None:
    heading = "What is measured and what is simulated"
    assert heading not in sections(two)
    assert sections(two, {"implanted": ("a", "b")})[heading] == ("a", "b")


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({}, ""),
        ({"source": {"camera": {"name": "kinect_v2"}}}, "Kinect v2"),
        ({"source": {"target": {"distance_m": 0.75}}}, "at 0.75 m"),
        ({"threshold": {"k": 4.5}}, "threshold 4.5 deviations"),
        (
            {"threshold": {"calibrate": {"false_calls_per_m2": 1, "repeats": 9}}},
            "threshold for 1 false call per m²",
        ),
        (
            {"threshold": {"calibrate": {"repeats": 9}}},
            "threshold set to the highest score of 9 hole-free runs",
        ),
        (
            {"source": {"target": {"distance_m": 0.75}}, "sweep": {"source.target": [1, 2]}},
            "",
        ),
    ],
)
def test_conditions_of_all_set_ups(facts: dict[str, Any], words: str) -> None:
    assert conditions_of(facts) == words


def test_damages_out_of_view_are_counted() -> None:
    facts = {
        "source": {"target": {"damage": {"per_board": 8}}},
        "study": {"boards": 10},
    }
    assert conditions_of(facts, 80) == ""
    assert conditions_of(facts, None) == ""
    words = "only 79 of 80 damages were in view and inspected by every set-up"
    assert conditions_of(facts, 79) == words
