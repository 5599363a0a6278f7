"""The threshold that a capture determines itself: noise towards the camera shows how often noise
looks like damage.

Damage lies behind the surface. Peaks in front of the surface are noise, fixed pattern or texture,
after objects on the target (regions that stand before the surface as a whole; edges in the colour
picture or the amplitude) and a margin are excluded. The tail of these peaks is extrapolated to the
threshold at which the wanted number of false calls is expected, bumps and hole-like calls
together. The tail is exponential in (s^q - 1) / q of the score s, minus the logarithm by which
maxima of normal noise in two dimensions are more frequent. The data weigh the exponents q,
starting from `PRIOR`; rates and scales are integrated out.

Beside objects, print and edges false calls are more frequent, on both sides of the surface. The
peaks in front of it there have a tail of their own, which predicts how many more calls that
threshold lets pass. A small mark in the picture that lies within a finding is the finding itself.

Where light from the target's edge mixes in, peaks along its rim are higher. If the peaks elsewhere
do not explain those at the rim, these have a law of their own too, and scores at the rim are
scaled down so that one threshold holds for both.

Not modelled: noise that is asymmetric beyond what `skew_of` sees in the core; damage towards the
camera that is no larger than the noise; objects on clouds without a grid, or that neither stand
out nor are visible in a picture."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from scipy import ndimage, special

from detectors.findings.measure import extents
from detectors.interface import Detection, Detector, Evidence
from detectors.levels import findings_at
from detectors.pixels.masks import grown, holes_filled, parts_with
from harness.vocabulary.geometry import Cloud

# --- the tail ---

EXPONENTS = np.array([3.0, 2.0, 1.5, 1.0, 0.5, 0.0])
PRIOR = np.array([0.40, 0.45, 0.07, 0.04, 0.02, 0.02])
"""Prior weights of exponents: averages of a camera's noise are near normal. From simulated boards
of three cameras."""
NORMAL_PEAKS = 10.0
"""Weight of the theory, in peaks: maxima of normal noise with the deviation that a unit of score
is meant to be. Ten peaks show that deviation to 16 %; robust scales of heavy-tailed noise err by
as much."""
THEORY_AT_MARKS = 1.0
"""The same at marks: what print and edges make of the distance is no normal noise."""
DRAWS = 4000  # of the interval
TAIL_SHARE = 0.025  # probability of fewer false calls than its lower end; as much lies above
HALVINGS = 48  # of the interval that holds a threshold: to rounding error
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

# --- objects on the target, and its rim ---

OBJECT_MARGIN_PX = 6
"""Margin around an object: its edge is mixed over 3 pixels, and its shadow lies beside it."""
PATCH_PX = 5  # side of the square that smooths residual and picture
LEAST_OBJECT_PX = 100  # least pixels of an object: four such squares
PROUD = 6.0
"""Smoothed residual in front of the surface at an object's highest point, in deviations."""
PROUD_FOOT = 3.0  # the same everywhere on it
MARKED = 8.0
"""Slope of an edge in the picture, in multiples of the median slope: a tag, print, another
material."""
MOST_MASKED = 0.5
"""Largest share of the judged area under objects: the rest must represent the whole."""
LONGEST_HOLE_PX = 35
"""A longer mark is more than a hole as the picture shows it: the widest filters judge 25 pixels,
and the squares that smooth the picture twice widen its edges by 10."""
OWN_SHARE = 0.5
"""A longer mark is still the finding itself if this share of it lies within the finding and its
margin."""
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


def calls_at(tails: Mapping[str, Tail], threshold: float) -> float:
    """Return the number of false calls that all laws together expect above a threshold, on both
    sides of the surface."""
    return 2.0 * sum(tail.expected(threshold) for tail in tails.values())


def threshold_at(tails: Mapping[str, Tail], calls: float, least: float) -> float:
    """Return the threshold, at least ``least``, above which all laws together expect so many false
    calls (above 0), on both sides of the surface."""
    if calls_at(tails, least) <= calls:
        return least
    return _falls_to(calls, lambda threshold: calls_at(tails, threshold), least)


