"""What whole jobs cost: ``python tests/benchmarks/jobs.py [--quick] [--results DIR] [NAME ..]``.

Runs each shipped experiment and the main programs, or the named ones, with two processes. A job
that stores trials runs three times: from nothing; with its renders stored, but no trials; and with
everything stored. With ``--once`` it runs from nothing only. Each row is printed and stored in
``results/costs/jobs.csv`` as soon as it is known. A job that this code has already been measured on
is left out (``--again``: measured again), so that the same command goes on after it was stopped.
All takes some two hours on an idle machine with two cores. What renders, trials and all else of
each experiment cost from nothing is stored in ``bills.csv`` beside it, from which ``--dry-run``
says what to expect.

``--quick`` runs the first look of each experiment instead, once, from nothing, for ``quick.csv``;
all takes some fifteen minutes. ``--results results`` keeps what was made in that folder of
results, where `tofpod artefacts` finds the trials; otherwise it is removed.

``--before DIR`` runs the code of another checkout in turns with this one's, each with its own
experiments. Without it, what a row says of the other code is kept:

    python tests/benchmarks/jobs.py --before ../older averaging check

Seconds are those of all processes of a run, as the operating system counts them; Linux only.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import datetime
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from harness.experiment.load import load_experiment
from harness.records.outputs import LATEST
from harness.runs.expected import PastRun, kind_of, past_run
from harness.vocabulary.code_digests import file_digests
from harness.vocabulary.seeds import digest
from tests.benchmarks.measuring import COSTS, cell_text, print_heads, print_row, write_rows
from tests.benchmarks.whole_jobs import (
    INPUTS,
    Job,
    experiments,
    jobs_named,
    keep_results,
    write_inspections,
)

TABLE = "jobs.csv"
QUICK_TABLE = "quick.csv"
BILLS = "bills.csv"
BASELINES = ROOT / "results" / "baselines"
QUOTED = BASELINES / "tables"
"""Folder of the tables that documents quote, without columns that they do not show."""
TEXTS = ("job", "measured", "code", "before_measured", "kind")
"""Columns that are no numbers."""
COUNTS = ("renders", "trials")
"""Columns of whole numbers."""
CODE = ("detectors", "scenes", "harness")
"""Rooms whose code decides what jobs cost."""
DIGITS = 8
PR_SET_CHILD_SUBREAPER = 36
"""Of prctl(2): orphans among a process' descendants become its children."""


@dataclass(frozen=True)
class Row:
    """What a job costs; None where it was not measured. Seconds of processor time are those of all
    processes."""

    job: str
    """Its name."""
    measured: str
    """The day."""
    code: str
    """Digest of the code that was measured."""
    before_measured: str
    """The day on which the other checkout's code was measured; empty if it was not."""
    before_s: float | None
    """Processor time from nothing, by the other checkout."""
    before_renders_stored_s: float | None
    """Likewise, with its renders stored, but no trials."""
    before_all_stored_s: float | None
    """Likewise, with everything stored."""
    from_nothing_s: float
    """Processor time from nothing."""
    renders_stored_s: float | None
    """With its renders stored, but no trials; None for a job that stores no trials."""
    all_stored_s: float | None
    """With everything stored; None likewise."""
    wall_s: float
    """From nothing, by the wall clock."""


@dataclass(frozen=True)
class QuickRow:
    """What the first look at an experiment costs, from nothing."""

    job: str
    """The experiment's name."""
    measured: str
    """The day."""
    code: str
    """Digest of the code that was measured."""
    processor_s: float
    """Processor time of all processes."""
    wall_s: float
    """Time by the wall clock."""


@dataclass(frozen=True)
class BillRow:
    """What the parts of an experiment cost from nothing, in processor seconds, as
    `harness.runs.expected` reads it."""

    job: str
    """The experiment's name."""
    kind: str
    """Its kind: ``study``, ``maps`` or ``sweep``."""
    renders: int
    """Number of renders."""
    trials: int
    """Number of trials."""
    renders_s: float
    """Seconds of renders."""
    trials_s: float
    """Seconds of frames and detection."""
    fixed_s: float
    """Seconds of all else."""


