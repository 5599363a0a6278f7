"""Sums over the imager's frames without drawing them: most pixels to first order in the noise, the
others one by one.

`at_once` sorts the pixels of a view once. Where all gates certainly pass a pixel and noise acts to
first order, z is a moving sum of one normal per pixel, displaced and rounded in each frame. Where
a gate certainly stops it, nothing is drawn. All other pixels, mostly at rims, go through the whole
chain. Differences to real frames: amplitudes have their own noise, independent of that of z (in
frames their correlation is at most 0.1); a pixel without a range has, in all its frames, the
reason that its mean has; variance of second order (at most 2.5 %) is added to the centre's noise.
The variance of averages of 50 frames of a board agrees to 0.002 (even pixels), 0.005 (uneven) and
0.017 (listed; tests/validation/at_once.py). Far behind a hole, where light is dim, the variance of
means of 8 frames is 13 to 15 % less than that of single frames' means (standard error 3 %); the
cause is not known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numba
import numpy as np

from harness.vocabulary.geometry import MM, Reason
from scenes.sensor.amcw import kernels, ranging
from scenes.sensor.amcw.certainty import Certainty, certainty, even_pixels, fill_even
from scenes.sensor.amcw.kernels import LANES
from scenes.sensor.amcw.linear import (
    DEVIATIONS,
    Light,
    light_of_samples,
    linearised,
    unknown_filtered,
)
from scenes.sensor.normals import EXACT_SUMS, FAST
from scenes.sensor.unit import N_REASONS, FrameTotals

if TYPE_CHECKING:
    from scenes.sensor.amcw.imager import AmcwExposure, AmcwImager

f4 = np.float32
Arrays = tuple[np.ndarray, ...]
NONE = 0
EVEN = 1
UNEVEN = 2


class Linear(NamedTuple):
    """Pixels of a view, (n,) float32 except ``kind`` (uint8) and ``row`` (int32); z in steps of
    the output. ``noise``: one deviation of a pixel's noise, in any unit. ``z``: the mean minus
    ``base``, a whole number. ``by_path``: change of z per step of half path. EVEN pixels have
    ``each``, the change of z by a neighbour's noise at weight 1, and ``more``, that by the
    centre's own noise beyond its weight's part. UNEVEN pixels have ``row`` in ``moved`` (m,
    side^2): the same by each neighbour. ``taps`` (side,): symmetric weights by distance along a
    row. The sides are an odd multiple of 5, with zeros around a smaller window."""

    kind: np.ndarray
    noise: np.ndarray
    base: np.ndarray
    z: np.ndarray
    by_path: np.ndarray
    each: np.ndarray
    more: np.ndarray
    row: np.ndarray
    moved: np.ndarray
    taps: np.ndarray


BEND = 2.9117528287640084
SCALE = 0.6075658039822274
"""Constants by which SCALE v (1 + BEND v^2) of 256 even v in -1..1 has variance 1 and a normal's
kurtosis."""


@numba.njit(**FAST)
def _noise_row(y, words, given, given_at, noise, w, half, row):  # type: ignore[no-untyped-def]
    """Write the noise of picture row y into ``row`` ((w + 2 half) lanes,), with zeros beside the
    picture."""
    bend = f4(BEND)
    centre = f4(0.5 / 128)
    size = f4(1 / 128)
    for x in range(w):
        i = y * w + x
        start = np.uint64((x + half) * LANES)
        first = np.uint64(i * LANES)
        if given_at[i] >= 0:
            for t in range(LANES):
                row[start + np.uint64(t)] = noise[i] * given[given_at[i], t]
        else:
            deviation = noise[i] * f4(SCALE)
            for t in range(np.uint64(LANES)):
                v = f4(words[first + t]) * size + centre
                row[start + t] = deviation * v * (f4(1) + bend * v * v)


@numba.njit(**FAST)
def _sum_over(values, starts, taps, total):  # type: ignore[no-untyped-def]
    """Write into ``total`` (n,) the sum of n values from each of ``starts`` (5 k,) on, times its
    tap."""
    for q in range(0, taps.size, 5):
        s1 = np.uint64(starts[q])
        s2 = np.uint64(starts[q + 1])
        s3 = np.uint64(starts[q + 2])
        s4 = np.uint64(starts[q + 3])
        s5 = np.uint64(starts[q + 4])
        a = taps[q]
        b = taps[q + 1]
        c = taps[q + 2]
        d = taps[q + 3]
        e = taps[q + 4]
        for k in range(np.uint64(total.size)):
            before = total[k] if q else f4(0)
            some = a * values[s1 + k] + b * values[s2 + k] + c * values[s3 + k]
            total[k] = before + some + d * values[s4 + k] + e * values[s5 + k]


@numba.njit(**FAST)
def _round(z, by_path, errors, each, moved, start, more, own, own_start, rounded):  # type: ignore[no-untyped-def]
    half = f4(0.5)
    for t in range(np.uint64(LANES)):
        noise = each * moved[np.uint64(start) + t] + more * own[np.uint64(own_start) + t]
        rounded[t] = np.floor(z + by_path * errors[t] + noise + half)


@numba.njit(**EXACT_SUMS)
def _sums_of(rounded, counted):  # type: ignore[no-untyped-def]
    """Return sums of z and z^2 over the frames whose ``counted`` (lanes,) is 1, not 0: whole
    numbers, below 2^24."""
    total = f4(0)
    squares = f4(0)
    for t in range(np.uint64(LANES)):
        r = counted[t] * rounded[t]
        total += r
        squares += r * r
    return total, squares


@numba.njit(**FAST)
def add_linear_frames(  # type: ignore[no-untyped-def]
    shape, linear, words, given, given_at, errors, counted, total, squares
):
    """Add `LANES` frames at the EVEN and UNEVEN pixels of ``linear`` to (k, n): z minus base, and
    its square, in steps, over the frames that each row of ``counted`` (k, lanes) counts. ``words``
    (n lanes,) int8: random bytes; the normals ``given`` (g, lanes) replace them where ``given_at``
    (n,) is not -1, so that pixels simulated in another way share their noise. ``errors`` (lanes,):
    displacements in steps."""
    h, w = shape
    side = linear.taps.size
    half = side // 2
    width = (w + 2 * half) * LANES
    # noise of the picture rows of a window, and of one beyond the picture; its sums along columns,
    # and over windows
    rows = np.zeros((side + 1, width), f4)
    down = np.empty(width, f4)
    across = np.empty(w * LANES, f4)
    noise = rows.reshape(rows.size)
    starts = np.empty(side, np.int64)
    places = np.empty(side * side, np.int64)
    beside = np.arange(side) * LANES
    sums = np.empty(LANES, f4)
    rounded = np.empty(LANES, f4)
    for y in range(-half, h):
        if y + half < h:
            _noise_row(
                y + half, words, given, given_at, linear.noise, w, half, rows[(y + half) % side]
            )
        if y < 0:
            continue
        for q in range(side):
            starts[q] = ((y + q - half) % side if 0 <= y + q - half < h else side) * width
        _sum_over(noise, starts, linear.taps, down)
        _sum_over(down, beside, linear.taps, across)
        for x in range(w):
            i = y * w + x
            own = starts[half] + (x + half) * LANES
            z = linear.z[i]
            by_path = linear.by_path[i]
            if linear.kind[i] == EVEN:
                _round(
                    z,
                    by_path,
                    errors,
                    linear.each[i],
                    across,
                    x * LANES,
                    linear.more[i],
                    noise,
                    own,
                    rounded,
                )
            elif linear.kind[i] == UNEVEN:
                for q in range(side * side):
                    places[q] = starts[q // side] + (x + q % side) * LANES
                _sum_over(noise, places, linear.moved[linear.row[i]], sums)
                _round(z, by_path, errors, f4(1), sums, 0, f4(0), sums, 0, rounded)
            else:
                continue
            for part in range(len(counted)):
                a, b = _sums_of(rounded, counted[part])
                total[part, i] += a
                squares[part, i] += b


MOST_LISTED = (
    0.25  # if more of the pixels had to be simulated one by one, whole frames would cost less
)
# from this noise of a sample over the converter's step, rounding is noise of step^2/12, to 1e-3
LEAST_DITHER = 0.6
JITTERS = 6.0  # limits of range keep this many deviations of a frame's displacement away


class Listed(NamedTuple):
    """Pixels to simulate. ``halo`` (g,): flat indices of pixels whose light is needed. ``range``
    (m,): those that get a range. ``wanted`` (p,): indices in ``range`` of those whose result is
    wanted. ``window`` (m, k): indices in ``halo`` of each range's window. ``near`` (p, 9): indices
    in ``range`` of each wanted one's neighbours. -1 means none."""

    halo: np.ndarray
    range: np.ndarray
    wanted: np.ndarray
    window: np.ndarray
    near: np.ndarray


