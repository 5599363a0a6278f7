"""Example clouds for the report: the first damaged repeat, drawn again from its seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from harness.engine.averages import averages_of
from harness.engine.judge import detector_for
from harness.engine.plan import Group
from harness.engine.setup import SetUp, load_set_up
from harness.engine.sight import sight_of_view
from harness.evaluation.profile import HoleInView
from harness.experiment.points import Point
from harness.report.examples import ExampleCloud
from harness.vocabulary.capture import Cloud
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.units import MM
from scenes.target.truth import Damage


def examples_of(group: Group, thresholds: Mapping[str, float]) -> list[ExampleCloud]:
    """The clouds of repeat 0 at the least and the greatest number of frames of each variant of a group."""
    chosen = _ends([point for point in group.points if point.digest in thresholds])
    if not chosen:
        return []
    set_up = load_set_up(group.damaged.set_ups[0])
    counts = sorted({point.config.capture.frames for point in chosen})
    capture = set_up.unit.capture(counts[-1], group.seed, "damaged", 0)
    averages = {canonical_json(point.config.capture.average.to_data()): point for point in chosen}
    clouds = {
        text: averages_of(capture, counts, point.config.capture.average, exact=point.config.capture.exact)
        for text, point in averages.items()
    }
    return [
        _example(
            set_up,
            clouds[canonical_json(point.config.capture.average.to_data())][point.config.capture.frames],
            point,
            thresholds[point.digest],
        )
        for point in chosen
    ]


def _ends(points: Sequence[Point]) -> list[Point]:
    """Of each variant the points with the least and the greatest number of frames."""
    by_variant: dict[str, list[Point]] = {}
    for point in sorted(points, key=lambda p: p.config.capture.frames):
        by_variant.setdefault(point.variant, []).append(point)
    return [
        point for found in by_variant.values() for point in (found[:1] if len(found) == 1 else [found[0], found[-1]])
    ]


def _example(set_up: SetUp, cloud: Cloud, point: Point, threshold: float) -> ExampleCloud:
    sight = sight_of_view(set_up, cloud, hole_free=False)
    settings = canonical_json(point.config.detector.settings)
    detector = detector_for(sight, point.config.detector.name, settings, hole_free=False)
    evidence = detector.analyse(cloud)
    detected = np.zeros(cloud.valid.size, bool)
    for detection in detector.find(cloud, evidence, threshold):
        detected[detection.pixels] = True
    return ExampleCloud(
        frames=point.config.capture.frames,
        variant=point.variant,
        points_m=cloud.points_m,
        rgb=cloud.rgb if cloud.rgb is not None else np.full((*cloud.valid.shape, 3), 160, np.uint8),
        residual_mm=evidence.residual_m / MM,
        detected=detected.reshape(cloud.valid.shape),
        inside=np.isfinite(evidence.score),
        truth=_marks(set_up),
        z_truth_mm=set_up.seen_z_m / MM,
        outlines_px=tuple(outline_px(set_up, damage) for damage in set_up.truth),
    )


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


def _marks(set_up: SetUp) -> tuple[HoleInView, ...]:
    """Each damage as a circle in pixels of the cloud's grid."""
    region, lens = set_up.unit.region, set_up.unit.camera.nominal_lens
    marks = []
    for damage in set_up.truth:
        u, v = lens.project(damage.centre_camera_m[None])[0]
        radius_px = lens.fx * damage.diameter_m / 2 / damage.centre_camera_m[2]
        marks.append(
            HoleInView(
                str(damage.id),
                float(u - region.col0),
                float(v - region.row0),
                float(radius_px),
                damage.diameter_m / MM,
                damage.depth_m / MM,
            )
        )
    return tuple(marks)
