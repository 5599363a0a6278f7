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

import cv2
import numpy as np

from detectors.hole_image import Patch, blurred_hole, derivatives

PARAMETERS = 6
"""u, v, radius, depth, offset, wall."""
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
    """Least squares from a start, by Levenberg and Marquardt (MINPACK), with `sandwich_covariance`.

    Fitted are (u, v, ln radius, depth * radius^2, offset, x) with the wall sin^2(pi x / 2). The fourth is the hole's
    volume, which the blur keeps, so that a hole smaller than the blur still has one well-determined direction for each
    parameter but its radius; x may run free where the wall must stay in 0..1. The wall has `WALL_PRIOR` for one more
    observation: a small hole, or one seen straight on, does not determine it.
    """
    from scipy.optimize import least_squares

    model = _Model(patch)
    start = np.array([u, v, np.log(radius_m), depth_m * radius_m**2, offset_m, WALL_PRIOR[0]])
    scales = np.array([1.0, 1.0, 0.3, 0.3 * abs(start[3]) + 1e-12, 0.1 * abs(depth_m) + 1e-6, 0.3])
    found = least_squares(
        lambda q: model.misfit(q * scales),
        start / scales,
        lambda q: model.jacobian(q * scales) * scales,
        method="lm",
        max_nfev=60,
        xtol=1e-4,
        ftol=1e-4,
        gtol=1e-9,
    )
    q = found.x * scales
    hole, offset = model.hole(q), float(q[4])
    covariance = sandwich_covariance(patch, hole, offset)
    u, v, radius, depth, wall = (float(value) for value in hole)
    return HoleFit(u, v, radius, depth, offset, wall, covariance, bool(found.success))


def _prior_weight(patch: Patch) -> float:
    """What a deviation of the wall of 1 is worth, in metres of misfit: noise that is equal over blur x blur pixels
    counts as often in the sum of squares."""
    return patch.noise_m * math.sqrt(patch.blur_area_px) / WALL_PRIOR[1]


def _wall(x: float) -> float:
    return math.sin(0.5 * math.pi * x) ** 2


class _Model:
    """Misfit and Jacobian of one patch with the prior as last row; MINPACK asks for both at the same place."""

    def __init__(self, patch: Patch) -> None:
        self._patch = patch
        self._data = patch.residual_m[patch.used]
        self._weight = _prior_weight(patch)
        h, w = patch.used.shape
        # keeps a wild trial step finite: no disc is larger than ten patches
        self._low = np.array([-10.0 * w, -10.0 * h, -20.0])
        self._high = np.array([10.0 * w, 10.0 * h, math.log(10.0 * (h + w) * math.sqrt(patch.metric_m2.max()))])
        self._at = np.full(PARAMETERS, np.nan)
        self._image = np.empty((h, w))

    def misfit(self, q: np.ndarray) -> np.ndarray:
        self._image, self._at = blurred_hole(self._patch, self.hole(q)), q.copy()
        hole = self._image[self._patch.used]
        return np.append(hole + q[4] - self._data, self._weight * (_wall(q[5]) - WALL_PRIOR[0]))

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        hole = self.hole(q)
        image = self._image if np.array_equal(q, self._at) else blurred_hole(self._patch, hole)
        by = derivatives(self._patch, hole, image)[:, self._patch.used]
        radius, depth = hole[2], hole[3]
        rows = np.zeros((by.shape[1] + 1, PARAMETERS))
        rows[:-1, :2] = by[:2].T
        rows[:-1, 2] = radius * by[2] - 2.0 * depth * by[3]
        rows[:-1, 3] = by[3] / radius**2
        rows[:-1, 4] = 1.0
        rows[:-1, 5] = by[4]
        rows[-1, 5] = self._weight
        rows[:, 5] *= 0.5 * math.pi * math.sin(math.pi * q[5])
        return rows

    def hole(self, q: np.ndarray) -> np.ndarray:
        """(u, v, radius, depth, wall) of the fitted parameters."""
        u, v, log_radius = np.minimum(np.maximum(q[:3], self._low), self._high)
        radius = math.exp(log_radius)
        return np.array([u, v, radius, q[3] / radius**2, _wall(q[5])])


def sandwich_covariance(patch: Patch, hole: np.ndarray, offset_m: float) -> np.ndarray:
    """(6, 6) covariance of (u, v, radius, depth, offset, wall) of the least-squares fit under correlated noise, where
    the fit gave a hole (u, v, radius, depth, wall) and an offset.

    The noise is white noise through the same square filter, so its correlation is C = B B' / blur^2 with B the sum over
    blur x blur pixels, and cov = A^-1 (s^2 J' C J + p^2 W) A^-1 with A = J' J + W, W the prior's square weight on the
    wall and p^2 its variance in the same unit. The variance s^2 of one pixel comes from the misfit:
    E[misfit' misfit] = s^2 (n - trace(A^-1 J' C J)); so what the model does not describe counts as noise. NaN where the
    fit determines no variance.
    """
    h, w = patch.used.shape
    image = blurred_hole(patch, hole)
    by = derivatives(patch, hole, image)
    columns = np.stack([*by[:4], np.ones((h, w)), by[4]], axis=-1) * patch.used[..., None]
    flat = columns.reshape(-1, PARAMETERS)
    across, down = patch.window
    padded = np.pad(columns, ((down - 1, down - 1), (across - 1, across - 1), (0, 0)))
    summed = np.dstack(
        [
            cv2.boxFilter(part, -1, patch.window, normalize=False, borderType=cv2.BORDER_CONSTANT)
            for part in (padded[..., :3], padded[..., 3:])
        ]
    ).reshape(-1, PARAMETERS)
    prior = np.zeros((PARAMETERS, PARAMETERS))
    prior[5, 5] = _prior_weight(patch) ** 2
    try:
        bread = np.linalg.inv(flat.T @ flat + prior)
    except np.linalg.LinAlgError:
        return np.full((PARAMETERS, PARAMETERS), np.nan)
    meat = summed.T @ summed / (across * down)
    freedom = int(patch.used.sum()) - float(np.trace(bread @ meat))
    misfit = (image + offset_m - patch.residual_m)[patch.used]
    if freedom <= 0:
        return np.full((PARAMETERS, PARAMETERS), np.nan)
    variance = float(misfit @ misfit) / freedom
    return bread @ (variance * meat + patch.noise_m**2 * patch.blur_area_px * prior) @ bread
