"""The steps of `tofpod detect`: one capture, or several views merged into one cloud, judged
alike."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.averages.average import RECORDED, average, unsteadiness
from detectors.averages.flat_agreement import places_doubt, refuse_unfit
from detectors.averages.flat_field import FlatField, corrected, doubts, load_flat_field
from detectors.averages.moved import motion_doubt
from detectors.crop import Choice, NoCrop
from detectors.interface import Detector, Evidence
from detectors.pixels.noise import REACH_FRAMES, with_noise
from detectors.surfaces.pieces import piece_facts
from detectors.views.view import View
from harness.inspection import arguments as cli
from harness.inspection import output
from harness.inspection.changes import Changes, changes_of
from harness.inspection.choosing import Contender, candidate_of, chosen, noted
from harness.inspection.judging import analysed, judged, refuse_thresholds, threshold_of
from harness.inspection.limit import Limit, limit_of
from harness.inspection.references import (
    CapturedReference,
    Reference,
    SeenPart,
    captured_reference,
    checked_on_parts,
    drawn_reference,
    seen,
)
from harness.inspection.several_views import merged_views, mistakes_named, registration_data
from harness.inspection.tolerance import (
    PartDecision,
    Tolerance,
    missed_at,
    part_decision,
    tolerances_from,
)
from harness.inspection.verdict import (
    InspectionVerdict,
    filled_areas_m2,
    verdict_of,
)
from harness.records import outputs
from harness.report.findings import Judged
from harness.vocabulary.geometry import Cloud

if TYPE_CHECKING:
    from detectors.recordings import Recording
    from detectors.views.mapping.merge import Mapped
    from detectors.views.mapping.settings import MappingConfig


@dataclass(frozen=True)
class Inspection:
    """A capture, or a map of several views, and what was found in it."""

    arguments: argparse.Namespace
    """Those of `tofpod detect`."""
    recordings: Sequence[Recording]
    """The captures: one, or one for each view."""
    quiet_recordings: Sequence[Recording]
    """The capture of an undamaged target that set the threshold, if one did."""
    choices: Sequence[Choice | None]
    """The chosen target of each capture; None if none was sought."""
    config: MappingConfig | None
    """How views were merged; None for one capture."""
    mapped: Mapped | None
    """The views and their map; None for one capture."""
    registrations: Mapping[str, Any]
    """The content of registrations.json; empty for one capture."""
    detector: Detector
    settings: Mapping[str, Any]
    """Settings of the detector that differ from its defaults, as plain data."""
    result: Judged
    """The cloud, the evidence and the findings."""
    threshold: float
    """Units of score."""
    threshold_origin: str
    """Where the threshold comes from, in words."""
    verdict: InspectionVerdict
    """The answer."""
    limit: Limit | None
    """The sizes that would have been missed; None if they were not asked for."""
    reference: Reference | None
    """What the part is compared with; None without a reference."""
    changes: Changes | None
    """What changed since an earlier capture; None without one."""
    decision: PartDecision | None
    """Whether the part is within its tolerances; None without --tolerance."""

    @property
    def cell_m(self) -> float | None:
        """The side of a map's cells, None if the cloud is not a map."""
        surface_map = self.mapped.merged.surface_map if self.mapped else None
        return surface_map.cell_m if surface_map else None


@dataclass(frozen=True)
class _Captured:
    """The recordings and their averages, before any detector judges them."""

    recordings: Sequence[Recording]
    """The captures: one, or one for each view."""
    quiet_recordings: Sequence[Recording]
    """The capture of an undamaged target, if there is one."""
    flat_field: FlatField | None
    """The unit's fixed pattern, which is subtracted."""
    views: Sequence[View]
    """The average of each capture."""
    choices: Sequence[Choice | None]
    """The chosen target of each view; None if none was sought."""
    mapped: Mapped | None
    """The views and their map; None for one capture."""
    registrations: Mapping[str, Any]
    """The content of registrations.json; empty for one capture."""
    cloud: Cloud
    """What is judged: the average, or the map."""
    reference: Reference | None
    """What it is compared with; None without a reference."""


