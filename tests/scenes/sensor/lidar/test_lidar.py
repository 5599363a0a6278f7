"""The scanned lidar's correlation, noise and calibration against closed forms and brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR, Region
from scenes.closed_form import plane_view
from scenes.sensor.calibration import (
    ONLY_NOISE,
    calibrated_numbers,
    temporal_sigma_m,
    unit_before_plane,
)
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.lidar.facts import ScannedLidar
from scenes.sensor.lidar.kernels import CHUNK, NOWHERE_M, smooth, strongest_peaks
from scenes.sensor.source import SimulatedUnit
from tests.support.lidar_units import (
    CAMERA,
    FINE,
    PATCH,
    QUIET,
    RAW,
    UNIFORM,
    changed,
    comb_phasors,
)
from tests.support.sensor_frames import correlation, noise_of, true_z_m, z_of

# ---------------------------------------------------------------- range without noise


@pytest.mark.parametrize("distance_m", [0.27, 0.5, 0.75, 1.0, 2.3, 6.4])
@pytest.mark.parametrize("region", [PATCH, Region(40, 80, 60, 110)], ids=["axis", "corner"])
def test_range_on_planes_is_exact_without_noise(distance_m, region):
    """With the receiver 20 mm beside the transmitter; what is left is the plane's perspective
    curvature across the smoothing, some 13 square pixels of half a curvature: 0.01 mm a metre,
    more in the corner."""
    camera = changed({**FINE, "engine.confidence_electrons": 1.0})
    unit = SimulatedUnit(
        camera,
        QUIET,
        plane_view(
            camera,
            region,
            distance_m,
            0.6,
            0.1,
            0.05,
        ),
    )
    off_m = z_of(unit)[0] - true_z_m(unit)
    assert np.abs(off_m).max() < 0.01e-3 + 0.025e-3 * distance_m


def test_the_receiver_beside_the_transmitter_is_corrected_for():
    """Half of both legs would be 0.2 mm too long at 0.5 m on the axis, and more to the sides."""
    unit = SimulatedUnit(CAMERA, QUIET, plane_view(CAMERA, PATCH, 0.5, 0.6))
    half_m = unit.exposure.half_m[0][unit.cut]
    assert (half_m - unit.view.range_m[unit.cut]).mean() == pytest.approx(
        0.02**2 / (4 * 0.5), rel=0.1
    )
    assert np.abs(z_of(unit)[0] - 0.5).max() <= 0.125e-3 + 1e-6


def test_output_is_whole_quarters_of_a_millimetre():
    z = z_of(
        SimulatedUnit(
            CAMERA,
            ONLY_NOISE,
            plane_view(
                CAMERA,
                PATCH,
                0.9,
                0.6,
                0.05,
                0.02,
            ),
        )
    )
    assert np.abs(z * 4000 - np.round(z * 4000)).max() < 2e-3
    assert len(np.unique(np.round(z * 4000).astype(int) % 4)) == 4


# ---------------------------------------------------------------- the correlation's peaks


@settings(max_examples=30, deadline=None)
@given(
    first_m=st.floats(0.3, 4.0),
    gap_m=st.floats(0.8, 4.0),
    ratio=st.floats(0.15, 0.9),
    far_wins=st.booleans(),
)
def test_two_separate_returns_are_two_peaks_in_order_of_their_light(
    first_m, gap_m, ratio, far_wins
):
    """Each at its place and height, but for 4 % of the other's light (side lobes, and the mean,
    which is filtered)."""
    half_m = np.array([first_m, first_m + gap_m])
    light = np.array([ratio, 1.0]) if far_wins else np.array([1.0, ratio])
    phasors = comb_phasors(CAMERA, half_m[:, None], light[:, None])
    peaks = strongest_peaks(phasors, CAMERA.weights)
    order = [1, 0] if far_wins else [0, 1]
    assert peaks.delay[:, 0] * CAMERA.unambiguous_m == pytest.approx(half_m[order], abs=0.02)
    assert peaks.height[:, 0] == pytest.approx([1.0, ratio], abs=0.04)


def test_peaks_are_ordered_by_height_even_where_samples_are_not():
    """Returns that differ by 1 %, at 200 places within a sample, where the samples' order is often
    the other one."""
    first_m = 1.0 + np.linspace(0, 0.15, 200)
    half_m = np.stack([first_m, first_m + 1.03])
    light = np.outer([0.99, 1.0], np.ones(200))
    peaks = strongest_peaks(comb_phasors(CAMERA, half_m, light), CAMERA.weights)
    assert (peaks.height[0] > peaks.height[1]).all()
    assert peaks.delay[0] * CAMERA.unambiguous_m == pytest.approx(half_m[1], abs=2e-3)


def test_a_lone_return_has_the_pulse_of_the_file():
    """Height 1 at the return, half of it half a width away; curvature of the bandwidth that the
    bound uses."""
    half_m = np.array([[1.234]])
    phasors = comb_phasors(CAMERA, half_m, np.ones((1, 1)))
    peaks = strongest_peaks(phasors, CAMERA.weights)
    assert peaks.delay[0, 0] * CAMERA.unambiguous_m == pytest.approx(1.234, abs=1e-6)
    assert peaks.height[0, 0] == pytest.approx(1, abs=1e-6)
    per_radian = CAMERA.period_s / (2 * np.pi)
    assert peaks.curvature[0, 0] == pytest.approx(
        (CAMERA.bandwidth_rad_s * per_radian) ** 2, rel=1e-5
    )
    half_width_s = CAMERA.code.correlation_fwhm_ns.value * 1e-9 / 2
    lines = np.arange(1, len(CAMERA.weights) + 1)
    cosines = np.cos(2 * np.pi * lines * half_width_s / CAMERA.period_s)
    height = (CAMERA.weights * cosines).sum() / CAMERA.weights.sum()
    # the missing mean and the cut band take 3 % off
    assert height == pytest.approx(0.5, abs=0.03)


def filtered_noise(rng: np.random.Generator, n: int) -> np.ndarray:
    """Phasors (K, n) of white noise whose correlations have a deviation of 1."""
    w = CAMERA.weights[:, None]
    re, im = rng.standard_normal((2, len(w), n)) * np.sqrt(w / w.sum())
    return (re + 1j * im) * (w.sum() / w)


def test_noise_of_a_peak_meets_the_bound_in_brute_force():
    """White noise through the matched filter on the whole correlation: deviation of place (the
    Cramer-Rao bound) and of height, and no correlation between them; 4,000 draws have 1.1 % of
    each deviation, held at 4 sigma."""
    rng = np.random.default_rng(4)
    n = 4000
    ratio = 20.0
    w = CAMERA.weights
    phasor = comb_phasors(CAMERA, np.full((1, n), 1.5), np.ones((1, n)))
    peaks = strongest_peaks(phasor + filtered_noise(rng, n) / ratio, w)
    places_m = peaks.delay[0] * CAMERA.unambiguous_m
    bound_m = CAMERA.unambiguous_m / (CAMERA.period_s * CAMERA.bandwidth_rad_s)
    assert places_m.std() == pytest.approx(bound_m / ratio, rel=0.045)
    assert peaks.height[0].std() == pytest.approx(1 / ratio, rel=0.045)
    correlations_of_both = np.corrcoef(places_m, peaks.height[0])
    assert abs(correlations_of_both[0, 1]) < 4 / np.sqrt(n)


def test_highest_maximum_of_noise_follows_rices_count():
    """Quantiles of 4,000 brute-force correlations of noise alone against the formula; it holds for
    high maxima."""
    rng = np.random.default_rng(6)
    n = 4000
    w = CAMERA.weights
    highest = strongest_peaks(filtered_noise(rng, n), w).height[0]
    rate = CAMERA.bandwidth_rad_s * CAMERA.period_s / (2 * np.pi)
    for chance in (0.5, 0.9, 0.99):
        assert np.quantile(highest, chance) == pytest.approx(
            np.sqrt(2 * np.log(rate / -np.log(chance))), rel=0.04
        )


# ---------------------------------------------------------------- noise of the output


def smoothing_factor(camera: ScannedLidar) -> float:
    """Deviation after the linear smoothing of noise that overlapping integrations correlate along
    columns."""
    along, across = camera.smoothing_taps
    rho = max(0.0, 1 - 1 / camera.integration_points)
    overlap = (along[1:] * along[:-1]).sum()
    along_variance = (along**2).sum() + 2 * rho * overlap
    return float(np.sqrt(along_variance * (across**2).sum()))


@pytest.mark.parametrize(
    ("distance_m", "albedo"),
    [
        (0.5, 0.95),
        (1.0, 0.5),
        (1.5, 0.95),
        (2.0, 0.6),
    ],
)
def test_output_noise_is_the_bound_times_the_smoothing(distance_m, albedo):
    """sigma = c / (2 B) sqrt(F (S + A) + a^2) / S, S = signal albedo / d^2, where all neighbours
    join.

    160 frames of 64 x 64 pixels, of which some 110 share their noise, tell it to 1.1 % at one
    sigma."""
    camera = changed({**UNIFORM, **FINE})
    photons = camera.photons
    signal = photons.signal_electrons.value * albedo / distance_m**2
    ambient = camera.ambient_electrons(ONLY_NOISE.ambient_uw_cm2_nm)
    noise = np.sqrt(
        photons.excess_noise_factor.value * (signal + ambient)
        + photons.amplifier_electrons.value**2
    )
    bound_m = SPEED_OF_LIGHT_AIR / (2 * camera.bandwidth_rad_s) * noise / signal
    assert temporal_sigma_m(
        camera,
        distance_m,
        albedo,
        160,
        3,
    ) == pytest.approx(bound_m * smoothing_factor(camera), rel=0.03)


def correlations(camera: ScannedLidar, frames: int = 60) -> np.ndarray:
    """(7, 7) noise correlation at lags 0..6 along columns (rows of the result) and along rows (its
    columns)."""
    unit = SimulatedUnit(
        camera, ONLY_NOISE, plane_view(camera, Region(340, 460, 460, 600), 1.0, 0.6)
    )
    noise = noise_of(z_of(unit, frames))
    lags = np.empty((7, 7))
    for down in range(7):
        for across in range(7):
            lags[down, across] = correlation(noise, down, across)
    return lags


def test_noise_is_alike_along_sweeps_and_not_across_them():
    """Before smoothing: 1 - 1/p along a column for integrations of p points, nothing along a row.
    One estimate has a deviation of 0.001 (a million pairs); 0.006 allows for it and for the taps'
    own 0.3 %."""
    share = 1 - 1 / CAMERA.integration_points
    expected = np.zeros((7, 7))
    expected[0, 0] = 1
    expected[1, 0] = share
    camera = changed({**RAW, **UNIFORM, **FINE})
    assert correlations(camera) == pytest.approx(expected, abs=0.006)


def test_smoothing_correlates_as_its_weights_say():
    """The weights' own correlation, the one along columns blurred by the overlap. The means of 60
    frames take nothing off at this tolerance; neighbouring means share most of their noise, hence
    its size."""
    share = 1 - 1 / CAMERA.integration_points
    column_taps, row_taps = CAMERA.smoothing_taps
    column = np.correlate(column_taps, column_taps, "full")
    row = np.correlate(row_taps, row_taps, "full")
    overlapped = np.convolve(column, [share, 1, share])
    along_column = overlapped[len(column) // 2 + 1 :][:7]
    along_row = row[len(row) // 2 :][:7]
    expected = np.outer(along_column / along_column[0], along_row / row.max())
    assert correlations(changed({**UNIFORM, **FINE})) == pytest.approx(expected, abs=0.04)


@pytest.mark.parametrize("along_rows", [False, True])
def test_smoothing_of_more_columns_than_a_chunk_meets_brute_force(along_rows: bool):
    """Of steps and noise that the gates let through in part, for both axes, and beyond the
    picture's border."""
    random = np.random.default_rng(1)
    taps = np.float32([0.05, 0.2, 0.5, 0.2, 0.05])
    r = 2
    h = 6
    w = CHUNK + 37
    bordered = (h + 2 * r, w + 2 * r)
    half_m = np.full(bordered, NOWHERE_M, np.float32)
    share = np.zeros(bordered, np.float32)
    height = np.zeros(bordered, np.float32)
    inner = slice(r, -r), slice(r, -r)
    steps_m = 0.02 * random.integers(0, 2, (h, w))
    half_m[inner] = 1 + steps_m + 0.005 * random.standard_normal((h, w))
    share[inner] = random.uniform(0.2, 1, (h, w))
    height[inner] = random.uniform(0.2, 1, (h, w))
    gate_m = random.uniform(0.005, 0.03, (h, w)).astype(np.float32)
    smoothed = np.empty((3, h, w), np.float32)
    smooth(half_m, share, height, gate_m, taps, along_rows, *smoothed)
    moved = np.zeros((h, w))
    total = np.zeros((h, w))
    heights = np.zeros((h, w))
    for k, tap in enumerate(taps, -r):
        down, right = (0, k) if along_rows else (k, 0)
        rows = slice(r + down, r + down + h)
        columns = slice(r + right, r + right + w)
        neighbours = (rows, columns)
        off = half_m[neighbours] - half_m[inner]
        weight = tap * (np.abs(off) <= gate_m)
        moved += weight * share[neighbours] * off
        total += weight * share[neighbours]
        heights += weight * height[neighbours]
    expected = [half_m[inner] + moved / total, total, heights]
    np.testing.assert_allclose(smoothed, expected, rtol=0, atol=1e-6)


