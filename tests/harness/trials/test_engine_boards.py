"""What a study asks of one board, and where lines of sight meet its face."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy import ndimage

from detectors.interface import Detection, Evidence, Measurement
from detectors.methods.thesis import ThesisConfig, ThesisDetector
from harness.evaluation.match import match
from harness.records.rows import Origin, TrialRecord
from harness.trials.board import (
    INTACT_MARGIN_PX,
    LabelledCloud,
    _eroded,
    highest_within,
    met_on_face,
    pixel_areas,
)
from harness.trials.judge import (
    FINDING_OCTAVES,
    PIXEL_OCTAVES,
    SMEARED_PX,
    Criteria,
    Judgement,
    grid,
    smeared,
)
from harness.trials.record import add_judgement
from harness.vocabulary.geometry import Cloud, Region
from scenes.target.custom import BoardConfig, SphereConfig, TargetConfig
from scenes.target.truth import face_of, truth_of


def judgement_of(*, damaged: bool = True, threshold: float = 4.0) -> Judgement:
    """The judgement of a board of 100 x 60 mm on a grid of 1 mm with two damages: the first's pixel
    scores 9, one far from both 5."""
    target = TargetConfig.from_data(
        {
            "name": "custom",
            "board": {"width_mm": 100, "height_mm": 60, "thickness_mm": 10},
            "holes": [
                {"id": 1, "diameter_mm": 6, "centre_mm": [-30, 0]},
                {"id": 2, "diameter_mm": 4, "centre_mm": [30, 0]},
            ],
        }
    )
    T_board_cloud = np.eye(4)
    x, y = np.meshgrid(np.arange(-49.5, 50) * 1e-3, np.arange(-29.5, 30) * 1e-3)
    points = np.stack([x, y, np.zeros(x.shape)], axis=-1)
    none = np.full(x.shape, np.nan)
    zeros = np.zeros(x.shape, np.uint8)
    region = Region(0, x.shape[0], 0, x.shape[1])
    cloud = Cloud(points, zeros, zeros.astype(int), none, region, 0.0, 1, projection="parallel")
    positions = points[..., :2]
    truth = truth_of(target, target.pose.T_camera_board)
    outlines = {
        d.id: np.flatnonzero(
            np.linalg.norm(positions - d.centre_board_m[:2], axis=-1) < d.diameter_m / 2
        )
        for d in truth
    }
    undamaged = np.ones(x.shape, bool)
    undamaged.ravel()[np.concatenate(list(outlines.values()))] = False
    labelled = LabelledCloud(
        cloud=cloud,
        damaged=damaged,
        T_board_cloud=T_board_cloud,
        target=target,
        truth=truth,
        outlines=outlines,
        places_m=positions,
        undamaged=undamaged,
        seen_depth_m={1: 0.01, 2: 0.01},
    )
    score = np.zeros(x.shape)
    score[:, 90:] = np.nan
    score[29, 19] = 9.0
    score[10, 50] = 5.0
    hit = Detection(score[29, 19], np.array([(29, 19)[0] * 100 + (29, 19)[1]]), points[29, 19])
    call = Detection(score[10, 50], np.array([(10, 50)[0] * 100 + (10, 50)[1]]), points[10, 50])

    class Finder:
        def find(self, cloud: Cloud, evidence: object, threshold: float) -> tuple[Detection, ...]:
            return tuple(one for one in (hit, call) if one.score > threshold)

    return Judgement(
        labelled=labelled,
        criteria=Criteria("finder", "{}", threshold, 0.01),
        detector=Finder(),  # type: ignore[arg-type]
        evidence=Evidence(score, score, score, 1.0),
        detections=(hit, call),
        places_m=np.array([points[29, 19, :2], points[10, 50, :2]]),
        hits={0: 0},
        measurements={0: Measurement(19.0, 29.0, 1, 9.0, 0.006, points[29, 19])},
    )


def study_record(judgement: Judgement) -> TrialRecord:
    """What a study records of a judgement."""
    record = TrialRecord()
    origin = Origin(variant="main", frames=1, repeat=0, board=3)
    role = "damaged" if judgement.labelled.damaged else "hole_free"
    add_judgement(record, judgement, point="digest", origin=origin, role=role, seconds_frames=0.0)
    return record


def test_what_a_damaged_board_gives():
    judgement = judgement_of()
    record = study_record(judgement)
    assert [row.signal for row in record.holes] == [9.0, 0.0]
    assert [row.detected for row in record.holes] == [True, False]
    # ten columns of 100 were not judged
    assert record.runs[0].inspected_m2 == pytest.approx(90 * 60e-6)
    assert [(row.hole, row.score) for row in record.findings] == [("1", 9.0), ("", 5.0)]
    call = record.findings[1]
    assert (call.x_mm, call.y_mm) == pytest.approx((0.5, -19.5))
    (operating,) = record.operating
    counts = {}
    for index, threshold in enumerate(operating.threshold):
        counts[threshold] = (operating.findings[index], operating.hits[index])
    assert counts[4.0] == (2, 1)
    assert counts[8.0] == (1, 1)
    assert counts[16.0] == (0, 0)
    pixels = {row.hole: row for row in record.pixels}
    assert pixels["1"].pixels == len(judgement.labelled.outlines[1])
    assert pixels["1"].above[pixels["1"].threshold.index(4.0)] == 1
    assert pixels[""].above[pixels[""].threshold.index(4.0)] == 1
    assert record.sites == []


def test_a_hole_free_board_gives_the_same_places_as_sites():
    record = study_record(judgement_of(damaged=False))
    assert record.holes == []
    assert [(row.hole, row.detected, row.signal) for row in record.sites] == [
        ("1", True, 9.0),
        ("2", False, 0.0),
    ]
    assert {row.hole for row in record.findings} == {""}
    assert record.operating[0].hits == [0] * len(grid(4.0, FINDING_OCTAVES))
    assert record.pixels == []


def test_a_place_where_nothing_was_judged_has_no_signal():
    judgement = judgement_of(damaged=False)
    judgement.evidence.score[:] = np.nan
    assert np.isnan(study_record(judgement).sites[0].signal)


@pytest.mark.parametrize("threshold", [0.3, 3.7])
def test_the_grid_of_thresholds_holds_the_one_in_use(threshold: float):
    for octaves in (FINDING_OCTAVES, PIXEL_OCTAVES):
        thresholds = grid(threshold, octaves)
        assert threshold in thresholds
        assert thresholds[1:] / thresholds[:-1] == pytest.approx(2**0.25)
        lowest, highest = octaves
        assert thresholds[0] == pytest.approx(threshold * 2.0**lowest)
        assert thresholds[-1] == pytest.approx(threshold * 2.0**highest)
    assert grid(0.0, FINDING_OCTAVES).tolist() == [0.0]


def test_outlines_are_smeared_by_half_a_window_on_a_grid():
    shape = (9, 11)
    outline = np.array([4 * 11 + 5])
    (mask,) = smeared([outline], shape)
    rows, columns = np.nonzero(mask.reshape(shape))
    assert (rows.min(), rows.max()) == (4 - SMEARED_PX, 4 + SMEARED_PX)
    assert (columns.min(), columns.max()) == (5 - SMEARED_PX, 5 + SMEARED_PX)
    (single,) = smeared([outline], shape, grid=False)
    assert np.flatnonzero(single).tolist() == outline.tolist()


def test_pixels_cover_the_face_however_it_is_tilted():
    """A camera's grid on a plane tilted by 40 degrees: the pixels' areas sum to the face's."""
    known = judgement_of().labelled
    slopes = np.stack(
        np.meshgrid(np.linspace(-0.07, 0.07, 281), np.linspace(-0.05, 0.05, 201)), axis=-1
    )
    tilt = np.deg2rad(40)
    depth = 1.0 / (1 - slopes[..., 0] * np.tan(tilt))  # z = 1 + x tan
    place = np.stack([slopes[..., 0] * depth / np.cos(tilt), slopes[..., 1] * depth], axis=-1)
    inside = (np.abs(place[..., 0]) < 0.05) & (np.abs(place[..., 1]) < 0.03)
    place[~inside] = np.nan
    cloud = SimpleNamespace(organised=True)
    tilted = replace(known, cloud=cast("Cloud", cloud), places_m=place)
    assert tilted.area_m2(inside) == pytest.approx(100 * 60e-6, rel=0.01)


