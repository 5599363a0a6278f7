"""The steps of `tofpod detect`: one capture, or several views merged into one cloud, judged and
reported alike."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.averages.average import RECORDED, average, unsteadiness
from detectors.averages.flat_field import FlatField, corrected, doubts, load_flat_field
from detectors.crop import Choice
from detectors.interface import Detector, Evidence
from detectors.pixels.noise import REACH_FRAMES, noise_reach_px
from detectors.surfaces.pieces import part_text, piece_facts
from detectors.views.view import View
from harness.inspection import arguments as cli
from harness.inspection import output
from harness.inspection.judging import (
    analysed,
    judged,
    refuse_thresholds,
    threshold_of,
    with_faint_warning,
    with_size_warnings,
)
from harness.inspection.several_views import merged_views, mistakes_named, registration_data
from harness.report.findings import Judged, write_findings
from harness.vocabulary.files import plain_json
from harness.vocabulary.geometry import MM, Cloud
from harness.vocabulary.provenance import record

if TYPE_CHECKING:
    from detectors.recordings import Recording
    from detectors.views.mapping.merge import Mapped
    from detectors.views.mapping.settings import MappingConfig

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

    @property
    def cell_m(self) -> float | None:
        """The side of a map's cells, None if the cloud is not a map."""
        surface_map = self.mapped.merged.surface_map if self.mapped else None
        return surface_map.cell_m if surface_map else None


def inspected(arguments: argparse.Namespace) -> Inspection:
    """Open, average, register and merge views, and judge. Raises UserError."""
    config = cli.mapping_of(arguments) if arguments.register is not None else None
    paths = arguments.paths[: config.views] if config else arguments.paths
    cli.refuse_misfits(arguments, paths)
    refuse_thresholds(arguments)
    detector, settings = _detector_of(arguments, config)
    flat_field = load_flat_field(arguments.flat_field) if arguments.flat_field else None
    guesses: Sequence[np.ndarray | None] = (None,) * len(paths)
    if arguments.poses:
        guesses = cli.read_poses(arguments.poses, len(paths))
    captures = [[path] for path in paths] if config else [paths]
    recordings = [_opened(arguments, capture) for capture in captures]
    quiet_recordings = []
    if arguments.quiet_capture is not None:
        quiet_recordings.append(_opened(arguments, [arguments.quiet_capture]))

    names = _names(paths) if config else [recordings[0].name]
    views = []
    for name, recording, guess in zip(names, recordings, guesses, strict=False):
        views.append(View(name, _averaged(arguments, recording, flat_field), guess))
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

    def silent_threshold() -> tuple[float, str]:
        """Return the lowest threshold that is silent on the quiet capture, and its origin."""
        undamaged = _averaged(arguments, quiet_recordings[0], flat_field)
        threshold = detector.quiet_threshold(undamaged, detector.analyse(undamaged))
        frames = f"{undamaged.n_frames} frames, here {cloud.n_frames}"
        quiet = f"{arguments.quiet_capture}, one repeat of {frames}"
        return threshold, f"the lowest that is silent on {quiet}"

    evidence = analysed(detector, cloud)
    if mapped is None:
        evidence = _with_pieces(evidence, cloud, choices[0])
    capture_doubts = _capture_doubts(arguments, views, flat_field)
    evidence = replace(evidence, warnings=(*capture_doubts, *evidence.warnings))
    threshold, threshold_origin, evidence = threshold_of(
        arguments, detector, cloud, evidence, silent_threshold
    )
    result = judged(detector, cloud, evidence, threshold)
    if mapped is None:
        result = with_faint_warning(result, threshold)
    result = with_size_warnings(result)
    return Inspection(
        arguments=arguments,
        recordings=recordings,
        quiet_recordings=quiet_recordings,
        choices=choices,
        config=config,
        mapped=mapped,
        registrations=registrations,
        detector=detector,
        settings=settings,
        result=result,
        threshold=threshold,
        threshold_origin=threshold_origin,
    )


def _with_pieces(evidence: Evidence, cloud: Cloud, choice: Choice | None) -> Evidence:
    """Note the pieces of the chosen part, and how much of each was judged."""
    if choice is None or choice.part is None:
        return evidence
    fit = str(evidence.notes.get("shape", evidence.notes.get("surface", "")))
    pieces = piece_facts(choice.part, cloud, evidence.residual_m, fit)
    return replace(evidence, notes={**evidence.notes, "pieces": pieces})


