"""Decisions on tolerances: a finding and the part conform, do not conform, or nobody can tell.

A measured size is accepted below the limit less a guard band, and rejected above the limit plus
the guard band (ISO 14253-1). The band is the one-sided quantile of the combined standard
uncertainty, the root sum of squares of its contributions (GUM, JCGM 100, 5.1.2), so that a size at
the limit is accepted, and one is rejected, with a probability of at most `RISK` each.

The deviation from the drawing is that of the place that deviates most, averaged over a window; its
noise counts as that of the largest of all windows, by Bonferroni's inequality. Damage is not
sought for it: the whole surface is measured.

Not modelled: contributions that are not normal, and correlations between them. An error of scale
of the lens is not in a width or volume (measure a gauge to know it), and errors of range that vary
over the part are not in a deviation (a flat field removes a unit's)."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from scipy.stats import norm

from detectors.findings.family import DEPTH_ERROR
from detectors.interface import Detection, Detector
from detectors.pixels.noise import sigma_of
from harness.inspection.changes import GONE, SHRUNK, Changes
from harness.inspection.limit import Limit, SizeCount, found_at, limit_of
from harness.inspection.verdict import (
    DOUBTFUL,
    FEATURE,
    filled_areas_m2,
    sight_lines,
    surface_points_m,
)
from harness.report.findings import Finding, Judged
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud
from harness.vocabulary.meshes import UNITS_M
from harness.vocabulary.program import length_m
from harness.vocabulary.text import joined_words

CONFORMS = "conforms"
FAILS = "does not conform"
UNDECIDED = "undecided"
DECISIONS = (FAILS, UNDECIDED, CONFORMS)
"""The decisions, of which the first that a finding has is that of the part."""
RISK = 0.05
"""Largest probability of a wrong acceptance, and of a wrong rejection, of a size at the limit: the
default of ISO 14253-1."""
GUARD = float(norm.ppf(1.0 - RISK))
"""Standard uncertainties in the guard band."""
KINDS = {"depth": "mm", "width": "mm", "volume": "mm3", "deviation": "mm"}
"""What may be limited, with the unit of its limit."""
SEARCHED = ("depth", "width")
"""Sizes of the damage that is pressed into the cloud, to see what would have been missed."""
LEGAL = "depth=0.5mm, width=4mm, volume=50mm3 or deviation=1mm, once each"
WINDOW_PX = 5
"""Side of the window over which a deviation is averaged."""
THE_PART = 0
"""Number that stands for the part as a whole among those of findings."""


@dataclass(frozen=True)
class Tolerance:
    """The largest size that damage may have."""

    kind: str
    """One of `KINDS`; a depth may be that of a hole or the height of a bump."""
    limit: float
    """In the unit of its kind."""

    @property
    def text(self) -> str:
        """Return ``depth of at most 0.5 mm``."""
        origin = " from the drawing" if self.kind == "deviation" else ""
        return f"{self.kind}{origin} of at most {self.limit:g} {KINDS[self.kind]}"


def tolerances_from(texts: Sequence[str], *, has_drawing: bool) -> tuple[Tolerance, ...]:
    """Return the tolerances of --tolerance. ``has_drawing``: a drawing is the reference. Raises
    UserError."""
    tolerances: list[Tolerance] = []
    for text in texts:
        kind, equals, size = text.partition("=")
        if kind not in KINDS or not equals:
            raise UserError(f"--tolerance {text}: is no tolerance", legal=LEGAL)
        if kind in [tolerance.kind for tolerance in tolerances]:
            raise UserError(f"--tolerance {text}: {kind} is stated twice", legal=LEGAL)
        if kind == "deviation" and not has_drawing:
            raise UserError(
                f"--tolerance {text}: without a drawing nothing deviates from it",
                fix="name the drawing with --reference part.stl",
            )
        if kind == "volume":
            limit = _volume_mm3(size)
        else:
            limit = length_m(f"--tolerance {kind}", size) / MM
        tolerances.append(Tolerance(kind, limit))
    return tuple(tolerances)


def _volume_mm3(text: str) -> float:
    """Convert a volume with its unit. Raises UserError."""
    match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*([a-z]+)3\s*", text)
    if match is None or match[2] not in UNITS_M or not float(match[1]) > 0:
        raise UserError(
            f"--tolerance volume {text}: is not a volume with a unit",
            legal="such as 50mm3, 0.5cm3 or 0.1in3",
        )
    return float(match[1]) * (UNITS_M[match[2]] / MM) ** 3


@dataclass(frozen=True)
class Contribution:
    """A part of a standard uncertainty."""

    name: str
    """Where it comes from, in words."""
    size: float
    """In the unit of the tolerance."""


@dataclass(frozen=True)
class FindingDecision:
    """The decision on one finding by one tolerance; sizes are in its unit."""

    id: int
    """Its number, or `THE_PART`."""
    kind: str
    """The tolerance's."""
    value: float
    """The measured size."""
    contributions: tuple[Contribution, ...]
    """Of its standard uncertainty; empty if that is unknown."""
    uncertainty: float
    """Combined standard uncertainty; NaN if it is unknown."""
    decision: str
    """One of `DECISIONS`."""
    reason: str
    """Why nobody can tell although the guard band would; else empty."""

    @property
    def guard(self) -> float:
        """The guard band."""
        return GUARD * self.uncertainty

    @property
    def place(self) -> str:
        """Return the finding's number, or ``part``."""
        return "part" if self.id == THE_PART else str(self.id)


