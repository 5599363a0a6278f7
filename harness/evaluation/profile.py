"""The shape of a hole in an averaged cloud: a flat floor, or a bowl."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from harness.records.examples import ExampleCloud, HoleInView

# valid pixels inside the outline to distinguish two shapes; with fewer, one ring is the whole hole
FEWEST_PIXELS = 12
# least share of valid pixels inside the outline: fewer may show only one side of the hole
FEWEST_VALID = 0.5
# a shape fits clearly better if its rms misfit is at most this share of the other's (fixed
# beforehand)
CLEARLY = 0.8


@dataclass(frozen=True)
class HoleShape:
    """Root mean square misfits of two shapes, scaled in depth to the residual inside a hole's
    outline: a flat floor, and a hemisphere on the same rim."""

    hole: str
    """Name of the damage."""
    pixels: int
    """Number of valid pixels inside its outline."""
    cylinder_rms_mm: float
    """Misfit of the flat floor."""
    bowl_rms_mm: float
    """Misfit of the hemisphere."""
    true_cylinder_rms_mm: float
    """Misfit of the flat floor to the true geometry, as a control."""
    true_bowl_rms_mm: float
    """Misfit of the hemisphere to the true geometry."""

    @property
    def looks(self) -> Literal["bowl", "cylinder", "neither"]:
        """The shape that fits clearly better (`CLEARLY`)."""
        if self.bowl_rms_mm <= CLEARLY * self.cylinder_rms_mm:
            return "bowl"
        return "cylinder" if self.cylinder_rms_mm <= CLEARLY * self.bowl_rms_mm else "neither"


def relative_radius(cloud: ExampleCloud, hole: HoleInView) -> np.ndarray:
    """Return the distance (h, w) from the hole's centre over its radius, in the image plane. Not
    modelled: foreshortening (a tilt by t shortens one direction by cos t: 1.5 % at 10 degrees)."""
    return _distance_px(cloud, hole) / hole.radius_px


def _distance_px(cloud: ExampleCloud, hole: HoleInView) -> np.ndarray:
    """Return the distance (h, w) from the hole's centre in pixels."""
    v, u = np.indices(cloud.residual_mm.shape)
    return np.asarray(np.hypot(u - hole.u_px, v - hole.v_px))


def true_residual_mm(cloud: ExampleCloud, hole: HoleInView) -> np.ndarray:
    """Return true z minus the undamaged face's (h, w). The face is continued over the hole by a
    quadratic through the board's pixels at 1.2 to 3 radii (at least 4 pixels wide) that lie in no
    other hole. NaN everywhere if these are too few for six coefficients."""
    outer_px = max(3 * hole.radius_px, 1.2 * hole.radius_px + 4)
    face = cloud.inside & np.isfinite(cloud.z_truth_mm) & (_distance_px(cloud, hole) <= outer_px)
    for damage in cloud.truth:
        face &= relative_radius(cloud, damage) > 1.2
    if face.sum() < 12:
        return np.full(cloud.residual_mm.shape, np.nan)
    v, u = np.indices(cloud.residual_mm.shape)
    x = (u - hole.u_px) / outer_px
    y = (v - hole.v_px) / outer_px
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    coefficients, *_ = np.linalg.lstsq(terms[face], cloud.z_truth_mm[face], rcond=None)
    return np.asarray(cloud.z_truth_mm - terms @ coefficients)


def hole_shape(cloud: ExampleCloud, hole: HoleInView) -> HoleShape | None:
    """Fit both shapes to the measured residual inside the outline; None if too few of its pixels
    are valid."""
    radius = relative_radius(cloud, hole)
    outline = radius < 1
    valid = outline & np.isfinite(cloud.residual_mm)
    if valid.sum() < FEWEST_PIXELS or valid.sum() < FEWEST_VALID * outline.sum():
        return None
    measured_mm = cloud.residual_mm[valid]
    true_mm = true_residual_mm(cloud, hole)
    comparable = outline & np.isfinite(true_mm)
    return HoleShape(
        hole=hole.hole,
        pixels=int(valid.sum()),
        cylinder_rms_mm=_misfit(measured_mm, np.ones(valid.sum())),
        bowl_rms_mm=_misfit(measured_mm, bowl(radius[valid])),
        true_cylinder_rms_mm=_misfit(true_mm[comparable], np.ones(comparable.sum())),
        true_bowl_rms_mm=_misfit(true_mm[comparable], bowl(radius[comparable])),
    )


def hole_shapes(cloud: ExampleCloud) -> list[HoleShape]:
    """Return the shapes of all holes that are large and valid enough, smallest first."""
    shapes = []
    for hole in sorted(cloud.truth, key=lambda hole: hole.diameter_mm):
        shape = hole_shape(cloud, hole)
        if shape is not None:
            shapes.append(shape)
    return shapes


def bowl(rho: np.ndarray) -> np.ndarray:
    """Return a hemisphere's depth over its greatest depth, at ``rho`` radii from the axis; 0
    outside the rim."""
    return np.asarray(np.sqrt(np.clip(1 - np.asarray(rho, float) ** 2, 0, None)))


def _misfit(depth: np.ndarray, shape: np.ndarray) -> float:
    """Return the root mean square of depth minus the least-squares multiple of ``shape``; NaN
    without data."""
    if depth.size == 0 or not shape.any():
        return float("nan")
    scale = depth @ shape / (shape @ shape)
    return float(np.sqrt(np.mean((depth - scale * shape) ** 2)))
