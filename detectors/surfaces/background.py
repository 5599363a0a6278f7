"""The undamaged surface behind a cloud: its shape is chosen by evidence, and its goodness of fit
is judged.

Each shape is fitted to the medians of cells of some 16 pixels or more, and predicts tiles of cells
that were left out of the fit; the simplest shape whose errors are not significantly larger than
the best shape's is taken. If neighbouring cells still depart together, smooth free forms of ever
shorter wavelength are tried. Not modelled: creases, several sheets, surfaces with real structure
as small as damage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np

from detectors.pixels.masks import grown, on_grid
from detectors.pixels.medians import group_medians, row_medians
from detectors.pixels.noise import median_of, rounding_floor, sigma_of
from detectors.surfaces.extruded import Profile, direction_of, profiled
from detectors.surfaces.free_form import free_form, picture_places
from detectors.surfaces.shared import shared, stated_surface
from detectors.surfaces.surface import (
    BISQUARE_TUNING,
    Surface,
    SurfaceConfig,
    SurfaceFunction,
    along_rays,
    bisquare_weights,
    fit_surface,
    polynomial,
    quadric,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, ExpectedSurface

MOST_CELLS = 3600
CELL_POINTS = 16  # least number of points in a cell
EVEN_CELL_POINTS = 64  # points in a cell where there are enough
ENOUGH_CELLS = 600
FEW_CELLS = 40
"""Fewest cells to choose a shape."""
TILE_CELLS = 3  # side, in cells, of a tile that is predicted as a whole
FOLDS = 5
"""Number of folds into which the tiles are dealt."""
# largest width of damage, unless the settings differ: no free form that could follow it is chosen
LEAST_SCALE_M = 0.04
# a shape is as good as the best if its error of prediction is larger by at most this share of the
# noise
WORTH = 0.1
# five standard errors of the median of 49 deviations of 16 pixels each; below it, noise counts as
# even
NOISIER = 1.25
STEEPEST_DEG = 75.0
"""Incidence beyond which a surface is not judged: a pixel covers 4 times its width there, and its
noise grows."""
FREE_FORM_FROM = 0.02  # share of the area with structure from which a free form is tried
MISFIT_FROM = 0.1
"""Share of the area with structure from which a warning of a misfit is given."""
MISFIT_AT_RIM_FROM = 0.05
"""The same for what lies off the surface at the rim, where other surfaces come into view."""
STATED = ("polynomial", "expected")  # shapes that the user states
STRUCTURE_CELLS = 5  # side of the block averaged to see structure
STRUCTURE_SIGMAS = 4.0  # least significance of structure
SEEN = 0.5
"""Least size of structure, as a share of a pixel's noise."""


@dataclass(frozen=True)
class Background:
    """The surface without its damage; maps are NaN where it is not judged."""

    surface_z_m: np.ndarray
    """(h, w): z of the surface, metres."""
    residual_m: np.ndarray
    """(h, w): z of the cloud minus the surface, metres."""
    noise_m: np.ndarray
    """(h, w): standard deviation of the residuals nearby, without the surface's own misfit."""
    spread_m: np.ndarray
    """(h, w): standard deviation of the surface itself, metres: 0 except beside steps of a
    profile."""
    description: str
    """The shape's name and limits, as programs print them."""
    scale_m: float | None
    """Width above which a free form follows shallow damage; None for other shapes."""
    warning: str
    """A sentence if remaining structure could be mistaken for damage; else empty."""
    notes: dict[str, Any]
    """Facts by name, as they are recorded."""


