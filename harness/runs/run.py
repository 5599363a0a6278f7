"""Runs a plan. Renders feed trials; detectors learn on hole-free boards, other hole-free trials
set thresholds, and judged trials use both. Trials in the journal are not run again, nor are views
rendered that only they need.

Each shard calibrates its own thresholds, and different processors give slightly different last
digits. So the journal stores the thresholds in use; after a merge, trials judged within `AGREES`
of them count as judged at them."""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from math import isclose
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from harness.evaluation.intervals import threshold_for_rate
from harness.experiment.schema import Point
from harness.runs.jobs import Ended, Failure, Job, JobEngine, Outcome
from harness.runs.journal import THRESHOLDS, Journal, record_text
from harness.runs.pictures import pictures_of
from harness.runs.plan import Group, PlanPart, RenderJob, SweepPlan, parts_of
from harness.runs.processes import render_into_cache
from harness.runs.shards import WHOLE, Shard
from harness.trials.judge import FINDING_OCTAVES, PIXEL_OCTAVES, grid
from harness.trials.learning import learn, learned_file
from harness.trials.trial import Trial, run_trial
from harness.vocabulary.errors import DiskFull, UserError
from harness.vocabulary.files import write_bytes
from harness.vocabulary.geometry import MM
from harness.vocabulary.seeds import canonical_json, digest
from scenes.render.cache import read_view

# a camera that allows no threshold sees nothing if at most this share of a board's face is judged
NOTHING = 0.1
Quiet = dict[
    str, dict[str, tuple[float, float]]
]  # (quiet threshold, judged area in m2) by point, then by trial
# relative difference of equal thresholds: below a tenth of the standard error of one from twenty
# boards
AGREES = 1e-3


class Calibration:
    """Derives thresholds from hole-free trials, which are added in any order. ``quiet``: shared by
    all groups."""

    def __init__(self, group: Group, quiet: Quiet) -> None:
        self._group = group
        self._quiet = quiet
        self.unlearned: set[str] = set()
        """Digests of points whose detector failed to learn: they get no threshold, not even a
        given one."""

    def add(self, key: str, runs: Sequence[Mapping[str, Any]]) -> None:
        """Add the ``runs`` rows of one trial."""
        for run in runs:
            if run["quiet_threshold"] is not None:
                area_m2 = run.get("inspected_m2", np.nan)
                self._quiet.setdefault(run["point"], {})[key] = (run["quiet_threshold"], area_m2)

    def thresholds(self) -> tuple[dict[str, float], list[Failure]]:
        """Return thresholds by point digest; and a failure for each point that has none."""
        stored: dict[str, float] = {}
        failures: list[Failure] = []
        for point in self._group.points:
            quiet = self._quiet.get(point.digest, {})
            threshold = None
            why = "no hole-free run ended"
            try:
                if point.digest in self.unlearned:
                    raise UserError("its detector has learned nothing")
                threshold = threshold_of(point, [quiet[key] for key in sorted(quiet)])
            except UserError as error:
                why = str(error)
            if threshold is None:
                failures.append(Failure(f"threshold of {point.label}", why))
            else:
                stored[point.digest] = threshold
        return stored, failures

    def sets(self, own_thresholds: Mapping[str, float], journal: Journal) -> list[dict[str, float]]:
        """Return sets of thresholds that agree with ``own``, the set to use first: ``own``, or one
        from the journal."""
        prefix = self._prefix()
        stored = []
        for key in journal.thresholds():
            entry = journal.read(key) if prefix and key.startswith(prefix) else None
            thresholds = entry.record if entry is not None else None
            if thresholds is None or thresholds.keys() != own_thresholds.keys():
                continue
            if all(isclose(thresholds[name], own_thresholds[name], rel_tol=AGREES) for name in own_thresholds):
                stored.append({name: float(value) for name, value in thresholds.items()})
        variants = [dict(own_thresholds)] if dict(own_thresholds) in stored or not stored else []
        return variants + [thresholds for thresholds in stored if thresholds not in variants]

    def store(self, thresholds: Mapping[str, float], journal: Journal) -> None:
        """Store the thresholds at which this process judges, if trials set them."""
        prefix = self._prefix()
        key = f"{prefix}{digest(dict(thresholds))}"
        if prefix and thresholds and journal.state(key) is None:
            journal.write(key, Ended("done", canonical_json(dict(thresholds))))

    def _prefix(self) -> str:
        """Return the prefix of the keys of thresholds that are based on the added trials; empty
        without such trials."""
        keys = sorted(
            {key for point in self._group.points for key in self._quiet.get(point.digest, ())}
        )
        return f"{THRESHOLDS}{digest(keys)}-" if keys else ""


