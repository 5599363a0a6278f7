"""Measures the size and the place of a detection: the thesis' extents, and a fitted model of a
damage, averaged over a family of shapes. Where the model does not hold, the contour at half depth
is measured instead. Depths are fitted along the optical axis, positive behind the surface; a
`Measurement` states them normal to the surface too. Sizes are measured on the surface."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numba
import numpy as np
from pydantic import Field, field_validator

from detectors.findings.family import BLURS, DEPTH_ERROR, ShapeFit, Size, Start, sized
from detectors.findings.hole_model import (
    HolePatch,
    lens_side,
    normal_of,
    pictures,
    sight,
    straight_sight,
)
from detectors.findings.shapes import Shape
from detectors.interface import Detection, Evidence, Measurement
from detectors.pixels.clusters import PLAIN
from detectors.pixels.masks import grown, parts_with
from detectors.pixels.noise import median_of, noise_sides_at, quantile_of, sigma_of
from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM, Cloud, Region, rotate_vectors

OTHER_DAMAGE_SIGMAS = 5.0
"""Pixels of the patch with a larger residual that do not touch the detection belong to other
damage."""
FEWEST_AROUND = 12  # valid pixels around a detection
PLANE_ROUNDS = 6  # of weighted least squares that approach least magnitudes
EXPLAINED = 0.7
"""Least share of a detection's squared residual that its fit must explain: correlated noise may
absorb a smooth dent, and a ragged damage has no shape."""
MARGIN_SHARE = 0.4
"""Margin around a detection, as a share of its size: a bowl's core is half as wide as its mouth."""
FINE_BLUR_PX = 2.0  # a recording's blur is at least as wide as this in the pixels of the fit
MOST_SIDE_PX = 24  # side of a patch from which means over squares of pixels are fitted
FEWEST_ACROSS = 6  # pixels of the fit across a detection
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


class HoleModelConfig(Config):
    """Assumptions of the model of a blurred hole.

    - ``blur_px``: side of the square over which the camera averages: 5 for the Azure Kinect's depth
      engine (OpenK4A), 3 for the Kinect v2 (libfreenect2), 1 for none.
    - ``lens_px``: standard deviation of the lens' blur, which widens the picture of a hole but not
      the noise: 0.45 for the Azure Kinect (0.3 to 0.6 by edges of its infrared images).
    - ``by_light``: whether the filter weighs pixels by their light, as the Kinect v2's does on
      phasors; the Azure Kinect's does not.
    - ``emitter_mm``: position of the light source in the camera's frame, which matters
      ``by_light``: what it does not light weighs nothing. Other filters see the floor there too, by
      the light of its surroundings.
    - ``linear_depth_mm``: the filter gives a neighbour that is so much deeper half of the weight;
      of deeper holes, the contour at half depth is more reliable. A recording's filter is not
      known, and taken to weigh all alike.
    - ``largest_invalid``: share of the disc that may lack a range.
    - ``largest_relative_error``: of the diameter; beyond it, diameter and depth are ambiguous."""

    blur_px: int = Field(default=5, ge=1, le=31)
    lens_px: float = Field(default=0.45, ge=0, le=5)
    by_light: bool = False
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


def blur_in_cells(
    cloud: Cloud,
    config: HoleModelConfig,
    pixel: tuple[float, float] = (0.0, 0.0),
) -> tuple[float, float]:
    """Return the sides, along u and along v, of the rectangle over which the cloud is averaged at
    a ``pixel`` (row, column), in its own pixels or cells: that of a recording's noise, else
    ``config.blur_px``. A map's interpolation between its views' pixels widens it to sqrt(blur^2 +
    2) pixels. Cells larger than a pixel are means themselves."""
    if cloud.map_views is None or not cloud.organised:
        row, column = pixel
        side_u, side_v = noise_sides_at(cloud, row, column)
        return side_u or float(config.blur_px), side_v or float(config.blur_px)
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
) -> Measurement:
    """Measure a detection both ways; failed measurements are NaN, with a note."""
    if not cloud.organised:
        return measure_extents(cloud, detection, "no pixel grid: extents only")
    measured = measure_extents(cloud, detection, "too few valid pixels around it for a model")
    around = _surroundings(cloud, evidence, detection, config)
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
        fine = _surroundings(cloud, evidence, detection, config, fine=True)
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


