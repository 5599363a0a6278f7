"""The light at the imager's converter, term by term."""

from __future__ import annotations

import numpy as np
import pytest

from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR, Lens, Region
from scenes.closed_form import plane_view
from scenes.sensor.amcw.exposure import AmcwExposure
from scenes.sensor.amcw.imager import AmcwImager, pixel_spans
from scenes.sensor.amcw.light import LENGTHS, RICE, light_of_samples
from scenes.sensor.amcw.windows import pixels_within, windows_of
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig

f4 = np.float32
STEPS = 2 * np.pi * np.arange(3) / 3
REGION = Region(290, 300, 310, 322)
ELECTRONS = 10_000.0
ALBEDO = 0.5


def exposure_of(numbers: dict, distance_m: float = 1.0, **effects: bool):
    """The exposure of a facing plane, and its view's intensity times the gathered light."""
    declared = {
        "photons.signal_electrons": ELECTRONS,
        "photons.electrons_per_unit": 2.0,
        "scatter.blur_px": 0.0,
        **numbers,
    }
    only = NO_EFFECTS.model_copy(update=effects)
    config = CameraConfig(effects=only, numbers=declared)
    camera = camera_of(config)
    view = plane_view(camera, REGION, distance_m, ALBEDO)
    imager = AmcwImager(camera, config, REGION, view.slopes)
    light = imager.gathered * view.intensity
    return imager.expose(view), light.ravel(), view


@pytest.mark.parametrize("read_noise", [0.0, 40.0, 300.0])
def test_a_sample_has_the_shot_noise_of_both_wells_and_the_read_noise_of_each(read_noise):
    numbers = {"photons.read_noise_electrons": read_noise}
    exposure, light, _ = exposure_of(numbers, noise=True)
    variance = ELECTRONS * light + 2 * read_noise**2
    assert exposure.sigma == pytest.approx(np.sqrt(variance) / 2.0, rel=1e-5)


def test_samples_are_those_of_the_correlation():
    """Re(S exp(-2 pi i k / N)) of the light's phasor, at three phases and frequencies."""
    exposure, light, view = exposure_of({"modulation.contrast": [0.9, 0.8, 0.7]})
    assert (exposure.sigma == 0).all()
    assert exposure.shape == REGION.shape
    phase = np.angle(view.phasor.reshape(3, -1))
    for f, contrast in enumerate((0.9, 0.8, 0.7)):
        amplitude = contrast * ELECTRONS * light / 2.0
        for k, step in enumerate(STEPS):
            expected = amplitude * np.cos(phase[f] - step)
            assert exposure.means[f, k] == pytest.approx(expected, rel=1e-4, abs=0.05)


def test_errors_that_all_frames_share_delay_the_light():
    numbers = {"unit.drift_mm": 40.0, "unit.drift_ramp": 0.0}
    exposure, _, _ = exposure_of(numbers)
    shifted, _, _ = exposure_of(numbers, warm_up_drift=True)
    waves = np.exp(1j * STEPS)[:, None]
    turned = np.angle((shifted.means * waves).sum(axis=1))
    turned -= np.angle((exposure.means * waves).sum(axis=1))
    error_m = 0.040 * np.exp(-60 / 20)
    for f, frequency_hz in enumerate(camera_of(CameraConfig()).frequencies_hz):
        expected = 4 * np.pi * frequency_hz * error_m / SPEED_OF_LIGHT_AIR
        off = np.exp(1j * (turned[f] - expected))
        assert off == pytest.approx(1, abs=1e-4)


def test_the_fuller_well_or_the_converter_limits_a_sample():
    """Half of both wells' electrons and half the sample fit into one well."""
    assert np.isinf(exposure_of({})[0].limit).all()
    wide = {
        "photons.full_well_electrons": 16_000.0,
        "converter.full_scale_units": 10**6,
    }
    exposure, light, _ = exposure_of(wide, saturation=True)
    room = 2 * 16_000 - ELECTRONS * light
    assert exposure.limit == pytest.approx(room / 2.0, rel=1e-5)
    narrow = {**wide, "converter.full_scale_units": 300}
    assert (exposure_of(narrow, saturation=True)[0].limit == 300).all()
    full = {**wide, "photons.full_well_electrons": 1.0}
    assert (exposure_of(full, saturation=True)[0].limit == 0).all()


