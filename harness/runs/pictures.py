"""Draws a report's pictures again from their seeds: the first damaged repeat or, in a study,
damages near the limit."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from detectors.interface import Detection, Evidence
from detectors.views.mapping.merge import SEVERAL, Mapped
from harness.evaluation.study.limit import SetUpLimit
from harness.experiment.schema import MAIN, Point
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
from harness.runs.journal import PICTURES
from harness.runs.plan import Batch, Group, SweepPlan
from harness.trials.averages import averages_of
from harness.trials.board import Board, LabelledCloud, load_board
from harness.trials.clouds import MapClouds, TrialPoint, mapping_of
from harness.trials.judge import Criteria, Judgement, detector_for, judge
from harness.trials.trial import Trial, capture_of, clouds_of, view_clouds
from harness.vocabulary.geometry import MM, transform_points
from harness.vocabulary.provenance import source_digest
from harness.vocabulary.seeds import digest
from scenes.target.truth import Damage, face_of

MOST_POINTS = 60_000  # most points of a merged cloud in a picture
# size of the damage over the limit
SHARES: dict[Where, float] = {"below": 0.75, "at": 1.0, "above": 1.25}
MOST_SET_UPS = 6
ROOM_MM = 12.0  # margin around the largest damage of a set-up, whose pictures all have one size
GREY = 160
ARRAYS = ("residual_mm", "detected", "outline_px")
"""Fields of a study's example that are arrays."""


def is_shown(group: Group) -> bool:
    """Return whether a page shows pictures of a group that is no study's: it does of maps, and of
    the only set-up of an experiment, but not of several set-ups or of variations."""
    if group.damaged.board is not None:
        return False
    return group.poses is not None or any(point.variant == MAIN for point in group.points)


def pictures_of(
    group: Group, thresholds: Mapping[str, float]
) -> list[ExampleCloud] | list[MappedExample]:
    """Return the example clouds of a group, or of its maps."""
    if group.poses is None:
        return _cloud_examples(group, thresholds)
    return _map_examples(group, thresholds)


def _seen_again(trial: Trial, point: TrialPoint, most: int) -> LabelledCloud:
    """Return the cloud of one view like a trial that drew ``most`` frames."""
    board = load_board(trial.views[0])
    capture = capture_of(trial, 0, board, most)
    averages = averages_of(capture, [point.frames], point.averaging)
    return view_clouds(trial, board, averages).labelled(point)


def _found(labelled: LabelledCloud, criteria: Criteria) -> tuple[Evidence, np.ndarray]:
    """Return the evidence on a cloud, and (h, w) bool: pixels of findings. Nothing is measured,
    which is a quarter of the cost of a picture."""
    detector = detector_for(labelled, criteria)
    evidence = detector.analyse(labelled.cloud)
    detections: Sequence[Detection] = ()
    if criteria.threshold is not None:
        detections = detector.find(labelled.cloud, evidence, criteria.threshold)
    return evidence, _pixels_of(detections, evidence)


def _pixels_of(detections: Iterable[Detection], evidence: Evidence) -> np.ndarray:
    """Return (h, w) bool: pixels that belong to a detection."""
    detected = np.zeros(evidence.score.shape, bool)
    for detection in detections:
        detected.ravel()[detection.pixels] = True
    return detected


def _cloud_examples(group: Group, thresholds: Mapping[str, float]) -> list[ExampleCloud]:
    """Return the clouds of repeat 0 of an experiment's only set-up, at its smallest and largest
    number of frames."""
    batch = group.damaged
    _, trial = next(group.trials(batch, thresholds))
    most = max(point.frames for point in trial.points)
    shown = [point for point in trial.points if point.variant == MAIN]
    board = load_board(batch.views[0])
    holes = tuple(_hole_in_view(board, damage) for damage in board.truth)
    examples = []
    for point in _fewest_and_most_frames(shown):
        evidence, detected = _found(_seen_again(trial, point, most), point.criteria)
        example = ExampleCloud(
            frames=point.frames,
            variant=point.variant,
            residual_mm=evidence.residual_m / MM,
            detected=detected,
            inside=np.isfinite(evidence.score),
            truth=holes,
            z_truth_mm=board.seen_z_m / MM,
        )
        examples.append(example)
    return examples


def _fewest_and_most_frames(points: Sequence[TrialPoint]) -> list[TrialPoint]:
    """Return the points with the fewest and, if there are several, with the most frames."""
    ascending = sorted(points, key=lambda point: point.frames)
    return [*ascending[:1], *ascending[1:][-1:]]


