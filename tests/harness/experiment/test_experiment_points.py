"""Loading an experiment: every problem with its place, points in order, digests that cover numbers
and only those."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest
from pydantic import Field

import detectors
from harness.experiment.load import load_experiment, resolved_yaml
from harness.experiment.schema import MAIN, Experiment, Point
from harness.vocabulary.config import Config
from harness.vocabulary.declaration.yaml_source import DeclarationError
from tests.support.plug_in_packages import offer


class TrialSettings(Config):
    scale: Literal["residual_std", "raw_z_std"] = "residual_std"
    degree: int = Field(3, ge=1, le=5)


@dataclass(frozen=True)
class TrialDetector:
    """A plug-in detector as far as validation needs it."""

    settings: TrialSettings
    name: str = "trial"
    version: int = 1

    settings_type = TrialSettings


BASE = """\
name: trial
seed: 7
source:
  kind: simulated
  target: {name: thesis, distance_m: 0.7}
  camera: {name: azure_kinect_nfov}
capture: {frames: 5}
detector: {name: trial, settings: {degree: 2}}
threshold: {calibrate: {repeats: 4}}
matching: {radius_mm: 15.0}
repeats: 3
"""
SWEEP = """\
sweep:
  capture.frames: [1, 5]
  source.target.hole_kind: [through, blind]
"""
STUDY = """\
sensitivity:
  repeats: 2
  frames: [1, 5]
  vary:
    - path: source.target.distance_m
      values: [0.5, 0.9]
      reason: the distance is not stated
    - label: script's estimator
      set: {detector.settings.scale: raw_z_std, detector.settings.degree: 3}
      reason: the script differs from the text
