"""Matching findings to the truth: one to one, nearest first, nothing beyond the radius."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.evaluation.match import match


def test_nearest_pairs_first_and_one_to_one():
    truth = np.array([[0.0, 0], [10, 0], [20, 0]])
    findings = np.array([[11.0, 0], [9.5, 0], [0.2, 0], [40, 0]])
    pairs = match(truth, findings, 5.0)
    assert pairs == {0: 2, 1: 1}


def test_a_second_finding_in_the_same_hole_stays_a_false_call():
    assert match(np.zeros((1, 2)), np.array([[0.1, 0], [0.2, 0]]), 1.0) == {0: 0}


def test_radius_is_inclusive_and_nan_matches_nothing():
    assert match(np.zeros((1, 2)), np.array([[1.0, 0]]), 1.0) == {0: 0}
    assert match(np.zeros((1, 2)), np.array([[1.0001, 0]]), 1.0) == {}
    assert match(np.zeros((1, 2)), np.array([[np.nan, 0]]), 1.0) == {}


def test_empty_sides():
    assert match(np.zeros((0, 2)), np.zeros((3, 2)), 1.0) == {}
    assert match(np.zeros((3, 2)), np.zeros((0, 2)), 1.0) == {}


centres = st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=0, max_size=8)


@settings(max_examples=60, deadline=None)
@given(centres, centres, st.floats(0.1, 40))
def test_matching_is_one_to_one_within_the_radius_and_maximal(
    a,
    b,
    radius,
):
    truth = np.array(a).reshape(-1, 2)
    findings = np.array(b).reshape(-1, 2)
    pairs = match(truth, findings, radius)
    assert len(set(pairs.values())) == len(pairs)
    for t, f in pairs.items():
        assert np.linalg.norm(truth[t] - findings[f]) <= radius
    for t in set(range(len(truth))) - set(pairs):
        for f in set(range(len(findings))) - set(pairs.values()):
            assert not np.linalg.norm(truth[t] - findings[f]) <= radius


def by_falling_through_all_pairs(
    truth: np.ndarray,
    findings: np.ndarray,
    radius: float,
) -> dict[int, int]:
    """The same, written plainly: every pair in the order of its distance."""
    distance = np.linalg.norm(truth[:, None] - findings[None], axis=-1)
    pairs: dict[int, int] = {}
    for flat in np.argsort(distance, axis=None, kind="stable"):
        t, f = divmod(int(flat), len(findings))
        if distance[t, f] <= radius and t not in pairs and f not in pairs.values():
            pairs[t] = f
    return pairs


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 8), m=st.integers(1, 20))
def test_pairs_are_those_of_all_pairs_in_order_ties_included(
    seed: int,
    n: int,
    m: int,
):
    random = np.random.default_rng(seed)
    truth = random.integers(0, 8, (n, 2)).astype(float)
    findings = random.integers(0, 8, (m, 2)).astype(float)
    pairs = match(truth, findings, 3.0)
    assert pairs == by_falling_through_all_pairs(truth, findings, 3.0)
    assert list(pairs) == list(by_falling_through_all_pairs(truth, findings, 3.0))