@dataclass(frozen=True)
class _Cells:
    """A grid of small cells of the picture, each with the median of its points."""

    # a ray through each cell and its median z (c, 3), metres
    points: np.ndarray
    # weight of each cell (c,): 1 if it is full
    weights: np.ndarray
    # standard deviation of a pixel in each cell (c,), metres
    noise: np.ndarray
    # standard deviation of a cell's median, metres
    level_noise: float
    # each point's cell (n,), or -1
    cell_of_point: np.ndarray
    # each cell's row and column on the grid (c,)
    row: np.ndarray
    column: np.ndarray
    # side of a cell in the picture's units, and in metres
    side: float
    side_m: float
    # whether rays leave the origin, else they are parallel
    central: bool

    def image(self, values: np.ndarray, empty: float = np.nan) -> np.ndarray:
        """Return cells' values (c,) on their grid."""
        rows = self.row.max() + 1
        columns = self.column.max() + 1
        image = np.full((rows, columns), empty)
        image[self.row, self.column] = values
        return image

    @property
    def pixel_noise(self) -> float:
        """Return the standard deviation of a pixel: about its cell's median, combined with that of
        the median."""
        within = median_of(self.noise[np.isfinite(self.noise)])
        return float(np.hypot(within, self.level_noise))

    def refreshed(self, residuals: np.ndarray, fit: SurfaceFunction) -> _Cells:
        """Return the cells with medians and deviations of the points' residuals (n,); some cells
        are then dropped."""
        medians, deviations = group_medians(residuals, self.cell_of_point, len(self.points))
        z = fit(self.points) + medians
        is_judged = np.isfinite(z)
        moved = self.points.copy()
        if self.central:
            moved = self.points * (z / self.points[:, 2])[:, None]
        moved[:, 2] = z
        moved[~is_judged] = self.points[~is_judged]
        return replace(
            self,
            points=moved,
            weights=np.where(is_judged, self.weights, 0.0),
            noise=deviations,
            level_noise=_cell_noise(self.image(medians))[0],
        )


class _Shape(NamedTuple):
    """A kind of surface, fitted to cells."""

    name: str
    # fits this kind of surface to points (c, 3) with weights (c,)
    fit_to: Callable[[np.ndarray, np.ndarray], SurfaceFunction | None]
    # the fit to all cells
    fit: SurfaceFunction
    # the cells' robust weights (c,) in that fit
    weights: np.ndarray
    # shortest wave of a free form, in the picture's units
    wavelength: float | None


def background(cloud: Cloud, mask: np.ndarray, config: SurfaceConfig) -> Background:
    """Choose, fit and judge the surface of the cloud's points where ``mask`` (h, w) is true.
    Deterministic. Raises UserError if the points do not determine it."""
    points = np.ascontiguousarray(cloud.points_m[mask])
    central = cloud.projection == "central"
    cells = _cells(points, cloud)
    if cells is None:
        return _of_few_points(cloud, points, mask, config)
    wavelength = None
    profile = None
    reference = _reference(cloud, config)
    if reference is not None:
        name = reference.text
        fit = reference.z_at
    elif config.shape in STATED:
        surface = shared(stated_surface, cloud, mask, config)
        name, fit = _named(surface, points, config, central)
    else:
        shape, cells, profile = _shape_of(points, cells, config, rounding_floor(cloud, mask))
        name = shape.name
        fit = shape.fit
        wavelength = shape.wavelength

    fitted = fit(points)
    residuals = points[:, 2] - fitted
    unseen = _unseen(points, cells, fit, fitted)
    if unseen.all():
        problem = (
            f"the whole target is seen at more than {STEEPEST_DEG:g} degrees, "
            "where nothing is judged"
        )
        raise UserError(problem, fix="choose another target or crop, or record it from its front")
    fitted[unseen] = np.nan
    cells = cells.refreshed(residuals, fit)
    warning, notes = _misfit(cells, fit, name)
    notes.update(shape=name, steep_share=float(unseen.mean()))
    if reference is not None:
        notes["reference"] = reference.facts
    text = name
    scale_m = None
    if wavelength is not None:
        scale_m = 0.5 * wavelength * cells.side_m / cells.side
        text += f", which absorbs shallow damage wider than {scale_m / MM:.0f} mm"
    if unseen.mean() > 0.001:
        steep = f"seen at more than {STEEPEST_DEG:g} degrees"
        if reference is not None:
            steep += " or at an edge of the reference"
        text += f"; {100 * unseen.mean():.1f} % of the target, {steep}, is not judged"
    spread_m = np.zeros(len(points))
    if profile is not None:
        spread_m = profile.spread_at(points)
    elif reference is not None:
        spread_m = _spread_of(reference, points, unseen)
    return Background(
        surface_z_m=on_grid(fitted, mask),
        residual_m=on_grid(points[:, 2] - fitted, mask),
        noise_m=on_grid(np.hypot(_noise_of_points(cells), spread_m), mask),
        spread_m=on_grid(spread_m, mask),
        description=text,
        scale_m=scale_m,
        warning=warning,
        notes=notes,
    )


