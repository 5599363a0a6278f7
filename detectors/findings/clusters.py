"""Clusters of points by Euclidean distance, at one threshold of their scores or at several. As the
threshold falls, clusters only grow and join. Points are sorted into cells so small that all points
of a cell belong to one cluster."""

from typing import Any

import numba
import numpy as np

from harness.vocabulary.errors import UserError

AXIS_BITS = 21
NEAR_CELLS = 2
MAX_CELLS = 1 << 20  # cells along one axis that a 63-bit key of three axes can hold
PLAIN: dict[str, Any] = {"cache": True, "nogil": True}


def euclidean_clusters(points_m: np.ndarray, distance_m: float, min_points: int = 1) -> np.ndarray:
    """Label points (n, 3): two are in one cluster if a chain of steps of at most ``distance_m``
    joins them, as in MATLAB's ``pcsegdist``. Returns (n,) int64: 0, 1, ... in the order of each
    cluster's first point, -1 for points with a NaN and in clusters smaller than ``min_points``.
    Raises UserError if the points spread over too many cells."""
    labels = np.full(len(points_m), -1, dtype=np.int64)
    finite = np.flatnonzero(np.isfinite(points_m).all(axis=1))
    alike = np.zeros(len(finite))
    labels[finite] = nested_clusters(
        points_m[finite], alike, distance_m, min_points, np.array([-1.0])
    )[0][0]
    return labels


def nested_clusters(
    points_m: np.ndarray,
    scores: np.ndarray,
    distance_m: float,
    min_points: int,
    thresholds: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Label the finite points (n, 3) with a score (n,) above each of the rising ``thresholds``
    (t,), as `euclidean_clusters` does: (t, n) int64, -1 for the others. Also return by label, (t,
    m), the lowest threshold at which no part of that cluster is found any more: parts with enough
    points last longest."""
    if not len(points_m):
        return np.zeros((len(thresholds), 0), np.int64), np.zeros((len(thresholds), 0))
    # slightly less than distance / sqrt(3): rounding must not put two points of a cell farther
    # apart than the distance
    cells = np.floor((points_m - points_m.min(axis=0)) / (distance_m / np.sqrt(3.0) * (1.0 - 1e-9)))
    if cells.max() >= MAX_CELLS:
        what = f"points spread over {np.ptp(points_m, axis=0).max():.3g} m cannot be clustered with a distance of"
        fix = "crop the cloud, check its unit, or choose a larger cluster distance"
        raise UserError(f"{what} {distance_m * 1e3:.3g} mm", fix=fix)
    # the margin makes a neighbour's key the sum of the cell's key and the key of the offset
    x, y, z = cells.astype(np.int64).T + NEAR_CELLS
    falling = np.argsort(-scores, kind="stable")
    key = (((x << AXIS_BITS | y) << AXIS_BITS) | z)[falling]
    by_cell = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[by_cell], prepend=-1))
    order = falling[
        by_cell
    ]  # the points of a cell, one cell after another, the highest score first
    found = (
        np.full((len(thresholds), len(falling)), -1, np.int64),
        np.zeros((len(thresholds), len(starts))),
    )
    near = np.empty((2 * NEAR_CELLS + 1) ** 3 * len(starts), np.int64)
    ends = np.append(starts, len(order))
    places = points_m, scores, falling, order, ends, key[by_cell[starts]], near
    _nested(*places, distance_m**2, min_points, thresholds, *found)
    return found


@numba.njit(**PLAIN)
def root_of(parent: np.ndarray, i: int) -> int:
    """Return the root of a node in a forest of ``parent`` nodes, and shorten the path to it."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@numba.njit(**PLAIN)
def _nested(  # type: ignore[no-untyped-def]
    points, scores, falling, order, starts, keys, near, limit, least, thresholds, labels, strengths
):
    """Write the results of `nested_clusters`. Cell c, in the order of ``keys``, holds the points
    ``order[starts[c]:starts[c + 1]]``. ``limit``: the squared distance. ``falling``: the points by
    score."""
    n = len(falling)
    cells = len(keys)
    side = 2 * NEAR_CELLS + 1
    parent = np.zeros(cells, np.int64)
    sizes = np.zeros(cells, np.int64)
    held = np.zeros(cells, np.int64)
    cell = np.zeros(n, np.int64)
    stops = np.zeros(cells + 1, np.int64)
    count = 0
    # near[stops[c]:stops[c + 1]] are near cell c: in each column along z, the cells from the first
    # to the last
    first = np.zeros(side**2, np.int64)
    last = np.zeros(side**2, np.int64)
    completed = np.zeros(cells)
    for c in range(cells):
        parent[c], completed[c] = c, -np.inf
        for k in range(starts[c], starts[c + 1]):
            cell[order[k]] = c
        for column in range(side**2):
            key = keys[c] + (
                (((column // side - NEAR_CELLS) << AXIS_BITS) + column % side - NEAR_CELLS)
                << AXIS_BITS
            )
            while first[column] < cells and keys[first[column]] < key - NEAR_CELLS:
                first[column] += 1
            while last[column] < cells and keys[last[column]] <= key + NEAR_CELLS:
                last[column] += 1
            for other in range(first[column], last[column]):
                near[count] = other
                count += 1
        stops[c + 1] = count
    done = 0
    ends = stops[1:].copy()
    for level in range(len(thresholds) - 1, -1, -1):
        while done < n and scores[falling[done]] > thresholds[level]:
            i = falling[done]
            done += 1
            own = cell[i]
            root = root_of(parent, own)
            held[own] += 1
            sizes[root] += 1
            k = stops[own]
            while k < ends[own]:
                c = near[k]
                other = root_of(parent, c) if held[c] else -1
                if other < 0 or (
                    other != root and not _touches(points, i, order, starts[c], held[c], limit)
                ):
                    k += 1
                    continue
                if other != root:
                    parent[other] = root
                    sizes[root] += sizes[other]
                    completed[root] = max(completed[root], completed[other])
                # what is joined stays so: the last one takes its place
                ends[own] -= 1
                near[k] = near[ends[own]]
            if sizes[root] >= least:
                completed[root] = max(completed[root], scores[i])
        # clusters are counted from 1 here
        names = np.zeros(cells, np.int64)
        count = 0
        for i in range(n):
            if scores[i] > thresholds[level]:
                root = root_of(parent, cell[i])
                if names[root] == 0 and sizes[root] >= least:
                    strengths[level, count] = completed[root]
                    count += 1
                    names[root] = count
                labels[level, i] = names[root] - 1


@numba.njit(**PLAIN)
def _touches(
    points: np.ndarray, i: int, order: np.ndarray, start: int, held: int, limit: float
) -> bool:
    for k in range(start, start + held):
        j = order[k]
        dx = points[i, 0] - points[j, 0]
        dy = points[i, 1] - points[j, 1]
        dz = points[i, 2] - points[j, 2]
        if dx * dx + dy * dy + dz * dz <= limit:
            return True
    return False
