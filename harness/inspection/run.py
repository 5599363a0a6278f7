"""The steps of `tofpod detect`: one capture, or several views merged into one cloud, judged and
reported alike."""

from __future__ import annotations

import argparse
import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.averages.average import RECORDED, average, unsteadiness
from detectors.averages.flat_agreement import places_doubt, refuse_unfit
from detectors.averages.flat_field import FlatField, corrected, doubts, load_flat_field
from detectors.crop import Choice, NoCrop, described_text
from detectors.interface import Detector, Evidence
from detectors.pixels.noise import REACH_FRAMES, with_noise
from detectors.surfaces.pieces import part_text, piece_facts
from detectors.views.view import View
from harness.inspection import arguments as cli
from harness.inspection import output
from harness.inspection.changes import Changes, changes_of
from harness.inspection.choosing import Contender, candidate_of, chosen, noted
from harness.inspection.judging import analysed, judged, refuse_thresholds, threshold_of
from harness.inspection.limit import Limit, limit_of
from harness.inspection.reference_page import changes_section, decision_section
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
from harness.inspection.sheets import Sheets
from harness.inspection.tolerance import (
    PartDecision,
    Tolerance,
    missed_at,
    part_decision,
    tolerances_from,
)
from harness.inspection.verdict import (
    CLASSES,
    FLAGS,
    InspectionVerdict,
    calls_text,
    filled_areas_m2,
    verdict_of,
)
from harness.records import outputs
from harness.report.blocks import joined, paragraph, plain
from harness.report.findings import Judged, write_findings
from harness.vocabulary.files import plain_json
from harness.vocabulary.geometry import MM, Cloud
from harness.vocabulary.provenance import made_by, record
from harness.vocabulary.text import Grid, many

if TYPE_CHECKING:
    from markupsafe import Markup

    from detectors.recordings import Recording
    from detectors.views.mapping.merge import Mapped
    from detectors.views.mapping.settings import MappingConfig
    from harness.records.examples import Scene3d

FileWriter = Callable[[Path], object]


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
    capture_doubts = _capture_doubts(arguments, capture.views, capture.flat_field)
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


def _capture_doubts(
    arguments: argparse.Namespace, views: Sequence[View], flat_field: FlatField | None
) -> list[str]:
    """Return doubts about the frames of the views and about the flat field, each once."""
    texts = [unsteadiness(view.cloud) for view in views]
    if flat_field is not None:
        for view in views:
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


def print_inspection(run: Inspection, further_warnings: Sequence[str] = ()) -> None:
    """Print warnings (``further_warnings`` last), the verdict, the capture, the surface, the
    threshold, the classes and the strongest findings."""
    output.print_warnings((*warnings_of(run), *further_warnings))
    if run.decision is not None:
        print(run.decision.sentence)
    print(run.verdict.sentence)
    if run.mapped is None:
        _print_capture(run)
    else:
        _print_map(run, run.mapped)
    notes = run.result.evidence.notes
    if "choice" in notes:
        print(f"detector: {notes['choice']['text']}")
    print(f"surface: {_surface_text(run)}")
    if run.result.missing is not None:
        print(run.result.missing.blind_text)
    print(f"threshold: {_threshold_text(run)}")
    if run.changes is not None:
        print(f"change: {run.changes.sentence}")
    if run.limit is not None:
        print(f"limit: {run.limit.text}")
    findings = run.result.findings
    if findings:
        output.print_classes(run.verdict.counts)
    grid = "px" if run.cell_m is None else "cell"
    output.print_findings(findings, grid, is_written=run.arguments.out is not None)


def _surface_text(run: Inspection) -> str:
    evidence = run.result.evidence
    unit = evidence.unit or f"{output.mm(evidence.scale_m)} at the median point"
    return f"{evidence.notes.get('surface', '')}; one unit of score is {unit}"


def _threshold_text(run: Inspection) -> str:
    limit = output.threshold_text(run.threshold, run.result.evidence)
    return f"{limit} ({run.threshold_origin})"


def _print_capture(run: Inspection) -> None:
    """Print the target, the frames, and how many points were judged."""
    recording = run.recordings[0]
    cloud = run.result.cloud
    crop = run.arguments.crop
    is_judged = np.isfinite(run.result.evidence.residual_m)
    pieces = run.result.evidence.notes.get("pieces")
    if pieces:
        print(part_text(pieces))
    output.print_choice(run.choices[0])
    output.print_capture(recording, cloud, recording.name, is_judged, crop)
    off_count = cloud.valid.sum() - is_judged.sum()
    if not cloud.organised and crop == "auto" and off_count > 0:
        text = f"{off_count} points lie off the target or on its rim: not judged"
        print(f"note: {text}; --crop none judges all of them")


