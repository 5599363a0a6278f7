"""Every effect of a real unit, on against off: the right amount when on, nothing when off."""

from __future__ import annotations

import dataclasses
from itertools import islice

import numpy as np
import pytest
from scipy import stats

from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR, Reason, Region
from scenes.closed_form import plane_view
from scenes.sensor.amcw.imager import AmcwImager, with_harmonics
from scenes.sensor.camera import camera_of, load_camera
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig, EffectsConfig
from scenes.sensor.common.unit import frame_errors_m, smooth_field
from scenes.sensor.source import SimulatedUnit
from tests.support.sensor_frames import first_frame, stretch_of, true_z_m, z_of

AZURE = "azure_kinect_nfov"
V2 = "kinect_v2"
NEAR_AXIS = Region(180, 230, 220, 290)
FINE = {
    "engine.output_step_mm": 1e-3,
    "photons.electrons_per_unit": 0.01,
    "converter.knee_units": 10**8,
    "converter.full_scale_units": 10**8,
}
"""A converter and an output whose rounding hides nothing; the wells overflow as ever."""


def config(
    camera: str = AZURE, numbers: dict | None = None, fine: bool = True, **effects: bool
) -> CameraConfig:
    """A camera with only the given effects on."""
    return CameraConfig(
        name=camera,
        effects=NO_EFFECTS.model_copy(update=effects),
        numbers=(FINE if fine else {}) | (numbers or {}),
        minutes_since_power_on=5.0,
    )


def unit_of(
    settings: CameraConfig, distance_m: float = 0.9, albedo: float = 0.6, **changes
) -> SimulatedUnit:
    camera = camera_of(settings)
    view = plane_view(
        camera,
        NEAR_AXIS,
        distance_m,
        albedo,
        0.05,
        0.02,
    )
    return SimulatedUnit(camera, settings, dataclasses.replace(view, **changes))


def detour(view) -> np.ndarray:
    """The view's light with a tenth more that came 0.3 m further."""
    frequencies_hz = np.array(view.frequencies_hz)[:, None, None]
    phase = 2 * np.pi * frequencies_hz * 0.3 / SPEED_OF_LIGHT_AIR
    return view.phasor * (1 + 0.1 * np.exp(1j * phase))


# ---------------------------------------------------------------- all of them


@pytest.mark.parametrize("camera", [AZURE, V2])
def test_without_effects_a_camera_sees_the_truth(camera):
    unit = unit_of(config(camera))
    truth = true_z_m(unit)
    z = z_of(unit, 2)
    assert np.array_equal(z[0], z[1])
    # the window makes up to a hundredth of a millimetre of the plane's perspective
    assert np.abs(z[0] - truth).max() < 0.02e-3


@pytest.mark.parametrize(
    ("effect", "numbers"),
    [
        ("noise", {"photons.read_noise_electrons": 300.0}),
        ("wiggling", {"modulation.wiggling_residual": [1.0, 1.0, 1.0]}),
        ("fixed_pattern", {"fixed_pattern.pixel_mm": 10.0}),
        ("unit_offset", {"unit.offset_mm": 30.0}),
        ("warm_up_drift", {"unit.drift_mm": 50.0}),
        ("saturation", {"converter.full_scale_units": 6400}),
        ("frame_jumps", {"unit.jitter_mm": 5.0}),
    ],
)
def test_an_effect_that_is_off_is_exactly_absent(effect, numbers):
    """Off, its numbers change no bit of any frame; on, they do. All other effects are on."""
    all_on = dict.fromkeys(EffectsConfig.model_fields, True)

    def three_frames(numbers: dict, switch: bool) -> np.ndarray:
        settings = config(numbers=numbers, **(all_on | {effect: switch}))
        return z_of(unit_of(settings), 3)

    plain_off = three_frames({}, False)
    changed_off = three_frames(numbers, False)
    assert np.array_equal(plain_off, changed_off, equal_nan=True)
    plain_on = three_frames({}, True)
    changed_on = three_frames(numbers, True)
    assert not np.array_equal(plain_on, changed_on, equal_nan=True)


