"""Clusters of points by Euclidean distance, at one threshold of their scores or at several at once: as the threshold
falls clusters only grow and join. Points stand in cells so small that all points of one belong together."""

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
    alike = np.zeros(len(finite))
    labels[finite] = nested_clusters(points_m[finite], alike, distance_m, min_points, np.array([-1.0]))[0][0]
    return labels


def nested_clusters(
    points_m: np.ndarray, scores: np.ndarray, distance_m: float, min_points: int, thresholds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Label finite points (n, 3) as `euclidean_clusters` does, those with a score (n,) above each of ``thresholds``
    (t,), which rise: (t, n) int64, -1 also for the others. And return (t, n) by label the lowest threshold at which its
    cluster is no longer found, as parts of it that are large enough remain longest."""
    if not len(points_m):
        return np.zeros((len(thresholds), 0), np.int64), np.zeros((len(thresholds), 0))
    # a little below distance / sqrt(3): rounding must not put two points of one cell beyond the distance
    cells = np.floor((points_m - points_m.min(axis=0)) / (distance_m / np.sqrt(3.0) * (1.0 - 1e-9)))
    if cells.max() >= MAX_CELLS:
        what = f"points spread over {np.ptp(points_m, axis=0).max():.3g} m cannot be clustered with a distance of"
        fix = "crop the cloud, check its unit, or choose a larger cluster distance"
        raise UserError(f"{what} {distance_m * 1e3:.3g} mm", fix=fix)
    x, y, z = cells.astype(np.int64).T
    falling = np.argsort(-scores, kind="stable")
    key = ((x << 42) | (y << 21) | z)[falling]
    by_cell = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[by_cell], prepend=-1))
    order = falling[by_cell]  # the points of a cell, one cell after another, the highest score first
    near = cKDTree(cells[order[starts]]).query_pairs(2.5, p=np.inf, output_type="ndarray")
    near = np.concatenate([near, near[:, ::-1]])
    near = near[np.argsort(near[:, 0], kind="stable")]
    ends = np.searchsorted(near[:, 0], np.arange(len(starts) + 1))
    return _nested(
        points_m, scores, falling, order, np.append(starts, len(order)), ends, near[:, 1].copy(), distance_m**2,
        min_points, thresholds,
    )  # fmt: skip


@numba.njit(**PLAIN)
def root_of(parent: np.ndarray, i: int) -> int:
    """Return the root of a node in a forest of ``parent`` nodes, whose paths it shortens."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@numba.njit(**PLAIN)
def _nested(  # type: ignore[no-untyped-def]
    points, scores, falling, order, starts, ends, near, limit, least, thresholds
):
    """`nested_clusters` of points of which each cell c holds those at ``order[starts[c]:starts[c + 1]]`` and is near to
    the cells ``near[ends[c]:ends[c + 1]]``. ``limit``: the distance squared. ``falling``: the points by score."""
    n = len(falling)
    parent, sizes, held = np.arange(len(starts) - 1), np.zeros(len(starts) - 1, np.int64), np.zeros_like(starts)
    completed, cell = np.full(len(parent), -np.inf), np.empty_like(falling)
    labels, strengths = np.full((len(thresholds), n), -1, np.int64), np.zeros((len(thresholds), n))
    for c in range(len(parent)):
        cell[order[starts[c] : starts[c + 1]]] = c
    done = 0
    for level in range(len(thresholds) - 1, -1, -1):
        while done < n and scores[falling[done]] > thresholds[level]:
            i = falling[done]
            done += 1
            own = cell[i]
            root = root_of(parent, own)
            held[own] += 1
            sizes[root] += 1
            for c in near[ends[own] : ends[own + 1]]:
                if held[c] and root_of(parent, c) != root and _touches(points, i, order, starts[c], held[c], limit):
                    other = root_of(parent, c)
                    parent[other] = root
                    sizes[root] += sizes[other]
                    completed[root] = max(completed[root], completed[other])
            if sizes[root] >= least:
                completed[root] = max(completed[root], scores[i])
        names, count = np.full(len(parent), -1, np.int64), 0
        for i in range(n):
            if scores[i] > thresholds[level]:
                root = root_of(parent, cell[i])
                if names[root] < 0 and sizes[root] >= least:
                    names[root] = count
                    strengths[level, count] = completed[root]
                    count += 1
                labels[level, i] = names[root]
    return labels, strengths


@numba.njit(**PLAIN)
def _touches(points: np.ndarray, i: int, order: np.ndarray, start: int, held: int, limit: float) -> bool:
    for j in order[start : start + held]:
        dx, dy, dz = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
        if dx * dx + dy * dy + dz * dz <= limit:
            return True
    return False
