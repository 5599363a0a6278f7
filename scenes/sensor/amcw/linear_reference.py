"""The linear model of `scenes.sensor.amcw.linear` for one pixel and frequency, in plain NumPy.

Notation as there: t the neighbours' phases minus the centre's, s their weights by distance, v the
variance of their phases, v0 that of the centre's, F(t) = exp(i t - c (1 - cos t)). For pixels
whose neighbours certainly count and are not too noisy."""

from typing import NamedTuple

import numpy as np

from scenes.sensor.amcw.linear import Filtered, Moves

NODES = ((0.0, 2 / 3), (np.sqrt(3.0), 1 / 6), (-np.sqrt(3.0), 1 / 6))  # deviations, weights


class PixelWindow(NamedTuple):
    """The k pixels of a window without noise; the centre, at index k // 2, has phase 0."""

    phase: np.ndarray
    """(k,) radians."""
    amplitude: np.ndarray
    """(k,) converter units."""
    mean_amplitude: np.ndarray
    """(k,): with noise."""
    phase_noise: np.ndarray
    """(k,) radians."""
    amplitude_noise: np.ndarray
    """(k,) converter units."""
    space: np.ndarray
    """(k,): weights by distance, 0 for pixels that do not count."""
    concentration: float
    by_amplitude: bool


def derivatives(c: float, t: np.ndarray) -> list[np.ndarray]:
    """Return F and its first five derivatives by t, from those of ln F."""
    g1 = 1j - c * np.sin(t)
    g2 = -c * np.cos(t)
    g3 = c * np.sin(t)
    value = np.exp(1j * t - c * (1 - np.cos(t)))
    fourth = g1**4 + 6 * g1**2 * g2 + 3 * g2**2 + 4 * g1 * g3 - g2
    fifth = g1**5 + 10 * g1**3 * g2 + 15 * g1 * g2**2 + 10 * g1**2 * g3
    fifth = fifth + 10 * g2 * g3 - 5 * g1 * g2 - g3
    over = [1.0, g1, g1**2 + g2, g1**3 + 3 * g1 * g2 + g3, fourth, fifth]
    return [value * factor for factor in over]


def linearised_pixel(window: PixelWindow) -> tuple[Filtered, Moves]:
    """Return the filtered pixel to first order in the noise, as scalars, and (k,) its moves."""
    centre = len(window.phase) // 2
    is_neighbour = np.arange(len(window.phase)) != centre
    c = window.concentration
    t = window.phase
    s = window.space
    v = window.phase_noise**2 * is_neighbour
    v0 = window.phase_noise[centre] ** 2
    loss = v + np.where(is_neighbour, v0, 0.0)
    plain_weight = s * np.exp(-c * (1 - np.cos(t)))

    # the phase: its mean, and its moves by neighbours, in the mean over the centre's noise
    carried = s * window.amplitude * (1 + window.phase_noise**2 / 2) if window.by_amplitude else s
    mean_phasor = 0j
    by_phase = np.zeros(len(t))
    for deviations, share in NODES:
        angle = deviations * window.phase_noise[centre]
        F = derivatives(c, np.where(is_neighbour, t - angle, 0.0))
        S = (carried * (F[0] + v / 2 * F[2] + v**2 / 8 * F[4])).sum()
        first = carried * (F[1] + v / 2 * F[3] + v**2 / 8 * F[5]) / S * is_neighbour
        second = carried * (F[2] + v / 2 * F[4]) / S
        squares = (v * first**2).sum()  # E[dS^2] / S^2
        by_phase += share * np.imag(first * (1 + squares - v * second))
        mean_phasor += share * np.exp(1j * angle) * S / abs(S) * (1 - 0.5j * squares.imag)
    # its variance: terms of second and third order without noise, neighbours, centre
    F = derivatives(c, t)
    size = s * window.amplitude if window.by_amplitude else s
    S = (size * F[0]).sum()
    second = np.imag(size * F[2] / S) * is_neighbour
    third = np.imag(size * F[3] / S)
    higher = (v * (second**2 * (v / 2 + v0) + third**2 / 6 * v * (v + 3 * v0))).sum()
    higher += 0.5 * (second.sum() * v0) ** 2
    by_length = np.imag(s * F[0] / S) * window.amplitude_noise * window.by_amplitude
    moves = np.sqrt(by_phase**2 * v + by_length**2) * np.sign(by_phase)
    moves[centre] = np.sqrt((1 - by_phase.sum()) ** 2 * v0 + higher)
    variance = (moves**2).sum()

    # the amplitude: weights in the mean over noise, then how noise of phases changes it
    curvature = c**2 * np.sin(t) ** 2 - c * np.cos(t)
    blurred = 1 + np.minimum(loss, 0.25) / 2 * curvature
    weight = np.where(is_neighbour, plain_weight * blurred, s)
    total = (weight * window.amplitude * np.exp(1j * t)).sum()
    amplitude = abs(total) if window.by_amplitude else (weight * window.mean_amplitude).sum()
    amplitude = amplitude / weight.sum()
    slope = c * np.sin(t)
    change = slope * plain_weight * (amplitude - window.mean_amplitude)
    if window.by_amplitude:
        along = np.real(np.exp(1j * t) * (1j - slope) * np.conj(total)) / abs(total)
        change = plain_weight * (window.amplitude * along + slope * amplitude)
    change = change * is_neighbour
    noise = np.minimum(window.phase_noise, 0.5)
    by_amplitude = weight * window.amplitude_noise
    by_own_phase = change * noise
    by_own_phase[centre] = change.sum() * noise[centre]
    amplitude_moves = np.hypot(by_amplitude, by_own_phase) / weight.sum()
    amplitude_moves = np.copysign(amplitude_moves, by_amplitude + by_own_phase)
    amplitude_noise = np.sqrt((amplitude_moves**2).sum())
    if window.by_amplitude:
        amplitude *= 1 + variance / 2

    # the edge sum of (1 - cos t)/2
    counted = (s > 0) & is_neighbour
    edge = (counted * (1 - np.cos(t) * np.maximum(1 - loss / 2, 0)) / 2).sum()
    edge_variance = (counted * np.sin(t) ** 2 / 4 * v).sum()
    edge_variance += (counted * np.cos(t) ** 2 / 8 * v * (v + 2 * v0)).sum()
    edge_variance += ((counted * np.sin(t)).sum() / 2) ** 2 * v0
    edge_variance += 2 * ((counted * np.cos(t)).sum() / 4 * v0) ** 2
    edge_noise = np.sqrt(edge_variance)
    filtered = Filtered(
        phasor=np.asarray(mean_phasor / abs(mean_phasor)),
        amplitude=amplitude,
        phase_noise=np.sqrt(variance),
        amplitude_noise=amplitude_noise,
        higher_share=higher / variance,
        edge=edge,
        edge_noise=edge_noise,
    )
    return filtered, Moves(moves, amplitude_moves)
