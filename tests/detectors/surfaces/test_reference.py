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
from detectors.surfaces.reference import front_of, laid_on
from detectors.surfaces.surface import ReferenceConfig
from harness.detect import main
from harness.inspection.arguments import detector_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Lens, Reason, Region, transform_points

LENS = Lens(320, 288, 252.0, 252.0, 160.0, 144.0, ())
SIZE_MM = (180.0, 120.0, 12.0)


def casting(path: Path) -> Path:
    """Write a plate with ribs and steps, which no smooth surface follows, in millimetres."""
    parts = [trimesh.creation.box(SIZE_MM)]
    for x, y, w, h, up in ((-50, 10, 12, 90, 14), (20, -30, 90, 10, 9), (60, 35, 30, 30, 6)):
        parts.append(
            trimesh.creation.box(
                (w, h, up), trimesh.transformations.translation_matrix((x, y, 6 + up / 2))
            )
        )
    trimesh.boolean.union(parts).export(path)
    return path


def seen(path: Path, T_camera_part: np.ndarray, noise_mm: float, dent_mm: float = 0.0) -> Cloud:
    """A cloud of the casting, with a round dent in its plain face at (0, 15) mm, 16 mm wide."""
    import open3d as o3d

    corners, _ = front_of(ReferenceConfig(file=str(path)))
    scene = o3d.t.geometry.RaycastingScene()
    moved = transform_points(T_camera_part, corners.reshape(-1, 3)).astype(np.float32)
    scene.add_triangles(moved, np.arange(len(moved), dtype=np.uint32).reshape(-1, 3))
    slopes = LENS.region_slopes(Region(0, 288, 0, 320))
    rays = np.concatenate([slopes, np.ones((288, 320, 1))], axis=-1)
    z_m = scene.cast_rays(np.concatenate([np.zeros(rays.shape), rays], axis=-1).astype(np.float32))[
        "t_hit"
    ].numpy()
    z_m = np.where(np.isfinite(z_m), z_m, np.nan).astype(float)
    points_part = transform_points(np.linalg.inv(T_camera_part), rays * z_m[..., None])
    z_m += dent_mm * MM * (np.hypot(points_part[..., 0], points_part[..., 1] - 15 * MM) < 8 * MM)
    z_m += np.random.default_rng(1).normal(0, noise_mm * MM, z_m.shape)
    reason = np.where(np.isfinite(z_m), 0, Reason.LOW_AMPLITUDE).astype(np.uint8)
    return replace(blank(), points_m=rays * z_m[..., None], reason=reason)


def blank() -> Cloud:
    shape = (288, 320)
    return Cloud(
        points_m=np.full((*shape, 3), np.nan), reason=np.zeros(shape, np.uint8), count=np.full(shape, 10),
        variance_m2=np.full(shape, np.nan), n_frames=10, region=Region(0, 288, 0, 320), lens=LENS, z_step_m=0.0,
    )  # fmt: skip


def stood(turn_deg: tuple[float, float, float], quarter: int = 0) -> np.ndarray:
    T = np.eye(4)
    roll = Rotation.from_euler("z", 90 * quarter, degrees=True)
    T[:3, :3] = (
        np.diag([1.0, -1.0, -1.0])
        @ (Rotation.from_euler("xyz", turn_deg, degrees=True) * roll).as_matrix()
    )
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
    tmp_path: Path, turn_deg: tuple[float, float, float], quarter: int
) -> None:
    path = casting(tmp_path / "casting.stl")
    T = stood(turn_deg, quarter)
    cloud = seen(path, T, 0.5, dent_mm=3.0)
    true = seen(path, T, 0.0)
    points = cloud.points_m[cloud.valid]
    note, surface = laid_on(points, ReferenceConfig(file=str(path)), central=True)
    off_m = surface(points) - true.points_m[cloud.valid][:, 2]
    assert np.isnan(off_m).mean() < 0.25  # along outline, steps and edges
    assert np.nanmedian(np.abs(off_m)) < 0.05 * MM  # a tenth of the noise of a pixel
    assert np.nanquantile(np.abs(off_m), 0.95) < 0.1 * MM
    assert "casting.stl" in note
    _, level = laid_on(points, ReferenceConfig(file=str(path)), central=False)  # of a map, along z
    assert np.nanmedian(np.abs(level(points) - points[:, 2])) == pytest.approx(
        0.6745 * 0.5 * MM, rel=0.15
    )


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

    def damage_mm(surface: dict[str, object]) -> list[np.ndarray]:
        measuring = load_detector(detector, {"crop": {"kind": "none"}, "surface": surface})
        findings = measuring.find(cloud, measuring.analyse(cloud), 6.0)
        return [transform_points(np.linalg.inv(T), finding.centre_m) / MM for finding in findings]

    (centre,) = damage_mm({"shape": "mesh", "reference": {"file": str(path)}})
    assert np.linalg.norm(centre[:2] - (0, 15)) < 3.0
    assert (
        len(damage_mm({"shape": "auto"})) > 1
    )  # ribs pass for damage where nothing is known of the part


def test_mistakes_are_told(tmp_path: Path) -> None:
    path = casting(tmp_path / "casting.stl")
    with pytest.raises(UserError, match="need each other"):
        load_detector("local", {"surface": {"shape": "mesh"}})
    sheet = trimesh.Trimesh([(0, 0, 0), (10, 0, 0), (0, 10, 0)], [(0, 2, 1)])
    sheet.export(tmp_path / "away.stl")
    with pytest.raises(UserError, match="none of its triangles faces"):
        front_of(ReferenceConfig(file=str(tmp_path / "away.stl")))
    with pytest.raises(UserError, match="cannot be read"):
        front_of(ReferenceConfig(file=str(tmp_path / "none.stl")))
    arguments = ["capture", "--reference", str(path), "--set", "surface.reference.unit=cm"]
    _, settings = detector_of(
        main.parser().parse_args(arguments), "none", ["surface.reference.unit=cm"]
    )
    assert settings["surface"]["reference"] == {"file": str(path), "unit": "cm", "front": "+z"}
    with pytest.raises(UserError, match="has no surface setting"):
        detector_of(main.parser().parse_args([*arguments, "--detector", "plane_ransac"]), "none", [])
