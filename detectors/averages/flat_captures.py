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
from detectors.averages.noise import LEAST_FRAMES, average_variance_m2, sigma_of
from detectors.surfaces.surface import SurfaceConfig, fit_surface
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Lens, transform_points

SMOOTH = SurfaceConfig(degree=5, method="bisquare")
OUTLIER_SIGMAS = (
    6.0  # larger residuals do not belong to a flat surface: they are marks, dirt or flying pixels
)
STABLE_SHARE = 0.2
"""Part of the pattern's rms by which two parts of the captures may differ beyond their noise: 4 %
of its variance then remain. Where the surface's shape is solved for, it takes up to half of such a
change."""
# ratio to its noise from which a difference counts: noise that 30,000 pixels share makes 3 % of it
SURE = 1.1
SAME_PLACE_M = 2 * MM
SAME_TURN = 0.003
"""Changes of distance and of the plane's normal (rad) below which no movement of the camera shows:
ten times the wander of a static Azure Kinect, and the effect of that wander over an image."""
LEAST_SHIFT_M = 30 * MM
# of the least squares
MOST_STEPS = 200
SOLVED = 1e-5
BELIEF_STEPS = 5


@dataclass(frozen=True)
class FlatCapture:
    """One capture of a flat surface. ``residual_m`` (h, w): range along the ray minus the smooth
    fit, NaN where it does not count; ``variance_m2`` (h, w): of it, by the frames' noise.
    ``normal`` (3,): of the plane, towards the camera. ``places_m`` (h, w, 2): where each pixel
    sees the surface, in its co-ordinates; None if poses are unknown."""

    name: str
    frames: int
    distance_m: float
    normal: np.ndarray
    residual_m: np.ndarray
    variance_m2: np.ndarray
    places_m: np.ndarray | None = None

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
    """The pattern from one part of the captures beside that from another: correlation over pixels,
    rms of their difference, and the rms that noise alone would make."""

    correlation: float
    difference_m: float
    noise_m: float

    @property
    def excess_m(self) -> float:
        """The rms by which they differ beyond their noise."""
        return float(np.sqrt(max(self.difference_m**2 - self.noise_m**2, 0.0)))


@dataclass(frozen=True)
class Separated:
    """A flat field with its diagnostics. ``surface_m``: standard deviation of the part that
    captures do not share, beyond their noise, or NaN; ``separated``: whether the shape was solved
    for. ``in_time``: first captures beside last ones, at equal distances; ``in_range``: near
    beside far ones; None if there are not enough."""

    field: FlatField
    captures: tuple[FlatCapture, ...]
    surface_m: float
    separated: bool
    in_time: PatternChange | None
    in_range: PatternChange | None

    @property
    def noise_m(self) -> float:
        """Root mean square of the map's standard deviation."""
        return float(np.sqrt(np.nanmean(self.field.variance_m2)))


def flattened(
    cloud: Cloud, mask: np.ndarray, name: str, T_first_camera: np.ndarray | None = None
) -> FlatCapture:
    """Return an averaged cloud of a flat surface, of the pixels in ``mask`` (h, w), minus its
    smooth fit. With a pose, the places are x and y in the first capture's camera frame, until
    `_on_one_plane` rotates them. Raises UserError without a pixel grid, or if frames or pixels are
    too few for noise or surface."""
    noise_m2 = average_variance_m2(cloud, mask)
    if not cloud.organised or noise_m2 is None:
        what = f"{name}: {cloud.n_frames} frame{'s' * (cloud.n_frames != 1)}: too few to estimate the noise"
        raise UserError(
            what,
            legal=f"depth images, {LEAST_FRAMES} frames or more",
            fix="record 50 frames or more",
        )
    points = cloud.points_m[mask]
    slopes = points[:, :2] / points[:, 2:]
    length = np.sqrt(1 + (slopes**2).sum(axis=1))
    fit = fit_surface(slopes[:, 0], slopes[:, 1], 1 / points[:, 2], SMOOTH)
    off_m = (points[:, 2] - 1 / fit.evaluate(slopes[:, 0], slopes[:, 1])) * length
    off_m = np.where(np.abs(off_m) < OUTLIER_SIGMAS * sigma_of(off_m), off_m, np.nan)
    off_m -= np.nanmean(off_m)
    residual_m, variance_m2 = np.full((2, *mask.shape), np.nan)
    residual_m[mask], variance_m2[mask] = off_m, noise_m2[mask] * length**2
    plane = np.linalg.lstsq(
        np.column_stack([slopes, np.ones(len(slopes))]), 1 / points[:, 2], rcond=None
    )[0]
    distance_m = float(np.median(points[:, 2]))
    normal = -plane / np.linalg.norm(plane)
    places_m = None if T_first_camera is None else transform_points(T_first_camera, cloud.points_m)
    return FlatCapture(name, cloud.n_frames, distance_m, normal, residual_m, variance_m2, places_m)


