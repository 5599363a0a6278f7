"""Several set-ups in one experiment: how axes and switches make them, what they are called, what
is compared."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.experiment.load import load_experiment
from harness.experiment.schema import MAIN, Experiment
from harness.vocabulary.declaration.yaml_source import DeclarationError
from harness.vocabulary.path_names import differing, in_words, names_of, unit_of, value_text

ROOT = Path(__file__).resolve().parents[3]

BASE = """\
name: trial
source:
  kind: simulated
  target: {name: thesis, distance_m: 0.7}
  camera: {name: azure_kinect_nfov}
capture: {frames: 5}
threshold: {calibrate: {repeats: 4}}
"""
STUDY = """\
sensitivity:
  repeats: 2
  frames: [5]
  vary:
    - {path: source.target.hole_kind, values: [blind], reason: not stated}
    - {label: far and blind, set: {source.target.distance_m: 0.9, source.target.hole_kind: blind}, reason: not stated}
"""


def loaded(folder: Path, text: str) -> Experiment:
    path = folder / "x.yaml"
    path.write_text(text)
    return load_experiment(path)


def problems(folder: Path, text: str) -> str:
    with pytest.raises(DeclarationError) as caught:
        loaded(folder, text)
    return str(caught.value)


def set_ups(experiment: Experiment) -> list[str]:
    return list(
        dict.fromkeys(point.variant for point in experiment.points if not point.is_variation)
    )


def test_averaging_alone_is_one_set_up_whose_digest_does_not_know_of_others(tmp_path):
    averaging = load_experiment(ROOT / "experiments" / "averaging.yaml")
    assert set_ups(averaging) == [MAIN]
    assert all(point.axes == {} for point in averaging.points)
    one_value = loaded(
        tmp_path, BASE + "sweep: {source.target.distance_m: [0.7], capture.frames: [1, 5]}\n"
    )
    assert set_ups(one_value) == [MAIN]
    without = loaded(tmp_path, BASE + "sweep: {capture.frames: [1, 5]}\n")
    assert [p.digest for p in one_value.points] == [p.digest for p in without.points]


def test_each_combination_of_the_other_axes_is_a_set_up_with_its_own_frames(tmp_path):
    text = (
        "sweep: {source.camera.unit_seed: [1, 2], capture.frames: [1, 5], "
        "source.target.distance_m: [0.6, 0.9]}\n"
    )
    experiment = loaded(tmp_path, BASE + text)
    assert set_ups(experiment) == [
        "unit seed=1, distance=0.6 m",
        "unit seed=1, distance=0.9 m",
        "unit seed=2, distance=0.6 m",
        "unit seed=2, distance=0.9 m",
    ]
    assert len({point.frames_key for point in experiment.points}) == 4
    # one number of frames more changes no other point
    additional = loaded(tmp_path, BASE + text.replace("[1, 5]", "[1, 2, 5]"))
    assert {p.digest for p in experiment.points} < {p.digest for p in additional.points}
    assert experiment.points[0].axes == {
        "source.camera.unit_seed": 1,
        "source.target.distance_m": 0.6,
    }


def test_a_variation_is_compared_with_the_set_up_at_its_place(tmp_path):
    experiment = loaded(tmp_path, BASE + "sweep: {source.target.distance_m: [0.6, 0.9]}\n" + STUDY)
    reference = {point.variant: point.reference for point in experiment.points}
    assert reference["far and blind"] == "distance=0.9 m"
    assert reference["source.target.hole_kind=blind"] == ""  # at the base's 0.7 m stands no set-up
    assert reference["distance=0.6 m"] == "distance=0.6 m"
    alone = loaded(tmp_path, BASE + STUDY)
    assert {point.reference for point in alone.points} == {MAIN}


def test_switches_are_none_each_alone_all_but_each_and_all(tmp_path):
    experiment = loaded(
        tmp_path, BASE + "switches: source.camera.effects\nsweep: {capture.frames: [1, 5]}\n"
    )
    effects = list(type(experiment.config.source.camera.effects).model_fields)
    words = [name.replace("_", " ") for name in effects]
    expected = ["none", *(f"{w} alone" for w in words), *(f"all but {w}" for w in words), "all"]
    assert set_ups(experiment) == expected
    on = {p.variant: p.config.source.camera.effects.to_data() for p in experiment.points}
    assert not any(on["none"].values())
    assert all(on["all"].values())
    for name, word in zip(effects, words, strict=True):
        assert [key for key, value in on[f"{word} alone"].items() if value] == [name]
        assert [key for key, value in on[f"all but {word}"].items() if not value] == [name]
    assert len({point.frames_key for point in experiment.points}) == len(expected)
    # what all switches on gives is the camera as it stands
    plain = loaded(tmp_path, BASE + "sweep: {capture.frames: [1, 5]}\n")
    everything = [p.digest for p in experiment.points if p.variant == "all"]
    assert everything == [p.digest for p in plain.points]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("switches: source.camera\n", ["does not hold switches", "true or false"]),
        ("switches: source.camra.effects\n", ["does not hold switches"]),
        (
            (
                "switches: source.camera.effects\nsweep: {source.camera.effects.noise: [true, "
                "false]}\n"
            ),
            ["set the same key"],
        ),
        (
            "sweep: {source.target.distance_m: [0.6, 0.9]}\n"
            + STUDY.replace("far and blind", "distance=0.9 m"),
            ["two different set-ups are called `distance=0.9 m`"],
        ),
        ("sweep: {switches: [source.camera.effects]}\n", ["`switches` cannot be varied here"]),
    ],
)
def test_what_cannot_be_told_apart_is_refused_with_its_place(tmp_path, text, expected):
    printed = problems(tmp_path, BASE + text)
    assert "x.yaml:" in printed
    for part in expected:
        assert part in printed


def test_names_of_paths_and_values():
    paths = [
        "source.camera.name",
        "source.target.distance_m",
        "detector.name",
        "source.camera.numbers.beam.fwhm_mrad",
    ]
    assert list(names_of(paths).values()) == ["camera", "distance", "detector", "fwhm"]
    assert names_of(["a.tilt_x_deg", "b.tilt_x_deg"]) == {
        "a.tilt_x_deg": "a.tilt_x_deg",
        "b.tilt_x_deg": "b.tilt_x_deg",
    }
    assert [unit_of(path) for path in ("x.tilt_deg", "x.width_mm", "x.degree", "x.m")] == [
        "°",
        "mm",
        "",
        "",
    ]
    assert value_text("x.distance_m", 0.75) == "0.75 m"
    assert value_text("x.distance_m", None) == "none"
    assert value_text("x.edge_gate", True) == "true"
    assert len(value_text("x", "y" * 100)) == 60


def test_set_ups_and_variations_read_as_words():
    assert (
        in_words("camera=kinect_v2, backing distance=20 mm") == "Kinect v2, backing distance 20 mm"
    )
    assert in_words("source.target.distance_m=0.5") == "distance 0.5 m"
    assert in_words("source.camera.edge_gate=false") == "edge gate off"
    assert in_words("filter=none, filter=hole_filling") == "no filter, filter hole filling"
    assert in_words("albedo 850=0.1") == "albedo 0.1 at 850 nm"


def test_references_and_shapes_read_as_an_engineer_says_them():
    good_parts = [{"kind": "good_parts", "parts": 1}, {"parts": 20}]
    references = [None, {"kind": "scan"}, *good_parts, {"kind": "mesh"}]
    texts = [value_text("compared_with", value) for value in references]
    assert texts[:2] == ["no reference", "an earlier scan"]
    assert texts[2:] == ["1 good part", "20 good parts", "the drawing"]
    made = {"kind": "made", "shape": {"kind": "panel"}, "form_mm": 0.3, "sizes_percent": 2.0}
    shape = value_text("source.target.board.shape", made)
    assert shape == "made, door panel, form 0.3 mm, sizes 2 %"
    bent = {"kind": "cylinder", "radius_mm": 70.0}
    sibling = {**made, "shape": bent}
    assert differing(sibling, [made, sibling]) == {"shape": {"kind": "cylinder"}}
    wider = {**made, "shape": {**bent, "radius_mm": 80.0}}
    assert differing(sibling, [made, sibling, wider]) == {"shape": bent}
    name = "shape=flat board, compared with=5 good parts"
    assert in_words(name) == "flat board, 5 good parts"
    assert in_words("the script as it stands, k = 1.2") == "the script as it stands, k = 1.2"


@pytest.mark.parametrize(("name", "points", "groups"), [("cameras", 90, 45), ("anatomy", 40, 20)])
def test_comparison_experiments_are_valid(name, points, groups, capsys, tmp_path):
    from harness.sweep import main

    path = ROOT / "experiments" / f"{name}.yaml"
    assert main([str(path), "--dry-run", "--out", str(tmp_path / "out")]) == 0
    assert f"{name}: valid\n  {points} points, {groups} sets of frames" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    experiment = load_experiment(path)
    assert all(
        point.config.repeats >= 8 for point in experiment.points
    )  # fewer could not make "found" of all
