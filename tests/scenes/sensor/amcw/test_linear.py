"""The compiled linear model against its plain references."""

from __future__ import annotations

import numpy as np
import pytest

from scenes.sensor.amcw.kernels import FilterSettings
from scenes.sensor.amcw.light import Light
from scenes.sensor.amcw.linear import Filtered, Moves, linearised, unknown_filtered
from scenes.sensor.amcw.linear_frames import Linear, draw_linear_frame
from scenes.sensor.amcw.linear_frames_reference import linear_frame
from scenes.sensor.amcw.linear_reference import PixelWindow, linearised_pixel

f4 = np.float32
SHAPE = (9, 11)
SIDE = 5
CONCENTRATION = 3.6
DIM = 3.0
BRIGHT = 400.0


def random_light(seed: int, noise: float) -> Light:
    """One frequency of a picture of random phases, bright enough for every gate."""
    rng = np.random.default_rng(seed)
    n = SHAPE[0] * SHAPE[1]
    phase = 0.3 * rng.standard_normal((1, n))
    amplitude = BRIGHT * rng.uniform(0.5, 1.5, (1, n))
    phase_noise = noise * rng.uniform(0.3, 1.0, (1, n))
    return Light(
        phasor=np.exp(1j * phase).astype(np.complex64),
        amplitude=amplitude.astype(f4),
        mean_amplitude=(amplitude * np.sqrt(1 + phase_noise**2)).astype(f4),
        phase_noise=phase_noise.astype(f4),
        relative_noise=(phase_noise * rng.uniform(0.2, 0.6, (1, n))).astype(f4),
    )


def settings_of(by_amplitude: bool, drop_dim: bool = True, dim_edges: bool = False):
    offset = np.arange(SIDE) - SIDE // 2
    space = np.exp(-np.add.outer(offset**2, offset**2) / 18)
    return FilterSettings(
        space=space.astype(f4),
        concentration=f4(CONCENTRATION),
        dim=f4(DIM),
        drop_dim=drop_dim,
        dim_edges=dim_edges,
        by_amplitude=by_amplitude,
    )


def filtered_by_kernel(light: Light, settings: FilterSettings) -> tuple[Filtered, Moves]:
    """All pixels of a picture."""
    n = SHAPE[0] * SHAPE[1]
    filtered = unknown_filtered(1, n)
    return filtered, linearised(np.arange(n), light, settings, SHAPE, filtered)


def window_at(light: Light, settings: FilterSettings, i: int) -> PixelWindow:
    """The reference's window of pixel i; pixels beyond the border repeat it, with weight 0."""
    h, w = SHAPE
    half = SIDE // 2
    indices = np.full(SIDE**2, i)
    space = np.zeros(SIDE**2)
    for q in range(SIDE**2):
        row = i // w + q // SIDE - half
        column = i % w + q % SIDE - half
        if 0 <= row < h and 0 <= column < w:
            indices[q] = row * w + column
            space[q] = settings.space.ravel()[q]
    amplitude = light.amplitude[0, indices].astype(float)
    direction = light.phasor[0, indices] * np.conj(light.phasor[0, i])
    return PixelWindow(
        phase=np.angle(direction).astype(float),
        amplitude=amplitude,
        mean_amplitude=light.mean_amplitude[0, indices].astype(float),
        phase_noise=light.phase_noise[0, indices].astype(float),
        amplitude_noise=amplitude * light.relative_noise[0, indices],
        space=space,
        concentration=float(settings.concentration),
        by_amplitude=settings.by_amplitude,
    )


@pytest.mark.parametrize("noise", [0.12, 0.34])
@pytest.mark.parametrize("by_amplitude", [False, True])
def test_the_linear_model_is_that_of_its_reference(by_amplitude: bool, noise: float):
    """On every pixel, those at the border included, with noise at which terms of second order
    count, and with all that the model allows."""
    light = random_light(1, noise)
    settings = settings_of(by_amplitude)
    filtered, moves = filtered_by_kernel(light, settings)
    for i in range(SHAPE[0] * SHAPE[1]):
        expected, expected_moves = linearised_pixel(window_at(light, settings, i))
        centre = light.phasor[0, i]
        assert filtered.phasor[0, i] * np.conj(centre) == pytest.approx(expected.phasor, abs=1e-6)
        for name in Filtered._fields[1:]:
            value = getattr(filtered, name)[0, i]
            assert value == pytest.approx(getattr(expected, name), rel=2e-5, abs=1e-7), name
        np.testing.assert_allclose(moves.phase[0, i], expected_moves.phase, rtol=3e-5, atol=1e-7)
        size = np.abs(expected_moves.amplitude)
        np.testing.assert_allclose(np.abs(moves.amplitude[0, i]), size, rtol=1e-4, atol=1e-5)
        same_sign = moves.amplitude[0, i] * expected_moves.amplitude >= 0
        assert same_sign.mean() > 0.95  # where both parts cancel, it hangs on the last digit


