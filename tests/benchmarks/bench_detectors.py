"""Speed of averaging, fitting, clustering, measuring: ``pytest tests/benchmarks/bench_detectors.py --benchmark-only``.

Nothing here asserts a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from detectors import load_detector
from detectors.average import AverageConfig, FrameSums
from detectors.clusters import euclidean_clusters
from detectors.crop import AutoCrop, crop
from detectors.surface import SurfaceConfig, fit_surface
from harness.vocabulary.geometry import Cloud, Frame, Lens, Region

SHAPE = (150, 240)
"""36,000 pixels, about the board's part of a picture."""
LENS = Lens(SHAPE[1], SHAPE[0], 504.0, 504.0, 119.5, 74.5)


class _Frames:
    name, organised, lens, z_step_m = "bench", True, LENS, 1e-3
    region = LENS.whole
    slopes = LENS.region_slopes(LENS.whole)

    def frames(self) -> Iterator[Frame]:
        random = np.random.default_rng(0)
        for i in range(20):
            z = np.round(750 + random.standard_normal(SHAPE)) * 1e-3
            yield Frame(str(i), z.astype(np.float32), np.zeros(SHAPE, dtype=np.uint8))


def _board() -> Cloud:
    slopes = LENS.region_slopes(LENS.whole)
    z = 0.75 / (1 - 0.1 * slopes[..., 0])
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    part = np.zeros(SHAPE)
    for k, radius in enumerate((2.1, 2.7, 3.2, 3.7, 4.3, 5.3, 6.4, 8.5)):
        part[(u - 25 - 27 * k) ** 2 + (v - 75) ** 2 < radius**2] = 1.0
    z += 0.0127 * cv2.blur(part, (5, 5))
    z += 7.5e-4 * cv2.blur(np.random.default_rng(1).standard_normal(SHAPE), (5, 5))
    points = np.concatenate([slopes * z[..., None], z[..., None]], axis=-1)
    flat = np.zeros(SHAPE, dtype=np.uint8)
    return Cloud(points, flat, flat + 1, np.full(SHAPE, np.nan), Region(0, SHAPE[0], 0, SHAPE[1]), 0.0, 1, lens=LENS)


@pytest.mark.parametrize("method", ["mean", "clipped", "median"])
def test_add_a_frame_of_36_000_pixels(benchmark: Any, method: str) -> None:
    source = _Frames()
    frames = list(source.frames())
    config = AverageConfig.from_data({"method": method, "median_memory_mb": 4000.0})
    benchmark.pedantic(FrameSums(source, frames[:5], config).take, args=(frames[7],), rounds=500, iterations=1)


@pytest.mark.parametrize("points", [33_000, 300_000])
@pytest.mark.parametrize("method", ["lar", "bisquare", "lts", "least_squares"])
def test_fit_a_cubic(benchmark: Any, method: str, points: int) -> None:
    random = np.random.default_rng(0)
    x, y = random.uniform(-0.2, 0.2, points), random.uniform(-0.1, 0.1, points)
    z = 0.75 + 0.1 * x + 0.3 * x * y - y**3 + 3e-4 * random.standard_normal(points)
    z[x**2 + y**2 < 0.0127**2] += 0.0127
    benchmark(fit_surface, x, y, z, SurfaceConfig.from_data({"method": method}))


def test_cluster_100_000_points(benchmark: Any) -> None:
    v, u = np.mgrid[:320, :320] * 1.5e-3
    benchmark(euclidean_clusters, np.stack([u.ravel(), v.ravel(), 0 * u.ravel()], axis=1), 0.01)


def test_analyse_and_find(benchmark: Any) -> None:
    detector, cloud = load_detector("thesis", {"crop": {"kind": "none"}}), _board()
    found = benchmark(lambda: detector.find(cloud, detector.analyse(cloud), 8.0))
    assert len(found) == 8


def test_measure_eight_holes(benchmark: Any) -> None:
    detector, cloud = load_detector("thesis", {"crop": {"kind": "none"}}), _board()
    evidence = detector.analyse(cloud)
    found = detector.find(cloud, evidence, 8.0)
    measured = benchmark(lambda: [detector.measure(cloud, evidence, d) for d in found])
    assert len(measured) == 8


def test_findings_at_21_thresholds(benchmark: Any) -> None:
    detector, cloud = load_detector("thesis", {"crop": {"kind": "none"}}), _board()
    evidence = detector.analyse(cloud)
    found = benchmark(lambda: [detector.find(cloud, evidence, 2.0 * 2.0 ** (k / 4)) for k in range(21)])
    assert len(found[8]) == 8


def test_crop_to_the_largest_surface(benchmark: Any) -> None:
    assert benchmark(crop, _board(), AutoCrop()).any()
