"""`harness.detect` step by step: one capture, or several views that become one cloud, judged and told in one way."""

from __future__ import annotations

import argparse
import hashlib
import shlex
import sys
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.inspection import told
from harness.inspection.arguments import PREFIX, averaged, detector_of, mapping_of, opened, refuse_misfits
from harness.inspection.judging import analysed, judged, threshold_of, with_faint_told
from harness.inspection.poses import read_poses
from harness.vocabulary.errors import UserError
from harness.vocabulary.units import MM
from harness.vocabulary.versions import RESULTS_VERSION

if TYPE_CHECKING:
    from collections.abc import Iterator

    from detectors.interface import Detector
    from detectors.mapping.merge import Mapped
    from detectors.mapping.settings import MappingConfig
    from detectors.recordings import Recording
    from detectors.target import Choice
    from detectors.views import PreparedView, View
    from harness.report.findings import Judged

START_FROM_MARKS = ("icp", "cpd")
"""Methods that need a place to start from. `joint` finds its own by marks, `odometry` uses none and goes from view to
view, `nominal` has nothing but the poses."""
LOOPING = ("marks", "icp", "cpd")
"""Methods that register any two views to each other by themselves, so that going round a loop can be wrong."""


@dataclass(frozen=True)
class Merging:
    """Several views as one cloud: the settings, the views with their registrations, and checks of these."""

    config: MappingConfig
    mapped: Mapped
    checks: told.Checks


@dataclass(frozen=True)
class Inspection:
    """Everything that a run knows when it is time to tell it. ``merging`` is None for one capture."""

    arguments: argparse.Namespace
    recordings: list[Recording]
    choices: list[Choice | None]
    merging: Merging | None
    detector: Detector
    settings: dict[str, Any]
    result: Judged
    threshold: float
    origin: str

    @property
    def cell_m(self) -> float | None:
        """The side of a map's cells, None where the cloud is no map."""
        surface_map = None if self.merging is None else self.merging.mapped.merged.surface_map
        return None if surface_map is None else surface_map.cell_m


def inspect(arguments: argparse.Namespace) -> int:
    """Open, average, register and merge where there are several views, judge; print, and write with --out. Returns 0.

    Raises UserError for faults of the files, where a view cannot be registered, and where nothing can be judged.
    """
    config = mapping_of(arguments) if arguments.register is not None else None
    paths = arguments.paths if config is None else arguments.paths[: config.views]
    refuse_misfits(arguments, paths)
    own_settings = [each for each in arguments.set if config is None or not each.startswith(PREFIX)]
    detector, settings = detector_of(arguments, "none" if config else arguments.crop, own_settings)
    guesses = read_poses(arguments.poses, len(paths)) if arguments.poses else (None,) * len(paths)
    recordings = [opened(arguments, group) for group in ([[path] for path in paths] if config else [paths])]
    wants_quiet = arguments.quiet_capture is not None and arguments.threshold is arguments.false_calls is None
    quiet = opened(arguments, [arguments.quiet_capture]) if wants_quiet else None

    merging: Merging | None = None
    if config is None:
        if arguments.frames_report:
            told.print_frames(recordings[0])
        cloud = averaged(arguments, recordings[0])
        choices = [told.choice_by(getattr(detector, "settings", None), cloud)]
    else:
        views = _views(arguments, paths, recordings, guesses)
        choices = []
        for view in views:
            with _mistakes_named(view):
                choices.append(told.choice_by(config, view.cloud))
        merging = _merged(arguments, config, recordings, views, choices)
        cloud = merging.mapped.merged.cloud

    evidence = analysed(detector, cloud)

    def silent_threshold() -> tuple[float, str]:
        assert quiet is not None
        undamaged = averaged(arguments, quiet)
        threshold = detector.quiet_threshold(undamaged, detector.analyse(undamaged))
        frames = f"{undamaged.n_frames} frames, here {cloud.n_frames}"
        return threshold, f"the lowest that is silent on {arguments.quiet_capture}, one repeat of {frames}"

    threshold, origin, evidence = threshold_of(arguments, detector, cloud, evidence, silent_threshold)
    result = judged(detector, cloud, evidence, threshold)
    result = with_faint_told(result, threshold) if merging is None else result
    inspection = Inspection(arguments, recordings, choices, merging, detector, settings, result, threshold, origin)
    _print(inspection)
    if arguments.out is not None:
        _write(inspection, _facts(inspection, [*recordings, *([quiet] if quiet else [])]))
    return 0


# ---- several views as one cloud --------------------------------------------------------------------------------------


