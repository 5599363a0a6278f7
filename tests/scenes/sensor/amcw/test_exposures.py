"""Exposure control: which times are chosen, and what shorter exposures hold."""

from __future__ import annotations

import numpy as np
import pytest

from harness.vocabulary.geometry import UW_CM2, Reason, Region
from scenes.closed_form import plane_view
from scenes.sensor.amcw.exposure import AmcwExposure, time_shares
from scenes.sensor.amcw.facts import AmcwCamera, ExposuresFacts
from scenes.sensor.calibration import unit_before_plane
from scenes.sensor.camera import camera_names, camera_of, load_camera
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.source import SimulatedUnit

REGION = Region(290, 300, 310, 322)
ELECTRONS = 40_000.0
"""Of both wells, from albedo 1 at 1 m: half of a full well at albedo 0.5."""
WELL = 40_000.0
READ_NOISE = 60.0
PER_UNIT = 2.0
CONTRAST = 0.5
AMBIENT = 40.0
NUMBERS = {
    "photons.signal_electrons": ELECTRONS,
    "photons.electrons_per_unit": PER_UNIT,
    "photons.full_well_electrons": WELL,
    "photons.read_noise_electrons": READ_NOISE,
    "modulation.contrast": [CONTRAST] * 3,
    "converter.full_scale_units": 10**6,
}
CONTROLLED = [
    name for name in camera_names() if getattr(load_camera(name), "exposures", None) is not None
]


def fact(value: object) -> dict[str, object]:
    return {"value": value, "tag": "M", "source": "test"}


def control(
    shares: tuple[float, ...],
    continuous: bool = False,
    fill: float = 0.9,
    bright_share: float | None = None,
) -> ExposuresFacts:
    """Exposures for a frame if a share of bright pixels is given, else for each pixel."""
    data = {
        "shares": fact(list(shares)),
        "continuous": fact(continuous),
        "chosen_for": fact("pixel" if bright_share is None else "frame"),
        "fill": fact(fill),
        "bright_share": None if bright_share is None else fact(bright_share),
    }
    return ExposuresFacts.from_data(data)


def unit_with(
    exposures: ExposuresFacts | None, distance_m: float, slope_x: float = 0.0, **effects: bool
) -> SimulatedUnit:
    """A unit before a plane of albedo 0.5."""
    only = NO_EFFECTS.model_copy(update={"saturation": True, "noise": True, **effects})
    config = CameraConfig(effects=only, numbers=NUMBERS, ambient_uw_cm2_nm=AMBIENT)
    camera = camera_of(config)
    assert isinstance(camera, AmcwCamera)
    camera = camera.model_copy(update={"exposures": exposures, "scatter": None})
    view = plane_view(camera, REGION, distance_m, 0.5, slope_x)
    return SimulatedUnit(camera, config, view)


def exposed(
    exposures: ExposuresFacts | None, distance_m: float, **effects: bool
) -> tuple[AmcwExposure, np.ndarray]:
    """The exposure of a facing plane of albedo 0.5, and the electrons (n,) of the emitter in both
    wells in the longest exposure."""
    unit = unit_with(exposures, distance_m, **effects)
    electrons = ELECTRONS * unit.model.gathered * unit.view.intensity
    return unit.exposure, electrons.ravel()


def test_each_pixel_takes_the_longest_time_that_fits():
    fullness = np.array([[0.0, 0.9, 0.91, 3.6, 3.7, 100.0]])
    chosen = time_shares(control((1.0, 0.25, 0.1)), fullness)
    assert chosen.tolist() == [[1.0, 1.0, 0.25, 0.25, 0.1, 0.1]]
    chosen = time_shares(control((1.0, 0.1), continuous=True), fullness)
    expected = [[1.0, 1.0, 0.9 / 0.91, 0.25, 0.9 / 3.7, 0.1]]
    assert chosen == pytest.approx(np.array(expected), rel=1e-12)
    assert (chosen[0, :2] == 1.0).all()


def test_a_frame_takes_the_longest_time_that_few_pixels_exceed():
    """One of 101 pixels may saturate; two may not."""
    one_bright = np.full((1, 101), 1.8)
    one_bright[0, 0] = 50.0
    control_of_frame = control((1.0, 0.01), continuous=True, bright_share=0.01)
    assert time_shares(control_of_frame, one_bright) == pytest.approx(np.full((1, 101), 0.5))
    two_bright = one_bright.copy()
    two_bright[0, 1] = 50.0
    assert time_shares(control_of_frame, two_bright) == pytest.approx(np.full((1, 101), 0.018))
    stepped = control((1.0, 0.4, 0.01), bright_share=0.01)
    assert (time_shares(stepped, one_bright) == 0.4).all()
    assert (time_shares(stepped, two_bright) == 0.01).all()


