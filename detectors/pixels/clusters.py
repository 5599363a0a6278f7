"""Clusters of points by Euclidean distance, at one threshold of their scores or at several.

As the threshold falls, clusters only grow and join, so that all thresholds take one pass. Points
are sorted into cubic cells so small that all points of a cell belong to one cluster; only cells up
to `NEAR_CELLS` apart may be joined."""

from typing import Any

import numba
import numpy as np

from detectors.pixels.ordering import falling_order, rising_order
from harness.vocabulary.errors import UserError

AXIS_BITS = 21  # of a cell's key that hold its number along one axis
# a cell's side is distance / sqrt(3): points farther apart than two cells never touch
NEAR_CELLS = 2
MAX_CELLS = 1 << 20  # cells along one axis that a 63-bit key of three axes can hold
PLAIN: dict[str, Any] = {"cache": True, "nogil": True}  # options of compiled functions


def euclidean_clusters(
    points_m: np.ndarray,
    distance_m: float,
    min_points: int = 1,
) -> np.ndarray:
    """Label points (n, 3): two are in one cluster if a chain of steps of at most ``distance_m``
    joins them, as in MATLAB's ``pcsegdist``. Returns (n,) int64: 0, 1, ... in the order of each
    cluster's first point, -1 for points with a NaN and in clusters smaller than ``min_points``.
    Raises UserError if the points spread over too many cells."""
    labels = np.full(len(points_m), -1, dtype=np.int64)
    finite = np.flatnonzero(np.isfinite(points_m).all(axis=1))
    equal_scores = np.zeros(len(finite))
    by_threshold, _ = nested_clusters(
        points_m[finite],
        equal_scores,
        distance_m,
        min_points,
        np.array([-1.0]),
    )
    labels[finite] = by_threshold[0]
    return labels


