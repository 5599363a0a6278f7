"""The built-in filters against plain transcriptions of their vendor's arithmetic, and against
OpenCV's or SciPy's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.ndimage import median_filter

from detectors.filters import load_filter
from detectors.filters.interface import in_metres, in_units

UNIT_M = 0.001


def depth_units(seed: int = 1, shape: tuple[int, int] = (13, 17)) -> np.ndarray:
    """A step of 30 units with noise, and missing pixels alone and together."""
    rng = np.random.default_rng(seed)
    units = 700 + 30 * (np.arange(shape[1]) > 8) + rng.integers(-12, 13, shape)
    units[rng.random(shape) < 0.12] = 0
    units[3:7, 4:7] = 0
    return units.astype(np.int64)


def through(name: str, units: np.ndarray, **settings: Any) -> np.ndarray:
    """A single frame through a filter, in units."""
    function = load_filter(name, settings).started(UNIT_M, whole=True)
    z_m = function(in_metres(units.astype(np.float32), UNIT_M))
    return in_units(z_m, UNIT_M, whole=True).astype(int)


def rounded_mean(new: int, old: int, alpha: float) -> int:
    """The vendor's mean of whole numbers: C cuts after adding one half."""
    return int(np.float32(new) * np.float32(alpha) + np.float32(old) * np.float32(1 - alpha) + 0.5)


def plain_spatial(
    units: np.ndarray, passes: int, alpha: float, delta: int, radius: int
) -> np.ndarray:
    """librealsense's spatial filter on whole numbers, pixel by pixel."""
    image = units.copy()
    height, width = image.shape
    for _ in range(passes):
        for row in image:
            for order in (range(1, width - 1), range(width - 2, -1, -1)):
                before = -1 if order.step > 0 else 1
                gap = 0
                for u in order:
                    old = row[u + before]
                    if not old:
                        continue
                    if row[u]:
                        gap = 0
                        if abs(row[u] - old) <= delta:
                            row[u] = rounded_mean(row[u], old, alpha)
                    elif radius:
                        gap += 1
                        if gap < radius:
                            row[u] = old
        for order in (range(1, height), range(height - 2, -1, -1)):
            before = -1 if order.step > 0 else 1
            for v in order:
                for u in range(width):
                    old = image[v + before, u]
                    if image[v, u] and old and abs(image[v, u] - old) < delta:
                        image[v, u] = rounded_mean(image[v, u], old, alpha)
    return image


@pytest.mark.parametrize(
    ("passes", "alpha", "delta", "mode", "radius"),
    [
        (1, 0.5, 20, 0, 0),
        (2, 0.5, 20, 0, 0),
        (2, 0.3, 7, 1, 2),
        (1, 0.6, 50, 3, 8),
        (1, 1.0, 5, 5, 255),
    ],
)
def test_spatial_is_the_vendors(passes: int, alpha: float, delta: int, mode: int, radius: int):
    units = depth_units()
    filtered = through(
        "spatial",
        units,
        filter_magnitude=passes,
        filter_smooth_alpha=alpha,
        filter_smooth_delta=delta,
        holes_fill=mode,
    )
    assert np.array_equal(filtered, plain_spatial(units, passes, alpha, delta, radius))


def test_spatial_keeps_an_edge_and_smooths_beside_it():
    units = depth_units()
    filtered = through("spatial", units, filter_smooth_delta=10, filter_magnitude=5)
    left = filtered[:, :8][filtered[:, :8] > 0]
    right = filtered[:, 10:][filtered[:, 10:] > 0]
    assert left.std() < 0.7 * units[:, :8][units[:, :8] > 0].std()
    assert right.mean() - left.mean() == pytest.approx(30, abs=3)


CREDIBLE = {1: (8, 8), 2: (2, 3), 3: (2, 4), 4: (2, 8), 5: (1, 2), 6: (1, 5), 7: (1, 8)}
"""The vendor's words for ``holes_fill``: valid in so many of the last so many frames."""


