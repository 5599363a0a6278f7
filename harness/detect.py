"""``python -m harness.detect``: the damage in a real capture, as a table and, with --out, as files."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.inspection import several_arguments, steps
from harness.inspection.steps import DEFAULT_FALSE_CALLS, LEGAL_CROP
from harness.vocabulary.errors import exit_code_of

if TYPE_CHECKING:
    from detectors.interface import Detector
    from detectors.recordings import Recording
    from harness.report.findings import Judged
    from harness.vocabulary.capture import Cloud


def main(argv: list[str] | None = None) -> int:
    """Run the program; returns its exit code (0, 2 for the user's mistake, 130 for Ctrl-C)."""
    arguments = _parser().parse_args(argv)
    return exit_code_of(lambda: _run(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m harness.detect",
        description="Find damage in a real capture: average its frames, fit the surface, list what departs from it."
        " With --register, each PATH is one view of the same target, and all of them become one cloud.",
        epilog="examples: python -m harness.detect recording.mkv --crop box:-200,200,-150,150,400,900 --out found/"
        "; python -m harness.detect left.mcap right.mcap --register marks --merge fusion --out found/",
    )
    add = parser.add_argument
    add(
        "paths",
        nargs="+",
        type=Path,
        metavar="PATH",
        help="folder or list of depth .png, .ply, .pcd, .xyz; .npy .npz .mat .mkv .r3d .bin; a ROS bag (folder, .mcap,"
        " .db3, .bag); a Stray Scanner folder; with --pitch a height map",
    )
    add(
        "--out",
        type=Path,
        metavar="DIR",
        help="write findings.csv, findings.json, annotated.png, targets.png (the surfaces to choose from), blind.png"
        " (where nothing returned) and cloud.ply here; of several views merged.ply, registrations.json and view3d.html"
        " (turns in the browser) too",
    )
    add(
        "--unit",
        help="unit of the stored distances: mm, m, cm, um, tum (5000/m) or N/m; default: what the file, the camera or"
        " the data say, which is printed",
    )
    add(
        "--intrinsics",
        metavar="FILE|CAMERA",
        help="the lens of the depth pixels: a file, or a camera's nominal lens by name",
    )
    add(
        "--crop",
        default="auto",
        metavar="KIND",
        help=f"which part is the target: {LEGAL_CROP}; default auto, the nearest large smooth surface less the 3 pixels"
        " of its rim where the camera mixes in what is behind (depth aligned to a finer colour camera:"
        " --set crop.inset_px=8)",
    )
    add(
        "--target",
        type=_number,
        metavar="N",
        help="with --crop auto: take surface N of those that a run lists and that targets.png, in --out, shows",
    )
    add("--detector", default="local", help="detector's name (default: local)")
    add(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="detector's setting by dotted path: surface.degree=5",
    )
    add(
        "--average",
        choices=("mean", "median", "clipped"),
        default="mean",
        help="how frames are averaged (default: mean)",
    )
    add("--max-frames", type=_number, metavar="N", help="use the first N frames only")
    add(
        "--false-calls",
        type=float,
        metavar="N",
        help="set the threshold so that N false calls are expected in this capture, by the noise that it shows towards"
        f" the camera (default: {DEFAULT_FALSE_CALLS:g})",
    )
    add("--threshold", type=float, metavar="K", help="threshold in units of score instead")
    add(
        "--quiet-capture",
        type=Path,
        metavar="PATH",
        help="calibrate the threshold on this capture of an undamaged target",
    )
    add("--topic", help="of a ROS bag: the topic with the depth images or clouds (default: the only one)")
    add("--array", metavar="NAME[:NUMBER]", help="of a .npz, .mat or .npy: the array, and which of several maps in it")
    add("--pitch", metavar="LENGTH", help="the array is a height map whose pixels are so far apart: 0.5mm")
    add("--raw", metavar="LAYOUT", help="of a file of bare numbers: WIDTHxHEIGHT[:TYPE[/STEP][:BYTES]], 640x480:u2")
    add("--frames-report", action="store_true", help="list every frame with its valid part and median distance")
    several_arguments.add_to(parser)
    return parser


def _number(text: str) -> int:
    if not (text.isascii() and text.isdigit()) or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number of 1 or more")
    return int(text)


def _run(arguments: argparse.Namespace) -> int:
    if arguments.register is not None:
        from harness.inspection.several_views import inspect_views

        return inspect_views(arguments)
    several_arguments.refuse_without_register(arguments)
    return _inspect_capture(arguments)


def _inspect_capture(arguments: argparse.Namespace) -> int:
    from harness.inspection import printed
    from harness.inspection.target import choice_by, choice_facts, pictures, print_choice
    from harness.report.findings import write_findings

    detector, settings = steps.detector_of(arguments, arguments.crop, arguments.set)
    recording = steps.opened(arguments, arguments.paths)
    wants_quiet = arguments.quiet_capture is not None and arguments.threshold is arguments.false_calls is None
    quiet = steps.opened(arguments, [arguments.quiet_capture]) if wants_quiet else None
    if arguments.frames_report:
        printed.print_frames(recording)
    cloud = steps.averaged(arguments, recording)
    choice = choice_by(getattr(detector, "settings", None), cloud)
    evidence = steps.analysed(detector, cloud)
    threshold, origin, evidence = steps.threshold_of(
        arguments, detector, cloud, evidence, lambda: _quiet_on(quiet, arguments, detector, cloud)
    )
    judged = steps.with_faint_told(steps.judged(detector, cloud, evidence, threshold), threshold)
    evidence = judged.evidence
    printed.print_warnings((*recording.warnings, *(choice.warnings if choice else ()), *evidence.warnings))
    print_choice(choice)
    printed.print_capture(recording, cloud, evidence, arguments.crop)
    if judged.missing is not None:
        print(judged.missing.blind_text)
    print(printed.threshold_text(threshold, evidence, origin))
    printed.print_findings(judged.findings)
    if arguments.out is not None:
        about = _about(arguments, recording, quiet, judged, detector, settings, threshold, origin)
        about = {"target": choice_facts(choice), **about}
        title = f"{recording.name}: {len(judged.detections)} findings beyond {printed.beyond_text(threshold, evidence)}"
        for path in write_findings(arguments.out, judged, about, title, beside=pictures(choice)):
            print(f"wrote {path}")
    return 0


# ---- one capture -----------------------------------------------------------------------------------------------------


def _quiet_on(
    recording: Recording | None, arguments: argparse.Namespace, detector: Detector, cloud: Cloud
) -> tuple[float, str]:
    """The threshold that is silent on a capture of an undamaged target, and what to say of it."""
    assert recording is not None
    quiet = steps.averaged(arguments, recording)
    threshold = detector.quiet_threshold(quiet, detector.analyse(quiet))
    frames = f"{quiet.n_frames} frames, here {cloud.n_frames}"
    return threshold, f"the lowest that is silent on {arguments.quiet_capture}, one repeat of {frames}"


def _about(
    arguments: argparse.Namespace,
    recording: Recording,
    quiet: Recording | None,
    judged: Judged,
    detector: Detector,
    settings: dict[str, Any],
    threshold: float,
    origin: str,
) -> Mapping[str, Any]:
    """What the JSON says beside the findings."""
    evidence = judged.evidence
    mm = None if evidence.unit else 1e3 * threshold * evidence.scale_m
    return {
        "capture": steps.capture_facts(recording, judged.cloud),
        "threshold": {"k": threshold, "mm": mm, "from": origin},
        "warnings": evidence.warnings,
        "missing_returns": None if judged.missing is None else judged.missing.facts,
        "surface": {"one_unit_of_score_mm": 1e3 * evidence.scale_m, **evidence.notes},
        "settings": {
            "average": arguments.average,
            "unit": arguments.unit,
            "detector": {"name": detector.name, "version": detector.version, "settings": settings},
        },
        "provenance": steps.provenance([recording] if quiet is None else [recording, quiet]),
    }


if __name__ == "__main__":
    sys.exit(main())