AnyRow = TypeVar("AnyRow", Row, QuickRow, BillRow)


@dataclass(frozen=True)
class Spent:
    """What a run has spent."""

    processor_s: float
    """Seconds of all its processes."""
    wall_s: float
    """Seconds by the wall clock."""


@dataclass(frozen=True)
class Runs:
    """The runs of a job; None for those that it has not."""

    from_nothing: Spent
    """With nothing stored."""
    renders_stored: Spent | None = None
    """With its renders stored."""
    all_stored: Spent | None = None
    """With everything stored."""
    bill: PastRun | None = None
    """What parts of the first cost, if it recorded that."""


class Failed(Exception):
    """A run that ended with an error; its text says which."""


def main() -> None:
    """Run the jobs and print the table."""
    parser = argparse.ArgumentParser(description="Print what whole jobs cost.")
    add = parser.add_argument
    add("names", nargs="*", metavar="NAME", help="experiments or programs (default: all)")
    add("--out", type=Path, default=COSTS, metavar="DIR", help="folder of the tables")
    add("--quick", action="store_true", help="the first look of each experiment, once")
    add("--results", type=Path, metavar="DIR", help="folder of results that keeps what is made")
    add("--before", type=Path, metavar="DIR", help="checkout of other code, run in turns")
    add("--again", action="store_true", help="also measure what this code was measured on")
    add("--once", action="store_true", help="from nothing only, for jobs that take long")
    options = parser.parse_args()
    adopt_orphans()
    jobs = jobs_named(options.names)
    if options.quick:
        known = experiments()
        all_well = quick_table([job for job in jobs if job in known], options)
    else:
        all_well = full_table(jobs, options)
    raise SystemExit(int(not all_well))


def quick_table(jobs: Sequence[Job], options: argparse.Namespace) -> bool:
    """Measure and store the first looks at experiments. Return whether all ended well."""
    path = options.out.absolute() / QUICK_TABLE
    print_heads([field.name for field in fields(QuickRow)])
    prepare(ROOT)
    folders = folders_in(options.out.absolute())
    all_well = True
    for job in left_to_measure(jobs, stored_rows(path, QuickRow), again=options.again):
        shutil.rmtree(folders["out"], ignore_errors=True)
        try:
            spent = run(ROOT, [*job.command(folders), "--quick"])
        except Failed as failure:
            print(f"{job.name}: {failure}", file=sys.stderr, flush=True)
            all_well = False
            continue
        row = QuickRow(
            job=job.name,
            measured=today(),
            code=code_digest(),
            processor_s=round(spent.processor_s, 1),
            wall_s=round(spent.wall_s, 1),
        )
        shutil.rmtree(folders["out"])
        store(path, row)
        print_values(row)
    return all_well


def full_table(jobs: Sequence[Job], options: argparse.Namespace) -> bool:
    """Measure and store what jobs cost. Return whether all ended well."""
    out = options.out.absolute()
    path = out / TABLE
    folders = folders_in(out)
    print_heads([field.name for field in fields(Row)])
    before_at = None if options.before is None else options.before.absolute()
    for checkout in filter(None, (before_at, ROOT)):
        prepare(checkout)
    all_well = True
    make_inputs(folders)
    for job in left_to_measure(jobs, stored_rows(path, Row), again=options.again):
        try:
            before = None
            if before_at is not None:
                before = before_of(job, before_at, folders, once=options.once)
            now = runs_of(job, ROOT, folders, once=options.once)
        except Failed as failure:
            print(f"{job.name}: {failure}", file=sys.stderr, flush=True)
            all_well = False
            continue
        row = row_of(job.name, before, now, stored_row(path, job.name))
        store(path, row)
        print_values(row)
        if now.bill is not None:
            store_bill(out / BILLS, job, now.bill)
        if options.results is not None and folders["out"].exists():
            keep_results(folders["out"], options.results.absolute())
        shutil.rmtree(folders["out"], ignore_errors=True)
    return all_well


