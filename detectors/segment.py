"""Clusters of points by Euclidean distance."""

from __future__ import annotations

import numba
import numpy as np

from harness.vocabulary.errors import UserError

MAX_CELLS = 1 << 20
"""Cells along one axis that a 63-bit key of three axes can hold with room for the neighbours' offsets."""


def euclidean_clusters(points_m: np.ndarray, distance_m: float, min_points: int = 1) -> np.ndarray:
    """Label points (n, 3) so that two share a cluster if a chain of steps no longer than ``distance_m`` joins them.

    The semantics of MATLAB's ``pcsegdist``: single linkage, points of different clusters are farther apart than the
    distance. Returns (n,) int64: 0, 1, ... in the order of each cluster's first point, -1 for points with a NaN and for
    clusters smaller than ``min_points``. Exact; a grid of cells of side distance / sqrt(3) (whose points all belong
    together) leaves few pairs to test, so the cost hardly depends on the density.

    Raises UserError where the points spread over more than 2^20 cells along an axis.
    """
    labels = np.full(len(points_m), -1, dtype=np.int64)
    finite = np.flatnonzero(np.isfinite(points_m).all(axis=1))
    if len(finite) == 0:
        return labels
    points = np.ascontiguousarray(points_m[finite], dtype=np.float64)
    cells = _cells(points, distance_m)
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    roots = _join_cells(
        points[order], cells[order[starts]], keys[order[starts]], np.append(starts, len(order)), distance_m
    )
    cell_of = np.empty(len(order), dtype=np.int64)
    cell_of[order] = np.repeat(roots, np.diff(np.append(starts, len(order))))
    labels[finite] = _in_order_of_appearance(cell_of, min_points)
    return labels


def _cells(points: np.ndarray, distance_m: float) -> np.ndarray:
    """(n, 3) int64 cell of each point, from 2 (so that neighbours' indices stay non-negative)."""
    # a little below distance / sqrt(3): rounding must not put two points of one cell beyond the distance
    side = distance_m / np.sqrt(3.0) * (1.0 - 1e-9)
    cells = np.floor((points - points.min(axis=0)) / side)
    if cells.max() >= MAX_CELLS:
        raise UserError(
            f"points spread over {np.ptp(points, axis=0).max():.3g} m cannot be clustered with a distance of"
            f" {distance_m * 1e3:.3g} mm",
            fix="crop the cloud, check its unit, or choose a larger cluster distance",
        )
    return cells.astype(np.int64) + 2


def _in_order_of_appearance(groups: np.ndarray, min_points: int) -> np.ndarray:
    """Rename group numbers to 0, 1, ... by first appearance; -1 for groups smaller than ``min_points``."""
    _, first, inverse, sizes = np.unique(groups, return_index=True, return_inverse=True, return_counts=True)
    kept = np.flatnonzero(sizes >= min_points)
    names = np.full(len(sizes), -1, dtype=np.int64)
    names[kept[np.argsort(first[kept])]] = np.arange(len(kept))
    return names[inverse]


@numba.njit(cache=True, nogil=True)
def _root(parents: np.ndarray, i: int) -> int:
    while parents[i] != i:
        parents[i] = parents[parents[i]]
        i = parents[i]
    return i


@numba.njit(cache=True, nogil=True)
def _any_pair_within(points: np.ndarray, a0: int, a1: int, b0: int, b1: int, limit: float) -> bool:
    for i in range(a0, a1):
        for j in range(b0, b1):
            dx = points[i, 0] - points[j, 0]
            dy = points[i, 1] - points[j, 1]
            dz = points[i, 2] - points[j, 2]
            if dx * dx + dy * dy + dz * dz <= limit:
                return True
    return False


@numba.njit(cache=True, nogil=True)
def _join_cells(
    points: np.ndarray, cells: np.ndarray, keys: np.ndarray, starts: np.ndarray, distance: float
) -> np.ndarray:
    """Root cell of each occupied cell; ``points`` sorted by cell, ``starts`` (c + 1,) where each cell begins."""
    n = len(keys)
    parents = np.arange(n)
    limit = distance * distance
    for c in range(n):
        # points within the distance lie at most two cells away; half of the neighbours, because links are mutual
        for dx in range(0, 3):
            for dy in range(-2, 3):
                for dz in range(-2, 3):
                    if dx == 0 and (dy < 0 or (dy == 0 and dz <= 0)):
                        continue
                    key = ((cells[c, 0] + dx) << 42) | ((cells[c, 1] + dy) << 21) | (cells[c, 2] + dz)
                    o = np.searchsorted(keys, key)
                    if o == n or keys[o] != key:
                        continue
                    ours = _root(parents, c)
                    theirs = _root(parents, o)
                    if ours != theirs and _any_pair_within(
                        points, starts[c], starts[c + 1], starts[o], starts[o + 1], limit
                    ):
                        parents[max(ours, theirs)] = min(ours, theirs)
    for c in range(n):
        parents[c] = _root(parents, c)
    return parents
