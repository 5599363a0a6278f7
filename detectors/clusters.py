"""Clusters of points by Euclidean distance, at one threshold or at many.

Cells have a side of a little under distance / sqrt(3), so that the points of a cell all belong together and a point
within the distance lies at most two cells away. They are numbered by their first point.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from harness.vocabulary.errors import UserError

MAX_CELLS = 1 << 20
"""Cells along one axis that a 63-bit key of three axes can hold with room for the neighbours' offsets."""
PLAIN: dict[str, Any] = {"cache": True, "nogil": True}

_NEAR = range(-2, 3)
_STEPS = [(x * x + y * y + z * z, (x << 42) + (y << 21) + z) for x in _NEAR for y in _NEAR for z in _NEAR]
NEIGHBOURS = np.array([key for _, key in sorted(_STEPS) if key > 0], dtype=np.int64)
"""Differences of keys (62,), of each two opposite neighbours the positive, the nearest first, whose points most likely
are within the distance: cells that belong together already need no look at their points."""


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
    root = _clusters(points, np.zeros(len(points)), np.ones(len(points), dtype=np.int64), 1, distance_m, min_points)[3]
    # a cluster's root is its first cell, and cells are numbered by their first point
    roots, sizes = np.unique(root, return_counts=True)
    large = roots[sizes >= min_points]
    names = np.full(roots.max() + 1, -1, dtype=np.int64)
    names[large] = np.arange(len(large))
    labels[finite] = names[root]
    return labels


def cluster_centres(
    points_m: np.ndarray, scores: np.ndarray, thresholds: np.ndarray, distance_m: float, min_points: int = 1
) -> tuple[np.ndarray, ...]:
    """Return the centres (m, 3) of the clusters at each threshold: of each, the mean of its extreme points in x and y.

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
    at, highest, named, _ = _clusters(points, strength, level, len(rising), distance_m, min_points)
    west, east, north, south = (points[named[:, way]] for way in range(4))
    centres = (west + east + north + south) / 4.0
    sorted_by_level = np.lexsort((named[:, 4], -highest, at))
    bounds = np.searchsorted(at[sorted_by_level], np.arange(len(rising) + 1))
    each = [centres[sorted_by_level[bounds[n] : bounds[n + 1]]] for n in range(len(rising))]
    return tuple(each[n] for n in np.searchsorted(rising, thresholds))


def _clusters(
    points: np.ndarray, scores: np.ndarray, level: np.ndarray, levels: int, distance_m: float, min_points: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return what `_joined_by_level` does of finite points (n, 3), and the root cell of each point (n,) at the end."""
    # a little below distance / sqrt(3): rounding must not put two points of one cell beyond the distance
    cells = np.floor((points - points.min(axis=0)) / (distance_m / np.sqrt(3.0) * (1.0 - 1e-9)))
    if cells.max() >= MAX_CELLS:
        raise UserError(
            f"points spread over {np.ptp(points, axis=0).max():.3g} m cannot be clustered with a distance of"
            f" {distance_m * 1e3:.3g} mm",
            fix="crop the cloud, check its unit, or choose a larger cluster distance",
        )
    # from 2 on, so that neighbours' indices stay non-negative
    x, y, z = (cells.astype(np.int64) + 2).T
    keys, first, cell = np.unique((x << 42) | (y << 21) | z, return_index=True, return_inverse=True)
    by_first = np.argsort(first)
    number = np.empty_like(by_first)
    number[by_first] = np.arange(len(keys))
    cell = number[cell]
    # each cell's points from the highest level down, then in their order
    order = np.lexsort((-level, cell))
    starts = np.searchsorted(cell[order], np.arange(len(keys) + 1))
    pairs = number[_neighbours(keys)]
    both = np.stack([pairs, pairs[:, ::-1]], axis=1).reshape(-1, 2)
    both = both[np.argsort(both[:, 0], kind="stable")]
    begins = np.searchsorted(both[:, 0], np.arange(len(keys) + 1))
    adjacent = np.ascontiguousarray(both[:, 1])
    *found, parents = _joined_by_level(
        points, scores, level, order, starts, adjacent, begins, levels, distance_m, min_points
    )
    return found[0], found[1], found[2], parents[cell]


@numba.njit(**PLAIN)
def root_of(parents: np.ndarray, i: int) -> int:
    """Return the root of the set that holds ``i``, each member pointing to a parent and the root to itself (Tarjan
    1975); the way to it is halved in ``parents`` (n,)."""
    while parents[i] != i:
        parents[i] = parents[parents[i]]
        i = parents[i]
    return i


