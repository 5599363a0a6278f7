"""A board in closed form, without a render: a plate straight ahead with a hole, a plane behind."""

from __future__ import annotations

import numpy as np

from detectors.averages.average import AverageConfig
from harness.trials import board as boards
from harness.trials.averages import Averaging
from harness.trials.board import Board, BoardRef
from harness.trials.clouds import TrialPoint
from harness.trials.judge import Criteria
from harness.vocabulary.geometry import Region
from harness.vocabulary.seeds import canonical_json
from scenes.closed_form import Plane, layered_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig, EffectsConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target.custom import TargetConfig
from scenes.target.truth import truth_of

DISTANCE_M = 0.7
BACKING_M = 0.02
HOLE_MM = 16.0
CAMERA = CameraConfig(name="azure_kinect_nfov", effects=EffectsConfig(frame_jumps=False))
REGION = Region(308, 368, 276, 376)
"""A part of the sensor that the board more than fills."""
TARGET = TargetConfig.from_data(
    {
        "name": "custom",
        "board": {"width_mm": 400.0, "height_mm": 300.0, "thickness_mm": 12.0},
        "holes": [{"id": 7, "diameter_mm": HOLE_MM, "centre_mm": [8.0, -4.0]}],
        "pose": {"distance_m": DISTANCE_M},
    }
)
SETTINGS = canonical_json({"crop": {"kind": "none"}})


def board_of(*, damaged: bool = True) -> Board:
    """Return the board, with its hole or without."""
    camera = camera_of(CAMERA)
    lens = camera.nominal_lens
    region = REGION.grown(camera.optics.margin_px, lens.height, lens.width)
    T_camera_board = TARGET.pose.T_camera_board
    (hole,) = truth_of(TARGET, T_camera_board)
    centre = hole.centre_camera_m[:2] / DISTANCE_M
    radius = hole.diameter_m / 2 / DISTANCE_M

    def covers(slopes: np.ndarray) -> np.ndarray:
        is_hole = np.linalg.norm(slopes - centre, axis=-1) < radius
        return np.isfinite(slopes[..., 0]) & ~(is_hole & damaged)

    front = Plane(DISTANCE_M, 0.0, 0.0)
    back = Plane(DISTANCE_M + BACKING_M, 0.0, 0.0)
    view = layered_view(camera, region, front, back, covers, 0.6)
    unit = SimulatedUnit(camera, CAMERA, view)
    return Board(unit, damaged, (hole,), TARGET, T_camera_board)


def reference_of(board: Board) -> BoardRef:
    """Return a reference by which trials in this process get the board."""
    ref = BoardRef(f"in memory {board.damaged}", CAMERA, TARGET, board.damaged)
    boards._kept[ref] = board
    return ref


def point_of(
    variant: str = "main", *, frames: int = 5, threshold: float | None = 6.0, digest: str = "digest"
) -> TrialPoint:
    """Return a point that judges averages by the thesis' detector."""
    criteria = Criteria("thesis", SETTINGS, threshold, 0.01)
    averaging = Averaging(AverageConfig())
    return TrialPoint(digest, variant, frames, averaging, criteria)
