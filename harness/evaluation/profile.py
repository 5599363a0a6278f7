"""The shape that a hole shows in an averaged cloud, and the share of its wall that no view can see.

Walls are pure geometry: a straight bore with a circular mouth of radius r in the plane z = 0. A wall point at depth t
and azimuth e (a unit vector) looks at a lens at height H above the mouth and L beside its centre through the point of
the mouth at (1 - s) r e + s L with s = t / (t + H). That lies inside where s <= 2 r (r - e . L) / |L - r e|^2, so each
azimuth is seen from the rim down to one depth, and the shares need an average over azimuths only."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from harness.vocabulary.geometry import MM

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
    """The truth of one round damage on the cloud's pixel grid. ``u_px``, ``v_px``: column and row of its centre in the
    cloud's arrays (0, 0 = centre of the first pixel); ``radius_px``: radius of its outline there. ``depth_mm``: depth
    below the face, NaN or infinite if it has no floor."""

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
    """One-parameter fits to the depth inside a hole's outline, mm: a flat floor, and the hemisphere on the same rim
    scaled; ``seen_rms_mm``: misfit of the true hole as seen, scaled, NaN where the truth has gaps. ``true_*``: the same
    of the true geometry, a control. ``reached``: median depth in the `RINGS` over the true floor's."""

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
    """(h, w): distance from the hole's centre over its radius, in the image plane. Not modelled: foreshortening; a tilt
    of the board by t squeezes one direction by cos t (1.5 % at 10 degrees)."""
    v, u = np.indices(cloud.residual_mm.shape)
    return np.hypot(u - hole.u_px, v - hole.v_px) / hole.radius_px


def true_residual_mm(cloud: AveragedCloud, hole: HoleInView) -> np.ndarray:
    """(h, w): true z minus the undamaged face's, continued over the hole by a quadratic through its surroundings. The
    surroundings are the board's pixels from 1.2 to 3 radii (at least 4 pixels wide) that lie in no other hole. NaN
    everywhere where there are too few of them for six coefficients."""
    v, u = np.indices(cloud.residual_mm.shape)
    outer = max(3 * hole.radius_px, 1.2 * hole.radius_px + 4)
    face = cloud.inside & np.isfinite(cloud.z_truth_mm) & (np.hypot(u - hole.u_px, v - hole.v_px) <= outer)
    for other in cloud.truth:
        face &= relative_radius(cloud, other) > 1.2
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
    true_floor = _median(true_depth[(radius < 0.5) & np.isfinite(true_depth)])
    known = outline & np.isfinite(true_depth)
    return HoleShape(
        hole.hole,
        hole.diameter_mm,
        int(valid.sum()),
        *_fit(measured, np.ones_like(rho)),
        *_fit(measured, bowl(rho)),
        seen_rms_mm=_fit(measured, true_depth[valid])[1],
        true_depth_mm=true_floor,
        true_cylinder_rms_mm=_fit(true_depth[known], np.ones(known.sum()))[1],
        true_bowl_rms_mm=_fit(true_depth[known], bowl(radius[known]))[1],
        reached=tuple(_median(measured[np.abs(rho - ring) <= 0.125]) / true_floor for ring in RINGS),
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


def _median(depth: np.ndarray) -> float:
    return float(np.median(depth)) if depth.size else float("nan")


AZIMUTHS = 1440
"""Directions around the wall; the mean over them is off by less than 1e-5 of the wall's area."""


def shadowed_shares(
    lens_board_m: np.ndarray,
    emitter_board_m: np.ndarray,
    centre_board_m: np.ndarray,
    diameter_m: float,
    depth_m: float,
    counts: Iterable[int],
) -> list[dict[str, float]]:
    """Make one row for each of ``counts``, which takes the first so many views. ``lens_board_m``, ``emitter_board_m``
    (n, 3): board frame (z out of the face). ``unseen_share``: of the wall's area that no lens sees through the mouth;
    ``shadowed_share``: unseen or unlit in every view. Not modelled: the size of lens and emitter, the pixel's
    footprint, light by another wall, a curved face. ValueError for a place not before the face, or too few views."""
    lenses, emitters = (np.atleast_2d(np.asarray(places, float)) for places in (lens_board_m, emitter_board_m))
    counts = list(counts)
    if not all(1 <= count <= len(lenses) for count in counts):
        raise ValueError(f"counts {counts} of {len(lenses)} views")
    seen = _seen_depths(lenses - centre_board_m, diameter_m / 2)
    lit = _seen_depths(emitters - centre_board_m, diameter_m / 2)
    both = np.minimum(seen, lit)
    return [
        {
            "views": count,
            "true_diameter_mm": diameter_m / MM,
            "depth_mm": depth_m / MM,
            "unseen_share": _missing(seen[:count], depth_m),
            "shadowed_share": _missing(both[:count], depth_m),
        }
        for count in counts
    ]


def _seen_depths(places_m: np.ndarray, radius_m: float) -> np.ndarray:
    """(n, AZIMUTHS): down to which depth each place, relative to the mouth's centre, sees the wall; 0 where not."""
    beside, height = places_m[:, None, :2], places_m[:, None, 2]
    if not (height > 0).all():
        raise ValueError("a lens or an emitter does not stand before the face")
    turn = (np.arange(AZIMUTHS) + 0.5) * 2 * np.pi / AZIMUTHS
    out = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    towards = (beside * out).sum(axis=-1)
    apart2 = ((beside - radius_m * out) ** 2).sum(axis=-1)
    share = np.maximum(2 * radius_m * (radius_m - towards), 0.0) / np.maximum(apart2, np.finfo(float).tiny)
    with np.errstate(over="ignore"):
        return np.where(share < 1, height * share / np.maximum(1 - share, np.finfo(float).tiny), np.inf)


def _missing(depths_m: np.ndarray, depth_m: float) -> float:
    return float(1 - np.minimum(depths_m.max(axis=0) / depth_m, 1.0).mean())