def plain_temporal(
    frames: list[np.ndarray], alpha: float, delta: int, mode: int
) -> list[np.ndarray]:
    """librealsense's temporal filter on whole numbers, pixel by pixel, with lists of the past."""
    shape = frames[0].shape
    last = np.zeros(shape, int)
    past: dict[tuple[int, ...], list[bool]] = {pixel: [] for pixel in np.ndindex(shape)}
    filtered = []
    for frame in frames:
        result = frame.copy()
        for pixel, agreed in past.items():
            value = int(frame[pixel])
            old = int(last[pixel])
            if value and old and abs(value - old) < delta:
                mean = np.float32(alpha) * np.float32(value)
                mean += np.float32(1 - alpha) * np.float32(old)
                result[pixel] = last[pixel] = int(mean)
                agreed.append(True)
            elif value:
                last[pixel] = value
                agreed[:] = [True]
            else:
                needed, of_last = CREDIBLE.get(mode, (0, 1))
                is_credible = mode > 0 and sum(agreed[-of_last:]) >= needed
                if old and is_credible:
                    result[pixel] = old
                agreed.append(False)
        filtered.append(result)
    return filtered


@pytest.mark.parametrize("mode", range(9))
def test_temporal_is_the_vendors(mode: int):
    frames = [depth_units(seed, (6, 7)) for seed in range(30)]
    for number, frame in enumerate(frames):
        frame[2, :3] = 0 if number % 14 > 3 else frame[2, :3]  # long gaps
    function = load_filter("temporal", {"holes_fill": mode, "filter_smooth_delta": 15}).started(
        UNIT_M, whole=True
    )
    for frame, expected in zip(frames, plain_temporal(frames, 0.4, 15, mode), strict=True):
        z_m = function(in_metres(frame.astype(np.float32), UNIT_M))
        assert np.array_equal(in_units(z_m, UNIT_M, whole=True), expected)


def test_temporal_cuts_whole_units_and_so_reads_too_near():
    function = load_filter("temporal", {}).started(UNIT_M, whole=True)
    rng = np.random.default_rng(1)
    for _ in range(100):
        z_m = function(np.round(700 + rng.normal(0, 2, (40, 40))).astype(np.float32) * UNIT_M)
    assert -0.002 < z_m.mean() - 0.7 < -0.0007
    function = load_filter("temporal", {}).started(UNIT_M, whole=False)
    for _ in range(100):
        z_m = function((700 + rng.normal(0, 2, (40, 40))).astype(np.float32) * UNIT_M)
    assert abs(z_m.mean() - 0.7) < 0.0001


@pytest.mark.parametrize("side", [3, 5])
def test_median_is_that_of_scipy_with_missing_pixels_as_zeros(side: int):
    units = depth_units()
    filtered = through("median", units, kernel_size=side)
    assert np.array_equal(filtered, median_filter(units, side, mode="nearest"))
    assert (filtered[3:7, 4:7] == 0).any()


def plain_filling(units: np.ndarray, mode: int) -> np.ndarray:
    """librealsense's hole filling on whole numbers, pixel by pixel."""
    image = units.copy()
    height, width = image.shape
    for v in range(height) if mode == 0 else range(1, height - 1):
        for u in range(1, width):
            if image[v, u]:
                continue
            above = image[v - 1, u] if v else 0
            around = [image[v - 1, u - 1], image[v, u - 1], image[(v + 1) % height, u - 1]]
            around.append(image[(v + 1) % height, u])
            if mode == 0:
                image[v, u] = image[v, u - 1]
            elif mode == 1:
                image[v, u] = max(above, *around)
            elif above:
                image[v, u] = min(above, *(value for value in around if value))
    return image


@pytest.mark.parametrize("mode", [0, 1, 2])
def test_hole_filling_is_the_vendors(mode: int):
    units = depth_units()
    filtered = through("hole_filling", units, holes_fill=mode)
    assert np.array_equal(filtered, plain_filling(units, mode))
    assert np.array_equal(filtered[units > 0], units[units > 0])
    assert (filtered[4:6, 5:7] > 0).any()
