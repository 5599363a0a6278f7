"""Fusion in the target's frame: registered views to one 2.5-D map over the fitted surface, with its variance.

Each pixel's depth counts as a height over the surface at the place where its *ray meets the surface*. On an intact
surface that is the point itself; at a hole it is the mouth, which thereby lies in one place for all views, where the
points behind it, shifted by depth times the tangent of the viewing angle, would smear it. What lies at the bottom of a
wide hole, or stands out before the surface, is displaced by as much in a view that is slanted.

Blur is added by linear interpolation only: `detectors.mapping.raster`. Not modelled: correlation between the errors of
registrations to one reference; changes of the blur between views (all count with the reference's).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from detectors.mapping.between_views import BetweenViews, between_views
from detectors.mapping.chosen_views import ChosenView
from detectors.mapping.combine import Combined, combine
from detectors.mapping.depth_noise import noise_of
from detectors.mapping.placing import PlacedView, T_reference_map_of, common_surface, grid_over, place
from detectors.mapping.raster import CellGrid
from detectors.mapping.surface_map import SurfaceMap
from detectors.surface import Surface, SurfaceConfig, fit_surface
from harness.vocabulary.capture import MapViews
from harness.vocabulary.geometry import invert, transform_points

LATERAL_PX = 0.1
"""Standard deviation of where a pixel looks: the reprojection error of a well calibrated lens."""
SMOOTH_POINTS = 8192
"""Points to which a single view's own smooth surface is fitted, and of which medians are taken."""


@dataclass(frozen=True)
class _Sheet:
    """The surface on the map's cells. ``points_m`` (h, w, 3) and ``gradient`` (h, w, 3): (-dz/dx, -dz/dy, 1), whose
    product with a small displacement is the change of height along z."""

    grid: CellGrid
    points_m: np.ndarray
    gradient: np.ndarray

    @classmethod
    def of(cls, grid: CellGrid, surface: Surface) -> _Sheet:
        x, y = np.meshgrid(grid.x, grid.y)
        z = surface.evaluate(x, y)
        by_x = (surface.evaluate(x + grid.step, y) - z) / grid.step
        by_y = (surface.evaluate(x, y + grid.step) - z) / grid.step
        return cls(grid, np.stack([x, y, z], axis=-1), np.stack([-by_x, -by_y, np.ones_like(z)], axis=-1))


@dataclass(frozen=True)
class _Observed:
    """One view on the map's cells, (h, w) each, NaN where it has nothing: height, its variance by the sensor's law and
    by lens and registration, samples, the direction to the camera (h, w, 3) and that from it in pixels (h, w, 2).
    ``repeated``: the sensor's law was read off repeated frames."""

    height: np.ndarray
    sensor: np.ndarray
    other: np.ndarray
    samples: np.ndarray
    direction: np.ndarray
    looks_px: np.ndarray
    repeated: bool
    rgb: np.ndarray | None
    amplitude: np.ndarray | None


def fuse(views: Sequence[ChosenView], cell_m: float | None) -> tuple[SurfaceMap, tuple[str, ...]]:
    """The map, and what a user should know about it.

    Raises UserError where the points do not determine a surface or the map would have too many cells.
    """
    T_reference_map = T_reference_map_of(views[0])
    surface = common_surface(views, T_reference_map)
    placed = [place(view, T_reference_map, surface) for view in views]
    sheet = _Sheet.of(grid_over(placed, cell_m), surface)
    observed = [_observe(view, sheet, T_reference_map, views[0].slope_step) for view in placed]
    heights, sensor, other, looks_px = (
        np.stack([getattr(o, name) for o in observed]) for name in ("height", "sensor", "other", "looks_px")
    )
    between = between_views(heights, sensor, other, looks_px, all(o.repeated for o in observed))
    found = combine(heights, sensor, other, looks_px, between)
    return _map(placed, sheet, T_reference_map, observed, found, between), _notes(views, found, between)


