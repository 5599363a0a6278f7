"""Joins slots that repeat: the joints of a brick wall, the vents of a grille.

Long findings of equal direction, width and depth that a move across the surface carries onto one
another are one feature and not as many damages. That they repeat must be significant: the first
pair gives the move, and the others follow it far more often than places at random would. Round
findings are never joined, because drilled holes are what is sought.

Not modelled: slots whose distances vary, such as boards of different widths, and slots on surfaces
that are bent strongly; they remain findings of their own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import special

from detectors.interface import Detection, Evidence, Measurement
from detectors.pixels.masks import grown
from detectors.surfaces.surface import BISQUARE_TUNING, bisquare_weights, polynomial
from harness.vocabulary.geometry import MM, Cloud

LONG = 2.0
"""Least ratio of length to width of a slot."""
ALIKE = 1.5
"""Most ratio of lengths, widths and depths of slots that may belong together, before their scatter
is known."""
FEWEST = 4  # slots of a feature
CHANCE = 1e-3
"""Most probability that slots at random places follow one of the moves that were tried."""
FOLLOWED = 0.5
"""Least share of the places to which a move leads, where they are seen, that hold a slot."""
MOVES = 2  # that carry a lattice onto itself: along its rows and from row to row
STARTS = 12  # strongest slots from which moves are tried
TREND_FROM = 12  # slots from which a trend of their sizes is known: four for each coefficient
SCATTERS = 4.0  # of the others, by which a slot departs that is no longer alike
LEAST_SCATTER = 0.03
"""Least scatter of all that is compared, as a share of what is usual."""
DEEPEST = 0.95  # quantile of the residuals of a slot's pixels that shows damage within it


@dataclass(frozen=True)
class Joints:
    """Slots that repeat."""

    members: tuple[int, ...]
    """Numbers of the detections that are alike, strongest first."""
    differing: tuple[int, ...]
    """Numbers of those in the same rows that depart in width, depth, area, length or deepest
    place."""


@dataclass(frozen=True)
class _Slots:
    """The long findings and the ends of slots, n of them."""

    numbers: np.ndarray
    """(n,): of their detections."""
    centres_m: np.ndarray
    """(n, 3)."""
    along: np.ndarray
    """(n, 3): unit vectors of any sign."""
    lengths_m: np.ndarray
    """(n,)."""
    widths_m: np.ndarray
    """(n,)."""
    depths_m: np.ndarray
    """(n,): positive behind the surface."""
    areas_m2: np.ndarray
    """(n,): across the line of sight, but for a factor common to all of them."""
    errors: np.ndarray
    """(n, 2): standard errors of width and depth, metres; 0 if unknown."""
    deepest_m: np.ndarray
    """(n,): size of the residual at the quantile `DEEPEST` of the pixels."""
    cut: np.ndarray
    """(n,) bool: reaches the rim of the judged area, so that its length is not known."""
    is_long: np.ndarray
    """(n,) bool: is long; else it may be the end of a slot that the rim cuts."""


def joints_of(
    cloud: Cloud,
    evidence: Evidence,
    detections: Sequence[Detection],
    measurements: Sequence[Measurement],
) -> tuple[Joints, ...]:
    """Return the features that long findings form, each finding in one of them at most. There are
    none without a pixel grid."""
    if not cloud.organised:
        return ()
    candidates = _slots(evidence, detections, measurements)
    free = np.ones(len(candidates.numbers), bool)
    features = []
    for seed in range(len(candidates.numbers)):
        slots = _with_ends(candidates, seed)
        if not free[seed] or not slots.is_long[seed]:
            continue
        parallel = _parallel(slots, seed) & free
        similar = parallel & _similar(slots, seed)
        if (similar & slots.is_long).sum() < FEWEST:
            continue
        on_lattice = parallel & _on_lattice(cloud, evidence, slots, similar)
        # uncertain sizes that are far off are no departure
        members = on_lattice & ~_departing(slots, on_lattice & similar)
        if (members & slots.is_long).sum() < FEWEST:
            continue
        free &= ~on_lattice
        differing = tuple(slots.numbers[on_lattice & ~members].tolist())
        features.append(Joints(tuple(slots.numbers[members].tolist()), differing))
    return tuple(features)


def joined(
    detections: Sequence[Detection],
    measurements: Sequence[Measurement],
    features: Sequence[Joints],
    fragments: Sequence[int] = (),
) -> tuple[tuple[Detection, ...], tuple[Measurement, ...]]:
    """Return the findings, strongest first, with each feature as one finding. It has the place and
    the sizes of its strongest member and the pixels of all of them. ``fragments``: numbers of
    findings that are parts of a joint, which are left out."""
    in_feature = {number for feature in features for number in feature.members}
    in_feature.update(fragments)
    pairs = []
    for number, pair in enumerate(zip(detections, measurements, strict=True)):
        if number not in in_feature:
            pairs.append(pair)
    for feature in features:
        members = [detections[number] for number in feature.members]
        strongest = feature.members[0]
        pixels = np.unique(np.concatenate([member.pixels for member in members]))
        detection = replace(detections[strongest], pixels=pixels, count=len(members))
        points = sum(measurements[number].points for number in feature.members)
        pairs.append((detection, replace(measurements[strongest], points=points)))
    pairs.sort(key=lambda pair: -pair[0].score)
    return tuple(pair[0] for pair in pairs), tuple(pair[1] for pair in pairs)


def joints_facts(
    features: Sequence[Joints], measurements: Sequence[Measurement]
) -> list[dict[str, Any]]:
    """Return plain data on each feature: its sizes (medians) and the places of its members."""
    facts = []
    for feature in features:
        members = [measurements[number] for number in feature.members]
        facts.append(
            {
                "count": len(members),
                "differing": len(feature.differing),
                "length_mm": float(np.median([member.length_m for member in members])) / MM,
                "width_mm": float(np.median([member.width_m for member in members])) / MM,
                "depth_mm": float(np.median([member.normal_depth_m for member in members])) / MM,
                "places_px": [[member.u_px, member.v_px] for member in members],
            }
        )
    return facts


def _slots(
    evidence: Evidence,
    detections: Sequence[Detection],
    measurements: Sequence[Measurement],
) -> _Slots:
    """Return the findings by depth whose sizes are known, strongest first, that are long or
    reach the rim."""
    rim = rim_of(evidence).ravel()
    numbers = []
    long = []
    cut = []
    for number, (detection, measured) in enumerate(zip(detections, measurements, strict=True)):
        sizes = (measured.length_m, measured.width_m, measured.normal_depth_m)
        is_known = all(math.isfinite(size) for size in sizes)
        is_long = measured.length_m > LONG * max(measured.width_m, 1.0 * MM)
        is_cut = bool(rim[detection.pixels].any())
        if detection.kind == "depth" and is_known and (is_long or is_cut):
            numbers.append(number)
            long.append(is_long)
            cut.append(is_cut)
    chosen = [measurements[number] for number in numbers]
    sizes_m = np.abs(np.nan_to_num(evidence.residual_m)).ravel()
    deepest_m = [np.quantile(sizes_m[detections[number].pixels], DEEPEST) for number in numbers]
    widths_m = np.array([max(measured.width_m, 1.0 * MM) for measured in chosen])
    diameters_m = np.array([measured.model_diameter_m for measured in chosen])
    diameter_errors_m = np.array([measured.model_diameter_se_m for measured in chosen])
    depth_errors_m = np.array([measured.normal_depth_se_m for measured in chosen])
    depths_m = np.array([measured.normal_depth_m for measured in chosen])
    # blur leaves the volume, so that a narrower slot may be a less deep one
    shares = np.hypot(diameter_errors_m / diameters_m, depth_errors_m / depths_m)
    width_errors_m = widths_m * shares
    centres_m = np.array([_centre(measured) for measured in chosen]).reshape(-1, 3)
    directions = np.array([measured.along for measured in chosen]).reshape(-1, 3)
    points = np.array([measured.points for measured in chosen])
    errors_m = np.column_stack([width_errors_m, depth_errors_m])
    return _Slots(
        numbers=np.array(numbers, np.int64),
        centres_m=centres_m,
        along=directions,
        lengths_m=np.array([measured.length_m for measured in chosen]),
        widths_m=widths_m,
        depths_m=depths_m,
        areas_m2=points * centres_m[:, 2] ** 2,
        errors=np.nan_to_num(errors_m),
        deepest_m=np.array(deepest_m),
        cut=np.array(cut, bool),
        is_long=np.array(long, bool),
    )


def _centre(measured: Measurement) -> np.ndarray:
    if np.isfinite(measured.model_centre_m).all():
        return measured.model_centre_m
    return measured.extent_centre_m


def rim_of(evidence: Evidence) -> np.ndarray:
    """Return (h, w) bool: the pixels beside those that are not judged or not in the picture."""
    outside = np.pad(~np.isfinite(evidence.residual_m), 1, constant_values=True)
    return grown(outside, 1)[1:-1, 1:-1]


def _with_ends(slots: _Slots, seed: int) -> _Slots:
    """Return the slots, of which those at the rim that are less than `LONG` times as long as a seed
    is wide do not count as long: the rim leaves the end of a slot, of any direction and width."""
    is_end = slots.cut & (slots.lengths_m < LONG * slots.widths_m[seed])
    return replace(slots, is_long=slots.is_long & ~is_end)


def _parallel(slots: _Slots, seed: int) -> np.ndarray:
    """Return which slots (n,) run along a seed, as far as their widths let one tell, and are on the
    same side of the surface, and about as long or cut by the rim. An end has no direction."""
    cosines = np.abs(slots.along @ slots.along[seed])
    angles_rad = np.arctan2(slots.widths_m, slots.lengths_m)
    limits_rad = np.maximum(angles_rad, angles_rad[seed])
    same_side = np.sign(slots.depths_m) == np.sign(slots.depths_m[seed])
    ratio = slots.lengths_m / slots.lengths_m[seed]
    as_long = (ratio < ALIKE) & ((ratio > 1.0 / ALIKE) | slots.cut)
    runs_along = (cosines >= np.cos(limits_rad)) | ~slots.is_long
    return runs_along & same_side & as_long


def _similar(slots: _Slots, seed: int) -> np.ndarray:
    """Return which slots (n,) have about the width and depth of a seed. An end has no width."""
    widths = slots.widths_m / slots.widths_m[seed]
    depths = slots.depths_m / slots.depths_m[seed]
    as_wide = (widths < ALIKE) & (widths > 1.0 / ALIKE)
    as_deep = (depths < ALIKE) & (depths > 1.0 / ALIKE)
    return (as_wide | ~slots.is_long) & as_deep


def _departing(slots: _Slots, members: np.ndarray) -> np.ndarray:
    """Return which slots (n,) depart from the members (n,) in width, depth, area, length or deepest
    place by more than these scatter and than what is less certain about them, as about a slot that
    the rim cuts. An end has no width."""
    result = np.zeros(len(slots.numbers), bool)
    certain = members & slots.is_long
    if not certain.any():
        return result
    width_errors_m = slots.errors[:, 0]
    depth_errors_m = slots.errors[:, 1]
    result |= _differs(slots, slots.widths_m, width_errors_m, certain) & slots.is_long
    result |= _differs(slots, slots.depths_m, depth_errors_m, certain)
    # damage that touches a joint is found with it: it shows in the area, or deepens a part of it
    usual_m2 = _usual(slots, slots.areas_m2, certain)
    scatter_m2 = _scatter(slots.areas_m2, usual_m2, certain)
    result |= slots.areas_m2 > usual_m2 + SCATTERS * scatter_m2
    result |= _exceeds(slots, slots.deepest_m, certain)
    # at the end of a joint, where it is no wider, it shows in the length
    whole = certain & ~slots.cut
    if whole.any():
        result |= ~slots.cut & slots.is_long & _exceeds(slots, slots.lengths_m, whole)
    # less of it leaves an error that no slot explains; alone, that is a fit that was not determined
    is_larger = slots.areas_m2 > usual_m2 + scatter_m2
    result |= ~slots.cut & is_larger & _exceeds(slots, width_errors_m, certain)
    return result


def _differs(
    slots: _Slots,
    sizes_m: np.ndarray,
    errors_m: np.ndarray,
    certain: np.ndarray,
) -> np.ndarray:
    """Return which sizes (n,) differ from the usual ones by more than `SCATTERS` times both the
    scatter of the ``certain`` ones and what their own errors (n,) have beyond the usual error."""
    usual_m = _usual(slots, sizes_m, certain)
    scatter_m = _scatter(sizes_m, usual_m, certain)
    usual_error_m = float(np.median(errors_m[certain]))
    excess_m = np.sqrt(np.maximum(errors_m**2 - usual_error_m**2, 0.0))
    limit_m = SCATTERS * np.hypot(scatter_m, excess_m)
    return np.asarray(np.abs(sizes_m - usual_m) > limit_m)


def _exceeds(slots: _Slots, sizes_m: np.ndarray, certain: np.ndarray) -> np.ndarray:
    """Return which sizes (n,) exceed the usual ones by more than `SCATTERS` times the scatter of
    the ``certain`` ones."""
    usual_m = _usual(slots, sizes_m, certain)
    scatter_m = _scatter(sizes_m, usual_m, certain)
    return np.asarray(sizes_m > usual_m + SCATTERS * scatter_m)


def _usual(slots: _Slots, sizes: np.ndarray, certain: np.ndarray) -> np.ndarray:
    """Return the size (n,) that is usual at the place of each slot, from the ``certain`` ones (n,):
    what a camera sees of slots that are alike changes steadily across its picture. If fewer than
    `TREND_FROM` are certain, it is the same everywhere."""
    if certain.sum() < TREND_FROM:
        return np.full(len(sizes), float(np.median(sizes[certain])))
    points = np.column_stack([slots.centres_m[:, :2], sizes])
    weights = certain.astype(float)
    for _ in range(3):
        usual = np.asarray(polynomial(points, weights, degree=1)(points))
        residuals = sizes - usual
        scatter = max(float(np.median(np.abs(residuals[certain]))) / 0.6745, 1e-9)
        weights = certain * bisquare_weights(residuals, BISQUARE_TUNING * scatter)
    return usual


def _scatter(sizes: np.ndarray, usual: np.ndarray, certain: np.ndarray) -> np.ndarray:
    """Return the scatter (n,) of the ``certain`` sizes about their ``usual`` ones, at least
    `LEAST_SCATTER` of these."""
    scatter = float(np.median(np.abs(sizes - usual)[certain])) / 0.6745
    return np.maximum(scatter, LEAST_SCATTER * np.abs(usual))


def chance_of_following(hits: int, trials: int, chance: float) -> float:
    """Return the probability that a move leads to ``hits`` slots or more in as many ``trials``, if
    a slot lies at the end of each with the probability ``chance``. The first pair gives the move
    and proves nothing, so it is left out of both numbers."""
    return float(special.bdtrc(hits - 2, trials - 1, chance))


def plane_along(along: np.ndarray, sight_m: np.ndarray) -> np.ndarray:
    """Return two directions (3, 2) in which places on a surface are counted: ``along`` a slot, and
    across it and the line of sight (3,)."""
    across = np.cross(along, sight_m)
    return np.column_stack([along, across / np.linalg.norm(across)])


def _on_lattice(
    cloud: Cloud,
    evidence: Evidence,
    slots: _Slots,
    similar: np.ndarray,
) -> np.ndarray:
    """Return which slots (n,) the significant moves between ``similar`` slots carry onto one."""
    similar = similar & slots.is_long
    first = int(np.flatnonzero(similar)[0])
    plane = plane_along(slots.along[first], slots.centres_m[similar].mean(axis=0))
    centres_on_plane_m = slots.centres_m @ plane
    reach_m = np.full(centres_on_plane_m.shape, float(np.median(slots.widths_m[similar])))
    # the centre of a slot that the rim cuts lies up to half its length from the middle
    reach_m[slots.cut, 0] = 0.5 * float(slots.lengths_m[similar].max())

    judged = np.isfinite(evidence.residual_m)
    pixel_of = _pixel_map(cloud.points_m[judged] @ plane, judged)
    pixels_per_m2 = abs(float(np.linalg.det(pixel_of[:2])))
    area_m2 = float(judged.sum()) / max(pixels_per_m2, 1e-12)
    chance = min(float(4.0 * reach_m[similar].prod(axis=1).sum()) / area_m2, 1.0)
    pairs = _pairs(similar)
    moves: list[np.ndarray] = []
    for _ in range(MOVES):
        most_hits = 0
        best_move = None
        for start, end in pairs:
            move = centres_on_plane_m[end] - centres_on_plane_m[start]
            linked = _linked(centres_on_plane_m, reach_m, similar, move)[similar]
            hits = int(linked.sum())
            if hits <= most_hits or _is_along(move, moves, float(reach_m[first, 1])):
                continue
            is_judged = _are_judged(centres_on_plane_m[similar] + move, pixel_of, judged)
            trials = int((is_judged | linked).sum())
            probability = chance_of_following(hits, trials, chance)
            if hits >= FOLLOWED * trials and probability * len(pairs) < CHANCE:
                most_hits = hits
                best_move = move
        if best_move is None:
            break
        moves.append(best_move)
    if len(moves) == 2:
        moves += [moves[0] + moves[1], moves[0] - moves[1]]
    result = np.zeros(len(similar), bool)
    for move in moves:
        result |= _linked(centres_on_plane_m, reach_m, similar, move)
        result |= _linked(centres_on_plane_m, reach_m, similar, -move)
    return result


def _pairs(similar: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs between which moves are tried: from the strongest of the slots (n,)."""
    ends = np.flatnonzero(similar).tolist()
    return [(start, end) for start in ends[:STARTS] for end in ends if start != end]


