"""The plan of a sweep: views to render, trials to run, points that share their frames, and the
parts of a shard.

Points whose frames are equal form a `Group`. A group's trials come in batches: each `Batch` shows
one target in one role, and repeats differ in their noise only. `parts_of` cuts batches into parts
of some repeats, which shards share out."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import cycle
from pathlib import Path
from typing import Any

from detectors import DETECTORS
from detectors.filters import BUILT_IN, filter_module
from detectors.interface import Calibratable
from harness.evaluation.study.record import BoardDesign
from harness.experiment.schema import (
    AnyReference,
    Experiment,
    GoodPartsReference,
    Point,
    ScanReference,
    SimulatedSource,
    StudyConfig,
)
from harness.experiment.unfold import source_of
from harness.records.rows import Role
from harness.runs.journal import JOURNAL_VERSION
from harness.runs.shards import Shard
from harness.trials.averages import Averaging
from harness.trials.board import BoardRef
from harness.trials.clouds import TrialPoint
from harness.trials.judge import Criteria, detector_of
from harness.trials.learning import LEARNING_BOARDS
from harness.trials.references import NO_REFERENCES, ReferenceBoards
from harness.trials.trial import Trial
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from harness.vocabulary.provenance import source_digest
from harness.vocabulary.seeds import canonical_json, digest, random_stream
from scenes.optics import RenderConfig
from scenes.perspectives import AnyViews, poses_of
from scenes.render.cache import render_key
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.target.custom import TargetConfig
from scenes.target.drawn import DrawnTargetConfig

CODE = "harness.trials.learning"
PACKAGES = (
    "numpy",
    "scipy",
    "numba",
    "opencv-python-headless",
    "open3d-cpu",
    "open3d",
)
"""A trial runs again after a change of its task, of sources that it reaches, or of a version of
these packages."""
BUILT_IN_FILTERS = tuple(target.partition(":")[0] for target in BUILT_IN.values())
MOST_REPEATS = 256  # repeats in one part of a plan; a part is looked up and queued as a whole


def trial_code(detector: str) -> tuple[str, ...]:
    """Return the modules whose sources determine a trial with a detector, including those of a
    plug-in and of all built-in filters."""
    module, _, _ = DETECTORS.offer(detector).target.partition(":")
    return (CODE, *BUILT_IN_FILTERS, module)


@dataclass(frozen=True)
class RenderJob:
    """A view to render, unless it is in the cache."""

    target: TargetConfig
    """The target as the view shows it."""
    camera: CameraConfig
    """The camera, of which only the optics matter."""
    config: RenderConfig
    """Settings of the render."""
    folder: Path
    """The cache."""

    @cached_property
    def path(self) -> Path:
        """Its file in the cache."""
        key = render_key(self.target, camera_of(self.camera).optics, self.config)
        return self.folder / f"{key}.npz"


@dataclass(frozen=True)
class Batch:
    """Trials of one role with one target, which share its renders."""

    role: Role
    """Purpose of the target."""
    renders: tuple[RenderJob, ...]
    """A render for each view, then those of references; in the role "learning", those of all
    targets in sequence."""
    views: tuple[BoardRef, ...]
    """The board in each of these views."""
    board: int | None = None
    """The board's number in a study; None for other experiments."""
    units: tuple[CameraConfig, ...] = ()
    """Cameras that take turns over the repeats; empty: the camera of the views."""
    references: ReferenceBoards = NO_REFERENCES
    """What the board may be compared with."""

    @cached_property
    def paths(self) -> tuple[Path, ...]:
        """The files of its views."""
        return tuple(job.path for job in self.renders)

    def references_before(self, repeat: int) -> ReferenceBoards:
        """Return the boards of references before the camera of a repeat."""
        if not self.units:
            return self.references
        return self.references.before(self.units[repeat % len(self.units)])

    def before(self, repeat: int) -> tuple[BoardRef, ...]:
        """Return the board in each view before the camera of a repeat."""
        if not self.units:
            return self.views
        unit = self.units[repeat % len(self.units)]
        return tuple(replace(view, camera=unit) for view in self.views)


