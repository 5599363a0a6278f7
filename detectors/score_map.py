"""A base class for detectors that only score pixels: it adds clusters, the quiet threshold and
sizes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Generic, TypeVar

import numpy as np
from pydantic import Field

from detectors.findings.extents import centres_of
from detectors.findings.measure import measure_detection
from detectors.findings.surroundings import HoleModelConfig
from detectors.interface import Detection, Evidence, Measurement
from detectors.levels import Findings as Findings
from detectors.levels import above as above
from detectors.levels import findings_at as findings_at
from detectors.pixels.clusters import nested_clusters
from detectors.pixels.masks import on_grid as on_grid
from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM, Cloud

FIRST_TRIED = 64
"""Highest scores in which a cluster is sought first, as a multiple of its fewest points."""


class ScoreMapConfig(Config):
    """Settings that turn a score map into detections.

    - ``min_points``: groups of fewer pixels are dropped.
    - ``cluster_distance_mm``: pixels above the threshold form one detection if a chain of steps of
      at most this length joins them.
    - ``hole_model``: measures sizes."""

    min_points: int = Field(default=1, ge=1)
    cluster_distance_mm: float = Field(default=10.0, gt=0)
    hole_model: HoleModelConfig = Field(default_factory=HoleModelConfig)


S = TypeVar("S", bound=ScoreMapConfig)


class ScoreMapDetector(ABC, Generic[S]):
    """Implements `detectors.interface.Detector` except `analyse`. A subclass also sets ``name``,
    ``version`` and, for settings of its own, a ``settings_type`` that derives from
    `ScoreMapConfig`; the first line of its docstring is its description in ``tofpod ls``.
    `on_grid` puts the scores of cropped pixels back on the cloud's grid."""

    settings_type: ClassVar[type[ScoreMapConfig]] = ScoreMapConfig
    name: str
    version: int

    def __init__(self, settings: S) -> None:
        self.settings = settings

    @abstractmethod
    def analyse(self, cloud: Cloud) -> Evidence:
        """Score every pixel. Raises UserError if the cloud cannot be judged (empty crop, too few
        points)."""

    def find(
        self,
        cloud: Cloud,
        evidence: Evidence,
        threshold: float,
    ) -> tuple[Detection, ...]:
        """Return clusters of pixels whose score is above the threshold, strongest first."""
        return self.findings(cloud, evidence, [threshold])[0].detections

    def findings(
        self,
        cloud: Cloud,
        evidence: Evidence,
        thresholds: Sequence[float],
    ) -> list[Findings]:
        """Return the result of `find` at each of several rising thresholds."""
        pixels = _scored_pixels(cloud, evidence, thresholds[0])
        points_m = cloud.points_m.reshape(-1, 3)[pixels]
        scores = evidence.score.reshape(-1)[pixels]
        all_labels, all_strengths = self._clusters(self.places(points_m), scores, thresholds)
        findings = []
        for labels, strengths in zip(all_labels, all_strengths, strict=True):
            count = int(labels.max(initial=-1)) + 1
            centres_m = centres_of(points_m, labels, count)
            findings.append(Findings(strengths[:count], pixels, labels, centres_m))
        return findings

    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        """Return the exact lowest threshold at which `find` returns nothing; 0 if it never returns
        anything."""
        pixels = _scored_pixels(cloud, evidence, 0.0)
        scores = evidence.score.reshape(-1)[pixels]
        least = self.settings.min_points
        if least == 1:
            return float(scores.max(initial=0.0))
        # try the highest scores first: they usually contain a cluster
        falling = np.argsort(-scores, kind="stable")
        for count in (FIRST_TRIED * least, len(pixels)):
            highest = falling[:count]
            coordinates = self.places(cloud.points_m.reshape(-1, 3)[pixels[highest]])
            _, strengths = self._clusters(coordinates, scores[highest], [0.0])
            if strengths.max(initial=0.0) > 0.0:
                return float(strengths.max())
        return 0.0

    def places(self, points_m: np.ndarray) -> np.ndarray:
        """Return the places (n, 3) of points (n, 3); the distances between places decide which
        points are joined."""
        return points_m

    def _clusters(
        self,
        places_m: np.ndarray,
        scores: np.ndarray,
        thresholds: Sequence[float],
    ) -> tuple[np.ndarray, np.ndarray]:
        distance_m = self.settings.cluster_distance_mm * MM
        return nested_clusters(
            places_m,
            scores,
            distance_m,
            self.settings.min_points,
            np.array(thresholds),
        )

    def measure(
        self,
        cloud: Cloud,
        evidence: Evidence,
        detection: Detection,
    ) -> Measurement:
        """Measure the thesis' extents and fit the model of a blurred hole."""
        return measure_detection(cloud, evidence, detection, self.settings.hole_model)


def _scored_pixels(
    cloud: Cloud,
    evidence: Evidence,
    threshold: float,
) -> np.ndarray:
    """Return the flat indices, ascending, of the valid pixels whose score exceeds the
    threshold."""
    pixels = above(evidence, threshold)
    return pixels[cloud.valid.reshape(-1)[pixels]]
