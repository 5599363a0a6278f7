"""The undamaged face as a height field z(x, y) in the board's frame, and the planes around it. All in metres."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from harness.vocabulary.units import MM
from scenes.target.custom import (
    BackingConfig,
    BoardConfig,
    CylinderConfig,
    PolynomialConfig,
    RoomConfig,
    SphereConfig,
    TargetConfig,
)

OUTLINE_STEPS = 64
"""Points along each side of the outline."""
OPEN_FLOOR_M = 3.0
"""Reach of a floor without a back wall: beyond it, light returns under 1 % of the board's at 0.7 m."""
_UNIT_CORNERS = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])


class Face(ABC):
    """A smooth height field with z(0, 0) = 0. Arguments broadcast; every answer is vectorised."""

    @abstractmethod
    def derivatives(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return z, dz/dx, dz/dy, d2z/dx2, d2z/dxdy and d2z/dy2, each of the shape of ``x``; NaN beyond its reach."""

    def _derived(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[np.ndarray, ...]:
        return self.derivatives(*np.broadcast_arrays(np.asarray(x_m, float), np.asarray(y_m, float)))

    def height_m(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return z of the face; NaN where the shape does not reach."""
        return self._derived(x_m, y_m)[0]

    def slope(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return (..., 2): dz/dx and dz/dy."""
        return np.stack(self._derived(x_m, y_m)[1:3], axis=-1)

    def bend(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return (..., 3): d2z/dx2, d2z/dxdy and d2z/dy2 in 1/m."""
        return np.stack(self._derived(x_m, y_m)[3:], axis=-1)

    def point(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return (..., 3): the face's points above plan positions."""
        x, y = np.broadcast_arrays(np.asarray(x_m, float), np.asarray(y_m, float))
        return np.stack([x, y, self.height_m(x, y)], axis=-1)

    def normal(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return (..., 3): unit normals out of the face."""
        slope = self.slope(x_m, y_m)
        upward = np.concatenate([-slope, np.ones((*slope.shape[:-1], 1))], axis=-1)
        return upward / np.linalg.norm(upward, axis=-1, keepdims=True)

    def curvatures(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return (..., 2): principal curvatures in 1/m, positive where the face bulges to the camera, larger first.

        From mean and Gaussian curvature of a Monge patch (do Carmo, Differential Geometry, section 3-3, example 5).
        """
        _, fx, fy, fxx, fxy, fyy = self._derived(x_m, y_m)
        metric = 1 + fx**2 + fy**2
        mean = ((1 + fx**2) * fyy - 2 * fx * fy * fxy + (1 + fy**2) * fxx) / (2 * metric**1.5)
        gaussian = (fxx * fyy - fxy**2) / metric**2
        spread = np.sqrt(np.maximum(mean**2 - gaussian, 0.0))
        return np.stack([spread - mean, -spread - mean], axis=-1)


@dataclass(frozen=True)
class RoundFace(Face):
    """A cylinder or a sphere: z = sign (sqrt(R^2 - bent_x x^2 - bent_y y^2) - R); sign +1 bulges towards the camera."""

    radius_m: float
    sign: float
    bent_x: float
    bent_y: float

    def derivatives(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Face`."""
        square = self.radius_m**2 - self.bent_x * np.square(x) - self.bent_y * np.square(y)
        root = np.sqrt(np.where(square > 0, square, np.nan))
        return (
            self.sign * (root - self.radius_m),
            -self.sign * (self.bent_x * x / root),
            -self.sign * (self.bent_y * y / root),
            -self.sign * (self.bent_x * (1 / root + x**2 / root**3)),
            -self.sign * (self.bent_x * self.bent_y * x * y / root**3),
            -self.sign * (self.bent_y * (1 / root + y**2 / root**3)),
        )


@dataclass(frozen=True)
class PolynomialFace(Face):
    """The sum of terms coefficient_m x^power_x y^power_y, x and y in metres; no terms make a flat face."""

    terms: tuple[tuple[int, int, float], ...]

    def derivatives(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Face`."""
        orders = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
        totals = tuple(np.zeros(x.shape) for _ in orders)
        for power_x, power_y, coefficient in self.terms:
            for total, (dx, dy) in zip(totals, orders, strict=True):
                if power_x >= dx and power_y >= dy:
                    # the factors that differentiating leaves: power (power - 1) ... (power - order + 1)
                    left = np.prod(np.arange(power_x - dx + 1, power_x + 1), dtype=int)
                    left *= np.prod(np.arange(power_y - dy + 1, power_y + 1), dtype=int)
                    total += coefficient * left * x ** (power_x - dx) * y ** (power_y - dy)
        return totals


def face_of(board: BoardConfig) -> Face:
    """Return the face that a board's declaration describes."""
    shape = board.shape
    if isinstance(shape, CylinderConfig | SphereConfig):
        straight = shape.straight_along if isinstance(shape, CylinderConfig) else ""
        sign = 1.0 if shape.bulge == "towards" else -1.0
        return RoundFace(shape.radius_mm * MM, sign, float(straight != "x"), float(straight != "y"))
    half_x, half_y = board.width_mm * MM / 2, board.height_mm * MM / 2
    terms = shape.terms if isinstance(shape, PolynomialConfig) else ()
    return PolynomialFace(
        tuple((t.power_x, t.power_y, t.coefficient_mm * MM / half_x**t.power_x / half_y**t.power_y) for t in terms)
    )


def outline_board_m(board: BoardConfig) -> np.ndarray:
    """Return (n, 3): the rim of the undamaged face, counter-clockwise seen from the camera, board frame."""
    half_x, half_y = board.width_mm * MM / 2, board.height_mm * MM / 2
    side = np.linspace(-1, 1, OUTLINE_STEPS, endpoint=False)
    end = np.ones(OUTLINE_STEPS)
    x, y = np.concatenate([side, end, -side, -end]), np.concatenate([-end, side, end, -side])
    return face_of(board).point(half_x * x, half_y * y)


def face_grid_m(board: BoardConfig, depth_m: float = 0.0, steps: int = 32) -> np.ndarray:
    """Return (n, n, 3): the face, rim included, moved along its normals by ``depth_m`` into the board; board frame."""
    face, places = face_of(board), np.linspace(-0.5, 0.5, steps + 1)
    x, y = np.meshgrid(places * board.width_mm * MM, places * board.height_mm * MM)
    return face.point(x, y) - depth_m * face.normal(x, y) if depth_m else face.point(x, y)


# ---- what stands around the board: corners (4, 3), counter-clockwise seen from the side that the camera sees


def backing_corners_board_m(config: TargetConfig, backing: BackingConfig) -> np.ndarray:
    """Return the backing's corners in the board's frame; it faces the board."""
    deepest_m = -float(face_grid_m(config.board, config.board.thickness_mm * MM)[..., 2].min())
    z_m = deepest_m + backing.distance_mm * MM
    size_m = np.array(backing.size_mm or (config.board.width_mm, config.board.height_mm)) * MM
    if backing.size_mm is None:
        size_m = size_m * (config.pose.distance_m + z_m) / config.pose.distance_m
    return np.column_stack([_UNIT_CORNERS * size_m, np.full(4, -z_m)])


def floor_corners_camera_m(room: RoomConfig, floor_below_lens_m: float) -> np.ndarray:
    """Return the floor's corners in the camera's frame; it faces up and reaches from the lens to the back wall."""
    far_m = room.back_wall_distance_m or OPEN_FLOOR_M
    x, z = room.width_m * _UNIT_CORNERS[:, 0], far_m * (_UNIT_CORNERS[:, 1] + 0.5)
    return np.column_stack([x, np.full(4, floor_below_lens_m), z])


def wall_corners_camera_m(room: RoomConfig, back_wall_distance_m: float) -> np.ndarray:
    """Return the back wall's corners in the camera's frame, on the floor (without a floor, centred on the axis)."""
    foot_m = room.height_m / 2 if room.floor_below_lens_m is None else room.floor_below_lens_m
    x, up = room.width_m * _UNIT_CORNERS[:, 0], room.height_m * (_UNIT_CORNERS[:, 1] + 0.5)
    return np.column_stack([x, foot_m - up, np.full(4, back_wall_distance_m)])