@dataclass(frozen=True)
class Group:
    """Points that share their frames: one set-up, one seed.

    Groups of a study that differ only in the damage have the same trials before thresholds. The
    first such group is the ``leader`` of the others and runs these trials for all of them, and
    those of hole-free boards if these are the same too."""

    points: tuple[Point, ...]
    """The points, in the experiment's order."""
    learning: tuple[Batch, ...]
    """The batch on which detectors learn, if any does."""
    first: tuple[Batch, ...]
    """Hole-free batches that set thresholds."""
    then: tuple[Batch, ...]
    """Batches that are judged at the thresholds."""
    seed: int
    """Seed of the noise."""
    folder: Path
    """Folder for files of what detectors learn."""
    poses: AnyViews | None = None
    """Declaration of several views."""
    also: tuple[Point, ...] = ()
    """Points of the groups that this group leads, in the same order as its own."""
    leader: Group | None = None
    """The group that runs the trials before thresholds; None: this group."""
    sharing: tuple[Group, ...] = ()
    """Groups that this group leads and whose hole-free boards show the same: their points are
    judged in this group's trials."""
    is_shared: bool = False
    """Whether this group's hole-free boards are judged in its leader's trials."""

    @property
    def batches(self) -> tuple[Batch, ...]:
        """All batches, in the order in which they run."""
        return (*self.learning, *self.first, *self.then)

    @cached_property
    def learners(self) -> tuple[Point, ...]:
        """The points whose detector learns."""
        learners = []
        for point in self.points:
            settings = canonical_json(point.config.detector_settings)
            if isinstance(detector_of(point.config.detector.name, settings), Calibratable):
                learners.append(point)
        return tuple(learners)

    @cached_property
    def learned(self) -> dict[str, str]:
        """The files that hold what detectors learn, by point digest; each is named after its trial
        in the journal."""
        if self.leader is not None:
            return self.leader.learned
        files = {}
        for batch in self.learning:
            for key, trial in self.trials(batch, None):
                files[trial.points[0].digest] = str(self.folder / f"{key}.npz")
        followers = {}
        for point, like in zip(self.also, cycle(self.points), strict=False):
            if like.digest in files:
                followers[point.digest] = files[like.digest]
        return {**files, **followers}

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
        if self.is_shared and batch.role == "hole_free":
            return 0
        return max(self.repeats(batch, point) for point in self.points)

    def trials(
        self,
        batch: Batch,
        thresholds: Mapping[str, float] | None,
        repeats: Iterable[int] | None = None,
        without: Collection[str] = (),
    ) -> Iterator[tuple[str, Trial]]:
        """Yield (journal key, trial) of the trials of a batch, or of some ``repeats``.
        ``thresholds``: by point digest, empty in calibration; None: list all trials. Points
        without a threshold, or in ``without``, are not judged."""
        if batch.role == "learning":
            yield from self._learning_trials(batch, repeats)
            return
        points = []
        for point, shown in self._judging_points(batch):
            threshold = point.config.threshold.k
            if thresholds is not None:
                threshold = thresholds.get(point.digest, threshold)
            is_judged = thresholds is None or batch in self.first or threshold is not None
            if is_judged and point.digest not in without:
                learned = self.learned.get(point.digest)
                count = self.repeats(batch, point)
                points.append((count, trial_point(point, threshold, learned), shown))
        if repeats is None:
            repeats = range(max((count for count, _, _ in points), default=0))
        for repeat in repeats:
            judging = []
            for count, of_trial, shown in points:
                if repeat < count:
                    left_out = () if shown is batch else shown.before(repeat)
                    judging.append(replace(of_trial, left_out=left_out))
            if not judging:
                continue
            trial = Trial(
                views=batch.before(repeat),
                seed=self.seed,
                role=batch.role,
                repeat=repeat,
                points=tuple(judging),
                poses=self.poses,
                board=batch.board,
                references=batch.references_before(repeat),
            )
            yield self._key(batch, trial), trial

    def _learning_trials(
        self, batch: Batch, repeats: Iterable[int] | None
    ) -> Iterator[tuple[str, Trial]]:
        """Yield the trials in which detectors learn: one for each learner, by its number."""
        numbers = range(len(self.learners)) if repeats is None else repeats
        for number in numbers:
            trial = Trial(
                views=batch.views,
                seed=self.seed,
                role=batch.role,
                repeat=0,
                points=(trial_point(self.learners[number], None, None),),
                poses=self.poses,
                references=batch.references,
            )
            yield self._key(batch, trial), trial

    def _judging_points(self, batch: Batch) -> list[tuple[Point, Batch]]:
        """Return the points that judge a batch, each with the batch that shows its own target:
        before thresholds, also those of led groups, and on hole-free boards of those that share
        them."""
        if batch in self.first:
            return [(point, batch) for point in (*self.points, *self.also)]
        if self.is_shared and batch.role == "hole_free":
            return []
        judging = [(point, batch) for point in self.points]
        if batch.role == "hole_free":
            for group in self.sharing:
                (shown,) = [own for own in group.hole_free if own.board == batch.board]
                judging += [(point, shown) for point in group.points]
        return judging

    @property
    def hole_free(self) -> tuple[Batch, ...]:
        """The hole-free batches that are judged."""
        return tuple(batch for batch in self.then if batch.role == "hole_free")

    def shows_the_same_hole_free(self, other: Group) -> bool:
        """Return whether the hole-free boards that both groups of a study judge show the same in
        one view, so that frames and findings are the same: their damage is left out."""
        return (
            self.poses is None
            and bool(self.hole_free)
            and _seen(self.hole_free) == _seen(other.hole_free)
        )

    def _key(self, batch: Batch, trial: Trial) -> str:
        """Return a trial's key in the journal: its role and number, and a digest of everything
        that determines its record."""
        detectors = sorted({point.criteria.detector for point in trial.points})
        content: list[Any] = [JOURNAL_VERSION]
        content += [source_digest(trial_code(name), PACKAGES) for name in detectors]
        content += [source_digest((module,), PACKAGES) for module in foreign_filters(trial)]
        content += [path.stem for path in batch.paths]
        content += [
            None if self.poses is None else self.poses.to_data(),
            trial.role,
            trial.board,
            trial.repeat,
            [view.camera.unit_seed for view in trial.views],
            [_point_key(point) for point in trial.points],
        ]
        number = trial.repeat if trial.board is None else trial.board
        return f"{trial.role}-{number:05d}-{digest(content)}"


