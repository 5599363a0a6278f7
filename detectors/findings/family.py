"""The size of a damage by a family of shapes, averaged by their evidence.

Each shape of `detectors.findings.shapes` is fitted to the same pixels. A shape's weight is its prior
times exp(-BIC / 2), with the Bayesian information criterion n ln(chi^2 / n) + p ln n of n
independent pixels and p parameters (Burnham and Anderson 2002, 6.4). Of an averaged size, the
variance is the mean variance within the shapes plus the variance between them: where the blur hides
the shape, the stated error contains that nobody can tell a drilled hole from a dent.

What no shape explains adds to a shape's variance as an error that all n pixels of the damage share:
if the residuals' variance is 1 + e times the noise's, the part e repeats itself from pixel to pixel,
so that it does not average out and the variance of a size is raised by 1 + n e / (1 + e)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from detectors.findings.hole_model import HoleFit, HolePatch, fit_hole
from detectors.findings.shapes import Shape

PRIOR: dict[Shape, float] = {"disc": 0.6, "cap": 0.2, "bowl": 0.2, "slot": 0.2}
"""Prior weights: more damage is drilled or punched than pressed. They decide only where the blur
hides the shape."""
WIDER: dict[Shape, float] = {"disc": 1.0, "cap": 1.25, "bowl": 1.6, "slot": 1.0}
"""Mouth of each shape, in mouths of a disc with the same volume and deepest residual."""
LEAST_WEIGHT = 0.05  # a shape with less says nothing about the size
SHARPER_GAIN = 9.0
"""Gain in the information criterion that accepts another blur than the noise's."""


@dataclass(frozen=True)
class Start:
    """Start values of a fit."""

    u_px: float
    """Centre along columns."""
    v_px: float
    """Centre along rows."""
    radius_m: float
    """Radius of a disc with the damage's volume and depth."""
    depth_m: float
    """Along the optical axis."""
    offset_m: float
    """Residual of the surface around the damage."""
    stretch: float
    """Logarithm of length over width."""
    angle_rad: float
    """Angle of the length on the surface, from the direction of the rows."""


@dataclass(frozen=True)
class Size:
    """An averaged size."""

    best: HoleFit
    """The fit with the largest weight."""
    patch: HolePatch
    """The pixels, with the blur with which they fit best."""
    weights: dict[Shape, float]
    """Weight of each shape that was compared; their sum is 1."""
    diameter_m: float
    """Of the mouth; of a slot, of the circle with its area."""
    diameter_se_m: float
    depth_m: float
    """Along the optical axis."""
    depth_se_m: float

    @property
    def shape(self) -> Shape | None:
        """The shape, if its weight is at least a half."""
        return self.best.shape if self.weights[self.best.shape] >= 0.5 else None


def criterion(fit: HoleFit) -> float:
    """Return the Bayesian information criterion of a fit; the variance of its residuals is
    unknown."""
    parameters = 7 if fit.shape == "slot" else 5
    independent = max(fit.independent, parameters + 1.0)
    per_pixel = max(fit.chi_square, 1e-12) / independent
    return independent * math.log(per_pixel) + parameters * math.log(independent)


def sized(
    patch: HolePatch,
    start: Start,
    shapes: Sequence[Shape],
    sharper_px: Sequence[float],
) -> Size | None:
    """Fit the shapes and average them; None if no fit has converged. ``sharper_px``: further sides
    of the blur to try."""
    fits = _fits(patch, start, shapes)
    if not fits:
        return None
    best = min(fits, key=criterion)
    best_patch = patch
    least = criterion(best) - SHARPER_GAIN
    for side in sharper_px:
        sharper_patch = replace(patch, blur_px=(side, side), shared_px=patch.shared_px)
        sharper = _fit(sharper_patch, start, best.shape)
        if sharper.converged and criterion(sharper) < least:
            least = criterion(sharper)
            best_patch = sharper_patch
    if best_patch is not patch:
        fits = _fits(best_patch, start, shapes)
    return averaged(fits, best_patch) if fits else None


