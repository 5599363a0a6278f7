"""Clusters against a brute-force distance matrix."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from detectors.pixels.clusters import euclidean_clusters, nested_clusters
from harness.vocabulary.errors import UserError


def brute_force(points: np.ndarray, distance: float) -> np.ndarray:
    """Component of each point, in the order of first appearance."""
    component = connected_components(cdist(points, points) <= distance, directed=False)[1]
    _, first, inverse = np.unique(component, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    n=st.integers(1, 200),
    spread=st.sampled_from([0.02, 0.1, 0.4]),
    flat=st.booleans(),
)
def test_equals_brute_force(seed: int, n: int, spread: float, flat: bool) -> None:
    points = np.random.default_rng(seed).uniform(-spread, spread, (n, 3))
    if flat:
        points[:, 2] = 0.7
    np.testing.assert_array_equal(euclidean_clusters(points, 0.01), brute_force(points, 0.01))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000))
def test_order_and_place_of_points_do_not_matter(seed: int) -> None:
    random = np.random.default_rng(seed)
    points = random.uniform(0, 0.1, (150, 3))
    order = random.permutation(150)
    labels = euclidean_clusters(points, 0.012)
    moved = euclidean_clusters(points[order] + [0.3, -0.2, 1.0], 0.012)
    same = labels[order][:, None] == labels[order][None, :]
    np.testing.assert_array_equal(same, moved[:, None] == moved[None, :])


def test_single_linkage_joins_a_chain_and_stops_beyond_the_distance() -> None:
    x = np.array([0.0, 0.0099, 0.0198, 0.0299, 0.0398])
    points = np.stack([x, 0 * x, 0 * x], axis=1)
    np.testing.assert_array_equal(euclidean_clusters(points, 0.01), [0, 0, 0, 1, 1])


def test_a_distance_exactly_reached_joins() -> None:
    points = np.array([[0.0, 0, 0], [0.25, 0, 0], [0.51, 0, 0]])
    np.testing.assert_array_equal(euclidean_clusters(points, 0.25), [0, 0, 1])


@pytest.mark.parametrize(
    "direction",
    [
        (1, 0, 0),
        (0, 1, 0),
        (0, 0, 1),
        (0.6, 0.0, -0.8),
    ],
)
def test_points_are_joined_up_to_the_distance_and_no_farther(direction) -> None:
    first = np.array([0.03, 0.01, 0.7])
    for distance_m, count in ((0.0099, 1), (0.0101, 2)):
        second = first + distance_m * np.array(direction)
        labels = euclidean_clusters(np.stack([first, second]), 0.01)
        assert labels.max() + 1 == count


def directions(seed: int, count: int) -> np.ndarray:
    """Unit vectors (n, 3): all along axes and diagonals, and ``count`` random ones."""
    ticks = [-1, 0, 1]
    grid = np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3)
    regular = grid[np.any(grid != 0, axis=1)]
    random = np.random.default_rng(seed).normal(size=(count, 3))
    vectors = np.concatenate([regular, random])
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("distance_m", [0.01, 0.3])
def test_pairs_are_joined_up_to_the_distance_wherever_they_lie_in_their_cells(distance_m) -> None:
    """Also two points at the ends of the diagonal of one cell, which are not compared."""
    vectors = np.tile(directions(1, 100), (5, 1))
    random = np.random.default_rng(2)
    firsts = random.uniform(0.0, 1.0, vectors.shape) * distance_m
    firsts[:26] = 0.0  # the corner of a cell
    firsts[:, 0] += 20.0 * distance_m * np.arange(len(firsts))
    for factor, is_joined in ((0.9999, True), (1.0001, False)):
        seconds = firsts + factor * distance_m * vectors
        # points in the first cell's corner, so that cells begin there
        corner = np.minimum(firsts.min(axis=0), seconds.min(axis=0))
        points = np.concatenate([firsts, seconds, [corner]])
        labels = euclidean_clusters(points, distance_m)
        np.testing.assert_array_equal(labels[: len(firsts)] == labels[len(firsts) : -1], is_joined)


def test_the_diagonal_of_the_first_cell_is_no_longer_than_the_distance() -> None:
    for factor, count in ((0.9999, 1), (1.0001, 2)):
        points = np.zeros((2, 3))
        points[1] = factor * 0.01 / np.sqrt(3.0)
        assert euclidean_clusters(points, 0.01).max() + 1 == count


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_as_many_cells_as_their_keys_hold_are_legal_along_each_axis(axis: int) -> None:
    cell_m = 0.01 / np.sqrt(3.0)
    points = np.zeros((5, 3))
    points[1, axis] = 0.009
    points[2:4, axis] = 0.99999 * 2**20 * cell_m
    points[3] += 0.004
    points[4, axis] = 0.5 * 2**20 * cell_m
    np.testing.assert_array_equal(euclidean_clusters(points, 0.01), [0, 0, 1, 1, 2])
    points[2:4, axis] *= 1.0001
    with pytest.raises(UserError, match="cannot be clustered"):
        euclidean_clusters(points, 0.01)


def strength_by_trial(
    points: np.ndarray,
    scores: np.ndarray,
    distance_m: float,
    min_points: int,
) -> float:
    """The lowest threshold at which no cluster of some points is left: the largest score s so that
    the points with a score of s and more hold a cluster."""
    for score in -np.sort(-scores):
        labels = brute_force(points[scores >= score], distance_m)
        if np.bincount(labels).max() >= min_points:
            return float(score)
    return 0.0


@pytest.mark.parametrize("min_points", [1, 2, 4])
def test_strengths_are_the_scores_at_which_the_last_part_falls_apart(min_points: int) -> None:
    for seed in range(6):
        random = np.random.default_rng(seed)
        points = random.uniform(0, 0.1, (120, 3)) * [1.0, 1.0, 0.2]
        scores = random.exponential(size=120)
        thresholds = np.array([0.0, 0.3, 1.0])
        labels, strengths = nested_clusters(points, scores, 0.011, min_points, thresholds)
        for level, threshold in enumerate(thresholds):
            above = np.flatnonzero(scores > threshold)
            parts = brute_force(points[above], 0.011)
            count = 0
            for number in range(parts.max() + 1):
                part = above[parts == number]
                if len(part) < min_points:
                    assert (labels[level, part] == -1).all()
                    continue
                assert (labels[level, part] == count).all()
                expected = strength_by_trial(points[part], scores[part], 0.011, min_points)
                assert strengths[level, count] == expected
                count += 1
            assert labels[level].max() == count - 1


def test_nested_clusters_are_those_of_each_threshold() -> None:
    """Labels at several thresholds beside clusters of the points above each, and the threshold at
    which each is gone."""
    random = np.random.default_rng(5)
    points = random.uniform(0, 0.1, (200, 3)) * [1.0, 1.0, 0.1]
    scores = random.exponential(size=200)
    thresholds = np.array([0.1, 0.7, 1.6])
    labels, strengths = nested_clusters(points, scores, 0.012, 3, thresholds)
    for level, threshold in enumerate(thresholds):
        above = scores > threshold
        alone = euclidean_clusters(points[above], 0.012, 3)
        np.testing.assert_array_equal(labels[level][above], alone)
        assert (labels[level][~above] == -1).all()
        for number in range(alone.max() + 1):
            cluster = points[above][alone == number]
            cluster_scores = scores[above][alone == number]
            strength = strengths[level, number]
            just_below = cluster_scores > np.nextafter(strength, 0.0)
            highest = cluster[cluster_scores > strength]
            assert euclidean_clusters(cluster[just_below], 0.012, 3).max() >= 0
            assert euclidean_clusters(highest, 0.012, 3).max(initial=-1) < 0


def test_small_clusters_and_missing_points_get_no_label() -> None:
    points = np.array(
        [[0.0, 0, 0], [1, 0, 0], [1.001, 0, 0], [np.nan, 0, 0], [2, 0, 0], [2, 0.001, 0]]
    )
    np.testing.assert_array_equal(
        euclidean_clusters(points, 0.01, min_points=2), [-1, 0, 0, -1, 1, 1]
    )
    assert len(euclidean_clusters(np.empty((0, 3)), 0.01)) == 0


def test_a_dense_sheet_of_100_000_points_is_one_cluster() -> None:
    v, u = np.mgrid[:320, :320] * 1e-3
    points = np.stack([u.ravel(), v.ravel(), np.full(u.size, 0.7)], axis=1)
    points[points[:, 0] > 0.2, 0] += 0.0101
    labels = euclidean_clusters(points, 0.01)
    assert labels.max() == 1
    assert (labels == 0).sum() == 320 * 201


def test_a_wrong_unit_is_a_clear_mistake() -> None:
    with pytest.raises(UserError, match="cannot be clustered"):
        euclidean_clusters(np.array([[0.0, 0, 0], [1e5, 0, 0]]), 0.01)