def _seen(batches: Sequence[Batch]) -> list[tuple[Any, ...]]:
    """Return what the cameras see of each batch, with its references."""
    seen = []
    for batch in batches:
        cameras = [view.camera for view in batch.views]
        seen.append((batch.board, batch.paths, cameras, batch.units, batch.references))
    return seen


def foreign_filters(trial: Trial) -> list[str]:
    """Return the modules of the plug-ins among the filters of a trial, sorted."""
    chosen = [point.averaging.filter for point in trial.points]
    modules = {filter_module(config.name) for config in chosen if config is not None}
    return sorted(module for module in modules - {*BUILT_IN_FILTERS} if module is not None)


def _point_key(point: TrialPoint) -> list[Any]:
    """Return what distinguishes a point's part of a trial in its journal key."""
    learned = point.criteria.learned
    if learned is not None:
        learned = Path(learned).name
    return [point.digest, point.variant, point.criteria.threshold, learned]


def trial_point(point: Point, threshold: float | None, learned: str | None) -> TrialPoint:
    """Return a point's part of a trial. ``threshold``: None during calibration. ``learned``: file
    of what its detector has learned."""
    config = point.config
    depth_filter = config.capture.filter
    averaging = Averaging(
        config.capture.average,
        config.capture.flat_field,
        None if depth_filter is None else canonical_json(depth_filter.to_data()),
    )
    return TrialPoint(
        digest=point.digest,
        variant=point.variant,
        frames=config.capture.frames,
        averaging=averaging,
        criteria=Criteria(
            detector=config.detector.name,
            settings_json=canonical_json(config.detector_settings),
            threshold=threshold,
            radius_m=config.matching.radius_mm * MM,
            overlap=config.matching.overlap,
            learned=learned,
        ),
        mapping=config.mapping,
        reference=config.compared_with,
    )


