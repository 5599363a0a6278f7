"""Running a plan: renders feed trials, hole-free trials calibrate thresholds, the trials that are judged use them. What
is finished is in the journal; what the journal holds is not run again."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from harness.engine import workers
from harness.engine.examples import examples_of
from harness.engine.journal import Journal, without_nan
from harness.engine.map_examples import map_examples_of
from harness.engine.plan import Group, Plan, RenderJob
from harness.engine.trial import Record, Role, TrialTask, run_trial
from harness.evaluation.pod.false_calls import threshold_for_rate
from harness.experiment.points import Point
from harness.report.example import ExampleCloud
from harness.report.views_example import MappedExample
from harness.vocabulary.errors import UserError

FAILURE_CHARACTERS = 4000
"""Of a traceback, its end."""


@dataclass(frozen=True)
class Failure:
    """A trial that raised: what it was, and why: a message, or of a bug the end of its traceback."""

    what: str
    why: str
    is_bug: bool = False

    @property
    def in_short(self) -> str:
        """One line: of a bug what the traceback ends with."""
        return self.why.strip().splitlines()[-1] if self.is_bug else self.why


@dataclass
class Outcome:
    """What a run gave: records by journal key, failures, and what was done anew or found finished."""

    records: dict[str, Record] = field(default_factory=dict)
    failures: list[Failure] = field(default_factory=list)
    thresholds: dict[str, float] = field(default_factory=dict)
    examples: list[ExampleCloud | MappedExample] = field(default_factory=list)
    renders_done: int = 0
    renders_cached: int = 0
    render_seconds: float = 0.0
    trials_done: int = 0
    trials_resumed: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Progress:
    """How far a run is: finished and planned counts of renders and trials."""

    renders: int
    renders_total: int
    trials: int
    trials_total: int


@dataclass(frozen=True)
class _Render:
    job: RenderJob


@dataclass(frozen=True)
class _Examples:
    group: int


@dataclass(frozen=True)
class _Trial:
    key: str
    group: int
    batch: int
    role: Role


MOST_RENDERERS = 2
"""Processes that render, of 2 GB each."""


def run_plan(plan: Plan, journal: Journal, jobs: int, report: Callable[[Progress], None]) -> Outcome:
    """Run what is not finished. Raises UserError where nothing can be rendered or written; a single trial's error
    becomes a `Failure`. KeyboardInterrupt passes through: finished trials are in the journal."""
    began = time.perf_counter()
    with workers.pool(min(jobs, MOST_RENDERERS)) as renderer, workers.pool(jobs) as trial_pool:
        state = _Run(plan, journal, renderer, trial_pool, report)
        state.start()
        while state.pending:
            done, _ = wait(state.pending, return_when=FIRST_COMPLETED)
            for future in done:
                state.finish(future)
    state.outcome.seconds = time.perf_counter() - began
    return state.outcome


class _Run:
    """The state of one run: what is pending, what each group still waits for."""

    def __init__(
        self,
        plan: Plan,
        journal: Journal,
        renderer: ProcessPoolExecutor,
        trial_pool: ProcessPoolExecutor,
        report: Callable[[Progress], None],
    ) -> None:
        self.plan = plan
        self.journal = journal
        self.renderer = renderer
        self.trial_pool = trial_pool
        self.report = report
        self.outcome = Outcome()
        self.pending: dict[Future[Any], _Render | _Trial | _Examples] = {}
        self._waiting: dict[Path, list[tuple[int, int]]] = {}
        """Which batches, as (group, batch), wait for a render."""
        self._renders_missing: dict[tuple[int, int], set[Path]] = {}
        self._trials_missing: dict[tuple[int, int], set[str]] = {}
        """Of batches that have begun."""
        self._calibrated = [False for _ in plan.groups]
        self._quiet: dict[str, list[tuple[float, float]]] = {}
        """Of each point, the quiet threshold and the judged area of its hole-free runs."""
        for number, group in enumerate(plan.groups):
            for place, batch in enumerate(group.batches):
                paths = {job.path for job in batch.renders}
                self._renders_missing[number, place] = paths
                for path in paths:
                    self._waiting.setdefault(path, []).append((number, place))

    def start(self) -> None:
        """Submit every render; a group's trials follow when all its views are there."""
        for job in self.plan.renders:
            arguments = (job.target.to_data(), job.camera.to_data(), job.config.to_data(), str(job.folder))
            self.pending[self.renderer.submit(workers.render, *arguments)] = _Render(job)
        for number, group in enumerate(self.plan.groups):
            if not group.first:
                self._calibrate(number)
        self._tell()

    def finish(self, future: Future[Any]) -> None:
        """Take one result and submit what it makes possible."""
        work = self.pending.pop(future)
        try:
            result = future.result()
        except BrokenProcessPool as error:
            raise UserError(
                "a worker process died" + (" while rendering" if isinstance(work, _Render) else ""),
                legal="workers need about 1 GB of memory each, the render 2 GB",
                fix="run the same command again (finished trials are kept), with fewer --jobs if memory is short",
            ) from error
        except UserError as error:
            if isinstance(work, _Render):
                raise
            self._failed(work, error.message)
            return
        except Exception as error:
            # A bug in one trial costs that trial; its traceback (the worker's, as text) goes into the failures.
            if isinstance(work, _Render):
                raise
            self._failed(work, "".join(traceback.format_exception(error))[-FAILURE_CHARACTERS:], is_bug=True)
            return
        if isinstance(work, _Render):
            self._rendered(work.job, *result)
        elif isinstance(work, _Examples):
            self.outcome.examples += result
        else:
            record = without_nan(result)
            self.journal.write(work.key, record)
            self.outcome.trials_done += 1
            self._keep(work, record)
            self._trial_over(work)

    def _failed(self, work: _Trial | _Examples, why: str, *, is_bug: bool = False) -> None:
        what = work.key if isinstance(work, _Trial) else f"example clouds of set-up {work.group}"
        self.outcome.failures.append(Failure(what, why, is_bug))
        if isinstance(work, _Trial):
            self._trial_over(work)

    def _rendered(self, job: RenderJob, found: bool, seconds: float) -> None:
        self.outcome.renders_cached += found
        self.outcome.renders_done += not found
        self.outcome.render_seconds += 0.0 if found else seconds
        for number, place in self._waiting.pop(job.path, ()):
            self._renders_missing[number, place].discard(job.path)
            self._begin_if_ready(number, place)
        self._tell()

    def _begin_if_ready(self, number: int, place: int) -> None:
        """A batch begins once, when its views are there and, where it is judged, its points have their thresholds."""
        judged = place >= len(self.plan.groups[number].first)
        if self._renders_missing[number, place] or (number, place) in self._trials_missing:
            return
        if not judged or self._calibrated[number]:
            self._begin(number, place)

    def _begin(self, number: int, place: int) -> None:
        """Submit a batch's trials, or take them from the journal."""
        group = self.plan.groups[number]
        batch = group.batches[place]
        missing = self._trials_missing[number, place] = set()
        todo: list[tuple[_Trial, TrialTask]] = []
        for key, task in group.trials(batch, self.outcome.thresholds):
            work = _Trial(key, number, place, batch.role)
            stored = self.journal.read(key)
            if stored is None:
                missing.add(key)
                todo.append((work, task))
            else:
                self.outcome.trials_resumed += 1
                self._keep(work, stored)
        for work, task in todo:
            self.pending[self.trial_pool.submit(run_trial, task)] = work
        if not todo:
            self._batch_over(number, place)

    def _keep(self, work: _Trial, record: Record) -> None:
        self.outcome.records[work.key] = record
        if work.batch < len(self.plan.groups[work.group].first):
            for run in record["runs"]:
                if run["quiet_threshold"] is not None:
                    known = (run["quiet_threshold"], run.get("inspected_m2", np.nan))
                    self._quiet.setdefault(run["point"], []).append(known)

    def _trial_over(self, work: _Trial) -> None:
        missing = self._trials_missing[work.group, work.batch]
        missing.discard(work.key)
        self._tell()
        if not missing:
            self._batch_over(work.group, work.batch)

    def _batch_over(self, number: int, place: int) -> None:
        """After the batches that set thresholds the judged ones begin; after those there are pictures to make."""
        group = self.plan.groups[number]
        if place < len(group.first):
            if self._over(number, range(len(group.first))):
                self._calibrate(number)
        elif not group.is_study and self._over(number, range(len(group.first), len(group.batches))):
            future = self.trial_pool.submit(_examples_of, group, self.outcome.thresholds)
            self.pending[future] = _Examples(number)

    def _over(self, number: int, places: range) -> bool:
        """Whether all trials of these batches have ended."""
        return all(self._trials_missing.get((number, place)) == set() for place in places)

    def _calibrate(self, number: int) -> None:
        """Each point's threshold; then what is judged by it begins."""
        group = self.plan.groups[number]
        for point in group.points:
            found = self._threshold_of(point)
            if found is not None:
                self.outcome.thresholds[point.digest] = found
        if any(point.digest in self.outcome.thresholds for point in group.points):
            self._calibrated[number] = True
            for place in range(len(group.first), len(group.batches)):
                self._begin_if_ready(number, place)

    def _threshold_of(self, point: Point) -> float | None:
        """A point's threshold; where failed trials left too few runs, or none, that is a failure of its own."""
        try:
            found = threshold_of(point, self._quiet.get(point.digest, []))
        except UserError as error:
            if not self.outcome.failures:
                raise
            self.outcome.failures.append(Failure(f"threshold of {point.label}", error.message))
            return None
        if found is None:
            self.outcome.failures.append(Failure(f"threshold of {point.label}", "no hole-free run ended"))
        return found

    def _tell(self) -> None:
        o = self.outcome
        renders = o.renders_done + o.renders_cached
        trials = o.trials_done + o.trials_resumed + len(o.failures)
        self.report(Progress(renders, len(self.plan.renders), trials, self.plan.trial_count))


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


def _examples_of(group: Group, thresholds: dict[str, float]) -> Sequence[ExampleCloud | MappedExample]:
    return examples_of(group, thresholds) if group.poses is None else map_examples_of(group, thresholds)


def pending_counts(plan: Plan, journal: Journal) -> Iterator[tuple[str, int, int]]:
    """For a dry run: (what, planned, already there) for renders and hole-free trials."""
    renders = plan.renders
    yield "renders", len(renders), sum(job.path.exists() for job in renders)
    keys = [key for group in plan.groups for batch in group.first for key, _ in group.trials(batch, {})]
    yield "hole-free trials that set thresholds", len(keys), sum(journal.read(key) is not None for key in keys)