def inspected(arguments: argparse.Namespace) -> Inspection:
    """Open, average, register and merge views, and judge. Raises UserError."""
    config = cli.mapping_of(arguments) if arguments.register is not None else None
    paths = arguments.paths[: config.views] if config else arguments.paths
    cli.refuse_misfits(arguments, paths)
    refuse_thresholds(arguments)
    cli.limit_depth_m(arguments)
    reference = arguments.reference
    has_drawing = reference is not None and cli.is_mesh(reference)
    tolerances = tolerances_from(arguments.tolerance, has_drawing=has_drawing)
    detectors = _detectors_of(arguments, config)
    capture = _captured(arguments, paths, config, detectors[0][0])
    candidate = _chosen(arguments, detectors, capture)
    evidence = candidate.evidence
    if capture.mapped is None:
        evidence = _with_pieces(evidence, capture.cloud, capture.choices[0])
    capture_doubts = _capture_doubts(arguments, capture)
    evidence = replace(evidence, warnings=(*capture_doubts, *evidence.warnings))
    result = judged(candidate.detector, capture.cloud, evidence, candidate.threshold)
    outline = _outline(capture.choices, capture.mapped)
    changes = _changes(arguments, config, capture, candidate.detector, result)
    return Inspection(
        arguments=arguments,
        recordings=capture.recordings,
        quiet_recordings=capture.quiet_recordings,
        choices=capture.choices,
        config=config,
        mapped=capture.mapped,
        registrations=capture.registrations,
        detector=candidate.detector,
        settings=candidate.settings,
        result=result,
        threshold=candidate.threshold,
        threshold_origin=candidate.origin,
        verdict=verdict_of(result, candidate.threshold, outline),
        limit=_limit(arguments, candidate.detector, result, candidate.threshold),
        reference=capture.reference,
        changes=changes,
        decision=_decision(candidate, result, tolerances, changes),
    )


def _captured(
    arguments: argparse.Namespace,
    paths: Sequence[Path],
    config: MappingConfig | None,
    detector: Detector,
) -> _Captured:
    """Open and average the capture, or each view and merge them. ``detector`` states the crop of
    one capture."""
    flat_field = load_flat_field(arguments.flat_field) if arguments.flat_field else None
    poses: Sequence[np.ndarray | None] = (None,) * len(paths)
    if arguments.poses:
        poses = cli.read_poses(arguments.poses, len(paths))
    files_of_views = [[path] for path in paths] if config else [paths]
    recordings = [_opened(arguments, files) for files in files_of_views]
    quiet_recordings = []
    if arguments.quiet_capture is not None:
        quiet_recordings.append(_opened(arguments, [arguments.quiet_capture]))

    names = _names(paths) if config else [recordings[0].name]
    views = []
    for name, recording, pose in zip(names, recordings, poses, strict=False):
        views.append(View(name, _averaged(arguments, recording, flat_field), pose))
    choices = []
    for view in views:
        with mistakes_named(view if config else None):
            target_settings = config or getattr(detector, "settings", None)
            choices.append(output.choice_by(target_settings, view.cloud))
    mapped = None
    registrations: Mapping[str, Any] = {}
    cloud = views[0].cloud
    if config:
        mapped = merged_views(arguments, config, recordings, views, choices)
        registrations = registration_data(mapped)
        cloud = mapped.merged.cloud
    reference = _reference(arguments, config, detector, flat_field)
    if reference is not None:
        cloud = reference.under(_part(arguments, detector, cloud))
    return _Captured(
        recordings=recordings,
        quiet_recordings=quiet_recordings,
        flat_field=flat_field,
        views=views,
        choices=choices,
        mapped=mapped,
        registrations=registrations,
        cloud=cloud,
        reference=reference,
    )


def _reference(
    arguments: argparse.Namespace,
    config: MappingConfig | None,
    detector: Detector,
    flat_field: FlatField | None,
) -> Reference | None:
    """Open --reference; None without it. The part is cut out of each capture as it is out of the
    capture to be judged, or out of each view."""
    if arguments.reference is None:
        return None
    if cli.is_mesh(arguments.reference):
        return drawn_reference(cli.drawing_file_of(arguments))

    def opened(path: Path) -> tuple[Recording, Cloud]:
        cloud_of_result = path / outputs.CLOUD.name
        if cloud_of_result.is_file() and (path / outputs.FINDINGS_DATA.name).is_file():
            # the cloud of an earlier inspection is in metres, and its pattern is subtracted
            stored = argparse.Namespace(**{**vars(arguments), "unit": "m"})
            recording = _opened(stored, [cloud_of_result])
            return recording, _averaged(stored, recording, None)
        recording = _opened(arguments, [path])
        return recording, _averaged(arguments, recording, flat_field)

    settings = config or getattr(detector, "settings", None)
    crop = getattr(settings, "crop", NoCrop())
    return captured_reference(arguments.reference, opened, crop, cli.marks_of(arguments))


