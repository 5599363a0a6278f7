"""Pixels whose window shows one even surface: noise lowers the weight of all neighbours by the
same share, which a table gives by the phase noise."""

from typing import NamedTuple

import cv2
import numba
import numpy as np

from scenes.sensor.amcw.kernels import FilterSettings
from scenes.sensor.amcw.light import Light
from scenes.sensor.amcw.linear import DEVIATIONS, Filtered, linearised, unknown_filtered
from scenes.sensor.common.normals import FAST

f4 = np.float32
# a window with a smaller edge sum is even: a neighbour 0.13 rad off changes its weight by 3 %
LARGEST_EDGE = 0.004
# largest difference of c s^2 in a window with even noise: that share of a weight
LARGEST_DIFFERENCE = 0.005
# largest phase noise in radians of the table, beyond what `certainty` accepts
LARGEST_NOISE = 0.15
NOISES = np.linspace(0.0, LARGEST_NOISE, 33)


class NoiseTable(NamedTuple):
    """Effects of noise on an even window, at each of `NOISES`."""

    neighbour_share: np.ndarray
    """(33,): a neighbour's part in the phase, over its weight."""
    higher: np.ndarray
    """(33,): variance of higher order over the noise's variance."""


class EvenMoves(NamedTuple):
    """Changes of the phases of m even pixels by noise, at f frequencies."""

    by_neighbour: np.ndarray
    """(f, m) float32: change of the phase by a neighbour's noise at weight and amplitude 1, over
    its deviation."""
    by_centre: np.ndarray
    """(f, m) float32: change of the phase in radians by one deviation of the centre's noise."""


class _WindowSums(NamedTuple):
    """Sums over the window of each pixel, (n,) float32."""

    weights: np.ndarray
    """Sum of the weights by distance, times amplitudes if those count."""
    phase_variance: np.ndarray
    """Sum of squared weights times phase variances."""
    amplitude_variance: np.ndarray
    """Sum of squared weights by distance times amplitude variances."""


def even_pixels(
    edge: np.ndarray, light: Light, window: FilterSettings, shape: tuple[int, int]
) -> np.ndarray:
    """Return (n,) bool: pixels before one even surface. ``edge`` (f, n): noise-free edge sum."""
    side = window.space.shape[0]
    half = side // 2
    square = np.ones((side, side), np.uint8)
    lowest = light.amplitude * (1 - DEVIATIONS * light.relative_noise)
    unlike = (lowest <= window.dim).any(axis=0)
    unlike |= (light.phase_noise > LARGEST_NOISE).any(axis=0)
    even = np.asarray(cv2.dilate(unlike.reshape(shape).astype(np.uint8), square)) == 0
    even[:half] = False
    even[-half:] = False
    even[:, :half] = False
    even[:, -half:] = False
    for f, noise in enumerate(light.phase_noise):
        loss = window.concentration * noise.reshape(shape) ** 2
        difference = np.asarray(cv2.dilate(loss, square)) - np.asarray(cv2.erode(loss, square))
        even &= difference < LARGEST_DIFFERENCE
        even &= edge[f].reshape(shape) < LARGEST_EDGE
    return even.ravel()


def fill_even(
    even: np.ndarray,
    alone: np.ndarray,
    edge: np.ndarray,
    light: Light,
    window: FilterSettings,
    shape: tuple[int, int],
    filtered: Filtered,
) -> EvenMoves:
    """Fill ``filtered`` at the ``even`` pixels (n,) bool, from the noise-free filtered phasors
    ``alone`` (f, 3, n) and ``edge`` sums (f, n)."""
    pixels = np.flatnonzero(even)
    table = _noise_table(window)
    moves = EvenMoves(
        by_neighbour=np.empty((len(edge), len(pixels)), f4),
        by_centre=np.empty((len(edge), len(pixels)), f4),
    )
    for f in range(len(edge)):
        light_of_frequency = Light._make(part[f] for part in light)
        filtered_of_frequency = Filtered._make(part[f] for part in filtered)
        amplitude = light_of_frequency.amplitude
        carried = amplitude if window.by_amplitude else np.ones_like(amplitude)
        _fill_even(
            pixels,
            alone[f],
            edge[f],
            light_of_frequency,
            carried,
            _window_sums(light_of_frequency, carried, window, shape),
            window.space,
            table,
            window.by_amplitude,
            filtered_of_frequency,
            moves.by_neighbour[f],
            moves.by_centre[f],
        )
    return moves


