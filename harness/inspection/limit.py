"""Sizes that an inspection would have missed: discs are pressed into the capture's own cloud at
places without findings, and the same detector searches it at the same threshold.

The discs have a flat floor, a rim as sharp as a pixel, and the blur of the camera's filter, as wide
as the noise's reach. The detector fits its surface and learns its noise anew each time, with the
discs in the cloud. Not modelled: multipath at walls and floor, the lens' blur, and places near the
rim or near findings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np

from detectors.interface import Detector
from detectors.pixels.masks import grown
from harness.evaluation import intervals
from harness.inspection.judging import at_steps
from harness.inspection.verdict import pitch_mm, sight_lines, surface_points_m
from harness.report.findings import Judged
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud
from harness.vocabulary.seeds import random_stream

FIRST_PX = 4.0
"""Width in pixels of the discs with which the search begins."""
LEAST_PX = 1.0
"""Width of the smallest discs."""
STEP = 1.4
"""Ratio of neighbouring sizes."""
FINEST = 0.2
"""Least difference of the steps of two sizes: 7 %."""
MOST_SIZES = 9
"""Most sizes, of which each costs an analysis of the cloud."""
MOST_PLACES = 40
"""Most discs in a cloud."""
MOST_SHARE = 0.03
"""Largest share of the judged pixels that discs cover, so that they do not bend the fit."""
MOST_ROUNDS = 15
"""Most clouds with discs of one size."""
APART_PX = 24.0
"""Least distance between the rims of two discs: the widest filters reach 25 pixels."""
RARE = 0.25
"""The search goes on to smaller sizes until at most this share is found, and ..."""
USUAL = 0.98
"""... to larger ones until at least this share is."""
WANTED = 0.9
HALF = 0.5
"""Depth over width of the discs, if no depth is stated."""


@dataclass(frozen=True)
class SizeCount:
    """Discs of one size."""

    diameter_mm: float
    depth_mm: float
    hits: int
    """Number of those that were found."""
    places: int
    low: float
    """Lower end of Wilson's 95 % interval of the share that is found."""
    high: float


@dataclass(frozen=True)
class Limit:
    """The sizes that are found in a capture."""

    sizes: tuple[SizeCount, ...]
    """Smallest first."""
    a90_mm: float
    """Width that is found in 90 % of the places, by a logistic curve over its logarithm; NaN if
    the discs do not determine it."""
    bound_mm: float
    """Its upper 95 % bound (likelihood ratio); NaN likewise, infinite if there is none."""
    text: str
    """The result in one sentence."""

    @property
    def facts(self) -> dict[str, Any]:
        """Return it as plain data, for the JSON."""
        return asdict(self)


def limit_of(
    detector: Detector, result: Judged, threshold: float, depth_m: float | None = None
) -> Limit:
    """Return the sizes of discs that the detector finds in a judged cloud at the threshold.
    ``depth_m``: their depth, or None for half their width. Raises UserError without a pixel grid,
    or without room for a disc."""
    _refuse_ungridded(result)
    free = free_area(result)
    counts: dict[float, SizeCount] = {}
    step = 0.0
    while len(counts) < MOST_SIZES:
        count = _counted(detector, result, threshold, free, _disc(result, step, depth_m))
        if count is None:
            break
        counts[step] = count
        following = next_step(counts)
        if following is None:
            break
        step = following
    if not counts:
        raise UserError(
            "--limit: the judged area has no room for a disc away from the findings",
            fix="leave out --limit, or judge a larger area",
        )
    sizes = tuple(counts[number] for number in sorted(counts))
    return fitted(sizes, depth_m)


def found_at(
    detector: Detector,
    result: Judged,
    threshold: float,
    *,
    diameter_m: float,
    depth_m: float,
) -> SizeCount | None:
    """Return how many of some `MOST_PLACES` discs of one size the detector finds in a judged cloud
    at the threshold, in up to `MOST_ROUNDS` clouds, as few lie in each; None without room for any.
    Raises UserError without a pixel grid."""
    _refuse_ungridded(result)
    disc = Disc(diameter_m, depth_m)
    free = free_area(result)
    hits = 0
    trials = 0
    for number in range(MOST_ROUNDS):
        count = _counted(detector, result, threshold, free, disc, round_number=number)
        if count is None:
            break
        hits += count.hits
        trials += count.places
        if trials >= MOST_PLACES:
            break
    return _size_count(disc, hits, trials) if trials else None


