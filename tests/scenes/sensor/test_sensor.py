"""The continuous-wave imager against closed forms and brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR, Reason, Region
from harness.vocabulary.seeds import random_stream
from scenes.closed_form import plane_view
from scenes.sensor.amcw import kernels, ranging
from scenes.sensor.amcw.facts import unwrap_table
from scenes.sensor.amcw.filter_reference import filtered_pixel
from scenes.sensor.amcw.imager import AmcwImager
from scenes.sensor.calibration import calibrated_signal_electrons, temporal_sigma_m, with_number
from scenes.sensor.camera import camera_of, load_camera
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.common.normals import (
    BLOCK,
    LANES,
    fill_words,
    normals_from_words,
    standard_normals,
)
from scenes.sensor.source import SimulatedUnit
from tests.support.sensor_frames import correlation, first_frame, noise_of, true_z_m, z_of

f4 = np.float32
CAMERA = load_camera("azure_kinect_nfov")
NEAR_AXIS = Region(300, 360, 280, 360)
QUIET = CameraConfig(effects=NO_EFFECTS.model_copy(update={"multipath": True, "saturation": True}))
CLEAN = CameraConfig(effects=QUIET.effects.model_copy(update={"noise": True, "ambient": True}))


def unit_at(
    distance_m: float, albedo: float = 0.6, config: CameraConfig = CLEAN, region: Region = NEAR_AXIS
):
    return SimulatedUnit(
        CAMERA,
        config,
        plane_view(
            CAMERA,
            region,
            distance_m,
            albedo,
            0.05,
            0.02,
        ),
    )


def test_noise_free_range_is_exact_up_to_rounding():
    # a converter whose rounding no noise hides would add a fifth of a millimetre
    config = QUIET.model_copy(update={"numbers": {"converter.knee_units": 10**6}})
    fine = camera_of(config)
    unit = SimulatedUnit(
        fine,
        config,
        plane_view(
            fine,
            NEAR_AXIS,
            0.7,
            0.6,
            0.05,
            0.02,
        ),
    )
    truth = true_z_m(unit)
    z = z_of(unit, 1)[0]
    assert np.isfinite(z).all()
    # half a millimetre of rounding, and what a 5x5 window makes of the plane's perspective
    # curvature
    assert np.abs(z - truth).max() < 0.5e-3 + 0.05e-3


def test_output_is_whole_millimetres():
    z = z_of(unit_at(0.9), 1)
    assert np.abs(z * 1000 - np.round(z * 1000)).max() < 1e-3


def test_gain_meets_the_calibration_point():
    electrons = calibrated_signal_electrons(CAMERA, frames=60, seed=5)
    assert CAMERA.photons.signal_electrons.value == pytest.approx(electrons, rel=0.03)
    sigma_m = temporal_sigma_m(
        CAMERA,
        1.5,
        0.8,
        100,
        seed=6,
    )
    assert np.hypot(sigma_m, 1e-3 * CAMERA.unit.jitter_mm.value) == pytest.approx(0.89e-3, rel=0.02)


def test_phase_noise_follows_the_closed_form():
    """sigma_phi = sqrt(2/N) sqrt(Ns + 2 s^2) / (C Ns), before the filter, for each frequency."""
    view = plane_view(CAMERA, NEAR_AXIS, 1.0, 0.6)
    imager = AmcwImager(CAMERA, CLEAN, NEAR_AXIS, view.slopes)
    exposure = imager.expose(view)
    light = view.phasor.reshape(3, -1)
    phases = []
    rng = random_stream(3)
    for _ in range(60):
        unit = imager.reading(exposure, rng).unit
        phases.append(np.angle((unit[0] + 1j * unit[1]) * light.conj()))
    measured = np.std(phases, axis=0, ddof=1)
    electrons = CAMERA.photons.signal_electrons.value * view.intensity.ravel()
    for f, contrast in enumerate(CAMERA.modulation.contrast.value):
        noise = np.sqrt(electrons + 2 * 3.2**2)
        expected = np.sqrt(2 / 3) * noise / (contrast * electrons)
        ratio = np.sqrt((measured[f] ** 2).mean() / (expected**2).mean())
        assert ratio == pytest.approx(1, abs=0.015)


def expose(
    means,
    sigma,
    normals,
    knee=256.0,
    limit=32704.0,
    gains=(1.0,),
):
    """`kernels.expose` on (f, k, n) samples: unit phasors (2, f, n), amplitudes (f, n), saturated
    (n,)."""
    f, k, n = means.shape
    steps = 2 * np.pi * np.arange(k) / k
    unit = np.empty((2, f, n), f4)
    amplitude = np.empty((f, n), f4)
    saturated = np.empty(n, np.uint8)
    limits = np.full(n, limit, f4)
    kernels.expose(
        means,
        sigma,
        limits,
        normals,
        f4(knee),
        np.array(gains, f4),
        np.cos(steps).astype(f4),
        np.sin(steps).astype(f4),
        unit,
        amplitude,
        saturated,
    )
    return unit, amplitude, saturated


def test_normals_are_normal():
    """Kolmogorov-Smirnov at alpha 0.001 on 200,000 draws, against the transform in double
    precision, and the tails."""
    bits = np.random.default_rng(8).integers(0, 2**32, 200_000, dtype=np.uint32)
    out = np.empty(200_000, f4)
    normals_from_words(bits[:100_000], bits[100_000:], out[:100_000], out[100_000:])
    u = ((bits[:100_000] >> 8) + 0.5) / 2**24
    v = (bits[100_000:] >> 8) / 2**24
    radius = np.sqrt(-2 * np.log(u))
    cosines = radius * np.cos(2 * np.pi * v)
    sines = radius * np.sin(2 * np.pi * v)
    np.testing.assert_allclose(out, np.append(cosines, sines), rtol=0, atol=2e-5)
    assert stats.kstest(out, "norm").pvalue > 0.001
    beyond_3 = np.abs(out) > 3
    assert beyond_3.mean() == pytest.approx(2 * stats.norm.sf(3), rel=0.15)


def xoshiro128(state: list[int], count: int) -> list[int]:
    """Words of one generator xoshiro128++, as its authors write it."""
    s0, s1, s2, s3 = state
    words = []
    for _ in range(count):
        words.append((rotated(s0 + s3, 7) + s0) % 2**32)
        shifted = s1 << 9
        s2 ^= s0
        s3 ^= s1
        s1 ^= s2
        s0 ^= s3
        s2 = (s2 ^ shifted) % 2**32
        s3 = rotated(s3, 11)
    return words


def rotated(word: int, bits: int) -> int:
    word %= 2**32
    return (word << bits | word >> (32 - bits)) % 2**32


def test_words_are_those_of_generators_side_by_side():
    states = np.random.default_rng(4).integers(0, 2**32, 4 * LANES, dtype=np.uint32)
    lanes = states.reshape(4, LANES).T.tolist()
    lanes[0] = [1, 2, 3, 4]
    states[::LANES] = lanes[0]
    words = np.empty(12 * LANES, np.uint32)
    fill_words(states, words[: 4 * LANES])
    fill_words(states, words[4 * LANES :])
    expected = np.array([xoshiro128(lane, 12) for lane in lanes])
    assert np.array_equal(words.reshape(12, LANES), expected.T)
    # published for this state
    assert expected[0, :4].tolist() == [641, 1573767, 3222811527, 3517856514]
    assert expected[0, 8] == 495546011


def test_standard_normals_have_no_pattern():
    """Neither within a draw, between lanes and blocks and pairs, nor between draws; an odd count,
    which no block fits. Correlations of 40,000 products are normal; alpha 1e-5 each."""
    rng = np.random.default_rng(5)
    count = 16 * BLOCK + 2 * 321 + 1
    first = standard_normals(rng, (count,))
    second = standard_normals(rng, (count,))
    assert stats.kstest(np.append(first, second), "norm").pvalue > 0.001
    limit = 4.5 / np.sqrt(count)
    assert abs((first * second).mean()) < limit
    for lag in (1, LANES, BLOCK, (count + 1) // 2):
        for values in (first, first**2 - 1):
            products = values[lag:] * values[:-lag]
            assert abs(products.mean()) < 2 * limit * np.sqrt(count / products.size)


@pytest.mark.parametrize("electrons", [40.0, 400.0])
def test_normal_samples_match_true_poisson_wells(electrons):
    """The real part of the demodulated phasor: two Poisson wells and two read noises against the
    kernel's normals.

    Two-sample Kolmogorov-Smirnov at alpha 0.001 on 40,000 draws each, and variances within 3 %.
    """
    rng = np.random.default_rng(11)
    n = 40_000
    contrast = 0.9
    phase = 0.7
    read = 3.2
    steps = 2 * np.pi * np.arange(3) / 3
    modulated = contrast * np.cos(phase - steps)[:, None]
    first_well = rng.poisson(electrons * (1 + modulated) / 2, (3, n))
    second_well = rng.poisson(electrons * (1 - modulated) / 2, (3, n))
    wells = first_well - second_well + rng.normal(0, read * np.sqrt(2), (3, n))
    true_re = (2 / 3 * np.cos(steps) @ wells).ravel()
    means = np.empty((1, 3, n), f4)
    means[0] = electrons * modulated
    sigma = np.full(n, np.sqrt(electrons + 2 * read**2), f4)
    normals = rng.standard_normal((1, 3, n)).astype(f4)
    unit, amplitude, _ = expose(means, sigma, normals)
    ours = unit[0, 0] * amplitude[0]
    assert ours.var() == pytest.approx(true_re.var(), rel=0.03)
    # the kernel rounds samples to whole units; a uniform dither of that size makes both continuous
    dithered = ours + rng.uniform(-0.3, 0.3, n)
    true_dithered = true_re + rng.uniform(-0.3, 0.3, n)
    assert stats.ks_2samp(dithered, true_dithered).pvalue > 0.001


@pytest.mark.parametrize(
    ("knee", "size", "step"),
    [
        (256, 100, 1),
        (256, 511, 1),
        (256, 600, 2),
        (256, 1500, 4),
        (256, 20_000, 64),
        (128, 250, 1),
        (128, 300, 2),
    ],
)
def test_companding_steps_double_with_each_octave(knee, size, step):
    value = f4(size + 0.37 * step)
    # one sample beside two zeros has the phasor (2/3) value
    means = np.array([[[value], [0], [0]]], f4)
    no_noise = np.zeros(1, f4)
    normals = np.zeros((1, 3, 1), f4)
    _, amplitude, saturated = expose(means, no_noise, normals, knee)
    rounded = step * np.floor(value / step + 0.5)
    assert amplitude[0, 0] * 1.5 == pytest.approx(rounded, abs=1e-2)
    assert saturated[0] == 0


def test_a_saturated_pixel_has_no_phasor():
    means = np.zeros((2, 3, 2), f4)
    means[0, 0] = [900.0, 1100.0]
    means[1, 0] = 100.0
    unit, amplitude, saturated = expose(
        means,
        np.zeros(2, f4),
        np.zeros((2, 3, 2), f4),
        128,
        1000.0,
        (1.0, 2.0),
    )
    assert saturated.tolist() == [0, 1]
    assert (unit[:, :, 1] == 0).all()
    assert (amplitude[:, 1] == kernels.OUTSIDE).all()
    # steps of 4 between 512 and 1023; the second frequency's gain is 2
    assert amplitude[:, 0] == pytest.approx([900 * 2 / 3, 2 * 100 * 2 / 3])


@pytest.mark.parametrize("bright", [True, False], ids=["bright", "dim"])
@pytest.mark.parametrize(
    ("half", "sigma_px", "drop_dim", "dim_edges", "by_amplitude"),
    [
        (2, np.inf, False, True, False),
        (2, np.inf, False, False, False),
        (1, 3.0, True, True, True),
        (1, 3.0, True, False, True),
    ],
)
def test_the_filter_is_that_of_its_reference(
    bright,
    half,
    sigma_px,
    drop_dim,
    dim_edges,
    by_amplitude,
):
    """Both cameras' variants, on a step of phase; one pixel in eight is dim, two are saturated."""
    rng = np.random.default_rng(2)
    h = 9
    w = 14
    step = np.where(np.arange(w) < 7, 0.3, 1.4)
    phase = step + 0.2 * rng.standard_normal((h, w))
    unit = np.stack([np.cos(phase), np.sin(phase)]).astype(f4)
    least, greatest = (50, 90) if bright else (1, 20)
    amplitude = rng.uniform(least, greatest, (h, w)).astype(f4)
    amplitude[rng.random((h, w)) < 1 / 8] = 5.0
    amplitude[4, 6:8] = kernels.OUTSIDE
    unit[:, 4, 6:8] = 0.0
    offset = np.arange(-half, half + 1)
    space = np.exp(-(offset[:, None] ** 2 + offset**2) / (2 * sigma_px**2))
    filtered = np.empty((3, h, w), f4)
    edge = np.empty((h, w), f4)
    settings = kernels.FilterSettings(
        space=space.astype(f4),
        concentration=f4(3.6067),
        dim=f4(24),
        drop_dim=drop_dim,
        dim_edges=dim_edges,
        by_amplitude=by_amplitude,
    )
    kernels.filter_image(
        unit,
        amplitude,
        settings,
        filtered,
        edge,
    )
    phasor = unit[0] + 1j * unit[1]
    for y in range(h):
        for x in range(w):
            expected, strength, edge_sum = filtered_pixel(
                phasor,
                amplitude,
                settings,
                y,
                x,
            )
            by_kernel = filtered[0, y, x] + 1j * filtered[1, y, x]
            assert by_kernel == pytest.approx(expected, rel=1e-4, abs=1e-4)
            assert filtered[2, y, x] == pytest.approx(strength, rel=1e-4)
            assert edge[y, x] == pytest.approx(edge_sum, rel=1e-3, abs=1e-4)


