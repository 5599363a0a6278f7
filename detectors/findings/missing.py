"""Missing returns as evidence: connected pixels inside the target's outline from which no light
came back.

Size distinguishes a hole from chance. A cluster that touches the edge of the outline or image is
not a finding. Chance is simulated: scattered dropouts are pixels where white noise, averaged over
a square of 1 to 5 pixels, falls below a level. The square gives the share of missing neighbours
and the level the local rate; both come from clusters that are too small to be findings. Not
modelled: dropouts in equal blobs wider than 3 pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from scipy.special import ndtri, ndtri_exp, owens_t

from detectors.findings.surroundings import local_plane
from detectors.interface import Detection, Evidence, Measurement, MissingReturns
from detectors.pixels.masks import grown, holes_filled, nearest_pixel, parts_with
from harness.vocabulary.geometry import Cloud, Reason
from harness.vocabulary.seeds import random_stream

ALPHA = 0.01
"""Expected number of chance findings in one capture, which determines the smallest size of a
finding."""
LEAST_POINTS = 9
"""Fewest connected pixels of a finding: 3 x 3, the narrowest filter of depth cameras, turns one
into so many."""
SELDOM = 0.2
"""A pixel that returned in at most this share of the frames counts as missing: its depth comes
from stray light."""
RATE_WINDOW_PX = 65  # side of the window for the local rate of dropouts
RATE_PRIOR_PX = 200.0  # the target's own rate counts like this many pixels in it

# --- simulated dropouts ---

SQUARES = (1, 2, 3, 4, 5)  # sides in pixels of the square that correlates dropouts
SIMULATED_PX = 1e6
"""Simulation continues until its fields hold this many pixels: enough to reach well under one
cluster per target."""
FEWEST_FIELDS = 10
MOST_FIELDS = 100
TAIL_CLUSTERS = 60
"""Largest simulated clusters, from which the fall of their number with size is estimated."""
SLOWEST_FALL = math.log(2.0)
"""Fall without simulated clusters: each further pixel halves a cluster's probability."""
HIGHEST_SCORE = 37.0  # in standard deviations; float64 has no probabilities beyond

# --- missing pixels as evidence ---

DISCS_PX = (1.5, 2.5, 3.5)  # radii of the discs in which missing pixels are counted
LOUD_SIGMAS = 3.0  # scores next to which missing pixels do not count as chance

# --- one damage, found by depth and by missing returns ---

REACH_PX = 2
"""A depth finding this close to pixels without return (half of a 5 x 5 window) is the same
damage."""
APART = 0.8
"""It is another damage if its centre is this share of its radius and 2 `REACH_PX` away: 1 radius
for a disc beside them, 0.6 for a disc's other half."""

RING_PX = 4  # width of the ring of judged pixels that determines the surface at a hole
REASONS: dict[int, str] = {
    Reason.SATURATED: "the sensor is saturated",
    Reason.LOW_AMPLITUDE: "too little light came back",
    Reason.LOW_REFLECTIVITY: "too little light came back",
    Reason.AMPLITUDE_RATIO: "near and far mix",
    Reason.EDGE: "near and far mix",
    Reason.UNWRAP: "the phases fit no single distance",
    Reason.OUT_OF_RANGE: "what lies there is out of range",
}


@dataclass(frozen=True)
class _Gaps:
    """Pixels without a return inside the target's outline."""

    outline: np.ndarray
    """(h, w) bool."""
    unseen: np.ndarray
    """(h, w): share of the frames in which a pixel returned nothing, as in `MissingReturns`."""
    missing: np.ndarray
    """(h, w) bool."""
    labels: np.ndarray
    """(h, w): number of each missing pixel's cluster, 0 for none."""
    sizes: np.ndarray
    """(n,): pixels of each cluster."""
    free: np.ndarray
    """(n,) bool: whether a cluster does not touch the outline's edge."""


