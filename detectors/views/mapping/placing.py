"""The map's frame and cells, and the views placed in it: where a ray meets the target's surface,
and how far off.

Samples are resampled to a grid over triangles of neighbours, which leaves no gaps and no moire
between two grids. It blurs with a tent whose variance is a sixth of the spacing squared."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import Delaunay

from detectors.surfaces.surface import Surface, SurfaceConfig, fit_surface
from detectors.views.registration.registered import Registration
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud, invert, transform_points

# longest edge, in spacings, of a triangle between samples without a grid: longer edges cross a gap
LONGEST_EDGE = 4.0
# a cell on the edge between two triangles belongs to the first, and rounding must not lose it
SLACK = 1e-9


@dataclass(frozen=True)
class CellGrid:
    """Cells centred at (``x0`` + column * ``step``, ``y0`` + row * ``step``)."""

    x0: float
    """x of the first column, in the unit of the step."""
    y0: float
    """y of the first row."""
    step: float
    """Side of a cell."""
    shape: tuple[int, int]
    """Rows and columns."""

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y (h, w) of the cells."""
        h, w = self.shape
        across = self.x0 + self.step * np.arange(w)
        down = self.y0 + self.step * np.arange(h)
        x, y = np.meshgrid(across, down)
        return x, y


@dataclass(frozen=True)
class Raster:
    """The samples around each cell of a grid (h, w)."""

    weights: Any
    """Sparse (h * w, n): the share of each of n samples in the mean over a cell. A row sums to 1,
    and is empty if less than half of the cell is covered."""
    shape: tuple[int, int]
    """Rows and columns of the grid."""

    def at_cells(self, values: np.ndarray) -> np.ndarray:
        """Return samples' values (n,) or (n, c) at the cells, (h, w) or (h, w, c); NaN where the
        cell is unknown."""
        means = np.asarray(self.weights @ values.astype(np.float64))
        means[self.weights.getnnz(axis=1) == 0] = np.nan
        return means.reshape(*self.shape, *values.shape[1:])

    @property
    def concentration(self) -> np.ndarray:
        """Return the sum of squares (h, w) of the samples' weights: the factor of independent
        errors' variance."""
        squares = self.weights.multiply(self.weights)
        return np.asarray(squares.sum(axis=1), np.float64).reshape(self.shape)


def raster_between(
    sample_xy: np.ndarray,
    valid: np.ndarray,
    organised: bool,
    spacing: float,
    grid: CellGrid,
) -> Raster:
    """Return the `Raster` of a grid over the ``valid`` samples at ``sample_xy`` (v, u, 2), on a
    pixel grid or not (v = 1). Cells larger than ``spacing``, that of the samples, are divided into
    parts, whose mean they take."""
    parts = max(1, round(grid.step / spacing))
    step = grid.step / parts
    corner = np.array([grid.x0, grid.y0]) - 0.5 * (grid.step - step)
    flat = np.ascontiguousarray((sample_xy.reshape(-1, 2) - corner) / step)
    h, w = grid.shape
    corners = np.full((h * parts, w * parts, 3), -1)
    shares = np.zeros((h * parts, w * parts, 3))
    triangles = _of_grid(valid) if organised else _of_points(sample_xy[0], valid[0])
    _fill(flat, triangles, corners, shares)
    rows, columns = np.nonzero(corners[..., 0] >= 0)
    cells = rows // parts * w + columns // parts
    covered = np.bincount(cells, minlength=h * w)[cells]
    enough = 2 * covered >= parts**2
    rows = rows[enough]
    columns = columns[enough]
    cells = cells[enough]
    covered = covered[enough]
    values = shares[rows, columns] / covered[:, None]
    indices = np.repeat(cells, 3), corners[rows, columns].ravel()
    weights = csr_matrix((values.ravel(), indices), shape=(h * w, len(flat)))
    return Raster(weights, grid.shape)


def _of_grid(valid: np.ndarray) -> np.ndarray:
    """Return triangles (t, 3) of flat indices: two for each four neighbours, or one if one of the
    four is invalid."""
    index = np.arange(valid.size).reshape(valid.shape)
    a = index[:-1, :-1].ravel()
    b = index[:-1, 1:].ravel()
    c = index[1:, :-1].ravel()
    d = index[1:, 1:].ravel()
    has_a = valid.ravel()[a]
    has_b = valid.ravel()[b]
    has_c = valid.ravel()[c]
    has_d = valid.ravel()[d]
    # the diagonal goes from b to c, or from a to d where b or c is invalid
    inner = has_b & has_c
    outer = has_a & has_d & ~inner
    return np.concatenate(
        [
            np.stack([a, b, c], axis=1)[inner & has_a],
            np.stack([b, c, d], axis=1)[inner & has_d],
            np.stack([a, b, d], axis=1)[outer & has_b],
            np.stack([a, c, d], axis=1)[outer & has_c],
        ]
    )