def _refuse_ungridded(result: Judged) -> None:
    if not result.cloud.organised:
        raise UserError(
            "--limit presses damage into a grid of pixels, and these points have none",
            fix="leave out --limit, or give depth images",
        )


@dataclass(frozen=True)
class Disc:
    """A disc to be pressed into a cloud."""

    diameter_m: float
    depth_m: float


def _disc(result: Judged, step: float, depth_m: float | None) -> Disc:
    """Return the disc that is ``step`` sizes larger than the first."""
    diameter_m = FIRST_PX * STEP**step * _pitch_m(result)
    return Disc(diameter_m, HALF * diameter_m if depth_m is None else depth_m)


def _pitch_m(result: Judged) -> float:
    return pitch_mm(result.cloud, result.evidence) * MM


def next_step(counts: dict[float, SizeCount]) -> float | None:
    """Return the step of the next size: smaller ones until few are found, larger ones until nearly
    all are, then between them, as a curve needs two sizes of which some are found and some are
    missed; None at the end."""
    steps = sorted(counts)
    next_px = FIRST_PX * STEP ** (steps[0] - 1)
    if _share(counts[steps[0]]) > RARE and next_px >= LEAST_PX:
        return steps[0] - 1
    if _share(counts[steps[-1]]) < USUAL:
        return steps[-1] + 1
    mixed = [step for step in steps if 0 < _share(counts[step]) < 1]
    below = [step for step in steps if _share(counts[step]) < WANTED]
    if len(mixed) >= 2 or not below:
        return None
    above = next(step for step in steps if step > below[-1])
    if above - below[-1] <= FINEST:
        return None
    return 0.5 * (below[-1] + above)


def _share(count: SizeCount) -> float:
    return count.hits / count.places


def _counted(
    detector: Detector,
    result: Judged,
    threshold: float,
    free: np.ndarray,
    disc: Disc,
    *,
    round_number: int = 0,
) -> SizeCount | None:
    """Press discs of one size into the cloud and count those that are found; None without room.
    ``round_number``: another has other places."""
    centres = places_for(result, free, disc, round_number)
    if not len(centres):
        return None
    pressed, floors = pressed_in(result, centres, disc)
    evidence = detector.analyse(pressed)
    searched = np.isfinite(result.evidence.score)
    evidence = replace(evidence, score=np.where(searched, evidence.score, np.nan))
    detections = detector.find(pressed, evidence, threshold)
    explained = at_steps(pressed, evidence, detections, threshold)
    is_found = np.zeros(pressed.valid.size, bool)
    for number, detection in enumerate(detections):
        if number not in explained:
            is_found[detection.pixels] = True
    hits = sum(bool(is_found[floor].any()) for floor in floors)
    return _size_count(disc, hits, len(centres))


def _size_count(disc: Disc, hits: int, places: int) -> SizeCount:
    """Return the hits at discs of one size with their interval."""
    low, high = intervals.wilson(hits, places)
    return SizeCount(
        diameter_mm=disc.diameter_m / MM,
        depth_mm=disc.depth_m / MM,
        hits=hits,
        places=places,
        low=float(low),
        high=float(high),
    )


def pressed_in(
    result: Judged, centres: np.ndarray, disc: Disc
) -> tuple[Cloud, tuple[np.ndarray, ...]]:
    """Return the cloud with discs pressed into it, and the flat indices of each disc's pixels.

    ``centres`` (n,): flat indices of pixels. Points move along their rays until the floor is as
    deep as stated, across the fitted surface."""
    cloud = result.cloud
    surface_m = surface_points_m(cloud, result.evidence.surface_z_m)
    pixel_m = _pitch_m(result)
    covered = np.zeros(cloud.valid.shape)
    floors = []
    for centre in centres:
        distance_m = np.linalg.norm(surface_m - surface_m.reshape(-1, 3)[centre], axis=-1)
        share = np.clip((0.5 * disc.diameter_m - distance_m) / pixel_m + 0.5, 0.0, 1.0)
        share = np.nan_to_num(share)
        covered = np.maximum(covered, share)
        floors.append(np.union1d(np.flatnonzero(share.ravel() >= 0.5), centre))
    side_px = max(1, round(cloud.noise_reach_px))
    blurred = cv2.blur(covered, (side_px, side_px), borderType=cv2.BORDER_REFLECT)
    shift_m = blurred[..., None] * disc.depth_m * _along_ray(cloud, surface_m)
    return replace(cloud, points_m=cloud.points_m + shift_m), tuple(floors)


