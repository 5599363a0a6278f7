"""Running a plan: renders feed trials, hole-free trials set thresholds, the trials that are judged use them. Whatever
ends is in the journal; what the journal holds is not run again, nor is what only it needed rendered.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from harness.engine.calibration import Calibration
from harness.engine.examples import examples_of
from harness.engine.journal import Entry, Journal, record_text
from harness.engine.map_examples import map_examples_of
from harness.engine.outcome import Failure, Outcome, Progress
from harness.engine.parts import Part, parts_of
from harness.engine.plan import Group, Plan, RenderJob
from harness.engine.rendering import render_into_cache
from harness.engine.shard import WHOLE, Shard
from harness.engine.trial import TrialTask, run_trial
from harness.engine.work import Ended, Engine, Job
from harness.vocabulary.errors import DiskFull
from scenes.render.cache import read_view

AHEAD = 4096
"""Trials that may wait to be run: enough for a thousand workers, and a few megabytes whatever the plan's size."""
RENDER_TRIES = 2
"""A render whose process died is begun once more: two of them may have been too much for the memory. So is a trial that
sets a threshold, since with another threshold all that was judged by it would be run again."""
PARTS_AT_ONCE = 200
"""That are looked up in the journal before the engine is asked again: some 0.1 s."""
TOLD_WHOLE = 200
"""Failures whose traceback is kept in memory; of the others the journal has it."""


def run_plan(
    plan: Plan,
    journal: Journal,
    engine: Engine,
    report: Callable[[Progress], None],
    *,
    shard: Shard = WHOLE,
    retry_failed: bool = False,
) -> Outcome:
    """Run what the journal does not hold, or of it with ``retry_failed`` what is not done. A job that does not end well
    becomes a `Failure` and costs what needs it. Raises UserError where nothing can be written or the engine is gone;
    KeyboardInterrupt passes through: what ended is in the journal."""
    began = time.monotonic()
    state = _Run(plan, journal, engine, report, shard, retry_failed)
    state.start()
    while state.feed():
        for job, ended in engine.ended() if state.waits else ():
            state.take(job, ended)
    if state.outcome.trials.over != state.outcome.trials.total:
        raise RuntimeError(f"trials were lost: {state.outcome.trials}")
    state.outcome.seconds = time.monotonic() - began
    state.outcome.finished.sort()
    state.outcome.examples = [one for number in sorted(state.examples) for one in state.examples[number]]
    state.outcome.failures.sort(key=lambda failure: failure.what)
    return state.outcome


def render_missing(jobs: Iterable[RenderJob], engine: Engine) -> list[Failure]:
    """Have views rendered that the cache lacks or holds damaged, for pictures of trials that are done. Returns what
    could not be."""
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
    part: Part
    key: str
    task: TrialTask


@dataclass
class _Views:
    """Which renders are wanted, there, or lost."""

    jobs: dict[Path, RenderJob] = field(default_factory=dict)
    there: set[Path] = field(default_factory=set)
    lost: dict[Path, str] = field(default_factory=dict)
    users: Counter[Path] = field(default_factory=Counter)
    """Parts that are not over, and pictures: a view without any is not rendered."""
    wanted: deque[Path] = field(default_factory=deque)
    later: deque[Path] = field(default_factory=deque)
    """Will be wanted once thresholds are set; rendered when nothing is wanted now."""
    asked: set[Path] = field(default_factory=set)
    tries: dict[Path, int] = field(default_factory=dict)

    def want(self, renders: Iterable[RenderJob]) -> set[Path]:
        """Ask for renders; returns those that are still missing."""
        paths = [job.path for job in renders]
        for path in paths:
            if path not in self.asked:
                self.asked.add(path)
                self.wanted.append(path)
        return {path for path in paths if path not in self.there}

    def next(self) -> Path | None:
        """The next to render."""
        if self.wanted:
            return self.wanted.popleft()
        while self.later:
            path = self.later.popleft()
            if path not in self.asked and self.users[path]:
                self.asked.add(path)
                return path
        return None


