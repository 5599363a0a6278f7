"""``tofpod characterise``: measures your own camera on static captures, as a page and a camera
file."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from harness.inspection.arguments import add_reading, read_poses, reading_of, refuse_repeats
from harness.vocabulary.errors import UserError
from harness.vocabulary.program import program

if TYPE_CHECKING:
    import numpy as np

    from detectors.recordings import Recording
    from harness.evaluation.study.record import StudyRecord
    from harness.programs.camera.camera_file import Stated
    from harness.programs.camera.measure import Characteristics, StillCapture
    from harness.programs.camera.page import OwnFigure
    from scenes.sensor.camera import AnyCamera

CAMERA_FILE = "my_camera.yaml"
# relative error of the simulated noise above which the camera file counts as wrong
REPEATED = 0.15


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("paths", nargs="+", type=Path, metavar="PATH", help="captures by one camera in one mode")
    add(
        "--out",
        required=True,
        type=Path,
        metavar="DIR",
        help="folder for the page, the tables and my_camera.yaml",
    )
    like = (
        "refit this camera's model (a name or a .yaml file); without it, the file is an empirical "
        "camera"
    )
    add("--like", metavar="CAMERA", help=like)
    add_reading(add)
    add(
        "--poses",
        type=Path,
        metavar="FILE",
        help="camera pose for each PATH, as for tofpod detect",
    )
    sphere_help = (
        "only find and measure spheres of this diameter, such as 145mm: errors of size and form, "
        "and spacings; a single frame will do"
    )
    add("--spheres", metavar="DIAMETER", help=sphere_help)
    gauge_help = (
        "truth of a solid gauge (tofpod gauge --print) that the first PATH shows: scale and bias "
        "of range, errors of spheres, blur"
    )
    add("--gauge", type=Path, metavar="FILE.json", help=gauge_help)
    calliper_help = "the gauge's calliper.csv with measured sizes"
    add("--calliper", type=Path, metavar="FILE.csv", help=calliper_help)
    add("--albedo", type=float, default=0.6, help="assumed albedo of the surfaces (default: 0.6)")
    add(
        "--rate",
        type=float,
        metavar="FPS",
        help="frames per second (default: that of --like, or 30)",
    )
    add(
        "--title",
        default="my camera",
        help="the camera's and the unit's name on page and certificate",
    )
    add(
        "--certificate",
        action="store_true",
        help="write also a certificate of two pages, certificate.html and .json",
    )
    study = (
        "results folder of a study (tofpod sweep or tofpod implant), whose limits the certificate "
        "quotes"
    )
    add("--study", type=Path, metavar="DIR", help=study)
    fact_help = (
        "a fact about the unit, such as serial=1234, firmware=1.6, warm-up='40 minutes'; may be "
        "repeated"
    )
    add("--about", action="append", default=[], metavar="KEY=TEXT", help=fact_help)


@program(
    _options,
    "Measure a depth camera on static captures, preferably of a matte wall that fills the view: "
    "noise against range, angle and amplitude, correlation, dropouts, displaced frames, fixed "
    "pattern, fill rate, edges. Write a page, tables, and my_camera.yaml, a camera for "
    "experiments (source.camera.name: ./my_camera.yaml). With --gauge, one recording of a printed "
    "gauge also shows scale and bias of range, errors of spheres, and blur. Each PATH is a capture "
    "of 50 frames or more, in any format that tofpod detect reads, in order of time. Captures at "
    "several distances, with the camera moved sideways by 30 mm or more, show the most.",
    "tofpod characterise captures/near captures/far --like azure_kinect_nfov --out my_camera",
    "tofpod characterise captures/gauge --gauge gauge/gauge.json --out my_camera",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.evaluation.study.record import read_record
    from harness.inspection.arguments import opened_as
    from harness.programs.camera.camera_file import with_lens, write_camera
    from harness.programs.camera.gauge_report import read_recording, write_pockets, write_reading
    from harness.programs.camera.measure import characteristics, read_still
    from harness.programs.camera.page import KNOWN, SIMULATED, beside
    from harness.programs.camera.spheres import run_spheres

    _refuse_illegal(options)
    study = read_record(options.study) if options.study else None
    poses = read_poses(options.poses, len(options.paths)) if options.poses else None
    refuse_repeats(options.paths)
    if options.spheres:
        return run_spheres(options, command)
    if options.calliper and not options.gauge:
        raise UserError("--calliper corrects a gauge", fix="name its truth with --gauge")
    by_gauge = None
    if options.gauge:
        by_gauge = read_recording(options)
        write_reading(options, by_gauge, command)

    recordings = [
        opened_as(options.like, [path], options.intrinsics, **reading_of(options))
        for path in options.paths
    ]
    captures = [read_still(recording) for recording in recordings]
    if options.like:
        # a camera with another image size cannot be refitted
        with_lens(options.like, captures[0].lens)
    measured = characteristics(captures, poses)

    print("fitting the camera file ..", file=sys.stderr)
    facts_of_gauge = by_gauge.stated() if by_gauge and not options.like else []
    camera = write_camera(
        options.out / CAMERA_FILE,
        options.title,
        options.like,
        measured,
        options.albedo,
        _stated_rate(options),
        facts_of_gauge,
    )
    print("simulating the captures from it ..", file=sys.stderr)
    if by_gauge:
        write_pockets(options, by_gauge, camera)
    sources, known_title = _with_simulations(options, measured, camera, poses)

    rows = beside(measured, sources[SIMULATED], sources.get(KNOWN))
    answer, wrong = _answer(measured, rows)
    warnings = list(wrong)
    for recording in recordings:
        warnings += recording.warnings
    warnings += measured.doubts
    if by_gauge and options.like:
        warnings.append(
            f"{CAMERA_FILE} has no scale, bias and blur by the gauge: only an empirical camera has "
            "(leave out --like)"
        )
    _print_captures(recordings, captures, warnings)
    _write_results(
        options,
        command,
        sources=sources,
        rows=rows,
        answer=answer,
        known_title=known_title,
        warnings=warnings,
        poses=poses,
        study=study,
    )
    return 0


def _refuse_illegal(options: argparse.Namespace) -> None:
    """Raise UserError if the value of an option is not legal, or needs another option."""
    if not 0 < options.albedo <= 1:
        raise UserError(f"--albedo {options.albedo:g}", legal="a number above 0, up to 1")
    if not options.certificate and (options.study or options.about):
        raise UserError(
            "--study and --about need --certificate", fix="add --certificate, or leave them out"
        )
    if malformed := [text for text in options.about if not text.partition("=")[2]]:
        raise UserError(
            f"--about {malformed[0]}: is not KEY=TEXT", legal="such as --about firmware=1.6"
        )
    if options.rate is not None and not options.rate > 0:
        raise UserError(f"--rate {options.rate:g}", legal="a number above 0 (frames per second)")


def _stated_rate(options: argparse.Namespace) -> Stated:
    """Return the rate of frames: that of the user, of the known camera, or an assumed one."""
    from harness.programs.camera.camera_file import Stated
    from scenes.sensor.camera import load_camera

    rate = Stated("unit", "frames_per_second", 30.0, "assumed", tag="M")
    if options.rate:
        return rate._replace(value=options.rate, source="stated by the user", tag="U")
    if options.like:
        frames_per_second = load_camera(options.like).unit.frames_per_second.value
        return rate._replace(value=frames_per_second, source=f"of {options.like}")
    return rate


def _with_simulations(
    options: argparse.Namespace,
    measured: Characteristics,
    camera: AnyCamera,
    poses: Sequence[np.ndarray] | None,
) -> tuple[dict[str, Characteristics], str]:
    """Return what was measured by its source: on the captures, on their simulation by the fitted
    ``camera``, and on one by the known camera, where there is one; and the known camera's title,
    which is empty without one."""
    from harness.programs.camera.camera_file import camera_of_size, simulated, with_lens
    from harness.programs.camera.measure import characteristics
    from harness.programs.camera.page import KNOWN, MEASURED, SIMULATED
    from scenes.sensor.camera import load_camera

    twin = characteristics(simulated(camera, measured, options.albedo), poses)
    sources = {MEASURED: measured, SIMULATED: twin}
    lens = measured.captures[0].lens
    known_camera = options.like
    with suppress(UserError):  # no camera has this image size, or it sees none of the surfaces
        known_camera = known_camera or camera_of_size(lens)
        nearest = with_lens(known_camera, lens)
        sources[KNOWN] = characteristics(simulated(nearest, measured, options.albedo), poses)
    title = load_camera(known_camera).title if known_camera else ""
    return sources, title


def _answer(measured: Characteristics, rows: Sequence[OwnFigure]) -> tuple[str, list[str]]:
    """Return the answer in sentences, and a warning of each figure that the camera file does not
    reproduce."""
    noise = ", ".join(
        f"{face.temporal.value:.3g} mm at {face.distance_m:.2f} m" for face in measured.surfaces[:3]
    )
    answer = f"Temporal noise of single pixels: {noise}." if noise else "No flat surface was found."
    repeated = []
    wrong: list[str] = []
    for figure in ("fill rate", "temporal noise"):
        worst = 0.0
        for row in rows:
            if row.figure == figure:
                # a figure that only one of the two shows is as wrong as can be
                off = 1.0 if math.isnan(row.ratio) else abs(row.ratio - 1)
                worst = max(worst, off)
        if worst > REPEATED:
            departs = (
                f"the {figure} of {CAMERA_FILE} differs from the captures by up to "
                f"{100 * worst:.0f} %"
            )
            # noise, which limits depend on most, comes first
            wrong.insert(0, f"{departs}: limits that are simulated with it are also wrong")
        elif noise:
            repeated.append(f"the {figure} within {100 * worst:.1g} %")
    if repeated:
        answer += f" {CAMERA_FILE} reproduces {' and '.join(repeated)}."
    return answer, wrong


def _print_captures(
    recordings: Sequence[Recording], captures: Sequence[StillCapture], warnings: Sequence[str]
) -> None:
    """Print warnings, and what was read of each recording."""
    from harness.inspection.output import print_notes, print_warnings

    print_warnings(warnings)
    for recording, capture in zip(recordings, captures, strict=True):
        print(f"{recording.name}: {len(capture.z_m)} frames, {recording.unit_text}")
        print_notes(recording.notes)


def _write_results(
    options: argparse.Namespace,
    command: str,
    *,
    sources: dict[str, Characteristics],
    rows: list[OwnFigure],
    answer: str,
    known_title: str,
    warnings: Sequence[str],
    poses: Sequence[np.ndarray] | None,
    study: StudyRecord | None,
) -> None:
    """Print the figures, and write the page, its tables and, if wanted, the certificate."""
    from harness.programs.camera.certificate import write_certificate
    from harness.programs.camera.page import MEASURED, write_page

    write_page(
        path=options.out / "characterise.html",
        sources=sources,
        rows=rows,
        title=f"{options.title}, characterised",
        answer=answer,
        known_title=known_title,
        command=command,
        facts={"like": options.like, "camera_file": CAMERA_FILE},
        warnings=warnings,
    )
    if not options.certificate:
        return
    measured = sources[MEASURED]
    lens = measured.captures[0].lens
    mode = f"{lens.width} x {lens.height} pixels"
    if options.like:
        mode += f", as {options.like}"
    unit_facts = {
        "unit": options.title,
        "mode": mode,
        "firmware": "not recorded",
        "warm-up": "not stated",
        "captures": ", ".join(capture.name for capture in measured.captures),
    }
    unit_facts |= dict(text.split("=", 1) for text in options.about)
    write_certificate(options.out, measured, unit_facts, poses, study, command)


if __name__ == "__main__":
    raise SystemExit(main())
