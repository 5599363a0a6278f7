"""The run of a plan: renders feed trials, hole-free trials set thresholds, and judged trials use these. Every end is in
the journal; trials that the journal holds are not run again, and views that only they need are not rendered.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from harness.engine.journal import Entry, Journal, record_text
from harness.engine.pictures import pictures_of
from harness.engine.plan import PlanPart, RenderJob, SweepPlan, parts_of
from harness.engine.processes import render_into_cache
from harness.engine.shard import WHOLE, Shard
from harness.engine.thresholds import Calibration, refiled
from harness.engine.trial import TrialTask, run_trial
from harness.engine.work import Ended, Failure, Job, JobEngine, Outcome, Progress
from harness.vocabulary.errors import DiskFull
from scenes.render.cache import read_view

AHEAD = 4096
"""Trials that may wait to be run: enough for a thousand workers, and a few megabytes whatever the plan's size."""
RENDER_TRIES = 2
"""A render whose process died is begun once more: two of them may have been too much for the memory. So is a trial that
sets a threshold, since with another threshold all that was judged by it would be run again."""
PARTS_AT_ONCE = 200
"""Parts that are looked up in the journal before the engine is asked again: some 0.1 s."""
TOLD_WHOLE = 200
"""Failures whose traceback is kept in memory; of the others the journal has it."""


def run_plan(
    plan: SweepPlan,
    journal: Journal,
    engine: JobEngine,
    report: Callable[[Progress], None],
    *,
    shard: Shard = WHOLE,
    retry_failed: bool = False,
) -> Outcome:
    """Run the trials that the journal lacks, with ``retry_failed`` also those that are not done. A job that does not
    end well becomes a `Failure` and costs the trials that need it. Raises UserError where nothing can be written or the
    engine is gone; KeyboardInterrupt passes through: trials that ended are in the journal."""
    began = time.monotonic()
    state = _Run(plan, journal, engine, report, shard, retry_failed)
    try:
        while state.feed():
            for job, ended in engine.ended() if state.under_way else ():
                state.take(job, ended)
    finally:
        journal.sync()
    outcome = state.outcome
    if outcome.trials.over != outcome.trials.total:
        raise RuntimeError(f"trials were lost: {outcome.trials}")
    outcome.seconds = time.monotonic() - began
    outcome.finished.sort()
    outcome.examples = [one for number in sorted(state.examples) for one in state.examples[number]]
    outcome.failures.sort(key=lambda failure: failure.what)
    return outcome


def render_missing(jobs: Iterable[RenderJob], engine: JobEngine) -> list[Failure]:
    """Have views rendered that the cache lacks or holds damaged, for pictures of trials that are done. Returns a
    failure for each that could not be."""
    distinct = {job.path: job for job in jobs}
    waiting = deque(_render_job(job) for job in distinct.values() if read_view(job.path) is None)
    under_way, failures = 0, []
    while waiting or under_way:
        while waiting and engine.room("renders") > 0:
            engine.submit(waiting.popleft())
            under_way += 1
        for job, ended in engine.ended():
            under_way -= 1
            if ended.state != "done":
                failures.append(Failure(f"view {job.name} for a picture", ended.why, ended.is_bug, ended.state))
    return failures


def _render_job(job: RenderJob) -> Job:
    arguments = (job.target.to_data(), job.camera.to_data(), job.config.to_data(), str(job.folder))
    return Job(job.path.name, "renders", render_into_cache, arguments)


@dataclass(frozen=True)
class _Trial:
    part: PlanPart
    key: str
    task: TrialTask