def test_noise_of_range_and_of_strength_are_independent():
    """As the brute force above has it; 50,000 pairs, half of them alike along columns, held at 4
    sigma."""
    unit = SimulatedUnit(
        changed({**RAW, **UNIFORM, **FINE}), ONLY_NOISE, plane_view(CAMERA, PATCH, 1.0, 0.6)
    )
    frames = list(unit.capture(20, 1).frames())
    z = np.stack([frame.z_m for frame in frames]).astype(float)
    strength = np.stack([frame.amplitude for frame in frames]).astype(float)
    pairs = np.corrcoef(noise_of(z).ravel(), noise_of(strength).ravel())
    assert abs(pairs[0, 1]) < 4 / np.sqrt(z.size / 2)
    assert strength.std(axis=0).mean() == pytest.approx(
        unit.exposure.noise[unit.cut].mean(), rel=0.05
    )


def test_a_sweep_shares_its_jitter():
    camera = changed({**RAW, **FINE, "scan.sweep_jitter_mm": 5.0})
    unit = SimulatedUnit(camera, ONLY_NOISE, plane_view(camera, PATCH, 0.5, 0.95))
    columns = noise_of(z_of(unit, 60)).mean(axis=1)
    # 60 x 56 independent draws: 1.2 % at one sigma
    assert columns.std() == pytest.approx(5e-3, rel=0.05)


