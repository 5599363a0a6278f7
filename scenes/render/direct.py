"""The direct part of a view: light from emitter to surface to pixel, deterministic, with fine
sampling at edges."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from scipy import ndimage

from scenes.optics import Quadrilaterals, wave_numbers
from scenes.render.scene import LitScene, Met, on_device

# sub-rays where fewer leave an error in a hole: a dark wall beside a strip of what lies behind it
FINEST = 2048
FLOATS_AT_ONCE = 1 << 24  # sums held on the device at once, and their footprints: 0.07 GB
A_LANE = 16  # sub-rays of one lane: a divisor of all numbers of sub-rays, at most 32 bits
KEPT = 32  # at least so many of a pixel's sub-rays off the face, or all, are starts of paths
KINK_M = 2e-5
BENT_M = 2e-6
"""If a pixel's corners lie farther than the first off the plane at its centre, there is an edge in
it, such as that of a strip of tape. Up to the second, its light follows from that plane without
casting sub-rays."""
UNSURE_M = 1e-4  # pixels whose direct light may be wrong by more are sampled once more, finely
UNEVEN = 0.2  # relative spread of direct light in a footprint that indicates the edge of a shadow
FAST: Any = {
    "cache": True,
    "fastmath": {"contract", "reassoc", "nsz"},
    "nogil": True,
}  # options for compilation
# largest deviation from even spacing, relative to the highest frequency, for the recurrence
COMB_TOLERANCE = 1e-9
Frequencies = tuple[float, ...]


def comb_step(frequencies_hz: tuple[float, ...]) -> float | None:
    """Return the spacing in Hz of four or more evenly spaced frequencies (a comb); None for other
    lists."""
    if len(frequencies_hz) < 4:
        return None
    steps = np.diff(frequencies_hz)
    even = np.abs(steps - steps.mean()).max() <= COMB_TOLERANCE * max(frequencies_hz)
    return float(steps.mean()) if even else None


def added(totals: list[Any], light: Any, length: Any, frequencies_hz: Frequencies) -> list[Any]:
    """Add light after a path's length to real and imaginary sums by frequency, intensity last; for
    a comb, each phasor is the previous one times that of the spacing."""
    import drjit as dr

    out = []
    waves = wave_numbers(frequencies_hz)
    step_hz = comb_step(frequencies_hz)
    if step_hz is None:
        for number in waves:
            sine, cosine = dr.sincos(float(number) * length)
            out += [light * cosine, light * sine]
    else:
        sine, cosine = dr.sincos(float(waves[0]) * length)
        turn_sine, turn_cosine = dr.sincos(float(wave_numbers((step_hz,))[0]) * length)
        re = light * cosine
        im = light * sine
        for _ in waves:
            out += [re, im]
            re, im = re * turn_cosine - im * turn_sine, re * turn_sine + im * turn_cosine
    return [total + part for total, part in zip(totals, [*out, light], strict=True)]


class Hits(NamedTuple):
    """Hits of n rays from the lens, float32: range (NaN for nothing), path out and back, amplitude
    of direct light, albedo, surface (int32, -1 for nothing), texture place (n, 2), whether on the
    undamaged face, unit normal (n, 3)."""

    range_m: np.ndarray
    path_m: np.ndarray
    amplitude: np.ndarray
    albedo: np.ndarray
    surface: np.ndarray
    uv: np.ndarray
    on_face: np.ndarray
    normal: np.ndarray


class OffFace(NamedTuple):
    """Sub-rays that met something other than the undamaged face. ``pixel`` (p,): flat indices of
    pixels that have any, ``share`` (p,): theirs of the footprint, ``counts`` (p,): the number of
    those that stand for all (every second if there are twice KEPT, and so on), ``slopes`` (sum of
    counts, 2) float32: these, by pixel."""

    pixel: np.ndarray
    counts: np.ndarray
    share: np.ndarray
    slopes: np.ndarray

    def chosen(self, here: np.ndarray) -> OffFace:
        """Return those of the pixels selected by a mask (p,)."""
        return OffFace(
            self.pixel[here],
            self.counts[here],
            self.share[here],
            self.slopes[np.repeat(here, self.counts)],
        )


class DirectLight(NamedTuple):
    """The direct part on a region (h, w): phasor (f, h, w); intensity; range, surface and texture
    coordinates of the central ray; share of the footprint on that surface; which pixels were
    finely sampled. ``face`` (f + 1, h, w): mean over a pixel's sub-rays on the undamaged face of
    albedo x exp(i 2 pi f range / c), frequency 0 last. ``face_range_m``: their mean range, 0
    without any. ``off_face``: the other sub-rays that met something."""

    phasor: np.ndarray
    intensity: np.ndarray
    range_m: np.ndarray
    surface: np.ndarray
    uv: np.ndarray
    coverage: np.ndarray
    fine: np.ndarray
    face: np.ndarray
    face_range_m: np.ndarray
    off_face: OffFace


def cast(lit: LitScene, slopes: np.ndarray) -> Hits:
    """Cast rays from the lens along ``slopes`` (n, 2) = x/z, y/z."""
    mi = lit.mi
    dr = lit.dr
    x, y = (on_device(mi.Float, each) for each in slopes.T)
    met = lit.meet(mi.Point3f(0.0), dr.normalize(mi.Vector3f(x, y, 1.0)), coherent=True)
    arriving, leg = lit.arriving(met, coherent=True)
    albedo = lit.albedo(met)
    uv = lit.uv(met.place)
    range_m = dr.select(met.valid, met.distance, dr.nan)
    path_m = dr.select(met.valid, met.distance + leg, 0)
    amplitude = albedo * arriving
    surface = dr.select(met.valid, mi.Int32(met.surface), -1)
    on_face = dr.gather(mi.Bool, lit.on_face, met.triangle, met.valid)
    found = range_m, path_m, amplitude, albedo, surface, *uv, on_face, *met.normal
    dr.eval(*found)
    # one by one: to interleave them, Dr.Jit would compile a kernel for each number of rays
    far, path, light, own, which, u, v, face, nx, ny, nz = (each.numpy() for each in found)
    return Hits(
        far, path, light, own, which, np.column_stack([u, v]), face, np.column_stack([nx, ny, nz])
    )


class _Sums:
    """Sums of direct light of a region's pixels, flat; fields as in `DirectLight`."""

    def __init__(
        self, lit: LitScene, slopes: np.ndarray, footprint: Quadrilaterals, f: Frequencies
    ) -> None:
        self.lit = lit
        self.footprint = footprint
        self.frequencies_hz = f
        self.slopes, (h, w), lines = slopes.reshape(-1, 2), slopes.shape[:2], len(f)
        self.rows, self.cols = np.divmod(np.arange(h * w), w)
        self.central = cast(lit, self.slopes)
        self.phasor, self.face = (
            np.zeros((lines, h * w), complex),
            np.zeros((lines + 1, h * w), complex),
        )
        self.intensity, self.coverage, self.face_range_m = (
            np.zeros(h * w),
            np.ones(h * w),
            np.zeros(h * w),
        )
        none = np.zeros(0, int)
        self.off_face = [OffFace(none, none, np.zeros(0), np.zeros((0, 2), np.float32))]

    def add_all(
        self, wanted: np.ndarray, weights: np.ndarray, again: Any = None, plane: bool = False
    ) -> np.ndarray:
        """Call `add` for the pixels ``wanted`` (h w,), so many at once as memory allows; return a
        mask as well."""
        here = np.flatnonzero(wanted)
        unsure = np.zeros(len(wanted), bool)
        at_once = max(
            FLOATS_AT_ONCE * A_LANE // weights.shape[1] // (4 * len(self.frequencies_hz) + 24), 1
        )
        for begin in range(0, len(here), at_once):
            unsure[self.add(here[begin : begin + at_once], weights, again, plane)] = True
        return unsure

    def add(
        self, here: np.ndarray, weights: np.ndarray, again: Any = None, plane: bool = False
    ) -> np.ndarray:
        """Add the light of the footprints' sub-rays axes (n, 3, k) @ ``weights`` (k, m) in pixels;
        no rays are cast if each pixel sees only the ``plane`` at its centre. Return those of
        ``again`` (h w,) that need finer sampling."""
        mi = self.lit.mi
        dr = self.lit.dr
        central = self.central
        f = self.frequencies_hz
        axes = self.footprint.axes(self.rows[here], self.cols[here])
        m = weights.shape[1]
        lines = len(f)
        (n, _, k), parts = axes.shape, m // A_LANE
        pixel, part = np.divmod(np.arange(n * parts), parts)
        axis = [on_device(mi.Float, each[pixel]) for each in axes.reshape(n, -1).T]
        table = [on_device(mi.Float, each) for each in weights]
        begin = on_device(mi.UInt32, part * A_LANE)
        middle = on_device(mi.Float, central.path_m[here][pixel])
        own = on_device(mi.Float, central.surface[here][pixel])
        if plane:
            ray = np.column_stack([self.slopes[here], np.ones(n)])
            ray *= (central.range_m[here] / np.linalg.norm(ray, axis=1))[:, None]
            height = on_device(mi.Float, (central.normal[here] * ray).sum(axis=1))
            normal = mi.Normal3f(*(on_device(mi.Float, each) for each in central.normal[here].T))
            is_face = on_device(mi.UInt32, central.on_face[here]) > 0
            clear = on_device(mi.UInt32, (central.amplitude > 0)[here]) > 0

        def meet(ray: Any) -> tuple[Met, Any, Any, Any]:
            if plane:
                far = height / dr.dot(normal, ray)
                there = mi.Bool(True)
                met = Met(
                    there, far, mi.Point3f(far * ray), normal, mi.UInt32(own), mi.UInt32(0), -ray
                )
                return met, *self.lit.arriving(met, clear=clear), is_face
            met = self.lit.meet(mi.Point3f(0.0), ray, coherent=True)
            on_face = dr.gather(mi.Bool, self.lit.on_face, met.triangle, met.valid)
            return met, *self.lit.arriving(met, coherent=True), on_face

        def step(
            j: Any, off: Any, light: list[Any], face: list[Any], others: list[Any]
        ) -> tuple[Any, ...]:
            weight = [dr.gather(mi.Float, row, begin + j) for row in table]
            ray = mi.Vector3f(
                *(sum(axis[c * k + i] * weight[i] for i in range(k)) for c in range(3))
            )
            met, arriving, leg, on_face = meet(dr.normalize(ray))
            albedo, (count, same, far, first, second, most) = self.lit.albedo(met), others
            amplitude = albedo * arriving
            longer = dr.select(met.valid, met.distance + leg - middle, 0)
            light = added(light, amplitude, longer + middle, f)
            face = added(face, dr.select(on_face, albedo, 0), met.distance, f)
            same = same + dr.select(
                dr.select(met.valid, mi.Float(met.surface), -1) == own, 1.0, 0.0
            )
            far = far + dr.select(on_face, met.distance, 0)
            count = count + dr.select(on_face, 1.0, 0.0)
            first = first + amplitude * longer
            second = second + amplitude * dr.square(longer)
            off = off | dr.select(met.valid & ~on_face, mi.UInt32(1) << j, 0)
            return (
                j + 1,
                off,
                light,
                face,
                [count, same, far, first, second, dr.maximum(most, amplitude)],
            )

        zeros = [
            [dr.zeros(mi.Float, n * parts) for _ in range(size)]
            for size in (2 * lines + 1, 2 * lines + 1, 6)
        ]
        state = (*(dr.zeros(mi.UInt32, n * parts) for _ in range(2)), *zeros)
        _, off, *found = dr.while_loop(state, lambda j, *_: j < A_LANE, step, label="footprints")
        dr.eval(off, *found)
        light, face, others = (
            np.stack([e.numpy() for e in each]).reshape(-1, n, parts) for each in found
        )
        strongest = np.maximum(others[5].max(axis=1), 1e-30)
        light = light.sum(axis=2, dtype=float) / m
        face = face.sum(axis=2, dtype=float) / m
        others = others.sum(axis=2, dtype=float) / m
        count, same, far, first, second, _ = others
        self.phasor[:, here], self.intensity[here] = light[:-1:2] + 1j * light[1::2], light[-1]
        self.face[:-1, here], self.face[-1, here] = face[:-1:2] + 1j * face[1::2], face[-1]
        self.coverage[here], self.face_range_m[here] = same, far / np.maximum(count, 1 / m)
        # an edge is misplaced by one or two of m sub-rays; holes of 1/16 to 1 in before a backing
        # showed this error
        total = np.maximum(light[-1], 1e-30)
        spread = np.sqrt(np.maximum(second / total - (first / total) ** 2, 0.0))
        error_m = 1.5 * spread / (m * np.sqrt(np.maximum(light[-1] / strongest, 1 / m)))
        unsure = np.zeros(n, bool) if again is None else again[here] & (error_m > UNSURE_M)
        off = off.numpy().reshape(n, parts)
        counts = np.where(unsure, 0, np.bitwise_count(off).sum(axis=1, dtype=int))
        steps = np.maximum(counts // KEPT, 1)
        some = counts > 0
        kept = -(-counts // steps)[some]
        slopes = np.empty((kept.sum(), 2), np.float32)
        _slopes_kept(off[some], steps[some], axes[some], weights, slopes)
        self.off_face.append(OffFace(here[some], kept, counts[some] / m, slopes))
        return here[unsure]


@numba.njit(**FAST)
def _slopes_kept(off, steps, axes, weights, slopes):  # type: ignore[no-untyped-def]
    """Write the slopes of every ``steps`` (n,)-th of a pixel's sub-rays whose bit is set in
    ``off`` (n, m / A_LANE)."""
    at = 0
    ray = np.zeros(3)
    for i in range(off.shape[0]):
        number = 0
        for j in range(weights.shape[1]):
            if off[i, j // A_LANE] >> (j % A_LANE) & 1:
                if number % steps[i] == 0:
                    ray[:] = 0.0
                    for c in range(3):
                        for k in range(weights.shape[0]):
                            ray[c] += axes[i, c, k] * weights[k, j]
                    slopes[at, 0], slopes[at, 1] = ray[0] / ray[2], ray[1] / ray[2]
                    at += 1
                number += 1


def direct_light(
    lit: LitScene,
    slopes: np.ndarray,
    footprint: Quadrilaterals,
    frequencies_hz: Frequencies,
    closely: np.ndarray | None = None,
    roughly: np.ndarray | None = None,
) -> DirectLight:
    """Return the direct light of every pixel of a region with central rays ``slopes`` (h, w, 2).
    If the rays to a pixel's centre and corners meet one evenly lit plane, its light follows from
    these. Other pixels are sampled by sub-rays: a few on a curved surface, many where the
    footprint meets an edge or the edge of a shadow, in the pixels that are 2 in ``closely`` (h,
    w), and in those that are 1 beside such edges; where that is not 0, more follow if an error is
    left. There are a few at edges in the pixels ``roughly``."""
    shape = slopes.shape[:2]
    sums = _Sums(lit, slopes, footprint, frequencies_hz)
    central = sums.central
    bend_m, edge = _corners(lit, footprint.corner, slopes, central)
    if closely is not None:
        edge |= (closely > 1) | (
            (closely > 0) & ndimage.binary_dilation(edge, np.ones((3, 3), bool))
        )
    reach = 2 * footprint.reach_px + 1
    edge = ndimage.binary_dilation(edge, np.ones((reach, reach), bool))
    fine = edge if roughly is None else edge & ~roughly
    rest = ~fine.ravel()
    bent = ((bend_m > BENT_M) | edge).ravel()
    sums.add_all(rest & ~bent & (central.surface >= 0), footprint.grid(), plane=True)
    sums.add_all(rest & bent, footprint.grid())
    unsure = sums.add_all(
        fine.ravel(), footprint.lattice(), None if closely is None else closely.ravel() > 0
    )
    sums.add_all(unsure, footprint.lattice(FINEST))
    return DirectLight(
        phasor=sums.phasor.reshape(-1, *shape),
        intensity=sums.intensity.reshape(shape),
        range_m=central.range_m.reshape(shape).astype(float),
        surface=central.surface.reshape(shape).astype(np.int16),
        uv=central.uv.reshape(*shape, 2),
        coverage=sums.coverage.reshape(shape).astype(np.float32),
        fine=fine,
        face=sums.face.reshape(-1, *shape),
        face_range_m=sums.face_range_m.reshape(shape),
        off_face=OffFace(*map(np.concatenate, zip(*sums.off_face, strict=True))),
    )


def _corners(
    lit: LitScene, corner: np.ndarray, slopes: np.ndarray, central: Hits
) -> tuple[np.ndarray, np.ndarray]:
    """Return, (h, w) each, how far rays through a pixel's corners (slopes ``corner``, (h + 1, w +
    1, 2)) hit off the plane at its centre, and whether they show an edge or the edge of a shadow
    in the pixel."""
    (h, w), hits = slopes.shape[:2], cast(lit, corner.reshape(-1, 2))
    rays = np.concatenate([slopes, np.ones((h, w, 1))], axis=-1)
    normal = central.normal.reshape(h, w, 3).astype(float)
    middle_m = central.range_m.reshape(h, w).astype(float)
    surface = central.surface.reshape(h, w)
    height_m = middle_m * (normal * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
    bare = np.divide(
        hits.amplitude, hits.albedo, out=np.zeros(len(hits.albedo)), where=hits.albedo > 0
    )
    middle = np.divide(
        central.amplitude, central.albedo, out=np.zeros(h * w), where=central.albedo > 0
    ).reshape(h, w)
    most = middle.copy()
    least = middle.copy()
    bend_m = np.zeros((h, w))
    edge = np.zeros((h, w), bool)
    for at in (
        (down, across)
        for down in (slice(h), slice(1, None))
        for across in (slice(w), slice(1, None))
    ):
        range_m = hits.range_m.reshape(h + 1, w + 1)[at]
        light = bare.reshape(h + 1, w + 1)[at]
        other = hits.surface.reshape(h + 1, w + 1)[at]
        x = corner[at][..., 0]
        y = corner[at][..., 1]
        length = np.sqrt(1 + x * x + y * y)
        with np.errstate(invalid="ignore", divide="ignore"):
            off_m = np.abs(
                range_m
                - height_m * length / (normal[..., 0] * x + normal[..., 1] * y + normal[..., 2])
            )
        bend_m = np.fmax(bend_m, off_m)
        edge |= other != surface
        most = np.maximum(most, light)
        least = np.minimum(least, light)
    return bend_m, edge | (bend_m > KINK_M) | (most - least > UNEVEN * most)