def _gaps(cloud: Cloud, evidence: Evidence) -> _Gaps | None:
    """Return what is missing inside the outline of the judged area; None without a pixel grid.
    A cloud keeps it by that area."""
    judged = np.isfinite(evidence.score)
    if not cloud.organised or not judged.any():
        return None
    key = judged.tobytes()
    if key not in cloud.gaps:
        cloud.gaps[key] = _gaps_within(cloud, judged)
    return cast("_Gaps", cloud.gaps[key])


def _gaps_within(cloud: Cloud, judged: np.ndarray) -> _Gaps:
    """Return what is missing inside the outline of the ``judged`` area (h, w) bool."""
    padded = np.pad(judged.astype(np.uint8), 2)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    outline = holes_filled(closed > 0)[2:-2, 2:-2]
    if cloud.projection == "parallel":
        unseen = (~cloud.valid).astype(float)
    else:
        unseen = 1.0 - np.clip(cloud.count / max(cloud.n_frames, 1), 0.0, 1.0)
    missing = (~cloud.valid | (unseen >= 1.0 - SELDOM)) & outline
    labels, sizes = _clusters(missing)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    inner = cv2.erode(outline.astype(np.uint8), cross, borderValue=0)
    free = np.ones(len(sizes), dtype=bool)
    free[labels[outline & (inner == 0)]] = False
    return _Gaps(outline, unseen, missing, labels, sizes, free)


