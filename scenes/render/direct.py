"""The direct part of a view: emitter to surface to pixel, deterministic, fine where a footprint meets an edge.

A pixel's footprint, its area or the scanner's beam, is sampled by sub-rays of equal weight, whose phasors are summed.
Beside the sums stands what the indirect part needs of the same sub-rays: which of them end on the board's undamaged
face, and where the others go.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from scipy import ndimage
from scipy.special import ndtri

from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens
from harness.vocabulary.units import SPEED_OF_LIGHT_AIR
from scenes.optics import FWHM_PER_DEVIATION, BeamFootprint, PixelFootprint
from scenes.render.scene import LitScene

COARSE = 4
"""Sub-rays per side on a smooth surface: the midpoint rule leaves 1e-4 mm."""
FINE = 256
"""Sub-rays where a footprint meets an edge: one of them is 0.4 % of a step."""
FINEST = 2048
"""Sub-rays where that still leaves an error in a hole: a dark wall beside a strip of what lies behind."""
BEAM_REACH = 3.0
"""Standard deviations of a beam within which an edge is looked for: 1 % of the light lies beyond."""
GOLDEN = (np.sqrt(5) - 1) / 2
RAYS_AT_ONCE = 1 << 22
"""Sub-rays cast at once: 4 million take 0.6 GB."""
KINK_M = 2e-5
"""Sub-rays of one pixel that leave a plane by more have met an edge, such as that of a strip of tape."""
UNSURE_M = 1e-4
"""Pixels whose direct light may be wrong by more are divided once more."""
UNEVEN = 0.2
"""Relative spread of direct light in a footprint from which on a shadow's edge is taken to be in it."""
FAST: Any = {"cache": True, "fastmath": {"contract", "reassoc", "nsz"}, "nogil": True}
"""Options of compilation; sums are float64, whose order moves a range by 1e-14 m."""
COMB_TOLERANCE = 1e-9
"""Unevenness, relative to the highest frequency, up to which a comb is summed by a recurrence."""


