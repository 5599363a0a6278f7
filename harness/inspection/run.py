"""The steps of `tofpod detect`: one capture, or several views merged into one cloud, judged and
reported alike."""

from __future__ import annotations

import argparse
import hashlib
import math
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.averages.average import RECORDED, average, unsteadiness
from detectors.averages.flat_field import FlatField, corrected, doubts, load_flat_field
from detectors.averages.noise import REACH_FRAMES, noise_reach_px
from detectors.crop import Choice
from detectors.findings.measure import measure_extents
from detectors.findings.missing import measure_missing, missing_returns, one_damage_once
from detectors.findings.null import each_object_once, own_threshold
from detectors.interface import Detection, Detector, Evidence, Measurement
from detectors.masks import grown, holes_filled
from detectors.surfaces.background import misfit
from detectors.views.view import PreparedView, View
from harness.inspection import arguments as cli
from harness.inspection import output
from harness.programs.inspections.gauge_board import HITS_AND_MISSES, GaugeSeen, read_gauge, seen_on
from harness.records.outputs import GAUGE_ROWS
from harness.report.findings import Judged, write_findings
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import plain_json
from harness.vocabulary.geometry import MM, Cloud
from harness.vocabulary.provenance import RESULTS_VERSION, record
from harness.vocabulary.text import show

if TYPE_CHECKING:
    from detectors.recordings import Recording
    from detectors.views.mapping.merge import Mapped
    from detectors.views.mapping.settings import MappingConfig
    from detectors.views.registration.registered import Registration

# robust deviations, if the capture sets no threshold; 0.6 of a million normal pixels lie beyond
DEFAULT_K = 5.0
FAINT_CALLS = (
    0.05  # noise explains a finding if at least this many false calls of its score are expected
)
THRESHOLDS = (
    "threshold",
    "quiet_capture",
    "false_calls",
)  # arguments of which each sets the threshold


def judged(detector: Detector, cloud: Cloud, evidence: Evidence, threshold: float) -> Judged:
    """Find damage above a threshold and missing returns, each damage and each object once, and
    measure them."""
    missing = missing_returns(cloud, evidence)
    unseen = () if missing is None else missing.detections
    searched = detector.find(cloud, evidence, threshold)
    detections = one_damage_once(cloud.valid.shape, each_object_once(cloud, evidence, searched), unseen)

    def measure(detection: Detection) -> Measurement:
        if detection.kind == "object":
            return measure_extents(
                cloud, detection, "an object that lies on the target: no model of a hole fits it"
            )
        return (measure_missing if detection.kind == "no return" else detector.measure)(
            cloud, evidence, detection
        )

    return Judged(cloud, evidence, detections, tuple(map(measure, detections)), missing)


def analysed(detector: Detector, cloud: Cloud) -> Evidence:
    """Return the detector's evidence, with a warning if it fitted a stated surface that does not
    fit."""
    evidence = detector.analyse(cloud)
    doubt = (
        ""
        if "misfit_share" in evidence.notes
        else misfit(cloud, evidence.residual_m, "the stated surface")
    )
    return replace(evidence, warnings=(*evidence.warnings, doubt)) if doubt else evidence


OPEN_MM = 75.0
FILTER_PX = 3.0
"""Depth beyond which a hole shows objects far behind it; least width of a filter that hides its
rim."""


