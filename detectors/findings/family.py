"""The size of a damage by a family of shapes, averaged by their evidence.

Each shape of `detectors.findings.shapes` is fitted to the same pixels. A shape's weight is its
prior times exp(-BIC / 2), with the Bayesian information criterion n ln(chi^2 / n) + p ln n of n
independent pixels and p parameters (Burnham and Anderson 2002, 6.4). Of an averaged size, the
variance is the mean variance within the shapes plus the variance between them: where the blur hides
the shape, the stated error contains that nobody can tell a drilled hole from a dent.

What no shape explains adds to a shape's variance as an error that all n pixels of the damage share:
if the residuals' variance is 1 + e times the noise's, the part e repeats itself from pixel to
pixel, so that it does not average out and the variance of a size is raised by 1 + n e / (1 + e)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from detectors.findings.hole_model import HoleFit, fit_hole
from detectors.findings.hole_patch import HolePatch
from detectors.findings.shapes import Shape

PRIOR: dict[Shape, float] = {"disc": 0.7, "cap": 0.15, "bowl": 0.15, "slot": 0.1}
"""Prior weights: more damage is drilled or punched than pressed. They decide only where the blur
hides the shape."""
PARAMETERS: dict[Shape, int] = {"disc": 5, "cap": 5, "bowl": 5, "slot": 7}
"""Parameters of each shape in the information criterion."""
LEAST_WEIGHT = 1e-9
"""Weight beside the best shape's below which a shape changes no digit of an average."""
WIDER: dict[Shape, float] = {"disc": 1.0, "cap": 1.25, "bowl": 1.6, "slot": 1.0}
"""Mouth of each shape, in mouths of a disc with the same volume and deepest residual."""
BLURS = (
    (1.0, False, 0.0),
    (1.5, False, 4.0),
    (1.0, True, 2.0),
    (1.4, True, 4.0),
    (0.7, True, 2.0),
    (0.5, False, 9.0),
    (0.25, False, 9.0),
)
"""Blurs that are tried for a recording, whose own is known by its noise alone: side over that of
the noise, whether it is soft, and penalty in the information criterion. Rounded noise looks sharper
than it is; a camera's maker may smooth the noise more than the scene."""
FLOORS = (0.6, 0.36)
"""Brightness of a hole's floor over that of the face, which are tried beside 1 where the camera's
filter weighs pixels by their light. A floor is lit through the mouth, by an emitter beside the
camera, and farther away; it weighs less, and the mouth looks smaller than it is."""
MOST_OPEN = 0.3  # largest relative error of a radius that counts as measured
RADIUS_ERROR_PX = 0.05
"""Error of the model's radius on simulated clouds, in pixels."""
LENS_ERROR_PX2 = 0.18
"""Error of the radius by that of the lens' blur, times the radius, in pixels: a disc of radius r
and a blur of deviation s look like one of radius root(r^2 + 4 s^2), and s = 0.45 is known to 0.1.
"""
DIAMETER_ERROR: dict[Shape, float] = {"disc": 0.02, "cap": 0.035, "bowl": 0.035, "slot": 0.02}
"""Error of the model's diameter on simulated clouds, as a share of it: light between the slopes of
a dent changes its profile."""
DEPTH_ERROR = 0.08
"""Error of the model's depth on simulated clouds, as a share of it: light between floor, slopes and
walls lengthens its way."""


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


