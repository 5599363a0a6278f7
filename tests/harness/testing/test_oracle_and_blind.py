"""The two detectors that test the harness: one is handed the truth, the other guesses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from detectors import load_detector
from detectors.interface import NeedsTruth, TrueDamage
from harness.testing import CHECKS
from harness.testing import contract as checks
from harness.testing.synthetic_clouds import (
    DISTANCE_M,
    LENS,
    SHAPE,
    cylinder,
    plane,
    with_gaps,
    without,
)
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud
from tests.support.control_detectors import BlindDetector, Oracle, judged_area_m2

pytestmark = pytest.mark.usefixtures("control_detectors")

ALPHA = 0.001
"""Of every statistical test here, with fixed seeds."""
PITCH_M = DISTANCE_M / LENS.fx


def damage(row: int, column: int, radius_px: float) -> TrueDamage:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    pixels = np.flatnonzero(np.hypot(u - column, v - row) <= radius_px)
    slopes = LENS.slopes(column, row)
    return TrueDamage(np.array([*slopes, 1.0]) * DISTANCE_M, 2 * radius_px * PITCH_M, pixels)


TRUTH = (damage(20, 30, 5.0), damage(60, 80, 0.4), damage(60, 90, 3.0))
"""The second has one pixel; the last is 10 pixels, 14 mm, beside it."""


def oracle(*truth: TrueDamage) -> Oracle:
    unaware = load_detector("oracle", {})
    assert isinstance(unaware, NeedsTruth)
    detector = unaware.with_truth(truth)
    assert isinstance(detector, Oracle)
    return detector


# ---------------------------------------------------------------- the oracle


@pytest.mark.parametrize("threshold", [0.0, 0.3, float(np.nextafter(1.0, 0.0))])
def test_the_oracle_finds_each_damage_once_where_it_is(threshold: float) -> None:
    cloud = plane(seed=1)
    detector = oracle(*TRUTH)
    evidence = detector.analyse(cloud)
    result = detector.find(cloud, evidence, threshold)
    assert [detection.score for detection in result] == [1.0, 1.0, 1.0]
    for detection, true in zip(result, TRUTH, strict=True):
        np.testing.assert_array_equal(detection.centre_m, true.centre_m)
        np.testing.assert_array_equal(detection.pixels, true.pixels)
        measured = detector.measure(cloud, evidence, detection)
        assert (measured.extent_diameter_m, measured.points) == (true.diameter_m, len(true.pixels))
    assert (
        detector.find(cloud, evidence, 1.0) == ()
        and detector.quiet_threshold(cloud, evidence) == 1.0
    )
    score = np.zeros(SHAPE)
    score.reshape(-1)[np.concatenate([true.pixels for true in TRUTH])] = 1.0
    np.testing.assert_array_equal(evidence.score, score)


def test_the_oracle_finds_damage_none_of_whose_pixels_has_a_range() -> None:
    cloud = plane(seed=1)
    gone = np.zeros(SHAPE, dtype=bool)
    for true in TRUTH:
        gone.reshape(-1)[true.pixels] = True
    blinded = without(cloud, gone)
    detector = oracle(*TRUTH)
    evidence = detector.analyse(blinded)
    result = detector.find(blinded, evidence, 0.5)
    assert len(result) == 3 and (evidence.score.reshape(-1)[TRUTH[0].pixels] == 1.0).all()
    assert detector.measure(blinded, evidence, result[0]).extent_diameter_m == TRUTH[0].diameter_m


def test_the_oracle_calls_nothing_on_a_hole_free_board() -> None:
    cloud = with_gaps(plane(seed=1), seed=2)
    detector = oracle()
    evidence = detector.analyse(cloud)
    assert (
        detector.find(cloud, evidence, 0.0) == ()
        and detector.quiet_threshold(cloud, evidence) == 0.0
    )
    assert np.nanmax(evidence.score) == 0.0 and np.array_equal(
        np.isfinite(evidence.score), cloud.valid
    )


def test_the_oracle_keeps_the_contract_of_its_own_cloud() -> None:
    """Told of one cloud, it finds the same damage in any other."""
    cloud = plane(seed=1)
    for check in CHECKS:
        if check not in (
            checks.turns_with_the_cloud,
            checks.moves_with_the_cloud,
            checks.survives_missing_pixels,
        ):
            check(lambda: oracle(*TRUTH), cloud)


def test_the_oracle_without_the_truth_says_so() -> None:
    with pytest.raises(UserError, match="has not received the truth"):
        Oracle(Config()).analyse(plane(seed=1))


# ---------------------------------------------------------------- the blind one


def blind(**settings: object) -> BlindDetector:
    detector = load_detector("blind", {"crop": {"kind": "none"}, **settings})
    assert isinstance(detector, BlindDetector)
    return detector


def test_the_blind_detector_keeps_the_contract_but_does_not_move_with_the_cloud() -> None:
    cloud = with_gaps(plane(seed=1), seed=2)
    for check in CHECKS:
        if check not in (checks.turns_with_the_cloud, checks.moves_with_the_cloud):
            check(blind, cloud)
    with pytest.raises(AssertionError, match="moved by 37 mm"):
        checks.moves_with_the_cloud(blind, cloud)


def test_guesses_are_those_of_the_seed_and_the_cloud() -> None:
    cloud = plane(seed=1)
    first = blind(seed=1).analyse(cloud).score
    assert np.array_equal(first, blind(seed=1).analyse(cloud).score)
    assert not np.array_equal(first, blind(seed=2).analyse(cloud).score)
    points = cloud.points_m.copy()
    points[0, 0, 2] += 1e-9
    assert not np.array_equal(first, blind(seed=1).analyse(replace(cloud, points_m=points)).score)


def test_guesses_are_as_many_as_stated_everywhere_alike_and_exponential() -> None:
    """400 clouds of 0.021 m^2: some 3,400 guesses at 400 per square metre."""
    cloud = plane(seed=1, tilt=0.0)
    detector = blind()
    rows = []
    scores = []
    area_m2 = 0.0
    for seed in range(400):
        evidence = blind(seed=seed).analyse(cloud)
        result = detector.find(cloud, evidence, 0.0)
        rows += [detection.pixels[0] // SHAPE[1] for detection in result]
        scores += [detection.score for detection in result]
        area_m2 += evidence.notes["area_m2"]
        assert len(result) == evidence.notes["guesses"]
    low, high = stats.poisson.interval(1 - ALPHA, 400 * area_m2)
    assert low <= len(scores) <= high
    assert stats.kstest(scores, "expon").pvalue > ALPHA
    assert stats.chisquare(np.histogram(rows, bins=9, range=(0, SHAPE[0]))[0]).pvalue > ALPHA
    # so a threshold of ln(400) leaves one false call per square metre
    low, high = stats.poisson.interval(1 - ALPHA, area_m2)
    assert low <= sum(score > np.log(400) for score in scores) <= high


def test_guesses_do_not_look_at_depth() -> None:
    """Damaged pixels draw their share: 3.9 % of them are in a hole or on a bump."""
    cloud = plane(seed=1, tilt=0.0)
    damaged = np.abs(cloud.points_m[..., 2] - DISTANCE_M) > 3e-3
    inside = 0
    total = 0
    for seed in range(300):
        positions = np.flatnonzero(blind(seed=seed).analyse(cloud).score > 0)
        inside += int(damaged.reshape(-1)[positions].sum())
        total += len(positions)
    assert stats.binomtest(inside, total, float(damaged.mean())).pvalue > ALPHA


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_the_judged_area_is_the_faces(tilt: float) -> None:
    """A plane z = d + t x cuts a ray of slope s at z = d / (1 - t s); its corners' quadrilateral,
    over its tilt."""
    cloud = plane(seed=1, tilt=tilt)
    h, w = SHAPE
    slopes = LENS.slopes(np.array([0, w - 1, w - 1, 0]), np.array([0, 0, h - 1, h - 1]))
    z = DISTANCE_M / (1 - tilt * slopes[:, 0])
    x = slopes[:, 0] * z
    y = slopes[:, 1] * z
    across = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    true = across * np.hypot(1.0, tilt)
    assert judged_area_m2(cloud, cloud.valid) == pytest.approx(true, rel=0.01)


def test_noise_does_not_make_a_face_larger_and_a_curved_one_is_hardly_smaller() -> None:
    cloud = plane(seed=1)
    quiet = judged_area_m2(cloud, cloud.valid)
    noise = np.random.default_rng(7).standard_normal(SHAPE)[..., None] * 5e-3
    noisy = replace(cloud, points_m=cloud.points_m * (1 + noise / DISTANCE_M))
    assert judged_area_m2(noisy, cloud.valid) == pytest.approx(quiet, rel=0.01)
    bent = cylinder(seed=1)
    chord = float(np.ptp(bent.points_m[..., 0]))
    arc = 2 * 0.5 * np.arcsin(chord / 2 / 0.5)
    assert judged_area_m2(bent, bent.valid) == pytest.approx(
        np.ptp(bent.points_m[..., 1]) * arc, rel=0.03
    )


def test_a_cloud_without_a_grid_has_an_area_and_guesses() -> None:
    cloud = plane(seed=1)
    n = cloud.valid.size
    images = ("points_m", "reason", "count", "variance_m2")
    row = {
        name: getattr(cloud, name).reshape(1, n, *getattr(cloud, name).shape[2:]) for name in images
    }
    flat = Cloud(**{**cloud.__dict__, **row, "organised": False})
    assert judged_area_m2(flat, flat.valid) == pytest.approx(
        judged_area_m2(cloud, cloud.valid), rel=0.03
    )
    detector = blind(guesses_per_m2=1000.0)
    evidence = detector.analyse(flat)
    (strongest, *_) = detector.find(flat, evidence, 0.0)
    measured = detector.measure(flat, evidence, strongest)
    assert measured.extent_diameter_m == 0.0 and np.array_equal(
        measured.extent_centre_m, strongest.centre_m
    )


def test_three_points_on_a_line_have_no_area() -> None:
    cloud = plane(seed=1)
    sample = np.ones(SHAPE, dtype=bool)
    sample[5, [3, 40]] = False
    assert judged_area_m2(cloud, without(cloud, sample).valid) == 0.0
