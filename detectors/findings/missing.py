"""Missing returns as evidence: connected pixels inside the target's outline from which no light
came back.

Size distinguishes a hole from chance. A place that touches the edge of the outline or image is not
a finding. Chance is simulated: scattered dropouts are places where white noise, averaged over a
square of 1 to 5 pixels, falls below a level. The square gives the share of missing neighbours and
the level the local rate; both come from clusters that are too small to be findings. Not modelled:
dropouts in equal blobs wider than 3 pixels."""

import math
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from scipy.special import ndtri, ndtri_exp, owens_t

from detectors.findings.measure import local_plane
from detectors.interface import Detection, Evidence, Measurement, MissingReturns
from detectors.masks import grown, holes_filled, nearest_pixel, parts_with
from harness.vocabulary.geometry import Cloud, Reason
from harness.vocabulary.seeds import random_stream

# expected number of chance findings in one capture, which determines the smallest size of a
# finding
ALPHA = 0.01
LEAST_POINTS = 9
"""Fewest connected pixels of a finding: 3 x 3, the narrowest filter of depth cameras, turns one
into so many."""
SELDOM = 0.2
"""A pixel that returned in at most this share of the frames counts as missing: its depth comes
from stray light."""
SQUARES = (1, 2, 3, 4, 5)  # sides in pixels of the square that correlates dropouts
RATE_WINDOW_PX = 65
RATE_PRIOR_PX = 200.0
"""Side of the window for the local rate of dropouts; the target's own rate counts like this many
pixels in it."""
SIMULATED_PX = 1e6
FEWEST_FIELDS = 10
MOST_FIELDS = 100
"""Simulation continues until its fields hold this many pixels: enough to reach well under one
cluster per target."""
TAIL_CLUSTERS = (
    60  # largest simulated clusters, from which the fall of their number with size is estimated
)
SLOWEST_FALL = math.log(
    2.0
)  # without simulated clusters, each further pixel halves a cluster's probability
DISCS_PX = (1.5, 2.5, 3.5)
LOUD_SIGMAS = 3.0
"""Radii of the discs in which missing pixels are counted, and scores next to which they do not
count as chance."""
REACH_PX = 2
APART = 0.8
"""A depth finding within `REACH_PX` of pixels without return (half of a 5 x 5 window) is the same
damage, unless its centre is `APART` of its radius and 2 `REACH_PX` away: 1 radius for a disc
beside them, 0.6 for a disc's other half."""
RING_PX = 4  # width of the ring of judged pixels that determines the surface at a hole
HIGHEST_SCORE = 37.0  # in standard deviations; float64 has no probabilities beyond
REASONS: dict[int, str] = {
    Reason.SATURATED: "the sensor is saturated",
    Reason.LOW_AMPLITUDE: "too little light came back",
    Reason.LOW_REFLECTIVITY: "too little light came back",
    Reason.AMPLITUDE_RATIO: "near and far mix",
    Reason.EDGE: "near and far mix",
    Reason.UNWRAP: "the phases fit no single distance",
    Reason.OUT_OF_RANGE: "what lies there is out of range",
}


class _Gaps(NamedTuple):
    """Pixels without a return inside the target's ``outline`` (h, w). ``unseen``: as in
    `MissingReturns`. ``missing``: (h, w) bool. ``labels`` (h, w) and ``sizes``: of their clusters;
    ``free``: which do not touch the outline's edge."""

    outline: np.ndarray
    unseen: np.ndarray
    missing: np.ndarray
    labels: np.ndarray
    sizes: np.ndarray
    free: np.ndarray


def _gaps(cloud: Cloud, evidence: Evidence) -> _Gaps | None:
    """Return what is missing inside the outline of the judged area; None without a pixel grid."""
    judged = np.isfinite(evidence.score)
    if not cloud.organised or not judged.any():
        return None
    closed = cv2.morphologyEx(
        np.pad(judged.astype(np.uint8), 2), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)
    )
    outline = holes_filled(closed > 0)[2:-2, 2:-2]
    if cloud.projection == "parallel":
        unseen = (~cloud.valid).astype(float)
    else:
        unseen = 1.0 - np.clip(cloud.count / max(cloud.n_frames, 1), 0.0, 1.0)
    missing = (~cloud.valid | (unseen >= 1.0 - SELDOM)) & outline
    labels, sizes = _clusters(missing)
    inner = cv2.erode(
        outline.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), borderValue=0
    )
    free = np.ones(len(sizes), dtype=bool)
    free[labels[outline & (inner == 0)]] = False
    return _Gaps(outline, unseen, missing, labels, sizes, free)


