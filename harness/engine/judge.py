"""One detector on one cloud, measured against the truth: the rows of a run and of each damage; and the further rows of
a study's board: signals at every place, findings, and counts at other thresholds than the one in use."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from detectors import DETECTORS, load_detector
from detectors.interface import Detection, Detector, Evidence, FindsAtOnce, Measurement, ToldTheTruth, TrueDamage
from detectors.missing import missing_returns, one_damage_once
from detectors.noise import median_of, median_size_of
from harness.engine.setup import KnownCloud, highest_within
from harness.evaluation.match import match
from harness.vocabulary.capture import Cloud
from harness.vocabulary.units import MM
from scenes.target.truth import Damage


@lru_cache(maxsize=32)
def _detector(name: str, settings_json: str) -> Detector:

    return load_detector(name, json.loads(settings_json))


@dataclass(frozen=True)
class JudgedCloud:
    """One detector on one cloud. ``run``: its row; ``holes``: one row per damage where there is any.

    ``places_m`` (m, 2): where the findings lie on the face; ``pairs``: which finding counts for which damage, index
    into ``known.truth`` -> index into ``detections``, on a hole-free board those at places without damage.
    """

    run: dict[str, Any]
    holes: list[dict[str, Any]]
    detector: Detector
    evidence: Evidence
    detections: tuple[Detection, ...] = ()
    places_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    pairs: Mapping[int, int] = field(default_factory=dict)
    measured: tuple[Measurement, ...] = ()


def judge(
    known: KnownCloud,
    detector_name: str,
    settings_json: str,
    threshold: float | None,
    radius_m: float,
    *,
    hole_free: bool,
) -> JudgedCloud:
    """One detector on one cloud. Without a threshold only the quiet one is found."""
    cloud = known.cloud
    detector = detector_for(known, detector_name, settings_json, hole_free=hole_free)
    evidence = detector.analyse(cloud)
    run: dict[str, Any] = {
        "threshold": threshold if threshold is not None else np.nan,
        "quiet_threshold": detector.quiet_threshold(cloud, evidence) if hole_free else np.nan,
        "scale_mm": evidence.scale_m / MM,
        "surface_noise_mm": _robust_std(evidence.residual_m[known.undamaged]) / MM,
        "frames_used": cloud.n_frames,
        "left_out": len(cloud.left_out),
        "detections": 0,
        "false_calls": 0,
    }
    if threshold is None:
        return JudgedCloud(run, [], detector, evidence)
    detections = detector.find(cloud, evidence, threshold)
    places_m = places_of(known, detections)
    pairs = match(centres_m(known), places_m, radius_m)
    true = 0 if hole_free else len(pairs)
    run |= {"detections": len(detections), "false_calls": len(detections) - true}
    if hole_free:
        return JudgedCloud(run, [], detector, evidence, detections, places_m, pairs)
    measured = tuple(detector.measure(cloud, evidence, detection) for detection in detections)
    largest = max(measured, key=lambda m: m.points, default=None)
    holes = [
        _hole_row(known, evidence, damage, measured[pairs[i]] if i in pairs else None, largest)
        | {"threshold": threshold}
        for i, damage in enumerate(known.truth)
    ]
    return JudgedCloud(run, holes, detector, evidence, detections, places_m, pairs, measured)


def detector_for(known: KnownCloud, name: str, settings_json: str, *, hole_free: bool) -> Detector:
    """The detector that is to see a cloud. tofpod's own oracle is handed the truth; a plug-in never is."""
    detector = _detector(name, settings_json)
    if not (isinstance(detector, ToldTheTruth) and DETECTORS.offer(name).built_in):
        return detector
    truth = (
        TrueDamage(known.centre_in_cloud_m(damage), damage.diameter_m, known.outlines[damage.id])
        for damage in known.truth
    )
    return detector.told(() if hole_free else tuple(truth))


def places_of(known: KnownCloud, detections: Sequence[Detection]) -> np.ndarray:
    """(m, 2) places of findings on the face."""
    return known.on_board(np.array([one.centre_m for one in detections]).reshape(-1, 3))


def centres_m(known: KnownCloud) -> np.ndarray:
    """(n, 2) true centres of the damage on the face."""
    return np.array([damage.centre_board_m[:2] for damage in known.truth]).reshape(-1, 2)


