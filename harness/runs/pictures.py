"""Draws a report's pictures again from their seeds: the first damaged repeat or, in a study,
damages near the limit."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from detectors.views.mapping.merge import SEVERAL, Mapped
from detectors.views.mapping.settings import MappingConfig
from harness.evaluation.study.limit import SetUpLimit
from harness.experiment.schema import Point
from harness.records.examples import (
    Circle3d,
    CircleKind,
    ExampleCloud,
    HoleInView,
    MappedExample,
    Scene3d,
    StudyExample,
    Where,
)
from harness.runs.plan import Batch, Group, SweepPlan
from harness.trials.judge import JudgedCloud, judge
from harness.trials.setup import SetUp, known_view, load_set_up
from harness.trials.trial import MapMaker, PointTask, TrialTask, averages_of, capture_of
from harness.vocabulary.geometry import MM, transform_points
from harness.vocabulary.seeds import canonical_json
from scenes.target.truth import Damage, face_of

MOST_POINTS = 60_000  # most points of a merged cloud in a picture
SHARES: dict[Where, float] = {
    "below": 0.75,
    "at": 1.0,
    "above": 1.25,
}  # size of the damage over the limit
MOST_SET_UPS = 6
ROOM_MM = 12.0  # margin around the largest damage of a set-up, whose pictures all have one size
GREY = 160


def pictures_of(group: Group, thresholds: Mapping[str, float]) -> list[Any]:
    """Return the example clouds of a group, or of its maps."""
    return (
        _cloud_examples(group, thresholds)
        if group.poses is None
        else _map_examples(group, thresholds)
    )


def _judged(task: TrialTask, point: PointTask, most: int) -> JudgedCloud:
    """Judge the cloud of one view like a trial that drew ``most`` frames."""
    set_up = load_set_up(task.set_ups[0])
    capture = capture_of(set_up, 0, task, most)
    clouds = averages_of(capture, [point.frames], point.average, point.exact, point.flat_field)
    known = known_view(set_up, clouds[point.frames], hole_free=False)
    given = (point.detector, point.settings_json, point.threshold, point.radius_m)
    return judge(known, *given, overlap=point.overlap, hole_free=False, learned=point.learned)


def _detected(judged: JudgedCloud) -> np.ndarray:
    """Return (h, w) bool: pixels that belong to a detection."""
    detected = np.zeros(judged.evidence.score.shape, bool)
    for detection in judged.detections:
        detected.ravel()[detection.pixels] = True
    return detected


def _cloud_examples(group: Group, thresholds: Mapping[str, float]) -> list[ExampleCloud]:
    """Return the clouds of repeat 0 of each variant of a group, at its smallest and largest number
    of frames."""
    batch = group.damaged
    by_variant = dict[str, list[PointTask]]()
    _, task = next(group.trials(batch, thresholds))
    for point in sorted(task.points, key=lambda point: point.frames):
        by_variant.setdefault(point.variant, []).append(point)
    set_up = load_set_up(batch.set_ups[0])
    region = set_up.unit.region
    lens = set_up.unit.camera.nominal_lens
    marks = []
    for damage in set_up.truth:
        u, v = lens.project(damage.centre_camera_m[None])[0]
        radius_px = float(lens.fx * damage.diameter_m / 2 / damage.centre_camera_m[2])
        sizes_mm = damage.diameter_m / MM, damage.depth_m / MM
        marks.append(
            HoleInView(
                str(damage.id), float(u - region.col0), float(v - region.row0), radius_px, *sizes_mm
            )
        )
    examples = []
    for point in (point for found in by_variant.values() for point in (found[0], *found[1:][-1:])):
        judged = _judged(task, point, max(each.frames for each in task.points))
        example = ExampleCloud(
            frames=point.frames,
            variant=point.variant,
            residual_mm=judged.evidence.residual_m / MM,
            detected=_detected(judged),
            inside=np.isfinite(judged.evidence.score),
            truth=tuple(marks),
            z_truth_mm=set_up.seen_z_m / MM,
        )
        examples.append(example)
    return examples


def _outline_px(set_up: SetUp, damage: Damage) -> np.ndarray:
    """Return columns and rows (n, 2) of a damage's rim on the cloud's grid; a circle for a hole or
    dent."""
    region = set_up.unit.region
    lens = set_up.unit.camera.nominal_lens
    across = np.cross(damage.axis_camera, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    along = np.cross(damage.axis_camera, across)
    turn = np.linspace(0, 2 * np.pi, 64)[:, None]
    rim = damage.centre_camera_m + damage.diameter_m / 2 * (
        np.cos(turn) * across + np.sin(turn) * along
    )
    if (outline := damage.outline_board_m) is not None:
        on_face = face_of(set_up.target.board).point(*outline.T)
        rim = transform_points(set_up.T_camera_board, np.vstack([on_face, on_face[:1]]))
    return np.asarray(lens.project(rim) - [region.col0, region.row0])


def _map_examples(group: Group, thresholds: Mapping[str, float]) -> list[MappedExample]:
    """Return maps of the fewest and of all views, one per merge, with the most frames and the last
    registration."""
    batch = group.damaged
    points = [
        point
        for point in group.points
        if point.digest in thresholds and point.config.mapping is not None
    ]
    several = [point for point in points if (_mapping(point).views or len(batch.renders)) > 1]
    most = max((point.config.capture.frames for point in several), default=0)
    last: dict[tuple[int, str], Point] = {}
    for point in several:
        # a variation has a picture only if the group holds nothing else
        if point.config.capture.frames == most and (
            not point.is_variation or points[0].is_variation
        ):
            last[_mapping(point).views or len(batch.renders), _mapping(point).merge.kind] = point
    ends = {pick(count for count, _ in last) for pick in (min, max)} if last else set()
    if not last or group.poses is None:
        return []
    set_ups = [load_set_up(ref) for ref in batch.set_ups]
    _, task = next(group.trials(batch, thresholds))
    config = next(iter(last.values())).config.capture
    captures = [capture_of(set_up, number, task, most) for number, set_up in enumerate(set_ups)]
    clouds = [
        averages_of(capture, [most], config.average, config.exact, config.flat_field)
        for capture in captures
    ]
    maps = MapMaker(set_ups, clouds, group.poses, ("damaged", 0))
    chosen = [point for (count, _), point in last.items() if count in ends]
    return [
        _map_example(maps, point, thresholds[point.digest], group.learned.get(point.digest))
        for point in chosen
    ]


def _mapping(point: Point) -> MappingConfig:
    return cast("MappingConfig", point.config.mapping)


def _map_example(
    maps: MapMaker, point: Point, threshold: float, learned: str | None
) -> MappedExample:
    mapping = _mapping(point)
    frames = point.config.capture.frames
    known = maps.known(mapping, frames, hole_free=False)
    cloud = known.cloud
    settings = canonical_json(point.config.detector.settings)
    radius_m = point.config.matching.radius_mm * MM
    named = (point.config.detector.name, settings, threshold, radius_m)
    judged = judge(known, *named, hole_free=False, learned=learned)
    shown = np.flatnonzero(cloud.valid.ravel())
    shown = shown[:: max(1, -(-len(shown) // MOST_POINTS))]
    points_m = transform_points(known.T_board_cloud, cloud.points_m.reshape(-1, 3)[shown])
    circles = []

    def add(centre_m: np.ndarray, diameter_m: float, label: str, kind: CircleKind) -> None:
        centre_mm = np.array([*centre_m[:2], 0.0]) / MM
        circles.append(Circle3d(centre_mm, np.array([0.0, 0.0, 1.0]), diameter_m / MM, label, kind))

    for n, damage in enumerate(known.truth):
        kind: CircleKind = "found" if n in judged.pairs else "missed"
        add(damage.centre_board_m, damage.diameter_m, str(damage.id), kind)
    for n, (place_m, detection) in enumerate(zip(judged.places_m, judged.detections, strict=True)):
        diameter_m = judged.detector.measure(cloud, judged.evidence, detection).extent_diameter_m
        kind = "finding" if n in judged.pairs.values() else "false call"
        add(place_m, diameter_m, f"{diameter_m / MM:.1f}", kind)
    merged = maps.merged(mapping, frames)
    mapped = Mapped(maps.prepared(mapping, frames), maps.registrations(mapping, frames), merged)
    count = maps.count(mapping)
    way = (mapping.registration.method, mapping.merge.kind)
    names = tuple(view.view.name for view in mapped.views)
    number_of = np.array(
        [*map(names.index, merged.views_used), SEVERAL]
    )  # a view that failed keeps its number
    scene = Scene3d(
        points_mm=points_m / MM,
        frame="board",
        rgb=np.full((len(shown), 3), GREY, np.uint8)
        if cloud.rgb is None
        else cloud.rgb.reshape(-1, 3)[shown],
        residual_mm=judged.evidence.residual_m.ravel()[shown] / MM,
        detected=_detected(judged).ravel()[shown],
        view_of=number_of[mapped.view_of_points()[shown]],
        view_names=names,
        circles=tuple(circles),
        facts=(
            ("views", f"{count} ({', '.join(way)})"),
            ("frames a view", str(frames)),
            ("holes found", f"{len(judged.pairs)} of {len(known.truth)}"),
        ),
    )
    return MappedExample(point.variant, frames, count, *way, scene, point.is_variation)


class ShownDamage(NamedTuple):
    """A damage to show: row ``row`` of the limit's inspections, on the board of ``batch``."""

    group: Group
    batch: Batch
    point: Point
    limit: SetUpLimit
    where: Where
    row: int
    half_m: float


