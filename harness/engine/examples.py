"""Example clouds for the report: the first damaged repeat, drawn again from its seed."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from detectors import load_detector
from detectors.average import prefix_averages
from harness.engine.plan import Group
from harness.engine.setup import SetUp, load_set_up
from harness.evaluation.profile import HoleInView
from harness.report.example import ExampleCloud
from harness.vocabulary.units import MM


def examples_of(group: Group, thresholds: Mapping[str, float], variant: str) -> list[ExampleCloud]:
    """The clouds of repeat 0 at the least and the greatest number of frames of a variant, with what was detected."""
    points = sorted((p for p in group.points if p.variant == variant), key=lambda p: p.config.capture.frames)
    points = [p for p in points if p.digest in thresholds]
    if not points:
        return []
    chosen = [points[0], points[-1]] if len(points) > 1 else points
    set_up = load_set_up(group.set_up)
    counts = [p.config.capture.frames for p in chosen]
    capture = set_up.damaged.capture(max(counts), group.seed, "damaged", 0)
    clouds = prefix_averages(capture, counts, chosen[0].config.capture.average)
    found = []
    for point in chosen:
        cloud = clouds[point.config.capture.frames]
        detector = load_detector(point.config.detector.name, json.loads(json.dumps(point.config.detector.settings)))
        evidence = detector.analyse(cloud)
        detected = np.zeros(cloud.valid.size, bool)
        for detection in detector.find(cloud, evidence, thresholds[point.digest]):
            detected[detection.pixels] = True
        found.append(
            ExampleCloud(
                frames=point.config.capture.frames,
                variant=variant,
                points_m=cloud.points_m,
                rgb=cloud.rgb if cloud.rgb is not None else np.full((*cloud.valid.shape, 3), 160, np.uint8),
                residual_mm=evidence.residual_m / MM,
                detected=detected.reshape(cloud.valid.shape),
                inside=np.isfinite(evidence.score),
                truth=_marks(set_up),
                z_truth_mm=set_up.seen_z_m / MM,
            )
        )
    return found


def _marks(set_up: SetUp) -> tuple[HoleInView, ...]:
    """Each damage as a circle in pixels of the cloud's grid."""
    region, lens = set_up.damaged.region, set_up.damaged.camera.nominal_lens
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
