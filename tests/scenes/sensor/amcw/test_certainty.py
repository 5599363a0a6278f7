"""Even pixels against the linear model, and sorted pixels against frames."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from harness.vocabulary.geometry import Region
from harness.vocabulary.seeds import random_stream
from scenes.closed_form import plane_view
from scenes.sensor.amcw import kernels, ranging
from scenes.sensor.amcw.certainty import _may_fly
from scenes.sensor.amcw.even import EvenMoves, even_pixels, fill_even
from scenes.sensor.amcw.light import Light
from scenes.sensor.amcw.linear import Filtered, linearised, unknown_filtered
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig, EffectsConfig
from scenes.sensor.source import SimulatedUnit

f4 = np.float32
SHAPE = (15, 17)
INNER = (slice(4, -4), slice(4, -4))


def even_light(noise: float, checked: bool = False) -> Light:
    """One frequency of a bright, gently tilted surface, or of one whose pixels lie alternately
    nearer and farther, so that each differs from the mean around it."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    phase = (0.01 * u + 0.006 * v).reshape(1, -1)
    if checked:
        phase = 0.02 * ((u + v) % 2).reshape(1, -1)
    amplitude = (300.0 + 2.0 * u - v).reshape(1, -1)
    phase_noise = np.full(amplitude.shape, noise)
    return Light(
        phasor=np.exp(1j * phase).astype(np.complex64),
        amplitude=amplitude.astype(f4),
        mean_amplitude=(amplitude * np.sqrt(1 + noise**2)).astype(f4),
        phase_noise=phase_noise.astype(f4),
        relative_noise=(0.8 * phase_noise).astype(f4),
    )


def settings_of(by_amplitude: bool) -> kernels.FilterSettings:
    offset = np.arange(-2, 3)
    taps = np.exp(-(offset**2) / 8)
    return kernels.FilterSettings(
        space=np.outer(taps, taps).astype(f4),
        concentration=f4(3.6),
        dim=f4(3.0),
        drop_dim=True,
        dim_edges=True,
        by_amplitude=by_amplitude,
    )


def filled_both_ways(
    light: Light, settings: kernels.FilterSettings
) -> tuple[np.ndarray, Filtered, EvenMoves, Filtered, np.ndarray]:
    """The even pixels (flat indices), what they are filled with and their moves; the same by the
    linear model."""
    n = SHAPE[0] * SHAPE[1]
    alone = np.empty((1, 3, *SHAPE), f4)
    edge = np.empty((1, *SHAPE), f4)
    planes = np.stack([light.phasor.real, light.phasor.imag])
    unit = planes.reshape(2, *SHAPE)
    strength = light.amplitude if settings.by_amplitude else light.mean_amplitude
    kernels.filter_image(unit, strength.reshape(SHAPE), settings, alone[0], edge[0])
    flat_edge = edge.reshape(1, n)
    even = even_pixels(flat_edge, light, settings, SHAPE)
    assert even.reshape(SHAPE)[2:-2, 2:-2].all()
    assert even.sum() == 11 * 13
    filtered = unknown_filtered(1, n)
    moves = fill_even(even, alone.reshape(1, 3, n), flat_edge, light, settings, SHAPE, filtered)
    expected = unknown_filtered(1, n)
    pixels = np.flatnonzero(even)
    expected_moves = linearised(pixels, light, settings, SHAPE, expected).phase[0]
    return pixels, filtered, moves, expected, expected_moves


@pytest.mark.parametrize("noise", [0.02, 0.1])
@pytest.mark.parametrize("by_amplitude", [False, True])
def test_even_pixels_are_filled_as_the_linear_model_would(by_amplitude: bool, noise: float):
    settings = settings_of(by_amplitude)
    light = even_light(noise)
    pixels, filtered, moves, expected, expected_moves = filled_both_ways(light, settings)
    tolerances = {
        "phasor": 1e-4,
        "amplitude": 3e-4,
        "phase_noise": 0.003,
        "amplitude_noise": 0.02,
        "higher_share": 0.06,
        "edge": 0.02,
    }
    for name, tolerance in tolerances.items():
        value = getattr(filtered, name)[0, pixels]
        wanted = getattr(expected, name)[0, pixels]
        assert value == pytest.approx(wanted, rel=tolerance, abs=2e-5), name
    # the part by the phases' differences is a bound
    bound = filtered.edge_noise[0, pixels] / expected.edge_noise[0, pixels]
    assert bound.min() > 0.97
    assert bound.max() < (1.6 if noise < 0.1 else 1.1)
    # by a neighbour, of each weight, and by the centre
    carried = light.amplitude[0, pixels] if by_amplitude else 1.0
    by_neighbour = moves.by_neighbour[0] * carried * noise
    corner = by_neighbour * settings.space[0, 0]
    assert corner == pytest.approx(expected_moves[:, 0], rel=0.05)
    assert moves.by_centre[0] == pytest.approx(expected_moves[:, 12], rel=0.015)


@pytest.mark.parametrize("by_amplitude", [False, True])
def test_noise_moves_the_mean_towards_the_centres_own_phase(by_amplitude: bool) -> None:
    """By a 25th of the distance of 0.01 rad, as noise of 0.1 rad lowers the neighbours' weights by
    3.6 x 0.01."""
    light = even_light(0.1, checked=True)
    pixels, filtered, _, expected, _ = filled_both_ways(light, settings_of(by_amplitude))
    turn = np.angle(filtered.phasor[0, pixels] / expected.phasor[0, pixels])
    assert np.abs(turn).max() < 5e-5
    still_light = even_light(1e-3, checked=True)
    pixels, still, *_ = filled_both_ways(still_light, settings_of(by_amplitude))
    moved = np.angle(filtered.phasor[0, pixels] / still.phasor[0, pixels])
    own = np.angle(light.phasor[0, pixels] / still.phasor[0, pixels])
    assert moved == pytest.approx(0.036 * own, rel=0.15)
    assert np.abs(own).min() > 0.008


