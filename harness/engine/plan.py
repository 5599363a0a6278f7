"""The plan of a sweep: views to render, trials to run, points that share their frames, and a shard's parts of it."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from detectors import DETECTORS
from harness.engine.journal import JOURNAL_VERSION
from harness.engine.setup import SetUpRef
from harness.engine.trial import PointTask, Role, TrialTask
from harness.engine.work import Shard
from harness.experiment.schema import Experiment, Point, SimulatedSource
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from harness.vocabulary.provenance import source_digest
from harness.vocabulary.seeds import canonical_json, digest
from scenes.optics import RenderConfig
from scenes.perspectives import AnyViews, poses_of
from scenes.render.cache import render_key
from scenes.sensor.camera import CameraConfig, camera_of
from scenes.target.custom import TargetConfig
from scenes.target.drawn import DrawnTargetConfig

CODE = "harness.engine.trial"
PACKAGES = (
    "numpy", "scipy", "numba", "opencv-python-headless", "open3d-cpu" if sys.platform == "linux" else "open3d",
)  # fmt: skip
"""A trial's numbers are decided, beside its task, by all sources that this module and the detector's reach, and by the
versions of these packages: a change of any makes stored trials count as not done. Mitsuba's version is part of the
names of the rendered views."""
MOST_REPEATS = 256  # repeats of a part of a plan, which is looked up and queued as one


def trial_code(detector: str) -> tuple[str, ...]:
    """Return the modules whose sources decide a trial with a detector, a plug-in's included."""
    return (CODE, DETECTORS.offer(detector).target.partition(":")[0])


@dataclass(frozen=True)
class RenderJob:
    """One view to render, or to find in the cache."""

    target: TargetConfig
    camera: CameraConfig
    config: RenderConfig
    folder: Path

    @cached_property
    def path(self) -> Path:
        """The file in the cache."""
        return self.folder / f"{render_key(self.target, camera_of(self.camera).optics, self.config)}.npz"


@dataclass(frozen=True)
class Batch:
    """Trials of one role before one target, which share its renders. ``renders`` and ``set_ups``: one for each view.
    ``board``: its number among a study's boards of this role; None for any other experiment."""

    role: Role
    renders: tuple[RenderJob, ...]
    set_ups: tuple[SetUpRef, ...]
    board: int | None = None

    @cached_property
    def paths(self) -> tuple[Path, ...]:
        """The files of its views."""
        return tuple(job.path for job in self.renders)


@dataclass(frozen=True)
class Group:
    """Points that share their frames: one set-up, one seed. The batches ``first`` are hole-free and set the points'
    thresholds; ``then`` those judged by them. ``poses``: the declaration of the views, where there are several."""

    points: tuple[Point, ...]
    first: tuple[Batch, ...]
    then: tuple[Batch, ...]
    seed: int
    poses: AnyViews | None = None

    @property
    def batches(self) -> tuple[Batch, ...]:
        """All, in the order in which they run."""
        return (*self.first, *self.then)

    @property
    def is_study(self) -> bool:
        """Return whether its boards are drawn at random."""
        return self.then[0].board is not None

    @property
    def damaged(self) -> Batch:
        """The first batch before a damaged target."""
        return next(batch for batch in self.then if batch.role == "damaged")

    def repeats(self, batch: Batch, point: Point) -> int:
        """Return the number of trials of a batch that a point wants: with a given threshold, as many hole-free as
        damaged ones; one of each board that sets a study's threshold."""
        calibrate = point.config.threshold.calibrate
        if batch.role == "calibration":
            return 0 if calibrate is None else 1
        if batch.role == "hole_free" and calibrate is not None and calibrate.repeats is not None:
            return calibrate.repeats
        return point.config.repeats

    def most_repeats(self, batch: Batch) -> int:
        """Return the number of trials of a batch."""
        return max(self.repeats(batch, point) for point in self.points)

    def trials(
        self, batch: Batch, thresholds: Mapping[str, float] | None, repeats: Iterable[int] | None = None
    ) -> Iterator[tuple[str, TrialTask]]:
        """Yield (journal key, task) of each trial of a batch, or of some ``repeats``. ``thresholds`` by point digest,
        empty while calibrating; a point that got none is not judged; None names trials that cannot be judged."""
        given = {point.digest: (thresholds or {}).get(point.digest, point.config.threshold.k) for point in self.points}
        unjudged = thresholds is None or batch in self.first
        points = [point for point in self.points if unjudged or given[point.digest] is not None]
        asked = {point.digest: _point_task(point, given[point.digest]) for point in points}
        count = max((self.repeats(batch, point) for point in points), default=0)
        for repeat in range(count) if repeats is None else repeats:
            wanted = tuple(asked[point.digest] for point in points if repeat < self.repeats(batch, point))
            if wanted:
                task = TrialTask(batch.set_ups, self.seed, batch.role, repeat, wanted, self.poses, batch.board)
                yield self._key(batch, task), task

    def _key(self, batch: Batch, task: TrialTask) -> str:
        content = [
            JOURNAL_VERSION,
            *(source_digest(trial_code(name), PACKAGES) for name in sorted({each.detector for each in task.points})),
            *(path.stem for path in batch.paths),
            None if self.poses is None else self.poses.to_data(),
            task.role,
            task.board,
            task.repeat,
            [[point.digest, point.variant, point.threshold] for point in task.points],
        ]
        number = task.repeat if task.board is None else task.board
        return f"{task.role}-{number:05d}-{digest(content)}"