def _as_slot(measured: Measurement, around: _Surroundings, size: Size) -> Measurement:
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


@dataclass(frozen=True)
class _Surroundings:
    """A detection and its neighbourhood, a patch of h x w pixels."""

    patch: HolePatch
    detected: np.ndarray
    """(h, w) bool: the detection's pixels."""
    widened: np.ndarray
    """(h, w) bool: these grown by one more than ``reach_px``."""
    binned: int
    """Side of the squares of the cloud's pixels whose means are the patch's pixels."""
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
    normal_share: float
    """Depth normal to the surface over the residual."""
    sight_share: float
    """Depth along the line of sight over the residual."""
    u0: float
    """Centroid of the detection's pixels in the patch, along columns."""
    v0: float
    """The same along rows."""
    origin_m: np.ndarray
    """(3,): the surface's point at (u0, v0)."""
    per_px_m: np.ndarray
    """(2, 3): the surface's derivatives by u and v."""
    blurs: tuple[tuple[float, bool, float], ...]
    """The `BLURS` to try."""

    @property
    def area_m2(self) -> float:
        """Area of one pixel on the surface."""
        return math.hypot(*normal_of(self.per_px_m))

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit vectors (3,) on the surface along the rows, and across them towards larger v."""
        right = self.per_px_m[0] / np.linalg.norm(self.per_px_m[0])
        down = self.per_px_m[1] - (self.per_px_m[1] @ right) * right
        return right, down / np.linalg.norm(down)

    def hides_floor(self, diameter_m: float, sides: float) -> bool:
        """Return whether a hole is narrower than so many ``sides`` of the blur."""
        diameter_px = diameter_m / math.sqrt(self.area_m2)
        return self.sign > 0 and diameter_px < sides * max(self.patch.blur_px)

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
            u_px=self.binned * du + measured.u_px,
            v_px=self.binned * dv + measured.v_px,
            model_centre_m=self.origin_m + du * self.per_px_m[0] + dv * self.per_px_m[1],
        )


def _surroundings(
    cloud: Cloud,
    evidence: Evidence,
    detection: Detection,
    config: HoleModelConfig,
    *,
    fine: bool = False,
) -> _Surroundings | None:
    """Cut out the detection with a margin of twice the blur or `MARGIN_SHARE` of its size on each
    side, in means over squares of pixels where these are small; None with too few valid pixels
    around. ``fine``: all pixels instead."""
    h, w = cloud.points_m.shape[:2]
    rows, columns = np.unravel_index(detection.pixels, (h, w))
    middle = (float(rows.mean()), float(columns.mean()))
    blur_px = blur_in_cells(cloud, config, middle)
    tight = Region(
        int(rows.min()),
        int(rows.max()) + 1,
        int(columns.min()),
        int(columns.max()) + 1,
    )
    widest = max(tight.row1 - tight.row0, tight.col1 - tight.col0)
    margin_px = math.ceil(max(2 * max(blur_px) + 2, MARGIN_SHARE * widest))
    corner = tight.grown(margin_px, h, w)
    cut = corner.within(Region(0, h, 0, w))
    residual_m = evidence.residual_m[cut]
    points_m = cloud.points_m[cut]
    detected = np.zeros(residual_m.shape, dtype=bool)
    detected[rows - corner.row0, columns - corner.col0] = True
    plane = local_plane(
        points_m,
        evidence.surface_z_m[cut],
        np.isfinite(residual_m),
        detected,
        cloud.projection,
    )
    if plane is None:
        return None
    origin_m, per_px_m = plane
    u0, v0 = _centroid(detected)
    binned = 1
    if not fine:
        # several pixels across the detection: a slot is long, but narrow
        across_px = len(rows) / widest
        binned = min(max(residual_m.shape) // MOST_SIDE_PX, int(across_px / FEWEST_ACROSS))
        if cloud.noise_reach_px:  # its blurs are many fits
            binned = max(binned, int(min(blur_px) / FINE_BLUR_PX))
        binned = max(binned, 1)
    invalid = ~np.isfinite(points_m[..., 2])
    if binned > 1:
        residual_m = _means(residual_m, binned)
        coverage = _means(detected.astype(float), binned)
        detected = coverage >= min(0.5, coverage.max())
        invalid = _means(invalid.astype(float), binned) > 0.5
        per_px_m = binned * per_px_m
        u0 = (u0 + 0.5) / binned - 0.5
        v0 = (v0 + 0.5) / binned - 0.5
        blur_u, blur_v = blur_px
        blur_px = (_binned_blur(blur_u, binned), _binned_blur(blur_v, binned))
    finite = np.isfinite(residual_m)
    reach_px = int(max(blur_px) / 2)
    widened = grown(detected, reach_px + 1)
    ring = finite & ~widened
    if ring.sum() < FEWEST_AROUND:
        return None
    if cloud.noise_sides_px is not None:
        residual_m = residual_m - _tilt_m(residual_m, ring)
    ring_m = residual_m[ring]
    offset_m = median_of(ring_m)
    noise_m = sigma_of(ring_m - offset_m)
    # large residuals that do not touch the detection are other damage; the blur spreads it
    limit_m = OTHER_DAMAGE_SIGMAS * max(noise_m, 1e-9)
    stands_out = (np.abs(residual_m - offset_m) > limit_m) | detected
    other_damage = stands_out & ~parts_with(stands_out, detected)
    used = finite & (detected | ~grown(other_damage, reach_px))
    deviations_m = residual_m[detected & finite] - offset_m
    sign = 1.0 if deviations_m.sum() >= 0 else -1.0
    patch = HolePatch(
        residual_m=residual_m,
        used=used,
        metric_m2=per_px_m @ per_px_m.T,
        blur_px=blur_px,
        lens_px=_lens_sides(cloud, config, blur_px),
        brightness=1.0 if config.by_light else 0.0,
        half_m=math.inf if cloud.noise_reach_px else config.linear_depth_mm * MM,
        noise_m=noise_m,
        sights=_sights(cloud, origin_m, per_px_m, config),
        shared_px=blur_px,
    )
    axis = np.array([0.0, 0.0, 1.0])
    ray = axis
    if cloud.projection == "central":
        ray = origin_m / origin_m[2]
    # depth along the normal over z along the ray, and over the residual
    ray_share = _cosine(per_px_m, ray)
    normal_share = ray_share
    if evidence.residual_along == "axis":
        normal_share = _cosine(per_px_m, axis)
    return _Surroundings(
        patch=patch,
        detected=detected,
        widened=widened,
        binned=binned,
        invalid=invalid,
        offset_m=offset_m,
        sign=sign,
        peak_m=max(quantile_of(sign * deviations_m, 0.9), 1e-9),
        reach_px=reach_px,
        normal_share=normal_share,
        sight_share=normal_share / ray_share * float(np.linalg.norm(ray)),
        u0=u0,
        v0=v0,
        origin_m=origin_m,
        per_px_m=per_px_m,
        blurs=_blurs_of(cloud),
    )


def _cosine(per_px_m: np.ndarray, direction: np.ndarray) -> float:
    """Return the length of the part of a direction (3,) that is normal to the surface."""
    normal = normal_of(per_px_m)
    return float(abs(normal @ direction) / math.hypot(*normal))


def _tilt_m(residual_m: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """Return the tilt (h, w) of the residuals around a detection: of the plane through those of
    the ring (h, w) bool by least magnitudes, 0 at the ring's centroid.

    Upsampling makes the camera's fixed pattern, and so its waves, as wide as the patch. On the
    plate that `tests/harness/inspection/test_drilled_plate.py` judges, fits of wide shapes would
    follow these waves: the ninth decile of the holes' diameters would be 19 mm instead of 15."""
    u0, v0 = _centroid(ring)
    rows, columns = np.indices(residual_m.shape, float)
    columns -= u0
    rows -= v0
    values_m = residual_m[ring]
    system = np.stack([np.ones(len(values_m)), columns[ring], rows[ring]], axis=1)
    weights = np.ones(len(values_m))
    plane = np.zeros(3)
    for _ in range(PLANE_ROUNDS):
        weighted = system * weights[:, None]
        plane = np.linalg.lstsq(weighted, values_m * weights, rcond=None)[0]
        sizes_m = np.abs(values_m - system @ plane)
        # squares over sizes are magnitudes; below the typical size, squares again
        weights = 1.0 / np.sqrt(np.maximum(sizes_m, median_of(sizes_m) + 1e-9))
    return np.asarray(plane[1] * columns + plane[2] * rows)


