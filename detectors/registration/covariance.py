"""The covariance of a pose that makes a sum over many points small, when the points' errors are not independent."""

from __future__ import annotations

import numpy as np

CLUSTER_PITCHES = 5.0
"""Side of the cubes within which errors are taken to be common: the window of the widest depth filter."""


def clustered_sandwich(curvature: np.ndarray, scores: np.ndarray, points_m: np.ndarray, pitch_m: float) -> np.ndarray:
    """(6, 6): H^-1 S H^-1, S the sum over cubes of points (n, 3) of the outer square of their summed scores (n, 6).

    ``curvature`` H (6, 6) and ``scores`` belong to the same objective, in any unit. NaN where H is not positive
    definite to working precision, or where there are too few cubes to see a scatter in six directions.
    """
    unknown = np.full((6, 6), np.nan)
    # rotations and shifts compared at the points' own arm, so that definiteness does not depend on units
    arm = max(float(np.sqrt(np.mean(np.sum((points_m - points_m.mean(axis=0)) ** 2, axis=1)))), 1e-12)
    unit = np.array([1 / arm] * 3 + [1.0] * 3)
    scaled = curvature * np.outer(unit, unit)
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    if not np.isfinite(values).all() or values[0] <= 1e-9 * max(values[-1], 0.0):
        return unknown
    summed = cluster_sums(scores * unit, points_m, pitch_m)
    if len(summed) < 7:
        return unknown
    # the scores sum to zero at the optimum, which takes one cube's worth of scatter away
    scatter = summed.T @ summed * len(summed) / (len(summed) - 1)
    inverse = (vectors / values) @ vectors.T
    covariance: np.ndarray = inverse @ scatter @ inverse * np.outer(unit, unit)
    return (covariance + covariance.T) / 2


def cluster_sums(scores: np.ndarray, points_m: np.ndarray, pitch_m: float) -> np.ndarray:
    """(c, 6) sums of scores (n, 6) over the occupied cubes of 5 pitches, in the cubes' order."""
    side = max(CLUSTER_PITCHES * pitch_m, 1e-9)
    cubes = np.floor((points_m - points_m.min(axis=0)) / side).astype(np.int64)
    _, which = np.unique(cubes, axis=0, return_inverse=True)
    sums = np.zeros((int(which.max()) + 1, scores.shape[1]))
    np.add.at(sums, which.ravel(), scores)
    return sums


def score_jacobian(arm_m: np.ndarray) -> np.ndarray:
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
