"""``tofpod detect``: finds the damage in a real capture, prints a table and, with --out, writes
files."""

import argparse
from pathlib import Path

from harness.inspection import arguments as cli
from harness.vocabulary.program import program, whole_number


def detect_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `tofpod detect`, which other programs that inspect a capture have too."""
    add = parser.add_argument
    formats = (
        "folder or list of depth .png, .ply, .pcd, .xyz; folder of .npy, .tiff, .exr; one .npy "
        ".npz .mat .tiff .exr .pfm .mkv .r3d"
        " .bin; a ROS bag (folder, .mcap, .db3, .bag); a Stray Scanner folder; with --pitch "
        "a height map"
    )
    add("paths", nargs="+", type=Path, metavar="PATH", help=formats)
    add(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for tables, pictures and clouds (docs/recordings.md)",
    )
    cli.add_reading(add)
    crop = (
        f"the target: {cli.LEGAL_CROP}; auto: the nearest large smooth surface without its rim "
        "(crop.inset_px)"
    )
    add("--crop", default="auto", metavar="KIND", help=crop)
    target = (
        "with --crop auto: inspect surface N of the list that a run prints and targets.png shows"
    )
    add("--target", type=whole_number(10**9), metavar="N", help=target)
    add(
        "--detector",
        metavar="NAME",
        default=cli.DEFAULT_DETECTOR,
        help=(
            f"name of the detector; {cli.DEFAULT_DETECTOR} (default): of "
            f"{', '.join(cli.CANDIDATES)}, the one that finds most of the holes implanted in the "
            "capture"
        ),
    )
    setting = "a setting of the detector by dotted path: surface.degree=5"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=setting)
    reference = (
        "what the part should look like: an earlier capture of it or its folder of --out, a folder "
        "of captures of good parts, or a mesh (--set reference.unit=m, .front=-y)"
    )
    add("--reference", type=Path, metavar="WHAT", help=reference)
    averages = ("mean", "median", "clipped")
    add(
        "--average",
        choices=averages,
        default="mean",
        help="how frames are averaged (default: mean)",
    )
    add("--max-frames", type=whole_number(10**9), metavar="N", help="use only the first N frames")
    calls = (
        "expected number of false calls, by the noise towards the camera (default: "
        f"{cli.DEFAULT_FALSE_CALLS:g})"
    )
    add("--false-calls", type=float, metavar="N", help=calls)
    add(
        "--threshold",
        type=float,
        metavar="K",
        help="threshold in units of score, instead of --false-calls",
    )
    flat = "subtract this unit's fixed pattern, measured by tofpod flatfield, from each capture"
    add("--flat-field", type=Path, metavar="FILE.npz", help=flat)
    quiet = "calibrate the threshold on this capture of an undamaged target"
    add("--quiet-capture", type=Path, metavar="PATH", help=quiet)
    limit = (
        "state which sizes would have been missed, from damage of this depth that is pressed into "
        "the capture (default: half as deep as wide); takes an analysis for each of up to nine "
        "sizes"
    )
    add("--limit", nargs="?", const="", metavar="DEPTH", help=limit)
    tolerance = (
        "decide whether damage and part conform: depth=0.5mm, width=4mm (ISO 14253-1, with the "
        "whole uncertainty; takes the analyses of --limit)"
    )
    add("--tolerance", action="append", default=[], metavar="SIZE", help=tolerance)
    add = parser.add_argument_group(
        "several views of one target",
        "Each PATH is one view. --crop cuts the target out of each view, and the detector "
        "judges the merged cloud (or"
        " --set crop.kind=..). --set mapping.KEY=VALUE changes other settings: "
        "mapping.merge.cell_mm=1,"
        " mapping.marks.dictionary=DICT_4X4_50, mapping.registration.points=target (icp and "
        "cpd use the whole target"
        " instead of the points of the marks).",
    ).add_argument
    add(
        "--register",
        choices=cli.METHODS,
        metavar="METHOD",
        help=f"register the views by {', '.join(cli.METHODS)}",
    )
    add(
        "--merge",
        choices=cli.MERGES,
        metavar="KIND",
        help=f"merge them by {', '.join(cli.MERGES)} (default: fusion)",
    )
    marks = (
        "marks: colour (separate coloured strips; default), red (the thesis' rule), coded "
        "(ArUco, AprilTag)"
    )
    add("--marks", choices=cli.MARKS, metavar="KIND", help=marks)
    poses = (
        "poses from which registration starts: JSON with 4x4 matrices in metres, or TUM's "
        "groundtruth.txt"
    )
    add("--poses", type=Path, metavar="FILE", help=poses)


@program(
    detect_options,
    "Find damage in a real capture: average its frames, fit the surface, and list what "
    "deviates from it."
    " With --register, each PATH is one view of the same target, and all views are merged "
    "into one cloud.",
    "tofpod detect captures/board --out findings",
    "tofpod detect left right --register marks --marks coded --out findings",
)
def main(arguments: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.inspection.presentation import print_inspection, write_inspection
    from harness.inspection.run import inspected

    run = inspected(arguments)
    print_inspection(run)
    if arguments.out is not None:
        write_inspection(run, command)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
