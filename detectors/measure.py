"""Size and place of a detection: the thesis' extents, and beside them the model of a blurred hole.

Depths are measured along the optical axis from the fitted surface, positive behind it. Sizes are measured on the
surface. The model: a round tube that starts with the surface's mouth, and behind it a floor of one depth, seen and lit
obliquely, averaged over ``blur_px`` x ``blur_px`` pixels. A ray that has come as deep as t has passed the mouth and the
circle at depth t, and so has the light that comes back along it; in the image each is an ellipse, shifted by parallax.
The tube's length over the depth is fitted too.

Not modelled: light between wall and floor, which makes a wall look deeper than it is; walls darker than the floor; a
floor that is not flat; the loss of weight of deep neighbours in a bilateral filter (holes of 2 to 3 times the blur come
out up to 16 % too deep at 33 mm).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numba
import numpy as np
from pydantic import Field, field_validator
from scipy.optimize import leastsq

from detectors.interface import Detection, Evidence, Measurement
from detectors.masks import grown, parts_with
from detectors.noise import median_of, sigma_of
from detectors.whitening import correlated_products, whitener
from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM, Cloud, Region, rotate_vectors

STRIPS = 64
"""Strips that stand for the disc: the coverage is exact in total, and in each pixel within 0.001 for a blur of 3."""
NODES, WEIGHTS = np.array([0.5 - 0.15**0.5, 0.5, 0.5 + 0.15**0.5, 1.0]), np.array([5.0, 8.0, 5.0, 0.0]) / 18.0
"""Gauss and Legendre's rule of three points on (0, 1), for the integral over the depth of the wall; and its end."""
STEP = 1e-3
"""Size of the differences that stand for derivatives: in pixels, relative for radius and depth, absolute for the wall.
"""
IMAGES, TOLERANCE = 60, 1e-4  # limits of a descent: the most images drawn, and the relative change below which it ends
MODEL_ERROR, RADIUS_ERROR_PX, DEPTH_ERROR = 0.02, 0.05, 0.05
"""Errors that light between wall and floor leaves, as simulated clouds show beyond their noise: a pixel's share of its
depth, by which the likelihood trusts it less, and parts of the fitted radius and depth, which their standard errors
include."""
MOST_MISFIT = 1.5
"""Deviation of what the fit leaves from which on the model does not hold: 0.3 to 1.05 on simulated boards of its own
optics, 1.1 to 3 before lenses that blur otherwise."""
WALL_PRIOR = (0.5, 12.0**-0.5)
"""Mean and standard deviation of the tube's length over the depth before the image is seen: uniform from 0 to 1."""

_THETA = np.linspace(-np.pi / 2, np.pi / 2, STRIPS + 1)
EDGES = np.sin(_THETA)  # edges (s + 1,) of strips across a unit disc, narrow where the chord changes fast
HALF_CHORDS = np.diff(_THETA / 2 + np.sin(2 * _THETA) / 4) / np.diff(EDGES)  # mean half-chords (s,) of these strips
MIDDLES = 0.5 * (EDGES[:-1] + EDGES[1:])


def sight(centre_m: np.ndarray, per_px_m: np.ndarray, emitter_m: np.ndarray, share: float = 1.0) -> np.ndarray:
    """Return the place (8,) from where a hole is seen and lit, reduced to what moves in the image: the cosine between
    ray and normal, times the ray's length per z; the drift along u and v; the shrinking; the beam along u and v; the
    emitter's height; the share of the image that is seen from here. ``centre_m`` (3,) in the camera's frame,
    ``per_px_m`` (2, 3).

    A circle at depth h along the normal looks like the same circle on the surface, moved by h * drift / (1 + h *
    shrinking), and smaller by that divisor. Light that comes back from depth h came in at beam * h / (h + height) from
    it.
    """
    normal = np.cross(per_px_m[0], per_px_m[1])
    normal = normal / np.copysign(np.linalg.norm(normal), normal @ centre_m)
    ray, z = centre_m / centre_m[2], centre_m[2]
    slopes_per_px = ((per_px_m - np.outer(per_px_m[:, 2], ray)) / z)[:, :2].T
    drift = np.linalg.pinv(slopes_per_px) @ (normal - normal[2] * ray)[:2] / z
    distance, before = normal @ centre_m, normal @ emitter_m
    beam = np.linalg.pinv(per_px_m.T) @ (emitter_m - centre_m * before / distance)
    return np.array([normal @ ray, *drift, normal[2] / z, *beam, distance - before, share])


