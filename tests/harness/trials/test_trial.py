"""One trial from frames to rows, on a board in closed form."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from detectors.views.mapping.settings import MappingConfig
from harness.records.rows import TrialRecord
from harness.trials import board as boards
from harness.trials import trial as trials
from harness.trials.board import Board
from harness.trials.judge import Criteria, Judgement, LabelledCloud, judge
from harness.trials.trial import (
    Trial,
    capture_of,
    cloud_of,
    exposure_share_of,
    run_trial,
    uses_view,
)
from harness.vocabulary.geometry import MM
from tests.support.board_in_closed_form import (
    BACKING_M,
    DISTANCE_M,
    HOLE_MM,
    REGION,
    board_of,
    point_of,
    reference_of,
)


@pytest.fixture(scope="module")
def damaged() -> Board:
    return board_of(damaged=True)


@pytest.fixture(scope="module")
def hole_free() -> Board:
    return board_of(damaged=False)


def trial_before(board: Board, *points: trials.TrialPoint, number: int | None = None) -> Trial:
    """A trial of a board; the number makes it one of a study."""
    return Trial(
        views=(reference_of(board),),
        seed=5,
        role="damaged" if board.damaged else "hole_free",
        repeat=3,
        points=points or (point_of(),),
        board=number,
    )


@pytest.fixture(scope="module")
def inspected(damaged: Board) -> TrialRecord:
    return run_trial(trial_before(damaged))


def test_a_damaged_board_gives_a_run_and_a_row_of_its_hole(inspected: TrialRecord) -> None:
    (run,) = inspected.runs
    (row,) = inspected.holes
    assert (run.point, run.role, run.origin.variant) == ("digest", "damaged", "main")
    assert (run.origin.frames, run.origin.repeat, run.origin.board) == (5, 3, None)
    assert (run.threshold, run.detections, run.false_calls) == (6.0, 1, 0)
    assert (run.frames_used, run.left_out, run.exposure_share) == (5, 0, 1.0)
    assert np.isnan(run.quiet_threshold)
    assert run.seconds_frames > 0 and run.seconds_detect > 0
    assert (row.hole, row.detected, row.state, row.threshold) == ("7", True, "found", 6.0)
    assert row.origin == run.origin
    # a study's columns are absent elsewhere
    assert run.inspected_m2 is None and row.no_return is None
    assert row.signal == row.score  # the finding's peak lies within the hit radius
    assert not inspected.findings and not inspected.probes and not inspected.noise


def test_the_row_of_a_hole_states_truth_and_measurement(inspected: TrialRecord) -> None:
    (row,) = inspected.holes
    assert row.true_diameter_mm == pytest.approx(HOLE_MM)
    assert row.true_depth_mm == pytest.approx(12.0)
    assert (row.true_x_mm, row.true_y_mm) == pytest.approx((8.0, -4.0))
    assert row.true_offset_mm == 0.0
    assert row.seen_depth_mm == pytest.approx(BACKING_M / MM)
    assert row.invalid_fraction == 0.0
    assert 0.5 * BACKING_M / MM < row.median_residual_mm <= BACKING_M / MM + 1
    assert row.model_diameter_mm == pytest.approx(HOLE_MM, abs=1.5)
    assert row.model_depth_mm == pytest.approx(BACKING_M / MM, abs=3.0)
    assert row.model_error_mm < 1.5
    assert row.extent_offset_mm == 0.0 and row.model_offset_mm == 0.0
    assert row.points > 30
    assert row.score > 6.0


def test_what_is_not_found_has_no_measurement(damaged: Board) -> None:
    record = run_trial(trial_before(damaged, point_of(threshold=1e6)))
    (row,) = record.holes
    assert not row.detected
    assert row.state == "wrong depth"
    assert np.isnan([row.score, row.extent_diameter_mm, row.model_depth_mm, row.angle_deg]).all()
    assert (row.points, row.model_note) == (0, "")
    assert record.runs[0].detections == 0


def test_a_hole_free_board_shows_noise_and_errors(hole_free: Board) -> None:
    record = run_trial(trial_before(hole_free, point_of(threshold=None)))
    (run,) = record.runs
    assert np.isnan(run.threshold) and run.quiet_threshold > 0
    assert record.holes == []
    (noise,) = record.noise
    lens = hole_free.unit.camera.nominal_lens
    assert noise.valid_share == 1.0
    assert noise.pitch_u_mm == pytest.approx(DISTANCE_M / lens.fx / MM, rel=0.005)
    assert noise.pitch_v_mm == pytest.approx(DISTANCE_M / lens.fy / MM, rel=0.005)
    capture = capture_of(trial_before(hole_free), 0, hole_free, 2)
    first, second = [frame.z_m for frame in capture.frames()]
    inside = np.isfinite(first - second) & hole_free.bare
    expected_mm = np.std((first - second)[inside]) / np.sqrt(2) / MM
    assert noise.single_frame_mm == pytest.approx(expected_mm, rel=0.05)
    (probes,) = record.probes
    errors_mm = np.array(probes.error_tenth_um, float) * 1e-4
    assert len(errors_mm) == len(hole_free.probes)
    cloud = cloud_of(trial_before(hole_free), point_of())
    expected_mm = (cloud.points_m[..., 2].ravel()[hole_free.probes] - DISTANCE_M) / MM
    np.testing.assert_allclose(errors_mm, expected_mm, atol=1e-4)


def test_set_ups_that_differ_in_their_damage_share_a_hole_free_board(
    hole_free: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames are drawn again for other noise, for more of them and for another view, but not for
    another damage that is not shown."""
    drawn = []

    def counting(trial: Trial, *arguments: Any) -> Any:
        drawn.append(trial)
        return drawing(trial, *arguments)

    drawing = trials._averages
    monkeypatch.setattr(trials, "_averages", counting)
    monkeypatch.setattr(trials, "_kept", {})
    first = trial_before(hole_free)
    (view,) = first.views
    alike = replace(view, target=view.target.model_copy(update={"holes": ()}))
    another = replace(view, view_path="another")
    other_unit = replace(view, camera=view.camera.model_copy(update={"unit_seed": 2}))
    for shown in (alike, another, other_unit):
        monkeypatch.setitem(boards._kept, shown, hole_free)
    record = run_trial(first)
    again = run_trial(replace(first, views=(alike,), points=(point_of(threshold=7.0),)))
    assert drawn == [first]
    assert again.runs[0].quiet_threshold == record.runs[0].quiet_threshold
    assert again.probes == record.probes
    others = (
        replace(first, seed=6),
        replace(first, repeat=4),
        replace(first, points=(replace(point_of(), frames=6),)),
        replace(first, views=(another,)),
        replace(first, views=(other_unit,)),
        replace(first, board=1),
    )
    for other in others:
        drawn.clear()
        run_trial(first)
        run_trial(other)
        assert drawn[-1] == other
    # boards of studies are not kept
    run_trial(others[-1])
    assert drawn[-2:] == [others[-1], others[-1]]


