"""What whole experiments cost: ``python tests/benchmarks/jobs.py [--out DIR] [--quick] [NAME ..]``.

Runs each shipped experiment, or the named ones, three times with two processes: from nothing; with
its renders stored, but no trials; and with everything stored. Prints a row as soon as it is known,
and writes the table to ``DIR/jobs.csv``, beside the rows of other experiments that stand there. Run
it on an idle machine with two cores; all takes some two hours, ``--quick`` some fifteen minutes.

``--before`` runs the code of another checkout in turns with this one's, each with its own
experiments:

    python tests/benchmarks/jobs.py --before ../older averaging

Seconds are those of all processes of a run, as the operating system counts them; Linux only.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from tests.benchmarks.measuring import COSTS, cell_text, print_heads, print_row, write_rows

TABLE = "jobs.csv"
NAME = "experiment"
"""Column of the name."""
TRAINED_ON = "training"
"""An experiment that `tofpod train` uses, and nobody sweeps."""
PR_SET_CHILD_SUBREAPER = 36
"""Of prctl(2): orphans among a process' descendants become its children."""


@dataclass(frozen=True)
class Row:
    """What an experiment costs; None where it was not measured. Seconds of processor time are those
    of all processes."""

    experiment: str
    """Its name."""
    before_s: float | None
    """Processor time from nothing, by the other checkout."""
    before_renders_stored_s: float | None
    """Likewise, with its renders stored, but no trials."""
    before_all_stored_s: float | None
    """Likewise, with everything stored."""
    from_nothing_s: float
    """Processor time from nothing."""
    renders_stored_s: float
    """With its renders stored, but no trials."""
    all_stored_s: float
    """With everything stored."""
    wall_s: float
    """From nothing, by the wall clock."""


HEADS = {
    "experiment": "experiment",
    "before_s": "before: from nothing (s)",
    "before_renders_stored_s": "before: renders stored (s)",
    "before_all_stored_s": "before: all stored (s)",
    "from_nothing_s": "from nothing (s)",
    "renders_stored_s": "renders stored (s)",
    "all_stored_s": "all stored (s)",
    "wall_s": "from nothing, by the wall clock (s)",
}


@dataclass(frozen=True)
class Spent:
    """What a run has spent."""

    processor_s: float
    """Seconds of all its processes."""
    wall_s: float
    """Seconds by the wall clock."""


@dataclass(frozen=True)
class Runs:
    """The three runs of an experiment."""

    from_nothing: Spent
    """With nothing stored."""
    renders_stored: Spent
    """With its renders stored."""
    all_stored: Spent
    """With everything stored."""


def main() -> None:
    """Run the experiments and print the table."""
    names = [path.stem for path in sorted((ROOT / "experiments").glob("*.yaml"))]
    shipped = [name for name in names if name != TRAINED_ON]
    parser = argparse.ArgumentParser(description="Print what whole experiments cost.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="default: all that are shipped")
    parser.add_argument("--out", type=Path, default=COSTS, metavar="DIR")
    parser.add_argument("--quick", action="store_true", help="the first look of each")
    parser.add_argument("--before", type=Path, metavar="DIR", help="checkout of other code")
    options = parser.parse_args()
    adopt_orphans()
    out = options.out.absolute()
    print_heads(list(HEADS.values()))
    for name in options.names or shipped:
        before = None
        if options.before is not None and (options.before / file_of(name)).exists():
            before = three_runs(options.before.absolute(), name, out / "before", quick=False)
        now = three_runs(ROOT, name, out / "now", quick=options.quick)
        row = row_of(name, before, now)
        print_row([cell_text(getattr(row, field)) for field in HEADS])
        store(out / TABLE, row)


def file_of(name: str) -> Path:
    """Return the file of an experiment, relative to a checkout."""
    return Path("experiments") / f"{name}.yaml"


def adopt_orphans() -> None:
    """Make orphans among this process' descendants its children. A sweep's workers outlive the
    process that started them by a moment, and their time counts only once a parent waited."""
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def three_runs(checkout: Path, name: str, out: Path, *, quick: bool) -> Runs:
    """Run an experiment three times in a folder of its own, because experiments share renders."""
    folder = out / name
    shutil.rmtree(folder, ignore_errors=True)
    from_nothing = run(checkout, name, folder, quick=quick)
    shutil.rmtree(folder / name)
    renders_stored = run(checkout, name, folder, quick=quick)
    all_stored = run(checkout, name, folder, quick=quick)
    return Runs(from_nothing, renders_stored, all_stored)


def run(checkout: Path, name: str, folder: Path, *, quick: bool) -> Spent:
    """Run an experiment by the code of a checkout; its page and tables go to ``folder``. A study
    that fails a claim, which is exit code 1, costs too. Ends this program if it fails otherwise."""
    command = [sys.executable, "-m", "harness.sweep", str(file_of(name)), "--out", str(folder)]
    if quick:
        command.append("--quick")
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    used_before_s = used_by_children_s()
    began = time.monotonic()
    ended = subprocess.run(
        command, cwd=checkout, env=environment, capture_output=True, encoding="utf-8", check=False
    )
    wall_s = time.monotonic() - began
    if ended.returncode not in (0, 1):
        raise SystemExit(f"{ended.stderr}{name} ended with exit code {ended.returncode}")
    wait_for_orphans()
    return Spent(processor_s=used_by_children_s() - used_before_s, wall_s=wall_s)


def wait_for_orphans() -> None:
    """Wait until this process has no children."""
    while True:
        try:
            os.wait()
        except ChildProcessError:
            return


def used_by_children_s() -> float:
    """Return the processor time of all descendants that have ended, in seconds."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def row_of(name: str, before: Runs | None, now: Runs) -> Row:
    """Return an experiment's row."""
    return Row(
        experiment=name,
        before_s=seconds_of(before.from_nothing if before else None),
        before_renders_stored_s=seconds_of(before.renders_stored if before else None),
        before_all_stored_s=seconds_of(before.all_stored if before else None),
        from_nothing_s=round(now.from_nothing.processor_s, 1),
        renders_stored_s=round(now.renders_stored.processor_s, 1),
        all_stored_s=round(now.all_stored.processor_s, 1),
        wall_s=round(now.from_nothing.wall_s, 1),
    )


def seconds_of(spent: Spent | None) -> float | None:
    """Return a run's processor seconds, with a decimal; None if there was no run."""
    return None if spent is None else round(spent.processor_s, 1)


def store(path: Path, row: Row) -> None:
    """Write a row into the table, in place of an earlier one of the same experiment."""
    rows = [stored for stored in stored_rows(path) if stored.experiment != row.experiment]
    write_rows(path, Row, sorted([*rows, row], key=attrgetter(NAME)))


def stored_rows(path: Path) -> list[Row]:
    """Return the rows of a table; none if it does not exist yet."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as stream:
        return [row_of_texts(texts) for texts in csv.DictReader(stream)]


def row_of_texts(texts: Mapping[str, str]) -> Row:
    """Return a row as the table has it; an empty text is a number that was not measured."""
    numbers = {field: float(text) for field, text in texts.items() if text and field != NAME}
    missing = {field: None for field, text in texts.items() if not text}
    return Row(experiment=texts[NAME], **numbers, **missing)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
