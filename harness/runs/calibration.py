"""Thresholds of detectors: set by hole-free trials, stored in the journal, shared by shards.

Each shard calibrates its own thresholds, and different processors give slightly different last
digits. So the journal stores the thresholds in use; after a merge, trials judged within `AGREES`
of them count as judged at them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isclose
from typing import Any

import numpy as np

from harness.evaluation.peaks import threshold_from_peaks
from harness.experiment.schema import Point
from harness.runs.jobs import Ended, Failure
from harness.runs.journal import THRESHOLDS, Journal, record_text
from harness.runs.plan import Group
from harness.trials.judge import FINDING_OCTAVES, PIXEL_OCTAVES, grid
from harness.trials.trial import Trial
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from harness.vocabulary.seeds import canonical_json, digest

NOTHING = 0.1
"""A camera that allows no threshold sees nothing if at most this share of a board's face is
judged."""
AGREES = 1e-3
"""Relative difference of equal thresholds: below a tenth of the standard error of one from twenty
boards."""


@dataclass(frozen=True)
class QuietRun:
    """A hole-free run."""

    threshold: float
    """Lowest threshold without a finding."""
    area_m2: float
    """Judged area."""
    peaks: tuple[float, ...] = ()
    """Scores of the strongest findings, highest first; empty outside studies."""


Quiet = dict[str, dict[str, QuietRun]]
"""Hole-free runs by point digest, then by trial key."""


class Calibration:
    """Derives the thresholds of one group's points from hole-free trials, added in any order."""

    def __init__(self, group: Group, quiet: Quiet) -> None:
        self._group = group
        self._quiet = quiet
        """Shared by all groups, as groups that differ only in the damage share these trials."""
        self.unlearned: set[str] = set()
        """Digests of points whose detector failed to learn: they get no threshold, not even a
        given one."""

    def add(self, key: str, runs: Sequence[Mapping[str, Any]]) -> None:
        """Add the ``runs`` rows of one trial."""
        for run in runs:
            quiet_threshold = run["quiet_threshold"]
            if quiet_threshold is not None:
                area_m2 = run.get("inspected_m2", np.nan)
                quiet = QuietRun(quiet_threshold, area_m2, tuple(run.get("peaks") or ()))
                self._quiet.setdefault(run["point"], {})[key] = quiet

    def thresholds(self) -> tuple[dict[str, float], list[Failure]]:
        """Return thresholds by point digest; and a failure for each point that has none."""
        thresholds: dict[str, float] = {}
        failures: list[Failure] = []
        for point in self._group.points:
            try:
                threshold = self._threshold(point)
            except UserError as error:
                failures.append(Failure(f"threshold of {point.label}", str(error)))
            else:
                thresholds[point.digest] = threshold
        return thresholds, failures

    def _threshold(self, point: Point) -> float:
        """Return a point's threshold. Raises UserError with the reason if there is none."""
        if point.digest in self.unlearned:
            raise UserError("its detector has learned nothing")
        quiet = self._quiet.get(point.digest, {})
        threshold = threshold_of(point, [quiet[key] for key in sorted(quiet)])
        if threshold is None:
            raise UserError("no hole-free run ended")
        return threshold

    def sets(self, own_thresholds: Mapping[str, float], journal: Journal) -> list[dict[str, float]]:
        """Return sets of thresholds that agree with ``own_thresholds``; the first is to be used.

        It is ``own_thresholds`` unless the journal stores only others that agree."""
        stored = [
            thresholds for thresholds in self._stored(journal) if _agree(thresholds, own_thresholds)
        ]
        own = dict(own_thresholds)
        if own not in stored and stored:
            return stored
        return [own, *(thresholds for thresholds in stored if thresholds != own)]

    def _stored(self, journal: Journal) -> Iterator[dict[str, float]]:
        """Yield the sets of thresholds in the journal that are based on the added trials."""
        prefix = self._prefix()
        if not prefix:
            return
        for key in journal.thresholds():
            entry = journal.read(key) if key.startswith(prefix) else None
            if entry is not None and entry.record is not None:
                yield {name: float(value) for name, value in entry.record.items()}

    def store(self, thresholds: Mapping[str, float], journal: Journal) -> None:
        """Store the thresholds at which this process judges, if trials set them."""
        prefix = self._prefix()
        key = f"{prefix}{digest(dict(thresholds))}"
        if prefix and thresholds and journal.state(key) is None:
            journal.write(key, Ended("done", canonical_json(dict(thresholds))))

    def _prefix(self) -> str:
        """Return the prefix of the keys of thresholds that are based on the added trials; empty
        without such trials."""
        keys: set[str] = set()
        for point in self._group.points:
            keys.update(self._quiet.get(point.digest, ()))
        return f"{THRESHOLDS}{digest(sorted(keys))}-" if keys else ""


def _agree(first: Mapping[str, float], second: Mapping[str, float]) -> bool:
    """Return whether two sets have the same points with equal thresholds, within `AGREES`."""
    if first.keys() != second.keys():
        return False
    return all(isclose(first[name], second[name], rel_tol=AGREES) for name in second)


def refiled(entry: Ended, judged: Trial, task: Trial) -> Ended:
    """Return a trial's entry with the thresholds of ``task``, which agree with those at which it
    was judged."""
    new = {(point.variant, point.frames): point.criteria.threshold for point in task.points}
    old = {(point.variant, point.frames): point.criteria.threshold for point in judged.points}
    octaves = {"operating": FINDING_OCTAVES, "pixels": PIXEL_OCTAVES}
    record = entry.record or {}
    for table, rows in record.items():
        for row in rows:
            point_key = (row.get("variant"), row.get("frames"))
            threshold = new.get(point_key)
            if threshold is None or old.get(point_key) is None or row.get("threshold") is None:
                continue
            if table not in octaves:
                row["threshold"] = threshold
            elif len(row["threshold"]) > 1:
                row["threshold"] = grid(threshold, octaves[table]).tolist()
            else:
                row["threshold"] = [threshold]
    return replace(entry, value=record_text(record))


def threshold_of(point: Point, quiet: Iterable[QuietRun]) -> float | None:
    """Return a point's threshold: given, or from its hole-free runs; None without runs.

    The threshold is the runs' highest quiet threshold or, in a study, the one for the wanted rate
    of false calls. Raises UserError."""
    given_k = point.config.threshold.k
    calibrate = point.config.threshold.calibrate
    runs = list(quiet)
    if given_k is not None or not runs:
        return given_k
    if calibrate is None or calibrate.false_calls_per_m2 is None:
        return max(run.threshold for run in runs)
    area_m2 = float(np.mean([run.area_m2 for run in runs]))
    if not area_m2 > 0:
        detector = point.config.detector.name
        message = f"the detector {detector!r} gave no score to any pixel of the hole-free boards"
        raise UserError(message, fix="check its crop against the boards' poses")
    try:
        # a run without a finding has no peak, but a threshold above which it has none
        peaks = [run.peaks or (run.threshold,) for run in runs]
        return threshold_from_peaks(peaks, area_m2, calibrate.false_calls_per_m2).value
    except UserError as error:
        board = point.config.simulated.target.declare().board
        inspected_share = area_m2 / (board.width_mm * board.height_mm * MM**2)
        if inspected_share > NOTHING:
            raise
        percent = f"{100 * inspected_share:.2g} %"
        message = f"the camera sees nothing of the board here but {percent} of its face"
        raise UserError(f"{message}, too little for a threshold") from error