class _Run:
    """The state of one run: what may be begun, what waits for what, and what came of it."""

    def __init__(
        self,
        plan: Plan,
        journal: Journal,
        engine: Engine,
        report: Callable[[Progress], None],
        shard: Shard,
        retry_failed: bool,
    ) -> None:
        self.outcome = Outcome()
        self._groups = plan.groups
        self._journal, self._engine, self._report = journal, engine, report
        self._shard, self._retry_failed = shard, retry_failed
        self._first, self._then = parts_of(plan, shard)
        self._calibrations = [Calibration(group) for group in plan.groups]
        self._views = _Views(
            {job.path: job for parts in (*self._first, *self._then) for p in parts for job in p.renders}
        )
        self._views.users.update(path for parts in (*self._first, *self._then) for p in parts for path in p.paths)
        self._to_open: deque[Part] = deque()
        self._queue: deque[_Trial] = deque()
        self._waiting: dict[Path, list[Part]] = {}
        self._pictures: deque[int] = deque()
        """Groups whose trials are over and whose pictures are not begun."""
        self._prefetched: set[int] = set()
        """Groups whose judged views are asked for."""
        self._tried: set[str] = set()
        """Calibrations whose process died once."""
        self._ahead = 0
        """Trials that are open and not begun."""
        self.examples: dict[int, list[Any]] = {}
        """By group."""
        self._under_way: dict[str, _Trial | RenderJob | int] = {}
        """By name of the job; a number is that of a group whose pictures are made."""
        self.outcome.renders.total = len(self._views.jobs)
        self.outcome.trials.total = sum(part.count for parts in (*self._first, *self._then) for part in parts)

    # ---------------------------------------------------------------- what begins

    def start(self) -> None:
        """All calibrations may begin; groups that need none are judged at once."""
        for number, parts in enumerate(self._first):
            if parts:
                self._to_open += self._shard.rotated(parts)
            elif self._then[number]:
                self._calibrated(number)

    @property
    def waits(self) -> bool:
        """Whether the engine has something to do."""
        return bool(self._under_way)

    def feed(self) -> bool:
        """Hand the engine what it has room for, and look a few more parts up. False where nothing is left to do."""
        for _ in range(PARTS_AT_ONCE):
            if not self._to_open or self._ahead >= AHEAD:
                break
            self._open(self._to_open.popleft())
        while self._engine.room("renders") > 0 and (path := self._views.next()) is not None:
            job = self._views.jobs[path]
            self._submit(_render_job(job), job)
        while self._engine.room("trials") > 0 and (self._queue or self._pictures_ready()):
            self._submit_trial() if self._queue else self._submit_pictures()
        self._report(Progress(self.outcome.renders, self.outcome.trials))
        return bool(self._under_way or self._to_open or self._queue)

    def _submit(self, job: Job, work: _Trial | RenderJob | int) -> None:
        self._under_way[job.name] = work
        self._engine.submit(job)

    def _submit_trial(self) -> None:
        trial = self._queue.popleft()
        self._ahead -= 1
        # another shard with the same folder may have run a calibration meanwhile
        if not self._shard.is_whole and trial.part.sets_threshold and self._found(trial.part, trial.key):
            self._trial_over(trial)
            return
        self._submit(Job(trial.key, "trials", trial_as_text, (trial.task,), trial.part.paths), trial)

    def _pictures_ready(self) -> bool:
        """Whether the views of the first group that waits for its pictures are there; lost ones are given up."""
        while self._pictures:
            paths = [job.path for job in self._groups[self._pictures[0]].damaged.renders]
            if not any(path in self._views.lost for path in paths):
                return all(path in self._views.there for path in paths)
            self._pictures.popleft()
        return False

    def _submit_pictures(self) -> None:
        number = self._pictures.popleft()
        group = self._groups[number]
        arguments = (group, self.outcome.thresholds)
        needs = tuple(job.path for job in group.damaged.renders)
        self._submit(Job(f"pictures of set-up {number}", "trials", pictures_of, arguments, needs), number)

    def _open(self, part: Part) -> None:
        """Take from the journal what it holds of a part, and queue the rest once its views are there."""
        missing = [trial for trial in self._trials(part) if not self._found(part, trial.key)]
        part.left = len(missing)
        if not missing:
            self._part_over(part)
            return
        if part.sets_threshold and part.group not in self._prefetched:
            self._prefetched.add(part.group)
            self._views.later += [path for later in self._then[part.group] for path in later.paths]
        absent = self._views.want(part.renders)
        lost = [self._views.lost[path] for path in absent if path in self._views.lost]
        if lost:
            self._skip(missing, lost[0])
        elif absent:
            part.absent, part.trials = absent, missing
            self._ahead += len(missing)
            for path in absent:
                self._waiting.setdefault(path, []).append(part)
        else:
            self._queue += missing
            self._ahead += len(missing)

    def _trials(self, part: Part) -> Iterator[_Trial]:
        group = self._groups[part.group]
        found = [
            _Trial(part, key, task) for key, task in group.trials(part.batch, self.outcome.thresholds, part.repeats)
        ]
        self.outcome.trials.total += len(found) - part.count
        yield from self._shard.rotated(found) if part.sets_threshold else found

    def _found(self, part: Part, key: str) -> bool:
        """Whether the journal says how a trial ended, and nothing asks for another try."""
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
        """A job has ended, one way or another."""
        work = self._under_way.pop(job.name)
        if ended.ends_all:
            raise DiskFull(ended.why)
        if isinstance(work, RenderJob):
            self._render_over(work, ended)
        elif isinstance(work, int):
            if ended.state == "done":
                self.examples[work] = ended.value
            else:
                self.outcome.failures.append(Failure(job.name, ended.why, ended.is_bug, ended.state))
        elif ended.state == "crashed" and work.part.sets_threshold and work.key not in self._tried:
            self._tried.add(work.key)
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

    def _done(self, part: Part, key: str, entry: Entry) -> None:
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
            self._views.there.add(path)
            for part in self._waiting.pop(path, ()):
                self._view_there(part, path)
            return
        self._views.tries[path] = self._views.tries.get(path, 0) + 1
        if ended.state == "crashed" and self._views.tries[path] < RENDER_TRIES:
            self._views.wanted.appendleft(path)
            return
        counts.failed += 1
        self.outcome.failures.append(Failure(f"render {path.stem}", ended.why, ended.is_bug, ended.state))
        self._views.lost[path] = self.outcome.failures[-1].in_short
        for part in self._waiting.pop(path, ()):
            trials, part.trials = part.trials, []
            self._ahead -= len(trials)
            self._skip(trials, self._views.lost[path])

    def _view_there(self, part: Part, path: Path) -> None:
        part.absent.discard(path)
        if not part.absent:
            self._queue += part.trials
            part.trials = []

    def _skip(self, trials: list[Any], why: str) -> None:
        """Trials that cannot be begun; they are tried again by the next run."""
        for trial in trials:
            entry = Entry("skipped", why=why)
            self._journal.write(trial.key, entry)
            self._failed(trial.key, entry)
            self._trial_over(trial)

    def _trial_over(self, trial: _Trial) -> None:
        trial.part.left -= 1
        if trial.part.left == 0:
            self._part_over(trial.part)

    def _part_over(self, part: Part) -> None:
        """After the parts that set thresholds the judged ones may begin; after those there are pictures to make."""
        for path in part.paths:
            self._views.users[path] -= 1
            if not self._views.users[path] and path not in self._views.asked:
                self.outcome.renders.total -= 1  # nobody needs it
        part.is_over = True
        group = self._groups[part.group]
        if part.sets_threshold:
            if all(one.is_over for one in self._first[part.group]):
                self._calibrated(part.group)
        elif self._shard.is_whole and not group.is_study and all(one.is_over for one in self._then[part.group]):
            self._want_pictures(part.group)

    def _calibrated(self, number: int) -> None:
        """Each point's threshold; then what is judged by it may begin."""
        thresholds, failures = self._calibrations[number].thresholds()
        self.outcome.thresholds |= thresholds
        self.outcome.failures += failures
        if thresholds:
            self._to_open += self._then[number]
            return
        group = self._groups[number]
        for part in self._then[number]:
            unjudged = [_Trial(part, *one) for one in group.trials(part.batch, None, part.repeats)]
            part.left = len(unjudged)
            self._skip(unjudged, f"no threshold: {failures[0].in_short}")

    def _want_pictures(self, number: int) -> None:
        group = self._groups[number]
        if any(point.digest in self.outcome.thresholds for point in group.points):
            for job in group.damaged.renders:
                self.outcome.renders.total += not self._views.users[job.path] and job.path not in self._views.asked
                self._views.users[job.path] += 1
            self._views.want(group.damaged.renders)
            self._pictures.append(number)


def trial_as_text(task: TrialTask) -> str:
    """A trial's record as the journal keeps it; made where the trial runs, as it takes a millisecond."""
    return record_text(run_trial(task))


def pictures_of(group: Group, thresholds: dict[str, float]) -> list[Any]:
    """The example clouds of a group, or of its maps."""
    return list(examples_of(group, thresholds) if group.poses is None else map_examples_of(group, thresholds))