def _falls_to(number: float, expected: Callable[[float], float], least: float) -> float:
    """Return the threshold above ``least`` (above 0) at which a falling expectation is this
    number."""
    low = least
    high = 2.0 * least
    while expected(high) > number:
        low = high
        high *= 2.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if expected(middle) > number:
            low = middle
        else:
            high = middle
    return low


def counts_of(tails: Mapping[str, Tail], threshold: float) -> tuple[float, float]:
    """Return the fewest and the most false calls of the central 95 % of their number above a
    threshold, on both sides of the surface and by all laws together.

    The number is Poisson, with the expectation of each of `DRAWS` laws that the peaks allow. So it
    contains that the law is uncertain and that calls come by chance."""
    expected = np.zeros(DRAWS)
    for tail in tails.values():
        expected += 2.0 * tail.laws(DRAWS).expected(threshold)
    return _count_reaching(TAIL_SHARE, expected), _count_reaching(1.0 - TAIL_SHARE, expected)


def _count_reaching(share: float, expected: np.ndarray) -> float:
    """Return the smallest count that a Poisson number, with one of equally likely expectations
    (k,), does not exceed with a probability of at least ``share``."""
    low = -1
    high = 1
    while special.pdtr(high, expected).mean() < share:
        low = high
        high *= 2
    while high - low > 1:
        middle = (low + high) // 2
        if special.pdtr(middle, expected).mean() < share:
            low = middle
        else:
            high = middle
    return float(high)


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
    return _depth_px(holes_filled(judged)) <= RIM_PX


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
    depth_px = _depth_px(holes_filled(np.isfinite(evidence.residual_m)))
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


# --- the tail of the peaks ---


@dataclass(frozen=True)
class Laws:
    """Laws that the peaks allow, drawn at random, each with one exponent."""

    floor: float
    """Units of score."""
    exponents: np.ndarray
    """(k,)."""
    numbers: np.ndarray
    """(k,): expected number of calls above the floor."""
    rates: np.ndarray
    """(k,): by which the logarithm of the number falls with the excess."""
    scale: float
    """Scores in the evidence over those of the law."""

    def expected(self, threshold: float) -> np.ndarray:
        """Return the expected number (k,) of calls above a threshold."""
        ratio = np.array([threshold / (self.scale * self.floor)])
        excesses = np.zeros(len(self.numbers))
        for exponent in EXPONENTS:
            excesses[self.exponents == exponent] = _excess(ratio, exponent, self.floor)[0]
        return self.numbers * np.exp(-self.rates * excesses)

    def densities(self, scores: np.ndarray) -> np.ndarray:
        """Return the expected number (k, n) of calls per unit of score, at scores (n,) above the
        floor."""
        floor = self.scale * self.floor
        ratios = scores / floor
        falls = np.zeros((len(self.numbers), len(scores)))
        for exponent in EXPONENTS:
            excess = _excess(ratios, exponent, self.floor)
            slope = self.floor * (ratios ** (exponent - 1.0) - _crowd(self.floor) / ratios)
            chosen = self.exponents == exponent
            rates = self.rates[chosen, None]
            falls[chosen] = rates * slope / self.scale * np.exp(-rates * excess)
        return self.numbers[:, None] * falls


