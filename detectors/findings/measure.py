"""Measures the size and the place of a detection: the thesis' extents, and a fitted model of a
blurred hole. Where the model does not hold, the contour at half depth is measured instead. Depths
are measured along the optical axis, positive behind the surface; sizes are measured on the
surface."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numba
import numpy as np
from pydantic import Field, field_validator

from detectors.averages.noise import median_of, quantile_of, sigma_of
from detectors.findings.clusters import PLAIN
from detectors.findings.hole_model import (
    MOST_MISFIT,
    HoleFit,
    HolePatch,
    fit_hole,
    normal_of,
    pictures,
    sight,
    straight_sight,
    whitened,
)
from detectors.interface import Detection, Evidence, Measurement
from detectors.masks import grown, parts_with
from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM, Cloud, Region, rotate_vectors

OTHER_DAMAGE_SIGMAS = 5.0
"""Pixels of the patch with a larger residual that do not touch the detection belong to other
damage."""
OPEN_M = 20.0 * MM
"""The contour clips deeper residuals to this depth, to follow an oblique hole's mouth, not what
shows through."""
CONTOUR_ZOOM = 4  # sub-pixels of the half-depth contour along each axis
NEAR_BLURS = 1.4
"""Distance from a detection, in sides of the blur, up to which all pixels count if the noise's
correlation is known. Leaving out 15 of 16 farther pixels raises the standard errors of diameter
and depth by 0.5 to 1.5 %."""
EXPLAINED = 0.5
"""Least share of a detection's mean residual that its fit must explain: correlated noise may
absorb a smooth dent."""
SHARPER_PX = (1.0, 2.0, 3.0, 5.0)
SHARPER_GAIN = 9.0
"""Blurs, smaller than the noise's, that are tried for a recording, and the gain in chi square that
accepts them."""


class HoleModelConfig(Config):
    """Assumptions of the model of a blurred hole. ``blur_px``: side of the square over which the
    camera averages: 5 for the Azure Kinect's depth engine (OpenK4A), 3 for the Kinect v2
    (libfreenect2), 1 for none. ``emitter_mm``: position of the light source in the camera's frame.
    ``linear_depth_mm``: at greater depths, the filter weights a deep neighbour by less than half,
    and the contour at half depth is more reliable. ``largest_invalid``: share of the disc that may
    lack a range. ``largest_relative_error``: of the diameter; beyond it, diameter and depth are
    ambiguous."""

    blur_px: int = Field(default=5, ge=1, le=31)
    emitter_mm: tuple[float, float, float] = (-14.0, 0.0, 1.0)
    linear_depth_mm: float = Field(default=75.0, gt=0)
    largest_invalid: float = Field(default=0.1, ge=0, le=1)
    largest_relative_error: float = Field(default=0.3, gt=0)

    @field_validator("blur_px")
    @classmethod
    def _odd(cls, blur_px: int) -> int:
        if blur_px % 2 == 0:
            raise ValueError("blur_px must be odd (1, 3, 5 ...): the filter has a centre pixel")
        return blur_px


def blur_in_cells(cloud: Cloud, config: HoleModelConfig) -> tuple[float, float]:
    """Return the sides, along columns and rows, of the rectangle over which the cloud is averaged,
    in its own pixels or cells: the reach of a recording's noise, else ``config.blur_px``. A map's
    interpolation between its views' pixels widens it to sqrt(blur^2 + 2) pixels. Cells larger than
    a pixel are means themselves."""
    if cloud.map_views is None or not cloud.organised:
        blur_px = cloud.noise_reach_px or float(config.blur_px)
        return blur_px, blur_px
    across = np.diff(cloud.points_m[..., 0], axis=1 - 0)
    down = np.diff(cloud.points_m[..., 1], axis=1 - 1)
    cells = [
        float(np.nanmedian(steps)) if np.isfinite(steps).any() else 1.0 for steps in (across, down)
    ]
    pixels = [pitch / cell for pitch, cell in zip(cloud.map_views.pixel_m, cells, strict=True)]
    along_u, along_v = (
        math.sqrt((config.blur_px**2 + 2.0) * pixel**2 + (1.0 if round(1.0 / pixel) > 1 else 0.0))
        for pixel in pixels
    )
    return along_u, along_v


def extents(points_m: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the thesis' size and centre (3,) of a cluster (n, 3), metres. The size is the mean of
    the distances between the two extreme points in x and between those in y; the centre is the
    mean of these four. Of equals, the first counts."""
    west, east, north, south = points_m[
        _extremes(points_m, np.zeros(len(points_m), np.int64), 1)[0]
    ]
    diameter = 0.5 * (math.dist(east, west) + math.dist(south, north))
    return diameter, (west + east + north + south) / 4.0


