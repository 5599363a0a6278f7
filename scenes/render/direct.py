"""The direct part of a view: light from emitter to surface to pixel, deterministic, with fine sampling at edges."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from scipy import ndimage

from scenes.optics import COARSE, FINE, Quadrilaterals, wave_numbers
from scenes.render.scene import LitScene, on_device

FINEST = 2048  # sub-rays where fewer leave an error in a hole: a dark wall beside a strip of what lies behind it
RAYS_AT_ONCE = 1 << 22  # sub-rays cast at once
A_LANE = 16  # sub-rays of one lane: a divisor of all numbers of sub-rays, at most 32 bits
ALL_OF_A_LANE = (1 << A_LANE) - 1
KEPT = 32  # at least so many of a pixel's sub-rays off the face, or all, are starts of paths
KINK_M, BENT_M = 2e-5, 2e-6
"""If a pixel's corners lie farther than the first off the plane at its centre, there is an edge in it, such as that of
a strip of tape. Up to the second, its light follows from that plane without casting sub-rays."""
UNSURE_M = 1e-4  # pixels whose direct light may be wrong by more are sampled once more, finely
UNEVEN = 0.2  # relative spread of direct light in a footprint that indicates the edge of a shadow
FAST: Any = {"cache": True, "fastmath": {"contract", "reassoc", "nsz"}, "nogil": True}
"""Options for compilation. Sums are in float64; their order changes a range by 1e-14 m."""
COMB_TOLERANCE = 1e-9  # largest deviation from even spacing, relative to the highest frequency, for the recurrence
Frequencies = tuple[float, ...]


def comb_step(frequencies_hz: tuple[float, ...]) -> float | None:
    """Return the spacing in Hz of four or more evenly spaced frequencies (a comb); None for other lists."""
    if len(frequencies_hz) < 4:
        return None
    steps = np.diff(frequencies_hz)
    even = np.abs(steps - steps.mean()).max() <= COMB_TOLERANCE * max(frequencies_hz)
    return float(steps.mean()) if even else None


def added(totals: list[Any], light: Any, length: Any, frequencies_hz: Frequencies) -> list[Any]:
    """Add light after a path's length to real and imaginary sums by frequency, intensity last; for a comb, each phasor
    is the previous one times that of the spacing."""
    import drjit as dr

    out, waves, step_hz = [], wave_numbers(frequencies_hz), comb_step(frequencies_hz)
    if step_hz is None:
        for number in waves:
            sine, cosine = dr.sincos(float(number) * length)
            out += [light * cosine, light * sine]
    else:
        sine, cosine = dr.sincos(float(waves[0]) * length)
        turn_sine, turn_cosine = dr.sincos(float(wave_numbers((step_hz,))[0]) * length)
        re, im = light * cosine, light * sine
        for _ in waves:
            out += [re, im]
            re, im = re * turn_cosine - im * turn_sine, re * turn_sine + im * turn_cosine
    return [total + part for total, part in zip(totals, [*out, light], strict=True)]


class Hits(NamedTuple):
    """Hits of n rays from the lens, float32: range (NaN for nothing), path out and back, amplitude of direct light,
    albedo, surface (int32, -1 for nothing), texture place (n, 2), whether on the undamaged face, unit normal (n, 3)."""

    range_m: np.ndarray
    path_m: np.ndarray
    amplitude: np.ndarray
    albedo: np.ndarray
    surface: np.ndarray
    uv: np.ndarray
    on_face: np.ndarray
    normal: np.ndarray


class OffFace(NamedTuple):
    """Sub-rays that met something other than the undamaged face. ``pixel`` (p,): flat indices of pixels that have any,
    ``share`` (p,): theirs of the footprint, ``counts`` (p,): the number of those that stand for all (every second if
    there are twice KEPT, and so on), ``slopes`` (sum of counts, 2) float32: these, by pixel."""

    pixel: np.ndarray
    counts: np.ndarray
    share: np.ndarray
    slopes: np.ndarray

    def chosen(self, here: np.ndarray) -> OffFace:
        """Return those of the pixels selected by a mask (p,)."""
        return OffFace(self.pixel[here], self.counts[here], self.share[here], self.slopes[np.repeat(here, self.counts)])


class DirectLight(NamedTuple):
    """The direct part on a region (h, w): phasor (f, h, w); intensity; range, surface and texture coordinates of the
    central ray; share of the footprint on that surface; which pixels were finely sampled. ``face`` (f + 1, h, w): mean
    over a pixel's sub-rays on the undamaged face of albedo x exp(i 2 pi f range / c), frequency 0 last.
    ``face_range_m``: their mean range, 0 without any. ``off_face``: the other sub-rays that met something."""

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
    mi, dr = lit.mi, lit.dr
    x, y = (on_device(mi.Float, each) for each in slopes.T)
    met = lit.meet(mi.Point3f(0.0), dr.normalize(mi.Vector3f(x, y, 1.0)), coherent=True)
    arriving, leg = lit.arriving(met, coherent=True)
    albedo, uv = lit.albedo(met), lit.uv(met.place)
    range_m = dr.select(met.valid, met.distance, dr.nan)
    path_m, amplitude = dr.select(met.valid, met.distance + leg, 0), albedo * arriving
    surface = dr.select(met.valid, mi.Int32(met.surface), -1)
    on_face = dr.gather(mi.Bool, lit.on_face, met.triangle, met.valid)
    found = range_m, path_m, amplitude, albedo, surface, *uv, on_face, *met.normal
    dr.eval(*found)
    # one by one: to interleave them, Dr.Jit would compile a kernel for each number of rays
    far, path, light, own, which, u, v, face, nx, ny, nz = (each.numpy() for each in found)
    return Hits(far, path, light, own, which, np.column_stack([u, v]), face, np.column_stack([nx, ny, nz]))


class Summed(NamedTuple):
    """Sums over the sub-rays of n footprints: phasors (f, n), intensity and coverage (n,) as in `DirectLight`; of those
    on the face ``face`` (f + 1, n) and ``face_range_m`` (n,); ``off`` (n, m / A_LANE), a bit for each that met another
    surface; and ``error_m`` (n,), the approximate error of range."""

    phasor: np.ndarray
    intensity: np.ndarray
    coverage: np.ndarray
    face: np.ndarray
    face_range_m: np.ndarray
    off: np.ndarray
    error_m: np.ndarray


def summed(
    lit: LitScene, axes: np.ndarray, weights: np.ndarray, surface: np.ndarray, about_m: np.ndarray, f: Frequencies
) -> Summed:
    """Cast the sub-rays ``axes`` (n, 3, k) @ ``weights`` (k, m) of footprints and sum their light. ``surface`` (n,) and
    ``about_m`` (n,): surface and path of the central ray. A lane casts A_LANE of them."""
    mi, dr, (n, _, k), m, lines = lit.mi, lit.dr, axes.shape, weights.shape[1], len(f)
    parts = m // A_LANE
    columns = [on_device(mi.Float, each) for each in axes.reshape(n, -1).T]
    table, own = [on_device(mi.Float, each) for each in weights], on_device(mi.UInt32, surface)
    lanes = [on_device(mi.UInt32, each) for each in np.divmod(np.arange(n * parts), parts)]
    middle, begin = on_device(mi.Float, np.repeat(about_m, parts)), lanes[1] * A_LANE
    axis = [dr.gather(mi.Float, column, lanes[0]) for column in columns]
    surface_there = dr.gather(mi.UInt32, own, lanes[0])

    def step(j: Any, off: Any, light: list[Any], face: list[Any], others: list[Any]) -> tuple[Any, ...]:
        weight = [dr.gather(mi.Float, row, begin + j) for row in table]
        ray = mi.Vector3f(*(sum(axis[c * k + i] * weight[i] for i in range(k)) for c in range(3)))
        met = lit.meet(mi.Point3f(0.0), dr.normalize(ray), coherent=True)
        arriving, leg = lit.arriving(met, coherent=True)
        albedo = lit.albedo(met)
        amplitude, longer = albedo * arriving, dr.select(met.valid, met.distance + leg - middle, 0)
        on_face = dr.gather(mi.Bool, lit.on_face, met.triangle, met.valid)
        light = added(light, amplitude, longer + middle, f)
        face = added(face, dr.select(on_face, albedo, 0), met.distance, f)
        count, same, far, first, second, most = others
        same = same + dr.select(dr.select(met.valid, met.surface, mi.UInt32(0xFFFFFFFF)) == surface_there, 1.0, 0.0)
        far, count = far + dr.select(on_face, met.distance, 0), count + dr.select(on_face, 1.0, 0.0)
        first, second = first + amplitude * longer, second + amplitude * dr.square(longer)
        off = off | dr.select(met.valid & ~on_face, mi.UInt32(1) << j, 0)
        return j + 1, off, light, face, [count, same, far, first, second, dr.maximum(most, amplitude)]

    size = n * parts
    zeros = [[dr.zeros(mi.Float, size) for _ in range(number)] for number in (2 * lines + 1, 2 * lines + 1, 6)]
    state = (dr.zeros(mi.UInt32, size), dr.zeros(mi.UInt32, size), *zeros)
    _, off, *found = dr.while_loop(state, lambda j, *_: j < A_LANE, step, label="footprints")
    dr.eval(off, *found)
    light, face, others = (np.stack([e.numpy() for e in each]).reshape(-1, n, parts) for each in found)
    count, same, far, first, second, _ = others.sum(axis=2, dtype=float)
    light, face = (each.sum(axis=2, dtype=float) for each in (light, face))
    strongest, total = np.maximum(others[5].max(axis=1), 1e-30), np.maximum(light[-1], 1e-30)
    # an edge is misplaced by one or two of m sub-rays; holes of 1/16 to 1 in before a backing showed this error
    spread = np.sqrt(np.maximum(second / total - (first / total) ** 2, 0.0))
    return Summed(
        phasor=(light[:-1:2] + 1j * light[1::2]) / m,
        intensity=light[-1] / m,
        coverage=same / m,
        face=np.concatenate([face[:-1:2] + 1j * face[1::2], face[-1:]]) / m,
        face_range_m=far / np.maximum(count, 1),
        off=off.numpy().reshape(n, parts),
        error_m=1.5 * spread / (m * np.sqrt(np.maximum(light[-1] / m / strongest, 1 / m))),
    )


@numba.njit(**FAST)
def _plane_light(  # type: ignore[no-untyped-def]
    axes, weights, centre, normal, emitter, albedo, texture, uv_of, waves, light, face
):
    """Sum a pixel's light over the sub-rays ``axes`` (n, 3, k) @ ``weights`` (k, m) on the plane of its ``centre`` and
    ``normal`` (n, 3): ``light`` (f + 1, n), whose amplitude is the albedo at the centre, and ``face``, the albedo at
    its range; frequency 0 last. ``albedo`` (n,): negative where ``texture`` gives it. Phases about the centre's are a
    series of moments, 1e-6 off at 0.07 rad."""
    rows, columns = texture.shape
    n, _, terms = axes.shape
    m = weights.shape[1]
    lit, own = np.empty(4), np.empty(4)
    px, py, pz, longer, farther, facing = np.empty((6, m))
    for i in range(n):
        x0, y0, z0 = centre[i]
        nx, ny, nz = normal[i]
        height = nx * x0 + ny * y0 + nz * z0
        ex, ey, ez = emitter[0] - x0, emitter[1] - y0, emitter[2] - z0
        leg0 = np.sqrt(ex * ex + ey * ey + ez * ez)
        range0 = np.sqrt(x0 * x0 + y0 * y0 + z0 * z0)
        facing0 = (nx * ex + ny * ey + nz * ez) / leg0**3
        bright = 1.0 / facing0 if facing0 > 0.0 else 0.0
        lit[:] = 0.0
        own[:] = 0.0
        px[:] = 0.0
        py[:] = 0.0
        pz[:] = 0.0
        for k in range(terms):
            ax, ay, az = axes[i, 0, k], axes[i, 1, k], axes[i, 2, k]
            for j in range(m):
                px[j] += ax * weights[k, j]
                py[j] += ay * weights[k, j]
                pz[j] += az * weights[k, j]
        for j in range(m):
            scale = height / (nx * px[j] + ny * py[j] + nz * pz[j])
            x, y, z = px[j] * scale, py[j] * scale, pz[j] * scale
            dx, dy, dz = emitter[0] - x, emitter[1] - y, emitter[2] - z
            squared = dx * dx + dy * dy + dz * dz
            leg, range_m = np.sqrt(squared), np.sqrt(x * x + y * y + z * z)
            facing[j] = (nx * dx + ny * dy + nz * dz) / (squared * leg) * bright
            longer[j], farther[j] = range_m + leg - range0 - leg0, range_m - range0
            px[j], py[j], pz[j] = x, y, z
        for j in range(m):
            a = albedo[i]
            if a < 0.0:
                u = uv_of[0, 0] * px[j] + uv_of[0, 1] * py[j] + uv_of[0, 2] * pz[j] + uv_of[0, 3]
                v = uv_of[1, 0] * px[j] + uv_of[1, 1] * py[j] + uv_of[1, 2] * pz[j] + uv_of[1, 3]
                across = min(max(u * columns - 0.5, 0.0), columns - 1.0)
                down = min(max(v * rows - 0.5, 0.0), rows - 1.0)
                c, r = min(int(across), columns - 2), min(int(down), rows - 2)
                p, q = across - c, down - r
                above = (1.0 - p) * texture[r, c] + p * texture[r, c + 1]
                a = (1.0 - q) * above + q * ((1.0 - p) * texture[r + 1, c] + p * texture[r + 1, c + 1])
            amplitude = a * facing[j]
            for order in range(4):
                lit[order] += amplitude
                own[order] += a
                amplitude *= longer[j]
                a *= farther[j]
        for k in range(waves.size):
            w = waves[k]
            series = complex(lit[0] - w * w * lit[2] / 2, w * lit[1] - w**3 * lit[3] / 6)
            light[k, i] = series * np.exp(1j * w * (range0 + leg0)) / m
            series = complex(own[0] - w * w * own[2] / 2, w * own[1] - w**3 * own[3] / 6)
            face[k, i] = series * np.exp(1j * w * range0) / m
        light[waves.size, i], face[waves.size, i] = lit[0] / m, own[0] / m


class _Sums:
    """Sums of direct light of a region's pixels, flat; fields as in `DirectLight`."""

    def __init__(
        self, lit: LitScene, slopes: np.ndarray, footprint: Quadrilaterals, frequencies_hz: Frequencies
    ) -> None:
        self.lit, self.footprint, self.frequencies_hz = lit, footprint, frequencies_hz
        self.slopes, (h, w), lines = slopes.reshape(-1, 2), slopes.shape[:2], len(frequencies_hz)
        self.rows, self.cols = np.divmod(np.arange(h * w), w)
        self.central = cast(lit, self.slopes)
        self.phasor, self.face = np.zeros((lines, h * w), complex), np.zeros((lines + 1, h * w), complex)
        self.intensity, self.coverage, self.face_range_m = np.zeros(h * w), np.ones(h * w), np.zeros(h * w)
        self.off_face: list[OffFace] = []

    def add_plane(self, here: np.ndarray) -> None:
        """Add the light of pixels that see a single plane, from the hits of their centres."""
        lit, central, waves = self.lit, self.central, wave_numbers(self.frequencies_hz)
        axes, weights = self.footprint.axes(self.rows[here], self.cols[here]), self.footprint.grid()
        ray = np.column_stack([self.slopes[here], np.ones(len(here))])
        range_m, albedo = (each[here].astype(float) for each in (central.range_m, central.albedo))
        centre = ray * (range_m / np.linalg.norm(ray, axis=1))[:, None]
        light, face = np.empty((2, len(waves) + 1, len(here)), complex)
        plain = np.where(central.surface[here] == lit.textured, -1.0, albedo)
        texture = np.zeros((2, 2), np.float32) if lit.texture is None else lit.parts[lit.textured].texture_850
        normal = central.normal[here].astype(float)
        _plane_light(axes, weights, centre, normal, lit.emitter_m, plain, texture, lit.uv_of, waves, light, face)
        light *= np.divide(central.amplitude[here], albedo, out=np.zeros(len(here)), where=albedo > 0)
        self.phasor[:, here], self.intensity[here] = light[:-1], light[-1].real
        on = central.on_face[here]
        self.face[:, here[on]], self.face_range_m[here[on]] = face[:, on], range_m[on]
        self._keep_off_face(here[~on], np.full((int((~on).sum()), 1), ALL_OF_A_LANE, np.uint32), axes[~on], weights)

    def add_rays(self, here: np.ndarray, weights: np.ndarray, again: np.ndarray | None = None) -> np.ndarray:
        """Add the light of sub-rays of pixels. Return those of ``again`` (h w,) that need finer sampling."""
        axes, central = self.footprint.axes(self.rows[here], self.cols[here]), self.central
        found = summed(self.lit, axes, weights, central.surface[here], central.path_m[here], self.frequencies_hz)
        self.phasor[:, here], self.intensity[here], self.coverage[here] = found[:3]
        self.face[:, here], self.face_range_m[here] = found.face, found.face_range_m
        unsure = np.zeros(len(here), bool) if again is None else again[here] & (found.error_m > UNSURE_M)
        self._keep_off_face(here[~unsure], found.off[~unsure], axes[~unsure], weights)
        return here[unsure]

    def _keep_off_face(self, here: np.ndarray, off: np.ndarray, axes: np.ndarray, weights: np.ndarray) -> None:
        counts = np.bitwise_count(off).sum(axis=1, dtype=int)
        steps, some = np.maximum(counts // KEPT, 1), counts > 0
        kept = -(-counts // steps)
        slopes = np.empty((kept.sum(), 2), np.float32)
        _slopes_kept(off, steps, axes, weights, slopes)
        self.off_face.append(OffFace(here[some], kept[some], counts[some] / weights.shape[1], slopes))


@numba.njit(**FAST)
def _slopes_kept(off, steps, axes, weights, slopes):  # type: ignore[no-untyped-def]
    """Write the slopes of every ``steps`` (n,)-th of a pixel's sub-rays whose bit is set in ``off`` (n, m / A_LANE)."""
    at = 0
    for i in range(off.shape[0]):
        number = 0
        for j in range(weights.shape[1]):
            if off[i, j // A_LANE] >> (j % A_LANE) & 1:
                if number % steps[i] == 0:
                    x = y = z = 0.0
                    for k in range(weights.shape[0]):
                        x += axes[i, 0, k] * weights[k, j]
                        y += axes[i, 1, k] * weights[k, j]
                        z += axes[i, 2, k] * weights[k, j]
                    slopes[at, 0], slopes[at, 1] = x / z, y / z
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
    """Return the direct light of every pixel of a region with central rays ``slopes`` (h, w, 2). If the rays to a
    pixel's centre and corners meet one evenly lit plane, its light follows from these. Other pixels are sampled by
    sub-rays: a few on a curved surface, many where the footprint meets an edge or the edge of a shadow, in the pixels
    that are 2 in ``closely`` (h, w), and in those that are 1 beside such edges; where that is not 0, more follow if an
    error is left. There are a few at edges in the pixels ``roughly``."""
    shape, sums = slopes.shape[:2], _Sums(lit, slopes, footprint, frequencies_hz)
    central = sums.central
    bend_m, edge = _corners(lit, footprint.corner, slopes, central)
    if closely is not None:
        edge |= (closely > 1) | ((closely > 0) & ndimage.binary_dilation(edge, np.ones((3, 3), bool)))
    reach = 2 * footprint.reach_px + 1
    edge = ndimage.binary_dilation(edge, np.ones((reach, reach), bool))
    fine = edge if roughly is None else edge & ~roughly
    rest, bent = ~fine.ravel(), ((bend_m > BENT_M) | edge).ravel()
    sums.add_plane(np.flatnonzero(rest & ~bent & (central.surface >= 0)))
    for here in _chunks(np.flatnonzero(rest & bent), COARSE**2):
        sums.add_rays(here, footprint.grid())
    again = None if closely is None else closely.ravel() > 0
    unsure = [sums.add_rays(here, footprint.lattice(), again) for here in _chunks(np.flatnonzero(fine), FINE)]
    for here in _chunks(np.concatenate([np.zeros(0, int), *unsure]), FINEST):
        sums.add_rays(here, footprint.lattice(FINEST))
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


def _chunks(pixels: np.ndarray, per_pixel: int) -> list[np.ndarray]:
    at_once = RAYS_AT_ONCE // per_pixel
    return [pixels[begin : begin + at_once] for begin in range(0, len(pixels), at_once)]


def _corners(lit: LitScene, corner: np.ndarray, slopes: np.ndarray, central: Hits) -> tuple[np.ndarray, np.ndarray]:
    """Return, (h, w) each, how far rays through a pixel's corners (slopes ``corner``, (h + 1, w + 1, 2)) hit off the
    plane at its centre, and whether they show an edge or the edge of a shadow in the pixel."""
    (h, w), hits = slopes.shape[:2], cast(lit, corner.reshape(-1, 2))
    rays = np.concatenate([slopes, np.ones((h, w, 1))], axis=-1)
    normal = central.normal.reshape(h, w, 3).astype(float)
    middle_m, surface = central.range_m.reshape(h, w).astype(float), central.surface.reshape(h, w)
    height_m = middle_m * (normal * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
    bare = np.divide(hits.amplitude, hits.albedo, out=np.zeros(len(hits.albedo)), where=hits.albedo > 0)
    middle = np.divide(central.amplitude, central.albedo, out=np.zeros(h * w), where=central.albedo > 0).reshape(h, w)
    most, least, bend_m, edge = middle.copy(), middle.copy(), np.zeros((h, w)), np.zeros((h, w), bool)
    for at in ((down, across) for down in (slice(h), slice(1, None)) for across in (slice(w), slice(1, None))):
        range_m, light, other = (each.reshape(h + 1, w + 1)[at] for each in (hits.range_m, bare, hits.surface))
        x, y = corner[at][..., 0], corner[at][..., 1]
        length = np.sqrt(1 + x * x + y * y)
        with np.errstate(invalid="ignore", divide="ignore"):
            off_m = np.abs(range_m - height_m * length / (normal[..., 0] * x + normal[..., 1] * y + normal[..., 2]))
        bend_m = np.fmax(bend_m, off_m)
        edge |= other != surface
        most, least = np.maximum(most, light), np.minimum(least, light)
    return bend_m, edge | (bend_m > KINK_M) | (most - least > UNEVEN * most)
