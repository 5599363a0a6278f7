"""The experiments that come with tofpod: valid, complete, crop and radius fit for the board in
every variation."""

from __future__ import annotations

from functools import cache
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest

from detectors.crop import BoxCrop
from detectors.methods.thesis import ThesisConfig
from harness.experiment import quick
from harness.experiment.load import load_experiment, resolved_yaml
from harness.experiment.schema import MAIN, Experiment, Point, SimulatedSource
from harness.runs.plan import plan_of
from harness.vocabulary.geometry import MM, transform_points

FOLDER = Path(__file__).resolve().parents[3] / "experiments"
MANY = 200  # set-ups
RIM_MM = 5.9
"""The crop leaves a rim of 6 mm of the untilted board (and 3 pixels more); the tilt shortens it by
0.1 mm."""


@cache
def experiment(name: str) -> Experiment:
    return load_experiment(FOLDER / f"{name}.yaml")


def points_of(name: str) -> tuple[Point, ...]:
    return experiment(name).points


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_experiment_is_valid_and_named_like_its_file(path: Path, tmp_path: Path) -> None:
    first = experiment(path.stem)
    assert first.config.name == path.stem
    if len(first.points) > MANY:  # resolved in the same way, but for seconds
        return
    resolved = tmp_path / path.name
    resolved.write_text(resolved_yaml(first))
    again = load_experiment(resolved)
    assert (again.points, again.digest) == (first.points, first.digest)


def test_averaging_is_the_experiment_of_the_thesis() -> None:
    main = [point for point in points_of("averaging") if point.variant == MAIN]
    assert [point.config.capture.frames for point in main] == [1, 2, 5, 10, 20, 50]
    assert {point.config.repeats for point in main} == {50}
    assert (
        len({point.frames_key for point in main}) == 1
    )  # shorter averages are prefixes of the longer
    assert len({point.digest for point in main}) == len(main)


def test_a_quick_run_has_few_repeats_or_boards_and_says_that_it_is_a_first_look() -> None:
    first = load_experiment(
        FOLDER / "averaging.yaml", ["threshold.calibrate.repeats=7"], quick=True
    )
    assert first.config.repeats == 5 and first.config.threshold.calibrate.repeats == 7  # type: ignore[union-attr]
    assert first.config.sensitivity is None and {point.variant for point in first.points} == {MAIN}
    assert first.config.title == f"{experiment('averaging').config.title} (a first look)"
    config = load_experiment(FOLDER / "detection_limit.yaml", quick=False).config
    study = load_experiment(FOLDER / "detection_limit.yaml", quick=True).config
    boards = [
        [c.study.boards, c.study.hole_free_boards, c.threshold.calibrate.boards]
        for c in (config, study)
    ]  # type: ignore[union-attr]
    assert boards == [[36, 36, 60], [12, 12, 20]] and study.repeats == config.repeats == 1


def test_a_quick_run_keeps_the_boards_that_its_threshold_needs() -> None:
    first = load_experiment(FOLDER / "detectors.yaml", quick=True).config
    assert first.threshold.calibrate is not None
    assert first.threshold.calibrate.boards == 20  # a third of 38 is 13, which cannot show the rate


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.yaml")), ids=lambda file: file.stem)
def test_the_quick_run_of_every_shipped_experiment_is_small(file: Path, tmp_path: Path) -> None:
    """What is planned costs about what the rule allows, which knows no plan: 25 % more at most."""
    first_look = load_experiment(file, quick=True)
    plan = plan_of(first_look, tmp_path)
    is_map = bool(first_look.config.mapping)
    frames_s = quick.MAP_FRAMES_S if is_map else quick.FRAMES_S
    noise_mm = first_look.points[0].config.simulated.render.hole_noise_mm
    view_s = max(quick.LEAST_VIEW_S, quick.VIEW_S_MM / noise_mm) + quick.FIRST_S
    cost_s = view_s * len(plan.renders)
    for group in plan.groups:
        detections_s = 0.0
        for point in group.points:
            name = point.config.detector.name
            usual_s = quick.MAP_DETECTION_S if is_map else quick.DETECTION_S
            detections_s += quick.DETECTORS_S.get(name, usual_s)
        for batch in (*group.first, *group.then):
            trials = group.most_repeats(batch)
            cost_s += trials * (frames_s * len(batch.views) + detections_s)
    assert cost_s <= 1.25 * quick.BUDGET_S