def _blurs_of(cloud: Cloud) -> tuple[tuple[float, bool, float], ...]:
    """Return the blurs to try: one for a simulated camera, whose blur is stated; for upsampled
    depth, whose noise is known at each place, those that are no narrower than it, because
    interpolation blurs scene and noise alike; else all, for a recording's is estimated."""
    if cloud.noise_sides_px is not None:
        return tuple(blur for blur in BLURS if blur[0] >= 1.0)
    return BLURS if cloud.noise_reach_px else BLURS[:1]


def _means(picture: np.ndarray, side: int) -> np.ndarray:
    """Return the means (h // side, w // side) of a picture's known pixels over squares; NaN where
    fewer than half are known."""
    height = picture.shape[0] // side
    width = picture.shape[1] // side
    squares = picture[: height * side, : width * side].reshape(height, side, width, side)
    is_finite = np.isfinite(squares)
    counts = is_finite.sum(axis=(1, 3))
    sums = np.where(is_finite, squares, 0.0).sum(axis=(1, 3))
    return np.where(2 * counts >= side**2, sums / np.maximum(counts, 1), np.nan)


def _lens_sides(
    cloud: Cloud,
    config: HoleModelConfig,
    blur_px: tuple[float, float],
) -> tuple[float, float]:
    """Return the `lens_side` along u and along v, in the pixels in which the camera's filter has
    the sides ``blur_px``. They are 1 for a recording, whose blur is estimated: `BLURS` allow for
    its lens."""
    if cloud.noise_reach_px:
        return 1.0, 1.0
    blur_u, blur_v = blur_px
    wide_px = float(config.blur_px)
    if cloud.map_views is not None:
        wide_px = _map_blur(config.blur_px, 1.0)
    per_blur = config.lens_px / wide_px
    return lens_side(per_blur * blur_u), lens_side(per_blur * blur_v)