def _clusters(missing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return labels (h, w) of clusters joined along rows and columns, and their sizes by label; 0
    is no cluster."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(missing.astype(np.uint8), connectivity=4)
    sizes = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
    sizes[0] = 0
    return labels, sizes


# --- missing pixels as evidence ---


def missing_evidence(cloud: Cloud, evidence: Evidence) -> np.ndarray | None:
    """Return (h, w), at least 0, the amount that missing pixels around each pixel add to the
    square of a score there: twice the logarithm of a likelihood ratio.

    It compares the likelihood of their number in a disc (the best of several) with that at the
    local rate of dropouts, which is estimated where scores are not high. None if nothing is
    missing. Clusters that may be findings by themselves do not count, and others little: one bad
    sample of a filter makes `LEAST_POINTS` missing pixels."""
    gaps = _gaps(cloud, evidence)
    if gaps is None:
        return None
    outline = gaps.outline
    scattered = (gaps.free & (gaps.sizes > 0) & (gaps.sizes < LEAST_POINTS))[gaps.labels]
    if not scattered.any():
        return None
    loud = grown(np.nan_to_num(evidence.score) > LOUD_SIGMAS, REACH_PX)
    quiet = scattered & ~parts_with(scattered, loud, connectivity=4)
    rate = max(float(quiet.sum()), 0.5) / outline.sum()
    window = np.ones((RATE_WINDOW_PX, RATE_WINDOW_PX))
    local_rate = _local_rate(_counted(quiet, window), _counted(outline, window), rate)
    local_rate = np.where(outline, local_rate, 0.0)
    best = np.zeros(outline.shape)
    for radius in DISCS_PX:
        reach = np.arange(-int(radius), int(radius) + 1)
        disc = (np.hypot(reach[:, None], reach) <= radius).astype(float)
        expected = np.maximum(_counted(local_rate, disc), 1e-12)
        # the variance of the number over its mean: dropouts come in groups
        squares = (_counted(quiet, disc) - expected) ** 2
        spread = squares[outline].sum() / expected[outline].sum()
        # counts are whole numbers: subtract a half, as a continuity correction
        number = np.maximum(_counted(scattered, disc) - 0.5, expected)
        likelihood = number * np.log(number / expected) - (number - expected)
        best = np.maximum(best, 2.0 * likelihood / max(float(spread), float(LEAST_POINTS)))
    return best


def _counted(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Return the sums (h, w) of an image around each pixel, weighted by a kernel."""
    image = image.astype(np.float64)
    return cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_CONSTANT)


def _local_rate(
    missing: np.ndarray,
    known: np.ndarray,
    rate: float,
) -> np.ndarray:
    """Return the rate of dropouts around each pixel, from the numbers of missing and known pixels
    in a window and the target's own rate."""
    return (missing + RATE_PRIOR_PX * rate) / (known + RATE_PRIOR_PX)


# --- missing pixels as findings ---


def missing_returns(cloud: Cloud, evidence: Evidence) -> MissingReturns | None:
    """Look for missing returns inside the outline of the judged area. Return None for a cloud
    without a pixel grid."""
    gaps = _gaps(cloud, evidence)
    if gaps is None:
        return None
    if gaps.sizes[gaps.free].max(initial=0) < LEAST_POINTS:
        # all are scattered
        dropouts = float(gaps.missing.sum() / gaps.outline.sum())
        least_points = LEAST_POINTS
        expected = 0.0
        detections = []
    else:
        chance = _settled(gaps)
        dropouts = chance.rate
        least_points = chance.least_points
        expected = float(np.exp(chance.log_expected(least_points)))
        detections = _detections(cloud, evidence, gaps, chance)
    return MissingReturns(
        outline=gaps.outline,
        unseen=gaps.unseen,
        blind=float((~cloud.valid)[gaps.outline].mean()),
        dropouts=dropouts,
        least_points=least_points,
        expected=expected,
        detections=tuple(detections),
    )


def _detections(
    cloud: Cloud,
    evidence: Evidence,
    gaps: _Gaps,
    chance: _Chance,
) -> list[Detection]:
    """Return the clusters that chance does not explain, largest first."""
    detections = []
    for number in np.flatnonzero(gaps.free & (gaps.sizes >= chance.least_points)):
        pixels = np.flatnonzero(gaps.labels.ravel() == number)
        surface = _surface_at(cloud, evidence, _filled(cloud.valid.shape, pixels))
        if surface is None:
            continue
        centre_m, _ = surface
        log_probability = min(chance.log_expected(len(pixels)), np.log(0.5))
        score = min(float(-ndtri_exp(log_probability)), HIGHEST_SCORE)
        detections.append(Detection(score, pixels, centre_m, "no return"))
    detections.sort(key=lambda detection: (-len(detection.pixels), int(detection.pixels[0])))
    return detections


def measure_missing(
    cloud: Cloud,
    evidence: Evidence,
    detection: Detection,
) -> Measurement:
    """Measure place and size of pixels without return, on a plane through the fitted surface
    around: the diameter of a circle of the same area, and its centre. No depth or volume; the
    camera's blur is not allowed for."""
    area = _filled(cloud.valid.shape, detection.pixels)
    rows, columns = np.nonzero(area)
    surface = _surface_at(cloud, evidence, area)
    if surface is None:
        raise ValueError("`missing_returns` did not make this detection from this cloud")
    centre_m, pixel_m2 = surface
    reason = int(np.bincount(cloud.reason.ravel()[detection.pixels]).argmax())
    return Measurement(
        u_px=float(columns.mean()) + cloud.region.col0,
        v_px=float(rows.mean()) + cloud.region.row0,
        points=len(detection.pixels),
        score=detection.score,
        extent_diameter_m=2.0 * float(np.sqrt(len(rows) * pixel_m2 / np.pi)),
        extent_centre_m=centre_m,
        model_note=f"no return: {REASONS.get(reason, 'no light came back')}",
    )


def _filled(shape: tuple[int, int], pixels: np.ndarray) -> np.ndarray:
    """Return (h, w) bool: the pixels and the area that they enclose."""
    mask = np.zeros(shape, dtype=bool)
    mask.reshape(-1)[pixels] = True
    return holes_filled(mask)


def _surface_at(
    cloud: Cloud,
    evidence: Evidence,
    area: np.ndarray,
) -> tuple[np.ndarray, float] | None:
    """Return the surface's point (3,) at an area's centroid, and the area in m2 that one pixel
    covers there; None if too few pixels around are judged."""
    rows, columns = np.nonzero(area)
    top = max(rows.min() - RING_PX, 0)
    left = max(columns.min() - RING_PX, 0)
    cut = np.s_[top : rows.max() + RING_PX + 1, left : columns.max() + RING_PX + 1]
    inside = area[cut]
    ring = grown(inside, RING_PX) & ~inside & np.isfinite(evidence.score[cut]) & cloud.valid[cut]
    if ring.sum() < LEAST_POINTS:
        return None
    surface_z_m = evidence.surface_z_m[cut]
    plane = local_plane(cloud.points_m[cut], surface_z_m, ring, inside, cloud.projection)
    if plane is None:
        return None
    centre_m, per_px_m = plane
    return centre_m, float(np.linalg.norm(np.cross(per_px_m[0], per_px_m[1])))


# --- one damage, found by depth and by missing returns ---


def one_damage_once(
    shape: tuple[int, int],
    found: tuple[Detection, ...],
    missing: tuple[Detection, ...],
) -> tuple[Detection, ...]:
    """Return findings by depth and by missing returns (flat indices into a grid of ``shape``) as
    one list, strongest first. Of those that are one damage with a cluster without return
    (`REACH_PX`, `APART`), the largest is kept."""
    kept: list[Detection] = []
    depth = list(found)
    for hole in missing:
        area = _filled(shape, hole.pixels)
        distance_px, _ = nearest_pixel(area)
        dropped = [finding for finding in depth if _is_same(distance_px, finding.pixels)]
        largest = max(dropped, key=lambda finding: len(finding.pixels), default=None)
        if largest is None or len(largest.pixels) < area.sum():
            kept.append(hole)
        else:
            dropped = [finding for finding in dropped if finding is not largest]
        depth = [finding for finding in depth if all(finding is not drop for drop in dropped)]
    return tuple(sorted((*depth, *kept), key=lambda finding: -finding.score))


def _is_same(distance_px: np.ndarray, pixels: np.ndarray) -> bool:
    """Return whether a depth finding and an area without return, at ``distance_px`` (h, w), are
    one damage."""
    rows, columns = np.unravel_index(pixels, distance_px.shape)
    centre = round(float(rows.mean())), round(float(columns.mean()))
    radius_px = math.sqrt(len(pixels) / math.pi)
    is_beside = distance_px[centre] > max(APART * radius_px, 2.0 * REACH_PX)
    touches = distance_px.flat[pixels].min() <= math.sqrt(2) * REACH_PX
    return bool(touches and not is_beside)


# --- what chance makes of scattered dropouts ---


@dataclass(frozen=True)
class _Chance:
    """Scattered dropouts: the log number of clusters on the whole target falls along a line with
    their size."""

    rate: float
    """Share of the pixels that are scattered dropouts."""
    size: int = 1
    """Pixels of a cluster at which the line is known."""
    log_number: float = 0.0
    """Logarithm of the expected number of clusters of at least that size."""
    fall: float = SLOWEST_FALL
    """Fall of the logarithm with each further pixel."""

    def log_expected(self, points: int) -> float:
        """Return the logarithm of the expected number of clusters of at least this many pixels on
        the whole target."""
        return self.log_number - self.fall * (points - self.size)

    @property
    def least_points(self) -> int:
        """Smallest size of a finding: `LEAST_POINTS`, or more such that fewer than `ALPHA`
        clusters are expected."""
        points = math.ceil(self.size + (self.log_number - math.log(ALPHA)) / self.fall)
        return max(LEAST_POINTS, points)


def _settled(gaps: _Gaps) -> _Chance:
    """Return the chance by clusters that are not findings; the smallest size of a finding rises
    until it is stable."""
    rows, columns = np.nonzero(gaps.outline)
    cut = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    labels = gaps.labels[cut]
    outline = gaps.outline[cut]
    least = LEAST_POINTS
    while True:
        scattered = (gaps.sizes < least)[labels] & (labels > 0)
        chance = _chance_of(scattered, outline & (scattered | (labels == 0)), outline)
        larger = (gaps.sizes >= least) & (gaps.sizes < chance.least_points)
        if not larger.any():
            return chance
        least = chance.least_points


def _chance_of(
    scattered: np.ndarray,
    known: np.ndarray,
    outline: np.ndarray,
) -> _Chance:
    """Return the chance by ``scattered`` dropouts (h, w) among the ``known`` pixels (h, w) of an
    outline, from simulated fields with the same local rate and correlation."""
    rate = float(scattered.sum() / max(known.sum(), 1))
    if not scattered.any():
        return _Chance(0.0)
    local_rate = _local_rate(_in_window(scattered), _in_window(known), rate)
    level = ndtri(np.clip(local_rate, 1e-7, 0.999)).astype(np.float32)
    count = int(np.clip(SIMULATED_PX / outline.size, FEWEST_FIELDS, MOST_FIELDS))
    sizes = [
        _clusters((field < level) & outline)[1][1:]
        for field in _fields(outline.shape, _square(scattered, known, rate), count)
    ]
    return _tail(rate, np.sort(np.concatenate(sizes)), count)


def _in_window(image: np.ndarray) -> np.ndarray:
    """Return the number of true pixels in the window around each pixel."""
    window = (RATE_WINDOW_PX, RATE_WINDOW_PX)
    image = image.astype(np.float32)
    border = cv2.BORDER_CONSTANT
    return cv2.boxFilter(image, -1, window, normalize=False, borderType=border)


def _fields(
    shape: tuple[int, ...],
    side: int,
    count: int,
) -> Iterator[np.ndarray]:
    """Draw fields (h, w) of unit variance, averaged over a square of this side."""
    height, width = shape
    margin = side - 1
    first = margin // 2
    random = random_stream(0, "missing returns", height, width, side)
    for _ in range(count):
        white = random.standard_normal((height + margin, width + margin), dtype=np.float32)
        field = cv2.blur(white, (side, side)) * side if margin else white
        yield field[first : first + height, first : first + width]


def _square(scattered: np.ndarray, known: np.ndarray, rate: float) -> int:
    """Return the side of the smallest square whose fields have as many missing neighbours, to two
    standard errors."""
    pairs = 0
    missing_pairs = 0
    # along columns, then along rows
    for image, known_image in ((scattered, known), (scattered.T, known.T)):
        pairs += int((image[:-1] & known_image[1:]).sum())
        missing_pairs += int((image[:-1] & image[1:]).sum())
    pairs = max(pairs, 1)
    measured = missing_pairs / pairs
    error = np.sqrt(max(measured * (1.0 - measured), 1.0 / pairs) / pairs)
    level = ndtri(rate)
    for side in SQUARES:
        # two normal variables with correlation r are below one level t with the probability
        # Phi(t) - 2 T(t, sqrt((1 - r) / (1 + r))) (Owen 1956)
        correlation = 1.0 - 1.0 / side
        slope = np.sqrt((1.0 - correlation) / (1.0 + correlation))
        likely = 1.0 - 2.0 * owens_t(level, slope) / rate
        if likely >= measured - 2.0 * error:
            return side
    return SQUARES[-1]


def _tail(rate: float, sizes: np.ndarray, fields: int) -> _Chance:
    """Return how the number of clusters falls with size, from the largest of simulated ``sizes``,
    ascending, in this many ``fields``."""
    if len(sizes) < 2:
        return _Chance(rate, log_number=float(np.log(max(len(sizes), 1) / fields)))
    largest = sizes[-min(TAIL_CLUSTERS, len(sizes)) :]
    size = int(largest[0])
    number = int((sizes >= size).sum())
    mean_excess = float(sizes[-number:].mean() - size)
    excess = mean_excess * (1.0 + 2.0 / np.sqrt(number))
    # in a geometric distribution with mean excess m, the share m / (1 + m) continues to the next
    # size
    fall = float(np.log1p(1.0 / max(excess, 1e-9)))
    log_number = float(np.log(number / fields))
    return _Chance(rate, size, log_number, min(fall, SLOWEST_FALL))
