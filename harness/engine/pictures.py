"""The pictures of a report, drawn again from their seeds: example clouds and maps of the first damaged repeat, and of a
study the damages just below, at and above the limit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from detectors.mapping.settings import MappingConfig
from harness.engine.averages import averages_of
from harness.engine.judge import JudgedCloud, detector_for, judge
from harness.engine.maps import MapMaker
from harness.engine.plan import Batch, Group, SweepPlan
from harness.engine.setup import KnownCloud, SetUp, known_view, load_set_up
from harness.engine.trial import capture_of
from harness.evaluation.profile import HoleInView
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.record import Inspected
from harness.experiment.points import Point
from harness.report.examples import (
    ExampleCloud,
    FindingSeen,
    HoleSeen,
    MappedExample,
    ShownView,
    StudyExample,
    Where,
)
from harness.vocabulary.geometry import invert, transform_points
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.units import MM
from scenes.target.truth import Damage

MOST_POINTS = 60_000
"""Points of a merged cloud in a picture."""
MOST_VIEW_POINTS = 8_000
SAME_POINT_M = 0.1 * MM
"""A merged point this near to a view's own is that view's: the step of the thesis' merge."""
SHARES: dict[Where, float] = {"below": 0.75, "at": 1.0, "above": 1.25}
"""Sizes of damage in a study's pictures, as shares of the limit."""
MOST_SET_UPS = 6
ROOM_MM = 12.0
"""Room around the largest of a set-up's damages in their pictures, which all have one size."""
GREY = 160


def pictures_of(group: Group, thresholds: Mapping[str, float]) -> list[Any]:
    """The example clouds of a group, or of its maps."""
    return cloud_examples(group, thresholds) if group.poses is None else map_examples(group, thresholds)


# ---------------------------------------------------------------- clouds of one view


def cloud_examples(group: Group, thresholds: Mapping[str, float]) -> list[ExampleCloud]:
    """The clouds of repeat 0 at the least and the greatest number of frames of each variant of a group."""
    by_variant: dict[str, list[Point]] = {}
    for point in sorted(group.points, key=lambda one: one.config.capture.frames):
        if point.digest in thresholds:
            by_variant.setdefault(point.variant, []).append(point)
    chosen = [point for found in by_variant.values() for point in (found[0], *found[1:][-1:])]
    if not chosen:
        return []
    set_up = load_set_up(group.damaged.set_ups[0])
    counts = sorted({point.config.capture.frames for point in chosen})
    capture = set_up.unit.capture(counts[-1], group.seed, "damaged", 0)
    clouds: dict[str, Any] = {}
    examples = []
    for point in chosen:
        asked = point.config.capture
        name = canonical_json(asked.average.to_data())
        if name not in clouds:
            clouds[name] = averages_of(capture, counts, asked.average, exact=asked.exact)
        known = known_view(set_up, clouds[name][asked.frames], hole_free=False)
        examples.append(_cloud_example(set_up, known, point, thresholds[point.digest]))
    return examples


def _cloud_example(set_up: SetUp, known: KnownCloud, point: Point, threshold: float) -> ExampleCloud:
    cloud = known.cloud
    settings = canonical_json(point.config.detector.settings)
    detector = detector_for(known, point.config.detector.name, settings, hole_free=False)
    evidence = detector.analyse(cloud)
    region, lens = set_up.unit.region, set_up.unit.camera.nominal_lens
    marks = []
    for damage in set_up.truth:
        u, v = lens.project(damage.centre_camera_m[None])[0]
        radius_px = float(lens.fx * damage.diameter_m / 2 / damage.centre_camera_m[2])
        sizes_mm = damage.diameter_m / MM, damage.depth_m / MM
        marks.append(HoleInView(str(damage.id), float(u - region.col0), float(v - region.row0), radius_px, *sizes_mm))
    return ExampleCloud(
        frames=point.config.capture.frames,
        variant=point.variant,
        points_m=cloud.points_m,
        rgb=cloud.rgb if cloud.rgb is not None else np.full((*cloud.valid.shape, 3), GREY, np.uint8),
        residual_mm=evidence.residual_m / MM,
        detected=_detected(cloud.valid.shape, detector.find(cloud, evidence, threshold)),
        inside=np.isfinite(evidence.score),
        truth=tuple(marks),
        z_truth_mm=set_up.seen_z_m / MM,
        outlines_px=tuple(outline_px(set_up, damage) for damage in set_up.truth),
    )