def _hole_row(
    known: KnownCloud, evidence: Evidence, damage: Damage, found: Measurement | None, largest: Measurement | None
) -> dict[str, Any]:
    """The row of one damage. Distances in mm; positions as the thesis takes them, from the largest cluster's centre."""
    inside = known.outlines[damage.id]
    # a cloud without a grid has no pixels that could lack a range
    seen_z = known.cloud.points_m.reshape(-1, 3)[inside, 2]
    missing = float((~np.isfinite(seen_z)).mean()) if known.cloud.organised else np.nan
    residual = evidence.residual_m.reshape(-1)[inside]
    residual = residual[np.isfinite(residual)]
    median_m = median_of(residual) if residual.size else np.nan
    last = max(known.truth, key=lambda d: d.diameter_m)
    row: dict[str, Any] = {
        "hole": str(damage.id),
        "kind": damage.kind,
        "true_diameter_mm": damage.diameter_m / MM,
        "true_depth_mm": damage.depth_m / MM,
        "seen_depth_mm": known.seen_depth_m[damage.id] / MM,
        "true_x_mm": float(damage.centre_board_m[0]) / MM,
        "true_y_mm": float(damage.centre_board_m[1]) / MM,
        "true_offset_mm": float(np.linalg.norm(damage.centre_board_m - last.centre_board_m)) / MM,
        "detected": found is not None,
        "invalid_fraction": missing,
        "median_residual_mm": median_m / MM,
        "state": _state(found is not None, missing, median_m, evidence.scale_m),
    }
    return row | _measured_columns(known, damage, found, largest)


def _state(detected: bool, invalid_fraction: float, median_m: float, scale_m: float) -> str:
    """The state of a hole: "found", "invalid" (most of its pixels have no range), "wrong depth" (its pixels lie off the
    surface by more than the detector's scale, yet below threshold), or "invisible"."""
    if detected:
        return "found"
    if invalid_fraction > 0.5:
        return "invalid"
    return "wrong depth" if abs(median_m) > scale_m else "invisible"


def _measured_columns(
    known: KnownCloud, damage: Damage, found: Measurement | None, largest: Measurement | None
) -> dict[str, Any]:
    names = ("extent_diameter", "model_diameter", "model_diameter_se", "model_depth", "model_depth_se")
    if found is None or largest is None:
        blank = dict.fromkeys((*names, "extent_offset", "extent_error", "model_offset", "model_error"), np.nan)
        return {f"{k}_mm": v for k, v in blank.items()} | {"score": np.nan, "points": 0, "model_note": ""}
    values = {name: getattr(found, f"{name}_m") for name in names}
    true_centre = known.centre_in_cloud_m(damage)
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


STUDY_TABLES = ("sites", "findings", "operating", "pixels")
STEPS_PER_OCTAVE = 4
FINDING_OCTAVES = (-2, 3)
"""Other thresholds for findings, about the one in use: under a quarter of it most of a noisy face is one finding."""
PIXEL_OCTAVES = (-6, 4)
"""Other thresholds for pixels: reaches down to where a third of the undamaged face and more lies above."""


@dataclass(frozen=True)
class PointRows:
    """Rows of one point on one cloud. ``of_study``: by table of `STUDY_TABLES`; ``errors``: of a map, on the probes."""

    run: dict[str, Any]
    holes: list[dict[str, Any]]
    of_study: Mapping[str, list[dict[str, Any]]] = field(default_factory=dict)
    errors: list[int | None] | None = None


def study_rows(known: KnownCloud, judged_cloud: JudgedCloud, radius_m: float, *, hole_free: bool) -> PointRows:
    """The rows of one board: of a board that only sets a threshold, the area that was judged, and what stood out most
    and where. Findings without return stand in ``no_return`` of each damage and ``no_return_calls`` of the run, beside
    those by depth."""
    score = judged_cloud.evidence.score
    run = {**judged_cloud.run, "inspected_m2": known.area_m2(np.isfinite(score))}
    threshold = run["threshold"]
    if np.isnan(threshold):
        return PointRows(run | _loudest(known, score), [])
    without_return, calls = _without_return(known, judged_cloud, radius_m, hole_free=hole_free)
    run["no_return_calls"] = calls
    signals = highest_within(known.places_m, score, centres_m(known), radius_m).tolist()
    sites = list(_sites(known, judged_cloud, signals)) if hole_free else []
    judged = [] if hole_free else zip(judged_cloud.holes, signals, strict=True)
    holes = [
        {**row, "signal": signal, "no_return": number in without_return} for number, (row, signal) in enumerate(judged)
    ]
    tables = {
        "sites": sites,
        "findings": list(_findings(known, judged_cloud, hole_free=hole_free)),
        "operating": [_operating(known, judged_cloud, threshold, radius_m, hole_free=hole_free)],
        "pixels": [] if hole_free else list(_pixels(known, score, threshold)),
    }
    return PointRows(run, holes, tables)


def _loudest(known: KnownCloud, score: np.ndarray) -> dict[str, float]:
    """The place on the board of the pixel with the highest score; NaN where it is off the board."""
    if not np.isfinite(score).any():
        return {"loudest_x_mm": np.nan, "loudest_y_mm": np.nan}
    x_m, y_m = known.places_m.reshape(-1, 2)[int(np.nanargmax(score))]
    return {"loudest_x_mm": float(x_m) / MM, "loudest_y_mm": float(y_m) / MM}


