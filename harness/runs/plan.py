"""The plan of a sweep: views to render, trials to run, points that share their frames, and the
parts of a shard."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

from detectors import DETECTORS
from detectors.interface import Calibratable
from harness.experiment.schema import Experiment, Point, SimulatedSource
from harness.runs.journal import JOURNAL_VERSION
from harness.runs.shards import Shard
from harness.trials.judge import detector_of
from harness.trials.learning import LEARNING_BOARDS
from harness.trials.setup import SetUpRef
from harness.trials.trial import PointTask, Role, TrialTask
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from harness.vocabulary.provenance import source_digest
from harness.vocabulary.seeds import canonical_json, digest, random_stream
from scenes.optics import RenderConfig
from scenes.perspectives import AnyViews, poses_of
from scenes.render.cache import render_key
from scenes.sensor.camera import CameraConfig, camera_of
from scenes.target.custom import TargetConfig
from scenes.target.drawn import DrawnTargetConfig

CODE = "harness.trials.learning"
PACKAGES = (
    "numpy", "scipy", "numba", "opencv-python-headless", "open3d-cpu" if sys.platform == "linux" else "open3d",
)  # fmt: skip
"""A trial runs again after a change of its task, of sources that it reaches, or of a version of
these packages."""
MOST_REPEATS = 256  # repeats in one part of a plan; a part is looked up and queued as a whole


def trial_code(detector: str) -> tuple[str, ...]:
    """Return the modules whose sources determine a trial with a detector, including those of a
    plug-in."""
    return (CODE, DETECTORS.offer(detector).target.partition(":")[0])


@dataclass(frozen=True)
class RenderJob:
    """A view to render, unless it is in the cache."""

    target: TargetConfig
    camera: CameraConfig
    config: RenderConfig
    folder: Path

    @cached_property
    def path(self) -> Path:
        """Its file in the cache."""
        return (
            self.folder
            / f"{render_key(self.target, camera_of(self.camera).optics, self.config)}.npz"
        )


@dataclass(frozen=True)
class Batch:
    """Trials of one role with one target, which share its renders. ``renders`` and ``set_ups``
    have an entry for each view (in the role "learning": the views of all targets in sequence).
    ``board``: the board's number in a study; None for other experiments. ``units``: cameras that
    take turns over the repeats; empty: the camera of the set-ups."""

    role: Role
    renders: tuple[RenderJob, ...]
    set_ups: tuple[SetUpRef, ...]
    board: int | None = None
    units: tuple[CameraConfig, ...] = ()

    @cached_property
    def paths(self) -> tuple[Path, ...]:
        """The files of its views."""
        return tuple(job.path for job in self.renders)

    def before(self, repeat: int) -> tuple[SetUpRef, ...]:
        """Return the set-ups of a repeat, with its unit of the camera."""
        if not self.units:
            return self.set_ups
        return tuple(
            replace(ref, camera=self.units[repeat % len(self.units)]) for ref in self.set_ups
        )


@dataclass(frozen=True)
class Group:
    """Points that share their frames: one set-up, one seed. Detectors learn on the batch
    ``learning``; the batches ``first`` are hole-free and set thresholds; the batches ``then`` are
    judged at them. ``poses`` declares several views. ``folder`` is for files of what detectors
    learn. Groups of a study that differ only in the damage have the same trials before thresholds.
    The first such group is the ``leader`` of the others and also runs these trials for their
    points, ``also``, in the same order as its own."""

    points: tuple[Point, ...]
    learning: tuple[Batch, ...]
    first: tuple[Batch, ...]
    then: tuple[Batch, ...]
    seed: int
    folder: Path
    poses: AnyViews | None = None
    also: tuple[Point, ...] = ()
    leader: Group | None = None

    @property
    def batches(self) -> tuple[Batch, ...]:
        """All batches, in the order in which they run."""
        return (*self.learning, *self.first, *self.then)

    @cached_property
    def learners(self) -> tuple[Point, ...]:
        """The points whose detector learns."""
        pairs = ((point, point.config.detector) for point in self.points)
        made = (
            (point, detector_of(config.name, canonical_json(config.settings)))
            for point, config in pairs
        )
        return tuple(point for point, detector in made if isinstance(detector, Calibratable))

    @cached_property
    def learned(self) -> dict[str, str]:
        """The files that hold what detectors learn, by point digest; each is named after its trial
        in the journal."""
        if self.leader is not None:
            return self.leader.learned
        trials = (trial for batch in self.learning for trial in self.trials(batch, None))
        files = {task.points[0].digest: str(self.folder / f"{key}.npz") for key, task in trials}
        pairs = zip(self.also, cycle(self.points), strict=False)
        return files | {
            point.digest: files[own.digest] for point, own in pairs if own.digest in files
        }

    @property
    def damaged(self) -> Batch:
        """The first batch with a damaged target."""
        return next(batch for batch in self.then if batch.role == "damaged")

    def repeats(self, batch: Batch, point: Point) -> int:
        """Return a point's number of trials of a batch: 1 of a calibration board; ``repeats`` per
        unit of a damaged board; of hole-free boards as many as calibrate or, with a given
        threshold, as of damaged boards."""
        calibrate = point.config.threshold.calibrate
        if batch.role == "calibration":
            return 0 if calibrate is None else 1
        if batch.role == "hole_free" and calibrate is not None and calibrate.repeats is not None:
            return calibrate.repeats
        return point.config.repeats * max(len(batch.units), 1)

    def most_repeats(self, batch: Batch) -> int:
        """Return the number of trials of a batch; when learning, one for each detector that
        learns."""
        if batch.role == "learning":
            return len(self.learners)
        return max(self.repeats(batch, point) for point in self.points)

    def trials(
        self,
        batch: Batch,
        thresholds: Mapping[str, float] | None,
        repeats: Iterable[int] | None = None,
        without: Collection[str] = (),
    ) -> Iterator[tuple[str, TrialTask]]:
        """Yield (journal key, task) of the trials of a batch, or of some ``repeats``.
        ``thresholds``: by point digest, empty in calibration; None: list all trials. Points
        without a threshold, or in ``without``, are not judged."""
        if batch.role == "learning":
            for number in range(len(self.learners)) if repeats is None else repeats:
                learner = (point_task(self.learners[number], None, None),)
                task = TrialTask(batch.set_ups, self.seed, batch.role, 0, learner, self.poses)
                yield self._key(batch, task), task
            return
        sets_threshold = batch in self.first
        every = (*self.points, *(self.also if sets_threshold else ()))
        unjudged = thresholds is None or sets_threshold
        given = {
            point.digest: (thresholds or {}).get(point.digest, point.config.threshold.k)
            for point in every
        }
        points = [point for point in every if unjudged or given[point.digest] is not None]
        points = [point for point in points if point.digest not in without]
        learned = self.learned
        tasks = {
            point.digest: point_task(point, given[point.digest], learned.get(point.digest))
            for point in points
        }
        count = max((self.repeats(batch, point) for point in points), default=0)
        for repeat in range(count) if repeats is None else repeats:
            wanted = tuple(
                tasks[point.digest] for point in points if repeat < self.repeats(batch, point)
            )
            if wanted:
                task = TrialTask(
                    batch.before(repeat),
                    self.seed,
                    batch.role,
                    repeat,
                    wanted,
                    self.poses,
                    batch.board,
                )
                yield self._key(batch, task), task

    def _key(self, batch: Batch, task: TrialTask) -> str:
        content = [
            JOURNAL_VERSION,
            *(
                source_digest(trial_code(name), PACKAGES)
                for name in sorted({each.detector for each in task.points})
            ),
            *(path.stem for path in batch.paths),
            None if self.poses is None else self.poses.to_data(),
            task.role,
            task.board,
            task.repeat,
            [ref.camera.unit_seed for ref in task.set_ups],
            [
                [p.digest, p.variant, p.threshold, p.learned and Path(p.learned).name]
                for p in task.points
            ],
        ]
        number = task.repeat if task.board is None else task.board
        return f"{task.role}-{number:05d}-{digest(content)}"


def point_task(point: Point, threshold: float | None, learned: str | None) -> PointTask:
    """Return a point's part of a trial. ``threshold`` is None during calibration; ``learned`` as
    in `PointTask`."""
    capture = point.config.capture
    detector = point.config.detector
    matching = point.config.matching
    first = (
        detector.name,
        canonical_json(detector.settings),
        capture.average,
        matching.radius_mm * MM,
        threshold,
    )
    further = (point.config.mapping, capture.exact, learned, capture.flat_field, matching.overlap)
    return PointTask(point.digest, point.variant, capture.frames, *first, *further)


@dataclass(frozen=True)
class SweepPlan:
    """All groups of an experiment."""

    groups: tuple[Group, ...]

    @property
    def renders(self) -> tuple[RenderJob, ...]:
        """The different views, in the order in which trials need them."""
        jobs = {
            job.path: job
            for group in self.groups
            for batch in group.batches
            for job in batch.renders
        }
        return tuple(jobs.values())


def plan_of(experiment: Experiment, cache: Path, folder: Path | None = None) -> SweepPlan:
    """Group the points of an experiment that share their frames. ``folder``: its results; None:
    the cache."""
    by_frames: dict[str, list[Point]] = {}
    for point in experiment.points:
        by_frames.setdefault(point.frames_key, []).append(point)
    alike: dict[str, list[Group]] = {}
    for points in by_frames.values():
        group = _group(tuple(points), cache, folder or cache)
        alike.setdefault(_before_thresholds(group), []).append(group)
    groups: list[Group] = []
    for first, *rest in alike.values():
        leader = replace(first, also=tuple(point for group in rest for point in group.points))
        groups += [
            leader,
            *(replace(group, learning=(), first=(), leader=leader) for group in rest),
        ]
    return SweepPlan(tuple(groups))


def _before_thresholds(group: Group) -> str:
    """Return a text that is the same for groups of a study whose trials before thresholds are the
    same."""
    batches = (*group.learning, *group.first)
    if not batches or batches[-1].board is None:
        return group.points[0].frames_key
    tasks = [
        replace(point_task(point, None, None), digest="", variant="") for point in group.points
    ]
    seen = [(batch.paths, [ref.camera for ref in batch.before(0)]) for batch in batches]
    return repr(
        [group.seed, group.poses, tasks, [point.config.threshold for point in group.points], seen]
    )


def _group(points: tuple[Point, ...], cache: Path, folder: Path) -> Group:
    source = points[0].config.simulated
    study = points[0].config.study
    target = source.target
    seed = points[0].config.seed
    if study is not None and isinstance(target, DrawnTargetConfig):
        calibrate = points[0].config.threshold.calibrate
        boards = 0 if calibrate is None else calibrate.boards or 0

        def batches(role: Role, count: int) -> tuple[Batch, ...]:
            """Return a role's batches: all units inspect each damaged board; every other board has
            its own unit."""
            made = []
            for board in range(count):
                numbers = (
                    range(study.units or 0) if role == "damaged" else [board] if study.units else []
                )
                units = tuple(unit_of(source.camera, seed, role, number) for number in numbers)
                made.append(
                    batch_of(_drawn(target, role, board), role, source, cache, board, units)
                )
            return tuple(made)

        learning = batches("learning", LEARNING_BOARDS)
        first = batches("calibration", boards)
        then = (*batches("damaged", study.boards), *batches("hole_free", study.hole_free_boards))
    else:
        declared = target.declare()
        if not declared.damages:
            what = "the target has no damage, so that there is nothing to find"
            raise UserError(
                what, fix="declare source.target.holes, source.target.dents or source.target.flaws"
            )
        learning = (batch_of(declared, "learning", source, cache),) * LEARNING_BOARDS
        first = (batch_of(declared, "hole_free", source, cache),)
        then = (batch_of(declared, "damaged", source, cache),)
    group = Group(points, (), first, then, seed, folder, source.views)
    if not group.learners:
        return group
    renders = {job.path: job for batch in learning for job in batch.renders}
    set_ups = tuple(ref for batch in learning for ref in batch.before(0))
    return replace(group, learning=(Batch("learning", tuple(renders.values()), set_ups),))


_drawn = lru_cache(maxsize=4096)(
    DrawnTargetConfig.drawn
)  # cameras, frames and detectors share boards


def unit_of(camera: CameraConfig, seed: int, role: Role, number: int) -> CameraConfig:
    """Return the camera of a unit that is drawn for a role and number."""
    stream = random_stream(seed, "unit of the camera", camera.unit_seed, role, number)
    return camera.model_copy(update={"unit_seed": int(stream.integers(2**32))})


def batch_of(
    declared: TargetConfig,
    role: Role,
    source: SimulatedSource,
    cache: Path,
    board: int | None = None,
    units: tuple[CameraConfig, ...] = (),
) -> Batch:
    """Return the trials of a role with one declared target, which shows its damage only in the
    role "damaged"."""
    target = declared.at_wavelength(camera_of(source.camera).optics.wavelength_nm)
    poses = (target.pose,) if source.views is None else poses_of(source.views, target.pose)
    renders = []
    set_ups = []
    damaged = role == "damaged"
    for pose in poses:
        placed = target.model_copy(update={"pose": pose})
        renders.append(
            RenderJob(
                placed if damaged else placed.hole_free(), source.camera, source.render, cache
            )
        )
        set_ups.append(SetUpRef(str(renders[-1].path), source.camera, placed, damaged))
    return Batch(role, tuple(renders), tuple(set_ups), board, units)


class PlanPart(NamedTuple):
    """Some repeats of one batch of group number ``group``. ``sets_threshold``: whether they set
    its thresholds."""

    group: int
    batch: Batch
    sets_threshold: bool
    repeats: range


def parts_of(plan: SweepPlan, shard: Shard) -> tuple[list[list[PlanPart]], list[list[PlanPart]]]:
    """Cut a plan, by group, into parts that set thresholds (learning first), and the judged parts
    of a shard."""

    def cut(number: int, batch: Batch, repeats: range, sets_threshold: bool) -> list[PlanPart]:
        starts = range(repeats.start, repeats.stop, MOST_REPEATS)
        slices = (range(start, min(start + MOST_REPEATS, repeats.stop)) for start in starts)
        return [PlanPart(number, batch, sets_threshold, each) for each in slices]

    mine = shard.part(
        sum(group.most_repeats(batch) for group in plan.groups for batch in group.then)
    )
    before = 0
    then: list[list[PlanPart]] = []
    for number, group in enumerate(plan.groups):
        judged = []
        for batch in group.then:
            count = group.most_repeats(batch)
            judged += cut(
                number,
                batch,
                range(max(mine.start - before, 0), min(mine.stop - before, count)),
                False,
            )
            before += count
        then.append(judged)
    wanted = {
        id(group.leader or group) for group, judged in zip(plan.groups, then, strict=True) if judged
    }
    first: list[list[PlanPart]] = []
    for number, group in enumerate(plan.groups):
        calibrating = (*group.learning, *group.first) if id(group) in wanted else ()
        first.append(
            [
                part
                for b in calibrating
                for part in cut(number, b, range(group.most_repeats(b)), True)
            ]
        )
    return first, then
