"""Speed of registrations: ``pytest tests/benchmarks/bench_registration.py --benchmark-only``.

Nothing here asserts a time.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from board_views import pose, usual_error, views

from detectors.registration.by_points import coherent_point_drift, drift_covariance
from detectors.registration.register import register
from detectors.registration.settings import (
    AnyRegistration,
    CpdRegistration,
    IcpRegistration,
    PlainRegistration,
)

POSES = [pose(5 * np.sin(2 * t), 6 * t - 24, t, (0.002 * t, 0.0, 0.002 * t)) for t in range(9)]
METHODS: dict[str, AnyRegistration] = {
    "marks": PlainRegistration(method="marks"),
    "joint": PlainRegistration(method="joint"),
    "cpd": CpdRegistration(),
    "icp": IcpRegistration(),
    "icp of targets": IcpRegistration(points="target", estimation="point_to_plane"),
    "odometry": PlainRegistration(method="odometry"),
}


def _two_clouds(points: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    fixed = random.standard_normal((points, 3)) * [0.3, 0.1, 0.02]
    return fixed, fixed + 1e-3 * random.standard_normal((points, 3))


@pytest.mark.parametrize("points", [1000, 5000, 10_000])
def test_twenty_iterations_of_coherent_point_drift(benchmark: Any, points: int) -> None:
    fixed, moving = _two_clouds(points)
    config = CpdRegistration(tolerance=1e-300)
    drift = benchmark.pedantic(coherent_point_drift, args=(fixed, moving, config), warmup_rounds=1, rounds=3)
    assert drift.iterations == 20


def test_its_covariance_for_5000_points(benchmark: Any) -> None:
    fixed, moving = _two_clouds(5000)
    drift = coherent_point_drift(fixed, moving, CpdRegistration())
    benchmark.pedantic(drift_covariance, args=(fixed, moving, drift, 1e-3), warmup_rounds=1, rounds=3)


@pytest.mark.parametrize("method", METHODS)
def test_register_and_judge_nine_views(benchmark: Any, method: str) -> None:
    made = views(POSES, guess_error=usual_error(), noise_m=3e-4, textured=method == "odometry")
    prepared = [each.prepared for each in made]
    found = benchmark.pedantic(register, args=(prepared, METHODS[method]), warmup_rounds=1, rounds=3)
    assert len(found) == 9
