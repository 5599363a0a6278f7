"""Judges one cloud: what deviates from the surface, at which threshold, and which doubts are
due."""

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from detectors.findings.measure import measure_extents
from detectors.findings.missing import measure_missing, missing_returns, one_damage_once
from detectors.findings.null import OwnThreshold, each_object_once, own_threshold
from detectors.interface import Detection, Detector, Evidence, Measurement
from detectors.pixels.masks import grown, holes_filled
from detectors.surfaces.background import misfit
from harness.inspection import arguments as cli
from harness.report.findings import Finding, Judged
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud

DEFAULT_K = 5.0
"""Robust deviations, if the capture sets no threshold; 0.6 of a million normal pixels lie beyond.
"""
FAINT_CALLS = 0.05
"""Noise explains a finding if at least this many false calls of its score are expected."""
FALLBACK = "a fallback"
"""First words of the origin of a threshold that the capture could not set."""
THRESHOLDS = ("threshold", "quiet_capture", "false_calls")
"""Arguments of which each sets the threshold."""
NULL_FACTS = ("threshold", "expected", "low", "high", "peaks", "floor", "objects", "rim_pixels")
"""Facts of a capture's own threshold that are stored with the findings."""
OPEN_MM = 75.0
"""Depth beyond which a hole shows objects far behind it."""
FILTER_PX = 3.0
"""Least width of a camera's filter that hides the rim of a hole."""


def judged(detector: Detector, cloud: Cloud, evidence: Evidence, threshold: float) -> Judged:
    """Find damage above a threshold and missing returns, each damage and each object once, and
    measure them."""
    missing = missing_returns(cloud, evidence)
    without_return = () if missing is None else missing.detections
    above_threshold = detector.find(cloud, evidence, threshold)
    objects_once = each_object_once(cloud, evidence, above_threshold)
    detections = one_damage_once(cloud.valid.shape, objects_once, without_return)
    measurements = tuple(
        _measured(detector, cloud, evidence, detection) for detection in detections
    )
    return Judged(cloud, evidence, detections, measurements, missing)


def _measured(
    detector: Detector, cloud: Cloud, evidence: Evidence, detection: Detection
) -> Measurement:
    """Measure a detection by what fits its kind."""
    if detection.kind == "object":
        why = "an object that lies on the target: no model of a hole fits it"
        return measure_extents(cloud, detection, why)
    if detection.kind == "no return":
        return measure_missing(cloud, evidence, detection)
    return detector.measure(cloud, evidence, detection)


def analysed(detector: Detector, cloud: Cloud) -> Evidence:
    """Return the detector's evidence, with a warning if it fitted a stated surface that does not
    fit."""
    evidence = detector.analyse(cloud)
    if "misfit_share" in evidence.notes:  # the shape of the surface was chosen by evidence
        return evidence
    doubt = misfit(cloud, evidence.residual_m, "the stated surface")
    return with_warnings(evidence, doubt) if doubt else evidence


def with_warnings(evidence: Evidence, *warnings: str) -> Evidence:
    """Return the evidence with further warnings."""
    return replace(evidence, warnings=(*evidence.warnings, *warnings))


def refuse_thresholds(arguments: argparse.Namespace) -> None:
    """Raise UserError if several arguments set the threshold, or its value is not legal."""
    given = []
    for name in THRESHOLDS:
        if getattr(arguments, name) is not None:
            given.append(f"--{name.replace('_', '-')}")
    if len(given) > 1:
        raise UserError(f"{' and '.join(given)} set the threshold", fix="give one of them")
    for name, value in (("threshold", arguments.threshold), ("false-calls", arguments.false_calls)):
        if value is not None and not 0 < value < float("inf"):
            raise UserError(f"--{name} {value:g}", legal="a number above 0")


def threshold_of(
    arguments: argparse.Namespace,
    detector: Detector,
    cloud: Cloud,
    evidence: Evidence,
    quiet: Callable[[], tuple[float, str]],
) -> tuple[float, str, Evidence]:
    """Return the threshold, its origin, and the evidence to search with it.

    The threshold is given, calibrated on a quiet capture (by ``quiet``), the detector's own, or
    from the capture's peaks towards the camera, which may leave out a rim that cannot be judged;
    if these cannot be trusted, it is a fallback with warnings."""
    if arguments.threshold is not None:
        return arguments.threshold, "given", evidence
    if arguments.quiet_capture is not None:
        threshold, origin = quiet()
        return threshold, origin, evidence
    default = getattr(detector, "default_threshold", None)
    if default is not None and arguments.false_calls is None:
        return float(default), "the detector's own", evidence

    wanted_calls = arguments.false_calls or cli.DEFAULT_FALSE_CALLS
    own = own_threshold(detector, cloud, evidence, wanted_calls)
    own_null = {name: getattr(own, name) for name in NULL_FACTS}
    notes: dict[str, Any] = {**evidence.notes, "own_null": own_null}
    searched = replace(own.evidence, notes=notes)
    peaks = _peaks_text(own, cloud)
    if own.doubts:
        k = DEFAULT_K
        if math.isfinite(own.threshold):
            k = max(DEFAULT_K, own.threshold)
        used = f"the capture cannot set its own threshold, {k:.3g} is used"
        warnings = [f"{used}: {why}" for why in own.doubts]
        unknown = "the number of false calls is unknown"
        origin = f"{FALLBACK}, {k:.3g} units of score: {unknown}; {peaks}"
        return k, origin, replace(searched, warnings=(*evidence.warnings, *warnings))
    expected = f"{_calls_text(own.expected)} false calls expected"
    interval = f"95 % interval {_calls_text(own.low)} to {_calls_text(own.high)}"
    origin = f"from this capture's own null: {expected}, {interval}, from {peaks}"
    return own.threshold, origin, searched


