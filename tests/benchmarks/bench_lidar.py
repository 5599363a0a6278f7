"""Speed of the simulated scanned lidar: ``pytest tests/benchmarks/bench_lidar.py --benchmark-only``.

Frames run on one core; an exposure's matrix product takes all cores unless OPENBLAS_NUM_THREADS says otherwise.
Nothing here asserts a time. An exposure is made once a view.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from harness.vocabulary.geometry import Region
from harness.vocabulary.seeds import random_stream
from scenes.closed_form import plane_view
from scenes.sensor.camera import CameraConfig, load_camera
from scenes.sensor.lidar.kernels import strongest_peaks
from scenes.sensor.source import SimulatedUnit

CAMERA = load_camera("realsense_l515")
LENS = CAMERA.nominal_lens
BOARD = Region(300, 550, 350, 750)
"""100,000 pixels, about the board's part of a picture at 0.75 m."""


def unit_on(region: Region) -> SimulatedUnit:
    """A unit before a board of 0.75 m, with all effects, from a view in single precision as renders are stored."""
    view = plane_view(CAMERA, region, 0.75, 0.6, 0.1, 0.05)
    single = view.phasor.astype(np.complex64)
    return SimulatedUnit(CAMERA, CameraConfig(name=CAMERA.name), replace(view, phasor=single, phasor_direct=single))


@pytest.mark.benchmark(group="whole frame")
@pytest.mark.parametrize("region", [BOARD, LENS.whole], ids=["100,000 pixels", "1024 x 768"])
def test_a_simulated_frame(benchmark: Any, region: Region) -> None:
    unit, rng = unit_on(region), random_stream(1)
    decoded = benchmark(unit.model.frame, unit.exposure, rng)
    assert np.isfinite(decoded.z_m).mean() > 0.99


@pytest.mark.benchmark(group="exposure, 100,000 pixels")
def test_an_exposure(benchmark: Any) -> None:
    unit = unit_on(BOARD)
    returns = benchmark(unit.model.expose, unit.view)
    assert (returns.height[0] > returns.height[1]).all()


@pytest.mark.benchmark(group="exposure, 100,000 pixels")
def test_the_peaks_of_10_000_correlations(benchmark: Any) -> None:
    phasor = unit_on(BOARD).view.phasor.reshape(len(CAMERA.weights), -1)[:, :10_000]
    peaks = benchmark(strongest_peaks, phasor, CAMERA.weights)
    assert (peaks.height[0] > 0).all()
