"""A unit's fixed pattern from captures of a flat surface, divided into parts fixed to the pixels
and to the surface.

Each capture's average is the sum of a smooth fit, the pattern P at each pixel, the surface's own
shape S at each place, and noise. If the captures' poses are known, P and S are found together by
least squares, from the noise's variances and that of S, which follows from the captures'
disagreement. Without poses each capture has its own S, which counts as noise and averages out; a
camera that did not move sees the same S each time, and nothing can separate it from P.

The smooth fit is a polynomial in 1/z over the rays' slopes, in which a plane is exact; it absorbs
structure wider than about a sixth of the image. Not modelled: errors of the stated poses, and the
correlation of noise."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import lsqr

from detectors.averages.flat_field import NEAR_ENOUGH, FlatField
from detectors.pixels.masks import on_grid
from detectors.pixels.noise import LEAST_FRAMES, average_variance_m2, sigma_of
from detectors.surfaces.surface import SurfaceConfig, fit_surface
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Lens, transform_points

SMOOTH = SurfaceConfig(degree=5, method="bisquare")
OUTLIER_SIGMAS = 6.0
"""Larger residuals do not belong to a flat surface: they are marks, dirt or flying pixels."""
STABLE_SHARE = 0.2
"""Part of the pattern's rms by which two parts of the captures may differ beyond their noise: 4 %
of its variance then remain. Where the surface's shape is solved for, it takes up to half of such a
change."""
SURE = 1.1
"""Ratio to its noise from which a difference counts: noise that 30,000 pixels share makes 3 % of
it."""

# --- movements of the camera ---

SAME_PLACE_M = 2 * MM
"""Change of distance below which no movement of the camera shows: ten times the wander of a static
Azure Kinect."""
SAME_TURN = 0.003
"""The same change of the plane's normal (rad): the effect of that wander over an image."""
LEAST_SHIFT_M = 30 * MM  # shift along the surface that shows

# --- the least squares of pattern and shape ---

MOST_STEPS = 200
SOLVED = 1e-5  # relative error
BELIEF_STEPS = 5


@dataclass(frozen=True)
class FlatCapture:
    """One capture of a flat surface."""

    name: str
    frames: int
    """Number of averaged frames."""
    distance_m: float
    """Median z."""
    normal: np.ndarray
    """(3,): of the plane, towards the camera."""
    residual_m: np.ndarray
    """(h, w): range along the ray minus the smooth fit, NaN where it does not count."""
    variance_m2: np.ndarray
    """(h, w): of the residual, by the frames' noise."""
    places_m: np.ndarray | None = None
    """(h, w, 2): where each pixel sees the surface, in its co-ordinates; None if poses are
    unknown."""

    @property
    def pixels(self) -> int:
        """Number of pixels that count."""
        return int(np.isfinite(self.residual_m).sum())

    @property
    def tilt_deg(self) -> float:
        """Angle between the optical axis and the plane's normal."""
        return float(np.degrees(np.arccos(min(-self.normal[2], 1.0))))

    @property
    def noise_m(self) -> float:
        """Root mean square of the frames' noise in the average."""
        return _rms(np.sqrt(self.variance_m2[np.isfinite(self.residual_m)]))


@dataclass(frozen=True)
class PatternChange:
    """The pattern from one part of the captures beside that from another."""

    correlation: float
    """Over pixels."""
    difference_m: float
    """Root mean square."""
    noise_m: float
    """The difference that noise alone would make."""

    @property
    def excess_m(self) -> float:
        """The rms by which they differ beyond their noise."""
        return float(np.sqrt(max(self.difference_m**2 - self.noise_m**2, 0.0)))


@dataclass(frozen=True)
class Separated:
    """A flat field with its diagnostics."""

    field: FlatField
    captures: tuple[FlatCapture, ...]
    surface_m: float
    """Standard deviation of the part that captures do not share, beyond their noise, or NaN."""
    separated: bool
    """True if the surface's shape was solved for."""
    in_time: PatternChange | None
    """First captures beside last ones, at equal distances; None if there are not enough."""
    in_range: PatternChange | None
    """Near captures beside far ones; None if there are not enough."""

    @property
    def noise_m(self) -> float:
        """Root mean square of the map's standard deviation."""
        return float(np.sqrt(np.nanmean(self.field.variance_m2)))