def refuse_thresholds(arguments: argparse.Namespace) -> None:
    """Raise UserError if several arguments set the threshold, or its value is not legal."""
    given_options = [
        f"--{name.replace('_', '-')}" for name in THRESHOLDS if getattr(arguments, name) is not None
    ]
    if len(given_options) > 1:
        raise UserError(f"{' and '.join(given_options)} set the threshold", fix="give one of them")
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
    """Return the threshold, its origin, and the evidence to search with it. The threshold is
    given, calibrated on a quiet capture (by ``quiet``), the detector's own, or from the capture's
    peaks towards the camera, which may leave out a rim that cannot be judged; if these cannot be
    trusted, it is a fallback with warnings."""
    if arguments.threshold is not None:
        return arguments.threshold, "given", evidence
    if arguments.quiet_capture is not None:
        return *quiet(), evidence
    default = getattr(detector, "default_threshold", None)
    if default is not None and arguments.false_calls is None:
        return float(default), "the detector's own", evidence

    own_noise = own_threshold(detector, cloud, evidence, arguments.false_calls or cli.DEFAULT_FALSE_CALLS)
    names = ("threshold", "expected", "low", "high", "peaks", "floor", "objects", "rim_pixels")
    notes = {**evidence.notes, "own_null": {name: getattr(own_noise, name) for name in names}}
    peaks = f"{own_noise.peaks} peaks towards the camera"
    if own_noise.objects:
        peaks += (
            f"; expect more beside objects, tags and edges in the picture ({own_noise.objects} places)"
        )
    if not cloud.organised:
        peaks += "; objects on the target were not sought"
    if own_noise.rim_pixels:
        peaks += f"; {own_noise.rim_pixels} pixels along the rim are mixed with the background and are not judged"
    if own_noise.doubts:
        k = max(DEFAULT_K, own_noise.threshold) if math.isfinite(own_noise.threshold) else DEFAULT_K
        warnings = tuple(
            f"the capture cannot set its own threshold, {k:.3g} is used: {why}"
            for why in own_noise.doubts
        )
        origin = (
            f"a fallback, {k:.3g} units of score: the number of false calls is unknown; {peaks}"
        )
        return (
            k,
            origin,
            replace(own_noise.evidence, notes=notes, warnings=(*evidence.warnings, *warnings)),
        )
    expected, low, high = map(_calls, (own_noise.expected, own_noise.low, own_noise.high))
    calls = f"{expected} false calls expected, 95 % interval {low} to {high}, from {peaks}"
    return (
        own_noise.threshold,
        f"from this capture's own null: {calls}",
        replace(own_noise.evidence, notes=notes),
    )


def with_faint_warning(judged: Judged, threshold: float) -> Judged:
    """Add a warning if noise explains more of the findings than the expected false calls, in a
    capture that set its own threshold. The logarithm of the number of false calls is assumed to
    fall with the square of the score, as for normal noise, through the peaks above the floor and
    the upper 95 % bound of the number expected at the threshold."""
    null = judged.evidence.notes.get("own_null", {"threshold": None})
    if threshold != null["threshold"] or not FAINT_CALLS < null["high"] < null["peaks"]:
        return judged
    rate = math.log(2 * null["peaks"] / null["high"]) / (threshold**2 - null["floor"] ** 2)
    sure = math.sqrt(threshold**2 + math.log(null["high"] / FAINT_CALLS) / rate)
    faint = [
        str(finding.id) for finding in judged.findings if finding.kind != "no return" and finding.score < sure
    ]
    if len(faint) <= max(null["expected"], 1.0) + 1e-6:
        return judged
    faint_findings = f"{len(faint)} of {len(judged.findings)} findings ({', '.join(faint)})"
    calls = (
        f"{_calls(null['expected'])} false calls are expected, with scores up to about {sure:.2g}"
    )
    warning = f"{faint_findings} are so faint that noise explains them: {calls}"
    return replace(
        judged, evidence=replace(judged.evidence, warnings=(*judged.evidence.warnings, warning))
    )


def with_size_warnings(judged: Judged) -> Judged:
    """Add warnings if findings reach the rim of the judged area, because the rest of them was not
    seen, and if distant surfaces show through holes: the camera's filter, as wide as the noise's
    reach, then draws them over the rim."""
    cloud = judged.cloud
    if not cloud.organised:
        return judged
    outside = np.pad(
        ~holes_filled(np.isfinite(judged.evidence.residual_m)), 1, constant_values=True
    )
    rim = grown(outside, 1)[1:-1, 1:-1].ravel()
    doubts = []
    pairs = zip(judged.findings, judged.detections, strict=True)
    if cut := [str(finding.id) for finding, detection in pairs if rim[detection.pixels].any()]:
        doubts.append(
            f"findings that reach the rim of the judged area ({', '.join(cut)}) may be larger than stated"
        )
    open_ = [
        str(finding.id)
        for finding in judged.findings
        if finding.kind == "no return" or finding.depth_mm > OPEN_MM
    ]
    if open_ and cloud.noise_reach_px >= FILTER_PX:
        most_mm = (
            cloud.noise_reach_px
            * float(np.nanmedian(np.abs(np.diff(cloud.points_m[..., 0], axis=1))))
            / MM
        )
        far = f"holes that show what lies far behind, or nothing ({', '.join(open_)}), may be up to {most_mm:.2g} mm"
        doubts.append(f"{far} wider than stated: the camera's filter mixes their rim into them")
    return replace(
        judged, evidence=replace(judged.evidence, warnings=(*judged.evidence.warnings, *doubts))
    )