def shown_in(plan: SweepPlan, limits: Sequence[SetUpLimit]) -> Iterator[list[ShownDamage]]:
    """Yield, for the first set-ups with single views, the damages closest to 0.75, 1 and 1.25 of
    the limit."""
    places = [(group, point) for group in plan.groups for point in group.points]
    by_place = {
        (point.variant, point.config.capture.frames): (group, point) for group, point in places
    }
    for limit in limits[:MOST_SET_UPS]:
        group, point = by_place[limit.record.variant, limit.record.frames]
        if group.poses is not None:
            continue
        seen = limit.record.inspected
        sizes = (limit.a90_95.value, limit.a90_mm, limit.a50_mm, float(np.median(seen.size_mm)))
        limit_mm = min(
            next(size for size in sizes if np.isfinite(size)),
            seen.size_mm.max() / max(SHARES.values()),
        )
        rows: dict[Where, int] = {}
        for where, share in SHARES.items():
            apart = np.abs(seen.size_mm - share * limit_mm)
            apart[list(rows.values())] = np.inf
            rows[where] = int(apart.argmin())
        half_m = (max(seen.diameter_mm[row] for row in rows.values()) / 2 + ROOM_MM) * MM
        batches = {batch.board: batch for batch in group.then if batch.role == "damaged"}
        shown = [
            (batches[int(seen.board[row])], point, limit, where, row) for where, row in rows.items()
        ]
        yield [ShownDamage(group, *each, half_m) for each in shown]


