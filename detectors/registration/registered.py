"""What a registration gives: a rigid transform, its covariance, and the reasons to trust it or not."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Registration:
    """One view's place to the reference view.

    ``T_reference_view`` (4, 4), rigid, no scale. ``covariance`` (6, 6) of a small error (w, t): a point p of the
    reference frame is wrong by w x (p - ``centre_m``) + t, radians and metres; NaN where the method has no estimate.
    It holds what the method knows of: noise of its points, not an error that a whole view shares. ``residual_m``: root
    mean square of what was made small. ``overlap``: share of the view's target points that lie within a pixel's pitch
    of the reference's target, 0..1. ``failure``: why the view must not be merged; empty where it may. ``pairs``: marks
    or points that were matched. ``seconds``: of this registration (of one over all views its share).
    """

    view: str
    method: str
    T_reference_view: np.ndarray
    covariance: np.ndarray
    centre_m: np.ndarray
    residual_m: float
    overlap: float
    pairs: int
    iterations: int
    converged: bool
    seconds: float
    failure: str = ""
    notes: tuple[str, ...] = field(default=())


def reference_registration(view: str, method: str) -> Registration:
    """That of the first view to itself: the identity, known exactly."""
    return Registration(view, method, np.eye(4), np.zeros((6, 6)), np.zeros(3), 0.0, 1.0, 0, 0, True, 0.0)


def displacement_jacobian(points_m: np.ndarray, centre_m: np.ndarray) -> np.ndarray:
    """(n, 3, 6): how points (n, 3) of the reference frame move with the error (w, t) of `Registration`."""
    arm = np.asarray(points_m) - centre_m
    jacobian = np.zeros((len(arm), 3, 6))
    # w x r = -[r]x w
    jacobian[:, 0, 1], jacobian[:, 0, 2] = arm[:, 2], -arm[:, 1]
    jacobian[:, 1, 0], jacobian[:, 1, 2] = -arm[:, 2], arm[:, 0]
    jacobian[:, 2, 0], jacobian[:, 2, 1] = arm[:, 1], -arm[:, 0]
    jacobian[:, [0, 1, 2], [3, 4, 5]] = 1.0
    return jacobian


def predicted_error_m(registration: Registration, points_m: np.ndarray, normal: np.ndarray) -> tuple[float, float]:
    """Root mean square target registration error over points (n, 3) of the reference frame that the covariance
    predicts: (in the plane, across it), the plane being that across the unit ``normal`` (3,). NaN without a covariance.
    """
    jacobian = displacement_jacobian(points_m, registration.centre_m)
    spread = np.einsum("nij,jk,nlk->nil", jacobian, registration.covariance, jacobian)
    across = np.einsum("i,nij,j->n", normal, spread, normal)
    total = np.trace(spread, axis1=1, axis2=2)
    return float(np.sqrt(max((total - across).mean(), 0.0))), float(np.sqrt(max(across.mean(), 0.0)))
