"""Measures the size and the place of a detection: the thesis' extents, and a fitted model of a
damage, averaged over a family of shapes. Where the model does not hold, the contour at half depth
is measured instead. Depths are fitted along the optical axis, positive behind the surface; a
`Measurement` states them normal to the surface too. Sizes are measured on the surface."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from detectors.findings.extents import measure_extents
from detectors.findings.family import DEPTH_ERROR, ShapeFit, Size, Start, sized
from detectors.findings.pictures import pictures
from detectors.findings.shapes import Shape
from detectors.findings.surroundings import HoleModelConfig, Surroundings, surroundings_of
from detectors.interface import Detection, Evidence, Measurement
from detectors.pixels.masks import grown, parts_with
from detectors.pixels.noise import median_of
from harness.vocabulary.geometry import MM, Cloud

EXPLAINED = 0.7
"""Least share of a detection's squared residual that its fit must explain: correlated noise may
absorb a smooth dent, and a ragged damage has no shape."""
LONG = 0.5  # logarithm of length over width from which a slot is tried
MOST_STRETCH = 2.5  # largest start value of it
PARTLY = 1.0
"""Width of a mouth, in sides of the blur, from which a fit states a depth that is no lower bound:
four fifths of the rectangle then lie within the mouth. Of narrower holes, a fit knows only the
volume that their camera's filter leaves."""
WHOLLY = math.sqrt(2.0)
"""The same for a contour: the whole rectangle fits into the mouth."""
OPEN_M = 20.0 * MM
"""The contour clips deeper residuals to this depth, to follow an oblique hole's mouth, not what
shows through."""
FLANK = (0.35, 0.65)
"""Shares of the depth between whose contours that at half depth lies within a standard error."""
CONTOUR_ZOOM = 4  # sub-pixels of the half-depth contour along each axis

MISFIT = "the model of a blurred hole does not fit"
DARK = "part of the hole has no range"
AMBIGUOUS = (
    "the blur hides the difference between diameter and depth (the diameter is an upper limit)"
)


# --- both measurements of one detection ---


def measure_detection(
    cloud: Cloud,
    evidence: Evidence,
    detection: Detection,
    config: HoleModelConfig,
) -> Measurement:
    """Measure a detection both ways; failed measurements are NaN, with a note."""
    if not cloud.organised:
        return measure_extents(cloud, detection, "no pixel grid: extents only")
    measured = measure_extents(cloud, detection, "too few valid pixels around it for a model")
    around = surroundings_of(cloud, evidence, detection, config)
    if around is None:
        return measured
    pixels = around.widened & around.patch.used
    length_m, width_m, along = _sides(around, pixels)
    measured = replace(
        measured,
        volume_m3=_volume(around, pixels),
        length_m=length_m,
        width_m=width_m,
        along=along,
    )
    size, doubt = _modelled(around, config)
    if size is None:
        # a contour needs no fit, and so all pixels
        fine = surroundings_of(cloud, evidence, detection, config, fine=True)
        return _by_contour(measured, fine or around, doubt)
    fit = size.best
    spread = around.per_px_m.T @ fit.covariance[:2, :2] @ around.per_px_m
    measured = replace(
        around.positioned(measured, fit.u_px, fit.v_px),
        model_diameter_m=size.diameter_m,
        model_diameter_se_m=size.diameter_se_m,
        model_depth_m=size.depth_m,
        model_depth_se_m=size.depth_se_m,
        depth_is_least=around.hides_floor(size.diameter_m, PARTLY),
        normal_share=around.normal_share,
        sight_share=around.sight_share,
        # standard error along one axis: the two axes on the surface share the trace
        model_centre_se_m=float(np.sqrt(np.trace(spread) / 2.0)),
        shape=size.shape or "",
        model_note="",
    )
    return _as_slot(measured, around, size) if size.shape == "slot" else measured


def _as_slot(measured: Measurement, around: Surroundings, size: Size) -> Measurement:
    """Return a measurement with the sides and the direction of a fitted slot, and their errors."""
    fit = size.best
    sides_m = 2.0 * fit.radius_m * np.array([math.exp(fit.stretch), 1.0])
    angle_rad = fit.angle_rad
    length_se_m, width_se_m, angle_se_rad = ShapeFit(fit, size.patch).slot_errors
    errors_m = (length_se_m, width_se_m)
    if fit.stretch < 0.0:
        sides_m = sides_m[::-1]
        errors_m = errors_m[::-1]
        angle_rad += 0.5 * math.pi
    right, down = around.axes
    return replace(
        measured,
        length_m=float(sides_m[0]),
        width_m=float(sides_m[1]),
        along=math.cos(angle_rad) * right + math.sin(angle_rad) * down,
        length_se_m=errors_m[0],
        width_se_m=errors_m[1],
        along_se_rad=angle_se_rad,
    )


def _volume(around: Surroundings, pixels: np.ndarray) -> float:
    """Return the volume in m3 between the surface and the ``pixels`` (h, w) bool, positive
    behind the surface."""
    depth_m = float((around.patch.residual_m[pixels] - around.offset_m).sum())
    (ax, ay, _), (bx, by, _) = around.per_px_m
    # the area of a pixel perpendicular to the optical axis
    return depth_m * float(abs(ax * by - ay * bx))