def _of_few_points(
    cloud: Cloud, points: np.ndarray, mask: np.ndarray, config: SurfaceConfig
) -> Background:
    """Return the stated surface, or a plane, behind points (n, 3) that are too few to judge it."""
    reference = _reference(cloud, config)
    if reference is not None:
        name = reference.text
        fit = reference.z_at
    else:
        if config.shape not in STATED:
            config = SurfaceConfig(degree=1)
        surface = shared(stated_surface, cloud, mask, config)
        name, fit = _named(surface, points, config, cloud.projection == "central")
    fitted = fit(points)
    residuals = points[:, 2] - fitted
    noise_m = sigma_of(residuals)
    return Background(
        surface_z_m=on_grid(fitted, mask),
        residual_m=on_grid(residuals, mask),
        noise_m=np.where(mask, noise_m, np.nan),
        spread_m=np.where(mask, 0.0, np.nan),
        description=name,
        scale_m=None,
        warning=f"{len(points)} points are too few to tell whether the surface ({name}) fits",
        notes={"shape": name, "local_noise_m": noise_m, "misfit_share": None},
    )


def _reference(cloud: Cloud, config: SurfaceConfig) -> ExpectedSurface | None:
    """Return the surface that a reference says the cloud should show; None if the surface is fitted
    to it. Raises UserError if the cloud has none."""
    if config.shape != "expected":
        return None
    if cloud.expected is None:
        raise UserError(
            "surface.shape: expected compares with a reference, and the cloud has none",
            fix="state it with --reference of tofpod detect, or choose another shape",
        )
    return cloud.expected


