"""One trial: frames of one set-up, their averages, the maps made of them, every detector that asked for them, measured
against the truth."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Literal

import numpy as np

from detectors.average import AverageConfig
from detectors.mapping.settings import MappingConfig
from harness.engine.averages import averages_of
from harness.engine.judge import STUDY_TABLES, PointRows, judge, study_rows
from harness.engine.maps import MapMaker
from harness.engine.setup import KnownCloud, SetUp, SetUpRef, face_errors_m, known_view, load_set_up
from harness.vocabulary.capture import Cloud
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.units import MM
from scenes.perspectives import AnyViews
from scenes.sensor.source import SimulatedCapture

Role = Literal["calibration", "hole_free", "damaged"]
"""The purpose of a trial's target. Only in a study do boards that set a threshold ("calibration") differ from those on
which false calls are counted at it ("hole_free")."""
Record = dict[str, list[dict[str, Any]]]
TABLES = ("runs", "holes", "probes", "noise", "registrations", *STUDY_TABLES)


@dataclass(frozen=True)
class PointTask:
    """The demands of a point on a trial. ``threshold`` is None while it is being calibrated."""

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
        judged = _PointJudge(task, set_ups, clouds)
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
    """Labels that separate the random streams of a study's boards."""
    return () if task.board is None else ("board", task.board)


class _PointJudge:
    """The rows of a trial's points, from its clouds; points that come to the same share the work."""

    def __init__(self, task: TrialTask, set_ups: Sequence[SetUp], clouds: Sequence[dict[int, Cloud]]) -> None:
        self._task = task
        self._hole_free = task.role != "damaged"
        self._set_ups = set_ups
        self._clouds = clouds
        self._done: dict[str, PointRows] = {}
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

    def _judged(self, point: PointTask) -> PointRows:
        if self._maps is None or point.mapping is None:
            known = known_view(self._set_ups[0], self._clouds[0][point.frames], hole_free=self._hole_free)
            return self._judge(known, point)
        asked = [point.detector, point.settings_json, point.threshold, point.radius_m]
        key = canonical_json([self._maps.key(point.mapping, point.frames), *asked])
        if key not in self._done:
            known = self._maps.known(point.mapping, point.frames)
            errors = self._map_errors(known) if self._hole_free and self._task.board is None else None
            self._done[key] = replace(self._judge(known, point), errors=errors)
        return self._done[key]

    def _judge(self, known: KnownCloud, point: PointTask) -> PointRows:
        settings, limit = point.settings_json, point.threshold
        judged_cloud = judge(known, point.detector, settings, limit, point.radius_m, hole_free=self._hole_free)
        if self._task.board is None:
            return PointRows(judged_cloud.run, judged_cloud.holes)
        return study_rows(known, judged_cloud, point.radius_m, hole_free=self._hole_free)

    def _map_errors(self, known: KnownCloud) -> list[int | None]:
        first = self._set_ups[0]
        return _tenth_um(face_errors_m(known, first.board_xy_m.reshape(-1, 2)[first.probes]))


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


LAGS = (1, 2, 3)
"""Distances in pixels at which the noise's correlation is taken."""
FEWEST_PAIRS = 50
"""Pairs of pixels below which a correlation is not told: its standard error would exceed 0.14."""


def board_noise_rows(
    set_up: SetUp, clouds: Mapping[int, Cloud], capture: SimulatedCapture, repeat: int, variants: set[tuple[str, int]]
) -> Iterator[dict[str, Any]]:
    """Rows, one for each (variant, number of frames), of what one camera makes of an undamaged board: pitch of its
    pixels, share that is valid, temporal noise and its grain.

    Temporal noise comes from the difference of a capture's first two frames, from which everything that frames share
    is gone: scene, multipath, fixed pattern, rounding that does not change. A displacement of a whole frame is taken
    out with the difference's median.

    ``valid_share``: of the board's pixels, after averaging so many frames. ``single_frame_mm``: standard deviation over
    pixels of one frame's temporal noise of z. ``correlation_u<k>``, ``correlation_v<k>``: of that noise with itself k
    columns or rows on. ``pitch_u_mm``, ``pitch_v_mm``: median distance on the board between neighbouring pixels.
    """
    pair = [frame.z_m for frame in islice(capture.frames(), 2)]
    noise = pair_noise(pair[0], pair[1], set_up.bare) if len(pair) == 2 else pair_noise(pair[0], pair[0], set_up.bare)
    pitch = set_up.pitch_mm
    for variant, frames in sorted(variants):
        yield {
            "variant": variant,
            "frames": frames,
            "repeat": repeat,
            "valid_share": float(clouds[frames].valid[set_up.on_board].mean()),
            "pitch_u_mm": pitch[0],
            "pitch_v_mm": pitch[1],
            **noise,
        }


def pair_noise(first_z_m: np.ndarray, second_z_m: np.ndarray, where: np.ndarray) -> dict[str, float]:
    """Standard deviation of one frame's temporal noise and its correlations from two frames' z (h, w), metres.

    Pixels count that are in ``where`` (h, w) and valid in both frames; NaN where there are too few.
    """
    difference = (first_z_m.astype(float) - second_z_m.astype(float)) / np.sqrt(2)
    there = where & np.isfinite(difference)
    if there.sum() < FEWEST_PAIRS:
        return {"single_frame_mm": np.nan} | {f"correlation_{way}{lag}": np.nan for way in "uv" for lag in LAGS}
    noise = np.where(there, difference - np.median(difference[there]), 0.0)
    found = {"single_frame_mm": float(np.sqrt((noise[there] ** 2).mean())) / MM}
    for way, turned, mask in (("u", noise, there), ("v", noise.T, there.T)):
        found |= {f"correlation_{way}{lag}": _correlation(turned, mask, lag) for lag in LAGS}
    return found


def _correlation(noise: np.ndarray, there: np.ndarray, lag: int) -> float:
    """Correlation of pixels with those ``lag`` columns on, over pairs that are both there."""
    both = there[:, :-lag] & there[:, lag:]
    a, b = noise[:, :-lag][both], noise[:, lag:][both]
    power = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / power) if len(a) >= FEWEST_PAIRS and power > 0 else float("nan")
