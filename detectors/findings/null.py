"""The threshold that a capture determines itself: noise towards the camera shows how often noise
looks like damage.

Damage lies behind the surface. Peaks in front of the surface are noise, fixed pattern or texture,
after objects on the target (`detectors.findings.objects`) and a margin are excluded. The tail of
these peaks is extrapolated to the threshold at which the wanted number of false calls is expected,
bumps and hole-like calls together (`detectors.findings.tails`).

Beside objects, print and edges false calls are more frequent, on both sides of the surface. The
peaks in front of it there have a tail of their own, which predicts how many more calls that
threshold lets pass. A small mark in the picture that lies within a finding is the finding itself.

Where light from the target's edge mixes in, peaks along its rim are higher. If the peaks elsewhere
do not explain those at the rim, these have a law of their own too, and scores at the rim are
scaled down so that one threshold holds for both.

Not modelled: noise that is asymmetric beyond what `skew_of` sees in the core; damage towards the
camera that is no larger than the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from detectors.findings.objects import MOST_MASKED, Marks, marks_of
from detectors.findings.tails import Tail, counts_of
from detectors.interface import Detection, Detector, Evidence
from detectors.levels import findings_at
from detectors.pixels.masks import holes_filled, rim_distance_px
from harness.vocabulary.geometry import Cloud

# --- tails ---

THEORY_AT_MARKS = 1.0
"""Weight of the theory of normal noise at marks, in peaks (`NORMAL_PEAKS` elsewhere): what print
and edges make of the distance is no normal noise."""
CONTRADICTED = 0.1
"""A tail is rejected if the probability of the number of peaks above the threshold is lower."""

# --- peaks and thresholds ---

WANTED_PEAKS = 60  # above the floor: their mean excess is known to 13 %
FEWEST_PEAKS = 8  # above the floor: their mean excess is known to 35 %
CROWDED = 0.6
"""Share of the largest number of findings at any threshold that the floor may have at most: at
more, findings still join."""
SPARSE = 0.05  # share of the judged pixels that exceed the thresholds that are tried first
LADDER = 1.06  # ratio of thresholds tried for the floor
LEAST = 3.0
"""Lowest threshold in units of score: bounded errors end so near that peaks in front predict
nothing behind."""
MOST = 10.0
"""Thresholds above this are seldom due to noise alone, which needs 4 to 7 on all recordings.
Averages of 50 simulated frames of an L515 need up to 13 on hole-free boards, probably because of
the pattern that all frames share."""
MOST_SKEW = 0.15
"""Difference of the quartiles' distances from the median, over their sum: 0.15 means 1.35 times as
far on one side."""

# --- marks and the rim ---

PLAIN = "plain"
"""Name of the law of noise away from long marks."""
MARKS = "at marks"
"""Name of the law at objects, print and edges."""
RIM = "at the rim"
"""Name of the law along the target's rim."""
RIM_PX = 10  # depth of the target's rim
RIM_CHANCE = 0.01
"""Peaks at the rim have a law of their own if chance makes as many high ones more seldom."""
RIM_CALLS = 2  # calls behind the surface along the rim that chance does not explain


@dataclass(frozen=True)
class OwnThreshold:
    """A threshold that a capture's own noise determines. With too few peaks the numbers are NaN."""

    threshold: float
    """Units of score."""
    expected: float
    """False calls expected at the threshold, in front of and behind the surface, with those at
    marks."""
    at_marks: float
    """False calls of these that are expected at objects, print and edges in the picture."""
    low: float
    """Fewest false calls of the 95 % interval of their number (`counts_of`)."""
    high: float
    """Most of it."""
    peaks: int
    """Number of peaks above the floor on which it is based."""
    floor: float
    """Units of score."""
    objects: int
    """Number of regions that are excluded as objects."""
    rim_pixels: int
    """Number of pixels along the rim that mix in what lies behind the target."""
    rim_scale: float
    """Factor of scores at the rim in ``evidence``; 1 if one law explains all peaks."""
    evidence: Evidence
    """Evidence to search: without the rim pixels, and with scores at the rim scaled."""
    doubts: tuple[str, ...]
    """Full sentences on why the numbers cannot be trusted."""
    tails: dict[str, Tail]
    """Laws of the false calls on one side of the surface, by `PLAIN`, `RIM` and `MARKS`; empty
    with too few peaks."""