def _print_map(run: Inspection, mapped: Mapped) -> None:
    """Print the registrations, and the size of the merged cloud."""
    output.print_registrations(run.registrations)
    merged = mapped.merged
    output.print_notes(merged.notes)
    cloud = run.result.cloud
    judged_count = np.isfinite(run.result.evidence.residual_m).sum()
    text = f"{len(merged.views_used)} views, {cloud.valid.sum()} points, {judged_count} judged"
    if run.cell_m is not None:
        height, width = cloud.valid.shape
        text += f", a map of {width} x {height} cells of {output.mm(run.cell_m)}"
    print(f"merged: {text}")


def write_inspection(
    run: Inspection,
    command: str,
    further_inputs: Sequence[Path] = (),
    further_files: Mapping[str, FileWriter] | None = None,
    further_warnings: Sequence[str] = (),
) -> None:
    """Write the findings, their facts and pictures into the folder of ``--out``, and print the
    paths. ``further_inputs``: other files that were read; ``further_files``: how to write other
    files, by name; ``further_warnings``: last on the page."""
    mapped = run.mapped
    limit = output.threshold_text(run.threshold, run.result.evidence)
    subject = f"{len(mapped.merged.views_used)} views" if mapped else run.recordings[0].name
    title = f"{subject}: {len(run.result.detections)} findings beyond {limit}"
    files: dict[str, FileWriter] = dict(further_files or {})
    facts = _facts(run, command, further_inputs)
    scene = output.scene_of(run.result, _scene_facts(run), mapped)
    if mapped is None:
        cloud_name = "cloud.ply"
        files |= output.pictures(run.choices[0])
    else:
        from harness.report.view3d import write_view3d

        cloud_name = "merged.ply"
        registrations = plain_json(run.registrations)
        files["registrations.json"] = lambda path: path.write_text(registrations, encoding="utf-8")
        files["view3d.html"] = lambda path: write_view3d(path, scene, title)
        for number, choice in enumerate(run.choices, start=1):
            files |= output.pictures(choice, f"targets-{number}.png")
    if run.changes is not None:
        changes_csv = run.changes.csv_text
        files[outputs.CHANGE.name] = lambda path: path.write_text(changes_csv, encoding="utf-8")
    if run.decision is not None:
        sheets = Sheets(run.decision, _decision_rows(run), facts["provenance"]["files"])
        files[outputs.DECISION.name] = lambda path: path.write_text(
            sheets.html(run.result), encoding="utf-8"
        )
        files[outputs.DECISION_DATA.name] = lambda path: path.write_text(
            plain_json(sheets.facts), encoding="utf-8"
        )
    page = partial(_page_html, run, subject, scene, facts["provenance"], further_warnings)
    files[outputs.INSPECTION_PAGE.name] = lambda path: path.write_text(page(), encoding="utf-8")
    written = write_findings(
        run.arguments.out, run.result, facts, title, cloud_name=cloud_name, beside=files
    )
    for path in written:
        print(f"wrote {path}")


def _scene_facts(run: Inspection) -> list[tuple[str, str]]:
    """Return what stands beside the cloud."""
    if run.mapped is not None:
        return output.map_facts(run.mapped, run.result)
    frames = str(run.result.cloud.n_frames)
    return [("frames averaged", frames), ("findings", str(len(run.result.findings)))]


def _facts(run: Inspection, command: str, further_inputs: Sequence[Path]) -> dict[str, Any]:
    """Return the facts in the JSON file besides the findings, with the origin and digests of all
    files read."""
    evidence = run.result.evidence
    arguments = run.arguments
    settings: dict[str, Any] = {"average": arguments.average, "unit": arguments.unit}
    if run.config is not None:
        settings["mapping"] = run.config.to_data()
    settings["detector"] = {
        "name": run.detector.name,
        "version": run.detector.version,
        "settings": run.settings,
    }
    recordings = [*run.recordings, *run.quiet_recordings]
    inputs = [path for recording in recordings for path in recording.files]
    if run.reference is not None:
        inputs += run.reference.files
    for path in (arguments.poses, arguments.flat_field, *further_inputs):
        if path:
            inputs.append(path)
    scale_mm = evidence.scale_m / MM
    threshold_mm = None if evidence.unit else run.threshold * scale_mm
    return {
        **_capture_facts(run),
        "threshold": {"k": run.threshold, "mm": threshold_mm, "from": run.threshold_origin},
        "verdict": run.verdict.facts,
        "limit": None if run.limit is None else run.limit.facts,
        "change": None if run.changes is None else run.changes.facts,
        "tolerance": None if run.decision is None else run.decision.facts,
        "warnings": evidence.warnings,
        "missing_returns": None if run.result.missing is None else run.result.missing.facts,
        "surface": {"one_unit_of_score_mm": scale_mm, **evidence.notes},
        "settings": settings,
        "provenance": {**record(command), "files": [_file_facts(path) for path in inputs]},
    }


