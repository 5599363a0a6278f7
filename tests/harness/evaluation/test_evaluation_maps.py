"""Maps side by side: what registrations amount to, paired differences, and where one map begins to
size better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from harness.evaluation.maps import (
    against_one,
    by_views,
    change_of,
    compare_maps,
    map_cases,
    maps_of,
    of_map,
    paired_ratio,
    run_ratio,
    size_errors,
    summarise_registrations,
)
from harness.evaluation.summary import summarise_holes
from tests.support.synthetic_perspectives import (
    MERGE,
    REGISTRATION,
    VIEWS,
    MapWorld,
    name_of,
    perspectives,
    with_variation,
)


def registrations(**columns):
    """Rows with two repeats of one view each; ``columns`` change them."""
    rows = pd.DataFrame({"repeat": [0, 1]}).assign(
        frames=50,
        role="damaged",
        view=1,
        method="marks",
        variant="a",
        tre_in_plane_mm=[0.3, 0.4],
        tre_across_mm=[0.1, 0.1],
        tre_mm=0.4,
        predicted_in_plane_mm=[0.25, 0.25],
        predicted_across_mm=np.nan,
        guess_tre_mm=9.0,
        residual_mm=0.1,
        overlap=0.9,
        pairs=4,
        marks=4,
        iterations=1,
        converged=True,
        seconds=0.002,
        failure="",
    )
    return rows.assign(**columns)


def test_registrations_are_summed_up_by_hand():
    failed = registrations(
        failure=["", "too few marks"], repeat=[2, 3], tre_in_plane_mm=[0.5, 90.0]
    )
    (row,) = summarise_registrations(pd.concat([registrations(), failed])).to_dict("records")
    assert (row["n"], row["failed"], row["reasons"]) == (4, 1, ["too few marks (1)"])
    assert row["in_plane_median_mm"] == pytest.approx(0.4)
    assert row["in_plane_rms_mm"] == pytest.approx(np.sqrt((0.09 + 0.16 + 0.25) / 3))
    assert row["in_plane_predicted_mm"] == pytest.approx(0.25)
    assert row["in_plane_ratio"] == pytest.approx(np.sqrt(0.5 / 3) / 0.25)
    # the greatest and least ratios that three repeats can be drawn to
    assert row["in_plane_ratio_low"] == pytest.approx(1.2)
    assert row["in_plane_ratio_high"] == pytest.approx(2.0)
    assert np.isnan(row["across_predicted_mm"])
    assert np.isnan(row["across_ratio"])


def test_a_covariance_that_is_honest_has_a_ratio_about_one():
    rng = np.random.default_rng(8)
    n = 400
    # three degrees of freedom in the plane: rms over the board from a chi-square with three
    actual = 0.2 * np.sqrt(rng.chisquare(3, n) / 3)
    rows = pd.concat([registrations()] * (n // 2)).assign(
        repeat=np.arange(n), tre_in_plane_mm=actual
    )
    rows["predicted_in_plane_mm"] = 0.2
    (row,) = summarise_registrations(rows).to_dict("records")
    # alpha 1e-4: four standard errors, each sqrt(2 / 3 / n) / 2
    assert row["in_plane_ratio"] == pytest.approx(1.0, abs=4 * np.sqrt(2 / 3 / n) / 2)
    assert row["in_plane_ratio_low"] < 1 < row["in_plane_ratio_high"]


def test_a_ratio_is_paired_by_view():
    """Two repeats of each of two pairs of views: the pairs count, not the repeats."""
    first = pd.concat([registrations(view=view) for view in (1, 2)], ignore_index=True)
    ratio, low, high, n = paired_ratio(
        first, first.assign(tre_in_plane_mm=first["tre_in_plane_mm"] / 2), "tre_in_plane_mm"
    )
    assert (ratio, low, high, n) == (pytest.approx(0.5), pytest.approx(0.5), pytest.approx(0.5), 2)
    gone = first.assign(failure=["", "", "x", "x"])
    assert np.isnan(paired_ratio(first, gone, "tre_in_plane_mm")[0])


def test_the_registrations_of_a_map_are_found_under_whichever_number_of_views_they_stand():
    shared = pd.concat([registrations(view=v).assign(**{VIEWS: v + 1.0}) for v in (1, 2)])
    own = pd.concat(
        [
            registrations(view=v, method="joint").assign(**{VIEWS: n})
            for n, last in ((2.0, 2), (3.0, 3))
            for v in range(1, last)
        ]
    )
    table = pd.concat([shared, own], ignore_index=True)
    assert sorted(of_map(table, "marks", 3)["view"]) == [1, 1, 2, 2]
    assert sorted(of_map(table, "marks", 2)["view"]) == [1, 1]
    joint = of_map(table, "joint", 3)
    assert set(joint[VIEWS]) == {3.0}
    assert len(joint) == 4
    assert set(of_map(table, "joint", 2)[VIEWS]) == {2.0}
    counts = by_views(table, (1, 2, 3)).set_index(["method", "views"])["n"]
    assert counts.to_dict() == {("marks", 2): 2, ("marks", 3): 4, ("joint", 2): 2, ("joint", 3): 4}


def holes(diameters, repeats=4, true=(10.0, 5.0)):
    return pd.DataFrame(
        [
            {
                "repeat": r,
                "hole": str(n),
                "true_diameter_mm": t,
                "extent_diameter_mm": diameters[n][r],
            }
            for n, t in enumerate(true)
            for r in range(repeats)
        ]
    )


def test_size_errors_are_paired_and_need_both_maps():
    one = holes([[11.0, 12.0, 11.0, 12.0], [5.5, 5.5, np.nan, np.nan]])
    two = holes([[10.5, 11.5, 10.5, 11.5], [np.nan, np.nan, 6.0, 6.0]])
    found = size_errors(one, two)
    assert found.holes == ("0",)
    change = found.change()
    assert (change.mean, change.n) == (pytest.approx(-0.5), 4)
    assert change.is_below is True
    # differences do not vary though sizes do: a point
    assert (change.interval.low, change.interval.high) == (pytest.approx(-0.5), pytest.approx(-0.5))


def test_holes_are_in_the_order_of_their_size():
    both = holes([[11.0] * 4, [5.5] * 4])
    assert size_errors(both, both).holes == ("1", "0")
    assert size_errors(both, both).diameters_mm.tolist() == [5.0, 10.0]


@pytest.mark.parametrize(
    ("values", "above", "below"),
    [
        ([1.0, 1.1], True, False),
        ([-1.0, -1.1], False, True),
        ([-1.0, 1.0], None, None),
        ([0.0, 0.0], False, False),
    ],
)
def test_a_change_is_certain_or_open(values, above, below):
    change = change_of(np.array(values))
    assert (change.interval.over(0), change.is_below) == (above, below)
    assert change_of(np.array(values[:1])).interval.over(0) is None


def test_noise_is_compared_as_a_ratio():
    runs = pd.DataFrame(
        {"role": "damaged", "repeat": range(3), "surface_noise_mm": [1.0, 2.0, 3.0]}
    )
    half = runs.assign(surface_noise_mm=runs["surface_noise_mm"] / 2)
    assert np.exp(run_ratio(runs, half, "surface_noise_mm").mean) == pytest.approx(0.5)


@pytest.fixture(scope="module")
def small():
    return perspectives(
        counts=(1, 2), methods=("cpd", "marks"), merges=("grid", "fusion"), frames=(1, 50)
    )


def test_maps_are_known_by_their_axes(small):
    found = with_variation(small, MapWorld(), "hand-held", (24, "odometry", "volume"), (1,))
    maps = {one.variant: one for one in maps_of(found)}
    assert (maps["hand-held"].views, maps["hand-held"].merge, maps["hand-held"].is_variation) == (
        24,
        "volume",
        True,
    )
    one = maps[name_of(2, "cpd", "grid")]
    assert (one.views, one.registration, one.merge, one.conditions, one.is_variation) == (
        2,
        "cpd",
        "grid",
        "",
        False,
    )
    (case,) = map_cases(found, summarise_holes(found.holes, [VIEWS, REGISTRATION, MERGE]))
    assert case.variant(1, "joint", "grid") == name_of(
        1, "cpd", "grid"
    )  # of one view any registration will do
    assert case.variant(2, "joint", "grid") is None
    assert case.common_frames(name_of(1, "cpd", "grid"), "hand-held") == 1
    assert case.single().frames == 50


def test_all_views_are_counted_by_the_runs(small):
    every = small.variants[VIEWS].where(small.variants[VIEWS] != 2.0)
    table = replace(
        small,
        variants=small.variants.assign(
            **{VIEWS: every.astype(object).map(lambda v: "null" if v != v else str(v))}
        ),
    )
    assert {one.views for one in maps_of(table)} == {1, 2}


def test_maps_side_by_side(small):
    compared = compare_maps(small, summarise_holes(small.holes, [VIEWS, REGISTRATION, MERGE]))
    assert len(compared) == 2 * 2 * 2 * 2
    row = compared[
        (compared["variant"] == name_of(2, "cpd", "fusion")) & (compared["frames"] == 50)
    ].iloc[0]
    assert row["found"] == [str(number) for number in range(4, 12)]
    assert row["seconds_map"] == pytest.approx(0.1)
    assert row["temporal_mm"] == pytest.approx(0.09, rel=0.1)
    assert (row["views"], row["views_left_out"]) == (2, 0)


def test_other_axes_make_places_of_their_own(small):
    more = [
        *small.axes.to_dict("records"),
        {"path": "source.target.distance_m", "name": "distance", "unit": "m"},
    ]
    names = ("holes", "runs", "probes", "variants", "registrations")
    placed = replace(
        small,
        axes=pd.DataFrame(more),
        **{
            name: getattr(small, name).assign(**{"source.target.distance_m": 0.7}) for name in names
        },
    )
    (case,) = map_cases(placed, summarise_holes(placed.holes, [row["path"] for row in more]))
    assert case.conditions == "0.7 m"
    assert against_one(case, "cpd", "grid") is not None
