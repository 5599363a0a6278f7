"""A tree of boxes over triangles: the first triangle that a ray meets, and the closest point.

The triangles are sorted along a Morton curve of their middles (Lauterbach et al. 2009), two to a
leaf; node i of a complete binary tree has the children 2 i and 2 i + 1, and the root is node 1."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

LEAF = 2  # triangles of a leaf
CURVE_BITS = 20  # of a triangle's place on the curve, along one axis
MOST_WAITING = 64  # nodes that wait while one is visited: one for each level
# a ray that passes between two triangles by rounding meets both; a share of a triangle's side
ON_EDGE = 1e-12
PLAIN: dict[str, Any] = {"cache": True, "nogil": True}  # options of compiled functions


class TriangleTree(NamedTuple):
    """Triangles and the boxes around them."""

    # (m, 3, 3): the corners of each triangle, in the order of the curve
    corners: np.ndarray
    # (m,): the number of each of them in the list that the tree is made of
    numbers: np.ndarray
    # (2 leaves, 2, 3): the lowest and the highest corner of each node's box, side by side;
    # infinite and minus infinite if it holds no triangle
    boxes: np.ndarray


def tree_of(corners: np.ndarray) -> TriangleTree:
    """Return the tree of triangles (m, 3, 3), which must be finite and at least one."""
    order = np.argsort(_along_curve(corners.mean(axis=1)), kind="stable")
    ordered = np.ascontiguousarray(corners[order], dtype=np.float64)
    leaves = 1
    while leaves * LEAF < len(ordered):
        leaves *= 2
    lows = np.full((2 * leaves, 3), np.inf)
    highs = np.full((2 * leaves, 3), -np.inf)
    starts = np.arange(0, len(ordered), LEAF)
    filled = slice(leaves, leaves + len(starts))
    lows[filled] = np.minimum.reduceat(ordered.min(axis=1), starts)
    highs[filled] = np.maximum.reduceat(ordered.max(axis=1), starts)
    first = leaves
    while first > 1:
        pairs = slice(first, 2 * first)
        first //= 2
        lows[first : 2 * first] = lows[pairs].reshape(-1, 2, 3).min(axis=1)
        highs[first : 2 * first] = highs[pairs].reshape(-1, 2, 3).max(axis=1)
    return TriangleTree(ordered, order, np.stack([lows, highs], axis=1))


def _along_curve(places: np.ndarray) -> np.ndarray:
    """Return the number of each place (n, 3) on a Morton curve: the bits of its cell, by turns."""
    low = places.min(axis=0)
    side = max(float((places.max(axis=0) - low).max()), np.finfo(float).tiny)
    cells = ((places - low) / side * (2**CURVE_BITS - 1)).astype(np.int64)
    along = np.zeros(len(places), np.int64)
    for bit in range(CURVE_BITS):
        for axis in range(3):
            along |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return along


def first_hits(
    tree: TriangleTree, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the number (n,) of the first triangle that each ray meets from either side, -1 for
    none, and the shares (n, 3) of its corners in the place. Of triangles at the same distance, the
    first in the list counts. Rays: from (n, 3) along (n, 3), of any length."""
    starts = np.ascontiguousarray(origins, float)
    along = np.ascontiguousarray(directions, float)
    return _first_hits(*tree, starts, along)


