"""The shape that a hole shows in an averaged cloud: nearer to a flat-bottomed cylinder or to a spherical bowl?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

RINGS = (0.25, 0.5, 0.75)
"""Fractions of the hole's radius at which the depth reached is told; each ring is +-0.125 wide."""
FEWEST_PIXELS = 12
"""Valid pixels inside the outline below which two shapes cannot be told apart: one ring of pixels is the whole hole."""
FEWEST_VALID = 0.5
"""Share of valid pixels inside the outline below which those left speak of one side of the hole only."""
CLEARLY = 0.8
"""A shape fits clearly better when its rms misfit is at most this share of the other's (fixed beforehand)."""


@dataclass(frozen=True)
class HoleInView:
    """The truth of one round damage on the cloud's pixel grid.

    ``u_px``, ``v_px``: column and row of its centre in the cloud's arrays (0, 0 = centre of the first pixel);
    ``radius_px``: radius of its outline there. ``depth_mm``: depth below the face, NaN or infinite if it has no floor.
    """

    hole: str
    u_px: float
    v_px: float
    radius_px: float
    diameter_mm: float
    depth_mm: float


class AveragedCloud(Protocol):
    """The part of an example that the shape needs: residual and truth on one pixel grid (h, w)."""

    @property
    def residual_mm(self) -> np.ndarray: ...
    @property
    def z_truth_mm(self) -> np.ndarray: ...
    @property
    def inside(self) -> np.ndarray: ...
    @property
    def truth(self) -> Sequence[HoleInView]: ...


@dataclass(frozen=True)
class HoleShape:
    """One-parameter fits to the depth inside a hole's outline, mm.

    ``cylinder_rms_mm``: misfit of a flat floor at ``cylinder_depth_mm``. ``bowl_rms_mm``: misfit of the hemisphere on
    the same rim, its depth scaled to ``bowl_depth_mm``. ``seen_rms_mm``: misfit of the true hole as it is seen from the
    camera's place (walls that an oblique view shows included), its depth scaled; NaN where the truth has gaps.
    ``true_*``: the first two misfits for the true geometry at the same pixels, a control that no camera has touched.
    ``reached``: median depth in the `RINGS` over the true floor's.
    """

    hole: str
    diameter_mm: float
    pixels: int
    cylinder_depth_mm: float
    cylinder_rms_mm: float
    bowl_depth_mm: float
    bowl_rms_mm: float
    seen_rms_mm: float
    true_depth_mm: float
    true_cylinder_rms_mm: float
    true_bowl_rms_mm: float
    reached: tuple[float, ...]

    @property
    def looks(self) -> Literal["bowl", "cylinder", "neither"]:
        """The shape that fits clearly better (`CLEARLY`)."""
        if self.bowl_rms_mm <= CLEARLY * self.cylinder_rms_mm:
            return "bowl"
        return "cylinder" if self.cylinder_rms_mm <= CLEARLY * self.bowl_rms_mm else "neither"


def relative_radius(cloud: AveragedCloud, hole: HoleInView) -> np.ndarray:
    """(h, w): distance from the hole's centre over its radius, in the image plane.

    Not modelled: foreshortening; a tilt of the board by t squeezes one direction by cos t (1.5 % at 10 degrees).
    """
    v, u = np.indices(cloud.residual_mm.shape)
    return np.hypot(u - hole.u_px, v - hole.v_px) / hole.radius_px


def true_residual_mm(cloud: AveragedCloud, hole: HoleInView) -> np.ndarray:
    """(h, w): true z minus the undamaged face's, continued over the hole by a quadratic through its surroundings.

    The surroundings are the board's pixels from 1.2 to 3 radii (at least 4 pixels wide) that lie in no other hole. NaN
    everywhere where there are too few of them for six coefficients.
    """
    v, u = np.indices(cloud.residual_mm.shape)
    radius = np.hypot(u - hole.u_px, v - hole.v_px)
    outer = max(3 * hole.radius_px, 1.2 * hole.radius_px + 4)
    face = cloud.inside & np.isfinite(cloud.z_truth_mm) & (radius <= outer)
    for other in cloud.truth:
        face &= np.hypot(u - other.u_px, v - other.v_px) > 1.2 * other.radius_px
    if face.sum() < 12:
        return np.full(cloud.residual_mm.shape, np.nan)
    x, y = (u - hole.u_px) / outer, (v - hole.v_px) / outer
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    coefficients, *_ = np.linalg.lstsq(terms[face], cloud.z_truth_mm[face], rcond=None)
    return cloud.z_truth_mm - terms @ coefficients


def hole_shape(cloud: AveragedCloud, hole: HoleInView) -> HoleShape | None:
    """Fit both shapes to the measured residual inside the outline; None where too few of its pixels are valid."""
    radius = relative_radius(cloud, hole)
    outline = radius < 1
    valid = outline & np.isfinite(cloud.residual_mm)
    if valid.sum() < FEWEST_PIXELS or valid.sum() < FEWEST_VALID * outline.sum():
        return None
    measured, rho = cloud.residual_mm[valid], radius[valid]
    true_depth = true_residual_mm(cloud, hole)
    floor = true_depth[(radius < 0.5) & np.isfinite(true_depth)]
    true_floor = float(np.median(floor)) if floor.size else float("nan")
    known = outline & np.isfinite(true_depth)
    cylinder_depth, cylinder_rms = _fit(measured, np.ones_like(rho))
    bowl_depth, bowl_rms = _fit(measured, bowl(rho))
    return HoleShape(
        hole=hole.hole,
        diameter_mm=hole.diameter_mm,
        pixels=int(valid.sum()),
        cylinder_depth_mm=cylinder_depth,
        cylinder_rms_mm=cylinder_rms,
        bowl_depth_mm=bowl_depth,
        bowl_rms_mm=bowl_rms,
        seen_rms_mm=_fit(measured, true_depth[valid])[1],
        true_depth_mm=true_floor,
        true_cylinder_rms_mm=_fit(true_depth[known], np.ones(known.sum()))[1],
        true_bowl_rms_mm=_fit(true_depth[known], bowl(radius[known]))[1],
        reached=tuple(_median_in_ring(measured, rho, ring) / true_floor for ring in RINGS),
    )


def hole_shapes(cloud: AveragedCloud) -> list[HoleShape]:
    """The shapes of all holes large and valid enough, smallest first."""
    shapes = (hole_shape(cloud, hole) for hole in sorted(cloud.truth, key=lambda hole: hole.diameter_mm))
    return [shape for shape in shapes if shape is not None]


def bowl(rho: np.ndarray) -> np.ndarray:
    """Depth of a hemisphere on the rim over its greatest depth, at ``rho`` radii from the axis; 0 outside the rim."""
    return np.sqrt(np.clip(1 - np.asarray(rho, float) ** 2, 0, None))


def _fit(depth: np.ndarray, shape: np.ndarray) -> tuple[float, float]:
    """Least-squares factor of ``shape`` and the rms misfit; NaN without data."""
    if depth.size == 0 or not np.isfinite(shape).all() or not shape.any():
        return float("nan"), float("nan")
    factor = float(depth @ shape / (shape @ shape))
    return factor, float(np.sqrt(np.mean((depth - factor * shape) ** 2)))


def _median_in_ring(depth: np.ndarray, rho: np.ndarray, ring: float) -> float:
    chosen = depth[np.abs(rho - ring) <= 0.125]
    return float(np.median(chosen)) if chosen.size else float("nan")
