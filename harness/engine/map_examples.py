"""Maps kept for the report's pictures and its view in space: the first damaged repeat, drawn again from its seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from detectors.interface import Measurement
from detectors.mapping.settings import MappingConfig
from detectors.views import PreparedView
from harness.engine.averages import averages_of
from harness.engine.judge import centres_m, detector_for, places_of
from harness.engine.maps import MapMaker
from harness.engine.plan import Group
from harness.engine.setup import load_set_up
from harness.engine.sight import Sight
from harness.engine.trial import capture_of
from harness.evaluation.match import match
from harness.experiment.points import Point
from harness.report.examples import FindingSeen, HoleSeen, MappedExample, PlacedView
from harness.vocabulary.geometry import invert, transform_points
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.units import MM
from scenes.target.truth import Damage

MOST_POINTS = 60_000
"""Of a merged cloud in a picture."""
MOST_VIEW_POINTS = 8_000
SAME_POINT_M = 0.1 * MM
"""A merged point this near to a view's own is that view's: the step of the thesis' merge."""


def map_examples_of(group: Group, thresholds: Mapping[str, float]) -> list[MappedExample]:
    """Of two views and of all, one map by each way of merging, with the greatest number of frames and the method of
    registration that the experiment names last."""
    points = [point for point in group.points if point.digest in thresholds and point.config.mapping is not None]
    batch = group.damaged
    chosen = _chosen(points, len(batch.views))
    if not chosen or group.poses is None:
        return []
    set_ups = [load_set_up(ref) for ref in batch.set_ups]
    _, task = next(group.trials(batch, thresholds))
    frames = chosen[0].config.capture.frames
    average = chosen[0].config.capture.average
    captures = [capture_of(set_up, number, task, frames) for number, set_up in enumerate(set_ups)]
    clouds = [averages_of(capture, [frames], average, exact=chosen[0].config.capture.exact) for capture in captures]
    maps = MapMaker(set_ups, clouds, group.poses, ("damaged", 0), hole_free=False)
    T_board_reference = invert(set_ups[0].T_camera_board)
    placed: dict[int, tuple[PlacedView, ...]] = {}
    examples = []
    for point in chosen:
        count = maps.count(_mapping(point))
        if count not in placed:
            placed[count] = _placed(maps, count, points, frames, T_board_reference)
        examples.append(_example(maps, point, thresholds[point.digest], placed[count]))
    return examples


def _chosen(points: Sequence[Point], views: int) -> list[Point]:
    counted = [(_mapping(point).views or views, point) for point in points]
    several = [(count, point) for count, point in counted if count > 1]
    most = max((point.config.capture.frames for _, point in several), default=0)
    last: dict[tuple[int, str], Point] = {}
    for count, point in several:
        # of what is not the experiment itself there is a picture where nothing else is in the group
        if point.config.capture.frames == most and (not point.is_variation or points[0].is_variation):
            last[count, _mapping(point).merge.kind] = point
    counts = {count for count, _ in last}
    return [point for (count, _), point in last.items() if count in (min(counts), max(counts))]


def _mapping(point: Point) -> MappingConfig:
    assert point.config.mapping is not None
    return point.config.mapping


