"""Missing returns as evidence: connected pixels inside the target's outline from which no light came back.

A deep hole before a far background, a mirror, or black tape sends nothing back, and no depth departs from the surface.
What tells such a place from chance is its size: cameras lose scattered pixels anywhere, connected ones now and then.

The outline is that of the pixels that a detector judged, with small gaps closed and everything inside filled. A place
that touches the outline's edge or that of the image is not enclosed: a notch or a hole cut by the rim cannot be told
from the target's own shape there, so it is no finding. The pixels that an automatic crop takes off the rim lie outside.

Chance is simulated. Scattered dropouts are taken for places where a random field, white noise averaged over a square of
1 to 5 pixels, falls below a level: the square is chosen to give the share of missing neighbours that was measured, no
wider than the widest filter that depth cameras are known to apply to their pixels (5 x 5, Azure Kinect), and the level
gives the local rate. Clusters of simulated fields say how many of each size to expect on the whole target. Rate and
square come from the clusters that are too small to be findings; whatever then is a finding is left out, and the bound
is raised from the least size until it no longer changes. Not modelled: dropouts that come in equal blobs wider than 3
pixels, which nothing in a single frame tells from small holes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from scipy.special import ndtri, ndtri_exp, owens_t

from detectors.interface import Detection, Evidence, Measurement, MissingReturns
from detectors.masks import grown, holes_filled
from detectors.measure import local_plane
from harness.vocabulary.capture import Cloud, Reason
from harness.vocabulary.seeds import random_stream

ALPHA = 0.01
"""Expected chance findings in one capture: what the least size of a finding is set by."""
LEAST_POINTS = 9
"""Fewer connected pixels are never a finding: 3 x 3, the narrowest filter that depth cameras are known to apply, turns
one bad sample into as many."""
SELDOM = 0.2
"""A pixel that returned in no more than this share of the frames counts as missing: its depth rests on stray light."""
SQUARES = (1, 2, 3, 4, 5)
"""Sides in pixels of the square that correlates dropouts."""
RATE_WINDOW_PX = 65
RATE_PRIOR_PX = 200.0
"""The local rate of dropouts is that of a window of this side, drawn towards the target's own by so many pixels."""
SIMULATED_PX = 1e6
FEWEST_FIELDS, MOST_FIELDS = 10, 100
"""Fields are simulated until they hold so many pixels: enough to reach well under one cluster a target."""
TAIL_CLUSTERS = 60
"""Largest simulated clusters from which the fall of their number with size is taken."""
SLOWEST_FALL = 0.5
"""Fall without simulated clusters to tell each further pixel multiplies a cluster's chance by this: in fields averaged
over 5 x 5 pixels at a rate of 1e-4, 0.3 % of the clusters have 9 pixels and more."""
REACH_PX = 2
"""A depth finding so near to pixels without return belongs to the same damage: half of a 5 x 5 window."""
RING_PX = 4
"""Width of the ring of judged pixels that places the surface at a hole."""
HIGHEST_SCORE = 37.0
"""Standard deviations; beyond it float64 knows no probability."""


def missing_returns(cloud: Cloud, evidence: Evidence) -> MissingReturns | None:
    """Look for missing returns inside the outline of what was judged; None for a cloud without a pixel grid, which does
    not tell what it lacks. Deterministic.

    The outline (h, w) bool: judged pixels, gaps narrower than 3 pixels between them, and all that these enclose. Beyond
    the image's edge there is no target.
    """
    judged = np.isfinite(evidence.score)
    if not cloud.organised or not judged.any():
        return None
    closed = cv2.morphologyEx(np.pad(judged.astype(np.uint8), 2), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    outline = holes_filled(closed > 0)[2:-2, 2:-2]
    is_map = cloud.projection == "parallel"
    frames = max(cloud.n_frames, 1)
    unseen = (~cloud.valid).astype(float) if is_map else 1.0 - np.clip(cloud.count / frames, 0.0, 1.0)
    missing = (~cloud.valid | (unseen >= 1.0 - SELDOM)) & outline
    blind = float((~cloud.valid)[outline].mean())
    labels, sizes = _clusters(missing)
    inner = cv2.erode(outline.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), borderValue=0)
    free = np.ones(len(sizes), dtype=bool)
    free[labels[outline & (inner == 0)]] = False
    if sizes[free].max(initial=0) < LEAST_POINTS:
        small = float(missing.sum() / outline.sum())
        return MissingReturns(outline, unseen, blind, small, LEAST_POINTS, 0.0, ())
    chance = _settled(labels, sizes, outline)
    found = []
    for number in np.flatnonzero(free & (sizes >= chance.least_points)):
        pixels = np.flatnonzero(labels.ravel() == number)
        placed = _surface_at(cloud, evidence, _filled(cloud.valid.shape, pixels))
        if placed is not None:
            improbable = -ndtri_exp(min(chance.log_expected(len(pixels)), np.log(0.5)))
            found.append(Detection(min(float(improbable), HIGHEST_SCORE), pixels, placed[0], "no return"))
    found.sort(key=lambda each: (-len(each.pixels), int(each.pixels[0])))
    expected = float(np.exp(chance.log_expected(chance.least_points)))
    return MissingReturns(outline, unseen, blind, chance.rate, chance.least_points, expected, tuple(found))


