"""The direct part of a view: emitter to surface to pixel, deterministic, stratified inside each pixel's footprint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens
from harness.vocabulary.units import SPEED_OF_LIGHT_AIR
from scenes.render.scene import LitScene

COARSE = 4
"""Strata per side in every pixel: on a smooth surface the midpoint rule leaves 1e-4 mm."""
FINE = 16
"""Strata per side where a footprint meets an edge: one of 256 sub-rays is 0.4 % of a step."""


KINK_M = 2e-5
"""Sub-rays of one pixel that leave a plane by more have met an edge, such as that of a strip of tape."""


@dataclass(frozen=True)
class Hits:
    """What n rays from the lens met: true range, path out and back, amplitude of direct light, surface, texture place.

    Arrays are (n,); ``range_m`` is NaN where a ray met nothing and ``surface`` is -1 there.
    """

    range_m: np.ndarray
    path_m: np.ndarray
    amplitude: np.ndarray
    surface: np.ndarray
    uv: np.ndarray


@dataclass(frozen=True)
class DirectLight:
    """The direct part on a region, (h, w): phasor (f, h, w), intensity, the central ray's range, surface and texture
    place, the share of the footprint on that surface, and which pixels were finely divided."""

    phasor: np.ndarray
    intensity: np.ndarray
    range_m: np.ndarray
    surface: np.ndarray
    uv: np.ndarray
    coverage: np.ndarray
    fine: np.ndarray


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
    albedo = hit.bsdf().eval_diffuse_reflectance(hit, valid)[0]
    surface = lit.surface_index(hit)
    amplitude = dr.select(valid, albedo * arriving, 0)
    dr.eval(hit.t, leg, amplitude, surface, valid, hit.uv)
    ok = valid.numpy()
    range_m = np.where(ok, hit.t.numpy().astype(float), np.nan)
    return Hits(
        range_m=range_m,
        path_m=np.where(ok, range_m + leg.numpy(), 0.0),
        amplitude=amplitude.numpy().astype(float),
        surface=np.where(ok, surface.numpy().astype(np.int64), -1).astype(np.int16),
        uv=hit.uv.numpy().T,
    )


def direct_light(lit: LitScene, lens: Lens, region: Region, frequencies_hz: tuple[float, ...]) -> DirectLight:
    """Direct light on every pixel of a region, finely divided where a footprint meets an edge or a shadow's edge."""
    h, w = region.shape
    rows, cols = np.divmod(np.arange(h * w), w)
    coarse = cast(lit, _strata(lens, region, rows, cols, COARSE))
    central = cast(lit, lens.region_slopes(region).reshape(-1, 2))
    phasor, intensity = _sums(coarse, COARSE**2, frequencies_hz)
    same = coarse.surface.reshape(h * w, -1) == central.surface[:, None]
    coverage = same.mean(axis=1)
    fine = _needs_fine(coarse, coverage.reshape(h, w), (h, w)).ravel()
    if fine.any():
        sub = cast(lit, _strata(lens, region, rows[fine], cols[fine], FINE))
        phasor[:, fine], intensity[fine] = _sums(sub, FINE**2, frequencies_hz)
        same = sub.surface.reshape(int(fine.sum()), -1) == central.surface[fine, None]
        coverage[fine] = same.mean(axis=1)
    return DirectLight(
        phasor=phasor.reshape(-1, h, w),
        intensity=intensity.reshape(h, w),
        range_m=central.range_m.reshape(h, w),
        surface=central.surface.reshape(h, w),
        uv=central.uv.reshape(h, w, 2),
        coverage=coverage.reshape(h, w).astype(np.float32),
        fine=fine.reshape(h, w),
    )


def _strata(lens: Lens, region: Region, rows: np.ndarray, cols: np.ndarray, side: int) -> np.ndarray:
    """Slopes of the centres of side x side strata in each listed pixel, (n side^2, 2), pixel by pixel.

    Inside a pixel the lens is linear to 1e-7 in slope (0.1 um at 1 m), so slopes are interpolated between its corners.
    """
    v, u = np.mgrid[region.row0 : region.row1 + 1, region.col0 : region.col1 + 1] - 0.5
    corner = lens.slopes(u, v)
    place = (np.arange(side) + 0.5) / side
    fy, fx = (a.reshape(1, -1, 1) for a in np.meshgrid(place, place, indexing="ij"))
    c00, c01 = corner[rows, cols][:, None], corner[rows, cols + 1][:, None]
    c10, c11 = corner[rows + 1, cols][:, None], corner[rows + 1, cols + 1][:, None]
    slopes = (1 - fy) * ((1 - fx) * c00 + fx * c01) + fy * ((1 - fx) * c10 + fx * c11)
    return np.asarray(slopes.reshape(-1, 2))


def _sums(hits: Hits, per_pixel: int, frequencies_hz: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Mean phasor (f, n) and mean intensity (n,) over the sub-rays of each pixel."""
    amplitude = hits.amplitude.reshape(-1, per_pixel)
    path_m = hits.path_m.reshape(-1, per_pixel)
    phasor = [
        (amplitude * np.exp(1j * (2 * np.pi * f / SPEED_OF_LIGHT_AIR) * path_m)).mean(axis=1) for f in frequencies_hz
    ]
    return np.stack(phasor), amplitude.mean(axis=1)


def _needs_fine(hits: Hits, coverage: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(h, w) bool: pixels whose footprint, or a neighbour's, is not one smooth, evenly lit piece of surface."""
    h, w = shape
    amplitude = hits.amplitude.reshape(h * w, -1)
    range_m = hits.range_m.reshape(h * w, -1)
    uneven = amplitude.max(axis=1) - amplitude.min(axis=1) > 0.2 * amplitude.max(axis=1)
    # Sub-rays of a smooth surface lie on a plane: the sum of opposite corners equals that of the centre's two.
    n = int(np.sqrt(range_m.shape[1]))
    grid = range_m.reshape(-1, n, n)
    with np.errstate(invalid="ignore"):
        bend = np.abs(grid[:, 0, 0] + grid[:, -1, -1] - grid[:, 0, -1] - grid[:, -1, 0])
        bend = np.maximum(bend, np.abs(grid[:, 0, 0] + grid[:, -1, -1] - grid[:, 1, 1] - grid[:, 2, 2]))
    kinked = ~(bend < KINK_M)
    flagged = (uneven | kinked).reshape(h, w) | (coverage < 1)
    return np.asarray(ndimage.binary_dilation(flagged, np.ones((3, 3), bool)))


def surface_rgb(parts: Any, surface: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Colour albedo (h, w, 3) float32 in 0..1 at the central rays, 0 where they meet nothing."""
    rgb = np.zeros((*surface.shape, 3), np.float32)
    for index, part in enumerate(parts):
        here = surface == index
        if here.any():
            rgb[here] = part.rgb_at(uv[here])
    return rgb
