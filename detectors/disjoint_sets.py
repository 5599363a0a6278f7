"""Compiled union of sets whose members are numbered: each points to a parent, the root to itself (Tarjan 1975)."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

PLAIN: dict[str, Any] = {"cache": True, "nogil": True}


@numba.njit(**PLAIN)
def root_of(parents: np.ndarray, i: int) -> int:
    """The root of the set that holds ``i``; the way to it is halved in ``parents`` (n,)."""
    while parents[i] != i:
        parents[i] = parents[parents[i]]
        i = parents[i]
    return i
