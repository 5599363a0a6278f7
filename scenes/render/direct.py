"""The direct part of a view: emitter to surface to pixel, deterministic, fine where a footprint meets an edge.
Sub-rays of a footprint have equal weight; beside their sums stands what the indirect part needs of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from scipy import ndimage

from scenes.optics import COARSE, FINE, Beams, Quadrilaterals, wave_numbers
from scenes.render.scene import LitScene

FINEST = 2048
"""Sub-rays where that still leaves an error in a hole: a dark wall beside a strip of what lies behind."""
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


def comb_step(frequencies_hz: tuple[float, ...]) -> float | None:
    """Return the spacing in Hz of four or more evenly spaced frequencies; None for other lists."""
    if len(frequencies_hz) < 4:
        return None
    steps = np.diff(frequencies_hz)
    even = np.abs(steps - steps.mean()).max() <= COMB_TOLERANCE * max(frequencies_hz)
    return float(steps.mean()) if even else None


def phasor_sums(amplitude: np.ndarray, path_m: np.ndarray, frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """Return the mean over sub-rays of a exp(i 2 pi f L / c): (f, n) complex128 from amplitudes and paths (n, m). A
    comb is summed by multiplying with the phasor of its spacing: rounding grows to 1e-14 over 100 lines."""
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


@dataclass(frozen=True)
class Hits:
    """Hits of n rays from the lens: true range (NaN where a ray met nothing), path out and back, amplitude of direct
    light, albedo, surface (-1 for nothing), texture place (n, 2), and whether it is the board's undamaged face."""

    range_m: np.ndarray
    path_m: np.ndarray
    amplitude: np.ndarray
    albedo: np.ndarray
    surface: np.ndarray
    uv: np.ndarray
    on_face: np.ndarray


