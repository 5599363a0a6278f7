"""The compiled descent of the least-absolute-residuals fit: Huber's function at one knee, by Newton's method.

What it minimises and why that ends at the L1 solution stands in `detectors.surface`.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from detectors.surface_kernels import huber_state, residuals, sides_changed, signed_sum, split, weighted_gram
from detectors.triangular import solved

PLAIN: dict[str, Any] = {"cache": True, "nogil": True}
LAR_STEPS = 60
HALVINGS = 12


@numba.njit(**PLAIN)
def lower_factor(gram: np.ndarray) -> tuple[np.ndarray, bool]:
    """Cholesky's factor (p, p) of a symmetric matrix, and whether it is regular to working precision."""
    n = len(gram)
    factor = np.zeros((n, n))
    least, most = np.inf, 0.0
    for a in range(n):
        for b in range(a + 1):
            total = gram[a, b]
            for k in range(b):
                total -= factor[a, k] * factor[b, k]
            if b < a:
                factor[a, b] = total / factor[b, b]
            elif total > 0.0:
                factor[a, a] = np.sqrt(total)
                least, most = min(least, factor[a, a]), max(most, factor[a, a])
            else:
                return factor, False
    return factor, least > 1e-7 * most


@numba.njit(**PLAIN)
def _newton_step(basis: np.ndarray, r: np.ndarray, knee: float, pull: np.ndarray) -> tuple[np.ndarray, bool]:
    inside = np.empty(len(r))
    for i in range(len(r)):
        inside[i] = 1.0 if abs(r[i]) <= knee else 0.0
    factor, regular = lower_factor(weighted_gram(basis, r, inside)[0] / knee)
    return (solved(factor, pull) if regular else pull), regular


@numba.njit(**PLAIN)
def _majorising_step(basis: np.ndarray, r: np.ndarray, knee: float, pull: np.ndarray) -> np.ndarray:
    """The reweighted least-squares step: each |r| beyond the knee under its tangent parabola. Always descends."""
    weights = np.empty(len(r))
    for i in range(len(r)):
        weights[i] = 1.0 / max(abs(r[i]), knee)
    return np.linalg.lstsq(weighted_gram(basis, r, weights)[0], pull, 1e-12)[0]


@numba.njit(**PLAIN)
def _line_search(
    basis: np.ndarray,
    z: np.ndarray,
    fixed_pull: np.ndarray,
    c: np.ndarray,
    step: np.ndarray,
    knee: float,
    value: float,
) -> tuple[np.ndarray, np.ndarray, float, bool]:
    """The first of the full, half, quarter ... step that lowers the value: coefficients, residuals, value, whether."""
    trial, r, new = c, z, value
    for halvings in range(HALVINGS):
        trial = c + step * 0.5**halvings
        r = residuals(basis, z, trial)
        new = huber_state(r, knee)[0] - np.sum(trial * fixed_pull)
        if new < value:
            return trial, r, new, True
    return trial, r, new, False


@numba.njit(**PLAIN)
def smoothed_descent(
    basis: np.ndarray, z: np.ndarray, fixed_pull: np.ndarray, start: np.ndarray, knee: float, enough: float
) -> tuple[np.ndarray, int]:
    """Minimise sum huber(r, knee) - c' fixed_pull: Newton, or a majorising step where it fails: (c, steps).

    ``basis`` (p, n), ``z`` (n,), ``fixed_pull``, ``start`` (p,). Stops where a step promises or brings less than
    ``enough``.
    """
    c = start
    r = residuals(basis, z, c)
    value = huber_state(r, knee)[0] - np.sum(c * fixed_pull)
    steps = 0
    while steps < LAR_STEPS:
        steps += 1
        pull = signed_sum(basis, r, knee) + fixed_pull
        step, regular = _newton_step(basis, r, knee, pull)
        if regular and np.sum(step * pull) < enough:
            break
        lower = False
        trial, r_trial, new = c, r, value
        if regular:
            trial, r_trial, new, lower = _line_search(basis, z, fixed_pull, c, step, knee, value)
        if not lower:
            step = _majorising_step(basis, r, knee, pull)
            trial, r_trial, new, lower = _line_search(basis, z, fixed_pull, c, step, knee, value)
        if not lower or value - new < enough:
            break
        c, r, value = trial, r_trial, new
    return c, steps


@numba.njit(**PLAIN)
def lar_stage(
    basis: np.ndarray,
    z: np.ndarray,
    start: np.ndarray,
    r_start: np.ndarray,
    margin: float,
    knee: float,
    enough: float,
) -> tuple[np.ndarray, np.ndarray, int]:
    """The optimum at one knee: (coefficients (p,), residuals (n,), steps). Only points within the margin of the start
    are iterated, the others pull as they did; the margin widens until no far point changes sides."""
    steps = 0
    while True:
        near, part, far_pull = split(basis, r_start, margin)
        c, spent = smoothed_descent(part, z[near], far_pull, start, knee, enough)
        r = residuals(basis, z, c)
        steps += spent
        if not sides_changed(r_start, r, margin, knee):
            return c, r, steps
        margin *= 3.0