def refiled(entry: Ended, judged: Trial, task: Trial) -> Ended:
    """Return a trial's entry with the thresholds of ``task``, which agree with those at which it
    was judged."""
    new = {(point.variant, point.frames): point.criteria.threshold for point in task.points}
    old = {(point.variant, point.frames): point.criteria.threshold for point in judged.points}
    octaves = {"operating": FINDING_OCTAVES, "pixels": PIXEL_OCTAVES}
    record = entry.record or {}
    for table, rows in record.items():
        for row in rows:
            point_key = row.get("variant"), row.get("frames")
            now = new.get(point_key)
            if now is None or old.get(point_key) is None or row.get("threshold") is None:
                continue
            if table in octaves:
                row["threshold"] = (
                    grid(now, octaves[table]).tolist() if len(row["threshold"]) > 1 else [now]
                )
            else:
                row["threshold"] = now
    return replace(entry, value=record_text(record))


def threshold_of(point: Point, quiet: Iterable[tuple[float, float]]) -> float | None:
    """Return a point's threshold: given, or from its hole-free runs (quiet threshold, judged area
    in m2): the highest or, in a study, the one for the wanted rate of false calls. None without
    runs. Raises UserError."""
    given_k = point.config.threshold.k
    calibrate = point.config.threshold.calibrate
    quiet = list(quiet)
    if given_k is not None or not quiet:
        return given_k
    thresholds, areas_m2 = np.array(quiet).T
    if calibrate is None or calibrate.false_calls_per_m2 is None:
        return float(thresholds.max())
    if not areas_m2.mean() > 0:
        message = f"the detector {point.config.detector.name!r} gave no score to any pixel of the hole-free boards"
        raise UserError(message, fix="check its crop against the boards' poses")
    try:
        return threshold_for_rate(
            thresholds, float(areas_m2.mean()), calibrate.false_calls_per_m2
        ).value
    except UserError as error:
        board = point.config.simulated.target.declare().board
        inspected_share = float(areas_m2.mean()) / (board.width_mm * board.height_mm * MM**2)
        if inspected_share > NOTHING:
            raise
        message = f"the camera sees nothing of the board here but {100 * inspected_share:.2g} % of its face"
        raise UserError(f"{message}, too little for a threshold") from error


Report = Callable[[Outcome], None]
AHEAD = 4096  # most trials that wait to be run: enough for a thousand workers, and a few megabytes
# attempts at a render (two at once may need too much memory) or at a trial that sets a threshold
TRIES = 2
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
    """Run the trials that the journal lacks (with ``retry_failed``, also those that failed), and
    draw a whole sweep's pictures. A job that fails becomes a `Failure`; trials that need it are
    skipped. Raises UserError if nothing can be written or the engine is gone. KeyboardInterrupt
    passes through; the journal has all finished trials."""
    first, then = parts_of(plan, shard)
    run = _Run(plan, journal, engine, report, shard, retry_failed)
    outcome = run.outcome
    outcome.trials.total = sum(len(part.repeats) for parts in (*first, *then) for part in parts)
    run.judged_paths = {
        n: [path for part in parts for path in part.batch.paths] for n, parts in enumerate(then)
    }
    try:
        before = [part for parts in first for part in shard.rotated(parts)]
        run.carry_out([part for part in before if part.batch.role == "learning"])
        run.take_learned()
        run.carry_out([part for part in before if part.batch.role != "learning"])
        run.carry_out(
            [
                part
                for number, parts in enumerate(then)
                if parts
                for part in run.calibrated(number, parts)
            ]
        )
        while run.under_way:  # renders that no trial waits for
            run.step()
    finally:
        journal.sync()
    if outcome.trials.over != outcome.trials.total:
        raise RuntimeError(f"trials were lost: {outcome.trials}")
    if shard.is_whole:
        _draw(plan, outcome, engine, run.there)
    outcome.finished.sort()
    outcome.failures.sort(key=lambda failure: failure.what)
    return outcome