def _calls(expected: float) -> str:
    return f"{expected:.1f}" if expected >= 0.1 else f"{expected:.1g}" if expected >= 1e-4 else "0"


START_FROM_MARKS = (
    "icp",
    "cpd",
)  # methods that need a start; `joint` finds its own, `odometry` goes view to view


@dataclass(frozen=True)
class Inspection:
    """The results of a run. ``mapped``: None for one capture. ``registrations``: data of
    registrations.json."""

    arguments: argparse.Namespace
    recordings: list[Recording]
    choices: list[Choice | None]
    config: MappingConfig | None
    mapped: Mapped | None
    registrations: dict[str, Any]
    detector: Detector
    settings: dict[str, Any]
    result: Judged
    threshold: float
    origin: str
    seen: GaugeSeen | None

    @property
    def cell_m(self) -> float | None:
        """The side of a map's cells, None if the cloud is not a map."""
        surface_map = self.mapped.merged.surface_map if self.mapped else None
        return surface_map.cell_m if surface_map else None


def inspect(arguments: argparse.Namespace) -> int:
    """Open, average, register and merge views, judge, print, and write with --out. Returns 0.
    Raises UserError."""
    config = cli.mapping_of(arguments) if arguments.register is not None else None
    paths = arguments.paths[: config.views] if config else arguments.paths
    cli.refuse_misfits(arguments, paths)
    refuse_thresholds(arguments)
    own_settings = [
        assignment for assignment in arguments.set if config is None or not assignment.startswith(cli.PREFIX)
    ]
    detector, settings = cli.detector_of(
        arguments, "none" if config else arguments.crop, own_settings
    )
    gauge = read_gauge(arguments.gauge) if arguments.gauge else None
    field = load_flat_field(arguments.flat_field) if arguments.flat_field else None
    guesses = (
        cli.read_poses(arguments.poses, len(paths)) if arguments.poses else (None,) * len(paths)
    )
    recordings = [
        _opened(arguments, group) for group in ([[path] for path in paths] if config else [paths])
    ]
    quiet = (
        [] if arguments.quiet_capture is None else [_opened(arguments, [arguments.quiet_capture])]
    )

    # a view's name is the last part of its path, or the whole path if these parts are not distinct
    names = [path.resolve().name for path in paths] if config else [recordings[0].name]
    names = names if len(set(names)) == len(names) else list(map(str, paths))
    clouds = (_averaged(arguments, recording, field) for recording in recordings)
    views = [View(*view_parts) for view_parts in zip(names, clouds, guesses, strict=False)]
    choices: list[Choice | None] = []
    for view in views:
        with _mistakes_named(view if config else None):
            choices.append(
                output.choice_by(config or getattr(detector, "settings", None), view.cloud)
            )
    mapped = None
    registrations = dict[str, Any]()
    if config:
        mapped, registrations = _merged(arguments, config, recordings, views, choices)
    cloud = mapped.merged.cloud if mapped else views[0].cloud

    def silent_threshold() -> tuple[float, str]:
        undamaged = _averaged(arguments, quiet[0], field)
        threshold = detector.quiet_threshold(undamaged, detector.analyse(undamaged))
        frames = f"{undamaged.n_frames} frames, here {cloud.n_frames}"
        return (
            threshold,
            f"the lowest that is silent on {arguments.quiet_capture}, one repeat of {frames}",
        )

    evidence = analysed(detector, cloud)
    doubted = dict.fromkeys(doubt for view in views if (doubt := unsteadiness(view.cloud)))
    if field is not None:
        doubted |= dict.fromkeys(
            doubt for view in views for doubt in doubts(view.cloud, field, arguments.flat_field)
        )
    evidence = replace(evidence, warnings=(*doubted, *evidence.warnings))
    threshold, origin, evidence = threshold_of(
        arguments, detector, cloud, evidence, silent_threshold
    )
    result = judged(detector, cloud, evidence, threshold)
    result = with_size_warnings(result if mapped else with_faint_warning(result, threshold))
    gauge_seen = (
        seen_on(gauge, result, f"{detector.name} {detector.version}", threshold) if gauge else None
    )
    parts = (mapped, registrations, detector, settings, result, threshold, origin, gauge_seen)
    run = Inspection(arguments, recordings, choices, config, *parts)
    _print(run)
    if arguments.out is not None:
        _write(run, _facts(run, [*recordings, *quiet]))
    return 0