@dataclass(frozen=True)
class OffFace:
    """Sub-rays that met something other than the undamaged face, by pixel. ``pixel`` (p,): flat indices of pixels that
    have any, ``count`` (p,): how many, ``share`` (p,): of the footprint; ``slopes`` (sum of count, 2) float32, pixel by
    pixel."""

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
    place, the share of the footprint on that surface, and which pixels were finely divided. ``face`` (f + 1, h, w):
    mean over a pixel's sub-rays on the undamaged face of albedo x exp(i 2 pi f range / c), frequency 0 last;
    ``face_range_m`` (h, w): their mean range, 0 where there are none. ``off_face``: the other sub-rays that met
    something."""

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
    hit = lit.scene.ray_intersect(mi.Ray3f(mi.Point3f(0.0), direction / dr.norm(direction)))
    valid = hit.is_valid()
    arriving, leg = lit.arriving(hit, valid)
    albedo = dr.select(valid, hit.bsdf().eval_diffuse_reflectance(hit, valid)[0], 0)
    surface, amplitude = lit.surface_index(hit), albedo * arriving
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
    footprint meets an edge or a shadow's edge, and once more where that leaves an error in the pixels ``closely``
    (h, w). A pixel that is divided again replaces what was there."""
    (h, w), lines = slopes.shape[:2], len(frequencies_hz)
    n = h * w
    rows, cols = np.divmod(np.arange(n), w)
    central = cast(lit, slopes.reshape(-1, 2))
    phasor, face = np.zeros((lines, n), complex), np.zeros((lines + 1, n), complex)
    intensity, coverage, face_range_m = np.zeros(n), np.zeros(n), np.zeros(n)
    flagged, unsure, seen = np.zeros(n, bool), np.zeros(n, bool), np.zeros(n, bool)
    passes: list[tuple[np.ndarray, np.ndarray, int, np.ndarray]] = []

    def add(here: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cast sub-rays (n, m, 2) of pixels; returns their amplitudes, ranges and paths (n, m)."""
        m = rays.shape[1]
        hits = cast(lit, rays.reshape(-1, 2))
        amplitude, range_m, path_m, surface, albedo, on_face = (
            each.reshape(-1, m)
            for each in (hits.amplitude, hits.range_m, hits.path_m, hits.surface, hits.albedo, hits.on_face)
        )
        phasor[:, here] = phasor_sums(amplitude, path_m, frequencies_hz)
        intensity[here] = amplitude.mean(axis=1)
        coverage[here] = (surface == central.surface[here, None]).mean(axis=1)
        some = on_face.any(axis=1)
        chosen, without = here[some], here[~some]
        lit_albedo, to_face = (np.where(on_face[some], each[some], 0.0) for each in (albedo, range_m))
        face[:, without], face_range_m[without] = 0, 0
        face[:-1, chosen], face[-1, chosen] = phasor_sums(lit_albedo, to_face, frequencies_hz), lit_albedo.mean(axis=1)
        face_range_m[chosen] = to_face.sum(axis=1) / on_face[some].sum(axis=1)
        off = ~on_face & (surface >= 0)
        passes.append((here, off.sum(axis=1), m, rays[off].astype(np.float32)))
        return amplitude, range_m, path_m

    for here in _chunks(np.arange(n), COARSE**2):
        amplitude, range_m, _ = add(here, footprint.coarse(rows[here], cols[here]))
        flagged[here] = _edges(amplitude, range_m) | (coverage[here] < 1)
    reach = 2 * footprint.reach_px + 1
    fine = ndimage.binary_dilation(flagged.reshape(h, w), np.ones((reach, reach), bool)).ravel()
    for here in _chunks(np.flatnonzero(fine), FINE):
        amplitude, _, path_m = add(here, footprint.fine(rows[here], cols[here]))
        unsure[here] = _error_m(amplitude, path_m) > UNSURE_M
    unsure &= False if closely is None else closely.ravel()
    for here in _chunks(np.flatnonzero(unsure), FINEST):
        add(here, footprint.fine(rows[here], cols[here], FINEST))
    # the sub-rays off the face of the last division of each pixel
    off_face = []
    for here, counts, m, rays in reversed(passes):
        new = ~seen[here] & (counts > 0)
        seen[here] = True
        off_face.append((here[new], counts[new], counts[new] / m, rays[np.repeat(new, counts)]))
    return DirectLight(
        phasor=phasor.reshape(-1, h, w),
        intensity=intensity.reshape(h, w),
        range_m=central.range_m.reshape(h, w),
        surface=central.surface.reshape(h, w),
        uv=central.uv.reshape(h, w, 2),
        coverage=coverage.reshape(h, w).astype(np.float32),
        fine=fine.reshape(h, w),
        face=face.reshape(-1, h, w),
        face_range_m=face_range_m.reshape(h, w),
        off_face=OffFace(*(np.concatenate(each) for each in zip(*off_face, strict=True))),
    )


def _chunks(pixels: np.ndarray, per_pixel: int) -> list[np.ndarray]:
    at_once = RAYS_AT_ONCE // per_pixel
    return [pixels[begin : begin + at_once] for begin in range(0, len(pixels), at_once)]


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
    """Return (n,) the error of range that m sub-rays (n, m) of a pixel leave, about. An edge is misplaced by one
    sub-ray or two of m, so the mean path by the paths' spread over m and, where few sub-rays carry light, more: 3
    spread / (2 m sqrt(lit share)) was seen on holes of 1/16 to 1 in before a backing."""
    light = np.maximum(amplitude.sum(axis=1), 1e-30)
    mean = (amplitude * path_m).sum(axis=1) / light
    spread = np.sqrt((amplitude * (path_m - mean[:, None]) ** 2).sum(axis=1) / light)
    strongest = np.maximum(amplitude.max(axis=1), 1e-30)
    lit_share = np.maximum(amplitude.mean(axis=1) / strongest, 1 / amplitude.shape[1])
    return np.asarray(1.5 * spread / (amplitude.shape[1] * np.sqrt(lit_share)))