Designs = Mapping[str, BoardDesign]
"""The damaged boards of a study with a precision, by `family_of` its points."""


def family_of(point: Point) -> str:
    """Return what names the points of a study whose damaged boards have the same sizes: their
    damage and the seed of the boards."""
    target = point.config.simulated.target
    assert isinstance(target, DrawnTargetConfig)
    return digest([target.damage.to_data(), target.seed])


@dataclass(frozen=True)
class SweepPlan:
    """All groups of an experiment."""

    groups: tuple[Group, ...]
    """Leaders stand before the groups that they lead."""
    designs: Designs = field(default_factory=dict)
    """The damaged boards so far of a study with a precision, else empty."""

    def group_of(self, point: Point) -> Group:
        """Return the group of one of the experiment's points."""
        for group in self.groups:
            if any(member.digest == point.digest for member in group.points):
                return group
        raise KeyError(point.label)

    @property
    def renders(self) -> tuple[RenderJob, ...]:
        """The different views, in the order in which trials need them."""
        jobs = {}
        for group in self.groups:
            for batch in group.batches:
                jobs.update({job.path: job for job in batch.renders})
        return tuple(jobs.values())


def plan_of(
    experiment: Experiment,
    cache: Path,
    folder: Path | None = None,
    designs: Designs | None = None,
) -> SweepPlan:
    """Group the points of an experiment that share their frames. ``folder``: its results; None:
    the cache. ``designs``: the damaged boards so far of a study with a precision; without them a
    study has all boards that it declares, with sizes over the whole range."""
    by_frames: dict[str, list[Point]] = {}
    for point in experiment.points:
        by_frames.setdefault(point.frames_key, []).append(point)
    by_first_trials: dict[str, list[Group]] = {}
    for points in by_frames.values():
        design = designs[family_of(points[0])] if designs else None
        group = _group(tuple(points), cache, folder or cache, design)
        by_first_trials.setdefault(_before_thresholds(group), []).append(group)
    groups: list[Group] = []
    for leader, *followers in by_first_trials.values():
        also = tuple(point for group in followers for point in group.points)
        sharing = tuple(group for group in followers if group.shows_the_same_hole_free(leader))
        leader = replace(leader, also=also, sharing=sharing)
        groups.append(leader)
        for group in followers:
            is_shared = group in sharing
            led = replace(group, learning=(), first=(), leader=leader, is_shared=is_shared)
            groups.append(led)
    return SweepPlan(tuple(groups), designs or {})


def _before_thresholds(group: Group) -> str:
    """Return a text that is the same for groups of a study whose trials before thresholds are the
    same."""
    batches = (*group.learning, *group.first)
    if not batches or batches[-1].board is None:
        return group.points[0].frames_key
    judged_as = []
    for point in group.points:
        unnamed = replace(trial_point(point, None, None), digest="", variant="")
        judged_as.append((unnamed, point.config.threshold))
    shown = []
    for batch in batches:
        shown.append((batch.paths, [view.camera for view in batch.before(0)]))
    return repr([group.seed, group.poses, judged_as, shown])