def _listed(wanted: np.ndarray, side: int, flying: bool) -> Listed:
    ranges = grown(wanted, 3) if flying else wanted
    halo = grown(ranges, side)
    # running numbers of the pixels, -1 elsewhere
    in_range = np.where(ranges, np.cumsum(ranges).reshape(ranges.shape) - 1, -1).astype(np.int32)
    in_halo = np.where(halo, np.cumsum(halo).reshape(halo.shape) - 1, -1).astype(np.int32)
    range_ = np.flatnonzero(ranges)
    wanted_ = np.flatnonzero(wanted)
    window = windows_of(in_halo, side, -1, range_)
    near = windows_of(in_range, 3, -1, wanted_)
    return Listed(np.flatnonzero(halo), range_, in_range.ravel()[wanted_], window, near)


def grown(pixels: np.ndarray, side: int) -> np.ndarray:
    """Return the pixels (h, w) bool whose window of ``side`` contains one of ``pixels`` (h, w)
    bool."""
    return cv2.dilate(pixels.view(np.uint8), np.ones((side, side), np.uint8)).view(bool)


def windows_of(image: np.ndarray, side: int, beyond: float, pixels: np.ndarray) -> np.ndarray:
    """Return the windows (m, side^2) of an image (h, w) at flat ``pixels`` (m,), with ``beyond``
    outside the border."""
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(image, side // 2, constant_values=beyond), (side, side)
    )
    return windows[np.divmod(pixels, image.shape[1])].reshape(-1, side * side)