def own_threshold(
    detector: Detector,
    cloud: Cloud,
    evidence: Evidence,
    false_calls: float,
) -> OwnThreshold:
    """Find the threshold at which ``false_calls`` (above 0) are expected, from the capture's own
    peaks towards the camera; at least `LEAST`. With too few peaks the numbers are NaN, and
    ``doubts`` says so."""
    judged = np.isfinite(evidence.score)
    marks = marks_of(cloud, evidence)
    covered = marks.covered
    before = _only(evidence, ~behind(evidence))
    peaks = _peaks(detector, cloud, before, marks)
    doubts = _doubts_about_symmetry(evidence)
    if len(peaks.scores) < FEWEST_PEAKS:
        doubts.append(
            f"only {len(peaks.scores)} peaks of noise stand out towards the camera, too few to set"
            f" a threshold (at least {FEWEST_PEAKS} are needed)"
        )
        return OwnThreshold(
            threshold=float("nan"),
            expected=float("nan"),
            at_marks=float("nan"),
            low=float("nan"),
            high=float("nan"),
            peaks=len(peaks.scores),
            floor=peaks.floor,
            objects=marks.regions,
            rim_pixels=0,
            rim_scale=1.0,
            evidence=evidence,
            doubts=tuple(doubts),
            tails={},
        )
    # half of the false calls lie in front of the surface, where the peaks are
    threshold, tails = _laws(peaks, judged, marks, false_calls / 2.0)
    tail = tails[PLAIN]
    rim_scale = tails[RIM].scale if RIM in tails else 1.0
    evidence = with_rim_scaled(evidence, rim_scale)
    expected = {name: 2.0 * tail.expected(threshold) for name, tail in tails.items()}
    low, high = counts_of(tails, threshold)
    rim = np.zeros(judged.shape, bool)
    if cloud.organised:
        rim = _mixed_rim(detector, cloud, evidence, threshold)
    if threshold > MOST:
        doubts.append(
            "bumps or structure of the surface, the camera's fixed pattern, or noise with heavy"
            f" tails, raise it above {MOST:g} units of score, and fainter damage is not found"
            " (--threshold states another)"
        )
    hidden = int((covered & judged).sum())
    if hidden > MOST_MASKED * judged.sum():
        doubts.append(
            f"{100 * hidden / judged.sum():.0f} % of what is judged lies under or beside objects,"
            " and the rest may not stand for the whole"
        )
    return OwnThreshold(
        threshold=threshold,
        expected=sum(expected.values()),
        at_marks=expected.get(MARKS, 0.0),
        low=low,
        high=high,
        peaks=tail.peaks,
        floor=tail.floor,
        objects=marks.regions,
        rim_pixels=int(rim.sum()),
        rim_scale=rim_scale,
        evidence=_only(evidence, ~rim),
        doubts=tuple(doubts),
        tails=tails,
    )


def _laws(
    peaks: _FalsePeaks,
    judged: np.ndarray,
    marks: Marks,
    number: float,
) -> tuple[float, dict[str, Tail]]:
    """Return the threshold at which ``number`` are expected on one side away from marks, and the
    laws. ``judged`` (h, w) bool.

    The rim has a law of its own if the peaks elsewhere do not explain as many high ones there, at
    least `FEWEST_PEAKS`; it then gets its share of the number by area."""
    tails = {PLAIN: _fitting_tail(peaks.scores, peaks.floor, number, _area_ratio(judged, marks))}
    threshold = max(tails[PLAIN].threshold(number), LEAST)
    if marks.count:
        tails[MARKS] = Tail.of(peaks.at_marks, peaks.floor, THEORY_AT_MARKS)

    rim = judged & _rim_of(judged)
    share = float(rim.sum()) / float(judged.sum())
    inner = peaks.scores[~peaks.is_at_rim]
    outer = peaks.scores[peaks.is_at_rim]
    if len(inner) < FEWEST_PEAKS or not 0.0 < share < 0.5:
        return threshold, tails
    inner_number = (1.0 - share) * number
    inner_ratio = _area_ratio(judged & ~rim, marks)
    inner_tail = _fitting_tail(inner, peaks.floor, inner_number, inner_ratio)
    inner_threshold = max(inner_tail.threshold(inner_number), LEAST)
    exceeding = int((outer > inner_threshold).sum())
    # fewer than so many may be bumps
    if exceeding < FEWEST_PEAKS or special.gammainc(exceeding, share * number) > RIM_CHANCE:
        return threshold, tails
    rim_tail = replace(
        Tail.of(outer, peaks.floor, THEORY_AT_MARKS), area_ratio=_area_ratio(rim, marks)
    )
    rim_threshold = rim_tail.threshold(share * number)
    if rim_threshold <= inner_threshold:
        return threshold, tails
    tails[PLAIN] = inner_tail
    tails[RIM] = replace(rim_tail, scale=inner_threshold / rim_threshold)
    return inner_threshold, tails