@numba.njit(**PLAIN)
def _neighbours(rising: np.ndarray) -> np.ndarray:
    """Return (m, 2) pairs of cells, by the places of their ``rising`` keys, at most two apart along each axis, the
    nearest first."""
    pairs = np.empty((len(rising) * len(NEIGHBOURS), 2), dtype=np.int64)
    count = 0
    for step in NEIGHBOURS:
        other = 0
        for here in range(len(rising)):
            while other < len(rising) and rising[other] < rising[here] + step:
                other += 1
            if other < len(rising) and rising[other] == rising[here] + step:
                pairs[count, 0], pairs[count, 1] = here, other
                count += 1
    return pairs[:count]


@numba.njit(**PLAIN)
def _any_pair_within(points: np.ndarray, a0: int, a1: int, b0: int, b1: int, limit: float) -> bool:
    for i in range(a0, a1):
        for j in range(b0, b1):
            dx = points[i, 0] - points[j, 0]
            dy = points[i, 1] - points[j, 1]
            dz = points[i, 2] - points[j, 2]
            if dx * dx + dy * dy + dz * dz <= limit:
                return True
    return False


@numba.njit(**PLAIN)
def _take_in(points: np.ndarray, extreme: np.ndarray, root: int, new: np.ndarray) -> None:
    """Let a cluster's ``extreme`` (c, 5) points, farthest west, east, north and south (of equal ones the first) and
    the first, be those of ``new`` (5,) where these are more extreme."""
    for way in range(5):
        it, held = new[way], extreme[root, way]
        more = held < 0 or (way == 4 and it < held)
        if held >= 0 and way < 4:
            a, b = points[it, way // 2], points[held, way // 2]
            more = it < held if a == b else (a < b if way % 2 == 0 else a > b)
        if more:
            extreme[root, way] = it


@numba.njit(**PLAIN)
def _joined_by_level(
    points: np.ndarray,
    scores: np.ndarray,
    level: np.ndarray,
    order: np.ndarray,
    starts: np.ndarray,
    adjacent: np.ndarray,
    begins: np.ndarray,
    levels: int,
    distance: float,
    min_points: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Join the cells of the points (n, 3) above each level, from the highest down.

    ``level`` (n,): 1 to ``levels``; a point takes part in the levels below its own. ``order`` (n,), ``starts``
    (c + 1,): each cell's points from the highest level down; ``adjacent``, ``begins`` (c + 1,): its neighbours.
    Returns for each cluster (m,) its level and its highest score, and (m, 5) its points farthest west, east, north and
    south and its first; and the root (c,) of each cell at the last level.
    """
    cells = len(starts) - 1
    parents = np.arange(cells)
    there, before = np.zeros(cells, dtype=np.int64), np.zeros(cells, dtype=np.int64)
    size, highest = np.zeros(cells, dtype=np.int64), np.full(cells, -np.inf)
    extreme, alone = np.full((cells, 5), -1, dtype=np.int64), np.empty(5, dtype=np.int64)
    by_cell, limit = points[order], distance * distance
    at, peak, named = np.empty(64, dtype=np.int64), np.empty(64), np.empty((64, 5), dtype=np.int64)
    count = 0
    for now in range(levels - 1, -1, -1):
        for c in range(cells):
            before[c] = there[c]
            while starts[c] + there[c] < starts[c + 1] and level[order[starts[c] + there[c]]] > now:
                i = order[starts[c] + there[c]]
                there[c] += 1
                alone[:] = i
                root = root_of(parents, c)
                _take_in(points, extreme, root, alone)
                size[root] += 1
                highest[root] = max(highest[root], scores[i])
        for c in range(cells):
            new, end = starts[c] + before[c], starts[c] + there[c]
            ours = root_of(parents, c)
            for k in range(begins[c], begins[c + 1] if end > new else begins[c]):
                o = adjacent[k]
                theirs = root_of(parents, o) if there[o] > 0 else ours
                if ours != theirs and _any_pair_within(by_cell, new, end, starts[o], starts[o] + there[o], limit):
                    ours, gone = min(ours, theirs), max(ours, theirs)
                    parents[gone] = ours
                    _take_in(points, extreme, ours, extreme[gone])
                    size[ours] += size[gone]
                    highest[ours] = max(highest[ours], highest[gone])
        for c in range(cells):
            if parents[c] == c and size[c] >= max(min_points, 1):
                if count == len(at):
                    at, peak, named = np.append(at, at), np.append(peak, peak), np.concatenate((named, named))
                at[count], peak[count], named[count] = now, highest[c], extreme[c]
                count += 1
    for c in range(cells):
        parents[c] = root_of(parents, c)
    return at[:count], peak[:count], named[:count], parents
