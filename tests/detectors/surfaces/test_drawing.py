"""A part's own mesh as the undamaged surface: it is found where it lies, and what differs from it
is damage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from detectors import load_detector
from detectors.surfaces import drawing as drawing_module
from detectors.surfaces.drawing import DrawingFile, drawing_of, drawing_under, read_drawing
from detectors.surfaces.expected import closest_of, fitted
from harness.detect import main
from harness.inspection.arguments import detector_of, drawing_file_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Lens, Reason, Region, transform_points

LENS = Lens(width=320, height=288, fx=252.0, fy=252.0, cx=160.0, cy=144.0, distortion=())
SIZE_MM = (180.0, 120.0, 12.0)


def casting(path: Path) -> Path:
    """Write a plate with ribs and steps, which no smooth surface follows, in millimetres."""
    parts = [trimesh.creation.box(SIZE_MM)]
    for x, y, width, height, up in (
        (-50, 10, 12, 90, 14),
        (20, -30, 90, 10, 9),
        (60, 35, 30, 30, 6),
    ):
        shift = trimesh.transformations.translation_matrix((x, y, 6 + up / 2))
        parts.append(trimesh.creation.box((width, height, up), shift))
    trimesh.boolean.union(parts).export(path)
    return path


def seen(path: Path, T_camera_part: np.ndarray, noise_mm: float, dent_mm: float = 0.0) -> Cloud:
    """A cloud of the casting, with a round dent in its plain face at (0, 15) mm, 16 mm wide."""
    import open3d as o3d

    corners = read_drawing(DrawingFile(file=str(path))).triangles.corners_m
    scene = o3d.t.geometry.RaycastingScene()
    moved = transform_points(T_camera_part, corners.reshape(-1, 3)).astype(np.float32)
    faces = np.arange(len(moved), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(moved, faces)
    slopes = LENS.region_slopes(Region(0, 288, 0, 320))
    directions = np.concatenate([slopes, np.ones((288, 320, 1))], axis=-1)
    rays = np.concatenate([np.zeros(directions.shape), directions], axis=-1)
    hits = scene.cast_rays(rays.astype(np.float32))
    z_m = hits["t_hit"].numpy()
    z_m = np.where(np.isfinite(z_m), z_m, np.nan).astype(float)
    points_part = transform_points(np.linalg.inv(T_camera_part), directions * z_m[..., None])
    from_dent = np.hypot(points_part[..., 0], points_part[..., 1] - 15 * MM)
    z_m += dent_mm * MM * (from_dent < 8 * MM)
    z_m += np.random.default_rng(1).normal(0, noise_mm * MM, z_m.shape)
    shape = (288, 320)
    return Cloud(
        points_m=directions * z_m[..., None],
        reason=np.where(np.isfinite(z_m), 0, Reason.LOW_AMPLITUDE).astype(np.uint8),
        count=np.full(shape, 10),
        variance_m2=np.full(shape, np.nan),
        n_frames=10,
        region=Region(0, 288, 0, 320),
        lens=LENS,
        z_step_m=0.0,
    )


def stood(turn_deg: tuple[float, float, float], quarter: int = 0) -> np.ndarray:
    """T_camera_part of a part before the camera, rolled by quarters of a turn, then turned."""
    T = np.eye(4)
    roll = Rotation.from_euler("z", 90 * quarter, degrees=True)
    turn = Rotation.from_euler("xyz", turn_deg, degrees=True)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ (turn * roll).as_matrix()
    T[:3, 3] = 0.012, -0.02, 0.4
    return T


@pytest.mark.parametrize(
    ("turn_deg", "quarter"),
    [
        ((-5, 3, 6), 1),
        pytest.param((12, 10, -8), 0, marks=pytest.mark.slow),
        pytest.param((4, -6, 3), 0, marks=pytest.mark.slow),
        pytest.param((5, 8, 2), 2, marks=pytest.mark.slow),
    ],
)
def test_a_part_is_found_where_it_lies(
    tmp_path: Path,
    turn_deg: tuple[float, float, float],
    quarter: int,
) -> None:
    path = casting(tmp_path / "casting.stl")
    drawing = read_drawing(DrawingFile(file=str(path)))
    T = stood(turn_deg, quarter)
    cloud = seen(path, T, 0.5, dent_mm=3.0)
    true = seen(path, T, 0.0)
    points = cloud.points_m[cloud.valid]
    surface = drawing_under(drawing, points, central=True)
    off_m = np.abs(surface.z_at(points) - true.points_m[cloud.valid][:, 2])
    assert np.isnan(off_m).mean() < 0.25  # along outline, steps and edges
    assert np.nanmedian(off_m) < 0.05 * MM  # a tenth of the noise of a pixel
    assert np.nanquantile(off_m, 0.95) < 0.1 * MM
    assert "casting.stl" in surface.text
    level = drawing_under(drawing, points, central=False)  # of a map, along z
    noise_m = np.nanmedian(np.abs(level.z_at(points) - points[:, 2])) / 0.6745
    assert noise_m == pytest.approx(0.5 * MM, rel=0.15)


def test_all_points_go_on_from_the_pose_that_some_find(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a start that is 84 degrees off, 550 points find the part, and 4,400 do not."""
    start = drawing_module._start
    monkeypatch.setattr(
        drawing_module, "_start", lambda front, points, _: start(front, points, turn=2)
    )
    path = casting(tmp_path / "casting.stl")
    drawing = read_drawing(DrawingFile(file=str(path)))
    T = stood((-5, 3, 6), quarter=1)
    cloud = seen(path, T, 0.5)
    points_m = cloud.points_m[cloud.valid]
    surface = drawing_under(drawing, points_m, central=True)
    points_part = transform_points(np.linalg.inv(T), points_m)
    placed_m = transform_points(np.array(surface.facts["T_reference_camera"]), points_m)
    # less than a pixel, 1.6 mm
    assert np.linalg.norm(placed_m - points_part, axis=1).max() < 1.0 * MM


