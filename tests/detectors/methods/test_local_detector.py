"""The local and the matched detector: the contract, single pixels, neighbours, the noise of each
place, clouds without a grid, maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from detectors.interface import Detection
from detectors.methods import local, local_reference
from detectors.methods.local import (
    LocalConfig,
    LocalDetector,
    _scored,
    _strongest,
    tent_squares,
)
from detectors.methods.matched import MatchedDetector
from harness.testing import check_detector
from harness.testing.synthetic_clouds import LENS, plane, with_gaps
from harness.vocabulary.geometry import Cloud, Region

SHAPE = (200, 240)
NOISE_M = 3e-4


@pytest.fixture(params=[LocalDetector, MatchedDetector], ids=["local", "matched"])
def detector(request: pytest.FixtureRequest) -> LocalDetector:
    kind: type[LocalDetector] = request.param
    return kind(kind.settings_type.from_data({"crop": {"kind": "none"}}))


def seen(
    depth_m: Callable[[np.ndarray, np.ndarray], np.ndarray],
    seed: int = 1,
    noise_m: float = NOISE_M,
) -> Cloud:
    """A frontal plane at 0.7 m, 1.4 mm a pixel, with ``depth_m(u, v)`` of pixels added and white
    noise."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    z = 0.7 + depth_m(u, v) + noise_m * np.random.default_rng(seed).standard_normal(SHAPE)
    slopes = np.stack([(u - 119.5) / LENS.fx, (v - 99.5) / LENS.fy, np.ones(SHAPE)], axis=-1)
    flat = np.zeros(SHAPE, dtype=np.uint8)
    return Cloud(
        points_m=slopes * z[..., None],
        reason=flat,
        count=flat.astype(np.int64) + 20,
        variance_m2=np.full(SHAPE, 20 * noise_m**2),
        region=Region(0, SHAPE[0], 0, SHAPE[1]),
        z_step_m=0.0,
        n_frames=20,
    )


