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
import numba
import numpy as np

from detectors.pixels.masks import grown, on_grid
from detectors.pixels.noise import median_of, sigma_of
from detectors.surfaces.free_form import free_form, picture_places
from detectors.surfaces.reference import laid_on
from detectors.surfaces.surface import (
    BISQUARE_TUNING,
    Fit,
    SurfaceConfig,
    bisquare_weights,
    fit_surface,
    polynomial,
    quadric,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud

MOST_CELLS = 3600
CELL_POINTS = 16
EVEN_CELL_POINTS = 64
ENOUGH_CELLS = 600
FEW_CELLS = 40
"""Most cells; points per cell, at least and where there are enough; enough cells; fewest cells to
choose a shape."""
TILE_CELLS = 3
FOLDS = 5
"""Side, in cells, of a tile that is predicted as a whole, and the number of folds into which the
tiles are dealt."""
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
FREE_FORM_FROM = 0.02
MISFIT_FROM = 0.1
"""Share of the area with structure from which a free form is tried, and from which a warning of a
misfit is given."""
STATED = ("polynomial", "mesh")  # shapes that the user states
STRUCTURE_CELLS = 5
STRUCTURE_SIGMAS = 4.0
SEEN = 0.5
"""Side of the block averaged to see structure, least significance of structure, and share of a
pixel's noise."""


@dataclass(frozen=True)
class Background:
    """The surface without its damage. ``surface_z_m`` and ``residual_m`` (h, w): z of the surface,
    and z of the cloud minus the surface; NaN where it is not judged. ``noise_m`` (h, w): standard
    deviation of the residuals nearby, without the surface's own misfit. ``scale_m``: width above
    which a free form follows shallow damage. ``warning``: a sentence if remaining structure could
    be mistaken for damage."""

    surface_z_m: np.ndarray
    residual_m: np.ndarray
    noise_m: np.ndarray
    description: str
    scale_m: float | None
    warning: str
    notes: dict[str, Any]


@dataclass(frozen=True)
class _Cells:
    """``points`` (c, 3) metres: a ray through each cell and its median z. ``weights`` (c,).
    ``noise`` (c,): of a pixel. ``level_noise``: of a median. ``of`` (n,): each point's cell or -1.
    ``side``: in the picture's units."""

    points: np.ndarray
    weights: np.ndarray
    noise: np.ndarray
    level_noise: float
    of: np.ndarray
    row: np.ndarray
    column: np.ndarray
    side: float
    side_m: float
    central: bool

    def image(self, values: np.ndarray, empty: float = np.nan) -> np.ndarray:
        """Return cells' values (c,) on their grid."""
        image = np.full((self.row.max() + 1, self.column.max() + 1), empty)
        image[self.row, self.column] = values
        return image

    @property
    def pixel_noise(self) -> float:
        """Return the standard deviation of a pixel: about its cell's median, combined with that of
        the median."""
        return float(np.hypot(median_of(self.noise[np.isfinite(self.noise)]), self.level_noise))

    def refreshed(self, residuals: np.ndarray, fit: Fit) -> _Cells:
        """Return the cells with medians and deviations of the points' residuals (n,); some cells
        are then dropped."""
        medians, deviations = _group_medians(residuals, self.of, len(self.points))
        z = fit(self.points) + medians
        known = np.isfinite(z)
        moved = (
            self.points * (z / self.points[:, 2])[:, None] if self.central else self.points.copy()
        )
        moved[:, 2] = z
        moved[~known] = self.points[~known]
        weights = np.where(known, self.weights, 0.0)
        level_noise = _cell_noise(self.image(medians))[0]
        return replace(
            self, points=moved, weights=weights, noise=deviations, level_noise=level_noise
        )


class _Shape(NamedTuple):
    name: str
    fit_to: Callable[[np.ndarray, np.ndarray], Fit | None]
    fit: Fit
    weights: np.ndarray
    wavelength: float | None


def background(cloud: Cloud, mask: np.ndarray, config: SurfaceConfig) -> Background:
    """Choose, fit and judge the surface of the cloud's points where ``mask`` (h, w) is true.
    Deterministic. Raises UserError if the points do not determine it."""
    points = np.ascontiguousarray(cloud.points_m[mask])
    central = cloud.projection == "central"
    cells = _cells(points, cloud)
    if cells is None:
        name, fit = _stated(
            points, config if config.shape in STATED else SurfaceConfig(degree=1), central
        )
        fitted = fit(points)
        noise_m = sigma_of(points[:, 2] - fitted)
        warning = f"{len(points)} points are too few to tell whether the surface ({name}) fits"
        few: dict[str, Any] = {"shape": name, "local_noise_m": noise_m, "misfit_share": None}
        z_m = on_grid(fitted, mask)
        residual_m = on_grid(points[:, 2] - fitted, mask)
        return Background(
            z_m, residual_m, np.where(mask, noise_m, np.nan), name, None, warning, few
        )
    wavelength = None
    if config.shape in STATED:
        name, fit = _stated(points, config, central)
    else:
        _, start = _stated(
            points[:: max(1, len(points) // 8192)], SurfaceConfig(degree=2, method="bisquare")
        )
        shape = _chosen(cells.refreshed(points[:, 2] - start(points), start), config)
        for _ in range(2):
            cells = cells.refreshed(points[:, 2] - shape.fit(points), shape.fit)
            shape = (
                _fitted(cells, shape.name, shape.fit_to, shape.wavelength, widened=True) or shape
            )
        name = shape.name
        fit = shape.fit
        wavelength = shape.wavelength

    fitted = fit(points)
    residuals = points[:, 2] - fitted
    unseen = ~np.isfinite(fitted)
    if cells.central:
        # only the few pixels near the steepest incidence are examined one by one; a ray that
        # misses the surface beside the pixel gives NaN, which is not below the limit either
        near = _incidence_deg(cells.points, fit, cells.side) > STEEPEST_DEG - 20.0
        looked = np.flatnonzero((cells.of < 0) | near[cells.of])
        unseen[looked] |= ~(_incidence_deg(points[looked], fit, 0.1 * cells.side) < STEEPEST_DEG)
    if unseen.all():
        what = f"the whole target is seen at more than {STEEPEST_DEG:g} degrees, where nothing is judged"
        raise UserError(what, fix="choose another target or crop, or record it from its front")
    fitted[unseen] = np.nan
    cells = cells.refreshed(residuals, fit)
    warning, notes = _misfit(cells, fit, name)
    text = name
    scale_m = None
    if wavelength is not None:
        scale_m = 0.5 * wavelength * cells.side_m / cells.side
        text += f", which absorbs shallow damage wider than {scale_m / MM:.0f} mm"
    if unseen.mean() > 0.001:
        steep = f"seen at more than {STEEPEST_DEG:g} degrees" + " or at an edge of the mesh" * (
            config.shape == "mesh"
        )
        text += f"; {100 * unseen.mean():.1f} % of the target, {steep}, is not judged"
    # a pixel's noise near each cell: the target's median, or the median over 7 x 7 cells if that
    # is much larger
    padded = np.pad(cells.image(cells.noise), 3, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (7, 7))[
        cells.row, cells.column
    ].reshape(-1, 49)
    with np.errstate(all="ignore"):
        local = np.hypot(np.nanmedian(around, axis=1), cells.level_noise)
    pixel = cells.pixel_noise
    noise = np.where(
        cells.of >= 0, np.where(local > NOISIER * pixel, local, pixel)[cells.of], pixel
    )
    z_m = on_grid(fitted, mask)
    residual_m = on_grid(points[:, 2] - fitted, mask)
    noise_map_m = on_grid(noise, mask)
    notes.update(shape=name, steep_share=float(unseen.mean()))
    return Background(z_m, residual_m, noise_map_m, text, scale_m, warning, notes)


def misfit(cloud: Cloud, residual_m: np.ndarray, surface: str) -> str:
    """Return a sentence if a stated ``surface`` leaves structure like damage in ``residual_m`` (h,
    w), else ""."""
    mask = np.isfinite(residual_m)
    cells = _cells(cloud.points_m[mask], cloud)
    if cells is None:
        return ""
    medians, deviations = _group_medians(residual_m[mask], cells.of, len(cells.points))
    level_noise = _cell_noise(cells.image(medians))[0]
    flat = np.column_stack([cells.points[:, :2], medians])
    level = replace(cells, points=flat, noise=deviations, level_noise=level_noise)
    return _misfit(level, lambda p: np.zeros(len(p)), surface)[0]


def _stated(points: np.ndarray, config: SurfaceConfig, central: bool = True) -> tuple[str, Fit]:
    if config.reference is not None:
        return laid_on(points, config.reference, central)
    surface = fit_surface(points[:, 0], points[:, 1], points[:, 2], config)
    return f"degree {config.degree}, {surface.note}", lambda p: surface.evaluate(p[:, 0], p[:, 1])


def _cells(points: np.ndarray, cloud: Cloud) -> _Cells | None:
    """Return the cells of points (n, 3) of a cloud, not yet `refreshed`; None if too few are
    filled."""
    if len(points) < FEW_CELLS * CELL_POINTS:
        return None
    central = cloud.projection == "central" and float(points[:, 2].min()) > 0
    x, y = np.ascontiguousarray(picture_places(points, central).T)
    extent = np.maximum([np.ptp(x), np.ptp(y)], 1e-12)
    wanted = max(
        min(max(CELL_POINTS, len(points) / ENOUGH_CELLS), EVEN_CELL_POINTS),
        len(points) / MOST_CELLS,
    )
    side = float(np.sqrt(extent.prod() * wanted / len(points)))
    for _ in range(3):
        across = ((x - x.min()) / side).astype(np.int64)
        down = ((y - y.min()) / side).astype(np.int64)
        columns = int(across.max()) + 1
        keys = down * columns + across
        counts = np.bincount(keys)
        side *= float(np.sqrt(wanted / max(median_of(counts[counts > 0].astype(float)), 1.0)))
    held = np.flatnonzero(counts >= max(4, wanted / 4))
    if len(held) < FEW_CELLS:
        return None
    number = np.full(len(counts), -1)
    number[held] = np.arange(len(held))
    of = number[keys]
    row, column = np.divmod(held, columns)
    x = np.bincount(keys, x)[held] / counts[held]
    y = np.bincount(keys, y)[held] / counts[held]
    z = np.bincount(keys, points[:, 2])[held] / counts[held]
    side_m = side * (float(np.median(points[:, 2])) if central else 1.0)
    rays = np.column_stack([x, y]) * (z[:, None] if central else 1.0)
    weights = np.minimum(counts[held] / wanted, 1.0)
    none = np.zeros(len(held))
    return _Cells(
        np.column_stack([rays, z]), weights, none, 0.0, of, row, column, side, side_m, central
    )


@numba.njit(cache=True, nogil=True)
def _group_medians(
    values: np.ndarray, group: np.ndarray, groups: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the median of each group's finite values, and their median distance from it over
    0.6745; else NaN."""
    starts = np.zeros(groups + 1, np.int64)
    for i in range(len(values)):
        if group[i] >= 0 and np.isfinite(values[i]):
            starts[group[i] + 1] += 1
    starts = np.cumsum(starts)
    at = starts[:-1].copy()
    held = np.empty(starts[-1])
    for i in range(len(values)):
        if group[i] >= 0 and np.isfinite(values[i]):
            held[at[group[i]]] = values[i]
            at[group[i]] += 1
    medians = np.full(groups, np.nan)
    deviations = np.full(groups, np.nan)
    for g in range(groups):
        if starts[g + 1] > starts[g]:
            some = held[starts[g] : starts[g + 1]]
            medians[g] = _median(some)
            deviations[g] = _median(np.abs(some - medians[g])) / 0.6745
    return medians, deviations


@numba.njit(cache=True, nogil=True)
def _median(values: np.ndarray) -> float:
    """Return the median of values (n,), which it sorts (Shell 1959): numba's own takes 2 s longer
    to compile."""
    gap = len(values) // 2
    while gap > 0:
        for i in range(gap, len(values)):
            value = values[i]
            j = i
            while j >= gap and values[j - gap] > value:
                values[j] = values[j - gap]
                j -= gap
            values[j] = value
        gap //= 2
    return 0.5 * (values[(len(values) - 1) // 2] + values[len(values) // 2])


def _cell_noise(image: np.ndarray) -> tuple[float, float]:
    """Return the deviation of cells' medians and their neighbours' correlation, from second
    differences."""

    def bend(step: int) -> float:
        bends = [
            each[2 * step :] - 2 * each[step:-step] + each[: -2 * step] for each in (image, image.T)
        ]
        some = np.concatenate([each.ravel() for each in bends])
        some = some[np.isfinite(some)]
        return sigma_of(some) if len(some) else 0.0

    near = bend(1)
    far = bend(2)
    # for cells with variance s^2 and correlation r with direct neighbours: (6 - 8 r) s^2 and 6 s^2
    deviation = max(near, far) / np.sqrt(6.0)
    return deviation, float(np.clip((6.0 - (near / max(deviation, 1e-12)) ** 2) / 8.0, 0.0, 0.5))


def _chosen(cells: _Cells, config: SurfaceConfig) -> _Shape:
    shapes: list[_Shape] = []
    errors: list[np.ndarray] = []
    worth = WORTH * cells.pixel_noise
    auto = config.shape == "auto"
    degrees = {degree: partial(polynomial, degree=degree) for degree in (1, 2, 3, 4, 5)}
    formulas: list[tuple[str, Any]] = [
        ("plane", degrees[1]),
        ("polynomial of degree 2", degrees[2]),
    ]
    formulas += [("quadric", partial(quadric, central=cells.central))]
    formulas += [(f"polynomial of degree {degree}", degrees[degree]) for degree in (3, 4, 5)]
    for name, fit_to in formulas:
        shape = _fitted(cells, name, fit_to, None)
        if shape is not None:
            shapes.append(shape)
            errors.append(_prediction_errors(cells, shape))
        # the search ends after two more that predict no better
        if len(shapes) > 2 and _simplest(errors, worth) <= len(shapes) - 3:
            break
    best = shapes[_simplest(errors, worth)]
    if auto and _misfit(cells, best.fit, "")[1]["misfit_share"] < FREE_FORM_FROM:
        return best
    base = shapes[int(np.argmin([each.mean() for each in errors]))]
    # wavelengths in cells, longest first, down to twice the side of a tile or to the least scale
    ladder: list[float] = [max(int(np.ptp(cells.row)), int(np.ptp(cells.column))) + 1]
    while ladder[-1] / 1.6 >= max(2 * TILE_CELLS, 2 * LEAST_SCALE_M / cells.side_m):
        ladder.append(ladder[-1] / 1.6)
    if config.scale_mm is not None:
        ladder = [2 * config.scale_mm * MM / cells.side_m]
    free = [best] if auto else []
    for wavelength in (each * cells.side for each in ladder):
        fit_to = partial(
            free_form, base=base.fit, wavelength=wavelength, cell=cells.side, central=cells.central
        )
        made = _fitted(cells, "free form", fit_to, wavelength)
        free += [] if made is None else [made]
    return free[_simplest([_prediction_errors(cells, shape) for shape in free], worth)]


def _fitted(
    cells: _Cells, name: str, fit_to: Any, wavelength: float | None, widened: bool = False
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
        known = np.isfinite(error) & (cells.weights > 0)
        if known.sum() < 0.98 * (cells.weights > 0).sum():
            return None
        scale = max(sigma_of(error[known]), floor)
        before = weights
        robust = bisquare_weights(np.where(known, error, np.inf), BISQUARE_TUNING * scale)
        if widened:
            # pairs of neighbouring cells without weight, and the neighbours of these pairs
            image = cells.image((robust == 0).astype(float), 0.0) > 0
            pairs = (
                cv2.filter2D(
                    image.astype(np.uint8), -1, np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT
                )
                >= 3
            )
            robust = robust * ~grown(image & pairs, 1)[cells.row, cells.column]
        weights = cells.weights * robust
        if np.abs(weights - before).max() < 0.05:
            break
    return _Shape(name, fit_to, fit, weights, wavelength)


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
    _, tile = np.unique(down * (across.max() + 1) + across, return_inverse=True)
    return _group_medians(np.abs(error), tile, int(tile.max()) + 1)[0]


def _simplest(errors: list[np.ndarray], worth: float) -> int:
    """Return the first shape whose mean error exceeds the least by at most ``worth`` or a standard
    error."""
    best = int(np.argmin([each.mean() for each in errors]))
    for i, each in enumerate(errors):
        difference = each - errors[best]
        if each.mean() - errors[best].mean() <= max(
            worth, float(difference.std()) / np.sqrt(len(difference))
        ):
            return i
    return best


def _misfit(cells: _Cells, fit: Fit, name: str) -> tuple[str, dict[str, Any]]:
    """Return a warning if structure remains that could be mistaken for damage, else ""."""
    error = cells.points[:, 2] - fit(cells.points)
    image = cells.image(np.where(np.isfinite(error) & (cells.weights > 0), error, np.nan))
    (noise, shared), pixel = _cell_noise(image), cells.pixel_noise
    # compact findings differ from their neighbourhood's median; structure is the neighbourhood
    # itself
    valid = np.isfinite(image)
    limit = np.nanmedian(np.abs(image)) / 0.6745 * BISQUARE_TUNING
    used = valid & (np.abs(np.nan_to_num(image)) < max(limit, BISQUARE_TUNING * noise))
    size = (STRUCTURE_CELLS, STRUCTURE_CELLS)
    count, total = (
        cv2.boxFilter(each, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        for each in (used.astype(float), np.where(used, image, 0.0))
    )
    smooth = total / np.maximum(count, 1)
    enough = valid & (count >= 9)
    chance = STRUCTURE_SIGMAS * noise * (1 + 2 * shared) / np.sqrt(np.maximum(count, 1))
    beyond = enough & (np.abs(smooth) > np.maximum(chance, SEEN * pixel))
    rms_m = float(np.sqrt(np.mean(smooth[enough] ** 2))) if enough.any() else 0.0
    share = float(beyond.sum() / max(enough.sum(), 1))
    text = f"the surface does not fit here: {name} leaves {1e3 * rms_m:.2g} mm rms at scales above"
    text += f" {STRUCTURE_CELLS * cells.side_m / MM:.2g} mm, where the noise of a pixel is {1e3 * pixel:.2g} mm, on"
    text += f" {100 * share:.0f} % of the target; findings there may be due to its shape"
    # connected cells that lie far off: damage is seldom so large
    parts = cv2.connectedComponentsWithStats((valid & ~used).astype(np.uint8))[2]
    off = float(parts[1:, cv2.CC_STAT_AREA].max(initial=0) / max(valid.sum(), 1))
    if off >= MISFIT_FROM:
        text = f"the surface does not fit here: {100 * off:.0f} % of the target lies off it ({name}), as beside a step"
        text += " between two surfaces; findings there may be due to its shape (--crop can leave a surface out)"
    notes = {"misfit_share": share, "misfit_rms_m": rms_m, "local_noise_m": pixel}
    return (text if max(share, off) >= MISFIT_FROM else ""), notes


def _incidence_deg(points: np.ndarray, fit: Fit, step: float) -> np.ndarray:
    """Return the angles (n,) between the rays and the surface's normals, from the surface's slope
    over one ``step``."""

    def on_surface(dx: float, dy: float) -> np.ndarray:
        rays = points / points[:, 2:] + [dx, dy, 0.0]
        p = rays * points[:, 2:]
        for _ in range(2):
            p = rays * fit(p)[:, None]
        return p

    here = on_surface(0.0, 0.0)
    normal = np.cross(on_surface(step, 0.0) - here, on_surface(0.0, step) - here)
    along = np.abs((normal * here).sum(axis=1))
    return np.asarray(
        np.degrees(
            np.arccos(along / (np.linalg.norm(normal, axis=1) * np.linalg.norm(here, axis=1)))
        )
    )
