"""The thesis' detector: its two variants, thresholds, the rounding floor, and the registry of
detectors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detectors import detector_names, detector_type, load_detector
from detectors.interface import Detector, Evidence
from detectors.methods.thesis import ThesisConfig, ThesisDetector
from detectors.pixels.noise import rounding_floor
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud, Lens, Region

SHAPE = (120, 160)
LENS = Lens(SHAPE[1], SHAPE[0], 240.0, 240.0, 79.5, 59.5)


def board(
    holes: tuple[tuple[float, float, float], ...] = (),
    *,
    noise_m: float = 3e-4,
    seed: int = 0,
    tilt: float = 0.2,
    variance_m2: float = np.nan,
    n_frames: int = 1,
    z_step_m: float = 0.0,
) -> Cloud:
    """A tilted board with holes (u, v, radius in px), 12.7 mm deep."""
    slopes = LENS.region_slopes(LENS.whole)
    z = 0.7 / (1 - tilt * slopes[..., 0])
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    for cu, cv, radius in holes:
        z[(u - cu) ** 2 + (v - cv) ** 2 < radius**2] += 0.0127
    z = z + noise_m * np.random.default_rng(seed).standard_normal(SHAPE)
    if z_step_m:
        z = np.round(z / z_step_m) * z_step_m
    points = np.concatenate([slopes * z[..., None], z[..., None]], axis=-1)
    flat = np.zeros(SHAPE, dtype=np.uint8)
    variance = np.full(SHAPE, variance_m2)
    return Cloud(
        points,
        flat,
        flat + n_frames,
        variance,
        Region(0, SHAPE[0], 0, SHAPE[1]),
        z_step_m,
        n_frames,
        lens=LENS,
    )


HOLES = ((30.0, 40.0, 4.5), (80.0, 60.0, 3.2), (120.0, 90.0, 2.2))


def test_holes_are_found_strongest_first_and_nothing_else() -> None:
    detector: Detector = load_detector("thesis", {})
    cloud = board(HOLES)
    evidence = detector.analyse(cloud)
    detections = detector.find(cloud, evidence, 6.0)
    assert len(detections) == 3
    assert [d.score for d in detections] == sorted((d.score for d in detections), reverse=True)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    expected = {tuple(np.flatnonzero((u - a) ** 2 + (v - b) ** 2 < r**2)) for a, b, r in HOLES}
    assert {tuple(d.pixels) for d in detections} == expected
    measured = [detector.measure(cloud, evidence, d) for d in detections]
    assert {(round(m.u_px), round(m.v_px)) for m in measured} == {(30, 40), (80, 60), (120, 90)}


def test_the_score_is_the_residual_in_robust_standard_deviations() -> None:
    cloud = board(HOLES)
    evidence = ThesisDetector(ThesisConfig()).analyse(cloud)
    assert evidence.scale_m == pytest.approx(3e-4, rel=0.03)
    assert evidence.scale_m == pytest.approx(np.median(np.abs(evidence.residual_m)) / 0.6745)
    np.testing.assert_allclose(evidence.score, np.abs(evidence.residual_m) / evidence.scale_m)
    np.testing.assert_allclose(
        evidence.surface_z_m + evidence.residual_m,
        cloud.points_m[..., 2],
        atol=1e-12,
    )
    assert evidence.residual_m[40, 30] == pytest.approx(0.0127, abs=1.5e-3)


def test_pixels_outside_the_crop_or_without_range_have_no_score() -> None:
    cloud = board(HOLES)
    cloud.points_m[5, 5] = np.nan
    settings = {
        "crop": {"kind": "polygon", "vertices_px": [[-1, -1], [99.5, -1], [99.5, 200], [-1, 200]]}
    }
    evidence = load_detector("thesis", settings).analyse(cloud)
    assert np.isnan(evidence.score[5, 5])
    assert np.isnan(evidence.score[:, 100:]).all()
    assert np.isfinite(evidence.score[:, :100]).sum() == 100 * SHAPE[0] - 1


def test_the_script_is_least_squares_without_cross_terms_and_the_std_of_raw_z() -> None:
    cloud = board(HOLES)
    surface = {"method": "least_squares", "drop_cross_terms": True}
    detector = ThesisDetector(ThesisConfig.from_data({"surface": surface, "scale": "raw_z_std"}))
    x, y, z = cloud.points_m.reshape(-1, 3).T
    a = np.stack([np.ones_like(x), x, y, x**2, y**2, x**3, y**3], axis=1)
    residual = z - a @ np.linalg.lstsq(a, z, rcond=None)[0]
    evidence = detector.analyse(cloud)
    np.testing.assert_allclose(evidence.residual_m.ravel(), residual, atol=1e-10)
    assert evidence.scale_m == pytest.approx(np.std(z, ddof=1), rel=1e-12)
    assert detector.default_threshold is None
    above = np.flatnonzero(np.abs(residual) > 0.2 * np.std(z, ddof=1))
    pixels = np.concatenate([d.pixels for d in detector.find(cloud, evidence, 0.2)])
    np.testing.assert_array_equal(np.sort(pixels), above)


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 1000),
    min_points=st.sampled_from([1, 2, 4]),
    distance_mm=st.sampled_from([4.0, 10.0]),
)
def test_the_quiet_threshold_is_the_lowest_that_finds_nothing(
    seed: int,
    min_points: int,
    distance_mm: float,
) -> None:
    config = {
        "min_points": min_points,
        "cluster_distance_mm": distance_mm,
        "surface": {"method": "least_squares"},
    }
    detector = load_detector("thesis", config)
    cloud = board(seed=seed)
    evidence = detector.analyse(cloud)
    quiet = detector.quiet_threshold(cloud, evidence)
    assert detector.find(cloud, evidence, quiet) == ()
    detections = detector.find(cloud, evidence, np.nextafter(quiet, 0.0))
    assert len(detections) >= 1
    assert detections[0].score == quiet
    if min_points == 1:
        assert quiet == np.nanmax(evidence.score)


def test_a_detections_score_is_the_threshold_at_which_it_vanishes() -> None:
    detector = load_detector("thesis", {"min_points": 3})
    cloud = board(HOLES)
    evidence = detector.analyse(cloud)
    detections = detector.find(cloud, evidence, 6.0)
    assert len(detections) == len(HOLES)
    for detection in detections:
        pixels = set(detection.pixels)
        just_below = np.nextafter(detection.score, 0.0)
        kept = detector.find(cloud, evidence, just_below)
        above = detector.find(cloud, evidence, detection.score)
        assert any(pixels & set(other.pixels) for other in kept)
        assert not any(pixels & set(other.pixels) for other in above)


def test_nothing_can_be_found_among_too_few_points() -> None:
    detector = load_detector("thesis", {"min_points": 4})
    nothing = np.full(SHAPE, np.nan)
    nothing[3, 3:6] = 9.0
    cloud = board()
    evidence = Evidence(nothing, nothing, nothing, 1.0)
    assert detector.quiet_threshold(cloud, evidence) == 0.0
    assert detector.find(cloud, evidence, 0.0) == ()


def test_a_frontal_noise_free_rounded_board_keeps_the_rounding_as_scale() -> None:
    cloud = board(noise_m=0.0, tilt=0.0, z_step_m=1e-3, n_frames=50, variance_m2=0.0)
    detector = load_detector("thesis", {})
    evidence = detector.analyse(cloud)
    assert evidence.notes["spread_m"] < 1e-8
    assert evidence.scale_m == pytest.approx(1e-3 / np.sqrt(12))
    assert detector.quiet_threshold(cloud, evidence) < 1e-3


def test_without_rounding_a_perfect_board_still_has_a_scale() -> None:
    evidence = load_detector("thesis", {}).analyse(board(noise_m=0.0, tilt=0.0))
    assert 1e-9 < evidence.scale_m < 1e-6
    assert np.isfinite(evidence.score).all()


@pytest.mark.parametrize(
    ("noise_mm", "frames"),
    [
        (0.1, 20),
        (0.2, 50),
        (0.3, 50),
        (0.6, 2),
        (0.6, 50),
        (1.0, 10),
    ],
)
def test_the_floor_is_the_rounding_error_of_simulated_averages(
    noise_mm: float, frames: int
) -> None:
    """Rounded averages less unrounded averages of the same noise, over surfaces at all phases of
    the step."""
    random = np.random.default_rng(int(100 * noise_mm) + frames)
    true = np.linspace(700.0, 740.0, 20_000)
    samples = true + noise_mm * random.standard_normal((frames, true.size))
    rounded = np.round(samples)
    error = rounded.mean(axis=0) - samples.mean(axis=0)
    z = (rounded.mean(axis=0) * 1e-3)[None]
    variance = rounded.var(axis=0, ddof=1)[None] * 1e-6
    points = np.stack([0 * z, 0 * z, z], axis=-1)
    flat = np.zeros(z.shape, dtype=np.uint8)
    cloud = Cloud(
        points,
        flat,
        flat,
        variance,
        Region(0, 1, 0, z.size),
        1e-3,
        frames,
    )
    floor_mm = rounding_floor(cloud, cloud.valid) * 1e3
    # never above the whole rounding, never below what is there; tight once the noise dithers
    assert error.std() * 0.95 < floor_mm <= 1 / np.sqrt(12) + 1e-12
    if noise_mm >= 0.6:
        assert floor_mm == pytest.approx(error.std(), rel=0.1)


def test_a_median_keeps_the_whole_rounding() -> None:
    cloud = board(noise_m=6e-4, z_step_m=1e-3, n_frames=50, variance_m2=(6e-4) ** 2 + 1e-6 / 12)
    assert rounding_floor(cloud, cloud.valid) == pytest.approx(1e-3 / np.sqrt(12))


def test_an_unknown_name_and_wrong_settings_are_clear_mistakes() -> None:
    with pytest.raises(UserError, match="did you mean 'thesis'"):
        load_detector("thesys", {})
    with pytest.raises(UserError) as caught:
        load_detector("thesis", {"surface": {"degree": 99}, "scael": "mad"})
    assert "surface.degree" in str(caught.value)
    assert "scael" in str(caught.value)
    assert "thesis" in detector_names()
    assert detector_type("thesis") is ThesisDetector


def test_the_threshold_of_the_cloud_itself_is_its_largest_residual_towards_the_camera() -> None:
    detector = load_detector("thesis", {"scale": "highest_before"})
    assert isinstance(detector, ThesisDetector)
    assert detector.default_threshold == 1.0
    cloud = board(HOLES, seed=3)
    evidence = detector.analyse(cloud)
    assert evidence.scale_m == pytest.approx(-np.nanmin(evidence.residual_m))
    # Gaussian noise: the highest of 19,000 is about four deviations, and holes are 40 deep
    assert 3.5 * 3e-4 < evidence.scale_m < 5.5 * 3e-4
    detections = detector.find(cloud, evidence, 1.0)
    assert {len(detection.pixels) > 10 for detection in detections[:3]} == {True}
    assert len(detections) < 10