def _peaks_text(own: OwnThreshold, cloud: Cloud) -> str:
    """Say from how many peaks a capture's own threshold comes, and what limits them."""
    text = f"{own.peaks} peaks towards the camera"
    if own.objects:
        beside = "expect more beside objects, tags and edges in the picture"
        text += f"; {beside} ({own.objects} places)"
    if not cloud.organised:
        text += "; objects on the target were not sought"
    if own.rim_pixels:
        rim = f"{own.rim_pixels} pixels along the rim"
        text += f"; {rim} are mixed with the background and are not judged"
    return text


def _calls_text(expected: float) -> str:
    """Return a number of false calls with a digit that means something; 0 below 1e-4."""
    if expected >= 0.1:
        return f"{expected:.1f}"
    if expected >= 1e-4:
        return f"{expected:.1g}"
    return "0"


def with_faint_warning(result: Judged, threshold: float) -> Judged:
    """Add a warning if noise explains more of the findings than the expected false calls, in a
    capture that set its own threshold.

    The logarithm of the number of false calls is assumed to fall with the square of the score, as
    for normal noise, through the peaks above the floor and the upper 95 % bound of the number
    expected at the threshold."""
    null = result.evidence.notes.get("own_null", {"threshold": None})
    if threshold != null["threshold"] or not FAINT_CALLS < null["high"] < null["peaks"]:
        return result
    rate = math.log(2 * null["peaks"] / null["high"]) / (threshold**2 - null["floor"] ** 2)
    sure_score = math.sqrt(threshold**2 + math.log(null["high"] / FAINT_CALLS) / rate)
    faint = []
    for finding in result.findings:
        if finding.kind != "no return" and finding.score < sure_score:
            faint.append(str(finding.id))
    if len(faint) <= max(null["expected"], 1.0) + 1e-6:
        return result
    faint_findings = f"{len(faint)} of {len(result.findings)} findings ({', '.join(faint)})"
    expected = f"{_calls_text(null['expected'])} false calls are expected"
    warning = (
        f"{faint_findings} are so faint that noise explains them: "
        f"{expected}, with scores up to about {sure_score:.2g}"
    )
    return replace(result, evidence=with_warnings(result.evidence, warning))


def with_size_warnings(result: Judged) -> Judged:
    """Add warnings if findings reach the rim of the judged area, because the rest of them was not
    seen, and if distant surfaces show through holes: the camera's filter, as wide as the noise's
    reach, then draws them over the rim."""
    cloud = result.cloud
    if not cloud.organised:
        return result
    is_judged = holes_filled(np.isfinite(result.evidence.residual_m))
    outside = np.pad(~is_judged, 1, constant_values=True)
    is_rim = grown(outside, 1)[1:-1, 1:-1].ravel()
    warnings = []
    cut = []
    for finding, detection in zip(result.findings, result.detections, strict=True):
        if is_rim[detection.pixels].any():
            cut.append(str(finding.id))
    if cut:
        warnings.append(
            f"findings that reach the rim of the judged area ({', '.join(cut)}) "
            "may be larger than stated"
        )
    open_holes = [str(finding.id) for finding in result.findings if _shows_what_is_behind(finding)]
    if open_holes and cloud.noise_reach_px >= FILTER_PX:
        pitch_m = float(np.nanmedian(np.abs(np.diff(cloud.points_m[..., 0], axis=1))))
        most_mm = cloud.noise_reach_px * pitch_m / MM
        warnings.append(
            f"holes that show what lies far behind, or nothing ({', '.join(open_holes)}), "
            f"may be up to {most_mm:.2g} mm wider than stated: "
            "the camera's filter mixes their rim into them"
        )
    return replace(result, evidence=with_warnings(result.evidence, *warnings))


def _shows_what_is_behind(finding: Finding) -> bool:
    return finding.kind == "no return" or finding.depth_mm > OPEN_MM
