"""The direct part of a view: light from emitter to surface to pixel, deterministic, with fine sampling at edges."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from scipy import ndimage

from scenes.optics import COARSE, FINE, Quadrilaterals, wave_numbers
from scenes.render.scene import LitScene, on_device

FINEST = 2048  # sub-rays where fewer leave an error in a hole: a dark wall beside a strip of what lies behind it
RAYS_AT_ONCE = 1 << 22  # sub-rays cast at once: 4 million need 0.6 GB
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


def phasor_sums(amplitude: np.ndarray, path_m: np.ndarray, frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """Return the mean over sub-rays of a exp(i 2 pi f L / c), (f, n) complex128, from amplitudes and paths (n, m). For
    a comb, each phasor is the previous one times that of the spacing; rounding grows to 1e-14 over 100 lines."""
    waves = wave_numbers(frequencies_hz)
    out = np.empty((len(waves), len(path_m)), np.complex128)
    amplitude, path_m = np.ascontiguousarray(amplitude), np.ascontiguousarray(path_m)
    step = comb_step(frequencies_hz)
    if step is None:
        _sum_list(amplitude, path_m, waves, out)
    else:
        _sum_comb(amplitude, path_m, float(waves[0]), float(wave_numbers((step,))[0]), out)
    return out


@numba.njit(**FAST)
def _sum_list(amplitude: np.ndarray, path_m: np.ndarray, waves: np.ndarray, out: np.ndarray) -> None:
    n, m = path_m.shape
    for i in range(n):
        for k in range(waves.size):
            re = im = 0.0
            for j in range(m):
                phase = waves[k] * path_m[i, j]
                re += amplitude[i, j] * np.cos(phase)
                im += amplitude[i, j] * np.sin(phase)
            out[k, i] = complex(re / m, im / m)


@numba.njit(**FAST)
def _sum_comb(amplitude: np.ndarray, path_m: np.ndarray, first: float, step: float, out: np.ndarray) -> None:
    n, m = path_m.shape
    re, im, cosine, sine = np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    for i in range(n):
        for j in range(m):
            re[j] = amplitude[i, j] * np.cos(first * path_m[i, j])
            im[j] = amplitude[i, j] * np.sin(first * path_m[i, j])
            cosine[j], sine[j] = np.cos(step * path_m[i, j]), np.sin(step * path_m[i, j])
        for k in range(out.shape[0]):
            sum_re = sum_im = 0.0
            for j in range(m):
                sum_re += re[j]
                sum_im += im[j]
                turned = re[j] * cosine[j] - im[j] * sine[j]
                im[j] = re[j] * sine[j] + im[j] * cosine[j]
                re[j] = turned
            out[k, i] = complex(sum_re / m, sum_im / m)


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
    ``counts`` (p,): their number, ``share`` (p,): of the footprint; ``slopes`` (sum of counts, 2) float32, by pixel."""

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


