"""Judges one detector on one cloud of a board: what it finds, which damages that hits, and what it
measures."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from detectors import DETECTORS, load_detector
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
from detectors.levels import highest_peaks
from detectors.pixels.masks import grown
from detectors.pixels.noise import median_of, sigma_of
from detectors.score_map import Findings, findings_at
from harness.evaluation.match import closest_pairs
from harness.trials.board import LabelledCloud, highest_within
from scenes.target.flaws import from_line_m
from scenes.target.truth import Damage

PEAKS = 10  # number of findings of a hole-free board that set a threshold
# an outline is grown by half of a camera's window before detections are compared with it
SMEARED_PX = 2
STEPS_PER_OCTAVE = 4
# further thresholds for detections: below them, most of a noisy face is one detection
FINDING_OCTAVES = (-2, 3)
# further thresholds for pixels: a third of the undamaged face exceeds the lowest
PIXEL_OCTAVES = (-6, 4)


@dataclass(frozen=True)
class Criteria:
    """The detector that judges a cloud, its threshold, and what counts as a hit."""

    detector: str
    """Name of the detector."""
    settings_json: str
    """Its settings as canonical JSON."""
    threshold: float | None
    """Threshold in the detector's units; None in calibration, which finds the quiet threshold."""
    radius_m: float
    """A detection whose centre lies this close to a damage's centre (or centre line) hits it."""
    overlap: float | None = None
    """A detection also hits a damage if at least this share of its pixels lies on it."""
    learned: str | None = None
    """File of what the detector has learned."""


@dataclass(frozen=True)
class Judgement:
    """The result of one detector on one cloud. Without a threshold there are no detections."""

    labelled: LabelledCloud
    """The cloud with the truth."""
    criteria: Criteria
    """The detector, its threshold, and the rule of hits."""
    detector: Detector
    """The detector, with what it has learned."""
    evidence: Evidence
    """Its scores."""
    quiet_threshold: float = np.nan
    """Score above which nothing is found on a board without damage; NaN on a damaged board."""
    surface_noise_m: float = np.nan
    """Robust deviation from the fitted surface on the undamaged face; NaN if it has no pixels."""
    detections: tuple[Detection, ...] = ()
    """The findings at the threshold, strongest first."""
    places_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """Place (m, 2) of each detection on the face."""
    hits: Mapping[int, int] = field(default_factory=dict)
    """Index of damage -> index of the detection that hits it; on a hole-free board, at the place
    of left-out damage."""
    parts: int = 0
    """Number of further detections that are parts of a damage, and so not false calls."""
    measurements: Mapping[int, Measurement] = field(default_factory=dict)
    """Index of detection -> its measurement, for the hits and the largest detection of a damaged
    board."""
    seconds: float = 0.0
    """Time to analyse, find and measure."""

    @property
    def false_calls(self) -> int:
        """Number of detections that belong to no damage."""
        if not self.labelled.damaged:
            return len(self.detections)
        return len(self.detections) - len(self.hits) - self.parts

    @property
    def largest(self) -> Measurement | None:
        """The measurement of the detection with the most pixels; None if nothing is measured."""
        return self.measurements.get(_largest(self.detections))

    @cached_property
    def inspected_m2(self) -> float:
        """Area of the face that the detector judges."""
        return self.labelled.area_m2(np.isfinite(self.evidence.score))

    @cached_property
    def signals(self) -> list[float]:
        """Highest score within the hit radius of each damage; NaN if none is judged there."""
        lines_m = [damage.line_m for damage in self.labelled.truth]
        signals: list[float] = highest_within(
            self.labelled.places_m, self.evidence.score, lines_m, self.criteria.radius_m
        ).tolist()
        return signals

    @cached_property
    def without_return(self) -> tuple[frozenset[int], int]:
        """The indices of the damages that detections of pixels without a return hit, and the
        number of false calls among these detections: they hit no damage and are not part of a
        detection by depth."""
        if getattr(self.detector, "tests_the_harness", False):
            return frozenset(), 0
        missing = missing_returns(self.labelled.cloud, self.evidence)
        if missing is None or not missing.detections:
            return frozenset(), 0
        hits: dict[int, int] = {}
        if self.labelled.damaged:
            hits, _ = matched(
                self.labelled, missing.detections, self.criteria.radius_m, self.criteria.overlap
            )
        hitting = {id(missing.detections[index]) for index in hits.values()}
        grid_shape = self.labelled.cloud.valid.shape
        false_calls = 0
        for detection in one_damage_once(grid_shape, self.detections, missing.detections):
            false_calls += detection.kind == "no return" and id(detection) not in hitting
        return frozenset(hits), false_calls

    @cached_property
    def operating(self) -> tuple[list[float], list[int], list[int]]:
        """A grid of thresholds about the one in use, and the numbers of detections and of hits at
        each."""
        thresholds: list[float] = grid(self._threshold, FINDING_OCTAVES).tolist()
        levels = findings_at(self.detector, self.labelled.cloud, self.evidence, thresholds)
        hits = [0] * len(levels)
        if self.labelled.damaged:
            rule = (self.criteria.radius_m, self.criteria.overlap)
            matches = _matched(self.labelled, levels, *rule)
            hits = [len(pairs) for pairs, _ in matches]
        return thresholds, [len(level.scores) for level in levels], hits

    @cached_property
    def peaks(self) -> tuple[float, ...]:
        """Scores of the strongest findings on a board without damage, highest first; at most
        `PEAKS`."""
        return highest_peaks(
            self.detector,
            self.labelled.cloud,
            self.evidence,
            quiet_threshold=self.quiet_threshold,
            count=PEAKS,
        )

    @cached_property
    def pixel_thresholds(self) -> np.ndarray:
        """The finer grid of thresholds (n,) for pixels."""
        return grid(self._threshold, PIXEL_OCTAVES)

    @cached_property
    def pixels_above(self) -> dict[str, tuple[int, list[int]]]:
        """Numbers of judged pixels, and of those that exceed each of `pixel_thresholds`, by damage
        (text of its id; "" for the undamaged face)."""
        regions = {}
        for damage in self.labelled.truth:
            regions[str(damage.id)] = self.labelled.outlines[damage.id]
        regions[""] = np.flatnonzero(self.labelled.undamaged.ravel())
        scores = self.evidence.score.ravel()
        counts = {}
        for name, pixels in regions.items():
            judged = scores[pixels]
            judged = np.sort(judged[np.isfinite(judged)])
            below = np.searchsorted(judged, self.pixel_thresholds, side="right")
            counts[name] = (len(judged), (len(judged) - below).tolist())
        return counts

    @property
    def _threshold(self) -> float:
        if self.criteria.threshold is None:
            raise ValueError("nothing is found without a threshold")
        return self.criteria.threshold


