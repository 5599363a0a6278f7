"""What whole experiments cost: ``python tests/benchmarks/jobs.py [--out DIR] [--quick] [NAME ..]``.

Runs each shipped experiment, or the named ones, three times with two processes: from nothing; with
its renders stored, but no trials; and with everything stored. Prints a table of the processor
seconds that each run bills itself (`harness.runs.bill`), a row as soon as it is known, and the
minutes of the first run by the wall clock. Run it on an idle machine; all takes some two hours,
``--quick`` some fifteen minutes. ``--read`` runs nothing: it prints the bills of the newest runs in
DIR.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from harness.records.outputs import PROVENANCE
from harness.runs.bill import BILL, FIXED

BILLED = ("experiment", "views", "trials", "from nothing (s)", "of it fixed (s)")
MEASURED = ("from nothing (min)", "renders stored (s)", "all stored (s)")


def main() -> None:
    """Run the experiments, or read their bills, and print the table."""
    shipped = [path.stem for path in sorted((ROOT / "experiments").glob("*.yaml"))]
    parser = argparse.ArgumentParser(description="Print what whole experiments cost.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="default: all that are shipped")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "costs", metavar="DIR")
    parser.add_argument("--quick", action="store_true", help="the first look of each")
    parser.add_argument("--read", action="store_true", help="run nothing; read bills in DIR")
    options = parser.parse_args()
    columns = list(BILLED)
    if not options.read:
        columns += MEASURED
    print_row(columns)
    print_row(["---"] * len(columns))
    for name in options.names or shipped:
        if options.read:
            print_row(row_of_bill(options.out, name))
        else:
            print_row(measured_row(options.out / name, name, quick=options.quick))


def print_row(cells: Sequence[str]) -> None:
    """Print a row of a table in Markdown."""
    print(f"| {' | '.join(cells)} |", flush=True)


def measured_row(out: Path, name: str, *, quick: bool) -> list[str]:
    """Run an experiment three times in a folder of its own, because experiments share renders;
    return its row."""
    shutil.rmtree(out, ignore_errors=True)
    began = time.monotonic()
    run(out, name, quick=quick)
    minutes = (time.monotonic() - began) / 60
    row = row_of_bill(out, name)
    row.append(f"{minutes:.1f}")
    shutil.rmtree(out / name)
    for _ in MEASURED[1:]:
        run(out, name, quick=quick)
        seconds = bill_of(out, name)[BILL]
        row.append(f"{sum(seconds.values()):.0f}")
    return row


def run(out: Path, name: str, *, quick: bool) -> None:
    """Run an experiment; its page and tables go to ``out``."""
    command = [sys.executable, "-m", "harness", "sweep", name, "--out", str(out)]
    if quick:
        command.append("--quick")
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


def bill_of(out: Path, name: str) -> Mapping[str, Any]:
    """Return the provenance of an experiment's newest run; empty if there is none."""
    files = (out / name).glob(f"*/{PROVENANCE.name}")
    newest_first = sorted(files, key=lambda file: file.stat().st_mtime, reverse=True)
    for file in newest_first[:1]:
        facts: Mapping[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return facts
    return {}


def row_of_bill(out: Path, name: str) -> list[str]:
    """Return the cells of an experiment's row that its newest bill fills."""
    facts = bill_of(out, name)
    if BILL not in facts:
        return [f"`{name}`", *["no bill"] * (len(BILLED) - 1)]
    seconds = facts[BILL]
    fixed_s = sum(seconds[phase] for phase in FIXED)
    return [
        f"`{name}`",
        str(facts["renders"]["done"]),
        str(facts["trials"]["done"]),
        f"{sum(seconds.values()):.0f}",
        f"{fixed_s:.0f}",
    ]


if __name__ == "__main__":
    main()
