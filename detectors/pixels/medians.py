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
            medians[g] = median_of_few(members)
            deviations[g] = median_of_few(np.abs(members - medians[g])) / 0.6745
    return medians, deviations


@numba.njit(cache=True, nogil=True)
def row_medians(rows: np.ndarray) -> np.ndarray:
    """Return the median of the finite values in each of the rows (n, k); NaN without any."""
    medians = np.full(len(rows), np.nan)
    for n in range(len(rows)):
        values = rows[n][np.isfinite(rows[n])]
        if len(values):
            medians[n] = median_of_few(values)
    return medians


@numba.njit(cache=True, nogil=True)
def median_of_few(values: np.ndarray) -> float:
    """Return the median of values (n,), n >= 1, which it reorders until none before the middle is
    larger and none after it is smaller (Hoare 1961): numba's own takes 2 s longer to compile."""
    middle = len(values) // 2
    first = 0
    last = len(values) - 1
    while first < last:
        pivot = values[middle]
        low = first
        high = last
        while low <= high:
            while values[low] < pivot:
                low += 1
            while values[high] > pivot:
                high -= 1
            if low <= high:
                swapped = values[low]
                values[low] = values[high]
                values[high] = swapped
                low += 1
                high -= 1
        # the middle lies in one of the two parts, or between them in its place
        if high < middle:
            first = low
        if low > middle:
            last = high
    upper = values[middle]
    if len(values) % 2:
        return upper
    return 0.5 * (values[:middle].max() + upper)