def flattened(
    cloud: Cloud,
    mask: np.ndarray,
    name: str,
    T_first_camera: np.ndarray | None = None,
) -> FlatCapture:
    """Return an averaged cloud of a flat surface, of the pixels in ``mask`` (h, w), minus its
    smooth fit. With a pose, the places are x and y in the first capture's camera frame, until
    `_on_one_plane` rotates them. Raises UserError without a pixel grid, or if frames or pixels are
    too few for noise or surface."""
    noise_m2 = average_variance_m2(cloud, mask)
    if not cloud.organised or noise_m2 is None:
        plural = "" if cloud.n_frames == 1 else "s"
        raise UserError(
            f"{name}: {cloud.n_frames} frame{plural}: too few to estimate the noise",
            legal=f"depth images, {LEAST_FRAMES} frames or more",
            fix="record 50 frames or more",
        )
    points_m = cloud.points_m[mask]
    slopes = points_m[:, :2] / points_m[:, 2:]
    inverse_z = 1 / points_m[:, 2]
    length = np.sqrt(1 + (slopes**2).sum(axis=1))  # of the ray up to z = 1
    fit = fit_surface(slopes[:, 0], slopes[:, 1], inverse_z, SMOOTH)
    off_m = (points_m[:, 2] - 1 / fit.evaluate(slopes[:, 0], slopes[:, 1])) * length
    off_m = np.where(np.abs(off_m) < OUTLIER_SIGMAS * sigma_of(off_m), off_m, np.nan)
    off_m -= np.nanmean(off_m)
    # a plane is linear in the slopes: 1 / z = a x/z + b y/z + c
    system = np.column_stack([slopes, np.ones(len(slopes))])
    plane, *_ = np.linalg.lstsq(system, inverse_z, rcond=None)
    return FlatCapture(
        name=name,
        frames=cloud.n_frames,
        distance_m=float(np.median(points_m[:, 2])),
        normal=-plane / np.linalg.norm(plane),
        residual_m=on_grid(off_m, mask),
        variance_m2=on_grid(noise_m2[mask] * length**2, mask),
        places_m=None
        if T_first_camera is None
        else transform_points(T_first_camera, cloud.points_m),
    )


def separated(captures: Sequence[FlatCapture], lens: Lens) -> Separated:
    """Return the pattern of one unit from captures with one lens, in the order in which they were
    taken; the surface's shape is solved for if all captures have places on it. Raises UserError if
    no pixel counts in any capture."""
    captures = _on_one_plane(captures)
    residuals = np.stack([capture.residual_m for capture in captures])
    variances = np.stack([capture.variance_m2 for capture in captures])
    counts = np.isfinite(residuals).sum(axis=0)
    if not counts.any():
        raise UserError("no pixel of any capture shows the flat surface", fix="check --crop")
    shape_m2 = _disagreement_m2(residuals, variances, counts)
    is_solved = captures[0].places_m is not None and len(captures) > 1 and shape_m2 > 0
    if is_solved:
        error_m, variance_m2, shapes_m = _solved(
            captures,
            residuals,
            variances,
            shape_m2,
        )
        patterns = residuals - shapes_m
    else:
        error_m, variance_m2 = _averaged(residuals, variances + shape_m2)
        patterns = residuals
    distances_m = [capture.distance_m for capture in captures]
    groups = list(_groups(distances_m))
    firsts = []
    lasts = []
    for group in groups:
        middle = len(group) // 2
        firsts += group[:middle]
        if len(group) > 1:
            lasts += group[middle:]
    in_range = None
    if len(groups) > 1:
        in_range = _change(patterns, variances, groups[0], groups[-1])
    result = Separated(
        field=FlatField(
            error_m,
            variance_m2,
            lens,
            (min(distances_m), max(distances_m)),
        ),
        captures=captures,
        surface_m=float(np.sqrt(shape_m2)) if len(captures) > 1 else np.nan,
        separated=is_solved,
        in_time=_change(patterns, variances, firsts, lasts),
        in_range=in_range,
    )
    return _with_doubts(result)