def one_damage_once(
    shape: tuple[int, int], found: tuple[Detection, ...], missing: tuple[Detection, ...]
) -> tuple[Detection, ...]:
    """Return findings by depth and by missing returns (flat indices into a grid of ``shape``) as one list, strongest
    first; where two of them touch (`REACH_PX`) they are the same damage, and the larger of them stands for it.

    A hole's floor with a few pixels lost at its wall stays a depth finding, which has a depth and whose size takes in
    pixels without a range that touch it; a hole that returns nothing but along its rim becomes a missing return.
    """
    kept = list(missing)
    depth = list(found)
    for hole in missing:
        area = _filled(shape, hole.pixels)
        near = grown(area, REACH_PX).ravel()
        touching = [other for other in depth if near[other.pixels].any()]
        if any(len(other.pixels) >= area.sum() for other in touching):
            kept.remove(hole)
        else:
            depth = [other for other in depth if not any(other is gone for gone in touching)]
    return tuple(sorted((*depth, *kept), key=lambda each: -each.score))


def measure_missing(cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
    """Measure place and size of pixels without return, on the surface: the diameter of a circle of the same area, what
    they enclose included, and the centre of their pixels. No depth, no volume; no allowance for the camera's blur.

    The surface at the hole is a plane through the fitted surface around it: on a face of radius r the centre of a hole
    of diameter d is d^2 / 8r off.
    """
    area = _filled(cloud.valid.shape, detection.pixels)
    rows, columns = np.nonzero(area)
    placed = _surface_at(cloud, evidence, area)
    if placed is None:
        raise ValueError("the detection is none that `missing_returns` made of this cloud")
    centre, pixel_m2 = placed
    reasons = np.bincount(cloud.reason.ravel()[detection.pixels])
    return Measurement(
        u_px=float(columns.mean()) + cloud.region.col0,
        v_px=float(rows.mean()) + cloud.region.row0,
        points=len(detection.pixels),
        score=detection.score,
        extent_diameter_m=2.0 * float(np.sqrt(len(rows) * pixel_m2 / np.pi)),
        extent_centre_m=centre,
        model_note=f"no return: {_REASONS.get(int(reasons.argmax()), 'no light came back')}",
    )


_REASONS: dict[int, str] = {
    Reason.SATURATED: "the sensor is saturated",
    Reason.LOW_AMPLITUDE: "too little light came back",
    Reason.LOW_REFLECTIVITY: "too little light came back",
    Reason.AMPLITUDE_RATIO: "near and far mix",
    Reason.EDGE: "near and far mix",
    Reason.UNWRAP: "the phases fit no single distance",
    Reason.OUT_OF_RANGE: "what lies there is out of range",
}


# ---------------------------------------------------------------- clusters and their places


def _clusters(missing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return labels (h, w) of clusters joined along rows and columns, and their sizes by label; 0 is no cluster."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(missing.astype(np.uint8), connectivity=4)
    sizes = stats[:count, cv2.CC_STAT_AREA].astype(np.int64)
    sizes[0] = 0
    return labels, sizes


def _filled(shape: tuple[int, int], pixels: np.ndarray) -> np.ndarray:
    """Return (h, w) bool: the pixels and what they enclose."""
    mask = np.zeros(shape, dtype=bool)
    mask.reshape(-1)[pixels] = True
    return holes_filled(mask)


def _surface_at(cloud: Cloud, evidence: Evidence, area: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return the surface's point (3,) at an area's centroid and the surface that one pixel covers there, m2; None where
    too little was judged around it. Directions come from the judged pixels' own points, so that no lens is needed."""
    rows, columns = np.nonzero(area)
    h, w = area.shape
    cut = np.s_[
        max(rows.min() - RING_PX, 0) : min(rows.max() + RING_PX + 1, h),
        max(columns.min() - RING_PX, 0) : min(columns.max() + RING_PX + 1, w),
    ]
    ring = grown(area[cut], RING_PX) & ~area[cut] & np.isfinite(evidence.score[cut]) & cloud.valid[cut]
    if ring.sum() < LEAST_POINTS:
        return None
    plane = local_plane(cloud.points_m[cut], evidence.surface_z_m[cut], ring, area[cut], cloud.projection)
    if plane is None:
        return None
    centre, per_px = plane
    return centre, float(np.linalg.norm(np.cross(per_px[0], per_px[1])))


# ---------------------------------------------------------------- what chance brings about


@dataclass(frozen=True)
class _Chance:
    """Scattered dropouts of one target. ``rate``: their share of it. ``least_points``: size from which on fewer than
    `ALPHA` clusters are expected. A line through (``at``, ``log_at``) falling by ``fall`` a pixel tells the logarithm
    of the expected number of clusters of a size and more."""

    rate: float
    at: int = 1
    log_at: float = 0.0
    fall: float = -math.log(SLOWEST_FALL)

    def log_expected(self, points: int) -> float:
        """Return the logarithm of the expected number of clusters of so many pixels and more on the whole target."""
        return self.log_at - self.fall * (points - self.at)

    @property
    def least_points(self) -> int:
        """Least size of a finding, `LEAST_POINTS` or more."""
        needed = self.at + (self.log_at - np.log(ALPHA)) / self.fall
        return max(LEAST_POINTS, int(np.ceil(needed)))


def _settled(labels: np.ndarray, sizes: np.ndarray, outline: np.ndarray) -> _Chance:
    """Return chance by the clusters that are no findings, the least size of findings being raised until it stays."""
    rows, columns = np.nonzero(outline)
    cut = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    labels, outline = labels[cut], outline[cut]
    (h, w), count = outline.shape, int(np.clip(SIMULATED_PX / outline.size, FEWEST_FIELDS, MOST_FIELDS))

    @cache
    def fields(side: int) -> list[np.ndarray]:
        """Draw fields of unit variance averaged over a square of this side."""
        beyond = side - 1
        random = random_stream(0, "missing returns", h, w, side)
        noise = (random.standard_normal((h + beyond, w + beyond), dtype=np.float32) for _ in range(count))
        blurred = (cv2.blur(z, (side, side)) * side if beyond else z for z in noise)
        first = beyond // 2
        return [z[first : first + h, first : first + w].copy() for z in blurred]

    def chance_of(scattered: np.ndarray, known: np.ndarray) -> _Chance:
        """Return chance by scattered dropouts (h, w) among known pixels (h, w), findings left out."""
        rate = float(scattered.sum() / max(known.sum(), 1))
        if not scattered.any():
            return _Chance(0.0)
        window = (RATE_WINDOW_PX, RATE_WINDOW_PX)
        near, of = (
            cv2.boxFilter(part.astype(np.float32), -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
            for part in (scattered, known)
        )
        local = (near + RATE_PRIOR_PX * rate) / (of + RATE_PRIOR_PX)
        level = ndtri(np.clip(local, 1e-7, 0.999)).astype(np.float32)
        sizes = [_clusters((z < level) & outline)[1][1:] for z in fields(_square(scattered, known, rate))]
        return _tail(rate, np.sort(np.concatenate(sizes)), count)

    least = LEAST_POINTS
    while True:
        scattered = (sizes < least)[labels] & (labels > 0)
        chance = chance_of(scattered, outline & (scattered | (labels == 0)))
        if not ((sizes >= least) & (sizes < chance.least_points)).any():
            return chance
        least = chance.least_points


def _square(scattered: np.ndarray, known: np.ndarray, rate: float) -> int:
    """Return the side of the least square whose fields have as many missing neighbours of missing pixels as these
    dropouts, to within two standard errors; 5 where none has."""
    pairs = both = 0
    for a, b in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        pairs += int((scattered[a] & known[b]).sum())
        both += int((scattered[a] & scattered[b]).sum())
    measured = both / max(pairs, 1)
    error = np.sqrt(max(measured * (1.0 - measured), 1.0 / max(pairs, 1)) / max(pairs, 1))
    level = ndtri(rate)
    for side in SQUARES:
        # two normal variables of correlation r below one level: Phi(t) - 2 T(t, sqrt((1 - r) / (1 + r))) (Owen 1956)
        correlation = 1.0 - 1.0 / side
        likely = 1.0 - 2.0 * owens_t(level, np.sqrt((1.0 - correlation) / (1.0 + correlation))) / rate
        if likely >= measured - 2.0 * error:
            return side
    return SQUARES[-1]


def _tail(rate: float, sizes: np.ndarray, fields: int) -> _Chance:
    """Return the fall of the number of clusters with size, from the largest of simulated ``sizes``, ascending; its mean
    excess is taken two standard errors high, as the fall slows down a little with size."""
    if len(sizes) < 2:
        return _Chance(rate, log_at=float(np.log(max(len(sizes), 1) / fields)))
    largest = sizes[-min(TAIL_CLUSTERS, len(sizes)) :]
    at = int(largest[0])
    of_size = int((sizes >= at).sum())
    excess = float(sizes[-of_size:].mean() - at) * (1.0 + 2.0 / np.sqrt(of_size))
    # of a geometric distribution with the mean excess m, m / (1 + m) go on to the next size
    fall = float(np.log1p(1.0 / max(excess, 1e-9)))
    return _Chance(rate, at, float(np.log(of_size / fields)), min(fall, -np.log(SLOWEST_FALL)))
