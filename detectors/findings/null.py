"""The threshold that a capture determines itself: noise towards the camera shows how often noise
looks like damage.

Damage lies behind the surface. Peaks in front of the surface are noise, fixed pattern or texture,
after objects on the target (regions that stand before the surface as a whole; edges in the colour
picture or the amplitude) and a margin are excluded. The tail of these peaks is extrapolated to the
threshold at which the wanted number of false calls is expected, bumps and hole-like calls
together. The tail is exponential in (s^q - 1) / q of the score s, minus the logarithm by which
maxima of normal noise in two dimensions are more frequent. The data weigh the exponents q,
starting from `PRIOR`; rates and scales are integrated out.

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
DRAWS = 4000  # of the interval
CONTRADICTED = 0.1
"""A tail is rejected if the probability of the number of peaks above the threshold is lower."""

# --- peaks and thresholds ---

WANTED_PEAKS = 60  # above the floor: their mean excess is known to 13 %
FEWEST_PEAKS = 8  # above the floor: their mean excess is known to 35 %
CROWDED = 0.6
"""Share of the largest number of findings at any threshold that the floor may have at most: at
more, findings still join."""
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
RIM_PX = 10  # depth of the target's rim
RIM_CALLS = 2  # calls behind the surface along the rim that chance does not explain


@dataclass(frozen=True)
class OwnThreshold:
    """A threshold that a capture's own noise determines. With too few peaks the numbers are NaN."""

    threshold: float
    """Units of score."""
    expected: float
    """False calls expected at the threshold, in front of and behind the surface."""
    low: float
    """Lower end of the 95 % interval of that expectation."""
    high: float
    """Upper end of it."""
    peaks: int
    """Number of peaks above the floor on which it is based."""
    floor: float
    """Units of score."""
    objects: int
    """Number of regions that are excluded as objects."""
    rim_pixels: int
    """Number of pixels along the rim that mix in what lies behind the target."""
    evidence: Evidence
    """Evidence to search: without the rim pixels."""
    doubts: tuple[str, ...]
    """Full sentences on why the numbers cannot be trusted."""


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
    covered = np.zeros(judged.shape, bool)
    if cloud.organised:
        objects = _proud(cloud, evidence) | _marked(cloud, evidence)
        covered = grown(objects, _margin(cloud), cv2.MORPH_ELLIPSE)
    n_objects = int(ndimage.label(covered)[1])
    floor, peaks = _peaks(detector, cloud, _only(evidence, ~behind(evidence)), covered)
    doubts = _doubts_about_symmetry(evidence)
    if len(peaks) < FEWEST_PEAKS:
        doubts.append(
            f"only {len(peaks)} peaks of noise stand out towards the camera, too few to set a"
            f" threshold (at least {FEWEST_PEAKS} are needed)"
        )
        return OwnThreshold(
            threshold=float("nan"),
            expected=float("nan"),
            low=float("nan"),
            high=float("nan"),
            peaks=len(peaks),
            floor=floor,
            objects=n_objects,
            rim_pixels=0,
            evidence=evidence,
            doubts=tuple(doubts),
        )
    # half of the false calls lie in front of the surface, where the peaks are
    tail = _fitting_tail(peaks, floor, false_calls / 2.0)
    threshold = max(tail.threshold(false_calls / 2.0), LEAST)
    low, high = tail.interval(threshold)
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
        expected=2.0 * tail.expected(threshold),
        low=2.0 * low,
        high=2.0 * high,
        peaks=tail.peaks,
        floor=tail.floor,
        objects=n_objects,
        rim_pixels=int(rim.sum()),
        evidence=_only(evidence, ~rim),
        doubts=tuple(doubts),
    )


