"""Medians of groups of values."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def group_medians(
    values: np.ndarray,
    group: np.ndarray,
    groups: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the median of each group's finite values, and their median distance from it over
    0.6745; else NaN."""
    starts = np.zeros(groups + 1, np.int64)
    for i in range(len(values)):
        if group[i] >= 0 and np.isfinite(values[i]):
            starts[group[i] + 1] += 1
    starts = np.cumsum(starts)
    next_slot = starts[:-1].copy()
    grouped = np.empty(starts[-1])
    for i in range(len(values)):
        if group[i] >= 0 and np.isfinite(values[i]):
            grouped[next_slot[group[i]]] = values[i]
            next_slot[group[i]] += 1
    medians = np.full(groups, np.nan)
    deviations = np.full(groups, np.nan)
    for g in range(groups):
        if starts[g + 1] > starts[g]:
            members = grouped[starts[g] : starts[g + 1]]
            medians[g] = median_sorted(members)
            deviations[g] = median_sorted(np.abs(members - medians[g])) / 0.6745
    return medians, deviations


@numba.njit(cache=True, nogil=True)
def row_medians(rows: np.ndarray) -> np.ndarray:
    """Return the median of the finite values in each of the rows (n, k); NaN without any."""
    medians = np.full(len(rows), np.nan)
    for n in range(len(rows)):
        values = rows[n][np.isfinite(rows[n])]
        if len(values):
            medians[n] = median_sorted(values)
    return medians


@numba.njit(cache=True, nogil=True)
def median_sorted(values: np.ndarray) -> float:
    """Return the median of values (n,), which it sorts (Shell 1959): numba's own takes 2 s longer
    to compile."""
    gap = len(values) // 2
    while gap > 0:
        for i in range(gap, len(values)):
            value = values[i]
            j = i
            while j >= gap and values[j - gap] > value:
                values[j] = values[j - gap]
                j -= gap
            values[j] = value
        gap //= 2
    lower = values[(len(values) - 1) // 2]
    upper = values[len(values) // 2]
    return 0.5 * (lower + upper)