def _group(
    points: tuple[Point, ...], cache: Path, folder: Path, design: BoardDesign | None
) -> Group:
    """Return the group of points that share their frames. Raises UserError for a target without
    damage."""
    config = points[0].config
    source = config.simulated
    if config.study is not None and isinstance(source.target, DrawnTargetConfig):
        boards = _StudyBoards(points, config.study, cache, design)
        calibrate = config.threshold.calibrate
        calibrating = 0 if calibrate is None else calibrate.boards or 0
        learning = boards.batches("learning", LEARNING_BOARDS)
        first = boards.batches("calibration", calibrating)
        damaged = boards.batches(
            "damaged", config.study.boards if design is None else design.boards
        )
        then = damaged + boards.batches("hole_free", config.study.hole_free_boards)
    else:
        target = source.target.declare()
        if not target.damages:
            raise UserError(
                "the target has no damage, so that there is nothing to find",
                fix="declare source.target.holes, source.target.dents or source.target.flaws",
            )
        learning = [batch_of(target, "learning", source, cache)] * LEARNING_BOARDS
        first = [batch_of(target, "hole_free", source, cache)]
        then = [batch_of(target, "damaged", source, cache)]
    group = Group(
        points=points,
        learning=(),
        first=tuple(first),
        then=tuple(then),
        seed=config.seed,
        folder=folder,
        poses=source.views,
    )
    if not group.learners:
        return group
    return replace(group, learning=(_joined("learning", learning),))


def _joined(role: Role, batches: Sequence[Batch]) -> Batch:
    """Return one batch whose trials need the views of several."""
    renders = {}
    views: list[BoardRef] = []
    earlier: list[BoardRef] = []
    for batch in batches:
        renders.update({job.path: job for job in batch.renders})
        views += batch.before(0)
        earlier += batch.references_before(0).earlier
    good_parts = batches[0].references_before(0).good_parts
    references = ReferenceBoards(tuple(earlier), good_parts)
    return Batch(role, tuple(renders.values()), tuple(views), references=references)


@dataclass(frozen=True)
class _StudyBoards:
    """Makes the batches of a study: one for each board."""

    points: tuple[Point, ...]
    """They share the family of boards, the camera, and the unknowns that are drawn for each board;
    each may have a reference of its own."""
    study: StudyConfig
    """The number of units of the camera."""
    cache: Path
    """The cache of renders."""
    design: BoardDesign | None
    """Sizes of the damaged boards; None: drawn over the whole range."""

    def batches(self, role: Role, count: int) -> list[Batch]:
        """Return the batches of a role's first ``count`` boards."""
        batches = []
        for board in range(count):
            source = source_of(self.points[0], role, board)
            assert isinstance(source.target, DrawnTargetConfig)
            chosen_mm = None
            if self.design is not None and role == "damaged":
                chosen_mm = self.design.sizes_mm(board)
            target = _drawn(source.target, role, board, chosen_mm)
            units = self._units(source.camera, role, board)
            batch = batch_of(target, role, source, self.cache, board, units)
            earlier = []
            if any(isinstance(reference, ScanReference) for reference in self._references):
                pose = source.target.earlier_pose(role, board)
                placed = target.model_copy(update={"pose": pose})
                earlier.append(batch_of(placed, "hole_free", source, self.cache))
            batches.append(_with_references(batch, earlier, self._good_parts))
        return batches

    @property
    def _references(self) -> list[AnyReference | None]:
        return [point.config.compared_with for point in self.points]

    @cached_property
    def _good_parts(self) -> list[Batch]:
        """The good parts, as many as any point compares with."""
        counts = [0]
        for reference in self._references:
            if isinstance(reference, GoodPartsReference):
                counts.append(reference.parts)
        batches = []
        for number in range(max(counts)):
            source = source_of(self.points[0], "good_part", number)
            assert isinstance(source.target, DrawnTargetConfig)
            part = _drawn(source.target, "good_part", number)
            batches.append(batch_of(part, "hole_free", source, self.cache))
        return batches

    def _units(self, camera: CameraConfig, role: Role, board: int) -> tuple[CameraConfig, ...]:
        """Return the units of the camera that inspect a board: all of the study's for a damaged
        board, one of its own for any other; none if the camera's own unit does."""
        calibrates = role in ("learning", "calibration")
        if not self.study.units or (calibrates and self.study.one_unit_calibrates):
            return ()
        numbers = range(self.study.units) if role == "damaged" else [board]
        seed = self.points[0].config.seed
        return tuple(unit_of(camera, seed, role, number) for number in numbers)


