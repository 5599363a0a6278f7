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