def test_lines_of_sight_meet_a_sphere_where_they_should():
    board = BoardConfig(
        width_mm=200,
        height_mm=200,
        thickness_mm=5,
        shape=SphereConfig(kind="sphere", radius_mm=400),
    )
    direction = np.array([[0.1, -0.05, -1.0], [-0.15, 0.1, -1.0]])
    met = met_on_face(np.tile([0.0, 0.0, 0.7], (2, 1)), direction, face_of(board))
    assert np.linalg.norm(met - [0, 0, -0.4], axis=-1) == pytest.approx([0.4, 0.4], abs=1e-7)
    assert np.linalg.norm(np.cross(met - [0, 0, 0.7], direction), axis=-1) == pytest.approx(
        [0, 0], abs=1e-9
    )


def test_signals_are_the_highest_scores_within_the_radius():
    random = np.random.default_rng(0)
    positions = random.uniform(-0.05, 0.05, (17, 23, 2))
    score = random.exponential(1.0, (17, 23))
    positions[random.random((17, 23)) < 0.1] = np.nan
    score[random.random((17, 23)) < 0.1] = np.nan
    score[0, 0] = np.inf
    centres = np.vstack([random.uniform(-0.05, 0.05, (6, 2)), [[9.0, 9.0]]])
    found = highest_within(positions, score, centres, 0.015)
    with np.errstate(invalid="ignore"):
        is_near = [np.linalg.norm(positions - centre, axis=-1) <= 0.015 for centre in centres]
    expected = [max(score[there & np.isfinite(score)], default=np.nan) for there in is_near]
    np.testing.assert_array_equal(found, expected)


