"""Claim C11 on comparisons of known answer: borne out, not borne out, undecided."""

from __future__ import annotations

import pandas as pd
import pytest

from harness.evaluation.set_ups import compare_set_ups, set_ups_of
from harness.evaluation.summary import summarise_holes
from harness.programs.thesis.cameras import claim_c11
from tests.support.synthetic_tables import World, cameras, joined, placed, set_up_name, tables

UNIT = "source.camera.unit_seed"
AXES = ["source.camera.name", "source.target.distance_m", UNIT]


def judged(results, units=3, axes=AXES):
    """C11 on these tables, all units of a camera being alike."""
    holes = results.holes
    parts = [
        holes.assign(**{UNIT: unit, "variant": holes["variant"] + f", unit={unit}"})
        for unit in range(units)
    ]
    return claim_c11(summarise_holes(pd.concat(parts, ignore_index=True), AXES), axes)


def verdict(azure, v2, l515, **changes):
    results = cameras(
        {"azure_kinect_nfov": azure, "kinect_v2": v2, "realsense_l515": l515}, **changes
    )
    answer = judged(results)
    assert answer is not None
    return answer


@pytest.mark.parametrize(
    ("azure", "v2", "l515", "expected"),
    [
        ((3, 4), (4, 5), (4, 4), "borne out"),  # ahead of each somewhere, behind nowhere
        ((3, 4), (4, 5), (3, 4), "not borne out"),  # surely level with L515 everywhere
        ((3, 4), (4, 5), (4, 3), "not borne out"),  # behind L515 at one distance
        ((5, 5), (4, 4), (4, 4), "not borne out"),
    ],
)
def test_verdicts_where_every_hole_is_sure(azure, v2, l515, expected):
    assert verdict(azure, v2, l515).verdict == expected


def unsure(camera: str):
    """At 1 m this camera finds hole 3 in 6 of 12 repeats, and all larger ones; every camera finds
    4 to 11 there, and at 0.5 m Azure is ahead."""
    sure = cameras({"azure_kinect_nfov": (3, 4), "kinect_v2": (5, 4), "realsense_l515": (5, 4)})
    name = set_up_name(camera, 1.0)
    half = World(repeats=12, rate=lambda hole, frames: 0.5 if hole == 3 else float(hole >= 4))
    varied = joined(*(_without(sure, name), placed(tables(half, (1, 50), name), camera, 1.0)))
    return judged(varied)


def _without(results, name):
    from dataclasses import replace

    parts = ("holes", "runs", "probes", "variants", "noise")
    return replace(
        results,
        **{part: getattr(results, part)[getattr(results, part).variant != name] for part in parts},
    )


def test_an_undecided_hole_of_another_camera_leaves_the_claim_undecided():
    answer = unsure("realsense_l515")
    assert answer.verdict == "undecided"
    assert "8 to 9" in answer.evidence
    assert "Against realsense_l515: ahead at 0.5 m; open at 1 m." in answer.evidence


def test_an_undecided_hole_that_can_change_nothing_does_not_matter():
    # Azure finds 3 to 11 at 0.5 m; at 1 m it is behind L515 whatever becomes of v2's undecided
    # hole
    results = cameras({"azure_kinect_nfov": (3, 5), "kinect_v2": (5, 5), "realsense_l515": (5, 4)})
    name = set_up_name("kinect_v2", 1.0)
    half = World(repeats=12, rate=lambda hole, frames: 0.5 if hole == 4 else float(hole >= 5))
    results = joined(_without(results, name), placed(tables(half, (1, 50), name), "kinect_v2", 1.0))
    assert judged(results).verdict == "not borne out"


