"""The oracle: handed the truth, it finds each damage exactly once and nothing else, so that whatever a study says of it
beyond that is a fault of the study."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from detectors.interface import Detection, Evidence, Measurement, TrueDamage
from detectors.measure import measure_extents, on_pixels
from harness.vocabulary.capture import Cloud
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.units import MM

UNIT_M = 1.0 * MM
"""What one unit of its score is taken to be: the oracle's score is no length, and tables ask for one."""


class OracleConfig(Config):
    """The oracle has nothing to set."""


class Oracle:
    """Handed the truth: finds every damage once, at any threshold below 1, and nothing else.

    Implements `detectors.interface.ToldTheTruth`, and `detectors.interface.Detector` once it was told. Its findings are
    the truth as it stands, so a damage none of whose pixels has a range is found like any other.
    """

    settings_type: ClassVar[type[OracleConfig]] = OracleConfig
    name = "oracle"
    version = 1
    tests_the_harness = True

    def __init__(self, settings: OracleConfig, truth: tuple[TrueDamage, ...] | None = None) -> None:
        self.settings = settings
        self._truth = truth

    def told(self, truth: tuple[TrueDamage, ...]) -> Oracle:
        """The detector for one cloud with this truth; empty on a hole-free board."""
        return Oracle(self.settings, tuple(truth))

    def analyse(self, cloud: Cloud) -> Evidence:
        """Score 1 on the pixels of true damage, 0 on all others with a point; the surface is the cloud itself.

        Raises UserError where it was not told the truth, and where the cloud has no valid point.
        """
        truth = self._known()
        if not cloud.valid.any():
            raise UserError("the cloud has no valid point to judge", fix="check the capture")
        score = np.where(cloud.valid, 0.0, np.nan)
        for damage in truth:
            score.reshape(-1)[damage.pixels] = 1.0
        residual_m = np.where(cloud.valid, 0.0, np.nan)
        return Evidence(score, residual_m, cloud.points_m[..., 2].copy(), UNIT_M)

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        """The damages, in the truth's order, below a threshold of 1; nothing from 1 on."""
        if not threshold < 1.0:
            return ()
        return tuple(Detection(1.0, np.sort(damage.pixels), damage.centre_m) for damage in self._known())

    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        """1 where there is damage, 0 on a hole-free board."""
        return 1.0 if self._known() else 0.0

    def measure(self, cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
        """The true diameter and place as the extents; no model is fitted."""
        damage = next((one for one in self._known() if np.array_equal(one.centre_m, detection.centre_m)), None)
        if damage is None:
            raise ValueError("the detection is none of this oracle's")
        told = measure_extents(cloud, detection, "handed the truth")
        told = replace(told, extent_diameter_m=damage.diameter_m, extent_centre_m=damage.centre_m)
        return on_pixels(cloud, detection, told) if cloud.organised else told

    def _known(self) -> tuple[TrueDamage, ...]:
        if self._truth is None:
            raise UserError(
                "the detector 'oracle' was not told the truth: it tests studies on simulated boards, and finds nothing",
                fix="use it in an experiment with a simulated source, or choose another detector",
            )
        return self._truth
