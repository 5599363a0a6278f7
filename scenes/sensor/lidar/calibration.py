"""The two fitted numbers of a scanned lidar: the gain, and the confidence threshold that gives its published reach.

``python -m scenes.sensor.calibration realsense_l515`` prints both; a test compares them with the camera's file.
"""

from __future__ import annotations

import numpy as np
from scipy import optimize

from harness.vocabulary.capture import Reason
from harness.vocabulary.geometry import Region
from harness.vocabulary.seeds import random_stream
from harness.vocabulary.units import MM
from scenes.closed_form import plane_view
from scenes.sensor.camera import CameraConfig
from scenes.sensor.effects import NONE
from scenes.sensor.lidar.facts import ScannedLidar
from scenes.sensor.source import SimulatedUnit

ONLY_NOISE = CameraConfig(effects=NONE.model_copy(update={"noise": True, "ambient": True}))


def with_number(camera: ScannedLidar, section: str, key: str, value: float) -> ScannedLidar:
    """The same camera with another value of one number."""
    part = getattr(camera, section)
    fact = getattr(part, key).model_copy(update={"value": value})
    return camera.model_copy(update={section: part.model_copy(update={key: fact})})


def unit_before_plane(camera: ScannedLidar, distance_m: float, albedo: float) -> SimulatedUnit:
    """A unit with noise only before a plane near the axis; its tilt of 3 degrees meets every phase of rounding."""
    lens = camera.nominal_lens
    row, col = int(lens.cy), int(lens.cx)
    view = plane_view(camera, Region(row - 32, row + 32, col - 32, col + 32), distance_m, albedo, 0.05, 0.02)
    return SimulatedUnit(camera, ONLY_NOISE, view)


def temporal_sigma_m(camera: ScannedLidar, distance_m: float, albedo: float, frames: int, seed: int) -> float:
    """Temporal standard deviation of the output's z (rms over pixels) on a plane near the axis, metres."""
    unit = unit_before_plane(camera, distance_m, albedo)
    z = np.stack([frame.z_m for frame in unit.capture(frames, seed, "calibration").frames()]).astype(float)
    return float(np.sqrt(np.nanvar(z, axis=0, ddof=1).mean()))


def calibrated_signal_electrons(camera: ScannedLidar, frames: int = 100, seed: int = 1) -> float:
    """The gain that meets the published deviation, to 0.5 % (100 frames of 3,600 pixels)."""
    photons = camera.photons
    wanted = photons.calibration_sigma_mm.value * MM

    def excess(log_electrons: float) -> float:
        trial = with_number(camera, "photons", "signal_electrons", float(np.exp(log_electrons)))
        distance_m, albedo = photons.calibration_distance_m.value, photons.calibration_albedo.value
        sigma_m = temporal_sigma_m(trial, distance_m, albedo, frames, seed)
        # what is published is of single pixels, hence with the jitter of whole frames
        return float(np.hypot(sigma_m, camera.unit.jitter_mm.value * MM)) / wanted - 1

    return float(np.exp(optimize.brentq(excess, np.log(1e3), np.log(1e5), xtol=1e-3)))


def calibrated_confidence_electrons(camera: ScannedLidar, frames: int = 100, seed: int = 1) -> float:
    """The confidence threshold at which half of the pixels are valid at the published reach."""
    photons = camera.photons
    open_gate = with_number(camera, "engine", "confidence_electrons", 0.0)
    unit = unit_before_plane(open_gate, photons.calibration_reach_m.value, photons.calibration_reach_albedo.value)
    rng = random_stream(seed, "calibration")
    decoded = [unit.model.frame(unit.exposure, rng) for _ in range(frames)]
    return float(np.median([np.where(d.reason == Reason.VALID, d.amplitude, 0.0)[unit.cut] for d in decoded]))


def calibrated_numbers(camera: ScannedLidar) -> dict[str, float]:
    """Both fitted numbers by their keys in the camera's file: the gain first, then the threshold with that gain."""
    electrons = calibrated_signal_electrons(camera)
    fitted = with_number(camera, "photons", "signal_electrons", electrons)
    return {
        "photons.signal_electrons": electrons,
        "engine.confidence_electrons": calibrated_confidence_electrons(fitted),
    }
