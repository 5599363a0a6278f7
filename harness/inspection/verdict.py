"""The verdict of an inspection: class, flags and name of each finding, how much of the part was
judged, and the sentence that answers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage

from detectors.interface import Detection, Evidence, MissingReturns
from detectors.pixels.masks import holes_filled
from detectors.pixels.noise import noise_sides_at
from harness.report.findings import Finding, Judged, Remark
from harness.vocabulary.geometry import MM, Cloud
from harness.vocabulary.text import joined_words

SURE = "sure"
DOUBTFUL = "doubtful"
RIM_OR_BLIND = "rim or blind"
FEATURE = "feature"
CLASSES = {
    SURE: "each is a false call with a probability below 0.05; where this is unknown, its score is"
    " at least 1.5 times the threshold",
    DOUBTFUL: "noise, or what an object or print makes of the distance, may explain them, also at"
    " the rim",
    RIM_OR_BLIND: "the rest of them lies outside the judged area, or no light came back",
    FEATURE: "slots that repeat across the part, such as joints: no damage",
}
"""The classes of findings, with their meaning."""
FLAGS = {
    "faint": "noise, or what an object or print makes of the distance, may explain it",
    "at_rim": "reaches the rim of the judged area, or to within half of the camera's blur: may be"
    " larger than stated",
    "open_behind": "shows what lies far behind, or nothing: may be wider than stated by up to the"
    " noise's reach, where the camera's filter mixes the rim with what is behind",
    "size_from_contour": "no shape fits: its diameter is that of its outline at half depth",
    "size_from_extent": "no shape was fitted: its diameter is that of its outermost points",
    "depth_at_least": "so narrow that the camera's blur hides its floor: may be deeper than stated",
    "depth_from_extreme": "its depth is that of its deepest point, which noise makes deeper",
    "depth_open": "its depth's standard error is more than a third of it: the blur hides how deep"
    " it is",
}
"""The flags of findings, with their meaning."""
OPEN_DEPTH = 1.0 / 3.0
"""Standard error of a depth, as a share of it, from which the depth is open: it may then be a
third of what is stated, or nearly twice as much."""
MOST_NOISE = 0.05
"""Probability of a false call from which a finding is doubtful. Each sure finding is real with at
least 95 %, so that fewer than one in 20 of them are expected to be false, however many there are.
"""
CLEAR_RATIO = 1.5
"""Ratio of score to threshold from which a finding with unknown odds is not faint. At 1.5 times a
threshold of 5, normal noise is rarer by a factor of exp(15.6), and noise that falls like
exp(-score) by exp(2.5)."""
OPEN_MM = 75.0
"""Depth beyond which a hole shows objects far behind it."""
RIM_DEPTH_PX = 1.5
"""Depth of the pixels that touch the rim, by a side or by a corner."""
DENT_RATIO = 0.25
"""A dent is less deep than this share of its width; a hemisphere has 0.5."""
FLOOR_FILTERS = 3.0
"""Widths of the camera's filter in a damage whose floor is seen: one on each side is the blurred
rim, and one remains between them."""
LEAST_FILTER_PX = 2.0
"""Width of the lens' blur, with which a camera without a filter is counted."""

POINTS_IN_SQUARE = 6
"""Mean number of points in a square of the plan view that measures a cloud without a grid: a
random cloud leaves exp(-6) of them empty."""

# ---------------------------------------------------------------- each finding


def with_remarks(result: Judged, threshold: float) -> Judged:
    """Give each finding its class, its flags and its term. ``threshold``: units of score."""
    bare = replace(result, remarks=())
    least_score = CLEAR_RATIO * threshold
    cut = _cut_by_the_rim(result.cloud, result.evidence, result.detections)
    floor_mm = least_floor_mm(result.cloud, result.evidence)
    remarks = []
    for finding, is_cut in zip(bare.findings, cut, strict=True):
        # the sizes of joints are those of one of them, which the rim need not cut
        is_cut = is_cut and finding.count == 1
        flags = flags_of(finding, is_cut=is_cut, least_score=least_score)
        term = term_of(finding, floor_mm)
        remarks.append(Remark(certainty=class_of(finding, flags), flags=" ".join(flags), term=term))
    return replace(result, remarks=tuple(remarks))


