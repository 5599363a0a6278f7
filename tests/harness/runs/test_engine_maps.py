"""Maps in the engine: errors of registrations, the truth on a map, and a sweep over views end to
end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from harness.trials.board import Board, board_places_m, face_errors_m
from harness.trials.clouds import registration_error_m
from harness.vocabulary.geometry import Cloud, Region
from scenes.target.custom import TargetConfig
from scenes.target.truth import truth_of
from tests.support.declared_results import assert_declared
from tests.support.tiny_sweep import finished as finished_sweep
from tests.support.tiny_sweep import results, sweep

if TYPE_CHECKING:
    from scenes.sensor.source import SimulatedUnit

ROOT = Path(__file__).resolve().parents[3]
TARGET = TargetConfig.from_data(
    {
        "name": "custom",
        "board": {"width_mm": 300.0, "height_mm": 200.0, "thickness_mm": 12.0},
        "holes": [{"id": 7, "diameter_mm": 21.0, "centre_mm": [50.0, 0.0]}],
        "pose": {"distance_m": 0.7, "tilt_x_deg": 5.0, "tilt_y_deg": -8.0},
    }
)
T_CAMERA_BOARD = TARGET.pose.T_camera_board


def map_of(
    height_m: float, *, step_m: float = 2e-3, missing: bool = False
) -> tuple[Cloud, np.ndarray]:
    """A parallel map, its frame turned like the board, of a plane so far before the true face; and
    its frame."""
    T_board_map = np.diag([1.0, -1.0, -1.0, 1.0])
    T_board_map[:3, 3] = 0.0, 0.0, 0.7
    x, y = np.meshgrid(np.arange(-70, 71) * step_m, np.arange(-45, 46) * step_m)
    points = np.stack([x, y, np.full(x.shape, 0.7 - height_m)], axis=-1)
    if missing:
        points[np.hypot(x - 0.05, y) < 8e-3] = np.nan
    none = np.full(x.shape, np.nan)
    zeros = np.zeros(x.shape, np.uint8)
    region = Region(0, x.shape[0], 0, x.shape[1])
    cloud = Cloud(points, zeros, zeros.astype(int), none, region, 0.0, 1, projection="parallel")
    return cloud, T_CAMERA_BOARD @ T_board_map


def first_view(damaged: bool = True) -> Board:
    unit = cast("SimulatedUnit", None)
    set_up = Board(unit, damaged, truth_of(TARGET, T_CAMERA_BOARD), TARGET, T_CAMERA_BOARD)
    pixels = {7: np.array([0])}
    vars(set_up).update({"pitch_mm": (1.4, 1.4), "outlines": pixels, "seen_depth_m": {7: 0.0}})
    return set_up


def test_a_registration_error_is_split_into_the_plane_and_across_it():
    normal = np.array([0.0, 0.0, 1.0])
    points = np.array([[x, y, 0.7] for x in (-0.3, 0.3) for y in (-0.1, 0.1)])
    true = np.eye(4)
    true[:3, :3] = Rotation.from_euler("y", 20, degrees=True).as_matrix()
    shifted = true.copy()
    shifted[:3, 3] += 3e-3, 4e-3, 1e-3
    assert registration_error_m(shifted, true, points, normal) == pytest.approx((5e-3, 1e-3))
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec([0.0, 1e-3, 0.0]).as_matrix()
    turned[:3, 3] = np.array([0, 0, 0.7]) - turned[:3, :3] @ [0, 0, 0.7]
    in_plane, across = registration_error_m(turned @ true, true, points, normal)
    assert across == pytest.approx(0.3e-3, rel=1e-3)
    assert in_plane < 1e-6


def test_the_truth_lies_on_a_map_where_its_cells_are():
    cloud, T_reference_cloud = map_of(0.0, missing=True)
    reference = first_view().labelled_map(cloud, T_reference_cloud)
    positions = board_places_m(cloud, reference.T_board_cloud)
    inside = positions.reshape(-1, 2)[reference.outlines[7]]
    # cells without a value count as seeing into the hole as well
    assert not cloud.valid.ravel()[reference.outlines[7]].all()
    steps = range(-6, 7)
    assert len(inside) == sum((2 * i) ** 2 + (2 * j) ** 2 < 10.5**2 for i in steps for j in steps)
    assert np.linalg.norm(inside - [0.05, 0.0], axis=-1).max() < 0.0105
    margin_m = 8 * 1.4e-3
    assert (
        np.linalg.norm(positions[reference.undamaged] - [0.05, 0.0], axis=-1).min()
        > 0.0105 + margin_m
    )
    assert np.abs(positions[reference.undamaged]).max(axis=0) == pytest.approx(
        [0.14, 0.0888], abs=2.1e-3
    )
    assert reference.centre_in_cloud_m(reference.truth[0]) == pytest.approx(
        [0.05, 0.0, 0.7], abs=1e-12
    )


def test_a_finding_at_depth_is_placed_along_the_maps_axis():
    cloud, T_reference_cloud = map_of(0.0)
    reference = first_view().labelled_map(cloud, T_reference_cloud)
    assert reference.on_board(np.array([[0.05, 0.01, 0.73]]))[0] == pytest.approx(
        [0.05, -0.01], abs=1e-12
    )


@pytest.mark.parametrize("height_m", [0.0, 1e-3, -2e-3])
def test_errors_of_a_map_are_told_behind_the_face(height_m):
    cloud, T_reference_cloud = map_of(height_m)
    reference = first_view(damaged=False).labelled_map(cloud, T_reference_cloud)
    errors = face_errors_m(reference, np.array([[0.0, 0.0], [0.1, 0.05], [-0.1, 0.0301]]))
    assert errors == pytest.approx(np.full(3, -height_m), abs=1e-9)


def test_a_place_that_a_map_does_not_reach_has_no_error():
    cloud, T_reference_cloud = map_of(0.0)
    reference = first_view(damaged=False).labelled_map(cloud, T_reference_cloud)
    nearby = np.random.default_rng(1).uniform(-0.08, 0.08, (20, 2))
    errors = face_errors_m(reference, np.vstack([nearby, [[0.3, 0.2]]]))
    assert np.isfinite(errors[:-1]).all()
    assert np.isnan(errors[-1])


TINY = """\
name: tiny
seed: 3
source:
  kind: simulated
  target: {name: thesis}
  camera: {name: azure_kinect_nfov}
  render: {bounces: 0}
  views: {kind: arc, count: 3, spread_deg: 40.0}
