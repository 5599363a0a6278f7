"""Blur at the edges of a gauge, and the area of pixels, without frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from detectors.surfaces.expected import Triangles, normals_of
from harness.programs.camera.gauge_range import (
    _fitted,
    _start,
    averaged_ranges_m,
    blur_of,
    edge_blur,
    seen_ranges_m,
    triangles_of,
    variance_of,
)
from harness.stills.spheres import RangeImage, range_image
from tests.support.gauge_scene import LENS, exact_gauge, pose

DRAWS = 12
NOISE_M = 0.3e-3


def test_variance_and_deviation_of_a_sampled_gaussian():
    """Samples of a wide Gaussian have its variance; those of a narrow one hardly any."""
    assert variance_of(1.5) == pytest.approx(2.25, rel=1e-3)
    assert variance_of(0.3) == pytest.approx(2 * np.exp(-0.5 / 0.09), rel=0.01)
    assert variance_of(0.0) == 0
    for blur_px in (0.3, 0.6, 2.0):
        assert blur_of(variance_of(blur_px)) == pytest.approx(blur_px, abs=1e-6)
    assert blur_of(-0.1) == 0


def stairs() -> RangeImage:
    """Levels at 0.5 m that differ by up to 12 mm, with straight edges between pixels."""
    image = range_image(np.ones((80, 120, 3)), _slopes(80, 120))
    heights_m = np.random.default_rng(4).uniform(0, 12e-3, (8, 12))
    z_m = 0.5 + np.kron(heights_m, np.ones((10, 10)))
    return replace(image, range_m=z_m / image.rays[..., 2])


def _slopes(rows: int, columns: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(columns) - columns / 2, np.arange(rows) - rows / 2)
    return np.stack([x, y], axis=-1) / 500


@pytest.mark.parametrize("blur_px", [0.0, 0.3, 0.6, 1.0])
def test_blur_is_found_without_bias_and_held_by_its_intervals(blur_px: float):
    sharp = stairs()
    inverse = 1 / sharp.range_m
    if blur_px:
        inverse = ndimage.gaussian_filter(inverse, blur_px)
    exact = edge_blur(replace(sharp, range_m=1 / inverse), sharp.range_m, displaced_px=0.0)
    assert exact is not None
    assert variance_of(exact.blur_px) == pytest.approx(variance_of(blur_px), abs=3e-3)
    found = []
    covered = 0
    for seed in range(DRAWS):
        noise_m = NOISE_M * np.random.default_rng(seed).standard_normal(inverse.shape)
        noisy = replace(sharp, range_m=1 / inverse + noise_m)
        blur = edge_blur(noisy, sharp.range_m, displaced_px=0.0)
        assert blur is not None
        found.append(variance_of(blur.blur_px))
        covered += blur.interval.low <= blur_px <= blur.interval.high
        wide = variance_of(blur.interval.high) - variance_of(blur.blur_px)
        assert wide < 0.1 + 0.1 * blur_px
    assert covered >= DRAWS - 2
    if blur_px >= 0.6:
        assert np.mean(found) == pytest.approx(variance_of(blur_px), abs=0.01)


def test_edges_in_wrong_places_may_look_blurred():
    """The square of the displacement is an error of the variance."""
    sharp = stairs()
    noise_m = NOISE_M * np.random.default_rng(0).standard_normal(sharp.range_m.shape)
    noisy = replace(sharp, range_m=sharp.range_m + noise_m)
    ends = []
    for displaced_px in (0.0, 0.5):
        blur = edge_blur(noisy, sharp.range_m, displaced_px)
        assert blur is not None
        ends.append(variance_of(blur.interval.high))
    # of eleven degrees of freedom
    assert ends[1] - ends[0] == pytest.approx(2.2 * 0.25, rel=0.1)


def test_a_pixel_shows_the_mean_of_its_area():
    """A plate whose rim crosses a column of pixels at a quarter of them, before another."""
    corners_m = []
    for z_m, right_m in ((0.500, 0.0), (0.510, 0.1)):
        low = (-0.1, -0.1, z_m)
        far = (right_m, 0.1, z_m)
        corners_m += [
            [low, (right_m, -0.1, z_m), far],
            [low, far, (-0.1, 0.1, z_m)],
        ]
    corners = np.array(corners_m)
    triangles = Triangles(corners, normals_of(corners), np.zeros(corners.shape[:2]))
    # the rim lies at x = 0; a quarter of the pixels of column 10 is to the left of it
    slopes = _slopes(20, 20) + np.array([0.25 / 500, 0.0])
    rays = range_image(np.ones((20, 20, 3)), slopes).rays
    sharp_m = seen_ranges_m(triangles, rays, np.eye(4))
    seen_m = averaged_ranges_m(triangles, rays, np.eye(4), sharp_m) * rays[..., 2]
    assert seen_m[5:15, 9] == pytest.approx(0.500, abs=2e-5)
    assert seen_m[5:15, 10] == pytest.approx(0.510 - 0.25 * 0.010, abs=2e-4)
    assert seen_m[5:15, 11] == pytest.approx(0.510, abs=2e-5)


def test_scale_and_bias_of_a_noisy_image_with_the_gauges_own_uncertainty() -> None:
    """Ranges are 1 % too long and 2 mm too far. An uncertainty of the gauge's scale of 0.2 % adds
    to the error of the range's scale, which it multiplies."""
    exact = exact_gauge()
    rays = range_image(np.ones((LENS.height, LENS.width, 3)), LENS.region_slopes(LENS.whole))
    true_m = seen_ranges_m(triangles_of(exact), rays.rays, pose())
    noise_m = NOISE_M * np.random.default_rng(1).standard_normal(true_m.shape)
    image = replace(rays, range_m=1.01 * true_m + 2e-3 + noise_m)
    fits = []
    for scale in (0.0, 2e-3):
        uncertainty = exact.uncertainty.model_copy(update={"scale": scale})
        gauge = exact.model_copy(update={"uncertainty": uncertainty})
        fits.append(_fitted(image, gauge, _start(pose())))
    sharp, rough = fits
    assert abs(sharp.scale - 1.01) < 3 * sharp.sigmas[0] < 1e-3
    assert abs(sharp.bias_m - 2e-3) < 3 * sharp.sigmas[1] < 1e-3
    added = np.sqrt(rough.sigmas[0] ** 2 - sharp.sigmas[0] ** 2)
    assert added == pytest.approx(1.01 * 2e-3, rel=1e-3)
    assert rough.sigmas[1] == pytest.approx(sharp.sigmas[1])
    assert rough.scale == pytest.approx(sharp.scale)
