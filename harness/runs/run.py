"""Runs a plan. Renders feed trials; detectors learn on hole-free boards, other hole-free trials
set thresholds, and judged trials use both. Trials in the journal are not run again, nor are views
rendered that only they need."""

from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from harness.records.examples import ExampleCloud, MappedExample
from harness.runs.calibration import Calibration, Quiet, refiled
from harness.runs.job_batches import (
    failure_of,
    lost_view,
    pictures_from,
    render_job,
    render_missing,
)
from harness.runs.jobs import Ended, Job, JobEngine, Outcome
from harness.runs.journal import Journal, record_text
from harness.runs.pictures import is_shown, pictures_of
from harness.runs.plan import Group, PlanPart, RenderJob, SweepPlan, parts_of
from harness.runs.shards import WHOLE, Shard
from harness.trials.learning import learn, learned_file
from harness.trials.trial import Trial, run_trial
from harness.vocabulary.errors import DiskFull
from harness.vocabulary.files import write_bytes

Report = Callable[[Outcome], None]
AHEAD = 4096  # most trials that wait to be run: enough for a thousand workers, and a few megabytes
TRIES = 2
"""Attempts at a render (two at once may need too much memory) or at a trial that sets a
threshold."""
PARTS_AT_ONCE = 200  # parts looked up in the journal between two calls of the engine: about 0.1 s
MOST_TRACEBACKS = 200  # failures whose traceback stays in memory; the journal has those of all


def run_plan(
    plan: SweepPlan,
    journal: Journal,
    engine: JobEngine,
    report: Report,
    *,
    shard: Shard = WHOLE,
    retry_failed: bool = False,
) -> Outcome:
    """Run the trials that the journal lacks (with ``retry_failed``, also those that failed).

    A job that fails becomes a `Failure`; trials that need it are skipped. Raises UserError if
    nothing can be written or the engine is gone. KeyboardInterrupt passes through; the journal has
    all finished trials.
    """
    calibrating_parts, judged_parts = parts_of(plan, shard)
    run = _Run(plan, journal, engine, report, shard, retry_failed=retry_failed)
    outcome = run.outcome
    for parts in (*calibrating_parts, *judged_parts):
        outcome.trials.total += sum(len(part.repeats) for part in parts)
    for number, parts in enumerate(judged_parts):
        run.judged_paths[number] = [path for part in parts for path in part.batch.paths]
    try:
        before = [part for parts in calibrating_parts for part in shard.rotated(parts)]
        run.carry_out(part for part in before if part.batch.role == "learning")
        run.take_learned()
        run.carry_out(part for part in before if part.batch.role != "learning")
        to_judge: list[PlanPart] = []
        judging = {id(plan.groups[number]) for number, parts in enumerate(judged_parts) if parts}
        for number, parts in enumerate(judged_parts):
            group = plan.groups[number]
            if parts or (group.is_shared and id(group.leader) in judging):
                to_judge += run.calibrated(number, parts)
        run.carry_out(to_judge)
        while run.under_way:  # renders that no trial waits for
            run.step()
    finally:
        journal.sync()
    if outcome.trials.over != outcome.trials.total:
        raise RuntimeError(f"trials were lost: {outcome.trials}")
    outcome.finished.sort()
    outcome.failures.sort(key=lambda failure: failure.what)
    return outcome


def examples_of(
    plan: SweepPlan, outcome: Outcome, engine: JobEngine
) -> list[ExampleCloud | MappedExample]:
    """Draw the pictures that the page shows of judged groups, except in studies, whose limits
    determine which boards are shown. What fails is added to the outcome."""
    groups = []
    for group in plan.groups:
        is_judged = any(point.digest in outcome.thresholds for point in group.points)
        if is_judged and is_shown(group):
            groups.append(group)
    renders = [render for group in groups for render in group.damaged.renders]
    failures = render_missing(renders, engine)
    outcome.failures += failures
    lost_views = {failure.what for failure in failures}
    jobs = []
    for number, group in enumerate(groups):
        if not any(lost_view(path.name) in lost_views for path in group.damaged.paths):
            arguments = (group, outcome.thresholds)
            jobs.append(Job(f"pictures of set-up {number}", "trials", pictures_of, arguments))
    examples = list(pictures_from(jobs, engine, outcome))
    outcome.failures.sort(key=lambda failure: failure.what)
    return examples


@dataclass(frozen=True)
class _Trial:
    """A trial of the plan."""

    part: PlanPart
    key: str  # its key in the journal, which also names its job
    task: Trial


