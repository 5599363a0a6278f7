"""Findings of a detector at each of several thresholds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detectors.interface import Detection, Detector, Evidence
from harness.vocabulary.geometry import Cloud


@dataclass(frozen=True)
class Findings:
    """Detections at one threshold, as arrays."""

    scores: np.ndarray
    """(k,): of each detection."""
    pixels: np.ndarray
    """(n,): flat indices into the cloud's grid, ascending."""
    labels: np.ndarray
    """(n,): the number of the detection that has each pixel, -1 for none."""
    centres_m: np.ndarray
    """(k, 3): of each detection, in the cloud's frame."""

    @classmethod
    def of(cls, detections: Sequence[Detection]) -> Findings:
        """Convert detections to arrays."""
        sizes = [len(detection.pixels) for detection in detections]
        no_pixels = np.zeros(0, np.int64)
        centres_m = np.array([detection.centre_m for detection in detections])
        return cls(
            scores=np.array([detection.score for detection in detections]),
            pixels=np.concatenate([no_pixels, *(detection.pixels for detection in detections)]),
            labels=np.repeat(np.arange(len(detections)), sizes),
            centres_m=centres_m.reshape(-1, 3),
        )

    @property
    def detections(self) -> tuple[Detection, ...]:
        """The arrays as single detections, strongest first."""
        by_label = np.argsort(self.labels, kind="stable")
        counts = np.bincount(self.labels + 1, minlength=len(self.scores) + 1)
        _, *groups = np.split(self.pixels[by_label], np.cumsum(counts)[:-1])
        detections = [
            Detection(score, pixels, centre_m)
            for score, pixels, centre_m in zip(
                self.scores.tolist(),
                groups,
                self.centres_m,
                strict=True,
            )
        ]
        detections.sort(key=lambda detection: (-detection.score, int(detection.pixels[0])))
        return tuple(detections)


def findings_at(
    detector: Detector,
    cloud: Cloud,
    evidence: Evidence,
    thresholds: Sequence[float],
) -> list[Findings]:
    """Return a detector's detections at each of several rising thresholds.

    A detector's own method ``findings`` does it at once, unless a subclass has overridden ``find``
    without it."""
    owner = next(vars(kind) for kind in type(detector).__mro__ if "find" in vars(kind))
    if "findings" in owner:
        return list(owner["findings"](detector, cloud, evidence, thresholds))
    return [Findings.of(detector.find(cloud, evidence, threshold)) for threshold in thresholds]


LEVELS = np.linspace(0.4, 0.95, 12)
"""Thresholds, as shares of the lowest at which nothing is found, at which peaks are sought."""


def highest_peaks(
    detector: Detector,
    cloud: Cloud,
    evidence: Evidence,
    *,
    quiet_threshold: float,
    count: int,
) -> tuple[float, ...]:
    """Return the scores of the strongest findings, highest first: at most ``count``, at the
    highest of `LEVELS` with so many findings. ``quiet_threshold``: at which there is none."""
    if not quiet_threshold > 0:
        return (quiet_threshold,)
    levels = (quiet_threshold * LEVELS).tolist()
    strongest: tuple[float, ...] = (quiet_threshold,)
    for findings in reversed(findings_at(detector, cloud, evidence, levels)):
        scores = np.sort(findings.scores)[::-1]
        if len(scores) > len(strongest):
            strongest = tuple(scores[:count].tolist())
        if len(scores) >= count:
            break
    return strongest


def above(evidence: Evidence, threshold: float) -> np.ndarray:
    """Return the flat indices, ascending, of the pixels whose score exceeds the threshold."""
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(evidence.score.reshape(-1) > threshold)
