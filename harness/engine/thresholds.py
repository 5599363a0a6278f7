"""Thresholds: set by hole-free trials, and shared by shards whose machines differ in the last digits.

Every shard calibrates for itself, and unlike processors give unlike last digits. So the journal stores the thresholds
that were used beside the trials, and a merge keeps all work: trials that were judged at a threshold which agrees with
the one in use to within `AGREES` count, filed under the one in use; others are judged anew.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from math import isclose
from typing import Any

import numpy as np

from harness.engine.journal import THRESHOLDS, Entry, Journal, record_text
from harness.engine.judge import FINDING_OCTAVES, PIXEL_OCTAVES, grid
from harness.engine.plan import Group
from harness.engine.trial import TrialTask
from harness.engine.work import Failure
from harness.evaluation.pod.false_calls import threshold_for_rate
from harness.experiment.points import Point
from harness.vocabulary.errors import UserError
from harness.vocabulary.seeds import canonical_json, digest

AGREES = 1e-3
"""Relative difference up to which two thresholds count as equal: a tenth or less of the standard error that a threshold
from some twenty boards has, and a thousand times what unlike processors were seen to differ by."""


class Calibration:
    """Collects the findings of a group's hole-free trials, in any order; the thresholds do not depend on it."""

    def __init__(self, group: Group) -> None:
        self._group = group
        self._quiet: dict[str, dict[str, tuple[float, float]]] = {}
        """Quiet thresholds by point, then by trial: the quiet threshold and the judged area in m2."""

    def add(self, key: str, runs: Sequence[Mapping[str, Any]]) -> None:
        """Add the rows ``runs`` of one trial."""
        for run in runs:
            if run["quiet_threshold"] is not None:
                area_m2 = run.get("inspected_m2", np.nan)
                self._quiet.setdefault(run["point"], {})[key] = (run["quiet_threshold"], area_m2)

    def thresholds(self) -> tuple[dict[str, float], list[Failure]]:
        """Thresholds by point digest; and a failure for each point that has none."""
        found: dict[str, float] = {}
        failures: list[Failure] = []
        for point in self._group.points:
            quiet = self._quiet.get(point.digest, {})
            why = "no hole-free run ended"
            try:
                threshold = threshold_of(point, [quiet[key] for key in sorted(quiet)])
            except UserError as error:
                threshold, why = None, str(error)
            if threshold is None:
                failures.append(Failure(f"threshold of {point.label}", why))
            else:
                found[point.digest] = threshold
        return found, failures

    def sets(self, own: Mapping[str, float], journal: Journal) -> list[dict[str, float]]:
        """The thresholds to use, then others that agree with them, at which shards have judged: ``own``, unless the
        journal has only others that agree. They rest on the same trials, done elsewhere."""
        prefix = self._prefix()
        stored = []
        for key in sorted(journal.thresholds):
            entry = journal.read(key) if prefix and key.startswith(prefix) else None
            if entry is not None and entry.record is not None and agree(entry.record, own):
                stored.append({name: float(value) for name, value in entry.record.items()})
        mine = [dict(own)] if dict(own) in stored or not stored else []
        return mine + [one for one in stored if one not in mine]

    def store(self, thresholds: Mapping[str, float], journal: Journal) -> None:
        """Store the thresholds by which this process judges, where they rest on trials."""
        prefix = self._prefix()
        key = f"{prefix}{digest(dict(thresholds))}"
        if prefix and thresholds and key not in journal.thresholds:
            journal.write(key, Entry("done", canonical_json(dict(thresholds))))

    def _prefix(self) -> str:
        """The beginning of the keys of thresholds that rest on the trials that were added; empty without any."""
        keys = sorted({key for trials in self._quiet.values() for key in trials})
        return f"{THRESHOLDS}{digest(keys)}-" if keys else ""


def agree(one: Mapping[str, Any], other: Mapping[str, float]) -> bool:
    """Return whether two sets of thresholds are of the same points and equal to within `AGREES`."""
    return one.keys() == other.keys() and all(isclose(one[name], other[name], rel_tol=AGREES) for name in one)


def refiled(entry: Entry, judged: TrialTask, task: TrialTask) -> Entry:
    """Return the entry of a trial that was judged at thresholds which agree with those of ``task``, with these in the
    place of the others in every row: tables sort by them."""
    given = zip(judged.points, task.points, strict=True)
    new = {(was.variant, was.frames): (was.threshold, now.threshold) for was, now in given}
    octaves = {"operating": FINDING_OCTAVES, "pixels": PIXEL_OCTAVES}
    record = json.loads(entry.text or "{}")
    for table, rows in record.items():
        for row in rows:
            was, now = new.get((row.get("variant"), row.get("frames")), (None, None))
            if was is None or now is None or "threshold" not in row:
                continue
            if table in octaves and len(row["threshold"]) > 1:
                row["threshold"] = grid(now, octaves[table]).tolist()
            elif table in octaves:
                row["threshold"] = [now]
            elif row["threshold"] is not None:
                row["threshold"] = now
    return replace(entry, text=record_text(record))


def threshold_of(point: Point, quiet: Iterable[tuple[float, float]]) -> float | None:
    """A point's threshold: given, or by its hole-free runs, (quiet threshold, judged area in m2) each: the highest of
    them, or in a study the one for the wanted rate of false calls. None where there is nothing to go by.

    Raises UserError as `threshold_for_rate` does.
    """
    given, calibrate, quiet = point.config.threshold.k, point.config.threshold.calibrate, list(quiet)
    if given is not None or not quiet:
        return given
    thresholds, areas_m2 = np.array(quiet).T
    if calibrate is None or calibrate.false_calls_per_m2 is None:
        return float(thresholds.max())
    if not areas_m2.mean() > 0:
        message = f"the detector {point.config.detector.name!r} gave no score to any pixel of the hole-free boards"
        raise UserError(message, fix="check its crop against the boards' poses")
    return threshold_for_rate(thresholds, float(areas_m2.mean()), calibrate.false_calls_per_m2).value