def straight_sight(per_px_m: np.ndarray) -> np.ndarray:
    """Return the sight along z from everywhere at once, lit likewise: a parallel projection of unknown origin."""
    normal = np.cross(per_px_m[0], per_px_m[1])
    normal = normal / np.copysign(np.linalg.norm(normal), normal[2])
    drift = np.linalg.pinv(per_px_m[:, :2].T) @ normal[:2]
    return np.array([normal[2], *drift, 0.0, 0.0, 0.0, 1.0, 1.0])


@dataclass(frozen=True)
class HolePatch:
    """Residuals around one detection. ``metric_m2`` (2, 2): squared length of a pixel offset (du, dv) is its quadratic
    form. ``noise_m``: deviation beside the hole. ``blur_px`` (along u, along v): sides of the rectangle over which the
    image is averaged. ``sights`` (s, 8). ``correlation`` (odd, odd): of the noise by lag, where it is known."""

    residual_m: np.ndarray
    used: np.ndarray
    metric_m2: np.ndarray
    blur_px: tuple[float, float]
    noise_m: float
    sights: np.ndarray
    correlation: np.ndarray | None = None

    @property
    def prior_weight(self) -> float:
        """Misfit in metres that a deviation of the wall by 1 is worth."""
        return self.noise_m * math.sqrt(self.blur_px[0] * self.blur_px[1]) / WALL_PRIOR[1]


def pictures(patch: HolePatch, holes: np.ndarray) -> np.ndarray:
    """Return the residuals (m, h, w) of holes (m, 5), each (u, v, radius, depth, wall), without offset: depth along the
    optical axis, wall in 0..1; a disc where the depth is negative. The mouth is cut into strips along u, and each hole
    into layers: of each sight three of wall, and what is deeper."""
    return _painted(holes, patch.sights, patch.metric_m2, *patch.blur_px, *patch.used.shape)


