"""What a sweep would do, before it does it: what is there already, and what the rest would take in time and disk."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from harness.engine.calibration import Calibration
from harness.engine.console import duration
from harness.engine.costs import REFERENCE, Cost, render_cost, trial_cost
from harness.engine.journal import Entry, Journal
from harness.engine.opening import EngineOptions
from harness.engine.parts import Part, parts_of
from harness.engine.plan import Group, Plan, plan_of
from harness.engine.processes import MOST_RENDERERS
from harness.engine.rates import Rates, Stage, read_rates
from harness.engine.shard import Shard
from harness.experiment.points import Experiment
from harness.listing.text import size_text

START_S = 8.0
"""Until the first render and the first trial are under way: processes start, Mitsuba and numba load."""
REPORT_S = 6.0
"""Tables and report of a small experiment."""
REPORT_TRIAL_S = 2e-3
"""More of both, a trial."""
RESULTS_BYTES = 1_000_000
"""Report and tables of a small experiment; mostly its pictures."""
RESULTS_RECORD_SHARE = 0.15
"""More of both, of the records: tables are compressed."""
FILE_BYTES = 4096
"""A file takes whole blocks of the disk."""
READ_AT_MOST = 5000
"""Records that are read to tell whether they still count; of more, that they are there must do."""


@dataclass(frozen=True)
class Estimate:
    """Counts of what there is to do; seconds of work by stage, and by the clock on so many processes; bytes.

    ``renders``: distinct views of the whole plan, ``cached`` of them stored, ``to_render`` needed by trials that are
    missing. ``found``: trials that the journal holds. ``trials_known``: False where judged trials cannot be looked for
    yet, as their thresholds are not set. ``learnt``: runs of this machine on which render and trial times rest.
    """

    points: int
    groups: int
    renders: int
    cached: int
    to_render: int
    trials: int
    found: int
    trials_known: bool
    render_s: float
    trial_s: float
    wall_s: float
    render_bytes: float
    record_bytes: float
    result_bytes: float
    learnt: tuple[int, int]
    jobs: int
    is_cluster: bool = False

    @property
    def to_run(self) -> int:
        """Trials that are missing."""
        return self.trials - self.found

    def lines(self) -> list[str]:
        """The same as text."""
        searched = "" if self.trials_known else "; judged ones are looked for once thresholds are set"
        lines = [
            f"{_count(self.points, 'point')}, {_count(self.groups, 'set')} of frames",
            f"renders: {self.renders}, {self.cached} of them cached, {self.to_render} to do",
            f"trials: {self.trials}, {self.found} of them in the journal, {self.to_run} to do{searched}",
        ]
        if not self.to_render and not self.to_run:
            return [*lines, "nothing to run; the report is written anew"]
        where = _count(self.jobs, "worker" if self.is_cluster else "process", "es" * (not self.is_cluster) or "s")
        renders, trials = (_work_text(value) for value in (self.render_s, self.trial_s))
        disk = ", ".join(
            f"{name} {size_text(value)}"
            for name, value in (
                ("renders", self.render_bytes),
                ("journal", self.record_bytes),
                ("results", self.result_bytes),
            )
        )
        return [
            *lines,
            f"time: about {duration(self.wall_s)} on {where} (work: renders {renders}, trials {trials})",
            f"disk: about {size_text(self.render_bytes + self.record_bytes + self.result_bytes)} more ({disk})",
            f"measured: {self._basis()}; expect a factor of 2",
        ]

    def _basis(self) -> str:
        """What the times rest on."""
        needed = {"renders": self.to_render, "trials": self.to_run}
        known = {stage: runs for (stage, count), runs in zip(needed.items(), self.learnt, strict=True) if count}
        told = {stage: f"{_count(runs, 'run')} of this machine" if runs else REFERENCE for stage, runs in known.items()}
        if len(set(told.values())) == 1:
            return next(iter(told.values()))
        return ", ".join(f"{stage} {text}" for stage, text in told.items())


def dry_run(experiment: Experiment, out: Path, options: EngineOptions) -> int:
    """Say what a sweep would run and what that would take; nothing is written."""
    folder, cache = experiment.folder(out), Path(out) / ".cache"
    plan = plan_of(experiment, cache / "renders")
    found = estimate(plan, len(experiment.points), Journal(folder / "journal"), read_rates(cache), options)
    print(f"{experiment.config.name}: valid" + ("" if options.shard.is_whole else f"; shard {options.shard}"))
    for line in found.lines():
        print(f"  {line}")
    print(f"  results would go to {folder}")
    return 0


def estimate(plan: Plan, points: int, journal: Journal, rates: Rates, options: EngineOptions) -> Estimate:
    """What is there of a plan (or of the shard of it), and what the rest takes."""
    work = _missing(plan, options.shard, _Records(journal, options.retry_failed))
    jobs = 1 if options.serial else options.jobs
    needed = {job.path: job for part, _ in work.missing for job in part.renders}
    to_render = [job for job in needed.values() if not job.path.exists()]
    renders = [render_cost(job) for job in to_render]
    trials = [trial_cost(plan.groups[p.group], p.batch, jobs).times(count) for p, count in work.missing]
    render_s, trial_s = _seconds(rates, "renders", renders), _seconds(rates, "trials", trials)
    found_bytes = sum(one.size_bytes * rates.ratio("records", one.kind) for one in trials)
    count = sum(count for _, count in work.missing)
    return Estimate(
        points=points,
        groups=len(plan.groups),
        renders=len(plan.renders),
        cached=sum(job.path.exists() for job in plan.renders),
        to_render=len(to_render),
        trials=work.total,
        found=work.total - count,
        trials_known=work.known,
        render_s=render_s,
        trial_s=trial_s,
        wall_s=_by_the_clock(render_s, trial_s, work.total, jobs, options),
        render_bytes=sum(one.size_bytes for one in renders),
        record_bytes=found_bytes + count * FILE_BYTES / 2,
        result_bytes=RESULTS_BYTES + RESULTS_RECORD_SHARE * found_bytes,
        learnt=(
            rates.runs("renders", {one.kind for one in renders}),
            rates.runs("trials", {one.kind for one in trials}),
        ),
        jobs=jobs,
        is_cluster=options.scheduler is not None,
    )


def _seconds(rates: Rates, stage: Stage, costs: Iterable[Cost]) -> float:
    return sum(one.seconds * rates.ratio(stage, one.kind) for one in costs)


def _by_the_clock(render_s: float, trial_s: float, trials: int, jobs: int, options: EngineOptions) -> float:
    """Renders and trials share the machine's cores and go on beside each other, each on processes of its own."""
    report_s = REPORT_S + REPORT_TRIAL_S * trials if options.shard.is_whole else 0.0
    if options.serial:
        return START_S + render_s + trial_s + report_s
    if options.scheduler is not None:
        return START_S + (render_s + trial_s) / jobs + report_s
    cores = os.cpu_count() or 1
    renderers, workers = min(jobs, MOST_RENDERERS), jobs
    longest = max(
        render_s / min(renderers, cores),
        trial_s / min(workers, cores),
        (render_s + trial_s) / min(renderers + workers, cores),
    )
    return START_S + longest + report_s


