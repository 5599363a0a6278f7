"""The pose of a board before the camera."""

from __future__ import annotations

import numpy as np

from harness.vocabulary.geometry import rotation_xyz_deg
from harness.vocabulary.units import MM
from scenes.target.custom import PoseConfig


def T_camera_board_of(pose: PoseConfig) -> np.ndarray:
    """4x4: board to camera. The board is turned in its own axes (x, then y, then z), then set before the lens.

    At zero tilt board +x, +y, +z are camera +x, -y, -z. Positive ``tilt_x_deg`` brings the upper edge nearer,
    positive ``tilt_y_deg`` the -x edge, positive ``roll_deg`` lifts the +x edge.
    """
    T_camera_board = np.eye(4)
    T_camera_board[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ rotation_xyz_deg(
        pose.tilt_x_deg, pose.tilt_y_deg, pose.roll_deg
    )
    T_camera_board[:3, 3] = pose.offset_x_mm * MM, pose.offset_y_mm * MM, pose.distance_m
    return T_camera_board