@dataclass(frozen=True)
class ShapeFit:
    """A fit that has converged."""

    fit: HoleFit
    patch: HolePatch
    """The pixels, and the blur of this fit."""
    loss: float = 0.0
    """Penalty of its blur in the information criterion."""

    @property
    def criterion(self) -> float:
        """Bayesian information criterion; the variance of the residuals is unknown."""
        fit = self.fit
        independent = _independent(fit.shape, fit.independent)
        per_pixel = max(fit.chi_square, 1e-12) / independent
        return independent * math.log(per_pixel) + _penalty(fit.shape, independent, self.loss)

    @property
    def raised(self) -> float:
        """Factor by which what the shape does not explain raises the variance of sizes."""
        fit = self.fit
        per_pixel = fit.chi_square / max(fit.independent, 1.0)
        excess = max(per_pixel - 1.0, 0.0)
        pixel_m2 = math.sqrt(float(np.linalg.det(self.patch.metric_m2)))
        pixels = math.pi * fit.radius_m**2 * math.exp(fit.stretch) / pixel_m2
        inside = min(pixels / math.prod(self.patch.noise_px), fit.independent)
        return 1.0 + inside * excess / (1.0 + excess)

    @property
    def diameter_variance_m2(self) -> float:
        """Variance of the diameter."""
        fit = self.fit
        diameter_m = _diameter_m(fit)
        by_stretch = 0.5 * diameter_m if fit.shape == "slot" else 0.0
        slopes = np.array([diameter_m / fit.radius_m, by_stretch])
        fitted_m2 = float(slopes @ fit.covariance[np.ix_([2, 6], [2, 6])] @ slopes)
        own_m2 = (DIAMETER_ERROR[fit.shape] * diameter_m) ** 2
        return self.raised * fitted_m2 + 4.0 * self.edge_variance_m2 + own_m2

    @property
    def slot_errors(self) -> tuple[float, float, float]:
        """Standard errors of a slot's length (m, twice the radius times the stretch), width (m)
        and angle (rad)."""
        fit = self.fit
        width_m = 2.0 * fit.radius_m
        length_m = width_m * math.exp(fit.stretch)
        slopes = np.array([[length_m / fit.radius_m, length_m], [2.0, 0.0]])
        fitted_m2 = slopes @ fit.covariance[np.ix_([2, 6], [2, 6])] @ slopes.T
        shares_m2 = (DIAMETER_ERROR["slot"] * np.array([length_m, width_m])) ** 2
        edges_m2 = 4.0 * self.edge_variance_m2
        sides_m2 = self.raised * np.diag(fitted_m2) + edges_m2 + shares_m2
        length_se_m, width_se_m = np.sqrt(sides_m2).tolist()
        return length_se_m, width_se_m, math.sqrt(self.raised * fit.covariance[7, 7])

    @property
    def edge_variance_m2(self) -> float:
        """Variance of the place of the mouth's edge by what the model leaves out of the blur."""
        pixel_m2 = float(np.trace(self.patch.metric_m2)) / 2.0
        lens_m = LENS_ERROR_PX2 * pixel_m2 / self.fit.radius_m
        return RADIUS_ERROR_PX**2 * pixel_m2 + lens_m**2

    @property
    def depth_variance_m2(self) -> float:
        """Variance of the depth along the optical axis. An error of the model's radius moves the
        depth of a hole that the blur hides, whose volume alone is known."""
        fit = self.fit
        fitted_m2 = self.raised * float(fit.covariance[3, 3])
        per_radius = float(fit.covariance[2, 3] / fit.covariance[2, 2])
        own_m2 = (DIAMETER_ERROR[fit.shape] * fit.radius_m) ** 2
        by_radius_m2 = per_radius**2 * (self.edge_variance_m2 + own_m2)
        return fitted_m2 + by_radius_m2 + (DEPTH_ERROR * fit.depth_m) ** 2


def _independent(shape: Shape, independent: float) -> float:
    """Return the number of independent pixels, at least one more than the shape's parameters."""
    return max(independent, PARAMETERS[shape] + 1.0)


def _penalty(shape: Shape, independent: float, loss: float) -> float:
    """Return what the information criterion adds for a shape's parameters and for its blur."""
    return PARAMETERS[shape] * math.log(independent) + loss


def _largest_chi_square(
    candidates: Sequence[ShapeFit], patch: HolePatch, shape: Shape, loss: float
) -> float:
    """Return the chi square beyond which a fit of a shape would weigh less than `LEAST_WEIGHT` of
    the best candidate; infinite without candidates."""
    if not candidates:
        return math.inf
    best = min(candidates, key=lambda candidate: candidate.criterion)
    gap = 2.0 * math.log(PRIOR[shape] / (PRIOR[best.fit.shape] * LEAST_WEIGHT))
    independent = _independent(shape, np.count_nonzero(patch.used) / math.prod(patch.noise_px))
    log_ratio = (best.criterion + gap - _penalty(shape, independent, loss)) / independent
    return independent * math.exp(log_ratio)


def sized(
    patch: HolePatch,
    start: Start,
    shapes: Sequence[Shape],
    blur_choices: Sequence[tuple[float, bool, float]],
) -> Size | None:
    """Fit the shapes and average them; None if no fit has converged. ``blur_choices``: of `BLURS`,
    those to try."""
    blur_u, blur_v = patch.blur_px
    blurs = []
    for ratio, soft, loss in blur_choices:
        blur_px = (max(ratio * blur_u, 1.0), max(ratio * blur_v, 1.0))
        blurs.append((replace(patch, blur_px=blur_px, soft=soft), loss))
    is_blur_known = len(blur_choices) == 1
    candidates: list[ShapeFit] = []
    for shape in shapes:
        radius_m = start.radius_m * WIDER[shape]
        if shape == "slot":
            radius_m *= math.exp(-0.5 * start.stretch)
        first = replace(start, radius_m=radius_m)
        for blurred, loss in blurs:
            enough = _largest_chi_square(candidates, blurred, shape, loss)
            fit = _fit(blurred, first, shape, enough)
            is_possible = is_blur_known or _is_possible(fit, blurred)
            if fit.converged and _is_determined(fit) and is_possible:
                candidates.append(ShapeFit(fit, blurred, loss))
                first = _start_after(fit)
        if shape == "disc" and candidates and patch.brightness > 0.0:
            candidates += _with_dim_floors(min(candidates, key=lambda c: c.criterion))
    return averaged(candidates) if candidates else None


