"""A tree of boxes over triangles: the first triangle that a ray meets, and the closest point.

Middles of triangles are halved across the part's longest side, halves again, and so on; each
second cut makes four nodes, whose boxes are compared at once: half of the time of a binary tree
along a Morton curve. The root is node 0, and node i has the children 4 i + 1 to 4 i + 4."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

LEAF = 2  # triangles of a leaf
CHILDREN = 4
MOST_WAITING = 64  # nodes that wait while one is visited: three for each level
# rows of boxes: the lowest x, y and z, then the highest
HIGH = 3
# a ray that passes between two triangles by rounding meets both; a share of a triangle's side
ON_EDGE = 1e-12
# a flat box is entered where it is left, but for rounding
FLAT = 1.0 + 4e-16
WIDER = 1.0 + 1e-12  # of the square of a distance that was computed in another way
FINITE = np.finfo(float).max  # a box at an infinite distance is not entered
PLAIN: dict[str, Any] = {"cache": True, "nogil": True}  # options of compiled functions


class TriangleTree(NamedTuple):
    """Triangles and the boxes around them."""

    # (m, 3, 3): the corners of each triangle, leaf by leaf
    corners: np.ndarray
    # (m,): the number of each of them in the list that the tree is made of
    numbers: np.ndarray
    # (nodes above the leaves, 6, 4): the boxes of each one's children; infinite and minus infinite
    # around no triangle
    boxes: np.ndarray


def tree_of(corners: np.ndarray) -> TriangleTree:
    """Return the tree of triangles (m, 3, 3), which must be finite and at least one."""
    count = len(corners)
    leaves = 1
    while leaves * LEAF < count:
        leaves *= CHILDREN
    order = _leaf_by_leaf(corners.mean(axis=1), leaves)
    ordered = np.ascontiguousarray(corners[order], dtype=np.float64)
    lows = np.full((leaves, 3), np.inf)
    highs = np.full((leaves, 3), -np.inf)
    starts = np.arange(0, count, LEAF)
    lows[: len(starts)] = np.minimum.reduceat(ordered.min(axis=1), starts)
    highs[: len(starts)] = np.maximum.reduceat(ordered.max(axis=1), starts)
    levels = [np.empty((0, 2 * HIGH, CHILDREN))]
    while len(lows) > 1:
        child_lows = lows.reshape(-1, CHILDREN, 3)
        child_highs = highs.reshape(-1, CHILDREN, 3)
        levels.append(np.concatenate([child_lows, child_highs], axis=2).swapaxes(1, 2))
        lows = child_lows.min(axis=1)
        highs = child_highs.max(axis=1)
    return TriangleTree(ordered, order, np.ascontiguousarray(np.concatenate(levels[::-1])))


def _leaf_by_leaf(middles: np.ndarray, leaves: int) -> np.ndarray:
    """Return the numbers of triangles with these middles (m, 3) in the order of their leaves, of
    which all but the last are full."""
    count = len(middles)
    padded = np.concatenate([middles, np.full((leaves * LEAF - count, 3), np.inf)])
    order = np.arange(len(padded))[None]
    sides_m = np.ptp(middles, axis=0)
    while order.shape[1] > LEAF:
        axis = int(sides_m.argmax())
        sides_m[axis] /= 2
        half = order.shape[1] // 2
        lower_first = np.argpartition(padded[order, axis], half - 1, axis=1)
        order = np.take_along_axis(order, lower_first, axis=1).reshape(-1, half)
    return order.ravel()[:count]


def first_hits(
    tree: TriangleTree, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the number (n,) of the first triangle that each ray meets from either side, -1 for
    none, and the shares (n, 3) of its corners in the place. Of triangles at the same distance, the
    first in the list counts. Rays: from (n, 3) along (n, 3), of any length."""
    starts = np.ascontiguousarray(origins, float)
    along = np.ascontiguousarray(directions, float)
    return _first_hits(*tree, starts, along)