def test_slow_detectors_are_left_out_of_a_quick_run_first() -> None:
    first_look = load_experiment(FOLDER / "detectors.yaml", quick=True)
    names = {point.config.detector.name for point in first_look.points}
    assert names == {"thesis", "local", "matched", "learned", "plane_ransac"}


def test_a_quick_run_has_the_ends_of_long_axes() -> None:
    today = load_experiment(FOLDER / "today.yaml", quick=True).config
    assert today.sweep["source.camera.name"] == ("azure_kinect_nfov", "vzense_ds86")
    assert today.sweep["source.target.distance_m"] == (0.5, 1.5)
    assert today.sweep["detector.name"] == ("thesis", "matched")  # on the same views
    assert today.sweep["capture.frames"] == (1, 50)
    perspectives = load_experiment(FOLDER / "perspectives.yaml", quick=True).config
    assert perspectives.sweep["mapping.views"] == (1, 3, 9)
    written = ["sweep.source.target.distance_m=[0.5, 1.0, 1.5]"]
    asked = load_experiment(FOLDER / "today.yaml", written, quick=True).config
    assert asked.sweep["source.target.distance_m"] == (0.5, 1.0, 1.5)


def test_a_quick_run_of_the_detection_limit_has_all_its_set_ups() -> None:
    first_look = load_experiment(FOLDER / "detection_limit.yaml", quick=True)
    stated = [point for point in points_of("detection_limit") if not point.unknowns]
    assert {point.variant for point in first_look.points} == {point.variant for point in stated}


def test_a_quick_run_has_few_draws() -> None:
    draws = load_experiment(FOLDER / "thesis_inference.yaml", quick=True).config.draws
    # a draw has two views, four repeats and one that sets the threshold, at two numbers of frames
    draw_s = 2 * (0.8 + 0.17) + 5 * (0.15 + 2 * 0.085)
    assert draws == int(quick.BUDGET_S / draw_s) == 25


def test_every_variation_of_averaging_changes_something() -> None:
    points = points_of("averaging")
    main = {point.digest for point in points if point.variant == MAIN}
    varied = [point.digest for point in points if point.variant != MAIN]
    assert main.isdisjoint(varied)
    assert len(set(varied)) == len(varied)


@pytest.mark.parametrize("name", ["averaging", "smoke"])
def test_the_crop_keeps_all_holes_and_leaves_a_rim(name: str) -> None:
    for point in points_of(name):
        source = point.config.source
        crop = ThesisConfig.from_data(point.config.detector.settings).crop
        assert isinstance(source, SimulatedSource)
        assert isinstance(crop, BoxCrop)
        target = source.target.declare()
        to_camera = target.pose.T_camera_board
        half = np.array([target.board.width_mm, target.board.height_mm]) / 2
        corners = [[x * half[0], y * half[1], 0.0] for x, y in product((-1, 1), repeat=2)]
        board_mm = transform_points(to_camera, np.array(corners) * MM) / MM
        for axis, (low, high) in enumerate((crop.x_mm, crop.y_mm)):
            # the board's edges are within a degree of the camera's axes, so the inner corner on
            # each side is its limit
            assert low - np.sort(board_mm[:, axis])[1] >= RIM_MM, point.label
            assert np.sort(board_mm[:, axis])[2] - high >= RIM_MM, point.label
        assert crop.z_mm[0] < board_mm[:, 2].min(), point.label
        assert board_mm[:, 2].max() + target.board.thickness_mm < crop.z_mm[1], point.label
        assert crop.range_max_m is None
        for hole in target.holes:
            angle = np.linspace(0, 2 * np.pi, 64)
            rim = (
                np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1) * hole.diameter_mm / 2
            )
            rim_mm = transform_points(to_camera, (rim + np.array([*hole.centre_mm, 0.0])) * MM) / MM
            for axis, (low, high) in enumerate((crop.x_mm, crop.y_mm)):
                assert low < rim_mm[:, axis].min() and rim_mm[:, axis].max() < high, point.label


def test_the_matching_radius_tells_neighbours_apart_and_covers_the_largest_hole() -> None:
    for point in points_of("averaging"):
        assert isinstance(point.config.source, SimulatedSource)
        holes = point.config.source.target.declare().holes
        pitch_mm = min(abs(a.centre_mm[0] - b.centre_mm[0]) for a, b in pairwise(holes))
        assert (
            max(hole.diameter_mm for hole in holes) / 2
            < point.config.matching.radius_mm
            < pitch_mm / 2
        )
