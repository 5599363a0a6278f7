"""Frames of a view for a fraction of the cost: most pixels to first order in the noise, the others
by the whole chain.

`first_order` sorts the pixels of a view once. Where all gates certainly pass a pixel and noise acts
to first order, z and amplitude are moving sums of one normal each per pixel, and z is displaced and
rounded (`linear_frames`). All other pixels, mostly at rims, go through filter and engine
(`listed`), with light that shares its noise with linear pixels (`halo`). Differences to frames of
the whole chain: the amplitude's noise is independent of that of z (in the whole chain their
correlation is at most 0.1); at rims between surfaces of different brightness, amplitudes of
neighbours correlate by up to 0.07 more, on floors of small holes by up to 0.06 less; variance of
second order (at most 2.5 %) is added to the centre's noise. The variance of z before the thesis'
board agrees to 0.002 (even pixels) and 0.010 (uneven and listed; 400 frames of two cameras,
tests/validation/first_order.py)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np

from harness.vocabulary.geometry import MM, Reason
from scenes.sensor.amcw.certainty import Certainty, certainty
from scenes.sensor.amcw.even import EvenMoves, even_pixels, fill_even
from scenes.sensor.amcw.exposure import AmcwExposure
from scenes.sensor.amcw.halo import Halo, drawn_light, halo_of
from scenes.sensor.amcw.imager import AmcwImager
from scenes.sensor.amcw.light import Light, light_of_samples
from scenes.sensor.amcw.linear import DEVIATIONS, Moves, linearised, unknown_filtered
from scenes.sensor.amcw.linear_frames import TOGETHER, Linear, draw_linear_frame
from scenes.sensor.amcw.listed import Listed, decoded, listed_of
from scenes.sensor.amcw.windows import pixels_within, windows_of
from scenes.sensor.common.normals import FAST, standard_normals
from scenes.sensor.common.unit import DecodedFrame

f4 = np.float32
ZERO = f4(0)
RADIANS_PER_TURN = f4(2 * np.pi)
# if more of the pixels had to go through the whole chain, whole frames would cost less
MOST_LISTED = 0.3
# from this noise of a sample over the converter's step, rounding is noise of step^2/12, to 1e-3
LEAST_DITHER = 0.6
JITTERS = 6.0  # limits of range keep this many deviations of a frame's displacement away


class _EvenPixels(NamedTuple):
    """Pixels before one even surface."""

    pixels: np.ndarray
    """(m,): flat indices."""
    moves: EvenMoves
    """Changes of their phases by noise."""


class _UnevenPixels(NamedTuple):
    """Other pixels that may be linear."""

    pixels: np.ndarray
    """(m,): flat indices."""
    moves: Moves
    """Changes by the noise of each pixel of their windows."""


def first_order(
    imager: AmcwImager, exposure: AmcwExposure, wanted: np.ndarray, jitter_mm: float
) -> FirstOrder | None:
    """Return the first-order model of a view at the ``wanted`` (h, w) bool pixels, whose frames
    are displaced by ``jitter_mm``; None if whole frames cost less, because it holds for too few of
    them."""
    window = imager.filter_settings
    shape = exposure.shape
    n = exposure.sigma.size
    side = len(window.space)
    is_by_sample = _unfit(imager, exposure)
    unfit = pixels_within(is_by_sample.reshape(shape), side)
    if (unfit | imager.outside_mask)[wanted].mean() > MOST_LISTED:
        return None

    # each wanted pixel after the filter, and its change by noise
    light = light_of_samples(
        exposure, float(imager.camera.converter.knee_units.value), imager.gains
    )
    noise_free = np.stack([light.phasor.real, light.phasor.imag])
    strength = light.amplitude if window.by_amplitude else light.mean_amplitude
    alone, edge = imager.filter(noise_free, strength, shape)
    alone = alone.reshape(len(alone), 3, n)
    edge = edge.reshape(len(edge), n)
    filtered = unknown_filtered(len(light.phase_noise), n)
    is_even = even_pixels(edge, light, window, shape) & ~unfit.ravel()
    even_moves = fill_even(
        is_even,
        alone,
        edge,
        light,
        window,
        shape,
        filtered,
    )
    # in the finished image, the engine looks one pixel beyond the wanted ones
    is_uneven = ~is_even & ~unfit.ravel() & pixels_within(wanted, 3).ravel()
    uneven = np.flatnonzero(is_uneven)
    uneven_moves = linearised(uneven, light, window, shape, filtered)

    # which pixels go through the whole chain
    unit = imager.camera.unit
    farthest_mm = unit.jump_mm.value + JITTERS * jitter_mm + abs(unit.drift_mm.value)
    farthest_m = farthest_mm * MM
    certain = certainty(filtered, imager.engine, shape, farthest_m)
    undecided = ~certain.always & wanted.ravel()
    if undecided.sum() > MOST_LISTED * wanted.sum():
        return None

    metres_by_phase = _metres_by_phase(imager, light)
    linear = _linear(
        imager,
        light,
        certain,
        metres_by_phase,
        _EvenPixels(np.flatnonzero(is_even), even_moves),
        _UnevenPixels(uneven, uneven_moves),
    )
    listed = listed_of(undecided.reshape(shape), imager)
    return FirstOrder(
        imager=imager,
        shape=shape,
        linear=linear,
        listed=listed,
        halo=halo_of(listed.halo, light, metres_by_phase, is_by_sample, exposure),
        farthest_error_m=farthest_m,
    )


def _unfit(imager: AmcwImager, exposure: AmcwExposure) -> np.ndarray:
    """Find pixels (n,) whose light is no phasor with normal noise: a sample may saturate, or noise
    does not hide the converter's steps."""
    knee = imager.camera.converter.knee_units.value
    largest = np.abs(exposure.means).max(axis=(0, 1))
    may_saturate = largest + DEVIATIONS * exposure.sigma > exposure.limit
    octave = np.floor(np.log2(np.maximum(largest, 1e-9) / knee))
    converter_step = np.exp2(np.maximum(octave, 0))
    return np.asarray(may_saturate | (exposure.sigma <= LEAST_DITHER * converter_step))