def _rim_of(judged: np.ndarray) -> np.ndarray:
    """Return (h, w) bool: the pixels along the rim of the judged ones, (h, w) bool."""
    return rim_distance_px(holes_filled(judged)) <= RIM_PX


def is_at_rim(evidence: Evidence, detection: Detection) -> bool:
    """Return whether a finding's highest score lies along the rim of the judged area."""
    return bool(
        _rim_of(np.isfinite(evidence.residual_m)).reshape(-1)[_peak_of(evidence, detection)]
    )


def _peak_of(evidence: Evidence, detection: Detection) -> int:
    """Return the flat index of a finding's highest score."""
    scores = np.nan_to_num(evidence.score.reshape(-1)[detection.pixels])
    return int(detection.pixels[np.argmax(scores)])


def with_rim_scaled(evidence: Evidence, scale: float) -> Evidence:
    """Return the evidence with scores along the rim multiplied by a scale, and by less up to twice
    as far from it: a finding at the rim, as wide as the widest filters, is not cut in two."""
    if scale == 1.0:
        return evidence
    depth_px = rim_distance_px(holes_filled(np.isfinite(evidence.residual_m)))
    nearness = np.clip(2.0 - depth_px / RIM_PX, 0.0, 1.0)
    return replace(evidence, score=evidence.score * scale**nearness)


def _area_ratio(judged: np.ndarray, marks: Marks) -> float:
    """Return the judged area away from long marks over the area where peaks count as noise.

    ``judged`` (h, w) bool. Peaks at small marks do not count, but noise is as frequent there."""
    counted = int((judged & ~marks.covered).sum())
    return float((judged & ~marks.beside_long).sum()) / max(counted, 1)


def _fitting_tail(
    peaks: np.ndarray,
    floor: float,
    number: float,
    area_ratio: float = 1.0,
) -> Tail:
    """Return a tail that the highest peaks (n,) do not contradict at the threshold at which
    ``number`` are expected, in ``area_ratio`` times the area of the peaks.

    It takes all peaks, then the higher half, and so on while too many exceed the threshold: a few
    wide waves of a fixed pattern are then higher than the noise of many pixels, and one tail does
    not fit both."""
    falling = np.sort(peaks)[::-1]
    while True:
        tail = Tail.of(falling, floor)
        half = len(falling) // 2
        exceeding = int((falling > tail.threshold(number / area_ratio)).sum())
        likely = special.gammainc(exceeding, number / area_ratio) > CONTRADICTED
        if half < FEWEST_PEAKS or likely:
            return replace(tail, area_ratio=area_ratio)
        floor = float(falling[half])
        falling = falling[:half]


def behind(evidence: Evidence) -> np.ndarray:
    """Return (h, w) bool: pixels whose score indicates something behind the surface."""
    if evidence.behind is not None:
        return evidence.behind
    with np.errstate(invalid="ignore"):
        return evidence.residual_m >= 0


def _only(evidence: Evidence, where: np.ndarray) -> Evidence:
    """Return the evidence with scores only ``where`` (h, w)."""
    return replace(evidence, score=np.where(where, evidence.score, np.nan))


def skew_of(evidence: Evidence) -> float:
    """Return Bowley's skewness of the residual, -1 to 1; damage on less than a quarter hardly
    changes it."""
    finite_m = evidence.residual_m[np.isfinite(evidence.residual_m)]
    low, middle, high = np.quantile(finite_m, (0.25, 0.5, 0.75))
    return float((high + low - 2 * middle) / max(high - low, 1e-12))


def _doubts_about_symmetry(evidence: Evidence) -> list[str]:
    skew = skew_of(evidence)
    if abs(skew) <= MOST_SKEW:
        return []
    ratio = (1 + abs(skew)) / (1 - abs(skew))
    side = "behind" if skew > 0 else "before"
    return [
        f"the residual is not symmetric: its quartiles reach {ratio:.1f} times as far {side} the"
        " surface as to the other side"
    ]


# --- the peaks ---


@dataclass(frozen=True)
class _FalsePeaks:
    """Findings in front of the surface, which are false calls."""

    floor: float
    """Units of score; about `WANTED_PEAKS` of them away from marks exceed it."""
    scores: np.ndarray
    """(n,): of the findings above the floor away from marks."""
    is_at_rim: np.ndarray
    """(n,) bool: those along the rim."""
    at_marks: np.ndarray
    """(m,): scores of the findings at long marks."""