def flags_of(finding: Finding, *, is_cut: bool, least_score: float) -> tuple[str, ...]:
    """Return the flags of a finding. ``is_cut``: it reaches the rim; ``least_score``: a finding
    with unknown odds and a lower score is faint."""
    present = {
        "faint": is_faint(finding, least_score),
        "at_rim": is_cut,
        "open_behind": finding.kind == "no return" or finding.depth_mm > OPEN_MM,
        "size_from_contour": finding.size_from == "contour",
        "size_from_extent": finding.size_from == "extent",
        "depth_at_least": finding.depth_is_least,
        "depth_from_extreme": finding.depth_from == "extreme residual",
        "depth_open": finding.depth_se_mm > OPEN_DEPTH * abs(finding.depth_mm),
    }
    return tuple(flag for flag in FLAGS if present[flag])


def is_faint(finding: Finding, least_score: float) -> bool:
    """Return whether noise may explain a finding. Missing returns have their own law of chance,
    which makes them findings only where chance expects 0.01 of them in a capture."""
    if finding.kind == "no return":
        return False
    if math.isnan(finding.noise_probability):
        return finding.score < least_score
    return finding.noise_probability >= MOST_NOISE


def class_of(finding: Finding, flags: Sequence[str]) -> str:
    """Return the class of a finding with these flags."""
    if finding.count > 1:
        return FEATURE
    if "faint" in flags:
        return DOUBTFUL
    if "at_rim" in flags or finding.kind == "no return":
        return RIM_OR_BLIND
    return SURE


def term_of(finding: Finding, floor_mm: float) -> str:
    """Return the name of what was found. ``floor_mm``: the least width at which a floor is seen."""
    if finding.count > 1:
        return JOINTS
    if finding.kind != "hole":
        return finding.kind
    if finding.is_long or finding.shape == "slot":
        return "slot"
    if not finding.depth_mm < DENT_RATIO * finding.diameter_mm:
        return "hole"
    return "dent" if finding.diameter_mm >= floor_mm else "hole or dent"


def least_floor_mm(cloud: Cloud, evidence: Evidence) -> float:
    """Return the width of damage whose floor the camera's filter leaves visible; 0 without a pixel
    grid, where no filter is known."""
    if not cloud.organised:
        return 0.0
    filter_px = max(cloud.noise_reach_px, LEAST_FILTER_PX)
    return FLOOR_FILTERS * filter_px * pitch_mm(cloud, evidence)


def pitch_mm(cloud: Cloud, evidence: Evidence) -> float:
    """Return the typical distance in x between neighbours in a row of the judged area; NaN if no
    pixel has a neighbour."""
    is_judged = np.isfinite(evidence.residual_m)
    x_m = np.where(is_judged, surface_points_m(cloud, evidence.surface_z_m)[..., 0], np.nan)
    steps_m = np.abs(np.diff(x_m, axis=1))
    finite_m = steps_m[np.isfinite(steps_m)]
    return float(np.median(finite_m)) / MM if len(finite_m) else math.nan


def _cut_by_the_rim(
    cloud: Cloud, evidence: Evidence, detections: Sequence[Detection]
) -> tuple[bool, ...]:
    """Return whether each detection reaches the rim of the judged area, or lies so near that the
    camera's blur, which carries it half of its width beyond what is seen, reaches it: the rest of
    it may not have been seen. All False without a pixel grid."""
    if not cloud.organised:
        return (False,) * len(detections)
    is_judged = holes_filled(np.isfinite(evidence.residual_m))
    # the picture's own edge is a rim too
    padded = np.pad(is_judged, 1)
    depths_px = ndimage.distance_transform_edt(padded)[1:-1, 1:-1].ravel()
    return tuple(_is_cut(cloud, detection, depths_px) for detection in detections)


def _is_cut(cloud: Cloud, detection: Detection, depths_px: np.ndarray) -> bool:
    """Return whether a detection's pixel that is nearest to the rim lies within half of the blur
    there. ``depths_px``: flat, distance of each pixel to the rim, 1 for those along it."""
    depths_of_detection_px = depths_px[detection.pixels]
    outermost = int(detection.pixels[np.argmin(depths_of_detection_px)])
    row, column = divmod(outermost, cloud.points_m.shape[1])
    half_blur_px = 0.5 * max(noise_sides_at(cloud, row, column))
    return bool(depths_px[outermost] <= max(half_blur_px, RIM_DEPTH_PX))


# ---------------------------------------------------------------- what was judged


@dataclass(frozen=True)
class Extent:
    """The judged part of a target; NaN where it is unknown."""

    judged_m2: float
    """Area of the fitted surface at the pixels that were judged."""
    judged_share: float
    """Share of the part's outline that was judged."""
    blind_m2: float
    """Area inside the outline from which no light came back."""