def centres_of(points_m: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Return the centres (count, 3) by `extents` of clusters of points (n, 3). ``labels`` (n,): -1
    for no cluster."""
    return np.asarray(points_m[_extremes(points_m, labels, count)].mean(axis=1))


@numba.njit(**PLAIN)
def _extremes(points: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Return the indices (count, 4) of the points with the least and greatest x, and with the
    least and greatest y."""
    found = np.full((count, 4), -1)
    for i in range(len(labels)):
        for end in range(4 if labels[i] >= 0 else 0):
            sign = 1.0 if end % 2 else -1.0
            best = found[labels[i], end]
            if best < 0 or sign * points[i, end // 2] > sign * points[best, end // 2]:
                found[labels[i], end] = i
    return found


def measure_extents(cloud: Cloud, detection: Detection, note: str) -> Measurement:
    """Measure the thesis' extents and the place on the sensor, if any. ``note`` says why nothing
    else is measured."""
    points = cloud.points_m.reshape(-1, 3)[detection.pixels]
    diameter, centre = extents(points)
    u = v = np.nan
    if cloud.organised:
        rows, columns = np.unravel_index(detection.pixels, cloud.points_m.shape[:2])
        u = float(columns.mean()) + cloud.region.col0
        v = float(rows.mean()) + cloud.region.row0
    return Measurement(u, v, len(points), detection.score, diameter, centre, model_note=note)


def measure_detection(
    cloud: Cloud,
    evidence: Evidence,
    detection: Detection,
    config: HoleModelConfig,
    by_lag: np.ndarray | None = None,
) -> Measurement:
    """Measure a detection both ways; failed measurements are NaN, with a note. ``by_lag``: the
    noise's correlation."""
    if not cloud.organised:
        return measure_extents(cloud, detection, "no pixel grid: extents only")
    placed = measure_extents(cloud, detection, "too few valid pixels around it for a model")
    rows, columns = np.unravel_index(detection.pixels, cloud.points_m.shape[:2])
    around = _surroundings(cloud, evidence, rows, columns, config)
    if around is None:
        return placed
    near = around.near & around.patch.used
    (ax, ay, _), (bx, by, _) = around.per_px_m
    # the area of a pixel perpendicular to the optical axis
    volume = float((around.patch.residual_m[near] - around.offset_m).sum()) * float(
        abs(ax * by - ay * bx)
    )
    length_m, width_m, along = _sides(around, near)
    placed = replace(placed, volume_m3=volume, length_m=length_m, width_m=width_m, along=along)
    fit, doubt = _modelled(around, config, by_lag)
    if fit is None:
        return _by_contour(placed, around, doubt)
    errors = np.sqrt(np.diag(fit.covariance))
    spread = around.per_px_m.T @ fit.covariance[:2, :2] @ around.per_px_m
    return replace(
        around.placed(placed, fit.u_px, fit.v_px),
        model_diameter_m=2.0 * fit.radius_m,
        model_diameter_se_m=2.0 * float(errors[2]),
        model_depth_m=fit.depth_m,
        model_depth_se_m=float(errors[3]),
        # standard error along one axis: the two axes on the surface share the trace
        model_centre_se_m=float(np.sqrt(np.trace(spread) / 2.0)),
        model_note="",
    )


def _sides(around: _Surroundings, near: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Return length, width and direction (3,) of the length of the rectangle on the surface that
    has the second moments of the residual within ``near`` (h, w) bool, minus those of the blur."""
    residual = around.patch.residual_m[near] - around.offset_m
    weight = np.maximum(around.sign * residual, 0.0)
    v, u = np.nonzero(near)
    if not weight.sum() > 0:
        return np.nan, np.nan, np.full(3, np.nan)
    places = np.stack([u, v])
    weight = weight / weight.sum()
    places = places - (places @ weight)[:, None]
    moments = (places * weight) @ places.T - np.diag(np.square(around.patch.blur_px)) / 12
    variances, axes = np.linalg.eigh(around.per_px_m.T @ moments @ around.per_px_m)
    # the variance along the surface's normal is the one nearest to 0
    width_m = float(np.sqrt(12.0 * max(sorted(variances)[-2], 0.0)))
    length_m = float(np.sqrt(12.0 * max(variances[-1], 0.0)))
    return length_m, width_m, axes[:, -1]


@dataclass(frozen=True)
class _Surroundings:
    """A detection and its neighbourhood. ``near`` (h, w) bool: its ``own`` pixels, grown by one
    more than half of the blur, ``reach_px``. ``offset_m``: residual around it. ``sign``,
    ``peak_m``: of its own residual, less the offset. ``origin_m``: the surface's point at (``u0``,
    ``v0``), the detection's centroid. ``sharper_px``: smaller blurs to try, as noise may be
    blurred more than the scene."""

    patch: HolePatch
    own: np.ndarray
    near: np.ndarray
    invalid: np.ndarray
    offset_m: float
    sign: float
    peak_m: float
    reach_px: int
    u0: float
    v0: float
    origin_m: np.ndarray
    per_px_m: np.ndarray
    sharper_px: tuple[float, ...]

    @property
    def area_m2(self) -> float:
        """Area of one pixel on the surface."""
        return math.hypot(*normal_of(self.per_px_m))

    def placed(self, measured: Measurement, u: float, v: float) -> Measurement:
        """Return the measurement with the position (u, v) of the patch as its place."""
        du = u - self.u0
        dv = v - self.v0
        centre_m = self.origin_m + du * self.per_px_m[0] + dv * self.per_px_m[1]
        return replace(
            measured, u_px=du + measured.u_px, v_px=dv + measured.v_px, model_centre_m=centre_m
        )


def _surroundings(
    cloud: Cloud, evidence: Evidence, rows: np.ndarray, columns: np.ndarray, config: HoleModelConfig
) -> _Surroundings | None:
    """Cut out the detection with a margin of twice the blur on each side; None with too few valid
    pixels around."""
    h, w = cloud.points_m.shape[:2]
    sides = blur_in_cells(cloud, config)
    blur = max(sides)
    tight = Region(int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1)
    corner = tight.grown(math.ceil(2 * blur) + 2, h, w)
    cut = corner.within(Region(0, h, 0, w))
    residual = evidence.residual_m[cut]
    points = cloud.points_m[cut]
    own = np.zeros(residual.shape, dtype=bool)
    own[rows - corner.row0, columns - corner.col0] = True
    finite = np.isfinite(residual)
    reach = int(blur / 2)
    near = grown(own, reach + 1)
    ring = residual[finite & ~near]
    if len(ring) < 12:
        return None
    offset = median_of(ring)
    noise = sigma_of(ring - offset)
    plane = local_plane(points, evidence.surface_z_m[cut], finite, own, cloud.projection)
    if plane is None:
        return None
    centre, per_px = plane
    # large residuals that do not touch the detection are other damage; the blur spreads it
    stands_out = (np.abs(residual - offset) > OTHER_DAMAGE_SIGMAS * max(noise, 1e-9)) | own
    others = stands_out & ~parts_with(stands_out, own)
    used = finite & (own | ~grown(others, reach))
    deviations = residual[own] - offset
    sign = 1.0 if deviations.sum() >= 0 else -1.0
    peak = max(quantile_of(sign * deviations, 0.9), 1e-9)
    # the camera that sees the surface's point, or all the cameras of a map
    emitter = np.array(config.emitter_mm) * MM
    views = cloud.map_views
    if cloud.projection == "central":
        sights = [sight(centre, per_px, emitter)]
    elif views is None:
        sights = [straight_sight(per_px)]
    else:
        sights = [
            sight(centre - T[:3, 3], per_px, rotate_vectors(T, emitter), float(share))
            for T, share in zip(views.T_cloud_cameras, views.shares, strict=True)
        ]
    patch = HolePatch(residual, used, per_px @ per_px.T, sides, noise, np.array(sights))
    v0, u0 = (float(axis.mean()) for axis in np.nonzero(own))
    invalid = ~np.isfinite(points[..., 2])
    sharper = tuple(side for side in SHARPER_PX if side < cloud.noise_reach_px)
    return _Surroundings(
        patch, own, near, invalid, offset, sign, peak, reach, u0, v0, centre, per_px, sharper
    )


def local_plane(
    points: np.ndarray, surface_z: np.ndarray, finite: np.ndarray, own: np.ndarray, projection: str
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the surface's point at the detection's centroid (3,) and its derivatives by u and v
    (2, 3), by linear regression of directions (in a parallel projection of x and y) and of the
    surface's z; None if singular."""
    v0, u0 = (float(axis.mean()) for axis in np.nonzero(own))
    (x, y, z), pixels = points[finite].T, np.nonzero(finite)
    scale = 1.0 if projection == "parallel" else z
    rows = np.stack(
        [np.ones(len(x)), pixels[1] - u0, pixels[0] - v0, x / scale, y / scale, surface_z[finite]]
    )
    sums = rows[:3] @ rows.T
    try:
        beta = np.linalg.solve(sums[:, :3], sums[:, 3:])
    except np.linalg.LinAlgError:
        return None
    if projection == "parallel":
        centre = beta[0]
        per_px = beta[1:]
    else:
        ray = np.array([*beta[0, :2], 1.0])
        centre = ray * beta[0, 2]
        per_px = beta[1:] * [1.0, 1.0, 0.0] * beta[0, 2] + ray * beta[1:, 2:]
    if not math.hypot(*normal_of(per_px)) > 1e-12:
        return None
    return centre, per_px


def _modelled(
    around: _Surroundings, config: HoleModelConfig, by_lag: np.ndarray | None
) -> tuple[HoleFit | None, str]:
    """Return the fitted hole, or None and the reason why the model does not hold."""
    own = around.own
    invalid = around.invalid
    patch = around.patch
    dark = "part of the hole has no range"
    too_deep = f"deeper than {config.linear_depth_mm:g} mm, where the camera's filter no longer averages evenly"
    inside = own | (invalid & grown(own, 1))
    if float((invalid & inside).sum()) > config.largest_invalid * float(inside.sum()):
        return None, dark
    if around.peak_m > config.linear_depth_mm * MM:
        return None, too_deep
    # start values: centroid of the deviation, peak depth, and the radius that gives the volume
    near = grown(own, around.reach_px) & patch.used
    weight = np.maximum(around.sign * (patch.residual_m[near] - around.offset_m), 0.0)
    v, u = np.nonzero(near)
    total = max(float(weight.sum()), 1e-12)
    radius = float(np.sqrt(total * around.area_m2 / (np.pi * around.peak_m)))
    u0 = float(weight @ u) / total
    v0 = float(weight @ v) / total
    if patch.used.sum() < 6:
        return None, "the model of a blurred hole does not fit"
    start = (u0, v0, radius, around.sign * around.peak_m, around.offset_m)
    if by_lag is not None:
        known_by = grown(own, round(NEAR_BLURS * max(patch.blur_px)), cv2.MORPH_ELLIPSE)
        patch = whitened(patch, by_lag, around.offset_m, known_by)
    fit = fit_hole(patch, *start)
    seen_by = patch
    pixels = int(patch.used.sum()) + patch.left_out
    for side in around.sharper_px if fit.misfit else ():
        narrower = replace(patch, blur_px=(side, side))
        other = fit_hole(narrower, *start)
        gain = pixels * (fit.misfit**2 - other.misfit**2)
        if other.converged and gain > (SHARPER_GAIN * other.misfit**2 if fit.converged else 0.0):
            fit = other
            seen_by = narrower
    h, w = own.shape
    row = round(fit.v_px)
    column = round(fit.u_px)
    is_near = 0 <= row < h and 0 <= column < w and around.near[row, column]
    fitted = pictures(
        seen_by, np.array([[fit.u_px, fit.v_px, fit.radius_m, fit.depth_m, fit.wall]])
    )[0][own].mean()
    share = fitted / (patch.residual_m[own].mean() - fit.offset_m)
    if not (fit.converged and is_near and fit.misfit < MOST_MISFIT and share > EXPLAINED):
        return None, "the model of a blurred hole does not fit"
    if abs(fit.depth_m) > config.linear_depth_mm * MM:
        return None, too_deep
    # the share of each pixel that the disc covers
    flat = np.array([[fit.u_px, fit.v_px, fit.radius_m, -1.0, 0.0]])
    disc = -pictures(replace(patch, blur_px=(1.0, 1.0)), flat)[0]
    if float(disc[invalid].sum()) > config.largest_invalid * float(disc.sum()):
        return None, dark
    # rounding can make the variance of a singular fit negative
    variance = float(fit.covariance[2, 2])
    if not 0 < variance < (config.largest_relative_error * fit.radius_m) ** 2:
        return (
            None,
            "the blur hides the difference between diameter and depth (the diameter is an upper limit)",
        )
    return fit, ""


def _by_contour(measured: Measurement, around: _Surroundings, doubt: str) -> Measurement:
    """Measure the contour at half of the depth, or at half of `OPEN_M` if that is less. Pixels
    without a range that touch the detection count as inside."""
    residual = np.nan_to_num(around.sign * (around.patch.residual_m - around.offset_m))
    hollow = around.invalid & parts_with(around.own | around.invalid, around.own)
    top_m = min(around.peak_m, OPEN_M)
    residual = np.minimum(residual, top_m)
    residual[hollow] = top_m
    residual[~around.patch.used & ~hollow] = 0.0
    size = tuple(CONTOUR_ZOOM * side for side in residual.shape[::-1])
    fine = cv2.resize(residual, size, interpolation=cv2.INTER_LINEAR)
    seeds = cv2.resize(around.own.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    inside = parts_with(fine > 0.5 * top_m, seeds > 0)
    if not inside.any():
        return replace(measured, model_note=doubt + "; no half-depth contour")
    v, u = (float((axis.mean() + 0.5) / CONTOUR_ZOOM - 0.5) for axis in np.nonzero(inside))
    area = inside.sum() / CONTOUR_ZOOM**2 * around.area_m2
    diameter_m = 2.0 * float(np.sqrt(area / np.pi))
    if not hollow.any():  # a rim pixel may exceed half of `OPEN_M` although it lies mostly outside
        diameter_m -= (1.0 - top_m / around.peak_m) * math.sqrt(around.area_m2)
    depth_m = np.nan if hollow.sum() > around.own.sum() else around.sign * around.peak_m
    note = doubt + "; measured at the half-depth contour, without standard errors"
    placed = around.placed(measured, u, v)
    return replace(placed, model_diameter_m=diameter_m, model_depth_m=depth_m, model_note=note)
