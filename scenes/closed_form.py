"""Views known in closed form: endless planes under one emitter. For calibration, tests and checks.

Direct light only. `plane_view` samples one plane at pixel centres; `layered_view` puts a part of a plane before another
and sums over each pixel's footprint, with the shadow that the front throws on the back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens
from harness.vocabulary.units import SPEED_OF_LIGHT_AIR
from scenes.optics import BeamFootprint, Optics
from scenes.sensor.camera import AnyCamera
from scenes.view import NoiseFreeView

COARSE, FINE = 4, 12
"""Sub-rays along each side of a footprint; fine where it or a neighbour's meets an edge or a shadow's edge."""
BEAM_REACH_FWHM = 1.25
"""Half width of a beam's grid of sub-rays: 2.9 deviations, beyond which lies 1.3 % of a round Gaussian's light."""
WHITE = 0.8
"""The colour albedo of closed-form surfaces; no sensor uses it."""

Covers = Callable[[np.ndarray], np.ndarray]
"""Function of slopes (..., 2) of points on the front plane, as seen from the lens: whether the front is there; False
for NaN."""


@dataclass(frozen=True)
class Plane:
    """The plane z = distance + slope_x x + slope_y y in the camera's frame, metres."""

    distance_m: float
    slope_x: float = 0.0
    slope_y: float = 0.0

    @property
    def normal(self) -> np.ndarray:
        """(3,) unit normal, towards the camera."""
        return np.array([self.slope_x, self.slope_y, -1.0]) / np.sqrt(self.slope_x**2 + self.slope_y**2 + 1)

    def z_along_m(self, slopes: np.ndarray) -> np.ndarray:
        """z (...) where rays with ``slopes`` (..., 2) meet the plane; NaN where they never do."""
        one_by_z = (1 - self.slope_x * slopes[..., 0] - self.slope_y * slopes[..., 1]) / self.distance_m
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
    """The plane z = distance + slope_x x + slope_y y, Lambertian, direct light only, sampled at pixel centres.

    Amplitude: albedo cos(incidence) / d^2 with d from the emitter. The footprint's extent and the cone are left out.
    """
    plane = Plane(distance_m, slope_x, slope_y)
    slopes = camera.nominal_lens.region_slopes(region)
    points = _points(slopes, plane.z_along_m(slopes))
    amplitude, path_m = _lit(points, plane, albedo, camera.optics)
    phasor = amplitude * np.exp(1j * _wave_numbers(camera.optics)[:, None, None] * path_m)
    range_m = np.linalg.norm(points, axis=-1)
    seen = np.zeros(range_m.shape, int)
    return _view(camera.optics, region, slopes, phasor, amplitude, range_m, seen, ("plane",), np.ones(range_m.shape))


def layered_view(
    camera: AnyCamera, region: Region, front: Plane, back: Plane, covers: Covers, albedo: float
) -> NoiseFreeView:
    """A part of the plane ``front`` before the endless plane ``back``, both Lambertian of one albedo.

    ``covers`` says where the front is. Each pixel sums phasors over its footprint; a point of the back is dark where
    the way to the emitter passes the front. Surfaces: "front", "back". Left out: the front's thickness and its edge's
    own face, light between the planes, the emitter's cone.
    """
    lens, optics = camera.nominal_lens, camera.optics
    footprints = Footprints(optics, lens, region)
    scene = _Layers(front, back, covers, albedo, optics)
    everywhere = np.ones(region.shape, bool)
    coarse = scene.seen(footprints.rays(everywhere, COARSE), footprints.weights(COARSE))
    phasor, intensity, share = coarse.phasor, coarse.intensity, coarse.front_share
    mixed = ndimage.binary_dilation(coarse.mixed, np.ones((3, 3), bool))
    if mixed.any():
        fine = scene.seen(footprints.rays(mixed, FINE), footprints.weights(FINE))
        phasor[:, mixed], intensity[mixed], share[mixed] = fine.phasor, fine.intensity, fine.front_share
    slopes = lens.region_slopes(region)
    on_front, points, _, _, _ = scene.meet(slopes)
    return _view(
        optics,
        region,
        slopes,
        phasor,
        intensity,
        np.linalg.norm(points, axis=-1),
        np.where(on_front, 0, 1),
        ("front", "back"),
        np.where(on_front, share, 1 - share),
    )


class Footprints:
    """The sub-rays of the pixels of a region: a grid of side x side rays over each pixel's footprint."""

    def __init__(self, optics: Optics, lens: Lens, region: Region) -> None:
        self._footprint = optics.footprint
        if isinstance(self._footprint, BeamFootprint):
            self._centre = lens.region_slopes(region)
        else:
            v, u = np.mgrid[region.row0 : region.row1 + 1, region.col0 : region.col1 + 1] - 0.5
            self._corner = lens.slopes(u, v)

    def rays(self, pixels: np.ndarray, side: int) -> np.ndarray:
        """Slopes (..., side^2, 2) of the sub-rays of the chosen ``pixels`` (h, w) bool: (n, ...), or (h, w, ...)
        where all are chosen."""
        shape = pixels.shape if pixels.all() else (int(pixels.sum()),)
        place = (np.arange(side) + 0.5) / side
        fy, fx = (a.reshape(-1, 1) for a in np.meshgrid(place, place, indexing="ij"))
        if isinstance(self._footprint, BeamFootprint):
            reach = 2 * BEAM_REACH_FWHM * self._footprint.fwhm_rad
            return _beam(self._centre[pixels], reach * (fx - 0.5), reach * (fy - 0.5)).reshape(*shape, side**2, 2)
        # Inside a pixel the lens is linear to 1e-7 in slope, so slopes are interpolated between its corners.
        c = self._corner
        c00, c01, c10, c11 = (each[pixels][:, None] for each in (c[:-1, :-1], c[:-1, 1:], c[1:, :-1], c[1:, 1:]))
        rays = (1 - fy) * ((1 - fx) * c00 + fx * c01) + fy * ((1 - fx) * c10 + fx * c11)
        return np.asarray(rays.reshape(*shape, side**2, 2))

    def weights(self, side: int) -> np.ndarray:
        """(side^2,) share of the footprint's light that each sub-ray stands for."""
        if not isinstance(self._footprint, BeamFootprint):
            return np.full(side**2, 1 / side**2)
        place = ((np.arange(side) + 0.5) / side * 2 - 1) * BEAM_REACH_FWHM
        weight = np.exp(-4 * np.log(2) * (place[:, None] ** 2 + place**2)).ravel()
        return np.asarray(weight / weight.sum())


