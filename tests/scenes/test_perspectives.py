"""Poses of several views, the guesses of where they stand, and what an experiment may say about
them."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from harness.experiment.load import load_experiment
from harness.vocabulary.declaration.yaml_source import DeclarationError
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import invert, transform_points
from harness.vocabulary.seeds import random_stream
from scenes.perspectives import (
    ArcViews,
    GridViews,
    HandHeldViews,
    ListedViews,
    T_reference_view_of,
    _walk,
    check_in_view,
    guessed_T_reference_view,
    poses_of,
    seen_region,
)
from scenes.sensor.camera import load_camera
from scenes.target.custom import BoardConfig, PoseConfig, TargetConfig

POSE = PoseConfig(
    distance_m=0.7,
    tilt_x_deg=3.0,
    tilt_y_deg=4.0,
)


def test_nine_views_of_an_arc_are_equally_spaced_and_keep_the_targets_pose_first():
    poses = poses_of(
        ArcViews(
            kind="arc",
            count=9,
            spread_deg=40.0,
        ),
        POSE,
    )
    assert poses[0] == POSE
    turns = [pose.tilt_y_deg - POSE.tilt_y_deg for pose in poses]
    assert turns[:5] == pytest.approx([0, 20, -20, 10, -10])
    assert sorted(turns) == pytest.approx(np.linspace(-20, 20, 9))
    assert {pose.tilt_x_deg for pose in poses} == {3.0}


def test_a_grid_of_nine_views_is_three_by_three_with_corners_first():
    poses = poses_of(
        GridViews(
            kind="grid",
            count=9,
            spread_deg=30.0,
        ),
        PoseConfig(),
    )
    turns = [(pose.tilt_x_deg, pose.tilt_y_deg) for pose in poses]
    assert turns[0] == (0, 0)
    assert {frozenset(map(abs, turn)) for turn in turns[1:5]} == {frozenset({15.0})}
    assert set(turns) == {(x, y) for x in (-15.0, 0.0, 15.0) for y in (-15.0, 0.0, 15.0)}


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(["arc", "grid"]), st.integers(1, 12), st.integers(0, 12))
def test_fewer_views_are_the_first_of_more(
    kind,
    count,
    more,
):
    kind_of = {"arc": ArcViews, "grid": GridViews}[kind]
    views = kind_of(
        kind=kind, count=count, spread_deg=30.0, distance_jitter_mm=20.0, aim_jitter_mm=9.0
    )
    fewer = poses_of(views, POSE)
    longer = poses_of(views.model_copy(update={"count": count + more}), POSE)
    assert longer[:count] == fewer
    assert len(set(longer)) == count + more


def test_a_hand_held_walk_stays_within_its_sway_and_moves_little_between_views():
    views = HandHeldViews(
        kind="hand_held",
        count=40,
        sway_deg=10.0,
        sway_mm=40.0,
    )
    poses = poses_of(views, POSE)
    assert poses[0] == POSE
    turns = np.array([[p.tilt_x_deg - 3, p.tilt_y_deg - 4, p.roll_deg] for p in poses])
    assert np.abs(turns).max(axis=0) == pytest.approx([10, 10, 5])
    assert np.abs(np.diff(turns, axis=0)).max() < 3


def test_a_walk_is_a_sum_of_slow_sines() -> None:
    """Written out: three sines for each of six paths, from the place of the first view, scaled to
    the sway; half as much roll, and half as much towards the target."""
    views = HandHeldViews(kind="hand_held", count=7, sway_deg=10.0, sway_mm=40.0, seed=5)
    rng = random_stream(5, "hand-held")
    phases = rng.uniform(0, 2 * np.pi, (6, 3))
    cycles = rng.uniform(0.3, 1.5, (6, 3))
    steps = np.array(_walk(views))
    for path, reach in enumerate((10.0, 10.0, 5.0, 40.0, 40.0, 20.0)):
        heights = []
        for time in np.arange(7) / 6:
            sines = [
                math.sin(2 * math.pi * cycle * time + phase)
                for cycle, phase in zip(cycles[path], phases[path], strict=True)
            ]
            heights.append(sum(sines))
        moved = np.array(heights) - heights[0]
        assert steps[:, path] == pytest.approx(moved / np.abs(moved).max() * reach)
    poses = poses_of(views, POSE)
    assert poses[3].offset_x_mm == pytest.approx(steps[3, 3])
    assert poses[3].offset_y_mm == pytest.approx(steps[3, 4])
    assert poses[3].distance_m == pytest.approx(0.7 + steps[3, 5] / 1000)
    alone = HandHeldViews(kind="hand_held", count=1)
    assert poses_of(alone, POSE) == (POSE,)


def test_the_views_of_an_arc_and_of_a_grid_come_coarse_to_fine() -> None:
    arc = poses_of(ArcViews(kind="arc", count=12, spread_deg=80.0, about="x"), PoseConfig())
    tilts_deg = [0, 40, -40, 20, -20, 10, -10, 30, -30, 5, -5, 15]
    assert [pose.tilt_x_deg for pose in arc] == pytest.approx(tilts_deg)
    assert {pose.tilt_y_deg for pose in arc} == {0.0}

    grid = poses_of(GridViews(kind="grid", count=25, spread_deg=40.0), PoseConfig())
    turns = [(pose.tilt_x_deg, pose.tilt_y_deg) for pose in grid]
    ticks = (-20.0, -10.0, 0.0, 10.0, 20.0)
    assert sorted(turns) == sorted(itertools.product(ticks, ticks))
    # the centre; four corners, four sides; then from (20, 10) inwards
    away = [np.hypot(*turn) for turn in turns]
    assert away[1:5] == pytest.approx(4 * [np.hypot(20, 20)])
    assert away[5:9] == pytest.approx(4 * [20.0])
    assert away[9:17] == pytest.approx(8 * [np.hypot(20, 10)])
    assert away[17:21] == pytest.approx(4 * [np.hypot(10, 10)])
    assert away[21:] == pytest.approx(4 * [10.0])
    assert turns[1:3] == [(-20.0, -20.0), (-20.0, 20.0)]


def test_views_but_the_first_deviate_as_stated() -> None:
    """Of 199 views, a deviation is known to 5 %."""
    views = ArcViews(
        kind="arc", count=200, spread_deg=1e-9, distance_jitter_mm=20.0, aim_jitter_mm=5.0
    )
    poses = poses_of(views, POSE)
    assert poses[0] == POSE
    shifts_mm = np.array(
        [[pose.offset_x_mm, pose.offset_y_mm, 1000 * (pose.distance_m - 0.7)] for pose in poses[1:]]
    )
    assert shifts_mm.std(axis=0) == pytest.approx([5.0, 5.0, 20.0], rel=0.2)
    assert np.abs(shifts_mm.mean(axis=0) / [5.0, 5.0, 20.0]).max() < 0.25
    assert np.abs(np.corrcoef(shifts_mm.T) - np.eye(3)).max() < 0.25


def test_the_directions_of_guesses_are_even() -> None:
    """Axes and shifts of 199 guesses: the mean of each part of a unit vector is 0 within 0.04."""
    views = ArcViews(kind="arc", count=200, spread_deg=40.0, guess_error_deg=3.0)
    poses = poses_of(views, POSE)
    centre = poses[0].T_camera_board[:3, 3]
    directions = []
    for number in range(1, 200):
        true = T_reference_view_of(poses, number)
        error = guessed_T_reference_view(views, poses, number) @ invert(true)
        turn = Rotation.from_matrix(error[:3, :3]).as_rotvec()
        shift = transform_points(error, centre) - centre
        directions.append(np.concatenate([turn / np.radians(3.0), shift / 0.01]))
    assert np.abs(np.mean(directions, axis=0)).max() < 0.17
    assert (np.array(directions) ** 2).mean(axis=0) == pytest.approx(np.full(6, 1 / 3), abs=0.09)


@pytest.mark.parametrize(
    ("distance_m", "tilt_deg", "problem"),
    [
        (0.3, 0.0, None),
        (0.2, 0.0, "lies 0.200 to"),
        (4.2, 0.0, "lies 4.200 to"),
        (3.8, 0.0, None),
        (0.135, 60.0, "nearest point is 0.048 m"),
        (0.137, 60.0, "lies 0.050 to"),
    ],
)
def test_a_target_out_of_range_is_told(
    distance_m: float, tilt_deg: float, problem: str | None
) -> None:
    """The range along the axis of a camera that sees from 0.25 to 4 m. A face partly in range
    counts."""
    optics = replace(
        load_camera("azure_kinect_nfov").optics,
        nearest_m=0.25,
        farthest_m=4.0,
        limits_along="axis",
    )
    target = TargetConfig(
        name="custom",
        board=BoardConfig(width_mm=200.0, height_mm=100.0, thickness_mm=5.0),
        pose=PoseConfig(distance_m=distance_m, tilt_y_deg=tilt_deg),
    )
    if problem is None:
        check_in_view(target, optics)
        return
    with pytest.raises(UserError, match=problem):
        check_in_view(target, optics)


def test_ranges_along_the_ray_are_longer() -> None:
    """The farthest corner of a face of 400 x 300 mm at 0.5 m lies sqrt(0.25 + 0.04 + 0.0225) m
    away along the ray, 0.5 m along the axis."""
    target = TargetConfig(
        name="custom",
        board=BoardConfig(width_mm=400.0, height_mm=300.0, thickness_mm=5.0),
        pose=PoseConfig(distance_m=0.5),
    )
    for nearest_m, along, fits in (
        (0.55, "ray", True),
        (0.56, "ray", False),
        (0.51, "axis", False),
        (0.49, "axis", True),
    ):
        optics = replace(
            load_camera("azure_kinect_nfov").optics, nearest_m=nearest_m, limits_along=along
        )
        if fits:
            check_in_view(target, optics)
        else:
            with pytest.raises(UserError, match=r"lies 0.500 to 0.\d+ m"):
                check_in_view(target, optics)


def test_the_region_of_a_face_holds_its_pixels() -> None:
    """A face of 200 x 100 mm across the axis at 1 m; half out of view, it is the whole sensor."""
    optics = load_camera("azure_kinect_nfov").optics
    lens = optics.lens
    board = BoardConfig(width_mm=200.0, height_mm=100.0, thickness_mm=5.0)
    target = TargetConfig(name="custom", board=board, pose=PoseConfig(distance_m=1.0))
    region = seen_region(target, optics)
    x_m, y_m = np.meshgrid(np.linspace(-0.1, 0.1, 201), np.linspace(-0.05, 0.05, 101))
    pixels = lens.project(np.stack([x_m, y_m, np.ones_like(x_m)], axis=-1)).reshape(-1, 2)
    left, top = np.floor(pixels.min(axis=0))
    right, bottom = np.ceil(pixels.max(axis=0))
    bounds = (region.row0, region.row1, region.col0, region.col1)
    assert bounds == (top, bottom + 1, left, right + 1)
    wide = target.model_copy(update={"pose": PoseConfig(distance_m=1.0, offset_x_mm=700.0)})
    assert seen_region(wide, optics) == lens.whole
    gone = target.model_copy(update={"pose": PoseConfig(distance_m=1.0, offset_x_mm=5000.0)})
    with pytest.raises(UserError, match="is out of view"):
        seen_region(gone, optics)


def test_the_guess_is_wrong_by_what_it_says_about_the_targets_centre():
    views = ArcViews(
        kind="arc",
        count=3,
        spread_deg=40.0,
        guess_error_deg=3.0,
        guess_error_mm=10.0,
    )
    poses = poses_of(views, POSE)
    true = T_reference_view_of(poses, 1)
    guesses = [guessed_T_reference_view(views, poses, 1, "damaged", repeat) for repeat in range(2)]
    assert not np.allclose(*guesses)
    for guess in guesses:
        error = guess @ invert(true)
        assert np.rad2deg(Rotation.from_matrix(error[:3, :3]).magnitude()) == pytest.approx(3.0)
        centre = poses[0].T_camera_board[:3, 3]
        assert np.linalg.norm(transform_points(error, centre) - centre) == pytest.approx(0.010)
    first = guessed_T_reference_view(views, poses, 0, "damaged", 0)
    assert np.allclose(first, np.eye(4), rtol=0, atol=1e-15)


def test_a_view_and_the_reference_see_the_same_board():
    poses = poses_of(
        ArcViews(
            kind="arc",
            count=5,
            spread_deg=50.0,
            about="x",
        ),
        POSE,
    )
    corner_board = np.array([0.1, -0.04, 0.0])
    for number, pose in enumerate(poses):
        corner_camera = transform_points(pose.T_camera_board, corner_board)
        assert transform_points(T_reference_view_of(poses, number), corner_camera) == pytest.approx(
            transform_points(POSE.T_camera_board, corner_board), abs=1e-12
        )


def test_listed_poses_are_taken_as_they_are():
    second = PoseConfig(distance_m=0.9)
    assert poses_of(ListedViews(kind="list", poses=(POSE, second)), PoseConfig()) == (POSE, second)


BASE = """\
name: views
source:
  kind: simulated
  target: {name: thesis}
  VIEWS