@contextmanager
def _mistakes_named(view: View) -> Iterator[None]:
    """Name the view in a UserError of one of its steps."""
    try:
        yield
    except UserError as mistake:
        raise UserError(f"view {view.name}: {mistake.message}", legal=mistake.legal, fix=mistake.fix) from mistake


def _views(
    arguments: argparse.Namespace,
    paths: Sequence[Path],
    recordings: Sequence[Recording],
    guesses: Sequence[np.ndarray | None],
) -> list[View]:
    """Average each capture, and name it by its path's last part, or by the whole path where these are not distinct."""
    from detectors.views import View

    names = [path.resolve().name for path in paths]
    names = names if len(set(names)) == len(names) else list(map(str, paths))
    views = []
    for name, recording, guess in zip(names, recordings, guesses, strict=True):
        if arguments.frames_report:
            print(f"{name}:")
            told.print_frames(recording)
        views.append(View(name, averaged(arguments, recording), guess))
    return views


def _merged(
    arguments: argparse.Namespace,
    config: MappingConfig,
    recordings: Sequence[Recording],
    views: Sequence[View],
    choices: Sequence[Choice | None],
) -> Merging:
    """Find targets and marks, which are told at once as they explain later failures, then register and merge.

    Raises UserError where a view has no target, or names each view that cannot be placed, and why.
    """
    from detectors.mapping.merge import Mapped, merge, prepare
    from detectors.registration.by_marks import held_out_error_m, register_by_marks
    from detectors.registration.register import loop_errors, register
    from detectors.registration.registered import predicted_error_m
    from detectors.registration.sampling import plane_through, thinned

    pairs = list(zip(recordings, views, choices, strict=True))
    told.print_warnings(f"view {view.name}: {why}" for _, view, choice in pairs if choice for why in choice.warnings)
    prepared: list[PreparedView] = []
    for recording, view, choice in pairs:
        with _mistakes_named(view):
            ready = prepare(view, config)
        told.print_choice(choice)
        told.print_capture(recording, view.cloud, view.name, ready.inside, arguments.crop)
        told.print_marks(ready)
        prepared.append(ready)

    has_poses = arguments.poses is not None
    reference = prepared[0]
    if config.registration.method in START_FROM_MARKS and not has_poses:
        for number, each in enumerate(prepared):
            guess = np.eye(4)
            if number:
                by_marks = register_by_marks(reference, each)
                guess = by_marks.T_reference_view if not by_marks.failure else guess
                if by_marks.failure:
                    print(f"note: {each.view.name} starts from where {reference.view.name} stands: {by_marks.failure}")
            prepared[number] = replace(each, view=replace(each.view, T_reference_view_guess=guess))
        reference = prepared[0]
    registrations = register(tuple(prepared), config.registration)
    failed = [each for each in registrations if each.failure]
    if failed:
        reasons = "\n  ".join(f"{each.view}: {each.failure.removeprefix(f'{each.view}: ')}" for each in failed)
        pose = "correct --poses where it is wrong" if has_poses else "state where they stand (--poses)"
        several = f"{len(failed)} of {len(registrations)} views" if len(failed) > 1 else "one view"
        raise UserError(
            f"{several} cannot be registered to {registrations[0].view} by {failed[0].method}:\n  {reasons}",
            fix=f"leave such views out, {pose}, or choose another --register or --marks",
        )
    mapped = Mapped(tuple(prepared), registrations, merge(tuple(prepared), registrations, config.merge))

    # checks that need no truth: marks held out, errors predicted over the reference's target, and loops
    points_m = thinned(reference.points_m)
    _, normal = plane_through(points_m)
    is_looping = config.registration.method in LOOPING and len(prepared) > 2
    loops = loop_errors(mapped.views, config.registration) if is_looping else ()
    checks = told.Checks(
        held_out_m=(None, *(held_out_error_m(reference, each) for each in prepared[1:])),
        predicted_m=tuple(predicted_error_m(each, points_m, normal) for each in registrations),
        loops=loops,
    )
    return Merging(config, mapped, checks)


# ---- what is told ----------------------------------------------------------------------------------------------------


