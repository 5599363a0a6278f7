"""``tofpod record``: records a depth camera as a folder that `tofpod detect` reads, and says while
frames come what they show."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from harness.inspection.arguments import READING, add_reading, opened, reading_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.program import program, whole_number

if TYPE_CHECKING:
    from detectors.sources.interface import Stream

WRITTEN_M = 1e-4
"""Unit in metres of depth that has no rounding step: 16 bits reach 6.5 m."""


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    camera_help = (
        "femto, k4a, oak, realsense, or one of an installed package (entry points tofpod.sources); "
        "none of the built-in ones has been run on hardware"
    )
    add("--camera", metavar="NAME", help=camera_help)
    from_help = (
        "a recorded file or folder instead of a camera that runs; with --camera, its maker's "
        "package plays it"
    )
    add("--from", dest="source", type=Path, metavar="PATH", help=from_help)
    add("--out", type=Path, metavar="DIR", help="new folder for the frames; without it, only watch")
    add("--frames", type=whole_number(10**9), metavar="N", help="end after N frames, or by Ctrl-C")
    rate_help = "frames per second of a file that states no times (default: 30)"
    add("--rate", type=float, default=30.0, metavar="FPS", help=rate_help)
    add_reading(add)


@program(
    _options,
    "Record a depth camera, or a file in its place, as a folder that tofpod detect reads without "
    "an option. Once a second a line states, on the surface that detect would inspect, the noise "
    "of single pixels, the fill rate, the drift and whether the camera is still warming up, and "
    "whether the target is in view. The folder keeps these lines as recording.json.",
    "tofpod record --camera realsense --frames 300 --out captures/board",
    "tofpod record --from board.mkv --out captures/board",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, also after Ctrl-C, which ends a recording; 2 for a user's
    mistake."""
    if not options.rate > 0:
        raise UserError(f"--rate {options.rate:g}", legal="a number above 0 (frames per second)")
    if options.camera is None and options.source is None:
        fix = "name a camera with --camera, or a recorded file with --from"
        raise UserError("nothing is named that gives frames", fix=fix)
    for name in ("intrinsics", *READING):
        if options.camera is not None and getattr(options, name) is not None:
            problem = f"--{name}: concerns files that tofpod reads, not the camera {options.camera}"
            raise UserError(problem, fix=f"leave out --{name}, or --camera")
    with _stream(options) as stream:
        _record(stream, options, command)
    return 0


def _record(stream: Stream, options: argparse.Namespace, command: str) -> None:
    """Watch a stream and write its frames. Raises UserError, after what came has been written."""
    from harness.programs.record.watching import Watch
    from harness.programs.record.writing import LARGEST, FrameFolder
    from harness.vocabulary.provenance import record
    from harness.vocabulary.text import many

    folder = FrameFolder(options.out, stream) if options.out else None
    watch = Watch(stream)
    seconds = []
    times_s: list[float] = []
    are_stated = True
    failure = None
    print(f"{stream.name}: {stream.lens.width} x {stream.lens.height} pixels", flush=True)
    try:
        for frame in islice(stream.frames, options.frames):
            are_stated = are_stated and frame.time_s is not None
            time_s = len(times_s) / options.rate if frame.time_s is None else frame.time_s
            times_s.append(time_s)
            if folder:
                folder.add(frame)
            second = watch.add(frame, time_s)
            if second is not None:
                seconds.append(second)
                print(second.line, flush=True)
    except KeyboardInterrupt:
        print("ended by Ctrl-C", flush=True)
    except UserError as error:
        failure = error
    second = watch.ended()
    if second is not None:
        seconds.append(second)
        print(second.line)
    if not are_stated:
        print(f"the frames state no times: {options.rate:g} a second are assumed")
    if folder and times_s:
        if folder.beyond:
            reach = f"{LARGEST * stream.unit_m:.3g} m"
            warning = f"{folder.beyond} distances beyond {reach} are left out"
            print(f"warning: {warning}", file=sys.stderr)
        facts = {
            "provenance": record(command),
            "camera": stream.name,
            "frames": len(times_s),
            "times_are_stated": are_stated,
            "times_s": times_s,
            "distances_left_out": folder.beyond,
            "seconds": [second.to_data() for second in seconds],
        }
        folder.finish(facts)
        print(f"{many(len(times_s), 'frame')} in {options.out}: tofpod detect {options.out}")
    if failure is not None:
        raise failure


@contextmanager
def _stream(options: argparse.Namespace) -> Iterator[Stream]:
    """Open the camera or the file. Raises UserError, also for frames of points, which have no
    lens."""
    from detectors.sources import open_source
    from detectors.sources.interface import Stream
    from harness.inspection.output import print_notes, print_warnings
    from harness.programs.record.watching import compile_loops

    if options.camera is not None:
        source = open_source(options.camera, options.source)
        compile_loops()
        with source as stream:
            yield stream
        return
    recording = opened([options.source], options.intrinsics, **reading_of(options))
    if recording.lens is None or recording.projection != "central":
        fix = "pass it to tofpod detect as it is"
        raise UserError(f"{recording.name}: holds points, not depth images", fix=fix)
    print_warnings(recording.warnings)
    print_notes(recording.notes)
    unit_m = recording.z_step_m or WRITTEN_M
    yield Stream(recording.name, recording.lens, unit_m, recording.frames())


if __name__ == "__main__":
    raise SystemExit(main())