def closest_places(tree: TriangleTree, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the number (n,) of the triangle closest to each point (n, 3), and the place (n, 3) on
    it. At the same distance, the first in the list counts. The points must be finite."""
    return _closest_places(*tree, np.ascontiguousarray(points, float))


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
    leaves = len(boxes) // 2
    waiting = np.empty(MOST_WAITING, np.int64)
    for i in range(len(origins)):
        origin = _row(origins, i)
        direction = _row(directions, i)
        # its comparisons would let it into every box
        if np.isnan(_dot(origin, direction)):
            continue
        reciprocal = (_inverse(direction[0]), _inverse(direction[1]), _inverse(direction[2]))
        nearest = np.inf
        waiting[0] = 1
        size = 1 if _entry(boxes, 1, origin, reciprocal) < np.inf else 0
        while size > 0:
            size -= 1
            node = waiting[size]
            if node >= leaves:
                begin = (node - leaves) * LEAF
                for j in range(begin, min(begin + LEAF, len(corners))):
                    distance, u, v = _met(corners, j, origin, direction)
                    is_first = distance == nearest and numbers[j] < first[i]
                    if distance < nearest or (is_first and distance < np.inf):
                        nearest = distance
                        first[i] = numbers[j]
                        shares[i, 0] = 1.0 - u - v
                        shares[i, 1] = u
                        shares[i, 2] = v
                continue
            near_node = 2 * node
            far = near_node + 1
            near_entry = _entry(boxes, near_node, origin, reciprocal)
            far_entry = _entry(boxes, far, origin, reciprocal)
            if far_entry < near_entry:
                near_node, far = far, near_node
                near_entry, far_entry = far_entry, near_entry
            if far_entry < np.inf and far_entry <= nearest:
                waiting[size] = far
                size += 1
            if near_entry < np.inf and near_entry <= nearest:
                waiting[size] = near_node
                size += 1
    return first, shares


@numba.njit(inline="always", **PLAIN)
def _row(places: np.ndarray, i: int) -> Vector:
    """Return one of places (n, 3)."""
    return places[i, 0], places[i, 1], places[i, 2]


@numba.njit(inline="always", **PLAIN)
def _corner(corners: np.ndarray, j: int, number: int) -> Vector:
    """Return a corner of one of triangles (m, 3, 3) or boxes (m, 2, 3)."""
    return corners[j, number, 0], corners[j, number, 1], corners[j, number, 2]


@numba.njit(inline="always", **PLAIN)
def _inverse(component: float) -> float:
    """Return the reciprocal of a ray's component; 0 for a ray across the axis."""
    if component == 0.0:
        return 0.0
    return 1.0 / component


@numba.njit(inline="always", **PLAIN)
def _entry(boxes: np.ndarray, node: int, origin: Vector, reciprocal: Vector) -> float:
    """Return where a ray enters a node's box, at least 0; infinite if it does not."""
    low = _corner(boxes, node, 0)
    high = _corner(boxes, node, 1)
    entry = 0.0
    leave = np.inf
    for axis in range(3):
        if reciprocal[axis] == 0.0:
            if origin[axis] < low[axis] or origin[axis] > high[axis]:
                return np.inf
            continue
        to_low = (low[axis] - origin[axis]) * reciprocal[axis]
        to_high = (high[axis] - origin[axis]) * reciprocal[axis]
        first = to_low if reciprocal[axis] > 0.0 else to_high
        last = to_high if reciprocal[axis] > 0.0 else to_low
        entry = first if first > entry else entry
        leave = last if last < leave else leave
    # a flat box is entered where it is left, but for rounding
    return entry if entry <= leave * (1.0 + 4e-16) else np.inf


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
) -> tuple[np.ndarray, np.ndarray]:
    closest = np.full(len(points), -1, np.int64)
    feet = np.zeros((len(points), 3))
    leaves = len(boxes) // 2
    waiting = np.empty(MOST_WAITING, np.int64)
    for i in range(len(points)):
        point = _row(points, i)
        nearest = np.inf
        if i > 0:
            # the place closest to the point before it bounds the search, but may not be the first
            before = _row(feet, i - 1)
            nearest = (1.0 + 1e-12) * _square_off(before, before, point)
        waiting[0] = 1
        size = 1
        while size > 0:
            size -= 1
            node = waiting[size]
            if _square_off(_corner(boxes, node, 0), _corner(boxes, node, 1), point) > nearest:
                continue
            if node >= leaves:
                begin = (node - leaves) * LEAF
                for j in range(begin, min(begin + LEAF, len(corners))):
                    place = _closest(corners, j, point)
                    square = _square_off(place, place, point)
                    is_first = square == nearest and numbers[j] < closest[i]
                    if square < nearest or is_first:
                        nearest = square
                        closest[i] = numbers[j]
                        feet[i, 0] = place[0]
                        feet[i, 1] = place[1]
                        feet[i, 2] = place[2]
                continue
            near_node = 2 * node
            far = near_node + 1
            near_square = _square_off(
                _corner(boxes, near_node, 0), _corner(boxes, near_node, 1), point
            )
            far_square = _square_off(_corner(boxes, far, 0), _corner(boxes, far, 1), point)
            if far_square < near_square:
                near_node, far = far, near_node
            waiting[size] = far
            waiting[size + 1] = near_node
            size += 2
    return closest, feet


@numba.njit(inline="always", **PLAIN)
def _square_off(low: Vector, high: Vector, point: Vector) -> float:
    """Return the square of a point's distance from a box."""
    square = 0.0
    for axis in range(3):
        off = max(low[axis] - point[axis], point[axis] - high[axis], 0.0)
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
