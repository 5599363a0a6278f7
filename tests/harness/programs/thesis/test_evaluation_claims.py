"""Every claim reaches every verdict, on tables whose answer is known."""

from __future__ import annotations

import dataclasses
import json
from itertools import permutations
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest
from scipy.stats import spearmanr

from harness.evaluation.profile import HoleShape, hole_shape, hole_shapes
from harness.programs.thesis.claims import (
    RULES,
    decide,
    falling_rank,
    p_text,
    scatter_ratio,
    score_claims,
)
from harness.records.examples import ExampleCloud, HoleInView
from harness.records.trials import CLAIMS, hole_list
from harness.report.claims import Verdict
from tests.support.synthetic_tables import World, example, joined, tables


def verdict(
    claim: str, world: World | None = None, frames: tuple[int, ...] = (1, 10, 50)
) -> Verdict:
    with patch.dict(
        RULES, {claim: RULES[claim]}, clear=True
    ):  # the others would take most of the time
        (judged,) = score_claims(tables(world, frames=frames))
    return judged


def rate(many: float, few: float, of: int) -> World:
    """The thesis' answer but for one hole, detected at these rates."""
    usual = World().rate

    def of_hole(hole: int, frames: int) -> float:
        if hole != of:
            return usual(hole, frames)
        return many if frames == 50 else few

    return World(rate=of_hole)


CASES = {
    "C1": (
        (World(), "borne out"),
        (rate(1.0, 0.0, of=3), "borne out"),
        (rate(0.0, 0.0, of=4), "not borne out"),
        (rate(0.5, 0.0, of=4), "undecided"),
    ),
    "C1b": (
        (World(), "borne out"),
        (rate(1.0, 0.0, of=3), "not borne out"),
        (rate(0.0, 0.0, of=4), "borne out"),
        (rate(0.5, 0.0, of=3), "undecided"),
    ),
    "C2": (
        (World(), "borne out"),
        (rate(1.0, 1.0, of=4), "not borne out"),
        (rate(1.0, 0.5, of=5), "undecided"),
        (World(threshold={1: 1.0, 10: 3.0, 50: 5.0}), "not borne out"),
    ),
    "C3": (
        (World(), "borne out"),
        (World(size_bias_mm=lambda diameter: 2.4 if diameter < 7 else 0.0), "not borne out"),
        (World(size_bias_mm=lambda diameter: 1.2), "undecided"),
        (World(size_bias_mm=lambda diameter: -2.4), "not borne out"),
    ),
    "C4": (
        (World(), "borne out"),
        (World(size_bias_mm=lambda diameter: 0.1 * diameter), "not borne out"),
        (
            World(size_bias_mm=lambda diameter: 1.0 + 0.3 * np.cos(2 * diameter) - 0.01 * diameter),
            "undecided",
        ),
    ),
    "C5": (
        (World(), "borne out"),
        (World(place_bias_mm=3.0), "not borne out"),
        (World(place_std_mm=0.6), "not borne out"),
        (World(place_std_mm=1.2), "undecided"),
    ),
    "C9": (
        (World(), "borne out"),
        (World(temporal_mm=lambda n: 0.9 * n**-0.2), "not borne out"),
        (World(pattern_mm=lambda n: 0.6 / n**0.5, offset_mm=0.0), "not borne out"),
        (World(pattern_mm=lambda n: 0.27 if n == 50 else 0.3, offset_mm=0.0, seed=2), "undecided"),
    ),
}


@pytest.mark.parametrize(
    ("claim", "world", "answer"),
    [(claim, world, answer) for claim, rows in CASES.items() for world, answer in rows],
)
def test_each_verdict_is_reachable(claim: str, world: World, answer: str) -> None:
    assert verdict(claim, world).verdict == answer


@pytest.mark.parametrize("shape", ["bowl", "cylinder"])
def test_shapes_are_told_apart(shape: str) -> None:
    scored = score_claims(tables(frames=(50,)), examples=[example(50, shape)])
    c6 = next(v for v in scored if v.claim == "C6")
    assert c6.verdict == ("borne out" if shape == "bowl" else "not borne out")


def test_c6_is_undecided_without_a_cloud_or_with_mixed_holes() -> None:
    assert verdict("C6").verdict == "undecided"
    one_frame = score_claims(tables(), examples=[example(1)])
    assert next(v for v in one_frame if v.claim == "C6").verdict == "undecided"
    round_ = example(50, "bowl")
    flat = example(50, "cylinder")
    mixed = round_.residual_mm.copy()
    mixed[:, 250:] = flat.residual_mm[:, 250:]
    scored = score_claims(tables(), examples=[dataclasses.replace(round_, residual_mm=mixed)])
    assert next(v for v in scored if v.claim == "C6").verdict == "undecided"


