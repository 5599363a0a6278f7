"""Each pixel's light before the filter in NumPy (`scenes.sensor.amcw.light`): one frequency."""

import numpy as np


def light_of_frequency(
    means: np.ndarray, sigma: np.ndarray, knee: float, gain: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the direction of the mean phasor, its amplitude, and the deviations of its phase and,
    over the amplitude, of its amplitude, (n,) each. ``means`` (k, n) and ``sigma`` (n,) as in
    `scenes.sensor.amcw.exposure.AmcwExposure`; some light is on every pixel."""
    phases = len(means)
    steps = np.exp(2j * np.pi * np.arange(phases) / phases)
    total = steps @ means
    direction = total / np.abs(total)
    # the companding converter rounds to powers of two
    converter_step = 2.0 ** np.maximum(np.floor(np.log2(np.abs(means) / knee)), 0)
    variance = sigma**2 + converter_step**2 / 12
    turned = steps[:, None] * np.conj(direction)
    across = np.sqrt((variance * turned.imag**2).sum(axis=0))
    along = np.sqrt((variance * turned.real**2).sum(axis=0))
    length = np.abs(total)
    return direction, gain * 2 / phases * length, across / length, along / length
