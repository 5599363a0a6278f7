"""Decisions on tolerances: a finding and the part conform, do not conform, or nobody can tell.

A measured size is accepted below the limit less a guard band, and rejected above the limit plus
the guard band (ISO 14253-1). The band is the one-sided quantile of the combined standard
uncertainty, the root sum of squares of its contributions (GUM, JCGM 100, 5.1.2), so that a size at
the limit is accepted, and one is rejected, with a probability of at most `RISK` each.

Not modelled: contributions that are not normal, and correlations between them. An error of scale
of the lens is not in a width; measure a gauge to know it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

from detectors.findings.family import DEPTH_ERROR
from detectors.interface import Detection, Detector
from harness.inspection.changes import GONE, SHRUNK, Changes
from harness.inspection.limit import Limit, SizeCount, found_at, limit_of
from harness.inspection.verdict import DOUBTFUL, FEATURE
from harness.report.findings import Finding, Judged
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud
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
KINDS = ("depth", "width")
LEGAL = "depth=0.5mm or width=4mm, once each"


@dataclass(frozen=True)
class Tolerance:
    """The largest size that damage may have."""

    kind: str
    """One of `KINDS`; a depth may be that of a hole or the height of a bump."""
    limit_mm: float

    @property
    def text(self) -> str:
        """Return ``depth of at most 0.5 mm``."""
        return f"{self.kind} of at most {self.limit_mm:g} mm"


def tolerances_from(texts: Sequence[str]) -> tuple[Tolerance, ...]:
    """Return the tolerances of --tolerance. Raises UserError."""
    tolerances: list[Tolerance] = []
    for text in texts:
        kind, equals, length = text.partition("=")
        if kind not in KINDS or not equals:
            raise UserError(f"--tolerance {text}: is no tolerance", legal=LEGAL)
        if kind in [tolerance.kind for tolerance in tolerances]:
            raise UserError(f"--tolerance {text}: {kind} is stated twice", legal=LEGAL)
        tolerances.append(Tolerance(kind, length_m(f"--tolerance {kind}", length) / MM))
    return tuple(tolerances)


@dataclass(frozen=True)
class Contribution:
    """A part of a standard uncertainty."""

    name: str
    """Where it comes from, in words."""
    mm: float


@dataclass(frozen=True)
class FindingDecision:
    """The decision on one finding by one tolerance."""

    id: int
    """Its number."""
    kind: str
    """The tolerance's."""
    value_mm: float
    """The measured size."""
    contributions: tuple[Contribution, ...]
    """Of its standard uncertainty; empty if that is unknown."""
    uncertainty_mm: float
    """Combined standard uncertainty; NaN if it is unknown."""
    decision: str
    """One of `DECISIONS`."""
    reason: str
    """Why nobody can tell although the guard band would; else empty."""


def combined_mm(contributions: Sequence[Contribution]) -> float:
    """Return the combined standard uncertainty; NaN without contributions."""
    if not contributions:
        return math.nan
    return math.hypot(*(contribution.mm for contribution in contributions))


def decided(value_mm: float, uncertainty_mm: float, limit_mm: float) -> str:
    """Return the decision on a size by the guard band on either side of its limit."""
    guard_mm = GUARD * uncertainty_mm
    if value_mm + guard_mm <= limit_mm:
        return CONFORMS
    if value_mm - guard_mm > limit_mm:
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

    @property
    def is_enough(self) -> bool:
        """True if finding nothing says something: damage at both tolerances is missed no more often
        than `RISK`, or the width from which damage is found is bounded."""
        if self.at_both is not None:
            return self.at_both.hits >= (1.0 - RISK) * self.at_both.places
        return self.limit is not None and math.isfinite(self.limit.bound_mm)


def missed_at(
    detector: Detector, result: Judged, threshold: float, tolerances: Sequence[Tolerance]
) -> Missed:
    """Press damage at the tolerances into a judged cloud, and count what is found."""
    sizes_m = {tolerance.kind: tolerance.limit_mm * MM for tolerance in tolerances}
    try:
        limit = limit_of(detector, result, threshold, sizes_m.get("depth"))
        at_both = None
        if len(sizes_m) == len(KINDS):
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
    def short(self) -> str:
        """Return ``The part does not conform to a depth of at most 0.5 mm (...)``."""
        limits = " and ".join(tolerance.text for tolerance in self.tolerances)
        counts = []
        for decision in DECISIONS:
            numbers = {finding.id for finding in self.findings if finding.decision == decision}
            if numbers and decision != CONFORMS:
                listed = joined_words([str(number) for number in sorted(numbers)])
                prefix = "" if decision == self.decision else f"{decision}: "
                counts.append(f"{prefix}finding{'s' * (len(numbers) > 1)} {listed}")
        if self.decision == UNDECIDED:
            start = "Undecided whether the part conforms"
        else:
            start = f"The part {self.decision}"
        found = f" ({'; '.join(counts)})" if counts else ""
        limited = f"a growth in {limits} since {self.since}" if self.since else f"a {limits}"
        return f"{start} to {limited}{found}"

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
            facts["guard_band_mm"] = GUARD * finding.uncertainty_mm
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
        value_mm = abs(finding.depth_mm)
        contributions = _of_depth(result.cloud, finding, detection)
    else:
        value_mm = finding.length_mm if finding.is_long else finding.diameter_mm
        contributions = _of_width(finding)
    uncertainty_mm = combined_mm(contributions)
    decision = UNDECIDED
    reason = ""
    if not math.isfinite(value_mm):
        reason = f"its {tolerance.kind} is not known"
    elif not contributions:
        reason = f"the uncertainty of its {tolerance.kind} is not known"
    else:
        decision = decided(value_mm, uncertainty_mm, tolerance.limit_mm)
        reason = _doubt(finding, tolerance, decision)
        if reason:
            decision = UNDECIDED
    return FindingDecision(
        id=finding.id,
        kind=tolerance.kind,
        value_mm=value_mm,
        contributions=contributions,
        uncertainty_mm=uncertainty_mm,
        decision=decision,
        reason=reason,
    )


def _doubt(finding: Finding, tolerance: Tolerance, decision: str) -> str:
    """Return why a decision by the guard band does not stand, or an empty text."""
    if decision == FAILS and finding.certainty == DOUBTFUL:
        return "it may be noise"
    if decision == CONFORMS and "at_rim" in finding.flags.split():
        return "the rim cuts it: it may be larger"
    if decision == CONFORMS and tolerance.kind == "depth" and finding.depth_is_least:
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
