"""Field of view: a target that a camera sees, and the part of its sensor."""

from __future__ import annotations

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region, transform_points
from scenes.optics import Optics
from scenes.target.custom import TargetConfig
from scenes.target.face import OUTLINE_STEPS, face_grid_m, outline_board_m

NEAREST_M = 0.05
"""Least distance of the face from the lens' plane, whatever the camera."""


def check_in_view(config: TargetConfig, optics: Optics) -> None:
    """Raise UserError where a part of the face is out of the camera's field of view, or all of it out of its range.

    A face partly out of range is legal: its pixels there have no range, as they would have in the real camera.
    """
    outline = transform_points(config.pose.T_camera_board, outline_board_m(config.board))
    seen_region(outline, optics)
    face = transform_points(config.pose.T_camera_board, face_grid_m(config.board, steps=OUTLINE_STEPS))
    range_m = face[..., 2] if optics.limits_along == "axis" else np.linalg.norm(face, axis=-1)
    if range_m.max() < optics.nearest_m or range_m.min() > optics.farthest_m:
        raise UserError(
            f"the target's face lies {range_m.min():.3f} to {range_m.max():.3f} m from the camera",
            legal=f"{optics.nearest_m:g} to {optics.farthest_m:g} m for {optics.title}",
            fix="change target.pose.distance_m (or target.distance_m)",
        )


def seen_region(outline_camera_m: np.ndarray, optics: Optics) -> Region:
    """Return the pixels on which an outline (n, 3) lies. Raises UserError where part of it is off the sensor or behind
    it."""
    lens = optics.lens
    nearest_m = float(outline_camera_m[:, 2].min())
    if nearest_m <= NEAREST_M:
        raise UserError(
            f"the target reaches to {nearest_m:.3f} m before the lens",
            legal=f"all of the face at least {NEAREST_M:g} m in front of the camera",
            fix="raise target.pose.distance_m (or target.distance_m) or lower its tilt",
        )
    uv = lens.project(outline_camera_m)
    low, high = np.floor(uv.min(axis=0)).astype(int), np.ceil(uv.max(axis=0)).astype(int) + 1
    if low.min() < 0 or high[0] > lens.width or high[1] > lens.height:
        raise UserError(
            f"the target covers columns {low[0]}..{high[0]} and rows {low[1]}..{high[1]}",
            legal=f"columns 0..{lens.width} and rows 0..{lens.height} of {optics.title}",
            fix="move the target away (distance), towards the axis (offset), or make it smaller",
        )
    return Region(int(low[1]), int(high[1]), int(low[0]), int(high[0]))