def _part(arguments: argparse.Namespace, detector: Detector, cloud: Cloud) -> SeenPart:
    """Find the part in the cloud that is judged."""
    crop = getattr(getattr(detector, "settings", None), "crop", NoCrop())
    return seen("this capture", cloud, crop, cli.marks_of(arguments))


def _changes(
    arguments: argparse.Namespace,
    config: MappingConfig | None,
    capture: _Captured,
    detector: Detector,
    result: Judged,
) -> Changes | None:
    """Return what changed since an earlier capture: that and this one are also judged by
    themselves, for the sizes of damage then and now."""
    reference = capture.reference
    if not isinstance(reference, CapturedReference) or not reference.is_earlier:
        return None
    alone = argparse.Namespace(**vars(arguments))
    alone.reference = None
    alone.detector = detector.name

    def judged_alone(loaded: tuple[Detector, dict[str, Any]], cloud: Cloud) -> Judged:
        contender = candidate_of(alone, loaded, cloud, lambda _: (math.nan, ""))
        return judged(contender.detector, cloud, contender.evidence, contender.threshold)

    (now,) = _detectors_of(alone, config)
    (then,) = cli.detectors_of(alone, alone.crop, _own_settings(alone))
    return changes_of(
        result,
        reference.scan,
        then=judged_alone(then, reference.parts[0].cloud),
        now=judged_alone(now, replace(capture.cloud, expected=None)),
    )


def _chosen(
    arguments: argparse.Namespace,
    detectors: Sequence[tuple[Detector, dict[str, Any]]],
    capture: _Captured,
) -> Contender:
    """Let the detectors judge the capture, and choose one."""

    @cache
    def quiet_cloud() -> Cloud:
        return _averaged(arguments, capture.quiet_recordings[0], capture.flat_field)

    def silent_threshold(detector: Detector) -> tuple[float, str]:
        """Return a detector's lowest threshold that is silent on the quiet capture, and its
        origin."""
        undamaged = quiet_cloud()
        if capture.reference is not None:
            undamaged = capture.reference.under(_part(arguments, detector, undamaged))
        threshold = detector.quiet_threshold(undamaged, detector.analyse(undamaged))
        frames = f"{undamaged.n_frames} frames, here {capture.cloud.n_frames}"
        quiet = f"{arguments.quiet_capture}, one repeat of {frames}"
        return threshold, f"the lowest that is silent on {quiet}"

    candidates = [
        candidate_of(arguments, loaded, capture.cloud, silent_threshold) for loaded in detectors
    ]
    reference = capture.reference
    if isinstance(reference, CapturedReference) and arguments.threshold is None:
        candidates = [_with_left_out(arguments, reference, candidate) for candidate in candidates]
    if arguments.detector != cli.DEFAULT_DETECTOR:
        return candidates[0]
    if arguments.threshold is not None:
        return noted(candidates[0], "as --threshold is in units of its score")
    return chosen(candidates, capture.cloud, cli.rate_text(arguments))


def _with_left_out(
    arguments: argparse.Namespace, reference: CapturedReference, candidate: Contender
) -> Contender:
    """Raise a candidate's threshold if it has more findings on good parts than expected."""

    def own(detector: Detector, cloud: Cloud) -> tuple[float, Evidence]:
        evidence = analysed(detector, cloud)
        threshold, _, searched = threshold_of(
            arguments, detector, cloud, evidence, lambda: (math.nan, "")
        )
        return threshold, searched

    calls = arguments.false_calls or cli.DEFAULT_FALSE_CALLS
    check = checked_on_parts(reference, candidate.detector, own, calls)
    if check is None:
        return candidate
    origin = f"{candidate.origin}; {check.text}"
    return replace(candidate, threshold=candidate.threshold * check.factor, origin=origin)


def _outline(choices: Sequence[Choice | None], mapped: Mapped | None) -> np.ndarray | None:
    """Return the outline (h, w) bool of the target that was taken; None for a map, or if none was
    sought."""
    choice = choices[0]
    if mapped is not None or choice is None or not choice.candidates:
        return None
    if choice.part is not None:
        return choice.part
    return choice.candidates[choice.taken - 1].outline


