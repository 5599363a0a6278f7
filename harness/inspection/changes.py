"""Changes between an earlier capture of a part and this one: distances with their level of
detection, and damage that is new, grown, shrunk or gone, with its size then and now.

Findings are places where the part departs from the earlier capture. A damage's size then and now is
what each capture shows there by itself, against a smooth surface."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from detectors.pixels.noise import median_of
from detectors.surfaces.change import Distances, distances
from detectors.surfaces.scans import PartScan
from detectors.views.registration.registered import local_normals
from harness.inspection.verdict import DOUBTFUL
from harness.report.findings import Finding, Judged
from harness.vocabulary.geometry import MM, Cloud, invert, transform_points

CYLINDER_POINTS = 20
"""Typical number of points in a cylinder, as Lague et al. recommend."""
REACH_M = 50 * MM
"""Half of a cylinder's length: a change that is deeper is not measured."""
CORES = 2000
"""Number of core points over the part."""
NORMAL_POINTS = 40
"""Points whose plane gives a normal: over a neighbourhood of twice a cylinder's area."""
LEAST_COVERED = 0.3
"""Least share of a change that a damage covers: a damage that grows covers more of it."""
NEW = "new"
GROWN = "grown"
SHRUNK = "shrunk"
GONE = "gone"
STATES = (NEW, GROWN, SHRUNK, GONE)


@dataclass(frozen=True)
class DamageSize:
    """The size of a damage in one capture."""

    diameter_mm: float
    depth_mm: float
    """Normal to the surface, negative for a bump."""
    depth_se_mm: float

    @classmethod
    def of(cls, finding: Finding) -> DamageSize:
        """Return the size of a finding."""
        return cls(finding.diameter_mm, finding.depth_mm, finding.depth_se_mm)


@dataclass(frozen=True)
class DamageChange:
    """A finding that is a change."""

    id: int
    """Its number among the findings."""
    state: str
    """One of `STATES`."""
    then: DamageSize | None
    """Its size in the earlier capture; None if that shows no damage there."""
    now: DamageSize | None
    """Its size in this capture."""
    distance_mm: float
    """Distance between both captures at its centre, + behind; NaN if not measured."""
    lod_mm: float
    """Level of detection of that distance at 95 %."""


