"""Poses of several views, the guesses of where they stand, and what an experiment may say about
them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from harness.experiment.load import load_experiment
from harness.vocabulary.declaration.yaml_source import DeclarationError
from harness.vocabulary.geometry import invert, transform_points
from scenes.perspectives import (
    ArcViews,
    GridViews,
    HandHeldViews,
    ListedViews,
    T_reference_view_of,
    guessed_T_reference_view,
    poses_of,
)
from scenes.target.custom import PoseConfig

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
