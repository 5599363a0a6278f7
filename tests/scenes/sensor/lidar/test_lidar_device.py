"""The scanned lidar's returns, processing, effects, footprint and file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR, Reason, Region
from scenes.closed_form import Plane, layered_view, plane_view
from scenes.optics import NoiseFreeView
from scenes.sensor.calibration import ONLY_NOISE
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig, EffectsConfig
from scenes.sensor.lidar.scanner import LidarScanner, overlap_taps, smear_weights
from scenes.sensor.source import SimulatedUnit
from tests.support.lidar_footprint import hole_depth_seen_m, share_in_disc
from tests.support.lidar_units import CAMERA, FINE, PATCH, QUIET, RAW, changed, mixed
from tests.support.sensor_frames import first_frame, z_of

# ---------------------------------------------------------------- several returns in one beam


def two_returns(share: float, effects: EffectsConfig) -> tuple[SimulatedUnit, np.ndarray]:
    """A unit without smoothing whose beams see 1 m and, with ``share`` of equal light, 2 m; and
    its z."""
    camera = changed(RAW)
    front = plane_view(camera, PATCH, 1.0, 0.6)
    back = plane_view(camera, PATCH, 2.0, 2.4)
    config = QUIET.model_copy(update={"effects": effects})
    unit = SimulatedUnit(camera, config, mixed(front, back, share))
    return unit, z_of(unit, 20)


def test_the_stronger_of_two_returns_wins_and_equal_ones_flip():
    """Share of frames that show the far return: Phi((far - near) / (sqrt 2 noise)), to 4 sigma of
    60,000 draws that overlap along columns."""
    for share, quiet in ((0.4, 1.0), (0.6, 2.0)):
        _, z = two_returns(share, QUIET.effects)
        assert np.abs(z - quiet).max() < 5e-3
    for share in (0.5, 0.51, 0.52):
        unit, z = two_returns(share, ONLY_NOISE.effects)
        returns = unit.exposure
        order = np.where(returns.half_m[0] > 1.5, 1.0, -1.0)
        ahead = order * (returns.height[0] - returns.height[1])
        deviations = ahead / (np.sqrt(2) * returns.noise)
        far_share = float(stats.norm.cdf(deviations).mean())
        assert (z > 1.5).mean() == pytest.approx(far_share, abs=0.015)


def test_shot_noise_is_that_of_all_light_in_the_beam():
    """Of both returns, though their phasors partly cancel: sqrt(F S + a^2)."""
    unit, _ = two_returns(
        0.5, ONLY_NOISE.effects.model_copy(update={"ambient": False, "multipath": True})
    )
    photons = CAMERA.photons
    light = unit.model.gathered * unit.view.intensity
    expected = np.sqrt(
        photons.excess_noise_factor.value * light + photons.amplifier_electrons.value**2
    )
    assert unit.exposure.noise[unit.cut] == pytest.approx(expected[unit.cut], rel=1e-4)


def test_a_footprint_across_a_small_step_reads_between_by_light():
    """Returns 30 mm apart merge: a tenth of the pulse's 0.3 m, so the peak is their mean by light,
    within 2 %."""
    front = plane_view(CAMERA, PATCH, 1.0, 0.6)
    back = plane_view(CAMERA, PATCH, 1.03, 0.6 * 1.03**2)
    for share in (0.25, 0.5, 0.75):
        z = z_of(SimulatedUnit(CAMERA, QUIET, mixed(front, back, share)))
        assert (z - 1.0).mean() == pytest.approx(30e-3 * share, abs=0.6e-3)


def test_multipath_lengthens_range_and_its_switch_takes_it_away():
    direct = plane_view(CAMERA, PATCH, 1.0, 0.6)
    late = plane_view(CAMERA, PATCH, 1.1, 0.6)
    view = replace(
        direct,
        phasor=direct.phasor + 0.1 * late.phasor,
        intensity=direct.intensity + 0.1 * late.intensity,
    )
    without = NO_EFFECTS.model_copy(update={"saturation": True})
    direct_only = QUIET.model_copy(update={"effects": without})
    all_light_m = z_of(SimulatedUnit(CAMERA, QUIET, view)).mean()
    direct_m = z_of(SimulatedUnit(CAMERA, direct_only, view)).mean()
    assert direct_m == pytest.approx(1.0, abs=1e-5)
    # 8 % of the light 100 mm later, pulled in full while within the pulse: nearly 7.6 mm
    assert 4e-3 < all_light_m - direct_m < 8e-3


# ---------------------------------------------------------------- processing on the device


def stepped(step_m: float) -> NoiseFreeView:
    """The left half at 1 m, the right half farther, no beam across the edge."""
    front = plane_view(CAMERA, PATCH, 1.0, 0.6)
    back = plane_view(CAMERA, PATCH, 1.0 + step_m, 0.6)
    right_half = np.arange(PATCH.shape[1]) >= 30
    return mixed(front, back, right_half.astype(float))


def test_smoothing_keeps_a_step_of_30_mm_and_blurs_one_of_4_mm():
    kept = z_of(SimulatedUnit(CAMERA, QUIET, stepped(0.030)))[0]
    blurred = z_of(SimulatedUnit(CAMERA, QUIET, stepped(0.004)))[0]
    edge = 30 - CAMERA.optics.margin_px
    assert kept[:, edge - 1] == pytest.approx(1.0, abs=0.13e-3)
    assert kept[:, edge] == pytest.approx(1.030, abs=0.13e-3)
    taps = CAMERA.smoothing_taps[1]
    beyond = float(taps[len(taps) // 2 + 1 :].sum())
    assert blurred[:, edge - 1] == pytest.approx(1.0 + 4e-3 * beyond, abs=0.13e-3)
    assert blurred[:, edge] == pytest.approx(1.004 - 4e-3 * beyond, abs=0.13e-3)


def test_integration_smears_along_the_sweep_only():
    """A bright row in the dark: neighbours above and below get the hat's share of its light, those
    beside nothing."""
    view = plane_view(CAMERA, PATCH, 1.0, 0.6)
    row = (np.arange(PATCH.shape[0]) == 25).astype(float)[:, None]
    dark = replace(view, phasor=0 * view.phasor, intensity=0 * view.intensity)
    lit = mixed(dark, view, row)
    heights = SimulatedUnit(CAMERA, QUIET, lit).exposure.height[0]
    weights = smear_weights(CAMERA.integration_points)
    bright = SimulatedUnit(CAMERA, QUIET, view).exposure.height[0]
    shares = heights[24:27] / bright[24:27]
    expected = np.repeat(weights[:, None], 60, axis=1)
    assert shares == pytest.approx(expected, rel=1e-4)
    assert heights[23].max() <= 0
    assert heights[27].max() <= 0


@pytest.mark.parametrize(
    ("points", "weights"),
    [
        (1.0, [1 / 8, 6 / 8, 1 / 8]),
        (2.0, [1 / 4, 1 / 2, 1 / 4]),
        (1e-6, [0, 1, 0]),
    ],
)
def test_smear_weights_by_hand(points, weights):
    assert smear_weights(points) == pytest.approx(weights, abs=1e-5)


@settings(max_examples=30, deadline=None)
@given(points=st.floats(0.1, 3.0))
def test_overlapping_integrations_share_light_and_noise_as_their_overlap(points):
    assert smear_weights(points).sum() == pytest.approx(1)
    taps = overlap_taps(points)
    padded = np.append(taps, np.zeros(4))
    for lag in range(4):
        correlation = float((taps * padded[lag : lag + len(taps)]).sum())
        overlap = max(0.0, 1 - lag / points) if points > 1 else float(lag == 0)
        assert correlation == pytest.approx(overlap, abs=0.006)


def reasons_at(distance_m: float, albedo: float, config: CameraConfig = QUIET) -> set[Reason]:
    unit = SimulatedUnit(CAMERA, config, plane_view(CAMERA, PATCH, distance_m, albedo))
    frame = first_frame(unit)
    assert np.array_equal(np.isnan(frame.z_m), frame.reason != Reason.VALID)
    return {Reason(code) for code in np.unique(frame.reason)}


def test_each_gate_names_its_reason():
    assert reasons_at(0.8, 0.6) == {Reason.VALID}
    assert reasons_at(0.8, 0.0) == {Reason.LOW_AMPLITUDE}
    assert reasons_at(0.24, 0.5) == {Reason.OUT_OF_RANGE}
    assert reasons_at(0.24, 1.0) == {Reason.SATURATED}
    assert reasons_at(0.26, 0.95) == {Reason.VALID}
    blind = QUIET.model_copy(update={"effects": NO_EFFECTS})
    assert reasons_at(0.24, 1.0, blind) == {Reason.OUT_OF_RANGE}


def test_five_pixels_in_a_row_are_invalid_and_three_by_three_are_not():
    """They hold 0.08 and 0.15 of the weights; a tenth is asked for."""
    view = plane_view(CAMERA, PATCH, 1.0, 0.6)
    behind = plane_view(CAMERA, PATCH, 1.8, 1.9)
    share = np.zeros(PATCH.shape)
    share[20, 20:25] = share[30:33, 20:23] = 1.0
    camera = changed({"code.integration_ns": 1e-3})
    unit = SimulatedUnit(camera, QUIET, mixed(view, behind, share))
    frame = first_frame(unit)
    m = camera.optics.margin_px
    assert (frame.reason[20 - m, 20 - m : 25 - m] == Reason.EDGE).all()
    square = frame.z_m[30 - m : 33 - m, 20 - m : 23 - m]
    assert square == pytest.approx(1.8, abs=0.13e-3)
    assert (frame.reason != Reason.VALID).sum() == 5


def test_dark_beams_do_not_pass_for_returns():
    """Noise alone: maxima would have to agree, and to exceed the threshold in the mean over all
    neighbours. With both gates off they do pass."""
    unit = SimulatedUnit(CAMERA, ONLY_NOISE, plane_view(CAMERA, PATCH, 1.0, 0.0))
    assert not np.isfinite(z_of(unit, 20)).any()
    open_gates = {"engine.least_agreeing": 0.0, "engine.confidence_electrons": 0.0}
    z = z_of(SimulatedUnit(changed(open_gates), ONLY_NOISE, unit.view))
    assert np.isfinite(z).mean() > 0.9
    assert np.nanstd(z) > 1.0


# ---------------------------------------------------------------- units, effects, streams


def test_effects_that_are_off_are_absent():
    view = plane_view(
        CAMERA,
        PATCH,
        0.8,
        0.6,
        0.05,
        0.02,
    )
    quiet = CameraConfig(name=CAMERA.name, effects=NO_EFFECTS)
    z = z_of(SimulatedUnit(CAMERA, quiet, view), 3)
    assert np.array_equal(z[0], z[1])
    assert np.array_equal(z[0], z[2])
    for name in EffectsConfig.model_fields:
        effects = NO_EFFECTS.model_copy(update={name: True})
        config = CameraConfig(name=CAMERA.name, effects=effects)
        with_effect = z_of(SimulatedUnit(CAMERA, config, view))
        # nothing to saturate, no other path, no noise to add to, no harmonics
        silent = name in ("multipath", "wiggling", "ambient", "saturation")
        assert np.array_equal(with_effect[0], z[0]) == silent, name


@pytest.mark.parametrize(
    ("effects", "is_saturated"),
    [
        ({"saturation": True, "ambient": True}, True),
        ({"saturation": True}, False),
        ({"ambient": True}, False),
    ],
)
def test_a_beam_is_saturated_by_its_light_and_the_ambient_together(
    effects: dict[str, bool], is_saturated: bool
) -> None:
    """The limit lies above the light that returns, by half of the ambient light."""
    config = CameraConfig(
        name=CAMERA.name,
        effects=NO_EFFECTS.model_copy(update=effects),
        ambient_uw_cm2_nm=1.0,
    )
    view = plane_view(CAMERA, PATCH, 1.0, 0.6)
    unit = SimulatedUnit(CAMERA, config, view)
    signal = (unit.model.gathered * view.intensity).max()
    ambient = CAMERA.ambient_electrons(1.0)
    limited = changed({"photons.full_scale_electrons": float(signal + 0.5 * ambient)})
    frame = first_frame(SimulatedUnit(limited, config, view))
    assert (frame.reason == Reason.SATURATED).all() == is_saturated
    assert (frame.reason == Reason.SATURATED).any() == is_saturated


def test_the_way_back_to_the_receiver_beside_the_transmitter_is_in_the_range():
    """At 0.3 m the way back is longer by 0.7 mm to a receiver 20 mm aside."""
    assert np.linalg.norm(CAMERA.optics.emitter_m) == pytest.approx(0.02)
    camera = changed(FINE)
    z_m = z_of(SimulatedUnit(camera, QUIET, plane_view(camera, PATCH, 0.3, 0.6)))
    assert np.abs(z_m - 0.3).max() < 2e-5


def test_a_peak_of_noise_is_as_uncertain_as_a_delay_in_white_noise():
    """Cramer and Rao's bound: half of what light travels in 1 / bandwidth, over the peak's height
    in deviations of the noise."""
    camera = changed(RAW)
    dark = plane_view(camera, PATCH, 1.0, 0.0)
    unit = SimulatedUnit(camera, ONLY_NOISE.model_copy(update={"name": camera.name}), dark)
    scanner = unit.model
    _, height, deviation_m = scanner._noisy_peaks(unit.exposure, np.random.default_rng(1))
    level = height / (scanner.averaged * unit.exposure.noise)
    is_high = level > 1.0
    assert is_high.mean() > 0.5
    bound_m = SPEED_OF_LIGHT_AIR / 2 / camera.bandwidth_rad_s
    assert (deviation_m * level)[is_high] == pytest.approx(bound_m, rel=1e-4)


def test_ripples_have_the_size_and_length_of_their_facts():
    lens = CAMERA.nominal_lens
    only = NO_EFFECTS.model_copy(update={"fixed_pattern": True})
    config = CameraConfig(name=CAMERA.name, unit_seed=4, effects=only)
    ripples = LidarScanner(
        CAMERA, config, lens.whole, lens.region_slopes(lens.whole)
    ).static_error_m
    size = CAMERA.fixed_pattern.smooth_mm.value * 1e-3
    length = CAMERA.fixed_pattern.smooth_length_px.value
    # some 2,700 independent patches: 1.4 % at one sigma
    assert ripples.std() == pytest.approx(size, rel=0.05)
    for lag in (6, 12, 24):
        products = ripples[lag:] * ripples[:-lag]
        expected = np.exp(-(lag**2) / (2 * length**2))
        assert products.mean() / ripples.var() == pytest.approx(expected, abs=0.05)
    part = LidarScanner(CAMERA, config, PATCH, lens.region_slopes(PATCH)).static_error_m
    assert np.array_equal(part, ripples[PATCH.within(lens.whole)])


def test_shorter_captures_are_prefixes_and_streams_are_repeatable():
    unit = SimulatedUnit(
        CAMERA, CameraConfig(name=CAMERA.name), plane_view(CAMERA, PATCH, 3.5, 0.5)
    )
    long = z_of(unit, 4)
    short = z_of(unit, 2)
    assert np.array_equal(long[:2], short, equal_nan=True)
    assert not np.array_equal(long[0], long[1], equal_nan=True)
    assert not np.array_equal(z_of(unit, 1, seed=2)[0], long[0], equal_nan=True)


def test_single_precision_views_change_nothing_that_counts():
    view = plane_view(
        CAMERA,
        PATCH,
        0.8,
        0.6,
        0.05,
        0.02,
    )
    phasor = view.phasor.astype(np.complex64)
    intensity = view.intensity.astype(np.float32)
    single = replace(view, phasor=phasor, intensity=intensity)
    a = SimulatedUnit(CAMERA, QUIET, view).exposure.half_m[0]
    b = SimulatedUnit(CAMERA, QUIET, single).exposure.half_m[0]
    assert np.abs(a - b).max() < 2e-6


# ---------------------------------------------------------------- the beam's footprint


@pytest.mark.parametrize("fwhm_mrad", [0.7, 1.37, 2.0])
def test_share_of_a_resting_beam_is_the_gaussians(fwhm_mrad):
    """1 - 2^-(D / w)^2 for a disc of diameter D under a round Gaussian of full width w, without
    the smear."""
    camera = changed({"beam.fwhm_mrad": fwhm_mrad, "code.integration_ns": 1e-6})
    expected = 1 - 2 ** -((3.2 / (fwhm_mrad * 0.75)) ** 2)
    assert share_in_disc(camera, 3.2e-3, 0.75) == pytest.approx(expected, rel=1e-6)


def test_wider_beams_see_small_holes_shallower():
    """A blind hole of 3/32 in, 5 mm deep, at 1 m, in beams of the nuisance range; a large one does
    not care."""
    widths = (0.7, 1.37, 2.0)
    small = [hole_depth_seen_m(changed({"beam.fwhm_mrad": w}), 2.4e-3, 5e-3, 1.0) for w in widths]
    large = [hole_depth_seen_m(changed({"beam.fwhm_mrad": w}), 25e-3, 5e-3, 1.0) for w in widths]
    assert 5e-3 > small[0] > small[1] > small[2] > 0
    assert small[2] < 0.75 * small[0]
    assert large == pytest.approx([5e-3] * 3, rel=1e-3)


def test_the_closed_form_hole_is_the_one_of_a_sampled_view():
    """At the hole's centre, through sub-rays, smear and peak; to 5 % (100 sub-rays). The receiver
    stands in the beam, so that the rim throws no shadow."""
    camera = changed({"receiver.position_mm": [0.0, 0.0, 0.0], **RAW, **FINE})
    lens = camera.nominal_lens
    region = Region(396, 411, 520, 537)
    centre = lens.slopes(np.array(528), np.array(403))

    def covers(slopes: np.ndarray) -> np.ndarray:
        distance2 = ((slopes - centre) ** 2).sum(axis=-1)
        return np.asarray(distance2 > (1.6e-3 / 0.75) ** 2)

    view = layered_view(
        camera,
        region,
        Plane(0.75),
        Plane(0.755),
        covers,
        0.6,
    )
    half_m = SimulatedUnit(camera, QUIET, view).exposure.half_m[0]
    depth_m = half_m[403 - 396, 528 - 520] - half_m[0, 528 - 520]
    assert depth_m == pytest.approx(hole_depth_seen_m(camera, 3.2e-3, 5e-3, 0.75), rel=0.05)


# ---------------------------------------------------------------- the file


@pytest.mark.parametrize(
    ("numbers", "wanted"),
    [
        ({"code.integration_ns": 200.0}, "at most three times scan.point_ns"),
        ({"code.band_floor": 1.0}, "code.band_floor must be above 0 and below 1"),
        ({"code.period_ns": 2.0}, "code.period_ns must be longer"),
        (
            {"receiver.cutoff_half_angle_deg": 30.0},
            "cutoff_half_angle_deg must be above full_half_angle_deg",
        ),
        ({"engine.min_range_mm": 2e4}, "engine.min_range_mm must lie within"),
        ({"beam.fwhm_mrad": 0.0}, "must be above 0"),
        ({"beam.fwhm_mrad": 300.0}, "at most 20 milliradians"),
        ({"photons.excess_noise_factor": 0.1}, "1 or more"),
        ({"beam.fwhm": 1.0}, "did you mean 'beam.fwhm_mrad'"),
    ],
)
def test_impossible_numbers_are_refused(numbers, wanted):
    with pytest.raises(UserError, match=wanted):
        changed(numbers)


def test_the_comb_spans_the_pulse_and_the_range():
    optics = CAMERA.optics
    spacing = np.diff([0.0, *optics.frequencies_hz])
    assert spacing == pytest.approx(1 / 64e-9)
    assert optics.nearest_m == 0.25
    assert optics.farthest_m > 6.5
    # the next line would be below the floor
    before_last, last = CAMERA.weights[-2:]
    assert last > 0.03
    assert last * (last / before_last) < 0.03
    twice = changed({"code.correlation_fwhm_ns": 1.0})
    assert len(twice.weights) == pytest.approx(2 * len(CAMERA.weights), abs=1)