def missing_evidence(cloud: Cloud, evidence: Evidence) -> np.ndarray | None:
    """Return (h, w), at least 0, the amount that missing pixels around each place add to the
    square of a score there: twice the logarithm of a likelihood ratio. It compares the likelihood
    of their number in a disc (the best of several) with that at the local rate of dropouts, which
    is estimated where scores are not high. None if nothing is missing. Clusters that may be
    findings by themselves do not count, and others little: one bad sample of a filter makes
    `LEAST_POINTS` missing pixels."""
    gaps = _gaps(cloud, evidence)
    if gaps is None:
        return None
    scattered = (gaps.free & (gaps.sizes > 0) & (gaps.sizes < LEAST_POINTS))[gaps.labels]
    if not scattered.any():
        return None
    loud = grown(np.nan_to_num(evidence.score) > LOUD_SIGMAS, REACH_PX)
    quiet = scattered & ~parts_with(scattered, loud, connectivity=4)
    rate = max(float(quiet.sum()), 0.5) / gaps.outline.sum()
    near = _counted(quiet, np.ones((RATE_WINDOW_PX, RATE_WINDOW_PX)))
    of = _counted(gaps.outline, np.ones((RATE_WINDOW_PX, RATE_WINDOW_PX)))
    local = np.where(gaps.outline, (near + RATE_PRIOR_PX * rate) / (of + RATE_PRIOR_PX), 0.0)
    best = np.zeros(local.shape)
    for radius in DISCS_PX:
        reach = np.arange(-int(radius), int(radius) + 1)
        disc = (np.hypot(reach[:, None], reach) <= radius).astype(float)
        expected = np.maximum(_counted(local, disc), 1e-12)
        spread = ((_counted(quiet, disc) - expected) ** 2)[gaps.outline].sum() / expected[
            gaps.outline
        ].sum()
        # counts are whole numbers: subtract a half, as a continuity correction
        seen = np.maximum(_counted(scattered, disc) - 0.5, expected)
        likelihood = seen * np.log(seen / expected) - (seen - expected)
        best = np.maximum(best, 2.0 * likelihood / max(float(spread), float(LEAST_POINTS)))
    return best


