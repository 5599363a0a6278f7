"""Views in closed form: infinite planes under one emitter, with direct light only. For calibration
and checks."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from harness.vocabulary.geometry import Region, rays_of
from scenes.optics import NoiseFreeView, Optics, footprint_of, wave_numbers
from scenes.sensor.common.facts import CameraFacts

WHITE = 0.8  # albedo of closed-form surfaces in red, green and blue; no sensor uses it
# slopes (..., 2), without NaN, to whether the front is there
Covers = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Plane:
    """The plane z = distance + slope_x x + slope_y y, in the camera's frame and in metres."""

    distance_m: float
    """z on the optical axis."""
    slope_x: float = 0.0
    """dz/dx."""
    slope_y: float = 0.0
    """dz/dy."""

    @property
    def normal(self) -> np.ndarray:
        """Unit normal (3,), towards the camera."""
        length = np.sqrt(self.slope_x**2 + self.slope_y**2 + 1)
        return np.array([self.slope_x, self.slope_y, -1.0]) / length

    def z_along_m(self, slopes: np.ndarray) -> np.ndarray:
        """Return z (...) where rays with ``slopes`` (..., 2) meet the plane; NaN for rays that do
        not."""
        share = 1 - self.slope_x * slopes[..., 0] - self.slope_y * slopes[..., 1]
        one_by_z = share / self.distance_m
        with np.errstate(divide="ignore"):
            return np.where(one_by_z > 0, 1 / one_by_z, np.nan)


def plane_view(
    camera: CameraFacts,
    region: Region,
    distance_m: float,
    albedo: float,
    slope_x: float = 0.0,
    slope_y: float = 0.0,
) -> NoiseFreeView:
    """Return a view of the plane z = distance + slope_x x + slope_y y, Lambertian, direct light
    only, sampled at pixel centres. Amplitude: albedo cos(incidence) / d^2 with d from the emitter.
    Left out: the footprint, the cone."""
    plane = Plane(distance_m, slope_x, slope_y)
    slopes = camera.nominal_lens.region_slopes(region)
    hits = _lit(slopes, plane, albedo, camera.optics)
    return image_view(camera, region, hits.points_m[..., 2], hits.light)


def image_view(
    camera: CameraFacts,
    region: Region,
    z_m: np.ndarray,
    light: np.ndarray,
) -> NoiseFreeView:
    """Return a view from a depth image, sampled at pixel centres, with direct light only. ``z_m``
    (h, w): NaN where there is nothing. ``light`` (h, w): the light that returns from each pixel,
    in a view's units. Both may be (k, h, w): parts of pixels on different surfaces, the first of
    which determines its range."""
    optics = camera.optics
    slopes = camera.nominal_lens.region_slopes(region)
    z_m = z_m.reshape(-1, *region.shape)
    light = light.reshape(-1, *region.shape)
    points = rays_of(slopes) * z_m[..., None]
    range_m = np.linalg.norm(points, axis=-1)
    path_m = np.nan_to_num(range_m + np.linalg.norm(optics.emitter_m - points, axis=-1))
    amplitude = np.where(np.isfinite(z_m), np.nan_to_num(light), 0.0)
    waves = wave_numbers(optics.frequencies_hz)
    phasor = np.stack([(amplitude * np.exp(1j * wave * path_m)).sum(axis=0) for wave in waves])
    return _view(
        optics,
        region,
        names=("image",),
        phasor=phasor,
        intensity=amplitude.sum(axis=0),
        range_m=range_m[0],
        surface=np.zeros(region.shape, int),
        coverage=np.ones(region.shape),
    )


class _RayEnds(NamedTuple):
    """Ends of rays (...) on a plane and the light from there."""

    points_m: np.ndarray
    """(..., 3): where they meet the plane; NaN for rays that do not."""
    light: np.ndarray
    """(...): amplitude; 0 for rays that do not."""
    path_m: np.ndarray
    """(...): length of the light's path by way of the emitter; 0 for rays that do not."""