@dataclass(frozen=True)
class Tail:
    """The law by which noise exceeds a threshold, from its peaks above a floor."""

    floor: float
    """Units of score."""
    peaks: int
    """Number of peaks above it."""
    sums: np.ndarray
    """(e,): for each exponent, the sum of the peaks' transformed excesses, and the theory's."""
    weights: np.ndarray
    """(e,): of the exponents, which sum to 1."""
    theory: float = NORMAL_PEAKS
    """Weight of the theory of normal noise, in peaks."""
    area_ratio: float = 1.0
    """Area where calls are expected, over the area of the peaks."""
    scale: float = 1.0
    """Scores in the evidence over those of the peaks."""

    @property
    def number(self) -> float:
        """Expected number of calls above the floor; that of half a peak if there is none."""
        return max(self.peaks, 0.5) * self.area_ratio

    @property
    def facts(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "floor": self.floor,
            "peaks": self.peaks,
            "sums": self.sums.tolist(),
            "weights": self.weights.tolist(),
            "theory": self.theory,
            "area_ratio": self.area_ratio,
            "scale": self.scale,
        }

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any]) -> Tail:
        """Return the tail with these `facts`."""
        return cls(
            floor=facts["floor"],
            peaks=facts["peaks"],
            sums=np.array(facts["sums"]),
            weights=np.array(facts["weights"]),
            theory=facts["theory"],
            area_ratio=facts["area_ratio"],
            scale=facts["scale"],
        )

    @classmethod
    def of(cls, peaks: np.ndarray, floor: float, theory: float = NORMAL_PEAKS) -> Tail:
        """Weigh the exponents by the scores (n,) of the peaks above a floor, which is positive."""
        ratios = np.maximum(np.asarray(peaks, float) / floor, 1.0 + 1e-9)
        count = len(ratios)
        excesses = [_excess(ratios, exponent, floor).sum() for exponent in EXPONENTS]
        sums = theory + np.array(excesses)
        # the likelihood with the scale integrated out under its prior, a Gamma distribution
        slopes = ratios[:, None] ** (EXPONENTS - 1.0) - _crowd(floor) / ratios[:, None]
        log_slopes = np.log(slopes).sum(axis=0)
        log_likelihoods = log_slopes - (count + theory) * np.log(sums)
        log_weights = log_likelihoods + np.log(PRIOR)
        weights = np.exp(log_weights - log_weights.max())
        weights = weights / weights.sum()
        return cls(floor, count, sums, weights, theory)

    def _excesses(self, threshold: float) -> np.ndarray:
        """Return the excess (e,) of a threshold by each exponent."""
        ratio = np.array([threshold / (self.scale * self.floor)])
        return np.array([float(_excess(ratio, exponent, self.floor)[0]) for exponent in EXPONENTS])

    def expected(self, threshold: float) -> float:
        """Return the mean number of peaks above a threshold, over all rates and scales that the
        peaks allow."""
        beyond = 1.0 + self._excesses(threshold) / self.sums
        shares = beyond ** -(self.peaks + self.theory)
        return float((self.weights * self.number * shares).sum())

    def threshold(self, number: float) -> float:
        """Return the threshold at which this number of peaks is expected; the floor if fewer are
        expected there."""
        floor = self.scale * self.floor
        if number >= self.number:
            return floor

        return _falls_to(number, self.expected, floor)

    def laws(self, count: int) -> Laws:
        """Draw ``count`` laws that the peaks allow, the same ones every time."""
        random = np.random.default_rng(20201102)
        chosen = random.choice(len(EXPONENTS), count, p=self.weights)
        steepness = random.gamma(self.peaks + self.theory, 1.0, count)
        numbers = self.area_ratio * random.gamma(max(self.peaks, 0.5), 1.0, count)
        return Laws(
            floor=self.floor,
            exponents=EXPONENTS[chosen],
            numbers=numbers,
            rates=steepness / self.sums[chosen],
            scale=self.scale,
        )


def _excess(
    ratios: np.ndarray,
    exponent: float,
    floor: float,
) -> np.ndarray:
    """Return how far scores, as ratios (n,) to the floor, lie above it, in factors of e by which
    peaks become fewer.

    The exponent 2 is that of normal noise, whose maxima in two dimensions fall as s exp(-s^2 / 2)
    (Adler 1981)."""
    power = np.log(ratios) if exponent == 0.0 else (ratios**exponent - 1.0) / exponent
    return floor**2 * (power - _crowd(floor) * np.log(ratios))


def _crowd(floor: float) -> float:
    """Return the logarithmic part of the excess; at most half of it for low floors, where that law
    does not hold."""
    return min(floor**-2.0, 0.5)


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


# --- objects on the target, print and edges ---