class _Run:
    """The state of a run: jobs that are running, views in the cache, views wanted after
    calibration."""

    def __init__(
        self,
        plan: SweepPlan,
        journal: Journal,
        engine: JobEngine,
        report: Report,
        shard: Shard,
        *,
        retry_failed: bool,
    ) -> None:
        self._groups = plan.groups
        self._journal = journal
        self._engine = engine
        self._report = report
        self._shard = shard
        self._retry_failed = retry_failed

        self.outcome = Outcome()
        self.under_way: dict[str, _Trial | RenderJob] = {}
        """What runs in the engine, by the name of its job."""
        self._deaths: Counter[str] = Counter()
        """How often the process of a job died, by the job's name."""

        # views
        self._renders = {render.path: render for render in plan.renders}
        self._rendered: set[Path] = set()
        """Files of views that are in the cache."""
        self._lost: dict[Path, str] = {}
        """The reasons why views could not be rendered."""
        self._requested: set[Path] = set()
        """Views that were ever requested."""
        self._render_now: deque[Path] = deque()
        self._render_when_idle: deque[Path] = deque()
        self.judged_paths: dict[int, list[Path]] = {}
        """The views that judged trials of a group need, by the group's number: rendered while the
        engine is idle, from when its calibration has begun."""

        # trials
        self._queue: deque[_Trial] = deque()
        """Trials whose views are rendered."""
        self._waiting: dict[Path, list[tuple[PlanPart, list[_Trial]]]] = {}
        """Parts that wait for a view, with their trials."""
        self._unstarted = 0
        """Number of trials that are queued or wait for a view."""
        self._running = 0
        """Number of trials that run."""

        # thresholds
        quiet: Quiet = {}
        self._calibrations = [Calibration(group, quiet) for group in plan.groups]
        self._others_thresholds: list[list[dict[str, float]]] = [[] for _ in plan.groups]
        """By group: thresholds of other shards that agree with those in use."""

    def carry_out(self, parts: Iterable[PlanPart]) -> None:
        """Run all trials of the parts that the journal lacks."""
        unopened = deque(parts)
        while unopened or self._unstarted or self._running:
            for _ in range(PARTS_AT_ONCE):
                if not unopened or self._unstarted >= AHEAD:
                    break
                self._open(unopened.popleft())
            self._start_renders(is_idle=not unopened)
            while self._engine.room("trials") > 0 and self._queue:
                self._begin(self._queue.popleft())
            self.step()

    def _start_renders(self, *, is_idle: bool) -> None:
        """Give the engine the renders for which it has room; if it is idle, also those that only
        later trials need."""
        while self._engine.room("renders") > 0:
            while is_idle and self._render_when_idle and not self._render_now:
                self._request(self._render_when_idle.popleft())
            if not self._render_now:
                return
            render = self._renders[self._render_now.popleft()]
            self.under_way[render.path.name] = render
            self._engine.submit(render_job(render))

    def step(self) -> None:
        """Wait for jobs to end, and process their results."""
        self._report(self.outcome)
        if self.under_way:
            for job, ended in self._engine.ended():
                self._job_over(job, ended)
        self._report(self.outcome)

    def _job_over(self, job: Job, ended: Ended) -> None:
        if ended.ends_all:
            raise DiskFull(ended.why)
        work = self.under_way.pop(job.name)
        self._deaths[job.name] += ended.state == "crashed"
        is_tried_again = ended.state == "crashed" and self._deaths[job.name] < TRIES
        if isinstance(work, RenderJob):
            if is_tried_again:
                self._render_now.appendleft(work.path)
            else:
                self._render_over(work.path, ended)
            return
        self._running -= 1
        if is_tried_again and work.part.sets_threshold:
            self._queue.append(work)
            self._unstarted += 1
            return
        self._journal.write(work.key, ended)
        self.outcome.peak_mb = max(self.outcome.peak_mb, ended.peak_mb)
        self.outcome.trials.done += ended.state == "done"
        self._count(work, ended)

    def take_learned(self) -> None:
        """Write what detectors have learned into files, which trials read."""
        for group, calibration in zip(self._groups, self._calibrations, strict=True):
            for point_digest, file in group.learned.items():
                path = Path(file)
                entry = self._journal.read(path.stem)
                if entry is None or entry.record is None:
                    calibration.unlearned.add(point_digest)
                elif not path.exists():
                    write_bytes(path, learned_file(entry.record))

    def calibrated(self, number: int, judged: list[PlanPart]) -> list[PlanPart]:
        """Set the thresholds of a group. Return the parts that can be judged at them."""
        calibration = self._calibrations[number]
        own_thresholds, failures = calibration.thresholds()
        if not self._shard.is_whole:
            self._journal.refresh()
        thresholds, *others_thresholds = calibration.sets(own_thresholds, self._journal)
        self._others_thresholds[number] = others_thresholds
        calibration.store(thresholds, self._journal)
        self.outcome.thresholds |= thresholds
        self.outcome.failures += failures
        if thresholds:
            return judged
        for part in judged:
            keyed_tasks = self._groups[number].trials(part.batch, None, part.repeats)
            trials = [_Trial(part, key, task) for key, task in keyed_tasks]
            self._skip(trials, f"no threshold: {failures[0].in_short}")
        return []

    def _request(self, path: Path) -> None:
        """Have a view rendered, unless it was requested before."""
        if path not in self._requested:
            self._requested.add(path)
            self._render_now.append(path)
            self.outcome.renders.total += 1

    def _open(self, part: PlanPart) -> None:
        """Take the finished trials of a part from the journal, and queue the others once their
        views are rendered."""
        missing = [trial for trial in self._trials(part) if not self._take_from_journal(trial)]
        if not missing:
            return
        absent = [path for path in part.batch.paths if path not in self._rendered]
        for path in absent:
            self._request(path)
        lost = [self._lost[path] for path in absent if path in self._lost]
        if lost:
            self._skip(missing, lost[0])
            return
        self._unstarted += len(missing)
        if part.sets_threshold:
            self._render_when_idle += self.judged_paths.pop(part.group, ())
        if not absent:
            self._queue += missing
        for path in absent:
            self._waiting.setdefault(path, []).append((part, missing))

    def _begin(self, trial: _Trial) -> None:
        self._unstarted -= 1
        if not self._shard.is_whole and trial.part.sets_threshold:
            # another shard in the same folder may have run it in the meantime
            self._journal.refresh()
            if self._take_from_journal(trial):
                return
        self._running += 1
        self.under_way[trial.key] = trial
        self._engine.submit(Job(trial.key, "trials", trial_as_text, (trial.task,)))

    def _trials(self, part: PlanPart) -> list[_Trial]:
        """Return a part's trials. Those that others judged at agreeing thresholds are filed under
        this run's keys."""
        group = self._groups[part.group]
        unlearned = self._calibrations[part.group].unlearned
        keyed_tasks = group.trials(part.batch, self.outcome.thresholds, part.repeats, unlearned)
        trials = [_Trial(part, key, task) for key, task in keyed_tasks]
        self.outcome.trials.total += len(trials) - len(part.repeats)
        if part.sets_threshold:
            return self._shard.rotated(trials)
        for thresholds in self._others_thresholds_of(group):
            others_tasks = group.trials(part.batch, thresholds, part.repeats)
            for trial, (others_key, others_task) in zip(trials, others_tasks, strict=True):
                self._refile(trial, others_key, others_task)
        return trials

    def _others_thresholds_of(self, group: Group) -> list[dict[str, float]]:
        """Return other shards' thresholds of a group, each set with one of each group that shares
        its hole-free boards. A trial that a shard has judged at other pairs is judged again."""
        by_group = []
        for number, other in enumerate(self._groups):
            if other is group or (other.is_shared and other.leader is group):
                by_group.append(self._others_thresholds[number])
        joined = []
        for of_shard in zip(*by_group, strict=False):
            joined.append({digest: k for own in of_shard for digest, k in own.items()})
        return joined

    def _refile(self, trial: _Trial, others_key: str, others_task: Trial) -> None:
        """File what another shard has judged under this run's key, unless it is there."""
        if self._journal.state(trial.key) == "done" or self._journal.state(others_key) != "done":
            return
        entry = self._journal.read(others_key)
        if entry is not None:
            self._journal.write(trial.key, refiled(entry, others_task, trial.task))

    def _take_from_journal(self, trial: _Trial) -> bool:
        """Count a trial whose final end is in the journal, which is not run again. Returns whether
        it is."""
        entry = self._journal.read(trial.key)
        if entry is None or entry.state == "skipped":
            return False
        if self._retry_failed and entry.state != "done":
            return False
        self.outcome.trials.found += entry.state == "done"
        self._count(trial, entry)
        return True

    def _count(self, trial: _Trial, entry: Ended) -> None:
        """Count a trial's end; what sets a threshold goes to the calibration."""
        if entry.state == "done":
            self.outcome.finished.append(trial.key)
            if trial.part.sets_threshold and entry.record is not None:
                self._calibrations[trial.part.group].add(trial.key, entry.record["runs"])
            return
        self.outcome.trials.failed += 1
        failure = failure_of(trial.key, entry)
        if len(self.outcome.failures) >= MOST_TRACEBACKS:
            failure = replace(failure, why=failure.in_short)
        self.outcome.failures.append(failure)

    def _render_over(self, path: Path, ended: Ended) -> None:
        """Count a render's end; queue the trials that waited for it, or skip them."""
        counts = self.outcome.renders
        waiting = self._waiting.pop(path, ())
        if ended.state == "done":
            was_stored, seconds = ended.value
            if was_stored:
                counts.found += 1
            else:
                counts.done += 1
                counts.seconds += seconds
            self._rendered.add(path)
            for part, trials in waiting:
                if self._rendered.issuperset(part.batch.paths):
                    self._queue += trials
            return
        counts.failed += 1
        failure = failure_of(f"render {path.stem}", ended)
        self.outcome.failures.append(failure)
        self._lost[path] = failure.in_short
        for _, trials in waiting:
            self._unstarted -= len(trials)
            self._skip(trials, failure.in_short)
            trials.clear()  # the part's other views wait with the same list

    def _skip(self, trials: Iterable[_Trial], why: str) -> None:
        """Record trials that cannot be started; the next run tries them again."""
        entry = Ended("skipped", why=why)
        for trial in trials:
            self._journal.write(trial.key, entry)
            self._count(trial, entry)


def trial_as_text(task: Trial) -> str:
    """Return a trial's record as JSON for the journal. The worker makes this text, because it
    takes a millisecond."""
    if task.role == "learning":
        return record_text(learn(task))
    return record_text(run_trial(task).to_data())
