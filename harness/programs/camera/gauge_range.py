"""Scale and bias of a camera's range, and blur, from one view of a solid gauge.

Model: measured range = scale * true range + bias, along each ray. In one view, heights along the
ray show the scale alone, and lengths across it the scale and the bias over the distance; the lens
is taken as true. Pose, scale and bias are one least-squares fit to the centres of the spheres and
the levels of the face and the steps. Each has the noise of its own residuals; if they disagree by
more, all errors are widened by the ratio (Birge), which holds fixed pattern and errors of the
piece."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from detectors.rigid_motion import displacement_jacobian, moved_by
from detectors.surfaces.expected import Triangles, normals_of
from detectors.surfaces.triangle_tree import first_hits
from harness.evaluation.intervals import Interval
from harness.stills.solid_body import solid_of
from harness.stills.solid_gauge import SolidGauge
from harness.stills.spheres import (
    NoFit,
    RangeImage,
    SphereFit,
    correlated_pixels,
    fit_sphere,
    student,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, invert, rotate_vectors, transform_points

PASSES = 3
# pixels kept from every edge of a level, which blur and mixed pixels reach
MARGIN_PX = 2.5
FEWEST_PX = 20
PATCH_MM = 12.0
"""Side of the squares into which the face is divided, on a plate of 180 mm."""
OUTLIER = 4.0
FARTHEST = 5.0
"""Robust deviations from the fit beyond which an element does not count."""
NUMBERS = 8  # pose, scale and bias
# blur: steps of depth that show it, beyond which lens and light mix surfaces by other rules
LEAST_STEP_M = 2 * MM
LARGEST_STEP_M = 25 * MM
EDGE_REACH_PX = 3
FEWEST_EDGE_PX = 100
WIDEST_BLUR_PX = 3.0
BLOCKS = 12


class FlatLevel(NamedTuple):
    """A flat square parallel to the face."""

    name: str
    x_m: float
    y_m: float
    z_m: float
    half_m: float


@dataclass(frozen=True)
class RangeFit:
    """Scale and bias of range."""

    T_camera_gauge: np.ndarray
    scale: float
    """Measured over true change of range."""
    bias_m: float
    """Measured range minus scale times true range."""
    covariance: np.ndarray
    """(2, 2): of scale and bias."""
    degrees: int
    """Degrees of freedom of the fit."""
    birge: float
    """Ratio of the elements' disagreement to their own noise; 1 or more."""
    spheres: tuple[SphereFit | NoFit, ...]
    """The gauge's spheres in the corrected image."""
    levels: tuple[tuple[FlatLevel, float, float], ...]
    """Each level, its mean distance from its place along the ray, and the standard error, metres.
    """

    @property
    def sigmas(self) -> np.ndarray:
        """Standard errors (2,) of scale and bias."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def interval(self, number: int) -> Interval:
        """Return the two-sided 95 % interval of scale (0) or bias (1)."""
        value = (self.scale, self.bias_m)[number]
        half = student(self.degrees) * float(self.sigmas[number])
        return Interval(value - half, value + half)


def range_and_blur(
    image: RangeImage, gauge: SolidGauge, T_camera_gauge: np.ndarray
) -> tuple[RangeFit, Blur | None, np.ndarray]:
    """Return scale and bias from a pose that is right to a few millimetres, blur, and the sharp
    ranges (h, w) of the gauge. What blur does to curved surfaces and near edges is taken out of
    the image before the last fit. Raises UserError if too few elements have enough pixels."""
    triangles = triangles_of(gauge)
    fit = _fitted(image, gauge, _start(T_camera_gauge))
    sharp_m = seen_ranges_m(triangles, image.rays, fit.T_camera_gauge)
    straight = replace(image, range_m=(image.range_m - fit.bias_m) / fit.scale)
    blur = edge_blur(straight, sharp_m)
    if blur is None:
        return fit, None, sharp_m
    displaced_m = blurred(sharp_m, blur.blur_px) - sharp_m
    deblurred = replace(image, range_m=image.range_m - fit.scale * displaced_m)
    fit = _fitted(deblurred, gauge, fit)
    return fit, blur, seen_ranges_m(triangles, image.rays, fit.T_camera_gauge)


def _start(T_camera_gauge: np.ndarray) -> RangeFit:
    """Return a perfect camera's scale and bias at a pose."""
    return RangeFit(
        T_camera_gauge=T_camera_gauge,
        scale=1.0,
        bias_m=0.0,
        covariance=np.zeros((2, 2)),
        degrees=1,
        birge=1.0,
        spheres=(),
        levels=(),
    )


