"""A whole study judged, and the sentences on the limits of its validity."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pandas as pd
import pytest

from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import ThresholdError, read_record, record_text
from harness.evaluation.study.result import (
    StudyResult,
    conditions_of,
    difference,
    evaluate_study,
    validity_of,
)
from harness.records.trials import ResultTables
from harness.tables.limits import notes_of
from tests.support.synthetic_study import SetUp, Study, study_record, study_tables

FACTS: dict[str, Any] = {
    "source": {
        "kind": "simulated",
        "target": {
            "name": "drawn",
            "seed": 1,
            "damage": {
                "kind": "blind",
                "per_board": 8,
                "diameter_mm": [1, 14],
                "depth_mm": [2, 9],
                "sizes": "uniform",
            },
            "board": {"width_mm": 304.8, "shape": {"kind": "flat"}},
            "distance_m": 0.7,
            "distance_jitter_mm": 10.0,
            "tilt_deg": 8.0,
            "roll_deg": 0.0,
            "material": {"albedo_850": 0.6, "grain_contrast": 0.05},
            "tapes": [],
        },
        "camera": {"name": "azure_kinect_nfov", "unit_seed": 1, "edge_gate": True},
        "views": None,
    },
    "capture": {"frames": 1, "average": {"method": "mean"}},
    "detector": {"name": "plane"},
    "sweep": {"capture.frames": [1, 10], "source.target.distance_m": [0.5, 0.7]},
}


@pytest.fixture(scope="module")
def study() -> Study:
    return Study(
        (SetUp(), SetUp(frames=10, a50_mm=4.5)),
        boards=16,
        hole_free_boards=15,
        depths_mm=(2.0, 9.0),
        repeats=2,
    )


@pytest.fixture(scope="module")
def result(study) -> StudyResult:
    return evaluate_study(study_record(study), study_tables(study), FACTS, draws=200)


def no_tables() -> ResultTables:
    names = ("holes", "runs", "probes", "variants", "noise", "axes")
    return ResultTables(**dict.fromkeys(names, pd.DataFrame()))


def section(result: StudyResult, heading: str) -> str:
    return " ".join(dict(result.validity).get(heading, ()))


class TestStudy:
    def test_everything_is_there(self, result):
        assert [set_up.limit.record.frames for set_up in result.set_ups] == [1, 10]
        for set_up in result.set_ups:
            assert set_up.limit.statement is not None
            assert set_up.surface is not None
            assert set_up.chance.laid > 0
            assert set_up.roc is not None
            assert set_up.free_response is not None
            assert set_up.pixels is not None
        assert [line.axis for line in result.axes] == ["capture.frames"]
        assert result.axes[0].steps[0].beyond_chance
        assert result.axes[0].steps[0].ratio < 1

    def test_record_and_tables_tell_the_same(self, study, result):
        tables = study_tables(study)
        for set_up in result.set_ups:
            frames = set_up.limit.record.frames
            holes = tables.holes[tables.holes["frames"] == frames]
            assert set_up.limit.hits == holes["detected"].sum()
            sites = tables.sites[tables.sites["frames"] == frames]
            assert set_up.roc.damages == len(holes)
            assert set_up.roc.unflawed == len(sites) != len(holes)
            assert set_up.roc.in_use[1] == holes["detected"].mean()
            assert set_up.free_response.in_use[1] == pytest.approx(
                set_up.limit.hits / set_up.limit.inspections
            )
            sized = holes[holes["detected"] & holes["model_diameter_mm"].notna()]
            assert set_up.limit.sized == len(sized) < set_up.limit.hits
            error_mm = set_up.limit.size_error_mm
            assert error_mm == pytest.approx(
                np.median(np.abs(sized["model_diameter_mm"] - sized["true_diameter_mm"]))
            )
            assert 0.1 <= error_mm < 0.45
            assert set_up.limit.seconds_detect == 0.05
            runs = tables.runs[
                (tables.runs["frames"] == frames) & (tables.runs["role"] == "hole_free")
            ]
            assert set_up.limit.false_calls.calls == runs["false_calls"].sum()

    def test_a_record_from_its_file_gives_the_same_limits(
        self,
        study,
        result,
        tmp_path,
    ):
        file = tmp_path / "study.json"
        file.write_text(record_text(study_record(study)))
        again = evaluate_study(read_record(file), study_tables(study), FACTS, draws=200)
        for before, after in zip(result.limits, again.limits, strict=True):
            assert before.a90_95 == after.a90_95
            assert np.array_equal(before.a90_draws_mm, after.a90_draws_mm)
        assert again.validity == result.validity

    def test_nothing_but_the_record_is_enough_for_limits(self, study):
        record = study_record(study)
        bare = evaluate_study(record, no_tables(), {})
        assert [set_up.limit.a90_95.demonstrated for set_up in bare.set_ups] == [True, True]
        first = bare.set_ups[0]
        assert (first.chance, first.free_response, first.pixels, first.roc) == (None,) * 4

    def test_a_detector_that_finds_nothing_is_judged_too(self, study):
        blind = dataclasses.replace(study, set_ups=(SetUp(a50_mm=200.0),))
        result = evaluate_study(study_record(blind), study_tables(blind), FACTS, draws=50)
        assert not result.limits[0].a90_95.demonstrated
        assert result.set_ups[0].surface is None


class TestValidity:
    def test_what_was_inspected_and_counts_as_a_hit(self, result):
        text = section(result, "What was inspected")
        assert "128 damages on 16 boards, 1 to 14 mm in diameter" in text
        assert "each inspected 2 times with new noise" in text
        assert "Varied: frames 1; frames 10." in text
        assert "within 15 mm" in section(result, "What counts as a hit")

    def test_departures_are_those_of_this_study(self, result):
        text = section(result, "Departures from MIL-HDBK-1823A")
        for words in (
            "simulated",
            "Targets share boards, 8 per board",
            "more than once",
            "Unflawed places",
            "deviance",
        ):
            assert words in text
        assert "failed" not in text

    def test_a_small_study_with_one_damage_a_board_departs_otherwise(self):
        study = Study((SetUp(a50_mm=12.0),), boards=40, hole_free_boards=120, holes=1)
        record = study_record(study)
        failed = dataclasses.replace(
            record, set_ups=(dataclasses.replace(record.set_ups[0], failed=3),)
        )
        text = section(
            evaluate_study(failed, study_tables(study), {}, draws=50),
            "Departures from MIL-HDBK-1823A",
        )
        assert "Failed trials (3)" in text
        assert "share boards" not in text
        assert "simulated" not in text
        assert "more than once" not in text

    def test_a_limit_beyond_what_was_inspected_has_no_number(self):
        study = Study((SetUp(a50_mm=13.0),), boards=16, hole_free_boards=0)
        result = evaluate_study(study_record(study), no_tables(), {}, draws=50)
        limit = result.limits[0]
        assert limit.beyond(limit.a90_95.value)
        assert limit.a90_95.demonstrated
        assert "a90/95 lies beyond the largest size" in "; ".join(notes_of(limit))

    def test_all_found_names_its_rule(self, study):
        sighted = dataclasses.replace(study, set_ups=(SetUp(a50_mm=-9.0),))
        result = evaluate_study(study_record(sighted), study_tables(sighted), FACTS, draws=50)
        assert "29th smallest size" in section(result, "Departures from MIL-HDBK-1823A")

    def test_kinds_are_named_unless_they_were_swept(self, result):
        missing = "What is not included"
        assert "all are holes with a flat bottom" in section(result, missing)
        assert "one unit" in section(result, missing)
        swept = {
            **FACTS,
            "sweep": {
                "source.target.damage.kind": ["blind", "dent"],
                "source.camera.unit_seed": [1, 2],
            },
        }
        sections = dict(
            validity_of(
                result.record, result.limits, [set_up.chance for set_up in result.set_ups], swept
            )
        )[missing]
        assert not any("all are" in sentence or "one unit" in sentence for sentence in sections)

    def test_conditions_state_the_interval_of_the_thresholds_rate(self, result):
        """The lowest and the highest end of all set-ups that know theirs."""
        facts = {"threshold": {"calibrate": {"false_calls_per_m2": 1.0}}}
        assert "(" not in dataclasses.replace(result, facts=facts).conditions
        set_ups = []
        rates_per_m2 = ((0.5, 1.7), (0.41, 1.6))
        for set_up, (low, high) in zip(result.set_ups, rates_per_m2, strict=True):
            error = ThresholdError(0.1, low, high, "order statistics")
            record = dataclasses.replace(set_up.limit.record, threshold_error=error)
            limit = dataclasses.replace(set_up.limit, record=record)
            set_ups.append(dataclasses.replace(set_up, limit=limit))
        stated = dataclasses.replace(result, facts=facts, set_ups=tuple(set_ups)).conditions
        assert stated == "threshold for 1 false call per m² (0.4 to 1.7)"

    def test_conditions_begin_with_the_damage_and_the_sizes_that_do_not_vary(self):
        gouges = {
            "kind": "gouge",
            "per_board": 5,
            "length_mm": [60, 60],
            "width_mm": [10, 10],
            "depth_mm": [0.5, 7],
        }
        facts = {"source": {"target": {"name": "drawn", "damage": gouges}}}
        assert conditions_of(facts) == "gouges 60 mm long, 10 mm wide"
        assert conditions_of(
            {**facts, "sweep": {"source.target.damage.width_mm": [[5, 5], [9, 9]]}}
        ).endswith("mm long")
        assert (
            conditions_of({**facts, "sweep": {"source.target.damage.kind": ["gouge", "slot"]}})
            == ""
        )
        assert conditions_of({"source": {"target": {"holes": [{}, {}, {}]}}}, 2).startswith(
            "only 2 of 3 damages"
        )


def test_set_ups_that_lack_a_board_are_not_paired(study):
    """A board whose trial failed in one set-up is missing there: draws of the rest are draws of
    other boards."""
    first, second = study_record(study).set_ups
    kept = second.inspected.board != 3
    columns_of_second = {
        field.name: getattr(second.inspected, field.name)
        for field in dataclasses.fields(second.inspected)
    }
    columns = {
        name: values[kept]
        for name, values in columns_of_second.items()
        if isinstance(values, np.ndarray)
    }
    lacking = dataclasses.replace(
        second, inspected=dataclasses.replace(second.inspected, **columns)
    )
    complete = difference(limit_of(first, draws=50), limit_of(second, draws=50))
    part = difference(limit_of(first, draws=50), limit_of(lacking, draws=50))
    assert first.targets_digest == lacking.targets_digest
    assert complete.paired
    assert not part.paired