def combined(contributions: Sequence[Contribution]) -> float:
    """Return the combined standard uncertainty; NaN without contributions."""
    if not contributions:
        return math.nan
    return math.hypot(*(contribution.size for contribution in contributions))


def decided(value: float, guard: float, limit: float) -> str:
    """Return the decision on a size by the guard band on either side of its limit."""
    if value + guard <= limit:
        return CONFORMS
    if value - guard > limit:
        return FAILS
    return UNDECIDED


@dataclass(frozen=True)
class Missed:
    """The damage that an inspection would have missed at its tolerances."""

    text: str
    """In words, or why it is not known."""
    limit: Limit | None = None
    """Widths at which damage as deep as the tolerance is found; None if they are not known."""
    at_both: SizeCount | None = None
    """Damage as deep and as wide as both tolerances; None unless both are stated."""
    is_irrelevant: bool = False
    """True if the tolerances limit no damage."""

    @property
    def is_enough(self) -> bool:
        """True if finding nothing says something: damage at both tolerances is missed no more often
        than `RISK`, or the width from which damage is found is bounded."""
        if self.is_irrelevant:
            return True
        if self.at_both is not None:
            return self.at_both.hits >= (1.0 - RISK) * self.at_both.places
        return self.limit is not None and math.isfinite(self.limit.bound_mm)


def missed_at(
    detector: Detector, result: Judged, threshold: float, tolerances: Sequence[Tolerance]
) -> Missed:
    """Press damage at the tolerances into a judged cloud, and count what is found."""
    if all(tolerance.kind == "deviation" for tolerance in tolerances):
        return Missed(_compared_text(result), is_irrelevant=True)
    sizes_m = {}
    for tolerance in tolerances:
        if tolerance.kind in SEARCHED:
            sizes_m[tolerance.kind] = tolerance.limit * MM
    try:
        limit = limit_of(detector, result, threshold, sizes_m.get("depth"))
        at_both = None
        if len(sizes_m) == len(SEARCHED):
            at_both = found_at(
                detector,
                result,
                threshold,
                diameter_m=sizes_m["width"],
                depth_m=sizes_m["depth"],
            )
    except UserError as mistake:
        return Missed(f"what would have been missed is not known ({mistake.message})")
    if at_both is None:
        return Missed(limit.text, limit)
    share = at_both.hits / at_both.places
    text = (
        f"a dent {at_both.depth_mm:.3g} mm deep and {at_both.diameter_mm:.3g} mm wide is found with"
        f" probability {share:.2f} ({at_both.low:.2f} at least, with 97.5 % confidence)"
    )
    return Missed(f"{text}; {limit.text}", limit, at_both)


