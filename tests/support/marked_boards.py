"""Boards with marks before a pinhole camera, in closed form: every pixel's ray meets a plane."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from detectors.views.marks.mark import MarkSet
from detectors.views.view import PreparedView, View
from harness.vocabulary.geometry import (
    Cloud,
    Lens,
    Region,
    invert,
    rays_of,
    rotation_xyz_deg,
    transform_points,
)
from tests.support.plain_clouds import cloud_of_points

LENS = Lens(width=400, height=140, fx=500.0, fy=500.0, cx=199.5, cy=69.5)
TAPES = np.array([[-0.2, 0.038], [0.2, 0.038], [0.2, -0.038], [-0.2, -0.038]])
"""The thesis board's strips, 40 x 12 mm."""
WOOD = (140, 107, 71)
RED = (217, 20, 20)
DEPTH_SIGMA_M = 0.5e-3

Paint = Callable[[np.ndarray], np.ndarray]
"""From places on the board (..., 2) in metres to colours (..., 3), 0..255."""


def board_pose(
    tilt_x_deg: float = 3.0, tilt_y_deg: float = 4.0, roll_deg: float = 0.0, distance_m: float = 0.7
) -> np.ndarray:
    """``T_camera_board``: the board's z faces the camera, its y is up."""
    T = np.eye(4)
    T[:3, :3] = rotation_xyz_deg(tilt_x_deg, tilt_y_deg, roll_deg) @ np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = 0.0, 0.0, distance_m
    return T


def strips(
    places: np.ndarray = TAPES,
    colour: tuple[int, int, int] = RED,
    wood: tuple[int, int, int] = WOOD,
    half_size: tuple[float, float] = (0.02, 0.006),
    turn_deg: float = 0.0,
) -> Paint:
    """Strips of one colour on wood."""
    turn = rotation_xyz_deg(0.0, 0.0, turn_deg)[:2, :2]

    def paint(xy: np.ndarray) -> np.ndarray:
        colours = np.broadcast_to(np.array(wood, float), (*xy.shape[:-1], 3)).copy()
        for position in places:
            local = np.abs((xy - position) @ turn)
            colours[(local[..., 0] < half_size[0]) & (local[..., 1] < half_size[1])] = colour
        return colours

    return paint


def marked_cloud(
    T_camera_board: np.ndarray,
    paint: Paint,
    *,
    rng: np.random.Generator | None = None,
    samples: int = 1,
    light: Callable[[np.ndarray], np.ndarray] | None = None,
    behind_m: Callable[[np.ndarray], np.ndarray] | None = None,
    lens: Lens = LENS,
    sigma_m: float = DEPTH_SIGMA_M,
) -> Cloud:
    """A cloud of an endless board: colour of each pixel's centre, or the mean over ``samples``
    squared points of it, times ``light`` at (u, v) scaled to -1..1; depth with noise through a 5 x
    5 window; ``behind_m`` the surface."""
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(float)
    colours = np.mean(
        [
            paint(_board_places(T_camera_board, lens.slopes(u + du, v + dv))[..., :2])
            for du in steps
            for dv in steps
        ],
        axis=0,
    )
    if light is not None:
        scaled = np.stack([2 * u / lens.width - 1, 2 * v / lens.height - 1], axis=-1)
        colours = colours * light(scaled)
    slopes = lens.slopes(u, v)
    positions = _board_places(T_camera_board, slopes)
    z = transform_points(T_camera_board, positions)[..., 2]
    if behind_m is not None:
        z = z + behind_m(positions[..., :2])
    if rng is not None:
        # the mean of 5 x 5 independent values has a fifth of their deviation
        z = z + cv2.blur(rng.standard_normal(z.shape), (5, 5)) * 5.0 * sigma_m
    points = rays_of(slopes) * z[..., None]
    rgb = np.clip(np.rint(colours), 0, 255).astype(np.uint8)
    return cloud_of_points(points, lens=lens, rgb=rgb)


def prepared(name: str, marks: MarkSet, T_reference_view_guess: np.ndarray | None) -> PreparedView:
    """A view of which only the marks are looked at."""
    nothing = np.zeros((1, 1))
    cloud = Cloud(np.full((1, 1, 3), np.nan), nothing, nothing, nothing, Region(0, 1, 0, 1), 0.0, 1)
    return PreparedView(View(name, cloud, T_reference_view_guess), np.zeros((1, 1), bool), marks)


def _board_places(T_camera_board: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """(..., 3) where rays (..., 2) meet the board, in its frame."""
    rays = rays_of(slopes)
    normal = T_camera_board[:3, 2]
    origin = T_camera_board[:3, 3]
    points = rays * ((origin @ normal) / (rays @ normal))[..., None]
    positions: np.ndarray = transform_points(invert(T_camera_board), points)
    return positions