def test_ambient_and_multipath_that_are_off_are_exactly_absent():
    all_on = dict.fromkeys(EffectsConfig.model_fields, True)
    settings = config(**(all_on | {"ambient": False}))
    dark = settings.model_copy(update={"ambient_uw_cm2_nm": 0.0})
    bright = settings.model_copy(update={"ambient_uw_cm2_nm": 50.0})
    assert np.array_equal(z_of(unit_of(dark)), z_of(unit_of(bright)))
    settings = config(**(all_on | {"multipath": False}))
    plain = unit_of(settings)
    with_detour = unit_of(settings, phasor=detour(plain.view))
    assert np.array_equal(z_of(plain), z_of(with_detour))


def test_noise_keeps_its_draws_when_another_effect_is_switched():
    """So that what an effect costs is its difference and not another draw."""
    with_offset = z_of(unit_of(config(noise=True, unit_offset=True)), 4)
    without = z_of(unit_of(config(noise=True, unit_offset=False)), 4)
    assert (with_offset - without).std() < 0.1 * without.std(axis=0).mean()


# ---------------------------------------------------------------- wiggling


def triangle(phase: np.ndarray) -> np.ndarray:
    """Correlation of a square wave with a square wave."""
    t = (phase / (2 * np.pi)) % 1
    return np.where(t < 0.5, 1 - 4 * t, 4 * t - 3)


@pytest.mark.parametrize(
    ("phases", "most_mrad"),
    [
        (3, 19.5),
        (4, 71.1),
        (5, 4.06),
    ],
)
def test_harmonics_are_those_of_a_triangle_seen_at_n_phases(phases, most_mrad):
    phase = np.linspace(0, 2 * np.pi, 5001)[None, None]
    steps = 2 * np.pi * np.arange(phases) / phases
    sampled = np.zeros(phase.shape, complex)
    for step in steps:
        sampled += triangle(phase - step) * np.exp(1j * step)
    error = np.angle(sampled * np.exp(-1j * phase))
    harmonics = with_harmonics(np.exp(1j * phase), phases, np.ones(1))
    by_series = np.angle(harmonics * np.exp(-1j * phase))
    # what the series leaves out at the triangle's corners
    assert np.abs(by_series - error).max() < 0.6e-3
    assert np.abs(error).max() * 1e3 == pytest.approx(most_mrad, abs=0.05)


@pytest.mark.parametrize("camera", [AZURE, V2])
def test_wiggling_is_the_weighted_sum_of_its_frequencies(camera):
    """In depth: the sum of metres per turn times the share that is left times each frequency's
    error of phase."""
    for distance_m in (0.62, 0.85, 1.31):
        unit = unit_of(config(camera, wiggling=True), distance_m)
        slopes = unit.view.slopes[unit.cut]
        imager = AmcwImager(unit.camera, unit.config, unit.region, slopes)
        shares = np.array(unit.camera.modulation.wiggling_residual.value)
        light = unit.view.phasor
        wiggled_light = with_harmonics(light, 3, shares)
        turns = np.angle(wiggled_light * light.conj()) / (2 * np.pi)
        expected = np.einsum("f,fhw->hw", imager.unwrap.metres_per_turn, turns)[unit.cut]
        plain = unit_of(config(camera), distance_m)
        wiggled = z_of(unit)[0] - z_of(plain)[0]
        # along the axis, and averaged over the filter's window
        assert np.abs(wiggled - expected / stretch_of(unit)).max() < 0.06e-3