capture: {frames: 2}
mapping: {marks: {kind: red}}
detector:
  name: thesis
  settings:
    crop: {kind: box, x_mm: [-294, 294], y_mm: [-51, 51], z_mm: [0, 1100], range_max_m: null, inset_px: 3}
threshold: {calibrate: {repeats: 1}}
repeats: 1
sweep:
  mapping.views: [1, 3]
  mapping.registration.method: [cpd, marks]
  mapping.merge.kind: [fusion]
sensitivity:
  repeats: 1
  frames: [2]
  vary:
    - label: odometry
      set: {mapping: {registration: {method: odometry}, merge: {kind: volume}}}
      frames: [1]
      reason: every way of registering and of merging runs
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return results(finished_sweep(tmp_path_factory.mktemp("maps"), TINY, "--serial"))


def test_a_sweep_over_views_leaves_its_tables_report_and_view_in_space(finished):
    names = {path.name for path in finished.iterdir()}
    assert {"registrations.parquet", "report.html"} <= names
    assert {"registrations.csv", "registration_errors.csv", "set_ups.csv", "claims.csv"} <= names
    assert_declared(finished)
    registrations = pd.read_parquet(finished / "registrations.parquet")
    main = registrations[registrations["method"] != "odometry"]
    # methods, roles, repeats, views but the first
    assert len(main) == 2 * 2 * 1 * 2
    assert set(main["view"]) == {1, 2}
    marks = main[main["method"] == "marks"]
    assert (marks["failure"] == "").all()
    assert (marks["marks"] == 4).all()
    # 15 standard errors of a nominal pose that is 10 mm off: registering must have moved the views
    assert marks["tre_mm"].max() < 2.0 < 8.0 < marks["guess_tre_mm"].min()
    runs = pd.read_parquet(finished / "runs.parquet")
    assert set(runs["views_used"]) <= {1, 2, 3}
    one = runs[(runs["mapping.views"] == 1) & (runs["role"] == "damaged")]
    numbers = one.groupby(["mapping.merge.kind", "repeat"])["surface_noise_mm"].nunique()
    assert (numbers == 1).all(), "with one view the way of registering changes nothing"


@pytest.mark.slow
def test_two_worker_processes_give_the_same_numbers(finished, tmp_path):
    import shutil

    shutil.copy(finished.parents[2] / "tiny.yaml", tmp_path / "tiny.yaml")
    shutil.copytree(finished.parents[1] / ".cache", tmp_path / "out" / ".cache")
    done = sweep(tmp_path / "tiny.yaml", tmp_path / "out", "--jobs", "2")
    assert done.returncode == 0, done.stderr
    (again,) = (tmp_path / "out" / "tiny").glob("[0-9a-f]*")
    for name in ("trials", "registrations", "probes"):
        tables = [
            pd.read_parquet(folder / f"{name}.parquet").drop(columns="seconds", errors="ignore")
            for folder in (finished, again)
        ]
        pd.testing.assert_frame_equal(*tables)
    assert json.loads((again / "provenance.json").read_text())["renders"] == {
        "done": 0,
        "cached": 6,
        "failed": 0,
    }