def _limit(
    arguments: argparse.Namespace, detector: Detector, result: Judged, threshold: float
) -> Limit | None:
    """Return the sizes that would have been missed, if they were asked for."""
    if arguments.limit is None:
        return None
    return limit_of(detector, result, threshold, cli.limit_depth_m(arguments))


def _decision(
    candidate: Contender,
    result: Judged,
    tolerances: Sequence[Tolerance],
    changes: Changes | None,
) -> PartDecision | None:
    """Return the decision on the tolerances, with what would have been missed at them; None without
    tolerances."""
    if not tolerances:
        return None
    missed = missed_at(candidate.detector, result, candidate.threshold, tolerances)
    return part_decision(result, tolerances, missed, changes)


def _with_pieces(evidence: Evidence, cloud: Cloud, choice: Choice | None) -> Evidence:
    """Note the pieces of the chosen part, and how much of each was judged."""
    if choice is None or choice.part is None:
        return evidence
    fit = str(evidence.notes.get("shape", evidence.notes.get("surface", "")))
    pixel_m2, _ = filled_areas_m2(cloud, evidence)
    pieces = piece_facts(choice.part, pixel_m2, evidence.residual_m, fit)
    return replace(evidence, notes={**evidence.notes, "pieces": pieces})


def _detectors_of(
    arguments: argparse.Namespace, config: MappingConfig | None
) -> list[tuple[Detector, dict[str, Any]]]:
    """Return the detectors to choose from, and their settings. With several views the target is cut
    out of each view, and settings of the map are not the detector's."""
    crop = arguments.crop if config is None else "none"
    return cli.detectors_of(arguments, crop, _own_settings(arguments))


def _own_settings(arguments: argparse.Namespace) -> list[str]:
    """Return the assignments of --set that are the detector's."""
    return [assignment for assignment in arguments.set if not assignment.startswith(cli.PREFIXES)]


def _names(paths: Sequence[Path]) -> list[str]:
    """Name views by the last part of their paths, or by the whole paths if these parts are not
    distinct."""
    names = [path.resolve().name for path in paths]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


def _opened(arguments: argparse.Namespace, paths: Sequence[Path]) -> Recording:
    frames = slice(arguments.max_frames) if arguments.max_frames else None
    return cli.opened(paths, arguments.intrinsics, frames=frames, **cli.reading_of(arguments))


def _averaged(
    arguments: argparse.Namespace, recording: Recording, flat_field: FlatField | None
) -> Cloud:
    """Average a recording's frames, and measure how far its noise reaches."""
    cloud = average(recording, RECORDED.model_copy(update={"method": arguments.average}))
    first_frames = list(islice(recording.frames(), REACH_FRAMES)) if cloud.organised else []
    cloud = replace(cloud, projection=recording.projection)
    if first_frames:
        cloud = with_noise(cloud, first_frames, recording.z_step_m)
    if flat_field is None:
        return cloud
    corrected_cloud = corrected(cloud, flat_field)
    refuse_unfit(cloud, recording.selected(), flat_field, arguments.flat_field)
    return corrected_cloud


def _capture_doubts(arguments: argparse.Namespace, capture: _Captured) -> list[str]:
    """Return doubts about the frames of the views and about the flat field, each once."""
    texts = []
    for recording, view in zip(capture.recordings, capture.views, strict=True):
        texts.append(unsteadiness(view.cloud))
        texts.append(motion_doubt(recording.frames(), view.cloud, recording.z_step_m))
    flat_field = capture.flat_field
    if flat_field is not None:
        for view in capture.views:
            texts += doubts(view.cloud, flat_field, arguments.flat_field)
            texts.append(places_doubt(view.cloud, flat_field, arguments.flat_field))
    return [text for text in dict.fromkeys(texts) if text]


def warnings_of(run: Inspection) -> tuple[str, ...]:
    """Return the doubts about the answer as a whole. With several views, doubts about their
    targets were printed before the registration."""
    warnings = [warning for recording in run.recordings for warning in recording.warnings]
    choice = run.choices[0]
    if run.mapped is None and choice:
        warnings += choice.warnings
    return (*warnings, *run.result.evidence.warnings)