def judge(labelled: LabelledCloud, criteria: Criteria) -> Judgement:
    """Judge a detector on a cloud; without a threshold, only find the quiet threshold. Raises
    UserError if the detector cannot judge the cloud."""
    began = time.perf_counter()
    judgement = analysed(labelled, criteria)
    if criteria.threshold is not None:
        judgement = with_detections(judgement, criteria.threshold)
    return replace(judgement, seconds=time.perf_counter() - began)


def analysed(labelled: LabelledCloud, criteria: Criteria) -> Judgement:
    """Score every pixel of a cloud, without a threshold."""
    detector = detector_for(labelled, criteria)
    evidence = detector.analyse(labelled.cloud)
    quiet_threshold = np.nan
    if not labelled.damaged:
        quiet_threshold = detector.quiet_threshold(labelled.cloud, evidence)
    return Judgement(
        labelled=labelled,
        criteria=criteria,
        detector=detector,
        evidence=evidence,
        quiet_threshold=quiet_threshold,
        surface_noise_m=_surface_noise_m(labelled, evidence),
    )


def _surface_noise_m(labelled: LabelledCloud, evidence: Evidence) -> float:
    residual_m = evidence.residual_m[labelled.undamaged]
    residual_m = residual_m[np.isfinite(residual_m)]
    if not residual_m.size:
        return np.nan
    return sigma_of(residual_m - median_of(residual_m))


def with_truth(judgement: Judgement, labelled: LabelledCloud) -> Judgement:
    """Return the judgement of a hole-free board as one of the same cloud with other damage left
    out: only what is compared with the truth changes."""
    if labelled.damaged:
        raise ValueError("a board with other damage shows something else")
    judgement = replace(
        judgement,
        labelled=labelled,
        surface_noise_m=_surface_noise_m(labelled, judgement.evidence),
    )
    if judgement.criteria.threshold is None:
        return judgement
    return _with_hits(judgement, judgement.detections)


def _with_hits(judgement: Judgement, detections: tuple[Detection, ...]) -> Judgement:
    """Place detections on the face, and match them to the damage."""
    labelled = judgement.labelled
    centres_m = np.array([detection.centre_m for detection in detections]).reshape(-1, 3)
    hits, parts = matched(
        labelled, detections, judgement.criteria.radius_m, judgement.criteria.overlap
    )
    return replace(
        judgement,
        detections=detections,
        places_m=labelled.on_board(centres_m),
        hits=hits,
        parts=parts,
    )


def with_detections(judgement: Judgement, threshold: float) -> Judgement:
    """Find, match and measure at a threshold."""
    labelled = judgement.labelled
    detector = judgement.detector
    detections = detector.find(labelled.cloud, judgement.evidence, threshold)
    judgement = _with_hits(judgement, detections)
    measurements = {}
    if labelled.damaged:
        # the hits, and the largest detection, relative to which the other places are given
        for index in {*judgement.hits.values(), _largest(detections)} - {NONE}:
            measurements[index] = detector.measure(
                labelled.cloud, judgement.evidence, detections[index]
            )
    return replace(judgement, measurements=measurements)