def _along_ray(cloud: Cloud, surface_m: np.ndarray) -> np.ndarray:
    """Return (h, w, 3): the step along each ray that leads one metre behind the surface, measured
    across it; 0 where the surface is not known."""
    rays, cosines = sight_lines(cloud, surface_m)
    return np.asarray(np.nan_to_num(rays / cosines[..., None]))


def free_area(result: Judged) -> np.ndarray:
    """Return (h, w) bool: judged pixels away from findings."""
    occupied = np.zeros(result.cloud.valid.size, bool)
    for detection in result.detections:
        occupied[detection.pixels] = True
    beside_findings = grown(occupied.reshape(result.cloud.valid.shape), math.ceil(APART_PX / 2))
    return np.isfinite(result.evidence.score) & result.cloud.valid & ~beside_findings


def places_for(result: Judged, free: np.ndarray, disc: Disc, round_number: int = 0) -> np.ndarray:
    """Return the flat indices (n,) of random centres with room for a disc and apart from one
    another; the same at each call with this ``round_number``."""
    radius_px = 0.5 * disc.diameter_m / _pitch_m(result)
    padded = np.pad(free.astype(np.uint8), 1)
    room_px = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    margin_px = radius_px + max(1.0, 0.5 * result.cloud.noise_reach_px)
    candidates = np.flatnonzero(room_px.ravel() > margin_px)
    size = f"{disc.diameter_m / MM:.6f} mm"
    shuffled = random_stream(round_number, "limit", size).permutation(candidates)
    area_px = math.pi * max(radius_px, 0.5) ** 2
    limit = min(MOST_PLACES, max(1, int(MOST_SHARE * free.sum() / area_px)))
    apart_px = 2 * radius_px + APART_PX
    taken: list[tuple[int, int]] = []
    chosen = []
    for pixel in shuffled:
        row, column = divmod(int(pixel), free.shape[1])
        if all(math.hypot(row - v, column - u) >= apart_px for v, u in taken):
            taken.append((row, column))
            chosen.append(int(pixel))
        if len(chosen) == limit:
            break
    return np.array(chosen, int)


def fitted(sizes: Sequence[SizeCount], depth_m: float | None) -> Limit:
    """Fit the share that is found as a function of size."""
    from harness.evaluation.pod import hit_miss

    diameters = np.concatenate([np.full(size.places, size.diameter_mm) for size in sizes])
    hits = np.concatenate([np.arange(size.places) < size.hits for size in sizes])
    depth = "half as deep as wide" if depth_m is None else f"{depth_m / MM:.3g} mm deep"
    a90_mm = math.nan
    bound_mm = math.nan
    if hits.all():
        text = f"all implanted damage {depth} was found, down to {sizes[0].diameter_mm:.2g} mm wide"
    elif not hits.any():
        text = f"no implanted damage {depth} was found, up to {sizes[-1].diameter_mm:.3g} mm wide"
    else:
        try:
            fit = hit_miss.fit_hit_miss(diameters, hits, log_size=True)
        except UserError:
            text = f"implanted damage {depth} is not found more often if it is wider"
        else:
            a90_mm = fit.curve.size_at(WANTED)
            bound_mm = hit_miss.bound(fit).value
            text = _limit_text(depth, a90_mm, bound_mm, sizes[-1].diameter_mm)
    return Limit(tuple(sizes), a90_mm, bound_mm, text)


def _limit_text(depth: str, a90_mm: float, bound_mm: float, largest_mm: float) -> str:
    if a90_mm > largest_mm:
        return (
            f"damage {depth} is not found in 90 % of places up to {largest_mm:.3g} mm wide, the"
            " largest that was implanted"
        )
    bound = "without an upper bound"
    if math.isfinite(bound_mm):
        bound = f"at most {bound_mm:.2g} mm with 95 % confidence"
    return (
        f"damage {depth} is found in 90 % of places from {a90_mm:.2g} mm wide ({bound}); smaller"
        " damage would often have been missed"
    )
