"""Two detectors that test the harness, not a target: the oracle is handed the truth, the blind
detector guesses."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import Field

from detectors.crop import BoxCrop, CropConfig, crop
from detectors.findings.extents import measure_extents
from detectors.interface import Detection, Evidence, Measurement, TrueDamage
from detectors.score_map import above
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud
from harness.vocabulary.seeds import random_stream

UNIT_M = 1.0 * MM  # length of one unit of score: neither score is a length, and tables ask for one


class Oracle:
    """Handed the truth: finds every damage once, at any threshold below 1, and nothing else; has
    no settings."""

    settings_type: ClassVar[type[Config]] = Config
    name = "oracle"
    version = 1
    tests_the_harness = True  # missing returns are no findings of theirs

    def __init__(self, settings: Config, truth: tuple[TrueDamage, ...] | None = None) -> None:
        self.settings = settings
        self._truth = truth

    def with_truth(self, truth: tuple[TrueDamage, ...]) -> Oracle:
        """Return the detector for one cloud with this truth; empty on a hole-free board."""
        return Oracle(self.settings, tuple(truth))

    def analyse(self, cloud: Cloud) -> Evidence:
        """Score 1 on the pixels of true damage, 0 on others. Raises UserError if it has not
        received the truth."""
        truth = self._known()
        if not cloud.valid.any():
            raise UserError("the cloud has no valid point to judge", fix="check the capture")
        residual_m = np.where(cloud.valid, 0.0, np.nan)
        score = residual_m.copy()
        for damage in truth:
            score.reshape(-1)[damage.pixels] = 1.0
        return Evidence(score, residual_m, cloud.points_m[..., 2].copy(), UNIT_M)

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        """Return the damages, in the truth's order, below a threshold of 1; nothing from 1 on."""
        reference = self._known() if threshold < 1.0 else ()
        return tuple(
            Detection(1.0, np.sort(damage.pixels), damage.centre_m) for damage in reference
        )

    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        """Return 1 where there is damage, 0 on a hole-free board."""
        return 1.0 if self._known() else 0.0

    def measure(self, cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
        """Return the true diameter and place as the extents; no model is fitted."""
        damage = next(
            (each for each in self._known() if np.array_equal(each.centre_m, detection.centre_m)),
            None,
        )
        if damage is None:
            raise ValueError("the detection is none of this oracle's")
        measured = measure_extents(cloud, detection, "handed the truth")
        return replace(
            measured, extent_diameter_m=damage.diameter_m, extent_centre_m=damage.centre_m
        )

    def _known(self) -> tuple[TrueDamage, ...]:
        if self._truth is None:
            content = (
                "the detector 'oracle' has not received the truth: it tests studies on "
                "simulated boards alone"
            )
            raise UserError(
                content,
                fix="use it in an experiment with a simulated source, or choose another detector",
            )
        return self._truth


class BlindConfig(Config):
    """``guesses_per_m2``: mean number of guesses on a square metre; above a threshold t exp(-t)
    times as many."""

    crop: CropConfig = Field(default_factory=BoxCrop)
    guesses_per_m2: float = Field(default=400.0, gt=0, le=1e6)
    seed: int = Field(default=0, ge=0)


class BlindDetector:
    """Random: guesses without looking, at a stated number per square metre, with exponential
    scores; the same cloud gives the same guesses, another draw of noise independent ones."""

    settings_type: ClassVar[type[BlindConfig]] = BlindConfig
    name = "blind"
    version = 1
    tests_the_harness = True  # missing returns are no findings of theirs

    def __init__(self, settings: BlindConfig) -> None:
        self.settings = settings

    def analyse(self, cloud: Cloud) -> Evidence:
        """Score exponentially where a guess falls, 0 elsewhere in the crop. Raises UserError on an
        empty crop."""
        mask = crop(cloud, self.settings.crop)
        points = np.ascontiguousarray(cloud.points_m)
        content = hashlib.blake2b(
            repr(points.shape).encode() + points.tobytes(), digest_size=16
        ).hexdigest()
        random = random_stream(self.settings.seed, "blind", content)
        area_m2 = judged_area_m2(cloud, mask)
        guesses = min(int(random.poisson(self.settings.guesses_per_m2 * area_m2)), int(mask.sum()))
        positions = random.choice(np.flatnonzero(mask), guesses, replace=False)
        residual_m = np.where(mask, 0.0, np.nan)
        score = residual_m.copy()
        score.reshape(-1)[positions] = random.exponential(size=guesses)
        surface_z_m = np.where(mask, cloud.points_m[..., 2], np.nan)
        return Evidence(
            score, residual_m, surface_z_m, UNIT_M, {"guesses": guesses, "area_m2": area_m2}
        )

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        """Return each guess above the threshold by itself, strongest first."""
        pixels = above(evidence, threshold)
        scores = evidence.score.reshape(-1)[pixels]
        points = cloud.points_m.reshape(-1, 3)
        strongest = np.lexsort((pixels, -scores))
        return tuple(
            Detection(float(scores[i]), pixels[i : i + 1], points[pixels[i]].copy())
            for i in strongest
        )

    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        """Return the highest score; 0 where there was no guess."""
        return float(np.nanmax(evidence.score, initial=0.0))

    def measure(self, cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
        """Return extents alone: 0 at the guess' place."""
        return measure_extents(cloud, detection, "a guess has no size")


def judged_area_m2(cloud: Cloud, mask: np.ndarray) -> float:
    """Return the area of the surface that a mask (h, w) of pixels covers: of its cells between
    four pixels across the optical axis, over the cosine of the tilt of its plane. Of a cloud
    without a grid the area of the convex hull."""
    from scipy.spatial import ConvexHull, QhullError

    x, y, z = cloud.points_m[mask].T
    if len(z) < 3:
        return 0.0
    middle = np.stack([x - x.mean(), y - y.mean(), np.ones(len(z))], axis=-1)
    slope_x, slope_y, _ = np.linalg.lstsq(middle, z, rcond=None)[0]
    if cloud.organised:
        complete = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1] & mask[1:, 1:]
        xy = np.where(mask[..., None], cloud.points_m[..., :2], 0.0)
        falling = xy[1:, 1:] - xy[:-1, :-1]
        rising = xy[1:, :-1] - xy[:-1, 1:]
        areas = 0.5 * (falling[..., 0] * rising[..., 1] - falling[..., 1] * rising[..., 0])
        across = float(abs(areas[complete].sum()))
    else:
        try:
            across = float(ConvexHull(np.stack([x, y], axis=-1)).volume)
        except QhullError:
            return 0.0
    return float(across * np.sqrt(1.0 + slope_x**2 + slope_y**2))