def extent_of(result: Judged, outline: np.ndarray | None) -> Extent:
    """Return how much was judged. ``outline`` (h, w) bool: the part, or None if it was not sought;
    then the outline of the judged area takes its place."""
    areas_m2, typical_m2 = filled_areas_m2(result.cloud, result.evidence)
    is_judged = np.isfinite(result.evidence.residual_m)
    judged_m2 = float(areas_m2[is_judged].sum())
    part = outline
    if part is None and result.missing is not None:
        part = result.missing.outline
    share = math.nan
    if part is not None and part.shape == is_judged.shape:
        share = float((is_judged & part).sum() / max(part.sum(), 1))
    return Extent(judged_m2, share, _blind_m2(result.missing, typical_m2))


def filled_areas_m2(cloud: Cloud, evidence: Evidence) -> tuple[np.ndarray, float]:
    """Return the area of the surface that each pixel sees, and the median over judged pixels, which
    stands for pixels where the surface is not known; NaN if nothing is judged."""
    areas_m2 = pixel_areas_m2(cloud, evidence.surface_z_m)
    has_area = np.isfinite(areas_m2)
    areas_of_judged_m2 = areas_m2[has_area & np.isfinite(evidence.residual_m)]
    typical_m2 = math.nan
    if areas_of_judged_m2.size:
        typical_m2 = float(np.median(areas_of_judged_m2))
    filled_m2 = np.where(has_area, areas_m2, typical_m2)
    return filled_m2, typical_m2


def _blind_m2(missing: MissingReturns | None, pixel_m2: float) -> float:
    if missing is None:
        return math.nan
    return float(missing.blind * missing.outline.sum() * pixel_m2)


def pixel_areas_m2(cloud: Cloud, surface_z_m: np.ndarray) -> np.ndarray:
    """Return (h, w): the area of the fitted surface that each pixel sees, NaN where neither
    neighbour is known. Without a pixel grid it is the area of the cloud's plan view in x and y,
    spread over its points: the surface's slope is not counted."""
    surface_m = surface_points_m(cloud, surface_z_m)
    if not cloud.organised:
        return _plan_areas_m2(surface_m)
    along_row, along_column = surface_steps_m(surface_m)
    return np.asarray(np.linalg.norm(np.cross(along_row, along_column), axis=-1))


def surface_points_m(cloud: Cloud, surface_z_m: np.ndarray) -> np.ndarray:
    """Return (h, w, 3): where each pixel's ray meets the fitted surface."""
    across_m = cloud.points_m[..., :2]
    if cloud.projection == "central":
        across_m = across_m * (surface_z_m / cloud.points_m[..., 2])[..., None]
    return np.concatenate([across_m, surface_z_m[..., None]], axis=-1)


