"""Changes of range by small changes of phasors, and the noise that batches of paths leave in it."""

import numpy as np

from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR

# lines of a long comb from which noise of range is estimated: paths are the same for all lines
NOISE_LINES = 4


def range_noise_m(
    batches: np.ndarray,
    total: np.ndarray,
    frequencies_hz: tuple[float, ...],
) -> np.ndarray:
    """Return the standard error of range (n,) of the mean over independent batches of light.

    ``batches`` (B, l, n): phasors of each batch at the frequencies of `noise_lines`.
    ``total`` (f, n): all light at all frequencies, the batches' mean included."""
    lines = noise_lines(frequencies_hz)
    line_frequencies_hz = tuple(frequencies_hz[line] for line in lines)
    deviations = batches - batches.mean(axis=0)
    changes_m = range_change_m(deviations, total[lines], line_frequencies_hz)
    return np.asarray(changes_m.std(axis=0, ddof=1) / np.sqrt(len(batches)))


def range_change_m(
    change: np.ndarray,
    total: np.ndarray,
    frequencies_hz: tuple[float, ...],
) -> np.ndarray:
    """Return the change of range (..., n) by a small change (..., f, n) of phasors ``total`` (f,
    n); 0 without light. Phases turn by Im(dH / H) and are combined with the `range_weights`."""
    weights = range_weights(frequencies_hz)[:, None]
    nothing = np.zeros(total.shape, complex)
    by_light = np.divide(
        weights,
        total,
        out=nothing,
        where=np.abs(total) > 0,
    )
    turned = change.real * by_light.imag + change.imag * by_light.real
    return np.asarray(turned.sum(axis=-2))


def range_weights(frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """Return the least-squares weights (f,) of phases in a range: c f_k / (4 pi sum f^2), in
    metres per radian."""
    frequency = np.array(frequencies_hz)
    return np.asarray(SPEED_OF_LIGHT_AIR * frequency / (4 * np.pi * (frequency**2).sum()))


def noise_lines(frequencies_hz: tuple[float, ...]) -> list[int]:
    """Return the indices of the frequencies at which noise is estimated: all, or NOISE_LINES
    spread over a longer list."""
    count = len(frequencies_hz)
    positions = np.linspace(0, count - 1, min(count, NOISE_LINES))
    return [round(position) for position in positions]
