"""Rigid coherent point drift (Myronenko & Song, TPAMI 32:2262, 2010, figure 2), without scale.

The moving cloud's points are centres of Gaussians of one width, together with a uniform component for outliers; the
fixed cloud is drawn from them. Expectation maximisation finds rotation, translation and width. As MATLAB's
`pcregistercpd` with Transform "Rigid": both clouds are set to zero mean, the start is the width of all pairs, the
iteration stops after so many steps or when the log likelihood changes by no more than a share. Unlike the authors' own
code the two clouds share one unit of length, so that no scale can enter, and the start is the guess where there is one:
because both are centred, only its turn matters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from detectors.registration import cpd_kernels as kernels
from detectors.registration.judged import still_moving, too_few_points
from detectors.registration.registered import NO_GUESS, Registration, cloud_of, clustered_sandwich, failed, guess_of
from detectors.registration.sampling import sampling_of, thinned
from detectors.registration.settings import CpdRegistration
from detectors.views import PreparedView
from harness.vocabulary.geometry import transform_points

MAX_POINTS = 10_000
"""Limit for each cloud: time grows with the product; 10^8 pairs an iteration are about a tenth of a second."""
LEAST_VARIANCE = 10 * float(np.finfo(np.float64).eps)
"""Variance in squared normalised units at which the clouds coincide (the authors' own criterion)."""
FLAT_LIKELIHOOD = (
    "not determined: the points can slide or turn without matching worse (points spread evenly over a flat surface, or"
    " too few of them)"
)


@dataclass(frozen=True)
class Drift:
    """The result of coherent point drift. ``T_fixed_moving`` (4, 4); ``sigma_m`` the Gaussians' width; ``matched`` the
    expected number of fixed points that are no outliers; ``step_m`` how far the last iteration moved the points, root
    mean square; ``background`` as `cpd_kernels.expectation` takes it: a share, without unit."""

    T_fixed_moving: np.ndarray
    sigma_m: float
    matched: float
    iterations: int
    converged: bool
    step_m: float
    background: float


def coherent_point_drift(
    fixed_m: np.ndarray, moving_m: np.ndarray, config: CpdRegistration, T_start: np.ndarray | None = None
) -> Drift:
    """Register points ``moving_m`` (m, 3) to ``fixed_m`` (n, 3), each at least three.

    ``T_start`` (4, 4): moving to fixed; the identity where not given.
    """
    start = np.eye(4) if T_start is None else T_start
    centre = fixed_m.mean(axis=0)
    scale = max(float(np.sqrt(np.mean(np.sum((fixed_m - centre) ** 2, axis=1)))), 1e-12)
    fixed = np.ascontiguousarray(((fixed_m - centre) / scale).T)
    turned = transform_points(start, moving_m)
    moving = np.ascontiguousarray(((turned - turned.mean(axis=0)) / scale).T)
    turn, shift = np.eye(3), np.zeros(3)
    # a third of the mean squared distance of all pairs; both clouds have zero mean
    variance = float((np.sum(fixed**2) / fixed.shape[1] + np.sum(moving**2) / moving.shape[1]) / 3)
    outliers = config.outlier_ratio / (1 - config.outlier_ratio) * moving.shape[1] / fixed.shape[1]
    last, change, step, matched, iterations = 0.0, np.inf, np.inf, 0.0, 0
    while iterations < config.max_iterations and change > config.tolerance and variance > LEAST_VARIANCE:
        iterations += 1
        sums, objective = kernels.expectation(fixed, moving, variance, outliers * (2 * np.pi * variance) ** 1.5)
        objective += 1.5 * fixed.shape[1] * np.log(variance)
        change, last = abs((objective - last) / objective), objective
        d_turn, d_shift, variance, matched = _maximisation(fixed, sums)
        moved = d_turn @ moving + d_shift[:, None]
        step = float(np.sqrt(np.mean(np.sum((moved - moving) ** 2, axis=0)))) * scale
        moving, turn, shift = moved, d_turn @ turn, d_turn @ shift + d_shift
    T = np.eye(4)
    T[:3, :3] = turn
    T[:3, 3] = centre + scale * shift - turn @ turned.mean(axis=0)
    background = outliers * (2 * np.pi * variance) ** 1.5
    converged = bool(change <= config.tolerance or variance <= LEAST_VARIANCE)
    return Drift(T @ start, float(np.sqrt(variance)) * scale, matched, iterations, converged, step, background)


def register_by_cpd(reference: PreparedView, view: PreparedView, config: CpdRegistration) -> Registration:
    """Return the registration of a view to the reference by coherent point drift of their fiducial clouds or targets.

    ``covariance``: see `drift_covariance`. Few iterations are the rule, so one that stops by their number is a failure
    only where its last step still moved the points by a good part of a pixel.
    """
    fixed, moving = (thinned(cloud_of(each, config.points), MAX_POINTS) for each in (reference, view))
    start = guess_of(reference, view)
    notes: tuple[str, ...] = () if start is not None else (NO_GUESS,)
    few = too_few_points(len(moving), len(fixed), config.points)
    if few:
        return failed(view, "cpd", start, few, *notes)
    drift = coherent_point_drift(fixed, moving, config, start)
    pitch = sampling_of(view).pitch_m
    covariance = drift_covariance(fixed, transform_points(drift.T_fixed_moving, moving), drift, pitch)
    failure = "" if drift.converged else still_moving(drift.step_m, pitch)
    if not failure and not np.isfinite(covariance).all():
        failure = FLAT_LIKELIHOOD
    if not drift.converged:
        notes += (f"stopped after {drift.iterations} iterations, the limit in the settings",)
    return Registration(
        view=view.view.name,
        method="cpd",
        T_reference_view=drift.T_fixed_moving,
        covariance=covariance,
        centre_m=fixed.mean(axis=0),
        residual_m=drift.sigma_m * np.sqrt(3.0),
        pairs=round(drift.matched),
        iterations=drift.iterations,
        converged=drift.converged,
        failure=failure,
        notes=notes,
    )


def drift_covariance(fixed_m: np.ndarray, moved_m: np.ndarray, drift: Drift, pitch_m: float) -> np.ndarray:
    """Return the (6, 6) covariance of the pose, as `Registration` means it, about the fixed cloud's centroid.

    The pose maximises a likelihood whose model (independent draws of Gaussians) the pixels of a surface do not follow,
    so the curvature alone would be far too sure: H^-1 S H^-1 with H the observed information (complete information less
    that which is missing because the correspondence is not known; Louis, JRSS B 44:226, 1982) and S the scatter of the
    scores, summed within cubes of 5 pixels whose errors are common (Liang & Zeger, Biometrika 73:13, 1986). The moving
    cloud's own noise is taken to be as large. Both are taken at a Gaussian width of no less than a pitch, because below
    it the likelihood shows how the two grids of pixels beat and not where the clouds lie. NaN where H is not positive
    definite.
    """
    centre = fixed_m.mean(axis=0)
    x, y = fixed_m - centre, moved_m - centre
    variance = max(drift.sigma_m, pitch_m) ** 2
    background = drift.background * (variance / drift.sigma_m**2) ** 1.5
    moments = kernels.second_moments(np.ascontiguousarray(x.T), np.ascontiguousarray(y.T), variance, background)
    # the score of a pair is J'(x - y) / variance, linear in (y, 1)
    linear = _score_jacobian(x)
    scores = np.einsum("nij,nj->ni", linear, moments[:, :, 3]) / variance
    within = np.einsum("nij,njk,nlk->il", linear, moments, linear) / variance**2
    information = _complete_information(moments.sum(axis=0)) / variance - (within - scores.T @ scores)
    scores = scores - scores.mean(axis=0)
    both = 1 + len(fixed_m) / len(moved_m)
    return clustered_sandwich(information, scores, fixed_m, pitch_m) * both


def _maximisation(fixed: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Turn (3, 3), shift (3,), variance and expected matches from the posterior sums (n, 5); scale held at 1."""
    matched = float(sums[:, 0].sum())
    mean_x = fixed @ sums[:, 0] / matched
    mean_y = sums[:, 1:4].sum(axis=0) / matched
    cross = fixed @ sums[:, 1:4] - matched * np.outer(mean_x, mean_y)
    left, _, right = np.linalg.svd(cross)
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    spread_x = float(np.sum(fixed**2, axis=0) @ sums[:, 0]) - matched * float(mean_x @ mean_x)
    spread_y = float(sums[:, 4].sum()) - matched * float(mean_y @ mean_y)
    variance = (spread_x + spread_y - 2 * float(np.sum(cross * turn))) / (3 * matched)
    return turn, mean_x - turn @ mean_y, max(variance, LEAST_VARIANCE / 2), matched


def _complete_information(moment: np.ndarray) -> np.ndarray:
    """(6, 6) sum of weights times J'J from the weighted sum (4, 4) of (y, 1)(y, 1)'."""
    count, first, second = moment[3, 3], moment[:3, 3], moment[:3, :3]
    cross = np.array([[0, -first[2], first[1]], [first[2], 0, -first[0]], [-first[1], first[0], 0]])
    information = np.zeros((6, 6))
    information[:3, :3] = np.trace(second) * np.eye(3) - second
    information[:3, 3:] = cross
    information[3:, :3] = cross.T
    information[3:, 3:] = count * np.eye(3)
    return information


def _score_jacobian(arm_m: np.ndarray) -> np.ndarray:
    """(n, 6, 4): J(y)'(x - y) = B (y, 1) for fixed points x at ``arm_m`` (n, 3) from the centre: y x x and x - y."""
    linear = np.zeros((len(arm_m), 6, 4))
    x, y, z = arm_m.T
    # y x x = -[x]x y
    linear[:, 0, 1], linear[:, 0, 2] = z, -y
    linear[:, 1, 0], linear[:, 1, 2] = -z, x
    linear[:, 2, 0], linear[:, 2, 1] = y, -x
    linear[:, [3, 4, 5], [0, 1, 2]] = -1.0
    linear[:, 3:, 3] = arm_m
    return linear