capture: {frames: 1}
MAPPING
threshold: {k: 4.0}
"""
ARC = "views: {kind: arc, count: 3, spread_deg: 40.0}"


@pytest.mark.parametrize(
    ("views", "mapping", "said"),
    [
        (ARC, "", "several views need a mapping"),
        ("", "mapping: {views: 2}", "a mapping needs several views"),
        (ARC, "mapping: {views: 4}", "4 views, but source.views has 3"),
        ("views: {kind: list, poses: [{}, {offset_x_mm: 900.0}]}", "mapping: {}", "view 1 of 2"),
        ("views: {kind: list, poses: [{}, {tilt_y_deg: 130.0}]}", "mapping: {}", "tilt_y_deg"),
        ("views: {kind: arc, count: 3, spread_deg: 140.0}", "mapping: {}", "spread_deg"),
        ("views: {kind: arc, count: 3}", "mapping: {}", "spread_deg"),
        ("views: {kind: ark, count: 3, spread_deg: 40.0}", "mapping: {}", "arc"),
        (
            f"{ARC.replace('40.0', '118.0')}\n  target: {{name: thesis, tilt_y_deg: 50.0}}",
            "",
            "a number from -70 to 70",
        ),
        (ARC, "mapping: {registration: {method: ipc}}", "icp"),
        (ARC, "mapping: {merge: {kind: fusion, step_mm: 1.0}}", "step_mm"),
    ],
)
def test_what_does_not_fit_is_told_where_it_stands(
    tmp_path: Path,
    views,
    mapping,
    said,
):
    path = tmp_path / "views.yaml"
    base = BASE.replace("  target: {name: thesis}\n", "") if "target:" in views else BASE
    path.write_text(base.replace("VIEWS", views).replace("MAPPING", mapping))
    with pytest.raises(DeclarationError) as error:
        load_experiment(path)
    assert said in str(error.value)
    assert "views.yaml:" in str(error.value)


def test_a_pose_that_tilts_too_far_is_told(tmp_path: Path):
    path = tmp_path / "views.yaml"
    target = BASE.replace("{name: thesis}", "{name: thesis, tilt_y_deg: 30.0}")
    path.write_text(
        target.replace("VIEWS", "views: {kind: arc, count: 3, spread_deg: 100.0}").replace(
            "MAPPING", "mapping: {}"
        )
    )
    with pytest.raises(DeclarationError, match="tilt_y_deg would be 80"):
        load_experiment(path)


def test_views_and_mappings_are_axes_like_any_other(tmp_path: Path):
    path = tmp_path / "views.yaml"
    text = BASE.replace("VIEWS", ARC).replace("MAPPING", "mapping: {}")
    axes = {"mapping.views": "[1, 3]", "mapping.registration.method": "[icp, marks]"}
    axes |= {"source.views.spread_deg": "[20.0, 40.0]"}
    path.write_text(
        text + "sweep:\n" + "".join(f"  {name}: {values}\n" for name, values in axes.items())
    )
    experiment = load_experiment(path)
    assert len(experiment.points) == 8
    assert len({point.frames_key for point in experiment.points}) == 2
    assert experiment.points[0].variant == "views=1, registration=icp, spread=20 °"


def test_another_kind_leaves_out_what_only_the_former_has(tmp_path: Path):
    path = tmp_path / "views.yaml"
    merge = "merge: {kind: fusion, cell_mm: 1.0}"
    registration = "registration: {method: cpd, max_iterations: 9}"
    mapping = f"mapping: {{{merge}, {registration}}}"
    axes = (
        "sweep:\n  mapping.merge.kind: [fusion, grid]\n"
        "  mapping.registration.method: [cpd, marks]\n"
    )
    path.write_text(BASE.replace("VIEWS", ARC).replace("MAPPING", mapping) + axes)
    points = {point.variant: point.config.mapping for point in load_experiment(path).points}
    assert points["merge=fusion, registration=cpd"].merge.cell_mm == 1.0
    assert points["merge=fusion, registration=cpd"].registration.max_iterations == 9
    assert points["merge=grid, registration=marks"].merge.to_data() == {
        "kind": "grid",
        "step_mm": 0.1,
    }
    assert points["merge=grid, registration=marks"].registration.to_data() == {"method": "marks"}


def test_a_key_that_no_kind_has_is_still_told(tmp_path: Path):
    path = tmp_path / "views.yaml"
    mapping = "mapping: {merge: {kind: fusion, cell_mmm: 1.0}}"
    axes = "sweep:\n  mapping.merge.kind: [fusion, grid]\n"
    path.write_text(BASE.replace("VIEWS", ARC).replace("MAPPING", mapping) + axes)
    with pytest.raises(DeclarationError, match="did you mean: cell_mm"):
        load_experiment(path)