def nested_clusters(
    points_m: np.ndarray,
    scores: np.ndarray,
    distance_m: float,
    min_points: int,
    thresholds: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Label points with a score above each of several thresholds, as `euclidean_clusters` does.

    Args:
        points_m: (n, 3), finite.
        scores: (n,).
        distance_m: longest step within a cluster.
        min_points: fewest points of a cluster.
        thresholds: (t,), rising.

    Returns:
        labels (t, n) int64, -1 for other points; and by label (t, m) the lowest threshold at which
        no part of that cluster is found any more: parts with enough points last longest."""
    if not len(points_m):
        return np.zeros((len(thresholds), 0), np.int64), np.zeros((len(thresholds), 0))
    # slightly less than distance / sqrt(3): rounding must not put two points of a cell farther
    # apart than the distance
    cell_m = distance_m / np.sqrt(3.0) * (1.0 - 1e-9)
    cells = np.floor((points_m - points_m.min(axis=0)) / cell_m)
    if cells.max() >= MAX_CELLS:
        raise UserError(
            f"points spread over {np.ptp(points_m, axis=0).max():.3g} m cannot be clustered with a"
            f" distance of {distance_m * 1e3:.3g} mm",
            fix="crop the cloud, check its unit, or choose a larger cluster distance",
        )
    # the margin makes a neighbour's key the sum of the cell's key and the key of the offset
    x, y, z = cells.astype(np.int64).T + NEAR_CELLS
    falling = falling_order(scores)
    key = (((x << AXIS_BITS | y) << AXIS_BITS) | z)[falling]
    by_cell = rising_order(key)
    starts = np.flatnonzero(np.diff(key[by_cell], prepend=-1))
    # the points of a cell, one cell after another, the highest score first
    order = falling[by_cell]
    labels = np.full((len(thresholds), len(falling)), -1, np.int64)
    strengths = np.zeros((len(thresholds), len(starts)))
    _nested(
        points_m,
        scores,
        falling,
        order,
        np.append(starts, len(order)),
        key[by_cell[starts]],
        distance_m**2,
        min_points,
        thresholds,
        labels,
        strengths,
    )
    return labels, strengths


@numba.njit(**PLAIN)
def root_of(parent: np.ndarray, i: int) -> int:
    """Return the root of a node in a forest of ``parent`` nodes, and shorten the path to it."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@numba.njit(**PLAIN)
def _nested(  # type: ignore[no-untyped-def]
    points,
    scores,
    falling,
    order,
    starts,
    keys,
    limit,
    least,
    thresholds,
    labels,
    strengths,
):
    """Write the results of `nested_clusters` into ``labels`` and ``strengths``.

    Cell c, in the order of ``keys``, holds the points ``order[starts[c]:starts[c + 1]]``.
    ``limit``: the squared distance. ``falling``: the points by score. ``least``: fewest points of
    a cluster.

    Points are added by falling score. A forest of cells says which belong to one cluster; a cell's
    neighbour that is joined to it is taken out of its list."""
    n = len(falling)
    cells = len(keys)
    cell_of = np.zeros(n, np.int64)
    for c in range(cells):
        for k in range(starts[c], starts[c + 1]):
            cell_of[order[k]] = c
    neighbours, stops = _neighbours(keys)
    ends = stops[1:].copy()
    parent = np.arange(cells)
    sizes = np.zeros(cells, np.int64)  # points of the cluster with this root
    filled = np.zeros(cells, np.int64)  # points added to a cell
    completed = np.full(cells, -np.inf)  # by root, the score at which a part last was large enough
    added = 0
    for level in range(len(thresholds) - 1, -1, -1):
        while added < n and scores[falling[added]] > thresholds[level]:
            i = falling[added]
            added += 1
            cell = cell_of[i]
            root = root_of(parent, cell)
            filled[cell] += 1
            sizes[root] += 1
            k = stops[cell]
            while k < ends[cell]:
                c = neighbours[k]
                other_root = root_of(parent, c) if filled[c] else -1
                if other_root < 0 or (
                    other_root != root
                    and not _touches(
                        points,
                        i,
                        order,
                        starts[c],
                        filled[c],
                        limit,
                    )
                ):
                    k += 1
                    continue
                if other_root != root:
                    parent[other_root] = root
                    sizes[root] += sizes[other_root]
                    completed[root] = max(completed[root], completed[other_root])
                # what is joined stays so: the last one takes its position
                ends[cell] -= 1
                neighbours[k] = neighbours[ends[cell]]
            if sizes[root] >= least:
                completed[root] = max(completed[root], scores[i])
        # number the clusters in the order of their first points, from 1 here
        numbers = np.zeros(cells, np.int64)
        count = 0
        for i in range(n):
            if scores[i] > thresholds[level]:
                root = root_of(parent, cell_of[i])
                if numbers[root] == 0 and sizes[root] >= least:
                    strengths[level, count] = completed[root]
                    count += 1
                    numbers[root] = count
                labels[level, i] = numbers[root] - 1


@numba.njit(**PLAIN)
def _neighbours(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells up to `NEAR_CELLS` away from each cell along every axis, itself included,
    one list after another, and where each list begins (c + 1,). ``keys`` (c,): ascending.

    In each column along z, near cells are neighbours in the order of keys, and both ends of their
    range only move on from cell to cell."""
    cells = len(keys)
    side = 2 * NEAR_CELLS + 1
    neighbours = np.empty(side**3 * cells, np.int64)
    stops = np.zeros(cells + 1, np.int64)
    first = np.zeros(side**2, np.int64)
    end = np.zeros(side**2, np.int64)
    count = 0
    for c in range(cells):
        for column in range(side**2):
            x = column // side - NEAR_CELLS
            y = column % side - NEAR_CELLS
            key = keys[c] + (((x << AXIS_BITS) + y) << AXIS_BITS)
            while first[column] < cells and keys[first[column]] < key - NEAR_CELLS:
                first[column] += 1
            while end[column] < cells and keys[end[column]] <= key + NEAR_CELLS:
                end[column] += 1
            for neighbour in range(first[column], end[column]):
                neighbours[count] = neighbour
                count += 1
        stops[c + 1] = count
    return neighbours, stops


@numba.njit(**PLAIN)
def _touches(
    points: np.ndarray,
    i: int,
    order: np.ndarray,
    start: int,
    count: int,
    limit: float,
) -> bool:
    """Return whether point i is within the squared distance ``limit`` of one of the ``count``
    points in ``order`` from ``start`` on."""
    for k in range(start, start + count):
        j = order[k]
        dx = points[i, 0] - points[j, 0]
        dy = points[i, 1] - points[j, 1]
        dz = points[i, 2] - points[j, 2]
        if dx * dx + dy * dy + dz * dz <= limit:
            return True
    return False
