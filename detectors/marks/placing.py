"""The rigid transform between two sets of matched points, each with its own covariance.

The closed form (Kabsch 1976; Umeyama 1991 for the sign) gives the start; Gauss-Newton on the full covariances of both
sides then gives the maximum-likelihood transform for Gaussian errors, and its information matrix the covariance (the
first-order theory of heteroscedastic errors in both sets, e.g. Ohta and Kanatani 1998). No scale.
Not modelled: errors that the points of one set share.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from detectors.registration.registered import displacement_jacobian

MAX_STEPS = 20
SMALL_STEP_M = 1e-10
"""Gauss-Newton stops where no point moves by more than a tenth of a nanometre: it converges within three to five."""


@dataclass(frozen=True)
class Placement:
    """``T_to_from`` (4, 4) rigid. ``covariance`` (6, 6) of a small error (w, t): a point p of the target frame is
    wrong by w x (p - ``centre_m``) + t. ``residuals_m`` (n, 3): mapped points less their partners; ``chi2`` their sum
    of squares in units of the covariances, of 3 n - 6 degrees of freedom."""

    T_to_from: np.ndarray
    covariance: np.ndarray
    centre_m: np.ndarray
    residuals_m: np.ndarray
    chi2: float
    iterations: int
    converged: bool


def kabsch(from_m: np.ndarray, to_m: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return least-squares rigid transforms (..., 4, 4) of points (..., n, 3) onto (..., n, 3), with
    ``weights`` (..., n) of 0 or more.

    The rotations are proper. Points on a line leave the turn about it undetermined, and any is given.
    """
    share = (weights / weights.sum(axis=-1, keepdims=True))[..., None]
    from_centre, to_centre = (share * from_m).sum(axis=-2), (share * to_m).sum(axis=-2)
    spread = np.swapaxes(share * (from_m - from_centre[..., None, :]), -1, -2) @ (to_m - to_centre[..., None, :])
    u, _, vt = np.linalg.svd(spread)
    signs = np.ones(spread.shape[:-1])
    signs[..., 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    T = np.zeros((*spread.shape[:-2], 4, 4))
    T[..., :3, :3] = np.swapaxes(vt, -1, -2) @ (signs[..., None] * np.swapaxes(u, -1, -2))
    T[..., :3, 3] = to_centre - np.einsum("...ij,...j->...i", T[..., :3, :3], from_centre)
    T[..., 3, 3] = 1.0
    return T


def place(
    from_m: np.ndarray, from_covariance_m2: np.ndarray, to_m: np.ndarray, to_covariance_m2: np.ndarray
) -> Placement:
    """Find the most probable rigid transform of points (n, 3) onto (n, 3) with covariances (n, 3, 3), n >= 3.

    Raises numpy.linalg.LinAlgError where the points leave it undetermined (two, or all on a line).
    """
    variance = np.trace(from_covariance_m2 + to_covariance_m2, axis1=1, axis2=2)
    T = kabsch(from_m, to_m, 1.0 / variance)
    centre = np.average(to_m, axis=0, weights=1.0 / variance)
    converged, steps = False, 0
    while not converged and steps < MAX_STEPS:
        steps += 1
        rotation = T[:3, :3]
        residuals, weight = _residuals(T, from_m, from_covariance_m2, to_m, to_covariance_m2)
        jacobian = displacement_jacobian(residuals + to_m, centre)
        information = np.einsum("nki,nkl,nlj->ij", jacobian, weight, jacobian)
        move = -np.linalg.solve(information, np.einsum("nki,nkl,nl->i", jacobian, weight, residuals))
        # a turn by the vector move[:3] about the centre, and a shift by move[3:]
        turn, shift = cv2.Rodrigues(move[:3])[0], T[:3, 3] - centre
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turn @ rotation, turn @ shift + centre + move[3:]
        converged = bool(np.abs(jacobian @ move).max() < SMALL_STEP_M)
    residuals, weight = _residuals(T, from_m, from_covariance_m2, to_m, to_covariance_m2)
    chi2 = float(np.einsum("ni,nij,nj->", residuals, weight, residuals))
    covariance = np.linalg.inv(information)
    return Placement(T, (covariance + covariance.T) / 2, centre, residuals, chi2, steps, converged)


def _residuals(
    T: np.ndarray, from_m: np.ndarray, from_covariance: np.ndarray, to_m: np.ndarray, to_covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mapped less partner (n, 3), and the inverse of its covariance (n, 3, 3)."""
    rotation = T[:3, :3]
    residuals = from_m @ rotation.T + T[:3, 3] - to_m
    return residuals, np.linalg.inv(to_covariance + rotation @ from_covariance @ rotation.T)