def _opened(arguments: argparse.Namespace, paths: Sequence[Path]) -> Recording:
    frames = slice(arguments.max_frames) if arguments.max_frames else None
    return cli.opened(paths, arguments.intrinsics, frames=frames, **cli.reading_of(arguments))


def _averaged(
    arguments: argparse.Namespace, recording: Recording, field: FlatField | None
) -> Cloud:
    cloud = average(recording, RECORDED.model_copy(update={"method": arguments.average}))
    first = list(islice(recording.frames(), REACH_FRAMES)) if cloud.organised else []
    reach_px = noise_reach_px(first, recording.z_step_m) if first else 0.0
    cloud = replace(cloud, projection=recording.projection, noise_reach_px=reach_px)
    return cloud if field is None else corrected(cloud, field)


@contextmanager
def _mistakes_named(view: View | None) -> Iterator[None]:
    """Name the view, if there are several, in a UserError from one of its steps."""
    try:
        yield
    except UserError as mistake:
        prefix = "" if view is None else f"view {view.name}: "
        raise UserError(
            f"{prefix}{mistake.message}", legal=mistake.legal, fix=mistake.fix
        ) from mistake


def _merged(
    arguments: argparse.Namespace,
    config: MappingConfig,
    recordings: Sequence[Recording],
    views: Sequence[View],
    choices: Sequence[Choice | None],
) -> tuple[Mapped, dict[str, Any]]:
    """Find targets and marks (printed at once, as they explain later failures), register and
    merge. Also return the data of registrations.json. Raises UserError if a view has no target, or
    for all views that cannot be placed."""
    from detectors.views.mapping.merge import Mapped, merge, prepare
    from detectors.views.registration.by_marks import register_by_marks
    from detectors.views.registration.register import register

    for view, choice in zip(views, choices, strict=True):
        output.print_warnings(
            f"view {view.name}: {why}" for why in (choice.warnings if choice else ())
        )
    prepared: list[PreparedView] = []
    for recording, view, choice in zip(recordings, views, choices, strict=True):
        with _mistakes_named(view):
            ready = prepare(view, config)
        output.print_choice(choice)
        output.print_capture(recording, view.cloud, view.name, ready.inside, arguments.crop)
        output.print_marks(ready)
        prepared.append(ready)
    reference = prepared[0]
    has_poses = arguments.poses is not None
    if config.registration.method in START_FROM_MARKS and not has_poses:
        for number, ready in enumerate(prepared):
            guess = np.eye(4)
            if number:
                by_marks = register_by_marks(reference, ready)
                if by_marks.failure:
                    print(
                        f"note: {ready.view.name} starts from the pose of {reference.view.name}: {by_marks.failure}"
                    )
                else:
                    guess = by_marks.T_reference_view
            prepared[number] = replace(
                ready, view=replace(ready.view, T_reference_view_guess=guess)
            )
    registrations = register(tuple(prepared), config.registration)
    failed = [registration for registration in registrations if registration.failure]
    if failed:
        reasons = "\n  ".join(
            f"{registration.view}: {registration.failure.removeprefix(f'{registration.view}: ')}" for registration in failed
        )
        several = f"{len(failed)} of {len(registrations)} views" if len(failed) > 1 else "one view"
        message = f"{several} cannot be registered to {registrations[0].view} by {failed[0].method}:\n  {reasons}"
        pose = "correct --poses" if has_poses else "state their poses (--poses)"
        raise UserError(
            message, fix=f"leave such views out, {pose}, or choose another --register or --marks"
        )
    mapped = Mapped(
        tuple(prepared), registrations, merge(tuple(prepared), registrations, config.merge)
    )
    return mapped, _registration_data(mapped)


