"""Judges one cloud: what deviates from the surface, at which threshold, and which doubts are
due."""

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from detectors.findings.beside_joints import (
    TouchingDamage,
    damage_beside,
    fragments_of,
    without_damage,
)
from detectors.findings.extents import measure_extents
from detectors.findings.joints import joined, joints_facts, joints_of
from detectors.findings.missing import measure_missing, missing_returns, one_damage_once
from detectors.findings.null import RIM_PX, OwnThreshold, own_threshold
from detectors.findings.objects import each_object_once
from detectors.findings.odds import noise_probabilities
from detectors.findings.steps import explained_by_steps
from detectors.interface import Detection, Detector, Evidence, Measurement, MissingReturns
from detectors.methods.local import LocalEvidence
from detectors.surfaces.background import misfit
from harness.inspection import arguments as cli
from harness.inspection.verdict import FalseCalls, calls_text, with_remarks
from harness.report.findings import Judged
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud

DEFAULT_K = 5.0
"""Robust deviations, if the capture sets no threshold; 0.6 of a million normal pixels lie beyond.
"""
FALLBACK = "a fallback"
"""First words of the origin of a threshold that the capture could not set."""
THRESHOLDS = ("threshold", "quiet_capture", "false_calls")
"""Arguments of which each sets the threshold."""
NULL_FACTS = ("threshold", "expected", "at_marks", "low", "high")
"""Facts of a capture's own threshold that are stored with the findings if it can be trusted."""
PEAK_FACTS = ("peaks", "floor", "objects", "rim_pixels", "rim_scale")
"""Facts that are stored in any case."""
LEAST_AT_MARKS = 0.05
"""Fewest expected calls at marks that the output states: 0.1 when rounded."""


LEAST_EXPECTED = 0.5
"""Share of pixels without return at which the reference shows a surface, from which they are a
finding."""


def judged(detector: Detector, cloud: Cloud, evidence: Evidence, threshold: float) -> Judged:
    """Find damage above a threshold and missing returns, each damage, each object and each set of
    joints once, without what a profile's steps explain, measure them, and say how certain each
    is."""
    missing = missing_returns(cloud, evidence)
    if missing is not None and cloud.expected is not None:
        missing = _without_features(cloud, missing)
    without_return = () if missing is None else missing.detections
    above_threshold = detector.find(cloud, evidence, threshold)
    objects_once = each_object_once(cloud, evidence, above_threshold)
    detections = one_damage_once(cloud.valid.shape, objects_once, without_return)
    measurements = tuple(
        _measured(detector, cloud, evidence, detection) for detection in detections
    )
    joints = joints_of(cloud, evidence, detections, measurements)
    touching: list[TouchingDamage] = []
    if joints:
        fragments: list[int] = []
        for feature in joints:
            fragments += fragments_of(cloud, evidence, detections, measurements, feature)
            touching += damage_beside(cloud, evidence, detections, measurements, feature)
        joints = tuple(without_damage(feature, touching) for feature in joints)
        detections += tuple(damage.detection for damage in touching)
        measurements += tuple(
            _measured(detector, cloud, damage.evidence, damage.detection) for damage in touching
        )
        notes = {**evidence.notes, "joints": joints_facts(joints, measurements)}
        evidence = replace(evidence, notes=notes)
        detections, measurements = joined(detections, measurements, joints, fragments)
    # what lies beyond a joint was compared with the other joints, which have the same steps
    parted = {id(damage.detection) for damage in touching}
    explained = [
        number
        for number in at_steps(cloud, evidence, detections, threshold)
        if id(detections[number]) not in parted
    ]
    if explained:
        evidence = replace(evidence, notes={**evidence.notes, "at_steps": len(explained)})
        left = [number for number in range(len(detections)) if number not in explained]
        detections = tuple(detections[number] for number in left)
        measurements = tuple(measurements[number] for number in left)
    probabilities = noise_probabilities(cloud, evidence, detections, missing)
    result = Judged(cloud, evidence, detections, measurements, missing, probabilities)
    return with_remarks(result, threshold)


