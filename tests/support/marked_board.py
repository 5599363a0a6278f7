"""A board with strips of tape and one blind hole before a pinhole camera, as Open3D's recorder
would store it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from harness.vocabulary.geometry import Lens, invert, rays_of, rotation_xyz_deg, transform_points

LENS = Lens(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
DISTANCE_M = 0.5
HALF_WIDTH_M = 0.2
HALF_HEIGHT_M = 0.1
HOLE_M = np.array([0.03, 0.01])
HOLE_RADIUS_M = 0.01
HOLE_DEPTH_M = 0.008
STRIPS_M = ((-0.15, 0.06), (0.14, 0.065), (0.12, -0.06), (-0.10, -0.055), (0.01, 0.075))
"""Centres; no turn of the board brings these strips to each other's places."""
STRIP_HALF_M = (0.02, 0.006)
FINE = 4
"""Rays a pixel and side, whose colours are averaged."""


def T_camera_board(turn_y_deg: float, turn_x_deg: float = 0.0) -> np.ndarray:
    """The board, turned in its own axes, at half a metre (board: x right, y up, z to the camera)."""
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ rotation_xyz_deg(turn_x_deg, turn_y_deg, 0.0)
    pose[2, 3] = DISTANCE_M
    return pose


def write_view(
    folder: Path,
    pose: np.ndarray,
    *,
    seed: int,
    frames: int = 3,
    strips: tuple[tuple[float, float], ...] = STRIPS_M,
    hidden: tuple[int, ...] = (),
    noise_mm: float = 0.3,
) -> Path:
    """Depth (whole millimetres) and colour pictures and the lens. ``hidden``: strips that a hand
    covers."""
    for name in ("depth", "color"):
        (folder / name).mkdir(parents=True)
    z_m, on_board = _depth_m(pose)
    colour = _colour(pose, tuple(strip for i, strip in enumerate(strips) if i not in hidden))
    rng = np.random.default_rng(seed)
    for frame in range(frames):
        noisy = 1e3 * z_m + noise_mm * rng.standard_normal(z_m.shape)
        stored = np.where(on_board, np.rint(noisy), 0).astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{frame:05d}.png"), stored)
        cv2.imwrite(str(folder / "color" / f"{frame:05d}.png"), colour[..., ::-1])
    matrix = LENS.matrix.T.ravel().tolist()
    text = json.dumps({"width": LENS.width, "height": LENS.height, "intrinsic_matrix": matrix})
    (folder / "intrinsic.json").write_text(text)
    return folder


def _depth_m(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) z of the face or of the hole's floor, and whether the ray meets the board; the hole's
    wall is left out."""
    slopes = LENS.region_slopes(LENS.whole)
    face = _meet(pose, slopes, 0.0)
    floor = _meet(pose, slopes, -HOLE_DEPTH_M)
    in_hole = np.linalg.norm(face[1] - HOLE_M, axis=-1) < HOLE_RADIUS_M
    return np.where(in_hole, floor[0], face[0]), _on_board(face[1])


def _colour(pose: np.ndarray, strips: tuple[tuple[float, float], ...]) -> np.ndarray:
    """(h, w, 3) uint8: grey board with red strips, each pixel the mean of its rays, black beyond
    the rim."""
    part = (np.arange(FINE) + 0.5) / FINE - 0.5
    v, u = np.mgrid[: LENS.height, : LENS.width][..., None]
    dv = np.repeat(part, len(part))
    du = np.tile(part, len(part))
    _, xy = _meet(pose, LENS.slopes(u + du, v + dv), 0.0)
    colour = np.where(_on_board(xy)[..., None], [150.0, 148.0, 140.0], 0.0)
    for x, y in strips:
        on_strip = (np.abs(xy[..., 0] - x) < STRIP_HALF_M[0]) & (
            np.abs(xy[..., 1] - y) < STRIP_HALF_M[1]
        )
        colour[on_strip] = [200.0, 30.0, 40.0]
    return np.rint(colour.mean(axis=2)).astype(np.uint8)


def _meet(pose: np.ndarray, slopes: np.ndarray, height_m: float) -> tuple[np.ndarray, np.ndarray]:
    """z (...) where rays meet the plane ``height_m`` above the face, and the place (..., 2) on the
    board."""
    normal = pose[:3, 2]
    middle_m = pose[:3, 3]
    rays = rays_of(slopes)
    z_m = (middle_m @ normal + height_m) / (rays @ normal)
    on_board_m = transform_points(invert(pose), rays * z_m[..., None])
    return z_m, on_board_m[..., :2]


def _on_board(xy: np.ndarray) -> np.ndarray:
    on_board: np.ndarray = (np.abs(xy[..., 0]) < HALF_WIDTH_M) & (
        np.abs(xy[..., 1]) < HALF_HEIGHT_M
    )
    return on_board