def _registration_data(mapped: Mapped) -> dict[str, Any]:
    """Return registrations as plain data (metres in matrices, else millimetres), and checks that
    need no truth."""
    from detectors.views.registration.by_marks import held_out_error_m
    from detectors.views.registration.registered import plane_through, predicted_error_m, thinned

    reference = mapped.views[0]
    points_m = thinned(reference.points_m)
    _, normal = plane_through(points_m)

    def row(view: PreparedView, registration: Registration) -> dict[str, Any]:
        in_plane_m, across_m = predicted_error_m(registration, points_m, normal)
        held_out_m = None if view is reference else held_out_error_m(reference, view)
        return {
            "view": registration.view,
            "method": registration.method,
            "T_reference_view": registration.T_reference_view.tolist(),
            "covariance": registration.covariance.tolist(),
            "covariance_about_mm": (registration.centre_m / MM).tolist(),
            "residual_mm": registration.residual_m / MM,
            "overlap": registration.overlap,
            "predicted_in_plane_mm": in_plane_m / MM,
            "predicted_across_mm": across_m / MM,
            "held_out_mark_mm": None if held_out_m is None else held_out_m / MM,
            "marks": len(view.marks.trusted),
            "marks_doubtful": len(view.marks.marks) - len(view.marks.trusted),
            "pairs": registration.pairs,
            "notes": registration.notes,
        }

    return {
        "results_version": RESULTS_VERSION,
        "reference": reference.view.name,
        "frames": {
            "T_reference_view": "from a view's camera to the first view's camera (x right, y down, z away), metres",
            "T_reference_cloud": "from the merged cloud's frame to the first view's camera, metres",
            "covariance": "of the error of T_reference_view: turn about covariance_about_mm, rad, then shift, metres,"
            " both in the first view's frame",
        },
        "T_reference_cloud": np.asarray(mapped.merged.T_reference_cloud).tolist(),
        "views": list(map(row, mapped.views, mapped.registrations)),
    }


def _print(run: Inspection) -> None:
    cloud = run.result.cloud
    evidence = run.result.evidence
    crop = run.arguments.crop
    choice = run.choices[0]
    recorded = [warning for recording in run.recordings for warning in recording.warnings]
    # with several views, doubts about their targets were printed before the registration
    doubts = choice.warnings if run.mapped is None and choice else ()
    of_gauge = run.seen.warnings if run.seen else ()
    output.print_warnings((*recorded, *doubts, *evidence.warnings, *of_gauge))
    kept = np.isfinite(evidence.residual_m)
    if run.mapped is None:
        output.print_choice(choice)
        output.print_capture(run.recordings[0], cloud, run.recordings[0].name, kept, crop)
        if not cloud.organised and crop == "auto" and (off := cloud.valid.sum() - kept.sum()) > 0:
            print(
                f"note: {off} points lie off the target or on its rim: not judged; --crop none judges all of them"
            )
    else:
        output.print_registrations(run.registrations)
        merged = run.mapped.merged
        output.print_notes(merged.notes)
        height, width = cloud.valid.shape
        grid = (
            f", a map of {width} x {height} cells of {output.mm(run.cell_m)}"
            if run.cell_m is not None
            else ""
        )
        print(
            f"merged: {len(merged.views_used)} views, {cloud.valid.sum()} points, {kept.sum()} judged{grid}"
        )
    unit = evidence.unit or f"{output.mm(evidence.scale_m)} at the median point"
    print(f"surface: {evidence.notes.get('surface', '')}; one unit of score is {unit}")
    if run.result.missing is not None:
        print(run.result.missing.blind_text)
    print(f"threshold: {output.threshold_text(run.threshold, evidence)} ({run.origin})")
    output.print_findings(run.result.findings, grid="px" if run.cell_m is None else "cell")
    if run.seen is not None:
        output.print_notes(run.seen.notes)
        show([HITS_AND_MISSES.grid(run.seen.rows, terminal=True)])
        print(run.seen.answer)