def test_pixels_that_are_not_even():
    """Beside a dim pixel, a rim, uneven noise or too much of it."""
    settings = settings_of(True)
    n = SHAPE[0] * SHAPE[1]
    middle = 7 * SHAPE[1] + 8
    edge = np.zeros((1, n), f4)
    one_pixel = np.zeros(n, bool)
    one_pixel[middle] = True

    def even_beside(light: Light, edge: np.ndarray) -> int:
        even = even_pixels(edge, light, settings, SHAPE)
        return int(11 * 13 - even.sum())

    light = even_light(0.05)
    assert even_beside(light, edge) == 0
    assert even_beside(light, np.where(one_pixel, f4(0.005), edge)) == 1
    dim = light._replace(amplitude=np.where(one_pixel, f4(3.5), light.amplitude))
    assert even_beside(dim, edge) == 25
    noisier = np.where(one_pixel, f4(0.063), light.phase_noise)
    # c s^2 from 0.009 to 0.0143
    assert even_beside(light._replace(phase_noise=noisier), edge) == 25
    assert even_beside(even_light(0.16), edge) == 11 * 13


# ---------------------------------------------------------------- sorted pixels

REGION = Region(300, 324, 300, 330)


@lru_cache
def unit_with(distance_m: float, albedo: float) -> SimulatedUnit:
    """A unit before a tilted plane, with an output whose steps hide nothing."""
    config = CameraConfig(
        effects=EffectsConfig(frame_jumps=False, ambient=False),
        numbers={"engine.output_step_mm": 1e-3},
    )
    camera = camera_of(config)
    view = plane_view(camera, REGION, distance_m, albedo, 0.2, 0.1)
    return SimulatedUnit(camera, config, view)


def test_certain_pixels_have_the_mean_and_the_deviations_of_frames():
    """Of 100 frames, over 500 pixels that share their noise: deviations to 2 %."""
    unit = unit_with(0.7, 0.6)
    model = unit.first_order
    assert model is not None
    linear = model.linear

    def cut(values: np.ndarray) -> np.ndarray:
        return values.reshape(model.shape)[unit.cut]

    assert cut(linear.is_linear).all()
    rng = random_stream(7)
    z_m = np.empty((100, *cut(linear.z).shape))
    amplitude = np.empty(z_m.shape)
    for number in range(100):
        frame = unit.model.frame(unit.exposure, rng)
        z_m[number] = frame.z_m[unit.cut]
        amplitude[number] = frame.amplitude[unit.cut]
    # one deviation in steps of 1 um: of each neighbour, and of the centre
    weights2 = (linear.taps**2).sum() ** 2
    middle = linear.taps[len(linear.taps) // 2] ** 2
    of_centre = linear.by_neighbour * middle + linear.by_centre
    variance = linear.by_neighbour**2 * (weights2 - middle**2) + of_centre**2
    deviation_m = cut(np.sqrt(variance) * linear.noise) * 1e-6
    off = (z_m.mean(axis=0) - cut(linear.base + linear.z) * 1e-6) / deviation_m
    assert np.abs(off).max() < 5 / np.sqrt(100)
    assert abs(off.mean()) < 0.05
    ratio = np.sqrt((z_m.var(axis=0, ddof=1) / deviation_m**2).mean())
    assert ratio == pytest.approx(1.0, abs=0.06)
    assert amplitude.mean(axis=0) == pytest.approx(cut(linear.amplitude), rel=0.01)
    expected = cut(linear.amplitude_noise) ** 2
    ratio = np.sqrt((amplitude.var(axis=0, ddof=1) / expected).mean())
    assert ratio == pytest.approx(1.0, abs=0.06)


def test_z_changes_with_the_path_as_a_displaced_frame_does():
    unit = unit_with(0.35, 0.3)
    filtered_at = unit.model.frame(unit.exposure, random_stream(7))
    displaced = unit.model.frame(unit.exposure, random_stream(7), 0.002)
    by_path = (displaced.z_m - filtered_at.z_m)[unit.cut] / 0.002
    model = unit.first_order
    assert model is not None
    expected = model.linear.by_path.reshape(model.shape)[unit.cut]
    assert by_path == pytest.approx(expected, abs=2e-3)


GATE = ranging.FlyingGate(
    relative_deviation=f4(0.05),
    least_mean=f4(1.0),
    near_m=f4(0.05),
    far_m=f4(0.03),
    most_m=f4(0.1),
)


@pytest.mark.parametrize(
    ("nearer_m", "farther_m", "reach_m", "linear", "flies"),
    [
        (0.06, 0.04, 0.0, True, True),
        (0.04, 0.04, 0.0, True, False),
        (0.06, 0.02, 0.0, True, False),
        (0.04, 0.04, 0.006, True, True),  # noise of both pixels carries it over
        (0.04, 0.04, 0.004, True, False),
        (0.04, 0.04, 0.0, False, True),  # of a neighbour nothing is known, and one is farther
    ],
)
def test_pixels_that_may_fly(nearer_m, farther_m, reach_m, linear, flies):
    z_m = np.ones((5, 5))
    z_m[2, 1] -= nearer_m
    z_m[2, 3] += farther_m
    is_linear = np.ones((5, 5), bool)
    is_linear[2, 1] = linear
    reach = np.full((5, 5), reach_m)
    may_fly = _may_fly(GATE, z_m, reach, is_linear).reshape(5, 5)
    assert bool(may_fly[2, 2]) == flies