def _averaged(residuals: np.ndarray, variances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted mean (h, w) over captures and its variance; NaN where none counts."""
    weights = np.where(np.isfinite(residuals), 1 / variances, 0.0)
    total = weights.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.nansum(weights * residuals, axis=0) / total
        variance = np.where(total > 0, 1 / total, np.nan)
    return mean, variance


def _disagreement_m2(
    residuals: np.ndarray,
    variances: np.ndarray,
    counts: np.ndarray,
) -> float:
    """Return the variance between captures at a pixel beyond their noise, by the moments of a
    random effect."""
    several = counts > 1
    if not several.any():
        return 0.0
    values = residuals[:, several]
    noise_m2 = np.where(np.isfinite(residuals), variances, np.nan)[:, several]
    beyond_m2 = np.nanvar(values, axis=0, ddof=1) - np.nanmean(noise_m2, axis=0)
    return max(float(beyond_m2.mean()), 0.0)


def _solved(
    captures: Sequence[FlatCapture],
    residuals: np.ndarray,
    variances: np.ndarray,
    shape_m2: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pattern (h, w), its variance, and the surface's shape as each capture sees it (c, h,
    w), by the least sum of squares of noise, pattern and shape, each over its own variance.

    The variance follows from beliefs passed between pixels and cells, exact but for loops and for
    what smooth fits take of the shape: before a wall rough by half of an Azure Kinect's pattern
    the true deviation is 1.3 times as large."""
    finite = np.isfinite(residuals)
    pixels = finite[0].size
    pixel = np.flatnonzero(finite) % pixels
    value = residuals[finite]
    noise_m2 = variances[finite]
    cell = _cells_of(captures, finite)
    cells = int(cell.max()) + 1
    pattern_m2 = max(float((value**2).mean() - noise_m2.mean() - shape_m2), float(noise_m2.mean()))

    # value / noise = pattern[pixel] / noise + shape[cell] / noise; the unknowns are divided by
    # their own deviations, so that damping adds their squares
    rows = np.tile(np.arange(len(value)), 2)
    columns = np.concatenate([pixel, pixels + cell])
    per_noise = 1 / np.sqrt(noise_m2)
    parts = np.concatenate([per_noise * np.sqrt(pattern_m2), per_noise * np.sqrt(shape_m2)])
    system = sparse.csr_array((parts, (rows, columns)), shape=(len(value), pixels + cells))
    unknowns = lsqr(
        system,
        per_noise * value,
        damp=1.0,
        atol=SOLVED,
        btol=SOLVED,
        iter_lim=MOST_STEPS,
    )[0]
    error_m = unknowns[:pixels] * np.sqrt(pattern_m2)
    shapes_m = np.full(finite.shape, np.nan)
    shapes_m[finite] = (unknowns[pixels:] * np.sqrt(shape_m2))[cell]

    variance_m2 = np.full(pixels, pattern_m2)
    for _ in range(BELIEF_STEPS):
        # what a cell knows of its shape from all values but one, and a pixel from all cells
        precision = 1 / (noise_m2 + variance_m2[pixel])
        of_cell = np.bincount(cell, precision, cells)[cell]
        cell_m2 = 1 / (1 / shape_m2 + of_cell - precision)
        of_pixel = np.bincount(pixel, 1 / (noise_m2 + cell_m2), pixels)
        variance_m2 = 1 / (1 / pattern_m2 + of_pixel)
    unseen = ~finite.any(axis=0)
    error_m = np.where(unseen, np.nan, error_m.reshape(unseen.shape))
    variance_m2 = np.where(unseen, np.nan, variance_m2.reshape(unseen.shape))
    return error_m, variance_m2, shapes_m


def _cells_of(captures: Sequence[FlatCapture], finite: np.ndarray) -> np.ndarray:
    """Return the number (n,) of the cell on the surface that each finite pixel (c, h, w) sees.
    Cells are as wide as the pixels of the nearest capture."""
    positions = []
    steps_m = []
    for capture, is_finite in zip(captures, finite, strict=True):
        assert capture.places_m is not None
        positions.append(capture.places_m[is_finite])
        steps_m.append(np.nanmedian(np.abs(np.diff(capture.places_m[..., 0], axis=1))))
    position_m = np.concatenate(positions)
    corner_m = position_m.min(axis=0)
    row, column = np.floor((position_m - corner_m) / float(min(steps_m))).astype(np.int64).T
    _, cell = np.unique(row * (column.max() + 1) + column, return_inverse=True)
    return cell


def _on_one_plane(captures: Sequence[FlatCapture]) -> tuple[FlatCapture, ...]:
    """Return the captures with places (h, w, 2) along the first one's plane if all have a pose,
    else without places."""
    all_places_m = [capture.places_m for capture in captures if capture.places_m is not None]
    if len(all_places_m) < len(captures):
        return tuple(replace(capture, places_m=None) for capture in captures)
    normal = captures[0].normal
    across = np.cross([0.0, 1.0, 0.0], normal)
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(normal, across)], axis=-1)
    return tuple(
        replace(capture, places_m=places_m @ axes)
        for capture, places_m in zip(captures, all_places_m, strict=True)
    )