def at_steps(
    cloud: Cloud, evidence: Evidence, detections: Sequence[Detection], threshold: float
) -> tuple[int, ...]:
    """Return the numbers of the findings that the uncertain steps of a profile explain."""
    # a reference has an error everywhere, which the tolerances count
    if cloud.expected is not None or not isinstance(evidence, LocalEvidence):
        return ()
    return explained_by_steps(evidence.spread_m, evidence.residual_m, detections, threshold)


def _without_features(cloud: Cloud, missing: MissingReturns) -> MissingReturns:
    """Leave out missing returns where the reference shows nothing either: openings of the part."""
    if cloud.lens is None or cloud.expected is None:
        return missing
    slopes = cloud.lens.region_slopes(cloud.region).reshape(-1, 2)
    kept = []
    for detection in missing.detections:
        rays = np.column_stack([slopes[detection.pixels], np.ones(len(detection.pixels))])
        is_expected = np.isfinite(cloud.expected.z_at(rays))
        if is_expected.mean() >= LEAST_EXPECTED:
            kept.append(detection)
    return replace(missing, detections=tuple(kept))


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
    stated = []
    for name in THRESHOLDS:
        if getattr(arguments, name) is not None:
            stated.append(f"--{name.replace('_', '-')}")
    if len(stated) > 1:
        raise UserError(f"{' and '.join(stated)} set the threshold", fix="give one of them")
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
    by_peaks = own_threshold(detector, cloud, evidence, wanted_calls)
    notes: dict[str, Any] = {**evidence.notes, "own_null": null_facts(by_peaks)}
    searched = replace(by_peaks.evidence, notes=notes)
    peaks = _peaks_text(by_peaks, cloud)
    if by_peaks.doubts:
        k = DEFAULT_K
        if math.isfinite(by_peaks.threshold):
            k = max(DEFAULT_K, by_peaks.threshold)
        used = f"the capture cannot set its own threshold, {k:.3g} is used"
        warnings = [f"{used}: {why}" for why in by_peaks.doubts]
        unknown = "the number of false calls is unknown"
        origin = f"{FALLBACK}, {k:.3g} units of score: {unknown}; {peaks}"
        return k, origin, replace(searched, warnings=(*evidence.warnings, *warnings))
    expected = FalseCalls(by_peaks.expected, by_peaks.low, by_peaks.high).text
    at_marks = ""
    if by_peaks.at_marks >= LEAST_AT_MARKS:
        at_marks = f", {calls_text(by_peaks.at_marks)} of them at objects, print and edges"
    origin = f"from this capture's own null: {expected}{at_marks}, from {peaks}"
    return by_peaks.threshold, origin, searched


def null_facts(own: OwnThreshold) -> dict[str, Any]:
    """Return the facts of a capture's own threshold as plain data; the expected numbers are NaN
    and the laws are missing if they cannot be trusted."""
    facts: dict[str, Any] = {name: getattr(own, name) for name in PEAK_FACTS}
    if own.doubts:
        facts.update(dict.fromkeys(NULL_FACTS, math.nan))
        facts["tails"] = {}
    else:
        facts.update({name: getattr(own, name) for name in NULL_FACTS})
        facts["tails"] = {name: tail.facts for name, tail in own.tails.items()}
    return facts


def _peaks_text(own: OwnThreshold, cloud: Cloud) -> str:
    """Say from how many peaks a capture's own threshold comes, and what limits them."""
    text = f"{own.peaks} peaks towards the camera"
    if not cloud.organised:
        text += "; objects on the target were not sought"
    if own.rim_scale < 1.0:
        rim = f"scores within {RIM_PX} pixels of the rim count {own.rim_scale:.2g} times"
        text += f"; {rim}, because noise is higher there"
    if own.rim_pixels:
        rim = f"{own.rim_pixels} pixels along the rim"
        text += f"; {rim} are mixed with the background and are not judged"
    return text