def wave_numbers(frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """Return (f,) 2 pi f / c in rad per metre of full path, for the speed of light in air."""
    return 2 * np.pi * np.array(frequencies_hz, float) / SPEED_OF_LIGHT_AIR


def comb_step(frequencies_hz: tuple[float, ...]) -> float | None:
    """Return the spacing in Hz of four or more evenly spaced frequencies; None for other lists."""
    if len(frequencies_hz) < 4:
        return None
    steps = np.diff(frequencies_hz)
    even = np.abs(steps - steps.mean()).max() <= COMB_TOLERANCE * max(frequencies_hz)
    return float(steps.mean()) if even else None


def phasor_sums(amplitude: np.ndarray, path_m: np.ndarray, frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """Return the mean over sub-rays of a exp(i 2 pi f L / c): (f, n) complex128 from amplitudes and paths (n, m).

    A comb is summed by multiplying with the phasor of its spacing: rounding grows to 1e-14 over 100 lines.
    """
    waves = wave_numbers(frequencies_hz)
    out = np.empty((len(waves), len(path_m)), np.complex128)
    amplitude, path_m = np.ascontiguousarray(amplitude, float), np.ascontiguousarray(path_m, float)
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


def footprint_of(lens: Lens, region: Region, kind: PixelFootprint | BeamFootprint) -> Quadrilaterals | Beams:
    """Return the footprint of a region's pixels."""
    if isinstance(kind, BeamFootprint):
        return Beams(lens, region, kind.fwhm_rad / FWHM_PER_DEVIATION)
    return Quadrilaterals(lens, region)


class Quadrilaterals:
    """An imager's pixels: the area between a pixel's corners, evenly weighted.

    Fine sub-rays lie on a golden lattice: an edge along the rows or columns, such as a board's, moves past them one by
    one and not sixteen at a time.
    Inside a pixel the lens is linear to 1e-7 in slope (0.1 um at 1 m), so slopes are interpolated between its corners.
    """

    reach_px = 1
    """Pixels around an edge that have a part of it in their footprint, besides the edge's own."""

    def __init__(self, lens: Lens, region: Region) -> None:
        v, u = np.mgrid[region.row0 : region.row1 + 1, region.col0 : region.col1 + 1] - 0.5
        self._corner = lens.slopes(u, v)

    def coarse(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        """Return slopes (n, COARSE^2, 2) of pixels by row and column of the region, a grid by rows."""
        return self.strata(rows, cols, COARSE)

    def fine(self, rows: np.ndarray, cols: np.ndarray, count: int = FINE) -> np.ndarray:
        """Return slopes (n, count, 2) of sub-rays where a footprint meets an edge."""
        number = np.arange(count) + 0.5
        return self._placed(rows, cols, number / count, (number * GOLDEN) % 1)

    def strata(self, rows: np.ndarray, cols: np.ndarray, side: int) -> np.ndarray:
        """Return slopes (n, side^2, 2) of the centres of side x side strata."""
        place = (np.arange(side) + 0.5) / side
        fy, fx = np.meshgrid(place, place, indexing="ij")
        return self._placed(rows, cols, fx.ravel(), fy.ravel())

    def _placed(self, rows: np.ndarray, cols: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Return slopes (n, m, 2) at fractions (m,) of pixels' widths and heights."""
        fx, fy, corner = fx[None, :, None], fy[None, :, None], self._corner
        c00, c01 = corner[rows, cols][:, None], corner[rows, cols + 1][:, None]
        c10, c11 = corner[rows + 1, cols][:, None], corner[rows + 1, cols + 1][:, None]
        return np.asarray((1 - fy) * ((1 - fx) * c00 + fx * c01) + fy * ((1 - fx) * c10 + fx * c11))


class Beams:
    """A scanner's beams: round Gaussians in angle about the pixels' central rays, cut nowhere.

    Fine sub-rays lie on a sunflower's spiral (Vogel, Mathematical Biosciences 44, 1979) at the radii of equal shares,
    so that a knife edge in any direction takes its share of the Gaussian within 0.02. The coarse grid has the
    Gaussian's second moments. Angles are taken as tangents: 1e-6 of themselves for milliradians.
    """

    def __init__(self, lens: Lens, region: Region, deviation_rad: float) -> None:
        self._slopes = lens.region_slopes(region)
        # Away from the axis an angle spans more slope, and so more pixels, by 1 + slope^2.
        widest = 1 + float((self._slopes**2).sum(axis=-1).max())
        self.reach_px = 1 + int(np.ceil(BEAM_REACH * deviation_rad * widest * max(lens.fx, lens.fy)))
        place = (np.arange(COARSE) + 0.5) / COARSE
        quantile = ndtri(place)
        quantile /= np.sqrt((quantile**2).mean())
        y, x = np.meshgrid(quantile, quantile, indexing="ij")
        self._deviation_rad = deviation_rad
        self._coarse = deviation_rad * np.column_stack([x.ravel(), y.ravel()])

    def coarse(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        """See `Quadrilaterals`."""
        return self._turned(rows, cols, self._coarse)

    def fine(self, rows: np.ndarray, cols: np.ndarray, count: int = FINE) -> np.ndarray:
        """Return slopes (n, count, 2) of sub-rays where a footprint meets an edge."""
        number = np.arange(count) + 0.5
        radius = self._deviation_rad * np.sqrt(-2 * np.log1p(-number / count))
        angle = np.pi * (3 - np.sqrt(5)) * number
        spiral = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return self._turned(rows, cols, spiral - spiral.mean(axis=0))

    def _turned(self, rows: np.ndarray, cols: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Return slopes (n, m, 2) of directions off the central ones by angles (m, 2) across the beam."""
        centre = np.concatenate([self._slopes[rows, cols], np.ones((len(rows), 1))], axis=-1)
        centre /= np.linalg.norm(centre, axis=-1, keepdims=True)
        across = np.cross([0.0, 1.0, 0.0], centre)
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
        down = np.cross(centre, across)
        x, y, z = (
            centre[:, k, None] + across[:, k, None] * angles[:, 0] + down[:, k, None] * angles[:, 1] for k in range(3)
        )
        return np.stack([x / z, y / z], axis=-1)


@dataclass(frozen=True)
class Hits:
    """Hits of n rays from the lens: true range, path out and back, amplitude of direct light, albedo, surface, texture
    place, and whether it is the board's undamaged face.

    Arrays are (n,); ``range_m`` is NaN where a ray met nothing and ``surface`` is -1 there.
    """

    range_m: np.ndarray
    path_m: np.ndarray
    amplitude: np.ndarray
    albedo: np.ndarray
    surface: np.ndarray
    uv: np.ndarray
    on_face: np.ndarray


@dataclass(frozen=True)
class OffFace:
    """Sub-rays that met something other than the undamaged face, by pixel.

    ``pixel`` (p,): flat indices of pixels that have any, ``count`` (p,): how many, ``share`` (p,): of the footprint;
    ``slopes`` (sum of count, 2) float32, pixel by pixel.
    """

    pixel: np.ndarray
    count: np.ndarray
    share: np.ndarray
    slopes: np.ndarray

    def chosen(self, here: np.ndarray) -> OffFace:
        """Return those of the pixels picked by a mask (p,)."""
        return OffFace(self.pixel[here], self.count[here], self.share[here], self.slopes[np.repeat(here, self.count)])


@dataclass(frozen=True)
class DirectLight:
    """The direct part on a region, (h, w): phasor (f, h, w), intensity, the central ray's range, surface and texture
    place, the share of the footprint on that surface, and which pixels were finely divided.

    ``face`` (f + 1, h, w): mean over a pixel's sub-rays on the undamaged face of albedo x exp(i 2 pi f range / c),
    frequency 0 last; ``face_range_m`` (h, w): their mean range, 0 where there are none.
    ``off_face``: the other sub-rays that met something.
    """

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
    import drjit as dr

    mi = lit.mi
    direction = mi.Vector3f(mi.Float(slopes[:, 0].astype(np.float32)), mi.Float(slopes[:, 1].astype(np.float32)), 1.0)
    length = dr.norm(direction)
    ray = mi.Ray3f(mi.Point3f(0.0), direction / length)
    hit = lit.scene.ray_intersect(ray)
    valid = hit.is_valid()
    arriving, leg = lit.arriving(hit, valid)
    albedo = dr.select(valid, hit.bsdf().eval_diffuse_reflectance(hit, valid)[0], 0)
    surface = lit.surface_index(hit)
    amplitude = albedo * arriving
    on_face = valid & lit.on_face(hit, valid)
    dr.eval(hit.t, leg, amplitude, albedo, surface, valid, hit.uv, on_face)
    ok = valid.numpy()
    range_m = np.where(ok, hit.t.numpy().astype(float), np.nan)
    return Hits(
        range_m=range_m,
        path_m=np.where(ok, range_m + leg.numpy(), 0.0),
        amplitude=amplitude.numpy().astype(float),
        albedo=albedo.numpy().astype(float),
        surface=np.where(ok, surface.numpy().astype(np.int64), -1).astype(np.int16),
        uv=hit.uv.numpy().T,
        on_face=on_face.numpy(),
    )


def direct_light(
    lit: LitScene,
    slopes: np.ndarray,
    footprint: Quadrilaterals | Beams,
    frequencies_hz: tuple[float, ...],
    closely: np.ndarray | None = None,
) -> DirectLight:
    """Return direct light on every pixel of a region with central rays ``slopes`` (h, w, 2), finely divided where a
    footprint meets an edge or a shadow's edge, and once more where that leaves an error in the pixels ``closely`` (h,
    w)."""
    h, w = slopes.shape[:2]
    rows, cols = np.divmod(np.arange(h * w), w)
    central = cast(lit, slopes.reshape(-1, 2))
    sums = _FootprintSums(lit, frequencies_hz, central.surface)
    flagged = np.zeros(h * w, bool)
    for here in _chunks(np.arange(h * w), COARSE**2):
        amplitude, range_m, _ = sums.add(here, footprint.coarse(rows[here], cols[here]))
        flagged[here] = _edges(amplitude, range_m) | (sums.coverage[here] < 1)
    reach = 2 * footprint.reach_px + 1
    fine = ndimage.binary_dilation(flagged.reshape(h, w), np.ones((reach, reach), bool)).ravel()
    unsure = np.zeros(h * w, bool)
    for here in _chunks(np.flatnonzero(fine), FINE):
        amplitude, _, path_m = sums.add(here, footprint.fine(rows[here], cols[here]))
        unsure[here] = _error_m(amplitude, path_m) > UNSURE_M
    unsure &= False if closely is None else closely.ravel()
    for here in _chunks(np.flatnonzero(unsure), FINEST):
        sums.add(here, footprint.fine(rows[here], cols[here], FINEST))
    return DirectLight(
        phasor=sums.phasor.reshape(-1, h, w),
        intensity=sums.intensity.reshape(h, w),
        range_m=central.range_m.reshape(h, w),
        surface=central.surface.reshape(h, w),
        uv=central.uv.reshape(h, w, 2),
        coverage=sums.coverage.reshape(h, w).astype(np.float32),
        fine=fine.reshape(h, w),
        face=sums.face.reshape(-1, h, w),
        face_range_m=sums.face_range_m.reshape(h, w),
        off_face=sums.off_face(),
    )


def _chunks(pixels: np.ndarray, per_pixel: int) -> list[np.ndarray]:
    at_once = RAYS_AT_ONCE // per_pixel
    return [pixels[begin : begin + at_once] for begin in range(0, len(pixels), at_once)]


class _FootprintSums:
    """Sums over the sub-rays of n pixels; a pixel that is added again replaces what was there."""

    def __init__(self, lit: LitScene, frequencies_hz: tuple[float, ...], central_surface: np.ndarray) -> None:
        n, lines = len(central_surface), len(frequencies_hz)
        self._lit, self._frequencies, self._central = lit, frequencies_hz, central_surface
        self.phasor = np.zeros((lines, n), complex)
        self.face = np.zeros((lines + 1, n), complex)
        self.intensity, self.coverage, self.face_range_m = np.zeros(n), np.zeros(n), np.zeros(n)
        self._count, self._per_pixel = np.zeros(n, np.int64), np.ones(n, np.int64)
        self._order: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, pixels: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cast the pixels' sub-rays (n, m, 2); returns their amplitudes, ranges and paths (n, m)."""
        n, m = slopes.shape[:2]
        hits = cast(self._lit, slopes.reshape(-1, 2))
        amplitude, range_m = hits.amplitude.reshape(n, m), hits.range_m.reshape(n, m)
        surface = hits.surface.reshape(n, m)
        path_m = hits.path_m.reshape(n, m)
        self.phasor[:, pixels] = phasor_sums(amplitude, path_m, self._frequencies)
        self.intensity[pixels] = amplitude.mean(axis=1)
        self.coverage[pixels] = (surface == self._central[pixels, None]).mean(axis=1)
        face = hits.on_face.reshape(n, m)
        some = face.any(axis=1)
        albedo = np.where(face[some], hits.albedo.reshape(n, m)[some], 0.0)
        to_face = np.where(face[some], range_m[some], 0.0)
        chosen, without = pixels[some], pixels[~some]
        self.face[:, without], self.face_range_m[without] = 0, 0
        self.face[:-1, chosen] = phasor_sums(albedo, to_face, self._frequencies)
        self.face[-1, chosen] = albedo.mean(axis=1)
        self.face_range_m[chosen] = to_face.sum(axis=1) / face[some].sum(axis=1)
        off = ~face & (surface >= 0)
        self._order.append((pixels, off.sum(axis=1), slopes[off].astype(np.float32)))
        self._per_pixel[pixels] = m
        return amplitude, range_m, path_m

    def off_face(self) -> OffFace:
        """Return the sub-rays off the face of the last division of each pixel."""
        pixel, count, slopes = [], [], []
        seen = np.zeros(len(self._central), bool)
        for pixels, counts, rays in reversed(self._order):
            new = ~seen[pixels] & (counts > 0)
            seen[pixels] = True
            pixel.append(pixels[new])
            count.append(counts[new])
            slopes.append(rays[np.repeat(new, counts)])
        where, counts = np.concatenate(pixel), np.concatenate(count)
        return OffFace(where, counts, counts / self._per_pixel[where], np.concatenate(slopes))


def _edges(amplitude: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """Find pixels (n,) bool whose sub-rays (n, COARSE^2) differ in light, or leave a plane."""
    uneven = amplitude.max(axis=1) - amplitude.min(axis=1) > UNEVEN * amplitude.max(axis=1)
    # Sub-rays of a smooth surface lie on a plane: the sum of opposite corners equals that of the centre's two.
    grid = range_m.reshape(-1, COARSE, COARSE)
    with np.errstate(invalid="ignore"):
        bend = np.abs(grid[:, 0, 0] + grid[:, -1, -1] - grid[:, 0, -1] - grid[:, -1, 0])
        bend = np.maximum(bend, np.abs(grid[:, 0, 0] + grid[:, -1, -1] - grid[:, 1, 1] - grid[:, 2, 2]))
    return np.asarray(uneven | ~(bend < KINK_M))


def _error_m(amplitude: np.ndarray, path_m: np.ndarray) -> np.ndarray:
    """Return (n,) the error of range that m sub-rays (n, m) of a pixel leave, about.

    An edge is misplaced by one sub-ray or two of m, so the mean path by the paths' spread over m and, where few
    sub-rays carry light, more: 3 spread / (2 m sqrt(lit share)) was seen on holes of 1/16 to 1 in before a backing.
    """
    light = np.maximum(amplitude.sum(axis=1), 1e-30)
    mean = (amplitude * path_m).sum(axis=1) / light
    spread = np.sqrt((amplitude * (path_m - mean[:, None]) ** 2).sum(axis=1) / light)
    strongest = np.maximum(amplitude.max(axis=1), 1e-30)
    lit_share = np.maximum(amplitude.mean(axis=1) / strongest, 1 / amplitude.shape[1])
    return np.asarray(1.5 * spread / (amplitude.shape[1] * np.sqrt(lit_share)))


def surface_rgb(parts: Any, surface: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return colour albedo (h, w, 3) float32 in 0..1 at the central rays, 0 where they meet nothing."""
    rgb = np.zeros((*surface.shape, 3), np.float32)
    for index, part in enumerate(parts):
        here = surface == index
        if here.any():
            rgb[here] = part.rgb_at(uv[here])
    return rgb