def _fitting_tail(peaks: np.ndarray, floor: float, number: float) -> Tail:
    """Return a tail that the highest peaks (n,) do not contradict at the threshold at which
    ``number`` are expected.

    It takes all peaks, then the higher half, and so on while too many exceed the threshold: a few
    wide waves of a fixed pattern are then higher than the noise of many pixels, and one tail does
    not fit both."""
    falling = np.sort(peaks)[::-1]
    while True:
        tail = Tail.of(falling, floor)
        half = len(falling) // 2
        exceeding = int((falling > tail.threshold(number)).sum())
        if half < FEWEST_PEAKS or special.gammainc(exceeding, number) > CONTRADICTED:
            return tail
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

    @classmethod
    def of(cls, peaks: np.ndarray, floor: float) -> Tail:
        """Weigh the exponents by the scores (n,) of the peaks above a floor, which is positive."""
        ratios = np.maximum(np.asarray(peaks, float) / floor, 1.0 + 1e-9)
        excesses = [_excess(ratios, exponent, floor) for exponent in EXPONENTS]
        sums = NORMAL_PEAKS + np.array([excess.sum() for excess in excesses])
        # the likelihood with the scale integrated out under its prior, a Gamma distribution
        slopes = ratios[:, None] ** (EXPONENTS - 1.0) - _crowd(floor) / ratios[:, None]
        logs = np.log(slopes).sum(axis=0)
        logs = logs - (len(ratios) + NORMAL_PEAKS) * np.log(sums) + np.log(PRIOR)
        weights = np.exp(logs - logs.max())
        return cls(floor, len(ratios), sums, weights / weights.sum())

    def _excesses(self, threshold: float) -> np.ndarray:
        """Return the excess (e,) of a threshold by each exponent."""
        ratio = np.array([threshold / self.floor])
        return np.array([float(_excess(ratio, exponent, self.floor)[0]) for exponent in EXPONENTS])

    def expected(self, threshold: float) -> float:
        """Return the mean number of peaks above a threshold, over all rates and scales that the
        peaks allow."""
        beyond = 1.0 + self._excesses(threshold) / self.sums
        shares = beyond ** -(self.peaks + NORMAL_PEAKS)
        return float((self.weights * self.peaks * shares).sum())

    def threshold(self, number: float) -> float:
        """Return the threshold at which this number of peaks is expected; the floor if fewer are
        expected there."""
        if number >= self.peaks:
            return self.floor

        def surplus(log_ratio: float) -> float:
            threshold = float(np.exp(log_ratio)) * self.floor
            return float(np.log(self.expected(threshold) / number))

        high = 2.0
        while self.expected(high * self.floor) > number:
            high *= 2.0
        log_ratio = optimize.brentq(surplus, 0.0, np.log(high))
        return float(np.exp(log_ratio)) * self.floor

    def interval(self, threshold: float) -> tuple[float, float]:
        """Return the central 95 % of the expected number of peaks above a threshold."""
        random = np.random.default_rng(20201102)
        chosen = random.choice(len(EXPONENTS), DRAWS, p=self.weights)
        steepness = random.gamma(self.peaks + NORMAL_PEAKS, 1.0, DRAWS)
        excesses = self._excesses(threshold)
        exponents = steepness * excesses[chosen] / self.sums[chosen]
        drawn = random.gamma(self.peaks, 1.0, DRAWS) * np.exp(-exponents)
        low, high = np.quantile(drawn, (0.025, 0.975))
        return float(low), float(high)


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


def _peaks(
    detector: Detector,
    cloud: Cloud,
    before: Evidence,
    covered: np.ndarray,
) -> tuple[float, np.ndarray]:
    """Return a floor with about `WANTED_PEAKS` findings above it, and their scores (n,).

    ``before``: evidence with scores in front of the surface only. ``covered`` (h, w) bool: pixels
    at objects, where findings do not count."""
    evidence = _only(before, ~covered)
    judged = evidence.score[np.isfinite(evidence.score)]
    if not (len(judged) and judged.max() > 0):
        return 1.0, np.zeros(0)
    least = max(float(np.median(judged)), 1e-3 * float(judged.max()))
    steps = np.arange(np.log(judged.max() / least) / np.log(LADDER) + 1)
    thresholds = (least * LADDER**steps).tolist()
    findings = findings_at(detector, cloud, evidence, thresholds)
    counts = [len(at_threshold.scores) for at_threshold in findings]
    floor = thresholds[_floor_among(counts)]
    hidden = covered.reshape(-1)
    scores = [
        detection.score
        for detection in detector.find(cloud, before, floor)
        if not hidden[detection.pixels].any()
    ]
    return floor, np.array(scores)


def _floor_among(counts: list[int]) -> int:
    """Return which of rising thresholds is the floor, by the numbers of findings at each: the
    highest with enough peaks, else the first at which findings no longer join."""
    crowd = counts.index(max(counts))
    free = [n for n in range(crowd, len(counts)) if counts[n] <= CROWDED * counts[crowd]]
    enough = [n for n in free if counts[n] >= WANTED_PEAKS]
    if enough:
        return enough[-1]
    return free[0] if free else crowd


# --- objects on the target ---


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