@pytest.mark.parametrize(
    ("bowls", "cylinders", "unclear", "answer"),
    [
        (5, 0, 3, "borne out"),
        (4, 0, 4, "undecided"),
        (7, 1, 0, "undecided"),
        (0, 5, 3, "not borne out"),
        (0, 4, 4, "undecided"),
        (1, 7, 0, "undecided"),
    ],
)
def test_c6_needs_most_holes_and_no_other(
    bowls: int, cylinders: int, unclear: int, answer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    misfits = [(0.1, 1.0)] * bowls + [(1.0, 0.1)] * cylinders + [(1.0, 1.0)] * unclear
    shapes = [
        HoleShape(
            hole=str(number),
            pixels=20,
            bowl_rms_mm=bowl_mm,
            cylinder_rms_mm=cylinder_mm,
            true_bowl_rms_mm=cylinder_mm,
            true_cylinder_rms_mm=bowl_mm,
        )
        for number, (bowl_mm, cylinder_mm) in enumerate(misfits, start=1)
    ]
    monkeypatch.setattr("harness.programs.thesis.claims.hole_shapes", lambda cloud: shapes)
    scored = score_claims(tables(frames=(50,)), examples=[example(50)])
    c6 = next(v for v in scored if v.claim == "C6")
    assert c6.verdict == answer
    assert c6.evidence.endswith(f"closer to a bowl in {cylinders} of 8 holes.")


@pytest.mark.parametrize("claim", ["C1", "C3", "C4", "C5"])
def test_missing_counts_are_undecided_and_say_why(claim: str) -> None:
    answer = verdict(claim, frames=(1, 10))
    assert answer.verdict == "undecided"
    assert "50 frames" in answer.evidence


def test_nothing_found_is_no_evidence() -> None:
    scored = score_claims(tables(World(rate=lambda hole, frames: 0.0), frames=(1, 50)))
    assert [v.verdict for v in scored] == ["not borne out", "borne out", "not borne out"] + [
        "undecided"
    ] * 4 + ["borne out"]


def test_another_target_is_not_the_thesis() -> None:
    other_target = tables(frames=(1, 50))
    other_target = dataclasses.replace(
        other_target, holes=other_target.holes[other_target.holes["hole"] != "3"]
    )
    scored = {v.claim: v for v in score_claims(other_target)}
    assert scored["C1"].verdict == "undecided"
    assert "eleven" in scored["C1"].evidence


def test_evidence_carries_the_numbers() -> None:
    answer = verdict("C1b", rate(42 / 50, 0.0, of=3))
    assert "More than the thesis: 3" in answer.evidence
    assert "42 of 50 (3)" in answer.evidence
    assert (
        "hole 4 +2.0 (1.5 to 2.5)"
        in verdict("C3", World(size_bias_mm=lambda diameter: 2.4)).evidence
    )
    assert "that it falls with the diameter" in verdict("C4").evidence
    assert "ratio of the variances of position and size 4.00" in verdict("C5").evidence


@pytest.mark.parametrize(
    ("bias_mm", "std_mm", "agreeing"),
    [
        # the largest hole is the reference, so seven positions are compared
        (
            1.3,
            0.8,
            "7 of 7 mean positions agree;",
        ),  # within a graduation of 1.59 mm, but not within a deviation
        (1.9, 0.8, "0 of 7 mean positions agree (except 4–10);"),
        (
            1.9,
            2.8,
            "7 of 7 mean positions agree;",
        ),  # within a deviation, but not within a graduation
    ],
)
def test_positions_agree_within_the_larger_of_scatter_and_graduation(
    bias_mm: float, std_mm: float, agreeing: str
) -> None:
    world = World(place_bias_mm=bias_mm, place_std_mm=std_mm)
    assert verdict("C5", world).evidence.startswith(agreeing)


def test_four_holes_are_enough_to_rank() -> None:
    """The only order of four that falls throughout has a chance of 1 in 24."""
    four = World(rate=lambda hole, frames: float(hole >= 8))
    answer = verdict("C4", four)
    assert answer.verdict == "borne out"
    assert "over 4 holes (one-sided p = 0.042 that it falls" in answer.evidence
    three = World(rate=lambda hole, frames: float(hole >= 9))
    assert verdict("C4", three).evidence == "Only 3 holes are found with 50 frames."


def test_sizes_are_held_against_the_scatter_between_units_too() -> None:
    biases = {"main": 0.4, "unit 2": 1.4, "unit 3": 1.2}
    parts = [
        tables(World(size_bias_mm=lambda _, bias=bias: bias), frames=(50,), variant=variant)
        for variant, bias in biases.items()
    ]
    for number, part in enumerate(parts[1:], 2):
        part.variants["settings"] = json.dumps({"source.camera.unit_seed": number})
    other_distance = tables(
        World(size_bias_mm=lambda _: 30.0), frames=(50,), variant="nearer"
    )  # no unit: left out
    evidence = next(
        v.evidence for v in score_claims(joined(*parts, other_distance)) if v.claim == "C3"
    )
    assert "Between 3 units: hole 4 +1.9," in evidence  # 1.0 mm in the mean, by 0.53 mm
    assert "Between units: not judged" in verdict("C3").evidence


def test_the_table_of_claims_has_a_row_for_each_verdict() -> None:
    table = CLAIMS.frame(map(vars, score_claims(tables(frames=(1, 50)))))
    assert list(table["claim"]) == list(RULES)
    assert list(table.columns) == ["claim", "text", "verdict", "evidence", "rule"]
    assert list(CLAIMS.frame([]).columns) == list(table.columns)


def test_rank_test_is_the_exact_permutation_test() -> None:
    rng = np.random.default_rng(2)
    x = rng.normal(size=6)
    y = rng.normal(size=6)
    rho, p = falling_rank(x, y)
    assert rho == pytest.approx(spearmanr(x, y).statistic)
    correlations = [spearmanr(x, np.array(order)).statistic for order in permutations(y)]
    assert p == pytest.approx(np.mean(np.array(correlations) <= rho + 1e-12))
    assert falling_rank(np.arange(4.0), -np.arange(4.0)) == (
        pytest.approx(-1),
        pytest.approx(1 / 24),
    )
    assert falling_rank(np.arange(4.0), np.ones(4)) == (0.0, 1.0)
    # of more than 8 pairs, 20,000 random orders and the given one
    assert falling_rank(np.arange(9.0), -np.arange(9.0))[1] == pytest.approx(1 / 20_001)
    # seven falling pairs have a chance of 1 in 5,040, of which texts tell that it is small
    assert (p_text(1 / 5040), p_text(0.0014)) == ("< 0.001", "= 0.001")


def test_scatter_ratio_by_hand() -> None:
    offsets_mm = [1.0, 3.0, 5.0, np.nan]
    size = [1.0, 2.0, 3.0, 9.0]
    rows = pd.DataFrame(
        {
            "repeat": range(4),
            "hole": "5",
            "extent_offset_mm": offsets_mm,
            "extent_diameter_mm": size,
        }
    )
    assert scatter_ratio(rows, "extent_offset_mm", "extent_diameter_mm")[0] == pytest.approx(4.0)
    rows["extent_diameter_mm"] = 2.0
    assert scatter_ratio(rows, "extent_offset_mm", "extent_diameter_mm")[0] == np.inf


def test_hole_lists_and_decisions() -> None:
    assert hole_list(["4", "5", "6", "9", "11", "10", "dent"]) == "4–6, 9–11, dent"
    assert hole_list([]) == "none"
    assert decide([True, True]) == "borne out"
    assert decide([None, False]) == "not borne out"
    assert decide([None, True]) == "undecided"
    assert decide([]) == "undecided"


def test_bowl_fit_by_its_own_shape() -> None:
    cloud = example(50, "bowl", noise_mm=0.0)
    shape = hole_shape(cloud, cloud.truth[-1])
    assert shape is not None
    assert shape.bowl_rms_mm == pytest.approx(0, abs=1e-9)
    assert shape.true_cylinder_rms_mm == pytest.approx(0, abs=1e-9)


def test_holes_too_small_or_too_invalid_are_not_judged() -> None:
    cloud = example(50)
    assert {shape.hole for shape in hole_shapes(cloud)}.isdisjoint({"1", "2", "3"})
    blind: ExampleCloud = dataclasses.replace(
        cloud, residual_mm=np.where(cloud.residual_mm > 6, np.nan, cloud.residual_mm)
    )
    assert hole_shape(blind, cloud.truth[-1]) is None
    lonely = HoleInView("1", 0.0, 0.0, 0.4, 1.0, 5.0)
    assert hole_shape(cloud, lonely) is None