def test_areas_are_those_of_numpys_gradients():
    positions = np.random.default_rng(1).uniform(-0.05, 0.05, (9, 12, 2))
    positions[4, 5] = np.nan
    down, across = np.gradient(positions, axis=(0, 1))
    expected = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])
    np.testing.assert_allclose(pixel_areas(positions), expected, rtol=1e-12)
    assert (
        np.isnan(pixel_areas(positions)).sum() == 4
    )  # a central difference does not look at its own pixel


class FewerFound(ThesisDetector):
    """Finds in a way of its own: the strongest only."""

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        return super().find(cloud, evidence, threshold)[:1]


@pytest.mark.parametrize("kind", [ThesisDetector, FewerFound])
@pytest.mark.parametrize("min_points", [1, 3])
def test_findings_at_other_thresholds_are_those_of_find(
    kind: type[ThesisDetector], min_points: int
):
    judgement = judgement_of()
    labelled = judgement.labelled
    detector = kind(ThesisConfig.from_data({"min_points": min_points}))
    score = np.random.default_rng(2).exponential(2.0, labelled.cloud.valid.shape)
    evidence = Evidence(score, score, score, 1.0)
    (operating,) = study_record(replace(judgement, detector=detector, evidence=evidence)).operating
    truth = np.array([damage.centre_board_m[:2] for damage in labelled.truth])
    for index, threshold in enumerate(operating.threshold):
        detections = detector.find(labelled.cloud, evidence, threshold)
        centres = np.array([detection.centre_m for detection in detections]).reshape(-1, 3)
        assert operating.findings[index] == len(detections)
        hits = match(truth, labelled.on_board(centres), 0.01)
        assert operating.hits[index] == len(hits)
    most = max(operating.findings)
    assert most == 1 if kind is FewerFound else most > 1


def test_the_margin_is_taken_off_as_by_plain_erosion():
    mask = np.ones((60, 70), bool)
    mask[30, 40] = mask[5, 60] = False
    square = np.ones((2 * INTACT_MARGIN_PX + 1,) * 2, bool)
    np.testing.assert_array_equal(
        _eroded(mask), ndimage.binary_erosion(mask, square, border_value=0)
    )


def test_lines_of_sight_meet_a_flat_face_where_they_should():
    board = BoardConfig(width_mm=200, height_mm=200, thickness_mm=5)
    points = np.array([[0.0, 0.0, 0.7], [0.1, 0.0, 0.6]])
    direction = np.array([[0.1, -0.05, -1.0], [-0.15, 0.1, -0.9]])
    met = met_on_face(points, direction, face_of(board))
    np.testing.assert_allclose(
        met, points - (points[:, 2] / direction[:, 2])[:, None] * direction, atol=1e-15
    )


def test_a_detection_without_return_that_hits_a_damage_is_no_false_call(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of two places without a return, one is the second damage, the other is far from both."""
    hit = Detection(1.0, np.array([2979, 2980]), np.array([30e-3, 0.0, 0.0]), kind="no return")
    call = Detection(1.0, np.array([250, 251]), np.array([0.0, -25e-3, 0.0]), kind="no return")
    missing = SimpleNamespace(detections=(hit, call))
    monkeypatch.setattr("harness.trials.judge.missing_returns", lambda *_: missing)
    judgement = judgement_of()
    assert judgement.without_return == (frozenset({1}), 1)
    hole_free = judgement_of(damaged=False)
    assert hole_free.without_return == (frozenset(), 2)