@dataclass(frozen=True)
class Marks:
    """Objects, print and edges in the picture, where false calls are more frequent."""

    proud: np.ndarray
    """(h, w) bool: objects that stand before the surface."""
    covered: np.ndarray
    """(h, w) bool: objects and edges of the picture, with their margin."""
    labels: np.ndarray
    """(h, w): number of the object or edge that is longer than a hole, without margin; 0 elsewhere.
    """
    areas: np.ndarray
    """(n + 1,): number of pixels with each number."""
    margin_px: int
    """Distance in pixels up to which a finding is at a mark."""

    @property
    def count(self) -> int:
        """Number of long marks."""
        return len(self.areas) - 1

    @cached_property
    def regions(self) -> int:
        """Number of connected regions that are covered."""
        return int(ndimage.label(self.covered)[1])

    @cached_property
    def beside_long(self) -> np.ndarray:
        """(h, w) bool: long marks, with their margin."""
        return grown(self.labels > 0, self.margin_px, cv2.MORPH_ELLIPSE)

    def hold(self, detection: Detection) -> bool:
        """Return whether a finding is at a long mark, most of which lies beyond the finding."""
        if not self.count:
            return False
        height, width = self.labels.shape
        rows, columns = np.unravel_index(detection.pixels, self.labels.shape)
        margin = self.margin_px
        top = max(int(rows.min()) - margin, 0)
        left = max(int(columns.min()) - margin, 0)
        bottom = min(int(rows.max()) + margin + 1, height)
        right = min(int(columns.max()) + margin + 1, width)
        inside = np.zeros((bottom - top, right - left), bool)
        inside[rows - top, columns - left] = True
        labels_nearby = self.labels[top:bottom, left:right][
            grown(inside, margin, cv2.MORPH_ELLIPSE)
        ]
        counts = np.bincount(labels_nearby, minlength=len(self.areas))[1:]
        return bool(((counts > 0) & (counts < OWN_SHARE * self.areas[1:])).any())


def marks_of(cloud: Cloud, evidence: Evidence) -> Marks:
    """Return the objects, print and edges of a cloud; none without a pixel grid.

    A cloud keeps them by the pixels that are judged and by their residuals, which detectors
    share."""
    digest = hashlib.blake2b(np.isfinite(evidence.score).tobytes())
    digest.update(evidence.residual_m.tobytes())
    key = digest.digest()
    if key not in cloud.marks:
        cloud.marks[key] = _marks(cloud, evidence)
    return cloud.marks[key]


def _marks(cloud: Cloud, evidence: Evidence) -> Marks:
    """Find the `marks_of` a cloud."""
    shape = evidence.score.shape
    nowhere = np.zeros(shape, bool)
    margin_px = _margin(cloud)
    if not cloud.organised:
        labels = np.zeros(shape, np.int32)
        return Marks(nowhere, nowhere, labels, np.array([nowhere.size]), margin_px)
    proud = _proud(cloud, evidence)
    objects = proud | _marked(cloud, evidence)
    covered = grown(objects, margin_px, cv2.MORPH_ELLIPSE)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(objects.astype(np.uint8))
    longer = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
    is_long = longer > LONGEST_HOLE_PX
    is_long[0] = False
    number = np.cumsum(is_long) * is_long
    labels = number[labels]
    areas = np.bincount(labels.ravel(), minlength=int(is_long.sum()) + 1)
    return Marks(proud, covered, labels, areas, margin_px)