def _point_task(point: Point, threshold: float | None) -> PointTask:
    capture, detector, matching = point.config.capture, point.config.detector, point.config.matching
    settings, radius_m = canonical_json(detector.settings), matching.radius_mm * MM
    asked = (detector.name, settings, capture.average, radius_m, threshold, point.config.mapping)
    return PointTask(point.digest, point.variant, capture.frames, *asked, capture.exact, capture.flat_field)


@dataclass(frozen=True)
class SweepPlan:
    """All groups of an experiment with a simulated source."""

    groups: tuple[Group, ...]

    @property
    def renders(self) -> tuple[RenderJob, ...]:
        """The distinct views, in the order in which trials need them."""
        jobs = {job.path: job for group in self.groups for batch in group.batches for job in batch.renders}
        return tuple(jobs.values())

    @property
    def trial_count(self) -> int:
        """Trials of all roles."""
        return sum(group.most_repeats(batch) for group in self.groups for batch in group.batches)


def plan_of(experiment: Experiment, cache: Path) -> SweepPlan:
    """Group the points of an experiment by the frames that they share."""
    by_frames: dict[str, list[Point]] = {}
    for point in experiment.points:
        by_frames.setdefault(point.frames_key, []).append(point)
    return SweepPlan(tuple(_group(tuple(points), cache) for points in by_frames.values()))


def _group(points: tuple[Point, ...], cache: Path) -> Group:
    source, study = points[0].config.source, points[0].config.study
    assert isinstance(source, SimulatedSource)
    target, seed = source.target, points[0].config.seed
    if study is not None and isinstance(target, DrawnTargetConfig):
        calibrate = points[0].config.threshold.calibrate
        boards = 0 if calibrate is None else calibrate.boards or 0
        counts: dict[Role, int] = {"calibration": boards, "hole_free": study.hole_free_boards, "damaged": study.boards}
        first, hole_free, damaged = (
            tuple(_batch(target.drawn(role, n), role, source, cache, n) for n in range(count))
            for role, count in counts.items()
        )
        return Group(points, first, (*damaged, *hole_free), seed, source.views)
    declared = target.declare()
    if not declared.damages:
        what = "the target has neither holes nor dents, so that there is nothing to find"
        raise UserError(what, fix="declare source.target.holes or source.target.dents")
    first, then = ((_batch(declared, role, source, cache),) for role in ("hole_free", "damaged"))
    return Group(points, first, then, seed, source.views)


def _batch(declared: TargetConfig, role: Role, source: SimulatedSource, cache: Path, board: int | None = None) -> Batch:
    target = declared.at_wavelength(camera_of(source.camera).optics.wavelength_nm)
    poses = (target.pose,) if source.views is None else poses_of(source.views, target.pose)
    renders, set_ups, damaged = [], [], role == "damaged"
    for pose in poses:
        placed = target.model_copy(update={"pose": pose})
        shown = placed if damaged else placed.hole_free()
        renders.append(RenderJob(shown, source.camera, source.render, cache))
        set_ups.append(SetUpRef(str(renders[-1].path), source.camera, placed, damaged))
    return Batch(role, tuple(renders), tuple(set_ups), board)


class PlanPart(NamedTuple):
    """Some repeats of one batch. ``group``: its number in the plan; ``sets_threshold``: whether the trials set the
    points' thresholds."""

    group: int
    batch: Batch
    sets_threshold: bool
    repeats: range


def parts_of(plan: SweepPlan, shard: Shard) -> tuple[list[list[PlanPart]], list[list[PlanPart]]]:
    """Cut a plan, by group, into parts that set its thresholds, and judged parts that are the shard's. A group of which
    the shard judges nothing has neither."""

    def cut(number: int, batch: Batch, repeats: range, sets_threshold: bool) -> list[PlanPart]:
        starts = range(repeats.start, repeats.stop, MOST_REPEATS)
        slices = (range(start, min(start + MOST_REPEATS, repeats.stop)) for start in starts)
        return [PlanPart(number, batch, sets_threshold, each) for each in slices]

    mine, before = shard.part(sum(group.most_repeats(batch) for group in plan.groups for batch in group.then)), 0
    first: list[list[PlanPart]] = []
    then: list[list[PlanPart]] = []
    for number, group in enumerate(plan.groups):
        judged = []
        for batch in group.then:
            count = group.most_repeats(batch)
            judged += cut(number, batch, range(max(mine.start - before, 0), min(mine.stop - before, count)), False)
            before += count
        then.append(judged)
        calibrating = group.first if judged else ()
        first.append([part for one in calibrating for part in cut(number, one, range(group.most_repeats(one)), True)])
    return first, then
