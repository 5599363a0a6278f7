"""The Kinect v2 against what its published engine implies: noise, correlation, steps, edges,
unwrapping."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR, Reason, Region
from harness.vocabulary.seeds import random_stream
from scenes.closed_form import plane_view
from scenes.sensor.amcw import kernels, ranging
from scenes.sensor.amcw.facts import unwrap_table
from scenes.sensor.amcw.imager import AmcwImager
from scenes.sensor.calibration import calibrated_signal_electrons, temporal_sigma_m
from scenes.sensor.camera import camera_of, load_camera
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.source import SimulatedUnit
from tests.support.sensor_frames import correlation, first_frame, noise_of, true_z_m, z_of

f4 = np.float32
V2 = load_camera("kinect_v2_libfreenect2")
NEAR_AXIS = Region(170, 240, 210, 300)
SHARP = {"scatter.blur_px": 0.0}
"""A lens without blur: steps that can be worked out by hand."""
QUIET = CameraConfig(
    name=V2.name, effects=NO_EFFECTS.model_copy(update={"multipath": True}), numbers=SHARP
)
NOISY = QUIET.model_copy(
    update={"effects": NO_EFFECTS.model_copy(update={"noise": True, "multipath": True})}
)
FINE = {"converter.knee_units": 10**6, "photons.electrons_per_unit": 0.1}
"""A converter whose rounding hides nothing."""
DISTANCE2_PX = np.add.outer([1, 0, 1], [1, 0, 1])
WINDOW = np.exp(-DISTANCE2_PX / 18)
"""The published kernel: a Gaussian of 3 px over 3x3."""


def test_gain_meets_the_calibration_point():
    electrons = calibrated_signal_electrons(V2, frames=60, seed=5)
    assert V2.photons.signal_electrons.value == pytest.approx(electrons, rel=0.03)
    sigma_m = temporal_sigma_m(
        V2,
        1.5,
        0.8,
        100,
        seed=6,
    )
    assert np.hypot(sigma_m, 1e-3 * V2.unit.jitter_mm.value) == pytest.approx(1.42e-3, rel=0.02)


def test_the_window_is_the_published_one():
    imager = AmcwImager(V2, QUIET, NEAR_AXIS, V2.nominal_lens.region_slopes(NEAR_AXIS))
    space = imager.filter_settings.space
    assert space / space.sum() == pytest.approx(
        np.array([[0.1069973, 0.1131098, 0.1069973], [0.1131098, 0.1195716, 0.1131098]])[[0, 1, 0]],
        abs=1e-6,
    )


def test_the_window_leaves_a_third_of_the_noise():
    """0.334 by its weights; on each frequency's phases, deviations over 40 frames within 2 %."""
    view = plane_view(
        V2,
        NEAR_AXIS,
        1.0,
        0.8,
        0.05,
        0.02,
    )
    imager = AmcwImager(V2, NOISY, NEAR_AXIS, view.slopes)
    exposure = imager.expose(view)
    rng = random_stream(3)
    light = view.phasor.conj()
    before = []
    after = []
    for _ in range(40):
        unit, amplitude, _ = imager.reading(exposure, rng)
        filtered, _ = imager.filter(unit, amplitude, exposure.shape)
        phasor = (unit[0] + 1j * unit[1]).reshape(light.shape)
        before.append(np.angle(phasor * light))
        smooth = filtered[:, 0] + 1j * filtered[:, 1]
        after.append(np.angle(smooth * light))
    inner = (slice(None), slice(1, -1), slice(1, -1))
    variance_before = np.var(before, axis=0)[inner].mean((1, 2))
    variance_after = np.var(after, axis=0)[inner].mean((1, 2))
    ratio = np.sqrt(variance_after / variance_before)
    by_weights = np.sqrt((WINDOW**2).sum()) / WINDOW.sum()
    assert by_weights == pytest.approx(0.334, abs=0.001)
    assert ratio == pytest.approx(0.334, rel=0.02)


