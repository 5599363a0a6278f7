"""The final table of a sweep: for a terminal, and as plain lines where there is none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.summary import MAIN
from harness.report.measures import inches
from harness.report.perspectives import Ways
from harness.report.set_ups import Layout, count_text, found_text
from harness.tables.grid import aligned

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
    return "\n".join(aligned([_heads(frames), *([text for text, _ in row] for row in rows)], left=0))


def set_ups_table(compared: pd.DataFrame, layout: Layout) -> Table:
    """Of several set-ups: holes found and the smallest of them, for the least and the greatest number of frames.

    ``compared``: of `harness.evaluation.set_ups.compare_set_ups`.
    """
    from rich.table import Table

    lines = _set_up_lines(compared, layout)
    title = "holes found, and the smallest diameter from which on all are (mm), by number of averaged frames (N)"
    table = Table(title=title, box=None, pad_edge=False, collapse_padding=True)
    for head in lines[0]:
        table.add_column(head, no_wrap=True)
    for line in lines[1:]:
        table.add_row(*line)
    return table


def set_ups_text(compared: pd.DataFrame, layout: Layout) -> str:
    """`set_ups_table` as plain lines."""
    lines = _set_up_lines(compared, layout)
    return "\n".join(aligned(lines, left=len(lines[0])))


def maps_table(compared: pd.DataFrame, ways: Ways) -> Table:
    """Of an experiment with several views: holes found for each way of registering and merging (down) and number of
    views (across), with the least and the most frames a view.

    ``compared``: of `harness.evaluation.maps.compare_maps`.
    """
    from rich.table import Table

    lines = _map_lines(compared, ways)
    frames = " / ".join(f"N={n}" for n in ways.shown_frames)
    title = f"holes found{_of_holes(compared)} with {frames} frames a view (+: undecided)"
    table = Table(title=title, box=None, pad_edge=False, collapse_padding=True)
    for head in lines[0]:
        table.add_column(head, no_wrap=True)
    for line in lines[1:]:
        table.add_row(*line)
    return table


def maps_text(compared: pd.DataFrame, ways: Ways) -> str:
    """`maps_table` as plain lines."""
    lines = _map_lines(compared, ways)
    return "\n".join(aligned(lines, left=len(lines[0])))


def _map_lines(compared: pd.DataFrame, ways: Ways) -> list[list[str]]:
    cells: list[list[list[str]]] = [
        [row["cells"] for row in ways.table(compared, n, _map_count)] for n in ways.shown_frames
    ]
    heads = ["registration, merge", *(f"{n} view{'s' if n > 1 else ''}" for n in ways.views)]
    return [heads] + [
        [name, *(" / ".join(counts) for counts in zip(*(table[place] for table in cells), strict=True))]
        for place, name in enumerate(ways.rows)
    ]


def _map_count(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "–"
    open_ = len(row["undecided"])
    return f"{len(row['found'])}{f'+{open_}' if open_ else ''}"


def _of_holes(compared: pd.DataFrame) -> str:
    return f" of {int(compared['holes'].max())}" if len(compared) else ""


def _set_up_lines(compared: pd.DataFrame, layout: Layout) -> list[list[str]]:
    table = {(row["variant"], row["frames"]): row for _, row in compared.iterrows()}
    frames = layout.shown_frames
    heads = ["set-up", *([layout.column_name] if layout.columns else [])]
    lines = [[*heads, *(f"N={n}{part}" for n in frames for part in ("", " from mm"))]]
    for title, variants in layout.rows.items():
        for place, variant in enumerate(variants):
            line = [title, *([layout.columns[place]] if layout.columns else [])]
            for n in frames:
                row = table.get((variant, n))
                line += ["–", "–"] if row is None else [f"{count_text(row)} {found_text(row)}".strip(), _limit(row)]
            lines.append(line)
    return lines


def _limit(row: pd.Series) -> str:
    return f"{row['limit_mm']:.2f}" if np.isfinite(row["limit_mm"]) else "–"


def _heads(frames: list[int]) -> list[str]:
    return ["hole", "drill", "mm", *(f"N={n}" for n in frames), "extent mm", "model mm"]


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