def test_wiggling_of_a_kinect_v2_has_the_published_size_and_period():
    """16 MHz alone and uncorrected: 2.2 mm, six periods in half a wavelength: 1561 mm."""
    camera = load_camera(V2)
    distance_m = np.linspace(0.5, 4.5, 4001)
    phase = 4 * np.pi * camera.frequencies_hz[1] * distance_m / SPEED_OF_LIGHT_AIR
    light = np.exp(1j * phase)
    wiggled = with_harmonics(light[None, None], 3, np.ones(1))[0, 0]
    error_mm = np.angle(wiggled * light.conj()) / (2 * np.pi) * 694.0
    assert np.abs(error_mm).max() == pytest.approx(2.15, abs=0.05)
    rises = (error_mm[1:] >= 0) & (error_mm[:-1] < 0)
    crossings = distance_m[1:][rises]
    assert np.diff(crossings) == pytest.approx(1.561, abs=0.002)


# ---------------------------------------------------------------- errors of a unit and of a frame


def test_unit_offset_is_drawn_once_for_a_unit():
    """24 units scatter by the file's deviation: chi-square at alpha 0.001."""
    plain = unit_of(config())
    nominal = z_of(plain)[0]
    offsets_mm = []
    for seed in range(24):
        settings = config(unit_offset=True).model_copy(update={"unit_seed": seed})
        shift_m = z_of(unit_of(settings))[0] - nominal
        shift_mm = shift_m * stretch_of(plain) * 1e3
        assert np.ptp(shift_mm) < 0.02
        offsets_mm.append(shift_mm.mean())
    sigma = load_camera(AZURE).unit.offset_mm.value
    statistic = (np.array(offsets_mm) ** 2).sum() / sigma**2
    assert stats.chi2.ppf(0.0005, 24) < statistic < stats.chi2.ppf(0.9995, 24)


@pytest.mark.parametrize("minutes", [0.0, 20.0, 60.0])
def test_drift_decays_and_tilts(minutes):
    facts = load_camera(AZURE).unit
    settings = config(warm_up_drift=True).model_copy(update={"minutes_since_power_on": minutes})
    unit = unit_of(settings)
    still = unit_of(config())
    shift_mm = (z_of(unit)[0] - z_of(still)[0]) * 1e3
    ramp = 1 + 0.5 * unit.view.slopes[unit.cut][..., 0]
    expected = 2.0 * np.exp(-minutes / 20.0) * ramp / stretch_of(unit)
    assert facts.drift_mm.value == 2.0
    assert facts.drift_min.value == 20.0
    assert facts.drift_ramp.value == 0.5
    assert np.abs(shift_mm - expected).max() < 0.02


def test_frames_jitter_and_jump_as_a_whole():
    """Jitter by chi-square at alpha 0.001; of 300 frames, jumps as many as a binomial's 99.9 %
    interval allows."""
    # a jitter of 0.25 mm at this view's light: the converter of `FINE` has units of its own
    still = unit_of(config())
    sums = still.model.amplitude_sums(still.exposure)
    numbers = {"unit.jump_rate": 0.05, "unit.jitter_at_units": float(np.median(sums))}
    unit = unit_of(config(frame_jumps=True, numbers=numbers))
    z = z_of(unit, 300)
    shift_mm = (z - z_of(still)[0]) * stretch_of(unit) * 1e3
    assert np.ptp(shift_mm, axis=(1, 2)).max() < 0.05
    mean_mm = shift_mm.mean(axis=(1, 2))
    jumped = np.abs(mean_mm) > 10
    assert np.abs(mean_mm[jumped]) == pytest.approx(17.0, abs=1.5)
    fewest, most_jumps = stats.binom.ppf([0.0005, 0.9995], 300, 0.05)
    assert fewest <= jumped.sum() <= most_jumps
    statistic = (mean_mm[~jumped] ** 2).sum() / 0.25**2
    calm = (~jumped).sum()
    assert stats.chi2.ppf(0.0005, calm) < statistic < stats.chi2.ppf(0.9995, calm)


