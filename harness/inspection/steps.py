"""What the program does with a capture before anything is judged: its arguments become a detector, frames, a cloud."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.vocabulary.errors import UserError

if TYPE_CHECKING:
    from detectors.interface import Detection, Detector, Evidence, Measurement
    from detectors.recordings import Recording
    from harness.report.findings import Judged
    from harness.vocabulary.capture import Cloud

DEFAULT_K = 5.0
"""Robust standard deviations, where the capture cannot tell better: of a million normal pixels 0.6 lie beyond by
chance. Real surfaces are not that kind."""
STATED_SURFACE = ("surface=", "surface.degree", "surface.method", "surface.drop", "variant")
"""Settings that state a polynomial: without any of them the surface's shape is chosen by evidence."""
DEFAULT_FALSE_CALLS = 1.0
"""In the capture."""
FAINT_CALLS = 0.05
"""Expected false calls as strong as a finding, in the capture, from which on noise explains the finding."""
FAINT_PEAKS = 20
"""Fewer peaks than these do not tell how fast their number falls with the score."""
THRESHOLDS = ("threshold", "quiet_capture", "false_calls")
"""Arguments of which each sets the threshold."""
LEGAL_CROP = "auto, none, box:x0,x1,y0,y1,z0,z1 (mm, camera frame), polygon:u,v,u,v,u,v.. (pixels)"


def detector_of(
    arguments: argparse.Namespace, crop: str, assignments: Sequence[str]
) -> tuple[Detector, dict[str, Any]]:
    """The detector with a crop and settings as --crop and --set state them, and these settings with all defaults."""
    from detectors import detector_type, load_detector

    settings: dict[str, Any] = {}
    known = detector_type(arguments.detector).settings_type
    if "crop" in known.model_fields:
        # of several views --crop is the mapping's, and so is --target
        settings["crop"] = crop_from_text(crop, arguments.target if crop == arguments.crop else None)
    elif arguments.target is not None:
        raise UserError(f"--target {arguments.target}: detector {arguments.detector} has no crop that could take it")
    if "surface" in known.model_fields and not any(each.startswith(STATED_SURFACE) for each in assignments):
        settings["surface"] = {"shape": "auto"}
    for assignment in assignments:
        assign(settings, assignment)
    detector = load_detector(arguments.detector, settings)
    return detector, known.from_data(settings).to_data()


def crop_from_text(text: str, target: int | None = None) -> dict[str, Any]:
    """The crop's declaration from ``auto``, ``none``, ``box:..`` or ``polygon:..``, and which of the automatic crop's
    candidates is meant; UserError on anything else."""
    kind, _, values = text.partition(":")
    if target is not None and text != "auto":
        raise UserError(
            f"--target {target}: chooses among the surfaces that the automatic crop finds, and --crop {text} is"
            " another crop",
            legal="--target with --crop auto",
            fix="leave out one of the two",
        )
    try:
        numbers = [float(value) for value in values.split(",")] if values else []
    except ValueError as error:
        raise UserError(f"--crop {text}: not all of its values are numbers", legal=LEGAL_CROP) from error
    if kind in ("auto", "none") and not numbers:
        return {"kind": kind} if target is None else {"kind": kind, "target": target}
    if kind == "box" and len(numbers) == 6:
        x, y, z = numbers[0:2], numbers[2:4], numbers[4:6]
        return {"kind": "box", "x_mm": x, "y_mm": y, "z_mm": z, "range_max_m": None}
    if kind == "polygon" and len(numbers) >= 6 and len(numbers) % 2 == 0:
        return {"kind": "polygon", "vertices_px": [numbers[i : i + 2] for i in range(0, len(numbers), 2)]}
    raise UserError(f"--crop {text}: no such crop", legal=LEGAL_CROP)


def assign(settings: dict[str, Any], assignment: str) -> None:
    """Put one KEY=VALUE into nested settings; the value is JSON where it can be, else text. UserError without one."""
    import json

    path, equals, text = assignment.partition("=")
    if not (path and equals):
        raise UserError(f"--set {assignment}: no value", legal="KEY=VALUE, for instance surface.degree=5")
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        value = text
    *folders, leaf = path.split(".")
    for folder in folders:
        settings = settings.setdefault(folder, {})
        if not isinstance(settings, dict):
            raise UserError(f"--set {assignment}: {folder} is a value, not a group")
    settings[leaf] = value


def opened(arguments: argparse.Namespace, paths: list[Path]) -> Recording:
    """The capture; --intrinsics may name a camera, whose nominal lens then counts."""
    from detectors.recordings import open_capture

    lens, file = None, None
    if arguments.intrinsics is not None:
        from scenes.sensor.camera import lens_named, lens_names

        file = Path(arguments.intrinsics)
        if arguments.intrinsics in lens_names():
            lens, file = lens_named(arguments.intrinsics), None
        elif not file.exists():
            legal = f"a file, or one of the cameras {', '.join(lens_names())}"
            raise UserError(f"--intrinsics {file}: no such file and no such camera", legal=legal)
    first = slice(arguments.max_frames) if arguments.max_frames else None
    return open_capture(
        paths,
        unit=arguments.unit,
        intrinsics=file,
        lens=lens,
        frames=first,
        topic=arguments.topic,
        array=arguments.array,
        pitch=arguments.pitch,
        raw=arguments.raw,
    )


