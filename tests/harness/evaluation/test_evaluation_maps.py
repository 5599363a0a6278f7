"""Maps side by side: what registrations amount to, paired differences, and where one map begins to
size better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from harness.evaluation.intervals import UNKNOWN, Interval
from harness.evaluation.maps import (
    Change,
    against_one,
    by_views,
    change_of,
    change_text,
    compare_maps,
    frames_text,
    label_of,
    map_cases,
    maps_of,
    of_map,
    paired_ratio,
    ratio_text,
    run_ratio,
    size_errors,
    span,
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
    assert row["n"] == 4
    assert row["failed"] == 1
    assert row["reasons"] == ["too few marks (1)"]
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
    assert ratio == pytest.approx(0.5)
    assert low == pytest.approx(0.5)
    assert high == pytest.approx(0.5)
    assert n == 2
    gone = first.assign(failure=["", "", "x", "x"])
    assert np.isnan(paired_ratio(first, gone, "tre_in_plane_mm")[0])


def test_the_registrations_of_a_map_are_found_under_whichever_number_of_views_they_stand():
    shared = pd.concat([registrations(view=v).assign(**{VIEWS: v + 1.0}) for v in (1, 2)])
    joint_rows = pd.concat(
        [
            registrations(view=v, method="joint").assign(**{VIEWS: n})
            for n, last in ((2.0, 2), (3.0, 3))
            for v in range(1, last)
        ]
    )
    table = pd.concat([shared, joint_rows], ignore_index=True)
    assert sorted(of_map(table, "marks", 3)["view"]) == [1, 1, 2, 2]
    assert sorted(of_map(table, "marks", 2)["view"]) == [1, 1]
    joint = of_map(table, "joint", 3)
    assert set(joint[VIEWS]) == {3.0}
    assert len(joint) == 4
    assert set(of_map(table, "joint", 2)[VIEWS]) == {2.0}
    counts = by_views(table, (1, 2, 3)).set_index(["method", "views"])["n"]
    assert counts.to_dict() == {("marks", 2): 2, ("marks", 3): 4, ("joint", 2): 2, ("joint", 3): 4}


def holes(
    diameters,
    repeats=4,
    true=(10.0, 5.0),
):
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
    first = holes([[11.0, 12.0, 11.0, 12.0], [5.5, 5.5, np.nan, np.nan]])
    second = holes([[10.5, 11.5, 10.5, 11.5], [np.nan, np.nan, 6.0, 6.0]])
    errors = size_errors(first, second)
    assert errors.holes == ("0",)
    change = errors.change()
    assert change.mean == pytest.approx(-0.5)
    assert change.n == 4
    assert change.is_below is True
    # differences do not vary though sizes do: a point
    assert change.interval.low == pytest.approx(-0.5)
    assert change.interval.high == pytest.approx(-0.5)


def test_holes_are_in_the_order_of_their_size():
    rows = holes([[11.0] * 4, [5.5] * 4])
    assert size_errors(rows, rows).holes == ("1", "0")
    assert size_errors(rows, rows).diameters_mm.tolist() == [5.0, 10.0]


@pytest.mark.parametrize(
    ("values", "above", "below"),
    [
        ([1.0, 1.1], True, False),
        ([-1.0, -1.1], False, True),
        ([-1.0, 1.0], None, None),
        ([0.0, 0.0], False, False),
    ],
)
def test_a_change_is_certain_or_open(
    values,
    above,
    below,
):
    change = change_of(np.array(values))
    assert change.interval.over(0) == above
    assert change.is_below == below
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
    varied = with_variation(small, MapWorld(), "hand-held", (24, "odometry", "volume"), (1,))
    maps = {set_up.variant: set_up for set_up in maps_of(varied)}
    assert maps["hand-held"].views == 24
    assert maps["hand-held"].merge == "volume"
    assert maps["hand-held"].is_variation is True
    set_up = maps[name_of(2, "cpd", "grid")]
    assert set_up.views == 2
    assert set_up.registration == "cpd"
    assert set_up.merge == "grid"
    assert set_up.conditions == ""
    assert set_up.is_variation is False
    (case,) = map_cases(varied, summarise_holes(varied.holes, [VIEWS, REGISTRATION, MERGE]))
    assert case.variant(1, "joint", "grid") == name_of(
        1, "cpd", "grid"
    )  # of one view any registration will do
    assert case.variant(2, "joint", "grid") is None
    assert case.common_frames(name_of(1, "cpd", "grid"), "hand-held") == 1
    assert case.single().frames == 50


def test_all_views_are_counted_by_the_runs(small):
    views = small.variants[VIEWS].where(small.variants[VIEWS] != 2.0)
    table = replace(
        small,
        variants=small.variants.assign(
            **{VIEWS: views.astype(object).map(lambda v: "null" if v != v else str(v))}
        ),
    )
    assert {set_up.views for set_up in maps_of(table)} == {1, 2}


def test_maps_side_by_side(small):
    compared = compare_maps(small, summarise_holes(small.holes, [VIEWS, REGISTRATION, MERGE]))
    assert len(compared) == 2 * 2 * 2 * 2
    row = compared[
        (compared["variant"] == name_of(2, "cpd", "fusion")) & (compared["frames"] == 50)
    ].iloc[0]
    assert row["found"] == [str(number) for number in range(4, 12)]
    assert row["seconds_map"] == pytest.approx(0.1)
    assert row["temporal_mm"] == pytest.approx(0.09, rel=0.1)
    assert row["views"] == 2
    assert row["views_left_out"] == 0


def test_runs_of_a_map_have_a_typical_time_and_a_scatter_of_noise(small):
    """A single slow run does not count; the noise of runs scatters by 0.1 mm."""
    runs = small.runs.copy()
    chosen = (runs["variant"] == name_of(2, "cpd", "fusion")) & (runs["role"] == "damaged")
    is_odd = runs["repeat"] % 2 == 1
    runs.loc[chosen, "seconds_map"] = np.where(runs["repeat"] == 0, 60.0, 2.0)[chosen]
    runs.loc[chosen, "surface_noise_mm"] = np.where(is_odd, 0.4, 0.6)[chosen]
    runs.loc[chosen, "views_left_out"] = np.where(is_odd, 1, 0)[chosen]
    changed = replace(small, runs=runs)
    compared = compare_maps(changed, summarise_holes(small.holes, [VIEWS, REGISTRATION, MERGE]))
    row = compared[compared["variant"] == name_of(2, "cpd", "fusion")].iloc[0]
    count = (chosen & (runs["frames"] == row["frames"])).sum()
    assert count % 2 == 0
    assert row["seconds_map"] == 2.0
    assert row["surface_std_mm"] == pytest.approx(0.1 * np.sqrt(count / (count - 1)))
    assert row["views_left_out"] == 0.5


def test_other_axes_make_places_of_their_own(small):
    axes = [
        *small.axes.to_dict("records"),
        {"path": "source.target.distance_m", "name": "distance", "unit": "m"},
    ]
    names = ("holes", "runs", "probes", "variants", "registrations")
    placed = replace(
        small,
        axes=pd.DataFrame(axes),
        **{
            name: getattr(small, name).assign(**{"source.target.distance_m": 0.7}) for name in names
        },
    )
    (case,) = map_cases(placed, summarise_holes(placed.holes, [row["path"] for row in axes]))
    assert case.conditions == "0.7 m"
    assert against_one(case, "cpd", "grid") is not None


def test_two_views_against_one_by_hand() -> None:
    """Two views find one hole more and lose none, have half the bias and noise, and a threshold
    of 4 instead of 5."""
    world = MapWorld(
        first=lambda views, method, merge, frames: 5 if views == 1 else 4,
        size_bias_mm=lambda diameter, views, method, merge: (2.0 if diameter > 9 else 1.0) / views,
        size_std_mm=0.0,
        surface_mm=lambda views, method, merge, frames: 0.9 / views,
        threshold=lambda views, merge: 6.0 - views,
    )
    experiment = perspectives(world, counts=(1, 2), methods=("cpd",), merges=("grid",))
    (case,) = map_cases(experiment, summarise_holes(experiment.holes, [VIEWS, REGISTRATION, MERGE]))
    against = against_one(case, "cpd", "grid")
    assert against is not None
    assert against.frames == 50
    assert against.lost == ()
    assert against.gained == ("4",)
    # holes from 9.525 mm = 3/8 in are large
    assert against.sizes.holes == tuple(str(number) for number in range(5, 12))
    assert against.large.mean == pytest.approx(-1.0)
    assert against.small.mean == pytest.approx(-0.5)
    assert np.exp(against.noise.mean) == pytest.approx(0.5, rel=0.02)
    scale_mm = experiment.runs.groupby(["variant", "role", "frames"])["scale_mm"].mean()
    before = 5.0 * scale_mm[name_of(1, "cpd", "grid"), "damaged", 50]
    after = 4.0 * scale_mm[name_of(2, "cpd", "grid"), "damaged", 50]
    assert against.threshold.mean == pytest.approx(after - before)
    assert against_one(case, "cpd", "volume") is None
    turned = replace(world, first=lambda views, method, merge, frames: 4 if views == 1 else 5)
    experiment = perspectives(turned, counts=(1, 2), methods=("cpd",), merges=("grid",))
    (case,) = map_cases(experiment, summarise_holes(experiment.holes, [VIEWS, REGISTRATION, MERGE]))
    against = against_one(case, "cpd", "grid")
    assert against.lost == ("4",)
    assert against.gained == ()


def test_a_hole_of_three_eighths_of_an_inch_is_large(small) -> None:
    (case,) = map_cases(small, summarise_holes(small.holes, [VIEWS, REGISTRATION, MERGE]))
    against = against_one(case, "cpd", "grid")
    sizes = against.sizes
    assert 9.525 in np.round(sizes.diameters_mm, 6)
    assert against.large == sizes.change(sizes.diameters_mm > 9.0)
    assert against.small == sizes.change(sizes.diameters_mm < 9.0)


def test_maps_are_compared_with_fifty_frames_or_the_most_that_all_have(small) -> None:
    (case,) = map_cases(small, summarise_holes(small.holes, [VIEWS, REGISTRATION, MERGE]))
    single = name_of(1, "cpd", "grid")
    assert case.frames(single) == [1, 50]
    assert case.common_frames(single) == 50
    assert case.common_frames(single, None) is None
    chosen = case.named(1, "cpd", "grid")
    assert chosen.variant == single
    assert chosen.frames == 50
    assert chosen.views == 1
    assert case.named(1, "cpd", "grid", 7) is None
    assert case.named(2, "cpd", "grid", 1).frames == 1
    assert case.single(1).frames == 1
    assert set(case.runs(chosen)["variant"]) == {single}
    assert set(case.runs(chosen)["frames"]) == {50}
    assert set(case.holes(chosen)["frames"]) == {50}
    assert set(case.registrations(1)["frames"]) == {1}
    without = replace(case, summary=case.summary[case.summary["frames"] == 1])
    assert without.common_frames(single) == 1


def test_a_ratio_over_pairs_of_views_by_hand() -> None:
    """Root mean squares 1 and 2 against 2 and 2: ratios 2 and 1, geometric mean sqrt(2)."""
    first = pd.concat([registrations(view=1), registrations(view=2)], ignore_index=True)
    first["tre_mm"] = [0.6, np.sqrt(2 - 0.36), 2.0, 2.0]
    second = first.assign(tre_mm=2.0)
    ratio, low, high, pairs = paired_ratio(first, second, "tre_mm")
    # t(0.975, 1) = 12.7062 times ln(2) / sqrt(2) / sqrt(2)
    half = 12.7062 * np.log(2) / 2
    assert ratio == pytest.approx(np.sqrt(2))
    assert pairs == 2
    assert low == pytest.approx(np.sqrt(2) * np.exp(-half), rel=1e-4)
    assert high == pytest.approx(np.sqrt(2) * np.exp(half), rel=1e-4)
    nothing = first.assign(tre_mm=0.0)
    assert paired_ratio(first, nothing, "tre_mm")[3] == 0


def test_registrations_of_any_number_of_views_count_as_the_most() -> None:
    rows = pd.concat(
        [
            registrations(seconds=0.1).assign(**{VIEWS: 2.0}),
            registrations(seconds=0.2).assign(**{VIEWS: 5.0}),
            registrations(seconds=0.3).assign(**{VIEWS: "all"}),
        ],
        ignore_index=True,
    )
    assert of_map(rows, "marks", 2)["seconds"].tolist() == [0.1, 0.1]
    assert of_map(rows, "marks", 4)["seconds"].tolist() == [0.2, 0.2]
    assert of_map(rows[rows["seconds"] > 0.2], "marks", 9)["seconds"].tolist() == [0.3, 0.3]
    assert of_map(rows, "marks", 1).empty


def test_failures_are_counted_by_reason_most_frequent_first() -> None:
    rows = pd.concat([registrations()] * 5, ignore_index=True)
    rows["failure"] = ["", "b", "c", "b", "a", "d", "d", "d", "a", ""]
    rows["guess_tre_mm"] = np.arange(10.0)
    rows["seconds"] = np.arange(10.0)
    (row,) = summarise_registrations(rows).to_dict("records")
    assert row["n"] == 10
    assert row["failed"] == 8
    assert row["reasons"] == ["d (3)", "a (2)", "b (2)"]
    assert row["guess_mm"] == 4.5
    assert row["seconds"] == 4.5


def test_changes_in_words() -> None:
    change = Change(0.123, Interval(0.05, 0.187), 4)
    assert change_text(change) == "+0.12 mm (0.05 to 0.19)"
    assert change_text(Change(-0.001, UNKNOWN, 4)) == "+0.00 mm (interval unknown)"
    assert change_text(Change(np.nan, UNKNOWN, 0)) == "not compared"
    ratio = Change(np.log(0.6), Interval(np.log(0.5), np.log(0.7)), 4)
    assert ratio_text(ratio) == "× 0.60 (0.50 to 0.70)"
    assert ratio_text(Change(np.nan, UNKNOWN, 0)) == "not compared"
    assert span(Interval(-0.001, 1.25), 1) == "0.0 to 1.2"
    assert label_of("cpd", "grid", "0.7 m") == "cpd, grid, 0.7 m"
    assert label_of("", "") == "as declared"
    assert frames_text(1) == "1 frame a view"
    assert frames_text(2) == "2 frames a view"


def test_a_mean_change_by_hand() -> None:
    """Differences 1, 2 and 6: mean 3, standard deviation 2.645751, t(0.975, 2) = 4.302653."""
    change = change_of(np.array([1.0, np.nan, 2.0, 6.0, np.inf]))
    half = 4.302653 * np.sqrt(7.0) / np.sqrt(3)
    assert change.mean == 3.0
    assert change.n == 3
    assert change.interval.low == pytest.approx(3 - half, abs=1e-5)
    assert change.interval.high == pytest.approx(3 + half, abs=1e-5)
    assert change_of(np.array([1.0, np.nan])).n == 0


def test_size_errors_of_some_holes() -> None:
    first = holes([[11.0, 12.0], [5.5, 5.0]], repeats=2)
    second = holes([[10.5, 8.0], [4.0, 6.0]], repeats=2)
    errors = size_errors(first, second)
    assert errors.differences_mm.tolist() == [[0.5, -0.5], [1.0, 0.0]]
    assert errors.change(np.array([True, False])).mean == 0.75
    assert errors.change(np.array([False, True])).mean == -0.25
    assert errors.change().mean == 0.25
    assert errors.change(np.array([False, False])).n == 0
    # of a repeat in which a hole was not measured, the mean is of the others
    without_one = replace(errors, differences_mm=np.array([[0.5, np.nan], [1.0, 0.0]]))
    assert without_one.change().mean == 0.5


def test_a_ratio_needs_the_actual_and_the_predicted_error() -> None:
    rows = registrations(predicted_in_plane_mm=[0.25, np.nan])
    (row,) = summarise_registrations(rows).to_dict("records")
    assert row["in_plane_ratio"] == pytest.approx(0.3 / 0.25)
    assert row["in_plane_rms_mm"] == pytest.approx(np.sqrt((0.09 + 0.16) / 2))
    infinite = registrations(predicted_in_plane_mm=[0.25, np.inf])
    (row,) = summarise_registrations(infinite).to_dict("records")
    assert row["in_plane_predicted_mm"] == 0.25


def test_views_that_were_left_out_count_among_all_views(small) -> None:
    views = small.variants[VIEWS].astype(object)
    variants = small.variants.assign(**{VIEWS: views.where(small.variants[VIEWS] != 2.0, "all")})
    runs = small.runs.assign(views_left_out=0)
    of_two = runs["variant"] == name_of(2, "cpd", "grid")
    runs.loc[of_two & (runs["repeat"] == 0), ["views_used", "views_left_out"]] = [1, 4]
    set_ups = {
        set_up.variant: set_up for set_up in maps_of(replace(small, variants=variants, runs=runs))
    }
    assert set_ups[name_of(2, "cpd", "grid")].views == 5
    assert set_ups[name_of(2, "marks", "grid")].views == 2
    unfinished = replace(small, variants=variants, runs=runs.iloc[:0])
    assert {set_up.views for set_up in maps_of(unfinished)} == {0, 1}
