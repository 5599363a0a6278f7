"""The shape of a hole in an averaged cloud: a flat floor, or a bowl."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from harness.records.examples import ExampleCloud, HoleInView

# valid pixels inside the outline to distinguish two shapes; with fewer, one ring is the whole hole
FEWEST_PIXELS = 12
FEWEST_VALID = (
    0.5  # least share of valid pixels inside the outline: fewer may show only one side of the hole
)
# a shape fits clearly better if its rms misfit is at most this share of the other's (fixed
# beforehand)
CLEARLY = 0.8


@dataclass(frozen=True)
class HoleShape:
    """Root mean square misfits in mm of two shapes, scaled in depth to the residual inside a
    hole's outline: a flat floor, and a hemisphere on the same rim. ``true_*``: the same for the
    true geometry, as a control."""

    hole: str
    pixels: int
    cylinder_rms_mm: float
    bowl_rms_mm: float
    true_cylinder_rms_mm: float
    true_bowl_rms_mm: float

    @property
    def looks(self) -> Literal["bowl", "cylinder", "neither"]:
        """The shape that fits clearly better (`CLEARLY`)."""
        if self.bowl_rms_mm <= CLEARLY * self.cylinder_rms_mm:
            return "bowl"
        return "cylinder" if self.cylinder_rms_mm <= CLEARLY * self.bowl_rms_mm else "neither"


def relative_radius(cloud: ExampleCloud, hole: HoleInView) -> np.ndarray:
    """Return the distance (h, w) from the hole's centre over its radius, in the image plane. Not
    modelled: foreshortening (a tilt by t shortens one direction by cos t: 1.5 % at 10 degrees)."""
    v, u = np.indices(cloud.residual_mm.shape)
    return np.hypot(u - hole.u_px, v - hole.v_px) / hole.radius_px


def true_residual_mm(cloud: ExampleCloud, hole: HoleInView) -> np.ndarray:
    """Return true z minus the undamaged face's (h, w). The face is continued over the hole by a
    quadratic through the board's pixels at 1.2 to 3 radii (at least 4 pixels wide) that lie in no
    other hole. NaN everywhere if these are too few for six coefficients."""
    v, u = np.indices(cloud.residual_mm.shape)
    outer = max(3 * hole.radius_px, 1.2 * hole.radius_px + 4)
    face = (
        cloud.inside
        & np.isfinite(cloud.z_truth_mm)
        & (np.hypot(u - hole.u_px, v - hole.v_px) <= outer)
    )
    for known in cloud.truth:
        face &= relative_radius(cloud, known) > 1.2
    if face.sum() < 12:
        return np.full(cloud.residual_mm.shape, np.nan)
    x = (u - hole.u_px) / outer
    y = (v - hole.v_px) / outer
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    coefficients, *_ = np.linalg.lstsq(terms[face], cloud.z_truth_mm[face], rcond=None)
    return cloud.z_truth_mm - terms @ coefficients


def hole_shape(cloud: ExampleCloud, hole: HoleInView) -> HoleShape | None:
    """Fit both shapes to the measured residual inside the outline; None if too few of its pixels
    are valid."""
    radius = relative_radius(cloud, hole)
    outline = radius < 1
    valid = outline & np.isfinite(cloud.residual_mm)
    if valid.sum() < FEWEST_PIXELS or valid.sum() < FEWEST_VALID * outline.sum():
        return None
    measured = cloud.residual_mm[valid]
    rho = radius[valid]
    true_depth = true_residual_mm(cloud, hole)
    known = outline & np.isfinite(true_depth)
    flat = _misfit(measured, np.ones_like(rho))
    round_ = _misfit(measured, bowl(rho))
    true_flat = _misfit(true_depth[known], np.ones(known.sum()))
    true_round = _misfit(true_depth[known], bowl(radius[known]))
    return HoleShape(hole.hole, int(valid.sum()), flat, round_, true_flat, true_round)


def hole_shapes(cloud: ExampleCloud) -> list[HoleShape]:
    """Return the shapes of all holes that are large and valid enough, smallest first."""
    shapes = (
        hole_shape(cloud, hole) for hole in sorted(cloud.truth, key=lambda hole: hole.diameter_mm)
    )
    return [shape for shape in shapes if shape is not None]


def bowl(rho: np.ndarray) -> np.ndarray:
    """Return a hemisphere's depth over its greatest depth, at ``rho`` radii from the axis; 0
    outside the rim."""
    return np.sqrt(np.clip(1 - np.asarray(rho, float) ** 2, 0, None))


def _misfit(depth: np.ndarray, shape: np.ndarray) -> float:
    """Return the root mean square of depth minus the least-squares multiple of ``shape``; NaN
    without data."""
    if depth.size == 0 or not shape.any():
        return float("nan")
    return float(np.sqrt(np.mean((depth - (depth @ shape / (shape @ shape)) * shape) ** 2)))