def averaged(arguments: argparse.Namespace, recording: Recording) -> Cloud:
    """The capture's average as --average says."""
    from itertools import islice

    from detectors.average import AverageConfig, average
    from detectors.noise import REACH_FRAMES, noise_reach_px

    cloud = average(recording, AverageConfig(method=arguments.average))
    reach_px = noise_reach_px(list(islice(recording.frames(), REACH_FRAMES))) if cloud.organised else 0.0
    return replace(cloud, projection=recording.projection, noise_reach_px=reach_px)


def judged(detector: Detector, cloud: Cloud, evidence: Evidence, threshold: float) -> Judged:
    """Findings beyond a threshold and missing returns, each damage and each object once, with their sizes."""
    from detectors.measure import measure_extents
    from detectors.missing import measure_missing, missing_returns, one_damage_once
    from detectors.null import each_object_once
    from harness.report.findings import Judged

    missing = missing_returns(cloud, evidence)
    unseen = () if missing is None else missing.detections
    searched = detector.find(cloud, evidence, threshold)
    found = one_damage_once(cloud.valid.shape, each_object_once(cloud, evidence, searched), unseen)

    def measure(one: Detection) -> Measurement:
        if one.kind == "object":
            return measure_extents(cloud, one, "an object that lies on the target: no model of a hole fits it")
        return (measure_missing if one.kind == "no return" else detector.measure)(cloud, evidence, one)

    measured = tuple(measure(one) for one in found)
    return Judged(cloud, evidence, found, measured, missing)


def analysed(detector: Detector, cloud: Cloud) -> Evidence:
    """The detector's evidence, with a warning where it fitted a stated surface that does not fit."""
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
    """The threshold, its origin, and the evidence to search with it: given, calibrated on a quiet capture (``quiet``
    does it), the detector's own, or by the capture's own null, which may leave out a rim that cannot be judged."""
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
    own = getattr(detector, "default_threshold", None)
    if own is not None and arguments.false_calls is None:
        return float(own), "the detector's own", evidence
    return _by_own_null(detector, cloud, evidence, arguments.false_calls or DEFAULT_FALSE_CALLS)


def _by_own_null(
    detector: Detector, cloud: Cloud, evidence: Evidence, false_calls: float
) -> tuple[float, str, Evidence]:
    """The threshold by the peaks towards the camera; where they cannot be trusted, a fallback with warnings."""
    import dataclasses
    import math

    from detectors.null import own_threshold

    own = own_threshold(detector, cloud, evidence, false_calls)
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
        found_in = dataclasses.replace(own.evidence, notes=notes, warnings=(*evidence.warnings, *warnings))
        return k, origin, found_in
    origin = (
        f"from this capture's own null: {_calls(own.expected)} false calls expected, 95 % interval {_calls(own.low)} to"
        f" {_calls(own.high)}, from {told}"
    )
    return own.threshold, origin, dataclasses.replace(own.evidence, notes=notes)


def with_faint_told(judged: Judged, threshold: float) -> Judged:
    """The same, with a warning where noise explains more of the findings than false calls are expected, in a capture
    that set its own threshold. The logarithm of their number is taken to fall with the square of the score, as normal
    noise's does, through the peaks above the floor and the upper 95 % bound of what is expected at the threshold."""
    import math

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


def provenance(recordings: Sequence[Recording], *further: Path) -> dict[str, Any]:
    """Command, code, versions, and the content of every file that can change a number: those of the recordings, and
    ``further`` ones."""
    import hashlib

    from harness.vocabulary.provenance import record

    files = []
    for path in (*(path for recording in recordings for path in recording.files), *further):
        with path.open("rb") as stream:
            files.append({"path": str(path), "sha256": hashlib.file_digest(stream, "sha256").hexdigest()})
    return {**record("python -m harness.detect " + shlex.join(sys.argv[1:])), "files": files}


def capture_facts(recording: Recording, cloud: Cloud) -> dict[str, Any]:
    """What the JSON says of a capture."""
    import dataclasses

    return {
        "name": recording.name,
        "frames_used": cloud.n_frames,
        "frames_left_out": [dataclasses.asdict(left) for left in cloud.left_out],
        "lens": dataclasses.asdict(cloud.lens) if cloud.lens else None,
        "noise_reach_px": cloud.noise_reach_px or None,
        "depth_unit": {"mm": 1e3 * recording.scale_m, "from": recording.unit_from},
        "rounding_step_mm": 1e3 * cloud.z_step_m,
        "notes": recording.notes,
        "warnings": recording.warnings,
    }
