"""A simulated set-up as a trial needs it: the view, the camera's unit, and which pixels see which part of the truth.

The truth stays on this side: a detector is handed clouds only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import cv2
import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import invert, rotate_vectors, transform_points
from harness.vocabulary.units import MM
from scenes.render.cache import read_view
from scenes.sensor.camera import CameraConfig, camera_of
from scenes.sensor.source import SimulatedUnit
from scenes.target.custom import TargetConfig
from scenes.target.face import Face, face_of
from scenes.target.truth import Damage, truth_of
from scenes.view import NoiseFreeView

INTACT_MARGIN_PX = 8
"""Pixels nearer than this to damage or to the board's rim do not count as undamaged: twice the engine's window."""
FEWEST_PROBES = 100
PROBES = 500
"""Pixels on which temporal noise and systematic error are followed over repeats: known to 0.5 % with 50 repeats."""


FACE_STEPS = 8
"""Fixed-point steps to where a line of sight meets a curved face; each shrinks the error by the face's slope."""


@dataclass(frozen=True)
class SetUpRef:
    """Names a set-up in few bytes, for sending to a worker: a stored view, camera and target.

    ``target`` has its damage in any case; ``damaged`` tells whether the view shows it.
    """

    view_path: str
    camera: CameraConfig
    target: TargetConfig
    damaged: bool