def test_noise_correlates_over_three_pixels():
    """.68 and .32 along an axis, .46 along the diagonal, nothing at 3; without the rounding, which
    is white."""
    settings = NOISY.model_copy(update={"numbers": {"engine.output_step_mm": 1e-3}})
    camera = camera_of(settings)
    region = Region(130, 280, 150, 350)
    unit = SimulatedUnit(
        camera,
        settings,
        plane_view(
            camera,
            region,
            1.0,
            0.8,
            0.05,
            0.02,
        ),
    )
    noise = noise_of(z_of(unit, 60))
    for lag, expected in ((1, 0.68), (2, 0.32), (3, 0.0)):
        assert correlation(noise, 0, lag) == pytest.approx(expected, abs=0.02)
        assert correlation(noise, lag, 0) == pytest.approx(expected, abs=0.02)
    assert correlation(noise, 1, 1) == pytest.approx(0.46, abs=0.02)


def filtered_beside(phase: float, amplitude: float = 500.0) -> tuple[complex, float]:
    """The filter's phasor and edge sum of a pixel of phase 0 and amplitude 500 beside a column of
    another phase."""
    phases = np.zeros((3, 3))
    phases[:, 0] = phase
    strength = np.full((3, 3), 500.0, f4)
    strength[:, 0] = amplitude
    unit = np.stack([np.cos(phases), np.sin(phases)]).astype(f4)
    filtered = np.empty((3, 3, 3), f4)
    edge = np.empty((3, 3), f4)
    settings = kernels.FilterSettings(
        WINDOW.astype(f4),
        f4(3.6067),
        f4(3),
        True,
        True,
        True,
    )
    kernels.filter_image(
        unit,
        strength,
        settings,
        filtered,
        edge,
    )
    re, im, _ = filtered[:, 1, 1]
    return complex(re, im), float(edge[1, 1])


@pytest.mark.parametrize(
    ("step_mm", "weights"),
    [
        (18, (0.99, 1.0, 0.985)),
        (50, (0.95, 1.0, 0.89)),
        (100, (0.82, 0.99, 0.64)),
        (200, (0.46, 0.97, 0.19)),
        (500, (0.02, 0.82, 0.001)),
    ],
)
def test_weights_across_a_step(step_mm, weights):
    """The published table: near steps are smoothed as by a box, far ones keep their edge at the
    high frequencies."""
    for frequency_hz, expected in zip(V2.frequencies_hz, weights, strict=True):
        phase = 4 * np.pi * frequency_hz * step_mm * 1e-3 / SPEED_OF_LIGHT_AIR
        phasor, _ = filtered_beside(phase)
        weight = phasor.imag / (500 * np.sin(phase) * WINDOW[:, 0].sum())
        assert weight == pytest.approx(expected, abs=0.01)


def test_dim_neighbours_are_dropped():
    lit, edge = filtered_beside(2.0, amplitude=2.9)
    assert lit.imag == 0
    assert edge == 0
    lit, edge = filtered_beside(2.0, amplitude=3.1)
    assert lit.imag > 0
    assert edge == pytest.approx(3 * (1 - np.cos(2.0)) / 2, rel=1e-5)


def two_planes(
    near_m: float, step_m: float, share: float, config: CameraConfig = QUIET
) -> SimulatedUnit:
    """A step between two frontal planes at column 40, which sees ``share`` of the near one."""
    camera = camera_of(config)
    front = plane_view(camera, NEAR_AXIS, near_m, 0.5)
    back = plane_view(camera, NEAR_AXIS, near_m + step_m, 0.5)
    part = np.where(np.arange(NEAR_AXIS.shape[1]) < 40, 1.0, 0.0)
    part[40] = share
    phasor = part * front.phasor + (1 - part) * back.phasor
    intensity = part * front.intensity + (1 - part) * back.intensity
    view = dataclasses.replace(front, phasor=phasor, intensity=intensity)
    return SimulatedUnit(camera, config, view)


def middle(unit: SimulatedUnit) -> tuple[np.ndarray, np.ndarray]:
    """z and reason along the middle row."""
    frame = first_frame(unit)
    return frame.z_m[30].astype(float), frame.reason[30]