@dataclass(frozen=True)
class PartDecision:
    """The decision on a part."""

    tolerances: tuple[Tolerance, ...]
    findings: tuple[FindingDecision, ...]
    """By tolerance and finding."""
    missed: Missed
    """What would have been missed."""
    since: str
    """The earlier capture since which sizes may grow by the tolerances; empty if these limit the
    sizes themselves."""

    @property
    def decision(self) -> str:
        """One of `DECISIONS`: the worst of the findings. A part on which too much is missed is not
        accepted."""
        for decision in DECISIONS[:2]:
            if any(finding.decision == decision for finding in self.findings):
                return decision
        return CONFORMS if self.missed.is_enough else UNDECIDED

    @property
    def verdict(self) -> str:
        """Return ``The part does not conform to a depth of at most 0.5 mm``."""
        limits = " and ".join(tolerance.text for tolerance in self.tolerances)
        limited = f"a growth in {limits} since {self.since}" if self.since else f"a {limits}"
        if self.decision == UNDECIDED:
            return f"Undecided whether the part conforms to {limited}"
        return f"The part {self.decision} to {limited}"

    @property
    def short(self) -> str:
        """Return the verdict with the numbers of the findings that decide it."""
        counts = []
        for decision in DECISIONS:
            numbers = {finding.id for finding in self.findings if finding.decision == decision}
            numbers.discard(THE_PART)
            if numbers and decision != CONFORMS:
                listed = joined_words([str(number) for number in sorted(numbers)])
                prefix = "" if decision == self.decision else f"{decision}: "
                counts.append(f"{prefix}finding{'s' * (len(numbers) > 1)} {listed}")
        numbers_text = f" ({'; '.join(counts)})" if counts else ""
        return f"{self.verdict}{numbers_text}"

    @property
    def sentence(self) -> str:
        """Return the decision and what would have been missed, in one sentence."""
        return f"{self.short}; {self.missed.text}."

    @property
    def facts(self) -> dict[str, Any]:
        """Return it as plain data, for the JSON."""
        findings = []
        for finding in self.findings:
            facts = asdict(finding)
            facts["unit"] = KINDS[finding.kind]
            facts["guard_band"] = finding.guard
            findings.append(facts)
        return {
            "decision": self.decision,
            "rule": "ISO 14253-1",
            "risk": RISK,
            "since": self.since or None,
            "tolerances": [asdict(tolerance) for tolerance in self.tolerances],
            "findings": findings,
            "missed": asdict(self.missed),
        }


def part_decision(
    result: Judged,
    tolerances: Sequence[Tolerance],
    missed: Missed,
    changes: Changes | None = None,
) -> PartDecision:
    """Decide on each finding that is no feature of the part, and on the part. ``changes``: since an
    earlier capture, where findings are changes: damage that shrank or is gone then counts as none,
    and damage that is the same in both captures is no finding."""
    better = set()
    since = ""
    if changes is not None:
        better = {change.id for change in changes.damage if change.state in (SHRUNK, GONE)}
        since = "the earlier capture"
    decisions = []
    for tolerance in tolerances:
        if tolerance.kind == "deviation":
            decisions.append(_on_deviation(result, tolerance))
            continue
        for finding, detection in zip(result.findings, result.detections, strict=True):
            if finding.certainty != FEATURE and finding.id not in better:
                decisions.append(_on_finding(result, finding, detection, tolerance))
    return PartDecision(
        tolerances=tuple(tolerances),
        findings=tuple(decisions),
        missed=missed,
        since=since,
    )


def _on_finding(
    result: Judged, finding: Finding, detection: Detection, tolerance: Tolerance
) -> FindingDecision:
    """Decide on one finding by one tolerance."""
    if tolerance.kind == "depth":
        value = abs(finding.depth_mm)
        contributions = _of_depth(result.cloud, finding, detection)
    elif tolerance.kind == "volume":
        value = abs(finding.volume_mm3)
        contributions = _of_volume(result, finding, detection)
    else:
        value = finding.length_mm if finding.is_long else finding.diameter_mm
        contributions = _of_width(finding)
    uncertainty = combined(contributions)
    decision = UNDECIDED
    reason = ""
    if not math.isfinite(value):
        reason = f"its {tolerance.kind} is not known"
    elif not contributions:
        reason = f"the uncertainty of its {tolerance.kind} is not known"
    else:
        decision = decided(value, GUARD * uncertainty, tolerance.limit)
        reason = _doubt(finding, tolerance, decision)
        if reason:
            decision = UNDECIDED
    return FindingDecision(
        id=finding.id,
        kind=tolerance.kind,
        value=value,
        contributions=contributions,
        uncertainty=uncertainty,
        decision=decision,
        reason=reason,
    )


