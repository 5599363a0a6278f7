"""One trial: frames of one set-up, their averages, the maps made of them, every detector that asked for them, measured
against the truth."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from detectors.average import AverageConfig
from detectors.mapping.settings import MappingConfig
from harness.engine.averages import averages_of
from harness.engine.board_noise import board_noise_rows
from harness.engine.boards import STUDY_TABLES, Judged, study_rows
from harness.engine.judge import judge
from harness.engine.maps import MapMaker
from harness.engine.setup import SetUp, SetUpRef, load_set_up
from harness.engine.sight import Sight, face_errors_m, sight_of_view
from harness.vocabulary.capture import Cloud
from harness.vocabulary.seeds import canonical_json
from scenes.perspectives import AnyViews
from scenes.sensor.source import SimulatedCapture

Role = Literal["calibration", "hole_free", "damaged"]
"""What a trial's target is for. Only in a study do boards that set a threshold ("calibration") differ from those on
which false calls are counted at it ("hole_free")."""
Record = dict[str, list[dict[str, Any]]]
TABLES = ("runs", "holes", "probes", "noise", "registrations", *STUDY_TABLES)


@dataclass(frozen=True)
class PointTask:
    """What one point of the experiment asks of a trial. ``threshold`` is None while it is being calibrated."""

    digest: str
    variant: str
    frames: int
    detector: str
    settings_json: str
    average: AverageConfig
    radius_m: float
    threshold: float | None
    mapping: MappingConfig | None = None
    exact: bool = False


@dataclass(frozen=True)
class TrialTask:
    """Frames of one set-up, drawn once, judged by all points that share them. ``poses`` declares the views, if there
    are several. ``board``: its number among a study's boards of this role; None where the target is the only one."""

    set_ups: tuple[SetUpRef, ...]
    seed: int
    role: Role
    repeat: int
    points: tuple[PointTask, ...]
    poses: AnyViews | None = None
    board: int | None = None


def run_trial(task: TrialTask) -> Record:
    """Run one trial; rows for the tables of `TABLES` (columns: `harness.engine.tables`)."""
    set_ups = [load_set_up(ref) for ref in task.set_ups]
    record: Record = {name: [] for name in TABLES}
    for config, points in _by_average(task.points):
        began = time.perf_counter()
        clouds = [_clouds(set_up, number, task, points, config) for number, set_up in enumerate(set_ups)]
        seconds_frames = (time.perf_counter() - began) / len(points)
        if task.role == "hole_free" and task.poses is None and task.board is None:
            variants = {(point.variant, point.frames) for point in points}
            record["probes"] += list(_probe_rows(set_ups[0], clouds[0], task.repeat, variants))
            pair = capture_of(set_ups[0], 0, task, 2)
            record["noise"] += list(board_noise_rows(set_ups[0], clouds[0], pair, task.repeat, variants))
        judged = _Judged(task, set_ups, clouds)
        for point in points:
            for name, rows in judged.rows(point, seconds_frames).items():
                record[name] += rows
    return record


def _clouds(
    set_up: SetUp, number: int, task: TrialTask, points: Sequence[PointTask], config: AverageConfig
) -> dict[int, Cloud]:
    """One view's averages, of as many frames as the points that use this view ask for."""
    views = [point.mapping.views if point.mapping is not None else None for point in points]
    counts = sorted({point.frames for point, n in zip(points, views, strict=True) if n is None or number < n})
    if not counts:
        return {}
    return averages_of(capture_of(set_up, number, task, counts[-1]), counts, config, exact=points[0].exact)


def capture_of(set_up: SetUp, number: int, task: TrialTask, frames: int) -> SimulatedCapture:
    """The frames of one view in one trial. The first view's are those of an experiment that has no other."""
    view = () if number == 0 else ("view", number)
    return set_up.unit.capture(frames, task.seed, task.role, task.repeat, *board_labels(task), *view)


def board_labels(task: TrialTask) -> tuple[str | int, ...]:
    """What tells the random streams of a study's boards apart."""
    return () if task.board is None else ("board", task.board)


