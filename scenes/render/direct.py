"""The direct part of a view: emitter to surface to pixel, deterministic, fine where a footprint meets an edge.

Beside it stands what the indirect part needs of the same sub-rays: which of them end on the board's undamaged face, and
where the others go.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from scenes.render.footprint import COARSE, FINE, FINEST, Footprint
from scenes.render.phasors import phasor_sums
from scenes.render.scene import LitScene

RAYS_AT_ONCE = 1 << 22
"""Sub-rays cast at once: 4 million take 0.6 GB."""
KINK_M = 2e-5
"""Sub-rays of one pixel that leave a plane by more have met an edge, such as that of a strip of tape."""
UNSURE_M = 1e-4
"""Pixels whose direct light may be wrong by more are divided once more."""
UNEVEN = 0.2
"""Relative spread of direct light in a footprint from which on a shadow's edge is taken to be in it."""


@dataclass(frozen=True)
class Hits:
    """What n rays from the lens met: true range, path out and back, amplitude of direct light, albedo, surface, texture
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
        """Those of the pixels picked by a mask (p,)."""
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
    footprint: Footprint,
    frequencies_hz: tuple[float, ...],
    closely: np.ndarray | None = None,
) -> DirectLight:
    """Direct light on every pixel of a region with central rays ``slopes`` (h, w, 2), finely divided where a footprint
    meets an edge or a shadow's edge, and once more where that leaves an error in the pixels ``closely`` (h, w)."""
    h, w = slopes.shape[:2]
    rows, cols = np.divmod(np.arange(h * w), w)
    central = cast(lit, slopes.reshape(-1, 2))
    sums = _Sums(lit, frequencies_hz, central.surface)
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


class _Sums:
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
        """The sub-rays off the face of the last division of each pixel."""
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
    """(n,) bool: pixels whose sub-rays (n, COARSE^2) differ in light, or leave a plane."""
    uneven = amplitude.max(axis=1) - amplitude.min(axis=1) > UNEVEN * amplitude.max(axis=1)
    # Sub-rays of a smooth surface lie on a plane: the sum of opposite corners equals that of the centre's two.
    grid = range_m.reshape(-1, COARSE, COARSE)
    with np.errstate(invalid="ignore"):
        bend = np.abs(grid[:, 0, 0] + grid[:, -1, -1] - grid[:, 0, -1] - grid[:, -1, 0])
        bend = np.maximum(bend, np.abs(grid[:, 0, 0] + grid[:, -1, -1] - grid[:, 1, 1] - grid[:, 2, 2]))
    return np.asarray(uneven | ~(bend < KINK_M))


def _error_m(amplitude: np.ndarray, path_m: np.ndarray) -> np.ndarray:
    """(n,) error of range that m sub-rays (n, m) of a pixel leave, about.

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
    """Colour albedo (h, w, 3) float32 in 0..1 at the central rays, 0 where they meet nothing."""
    rgb = np.zeros((*surface.shape, 3), np.float32)
    for index, part in enumerate(parts):
        here = surface == index
        if here.any():
            rgb[here] = part.rgb_at(uv[here])
    return rgb