def closest_places(
    tree: TriangleTree, points: np.ndarray, known: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the number (n,) of the triangle closest to each point (n, 3), and the place (n, 3) on
    it. At the same distance, the first in the list counts. The points must be finite.

    ``known`` (n, 3): any places on the triangles; those close to the points make it quicker."""
    if known is None:
        known = np.empty((0, 3))
    return _closest_places(*tree, np.ascontiguousarray(points, float), known)


# Compiled code reads places as triples of numbers: a row of an array would be an object of its own,
# which costs more than the arithmetic.
Vector = tuple[float, float, float]


@numba.njit(**PLAIN)
def _first_hits(
    corners: np.ndarray,
    numbers: np.ndarray,
    boxes: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    first = np.full(len(origins), -1, np.int64)
    shares = np.zeros((len(origins), 3))
    waiting = np.empty(MOST_WAITING, np.int64)
    waits_at = np.empty(MOST_WAITING)
    entries = np.empty(CHILDREN)
    for i in range(len(origins)):
        origin = _row(origins, i)
        direction = _row(directions, i)
        # its comparisons would let it into every box
        if np.isnan(_dot(origin, direction)):
            continue
        reciprocal = (_inverse(direction[0]), _inverse(direction[1]), _inverse(direction[2]))
        is_oblique = reciprocal[0] != 0.0 and reciprocal[1] != 0.0 and reciprocal[2] != 0.0
        nearest = np.inf
        size = _begin(waiting, waits_at)
        while True:
            size = _still_waiting(waits_at, size, nearest) - 1
            if size < 0:
                break
            node = waiting[size]
            if node >= len(boxes):
                for j in _triangles_of(node, boxes, corners):
                    distance, u, v = _met(corners, j, origin, direction)
                    is_first = distance == nearest and numbers[j] < first[i]
                    if distance < nearest or (is_first and distance < np.inf):
                        nearest = distance
                        first[i] = numbers[j]
                        shares[i, 0] = 1.0 - u - v
                        shares[i, 1] = u
                        shares[i, 2] = v
                continue
            if is_oblique:
                _enter(boxes, node, origin, reciprocal, entries)
            else:
                for child in range(CHILDREN):
                    entries[child] = _entry(boxes, node, child, origin, reciprocal)
            size = _wait(waiting, waits_at, size, node, entries, min(nearest, FINITE))
    return first, shares


@numba.njit(inline="always", **PLAIN)
def _row(places: np.ndarray, i: int) -> Vector:
    """Return one of places (n, 3)."""
    return places[i, 0], places[i, 1], places[i, 2]


@numba.njit(inline="always", **PLAIN)
def _corner(corners: np.ndarray, j: int, number: int) -> Vector:
    """Return a corner of one of triangles (m, 3, 3)."""
    return corners[j, number, 0], corners[j, number, 1], corners[j, number, 2]


@numba.njit(inline="always", **PLAIN)
def _begin(waiting: np.ndarray, waits_at: np.ndarray) -> int:
    """Let the root alone wait. Return how many nodes then wait."""
    waiting[0] = 0
    waits_at[0] = 0.0
    return 1


@numba.njit(inline="always", **PLAIN)
def _still_waiting(waits_at: np.ndarray, size: int, farthest: float) -> int:
    """Return how many of ``size`` nodes wait once those at the end that are farther than
    ``farthest`` are dropped."""
    while size > 0 and waits_at[size - 1] > farthest:
        size -= 1
    return size


@numba.njit(inline="always", **PLAIN)
def _triangles_of(leaf: int, boxes: np.ndarray, corners: np.ndarray) -> range:
    """Return the places of a leaf's triangles in the tree."""
    first = (leaf - len(boxes)) * LEAF
    return range(first, min(first + LEAF, len(corners)))


@numba.njit(inline="always", **PLAIN)
def _wait(
    waiting: np.ndarray,
    waits_at: np.ndarray,
    size: int,
    node: int,
    distances: np.ndarray,
    farthest: float,
) -> int:
    """Let the children of a node wait that are no farther than ``farthest``, the nearest at the
    end. Return how many nodes then wait."""
    end = size
    for child in range(CHILDREN):
        distance = distances[child]
        if distance <= farthest:
            place = end
            while place > size and waits_at[place - 1] < distance:
                waits_at[place] = waits_at[place - 1]
                waiting[place] = waiting[place - 1]
                place -= 1
            waits_at[place] = distance
            waiting[place] = CHILDREN * node + 1 + child
            end += 1
    return end


@numba.njit(inline="always", **PLAIN)
def _inverse(component: float) -> float:
    """Return the reciprocal of a ray's component; 0 for a ray across the axis."""
    if component == 0.0:
        return 0.0
    return 1.0 / component


@numba.njit(inline="always", **PLAIN)
def _entry(boxes: np.ndarray, node: int, child: int, origin: Vector, reciprocal: Vector) -> float:
    """Return where a ray enters the box of a node's child, at least 0; infinite if it does not."""
    entry = 0.0
    leave = np.inf
    for axis in range(3):
        low = boxes[node, axis, child]
        high = boxes[node, HIGH + axis, child]
        if reciprocal[axis] == 0.0:
            if origin[axis] < low or origin[axis] > high:
                return np.inf
            continue
        to_low = (low - origin[axis]) * reciprocal[axis]
        to_high = (high - origin[axis]) * reciprocal[axis]
        first = to_low if reciprocal[axis] > 0.0 else to_high
        last = to_high if reciprocal[axis] > 0.0 else to_low
        entry = first if first > entry else entry
        leave = last if last < leave else leave
    return entry if entry <= leave * FLAT else np.inf


@numba.njit(inline="always", **PLAIN)
def _enter(
    boxes: np.ndarray, node: int, origin: Vector, reciprocal: Vector, entries: np.ndarray
) -> None:
    """Set ``entries`` (4,) to the `_entry` into each child of a node, for a ray across no axis:
    without branches, so that all four are computed at once."""
    x, y, z = origin
    per_x, per_y, per_z = reciprocal
    near_x = 0 if per_x > 0.0 else HIGH
    near_y = 1 if per_y > 0.0 else HIGH + 1
    near_z = 2 if per_z > 0.0 else HIGH + 2
    far_x = HIGH - near_x
    far_y = HIGH + 2 - near_y
    far_z = HIGH + 4 - near_z
    for child in range(CHILDREN):
        first_x = (boxes[node, near_x, child] - x) * per_x
        first_y = (boxes[node, near_y, child] - y) * per_y
        first_z = (boxes[node, near_z, child] - z) * per_z
        last_x = (boxes[node, far_x, child] - x) * per_x
        last_y = (boxes[node, far_y, child] - y) * per_y
        last_z = (boxes[node, far_z, child] - z) * per_z
        entry = first_x if first_x > 0.0 else 0.0
        entry = first_y if first_y > entry else entry
        entry = first_z if first_z > entry else entry
        leave = last_x if last_x < last_y else last_y
        leave = last_z if last_z < leave else leave
        entries[child] = entry if entry <= leave * FLAT else np.inf


@numba.njit(inline="always", **PLAIN)
def _met(corners: np.ndarray, j: int, origin: Vector, direction: Vector) -> Vector:
    """Return where a ray meets a triangle, in lengths of its direction, infinite if it does not,
    and the shares of the second and third corner (Moeller and Trumbore 1997)."""
    first = _corner(corners, j, 0)
    second = _minus(_corner(corners, j, 1), first)
    third = _minus(_corner(corners, j, 2), first)
    start = _minus(origin, first)
    across = _cross(direction, third)
    volume = _dot(second, across)
    if volume == 0.0:
        return np.inf, 0.0, 0.0
    u = _dot(start, across) / volume
    around = _cross(start, second)
    v = _dot(direction, around) / volume
    distance = _dot(third, around) / volume
    is_inside = u >= -ON_EDGE and v >= -ON_EDGE and u + v <= 1.0 + ON_EDGE
    if is_inside and distance >= 0.0:
        return distance, u, v
    return np.inf, 0.0, 0.0


@numba.njit(**PLAIN)
def _closest_places(
    corners: np.ndarray,
    numbers: np.ndarray,
    boxes: np.ndarray,
    points: np.ndarray,
    known: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    closest = np.full(len(points), -1, np.int64)
    feet = np.zeros((len(points), 3))
    waiting = np.empty(MOST_WAITING, np.int64)
    waits_at = np.empty(MOST_WAITING)
    squares = np.empty(CHILDREN)
    for i in range(len(points)):
        point = _row(points, i)
        farthest = np.inf
        if len(known) > 0:
            farthest = WIDER * _square_off(_row(known, i), point)
        elif i > 0:  # the place closest to the point before it bounds the search
            farthest = WIDER * _square_off(_row(feet, i - 1), point)
        number, place = _closest_within(
            corners, numbers, boxes, point, farthest, waiting, waits_at, squares
        )
        if number < 0:  # by rounding, if the known place is the point itself
            number, place = _closest_within(
                corners, numbers, boxes, point, np.inf, waiting, waits_at, squares
            )
        closest[i] = number
        feet[i, 0] = place[0]
        feet[i, 1] = place[1]
        feet[i, 2] = place[2]
    return closest, feet


@numba.njit(**PLAIN)
def _closest_within(
    corners: np.ndarray,
    numbers: np.ndarray,
    boxes: np.ndarray,
    point: Vector,
    farthest: float,
    waiting: np.ndarray,
    waits_at: np.ndarray,
    squares: np.ndarray,
) -> tuple[int, Vector]:
    """Return the number of the triangle closest to a point, and the place on it; -1 if the square
    of every distance is larger than ``farthest``. The last three arrays are for its own use."""
    closest = -1
    foot = (0.0, 0.0, 0.0)
    nearest = farthest
    size = _begin(waiting, waits_at)
    while True:
        size = _still_waiting(waits_at, size, nearest) - 1
        if size < 0:
            break
        node = waiting[size]
        if node >= len(boxes):
            for j in _triangles_of(node, boxes, corners):
                place = _closest(corners, j, point)
                square = _square_off(place, point)
                is_first = square == nearest and (closest < 0 or numbers[j] < closest)
                if square < nearest or is_first:
                    nearest = square
                    closest = numbers[j]
                    foot = place
            continue
        for child in range(CHILDREN):
            squares[child] = 0.0
            for axis in range(3):
                below = boxes[node, axis, child] - point[axis]
                above = point[axis] - boxes[node, HIGH + axis, child]
                off = max(below, above, 0.0)
                squares[child] += off * off
        size = _wait(waiting, waits_at, size, node, squares, min(nearest, FINITE))
    return closest, foot


@numba.njit(inline="always", **PLAIN)
def _square_off(place: Vector, point: Vector) -> float:
    """Return the square of a point's distance from a place."""
    square = 0.0
    for axis in range(3):
        off = max(place[axis] - point[axis], point[axis] - place[axis], 0.0)
        square += off * off
    return square


@numba.njit(inline="always", **PLAIN)
def _closest(corners: np.ndarray, j: int, point: Vector) -> Vector:
    """Return the place on a triangle that is closest to a point (Ericson 2005, 5.1.5)."""
    first = _corner(corners, j, 0)
    second = _corner(corners, j, 1)
    third = _corner(corners, j, 2)
    second_side = _minus(second, first)
    third_side = _minus(third, first)
    d1 = _dot(second_side, _minus(point, first))
    d2 = _dot(third_side, _minus(point, first))
    d3 = _dot(second_side, _minus(point, second))
    d4 = _dot(third_side, _minus(point, second))
    d5 = _dot(second_side, _minus(point, third))
    d6 = _dot(third_side, _minus(point, third))
    # twice the areas that the point makes with each side, of the sign of the triangle's own
    opposite_third = d1 * d4 - d3 * d2
    opposite_second = d5 * d2 - d1 * d6
    opposite_first = d3 * d6 - d5 * d4
    u = 0.0
    v = 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        pass
    elif d3 >= 0.0 and d4 <= d3:
        u = 1.0
    elif d6 >= 0.0 and d5 <= d6:
        v = 1.0
    elif opposite_third <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        u = d1 / (d1 - d3)
    elif opposite_second <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v = d2 / (d2 - d6)
    elif opposite_first <= 0.0 and d4 >= d3 and d5 >= d6:
        v = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        u = 1.0 - v
    else:
        area = opposite_first + opposite_second + opposite_third
        u = opposite_second / area
        v = opposite_third / area
    x = first[0] + u * second_side[0] + v * third_side[0]
    y = first[1] + u * second_side[1] + v * third_side[1]
    z = first[2] + u * second_side[2] + v * third_side[2]
    return x, y, z


@numba.njit(inline="always", **PLAIN)
def _minus(a: Vector, b: Vector) -> Vector:
    """Return the difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@numba.njit(inline="always", **PLAIN)
def _dot(a: Vector, b: Vector) -> float:
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(inline="always", **PLAIN)
def _cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product of two vectors."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    z = a[0] * b[1] - a[1] * b[0]
    return x, y, z
