"""The truth: which material was taken out of the board, its place and its volume."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from harness.vocabulary.geometry import rotate_vectors, transform_points
from harness.vocabulary.units import MM
from scenes.target.custom import DentConfig, HoleConfig, TargetConfig
from scenes.target.face import Face, face_of


@dataclass(frozen=True)
class Damage:
    """A hole or dent.

    ``centre_*`` (3,) lies on the undamaged face, ``axis_*`` (3,) is the face's unit normal there, out of the board.
    ``depth_m``: of the material removed, along the axis; for a through-hole the board's thickness, so the gap to a
    backing comes on top. ``diameter_m``: of the drill; of a dent the rim on this face (by equal area). ``volume_m3``:
    exact on a flat face, to second order in diameter over radius of curvature on a curved one.
    """

    id: int
    kind: Literal["through", "blind", "dent"]
    diameter_m: float
    depth_m: float
    volume_m3: float
    centre_board_m: np.ndarray
    axis_board: np.ndarray
    centre_camera_m: np.ndarray
    axis_camera: np.ndarray

    def to_row(self) -> dict[str, Any]:
        """Return plain data in millimetres, one flat row for JSON or a table."""
        row: dict[str, Any] = {
            "id": self.id,
            "kind": self.kind,
            "diameter_mm": self.diameter_m / MM,
            "depth_mm": self.depth_m / MM,
            "volume_mm3": self.volume_m3 / MM**3,
        }
        places = {"board": (self.centre_board_m, self.axis_board), "camera": (self.centre_camera_m, self.axis_camera)}
        for frame, (centre_m, axis) in places.items():
            row |= {f"{a}_{frame}_mm": float(value) / MM for a, value in zip("xyz", centre_m, strict=True)}
            row |= {f"axis_{a}_{frame}": float(value) for a, value in zip("xyz", axis, strict=True)}
        return row


def truth_of(config: TargetConfig, T_camera_board: np.ndarray) -> tuple[Damage, ...]:
    """Return the truth of a declaration: holes, then dents, in the order of their declaration."""
    face, truth = face_of(config.board), []
    for item in config.damages:
        centre, axis, bends = (of(*item.centre_m) for of in (face.point, face.normal, face.curvatures))
        radius_m = item.radius_m
        depth_m = (config.board.thickness_mm if item.depth_mm is None else item.depth_mm) * MM
        if isinstance(item, DentConfig):
            # The sphere's curvature gives paraboloids of the two principal curvatures the same volume as the face;
            # exact on flat and spherical faces.
            bend = (math.sqrt(float(np.prod(1 + item.ball_m * bends))) - 1) / item.ball_m
            radius_m, volume_m3 = _lens(item, bend)
        else:
            # Over a disc of radius a about the normal a face with principal curvatures k lies a^2 (k1 + k2) / 8 lower
            # on average than at the centre. The back of a through-hole is a parallel surface, curvatures k / (1 - t k).
            back = float((bends / (1 - depth_m * bends)).sum()) if item.kind == "through" else 0.0
            lift_m = radius_m**2 / 8 * (back - float(bends.sum()))
            volume_m3 = math.pi * radius_m**2 * (depth_m + lift_m)
        truth.append(
            Damage(
                item.id,
                item.kind,
                2 * radius_m,
                depth_m,
                volume_m3,
                centre,
                axis,
                transform_points(T_camera_board, centre),
                rotate_vectors(T_camera_board, axis),
            )
        )
    return tuple(truth)


def _lens(dent: DentConfig, bend: float) -> tuple[float, float]:
    """Return rim radius and volume that a dent's ball shares with a sphere of curvature ``bend``.

    Two caps on one rim circle, each pi h (3 r^2 + h^2) / 6; the sphere's counts against where it bends away (bend < 0).
    """
    depth_m = dent.depth_mm * MM
    half_square = dent.radius_m**2 / (2 * (1 + bend * (dent.ball_m - depth_m)))
    sphere_cap_m = bend * half_square
    rim_square = 2 * half_square - sphere_cap_m**2
    caps = [math.pi * h * (3 * rim_square + h**2) / 6 for h in (depth_m - sphere_cap_m, sphere_cap_m)]
    return math.sqrt(rim_square), sum(caps)


def widest_rim_m(item: HoleConfig | DentConfig, face: Face) -> float:
    """Return the largest radius of a rim: a dent's in the direction in which the face bends towards the ball most."""
    if isinstance(item, HoleConfig):
        return item.radius_m
    return _lens(item, float(face.curvatures(*item.centre_m).min()))[0]