def _print(run: Inspection) -> None:
    cloud, evidence, crop = run.result.cloud, run.result.evidence, run.arguments.crop
    recorded = [warning for recording in run.recordings for warning in recording.warnings]
    # of several views the doubts about their targets were told before they were registered
    choice = run.choices[0]
    doubts = choice.warnings if run.merging is None and choice else ()
    told.print_warnings((*recorded, *doubts, *evidence.warnings))
    kept = np.isfinite(evidence.residual_m)
    lines = [told.surface_text(cloud, evidence)]
    blind = [] if run.result.missing is None else [run.result.missing.blind_text]
    if run.merging is None:
        told.print_choice(choice)
        told.print_capture(run.recordings[0], cloud, run.recordings[0].name, kept, crop)
        if not cloud.organised and crop == "auto" and (off := cloud.valid.sum() - kept.sum()) > 0:
            print(f"note: {off} points lie off the target or on its rim: not judged; --crop none judges all of them")
        lines = [*lines, *blind]
    else:
        told.print_registrations(run.merging.mapped, run.merging.checks)
        merged = run.merging.mapped.merged
        for note in merged.notes:
            print(f"note: {note}")
        height, width = cloud.valid.shape
        grid = f", a map of {width} x {height} cells of {told.mm(run.cell_m)}" if run.cell_m is not None else ""
        print(f"merged: {len(merged.views_used)} views, {cloud.valid.sum()} points, {kept.sum()} judged{grid}")
        lines = [*blind, *lines]
    for line in (*lines, told.threshold_text(run.threshold, evidence, run.origin)):
        print(line)
    told.print_findings(run.result.findings, grid="px" if run.cell_m is None else "cell")


def _facts(run: Inspection, recordings: Sequence[Recording]) -> dict[str, Any]:
    """Return the facts that the JSON holds beside the findings, with command, code, versions, and the content of every
    file that can change a number (those of ``recordings``, and the poses)."""
    from harness.vocabulary.provenance import record

    evidence, merging, arguments = run.result.evidence, run.merging, run.arguments
    facts: dict[str, Any] = {}
    if merging is None:
        facts["target"] = told.choice_facts(run.choices[0])
        facts["capture"] = told.capture_facts(run.recordings[0], run.result.cloud)
    else:
        merged, cell_mm = merging.mapped.merged, None if run.cell_m is None else run.cell_m / MM
        facts["frame"] = "of the merged cloud; registrations.json says where it stands to the first view's camera"
        facts["captures"] = [
            {
                "view": each.view.name,
                **told.capture_facts(recording, each.view.cloud),
                "target": told.choice_facts(choice),
            }
            for recording, each, choice in zip(run.recordings, merging.mapped.views, run.choices, strict=True)
        ]
        facts["merged"] = {"views": merged.views_used, "cell_mm": cell_mm, "notes": merged.notes}
    mm = 1e3 * run.threshold * evidence.scale_m
    detector = {"name": run.detector.name, "version": run.detector.version, "settings": run.settings}
    paths = [path for recording in recordings for path in recording.files]
    files = []
    for path in (*paths, *([arguments.poses] if arguments.poses else [])):
        with path.open("rb") as stream:
            files.append({"path": str(path), "sha256": hashlib.file_digest(stream, "sha256").hexdigest()})
    return {
        **facts,
        "threshold": {"k": run.threshold, "mm": None if evidence.unit else mm, "from": run.origin},
        "warnings": evidence.warnings,
        "missing_returns": None if run.result.missing is None else run.result.missing.facts,
        "surface": {"one_unit_of_score_mm": 1e3 * evidence.scale_m, **evidence.notes},
        "settings": {
            "average": arguments.average,
            "unit": arguments.unit,
            **({} if merging is None else {"mapping": merging.config.to_data()}),
            "detector": detector,
        },
        "provenance": {**record("python -m harness.detect " + shlex.join(sys.argv[1:])), "files": files},
    }


def _write(run: Inspection, facts: dict[str, Any]) -> None:
    from harness.report.findings import plain_json, write_findings

    found = f"{len(run.result.detections)} findings beyond {told.beyond_text(run.threshold, run.result.evidence)}"
    beside: dict[str, Callable[[Path], object]] = {}
    if run.merging is None:
        title, cloud_name = f"{run.recordings[0].name}: {found}", "cloud.ply"
        beside |= told.pictures(run.choices[0])
    else:
        from harness.inspection.scene import scene_of
        from harness.report.view3d import write_view3d

        mapped = run.merging.mapped
        title, cloud_name = f"{len(mapped.merged.views_used)} views: {found}", "merged.ply"
        rows = {"results_version": RESULTS_VERSION, **told.registration_rows(mapped, run.merging.checks)}
        beside["registrations.json"] = lambda path: path.write_text(plain_json(rows), encoding="utf-8")
        beside["view3d.html"] = lambda path: write_view3d(path, scene_of(mapped, run.result), title)
        for number, choice in enumerate(run.choices, start=1):
            beside |= told.pictures(choice, f"targets-{number}.png")
    for path in write_findings(run.arguments.out, run.result, facts, title, cloud_name=cloud_name, beside=beside):
        print(f"wrote {path}")