def _observe(view: PlacedView, sheet: _Sheet, T_reference_map: np.ndarray, slope_step: float) -> _Observed:
    """One view's heights on the cells with their variances."""
    cloud = view.chosen.cloud
    grid = sheet.grid
    raster = view.raster(grid)
    deviation = view.deviation_m.reshape(-1)
    noise = noise_of(cloud, view.inside, _roughness(view))
    direction, per_range, across, looks = _sight_lines(
        sheet.points_m, sheet.gradient, view.camera_m, invert(view.T_map_view)[:3, :3], slope_step
    )
    slope = np.sqrt(np.einsum("...i,...i->...", cloud.points_m, cloud.points_m)) / cloud.points_m[..., 2]
    range_variance = raster.at_cells((noise.mean_variance(cloud) * slope**2).reshape(-1))
    correlation = _neighbour_correlation(view)
    kept = correlation + (1.0 - correlation) * raster.concentration
    sensor = range_variance * kept * per_range**2
    lateral = (LATERAL_PX * view.pitch_m) ** 2 * across
    rgb, amplitude = cloud.rgb, cloud.amplitude
    return _Observed(
        height=raster.at_cells(deviation),
        sensor=sensor,
        other=lateral + _registration_variance(view, sheet, T_reference_map),
        samples=raster.at_cells(cloud.count.reshape(-1).astype(np.float64)),
        direction=direction,
        looks_px=looks,
        repeated=noise.source == "frames",
        rgb=None if rgb is None else raster.at_cells(rgb.reshape(-1, 3).astype(np.float64)),
        amplitude=None if amplitude is None else raster.at_cells(amplitude.reshape(-1)),
    )


