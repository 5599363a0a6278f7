"""Running a plan: renders feed trials, hole-free trials calibrate thresholds, damaged trials use them. What is
finished is in the journal; what the journal holds is not run again."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.engine import workers
from harness.engine.examples import examples_of
from harness.engine.journal import Journal, without_nan
from harness.engine.map_examples import map_examples_of
from harness.engine.plan import Group, Plan, RenderJob
from harness.engine.trial import Record, Role, TrialTask, run_trial
from harness.report.example import ExampleCloud
from harness.report.views_example import MappedExample
from harness.vocabulary.errors import UserError

FAILURE_CHARACTERS = 4000
"""Of a traceback, its end."""


@dataclass(frozen=True)
class Failure:
    """A trial or render that raised: what it was, and why."""

    what: str
    why: str


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
    role: Role


def run_plan(plan: Plan, journal: Journal, jobs: int, report: Callable[[Progress], None]) -> Outcome:
    """Run what is not finished. Raises UserError where nothing can be rendered or written; a single trial's error
    becomes a `Failure`. KeyboardInterrupt passes through: finished trials are in the journal."""
    began = time.perf_counter()
    with workers.pool(1) as renderer, workers.pool(jobs) as trial_pool:
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
        self._views_missing = [{job.path for job in g.renders} for g in plan.groups]
        self._trials_missing: list[set[str]] = [set() for _ in plan.groups]
        self._quiet: dict[str, list[float]] = {}

    def start(self) -> None:
        """Submit every render; a group's trials follow when all its views are there."""
        for job in self.plan.renders:
            arguments = (job.target.to_data(), job.camera.to_data(), job.config.to_data(), str(job.folder))
            self.pending[self.renderer.submit(workers.render, *arguments)] = _Render(job)
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
            self._failed(work, "".join(traceback.format_exception(error))[-FAILURE_CHARACTERS:])
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

    def _failed(self, work: _Trial | _Examples, why: str) -> None:
        what = work.key if isinstance(work, _Trial) else f"example clouds of set-up {work.group}"
        self.outcome.failures.append(Failure(what, why))
        if isinstance(work, _Trial):
            self._trial_over(work)

    def _rendered(self, job: RenderJob, found: bool, seconds: float) -> None:
        self.outcome.renders_cached += found
        self.outcome.renders_done += not found
        self.outcome.render_seconds += 0.0 if found else seconds
        for number, group in enumerate(self.plan.groups):
            waiting = self._views_missing[number]
            if job.path in waiting:
                waiting.discard(job.path)
                if not waiting:
                    self._begin(number, group, "hole_free")
        self._tell()

    def _begin(self, number: int, group: Group, role: Role) -> None:
        """Submit a group's trials of a role, or take them from the journal."""
        todo: list[tuple[_Trial, TrialTask]] = []
        for key, task in group.trials(role, self.outcome.thresholds):
            work = _Trial(key, number, role)
            stored = self.journal.read(key)
            if stored is None:
                self._trials_missing[number].add(key)
                todo.append((work, task))
            else:
                self.outcome.trials_resumed += 1
                self._keep(work, stored)
        for work, task in todo:
            self.pending[self.trial_pool.submit(run_trial, task)] = work
        if not todo:
            self._role_over(number, role)

    def _keep(self, work: _Trial, record: Record) -> None:
        self.outcome.records[work.key] = record
        if work.role == "hole_free":
            for run in record["runs"]:
                self._quiet.setdefault(run["point"], []).append(run["quiet_threshold"])

    def _trial_over(self, work: _Trial) -> None:
        missing = self._trials_missing[work.group]
        missing.discard(work.key)
        self._tell()
        if not missing:
            self._role_over(work.group, work.role)

    def _role_over(self, number: int, role: Role) -> None:
        """After the hole-free trials each point has its threshold; then the damaged ones begin."""
        group = self.plan.groups[number]
        if role == "damaged":
            future = self.trial_pool.submit(_examples_of, group, self.outcome.thresholds)
            self.pending[future] = _Examples(number)
            return
        for point in group.points:
            given = point.config.threshold.k
            quiet = [value for value in self._quiet.get(point.digest, []) if value is not None]
            if given is not None:
                self.outcome.thresholds[point.digest] = given
            elif quiet:
                self.outcome.thresholds[point.digest] = float(np.max(quiet))
        if all(point.digest in self.outcome.thresholds for point in group.points):
            self._begin(number, group, "damaged")

    def _tell(self) -> None:
        o = self.outcome
        renders = o.renders_done + o.renders_cached
        trials = o.trials_done + o.trials_resumed + len(o.failures)
        self.report(Progress(renders, len(self.plan.renders), trials, self.plan.trial_count))


def _examples_of(group: Group, thresholds: dict[str, float]) -> Sequence[ExampleCloud | MappedExample]:
    return examples_of(group, thresholds) if group.poses is None else map_examples_of(group, thresholds)


def pending_counts(plan: Plan, journal: Journal) -> Iterator[tuple[str, int, int]]:
    """For a dry run: (what, planned, already there) for renders and hole-free trials."""
    renders = plan.renders
    yield "renders", len(renders), sum(job.path.exists() for job in renders)
    keys = [key for group in plan.groups for key, _ in group.trials("hole_free", {})]
    yield "hole-free trials", len(keys), sum(journal.read(key) is not None for key in keys)