def _with_references(batch: Batch, earlier: Sequence[Batch], good_parts: Sequence[Batch]) -> Batch:
    """Return a batch with the boards that its own is compared with."""
    renders = list(batch.renders)
    for shown in (*earlier, *good_parts):
        renders += shown.renders
    references = ReferenceBoards(
        earlier=tuple(view for shown in earlier for view in shown.views),
        good_parts=tuple(view for shown in good_parts for view in shown.views),
    )
    return replace(batch, renders=tuple(renders), references=references)


# cameras, frames and detectors share boards
_drawn = lru_cache(maxsize=4096)(DrawnTargetConfig.drawn)


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
    damaged = role == "damaged"
    poses = [target.pose]
    if source.views is not None:
        poses = list(poses_of(source.views, target.pose))
    renders = []
    views = []
    for pose in poses:
        placed = target.model_copy(update={"pose": pose})
        shown = placed if damaged else placed.hole_free()
        render = RenderJob(shown, source.camera, source.render, cache)
        renders.append(render)
        views.append(BoardRef(str(render.path), source.camera, placed, damaged))
    return Batch(role, tuple(renders), tuple(views), board, units)


@dataclass(frozen=True)
class PlanPart:
    """Some repeats of one batch."""

    group: int
    """Number of the batch's group in the plan."""
    batch: Batch
    """The batch."""
    sets_threshold: bool
    """True if these trials set the group's thresholds."""
    repeats: range
    """The repeats."""


def parts_of(plan: SweepPlan, shard: Shard) -> tuple[list[list[PlanPart]], list[list[PlanPart]]]:
    """Cut a plan, by group, into parts that set thresholds (learning first), and the judged parts
    of a shard."""
    judged = _judged_parts(plan, shard)
    leaders = set()
    for group, parts in zip(plan.groups, judged, strict=True):
        if parts:
            leaders.add(id(group.leader or group))
    first: list[list[PlanPart]] = []
    for number, group in enumerate(plan.groups):
        parts = []
        if id(group) in leaders:
            for batch in (*group.learning, *group.first):
                repeats = range(group.most_repeats(batch))
                parts += _cut(number, batch, repeats, sets_threshold=True)
        first.append(parts)
    return first, judged


def _judged_parts(plan: SweepPlan, shard: Shard) -> list[list[PlanPart]]:
    """Return a shard's parts of the judged batches, by group."""
    total = sum(group.most_repeats(batch) for group in plan.groups for batch in group.then)
    wanted = shard.part(total)
    before = 0
    judged: list[list[PlanPart]] = []
    for number, group in enumerate(plan.groups):
        parts: list[PlanPart] = []
        for batch in group.then:
            count = group.most_repeats(batch)
            start = max(wanted.start - before, 0)
            stop = min(wanted.stop - before, count)
            parts += _cut(number, batch, range(start, stop), sets_threshold=False)
            before += count
        judged.append(parts)
    return judged


def _cut(number: int, batch: Batch, repeats: range, *, sets_threshold: bool) -> list[PlanPart]:
    """Cut the repeats of a batch into parts of `MOST_REPEATS` at most."""
    parts = []
    for start in range(repeats.start, repeats.stop, MOST_REPEATS):
        stop = min(start + MOST_REPEATS, repeats.stop)
        parts.append(PlanPart(number, batch, sets_threshold, range(start, stop)))
    return parts