class _Judged:
    """What the points of a trial make of its clouds; points that come to the same share the work."""

    def __init__(self, task: TrialTask, set_ups: Sequence[SetUp], clouds: Sequence[dict[int, Cloud]]) -> None:
        self._task = task
        self._hole_free = task.role != "damaged"
        self._set_ups = set_ups
        self._clouds = clouds
        self._done: dict[str, Judged] = {}
        self._maps = None
        if task.poses is not None:
            labels = (task.role, task.repeat, *board_labels(task))
            self._maps = MapMaker(set_ups, clouds, task.poses, labels, hole_free=self._hole_free)

    def rows(self, point: PointTask, seconds_frames: float) -> Record:
        """The rows of one point, by table."""
        common = {"variant": point.variant, "frames": point.frames, "repeat": self._task.repeat}
        if self._task.board is not None:
            common["board"] = self._task.board
        extra: dict[str, Any] = {}
        registrations: list[dict[str, Any]] = []
        if self._maps is not None and point.mapping is not None:
            merged = self._maps.merged(point.mapping, point.frames)
            used = len(merged.views_used)
            extra = {
                "views_used": used,
                "views_left_out": self._maps.count(point.mapping) - used,
                "seconds_map": self._maps.seconds(point.mapping, point.frames),
            }
            registrations = list(self._maps.registration_rows(point.mapping, point.frames))
        began = time.perf_counter()
        judged = self._judged(point)
        run = {**judged.run, **extra, "seconds_frames": seconds_frames, "seconds_detect": time.perf_counter() - began}
        role = {"role": self._task.role}
        named = {"point": point.digest, **common}
        rows = {name: [{**common, **role, **row} for row in rows] for name, rows in judged.of_study.items()}
        return rows | {
            "runs": [{**named, **role, **run}],
            "holes": [{**named, **hole} for hole in judged.holes],
            "registrations": [{**common, **role, **row} for row in registrations],
            "probes": [] if judged.errors is None else [{**common, "error_tenth_um": judged.errors}],
        }

    def _judged(self, point: PointTask) -> Judged:
        if self._maps is None or point.mapping is None:
            sight = sight_of_view(self._set_ups[0], self._clouds[0][point.frames], hole_free=self._hole_free)
            return self._judge(sight, point)
        asked = [point.detector, point.settings_json, point.threshold, point.radius_m]
        key = canonical_json([self._maps.key(point.mapping, point.frames), *asked])
        if key not in self._done:
            sight = self._maps.sight(point.mapping, point.frames)
            errors = self._map_errors(sight) if self._hole_free and self._task.board is None else None
            self._done[key] = replace(self._judge(sight, point), errors=errors)
        return self._done[key]

    def _judge(self, sight: Sight, point: PointTask) -> Judged:
        settings, limit = point.settings_json, point.threshold
        judgement = judge(sight, point.detector, settings, limit, point.radius_m, hole_free=self._hole_free)
        if self._task.board is None:
            return Judged(judgement.run, judgement.holes)
        return study_rows(sight, judgement, point.radius_m, hole_free=self._hole_free)

    def _map_errors(self, sight: Sight) -> list[int | None]:
        first = self._set_ups[0]
        return _tenth_um(face_errors_m(sight, first.board_xy_m.reshape(-1, 2)[first.probes]))


def _by_average(points: Sequence[PointTask]) -> Iterator[tuple[AverageConfig, list[PointTask]]]:
    groups: dict[str, list[PointTask]] = {}
    for point in points:
        groups.setdefault(canonical_json([point.average.to_data(), point.exact]), []).append(point)
    for group in groups.values():
        yield group[0].average, group


def _probe_rows(
    set_up: SetUp, clouds: dict[int, Cloud], repeat: int, variants: set[tuple[str, int]]
) -> Iterator[dict[str, Any]]:
    """Errors of z on the probes, for each variant and number of frames: one row with a list."""
    for variant, frames in sorted(variants):
        error_m = clouds[frames].points_m[..., 2].ravel()[set_up.probes] - set_up.seen_z_m.ravel()[set_up.probes]
        yield {"variant": variant, "frames": frames, "repeat": repeat, "error_tenth_um": _tenth_um(error_m)}


def _tenth_um(errors_m: np.ndarray) -> list[int | None]:
    """Errors as whole tenths of a micrometre, for records that stay small."""
    return [round(float(error) * 1e7) if np.isfinite(error) else None for error in errors_m]
