"""The estimate of a sweep before it runs: trials that are there already, and the rest's costs in time and disk."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from harness.engine.console import duration
from harness.engine.costs import REFERENCE, CostStage, Rates, WorkCost, read_rates, render_cost, trial_cost
from harness.engine.journal import Journal
from harness.engine.options import EngineOptions
from harness.engine.plan import Group, PlanPart, SweepPlan, parts_of, plan_of
from harness.engine.processes import MOST_RENDERERS
from harness.engine.shard import Shard
from harness.engine.thresholds import Calibration
from harness.experiment.points import Experiment
from harness.listing.text import size_text

START_S = 8.0
"""Seconds until the first render and the first trial are under way: processes start, Mitsuba and numba load."""
REPORT_S = 6.0
"""Tables and report of a small experiment."""
REPORT_TRIAL_S = 2e-3
"""More of both, a trial."""
RESULTS_BYTES = 1_000_000
"""Report and tables of a small experiment; mostly its pictures."""
RESULTS_RECORD_SHARE = 0.15
"""More of both, of the records: tables are compressed."""


@dataclass(frozen=True)
class SweepEstimate:
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
        """The measurements that the times rest on."""
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


def estimate(plan: SweepPlan, points: int, journal: Journal, rates: Rates, options: EngineOptions) -> SweepEstimate:
    """Count the finished trials of a plan (or of a shard of it), and estimate the rest."""
    missing, total, is_known = _missing(plan, options.shard, journal, options.retry_failed)
    jobs = 1 if options.serial else options.jobs
    needed = {job.path: job for part, _ in missing for job in part.batch.renders}
    to_render = [job for job in needed.values() if not job.path.exists()]
    renders = [render_cost(job) for job in to_render]
    trials = [trial_cost(plan.groups[p.group], p.batch, jobs).times(count) for p, count in missing]
    render_s, trial_s = _seconds(rates, "renders", renders), _seconds(rates, "trials", trials)
    found_bytes = sum(one.size_bytes * rates.ratio("records", one.kind) for one in trials)
    count = sum(count for _, count in missing)
    return SweepEstimate(
        points=points,
        groups=len(plan.groups),
        renders=len(plan.renders),
        cached=sum(job.path.exists() for job in plan.renders),
        to_render=len(to_render),
        trials=total,
        found=total - count,
        trials_known=is_known,
        render_s=render_s,
        trial_s=trial_s,
        wall_s=_by_the_clock(render_s, trial_s, total, jobs, options),
        render_bytes=sum(one.size_bytes for one in renders),
        record_bytes=found_bytes,
        result_bytes=RESULTS_BYTES + RESULTS_RECORD_SHARE * found_bytes,
        learnt=(
            rates.runs("renders", {one.kind for one in renders}),
            rates.runs("trials", {one.kind for one in trials}),
        ),
        jobs=jobs,
        is_cluster=options.scheduler is not None,
    )


def _seconds(rates: Rates, stage: CostStage, costs: Iterable[WorkCost]) -> float:
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


def _missing(
    plan: SweepPlan, shard: Shard, journal: Journal, retry_failed: bool
) -> tuple[list[tuple[PlanPart, int]], int, bool]:
    """Parts with how many of their trials the journal lacks; the number of all trials; and whether judged trials can be
    looked for: thresholds are known."""
    over = ("done",) if retry_failed else ("done", "failed", "crashed", "timed out")
    first, then = parts_of(plan, shard)
    total = sum(part.count for group in (*first, *then) for part in group)
    missing, is_known = [], True

    def lacks(group: Group, part: PlanPart, sets: list[dict[str, float]]) -> int:
        keys = zip(*([key for key, _ in group.trials(part.batch, one, part.repeats)] for one in sets), strict=True)
        return part.count - sum(any(journal.state(key) in over for key in alike) for alike in keys)

    for group, own, judged in zip(plan.groups, first, then, strict=True):
        absent = [(part, lacks(group, part, [{}])) for part in own]
        if any(count for _, count in absent):
            is_known &= not judged or not len(journal)
            absent += [(part, part.count) for part in judged]
        else:
            calibration = Calibration(group)
            for part in own:
                for key, _ in group.trials(part.batch, {}, part.repeats):
                    entry = journal.read(key)
                    if entry is not None and entry.record is not None:
                        calibration.add(key, entry.record["runs"])
            sets = calibration.sets(calibration.thresholds()[0], journal)
            absent += [(part, lacks(group, part, sets)) for part in judged]
        missing += [(part, count) for part, count in absent if count]
    return missing, total, is_known


def _count(number: int, what: str, plural: str = "s") -> str:
    return f"{number} {what}" + ("" if number == 1 else plural)


def _work_text(seconds: float) -> str:
    return duration(seconds) if seconds else "none"