# ---------------------------------------------------------------- runs


def prepare(checkout: Path) -> None:
    """Compile the inner loops of a checkout, which no job's time is to include."""
    words = ["harness", "prepare"]
    if (checkout / "harness" / "prepare.py").exists():  # in November 2026 it was a program apart
        words = ["harness.prepare"]
    command = [sys.executable, "-m", *words]
    subprocess.run(
        command, cwd=checkout, env=environment(checkout), stdout=subprocess.DEVNULL, check=False
    )


def folders_in(out: Path) -> dict[str, Path]:
    """Return the folders that a job's words name, in the folder of the tables."""
    return {"out": out / "now", "inputs": out / "inputs"}


def make_inputs(folders: Mapping[str, Path]) -> None:
    """Make what programs read, unless it is there."""
    table = folders["inputs"] / "inspections.csv"
    if not table.exists():
        write_inspections(table)
    for made in INPUTS:
        folder = folders["inputs"] / made.folder
        if not folder.exists():
            words = [word.format_map(folders) for word in made.words]
            run(ROOT, [*words, "--out", str(folder)])


def before_of(job: Job, checkout: Path, folders: Mapping[str, Path], *, once: bool) -> Runs | None:
    """Return the runs of a job by another checkout; None if it has no such experiment, or cannot
    do it."""
    if job.experiment and not (checkout / job.experiment).exists():
        return None
    try:
        return runs_of(job, checkout, folders, once=once)
    except Failed as failure:
        print(f"{job.name}, before: {failure}", file=sys.stderr, flush=True)
        return None


def runs_of(job: Job, checkout: Path, folders: Mapping[str, Path], *, once: bool) -> Runs:
    """Run a job in an empty folder, because experiments share renders; ``once``: from nothing only.
    Raises Failed."""
    work = folders["out"]
    shutil.rmtree(work, ignore_errors=True)
    words = job.command(folders)
    from_nothing = run(checkout, words)
    is_sweep = job.stored == job.name
    bill = past_run(work / job.stored / LATEST) if is_sweep else None
    if job.makes and not any(work.glob(job.makes)):
        raise Failed(f"it made no {job.makes}")
    if once or not job.stored:
        return Runs(from_nothing, bill=bill)
    shutil.rmtree(work / job.stored)
    renders_stored = run(checkout, words)
    all_stored = run(checkout, words)
    return Runs(from_nothing, renders_stored, all_stored, bill)


