"""Set-ups side by side: each column of their table by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from harness.evaluation.set_ups import (
    RESAMPLES,
    Ladder,
    _errors,
    compare_set_ups,
    found_limit_mm,
    set_ups_of,
)
from harness.evaluation.summary import summarise_holes
from tests.support.synthetic_tables import DIAMETERS_MM, Tables, World, joined, tables

WORLD = World(repeats=6, rate=lambda hole, frames: float(hole >= 5))


def summary_of(parts: Tables) -> pd.DataFrame:
    return summarise_holes(parts.holes)


@pytest.fixture(scope="module")
def two_variants() -> Tables:
    """The set-up "main" and a variation with a shifted threshold."""
    other_world = WORLD.changed(threshold={50: 7.0})
    return joined(tables(WORLD, (1, 50)), tables(other_world, (50,), "varied"))


def test_set_ups_are_those_that_vary_nothing(two_variants: Tables) -> None:
    assert set_ups_of(two_variants) == ["main"]


def test_a_row_holds_what_its_trials_say(two_variants: Tables) -> None:
    compared = compare_set_ups(two_variants, summary_of(two_variants), ["varied", "main"])
    assert compared["variant"].tolist() == ["varied", "main", "main"]
    assert compared["frames"].tolist() == [50, 1, 50]
    row = compared.iloc[2]
    assert row["holes"] == 11
    assert row["repeats"] == 6
    assert row["found"] == [str(number) for number in range(5, 12)]
    assert row["undecided"] == []
    assert row["limit_mm"] == pytest.approx(DIAMETERS_MM[4])
    assert row["half_mm"] == pytest.approx((DIAMETERS_MM[3] + DIAMETERS_MM[4]) / 2)
    assert row["half_low_mm"] == row["half_high_mm"] == pytest.approx(row["half_mm"])
    assert np.isnan(compared.iloc[0]["half_mm"])
    assert row["runs"] == 6
    assert row["false_calls"] == 1
    assert row["threshold"] == 5.0
    assert compared.iloc[0]["threshold"] == 7.0
    damaged = two_variants.runs[
        (two_variants.runs["role"] == "damaged") & (two_variants.runs["frames"] == 50)
    ]
    scale_mm = damaged["scale_mm"][damaged["variant"] == "main"].mean()
    assert row["threshold_mm"] == pytest.approx(5.0 * scale_mm)
    assert row["surface_mm"] == pytest.approx(0.9 / np.sqrt(50))
    assert row["pitch_u_mm"] == pytest.approx(1.5)
    assert "half_mm" not in compare_set_ups(
        two_variants, summary_of(two_variants), ["main"], half_sizes=False
    )


def test_errors_of_measures_are_over_trials_of_found_holes(two_variants: Tables) -> None:
    row = compare_set_ups(two_variants, summary_of(two_variants), ["main"]).iloc[1]
    holes = two_variants.holes
    trials = holes[(holes["variant"] == "main") & (holes["frames"] == 50)]
    of_found = trials[trials["hole"].astype(int) >= 5]
    size_error = of_found["extent_diameter_mm"] - of_found["true_diameter_mm"]
    assert row["extent_n"] == 42
    assert row["extent_bias_mm"] == pytest.approx(size_error.mean())
    assert row["extent_std_mm"] == pytest.approx(size_error.std(ddof=1))
    assert row["model_bias_mm"] == pytest.approx(0.1)
    # the largest hole lies at offset 0, from which the others' distances count
    away = of_found[of_found["true_offset_mm"] > 0]
    place_error = away["extent_offset_mm"] - away["true_offset_mm"]
    assert row["extent_place_n"] == 36
    assert row["extent_place_bias_mm"] == pytest.approx(place_error.mean())
    assert row["extent_place_std_mm"] == pytest.approx(place_error.std(ddof=1))


def test_the_deviation_of_errors_needs_two() -> None:
    assert _errors("a", pd.Series([1.0, 4.0])) == {
        "a_bias_mm": 2.5,
        "a_std_mm": pytest.approx(np.sqrt(4.5)),
        "a_n": 2,
    }
    single = _errors("a", pd.Series([3.0]))
    assert single["a_bias_mm"] == 3.0
    assert np.isnan(single["a_std_mm"])
    nothing = _errors("a", pd.Series([], dtype=float))
    assert np.isnan([nothing["a_bias_mm"], nothing["a_std_mm"]]).all()


def test_two_largest_holes_leave_no_distances(two_variants: Tables) -> None:
    holes = two_variants.holes.copy()
    holes.loc[holes["hole"] == "10", "true_diameter_mm"] = DIAMETERS_MM[10]
    level = replace(two_variants, holes=holes)
    row = compare_set_ups(level, summary_of(level), ["main"]).iloc[0]
    assert row["extent_place_n"] == 0
    assert np.isnan(row["extent_place_bias_mm"])


def test_nothing_finished_gives_an_empty_table(two_variants: Tables) -> None:
    assert compare_set_ups(two_variants, summary_of(two_variants), ["unknown"]).empty


def test_a_limit_is_nan_if_the_largest_hole_is_missed() -> None:
    rows = pd.DataFrame({"true_diameter_mm": [1.0, 2.0], "status": ["found", "undecided"]})
    assert np.isnan(found_limit_mm(rows))
    assert found_limit_mm(rows.assign(status="found")) == 1.0


def test_the_bootstrap_draws_holes_within_sizes_and_repeats() -> None:
    """Two sizes of two holes; half of the trials of the larger find it: the same draws by hand."""
    detected = np.array(
        [[False, False, True, False], [False, True, True, True], [False, False, False, True]]
    )
    ladder = Ladder(np.array([1.0, 1.0, 3.0, 3.0]), detected)
    rng = np.random.default_rng(0)
    of_repeats = rng.multinomial(3, np.full(3, 1 / 3), RESAMPLES)
    of_small = rng.multinomial(2, np.full(2, 0.5), RESAMPLES)
    of_large = rng.multinomial(2, np.full(2, 0.5), RESAMPLES)
    for draw in range(0, RESAMPLES, 97):
        by_hole = of_repeats[draw] @ detected / 3
        small = (by_hole[:2] * of_small[draw]).sum() / 2
        large = (by_hole[2:] * of_large[draw]).sum() / 2
        if small > large:  # pooled
            small = large = (small + large) / 2
        expected = np.inf
        if small >= 0.5:
            expected = 1.0
        elif large >= 0.5:
            expected = 1.0 + 2.0 * (0.5 - small) / (large - small)
        assert ladder.half_draws_mm[draw] == pytest.approx(expected)
    assert len(ladder.half_draws_mm) == RESAMPLES