def _groups(distances_m: Sequence[float]) -> Iterator[list[int]]:
    """Yield the numbers of captures at similar distances, nearest first, each group in its own
    order."""
    waiting = sorted(range(len(distances_m)), key=lambda number: distances_m[number])
    while waiting:
        farthest_m = NEAR_ENOUGH * distances_m[waiting[0]]
        yield sorted(number for number in waiting if distances_m[number] <= farthest_m)
        waiting = [number for number in waiting if distances_m[number] > farthest_m]


def _change(
    patterns: np.ndarray,
    variances: np.ndarray,
    first: Sequence[int],
    second: Sequence[int],
) -> PatternChange | None:
    """Return how the pattern (c, h, w) of the first captures differs from that of the second; None
    if there are too few."""
    if not first or not second:
        return None
    first_m, first_m2 = _averaged(patterns[list(first)], variances[list(first)])
    second_m, second_m2 = _averaged(patterns[list(second)], variances[list(second)])
    is_common = np.isfinite(first_m) & np.isfinite(second_m)
    if is_common.sum() < 2:
        return None
    return PatternChange(
        correlation=float(np.corrcoef(first_m[is_common], second_m[is_common])[0, 1]),
        difference_m=_rms((first_m - second_m)[is_common]),
        noise_m=float(np.sqrt((first_m2 + second_m2)[is_common].mean())),
    )


def _with_doubts(result: Separated) -> Separated:
    """Return the pattern with warnings, and with a variance that holds for a pattern that is not
    stable."""
    notes = []
    field = result.field
    moved = _moved(result.captures)
    if not moved:
        why = "nothing shows that the camera moved between the captures"
        if len(result.captures) == 1:
            why = "one capture"
        notes.append(
            f"{why}: the surface's shape cannot be separated from the pattern and is assumed to be"
            f" flat (move the camera by {LEAST_SHIFT_M / MM:.0f} mm; if along the surface, state"
            " --poses)"
        )
    changes = {}
    if result.in_time is not None:
        changes["from the first captures to the last"] = result.in_time
    if result.in_range is not None:
        changes["with distance"] = result.in_range
    texts = []
    largest_m = 0.0
    for cause, change in changes.items():
        is_sure = change.difference_m > SURE * change.noise_m
        if is_sure and change.excess_m > STABLE_SHARE * field.rms_m:
            texts.append(f"{cause} by {change.excess_m / MM:.2g} mm")
            largest_m = max(largest_m, change.excess_m)
    if texts:
        also = ""
        if not result.separated:
            also = ", or the surface is not flat (state --poses to separate the two)"
        notes.append(
            f"the pattern, {field.rms_m / MM:.2g} mm, is not stable: it changes"
            f" {' and '.join(texts)} beyond its noise{also}"
        )
    # of two parts that scatter by t each, the mean is off a third part by 3/2 t^2, and their
    # difference is 2 t^2
    variance_m2 = field.variance_m2 + 0.75 * largest_m**2
    return replace(
        result, field=replace(field, variance_m2=variance_m2, warnings=tuple(notes), moved=moved)
    )


def _moved(captures: Sequence[FlatCapture]) -> bool:
    """Return whether any capture was taken from another place than the first: by its pose, or by
    its plane."""
    first = captures[0]
    for capture in captures[1:]:
        if first.places_m is not None and capture.places_m is not None:
            shift_m = np.nanmedian(capture.places_m - first.places_m, axis=(0, 1))
            if float(np.hypot(*shift_m)) >= LEAST_SHIFT_M:
                return True
            continue
        nearer_m = abs(capture.distance_m - first.distance_m)
        turn = float(np.linalg.norm(capture.normal - first.normal))
        if nearer_m > SAME_PLACE_M or turn > SAME_TURN:
            return True
    return False


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")
