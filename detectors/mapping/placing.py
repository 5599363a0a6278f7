"""The map's frame, and views placed in it: where each ray meets the target's surface, and how far off it ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detectors.mapping.chosen_views import ChosenView
from detectors.mapping.raster import CellGrid, Raster, raster_between
from detectors.surface import Surface, SurfaceConfig, fit_surface
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import invert, transform_points

FIT_POINTS = 20_000
"""Points of all views to which the map's surface is fitted, evenly strided."""
STEEPEST = 0.1
"""Cosine between the optical axis and the surface's normal below which the axis does not say where the target is."""
MAX_CELLS = 1 << 24
"""Cells of a map: a board of 4 m in millimetres."""


@dataclass(frozen=True)
class PlacedView:
    """A view in the map's frame. ``camera_m`` (3,): its centre. ``places_m`` (h, w, 2): x, y where each pixel's ray
    meets the surface; ``deviation_m`` (h, w): how far behind (+) the surface, along z, it ends. NaN outside the target.
    ``pixel_m`` (2,): sides along x and y of a rectangle that spreads as far as a pixel on the surface; ``pitch_m``: of
    the square of a pixel's area."""

    chosen: ChosenView
    T_map_view: np.ndarray
    places_m: np.ndarray
    deviation_m: np.ndarray
    pixel_m: np.ndarray
    pitch_m: float

    @property
    def camera_m(self) -> np.ndarray:
        centre: np.ndarray = self.T_map_view[:3, 3]
        return centre

    @property
    def inside(self) -> np.ndarray:
        """(h, w) bool: pixels of the target."""
        return np.isfinite(self.deviation_m)

    def raster(self, grid: CellGrid) -> Raster:
        """Return the position of the grid's cells among this view's pixels."""
        return raster_between(self.places_m, self.inside, self.chosen.cloud.organised, self.pitch_m, grid)


def T_reference_map_of(first: ChosenView) -> np.ndarray:
    """4x4: the map's frame in the first view's camera frame, from the plane through its target.

    The plane is by least absolute residuals. Its origin stands before the place where the optical axis meets the plane,
    as far from it as the camera; where the axis meets no target (too slant, or behind), before the target's middle.
    """
    points = _some(first.cloud.points_m[first.inside], FIT_POINTS)
    plane = fit_surface(points[:, 0], points[:, 1], points[:, 2], SurfaceConfig(degree=1))
    x, y = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    z0, zx, zy = plane.evaluate(x, y)
    normal = np.array([-(zx - z0), -(zy - z0), 1.0])
    normal /= np.linalg.norm(normal)
    meets = normal[2] > STEEPEST and z0 > 0 and _within(points, 0.0, 0.0)
    target = np.array([0.0, 0.0, z0]) if meets else np.median(points, axis=0)
    along_x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    along_x /= np.linalg.norm(along_x)
    T_reference_map = np.eye(4)
    T_reference_map[:3, :3] = np.column_stack([along_x, np.cross(normal, along_x), normal])
    T_reference_map[:3, 3] = target - np.linalg.norm(target) * normal
    return T_reference_map


def _within(points: np.ndarray, x: float, y: float) -> bool:
    (x0, y0), (x1, y1) = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    return bool(x0 <= x <= x1 and y0 <= y <= y1)


def _some(points: np.ndarray, number: int) -> np.ndarray:
    return points[:: max(1, len(points) // number)]


def common_surface(views: Sequence[ChosenView], T_reference_map: np.ndarray) -> Surface:
    """A robust cubic z(x, y) in the map's frame through the targets of all views.

    Raises UserError where their points do not determine one.
    """
    share = FIT_POINTS // len(views)
    points = np.concatenate([_some(view.points_reference_m, share) for view in views])
    x, y, z = transform_points(invert(T_reference_map), points).T
    return fit_surface(x, y, z, SurfaceConfig())


def place(view: ChosenView, T_reference_map: np.ndarray, surface: Surface) -> PlacedView:
    """Follow each pixel's ray from its point to the surface. Two steps: what is left is the square of the surface's
    slope in the map's frame times the deviation (0.3 % of it at 3 degrees)."""
    T_map_view = invert(T_reference_map) @ view.registration.T_reference_view
    inside = view.inside
    points = transform_points(T_map_view, view.cloud.points_m[inside])
    rays = points - T_map_view[:3, 3]
    deviation = points[:, 2] - surface.evaluate(points[:, 0], points[:, 1])
    part = deviation / rays[:, 2]
    moved = points - part[:, None] * rays
    part += (moved[:, 2] - surface.evaluate(moved[:, 0], moved[:, 1])) / rays[:, 2]
    places, deviations = np.full((*inside.shape, 2), np.nan), np.full(inside.shape, np.nan)
    places[inside] = (points - part[:, None] * rays)[:, :2]
    deviations[inside] = deviation
    return PlacedView(view, T_map_view, places, deviations, *_pixel(places, inside, view.cloud.organised))


def _pixel(places: np.ndarray, inside: np.ndarray, organised: bool) -> tuple[np.ndarray, float]:
    """``pixel_m`` and ``pitch_m`` of a `PlacedView`, by medians; without a grid as if the points lay on a square one.

    A pixel is the parallelogram J of its steps by u and v; its variance along x is (Jxu^2 + Jxv^2) / 12.
    """
    if organised and min(inside.shape) > 1:
        by_u, by_v = places[:-1, 1:] - places[:-1, :-1], places[1:, :-1] - places[:-1, :-1]
        known = np.isfinite(by_u + by_v).all(axis=-1)
        if known.any():
            by_u, by_v = _some(by_u[known], FIT_POINTS), _some(by_v[known], FIT_POINTS)
            sides = np.sqrt(np.median(by_u**2, axis=0) + np.median(by_v**2, axis=0))
            areas = np.abs(by_u[:, 0] * by_v[:, 1] - by_u[:, 1] * by_v[:, 0])
            return sides, float(np.sqrt(np.median(areas)))
    extent = np.nanmax(places, axis=(0, 1)) - np.nanmin(places, axis=(0, 1))
    pitch = float(np.sqrt(extent.prod() / inside.sum()))
    return np.array([pitch, pitch]), pitch


def grid_over(views: Sequence[PlacedView], cell_m: float | None) -> CellGrid:
    """Cells over all that any view sees, at whole multiples of the cell (none: the first view's pitch).

    Raises UserError where that would be more than `MAX_CELLS`.
    """
    step = cell_m if cell_m is not None else views[0].pitch_m
    low = np.min([np.nanmin(view.places_m, axis=(0, 1)) for view in views], axis=0)
    high = np.max([np.nanmax(view.places_m, axis=(0, 1)) for view in views], axis=0)
    first, last = np.ceil(low / step), np.floor(high / step)
    columns, rows = (np.maximum(last - first, 0) + 1).astype(int)
    if not columns * rows <= MAX_CELLS:
        raise UserError(
            f"a map of {high[0] - low[0]:.3g} x {high[1] - low[1]:.3g} m with cells of {step * 1e3:.3g} mm would have"
            f" {columns * rows:.3g} cells",
            legal=f"up to {MAX_CELLS:.2g} cells",
            fix="crop the views to the target, or give a larger merge.cell_mm",
        )
    return CellGrid(float(first[0] * step), float(first[1] * step), float(step), (int(rows), int(columns)))
