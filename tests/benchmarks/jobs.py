"""What whole experiments cost: ``python tests/benchmarks/jobs.py [--out DIR] [--quick] [NAME ..]``.

Runs each shipped experiment, or the named ones, three times with two processes: from nothing; with
its renders stored, but no trials; and with everything stored. Prints a table of the processor
seconds that each run bills itself (`harness.runs.bill`), a row as soon as it is known, and the
minutes of the first run by the wall clock; and writes it to ``DIR/jobs.csv``. Run it on an idle
machine; all takes some two hours, ``--quick`` some fifteen minutes.

``--checkout`` runs the code of another checkout, and ``--before DIR`` sets what was measured there
beside it:

    python tests/benchmarks/jobs.py --checkout ../older --out results/costs/before averaging
    python tests/benchmarks/jobs.py --before results/costs/before averaging

``--read DIR`` runs nothing: it prints the bills of the newest runs in a folder of results.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from harness.records.outputs import PROVENANCE
from harness.runs.bill import BILL, FIXED
from harness.vocabulary.files import write_text

TABLE = "jobs.csv"
STATED = re.compile(r"^processor seconds: ([0-9.]+)", re.MULTILINE)
"""The bill on the terminal: provenance has that of the run that wrote the results."""
TRAINED_ON = "training"
"""An experiment that `tofpod train` uses, and nobody sweeps."""


@dataclass(frozen=True)
class Row:
    """What one experiment costs; None where it was not measured. Seconds are of all processors."""

    experiment: str
    """Its name."""
    views: int | None = None
    """Views that were rendered."""
    trials: int | None = None
    """Trials that were run."""
    before_s: float | None = None
    """From nothing, as another measurement found it."""
    from_nothing_s: float | None = None
    """From nothing."""
    fixed_s: float | None = None
    """Of that, what depends on neither views nor trials."""
    from_nothing_min: float | None = None
    """The same run by the wall clock."""
    renders_stored_s: float | None = None
    """With renders stored, but no trials."""
    all_stored_s: float | None = None
    """With everything stored."""


HEADS = {
    "experiment": "experiment",
    "views": "views",
    "trials": "trials",
    "before_s": "before (s)",
    "from_nothing_s": "from nothing (s)",
    "fixed_s": "of it fixed (s)",
    "from_nothing_min": "from nothing (min)",
    "renders_stored_s": "renders stored (s)",
    "all_stored_s": "all stored (s)",
}


def main() -> None:
    """Run the experiments, or read their bills, and print the table."""
    names = [path.stem for path in sorted((ROOT / "experiments").glob("*.yaml"))]
    shipped = [name for name in names if name != TRAINED_ON]
    parser = argparse.ArgumentParser(description="Print what whole experiments cost.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="default: all that are shipped")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "costs", metavar="DIR")
    parser.add_argument("--quick", action="store_true", help="the first look of each")
    parser.add_argument("--checkout", type=Path, default=ROOT, metavar="DIR", help="whose code")
    parser.add_argument("--before", type=Path, metavar="DIR", help="--out of another measurement")
    parser.add_argument("--read", type=Path, metavar="DIR", help="print bills in DIR, run nothing")
    options = parser.parse_args()
    before = {} if options.before is None else seconds_before(options.before)
    print_row(list(HEADS.values()))
    print_row(["---"] * len(HEADS))
    rows = []
    for name in options.names or shipped:
        if options.read is not None:
            row = row_of_bill(options.read, name, before.get(name))
        else:
            row = measured_row(
                options.out.absolute() / name,
                name,
                checkout=options.checkout,
                quick=options.quick,
                before_s=before.get(name),
            )
        print_row([cell_text(getattr(row, field)) for field in HEADS])
        rows.append(row)
        if options.read is None:
            write_table(options.out / TABLE, rows)


def print_row(cells: Sequence[str]) -> None:
    """Print a row of a table in Markdown."""
    print(f"| {' | '.join(cells)} |", flush=True)


def cell_text(value: str | float | None) -> str:
    """Return a cell of the printed table: minutes and short times with a decimal."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.1f}" if value < 20 else f"{value:.0f}"
    return str(value)


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows measured so far as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = [field.name for field in fields(Row)]
    writer.writerow(names)
    for row in rows:
        writer.writerow([getattr(row, name) for name in names])
    write_text(path, text.getvalue())


def seconds_before(folder: Path) -> dict[str, float]:
    """Return the seconds from nothing by experiment, as another measurement wrote them."""
    with (folder / TABLE).open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return {row["experiment"]: float(row["from_nothing_s"]) for row in rows}


def measured_row(
    out: Path, name: str, *, checkout: Path, quick: bool, before_s: float | None
) -> Row:
    """Run an experiment three times in a folder of its own, because experiments share renders;
    return its row."""
    shutil.rmtree(out, ignore_errors=True)
    began = time.monotonic()
    run(out, name, checkout=checkout, quick=quick)
    minutes = (time.monotonic() - began) / 60
    first = row_of_bill(out, name, before_s)
    shutil.rmtree(out / name)
    renders_stored_s = run(out, name, checkout=checkout, quick=quick)
    all_stored_s = run(out, name, checkout=checkout, quick=quick)
    return Row(
        experiment=name,
        views=first.views,
        trials=first.trials,
        before_s=before_s,
        from_nothing_s=first.from_nothing_s,
        fixed_s=first.fixed_s,
        from_nothing_min=round(minutes, 2),
        renders_stored_s=renders_stored_s,
        all_stored_s=all_stored_s,
    )


def run(out: Path, name: str, *, checkout: Path, quick: bool) -> float:
    """Run an experiment; its page and tables go to ``out``. Return the processor seconds that it
    states. What fails in it costs too."""
    command = [sys.executable, "-m", "harness", "sweep", name, "--out", str(out)]
    if quick:
        command.append("--quick")
    environment = os.environ | {"PYTHONPATH": str(checkout.absolute())}
    ended = subprocess.run(
        command, cwd=checkout, env=environment, capture_output=True, encoding="utf-8"
    )
    stated = STATED.search(ended.stderr)
    if ended.returncode not in (0, 1) or stated is None:
        raise SystemExit(f"{ended.stderr}{name} ended with exit code {ended.returncode}")
    return float(stated[1])


def bill_of(out: Path, name: str) -> Mapping[str, Any]:
    """Return the provenance of an experiment's newest run; empty if there is none."""
    files = (out / name).glob(f"*/{PROVENANCE.name}")
    newest_first = sorted(files, key=lambda file: file.stat().st_mtime, reverse=True)
    for file in newest_first[:1]:
        facts: Mapping[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return facts
    return {}


def row_of_bill(out: Path, name: str, before_s: float | None) -> Row:
    """Return the cells of an experiment's row that its newest bill fills."""
    facts = bill_of(out, name)
    if BILL not in facts:
        return Row(experiment=name, before_s=before_s)
    seconds = facts[BILL]
    return Row(
        experiment=name,
        views=facts["renders"]["done"],
        trials=facts["trials"]["done"],
        before_s=before_s,
        from_nothing_s=round(sum(seconds.values()), 2),
        fixed_s=round(sum(seconds[phase] for phase in FIXED), 2),
    )


if __name__ == "__main__":
    main()
