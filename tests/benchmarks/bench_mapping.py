"""Speed of merging and of detection on what was merged: ``pytest tests/benchmarks/bench_mapping.py --benchmark-only``.

Nothing here asserts a time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from detectors import load_detector
from detectors.mapping.merge import Merged, merge
from detectors.mapping.settings import AnyMerge, FusedMerge, GridMerge, VolumeMerge
from harness.vocabulary.geometry import MM, Lens
from tests.mapped_views import Hole, Plane, arc, reference, registered, seen

LENS = Lens(300, 200, 500.0, 500.0, 149.5, 99.5)
"""60,000 pixels a view."""
WAYS = {"grid": GridMerge(), "fusion": FusedMerge(), "volume": VolumeMerge()}
BLIND = {"crop": {"kind": "none"}, "min_points": 3}


def _merged(count: int, config: AnyMerge) -> Merged:
    return merge(*_views(count), config)


def _views(count: int) -> tuple[list[Any], list[Any]]:
    poses = arc(count, 25.0)
    rng = np.random.default_rng(1)
    plane = Plane(3.0, 4.0, Hole(12.7 * MM, 9.0 * MM))
    colour = np.full((LENS.height, LENS.width, 3), 128, np.uint8)
    amplitude = np.full((LENS.height, LENS.width), 1000.0)
    views = [
        seen(
            plane, T, rng, noise_m=0.5 * MM, frames=10, blur=5, lens=LENS, name=str(i), rgb=colour, amplitude=amplitude
        )
        for i, T in enumerate(poses)
    ]
    covariance = np.diag([1e-4] * 6) ** 2
    return views, [reference(), *(registered(str(i), T, covariance) for i, T in enumerate(poses) if i)]


@pytest.mark.parametrize("count", [2, 9])
@pytest.mark.parametrize("way", sorted(WAYS))
def test_merge_views_of_60_000_points(benchmark: Any, way: str, count: int) -> None:
    views, registrations = _views(count)
    merge(views, registrations, WAYS[way])
    found = benchmark.pedantic(lambda: merge(views, registrations, WAYS[way]), rounds=5, iterations=1)
    assert len(found.views_used) == count


@pytest.mark.parametrize("stage", ["analyse", "find", "measure"])
@pytest.mark.parametrize("way", sorted(WAYS))
def test_detect_on_nine_merged_views(benchmark: Any, way: str, stage: str) -> None:
    detector, cloud = load_detector("thesis", BLIND), _merged(9, WAYS[way]).cloud
    evidence = detector.analyse(cloud)
    found = detector.find(cloud, evidence, 6.0)
    stages = {
        "analyse": lambda: detector.analyse(cloud),
        "find": lambda: detector.find(cloud, evidence, 6.0),
        "measure": lambda: [detector.measure(cloud, evidence, detection) for detection in found],
    }
    benchmark(stages[stage])
    assert found