def _with_dim_floors(disc: ShapeFit) -> list[ShapeFit]:
    """Fit a disc again with floors less bright than the face (`FLOORS`)."""
    candidates = []
    if disc.fit.depth_m > 0:
        for brightness in FLOORS:
            patch = replace(disc.patch, brightness=brightness)
            fit = _fit(patch, _start_after(disc.fit), "disc", math.inf)
            if fit.converged and _is_determined(fit):
                candidates.append(ShapeFit(fit, patch, disc.loss))
    return candidates


def _is_determined(fit: HoleFit) -> bool:
    """Return whether radius and depth are known, so that errors to first order mean something."""
    radius_m2 = fit.covariance[2, 2]
    depth_m2 = fit.covariance[3, 3]
    radius_is_known = 0.0 < radius_m2 < (MOST_OPEN * fit.radius_m) ** 2
    return bool(radius_is_known and depth_m2 < fit.depth_m**2)


def _is_possible(fit: HoleFit, patch: HolePatch) -> bool:
    """Return whether a solid has the fit's sizes: no cap of a sphere is deeper than its rim's
    radius, and no sheet is pressed to a smooth hollow that is deeper than a half ball.

    It is asked where the blur is not known: through a wrong one, the flanks of a drilled hole look
    like those of a cap many radii deep, which then explains it better than a disc. The limit has
    room for two of the model's own errors of a depth."""
    if fit.shape not in ("cap", "bowl"):
        return True
    cosine = float(patch.sights[:, 7] @ patch.sights[:, 0])
    normal_depth_m = abs(fit.depth_m) * cosine
    return normal_depth_m <= (1.0 + 2.0 * DEPTH_ERROR) * fit.radius_m


def _fit(patch: HolePatch, start: Start, shape: Shape, largest_chi_square: float) -> HoleFit:
    """Fit one shape, unless it can hardly explain the pixels to this chi square."""
    return fit_hole(
        patch,
        start.u_px,
        start.v_px,
        start.radius_m,
        start.depth_m,
        start.offset_m,
        shape=shape,
        stretch=start.stretch,
        angle_rad=start.angle_rad,
        largest_chi_square=largest_chi_square,
    )


def _start_after(fit: HoleFit) -> Start:
    """Return a fit's numbers as start values: another blur changes them little."""
    return Start(
        u_px=fit.u_px,
        v_px=fit.v_px,
        radius_m=fit.radius_m,
        depth_m=fit.depth_m,
        offset_m=fit.offset_m,
        stretch=fit.stretch,
        angle_rad=fit.angle_rad,
    )


def averaged(candidates: Sequence[ShapeFit]) -> Size:
    """Return the average of fits to the same pixels."""
    criteria = np.array([candidate.criterion for candidate in candidates])
    priors = np.array([PRIOR[candidate.fit.shape] for candidate in candidates])
    weights = priors * np.exp(-0.5 * (criteria - criteria.min()))
    weights = weights / weights.sum()
    diameters_m = np.array([_diameter_m(candidate.fit) for candidate in candidates])
    diameter_m2 = np.array([candidate.diameter_variance_m2 for candidate in candidates])
    depths_m = np.array([candidate.fit.depth_m for candidate in candidates])
    depth_m2 = np.array([candidate.depth_variance_m2 for candidate in candidates])
    diameter_m, diameter_se_m = mixture(weights, diameters_m, diameter_m2)
    depth_m, depth_se_m = mixture(weights, depths_m, depth_m2)
    by_shape: dict[Shape, float] = {}
    for candidate, weight in zip(candidates, weights.tolist(), strict=True):
        shape = candidate.fit.shape
        by_shape[shape] = by_shape.get(shape, 0.0) + weight
    best = candidates[int(weights.argmax())]
    return Size(
        best=best.fit,
        patch=best.patch,
        weights=by_shape,
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


def _diameter_m(fit: HoleFit) -> float:
    """Return the diameter of the mouth; of a slot, that of the circle with its area."""
    diameter_m = 2.0 * fit.radius_m
    if fit.shape == "slot":
        return diameter_m * math.sqrt(4.0 / math.pi * math.exp(fit.stretch))
    return diameter_m