def _fitted(image: RangeImage, gauge: SolidGauge, fit: RangeFit) -> RangeFit:
    """Return the fit after `PASSES` steps from an earlier one."""
    for _ in range(PASSES):
        fit = _improved(image, gauge, fit)
    spheres = sum(isinstance(sphere, SphereFit) for sphere in fit.spheres)
    if spheres < 3:
        why = "; ".join(
            f"{ball.name}: {sphere.why}"
            for ball, sphere in zip(gauge.spheres, fit.spheres, strict=True)
            if isinstance(sphere, NoFit)
        )
        raise UserError(f"--gauge: {spheres} spheres can be fitted, 3 needed ({why})")
    return fit


def _improved(image: RangeImage, gauge: SolidGauge, fit: RangeFit) -> RangeFit:
    """Return the fit after one step of least squares."""
    corrected = replace(image, range_m=(image.range_m - fit.bias_m) / fit.scale)
    T = fit.T_camera_gauge
    place_m = gauge.uncertainty.place_mm * MM
    middle_m = T[:3, 3]
    rows = []
    wanted = []
    spheres = []
    for ball, centre_mm in zip(gauge.spheres, gauge.centres_mm, strict=True):
        expected_m = transform_points(T, centre_mm * MM)
        sphere = fit_sphere(corrected, expected_m, ball.diameter_mm / 2 * MM)
        spheres.append(sphere)
        if isinstance(sphere, NoFit):
            continue
        ray = sphere.centre_m / np.linalg.norm(sphere.centre_m)
        by_pose = displacement_jacobian(expected_m[None], middle_m)[0]
        by_range = np.column_stack([sphere.centre_m, ray]) / fit.scale
        design = np.concatenate([by_pose, by_range], axis=1)
        covariance_m2 = sphere.covariance_m2 + place_m**2 * np.eye(3)
        whiten = np.linalg.inv(np.linalg.cholesky(covariance_m2))
        rows.append(whiten @ design)
        wanted.append(whiten @ (sphere.centre_m - expected_m))
    levels = []
    normal = rotate_vectors(T, np.array([0.0, 0.0, 1.0]))
    for level, pixels in level_pixels(corrected, gauge, T):
        rays = image.rays.reshape(-1, 3)[pixels]
        ranges_m = corrected.range_m.ravel()[pixels]
        point_m = transform_points(T, np.array([0.0, 0.0, level.z_m]))
        off_m = ranges_m - (normal @ point_m) / (rays @ normal)
        centred_m = off_m - np.median(off_m)
        kept = np.abs(centred_m) <= OUTLIER * 1.4826 * np.median(np.abs(centred_m)) + 1e-9
        if kept.sum() < FEWEST_PX:
            continue
        shape = image.range_m.shape
        mean_m = float(off_m[kept].mean())
        shared = correlated_pixels(shape, pixels[kept], off_m[kept] - mean_m, numbers=1)
        sigma_m = float(off_m[kept].std() * np.sqrt(shared / kept.sum()))
        levels.append((level, mean_m, sigma_m))
        points_m = rays[kept] * ranges_m[kept, None]
        slant = rays[kept] @ normal
        along = displacement_jacobian(points_m, middle_m)
        by_pose = (np.einsum("j,njk->nk", normal, along) / slant[:, None]).mean(axis=0)
        by_range = np.array([ranges_m[kept].mean(), 1.0]) / fit.scale
        error_m = np.hypot(sigma_m, place_m)
        rows.append(np.concatenate([by_pose, by_range])[None] / error_m)
        wanted.append(np.array([mean_m / error_m]))
    if len(rows) < NUMBERS:
        raise UserError(
            f"--gauge: {len(rows)} elements of the gauge have enough pixels, {NUMBERS} needed",
            fix="come closer, or record more frames",
        )
    design = np.concatenate(rows)
    target = np.concatenate(wanted)
    kept = np.ones(len(target), bool)
    for _ in range(3):
        step, *_ = np.linalg.lstsq(design[kept], target[kept], rcond=None)
        size = np.abs(target - design @ step)
        # an element that something hides, or that multiple reflections displace, does not count
        kept = size <= FARTHEST * max(1.4826 * float(np.median(size)), 1.0)
    design = design[kept]
    target = target[kept]
    degrees = len(target) - NUMBERS
    left = target - design @ step
    birge = max(float(np.sqrt((left**2).sum() / degrees)), 1.0)
    covariance = np.linalg.inv(design.T @ design)[6:, 6:] * birge**2
    covariance[0, 0] += (fit.scale * gauge.uncertainty.scale) ** 2
    return RangeFit(
        T_camera_gauge=moved_by(step[:6], middle_m) @ T,
        scale=fit.scale + float(step[6]),
        bias_m=fit.bias_m + float(step[7]),
        covariance=covariance,
        degrees=degrees,
        birge=birge,
        spheres=tuple(spheres),
        levels=tuple(levels),
    )


