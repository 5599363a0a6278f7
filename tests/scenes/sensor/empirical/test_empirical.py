"""The empirical camera and its table, term by term."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from harness.vocabulary.geometry import Reason, Region
from scenes.closed_form import Plane, layered_view, plane_view
from scenes.sensor.camera import load_camera
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.common.tabled import DepthNoise, filtered
from scenes.sensor.empirical.facts import EmpiricalCamera
from scenes.sensor.empirical.imager import EmpiricalImager, IdealRange
from scenes.sensor.source import SimulatedUnit
from tests.support.sensor_frames import correlation

REGION = Region(60, 120, 80, 160)
QUIET = CameraConfig(effects=NO_EFFECTS)
NOISY = CameraConfig(effects=NO_EFFECTS.model_copy(update={"noise": True}))
f4 = np.float32


def fact(value: Any) -> dict[str, Any]:
    return {"value": value, "tag": "M", "source": "made up for a test"}


def camera_with(**changes: Any) -> EmpiricalCamera:
    """A camera whose noise is 1 mm at 1 m and 4 mm at 2 m; ``changes``: section__key."""
    azure = load_camera("azure_kinect_nfov").to_data()
    lens = {"width_px": 240, "height_px": 180, "fx_px": 200.0, "fy_px": 200.0}
    lens |= {"cx_px": 119.5, "cy_px": 89.5, "distortion": []}
    data: dict[str, Any] = {
        "name": "measured",
        "title": "A measured camera",
        "kind": "empirical",
        "wavelength_nm": fact(850.0),
        "lens": {key: fact(value) for key, value in lens.items()},
        # a table knows no photons, by which jitter could fall
        "unit": {key: fact for key, fact in azure["unit"].items() if key != "jitter_at_units"},
        "light": {"amplitude_at_1m": fact(100.0), "albedo": fact(0.5)},
        "noise": {
            "range_mm": fact([1000.0, 2000.0]),
            "sigma_mm": fact([1.0, 4.0]),
            "range_exponent": fact(2.0),
            "brightness_exponent": fact(0.5),
            "rows": fact([1.0]),
            "columns": fact([1.0]),
        },
        "fixed_pattern": {
            "deviation_mm": fact(2.0),
            "rows": fact([0.6, 0.8]),
            "columns": fact([1.0]),
        },
        "dropouts": {"amplitude": fact([1.0, 100.0]), "share": fact([0.8, 0.0])},
        "edge": {"gap_px": fact(0.0), "blur_px": fact(0.0), "least_step_mm": fact(20.0)},
        "engine": {
            "min_range_mm": fact(300.0),
            "max_range_mm": fact(5000.0),
            "output_step_mm": fact(0.001),
        },
    }
    for path, value in changes.items():
        section, key = path.split("__")
        data[section][key] = fact(value)
    return EmpiricalCamera.from_data(data)


def imager_before(distance_m: float, albedo: float, config: CameraConfig = NOISY, **changes: Any):
    """The imager on a facing plane, and the view."""
    camera = camera_with(**changes)
    view = plane_view(camera, REGION, distance_m, albedo)
    return EmpiricalImager(camera, config, REGION, view.slopes), view


def first_frame_of(imager: EmpiricalImager, ideal: IdealRange, error_m: float = 0.0):
    return imager.frame(ideal, np.random.default_rng(1), error_m)


@pytest.mark.parametrize(
    ("distance_m", "albedo", "sigma_mm"),
    [
        (1.0, 0.5, 1.0),
        (np.sqrt(2.0), 0.5, 2.0),  # logarithms are interpolated
        (2.0, 0.5, 4.0),
        (3.0, 0.5, 9.0),  # beyond the table's end the square of range holds
        (0.5, 0.5, 0.25),
        (1.0, 0.125, 2.0),  # a quarter of the brightness has twice the noise
    ],
)
def test_noise_by_range_and_brightness(distance_m, albedo, sigma_mm):
    imager, view = imager_before(distance_m, albedo)
    ideal = imager.expose(view)
    middle = (30, 40)
    assert ideal.range_m[middle] == pytest.approx(distance_m, rel=1e-4)
    assert ideal.sigma_m[middle] == pytest.approx(sigma_mm * 1e-3, rel=2e-3)
    amplitude = 100.0 * albedo / 0.5 / distance_m**2
    assert ideal.amplitude[middle] == pytest.approx(amplitude, rel=1e-3)


def test_beyond_the_table_noise_grows_with_the_stated_power_of_range():
    imager, view = imager_before(3.0, 0.5, noise__range_exponent=1.0)
    assert imager.expose(view).sigma_m[30, 40] == pytest.approx(4e-3 * 1.5, rel=2e-3)


@pytest.mark.parametrize(
    ("albedo", "share"),
    [
        (0.5, 0.0),
        (0.05, 0.4),
        (0.005, 0.8),
    ],
)
def test_dropouts_by_the_logarithm_of_amplitude(albedo, share):
    imager, view = imager_before(1.0, albedo)
    ideal = imager.expose(view)
    assert ideal.chance[30, 40] == pytest.approx(share, abs=2e-3)
    frame = first_frame_of(imager, ideal)
    lost = frame.reason == Reason.NO_RETURN
    assert lost.mean() == pytest.approx(ideal.chance.mean(), abs=0.03)
    assert np.array_equal(lost, np.isnan(frame.z_m))
    quiet, _ = imager_before(1.0, albedo, QUIET)
    assert quiet.expose(view).chance.max() == 0


def test_scale_and_bias_of_the_unit_act_along_each_ray():
    data = camera_with(unit__offset_mm=0.0).to_data()
    data["range_error"] = {"scale": fact(1.01), "bias_mm": fact(-5.0)}
    camera = EmpiricalCamera.from_data(data)
    view = plane_view(camera, REGION, 2.0, 0.5)
    without = EmpiricalImager(camera, QUIET, REGION, view.slopes).expose(view).range_m
    offset = CameraConfig(effects=NO_EFFECTS.model_copy(update={"unit_offset": True}))
    ideal = EmpiricalImager(camera, offset, REGION, view.slopes).expose(view)
    assert ideal.range_m == pytest.approx(1.01 * without - 0.005, abs=1e-6)


def test_frames_scatter_by_the_noise_and_their_displacement():
    imager, view = imager_before(1.0, 0.5, dropouts__share=[0.0, 0.0])
    ideal = imager.expose(view)
    stretch = np.sqrt(1 + (view.slopes**2).sum(axis=-1))
    true_m = view.range_m
    noise_m = first_frame_of(imager, ideal).z_m * stretch - true_m
    moved_m = first_frame_of(imager, ideal, 0.02).z_m * stretch - true_m
    # the same noise, 20 mm farther; 4,800 pixels tell a deviation to 1 %
    assert moved_m - noise_m == pytest.approx(0.02, abs=1e-5)
    assert abs(noise_m.mean()) < 0.06e-3
    normal = noise_m / ideal.sigma_m
    assert normal.std() == pytest.approx(1.0, rel=0.04)


def test_limits_and_the_step_of_the_output():
    for distance_m in (0.29, 5.1):
        imager, view = imager_before(distance_m, 0.5, QUIET)
        frame = first_frame_of(imager, imager.expose(view))
        assert frame.reason[30, 40] == Reason.OUT_OF_RANGE
    coarse, view = imager_before(1.0037, 0.5, QUIET, engine__output_step_mm=5.0)
    z_m = first_frame_of(coarse, coarse.expose(view)).z_m
    assert z_m == pytest.approx(1.005, abs=1e-6)


def stepped_view(camera: EmpiricalCamera, step_m: float):
    """A step at column 40 from 1 m to farther."""
    half_px = 0.5 / camera.nominal_lens.fx
    slope = camera.nominal_lens.region_slopes(REGION)[0, 40, 0] - half_px

    def covers(slopes: np.ndarray) -> np.ndarray:
        return np.asarray(slopes[..., 0] < slope)

    return layered_view(
        camera,
        REGION,
        Plane(1.0),
        Plane(1.0 + step_m),
        covers,
        0.5,
    )


@pytest.mark.parametrize(
    ("gap_px", "step_m", "chances"),
    [
        (3.0, 0.1, [0, 0, 0.5, 1, 1, 0.5, 0]),
        (2.0, 0.1, [0, 0, 0, 1, 1, 0, 0]),
        (5.0, 0.1, [0, 0.5, 1, 1, 1, 1, 0.5]),
        (3.0, 0.015, [0, 0, 0, 0, 0, 0, 0]),
    ],
)
def test_returns_are_lost_across_a_step(gap_px, step_m, chances):
    """On columns 36 to 42: half the gap either way of the two columns that meet."""
    camera = camera_with(edge__gap_px=gap_px)
    view = stepped_view(camera, step_m)
    ideal = EmpiricalImager(camera, QUIET, REGION, view.slopes).expose(view)
    assert ideal.chance[30, 36:43] == pytest.approx(chances, abs=1e-6)


def test_a_return_is_lost_by_darkness_or_at_a_step_independently():
    """A share of 0.4 is lost by darkness; of the rest, half at the gap's ends."""
    camera = camera_with(edge__gap_px=3.0, dropouts__share=[0.4, 0.4])
    view = stepped_view(camera, 0.1)
    ideal = EmpiricalImager(camera, NOISY, REGION, view.slopes).expose(view)
    expected = [0.4, 0.4, 1 - 0.6 * 0.5, 1.0, 1.0, 1 - 0.6 * 0.5, 0.4]
    assert ideal.chance[30, 36:43] == pytest.approx(expected, abs=1e-6)


