"""The image of a hole through a camera that averages over a square of pixels: forward model, fit, standard errors.

A drilled hole on a locally plane surface: a round tube that starts with the surface's mouth, of some length, and behind
it a floor of one depth, seen and lit obliquely, through the pixel's aperture and a filter that averages ``blur_px`` x
``blur_px`` pixels: a unit pixel convolved with that comb is a square of side ``blur_px``. A ray that has come as deep
as t has passed the mouth and the circle at depth t, and so has the light that comes back along it (a ray counts as
deep as light reaches along it, so a dark end for less); in the image each is an ellipse, shifted by parallax. So the
residual is the integral over t of the blurred overlap of such ellipses. It is the mouth that has the diameter; the
floor alone would look smaller and displaced.

The tube's length over the depth (1 in a blind hole, less where a backing stands behind a board) is fitted too, with
every length from none to the whole depth as plausible.

Not modelled: light between wall and floor, which makes a wall look deeper than it is (the fitted length is then too
short) and the floor too (by 1 mm of 9.5); walls that return less light than the floor; a floor that is not flat; the
loss of weight of deep neighbours in a bilateral filter (0.87 at 33 mm for the Azure Kinect: holes of 2 to 3 times the
blur come out up to 16 % too deep there). Of what stands out before the surface only the disc is modelled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from detectors.hole_image import Patch, blurred_hole, derivatives
from detectors.hole_kernels import PARAMETERS, correlated_products, descend, hole_of

IMAGES, TOLERANCE = 60, 1e-4
"""Of a descent: the most images drawn (most fits take eight), and the relative change of the sum of squares or of the
parameters below which it ends: some hundredth of a standard error."""
WALL_PRIOR = (0.5, 12.0**-0.5)
"""Mean and standard deviation of the tube's length over the depth before the image is seen: uniform from 0 to 1."""


@dataclass(frozen=True)
class HoleFit:
    """``u_px``, ``v_px`` in the patch; ``wall``: the tube's length over the depth; ``covariance`` (6, 6) of (u, v,
    radius, depth, offset, wall) in px and metres."""

    u_px: float
    v_px: float
    radius_m: float
    depth_m: float
    offset_m: float
    wall: float
    covariance: np.ndarray
    converged: bool


def fit_hole(patch: Patch, u: float, v: float, radius_m: float, depth_m: float, offset_m: float) -> HoleFit:
    """Least squares from a start, by Levenberg's and Marquardt's way (MINPACK's), with `sandwich_covariance`.

    Fitted are (u, v, ln radius, depth * radius^2, offset, x) with the wall sin^2(pi x / 2). The fourth is the hole's
    volume, which the blur keeps, so that a hole smaller than the blur still has one well-determined direction for each
    parameter but its radius; x may run free where the wall must stay in 0..1. The wall has `WALL_PRIOR` for one more
    observation: a small hole, or one seen straight on, does not determine it.
    """
    start = np.array([u, v, math.log(radius_m), depth_m * radius_m**2, offset_m, WALL_PRIOR[0]])
    h, w = patch.shape
    # keeps a wild trial step finite: no disc is larger than ten patches
    low = np.array([-10.0 * w, -10.0 * h, -20.0])
    high = np.array([10.0 * w, 10.0 * h, math.log(10.0 * (h + w) * math.sqrt(patch.metric_m2.max()))])
    prior = np.array([WALL_PRIOR[0], _prior_weight(patch)])
    seen = (np.ascontiguousarray(patch.residual_m), np.ascontiguousarray(patch.used))
    q, converged = descend(
        *seen, start, low, high, prior, patch.form, patch.sight.numbers, patch.blur_px, IMAGES, TOLERANCE
    )
    hole, offset = hole_of(q, low, high), float(q[4])
    covariance = sandwich_covariance(patch, hole, offset)
    u, v, radius, depth, wall = (float(value) for value in hole)
    return HoleFit(u, v, radius, depth, offset, wall, covariance, converged)


def _prior_weight(patch: Patch) -> float:
    """What a deviation of the wall of 1 is worth, in metres of misfit: noise that is equal over blur x blur pixels
    counts as often in the sum of squares."""
    return patch.noise_m * math.sqrt(patch.blur_area_px) / WALL_PRIOR[1]


def sandwich_covariance(patch: Patch, hole: np.ndarray, offset_m: float) -> np.ndarray:
    """(6, 6) covariance of (u, v, radius, depth, offset, wall) of the least-squares fit under correlated noise, where
    the fit gave a hole (u, v, radius, depth, wall) and an offset.

    The noise is white noise through the same square filter, so its correlation is C = B B' / blur^2 with B the sum over
    blur x blur pixels, and cov = A^-1 (s^2 J' C J + p^2 W) A^-1 with A = J' J + W, W the prior's square weight on the
    wall and p^2 its variance in the same unit. The variance s^2 of one pixel comes from the misfit:
    E[misfit' misfit] = s^2 (n - trace(A^-1 J' C J)); so what the model does not describe counts as noise. NaN where the
    fit determines no variance.
    """
    image = blurred_hole(patch, hole)
    by = derivatives(patch, hole, image)
    columns = np.stack([*by[:4], np.ones(patch.shape), by[4]]) * patch.used
    flat = columns.reshape(PARAMETERS, -1)
    across, down = patch.window
    prior = np.zeros((PARAMETERS, PARAMETERS))
    prior[5, 5] = _prior_weight(patch) ** 2
    try:
        bread = np.linalg.inv(flat @ flat.T + prior)
    except np.linalg.LinAlgError:
        return np.full((PARAMETERS, PARAMETERS), np.nan)
    meat = correlated_products(columns, across, down) / (across * down)
    freedom = int(patch.used.sum()) - float(np.trace(bread @ meat))
    misfit = (image + offset_m - patch.residual_m)[patch.used]
    if freedom <= 0:
        return np.full((PARAMETERS, PARAMETERS), np.nan)
    variance = float(misfit @ misfit) / freedom
    return bread @ (variance * meat + patch.noise_m**2 * patch.blur_area_px * prior) @ bread
