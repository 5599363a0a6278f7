"""A base class for detectors that only score pixels: it adds clusters, the quiet threshold and
sizes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Generic, TypeVar

import numpy as np
from pydantic import Field

from detectors.findings.clusters import nested_clusters
from detectors.findings.measure import HoleModelConfig, centres_of, measure_detection
from detectors.interface import Detection, Detector, Evidence, Measurement
from detectors.masks import on_grid as on_grid
from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM, Cloud


class ScoreMapConfig(Config):
    """Settings that turn a score map into detections. Pixels above the threshold form one
    detection if a chain of steps of at most ``cluster_distance_mm`` joins them; groups of fewer
    than ``min_points`` are dropped."""

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

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        """Return clusters of pixels whose score is above the threshold, strongest first."""
        return self.findings(cloud, evidence, [threshold])[0].detections

    def findings(
        self, cloud: Cloud, evidence: Evidence, thresholds: Sequence[float]
    ) -> list[Findings]:
        """Return the result of `find` at each of several rising thresholds."""
        pixels = above(evidence, thresholds[0])
        pixels = pixels[cloud.valid.reshape(-1)[pixels]]
        points = cloud.points_m.reshape(-1, 3)[pixels]
        scores = evidence.score.reshape(-1)[pixels]
        found = []
        for labels, strengths in zip(
            *self._clusters(self.places(points), scores, thresholds), strict=True
        ):
            count = int(labels.max(initial=-1)) + 1
            found.append(
                Findings(strengths[:count], pixels, labels, centres_of(points, labels, count))
            )
        return found

    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        """Return the exact lowest threshold at which `find` returns nothing; 0 if it never returns
        anything."""
        pixels = above(evidence, 0.0)
        pixels = pixels[cloud.valid.reshape(-1)[pixels]]
        scores = evidence.score.reshape(-1)[pixels]
        least = self.settings.min_points
        if least == 1:
            return float(scores.max(initial=0.0))
        # try the highest scores first: they usually contain a cluster
        for count in (64 * least, len(pixels)):
            highest = np.argsort(-scores, kind="stable")[:count]
            places = self.places(cloud.points_m.reshape(-1, 3)[pixels[highest]])
            _, strengths = self._clusters(places, scores[highest], [0.0])
            if strengths.max(initial=0.0) > 0.0:
                return float(strengths.max())
        return 0.0

    def places(self, points_m: np.ndarray) -> np.ndarray:
        """Return the places (n, 3) of points (n, 3); the distances between places decide which
        points are joined."""
        return points_m

    def _clusters(
        self, places_m: np.ndarray, scores: np.ndarray, thresholds: Sequence[float]
    ) -> tuple[np.ndarray, np.ndarray]:
        distance_m = self.settings.cluster_distance_mm * MM
        return nested_clusters(
            places_m, scores, distance_m, self.settings.min_points, np.array(thresholds)
        )

    def measure(self, cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
        """Measure the thesis' extents and fit the model of a blurred hole."""
        return measure_detection(cloud, evidence, detection, self.settings.hole_model)


@dataclass(frozen=True)
class Findings:
    """Detections at one threshold: ``scores`` (k,). ``pixels`` (n,): flat, ascending. ``labels``
    (n,): the number of the detection that has each pixel, -1 for none. ``centres_m`` (k, 3)."""

    scores: np.ndarray
    pixels: np.ndarray
    labels: np.ndarray
    centres_m: np.ndarray

    @classmethod
    def of(cls, detections: Sequence[Detection]) -> Findings:
        """Convert detections to arrays."""
        numbers = np.repeat(
            np.arange(len(detections)), [len(detection.pixels) for detection in detections]
        )
        pixels = np.concatenate(
            [np.zeros(0, np.int64), *(detection.pixels for detection in detections)]
        )
        centres = np.array([detection.centre_m for detection in detections]).reshape(-1, 3)
        return cls(
            np.array([detection.score for detection in detections]), pixels, numbers, centres
        )

    @property
    def detections(self) -> tuple[Detection, ...]:
        """The arrays as single detections, strongest first."""
        by_label = np.argsort(self.labels, kind="stable")
        counts = np.bincount(self.labels + 1, minlength=len(self.scores) + 1)
        _, *groups = np.split(self.pixels[by_label], np.cumsum(counts)[:-1])
        of_each = zip(self.scores.tolist(), groups, self.centres_m, strict=True)
        found = (Detection(score, pixels, centre) for score, pixels, centre in of_each)
        return tuple(
            sorted(found, key=lambda detection: (-detection.score, int(detection.pixels[0])))
        )


def findings_at(
    detector: Detector, cloud: Cloud, evidence: Evidence, thresholds: Sequence[float]
) -> list[Findings]:
    """Return a detector's detections at each of several rising thresholds."""
    own = next(vars(each) for each in type(detector).__mro__ if "find" in vars(each))
    if "findings" in own:
        return list(own["findings"](detector, cloud, evidence, thresholds))
    return [Findings.of(detector.find(cloud, evidence, threshold)) for threshold in thresholds]


def above(evidence: Evidence, threshold: float) -> np.ndarray:
    """Return the flat indices, ascending, of the pixels whose score exceeds the threshold."""
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(evidence.score.reshape(-1) > threshold)
