"""The claims on several views: borne out, refuted and undecided where the tables are made so."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest

from harness.evaluation.maps import CAMERA_UNIT, LARGE_MM, map_cases
from harness.evaluation.summary import summarise_holes
from harness.programs.thesis.views import VIEW_CLAIMS, rms_gap, score_views
from tests.support.synthetic_perspectives import MapWorld, name_of, perspectives, with_variation

UNIT_AXIS = pd.DataFrame([{"path": CAMERA_UNIT, "name": "unit", "unit": ""}])


def verdict(claim, results):
    summary = summarise_holes(results.holes, list(results.axes["path"]))
    with patch.dict(
        VIEW_CLAIMS, {claim: VIEW_CLAIMS[claim]}, clear=True
    ):  # the others would take most of the time
        (scored,) = score_views(map_cases(results, summary))
    return scored


def test_every_claim_is_judged_in_order():
    results = worlds(MapWorld())
    summary = summarise_holes(results.holes, list(results.axes["path"]))
    assert [scored.claim for scored in score_views(map_cases(results, summary))] == list(
        VIEW_CLAIMS
    )


def worlds(world, **settings):
    chosen = {
        "counts": (1, 2),
        "methods": ("icp", "cpd"),
        "merges": ("grid",),
        "frames": (1, 50),
    } | settings
    return perspectives(world, **chosen)


def in_units(results, units=3):
    """The same tables for several units of the camera, all alike."""
    units_tables = []
    for unit in range(1, units + 1):
        unit_tables = {
            name: getattr(results, name)
            for name in ("holes", "runs", "probes", "variants", "noise", "registrations")
        }
        for name, table in unit_tables.items():
            table = table.assign(**{CAMERA_UNIT: unit})
            for column in {"variant", "reference"} & set(table):
                table[column] = table[column].where(
                    table[column] == "", table[column] + f", unit={unit}"
                )
            unit_tables[name] = table
        units_tables.append(unit_tables)
    columns = {
        name: pd.concat([unit_part[name] for unit_part in units_tables], ignore_index=True)
        for name in units_tables[0]
    }
    return replace(results, **columns, axes=pd.concat([results.axes, UNIT_AXIS], ignore_index=True))


def registered(icp, cpd, **others):
    return MapWorld(tre_mm={"icp": icp, "cpd": cpd}, surface_mm=lambda *which: 0.2, **others)


@pytest.mark.parametrize(
    ("world", "expected"),
    [
        (registered((1.5, 0.1), (0.4, 0.1)), "borne out"),
        # ICP is the better within the plane
        (registered((0.4, 0.1), (1.5, 0.1)), "not borne out"),
        (
            registered((1.5, 0.5), (0.4, 0.1)),
            "not borne out",
        ),  # ICP leaves the marks out of the plane
        (registered((0.5, 0.1), (0.5, 0.1), spread=0.5), "undecided"),
        (
            registered((1.5, 0.156), (0.4, 0.1), spread=0.5),
            "undecided",
        ),  # ICP's error across is about the noise
        (registered((1.5, 0.1), (0.4, 0.1), failing={"cpd": 0.75}), "not borne out"),
    ],
)
def test_c7(world, expected):
    answer = verdict("C7", worlds(world, counts=(1, 9)))
    assert answer.verdict == expected
    assert "With 50 frames a view" in answer.evidence


def test_one_pair_of_views_says_nothing_of_others_however_often_it_is_repeated():
    assert verdict("C7", worlds(registered((1.5, 0.1), (0.4, 0.1)))).verdict == "undecided"


def test_c7_needs_both_methods():
    answer = verdict("C7", worlds(MapWorld(), methods=("cpd", "marks")))
    assert answer.verdict == "undecided"
    assert "does not try both" in answer.evidence


def sized(large, small, threshold, first=4):
    """|size error| of two views: that of one view, 1 mm, changed by so much for large and for
    small holes."""

    def bias(diameter, views, method, merge):
        return 1.0 + (views == 2) * (large if diameter >= LARGE_MM - 1e-9 else small)

    return MapWorld(
        size_bias_mm=bias,
        size_std_mm=0.1,
        threshold=lambda views, merge: 5.0 + threshold * (views - 1),
        surface_mm=lambda *which: 0.2,
        first=lambda views, method, merge, frames: first if views > 1 else 4,
    )


@pytest.mark.parametrize(
    ("world", "expected"),
    [
        (sized(-0.5, 0.5, 1.0), "borne out"),
        (sized(-0.5, 0.5, -1.0), "not borne out"),  # the threshold falls
        (sized(0.5, 0.5, 1.0), "not borne out"),
        (sized(-0.5, -0.5, 1.0), "not borne out"),
        (sized(0.0, 0.5, 1.0), "undecided"),
        (
            sized(-0.5, 0.5, 1.0, first=6),
            "borne out",
        ),  # two views miss both smaller holes that one view finds
    ],
)
def test_c8(world, expected):
    assert verdict("C8", in_units(worlds(world))).verdict == expected


@pytest.mark.parametrize(("threshold", "there"), [(1.0, "borne out"), (-1.0, "not borne out")])
def test_one_unit_says_nothing_of_others(threshold, there):
    alone = verdict("C8", worlds(sized(-0.5, 0.5, threshold)))
    assert alone.verdict == "undecided"
    assert (
        f"Judged on only 1 unit of the camera, so nothing follows for others: {there}"
        in alone.evidence
    )


def test_c8_tells_the_crossing_and_what_is_lost():
    answer = verdict("C8", worlds(sized(-0.5, 0.5, 1.0, first=5)))
    # from +0.5 at 7.94 mm to -0.5 at 9.53 mm
    assert "Found only by one view: 4." in answer.evidence


def slam(noise_mm, size_mm, place_mm, first=6):
    results = worlds(MapWorld(surface_mm=lambda *which: 0.2))
    world = MapWorld(
        surface_mm=lambda *which: noise_mm,
        size_bias_mm=lambda *which: 0.0,
        size_std_mm=size_mm,
        place_std_mm=place_mm,
        first=lambda *which: first,
    )
    return with_variation(
        results, world, "hand-held", (24, "odometry", "volume"), (1,), of=name_of(2, "cpd", "grid")
    )


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ((1.0, 2.0, 5.0), "borne out"),
        ((0.1, 2.0, 5.0), "not borne out"),  # less noise
        ((1.0, 0.01, 5.0), "not borne out"),  # better sizes
        ((1.0, 2.0, 0.01), "not borne out"),  # better places
        ((1.0, 2.0, 0.6), "undecided"),
        ((1.0, 2.0, 5.0, 12), "borne out"),  # it finds no hole at all
    ],
)
def test_c10(numbers, expected):
    assert verdict("C10", in_units(slam(*numbers))).verdict == expected


def test_two_units_are_too_few():
    assert verdict("C10", in_units(slam(1.0, 2.0, 5.0), 2)).verdict == "undecided"


def test_c10_without_a_slam_map_is_not_judged():
    answer = verdict("C10", worlds(MapWorld()))
    assert answer.verdict == "undecided"
    assert "no SLAM map" in answer.evidence


def mapped(noise, size, first=4, exposures=None):
    """Nine fused views against one: factor of noise, change of |size error|, smallest hole; and of
    one view of nine times the frames its noise."""

    def many(views, merge):
        return views == 9 and merge == "fusion"

    world = MapWorld(
        surface_mm=lambda views, method, merge, frames: (
            0.2 * (noise if many(views, merge) else 1.0)
        ),
        size_bias_mm=lambda d, views, method, merge: 1.0 + (size if many(views, merge) else 0.0),
        size_std_mm=0.1,
        first=lambda views, method, merge, frames: first if many(views, merge) else 4,
    )
    results = worlds(
        world, counts=(1, 9), methods=("marks",), merges=("grid", "fusion"), frames=(50,)
    )
    if exposures is None:
        return results
    rival = MapWorld(
        surface_mm=lambda *which: exposures, size_bias_mm=lambda *which: 1.0 + size, size_std_mm=0.1
    )
    return with_variation(results, rival, "as many exposures", (1, "marks", "grid"), (450,))


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        (dict(noise=0.3, size=-0.5), "borne out"),
        (dict(noise=0.3, size=-0.5, exposures=0.15), "borne out"),
        (
            dict(noise=0.3, size=-0.5, exposures=0.03),
            "not borne out",
        ),  # the long exposure has less noise
        (dict(noise=0.3, size=0.5), "not borne out"),
        (dict(noise=1.5, size=-0.5), "not borne out"),
        (dict(noise=0.3, size=-0.5, first=5), "not borne out"),  # a hole fewer
        (dict(noise=1.0, size=0.0), "undecided"),
    ],
)
def test_h1(numbers, expected):
    assert verdict("H1", mapped(**numbers)).verdict == expected


def test_h1_says_against_what_it_was_held():
    answer = verdict("H1", mapped(0.3, -0.5, first=3))
    assert "No single view has as many exposures" in answer.evidence
    assert "holes ahead, size ahead, noise ahead. Found 9 of 11 against 8 of 11" in answer.evidence
    assert (
        "of 50 frames against one of 450 frames"
        in verdict("H1", mapped(0.3, -0.5, exposures=0.1)).evidence
    )


def test_equal_exposures_are_found_within_the_table_too():
    # five views of 10 frames against one of 50
    world = MapWorld(surface_mm=lambda views, method, merge, frames: 0.2 / views)
    results = worlds(
        world, counts=(1, 5), methods=("marks",), merges=("grid", "fusion"), frames=(10, 50)
    )
    assert (
        "5 views (marks, fusion) of 10 frames against one of 50 frames"
        in verdict("H1", results).evidence
    )


def test_a_gap_of_root_mean_squares_covers_the_truth():
    rng = np.random.default_rng(2)
    inside = 0
    for _ in range(100):
        gap = rms_gap(rng.normal(0, 2.0, (40, 3)), rng.normal(0, 1.0, (40, 3)))
        inside += gap.low <= 1.0 <= gap.high
    # 95 expected of 100; fewer than 86 have a chance of 1e-4 at nominal coverage
    assert inside >= 86
    assert not rms_gap(np.zeros((1, 2)), np.ones((5, 2))).known