@numba.njit(**FAST)
def _even_moments(  # type: ignore[no-untyped-def]
    slopes, centre, normal, emitter, albedo, texture, uv_of, to_light, to_face
):
    """Sum a pixel's light over sub-rays ``slopes`` (n, m, 2) on the plane of its ``centre`` and ``normal`` (n, 3). The
    moments (4, n) have orders 0 to 3: of amplitude (1 at the centre, times the albedo) about the centre's path, and of
    the albedo about its range. ``albedo`` (n,): negative where ``texture`` gives it."""
    rows, columns = texture.shape
    n, m, _ = slopes.shape
    for i in range(n):
        x0, y0, z0 = centre[i]
        nx, ny, nz = normal[i]
        height = nx * x0 + ny * y0 + nz * z0
        ex, ey, ez = emitter[0] - x0, emitter[1] - y0, emitter[2] - z0
        leg0 = np.sqrt(ex * ex + ey * ey + ez * ez)
        range0 = np.sqrt(x0 * x0 + y0 * y0 + z0 * z0)
        facing0 = (nx * ex + ny * ey + nz * ez) / leg0**3
        for j in range(m):
            z = height / (nx * slopes[i, j, 0] + ny * slopes[i, j, 1] + nz)
            x, y = slopes[i, j, 0] * z, slopes[i, j, 1] * z
            range_m = np.sqrt(x * x + y * y + z * z)
            dx, dy, dz = emitter[0] - x, emitter[1] - y, emitter[2] - z
            leg = np.sqrt(dx * dx + dy * dy + dz * dz)
            a = albedo[i]
            if a < 0.0:
                u = uv_of[0, 0] * x + uv_of[0, 1] * y + uv_of[0, 2] * z + uv_of[0, 3]
                v = uv_of[1, 0] * x + uv_of[1, 1] * y + uv_of[1, 2] * z + uv_of[1, 3]
                across = min(max(u * columns - 0.5, 0.0), columns - 1.0)
                down = min(max(v * rows - 0.5, 0.0), rows - 1.0)
                c, r = min(int(across), columns - 2), min(int(down), rows - 2)
                p, q = across - c, down - r
                above = (1.0 - p) * texture[r, c] + p * texture[r, c + 1]
                a = (1.0 - q) * above + q * ((1.0 - p) * texture[r + 1, c] + p * texture[r + 1, c + 1])
            light = a * (nx * dx + ny * dy + nz * dz) / leg**3 / facing0 if facing0 > 0.0 else 0.0
            longer, farther = range_m + leg - range0 - leg0, range_m - range0
            for order in range(4):
                to_light[order, i] += light / m
                to_face[order, i] += a / m
                light *= longer
                a *= farther