def test_noise_is_as_smooth_as_a_box_of_five_makes_it():
    """Correlation .80 .60 .40 .20 0 where phase noise is small; without the rounding, which is
    white."""
    step = CAMERA.engine.output_step_mm.model_copy(update={"value": 1e-3})
    fine = CAMERA.model_copy(
        update={"engine": CAMERA.engine.model_copy(update={"output_step_mm": step})}
    )
    region = Region(250, 400, 200, 400)
    view = plane_view(
        fine,
        region,
        0.8,
        0.8,
        0.05,
        0.02,
    )
    noise = noise_of(z_of(SimulatedUnit(fine, CLEAN, view), 60))
    for lag, expected in enumerate([0.8, 0.6, 0.4, 0.2, 0.0], start=1):
        assert correlation(noise, 0, lag) == pytest.approx(expected, abs=0.02)
        assert correlation(noise, lag, 0) == pytest.approx(expected, abs=0.02)


def unwrapped(table, half_path):
    """Half the path (n,) that the kernel finds from exact wrapped phases, and its squared
    residual."""
    turns = half_path[:, None] / table.unambiguous_m * table.lattice
    turn = np.ascontiguousarray((turns % 1).T, f4)
    half = np.empty(half_path.size, f4)
    residual2 = np.empty(half_path.size, f4)
    ranging.half_path(
        turn,
        half_path.size,
        table,
        half,
        residual2,
    )
    return half, residual2