def _draw(plan: SweepPlan, outcome: Outcome, engine: JobEngine, stored: set[Path]) -> None:
    """Add the pictures of all judged groups, except in studies, whose limits determine which
    boards are shown."""
    groups = [group for group in plan.groups if group.damaged.board is None]
    groups = [
        group
        for group in groups
        if any(point.digest in outcome.thresholds for point in group.points)
    ]
    missing = (job for group in groups for job in group.damaged.renders if job.path not in stored)
    failures = render_missing(missing, engine)
    outcome.failures += failures
    lost = {failure.what for failure in failures}
    jobs = [
        Job(f"pictures of set-up {number}", "trials", pictures_of, (group, outcome.thresholds))
        for number, group in enumerate(groups)
        if not any(_lost_view(path.name) in lost for path in group.damaged.paths)
    ]
    outcome.examples += pictures_from(jobs, engine, outcome)


def pictures_from(jobs: Sequence[Job], engine: JobEngine, outcome: Outcome) -> Iterator[Any]:
    """Start jobs that draw pictures again; return an iterator over all pictures in the order of
    the jobs. While it is used, jobs that failed are added to the outcome."""
    ends = carried_out(jobs, engine)

    def pictures() -> Iterator[Any]:
        by_name = {job.name: ended for job, ended in ends}
        for job in jobs:
            if by_name[job.name].state == "done":
                yield from by_name[job.name].value
            else:
                outcome.failures.append(_failure(job.name, by_name[job.name]))

    return pictures()


def render_missing(jobs: Iterable[RenderJob], engine: JobEngine) -> list[Failure]:
    """Render views that the cache lacks or holds damaged. Return a failure for each that could not
    be rendered."""
    missing = [
        _render_job(job)
        for job in {job.path: job for job in jobs}.values()
        if read_view(job.path) is None
    ]
    ends = carried_out(missing, engine)
    return [_failure(_lost_view(job.name), ended) for job, ended in ends if ended.state != "done"]


def _lost_view(name: str) -> str:
    return f"view {name} for a picture"


def carried_out(jobs: Iterable[Job], engine: JobEngine) -> Iterator[tuple[Job, Ended]]:
    """Run jobs; yield each with its end, in the order in which they end. The first jobs start with
    this call."""
    waiting = deque(jobs)

    def started() -> int:
        """Start the jobs for which there is room, and return their number."""
        count = len(waiting)
        while waiting and engine.room(waiting[0].stage) > 0:
            engine.submit(waiting.popleft())
        return count - len(waiting)

    def ends(under_way: int) -> Iterator[tuple[Job, Ended]]:
        while waiting or under_way:
            for job, ended in engine.ended():
                under_way -= 1
                yield job, ended
            under_way += started()

    return ends(started())


def values_of(
    function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], engine: JobEngine
) -> list[Any]:
    """Return the values of a function of each of several arguments, None for a user's mistake. A
    bug is raised."""
    jobs = [Job(str(number), "trials", function, job_arguments) for number, job_arguments in enumerate(arguments)]
    ends = {job.name: ended for job, ended in carried_out(jobs, engine)}
    if bug := next((end.why for end in ends.values() if end.is_bug), None):
        raise RuntimeError(bug)
    return [ends[job.name].value for job in jobs]


def _render_job(job: RenderJob) -> Job:
    arguments = (job.target.to_data(), job.camera.to_data(), job.config.to_data(), str(job.folder))
    return Job(job.path.name, "renders", render_into_cache, arguments)


def _failure(label: str, ended: Ended) -> Failure:
    return Failure(label, ended.why, ended.is_bug, ended.state)


