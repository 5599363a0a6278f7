"""Views known in closed form: an endless plane under one emitter. For calibration, tests and checks."""

from __future__ import annotations

import numpy as np

from harness.vocabulary.geometry import Region
from harness.vocabulary.units import SPEED_OF_LIGHT_AIR
from scenes.sensor.camera import AnyCamera
from scenes.view import NoiseFreeView


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
    slopes = camera.nominal_lens.region_slopes(region)
    z_m = distance_m / (1 - slope_x * slopes[..., 0] - slope_y * slopes[..., 1])
    points = np.concatenate([slopes, np.ones((*z_m.shape, 1))], axis=-1) * z_m[..., None]
    to_emitter = camera.optics.emitter_m - points
    leg_out = np.linalg.norm(to_emitter, axis=-1)
    range_m = np.linalg.norm(points, axis=-1)
    normal = np.array([slope_x, slope_y, -1.0]) / np.sqrt(slope_x**2 + slope_y**2 + 1)
    intensity = albedo * np.clip(to_emitter @ normal, 0, None) / leg_out**3
    wave_number = 2 * np.pi * np.array(camera.optics.frequencies_hz)[:, None, None] / SPEED_OF_LIGHT_AIR
    phasor = intensity * np.exp(1j * wave_number * (leg_out + range_m))
    return NoiseFreeView(
        region=region,
        frequencies_hz=camera.optics.frequencies_hz,
        phasor=phasor,
        phasor_direct=phasor,
        intensity=intensity,
        indirect_noise_m=np.zeros(z_m.shape),
        range_m=range_m,
        surface=np.zeros(z_m.shape, np.int16),
        surface_names=("plane",),
        coverage=np.ones(z_m.shape, np.float32),
        rgb=np.full((*z_m.shape, 3), 0.8, np.float32),
        slopes=slopes,
        seconds=0.0,
        variant="closed form",
    )
