"""Several captures as views of one target: registered, merged, and judged as one cloud."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np

from harness.inspection import printed, steps
from harness.inspection.poses import read_poses
from harness.inspection.registrations import Checks, checks_of, print_registrations, registration_rows
from harness.inspection.several_arguments import mapping_config
from harness.inspection.target import choice_by, choice_facts, pictures, print_choice
from harness.vocabulary.errors import UserError
from harness.vocabulary.units import MM
from harness.vocabulary.versions import RESULTS_VERSION

if TYPE_CHECKING:
    from detectors.interface import Detector
    from detectors.mapping.merge import Mapped
    from detectors.mapping.settings import MappingConfig
    from detectors.recordings import Recording
    from detectors.registration.registered import Registration
    from detectors.target import Choice
    from detectors.views import PreparedView, View
    from harness.report.findings import Judged

P = ParamSpec("P")
T = TypeVar("T")
START_FROM_MARKS = ("icp", "cpd")
"""Methods that need a place to start from. `joint` finds its own by marks, `odometry` uses none and goes from view to
view, `nominal` has nothing but the poses."""


@dataclass(frozen=True)
class Inspection:
    """Everything that a run knows when it is time to tell it."""

    recordings: tuple[Recording, ...]
    mapped: Mapped
    choices: tuple[Choice | None, ...]
    checks: Checks
    detector: Detector
    judged: Judged
    threshold: float
    origin: str

    @property
    def beyond(self) -> str:
        """The threshold in words."""
        return printed.beyond_text(self.threshold, self.judged.evidence)


def inspect_views(arguments: argparse.Namespace) -> int:
    """Register, merge and judge; print, and write with --out. Returns 0.

    Raises UserError for faults of the files, where a view cannot be registered, and where nothing can be judged.
    """
    config, assignments = mapping_config(arguments)
    paths = arguments.paths[: config.views]
    _refuse_misfits(arguments, paths)
    detector, settings = steps.detector_of(arguments, "none", assignments)
    guesses = read_poses(arguments.poses, len(paths)) if arguments.poses else (None,) * len(paths)
    recordings = tuple(steps.opened(arguments, [path]) for path in paths)
    views = tuple(_view(arguments, *each) for each in zip(_names(paths), recordings, guesses, strict=True))
    choices = tuple(_of_view(view, choice_by, config, view.cloud) for view in views)
    # a wrong target explains much of what may fail below
    printed.print_warnings(_doubts(views, choices))
    pairs = zip(recordings, views, choices, strict=True)
    prepared = tuple(_prepared(*each, config, arguments.crop) for each in pairs)
    mapped = _mapped(prepared, config, has_poses=arguments.poses is not None)
    inspection = _judge(arguments, recordings, mapped, choices, checks_of(mapped, config), detector)
    _print(inspection)
    if arguments.out is not None:
        _write(arguments, inspection, config, settings)
    return 0


# ---- the steps -------------------------------------------------------------------------------------------------------


def _refuse_misfits(arguments: argparse.Namespace, paths: list[Path]) -> None:
    if len(paths) < 2:
        raise UserError(
            f"{len(paths)} view to register: there is nothing to register it to",
            legal="two or more PATHs, each a capture of its own",
            fix="name the other views, or leave out --register",
        )
    places = [path.resolve() for path in paths]
    twice = next((path for path, place in zip(paths, places, strict=True) if places.count(place) > 1), None)
    if twice is not None:
        raise UserError(
            f"{twice}: is named twice; the same noise counted twice would pass for less noise",
            legal="captures from different places, each named once",
        )
    if arguments.register == "nominal" and arguments.poses is None:
        raise UserError("--register nominal takes the poses as they are, and there are none", fix="give --poses FILE")
    if arguments.quiet_capture is not None:
        raise UserError(
            "--quiet-capture is one cloud, and its noise is not that of a cloud merged from several views",
            fix="run the undamaged views in the same way, and give the threshold that is silent there as --threshold",
        )


def _names(paths: list[Path]) -> tuple[str, ...]:
    """The paths' last parts, or whole paths where these are not distinct."""
    short = [path.resolve().name for path in paths]
    return tuple(short) if len(set(short)) == len(short) else tuple(map(str, paths))