NONE = -1  # index of no detection


def _largest(detections: Sequence[Detection]) -> int:
    """Return the index of the detection with the most pixels, or `NONE`."""
    sizes = [len(detection.pixels) for detection in detections]
    return sizes.index(max(sizes)) if sizes else NONE


def matched(
    labelled: LabelledCloud,
    detections: Sequence[Detection],
    radius_m: float,
    overlap: float | None,
) -> tuple[dict[int, int], int]:
    """Match detections to damages one to one, nearest first. Return the hits, {index of damage:
    index of detection}, and the number of other detections that are parts of a damage and so not
    false calls. A hit's centre lies within the radius of the damage's centre (or centre line, if
    long), or, with an ``overlap``, at least this share of its pixels lies on the damage, grown by
    `SMEARED_PX`. Other detections with this overlap are parts."""
    (matches,) = _matched(labelled, [Findings.of(detections)], radius_m, overlap)
    return matches


def _matched(
    labelled: LabelledCloud, levels: Sequence[Findings], radius_m: float, overlap: float | None
) -> list[tuple[dict[int, int], int]]:
    """Apply `matched` to the detections at each of several thresholds."""
    lines_m = [damage.line_m for damage in labelled.truth]
    areas = []
    if overlap is not None:
        outlines = [labelled.outlines[damage.id] for damage in labelled.truth]
        areas = smeared(outlines, labelled.cloud.valid.shape, grid=labelled.cloud.organised)
    return matched_places(lines_m, areas, labelled.on_board, levels, radius_m, overlap)


def smeared(
    outlines: Sequence[np.ndarray], shape: tuple[int, ...], *, grid: bool = True
) -> list[np.ndarray]:
    """Return a mask (n,) of pixels for each outline of flat indices, grown by `SMEARED_PX` on a
    ``grid``."""
    masks = []
    for outline in outlines:
        mask = np.zeros(shape, bool)
        mask.ravel()[outline] = True
        if grid:
            mask = grown(mask, SMEARED_PX)
        masks.append(mask.ravel())
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
    places_m = placed(np.concatenate([level.centres_m for level in levels]))
    distances_m = np.array([from_line_m(line_m, places_m) for line_m in lines_m])
    distances_m = distances_m.reshape(len(lines_m), len(places_m))
    matches = []
    start = 0
    for level in levels:
        count = len(level.scores)
        level_m = distances_m[:, start : start + count]
        start = start + count
        if overlap is None:
            matches.append((closest_pairs(level_m, radius_m), 0))
            continue
        sizes = _pixels_of(level, np.ones(len(level.labels), bool))
        on_damage = [_pixels_of(level, area[level.pixels]) for area in areas]
        covers = np.array(on_damage).reshape(len(areas), count) >= overlap * sizes
        close_m = np.where(covers, np.fmin(level_m, radius_m), level_m)
        pairs = closest_pairs(close_m, radius_m)
        covering = set(np.flatnonzero(covers.any(axis=0)).tolist())
        matches.append((pairs, len(covering - set(pairs.values()))))
    return matches


def _pixels_of(level: Findings, mask: np.ndarray) -> np.ndarray:
    """Return how many pixels of each detection (k,) a mask (n,) of all their pixels selects."""
    count = len(level.scores)
    return np.bincount(level.labels[mask] + 1, minlength=count + 1)[1:]


@lru_cache(maxsize=32)
def detector_of(name: str, settings_json: str, learned: str | None = None) -> Detector:
    """Return a detector; if the file ``learned`` is given, with what it has learned."""
    detector = load_detector(name, json.loads(settings_json))
    if learned is None or not isinstance(detector, Calibratable):
        return detector
    with np.load(learned, allow_pickle=False) as arrays:
        return detector.calibrated(dict(arrays))


def detector_for(labelled: LabelledCloud, criteria: Criteria) -> Detector:
    """Return the detector for a cloud. A built-in detector that needs the truth gets it; no
    plug-in does."""
    detector = detector_of(criteria.detector, criteria.settings_json, criteria.learned)
    if not isinstance(detector, NeedsTruth) or not DETECTORS.offer(criteria.detector).built_in:
        return detector
    damages: tuple[Damage, ...] = labelled.truth if labelled.damaged else ()
    truth = []
    for damage in damages:
        centre_m = labelled.centre_in_cloud_m(damage)
        truth.append(TrueDamage(centre_m, damage.diameter_m, labelled.outlines[damage.id]))
    return detector.with_truth(tuple(truth))


def grid(threshold: float, octaves: tuple[int, int]) -> np.ndarray:
    """Return thresholds (n,) in equal ratios about the one in use; only that one if it is 0."""
    if not threshold > 0:
        return np.array([threshold])
    lowest, highest = octaves
    steps = np.arange(lowest * STEPS_PER_OCTAVE, highest * STEPS_PER_OCTAVE + 1)
    return np.asarray(threshold * 2.0 ** (steps / STEPS_PER_OCTAVE))