def _of_moments(moments: np.ndarray, about_m: np.ndarray, frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """Return phasors (f, n) from moments (4, n) of lengths about ``about_m`` (n,): a series, 1e-6 off at 0.07 rad."""
    waves = wave_numbers(frequencies_hz)[:, None]
    zeroth, first, second, third = moments
    series = zeroth - waves**2 * second / 2 + 1j * (waves * first - waves**3 * third / 6)
    return np.asarray(series * np.exp(1j * waves * about_m))


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
        lit, central, frequencies = self.lit, self.central, self.frequencies_hz
        rays, range_m = self.footprint.coarse(self.rows[here], self.cols[here]), central.range_m[here].astype(float)
        ray = np.column_stack([self.slopes[here], np.ones(len(here))])
        centre = ray * (range_m / np.linalg.norm(ray, axis=1))[:, None]
        albedo, to_light, to_face = central.albedo[here].astype(float), *np.zeros((2, 4, len(here)))
        plain = np.where(central.surface[here] == lit.textured, -1.0, albedo)
        texture = np.zeros((2, 2), np.float32) if lit.texture is None else lit.parts[lit.textured].texture_850
        normal = central.normal[here].astype(float)
        _even_moments(rays, centre, normal, lit.emitter_m, plain, texture, lit.uv_of, to_light, to_face)
        to_light *= np.divide(central.amplitude[here], albedo, out=np.zeros(len(here)), where=albedo > 0)
        self.phasor[:, here] = _of_moments(to_light, central.path_m[here].astype(float), frequencies)
        self.intensity[here] = to_light[0]
        on = central.on_face[here]
        self.face[:-1, here[on]] = _of_moments(to_face[:, on], range_m[on], frequencies)
        self.face[-1, here[on]], self.face_range_m[here[on]] = to_face[0, on], range_m[on]
        self._keep_off_face(here[~on], np.ones((int((~on).sum()), rays.shape[1]), bool), rays[~on])

    def add_rays(self, here: np.ndarray, rays: np.ndarray, again: np.ndarray | None = None) -> np.ndarray:
        """Add the light of sub-rays (n, m, 2) of pixels. Return those of ``again`` (h w,) that need finer sampling."""
        m = rays.shape[1]
        hits = cast(self.lit, rays.reshape(-1, 2))
        range_m, path_m, amplitude, albedo, surface = (each.reshape(-1, m) for each in hits[:5])
        on_face = hits.on_face.reshape(-1, m)
        self.phasor[:, here] = phasor_sums(amplitude, path_m, self.frequencies_hz)
        self.intensity[here] = amplitude.mean(axis=1, dtype=float)
        self.coverage[here] = (surface == self.central.surface[here, None]).mean(axis=1)
        some = on_face.any(axis=1)
        chosen = here[some]
        lit_albedo, to_face = (np.where(on_face[some], each[some], 0.0) for each in (albedo, range_m))
        self.face[:, here], self.face_range_m[here] = 0, 0
        self.face[:-1, chosen] = phasor_sums(lit_albedo, to_face, self.frequencies_hz)
        self.face[-1, chosen] = lit_albedo.mean(axis=1)
        self.face_range_m[chosen] = to_face.sum(axis=1) / on_face[some].sum(axis=1)
        unsure = np.zeros(len(here), bool)
        if again is not None:
            unsure = again[here]
            unsure[unsure] = _error_m(amplitude[unsure], path_m[unsure]) > UNSURE_M
        self._keep_off_face(here[~unsure], (~on_face & (surface >= 0))[~unsure], rays[~unsure])
        return here[unsure]

    def _keep_off_face(self, here: np.ndarray, off: np.ndarray, rays: np.ndarray) -> None:
        counts, (row, column) = off.sum(axis=1), np.nonzero(off)
        some, kept = counts > 0, np.stack([rays[row, column, k].astype(np.float32) for k in (0, 1)], axis=1)
        self.off_face.append(OffFace(here[some], counts[some], counts[some] / off.shape[1], kept))


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
    sub-rays: a few on a curved surface, many where the footprint meets an edge or the edge of a shadow and in the
    pixels ``closely`` (h, w), where more follow if that leaves an error; a few at edges in the pixels ``roughly``."""
    shape, sums = slopes.shape[:2], _Sums(lit, slopes, footprint, frequencies_hz)
    central, rows, cols = sums.central, sums.rows, sums.cols
    bend_m, edge = _corners(lit, footprint.corner, slopes, central)
    edge |= False if closely is None else closely
    reach = 2 * footprint.reach_px + 1
    edge = ndimage.binary_dilation(edge, np.ones((reach, reach), bool))
    fine = edge if roughly is None else edge & ~roughly
    rest, bent = ~fine.ravel(), ((bend_m > BENT_M) | edge).ravel()
    sums.add_plane(np.flatnonzero(rest & ~bent & (central.surface >= 0)))
    for here in _chunks(np.flatnonzero(rest & bent), COARSE**2):
        sums.add_rays(here, footprint.coarse(rows[here], cols[here]))
    again = None if closely is None else closely.ravel()
    edges = _chunks(np.flatnonzero(fine), FINE)
    unsure = [sums.add_rays(here, footprint.fine(rows[here], cols[here]), again) for here in edges]
    for here in _chunks(np.concatenate([np.zeros(0, int), *unsure]), FINEST):
        sums.add_rays(here, footprint.fine(rows[here], cols[here], FINEST))
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


def _error_m(amplitude: np.ndarray, path_m: np.ndarray) -> np.ndarray:
    """Return the approximate error of range (n,) that m sub-rays (n, m) of a pixel leave: an edge is misplaced by one
    or two of m sub-rays. Holes of 1/16 to 1 in before a backing showed 3 spread / (2 m sqrt(lit share))."""
    light = np.maximum(amplitude.sum(axis=1), 1e-30)
    mean = (amplitude * path_m).sum(axis=1) / light
    spread = np.sqrt((amplitude * (path_m - mean[:, None]) ** 2).sum(axis=1) / light)
    strongest = np.maximum(amplitude.max(axis=1), 1e-30)
    lit_share = np.maximum(amplitude.mean(axis=1) / strongest, 1 / amplitude.shape[1])
    return np.asarray(1.5 * spread / (amplitude.shape[1] * np.sqrt(lit_share)))