def study_examples(
    shown: Sequence[ShownDamage], thresholds: Mapping[str, float]
) -> list[StudyExample]:
    """Return the pictures of damages whose boards have been rendered."""
    return [_example(damage, thresholds) for damage in shown]


def _example(shown: ShownDamage, thresholds: Mapping[str, float]) -> StudyExample:
    """Return the picture of a damage. The trial is repeated exactly."""
    group, batch, point, limit, where, row, half_m = shown
    seen = limit.record.inspected
    (task,) = (
        task for _, task in group.trials(batch, thresholds) if task.repeat == int(seen.repeat[row])
    )
    of_point = next(found for found in task.points if found.digest == point.digest)
    set_up = load_set_up(task.set_ups[0])
    judged = _judged(task, of_point, of_point.frames)
    damage = next(found for found in set_up.truth if str(found.id) == str(seen.hole[row]))
    rim = _outline_px(set_up, damage)
    pitch_mm = float(np.mean(set_up.pitch_mm))
    half = int(np.ceil(max(half_m, damage.reach_m + ROOM_MM * MM) / MM / pitch_mm))
    middle = np.round(rim.mean(axis=0)).astype(int)

    def window(image: np.ndarray, beyond: float | bool) -> np.ndarray:
        """Return a square of 2 half + 1 pixels around the rim's centre; ``beyond``: value outside
        the image."""
        padded = np.pad(image, half, constant_values=beyond)
        return np.asarray(
            padded[middle[1] : middle[1] + 2 * half + 1, middle[0] : middle[0] + 2 * half + 1]
        )

    curve = None if limit.statement is None else limit.statement.curve
    return StudyExample(
        variant=point.variant,
        frames=point.config.capture.frames,
        board=int(seen.board[row]),
        hole=str(seen.hole[row]),
        where=where,
        pod=float("nan") if curve is None else float(curve.pod(seen.size_mm[row])),
        hit=bool(seen.hit[row]),
        score=float(seen.signal[row]),
        diameter_mm=damage.diameter_m / MM,
        depth_mm=damage.depth_m / MM,
        threshold=float(judged.run["threshold"]),
        residual_mm=window(judged.evidence.residual_m / MM, np.nan),
        detected=window(_detected(judged), False),
        outline_px=rim - (middle - half),
        pitch_mm=pitch_mm,
    )
