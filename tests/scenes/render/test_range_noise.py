"""Range from phases of several frequencies: its change and its noise, against the formula."""

from __future__ import annotations

import numpy as np
import pytest

from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR
from scenes.render.range_noise import noise_lines, range_change_m, range_noise_m, range_weights

FREQUENCIES_HZ = (20e6, 60e6, 100e6)


def phasors_at(range_m: np.ndarray) -> np.ndarray:
    """Return phasors (f, n) of light that comes back from a range."""
    frequency = np.array(FREQUENCIES_HZ)[:, None]
    return 0.7 * np.exp(4j * np.pi * frequency * range_m / SPEED_OF_LIGHT_AIR)


def test_a_change_of_range_is_found_again_from_the_change_of_phasors() -> None:
    range_m = np.array([0.5, 0.9])
    before = phasors_at(range_m)
    change = phasors_at(range_m + 1e-6) - before
    assert range_change_m(change, before, FREQUENCIES_HZ) == pytest.approx([1e-6] * 2, rel=1e-3)
    # light in phase changes no range, and no light has none
    assert range_change_m(0.1 * before, before, FREQUENCIES_HZ) == pytest.approx([0.0] * 2)
    assert range_change_m(change, np.zeros_like(before), FREQUENCIES_HZ).tolist() == [0.0, 0.0]


def test_weights_are_those_of_least_squares() -> None:
    """Phases 4 pi f r / c of one range: weights times these are r, and grow with frequency."""
    weights = range_weights(FREQUENCIES_HZ)
    phase_of_a_metre = 4 * np.pi * np.array(FREQUENCIES_HZ) / SPEED_OF_LIGHT_AIR
    assert weights @ phase_of_a_metre == pytest.approx(1.0)
    assert weights / weights[0] == pytest.approx([1.0, 3.0, 5.0])


@pytest.mark.parametrize(
    ("count", "lines"),
    [
        (1, [0]),
        (3, [0, 1, 2]),
        (4, [0, 1, 2, 3]),
        (5, [0, 1, 3, 4]),
        (32, [0, 10, 21, 31]),
    ],
)
def test_noise_is_estimated_at_four_lines_or_all(
    count: int,
    lines: list[int],
) -> None:
    assert noise_lines(tuple(1e6 * (k + 1) for k in range(count))) == lines


def test_noise_is_the_standard_error_of_the_batches() -> None:
    range_m = np.array([0.5, 0.9])
    total = phasors_at(range_m)
    shifts_m = np.array([[1.0, 5.0], [2.0, 1.0], [4.0, 3.0], [5.0, -5.0]]) * 1e-7
    batches = np.stack([phasors_at(range_m + shift_m) for shift_m in shifts_m])
    expected_m = shifts_m.std(axis=0, ddof=1) / 2
    assert range_noise_m(batches, total, FREQUENCIES_HZ) == pytest.approx(expected_m, rel=1e-3)


def test_a_long_comb_is_judged_at_its_four_lines() -> None:
    frequencies_hz = tuple(10e6 * (k + 1) for k in range(10))
    lines = [0, 3, 6, 9]
    rng = np.random.default_rng(1)
    total = rng.random((10, 3)) + 1j
    batches = 1e-3 * (rng.random((8, 4, 3)) + 1j * rng.random((8, 4, 3)))
    chosen_hz = tuple(frequencies_hz[line] for line in lines)
    expected_m = range_noise_m(batches, total[lines], chosen_hz)
    assert range_noise_m(batches, total, frequencies_hz) == pytest.approx(expected_m)