def test_smoothed_depth_keeps_planes_and_softens_steps():
    camera = camera_with(edge__blur_px=2.0)
    tilted = plane_view(
        camera,
        REGION,
        1.0,
        0.5,
        0.3,
        0.2,
    )
    plane = EmpiricalImager(camera, QUIET, REGION, tilted.slopes).expose(tilted)
    inner = (slice(8, -8), slice(8, -8))
    assert plane.range_m[inner] == pytest.approx(tilted.range_m[inner], abs=2e-5)
    view = stepped_view(camera, 0.02)
    ideal = EmpiricalImager(camera, QUIET, REGION, view.slopes).expose(view)
    stretch = np.sqrt(1 + (view.slopes**2).sum(axis=-1))
    z_m = ideal.range_m[30] / stretch[30]
    # half a pixel from the step, a Gaussian of 2 px has 0.40 and 0.60 of it
    assert z_m[39] == pytest.approx(1.008, abs=3e-4)
    assert z_m[40] == pytest.approx(1.012, abs=3e-4)


def test_the_fixed_pattern_has_its_size_and_correlation():
    """Taps 0.6 and 0.8 down the columns correlate neighbours by 0.48; 43,200 pixels."""
    camera = camera_with()
    lens = camera.nominal_lens
    only = CameraConfig(effects=NO_EFFECTS.model_copy(update={"fixed_pattern": True}))
    imager = EmpiricalImager(camera, only, lens.whole, lens.region_slopes(lens.whole))
    pattern_mm = 1e3 * imager.static_error_m
    assert pattern_mm.std() == pytest.approx(2.0, rel=0.02)
    assert correlation(pattern_mm[None], 1, 0) == pytest.approx(0.48, abs=0.02)
    assert correlation(pattern_mm[None], 0, 1) == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({"noise__range_mm": [2000.0, 1000.0]}, "noise.range_mm must increase"),
        ({"noise__sigma_mm": [1.0]}, "noise.sigma_mm needs a value for each"),
        ({"dropouts__amplitude": [1.0, 1.0]}, "dropouts.amplitude must increase"),
        ({"dropouts__share": [0.5]}, "dropouts.share needs a value for each"),
    ],
)
def test_tables_that_are_none_are_refused(changes, wanted):
    with pytest.raises(ValueError, match=wanted):
        camera_with(**changes)