def _counted(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    return np.asarray(
        cv2.filter2D(image.astype(np.float64), -1, kernel, borderType=cv2.BORDER_CONSTANT)
    )


def missing_returns(cloud: Cloud, evidence: Evidence) -> MissingReturns | None:
    """Look for missing returns inside the outline of the judged area. Return None for a cloud
    without a pixel grid."""
    gaps = _gaps(cloud, evidence)
    if gaps is None:
        return None
    outline, unseen, missing, labels, sizes, free = gaps
    blind = float((~cloud.valid)[outline].mean())
    if sizes[free].max(initial=0) < LEAST_POINTS:
        return MissingReturns(
            outline, unseen, blind, float(missing.sum() / outline.sum()), LEAST_POINTS, 0.0, ()
        )
    chance = _settled(labels, sizes, outline)
    found = []
    for number in np.flatnonzero(free & (sizes >= chance.least_points)):
        pixels = np.flatnonzero(labels.ravel() == number)
        placed = _surface_at(cloud, evidence, _filled(cloud.valid.shape, pixels))
        if placed is not None:
            improbable = -ndtri_exp(min(chance.log_expected(len(pixels)), np.log(0.5)))
            found.append(
                Detection(min(float(improbable), HIGHEST_SCORE), pixels, placed[0], "no return")
            )
    found.sort(key=lambda each: (-len(each.pixels), int(each.pixels[0])))
    expected = float(np.exp(chance.log_expected(chance.least_points)))
    return MissingReturns(
        outline, unseen, blind, chance.rate, chance.least_points, expected, tuple(found)
    )


def one_damage_once(
    shape: tuple[int, int], found: tuple[Detection, ...], missing: tuple[Detection, ...]
) -> tuple[Detection, ...]:
    """Return findings by depth and by missing returns (flat indices into a grid of ``shape``) as
    one list, strongest first. Of those that are one damage with a place without return
    (`REACH_PX`, `APART`), the largest is kept."""
    kept: list[Detection] = []
    depth = list(found)
    for hole in missing:
        area = _filled(shape, hole.pixels)
        apart, _ = nearest_pixel(area)
        same = [other for other in depth if _is_same(apart, other.pixels)]
        largest = max(same, key=lambda each: len(each.pixels), default=None)
        if largest is None or len(largest.pixels) < area.sum():
            kept.append(hole)
        else:
            same = [other for other in same if other is not largest]
        depth = [other for other in depth if all(other is not each for each in same)]
    return tuple(sorted((*depth, *kept), key=lambda each: -each.score))


def _is_same(apart: np.ndarray, pixels: np.ndarray) -> bool:
    """Return whether a depth finding and an area without return, ``apart`` (h, w) pixels away, are
    one damage."""
    row, column = (round(float(places.mean())) for places in np.unravel_index(pixels, apart.shape))
    far = apart[row, column] > max(APART * math.sqrt(len(pixels) / math.pi), 2.0 * REACH_PX)
    return bool(apart.flat[pixels].min() <= math.sqrt(2) * REACH_PX and not far)


def measure_missing(cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
    """Measure place and size of pixels without return, on a plane through the fitted surface
    around: the diameter of a circle of the same area, and its centre. No depth or volume; the
    camera's blur is not allowed for."""
    area = _filled(cloud.valid.shape, detection.pixels)
    rows, columns = np.nonzero(area)
    placed = _surface_at(cloud, evidence, area)
    if placed is None:
        raise ValueError("`missing_returns` did not make this detection from this cloud")
    centre, pixel_m2 = placed
    u = float(columns.mean()) + cloud.region.col0
    v = float(rows.mean()) + cloud.region.row0
    diameter_m = 2.0 * float(np.sqrt(len(rows) * pixel_m2 / np.pi))
    reason = int(np.bincount(cloud.reason.ravel()[detection.pixels]).argmax())
    note = f"no return: {REASONS.get(reason, 'no light came back')}"
    return Measurement(
        u, v, len(detection.pixels), detection.score, diameter_m, centre, model_note=note
    )


def _clusters(missing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return labels (h, w) of clusters joined along rows and columns, and their sizes by label; 0
    is no cluster."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(missing.astype(np.uint8), connectivity=4)
    sizes = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
    sizes[0] = 0
    return labels, sizes


def _filled(shape: tuple[int, int], pixels: np.ndarray) -> np.ndarray:
    """Return (h, w) bool: the pixels and the area that they enclose."""
    mask = np.zeros(shape, dtype=bool)
    mask.reshape(-1)[pixels] = True
    return holes_filled(mask)


def _surface_at(
    cloud: Cloud, evidence: Evidence, area: np.ndarray
) -> tuple[np.ndarray, float] | None:
    """Return the surface's point (3,) at an area's centroid, and the area in m2 that one pixel
    covers there."""
    rows, columns = np.nonzero(area)
    h, w = area.shape
    cut = np.s_[
        max(rows.min() - RING_PX, 0) : min(rows.max() + RING_PX + 1, h),
        max(columns.min() - RING_PX, 0) : min(columns.max() + RING_PX + 1, w),
    ]
    ring = (
        grown(area[cut], RING_PX) & ~area[cut] & np.isfinite(evidence.score[cut]) & cloud.valid[cut]
    )
    if ring.sum() < LEAST_POINTS:
        return None
    plane = local_plane(
        cloud.points_m[cut], evidence.surface_z_m[cut], ring, area[cut], cloud.projection
    )
    if plane is None:
        return None
    centre, per_px = plane
    return centre, float(np.linalg.norm(np.cross(per_px[0], per_px[1])))


class _Chance(NamedTuple):
    """Scattered dropouts: ``rate``, and a line through (``at``, ``log_at``) of the log number of
    clusters by size."""

    rate: float
    at: int = 1
    log_at: float = 0.0
    fall: float = SLOWEST_FALL

    def log_expected(self, points: int) -> float:
        """Return the logarithm of the expected number of clusters of at least this many pixels on
        the whole target."""
        return self.log_at - self.fall * (points - self.at)

    @property
    def least_points(self) -> int:
        """Smallest size of a finding: `LEAST_POINTS`, or more such that fewer than `ALPHA`
        clusters are expected."""
        return max(LEAST_POINTS, math.ceil(self.at + (self.log_at - math.log(ALPHA)) / self.fall))


def _settled(labels: np.ndarray, sizes: np.ndarray, outline: np.ndarray) -> _Chance:
    """Return the chance by clusters that are not findings; the smallest size of a finding rises
    until it is stable."""
    rows, columns = np.nonzero(outline)
    cut = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    labels = labels[cut]
    outline = outline[cut]
    (h, w), count = (
        outline.shape,
        int(np.clip(SIMULATED_PX / outline.size, FEWEST_FIELDS, MOST_FIELDS)),
    )
    window = (RATE_WINDOW_PX, RATE_WINDOW_PX)

    @cache
    def fields(side: int) -> list[np.ndarray]:
        """Draw fields of unit variance averaged over a square of this side."""
        beyond = side - 1
        random = random_stream(0, "missing returns", h, w, side)
        noise = (
            random.standard_normal((h + beyond, w + beyond), dtype=np.float32) for _ in range(count)
        )
        blurred = (cv2.blur(z, (side, side)) * side if beyond else z for z in noise)
        first = beyond // 2
        return [z[first : first + h, first : first + w].copy() for z in blurred]

    least = LEAST_POINTS
    while True:
        scattered = (sizes < least)[labels] & (labels > 0)
        known = outline & (scattered | (labels == 0))
        rate = float(scattered.sum() / max(known.sum(), 1))
        chance = _Chance(0.0)
        if scattered.any():
            near, of = (
                cv2.boxFilter(
                    part.astype(np.float32),
                    -1,
                    window,
                    normalize=False,
                    borderType=cv2.BORDER_CONSTANT,
                )
                for part in (scattered, known)
            )
            local = (near + RATE_PRIOR_PX * rate) / (of + RATE_PRIOR_PX)
            level = ndtri(np.clip(local, 1e-7, 0.999)).astype(np.float32)
            drawn = [
                _clusters((z < level) & outline)[1][1:]
                for z in fields(_square(scattered, known, rate))
            ]
            chance = _tail(rate, np.sort(np.concatenate(drawn)), count)
        if not ((sizes >= least) & (sizes < chance.least_points)).any():
            return chance
        least = chance.least_points


def _square(scattered: np.ndarray, known: np.ndarray, rate: float) -> int:
    """Return the side of the smallest square whose fields have as many missing neighbours, to two
    standard errors."""
    pairs = both = 0
    for a, b in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        pairs += int((scattered[a] & known[b]).sum())
        both += int((scattered[a] & scattered[b]).sum())
    measured = both / max(pairs, 1)
    error = np.sqrt(max(measured * (1.0 - measured), 1.0 / max(pairs, 1)) / max(pairs, 1))
    level = ndtri(rate)
    for side in SQUARES:
        # two normal variables with correlation r below one level: Phi(t) - 2 T(t, sqrt((1 - r) /
        # (1 + r))) (Owen 1956)
        correlation = 1.0 - 1.0 / side
        likely = (
            1.0 - 2.0 * owens_t(level, np.sqrt((1.0 - correlation) / (1.0 + correlation))) / rate
        )
        if likely >= measured - 2.0 * error:
            return side
    return SQUARES[-1]


def _tail(rate: float, sizes: np.ndarray, fields: int) -> _Chance:
    """Return how the number of clusters falls with size, from the largest of simulated ``sizes``,
    ascending."""
    if len(sizes) < 2:
        return _Chance(rate, log_at=float(np.log(max(len(sizes), 1) / fields)))
    largest = sizes[-min(TAIL_CLUSTERS, len(sizes)) :]
    at = int(largest[0])
    of_size = int((sizes >= at).sum())
    excess = float(sizes[-of_size:].mean() - at) * (1.0 + 2.0 / np.sqrt(of_size))
    # in a geometric distribution with mean excess m, the share m / (1 + m) continues to the next
    # size
    fall = float(np.log1p(1.0 / max(excess, 1e-9)))
    return _Chance(rate, at, float(np.log(of_size / fields)), min(fall, SLOWEST_FALL))
