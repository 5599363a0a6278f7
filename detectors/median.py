"""Median and quantile where they are taken often, at a fraction of what numpy's general ones cost."""

from __future__ import annotations

import numpy as np


def median_of(values: np.ndarray) -> float:
    """Median of finite values (n,), n >= 1: numpy's, bit by bit. A NaN among them is not noticed."""
    middle = len(values) // 2
    parted = np.partition(values, middle)
    upper = float(parted[middle])
    return upper if len(values) % 2 else 0.5 * (float(parted[:middle].max()) + upper)


def median_size_of(values: np.ndarray) -> float:
    """`median_of` the absolute values."""
    return median_of(np.abs(values))


def quantile_of(values: np.ndarray, part: float) -> float:
    """The quantile of finite values (n,), n >= 1, between the two that are nearest, as numpy's default."""
    place = part * (len(values) - 1)
    below = int(place)
    above = min(below + 1, len(values) - 1)
    parted = np.partition(values, (below, above))
    low, high = float(parted[below]), float(parted[above])
    share = place - below
    return high - (high - low) * (1.0 - share) if share >= 0.5 else low + (high - low) * share
