"""The arguments that concern several views, and what they mean as settings."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.inspection.steps import assign, crop_from_text
from harness.vocabulary.errors import UserError

if TYPE_CHECKING:
    from detectors.mapping.settings import MappingConfig

METHODS = ("marks", "icp", "cpd", "joint", "odometry", "nominal")
MERGES = ("fusion", "grid", "volume")
MARKS = ("colour", "red", "coded")
WHOLE_CAPTURES = (".mcap", ".db3", ".mkv", ".npy", ".npz", ".mat")
PREFIX = "mapping."
"""Of the --set keys that concern the way from views to one cloud; all others are the detector's."""


def add_to(parser: argparse.ArgumentParser) -> None:
    """Add the arguments to the program's own."""
    add = parser.add_argument_group(
        "several views of one target",
        "Each PATH is then one view. --crop cuts the target out of each; the detector judges all that is merged, unless"
        " --set crop.kind=.. says otherwise. --set mapping.KEY=VALUE sets what the arguments below do not name, such as"
        " mapping.merge.cell_mm=1, mapping.marks.dictionary=DICT_4X4_50 or mapping.registration.points=target (icp and"
        " cpd then use the whole target; else the points of the marks, which need colour).",
    ).add_argument
    add("--register", choices=METHODS, metavar="METHOD", help=f"register the views by {', '.join(METHODS)}")
    add("--merge", choices=MERGES, metavar="KIND", help=f"merge them by {', '.join(MERGES)} (default: fusion)")
    add(
        "--marks",
        choices=MARKS,
        metavar="KIND",
        help="the fiducial marks: colour (strips of any colour that stands apart; default), red (the thesis' rule),"
        " coded (ArUco, AprilTag)",
    )
    add(
        "--poses",
        type=Path,
        metavar="FILE",
        help="where the views are thought to stand: JSON, a list of 4x4 matrices to one common frame in metres, or"
        " lines of TUM's groundtruth.txt, one a view; only a start for the registration",
    )


def refuse_without_register(arguments: argparse.Namespace) -> None:
    """Raise UserError where an argument for several views is given to a run of one capture, and where several whole
    captures are."""
    given = [name for name in ("merge", "marks", "poses") if getattr(arguments, name) is not None]
    given += [f"set {assignment}" for assignment in arguments.set if assignment.startswith(PREFIX)]
    if given:
        raise UserError(
            f"--{given[0]}: concerns several views, and without --register all PATHs are one capture",
            legal=f"--register {'|'.join(METHODS)}",
        )
    whole = [path for path in arguments.paths if path.is_dir() or path.suffix.lower() in WHOLE_CAPTURES]
    if len(arguments.paths) > 1 and whole:
        raise UserError(
            f"{len(arguments.paths)} PATHs, and {whole[0]} is a capture of its own",
            legal="one capture: a folder, a file of many frames, or a list of .png, .ply or .pcd",
            fix=f"run each alone, or, as views of one target, together: --register {'|'.join(METHODS)}",
        )


def mapping_config(arguments: argparse.Namespace) -> tuple[MappingConfig, tuple[str, ...]]:
    """The settings from views to one cloud, and the --set assignments that are the detector's.

    Raises UserError where they are not legal, every problem at once.
    """
    from detectors.mapping.settings import MappingConfig
    from harness.vocabulary.declaration.diagnose import settings_of

    data: dict[str, Any] = {
        "crop": crop_from_text(arguments.crop, arguments.target),
        "marks": {"kind": arguments.marks or MARKS[0]},
        "registration": {"method": arguments.register},
        "merge": {"kind": arguments.merge or MERGES[0]},
    }
    for assignment in arguments.set:
        if assignment.startswith(PREFIX):
            assign(data, assignment.removeprefix(PREFIX))
    config = settings_of(MappingConfig, data, "settings of the mapping", PREFIX.rstrip("."))
    return config, tuple(each for each in arguments.set if not each.startswith(PREFIX))