def test_a_frames_shorter_exposure_holds_less_of_all_light_but_has_all_read_noise():
    """Albedo 0.5 at 0.5 m: 80,000 electrons and room light; 60,000 in the fuller well. Amplitudes
    are those of the shorter exposure."""
    longest, electrons = exposed(None, 0.5, ambient=True)
    short, _ = exposed(control((1.0, 0.25), bright_share=0.01), 0.5, ambient=True)
    assert (short.time_share == 0.25).all()
    assert short.means == pytest.approx(0.25 * longest.means, rel=1e-5)
    camera = load_camera("azure_kinect_nfov")
    irradiance = AMBIENT * UW_CM2 * camera.photons.band_nm.value
    ambient = electrons * 0.5**2 * irradiance / camera.emitter.irradiance_w_m2.value
    collected = 0.25 * (electrons + ambient)
    variance = collected + 2 * READ_NOISE**2
    assert short.sigma * PER_UNIT == pytest.approx(np.sqrt(variance), rel=0.005)
    assert short.limit * PER_UNIT == pytest.approx(2 * WELL - collected, rel=0.005)
    assert (np.abs(longest.means).max(axis=(0, 1)) > longest.limit).all()


def test_a_pixels_shorter_exposure_is_scaled_with_its_noise_after_conversion():
    longest, electrons = exposed(None, 0.5)
    short, _ = exposed(control((1.0, 0.25)), 0.5)
    assert (short.time_share == 0.25).all()
    assert np.array_equal(short.means, longest.means)
    variance = electrons / 0.25 + 2 * (READ_NOISE / 0.25) ** 2
    assert short.sigma * PER_UNIT == pytest.approx(np.sqrt(variance), rel=1e-5)
    room = 2 * WELL / 0.25 - electrons
    assert short.limit * PER_UNIT == pytest.approx(room, rel=1e-5)


@pytest.mark.parametrize("full_scale", [1_000, 100_000])
def test_the_converter_is_filled_by_what_the_shorter_exposure_holds(full_scale, monkeypatch):
    """Amplitudes of 20,000 units at 0.5 m: a converter of 1,000 allows shares of 0.045; one of
    100,000 leaves the choice to the wells, of which 60,000 of 40,000 electrons are the fuller."""
    monkeypatch.setitem(NUMBERS, "converter.full_scale_units", full_scale)
    wanted = {1_000: 0.9 * 1_000 / 20_000, 100_000: 0.9 * 40 / 60}[full_scale]
    exposure, _ = exposed(control((1.0, 0.001), continuous=True), 0.5)
    assert np.median(exposure.time_share) == pytest.approx(wanted, rel=0.02)
    if full_scale == 1_000:
        limit = full_scale / exposure.time_share
        assert exposure.limit == pytest.approx(limit, rel=1e-5)
    assert (np.abs(exposure.means).max(axis=(0, 1)) < exposure.limit).all()


def test_the_choice_depends_on_light_only():
    """Not on noise, nor on whether saturated pixels are kept."""
    chosen = control((1.0, 0.01), continuous=True, bright_share=0.01)
    with_noise, _ = exposed(chosen, 0.5)
    without, _ = exposed(chosen, 0.5, noise=False, saturation=False)
    assert with_noise.time_share.max() < 0.7
    assert np.array_equal(with_noise.time_share, without.time_share)


def test_a_unit_states_the_mean_exposure_of_its_own_pixels():
    """Not of the margin for the filter's window. The plane comes nearer to the right, so that the
    columns there take the shorter exposure."""
    unit = unit_with(control((1.0, 0.25)), 0.604, slope_x=-0.5)
    shares = unit.exposure.time_share.reshape(unit.exposure.shape)
    assert 0.3 < unit.exposure_share < 0.9
    assert unit.exposure_share == pytest.approx(shares[unit.cut].mean())
    assert unit.exposure_share != pytest.approx(shares.mean(), rel=1e-3)
    assert unit_before_plane(load_camera("realsense_l515"), 0.4, 0.9).exposure_share == 1.0


@pytest.mark.parametrize("name", CONTROLLED)
def test_a_camera_at_its_calibration_point_takes_the_longest_exposure(name):
    camera = load_camera(name)
    photons = camera.photons
    place = (photons.calibration_distance_m.value, photons.calibration_albedo.value)
    exposure = unit_before_plane(camera, *place).exposure
    fixed = unit_before_plane(camera.model_copy(update={"exposures": None}), *place).exposure
    assert (exposure.time_share == 1).all()
    for part, fixed_part in zip(exposure, fixed, strict=True):
        assert np.array_equal(part, fixed_part)


def reasons_near(camera: AmcwCamera, albedo: float) -> np.ndarray:
    """The reasons (h, w) of a frame of a plane 4 % beyond the camera's least range, because noise
    carries some pixels below it."""
    unit = unit_before_plane(camera, 1.04 * camera.optics.nearest_m, albedo)
    effects = unit.config.effects.model_copy(update={"saturation": True})
    config = unit.config.model_copy(update={"effects": effects})
    capture = SimulatedUnit(camera, config, unit.view).capture(1, 1)
    return next(iter(capture.frames())).reason


@pytest.mark.parametrize("albedo", [0.1, 0.95])
@pytest.mark.parametrize(
    "name",
    [*CONTROLLED, "lucid_helios2plus_1250", "lucid_helios2plus_5000"],
)
def test_cameras_work_from_the_least_range_that_their_makers_state(name, albedo):
    reasons = reasons_near(load_camera(name), albedo)
    assert (reasons == Reason.VALID).mean() > 0.95


@pytest.mark.parametrize("name", CONTROLLED)
def test_without_exposure_control_these_cameras_are_blinded(name):
    camera = load_camera(name).model_copy(update={"exposures": None})
    assert (reasons_near(camera, 0.95) == Reason.SATURATED).all()