# ---------------------------------------------------------------- pixels of the elements


def level_pixels(
    image: RangeImage, gauge: SolidGauge, T_camera_gauge: np.ndarray
) -> list[tuple[FlatLevel, np.ndarray]]:
    """Return the steps' tops and the free squares of the face, each with the flat indices of its
    pixels that have a range, away from edges and from what spheres hide."""
    T_gauge_camera = invert(T_camera_gauge)
    eye_m = T_gauge_camera[:3, 3]
    finite = np.flatnonzero(np.isfinite(image.range_m.ravel()))
    rays = rotate_vectors(T_gauge_camera, image.rays.reshape(-1, 3)[finite])
    with np.errstate(divide="ignore", invalid="ignore"):
        on_face_m = eye_m + rays * (-eye_m[2] / rays[:, 2])[:, None]
    half_m = np.array([gauge.width_mm, gauge.height_mm]) / 2 * MM
    near = (np.abs(on_face_m[:, :2]) < 1.5 * half_m).all(axis=1) & (rays[:, 2] < 0)
    finite = finite[near]
    rays = rays[near]
    pitch_m = image.pitch_rad * float(np.linalg.norm(eye_m))
    clear = ~_hidden(gauge, eye_m, rays, MARGIN_PX * pitch_m)
    finite = finite[clear]
    rays = rays[clear]
    found = []
    for level in _levels(gauge):
        points_m = eye_m + rays * ((level.z_m - eye_m[2]) / rays[:, 2])[:, None]
        reach_m = level.half_m - MARGIN_PX * pitch_m
        inside = (np.abs(points_m[:, :2] - [level.x_m, level.y_m]) < reach_m).all(axis=1)
        inside = np.flatnonzero(inside)
        if len(inside) < FEWEST_PX:
            continue
        behind = _behind_steps(gauge, level.z_m, eye_m, rays[inside], MARGIN_PX * pitch_m)
        if (~behind).sum() >= FEWEST_PX:
            found.append((level, finite[inside[~behind]]))
    return found


def _behind_steps(
    gauge: SolidGauge, level_m: float, eye_m: np.ndarray, rays: np.ndarray, margin_m: float
) -> np.ndarray:
    """Return which rays (n, 3) meet a step that is taller than a level, on their way to it."""
    behind = np.zeros(len(rays), bool)
    for step in gauge.steps:
        if step.height_mm * MM <= level_m:
            continue
        reach_m = step.side_mm / 2 * MM + margin_m
        for height_m in np.linspace(level_m, step.height_mm * MM, 4):
            points_m = eye_m + rays * ((height_m - eye_m[2]) / rays[:, 2])[:, None]
            off_m = np.abs(points_m[:, :2] - np.array([step.x_mm, step.y_mm]) * MM)
            behind |= off_m.max(axis=1) < reach_m
    return behind


