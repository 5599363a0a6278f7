"""A simulated set-up as a trial needs it: both views, the camera's unit, and which pixels see which part of the truth.

The truth stays on this side: a detector is handed clouds only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from scipy import ndimage

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import invert, transform_points
from harness.vocabulary.units import MM
from scenes.render.cache import read_view
from scenes.sensor.camera import CameraConfig, camera_of
from scenes.sensor.source import SimulatedUnit
from scenes.target.custom import TargetConfig
from scenes.target.face import face_of
from scenes.target.pose import T_camera_board_of
from scenes.target.truth import Damage, truth_of
from scenes.view import NoiseFreeView

INTACT_MARGIN_PX = 8
"""Pixels nearer than this to damage or to the board's rim do not count as undamaged: twice the engine's window."""
FEWEST_PROBES = 100
PROBES = 500
"""Pixels on which temporal noise and systematic error are followed over repeats: known to 0.5 % with 50 repeats."""


@dataclass(frozen=True)
class SetUpRef:
    """Names a set-up in few bytes, for sending to a worker: stored views, camera and target."""

    damaged_path: str
    hole_free_path: str
    camera: CameraConfig
    target: TargetConfig


@dataclass(frozen=True)
class SetUp:
    """One target before one unit, with and without its damage. Arrays cover ``damaged.region``, (h, w)."""

    damaged: SimulatedUnit
    hole_free: SimulatedUnit
    truth: tuple[Damage, ...]
    target: TargetConfig
    T_camera_board: np.ndarray

    @cached_property
    def board_xy_m(self) -> np.ndarray:
        """(h, w, 2): where each pixel's central ray meets the undamaged face, board frame; NaN off the board."""
        view, cut = self.hole_free.view, self.hole_free.cut
        rays = np.concatenate([view.slopes[cut], np.ones((*self.hole_free.region.shape, 1))], axis=-1)
        points = rays * (view.range_m[cut] / np.linalg.norm(rays, axis=-1))[..., None]
        board = transform_points(invert(self.T_camera_board), points)
        x, y, z = np.moveaxis(board, -1, 0)
        size = self.target.board
        over = (np.abs(x) < size.width_mm / 2 * MM) & (np.abs(y) < size.height_mm / 2 * MM)
        on_face = over & (np.abs(z - face_of(size).height_m(x, y)) < 0.5 * MM)
        return np.where(on_face[..., None], board[..., :2], np.nan)

    @cached_property
    def true_z_m(self) -> np.ndarray:
        """(h, w): z of the undamaged face along each pixel's central ray."""
        return _z_m(self.hole_free)

    @cached_property
    def seen_z_m(self) -> np.ndarray:
        """(h, w): z of what each pixel's central ray meets on the damaged target, floors and backing of holes too."""
        return _z_m(self.damaged)

    @cached_property
    def outlines(self) -> dict[int, np.ndarray]:
        """Flat indices of the pixels whose central ray enters each damage; at least the nearest pixel."""
        flat = self.board_xy_m.reshape(-1, 2)
        inside = {}
        for damage in self.truth:
            distance = np.linalg.norm(flat - damage.centre_board_m[:2], axis=-1)
            within = np.flatnonzero(distance < damage.diameter_m / 2)
            inside[damage.id] = within if within.size else np.array([int(np.nanargmin(distance))])
        return inside

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
    square = np.ones((2 * INTACT_MARGIN_PX + 1,) * 2, bool)
    return np.asarray(ndimage.binary_erosion(mask, square, border_value=0))


def _z_m(unit: SimulatedUnit) -> np.ndarray:
    """(h, w): true z along the central rays of a unit's pixels."""
    view, cut = unit.view, unit.cut
    return np.asarray(view.range_m[cut] / np.sqrt(1 + (view.slopes[cut] ** 2).sum(axis=-1)))


@lru_cache(maxsize=32)
def load_set_up(ref: SetUpRef) -> SetUp:
    """The set-up behind a reference, kept for the worker's next trials."""
    camera = camera_of(ref.camera)
    T_camera_board = T_camera_board_of(ref.target.pose)
    return SetUp(
        damaged=SimulatedUnit(camera, ref.camera, _stored_view(ref.damaged_path)),
        hole_free=SimulatedUnit(camera, ref.camera, _stored_view(ref.hole_free_path)),
        truth=truth_of(ref.target, T_camera_board),
        target=ref.target,
        T_camera_board=T_camera_board,
    )


def _stored_view(path: str) -> NoiseFreeView:
    view = read_view(Path(path))
    if view is None:
        raise UserError(f"{path}: the stored render is missing or damaged", fix="run the same command again")
    return view
