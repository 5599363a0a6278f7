"""Compiled solutions with a Cholesky factor: a library's call takes longer than a system of six unknowns."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

PLAIN: dict[str, Any] = {"cache": True, "nogil": True}


@numba.njit(**PLAIN)
def forward(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    """x (p,) of L x = right; ``factor`` (p, p) is the lower triangle L."""
    x = right.copy()
    for a in range(len(x)):
        for k in range(a):
            x[a] -= factor[a, k] * x[k]
        x[a] /= factor[a, a]
    return x


@numba.njit(**PLAIN)
def solved(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    """x (p,) of L L' x = right."""
    x = forward(factor, right)
    for a in range(len(x) - 1, -1, -1):
        for k in range(a + 1, len(x)):
            x[a] -= factor[k, a] * x[k]
        x[a] /= factor[a, a]
    return x