def _view(arguments: argparse.Namespace, name: str, recording: Recording, guess: np.ndarray | None) -> View:
    from detectors.views import View

    if arguments.frames_report:
        print(f"{name}:")
        printed.print_frames(recording)
    return View(name, steps.averaged(arguments, recording), guess)


def _mapped(prepared: tuple[PreparedView, ...], config: MappingConfig, has_poses: bool) -> Mapped:
    """Register and merge. Raises UserError where a view's registration failed."""
    from detectors.mapping.merge import Mapped, merge
    from detectors.registration.register import register

    if config.registration.method in START_FROM_MARKS and not has_poses:
        prepared = _started_from_marks(prepared)
    registrations = register(prepared, config.registration)
    _refuse_failures(registrations, has_poses)
    return Mapped(prepared, registrations, merge(prepared, registrations, config.merge))


def _doubts(views: tuple[View, ...], choices: tuple[Choice | None, ...]) -> tuple[str, ...]:
    """Why the choice of the target is doubtful, view by view."""
    pairs = zip(views, choices, strict=True)
    return tuple(f"view {view.name}: {warning}" for view, choice in pairs if choice for warning in choice.warnings)


def _prepared(
    recording: Recording, view: View, choice: Choice | None, config: MappingConfig, crop: str
) -> PreparedView:
    """One view with its target and marks, which are told at once: they explain a registration that fails later.

    Raises UserError where it has no target.
    """
    from detectors.mapping.merge import prepare

    prepared = _of_view(view, prepare, view, config)
    print_choice(choice)
    printed.print_view(recording, prepared, crop)
    return prepared


