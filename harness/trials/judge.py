"""Judges one detector on one cloud: rows for the run and for each damage, and further rows for a
study's board."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from detectors import DETECTORS, load_detector
from detectors.averages.noise import median_of, sigma_of
from detectors.findings.missing import missing_returns, one_damage_once
from detectors.interface import (
    Calibratable,
    Detection,
    Detector,
    Evidence,
    Measurement,
    NeedsTruth,
    TrueDamage,
)
from detectors.masks import grown
from detectors.score_map import Findings, findings_at
from harness.evaluation.match import closest_pairs
from harness.trials.setup import KnownCloud, highest_within
from harness.vocabulary.geometry import MM
from scenes.target.flaws import from_line_m
from scenes.target.truth import Damage

Rows = dict[str, list[dict[str, Any]]]  # rows by table
STUDY_TABLES = ("sites", "findings", "operating", "pixels")
SMEARED_PX = (
    2  # an outline is grown by half of a camera's window before detections are compared with it
)
STEPS_PER_OCTAVE = 4
FINDING_OCTAVES = (
    -2,
    3,
)  # further thresholds for detections: below them, most of a noisy face is one detection
PIXEL_OCTAVES = (
    -6,
    4,
)  # further thresholds for pixels: a third of the undamaged face exceeds the lowest


@dataclass(frozen=True)
class JudgedCloud:
    """The result of one detector on one cloud. ``run``: its row. ``holes``: a row per damage.
    ``places_m`` (m, 2): of the detections on the face. ``pairs``: index into ``known.truth`` ->
    index into ``detections``; on a hole-free board, at the places of left-out damage. ``overlap``:
    the rule of matching beside the hit radius."""

    run: dict[str, Any]
    holes: list[dict[str, Any]]
    detector: Detector
    evidence: Evidence
    detections: tuple[Detection, ...] = ()
    places_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    pairs: Mapping[int, int] = field(default_factory=dict)
    overlap: float | None = None


def judge(
    known: KnownCloud,
    detector_name: str,
    settings_json: str,
    threshold: float | None,
    radius_m: float,
    *,
    overlap: float | None = None,
    hole_free: bool,
    learned: str | None = None,
) -> JudgedCloud:
    """Judge a detector on a cloud; without a threshold, only find the quiet threshold.
    ``learned``: path of a file."""
    cloud = known.cloud
    detector = detector_for(
        known, detector_name, settings_json, hole_free=hole_free, learned=learned
    )
    evidence = detector.analyse(cloud)
    residual_m = evidence.residual_m[known.undamaged]
    residual_m = residual_m[np.isfinite(residual_m)]
    noise_m = sigma_of(residual_m - median_of(residual_m)) if residual_m.size else np.nan
    run: dict[str, Any] = {
        "threshold": threshold if threshold is not None else np.nan,
        "quiet_threshold": detector.quiet_threshold(cloud, evidence) if hole_free else np.nan,
        "scale_mm": evidence.scale_m / MM,
        "surface_noise_mm": noise_m / MM,
        "frames_used": cloud.n_frames,
        "left_out": len(cloud.left_out),
        "detections": 0,
        "false_calls": 0,
    }
    if threshold is None:
        return JudgedCloud(run, [], detector, evidence)
    detections = detector.find(cloud, evidence, threshold)
    places_m = known.on_board(
        np.array([detection.centre_m for detection in detections]).reshape(-1, 3)
    )
    pairs, parts = matched(known, detections, radius_m, overlap)
    of_damage = 0 if hole_free else len(pairs) + parts
    run |= {"detections": len(detections), "false_calls": len(detections) - of_damage}
    if hole_free:
        return JudgedCloud(
            run, [], detector, evidence, detections, places_m, pairs, overlap=overlap
        )
    # measure the hits, and the largest detection: the other places are given relative to it
    largest = max(
        range(len(detections)), key=lambda number: len(detections[number].pixels), default=-1
    )
    wanted = {*pairs.values(), largest} - {-1}
    measured = {number: detector.measure(cloud, evidence, detections[number]) for number in wanted}
    found = [measured.get(pairs.get(i, -1)) for i in range(len(known.truth))]
    holes = [
        _hole_row(known, evidence, *pair, measured.get(largest))
        for pair in zip(known.truth, found, strict=True)
    ]
    holes = [{**row, "threshold": threshold} for row in holes]
    return JudgedCloud(run, holes, detector, evidence, detections, places_m, pairs, overlap)


def matched(
    known: KnownCloud, detections: Sequence[Detection], radius_m: float, overlap: float | None
) -> tuple[dict[int, int], int]:
    """Match detections to damages one to one, nearest first. Return the hits, {index of damage:
    index of detection}, and the number of other detections that are parts of a damage and so not
    false calls. A hit's centre lies within the radius of the damage's centre (or centre line, if
    long), or, with an ``overlap``, at least this share of its pixels lies on the damage, grown by
    `SMEARED_PX`. Other detections with this overlap are parts."""
    (found,) = _matched(known, [Findings.of(detections)], radius_m, overlap)
    return found


def _matched(
    known: KnownCloud, levels: Sequence[Findings], radius_m: float, overlap: float | None
) -> list[tuple[dict[int, int], int]]:
    """Apply `matched` to the detections at each of several thresholds."""
    lines = [damage.line_m for damage in known.truth]
    areas = []
    if overlap is not None:
        outlines = [known.outlines[damage.id] for damage in known.truth]
        areas = smeared(outlines, known.cloud.valid.shape, grid=known.cloud.organised)
    return matched_places(lines, areas, known.on_board, levels, radius_m, overlap)


def smeared(
    outlines: Sequence[np.ndarray], shape: tuple[int, ...], *, grid: bool = True
) -> list[np.ndarray]:
    """Return a mask (n,) of pixels for each outline of flat indices, grown by `SMEARED_PX` on a
    ``grid``."""
    masks = []
    for outline in outlines:
        on = np.zeros(shape, bool)
        on.ravel()[outline] = True
        masks.append((grown(on, SMEARED_PX) if grid else on).ravel())
    return masks


def matched_places(
    lines_m: Sequence[np.ndarray],
    areas: Sequence[np.ndarray],
    placed: Callable[[np.ndarray], np.ndarray],
    levels: Sequence[Findings],
    radius_m: float,
    overlap: float | None,
) -> list[tuple[dict[int, int], int]]:
    """Match as `matched` does. ``lines_m``: centre lines of the damages. ``areas``: their masks
    (none without an ``overlap``). ``placed``: maps centres onto the face. ``levels``: the
    detections at each of several thresholds."""
    places_m = placed(np.concatenate([found.centres_m for found in levels]))
    apart = np.array([from_line_m(line, places_m) for line in lines_m]).reshape(
        len(lines_m), len(places_m)
    )
    matches = []
    start = 0
    for found in levels:
        count = len(found.scores)
        near = apart[:, start : start + count]
        start = start + count
        if overlap is None:
            matches.append((closest_pairs(near, radius_m), 0))
            continue
        masks = (np.ones(len(found.labels), bool), *(area[found.pixels] for area in areas))
        sizes = np.array(
            [np.bincount(found.labels[mask] + 1, minlength=count + 1)[1:] for mask in masks]
        )
        lies = sizes[1:] >= overlap * sizes[0]
        pairs = closest_pairs(np.where(lies, np.fmin(near, radius_m), near), radius_m)
        matches.append(
            (pairs, len(set(np.flatnonzero(lies.any(axis=0)).tolist()) - set(pairs.values())))
        )
    return matches


@lru_cache(maxsize=32)
def detector_of(name: str, settings_json: str, learned: str | None = None) -> Detector:
    """Return a detector; if the file ``learned`` is given, with what it has learned."""
    detector = load_detector(name, json.loads(settings_json))
    if learned is None or not isinstance(detector, Calibratable):
        return detector
    with np.load(learned, allow_pickle=False) as arrays:
        return detector.calibrated(dict(arrays))


def detector_for(
    known: KnownCloud, name: str, settings_json: str, *, hole_free: bool, learned: str | None = None
) -> Detector:
    """Return the detector for a cloud. A built-in detector that needs the truth gets it; no
    plug-in does."""
    detector = detector_of(name, settings_json, learned)
    if not (isinstance(detector, NeedsTruth) and DETECTORS.offer(name).built_in):
        return detector
    damages = () if hole_free else known.truth
    truth = [
        TrueDamage(known.centre_in_cloud_m(each), each.diameter_m, known.outlines[each.id])
        for each in damages
    ]
    return detector.with_truth(tuple(truth))


def _place(damage: Damage) -> dict[str, Any]:
    x_m, y_m = damage.centre_board_m[:2]
    return {
        "hole": str(damage.id),
        "true_diameter_mm": damage.diameter_m / MM,
        "true_depth_mm": damage.depth_m / MM,
        "true_x_mm": float(x_m) / MM,
        "true_y_mm": float(y_m) / MM,
    }


def _hole_row(
    known: KnownCloud,
    evidence: Evidence,
    damage: Damage,
    found: Measurement | None,
    largest: Measurement | None,
) -> dict[str, Any]:
    """Return the row of one damage, mm. As in the thesis, positions are relative to the largest
    cluster."""
    inside = known.outlines[damage.id]
    # only a pixel of a grid can lack a range
    seen_z = known.cloud.points_m.reshape(-1, 3)[inside, 2]
    missing = float((~np.isfinite(seen_z)).mean()) if known.cloud.organised else np.nan
    residual = evidence.residual_m.reshape(-1)[inside]
    residual = residual[np.isfinite(residual)]
    median_m = median_of(residual) if residual.size else np.nan
    last = max(known.truth, key=lambda d: d.diameter_m)
    lost = (
        "invalid"
        if missing > 0.5
        else "wrong depth"
        if abs(median_m) > evidence.scale_m
        else "invisible"
    )
    row = _place(damage) | {
        "kind": damage.kind,
        "size_of": damage.size_of,
        "true_length_mm": damage.length_m / MM,
        "true_width_mm": damage.width_m / MM,
        "true_angle_deg": float(np.degrees(damage.angle_rad)),
        "seen_depth_mm": known.seen_depth_m[damage.id] / MM,
        "true_offset_mm": float(np.linalg.norm(damage.centre_board_m - last.centre_board_m)) / MM,
        "detected": found is not None,
        "invalid_fraction": missing,
        "median_residual_mm": median_m / MM,
        "state": "found" if found is not None else lost,
    }
    names = (
        "extent_diameter",
        "model_diameter",
        "model_diameter_se",
        "model_depth",
        "model_depth_se",
    )
    kinds = ("extent", "model")
    if found is None or largest is None:
        blank = (*names, *(f"{kind}_{what}" for kind in kinds for what in ("offset", "error")))
        row |= {f"{name}_mm": np.nan for name in blank} | dict.fromkeys(
            ("length_mm", "width_mm", "angle_deg"), np.nan
        )
        return row | {"score": np.nan, "points": 0, "model_note": ""}
    x, y, _ = known.T_board_cloud[:3, :3] @ found.along
    row |= {"length_mm": found.length_m / MM, "width_mm": found.width_m / MM}
    row |= {"angle_deg": float(np.degrees(np.arctan2(y, x) + np.pi / 2) % 180 - 90)}
    row |= {f"{name}_mm": float(getattr(found, f"{name}_m")) / MM for name in names}
    for kind in kinds:
        centre = getattr(found, f"{kind}_centre_m")
        reference = getattr(largest, f"{kind}_centre_m")
        row[f"{kind}_offset_mm"] = float(np.linalg.norm(centre - reference)) / MM
        row[f"{kind}_error_mm"] = (
            float(np.linalg.norm(centre - known.centre_in_cloud_m(damage))) / MM
        )
    return row | {
        "score": float(found.score),
        "points": int(found.points),
        "model_note": found.model_note,
    }


def study_rows(known: KnownCloud, judged: JudgedCloud, radius_m: float, *, hole_free: bool) -> Rows:
    """Return the rows of one board by table (`STUDY_TABLES`, "runs", "holes"); a board that only
    sets a threshold has its area and its highest score. Detections without return count in
    ``no_return`` and ``no_return_calls``."""
    score = judged.evidence.score
    threshold = judged.run["threshold"]
    run = {**judged.run, "inspected_m2": known.area_m2(np.isfinite(score))}
    if np.isnan(threshold):
        # the place of the highest score on the board and on the sensor; NaN if it is not there
        x_m = y_m = u_px = v_px = np.nan
        if np.isfinite(score).any():
            loudest = int(np.nanargmax(score))
            cloud = known.cloud
            x_m, y_m = known.places_m.reshape(-1, 2)[loudest]
            if cloud.organised and cloud.projection == "central":
                v_px, u_px = np.add(
                    np.unravel_index(loudest, score.shape), (cloud.region.row0, cloud.region.col0)
                )
        run |= {"loudest_x_mm": float(x_m) / MM, "loudest_y_mm": float(y_m) / MM}
        run |= {"loudest_u_px": float(u_px), "loudest_v_px": float(v_px)}
        return {"runs": [run], "holes": []}
    without_return, run["no_return_calls"] = _without_return(
        known, judged, radius_m, hole_free=hole_free
    )
    signals = highest_within(
        known.places_m, score, [damage.line_m for damage in known.truth], radius_m
    ).tolist()
    counts_for = (
        {}
        if hole_free
        else {finding: str(known.truth[i].id) for i, finding in judged.pairs.items()}
    )
    operating = _operating(known, judged, threshold, radius_m, hole_free=hole_free)
    tables: Rows = {
        "runs": [run],
        "holes": [],
        "sites": [],
        "findings": [],
        "operating": [operating],
        "pixels": [],
    }
    for number, (detection, place) in enumerate(
        zip(judged.detections, judged.places_m, strict=True)
    ):
        x_mm = float(place[0]) / MM
        y_mm = float(place[1]) / MM
        facts = {"score": float(detection.score), "hole": counts_for.get(number, "")}
        tables["findings"].append({"x_mm": x_mm, "y_mm": y_mm, **facts})
    if hole_free:  # the places where the damage was left out
        for i, (damage, signal) in enumerate(zip(known.truth, signals, strict=True)):
            tables["sites"].append(
                _place(damage) | {"detected": i in judged.pairs, "signal": signal}
            )
        return tables
    for i, (row, signal) in enumerate(zip(judged.holes, signals, strict=True)):
        tables["holes"].append({**row, "signal": signal, "no_return": i in without_return})
    # the number of judged pixels of each damage and of the undamaged face, and how many exceed
    # each threshold
    thresholds = grid(threshold, PIXEL_OCTAVES)
    flat = score.ravel()
    parts = [(str(damage.id), known.outlines[damage.id]) for damage in known.truth]
    for name, pixels in (*parts, ("", np.flatnonzero(known.undamaged.ravel()))):
        valid = np.sort(flat[pixels][np.isfinite(flat[pixels])])
        above = (len(valid) - np.searchsorted(valid, thresholds, side="right")).tolist()
        tables["pixels"].append(
            {"hole": name, "pixels": len(valid), "threshold": thresholds.tolist(), "above": above}
        )
    return tables


def grid(threshold: float, octaves: tuple[int, int]) -> np.ndarray:
    """Return thresholds (n,) in equal ratios about the one in use; only that one if it is 0."""
    if not threshold > 0:
        return np.array([threshold])
    steps = np.arange(octaves[0] * STEPS_PER_OCTAVE, octaves[1] * STEPS_PER_OCTAVE + 1)
    return np.asarray(threshold * 2.0 ** (steps / STEPS_PER_OCTAVE))


def _without_return(
    known: KnownCloud, judged: JudgedCloud, radius_m: float, *, hole_free: bool
) -> tuple[frozenset[int], int]:
    """Return the indices of the damages that detections without return hit, and the number of
    false calls among these detections: they hit no damage and are not part of a detection by
    depth."""
    tests = getattr(judged.detector, "tests_the_harness", False)
    missing = None if tests else missing_returns(known.cloud, judged.evidence)
    if missing is None or not missing.detections:
        return frozenset(), 0
    found = missing.detections
    pairs = {} if hole_free else matched(known, found, radius_m, judged.overlap)[0]
    hits = {id(found[number]) for number in pairs.values()}
    alone = one_damage_once(known.cloud.valid.shape, judged.detections, found)
    return frozenset(pairs), sum(
        each.kind == "no return" and id(each) not in hits for each in alone
    )


def _operating(
    known: KnownCloud, judged: JudgedCloud, threshold: float, radius_m: float, *, hole_free: bool
) -> dict[str, list[Any]]:
    """Return lists over the grid of thresholds: the numbers of detections and of hits."""
    thresholds = grid(threshold, FINDING_OCTAVES).tolist()
    found = findings_at(judged.detector, known.cloud, judged.evidence, thresholds)
    hits = [0] * len(found)
    if not hole_free:
        hits = [len(pairs) for pairs, _ in _matched(known, found, radius_m, judged.overlap)]
    return {"threshold": thresholds, "findings": [len(each.scores) for each in found], "hits": hits}