@dataclass(frozen=True)
class SetUp:
    """One target before one unit. ``truth`` is the target's damage, also where ``unit``'s view was rendered without it
    (``damaged`` False): the same places on a hole-free board. Arrays cover ``unit.region``, (h, w)."""

    unit: SimulatedUnit
    damaged: bool
    truth: tuple[Damage, ...]
    target: TargetConfig
    T_camera_board: np.ndarray

    @cached_property
    def on_face_m(self) -> np.ndarray:
        """(h, w, 3): where each pixel's central ray meets the undamaged face, board frame; NaN off the board."""
        slopes = self.unit.view.slopes[self.unit.cut]
        T_board_camera = invert(self.T_camera_board)
        rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
        origin = np.broadcast_to(T_board_camera[:3, 3], rays.shape)
        size = self.target.board
        met = met_on_face(origin, rotate_vectors(T_board_camera, rays), face_of(size))
        x, y, z = np.moveaxis(met, -1, 0)
        with np.errstate(invalid="ignore"):
            over = (np.abs(x) < size.width_mm / 2 * MM) & (np.abs(y) < size.height_mm / 2 * MM)
        return np.where((over & np.isfinite(z))[..., None], met, np.nan)

    @property
    def board_xy_m(self) -> np.ndarray:
        """(h, w, 2): the same, along the face in plan."""
        return self.on_face_m[..., :2]

    @cached_property
    def face_z_m(self) -> np.ndarray:
        """(h, w): z in the camera's frame of the undamaged face along each pixel's central ray; strips of tape count
        as face."""
        return np.asarray(transform_points(self.T_camera_board, self.on_face_m)[..., 2])

    @cached_property
    def seen_z_m(self) -> np.ndarray:
        """(h, w): z of what each pixel's central ray meets in the rendered view; where that is damaged, floors and
        backing of holes too."""
        view, cut = self.unit.view, self.unit.cut
        return np.asarray(view.range_m[cut] / np.sqrt(1 + (view.slopes[cut] ** 2).sum(axis=-1)))

    @cached_property
    def outlines(self) -> dict[int, np.ndarray]:
        """Flat indices of the pixels whose central ray enters each damage; at least the nearest pixel."""
        x, y = (np.ascontiguousarray(self.board_xy_m[..., axis]).ravel() for axis in (0, 1))
        inside = {}
        for damage in self.truth:
            centre_x, centre_y = damage.centre_board_m[:2]
            distance = np.sqrt((x - centre_x) ** 2 + (y - centre_y) ** 2)
            within = np.flatnonzero(distance < damage.diameter_m / 2)
            inside[damage.id] = within if within.size else np.array([int(np.nanargmin(distance))])
        return inside

    @cached_property
    def seen_depth_m(self) -> dict[int, float]:
        """By damage how far behind the face the central rays through it end, along the optical axis: the median of
        those that come within 1 mm of the deepest (walls are seen in passing). Behind a through-hole that is the
        backing."""
        depth_m = (self.seen_z_m - self.face_z_m).ravel()
        return {damage.id: _deepest(depth_m[self.outlines[damage.id]]) for damage in self.truth}

    @cached_property
    def intact(self) -> np.ndarray:
        """(h, w) bool: undamaged face well away from damage and rim."""
        whole = np.isfinite(self.board_xy_m[..., 0])
        whole.ravel()[np.concatenate(list(self.outlines.values()))] = False
        return _eroded(whole)

    @cached_property
    def on_board(self) -> np.ndarray:
        """(h, w) bool: pixels whose central ray meets the face or a hole in it."""
        return np.isfinite(self.board_xy_m[..., 0])

    @cached_property
    def bare(self) -> np.ndarray:
        """(h, w) bool: face well away from the rim, damaged or not: what a hole-free board shows undamaged."""
        return _eroded(self.on_board)

    @cached_property
    def pitch_mm(self) -> tuple[float, float]:
        """Median distance on the face between neighbouring columns and between neighbouring rows of pixels."""
        xy = self.board_xy_m
        steps = (np.linalg.norm(np.diff(xy, axis=axis), axis=-1) for axis in (1, 0))
        u, v = (float(np.nanmedian(step)) / MM for step in steps)
        return u, v

    @cached_property
    def probes(self) -> np.ndarray:
        """(p,) flat indices of evenly spread undamaged pixels.

        Where the camera is so far that damage leaves too few, pixels over damage count too: probes are read on the
        hole-free board only.
        """
        intact = np.flatnonzero(self.intact)
        intact = intact if len(intact) >= FEWEST_PROBES else np.flatnonzero(self.bare)
        return intact[:: max(1, len(intact) // PROBES)][:PROBES]


def _eroded(mask: np.ndarray) -> np.ndarray:
    """A mask less a rim of `INTACT_MARGIN_PX`."""
    square = np.ones((2 * INTACT_MARGIN_PX + 1,) * 2, np.uint8)
    left = cv2.erode(mask.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(left > 0)


def _deepest(depth_m: np.ndarray) -> float:
    known = depth_m[np.isfinite(depth_m)]
    return float(np.median(known[known > known.max() - 1 * MM])) if known.size else float("nan")


def met_on_face(points_m: np.ndarray, directions: np.ndarray, face: Face) -> np.ndarray:
    """(..., 3): where the lines through points along directions (both (..., 3), board frame) meet a face."""
    place, before = points_m, None
    for _ in range(FACE_STEPS):
        height = np.nan_to_num(face.height_m(place[..., 0], place[..., 1]))
        if before is not None and np.array_equal(height, before):
            break  # on a flat face the second step is the last
        before = height
        place = points_m + ((height - points_m[..., 2]) / directions[..., 2])[..., None] * directions
    return np.asarray(place)


@lru_cache(maxsize=32)
def load_set_up(ref: SetUpRef) -> SetUp:
    """The set-up behind a reference, kept for the worker's next trials."""
    camera = camera_of(ref.camera)
    T_camera_board = ref.target.pose.T_camera_board
    return SetUp(
        unit=SimulatedUnit(camera, ref.camera, _stored_view(ref.view_path)),
        damaged=ref.damaged,
        truth=truth_of(ref.target, T_camera_board),
        target=ref.target,
        T_camera_board=T_camera_board,
    )


sent_views: Path | None = None
"""Of a process that does not see the driver's cache: the folder where views that were sent lie under their names."""


def _stored_view(path: str) -> NoiseFreeView:
    place = Path(path)
    view = read_view(sent_views / place.name if sent_views is not None and not place.exists() else place)
    if view is None:
        raise UserError(f"{path}: the stored render is missing or damaged", fix="run the same command again")
    return view
