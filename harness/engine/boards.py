"""What a study asks of one board beside the ordinary rows: signals at every place, findings, and what would be found
and flagged at other thresholds than the one in use."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from detectors.interface import FindsAtOnce
from detectors.missing import missing_returns, one_damage_once
from harness.engine.judge import Judgement, centres_m, places_of
from harness.engine.sight import Sight
from harness.engine.sight_kernels import highest_within
from harness.evaluation.match import match
from harness.vocabulary.capture import Cloud
from harness.vocabulary.units import MM

STUDY_TABLES = ("sites", "findings", "operating", "pixels")
STEPS_PER_OCTAVE = 4
FINDING_OCTAVES = (-2, 3)
"""Other thresholds for findings, about the one in use: under a quarter of it most of a noisy face is one finding."""
PIXEL_OCTAVES = (-6, 4)
"""Other thresholds for pixels: reaches down to where a third of the undamaged face and more lies above."""


@dataclass(frozen=True)
class Judged:
    """Rows of one point's judgement. ``of_study``: by table of `STUDY_TABLES`; ``errors``: of a map, on the probes."""

    run: dict[str, Any]
    holes: list[dict[str, Any]]
    of_study: Mapping[str, list[dict[str, Any]]] = field(default_factory=dict)
    errors: list[int | None] | None = None


def study_rows(sight: Sight, judgement: Judgement, radius_m: float, *, hole_free: bool) -> Judged:
    """The rows of one board: of a board that only sets a threshold, the area that was judged, and what stood out most
    and where. Findings without return stand in ``no_return`` of each damage and ``no_return_calls`` of the run, beside
    those by depth."""
    score = judgement.evidence.score
    run = {**judgement.run, "inspected_m2": sight.area_m2(np.isfinite(score))}
    threshold = run["threshold"]
    if np.isnan(threshold):
        return Judged(run | _loudest(sight, score), [])
    without_return, calls = _without_return(sight, judgement, radius_m, hole_free=hole_free)
    run["no_return_calls"] = calls
    signals = highest_within(sight.places_m, score, centres_m(sight), radius_m).tolist()
    sites = list(_sites(sight, judgement, signals)) if hole_free else []
    judged = [] if hole_free else zip(judgement.holes, signals, strict=True)
    holes = [
        {**row, "signal": signal, "no_return": number in without_return} for number, (row, signal) in enumerate(judged)
    ]
    tables = {
        "sites": sites,
        "findings": list(_findings(sight, judgement, hole_free=hole_free)),
        "operating": [_operating(sight, judgement, threshold, radius_m, hole_free=hole_free)],
        "pixels": [] if hole_free else list(_pixels(sight, score, threshold)),
    }
    return Judged(run, holes, tables)


def _loudest(sight: Sight, score: np.ndarray) -> dict[str, float]:
    """Where on the board the pixel with the highest score lies; NaN where it is off the board."""
    if not np.isfinite(score).any():
        return {"loudest_x_mm": np.nan, "loudest_y_mm": np.nan}
    x_m, y_m = sight.places_m.reshape(-1, 2)[int(np.nanargmax(score))]
    return {"loudest_x_mm": float(x_m) / MM, "loudest_y_mm": float(y_m) / MM}


def _without_return(
    sight: Sight, judgement: Judgement, radius_m: float, *, hole_free: bool
) -> tuple[frozenset[int], int]:
    """Damages (indices into the truth) that a finding without return hits, and how many of these findings are false
    calls: those that hit none and are no part of a finding by depth. None for detectors that test the harness, whose
    findings are not what a cloud shows."""
    cloud = sight.cloud
    tests = getattr(judgement.detector, "tests_the_harness", False)
    missing = None if tests else missing_returns(cloud, judgement.evidence)
    if missing is None or not missing.detections:
        return frozenset(), 0
    found = missing.detections
    pairs = {} if hole_free else match(centres_m(sight), places_of(sight, found), radius_m)
    hits = {id(found[number]) for number in pairs.values()}
    alone = one_damage_once(cloud.valid.shape, judgement.detections, found)
    calls = sum(one.kind == "no return" and id(one) not in hits for one in alone)
    return frozenset(pairs), calls