def test_unwrapping_recovers_every_distance():
    table = unwrap_table(CAMERA.frequencies_hz, "least_squares")
    rows = np.abs(table.combination).tolist()
    assert sorted(rows) == [[3, 2, 4], [3, 4, 3]]
    assert table.metres_per_turn * 1000 == pytest.approx([381.18, 363.85, 103.96], abs=0.01)
    half_path = np.linspace(0.06, 13.9, 20_000)
    half, residual2 = unwrapped(table, half_path)
    assert np.abs(half - half_path).max() < 5e-6
    assert residual2.max() < 1e-10


@pytest.mark.parametrize("fusion", ["least_squares", "mean"])
@pytest.mark.parametrize(
    ("frequencies_mhz", "divisor_mhz"),
    [
        ((20.0,), 20),
        ((100.0, 80.0), 20),
        ((80.0, 16.0), 16),
        ((31.0, 30.0, 12.5), 0.5),
    ],
)
def test_unwrapping_of_other_cameras(frequencies_mhz, divisor_mhz, fusion):
    """One to three frequencies, up to the range after which all of them repeat: c / 2 by their
    greatest divisor."""
    table = unwrap_table(tuple(f * 1e6 for f in frequencies_mhz), fusion)
    assert table.unambiguous_m == pytest.approx(SPEED_OF_LIGHT_AIR / (2e6 * divisor_mhz))
    half_path = np.linspace(0.02, min(0.99 * table.unambiguous_m, 30), 5_000)
    half, residual2 = unwrapped(table, half_path)
    assert np.abs(half - half_path).max() < 3e-5
    assert residual2.max() < 1e-9