def _peaks(
    detector: Detector,
    cloud: Cloud,
    before: Evidence,
    marks: Marks,
) -> _FalsePeaks:
    """Return the peaks in front of the surface.

    ``before``: evidence with scores in front of the surface only. Findings at small marks, and
    those on objects, which are no false calls, do not count."""
    evidence = _only(before, ~marks.covered)
    judged = evidence.score[np.isfinite(evidence.score)]
    if not (len(judged) and judged.max() > 0):
        return _FalsePeaks(1.0, np.zeros(0), np.zeros(0, bool), np.zeros(0))
    least = max(float(np.median(judged)), 1e-3 * float(judged.max()))
    steps = np.arange(np.log(judged.max() / least) / np.log(LADDER) + 1)
    thresholds = (least * LADDER**steps).tolist()
    floor = _floor_of(detector, cloud, evidence, thresholds)
    hidden = marks.covered.reshape(-1)
    proud = marks.proud.reshape(-1)
    rim = np.zeros(hidden.shape, bool)
    if cloud.organised:
        rim = _rim_of(np.isfinite(before.residual_m)).reshape(-1)
    scores = []
    at_rim = []
    scores_at_marks = []
    for detection in detector.find(cloud, before, floor):
        if not hidden[detection.pixels].any():
            scores.append(detection.score)
            at_rim.append(rim[_peak_of(before, detection)])
        elif not proud[detection.pixels].any() and marks.hold(detection):
            scores_at_marks.append(detection.score)
    return _FalsePeaks(
        floor=floor,
        scores=np.array(scores),
        is_at_rim=np.array(at_rim, bool),
        at_marks=np.array(scores_at_marks),
    )


def _floor_of(
    detector: Detector,
    cloud: Cloud,
    evidence: Evidence,
    thresholds: Sequence[float],
) -> float:
    """Return which of rising thresholds is the floor of the peaks.

    Only few pixels exceed the higher thresholds, so these are tried first. They decide if more than
    enough findings join at the highest threshold with enough of them: lower ones can only have
    more."""
    judged = evidence.score[np.isfinite(evidence.score)]
    start = int(np.searchsorted(thresholds, np.quantile(judged, 1.0 - SPARSE)))
    counts = _counts(detector, cloud, evidence, thresholds[start:])
    enough = [n for n in range(len(counts)) if counts[n] >= WANTED_PEAKS]
    if enough and counts[enough[-1]] <= CROWDED * max(counts):
        return thresholds[start + enough[-1]]
    return thresholds[_floor_among(_counts(detector, cloud, evidence, thresholds))]


def _counts(
    detector: Detector,
    cloud: Cloud,
    evidence: Evidence,
    thresholds: Sequence[float],
) -> list[int]:
    """Return the number of findings at each of rising thresholds."""
    if not thresholds:
        return []
    findings = findings_at(detector, cloud, evidence, thresholds)
    return [len(at_threshold.scores) for at_threshold in findings]


def _floor_among(counts: list[int]) -> int:
    """Return which of rising thresholds is the floor, by the numbers of findings at each: the
    highest with enough peaks, else the first at which findings no longer join."""
    crowd = counts.index(max(counts))
    free = [n for n in range(crowd, len(counts)) if counts[n] <= CROWDED * counts[crowd]]
    enough = [n for n in free if counts[n] >= WANTED_PEAKS]
    if enough:
        return enough[-1]
    return free[0] if free else crowd


# --- the target's rim ---


def _mixed_rim(
    detector: Detector,
    cloud: Cloud,
    evidence: Evidence,
    threshold: float,
) -> np.ndarray:
    """Return (h, w) bool: a band along the outline, as wide as the zone of frequent calls behind
    the surface."""
    judged = np.isfinite(evidence.score)
    filled = holes_filled(judged)
    depth_px = rim_distance_px(filled)
    flat_px = depth_px.reshape(-1)
    calls = detector.find(cloud, _only(evidence, behind(evidence)), threshold)
    reaches_px = [
        float(flat_px[call.pixels].max()) for call in calls if flat_px[call.pixels].min() <= 1.5
    ]
    along = [reach_px for reach_px in reaches_px if reach_px <= RIM_PX]
    if len(along) < RIM_CALLS or filled.all():
        return np.zeros(judged.shape, bool)
    return (depth_px <= max(along)) & judged
