"""A study's file: written and read again it is the same, and whatever is wrong with it is told
with its place."""

from __future__ import annotations

import copy
import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.evaluation.study.record import (
    Calibrated,
    Inspected,
    SetUpRecord,
    StudyRecord,
    Unflawed,
    read_record,
    record_text,
    set_up_named,
)
from harness.vocabulary.errors import UserError
from tests.support.synthetic_study import SetUp, Study, study_record

STUDY = study_record(
    Study((SetUp(), SetUp(frames=5, axes={"x": [1, 2]})), boards=3, hole_free_boards=2, holes=4)
)
DATA = json.loads(record_text(STUDY))
MISSING = object()
SECOND = ("set_ups", 1)
TABLE = (*SECOND, "inspected")
EMPTY: dict[str, list[Any]] = {name: [] for name in DATA["set_ups"][0]["inspected"]}


def changed(path: tuple[str | int, ...], value: Any) -> Any:
    data = copy.deepcopy(DATA)
    container = data
    for step in path[:-1]:
        container = container[step]
    if value is MISSING:
        del container[path[-1]]
    else:
        container[path[-1]] = value
    return data


def refusal(file: Path) -> UserError:
    with pytest.raises(UserError) as caught:
        read_record(file)
    assert str(file) in caught.value.message
    assert caught.value.fix or caught.value.legal
    return caught.value


def test_written_and_read_it_is_the_same(tmp_path):
    by_depth = STUDY.set_ups[0].inspected.hit
    inspected = replace(
        STUDY.set_ups[0].inspected,
        signal=np.where(np.arange(12) == 3, np.nan, 2.5),
        by_depth=by_depth,
        by_no_return=~by_depth,
    )
    study = replace(
        STUDY,
        set_ups=(
            replace(STUDY.set_ups[0], inspected=inspected, threshold_mm=np.nan),
            STUDY.set_ups[1],
        ),
    )
    text = record_text(study)
    assert "NaN" not in text, "JSON has no such word"
    (tmp_path / "study.json").write_text(text)
    again = read_record(tmp_path)
    assert record_text(again) == text
    for field in fields(StudyRecord):
        if field.name != "set_ups":
            assert getattr(again, field.name) == getattr(study, field.name)
    for first, second in zip(study.set_ups, again.set_ups, strict=True):
        for field in fields(SetUpRecord):
            a = getattr(first, field.name)
            b = getattr(second, field.name)
            if isinstance(a, Inspected | Unflawed | Calibrated):
                for column in fields(a):
                    before = getattr(a, column.name)
                    now = getattr(b, column.name)
                    if not isinstance(before, np.ndarray):
                        assert now == before
                        continue
                    assert before.dtype.kind == now.dtype.kind
                    np.testing.assert_array_equal(before, now)
            else:
                assert a == b or (a != a and b != b)


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        (
            (*TABLE, "hit", 2),
            1,
            "set_ups.1.inspected.hit.2 (set-up main, frames 5): Input should be a valid boolean",
        ),
        (
            (*TABLE, "diameter_mm", 0),
            0,
            "inspected.diameter_mm.0 (set-up main, frames 5): Input should be greater than 0",
        ),
        ((*TABLE, "diameter_mm", 0), float("nan"), "Input should be a finite number, not .nan"),
        ((*TABLE, "depth_mm", 0), float("inf"), "inspected.depth_mm.0"),
        ((*TABLE, "x_mm"), "a", 'Input should be a valid list, not "a"'),
        ((*TABLE, "signal"), [1.0], "columns of different lengths: hit 12, signal 1"),
        (
            (*TABLE, "signal", 1),
            "high",
            'inspected.signal.1 (set-up main, frames 5): Input should be a valid number, not "',
        ),
        ((*TABLE, "hole"), MISSING, "set_ups.1.inspected.hole (set-up main, frames 5): "),
        ((*TABLE, "hole", 1), "1", "the same inspection occurs twice"),
        ((*TABLE, "board", 0), 10**30, "inspected.board.0"),
        (TABLE, EMPTY, "inspected.hole"),
        ((*SECOND, "unflawed", "area_m2", 0), 0.0, "unflawed.area_m2.0"),
        ((*SECOND, "unflawed", "calls", 0), -1, "greater than or equal to 0, not -1"),
        ((*SECOND, "frames"), 0, "set_ups.1.frames"),
        ((*SECOND, "frames"), 1, "set-up 'main' with frames 1 occurs twice"),
        ((*SECOND, "threshold"), None, "Input should be a valid number, not null"),
        ((*SECOND, "axes"), [1], "set_ups.1.axes"),
        (SECOND, 7, "set_ups.1: "),
        (("set_ups",), [], "set_ups: "),
        (("set_ups",), {"a": 1}, "set_ups: "),
        (("hit_radius_mm",), -1, "hit_radius_mm: Input should be greater than 0, not -1"),
        (
            ("false_calls_per_m2",),
            "one",
            'false_calls_per_m2: Input should be a valid number, not "one"',
        ),
        (("provenance",), MISSING, "provenance: "),
        (("further",), 1, "further: "),
    ],
)
def test_a_damaged_one_is_told_with_its_place(
    tmp_path,
    path,
    value,
    told,
):
    file = tmp_path / "study.json"
    file.write_text(json.dumps(changed(path, value)))
    mistake = refusal(file)
    assert f"{file}: is damaged: " in mistake.message
    assert told in mistake.message
    assert "run the study again" in (mistake.fix or "")


