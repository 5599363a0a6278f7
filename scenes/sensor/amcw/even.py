"""Pixels whose window holds one even surface, nearly all of a view: the effect of noise there, by few numbers a pixel.

There the filter weighs neighbours by distance (and amplitude) alone, but for noise: it takes the same share off the
weight of each and gives it to the centre. That share hangs on the phase noise only and is read from a table, which
`linear.linearised` fills on an even surface.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from scenes.sensor.amcw.linear import DEVIATIONS, Filtered, FilterWindow, Light, linearised, unknown_filtered

MOST_EDGE = 0.004
"""Edge sum up to which a window is even: one neighbour 0.13 rad off (15 mm at 200 MHz) changes its weight by 3 %."""
MOST_UNLIKE = 0.005
"""Difference of c s^2 within a window up to which its noise is even: that share of a weight."""
MOST_NOISE = 0.15
"""Phase noise in radians up to which the table goes, beyond what `certainty` takes."""
NOISES = np.linspace(0.0, MOST_NOISE, 33)


class Shares(NamedTuple):
    """Table by phase noise `NOISES`: ``neighbours``, times what the weights alone would give, and ``rest``, the
    variance that is not of first order, over the noise's."""

    neighbours: np.ndarray
    rest: np.ndarray


def shares_of(window: FilterWindow) -> Shares:
    """Return what the noise of an even surface does to the shares of its own."""
    side = window.space.shape[0]
    k, middle = side * side, side * side // 2
    weights = window.space.ravel() / window.space.sum()
    neighbours, rest = np.ones(len(NOISES)), np.zeros(len(NOISES))
    bright = np.full((1, k), 1e3 * max(window.dim, 1.0))
    none = np.zeros(k, bool)
    for row, noise in enumerate(NOISES[1:], 1):
        each = np.full((1, k), noise)
        out = unknown_filtered(1, k)
        light = Light(np.ones((1, k), complex), bright, bright, each, each / 1e3)
        moved = linearised(np.array([middle]), light, window, (side, side), none, none, out)[0, 0] / noise
        neighbours[row] = moved[0] / weights[0]
        rest[row] = out.left_out[0, middle] * (out.turned[0, middle] / noise) ** 2
    return Shares(neighbours, rest)


def even_pixels(
    edge: np.ndarray, light: Light, window: FilterWindow, shape: tuple[int, int], unsure: np.ndarray
) -> np.ndarray:
    """Find pixels (n,) bool before one even surface. ``edge`` (f, n): the noise-free edge sum; ``unsure`` (n,) bool:
    pixels that saturate or may."""
    half = window.space.shape[0] // 2
    unlike = unsure | (light.amplitude * (1 - DEVIATIONS * light.swell) <= window.dim).any(axis=0)
    unlike |= (light.turn > MOST_NOISE).any(axis=0)
    near = ndimage.binary_dilation(unlike.reshape(shape), np.ones(window.space.shape, bool), border_value=1)
    even = ~near
    even[:half], even[-half:], even[:, :half], even[:, -half:] = False, False, False, False
    for f, plane in enumerate(window.concentration * light.turn.reshape(-1, *shape) ** 2):
        size = 2 * half + 1
        even &= ndimage.maximum_filter(plane, size) - ndimage.minimum_filter(plane, size) < MOST_UNLIKE
        even &= edge[f].reshape(shape) < MOST_EDGE
    return even.ravel()


def fill_even(
    even: np.ndarray,
    filtered: np.ndarray,
    edge: np.ndarray,
    light: Light,
    window: FilterWindow,
    shape: tuple[int, int],
    shares: Shares,
    out: Filtered,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill ``out`` at the ``even`` pixels (n,) bool, from the noise-free ``filtered`` (f, 3, n) and ``edge`` (f, n).

    Return (f, m) each: what one deviation of a neighbour's noise at weight 1 and amplitude 1 moves the phase by, over
    that deviation, and what one of the centre's does in all.
    """
    own = light.turn[:, even]
    carried = light.amplitude if window.by_amplitude else np.ones(light.amplitude.shape)
    weights = _summed(carried, window.space, shape)[:, even]
    share = np.interp(own, NOISES, shares.neighbours)
    squares = _summed((carried * light.turn) ** 2, window.space**2, shape)[:, even]
    spreads = _summed((light.amplitude * light.swell) ** 2, window.space**2, shape)[:, even]
    middle = window.space.ravel()[window.space.size // 2]
    each = share / weights
    mine = middle * carried[:, even] / weights
    rest = np.interp(own, NOISES, shares.rest) * own**2
    centre = np.sqrt((1 - share * (1 - mine)) ** 2 * own**2 + rest)
    variance = each**2 * (squares - (middle * carried[:, even] * own) ** 2) + centre**2
    alone = filtered[:, 0, even] + 1j * filtered[:, 1, even]
    # noise brings the mean nearer to the centre's own phase, as it does the shares
    mean = light.phasor[:, even] * (1 - share) + alone * (share / np.abs(alone))
    out.phasor[:, even] = mean / np.abs(mean)
    # noise across a mean phasor makes it longer
    longer = 1 + 0.5 * variance if window.by_amplitude else 1.0
    out.amplitude[:, even] = filtered[:, 2, even] * longer
    out.turned[:, even] = np.sqrt(variance)
    plain = window.space.sum()
    out.spread[:, even] = np.sqrt(spreads) / plain
    out.left_out[:, even] = rest / variance
    kept = window.space.size - 1
    out.edge[:, even] = edge[:, even] + 0.5 * kept * (1 - np.exp(-(own**2)))
    quadratic = (kept * 6 / 16 + kept**2 / 8) * own**4
    out.edge_spread[:, even] = np.sqrt(quadratic + (1 + kept) * edge[:, even] * own**2)
    out.edge_least[:, even] = 0.0
    out.edge_loose[:, even] = np.sqrt(kept / 8)
    return each, centre


def _summed(values: np.ndarray, space: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Values (f, n) summed over each pixel's window with weights ``space``, which are a product of rows and columns."""
    middle = space.shape[0] // 2
    across = space[middle] / np.sqrt(space[middle, middle])
    planes = values.reshape(-1, *shape)
    summed = ndimage.correlate1d(
        ndimage.correlate1d(planes, across, axis=1, mode="constant"), across, axis=2, mode="constant"
    )
    return np.asarray(summed.reshape(values.shape))