def _metres_per_radian(imager: AmcwImager) -> np.ndarray:
    """Return (f, 1) float32: metres of half path per radian of each frequency's phase."""
    return imager.engine.lattice.metres_per_turn[:, None] / RADIANS_PER_TURN


def _metres_by_phase(imager: AmcwImager, light: Light) -> np.ndarray:
    """Return (f, n): metres of half path per radian of each phase, times the amplitude that
    carries it, over its median."""
    metres = _metres_per_radian(imager)
    if not imager.filter_settings.by_amplitude:
        return np.broadcast_to(metres, light.phase_noise.shape)
    return metres * light.amplitude / np.median(light.amplitude, axis=1, keepdims=True)


def _linear(
    imager: AmcwImager,
    light: Light,
    certain: Certainty,
    metres_by_phase: np.ndarray,
    even: _EvenPixels,
    uneven: _UnevenPixels,
) -> Linear:
    """Return the linear pixels: those that certainly have a range."""
    settings = imager.filter_settings
    space = settings.space
    side = space.shape[0]
    middle = side // 2
    step_m = imager.camera.z_step_m
    metres = _metres_per_radian(imager)
    by_path = certain.z_by_path
    n = light.phase_noise.shape[1]
    limited_noise = np.minimum(light.phase_noise, f4(1))
    noise = np.sqrt(((metres_by_phase * limited_noise) ** 2).sum(axis=0))

    # even pixels: one number for all neighbours, and one for the centre
    pixels = even.pixels
    carried = light.amplitude[:, pixels] if settings.by_amplitude else 1.0
    moves_m = metres * even.moves.by_neighbour * carried * light.phase_noise[:, pixels]
    by_neighbours = np.sqrt((moves_m**2).sum(axis=0)) * by_path[pixels] / step_m
    centre_m = metres * even.moves.by_centre
    by_own = np.sqrt((centre_m**2).sum(axis=0)) * by_path[pixels] / step_m
    by_neighbour = np.zeros(n, f4)
    by_neighbour[pixels] = by_neighbours / noise[pixels]
    by_centre = np.zeros(n, f4)
    by_centre[pixels] = (by_own - space[middle, middle] * by_neighbours) / noise[pixels]

    # uneven pixels: a number for each neighbour, with the sign of the sum over the frequencies
    always = np.flatnonzero(certain.always[uneven.pixels])
    pixels = uneven.pixels[always]
    moves = joined_moves(uneven.moves.phase, always, metres[:, 0])
    moves *= by_path[pixels, None]
    moves /= f4(step_m)
    moves /= windows_of(noise.reshape(imager.region.shape), side, 1.0, pixels)

    # windows with zeros around them, up to an odd multiple of `TOGETHER`
    padded_side = 2 * TOGETHER * ((side + 4) // (2 * TOGETHER)) + TOGETHER
    rim = (padded_side - side) // 2
    amplitude_moves = joined_moves(uneven.moves.amplitude, always, np.ones(len(metres), f4))
    amplitude_moves /= f4(len(metres))
    taps = np.pad(space[middle] / np.sqrt(space[middle, middle]), rim)
    z = np.where(certain.always, certain.z_m / f4(step_m), f4(np.nan))
    base = np.round(z)
    return Linear(
        noise=noise,
        base=base,
        z=z - base,
        by_path=by_path,
        by_neighbour=by_neighbour,
        by_centre=by_centre,
        uneven=pixels,
        moves=_padded(moves, side, rim),
        amplitude_moves=_padded(amplitude_moves, side, rim),
        taps=taps,
        amplitude=certain.amplitude,
        amplitude_noise=certain.amplitude_deviation,
    )


@numba.njit(**FAST)
def joined_moves(moves, chosen, scales):  # type: ignore[no-untyped-def]
    """Return the moves (p, k) float32 of the ``chosen`` (p,) pixels by their neighbours' noise, by
    all frequencies together: as frequencies have independent noise, the root of the sum of squares,
    with the sign of the sum.

    Args:
        moves: (f, m, k), those of each frequency.
        chosen: (p,) indices of m.
        scales: (f,) float32, factors of the frequencies.
    """
    neighbours = moves.shape[2]
    joined = np.empty((chosen.size, neighbours), f4)
    squares = np.empty(neighbours, f4)
    total = np.empty(neighbours, f4)
    for p in range(chosen.size):
        squares[:] = ZERO
        total[:] = ZERO
        for f in range(len(moves)):
            of_frequency = moves[f, chosen[p]]
            for q in range(np.uint64(neighbours)):
                move = scales[f] * of_frequency[q]
                squares[q] += move * move
                total[q] += move
        of_pixel = joined[p]
        for q in range(np.uint64(neighbours)):
            of_pixel[q] = np.copysign(np.sqrt(squares[q]), total[q])
    return joined


def _padded(windows: np.ndarray, side: int, rim: int) -> np.ndarray:
    """Return windows (m, side^2) with a rim of zeros."""
    squares = np.pad(windows.reshape(-1, side, side), ((0, 0), (rim, rim), (rim, rim)))
    return squares.reshape(-1, (side + 2 * rim) ** 2)


@dataclass(frozen=True)
class FirstOrder:
    """Frames of an exposure, distributed as those of the whole chain."""

    imager: AmcwImager
    """The camera on the view's region."""
    shape: tuple[int, int]
    """(h, w) of the view, n pixels."""
    linear: Linear
    """The pixels that are linear in the noise."""
    listed: Listed
    """The other wanted pixels."""
    halo: Halo
    """Light of the pixels in the windows of the listed ones."""
    farthest_error_m: float
    """Largest displacement of a frame for which the pixels are sorted, metres."""

    def frame(self, rng: np.random.Generator, error_m: float) -> DecodedFrame:
        """Draw a frame with noise from ``rng``, displaced by ``error_m``, at most
        ``farthest_error_m``; only the wanted pixels have a meaning."""
        imager = self.imager
        linear = self.linear
        listed = self.listed
        n = linear.z.size
        z_m = np.empty(n, f4)
        reason = np.full(n, Reason.VALID, np.uint8)
        amplitude = np.empty(n, f4)
        normals = standard_normals(rng, (2, n))
        draw_linear_frame(
            self.shape,
            linear,
            normals,
            f4(error_m / imager.camera.z_step_m),
            f4(imager.camera.z_step_m),
            z_m,
            amplitude,
        )
        if listed.pixels.size:
            light = drawn_light(self.halo, imager, normals, rng)
            of_listed = decoded(listed, imager, light, error_m)
            z_m[listed.pixels] = of_listed.z_m
            reason[listed.pixels] = of_listed.reason
            amplitude[listed.pixels] = of_listed.amplitude
        shape = self.shape
        return DecodedFrame(z_m.reshape(shape), reason.reshape(shape), amplitude.reshape(shape))