def test_several_mistakes_are_counted(tmp_path):
    data = changed((*TABLE, "hit"), [0] * 12)
    (tmp_path / "study.json").write_text(json.dumps(data))
    assert refusal(tmp_path / "study.json").message.endswith("not 0; and 11 more")


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b"a,b\n1,2\n"])
def test_what_is_no_json_is_told_what_to_do(tmp_path, content):
    (tmp_path / "no.json").write_bytes(content)
    mistake = refusal(tmp_path / "no.json")
    assert "is not JSON" in mistake.message
    assert mistake.fix
    assert mistake.legal


def test_a_set_up_is_found_by_its_label_or_alone() -> None:
    first, second = STUDY.set_ups
    alone = replace(STUDY, set_ups=(first,))
    assert set_up_named(STUDY, "5 frames") is second
    assert set_up_named(alone, None) is first
    assert set_up_named(alone, "") is first
    for name in (None, ""):
        with pytest.raises(UserError, match="synthetic has 2 set-ups") as caught:
            set_up_named(STUDY, name)
        assert caught.value.legal == "1 frame; 5 frames"
    with pytest.raises(UserError, match=r"no set-up '5 frame'; did you mean '5 frames'\?"):
        set_up_named(STUDY, "5 frame")


def test_labels_name_variant_and_frames() -> None:
    first = STUDY.set_ups[0]
    assert first.label == "1 frame"
    assert replace(first, frames=2).label == "2 frames"
    assert replace(first, variant="distance=0.5 m").label == "distance 0.5 m, 1 frame"


def test_limits_are_of_depth_if_only_the_depth_varies() -> None:
    inspected = STUDY.set_ups[0].inspected
    count = len(inspected.hit)
    same = replace(inspected, diameter_mm=np.full(count, 5.0))
    assert same.limit_of == "diameter"
    depths = np.linspace(1.0, 2.0, count)
    assert replace(same, depth_mm=depths).limit_of == "depth"
    assert replace(same, depth_mm=depths).size_mm.tolist() == depths.tolist()
    assert replace(same, depth_mm=depths - 1.0).limit_of == "diameter"
    assert replace(inspected, depth_mm=depths, size_of="width").limit_of == "width"


def test_the_rule_for_a_hit_in_words() -> None:
    rule = "where the centre of a finding lies within 15 mm of"
    assert STUDY.hit_rule == f"{rule} its own"
    overlap = replace(STUDY, hit_overlap=0.5)
    assert overlap.hit_rule == (
        f"{rule} its centre, or at least 50 % of a finding's pixels lie on it or 2 pixels beside it"
    )
    first = STUDY.set_ups[0]
    long = replace(first, inspected=replace(first.inspected, size_of="width"))
    assert replace(STUDY, set_ups=(long,)).hit_rule == f"{rule} its centre line"
