"""What tests of the scanned lidar share: the camera with other numbers, units before planes, mixed
views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR, Region
from scenes.optics import NoiseFreeView
from scenes.sensor.camera import camera_of, load_camera
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.lidar.facts import ScannedLidar

CAMERA = load_camera("realsense_l515")
QUIET = CameraConfig(
    name="realsense_l515",
    effects=NO_EFFECTS.model_copy(update={"multipath": True, "saturation": True}),
)
PATCH = Region(372, 422, 500, 560)
RAW: dict[str, float | list[float]] = {
    "engine.smoothing_px": [0.0, 0.0],
    "engine.least_agreeing": 0.0,
    "engine.confidence_electrons": 0.0,
}
"""No smoothing and no gate that looks at neighbours."""
FINE = {"engine.output_step_mm": 1e-3}
UNIFORM = {"engine.agree_deviations": 100.0, "scan.sweep_jitter_mm": 0.0}
"""All neighbours join, sweeps share nothing: the smoothing is linear."""


def changed(numbers: dict[str, float | list[float]]) -> ScannedLidar:
    camera = camera_of(CameraConfig(name="realsense_l515", numbers=numbers))
    assert isinstance(camera, ScannedLidar)
    return camera


def mixed(first: NoiseFreeView, second: NoiseFreeView, share: np.ndarray | float) -> NoiseFreeView:
    """A view whose beams take ``share`` of their light from the second."""
    phasor = (1 - share) * first.phasor + share * second.phasor
    intensity = (1 - share) * first.intensity + share * second.intensity
    return replace(first, phasor=phasor, phasor_direct=phasor, intensity=intensity)


def comb_phasors(camera: ScannedLidar, half_m: np.ndarray, light: np.ndarray) -> np.ndarray:
    """(K, n) phasors of returns (r, n) of that light at those half paths, summed over r."""
    wave = 4 * np.pi * np.array(camera.optics.frequencies_hz)[:, None, None] / SPEED_OF_LIGHT_AIR
    return (light * np.exp(1j * wave * half_m)).sum(axis=1)
