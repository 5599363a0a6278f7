"""Clusters of points by Euclidean distance, in cells so small that all points of one belong together."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from scipy.spatial import cKDTree

from harness.vocabulary.errors import UserError

MAX_CELLS = 1 << 20  # cells along one axis that a 63-bit key of three axes can hold
PLAIN: dict[str, Any] = {"cache": True, "nogil": True}


def euclidean_clusters(points_m: np.ndarray, distance_m: float, min_points: int = 1) -> np.ndarray:
    """Label points (n, 3) so that two share a cluster if a chain of steps no longer than ``distance_m`` joins them, as
    MATLAB's ``pcsegdist``. Returns (n,) int64: 0, 1, ... in the order of each cluster's first point, -1 for points with
    a NaN and for clusters smaller than ``min_points``. Raises UserError where the points spread over too many cells."""
    labels = np.full(len(points_m), -1, dtype=np.int64)
    finite = np.flatnonzero(np.isfinite(points_m).all(axis=1))
    if not len(finite):
        return labels
    points = points_m[finite]
    # a little below distance / sqrt(3): rounding must not put two points of one cell beyond the distance
    cells = np.floor((points - points.min(axis=0)) / (distance_m / np.sqrt(3.0) * (1.0 - 1e-9)))
    if cells.max() >= MAX_CELLS:
        raise UserError(
            f"points spread over {np.ptp(points, axis=0).max():.3g} m cannot be clustered with a distance of"
            f" {distance_m * 1e3:.3g} mm",
            fix="crop the cloud, check its unit, or choose a larger cluster distance",
        )
    x, y, z = cells.astype(np.int64).T
    key = (x << 42) | (y << 21) | z
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    pairs = cKDTree(cells[order[starts]]).query_pairs(2.5, p=np.inf, output_type="ndarray")
    labels[finite] = _joined(points, order, np.append(starts, len(order)), pairs, distance_m**2, min_points)
    return labels


@numba.njit(**PLAIN)
def root_of(parent: np.ndarray, i: int) -> int:
    """Return the root of a node in a forest of ``parent`` nodes, whose paths it shortens."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@numba.njit(**PLAIN)
def _joined(
    points: np.ndarray, order: np.ndarray, starts: np.ndarray, pairs: np.ndarray, limit: float, least: int
) -> np.ndarray:
    """Return the labels (n,) of points of which each cell c joins those at ``order[starts[c]:starts[c + 1]]``, where
    ``pairs`` (m, 2) of cells that hold points no farther apart than the root of ``limit`` are joined too."""
    parent, cell = np.arange(len(starts) - 1), np.empty_like(order)
    for c in range(len(parent)):
        cell[order[starts[c] : starts[c + 1]]] = c
    for a, b in pairs:
        if root_of(parent, a) != root_of(parent, b) and _touching(points, order, starts, a, b, limit):
            parent[root_of(parent, b)] = root_of(parent, a)
    sizes, names, labels, count = np.zeros_like(parent), np.full_like(parent, -1), np.empty_like(order), 0
    for c in range(len(parent)):
        sizes[root_of(parent, c)] += starts[c + 1] - starts[c]
    for i in range(len(cell)):
        root = root_of(parent, cell[i])
        if names[root] < 0 and sizes[root] >= least:
            names[root] = count
            count += 1
        labels[i] = names[root]
    return labels


@numba.njit(**PLAIN)
def _touching(points: np.ndarray, order: np.ndarray, starts: np.ndarray, a: int, b: int, limit: float) -> bool:
    for i in order[starts[a] : starts[a + 1]]:
        for j in order[starts[b] : starts[b + 1]]:
            dx, dy, dz = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
            if dx * dx + dy * dy + dz * dz <= limit:
                return True
    return False