@pytest.mark.parametrize("by_amplitude", [False, True])
def test_the_model_foretells_the_filter_of_noisy_phasors(by_amplitude: bool):
    """Mean and deviation of the phase of one window, in 40,000 draws of the filter itself, which
    tell both to 0.5 % of the deviation."""
    light = random_light(2, 0.10)
    settings = settings_of(by_amplitude)
    i = 4 * SHAPE[1] + 5
    window = window_at(light, settings, i)
    filtered, _ = filtered_by_kernel(light, settings)
    rng = np.random.default_rng(3)
    draws = 40_000
    along = 1 + window.amplitude_noise / window.amplitude * rng.standard_normal((draws, SIDE**2))
    across = window.phase_noise * rng.standard_normal((draws, SIDE**2))
    noisy = (along + 1j * across) * np.exp(1j * window.phase)
    unit = noisy / np.abs(noisy)
    cosine = np.real(unit * np.conj(unit[:, SIDE**2 // 2, None]))
    weight = window.space * np.exp(-CONCENTRATION * (1 - cosine))
    total = (weight * (noisy * window.amplitude if by_amplitude else unit)).sum(axis=1)
    centre = np.conj(light.phasor[0, i])
    phase = np.angle(total * np.conj(filtered.phasor[0, i] * centre))
    deviation = float(filtered.phase_noise[0, i])
    assert phase.std() == pytest.approx(deviation, rel=0.02)
    assert phase.mean() == pytest.approx(0, abs=0.03 * deviation)
    edge = (1 - cosine).sum(axis=1) / 2
    assert edge.mean() == pytest.approx(filtered.edge[0, i], rel=0.02)
    assert edge.std() == pytest.approx(filtered.edge_noise[0, i], rel=0.05)


def neighbour_of(amplitude: float, phase_noise: float, settings: FilterSettings) -> Filtered:
    """The filtered middle pixel of a bright picture beside one other pixel."""
    light = random_light(1, 0.01)
    middle = SHAPE[0] // 2 * SHAPE[1] + SHAPE[1] // 2
    light.amplitude[0, middle + 1] = amplitude
    light.mean_amplitude[0, middle + 1] = amplitude
    light.phase_noise[0, middle + 1] = phase_noise
    light.relative_noise[0, middle + 1] = 0.1
    filtered, _ = filtered_by_kernel(light, settings)
    return Filtered._make(part[:, middle] for part in filtered)


@pytest.mark.parametrize(
    ("amplitude", "certain"),
    [
        (DIM * 0.5, True),  # never counts: 1.5 and 4.5 deviations of a tenth
        (DIM * 0.8, False),
        (DIM * 1.2, False),
        (DIM * 2.0, True),
    ],
)
def test_a_neighbour_of_which_it_is_uncertain_whether_it_counts_is_told(amplitude, certain):
    filtered = neighbour_of(amplitude, 0.01, settings_of(True))
    assert np.isfinite(filtered.higher_share[0]) == certain
    assert np.isfinite(filtered.edge[0]) == certain
    # where no dim neighbour is dropped, it is certain in any case
    kept = neighbour_of(amplitude, 0.01, settings_of(True, drop_dim=False))
    assert np.isfinite(kept.higher_share[0])


def test_with_a_neighbour_that_is_too_noisy_nothing_is_known():
    """Beyond 0.35 rad."""
    calm = neighbour_of(BRIGHT, 0.34, settings_of(False))
    wild = neighbour_of(BRIGHT, 0.36, settings_of(False))
    assert np.isfinite(calm.phase_noise[0])
    assert np.isfinite(calm.edge[0])
    assert np.isinf(wild.phase_noise[0])
    assert np.isinf(wild.edge[0])


def random_linear(rng: np.random.Generator) -> Linear:
    """Pixels of all kinds, with a window of 5 x 5."""
    n = SHAPE[0] * SHAPE[1]
    uneven = np.flatnonzero(rng.random(n) < 0.3)
    z = rng.uniform(-0.5, 0.5, n)
    z[rng.random(n) < 0.3] = np.nan
    return Linear(
        noise=rng.uniform(1.0, 3.0, n).astype(f4),
        base=rng.integers(600, 700, n).astype(f4),
        z=z.astype(f4),
        by_path=rng.uniform(0.9, 1.0, n).astype(f4),
        by_neighbour=rng.uniform(2.0, 3.0, n).astype(f4),
        by_centre=rng.uniform(-1.0, 1.0, n).astype(f4),
        uneven=uneven,
        moves=rng.standard_normal((len(uneven), SIDE**2)).astype(f4),
        amplitude_moves=rng.standard_normal((len(uneven), SIDE**2)).astype(f4),
        taps=np.array([0.1, 0.2, 0.4, 0.2, 0.1], f4),
        amplitude=rng.uniform(50.0, 100.0, n).astype(f4),
        amplitude_noise=rng.uniform(1.0, 2.0, n).astype(f4),
    )


def test_a_frame_of_linear_pixels_is_that_of_its_reference():
    """Whole steps; one value in a thousand may round the other way."""
    rng = np.random.default_rng(5)
    linear = random_linear(rng)
    # uneven pixels have no other moves
    linear.by_neighbour[linear.uneven] = 0
    linear.by_centre[linear.uneven] = 0
    n = linear.z.size
    z_m = np.empty(n, f4)
    amplitude = np.empty(n, f4)
    step_m = 0.25
    for error in (-2.7, 0.0, 1.3):
        normals = rng.standard_normal((2, n)).astype(f4)
        draw_linear_frame(
            SHAPE,
            linear,
            normals,
            f4(error),
            f4(step_m),
            z_m,
            amplitude,
        )
        steps, expected_amplitude = linear_frame(SHAPE, linear, normals, error)
        off = z_m / step_m - steps
        assert np.array_equal(np.isnan(z_m), np.isnan(linear.z))
        assert np.nanmax(np.abs(off)) <= 1
        assert np.count_nonzero(np.nan_to_num(off)) <= 1
        np.testing.assert_allclose(amplitude, expected_amplitude, rtol=1e-5)
