"""One trial: frames of one set-up, their averages, every detector that asked for them, measured against the truth."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from detectors import load_detector
from detectors.average import AverageConfig, prefix_averages
from detectors.interface import Detector, Evidence, Measurement
from harness.engine.board_noise import board_noise_rows
from harness.engine.setup import SetUp, SetUpRef, load_set_up
from harness.evaluation.match import match
from harness.vocabulary.capture import Cloud
from harness.vocabulary.geometry import invert, transform_points
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.units import MM
from scenes.target.face import face_of
from scenes.target.truth import Damage

SIGHT_STEPS = 8
"""Fixed-point steps to where a line of sight meets a curved face; each shrinks the error by the face's slope."""

Role = Literal["hole_free", "damaged"]
Record = dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class PointTask:
    """What one point of the experiment asks of a trial. ``threshold`` is None while it is being calibrated."""

    digest: str
    variant: str
    frames: int
    detector: str
    settings_json: str
    average: AverageConfig
    radius_m: float
    threshold: float | None


@dataclass(frozen=True)
class TrialTask:
    """Frames of one set-up, drawn once, judged by all points that share them."""

    set_up: SetUpRef
    seed: int
    role: Role
    repeat: int
    points: tuple[PointTask, ...]


def run_trial(task: TrialTask) -> Record:
    """Run one trial; rows for the tables "runs", "holes", "probes" and "noise" (columns: `harness.engine.tables`)."""
    set_up = load_set_up(task.set_up)
    record: Record = {"runs": [], "holes": [], "probes": [], "noise": []}
    for config, points in _by_average(task.points):
        began = time.perf_counter()
        unit = set_up.damaged if task.role == "damaged" else set_up.hole_free
        counts = sorted({point.frames for point in points})
        capture = unit.capture(counts[-1], task.seed, task.role, task.repeat)
        clouds = prefix_averages(capture, counts, config)
        seconds_frames = time.perf_counter() - began
        if task.role == "hole_free":
            record["probes"] += list(_probe_rows(set_up, clouds, task.repeat, points))
            variants = {(point.variant, point.frames) for point in points}
            pair = unit.capture(2, task.seed, task.role, task.repeat)
            record["noise"] += list(board_noise_rows(set_up, clouds, pair, task.repeat, variants))
        for point in points:
            began = time.perf_counter()
            run, holes = _judge(set_up, clouds[point.frames], point, task.role)
            common = {"point": point.digest, "variant": point.variant, "frames": point.frames, "repeat": task.repeat}
            run["seconds_frames"] = seconds_frames / len(points)
            run["seconds_detect"] = time.perf_counter() - began
            record["runs"].append({**common, "role": task.role, **run})
            record["holes"] += [{**common, **hole} for hole in holes]
    return record


def _by_average(points: Sequence[PointTask]) -> Iterator[tuple[AverageConfig, list[PointTask]]]:
    groups: dict[str, list[PointTask]] = {}
    for point in points:
        groups.setdefault(canonical_json(point.average.to_data()), []).append(point)
    for group in groups.values():
        yield group[0].average, group


@lru_cache(maxsize=32)
def _detector(name: str, settings_json: str) -> Detector:
    import json

    return load_detector(name, json.loads(settings_json))


def _judge(set_up: SetUp, cloud: Cloud, point: PointTask, role: Role) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """One detector on one cloud: the run's row, and one row per damage where there is any."""
    detector = _detector(point.detector, point.settings_json)
    evidence = detector.analyse(cloud)
    run: dict[str, Any] = {
        "threshold": point.threshold if point.threshold is not None else np.nan,
        "quiet_threshold": detector.quiet_threshold(cloud, evidence) if role == "hole_free" else np.nan,
        "scale_mm": evidence.scale_m / MM,
        "surface_noise_mm": _robust_std(evidence.residual_m[_undamaged(set_up, role)]) / MM,
        "frames_used": cloud.n_frames,
        "left_out": len(cloud.left_out),
        "detections": 0,
        "false_calls": 0,
    }
    if point.threshold is None:
        return run, []
    detections = detector.find(cloud, evidence, point.threshold)
    measured = [detector.measure(cloud, evidence, detection) for detection in detections]
    pairs: dict[int, int] = {}
    if role == "damaged":
        centres = np.array([damage.centre_board_m[:2] for damage in set_up.truth]).reshape(-1, 2)
        pairs = match(centres, _on_board(set_up, measured), point.radius_m)
    run |= {"detections": len(detections), "false_calls": len(detections) - len(pairs)}
    if role == "hole_free":
        return run, []
    largest = max(measured, key=lambda m: m.points, default=None)
    holes = [
        _hole_row(set_up, cloud, evidence, damage, measured[pairs[i]] if i in pairs else None, largest)
        | {"threshold": point.threshold}
        for i, damage in enumerate(set_up.truth)
    ]
    return run, holes


def _undamaged(set_up: SetUp, role: Role) -> np.ndarray:
    """(h, w) bool: pixels that show undamaged face; where the camera is so far that none is left beside the damage, of
    a hole-free board all but the rim's."""
    return set_up.bare if role == "hole_free" and not set_up.intact.any() else set_up.intact