def _doubt(finding: Finding, tolerance: Tolerance, decision: str) -> str:
    """Return why a decision by the guard band does not stand, or an empty text."""
    if decision == FAILS and finding.certainty == DOUBTFUL:
        return "it may be noise"
    if decision == CONFORMS and "at_rim" in finding.flags.split():
        return "the rim cuts it: it may be larger"
    if decision == CONFORMS and tolerance.kind != "width" and finding.depth_is_least:
        return "the blur hides its floor: it may be deeper"
    return ""


def _of_depth(cloud: Cloud, finding: Finding, detection: Detection) -> tuple[Contribution, ...]:
    """Return the contributions to the standard uncertainty of a depth; none if it is unknown."""
    if not math.isfinite(finding.depth_se_mm):
        return ()
    # the fit's standard error contains the share that the model errs by
    model_mm = min(DEPTH_ERROR * abs(finding.depth_mm), finding.depth_se_mm)
    fit_mm = math.sqrt(finding.depth_se_mm**2 - model_mm**2)
    contributions = [
        Contribution("fit: noise, fixed pattern, shape and blur", fit_mm),
        Contribution("model: light between floor and walls", model_mm),
    ]
    if cloud.expected is not None:
        points_m = cloud.points_m.reshape(-1, 3)[detection.pixels]
        points_m = points_m[np.isfinite(points_m[:, 2])]
        contributions += [
            Contribution("reference: noise, and how parts differ", _spread_mm(cloud, points_m)),
            Contribution("registration", _registration_mm(cloud, points_m)),
        ]
    # floor and surface are measured by the same pixels' rays
    contributions.append(Contribution("offset of the unit, which floor and surface share", 0.0))
    return tuple(contributions)


def _spread_mm(cloud: Cloud, points_m: np.ndarray) -> float:
    """Return the standard deviation of the reference under a finding's points (n, 3): neighbours
    that share its noise count once."""
    assert cloud.expected is not None
    spread_m = cloud.expected.spread_at(points_m)
    known_m = spread_m[np.isfinite(spread_m)]
    if not len(known_m):
        return 0.0
    return float(np.sqrt(np.mean(known_m**2) * _shared(cloud, len(known_m)))) / MM


def _shared(cloud: Cloud, count: int) -> float:
    """Return the variance of a mean of ``count`` neighbours over that of one of them."""
    return min(1.0, max(cloud.noise_reach_px, 1.0) ** 2 / count)


def _registration_mm(cloud: Cloud, points_m: np.ndarray) -> float:
    """Return the standard deviation of the placement under a finding's points (n, 3)."""
    assert cloud.expected is not None
    errors_m = cloud.expected.registration_at(points_m)
    known_m = errors_m[np.isfinite(errors_m)]
    return float(np.sqrt(np.mean(known_m**2))) / MM if len(known_m) else 0.0


def _of_width(finding: Finding) -> tuple[Contribution, ...]:
    """Return the contributions to the standard uncertainty of a width; none if it is unknown."""
    error_mm = finding.length_se_mm if finding.is_long else finding.diameter_se_mm
    if not math.isfinite(error_mm):
        return ()
    return (Contribution("fit: noise, fixed pattern, shape and blur", error_mm),)


