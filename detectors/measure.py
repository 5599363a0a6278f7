"""Size and place of a detection: the thesis' extents, and beside them the model of a blurred hole.

Depths are measured along the optical axis from the fitted surface, positive behind it; a hole at an angle is deeper
along this axis than along its own by 1 / cos. Sizes are measured on the surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from pydantic import Field, field_validator

from detectors.hole import HoleFit, HolePatch, Sight, blurred_disc, crossed, fit_hole
from detectors.interface import Detection, Evidence, Measurement
from detectors.masks import grown, parts_with
from detectors.noise import median_of, quantile_of, sigma_of
from harness.vocabulary.capture import Cloud
from harness.vocabulary.config import Config
from harness.vocabulary.geometry import Region, rotate_vectors
from harness.vocabulary.units import MM

OTHER_DAMAGE_SIGMAS = 5.0
"""Pixels of the patch that stand out by so much and do not touch the detection belong to something else."""
CONTOUR_ZOOM = 4
"""Sub-pixels of the half-depth contour along each axis."""


class HoleModelConfig(Config):
    """Assumptions of the model of a blurred hole.

    ``blur_px``: side of the square over which the camera averages: 5 for the Azure Kinect's depth engine (5x5
    bilateral on phasors, OpenK4A), 3 for the Kinect v2 (libfreenect2), 1 for none. ``emitter_mm``: where the light
    stands in the camera's frame (the Azure Kinect's, 14 mm beside the lens; its SDK's issue 812). ``linear_depth_mm``:
    beyond it a neighbour at depth counts for less than half in the filter (weight 0.51 at 75 mm for 198 MHz), so that
    the image is no average any more, and the contour at half depth is the safer measure. ``largest_invalid``: the part
    of the disc that may lack a range. ``largest_relative_error``: of the diameter; beyond it diameter and depth cannot
    be told apart.
    """

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
    cells.

    The noise that a recording shares counts before ``config.blur_px``: depth that was upsampled or aligned to a finer
    camera is blurred over more pixels than the camera's filter has, and that of a camera without a filter over its own
    pixel only, where a model of 5 pixels would make every hole narrower and several times deeper.
    A map adds the linear interpolation of its views' pixels, whose variance is a sixth of a pixel squared, to the
    square's twelfth: as a square of side sqrt(blur^2 + 2) pixels. Cells of more than a pixel take a mean of their own.
    """
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


