"""The result of a registration: a rigid transform, its covariance, and the reasons to trust it or not."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from detectors.views import PreparedView
from harness.vocabulary.geometry import invert

NO_GUESS = "no guess: started from the reference's own place"
CLUSTER_PITCHES = 5.0
"""Side of the cubes within which errors are taken to be common: the window of the widest depth filter."""


def unknown_covariance() -> np.ndarray:
    """Return (6, 6) of NaN: the method has no estimate."""
    return np.full((6, 6), np.nan)


@dataclass(frozen=True)
class Registration:
    """The pose of a view relative to the reference view.

    ``T_reference_view`` (4, 4), rigid, no scale. ``covariance`` (6, 6) of a small error (w, t): a point p of the
    reference frame is wrong by w x (p - ``centre_m``) + t, radians and metres; NaN where the method has no estimate.
    It contains the errors that the method knows: noise of its points, not an error that a whole view shares.
    ``residual_m``: root mean square of the minimised distances. ``overlap``: share of the view's target points that lie
    within a pixel's pitch of the reference's target, 0..1. ``failure``: why the view must not be merged; empty where it
    may. ``pairs``: marks or points that were matched. ``seconds``: time that this registration took (an equal share
    where all views are registered together).
    """

    view: str
    method: str
    T_reference_view: np.ndarray
    covariance: np.ndarray = field(default_factory=unknown_covariance)
    centre_m: np.ndarray = field(default_factory=lambda: np.zeros(3))
    residual_m: float = float("nan")
    overlap: float = float("nan")
    pairs: int = 0
    iterations: int = 0
    converged: bool = True
    seconds: float = 0.0
    failure: str = ""
    notes: tuple[str, ...] = ()


def reference_registration(view: str, method: str) -> Registration:
    """Return the registration of the first view to itself: the identity, known exactly."""
    return Registration(view, method, np.eye(4), np.zeros((6, 6)), residual_m=0.0, overlap=1.0)


def failed(
    view: PreparedView, method: str, T_reference_view: np.ndarray | None, failure: str, *notes: str
) -> Registration:
    """Return a registration that found nothing: it stands at its guess, or else at the reference's own place."""
    place = np.eye(4) if T_reference_view is None else T_reference_view
    return Registration(view.view.name, method, place, converged=False, failure=failure, notes=notes)


def cloud_of(view: PreparedView, points: Literal["marks", "target"]) -> np.ndarray:
    """Return the points (n, 3) of the fiducials or of the whole target, camera frame of the view."""
    return view.mark_points_m if points == "marks" else view.points_m


def guess_of(reference: PreparedView, view: PreparedView) -> np.ndarray | None:
    """Return ``T_reference_view`` (4, 4) as implied by both guesses; the reference need not be the first view."""
    ours, theirs = reference.view.T_reference_view_guess, view.view.T_reference_view_guess
    return None if ours is None or theirs is None else invert(ours) @ theirs


def displacement_jacobian(points_m: np.ndarray, centre_m: np.ndarray) -> np.ndarray:
    """Return the derivatives (n, 3, 6) of points (n, 3), reference frame, by the error (w, t) of `Registration`."""
    arm = np.asarray(points_m) - centre_m
    jacobian = np.zeros((len(arm), 3, 6))
    # w x r = -[r]x w
    jacobian[:, 0, 1], jacobian[:, 0, 2] = arm[:, 2], -arm[:, 1]
    jacobian[:, 1, 0], jacobian[:, 1, 2] = -arm[:, 2], arm[:, 0]
    jacobian[:, 2, 0], jacobian[:, 2, 1] = arm[:, 1], -arm[:, 0]
    jacobian[:, [0, 1, 2], [3, 4, 5]] = 1.0
    return jacobian


def predicted_error_m(registration: Registration, points_m: np.ndarray, normal: np.ndarray) -> tuple[float, float]:
    """Return the root mean square target registration error over points (n, 3) of the reference frame that the
    covariance predicts: in the plane normal to the unit vector ``normal`` (3,), and across it. NaN without a
    covariance.
    """
    jacobian = displacement_jacobian(points_m, registration.centre_m)
    spread = np.einsum("nij,jk,nlk->nil", jacobian, registration.covariance, jacobian)
    across = np.einsum("i,nij,j->n", normal, spread, normal)
    total = np.trace(spread, axis1=1, axis2=2)
    return float(np.sqrt(max((total - across).mean(), 0.0))), float(np.sqrt(max(across.mean(), 0.0)))


def clustered_sandwich(curvature: np.ndarray, scores: np.ndarray, points_m: np.ndarray, pitch_m: float) -> np.ndarray:
    """Return the covariance (6, 6) H^-1 S H^-1; S is the sum over cubes of points (n, 3) of the outer square of their
    summed scores (n, 6).

    ``curvature`` H (6, 6) and ``scores`` belong to the same objective, in any unit. NaN where H is not positive
    definite to working precision, or where there are too few cubes to see a scatter in six directions.
    """
    # rotations and shifts compared at the points' own arm, so that definiteness does not depend on units
    arm = max(float(np.sqrt(np.mean(np.sum((points_m - points_m.mean(axis=0)) ** 2, axis=1)))), 1e-12)
    unit = np.array([1 / arm] * 3 + [1.0] * 3)
    scaled = curvature * np.outer(unit, unit)
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    if not np.isfinite(values).all() or values[0] <= 1e-9 * max(values[-1], 0.0):
        return unknown_covariance()
    summed = cluster_sums(scores * unit, points_m, pitch_m)
    if len(summed) < 7:
        return unknown_covariance()
    # the scores sum to zero at the optimum, which takes one cube's worth of scatter away
    scatter = summed.T @ summed * len(summed) / (len(summed) - 1)
    inverse = (vectors / values) @ vectors.T
    covariance: np.ndarray = inverse @ scatter @ inverse * np.outer(unit, unit)
    return (covariance + covariance.T) / 2


def cluster_sums(scores: np.ndarray, points_m: np.ndarray, pitch_m: float) -> np.ndarray:
    """Return the sums (c, 6) of scores (n, 6) over the occupied cubes of 5 pitches, in the cubes' order."""
    side = max(CLUSTER_PITCHES * pitch_m, 1e-9)
    cubes = np.floor((points_m - points_m.min(axis=0)) / side).astype(np.int64)
    _, which = np.unique(cubes, axis=0, return_inverse=True)
    sums = np.zeros((int(which.max()) + 1, scores.shape[1]))
    np.add.at(sums, which.ravel(), scores)
    return sums
