"""Summaries of holes and false calls, by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from harness.evaluation.summary import (
    FOUND_RULE,
    false_calls,
    found_holes,
    found_rule,
    summarise_holes,
)
from tests.support.synthetic_tables import World, joined, tables


def test_a_hole_by_hand() -> None:
    holes = tables(World(repeats=4), frames=(50,)).holes
    holes = holes[holes["hole"] == "8"].copy()
    holes["detected"] = [True, True, True, False]
    holes["extent_diameter_mm"] = [12.0, 13.0, 14.0, np.nan]
    holes["extent_offset_mm"] = [150.0, 152.0, 154.0, np.nan]
    holes["state"] = ["found", "found", "wrong depth", "invalid"]
    row = summarise_holes(holes).iloc[0]
    assert row["n"] == 4
    assert row["detected"] == 3
    assert row["rate"] == 0.75
    assert row["extent_measured"] == 3
    assert row["extent_diameter_mean_mm"] == 13.0
    assert row["extent_diameter_std_mm"] == 1.0
    assert row["extent_bias_mm"] == pytest.approx(0.3)
    # t(0.975, 2) = 4.302653 over sqrt(3)
    assert row["extent_bias_high_mm"] - row["extent_bias_mm"] == pytest.approx(
        4.302653 / np.sqrt(3), abs=1e-6
    )
    assert row["extent_offset_std_mm"] == 2.0
    assert row["extent_offset_bias_mm"] == pytest.approx(152.0 - 152.4)

    assert row["status"] == "undecided"


def test_rows_are_in_order() -> None:
    two_variants = joined(tables(frames=(1, 50), variant="far"), tables(frames=(1, 50)))
    summary = summarise_holes(two_variants.holes)
    assert list(summary["variant"].unique()) == ["main", "far"]
    main = summary[(summary["variant"] == "main") & (summary["frames"] == 1)]
    assert list(main["hole"]) == [str(n) for n in range(1, 12)]


@pytest.mark.parametrize(
    ("detected", "status"), [(17, "missed"), (18, "missed"), (25, "undecided"), (33, "found")]
)
def test_found_missed_or_undecided(detected: int, status: str) -> None:
    world = World(rate=lambda hole, frames: detected / 50)
    summary = summarise_holes(tables(world, frames=(50,)).holes)
    assert set(found_holes(summary, "main", 50).values()) == {status}
    assert found_holes(summary, "main", 7) == {}


def test_false_calls_with_poisson_interval() -> None:
    runs = tables(frames=(1,)).runs
    calls = false_calls(runs).set_index("role")
    # The hole-free runs set the threshold: they are no test of it.
    assert list(calls.index) == ["damaged"]
    damaged = calls.loc["damaged"]
    assert damaged["runs"] == 50
    assert damaged["false_calls"] == 1
    assert damaged["per_run"] == 0.02
    assert damaged["per_run_low"] == pytest.approx(0.0253 / 50, abs=1e-6)
    assert damaged["per_run_high"] == pytest.approx(5.5716 / 50, abs=1e-6)
    assert damaged["threshold_mm"] == pytest.approx(5 * 0.9, abs=0.01)
    assert damaged["quiet_runs"] == 50
    assert damaged["quiet_highest"] == 5.0


def test_threshold_and_noise_of_runs_are_means() -> None:
    """Half of the runs have three times the noise of the others, and half the threshold."""
    runs = tables(frames=(1,)).runs
    is_damaged = runs["role"] == "damaged"
    is_noisy = is_damaged & (runs["repeat"] < 25)
    runs.loc[is_damaged, ["surface_noise_mm", "threshold", "scale_mm"]] = [1.0, 6.0, 0.5]
    runs.loc[is_noisy, ["surface_noise_mm", "threshold", "scale_mm"]] = [3.0, 3.0, 1.5]
    damaged = false_calls(runs).set_index("role").loc["damaged"]
    assert damaged["surface_noise_mm"] == pytest.approx(2.0)
    assert damaged["threshold"] == pytest.approx(4.5)
    assert damaged["threshold_mm"] == pytest.approx((3.0 + 4.5) / 2)


def test_hole_free_runs_at_a_given_threshold_are_counted() -> None:
    runs = tables(frames=(1,)).runs
    runs.loc[runs["role"] == "hole_free", ["threshold", "false_calls"]] = [3.0, 2]
    calls = false_calls(runs).set_index("role")
    assert calls.loc["hole_free", "false_calls"] == 100
    assert calls.loc["hole_free", "per_run"] == 2.0


def test_a_repeat_of_rows_changes_counts_not_means() -> None:
    holes = tables(frames=(50,)).holes
    once = summarise_holes(holes)
    twice = summarise_holes(pd.concat([holes, holes], ignore_index=True))
    pd.testing.assert_series_equal(
        once["extent_diameter_mean_mm"], twice["extent_diameter_mean_mm"]
    )
    assert (twice["n"] == 2 * once["n"]).all()
    assert (twice["rate_high"] - twice["rate_low"] < once["rate_high"] - once["rate_low"]).all()


def test_too_few_trials_to_find_anything_are_told():
    for repeats, status in ((3, "undecided"), (4, "found")):
        summary = summarise_holes(
            tables(World(repeats=repeats), frames=(50,)).holes.assign(detected=True)
        )
        assert set(summary["status"]) == {status}
    assert found_rule(4) == FOUND_RULE
    assert "3 repeats are too few for either" in found_rule(3)


def test_fits_of_a_hole_are_compared_with_the_truth() -> None:
    holes = tables(World(repeats=4), frames=(50,)).holes
    holes = holes[holes["hole"] == "8"].copy()
    true_mm = holes["true_diameter_mm"].iloc[0]
    holes["detected"] = [True, True, True, False]
    holes["model_diameter_mm"] = [true_mm + 0.58, true_mm - 0.60, true_mm + 0.59, np.nan]
    holes["model_diameter_se_mm"] = [0.3, 0.3, 0.4, np.nan]
    holes["model_depth_mm"] = [9.0, 10.0, 14.0, np.nan]
    holes["model_depth_se_mm"] = [0.5, 0.7, 0.9, np.nan]
    holes["seen_depth_mm"] = 12.0
    holes["median_residual_mm"] = [1.0, 2.0, 3.0, 6.0]
    holes["invalid_fraction"] = [0.0, 0.2, 0.0, 0.2]
    row = summarise_holes(holes).iloc[0]
    # 1.93, 2.0 and 1.475 standard errors: within 1.96 are two of three
    assert row["model_diameter_covered"] == pytest.approx(2 / 3)
    assert row["model_diameter_se_mean_mm"] == pytest.approx(1.0 / 3)
    assert row["model_bias_mm"] == pytest.approx(0.19)
    assert row["model_depth_mean_mm"] == 11.0
    assert row["model_depth_se_mean_mm"] == pytest.approx(0.7)
    assert row["model_depth_std_mm"] == pytest.approx(np.sqrt(7.0))
    assert row["model_depth_bias_mm"] == -1.0
    assert row["median_residual_mm"] == 3.0
    assert row["invalid_fraction"] == 0.1


def test_axes_are_kept_beside_the_holes() -> None:
    holes = tables(World(repeats=4), frames=(50,)).holes.assign(distance=0.7)
    assert set(summarise_holes(holes, ["distance"])["distance"]) == {0.7}


def test_holes_with_names_follow_those_with_numbers() -> None:
    holes = tables(World(repeats=4), frames=(50,)).holes
    renamed = holes.assign(hole=holes["hole"].replace({"3": "b", "1": "a"}))
    order = ["2", *map(str, range(4, 12)), "a", "b"]
    assert list(summarise_holes(renamed)["hole"]) == order
    assert summarise_holes(pd.DataFrame()).empty
