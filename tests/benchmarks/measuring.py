"""Processor times of pieces of work, and the tables into which the benchmarks write them.

Times are processor times, which other work on the machine lengthens less than the wall clock. No
time is asserted anywhere: machines differ.
"""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from harness.vocabulary.files import write_text

ROOT = Path(__file__).resolve().parents[2]
COSTS = ROOT / "results" / "costs"
"""Folder of the tables."""
Work = Callable[[], Any]


def processor_s(work: Work) -> float:
    """Return the processor time of a call in this process, in seconds."""
    began = time.process_time()
    work()
    return time.process_time() - began


def median_s(work: Work, runs: int) -> float:
    """Return the median processor time of ``runs`` calls, after one that is not counted."""
    work()
    return float(np.median([processor_s(work) for _ in range(runs)]))


def median_in_turns_s(works: Mapping[str, Work], runs: int) -> dict[str, float]:
    """Return the median processor time of each work. All take turns, so that their ratios hold on
    a machine whose speed changes while they run."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(runs):
        for name, work in works.items():
            times[name].append(processor_s(work))
    return {name: float(np.median(seconds)) for name, seconds in times.items()}


def print_row(cells: Sequence[str]) -> None:
    """Print a row of a table in Markdown."""
    print(f"| {' | '.join(cells)} |", flush=True)


def print_heads(heads: Sequence[str]) -> None:
    """Print the heads of a table in Markdown."""
    print_row(heads)
    print_row(["---"] * len(heads))


def cell_text(value: str | float | None) -> str:
    """Return a cell of a printed table: three digits of a number, nothing where there is none."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def write_rows(path: Path, row_type: type, rows: Sequence[Any]) -> None:
    """Write rows, which are dataclasses of one type, as CSV: a column for each field."""
    names = [field.name for field in fields(row_type)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        writer.writerow([getattr(row, name) for name in names])
    write_text(path, text.getvalue())