def _without_return(
    known: KnownCloud, judged_cloud: JudgedCloud, radius_m: float, *, hole_free: bool
) -> tuple[frozenset[int], int]:
    """Damages (indices into the truth) that a finding without return hits, and how many of these findings are false
    calls: those that hit none and are no part of a finding by depth. None for detectors that test the harness, whose
    findings are not what a cloud shows."""
    cloud = known.cloud
    tests = getattr(judged_cloud.detector, "tests_the_harness", False)
    missing = None if tests else missing_returns(cloud, judged_cloud.evidence)
    if missing is None or not missing.detections:
        return frozenset(), 0
    found = missing.detections
    pairs = {} if hole_free else match(centres_m(known), places_of(known, found), radius_m)
    hits = {id(found[number]) for number in pairs.values()}
    alone = one_damage_once(cloud.valid.shape, judged_cloud.detections, found)
    calls = sum(one.kind == "no return" and id(one) not in hits for one in alone)
    return frozenset(pairs), calls


def grid(threshold: float, octaves: tuple[int, int]) -> np.ndarray:
    """(n,) thresholds in equal ratios about the one in use; that alone where it is 0."""
    if not threshold > 0:
        return np.array([threshold])
    steps = np.arange(octaves[0] * STEPS_PER_OCTAVE, octaves[1] * STEPS_PER_OCTAVE + 1)
    return np.asarray(threshold * 2.0 ** (steps / STEPS_PER_OCTAVE))


def _sites(known: KnownCloud, judged_cloud: JudgedCloud, signals: list[float]) -> Iterator[dict[str, Any]]:
    """A hole-free board's places of left-out damage."""
    for number, (damage, signal) in enumerate(zip(known.truth, signals, strict=True)):
        yield {
            "hole": str(damage.id),
            "true_diameter_mm": damage.diameter_m / MM,
            "true_depth_mm": damage.depth_m / MM,
            "true_x_mm": float(damage.centre_board_m[0]) / MM,
            "true_y_mm": float(damage.centre_board_m[1]) / MM,
            "detected": number in judged_cloud.pairs,
            "signal": signal,
        }


def _findings(known: KnownCloud, judged_cloud: JudgedCloud, *, hole_free: bool) -> Iterator[dict[str, Any]]:
    pairs = {} if hole_free else judged_cloud.pairs
    counts_for = {finding: str(known.truth[damage].id) for damage, finding in pairs.items()}
    for number, (detection, place) in enumerate(zip(judged_cloud.detections, judged_cloud.places_m, strict=True)):
        yield {
            "x_mm": float(place[0]) / MM,
            "y_mm": float(place[1]) / MM,
            "score": float(detection.score),
            "hole": counts_for.get(number, ""),
        }


def _operating(
    known: KnownCloud, judged_cloud: JudgedCloud, threshold: float, radius_m: float, *, hole_free: bool
) -> dict[str, list[Any]]:
    """Lists over the grid of thresholds: numbers of findings and of hits."""
    thresholds = grid(threshold, FINDING_OCTAVES).tolist()
    found = _centres_at(judged_cloud, known.cloud, thresholds)
    findings = [len(centres) for centres in found]
    if hole_free:
        return {"threshold": thresholds, "findings": findings, "hits": [0] * len(found)}
    places_m = np.split(known.on_board(np.concatenate(found)), np.cumsum(findings)[:-1])
    hits = [len(match(centres_m(known), places, radius_m)) for places in places_m]
    return {"threshold": thresholds, "findings": findings, "hits": hits}


def _centres_at(judged_cloud: JudgedCloud, cloud: Cloud, thresholds: Sequence[float]) -> tuple[np.ndarray, ...]:
    """The centres (m, 3) of the detector's findings at each threshold."""
    detector, evidence = judged_cloud.detector, judged_cloud.evidence
    if isinstance(detector, FindsAtOnce):
        return detector.centres_at(cloud, evidence, thresholds)
    found = (detector.find(cloud, evidence, threshold) for threshold in thresholds)
    return tuple(np.array([one.centre_m for one in each]).reshape(-1, 3) for each in found)


def _pixels(known: KnownCloud, score: np.ndarray, threshold: float) -> Iterator[dict[str, Any]]:
    """Count for each damage and the undamaged face judged pixels, and how many of them lie above each threshold."""
    thresholds = grid(threshold, PIXEL_OCTAVES)
    flat = score.ravel()
    parts = [(str(damage.id), known.outlines[damage.id]) for damage in known.truth]
    for name, pixels in (*parts, ("", np.flatnonzero(known.undamaged.ravel()))):
        there = np.sort(flat[pixels][np.isfinite(flat[pixels])])
        above = len(there) - np.searchsorted(there, thresholds, side="right")
        yield {"hole": name, "pixels": len(there), "threshold": thresholds.tolist(), "above": above.tolist()}