class _Trial(NamedTuple):
    part: PlanPart
    key: str
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
        retry: bool,
    ) -> None:
        self.outcome = Outcome()
        self.under_way: dict[str, _Trial | RenderJob] = {}
        self.there: set[Path] = set()
        self.judged_paths: dict[int, list[Path]] = {}
        self._groups = plan.groups
        self._journal = journal
        self._engine = engine
        self._report = report
        self._shard = shard
        self._retry_failed = retry
        self._renders = {job.path: job for job in plan.renders}
        quiet: Quiet = {}
        self._calibrations = [Calibration(group, quiet) for group in plan.groups]
        # by group: thresholds of other shards that agree with those in use
        self._others: list[list[dict[str, float]]] = [[] for _ in plan.groups]
        self._deaths: Counter[str] = (
            Counter()
        )  # by job: how often the process of a render or calibrating trial died
        self._queue: deque[_Trial] = deque()
        self._waiting: dict[
            Path, list[tuple[PlanPart, list[_Trial]]]
        ] = {}  # by view: parts that wait for it
        self._unstarted = self._running = (
            0  # numbers of queued or waiting trials, and of running trials
        )
        self._lost: dict[Path, str] = {}
        self._requested: set[Path] = set()  # views that were ever requested
        self._wanted: deque[Path] = deque()  # views to render now; then those to render later
        self._later: deque[Path] = deque()

    def carry_out(self, parts: Iterable[PlanPart]) -> None:
        """Run all trials of the parts that the journal lacks."""
        to_open = deque(parts)
        while to_open or self._unstarted or self._running:
            for _ in range(PARTS_AT_ONCE):
                if not to_open or self._unstarted >= AHEAD:
                    break
                self._open(to_open.popleft())
            while self._engine.room("renders") > 0:
                while (
                    self._later and not to_open and not self._wanted
                ):  # rendered while the engine is idle
                    self._want(self._later.popleft())
                if not self._wanted:
                    break
                render = self._renders[self._wanted.popleft()]
                self.under_way[render.path.name] = render
                self._engine.submit(_render_job(render))
            while self._engine.room("trials") > 0 and self._queue:
                self._begin(self._queue.popleft())
            self.step()

    def step(self) -> None:
        """Wait for jobs to end, and process their results."""
        self._report(self.outcome)
        for job, ended in self._engine.ended() if self.under_way else ():
            if ended.ends_all:
                raise DiskFull(ended.why)
            work = self.under_way.pop(job.name)
            self._deaths[job.name] += ended.state == "crashed"
            again = ended.state == "crashed" and self._deaths[job.name] < TRIES
            if isinstance(work, RenderJob):
                if again:
                    self._wanted.appendleft(work.path)
                else:
                    self._render_over(work.path, ended)
                continue
            self._running -= 1
            if again and work.part.sets_threshold:
                self._queue.append(work)
                self._unstarted += 1
                continue
            self._journal.write(work.key, ended)
            self.outcome.peak_mb = max(self.outcome.peak_mb, ended.peak_mb)
            self.outcome.trials.done += ended.state == "done"
            self._count(work, ended)
        self._report(self.outcome)

    def take_learned(self) -> None:
        """Write what detectors have learned into files, which trials read."""
        for group, calibration in zip(self._groups, self._calibrations, strict=True):
            for point, path in ((point, Path(file)) for point, file in group.learned.items()):
                entry = self._journal.read(path.stem)
                if entry is None or entry.record is None:
                    calibration.unlearned.add(point)
                elif not path.exists():
                    write_bytes(path, learned_file(entry.record))

    def calibrated(self, number: int, judged: list[PlanPart]) -> list[PlanPart]:
        """Set the thresholds of a group. Return the parts that can be judged at them."""
        calibration = self._calibrations[number]
        thresholds, failures = calibration.thresholds()
        if not self._shard.is_whole:
            self._journal.refresh()
        thresholds, *self._others[number] = calibration.sets(thresholds, self._journal)
        calibration.store(thresholds, self._journal)
        self.outcome.thresholds |= thresholds
        self.outcome.failures += failures
        for part in () if thresholds else judged:
            keyed_tasks = self._groups[number].trials(part.batch, None, part.repeats)
            self._skip(
                [_Trial(part, *keyed) for keyed in keyed_tasks], f"no threshold: {failures[0].in_short}"
            )
        return judged if thresholds else []

    def _want(self, path: Path) -> None:
        if path not in self._requested:
            self._requested.add(path)
            self._wanted.append(path)
            self.outcome.renders.total += 1

    def _open(self, part: PlanPart) -> None:
        """Take the finished trials of a part from the journal, and queue the others once their
        views are rendered."""
        missing = [trial for trial in self._trials(part) if not self._found(trial)]
        if not missing:
            return
        absent = [path for path in part.batch.paths if path not in self.there]
        for path in absent:
            self._want(path)
        lost = [self._lost[path] for path in absent if path in self._lost]
        if lost:
            self._skip(missing, lost[0])
            return
        self._unstarted += len(missing)
        if part.sets_threshold:
            self._later += self.judged_paths.pop(part.group, ())
        if not absent:
            self._queue += missing
        for path in absent:
            self._waiting.setdefault(path, []).append((part, missing))

    def _begin(self, trial: _Trial) -> None:
        self._unstarted -= 1
        if not self._shard.is_whole and trial.part.sets_threshold:
            # another shard in the same folder may have run it in the meantime
            self._journal.refresh()
            if self._found(trial):
                return
        self._running += 1
        self.under_way[trial.key] = trial
        self._engine.submit(Job(trial.key, "trials", trial_as_text, (trial.task,)))

    def _trials(self, part: PlanPart) -> list[_Trial]:
        """Return a part's trials. Those that others judged at agreeing thresholds are filed under
        this run's keys."""
        group = self._groups[part.group]
        keyed_tasks = group.trials(
            part.batch,
            self.outcome.thresholds,
            part.repeats,
            self._calibrations[part.group].unlearned,
        )
        trials = [_Trial(part, key, task) for key, task in keyed_tasks]
        self.outcome.trials.total += len(trials) - len(part.repeats)
        if part.sets_threshold:
            return self._shard.rotated(trials)
        for thresholds in self._others[part.group]:
            for trial, (key, judged) in zip(
                trials, group.trials(part.batch, thresholds, part.repeats), strict=True
            ):
                is_new = (
                    self._journal.state(trial.key) != "done" and self._journal.state(key) == "done"
                )
                if is_new and (entry := self._journal.read(key)) is not None:
                    self._journal.write(trial.key, refiled(entry, judged, trial.task))
        return trials

    def _found(self, trial: _Trial) -> bool:
        """Return whether the journal has a trial's final end, so that it is not run again."""
        entry = self._journal.read(trial.key)
        if (
            entry is None
            or entry.state == "skipped"
            or (self._retry_failed and entry.state != "done")
        ):
            return False
        self.outcome.trials.found += entry.state == "done"
        self._count(trial, entry)
        return True

    def _count(self, trial: _Trial, entry: Ended) -> None:
        if entry.state == "done":
            self.outcome.finished.append(trial.key)
            if trial.part.sets_threshold and entry.record is not None:
                self._calibrations[trial.part.group].add(trial.key, entry.record["runs"])
            return
        self.outcome.trials.failed += 1
        failure = _failure(trial.key, entry)
        with_traceback = len(self.outcome.failures) < MOST_TRACEBACKS
        self.outcome.failures.append(failure if with_traceback else replace(failure, why=failure.in_short))

    def _render_over(self, path: Path, ended: Ended) -> None:
        counts = self.outcome.renders
        waiting = self._waiting.pop(path, ())
        if ended.state == "done":
            was_there, seconds = ended.value
            counts.found += was_there
            counts.done += not was_there
            counts.seconds += 0.0 if was_there else seconds
            self.there.add(path)
            for part, trials in waiting:
                if self.there.issuperset(part.batch.paths):
                    self._queue += trials
            return
        counts.failed += 1
        self.outcome.failures.append(_failure(f"render {path.stem}", ended))
        self._lost[path] = self.outcome.failures[-1].in_short
        for _, trials in waiting:
            self._unstarted -= len(trials)
            self._skip(trials, self._lost[path])
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
