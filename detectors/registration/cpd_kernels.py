"""Compiled expectation step of coherent point drift: one row of posteriors at a time, in the memory of one cloud."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

# reductions may be reordered, which is what lets them run in parallel lanes; always the same way on one machine
FAST: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": {"contract", "reassoc", "nsz"}}
SQUARINGS = 6
"""exp(x) = exp(x / 64)^64: the polynomial then sees -1 to 0 only."""
LEAST_EXPONENT = -64.0
"""Weights below exp(-64) of the nearest component's are negligible: 10,000 of them add 2e-24."""
GREATEST_EXPONENT = 700.0
"""exp(700) is still a double; a point whose nearest Gaussian is farther is an outlier to 304 digits."""
# 1 / k!, degree 13: truncation below 2e-11 / 64 of the least value, rounding dominates
C2, C3, C4, C5, C6, C7 = 1 / 2, 1 / 6, 1 / 24, 1 / 120, 1 / 720, 1 / 5040
C8, C9, C10, C11, C12, C13 = 1 / 40320, 1 / 362880, 1 / 3628800, 1 / 39916800, 1 / 479001600, 1 / 6227020800


@numba.njit(**FAST)
def _exponential(x: float) -> float:
    """exp(x) for x <= 0, to 1e-14; no branches or tables, so that it runs in vector lanes."""
    u = max(x, LEAST_EXPONENT) / 64.0
    tail = C7 + u * (C8 + u * (C9 + u * (C10 + u * (C11 + u * (C12 + u * C13)))))
    p = 1.0 + u * (1.0 + u * (C2 + u * (C3 + u * (C4 + u * (C5 + u * (C6 + u * tail))))))
    for _ in range(SQUARINGS):
        p = p * p
    return p


@numba.njit(**FAST)
def _squared_distances(moving: np.ndarray, x: float, y: float, z: float, out: np.ndarray) -> float:
    """Fill ``out`` (m,) with squared distances from one point to ``moving`` (3, m); the least of them."""
    least = np.inf
    for m in range(moving.shape[1]):
        dx = x - moving[0, m]
        dy = y - moving[1, m]
        dz = z - moving[2, m]
        d = dx * dx + dy * dy + dz * dz
        out[m] = d
        least = min(least, d)
    return least


@numba.njit(**FAST)
def _weights(squared: np.ndarray, least: float, variance: float) -> float:
    """Replace squared distances by exp(-(d - least) / 2 variance); their sum."""
    half = -0.5 / variance
    total = 0.0
    for m in range(len(squared)):
        e = _exponential((squared[m] - least) * half)
        squared[m] = e
        total += e
    return total


@numba.njit(**FAST)
def _outlier_weight(background: float, least: float, variance: float) -> float:
    """The uniform component's weight in units of the nearest Gaussian's; at most its own e^700 times."""
    if background == 0.0:
        return 0.0
    return background * np.exp(min(0.5 * least / variance, GREATEST_EXPONENT))


@numba.njit(**FAST)
def expectation(fixed: np.ndarray, moving: np.ndarray, variance: float, background: float) -> tuple[np.ndarray, float]:
    """Posterior sums for each fixed point: (n, 5) of P, P y (3), P |y|^2 over the moving points y; and the negative sum
    of the log likelihood over fixed points, up to the Gaussians' factor.

    ``fixed`` (3, n), ``moving`` (3, m) where they stand now, ``background`` the uniform component as in equation 6 of
    Myronenko & Song: (2 pi variance)^(3/2) w / (1 - w) m / n. The nearest component's weight is divided out, so that
    nothing underflows at w = 0.
    """
    n, count = fixed.shape[1], moving.shape[1]
    sums = np.empty((n, 5))
    weight = np.empty(count)
    objective = 0.0
    for i in range(n):
        least = _squared_distances(moving, fixed[0, i], fixed[1, i], fixed[2, i], weight)
        total = _weights(weight, least, variance) + _outlier_weight(background, least, variance)
        sx = sy = sz = s0 = s2 = 0.0
        for m in range(count):
            e, x, y, z = weight[m], moving[0, m], moving[1, m], moving[2, m]
            s0 += e
            sx += e * x
            sy += e * y
            sz += e * z
            s2 += e * (x * x + y * y + z * z)
        sums[i, 0], sums[i, 1], sums[i, 2], sums[i, 3], sums[i, 4] = s0, sx, sy, sz, s2
        sums[i] /= total
        exponent = 0.5 * least / variance
        far = background > 0.0 and exponent > GREATEST_EXPONENT
        objective -= np.log(background) if far else np.log(total) - exponent
    return sums, objective


@numba.njit(**FAST)
def second_moments(fixed: np.ndarray, moving: np.ndarray, variance: float, background: float) -> np.ndarray:
    """(n, 4, 4) posterior sums of (y, 1)(y, 1)' for each fixed point; arguments as of `expectation`."""
    n, count = fixed.shape[1], moving.shape[1]
    moments = np.empty((n, 4, 4))
    weight = np.empty(count)
    for i in range(n):
        least = _squared_distances(moving, fixed[0, i], fixed[1, i], fixed[2, i], weight)
        total = _weights(weight, least, variance) + _outlier_weight(background, least, variance)
        for a in range(4):
            for b in range(a, 4):
                value = 0.0
                if a == 3:
                    for m in range(count):
                        value += weight[m]
                elif b == 3:
                    for m in range(count):
                        value += weight[m] * moving[a, m]
                else:
                    for m in range(count):
                        value += weight[m] * moving[a, m] * moving[b, m]
                moments[i, a, b] = value / total
                moments[i, b, a] = value / total
    return moments
