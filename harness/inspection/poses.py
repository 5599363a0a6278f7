"""Poses that a user states: where views are thought to stand, from JSON or from TUM's groundtruth.txt."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import invert

LEGAL_POSES = (
    "JSON: a list with a 4x4 matrix (metres, last row 0 0 0 1) for each view, all to one common frame; or lines of"
    " `timestamp tx ty tz qx qy qz qw`, one for each view"
)
RIGID_WITHIN = 1e-4
"""Of R R' = 1 and of the quaternion's length: poses are written with four digits and more."""


def read_poses(path: Path, count: int) -> tuple[np.ndarray, ...]:
    """``T_first_view`` (4, 4) of each view, the first the identity, whatever common frame the file's poses lead to.

    Raises UserError where the file cannot be read, holds another number of poses, or one that is not rigid.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read ({error})", legal=LEGAL_POSES) from error
    poses = _from_json(path, text) if text.lstrip().startswith("[") else _from_lines(path, text)
    if len(poses) != count:
        raise UserError(f"{path}: {len(poses)} poses for {count} views", legal=LEGAL_POSES)
    T_first_common = invert(poses[0])
    return (np.eye(4), *(T_first_common @ pose for pose in poses[1:]))


def _from_json(path: Path, text: str) -> list[np.ndarray]:
    try:
        data = json.loads(text)
        poses = [np.array(each, float) for each in data]
    except (json.JSONDecodeError, TypeError, ValueError) as error:
        raise UserError(f"{path}: holds no list of matrices ({error})", legal=LEGAL_POSES) from error
    for number, pose in enumerate(poses):
        rigid = (
            pose.shape == (4, 4)
            and np.isfinite(pose).all()
            and np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=RIGID_WITHIN)
            and np.linalg.det(pose[:3, :3]) > 0
            and np.array_equal(pose[3], [0, 0, 0, 1])
        )
        if not rigid:
            raise UserError(f"{path}: pose {number} is no rigid 4x4 transform", legal=LEGAL_POSES)
    return poses


def _from_lines(path: Path, text: str) -> list[np.ndarray]:
    from scipy.spatial.transform import Rotation

    poses = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            _, *values = (float(word) for word in line.split())
        except ValueError:
            values = []
        length = float(np.linalg.norm(values[3:])) if len(values) == 7 else float("nan")
        if not (abs(length - 1) < RIGID_WITHIN and np.isfinite(values).all()):
            raise UserError(f"{path}:{number}: is no pose", legal=LEGAL_POSES)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
        poses.append(pose)
    return poses