def _fits(patch: HolePatch, start: Start, shapes: Sequence[Shape]) -> list[HoleFit]:
    """Return the fits of shapes that have converged."""
    fits = [_fit(patch, start, shape) for shape in shapes]
    return [fit for fit in fits if fit.converged and fit.covariance[2, 2] > 0.0]


def _fit(patch: HolePatch, start: Start, shape: Shape) -> HoleFit:
    """Fit one shape."""
    return fit_hole(
        patch,
        start.u_px,
        start.v_px,
        start.radius_m * WIDER[shape] * math.exp(-0.5 * start.stretch * (shape == "slot")),
        start.depth_m,
        start.offset_m,
        shape=shape,
        stretch=start.stretch,
        angle_rad=start.angle_rad,
    )


def averaged(fits: Sequence[HoleFit], patch: HolePatch) -> Size:
    """Return the average of fits to the same pixels."""
    criteria = np.array([criterion(fit) for fit in fits])
    priors = np.array([PRIOR[fit.shape] for fit in fits])
    weights = priors * np.exp(-0.5 * (criteria - criteria.min()))
    weights = weights / weights.sum()
    weights = np.where(weights < LEAST_WEIGHT, 0.0, weights)
    weights = weights / weights.sum()
    raised = np.array([_raised(fit, patch) for fit in fits])
    diameters_m = np.array([_diameter_m(fit) for fit in fits])
    diameter_m2 = raised * [_diameter_variance_m2(fit) for fit in fits]
    depths_m = np.array([fit.depth_m for fit in fits])
    depth_m2 = raised * [fit.covariance[3, 3] for fit in fits]
    diameter_m, diameter_se_m = mixture(weights, diameters_m, diameter_m2)
    depth_m, depth_se_m = mixture(weights, depths_m, depth_m2)
    return Size(
        best=fits[int(weights.argmax())],
        patch=patch,
        weights={fit.shape: float(weight) for fit, weight in zip(fits, weights, strict=True)},
        diameter_m=diameter_m,
        diameter_se_m=diameter_se_m,
        depth_m=depth_m,
        depth_se_m=depth_se_m,
    )


def mixture(
    weights: np.ndarray,
    values: np.ndarray,
    variances: np.ndarray,
) -> tuple[float, float]:
    """Return mean and standard deviation of a mixture of estimates (k,) with weights (k,)."""
    mean = float(weights @ values)
    variance = float(weights @ (variances + (values - mean) ** 2))
    return mean, math.sqrt(max(variance, 0.0))


def _raised(fit: HoleFit, patch: HolePatch) -> float:
    """Return the factor by which what the shape does not explain raises the variance of sizes."""
    per_pixel = fit.chi_square / max(fit.independent, 1.0)
    excess = max(per_pixel - 1.0, 0.0)
    pixel_m2 = math.sqrt(float(np.linalg.det(patch.metric_m2)))
    pixels = math.pi * fit.radius_m**2 * math.exp(fit.stretch) / pixel_m2
    share = fit.independent / (np.count_nonzero(patch.used) + patch.left_out)
    return 1.0 + min(pixels * share, fit.independent) * excess / (1.0 + excess)


def _diameter_m(fit: HoleFit) -> float:
    """Return the diameter of the mouth; of a slot, that of the circle with its area."""
    diameter_m = 2.0 * fit.radius_m
    if fit.shape == "slot":
        return diameter_m * math.sqrt(4.0 / math.pi * math.exp(fit.stretch))
    return diameter_m


def _diameter_variance_m2(fit: HoleFit) -> float:
    """Return the variance of `_diameter_m`."""
    by_radius = _diameter_m(fit) / fit.radius_m
    by_stretch = 0.5 * _diameter_m(fit) if fit.shape == "slot" else 0.0
    slopes = np.array([by_radius, by_stretch])
    return float(slopes @ fit.covariance[np.ix_([2, 6], [2, 6])] @ slopes)
