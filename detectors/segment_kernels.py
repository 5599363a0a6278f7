"""Compiled inner loops of clustering: cells that hold points, and which of them belong together.

Cells have a side of a little under distance / sqrt(3), so that the points of one all belong together and a point within
the distance lies at most two cells away. They are numbered by their first point.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from detectors.disjoint_sets import root_of

PLAIN: dict[str, Any] = {"cache": True, "nogil": True}
SPREAD = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio: a product's high bits scatter neighbouring keys (Knuth, The Art of Computer Programming
3, 6.4)."""


def _half_of_the_neighbours() -> np.ndarray:
    """(62,) differences of keys: of each two opposite neighbours one, the nearest first, whose points most likely are
    within the distance: cells that belong together already need no look at their points."""
    near = range(-2, 3)
    steps = [(x * x + y * y + z * z, (x << 42) + (y << 21) + z) for x in near for y in near for z in near]
    return np.array([step for _, step in sorted(steps) if step > 0], dtype=np.int64)


NEIGHBOURS = _half_of_the_neighbours()


@numba.njit(**PLAIN)
def _slot(key: int, keys: np.ndarray, table: np.ndarray) -> Any:
    """Where a key stands in the table of cell numbers, or the free slot (-1) where it would."""
    mask = len(table) - 1
    slot = np.int64((np.uint64(key) * SPREAD) >> np.uint64(32)) & mask
    while table[slot] >= 0 and keys[table[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@numba.njit(**PLAIN)
def occupied_cells(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number of the cell of each point (n,), and each numbered cell's key (c,), of points' cells (n, 3)."""
    n = len(cells)
    size = 8
    while size < 2 * n:
        size *= 2
    table = np.full(size, -1, dtype=np.int32)
    keys = np.empty(n, dtype=np.int64)
    cell_of = np.empty(n, dtype=np.int64)
    count = 0
    for i in range(n):
        key = (cells[i, 0] << 42) | (cells[i, 1] << 21) | cells[i, 2]
        slot = _slot(key, keys, table)
        if table[slot] < 0:
            table[slot] = count
            keys[count] = key
            count += 1
        cell_of[i] = table[slot]
    return cell_of, keys[:count].copy()


@numba.njit(**PLAIN)
def grouped(cell_of: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Points' numbers (n,) by cell, in their order within each, and where each cell begins (c + 1,)."""
    starts = np.zeros(cells + 1, dtype=np.int64)
    for cell in cell_of:
        starts[cell + 1] += 1
    for cell in range(cells):
        starts[cell + 1] += starts[cell]
    order = np.empty(len(cell_of), dtype=np.int64)
    place = starts[:-1].copy()
    for i in range(len(cell_of)):
        order[place[cell_of[i]]] = i
        place[cell_of[i]] += 1
    return order, starts


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
def _neighbours(keys: np.ndarray) -> np.ndarray:
    """(m, 2) pairs of cells at most two apart along each axis, the nearest first."""
    order = np.argsort(keys)
    rising = keys[order]
    pairs = np.empty((len(keys) * len(NEIGHBOURS), 2), dtype=np.int32)
    count = 0
    for step in NEIGHBOURS:
        other = 0
        for one in range(len(rising)):
            while other < len(rising) and rising[other] < rising[one] + step:
                other += 1
            if other < len(rising) and rising[other] == rising[one] + step:
                pairs[count, 0], pairs[count, 1] = order[one], order[other]
                count += 1
    return pairs[:count]


@numba.njit(**PLAIN)
def joined_cells(points: np.ndarray, starts: np.ndarray, keys: np.ndarray, distance: float) -> np.ndarray:
    """(c,) the first cell of those that belong with each; ``points`` sorted by cell."""
    parents = np.arange(len(keys))
    limit = distance * distance
    for c, o in _neighbours(keys):
        ours, theirs = root_of(parents, c), root_of(parents, o)
        if ours != theirs and _any_pair_within(points, starts[c], starts[c + 1], starts[o], starts[o + 1], limit):
            parents[max(ours, theirs)] = min(ours, theirs)
    for c in range(len(keys)):
        parents[c] = root_of(parents, c)
    return parents


@numba.njit(**PLAIN)
def names_of(roots: np.ndarray, cell_of: np.ndarray, min_points: int) -> np.ndarray:
    """(n,) 0, 1, ... in the order of the clusters' first points; -1 for clusters smaller than ``min_points``."""
    sizes = np.zeros(len(roots), dtype=np.int64)
    for cell in cell_of:
        sizes[roots[cell]] += 1
    names = np.full(len(roots), -1, dtype=np.int64)
    count = 0
    for root in range(len(roots)):
        if sizes[root] >= min_points and sizes[root] > 0:
            names[root] = count
            count += 1
    labels = np.empty(len(cell_of), dtype=np.int64)
    for i in range(len(cell_of)):
        labels[i] = names[roots[cell_of[i]]]
    return labels


@numba.njit(**PLAIN)
def _adjacent(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Occupied neighbours of each cell, both ways, one list after another, and where each begins (c + 1,)."""
    pairs = _neighbours(keys)
    starts = np.zeros(len(keys) + 1, dtype=np.int64)
    for a, b in pairs:
        starts[a + 1] += 1
        starts[b + 1] += 1
    for c in range(len(keys)):
        starts[c + 1] += starts[c]
    adjacent = np.empty(2 * len(pairs), dtype=np.int32)
    place = starts[:-1].copy()
    for a, b in pairs:
        adjacent[place[a]], adjacent[place[b]] = b, a
        place[a] += 1
        place[b] += 1
    return adjacent, starts


@numba.njit(**PLAIN)
def _more_extreme(points: np.ndarray, way: int, one: int, other: int) -> bool:
    """Whether a point lies farther west, east, north or south (``way`` 0 to 3) than another, or as far and is first."""
    a, b = points[one, way // 2], points[other, way // 2]
    if a == b:
        return one < other
    return a < b if way % 2 == 0 else a > b


@numba.njit(**PLAIN)
def _take_in(
    points: np.ndarray,
    root: int,
    new: np.ndarray,
    count: int,
    score: float,
    size: np.ndarray,
    highest: np.ndarray,
    extreme: np.ndarray,
) -> None:
    """Add ``count`` points to a cluster, of which ``new`` (5,) are the extreme ones in the four ways and the first."""
    for way in range(4):
        if extreme[root, way] < 0 or _more_extreme(points, way, new[way], extreme[root, way]):
            extreme[root, way] = new[way]
    if extreme[root, 4] < 0 or new[4] < extreme[root, 4]:
        extreme[root, 4] = new[4]
    size[root] += count
    highest[root] = max(highest[root], score)


@numba.njit(**PLAIN)
def clusters_by_level(
    points: np.ndarray,
    scores: np.ndarray,
    level: np.ndarray,
    order: np.ndarray,
    starts: np.ndarray,
    keys: np.ndarray,
    levels: int,
    distance: float,
    min_points: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Clusters of the points (n, 3) above each level, from the highest down.

    ``level`` (n,): 1 to ``levels``; a point takes part in the levels below its own. ``order``, ``starts``: of
    `grouped`, each cell's points from the highest level down. Returns for each cluster (m,) its level and its highest
    score, and (m, 5) its points farthest west, east, north and south and its first.
    """
    cells = len(keys)
    adjacent, begins = _adjacent(keys)
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
                _take_in(points, root_of(parents, c), alone, 1, scores[i], size, highest, extreme)
        for c in range(cells):
            new, end = starts[c] + before[c], starts[c] + there[c]
            ours = root_of(parents, c)
            for k in range(begins[c], begins[c + 1] if end > new else begins[c]):
                o = adjacent[k]
                theirs = root_of(parents, o) if there[o] > 0 else ours
                if ours != theirs and _any_pair_within(by_cell, new, end, starts[o], starts[o] + there[o], limit):
                    ours, gone = min(ours, theirs), max(ours, theirs)
                    parents[gone] = ours
                    _take_in(points, ours, extreme[gone], size[gone], highest[gone], size, highest, extreme)
        for c in range(cells):
            if parents[c] == c and size[c] >= max(min_points, 1):
                if count == len(at):
                    at, peak, named = np.append(at, at), np.append(peak, peak), np.concatenate((named, named))
                at[count], peak[count], named[count] = now, highest[c], extreme[c]
                count += 1
    return at[:count], peak[:count], named[:count]