# ---------------------------------------------------------------- light


def test_ambient_electrons_by_hand():
    """Of the emitter's own electrons at 1 m, 2.2 uW/cm2/nm x 20 nm = 0.44 W/m2 by 4 W/m2 is 0.11,
    times the albedo."""
    settings = config(ambient=True).model_copy(update={"ambient_uw_cm2_nm": 2.2})
    for distance_m in (0.7, 2.8):
        unit = unit_of(settings, distance_m, albedo=0.5)
        electrons = (
            unit.model.ambient_electrons(unit.view, unit.view.intensity) / unit.model.gathered
        )
        at_1m = unit.camera.photons.signal_electrons.value
        # 0.998: the plane leans by 3 degrees; 5 %: seen up to 6 degrees more aslant, from an
        # emitter beside the lens
        assert electrons == pytest.approx(0.11 * 0.5 * at_1m * 0.998, rel=0.05)


def test_ambient_adds_its_shot_noise():
    """At 2 m and 2.2 uW/cm2/nm the surroundings give 0.11 x 2^2 of the own light: variances in
    that ratio."""
    light = {"ambient_uw_cm2_nm": 2.2}
    dark_settings = config(V2, noise=True, ambient=False).model_copy(update=light)
    quiet = z_of(unit_of(dark_settings, 2.0), 120)
    bright_settings = config(V2, noise=True, ambient=True).model_copy(update=light)
    bright = z_of(unit_of(bright_settings, 2.0), 120)
    photons = load_camera(V2).photons
    electrons = photons.signal_electrons.value * 0.6 / 2.0**2
    noise = electrons + 2 * photons.read_noise_electrons.value**2
    expected = np.sqrt((noise + electrons * 0.11 * 2.0**2) / noise)
    ratio = bright.std(axis=0).mean() / quiet.std(axis=0).mean()
    assert ratio == pytest.approx(expected, rel=0.02)


def test_sunlight_fills_the_wells():
    """150 uW/cm2/nm are 7.5 times the emitter's light at 1 m: 7,900 electrons on a surface of 0.9,
    beside the 6,000 of its own light at 0.42 m, leave 2,100 of the wells' 16,000 for samples of up
    to 0.87 x 6,000."""
    sun = {"ambient_uw_cm2_nm": 150.0}
    for saturation, expected in ((True, Reason.SATURATED), (False, Reason.VALID)):
        settings = config(AZURE, ambient=True, saturation=saturation).model_copy(update=sun)
        frame = first_frame(unit_of(settings, 0.42, albedo=0.9))
        assert (frame.reason == expected).all()
    in_a_room = config(AZURE, ambient=True, saturation=True)
    assert np.isfinite(z_of(unit_of(in_a_room, 0.42, albedo=0.9))).all()


def test_near_bright_surfaces_saturate():
    """White ones do below the least distance of use (0.5 m) and not from it on; with the effect
    off none does."""
    numbers = {"engine.min_range_mm": 50.0}
    with_effect = config(AZURE, numbers, fine=False, saturation=True)
    close = unit_of(with_effect, 0.14, albedo=1.0)
    frame = first_frame(close)
    assert (frame.reason == Reason.SATURATED).all()
    without_effect = config(AZURE, numbers, fine=False)
    assert np.isfinite(z_of(unit_of(without_effect, 0.14, albedo=1.0))).all()
    in_use = config(AZURE, fine=False, saturation=True)
    assert np.isfinite(z_of(unit_of(in_use, 0.53, albedo=0.95))).all()


