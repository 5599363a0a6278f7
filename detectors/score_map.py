"""The easy way to a detector: score every pixel, and clusters, quiet threshold and sizes follow."""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left
from itertools import pairwise
from typing import ClassVar, Generic, TypeVar

import numpy as np
from pydantic import Field

from detectors.clusters import euclidean_clusters
from detectors.interface import Detection, Evidence, Measurement
from detectors.masks import on_grid as on_grid
from detectors.measure import HoleModelConfig, extents, measure_detection
from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM, Cloud


class ScoreMapConfig(Config):
    """Settings that turn a score map into findings. Pixels above the threshold that a chain of steps no longer than
    ``cluster_distance_mm`` joins are one finding; those with fewer than ``min_points`` are none."""

    min_points: int = Field(default=1, ge=1)
    cluster_distance_mm: float = Field(default=10.0, gt=0)
    hole_model: HoleModelConfig = Field(default_factory=HoleModelConfig)


S = TypeVar("S", bound=ScoreMapConfig)


class ScoreMapDetector(ABC, Generic[S]):
    """Implements `detectors.interface.Detector` but for `analyse`. A subclass also gives ``name``, ``version`` and, for
    settings of its own, a ``settings_type`` that derives from `ScoreMapConfig`; the first line of its docstring is what
    ``python -m harness.ls`` says of it. `on_grid` puts the scores of cropped pixels back on the cloud's grid."""

    settings_type: ClassVar[type[ScoreMapConfig]] = ScoreMapConfig
    name: str
    version: int

    def __init__(self, settings: S) -> None:
        self.settings = settings

    @abstractmethod
    def analyse(self, cloud: Cloud) -> Evidence:
        """Score every pixel. Raises UserError where the cloud cannot be judged (empty crop, too few points)."""

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        """Return clusters of pixels whose score is above the threshold, strongest first."""
        pixels = above(evidence, threshold)
        labels = self._clusters(cloud, pixels)
        by_label = np.argsort(labels, kind="stable")
        bounds = np.searchsorted(labels[by_label], np.arange(labels.max(initial=-1) + 2))
        clusters = [pixels[by_label[start:end]] for start, end in pairwise(bounds)]
        found = [self._detection(cloud, evidence, cluster) for cluster in clusters]
        return tuple(sorted(found, key=lambda detection: (-detection.score, int(detection.pixels[0]))))

    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        """Return the lowest threshold at which `find` returns nothing; exact, 0 where nothing can ever be found."""
        return self._strength(cloud, evidence, above(evidence, 0.0))

    def measure(self, cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
        """Measure the thesis' extents, and the model of a blurred hole."""
        return measure_detection(cloud, evidence, detection, self.settings.hole_model)

    def _detection(self, cloud: Cloud, evidence: Evidence, pixels: np.ndarray) -> Detection:
        centre_m = extents(cloud.points_m.reshape(-1, 3)[pixels])[1]
        return Detection(self._strength(cloud, evidence, pixels), pixels, centre_m)

    def _clusters(self, cloud: Cloud, pixels: np.ndarray) -> np.ndarray:
        points = cloud.points_m.reshape(-1, 3)[pixels]
        return euclidean_clusters(points, self.settings.cluster_distance_mm * MM, self.settings.min_points)

    def _strength(self, cloud: Cloud, evidence: Evidence, pixels: np.ndarray) -> float:
        """Return the lowest threshold at which no cluster of ``min_points`` is left among these pixels: the score
        of the point, in falling order, that completes the first cluster, found by doubling and bisection."""
        least = self.settings.min_points
        if len(pixels) < least:
            return 0.0
        scores = evidence.score.reshape(-1)[pixels]
        if least == 1:
            return float(scores.max())
        falling = np.argsort(-scores, kind="stable")

        def completes(count: int) -> bool:
            return bool((self._clusters(cloud, pixels[falling[:count]]) >= 0).any())

        low = high = least
        while not completes(high):
            if high == len(pixels):
                return 0.0
            low, high = high + 1, min(2 * high, len(pixels))
        count = bisect_left(range(high), True, lo=low, key=completes)
        return float(scores[falling[count - 1]])


def above(evidence: Evidence, threshold: float) -> np.ndarray:
    """Return the flat indices, ascending, of the pixels whose score exceeds the threshold."""
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(evidence.score.reshape(-1) > threshold)