def _hidden(gauge: SolidGauge, eye_m: np.ndarray, rays: np.ndarray, margin_m: float) -> np.ndarray:
    """Return which rays (n, 3) of the gauge's frame meet a sphere, or the space below it."""
    hidden = np.zeros(len(rays), bool)
    for ball, centre_mm in zip(gauge.spheres, gauge.centres_mm, strict=True):
        reach_m = ball.diameter_mm / 2 * MM + margin_m
        for height_m in np.linspace(0, centre_mm[2] * MM, 5):
            middle_m = np.array([centre_mm[0] * MM, centre_mm[1] * MM, height_m])
            away_m = np.linalg.norm(np.cross(rays, middle_m - eye_m), axis=1)
            hidden |= away_m < reach_m
    return hidden


def _levels(gauge: SolidGauge) -> list[FlatLevel]:
    levels = []
    for step in gauge.steps:
        level = FlatLevel(
            name=step.name,
            x_m=step.x_mm * MM,
            y_m=step.y_mm * MM,
            z_m=step.height_mm * MM,
            half_m=step.side_mm / 2 * MM,
        )
        levels.append(level)
    taken = _taken_mm(gauge)
    side_mm = PATCH_MM * gauge.width_mm / 180.0
    count = int(gauge.width_mm / side_mm)
    for x_mm in side_mm * (np.arange(count) - (count - 1) / 2):
        for y_mm in side_mm * (np.arange(count) - (count - 1) / 2):
            apart_mm = np.abs(taken[:, :2] - [x_mm, y_mm]) - taken[:, 2:] - side_mm / 2
            if (apart_mm.max(axis=1) < 0).any():
                continue
            name = f"face at {x_mm:g}, {y_mm:g} mm"
            # the margin of pixels is kept by the elements' own, so that patches may adjoin
            level = FlatLevel(name, x_mm * MM, y_mm * MM, 0.0, side_mm / 2 * MM)
            levels.append(level)
    return levels


def _taken_mm(gauge: SolidGauge) -> np.ndarray:
    """Return the rectangles (n, 4) on the face that are not level: centre, and half sides."""
    boxes = [(mark.x_mm, mark.y_mm, mark.side_mm / 2, mark.side_mm / 2) for mark in gauge.marks]
    half_post_mm = gauge.post_mm / 2
    boxes += [(ball.x_mm, ball.y_mm, half_post_mm, half_post_mm) for ball in gauge.spheres]
    boxes += [(one.x_mm, one.y_mm, one.side_mm / 2, one.side_mm / 2) for one in gauge.steps]
    boxes += [(one.x_mm, one.y_mm, one.width_mm / 2, one.length_mm / 2) for one in gauge.grooves]
    boxes += [
        (one.x_mm, one.y_mm, one.diameter_mm / 2, one.diameter_mm / 2) for one in gauge.pockets
    ]
    return np.array(boxes)


# ---------------------------------------------------------------- a simulated view of the gauge


def triangles_of(gauge: SolidGauge) -> Triangles:
    """Return the gauge's surface in metres."""
    mesh = solid_of(gauge)
    corners_m = np.asarray(mesh.triangles) * MM
    return Triangles(corners_m, normals_of(corners_m), np.zeros(corners_m.shape[:2]))


def seen_ranges_m(triangles: Triangles, rays: np.ndarray, T_camera_gauge: np.ndarray) -> np.ndarray:
    """Return the range (h, w) at which rays (h, w, 3) meet the gauge, NaN beside it."""
    T_gauge_camera = invert(T_camera_gauge)
    directions = rotate_vectors(T_gauge_camera, np.nan_to_num(rays))
    flat = directions.reshape(-1, 3)
    camera_m = np.broadcast_to(T_gauge_camera[:3, 3], flat.shape)
    triangle, shares = first_hits(triangles.tree, camera_m, flat)
    places_m = np.einsum("nc,ncd->nd", shares, triangles.corners_m[triangle])
    range_m = np.linalg.norm(places_m - camera_m, axis=1)
    range_m[triangle < 0] = np.nan
    is_ray = np.isfinite(rays[..., 0])
    return np.where(is_ray, range_m.reshape(is_ray.shape), np.nan)


