"""Score maps: clusters at thresholds, the quiet threshold, detections as arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from detectors.interface import Detection, Evidence
from detectors.levels import highest_peaks
from detectors.score_map import (
    Findings,
    ScoreMapConfig,
    ScoreMapDetector,
    above,
    findings_at,
)
from harness.testing.synthetic_clouds import SHAPE, plane
from harness.vocabulary.geometry import Cloud

CLOUD = plane(seed=1, tilt=0.0)


class GivenScores(ScoreMapDetector[ScoreMapConfig]):
    """Scores that a test sets."""

    name = "given"
    version = 1

    def analyse(self, cloud: Cloud) -> Evidence:
        raise NotImplementedError


class OverriddenFind(GivenScores):
    """Finds nothing; what it inherits for many thresholds does not hold."""

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        return ()


def detector(min_points: int = 1, distance_mm: float = 2.0) -> GivenScores:
    """Pixels of the plane are 1.4 mm apart: 2 mm join diagonal neighbours."""
    return GivenScores(ScoreMapConfig(min_points=min_points, cluster_distance_mm=distance_mm))


def evidence(score: np.ndarray) -> Evidence:
    return Evidence(score, np.zeros(SHAPE), np.full(SHAPE, 0.7), 1e-3)


def scattered(score: float) -> np.ndarray:
    """So strong pixels, each six pixels from the next: 300 of them."""
    scores = np.zeros(SHAPE)
    scores[::6, ::6] = score
    return scores


def test_pixels_above_the_threshold_are_clusters() -> None:
    scores = np.full(SHAPE, np.nan)
    scores[10:12, 10:12] = [[3.0, 4.0], [5.0, 6.0]]
    scores[40, 50] = 7.0
    scores[60, 60] = 2.0
    results = detector().find(CLOUD, evidence(scores), 2.0)
    assert [detection.score for detection in results] == [7.0, 6.0]
    rows, columns = np.unravel_index(results[1].pixels, SHAPE)
    assert sorted(zip(rows.tolist(), columns.tolist(), strict=True)) == [
        (10, 10),
        (10, 11),
        (11, 10),
        (11, 11),
    ]
    np.testing.assert_allclose(
        results[0].centre_m,
        CLOUD.points_m[40, 50],
        atol=1e-12,
    )
    assert above(evidence(scores), 6.0).tolist() == [40 * SHAPE[1] + 50]


def test_invalid_points_are_in_no_cluster() -> None:
    scores = np.zeros(SHAPE)
    scores[10, 10:13] = 5.0
    points_m = CLOUD.points_m.copy()
    points_m[10, 12] = np.nan
    holed = replace(CLOUD, points_m=points_m)
    (results,) = detector().find(holed, evidence(scores), 1.0)
    assert len(results.pixels) == 2
    assert detector(3).quiet_threshold(holed, evidence(scores)) == 0.0


@pytest.mark.parametrize("min_points", [1, 2, 3])
def test_nothing_is_found_at_the_quiet_threshold_and_something_just_below(min_points) -> None:
    random = np.random.default_rng(2)
    scores = evidence(random.exponential(size=SHAPE))
    quiet = detector(min_points).quiet_threshold(CLOUD, scores)
    assert not detector(min_points).find(CLOUD, scores, quiet)
    assert detector(min_points).find(CLOUD, scores, np.nextafter(quiet, 0.0))


def test_a_weak_cluster_below_many_strong_pixels_sets_the_quiet_threshold() -> None:
    """300 strong pixels stand alone, more than the 64 for each of the two points that are tried
    first."""
    scores = scattered(9.0)
    scores[45, 51:53] = 1.5
    assert detector(2).quiet_threshold(CLOUD, evidence(scores)) == 1.5
    assert detector(2).quiet_threshold(CLOUD, evidence(scattered(9.0))) == 0.0
    assert detector(1).quiet_threshold(CLOUD, evidence(scores)) == 9.0


def test_arrays_and_detections_are_two_forms_of_findings() -> None:
    detections = (
        Detection(7.0, np.array([3, 9]), np.array([0.1, 0.2, 0.7])),
        Detection(5.0, np.array([4]), np.array([0.3, 0.2, 0.8])),
        Detection(5.0, np.array([1, 20]), np.array([0.0, 0.1, 0.9])),
    )
    arrays = Findings.of(detections)
    assert arrays.scores.tolist() == [7.0, 5.0, 5.0]
    assert arrays.pixels.tolist() == [3, 9, 4, 1, 20]
    assert arrays.labels.tolist() == [0, 0, 1, 2, 2]
    # of equal scores, the one with the first pixel comes first
    expected = (detections[0], detections[2], detections[1])
    for results, detection in zip(arrays.detections, expected, strict=True):
        assert results.score == detection.score
        np.testing.assert_array_equal(results.pixels, detection.pixels)
        np.testing.assert_array_equal(results.centre_m, detection.centre_m)
    assert Findings.of(()).detections == ()


def test_many_thresholds_at_once_are_each_alone() -> None:
    scores = evidence(np.random.default_rng(3).exponential(size=SHAPE))
    thresholds = [1.0, 2.5, 4.0]
    results = findings_at(detector(2), CLOUD, scores, thresholds)
    for findings, threshold in zip(results, thresholds, strict=True):
        alone = detector(2).find(CLOUD, scores, threshold)
        assert len(findings.detections) == len(alone) > 0
        for detection, expected in zip(findings.detections, alone, strict=True):
            assert detection.score == expected.score
            np.testing.assert_array_equal(detection.pixels, expected.pixels)
    overridden = OverriddenFind(ScoreMapConfig())
    empty = findings_at(overridden, CLOUD, scores, thresholds)
    assert all(len(findings.scores) == 0 for findings in empty)


def peaks_of(scores: np.ndarray, count: int) -> tuple[float, ...]:
    judged = detector()
    quiet = judged.quiet_threshold(CLOUD, evidence(scores))
    return highest_peaks(judged, CLOUD, evidence(scores), quiet_threshold=quiet, count=count)


def test_the_highest_peaks_are_those_of_the_strongest_findings() -> None:
    """Twenty separate pixels from 5.0 to 6.9: at 0.9 times the highest are seven of them, at 0.85
    ten and more."""
    scores = np.zeros(SHAPE)
    heights = 5.0 + 0.1 * np.arange(20)
    rows, columns = np.indices(scores[::6, ::6].shape)
    for number, height in enumerate(heights):
        scores[6 * rows.flat[number], 6 * columns.flat[number]] = height
    assert peaks_of(scores, 5) == pytest.approx(heights[::-1][:5])
    assert peaks_of(scores, 10) == pytest.approx(heights[::-1][:10])
    assert peaks_of(scores, 30) == pytest.approx(heights[::-1])  # there are no more


def test_without_a_finding_the_quiet_threshold_is_the_only_peak() -> None:
    assert peaks_of(np.zeros(SHAPE), 10) == (0.0,)