"""


@pytest.fixture(autouse=True)
def trial_detector(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    offer(
        monkeypatch,
        tmp_path / "packages",
        "trials",
        detectors.GROUP,
        {"trial": f"{__name__}:TrialDetector"},
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path


def loaded(folder: Path, text: str, *overrides: str) -> Experiment:
    path = folder / "x.yaml"
    path.write_text(text)
    return load_experiment(path, overrides)


def refused(folder: Path, text: str, *overrides: str) -> str:
    with pytest.raises(DeclarationError) as caught:
        loaded(folder, text, *overrides)
    return str(caught.value).replace(f"{folder}/", "")


def by_values(experiment: Experiment) -> dict[str, Point]:
    return {point.label: point for point in experiment.points}


def test_points_are_the_product_of_the_axes_in_order_then_the_variations(folder: Path) -> None:
    experiment = loaded(folder, BASE + SWEEP + STUDY)
    assert [(point.variant, point.label) for point in experiment.points] == [
        ("hole kind=through", "capture.frames=1, source.target.hole_kind=through"),
        ("hole kind=blind", "capture.frames=1, source.target.hole_kind=blind"),
        ("hole kind=through", "capture.frames=5, source.target.hole_kind=through"),
        ("hole kind=blind", "capture.frames=5, source.target.hole_kind=blind"),
        ("source.target.distance_m=0.5", "source.target.distance_m=0.5, capture.frames=1"),
        ("source.target.distance_m=0.5", "source.target.distance_m=0.5, capture.frames=5"),
        ("source.target.distance_m=0.9", "source.target.distance_m=0.9, capture.frames=1"),
        ("source.target.distance_m=0.9", "source.target.distance_m=0.9, capture.frames=5"),
        ("script's estimator", "script's estimator, capture.frames=1"),
        ("script's estimator", "script's estimator, capture.frames=5"),
    ]
    assert experiment.points[1].values == {"capture.frames": 1, "source.target.hole_kind": "blind"}
    assert [point.config.repeats for point in experiment.points] == [3] * 4 + [2] * 6
    assert {point.config.sensitivity for point in experiment.points} == {None}
    last = experiment.points[-1].config
    assert (last.capture.frames, last.detector.settings) == (5, {"scale": "raw_z_std", "degree": 3})


def test_without_axes_there_is_one_point(folder: Path) -> None:
    (point,) = loaded(folder, BASE).points
    assert (point.variant, point.values, point.config.repeats) == (MAIN, {}, 3)
    assert point.config.detector.settings == {"scale": "residual_std", "degree": 2}


def test_calibration_repeats_of_the_study(folder: Path) -> None:
    def repeats(text: str) -> list[int]:
        calibrations = (point.config.threshold.calibrate for point in loaded(folder, text).points)
        return [calibrate.repeats for calibrate in calibrations if calibrate]

    assert repeats(BASE + SWEEP + STUDY) == [4] * 10
    fewer = STUDY.replace("  repeats: 2\n", "  repeats: 2\n  calibration_repeats: 1\n")
    assert repeats(BASE + SWEEP + fewer) == [4] * 4 + [1] * 6


def test_a_new_value_on_an_axis_leaves_all_other_points_as_they_were(folder: Path) -> None:
    before = by_values(loaded(folder, BASE + SWEEP + STUDY))
    after = by_values(loaded(folder, BASE + SWEEP.replace("[1, 5]", "[2, 1, 5, 50]") + STUDY))
    assert set(before) < set(after)
    for label, point in before.items():
        assert (after[label].digest, after[label].frames_key) == (point.digest, point.frames_key)
    assert len({point.digest for point in after.values()}) == len(after)


@pytest.mark.parametrize(
    "override", ["name=other", "title=new words", "repeats=99", "sensitivity=null"]
)
def test_what_changes_no_number_changes_no_digest(folder: Path, override: str) -> None:
    before = loaded(folder, BASE + SWEEP)
    after = loaded(folder, BASE + SWEEP, override)
    assert [point.digest for point in after.points] == [point.digest for point in before.points]


def test_spelling_out_a_default_or_another_order_changes_no_digest(folder: Path) -> None:
    reordered = (
        "threshold: {calibrate: {repeats: 4}}\nrepeats: 3\nmatching: {radius_mm: 15}\nname: "
        "trial\n"
        "capture: {average: {method: mean}, frames: 5}\nseed: 7\n"
        "detector: {settings: {scale: residual_std, degree: 2}, name: trial}\n"
        "source:\n  camera: {unit_seed: 1}\n  target: {distance_m: 0.7, hole_kind: through, "
        "name: thesis}\n"
        "  kind: simulated\n"
    )
    assert loaded(folder, reordered).points[0].digest == loaded(folder, BASE).points[0].digest


@pytest.mark.parametrize(
    ("override", "changes"),
    [
        ("seed=8", {"digest", "frames"}),
        ("capture.frames=6", {"digest"}),
        ("capture.average.method=median", {"digest"}),
        ("detector.settings.degree=3", {"digest"}),
        ("threshold={k: 3.5}", {"digest"}),
        ("matching.radius_mm=10", {"digest"}),
        ("source.camera.unit_seed=2", {"digest", "frames"}),
        ("source.camera.fixed_pattern_scale=2.0", {"digest", "frames"}),
        ("source.camera.edge_gate=false", {"digest", "frames"}),
        ("source.target.distance_m=0.8", {"digest", "frames"}),
        ("source.target.hole_kind=blind", {"digest", "frames"}),
        ("repeats=4", set()),
    ],
)
def test_keys_cover_exactly_what_they_name(folder: Path, override: str, changes: set[str]) -> None:
    (before,) = loaded(folder, BASE).points
    (after,) = loaded(folder, BASE, override).points
    changed = {"digest": before.digest != after.digest}
    changed["frames"] = before.frames_key != after.frames_key
    assert {name for name, differs in changed.items() if differs} == changes


def test_the_detectors_version_is_part_of_the_digest(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (before,) = loaded(folder, BASE).points
    monkeypatch.setattr(TrialDetector.__init__, "__defaults__", ("trial", 2))
    (after,) = loaded(folder, BASE).points
    assert before.digest != after.digest
    assert before.frames_key == after.frames_key


def test_digests_do_not_depend_on_the_process(folder: Path) -> None:
    first = loaded(folder, BASE + SWEEP + STUDY)
    second = loaded(folder, BASE + SWEEP + STUDY)
    assert first.digest == second.digest
    assert [point.digest for point in first.points] == [point.digest for point in second.points]


def test_the_results_folder_is_inside_the_results(folder: Path) -> None:
    experiment = loaded(folder, BASE)
    assert experiment.folder(Path("results")) == Path("results") / "trial" / experiment.digest
    assert loaded(folder, BASE, "repeats=9").digest != experiment.digest


@pytest.mark.parametrize(
    "name", ["../up", "a/b", "a\\b", "..", ".", "", "a b", "-x", "é", "x" * 65, "a.b", "'a\n'"]
)
def test_names_cannot_leave_the_results(folder: Path, name: str) -> None:
    message = refused(
        folder, BASE.replace("name: trial\nseed", f'name: "{name}"\nseed'.replace("\n'", "\\n'"))
    )
    assert "x.yaml:1:7: `name` is" in message
    assert "legal: text that matches" in message


def test_the_resolved_experiment_is_complete_and_gives_the_same_points(folder: Path) -> None:
    first = loaded(folder, BASE + SWEEP, "seed=9")
    text = resolved_yaml(first)
    for words in (
        "seed: 9",
        "clip_sigmas:",
        "scale: residual_std",
        "blind_depth_mm:",
        "edge_gate: true",
    ):
        assert words in text
    second = loaded(folder, text)
    assert (second.points, second.digest) == (first.points, first.digest)


def test_settings_that_are_varied_are_resolved_as_they_were_written(folder: Path) -> None:
    first = loaded(folder, BASE + SWEEP + STUDY)
    text = resolved_yaml(first)
    assert "  settings:\n    degree: 2\nthreshold:" in text
    second = loaded(folder, text)
    assert (second.points, second.digest) == (first.points, first.digest)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "repeats: 3",
            "repeats: 0",
            ["x.yaml:11:10: `repeats` is 0", "legal: a whole number from 1 to 100000"],
        ),
        ("{repeats: 4}", "{repeats: 0}", ["x.yaml:9:34: `threshold.calibrate.repeats` is 0"]),
        (
            "{calibrate: {repeats: 4}}",
            "{}",
            ["x.yaml:9:12: `threshold`: give either `k` or `calibrate`"],
        ),
        (
            "{calibrate:",
            "{k: 3.0, calibrate:",
            ["x.yaml:9:12: `threshold`: give either `k` or `calibrate`"],
        ),
        (
            "{frames: 5}",
            "{frames: 20000}",
            ["x.yaml:7:19: `capture.frames` is 20000", "from 1 to 10000"],
        ),
        (
            "{frames: 5}",
            "{frames: 5, average: {frames: 2}}",
            ["x.yaml:7:32: the number of frames is set by"],
        ),
        (
            "azure_kinect_nfov",
            "azure_kinect",
            [
                'x.yaml:6:18: `source.camera.name` is "azure_kinect"',
                "did you mean: azure_kinect_nfov",
            ],
        ),
        (
            "{name: trial,",
            "{name: tril,",
            ['x.yaml:8:18: `detector.name` is "tril"', "did you mean: trial"],
        ),
        (
            "degree: 2",
            "degree: 9",
            ["x.yaml:8:44: `detector.settings.degree` is 9", "legal: a whole number from 1 to 5"],
        ),
        (
            "degree: 2",
            "degre: 2",
            ["x.yaml:8:36: unknown key `degre` in `detector.settings`", "did you mean: degree"],
        ),
        (
            "radius_mm: 15.0",
            "radius_mm: 30.0",
            ["x.yaml:10:23: within a matching radius of 30 mm", "at most 25.4 mm"],
        ),
        (
            "radius_mm: 15.0",
            "radius_mm: 0.015",
            ["x.yaml:10:23: `matching.radius_mm` is 0.015", "from 0.5 to 1000"],
        ),
        (
            "kind: simulated",
            "kind: simulate",
            ['x.yaml:4:9: `source.kind` is "simulate"', "did you mean: simulated"],
        ),
        (
            "name: thesis,",
            "name: thesi,",
            ['x.yaml:5:18: `source.target.name` is "thesi"', "one of thesis, custom"],
        ),
        (
            "distance_m: 0.7",
            "distance_m: 700",
            ["x.yaml:5:38: `source.target.distance_m` is 700", "from 0.3 to 5"],
        ),
        ("distance_m: 0.7", "tape_y_mm: 3.0", ["x.yaml:5:11: the target cannot be built"]),
    ],
)
def test_mistakes_of_the_experiment_have_their_place(
    folder: Path, old: str, new: str, expected: list[str]
) -> None:
    assert old in BASE
    message = refused(folder, BASE.replace(old, new, 1))
    assert "1 problem" in message
    for words in expected:
        assert words in message


@pytest.mark.parametrize(
    ("sweep", "expected"),
    [
        (
            "capture.frames: [1, 0, 5]",
            ["13:23: `capture.frames` is 0: it should be greater", "|                       ^\n"],
        ),
        ("capture.frames: [1, ten]", ['13:23: `capture.frames` is "ten"', "from 1 to 10000"]),
        (
            "capture.frames: []",
            ["13:19: `sweep.capture.frames` is an empty list", "(1 to 1000 items)"],
        ),
        ("capture.frames: 3", ["13:19: `sweep.capture.frames` is 3"]),
        (
            "capture.frames: [1, 5, 1]",
            ["13:26: the points capture.frames=1 and capture.frames=1 are the same experiment"],
        ),
        ("source.target.distance_m: [1, 1.0]", ["13:33: the points", "are the same experiment"]),
        (
            "capture.frmes: [1]",
            ["13:3: unknown path `capture.frmes`", "did you mean: capture.frames"],
        ),
        (
            "source.target.distnce_m: [1]",
            ["13:3: unknown path", "did you mean: source.target.distance_m"],
        ),
        (
            "detector.settings.degre: [1]",
            ["13:3: unknown path", "did you mean: detector.settings.degree"],
        ),
        ("detector.settings.degree: [1, 7]", ["13:33: `detector.settings.degree` is 7"]),
        ("detector.name: [trial, nothing]", ['13:26: `detector.name` is "nothing"']),
        (
            "detector.settings: [{degree: 1}, {degre: 1}]",
            ["13:37: unknown key `degre` in `detector.settings`"],
        ),
        (
            "source.camera.name: [azure_kinect_nfow]",
            ["13:24: `source.camera.name` is", "did you mean: azure_kinect_nfov"],
        ),
        (
            "repeats: [1, 2]",
            ["13:3: `repeats` cannot be varied here: it is the same for all points"],
        ),
        ("name: [a, b]", ["13:3: `name` cannot be varied here"]),
        ("sensitivity.repeats: [1, 2]", ["13:3: `sensitivity.repeats` cannot be varied here"]),
        ("seed.x: [1]", ["13:3: unknown path `seed.x`"]),
        (
            "source.target.hole_spacing_mm: [50.8, 90.0]",
            ["13:41: with source.target.hole_spacing_mm=90.0: the target cannot be built"],
        ),
        ("matching.radius_mm: [10.0, 26.0]", ["13:30: within a matching radius of 26 mm"]),
        (
            "capture.frames: [1, 2]\n  capture: [{frames: 1}]",
            ["13:3: the axes `capture` and `capture.frames` set the same key"],
        ),
    ],
)
def test_mistakes_of_the_axes_have_the_place_of_the_value(
    folder: Path, sweep: str, expected: list[str]
) -> None:
    message = refused(folder, f"{BASE}sweep:\n  {sweep}\n")
    assert "1 problem" in message
    for words in expected:
        assert words in message


def test_too_many_points(folder: Path) -> None:
    values = ", ".join(map(str, range(1, 201)))
    message = refused(folder, f"{BASE}sweep:\n  capture.frames: [{values}]\n  seed: [{values}]\n")
    assert "x.yaml:12:1: the axes make 40000 points" in message


def test_a_combination_that_cannot_be_is_named(folder: Path) -> None:
    sweep = (
        "sweep:\n  source.target.board_width_mm: [609.6, 700.0]\n  source.target.tape_x_mm: "
        "[200.0, 325.0]\n"
    )
    alone = refused(folder, BASE + sweep)
    assert "x.yaml:14:36: with source.target.tape_x_mm=325.0: the target cannot be built" in alone
    base = BASE.replace("distance_m: 0.7", "board_width_mm: 700.0, tape_x_mm: 200.0")
    message = refused(folder, base + sweep)
    assert "1 problem" in message
    assert (
        "with source.target.board_width_mm=609.6, source.target.tape_x_mm=325.0: the target "
        "cannot be built"
    ) in message


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "frames: [1, 5]\n  vary",
            "frames: [1, 7]\n  vary",
            ["16:15: the main experiment has no set-up with 7 frames", "of 1, 5"],
        ),
        ("frames: [1, 5]\n  vary", "frames: [1, 1]\n  vary", ["are the same experiment"]),
        ("[0.5, 0.9]", "[0.5, 90]", ["19:21: `source.target.distance_m` is 90"]),
        ("[0.5, 0.9]", "[0.5, 0.5]", ["19:21: the points", "are the same experiment"]),
        (
            "path: source.target.distance_m",
            "path: source.target.distance",
            ["18:13: unknown path", "did you mean: source.target.distance_m"],
        ),
        (
            "path: source.target.distance_m",
            "path: capture.frames",
            ["`capture.frames` cannot be varied here: it is set by `sensitivity.frames`"],
        ),
        (
            "      reason: the distance is not stated\n",
            "",
            ["18:7: `sensitivity.vary.0` lacks the key `reason`"],
        ),
        (
            "raw_z_std",
            "raw_std",
            ['22:38: `detector.settings.scale` is "raw_std"', "did you mean: raw_z_std"],
        ),
        (
            "detector.settings.scale:",
            "detector.settings.scal:",
            ["22:13: unknown path", "did you mean: detector.settings.scale"],
        ),
        ("label: script's estimator", 'label: "a\\nb"', ["21:14: `sensitivity.vary.1.label` is"]),
    ],
)
def test_mistakes_of_the_study_have_their_place(
    folder: Path, old: str, new: str, expected: list[str]
) -> None:
    sweep = "sweep:\n  capture.frames: [1, 5]\n"
    assert old in STUDY
    message = refused(folder, BASE + sweep + STUDY.replace(old, new, 1))
    for words in expected:
        assert words in message


def test_problems_of_file_axes_study_and_overrides_come_together_in_order(folder: Path) -> None:
    text = (
        BASE.replace("seed: 7", "sed: 7")
        + SWEEP.replace("[1, 5]", "[0, 5]")
        + STUDY.replace("0.9", "9.9")
    )
    message = refused(folder, text, "repeats=none", "captur.frames=1")
    heads = [line for line in message.splitlines() if line.startswith(("x.yaml:", "--set:"))]
    assert heads[0].startswith("x.yaml: 6 problems; nothing was run")
    assert heads[1].startswith("--set: unknown path `captur.frames`")
    assert heads[2].startswith('--set: `repeats` is "none"')
    positions = [head.split(": ")[0] for head in heads[3:]]
    assert positions == ["x.yaml:2:1", "x.yaml:13:20", "x.yaml:17:12", "x.yaml:20:21"]