def _detector_of(
    arguments: argparse.Namespace, config: MappingConfig | None
) -> tuple[Detector, dict[str, Any]]:
    """Return the detector and its settings. With several views the target is cut out of each view,
    and settings of the map are not the detector's."""
    if config is None:
        return cli.detector_of(arguments, arguments.crop, arguments.set)
    own_settings = [
        assignment for assignment in arguments.set if not assignment.startswith(cli.PREFIX)
    ]
    return cli.detector_of(arguments, "none", own_settings)


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
    reach_px = noise_reach_px(first_frames, recording.z_step_m) if first_frames else 0.0
    cloud = replace(cloud, projection=recording.projection, noise_reach_px=reach_px)
    return cloud if flat_field is None else corrected(cloud, flat_field)


def _capture_doubts(
    arguments: argparse.Namespace, views: Sequence[View], flat_field: FlatField | None
) -> list[str]:
    """Return doubts about the frames of the views and about the flat field, each once."""
    found: list[str] = []
    for view in views:
        unsteady = unsteadiness(view.cloud)
        if unsteady:
            found.append(unsteady)
    if flat_field is not None:
        for view in views:
            found += doubts(view.cloud, flat_field, arguments.flat_field)
    return list(dict.fromkeys(found))


def print_inspection(run: Inspection, further_warnings: Sequence[str] = ()) -> None:
    """Print warnings (``further_warnings`` last), the capture, the surface, the threshold and the
    findings."""
    evidence = run.result.evidence
    warnings = [warning for recording in run.recordings for warning in recording.warnings]
    choice = run.choices[0]
    if run.mapped is None and choice:
        # with several views, doubts about their targets were printed before the registration
        warnings += choice.warnings
    output.print_warnings((*warnings, *evidence.warnings, *further_warnings))
    if run.mapped is None:
        _print_capture(run)
    else:
        _print_map(run, run.mapped)
    unit = evidence.unit or f"{output.mm(evidence.scale_m)} at the median point"
    print(f"surface: {evidence.notes.get('surface', '')}; one unit of score is {unit}")
    if run.result.missing is not None:
        print(run.result.missing.blind_text)
    threshold = output.threshold_text(run.threshold, evidence)
    print(f"threshold: {threshold} ({run.threshold_origin})")
    output.print_findings(run.result.findings, grid="px" if run.cell_m is None else "cell")


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
) -> None:
    """Write the findings, their facts and pictures into the folder of ``--out``, and print the
    paths. ``further_inputs``: other files that were read; ``further_files``: how to write other
    files, by name."""
    mapped = run.mapped
    limit = output.threshold_text(run.threshold, run.result.evidence)
    subject = f"{len(mapped.merged.views_used)} views" if mapped else run.recordings[0].name
    title = f"{subject}: {len(run.result.detections)} findings beyond {limit}"
    files: dict[str, FileWriter] = dict(further_files or {})
    if mapped is None:
        cloud_name = "cloud.ply"
        files |= output.pictures(run.choices[0])
    else:
        from harness.report.view3d import write_view3d

        cloud_name = "merged.ply"
        scene = output.scene_of(mapped, run.result)
        registrations = plain_json(run.registrations)
        files["registrations.json"] = lambda path: path.write_text(registrations, encoding="utf-8")
        files["view3d.html"] = lambda path: write_view3d(path, scene, title)
        for number, choice in enumerate(run.choices, start=1):
            files |= output.pictures(choice, f"targets-{number}.png")
    facts = _facts(run, command, further_inputs)
    written = write_findings(
        run.arguments.out, run.result, facts, title, cloud_name=cloud_name, beside=files
    )
    for path in written:
        print(f"wrote {path}")


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
    for path in (arguments.poses, arguments.flat_field, *further_inputs):
        if path:
            inputs.append(path)
    scale_mm = evidence.scale_m / MM
    threshold_mm = None if evidence.unit else run.threshold * scale_mm
    return {
        **_capture_facts(run),
        "threshold": {"k": run.threshold, "mm": threshold_mm, "from": run.threshold_origin},
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
    return {"path": str(path), "sha256": digest}
