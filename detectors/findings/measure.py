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
from detectors.pixels.clusters import PLAIN
from detectors.pixels.masks import grown, parts_with
from detectors.pixels.noise import median_of, quantile_of, sigma_of
from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM, Cloud, Region, rotate_vectors

OTHER_DAMAGE_SIGMAS = 5.0
"""Pixels of the patch with a larger residual that do not touch the detection belong to other
damage."""
FEWEST_AROUND = 12  # valid pixels around a detection
NEAR_BLURS = 1.4
"""Distance from a detection, in sides of the blur, up to which all pixels count if the noise's
correlation is known. Leaving out 15 of 16 farther pixels raises the standard errors of diameter
and depth by 0.5 to 1.5 %."""
EXPLAINED = 0.5
"""Least share of a detection's mean residual that its fit must explain: correlated noise may
absorb a smooth dent."""
SHARPER_PX = (1.0, 2.0, 3.0, 5.0)
"""Blurs, smaller than the noise's, that are tried for a recording: noise may be blurred more than
the scene."""
SHARPER_GAIN = 9.0  # gain in chi square that accepts them
OPEN_M = 20.0 * MM
"""The contour clips deeper residuals to this depth, to follow an oblique hole's mouth, not what
shows through."""
CONTOUR_ZOOM = 4  # sub-pixels of the half-depth contour along each axis

MISFIT = "the model of a blurred hole does not fit"
DARK = "part of the hole has no range"
AMBIGUOUS = (
    "the blur hides the difference between diameter and depth (the diameter is an upper limit)"
)


class HoleModelConfig(Config):
    """Assumptions of the model of a blurred hole.

    - ``blur_px``: side of the square over which the camera averages: 5 for the Azure Kinect's depth
      engine (OpenK4A), 3 for the Kinect v2 (libfreenect2), 1 for none.
    - ``emitter_mm``: position of the light source in the camera's frame.
    - ``linear_depth_mm``: at greater depths, the filter weights a deep neighbour by less than half,
      and the contour at half depth is more reliable.
    - ``largest_invalid``: share of the disc that may lack a range.
    - ``largest_relative_error``: of the diameter; beyond it, diameter and depth are ambiguous."""

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
    pitch_u, pitch_v = cloud.map_views.pixel_m
    pixel_u = pitch_u / _cell_m(np.diff(cloud.points_m[..., 0], axis=1))
    pixel_v = pitch_v / _cell_m(np.diff(cloud.points_m[..., 1], axis=0))
    return _map_blur(config.blur_px, pixel_u), _map_blur(config.blur_px, pixel_v)


def _cell_m(steps_m: np.ndarray) -> float:
    """Return the typical step between cells; 1 if there is none."""
    return float(np.nanmedian(steps_m)) if np.isfinite(steps_m).any() else 1.0


def _map_blur(blur_px: int, pixel: float) -> float:
    """Return the blur of a map in cells, whose views' pixels are ``pixel`` cells wide."""
    cell = 1.0 if round(1.0 / pixel) > 1 else 0.0
    return math.sqrt((blur_px**2 + 2.0) * pixel**2 + cell)


# --- the thesis' extents ---


