"""The blind detector: it guesses, so it must score what chance gives: its false calls and no more hits than places that
happen to lie near a damage."""

from __future__ import annotations

import hashlib
from typing import ClassVar

import numpy as np
from pydantic import Field

from detectors.crop import BoxCrop, CropConfig, crop
from detectors.interface import Detection, Evidence, Measurement
from detectors.measure import measure_extents, on_pixels
from detectors.score_map import above
from harness.vocabulary.capture import Cloud
from harness.vocabulary.config import Config
from harness.vocabulary.seeds import random_stream
from harness.vocabulary.units import MM

UNIT_M = 1.0 * MM
"""What one unit of its score is taken to be: a guess' score is no length, and tables ask for one."""


class BlindConfig(Config):
    """``guesses_per_m2``: mean number of guesses on a square metre of what the crop leaves. Above a threshold t there
    are exp(-t) times as many, so that one false call per square metre needs t = ln(guesses_per_m2)."""

    crop: CropConfig = Field(default_factory=BoxCrop)
    guesses_per_m2: float = Field(default=400.0, gt=0, le=1e6)
    seed: int = Field(default=0, ge=0)


class BlindDetector:
    """Random: guesses without looking, at a stated number per square metre, with exponential scores.

    A Poisson number of guesses falls on the judged pixels, each pixel as likely as any other. The stream is that of
    the seed and of the cloud's bytes: the same cloud gives the same guesses, another draw of noise independent ones.
    So, unlike a detector's, they do not move with the cloud. Implements `detectors.interface.Detector`.
    """

    settings_type: ClassVar[type[BlindConfig]] = BlindConfig
    name = "blind"
    version = 1
    tests_the_harness = True

    def __init__(self, settings: BlindConfig) -> None:
        self.settings = settings

    def analyse(self, cloud: Cloud) -> Evidence:
        """An exponential score where a guess falls, 0 elsewhere in the crop. Raises UserError on an empty crop."""
        mask = crop(cloud, self.settings.crop)
        random = random_stream(self.settings.seed, "blind", _content(cloud))
        area_m2 = judged_area_m2(cloud, mask)
        guesses = min(int(random.poisson(self.settings.guesses_per_m2 * area_m2)), int(mask.sum()))
        places = random.choice(np.flatnonzero(mask), guesses, replace=False)
        score = np.where(mask, 0.0, np.nan)
        score.reshape(-1)[places] = random.exponential(size=guesses)
        zeros = np.where(mask, 0.0, np.nan)
        surface_z_m = np.where(mask, cloud.points_m[..., 2], np.nan)
        return Evidence(score, zeros, surface_z_m, UNIT_M, {"guesses": guesses, "area_m2": area_m2})

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        """Each guess above the threshold by itself, strongest first."""
        pixels = above(evidence, threshold)
        scores = evidence.score.reshape(-1)[pixels]
        points = cloud.points_m.reshape(-1, 3)
        strongest = np.lexsort((pixels, -scores))
        return tuple(Detection(float(scores[i]), pixels[i : i + 1], points[pixels[i]].copy()) for i in strongest)

    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        """The highest score; 0 where there was no guess."""
        return float(np.nanmax(evidence.score, initial=0.0))

    def measure(self, cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
        """Extents alone: 0 at the guess' place."""
        measured = measure_extents(cloud, detection, "a guess has no size")
        return on_pixels(cloud, detection, measured) if cloud.organised else measured


def judged_area_m2(cloud: Cloud, mask: np.ndarray) -> float:
    """Area of the surface that a mask (h, w) of pixels covers: that of its cells across the optical axis, over the
    cosine of the tilt of its plane (a curved face's area is a little more). Cells lie between four pixels of the mask,
    and their signed areas add up to that of the outline, so that noise along the rays does not make a surface larger.
    Of a cloud without a grid it is the area of the convex hull."""
    x, y, z = cloud.points_m[mask].T
    if len(z) < 3:
        return 0.0
    middle = np.stack([x - x.mean(), y - y.mean(), np.ones(len(z))], axis=-1)
    slope_x, slope_y, _ = np.linalg.lstsq(middle, z, rcond=None)[0]
    across = _cells_m2(cloud, mask) if cloud.organised else _hull_m2(x, y)
    return float(across * np.sqrt(1.0 + slope_x**2 + slope_y**2))


def _cells_m2(cloud: Cloud, mask: np.ndarray) -> float:
    whole = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1] & mask[1:, 1:]
    xy = np.where(mask[..., None], cloud.points_m[..., :2], 0.0)
    falling, rising = xy[1:, 1:] - xy[:-1, :-1], xy[1:, :-1] - xy[:-1, 1:]
    areas = 0.5 * (falling[..., 0] * rising[..., 1] - falling[..., 1] * rising[..., 0])
    return float(abs(areas[whole].sum()))


def _hull_m2(x: np.ndarray, y: np.ndarray) -> float:
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(np.stack([x, y], axis=-1)).volume)
    except QhullError:
        return 0.0


def _content(cloud: Cloud) -> str:
    """Digest of the cloud's points, bit by bit."""
    points = np.ascontiguousarray(cloud.points_m)
    return hashlib.blake2b(repr(points.shape).encode() + points.tobytes(), digest_size=16).hexdigest()
