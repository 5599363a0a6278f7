"""``python -m harness.detect``: the damage in a real capture, as a table and, with --out, as files."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from harness.inspection.arguments import DEFAULT_DETECTOR, DEFAULT_FALSE_CALLS, LEGAL_CROP, MARKS, MERGES, METHODS
from harness.vocabulary.program import program, whole_number


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    formats = (
        "folder or list of depth .png, .ply, .pcd, .xyz; folder of .npy, .tiff; one .npy .npz .mat .tiff .pfm .mkv .r3d"
        " .bin; a ROS bag (folder, .mcap, .db3, .bag); a Stray Scanner folder; with --pitch a height map"
    )
    add("paths", nargs="+", type=Path, metavar="PATH", help=formats)
    files = (
        "write findings.csv, findings.json, annotated.png, targets.png (the surfaces to choose from), blind.png"
        " (where nothing returned) and cloud.ply here; of several views merged.ply, registrations.json and view3d.html"
        " (turns in the browser) too"
    )
    add("--out", type=Path, metavar="DIR", help=files)
    unit = "unit of the stored distances: mm, m, cm, um, tum (5000/m) or N/m; default: what the file, the camera or"
    add("--unit", help=f"{unit} the data say, which is printed")
    lens = "the lens of the depth pixels: a file, or a camera's nominal lens by name"
    add("--intrinsics", metavar="FILE|CAMERA", help=lens)
    crop = (
        f"which part is the target: {LEGAL_CROP}; default auto, the nearest large smooth surface less the 3 pixels"
        " of its rim where the camera mixes in what is behind (depth aligned to a finer colour camera:"
        " --set crop.inset_px=8)"
    )
    add("--crop", default="auto", metavar="KIND", help=crop)
    target = "with --crop auto: take surface N of those that a run lists and that targets.png, in --out, shows"
    add("--target", type=whole_number(10**9), metavar="N", help=target)
    add("--detector", default=DEFAULT_DETECTOR, help=f"detector's name (default: {DEFAULT_DETECTOR})")
    setting = "detector's setting by dotted path: surface.degree=5"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=setting)
    mesh = (
        "the part's own mesh as its undamaged surface, laid onto the cloud; --set surface.reference.unit=m, .front=-y"
    )
    add("--reference", metavar="MESH", help=mesh)
    averages = ("mean", "median", "clipped")
    add("--average", choices=averages, default="mean", help="how frames are averaged (default: mean)")
    add("--max-frames", type=whole_number(10**9), metavar="N", help="use the first N frames only")
    calls = (
        "set the threshold so that N false calls are expected in this capture, by the noise that it shows towards"
        f" the camera (default: {DEFAULT_FALSE_CALLS:g})"
    )
    add("--false-calls", type=float, metavar="N", help=calls)
    add("--threshold", type=float, metavar="K", help="threshold in units of score instead")
    flat = "take this unit's fixed pattern, as harness.flatfield measured it, off each capture"
    add("--flat-field", type=Path, metavar="FILE.npz", help=flat)
    gauge = "find the boards of this gauge.json (harness.gauge) by their marks, and tell hits and misses: gauge.csv"
    add("--gauge", type=Path, metavar="FILE.json", help=gauge)
    quiet = "calibrate the threshold on this capture of an undamaged target"
    add("--quiet-capture", type=Path, metavar="PATH", help=quiet)
    add("--topic", help="of a ROS bag: the topic with the depth images or clouds (default: the only one)")
    add("--array", metavar="NAME[:NUMBER]", help="of a .npz, .mat or .npy: the array, and which of several maps in it")
    add("--pitch", metavar="LENGTH", help="the array is a height map with this distance between pixels, such as 0.5mm")
    add("--raw", metavar="LAYOUT", help="of a file of bare numbers: WIDTHxHEIGHT[:TYPE[/STEP][:BYTES]], 640x480:u2")
    add = parser.add_argument_group(
        "several views of one target",
        "Each PATH is then one view. --crop cuts the target out of each; the detector judges all that is merged, unless"
        " --set crop.kind=.. says otherwise. --set mapping.KEY=VALUE sets what the arguments below do not name, such as"
        " mapping.merge.cell_mm=1, mapping.marks.dictionary=DICT_4X4_50 or mapping.registration.points=target (icp and"
        " cpd then use the whole target; else the points of the marks, which need colour).",
    ).add_argument
    add("--register", choices=METHODS, metavar="METHOD", help=f"register the views by {', '.join(METHODS)}")
    add("--merge", choices=MERGES, metavar="KIND", help=f"merge them by {', '.join(MERGES)} (default: fusion)")
    marks = (
        "the fiducial marks: colour (strips of any colour that stands apart; default), red (the thesis' rule),"
        " coded (ArUco, AprilTag)"
    )
    add("--marks", choices=MARKS, metavar="KIND", help=marks)
    poses = (
        "where the views are thought to stand: JSON, a list of 4x4 matrices to one common frame in metres, or"
        " lines of TUM's groundtruth.txt, one a view; only a start for the registration"
    )
    add("--poses", type=Path, metavar="FILE", help=poses)


@program(
    _options,
    "Find damage in a real capture: average its frames, fit the surface, list what departs from it."
    " With --register, each PATH is one view of the same target, and all of them become one cloud.",
    epilog="examples: python -m harness.detect recording.mkv --crop box:-200,200,-150,150,400,900 --out found/"
    "; python -m harness.detect left.mcap right.mcap --register marks --merge fusion --out found/",
)
def main(arguments: argparse.Namespace, command: str) -> int:
    """Returns 0, 2 on a mistake of the user, 130 after Ctrl-C."""
    from harness.inspection.run import inspect

    return inspect(arguments)


if __name__ == "__main__":
    sys.exit(main())
