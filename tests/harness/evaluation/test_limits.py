"""Detection limits on ladders of known answer, and what switches cost."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.evaluation.intervals import percentiles
from harness.evaluation.set_ups import Ladder, effect_costs, found_limit_mm, half_size, ladder_of
from harness.evaluation.summary import summarise_holes
from tests.support.synthetic_tables import World, joined, tables


def ladder(
    rates: list[float],
    copies: int = 1,
    repeats: int = 20,
) -> Ladder:
    """Holes of 1, 2, 3 ... mm, found in exactly these shares of the repeats."""
    sizes = np.repeat(np.arange(1.0, len(rates) + 1), copies)
    detected = np.arange(repeats)[:, None] < np.repeat(np.array(rates) * repeats, copies).round()
    return Ladder(sizes, detected)


@pytest.mark.parametrize(
    ("rates", "expected"),
    [
        ([0.0, 0.0, 1.0, 1.0], 2.5),
        ([0.0, 0.25, 0.75, 1.0], 2.5),
        ([0.0, 0.0, 0.25, 1.0], 3 + (0.5 - 0.25) / 0.75),
        ([0.0, 0.5, 1.0, 1.0], 2.0),
        # a drop is pooled with its neighbour: 0.6 and 0.2 are 0.4 both
        ([0.0, 0.6, 0.2, 1.0], 3 + (0.5 - 0.4) / 0.6),
        ([1.0, 1.0, 1.0, 1.0], 1.0),
        ([0.0, 0.1, 0.2, 0.4], np.inf),
    ],
)
def test_half_size_by_hand(rates, expected):
    assert half_size(np.arange(1.0, 5), np.array([rates]))[0] == pytest.approx(expected)
    assert ladder(rates).half_mm == pytest.approx(expected)
    assert ladder(rates).at_the_end == (not 1 < expected < np.inf)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(0, 1), min_size=2, max_size=12))
def test_half_size_lies_on_the_ladder_and_falls_when_more_is_found(rates):
    sizes = np.arange(1.0, len(rates) + 1)
    half_mm = half_size(sizes, np.array([rates]))[0]
    assert half_mm == np.inf or sizes[0] <= half_mm <= sizes[-1]
    assert half_size(sizes, np.minimum(1, np.array([rates]) + 0.1))[0] <= half_mm + 1e-9


def test_interval_is_a_point_without_chance_and_covers_with_it():
    certain = ladder([0, 0, 1, 1], copies=3)
    interval = percentiles(certain.half_draws_mm)
    assert interval.low == interval.high == 2.5
    rng = np.random.default_rng(1)
    sizes = np.repeat(np.arange(1.0, 10), 3)
    chance = 1 / (1 + np.exp(-(np.repeat(np.arange(1.0, 10), 3) - 5)))
    covered = [
        (drawn := percentiles(Ladder(sizes, rng.random((10, 27)) < chance).half_draws_mm)).low
        <= 5
        <= drawn.high
        for _ in range(40)
    ]
    # 95 % nominal; 32 of 40 or fewer would have a chance below 0.001
    assert sum(covered) >= 33


def test_limit_needs_every_larger_hole():
    rows = pd.DataFrame(
        {"true_diameter_mm": [1.0, 2.0, 3.0, 3.0, 4.0], "status": ["missed"] + ["found"] * 4}
    )
    assert found_limit_mm(rows) == 2.0
    assert (
        found_limit_mm(rows.assign(status=["found", "found", "found", "undecided", "found"])) == 4.0
    )
    assert np.isnan(found_limit_mm(rows.assign(status=["found"] * 4 + ["missed"])))


def test_ladder_from_the_table_of_holes():
    table = tables(World(rate=lambda hole, frames: float(hole >= 4), repeats=6), (50,)).holes
    ladder_of_table = ladder_of(table)
    assert ladder_of_table.detected.shape == (6, 11)
    assert ladder_of_table.half_mm == pytest.approx((4.7625 + 6.35) / 2)
    assert found_limit_mm(summarise_holes(table)) == pytest.approx(6.35)


PLACED = ("holes", "runs", "probes", "variants", "noise")


def switched(first_found: dict[tuple[str, ...], int], names: tuple[str, ...]):
    """Tables of set-ups by what is on, each finding all holes from a number on."""
    parts = []
    for effects, first in first_found.items():
        name = "+".join(effects) or "none"
        part = tables(
            World(rate=lambda hole, frames, first=first: float(hole >= first), repeats=6),
            (1, 50),
            name,
        )
        variants = part.variants.assign(
            is_variation=False,
            reference=name,
            switches=json.dumps({n: n in effects for n in names}),
        )
        part = replace(part, variants=variants)
        tables_with_axis = {
            t: getattr(part, t).assign(**{"source.camera.effects": name}) for t in PLACED
        }
        parts.append(replace(part, **tables_with_axis))
    axes = pd.DataFrame([{"path": "source.camera.effects", "name": "effects", "unit": ""}])
    return replace(joined(*parts), axes=axes)


def test_costs_are_differences_of_the_half_sizes():
    names = ("noise", "fixed_pattern")
    rows = effect_costs(switched({(): 3, ("noise",): 5, ("fixed_pattern",): 4, names: 6}, names))
    assert rows["frames"].tolist() == [1] * 5 + [50] * 5
    assert (
        rows["effect"].tolist() == ["noise", "fixed pattern", "noise", "fixed pattern", "all"] * 2
    )
    assert (
        rows["against"].tolist()
        == ["nothing", "nothing", "all others", "all others", "nothing"] * 2
    )
    step = 25.4 / 16
    assert rows["loss_mm"].tolist() == pytest.approx([2 * step, step, 2 * step, step, 3 * step] * 2)
    assert rows["on_ladder"].all()
    assert rows["loss_low_mm"][0] == pytest.approx(
        rows["loss_high_mm"][0]
    )  # the same chance on both sides


def test_a_size_off_the_ladder_gives_a_bound():
    names = ("noise", "fixed_pattern")
    rows = effect_costs(switched({(): 1, ("noise",): 99, ("fixed_pattern",): 4, names: 99}, names))
    noise_alone, pattern_alone, _, pattern_last = rows["loss_mm"][:4]
    assert noise_alone == np.inf
    # all holes are lost with the noise, with the pattern and without it
    assert np.isnan(pattern_last)
    # nothing on finds the smallest hole already
    assert not rows["on_ladder"][0]
    assert not rows["on_ladder"][1]
    assert np.isfinite(pattern_alone)


def test_without_switches_there_are_no_costs():
    assert effect_costs(tables()).empty