def _on_board(set_up: SetUp, measured: Sequence[Measurement]) -> np.ndarray:
    """(m, 2) places of the findings on the board: where the line of sight through their centre meets the face.

    The centre itself lies at depth, up to a centimetre aside of where a viewer would point on the face.
    """
    centres = np.array([m.extent_centre_m for m in measured]).reshape(-1, 3)
    T_board_camera = invert(set_up.T_camera_board)
    board, lens = transform_points(T_board_camera, centres), T_board_camera[:3, 3]
    face = face_of(set_up.target.board)
    place = board
    for _ in range(SIGHT_STEPS):
        height = np.nan_to_num(face.height_m(place[:, 0], place[:, 1]))
        share = (lens[2] - height) / (lens[2] - board[:, 2])
        place = lens + share[:, None] * (board - lens)
    return np.asarray(place[:, :2])


def _hole_row(
    set_up: SetUp,
    cloud: Cloud,
    evidence: Evidence,
    damage: Damage,
    found: Measurement | None,
    largest: Measurement | None,
) -> dict[str, Any]:
    """How one damage fared. Distances in mm; positions as the thesis takes them, from the largest cluster's centre."""
    inside = set_up.outlines[damage.id]
    missing = ~cloud.valid.ravel()[inside]
    residual = evidence.residual_m.ravel()[inside]
    median_m = float(np.median(residual[np.isfinite(residual)])) if np.isfinite(residual).any() else np.nan
    last = max(set_up.truth, key=lambda d: d.diameter_m)
    row: dict[str, Any] = {
        "hole": str(damage.id),
        "kind": damage.kind,
        "true_diameter_mm": damage.diameter_m / MM,
        "true_depth_mm": damage.depth_m / MM,
        "seen_depth_mm": _seen_depth_m(set_up, inside) / MM,
        "true_x_mm": float(damage.centre_board_m[0]) / MM,
        "true_y_mm": float(damage.centre_board_m[1]) / MM,
        "true_offset_mm": float(np.linalg.norm(damage.centre_board_m - last.centre_board_m)) / MM,
        "detected": found is not None,
        "invalid_fraction": float(missing.mean()),
        "median_residual_mm": median_m / MM,
        "state": _state(found is not None, float(missing.mean()), median_m, evidence.scale_m),
    }
    return row | _measured_columns(damage, found, largest)


def _seen_depth_m(set_up: SetUp, inside: np.ndarray) -> float:
    """How far behind the face the central rays through a hole end, along the optical axis: the median of those that
    come within 1 mm of the deepest (walls are seen in passing). Behind a through-hole that is the backing."""
    depth = set_up.seen_z_m.ravel()[inside] - set_up.true_z_m.ravel()[inside]
    depth = depth[np.isfinite(depth)]
    return float(np.median(depth[depth > depth.max() - 1 * MM])) if depth.size else float("nan")


def _state(detected: bool, invalid_fraction: float, median_m: float, scale_m: float) -> str:
    """How a hole shows: "found"; else "invalid" (most of its pixels have no range), "wrong depth" (its pixels lie off
    the surface by more than the detector's scale, yet below threshold), or "invisible"."""
    if detected:
        return "found"
    if invalid_fraction > 0.5:
        return "invalid"
    return "wrong depth" if abs(median_m) > scale_m else "invisible"


def _measured_columns(damage: Damage, found: Measurement | None, largest: Measurement | None) -> dict[str, Any]:
    names = ("extent_diameter", "model_diameter", "model_diameter_se", "model_depth", "model_depth_se")
    if found is None or largest is None:
        blank = dict.fromkeys((*names, "extent_offset", "extent_error", "model_offset", "model_error"), np.nan)
        return {f"{k}_mm": v for k, v in blank.items()} | {"score": np.nan, "points": 0, "model_note": ""}
    values = {name: getattr(found, f"{name}_m") for name in names}
    for kind in ("extent", "model"):
        centre, reference = getattr(found, f"{kind}_centre_m"), getattr(largest, f"{kind}_centre_m")
        values[f"{kind}_offset"] = float(np.linalg.norm(centre - reference))
        values[f"{kind}_error"] = float(np.linalg.norm(centre - damage.centre_camera_m))
    return {f"{k}_mm": float(v) / MM for k, v in values.items()} | {
        "score": float(found.score),
        "points": int(found.points),
        "model_note": found.model_note,
    }


def _probe_rows(
    set_up: SetUp, clouds: dict[int, Cloud], repeat: int, points: Sequence[PointTask]
) -> Iterator[dict[str, Any]]:
    """Errors of z on the probes, for each variant and number of frames: one row with a list, in micrometres."""
    for variant, frames in sorted({(point.variant, point.frames) for point in points}):
        error_m = clouds[frames].points_m[..., 2].ravel()[set_up.probes] - set_up.true_z_m.ravel()[set_up.probes]
        whole = [round(float(e) * 1e7) if np.isfinite(e) else None for e in error_m]
        yield {"variant": variant, "frames": frames, "repeat": repeat, "error_tenth_um": whole}


def _robust_std(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(np.abs(finite - np.median(finite))) / 0.6745) if finite.size else float("nan")