def _hole_in_view(board: Board, damage: Damage) -> HoleInView:
    """Return a damage as a circle on the cloud's grid."""
    region = board.unit.region
    lens = board.unit.camera.nominal_lens
    u, v = lens.project(damage.centre_camera_m[None])[0]
    return HoleInView(
        hole=str(damage.id),
        u_px=float(u - region.col0),
        v_px=float(v - region.row0),
        radius_px=float(lens.fx * damage.diameter_m / 2 / damage.centre_camera_m[2]),
        diameter_mm=damage.diameter_m / MM,
        depth_mm=damage.depth_m / MM,
    )


def _outline_px(board: Board, damage: Damage) -> np.ndarray:
    """Return columns and rows (n, 2) of a damage's rim on the cloud's grid; a circle for a hole or
    dent."""
    region = board.unit.region
    lens = board.unit.camera.nominal_lens
    outline_m = damage.outline_board_m
    if outline_m is None:
        across = np.cross(damage.axis_camera, [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        along = np.cross(damage.axis_camera, across)
        turn = np.linspace(0, 2 * np.pi, 64)[:, None]
        circle = np.cos(turn) * across + np.sin(turn) * along
        rim_m = damage.centre_camera_m + damage.diameter_m / 2 * circle
    else:
        on_face_m = face_of(board.target.board).point(*outline_m.T)
        closed_m = np.vstack([on_face_m, on_face_m[:1]])
        rim_m = transform_points(board.T_camera_board, closed_m)
    return np.asarray(lens.project(rim_m) - [region.col0, region.row0])


def _map_examples(group: Group, thresholds: Mapping[str, float]) -> list[MappedExample]:
    """Return maps of the fewest and of all views, one per merge, with the most frames and the last
    registration."""
    batch = group.damaged
    shown = _shown_maps(group, len(batch.views), thresholds)
    if not shown:
        return []
    counts = [count for count, _ in shown]
    _, trial = next(group.trials(batch, thresholds))
    trial_points = {point.digest: point for point in trial.points}
    boards = [load_board(view) for view in trial.views]
    first = next(iter(shown.values()))
    most = first.config.capture.frames
    averaging = trial_points[first.digest].averaging
    averages = []
    for number, board in enumerate(boards):
        capture = capture_of(trial, number, board, most)
        averages.append(averages_of(capture, [most], averaging))
    maps = clouds_of(trial, boards, averages)
    assert isinstance(maps, MapClouds)  # the group has several views
    examples = []
    for (count, _), point in shown.items():
        if count in (min(counts), max(counts)):
            in_trial = trial_points[point.digest]
            examples.append(_map_example(maps, in_trial, is_variation=point.is_variation))
    return examples


def _shown_maps(
    group: Group, views: int, thresholds: Mapping[str, float]
) -> dict[tuple[int, str], Point]:
    """Return the last judged point with the most frames for each number of views, if several, and
    kind of merge. ``views``: number of views of the group."""
    judged = [point for point in group.points if point.digest in thresholds]
    judged = [point for point in judged if point.config.mapping is not None]
    by_map: list[tuple[tuple[int, str], Point]] = []
    for point in judged:
        mapping = point.config.mapping
        if mapping is not None and (mapping.views or views) > 1:
            by_map.append(((mapping.views or views, mapping.merge.kind), point))
    most = max((point.config.capture.frames for _, point in by_map), default=0)
    last = {}
    for drawn_as, point in by_map:
        # a variation has a picture only if the group holds nothing else
        is_shown = not point.is_variation or judged[0].is_variation
        if point.config.capture.frames == most and is_shown:
            last[drawn_as] = point
    return last


def _map_example(maps: MapClouds, point: TrialPoint, *, is_variation: bool) -> MappedExample:
    """Return the picture of one map."""
    mapping = mapping_of(point)
    labelled = maps.labelled(point)
    cloud = labelled.cloud
    judgement = judge(labelled, replace(point.criteria, overlap=None))
    shown = np.flatnonzero(cloud.valid.ravel())
    shown = shown[:: max(1, -(-len(shown) // MOST_POINTS))]
    points_m = transform_points(labelled.T_board_cloud, cloud.points_m.reshape(-1, 3)[shown])
    rgb = np.full((len(shown), 3), GREY, np.uint8)
    if cloud.rgb is not None:
        rgb = cloud.rgb.reshape(-1, 3)[shown]
    merged = maps.merged(point)
    mapped = Mapped(maps.prepared(point), maps.registrations(point), merged)
    view_names = tuple(view.view.name for view in mapped.views)
    # a view that failed keeps its number
    number_of = np.array([*map(view_names.index, merged.views_used), SEVERAL])
    count = maps.count(point)
    registration = mapping.registration.method
    merge_kind = mapping.merge.kind
    scene = Scene3d(
        points_mm=points_m / MM,
        frame="board",
        rgb=rgb,
        residual_mm=judgement.evidence.residual_m.ravel()[shown] / MM,
        detected=_pixels_of(judgement.detections, judgement.evidence).ravel()[shown],
        view_of=number_of[mapped.view_of_points()[shown]],
        view_names=view_names,
        circles=tuple(_circles(judgement)),
        facts=(
            ("views", f"{count} ({registration}, {merge_kind})"),
            ("frames a view", str(point.frames)),
            ("holes found", f"{len(judgement.hits)} of {len(labelled.truth)}"),
        ),
    )
    return MappedExample(
        variant=point.variant,
        frames=point.frames,
        views=count,
        registration=registration,
        merge=merge_kind,
        scene=scene,
        is_variation=is_variation,
    )


def _circles(judgement: Judgement) -> Iterator[Circle3d]:
    """Yield a circle for each damage, hit or missed, and one for each detection."""
    labelled = judgement.labelled
    for index, damage in enumerate(labelled.truth):
        kind: CircleKind = "found" if index in judgement.hits else "missed"
        yield _circle(damage.centre_board_m, damage.diameter_m, str(damage.id), kind)
    hitting = set(judgement.hits.values())
    for index, detection in enumerate(judgement.detections):
        measured = judgement.detector.measure(labelled.cloud, judgement.evidence, detection)
        diameter_m = measured.extent_diameter_m
        kind = "finding" if index in hitting else "false call"
        label = f"{diameter_m / MM:.1f}"
        yield _circle(judgement.places_m[index], diameter_m, label, kind)


def _circle(centre_m: np.ndarray, diameter_m: float, label: str, kind: CircleKind) -> Circle3d:
    """Return a circle in the board's plane."""
    return Circle3d(
        centre_mm=np.array([*centre_m[:2], 0.0]) / MM,
        normal=np.array([0.0, 0.0, 1.0]),
        diameter_mm=diameter_m / MM,
        label=label,
        kind=kind,
    )


@dataclass(frozen=True)
class ShownDamage:
    """A damage to show."""

    group: Group
    """The group whose trials inspect it."""
    batch: Batch
    """The board that has it."""
    point: Point
    """The point that judged it."""
    limit: SetUpLimit
    """The limit of the point's set-up."""
    where: Where
    """Its size compared with the limit."""
    row: int
    """Its row of the limit's inspections."""
    half_m: float
    """Half the side of its picture."""


def shown_in(plan: SweepPlan, limits: Sequence[SetUpLimit]) -> Iterator[list[ShownDamage]]:
    """Yield, for the first set-ups with single views, the damages closest to 0.75, 1 and 1.25 of
    the limit."""
    judged_by = {}
    for group in plan.groups:
        for point in group.points:
            judged_by[point.variant, point.config.capture.frames] = (group, point)
    for limit in limits[:MOST_SET_UPS]:
        group, point = judged_by[limit.record.variant, limit.record.frames]
        if group.poses is not None:
            continue
        inspected = limit.record.inspected
        rows = _rows_near(limit)
        largest_mm = max(inspected.diameter_mm[row] for row in rows.values())
        batches = {batch.board: batch for batch in group.then if batch.role == "damaged"}
        damages = []
        for where, row in rows.items():
            damage = ShownDamage(
                group=group,
                batch=batches[int(inspected.board[row])],
                point=point,
                limit=limit,
                where=where,
                row=row,
                half_m=(largest_mm / 2 + ROOM_MM) * MM,
            )
            damages.append(damage)
        yield damages


def _rows_near(limit: SetUpLimit) -> dict[Where, int]:
    """Return the rows of the inspections whose sizes are closest to `SHARES` of the limit, each
    once."""
    sizes_mm = limit.record.inspected.size_mm
    limits_mm = [limit.a90_95.value, limit.a90_mm, limit.a50_mm, float(np.median(sizes_mm))]
    stated_mm = next(size_mm for size_mm in limits_mm if np.isfinite(size_mm))
    limit_mm = min(stated_mm, sizes_mm.max() / max(SHARES.values()))
    rows: dict[Where, int] = {}
    for where, share in SHARES.items():
        distance_mm = np.abs(sizes_mm - share * limit_mm)
        distance_mm[list(rows.values())] = np.inf
        rows[where] = int(distance_mm.argmin())
    return rows


def study_examples(
    shown: Sequence[ShownDamage], thresholds: Mapping[str, float]
) -> list[StudyExample]:
    """Return the pictures of damages whose boards have been rendered."""
    return [_study_example(damage, thresholds) for damage in shown]


def examples_as_text(examples: Iterable[StudyExample]) -> str:
    """Return pictures as JSON for the journal; NaN and infinity stand in it as such."""
    data = [asdict(example) for example in examples]
    return json.dumps(data, default=np.ndarray.tolist)


def examples_of_text(text: str) -> list[StudyExample]:
    """Return the pictures that `examples_as_text` wrote."""
    examples = []
    for stored in json.loads(text):
        arrays = {name: np.array(stored[name]) for name in ARRAYS}
        examples.append(StudyExample(**(stored | arrays)))
    return examples


def pictures_key(shown: Sequence[ShownDamage], thresholds: Mapping[str, float]) -> str:
    """Return the key in the journal of a set-up's pictures: a digest of all that decides them."""
    content: list[Any] = [source_digest((__name__,), ())]
    for damage in shown:
        key, _ = _trial_of(damage, thresholds)
        content.append([key, damage.point.digest, damage.where, damage.half_m, _facts_of(damage)])
    return f"{PICTURES}{digest(json.dumps(content))}"


def _trial_of(shown: ShownDamage, thresholds: Mapping[str, float]) -> tuple[str, Trial]:
    """Return the trial that inspected a damage, with its key in the journal."""
    repeat = int(shown.limit.record.inspected.repeat[shown.row])
    (keyed_trial,) = shown.group.trials(shown.batch, thresholds, [repeat])
    return keyed_trial


def _facts_of(shown: ShownDamage) -> dict[str, Any]:
    """Return what a study's record says of a damage."""
    inspected = shown.limit.record.inspected
    row = shown.row
    pod = float("nan")
    if shown.limit.statement is not None:
        pod = float(shown.limit.statement.curve.pod(inspected.size_mm[row]))
    return {
        "variant": shown.point.variant,
        "board": int(inspected.board[row]),
        "hole": str(inspected.hole[row]),
        "hit": bool(inspected.hit[row]),
        "score": float(inspected.signal[row]),
        "pod": pod,
    }


def _study_example(shown: ShownDamage, thresholds: Mapping[str, float]) -> StudyExample:
    """Return the picture of a damage. The trial is repeated exactly."""
    facts = _facts_of(shown)
    _, trial = _trial_of(shown, thresholds)
    point = next(point for point in trial.points if point.digest == shown.point.digest)
    board = load_board(trial.views[0])
    evidence, detected = _found(_seen_again(trial, point, point.frames), point.criteria)
    damage = next(damage for damage in board.truth if str(damage.id) == facts["hole"])
    rim_px = _outline_px(board, damage)
    pitch_mm = float(np.mean(board.pitch_mm))
    half_m = max(shown.half_m, damage.reach_m + ROOM_MM * MM)
    half = int(np.ceil(half_m / MM / pitch_mm))
    middle = np.round(rim_px.mean(axis=0)).astype(int)
    return StudyExample(
        **facts,
        frames=point.frames,
        where=shown.where,
        diameter_mm=damage.diameter_m / MM,
        depth_mm=damage.depth_m / MM,
        threshold=float("nan") if point.criteria.threshold is None else point.criteria.threshold,
        residual_mm=_window(evidence.residual_m / MM, middle, half, np.nan),
        detected=_window(detected, middle, half, False),
        outline_px=rim_px - (middle - half),
        pitch_mm=pitch_mm,
    )


def _window(image: np.ndarray, middle: np.ndarray, half: int, outside: float | bool) -> np.ndarray:
    """Return a square of 2 half + 1 pixels around a pixel (column, row); ``outside``: value beyond
    the image."""
    padded = np.pad(image, half, constant_values=outside)
    column, row = middle
    return np.asarray(padded[row : row + 2 * half + 1, column : column + 2 * half + 1])
