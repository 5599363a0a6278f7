"""Unknowns: what may be declared, what is drawn, and the points and boards that follow."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from harness.experiment.load import load_experiment
from harness.experiment.schema import DRAWN, STATED
from harness.experiment.unfold import source_of, stated_value
from harness.experiment.unknowns import PARTS, UnknownConfig, is_same_fact
from harness.runs.plan import plan_of
from harness.vocabulary.declaration.yaml_source import DeclarationError
from harness.vocabulary.path_names import UNKNOWNS
from tests.support.tiny_sweep import STUDY, TINY

BACKING = UnknownConfig(
    key="source.target.backing",
    values=({"distance_mm": 20.0}, {"distance_mm": 200.0}, None),
    reason="not seen",
)
BLUR = UnknownConfig(
    key="source.camera.numbers.scatter.blur_px", range=(0.3, 0.6), reason="not published"
)
UNKNOWN_YAML = """\
unknowns:
- {key: source.target.backing, values: [{distance_mm: 20.0}, {distance_mm: 200.0}, null], reason: not seen}
- {key: source.camera.numbers.scatter.blur_px, range: [0.3, 0.6], reason: not published}
"""


def loaded(folder: Path, text: str, *changes: str):
    (folder / "tiny.yaml").write_text(text)
    return load_experiment(folder / "tiny.yaml", changes)


def test_each_block_of_boards_has_every_value_once():
    drawn = [BACKING.drawn(1, "damaged", board) for board in range(30)]
    for start in range(0, 30, 3):
        assert all(value in drawn[start : start + 3] for value in BACKING.values)
    orders = {str(drawn[start : start + 3]) for start in range(0, 30, 3)}
    assert len(orders) > 2


def test_each_block_of_boards_has_every_part_of_a_range_once():
    drawn = [BLUR.drawn(1, "damaged", board) for board in range(5 * PARTS)]
    assert all(0.3 <= value <= 0.6 for value in drawn)
    assert len(set(drawn)) == len(drawn)
    for start in range(0, len(drawn), PARTS):
        parts = [int((value - 0.3) / 0.3 * PARTS) for value in drawn[start : start + PARTS]]
        assert sorted(parts) == list(range(PARTS))
    assert drawn[:PARTS] != sorted(drawn[:PARTS])


def test_draws_differ_by_seed_purpose_and_key_and_in_nothing_else():
    def draws(unknown, seed, purpose):
        return [unknown.drawn(seed, purpose, board) for board in range(12)]

    jitter = BLUR.model_copy(update={"key": "source.camera.numbers.unit.jitter_mm"})
    another_reason = BLUR.model_copy(update={"reason": "something else"})
    first = draws(BLUR, 1, "damaged")
    assert first == draws(another_reason, 1, "damaged")
    different = [
        draws(BLUR, 2, "damaged"),
        draws(BLUR, 1, "hole_free"),
        draws(jitter, 1, "damaged"),
    ]
    assert all(first != second for second in different)


def test_facts_that_overlap():
    assert is_same_fact("source.target.backing", "source.target.backing.distance_mm")
    assert is_same_fact("source.target.backing.distance_mm", "source.target.backing")
    assert not is_same_fact("source.target.backing", "source.target.backing_distance_mm")


@pytest.mark.parametrize(
    ("unknown", "expected"),
    [
        ("{key: source.target.tilt_deg, reason: r}", "give either `values` or `range`"),
        (
            "{key: source.target.tilt_deg, values: [1.0, 2.0], range: [1.0, 2.0], reason: r}",
            "give either `values` or `range`",
        ),
        ("{key: source.target.tilt_deg, range: [2.0, 2.0], reason: r}", "is empty"),
        (
            "{key: source.target.tilt_deg, values: [1.0, 2.0, 1.0], reason: r}",
            "`values` repeat 1.0: equally probable",
        ),
        (
            "{key: source.target.backing, values: [null, {distance_mm: 9.0}, null], reason: r}",
            "`values` repeat null",
        ),
        ("{key: capture.frames, values: [1, 2], reason: r}", "is no fact of source.target"),
        ("{key: source.camera.name, values: [a, b], reason: r}", "is chosen"),
        ("{key: source.target.damage.kind, values: [a, b], reason: r}", "is chosen"),
        ("{key: source.target.tild_deg, range: [1.0, 2.0], reason: r}", "did you mean"),
        ("{key: source.target.tilt_deg, range: [1.0, 99.0], reason: r}", "99"),
        ("{key: source.camera.numbers.scatter.blur, range: [0.1, 0.2], reason: r}", "scatter.blur"),
        (
            "{key: source.target.backing, values: [null, {distance_mm: 9.0}], reason: r}, "
            "{key: source.target.backing.distance_mm, range: [1.0, 2.0], reason: r}",
            "set the same fact",
        ),
    ],
)
def test_what_cannot_be_unknown(tmp_path, unknown, expected):
    with pytest.raises(DeclarationError) as refused:
        loaded(tmp_path, STUDY + f"unknowns: [{unknown}]\n")
    assert expected in str(refused.value)


def test_a_problem_that_all_values_of_an_unknown_share_is_reported_once(tmp_path):
    blur = "{key: source.camera.numbers.scatter.blur, range: [0.1, 0.2], reason: r}"
    with pytest.raises(DeclarationError) as refused:
        loaded(tmp_path, STUDY + f"unknowns: [{blur}]\n")
    (problem,) = refused.value.problems
    assert "scatter.blur=0.1" in problem.message
    tilt = "{key: source.target.tilt_deg, range: [98.0, 99.0], reason: r}"
    with pytest.raises(DeclarationError) as refused:
        loaded(tmp_path, STUDY + f"unknowns: [{tilt}]\n")
    assert len(refused.value.problems) == 2


def test_unknowns_are_drawn_by_a_study_or_by_draws(tmp_path):
    unknown = "unknowns: [{key: source.target.distance_m, range: [0.6, 0.9], reason: r}]\n"
    with pytest.raises(DeclarationError) as refused:
        loaded(tmp_path, TINY + unknown)
    assert "nothing draws the unknowns" in str(refused.value)
    assert len(loaded(tmp_path, TINY + unknown, "draws=5").points) == 10


def test_a_study_has_its_points_as_before_and_each_again_with_drawn_unknowns(tmp_path):
    plain = loaded(tmp_path, STUDY).points
    points = loaded(tmp_path, STUDY + UNKNOWN_YAML).points
    stated = points[: len(plain)]
    drawn = points[len(plain) :]
    assert [point.digest for point in stated] == [point.digest for point in plain]
    assert [point.variant for point in stated] == ["main", "main"]
    assert [point.variant for point in drawn] == ["unknowns=drawn"] * 2
    assert {point.axes[UNKNOWNS] for point in stated} == {STATED}
    assert {point.axes[UNKNOWNS] for point in drawn} == {DRAWN}
    assert not {point.digest for point in points} & {""} and len({p.digest for p in points}) == 4
    assert [point.config.capture.frames for point in drawn] == [1, 2]
    assert len(loaded(tmp_path, STUDY + UNKNOWN_YAML).at_stated_values().points) == 2
    again = loaded(tmp_path, STUDY + UNKNOWN_YAML.replace("not seen", "another reason")).points
    assert [point.digest for point in again] == [point.digest for point in points]
    wider = loaded(tmp_path, STUDY + UNKNOWN_YAML.replace("0.6]", "0.7]")).points
    assert wider[0].digest == points[0].digest and wider[2].digest != points[2].digest


def test_an_axis_over_an_unknown_fixes_it(tmp_path):
    sweep = "sweep={source.target.backing: [null, {distance_mm: 50.0}]}"
    points = loaded(tmp_path, STUDY + UNKNOWN_YAML, sweep).points
    assert [len(point.unknowns) for point in points] == [0, 0, 1, 1]
    assert [source_of(point, "damaged", 7).target.backing is None for point in points] == [
        True,
        False,
    ] * 2


def test_the_boards_have_what_is_drawn_for_them(tmp_path):
    stated, _, drawn, _ = loaded(tmp_path, STUDY + UNKNOWN_YAML).points
    assert source_of(stated, "damaged", 3) == stated.config.simulated
    for board in range(6):
        source = source_of(drawn, "damaged", board)
        blur_px = source.camera.numbers["scatter.blur_px"]
        assert blur_px == BLUR.drawn(3, "damaged", board)
        backing = BACKING.drawn(3, "damaged", board)
        if backing is None:
            assert source.target.backing is None
        else:
            assert source.target.backing.distance_mm == backing["distance_mm"]
        same = {"backing": None}
        family = source.target.model_copy(update=same)
        assert family == stated.config.simulated.target.model_copy(update=same)


def test_the_plan_is_at_most_twice_a_plain_study(tmp_path):
    plain = plan_of(loaded(tmp_path, STUDY), tmp_path)
    plan = plan_of(loaded(tmp_path, STUDY + UNKNOWN_YAML), tmp_path)
    # a board that draws what is stated shares the render
    assert 1.5 * len(plain.renders) < len(plan.renders) <= 2 * len(plain.renders)
    trials = [
        sum(group.most_repeats(batch) for group in planned.groups for batch in group.batches)
        for planned in (plain, plan)
    ]
    assert trials[1] == 2 * trials[0]
    stated, drawn = plan.groups
    for first, second in zip(stated.then, drawn.then, strict=True):
        # the same board in the same pose, whatever is unknown about it
        assert first.views[0].target.pose == second.views[0].target.pose
        assert first.views[0].target.damages == second.views[0].target.damages
        blur_px = BLUR.drawn(3, second.role, second.board or 0)
        assert second.views[0].camera.numbers["scatter.blur_px"] == blur_px


def test_what_is_stated_of_an_unknown(tmp_path):
    config = loaded(tmp_path, STUDY + UNKNOWN_YAML).config
    assert stated_value(config, BACKING.key)["distance_mm"] == 20.0
    assert stated_value(config, "source.camera.numbers.unit.jitter_mm") == 0.25
    config = loaded(tmp_path, STUDY, "source.camera.numbers={unit.jitter_mm: 0.5}").config
    assert stated_value(config, "source.camera.numbers.unit.jitter_mm") == 0.5


def test_set_ups_with_drawn_unknowns():
    experiment = load_experiment("experiments/thesis_inference.yaml", ["draws=40"])
    points = experiment.points
    assert len(points) == 80
    of_set_up: dict[str, list[int]] = {}
    for point in points:
        of_set_up.setdefault(point.variant, []).append(point.config.capture.frames)
    assert list(of_set_up.values()) == [[1, 50]] * 40
    sources = [point.config.simulated for point in points[::2]]
    assert sources == [point.config.simulated for point in points[1::2]]
    assert Counter(source.camera.unit_seed for source in sources) == dict.fromkeys(range(1, 9), 5)
    backings = Counter(source.target.backing_distance_mm for source in sources)
    assert backings == dict.fromkeys((0.0, 20.0, 100.0, 500.0, None), 8)
    poses = {(source.target.tilt_x_deg, source.target.offset_x_mm) for source in sources}
    assert len(poses) == 40
    assert {point.config.threshold.calibrate.repeats for point in points} == {1}


def test_a_first_look_leaves_the_unknowns_of_a_study_out():
    experiment = load_experiment("experiments/detection_limit.yaml", quick=True)
    assert experiment.config.unknowns == ()
    complete = load_experiment("experiments/detection_limit.yaml")
    assert len(complete.points) == 2 * len(experiment.points)
