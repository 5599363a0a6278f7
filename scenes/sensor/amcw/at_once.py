"""Sums over frames of the imager without its frames: most pixels to first order in the noise, the rest one by one.

`AtOnce.of` sorts the pixels of a view, once. Where all gates are sure to let a pixel through and noise acts to first
order, its frames are a moving sum of one normal a pixel, displaced and rounded (`linear_frames`); where a gate is sure
to stop it, nothing is drawn; all others, at rims mostly, go through the whole chain with the windows that they need
(`listed`), and pixels beside them get the same noise. Frames are independent, so sums over parts of a capture add up.
What is not as in a frame: amplitudes have their own noise, independent of that of z (in frames their correlation is
0.1 at most, at rims of a camera that weighs by amplitude); a pixel without a range has, in all its frames, the reason
that its mean has; variance of second order (2.5 % at most) is put on the centre's noise.

Thesis boards (flat, blind, 20 mm, 200 mm, none behind), 150 averages of 50 frames drawn at once over 150 of frames, by
tests/validation/at_once.py; deviations of the ratios by chance are some 0.005 (even), 0.01 (others), 0.05 (beyond 3):

| camera | pixels | variance of the average | share beyond 3 deviations | correlation at lags 1, 2, 3, 4 |
|---|---|---|---|---|
| Azure | even, 30,000 | 1.001 1.000 1.000 0.999 1.000 | 1.00 1.00 1.01 0.98 1.00 | .58 .42 .28 .14, both ways |
| Azure | uneven, 2,000 to 4,000 | 0.995 0.996 1.002 1.004 1.002 | 0.94 0.94 1.00 1.05 0.99 | equal to 0.01 |
| Azure | listed, 900 to 1,500 | 1.008 1.008 1.006 0.999 1.000 | 1.07 1.07 1.03 0.93 0.95 | equal to 0.01 |
| Kinect v2 | even, 20,000 | 0.998 0.998 0.997 1.001 0.999 | 1.00 0.99 0.98 1.01 1.01 | .60 .28 .00 .00, both ways |
| Kinect v2 | uneven, 400 to 900 | 1.008 1.012 1.004 0.992 1.002 | 1.11 1.00 0.95 1.06 0.90 | equal to 0.01 |
| Kinect v2 | listed, 900 to 1,500 | 1.005 1.017 0.986 0.997 0.992 | 1.06 1.06 0.97 1.00 1.00 | equal to 0.01 |

Means differ by 0.92 to 1.04 standard errors (root mean square over pixels), counts of listed pixels by 0.97 to 1.07.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from harness.vocabulary.capture import Reason
from harness.vocabulary.units import MM
from scenes.sensor.amcw import kernels, listed, ranging
from scenes.sensor.amcw.certainty import Certainty, certainty
from scenes.sensor.amcw.even import even_pixels, fill_even, shares_of
from scenes.sensor.amcw.exposure import Exposure
from scenes.sensor.amcw.filtered import DEVIATIONS, Filtered, unknown_filtered
from scenes.sensor.amcw.light_noise import Light, light_of_samples
from scenes.sensor.amcw.linear import Window, linearised
from scenes.sensor.amcw.linear_frames import EVEN, LANES, NONE, UNEVEN, Linear, add_bytes, add_linear_frames
from scenes.sensor.amcw.listed import Listed, list_pixels
from scenes.sensor.normals import standard_normals
from scenes.sensor.totals import N_REASONS, FrameTotals

if TYPE_CHECKING:
    from scenes.sensor.amcw.imager import AmcwImager

f4 = np.float32
MOST_LISTED = 0.25
"""Share of pixels simulated one by one above which whole frames cost less."""
LEAST_DITHER = 0.6
"""Noise of a sample over the converter's step from which rounding is noise of step^2/12: what the rounding's first
harmonic leaves of it, exp(-2 pi^2 0.6^2), is below 1e-3."""
JITTERS = 6.0
"""Deviations of a frame's displacement that limits of range are kept clear of."""