def run(checkout: Path, words: Sequence[str]) -> Spent:
    """Run a program by the code of a checkout. One that finds something wrong, which is exit code
    1, costs too. Raises Failed for any other."""
    command = [sys.executable, "-m", "harness", *words]
    used_before_s = used_by_children_s()
    began = time.monotonic()
    ended = subprocess.run(
        command,
        cwd=checkout,
        env=environment(checkout),
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    wall_s = time.monotonic() - began
    if ended.returncode not in (0, 1):
        raise Failed(f"exit code {ended.returncode}\n{ended.stderr}")
    wait_for_orphans()
    return Spent(processor_s=used_by_children_s() - used_before_s, wall_s=wall_s)


def environment(checkout: Path) -> dict[str, str]:
    """Return the variables of a run: the code of a checkout, which Python may keep compiled."""
    variables = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    variables.pop("PYTHONDONTWRITEBYTECODE", None)
    return variables


def adopt_orphans() -> None:
    """Make orphans among this process' descendants its children. A sweep's workers outlive the
    process that started them by a moment, and their time counts only once a parent waited."""
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


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


# ---------------------------------------------------------------- the table


@cache
def code_digest() -> str:
    """Return a digest of this checkout's code, cameras and experiments."""
    yaml = [*ROOT.glob("scenes/cameras/*.yaml"), *ROOT.glob("experiments/*.yaml")]
    names = [*CODE, *sorted(path.relative_to(ROOT).as_posix() for path in yaml)]
    return digest(file_digests(names))[:DIGITS]


def today() -> str:
    """Return the day."""
    return datetime.date.today().isoformat()


def left_to_measure(jobs: Sequence[Job], rows: Sequence[AnyRow], *, again: bool) -> list[Job]:
    """Return the jobs that have no row of this checkout's code; all if ``again``."""
    measured = {row.job for row in rows if row.code == code_digest()}
    return [job for job in jobs if again or job.name not in measured]


def row_of(name: str, before: Runs | None, now: Runs, earlier: Row | None) -> Row:
    """Return a job's row. What an ``earlier`` row says of the other code stays if that was not
    measured again."""
    before_measured = today() if before else ""
    before_s = [None, None, None]
    if before is not None:
        before_s = seconds_of(before)
    elif earlier is not None:
        before_measured = earlier.before_measured
        before_s = [
            earlier.before_s,
            earlier.before_renders_stored_s,
            earlier.before_all_stored_s,
        ]
    from_nothing_s, renders_stored_s, all_stored_s = seconds_of(now)
    return Row(
        job=name,
        measured=today(),
        code=code_digest(),
        before_measured=before_measured,
        before_s=before_s[0],
        before_renders_stored_s=before_s[1],
        before_all_stored_s=before_s[2],
        from_nothing_s=from_nothing_s,
        renders_stored_s=renders_stored_s,
        all_stored_s=all_stored_s,
        wall_s=round(now.from_nothing.wall_s, 1),
    )


def seconds_of(runs: Runs) -> list[Any]:
    """Return the processor seconds of each run, with a decimal; None for a run that was not."""
    spent = (runs.from_nothing, runs.renders_stored, runs.all_stored)
    return [None if one is None else round(one.processor_s, 1) for one in spent]


def print_values(row: Row | QuickRow) -> None:
    """Print a row of the table."""
    print_row([cell_text(getattr(row, field.name)) for field in fields(row)])


def store_bill(path: Path, job: Job, bill: PastRun) -> None:
    """Write what the parts of an experiment cost into the table of bills."""
    row = BillRow(
        job=job.name,
        kind=kind_of(load_experiment(ROOT / job.experiment)),
        renders=bill.renders,
        trials=bill.trials,
        renders_s=round(bill.renders_s, 1),
        trials_s=round(bill.trials_s, 1),
        fixed_s=round(bill.fixed_s, 1),
    )
    store(path, row)


def store(path: Path, row: Row | QuickRow | BillRow) -> None:
    """Write a row into the table, in place of an earlier one of the same job."""
    rows = [stored for stored in stored_rows(path, type(row)) if stored.job != row.job]
    write_rows(path, type(row), sorted([*rows, row], key=attrgetter("job")))


def stored_row(path: Path, name: str) -> Row | None:
    """Return the row of a job in a table; None if there is none."""
    for row in stored_rows(path, Row):
        if row.job == name:
            return row
    return None


def stored_rows(path: Path, row_type: type[AnyRow]) -> list[AnyRow]:
    """Return the rows of a table; if it does not exist yet, those of the repository."""
    existing = [
        known for known in (path, QUOTED / path.name, BASELINES / path.name) if known.exists()
    ]
    if not existing:
        return []
    with existing[0].open(encoding="utf-8", newline="") as stream:
        return [row_of_texts(texts, row_type) for texts in csv.DictReader(stream)]


def row_of_texts(texts: Mapping[str, str], row_type: type[AnyRow]) -> AnyRow:
    """Return a row as the table has it; an empty text is a number that was not measured."""
    values: dict[str, Any] = {}
    for field in fields(row_type):
        text = texts.get(field.name, "")
        if field.name in TEXTS:
            values[field.name] = text
        elif field.name in COUNTS:
            values[field.name] = int(text)
        else:
            values[field.name] = float(text) if text else None
    return row_type(**values)


if __name__ == "__main__":
    main()