def _window_sums(
    light: Light, carried: np.ndarray, window: FilterSettings, shape: tuple[int, int]
) -> _WindowSums:
    """Return the sums over windows of one frequency; ``carried`` (n,): the amplitude that phasors
    count by, or 1."""
    middle = len(window.space) // 2
    # the weights are a product of those along rows and along columns
    taps = window.space[middle] / np.sqrt(window.space[middle, middle])

    def summed(values: np.ndarray, taps: np.ndarray) -> np.ndarray:
        image = values.reshape(shape)
        summed_image = cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed_image).ravel()

    return _WindowSums(
        weights=summed(carried, taps),
        phase_variance=summed((carried * light.phase_noise) ** 2, taps**2),
        amplitude_variance=summed((light.amplitude * light.relative_noise) ** 2, taps**2),
    )


def _noise_table(window: FilterSettings) -> NoiseTable:
    """Return the table, from the linear model on windows with one noise each, below one another."""
    side = window.space.shape[0]
    k = window.space.size
    count = len(NOISES)
    noise = np.repeat(NOISES, k)[None].astype(f4)
    bright = np.full((1, count * k), 1e3 * max(window.dim, 1.0), f4)
    light = Light(
        phasor=np.ones_like(noise, np.complex64),
        amplitude=bright,
        mean_amplitude=bright,
        phase_noise=noise,
        relative_noise=noise / f4(1e3),
    )
    filtered = unknown_filtered(1, count * k)
    middles = np.arange(count) * k + k // 2
    noisy = middles[1:]  # the first window has no noise
    moves = linearised(
        noisy,
        light,
        window,
        (count * side, side),
        filtered,
    ).phase[0]
    corner_weight = window.space.ravel()[0] / window.space.sum()
    neighbour_share = np.ones(count)
    neighbour_share[1:] = moves[:, 0] / NOISES[1:] / corner_weight
    noise_ratio = filtered.phase_noise[0, noisy] / NOISES[1:]
    higher = np.zeros(count)
    higher[1:] = filtered.higher_share[0, noisy] * noise_ratio**2
    return NoiseTable(neighbour_share, higher)


@numba.njit(**FAST)
def _fill_even(  # type: ignore[no-untyped-def]
    pixels,
    alone,
    edge,
    light,
    carried,
    sums,
    space,
    table,
    by_amplitude,
    filtered,
    by_neighbour,
    by_centre,
):
    """Do the work of `fill_even` for one frequency."""
    middle = space[len(space) // 2, len(space) // 2]
    neighbours = space.size - 1
    space_sum = space.sum()
    step = LARGEST_NOISE / (len(table.neighbour_share) - 1)
    for m in range(pixels.size):
        i = pixels[m]
        noise = light.phase_noise[i]
        noise2 = noise * noise
        # the table at this noise, interpolated
        low = min(int(noise / step), len(table.higher) - 2)
        part = noise / step - low
        share_low = table.neighbour_share[low]
        share = share_low + part * (table.neighbour_share[low + 1] - share_low)
        higher_low = table.higher[low]
        higher = noise2 * (higher_low + part * (table.higher[low + 1] - higher_low))
        # the phase's variance, by the centre and by all neighbours
        by_neighbour[m] = share / sums.weights[i]
        centre_weight = middle * carried[i] / sums.weights[i]
        by_centre2 = (1 - share * (1 - centre_weight)) ** 2 * noise2 + higher
        of_centre = (middle * carried[i] * noise) ** 2
        variance = by_neighbour[m] ** 2 * (sums.phase_variance[i] - of_centre) + by_centre2
        by_centre[m] = np.sqrt(by_centre2)
        # noise moves the mean towards the centre's own phase, as it does the shares
        mean_alone = complex(alone[0, i], alone[1, i])
        mean = light.phasor[i] * (1 - share) + mean_alone * (
            share / np.sqrt(mean_alone.real**2 + mean_alone.imag**2)
        )
        filtered.phasor[i] = mean / np.sqrt(mean.real**2 + mean.imag**2)
        # noise perpendicular to a mean phasor lengthens it
        filtered.amplitude[i] = alone[2, i] * (1 + 0.5 * variance if by_amplitude else 1.0)
        filtered.phase_noise[i] = np.sqrt(variance)
        filtered.amplitude_noise[i] = np.sqrt(sums.amplitude_variance[i]) / space_sum
        filtered.higher_share[i] = higher / variance
        # each neighbour's difference has the noise of two pixels; the centre's is in all
        filtered.edge[i] = edge[i] + 0.5 * neighbours * (1 - np.exp(-noise2))
        filtered.edge_noise[i] = np.sqrt(
            (neighbours * 6 / 16 + neighbours**2 / 8) * noise2 * noise2
            + (1 + neighbours) * edge[i] * noise2
        )
