"""A detection with its neighbourhood, as the model of a blurred hole is fitted to it: the patch of
residuals, the blur of the camera there, and the plane of the surface."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field, field_validator

from detectors.findings.family import BLURS
from detectors.findings.hole_patch import HolePatch, lens_side
from detectors.findings.viewpoints import normal_of, sight, straight_sight
from detectors.interface import Detection, Evidence, Measurement
from detectors.pixels.masks import grown, parts_with
from detectors.pixels.noise import median_of, noise_sides_at, quantile_of, sigma_of
from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM, Cloud, Region, rotate_vectors

OTHER_DAMAGE_SIGMAS = 5.0
"""Pixels of the patch with a larger residual that do not touch the detection belong to other
damage."""
FEWEST_AROUND = 12  # valid pixels around a detection
PLANE_ROUNDS = 6  # of weighted least squares that approach least magnitudes
MARGIN_SHARE = 0.4
"""Margin around a detection, as a share of its size: a bowl's core is half as wide as its mouth."""
FINE_BLUR_PX = 2.0  # a recording's blur is at least as wide as this in the pixels of the fit
MOST_SIDE_PX = 24  # side of a patch from which means over squares of pixels are fitted
FEWEST_ACROSS = 6  # pixels of the fit across a detection


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


@dataclass(frozen=True)
class Surroundings:
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


@dataclass(frozen=True)
class _Grid:
    """The pixels around a detection (h, w), or means over squares of them."""

    residual_m: np.ndarray
    """(h, w): z minus the surface; NaN where it is not judged."""
    detected: np.ndarray
    """(h, w) bool: the detection's pixels."""
    invalid: np.ndarray
    """(h, w) bool: pixels without a range."""
    per_px_m: np.ndarray
    """(2, 3): the surface's derivatives by u and v."""
    u0: float
    """Centroid of the detection's pixels, along columns."""
    v0: float
    """The same along rows."""
    blur_px: tuple[float, float]
    """Sides of the camera's blur along u and v."""

    def means(self, side: int) -> _Grid:
        """Return the means over squares of ``side`` pixels."""
        coverage = _means(self.detected.astype(float), side)
        blur_u, blur_v = self.blur_px
        return _Grid(
            residual_m=_means(self.residual_m, side),
            detected=coverage >= min(0.5, coverage.max()),
            invalid=_means(self.invalid.astype(float), side) > 0.5,
            per_px_m=side * self.per_px_m,
            u0=(self.u0 + 0.5) / side - 0.5,
            v0=(self.v0 + 0.5) / side - 0.5,
            blur_px=(_binned_blur(blur_u, side), _binned_blur(blur_v, side)),
        )


def surroundings_of(
    cloud: Cloud,
    evidence: Evidence,
    detection: Detection,
    config: HoleModelConfig,
    *,
    fine: bool = False,
) -> Surroundings | None:
    """Cut out the detection with a margin of twice the blur or `MARGIN_SHARE` of its size on each
    side, in means over squares of pixels where these are small; None with too few valid pixels
    around. ``fine``: all pixels instead."""
    cut_out = _cut_out(cloud, evidence, detection, config)
    if cut_out is None:
        return None
    grid, origin_m = cut_out
    binned = 1 if fine else _square_side(cloud, grid)
    if binned > 1:
        grid = grid.means(binned)
    residual_m = grid.residual_m
    detected = grid.detected
    blur_px = grid.blur_px
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
    other_damage = _other_damage(residual_m - offset_m, noise_m, detected)
    # the blur spreads it
    used = finite & (detected | ~grown(other_damage, reach_px))
    deviations_m = residual_m[detected & finite] - offset_m
    sign = 1.0 if deviations_m.sum() >= 0 else -1.0
    patch = HolePatch(
        residual_m=residual_m,
        used=used,
        metric_m2=grid.per_px_m @ grid.per_px_m.T,
        blur_px=blur_px,
        lens_px=_lens_sides(cloud, config, blur_px),
        brightness=1.0 if config.by_light else 0.0,
        half_m=math.inf if cloud.noise_reach_px else config.linear_depth_mm * MM,
        noise_m=noise_m,
        sights=_sights(cloud, origin_m, grid.per_px_m, config),
        shared_px=blur_px,
    )
    normal_share, sight_share = _shares_of_residual(cloud, evidence, origin_m, grid.per_px_m)
    return Surroundings(
        patch=patch,
        detected=detected,
        widened=widened,
        binned=binned,
        invalid=grid.invalid,
        offset_m=offset_m,
        sign=sign,
        peak_m=max(quantile_of(sign * deviations_m, 0.9), 1e-9),
        reach_px=reach_px,
        normal_share=normal_share,
        sight_share=sight_share,
        u0=grid.u0,
        v0=grid.v0,
        origin_m=origin_m,
        per_px_m=grid.per_px_m,
        blurs=_blurs_of(cloud),
    )


def _cut_out(
    cloud: Cloud, evidence: Evidence, detection: Detection, config: HoleModelConfig
) -> tuple[_Grid, np.ndarray] | None:
    """Return the pixels around a detection, and the surface's point (3,) at its centroid; None
    without a plane through them."""
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
    widest = max(tight.shape)
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
    grid = _Grid(
        residual_m=residual_m,
        detected=detected,
        invalid=~np.isfinite(points_m[..., 2]),
        per_px_m=per_px_m,
        u0=u0,
        v0=v0,
        blur_px=blur_px,
    )
    return grid, origin_m


def _square_side(cloud: Cloud, grid: _Grid) -> int:
    """Return the side of the squares of pixels whose means are fitted, 1 for each pixel alone."""
    rows, columns = np.nonzero(grid.detected)
    widest = int(max(np.ptp(rows), np.ptp(columns))) + 1
    # several pixels across the detection: a slot is long, but narrow
    across_px = len(rows) / widest
    side = min(max(grid.detected.shape) // MOST_SIDE_PX, int(across_px / FEWEST_ACROSS))
    if cloud.noise_reach_px:  # its blurs are many fits
        side = max(side, int(min(grid.blur_px) / FINE_BLUR_PX))
    return max(side, 1)


def _other_damage(deviations_m: np.ndarray, noise_m: float, detected: np.ndarray) -> np.ndarray:
    """Return the pixels (h, w) bool of large residuals, less the offset, (h, w) that do not touch
    the detection: other damage."""
    limit_m = OTHER_DAMAGE_SIGMAS * max(noise_m, 1e-9)
    stands_out = (np.abs(deviations_m) > limit_m) | detected
    return np.asarray(stands_out & ~parts_with(stands_out, detected))


def _shares_of_residual(
    cloud: Cloud, evidence: Evidence, origin_m: np.ndarray, per_px_m: np.ndarray
) -> tuple[float, float]:
    """Return the depth normal to the surface, and that along the line of sight, over the
    residual, at the surface's point ``origin_m`` (3,)."""
    axis = np.array([0.0, 0.0, 1.0])
    ray = axis
    if cloud.projection == "central":
        ray = origin_m / origin_m[2]
    # depth along the normal over z along the ray
    ray_share = _cosine(per_px_m, ray)
    normal_share = ray_share
    if evidence.residual_along == "axis":
        normal_share = _cosine(per_px_m, axis)
    return normal_share, normal_share / ray_share * float(np.linalg.norm(ray))


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