def test_pixels_without_light_have_no_return():
    imager, view = imager_before(1.0, 0.5)
    dark = dataclasses.replace(view, phasor_direct=0 * view.phasor_direct)
    ideal = imager.expose(dark)
    assert (ideal.chance == 1).all()
    frame = first_frame_of(imager, ideal)
    assert (frame.reason == Reason.NO_RETURN).all()


def test_the_margin_holds_the_gap_and_the_kernel():
    assert camera_with(edge__gap_px=3.0, edge__blur_px=2.0).optics.margin_px == 6 + 2 + 1
    unit = SimulatedUnit(camera_with(), QUIET, plane_view(camera_with(), REGION, 1.0, 0.5))
    assert unit.first_order is None


# ---------------------------------------------------------------- the table for any simulator


def table_of(**changes: Any) -> dict[str, Any]:
    """Three levels of light, at octaves of intensity / range^2 from 1/4 on."""
    h = 40
    w = 50
    return {
        "slopes": np.zeros((h, w, 2), f4),
        "falloff": np.ones((h, w), f4),
        "sigma_m": np.array([0.004, 0.002, 0.001], f4),
        "seen": np.array([0.5, 0.9, 1.0], f4),
        "first": f4(-2.0),
        "per_octave": f4(1.0),
        "rows": np.array([1.0], f4),
        "columns": np.array([1.0], f4),
        "pattern_m": f4(0.0),
        "pattern_rows": np.array([1.0], f4),
        "pattern_columns": np.array([1.0], f4),
        "nearest_m": f4(0.5),
        "farthest_m": f4(5.0),
        "step_m": f4(0.0),
        **changes,
    }


