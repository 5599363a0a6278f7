"""The numbers in the evidence of each claim, on worlds that state them: a mean error of 2 mm / D, a
deviation of 1.2 mm, thresholds of 5 times a scale."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from harness.evaluation import maps
from harness.evaluation.summary import summarise_holes
from harness.programs.thesis.claims import RULES, score_claims
from harness.programs.thesis.counts import HoleCount
from harness.programs.thesis.views import duels_of, rms_gap, score_views
from harness.records.trials import ResultTables
from harness.report.claims import Verdict
from tests.harness.programs.thesis.test_claim_views import (
    mapped,
    registered,
    sized,
    slam,
    worlds,
)
from tests.support.synthetic_perspectives import MapWorld, name_of, with_variation
from tests.support.synthetic_tables import World, example, tables


@pytest.fixture(scope="module")
def single_view() -> dict[str, Verdict]:
    results = tables(World(), frames=(1, 10, 50))
    return {verdict.claim: verdict for verdict in score_claims(results, [example(50)])}


EVIDENCE = {
    "C1": (
        "With 50 frames found: 4–11. Detections of trials (holes): 0 of 50 (1–3), 50 of 50 (4–11)."
    ),
    "C2": (
        "With 1 frame found: 5–11. Detections of trials (holes): 0 of 50 (1–4), 50 of 50 (5–11)."
        # 5 (0.25 + 0.65) and 5 (0.25 + 0.65 / sqrt(50))
        " Threshold 4.50 mm with 1 frame, 1.71 mm with 50 (difference 2.78 to 2.79 mm)."
    ),
    "C3": (
        # 2 / 6.35 / 1.2, and Student's interval of 50 repeats: 0.284 about it
        "(mean - true)/std by the thesis' measure: hole 4 +0.3 (0.0 to 0.5), hole 5 +0.2 (-0.1 to"
        " 0.5), hole 6 +0.2 (-0.1 to 0.5), hole 7 +0.1 (-0.1 to 0.4), hole 8 +0.1 (-0.1 to 0.4),"
        " hole 9 +0.1 (-0.2 to 0.4), hole 10 +0.1 (-0.2 to 0.4), hole 11 +0.1 (-0.2 to 0.3)."
        " Between units: not judged, because all repeats have the same unit's fixed pattern."
    ),
    "C4": (
        "Rank correlation -1.00 over 8 holes (one-sided p < 0.001 that it falls with the diameter,"
        " = 1.000 that it grows). Error 0.31 mm at 6.35 mm, 0.08 mm at 25.40 mm."
    ),
    "C6": (
        "Of 8 holes judged, like a bowl: 4–11; like a cylinder: none; unclear: none. Median misfit"
        " of the bowl relative to the cylinder 0.06. Control: the true geometry at the same pixels"
        " is closer to a bowl in 0 of 8 holes."
    ),
    "C9": (
        "Temporal noise varies as N to the power -0.498 (-0.501 to -0.496); the systematic error"
        " with 50 frames is 1.01 times that with 1 (0.98 to 1.05); 800 pixels."
    ),
}


@pytest.mark.parametrize("claim", EVIDENCE)
def test_evidence_of_a_single_view(claim: str, single_view: dict[str, Verdict]) -> None:
    assert single_view[claim].evidence == EVIDENCE[claim]


def test_positions_are_told_with_the_worst(single_view: dict[str, Verdict]) -> None:
    evidence = single_view["C5"].evidence
    assert evidence.startswith("7 of 7 mean positions agree; the largest difference is +0.20 mm,")
    # (2.4 mm / 1.2 mm) squared
    assert "std 2.40 mm" in evidence
    assert "variances of position and size 4.00 (3.15 to 5.13)." in evidence


def test_criteria_hold_the_constants(single_view: dict[str, Verdict]) -> None:
    assert list(single_view) == list(RULES)
    assert "1/16 in = 1.59 mm" in single_view["C5"].rule
    assert "fewer than 4 holes" in single_view["C4"].rule
    assert "within 0.05 of -0.5" in single_view["C9"].rule
    assert "lies above 0.9 (bootstrap" in single_view["C9"].rule
    assert not any("{" in verdict.rule for verdict in single_view.values())


@pytest.mark.parametrize(
    ("count", "rival", "standing"),
    [
        (HoleCount(8, 9), HoleCount(6, 7), "ahead"),
        (HoleCount(8, 9), HoleCount(6, 8), "open"),
        (HoleCount(6, 7), HoleCount(8, 9), "behind"),
        (HoleCount(6, 8), HoleCount(8, 9), "open"),
        (HoleCount(8, 8), HoleCount(8, 8), "level"),
        (HoleCount(8, 8), HoleCount(7, 8), "open"),
        (HoleCount(7, 8), HoleCount(8, 8), "open"),
        (HoleCount(8, 9), HoleCount(8, 9), "open"),
    ],
)
def test_counts_of_holes(count: HoleCount, rival: HoleCount, standing: str) -> None:
    assert count.against(rival) == standing


# ---------------------------------------------------------------- several views


def evidence_of(claim: str, results: ResultTables) -> str:
    summary = summarise_holes(results.holes, list(results.axes["path"]))
    verdicts = score_views(maps.map_cases(results, summary))
    return next(verdict.evidence for verdict in verdicts if verdict.claim == claim)


def test_registrations_are_told_with_their_errors_and_failures() -> None:
    world = registered((1.5, 0.5), (0.4, 0.1), failing={"cpd": 0.25})
    evidence = evidence_of("C7", worlds(world, counts=(1, 9)))
    # 12 repeats, 2 boards, 8 views; 0.4 / 1.5 = 0.27
    assert "icp 1.54 and 0.51 mm, 0 of 192; cpd 0.41 and 0.10 mm, 48 of 192." in evidence
    assert "The noise of a single cloud's surface is 0.20 mm." in evidence
    assert "CPD has 0.27 times the error of ICP (0.25 to 0.28, 8 pairs of views)." in evidence


def test_two_views_are_told_with_each_change() -> None:
    evidence = evidence_of("C8", worlds(sized(-0.5, 0.5, 1.0, first=3)))
    assert "3/8 in and larger -0.50 mm (-0.55 to -0.45)" in evidence
    assert "of smaller holes +0.50 mm (0.43 to 0.57)." in evidence
    # the threshold rises from 5 to 6 times a scale of 0.2 mm
    assert "Threshold +0.20 mm (0.20 to 0.20), surface noise × 1.01 (1.00 to 1.03)." in evidence
    assert evidence.endswith("Found only by two views: 3.")


def test_a_slam_map_is_told_with_its_noise_and_errors() -> None:
    evidence = evidence_of("C10", slam(1.0, 2.0, 5.0))
    assert evidence.endswith(
        "24 views of 1 frame against one and two of 50 frames: surface noise 1.01 mm against 0.20"
        " and 0.20 (more by 0.79 to 0.82 and 0.79 to 0.82); size error 1.91 mm against 0.24 and"
        " 0.24 (more by 1.39 to 1.94 and 1.39 to 1.95); position error 4.79 mm against 0.52 and"
        " 0.52 (more by 3.62 to 4.96 and 3.61 to 4.96). Found: 6 of 11, 8 of 11, 8 of 11."
    )
    without_holes = evidence_of("C10", slam(1.0, 2.0, 5.0, 12))
    assert without_holes.endswith(
        "no hole is measured by all three. Found: 0 of 11, 8 of 11, 8 of 11."
    )


def test_the_variation_with_the_most_views_and_frames_is_the_slam_map() -> None:
    results = worlds(MapWorld(), methods=("icp", "cpd", "odometry"), merges=("grid", "volume"))
    assert "2 views of 50 frames against" in evidence_of("C10", results)
    for views, label in ((5, "five"), (24, "many"), (9, "nine")):
        results = with_variation(
            results,
            MapWorld(),
            label,
            (views, "odometry", "volume"),
            (1, 10),
            of=name_of(2, "cpd", "grid"),
        )
    assert "24 views of 10 frames against" in evidence_of("C10", results)


def test_a_duel_is_told_with_its_standings() -> None:
    evidence = evidence_of("H1", mapped(0.3, -0.5, exposures=0.1))
    assert evidence == (
        "9 views (marks, fusion) of 50 frames against one of 50 frames: holes level, size ahead,"
        " noise ahead. Found 8 of 11 against 8 of 11; |size error| -0.50 mm (-0.53 to -0.47);"
        " surface noise × 0.30 (0.29 to 0.31)."
        " 9 views (marks, fusion) of 50 frames against one of 450 frames: holes level, size open,"
        " noise ahead. Found 8 of 11 against 8 of 11; |size error| +0.00 mm (-0.03 to 0.03);"
        " surface noise × 0.61 (0.59 to 0.62)."
    )


def test_joint_registration_and_the_most_views_fight_first() -> None:
    results = worlds(
        MapWorld(),
        counts=(1, 3, 9),
        methods=("marks", "joint"),
        merges=("grid", "fusion"),
        frames=(10, 30),
    )
    summary = summarise_holes(results.holes, list(results.axes["path"]))
    (case,) = maps.map_cases(results, summary)
    equal_frames, equal_exposures = duels_of(case)
    assert equal_frames.text.startswith("9 views (joint, fusion) of 30 frames against one of 30")
    # 3 views of 10 frames are as many exposures as one of 30; 9 views have no such rival
    assert equal_exposures.text.startswith("3 views (joint, fusion) of 10 frames against one of 30")


def test_a_gap_of_root_mean_squares_by_its_resamples() -> None:
    """Errors of one size have an rms that no resample changes, whatever is missing."""
    first = np.array([[3.0, -3.0], [np.nan, 3.0], [-3.0, np.nan]])
    second = np.array([[1.0, np.nan], [-1.0, 1.0]])
    gap = rms_gap(first, second)
    assert (gap.low, gap.high) == (pytest.approx(2.0), pytest.approx(2.0))
    assert not rms_gap(first, np.full((2, 2), np.nan)).known
    assert not rms_gap(np.full((3, 2), np.nan), second).known
    assert not rms_gap(first, second[:1]).known


def test_places_are_told_and_units_are_taken_together() -> None:
    results = worlds(MapWorld())
    parts = []
    for distance_m in (0.5, 1.0):
        columns = {
            name: getattr(results, name)
            for name in ("holes", "runs", "probes", "variants", "registrations")
        }
        for name, table in columns.items():
            columns[name] = table.assign(**{"source.target.distance_m": distance_m})
            for column in {"variant", "reference"} & set(table):
                is_empty = table[column] == ""
                renamed = table[column] + f", distance={distance_m}"
                columns[name][column] = table[column].where(is_empty, renamed)
        parts.append(columns)
    axis = pd.DataFrame([{"path": "source.target.distance_m", "name": "distance", "unit": "m"}])
    joined = {name: pd.concat([part[name] for part in parts]) for name in parts[0]}
    two_places = type(results)(
        **joined,
        noise=results.noise,
        axes=pd.concat([results.axes, axis], ignore_index=True),
    )
    summary = summarise_holes(two_places.holes, list(two_places.axes["path"]))
    verdicts = score_views(maps.map_cases(two_places, summary))
    claims = [verdict.claim for verdict in verdicts]
    assert claims == ["C7", "C7", "C8", "C8", "C10", "C10", "H1", "H1"]
    assert verdicts[0].evidence.startswith("0.5 m: With 50 frames a view")
    assert verdicts[-1].evidence.startswith("1 m: Not judged")