def _of_volume(result: Judged, finding: Finding, detection: Detection) -> tuple[Contribution, ...]:
    """Return the contributions to the standard uncertainty of a volume, mm3; none without points.

    Blur moves volume but keeps it; how much lies beyond the finding's pixels is taken to be as
    uncertain as half of what its outermost pixels show."""
    cloud = result.cloud
    residuals_mm = result.evidence.residual_m / MM
    pixels = detection.pixels[np.isfinite(residuals_mm.ravel()[detection.pixels])]
    if not len(pixels):
        return ()
    pixel_m2, _ = filled_areas_m2(cloud, result.evidence)
    areas_mm2 = pixel_m2.ravel()[pixels] / MM**2
    area_mm2 = float(areas_mm2.sum())
    noise_mm = sigma_of(residuals_mm[np.isfinite(residuals_mm)])
    mean_mm = noise_mm * math.sqrt(2.0 * _shared(cloud, len(pixels)))
    inside = np.zeros(residuals_mm.shape, np.uint8)
    inside.ravel()[pixels] = 1
    inner = cv2.erode(inside, np.ones((3, 3), np.uint8), borderValue=0)
    is_outermost = inner.ravel()[pixels] == 0
    shown_mm3 = areas_mm2 * residuals_mm.ravel()[pixels]
    contributions = [
        Contribution("noise and fixed pattern, of it and of its surroundings", area_mm2 * mean_mm),
        Contribution("model: light between floor and walls", DEPTH_ERROR * abs(finding.volume_mm3)),
        Contribution("outline", 0.5 * abs(float(shown_mm3[is_outermost].sum()))),
    ]
    if cloud.expected is not None:
        points_m = cloud.points_m.reshape(-1, 3)[pixels]
        spread_mm3 = area_mm2 * _spread_mm(cloud, points_m)
        placed_mm3 = area_mm2 * _registration_mm(cloud, points_m)
        contributions += [
            Contribution("reference: noise, and how parts differ", spread_mm3),
            Contribution("registration", placed_mm3),
        ]
    return tuple(contributions)


# ---------------------------------------------------------------- the deviation from a drawing


def _on_deviation(result: Judged, tolerance: Tolerance) -> FindingDecision:
    """Decide on the place that deviates most from the drawing."""
    cloud = result.cloud
    assert cloud.expected is not None
    deviation_mm = deviations_mm(result)
    means_mm, counts = _windowed(deviation_mm)
    is_finite = np.isfinite(means_mm)
    if not is_finite.any() or not cloud.organised:
        return FindingDecision(
            id=THE_PART,
            kind=tolerance.kind,
            value=math.nan,
            contributions=(),
            uncertainty=math.nan,
            decision=UNDECIDED,
            reason="no grid of pixels was compared with the drawing",
        )
    peak = int(np.nanargmax(np.abs(means_mm)))
    count = float(counts.ravel()[peak])
    noise_mm = sigma_of((deviation_mm - means_mm)[is_finite & np.isfinite(deviation_mm)])
    # windows that do not overlap
    windows = max(1, round(int(is_finite.sum()) / WINDOW_PX**2))
    largest = float(norm.ppf(1.0 - RISK / windows)) / GUARD
    of_window_mm = noise_mm * math.sqrt(_shared(cloud, round(count)))
    point_m = cloud.points_m.reshape(-1, 3)[peak : peak + 1]
    contributions = (
        Contribution(f"noise, of the largest of {windows} places", largest * of_window_mm),
        Contribution("registration", _registration_mm(cloud, point_m)),
    )
    value = float(abs(means_mm.ravel()[peak]))
    uncertainty = combined(contributions)
    return FindingDecision(
        id=THE_PART,
        kind=tolerance.kind,
        value=value,
        contributions=contributions,
        uncertainty=uncertainty,
        decision=decided(value, GUARD * uncertainty, tolerance.limit),
        reason="",
    )


def deviations_mm(result: Judged) -> np.ndarray:
    """Return how far (h, w) the cloud lies behind the surface, along its normals; NaN where nothing
    was judged."""
    surface_m = surface_points_m(result.cloud, result.evidence.surface_z_m)
    _, cosines = sight_lines(result.cloud, surface_m)
    return np.asarray(result.evidence.residual_m * cosines / MM)


def _windowed(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the means (h, w) over windows of `WINDOW_PX` with at least half of their values, else
    NaN, and the numbers of these."""
    is_finite = np.isfinite(values)
    side = (WINDOW_PX, WINDOW_PX)
    border = cv2.BORDER_CONSTANT
    sums = cv2.boxFilter(
        np.where(is_finite, values, 0.0), -1, side, normalize=False, borderType=border
    )
    counts = cv2.boxFilter(is_finite.astype(float), -1, side, normalize=False, borderType=border)
    enough = is_finite & (counts >= WINDOW_PX**2 / 2)
    return np.where(enough, sums / np.maximum(counts, 1.0), np.nan), counts


def _compared_text(result: Judged) -> str:
    """Return how much of the part was compared with the drawing."""
    compared = np.isfinite(result.evidence.residual_m).sum() / result.cloud.valid.sum()
    return f"{100 * compared:.0f} % of the points were compared with the drawing"