def _of_points(sample_xy: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return triangles (t, 3) of indices of samples (n, 2) without a grid: Delaunay triangles with
    short edges."""
    valid_indices = np.flatnonzero(valid)
    triangles = valid_indices[Delaunay(sample_xy[valid_indices]).simplices.astype(np.int64)]
    edges = sample_xy[triangles] - sample_xy[np.roll(triangles, 1, axis=1)]
    lengths = np.linalg.norm(edges, axis=-1)
    short = lengths <= LONGEST_EDGE * np.median(lengths)
    return triangles[short.all(axis=1)]


@numba.njit(cache=True, nogil=True)
def _fill(
    sample_xy: np.ndarray,
    triangles: np.ndarray,
    corners: np.ndarray,
    shares: np.ndarray,
) -> None:
    """Give each triangle (t, 3) the cells that no earlier triangle has; ``sample_xy`` (n, 2) in
    cells."""
    h, w = corners.shape[:2]
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        ax, ay = sample_xy[a]
        bx, b_y = sample_xy[b]
        cx, cy = sample_xy[c]
        area = (bx - ax) * (cy - ay) - (b_y - ay) * (cx - ax)
        if not abs(area) > 1e-12:
            continue
        first_column = max(0, int(np.ceil(min(ax, bx, cx) - SLACK)))
        right = min(w - 1, int(np.floor(max(ax, bx, cx) + SLACK)))
        top = max(0, int(np.ceil(min(ay, b_y, cy) - SLACK)))
        bottom = min(h - 1, int(np.floor(max(ay, b_y, cy) + SLACK)))
        for row in range(top, bottom + 1):
            for column in range(first_column, right + 1):
                of_b = ((column - ax) * (cy - ay) - (row - ay) * (cx - ax)) / area
                of_c = ((bx - ax) * (row - ay) - (b_y - ay) * (column - ax)) / area
                of_a = 1.0 - of_b - of_c
                if corners[row, column, 0] < 0 and min(of_a, of_b, of_c) >= -SLACK:
                    corners[row, column, 0] = a
                    corners[row, column, 1] = b
                    corners[row, column, 2] = c
                    shares[row, column, 0] = of_a
                    shares[row, column, 1] = of_b
                    shares[row, column, 2] = of_c


FIT_POINTS = 20_000
# cosine between optical axis and surface normal below which the axis does not locate the target
STEEPEST = 0.1
MAX_CELLS = 1 << 24  # most cells of a map: those of a board of 4 m in millimetres


@dataclass(frozen=True)
class ChosenView:
    """A view to be merged."""

    name: str
    """Name of the view."""
    cloud: Cloud
    """Its cloud, camera frame."""
    inside: np.ndarray
    """(h, w) bool: valid pixels of the target."""
    registration: Registration
    """Its pose relative to the first view."""

    @property
    def known_covariance(self) -> bool:
        """True where the registration states its covariance."""
        return bool(np.isfinite(self.registration.covariance).all())

    @cached_property
    def points_reference_m(self) -> np.ndarray:
        """The target's points (n, 3) in the first view's frame, in the order of the grid."""
        return transform_points(
            self.registration.T_reference_view, self.cloud.points_m[self.inside]
        )

    @cached_property
    def slope_step(self) -> float:
        """Median step of x/z and y/z between pixels; without a grid, that of a square grid with as
        many points."""
        points = self.cloud.points_m
        with np.errstate(invalid="ignore"):
            slopes = points[..., :2] / points[..., 2:]
        slopes[~self.inside] = np.nan
        if self.cloud.organised and min(self.inside.shape) > 1:
            along_rows = np.abs(np.diff(slopes[..., 0], axis=1))
            along_columns = np.abs(np.diff(slopes[..., 1], axis=0))
            steps = np.concatenate([along_rows.ravel(), along_columns.ravel()])
            if np.isfinite(steps).any():
                return float(np.nanmedian(steps))
        extent = np.nanmax(slopes, axis=(0, 1)) - np.nanmin(slopes, axis=(0, 1))
        return float(np.sqrt(extent.prod() / self.inside.sum()))


@dataclass(frozen=True)
class PlacedView:
    """A view in the map's frame; NaN outside the target."""

    chosen: ChosenView
    T_map_view: np.ndarray
    """(4, 4): from the view's camera frame to the map's."""
    places_m: np.ndarray
    """(h, w, 2): x, y where each pixel's ray meets the surface."""
    deviation_m: np.ndarray
    """(h, w): how far behind (+) the surface, along z, the ray ends."""
    pixel_m: np.ndarray
    """(2,): sides along x and y of a rectangle that spreads as far as a pixel on the surface."""
    pitch_m: float
    """Side of a square with that pixel's area."""


def T_reference_map_of(first: ChosenView) -> np.ndarray:
    """Return the map's frame in the first view's camera frame (4, 4), from the plane through its
    target by least absolute residuals. z points away from the viewer along the plane's normal, x
    as near as possible to the camera's x. The origin is in front of the point where the optical
    axis meets the plane, at the camera's distance; if the axis meets no target, it is in front of
    the target's middle."""
    points = _some(first.cloud.points_m[first.inside], FIT_POINTS)
    x, y, z = points.T
    plane = fit_surface(x, y, z, SurfaceConfig(degree=1))
    z0, zx, zy = plane.evaluate(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    normal = np.array([z0 - zx, z0 - zy, 1.0])
    normal /= np.linalg.norm(normal)
    in_front = normal[2] > STEEPEST and z0 > 0
    if in_front and x.min() <= 0 <= x.max() and y.min() <= 0 <= y.max():
        target = np.array([0.0, 0.0, z0])
    else:
        target = np.median(points, axis=0)
    along_x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    along_x /= np.linalg.norm(along_x)
    T_reference_map = np.eye(4)
    T_reference_map[:3, :3] = np.column_stack([along_x, np.cross(normal, along_x), normal])
    T_reference_map[:3, 3] = target - np.linalg.norm(target) * normal
    return T_reference_map


def _some(points: np.ndarray, number: int) -> np.ndarray:
    return points[:: max(1, len(points) // number)]


def common_surface(views: Sequence[ChosenView], T_reference_map: np.ndarray) -> Surface:
    """Fit a robust cubic z(x, y) in the map's frame through all targets. Raises UserError if they
    give none."""
    points = np.concatenate(
        [_some(view.points_reference_m, FIT_POINTS // len(views)) for view in views]
    )
    x, y, z = transform_points(invert(T_reference_map), points).T
    return fit_surface(x, y, z, SurfaceConfig())


def place(
    view: ChosenView,
    T_reference_map: np.ndarray,
    surface: Surface,
) -> PlacedView:
    """Follow each pixel's ray from its point to the surface in two steps; the remaining error is
    the squared slope of the surface times the deviation (0.3 % of it at 3 degrees). Pixel sizes
    are medians; without a grid, points count as if on a square grid. A pixel is the parallelogram
    J of its steps, of variance (Jxu^2 + Jxv^2) / 12 along x."""
    T_map_view = invert(T_reference_map) @ view.registration.T_reference_view
    inside = view.inside
    points = transform_points(T_map_view, view.cloud.points_m[inside])
    rays = points - T_map_view[:3, 3]
    deviation = points[:, 2] - surface.evaluate(points[:, 0], points[:, 1])
    # share of the ray by which its end is moved back
    part = deviation / rays[:, 2]
    moved = points - part[:, None] * rays
    left_m = moved[:, 2] - surface.evaluate(moved[:, 0], moved[:, 1])
    part += left_m / rays[:, 2]
    places_m = np.full((*inside.shape, 2), np.nan)
    deviations = np.full(inside.shape, np.nan)
    places_m[inside] = (points - part[:, None] * rays)[:, :2]
    deviations[inside] = deviation
    if view.cloud.organised and min(inside.shape) > 1:
        by_u = places_m[:-1, 1:] - places_m[:-1, :-1]
        by_v = places_m[1:, :-1] - places_m[:-1, :-1]
        finite = np.isfinite(by_u + by_v).all(axis=-1)
        if finite.any():
            by_u = _some(by_u[finite], FIT_POINTS)
            by_v = _some(by_v[finite], FIT_POINTS)
            sides = np.sqrt(np.median(by_u**2, axis=0) + np.median(by_v**2, axis=0))
            areas = np.abs(by_u[:, 0] * by_v[:, 1] - by_u[:, 1] * by_v[:, 0])
            pitch = float(np.sqrt(np.median(areas)))
            return PlacedView(
                chosen=view,
                T_map_view=T_map_view,
                places_m=places_m,
                deviation_m=deviations,
                pixel_m=sides,
                pitch_m=pitch,
            )
    extent = np.nanmax(places_m, axis=(0, 1)) - np.nanmin(places_m, axis=(0, 1))
    pitch = float(np.sqrt(extent.prod() / inside.sum()))
    return PlacedView(
        chosen=view,
        T_map_view=T_map_view,
        places_m=places_m,
        deviation_m=deviations,
        pixel_m=np.array([pitch, pitch]),
        pitch_m=pitch,
    )


def grid_over(views: Sequence[PlacedView], cell_m: float | None) -> CellGrid:
    """Return cells over all that any view sees, at whole multiples of the cell (None: the first
    view's pitch)."""
    step = cell_m if cell_m is not None else views[0].pitch_m
    low = np.min([np.nanmin(view.places_m, axis=(0, 1)) for view in views], axis=0)
    high = np.max([np.nanmax(view.places_m, axis=(0, 1)) for view in views], axis=0)
    first = np.ceil(low / step)
    last = np.floor(high / step)
    columns, rows = (np.maximum(last - first, 0) + 1).astype(int)
    if not columns * rows <= MAX_CELLS:
        width, height = high - low
        problem = (
            f"a map of {width:.3g} x {height:.3g} m with cells of {step * 1e3:.3g} mm would have "
            f"{columns * rows:.3g}"
        )
        raise UserError(
            problem,
            legal=f"up to {MAX_CELLS:.2g} cells",
            fix="crop the views to the target, or give a larger merge.cell_mm",
        )
    return CellGrid(
        x0=float(first[0] * step),
        y0=float(first[1] * step),
        step=float(step),
        shape=(int(rows), int(columns)),
    )