def _facts(run: Inspection, recordings: Sequence[Recording]) -> dict[str, Any]:
    """Return the facts in the JSON file besides the findings, with the origin and digests of all
    files read."""
    evidence = run.result.evidence
    arguments = run.arguments
    settings: dict[str, Any] = {"average": arguments.average, "unit": arguments.unit}
    facts: dict[str, Any] = {}
    if run.mapped is None or run.config is None:
        facts["target"] = output.choice_facts(run.choices[0])
        facts["capture"] = output.capture_facts(run.recordings[0], run.result.cloud)
    else:
        merged = run.mapped.merged
        cell_mm = None if run.cell_m is None else run.cell_m / MM
        facts["frame"] = (
            "of the merged cloud; registrations.json has its pose relative to the first view's camera"
        )
        facts["captures"] = [
            {
                "view": view.view.name,
                **output.capture_facts(recording, view.view.cloud),
                "target": output.choice_facts(view_choice),
            }
            for recording, view, view_choice in zip(run.recordings, run.mapped.views, run.choices, strict=True)
        ]
        facts["merged"] = {"views": merged.views_used, "cell_mm": cell_mm, "notes": merged.notes}
        settings["mapping"] = run.config.to_data()
    settings["detector"] = {
        "name": run.detector.name,
        "version": run.detector.version,
        "settings": run.settings,
    }
    paths = [path for recording in recordings for path in recording.files]
    files = []
    for path in (*paths, *filter(None, [arguments.poses, arguments.flat_field, arguments.gauge])):
        with path.open("rb") as stream:
            files.append(
                {"path": str(path), "sha256": hashlib.file_digest(stream, "sha256").hexdigest()}
            )
    scale_mm = evidence.scale_m / MM
    threshold_mm = None if evidence.unit else run.threshold * scale_mm
    return {
        **facts,
        "threshold": {"k": run.threshold, "mm": threshold_mm, "from": run.origin},
        "warnings": evidence.warnings,
        "missing_returns": None if run.result.missing is None else run.result.missing.facts,
        "surface": {"one_unit_of_score_mm": scale_mm, **evidence.notes},
        "settings": settings,
        "provenance": {
            **record("tofpod detect " + shlex.join(sys.argv[1:])),
            "files": files,
        },
    }


def _write(run: Inspection, facts: dict[str, Any]) -> None:
    mapped = run.mapped
    beside = dict[str, Callable[[Path], object]]()
    count = len(run.result.detections)
    limit = output.threshold_text(run.threshold, run.result.evidence)
    subject = f"{len(mapped.merged.views_used)} views" if mapped else run.recordings[0].name
    title = f"{subject}: {count} findings beyond {limit}"
    if run.seen is not None:
        table = HITS_AND_MISSES.frame(run.seen.rows).to_csv(
            index=False, float_format="%.6g", lineterminator="\n"
        )
        beside[GAUGE_ROWS.name] = lambda path: path.write_text(table, encoding="utf-8")
    if mapped is None:
        beside |= output.pictures(run.choices[0])
    else:
        from harness.report.view3d import write_view3d

        scene = output.scene_of(mapped, run.result)
        beside["registrations.json"] = lambda path: path.write_text(
            plain_json(run.registrations), encoding="utf-8"
        )
        beside["view3d.html"] = lambda path: write_view3d(path, scene, title)
        for number, choice in enumerate(run.choices, start=1):
            beside |= output.pictures(choice, f"targets-{number}.png")
    name = "merged.ply" if mapped else "cloud.ply"
    for path in write_findings(
        run.arguments.out, run.result, facts, title, cloud_name=name, beside=beside
    ):
        print(f"wrote {path}")