def test_two_units_or_units_that_differ_leave_the_claim_undecided():
    results = cameras({"azure_kinect_nfov": (3, 4), "kinect_v2": (4, 5), "realsense_l515": (4, 4)})
    verdict_of_two = judged(results, units=2)
    assert verdict_of_two.verdict == "undecided" and verdict_of_two.evidence.startswith(
        "Only 2 of each camera's units"
    )
    # a variation of the L515 at 0.5 m finds as many holes as the Azure Kinect
    better = tables(
        World(repeats=12, rate=lambda hole, frames: float(hole >= 3)), (1, 50), "another beam"
    )
    varied = joined(
        results, placed(better, "realsense_l515", 0.5, of=set_up_name("realsense_l515", 0.5))
    )
    assert judged(varied).verdict == "undecided"


def test_a_variation_by_another_camera_takes_no_units_away():
    """A fourth camera file with one unit, as a variation that stands for one of the three."""
    results = cameras({"azure_kinect_nfov": (3, 4), "kinect_v2": (4, 5), "realsense_l515": (4, 4)})
    summary = summarise_holes(
        pd.concat(
            [
                results.holes.assign(
                    **{UNIT: unit, "variant": results.holes["variant"] + f", {unit}"}
                )
                for unit in range(3)
            ]
        ),
        AXES,
    )
    fourth = summary[(summary[UNIT] == 0) & (summary[AXES[0]] == "realsense_l515")]
    with_fourth = pd.concat(
        [summary, fourth.assign(**{AXES[0]: "realsense_l515_lines"})], ignore_index=True
    )
    assert claim_c11(with_fourth, AXES) == claim_c11(summary, AXES)
    assert claim_c11(with_fourth, AXES).verdict == "borne out"


def test_the_l515_is_not_judged_where_its_noise_is_not_known():
    far = (0.5, 2.0)
    smallest = {"azure_kinect_nfov": (3, 4), "kinect_v2": (4, 5), "realsense_l515": (4, 3)}
    answer = judged(cameras(smallest, far))
    # the L515 is ahead at 2 m only
    assert answer.verdict == "borne out"
    assert "Withdrawn for realsense_l515 beyond 1 m" in answer.evidence
    assert "Against realsense_l515: ahead at 0.5 m." in answer.evidence
    assert "2 m 8 / 7 / –" in answer.evidence
    assert judged(cameras(smallest)).verdict == "not borne out"


def test_not_judged_without_the_three_cameras_or_without_fifty_frames():
    results = cameras({"azure_kinect_nfov": (3, 4), "kinect_v2": (4, 5), "realsense_l515": (4, 4)})
    summary = summarise_holes(results.holes, AXES[:2])
    assert claim_c11(summary[summary["source.camera.name"] != "kinect_v2"], AXES[:2]) is None
    assert claim_c11(summary, ["source.target.distance_m"]) is None
    answer = claim_c11(summary[summary.frames == 1], AXES[:2])
    assert answer.verdict == "undecided"
    assert "no trial has 50 frames" in answer.evidence


def test_set_ups_side_by_side():
    results = cameras({"azure_kinect_nfov": (3, 4), "kinect_v2": (4, 5), "realsense_l515": (4, 4)})
    compared = compare_set_ups(
        results, summarise_holes(results.holes, AXES[:2]), set_ups_of(results)
    )
    assert len(compared) == 3 * 2 * 2
    row = compared[
        (compared["variant"] == set_up_name("kinect_v2", 1.0)) & (compared["frames"] == 50)
    ].iloc[0]
    assert row["found"] == [str(number) for number in range(5, 12)]
    assert row["limit_mm"] == pytest.approx(5 / 16 * 25.4)
    assert row["extent_n"] == 7 * 12
    assert row["extent_place_n"] == 6 * 12  # the largest hole is where distances count from
    assert row["model_bias_mm"] == pytest.approx(0.1)
    assert row["correlation_u2"] == pytest.approx(0.6)
    assert row["valid_share"] == pytest.approx(0.97)
    assert row["threshold_mm"] == pytest.approx(5.0 * (0.25 + 0.65 / 50**0.5), abs=0.02)
    # every diameter of a found hole is exactly 2/D too large on the mean
    sizes = [d * 25.4 / 16 for d in (5, 6, 7, 8, 10, 12, 16)]
    assert row["extent_bias_mm"] == pytest.approx(sum(2 / d for d in sizes) / 7)