@dataclass(frozen=True)
class AtOnce:
    """What one imager needs to sum frames of one exposure, some 4 MB for 30,000 pixels; ``light`` and ``shares`` (g, f)
    of the list's halo: before the filter, and each frequency's in the noise that moves z."""

    imager: AmcwImager
    exposure: Exposure
    light: Light
    shares: np.ndarray
    linear: Linear
    certain: Certainty
    list: Listed
    farthest_error_m: float

    @classmethod
    def of(cls, imager: AmcwImager, exposure: Exposure, asked: np.ndarray) -> AtOnce | None:
        """Of the pixels ``asked`` (h, w) bool. None where frames are to be drawn one by one: without noise, where a
        sample may saturate or may not, or where many pixels hang on a gate."""
        wild, lost, dithered = _saturating(imager, exposure)
        if wild.any() or not dithered:
            return None
        camera, shape = imager.camera, exposure.shape
        light = light_of_samples(exposure, float(camera.converter.knee_units.value), imager._gains)
        window = imager.linear_window
        filtered, moves = _filtered(imager, exposure, light, wild, lost, asked)
        unit = camera.unit
        farthest_m = (unit.jump_mm.value + JITTERS * unit.jitter_mm.value + abs(unit.drift_mm.value)) * MM
        certain = certainty(filtered, imager.engine, lost, shape, farthest_m)
        wanted = ~(certain.always | certain.never) & asked.ravel()
        if wanted.mean() > MOST_LISTED:
            return None
        linear = _linear(imager, light, window, certain, moves)
        listing = list_pixels(wanted.reshape(shape), shape, len(linear.taps), imager.engine.flying is not None)
        there = Light(*(np.ascontiguousarray(part[:, listing.halo]) for part in light))
        each = (_weights(imager, light)[:, listing.halo] * there.turn).T
        shares = (each / np.sqrt((each**2).sum(axis=1, keepdims=True))).astype(f4)
        return cls(imager, exposure, there, shares, linear, certain, listing, farthest_m)

    @cached_property
    def sure_pixels(self) -> int:
        """How many pixels have a range in every frame."""
        return int(self.certain.always.sum())

    @cached_property
    def noise_m(self) -> float:
        """The median deviation of one frame's z in these pixels, before rounding and without what frames share."""
        return float(np.median(self.certain.mean.deviation_m[self.certain.always])) if self.sure_pixels else 0.0

    @cached_property
    def z_by_error(self) -> float:
        """By how much z moves where a frame is displaced: the median of the pixels that always have a range."""
        moved = self.certain.mean.z_by_path[self.certain.always]
        return float(np.median(moved)) if moved.size else 1.0

    @cached_property
    def listed(self) -> np.ndarray:
        """(h, w) bool: pixels that are simulated one by one."""
        listed_pixels = np.zeros(self.exposure.sigma.size, bool)
        listed_pixels[self.list.range[self.list.wanted]] = True
        return listed_pixels.reshape(self.exposure.shape)

    def totals(
        self, frames: np.ndarray, errors_m: np.ndarray, stream: Callable[[int], np.random.Generator]
    ) -> FrameTotals:
        """Sums over the frames of numbers ``frames`` (t,), which ``errors_m`` (t,) displace. The noise of frames
        `LANES` k to `LANES` (k + 1) - 1 is from ``stream`` (k), whichever of them are asked for."""
        sums = _Sums.of(self)
        for block in np.unique(frames // LANES):
            chosen = frames // LANES == block
            errors, counted = np.zeros(LANES), np.zeros(LANES, f4)
            errors[frames[chosen] % LANES], counted[frames[chosen] % LANES] = errors_m[chosen], 1
            self._add_block(errors, counted, stream(int(block)), sums)
        return sums.totals(self, len(frames))

    def _add_block(self, errors_m: np.ndarray, counted: np.ndarray, rng: np.random.Generator, sums: _Sums) -> None:
        """Add a block of `LANES` frames, those that are ``counted``, to ``sums``."""
        n, step_m = self.exposure.sigma.size, f4(self.imager.camera.z_step_m)
        given = self._add_one_by_one(errors_m, counted, rng, sums)
        words = rng.bit_generator.random_raw(2 * n * LANES // 8).view(np.int8)
        errors = (errors_m / step_m).astype(f4)
        at = self._given_at
        add_linear_frames(
            self.exposure.shape, self.linear, words[: n * LANES], given, at, errors, counted, sums.total, sums.squares
        )
        add_bytes(words[n * LANES :], counted, sums.sway)

    def _add_one_by_one(
        self, errors_m: np.ndarray, counted: np.ndarray, rng: np.random.Generator, sums: _Sums
    ) -> np.ndarray:
        """The listed pixels of a block; (g, lanes) standard normals of the pixels in their windows."""
        light, engine, wanted = self.light, self.imager.engine, self.list.wanted
        g, m, n_frequencies = len(self.list.halo), len(self.list.range), len(light.turn)
        normals = standard_normals(rng, (g, n_frequencies, 2, LANES))
        if m == 0:
            return normals[:, 0, 0]
        planes = np.empty((g, n_frequencies, listed.BLOCK), f4)
        listed.noisy_phasors(light.phasor, light.amplitude, light.turn, light.swell, normals, planes)
        filtered, edge = np.empty((n_frequencies, 3, m, LANES), f4), np.empty((n_frequencies, m, LANES), f4)
        listed.filter_listed(planes, self.list.window, *self.imager.filter_settings, filtered, edge)
        z_m, total, reason = np.empty((m, LANES), f4), np.empty((m, LANES), f4), np.empty((m, LANES), np.uint8)
        geometry, outside, dry = self._listed_geometry
        ranging.range_and_gates(
            filtered.reshape(n_frequencies, 3, -1), edge.reshape(n_frequencies, -1), dry, geometry, outside,
            engine.lattice, engine.gates, np.tile(errors_m.astype(f4), m), z_m.reshape(-1), reason.reshape(-1),
            total.reshape(-1),
        )  # fmt: skip
        flying = np.zeros((len(wanted), LANES), bool)
        if engine.flying is not None:
            listed.gate_flying_listed(z_m, total, reason, wanted, self.list.near, engine.flying, flying)
        listed.add_listed(
            z_m, reason, total, flying, wanted, counted, n_frequencies, f4(self.imager.camera.z_step_m),
            self.linear.base[self._asked], *sums.listed,
        )  # fmt: skip
        return self._normals(normals)

    @cached_property
    def _asked(self) -> np.ndarray:
        """(p,): flat indices of the pixels that are simulated one by one."""
        return self.list.range[self.list.wanted]

    @cached_property
    def _given_at(self) -> np.ndarray:
        """(n,) int32: place of each pixel in the halo, -1 where it is not in it."""
        places = np.full(self.exposure.sigma.size, -1, np.int32)
        places[self.list.halo] = np.arange(len(self.list.halo))
        return places

    @cached_property
    def _listed_geometry(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Geometry, mask and saturation of the listed pixels, once for each lane."""
        engine, at = self.imager.engine, self.list.range
        outside = np.repeat(engine.outside_mask[at], LANES)
        return np.repeat(engine.geometry[:, at], LANES, axis=1), outside, np.zeros(outside.size, np.uint8)

    def _normals(self, normals: np.ndarray) -> np.ndarray:
        """(g, lanes) float32: of ``normals`` (g, f, 2, lanes) the combination that moves z, with variance 1."""
        return np.asarray((self.shares[:, :, None] * normals[:, :, 1]).sum(axis=1))


@dataclass(frozen=True)
class _Sums:
    """Running sums: of all pixels ``total`` and ``squares`` of z in steps, and ``sway``, of the amplitude's noise;
    of ``listed`` pixels count, total, squares, amplitude and reasons, as `listed.add_listed` takes them."""

    total: np.ndarray
    squares: np.ndarray
    sway: np.ndarray
    listed: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, ours: AtOnce) -> _Sums:
        n, p = ours.exposure.sigma.size, len(ours.list.wanted)
        return cls(
            np.zeros(n),
            np.zeros(n),
            np.zeros(n, f4),
            (np.zeros(p, np.int32), np.zeros(p), np.zeros(p), np.zeros(p), np.zeros((N_REASONS, p), np.uint16)),
        )

    def totals(self, ours: AtOnce, frames: int) -> FrameTotals:
        """The sums over so many frames as a `FrameTotals`."""
        shape, step_m, certain = ours.exposure.shape, ours.imager.camera.z_step_m, ours.certain
        taps, mean = ours.linear.taps, certain.mean
        noise = self.sway.reshape(shape)
        for axis in (0, 1):
            noise = ndimage.correlate1d(noise, taps / np.sqrt((taps**2).sum()), axis=axis, mode="constant")
        amplitude = np.where(certain.always, frames * mean.amplitude + mean.amplitude_deviation * noise.ravel(), 0.0)
        count = np.where(certain.always, frames, 0).astype(np.int32)
        reasons = np.zeros((N_REASONS, count.size), np.uint16)
        never = np.flatnonzero(certain.never)
        reasons[mean.reason[never], never] = frames
        reasons[Reason.VALID, certain.always] = frames
        at = ours._asked
        count[at], self.total[at], self.squares[at], amplitude[at], reasons[:, at] = self.listed
        return FrameTotals(
            frames,
            step_m,
            ours.linear.base.astype(float).reshape(shape),
            count.reshape(shape),
            self.total.reshape(shape),
            self.squares.reshape(shape),
            amplitude.reshape(shape),
            reasons.reshape(-1, *shape),
        )


def _saturating(imager: AmcwImager, exposure: Exposure) -> tuple[np.ndarray, np.ndarray, bool]:
    """(n,) bool each: pixels whose samples may saturate, and those where they always do; whether noise hides the
    converter's steps everywhere."""
    largest = np.abs(exposure.means).max(axis=(0, 1))
    lost = largest - DEVIATIONS * exposure.sigma > exposure.limit
    wild = (largest + DEVIATIONS * exposure.sigma > exposure.limit) & ~lost
    step = np.exp2(
        np.maximum(np.floor(np.log2(np.maximum(largest, 1e-9) / imager.camera.converter.knee_units.value)), 0)
    )
    return wild, lost, bool((exposure.sigma > LEAST_DITHER * step).all())


def _filtered(
    imager: AmcwImager, exposure: Exposure, light: Light, wild: np.ndarray, lost: np.ndarray, asked: np.ndarray
) -> tuple[Filtered, _Moves]:
    """Each pixel that is asked for after the filter, and how noise moves it."""
    window, shape, n = imager.linear_window, exposure.shape, exposure.sigma.size
    unit = np.stack([light.phasor.real, light.phasor.imag]).astype(f4)
    dark = light.amplitude if window.by_amplitude else light.bright
    unit[:, :, lost] = 0
    dark = np.where(lost, kernels.OUTSIDE, dark).astype(f4)
    alone, edge = imager.filter(unit, dark, shape)
    edge = edge.reshape(len(edge), n).astype(float)
    even = even_pixels(edge, light, window, shape, wild | lost)
    out = unknown_filtered(len(light.turn), n)
    each, centre = fill_even(even, alone.reshape(len(alone), 3, n), edge, light, window, shape, shares_of(window), out)
    # what the engine looks at in the finished image of the pixels asked for is one pixel farther
    rest = np.flatnonzero(~even & ndimage.binary_dilation(asked, np.ones((3, 3), bool)).ravel())
    return out, _Moves(
        np.flatnonzero(even), each, centre, rest, linearised(rest, light, window, shape, wild, lost, out)
    )


@dataclass(frozen=True)
class _Moves:
    """Pixels (e,) that are ``even`` with ``each`` and ``centre`` (f, e) of `fill_even`, and the ``rest`` (m,) with
    ``moved`` (f, m, k) of `linearised`."""

    even: np.ndarray
    each: np.ndarray
    centre: np.ndarray
    rest: np.ndarray
    moved: np.ndarray


def _weights(imager: AmcwImager, light: Light) -> np.ndarray:
    """(f, n): metres of half path by a radian of each frequency's phase, times the amplitude that carries it, over its
    median, where the filter counts amplitudes."""
    metres = imager.engine.lattice.metres_per_turn.astype(float)[:, None] / (2 * np.pi)
    if not imager.linear_window.by_amplitude:
        return np.broadcast_to(metres, light.turn.shape)
    return np.asarray(metres * light.amplitude / np.median(light.amplitude, axis=1, keepdims=True))


def _linear(imager: AmcwImager, light: Light, window: Window, certain: Certainty, moves: _Moves) -> Linear:
    """The pixels that always have a range, as `add_linear_frames` takes them."""
    n, step_m = light.turn.shape[1], imager.camera.z_step_m
    metres = imager.engine.lattice.metres_per_turn.astype(float)[:, None] / (2 * np.pi)
    by_path, always = certain.mean.z_by_path, certain.always
    z = np.where(always, certain.mean.z_m / step_m, 0.0)
    noise = np.sqrt(((_weights(imager, light) * np.minimum(light.turn, 1.0)) ** 2).sum(axis=0))
    kind, row = np.full(n, NONE, np.uint8), np.zeros(n, np.int32)
    each, more = np.zeros(n), np.zeros(n)
    at = moves.even
    kind[at] = np.where(always[at], EVEN, NONE)
    carried = light.amplitude[:, at] if window.by_amplitude else 1.0
    by_others = np.sqrt(((metres * moves.each * carried * light.turn[:, at]) ** 2).sum(axis=0)) * by_path[at] / step_m
    by_own = np.sqrt(((metres * moves.centre) ** 2).sum(axis=0)) * by_path[at] / step_m
    each[at] = by_others / noise[at]
    middle = window.space.shape[0] // 2
    more[at] = (by_own - window.space[middle, middle] * by_others) / noise[at]
    kept = always[moves.rest]
    at = moves.rest[kept]
    kind[at], row[at] = UNEVEN, np.arange(len(at))
    pulls = metres[:, :, None] * moves.moved[:, kept]
    pull = np.copysign(np.sqrt((pulls**2).sum(axis=0)), pulls.sum(axis=0)) * by_path[at, None] / step_m
    pull /= _neighbours_noise(noise, certain, moves.rest[kept], window, imager.region.shape)
    taps = window.space[middle] / np.sqrt(window.space[middle, middle])
    base = np.round(z)
    return Linear(
        kind, noise.astype(f4), base.astype(f4), (z - base).astype(f4), by_path.astype(f4), each.astype(f4),
        more.astype(f4), row, pull.astype(f4), taps.astype(f4),
    )  # fmt: skip


def _neighbours_noise(
    noise: np.ndarray, certain: Certainty, pixels: np.ndarray, window: Window, shape: tuple[int, int]
) -> np.ndarray:
    """(m, k): the noise of each pixel's neighbours, 1 beyond the border."""
    side = window.space.shape[0]
    padded = np.pad(noise.reshape(shape), side // 2, constant_values=1.0)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    return np.asarray(windows.reshape(-1, side * side)[pixels])