def _of_view(view: View, step: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
    """A step's outcome; its UserError names the view."""
    try:
        return step(*arguments, **named)
    except UserError as mistake:
        raise UserError(f"view {view.name}: {mistake.message}", legal=mistake.legal, fix=mistake.fix) from mistake


def _started_from_marks(prepared: tuple[PreparedView, ...]) -> tuple[PreparedView, ...]:
    """The views with guesses by their marks, and the identity where marks do not tell, which is said."""
    from detectors.registration.by_marks import register_by_marks

    started = [_with_guess(prepared[0], np.eye(4))]
    for view in prepared[1:]:
        by_marks = register_by_marks(prepared[0], view)
        if by_marks.failure:
            print(f"note: {view.view.name} starts from where {prepared[0].view.name} stands: {by_marks.failure}")
        started.append(_with_guess(view, np.eye(4) if by_marks.failure else by_marks.T_reference_view))
    return tuple(started)


def _with_guess(prepared: PreparedView, T_reference_view: np.ndarray) -> PreparedView:
    return replace(prepared, view=replace(prepared.view, T_reference_view_guess=T_reference_view))


def _refuse_failures(registrations: tuple[Registration, ...], has_poses: bool) -> None:
    """Raise UserError that names each view that cannot be placed, and why."""
    failed = [each for each in registrations if each.failure]
    if failed:
        told = "\n  ".join(f"{each.view}: {each.failure.removeprefix(f'{each.view}: ')}" for each in failed)
        pose = "correct --poses where it is wrong" if has_poses else "state where they stand (--poses)"
        several = f"{len(failed)} of {len(registrations)} views" if len(failed) > 1 else "one view"
        raise UserError(
            f"{several} cannot be registered to {registrations[0].view} by {failed[0].method}:\n  {told}",
            fix=f"leave such views out, {pose}, or choose another --register or --marks",
        )


def _judge(
    arguments: argparse.Namespace,
    recordings: tuple[Recording, ...],
    mapped: Mapped,
    choices: tuple[Choice | None, ...],
    checks: Checks,
    detector: Detector,
) -> Inspection:
    cloud = mapped.merged.cloud
    evidence = steps.analysed(detector, cloud)
    # a quiet capture was refused before
    threshold, origin, evidence = steps.threshold_of(
        arguments, detector, cloud, evidence, lambda: (steps.DEFAULT_K, "")
    )
    judged = steps.judged(detector, cloud, evidence, threshold)
    return Inspection(recordings, mapped, choices, checks, detector, judged, threshold, origin)


# ---- what is told ----------------------------------------------------------------------------------------------------


def _print(inspection: Inspection) -> None:
    mapped, judged = inspection.mapped, inspection.judged
    recorded = (warning for recording in inspection.recordings for warning in recording.warnings)
    printed.print_warnings((*recorded, *judged.evidence.warnings))
    print_registrations(mapped, inspection.checks)
    cloud, merged = judged.cloud, mapped.merged
    for note in merged.notes:
        print(f"note: {note}")
    kept = np.isfinite(judged.evidence.residual_m)
    height, width = cloud.valid.shape
    cell_m = None if merged.surface_map is None else merged.surface_map.cell_m
    grid = f", a map of {width} x {height} cells of {printed.mm(cell_m)}" if cell_m is not None else ""
    print(f"merged: {len(merged.views_used)} views, {cloud.valid.sum()} points, {kept.sum()} judged{grid}")
    if judged.missing is not None:
        print(judged.missing.blind_text)
    print(printed.surface_text(cloud, judged.evidence))
    print(printed.threshold_text(inspection.threshold, judged.evidence, inspection.origin))
    printed.print_findings(judged.findings, grid="px" if cell_m is None else "cell")


def _write(
    arguments: argparse.Namespace, inspection: Inspection, config: MappingConfig, settings: dict[str, Any]
) -> None:
    from harness.inspection.scene import scene_of
    from harness.report.findings import plain_json, write_findings
    from harness.report.view3d import write_view3d

    judged, merged = inspection.judged, inspection.mapped.merged
    title = f"{len(merged.views_used)} views: {len(judged.detections)} findings beyond {inspection.beyond}"
    rows = {"results_version": RESULTS_VERSION, **registration_rows(inspection.mapped, inspection.checks)}
    beside = {
        "registrations.json": lambda path: path.write_text(plain_json(rows), encoding="utf-8"),
        "view3d.html": lambda path: write_view3d(path, scene_of(inspection.mapped, judged), title),
    }
    for number, choice in enumerate(inspection.choices, start=1):
        beside |= pictures(choice, f"targets-{number}.png")
    about = _about(arguments, inspection, config, settings)
    for path in write_findings(arguments.out, judged, about, title, cloud_name="merged.ply", beside=beside):
        print(f"wrote {path}")


def _about(
    arguments: argparse.Namespace, inspection: Inspection, config: MappingConfig, settings: dict[str, Any]
) -> dict[str, Any]:
    """What the JSON says beside the findings."""
    judged, mapped = inspection.judged, inspection.mapped
    evidence, detector = judged.evidence, inspection.detector
    pairs = zip(inspection.recordings, mapped.views, inspection.choices, strict=True)
    return {
        "frame": "of the merged cloud; registrations.json says where it stands to the first view's camera",
        "captures": [
            {"view": view.view.name, **steps.capture_facts(recording, view.view.cloud), "target": choice_facts(choice)}
            for recording, view, choice in pairs
        ],
        "merged": {
            "views": mapped.merged.views_used,
            "cell_mm": None if mapped.merged.surface_map is None else mapped.merged.surface_map.cell_m / MM,
            "notes": mapped.merged.notes,
        },
        "warnings": evidence.warnings,
        "missing_returns": None if judged.missing is None else judged.missing.facts,
        "threshold": {
            "k": inspection.threshold,
            "mm": 1e3 * inspection.threshold * evidence.scale_m,
            "from": inspection.origin,
        },
        "surface": {"one_unit_of_score_mm": 1e3 * evidence.scale_m, **evidence.notes},
        "settings": {
            "average": arguments.average,
            "unit": arguments.unit,
            "mapping": config.to_data(),
            "detector": {"name": detector.name, "version": detector.version, "settings": settings},
        },
        "provenance": steps.provenance(inspection.recordings, *([arguments.poses] if arguments.poses else [])),
    }