def disc(
    u0: float,
    v0: float,
    radius_px: float,
    depth_m: float,
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda u, v: depth_m * (np.hypot(u - u0, v - v0) < radius_px)


def detections_in(
    detector: LocalDetector,
    cloud: Cloud,
    threshold: float = 6.0,
) -> tuple[Detection, ...]:
    return detector.find(cloud, detector.analyse(cloud), threshold)


def places_px(cloud: Cloud, detections: tuple[Detection, ...]) -> np.ndarray:
    """(n, 2) column and row, by column."""
    centres = np.array([detection.centre_m for detection in detections]).reshape(-1, 3)
    slopes = centres[:, :2] / centres[:, 2:]
    return np.array(sorted((slopes * [LENS.fx, LENS.fy] + [119.5, 99.5]).tolist())).reshape(-1, 2)


def test_it_keeps_the_contract(detector: LocalDetector) -> None:
    check_detector(type(detector), clouds=[with_gaps(plane(seed=3), seed=4)])


@pytest.mark.slow
def test_it_keeps_the_contract_on_every_face(detector: LocalDetector) -> None:
    check_detector(type(detector))


def test_white_noise_scores_as_noise_does(detector: LocalDetector) -> None:
    """Some 4,000 independent means of seven widths: beyond 6 deviations by chance with probability
    5e-5."""
    evidence = detector.analyse(seen(lambda u, v: 0 * u))
    assert 3.0 < detector.quiet_threshold(seen(lambda u, v: 0 * u), evidence) < 6.0


def test_peaks_are_the_same_at_every_threshold(detector: LocalDetector) -> None:
    """A threshold between a peak and its saddle parts no peak: the tail of low peaks tells how
    many there are at a higher one."""
    cloud = seen(lambda u, v: 0 * u)
    evidence = detector.analyse(cloud)
    scores = [
        [detection.score for detection in detector.find(cloud, evidence, threshold)]
        for threshold in (2.2, 3.0, 3.4)
    ]
    for above, threshold in zip(scores[1:], (3.0, 3.4), strict=True):
        assert above == [score for score in scores[0] if score > threshold]
    assert len(scores[2]) >= 3


def test_what_no_single_pixel_shows_is_found_by_its_mean(detector: LocalDetector) -> None:
    """A dent of one deviation, 30 pixels wide: 700 pixels, so that their mean stands out by 20
    deviations."""
    cloud = seen(disc(120, 100, 15, NOISE_M))
    centres_px = places_px(cloud, detections_in(detector, cloud))
    assert len(centres_px) == 1
    assert np.abs(centres_px[0] - [120, 100]).max() < 4


def test_a_flying_pixel_alone_is_no_finding_but_a_small_hole_is(detector: LocalDetector) -> None:
    def holes(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        flying = 0.5 * ((u == 60) & (v == 80))
        return flying + disc(170, 120, 2.0, 0.005)(u, v)

    cloud = seen(holes)
    centres_px = places_px(cloud, detections_in(detector, cloud))
    assert len(centres_px) == 1
    assert np.abs(centres_px[0] - [170, 120]).max() < 1


def test_neighbours_stay_apart_and_a_deep_hole_hides_no_shallow_one(
    detector: LocalDetector,
) -> None:
    """Two diameters from centre to centre; gaps of 7 mm, which a linkage of 10 mm closes. The deep
    hole is 100 times as deep as its neighbour."""
    row = [(60.0, 0.003), (70.0, 0.003), (80.0, 0.003), (150.0, 0.2), (164.0, 0.002)]
    cloud = seen(
        lambda u, v: sum((disc(u0, 100, 2.5, depth)(u, v) for u0, depth in row), start=0 * u)
    )
    centres_px = places_px(cloud, detections_in(detector, cloud))
    assert np.abs(centres_px[:, 0] - [u0 for u0, _ in row]).max() < 1.5


def test_a_deep_hole_leaves_no_ring_of_false_findings(detector: LocalDetector) -> None:
    cloud = seen(disc(120, 100, 12, 0.03))
    assert len(detections_in(detector, cloud, 5.5)) == 1


def test_holes_and_bumps_side_by_side_are_findings_of_their_own(detector: LocalDetector) -> None:
    cloud = seen(lambda u, v: disc(100, 100, 5, 0.004)(u, v) - disc(111, 100, 5, 0.004)(u, v))
    evidence = detector.analyse(cloud)
    detections = detector.find(cloud, evidence, 6.0)
    depths = [
        detector.measure(cloud, evidence, detection).model_depth_m for detection in detections
    ]
    assert sorted(np.sign(depths)) == [-1, 1]


def test_noise_counts_where_it_is(detector: LocalDetector) -> None:
    """Ten times the noise on the right half: a hole that is found in the quiet half is lost in the
    noise there, and the noisy half calls no more often. The window of the noise blurs the step
    itself."""
    rough = np.random.default_rng(5).standard_normal(SHAPE)

    def half(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        noise = np.where(u >= 120, 10 * NOISE_M * rough, 0.0)
        return noise + disc(60, 100, 3, 0.0015)(u, v) + disc(180, 100, 3, 0.0015)(u, v)

    # the noisy half draws the surface by a fifth of a deviation of the quiet one, which wide
    # templates see
    threshold = 6.5 if isinstance(detector, MatchedDetector) else 6.0
    centres_px = places_px(seen(half), detections_in(detector, seen(half), threshold))
    away = centres_px[np.abs(centres_px[:, 0] - 120) > 50]
    assert len(away) == 1
    assert abs(away[0, 0] - 60) < 2


def test_invalid_pixels_and_borders_are_not_evidence(detector: LocalDetector) -> None:
    cloud = seen(disc(120, 100, 4, 0.004))
    gone = np.random.default_rng(3).random(SHAPE) < 0.3
    gone[40:60, 40:60] = True
    holed = replace(cloud, points_m=np.where(gone[..., None], np.nan, cloud.points_m))
    centres_px = places_px(holed, detections_in(detector, holed))
    assert len(centres_px) == 1
    assert np.abs(centres_px[0] - [120, 100]).max() < 2


def test_a_cloud_without_a_grid_is_judged_on_a_raster(detector: LocalDetector) -> None:
    cloud = seen(disc(120, 100, 6, 0.005))
    order = np.random.default_rng(2).permutation(SHAPE[0] * SHAPE[1])

    def listed(image: np.ndarray) -> np.ndarray:
        return image.reshape(1, len(order), *image.shape[2:])[:, order]

    names = ("points_m", "reason", "count", "variance_m2")
    region = Region(0, 1, 0, len(order))
    loose = replace(
        cloud,
        organised=False,
        region=region,
        **{name: listed(getattr(cloud, name)) for name in names},
    )
    centres_px = places_px(loose, detections_in(detector, loose))
    assert len(centres_px) == 1
    assert np.abs(centres_px[0] - [120, 100]).max() < 2


def test_a_map_trusts_points_by_their_variance(detector: LocalDetector) -> None:
    """Every second column is ten times as noisy: with variances the dent stands out by the quiet
    columns alone."""
    rough = 10 * NOISE_M * np.random.default_rng(4).standard_normal(SHAPE)
    cloud = seen(lambda u, v: np.where(u % 2 == 1, rough, 0.0) + disc(120, 100, 6, 0.0015)(u, v))
    noise = np.where(np.arange(SHAPE[1]) % 2 == 1, 10 * NOISE_M, NOISE_M)
    stated = replace(cloud, mean_variance_m2=np.broadcast_to(noise**2, SHAPE).copy())
    scores = [
        detector.analyse(detection).score[97:104, 117:124].max() for detection in (cloud, stated)
    ]
    # a spectrum knows of the columns, even where nobody states variances
    gain = 1.2 if isinstance(detector, MatchedDetector) else 2.0
    assert scores[1] > gain * scores[0]
    assert scores[1] > 8


def test_the_least_unit_is_what_rounding_leaves_in_a_mean() -> None:
    """A tent over 3 pixels lowers the deviation of what differs from pixel to pixel to 2 / 9, and
    nothing of what neighbours share."""
    flat_m = np.zeros((80, 90))
    weights = np.ones(flat_m.shape, np.float32)
    for fixed_m2, random_m2, expected_m in ((4e-6, 0.0, 2e-3), (0.0, 4e-6, 2e-3 * 2 / 9)):
        _, _, typical_m = _scored(flat_m, weights, (fixed_m2, random_m2), 6.0)
        assert typical_m == pytest.approx(expected_m, rel=1e-5)


MOUTHS_U = (190, 300, 407, 517, 626, 736, 218, 321, 423, 729, 836, 944, 1059)
MOUTHS_U += (244, 340, 437, 726, 825, 721, 816, 718, 809, 902, 716, 803, 390)
MOUTHS_V = (603, 602, 601, 603, 603, 605, 492, 491, 491, 491, 493, 493, 494)
MOUTHS_V += (394, 394, 393, 392, 392, 303, 302, 222, 219, 216, 147, 144, 85)
MOUTHS_PX = np.array([MOUTHS_U, MOUTHS_V]).T
"""Mouths of a drilled plate that nothing lies beside, read off the mean depth by eye, to some 3
pixels."""


@pytest.mark.slow
def test_a_real_drilled_plate(detector: LocalDetector, shared_data: Path) -> None:
    """A metal plate with holes of 5 mm at 0.25 m, with tags and an object on it, seen by an Azure
    Kinect."""
    from detectors.averages.average import AverageConfig, average
    from detectors.pixels.noise import REACH_FRAMES, noise_reach_px
    from detectors.recordings import open_capture

    folder = shared_data / "azure_drilled_board"
    if not folder.is_dir():
        pytest.skip("the capture of the drilled plate is not here")
    recording = open_capture([folder])
    reach_px = noise_reach_px(list(islice(recording.frames(), REACH_FRAMES)), recording.z_step_m)
    cloud = replace(average(recording, AverageConfig()), noise_reach_px=reach_px)
    detector = type(detector)(LocalConfig.from_data({}))
    evidence = detector.analyse(cloud)
    # the thresholds that one false call on this capture needs by its own noise
    threshold = 5.7 if isinstance(detector, MatchedDetector) else 5.0
    holes = [
        detector.measure(cloud, evidence, detection)
        for detection in detector.find(cloud, evidence, threshold)
        if np.median(evidence.residual_m.reshape(-1)[detection.pixels]) > 0
    ]
    centres_px = np.array([(detection.u_px, detection.v_px) for detection in holes])
    distances_px = np.linalg.norm(MOUTHS_PX[:, None] - centres_px[None], axis=-1)
    hit = distances_px.min(axis=1) < 12
    assert hit.sum() >= len(MOUTHS_PX) - 1
    # the plate has some 60 holes behind its face
    assert len(holes) <= 75


def test_findings_at_many_thresholds_are_those_of_each(detector: LocalDetector) -> None:
    """Among noise, where peaks join and part by the threshold."""
    cloud = with_gaps(seen(disc(120, 100, 6.0, 2.0 * NOISE_M)), seed=3)
    evidence = detector.analyse(cloud)
    thresholds = [0.8, 1.1, 1.6, 2.2, 3.1, 4.4]
    for together, threshold in zip(
        detector.findings(cloud, evidence, thresholds),
        thresholds,
        strict=True,
    ):
        alone = detector.find(cloud, evidence, threshold)
        assert len(together.detections) == len(alone)
        for detection, expected in zip(together.detections, alone, strict=True):
            assert detection.score == expected.score
            np.testing.assert_array_equal(detection.pixels, expected.pixels)
            np.testing.assert_allclose(
                detection.centre_m,
                expected.centre_m,
                atol=1e-12,
            )


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("share", "expected"),
    [
        (1.0, 20.0),
        # half of the wide departure confirms it, a quarter does not; between, it counts in part
        (0.50, 20.0),
        (0.49, 20.0 * 0.96),
        (0.40, 20.0 * 0.6),
        (0.30, 20.0 * 0.2),
        # then the narrow one's own score is left
        (0.24, (2.0 * 0.24 - 0.6) / 0.4),
    ],
)
def test_a_wide_mean_counts_as_far_as_narrower_ones_confirm_it(sign, share, expected) -> None:
    """The wide mean departs by 2, 20 deviations; the narrow one, of deviation 0.4, by a share of
    that less 1.5 deviations, which are allowed for."""
    around = np.full((2, 1), 0.4)
    departures = sign * np.array([[2.0 * share - 1.5 * 0.4], [2.0]])
    deviations = np.array([[0.4], [0.1]])
    (result,) = _strongest(around + departures, around, deviations)
    assert result == pytest.approx(sign * expected, rel=1e-4)


def test_the_narrowest_mean_needs_no_confirmation() -> None:
    means = np.array([[3.0, -3.0], [3.0, -3.0]])
    around = np.array([[1.0, -1.0], [2.9, -2.9]])
    deviations = np.full((2, 2), 0.25)
    np.testing.assert_allclose(_strongest(means, around, deviations), [8.0, -8.0], rtol=1e-6)


def rough_rim() -> tuple[np.ndarray, np.ndarray]:
    """Residuals (r, c) in metres of white noise that is twice as large on the three outermost
    pixels, and which pixels (r, c) these are."""
    noise_m = NOISE_M * np.random.default_rng(3).standard_normal((120, 160))
    is_rim = np.ones(noise_m.shape, bool)
    is_rim[3:-3, 3:-3] = False
    noise_m[is_rim] *= 2.0
    return noise_m, is_rim


def test_errors_of_a_rim_are_not_averaged_out() -> None:
    """Errors of an edge may be alike along it, so that the variance of a rim stays in every mean.
    Without it, this rim's highest score is 5.2, above all others."""
    noise_m, is_rim = rough_rim()
    weights = np.ones(noise_m.shape, np.float32)
    signed, _, _ = _scored(noise_m, weights, (0.0, 1e-10), reach_px=4.0)
    assert 1.0 < np.abs(signed[is_rim]).max() < 3.0
    assert 3.5 < np.abs(signed[~is_rim]).max() < 5.0


def test_what_rounding_leaves_of_a_rim_is_no_variance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Running sums may leave a mean of rims slightly below 0 where there is none."""
    noise_m, _ = rough_rim()
    weights = np.ones(noise_m.shape, np.float32)
    signed = []
    for left in (0.0, -1e-12):
        of_rims = np.full(noise_m.shape, left, np.float32)
        monkeypatch.setattr(local, "_rim_variances", lambda *args, of_rims=of_rims: of_rims)
        signed.append(_scored(noise_m, weights, (0.0, 1e-10), reach_px=4.0)[0])
    np.testing.assert_array_equal(signed[0], signed[1])


@pytest.mark.parametrize("width", [3, 7, 55])
def test_squared_tents_are_summed_as_their_definition_says(width: int) -> None:
    """Also where the tent is wider than the picture."""
    image = np.random.default_rng(width).random((40, 57))
    expected = local_reference.tent_squares(image, width)
    np.testing.assert_allclose(tent_squares(image, width), expected, rtol=1e-10)