def test_unrelated_frequencies_are_refused():
    with pytest.raises(UserError, match="share no base frequency"):
        unwrap_table((100e6, 100e6 * np.sqrt(2), 57.3e6), "mean")


def test_emitter_beside_the_lens_is_corrected_for():
    region = Region(240, 280, 110, 150)
    unit = SimulatedUnit(CAMERA, QUIET, plane_view(CAMERA, region, 0.3, 0.3))
    z = z_of(unit, 1)[0]
    # uncorrected, half the path of a point seen 30 degrees off the axis at 0.35 m would be off by
    # some 4 mm
    assert np.abs(z - 0.3).max() <= 0.5e-3 + 1e-6


def test_fixed_pattern_has_the_size_and_length_of_its_facts():
    config = CameraConfig(
        unit_seed=4, effects=NO_EFFECTS.model_copy(update={"fixed_pattern": True})
    )
    lens = CAMERA.nominal_lens
    imager = AmcwImager(CAMERA, config, lens.whole, lens.region_slopes(lens.whole))
    pattern = imager.static_error_m
    smooth = CAMERA.fixed_pattern.smooth_mm.value
    pixel = CAMERA.fixed_pattern.pixel_mm.value
    assert pattern.std() * 1e3 == pytest.approx(np.hypot(smooth, pixel), rel=0.05)
    for lag in (3, 6, 12):
        expected = smooth**2 * np.exp(-(lag**2) / (2 * 6.3**2))
        assert (pattern[:, lag:] * pattern[:, :-lag]).mean() * 1e6 == pytest.approx(
            expected, abs=0.02
        )


