"""The one gain of a camera: signal electrons such that the output's temporal deviation is the published one.

Run ``python -m scenes.sensor.calibration azure_kinect_nfov`` (or kinect_v2) after a change to the sensor model and
write the number into the camera's file; a test compares the two. The published deviation is that of single pixels of a
real unit, so it contains the small jitter of whole frames, which is taken off in squares; frames that jump are left
out, as whoever measures a deviation leaves them out. Ambient light is that of `CameraConfig`'s default, indoors.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from scipy import optimize

from harness.vocabulary.errors import exit_code_of
from harness.vocabulary.geometry import Region
from harness.vocabulary.units import MM
from scenes.closed_form import plane_view
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.camera import CameraConfig, load_camera
from scenes.sensor.effects import NONE
from scenes.sensor.lidar.calibration import calibrated_numbers
from scenes.sensor.lidar.facts import ScannedLidar
from scenes.sensor.source import SimulatedUnit

NOISE = NONE.model_copy(update={"noise": True, "ambient": True})


def with_signal(camera: AmcwCamera, electrons: float) -> AmcwCamera:
    """The same camera with another gain."""
    photons = camera.photons.model_copy(
        update={"signal_electrons": camera.photons.signal_electrons.model_copy(update={"value": electrons})}
    )
    return camera.model_copy(update={"photons": photons})


def temporal_sigma_m(camera: AmcwCamera, distance_m: float, albedo: float, frames: int, seed: int) -> float:
    """Temporal standard deviation of the output's z (rms over pixels) on a frontal plane near the axis, metres.

    NaN where pixels are invalid in any frame. Without what a frame's pixels have in common (jitter, jumps);
    `with_jitter_m` adds the jitter. The plane is tilted by 3 degrees, so that the rounding meets every phase of its
    step.
    """
    lens = camera.nominal_lens
    row, col = int(lens.cy), int(lens.cx)
    view = plane_view(camera, Region(row - 24, row + 24, col - 40, col + 40), distance_m, albedo, 0.05, 0.02)
    unit = SimulatedUnit(camera, CameraConfig(name=camera.name, effects=NOISE), view)
    z = np.stack([frame.z_m for frame in unit.capture(frames, seed, "calibration").frames()]).astype(float)
    return float(np.sqrt(z.var(axis=0, ddof=1).mean()))


def with_jitter_m(camera: AmcwCamera, sigma_m: float) -> float:
    """The deviation of single pixels with the jitter of whole frames, from that without it, metres."""
    return float(np.hypot(sigma_m, camera.unit.jitter_mm.value * MM))


def calibrated_signal_electrons(camera: AmcwCamera, frames: int = 200, seed: int = 1) -> float:
    """The gain that meets the camera's calibration point, to 0.5 % (200 frames of 3,000 pixels, common noise)."""
    photons = camera.photons
    wanted = photons.calibration_sigma_mm.value * MM

    def excess(log_electrons: float) -> float:
        trial = with_signal(camera, float(np.exp(log_electrons)))
        sigma = temporal_sigma_m(
            trial, photons.calibration_distance_m.value, photons.calibration_albedo.value, frames, seed
        )
        # a camera too dim to see the wall at all is as far too noisy as any
        return with_jitter_m(trial, sigma) / wanted - 1 if np.isfinite(sigma) else 100.0

    return float(np.exp(optimize.brentq(excess, np.log(50.0), np.log(200_000.0), xtol=1e-3)))


def _main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m scenes.sensor.calibration", description="Solve for the calibrated numbers of a camera's file."
    )
    parser.add_argument("camera", help="a file of scenes/cameras/ without its ending")
    options = parser.parse_args(arguments)
    return exit_code_of(lambda: _print_numbers(options.camera))


def _print_numbers(name: str) -> int:
    camera = load_camera(name)
    if isinstance(camera, ScannedLidar):
        for key, value in calibrated_numbers(camera).items():
            print(f"{camera.name}: {key} = {value:.4g}")
        return 0
    print(f"{camera.name}: signal_electrons = {calibrated_signal_electrons(camera):.0f}")
    return 0


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