def sight_lines(cloud: Cloud, surface_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rays (h, w, 3), one metre along z, and their cosines (h, w) with the normals of
    the surface, times their length; NaN where the surface is not known."""
    rays = np.zeros_like(surface_m)
    rays[..., 2] = 1.0
    if cloud.projection == "central":
        rays = surface_m / surface_m[..., 2:]
    along_row, along_column = surface_steps_m(surface_m)
    normals = np.cross(along_row, along_column)
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    return rays, np.abs((normals * rays).sum(axis=-1))


def surface_steps_m(surface_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps (h, w, 3) to the neighbours along the row and along the column."""
    return _neighbour_steps(surface_m, axis=1), _neighbour_steps(surface_m, axis=0)


def _neighbour_steps(surface_m: np.ndarray, axis: int) -> np.ndarray:
    """Return (h, w, 3): the step to the next pixel, or else from the one before."""
    steps = np.full_like(surface_m, np.nan)
    between = np.diff(surface_m, axis=axis)
    later = [slice(None)] * 3
    earlier = [slice(None)] * 3
    later[axis] = slice(1, None)
    earlier[axis] = slice(None, -1)
    steps[tuple(later)] = between
    is_finite = np.isfinite(between).all(axis=-1)
    steps[tuple(earlier)][is_finite] = between[is_finite]
    return steps


def _plan_areas_m2(surface_m: np.ndarray) -> np.ndarray:
    """Return (h, w): the area of occupied squares of a plan view, spread evenly over the points.

    The squares hold about `POINTS_IN_SQUARE` points, so that few inside the cloud are empty."""
    areas = np.full(surface_m.shape[:2], np.nan)
    is_finite = np.isfinite(surface_m).all(axis=-1)
    plan_m = surface_m[is_finite][:, :2]
    if len(plan_m) < 2 * POINTS_IN_SQUARE:
        return areas
    box_m2 = float(np.prod(np.ptp(plan_m, axis=0)))
    side_m = math.sqrt(max(box_m2, 1e-12) * POINTS_IN_SQUARE / len(plan_m))
    squares = np.unique(np.floor((plan_m - plan_m.min(axis=0)) / side_m), axis=0)
    areas[is_finite] = len(squares) * side_m**2 / len(plan_m)
    return areas


# ---------------------------------------------------------------- the sentence

WORDS = (
    "no",
    "one",
    "two",
    "three",
    "four",
    "five",
    "six",
    "seven",
    "eight",
    "nine",
    "ten",
    "eleven",
    "twelve",
)
PLURALS = {
    "hole": "holes",
    "slot": "slots",
    "dent": "dents",
    "hole or dent": "small holes or dents",
    "bump": "bumps",
}
"""Terms of findings that can be sure, in the order of the sentence."""
SINGULARS = {"hole or dent": "small hole or dent"}
JOINTS = "joints"
"""Term of slots that repeat: a feature of the part and no damage."""


@dataclass(frozen=True)
class FalseCalls:
    """The false calls that the capture's own null predicts; NaN where it set no threshold."""

    expected: float
    """Their expected number."""
    fewest: float
    """Lower end of the 95 % interval of their number."""
    most: float
    """Upper end of it."""

    @property
    def text(self) -> str:
        """Return ``1.0 false calls expected (0 to 4)``."""
        if math.isnan(self.expected):
            return "the number of false calls is unknown"
        interval = f"({self.fewest:.0f} to {self.most:.0f})"
        return f"{calls_text(self.expected)} false calls expected {interval}"


@dataclass(frozen=True)
class InspectionVerdict:
    """The answer of an inspection."""

    sentence: str
    """It in one sentence."""
    counts: dict[str, int]
    """Number of findings by class; features of the part only where there are any."""
    sure_terms: dict[str, int]
    """Number of sure findings by term."""
    extent: Extent
    calls: FalseCalls
    """False calls in the capture."""
    expected_false_sure: float
    """Number of sure findings that are expected to be false, the sum of their probabilities; NaN
    where these are unknown."""

    @property
    def facts(self) -> dict[str, Any]:
        """Return it as plain data, for the JSON."""
        return {
            "sentence": self.sentence,
            "counts": self.counts,
            "sure": self.sure_terms,
            "judged_area_m2": self.extent.judged_m2,
            "judged_share_of_outline": self.extent.judged_share,
            "blind_area_m2": self.extent.blind_m2,
            "expected_false_calls": self.calls.expected,
            "fewest_false_calls": self.calls.fewest,
            "most_false_calls": self.calls.most,
            "expected_false_sure": self.expected_false_sure,
        }


def verdict_of(
    result: Judged, threshold: float, outline: np.ndarray | None = None
) -> InspectionVerdict:
    """Return the answer. ``outline``: see `extent_of`."""
    findings = result.findings
    counts = {SURE: 0, DOUBTFUL: 0, RIM_OR_BLIND: 0}
    terms: dict[str, int] = {}
    false_sure = 0.0
    for finding in findings:
        counts[finding.certainty] = counts.get(finding.certainty, 0) + 1
        if finding.certainty == SURE:
            terms[finding.term] = terms.get(finding.term, 0) + 1
            false_sure += finding.noise_probability
    extent = extent_of(result, outline)
    calls = calls_of(result.evidence, threshold)
    damage = [finding for finding in findings if finding.certainty != FEATURE]
    clauses = [_sure_clause(terms, extent, is_empty=not damage)]
    clauses += _other_clauses(damage, is_further=bool(terms))
    clauses += _joints_clauses(result.evidence.notes.get("joints", ()))
    clauses += _steps_clauses(result.evidence.notes.get("at_steps", 0))
    clauses.append(_calls_clause(calls, false_sure if terms else math.nan))
    return InspectionVerdict(
        sentence="; ".join(clauses) + ".",
        counts=counts,
        sure_terms=terms,
        extent=extent,
        calls=calls,
        expected_false_sure=false_sure,
    )


def calls_of(evidence: Evidence, threshold: float) -> FalseCalls:
    """Return the false calls at the threshold; unknown unless the capture set it."""
    null = evidence.notes.get("own_null", {"threshold": None})
    if threshold != null["threshold"]:
        return FalseCalls(math.nan, math.nan, math.nan)
    return FalseCalls(expected=null["expected"], fewest=null["low"], most=null["high"])


def _sure_clause(terms: dict[str, int], extent: Extent, *, is_empty: bool) -> str:
    """Return the first clause. ``is_empty``: there is no damage of any class."""
    counted = []
    for term in PLURALS:
        if terms.get(term):
            counted.append(counted_text(terms[term], term))
    start = "no damage is sure"
    if is_empty:
        start = "no damage found"
    if counted:
        start = f"{joined_words(counted)} found"
    return f"{start[0].upper()}{start[1:]} on {extent_text(extent)}the part"


def counted_text(count: int, term: str) -> str:
    """Return ``three holes``, ``one dent``, ``44 bumps``."""
    word = WORDS[count] if count < len(WORDS) else str(count)
    name = SINGULARS.get(term, term) if count == 1 else PLURALS[term]
    return f"{word} {name}"


def extent_text(extent: Extent) -> str:
    """Return ``0.12 m2, 97 % of ``, with as much as is known of how much was judged; empty where
    nothing is."""
    parts = []
    if math.isfinite(extent.judged_m2) and extent.judged_m2 > 0:
        parts.append(area_text(extent.judged_m2))
    if math.isfinite(extent.judged_share):
        parts.append(f"{100.0 * extent.judged_share:.0f} %")
    return f"{', '.join(parts)} of " if parts else ""


def area_text(area_m2: float) -> str:
    """Return ``0.12 m2`` or ``45 cm2``."""
    if area_m2 < 0.01:
        return f"{1e4 * area_m2:.2g} cm2"
    return f"{area_m2:.2g} m2"


def _other_clauses(findings: Sequence[Finding], *, is_further: bool) -> list[str]:
    """Return a clause for the doubtful findings, for those at the rim and for those without a
    return, if there are any."""
    doubtful = 0
    cut = 0
    blind = 0
    for finding in findings:
        doubtful += finding.certainty == DOUBTFUL
        if finding.certainty == RIM_OR_BLIND:
            blind += finding.kind == "no return"
            cut += finding.kind != "no return"
    clauses: list[str] = []
    for count, singular, plural in (
        (doubtful, "is doubtful", "are doubtful"),
        (cut, "is cut by the rim", "are cut by the rim"),
        (blind, "returned no light", "returned no light"),
    ):
        if count:
            word = WORDS[count] if count < len(WORDS) else str(count)
            adjective = " further" if is_further and not clauses else ""
            noun = "place" if count == 1 else "places"
            clauses.append(f"{word}{adjective} {noun} {singular if count == 1 else plural}")
    return clauses


def _joints_clauses(joints: Sequence[dict[str, Any]]) -> list[str]:
    """Return a clause for each set of joints (`detectors.findings.joints.joints_facts`)."""
    clauses = []
    for facts in joints:
        size = f"{facts['length_mm']:.0f} x {facts['width_mm']:.0f} mm"
        differing = facts["differing"]
        count = facts["count"] + differing
        clause = f"{count} joints of {size} in rows, "
        if not differing:
            clause += "all alike"
        else:
            word = WORDS[differing] if differing < len(WORDS) else str(differing)
            clause += f"{word} differs" if differing == 1 else f"{word} differ"
        clauses.append(clause)
    return clauses


def _steps_clauses(count: int) -> list[str]:
    """Return a clause on the places that a profile's steps explain, if there are any
    (`detectors.findings.steps`)."""
    if not count:
        return []
    word = WORDS[count] if count < len(WORDS) else str(count)
    places = "place departs" if count == 1 else "places depart"
    return [f"{word} {places} no more than the profile is uncertain at its steps"]


def _calls_clause(calls: FalseCalls, false_sure: float) -> str:
    """Return the clause on false calls. ``false_sure``: those expected among the sure findings; NaN
    if there are none."""
    if math.isnan(calls.expected) or math.isnan(false_sure):
        return calls.text
    return f"{calls.text}, {calls_text(false_sure)} of them among the sure ones"


def calls_text(expected: float) -> str:
    """Return a number of false calls with a digit that means something; 0 below 1e-4. NaN is
    ``unknown``."""
    if math.isnan(expected):
        return "unknown"
    if expected >= 0.1:
        return f"{expected:.1f}"
    if expected >= 1e-4:
        return f"{expected:.1g}"
    return "0"
