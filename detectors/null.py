"""The threshold that a capture sets itself: noise seen towards the camera tells how often noise looks like damage.

Damage lies behind the surface. What stands out before it is noise, fixed pattern or texture, once objects that lie on
the target are set aside. So the peaks towards the camera are a sample of the null for both sides. Their tail is
extrapolated to the threshold at which the wanted number of false calls is expected in the capture, bumps and hole-like
calls together.

The tail above a floor is exponential in (s^q - 1) / q of the score s. q = 2 is normal noise, 1 is Laplace's, 0 a power
law. The data weigh the exponents, starting from `PRIOR`; rates and scales are integrated out, so that the mean of the
expected number is right although few peaks are known.

Not modelled: noise that is not symmetric beyond what `skew_of` sees in the core, and damage that is itself towards the
camera and no larger than the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage, optimize

from detectors.interface import Detection, Detector, Evidence, FindsAtOnce
from harness.vocabulary.capture import Cloud

EXPONENTS = np.array([3.0, 2.0, 1.5, 1.0, 0.5, 0.0])
PRIOR = np.array([0.40, 0.45, 0.07, 0.04, 0.02, 0.02])
"""Averages of a camera's noise are near normal; peaks that merge at the floor make a tail look lighter (3). Chosen on
simulated hole-free boards of three cameras; 80 peaks of Student's t with 4 degrees of freedom find their power law in
spite of it."""
WANTED_PEAKS = 60
"""Peaks above the floor: their mean excess is then known to 13 %, and the floor is as high as it can be."""
FEWEST_PEAKS = 8
"""Below, the tail is anybody's guess: the mean excess is known to 35 %, and the threshold is twice as far away as the
floor."""
CROWDED = 0.6
"""Share of the most findings that any threshold gives: with more, neighbouring peaks have merged."""
LADDER = 1.06
"""Ratio of the thresholds that are tried for the floor."""
LEAST = 3.0
"""Units of score below which no threshold goes, whatever is expected there: errors that are bounded, as those of
rounded numbers without noise, end so near that a tail extrapolated from one side says nothing of the other."""
RARE = 0.01
"""Chance at which a peak is no longer taken for the largest of the noise's."""
OBJECT_AREA, PLATE_AREA = 4.0, 15.0
"""An object that lies on the target covers so many times the area of noise's peaks, or, flat and low, so many times
what a peak of its height covers."""
OBJECT_MARGIN_PX = 6
"""Around an object: its edge is mixed over 3 pixels, and its shadow lies beside it."""
MOST_MASKED = 0.3
"""Share of the judged area that objects may cover before what is left no longer stands for it."""
RIM_PX = 10
"""Reach of the target's rim into what was judged. Depth aligned to a finer camera mixes the farthest: 8 pixels."""
RIM_CALLS = 2
"""Calls behind the surface along the rim that chance does not give: where 1 is expected on the whole target, 2 fall on
a twentieth of it once in 800 captures."""
MOST_SKEW = 0.15
"""Of the quartiles' distances from the median, over their sum: 0.15 are 1.35 times as far to one side."""
DRAWS = 4000
"""Of rate and scale, for the interval."""


@dataclass(frozen=True)
class OwnThreshold:
    """``threshold`` in units of score, at which ``expected`` false calls (both signs) are expected in the capture, with
    the 95 % interval ``low`` to ``high``; ``peaks`` above ``floor`` towards the camera told it. ``evidence``: what is
    to be searched, without the ``rim_pixels`` that mix in what lies behind the target. ``doubts``: full sentences on
    why the numbers cannot be trusted."""

    threshold: float
    expected: float
    low: float
    high: float
    peaks: int
    floor: float
    objects: int
    rim_pixels: int
    evidence: Evidence
    doubts: tuple[str, ...]