def _detected(shape: tuple[int, ...], detections: Sequence[Any]) -> np.ndarray:
    """(shape) bool: pixels that belong to a detection."""
    detected = np.zeros(shape, bool)
    for detection in detections:
        detected.ravel()[detection.pixels] = True
    return detected


def outline_px(set_up: SetUp, damage: Damage) -> np.ndarray:
    """(64, 2) columns and rows of a damage's rim on the cloud's grid, through the lens with its distortion.

    The rim is taken as a circle in the face's tangent plane at the damage's centre: exact on a flat face.
    """
    region, lens = set_up.unit.region, set_up.unit.camera.nominal_lens
    across = np.cross(damage.axis_camera, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    along = np.cross(damage.axis_camera, across)
    turn = np.linspace(0, 2 * np.pi, 64)[:, None]
    rim = damage.centre_camera_m + damage.diameter_m / 2 * (np.cos(turn) * across + np.sin(turn) * along)
    return np.asarray(lens.project(rim) - [region.col0, region.row0])


# ---------------------------------------------------------------- maps of several views


def map_examples(group: Group, thresholds: Mapping[str, float]) -> list[MappedExample]:
    """Maps of two views and of all, one by each way of merging, with the greatest number of frames and the method of
    registration that the experiment names last."""
    points = [point for point in group.points if point.digest in thresholds and point.config.mapping is not None]
    batch = group.damaged
    chosen = _chosen_maps(points, len(batch.renders))
    if not chosen or group.poses is None:
        return []
    set_ups = [load_set_up(ref) for ref in batch.set_ups]
    _, task = next(group.trials(batch, thresholds))
    asked = chosen[0].config.capture
    captures = [capture_of(set_up, number, task, asked.frames) for number, set_up in enumerate(set_ups)]
    clouds = [averages_of(capture, [asked.frames], asked.average, exact=asked.exact) for capture in captures]
    maps = MapMaker(set_ups, clouds, group.poses, ("damaged", 0), hole_free=False)
    T_board_reference = invert(set_ups[0].T_camera_board)
    placed: dict[int, tuple[ShownView, ...]] = {}
    examples = []
    for point in chosen:
        count = maps.count(_mapping(point))
        if count not in placed:
            placed[count] = _placed(maps, count, points, asked.frames, T_board_reference)
        examples.append(_map_example(maps, point, thresholds[point.digest], placed[count]))
    return examples


def _chosen_maps(points: Sequence[Point], views: int) -> list[Point]:
    counted = [(_mapping(point).views or views, point) for point in points]
    several = [(count, point) for count, point in counted if count > 1]
    most = max((point.config.capture.frames for _, point in several), default=0)
    last: dict[tuple[int, str], Point] = {}
    for count, point in several:
        # a variation has a picture only where nothing else is in the group
        if point.config.capture.frames == most and (not point.is_variation or points[0].is_variation):
            last[count, _mapping(point).merge.kind] = point
    counts = {count for count, _ in last}
    return [point for (count, _), point in last.items() if count in (min(counts), max(counts))]


def _mapping(point: Point) -> MappingConfig:
    assert point.config.mapping is not None
    return point.config.mapping


def _map_example(maps: MapMaker, point: Point, threshold: float, placed: tuple[ShownView, ...]) -> MappedExample:
    mapping, frames = _mapping(point), point.config.capture.frames
    known = maps.known(mapping, frames)
    cloud = known.cloud
    settings, radius_m = canonical_json(point.config.detector.settings), point.config.matching.radius_mm * MM
    judged = judge(known, point.config.detector.name, settings, threshold, radius_m, hole_free=False)
    shown = _thinned(np.flatnonzero(cloud.valid.ravel()), MOST_POINTS)
    points_m = transform_points(known.T_board_cloud, cloud.points_m.reshape(-1, 3)[shown])
    rgb = np.full((cloud.valid.size, 3), GREY, np.uint8) if cloud.rgb is None else cloud.rgb.reshape(-1, 3)
    names = {finding: str(known.truth[hole].id) for hole, finding in judged.pairs.items()}
    holes, findings = [], []
    for number, damage in enumerate(known.truth):
        x_mm, y_mm = (float(value) / MM for value in damage.centre_board_m[:2])
        holes.append(HoleSeen(str(damage.id), x_mm, y_mm, damage.diameter_m / MM, number in judged.pairs))
    for number in range(len(judged.detections)):
        x_mm, y_mm = (float(value) / MM for value in judged.places_m[number])
        measured = judged.measured[number]
        size_mm = measured.extent_diameter_m / MM
        findings.append(FindingSeen(x_mm, y_mm, size_mm, measured.score, names.get(number, "")))
    return MappedExample(
        variant=point.variant,
        frames=frames,
        views=maps.count(mapping),
        registration=mapping.registration.method,
        merge=mapping.merge.kind,
        points_mm=points_m / MM,
        rgb=rgb[shown],
        residual_mm=judged.evidence.residual_m.ravel()[shown] / MM,
        detected=_detected(cloud.valid.shape, judged.detections).ravel()[shown],
        view_of=_view_of(points_m, maps, mapping, frames, known),
        holes=tuple(holes),
        findings=tuple(findings),
        placed=placed,
        is_variation=point.is_variation,
    )


def _view_of(
    points_m: np.ndarray, maps: MapMaker, mapping: MappingConfig, frames: int, known: KnownCloud
) -> np.ndarray:
    """(k,) the view whose own point each merged point (k, 3), board frame, is; -1 where it is no single view's."""
    T_board_reference = known.T_board_cloud @ invert(maps.merged(mapping, frames).T_reference_cloud)
    found, nearest = np.full(len(points_m), -1), np.full(len(points_m), SAME_POINT_M)
    views = zip(maps.prepared(mapping, frames), maps.registrations(mapping, frames), strict=True)
    for number, (view, registration) in enumerate(views):
        if not registration.failure:
            own = transform_points(T_board_reference @ registration.T_reference_view, view.points_m)
            distance, _ = cKDTree(own).query(points_m, distance_upper_bound=SAME_POINT_M)
            closer = distance < nearest
            found[closer], nearest[closer] = number, distance[closer]
    return found


def _placed(
    maps: MapMaker, count: int, points: Sequence[Point], frames: int, T_board_reference: np.ndarray
) -> tuple[ShownView, ...]:
    """The views as every method of the experiment places them."""
    same = [p for p in points if maps.count(_mapping(p)) == count and p.config.capture.frames == frames]
    by_method = {_mapping(point).registration.method: _mapping(point) for point in same}
    registered = {method: maps.registrations(mapping, frames) for method, mapping in by_method.items()}
    placed = []
    for number, view in enumerate(maps.prepared(next(iter(by_method.values())), frames)):
        transforms = {"truth": maps.truth[number], "guess": maps.guesses[number]}
        found = {method: registrations[number] for method, registrations in registered.items()}
        transforms |= {method: one.T_reference_view for method, one in found.items() if not one.failure}
        kept = _thinned(np.flatnonzero(view.inside.ravel()), MOST_VIEW_POINTS)
        cloud = view.view.cloud
        rgb = np.full((cloud.valid.size, 3), GREY, np.uint8) if cloud.rgb is None else cloud.rgb.reshape(-1, 3)
        in_mm = {name: T_board_reference @ T for name, T in transforms.items()}
        for T_board_view in in_mm.values():
            T_board_view[:3, 3] /= MM
        placed.append(
            ShownView(
                name=view.view.name,
                points_mm=cloud.points_m.reshape(-1, 3)[kept] / MM,
                rgb=rgb[kept],
                marks_mm=view.mark_points_m / MM,
                T_board_view=in_mm,
                failures={method: one.failure for method, one in found.items() if one.failure},
            )
        )
    return tuple(placed)


def _thinned(indices: np.ndarray, most: int) -> np.ndarray:
    return indices[:: -(-len(indices) // most)] if len(indices) > most else indices


# ---------------------------------------------------------------- damages of a study


@dataclass(frozen=True)
class ShownDamage:
    """One damage to show: row ``row`` of the limit's inspections, on the board of ``batch``."""

    group: Group
    batch: Batch
    point: Point
    limit: SetUpLimit
    where: Where
    row: int
    half_m: float


def shown_in(plan: SweepPlan, limits: Sequence[SetUpLimit]) -> Iterator[ShownDamage]:
    """The damages of each of the first few set-ups whose sizes lie nearest to 0.75, 1 and 1.25 of its limit: of a90/95
    where that is demonstrated, otherwise of the estimate of a90, a50 or the middle size; of smaller ones where that is
    too near the largest size. One view's clouds only: of maps there are none."""
    places = [(group, point) for group in plan.groups for point in group.points]
    by_place = {(point.variant, point.config.capture.frames): (group, point) for group, point in places}
    for limit in limits[:MOST_SET_UPS]:
        group, point = by_place[limit.record.variant, limit.record.frames]
        if group.poses is None:
            seen = limit.record.inspected
            batches = {batch.board: batch for batch in group.then if batch.role == "damaged"}
            chosen = _chosen_rows(seen, limit)
            half_m = (max(seen.diameter_mm[row] for row in chosen.values()) / 2 + ROOM_MM) * MM
            for where, row in chosen.items():
                yield ShownDamage(group, batches[int(seen.board[row])], point, limit, where, row, half_m)


def _chosen_rows(seen: Inspected, limit: SetUpLimit) -> dict[Where, int]:
    """Rows of the inspections to show, each another one."""
    sizes = (limit.a90_95.value, limit.a90_mm, limit.a50_mm, float(np.median(seen.diameter_mm)))
    limit_mm = min(next(size for size in sizes if np.isfinite(size)), seen.diameter_mm.max() / max(SHARES.values()))
    rows: dict[Where, int] = {}
    for where, share in SHARES.items():
        apart = np.abs(seen.diameter_mm - share * limit_mm)
        apart[list(rows.values())] = np.inf
        rows[where] = int(apart.argmin())
    return rows


def study_example(one: ShownDamage, thresholds: Mapping[str, float]) -> StudyExample:
    """The picture of a damage; its board's view is there. The run is repeated as it was."""
    seen, row, point = one.limit.record.inspected, one.row, one.point
    (task,) = (task for _, task in one.group.trials(one.batch, thresholds) if task.repeat == int(seen.repeat[row]))
    asked = next(found for found in task.points if found.digest == point.digest)
    set_up = load_set_up(one.batch.set_ups[0])
    capture = capture_of(set_up, 0, task, asked.frames)
    cloud = averages_of(capture, [asked.frames], asked.average, exact=asked.exact)[asked.frames]
    known = known_view(set_up, cloud, hole_free=False)
    detector, settings = asked.detector, asked.settings_json
    judged: JudgedCloud = judge(known, detector, settings, asked.threshold, asked.radius_m, hole_free=False)
    curve = None if one.limit.statement is None else one.limit.statement.curve
    damage = next(found for found in known.truth if str(found.id) == str(seen.hole[row]))
    rim = outline_px(set_up, damage)
    pitch_mm = float(np.mean(set_up.pitch_mm))
    half = int(np.ceil(one.half_m / MM / pitch_mm))
    middle = np.round(rim.mean(axis=0)).astype(int)

    def window(image: np.ndarray, beyond: float | bool) -> np.ndarray:
        """A square of 2 half + 1 pixels about the rim's centre; ``beyond`` the image's edge."""
        padded = np.pad(image, half, constant_values=beyond)
        return np.asarray(padded[middle[1] : middle[1] + 2 * half + 1, middle[0] : middle[0] + 2 * half + 1])

    return StudyExample(
        variant=point.variant,
        frames=point.config.capture.frames,
        board=int(seen.board[row]),
        hole=str(seen.hole[row]),
        where=one.where,
        pod=float("nan") if curve is None else float(curve.pod(seen.diameter_mm[row])),
        hit=bool(seen.hit[row]),
        score=float(seen.signal[row]),
        diameter_mm=damage.diameter_m / MM,
        depth_mm=damage.depth_m / MM,
        threshold=float(judged.run["threshold"]),
        residual_mm=window(judged.evidence.residual_m / MM, np.nan),
        detected=window(_detected(cloud.valid.shape, judged.detections), False),
        outline_px=rim - (middle - half),
        pitch_mm=pitch_mm,
    )