@numba.njit(cache=True, nogil=True)
def _sight_lines(
    points: np.ndarray, gradient: np.ndarray, camera: np.ndarray, R_view_map: np.ndarray, slope_step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return for cells (h, w): unit direction to the camera (h, w, 3), change of height per metre along the ray, square
    of the greatest change per metre across it, and x/z, y/z in the view's frame in the first view's pixels (h, w,
    2)."""
    h, w = points.shape[:2]
    direction, looks = np.empty((h, w, 3)), np.empty((h, w, 2))
    per_range, across = np.empty((h, w)), np.empty((h, w))
    for row in range(h):
        for column in range(w):
            x, y, z = points[row, column] - camera
            a, b, c = gradient[row, column]
            distance = np.sqrt(x * x + y * y + z * z)
            along = (x * a + y * b + z * c) / distance
            direction[row, column] = (-x / distance, -y / distance, -z / distance)
            per_range[row, column] = along
            across[row, column] = max(a * a + b * b + c * c - along * along, 0.0)
            depth = R_view_map[2, 0] * x + R_view_map[2, 1] * y + R_view_map[2, 2] * z
            for k in range(2):
                seen = R_view_map[k, 0] * x + R_view_map[k, 1] * y + R_view_map[k, 2] * z
                looks[row, column, k] = seen / depth / slope_step
    return direction, per_range, across, looks


def _roughness(view: PlacedView) -> np.ndarray:
    """(h, w) z less the view's own smooth surface; only needed, and only worked out, where frames do not repeat."""
    rough = np.full(view.inside.shape, np.nan)
    inside = view.inside
    if (view.chosen.cloud.count[inside] > 1).any():
        return rough
    x, y = view.places_m[inside].T
    z = view.deviation_m[inside]
    every = slice(None, None, max(1, len(z) // SMOOTH_POINTS))
    rough[inside] = z - fit_surface(x[every], y[every], z[every], SurfaceConfig()).evaluate(x, y)
    return rough


def _neighbour_correlation(view: PlacedView) -> float:
    """Return the correlation of neighbouring pixels' deviations, 0..1, from medians; 1 without a pixel grid.

    A smooth misfit of the surface counts as correlation, so that the variance is rather stated too large.
    """
    if not view.chosen.cloud.organised:
        return 1.0
    d = view.deviation_m
    middle = _median(d)
    single = _median(np.abs(d - middle))
    step = _median(np.concatenate([np.abs(np.diff(d, axis=0)).ravel(), np.abs(np.diff(d, axis=1)).ravel()]))
    if not (single > 0 and np.isfinite(step)):
        return 1.0
    return float(np.clip(1.0 - 0.5 * (step / single) ** 2, 0.0, 1.0))


def _median(values: np.ndarray) -> float:
    """Return the median of some of the finite values, evenly taken; NaN where there is none."""
    known = values[np.isfinite(values)]
    return float(np.median(known[:: max(1, len(known) // SMOOTH_POINTS)])) if len(known) else np.nan


def _registration_variance(view: PlacedView, sheet: _Sheet, T_reference_map: np.ndarray) -> np.ndarray:
    """(h, w) of the height, from the registration's covariance; 0 where the method has none."""
    registration = view.chosen.registration
    if not np.isfinite(registration.covariance).all():
        return np.zeros(sheet.grid.shape)
    turn = np.kron(np.eye(2), T_reference_map[:3, :3])
    centre = transform_points(invert(T_reference_map), registration.centre_m)
    variance: np.ndarray = _spread_along(
        sheet.points_m, sheet.gradient, centre, np.ascontiguousarray(turn.T @ registration.covariance @ turn)
    )
    return variance


@numba.njit(cache=True, nogil=True)
def _spread_along(points: np.ndarray, along: np.ndarray, centre: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(h, w) variance of the displacements w x (p - centre) + t of points (h, w, 3) along vectors (h, w, 3): that of
    w . ((p - centre) x along) + t . along."""
    h, w = points.shape[:2]
    spread = np.empty((h, w))
    lever = np.empty(6)
    for row in range(h):
        for column in range(w):
            a, b, c = along[row, column]
            x, y, z = points[row, column] - centre
            lever[:] = (y * c - z * b, z * a - x * c, x * b - y * a, a, b, c)
            total = 0.0
            for i in range(6):
                for j in range(6):
                    total += lever[i] * covariance[i, j] * lever[j]
            spread[row, column] = max(total, 0.0)
    return spread


def _map(
    placed: Sequence[PlacedView],
    sheet: _Sheet,
    T_reference_map: np.ndarray,
    observed: Sequence[_Observed],
    found: Combined,
    between: BetweenViews,
) -> SurfaceMap:
    used = found.used
    towards = sum(np.where(u[..., None], o.direction, 0.0) for u, o in zip(used, observed, strict=True))
    number = used.sum(axis=0)
    length = np.linalg.norm(towards, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        direction = towards / length[..., None]
        spread = np.rad2deg(np.sqrt(np.maximum(2.0 * (1.0 - length / number), 0.0)))
    samples = sum(np.where(u, o.samples, 0.0) for u, o in zip(used, observed, strict=True))
    return SurfaceMap(
        T_reference_map=T_reference_map,
        views=tuple(view.chosen.prepared.view.name for view in placed),
        map_views=_map_views(placed, found),
        x_m=sheet.grid.x,
        y_m=sheet.grid.y,
        cell_m=sheet.grid.step,
        surface_z_m=sheet.points_m[..., 2],
        height_m=found.height_m,
        variance_m2=found.variance_m2,
        temporal_m2=found.temporal_m2,
        spread_m2=found.spread_m2,
        samples=np.round(samples).astype(np.int32),
        seen_by=used,
        direction=direction,
        direction_spread_deg=spread,
        rejected=found.rejected,
        between=between,
        rgb=_mean_colour([o.rgb for o in observed], found),
        amplitude=_mean_amplitude([o.amplitude for o in observed], found),
    )


def _map_views(placed: Sequence[PlacedView], found: Combined) -> MapViews:
    shares = found.shares.sum(axis=(1, 2))
    shares = shares / shares.sum()
    x, y = np.sqrt(shares @ np.stack([view.pixel_m for view in placed]) ** 2)
    return MapViews(np.stack([view.T_map_view for view in placed]), shares, (float(x), float(y)))


def _mean_colour(colours: Sequence[np.ndarray | None], found: Combined) -> np.ndarray | None:
    """(h, w, 3) uint8 by the heights' weights; None where a view has no colour."""
    known = [colour for colour in colours if colour is not None]
    if len(known) < len(colours):
        return None
    mean = sum(share[..., None] * np.nan_to_num(c) for share, c in zip(found.shares, known, strict=True))
    return np.asarray(np.round(mean), dtype=np.uint8)


def _mean_amplitude(amplitudes: Sequence[np.ndarray | None], found: Combined) -> np.ndarray | None:
    """(h, w) as `_mean_colour`, NaN where no view counts."""
    known = [amplitude for amplitude in amplitudes if amplitude is not None]
    if len(known) < len(amplitudes):
        return None
    mean = sum(share * np.nan_to_num(a) for share, a in zip(found.shares, known, strict=True))
    return np.where(np.isfinite(found.height_m), mean, np.nan)


def _notes(views: Sequence[ChosenView], found: Combined, between: BetweenViews) -> tuple[str, ...]:
    notes: list[str] = []
    if len(views) == 1:
        notes.append("one view: errors fixed for a view (pattern, wiggling) cannot be told, its variance has none")
    else:
        notes.append(
            f"fixed pattern {1e3 * np.sqrt(between.pattern_m2):.3f} mm over {between.length_px:.1f} px of the sensor,"
            f" other differences between views {1e3 * np.sqrt(between.own_m2):.3f} mm"
        )
    without = [v.prepared.view.name for v in views if not np.isfinite(v.registration.covariance).all()]
    if without:
        notes.append(f"registered without a covariance, so counted among those differences: {', '.join(without)}")
    if found.rejected:
        notes.append(f"{found.rejected} of {int(found.used.sum()) + found.rejected} observations were outliers")
    return tuple(notes)