def extents(points_m: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the thesis' size and centre of a cluster (n, 3): (diameter, centre (3,)), metres.

    Size: mean of the distances in space between the extreme points in x and between those in y; centre: mean of these
    four points. Of equal extremes the first counts, as in MATLAB.
    """
    x, y = points_m[:, 0], points_m[:, 1]
    west, east, north, south = points_m[[int(x.argmin()), int(x.argmax()), int(y.argmin()), int(y.argmax())]]
    diameter = 0.5 * (float(np.linalg.norm(east - west)) + float(np.linalg.norm(south - north)))
    return diameter, (west + east + north + south) / 4.0


def measure_extents(cloud: Cloud, detection: Detection, note: str) -> Measurement:
    """Measure the thesis' extents, and the mean of the detection's pixels as its place on the sensor where there is a
    pixel grid; ``note`` says why there is no more."""
    points = cloud.points_m.reshape(-1, 3)[detection.pixels]
    diameter, centre = extents(points)
    u = v = np.nan
    if cloud.organised:
        rows, columns = np.unravel_index(detection.pixels, cloud.points_m.shape[:2])
        u, v = float(columns.mean()) + cloud.region.col0, float(rows.mean()) + cloud.region.row0
    return Measurement(u, v, len(points), detection.score, diameter, centre, model_note=note)


def measure_detection(cloud: Cloud, evidence: Evidence, detection: Detection, config: HoleModelConfig) -> Measurement:
    """Measure one detection both ways; NaN and a note where a measure cannot be made."""
    if not cloud.organised:
        return measure_extents(cloud, detection, "no pixel grid: extents only")
    placed = measure_extents(cloud, detection, "too few valid pixels around for a model")
    rows, columns = np.unravel_index(detection.pixels, cloud.points_m.shape[:2])
    around = _Surroundings.of(cloud, evidence, rows, columns, config)
    if around is None:
        return placed
    near = grown(around.own, around.reach_px + 1) & around.patch.used
    volume = float((around.patch.residual_m[near] - around.offset_m).sum()) * around.facing_area_m2
    measured = replace(placed, volume_m3=volume)
    fit, doubt = _modelled(around, config)
    if fit is None or doubt:
        return _by_contour(measured, around, doubt)
    errors = np.sqrt(np.diag(fit.covariance))
    spread = around.per_px_m.T @ fit.covariance[:2, :2] @ around.per_px_m
    return replace(
        measured,
        **around.placed(placed, fit.u_px, fit.v_px),
        model_diameter_m=2.0 * fit.radius_m,
        model_diameter_se_m=2.0 * float(errors[2]),
        model_depth_m=fit.depth_m,
        model_depth_se_m=float(errors[3]),
        # per axis: the two axes on the surface share the trace
        model_centre_se_m=float(np.sqrt(np.trace(spread) / 2.0)),
        model_note="",
    )


# ---------------------------------------------------------------- the neighbourhood


@dataclass(frozen=True)
class _Surroundings:
    """A detection and its neighbourhood. ``own`` (h, w): the detection's pixels, ``invalid`` (h, w): without a range.

    ``origin_m`` is the surface's point at patch pixel (``u0``, ``v0``), ``per_px_m`` (2, 3) its derivatives by u and v.
    """

    patch: HolePatch
    own: np.ndarray
    invalid: np.ndarray
    offset_m: float
    sign: float
    peak_m: float
    u0: float
    v0: float
    origin_m: np.ndarray
    per_px_m: np.ndarray

    @classmethod
    def of(
        cls, cloud: Cloud, evidence: Evidence, rows: np.ndarray, columns: np.ndarray, config: HoleModelConfig
    ) -> _Surroundings | None:
        """Cut out the detection with twice the blur of margin on each side; None where the surface around cannot be
        placed."""
        h, w = cloud.points_m.shape[:2]
        sides = blur_in_cells(cloud, config)
        blur = max(sides)
        tight = Region(int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1)
        corner = tight.grown(math.ceil(2 * blur) + 2, h, w)
        cut = corner.within(Region(0, h, 0, w))
        residual = evidence.residual_m[cut]
        own = np.zeros(residual.shape, dtype=bool)
        own[rows - corner.row0, columns - corner.col0] = True
        finite = np.isfinite(residual)
        ring = residual[finite & ~grown(own, int(blur / 2) + 1)]
        if len(ring) < 12:
            return None
        offset = median_of(ring)
        noise = sigma_of(ring - offset)
        plane = local_plane(cloud.points_m[cut], evidence.surface_z_m[cut], finite, own, cloud.projection)
        if plane is None:
            return None
        # what stands out without touching the detection is other damage, with the blur around it
        stands_out = (np.abs(np.nan_to_num(residual - offset)) > OTHER_DAMAGE_SIGMAS * max(noise, 1e-9)) | own
        others = stands_out & ~parts_with(stands_out, own)
        used = finite & (own | ~grown(others, int(blur / 2)))
        deviations = residual[own] - offset
        sign = 1.0 if deviations.sum() >= 0 else -1.0
        peak = max(quantile_of(sign * deviations, 0.9), 1e-9)
        metric = plane[1] @ plane[1].T
        patch = HolePatch(residual, used, metric, sides, noise, _sight(cloud, *plane, np.array(config.emitter_mm) * MM))
        invalid = ~np.isfinite(cloud.points_m[cut][..., 2])
        v0, u0 = (float(axis.mean()) for axis in np.nonzero(own))
        return cls(patch, own, invalid, offset, sign, peak, u0, v0, plane[0], plane[1])

    @property
    def reach_px(self) -> int:
        """Half of the blur."""
        return int(max(self.patch.blur_px) / 2)

    @property
    def surface_area_m2(self) -> float:
        """Area of one pixel on the surface."""
        return float(np.linalg.norm(crossed(self.per_px_m[0], self.per_px_m[1])))

    @property
    def facing_area_m2(self) -> float:
        """Area of one pixel across the optical axis."""
        (ax, ay, _), (bx, by, _) = self.per_px_m
        return float(abs(ax * by - ay * bx))

    def placed(self, at_detection: Measurement, u: float, v: float) -> dict[str, Any]:
        """Return the fields that place a measurement at a patch position."""
        return {
            "u_px": u - self.u0 + at_detection.u_px,
            "v_px": v - self.v0 + at_detection.v_px,
            "model_centre_m": self.origin_m + (u - self.u0) * self.per_px_m[0] + (v - self.v0) * self.per_px_m[1],
        }


def local_plane(
    points: np.ndarray, surface_z: np.ndarray, finite: np.ndarray, own: np.ndarray, projection: str
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the surface's point at the detection's centroid (3,) and its derivatives by u and v (2, 3), by regression.

    Directions x/z and y/z and the surface's z are each linear in the pixel over a patch; then the product rule. In a
    parallel projection x and y themselves are.
    """
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
    if not np.linalg.norm(crossed(per_px[0], per_px[1])) > 1e-12:
        return None
    return centre, per_px


def _sight(cloud: Cloud, centre: np.ndarray, per_px: np.ndarray, emitter_camera_m: np.ndarray) -> Sight:
    """Return the sight of the surface's point (3,) from the camera, or from all those that a map was made from."""
    if cloud.projection == "central":
        return Sight.of(centre, per_px, emitter_camera_m)
    if cloud.map_views is None:
        return Sight.straight(per_px)
    views = cloud.map_views
    places = [
        replace(Sight.of(centre - T[:3, 3], per_px, rotate_vectors(T, emitter_camera_m)), share=float(share))
        for T, share in zip(views.T_cloud_cameras, views.shares, strict=True)
    ]
    return replace(places[0], others=tuple(places[1:]))


# ---------------------------------------------------------------- the model, and what to do without it


def _modelled(around: _Surroundings, config: HoleModelConfig) -> tuple[HoleFit | None, str]:
    """Return the fitted hole, and the reason to doubt it ('' for none)."""
    own, invalid, patch = around.own, around.invalid, around.patch
    inside = own | (invalid & grown(own, 1))
    if float((invalid & inside).sum()) > config.largest_invalid * float(inside.sum()):
        return None, "part of the hole has no range"
    too_deep = f"deeper than {config.linear_depth_mm:g} mm, where the camera's filter no longer averages evenly"
    if around.peak_m > config.linear_depth_mm * MM:
        return None, too_deep
    # the start: centroid of the deviation, peak depth, and the radius that gives the volume
    near = grown(own, around.reach_px) & patch.used
    weight = np.maximum(around.sign * (patch.residual_m[near] - around.offset_m), 0.0)
    v, u = np.nonzero(near)
    total = max(float(weight.sum()), 1e-12)
    radius = float(np.sqrt(total * around.surface_area_m2 / (np.pi * around.peak_m)))
    u0, v0 = float(weight @ u) / total, float(weight @ v) / total
    fit = fit_hole(patch, u0, v0, radius, around.sign * around.peak_m, around.offset_m)
    h, w = own.shape
    reach = np.pad(grown(own, around.reach_px + 1), 1)
    at = np.clip(np.round([fit.v_px + 1, fit.u_px + 1]), 0, [h + 1, w + 1]).astype(int)
    if not (fit.converged and reach[at[0], at[1]]):
        return None, "the model of a blurred hole does not fit"
    if abs(fit.depth_m) > config.linear_depth_mm * MM:
        return None, too_deep
    disc = blurred_disc((h, w), fit.u_px, fit.v_px, fit.radius_m, patch.metric_m2, 1)
    if float(disc[invalid].sum()) > config.largest_invalid * float(disc.sum()):
        return None, "part of the hole has no range"
    variance = float(fit.covariance[2, 2])
    # a singular fit can leave a negative variance by rounding
    error = math.sqrt(variance) / fit.radius_m if variance > 0 else math.inf
    if not error < config.largest_relative_error:
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
    area = inside.sum() / CONTOUR_ZOOM**2 * around.surface_area_m2
    return replace(
        measured,
        **around.placed(measured, u, v),
        model_diameter_m=2.0 * float(np.sqrt(area / np.pi)),
        model_depth_m=np.nan if hollow.sum() > around.own.sum() else around.sign * around.peak_m,
        model_note=doubt + "; from the contour at half depth, without standard errors",
    )
