"""Rows of hand-made judgements: every number is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from detectors.interface import Detection, Evidence, Measurement
from harness.records.rows import Origin
from harness.trials.clouds import MapFacts
from harness.trials.judge import Judgement
from harness.trials.record import damage_row, damage_rows, finding_rows, run_row
from harness.vocabulary.geometry import Region
from tests.harness.trials.test_engine_boards import judgement_of

IN_STUDY = Origin(variant="main", frames=2, repeat=1, board=3)
ALONE = replace(IN_STUDY, board=None)
FAR = Measurement(
    u_px=19.0,
    v_px=29.0,
    points=12,
    score=9.0,
    extent_diameter_m=6e-3,
    extent_centre_m=np.array([-30e-3, 1e-3, 0.0]),
    model_diameter_m=5e-3,
    model_diameter_se_m=0.1e-3,
    model_depth_m=2e-3,
    model_depth_se_m=0.2e-3,
    model_centre_m=np.array([-30e-3, 0.0, 2e-3]),
    length_m=7e-3,
    width_m=4e-3,
    along=np.array([1.0, 1.0, 0.0]),
    model_note="a note",
)
LARGEST = replace(
    FAR,
    extent_centre_m=np.array([30e-3, 1e-3, 0.0]),
    model_centre_m=np.array([29e-3, 0.0, 2e-3]),
)


def measured() -> Judgement:
    """A judgement in which the first damage is hit by a small detection and the largest detection
    hits nothing."""
    judgement = judgement_of()
    hit, call = judgement.detections
    larger = replace(call, pixels=np.arange(1050, 1060))
    return replace(
        judgement, detections=(hit, larger), measurements={0: FAR, 1: LARGEST}, hits={0: 0}
    )


def run_of(judgement: Judgement, origin: Origin, facts: MapFacts | None = None):
    return run_row(
        judgement,
        "digest",
        origin,
        "damaged",
        seconds_frames=0.5,
        map_facts=facts or MapFacts(),
    )


def test_a_measured_damage_is_placed_from_the_largest_detection_and_from_the_truth() -> None:
    row, missed = damage_rows(measured(), 4.0, "digest", ALONE)
    assert row.extent_offset_mm == pytest.approx(60.0)
    assert row.extent_error_mm == pytest.approx(1.0)
    assert row.model_offset_mm == pytest.approx(59.0)
    assert row.model_error_mm == pytest.approx(2.0)
    assert (row.extent_diameter_mm, row.model_diameter_mm) == pytest.approx((6.0, 5.0))
    assert (row.model_diameter_se_mm, row.model_depth_se_mm) == pytest.approx((0.1, 0.2))
    assert (row.model_depth_mm, row.length_mm, row.width_mm) == pytest.approx((2.0, 7.0, 4.0))
    assert (row.score, row.points, row.model_note) == (9.0, 12, "a note")
    assert row.angle_deg == pytest.approx(45.0)
    assert (row.hole, missed.hole) == ("1", "2")
    assert (row.detected, missed.detected) == (True, False)
    assert (missed.points, missed.model_note) == (0, "")
    assert np.isnan([missed.score, missed.model_offset_mm, missed.extent_error_mm]).all()


def test_the_truth_of_a_row_is_that_of_the_board() -> None:
    row, other = damage_rows(measured(), 4.0, "digest", ALONE)
    assert (row.true_diameter_mm, other.true_diameter_mm) == pytest.approx((6.0, 4.0))
    assert (row.true_x_mm, row.true_y_mm) == pytest.approx((-30.0, 0.0))
    # the first hole is the largest
    assert (row.true_offset_mm, other.true_offset_mm) == pytest.approx((0.0, 60.0))
    assert row.seen_depth_mm == pytest.approx(10.0)
    assert (row.kind, row.size_of) == ("through", "diameter")
    assert row.signal == 9.0
    assert row.no_return is None


@pytest.mark.parametrize(
    ("missing", "residual_m", "state"),
    [
        (0.4, 2.0, "wrong depth"),
        (0.6, 2.0, "invalid"),
        (0.5, 0.5, "invisible"),
        (0.0, -2.0, "wrong depth"),
    ],
)
def test_what_became_of_the_pixels_of_a_missed_damage(
    missing: float, residual_m: float, state: str
) -> None:
    judgement = replace(measured(), hits={})
    pixels = judgement.labelled.outlines[1]
    lost = pixels[: round(missing * len(pixels))]
    judgement.labelled.cloud.points_m.reshape(-1, 3)[lost, 2] = np.nan
    judgement.evidence.residual_m.reshape(-1)[pixels] = residual_m
    row = damage_row(judgement, 4.0, 0, judgement.labelled.truth[0], "digest", ALONE)
    assert row.state == state
    assert row.invalid_fraction == pytest.approx(len(lost) / len(pixels))
    assert row.median_residual_mm == pytest.approx(residual_m * 1e3)


def test_a_cloud_without_a_grid_has_no_share_of_missing_pixels() -> None:
    judgement = measured()
    cloud = replace(judgement.labelled.cloud, organised=False)
    judgement = replace(judgement, labelled=replace(judgement.labelled, cloud=cloud))
    row = damage_row(judgement, 4.0, 1, judgement.labelled.truth[1], "digest", ALONE)
    assert np.isnan(row.invalid_fraction)


def test_a_run_counts_detections_and_false_calls() -> None:
    judgement = replace(measured(), parts=1, quiet_threshold=5.5, surface_noise_m=2e-4)
    run = run_of(judgement, ALONE, MapFacts(views_used=3, views_left_out=1, seconds_map=2.5))
    assert (run.detections, run.false_calls) == (2, 0)
    assert run_of(replace(judgement, parts=0), ALONE).false_calls == 1
    bare = replace(judgement, labelled=replace(judgement.labelled, damaged=False))
    assert run_of(bare, ALONE).false_calls == 2
    assert (run.threshold, run.quiet_threshold) == (4.0, 5.5)
    assert (run.scale_mm, run.surface_noise_mm) == pytest.approx((1000.0, 0.2))
    assert (run.views_used, run.views_left_out, run.seconds_map) == (3, 1, 2.5)
    assert (run.seconds_frames, run.inspected_m2, run.no_return_calls) == (0.5, None, None)


def test_a_study_run_without_a_threshold_names_its_loudest_pixel() -> None:
    judgement = measured()
    criteria = replace(judgement.criteria, threshold=None)
    cloud = replace(
        judgement.labelled.cloud, projection="central", region=Region(200, 260, 400, 500)
    )
    labelled = replace(judgement.labelled, cloud=cloud)
    run = run_of(replace(judgement, criteria=criteria, labelled=labelled), IN_STUDY)
    assert np.isnan(run.threshold)
    assert (run.loudest_x_mm, run.loudest_y_mm) == pytest.approx((-30.5, -0.5))
    assert (run.loudest_u_px, run.loudest_v_px) == (419.0, 229.0)
    assert run.no_return_calls is None
    unscored = Evidence(np.full((60, 100), np.nan), *np.zeros((2, 60, 100)), 1.0)
    silent = replace(judgement, criteria=criteria, labelled=labelled, evidence=unscored)
    run = run_of(silent, IN_STUDY)
    assert run.inspected_m2 == 0.0
    assert np.isnan([run.loudest_x_mm, run.loudest_v_px]).all()


def test_findings_name_the_damage_that_they_hit() -> None:
    rows = finding_rows(measured(), IN_STUDY, "damaged")
    assert [row.hole for row in rows] == ["1", ""]
    assert (rows[0].x_mm, rows[0].y_mm) == pytest.approx((-30.5, -0.5))


def test_the_largest_detection_is_that_with_most_pixels() -> None:
    judgement = measured()
    assert judgement.largest is LARGEST
    assert replace(judgement, detections=()).largest is None
    equal = Detection(1.0, np.arange(10), np.zeros(3))
    assert replace(judgement, detections=(equal, equal)).largest is FAR
