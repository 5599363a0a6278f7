"""A cloud judged: its evidence, the threshold that suits it, and the findings beyond it with their sizes."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from harness.vocabulary.errors import UserError

if TYPE_CHECKING:
    from detectors.interface import Detection, Detector, Evidence, Measurement
    from harness.report.findings import Judged
    from harness.vocabulary.capture import Cloud

DEFAULT_K = 5.0
"""Robust standard deviations, where the capture cannot tell better: of a million normal pixels 0.6 lie beyond by
chance. Real surfaces are not that kind."""
DEFAULT_FALSE_CALLS = 1.0
"""Expected false calls in the capture."""
FAINT_CALLS = 0.05
"""Expected false calls as strong as a finding, in the capture, from which on noise explains the finding."""
FAINT_PEAKS = 20
"""Peaks below which their number does not tell how fast it falls with the score."""
THRESHOLDS = ("threshold", "quiet_capture", "false_calls")
"""Arguments of which each sets the threshold."""


def judged(detector: Detector, cloud: Cloud, evidence: Evidence, threshold: float) -> Judged:
    """Find damage beyond a threshold and missing returns, each damage and each object once, and measure them."""
    from detectors.measure import measure_extents
    from detectors.missing import measure_missing, missing_returns, one_damage_once
    from detectors.null import each_object_once
    from harness.report.findings import Judged

    missing = missing_returns(cloud, evidence)
    unseen = () if missing is None else missing.detections
    searched = detector.find(cloud, evidence, threshold)
    found = one_damage_once(cloud.valid.shape, each_object_once(cloud, evidence, searched), unseen)

    def measure(each: Detection) -> Measurement:
        if each.kind == "object":
            return measure_extents(cloud, each, "an object that lies on the target: no model of a hole fits it")
        return (measure_missing if each.kind == "no return" else detector.measure)(cloud, evidence, each)

    measured = tuple(map(measure, found))
    return Judged(cloud, evidence, found, measured, missing)


def analysed(detector: Detector, cloud: Cloud) -> Evidence:
    """Return the detector's evidence, with a warning where it fitted a stated surface that does not fit."""
    from detectors.background import misfit

    evidence = detector.analyse(cloud)
    if "misfit_share" in evidence.notes:
        return evidence
    doubt = misfit(cloud, evidence.residual_m, "the stated surface")
    return replace(evidence, warnings=(*evidence.warnings, doubt)) if doubt else evidence


def threshold_of(
    arguments: argparse.Namespace,
    detector: Detector,
    cloud: Cloud,
    evidence: Evidence,
    quiet: Callable[[], tuple[float, str]],
) -> tuple[float, str, Evidence]:
    """Return the threshold, its origin, and the evidence to search with it: given, calibrated on a quiet capture
    (``quiet`` does it), the detector's own, or by the peaks of the capture towards the camera, which may leave out a
    rim that cannot be judged; where these cannot be trusted, a fallback with warnings."""
    from detectors.null import own_threshold

    given = [name for name in THRESHOLDS if getattr(arguments, name) is not None]
    if len(given) > 1:
        flags = [f"--{name.replace('_', '-')}" for name in given]
        all_set = "both set" if len(given) == 2 else "all set"
        raise UserError(f"{' and '.join(flags)} {all_set} the threshold", fix="give one of them")
    for name in ("threshold", "false_calls"):
        value = getattr(arguments, name)
        if value is not None and not 0 < value < float("inf"):
            raise UserError(f"--{name.replace('_', '-')} {value:g}", legal="a number above 0")
    if arguments.threshold is not None:
        return arguments.threshold, "given", evidence
    if arguments.quiet_capture is not None:
        return *quiet(), evidence
    default = getattr(detector, "default_threshold", None)
    if default is not None and arguments.false_calls is None:
        return float(default), "the detector's own", evidence

    own = own_threshold(detector, cloud, evidence, arguments.false_calls or DEFAULT_FALSE_CALLS)
    names = ("threshold", "expected", "low", "high", "peaks", "floor", "objects", "rim_pixels")
    notes = {**evidence.notes, "own_null": {name: getattr(own, name) for name in names}}
    told = f"{own.peaks} peaks towards the camera"
    if own.objects:
        told += f"; beside objects, tags and edges in the picture ({own.objects} places), where more are to be expected"
    if not cloud.organised:
        told += "; objects on the target were not looked for"
    if own.rim_pixels:
        told += f"; {own.rim_pixels} pixels along the rim mix in what lies behind it and are not judged"
    if own.doubts:
        known = math.isfinite(own.threshold)
        k = max(DEFAULT_K, own.threshold) if known else DEFAULT_K
        why = f"the larger of {DEFAULT_K:g} and its own {own.threshold:.3g}" if known else f"{DEFAULT_K:g}"
        warnings = tuple(f"the capture cannot set its own threshold, {why} is used: {doubt}" for doubt in own.doubts)
        origin = f"a fallback, {why} units of score: the number of false calls is unknown; {told}"
        return k, origin, replace(own.evidence, notes=notes, warnings=(*evidence.warnings, *warnings))
    origin = (
        f"from this capture's own null: {_calls(own.expected)} false calls expected, 95 % interval {_calls(own.low)} to"
        f" {_calls(own.high)}, from {told}"
    )
    return own.threshold, origin, replace(own.evidence, notes=notes)


def with_faint_told(judged: Judged, threshold: float) -> Judged:
    """Add a warning where noise explains more of the findings than false calls are expected, in a capture that set its
    own threshold. The logarithm of their number is taken to fall with the square of the score, as normal
    noise's does, through the peaks above the floor and the upper 95 % bound of what is expected at the threshold."""
    null = judged.evidence.notes.get("own_null")
    if (
        null is None
        or threshold != null["threshold"]
        or not FAINT_CALLS < null["high"] < null["peaks"]
        or null["peaks"] < FAINT_PEAKS
    ):
        return judged
    rate = math.log(2 * null["peaks"] / null["high"]) / (threshold**2 - null["floor"] ** 2)
    sure = math.sqrt(threshold**2 + math.log(null["high"] / FAINT_CALLS) / rate)
    faint = [str(each.id) for each in judged.findings if each.kind != "no return" and each.score < sure]
    if len(faint) <= max(null["expected"], 1.0) + 1e-6:
        return judged
    warning = (
        f"{len(faint)} of {len(judged.findings)} findings ({', '.join(faint)}) are so faint that noise explains them:"
        f" {_calls(null['expected'])} false calls are expected, with scores up to about {sure:.2g}"
    )
    evidence = replace(judged.evidence, warnings=(*judged.evidence.warnings, warning))
    return replace(judged, evidence=evidence)


def _calls(expected: float) -> str:
    return f"{expected:.1f}" if expected >= 0.1 else f"{expected:.1g}" if expected >= 1e-4 else "0"