def _sides(around: Surroundings, pixels: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Return length, width and direction (3,) of the length of the rectangle on the surface that
    has the second moments of the residual within the ``pixels`` (h, w) bool, minus those of the
    blur."""
    residual_m = around.patch.residual_m[pixels] - around.offset_m
    weight = np.maximum(around.sign * residual_m, 0.0)
    rows, columns = np.nonzero(pixels)
    if not weight.sum() > 0:
        return np.nan, np.nan, np.full(3, np.nan)
    weight = weight / weight.sum()
    positions = np.stack([columns, rows])
    positions = positions - (positions @ weight)[:, None]
    # a side b has the second moment b^2 / 12
    blur_moments = np.diag(np.square(around.patch.blur_px)) / 12
    moments = (positions * weight) @ positions.T - blur_moments
    variances, axes = np.linalg.eigh(around.per_px_m.T @ moments @ around.per_px_m)
    # the variance along the surface's normal is the one nearest to 0
    width_m = float(np.sqrt(12.0 * max(sorted(variances)[-2], 0.0)))
    length_m = float(np.sqrt(12.0 * max(variances[-1], 0.0)))
    return length_m, width_m, axes[:, -1]


# --- the model of a blurred hole, where it holds ---


def _modelled(
    around: Surroundings,
    config: HoleModelConfig,
) -> tuple[Size | None, str]:
    """Return the fitted hole, or None and the reason why the model does not hold."""
    detected = around.detected
    invalid = around.invalid
    too_deep = (
        f"deeper than {config.linear_depth_mm:g} mm, where the camera's filter no longer averages"
        " evenly"
    )
    inside = detected | (invalid & grown(detected, 1))
    if float((invalid & inside).sum()) > config.largest_invalid * float(inside.sum()):
        return None, DARK
    if around.peak_m > config.linear_depth_mm * MM:
        return None, too_deep
    if around.patch.used.sum() < 8:
        return None, MISFIT
    size = _sized(around)
    if size is None:
        return None, AMBIGUOUS
    if not _explains(around, size):
        return None, MISFIT
    if abs(size.depth_m) > config.linear_depth_mm * MM:
        return None, too_deep
    # the share of each pixel that the mouth covers
    fit = size.best
    flat = np.array([[fit.u_px, fit.v_px, fit.radius_m, -1.0, 0.0, fit.stretch, fit.angle_rad]])
    sharp = replace(size.patch, blur_px=(1.0, 1.0))
    mouth: Shape = "slot" if fit.shape == "slot" else "disc"
    disc = -pictures(sharp, flat, mouth)[0]
    if float(disc[invalid].sum()) > config.largest_invalid * float(disc.sum()):
        return None, DARK
    # a fit that leaves the radius open has a singular covariance
    if not fit.covariance[2, 2] < (config.largest_relative_error * fit.radius_m) ** 2:
        return None, AMBIGUOUS
    return size, ""


def _sized(around: Surroundings) -> Size | None:
    """Return the averaged size by the family of shapes."""
    start = _start(around)
    shapes: tuple[Shape, ...] = ("disc", "cap", "bowl")
    if start.stretch > LONG:
        shapes = (*shapes, "slot")
    return sized(around.patch, start, shapes, around.blurs)


def _start(around: Surroundings) -> Start:
    """Return start values: the centroid of the deviation, the radius that gives its volume, its
    peak, and the sides and the direction of its second moments."""
    pixels = grown(around.detected, around.reach_px) & around.patch.used
    weight = np.maximum(around.sign * (around.patch.residual_m[pixels] - around.offset_m), 0.0)
    rows, columns = np.nonzero(pixels)
    total = max(float(weight.sum()), 1e-12)
    length_m, width_m, along = _sides(around, around.widened & around.patch.used)
    stretch = 0.0
    angle_rad = 0.0
    if width_m > 0.0:
        right, down = around.axes
        stretch = min(math.log(length_m / width_m), MOST_STRETCH)
        angle_rad = math.atan2(along @ down, along @ right)
    return Start(
        u_px=float(weight @ columns) / total,
        v_px=float(weight @ rows) / total,
        radius_m=float(np.sqrt(total * around.area_m2 / (np.pi * around.peak_m))),
        depth_m=around.sign * around.peak_m,
        offset_m=around.offset_m,
        stretch=stretch,
        angle_rad=angle_rad,
    )


def _explains(around: Surroundings, size: Size) -> bool:
    """Return whether the best shape lies near the detection and explains its residual."""
    fit = size.best
    h, w = around.detected.shape
    row = round(fit.v_px)
    column = round(fit.u_px)
    if not (0 <= row < h and 0 <= column < w and around.widened[row, column]):
        return False
    inside = around.widened & around.patch.used
    seen_m = around.patch.residual_m[inside] - fit.offset_m
    left_m = seen_m - pictures(size.patch, fit.numbers[None], fit.shape)[0][inside]
    return bool(left_m @ left_m < (1.0 - EXPLAINED) * (seen_m @ seen_m))


# --- the contour at half depth, elsewhere ---


def _by_contour(
    measured: Measurement,
    around: Surroundings,
    doubt: str,
) -> Measurement:
    """Measure the contour at half of the depth, or at half of `OPEN_M` if that is less. Pixels
    without a range that touch the detection count as inside.

    The diameter's standard error is half of the difference to the contours at the shares `FLANK` of
    the depth, and what the blur moves a round contour. If no shape fits, the damage is ragged, and
    its depth is the mean one, volume over area; else it is the deepest."""
    residual_m = np.nan_to_num(around.sign * (around.patch.residual_m - around.offset_m))
    hollow = around.invalid & parts_with(around.detected | around.invalid, around.detected)
    top_m = min(around.peak_m, OPEN_M)
    residual_m = np.minimum(residual_m, top_m)
    residual_m[hollow] = top_m
    residual_m[~around.patch.used & ~hollow] = 0.0
    inside = _contour(around, residual_m, 0.5 * top_m)
    if not inside.any():
        return replace(measured, model_note=doubt + "; no half-depth contour")
    rows, columns = np.nonzero(inside)
    u = float((columns.mean() + 0.5) / CONTOUR_ZOOM - 0.5)
    v = float((rows.mean() + 0.5) / CONTOUR_ZOOM - 0.5)
    diameter_m = _diameter_m(around, inside)
    low_share, high_share = FLANK
    foot = _contour(around, residual_m, low_share * top_m)
    summit = _contour(around, residual_m, high_share * top_m)
    flank_m = 0.5 * (_diameter_m(around, foot) - _diameter_m(around, summit))
    blur_m2 = math.prod(around.patch.blur_px) * around.area_m2
    moved_m = min(blur_m2 / (6.0 * diameter_m), 0.5 * diameter_m)
    if doubt == AMBIGUOUS:
        moved_m = 0.5 * diameter_m
    if not hollow.any():  # a rim pixel may exceed half of `OPEN_M` although it lies mostly outside
        diameter_m -= (1.0 - top_m / around.peak_m) * math.sqrt(around.area_m2)
    diameter_se_m = math.hypot(flank_m, moved_m)
    depth_m, depth_se_m = _contour_depth(around, inside, residual_m)
    is_least = around.hides_floor(diameter_m, WHOLLY)
    is_ragged = doubt == MISFIT
    if is_ragged:
        # the volume is known: the area's error is twice that of the diameter
        area_m2 = inside.sum() / CONTOUR_ZOOM**2 * around.area_m2
        volume_m3 = measured.volume_m3 / around.normal_share
        depth_m = volume_m3 / area_m2
        depth_se_m = abs(depth_m) * 2.0 * diameter_se_m / diameter_m
    if hollow.sum() > around.detected.sum():
        is_least = around.sign > 0
    return replace(
        around.positioned(measured, u, v),
        model_diameter_m=diameter_m,
        model_diameter_se_m=diameter_se_m,
        model_depth_m=depth_m,
        model_depth_se_m=math.hypot(depth_se_m, DEPTH_ERROR * depth_m),
        depth_is_least=is_least,
        normal_share=around.normal_share,
        sight_share=around.sight_share,
        shape="ragged" if is_ragged else "",
        model_note=doubt + "; measured at the half-depth contour",
    )


def _contour(around: Surroundings, residual_m: np.ndarray, level_m: float) -> np.ndarray:
    """Return where a residual (h, w), drawn `CONTOUR_ZOOM` times as fine, exceeds a level in one
    piece with the detection."""
    height, width = residual_m.shape
    size = (CONTOUR_ZOOM * width, CONTOUR_ZOOM * height)
    fine_m = cv2.resize(residual_m, size, interpolation=cv2.INTER_LINEAR)
    seeds = cv2.resize(
        around.detected.astype(np.uint8),
        size,
        interpolation=cv2.INTER_NEAREST,
    )
    return parts_with(fine_m > level_m, seeds > 0)


def _diameter_m(around: Surroundings, inside: np.ndarray) -> float:
    """Return the diameter of the circle with the area of a `_contour`."""
    area_m2 = inside.sum() / CONTOUR_ZOOM**2 * around.area_m2
    return 2.0 * math.sqrt(area_m2 / math.pi)


def _contour_depth(
    around: Surroundings,
    inside: np.ndarray,
    residual_m: np.ndarray,
) -> tuple[float, float]:
    """Return the deepest residual along the optical axis, and its standard error: half of its
    difference from the median inside, and the noise."""
    height, width = residual_m.shape
    coarse = cv2.resize(
        inside.astype(np.uint8),
        (width, height),
        interpolation=cv2.INTER_NEAREST,
    )
    depths_m = around.sign * (around.patch.residual_m - around.offset_m)
    depths_m = depths_m[(coarse > 0) & np.isfinite(depths_m)]
    if not len(depths_m):
        return around.sign * around.peak_m, np.nan
    spread_m = 0.5 * (around.peak_m - median_of(depths_m))
    return around.sign * around.peak_m, math.hypot(spread_m, around.patch.noise_m)