def blurred(range_m: np.ndarray, blur_px: float) -> np.ndarray:
    """Return a range image (h, w) after the smoothing of an empirical camera's edges: a Gaussian
    over the inverse, with which planes stay planes."""
    finite = np.isfinite(range_m)
    if blur_px <= 0:
        return range_m
    inverse = np.where(finite, 1 / np.where(finite, range_m, 1.0), 0.0)
    weight = ndimage.gaussian_filter(finite.astype(float), blur_px)
    smoothed = ndimage.gaussian_filter(inverse, blur_px)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(finite, weight / smoothed, np.nan)


@dataclass(frozen=True)
class Blur:
    """Blur of depth at the edges of steps, grooves and pockets."""

    blur_px: float
    """Standard deviation of the Gaussian that makes the gauge's edges look like the captured
    ones."""
    interval: Interval
    """Two-sided 95 % interval."""
    pixels: int
    """Pixels at edges."""
    fill: float
    """Share of them with a range, over that of the pixels beside."""


def edge_blur(image: RangeImage, sharp_m: np.ndarray) -> Blur | None:
    """Return the blur of a corrected image, by the sharp view of the gauge ``sharp_m`` (h, w);
    None if too few pixels lie at edges. The interval is a jackknife over blocks of the image."""
    window = np.ones((2 * EDGE_REACH_PX + 1,) * 2)
    low_m = ndimage.minimum_filter(np.nan_to_num(sharp_m, nan=-1.0), footprint=window)
    high_m = ndimage.maximum_filter(np.nan_to_num(sharp_m, nan=1e3), footprint=window)
    at_edge = (high_m - low_m > LEAST_STEP_M) & (high_m - low_m < LARGEST_STEP_M)
    # spheres are curved, and no edges
    laplacian_m = np.abs(cv2.Laplacian(np.nan_to_num(sharp_m), cv2.CV_64F))
    jumps = ndimage.maximum_filter(laplacian_m, footprint=window) > LEAST_STEP_M
    at_edge &= jumps
    usable = at_edge & np.isfinite(image.range_m)
    if usable.sum() < FEWEST_EDGE_PX:
        return None
    beside = (high_m - low_m < LARGEST_STEP_M) & ~at_edge & (low_m > 0)
    fill = np.isfinite(image.range_m[at_edge]).mean()
    fill_beside = np.isfinite(image.range_m[beside]).mean() if beside.any() else np.nan
    columns = np.nonzero(usable)[1]
    block = np.argsort(np.argsort(columns, kind="stable")) * BLOCKS // len(columns)
    views = [blurred(sharp_m, blur_px)[usable] for blur_px in _BLURS_PX]
    measured_m = image.range_m[usable]
    value_px = _best_blur(views, measured_m, np.ones(len(block), bool))
    without = [_best_blur(views, measured_m, block != k) for k in range(BLOCKS)]
    error_px = float(np.sqrt((BLOCKS - 1) * np.var(without)))
    half_px = student(BLOCKS - 1) * error_px
    return Blur(
        blur_px=value_px,
        interval=Interval(max(value_px - half_px, 0.0), value_px + half_px),
        pixels=int(usable.sum()),
        fill=float(fill / fill_beside),
    )


_BLURS_PX = np.arange(0, WIDEST_BLUR_PX + 0.01, 0.05)

SHARPISH = 10  # of them, half a pixel: the scale of residuals is taken there


def _best_blur(views: list[np.ndarray], measured_m: np.ndarray, used: np.ndarray) -> float:
    """Return the blur whose view (n,) lies closest to the measured ranges (n,), between those of
    `_BLURS_PX`, by robust squares."""
    limit_m = 3 * float(np.median(np.abs(measured_m[used] - views[SHARPISH][used]))) + 1e-6
    losses = []
    for view in views:
        off_m = measured_m[used] - view[used]
        off_m = off_m - np.median(off_m)
        losses.append(float(np.minimum(off_m**2, limit_m**2).sum()))
    best = int(np.argmin(losses))
    if best in (0, len(losses) - 1):
        return float(_BLURS_PX[best])
    below, at, above = losses[best - 1 : best + 2]
    shift = (below - above) / (2 * (below - 2 * at + above))
    return float(_BLURS_PX[best] + shift * (_BLURS_PX[1] - _BLURS_PX[0]))
