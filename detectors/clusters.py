"""Clusters of points by Euclidean distance, in cells so small that all points of one belong together."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
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
    if len(finite):
        cell, pairs, count = _linked_cells(points_m[finite], distance_m)
        graph = coo_array((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
        group = connected_components(graph, directed=False)[1][cell]
        _, first, group, sizes = np.unique(group, return_index=True, return_inverse=True, return_counts=True)
        large = np.flatnonzero(sizes >= min_points)
        names = np.full(len(sizes), -1)
        names[large[np.argsort(first[large])]] = np.arange(len(large))
        labels[finite] = names[group]
    return labels


def _linked_cells(points: np.ndarray, distance_m: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the cell (n,) of points (n, 3), the pairs (m, 2) of cells that touch, and the number of cells."""
    # a little below distance / sqrt(3): rounding must not put two points of one cell beyond the distance
    cells = np.floor((points - points.min(axis=0)) / (distance_m / np.sqrt(3.0) * (1.0 - 1e-9)))
    if cells.max() >= MAX_CELLS:
        raise UserError(
            f"points spread over {np.ptp(points, axis=0).max():.3g} m cannot be clustered with a distance of"
            f" {distance_m * 1e3:.3g} mm",
            fix="crop the cloud, check its unit, or choose a larger cluster distance",
        )
    x, y, z = cells.astype(np.int64).T
    _, first, cell = np.unique((x << 42) | (y << 21) | z, return_index=True, return_inverse=True)
    pairs = cKDTree(cells[first]).query_pairs(2.5, p=np.inf, output_type="ndarray")
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange(len(first) + 1))
    return cell, pairs[_touching(points[order], starts, pairs, distance_m**2)], len(first)


@numba.njit(**PLAIN)
def _touching(points: np.ndarray, starts: np.ndarray, pairs: np.ndarray, limit: float) -> np.ndarray:
    touching = np.zeros(len(pairs), dtype=np.bool_)
    for k, (a, b) in enumerate(pairs):
        for i in range(starts[a], starts[a + 1]):
            for j in range(starts[b], starts[b + 1]):
                dx, dy, dz = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
                if dx * dx + dy * dy + dz * dz <= limit:
                    touching[k] = True
                    break
            if touching[k]:
                break
    return touching
