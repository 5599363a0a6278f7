"""A scan of a tilted plane: its frame, its places and what is left out, in closed form."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.inspection.arguments import opened
from harness.programs.implant.scans import Implanted, Judging, Scan
from harness.trials import judge
from harness.vocabulary.geometry import MM
from scenes.closed_form import Plane
from scenes.implants import BEYOND_PX

WALL = Plane(0.8, 0.3, 0.1)
ROWS = slice(5, 55)
COLUMNS = slice(10, 70)
FOUND = (30, 20)
"""Row and column of a finding on the undamaged part."""
RADIUS_M = 0.015


def rays() -> np.ndarray:
    v, u = np.mgrid[:60, :80]
    return np.stack([(u - 39.5) / 200.0, (v - 29.5) / 210.0, np.ones(u.shape)], axis=-1)


def wall_m() -> np.ndarray:
    """Points (h, w, 3) of the wall."""
    return rays() * WALL.z_along_m(rays()[..., :2])[..., None]


@pytest.fixture
def scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scan:
    judged = np.full((60, 80), np.nan)
    judged[ROWS, COLUMNS] = 0.0
    evidence = SimpleNamespace(score=judged, surface_z_m=wall_m()[..., 2])
    thresholds = []

    def find(cloud: Any, evidence: Any, threshold: float) -> list[Any]:
        thresholds.append(threshold)
        # 8 mm behind the wall, on the same ray
        return [SimpleNamespace(centre_m=1.01 * wall_m()[FOUND])]

    detector = SimpleNamespace(analyse=lambda cloud: evidence, find=find)
    monkeypatch.setattr(judge, "detector_of", lambda *_: detector)
    noise = np.random.default_rng(1).normal(scale=0.3 * MM, size=(6, 60, 80))
    np.save(tmp_path / "part.npy", (wall_m()[..., 2] + noise).astype(np.float32))
    (tmp_path / "lens.json").write_text('{"fx": 200, "fy": 210, "cx": 39.5, "cy": 29.5}')
    judging = Judging("fake", "{}", RADIUS_M, None, lambda cloud: (6.5, ()))
    recording = opened([tmp_path / "part.npy"], str(tmp_path / "lens.json"), unit="m")
    scan = Scan(recording, judging)
    assert thresholds == [6.5]
    return scan


def test_the_frame_of_a_scan_is_that_of_its_plane(scan: Scan) -> None:
    """z towards the camera, x along the picture's rows, the origin in the middle of the judged
    area."""
    T = scan.T_camera_board
    assert T[:3, :3].T @ T[:3, :3] == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    normal = WALL.normal
    assert T[:3, 2] == pytest.approx(normal, abs=1e-9)
    along = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    assert T[:3, 0] == pytest.approx(along / np.linalg.norm(along), abs=1e-9)
    assert T[:3, 3] @ normal == pytest.approx(WALL.distance_m * normal[2])
    low = np.nanmin(scan.places_m, axis=(0, 1))
    high = np.nanmax(scan.places_m, axis=(0, 1))
    assert low == pytest.approx(-high, abs=1e-9)
    assert scan.size_m == pytest.approx(high - low)


def test_places_lie_on_the_rays_of_their_pixels(scan: Scan) -> None:
    T = scan.T_camera_board
    positions = scan.places_m
    judged = np.zeros((60, 80), bool)
    judged[ROWS, COLUMNS] = True
    assert np.array_equal(np.isfinite(positions[..., 0]), judged)
    points = positions[judged] @ T[:3, :2].T + T[:3, 3]
    assert points == pytest.approx(wall_m()[judged], abs=1e-9)
    # between the edges of the outermost pixels that have neighbours on all sides: of the others no
    # area is known; edges are straight on a plane
    u = np.array([10.5, 68.5, 68.5, 10.5])
    v = np.array([5.5, 5.5, 53.5, 53.5])
    corner_rays = np.stack([(u - 39.5) / 200.0, (v - 29.5) / 210.0, np.ones(4)], axis=-1)
    corners = corner_rays * WALL.z_along_m(corner_rays[:, :2])[:, None]
    first_diagonal = corners[2] - corners[0]
    second_diagonal = corners[3] - corners[1]
    area_m2 = np.linalg.norm(np.cross(first_diagonal, second_diagonal)) / 2
    assert scan.area_m2 == pytest.approx(area_m2, rel=1e-3)
    assert scan.pitch_m == pytest.approx(np.sqrt(scan.area_m2 / 3000))


def test_the_part_is_larger_than_what_is_judged_of_it(scan: Scan) -> None:
    """The wall fills the picture, of which 50 x 60 of 60 x 80 pixels are judged."""
    corners = np.array([(0, 0), (0, 79), (59, 0), (59, 79)])
    wall = wall_m()[tuple(corners.T)]
    positions = (wall - scan.T_camera_board[:3, 3]) @ scan.T_camera_board[:3, :2]
    widths = positions[[1, 3], 0] - positions[[0, 2], 0]
    extent = scan.part.high_m - scan.part.low_m
    assert widths.min() * 0.95 < extent[0] < widths.max()
    assert extent[0] > 1.2 * scan.size_m[0]
    assert scan.part.low_m[0] < -scan.size_m[0] / 2
    assert scan.part.T_camera_part is scan.T_camera_board


def test_angles_and_distances_from_the_rim(scan: Scan) -> None:
    directions = rays() / np.linalg.norm(rays(), axis=-1, keepdims=True)
    angle_deg = np.degrees(np.arccos(-(directions @ WALL.normal)))
    inner = scan.angle_deg[6:54, 11:69]
    assert inner == pytest.approx(angle_deg[6:54, 11:69], abs=1e-6)
    assert scan.depth_px[5:15, 40].tolist() == list(range(1, 11))
    assert scan.depth_px[30, 10:15].tolist() == [1, 2, 3, 4, 5]
    assert scan.depth_px[4, 40] == 0
    family: Any = SimpleNamespace(damage=SimpleNamespace(widest_mm=20.0))
    scan.reach_px = 1.5
    rim_px = 0.010 / scan.pitch_m + BEYOND_PX + 1.5
    assert scan.rim_px(family) == pytest.approx(rim_px)


def test_a_place_is_on_the_surface_off_the_rim_and_off_findings(scan: Scan) -> None:
    at_m = scan.places_m[20, 50]
    spot = scan.place(*at_m, 5.0)
    assert spot is not None
    point, normal = spot
    assert point == pytest.approx(wall_m()[20, 50], abs=1e-9)
    assert normal == pytest.approx(WALL.normal, abs=1e-6)
    # 16 pixels to the upper edge of the judged area, 20 to the right one
    assert scan.place(*at_m, 16.0) is not None
    assert scan.place(*at_m, 16.1) is None
    # the finding lies where its ray meets the plane
    assert scan.taken_m == pytest.approx(scan.places_m[FOUND][None], abs=1e-9)
    away = np.array([0.6, 0.8])
    near_m = scan.places_m[FOUND] + 0.99 * RADIUS_M * away
    beside_m = scan.places_m[FOUND] + 1.01 * RADIUS_M * away
    assert scan.place(*near_m, 1.0) is None
    assert scan.place(*beside_m, 1.0) is not None
    assert scan.place(10.0, 0.0, 0.0) is None
    assert scan.place(0.0, -10.0, 0.0) is None


def test_damage_is_put_into_the_frames_of_a_group(scan: Scan) -> None:
    """Frames 2 to 4 of six, each moved by its number in millimetres."""
    numbers = []

    class Mover:
        def put_into(self, frame: Any, number: int, z_m: np.ndarray, reason: np.ndarray) -> None:
            numbers.append(number)
            z_m[10, 20] += number * MM
            reason[11, 21] = 5
            z_m[11, 21] = np.nan

    placed: Any = Implanted(0, scan, None, (Mover(),))  # type: ignore[arg-type]
    cloud = placed.cloud(slice(2, 5))
    assert numbers == [2, 3, 4]
    plain = scan.averaged(scan.frames[2:5])
    moved_m = cloud.points_m[..., 2] - plain.points_m[..., 2]
    assert moved_m[10, 20] == pytest.approx(3.0 * MM, abs=1e-6)
    assert np.isnan(moved_m[11, 21])
    moved_m[10, 20] = moved_m[11, 21] = 0.0
    assert np.nanmax(np.abs(moved_m)) == 0.0
    assert cloud.n_frames == 3
    assert plain.noise_reach_px == scan.reach_px
    # the frames themselves stay as they are
    assert np.isfinite(scan.frames[3].z_m[11, 21])
