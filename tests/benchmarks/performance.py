"""Speed beside other libraries, and what the parts of a study cost:
``python tests/benchmarks/performance.py [--quick] [PART ..]``.

Prints tables, and writes them to ``results/costs/``. No time is asserted. Ratios to other libraries
hold on any machine; times do not. The parts are `peers` and `growth` and `steps`.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

# Before NumPy is imported: one thread.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.benchmarks.measuring import COSTS, cell_text, print_heads, print_row, write_rows
from tests.benchmarks.peers import PEERS, PeerRow
from tests.benchmarks.study_steps import (
    STEPS,
    GrowthRow,
    StepRow,
    gain_of_a_second_process,
    growth,
)


def main() -> None:
    """Measure the parts that are named, or all."""
    parts = {"peers": peers, "steps": steps, "growth": growing, "processes": processes}
    parser = argparse.ArgumentParser(description="Compare speed; show what a study costs.")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(parts)}")
    parser.add_argument("--quick", action="store_true", help="fewer runs, less certain")
    options = parser.parse_args()
    unknown = [part for part in options.parts if part not in parts]
    if unknown:
        parser.error(f"there is no part {unknown[0]!r}; there are {', '.join(parts)}")
    # Mitsuba cannot run if Open3D was imported before it.
    from scenes.render.scene import load_mitsuba

    load_mitsuba()
    print(f"{os.cpu_count()} cores, one thread used; load {os.getloadavg()[0]:.1f} at the start")
    for part in options.parts or parts:
        print()
        parts[part](3 if options.quick else 9)
    print(f"\nload {os.getloadavg()[0]:.1f} at the end")


def peers(runs: int) -> None:
    """Print and store the steps that other libraries do too."""
    rows = (row for compare in PEERS for row in compare(runs))
    report("peers", PeerRow, rows)


def steps(runs: int) -> None:
    """Print and store the parts of a study."""
    rows = (row for measure in STEPS for row in measure(runs))
    report("steps", StepRow, rows)


def growing(runs: int) -> None:
    """Print and store how costs grow."""
    report("growth", GrowthRow, growth(runs))


def processes(runs: int) -> None:
    """Print what a second process gains."""
    gain = gain_of_a_second_process(runs)
    print(f"two processes do {gain:.2f} times the trials of one, by the wall clock")


def report(name: str, row_type: type, rows: Iterable[Any]) -> None:
    """Print rows as they are measured, and store them when all are."""
    columns = [field.name for field in fields(row_type)]
    print_heads(columns)
    measured = []
    for row in rows:
        print_row([cell_text(getattr(row, column)) for column in columns])
        measured.append(row)
    write_rows(COSTS / f"{name}.csv", row_type, measured)


if __name__ == "__main__":
    main()
