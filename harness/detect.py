"""``python -m harness.detect``: the damage in a real capture, as a table and, with --out, as files."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.vocabulary.errors import UserError, exit_code_of

if TYPE_CHECKING:
    from detectors.interface import Detector, Evidence
    from detectors.recordings import Recording
    from harness.report.findings import Finding, Judged
    from harness.vocabulary.capture import Cloud

DEFAULT_K = 5.0
"""Robust standard deviations: of a million normal pixels 0.6 lie beyond by chance. Real surfaces are not that kind."""
LEGAL_CROP = "auto, none, box:x0,x1,y0,y1,z0,z1 (mm, camera frame), polygon:u,v,u,v,u,v.. (pixels)"


def main(argv: list[str] | None = None) -> int:
    """Run the program; returns its exit code (0, 2 for the user's mistake, 130 for Ctrl-C)."""
    arguments = _parser().parse_args(argv)
    return exit_code_of(lambda: _run(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m harness.detect",
        description="Find damage in a real capture: average its frames, fit the surface, list what departs from it.",
        epilog="example: python -m harness.detect recording.mkv --crop box:-200,200,-150,150,400,900 --out found/",
    )
    add = parser.add_argument
    add(
        "paths",
        nargs="+",
        type=Path,
        metavar="PATH",
        help="folder or list of depth .png, .ply, .pcd; .npy .npz .mat .mkv",
    )
    add("--out", type=Path, metavar="DIR", help="write findings.csv, findings.json, annotated.png and cloud.ply here")
    add(
        "--unit",
        help="unit of the stored distances: mm, m, cm, um, tum (5000/m) or N/m; default: the format's usual one",
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
        help=f"which part is the target: {LEGAL_CROP}; default auto, the largest surface less the 3 pixels of its rim"
        " where the camera mixes in what is behind (depth aligned to a finer colour camera: --set crop.inset_px=8)",
    )
    add("--detector", default="thesis", help="detector's name (default: thesis)")
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
    add("--max-frames", type=_count, metavar="N", help="use the first N frames only")
    add("--threshold", type=float, metavar="K", help=f"threshold in units of score (default {DEFAULT_K:g})")
    add(
        "--quiet-capture",
        type=Path,
        metavar="PATH",
        help="calibrate the threshold on this capture of an undamaged target",
    )
    add("--frames-report", action="store_true", help="list every frame with its valid part and median distance")
    return parser


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of frames: 1 or more")
    return int(text)


def _run(arguments: argparse.Namespace) -> int:
    from harness.report.findings import Judged, write_findings

    detector, settings = _detector(arguments)
    recording = _opened(arguments, arguments.paths)
    if arguments.frames_report:
        _print_frames(recording)
    cloud = _averaged(arguments, recording)
    evidence = detector.analyse(cloud)
    threshold, origin = _threshold(arguments, detector, cloud)
    detections = detector.find(cloud, evidence, threshold)
    judged = Judged(cloud, evidence, detections, tuple(detector.measure(cloud, evidence, d) for d in detections))
    _print_capture(recording, cloud, evidence, arguments.crop)
    print(f"threshold: {threshold:.4g} x {_mm(evidence.scale_m)} = {_mm(threshold * evidence.scale_m)} ({origin})")
    _print_table(judged.findings)
    if arguments.out is not None:
        about = _about(arguments, recording, judged, detector, settings, threshold, origin)
        title = f"{recording.name}: {len(detections)} findings beyond {_mm(threshold * evidence.scale_m)}"
        for path in write_findings(arguments.out, judged, about, title):
            print(f"wrote {path}")
    return 0


# ---- the steps -------------------------------------------------------------------------------------------------------


def _detector(arguments: argparse.Namespace) -> tuple[Detector, dict[str, Any]]:
    """The detector with the settings of --crop and --set, and these settings with all defaults."""
    from detectors import detector_type, load_detector

    settings: dict[str, Any] = {}
    known = detector_type(arguments.detector).settings_type
    if "crop" in known.model_fields:
        settings["crop"] = crop_from_text(arguments.crop)
    for assignment in arguments.set:
        _assign(settings, assignment)
    detector = load_detector(arguments.detector, settings)
    return detector, known.from_data(settings).to_data()


def crop_from_text(text: str) -> dict[str, Any]:
    """The crop's declaration from ``auto``, ``none``, ``box:..`` or ``polygon:..``; UserError on anything else."""
    kind, _, values = text.partition(":")
    try:
        numbers = [float(value) for value in values.split(",")] if values else []
    except ValueError as error:
        raise UserError(f"--crop {text}: not all of its values are numbers", legal=LEGAL_CROP) from error
    if kind in ("auto", "none") and not numbers:
        return {"kind": kind}
    if kind == "box" and len(numbers) == 6:
        x, y, z = numbers[0:2], numbers[2:4], numbers[4:6]
        return {"kind": "box", "x_mm": x, "y_mm": y, "z_mm": z, "range_max_m": None}
    if kind == "polygon" and len(numbers) >= 6 and len(numbers) % 2 == 0:
        return {"kind": "polygon", "vertices_px": [numbers[i : i + 2] for i in range(0, len(numbers), 2)]}
    raise UserError(f"--crop {text}: no such crop", legal=LEGAL_CROP)


def _assign(settings: dict[str, Any], assignment: str) -> None:
    """Put one KEY=VALUE into nested settings; the value is JSON where it can be, else text."""
    import json

    path, equals, text = assignment.partition("=")
    if not (path and equals):
        raise UserError(f"--set {assignment}: no value", legal="KEY=VALUE, for instance surface.degree=5")
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = text
    *folders, leaf = path.split(".")
    for folder in folders:
        settings = settings.setdefault(folder, {})
        if not isinstance(settings, dict):
            raise UserError(f"--set {assignment}: {folder} is a value, not a group")
    settings[leaf] = value


def _opened(arguments: argparse.Namespace, paths: list[Path]) -> Recording:
    """The capture; --intrinsics may name a camera, whose nominal lens then counts."""
    from detectors.recordings import open_capture

    lens, file = None, None
    if arguments.intrinsics is not None:
        from scenes.sensor.camera import camera_names, load_camera

        file = Path(arguments.intrinsics)
        if arguments.intrinsics in camera_names():
            lens, file = load_camera(arguments.intrinsics).nominal_lens, None
        elif not file.exists():
            legal = f"a file, or one of the cameras {', '.join(camera_names())}"
            raise UserError(f"--intrinsics {file}: no such file and no such camera", legal=legal)
    first = slice(arguments.max_frames) if arguments.max_frames else None
    return open_capture(paths, unit=arguments.unit, intrinsics=file, lens=lens, frames=first)


def _averaged(arguments: argparse.Namespace, recording: Recording) -> Cloud:
    from detectors.average import AverageConfig, average

    return average(recording, AverageConfig(method=arguments.average))


def _threshold(arguments: argparse.Namespace, detector: Detector, cloud: Cloud) -> tuple[float, str]:
    """The threshold and its origin: given, calibrated on a quiet capture, the detector's own, or the default."""
    if arguments.threshold is not None and arguments.quiet_capture is not None:
        raise UserError("--threshold and --quiet-capture both set the threshold", fix="give one of them")
    if arguments.threshold is not None:
        if not 0 < arguments.threshold < float("inf"):
            raise UserError(f"--threshold {arguments.threshold:g}", legal="a number above 0")
        return arguments.threshold, "given"
    if arguments.quiet_capture is not None:
        quiet = _averaged(arguments, _opened(arguments, [arguments.quiet_capture]))
        threshold = detector.quiet_threshold(quiet, detector.analyse(quiet))
        frames = f"{quiet.n_frames} frames, here {cloud.n_frames}"
        return threshold, f"the lowest that is silent on {arguments.quiet_capture}, one repeat of {frames}"
    own = getattr(detector, "default_threshold", None)
    if own is not None:
        return float(own), "the detector's own"
    return DEFAULT_K, "default, not calibrated: without an undamaged capture the rate of false calls is unknown"


# ---- what is printed -------------------------------------------------------------------------------------------------


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm"


def _print_frames(recording: Recording) -> None:
    import numpy as np

    for frame in recording.frames():
        valid = np.isfinite(frame.z_m)
        median = _mm(float(np.median(frame.z_m[valid]))) if valid.any() else "none"
        print(f"frame {frame.name}: {100 * valid.mean():.1f} % valid, median distance {median}")


def _print_capture(recording: Recording, cloud: Cloud, evidence: Evidence, crop: str) -> None:
    """Frames, what was left out, crop and surface, a line each."""
    import numpy as np

    height, width = cloud.valid.shape
    size = f"{width} x {height} pixels" if cloud.organised else f"{width} points"
    print(f"{recording.name}: {cloud.n_frames} frames averaged, {size}")
    for note in recording.notes:
        print(f"note: {note}")
    for left in cloud.left_out:
        print(f"left out: {left.name}: {left.why}")
    kept = np.isfinite(evidence.residual_m)
    rows, columns = np.nonzero(kept)
    where = (
        f", columns {columns.min()} to {columns.max()}, rows {rows.min()} to {rows.max()}" if cloud.organised else ""
    )
    print(f"crop: {crop} keeps {kept.sum()} of {cloud.valid.sum()} valid points{where}")
    if not cloud.organised and crop == "auto" and kept.sum() < cloud.valid.sum():
        off = cloud.valid.sum() - kept.sum()
        print(
            f"note: {off} points lie off the largest surface or on its rim: not judged; --crop none judges all of them"
        )
    within = cloud.variance_m2[kept & np.isfinite(cloud.variance_m2)]
    temporal = f"; one frame's noise {_mm(float(np.sqrt(np.median(within))))}" if within.size else ""
    print(f"surface: {evidence.notes.get('surface', '')}; one unit of score is {_mm(evidence.scale_m)}{temporal}")


def _print_table(findings: tuple[Finding, ...]) -> None:
    """A table on a terminal that is wide enough for it, plain columns elsewhere."""
    if not findings:
        print("no findings")
        return
    titles = (
        "id",
        "u px",
        "v px",
        "x mm",
        "y mm",
        "z mm",
        "diam. mm",
        "from",
        "depth mm",
        "vol. mm3",
        "points",
        "score",
    )
    rows = [_cells(finding) for finding in findings]
    widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    if sys.stdout.isatty():
        from rich.box import SIMPLE_HEAD
        from rich.console import Console
        from rich.table import Table

        console = Console()
        if sum(widths) + 2 * len(widths) <= console.width:
            table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
            for title, width in zip(titles, widths, strict=True):
                table.add_column(title, justify="right", no_wrap=True, min_width=width)
            for row in rows:
                table.add_row(*row)
            console.print(table)
            return
    for row in (titles, *rows):
        print("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)))


def _cells(f: Finding) -> tuple[str, ...]:
    numbers = (f.u_px, f.v_px, f.x_mm, f.y_mm, f.z_mm, f.diameter_mm)
    start = [str(f.id), *(_number(n, 1) for n in numbers), f.size_from]
    return (*start, _number(f.depth_mm, 2), _number(f.volume_mm3, 1), str(f.points), _number(f.score, 2))


def _number(value: float, digits: int) -> str:
    return "-" if value != value else f"{value:.{digits}f}"


# ---- what the JSON says beside the findings --------------------------------------------------------------------------


def _about(
    arguments: argparse.Namespace,
    recording: Recording,
    judged: Judged,
    detector: Detector,
    settings: dict[str, Any],
    threshold: float,
    origin: str,
) -> Mapping[str, Any]:
    import dataclasses

    cloud, evidence = judged.cloud, judged.evidence
    return {
        "capture": {
            "name": recording.name,
            "frames_used": cloud.n_frames,
            "frames_left_out": [dataclasses.asdict(left) for left in cloud.left_out],
            "lens": dataclasses.asdict(cloud.lens) if cloud.lens else None,
            "rounding_step_mm": 1e3 * cloud.z_step_m,
            "notes": recording.notes,
        },
        "threshold": {"k": threshold, "mm": 1e3 * threshold * evidence.scale_m, "from": origin},
        "surface": {"one_unit_of_score_mm": 1e3 * evidence.scale_m, **evidence.notes},
        "settings": {
            "average": arguments.average,
            "unit": arguments.unit,
            "detector": {"name": detector.name, "version": detector.version, "settings": settings},
        },
        "provenance": _provenance(recording),
    }


def _provenance(recording: Recording) -> dict[str, Any]:
    """Command, code, versions, and the content of every file that can change a number."""
    import hashlib

    from harness.vocabulary.provenance import record

    files = []
    for path in recording.files:
        with path.open("rb") as stream:
            files.append({"path": str(path), "sha256": hashlib.file_digest(stream, "sha256").hexdigest()})
    return {**record("python -m harness.detect " + shlex.join(sys.argv[1:])), "files": files}


if __name__ == "__main__":
    sys.exit(main())