def test_ambient_light_adds_noise_and_its_switch_takes_it_away():
    view = plane_view(CAMERA, PATCH, 2.0, 0.5)

    def noise_in(ambient: bool, level: float) -> np.ndarray:
        effects = NO_EFFECTS.model_copy(update={"noise": True, "ambient": ambient})
        config = CameraConfig(name=CAMERA.name, effects=effects, ambient_uw_cm2_nm=level)
        return SimulatedUnit(CAMERA, config, view).exposure.noise

    in_the_dark = noise_in(True, 0.0)
    assert np.array_equal(noise_in(False, 0.4), in_the_dark)
    added = noise_in(True, 0.4) ** 2 - in_the_dark**2
    electrons = CAMERA.ambient_electrons(0.4)
    factor = CAMERA.photons.excess_noise_factor.value
    assert added == pytest.approx(factor * electrons, rel=1e-3)


def test_ambient_electrons_by_hand():
    """0.4 uW/cm2/nm is 4e-3 W/m2/nm; times 30 nm, albedo 0.5 and the foreshortened solid angle,
    over 0.24 W."""
    by_hand = CAMERA.photons.signal_electrons.value * 4e-3 * 30 * 0.5 * CAMERA.field_sr / 0.24
    assert CAMERA.ambient_electrons(0.4) == pytest.approx(by_hand)
    # 70 x 55 degrees: tan 35 x tan 27.5 x 4 = 1.46 before foreshortening
    assert 0.9 < CAMERA.field_sr < 1.46