@pytest.mark.parametrize(
    ("intensity", "sigma_mm", "share"),
    [
        (0.25, 4.0, 0.5),
        (0.33, 4.0, 0.5),  # the nearest octave counts
        (0.38, 2.0, 0.9),
        (0.5, 2.0, 0.9),
        (1.0, 1.0, 1.0),
        (8.0, 1.0, 1.0),
        (0.01, 0.0, 0.0),
    ],
)
def test_the_table_s_noise_by_light(intensity, sigma_mm, share):
    """At 1 m; 2,000 pixels tell a share to 1 % and a deviation to 2 %."""
    noise = DepthNoise(table_of())
    distance_m = np.ones((40, 50))
    z_m = noise(distance_m, intensity * distance_m, np.random.default_rng(1))
    valid = np.isfinite(z_m)
    assert valid.mean() == pytest.approx(share, abs=0.04)
    if share:
        assert 1e3 * z_m[valid].std() == pytest.approx(sigma_mm, rel=0.08)
        assert z_m[valid].mean() == pytest.approx(1.0, abs=5e-4)
    # a quarter of the light at twice the range
    twice_m = 2 * distance_m
    far_m = noise(twice_m, 4 * intensity * distance_m, np.random.default_rng(1))
    assert np.isfinite(far_m).mean() == pytest.approx(share, abs=0.04)


def test_the_table_s_limits_step_pattern_and_rays():
    bright = np.ones((40, 50))
    rng = np.random.default_rng(1)
    plain = DepthNoise(table_of())
    assert np.isnan(plain(0.49 * bright, bright, rng)).all()
    assert np.isnan(plain(5.1 * bright, 100 * bright, rng)).all()
    coarse = DepthNoise(table_of(step_m=f4(0.01)))(bright, bright, rng)
    assert np.abs(coarse * 100 - np.round(coarse * 100)).max() < 1e-4
    patterned = DepthNoise(table_of(pattern_m=f4(0.05)), seed=3)
    assert patterned.pattern_m.std() == pytest.approx(0.05, rel=0.06)
    off_m = patterned(bright, bright, rng) - 1 - patterned.pattern_m
    assert np.abs(off_m).max() < 0.005
    # a ray twice as long as the axis sees a quarter of the light, and z is half of its noise
    aslant = np.zeros((40, 50, 2), f4)
    aslant[..., 0] = np.sqrt(3.0)
    z_m = DepthNoise(table_of(), aslant)(bright, 4 * bright, rng)
    assert 1e3 * z_m.std() == pytest.approx(0.5, rel=0.08)


def test_filters_are_causal_and_periodic():
    image = np.zeros((4, 5))
    image[3, 1] = 1.0
    down = np.array([0.5, 0.25])
    across = np.array([2.0, 1.0])
    result = filtered(image, down, across)
    expected = np.zeros((4, 5))
    expected[3, 1:3] = [1.0, 0.5]
    expected[0, 1:3] = [0.5, 0.25]
    assert result == pytest.approx(expected)