def at_once(imager: AmcwImager, exposure: AmcwExposure, pixels: np.ndarray) -> AtOnce | None:
    """Return the sums of frames at ``pixels`` (h, w) bool. Return None if frames must be drawn: if
    noise does not hide the converter's steps, if a sample may saturate, or if a gate may go either
    way for many pixels."""
    largest = np.abs(exposure.means).max(axis=(0, 1))
    lost = largest - DEVIATIONS * exposure.sigma > exposure.limit
    wild = (largest + DEVIATIONS * exposure.sigma > exposure.limit) & ~lost
    knee = imager.camera.converter.knee_units.value
    step = np.exp2(np.maximum(np.floor(np.log2(np.maximum(largest, 1e-9) / knee)), 0))
    # without noise that hides the converter's steps, frames differ from the linear model
    if wild.any() or not (exposure.sigma > LEAST_DITHER * step).all():
        return None
    window = imager.filter_settings
    shape = exposure.shape
    n = exposure.sigma.size
    unit = imager.camera.unit
    light = light_of_samples(exposure, float(knee), imager.gains)

    # each requested pixel after the filter, and its change by noise
    noise_free = np.stack([light.phasor.real, light.phasor.imag])
    noise_free[:, :, lost] = 0
    strength = light.amplitude if window.by_amplitude else light.bright
    alone, edge = imager.filter(noise_free, np.where(lost, kernels.OUTSIDE, strength), shape)
    edge = edge.reshape(len(edge), n)
    even = even_pixels(edge, light, window, shape, lost)
    filtered = unknown_filtered(len(light.turn), n)
    of_even = fill_even(even, alone.reshape(len(alone), 3, n), edge, light, window, shape, filtered)
    # in the finished image, the engine looks one pixel beyond the requested ones
    rest = np.flatnonzero(~(even | lost) & grown(pixels, 3).ravel())
    moved = linearised(rest, light, window, shape, lost, filtered)
    farthest_m = (
        unit.jump_mm.value + JITTERS * unit.jitter_mm.value + abs(unit.drift_mm.value)
    ) * MM
    certain = certainty(filtered, imager.engine, lost, shape, farthest_m)
    wanted = ~(certain.always | certain.never) & pixels.ravel()
    if wanted.mean() > MOST_LISTED:
        return None

    metres = imager.engine.lattice.metres_per_turn[:, None] / f4(2 * np.pi)
    # metres of half path per radian of each phase, times the amplitude that carries it, over its
    # median
    pull = np.broadcast_to(metres, light.turn.shape)
    if window.by_amplitude:
        pull = metres * light.amplitude / np.median(light.amplitude, axis=1, keepdims=True)
    linear = _linear(imager, light, certain, pull, (np.flatnonzero(even), *of_even), (rest, moved))
    listing = _listed(
        wanted.reshape(shape), window.space.shape[0], imager.engine.flying is not None
    )
    halo = Light(*(np.ascontiguousarray(part[:, listing.halo]) for part in light))
    each = (pull[:, listing.halo] * halo.turn).T
    shares = (each / np.sqrt((each**2).sum(axis=1, keepdims=True))).astype(f4)
    return AtOnce(imager, shape, halo, shares, linear, certain, listing, farthest_m)


