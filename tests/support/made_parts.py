"""A ribbed plate in closed form, as depth frames of a simulated camera with known truth.

The plate lies before a wall. Ribs and a boss are features of the part; dents are damage; parts may
be bent and have ribs of differing height, as made parts do."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from harness.vocabulary.geometry import MM, Cloud, Lens, rays_of, transform_points
from tests.support.plain_clouds import cloud_of_points

LENS = Lens(width=150, height=120, fx=260.0, fy=260.0, cx=74.5, cy=59.5)
HALF_M = (0.075, 0.055)
"""Half of the plate's sides."""
WALL_M = 0.62
DISTANCE_M = 0.4
NOISE_MM = 0.4
FRAMES = 12


@dataclass(frozen=True)
class Dent:
    """A round dent with a flat floor and sloping walls."""

    x_mm: float
    y_mm: float
    width_mm: float
    """Width at half of its depth."""
    depth_mm: float


@dataclass(frozen=True)
class MadePart:
    """One part of a series."""

    dents: Sequence[Dent] = ()
    has_ribs: bool = True
    bend_mm: float = 0.0
    """Height of the middle over the ends."""
    rib_mm: float = 0.0
    """By how much its ribs are higher than the drawing's."""

    def height_m(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Height over the plane towards the camera."""
        height_m = self.bend_mm * MM * (1.0 - (x_m / HALF_M[0]) ** 2)
        if self.has_ribs:
            rib_m = (8.0 + self.rib_mm) * MM
            height_m = height_m + rib_m * _step(x_m + 0.045, 0.008) * _step(y_m, 0.060)
            height_m = height_m + rib_m * _step(y_m - 0.030, 0.008) * _step(x_m - 0.020, 0.070)
            away_m = np.hypot(x_m - 0.045, y_m + 0.028)
            height_m = height_m + 6.0 * MM * _step(away_m, 0.016)
        for dent in self.dents:
            away_m = np.hypot(x_m - dent.x_mm * MM, y_m - dent.y_mm * MM)
            height_m = height_m - dent.depth_mm * MM * _step(away_m, dent.width_mm * MM)
        return np.asarray(height_m)


def _step(places_m: np.ndarray, width_m: float) -> np.ndarray:
    """1 within ``width_m`` about 0, falling to 0 over 3 mm."""
    return np.clip((0.5 * width_m - np.abs(places_m)) / (3.0 * MM) + 0.5, 0.0, 1.0)


def pose(
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    shift_mm: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """T_camera_part (4, 4) of a plate that faces the camera, turned about its own axes."""
    T = np.eye(4)
    turn = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    T[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ turn
    T[:3, 3] = shift_mm[0] * MM, shift_mm[1] * MM, DISTANCE_M
    return T


def depth_m(part: MadePart, T_camera_part: np.ndarray) -> np.ndarray:
    """The z image (h, w) without noise."""
    slopes = LENS.region_slopes(LENS.whole)
    directions = rays_of(slopes)
    T_part_camera = np.linalg.inv(T_camera_part)
    origin = T_part_camera[:3, 3]
    along = directions @ T_part_camera[:3, :3].T
    z_m = np.full(slopes.shape[:2], DISTANCE_M)
    for _ in range(30):
        points_m = transform_points(T_part_camera, directions * z_m[..., None])
        off_m = part.height_m(points_m[..., 0], points_m[..., 1]) - points_m[..., 2]
        z_m = z_m + 0.7 * off_m / along[..., 2]
    points_m = origin + along * z_m[..., None]
    on_plate = (np.abs(points_m[..., 0]) < HALF_M[0]) & (np.abs(points_m[..., 1]) < HALF_M[1])
    return np.where(on_plate, z_m, WALL_M)


def cloud_of(
    part: MadePart, T_camera_part: np.ndarray, seed: int, noise_mm: float = 0.12
) -> tuple[Cloud, np.ndarray]:
    """An average with this noise, and (h, w) bool: the plate without its rim."""
    true_m = depth_m(part, T_camera_part)
    noise_m = noise_mm * MM * np.random.default_rng(seed).standard_normal(true_m.shape)
    slopes = LENS.region_slopes(LENS.whole)
    directions = rays_of(slopes)
    cloud = cloud_of_points(directions * (true_m + noise_m)[..., None], lens=LENS)
    return cloud, ndimage.binary_erosion(true_m < WALL_M, iterations=3)


def write_capture(
    folder: Path,
    part: MadePart,
    T_camera_part: np.ndarray,
    seed: int,
    frames: int = FRAMES,
) -> Path:
    """Write frames (n, h, w) in metres as an array beside the lens."""
    folder.mkdir(parents=True)
    true_m = depth_m(part, T_camera_part)
    rng = np.random.default_rng(seed)
    noise_m = NOISE_MM * MM * rng.standard_normal((frames, *true_m.shape))
    for number, frame_m in enumerate(true_m + noise_m):
        np.save(folder / f"{number:03d}.npy", frame_m.astype(np.float32))
    lens = {
        "width": LENS.width,
        "height": LENS.height,
        "intrinsic_matrix": [LENS.fx, 0, 0, 0, LENS.fy, 0, LENS.cx, LENS.cy, 1],
    }
    (folder / "intrinsic.json").write_text(json.dumps(lens))
    return folder