def own_threshold(detector: Detector, cloud: Cloud, evidence: Evidence, false_calls: float) -> OwnThreshold:
    """The threshold at which ``false_calls`` (above 0) are expected in this capture, by its own peaks towards the
    camera, or `LEAST`, with fewer expected. With too few of them, threshold, expected number and interval are NaN, and
    ``doubts`` says so."""
    before = _only(evidence, ~behind(evidence))
    judged = int(np.isfinite(evidence.score).sum())
    before, floor, peaks, objects = _without_objects(detector, cloud, before)
    doubts = []
    skew = skew_of(evidence)
    if abs(skew) > MOST_SKEW:
        side = "behind" if skew > 0 else "before"
        doubts.append(
            f"the residual is not symmetric: its quartiles reach {(1 + abs(skew)) / (1 - abs(skew)):.1f} times as far"
            f" {side} the surface as to the other side"
        )
    if len(peaks) < FEWEST_PEAKS:
        doubts.append(
            f"only {len(peaks)} peaks of noise stand out towards the camera, too few to set a threshold by"
            f" ({FEWEST_PEAKS} at least)"
        )
        unknown = (float("nan"),) * 4
        return OwnThreshold(*unknown, len(peaks), floor, objects.count, 0, evidence, tuple(doubts))
    tail = Tail.of(peaks, floor)
    threshold = max(tail.threshold(false_calls / 2.0), LEAST)
    rim = _mixed_rim(detector, cloud, evidence, threshold) if cloud.organised else np.zeros(evidence.score.shape, bool)
    low, high = (2.0 * bound for bound in tail.interval(threshold))
    if objects.pixels > MOST_MASKED * judged:
        doubts.append(
            f"{100 * objects.pixels / judged:.0f} % of what is judged lies under or beside objects before the surface,"
            " and the rest may not stand for the whole"
        )
    return OwnThreshold(
        threshold=threshold,
        expected=2.0 * tail.expected(threshold),
        low=low,
        high=high,
        peaks=len(peaks),
        floor=floor,
        objects=objects.count,
        rim_pixels=int(rim.sum()),
        evidence=_only(evidence, ~rim),
        doubts=tuple(doubts),
    )


def behind(evidence: Evidence) -> np.ndarray:
    """(h, w) bool: pixels whose score speaks for something behind the surface."""
    if evidence.behind is not None:
        return evidence.behind
    with np.errstate(invalid="ignore"):
        return np.asarray(evidence.residual_m >= 0)


def skew_of(evidence: Evidence) -> float:
    """Bowley's skewness of the residual, -1 to 1: damage on less than a quarter of the target hardly moves it."""
    known = evidence.residual_m[np.isfinite(evidence.residual_m)]
    low, middle, high = np.quantile(known, (0.25, 0.5, 0.75))
    return float((high + low - 2 * middle) / max(high - low, 1e-12))


# ---- the tail --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tail:
    """Peaks above a floor. ``sums`` (e,): of their transformed excesses, by exponent; ``weights`` (e,): what the data
    leave of each exponent."""

    floor: float
    peaks: int
    sums: np.ndarray
    weights: np.ndarray

    @classmethod
    def of(cls, peaks: np.ndarray, floor: float) -> Tail:
        """From the scores (n,) of the peaks above a floor, which is above 0."""
        ratios = np.maximum(np.asarray(peaks, float) / floor, 1.0 + 1e-9)
        sums = np.array([_excess(ratios, exponent).sum() for exponent in EXPONENTS])
        # the likelihood with the scale integrated out under its invariant prior
        logs = (EXPONENTS - 1.0) * np.log(ratios).sum() - len(ratios) * np.log(sums) + np.log(PRIOR)
        weights = np.exp(logs - logs.max())
        return cls(floor, len(ratios), sums, weights / weights.sum())

    def expected(self, threshold: float) -> float:
        """Mean number of peaks above a threshold, over all rates and scales that the peaks allow."""
        ratio = np.array([threshold / self.floor])
        excesses = np.array([float(_excess(ratio, exponent)[0]) for exponent in EXPONENTS])
        return float((self.weights * self.peaks * (1.0 + excesses / self.sums) ** -self.peaks).sum())

    def threshold(self, number: float) -> float:
        """Where this many peaks are expected; the floor where fewer are expected there already."""
        if number >= self.peaks:
            return self.floor
        high = 2.0
        while self.expected(high * self.floor) > number:
            high *= 2.0
        log_ratio = optimize.brentq(
            lambda log: np.log(self.expected(float(np.exp(log)) * self.floor) / number), 0.0, np.log(high)
        )
        return float(np.exp(log_ratio)) * self.floor

    def interval(self, threshold: float) -> tuple[float, float]:
        """Central 95 % of the expected number of peaks above a threshold."""
        random = np.random.default_rng(20201102)
        chosen = random.choice(len(EXPONENTS), DRAWS, p=self.weights)
        ratio = np.array([threshold / self.floor])
        excesses = np.array([float(_excess(ratio, exponent)[0]) for exponent in EXPONENTS])
        per_scale = random.gamma(self.peaks, 1.0, DRAWS) * excesses[chosen] / self.sums[chosen]
        drawn = random.gamma(self.peaks, 1.0, DRAWS) * np.exp(-per_scale)
        low, high = np.quantile(drawn, (0.025, 0.975))
        return float(low), float(high)


def _excess(ratios: np.ndarray, exponent: float) -> np.ndarray:
    return np.log(ratios) if exponent == 0.0 else (ratios**exponent - 1.0) / exponent


# ---- peaks and objects -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Objects:
    count: int
    pixels: int