@dataclass(frozen=True, eq=False)
class Changes:
    """All that changed."""

    damage: tuple[DamageChange, ...]
    """One for each finding that is not doubtful, in order."""
    cores_m: np.ndarray
    """(n, 3): core points, frame of this capture."""
    distances: Distances
    """Distances at the core points, and then at the findings."""
    radius_m: float
    """Radius of the cylinders."""

    @property
    def lod_mm(self) -> float:
        """The level of detection at a typical point; NaN if none was measured."""
        lods_m = self.distances.lod_m[: len(self.cores_m)]
        finite_m = lods_m[np.isfinite(lods_m)]
        return median_of(finite_m) / MM if len(finite_m) else math.nan

    @property
    def counts(self) -> dict[str, int]:
        """The number of damages in each state."""
        return {state: sum(change.state == state for change in self.damage) for state in STATES}

    @property
    def sentence(self) -> str:
        """Return ``1 new, 2 grown``, with the level of detection."""
        counts = [f"{count} {state}" for state, count in self.counts.items() if count]
        states = ", ".join(counts) or "no damage is new, grown, shrunk or gone"
        typical = f"{self.lod_mm:.2g} mm at a typical place (95 %)"
        return f"{states}; changes over {2 * self.radius_m / MM:.2g} mm are detected from {typical}"

    @property
    def facts(self) -> dict[str, Any]:
        """Return it as plain data, for the JSON."""
        scale = 1.0 / MM
        return {
            "damage": [asdict(change) for change in self.damage],
            "cylinder_radius_mm": self.radius_m * scale,
            "typical_level_of_detection_mm": self.lod_mm,
            "unexplained_mm": self.distances.common_m * scale,
        }

    @property
    def csv_text(self) -> str:
        """Return place, distance, level of detection and verdict of each core point, as CSV."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(("x_mm", "y_mm", "z_mm", "distance_mm", "lod_mm", "significant"))
        count = len(self.cores_m)
        lods_m = self.distances.lod_m[:count]
        significant = self.distances.is_significant[:count]
        for number in np.flatnonzero(np.isfinite(lods_m)):
            position = [f"{value:.2f}" for value in self.cores_m[number] / MM]
            sizes_m = (self.distances.distance_m[number], lods_m[number])
            sizes = [f"{value / MM:.4f}" for value in sizes_m]
            writer.writerow((*position, *sizes, int(significant[number])))
        return stream.getvalue()


def changes_of(result: Judged, earlier: PartScan, then: Judged, now: Judged) -> Changes:
    """Compare a capture with an earlier one. ``result``: judged against it; ``then`` and ``now``:
    the earlier and this capture, each judged by itself."""
    cloud = result.cloud
    assert cloud.expected is not None
    T_reference_camera = np.array(cloud.expected.facts["T_reference_camera"])
    earlier_m = transform_points(invert(T_reference_camera), earlier.points_m)
    judged = np.isfinite(result.evidence.residual_m) & cloud.valid
    later_m = cloud.points_m[judged]
    on_surface_m = _on_reference(cloud, later_m)
    cores_m = on_surface_m[:: max(1, len(on_surface_m) // CORES)]
    centres_m = _centres(result)
    radius_m = math.sqrt(CYLINDER_POINTS / math.pi) * earlier.pitch_m
    places_m = np.concatenate([cores_m, _on_reference(cloud, centres_m)])
    _, neighbours = cKDTree(earlier_m).query(np.nan_to_num(places_m), k=NORMAL_POINTS)
    normals = local_normals(earlier_m[neighbours])
    # out of the camera, so that a deeper place has a positive distance
    normals[(normals * np.nan_to_num(places_m)).sum(axis=1) < 0] *= -1.0
    measured = distances(
        earlier_m,
        later_m,
        cores_m=np.nan_to_num(places_m, nan=-1e3),
        normals=normals,
        radius_m=radius_m,
        reach_m=REACH_M,
        registration_m=cloud.expected.registration_at(places_m),
        shared=(earlier.share_px, max(cloud.noise_reach_px, 1.0) ** 2),
    )
    damage = []
    for number, finding in enumerate(result.findings):
        if finding.certainty == DOUBTFUL:
            continue
        index = len(cores_m) + number
        places_m = cloud.points_m.reshape(-1, 3)[result.detections[number].pixels]
        places_m = places_m[np.isfinite(places_m[:, 2])]
        size_then = _size_at(places_m, then, T_reference_camera, earlier.pitch_m)
        size_now = _size_at(places_m, now, np.eye(4), earlier.pitch_m)
        departed_then_m = _departure_m(places_m, then, T_reference_camera)
        departed_now_m = _departure_m(places_m, now, np.eye(4))
        damage.append(
            _change(
                finding,
                size_then,
                size_now,
                was_there=abs(departed_then_m) > abs(departed_now_m),
                distance_m=float(measured.distance_m[index]),
                lod_m=float(measured.lod_m[index]),
            )
        )
    return Changes(tuple(damage), cores_m, measured, radius_m)


def _on_reference(cloud: Cloud, points_m: np.ndarray) -> np.ndarray:
    """Return where the rays through points (n, 3) meet the reference; NaN where they do not."""
    assert cloud.expected is not None
    z_m = cloud.expected.z_at(points_m)
    if cloud.projection == "central":
        return np.asarray(points_m * (z_m / points_m[:, 2])[:, None])
    return np.column_stack([points_m[:, :2], z_m])


def _centres(result: Judged) -> np.ndarray:
    """Return the centres (n, 3) of the findings, metres."""
    centres_mm = [(finding.x_mm, finding.y_mm, finding.z_mm) for finding in result.findings]
    return np.array(centres_mm).reshape(-1, 3) * MM


def _size_at(
    places_m: np.ndarray, damage: Judged, T_damage_change: np.ndarray, pitch_m: float
) -> DamageSize | None:
    """Return the size of the finding that covers most of the places (n, 3) of a change, if it
    covers `LEAST_COVERED` of them. ``T_damage_change`` (4, 4): from the change's frame."""
    sought = transform_points(T_damage_change, places_m)[:, :2]
    best = LEAST_COVERED
    size = None
    points_m = damage.cloud.points_m.reshape(-1, 3)
    for finding, detection in zip(damage.findings, damage.detections, strict=True):
        of_finding = points_m[detection.pixels]
        of_finding = of_finding[np.isfinite(of_finding[:, 2])]
        if not len(of_finding) or not len(sought):
            continue
        off_m, _ = cKDTree(of_finding[:, :2]).query(sought)
        covered = float((off_m <= pitch_m).mean())
        if covered >= best:
            best = covered
            size = DamageSize.of(finding)
    return size