def each_object_once(
    cloud: Cloud,
    evidence: Evidence,
    found: tuple[Detection, ...],
) -> tuple[Detection, ...]:
    """Return the findings, strongest first, with each object on the target as one finding:
    findings that reach its margin and are weaker belong to it.

    An object with a single finding keeps it. Nothing is joined without a pixel grid, or if objects
    would cover more than `MOST_MASKED`."""
    if not cloud.organised or not found:
        return found
    proud = _proud(cloud, evidence)
    judged = np.isfinite(evidence.score)
    if (proud & judged).sum() > MOST_MASKED * judged.sum():
        return found
    labels, count = ndimage.label(proud, np.ones((3, 3)))
    kept = list(found)
    for number in range(1, count + 1):
        region = labels == number
        flat = region.ravel()
        margin = grown(region, _margin(cloud), cv2.MORPH_ELLIPSE).ravel()
        scores = [detection.score for detection in kept if flat[detection.pixels].any()]
        height = max(scores, default=0.0)
        separate = [
            detection
            for detection in kept
            if detection.score > height or not margin[detection.pixels].any()
        ]
        if len(kept) - len(separate) >= 2:
            pixels = np.flatnonzero(region & cloud.valid)
            centre_m = extents(cloud.points_m.reshape(-1, 3)[pixels])[1]
            kept = [*separate, Detection(height, pixels, centre_m, "object")]
    return tuple(sorted(kept, key=lambda detection: -detection.score))


def _margin(cloud: Cloud) -> int:
    """Return the margin around objects in pixels: the reach of noise blurs them farther."""
    return OBJECT_MARGIN_PX + int(np.ceil(cloud.noise_reach_px / 2))


def _proud(cloud: Cloud, evidence: Evidence) -> np.ndarray:
    """Return (h, w) bool: connected regions, wider than noise, that are in front of the surface as
    a whole."""
    judged = np.isfinite(evidence.residual_m)
    weights = _boxed(judged.astype(np.float64))
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = _boxed(np.where(judged, evidence.residual_m, 0.0)) / weights
    smooth[~judged | (weights < 0.5)] = np.nan
    if not np.isfinite(smooth).any():
        return np.zeros_like(judged)
    before = np.nanmedian(smooth) - smooth
    spread = 1.4826 * np.nanmedian(np.abs(before))
    before /= max(spread, cloud.z_step_m / PATCH_PX, 1e-9)
    return parts_with(before > PROUD_FOOT, before > PROUD, least=LEAST_OBJECT_PX)


def _marked(cloud: Cloud, evidence: Evidence) -> np.ndarray:
    """Return (h, w) bool: long steep edges of the colour picture or the amplitude."""
    inside = _depth_px(holes_filled(np.isfinite(evidence.score))) > 2 * PATCH_PX
    edges = np.zeros(cloud.valid.shape, bool)
    channels: list[np.ndarray] = []
    if cloud.rgb is not None:
        channels += list(np.moveaxis(np.asarray(cloud.rgb, np.float64), -1, 0))
    if cloud.amplitude is not None:
        channels.append(cloud.amplitude)
    for channel in channels:
        judged = np.isfinite(channel) & inside
        if not judged.any():
            continue
        filled = np.where(np.isfinite(channel), channel, np.median(channel[judged]))
        steepness = np.hypot(*np.gradient(_boxed(_boxed(filled))))
        typical = max(float(np.median(steepness[judged])), 1e-9)
        edges |= judged & (steepness > MARKED * typical)
    return parts_with(edges, edges, least=LEAST_OBJECT_PX)


def _boxed(image: np.ndarray) -> np.ndarray:
    return cv2.blur(image, (PATCH_PX, PATCH_PX), borderType=cv2.BORDER_REFLECT)


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
    depth_px = _depth_px(filled)
    flat_px = depth_px.reshape(-1)
    calls = detector.find(cloud, _only(evidence, behind(evidence)), threshold)
    reaches_px = [
        float(flat_px[call.pixels].max()) for call in calls if flat_px[call.pixels].min() <= 1.5
    ]
    along = [reach_px for reach_px in reaches_px if reach_px <= RIM_PX]
    if len(along) < RIM_CALLS or filled.all():
        return np.zeros(judged.shape, bool)
    return (depth_px <= max(along)) & judged


def _depth_px(mask: np.ndarray) -> np.ndarray:
    """Return the distance (h, w) of each pixel of a mask to its rim; the image's own edge does not
    count as a rim."""
    return ndimage.distance_transform_edt(np.pad(mask, 1, mode="edge"))[1:-1, 1:-1]