def layered_view(
    camera: CameraFacts,
    region: Region,
    front: Plane,
    back: Plane,
    covers: Covers,
    albedo: float,
) -> NoiseFreeView:
    """Return a view of a part of the plane ``front`` (where it ``covers``) in front of the
    infinite plane ``back``, both Lambertian with the same albedo. Each pixel sums phasors over its
    footprint; the front casts a shadow on the back. Surfaces: "front", "back". Not modelled: the
    front's thickness, light between the planes, the emitter's cone."""
    lens = camera.nominal_lens
    optics = camera.optics
    waves = wave_numbers(optics.frequencies_hz)
    footprint = footprint_of(lens, region, optics.beam_fwhm_rad)
    phasor = np.zeros((len(waves), *region.shape), complex)
    intensity = np.zeros(region.shape)
    front_share = np.zeros(region.shape)
    pixels = np.ones(region.shape, bool)
    # finely where a pixel's or a neighbour's footprint meets an edge
    for weights in (footprint.grid(), footprint.lattice()):
        rows, cols = np.nonzero(pixels)
        rays = footprint.slopes(rows, cols, weights)
        on_front = covers(rays)
        front_hits = _lit(rays, front, albedo, optics)
        back_hits = _lit(rays, back, albedo, optics)
        shadowed = ~on_front & _behind(back_hits.points_m, front, covers, optics)
        back_light = np.where(shadowed, 0.0, back_hits.light)
        light = np.where(on_front, front_hits.light, back_light)
        path_m = np.where(on_front, front_hits.path_m, back_hits.path_m)
        for line, wave in enumerate(waves):
            phasor[line, pixels] = (light * np.exp(1j * wave * path_m)).mean(axis=-1)
        intensity[pixels] = light.mean(axis=-1)
        front_share[pixels] = on_front.mean(axis=-1)
        state = on_front + 2 * shadowed
        mixed = np.zeros(region.shape, bool)
        mixed[pixels] = state.min(axis=-1) != state.max(axis=-1)
        pixels = ndimage.binary_dilation(mixed, np.ones((3, 3), bool), footprint.reach_px or 1)
        if not pixels.any():
            break
    central = lens.region_slopes(region)
    on_front = covers(central)
    front_points = _lit(central, front, albedo, optics).points_m
    back_points = _lit(central, back, albedo, optics).points_m
    points = np.where(on_front[..., None], front_points, back_points)
    return _view(
        optics,
        region,
        names=("front", "back"),
        phasor=phasor,
        intensity=intensity,
        range_m=np.linalg.norm(points, axis=-1),
        surface=np.where(on_front, 0, 1),
        coverage=np.where(on_front, front_share, 1 - front_share),
    )


def _behind(
    points_m: np.ndarray,
    front: Plane,
    covers: Covers,
    optics: Optics,
) -> np.ndarray:
    """Return whether the front casts its shadow on points (..., 3)."""
    # the line to the emitter meets the front's plane, n . p = -distance, at p + t to_emitter
    to_emitter = optics.emitter_m - points_m
    normal = np.array([front.slope_x, front.slope_y, -1.0])
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (-front.distance_m - points_m @ normal) / (to_emitter @ normal)
        crossing = points_m + t[..., None] * to_emitter
        between = (t > 0) & (t < 1) & (crossing[..., 2] > 0)
        slopes = np.where(between[..., None], crossing[..., :2] / crossing[..., 2:], np.nan)
    return between & covers(slopes)


def _lit(
    slopes: np.ndarray,
    plane: Plane,
    albedo: float,
    optics: Optics,
) -> _RayEnds:
    """Return the ends on a plane of rays (..., 2) from the lens."""
    rays = rays_of(slopes)
    points = rays * plane.z_along_m(slopes)[..., None]
    to_emitter = optics.emitter_m - points
    leg_out = np.linalg.norm(to_emitter, axis=-1)
    light = albedo * np.clip(to_emitter @ plane.normal, 0, None) / leg_out**3
    path_m = leg_out + np.linalg.norm(points, axis=-1)
    return _RayEnds(points, np.nan_to_num(light), np.nan_to_num(path_m))


def _view(
    optics: Optics,
    region: Region,
    names: tuple[str, ...],
    phasor: np.ndarray,
    intensity: np.ndarray,
    range_m: np.ndarray,
    surface: np.ndarray,
    coverage: np.ndarray,
) -> NoiseFreeView:
    return NoiseFreeView(
        region=region,
        frequencies_hz=optics.frequencies_hz,
        phasor=phasor,
        phasor_direct=phasor,
        intensity=intensity,
        indirect_noise_m=np.zeros(range_m.shape),
        range_m=range_m,
        surface=np.where(np.isfinite(range_m), surface, -1).astype(np.int16),
        surface_names=names,
        coverage=coverage.astype(np.float32),
        rgb=np.full((*range_m.shape, 3), WHITE, np.float32),
        slopes=optics.lens.region_slopes(region),
        seconds=0.0,
        variant="closed form",
    )
