"""The surface's shape, chosen by evidence, against surfaces that are known to the last micrometre."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from detectors.background import Background, background
from detectors.surface import SurfaceConfig
from harness.vocabulary.capture import Cloud
from harness.vocabulary.geometry import Region

SHAPE, FOCAL_PX, NOISE_M = (144, 160), 140.0, 3e-4
V, U = np.mgrid[: SHAPE[0], : SHAPE[1]]
X, Y = (U - 79.5) / FOCAL_PX, (V - 71.5) / FOCAL_PX
"""Slopes x/z and y/z: at 0.7 m a pixel is 5 mm wide and the picture 0.8 m."""
DAMAGE = ((0.0, 0.0, 0.06, 0.004), (0.10, 0.06, 0.04, 0.003), (-0.08, -0.10, 0.04, -0.003))
"""x, y, diameter, depth (negative: a bump), metres: parabolic dents."""


def plane() -> np.ndarray:
    return 0.7 / (1 - 0.2 * X - 0.1 * Y)


def pipe(radius_m: float = 0.3, distance_m: float = 0.7) -> np.ndarray:
    return _nearer_root(X**2 + 1, distance_m + radius_m, radius_m)


def sphere(radius_m: float = 0.3, distance_m: float = 0.7) -> np.ndarray:
    return _nearer_root(X**2 + Y**2 + 1, distance_m + radius_m, radius_m)


def _nearer_root(a: np.ndarray, centre_m: float, radius_m: float) -> np.ndarray:
    inside = centre_m**2 - a * (centre_m**2 - radius_m**2)
    return np.where(inside > 0, (centre_m - np.sqrt(np.maximum(inside, 0))) / a, np.nan)


def face(z_of: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    z = np.full(SHAPE, 0.7)
    for _ in range(60):
        z = z_of(X * z, Y * z)
    return z


def saddle() -> np.ndarray:
    return face(lambda x, y: 0.7 + 0.4 * x * y)


def bent_sheet() -> np.ndarray:
    return face(lambda x, y: 0.7 + 0.01 * np.tanh(x / 0.12))


def cloud_of(z: np.ndarray, points_m: np.ndarray | None = None) -> Cloud:
    points = np.stack([X * z, Y * z, z], axis=-1) if points_m is None else points_m
    flat = np.zeros(points.shape[:2], np.uint8)
    region = Region(0, flat.shape[0], 0, flat.shape[1])
    return Cloud(points, flat, flat.astype(int) + 1, np.full(flat.shape, np.nan), region, 0.0, 1)


def measured(z: np.ndarray, seed: int = 0, correlated_px: float = 0.0, damage: tuple = DAMAGE) -> np.ndarray:
    """The surface with damage and noise."""
    seen = z.copy()
    for x, y, diameter, depth in damage:
        part = np.hypot(X * z - x, Y * z - y) / (diameter / 2)
        seen = seen + depth * np.maximum(1 - part**2, 0)
    noise = np.random.default_rng(seed).standard_normal(SHAPE)
    if correlated_px:
        noise = cv2.GaussianBlur(noise, (0, 0), correlated_px)
        noise /= noise.std()
    return seen + NOISE_M * noise


def found(z: np.ndarray, **settings: object) -> Background:
    cloud = cloud_of(z)
    return background(cloud, cloud.valid, SurfaceConfig.from_data({"shape": "auto", **settings}))


@pytest.mark.parametrize(
    ("z", "name"),
    [(plane(), "plane"), (pipe(), "quadric"), (sphere(), "quadric"), (saddle(), "polynomial of degree 2")],
    ids=["plane", "pipe", "sphere", "saddle"],
)
@pytest.mark.parametrize("correlated_px", [0.0, 1.2])
def test_the_simplest_shape_that_explains_the_cloud_is_taken(z: np.ndarray, name: str, correlated_px: float) -> None:
    answer = found(measured(z, correlated_px=correlated_px))
    assert answer.description == name and answer.scale_m is None and answer.fits and answer.warning == ""
    error = answer.surface_z_m - z
    assert np.nanquantile(np.abs(error), 0.9) < 0.5 * NOISE_M
    assert abs(error[71:73, 79:81]).max() < 0.5 * NOISE_M
