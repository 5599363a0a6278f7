"""Spheres in range images: where they are, how large, and how certain that is."""

from __future__ import annotations

import numpy as np
import pytest

from harness.stills.spheres import (
    FEWEST_PX,
    NoFit,
    RangeImage,
    SphereFit,
    correlated_pixels,
    disc,
    farthest_m,
    find_spheres,
    fit_sphere,
)
from harness.vocabulary.geometry import Lens
from tests.support.spheres import LENS, sphere_scene

RADIUS_M = 0.0725
CENTRES_M = np.array([[-0.2, 0.05, 1.0], [0.25, -0.1, 1.2]])
DRAWS = 40


def test_spheres_without_noise_are_found_exactly():
    fits = find_spheres(sphere_scene(CENTRES_M, RADIUS_M), RADIUS_M)
    assert len(fits) == 2
    for fit, centre_m in zip(fits, CENTRES_M, strict=True):
        assert fit.centre_m == pytest.approx(centre_m, abs=1e-6)
        assert fit.radius_m == pytest.approx(RADIUS_M, abs=1e-6)
        assert fit.seen_share == 1


@pytest.mark.parametrize(("missing", "blur_px"), [(0.0, 0.0), (0.5, 0.0), (0.0, 0.8)])
def test_centre_and_diameter_are_unbiased_and_as_certain_as_they_say(missing, blur_px):
    """Over draws, the mean error is 0 within three standard errors, and errors scatter as stated,
    with half of the pixels lost, and with the noise of neighbours correlated."""
    centre_errors = []
    size_errors = []
    for seed in range(DRAWS):
        image = sphere_scene(CENTRES_M, RADIUS_M, 3e-3, missing, seed, blur_px)
        fit = fit_sphere(image, CENTRES_M[0] + 0.02, RADIUS_M)
        assert isinstance(fit, SphereFit)
        sigmas_m = np.sqrt(np.diag(fit.covariance_m2))
        centre_errors.append((fit.centre_m - CENTRES_M[0]) / sigmas_m)
        size_errors.append(fit.size_error_m / 2 / fit.radius_sigma_m)
    errors = np.column_stack([centre_errors, size_errors])
    assert (np.abs(errors.mean(axis=0)) < 3 / np.sqrt(DRAWS)).all()
    scatter = errors.std(axis=0)
    assert (scatter > 0.7).all()
    assert (scatter < 1.35).all()


def test_half_of_the_pixels_and_much_noise_leave_the_spheres():
    image = sphere_scene(CENTRES_M, RADIUS_M, 8e-3, 0.5, seed=3)
    fits = find_spheres(image, RADIUS_M)
    assert len(fits) == 2
    for fit, centre_m in zip(fits, CENTRES_M, strict=True):
        assert np.linalg.norm(fit.centre_m - centre_m) < 5e-3
        assert 0.4 < fit.seen_share < 0.6


FAR = Lens(width=120, height=90, fx=500.0, fy=500.0, cx=59.5, cy=44.5)


def test_a_far_sphere_in_the_sun_is_measured_with_a_wide_interval():
    """145 mm at 3.5 m, noise of 10 mm, half of the pixels lost: 36 of 40 are found and 34 of 36
    intervals hold; here, eight."""
    centre_m = np.array([[0.05, 0.02, 3.5]])
    covered = 0
    fitted_count = 0
    for seed in range(8):
        image = sphere_scene(centre_m, RADIUS_M, 10e-3, 0.5, seed, lens=FAR, wall_m=5.0)
        for fit in find_spheres(image, RADIUS_M):
            fitted_count += 1
            ends = fit.size_interval_m
            assert 0.02 < ends.high - ends.low < 0.09
            covered += ends.low < 0 < ends.high
            # ranges show curvature
            inverse = [1 / (2 * RADIUS_M + end_m) for end_m in (ends.low, ends.high)]
            assert np.mean(inverse) == pytest.approx(1 / (2 * fit.radius_m))
    assert fitted_count >= 6
    assert covered >= fitted_count - 1


def test_half_a_sphere_on_a_wall_needs_more_evidence_than_one_alone():
    """What stands alone is searched for at few places of an image."""
    centre_m = np.array([[0.05, 0.02, 3.5]])
    fitted = []
    for wall_m in (3.5, 5.0):
        fits = []
        for seed in range(16):
            image = sphere_scene(centre_m, RADIUS_M, 12e-3, 0.5, seed, lens=FAR, wall_m=wall_m)
            fits.append(fit_sphere(image, centre_m[0], RADIUS_M))
        fitted.append(sum(isinstance(fit, SphereFit) for fit in fits))
    assert fitted[0] <= 5
    assert fitted[1] >= 10


