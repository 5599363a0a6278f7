"""One detector on one cloud, measured against the truth: the rows of a run and of each damage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from detectors import DETECTORS, load_detector
from detectors.interface import Detection, Detector, Evidence, Measurement, ToldTheTruth, TrueDamage
from detectors.noise import median_of, median_size_of
from harness.engine.sight import Sight
from harness.evaluation.match import match
from harness.vocabulary.units import MM
from scenes.target.truth import Damage


@lru_cache(maxsize=32)
def _detector(name: str, settings_json: str) -> Detector:
    import json

    return load_detector(name, json.loads(settings_json))


@dataclass(frozen=True)
class Judgement:
    """One detector on one cloud. ``run``: its row; ``holes``: one row per damage where there is any.

    ``places_m`` (m, 2): where the findings lie on the face; ``pairs``: which finding counts for which damage, index
    into ``sight.truth`` -> index into ``detections``, on a hole-free board those at places without damage.
    """

    run: dict[str, Any]
    holes: list[dict[str, Any]]
    detector: Detector
    evidence: Evidence
    detections: tuple[Detection, ...] = ()
    places_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    pairs: Mapping[int, int] = field(default_factory=dict)


def judge(
    sight: Sight, detector_name: str, settings_json: str, threshold: float | None, radius_m: float, *, hole_free: bool
) -> Judgement:
    """One detector on one cloud. Without a threshold only the quiet one is found."""
    cloud = sight.cloud
    detector = detector_for(sight, detector_name, settings_json, hole_free=hole_free)
    evidence = detector.analyse(cloud)
    run: dict[str, Any] = {
        "threshold": threshold if threshold is not None else np.nan,
        "quiet_threshold": detector.quiet_threshold(cloud, evidence) if hole_free else np.nan,
        "scale_mm": evidence.scale_m / MM,
        "surface_noise_mm": _robust_std(evidence.residual_m[sight.undamaged]) / MM,
        "frames_used": cloud.n_frames,
        "left_out": len(cloud.left_out),
        "detections": 0,
        "false_calls": 0,
    }
    if threshold is None:
        return Judgement(run, [], detector, evidence)
    detections = detector.find(cloud, evidence, threshold)
    places_m = places_of(sight, detections)
    pairs = match(centres_m(sight), places_m, radius_m)
    true = 0 if hole_free else len(pairs)
    run |= {"detections": len(detections), "false_calls": len(detections) - true}
    if hole_free:
        return Judgement(run, [], detector, evidence, detections, places_m, pairs)
    measured = [detector.measure(cloud, evidence, detection) for detection in detections]
    largest = max(measured, key=lambda m: m.points, default=None)
    holes = [
        _hole_row(sight, evidence, damage, measured[pairs[i]] if i in pairs else None, largest)
        | {"threshold": threshold}
        for i, damage in enumerate(sight.truth)
    ]
    return Judgement(run, holes, detector, evidence, detections, places_m, pairs)


def detector_for(sight: Sight, name: str, settings_json: str, *, hole_free: bool) -> Detector:
    """The detector that is to see a cloud. tofpod's own oracle is handed the truth; a plug-in never is."""
    detector = _detector(name, settings_json)
    if not (isinstance(detector, ToldTheTruth) and DETECTORS.offer(name).built_in):
        return detector
    truth = (
        TrueDamage(sight.centre_in_cloud_m(damage), damage.diameter_m, sight.outlines[damage.id])
        for damage in sight.truth
    )
    return detector.told(() if hole_free else tuple(truth))


def places_of(sight: Sight, detections: Sequence[Detection]) -> np.ndarray:
    """(m, 2) places of findings on the face."""
    return sight.on_board(np.array([one.centre_m for one in detections]).reshape(-1, 3))


def centres_m(sight: Sight) -> np.ndarray:
    """(n, 2) true centres of the damage on the face."""
    return np.array([damage.centre_board_m[:2] for damage in sight.truth]).reshape(-1, 2)


def _hole_row(
    sight: Sight, evidence: Evidence, damage: Damage, found: Measurement | None, largest: Measurement | None
) -> dict[str, Any]:
    """How one damage fared. Distances in mm; positions as the thesis takes them, from the largest cluster's centre."""
    inside = sight.outlines[damage.id]
    # a cloud without a grid has no pixels that could lack a range
    seen_z = sight.cloud.points_m.reshape(-1, 3)[inside, 2]
    missing = float((~np.isfinite(seen_z)).mean()) if sight.cloud.organised else np.nan
    residual = evidence.residual_m.reshape(-1)[inside]
    residual = residual[np.isfinite(residual)]
    median_m = median_of(residual) if residual.size else np.nan
    last = max(sight.truth, key=lambda d: d.diameter_m)
    row: dict[str, Any] = {
        "hole": str(damage.id),
        "kind": damage.kind,
        "true_diameter_mm": damage.diameter_m / MM,
        "true_depth_mm": damage.depth_m / MM,
        "seen_depth_mm": sight.seen_depth_m[damage.id] / MM,
        "true_x_mm": float(damage.centre_board_m[0]) / MM,
        "true_y_mm": float(damage.centre_board_m[1]) / MM,
        "true_offset_mm": float(np.linalg.norm(damage.centre_board_m - last.centre_board_m)) / MM,
        "detected": found is not None,
        "invalid_fraction": missing,
        "median_residual_mm": median_m / MM,
        "state": _state(found is not None, missing, median_m, evidence.scale_m),
    }
    return row | _measured_columns(sight, damage, found, largest)


def _state(detected: bool, invalid_fraction: float, median_m: float, scale_m: float) -> str:
    """How a hole shows: "found"; else "invalid" (most of its pixels have no range), "wrong depth" (its pixels lie off
    the surface by more than the detector's scale, yet below threshold), or "invisible"."""
    if detected:
        return "found"
    if invalid_fraction > 0.5:
        return "invalid"
    return "wrong depth" if abs(median_m) > scale_m else "invisible"


def _measured_columns(
    sight: Sight, damage: Damage, found: Measurement | None, largest: Measurement | None
) -> dict[str, Any]:
    names = ("extent_diameter", "model_diameter", "model_diameter_se", "model_depth", "model_depth_se")
    if found is None or largest is None:
        blank = dict.fromkeys((*names, "extent_offset", "extent_error", "model_offset", "model_error"), np.nan)
        return {f"{k}_mm": v for k, v in blank.items()} | {"score": np.nan, "points": 0, "model_note": ""}
    values = {name: getattr(found, f"{name}_m") for name in names}
    true_centre = sight.centre_in_cloud_m(damage)
    for kind in ("extent", "model"):
        centre, reference = getattr(found, f"{kind}_centre_m"), getattr(largest, f"{kind}_centre_m")
        values[f"{kind}_offset"] = float(np.linalg.norm(centre - reference))
        values[f"{kind}_error"] = float(np.linalg.norm(centre - true_centre))
    return {f"{k}_mm": float(v) / MM for k, v in values.items()} | {
        "score": float(found.score),
        "points": int(found.points),
        "model_note": found.model_note,
    }


def _robust_std(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return median_size_of(finite - median_of(finite)) / 0.6745 if finite.size else float("nan")
