"""``tofpod gauge read``: counts the hits and misses of a gauge's holes in a capture."""

import argparse
from pathlib import Path

from harness.detect import detect_options
from harness.vocabulary.program import Program


def _options(parser: argparse.ArgumentParser) -> None:
    detect_options(parser)
    truth = "the truth that tofpod gauge wrote: its boards are found by their marks"
    parser.add_argument("--gauge", type=Path, required=True, metavar="FILE.json", help=truth)


def _run(arguments: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.inspection import output
    from harness.inspection.presentation import print_inspection, write_inspection
    from harness.inspection.run import inspected
    from harness.programs.inspections.gauge_board import HITS_AND_MISSES, read_gauge, seen_on
    from harness.records.outputs import GAUGE_ROWS
    from harness.vocabulary.text import show

    gauge = read_gauge(arguments.gauge)
    inspection = inspected(arguments)
    detector = f"{inspection.detector.name} {inspection.detector.version}"
    reading = seen_on(gauge, inspection.result, detector, inspection.threshold)
    print_inspection(inspection, further_warnings=reading.warnings)
    output.print_notes(reading.notes)
    show([HITS_AND_MISSES.grid(reading.rows, terminal=True)])
    print(reading.answer)
    if arguments.out is not None:
        frame = HITS_AND_MISSES.frame(reading.rows)
        table = frame.to_csv(index=False, float_format="%.6g", lineterminator="\n")
        write_inspection(
            inspection,
            command,
            further_inputs=[arguments.gauge],
            further_files={
                GAUGE_ROWS.name: lambda path: path.write_text(table, encoding="utf-8"),
            },
            further_warnings=reading.warnings,
        )
    return 0


READ = Program(
    name="gauge read",
    options=_options,
    run=_run,
    description="Find the boards of a gauge in a capture by their marks, inspect the capture as "
    "tofpod detect does, and count which holes are hit. Write the findings, and hits and misses "
    "to gauge.csv, which tofpod pod reads.",
    examples=(
        "tofpod gauge read captures/gauge --gauge gauge/gauge.json",
        "tofpod gauge read captures/gauge --gauge gauge/gauge.json --detector matched --out found",
    ),
)