def _linear(
    imager: AmcwImager,
    light: Light,
    certain: Certainty,
    pull: np.ndarray,
    at_even: Arrays,
    at_rest: Arrays,
) -> Linear:
    """Return the linear pixels: even ones with the results of `fill_even`, the others with those
    of `linearised`."""
    (even, of_each, of_centre), (rest, moved) = at_even, at_rest
    space = imager.filter_settings.space
    by_amplitude = imager.filter_settings.by_amplitude
    n = light.turn.shape[1]
    step_m = imager.camera.z_step_m
    side = space.shape[0]
    metres = imager.engine.lattice.metres_per_turn[:, None] / f4(2 * np.pi)
    by_path = certain.z_by_path
    always = certain.always
    z = np.where(always, certain.z_m / f4(step_m), f4(0))
    noise = np.sqrt(((pull * np.minimum(light.turn, f4(1))) ** 2).sum(axis=0))
    kind = np.full(n, NONE, np.uint8)
    row = np.zeros(n, np.int32)
    each, more = np.zeros((2, n), f4)
    kind[even] = np.where(always[even], EVEN, NONE)
    carried = light.amplitude[:, even] if by_amplitude else 1.0
    moves = metres * of_each * carried * light.turn[:, even]
    by_others = np.sqrt((moves**2).sum(axis=0)) * by_path[even] / step_m
    by_own = np.sqrt(((metres * of_centre) ** 2).sum(axis=0)) * by_path[even] / step_m
    each[even] = by_others / noise[even]
    more[even] = (by_own - space[side // 2, side // 2] * by_others) / noise[even]
    kept = always[rest]
    at = rest[kept]
    kind[at], row[at] = UNEVEN, np.arange(len(at))
    pulls = metres[:, :, None] * moved[:, kept]
    by_each = (
        np.copysign(np.sqrt((pulls**2).sum(axis=0)), pulls.sum(axis=0))
        * by_path[at, None]
        / f4(step_m)
    )
    by_each /= windows_of(noise.reshape(imager.region.shape), side, 1.0, at)
    taps = space[side // 2] / np.sqrt(space[side // 2, side // 2])
    rim = (10 * ((side + 4) // 10) + 5 - side) // 2
    taps = np.pad(taps, rim)
    by_each = np.pad(by_each.reshape(-1, side, side), ((0, 0), (rim, rim), (rim, rim)))
    by_each = by_each.reshape(-1, taps.size**2)
    base = np.round(z)
    return Linear(kind, noise, base, z - base, by_path, each, more, row, by_each, taps)


@dataclass(frozen=True)
class AtOnce:
    """Sums of frames of an exposure. Their distribution is that of single frames, for a fraction
    of the cost. ``light`` and ``shares`` (g, f), on the list's halo: light before the filter, and
    each frequency's share in the noise of z. ``farthest_error_m``: largest displacement of a
    frame."""

    imager: AmcwImager
    shape: tuple[int, int]
    light: Light
    shares: np.ndarray
    linear: Linear
    certain: Certainty
    list: Listed
    farthest_error_m: float

    @property
    def sure_pixels(self) -> int:
        """Number of pixels that have a range in every frame."""
        return int(self.certain.always.sum())

    @cached_property
    def noise_m(self) -> float:
        """Median deviation of a frame's z over the sure pixels, before rounding, without noise
        shared by a frame."""
        return (
            float(np.median(self.certain.deviation_m[self.certain.always]))
            if self.sure_pixels
            else 0.0
        )

    @cached_property
    def z_by_error(self) -> float:
        """Change of z per displacement of a frame: the median over the sure pixels."""
        return (
            float(np.median(self.certain.z_by_path[self.certain.always]))
            if self.sure_pixels
            else 1.0
        )

    @cached_property
    def listed(self) -> np.ndarray:
        """Flat indices (p,) of the pixels that are simulated one by one."""
        return np.asarray(self.list.range[self.list.wanted])

    @cached_property
    def _engine(self) -> ranging.DepthEngine:
        """The engine of the listed pixels, repeated for each lane."""
        engine = self.imager.engine
        at = np.repeat(self.list.range, LANES)
        return engine._replace(
            geometry=engine.geometry.take(at, axis=1), outside_mask=engine.outside_mask[at]
        )

    def totals(
        self,
        parts: Sequence[np.ndarray],
        errors_m: np.ndarray,
        stream: Callable[[int], np.random.Generator],
    ) -> Sequence[FrameTotals]:
        """Return the sums over the first of ``parts``, over the first two, and so on: each has
        numbers of frames (t,), no number twice. ``errors_m``: displacements by number. The noise
        of frames `LANES` k to `LANES` (k + 1) - 1 comes from ``stream`` (k), whichever of them are
        requested."""
        n = self.linear.z.size
        p = len(self.listed)
        k = len(parts)
        shape = self.shape
        step_m = self.imager.camera.z_step_m
        total = np.zeros((k, n))
        squares = np.zeros((k, n))
        sway = np.zeros((k, n), f4)
        sums = (
            np.zeros((k, p), np.int32),
            *np.zeros((3, k, p)),
            np.zeros((k, N_REASONS, p), np.uint16),
        )
        given_at = np.full(n, -1, np.int32)
        given_at[self.list.halo] = np.arange(len(self.list.halo))
        blocks = 1 + max(int(frames.max(initial=0)) for frames in parts) // LANES
        part_of = np.full(blocks * LANES, -1)
        errors = np.zeros(blocks * LANES, f4)
        for number, frames in enumerate(parts):
            part_of[frames], errors[frames] = number, errors_m[frames]
        for block in np.unique(np.flatnonzero(part_of >= 0) // LANES).tolist():
            lanes = slice(block * LANES, (block + 1) * LANES)
            rng = stream(block)
            counted = (part_of[lanes] == np.arange(k)[:, None]).astype(f4)
            given = self._add_one_by_one(errors[lanes], part_of[lanes], rng, sums)
            draw = rng.bit_generator.random_raw
            words = draw(n * LANES // 8).view(np.int8)
            signs = draw(n)
            steps = errors[lanes] / f4(step_m)
            add_linear_frames(
                shape, self.linear, words, given, given_at, steps, counted, total, squares
            )
            for part, there in zip(sway, counted, strict=True):
                # the amplitude's noise in each frame is one deviation up or down
                bits = np.uint64(sum(1 << lane for lane in np.flatnonzero(there).tolist()))
                part += f4(2) * np.bitwise_count(signs & bits) - f4(there.sum())
        running = (total, squares, sway, *sums)
        for values in running:
            for later in range(1, k):
                values[later] += values[later - 1]
        frames_in = np.cumsum([len(frames) for frames in parts]).tolist()
        return [self._finished(*each) for each in zip(frames_in, *running, strict=True)]

    def _finished(
        self,
        frames: int,
        total: np.ndarray,
        squares: np.ndarray,
        sway: np.ndarray,
        *sums: np.ndarray,
    ) -> FrameTotals:
        """Return the sums over ``frames`` frames from those of the linear and of the listed
        pixels."""
        certain = self.certain
        taps = self.linear.taps
        shape = self.shape
        even = taps / np.sqrt((taps**2).sum())
        noise = cv2.sepFilter2D(sway.reshape(shape), -1, even, even, borderType=cv2.BORDER_CONSTANT)
        swaying = frames * certain.amplitude + certain.amplitude_deviation * noise.ravel()
        amplitude = np.where(certain.always, swaying, 0.0)
        count = np.where(certain.always, frames, 0).astype(np.int32)
        reasons = np.zeros((N_REASONS, len(count)), np.uint16)
        never = np.flatnonzero(certain.never)
        at = self.listed
        reasons[certain.reason[never], never] = frames
        reasons[Reason.VALID, certain.always] = frames
        count[at], total[at], squares[at], amplitude[at], reasons[:, at] = sums
        return FrameTotals(
            frames, self.imager.camera.z_step_m, self.linear.base.astype(float).reshape(shape), count.reshape(shape),
            total.reshape(shape), squares.reshape(shape), amplitude.reshape(shape), reasons.reshape(-1, *shape),
        )  # fmt: skip

    def _add_one_by_one(
        self, errors_m: np.ndarray, part_of: np.ndarray, rng: np.random.Generator, sums: Arrays
    ) -> np.ndarray:
        """Add the listed pixels' frames to ``sums``, each to its ``part_of`` (lanes,). Return
        their halo's noise of z (g, lanes)."""
        light = self.light
        flying_gate = self.imager.engine.flying
        wanted = self.list.wanted
        g = len(self.list.halo)
        m = len(self.list.range)
        n_frequencies = len(light.turn)
        words = rng.bit_generator.random_raw(g * n_frequencies * LANES // 2).view(np.uint32)
        words = words.reshape(g, n_frequencies, LANES)
        noise = np.empty((g, LANES), f4)
        planes = np.empty((g // kernels.BESIDE + 2, n_frequencies, 3, kernels.STRIDE), f4)
        kernels.noisy_phasors(*light[:2], *light[3:], self.shares, words, planes, noise)
        filtered = np.empty((n_frequencies, 3, m, LANES), f4)
        edge = np.empty((n_frequencies, m, LANES), f4)
        kernels.filter_listed(planes, self.list.window, self.imager.filter_settings, filtered, edge)
        flat = filtered.reshape(n_frequencies, 3, -1)
        unsaturated = np.zeros(m * LANES, np.uint8)
        errors = np.tile(errors_m, m)
        ranges = ranging.ranges_of(
            flat, edge.reshape(n_frequencies, -1), unsaturated, self._engine, errors
        )
        z_m, reason, total = (plane.reshape(m, LANES) for plane in ranges)
        flying = np.zeros((len(wanted), LANES), bool)
        if flying_gate is not None:
            ranging.find_flying(z_m, total, reason, wanted, self.list.near, flying_gate, flying)
        base = self.linear.base[self.listed]
        step_m = f4(self.imager.camera.z_step_m)
        _add_listed(
            z_m, reason, total, flying, wanted, part_of, 1.0 / n_frequencies, step_m, base, *sums
        )
        return noise


@numba.njit(**FAST)
def _add_listed(  # type: ignore[no-untyped-def]
    z_m,
    reason,
    strength,
    flying,
    wanted,
    part_of,
    share,
    step_m,
    base,
    count,
    total,
    squares,
    amplitude,
    reasons,
):
    """Add the frames of listed pixels to sums (k, p) and ``reasons`` (k, r, p), each to its part;
    -1: not counted."""
    for p in range(wanted.size):
        for t in range(part_of.size):
            k = part_of[t]
            if k < 0:
                continue
            code = np.uint8(ranging.EDGE) if flying[p, t] else reason[wanted[p], t]
            reasons[k, code, p] += 1
            if code == ranging.VALID:
                steps = np.floor(z_m[wanted[p], t] / step_m + f4(0.5)) - base[p]
                count[k, p] += 1
                total[k, p] += steps
                squares[k, p] += steps * steps
                amplitude[k, p] += strength[wanted[p], t] * share