def separated(captures: Sequence[FlatCapture], lens: Lens) -> Separated:
    """Return the pattern of one unit from captures with one lens, in the order in which they were
    taken; the surface's shape is solved for if all captures have places on it. Raises UserError if
    no pixel counts in any capture."""
    captures = _on_one_plane(captures)
    residuals, variances = (
        np.stack([getattr(c, name) for c in captures]) for name in ("residual_m", "variance_m2")
    )
    counts = np.isfinite(residuals).sum(axis=0)
    if not counts.any():
        raise UserError("no pixel of any capture shows the flat surface", fix="check --crop")
    shape_m2 = _disagreement_m2(residuals, variances, counts)
    is_solved = captures[0].places_m is not None and len(captures) > 1 and shape_m2 > 0
    if is_solved:
        error_m, variance_m2, shapes_m = _solved(captures, residuals, variances, shape_m2)
        rests = residuals - shapes_m
    else:
        error_m, variance_m2 = _averaged(residuals, variances + shape_m2)
        rests = residuals
    distances = [capture.distance_m for capture in captures]
    field = FlatField(error_m, variance_m2, lens, (min(distances), max(distances)))
    groups = list(_groups(distances))
    firsts = [number for group in groups for number in group[: len(group) // 2]]
    lasts = [number for group in groups if len(group) > 1 for number in group[len(group) // 2 :]]
    in_time = _change(rests, variances, firsts, lasts)
    in_range = _change(rests, variances, groups[0], groups[-1]) if len(groups) > 1 else None
    surface_m = float(np.sqrt(shape_m2)) if len(captures) > 1 else np.nan
    return _with_doubts(Separated(field, captures, surface_m, is_solved, in_time, in_range))


def _averaged(residuals: np.ndarray, variances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted mean (h, w) over captures and its variance; NaN where no capture counts."""
    weights = np.where(np.isfinite(residuals), 1 / variances, 0.0)
    total = weights.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nansum(weights * residuals, axis=0) / total, np.where(
            total > 0, 1 / total, np.nan
        )


def _disagreement_m2(residuals: np.ndarray, variances: np.ndarray, counts: np.ndarray) -> float:
    """Return the variance between captures at a pixel beyond their noise, by the moments of a
    random effect."""
    several = counts > 1
    if not several.any():
        return 0.0
    held = residuals[:, several]
    noise = np.where(np.isfinite(residuals), variances, np.nan)[:, several]
    return max(float((np.nanvar(held, axis=0, ddof=1) - np.nanmean(noise, axis=0)).mean()), 0.0)


def _solved(
    captures: Sequence[FlatCapture], residuals: np.ndarray, variances: np.ndarray, shape_m2: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pattern (h, w), its variance, and the surface's shape as each capture sees it (c, h,
    w), by the least sum of squares of noise, pattern and shape, each over its own variance. The
    variance follows from beliefs passed between pixels and cells, exact but for loops and for what
    smooth fits take of the shape: before a wall rough by half of an Azure Kinect's pattern the
    true deviation is 1.3 times as large."""
    there = np.isfinite(residuals)
    pixel = np.flatnonzero(there) % there[0].size
    value = residuals[there]
    noise_m2 = variances[there]
    # cells as wide as the pixels of the nearest capture
    side = min(float(np.nanmedian(np.abs(np.diff(c.places_m[..., 0], axis=1)))) for c in captures)  # type: ignore[index]
    place = np.concatenate([capture.places_m[there[n]] for n, capture in enumerate(captures)])  # type: ignore[index]
    at = np.floor((place - place.min(axis=0)) / side).astype(np.int64)
    _, cell = np.unique(at[:, 0] * (at[:, 1].max() + 1) + at[:, 1], return_inverse=True)
    pixels = there[0].size
    cells = int(cell.max()) + 1
    pattern_m2 = max(float((value**2).mean() - noise_m2.mean() - shape_m2), float(noise_m2.mean()))
    rows = np.arange(len(value))
    loud = 1 / np.sqrt(noise_m2)
    places = (np.tile(rows, 2), np.concatenate([pixel, pixels + cell]))
    parts = np.concatenate([loud * np.sqrt(pattern_m2), loud * np.sqrt(shape_m2)])
    system = sparse.csr_array((parts, places), shape=(len(value), pixels + cells))
    found = lsqr(system, loud * value, damp=1.0, atol=SOLVED, btol=SOLVED, iter_lim=MOST_STEPS)[0]
    error_m = found[:pixels] * np.sqrt(pattern_m2)
    shapes_m = np.full(there.shape, np.nan)
    shapes_m[there] = (found[pixels:] * np.sqrt(shape_m2))[cell]
    variance_m2 = np.full(pixels, pattern_m2)
    for _ in range(BELIEF_STEPS):
        precision = 1 / (noise_m2 + variance_m2[pixel])
        left_m2 = 1 / (1 / shape_m2 + np.bincount(cell, precision, cells)[cell] - precision)
        variance_m2 = 1 / (1 / pattern_m2 + np.bincount(pixel, 1 / (noise_m2 + left_m2), pixels))
    unseen = ~there.any(axis=0)
    error_m = np.where(unseen, np.nan, error_m.reshape(unseen.shape))
    variance_m2 = np.where(unseen, np.nan, variance_m2.reshape(unseen.shape))
    return error_m, variance_m2, shapes_m


def _on_one_plane(captures: Sequence[FlatCapture]) -> tuple[FlatCapture, ...]:
    """Return the captures with places (h, w, 2) along the first one's plane if all have a pose,
    else without places."""
    if any(capture.places_m is None for capture in captures):
        return tuple(replace(capture, places_m=None) for capture in captures)
    normal = captures[0].normal
    across = np.cross([0.0, 1.0, 0.0], normal)
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(normal, across)], axis=-1)
    return tuple(replace(capture, places_m=capture.places_m @ axes) for capture in captures)


def _groups(distances: Sequence[float]) -> Iterator[list[int]]:
    """Yield the numbers of captures at similar distances, nearest first, each group in its own
    order."""
    waiting = sorted(range(len(distances)), key=lambda number: distances[number])
    while waiting:
        near = [
            number for number in waiting if distances[number] <= NEAR_ENOUGH * distances[waiting[0]]
        ]
        waiting = [number for number in waiting if number not in near]
        yield sorted(near)


def _change(
    rests: np.ndarray, variances: np.ndarray, one: Sequence[int], other: Sequence[int]
) -> PatternChange | None:
    if not one or not other:
        return None
    (a, of_a), (b, of_b) = (
        _averaged(rests[list(part)], variances[list(part)]) for part in (one, other)
    )
    both = np.isfinite(a) & np.isfinite(b)
    if both.sum() < 2:
        return None
    correlation = float(np.corrcoef(a[both], b[both])[0, 1])
    return PatternChange(
        correlation, _rms((a - b)[both]), float(np.sqrt((of_a + of_b)[both].mean()))
    )


def _with_doubts(found: Separated) -> Separated:
    """Return the pattern with warnings, and with a variance that holds for a pattern that is not
    stable."""
    notes = []
    captures = found.captures
    field = found.field
    rms_m = found.field.rms_m
    if len(captures) == 1 or not _moved(captures):
        why = (
            "one capture"
            if len(captures) == 1
            else "nothing shows that the camera moved between the captures"
        )
        why += (
            ": the surface's shape cannot be separated from the pattern and is assumed to be flat"
        )
        notes.append(
            f"{why} (move the camera by {LEAST_SHIFT_M / MM:.0f} mm; if along the surface, state --poses)"
        )
    parts = (
        (found.in_time, "from the first captures to the last"),
        (found.in_range, "with distance"),
    )
    known = [
        (part, apart)
        for part, apart in parts
        if part is not None and part.difference_m > SURE * part.noise_m
    ]
    changes = [(part, apart) for part, apart in known if part.excess_m > STABLE_SHARE * rms_m]
    # of two parts that scatter by t each, the mean is off a third part by 3/2 t^2, and their
    # difference is 2 t^2
    variance_m2 = (
        field.variance_m2 + 0.75 * max((part.excess_m for part, _ in changes), default=0.0) ** 2
    )
    if changes:
        why = " and ".join(f"{apart} by {part.excess_m / MM:.2g} mm" for part, apart in changes)
        also = (
            ""
            if found.separated
            else ", or the surface is not flat (state --poses to separate the two)"
        )
        notes.append(
            f"the pattern, {rms_m / MM:.2g} mm, is not stable: it changes {why} beyond its noise{also}"
        )
    return replace(found, field=replace(field, variance_m2=variance_m2, warnings=tuple(notes)))


def _moved(captures: Sequence[FlatCapture]) -> bool:
    """Return whether any capture was taken from another place than the first: by its pose, or by
    its plane."""
    first = captures[0]
    for other in captures[1:]:
        if first.places_m is not None and other.places_m is not None:
            shift_m = np.nanmedian(other.places_m - first.places_m, axis=(0, 1))
            if float(np.hypot(*shift_m)) >= LEAST_SHIFT_M:
                return True
            continue
        apart_m = abs(other.distance_m - first.distance_m)
        turn = float(np.linalg.norm(other.normal - first.normal))
        if apart_m > SAME_PLACE_M or turn > SAME_TURN:
            return True
    return False


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")