def _example(maps: MapMaker, point: Point, threshold: float, placed: tuple[PlacedView, ...]) -> MappedExample:
    mapping, frames = _mapping(point), point.config.capture.frames
    sight = maps.sight(mapping, frames)
    cloud = sight.cloud
    settings = canonical_json(point.config.detector.settings)
    detector = detector_for(sight, point.config.detector.name, settings, hole_free=False)
    evidence = detector.analyse(cloud)
    detections = detector.find(cloud, evidence, threshold)
    measured = [detector.measure(cloud, evidence, detection) for detection in detections]
    places = places_of(sight, detections)
    pairs = match(centres_m(sight), places, point.config.matching.radius_mm * MM)
    detected = np.zeros(cloud.valid.size, bool)
    for detection in detections:
        detected[detection.pixels] = True
    shown = _thinned(np.flatnonzero(cloud.valid.ravel()), MOST_POINTS)
    points_m = transform_points(sight.T_board_cloud, cloud.points_m.reshape(-1, 3)[shown])
    rgb = np.full((cloud.valid.size, 3), 160, np.uint8) if cloud.rgb is None else cloud.rgb.reshape(-1, 3)
    names = {finding: str(sight.truth[hole].id) for hole, finding in pairs.items()}
    return MappedExample(
        variant=point.variant,
        frames=frames,
        views=maps.count(mapping),
        registration=mapping.registration.method,
        merge=mapping.merge.kind,
        points_mm=points_m / MM,
        rgb=rgb[shown],
        residual_mm=evidence.residual_m.ravel()[shown] / MM,
        detected=detected[shown],
        view_of=_view_of(points_m, maps, mapping, frames, sight),
        holes=tuple(_hole(damage, number in pairs) for number, damage in enumerate(sight.truth)),
        findings=tuple(
            _finding(place, one, names.get(number, ""))
            for number, (place, one) in enumerate(zip(places, measured, strict=True))
        ),
        placed=placed,
        is_variation=point.is_variation,
    )


def _hole(damage: Damage, found: bool) -> HoleSeen:
    x_mm, y_mm = (float(value) / MM for value in damage.centre_board_m[:2])
    return HoleSeen(str(damage.id), x_mm, y_mm, damage.diameter_m / MM, found)


def _finding(place_m: np.ndarray, measured: Measurement, hole: str) -> FindingSeen:
    x_mm, y_mm = (float(value) / MM for value in place_m)
    return FindingSeen(x_mm, y_mm, measured.extent_diameter_m / MM, measured.score, hole)


def _view_of(points_m: np.ndarray, maps: MapMaker, mapping: MappingConfig, frames: int, sight: Sight) -> np.ndarray:
    """(k,) the view whose own point each merged point (k, 3), board frame, is; -1 where it is no single view's."""
    T_board_reference = sight.T_board_cloud @ invert(maps.merged(mapping, frames).T_reference_cloud)
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
) -> tuple[PlacedView, ...]:
    """The views as every method of the experiment places them."""
    same = [p for p in points if maps.count(_mapping(p)) == count and p.config.capture.frames == frames]
    by_method = {_mapping(point).registration.method: _mapping(point) for point in same}
    registered = {method: maps.registrations(mapping, frames) for method, mapping in by_method.items()}
    views = maps.prepared(next(iter(by_method.values())), frames)
    placed = []
    for number, view in enumerate(views):
        transforms = {"truth": maps.truth[number], "guess": maps.guesses[number]}
        found = {method: registrations[number] for method, registrations in registered.items()}
        transforms |= {method: one.T_reference_view for method, one in found.items() if not one.failure}
        points_mm, rgb = _shown(view)
        placed.append(
            PlacedView(
                name=view.view.name,
                points_mm=points_mm,
                rgb=rgb,
                marks_mm=view.mark_points_m / MM,
                T_board_view={name: _in_mm(T_board_reference @ T) for name, T in transforms.items()},
                failures={method: one.failure for method, one in found.items() if one.failure},
            )
        )
    return tuple(placed)


def _shown(view: PreparedView) -> tuple[np.ndarray, np.ndarray]:
    kept = _thinned(np.flatnonzero(view.inside.ravel()), MOST_VIEW_POINTS)
    cloud = view.view.cloud
    rgb = np.full((len(kept), 3), 160, np.uint8) if cloud.rgb is None else cloud.rgb.reshape(-1, 3)[kept]
    return cloud.points_m.reshape(-1, 3)[kept] / MM, rgb


def _thinned(indices: np.ndarray, most: int) -> np.ndarray:
    return indices[:: -(-len(indices) // most)] if len(indices) > most else indices


def _in_mm(T_a_b: np.ndarray) -> np.ndarray:
    scaled = T_a_b.copy()
    scaled[:3, 3] /= MM
    return scaled