# ---------------------------------------------------------------- calibration


def test_the_file_holds_the_calibrated_numbers():
    numbers = calibrated_numbers(CAMERA)
    electrons = numbers["photons.signal_electrons"]
    assert CAMERA.photons.signal_electrons.value == pytest.approx(electrons, rel=0.015)
    threshold = numbers["engine.confidence_electrons"]
    assert CAMERA.engine.confidence_electrons.value == pytest.approx(threshold, rel=0.03)


def valid_share(distance_m: float, albedo: float) -> float:
    unit = unit_before_plane(CAMERA, distance_m, albedo)
    return float(np.isfinite(z_of(unit, 40, 7)).mean())


def test_both_calibration_points_are_met():
    assert temporal_sigma_m(
        CAMERA,
        0.945,
        0.3,
        100,
        9,
    ) == pytest.approx(0.71e-3, rel=0.03)
    assert valid_share(6.5, 0.95) == pytest.approx(0.5, abs=0.03)


def test_reach_follows_the_energy():
    """Half of the pixels at 6.5 m sqrt(albedo / 0.95): the light, not the distance, decides."""
    assert valid_share(6.5 * np.sqrt(0.15 / 0.95), 0.15) == pytest.approx(0.5, abs=0.03)
    shares = [valid_share(d, 0.95) for d in (3.0, 5.0, 6.5, 8.0)]
    assert shares[0] > 0.999
    assert shares == sorted(shares, reverse=True)
    assert shares[3] < 0.25
