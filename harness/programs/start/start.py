"""``tofpod start``: asks for camera, part, damage and tolerance, and writes an experiment."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING

from harness.programs.start.questions import Question
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from harness.vocabulary.program import length_m, program

if TYPE_CHECKING:
    from harness.programs.start.plan import Inquiry

NEEDED = ("camera", "part", "damage", "size")
"""Options without a default: if one is missing, all that are missing are asked for."""
NONE = "none"
DEFAULT_DISTANCE = "0.7m"
DEPTH = 0.25
"""Depth as a share of the tolerance, unless it is stated."""


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--camera", metavar="NAME|FILE.yaml", help="the camera; of a recording, its camera")
    recording = f"a recording of the part by this camera, or {NONE} (the default)"
    add("--recording", metavar="PATH", help=recording)
    add("--part", metavar="PART", help="board, sheet, pipe or wall")
    add("--damage", metavar="KIND", help="hole, blind-hole, dent, crack, scratch, bump, ...")
    size = "the tolerance, which must be found, such as 5mm: a diameter, a crack's width"
    add("--size", metavar="LENGTH", help=size)
    add("--depth", metavar="LENGTH", help="its depth (default: a quarter of the size)")
    distance = f"distance from camera to part (default: {DEFAULT_DISTANCE})"
    add("--distance", metavar="LENGTH", help=distance)
    add("--out", metavar="FILE.yaml", help="the experiment's file (default: named after the part)")


@program(
    _options,
    "Ask for camera or recording, part, damage and tolerance in plain questions, write an "
    "experiment that tells whether such damage is found, and print three commands to run. "
    "What options state is not asked for.",
    "tofpod start --camera azure_kinect_nfov --part board --damage hole --size 5mm",
    "tofpod start --camera kinect_v2 --part pipe --damage scratch --size 40mm --depth 2mm",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake or an input that ends, 130 after
    Ctrl-C."""
    from harness.programs.start.plan import commands, experiment_text

    asks = any(getattr(options, name) is None for name in NEEDED)
    inquiry = _inquiry(options, asks=asks)
    proposed = f"{inquiry.part}_{inquiry.kind}.yaml"
    name = Question("--out", "Name of the experiment's file", _new_file, proposed)
    file = name.answered(options.out, asks=asks)
    _write(file, experiment_text(inquiry, file.stem))
    print(f"wrote {file}\n")
    listed = commands(inquiry, file)
    wide = max(len(words) for words, _ in listed)
    for words, purpose in listed:
        print(f"  {words:{wide}}  # {purpose}")
    return 0


def _inquiry(options: argparse.Namespace, *, asks: bool) -> Inquiry:
    """Return the inspection that options and answers describe."""
    from harness.programs.start.plan import KINDS, PARTS, Inquiry
    from harness.vocabulary.words import damage_kind

    camera = Question("--camera", "Which camera? (such as azure_kinect_nfov; ? lists all)", _camera)
    recording = Question("--recording", "Path of a recording of the part", _recording, NONE)
    part = Question("--part", f"Which part? ({', '.join(PARTS)})", _part)
    damage = Question(
        "--damage",
        "Which damage? (hole, blind-hole, dent, crack, scratch, bump)",
        lambda words: damage_kind("--damage", words, KINDS),
    )
    tolerance = Question(
        "--size",
        "Which size must be found? (the diameter, a crack's width, a scratch's length; 5mm)",
        lambda words: length_m("--size", words) / MM,
    )
    distance = Question(
        "--distance",
        "How far is the camera from the part?",
        lambda words: length_m("--distance", words),
        DEFAULT_DISTANCE,
    )
    chosen_camera = camera.answered(options.camera, asks=asks)
    chosen_recording = recording.answered(options.recording, asks=asks)
    chosen_part = part.answered(options.part, asks=asks)
    kind = damage.answered(options.damage, asks=asks)
    tolerance_mm = tolerance.answered(options.size, asks=asks)
    depth_mm = None
    if kind != "through":
        depth = Question(
            "--depth",
            "How deep is it?",
            lambda words: length_m("--depth", words) / MM,
            f"{DEPTH * tolerance_mm:.3g}mm",
        )
        depth_mm = depth.answered(options.depth, asks=asks)
    elif options.depth is not None:
        raise UserError("--depth: a hole goes through the part", legal="--damage blind-hole")
    return Inquiry(
        camera=chosen_camera,
        recording=chosen_recording,
        part=chosen_part,
        kind=kind,
        tolerance_mm=tolerance_mm,
        depth_mm=depth_mm,
        distance_m=distance.answered(options.distance, asks=asks),
    )


def _camera(words: str) -> str:
    """Return a camera's name, or the path of its file. Raises UserError, also with the list."""
    from scenes.sensor.camera import camera_names, is_camera_path, load_camera

    if words == "?":
        raise UserError("cameras", legal=", ".join(camera_names()))
    load_camera(words)
    return str(Path(words).resolve()) if is_camera_path(words) else words


def _recording(words: str) -> Path | None:
    """Return the path of a recording, which must exist; None for none."""
    if words == NONE:
        return None
    path = Path(words).expanduser()
    if not path.exists():
        raise UserError(f"--recording {words}: no such file or folder", legal=f"a path, or {NONE}")
    return path


def _part(words: str) -> str:
    from harness.programs.start.plan import PARTS
    from harness.vocabulary.words import nearest

    if words in PARTS:
        return words
    meant = nearest(words, PARTS)
    hint = f"; did you mean {meant!r}?" if meant else ""
    raise UserError(f"--part {words}: no such part{hint}", legal=", ".join(PARTS))


def _new_file(words: str) -> Path:
    """Return the path of an experiment that does not exist yet."""
    path = Path(words).expanduser()
    if path.suffix != ".yaml" or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", path.stem):
        legal = "NAME.yaml, with letters, digits, - and _ in the name"
        raise UserError(f"--out {words}: is no name of an experiment's file", legal=legal)
    if not path.parent.is_dir():
        raise UserError(f"--out {words}: there is no folder {path.parent}")
    if path.exists():
        raise UserError(f"--out {words}: there is such a file", fix="choose another name")
    return path


def _write(file: Path, text: str) -> None:
    """Write an experiment that loads, or nothing. Raises UserError if the answers do not fit
    together."""
    from harness.experiment.load import load_experiment
    from harness.vocabulary.declaration.yaml_source import DeclarationError
    from harness.vocabulary.files import atomic_path

    with atomic_path(file) as temporary:
        temporary.write_text(text, encoding="utf-8")
        try:
            load_experiment(temporary)
        except DeclarationError as error:
            # one of several damages that have the same problem is enough
            problem = " ".join(error.problems[0].message.splitlines()[:2])
            raise UserError(
                f"the answers do not fit together; nothing was written\n  {problem}",
                fix="state another damage, size, depth, distance or part",
            ) from error


if __name__ == "__main__":
    raise SystemExit(main())