def test_points_that_see_and_judge_alike_share_the_judgement(
    damaged: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged = []

    def counted(labelled: LabelledCloud, criteria: Criteria) -> Judgement:
        judged.append(criteria.threshold)
        return judge(labelled, criteria)

    monkeypatch.setattr(trials, "judge", counted)
    points = (
        point_of("first"),
        point_of("second", digest="other"),
        point_of("third", threshold=9.0),
        point_of("fourth", frames=2),
    )
    record = run_trial(trial_before(damaged, *points))
    assert judged == [6.0, 9.0, 6.0]
    assert [row.origin.variant for row in record.holes] == ["first", "second", "third", "fourth"]
    assert [run.point for run in record.runs] == ["digest", "other", "digest", "digest"]
    first, second, *_ = record.holes
    alike = replace(second, point=first.point, origin=first.origin)
    assert repr(alike) == repr(first)  # NaN differs from itself


def test_points_that_leave_out_other_damage_share_frames_and_findings(
    hole_free: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their rows are those of a trial of their own."""
    judged = []

    def counting(labelled: LabelledCloud, criteria: Criteria) -> Judgement:
        judged.append(labelled)
        return judge(labelled, criteria)

    monkeypatch.setattr(trials, "judge", counting)
    first = trial_before(hole_free, point_of("first", threshold=3.0), number=2)
    (view,) = first.views
    data = view.target.to_data()
    finding = run_trial(first).findings[0]
    place_mm = [finding.x_mm, finding.y_mm]
    wide_hole = {**data["holes"][0], "diameter_mm": 40.0, "centre_mm": place_mm}
    elsewhere = replace(view, target=type(view.target).from_data({**data, "holes": [wide_hole]}))
    for threshold in (3.0, None):
        own = point_of("first", digest="1", threshold=threshold)
        other = point_of("second", digest="2", threshold=threshold)
        sharing = replace(other, left_out=(elsewhere,))
        judged.clear()
        joint = rows_of(run_trial(replace(first, points=(own, sharing))))
        assert len(judged) == 1
        alone = rows_of(run_trial(replace(first, points=(own,))))
        alone += rows_of(run_trial(replace(first, views=(elsewhere,), points=(other,))))
        assert joint == sorted(alone)
        assert len(alone) > (4 if threshold else 1)


def rows_of(record: TrialRecord) -> list[str]:
    """The rows of a record as sorted texts, without their times."""
    rows = []
    for table, own_rows in record.to_data().items():
        for row in own_rows:
            kept = {name: value for name, value in row.items() if "seconds" not in name}
            rows.append(f"{table} {sorted(kept.items())}")
    return sorted(rows)


def test_a_study_records_signals_findings_and_counts_over_grids(damaged: Board) -> None:
    record = run_trial(trial_before(damaged, number=4))
    (run,) = record.runs
    assert run.origin.board == 4
    area_m2 = np.prod(REGION.shape) * np.prod(damaged.pitch_mm) * MM**2
    assert run.inspected_m2 == pytest.approx(area_m2, rel=0.05)
    assert run.no_return_calls == 0
    (row,) = record.holes
    (finding,) = record.findings
    assert row.signal is not None and row.signal >= row.score
    assert row.no_return is False
    assert finding.hole == "7"
    assert (finding.x_mm, finding.y_mm) == pytest.approx((8.0, -4.0), abs=1.0)
    (operating,) = record.operating
    in_use = operating.threshold.index(6.0)
    assert (operating.findings[in_use], operating.hits[in_use]) == (1, 1)
    assert {pixels.hole for pixels in record.pixels} == {"7", ""}
    assert record.sites == []


def test_a_calibrating_board_tells_where_it_is_loudest(hole_free: Board) -> None:
    record = run_trial(trial_before(hole_free, point_of(threshold=None), number=0))
    (run,) = record.runs
    assert record.operating == [] and record.sites == [] and record.noise == []
    assert run.loudest_u_px is not None and run.loudest_v_px is not None
    assert REGION.col0 <= run.loudest_u_px < REGION.col1
    assert REGION.row0 <= run.loudest_v_px < REGION.row1
    lens = hole_free.unit.camera.nominal_lens
    x_mm = (run.loudest_u_px - lens.cx) / lens.fx * DISTANCE_M / MM
    y_mm = -(run.loudest_v_px - lens.cy) / lens.fy * DISTANCE_M / MM
    assert (run.loudest_x_mm, run.loudest_y_mm) == pytest.approx((x_mm, y_mm), abs=1.0)


def test_trials_and_views_have_streams_of_their_own(damaged: Board) -> None:
    trial = trial_before(damaged)
    assert trial.labels == ("damaged", 3)
    assert replace(trial, board=2).labels == ("damaged", 3, "board", 2)
    assert capture_of(trial, 0, damaged, 1).labels == trial.labels
    assert capture_of(trial, 2, damaged, 1).labels == (*trial.labels, "view", 2)


def test_the_exposure_of_a_point_is_the_mean_over_its_views() -> None:
    boards: Any = [SimpleNamespace(unit=SimpleNamespace(exposure_share=s)) for s in (1.0, 0.5, 0.1)]
    point = replace(point_of(), mapping=MappingConfig(views=2))
    assert exposure_share_of(boards, point) == 0.75
    assert exposure_share_of(boards[:1], point_of()) == 1.0


def test_a_mapping_of_fewer_views_does_not_use_the_last() -> None:
    point = replace(point_of(), mapping=MappingConfig(views=2))
    assert [uses_view(point, number) for number in range(3)] == [True, True, False]
    assert uses_view(replace(point, mapping=MappingConfig()), 7)
    assert uses_view(point_of(), 0)
