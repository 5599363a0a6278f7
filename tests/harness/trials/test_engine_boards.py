"""What a study asks of one board, and where lines of sight meet its face."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy import ndimage

from detectors.interface import Detection, Evidence
from detectors.methods.thesis import ThesisConfig, ThesisDetector
from harness.evaluation.match import match
from harness.trials.judge import FINDING_OCTAVES, PIXEL_OCTAVES, JudgedCloud, grid, study_rows
from harness.trials.setup import (
    INTACT_MARGIN_PX,
    KnownCloud,
    _eroded,
    highest_within,
    met_on_face,
    pixel_areas,
)
from harness.vocabulary.geometry import Cloud, Region
from scenes.target.custom import BoardConfig, SphereConfig, TargetConfig
from scenes.target.truth import face_of, truth_of


def sight_and_judgement(threshold: float = 4.0) -> tuple[KnownCloud, JudgedCloud]:
    """A board of 100 x 60 mm on a grid of 1 mm, two damages; the first's pixel scores 9, one far
    from both 5."""
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
    places = points[..., :2]
    truth = truth_of(target, target.pose.T_camera_board)
    outlines = {
        d.id: np.flatnonzero(
            np.linalg.norm(places - d.centre_board_m[:2], axis=-1) < d.diameter_m / 2
        )
        for d in truth
    }
    undamaged = np.ones(x.shape, bool)
    undamaged.ravel()[np.concatenate(list(outlines.values()))] = False
    known = KnownCloud(
        cloud, T_board_cloud, target, truth, outlines, places, undamaged, {1: 0.01, 2: 0.01}
    )
    score = np.zeros(x.shape)
    score[:, 90:] = np.nan
    score[29, 19], score[10, 50] = 9.0, 5.0
    hit = Detection(score[29, 19], np.array([(29, 19)[0] * 100 + (29, 19)[1]]), points[29, 19])
    call = Detection(score[10, 50], np.array([(10, 50)[0] * 100 + (10, 50)[1]]), points[10, 50])

    class Found:
        def find(self, cloud: Cloud, evidence: object, threshold: float) -> tuple[Detection, ...]:
            return tuple(one for one in (hit, call) if one.score > threshold)

    evidence = SimpleNamespace(score=score)
    judgement = JudgedCloud(
        run={"threshold": threshold},
        holes=[{"hole": "1"}, {"hole": "2"}],
        detector=Found(),  # type: ignore[arg-type]
        evidence=evidence,  # type: ignore[arg-type]
        detections=(hit, call),
        places_m=np.array([points[29, 19, :2], points[10, 50, :2]]),
        pairs={0: 0},
    )
    return known, judgement


def test_what_a_damaged_board_gives():
    known, judgement = sight_and_judgement()
    rows = study_rows(known, judgement, 0.01, hole_free=False)
    assert [row["signal"] for row in rows["holes"]] == [9.0, 0.0]
    assert rows["runs"][0]["inspected_m2"] == pytest.approx(
        90 * 60e-6
    )  # ten columns of 100 were not judged
    findings = rows["findings"]
    assert [(one["hole"], one["score"]) for one in findings] == [("1", 9.0), ("", 5.0)]
    assert (findings[1]["x_mm"], findings[1]["y_mm"]) == pytest.approx((0.5, -19.5))
    (operating,) = rows["operating"]
    at = dict(
        zip(
            operating["threshold"],
            zip(operating["findings"], operating["hits"], strict=True),
            strict=True,
        )
    )
    assert at[4.0] == (2, 1)
    assert at[8.0] == (1, 1)
    assert at[16.0] == (0, 0)
    of_pixels = {row["hole"]: row for row in rows["pixels"]}
    assert of_pixels["1"]["pixels"] == len(known.outlines[1])
    assert of_pixels["1"]["above"][of_pixels["1"]["threshold"].index(4.0)] == 1
    assert of_pixels[""]["above"][of_pixels[""]["threshold"].index(4.0)] == 1
    assert rows["sites"] == []


def test_a_hole_free_board_gives_the_same_places_as_sites():
    known, judgement = sight_and_judgement()
    rows = study_rows(known, judgement, 0.01, hole_free=True)
    assert rows["holes"] == []
    assert [(row["hole"], row["detected"], row["signal"]) for row in rows["sites"]] == [
        ("1", True, 9.0),
        ("2", False, 0.0),
    ]
    assert {one["hole"] for one in rows["findings"]} == {""}
    assert rows["operating"][0]["hits"] == [0] * len(grid(4.0, FINDING_OCTAVES))
    assert rows["pixels"] == []


def test_a_place_where_nothing_was_judged_has_no_signal():
    known, judgement = sight_and_judgement()
    judgement.evidence.score[:] = np.nan
    assert np.isnan(study_rows(known, judgement, 0.01, hole_free=True)["sites"][0]["signal"])


def test_the_grid_of_thresholds_holds_the_one_in_use():
    for octaves in (FINDING_OCTAVES, PIXEL_OCTAVES):
        found = grid(3.7, octaves)
        assert 3.7 in found
        assert found[1:] / found[:-1] == pytest.approx(2**0.25)
    assert grid(0.0, FINDING_OCTAVES).tolist() == [0.0]


def test_pixels_cover_the_face_however_it_is_tilted():
    """A camera's grid on a plane tilted by 40 degrees: the pixels' areas sum to the face's."""
    known, _ = sight_and_judgement()
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
    places = random.uniform(-0.05, 0.05, (17, 23, 2))
    score = random.exponential(1.0, (17, 23))
    places[random.random((17, 23)) < 0.1] = np.nan
    score[random.random((17, 23)) < 0.1] = np.nan
    score[0, 0] = np.inf
    centres = np.vstack([random.uniform(-0.05, 0.05, (6, 2)), [[9.0, 9.0]]])
    found = highest_within(places, score, centres, 0.015)
    with np.errstate(invalid="ignore"):
        near = [np.linalg.norm(places - centre, axis=-1) <= 0.015 for centre in centres]
    expected = [max(score[there & np.isfinite(score)], default=np.nan) for there in near]
    np.testing.assert_array_equal(found, expected)


def test_areas_are_those_of_numpys_gradients():
    places = np.random.default_rng(1).uniform(-0.05, 0.05, (9, 12, 2))
    places[4, 5] = np.nan
    down, across = np.gradient(places, axis=(0, 1))
    expected = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])
    np.testing.assert_allclose(pixel_areas(places), expected, rtol=1e-12)
    assert (
        np.isnan(pixel_areas(places)).sum() == 4
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
    known, judgement = sight_and_judgement()
    detector = kind(ThesisConfig.from_data({"min_points": min_points}))
    score = np.random.default_rng(2).exponential(2.0, known.cloud.valid.shape)
    evidence = Evidence(score, score, score, 1.0)
    judgement = replace(judgement, detector=detector, evidence=evidence)
    (operating,) = study_rows(known, judgement, 0.01, hole_free=False)["operating"]
    found = [detector.find(known.cloud, evidence, one) for one in operating["threshold"]]
    centres = [
        known.on_board(np.array([one.centre_m for one in each]).reshape(-1, 3)) for each in found
    ]
    truth = np.array([damage.centre_board_m[:2] for damage in known.truth])
    assert operating["findings"] == [len(each) for each in found]
    assert operating["hits"] == [len(match(truth, each, 0.01)) for each in centres]
    assert max(operating["findings"]) == 1 if kind is FewerFound else max(operating["findings"]) > 1


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