def grid(threshold: float, octaves: tuple[int, int]) -> np.ndarray:
    """(n,) thresholds in equal ratios about the one in use; that alone where it is 0."""
    if not threshold > 0:
        return np.array([threshold])
    steps = np.arange(octaves[0] * STEPS_PER_OCTAVE, octaves[1] * STEPS_PER_OCTAVE + 1)
    return np.asarray(threshold * 2.0 ** (steps / STEPS_PER_OCTAVE))


def _sites(sight: Sight, judgement: Judgement, signals: list[float]) -> Iterator[dict[str, Any]]:
    """A hole-free board's places of left-out damage."""
    for number, (damage, signal) in enumerate(zip(sight.truth, signals, strict=True)):
        yield {
            "hole": str(damage.id),
            "true_diameter_mm": damage.diameter_m / MM,
            "true_depth_mm": damage.depth_m / MM,
            "true_x_mm": float(damage.centre_board_m[0]) / MM,
            "true_y_mm": float(damage.centre_board_m[1]) / MM,
            "detected": number in judgement.pairs,
            "signal": signal,
        }


def _findings(sight: Sight, judgement: Judgement, *, hole_free: bool) -> Iterator[dict[str, Any]]:
    pairs = {} if hole_free else judgement.pairs
    counts_for = {finding: str(sight.truth[damage].id) for damage, finding in pairs.items()}
    for number, (detection, place) in enumerate(zip(judgement.detections, judgement.places_m, strict=True)):
        yield {
            "x_mm": float(place[0]) / MM,
            "y_mm": float(place[1]) / MM,
            "score": float(detection.score),
            "hole": counts_for.get(number, ""),
        }


def _operating(
    sight: Sight, judgement: Judgement, threshold: float, radius_m: float, *, hole_free: bool
) -> dict[str, list[Any]]:
    """Lists over the grid of thresholds: numbers of findings and of hits."""
    thresholds = grid(threshold, FINDING_OCTAVES).tolist()
    found = _centres_at(judgement, sight.cloud, thresholds)
    findings = [len(centres) for centres in found]
    if hole_free:
        return {"threshold": thresholds, "findings": findings, "hits": [0] * len(found)}
    places_m = np.split(sight.on_board(np.concatenate(found)), np.cumsum(findings)[:-1])
    hits = [len(match(centres_m(sight), places, radius_m)) for places in places_m]
    return {"threshold": thresholds, "findings": findings, "hits": hits}


def _centres_at(judgement: Judgement, cloud: Cloud, thresholds: Sequence[float]) -> tuple[np.ndarray, ...]:
    """For each threshold the centres (m, 3) of what the detector finds."""
    detector, evidence = judgement.detector, judgement.evidence
    if isinstance(detector, FindsAtOnce):
        return detector.centres_at(cloud, evidence, thresholds)
    found = (detector.find(cloud, evidence, threshold) for threshold in thresholds)
    return tuple(np.array([one.centre_m for one in each]).reshape(-1, 3) for each in found)


def _pixels(sight: Sight, score: np.ndarray, threshold: float) -> Iterator[dict[str, Any]]:
    """Of each damage and of the undamaged face: judged pixels, and how many of them lie above each threshold."""
    thresholds = grid(threshold, PIXEL_OCTAVES)
    flat = score.ravel()
    parts = [(str(damage.id), sight.outlines[damage.id]) for damage in sight.truth]
    for name, pixels in (*parts, ("", np.flatnonzero(sight.undamaged.ravel()))):
        there = np.sort(flat[pixels][np.isfinite(flat[pixels])])
        above = len(there) - np.searchsorted(there, thresholds, side="right")
        yield {"hole": name, "pixels": len(there), "threshold": thresholds.tolist(), "above": above.tolist()}
