"""The merged cloud with its findings, as a scene that turns in the browser."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harness.report.view3d import Circle3d, Scene3d
from harness.vocabulary.geometry import transform_points
from harness.vocabulary.units import MM

if TYPE_CHECKING:
    from detectors.mapping.merge import Mapped
    from harness.report.findings import Judged

SEVERAL = -1


def scene_of(mapped: Mapped, judged: Judged) -> Scene3d:
    """Return the valid points of the merged cloud in its own frame (x right, y down, z away), millimetres, with a ring
    around each finding of known size."""
    cloud, merged = judged.cloud, mapped.merged
    valid = cloud.valid.reshape(-1)
    detected = np.zeros(valid.size, bool)
    for detection in judged.detections:
        detected[detection.pixels] = True
    rgb = None if cloud.rgb is None else np.clip(np.nan_to_num(cloud.rgb.reshape(-1, 3)[valid]), 0, 255)
    towards_viewer = np.array([0.0, 0.0, -1.0])
    circles = [
        Circle3d(place, towards_viewer, f.diameter_mm, f"{f.id}: {f.diameter_mm:.1f}", "finding")
        for f in judged.findings
        if np.isfinite([*(place := np.array([f.x_mm, f.y_mm, f.z_mm])), f.diameter_mm]).all()
    ]
    facts = (
        ("views", str(len(merged.views_used))),
        ("frames in all", str(sum(view.view.cloud.n_frames for view in mapped.views))),
        ("registration", mapped.registrations[-1].method),
        ("findings", str(len(judged.findings))),
    )
    return Scene3d(
        points_mm=cloud.points_m.reshape(-1, 3)[valid] / MM,
        frame="camera",
        rgb=None if rgb is None else rgb.astype(np.uint8),
        residual_mm=judged.evidence.residual_m.reshape(-1)[valid] / MM,
        view_of=view_of_points(mapped)[valid],
        view_names=merged.views_used,
        detected=detected[valid],
        circles=tuple(circles),
        facts=facts,
    )


def view_of_points(mapped: Mapped) -> np.ndarray:
    """Return (n,) for each point of the merged cloud the index of the view it comes from, -1 for several or unknown.

    A map knows; elsewhere it is the view of the nearest point, several where another view has one within twice that.
    """
    from scipy.spatial import cKDTree

    merged = mapped.merged
    count = merged.cloud.valid.size
    if merged.surface_map is not None:
        seen = merged.surface_map.seen_by.reshape(-1, count)
        return np.where(seen.sum(axis=0) == 1, seen.argmax(axis=0), SEVERAL)
    used = [
        (view, each)
        for view, each in zip(mapped.views, mapped.registrations, strict=True)
        if each.view in merged.views_used
    ]
    points = merged.cloud.points_m.reshape(-1, 3)
    known = np.isfinite(points).all(axis=1)
    in_reference = [transform_points(each.T_reference_view, view.points_m) for view, each in used]
    distances = np.stack([cKDTree(placed).query(points[known])[0] for placed in in_reference])
    nearest = distances.argmin(axis=0)
    if len(used) > 1:
        first, second = np.partition(distances, 1, axis=0)[:2]
        nearest = np.where(second <= 2 * first, SEVERAL, nearest)
    indices = np.full(count, SEVERAL)
    indices[known] = nearest
    return indices