def _is_along(move: np.ndarray, moves: Sequence[np.ndarray], reach_m: float) -> bool:
    """Return whether a move runs along one of the ``moves``, to ``reach_m`` across it."""
    for earlier in moves:
        area_m2 = abs(float(move[0] * earlier[1] - move[1] * earlier[0]))
        if area_m2 / float(np.linalg.norm(earlier)) <= reach_m:
            return True
    return False


def _linked(
    places: np.ndarray, reach_m: np.ndarray, similar: np.ndarray, move: np.ndarray
) -> np.ndarray:
    """Return which places (n, 2) a move (2,) carries near a ``similar`` one (n,)."""
    off_m = np.abs(places[:, None] + move - places[None, similar])
    limit_m = np.maximum(reach_m[:, None], reach_m[None, similar])
    return np.asarray((off_m <= limit_m).all(axis=2).any(axis=1))


def _pixel_map(places: np.ndarray, judged: np.ndarray) -> np.ndarray:
    """Return the affine map (3, 2) from places (n, 2) of the ``judged`` pixels (h, w) to columns
    and rows: enough to tell whether a place is in the picture."""
    rows, columns = np.nonzero(judged)
    design = np.column_stack([places, np.ones(len(places))])
    return np.linalg.lstsq(design, np.column_stack([columns, rows]), rcond=None)[0]


def _are_judged(places: np.ndarray, pixel_of: np.ndarray, judged: np.ndarray) -> np.ndarray:
    """Return which places (n, 2) are judged."""
    pixels = np.rint(places @ pixel_of[:2] + pixel_of[2]).astype(int)
    inside = ((pixels >= 0) & (pixels < judged.shape[::-1])).all(axis=1)
    result = np.zeros(len(places), bool)
    result[inside] = judged[pixels[inside, 1], pixels[inside, 0]]
    return result
