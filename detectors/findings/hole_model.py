"""The model of a blurred hole, and its fit to the residuals around one detection.

The model is a round tube between a mouth in the surface and a flat floor
(`detectors.findings.drilled`), or another shape (`detectors.findings.shapes`), averaged over a
rectangle of pixels. The tube's length, as a share of the depth, is fitted too: the model's
``wall``.

The lens averages too, by a second rectangle. A filter may weigh pixels: a bilateral one gives deep
neighbours less weight, and one that sums phasors gives each pixel that of its light
(`HolePatch.half_m`, `HolePatch.brightness`).

A hole is five numbers: u, v (px), radius, depth along the optical axis (m), and wall (0 to 1).
`detectors.findings.pictures` draws holes, `detectors.findings.descent` descends to the best one,
and `fit_hole` states its errors. `detectors.findings.hole_model_reference` is the same
model and the same least squares, written plainly.

Not modelled: light between wall and floor, which makes holes of 33 mm look 4 % deeper; walls darker
than the floor; a floor that is not flat; what weights do to other shapes than holes."""

import math
from dataclasses import dataclass

import numpy as np

from detectors.findings.descent import LEAST_M, descend
from detectors.findings.hole_patch import WALL_PRIOR, HolePatch
from detectors.findings.products import correlated_products, products_of
from detectors.findings.shapes import SHAPES, Shape


@dataclass(frozen=True)
class HoleFit:
    """A fitted hole."""

    u_px: float
    """Centre of the mouth in the patch, along columns."""
    v_px: float
    """Centre of the mouth in the patch, along rows."""
    radius_m: float
    depth_m: float
    """Along the optical axis, positive behind the surface."""
    offset_m: float
    """Residual of the surface around the hole."""
    wall: float
    """Length of the tube over the depth, 0 to 1."""
    covariance: np.ndarray
    """(8, 8): of u, v, radius, depth, offset, wall, stretch and angle, in px, metres and radians;
    0 for those that the shape lacks. NaN if the fit has not converged."""
    converged: bool
    shape: Shape = "disc"
    stretch: float = 0.0
    """Logarithm of a slot's length over its width."""
    angle_rad: float = 0.0
    """Angle of a slot's length on the surface, from the direction of the rows."""
    chi_square: float = np.nan
    """Sum of squared residuals over the noise's variance, of independent pixels."""
    independent: float = np.nan
    """Number of independent pixels: one in each rectangle that shares noise."""

    @property
    def numbers(self) -> np.ndarray:
        """The damage (7,) as `pictures` draws it."""
        place_and_size = [self.u_px, self.v_px, self.radius_m, self.depth_m]
        return np.array([*place_and_size, self.wall, self.stretch, self.angle_rad])


def fit_hole(
    patch: HolePatch,
    u: float,
    v: float,
    radius_m: float,
    depth_m: float,
    offset_m: float,
    *,
    shape: Shape = "disc",
    stretch: float = 0.0,
    angle_rad: float = 0.0,
    largest_chi_square: float = math.inf,
) -> HoleFit:
    """Fit a damage of one shape to at least eight used pixels by least squares (Levenberg and
    Marquardt) from start values. Its covariance is that of `sandwich_covariance`. The descent ends,
    without having converged, where it can hardly come below ``largest_chi_square`` any more.

    The parameters are (u, v, ln radius, depth * radius^2, offset, x) with the wall sin^2(pi x / 2),
    which has `WALL_PRIOR`; of a slot, its stretch and angle instead of the wall. The fourth is the
    hole's volume. The blur preserves it, so that only the radius of a small hole is
    ill-determined."""
    volume = depth_m * radius_m**2
    x = WALL_PRIOR[0]
    sharing = math.prod(patch.noise_px)
    per_chi_square_m2 = max(patch.noise_m, LEAST_M) ** 2 * sharing
    hole, offset, derivatives, misfit, converged = descend(
        patch.residual_m[patch.used],
        np.flatnonzero(patch.used),
        patch.prior_weight,
        np.array([u, v, math.log(radius_m), volume, offset_m, x, stretch, angle_rad]),
        SHAPES.index(shape),
        patch.view,
        largest_chi_square * per_chi_square_m2,
    )
    square = float(misfit @ misfit)
    covariance = np.full((8, 8), np.nan)
    if converged:
        covariance = sandwich_covariance(patch, derivatives, square)
    u, v, radius, depth, wall, stretch, angle = hole.tolist()
    return HoleFit(
        u_px=u,
        v_px=v,
        radius_m=radius,
        depth_m=depth,
        offset_m=offset,
        wall=wall,
        covariance=covariance,
        converged=converged,
        shape=shape,
        stretch=stretch,
        angle_rad=angle,
        chi_square=square / per_chi_square_m2,
        independent=len(misfit) / sharing,
    )


def sandwich_covariance(
    patch: HolePatch,
    derivatives: np.ndarray,
    square_m2: float,
) -> np.ndarray:
    """Return the covariance (p, p) of (u, v, radius, depth, offset, wall ..) if the square filter
    correlates the noise; NaN if it is singular.

    With A = J' J + W it is A^-1 (s^2 J' C J + p^2 W) A^-1. W is the prior's square weight on the
    wall, p^2 its variance; E[misfit' misfit] = s^2 (n - trace(A^-1 J' C J)).

    Args:
        patch: the pixels, their noise and blur.
        derivatives: J' (p, n), of the used pixels; rows of 0 for parameters that are not fitted.
        square_m2: sum of their squared residuals."""
    count = len(derivatives)
    fitted = np.flatnonzero(derivatives.any(axis=1) | (np.arange(count) < 6))
    derivatives = derivatives[fitted]
    images = np.zeros((len(fitted), *patch.used.shape))
    images[:, patch.used] = derivatives
    blur_u, blur_v = patch.noise_px
    across = _nearest_odd(blur_u)
    down = _nearest_odd(blur_v)
    prior = np.diag(np.where(fitted == 5, patch.prior_weight**2, 0.0))
    unknown = np.full((count, count), np.nan)
    try:
        bread = np.linalg.inv(products_of(derivatives) + prior)
    except np.linalg.LinAlgError:
        return unknown
    meat = correlated_products(images, across, down) / (across * down)
    freedom = derivatives.shape[1] - float(np.vdot(bread, meat))
    if freedom <= 0:
        return unknown
    prior_variance = patch.noise_m**2 * blur_u * blur_v
    covariance = np.zeros((count, count))
    inner = square_m2 / freedom * meat + prior_variance * prior
    covariance[np.ix_(fitted, fitted)] = bread @ inner @ bread
    return covariance


def _nearest_odd(blur: float) -> int:
    """Return the odd number of pixels nearest to a blur: pixels this far apart share no noise."""
    return 2 * max(round((blur - 1) / 2), 0) + 1
