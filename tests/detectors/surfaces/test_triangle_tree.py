"""Rays and closest points of the tree, beside all triangles tried one by one in NumPy."""

from __future__ import annotations

import numpy as np

from detectors.surfaces.triangle_tree import (
    CHILDREN,
    LEAF,
    _enter,
    _entry,
    closest_places,
    first_hits,
    tree_of,
)

DRAWS = np.random.default_rng(44)
SCATTERED = DRAWS.uniform(-1.0, 1.0, (83, 1, 3)) + DRAWS.normal(0.0, 0.2, (83, 3, 3))


def distances_along(corners: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return where a ray meets each triangle (m, 3, 3): origin + t direction = a + u b + v c."""
    a = corners[:, 0]
    b = corners[:, 1] - a
    c = corners[:, 2] - a
    back = np.broadcast_to(-direction, a.shape)
    matrix = np.stack([back, b, c], axis=2)
    t, u, v = np.linalg.solve(matrix, (origin - a)[..., None])[..., 0].T
    is_inside = (u >= 0) & (v >= 0) & (u + v <= 1)
    return np.where(is_inside & (t >= 0), t, np.inf)


def sampled_distance(corners: np.ndarray, point: np.ndarray) -> float:
    """Return the least distance of a point from samples of a triangle (3, 3), 1 % of a side apart."""
    u, v = np.meshgrid(np.linspace(0, 1, 101), np.linspace(0, 1, 101))
    inside = u + v <= 1.0 + 1e-9
    shares = np.column_stack([1.0 - u[inside] - v[inside], u[inside], v[inside]])
    return float(np.linalg.norm(shares @ corners - point, axis=1).min())


def test_rays_meet_the_triangle_that_is_first_of_all() -> None:
    origins = DRAWS.uniform(-1.5, 1.5, (300, 3))
    directions = DRAWS.uniform(-0.7, 0.7, (300, 3)) - origins
    directions[:30, 0] = 0.0
    number, shares = first_hits(tree_of(SCATTERED), origins, directions)
    for i in range(300):
        distances = distances_along(SCATTERED, origins[i], directions[i])
        if np.isinf(distances.min()):
            assert number[i] == -1
            continue
        assert number[i] == distances.argmin()
        met_point = origins[i] + distances.min() * directions[i]
        np.testing.assert_allclose(shares[i] @ SCATTERED[number[i]], met_point, atol=1e-9)
    assert 60 < (number >= 0).sum() < 290


def test_four_boxes_at_once_are_entered_as_one_by_one() -> None:
    boxes = tree_of(SCATTERED).boxes
    entries = np.empty(CHILDREN)
    is_entered = []
    for node in range(len(boxes)):
        for _ in range(20):
            origin = tuple(DRAWS.uniform(-1.5, 1.5, 3))
            reciprocal = tuple(1.0 / DRAWS.uniform(-1.0, 1.0, 3))
            _enter.py_func(boxes, node, origin, reciprocal, entries)
            for child in range(CHILDREN):
                assert entries[child] == _entry.py_func(boxes, node, child, origin, reciprocal)
            is_entered += np.isfinite(entries).tolist()
    assert 0.05 < np.mean(is_entered) < 0.95


def test_the_closest_place_is_on_the_closest_triangle() -> None:
    points = DRAWS.uniform(-2.0, 2.0, (60, 3))
    number, feet = closest_places(tree_of(SCATTERED), points)
    for i in range(60):
        sampled = [sampled_distance(corners, points[i]) for corners in SCATTERED]
        off = np.linalg.norm(feet[i] - points[i])
        assert min(sampled) - 0.01 < off <= min(sampled) + 1e-12
        assert sampled[number[i]] < min(sampled) + 0.01
        assert sampled_distance(SCATTERED[number[i]], feet[i]) < 0.02


def test_known_places_change_nothing() -> None:
    """Those of other points, and the points' own: there, rounding may let none be closer."""
    points = DRAWS.uniform(-2.0, 2.0, (60, 3))
    tree = tree_of(SCATTERED)
    number, feet = closest_places(tree, points)
    for known in (feet, np.roll(feet, 1, axis=0)):
        again, again_feet = closest_places(tree, points, known)
        np.testing.assert_array_equal(again, number)
        np.testing.assert_array_equal(again_feet, feet)
    on_itself, _ = closest_places(tree, feet, feet)
    assert (on_itself >= 0).all()


def test_equal_distances_and_flat_boxes() -> None:
    """A flat square of two triangles, twice: boxes without depth, and ties on all of it."""
    square = np.array([[[0, 0, 1], [1, 0, 1], [0, 1, 1]], [[1, 1, 1], [0, 1, 1], [1, 0, 1]]], float)
    tree = tree_of(np.concatenate([square, square]))
    ticks = np.linspace(0, 1, 9)
    x = np.tile(ticks, 9)
    y = np.repeat(ticks, 9)
    starts = np.column_stack([x, y, np.zeros(81)])
    number, _ = first_hits(tree, starts, np.tile([0.0, 0.0, 2.0], (81, 1)))
    np.testing.assert_array_equal(number, np.where(x + y <= 1.0, 0, 1))
    below, feet = closest_places(tree, starts)
    np.testing.assert_array_equal(below, np.where(x + y <= 1.0, 0, 1))
    np.testing.assert_allclose(feet, starts + np.array([0.0, 0.0, 1.0]), atol=1e-15)
    away, _ = first_hits(tree, starts, np.tile([0.0, 0.0, -2.0], (81, 1)))
    assert (away == -1).all()
    nowhere, _ = first_hits(tree, np.full((2, 3), np.nan), starts[:2])
    assert (nowhere == -1).all()


def test_every_triangle_of_any_number_is_in_the_tree() -> None:
    for count in (1, LEAF, LEAF + 1, 37):
        corners = SCATTERED[:count]
        number, _ = closest_places(tree_of(corners), corners.mean(axis=1))
        assert set(number.tolist()) <= set(range(count))
        assert number[0] == 0 or count > 1
        np.testing.assert_array_equal(np.sort(tree_of(corners).numbers), np.arange(count))
