"""Compiled loops of the local detector: local medians, the choice among filters, and findings about peaks."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from detectors.disjoint_sets import root_of

PLAIN: dict[str, Any] = {"cache": True, "nogil": True}
LEAST_SAMPLES = 32
"""Of a local median; with fewer it is NaN."""


@numba.njit(**PLAIN)
def local_medians(values: np.ndarray, rows: np.ndarray, columns: np.ndarray, half: int, stride: int) -> np.ndarray:
    """(r, c) medians of the finite values (h, w) in windows of 2 ``half`` + 1 pixels about the nodes, every
    ``stride``-th along both axes."""
    h, w = values.shape
    medians = np.full((len(rows), len(columns)), np.nan)
    side = 2 * (half // stride) + 1
    held = np.empty(side * side, values.dtype)
    reach = half // stride * stride
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            n = 0
            for y in range(row - reach, row + reach + 1, stride):
                if 0 <= y < h:
                    for x in range(column - reach, column + reach + 1, stride):
                        if 0 <= x < w and np.isfinite(values[y, x]):
                            held[n] = values[y, x]
                            n += 1
            if n >= LEAST_SAMPLES:
                medians[i, j] = np.median(held[:n])
    return medians


@numba.njit(**PLAIN)
def strongest(
    means: np.ndarray, around: np.ndarray, deviation: np.ndarray, seen: np.ndarray, share: float, margin: float
) -> np.ndarray:
    """(h, w) the largest (mean - around) / deviation in size, with its sign, over filters (k, h, w) from narrow to
    wide; 0 where no filter has its say.

    A wide filter reaches over what lies beside it. So it has its full say only where all narrower means, ``means[:k]``,
    depart from the same surroundings by ``share`` of what its own does, less ``margin`` of their deviations; and none
    where one departs by half as much.
    """
    filters, h, w = means.shape
    best = np.zeros((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            if not seen[y, x]:
                continue
            for k in range(filters):
                signal = means[k, y, x] - around[k, y, x]
                score = signal / deviation[k, y, x]
                say = 1.0
                for j in range(k):
                    if abs(score) * say <= abs(best[y, x]):
                        break
                    confirmed = (means[j, y, x] - around[k, y, x]) / signal + margin * deviation[j, y, x] / abs(signal)
                    say = min(say, max(2.0 * confirmed / share - 1.0, 0.0))
                if abs(score) * say > abs(best[y, x]):
                    best[y, x] = score * say
    return best


@numba.njit(**PLAIN)
def peaks(score: np.ndarray, order: np.ndarray, saddle: float, prominence: float) -> np.ndarray:
    """(n,) for each of the pixels ``order`` (n,), flat indices in falling order of size of the score (h, w), the place
    in ``order`` of the peak that it belongs to.

    Pixels join the highest neighbouring peak of their sign. Two peaks that meet become one where the pixel at which
    they meet is higher than ``saddle`` times the lower peak, or lies less than ``prominence`` below it.
    """
    h, w = score.shape
    place = np.full(h * w, -1, np.int64)
    parents = np.empty(len(order), np.int64)
    met = np.empty(8, np.int64)
    flat = score.ravel()
    for n in range(len(order)):
        pixel = order[n]
        parents[n] = n
        place[pixel] = n
        row, column = pixel // w, pixel % w
        count = 0
        for y in range(max(row - 1, 0), min(row + 2, h)):
            for x in range(max(column - 1, 0), min(column + 2, w)):
                neighbour = place[y * w + x]
                if neighbour >= 0 and neighbour != n and (flat[y * w + x] > 0) == (flat[pixel] > 0):
                    met[count] = root_of(parents, neighbour)
                    count += 1
        if count == 0:
            continue
        # an earlier place is a higher peak
        highest = met[:count].min()
        parents[n] = highest
        height = abs(flat[pixel])
        for other in met[:count]:
            top = abs(flat[order[other]])
            if other != highest and (height > saddle * top or top - height < prominence):
                parents[other] = highest
    for n in range(len(order)):
        parents[n] = root_of(parents, n)
    return parents
