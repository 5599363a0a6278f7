"""Range images of spheres before a wall and a floor, in closed form."""

from __future__ import annotations

import cv2
import numpy as np

from harness.stills.spheres import RangeImage, range_image
from harness.vocabulary.geometry import Lens

LENS = Lens(width=200, height=150, fx=200.0, fy=200.0, cx=99.5, cy=74.5)
WALL_M = 2.5


def sphere_scene(
    centres_m: np.ndarray,
    radius_m: float,
    sigma_m: float = 0.0,
    missing: float = 0.0,
    seed: int = 0,
    blur_px: float = 0.0,
    lens: Lens = LENS,
    wall_m: float = WALL_M,
) -> RangeImage:
    """Spheres whose noise grows with the inverse of the cosine of incidence, is correlated over
    ``blur_px``, and loses a share of all pixels."""
    rng = np.random.default_rng(seed)
    slopes = lens.region_slopes(lens.whole)
    plane = range_image(np.full((*slopes.shape[:2], 3), wall_m), slopes)
    rays = plane.rays
    range_m = plane.range_m
    with np.errstate(divide="ignore"):
        floor_m = np.where(slopes[..., 1] > 0, 0.6 / rays[..., 1], np.inf)
    range_m = np.minimum(range_m, floor_m)
    cosine = np.ones(range_m.shape)
    for centre_m in centres_m:
        along_m = rays @ centre_m
        inside_m2 = radius_m**2 - centre_m @ centre_m + along_m**2
        half_m = np.sqrt(np.maximum(inside_m2, 0))
        met_m = np.where(inside_m2 > 0, along_m - half_m, np.inf)
        cosine = np.where(met_m < range_m, half_m / radius_m, cosine)
        range_m = np.minimum(range_m, met_m)
    noise = rng.standard_normal(range_m.shape)
    if blur_px:
        noise = cv2.GaussianBlur(noise, (0, 0), blur_px)
        noise /= noise.std()
    range_m = range_m + sigma_m * noise / np.maximum(cosine, 0.1)
    range_m[rng.random(range_m.shape) < missing] = np.nan
    return RangeImage(range_m, rays)