def _spread_of(reference: ExpectedSurface, points: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """Return the standard deviation (n,) of the reference at points (n, 3) by its noise, by how
    parts differ and by its placement; 0 where nothing is judged."""
    spread_m = np.hypot(reference.spread_at(points), reference.registration_at(points))
    return np.where(unseen, 0.0, spread_m)


def _shape_of(
    points: np.ndarray, cells: _Cells, config: SurfaceConfig, rounding_m: float
) -> tuple[_Shape, _Cells, Profile | None]:
    """Choose the shape of points (n, 3), refine its fit with cells centred on it, and return both,
    with the profile that it contains, if any. ``rounding_m``: deviation that rounding leaves in
    the points."""
    sample = points[:: max(1, len(points) // 8192)]
    quadratic = SurfaceConfig(degree=2, method="bisquare")
    surface = fit_surface(sample[:, 0], sample[:, 1], sample[:, 2], quadratic)
    _, start = _named(surface, sample, quadratic, cells.central)
    cells = cells.refreshed(points[:, 2] - start(points), start)
    shapes, errors = _formula_shapes(cells)
    worth = WORTH * cells.pixel_noise
    best = shapes[_simplest(errors, worth)]
    base = shapes[int(np.argmin([tile_errors.mean() for tile_errors in errors]))]
    profile = None
    if config.shape == "auto":
        profile = _profile(points, cells, start, best, rounding_m)
    if profile is not None:
        cells = cells.refreshed(points[:, 2] - profile(points), profile)
        best = _extruded_shape(profile, cells)
        base = best
    shape, cells = _refined(points, cells, _with_free_form(cells, best, base, config))
    return shape, cells, profile


def _profile(
    points: np.ndarray, cells: _Cells, start: SurfaceFunction, best: _Shape, rounding_m: float
) -> Profile | None:
    """Return the extruded surface of points (n, 3), if it explains them better than the ``best``
    smooth shape; ``start`` is a surface of degree 2. ``rounding_m``: deviation that rounding
    leaves."""
    in_cells = cells.cell_of_point[cells.cell_of_point >= 0]
    pitch = cells.side / float(np.sqrt(np.median(np.bincount(in_cells))))
    directed = direction_of(points, start, pitch, cells.central)
    if directed is None:
        return None
    smooth, _ = _refined(points, cells, best)
    return profiled(directed, smooth.fit, points, rounding_m)


def _refined(points: np.ndarray, cells: _Cells, shape: _Shape) -> tuple[_Shape, _Cells]:
    """Return the shape fitted to cells that are centred on it, and these."""
    for _ in range(2):
        cells = cells.refreshed(points[:, 2] - shape.fit(points), shape.fit)
        refined = _fitted(cells, shape.name, shape.fit_to, shape.wavelength, widened=True)
        shape = refined or shape
    return shape, cells


def _unseen(
    points: np.ndarray, cells: _Cells, fit: SurfaceFunction, fitted: np.ndarray
) -> np.ndarray:
    """Return which points (n, 3) have no surface (``fitted`` (n,) is NaN), or too steep a one."""
    unseen = ~np.isfinite(fitted)
    if cells.central:
        # only the few pixels near the steepest incidence are examined one by one; a ray that
        # misses the surface beside the pixel gives NaN, which is not below the limit either
        is_steep = _incidence_deg(cells.points, fit, cells.side) > STEEPEST_DEG - 20.0
        examined = np.flatnonzero((cells.cell_of_point < 0) | is_steep[cells.cell_of_point])
        incidence_deg = _incidence_deg(points[examined], fit, 0.1 * cells.side)
        unseen[examined] |= ~(incidence_deg < STEEPEST_DEG)
    return unseen


def _noise_of_points(cells: _Cells) -> np.ndarray:
    """Return a pixel's noise (n,) near each point's cell: the target's median, or the median over
    7 x 7 cells if that is much larger."""
    padded = np.pad(cells.image(cells.noise), 3, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (7, 7))
    around = windows[cells.row, cells.column].reshape(-1, 49)
    pixel = cells.pixel_noise
    medians = row_medians(around)
    local = np.where(np.isfinite(medians), np.hypot(medians, cells.level_noise), pixel)
    of_cells = np.where(local > NOISIER * pixel, local, pixel)
    return np.where(cells.cell_of_point >= 0, of_cells[cells.cell_of_point], pixel)


def misfit(cloud: Cloud, residual_m: np.ndarray, surface: str) -> str:
    """Return a sentence if a stated ``surface`` leaves structure like damage in ``residual_m`` (h,
    w), else ""."""
    mask = np.isfinite(residual_m)
    cells = _cells(cloud.points_m[mask], cloud)
    if cells is None:
        return ""
    medians, deviations = group_medians(residual_m[mask], cells.cell_of_point, len(cells.points))
    level_noise = _cell_noise(cells.image(medians))[0]
    flat = np.column_stack([cells.points[:, :2], medians])
    level = replace(cells, points=flat, noise=deviations, level_noise=level_noise)
    return _misfit(level, lambda p: np.zeros(len(p)), surface)[0]


def _named(
    surface: Surface, points: np.ndarray, config: SurfaceConfig, central: bool
) -> tuple[str, SurfaceFunction]:
    """Return the name of a polynomial through points (n, 3), and its z along their rays.
    ``central``: rays leave the origin, else along z."""

    def z_at(queries: np.ndarray) -> np.ndarray:
        return surface.evaluate(queries[:, 0], queries[:, 1])

    name = f"degree {config.degree}, {surface.note}"
    if central and points[:, 2].min() > 0:
        return name, along_rays(z_at)
    return name, z_at


def _cells(points: np.ndarray, cloud: Cloud) -> _Cells | None:
    """Return the cells of points (n, 3) of a cloud, not yet `refreshed`; None if too few are
    filled."""
    if len(points) < FEW_CELLS * CELL_POINTS:
        return None
    central = cloud.projection == "central" and float(points[:, 2].min()) > 0
    x, y = np.ascontiguousarray(picture_places(points, central).T)
    extent = np.maximum([np.ptp(x), np.ptp(y)], 1e-12)
    even = min(max(CELL_POINTS, len(points) / ENOUGH_CELLS), EVEN_CELL_POINTS)
    wanted = max(even, len(points) / MOST_CELLS)
    side = float(np.sqrt(extent.prod() * wanted / len(points)))
    # the picture may be partly empty: the side is adapted to the cells that are not
    for _ in range(3):
        across = ((x - x.min()) / side).astype(np.int64)
        down = ((y - y.min()) / side).astype(np.int64)
        columns = int(across.max()) + 1
        keys = down * columns + across
        counts = np.bincount(keys)
        usual = median_of(counts[counts > 0].astype(float))
        side *= float(np.sqrt(wanted / max(usual, 1.0)))
    filled = np.flatnonzero(counts >= max(4, wanted / 4))
    if len(filled) < FEW_CELLS:
        return None
    number = np.full(len(counts), -1)
    number[filled] = np.arange(len(filled))
    row, column = np.divmod(filled, columns)

    def means(values: np.ndarray) -> np.ndarray:
        return np.bincount(keys, values)[filled] / counts[filled]

    z = means(points[:, 2])
    lateral = np.column_stack([means(x), means(y)])
    side_m = side
    if central:
        lateral = lateral * z[:, None]
        side_m = side * float(np.median(points[:, 2]))
    return _Cells(
        points=np.column_stack([lateral, z]),
        weights=np.minimum(counts[filled] / wanted, 1.0),
        noise=np.zeros(len(filled)),
        level_noise=0.0,
        cell_of_point=number[keys],
        row=row,
        column=column,
        side=side,
        side_m=side_m,
        central=central,
    )


def _cell_noise(image: np.ndarray) -> tuple[float, float]:
    """Return the deviation of cells' medians and their neighbours' correlation, from second
    differences."""

    def bend(step: int) -> float:
        bends = []
        for values in (image, image.T):
            bend = values[2 * step :] - 2 * values[step:-step] + values[: -2 * step]
            bends.append(bend.ravel())
        differences = np.concatenate(bends)
        differences = differences[np.isfinite(differences)]
        return sigma_of(differences) if len(differences) else 0.0

    adjacent = bend(1)
    second = bend(2)
    # for cells with variance s^2 and correlation r with direct neighbours: (6 - 8 r) s^2 and 6 s^2
    deviation = max(adjacent, second) / np.sqrt(6.0)
    correlation = (6.0 - (adjacent / max(deviation, 1e-12)) ** 2) / 8.0
    return deviation, float(np.clip(correlation, 0.0, 0.5))


def _formula_shapes(cells: _Cells) -> tuple[list[_Shape], list[np.ndarray]]:
    """Return the shapes with few coefficients, simplest first, and each one's errors (tiles,) of
    prediction."""
    shapes: list[_Shape] = []
    errors: list[np.ndarray] = []
    worth = WORTH * cells.pixel_noise
    for name, fit_to in _formulas(cells.central):
        shape = _fitted(cells, name, fit_to, None)
        if shape is not None:
            shapes.append(shape)
            errors.append(_prediction_errors(cells, shape))
        # the search ends after two more that predict no better
        if len(shapes) > 2 and _simplest(errors, worth) <= len(shapes) - 3:
            break
    return shapes, errors


def _extruded_shape(profile: Profile, cells: _Cells) -> _Shape:
    """Return an extruded profile, which is fitted to points and not to cells, as a shape."""
    turn_deg = float(np.degrees(np.arctan2(profile.along[1], profile.along[0]))) % 180.0
    name = f"extruded profile along {turn_deg:.0f} degrees"
    return _Shape(name, lambda points, weights: profile, profile, cells.weights, None)


def _with_free_form(cells: _Cells, best: _Shape, base: _Shape, config: SurfaceConfig) -> _Shape:
    """Return the best shape, or if it leaves structure the free form over ``base`` that predicts
    left-out cells significantly better."""
    auto = config.shape == "auto"
    if auto and _misfit(cells, best.fit, "")[1]["misfit_share"] < FREE_FORM_FROM:
        return best
    free = [best] if auto else []
    for length_cells in _wavelengths(cells, config):
        wavelength = length_cells * cells.side
        fit_to = partial(
            free_form, base=base.fit, wavelength=wavelength, cell=cells.side, central=cells.central
        )
        fitted = _fitted(cells, "free form", fit_to, wavelength)
        if fitted is not None:
            free.append(fitted)
    worth = WORTH * cells.pixel_noise
    return free[_simplest([_prediction_errors(cells, shape) for shape in free], worth)]


def _formulas(central: bool) -> list[tuple[str, Any]]:
    """Return the names of the shapes with few coefficients and their fits, simplest first."""
    of_degree = partial(_polynomial, central=central)
    formulas: list[tuple[str, Any]] = [
        ("plane", partial(of_degree, degree=1)),
        ("polynomial of degree 2", partial(of_degree, degree=2)),
        ("quadric", partial(quadric, central=central)),
    ]
    for degree in (3, 4, 5):
        formulas.append((f"polynomial of degree {degree}", partial(of_degree, degree=degree)))
    return formulas


def _polynomial(
    points: np.ndarray, weights: np.ndarray, degree: int, central: bool
) -> SurfaceFunction:
    """Fit z(x, y) to points (c, 3). ``central``: rays leave the origin, else along z."""
    fit = polynomial(points, weights, degree)
    return along_rays(fit) if central else fit


def _wavelengths(cells: _Cells, config: SurfaceConfig) -> list[float]:
    """Return the wavelengths of free forms to try, in cells, longest first: down to twice the side
    of a tile or to the least scale."""
    if config.scale_mm is not None:
        return [2 * config.scale_mm * MM / cells.side_m]
    rows = int(np.ptp(cells.row)) + 1
    columns = int(np.ptp(cells.column)) + 1
    wavelengths: list[float] = [max(rows, columns)]
    shortest = max(2 * TILE_CELLS, 2 * LEAST_SCALE_M / cells.side_m)
    while wavelengths[-1] / 1.6 >= shortest:
        wavelengths.append(wavelengths[-1] / 1.6)
    return wavelengths


def _fitted(
    cells: _Cells,
    name: str,
    fit_to: Any,
    wavelength: float | None,
    widened: bool = False,
) -> _Shape | None:
    """Fit with bisquare weights, ``widened`` by the flanks of dents; None if the fit misses a
    fiftieth of the cells."""
    weights = cells.weights
    floor = 0.2 * cells.pixel_noise / np.sqrt(CELL_POINTS)
    for _ in range(6):
        fit = fit_to(cells.points, weights)
        if fit is None:
            return None
        error = cells.points[:, 2] - fit(cells.points)
        is_fitted = np.isfinite(error) & (cells.weights > 0)
        if is_fitted.sum() < 0.98 * (cells.weights > 0).sum():
            return None
        scale = max(sigma_of(error[is_fitted]), floor)
        before = weights
        robust = bisquare_weights(np.where(is_fitted, error, np.inf), BISQUARE_TUNING * scale)
        if widened:
            robust = robust * ~_beside_outliers(cells, robust == 0)
        weights = cells.weights * robust
        if np.abs(weights - before).max() < 0.05:
            break
    return _Shape(name, fit_to, fit, weights, wavelength)


def _beside_outliers(cells: _Cells, is_outlier: np.ndarray) -> np.ndarray:
    """Return which cells (c,) belong to pairs of neighbouring outliers, or touch such a pair."""
    image = cells.image(is_outlier.astype(float), 0.0) > 0
    counts = cv2.filter2D(
        image.astype(np.uint8), -1, np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT
    )
    # a cell counts itself too
    pairs = counts >= 3
    return np.asarray(grown(image & pairs, 1)[cells.row, cells.column])


def _prediction_errors(cells: _Cells, shape: _Shape) -> np.ndarray:
    """Return the median size (tiles,) of the errors in each tile of cells, predicted from the
    tiles of other folds."""
    across = cells.column // TILE_CELLS
    down = cells.row // TILE_CELLS
    fold = (across + 2 * down) % FOLDS
    error = np.full(len(cells.points), np.inf)
    for left_out in range(FOLDS):
        inside = fold == left_out
        fit = shape.fit_to(cells.points, shape.weights * ~inside)
        if fit is not None and inside.any():
            error[inside] = cells.points[inside, 2] - fit(cells.points[inside])
    error[~np.isfinite(error)] = 1e3
    keys = down * (across.max() + 1) + across
    _, tile = np.unique(keys, return_inverse=True)
    medians, _ = group_medians(np.abs(error), tile, int(tile.max()) + 1)
    return medians


def _simplest(errors: list[np.ndarray], worth: float) -> int:
    """Return the first shape whose mean error exceeds the least by at most ``worth`` or a standard
    error."""
    best = int(np.argmin([tile_errors.mean() for tile_errors in errors]))
    for i, tile_errors in enumerate(errors):
        difference = tile_errors - errors[best]
        standard_error = float(difference.std()) / np.sqrt(len(difference))
        if tile_errors.mean() - errors[best].mean() <= max(worth, standard_error):
            return i
    return best


def _misfit(cells: _Cells, fit: SurfaceFunction, name: str) -> tuple[str, dict[str, Any]]:
    """Return a warning if structure remains that could be mistaken for damage, else "", and its
    size."""
    error = cells.points[:, 2] - fit(cells.points)
    is_used = np.isfinite(error) & (cells.weights > 0)
    image = cells.image(np.where(is_used, error, np.nan))
    noise, correlation = _cell_noise(image)
    pixel = cells.pixel_noise
    # compact findings differ from their neighbourhood's median; structure is the neighbourhood
    # itself
    valid = np.isfinite(image)
    limit = np.nanmedian(np.abs(image)) / 0.6745 * BISQUARE_TUNING
    used = valid & (np.abs(np.nan_to_num(image)) < max(limit, BISQUARE_TUNING * noise))
    count = _block_sums(used.astype(float))
    smooth = _block_sums(np.where(used, image, 0.0)) / np.maximum(count, 1)
    enough = valid & (count >= 9)
    chance = STRUCTURE_SIGMAS * noise * (1 + 2 * correlation) / np.sqrt(np.maximum(count, 1))
    beyond = enough & (np.abs(smooth) > np.maximum(chance, SEEN * pixel))
    rms_m = float(np.sqrt(np.mean(smooth[enough] ** 2))) if enough.any() else 0.0
    share = float(beyond.sum() / max(enough.sum(), 1))
    off = _share_off(valid & ~used, valid)
    warning = ""
    if off:
        warning = (
            f"the surface does not fit here: {100 * off:.0f} % of the target lies off it "
            f"({name}), "
            "as beside a step between two surfaces; findings there may be due to its shape "
            "(--crop can leave a surface out)"
        )
    elif share >= MISFIT_FROM:
        warning = (
            f"the surface does not fit here: {name} leaves {1e3 * rms_m:.2g} mm rms at scales "
            f"above {STRUCTURE_CELLS * cells.side_m / MM:.2g} mm, where the noise of a pixel is "
            f"{1e3 * pixel:.2g} mm, on {100 * share:.0f} % of the target; "
            "findings there may be due to its shape"
        )
    return warning, {"misfit_share": share, "misfit_rms_m": rms_m, "local_noise_m": pixel}


def _share_off(is_off: np.ndarray, valid: np.ndarray) -> float:
    """Return the share of the ``valid`` cells (h, w) that another surface takes, of those that lie
    far off (h, w); 0 if they may be damage, which is seldom so large.

    Another surface is a connected part of `MISFIT_FROM`, or all that reaches the rim if
    `MISFIT_AT_RIM_FROM` lies within the cells along it, which mix the target with what is
    behind."""
    _, labels, facts, _ = cv2.connectedComponentsWithStats(is_off.astype(np.uint8))
    cells = max(valid.sum(), 1)
    largest = float(facts[1:, cv2.CC_STAT_AREA].max(initial=0) / cells)
    outside = np.pad(~valid, 1, constant_values=True)
    is_rim = grown(outside, 1)[1:-1, 1:-1]
    reaches_rim = is_off & np.isin(labels, labels[is_rim])
    if (reaches_rim & ~is_rim).sum() >= MISFIT_AT_RIM_FROM * cells:
        return max(largest, float(reaches_rim.sum() / cells))
    return largest if largest >= MISFIT_FROM else 0.0


def _block_sums(image: np.ndarray) -> np.ndarray:
    """Return the sums over blocks of `STRUCTURE_CELLS` cells a side around each cell."""
    size = (STRUCTURE_CELLS, STRUCTURE_CELLS)
    sums = cv2.boxFilter(image, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(sums)


def _incidence_deg(points: np.ndarray, fit: SurfaceFunction, step: float) -> np.ndarray:
    """Return the angles (n,) between the rays and the surface's normals, from the surface's slope
    over one ``step``."""

    def on_surface(dx: float, dy: float) -> np.ndarray:
        rays = points / points[:, 2:] + [dx, dy, 0.0]
        p = rays * points[:, 2:]
        for _ in range(2):
            p = rays * fit(p)[:, None]
        return p

    surface_points = on_surface(0.0, 0.0)
    across = on_surface(step, 0.0) - surface_points
    down = on_surface(0.0, step) - surface_points
    normal = np.cross(across, down)
    projection = np.abs((normal * surface_points).sum(axis=1))
    lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(surface_points, axis=1)
    return np.asarray(np.degrees(np.arccos(projection / lengths)))