def test_an_exposure_that_ends_early_has_the_noise_of_what_it_holds():
    """A white surface at 1 m would give a Kinect v2 14,000 electrons; the exposure ends at 5,700
    of them, so samples keep their size and scatter as if there were so many, and both wells' read
    noise grows as the scale does."""
    photons = load_camera(V2).photons
    for distance_m in (1.0, 2.5):
        unit = unit_of(config(V2, noise=True), distance_m, albedo=1.0)
        intensity = unit.view.intensity
        middle_row = intensity[len(intensity) // 2]
        electrons = photons.signal_electrons.value * middle_row.mean()
        share = min(1.0, photons.exposure_ends_electrons.value / electrons)
        read_noise = photons.read_noise_electrons.value / share
        expected = np.sqrt(electrons / share + 2 * read_noise**2)
        sigma = unit.exposure.sigma.reshape(unit.exposure.shape)
        middle = sigma[len(sigma) // 2].mean()
        assert (share < 1) == (distance_m == 1.0)
        per_unit = unit.camera.photons.electrons_per_unit.value
        assert middle * per_unit == pytest.approx(expected, rel=0.01)


def test_multipath_off_sees_the_direct_light_only():
    settings = config(multipath=True)
    plain = unit_of(settings)
    lit = {"phasor": detour(plain.view), "intensity": plain.view.intensity * 1.1}
    lengthened = z_of(unit_of(settings, **lit))[0] - z_of(plain)[0]
    # a tenth of the light on a way that is 0.15 m longer, one way, at most; less as the filter's
    # phasor is no mean
    assert 2e-3 < lengthened.mean() < 15e-3
    assert np.array_equal(z_of(unit_of(config(), **lit)), z_of(plain))
    # and its photons are the direct light's alone
    dim = unit_of(config(noise=True, multipath=False), **lit).exposure.sigma
    bright = unit_of(config(noise=True, multipath=True), **lit).exposure.sigma
    plain_sigma = unit_of(config(noise=True, multipath=True)).exposure.sigma
    assert dim == pytest.approx(plain_sigma, rel=1e-5)
    assert (bright**2 / dim**2).mean() == pytest.approx(1.1, abs=0.01)


def test_the_scanner_is_rid_of_all_indirect_light_too():
    """Twice the light by multipath: with the effect off, noise and saturation are those of the
    direct part alone."""
    settings = config("realsense_l515", fine=False, noise=True)
    plain = unit_of(settings)
    twice = {"phasor": 2 * plain.view.phasor, "intensity": 2 * plain.view.intensity}
    lit = unit_of(settings, **twice)
    assert np.allclose(lit.exposure.noise, plain.exposure.noise, rtol=1e-6)
    with_multipath = config("realsense_l515", fine=False, noise=True, multipath=True)
    noisy = unit_of(with_multipath, **twice)
    assert (noisy.exposure.noise > 1.1 * plain.exposure.noise).all()


def test_saturated_neighbours_do_not_count():
    """Beside a saturated half of the picture at the same distance a pixel keeps its range and its
    amplitude."""
    sharp = {"scatter.blur_px": 0.0}
    settings = config(numbers=sharp, saturation=True, multipath=True)
    plain = unit_of(settings)
    columns = np.arange(plain.view.intensity.shape[1])
    bright = np.where(columns < 30, 1.0, 2000.0)
    unit = unit_of(
        settings, phasor=plain.view.phasor * bright, intensity=plain.view.intensity * bright
    )
    frame = first_frame(unit)
    plain_frame = first_frame(plain)
    dark = slice(0, 30 - (unit.region.col0 - unit.view.region.col0))
    assert (frame.reason[:, dark.stop :] == Reason.SATURATED).all()
    assert (frame.reason[:, dark] == Reason.VALID).all()
    # the plane is tilted: half a window has its middle a pixel aside, 0.1 mm in z
    assert np.allclose(frame.z_m[:, dark], plain_frame.z_m[:, dark], atol=2e-4)
    assert np.allclose(frame.amplitude[:, dark], plain_frame.amplitude[:, dark], rtol=0.01)


def test_ambient_light_of_a_mixed_pixel_is_that_of_its_nearest_surface():
    """A rim at 0.7 m whose central ray passes to 2.5 m has half its neighbours' ambient light, not
    (2.5/0.7)^2 / 2."""
    settings = config(ambient=True)
    plain = unit_of(settings, distance_m=0.7)
    range_m = plain.view.range_m.copy()
    coverage = plain.view.coverage.copy()
    intensity = plain.view.intensity.copy()
    range_m[20, 30] = 2.5
    coverage[20, 30] = 0.5
    intensity[20, 30] /= 2
    unit = unit_of(
        settings,
        distance_m=0.7,
        range_m=range_m,
        coverage=coverage,
        intensity=intensity,
    )
    light = unit.model.ambient_electrons(unit.view, intensity)
    assert light[20, 30] == pytest.approx(light[20, 31] / 2, rel=0.02)


def test_the_drift_goes_on_during_a_capture():
    """exp(-t / tau): 30 frames a second, so 900 frames are half a minute."""
    settings = config(numbers={"unit.drift_mm": 100.0, "unit.drift_ramp": 0.0}, warm_up_drift=True)
    facts = camera_of(settings).unit
    errors = frame_errors_m(
        facts, settings.effects, minutes=5.0, jitter_mm=0.0, rng=np.random.default_rng(1)
    )
    errors_m = list(islice(errors, 901))
    minutes = facts.drift_min.value
    wanted_m = 0.1 * (np.exp(-5.5 / minutes) - np.exp(-5.0 / minutes))
    assert errors_m[0] == 0.0
    assert errors_m[-1] == pytest.approx(wanted_m, rel=1e-6)


def test_jitter_is_inversely_proportional_to_the_light():
    """By hand: an albedo of 0.6 at 0.9 m gives 1168 electrons * 0.6 / 0.9^2 times the contrasts
    0.87, 0.88 and 0.96, at 1.4 electrons a unit."""
    settings = config(fine=False, frame_jumps=True)
    sum_units = 1168 * 0.6 / 0.9**2 * (0.87 + 0.88 + 0.96) / 1.4
    camera = camera_of(settings)
    on_axis = Region(328, 338, 317, 327)  # away from it, the lens gathers less
    on_axis_unit = SimulatedUnit(
        camera, settings, plane_view(camera, on_axis, 0.9, 0.6, slope_x=0.0, slope_y=0.0)
    )
    assert on_axis_unit.jitter_mm == pytest.approx(0.25 * 320 / sum_units, rel=0.02)
    unit = unit_of(settings)
    assert unit_of(settings, albedo=0.3).jitter_mm == pytest.approx(2 * unit.jitter_mm, rel=1e-5)
    # frames are displaced by it
    errors_m = unit.capture(3000, 1, "jitter").errors_m
    steady_m = errors_m[np.abs(errors_m) < 5e-3]
    assert steady_m.std() * 1e3 == pytest.approx(unit.jitter_mm, rel=0.05)


def test_jitter_of_a_dark_view_stays_finite():
    """Without light, a view counts as one that barely has ranges: a sum of 12 units."""
    unit = unit_of(config(fine=False, frame_jumps=True), albedo=1e-9)
    assert unit.jitter_mm == pytest.approx(0.25 * 320 / 12)


def test_jitter_of_other_cameras_is_the_same_in_any_light():
    assert unit_of(config(V2), albedo=0.1).jitter_mm == 0.25


@pytest.mark.parametrize("length_px", [0.4, 2.0, 12.0])
def test_smooth_fields_have_unit_variance_at_any_length(length_px):
    field = smooth_field(np.random.default_rng(3).standard_normal((600, 600)), length_px)
    # 360,000 pixels hold 360,000 / (4 pi (l^2 / 2)) independent ones: 400 at 12 px, whose
    # deviation is known to 3.5 %
    deviation = np.sqrt(2 * np.pi * length_px**2 / 720_000)
    assert field.std() == pytest.approx(1.0, abs=3 * max(0.002, deviation))
