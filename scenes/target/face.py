"""The undamaged face as a height field z(x, y) in the board's frame, with its normals and curvatures. All in metres."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from harness.vocabulary.units import MM
from scenes.target.custom import BoardConfig, CylinderConfig, PolynomialConfig, SphereConfig

OUTLINE_STEPS = 64
"""Points along each side of the outline."""


class Face(ABC):
    """A smooth height field with z(0, 0) = 0. Arguments broadcast; every answer is vectorised."""

    @abstractmethod
    def height_m(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """z of the face; NaN where the shape does not reach."""

    @abstractmethod
    def slope(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """(..., 2): dz/dx and dz/dy."""

    @abstractmethod
    def bend(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """(..., 3): d2z/dx2, d2z/dxdy and d2z/dy2 in 1/m."""

    def point(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """(..., 3): the face's points above plan positions."""
        x, y = np.broadcast_arrays(np.asarray(x_m, float), np.asarray(y_m, float))
        return np.stack([x, y, self.height_m(x, y)], axis=-1)

    def normal(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """(..., 3): unit normals out of the face."""
        slope = self.slope(x_m, y_m)
        upward = np.concatenate([-slope, np.ones((*slope.shape[:-1], 1))], axis=-1)
        return upward / np.linalg.norm(upward, axis=-1, keepdims=True)

    def curvatures(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """(..., 2): principal curvatures in 1/m, positive where the face bulges towards the camera, larger first.

        From mean and Gaussian curvature of a Monge patch (do Carmo, Differential Geometry, section 3-3, example 5).
        """
        fx, fy = np.moveaxis(self.slope(x_m, y_m), -1, 0)
        fxx, fxy, fyy = np.moveaxis(self.bend(x_m, y_m), -1, 0)
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

    def _root(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        square = self.radius_m**2 - self.bent_x * np.square(x_m) - self.bent_y * np.square(y_m)
        return np.sqrt(np.where(square > 0, square, np.nan))

    def height_m(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        return self.sign * (self._root(x_m, y_m) - self.radius_m)

    def slope(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        x, y = np.broadcast_arrays(np.asarray(x_m, float), np.asarray(y_m, float))
        root = self._root(x, y)
        return -self.sign * np.stack([self.bent_x * x / root, self.bent_y * y / root], axis=-1)

    def bend(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        x, y = np.broadcast_arrays(np.asarray(x_m, float), np.asarray(y_m, float))
        root = self._root(x, y)
        along_x = self.bent_x * (1 / root + x**2 / root**3)
        along_y = self.bent_y * (1 / root + y**2 / root**3)
        return -self.sign * np.stack([along_x, self.bent_x * self.bent_y * x * y / root**3, along_y], axis=-1)


@dataclass(frozen=True)
class PolynomialFace(Face):
    """The sum of terms coefficient_m x^power_x y^power_y, x and y in metres; no terms make a flat face."""

    terms: tuple[tuple[int, int, float], ...]

    def _sum(self, x_m: ArrayLike, y_m: ArrayLike, order_x: int, order_y: int) -> np.ndarray:
        """The derivative of the given orders."""
        x, y = np.broadcast_arrays(np.asarray(x_m, float), np.asarray(y_m, float))
        total = np.zeros(x.shape)
        for power_x, power_y, coefficient in self.terms:
            if power_x >= order_x and power_y >= order_y:
                factor = coefficient * _falling(power_x, order_x) * _falling(power_y, order_y)
                total += factor * x ** (power_x - order_x) * y ** (power_y - order_y)
        return total

    def height_m(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        return self._sum(x_m, y_m, 0, 0)

    def slope(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        return np.stack([self._sum(x_m, y_m, 1, 0), self._sum(x_m, y_m, 0, 1)], axis=-1)

    def bend(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        return np.stack([self._sum(x_m, y_m, 2, 0), self._sum(x_m, y_m, 1, 1), self._sum(x_m, y_m, 0, 2)], axis=-1)


def _falling(power: int, order: int) -> int:
    """power (power - 1) ... (power - order + 1): the factor that differentiating leaves."""
    return int(np.prod(np.arange(power - order + 1, power + 1)))


def face_of(board: BoardConfig) -> Face:
    """The face that a board's declaration describes."""
    shape = board.shape
    if isinstance(shape, CylinderConfig | SphereConfig):
        straight = shape.straight_along if isinstance(shape, CylinderConfig) else ""
        sign = 1.0 if shape.bulge == "towards" else -1.0
        return RoundFace(shape.radius_mm * MM, sign, float(straight != "x"), float(straight != "y"))
    if isinstance(shape, PolynomialConfig):
        half_x, half_y = board.width_mm * MM / 2, board.height_mm * MM / 2
        return PolynomialFace(
            tuple(
                (t.power_x, t.power_y, t.coefficient_mm * MM / half_x**t.power_x / half_y**t.power_y)
                for t in shape.terms
            )
        )
    return PolynomialFace(())


def outline_board_m(board: BoardConfig) -> np.ndarray:
    """(n, 3): the rim of the undamaged face, counter-clockwise seen from the camera, board frame."""
    half_x, half_y = board.width_mm * MM / 2, board.height_mm * MM / 2
    side = np.linspace(-1, 1, OUTLINE_STEPS, endpoint=False)
    end = np.ones(OUTLINE_STEPS)
    x, y = np.concatenate([side, end, -side, -end]), np.concatenate([-end, side, end, -side])
    return face_of(board).point(half_x * x, half_y * y)


def face_points_board_m(board: BoardConfig) -> np.ndarray:
    """(n, 3): a grid of points on the undamaged face, its rim included, board frame."""
    steps = np.linspace(-0.5, 0.5, OUTLINE_STEPS + 1)
    x, y = np.meshgrid(steps * board.width_mm * MM, steps * board.height_mm * MM)
    return face_of(board).point(x.ravel(), y.ravel())