@numba.njit(cache=True, nogil=True)
def _painted(
    holes: np.ndarray, sights: np.ndarray, metric: np.ndarray, blur_u: float, blur_v: float, h: int, w: int
) -> np.ndarray:
    g11, g12, g22 = metric[0, 0], metric[0, 1], metric[1, 1]
    # the mouth's height and half-width in px per metre of radius, and the drift of its chords along u by v
    height, width, slant = math.sqrt(g11 / (g11 * g22 - g12 * g12)), 1.0 / math.sqrt(g11), -g12 / g11
    half_u, half_v = 0.5 * blur_u, 0.5 * blur_v
    images, across = np.zeros((len(holes), h, w)), np.empty(w)
    # of each layer its weight, and three circles that its light has passed: shift along u and v, and scale
    layers, weights = np.empty((len(sights) * len(NODES), 3, 3)), np.empty(len(sights) * len(NODES))
    for n in range(len(holes)):
        u, v, radius, depth, wall = holes[n]
        for k in range(len(weights)):
            cosine, drift_u, drift_v, shrink, beam_u, beam_v, emitter, share = sights[k // len(NODES)]
            node = k % len(NODES)
            deepest = depth * cosine
            length = wall * deepest if depth > 0 else 0.0
            tube, is_wall = length * NODES[node], NODES[node] < 1.0
            end = tube if is_wall else max(deepest, 0.0)
            weights[k] = share / cosine * (length * WEIGHTS[node] if is_wall else deepest - length)
            scale, lit, below = (
                1.0 / (1.0 + tube * shrink),
                end / (end + emitter),
                (end - tube) / (end - tube + emitter),
            )
            shift_u, shift_v = tube * drift_u * scale, tube * drift_v * scale
            layers[k, 0] = shift_u, shift_v, scale
            layers[k, 1] = -lit * beam_u, -lit * beam_v, 1.0
            layers[k, 2] = shift_u - below * beam_u, shift_v - below * beam_v, scale
        for s in range(STRIPS):
            bottom, top = v + radius * height * EDGES[s], v + radius * height * EDGES[s + 1]
            down = radius * height * MIDDLES[s]
            across[:] = 0.0
            for k in range(len(weights)):
                start, end = (
                    slant * down - radius * HALF_CHORDS[s] * width,
                    slant * down + radius * HALF_CHORDS[s] * width,
                )
                for shift_u, shift_v, scale in layers[k]:
                    middle = shift_u + slant * (down - shift_v)
                    half = width * math.sqrt(max((radius * scale) ** 2 - ((down - shift_v) / height) ** 2, 0.0))
                    start, end = max(start, middle - half), min(end, middle + half)
                start, end = u + start, u + end
                if end > start:
                    for c in range(max(0, math.ceil(start - half_u)), min(w - 1, math.floor(end + half_u)) + 1):
                        across[c] += weights[k] * max(min(end, c + half_u) - max(start, c - half_u), 0.0)
            for r in range(max(0, math.ceil(bottom - half_v)), min(h - 1, math.floor(top + half_v)) + 1):
                along = max(min(top, r + half_v) - max(bottom, r - half_v), 0.0) / (4.0 * half_u * half_v)
                for c in range(w):
                    images[n, r, c] += along * across[c]
    return images


def derivatives(patch: HolePatch, hole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the residual (h, w) of a hole (5,), and its derivatives (5, h, w), by differences."""
    steps = STEP * np.array([1.0, 1.0, hole[2], hole[3] or STEP, -1.0 if hole[4] >= 0.5 else 1.0])
    image, *moved = pictures(patch, np.vstack([hole, hole + np.diag(steps)]))
    return image, (np.array(moved) - image) / steps[:, None, None]


@dataclass(frozen=True)
class HoleFit:
    """``u_px``, ``v_px`` in the patch; ``covariance`` (6, 6) of (u, v, radius, depth, offset, wall), px and metres.
    ``misfit``: deviation of what is left in units of the noise and the model's own error; 0 where neither is known."""

    u_px: float
    v_px: float
    radius_m: float
    depth_m: float
    offset_m: float
    wall: float
    covariance: np.ndarray
    converged: bool
    misfit: float


def fit_hole(patch: HolePatch, u: float, v: float, radius_m: float, depth_m: float, offset_m: float) -> HoleFit:
    """Fit by least squares (MINPACK) from a start, to six used pixels and more: the likelihood's maximum where the
    patch knows the noise's covariance, else with `sandwich_covariance`.

    Fitted are (u, v, ln radius, depth * radius^2, offset, x) with the wall sin^2(pi x / 2). The fourth is the hole's
    volume, which the blur keeps, so that a small hole still has one well-determined direction for each parameter but
    its radius. The wall has `WALL_PRIOR`: a small hole, or one seen straight on, does not determine it.
    """
    start = np.array([u, v, math.log(radius_m), depth_m * radius_m**2, offset_m, WALL_PRIOR[0]])
    h, w = patch.used.shape
    # keeps a wild trial step finite: no disc is larger than ten patches
    low = np.array([-10.0 * w, -10.0 * h, -20.0])
    high = np.array([10.0 * w, 10.0 * h, math.log(10.0 * (h + w) * math.sqrt(patch.metric_m2.max()))])
    used, data, error_m = patch.used, patch.residual_m[patch.used], MODEL_ERROR * np.abs(patch.residual_m - offset_m)
    whitened = whitener(used, patch.correlation, max(patch.noise_m, 1e-9), error_m)
    weight = patch.prior_weight if whitened is None else 1.0 / WALL_PRIOR[1]

    def hole_of(q: np.ndarray) -> np.ndarray:
        u, v, log_radius = np.clip(q[:3], low, high).tolist()
        radius = math.exp(log_radius)
        return np.array([u, v, radius, q[3] / radius**2, math.sin(0.5 * math.pi * q[5]) ** 2])

    def misfit(q: np.ndarray) -> np.ndarray:
        hole = hole_of(q)
        left = pictures(patch, hole[None])[0][used] + q[4] - data
        return np.append(left if whitened is None else whitened(left), weight * (hole[4] - WALL_PRIOR[0]))

    def jacobian(q: np.ndarray) -> np.ndarray:
        hole = hole_of(q)
        radius, depth = hole[2], hole[3]
        slope = 0.5 * math.pi * math.sin(math.pi * q[5])
        rows, by = np.zeros((6, len(data) + 1)), derivatives(patch, hole)[1][:, used]
        rows[:4, :-1] = by[0], by[1], radius * by[2] - 2.0 * depth * by[3], by[3] / radius**2
        rows[4, :-1], rows[5, :-1] = 1.0, slope * by[4]
        rows[5, -1] = weight * slope
        if whitened is not None:
            rows[:, :-1] = whitened(rows[:, :-1].T).T
        return rows

    stop = {"ftol": TOLERANCE, "xtol": TOLERANCE, "gtol": 1e-9, "maxfev": IMAGES}
    q, _, _, _, outcome = leastsq(misfit, start, Dfun=jacobian, col_deriv=True, full_output=True, **stop)
    hole, offset = hole_of(q), float(q[4])
    u, v, radius, depth, wall = hole.tolist()
    if whitened is None:
        covariance, left = sandwich_covariance(patch, hole, offset), 0.0
    else:
        by = derivatives(patch, hole)[1][:, used]
        rows = whitened(np.stack([*by[:4], np.ones(len(data)), by[4]]).T).T
        left = float((misfit(q)[:-1] ** 2).sum()) / max(len(data) - 6, 1)
        covariance = _likelihood_covariance(patch, hole, rows, left)
    return HoleFit(u, v, radius, depth, offset, wall, covariance, outcome in (1, 2, 3, 4), math.sqrt(left))


def _likelihood_covariance(patch: HolePatch, hole: np.ndarray, rows: np.ndarray, variance: float) -> np.ndarray:
    """Return the covariance (6, 6) of (u, v, radius, depth, offset, wall) from whitened derivatives (6, n) by them and
    the variance of what is left: the information's inverse times that variance, and the model's own errors."""
    information = rows @ rows.T
    information[5, 5] += WALL_PRIOR[1] ** -2
    found = np.linalg.pinv(information, hermitian=True) * variance
    found[2, 2] += RADIUS_ERROR_PX**2 * float(np.trace(patch.metric_m2)) / 2.0
    found[3, 3] += (DEPTH_ERROR * hole[3]) ** 2
    return np.asarray(found)


def sandwich_covariance(patch: HolePatch, hole: np.ndarray, offset_m: float) -> np.ndarray:
    """Return the covariance (6, 6) of (u, v, radius, depth, offset, wall) under noise that the square filter
    correlates, NaN where none is determined: cov = A^-1 (s^2 J' C J + p^2 W) A^-1 with A = J' J + W, W the prior's
    square weight on the wall, p^2 its variance; s^2 from the misfit, E[misfit' misfit] = s^2 (n - trace(A^-1 J' C
    J))."""
    image, by = derivatives(patch, hole)
    columns = np.stack([*by[:4], np.ones(patch.used.shape), by[4]]) * patch.used
    flat = columns.reshape(6, -1)
    # the odd numbers of pixels nearest to the blur: pixels so far apart have no noise in common
    across, down = (2 * max(round((blur - 1) / 2), 0) + 1 for blur in patch.blur_px)
    prior = np.zeros((6, 6))
    prior[5, 5] = patch.prior_weight**2
    try:
        bread = np.linalg.inv(flat @ flat.T + prior)
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.nan)
    meat = correlated_products(columns, across, down) / (across * down)
    freedom = int(patch.used.sum()) - float(np.trace(bread @ meat))
    if freedom <= 0:
        return np.full((6, 6), np.nan)
    misfit = (image + offset_m - patch.residual_m)[patch.used]
    variance = float(misfit @ misfit) / freedom
    prior_variance = patch.noise_m**2 * patch.blur_px[0] * patch.blur_px[1]
    return np.asarray(bread @ (variance * meat + prior_variance * prior) @ bread)


OTHER_DAMAGE_SIGMAS = 5.0
"""Pixels of the patch that stand out by so much and do not touch the detection belong to something else."""
CONTOUR_ZOOM = 4  # sub-pixels of the half-depth contour along each axis


class HoleModelConfig(Config):
    """Assumptions of the model of a blurred hole. ``blur_px``: side of the square over which the camera averages: 5 for
    the Azure Kinect's depth engine (OpenK4A), 3 for the Kinect v2 (libfreenect2), 1 for none. ``emitter_mm``: where the
    light stands in the camera's frame. ``linear_depth_mm``: beyond it a neighbour at depth counts for less than half in
    the filter, and the contour at half depth is the safer measure. ``largest_invalid``: the part of the disc that may
    lack a range. ``largest_relative_error``: of the diameter; beyond it diameter and depth cannot be told apart."""

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
    """Return the sides, along columns and rows, of the rectangle over which the cloud is averaged, in its own pixels or
    cells: what a recording's noise shares, else ``config.blur_px``. A map adds the interpolation of its views' pixels:
    sqrt(blur^2 + 2) pixels. Cells of more than a pixel take a mean of their own."""
    if cloud.map_views is None or not cloud.organised:
        blur_px = cloud.noise_reach_px or float(config.blur_px)
        return blur_px, blur_px
    across, down = (np.diff(cloud.points_m[..., k], axis=1 - k) for k in (0, 1))
    cells = [float(np.nanmedian(steps)) if np.isfinite(steps).any() else 1.0 for steps in (across, down)]
    pixels = [pitch / cell for pitch, cell in zip(cloud.map_views.pixel_m, cells, strict=True)]
    along_u, along_v = (
        math.sqrt((config.blur_px**2 + 2.0) * pixel**2 + (1.0 if round(1.0 / pixel) > 1 else 0.0)) for pixel in pixels
    )
    return along_u, along_v


@numba.njit(cache=True, nogil=True)
def extents(points_m: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the thesis' size and centre (3,) of a cluster (n, 3), metres: mean of the distances between the extreme
    points in x and between those in y; mean of these four. Of equal extremes the first counts."""
    x, y = points_m[:, 0], points_m[:, 1]
    west, east, north, south = points_m[x.argmin()], points_m[x.argmax()], points_m[y.argmin()], points_m[y.argmax()]
    diameter = 0.5 * (np.sqrt(((east - west) ** 2).sum()) + np.sqrt(((south - north) ** 2).sum()))
    return diameter, (west + east + north + south) / 4.0


def measure_extents(cloud: Cloud, detection: Detection, note: str) -> Measurement:
    """Measure the thesis' extents and the place on the sensor, if any; ``note`` says why there is no more."""
    points = cloud.points_m.reshape(-1, 3)[detection.pixels]
    diameter, centre = extents(points)
    u = v = np.nan
    if cloud.organised:
        rows, columns = np.unravel_index(detection.pixels, cloud.points_m.shape[:2])
        u, v = float(columns.mean()) + cloud.region.col0, float(rows.mean()) + cloud.region.row0
    return Measurement(u, v, len(points), detection.score, diameter, centre, model_note=note)


def measure_detection(
    cloud: Cloud,
    evidence: Evidence,
    detection: Detection,
    config: HoleModelConfig,
    correlation: np.ndarray | None = None,
) -> Measurement:
    """Measure one detection both ways; NaN and a note where a measure cannot be made. ``correlation`` (odd, odd): of
    the noise, by lag, where it is known."""
    if not cloud.organised:
        return measure_extents(cloud, detection, "no pixel grid: extents only")
    placed = measure_extents(cloud, detection, "too few valid pixels around for a model")
    rows, columns = np.unravel_index(detection.pixels, cloud.points_m.shape[:2])
    around = _surroundings(cloud, evidence, rows, columns, config)
    if around is None:
        return placed
    near = grown(around.own, around.reach_px + 1) & around.patch.used
    (ax, ay, _), (bx, by, _) = around.per_px_m
    # a pixel's area across the optical axis
    volume = float((around.patch.residual_m[near] - around.offset_m).sum()) * float(abs(ax * by - ay * bx))
    length_m, width_m, along = _sides(around, near)
    placed = replace(placed, volume_m3=volume, length_m=length_m, width_m=width_m, along=along)
    around = replace(around, patch=replace(around.patch, correlation=correlation))
    fit, doubt = _modelled(around, config)
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
        # per axis: the two axes on the surface share the trace
        model_centre_se_m=float(np.sqrt(np.trace(spread) / 2.0)),
        model_note="",
    )


def _sides(around: _Surroundings, near: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Return length and width of the rectangle on the surface that has the second moments of the residual within
    ``near`` (h, w) bool, those of the blur taken off, and the direction (3,) of its length."""
    residual = around.patch.residual_m[near] - around.offset_m
    weight = np.maximum(around.sign * residual, 0.0)
    v, u = np.nonzero(near)
    if not weight.sum() > 0:
        return np.nan, np.nan, np.full(3, np.nan)
    moments = (
        np.atleast_2d(np.cov(np.stack([u, v]), aweights=weight, ddof=0)) - np.diag(np.square(around.patch.blur_px)) / 12
    )
    variances, axes = np.linalg.eigh(around.per_px_m.T @ moments @ around.per_px_m)
    # of the three the one nearest to 0 is that across the surface
    width_m, length_m = (float(np.sqrt(12.0 * max(each, 0.0))) for each in (sorted(variances)[-2], variances[-1]))
    return length_m, width_m, axes[:, -1]


@dataclass(frozen=True)
class _Surroundings:
    """A detection and its neighbourhood. ``offset_m`` of the residual round about; ``sign`` and ``peak_m`` of the
    detection's own less that; ``reach_px``: half of the blur. ``origin_m``: the surface's point at (``u0``, ``v0``)."""

    patch: HolePatch
    own: np.ndarray
    invalid: np.ndarray
    offset_m: float
    sign: float
    peak_m: float
    reach_px: int
    u0: float
    v0: float
    origin_m: np.ndarray
    per_px_m: np.ndarray

    @property
    def area_m2(self) -> float:
        """Area of one pixel on the surface."""
        return float(np.linalg.norm(np.cross(*self.per_px_m)))

    def placed(self, measured: Measurement, u: float, v: float) -> Measurement:
        """Return the measurement, placed at a patch position."""
        du, dv = u - self.u0, v - self.v0
        centre_m = self.origin_m + du * self.per_px_m[0] + dv * self.per_px_m[1]
        return replace(measured, u_px=du + measured.u_px, v_px=dv + measured.v_px, model_centre_m=centre_m)


def _surroundings(
    cloud: Cloud, evidence: Evidence, rows: np.ndarray, columns: np.ndarray, config: HoleModelConfig
) -> _Surroundings | None:
    """Cut out the detection with twice the blur of margin on each side."""
    h, w = cloud.points_m.shape[:2]
    sides = blur_in_cells(cloud, config)
    blur = max(sides)
    tight = Region(int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1)
    corner = tight.grown(math.ceil(2 * blur) + 2, h, w)
    cut = corner.within(Region(0, h, 0, w))
    residual, points = evidence.residual_m[cut], cloud.points_m[cut]
    own = np.zeros(residual.shape, dtype=bool)
    own[rows - corner.row0, columns - corner.col0] = True
    finite = np.isfinite(residual)
    ring = residual[finite & ~grown(own, int(blur / 2) + 1)]
    if len(ring) < 12:
        return None
    offset = median_of(ring)
    noise = sigma_of(ring - offset)
    plane = local_plane(points, evidence.surface_z_m[cut], finite, own, cloud.projection)
    if plane is None:
        return None
    centre, per_px = plane
    # what stands out without touching the detection is other damage, with the blur around it
    stands_out = (np.abs(np.nan_to_num(residual - offset)) > OTHER_DAMAGE_SIGMAS * max(noise, 1e-9)) | own
    others = stands_out & ~parts_with(stands_out, own)
    used = finite & (own | ~grown(others, int(blur / 2)))
    deviations = residual[own] - offset
    sign = 1.0 if deviations.sum() >= 0 else -1.0
    peak = max(float(np.quantile(sign * deviations, 0.9)), 1e-9)
    # from where the surface's point is seen: the camera, or all those that a map was made from
    emitter, views = np.array(config.emitter_mm) * MM, cloud.map_views
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
    return _Surroundings(patch, own, invalid, offset, sign, peak, int(blur / 2), u0, v0, centre, per_px)


def local_plane(
    points: np.ndarray, surface_z: np.ndarray, finite: np.ndarray, own: np.ndarray, projection: str
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the surface's point at the detection's centroid (3,) and its derivatives by u and v (2, 3), by regression
    of directions (in a parallel projection of x and y) and of the surface's z."""
    v0, u0 = (float(axis.mean()) for axis in np.nonzero(own))
    v, u = np.nonzero(finite)
    design = np.column_stack([np.ones(len(u)), u - u0, v - v0])
    seen = points[finite]
    across = seen[:, :2] if projection == "parallel" else seen[:, :2] / seen[:, 2:]
    try:
        beta = np.linalg.solve(design.T @ design, design.T @ np.column_stack([across, surface_z[finite]]))
    except np.linalg.LinAlgError:
        return None
    if projection == "parallel":
        centre, per_px = beta[0], beta[1:]
    else:
        slopes, z = np.append(beta[0, :2], 1.0), beta[0, 2]
        centre = slopes * z
        per_px = np.stack([np.append(beta[k, :2], 0.0) * z + slopes * beta[k, 2] for k in (1, 2)])
    if not np.linalg.norm(np.cross(*per_px)) > 1e-12:
        return None
    return centre, per_px


def _modelled(around: _Surroundings, config: HoleModelConfig) -> tuple[HoleFit | None, str]:
    """Return the fitted hole; None with the reason where the model is to be doubted."""
    own, invalid, patch = around.own, around.invalid, around.patch
    dark = "part of the hole has no range"
    too_deep = f"deeper than {config.linear_depth_mm:g} mm, where the camera's filter no longer averages evenly"
    inside = own | (invalid & grown(own, 1))
    if float((invalid & inside).sum()) > config.largest_invalid * float(inside.sum()):
        return None, dark
    if around.peak_m > config.linear_depth_mm * MM:
        return None, too_deep
    # the start: centroid of the deviation, peak depth, and the radius that gives the volume
    near = grown(own, around.reach_px) & patch.used
    weight = np.maximum(around.sign * (patch.residual_m[near] - around.offset_m), 0.0)
    v, u = np.nonzero(near)
    total = max(float(weight.sum()), 1e-12)
    radius = float(np.sqrt(total * around.area_m2 / (np.pi * around.peak_m)))
    u0, v0 = float(weight @ u) / total, float(weight @ v) / total
    if patch.used.sum() < 6:
        return None, "the model of a blurred hole does not fit"
    fit = fit_hole(patch, u0, v0, radius, around.sign * around.peak_m, around.offset_m)
    h, w = own.shape
    reach = np.pad(grown(own, around.reach_px + 1), 1)
    at = np.clip(np.round([fit.v_px + 1, fit.u_px + 1]), 0, [h + 1, w + 1]).astype(int)
    if not (fit.converged and reach[at[0], at[1]] and fit.misfit < MOST_MISFIT):
        return None, "the model of a blurred hole does not fit"
    if abs(fit.depth_m) > config.linear_depth_mm * MM:
        return None, too_deep
    # the part of each pixel that the disc covers
    flat = np.array([[fit.u_px, fit.v_px, fit.radius_m, -1.0, 0.0]])
    disc = -pictures(replace(patch, blur_px=(1.0, 1.0)), flat)[0]
    if float(disc[invalid].sum()) > config.largest_invalid * float(disc.sum()):
        return None, dark
    # a singular fit can leave a negative variance by rounding
    variance = float(fit.covariance[2, 2])
    if not 0 < variance < (config.largest_relative_error * fit.radius_m) ** 2:
        return None, "diameter and depth cannot be told apart through the blur (the diameter is an upper limit)"
    return fit, ""


def _by_contour(measured: Measurement, around: _Surroundings, doubt: str) -> Measurement:
    """Measure the contour at half of the depth; pixels without a range that touch the detection count as inside."""
    residual = np.nan_to_num(around.sign * (around.patch.residual_m - around.offset_m))
    hollow = around.invalid & parts_with(around.own | around.invalid, around.own)
    residual[hollow] = around.peak_m
    residual[~around.patch.used & ~hollow] = 0.0
    size = tuple(CONTOUR_ZOOM * side for side in residual.shape[::-1])
    fine = cv2.resize(residual, size, interpolation=cv2.INTER_LINEAR)
    seeds = cv2.resize(around.own.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    inside = parts_with(fine > 0.5 * around.peak_m, seeds > 0)
    if not inside.any():
        return replace(measured, model_note=doubt + "; no half-depth contour")
    v, u = (float((axis.mean() + 0.5) / CONTOUR_ZOOM - 0.5) for axis in np.nonzero(inside))
    area = inside.sum() / CONTOUR_ZOOM**2 * around.area_m2
    return replace(
        around.placed(measured, u, v),
        model_diameter_m=2.0 * float(np.sqrt(area / np.pi)),
        model_depth_m=np.nan if hollow.sum() > around.own.sum() else around.sign * around.peak_m,
        model_note=doubt + "; from the contour at half depth, without standard errors",
    )
