"""The shadow in a hole: against hand-computable cases, against tracing of single lines, and in its order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.evaluation.profile import shadowed_shares

RADIUS_M, DEPTH_M = 5e-3, 20e-3
FAR_M = 1e5
"""So far that lines of sight are parallel to 1e-7."""


def lens_at(angle_deg: float, away_m: float = FAR_M, about_deg: float = 0.0) -> np.ndarray:
    aside, turn = np.deg2rad(angle_deg), np.deg2rad(about_deg)
    return away_m * np.array([np.sin(aside) * np.cos(turn), np.sin(aside) * np.sin(turn), np.cos(aside)])


def shares(lenses, emitters=None, counts=(1,), centre=(0.0, 0.0, 0.0), depth_m=DEPTH_M):
    lenses = np.atleast_2d(lenses)
    emitters = lenses if emitters is None else np.atleast_2d(emitters)
    return shadowed_shares(lenses, emitters, np.array(centre), 2 * RADIUS_M, depth_m, counts)


def test_a_lens_on_the_axis_sees_the_whole_wall():
    (row,) = shares([[0.0, 0.0, 0.7]])
    size = {"true_diameter_mm": 10.0, "depth_mm": 20.0}
    assert row == {"views": 1, **size, "unseen_share": 0.0, "shadowed_share": 0.0}


@pytest.mark.parametrize("angle_deg", [45.0, 60.0, 75.0])
def test_parallel_light_reaches_what_geometry_says(angle_deg):
    # the wall opposite the lens is seen down to 2 r cos(azimuth) / tan(angle), on the average over azimuths to
    # 2 r / (pi tan(angle)); none of these angles reaches the floor at 4 r
    seen = 2 * RADIUS_M / (np.pi * np.tan(np.deg2rad(angle_deg))) / DEPTH_M
    (row,) = shares(lens_at(angle_deg))
    assert row["unseen_share"] == pytest.approx(1 - seen, abs=2e-6)
    both = shares([lens_at(angle_deg), lens_at(-angle_deg)], counts=(1, 2))
    assert both[1]["unseen_share"] == pytest.approx(1 - 2 * seen, abs=2e-6)


def test_the_floor_ends_the_wall():
    # at 45 degrees the wall is seen to 2 r cos(azimuth) where that is above the floor at r: beyond 60 degrees
    depth_m, end = RADIUS_M, np.pi / 3
    seen = (end * depth_m + 2 * RADIUS_M * (1 - np.sin(end))) / (np.pi * depth_m)
    (row,) = shares(lens_at(45.0), depth_m=depth_m)
    assert row["unseen_share"] == pytest.approx(1 - seen, abs=1e-5)


def test_what_is_seen_and_lit_in_different_views_stays_in_shadow():
    left, right = lens_at(-60.0), lens_at(60.0)
    rows = shares([left, right], [right, left], counts=(1, 2))
    assert [row["shadowed_share"] for row in rows] == [1.0, 1.0]
    assert rows[1]["unseen_share"] < 0.85


def test_agrees_with_lines_traced_one_by_one():
    rng = np.random.default_rng(4)
    centre = np.array([0.25, -0.01, 0.0])
    lenses = np.array([[0.1, 0.05, 0.7], [-0.2, 0.0, 0.6], [0.6, 0.1, 0.5]])
    emitters = lenses + np.array([0.03, 0.0, 0.0])
    n = 200_000
    turn, depth = rng.uniform(0, 2 * np.pi, n), rng.uniform(0, DEPTH_M, n)
    walls = centre + np.column_stack([RADIUS_M * np.cos(turn), RADIUS_M * np.sin(turn), -depth])

    def clear(place):
        share = depth / (depth + place[2])
        at_mouth = walls + share[:, None] * (place - walls)
        return np.hypot(*(at_mouth - centre)[:, :2].T) <= RADIUS_M * (1 + 1e-12)

    seen, both = np.zeros(n, bool), np.zeros(n, bool)
    rows = shares(lenses, emitters, counts=(1, 2, 3), centre=centre)
    for row, lens, emitter in zip(rows, lenses, emitters, strict=True):
        seen |= clear(lens)
        both |= clear(lens) & clear(emitter)
        for traced, said in ((seen, row["unseen_share"]), (both, row["shadowed_share"])):
            # four standard errors of a share from n draws: at most 0.0045
            assert said == pytest.approx(1 - traced.mean(), abs=4 * np.sqrt(0.25 / n))


places = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.05, 1.0))


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(places, places), min_size=2, max_size=5))
def test_more_views_never_see_less_and_light_never_helps(views):
    lenses, emitters = np.array([v[0] for v in views]), np.array([v[1] for v in views])
    rows = shares(lenses, emitters, counts=range(1, len(views) + 1))
    for name in ("unseen_share", "shadowed_share"):
        values = [row[name] for row in rows]
        assert all(0 <= value <= 1 for value in values)
        assert values == sorted(values, reverse=True)
    assert all(row["shadowed_share"] >= row["unseen_share"] for row in rows)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="before the face"):
        shares([[0.0, 0.0, -0.1]])
    with pytest.raises(ValueError, match="of 1 views"):
        shares([[0.0, 0.0, 0.1]], counts=(2,))