def _without_objects(
    detector: Detector, cloud: Cloud, before: Evidence
) -> tuple[Evidence, float, np.ndarray, _Objects]:
    """What is left before the surface when objects are set aside, the floor, the peaks' scores, and the objects."""
    start = int(np.isfinite(before.score).sum())
    objects = 0
    while True:
        floor, found = _peaks(detector, cloud, before)
        scores = np.array([each.score for each in found])
        foreign = _objects(found, floor) if len(found) >= FEWEST_PEAKS else []
        if not foreign:
            return before, floor, scores, _Objects(objects, start - int(np.isfinite(before.score).sum()))
        objects += len(foreign)
        covered = np.zeros(before.score.shape, bool)
        covered.reshape(-1)[np.concatenate([each.pixels for each in foreign])] = True
        if cloud.organised:
            covered = _grown(covered, OBJECT_MARGIN_PX)
        before = _only(before, ~covered)


def _peaks(detector: Detector, cloud: Cloud, evidence: Evidence) -> tuple[float, tuple[Detection, ...]]:
    """A floor with about `WANTED_PEAKS` findings above it, and they; a higher one where they would merge."""
    known = evidence.score[np.isfinite(evidence.score)]
    if not (len(known) and known.max() > 0):
        return 1.0, ()
    least = max(float(np.median(known)), 1e-3 * float(known.max()))
    thresholds = least * LADDER ** np.arange(np.log(known.max() / least) / np.log(LADDER) + 1)
    counts = _counts(detector, cloud, evidence, thresholds.tolist())
    crowd = int(counts.argmax())
    free = [n for n in range(crowd, len(counts)) if counts[n] <= CROWDED * counts[crowd]]
    enough = [n for n in free if counts[n] >= WANTED_PEAKS]
    floor = float(thresholds[enough[-1] if enough else free[0] if free else crowd])
    return floor, detector.find(cloud, evidence, floor)


def _counts(detector: Detector, cloud: Cloud, evidence: Evidence, thresholds: Sequence[float]) -> np.ndarray:
    """Numbers of findings at each threshold."""
    if isinstance(detector, FindsAtOnce):
        return np.array([len(centres) for centres in detector.centres_at(cloud, evidence, thresholds)])
    return np.array([len(detector.find(cloud, evidence, threshold)) for threshold in thresholds])


def _objects(found: Sequence[Detection], floor: float) -> list[Detection]:
    """Findings that are no noise: far too high or too flat for their area, by what the others are.

    A high peak of few pixels stays: it is what heavy tails look like.
    """
    scores = np.array([each.score for each in found])
    areas = np.array([len(each.pixels) for each in found], float)
    # near its summit a peak of noise is a paraboloid: its area grows with its height above the floor
    spread = areas / np.maximum(1.0 - floor / scores, 0.05)
    wide = areas > OBJECT_AREA * np.median(areas)
    flat = wide & (spread > PLATE_AREA * np.median(spread))
    # the lowest half is noise for certain; others are tried from the lowest up, against all below
    order = np.argsort(scores)
    foreign = [int(n) for n in np.flatnonzero(flat)]
    for place in range(max(len(order) // 2, FEWEST_PEAKS - 1), len(order)):
        below = Tail.of(scores[order[:place]], floor)
        if below.expected(scores[order[place]]) < RARE:
            foreign += [int(n) for n in order[place:] if wide[n]]
            break
    return [found[n] for n in sorted(set(foreign))]


# ---- the rim ---------------------------------------------------------------------------------------------------------


def _mixed_rim(detector: Detector, cloud: Cloud, evidence: Evidence, threshold: float) -> np.ndarray:
    """(h, w) bool: a band along the target's outline as deep as the calls behind the surface that touch it reach, where
    there are more of these than chance gives: pixels that mix in what lies behind the target."""
    none = np.zeros(evidence.score.shape, bool)
    known = np.isfinite(evidence.score)
    whole = ndimage.binary_fill_holes(known)
    # the image's own edge is no rim
    depth = ndimage.distance_transform_edt(np.pad(whole, 1, mode="edge"))[1:-1, 1:-1].reshape(-1)
    calls = detector.find(cloud, _only(evidence, behind(evidence)), threshold)
    along = [call for call in calls if depth[call.pixels].min() <= 1.5 and depth[call.pixels].max() <= RIM_PX]
    if len(along) < RIM_CALLS or (~whole).sum() == 0:
        return none
    reach = max(float(depth[call.pixels].max()) for call in along)
    return np.asarray((depth.reshape(none.shape) <= reach) & known)


def _only(evidence: Evidence, where: np.ndarray) -> Evidence:
    """The evidence with an opinion only ``where`` (h, w)."""
    return replace(evidence, score=np.where(where, evidence.score, np.nan))


def _grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc) > 0)
