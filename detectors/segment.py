"""Clusters of points by Euclidean distance."""

from __future__ import annotations

import numpy as np

from detectors import segment_kernels as kernels
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
    cell_of, keys = kernels.occupied_cells(_cells(points, distance_m))
    order, starts = kernels.grouped(cell_of, len(keys))
    roots = kernels.joined_cells(points[order], starts, keys, distance_m)
    labels[finite] = kernels.names_of(roots, cell_of, min_points)
    return labels


def cluster_centres(
    points_m: np.ndarray, scores: np.ndarray, thresholds: np.ndarray, distance_m: float, min_points: int = 1
) -> tuple[np.ndarray, ...]:
    """Centres (m, 3) of the clusters at each threshold: of each, the mean of its extreme points in x and in y.

    At a threshold those of the points (n, 3) take part whose score (n,) is above it, as in `euclidean_clusters`; of
    equal extremes the first point counts. Clusters come in falling order of their highest score, then in that of their
    first point. One pass for all thresholds: a lower one only adds points, and only joins clusters.

    Raises UserError as `euclidean_clusters`.
    """
    rising = np.unique(thresholds)
    with np.errstate(invalid="ignore"):
        loud = scores > np.min(rising, initial=np.inf)
    some = np.flatnonzero(loud & np.isfinite(points_m).all(axis=1))
    if not len(some):
        return tuple(np.zeros((0, 3)) for _ in thresholds)
    points, strength = np.ascontiguousarray(points_m[some], dtype=np.float64), scores[some]
    # the number of thresholds that a point is above: 1 or more
    level = np.searchsorted(rising, strength, side="left")
    cell_of, keys = kernels.occupied_cells(_cells(points, distance_m))
    loudest_first = np.argsort(-level, kind="stable")
    order, starts = kernels.grouped(cell_of[loudest_first], len(keys))
    order = loudest_first[order]
    at, highest, named = kernels.clusters_by_level(
        points, strength, level, order, starts, keys, len(rising), distance_m, min_points
    )
    west, east, north, south = (points[named[:, way]] for way in range(4))
    centres = (west + east + north + south) / 4.0
    sorted_by_level = np.lexsort((named[:, 4], -highest, at))
    bounds = np.searchsorted(at[sorted_by_level], np.arange(len(rising) + 1))
    each = [centres[sorted_by_level[bounds[n] : bounds[n + 1]]] for n in range(len(rising))]
    return tuple(each[n] for n in np.searchsorted(rising, thresholds))


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
