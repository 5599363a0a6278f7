"""The precision of cameras that are sold today, against what is published and recorded of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.programs.scorecard.bench import Bench, Effort
from harness.programs.scorecard.figures import Figure, read_figures
from harness.programs.scorecard.quantities import PlaneConditions, temporal_sigma_mm
from harness.vocabulary.geometry import MM
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.calibration import calibrated_signal_electrons, temporal_sigma_m
from scenes.sensor.camera import load_camera

PATCH_PX = 5
EFFORT = Effort(noise_frames=40, few_frames=4, whole_frames=40, units=2)


@pytest.mark.parametrize(
    "name",
    [
        "vzense_ds86",
        "pmd_flexx2",
        "luxonis_oak_d_tof",
        "basler_blaze101_short",
        "basler_blaze101_long",
        "arducam_tof_4m",
        "ifm_o3r222_4m",
    ],
)
def test_the_gain_gives_the_noise_of_the_calibration_point(name: str) -> None:
    camera = load_camera(name)
    assert isinstance(camera, AmcwCamera)
    electrons = calibrated_signal_electrons(camera, frames=60, seed=5)
    assert camera.photons.signal_electrons.value == pytest.approx(electrons, rel=0.03)


def test_a_longer_exposure_collects_as_much_light_as_a_brighter_plane() -> None:
    bench = Bench("vzense_ds86", EFFORT)
    longer = PlaneConditions(distance_m=2.0, albedo=0.3, exposure=3.0)
    brighter = PlaneConditions(distance_m=2.0, albedo=0.9)
    once = PlaneConditions(distance_m=2.0, albedo=0.3)
    sigma_mm = temporal_sigma_mm(bench, longer).value
    assert sigma_mm == pytest.approx(temporal_sigma_mm(bench, brighter).value, rel=0.03)
    # more than the root of 3, since read noise matters
    assert temporal_sigma_mm(bench, once).value / sigma_mm == pytest.approx(2.2, abs=0.3)


def test_the_long_mode_of_the_o3r222_is_twice_as_noisy_as_the_short_one() -> None:
    """ "Around twice as much", says ifm's page on modes; no number of the files was chosen by it."""
    long_m = temporal_sigma_m(load_camera("ifm_o3r222_4m"), 1.5, 0.8, frames=40, seed=1)
    short_m = temporal_sigma_m(load_camera("ifm_o3r222_2m"), 1.5, 0.8, frames=40, seed=1)
    assert long_m / short_m == pytest.approx(2.0, abs=0.3)


def test_the_blaze_is_6_times_noisier_with_15_mhz_than_with_100() -> None:
    """The maker states less than 1 mm for both frequencies and less than 6 mm for 15 MHz alone."""
    long_range = load_camera("basler_blaze101_long")
    assert isinstance(long_range, AmcwCamera)
    modulation = long_range.modulation
    slow = modulation.model_copy(
        update={
            "frequencies_hz": modulation.frequencies_hz.model_copy(update={"value": (15e6,)}),
            "contrast": modulation.contrast.model_copy(update={"value": (0.85,)}),
            "wiggling_residual": modulation.wiggling_residual.model_copy(update={"value": (0.1,)}),
        }
    )
    gains = long_range.engine.amplitude_gains.model_copy(update={"value": (1.0,)})
    engine = long_range.engine.model_copy(
        update={"amplitude_gains": gains, "lattice_residual_turns": None}
    )
    alone = long_range.model_copy(update={"modulation": slow, "engine": engine})
    both_m = temporal_sigma_m(long_range, 5.5, 0.9, frames=40, seed=1)
    alone_m = temporal_sigma_m(alone, 5.5, 0.9, frames=40, seed=1)
    assert 4.0 < alone_m / both_m < 6.0


def adi_frame(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return z in mm and brightness (512, 512) of a frame of the ADI ToF viewer: for each pixel two
    bytes of depth, one of confidence and two of brightness, the lower byte first."""
    pixels = np.fromfile(path, np.uint8).reshape(512, 512, 5).astype(int)
    return pixels[..., 0] + 256 * pixels[..., 1], pixels[..., 3] + 256 * pixels[..., 4]


def patches(image: np.ndarray) -> np.ndarray:
    """Return (n, pixels) the square patches of an image."""
    count = image.shape[0] // PATCH_PX
    cropped = image[: count * PATCH_PX, : count * PATCH_PX]
    cut = cropped.reshape(count, PATCH_PX, count, PATCH_PX).swapaxes(1, 2)
    return cut.reshape(-1, PATCH_PX**2).astype(float)


def noise_by_brightness(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean brightness and the deviation about a plane, in mm, of the patches of even
    brightness that have a range everywhere."""
    z_mm, brightness = adi_frame(path)
    depths = patches(z_mm)
    lights = patches(brightness)
    is_even = lights.std(axis=1) < 0.05 * np.maximum(lights.mean(axis=1), 1e-9)
    chosen = is_even & (depths > 0).all(axis=1) & (lights > 0).all(axis=1)
    v, u = np.mgrid[:PATCH_PX, :PATCH_PX].reshape(2, -1)
    plane = np.column_stack([np.ones(PATCH_PX**2), u, v])
    fitted = plane @ np.linalg.lstsq(plane, depths[chosen].T)[0]
    residual = depths[chosen] - fitted.T
    deviation_mm = np.sqrt((residual**2).sum(axis=1) / (PATCH_PX**2 - 3))
    return lights[chosen].mean(axis=1), deviation_mm


def figure(name: str) -> Figure:
    return next(figure for figure in read_figures().figures if figure.name == name)


@pytest.mark.parametrize(
    ("brightness", "low", "high"),
    [
        (12, 0, 20),
        (29, 20, 40),
        (53, 40, 80),
        (120, 80, 160),
        (208, 160, 320),
        (377, 320, 640),
        (844, 640, 1300),
    ],
)
def test_the_figures_of_the_adtf3175_are_those_of_the_frame(
    shared_data: Path, brightness: int, low: float, high: float
) -> None:
    path = shared_data / "adi_tof" / "frame_mode3.bin"
    if not path.is_file():
        pytest.skip("needs a frame that is not part of the project")
    light, deviation_mm = noise_by_brightness(path)
    in_bin = (light >= low) & (light < high)
    published = figure(f"adtf3175_noise_at_{brightness}").published
    assert float(np.median(light[in_bin])) == pytest.approx(brightness, rel=0.05)
    assert float(np.median(deviation_mm[in_bin])) == pytest.approx(published.value, rel=0.02)


def test_the_frame_of_the_ds86_is_of_the_plane_in_the_figures(shared_data: Path) -> None:
    path = shared_data / "vzense_plane" / "bg.bin"
    if not path.is_file():
        pytest.skip("needs a frame that is not part of the project")
    z_mm = np.fromfile(path, "<u2").reshape(480, 640)
    conditions = figure("ds86_plane_patch_5").conditions
    assert float(np.median(z_mm[z_mm < 65535])) * MM == pytest.approx(conditions["distance_m"])
