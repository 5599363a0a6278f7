"""The threshold that a capture determines itself: noise towards the camera shows how often noise
looks like damage.

Damage lies behind the surface. Peaks in front of the surface are noise, fixed pattern or texture,
after objects on the target (regions that stand before the surface as a whole; edges in the colour
picture or the amplitude) and a margin are excluded. The tail of these peaks is extrapolated to the
threshold at which the wanted number of false calls is expected, bumps and hole-like calls
together. The tail is exponential in (s^q - 1) / q of the score s, minus the logarithm by which
maxima of normal noise in two dimensions are more frequent. The data weigh the exponents, starting
from `PRIOR`; rates and scales are integrated out.

Not modelled: noise that is asymmetric beyond what `skew_of` sees in the core; damage towards the
camera that is no larger than the noise; objects on clouds without a grid, or that neither stand
out nor are visible in a picture."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage, optimize, special

from detectors.findings.measure import extents
from detectors.interface import Detection, Detector, Evidence
from detectors.masks import grown, holes_filled, parts_with
from harness.vocabulary.geometry import Cloud

EXPONENTS = np.array([3.0, 2.0, 1.5, 1.0, 0.5, 0.0])
PRIOR = np.array([0.40, 0.45, 0.07, 0.04, 0.02, 0.02])
"""Prior weights of exponents: averages of a camera's noise are near normal. From simulated boards
of three cameras."""
WANTED_PEAKS = 60
FEWEST_PEAKS = 8
"""Numbers of peaks above the floor: the mean excess of 60 is known to 13 %, that of the fewest to
35 %."""
NORMAL_PEAKS = 10.0
"""Weight of the theory, in peaks: maxima of normal noise with the deviation that a unit of score
is meant to be. Ten peaks show that deviation to 16 %; robust scales of heavy-tailed noise err by
as much."""
CROWDED = 0.6
LADDER = 1.06
"""Share of the largest number of findings at any threshold, and the ratio of thresholds tried for
the floor."""
# lowest threshold in units of score: bounded errors end so near that peaks in front predict
# nothing behind
LEAST = 3.0
MOST = 10.0
"""Thresholds above this are seldom due to noise alone, which needs 4 to 7 on all recordings.
Averages of 50 simulated frames of an L515 need up to 13 on hole-free boards, probably because of
the pattern that all frames share."""
OBJECT_MARGIN_PX = (
    6  # margin around an object: its edge is mixed over 3 pixels, and its shadow lies beside it
)
PATCH_PX = 5
LEAST_OBJECT_PX = 100
"""Side of the square that smooths residual and picture, and least pixels of an object: four such
squares."""
PROUD = 6.0
PROUD_FOOT = 3.0
"""Smoothed residual of an object in front of the surface, in deviations: at its highest point, and
everywhere on it."""
# slope of an edge in the picture, in multiples of the median slope: a tag, print, another material
MARKED = 8.0
MOST_MASKED = (
    0.5  # largest share of the judged area under objects: the rest must represent the whole
)
RIM_PX = 10
RIM_CALLS = 2
"""Depth of the target's rim, and number of calls behind the surface along it that chance does not
explain."""
CONTRADICTED = (
    # a tail is rejected if the probability of the number of peaks above the threshold is lower
    0.1
)
MOST_SKEW = 0.15
"""Difference of the quartiles' distances from the median, over their sum: 0.15 means 1.35 times as
far on one side."""
DRAWS = 4000


@dataclass(frozen=True)
class OwnThreshold:
    """``threshold``: in units of score, at which ``expected`` false calls are expected, with the
    95 % interval ``low`` to ``high``. It is based on ``peaks`` above ``floor``. ``evidence``: what
    to search, without the ``rim_pixels`` that mix in what lies behind the target. ``doubts``: full
    sentences on why the numbers cannot be trusted."""

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


def own_threshold(
    detector: Detector, cloud: Cloud, evidence: Evidence, false_calls: float
) -> OwnThreshold:
    """Find the threshold at which ``false_calls`` (above 0) are expected, from the capture's own
    peaks towards the camera; at least `LEAST`. With too few peaks the numbers are NaN, and
    ``doubts`` says so."""
    known = np.isfinite(evidence.score)
    covered = np.zeros(known.shape, bool)
    if cloud.organised:
        covered = grown(
            _proud(cloud, evidence) | _marked(cloud, evidence), _margin(cloud), cv2.MORPH_ELLIPSE
        )
    floor, peaks = _peaks(detector, cloud, _only(evidence, ~behind(evidence)), covered)
    objects = int(ndimage.label(covered)[1])
    doubts = []
    skew = skew_of(evidence)
    if abs(skew) > MOST_SKEW:
        farther = f"{(1 + abs(skew)) / (1 - abs(skew)):.1f} times as far {'behind' if skew > 0 else 'before'}"
        doubts.append(
            f"the residual is not symmetric: its quartiles reach {farther} the surface as to the other side"
        )
    if len(peaks) < FEWEST_PEAKS:
        few = f"only {len(peaks)} peaks of noise stand out towards the camera, too few to set a threshold"
        doubts.append(f"{few} (at least {FEWEST_PEAKS} are needed)")
        return OwnThreshold(
            *(float("nan"),) * 4, len(peaks), floor, objects, 0, evidence, tuple(doubts)
        )
    # Take all peaks, then the higher half, and so on while too many exceed the threshold: a few
    # wide waves of a fixed pattern are then higher than the noise of many pixels, and one tail
    # does not fit both.
    falling = np.sort(peaks)[::-1]
    number = false_calls / 2.0
    while True:
        tail = Tail.of(falling, floor)
        half = len(falling) // 2
        seen = int((falling > tail.threshold(number)).sum())
        if half < FEWEST_PEAKS or special.gammainc(seen, number) > CONTRADICTED:
            break
        falling, floor = falling[:half], float(falling[half])
    threshold = max(tail.threshold(number), LEAST)
    rim = (
        _mixed_rim(detector, cloud, evidence, threshold)
        if cloud.organised
        else np.zeros(known.shape, bool)
    )
    if threshold > MOST:
        why = "bumps or structure of the surface, the camera's fixed pattern, or noise with heavy tails, raise it above"
        doubts.append(
            f"{why} {MOST:g} units of score, and fainter damage is not found (--threshold states another)"
        )
    low, high = (2.0 * bound for bound in tail.interval(threshold))
    hidden = int((covered & known).sum())
    if hidden > MOST_MASKED * known.sum():
        share = f"{100 * hidden / known.sum():.0f} % of what is judged"
        doubts.append(
            f"{share} lies under or beside objects, and the rest may not stand for the whole"
        )
    expected = 2.0 * tail.expected(threshold)
    searched = _only(evidence, ~rim)
    counts = (tail.peaks, tail.floor, objects, int(rim.sum()))
    return OwnThreshold(threshold, expected, low, high, *counts, searched, tuple(doubts))


def each_object_once(
    cloud: Cloud, evidence: Evidence, found: tuple[Detection, ...]
) -> tuple[Detection, ...]:
    """Return the findings, strongest first, with each object on the target as one finding:
    findings that reach its margin and are weaker belong to it. An object with a single finding
    keeps it. Nothing is joined without a pixel grid, or if objects would cover more than
    `MOST_MASKED`."""
    if not cloud.organised or not found:
        return found
    proud = _proud(cloud, evidence)
    known = np.isfinite(evidence.score)
    if (proud & known).sum() > MOST_MASKED * known.sum():
        return found
    labels, count = ndimage.label(proud, np.ones((3, 3)))
    kept = list(found)
    for number in range(1, count + 1):
        region = labels == number
        near = grown(region, _margin(cloud), cv2.MORPH_ELLIPSE).ravel()
        height = max(
            (each.score for each in kept if region.ravel()[each.pixels].any()), default=0.0
        )
        rest = [each for each in kept if each.score > height or not near[each.pixels].any()]
        if len(kept) - len(rest) >= 2:
            pixels = np.flatnonzero(region & cloud.valid)
            centre_m = extents(cloud.points_m.reshape(-1, 3)[pixels])[1]
            kept = [*rest, Detection(height, pixels, centre_m, "object")]
    return tuple(sorted(kept, key=lambda each: -each.score))


def _margin(cloud: Cloud) -> int:
    return OBJECT_MARGIN_PX + int(np.ceil(cloud.noise_reach_px / 2))


def behind(evidence: Evidence) -> np.ndarray:
    """Return (h, w) bool: pixels whose score indicates something behind the surface."""
    if evidence.behind is not None:
        return evidence.behind
    with np.errstate(invalid="ignore"):
        return np.asarray(evidence.residual_m >= 0)


def skew_of(evidence: Evidence) -> float:
    """Return Bowley's skewness of the residual, -1 to 1; damage on less than a quarter hardly
    changes it."""
    low, middle, high = np.quantile(
        evidence.residual_m[np.isfinite(evidence.residual_m)], (0.25, 0.5, 0.75)
    )
    return float((high + low - 2 * middle) / max(high - low, 1e-12))


@dataclass(frozen=True)
class Tail:
    """Peaks above a floor: ``sums`` (e,) of their transformed excesses, ``weights`` (e,) of the
    exponents."""

    floor: float
    peaks: int
    sums: np.ndarray
    weights: np.ndarray

    @classmethod
    def of(cls, peaks: np.ndarray, floor: float) -> Tail:
        """Weigh the exponents by the scores (n,) of the peaks above a floor, which is positive."""
        ratios = np.maximum(np.asarray(peaks, float) / floor, 1.0 + 1e-9)
        excesses = [_excess(ratios, exponent, floor) for exponent in EXPONENTS]
        sums = NORMAL_PEAKS + np.array([each.sum() for each in excesses])
        # the likelihood with the scale integrated out under its prior, a Gamma distribution
        steep = np.log(ratios[:, None] ** (EXPONENTS - 1.0) - _crowd(floor) / ratios[:, None]).sum(
            axis=0
        )
        logs = steep - (len(ratios) + NORMAL_PEAKS) * np.log(sums) + np.log(PRIOR)
        weights = np.exp(logs - logs.max())
        return cls(floor, len(ratios), sums, weights / weights.sum())

    def _excesses(self, threshold: float) -> np.ndarray:
        ratio = np.array([threshold / self.floor])
        return np.array([float(_excess(ratio, exponent, self.floor)[0]) for exponent in EXPONENTS])

    def expected(self, threshold: float) -> float:
        """Return the mean number of peaks above a threshold, over all rates and scales that the
        peaks allow."""
        excesses = self._excesses(threshold)
        return float(
            (
                self.weights
                * self.peaks
                * (1.0 + excesses / self.sums) ** -(self.peaks + NORMAL_PEAKS)
            ).sum()
        )

    def threshold(self, number: float) -> float:
        """Return the threshold at which this number of peaks is expected; the floor if fewer are
        expected there."""
        if number >= self.peaks:
            return self.floor

        def excess(log_ratio: float) -> float:
            return float(np.log(self.expected(float(np.exp(log_ratio)) * self.floor) / number))

        high = 2.0
        while self.expected(high * self.floor) > number:
            high *= 2.0
        return float(np.exp(optimize.brentq(excess, 0.0, np.log(high)))) * self.floor

    def interval(self, threshold: float) -> tuple[float, float]:
        """Return the central 95 % of the expected number of peaks above a threshold."""
        random = np.random.default_rng(20201102)
        chosen = random.choice(len(EXPONENTS), DRAWS, p=self.weights)
        excesses = self._excesses(threshold)
        per_scale = (
            random.gamma(self.peaks + NORMAL_PEAKS, 1.0, DRAWS)
            * excesses[chosen]
            / self.sums[chosen]
        )
        drawn = random.gamma(self.peaks, 1.0, DRAWS) * np.exp(-per_scale)
        low, high = np.quantile(drawn, (0.025, 0.975))
        return float(low), float(high)


def _excess(ratios: np.ndarray, exponent: float, floor: float) -> np.ndarray:
    """Return how far scores, as ratios (n,) to the floor, lie above it, in factors of e by which
    peaks become fewer. The exponent 2 is that of normal noise, whose maxima in two dimensions fall
    as s exp(-s^2 / 2) (Adler 1981)."""
    power = np.log(ratios) if exponent == 0.0 else (ratios**exponent - 1.0) / exponent
    return np.asarray(floor**2 * (power - _crowd(floor) * np.log(ratios)))


def _crowd(floor: float) -> float:
    """Return the logarithmic part of the excess; at most half of it for low floors, where that law
    does not hold."""
    return min(floor**-2.0, 0.5)


def _proud(cloud: Cloud, evidence: Evidence) -> np.ndarray:
    """Return (h, w) bool: connected regions, wider than noise, that are in front of the surface as
    a whole."""
    known = np.isfinite(evidence.residual_m)
    weights = _boxed(known.astype(np.float64))
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = _boxed(np.where(known, evidence.residual_m, 0.0)) / weights
    smooth[~known | (weights < 0.5)] = np.nan
    if not np.isfinite(smooth).any():
        return np.zeros_like(known)
    before = np.nanmedian(smooth) - smooth
    before /= max(1.4826 * np.nanmedian(np.abs(before)), cloud.z_step_m / PATCH_PX, 1e-9)
    return parts_with(before > PROUD_FOOT, before > PROUD, least=LEAST_OBJECT_PX)


def _marked(cloud: Cloud, evidence: Evidence) -> np.ndarray:
    """Return (h, w) bool: long steep edges of the colour picture or the amplitude."""
    inside = _depth_px(holes_filled(np.isfinite(evidence.score))) > 2 * PATCH_PX
    edges = np.zeros(cloud.valid.shape, bool)
    channels = (
        [] if cloud.rgb is None else list(np.moveaxis(np.asarray(cloud.rgb, np.float64), -1, 0))
    )
    for channel in channels + ([] if cloud.amplitude is None else [cloud.amplitude]):
        known = np.isfinite(channel) & inside
        if not known.any():
            continue
        smooth = _boxed(_boxed(np.where(np.isfinite(channel), channel, np.median(channel[known]))))
        steep = np.hypot(*np.gradient(smooth))
        edges |= known & (steep > MARKED * max(float(np.median(steep[known])), 1e-9))
    return parts_with(edges, edges, least=LEAST_OBJECT_PX)


def _boxed(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.blur(image, (PATCH_PX, PATCH_PX), borderType=cv2.BORDER_REFLECT))


def _depth_px(whole: np.ndarray) -> np.ndarray:
    """Return the distance (h, w) of each pixel of a mask to its rim; the image's own edge does not
    count as a rim."""
    return np.asarray(ndimage.distance_transform_edt(np.pad(whole, 1, mode="edge"))[1:-1, 1:-1])


def _peaks(
    detector: Detector, cloud: Cloud, before: Evidence, covered: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return a floor with about `WANTED_PEAKS` findings above it, and their scores."""
    evidence = _only(before, ~covered)
    known = evidence.score[np.isfinite(evidence.score)]
    if not (len(known) and known.max() > 0):
        return 1.0, np.zeros(0)
    least = max(float(np.median(known)), 1e-3 * float(known.max()))
    thresholds = least * LADDER ** np.arange(np.log(known.max() / least) / np.log(LADDER) + 1)
    counts = np.array(
        [len(detector.find(cloud, evidence, threshold)) for threshold in thresholds.tolist()]
    )
    crowd = int(counts.argmax())
    free = [n for n in range(crowd, len(counts)) if counts[n] <= CROWDED * counts[crowd]]
    enough = [n for n in free if counts[n] >= WANTED_PEAKS]
    floor = float(thresholds[enough[-1] if enough else free[0] if free else crowd])
    hidden = covered.reshape(-1)
    peaks = [
        each.score for each in detector.find(cloud, before, floor) if not hidden[each.pixels].any()
    ]
    return floor, np.array(peaks)


def _mixed_rim(
    detector: Detector, cloud: Cloud, evidence: Evidence, threshold: float
) -> np.ndarray:
    """Return (h, w) bool: a band along the outline, as wide as the zone of frequent calls behind
    the surface."""
    known = np.isfinite(evidence.score)
    whole = holes_filled(known)
    depth = _depth_px(whole).reshape(-1)
    calls = detector.find(cloud, _only(evidence, behind(evidence)), threshold)
    along = [
        call
        for call in calls
        if depth[call.pixels].min() <= 1.5 and depth[call.pixels].max() <= RIM_PX
    ]
    if len(along) < RIM_CALLS or (~whole).sum() == 0:
        return np.zeros(known.shape, bool)
    reach = max(float(depth[call.pixels].max()) for call in along)
    return np.asarray((depth.reshape(known.shape) <= reach) & known)


def _only(evidence: Evidence, where: np.ndarray) -> Evidence:
    """Return the evidence with scores only ``where`` (h, w)."""
    return replace(evidence, score=np.where(where, evidence.score, np.nan))