def _capture_facts(run: Inspection) -> dict[str, Any]:
    """Return the facts about one capture, or about the views and their map."""
    if run.mapped is None:
        return {
            "target": output.choice_facts(run.choices[0]),
            "capture": output.capture_facts(run.recordings[0], run.result.cloud),
        }
    merged = run.mapped.merged
    captures = []
    for recording, view, choice in zip(run.recordings, run.mapped.views, run.choices, strict=True):
        captures.append(
            {
                "view": view.view.name,
                **output.capture_facts(recording, view.view.cloud),
                "target": output.choice_facts(choice),
            }
        )
    frame = (
        "of the merged cloud; registrations.json has its pose relative to the first view's camera"
    )
    cell_mm = None if run.cell_m is None else run.cell_m / MM
    return {
        "frame": frame,
        "captures": captures,
        "merged": {"views": merged.views_used, "cell_mm": cell_mm, "notes": merged.notes},
    }


def _file_facts(path: Path) -> dict[str, str]:
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return {"path": path.as_posix(), "sha256": digest}


# ---------------------------------------------------------------- the page


def _page_html(
    run: Inspection,
    subject: str,
    scene: Scene3d,
    provenance: Mapping[str, Any],
    further_warnings: Sequence[str],
) -> str:
    """Return report.html as text."""
    from harness.report.inspection_page import PageText, inspection_html

    text = PageText(
        title=subject,
        sentence=_sentence(run),
        conditions=_conditions(run),
        warnings=(*warnings_of(run), *further_warnings),
        classes={name: CLASSES[name] for name in run.verdict.counts},
        flags=FLAGS,
        summary=tuple(_summary_rows(run)),
        judged=tuple(_judged_rows(run)),
        facts=tuple(_fact_rows(run)),
        further=_sections(run),
        files=_files_text(run),
        provenance=provenance,
    )
    return inspection_html(run.result, scene, text)


def _sentence(run: Inspection) -> str:
    """Return the decision on the tolerances, if there are any, and the verdict."""
    if run.decision is None:
        return run.verdict.sentence
    return f"{run.decision.short}. {run.verdict.sentence}"


def _conditions(run: Inspection) -> str:
    """Return the frames, the distance and the detector in a few words."""
    cloud = run.result.cloud
    is_judged = np.isfinite(run.result.evidence.residual_m)
    parts = [many(cloud.n_frames, "frame")]
    if run.mapped is not None:
        views = many(len(run.mapped.merged.views_used), "view")
        parts = [f"{views} merged"]
    elif is_judged.any():
        distance_m = float(np.median(run.result.evidence.surface_z_m[is_judged]))
        parts.append(f"{distance_m:.2f} m away")
    parts.append(f"detector {run.detector.name} {run.detector.version}")
    if run.reference is not None:
        parts.append(f"compared with {run.reference.name}")
    return ", ".join(parts)


def _summary_rows(run: Inspection) -> list[tuple[str, str]]:
    """Return the figures of the verdict."""
    verdict = run.verdict
    rows = [(name, str(count)) for name, count in verdict.counts.items()]
    if run.changes is not None:
        rows += [(state, str(count)) for state, count in run.changes.counts.items()]
    extent = verdict.extent
    if np.isfinite(extent.judged_m2):
        rows.append(("judged", _area_text(extent.judged_m2)))
    if np.isfinite(extent.judged_share):
        rows.append(("share of the part", f"{100 * extent.judged_share:.0f} %"))
    if np.isfinite(extent.blind_m2):
        rows.append(("blind", f"{1e4 * extent.blind_m2:.3g} cm2"))
    false_sure = verdict.expected_false_sure
    rows.append(("false calls", verdict.calls.text))
    rows.append(("of them among the sure", calls_text(false_sure)))
    return rows


def _area_text(area_m2: float) -> str:
    """Return an area to four digits, in cm2 below a square metre."""
    return f"{1e4 * area_m2:.4g} cm2" if area_m2 < 1.0 else f"{area_m2:.4g} m2"


