"""Each pixel's light before the filter against its plain reference, and against noisy readings."""

import numpy as np
import pytest

from scenes.sensor.amcw.exposure import AmcwExposure
from scenes.sensor.amcw.light import Light, light_of_samples
from scenes.sensor.amcw.light_reference import light_of_frequency

f4 = np.float32
PIXELS = 500
KNEE = 100.0
"""Samples below and above it: the converter's step is 1 to 8 units."""
GAINS = np.array([1.0, 0.7], f4)


def exposure_of(phases: int) -> AmcwExposure:
    """Two frequencies of pixels between dim and bright."""
    rng = np.random.default_rng(phases)
    steps = 2 * np.pi * np.arange(phases) / phases
    amplitude = rng.uniform(20.0, 1000.0, (2, 1, PIXELS))
    phase = rng.uniform(0.0, 2 * np.pi, (2, 1, PIXELS))
    return AmcwExposure(
        means=(amplitude * np.cos(phase - steps[:, None])).astype(f4),
        sigma=rng.uniform(2.0, 8.0, PIXELS).astype(f4),
        limit=np.full(PIXELS, np.inf, f4),
        time_share=np.ones(PIXELS, f4),
        shape=(1, PIXELS),
    )


@pytest.mark.parametrize("phases", [3, 4, 9])
def test_light_is_that_of_its_reference(phases: int) -> None:
    exposure = exposure_of(phases)
    light = light_of_samples(exposure, KNEE, GAINS)
    for f, means in enumerate(exposure.means.astype(float)):
        expected = light_of_frequency(means, exposure.sigma.astype(float), KNEE, GAINS[f])
        found = (light.phasor, light.amplitude, light.phase_noise, light.relative_noise)
        for values, of_reference in zip(found, expected, strict=True):
            np.testing.assert_allclose(values[f], of_reference, rtol=2e-5, atol=2e-6)


def test_a_pixel_without_light_has_some_direction_and_no_amplitude() -> None:
    exposure = exposure_of(4)
    exposure.means[..., 0] = 0
    light = Light._make(part[:, 0] for part in light_of_samples(exposure, KNEE, GAINS))
    assert (light.phasor == 1).all()
    assert light.amplitude.max() < 1e-9
    assert np.isfinite(light.mean_amplitude).all()