def test_fixed_pattern_belongs_to_the_unit_not_to_the_region():
    small = Region(300, 340, 300, 360)
    large = Region(290, 350, 280, 380)
    views = [
        plane_view(
            CAMERA,
            region,
            0.8,
            0.6,
            0.05,
            0.02,
        )
        for region in (small, large)
    ]
    config = CameraConfig(effects=NO_EFFECTS.model_copy(update={"fixed_pattern": True}))
    small_unit = SimulatedUnit(CAMERA, config, views[0])
    large_unit = SimulatedUnit(CAMERA, config, views[1])
    cut = small_unit.region.within(large_unit.region)
    small_z = z_of(small_unit)[0]
    large_z = z_of(large_unit)[0]
    assert np.array_equal(small_z, large_z[cut])


def test_two_files_that_bear_one_name_have_their_own_pattern():
    smooth_mm = 3 * CAMERA.fixed_pattern.smooth_mm.value
    wider = with_number(CAMERA, "fixed_pattern", "smooth_mm", smooth_mm)
    config = CameraConfig(effects=NO_EFFECTS.model_copy(update={"fixed_pattern": True}))
    region = CAMERA.nominal_lens.whole
    slopes = CAMERA.nominal_lens.region_slopes(region)
    narrow = AmcwImager(CAMERA, config, region, slopes).static_error_m.std()
    wide = AmcwImager(wider, config, region, slopes).static_error_m.std()
    assert wide > 1.5 * narrow