def test_a_round_plate_that_stands_alone_is_no_sphere():
    plate_m = sphere_scene(CENTRES_M[:0], RADIUS_M, lens=FAR, wall_m=5.0)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        normal = np.array([*rng.uniform(-0.6, 0.6, 2), -1.0])
        centre_m = np.array([0.05, 0.02, 3.5])
        met_m = (normal @ centre_m) / (plate_m.rays @ normal)
        away_m = np.linalg.norm(plate_m.rays * met_m[..., None] - centre_m, axis=-1)
        range_m = np.where(away_m < RADIUS_M, met_m, plate_m.range_m)
        range_m += 10e-3 * rng.standard_normal(range_m.shape)
        range_m[rng.random(range_m.shape) < 0.5] = np.nan
        assert find_spheres(RangeImage(range_m, plate_m.rays), RADIUS_M) == []


@pytest.mark.parametrize("sigma_m", [1e-3, 20e-3])
def test_nothing_is_a_sphere_that_is_none(sigma_m: float):
    """Neither wall, floor and their corner, nor a sphere of another size, nor noise."""
    assert find_spheres(sphere_scene(CENTRES_M[:0], RADIUS_M, sigma_m), RADIUS_M) == []
    image = sphere_scene(CENTRES_M, 2.5 * RADIUS_M, sigma_m / 10)
    assert find_spheres(image, RADIUS_M) == []


def test_too_few_pixels_give_no_number():
    image = sphere_scene(CENTRES_M, RADIUS_M, 1e-3)
    on_sphere = disc(image, CENTRES_M[0], RADIUS_M)
    sparse = image.range_m.copy()
    sparse.ravel()[on_sphere[FEWEST_PX - 1 :]] = np.nan
    fit = fit_sphere(RangeImage(sparse, image.rays), CENTRES_M[0], RADIUS_M)
    assert isinstance(fit, NoFit)
    assert fit.why == "39 pixels with a range, 40 needed"
    half = image.range_m.copy()
    half.ravel()[on_sphere[on_sphere % LENS.width > 57]] = np.nan
    fit = fit_sphere(RangeImage(half, image.rays), CENTRES_M[0], RADIUS_M)
    assert isinstance(fit, NoFit)
    assert fit.why == "its pixels lie on one side of it"


def test_the_farthest_distance_is_that_of_the_fewest_pixels():
    image = sphere_scene(CENTRES_M[:0], RADIUS_M)
    limit_m = farthest_m(image.pitch_rad, RADIUS_M)
    counts = [len(disc(image, np.array([0, 0, limit_m * far]), RADIUS_M)) for far in (0.9, 1.1)]
    assert counts[0] > FEWEST_PX > counts[1]


def test_form_errors_are_the_shells_that_hold_the_points():
    image = sphere_scene(CENTRES_M, RADIUS_M, 1e-3, seed=1)
    fit = fit_sphere(image, CENTRES_M[0], RADIUS_M)
    assert isinstance(fit, SphereFit)
    assert fit.form_error_m(0.95) < fit.form_error_m(0.997)
    assert fit.form_error_m(0.95) == pytest.approx(2 * 1.96 * fit.radial_m.std(), rel=0.1)


def test_figures_of_a_sphere_by_hand():
    fit = SphereFit(
        stated_m=0.050,
        centre_m=np.array([0.0, 0.0, 1.0]),
        covariance_m2=np.eye(3),
        radius_m=0.052,
        radius_sigma_m=1e-3,
        pixels=np.arange(4),
        residual_m=np.array([1e-3, -1e-3, 3e-3, 1e-3]),
        radial_m=np.array([-2e-3, -1e-3, 0.0, 1e-3, 4e-3]),
        expected_px=16,
    )
    assert fit.seen_share == 0.25
    assert fit.scatter_m == pytest.approx(np.sqrt(3.0) * 1e-3)
    assert fit.size_error_m == pytest.approx(4e-3)
    assert fit.form_error_m(1.0) == pytest.approx(6e-3)
    assert fit.form_error_m(0.5) == pytest.approx(2e-3)


@pytest.mark.parametrize(("size", "count"), [(1.0, 2), (1.05, 2), (1.3, 0)])
def test_a_sphere_of_about_the_stated_size_is_found_and_its_error_is_stated(size, count):
    """Its interval is far narrower than the error, which is no reason to leave it out."""
    fits = find_spheres(sphere_scene(CENTRES_M, size * RADIUS_M, 2e-4), RADIUS_M)
    assert len(fits) == count
    for fit in fits:
        assert fit.size_error_m == pytest.approx(2 * (size - 1) * RADIUS_M, abs=8e-4)


def test_correlated_neighbours_share_an_error():
    rng = np.random.default_rng(0)
    pixels = np.arange(60 * 60)
    shared = []
    for _ in range(10):
        white = rng.standard_normal((60, 60))
        pairs = np.repeat(np.repeat(white[::2, ::2], 2, axis=0), 2, axis=1)
        of_white = correlated_pixels((60, 60), pixels, white.ravel())
        shared.append((of_white, correlated_pixels((60, 60), pixels, pairs.ravel())))
    assert np.mean(shared, axis=0) == pytest.approx([1, 4], rel=0.25)
