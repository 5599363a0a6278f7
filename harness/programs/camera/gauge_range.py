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
from scipy import ndimage, optimize

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
BLOCKS = 12
_BLURS_PX = (0.0, 0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
# rays of a pixel at an edge, a Fibonacci lattice: of a square grid with 4 x 4 rays, an edge along
# one side takes or leaves whole rows, and looks blurred by 0.1 pixels
SUBRAYS = 34
GENERATOR = 21
LEAST_BEND_M = 0.2 * MM  # second difference of range from which one ray is not a pixel's mean


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
    """Return scale and bias from a pose that is right to a few millimetres, blur, and the ranges
    (h, w) of the gauge without it. What blur does to curved surfaces and near edges is taken out of
    the image before the last fit. Raises UserError if too few elements have enough pixels."""
    triangles = triangles_of(gauge)
    fit = _fitted(image, gauge, _start(T_camera_gauge))
    sharp_m = seen_ranges_m(triangles, image.rays, fit.T_camera_gauge)
    seen_m = averaged_ranges_m(triangles, image.rays, fit.T_camera_gauge, sharp_m)
    straight = replace(image, range_m=(image.range_m - fit.bias_m) / fit.scale)
    away_m = float(np.linalg.norm(fit.T_camera_gauge[:3, 3]))
    blur = edge_blur(straight, seen_m, gauge.uncertainty.place_mm * MM / away_m / image.pitch_rad)
    if blur is None:
        return fit, None, seen_m
    displaced_m = blurred(seen_m, blur.blur_px) - sharp_m
    deblurred = replace(image, range_m=image.range_m - fit.scale * displaced_m)
    fit = _fitted(deblurred, gauge, fit)
    sharp_m = seen_ranges_m(triangles, image.rays, fit.T_camera_gauge)
    return fit, blur, averaged_ranges_m(triangles, image.rays, fit.T_camera_gauge, sharp_m)


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
    spheres, of_spheres = _sphere_equations(corrected, gauge, fit)
    levels, of_levels = _level_equations(corrected, gauge, fit)
    equations = [*of_spheres, *of_levels]
    if len(equations) < NUMBERS:
        raise UserError(
            f"--gauge: {len(equations)} elements of the gauge have enough pixels, {NUMBERS} needed",
            fix="come closer, or record more frames",
        )
    design = np.concatenate([equation.design for equation in equations])
    target = np.concatenate([equation.target for equation in equations])
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
    T = fit.T_camera_gauge
    return RangeFit(
        T_camera_gauge=moved_by(step[:6], T[:3, 3]) @ T,
        scale=fit.scale + float(step[6]),
        bias_m=fit.bias_m + float(step[7]),
        covariance=covariance,
        degrees=degrees,
        birge=birge,
        spheres=tuple(spheres),
        levels=tuple(levels),
    )


class _Equations(NamedTuple):
    """The equations of an element for the numbers of a fit, over its standard error."""

    design: np.ndarray
    """(k, `NUMBERS`): derivatives by the motion about the gauge's origin, scale and bias."""
    target: np.ndarray
    """(k,): where the element was measured, less where the fit expects it."""


def _sphere_equations(
    image: RangeImage, gauge: SolidGauge, fit: RangeFit
) -> tuple[list[SphereFit | NoFit], list[_Equations]]:
    """Return the spheres as they are measured, and the equations (3 each) of their centres.
    ``image``: corrected by scale and bias of the fit."""
    T = fit.T_camera_gauge
    place_m = gauge.uncertainty.place_mm * MM
    spheres: list[SphereFit | NoFit] = []
    equations = []
    for ball, centre_mm in zip(gauge.spheres, gauge.centres_mm, strict=True):
        expected_m = transform_points(T, centre_mm * MM)
        sphere = fit_sphere(image, expected_m, ball.diameter_mm / 2 * MM)
        spheres.append(sphere)
        if isinstance(sphere, NoFit):
            continue
        ray = sphere.centre_m / np.linalg.norm(sphere.centre_m)
        by_pose = displacement_jacobian(expected_m[None], T[:3, 3])[0]
        by_range = np.column_stack([sphere.centre_m, ray]) / fit.scale
        design = np.concatenate([by_pose, by_range], axis=1)
        covariance_m2 = sphere.covariance_m2 + place_m**2 * np.eye(3)
        whiten = np.linalg.inv(np.linalg.cholesky(covariance_m2))
        equations.append(_Equations(whiten @ design, whiten @ (sphere.centre_m - expected_m)))
    return spheres, equations


def _level_equations(
    image: RangeImage, gauge: SolidGauge, fit: RangeFit
) -> tuple[list[tuple[FlatLevel, float, float]], list[_Equations]]:
    """Return the levels, with mean and standard error of what they lie behind their places, and an
    equation for each. ``image``: corrected by scale and bias of the fit."""
    T = fit.T_camera_gauge
    place_m = gauge.uncertainty.place_mm * MM
    normal = rotate_vectors(T, np.array([0.0, 0.0, 1.0]))
    levels = []
    equations = []
    for level, pixels in level_pixels(image, gauge, T):
        rays = image.rays.reshape(-1, 3)[pixels]
        ranges_m = image.range_m.ravel()[pixels]
        point_m = transform_points(T, np.array([0.0, 0.0, level.z_m]))
        off_m = ranges_m - (normal @ point_m) / (rays @ normal)
        centred_m = off_m - np.median(off_m)
        kept = np.abs(centred_m) <= OUTLIER * 1.4826 * np.median(np.abs(centred_m)) + 1e-9
        if kept.sum() < FEWEST_PX:
            continue
        mean_m = float(off_m[kept].mean())
        shared = correlated_pixels(
            image.range_m.shape, pixels[kept], off_m[kept] - mean_m, numbers=1
        )
        sigma_m = float(off_m[kept].std() * np.sqrt(shared / kept.sum()))
        levels.append((level, mean_m, sigma_m))
        points_m = rays[kept] * ranges_m[kept, None]
        slant = rays[kept] @ normal
        along = displacement_jacobian(points_m, T[:3, 3])
        by_pose = (np.einsum("j,njk->nk", normal, along) / slant[:, None]).mean(axis=0)
        by_range = np.array([ranges_m[kept].mean(), 1.0]) / fit.scale
        error_m = np.hypot(sigma_m, place_m)
        design = np.concatenate([by_pose, by_range])[None] / error_m
        equations.append(_Equations(design, np.array([mean_m / error_m])))
    return levels, equations


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


def averaged_ranges_m(
    triangles: Triangles, rays: np.ndarray, T_camera_gauge: np.ndarray, sharp_m: np.ndarray
) -> np.ndarray:
    """Return the mean range (h, w) over each pixel's area, as the light of its parts mixes where
    they are near each other; ``sharp_m`` (h, w) is that of its middle. NaN at the outline."""
    bend_m = np.abs(cv2.Laplacian(np.nan_to_num(sharp_m), cv2.CV_64F))
    bent = ndimage.maximum_filter(bend_m, size=3) > LEAST_BEND_M
    bent &= np.isfinite(sharp_m)
    by_row = np.gradient(rays, axis=0)[bent]
    by_column = np.gradient(rays, axis=1)[bent]
    number = np.arange(SUBRAYS)
    across = (number + 0.5) / SUBRAYS - 0.5
    down = (number * GENERATOR % SUBRAYS + 0.5) / SUBRAYS - 0.5
    parts = []
    for share_x, share_y in zip(across, down, strict=True):
        part = rays[bent] + share_y * by_row + share_x * by_column
        parts.append(part / np.linalg.norm(part, axis=-1, keepdims=True))
    parts_m = seen_ranges_m(triangles, np.stack(parts), T_camera_gauge)
    averaged_m = sharp_m.copy()
    averaged_m[bent] = parts_m.mean(axis=0)
    return averaged_m


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
    """Blur of depth at the edges of steps, grooves and pockets, beside that of a pixel's area."""

    blur_px: float
    """Standard deviation of the Gaussian, sampled at pixels, that makes the gauge's edges look like
    the captured ones."""
    interval: Interval
    """Two-sided 95 % interval."""
    pixels: int
    """Pixels at edges."""
    fill: float
    """Share of them with a range, over that of the pixels beside."""


def edge_blur(image: RangeImage, seen_m: np.ndarray, displaced_px: float) -> Blur | None:
    """Return the blur of a corrected image, by the view of the gauge without blur ``seen_m``
    (h, w); None if too few pixels lie at edges.

    A view changes in proportion to the variance of the Gaussian's samples, of which there is
    hardly any up to 0.25 pixels, so the variance is fitted. Its error is a jackknife over blocks of
    the image, which holds noise, fixed pattern and pose. Edges that are ``displaced_px`` from their
    places (standard uncertainty of the gauge) look blurred by as much, which is added."""
    window = np.ones((2 * EDGE_REACH_PX + 1,) * 2)
    low_m = ndimage.minimum_filter(np.nan_to_num(seen_m, nan=-1.0), footprint=window)
    high_m = ndimage.maximum_filter(np.nan_to_num(seen_m, nan=1e3), footprint=window)
    at_edge = (high_m - low_m > LEAST_STEP_M) & (high_m - low_m < LARGEST_STEP_M)
    # spheres are curved, and no edges
    laplacian_m = np.abs(cv2.Laplacian(np.nan_to_num(seen_m), cv2.CV_64F))
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
    measured_m = image.range_m[usable]
    views_m = [blurred(seen_m, blur_px)[usable] for blur_px in _BLURS_PX]
    variance_px2 = variance_of(_nearest_blur(views_m, measured_m))
    for _ in range(PASSES):
        step_px2 = 0.02 + 0.05 * variance_px2
        low_px2 = max(variance_px2 - step_px2, 0.0)
        sharper_m = blurred(seen_m, blur_of(low_px2))[usable]
        softer_m = blurred(seen_m, blur_of(low_px2 + 2 * step_px2))[usable]
        slope = (softer_m - sharper_m) / (2 * step_px2)
        # noise may ask for edges sharper than sharp ones, a variance below 0
        off_m = measured_m - sharper_m - (variance_px2 - low_px2) * slope
        change_px2, error_px2 = _jackknifed(slope, off_m, block)
        variance_px2 += change_px2
    half_px2 = student(BLOCKS - 1) * float(np.hypot(error_px2, displaced_px**2))
    interval = Interval(blur_of(variance_px2 - half_px2), blur_of(variance_px2 + half_px2))
    return Blur(
        blur_px=blur_of(variance_px2),
        interval=interval,
        pixels=int(usable.sum()),
        fill=float(fill / fill_beside),
    )


def _nearest_blur(views_m: list[np.ndarray], measured_m: np.ndarray) -> float:
    """Return that of `_BLURS_PX` whose view (n,) lies closest to the measured ranges (n,)."""
    losses_m = [float(np.abs(measured_m - view_m).mean()) for view_m in views_m]
    return float(_BLURS_PX[int(np.argmin(losses_m))])


def _jackknifed(slope: np.ndarray, off_m: np.ndarray, block: np.ndarray) -> tuple[float, float]:
    """Return the change x that minimises the squares of off - slope x - constant over pixels (n,),
    without outliers, and its standard error by leaving out one block at a time."""
    centred_m = off_m - np.median(off_m)
    kept = np.abs(centred_m) <= OUTLIER * 1.4826 * np.median(np.abs(centred_m)) + 1e-6
    design = np.column_stack([slope, np.ones(len(slope))])[kept]
    products = np.zeros((BLOCKS, 2, 2))
    targets = np.zeros((BLOCKS, 2))
    np.add.at(products, block[kept], design[:, :, None] * design[:, None, :])
    np.add.at(targets, block[kept], design * off_m[kept, None])
    product = products.sum(axis=0)
    target = targets.sum(axis=0)
    change = np.linalg.solve(product, target)[0]
    without = np.linalg.solve(product - products, (target - targets)[..., None])[:, 0, 0]
    return float(change), float(np.sqrt((BLOCKS - 1) * np.var(without)))


def variance_of(blur_px: float) -> float:
    """Return the variance of the samples of a Gaussian, as filters use it."""
    reach_px = int(4 * blur_px + 0.5)
    impulse = np.zeros(2 * reach_px + 1)
    impulse[reach_px] = 1.0
    weights = ndimage.gaussian_filter1d(impulse, blur_px) if blur_px > 0 else impulse
    return float((weights * np.arange(-reach_px, reach_px + 1) ** 2).sum())


def blur_of(variance_px2: float) -> float:
    """Return the deviation of the Gaussian whose samples have this variance; 0 for none."""
    if variance_px2 <= 0:
        return 0.0
    widest_px = np.sqrt(variance_px2) + 0.5
    return float(optimize.brentq(lambda blur_px: variance_of(blur_px) - variance_px2, 0, widest_px))