def _binned_blur(blur_px: float, binned: int) -> float:
    """Return the side, in means over squares of pixels, of a blur: second moments add."""
    return math.sqrt(blur_px**2 + binned**2 - 1.0) / binned


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
    emitter_m = np.zeros(3)
    if config.by_light:
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
    detected: np.ndarray,
    projection: str,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the surface's point at the detection's centroid (3,) and its derivatives by u and v
    (2, 3), by linear regression of directions (in a parallel projection of x and y) and of the
    surface's z; None if singular.

    Args:
        points: (h, w, 3), metres, of a patch.
        surface_z: (h, w), metres, of the fitted surface.
        finite: (h, w) bool, the pixels to use.
        detected: (h, w) bool, the detection's pixels.
        projection: "central" or "parallel"."""
    u0, v0 = _centroid(detected)
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


def _volume(around: _Surroundings, pixels: np.ndarray) -> float:
    """Return the volume in m3 between the surface and the ``pixels`` (h, w) bool, positive
    behind the surface."""
    depth_m = float((around.patch.residual_m[pixels] - around.offset_m).sum())
    (ax, ay, _), (bx, by, _) = around.per_px_m
    # the area of a pixel perpendicular to the optical axis
    return depth_m * float(abs(ax * by - ay * bx))


def _sides(around: _Surroundings, pixels: np.ndarray) -> tuple[float, float, np.ndarray]:
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
    around: _Surroundings,
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


def _sized(around: _Surroundings) -> Size | None:
    """Return the averaged size by the family of shapes."""
    start = _start(around)
    shapes: tuple[Shape, ...] = ("disc", "cap", "bowl")
    if start.stretch > LONG:
        shapes = (*shapes, "slot")
    return sized(around.patch, start, shapes, around.blurs)


def _start(around: _Surroundings) -> Start:
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


def _explains(around: _Surroundings, size: Size) -> bool:
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
    around: _Surroundings,
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


def _contour(around: _Surroundings, residual_m: np.ndarray, level_m: float) -> np.ndarray:
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


def _diameter_m(around: _Surroundings, inside: np.ndarray) -> float:
    """Return the diameter of the circle with the area of a `_contour`."""
    area_m2 = inside.sum() / CONTOUR_ZOOM**2 * around.area_m2
    return 2.0 * math.sqrt(area_m2 / math.pi)


def _contour_depth(
    around: _Surroundings,
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
