"""Fits numbers of a camera: the gain that gives the published noise, and a lidar's confidence
threshold.

After a change of the sensor model, run ``python -m scenes.sensor.calibration NAME`` and write the
numbers into the camera's file; a test compares both. The gain gives the published temporal
deviation of single pixels, without the jitter of whole frames (subtracted in squares) and without
jumps. Ambient light is the default of `CameraConfig`."""

import argparse
import sys
from typing import TypeVar

import numpy as np
from scipy import optimize

from harness.vocabulary.errors import UserError, exit_code_of
from harness.vocabulary.geometry import MM, Reason, Region
from harness.vocabulary.seeds import random_stream
from scenes.closed_form import plane_view
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.camera import AnyCamera, load_camera
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.empirical.facts import EmpiricalCamera
from scenes.sensor.lidar.facts import ScannedLidar
from scenes.sensor.source import SimulatedUnit

ONLY_NOISE = CameraConfig(effects=NO_EFFECTS.model_copy(update={"noise": True, "ambient": True}))
# half the plane's height and width
HALF_PX = {"amcw_imager": (24, 40), "scanned_lidar": (32, 32), "empirical": (32, 32)}
RANGE_OF_ELECTRONS = {"amcw_imager": (50.0, 10_000_000.0), "scanned_lidar": (1e3, 1e5)}
# with some 3,000 pixels that share their noise: a gain to 0.5 %
FRAMES = {"amcw_imager": 200, "scanned_lidar": 100}

PhotonCamera = AmcwCamera | ScannedLidar  # cameras whose noise follows from a photon budget
Camera = TypeVar("Camera", bound=AnyCamera)


def with_number(camera: Camera, section: str, key: str, value: float) -> Camera:
    """Return the same camera with one number changed."""
    part = getattr(camera, section)
    fact = getattr(part, key).model_copy(update={"value": value})
    return camera.model_copy(update={section: part.model_copy(update={key: fact})})  # type: ignore[return-value]


def unit_before_plane(camera: AnyCamera, distance_m: float, albedo: float) -> SimulatedUnit:
    """Return a unit with noise only, without jitter, before a plane that is tilted to cover all
    phases of rounding."""
    lens = camera.nominal_lens
    half_h, half_w = HALF_PX[camera.kind]
    row = int(lens.cy)
    col = int(lens.cx)
    region = Region(row - half_h, row + half_h, col - half_w, col + half_w)
    view = plane_view(
        camera,
        region,
        distance_m,
        albedo,
        0.05,
        0.02,
    )
    return SimulatedUnit(camera, ONLY_NOISE.model_copy(update={"name": camera.name}), view)


def temporal_sigma_m(
    camera: AnyCamera, distance_m: float, albedo: float, frames: int, seed: int
) -> float:
    """Return the temporal standard deviation of z (rms over pixels) on a plane, metres. NaN if a
    pixel of an imager is invalid in any frame; invalid samples of a lidar are left out."""
    unit = unit_before_plane(camera, distance_m, albedo)
    capture = unit.capture(frames, seed, "calibration")
    z_m = np.stack([frame.z_m for frame in capture.frames()]).astype(float)
    if isinstance(camera, ScannedLidar):
        variance = np.nanvar(z_m, axis=0, ddof=1)
    else:
        variance = z_m.var(axis=0, ddof=1)
    return float(np.sqrt(variance.mean()))


def calibrated_signal_electrons(
    camera: PhotonCamera, frames: int | None = None, seed: int = 1
) -> float:
    """Return the gain that reproduces the camera's calibration point to 0.5 %."""
    photons = camera.photons
    count = frames or FRAMES[camera.kind]
    published_m = photons.calibration_sigma_mm.value * MM
    distance_m = photons.calibration_distance_m.value
    albedo = photons.calibration_albedo.value
    jitter_m = camera.unit.jitter_mm.value * MM

    def excess(log_electrons: float) -> float:
        electrons = float(np.exp(log_electrons))
        trial: PhotonCamera = with_number(camera, "photons", "signal_electrons", electrons)
        sigma_m = temporal_sigma_m(trial, distance_m, albedo, count, seed)
        if not np.isfinite(sigma_m):
            return 100.0  # a camera too dim to see the wall at all counts as far too noisy
        return float(np.hypot(sigma_m, jitter_m)) / published_m - 1

    lowest, highest = np.log(RANGE_OF_ELECTRONS[camera.kind])
    return float(np.exp(optimize.brentq(excess, lowest, highest, xtol=1e-3)))


def calibrated_numbers(camera: PhotonCamera) -> dict[str, float]:
    """Return the gain and a lidar's threshold at which half of the pixels are valid at the
    published reach, by key."""
    electrons = calibrated_signal_electrons(camera)
    numbers = {"photons.signal_electrons": electrons}
    if isinstance(camera, ScannedLidar):
        fitted = with_number(camera, "photons", "signal_electrons", electrons)
        numbers["engine.confidence_electrons"] = _median_strength_at_reach(fitted)
    return numbers


def _median_strength_at_reach(camera: ScannedLidar) -> float:
    """Return the median strength of pixels at the published reach, with the threshold at 0."""
    photons = camera.photons
    unit = unit_before_plane(
        with_number(camera, "engine", "confidence_electrons", 0.0),
        photons.calibration_reach_m.value,
        photons.calibration_reach_albedo.value,
    )
    rng = random_stream(1, "calibration")
    strengths = []
    for _ in range(100):
        frame = unit.model.frame(unit.exposure, rng)
        strength = np.where(frame.reason == Reason.VALID, frame.amplitude, 0.0)
        strengths.append(strength[unit.cut])
    return float(np.median(strengths))


def _main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        "python -m scenes.sensor.calibration", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("camera", help="the name of a file in scenes/cameras/ without .yaml")
    name = parser.parse_args(arguments).camera

    def print_numbers() -> int:
        camera = load_camera(name)
        if isinstance(camera, EmpiricalCamera):
            fix = "measure it again with tofpod characterise"
            raise UserError(f"{name}: an empirical camera has no gain to calibrate", fix=fix)
        for key, value in calibrated_numbers(camera).items():
            print(f"{name}: {key} = {value:.5g}")
        return 0

    return exit_code_of(print_numbers)


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
