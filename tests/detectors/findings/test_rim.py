"""The variance of a target's rim, from errors that edges leave on smooth noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from detectors.findings import whitening
from detectors.findings.rim import (
    BLOCK_PX,
    UNKNOWN_REACH_PX,
    on_pixels,
    reach_of,
    rim_variances,
)
from detectors.pixels.masks import outline_depth_px
from harness.testing.synthetic_clouds import plane

SHAPE = (140, 180)
SIDE_PX = 7
REACH_PX = 4.0


def smooth(seed: int) -> np.ndarray:
    """Noise of deviation 1 that a square of pixels correlates twice."""
    white = np.random.default_rng(seed).standard_normal((SHAPE[0] + 20, SHAPE[1] + 20))
    noise = cv2.blur(cv2.blur(white, (SIDE_PX, SIDE_PX)), (SIDE_PX, SIDE_PX))[10:-10, 10:-10]
    return np.asarray(noise / noise.std(), np.float32)


NOISE = whitening.filters(
    np.mean(
        [
            whitening.noise_covariance(smooth(seed), np.ones(SHAPE, bool), whitening.grid_of(SHAPE))
            for seed in range(8)
        ],
        axis=0,
    ),
    SHAPE,
)
DEPTH_PX = outline_depth_px(np.ones(SHAPE, bool))


def edge_errors(seed: int, deviations: tuple[float, ...]) -> np.ndarray:
    """Errors with these deviations by distance from the outline, alike over 3 x 3 pixels."""
    blocks = np.random.default_rng(seed).standard_normal((SHAPE[0] // 3 + 1, SHAPE[1] // 3 + 1))
    block_noise = np.kron(blocks, np.ones((3, 3)))[: SHAPE[0], : SHAPE[1]]
    errors = np.zeros(SHAPE)
    for distance, deviation in enumerate(deviations, start=1):
        errors += np.where(distance == DEPTH_PX, deviation * block_noise, 0.0)
    return errors


def shown(values: np.ndarray, *, is_alone: bool = False) -> np.ndarray:
    """The variances that one picture shows."""
    return rim_variances(values, DEPTH_PX, NOISE, REACH_PX, is_alone=is_alone)


def mean_variances(deviations: tuple[float, ...]) -> np.ndarray:
    """The variances of eight pictures, averaged."""
    variances = []
    for seed in range(8):
        values = smooth(seed) + edge_errors(100 + seed, deviations)
        variances.append(shown(values))
    return np.mean(variances, axis=0)


def test_the_rim_of_stationary_noise_adds_little() -> None:
    variances = mean_variances(())
    assert variances.shape == (4,)
    assert (variances < [0.15, 0.1, 0.06, 0.03]).all()


def test_the_errors_of_an_edge_are_the_variance_of_means_along_it() -> None:
    """A mean over three pixels covers one block of three or parts of two: all of their variance
    remains, or 5 / 9, on average 19 / 27."""
    variances = mean_variances((1.5, 0.8))
    assert variances[0] == pytest.approx(1.5**2 * 19 / 27, rel=0.25)
    assert variances[1] == pytest.approx(0.8**2 * 19 / 27, rel=0.3)
    assert (variances[2:] < 0.06).all()


def test_a_single_picture_leaves_out_what_chance_explains() -> None:
    values = smooth(2) + edge_errors(102, (1.5, 0.8))
    several = shown(values)
    alone = shown(values, is_alone=True)
    # 640 and 632 pixels at the rim, 608 and 600 farther in
    assert (alone < several + 1e-9).all()
    assert alone[0] == pytest.approx(several[0], rel=0.35)
    assert alone[0] < 0.92 * several[0]


def test_damage_on_a_tenth_of_the_rim_does_not_count() -> None:
    values = smooth(3)
    clean = shown(values)
    damaged = values.copy()
    damaged[:8, 20:80] += 20.0
    pixels = shown(damaged)
    np.testing.assert_allclose(pixels, clean, atol=0.35)


def test_variances_do_not_grow_inwards() -> None:
    """Errors at the third pixel alone: the two outside have them too."""
    variances = shown(smooth(1) + edge_errors(5, (0.0, 0.0, 1.0)))
    assert (np.diff(variances) <= 0.0).all()
    assert variances[0] >= variances[2] > 0.3
    assert variances[3] < 0.1


def test_too_few_pixels_show_nothing() -> None:
    depth_px = outline_depth_px(np.ones((20, 21), bool))
    variances = rim_variances(np.ones((20, 21), np.float32), depth_px, NOISE, 8.0, is_alone=True)
    np.testing.assert_array_equal(variances, np.zeros(8))


def test_pixels_get_the_variance_of_their_distance() -> None:
    depth_px = np.array([[0.0, 1.0, 2.0, 2.5, 3.0, 7.0]])
    image = on_pixels(np.array([0.5, 0.2, 0.1]), depth_px)
    np.testing.assert_allclose(image, [[0.0, 0.5, 0.2, 0.1, 0.1, 0.0]])


def test_the_reach_is_the_cameras_or_that_of_its_noise() -> None:
    cloud = plane(seed=1, tilt=0.0)
    assert reach_of(cloud) == UNKNOWN_REACH_PX
    blurred = replace(cloud, noise_reach_px=5.0)
    assert reach_of(blurred) == 5.0
    assert reach_of(replace(blurred, edge_reach_px=9.0)) == 9.0
    assert BLOCK_PX == 3
