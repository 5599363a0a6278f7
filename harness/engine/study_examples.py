"""Pictures for a study's report: damages just below, at and above the limit, their boards drawn again from seeds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.engine.averages import averages_of
from harness.engine.examples import outline_px
from harness.engine.judge import Judgement, judge
from harness.engine.plan import Batch, Group, Plan
from harness.engine.setup import SetUp, load_set_up
from harness.engine.sight import Sight, sight_of_view
from harness.engine.trial import PointTask, TrialTask, capture_of
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.record import Inspected
from harness.experiment.points import Point
from harness.report.examples import StudyExample, Where
from harness.vocabulary.units import MM

SHARES: dict[Where, float] = {"below": 0.75, "at": 1.0, "above": 1.25}
"""Sizes to show, of the limit."""
MOST_SET_UPS = 6
ROOM_MM = 12.0
"""Around the largest of a set-up's damages in their pictures, which are all of one size."""


@dataclass(frozen=True)
class Shown:
    """One damage to show: row ``row`` of the limit's inspections, on the board of ``batch``."""

    group: Group
    batch: Batch
    point: Point
    limit: SetUpLimit
    where: Where
    row: int
    half_m: float


def shown_in(plan: Plan, limits: Sequence[SetUpLimit]) -> list[Shown]:
    """Of each of the first few set-ups the damages whose sizes lie nearest to 0.75, 1 and 1.25 of its limit: of a90/95
    where that is demonstrated, else of the estimate of a90, a50 or the middle size; of smaller ones where that is too
    near the largest size. One view's clouds only: of maps there are none."""
    by_place = {(point.variant, point.config.capture.frames): (group, point) for group, point in _points(plan)}
    shown = []
    for limit in limits[:MOST_SET_UPS]:
        group, point = by_place[limit.record.variant, limit.record.frames]
        if group.poses is None:
            shown += list(_shown(group, point, limit))
    return shown


def _points(plan: Plan) -> Iterator[tuple[Group, Point]]:
    for group in plan.groups:
        for point in group.points:
            yield group, point


def _shown(group: Group, point: Point, limit: SetUpLimit) -> Iterator[Shown]:
    seen = limit.record.inspected
    batches = {batch.board: batch for batch in group.then if batch.role == "damaged"}
    chosen = _chosen(seen, _limit_mm(limit))
    half_m = (max(seen.diameter_mm[row] for row in chosen.values()) / 2 + ROOM_MM) * MM
    for where, row in chosen.items():
        yield Shown(group, batches[int(seen.board[row])], point, limit, where, row, half_m)


def study_examples(shown: Sequence[Shown], thresholds: Mapping[str, float]) -> list[StudyExample]:
    """The pictures; every view is there."""
    return [_example(one, thresholds) for one in shown]


def _example(one: Shown, thresholds: Mapping[str, float]) -> StudyExample:
    seen, row, point = one.limit.record.inspected, one.row, one.point
    set_up, sight, judgement = _again(one.group, one.batch, point, int(seen.repeat[row]), thresholds)
    curve = None if one.limit.statement is None else one.limit.statement.curve
    return _cut_out(
        set_up,
        sight,
        judgement,
        one.half_m,
        variant=point.variant,
        frames=point.config.capture.frames,
        board=int(seen.board[row]),
        hole=str(seen.hole[row]),
        where=one.where,
        pod=float("nan") if curve is None else float(curve.pod(seen.diameter_mm[row])),
        hit=bool(seen.hit[row]),
        score=float(seen.signal[row]),
    )


def _limit_mm(limit: SetUpLimit) -> float:
    seen_mm = limit.record.inspected.diameter_mm
    sizes = (limit.a90_95.value, limit.a90_mm, limit.a50_mm, float(np.median(seen_mm)))
    wanted = next(size for size in sizes if np.isfinite(size))
    return min(wanted, float(seen_mm.max()) / max(SHARES.values()))


def _chosen(seen: Inspected, limit_mm: float) -> dict[Where, int]:
    """Rows of the inspections to show, each another one."""
    rows: dict[Where, int] = {}
    for where, share in SHARES.items():
        apart = np.abs(seen.diameter_mm - share * limit_mm)
        apart[list(rows.values())] = np.inf
        rows[where] = int(apart.argmin())
    return rows


def _again(
    group: Group, batch: Batch, point: Point, repeat: int, thresholds: Mapping[str, float]
) -> tuple[SetUp, Sight, Judgement]:
    """A run as it was."""
    (task,) = (task for _, task in group.trials(batch, thresholds) if task.repeat == repeat)
    asked = next(one for one in task.points if one.digest == point.digest)
    set_up = load_set_up(batch.set_ups[0])
    sight = _sight(set_up, task, asked)
    detector, settings = asked.detector, asked.settings_json
    return set_up, sight, judge(sight, detector, settings, asked.threshold, asked.radius_m, hole_free=False)


def _sight(set_up: SetUp, task: TrialTask, asked: PointTask) -> Sight:
    capture = capture_of(set_up, 0, task, asked.frames)
    cloud = averages_of(capture, [asked.frames], asked.average, exact=asked.exact)[asked.frames]
    return sight_of_view(set_up, cloud, hole_free=False)


def _cut_out(
    set_up: SetUp, sight: Sight, judgement: Judgement, half_m: float, *, hole: str, **facts: object
) -> StudyExample:
    damage = next(one for one in sight.truth if str(one.id) == hole)
    rim = outline_px(set_up, damage)
    pitch_mm = float(np.mean(set_up.pitch_mm))
    half = int(np.ceil(half_m / MM / pitch_mm))
    middle = np.round(rim.mean(axis=0)).astype(int)
    detected = np.zeros(sight.cloud.valid.size, bool)
    for detection in judgement.detections:
        detected[detection.pixels] = True
    return StudyExample(
        hole=hole,
        diameter_mm=damage.diameter_m / MM,
        depth_mm=damage.depth_m / MM,
        threshold=float(judgement.run["threshold"]),
        residual_mm=_window(judgement.evidence.residual_m / MM, middle, half, np.nan),
        detected=_window(detected.reshape(sight.cloud.valid.shape), middle, half, False),
        outline_px=rim - (middle - half),
        pitch_mm=pitch_mm,
        **facts,  # type: ignore[arg-type]
    )


def _window(image: np.ndarray, middle: np.ndarray, half: int, beyond: float | bool) -> np.ndarray:
    """A square of 2 half + 1 pixels about a (column, row); ``beyond`` the image's edge."""
    padded = np.pad(image, half, constant_values=beyond)
    column, row = middle
    return np.asarray(padded[row : row + 2 * half + 1, column : column + 2 * half + 1])
