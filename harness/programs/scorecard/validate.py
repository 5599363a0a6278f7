"""``tofpod validate``: compares the simulated cameras with published figures, or with a real
capture."""

import argparse
from pathlib import Path

from harness.inspection.arguments import READING, add_reading, opened, reading_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.program import program, whole_number


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--camera",
        action="append",
        default=[],
        metavar="NAME",
        help="only this camera; may be repeated",
    )
    add(
        "--out",
        type=Path,
        default=Path("results/validate"),
        metavar="DIR",
        help="default: results/validate",
    )
    add(
        "--jobs",
        type=whole_number(4096),
        default=2,
        metavar="N",
        help="worker processes (default: 2)",
    )
    add("--figures", type=Path, metavar="FILE", help="a file with other published figures")
    add(
        "--power",
        action="store_true",
        help="move each constant of the cameras and name the figures that notice it "
        "(3 minutes on two cores for all cameras)",
    )
    put = parser.add_argument_group("a real capture").add_argument
    put(
        "--capture",
        type=Path,
        nargs="+",
        metavar="PATH",
        help="frames of a static scene, as read by tofpod detect",
    )
    add_reading(put)
    put("--max-frames", type=whole_number(4096), metavar="N", help="use only the first N frames")
    put(
        "--mask",
        type=Path,
        metavar="PNG",
        help="use only the pixels that are not black in this image",
    )
    put(
        "--board",
        type=Path,
        metavar="YAML",
        help="an experiment with a drilled board to compare with the capture",
    )
    put(
        "--albedo",
        type=float,
        default=0.8,
        metavar="A",
        help="albedo of the surfaces (default: 0.8, a light wall)",
    )


@program(
    _options,
    "Measure the simulated cameras like real cameras, and compare each published figure with the "
    "simulated figure. With --capture: compare a real capture of a static scene with the "
    "simulation of the planes and edges in it.",
    "tofpod validate --camera azure_kinect_nfov",
    "tofpod validate --capture captures/wall --camera azure_kinect_nfov",
    epilog="The exit code is 1 if a figure or a family of figures fails and its entry in the file "
    "gives no reason, or if --power finds other untested constants than are on file.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 1 if a figure fails without a reason, 2 for a user's mistake,
    130 after Ctrl-C."""
    if options.capture or options.board:
        if options.figures:
            raise UserError("--figures belongs to the scorecard, not to a capture")
        if options.power:
            raise UserError("--power belongs to the scorecard, not to a capture")
        if options.board is None:
            from harness.programs.camera.capture import run_capture

            return run_capture(options, command)
        from harness.programs.scorecard.board import run_board

        if options.camera or options.mask:
            raise UserError(
                "--camera and --mask cannot be combined with --board: the experiment names the "
                "camera"
            )
        reading = {
            **reading_of(options),
            "frames": slice(options.max_frames) if options.max_frames else None,
        }
        recording = (
            opened(options.capture, options.intrinsics, **reading) if options.capture else None
        )
        return run_board(options, recording, command)
    for name in (*READING, "intrinsics", "max_frames", "mask"):
        if getattr(options, name) is not None:
            raise UserError(
                f"--{name.replace('_', '-')} belongs to a capture, but none is named",
                fix="add --capture PATH",
            )
    from harness.programs.scorecard.program import run_scorecard

    return run_scorecard(options, command)


if __name__ == "__main__":
    raise SystemExit(main())