@pytest.mark.parametrize(
    "detector",
    [
        "local",
        pytest.param("thesis", marks=pytest.mark.slow),
        pytest.param("m3c2", marks=pytest.mark.slow),
    ],
)
def test_only_damage_differs_from_the_mesh(tmp_path: Path, detector: str) -> None:
    path = casting(tmp_path / "casting.stl")
    T = stood((6, -8, 3))
    cloud = seen(path, T, 0.5, dent_mm=3.0)
    drawing = read_drawing(DrawingFile(file=str(path)))
    points_m = cloud.points_m[cloud.valid]
    cloud = replace(cloud, expected=drawing_under(drawing, points_m, central=True))

    def damage_mm(surface: dict[str, object]) -> list[np.ndarray]:
        measuring = load_detector(detector, {"crop": {"kind": "none"}, "surface": surface})
        findings = measuring.find(cloud, measuring.analyse(cloud), 6.0)
        T_part_camera = np.linalg.inv(T)
        return [transform_points(T_part_camera, finding.centre_m) / MM for finding in findings]

    (centre,) = damage_mm({"shape": "expected"})
    assert np.linalg.norm(centre[:2] - (0, 15)) < 3.0
    # ribs pass for damage where nothing is known of the part
    assert len(damage_mm({"shape": "auto"})) > 1


@pytest.mark.parametrize(
    ("beside", "nearest_mm"), [(0.2, 0.5), (0.3, (0.7 * 0.5 + 0.1 * 60) / 0.8)]
)
def test_starts_are_judged_on_the_nearest_points(beside: float, nearest_mm: float) -> None:
    """Of points 0.5 mm above and below a square, a share lies 60 mm beside it."""
    square_mm = np.array([(-50, -50, 0), (50, -50, 0), (50, 50, 0), (-50, 50, 0)], float)
    triangles = drawing_of("square", MM * square_mm[[[0, 1, 2], [0, 2, 3]]]).triangles
    column, row = np.meshgrid(np.arange(20), np.arange(20))
    up_mm = np.where((column + row) % 2, 0.5, -0.5)
    points_mm = np.stack([5 * column - 47.5, 5 * row - 47.5, up_mm], axis=-1).reshape(-1, 3)
    count = round(beside * 400)
    points_mm[:count, 0] = np.where(np.arange(count) % 2, 110.0, -110.0)
    points_mm[:count, 2] = 0.0
    pose = fitted(triangles, MM * points_mm, np.eye(4))
    worse = replace(pose, nearest_m=1.01 * pose.nearest_m, off_m=0.0, apart_m=0.0)
    assert pose.nearest_m == pytest.approx(nearest_mm * MM, rel=0.01)
    assert closest_of([worse, pose]) is pose


def test_mistakes_are_told(tmp_path: Path) -> None:
    sheet = trimesh.Trimesh([(0, 0, 0), (10, 0, 0), (0, 10, 0)], [(0, 2, 1)])
    away = tmp_path / "away.stl"
    sheet.export(away)
    with pytest.raises(UserError, match="none of its triangles faces"):
        read_drawing(DrawingFile(file=str(away)))
    with pytest.raises(UserError, match="cannot be read"):
        read_drawing(DrawingFile(file=str(tmp_path / "none.stl")))


def test_a_wrong_unit_and_a_wrong_part_are_told(tmp_path: Path) -> None:
    path = casting(tmp_path / "casting.stl")
    cloud = seen(path, stood((6, -8, 3)), 0.5)
    points = cloud.points_m[cloud.valid]
    metres = tmp_path / "metres.stl"
    trimesh.load(path).apply_scale(1e-3).export(metres)
    with pytest.raises(
        UserError, match=r"is 0\.\d+ mm large in mm, and the target 2\d\d mm"
    ) as raised:
        drawing_under(read_drawing(DrawingFile(file=str(metres))), points, central=True)
    assert raised.value.fix == "state its unit, if it is m: reference.unit=m"
    with pytest.raises(UserError, match="mm large in m, and the target"):
        drawing_under(read_drawing(DrawingFile(file=str(path), unit="m")), points, central=True)
    ball = tmp_path / "ball.stl"
    trimesh.creation.icosphere(3, 110.0).export(ball)
    with pytest.raises(UserError, match="is not this part: "):
        drawing_under(read_drawing(DrawingFile(file=str(ball))), points, central=True)


def test_a_reference_is_stated_on_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = casting(tmp_path / "casting.stl")
    unit = "reference.unit=cm"
    options = main.parser().parse_args(["capture", "--reference", str(path), "--set", unit])
    assert drawing_file_of(options) == DrawingFile(file=str(path), unit="cm")
    _, settings = detector_of(options, "none", [])
    assert settings["surface"]["shape"] == "expected"
    options.detector = "plane_ransac"
    with pytest.raises(UserError, match="has no surface setting"):
        detector_of(options, "none", [])
    assert main(["capture", "--set", unit]) == 2
    assert "name it with --reference part.stl" in capsys.readouterr().err
