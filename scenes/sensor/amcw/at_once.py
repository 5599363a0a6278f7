"""Sums over the imager's frames without drawing them: most pixels to first order in the noise, the
others one by one.

`at_once` sorts the pixels of a view once. Where all gates certainly pass a pixel and noise acts to
first order, z is a moving sum of one normal per pixel, displaced and rounded in each frame
(`linear_frames`). Where a gate certainly stops it, nothing is drawn. All other pixels, mostly at
rims, go through the whole chain (`listed`). Differences to real frames: amplitudes have their own
noise, independent of that of z (in frames their correlation is at most 0.1); a pixel without a
range has, in all its frames, the reason that its mean has; variance of second order (at most 2.5
%) is added to the centre's noise. The variance of averages of 50 frames of a board agrees to 0.002
(even pixels), 0.005 (uneven) and 0.017 (listed; tests/validation/at_once.py). Far behind a hole,
where light is dim, the variance of means of 8 frames is 13 to 15 % less than that of single
frames' means (standard error 3 %); the cause is not known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from harness.vocabulary.geometry import MM, Reason
from scenes.sensor.amcw import kernels, ranging
from scenes.sensor.amcw.certainty import Certainty, certainty
from scenes.sensor.amcw.even import EvenMoves, even_pixels, fill_even
from scenes.sensor.amcw.exposure import AmcwExposure
from scenes.sensor.amcw.imager import AmcwImager
from scenes.sensor.amcw.kernels import LANES
from scenes.sensor.amcw.light import Light, light_of_samples
from scenes.sensor.amcw.linear import DEVIATIONS, linearised, unknown_filtered
from scenes.sensor.amcw.linear_frames import (
    EVEN,
    NONE,
    TOGETHER,
    UNEVEN,
    Linear,
    SharedNoise,
    add_linear_frames,
)
from scenes.sensor.amcw.listed import Listed, ListedSums, add_listed_frames, empty_sums, listed_of
from scenes.sensor.amcw.windows import pixels_within, windows_of
from scenes.sensor.common.unit import N_REASONS, FrameTotals

f4 = np.float32
RADIANS_PER_TURN = f4(2 * np.pi)
# if more of the pixels had to be simulated one by one, whole frames would cost less
MOST_LISTED = 0.25
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
    moves: np.ndarray
    """(f, m, k): change of the phase in radians by one deviation of each neighbour's noise."""


class _LinearSums(NamedTuple):
    """Sums over frames of a view's n pixels, for each of k parts of a capture."""

    total: np.ndarray
    """(k, n): of z minus base, in steps."""
    squares: np.ndarray
    """(k, n): of its square."""
    amplitude_signs: np.ndarray
    """(k, n) float32: of the signs of one deviation of the amplitude's noise."""