def gate_open(config: CameraConfig) -> CameraConfig:
    """Neither edge gate nor flying-pixel filter."""
    numbers = config.numbers | {"engine.flying_pixels.most_mm": 1e6}
    return config.model_copy(update={"edge_gate": False, "numbers": numbers})


@pytest.mark.parametrize(
    ("share", "step_m", "dead"),
    [
        (0.3, 0.3, [38]),  # 147 mm behind the near plane, and 153 before the far one
        (0.3, 0.5, [38]),
        (0.4, 0.3, [38, 39]),  # the second one 30.3 mm before the far plane
        (0.7, 0.3, []),  # 36 mm behind the near plane: within its 50 mm
        (0.3, 0.08, []),  # the gate wants 100 mm in one direction
    ],
)
def test_flying_pixels_die_over_a_far_step_and_live_over_a_near_one(share, step_m, dead):
    """The rule by hand on the range image without it: more than 50 mm behind, 30 before, 100
    either."""
    unrounded = QUIET.model_copy(update={"numbers": SHARP | {"engine.output_step_mm": 1e-3}})
    z, _ = middle(two_planes(0.8, step_m, share, gate_open(unrounded)))
    assert np.isfinite(z).all()
    before_m = z[1:-1] - np.minimum(z[:-2], z[2:])
    behind_m = np.maximum(z[:-2], z[2:]) - z[1:-1]
    between = (before_m > 0.05) & (behind_m > 0.03)
    rule = 1 + np.flatnonzero(between & (np.maximum(before_m, behind_m) > 0.1))
    _, reason = middle(two_planes(0.8, step_m, share, unrounded))
    assert np.flatnonzero(reason == Reason.EDGE).tolist() == rule.tolist() == dead
    assert ((reason == Reason.EDGE) | (reason == Reason.VALID)).all()


def test_even_amplitudes_hide_a_flying_pixel():
    """The gate asks for amplitudes that scatter by 5 %: raised to 200 %, it kills none."""
    lenient = QUIET.model_copy(
        update={"numbers": SHARP | {"engine.flying_pixels.relative_deviation": 2.0}}
    )
    z, _ = middle(two_planes(0.8, 0.3, 0.3, lenient))
    assert np.isfinite(z).all()
    assert 0.9 < z[38] < 1.0


def test_the_edge_flag_needs_half_a_wavelength():
    """Three neighbours sum 3 (1 - cos dphi)/2 >= 2.5 from 132 degrees on: 457 mm of step at 120
    MHz."""
    limit_m = np.arccos(-2 / 3) / (4 * np.pi * 120e6) * SPEED_OF_LIGHT_AIR
    assert limit_m == pytest.approx(0.457, abs=0.001)
    only_edges = QUIET.model_copy(update={"numbers": SHARP | {"engine.flying_pixels.most_mm": 1e6}})
    for step_m, flagged in ((limit_m - 0.02, []), (limit_m + 0.02, [37, 38])):
        _, reason = middle(two_planes(0.8, step_m, 0.0, only_edges))
        assert np.flatnonzero(reason == Reason.EDGE).tolist() == flagged


# ---------------------------------------------------------------- unwrapping


def published_range_m(turn: np.ndarray) -> np.ndarray:
    """The published procedure, step by step, on phases (80, 16, 120 MHz; n) in turns; lengths in c
    / 480 MHz."""
    a = 3 * turn[0]
    b = 15 * turn[1]
    c = 2 * turn[2]
    # 16 MHz says which of its five wraps 80 MHz is in, up to a multiple of 15
    a = a + 3 * np.round((b - a) / 3)
    # 120 MHz repeats every 2: an odd difference means the second half of 30
    odd = np.abs((a - c + 1) % 2) < 0.5
    odd |= np.abs((a - c + 1) % 2 - 2) < 0.5
    a = a + 15 * odd
    b = b + 15 * odd
    c = c + 2 * np.round((a - c) / 2)
    mean_of_cycles = (a / 3 + b / 15 + c / 2) / 3
    return mean_of_cycles * SPEED_OF_LIGHT_AIR / (2 * 72e6)