def _beam(slopes: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Slopes (n, k, 2) of rays at angles ``across`` and ``down`` (k, 1) in radians from central rays (n, 2)."""
    centre = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=-1)
    centre /= np.linalg.norm(centre, axis=-1, keepdims=True)
    first = np.cross([0.0, 1.0, 0.0], centre)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(centre, first)
    rays = centre[:, None] + across * first[:, None] + down * second[:, None]
    return np.asarray(rays[..., :2] / rays[..., 2:])


@dataclass(frozen=True)
class _Seen:
    """Sums over footprints: phasor (f, ...), intensity, the front's share; and which are not one evenly lit surface."""

    phasor: np.ndarray
    intensity: np.ndarray
    front_share: np.ndarray
    mixed: np.ndarray


@dataclass(frozen=True)
class _Layers:
    """A part of a plane before another, under one emitter."""

    front: Plane
    back: Plane
    covers: Covers
    albedo: float
    optics: Optics

    def seen(self, rays: np.ndarray, weights: np.ndarray) -> _Seen:
        """Sum up footprints (..., k, 2) with ``weights`` (k,)."""
        on_front, _, light, path_m, shadowed = self.meet(rays)
        phasor = [(weights * light * np.exp(1j * k * path_m)).sum(axis=-1) for k in _wave_numbers(self.optics)]
        state = on_front + 2 * shadowed
        return _Seen(
            phasor=np.stack(phasor),
            intensity=(weights * light).sum(axis=-1),
            front_share=(weights * on_front).sum(axis=-1),
            mixed=state.min(axis=-1) != state.max(axis=-1),
        )

    def meet(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return for rays (..., 2): whether they meet the front, where they end (..., 3), the light there, its path in
        m, and whether they end in the front's shadow."""
        on_front = self.covers(rays)
        front_points, back_points = (_points(rays, plane.z_along_m(rays)) for plane in (self.front, self.back))
        front_light, front_path = _lit(front_points, self.front, self.albedo, self.optics)
        back_light, back_path = _lit(back_points, self.back, self.albedo, self.optics)
        shadowed = ~on_front & self._in_shadow(back_points)
        light = np.where(on_front, front_light, np.where(shadowed, 0.0, back_light))
        points = np.where(on_front[..., None], front_points, back_points)
        return on_front, points, light, np.where(on_front, front_path, back_path), shadowed

    def _in_shadow(self, points: np.ndarray) -> np.ndarray:
        """Tell whether the way from points (..., 3) of the back to the emitter passes through the front.

        It crosses the front's plane, n . p = -distance with n = (slope_x, slope_y, -1), at p + t w.
        """
        way = self.optics.emitter_m - points
        normal = np.array([self.front.slope_x, self.front.slope_y, -1.0])
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (-self.front.distance_m - points @ normal) / (way @ normal)
            crossing = points + t[..., None] * way
            between = (t > 0) & (t < 1) & (crossing[..., 2] > 0)
            slopes = np.where(between[..., None], crossing[..., :2] / crossing[..., 2:], np.nan)
        return np.asarray(between & self.covers(slopes))


def _points(slopes: np.ndarray, z_m: np.ndarray) -> np.ndarray:
    return np.asarray(np.concatenate([slopes, np.ones((*z_m.shape, 1))], axis=-1) * z_m[..., None])


def _lit(points: np.ndarray, plane: Plane, albedo: float, optics: Optics) -> tuple[np.ndarray, np.ndarray]:
    """Amplitude (...) of points (..., 3) on a plane, and the length of the light's path to the lens in metres."""
    to_emitter = optics.emitter_m - points
    leg_out = np.linalg.norm(to_emitter, axis=-1)
    amplitude = albedo * np.clip(to_emitter @ plane.normal, 0, None) / leg_out**3
    # a ray that never meets the plane has no point, and no light
    return np.nan_to_num(amplitude), np.nan_to_num(leg_out + np.linalg.norm(points, axis=-1))


def _wave_numbers(optics: Optics) -> np.ndarray:
    return 2 * np.pi * np.array(optics.frequencies_hz) / SPEED_OF_LIGHT_AIR


def _view(
    optics: Optics,
    region: Region,
    slopes: np.ndarray,
    phasor: np.ndarray,
    intensity: np.ndarray,
    range_m: np.ndarray,
    surface: np.ndarray,
    names: tuple[str, ...],
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
        slopes=slopes,
        seconds=0.0,
        variant="closed form",
    )
