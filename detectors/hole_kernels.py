"""Compiled inner loops of the hole model's fit: normal equations, the descent of Levenberg and Marquardt, and what the
image's correlated noise makes of its covariance.

The descent is MINPACK's ``lmder`` (More 1978; Argonne ANL-80-74) step by step, with its own scaling of the variables;
only the damped step is solved from the normal equations, in scaled variables, by Cholesky's factor instead of QR: with
six parameters that costs no digit that counts, and the pixels are passed once.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from detectors.hole_image import differences, picture
from detectors.triangular import forward, solved

FAST: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": {"contract", "reassoc", "nsz"}}
PLAIN: dict[str, Any] = {"cache": True, "nogil": True}
PARAMETERS = 6
"""u, v, radius, depth, offset, wall."""
FIRST_REACH = 100.0
"""Of the first step, in scaled lengths of the start: MINPACK's default factor."""
DAMPING_TRIALS = 10
TINY = float(np.finfo(np.float64).tiny)
EPSILON = float(np.finfo(np.float64).eps)
SINGULAR = 1e-13
"""Added to a matrix of unit diagonal that has no factor."""


@numba.njit(**PLAIN)
def hole_of(q: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(u, v, radius, depth, wall) of fitted (u, v, ln radius, depth radius^2, offset, x); the first three are kept in
    ``low`` to ``high``."""
    radius = math.exp(min(max(q[2], low[2]), high[2]))
    hole = np.empty(5)
    hole[0], hole[1] = min(max(q[0], low[0]), high[0]), min(max(q[1], low[1]), high[1])
    hole[2], hole[3], hole[4] = radius, q[3] / radius**2, math.sin(0.5 * math.pi * q[5]) ** 2
    return hole


@numba.njit(**FAST)
def square_misfit(image: np.ndarray, residual: np.ndarray, used: np.ndarray, offset: float) -> float:
    """Sum of squares of image + offset - residual over the used pixels, all (h, w)."""
    total = 0.0
    for r in range(image.shape[0]):
        for c in range(image.shape[1]):
            misfit = image[r, c] + offset - residual[r, c]
            total += misfit * misfit if used[r, c] else 0.0
    return total


@numba.njit(**FAST)
def _normal_equations(
    by: np.ndarray,
    image: np.ndarray,
    residual: np.ndarray,
    used: np.ndarray,
    q: np.ndarray,
    hole: np.ndarray,
    prior: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """J' J (6, 6) and J' f (6,) by the fitted parameters ``q``. ``prior``: mean and weight of the wall's."""
    h, w = image.shape
    rows = np.empty((PARAMETERS + 1, w))
    gram, pull = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    radius, depth = hole[2], hole[3]
    slope = 0.5 * math.pi * math.sin(math.pi * q[5])
    for r in range(h):
        for c in range(w):
            one = 1.0 if used[r, c] else 0.0
            rows[0, c] = one * by[0, r, c]
            rows[1, c] = one * by[1, r, c]
            rows[2, c] = one * (radius * by[2, r, c] - 2.0 * depth * by[3, r, c])
            rows[3, c] = one * by[3, r, c] / radius**2
            rows[4, c] = one
            rows[5, c] = one * by[4, r, c] * slope
            rows[6, c] = image[r, c] + q[4] - residual[r, c] if used[r, c] else 0.0
        for a in range(PARAMETERS):
            for b in range(a + 1):
                total = 0.0
                for c in range(w):
                    total += rows[a, c] * rows[b, c]
                gram[a, b] += total
            total = 0.0
            for c in range(w):
                total += rows[a, c] * rows[6, c]
            pull[a] += total
    mean, weight = prior
    gram[5, 5] += (weight * slope) ** 2
    pull[5] += weight * slope * weight * (hole[4] - mean)
    for a in range(PARAMETERS):
        for b in range(a):
            gram[b, a] = gram[a, b]
    return gram, pull


@numba.njit(**PLAIN)
def _factor(matrix: np.ndarray, factor: np.ndarray) -> bool:
    """Cholesky's lower factor; False where the matrix is not positive definite to working precision."""
    n = len(matrix)
    for a in range(n):
        for b in range(a + 1):
            total = matrix[a, b]
            for k in range(b):
                total -= factor[a, k] * factor[b, k]
            if a == b:
                if not total > n * EPSILON * matrix[a, a]:
                    return False
                factor[a, a] = math.sqrt(total)
            else:
                factor[a, b] = total / factor[b, b]
    return True


@numba.njit(**PLAIN)
def _norm(x: np.ndarray) -> float:
    total = 0.0
    for value in x:
        total += value * value
    return math.sqrt(total)


@numba.njit(**PLAIN)
def _damped_step(gram: np.ndarray, pull: np.ndarray, reach: float, damping: float) -> tuple[np.ndarray, float]:
    """MINPACK's ``lmpar`` in scaled variables: the step p of (J' J + damping) p = J' f whose length is within a tenth
    of ``reach``, or the full step where that is shorter; and its damping. ``damping``: the first to try."""
    n = len(pull)
    factor = np.empty((n, n))
    regular = _factor(gram, factor)
    if not regular:
        # a direction that the image does not tell: the shortest step takes no part in it
        regular = _factor(gram + SINGULAR * np.eye(n), factor)
    step = solved(factor, pull)
    length = _norm(step)
    beyond = length - reach
    if regular and beyond <= 0.1 * reach:
        return step, 0.0
    least = 0.0
    if regular:
        size = _norm(forward(factor, step / length))
        least = beyond / reach / size / size
    steepest = _norm(pull)
    most = steepest / reach if steepest > 0.0 else TINY / min(reach, 0.1)
    damping = min(max(damping, least), most)
    if damping == 0.0:
        damping = steepest / length
    for trial in range(DAMPING_TRIALS):
        if damping == 0.0:
            damping = max(TINY, 1e-3 * most)
        while not _factor(gram + damping * np.eye(n), factor):
            damping = max(2.0 * damping, SINGULAR)
        step = solved(factor, pull)
        length = _norm(step)
        before, beyond = beyond, length - reach
        near = abs(beyond) <= 0.1 * reach or (least == 0.0 and beyond <= before and before < 0.0)
        if near or trial == DAMPING_TRIALS - 1:
            break
        size = _norm(forward(factor, step / length))
        if beyond > 0.0:
            least = max(least, damping)
        elif beyond < 0.0:
            most = min(most, damping)
        damping = max(least, damping + beyond / reach / size / size)
    return step, damping


@numba.njit(**PLAIN)
def descend(
    residual: np.ndarray,
    used: np.ndarray,
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    prior: np.ndarray,
    form: np.ndarray,
    sights: np.ndarray,
    blur: tuple[float, float],
    images: int,
    tolerance: float,
) -> tuple[np.ndarray, bool]:
    """Fitted parameters (6,) and whether the descent converged: to a relative ``tolerance`` of the sum of squares or of
    the step, within so many ``images``. ``residual``, ``used`` (h, w); ``low``, ``high`` as `hole_of` takes them."""
    q = start.copy()
    image, trial_image = np.empty(residual.shape), np.empty(residual.shape)
    by = np.empty((5, *residual.shape))
    scale = np.zeros(PARAMETERS)
    hole = hole_of(q, low, high)
    picture(hole, form, sights, blur, image)
    misfit = math.sqrt(square_misfit(image, residual, used, q[4]) + (prior[1] * (hole[4] - prior[0])) ** 2)
    drawn, damping, reach, size = 1, 0.0, 0.0, 0.0
    first = True
    while True:
        differences(hole, image, form, sights, blur, by)
        gram, pull = _normal_equations(by, image, residual, used, q, hole, prior)
        steepest = 0.0
        for a in range(PARAMETERS):
            column = math.sqrt(gram[a, a])
            if column > 0.0 and misfit > 0.0:
                steepest = max(steepest, abs(pull[a]) / (misfit * column))
            scale[a] = (column if column > 0.0 else 1.0) if first else max(scale[a], column)
        if first:
            size = _norm(scale * q)
            reach = FIRST_REACH * size if size > 0.0 else FIRST_REACH
        if steepest <= 1e-9:
            return q, True
        scaled = gram / np.outer(scale, scale)
        ratio = 0.0
        while ratio < 1e-4:
            step, damping = _damped_step(scaled, pull / scale, reach, damping)
            length = _norm(step)
            if first:
                reach = min(reach, length)
            moved = q - step / scale
            moved_hole = hole_of(moved, low, high)
            picture(moved_hole, form, sights, blur, trial_image)
            drawn += 1
            squares = square_misfit(trial_image, residual, used, moved[4])
            new = math.sqrt(squares + (prior[1] * (moved_hole[4] - prior[0])) ** 2)
            gain = 1.0 - (new / misfit) ** 2 if 0.1 * new < misfit else -1.0
            linear = (step @ scaled @ step) / misfit**2
            damped = damping * length * length / misfit**2
            promise, descent = linear + 2.0 * damped, -(linear + damped)
            ratio = gain / promise if promise != 0.0 else 0.0
            if ratio <= 0.25:
                part = 0.5 if gain >= 0.0 else 0.5 * descent / (descent + 0.5 * gain)
                if 0.1 * new >= misfit or part < 0.1:
                    part = 0.1
                reach = part * min(reach, 10.0 * length)
                damping /= part
            elif damping == 0.0 or ratio >= 0.75:
                reach = 2.0 * length
                damping *= 0.5
            if ratio >= 1e-4:
                q, hole, misfit = moved, moved_hole, new
                image, trial_image = trial_image, image
                size = _norm(scale * q)
                first = False
            if abs(gain) <= tolerance and promise <= tolerance and 0.5 * ratio <= 1.0:
                return q, True
            if reach <= tolerance * size:
                return q, True
            if drawn >= images:
                return q, False


@numba.njit(**FAST)
def correlated_products(columns: np.ndarray, across: int, down: int) -> np.ndarray:
    """(p, p) S' S with S the columns (p, h, w), zero outside, summed over a window of ``down`` x ``across`` pixels
    around every place that it reaches."""
    terms, h, w = columns.shape
    wide, tall = w + across - 1, h + down - 1
    along = np.zeros((terms, tall, wide))
    line = np.empty(w + 1)
    for t in range(terms):
        for r in range(h):
            line[0] = 0.0
            for c in range(w):
                line[c + 1] = line[c] + columns[t, r, c]
            for c in range(wide):
                along[t, r, c] = line[min(c + 1, w)] - line[max(c + 1 - across, 0)]
    products = np.zeros((terms, terms))
    window = np.zeros((terms, wide))
    for r in range(tall):
        for t in range(terms):
            if r < h:
                for c in range(wide):
                    window[t, c] += along[t, r, c]
            if r >= down:
                for c in range(wide):
                    window[t, c] -= along[t, r - down, c]
        for a in range(terms):
            for b in range(a + 1):
                total = 0.0
                for c in range(wide):
                    total += window[a, c] * window[b, c]
                products[a, b] += total
    for a in range(terms):
        for b in range(a):
            products[b, a] = products[a, b]
    return products


@numba.njit(**FAST)
def plane_sums(
    points: np.ndarray, surface_z: np.ndarray, finite: np.ndarray, u0: float, v0: float, parallel: bool
) -> tuple[np.ndarray, np.ndarray]:
    """D' D (3, 3) and D' T (3, 3) over the finite pixels (h, w) of a patch: D has the columns 1, u - u0, v - v0; T the
    direction of sight x/z, y/z of ``points`` (h, w, 3), in a parallel projection x, y, and ``surface_z`` (h, w).
    """
    square, right = np.zeros((3, 3)), np.zeros((3, 3))
    for r in range(finite.shape[0]):
        for c in range(finite.shape[1]):
            if not finite[r, c]:
                continue
            depth = 1.0 if parallel else points[r, c, 2]
            design = (1.0, c - u0, r - v0)
            target = (points[r, c, 0] / depth, points[r, c, 1] / depth, surface_z[r, c])
            for a in range(3):
                for b in range(3):
                    square[a, b] += design[a] * design[b]
                    right[a, b] += design[a] * target[b]
    return square, right