def extents(points_m: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the thesis' size and centre (3,) of a cluster (n, 3), metres. The size is the mean of
    the distances between the two extreme points in x and between those in y; the centre is the
    mean of these four. Of equals, the first counts."""
    ends = _extremes(points_m, np.zeros(len(points_m), np.int64), 1)[0]
    west, east, north, south = points_m[ends]
    diameter = 0.5 * (math.dist(east, west) + math.dist(south, north))
    return diameter, (west + east + north + south) / 4.0


def centres_of(
    points_m: np.ndarray,
    labels: np.ndarray,
    count: int,
) -> np.ndarray:
    """Return the centres (count, 3) by `extents` of clusters of points (n, 3). ``labels`` (n,): -1
    for no cluster."""
    return points_m[_extremes(points_m, labels, count)].mean(axis=1)


@numba.njit(**PLAIN)
def _extremes(
    points: np.ndarray,
    labels: np.ndarray,
    count: int,
) -> np.ndarray:
    """Return the indices (count, 4) of each cluster's points with the least and greatest x, and
    with the least and greatest y."""
    extremes = np.full((count, 4), -1)
    for i in range(len(labels)):
        if labels[i] < 0:
            continue
        for end in range(4):
            axis = end // 2
            sign = 1.0 if end % 2 else -1.0
            best = extremes[labels[i], end]
            if best < 0 or sign * points[i, axis] > sign * points[best, axis]:
                extremes[labels[i], end] = i
    return extremes


def measure_extents(
    cloud: Cloud,
    detection: Detection,
    note: str,
) -> Measurement:
    """Measure the thesis' extents and the position on the sensor, if any. ``note`` says why
    nothing else is measured."""
    points_m = cloud.points_m.reshape(-1, 3)[detection.pixels]
    diameter_m, centre_m = extents(points_m)
    u = np.nan
    v = np.nan
    if cloud.organised:
        rows, columns = np.unravel_index(detection.pixels, cloud.points_m.shape[:2])
        u = float(columns.mean()) + cloud.region.col0
        v = float(rows.mean()) + cloud.region.row0
    return Measurement(
        u_px=u,
        v_px=v,
        points=len(points_m),
        score=detection.score,
        extent_diameter_m=diameter_m,
        extent_centre_m=centre_m,
        model_note=note,
    )


# --- both measurements of one detection ---


def measure_detection(
    cloud: Cloud,
    evidence: Evidence,
    detection: Detection,
    config: HoleModelConfig,
    by_lag: np.ndarray | None = None,
) -> Measurement:
    """Measure a detection both ways; failed measurements are NaN, with a note. ``by_lag`` (odd,
    odd): the noise's correlation."""
    if not cloud.organised:
        return measure_extents(cloud, detection, "no pixel grid: extents only")
    measured = measure_extents(cloud, detection, "too few valid pixels around it for a model")
    around = _surroundings(cloud, evidence, detection, config)
    if around is None:
        return measured
    near = around.near & around.patch.used
    length_m, width_m, along = _sides(around, near)
    measured = replace(
        measured,
        volume_m3=_volume(around, near),
        length_m=length_m,
        width_m=width_m,
        along=along,
    )
    fit, doubt = _modelled(around, config, by_lag)
    if fit is None:
        return _by_contour(measured, around, doubt)
    errors = np.sqrt(np.diag(fit.covariance))
    spread = around.per_px_m.T @ fit.covariance[:2, :2] @ around.per_px_m
    return replace(
        around.positioned(measured, fit.u_px, fit.v_px),
        model_diameter_m=2.0 * fit.radius_m,
        model_diameter_se_m=2.0 * float(errors[2]),
        model_depth_m=fit.depth_m,
        model_depth_se_m=float(errors[3]),
        # standard error along one axis: the two axes on the surface share the trace
        model_centre_se_m=float(np.sqrt(np.trace(spread) / 2.0)),
        model_note="",
    )


@dataclass(frozen=True)
class _Surroundings:
    """A detection and its neighbourhood, a patch of h x w pixels."""

    patch: HolePatch
    own: np.ndarray
    """(h, w) bool: the detection's pixels."""
    near: np.ndarray
    """(h, w) bool: these grown by one more than ``reach_px``."""
    invalid: np.ndarray
    """(h, w) bool: pixels without a range."""
    offset_m: float
    """Residual around the detection."""
    sign: float
    """1 if the detection lies behind the surface, -1 if in front of it."""
    peak_m: float
    """Its largest residual (the 90th percentile) beyond the offset, above 0 on either side."""
    reach_px: int
    """Half of the blur."""
    u0: float
    """Centroid of the detection's pixels in the patch, along columns."""
    v0: float
    """The same along rows."""
    origin_m: np.ndarray
    """(3,): the surface's point at (u0, v0)."""
    per_px_m: np.ndarray
    """(2, 3): the surface's derivatives by u and v."""
    sharper_px: tuple[float, ...]
    """Smaller blurs to try."""

    @property
    def area_m2(self) -> float:
        """Area of one pixel on the surface."""
        return math.hypot(*normal_of(self.per_px_m))

    def positioned(
        self,
        measured: Measurement,
        u: float,
        v: float,
    ) -> Measurement:
        """Return the measurement with the position (u, v) of the patch as its centre."""
        du = u - self.u0
        dv = v - self.v0
        return replace(
            measured,
            u_px=du + measured.u_px,
            v_px=dv + measured.v_px,
            model_centre_m=self.origin_m + du * self.per_px_m[0] + dv * self.per_px_m[1],
        )


def _surroundings(
    cloud: Cloud,
    evidence: Evidence,
    detection: Detection,
    config: HoleModelConfig,
) -> _Surroundings | None:
    """Cut out the detection with a margin of twice the blur on each side; None with too few valid
    pixels around."""
    h, w = cloud.points_m.shape[:2]
    rows, columns = np.unravel_index(detection.pixels, (h, w))
    blur_px = blur_in_cells(cloud, config)
    tight = Region(
        int(rows.min()),
        int(rows.max()) + 1,
        int(columns.min()),
        int(columns.max()) + 1,
    )
    corner = tight.grown(math.ceil(2 * max(blur_px)) + 2, h, w)
    cut = corner.within(Region(0, h, 0, w))
    residual_m = evidence.residual_m[cut]
    points_m = cloud.points_m[cut]
    own = np.zeros(residual_m.shape, dtype=bool)
    own[rows - corner.row0, columns - corner.col0] = True
    finite = np.isfinite(residual_m)
    reach_px = int(max(blur_px) / 2)
    near = grown(own, reach_px + 1)
    ring_m = residual_m[finite & ~near]
    if len(ring_m) < FEWEST_AROUND:
        return None
    offset_m = median_of(ring_m)
    noise_m = sigma_of(ring_m - offset_m)
    plane = local_plane(
        points_m,
        evidence.surface_z_m[cut],
        finite,
        own,
        cloud.projection,
    )
    if plane is None:
        return None
    origin_m, per_px_m = plane
    # large residuals that do not touch the detection are other damage; the blur spreads it
    limit_m = OTHER_DAMAGE_SIGMAS * max(noise_m, 1e-9)
    stands_out = (np.abs(residual_m - offset_m) > limit_m) | own
    other_damage = stands_out & ~parts_with(stands_out, own)
    used = finite & (own | ~grown(other_damage, reach_px))
    deviations_m = residual_m[own] - offset_m
    sign = 1.0 if deviations_m.sum() >= 0 else -1.0
    u0, v0 = _centroid(own)
    patch = HolePatch(
        residual_m=residual_m,
        used=used,
        metric_m2=per_px_m @ per_px_m.T,
        blur_px=blur_px,
        noise_m=noise_m,
        sights=_sights(cloud, origin_m, per_px_m, config),
    )
    return _Surroundings(
        patch=patch,
        own=own,
        near=near,
        invalid=~np.isfinite(points_m[..., 2]),
        offset_m=offset_m,
        sign=sign,
        peak_m=max(quantile_of(sign * deviations_m, 0.9), 1e-9),
        reach_px=reach_px,
        u0=u0,
        v0=v0,
        origin_m=origin_m,
        per_px_m=per_px_m,
        sharper_px=tuple(side for side in SHARPER_PX if side < cloud.noise_reach_px),
    )


def _centroid(mask: np.ndarray) -> tuple[float, float]:
    """Return the mean column and the mean row of a mask's pixels."""
    rows, columns = np.nonzero(mask)
    return float(columns.mean()), float(rows.mean())


def _sights(
    cloud: Cloud,
    origin_m: np.ndarray,
    per_px_m: np.ndarray,
    config: HoleModelConfig,
) -> np.ndarray:
    """Return the viewpoints (s, 8) of the camera that sees the surface's point (3,), or of all the
    cameras of a map."""
    emitter_m = np.array(config.emitter_mm) * MM
    views = cloud.map_views
    if cloud.projection == "central":
        return np.array([sight(origin_m, per_px_m, emitter_m)])
    if views is None:
        return np.array([straight_sight(per_px_m)])
    sights = []
    for T_cloud_camera, share in zip(views.T_cloud_cameras, views.shares, strict=True):
        seen_from_m = origin_m - T_cloud_camera[:3, 3]
        turned_m = rotate_vectors(T_cloud_camera, emitter_m)
        sights.append(sight(seen_from_m, per_px_m, turned_m, float(share)))
    return np.array(sights)


def local_plane(
    points: np.ndarray,
    surface_z: np.ndarray,
    finite: np.ndarray,
    own: np.ndarray,
    projection: str,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the surface's point at the detection's centroid (3,) and its derivatives by u and v
    (2, 3), by linear regression of directions (in a parallel projection of x and y) and of the
    surface's z; None if singular.

    Args:
        points: (h, w, 3), metres, of a patch.
        surface_z: (h, w), metres, of the fitted surface.
        finite: (h, w) bool, the pixels to use.
        own: (h, w) bool, the detection's pixels.
        projection: "central" or "parallel"."""
    u0, v0 = _centroid(own)
    x, y, z = points[finite].T
    rows, columns = np.nonzero(finite)
    scale = 1.0 if projection == "parallel" else z
    ones = np.ones(len(x))
    system = np.stack([ones, columns - u0, rows - v0, x / scale, y / scale, surface_z[finite]])
    sums = system[:3] @ system.T
    try:
        beta = np.linalg.solve(sums[:, :3], sums[:, 3:])
    except np.linalg.LinAlgError:
        return None
    if projection == "parallel":
        centre = beta[0]
        per_px = beta[1:]
    else:
        # the point is z * ray, and both change with u and v
        ray = np.array([*beta[0, :2], 1.0])
        centre = ray * beta[0, 2]
        per_px = beta[1:] * [1.0, 1.0, 0.0] * beta[0, 2] + ray * beta[1:, 2:]
    if not math.hypot(*normal_of(per_px)) > 1e-12:
        return None
    return centre, per_px


def _volume(around: _Surroundings, near: np.ndarray) -> float:
    """Return the volume in m3 between the surface and the pixels ``near`` (h, w) bool, positive
    behind the surface."""
    depth_m = float((around.patch.residual_m[near] - around.offset_m).sum())
    (ax, ay, _), (bx, by, _) = around.per_px_m
    # the area of a pixel perpendicular to the optical axis
    return depth_m * float(abs(ax * by - ay * bx))


def _sides(around: _Surroundings, near: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Return length, width and direction (3,) of the length of the rectangle on the surface that
    has the second moments of the residual within ``near`` (h, w) bool, minus those of the blur."""
    residual_m = around.patch.residual_m[near] - around.offset_m
    weight = np.maximum(around.sign * residual_m, 0.0)
    rows, columns = np.nonzero(near)
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
    around: _Surroundings,
    config: HoleModelConfig,
    by_lag: np.ndarray | None,
) -> tuple[HoleFit | None, str]:
    """Return the fitted hole, or None and the reason why the model does not hold."""
    own = around.own
    invalid = around.invalid
    too_deep = (
        f"deeper than {config.linear_depth_mm:g} mm, where the camera's filter no longer averages"
        " evenly"
    )
    inside = own | (invalid & grown(own, 1))
    if float((invalid & inside).sum()) > config.largest_invalid * float(inside.sum()):
        return None, DARK
    if around.peak_m > config.linear_depth_mm * MM:
        return None, too_deep
    if around.patch.used.sum() < 6:
        return None, MISFIT
    fit, patch = _fitted(around, by_lag)
    if not _explains(around, fit, patch):
        return None, MISFIT
    if abs(fit.depth_m) > config.linear_depth_mm * MM:
        return None, too_deep
    # the share of each pixel that the disc covers
    flat = np.array([[fit.u_px, fit.v_px, fit.radius_m, -1.0, 0.0]])
    disc = -pictures(replace(patch, blur_px=(1.0, 1.0)), flat)[0]
    if float(disc[invalid].sum()) > config.largest_invalid * float(disc.sum()):
        return None, DARK
    # rounding can make the variance of a singular fit negative
    variance = float(fit.covariance[2, 2])
    if not 0 < variance < (config.largest_relative_error * fit.radius_m) ** 2:
        return None, AMBIGUOUS
    return fit, ""


def _fitted(around: _Surroundings, by_lag: np.ndarray | None) -> tuple[HoleFit, HolePatch]:
    """Return the fitted hole, and the patch with the blur with which it fits best."""
    patch = around.patch
    start = _start(around)
    if by_lag is not None:
        reach_px = round(NEAR_BLURS * max(patch.blur_px))
        near = grown(around.own, reach_px, cv2.MORPH_ELLIPSE)
        patch = whitened(patch, by_lag, around.offset_m, near)
    fit = fit_hole(patch, *start)
    if not fit.misfit:
        return fit, patch
    best_patch = patch
    pixels = int(patch.used.sum()) + patch.left_out
    for side in around.sharper_px:
        sharper_patch = replace(patch, blur_px=(side, side))
        sharper = fit_hole(sharper_patch, *start)
        gain = pixels * (fit.misfit**2 - sharper.misfit**2)
        least_gain = SHARPER_GAIN * sharper.misfit**2 if fit.converged else 0.0
        if sharper.converged and gain > least_gain:
            fit = sharper
            best_patch = sharper_patch
    return fit, best_patch


def _start(around: _Surroundings) -> tuple[float, float, float, float, float]:
    """Return start values of u, v, radius, depth and offset: the centroid of the deviation, the
    radius that gives its volume, and its peak."""
    near = grown(around.own, around.reach_px) & around.patch.used
    weight = np.maximum(around.sign * (around.patch.residual_m[near] - around.offset_m), 0.0)
    rows, columns = np.nonzero(near)
    total = max(float(weight.sum()), 1e-12)
    u = float(weight @ columns) / total
    v = float(weight @ rows) / total
    radius_m = float(np.sqrt(total * around.area_m2 / (np.pi * around.peak_m)))
    return u, v, radius_m, around.sign * around.peak_m, around.offset_m


def _explains(
    around: _Surroundings,
    fit: HoleFit,
    patch: HolePatch,
) -> bool:
    """Return whether a fit has converged near the detection and explains its residual."""
    h, w = around.own.shape
    row = round(fit.v_px)
    column = round(fit.u_px)
    if not (0 <= row < h and 0 <= column < w and around.near[row, column]):
        return False
    hole = np.array([[fit.u_px, fit.v_px, fit.radius_m, fit.depth_m, fit.wall]])
    fitted_m = pictures(patch, hole)[0][around.own].mean()
    share = fitted_m / (patch.residual_m[around.own].mean() - fit.offset_m)
    return bool(fit.converged and fit.misfit < MOST_MISFIT and share > EXPLAINED)


# --- the contour at half depth, elsewhere ---


def _by_contour(
    measured: Measurement,
    around: _Surroundings,
    doubt: str,
) -> Measurement:
    """Measure the contour at half of the depth, or at half of `OPEN_M` if that is less. Pixels
    without a range that touch the detection count as inside."""
    residual_m = np.nan_to_num(around.sign * (around.patch.residual_m - around.offset_m))
    hollow = around.invalid & parts_with(around.own | around.invalid, around.own)
    top_m = min(around.peak_m, OPEN_M)
    residual_m = np.minimum(residual_m, top_m)
    residual_m[hollow] = top_m
    residual_m[~around.patch.used & ~hollow] = 0.0
    height, width = residual_m.shape
    size = (CONTOUR_ZOOM * width, CONTOUR_ZOOM * height)
    fine_m = cv2.resize(residual_m, size, interpolation=cv2.INTER_LINEAR)
    seeds = cv2.resize(
        around.own.astype(np.uint8),
        size,
        interpolation=cv2.INTER_NEAREST,
    )
    inside = parts_with(fine_m > 0.5 * top_m, seeds > 0)
    if not inside.any():
        return replace(measured, model_note=doubt + "; no half-depth contour")
    rows, columns = np.nonzero(inside)
    u = float((columns.mean() + 0.5) / CONTOUR_ZOOM - 0.5)
    v = float((rows.mean() + 0.5) / CONTOUR_ZOOM - 0.5)
    area_m2 = inside.sum() / CONTOUR_ZOOM**2 * around.area_m2
    diameter_m = 2.0 * float(np.sqrt(area_m2 / np.pi))
    if not hollow.any():  # a rim pixel may exceed half of `OPEN_M` although it lies mostly outside
        diameter_m -= (1.0 - top_m / around.peak_m) * math.sqrt(around.area_m2)
    depth_m = np.nan if hollow.sum() > around.own.sum() else around.sign * around.peak_m
    return replace(
        around.positioned(measured, u, v),
        model_diameter_m=diameter_m,
        model_depth_m=depth_m,
        model_note=doubt + "; measured at the half-depth contour, without standard errors",
    )