def test_pixels_span_the_slopes_between_their_neighbours():
    """The inverse of the area that a lens's map from slopes to pixels makes of a small square."""
    lens = Lens(
        width=400,
        height=300,
        fx=300.0,
        fy=310.0,
        cx=200.0,
        cy=150.0,
        distortion=(0.05, 0.02, 0.01, -0.02, 0.01, 0.03, 0.01, 0.02),
    )
    slopes = np.array([[0.3, -0.2], [-0.1, 0.4]])
    moved_x = moved_by(lens, slopes, [1e-5, 0.0])
    moved_y = moved_by(lens, slopes, [0.0, 1e-5])
    areas = np.linalg.det(np.stack([moved_x, moved_y], axis=1))
    assert pixel_spans(lens, slopes) == pytest.approx(1 / areas, rel=1e-5)


def moved_by(lens: Lens, slopes: np.ndarray, step: list[float]) -> np.ndarray:
    """(n, 2): derivative of pixels over the focal lengths by slopes (n, 2), along a step."""
    ones = np.ones((len(slopes), 1))
    ahead = lens.project(np.append(slopes + step, ones, axis=1))
    behind = lens.project(np.append(slopes - step, ones, axis=1))
    per_slope = (ahead - behind) / (2 * sum(step))
    return per_slope / [lens.fx, lens.fy]


def test_light_of_samples_is_what_noisy_samples_show():
    """Mean amplitude and deviations against 100,000 draws of three samples: noisy, and so dim
    that the mean length is by Rice."""
    rng = np.random.default_rng(4)
    amplitude = np.array([40.0, 6.0])
    phase = np.array([0.7, 2.0])
    means = amplitude * np.cos(phase - STEPS[:, None])
    sigma = np.array([4.0, 4.0], f4)
    exposure = exposure_without_limit(means, sigma)
    light = light_of_samples(exposure, 1e6, np.array([1.5]))
    samples = means + sigma * rng.standard_normal((100_000, 3, 2))
    # the converter's rounding to whole units
    weights = np.exp(1j * STEPS) * 2 / 3 * 1.5
    phasor = np.einsum("dkn,k->dn", np.round(samples), weights)
    assert light.phasor[0] == pytest.approx(np.exp(1j * phase), abs=1e-5)
    assert light.amplitude[0] == pytest.approx(1.5 * amplitude, rel=1e-5)
    mean_amplitude = np.abs(phasor).mean(axis=0)
    assert light.mean_amplitude[0] == pytest.approx(mean_amplitude, rel=0.003)
    relative = phasor * np.conj(light.phasor[0]) / light.amplitude[0]
    phase_noise = relative.imag.std(axis=0)
    assert light.phase_noise[0] == pytest.approx(phase_noise, rel=0.01)
    relative_noise = relative.real.std(axis=0)
    assert light.relative_noise[0] == pytest.approx(relative_noise, rel=0.01)


def exposure_without_limit(means: np.ndarray, sigma: np.ndarray) -> AmcwExposure:
    """One frequency of n pixels in a row, with samples (k, n)."""
    n = sigma.size
    return AmcwExposure(
        means=means[None].astype(f4),
        sigma=sigma,
        limit=np.full(n, np.inf, f4),
        time_share=np.ones(n, f4),
        shape=(1, n),
    )


def test_coarse_steps_of_the_converter_are_noise():
    """At samples from 4 to 8 knees the step is 4: a variance of 16/12, and none of shot noise."""
    means = np.array([[50.0], [0.0], [0.0]])
    exposure = exposure_without_limit(means, np.zeros(1, f4))
    light = light_of_samples(exposure, 10.0, np.ones(1))
    variance = np.array([16.0, 1.0, 1.0]) / 12
    across = np.sqrt((variance * np.sin(STEPS) ** 2).sum())
    along = np.sqrt((variance * np.cos(STEPS) ** 2).sum())
    assert light.phase_noise[0, 0] == pytest.approx(across / 50.0, rel=1e-5)
    assert light.relative_noise[0, 0] == pytest.approx(along / 50.0, rel=1e-5)


def test_rices_mean_by_hand():
    """sqrt(pi / 2) of a vector of noise alone; L + 1 / (2 L) of a long one."""
    assert RICE[0] == pytest.approx(np.sqrt(np.pi / 2))
    longest = LENGTHS[-1]
    assert RICE[-1] == pytest.approx(longest + 0.5 / longest, abs=1e-4)


def test_windows_and_pixels_that_they_touch():
    image = np.arange(12).reshape(3, 4)
    windows = windows_of(image, 3, -1, np.array([0, 6]))
    corner, inner = windows.reshape(2, 3, 3)
    assert corner[1:, 1:].tolist() == image[:2, :2].tolist()
    assert (corner[0] == -1).all()
    assert (corner[:, 0] == -1).all()
    assert inner.tolist() == image[:, 1:].tolist()
    wanted = np.zeros((4, 5), bool)
    wanted[0, 3] = True
    touched = pixels_within(wanted, 3)
    assert np.flatnonzero(touched).tolist() == [2, 3, 4, 7, 8, 9]
