"""Peaks of a lidar's samples and of its noise, against plain NumPy and Rice's law."""

from __future__ import annotations

import numpy as np
import pytest

from scenes.sensor.lidar.kernels import noise_peaks, stronger_peak

f4 = np.float32
SHAPE = (7, 9)


def test_the_higher_peak_wins_with_its_own_noise() -> None:
    """Written out in NumPy; in half of the pixels noise decides."""
    rng = np.random.default_rng(1)
    height = rng.uniform(5.0, 6.0, (2, *SHAPE)).astype(f4)
    half_m = rng.uniform(1.0, 2.0, (2, *SHAPE)).astype(f4)
    deviation_m = rng.uniform(0.01, 0.02, (2, *SHAPE)).astype(f4)
    noise = rng.uniform(0.5, 1.0, SHAPE).astype(f4)
    normals = rng.standard_normal((3, SHAPE[0] + 2, SHAPE[1])).astype(f4)
    sweep_m = rng.uniform(-0.1, 0.1, SHAPE[1]).astype(f4)
    won_m, won_height, won_deviation_m = np.zeros((3, *SHAPE), f4)
    stronger_peak(
        height, half_m, deviation_m, noise, normals, sweep_m, won_m, won_height, won_deviation_m
    )
    drawn = normals[:, : SHAPE[0]]
    noisy = height + noise * drawn[:2]
    second = noisy[1] > noisy[0]
    assert 0.3 < (second != (height[1] > height[0])).mean() + 0.2 < 0.8
    assert won_height == pytest.approx(noisy.max(axis=0), rel=1e-6)
    expected_m = np.where(second, deviation_m[1], deviation_m[0])
    assert won_deviation_m == pytest.approx(expected_m)
    half = np.where(second, half_m[1], half_m[0])
    assert won_m == pytest.approx(half + expected_m * drawn[2] + sweep_m, rel=1e-6)


def test_the_highest_maximum_of_noise_has_rices_law() -> None:
    """P(highest < x deviations) = exp(-rate exp(-x^2 / 2)): the uniform number is that chance."""
    rate = 300.0
    weak = np.array([3, 14, 20, 40])
    noise = np.linspace(1.0, 2.0, SHAPE[0] * SHAPE[1]).reshape(SHAPE).astype(f4)
    chance = np.array([0.3, 0.9, 1e-200, 0.6])
    uniforms = np.stack([chance, [0.25, 0.5, 0.75, 0.1]])
    won_m = np.full(SHAPE, 7.0, f4)
    won_height = np.zeros(SHAPE, f4)
    won_height.ravel()[40] = 50.0
    won_deviation_m = np.full(SHAPE, 9.0, f4)
    noise_peaks(weak, noise, 0.5, uniforms, rate, 0.2, 4.0, won_m, won_height, won_deviation_m)
    level = np.sqrt(2 * np.log(rate / -np.log(chance[:2])))
    assert won_height.ravel()[[3, 14]] == pytest.approx(level * 0.5 * noise.ravel()[[3, 14]])
    assert won_m.ravel()[[3, 14]] == pytest.approx([1.0, 2.0])
    assert won_deviation_m.ravel()[[3, 14]] == pytest.approx(0.2 / level)
    # so unlikely a silence is no maximum; a return of 50 is higher than any noise
    for pixel in (20, 40):
        assert won_m.ravel()[pixel] == 7.0
        assert won_deviation_m.ravel()[pixel] == 9.0
    untouched = np.ones(won_m.size, bool)
    untouched[[3, 14]] = False
    assert (won_m.ravel()[untouched] == 7.0).all()


def test_a_low_maximum_of_noise_has_the_bandwidth_of_one_deviation() -> None:
    """A level of half a deviation: chance exp(-rate exp(-1/8))."""
    rate = 10.0
    uniforms = np.array([[np.exp(-rate * np.exp(-0.125))], [0.5]])
    won_m, won_height, won_deviation_m = np.zeros((3, 1, 1), f4)
    noise = np.full((1, 1), 3.0, f4)
    noise_peaks(
        np.array([0]), noise, 1.0, uniforms, rate, 0.2, 4.0, won_m, won_height, won_deviation_m
    )
    assert won_height[0, 0] == pytest.approx(1.5)
    assert won_deviation_m[0, 0] == pytest.approx(0.2)
