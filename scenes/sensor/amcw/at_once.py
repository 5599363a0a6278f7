"""Sums over frames of the imager without its frames: most pixels to first order in the noise, the rest one by one.

`at_once` sorts the pixels of a view, once. Where all gates are sure to let a pixel through and noise acts to first
order, its frames are a moving sum of one normal a pixel, displaced and rounded (`scenes.sensor.amcw.linear_frames`);
where a gate is sure to stop it, nothing is drawn; all others, at rims mostly, go through the whole chain with the
windows that they need, and pixels beside them get the same noise. Frames are independent, so sums over parts of a
capture add up. Not as in a frame: amplitudes have their own noise, independent of that of z (in frames their
correlation is 0.1 at most, at rims of a camera that weighs by amplitude); a pixel without a range has, in all its
frames, the reason that its mean has; variance of second order (2.5 % at most) is put on the centre's noise.

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
from typing import TYPE_CHECKING, NamedTuple

import numba
import numpy as np
from scipy import ndimage

from harness.vocabulary.capture import Reason
from harness.vocabulary.units import MM
from scenes.sensor.amcw import kernels, ranging
from scenes.sensor.amcw.certainty import Certainty, certainty
from scenes.sensor.amcw.even import even_pixels, fill_even, shares_of
from scenes.sensor.amcw.exposure import AmcwExposure
from scenes.sensor.amcw.kernels import LANES
from scenes.sensor.amcw.linear import DEVIATIONS, FilterWindow, Light, light_of_samples, linearised, unknown_filtered
from scenes.sensor.amcw.linear_frames import EVEN, NONE, UNEVEN, Linear, add_bytes, add_linear_frames
from scenes.sensor.frames import N_REASONS, FrameTotals
from scenes.sensor.normals import FAST, standard_normals

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


class Listed(NamedTuple):
    """Pixels to simulate, by flat indices and by places in them.

    ``halo`` (g,): pixels whose light is needed; ``range`` (m,): those that get a range; ``wanted`` (p,): places in
    ``range`` of those whose verdict is wanted. ``window`` (m, k): places in ``halo`` of each range's window; ``near``
    (p, 9): places in ``range`` of the neighbours of each wanted one; -1 for none.
    """

    halo: np.ndarray
    range: np.ndarray
    wanted: np.ndarray
    window: np.ndarray
    near: np.ndarray


def list_pixels(wanted: np.ndarray, side: int, flying: bool) -> Listed:
    """List the pixels ``wanted`` (h, w) bool and those that they need, for a filter window of ``side``; ``flying``:
    whether the engine looks at the finished image's neighbours."""

    def grown(mask: np.ndarray, by: int) -> np.ndarray:
        return np.asarray(ndimage.binary_dilation(mask, np.ones((2 * by + 1,) * 2, bool)))

    def places(mask: np.ndarray) -> np.ndarray:
        """Number the pixels of a mask (h, w) row by row, int32; -1 elsewhere."""
        return np.where(mask, np.cumsum(mask).reshape(mask.shape) - 1, -1).astype(np.int32)

    ranges = grown(wanted, 1) if flying else wanted
    halo = grown(ranges, side // 2)
    in_range, in_halo = places(ranges), places(halo)
    range_, wanted_ = np.flatnonzero(ranges), np.flatnonzero(wanted)
    return Listed(
        np.flatnonzero(halo),
        range_,
        in_range.ravel()[wanted_],
        np.ascontiguousarray(windows_of(in_halo, side, -1)[range_]),
        np.ascontiguousarray(windows_of(in_range, 3, -1)[wanted_]),
    )


def windows_of(image: np.ndarray, side: int, beyond: float) -> np.ndarray:
    """Return (h w, side^2): the windows of an image (h, w), row by row, with ``beyond`` outside the border."""
    padded = np.pad(image, side // 2, constant_values=beyond)
    return np.lib.stride_tricks.sliding_window_view(padded, (side, side)).reshape(-1, side * side)


def at_once(imager: AmcwImager, exposure: AmcwExposure, asked: np.ndarray) -> AtOnce | None:
    """Return what sums frames of an exposure at the pixels ``asked`` (h, w) bool. None where frames are to be drawn one
    by one: without noise, where a sample may saturate or may not, or where many pixels hang on a gate."""
    largest = np.abs(exposure.means).max(axis=(0, 1))
    lost = largest - DEVIATIONS * exposure.sigma > exposure.limit
    wild = (largest + DEVIATIONS * exposure.sigma > exposure.limit) & ~lost
    knee = imager.camera.converter.knee_units.value
    step = np.exp2(np.maximum(np.floor(np.log2(np.maximum(largest, 1e-9) / knee)), 0))
    # without noise that hides the converter's steps frames are not what the linear model says
    if wild.any() or not (exposure.sigma > LEAST_DITHER * step).all():
        return None
    window, shape, n, unit = imager.linear_window, exposure.shape, exposure.sigma.size, imager.camera.unit
    light = light_of_samples(exposure, float(knee), imager.gains)

    # each pixel that is asked for after the filter, and how noise moves it
    noise_free = np.stack([light.phasor.real, light.phasor.imag]).astype(f4)
    noise_free[:, :, lost] = 0
    strength = light.amplitude if window.by_amplitude else light.bright
    alone, edge32 = imager.filter(noise_free, np.where(lost, kernels.OUTSIDE, strength).astype(f4), shape)
    edge = edge32.reshape(len(edge32), n).astype(float)
    even = even_pixels(edge, light, window, shape, wild | lost)
    filtered = unknown_filtered(len(light.turn), n)
    of_even = fill_even(even, alone.reshape(len(alone), 3, n), edge, light, window, shape, shares_of(window), filtered)
    # what the engine looks at in the finished image of the pixels asked for is one pixel farther
    rest = np.flatnonzero(~even & ndimage.binary_dilation(asked, np.ones((3, 3), bool)).ravel())
    moved = linearised(rest, light, window, shape, wild, lost, filtered)
    farthest_m = (unit.jump_mm.value + JITTERS * unit.jitter_mm.value + abs(unit.drift_mm.value)) * MM
    certain = certainty(filtered, imager.engine, lost, shape, farthest_m)
    wanted = ~(certain.always | certain.never) & asked.ravel()
    if wanted.mean() > MOST_LISTED:
        return None

    metres = imager.engine.lattice.metres_per_turn.astype(float)[:, None] / (2 * np.pi)
    # metres of half path by a radian of each phase, times the amplitude that carries it, over its median
    pull = np.broadcast_to(metres, light.turn.shape)
    if window.by_amplitude:
        pull = metres * light.amplitude / np.median(light.amplitude, axis=1, keepdims=True)
    linear = _linear(imager, light, window, certain, np.flatnonzero(even), of_even, rest, moved, pull)
    listing = list_pixels(wanted.reshape(shape), window.space.shape[0], imager.engine.flying is not None)
    halo = Light(*(np.ascontiguousarray(part[:, listing.halo]) for part in light))
    each = (pull[:, listing.halo] * halo.turn).T
    shares = (each / np.sqrt((each**2).sum(axis=1, keepdims=True))).astype(f4)
    return AtOnce(imager, exposure, halo, shares, linear, certain, listing, farthest_m)


def _linear(
    imager: AmcwImager,
    light: Light,
    window: FilterWindow,
    certain: Certainty,
    even: np.ndarray,
    of_even: tuple[np.ndarray, np.ndarray],
    rest: np.ndarray,
    moved: np.ndarray,
    pull: np.ndarray,
) -> Linear:
    """Return the pixels that always have a range, as `add_linear_frames` takes them: ``even`` (e,) with what
    `fill_even` returned, and the ``rest`` (m,) with ``moved`` (f, m, k) of `linearised`."""
    n, step_m, side = light.turn.shape[1], imager.camera.z_step_m, window.space.shape[0]
    metres = imager.engine.lattice.metres_per_turn.astype(float)[:, None] / (2 * np.pi)
    by_path, always, (of_each, of_centre) = certain.z_by_path, certain.always, of_even
    z = np.where(always, certain.z_m / step_m, 0.0)
    noise = np.sqrt(((pull * np.minimum(light.turn, 1.0)) ** 2).sum(axis=0))
    kind, row = np.full(n, NONE, np.uint8), np.zeros(n, np.int32)
    each, more = np.zeros(n), np.zeros(n)
    kind[even] = np.where(always[even], EVEN, NONE)
    carried = light.amplitude[:, even] if window.by_amplitude else 1.0
    moves = metres * of_each * carried * light.turn[:, even]
    by_others = np.sqrt((moves**2).sum(axis=0)) * by_path[even] / step_m
    by_own = np.sqrt(((metres * of_centre) ** 2).sum(axis=0)) * by_path[even] / step_m
    each[even] = by_others / noise[even]
    more[even] = (by_own - window.space[side // 2, side // 2] * by_others) / noise[even]
    kept = always[rest]
    at = rest[kept]
    kind[at], row[at] = UNEVEN, np.arange(len(at))
    pulls = metres[:, :, None] * moved[:, kept]
    by_each = np.copysign(np.sqrt((pulls**2).sum(axis=0)), pulls.sum(axis=0)) * by_path[at, None] / step_m
    by_each /= windows_of(noise.reshape(imager.region.shape), side, 1.0)[at]
    taps = window.space[side // 2] / np.sqrt(window.space[side // 2, side // 2])
    base = np.round(z)
    return Linear(
        kind, noise.astype(f4), base.astype(f4), (z - base).astype(f4), by_path.astype(f4), each.astype(f4),
        more.astype(f4), row, by_each.astype(f4), taps.astype(f4),
    )  # fmt: skip


class AtOnce:
    """Sums of frames of an exposure, from some 4 MB for 30,000 pixels; equal in distribution to those of single frames,
    for a fraction of their cost.

    ``light`` and ``shares`` (g, f) of the list's halo: before the filter, and each frequency's in the noise that moves
    z. ``listed`` (h, w) bool: pixels that are simulated one by one. ``sure_pixels``: how many have a range in every
    frame; over these, the medians ``noise_m``, of the deviation of a frame's z, before rounding and without what frames
    share, and ``z_by_error``, by how much z moves with a frame's displacement; it may be ``farthest_error_m`` at most.
    """

    def __init__(
        self,
        imager: AmcwImager,
        exposure: AmcwExposure,
        light: Light,
        shares: np.ndarray,
        linear: Linear,
        certain: Certainty,
        listing: Listed,
        farthest_error_m: float,
    ) -> None:
        self.imager, self.exposure, self.light, self.shares, self.linear = imager, exposure, light, shares, linear
        self.certain, self.list, self.farthest_error_m = certain, listing, farthest_error_m
        always, n, engine = certain.always, exposure.sigma.size, imager.engine
        self.sure_pixels = int(always.sum())
        self.noise_m = float(np.median(certain.deviation_m[always])) if self.sure_pixels else 0.0
        self.z_by_error = float(np.median(certain.z_by_path[always])) if self.sure_pixels else 1.0
        self._asked = listing.range[listing.wanted]
        self.listed = np.zeros(n, bool)
        self.listed[self._asked] = True
        self.listed = self.listed.reshape(exposure.shape)
        self._given_at = np.full(n, -1, np.int32)
        self._given_at[listing.halo] = np.arange(len(listing.halo))
        # geometry, mask and saturation of the listed pixels, once for each lane
        outside = np.repeat(engine.outside_mask[listing.range], LANES)
        geometry = np.repeat(engine.geometry[:, listing.range], LANES, axis=1)
        self._geometry = np.zeros(outside.size, np.uint8), geometry, outside

    def totals(
        self, frames: np.ndarray, errors_m: np.ndarray, stream: Callable[[int], np.random.Generator]
    ) -> FrameTotals:
        """Sum the frames of numbers ``frames`` (t,), which ``errors_m`` (t,) displace. The noise of frames `LANES` k to
        `LANES` (k + 1) - 1 is from ``stream`` (k), whichever of them are asked for."""
        n, p, shape = self.exposure.sigma.size, len(self._asked), self.exposure.shape
        step_m = self.imager.camera.z_step_m
        total, squares, sway = np.zeros(n), np.zeros(n), np.zeros(n, f4)
        sums = np.zeros(p, np.int32), np.zeros(p), np.zeros(p), np.zeros(p), np.zeros((N_REASONS, p), np.uint16)
        for block in np.unique(frames // LANES):
            chosen = frames // LANES == block
            errors, counted = np.zeros(LANES), np.zeros(LANES, f4)
            errors[frames[chosen] % LANES], counted[frames[chosen] % LANES] = errors_m[chosen], 1
            rng = stream(int(block))
            given = self._add_one_by_one(errors, counted, rng, sums)
            words = rng.bit_generator.random_raw(2 * n * LANES // 8).view(np.int8)
            steps = (errors / f4(step_m)).astype(f4)
            add_linear_frames(
                shape, self.linear, words[: n * LANES], given, self._given_at, steps, counted, total, squares
            )
            add_bytes(words[n * LANES :], counted, sway)

        certain, taps, noise = self.certain, self.linear.taps, sway.reshape(shape)
        for axis in (0, 1):
            noise = ndimage.correlate1d(noise, taps / np.sqrt((taps**2).sum()), axis=axis, mode="constant")
        swaying = len(frames) * certain.amplitude + certain.amplitude_deviation * noise.ravel()
        amplitude = np.where(certain.always, swaying, 0.0)
        count = np.where(certain.always, len(frames), 0).astype(np.int32)
        reasons = np.zeros((N_REASONS, n), np.uint16)
        never, at = np.flatnonzero(certain.never), self._asked
        reasons[certain.reason[never], never] = len(frames)
        reasons[Reason.VALID, certain.always] = len(frames)
        count[at], total[at], squares[at], amplitude[at], reasons[:, at] = sums
        base = self.linear.base.astype(float)
        return FrameTotals(
            len(frames),
            step_m,
            base.reshape(shape),
            count.reshape(shape),
            total.reshape(shape),
            squares.reshape(shape),
            amplitude.reshape(shape),
            reasons.reshape(-1, *shape),
        )

    def _add_one_by_one(
        self, errors_m: np.ndarray, counted: np.ndarray, rng: np.random.Generator, sums: tuple[np.ndarray, ...]
    ) -> np.ndarray:
        """Add the listed pixels of a block to ``sums``; return (g, lanes) standard normals of the pixels in their
        windows: the combination of their noise that moves z."""
        light, engine, wanted = self.light, self.imager.engine, self.list.wanted
        g, m, n_frequencies = len(self.list.halo), len(self.list.range), len(light.turn)
        normals = standard_normals(rng, (g, n_frequencies, 2, LANES))
        if m == 0:
            return normals[:, 0, 0]
        planes = np.empty((g, n_frequencies, kernels.BLOCK), f4)
        kernels.noisy_phasors(light.phasor, light.amplitude, light.turn, light.swell, normals, planes)
        filtered, edge = np.empty((n_frequencies, 3, m, LANES), f4), np.empty((n_frequencies, m, LANES), f4)
        space, settings = self.imager.filter_settings
        kernels.filter_listed(planes, self.list.window, space, settings, filtered, edge)
        z_m, total, reason = np.empty((m, LANES), f4), np.empty((m, LANES), f4), np.empty((m, LANES), np.uint8)
        saturated, geometry, outside = self._geometry
        ranging.range_and_gates(
            filtered.reshape(n_frequencies, 3, -1), edge.reshape(n_frequencies, -1), saturated, geometry, outside,
            engine.lattice, engine.gates, np.tile(errors_m.astype(f4), m), z_m.reshape(-1), reason.reshape(-1),
            total.reshape(-1),
        )  # fmt: skip
        flying = np.zeros((len(wanted), LANES), bool)
        if engine.flying is not None:
            ranging.find_flying(z_m, total, reason, wanted, self.list.near, engine.flying, flying)
        base, step_m = self.linear.base[self._asked], f4(self.imager.camera.z_step_m)
        _add_listed(z_m, reason, total, flying, wanted, counted, 1.0 / n_frequencies, step_m, base, *sums)
        return np.asarray((self.shares[:, :, None] * normals[:, :, 1]).sum(axis=1))


@numba.njit(**FAST)
def _add_listed(  # type: ignore[no-untyped-def]
    z_m, reason, strength, flying, wanted, counted, share, step_m, base, count, total, squares, amplitude, reasons
):
    """Add the frames that are ``counted`` (t,) of listed pixels to sums (p,), and to ``reasons`` (r, p).

    ``z_m``, ``reason``, ``strength`` (amplitudes, times ``share``) (m, t), of which ``wanted`` (p,) count; ``flying``
    (p, t): gated on the finished image. z is rounded to whole steps, less ``base`` (p,)."""
    for p in range(wanted.size):
        for t in range(counted.size):
            if counted[t] == np.float32(0):
                continue
            code = np.uint8(ranging.EDGE) if flying[p, t] else reason[wanted[p], t]
            reasons[code, p] += 1
            if code == ranging.VALID:
                steps = np.floor(z_m[wanted[p], t] / step_m + np.float32(0.5)) - base[p]
                count[p] += 1
                total[p] += steps
                squares[p] += steps * steps
                amplitude[p] += strength[wanted[p], t] * share