def _judged_rows(run: Inspection) -> list[tuple[str, str]]:
    """Return what was judged and what not."""
    extent = run.verdict.extent
    rows = []
    if np.isfinite(extent.judged_m2):
        share = ""
        if np.isfinite(extent.judged_share):
            share = f", {100 * extent.judged_share:.0f} % of the part's outline"
        rows.append(("judged", f"{_area_text(extent.judged_m2)}{share}"))
    missing = run.result.missing
    if missing is not None:
        blind = f"{1e4 * extent.blind_m2:.3g} cm2, {100 * missing.blind:.2g} % of the outline"
        rows.append(("blind: no light came back", blind))
    null = run.result.evidence.notes.get("own_null")
    if null is not None:
        rim = f"{null['rim_pixels']} pixels, not judged"
        rows.append(("rim mixed with what lies behind", rim))
        objects = f"{null['objects']} places"
        if np.isfinite(null["at_marks"]):
            objects += f", {calls_text(null['at_marks'])} false calls expected there"
        rows.append(("objects, printed marks and edges in the picture", objects))
    choice = run.choices[0]
    if run.mapped is None and choice is not None:
        for number, candidate in enumerate(choice.candidates, start=1):
            role = "taken" if number == choice.taken else f"not judged: --target {number}"
            rows.append((f"surface {number}", f"{described_text(candidate)} ({role})"))
    pieces = run.result.evidence.notes.get("pieces")
    if pieces is not None:
        rows.append(("pieces of the part", plain(pieces)))
    return rows


def _fact_rows(run: Inspection) -> list[tuple[str, str]]:
    """Return how the capture was read and judged."""
    rows = []
    for recording in run.recordings:
        rows.append((recording.name, "; ".join((recording.unit_text, *recording.notes))))
    for left_out in run.result.cloud.left_out:
        rows.append(("left out", f"{left_out.name}: {left_out.why}"))
    for registration in run.registrations.get("views", ()):
        rows.append((f"registration of {registration['view']}", _registration_text(registration)))
    rows.append(("surface", _surface_text(run)))
    rows.append(("threshold", _threshold_text(run)))
    choice = run.result.evidence.notes.get("choice")
    if choice is not None:
        rows.append(("choice of the detector", plain(choice)))
    return rows


def _sections(run: Inspection) -> dict[str, Markup]:
    """Return the sections that only some inspections have, by their headings."""
    sections = {}
    if run.decision is not None:
        sections["Within tolerance?"] = decision_section(run.decision)
    if run.changes is not None:
        sections["What changed"] = changes_section(run.changes)
    if run.limit is not None:
        sections["What would have been missed"] = _limit_section(run.limit)
    return sections


def _decision_rows(run: Inspection) -> list[tuple[str, str]]:
    """Return part, reference, conditions and version of a decision."""
    reference = "none: a smooth surface"
    if run.arguments.reference is not None:
        reference = str(run.arguments.reference)
    return [
        ("part", ", ".join(recording.name for recording in run.recordings)),
        ("reference", reference),
        ("conditions", _conditions(run)),
        ("version", made_by(record(""))),
    ]


def _limit_section(limit: Limit) -> Markup:
    """Return the section on sizes that would have been missed."""
    heads = ("width (mm)", "depth (mm)", "found", "95 % interval")
    rows = []
    for size in limit.sizes:
        share = f"{100 * size.low:.0f} to {100 * size.high:.0f} %"
        found = f"{size.hits} of {size.places}"
        rows.append((f"{size.diameter_mm:.2f}", f"{size.depth_mm:.2f}", found, share))
    sentence = f"{limit.text[0].upper()}{limit.text[1:]}."
    how = (
        "Flat discs were pressed into this capture's cloud at places without findings, blurred by"
        " the camera's filter, and searched by the same detector at the same threshold."
    )
    return joined([paragraph(sentence), paragraph(how), Grid.of(heads, rows).html()])


def _registration_text(registration: Mapping[str, Any]) -> str:
    residual = output.number(registration["residual_mm"], 3)
    in_plane = output.number(registration["predicted_in_plane_mm"], 3)
    across = output.number(registration["predicted_across_mm"], 3)
    return (
        f"{registration['method']}, residual {residual} mm, predicted error {in_plane} mm in plane"
        f" and {across} mm across"
    )


def _files_text(run: Inspection) -> dict[str, str]:
    """Return the files beside the page, with their content."""
    shown = [outputs.FINDINGS, outputs.FINDINGS_DATA, outputs.ANNOTATED]
    if run.result.missing is not None:
        shown.append(outputs.BLIND)
    if run.mapped is None and run.choices[0] is not None:
        shown.append(outputs.TARGETS)
    if run.changes is not None:
        shown.append(outputs.CHANGE)
    if run.decision is not None:
        shown += [outputs.DECISION, outputs.DECISION_DATA]
    files = {shown_file.name: shown_file.note for shown_file in shown}
    if run.mapped is None:
        files[outputs.CLOUD.name] = outputs.CLOUD.note
    else:
        files["merged.ply"] = "the merged cloud, with findings in magenta"
        files["registrations.json"] = "the pose of each view, with its covariance and checks"
        files["view3d.html"] = "the merged cloud that can be turned, as a page of its own"
    return files
