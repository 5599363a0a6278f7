"""From the hole-free trials of a group to its points' thresholds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from harness.engine.outcome import Failure
from harness.engine.plan import Group
from harness.evaluation.pod.false_calls import threshold_for_rate
from harness.experiment.points import Point
from harness.vocabulary.errors import UserError


class Calibration:
    """Collects what a group's hole-free trials found, in any order; the thresholds do not depend on it."""

    def __init__(self, group: Group) -> None:
        self._group = group
        self._quiet: dict[str, dict[str, tuple[float, float]]] = {}
        """By point, then by trial: the quiet threshold and the judged area in m2."""

    def add(self, key: str, runs: Sequence[Mapping[str, Any]]) -> None:
        """The rows ``runs`` of one trial."""
        for run in runs:
            if run["quiet_threshold"] is not None:
                area_m2 = run.get("inspected_m2", np.nan)
                self._quiet.setdefault(run["point"], {})[key] = (run["quiet_threshold"], area_m2)

    def thresholds(self) -> tuple[dict[str, float], list[Failure]]:
        """By point digest; and a failure for each point that has none."""
        found: dict[str, float] = {}
        failures: list[Failure] = []
        for point in self._group.points:
            quiet = self._quiet.get(point.digest, {})
            try:
                threshold = threshold_of(point, [quiet[key] for key in sorted(quiet)])
            except UserError as error:
                failures.append(Failure(f"threshold of {point.label}", str(error)))
                continue
            if threshold is None:
                failures.append(Failure(f"threshold of {point.label}", "no hole-free run ended"))
            else:
                found[point.digest] = threshold
        return found, failures


def threshold_of(point: Point, quiet: Sequence[tuple[float, float]]) -> float | None:
    """A point's threshold: given, or by its hole-free runs, (quiet threshold, judged area in m2) each: the highest of
    them, or in a study the one for the wanted rate of false calls. None where there is nothing to go by.

    Raises UserError as `threshold_for_rate` does.
    """
    given, calibrate = point.config.threshold.k, point.config.threshold.calibrate
    if given is not None or not quiet:
        return given
    thresholds, areas_m2 = np.array(quiet).T
    if calibrate is None or calibrate.false_calls_per_m2 is None:
        return float(thresholds.max())
    if not areas_m2.mean() > 0:
        message = f"the detector {point.config.detector.name!r} gave no score to any pixel of the hole-free boards"
        raise UserError(message, fix="check its crop against the boards' poses")
    return threshold_for_rate(thresholds, float(areas_m2.mean()), calibrate.false_calls_per_m2).value