def test_unwrapping_is_right_over_the_whole_range_and_equals_the_published_one():
    """0.5 to 4.5 m: exact without noise, the right wraps with 0.02 turns of it, and with 0.06,
    where both often fail, the same decisions wherever the residual's gate passes them."""
    table = unwrap_table(V2.frequencies_hz, "mean")
    assert table.metres_per_turn * 1e3 == pytest.approx([693.8] * 3, abs=0.1)
    range_m = np.linspace(0.5, 4.5, 20_000)
    true = range_m[None] * table.lattice[:, None] / table.unambiguous_m
    for sigma in (0.0, 0.02, 0.06):
        turn = ((true + sigma * np.random.default_rng(4).standard_normal(true.shape)) % 1).astype(
            f4
        )
        published = published_range_m(turn.astype(float))
        half = np.empty(range_m.size, f4)
        residual2 = np.empty(range_m.size, f4)
        ranging.half_path(
            turn,
            range_m.size,
            table,
            half,
            residual2,
        )
        if sigma == 0:
            assert np.abs(half - range_m).max() < 5e-6
            assert residual2.max() < 1e-9
        passed = residual2 < (1 / 18) ** 2
        assert passed.mean() > (0.3 if sigma == 0.06 else 0.95)
        assert np.abs(half - published)[passed].max() < 2e-5
        wrong = np.abs(half - range_m)[passed] > 0.2
        assert wrong.any() if sigma == 0.06 else not wrong.any()


def test_the_residual_that_is_allowed_falls_with_amplitude():
    """0.611 rad for dim pixels, 0.349 for bright ones, and A^-0.533 between."""
    gates = AmcwImager(V2, QUIET, NEAR_AXIS, V2.nominal_lens.region_slopes(NEAR_AXIS)).engine.gates
    turns = np.linspace(0.05, 0.11, 60_001)

    def limit_of(amplitude: float) -> float:
        inputs = ranging.GateInputs(
            edge=np.zeros(turns.size),
            least=np.full(turns.size, 1e3),
            greatest=np.full(turns.size, 1e3),
            total=np.full(turns.size, 1e3),
            residual2=turns**2,
            brightest=np.full(turns.size, amplitude),
            range_m=np.full(turns.size, 1e6),
            low_m=np.ones(turns.size),
            high_m=np.ones(turns.size),
        )
        codes = ranging.first_failed_each(gates, inputs)
        assert set(codes) == {ranging.VALID, ranging.UNWRAP}
        return float(2 * np.pi * turns[codes == ranging.VALID].max())

    limit_rad = {a: limit_of(a) for a in (10, 400, 800, 5000)}
    assert limit_rad[10] == pytest.approx(0.6108653, rel=2e-5)
    assert limit_rad[5000] == pytest.approx(0.3490659, rel=2e-5)
    assert limit_rad[400] == pytest.approx(
        np.exp(3.321928 * (0.7694894 - 0.5330578 * 0.301030 * np.log(400))), rel=1e-3
    )
    assert limit_rad[400] / limit_rad[800] == pytest.approx(2**0.53306, rel=1e-4)


def test_noise_free_range_is_exact_from_half_a_metre_on():
    settings = CameraConfig(name="kinect_v2_libfreenect2", effects=NO_EFFECTS, numbers=FINE)
    camera = camera_of(settings)
    for distance_m in (0.49, 0.52, 2.0, 4.4, 4.6):
        unit = SimulatedUnit(
            camera,
            settings,
            plane_view(
                camera,
                NEAR_AXIS,
                distance_m,
                0.6,
                0.01,
                0.02,
            ),
        )
        frame = first_frame(unit)
        truth = true_z_m(unit)
        if 0.5 < distance_m < 4.5:
            assert np.abs(frame.z_m - truth).max() < 0.5e-3 + 0.05e-3
        else:
            assert (frame.reason == Reason.OUT_OF_RANGE).all()