def test_a_changed_number_changes_what_follows_from_it():
    assert CAMERA.optics.cutoff_half_angle_deg < 60.0
    wide = with_number(CAMERA, "emitter", "cutoff_half_angle_deg", 60.0)
    assert wide.optics.cutoff_half_angle_deg == 60.0


def test_shorter_captures_are_prefixes_and_streams_are_repeatable():
    unit = unit_at(0.8)
    long = z_of(unit, 4)
    short = z_of(unit, 2)
    assert np.array_equal(long[:2], short)
    assert not np.array_equal(long[0], long[1])
    assert not np.array_equal(z_of(unit, 1, seed=2)[0], long[0])


def reasons_of(unit: SimulatedUnit) -> set[Reason]:
    frame = first_frame(unit)
    assert np.array_equal(np.isnan(frame.z_m), frame.reason != Reason.VALID)
    return {Reason(code) for code in np.unique(frame.reason)}


def test_each_gate_names_its_reason():
    assert reasons_of(unit_at(0.8)) == {Reason.VALID}
    assert reasons_of(unit_at(0.8, albedo=0.0, config=QUIET)) == {Reason.LOW_AMPLITUDE}
    # bright enough for the converter's gates, too dark for its distance: albedo 0.005 at 0.3 m
    assert Reason.LOW_REFLECTIVITY in reasons_of(unit_at(0.3, albedo=0.005, config=QUIET))
    assert reasons_of(unit_at(0.1, albedo=1.0)) == {Reason.SATURATED}
    assert Reason.OUTSIDE_MASK in reasons_of(unit_at(0.8, region=Region(0, 40, 0, 60)))


def test_mixed_phasors_are_told_by_residual_ratio_or_edge():
    view = plane_view(CAMERA, NEAR_AXIS, 0.7, 0.6)
    # a step of 0.6 m is nearly a whole turn of the two higher frequencies, and the gate hardly
    # sees it
    far = plane_view(CAMERA, NEAR_AXIS, 1.1, 0.6)
    columns = np.arange(NEAR_AXIS.shape[1])
    share = np.clip((columns - 39.5) / 1.0, 0, 1)
    mixed = view.phasor * (1 - share) + far.phasor * share
    object.__setattr__(view, "phasor", mixed)
    unit = SimulatedUnit(CAMERA, QUIET, view)
    frame = first_frame(unit)
    assert Reason.EDGE in {Reason(code) for code in np.unique(frame.reason)}
    open_gate = SimulatedUnit(CAMERA, QUIET.model_copy(update={"edge_gate": False}), view)
    without = first_frame(open_gate)
    assert (without.reason == Reason.VALID).sum() > (frame.reason == Reason.VALID).sum()
    assert Reason.EDGE not in {Reason(code) for code in np.unique(without.reason)}


def test_more_light_less_noise():
    """Shot-limited: four times the light halves the deviation (rounding and read noise allow 10
    %)."""
    dim = with_number(CAMERA, "photons", "signal_electrons", 1000)
    bright = with_number(CAMERA, "photons", "signal_electrons", 4000)
    dim_sigma_m = temporal_sigma_m(
        dim,
        2.5,
        0.5,
        60,
        1,
    )
    bright_sigma_m = temporal_sigma_m(
        bright,
        2.5,
        0.5,
        60,
        1,
    )
    assert dim_sigma_m / bright_sigma_m == pytest.approx(2, rel=0.1)