def at_once(imager: AmcwImager, exposure: AmcwExposure, pixels: np.ndarray) -> AtOnce | None:
    """Return the sums of frames at ``pixels`` (h, w) bool. Return None if frames must be drawn: if
    noise does not hide the converter's steps, if a sample may saturate, or if a gate may go either
    way for many pixels."""
    knee = imager.camera.converter.knee_units.value
    largest = np.abs(exposure.means).max(axis=(0, 1))
    reach = DEVIATIONS * exposure.sigma
    lost = largest - reach > exposure.limit
    may_saturate = (largest + reach > exposure.limit) & ~lost
    octave = np.floor(np.log2(np.maximum(largest, 1e-9) / knee))
    converter_step = np.exp2(np.maximum(octave, 0))
    # without noise that hides the converter's steps, frames differ from the linear model
    hidden = exposure.sigma > LEAST_DITHER * converter_step
    if may_saturate.any() or not hidden.all():
        return None

    # each requested pixel after the filter, and its change by noise
    window = imager.filter_settings
    shape = exposure.shape
    n = exposure.sigma.size
    light = light_of_samples(exposure, float(knee), imager.gains)
    noise_free = np.stack([light.phasor.real, light.phasor.imag])
    noise_free[:, :, lost] = 0
    strength = light.amplitude if window.by_amplitude else light.mean_amplitude
    alone, edge = imager.filter(noise_free, np.where(lost, kernels.OUTSIDE, strength), shape)
    alone = alone.reshape(len(alone), 3, n)
    edge = edge.reshape(len(edge), n)
    filtered = unknown_filtered(len(light.phase_noise), n)
    is_even = even_pixels(edge, light, window, shape, lost)
    even_moves = fill_even(
        is_even,
        alone,
        edge,
        light,
        window,
        shape,
        filtered,
    )
    # in the finished image, the engine looks one pixel beyond the requested ones
    is_uneven = ~(is_even | lost) & pixels_within(pixels, 3).ravel()
    uneven = np.flatnonzero(is_uneven)
    uneven_moves = linearised(
        uneven,
        light,
        window,
        shape,
        lost,
        filtered,
    )

    # which pixels must be simulated one by one
    unit = imager.camera.unit
    jitter_mm = imager.jitter_mm(exposure)
    farthest_mm = unit.jump_mm.value + JITTERS * jitter_mm + abs(unit.drift_mm.value)
    farthest_m = farthest_mm * MM
    certain = certainty(filtered, imager.engine, lost, shape, farthest_m)
    undecided = ~(certain.always | certain.never) & pixels.ravel()
    if undecided.mean() > MOST_LISTED:
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
    flying = imager.engine.flying is not None
    listing = listed_of(undecided.reshape(shape), window.space.shape[0], flying)
    halo = Light._make(np.ascontiguousarray(part[:, listing.halo]) for part in light)
    halo_noise = (metres_by_phase[:, listing.halo] * halo.phase_noise).T
    shares = halo_noise / np.sqrt((halo_noise**2).sum(axis=1, keepdims=True))
    return AtOnce(
        imager=imager,
        shape=shape,
        light=halo,
        shares=shares.astype(f4),
        linear=linear,
        certain=certain,
        list=listing,
        farthest_error_m=farthest_m,
    )


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
    kind = np.full(n, NONE, np.uint8)

    # even pixels: one number for all neighbours, and one for the centre
    pixels = even.pixels
    kind[pixels] = np.where(certain.always[pixels], EVEN, NONE)
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
    always = certain.always[uneven.pixels]
    pixels = uneven.pixels[always]
    kind[pixels] = UNEVEN
    row = np.zeros(n, np.int32)
    row[pixels] = np.arange(len(pixels))
    pulls_m = metres[:, :, None] * uneven.moves[:, always]
    size_m = np.copysign(np.sqrt((pulls_m**2).sum(axis=0)), pulls_m.sum(axis=0))
    moves = size_m * by_path[pixels, None] / f4(step_m)
    moves /= windows_of(noise.reshape(imager.region.shape), side, 1.0, pixels)

    # windows with zeros around them, up to an odd multiple of `TOGETHER`
    padded_side = 2 * TOGETHER * ((side + 4) // (2 * TOGETHER)) + TOGETHER
    rim = (padded_side - side) // 2
    moves = np.pad(moves.reshape(-1, side, side), ((0, 0), (rim, rim), (rim, rim)))
    taps = np.pad(space[middle] / np.sqrt(space[middle, middle]), rim)
    z = np.where(certain.always, certain.z_m / f4(step_m), f4(0))
    base = np.round(z)
    return Linear(
        kind=kind,
        noise=noise,
        base=base,
        z=z - base,
        by_path=by_path,
        by_neighbour=by_neighbour,
        by_centre=by_centre,
        row=row,
        moves=moves.reshape(-1, taps.size**2),
        taps=taps,
    )


@dataclass(frozen=True)
class AtOnce:
    """Sums of frames of an exposure. Their distribution is that of single frames, for a fraction
    of the cost."""

    imager: AmcwImager
    """The camera on the view's region."""
    shape: tuple[int, int]
    """(h, w) of the view, n pixels."""
    light: Light
    """Light before the filter, of the g pixels of the list's halo."""
    shares: np.ndarray
    """(g, f) float32: each frequency's share in the noise of z, on the list's halo."""
    linear: Linear
    """The pixels that are linear in the noise."""
    certain: Certainty
    """The pixels that always, and those that never, have a range."""
    list: Listed
    """The pixels that are simulated one by one."""
    farthest_error_m: float
    """Largest displacement of a frame for which the pixels are sorted, metres."""

    @property
    def sure_pixels(self) -> int:
        """Number of pixels that have a range in every frame."""
        return int(self.certain.always.sum())

    @cached_property
    def noise_m(self) -> float:
        """Median deviation of a frame's z over the sure pixels, before rounding, without noise
        shared by a frame."""
        if self.sure_pixels == 0:
            return 0.0
        return float(np.median(self.certain.deviation_m[self.certain.always]))

    @cached_property
    def z_by_error(self) -> float:
        """Change of z per displacement of a frame: the median over the sure pixels."""
        if self.sure_pixels == 0:
            return 1.0
        return float(np.median(self.certain.z_by_path[self.certain.always]))

    @cached_property
    def listed(self) -> np.ndarray:
        """Flat indices (p,) of the pixels that are simulated one by one."""
        return np.asarray(self.list.range[self.list.wanted])

    @cached_property
    def _engine(self) -> ranging.DepthEngine:
        """The engine of the listed pixels, repeated for each lane."""
        engine = self.imager.engine
        pixels = np.repeat(self.list.range, LANES)
        geometry = engine.geometry.take(pixels, axis=1)
        return engine._replace(geometry=geometry, outside_mask=engine.outside_mask[pixels])

    def totals(
        self,
        parts: Sequence[np.ndarray],
        errors_m: np.ndarray,
        stream: Callable[[int], np.random.Generator],
    ) -> Sequence[FrameTotals]:
        """Return the sums over the first of ``parts``, over the first two, and so on.

        Args:
            parts: numbers of frames (t,) each; no number twice.
            errors_m: displacements of the frames, by number.
            stream: the noise of frames `LANES` b to `LANES` (b + 1) - 1 comes from ``stream`` (b),
                whichever of them are requested.
        """
        n = self.linear.z.size
        k = len(parts)
        linear_sums = _LinearSums(
            total=np.zeros((k, n)),
            squares=np.zeros((k, n)),
            amplitude_signs=np.zeros((k, n), f4),
        )
        listed_sums = empty_sums(k, len(self.listed))
        row_of_noise = np.full(n, -1, np.int32)
        row_of_noise[self.list.halo] = np.arange(len(self.list.halo))
        last_frame = max(int(frames.max(initial=0)) for frames in parts)
        blocks = 1 + last_frame // LANES
        part_of = np.full(blocks * LANES, -1)
        errors = np.zeros(blocks * LANES, f4)
        for number, frames in enumerate(parts):
            part_of[frames] = number
            errors[frames] = errors_m[frames]
        for block in np.unique(np.flatnonzero(part_of >= 0) // LANES).tolist():
            lanes = slice(block * LANES, (block + 1) * LANES)
            rng = stream(block)
            normals = self._add_listed(errors[lanes], part_of[lanes], rng, listed_sums)
            shared = SharedNoise(normals, row_of_noise)
            self._add_linear(errors[lanes], part_of[lanes], rng, shared, linear_sums)
        for sums in (*linear_sums, *listed_sums):
            for part in range(1, k):
                sums[part] += sums[part - 1]
        counts = np.cumsum([len(frames) for frames in parts]).tolist()
        return [
            self._finished(count, part, linear_sums, listed_sums)
            for part, count in enumerate(counts)
        ]

    def _add_linear(
        self,
        errors_m: np.ndarray,
        part_of: np.ndarray,
        rng: np.random.Generator,
        shared: SharedNoise,
        sums: _LinearSums,
    ) -> None:
        """Add the linear pixels' frames to ``sums``, each to its ``part_of`` (lanes,)."""
        n = self.linear.z.size
        step_m = f4(self.imager.camera.z_step_m)
        counted = (part_of == np.arange(len(sums.total))[:, None]).astype(f4)
        words = rng.bit_generator.random_raw(n * LANES // 8).view(np.int8)
        signs = rng.bit_generator.random_raw(n)
        add_linear_frames(
            self.shape,
            self.linear,
            words,
            shared,
            errors_m / step_m,
            counted,
            sums.total,
            sums.squares,
        )
        for part_signs, in_part in zip(sums.amplitude_signs, counted, strict=True):
            # the amplitude's noise in each frame is one deviation up or down, by a bit of its word
            bits = np.uint64(sum(1 << lane for lane in np.flatnonzero(in_part).tolist()))
            part_signs += f4(2) * np.bitwise_count(signs & bits) - f4(in_part.sum())

    def _add_listed(
        self,
        errors_m: np.ndarray,
        part_of: np.ndarray,
        rng: np.random.Generator,
        sums: ListedSums,
    ) -> np.ndarray:
        """Add the listed pixels' frames to ``sums``, each to its ``part_of`` (lanes,). Return
        their halo's noise of z (g, lanes)."""
        light = self.light
        listing = self.list
        settings = self.imager.filter_settings
        flying_gate = self.imager.engine.flying
        g = len(listing.halo)
        m = len(listing.range)
        f = len(light.phase_noise)
        words = rng.bit_generator.random_raw(g * f * LANES // 2).view(np.uint32)
        noise = np.empty((g, LANES), f4)
        planes = np.empty((g // kernels.BESIDE + 2, f, 3, kernels.STRIDE), f4)
        kernels.noisy_phasors(
            light.phasor,
            light.amplitude,
            light.phase_noise,
            light.relative_noise,
            self.shares,
            words.reshape(g, f, LANES),
            planes,
            noise,
        )
        filtered = np.empty((f, 3, m, LANES), f4)
        edge = np.empty((f, m, LANES), f4)
        kernels.filter_listed(planes, listing.window, settings, filtered, edge)
        flat_z_m, flat_reason, flat_total = ranging.ranges_of(
            filtered.reshape(f, 3, -1),
            edge.reshape(f, -1),
            np.zeros(m * LANES, np.uint8),
            self._engine,
            np.tile(errors_m, m),
        )
        z_m = flat_z_m.reshape(m, LANES)
        reason = flat_reason.reshape(m, LANES)
        total = flat_total.reshape(m, LANES)
        flying = np.zeros((len(listing.wanted), LANES), bool)
        if flying_gate is not None:
            ranging.find_flying(
                z_m,
                total,
                reason,
                listing.wanted,
                listing.neighbours,
                flying_gate,
                flying,
            )
        add_listed_frames(
            z_m,
            reason,
            total,
            flying,
            listing.wanted,
            part_of,
            1.0 / f,
            f4(self.imager.camera.z_step_m),
            self.linear.base[self.listed],
            sums,
        )
        return noise

    def _finished(
        self, frames: int, part: int, linear_sums: _LinearSums, listed_sums: ListedSums
    ) -> FrameTotals:
        """Return the sums over ``frames`` frames from those of the linear and of the listed
        pixels, both at index ``part``."""
        certain = self.certain
        shape = self.shape
        # the filter spreads the amplitude's noise over its window
        taps = self.linear.taps
        unit_taps = taps / np.sqrt((taps**2).sum())
        noise = cv2.sepFilter2D(
            linear_sums.amplitude_signs[part].reshape(shape),
            -1,
            unit_taps,
            unit_taps,
            borderType=cv2.BORDER_CONSTANT,
        )
        amplitude = frames * certain.amplitude + certain.amplitude_deviation * noise.ravel()
        amplitude = np.where(certain.always, amplitude, 0.0)
        count = np.where(certain.always, frames, 0).astype(np.int32)
        total = linear_sums.total[part]
        squares = linear_sums.squares[part]
        reasons = np.zeros((N_REASONS, len(count)), np.uint16)
        never = np.flatnonzero(certain.never)
        reasons[certain.reason[never], never] = frames
        reasons[Reason.VALID, certain.always] = frames
        listed = self.listed
        count[listed] = listed_sums.valid[part]
        total[listed] = listed_sums.total[part]
        squares[listed] = listed_sums.squares[part]
        amplitude[listed] = listed_sums.amplitude[part]
        reasons[:, listed] = listed_sums.reasons[part]
        return FrameTotals(
            frames=frames,
            step_m=self.imager.camera.z_step_m,
            base=self.linear.base.astype(float).reshape(shape),
            count=count.reshape(shape),
            total=total.reshape(shape),
            squares=squares.reshape(shape),
            amplitude=amplitude.reshape(shape),
            reasons=reasons.reshape(-1, *shape),
        )
