"""The final table of a sweep: for a terminal, and as plain lines where there is none."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.summary import MAIN
from harness.report.measures import inches

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

COLOUR_OF = {"found": "bold green", "missed": "red", "undecided": "yellow"}
"""Beside the counts, which say the same without colour."""


def terminal_table(summary: pd.DataFrame, variant: str = MAIN) -> Table:
    """Detections of trials for each hole and number of frames, and the sizes with the most frames.

    ``summary``: of `harness.evaluation.summary.summarise_holes`.
    """
    from rich.table import Table
    from rich.text import Text

    frames, rows = _cells(summary, variant)
    # No box and no wrapping: eleven columns then fit a terminal of 80.
    title = "holes detected of trials, by number of averaged frames (N)"
    table = Table(title=title, box=None, pad_edge=False, collapse_padding=True)
    for head in _heads(frames):
        table.add_column(head, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(text, style=COLOUR_OF.get(status, "")) for text, status in row))
    return table


def terminal_text(summary: pd.DataFrame, variant: str = MAIN) -> str:
    """`terminal_table` as plain lines without colour or boxes, columns aligned."""
    frames, rows = _cells(summary, variant)
    lines = [_heads(frames), *([text for text, _ in row] for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    return "\n".join("  ".join(f"{text:>{width}}" for text, width in zip(line, widths, strict=True)) for line in lines)


def _heads(frames: list[int]) -> list[str]:
    return ["hole", "drill", "mm", *(f"N={n}" for n in frames), "thesis mm", "model mm"]


def _cells(summary: pd.DataFrame, variant: str) -> tuple[list[int], list[list[tuple[str, str]]]]:
    """The numbers of frames, and each row's cells as (text, status of the hole or empty)."""
    rows = summary[summary["variant"] == variant]
    frames = sorted(int(n) for n in rows["frames"].unique())
    out = []
    for hole, part in rows.groupby("hole", sort=False):
        by_frames = {int(row["frames"]): row for _, row in part.iterrows()}
        last = by_frames[max(by_frames)]
        true = float(last["true_diameter_mm"])
        cells = [(str(hole), ""), (inches(true).replace(" in", '"'), ""), (f"{true:.2f}", "")]
        for n in frames:
            row = by_frames.get(n)
            cells.append(("–", "") if row is None else (f"{row['detected']}/{row['n']}", str(row["status"])))
        cells += [(_size(last, "extent"), ""), (_size(last, "model"), "")]
        out.append(cells)
    return frames, out


def _size(row: pd.Series, measure: str) -> str:
    mean, std = float(row[f"{measure}_diameter_mean_mm"]), float(row[f"{measure}_diameter_std_mm"])
    if np.isnan(mean):
        return "–"
    return f"{mean:.2f}" if np.isnan(std) else f"{mean:.2f} ± {std:.2f}"
