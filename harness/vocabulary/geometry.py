"""Rigid transforms and pixel regions.

Frames. ``camera``: x right, y down, z along the optical axis, origin at the depth lens (OpenCV's convention), metres.
``board``: x along the row of holes, y up the face, z out of the face to the camera, origin at the centre, metres.
``T_a_b`` maps co-ordinates in b to co-ordinates in a.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


def transform_points(T_a_b: np.ndarray, points_b: np.ndarray) -> np.ndarray:
    """Map points (..., 3) from frame b to frame a by the 4x4 matrix ``T_a_b``."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def rotate_vectors(T_a_b: np.ndarray, vectors_b: np.ndarray) -> np.ndarray:
    """Map directions (..., 3) from frame b to frame a (rotation only)."""
    return vectors_b @ T_a_b[:3, :3].T


def invert(T_a_b: np.ndarray) -> np.ndarray:
    """The inverse of a rigid 4x4 transform: ``T_b_a``."""
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = T_a_b[:3, :3].T
    T_b_a[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return T_b_a


def rotation_xyz_deg(about_x: float, about_y: float, about_z: float) -> np.ndarray:
    """3x3 rotation Rz @ Ry @ Rx by angles in degrees (about x first)."""
    ax, ay, az = np.deg2rad([about_x, about_y, about_z])
    rx = np.array([[1, 0, 0], [0, np.cos(ax), -np.sin(ax)], [0, np.sin(ax), np.cos(ax)]])
    ry = np.array([[np.cos(ay), 0, np.sin(ay)], [0, 1, 0], [-np.sin(ay), 0, np.cos(ay)]])
    rz = np.array([[np.cos(az), -np.sin(az), 0], [np.sin(az), np.cos(az), 0], [0, 0, 1]])
    return rz @ ry @ rx


@dataclass(frozen=True)
class Region:
    """A rectangle of sensor pixels: rows ``row0 <= v < row1``, columns ``col0 <= u < col1``."""

    row0: int
    row1: int
    col0: int
    col1: int

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.row1 - self.row0, self.col1 - self.col0

    def grown(self, margin: int, height: int, width: int) -> Region:
        """This region with ``margin`` more pixels on each side, clipped to a sensor of ``height`` x ``width``."""
        return Region(
            max(self.row0 - margin, 0),
            min(self.row1 + margin, height),
            max(self.col0 - margin, 0),
            min(self.col1 + margin, width),
        )

    def within(self, outer: Region) -> tuple[slice, slice]:
        """Slices that cut this region out of an array that covers ``outer``."""
        return (
            slice(self.row0 - outer.row0, self.row1 - outer.row0),
            slice(self.col0 - outer.col0, self.col1 - outer.col0),
        )
