"""Views in closed form: infinite planes under one emitter, with direct light only. For calibration
and checks."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from harness.vocabulary.geometry import Region
from scenes.optics import NoiseFreeView, Optics, footprint_of, wave_numbers
from scenes.sensor.camera import AnyCamera

WHITE = 0.8  # albedo of closed-form surfaces in red, green and blue; no sensor uses it
Covers = Callable[
    [np.ndarray], np.ndarray
]  # slopes (..., 2), without NaN, to whether the front is there


@dataclass(frozen=True)
class Plane:
    """The plane z = distance + slope_x x + slope_y y, in the camera's frame and in metres."""

    distance_m: float
    slope_x: float = 0.0
    slope_y: float = 0.0

    @property
    def normal(self) -> np.ndarray:
        """Unit normal (3,), towards the camera."""
        return np.array([self.slope_x, self.slope_y, -1.0]) / np.sqrt(
            self.slope_x**2 + self.slope_y**2 + 1
        )

    def z_along_m(self, slopes: np.ndarray) -> np.ndarray:
        """Return z (...) where rays with ``slopes`` (..., 2) meet the plane; NaN for rays that do
        not."""
        one_by_z = (
            1 - self.slope_x * slopes[..., 0] - self.slope_y * slopes[..., 1]
        ) / self.distance_m
        with np.errstate(divide="ignore"):
            return np.where(one_by_z > 0, 1 / one_by_z, np.nan)


def plane_view(
    camera: AnyCamera,
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
    points, amplitude, _ = _lit(slopes, plane, albedo, camera.optics)
    return image_view(camera, region, points[..., 2], amplitude)


def image_view(
    camera: AnyCamera, region: Region, z_m: np.ndarray, light: np.ndarray
) -> NoiseFreeView:
    """Return a view from a depth image, sampled at pixel centres, with direct light only. ``z_m``
    (h, w): NaN where there is nothing. ``light`` (h, w): the light that returns from each pixel,
    in a view's units. Both may be (k, h, w): parts of pixels on different surfaces, the first of
    which determines its range."""
    optics = camera.optics
    slopes = camera.nominal_lens.region_slopes(region)
    z_m = z_m.reshape(-1, *region.shape)
    light = light.reshape(-1, *region.shape)
    points = np.concatenate([slopes, np.ones((*region.shape, 1))], axis=-1) * z_m[..., None]
    path_m = np.nan_to_num(
        np.linalg.norm(points, axis=-1) + np.linalg.norm(optics.emitter_m - points, axis=-1)
    )
    amplitude = np.where(np.isfinite(z_m), np.nan_to_num(light), 0.0)
    waves = wave_numbers(optics.frequencies_hz)
    phasor = np.stack([(amplitude * np.exp(1j * wave * path_m)).sum(axis=0) for wave in waves])
    seen = np.zeros(region.shape, int)
    coverage = np.ones(region.shape)
    return _view(
        optics, region, ("image",), phasor, amplitude.sum(axis=0), points[0], seen, coverage
    )


def layered_view(
    camera: AnyCamera, region: Region, front: Plane, back: Plane, covers: Covers, albedo: float
) -> NoiseFreeView:
    """Return a view of a part of the plane ``front`` (where it ``covers``) in front of the
    infinite plane ``back``, both Lambertian with the same albedo. Each pixel sums phasors over its
    footprint; the front casts a shadow on the back. Surfaces: "front", "back". Not modelled: the
    front's thickness, light between the planes, the emitter's cone."""
    lens = camera.nominal_lens
    optics = camera.optics
    waves = wave_numbers(camera.optics.frequencies_hz)
    footprint = footprint_of(lens, region, optics.beam_fwhm_rad)

    def meet(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return for rays (..., 2): whether they meet the front, their ends, light, path in m, and
        if in the shadow."""
        on_front = covers(rays)
        front_points, front_light, front_path = _lit(rays, front, albedo, optics)
        points, light, path_m = _lit(rays, back, albedo, optics)
        # the line from the back to the emitter meets the front's plane, n . p = -distance, at p +
        # t way
        way = optics.emitter_m - points
        normal = np.array([front.slope_x, front.slope_y, -1.0])
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (-front.distance_m - points @ normal) / (way @ normal)
            crossing = points + t[..., None] * way
            between = (t > 0) & (t < 1) & (crossing[..., 2] > 0)
            slopes = np.where(between[..., None], crossing[..., :2] / crossing[..., 2:], np.nan)
        shadowed = ~on_front & between & covers(slopes)
        light = np.where(on_front, front_light, np.where(shadowed, 0.0, light))
        points = np.where(on_front[..., None], front_points, points)
        return on_front, points, light, np.where(on_front, front_path, path_m), shadowed

    phasor, (intensity, share) = (
        np.zeros((len(waves), *region.shape), complex),
        np.zeros((2, *region.shape)),
    )
    pixels = np.ones(region.shape, bool)
    for weights in (
        footprint.grid(),
        footprint.lattice(),
    ):  # where a pixel's or a neighbour's footprint meets an edge
        rows, cols = np.nonzero(pixels)
        on_front, _, light, path_m, shadowed = meet(footprint.slopes(rows, cols, weights))
        for line, wave in enumerate(waves):
            phasor[line, pixels] = (light * np.exp(1j * wave * path_m)).mean(axis=-1)
        intensity[pixels], share[pixels] = light.mean(axis=-1), on_front.mean(axis=-1)
        state = on_front + 2 * shadowed
        mixed = np.zeros(region.shape, bool)
        mixed[pixels] = state.min(axis=-1) != state.max(axis=-1)
        pixels = ndimage.binary_dilation(mixed, np.ones((3, 3), bool), footprint.reach_px or 1)
        if not pixels.any():
            break
    on_front, points, *_ = meet(lens.region_slopes(region))
    surface = np.where(on_front, 0, 1)
    coverage = np.where(on_front, share, 1 - share)
    return _view(optics, region, ("front", "back"), phasor, intensity, points, surface, coverage)


def _lit(
    slopes: np.ndarray, plane: Plane, albedo: float, optics: Optics
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where rays (..., 2) meet a plane (..., 3), the amplitude there, and the length of the
    light's path to the lens in metres; a ray that does not meet the plane has no point and no
    light."""
    points = (
        np.concatenate([slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1)
        * plane.z_along_m(slopes)[..., None]
    )
    to_emitter = optics.emitter_m - points
    leg_out = np.linalg.norm(to_emitter, axis=-1)
    amplitude = albedo * np.clip(to_emitter @ plane.normal, 0, None) / leg_out**3
    return (
        points,
        np.nan_to_num(amplitude),
        np.nan_to_num(leg_out + np.linalg.norm(points, axis=-1)),
    )


def _view(
    optics: Optics, region: Region, names: tuple[str, ...], *images: np.ndarray
) -> NoiseFreeView:
    phasor, intensity, points, surface, coverage = images
    range_m = np.linalg.norm(points, axis=-1)
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