# ---------------------------------------------------------------- what is there


@dataclass(frozen=True)
class _Missing:
    """Parts of a plan with how many of their trials the journal lacks."""

    missing: list[tuple[Part, int]]
    total: int
    known: bool


class _Records:
    """What the journal holds, as the engine will take it."""

    def __init__(self, journal: Journal, retry_failed: bool) -> None:
        self._journal, self._retry_failed = journal, retry_failed
        self._there = {key for key, _ in journal.entries()}

    def __bool__(self) -> bool:
        return bool(self._there)

    def entry(self, key: str) -> Entry | None:
        """How a trial ended, where it is not run again."""
        entry = self._journal.read(key) if key in self._there else None
        if entry is None or entry.state == "skipped" or (self._retry_failed and entry.state != "done"):
            return None
        return entry

    def is_over(self, key: str) -> bool:
        """Whether a trial is not run again; of very many, whether it is there."""
        return key in self._there if len(self._there) > READ_AT_MOST else self.entry(key) is not None


def _missing(plan: Plan, shard: Shard, records: _Records) -> _Missing:
    first, then = parts_of(plan, shard)
    parts = [part for group in (*first, *then) for part in group]
    total = sum(part.count for part in parts)
    if not records:
        return _Missing([(part, part.count) for part in parts], total, True)
    missing, known = [], True
    for group, own, judged in zip(plan.groups, first, then, strict=True):
        keys = [(part, _keys(group, part, {})) for part in own]
        thresholds = _thresholds(group, [key for _, found in keys for key in found], records)
        if thresholds is None:
            known &= not judged
            keys += [(part, []) for part in judged]
        else:
            keys += [(part, _keys(group, part, thresholds)) for part in judged]
        for part, wanted in keys:
            absent = part.count - sum(records.is_over(key) for key in wanted)
            if absent:
                missing.append((part, absent))
    return _Missing(missing, total, known)


def _keys(group: Group, part: Part, thresholds: dict[str, float]) -> list[str]:
    return [key for key, _ in group.trials(part.batch, thresholds, part.repeats)]


def _thresholds(group: Group, keys: list[str], records: _Records) -> dict[str, float] | None:
    """The thresholds that the journal's hole-free trials set; None while any of these is missing."""
    calibration = Calibration(group)
    for key in keys:
        entry = records.entry(key)
        if entry is None:
            return None
        if entry.record is not None:
            calibration.add(key, entry.record["runs"])
    return calibration.thresholds()[0]


def _count(number: int, what: str, plural: str = "s") -> str:
    return f"{number} {what}" + ("" if number == 1 else plural)


def _work_text(seconds: float) -> str:
    return duration(seconds) if seconds else "none"