class _Run:
    """The state of a run: the trials and renders that may begin, what they wait for, and how they ended."""

    def __init__(
        self,
        plan: SweepPlan,
        journal: Journal,
        engine: JobEngine,
        report: Callable[[Progress], None],
        shard: Shard,
        retry_failed: bool,
    ) -> None:
        self.outcome = Outcome()
        self.examples: dict[int, list[Any]] = {}
        """Pictures by group."""
        self.under_way: dict[str, _Trial | RenderJob | int] = {}
        """Jobs by name; a number is that of a group whose pictures are made."""
        self._groups = plan.groups
        self._journal, self._engine, self._report = journal, engine, report
        self._shard, self._retry_failed = shard, retry_failed
        self._first, self._then = parts_of(plan, shard)
        self._calibrations = [Calibration(group) for group in plan.groups]
        self._others: list[list[dict[str, float]]] = [[] for _ in plan.groups]
        """Thresholds, by group, that agree with those in use, at which other shards have judged."""
        self._tried: Counter[str] = Counter()
        """Number of times that the process of a render or of a calibrating trial died."""
        self._to_open: deque[PlanPart] = deque()
        self._queue: deque[_Trial] = deque()
        self._ahead = 0
        """Trials that are open and not begun."""
        self._waiting: dict[Path, list[PlanPart]] = {}
        """Parts by the views that they wait for."""
        self._pictures: deque[int] = deque()
        """Groups whose trials are over and whose pictures are not begun."""
        parts = [part for found in (*self._first, *self._then) for part in found]
        self._renders = {job.path: job for part in parts for job in part.batch.renders}
        self._users: Counter[Path] = Counter(path for part in parts for path in part.paths)
        """Parts that are not over, and pictures, by view: a view without any is not rendered."""
        self._there: set[Path] = set()
        self._lost: dict[Path, str] = {}
        self._asked: set[Path] = set()
        """Views that were wanted so far; those still to be rendered are ``_wanted``."""
        self._wanted: deque[Path] = deque()
        self._later: deque[Path] = deque()
        """Views that will be wanted once thresholds are set; rendered when nothing is wanted now."""
        self._prefetched: set[int] = set()
        """Groups whose judged views are among ``_later``."""
        self.outcome.renders.total = len(self._renders)
        self.outcome.trials.total = sum(part.count for part in parts)
        for number, first in enumerate(self._first):
            if first:
                self._to_open += shard.rotated(first)
            elif self._then[number]:  # needs no calibration
                self._calibrated(number)

    # ---------------------------------------------------------------- what begins

    def feed(self) -> bool:
        """Hand the engine jobs while it has room, and look a few more parts up. False where nothing is left to do."""
        for _ in range(PARTS_AT_ONCE):
            if not self._to_open or self._ahead >= AHEAD:
                break
            self._open(self._to_open.popleft())
        while self._engine.room("renders") > 0 and (path := self._next_render()) is not None:
            self._submit(_render_job(self._renders[path]), self._renders[path])
        while self._engine.room("trials") > 0 and (self._queue or self._pictures_ready()):
            self._submit_trial() if self._queue else self._submit_pictures()
        self._report(Progress(self.outcome.renders, self.outcome.trials))
        return bool(self.under_way or self._to_open or self._queue)

    def _submit(self, job: Job, work: _Trial | RenderJob | int) -> None:
        self.under_way[job.name] = work
        self._engine.submit(job)

    def _submit_trial(self) -> None:
        trial = self._queue.popleft()
        self._ahead -= 1
        if not self._shard.is_whole and trial.part.sets_threshold:
            # another shard with the same folder may have run it meanwhile
            self._journal.refresh()
            if self._found(trial.part, trial.key):
                self._trial_over(trial)
                return
        self._submit(Job(trial.key, "trials", trial_as_text, (trial.task,), trial.part.paths), trial)

    def _next_render(self) -> Path | None:
        if self._wanted:
            return self._wanted.popleft()
        while self._later:
            path = self._later.popleft()
            if path not in self._asked and self._users[path]:
                self._asked.add(path)
                return path
        return None

    def _want(self, paths: Iterable[Path]) -> set[Path]:
        """Ask for renders; returns those that are still missing."""
        for path in paths:
            if path not in self._asked:
                self._asked.add(path)
                self._wanted.append(path)
        return {path for path in paths if path not in self._there}

    def _pictures_ready(self) -> bool:
        """Return whether the views of the first group that waits for its pictures are there; lost ones are given up."""
        while self._pictures:
            paths = [job.path for job in self._groups[self._pictures[0]].damaged.renders]
            if not any(path in self._lost for path in paths):
                return all(path in self._there for path in paths)
            self._pictures.popleft()
        return False

    def _submit_pictures(self) -> None:
        number = self._pictures.popleft()
        group = self._groups[number]
        needs = tuple(job.path for job in group.damaged.renders)
        arguments = (group, self.outcome.thresholds)
        self._submit(Job(f"pictures of set-up {number}", "trials", pictures_of, arguments, needs), number)

    def _open(self, part: PlanPart) -> None:
        """Take from the journal what it holds of a part, and queue the rest once its views are there."""
        missing = [trial for trial in self._trials(part) if not self._found(part, trial.key)]
        part.left = len(missing)
        if not missing:
            self._part_over(part)
            return
        if part.sets_threshold and part.group not in self._prefetched:
            self._prefetched.add(part.group)
            self._later += [path for later in self._then[part.group] for path in later.paths]
        absent = self._want(part.paths)
        lost = [self._lost[path] for path in absent if path in self._lost]
        if lost:
            self._skip(missing, lost[0])
            return
        self._ahead += len(missing)
        if absent:
            part.absent, part.trials = absent, missing
            for path in absent:
                self._waiting.setdefault(path, []).append(part)
        else:
            self._queue += missing

    def _trials(self, part: PlanPart) -> list[_Trial]:
        """The trials of a part; judged ones that others judged at agreeing thresholds are filed under their keys."""
        group = self._groups[part.group]
        made = group.trials(part.batch, self.outcome.thresholds, part.repeats)
        found = [_Trial(part, key, task) for key, task in made]
        self.outcome.trials.total += len(found) - part.count
        if part.sets_threshold:
            return self._shard.rotated(found)
        for thresholds in self._others[part.group]:
            elsewhere = group.trials(part.batch, thresholds, part.repeats)
            for trial, (key, judged) in zip(found, elsewhere, strict=True):
                if self._journal.state(trial.key) != "done" and self._journal.state(key) == "done":
                    entry = self._journal.read(key)
                    if entry is not None:
                        self._journal.write(trial.key, refiled(entry, judged, trial.task))
        return found

    def _found(self, part: PlanPart, key: str) -> bool:
        """Return whether the journal says how a trial ended, and nothing asks for another try."""
        entry = self._journal.read(key)
        if entry is None or entry.state == "skipped" or (self._retry_failed and entry.state != "done"):
            return False
        if entry.state == "done":
            self.outcome.trials.found += 1
            self._done(part, key, entry)
        else:
            self._failed(key, entry)
        return True

    # ---------------------------------------------------------------- what ended

    def take(self, job: Job, ended: Ended) -> None:
        """Take in how a job ended."""
        work = self.under_way.pop(job.name)
        if ended.ends_all:
            raise DiskFull(ended.why)
        if isinstance(work, RenderJob):
            self._render_over(work, ended)
        elif isinstance(work, int):
            if ended.state == "done":
                self.examples[work] = ended.value
            else:
                self.outcome.failures.append(Failure(job.name, ended.why, ended.is_bug, ended.state))
        elif work.part.sets_threshold and self._may_try_again(work.key, ended):
            self._queue.append(work)
            self._ahead += 1
        else:
            entry = Entry.of(ended)
            self._journal.write(work.key, entry)
            self.outcome.peak_mb = max(self.outcome.peak_mb, entry.peak_mb)
            self.outcome.trials.seconds += entry.seconds
            if entry.state == "done":
                self.outcome.trials.done += 1
                self._done(work.part, work.key, entry)
            else:
                self._failed(work.key, entry)
            self._trial_over(work)

    def _may_try_again(self, name: str, ended: Ended) -> bool:
        self._tried[name] += ended.state == "crashed"
        return ended.state == "crashed" and self._tried[name] < RENDER_TRIES

    def _done(self, part: PlanPart, key: str, entry: Entry) -> None:
        self.outcome.finished.append(key)
        if part.sets_threshold and entry.record is not None:
            self._calibrations[part.group].add(key, entry.record["runs"])

    def _failed(self, key: str, entry: Entry) -> None:
        self.outcome.trials.failed += 1
        failure = Failure(key, entry.why, entry.is_bug, entry.state)
        told = len(self.outcome.failures) < TOLD_WHOLE
        self.outcome.failures.append(failure if told else replace(failure, why=failure.in_short))

    def _render_over(self, job: RenderJob, ended: Ended) -> None:
        counts, path = self.outcome.renders, job.path
        if ended.state == "done":
            was_there, seconds = ended.value
            counts.found += was_there
            counts.done += not was_there
            counts.seconds += 0.0 if was_there else seconds
            self._there.add(path)
            for part in self._waiting.pop(path, ()):
                part.absent.discard(path)
                if not part.absent:
                    self._queue += part.trials
                    part.trials = []
        elif self._may_try_again(path.name, ended):
            self._wanted.appendleft(path)
        else:
            counts.failed += 1
            self.outcome.failures.append(Failure(f"render {path.stem}", ended.why, ended.is_bug, ended.state))
            self._lost[path] = self.outcome.failures[-1].in_short
            for part in self._waiting.pop(path, ()):
                trials, part.trials = part.trials, []
                self._ahead -= len(trials)
                self._skip(trials, self._lost[path])

    def _skip(self, trials: list[Any], why: str) -> None:
        """Give up trials that cannot be begun; the next run tries them again."""
        for trial in trials:
            entry = Entry("skipped", why=why)
            self._journal.write(trial.key, entry)
            self._failed(trial.key, entry)
            self._trial_over(trial)

    def _trial_over(self, trial: _Trial) -> None:
        trial.part.left -= 1
        if trial.part.left == 0:
            self._part_over(trial.part)

    def _part_over(self, part: PlanPart) -> None:
        """Begin what waited for a part: judged parts for those that set thresholds, pictures for the judged ones."""
        for path in part.paths:
            self._users[path] -= 1
            if not self._users[path] and path not in self._asked:
                self.outcome.renders.total -= 1  # nobody needs it
        part.is_over = True
        group = self._groups[part.group]
        if part.sets_threshold:
            if all(one.is_over for one in self._first[part.group]):
                self._calibrated(part.group)
            return
        is_over = all(one.is_over for one in self._then[part.group])
        is_judged = any(point.digest in self.outcome.thresholds for point in group.points)
        if self._shard.is_whole and not group.is_study and is_over and is_judged:
            paths = [job.path for job in group.damaged.renders]
            for path in paths:
                self.outcome.renders.total += not self._users[path] and path not in self._asked
                self._users[path] += 1
            self._want(paths)
            self._pictures.append(part.group)

    def _calibrated(self, number: int) -> None:
        """Set each point's threshold; then the trials that are judged by it may begin."""
        calibration = self._calibrations[number]
        thresholds, failures = calibration.thresholds()
        if not self._shard.is_whole:
            self._journal.refresh()
        thresholds, *self._others[number] = calibration.sets(thresholds, self._journal)
        calibration.store(thresholds, self._journal)
        self.outcome.thresholds |= thresholds
        self.outcome.failures += failures
        if thresholds:
            self._to_open += self._then[number]
            return
        for part in self._then[number]:
            trials: Iterator[tuple[str, TrialTask]] = self._groups[number].trials(part.batch, None, part.repeats)
            unjudged = [_Trial(part, *one) for one in trials]
            part.left = len(unjudged)
            self._skip(unjudged, f"no threshold: {failures[0].in_short}")


def trial_as_text(task: TrialTask) -> str:
    """A trial's record as the journal keeps it; made where the trial runs, as it takes a millisecond."""
    return record_text(run_trial(task))
