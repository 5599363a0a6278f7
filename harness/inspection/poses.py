"""Poses that a user states: where views are thought to stand, from JSON or from TUM's groundtruth.txt."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import invert
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.limits import TEXT_BYTES, bounded_bytes
from harness.vocabulary.versions import RESULTS_VERSION, check_version

POSES_KEY = "T_reference_view"
"""Key of the list in a file of `harness.export`, beside the file's version."""
LEGAL_POSES = (
    "JSON: a list with a 4x4 matrix (metres, last row 0 0 0 1) for each view, all to one common frame, bare or"
    f" under the key {POSES_KEY}; or lines of"
    " `timestamp tx ty tz qx qy qz qw`, one for each view"
)
RIGID_WITHIN = 1e-4
"""Tolerance of R R' = 1 and of the quaternion's length: poses are written with four digits and more."""
FARTHEST_M = 100.0
"""Largest distance of two views of one target: several times any such camera's range. Poses in millimetres lie beyond.
"""
MOST_KEYS = 10
"""Keys that a message names of an object that is no list."""


def read_poses(path: Path, count: int) -> tuple[np.ndarray, ...]:
    """Return ``T_first_view`` (4, 4) of each view, the first the identity, from poses to any common frame.

    Raises UserError where the file cannot be read, is larger than `limits.TEXT_BYTES` or of a newer version, holds
    another number of poses, one that is not rigid, or one farther than `FARTHEST_M` from the first.
    """
    try:
        text = bounded_bytes(path, TEXT_BYTES).decode("utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})", legal=LEGAL_POSES) from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is no text", legal=LEGAL_POSES) from error
    poses = _from_json(path, text) if text.lstrip().startswith(("[", "{")) else _from_lines(path, text)
    if len(poses) != count:
        raise UserError(
            f"{path}: {len(poses)} poses for {count} views",
            legal=LEGAL_POSES,
            fix="keep one pose for each PATH, in the same order (of a sequence's groundtruth.txt one line a view)",
        )
    with np.errstate(over="ignore", invalid="ignore"):
        T_first_common = invert(poses[0])
        from_first = [T_first_common @ pose for pose in poses[1:]]
        distances_m = [float(np.linalg.norm(pose[:3, 3])) for pose in from_first]
    for number, distance_m in enumerate(distances_m, start=1):
        if not distance_m <= FARTHEST_M:  # or NaN, where numbers are near the largest
            raise UserError(
                f"{path}: pose {number} is {distance_m:.4g} m from pose 0",
                legal=f"up to {FARTHEST_M:g} m between views of one target",
                fix="write translations in metres, not millimetres",
            )
    return (np.eye(4), *from_first)


def _from_json(path: Path, text: str) -> list[np.ndarray]:
    """Parse a list of matrices: bare, or in an object that `harness.export` wrote, or without version by hand."""
    try:
        data = strict_json(text)
        if isinstance(data, dict):
            if "results_version" in data:
                check_version(data["results_version"], RESULTS_VERSION, path, "a file of poses")
            if POSES_KEY not in data:
                keys = ", ".join(key[:40] for key in list(data)[:MOST_KEYS])
                raise TypeError(f"an object with the keys {keys}{', ...' if len(data) > MOST_KEYS else ''}")
            data = data[POSES_KEY]
        poses = [np.array(each, float) for each in data]
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{path}: holds no list of matrices ({error})", legal=LEGAL_POSES) from error
    for number, pose in enumerate(poses):
        fault = _fault(pose)
        if fault:
            raise UserError(f"{path}: pose {number} is no rigid 4x4 transform: {fault}", legal=LEGAL_POSES)
    return poses


def _fault(pose: np.ndarray) -> str:
    """Return the reason why an array is no rigid 4x4 transform; empty where it is."""
    if pose.shape != (4, 4):
        return f"it has the shape {pose.shape}"
    if not np.isfinite(pose).all():
        return "not all of its numbers are finite"
    if not np.array_equal(pose[3], [0, 0, 0, 1]):
        return "its last row is not 0 0 0 1"
    if not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=RIGID_WITHIN):
        return "its upper left 3x3 is no rotation: it scales or shears"
    if np.linalg.det(pose[:3, :3]) < 0:
        return "its upper left 3x3 mirrors"
    return ""


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
