"""A detector as somebody else would write it, which learns the noise of hole-free clouds and
scores by it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from detectors.interface import Evidence
from detectors.methods.thesis import ThesisConfig, ThesisDetector
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud


class LearningConfig(ThesisConfig):
    """``refuses``: whether it refuses to learn."""

    refuses: bool = False


class LearningDetector(ThesisDetector):
    """Residuals over the deviation of hole-free clouds, where it has learned it."""

    settings_type: ClassVar[type[LearningConfig]] = LearningConfig
    name = "learning"
    version = 1
    learned_m: float | None = None

    def calibrate(self, hole_free: Sequence[Cloud]) -> Mapping[str, np.ndarray]:
        if self.settings.refuses:
            raise UserError("these clouds teach nothing")
        scales_m = [super(LearningDetector, self).analyse(cloud).scale_m for cloud in hole_free]
        return {"scales_m": np.array(scales_m)}

    def calibrated(self, learned: Mapping[str, np.ndarray]) -> LearningDetector:
        taught = LearningDetector(self.settings)
        taught.learned_m = float(np.median(learned["scales_m"]))
        return taught

    def analyse(self, cloud: Cloud) -> Evidence:
        evidence = super().analyse(cloud)
        if self.learned_m is None:
            return evidence
        return replace(
            evidence, score=np.abs(evidence.residual_m) / self.learned_m, scale_m=self.learned_m
        )
