"""What an experiment costs before it runs: set-ups to render, trials to run, and which points share their frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from harness.engine.journal import JOURNAL_VERSION
from harness.engine.setup import SetUpRef
from harness.engine.trial import PointTask, Role, TrialTask
from harness.experiment.points import Experiment, Point
from harness.experiment.schema import SimulatedSource
from harness.vocabulary.errors import UserError
from harness.vocabulary.seeds import canonical_json, digest
from harness.vocabulary.sources import source_digest
from harness.vocabulary.units import MM
from scenes.perspectives import AnyViews, poses_of
from scenes.render.cache import render_key
from scenes.render.settings import RenderConfig
from scenes.sensor.camera import CameraConfig, camera_of
from scenes.target.custom import TargetConfig
from scenes.target.wavelength import at_wavelength

CODE = ("detectors", "harness/engine", "harness/evaluation", "harness/vocabulary", "scenes")
PACKAGES = ("numpy", "scipy", "numba", "opencv-python-headless")
"""What decides a trial's numbers beside its task: a change of any makes stored trials count as not done."""


@dataclass(frozen=True)
class RenderJob:
    """One view to render, or to find in the cache."""

    target: TargetConfig
    camera: CameraConfig
    config: RenderConfig
    folder: Path

    @cached_property
    def path(self) -> Path:
        """Where the cache keeps it."""
        return self.folder / f"{render_key(self.target, camera_of(self.camera).optics, self.config)}.npz"


@dataclass(frozen=True)
class PlannedView:
    """One pose of the target: both its renders, and what names them to a worker."""

    damaged: RenderJob
    hole_free: RenderJob
    set_up: SetUpRef


@dataclass(frozen=True)
class Group:
    """Points that share their frames: one set-up, one seed. Trials draw the frames once for all of them.

    ``views``: one, or those from which the points' maps are made, of which ``poses`` is the declaration.
    """

    points: tuple[Point, ...]
    views: tuple[PlannedView, ...]
    seed: int
    poses: AnyViews | None = None

    @property
    def renders(self) -> tuple[RenderJob, ...]:
        """All renders, hole-free ones first."""
        return (*(view.hole_free for view in self.views), *(view.damaged for view in self.views))

    @property
    def set_ups(self) -> tuple[SetUpRef, ...]:
        """Of each view."""
        return tuple(view.set_up for view in self.views)

    def repeats(self, role: Role, point: Point) -> int:
        """How many trials of a role a point wants. With a given threshold, as many hole-free ones as damaged ones."""
        calibrate = point.config.threshold.calibrate
        if role == "hole_free" and calibrate is not None:
            return calibrate.repeats
        return point.config.repeats

    def trials(self, role: Role, thresholds: Mapping[str, float]) -> Iterator[tuple[str, TrialTask]]:
        """(journal key, task) of each trial of a role. ``thresholds`` by point digest, empty while calibrating."""
        for repeat in range(max(self.repeats(role, point) for point in self.points)):
            wanted = tuple(
                _point_task(point, thresholds.get(point.digest, point.config.threshold.k))
                for point in self.points
                if repeat < self.repeats(role, point)
            )
            task = TrialTask(self.set_ups, self.seed, role, repeat, wanted, self.poses)
            yield self._key(task), task

    def _key(self, task: TrialTask) -> str:
        asked = [[point.digest, point.variant, point.threshold] for point in task.points]
        content = [
            JOURNAL_VERSION,
            source_digest(CODE, PACKAGES),
            *(render.path.stem for render in self.renders),
            None if self.poses is None else self.poses.to_data(),
            task.role,
            task.repeat,
            asked,
        ]
        return f"{task.role}-{task.repeat:05d}-{digest(content)}"


def _point_task(point: Point, threshold: float | None) -> PointTask:
    config = point.config
    return PointTask(
        digest=point.digest,
        variant=point.variant,
        frames=config.capture.frames,
        detector=config.detector.name,
        settings_json=canonical_json(config.detector.settings),
        average=config.capture.average,
        radius_m=config.matching.radius_mm * MM,
        threshold=threshold,
        mapping=config.mapping,
    )


@dataclass(frozen=True)
class Plan:
    """All groups of an experiment with a simulated source."""

    groups: tuple[Group, ...]

    @property
    def renders(self) -> tuple[RenderJob, ...]:
        """The distinct views, in the order in which trials need them."""
        jobs = {job.path: job for group in self.groups for job in group.renders}
        return tuple(jobs.values())

    @property
    def trial_count(self) -> int:
        """Trials of both roles."""
        roles: tuple[Role, ...] = ("hole_free", "damaged")
        return sum(max(g.repeats(role, p) for p in g.points) for g in self.groups for role in roles)


def plan_of(experiment: Experiment, cache: Path) -> Plan:
    """Group the points of an experiment by the frames that they share."""
    by_frames: dict[str, list[Point]] = {}
    for point in experiment.points:
        by_frames.setdefault(point.frames_key, []).append(point)
    return Plan(tuple(_group(tuple(points), cache) for points in by_frames.values()))


def _group(points: tuple[Point, ...], cache: Path) -> Group:
    source = points[0].config.source
    assert isinstance(source, SimulatedSource)
    target = at_wavelength(source.target.declare(), camera_of(source.camera).optics.wavelength_nm)
    if not target.damages:
        raise UserError(
            "the target has neither holes nor dents, so that there is nothing to find",
            legal="at least one hole or dent",
            fix="declare source.target.holes or source.target.dents",
        )
    poses = (target.pose,) if source.views is None else poses_of(source.views, target.pose)
    views = tuple(_view(target.model_copy(update={"pose": pose}), source, cache) for pose in poses)
    return Group(points, views, points[0].config.seed, source.views)


def _view(target: TargetConfig, source: SimulatedSource, cache: Path) -> PlannedView:
    damaged, hole_free = (
        RenderJob(declared, source.camera, source.render, cache) for declared in (target, target.hole_free())
    )
    return PlannedView(damaged, hole_free, SetUpRef(str(damaged.path), str(hole_free.path), source.camera, target))
