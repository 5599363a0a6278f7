"""What stands around the board: backing, floor and back wall as rectangles.

Corners are (4, 3), counter-clockwise seen from the side that the camera sees.
"""

from __future__ import annotations

import numpy as np

from harness.vocabulary.units import MM
from scenes.target.custom import BackingConfig, RoomConfig, TargetConfig
from scenes.target.face import face_of

OPEN_FLOOR_M = 3.0
"""How far a floor without a back wall reaches: beyond it, light returns under 1 % of the board's at 0.7 m."""
_UNIT_CORNERS = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])


def backing_corners_board_m(config: TargetConfig, backing: BackingConfig) -> np.ndarray:
    """The backing in the board's frame, facing the board."""
    deepest_m = -float(face_grid_m(config, config.board.thickness_mm * MM)[..., 2].min())
    z_m = deepest_m + backing.distance_mm * MM
    size_m = np.array(backing.size_mm or (config.board.width_mm, config.board.height_mm)) * MM
    if backing.size_mm is None:
        size_m = size_m * (config.pose.distance_m + z_m) / config.pose.distance_m
    return np.column_stack([_UNIT_CORNERS * size_m, np.full(4, -z_m)])


def floor_corners_camera_m(room: RoomConfig, floor_below_lens_m: float) -> np.ndarray:
    """The floor in the camera's frame, facing up, from the lens to the back wall."""
    far_m = room.back_wall_distance_m or OPEN_FLOOR_M
    x, z = room.width_m * _UNIT_CORNERS[:, 0], far_m * (_UNIT_CORNERS[:, 1] + 0.5)
    return np.column_stack([x, np.full(4, floor_below_lens_m), z])


def wall_corners_camera_m(room: RoomConfig, back_wall_distance_m: float) -> np.ndarray:
    """The back wall in the camera's frame, facing the camera, on the floor (without one, centred on the axis)."""
    foot_m = room.height_m / 2 if room.floor_below_lens_m is None else room.floor_below_lens_m
    x, up = room.width_m * _UNIT_CORNERS[:, 0], room.height_m * (_UNIT_CORNERS[:, 1] + 0.5)
    return np.column_stack([x, foot_m - up, np.full(4, back_wall_distance_m)])


def face_grid_m(config: TargetConfig, depth_m: float) -> np.ndarray:
    """(33, 33, 3): the face in the board's frame, moved along its normals by ``depth_m`` into the board."""
    face, board = face_of(config.board), config.board
    steps = np.linspace(-0.5, 0.5, 33)
    x, y = np.meshgrid(steps * board.width_mm * MM, steps * board.height_mm * MM)
    return face.point(x, y) - depth_m * face.normal(x, y)
