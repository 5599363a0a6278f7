"""The truth: what was taken out of the board, where, and how much."""

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
    """One hole or dent.

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
        """Plain data in millimetres, one flat row for JSON or a table."""
        row: dict[str, Any] = {
            "id": self.id,
            "kind": self.kind,
            "diameter_mm": self.diameter_m / MM,
            "depth_mm": self.depth_m / MM,
            "volume_mm3": self.volume_m3 / MM**3,
        }
        for frame, centre_m, axis in (
            ("board", self.centre_board_m, self.axis_board),
            ("camera", self.centre_camera_m, self.axis_camera),
        ):
            row |= {f"{a}_{frame}_mm": float(value) / MM for a, value in zip("xyz", centre_m, strict=True)}
            row |= {f"axis_{a}_{frame}": float(value) for a, value in zip("xyz", axis, strict=True)}
        return row


def to_rows(truth: tuple[Damage, ...]) -> list[dict[str, Any]]:
    """One row per damage, in millimetres."""
    return [damage.to_row() for damage in truth]


def truth_of(config: TargetConfig, T_camera_board: np.ndarray) -> tuple[Damage, ...]:
    """The truth of a declaration: holes, then dents, in the order of their declaration."""
    face = face_of(config.board)
    thickness_m = config.board.thickness_mm * MM
    return tuple(_damage(item, face, thickness_m, T_camera_board) for item in config.damages)


def _damage(item: HoleConfig | DentConfig, face: Face, thickness_m: float, T_camera_board: np.ndarray) -> Damage:
    x_m, y_m = (np.asarray(value * MM) for value in item.centre_mm)
    bends = face.curvatures(x_m, y_m)
    kind: Literal["through", "blind", "dent"] = "dent" if isinstance(item, DentConfig) else item.kind
    radius_m = item.diameter_mm * MM / 2
    depth_m = thickness_m if item.depth_mm is None else item.depth_mm * MM
    if kind == "dent":
        radius_m, volume_m3 = _dent_on_face(radius_m, depth_m, bends)
    else:
        volume_m3 = (
            math.pi * radius_m**2 * (depth_m + _mean_lift_m(radius_m, bends, depth_m if kind == "through" else None))
        )
    centre, axis = face.point(x_m, y_m), face.normal(x_m, y_m)
    return Damage(
        id=item.id,
        kind=kind,
        diameter_m=2 * radius_m,
        depth_m=depth_m,
        volume_m3=volume_m3,
        centre_board_m=centre,
        axis_board=axis,
        centre_camera_m=transform_points(T_camera_board, centre),
        axis_camera=rotate_vectors(T_camera_board, axis),
    )


def _mean_lift_m(radius_m: float, bends: np.ndarray, thickness_m: float | None) -> float:
    """How much longer than at its centre a hole is on average, to second order in the face's curvature.

    Over a disc of radius a about the normal a face with principal curvatures k lies a^2 (k1 + k2) / 8 lower on average
    than at the centre. The back face of a through-hole is a parallel surface with curvatures k / (1 - t k).
    """
    front = float(bends.sum())
    back = 0.0 if thickness_m is None else float((bends / (1 - thickness_m * bends)).sum())
    return radius_m**2 / 8 * (back - front)


def _dent_on_face(radius_m: float, depth_m: float, bends: np.ndarray) -> tuple[float, float]:
    """Rim radius (by equal area) and volume of a ball's dent: what the ball shares with a sphere in place of the face.

    The sphere's curvature gives paraboloids of the two principal curvatures the same volume; exact on flat and
    spherical faces.
    """
    ball_m = ball_radius_m(radius_m, depth_m)
    return _lens(radius_m, depth_m, (math.sqrt(float(np.prod(1 + ball_m * bends))) - 1) / ball_m)


def _lens(radius_m: float, depth_m: float, bend: float) -> tuple[float, float]:
    """Rim radius and volume that a ball (on a flat: a cap of radius, depth) shares with a sphere of curvature ``bend``.

    Two caps on one rim circle, each pi h (3 r^2 + h^2) / 6; the sphere's counts against where it bends away (bend < 0).
    """
    ball_m = ball_radius_m(radius_m, depth_m)
    half_square = radius_m**2 / (2 * (1 + bend * (ball_m - depth_m)))
    sphere_cap_m = bend * half_square
    rim_square = 2 * half_square - sphere_cap_m**2
    caps = [math.pi * h * (3 * rim_square + h**2) / 6 for h in (depth_m - sphere_cap_m, sphere_cap_m)]
    return math.sqrt(rim_square), sum(caps)


def widest_rim_m(item: HoleConfig | DentConfig, face: Face) -> float:
    """The largest radius of a damage's rim: a dent's in the direction in which the face bends towards the ball most."""
    radius_m = item.diameter_mm * MM / 2
    if isinstance(item, HoleConfig):
        return radius_m
    bends = face.curvatures(*(np.asarray(value * MM) for value in item.centre_mm))
    return _lens(radius_m, item.depth_mm * MM, float(bends.min()))[0]


def ball_radius_m(radius_m: float, depth_m: float) -> float:
    """Radius of the ball whose cap has this rim radius and depth."""
    return (radius_m**2 + depth_m**2) / (2 * depth_m)