def _departure_m(places_m: np.ndarray, damage: Judged, T_damage_change: np.ndarray) -> float:
    """Return how far a capture departs at the places (n, 3) of a change from the ring around them,
    as wide as they are; 0 if either is not judged."""
    sought = transform_points(T_damage_change, places_m)[:, :2]
    judged = np.isfinite(damage.evidence.residual_m) & damage.cloud.valid
    if not len(sought) or not judged.any():
        return 0.0
    residuals_m = damage.evidence.residual_m[judged]
    middle = sought.mean(axis=0)
    radius_m = float(np.linalg.norm(sought - middle, axis=1).max())
    off_m = np.linalg.norm(damage.cloud.points_m[judged][:, :2] - middle, axis=1)
    core_m = residuals_m[off_m < 0.5 * radius_m]
    ring_m = residuals_m[(off_m > 1.2 * radius_m) & (off_m < 2.0 * radius_m)]
    if not len(core_m) or not len(ring_m):
        return 0.0
    return median_of(core_m) - median_of(ring_m)


def _change(
    finding: Finding,
    then: DamageSize | None,
    now: DamageSize | None,
    *,
    was_there: bool,
    distance_m: float,
    lod_m: float,
) -> DamageChange:
    """Return what a finding is, from the damage that each capture shows at its place by itself.
    ``was_there``: the earlier capture departs more from its surroundings there.

    A capture alone may miss damage beside ribs; its depth then is that of the other capture less
    the change. Where both show something that does not differ by the change, it is a feature of the
    part, on which the change lies."""
    change = DamageSize.of(finding)
    if then is not None and now is not None:
        differing_mm = now.depth_mm - then.depth_mm
        if abs(differing_mm - change.depth_mm) > 0.5 * abs(change.depth_mm):
            then = None
            now = None
    if then is None and now is None:
        if was_there:
            then = DamageSize(change.diameter_mm, -change.depth_mm, change.depth_se_mm)
        else:
            now = change
    elif then is None:
        then = _rest(now, change, -1.0)
    elif now is None:
        now = _rest(then, change, 1.0)
    state = NEW
    if now is None:
        state = GONE
    elif then is not None:
        state = GROWN if abs(now.depth_mm) > abs(then.depth_mm) else SHRUNK
    return DamageChange(
        id=finding.id,
        state=state,
        then=then,
        now=now,
        distance_mm=distance_m / MM,
        lod_mm=lod_m / MM,
    )


def _rest(size: DamageSize | None, change: DamageSize, sign: float) -> DamageSize | None:
    """Return what remains of a damage after ``sign`` times a change of its depth; None if nothing
    is left beyond twice the standard error. Its width is not known."""
    assert size is not None
    depth_mm = size.depth_mm + sign * change.depth_mm
    error_mm = math.hypot(np.nan_to_num(size.depth_se_mm), np.nan_to_num(change.depth_se_mm))
    is_left = depth_mm * np.sign(size.depth_mm) > 2.0 * error_mm
    return DamageSize(math.nan, depth_mm, error_mm) if is_left else None
