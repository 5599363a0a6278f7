"""Final tables of a sweep without a study: holes by number of frames, set-ups side by side, ways of making a map."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from harness.evaluation.summary import MAIN
from harness.report.perspectives import Ways
from harness.report.set_ups import Layout, count_text, found_text
from harness.tables.grid import Cell, Grid, Tone
from harness.tables.text import UNKNOWN_TEXT, inches, mm

if TYPE_CHECKING:
    import pandas as pd

TONES: Mapping[str, Tone] = {"found": "key", "missed": "bad", "undecided": "open"}


def holes_grid(summary: pd.DataFrame, variant: str = MAIN) -> Grid:
    """Return detections of trials for each hole and number of frames, and the sizes with the most frames.

    ``summary``: of `harness.evaluation.summary.summarise_holes`.
    """
    summary = summary[summary["variant"] == variant]
    frames = sorted(int(n) for n in summary["frames"].unique())
    rows = []
    for hole, part in summary.groupby("hole", sort=False):
        by_frames = {int(row["frames"]): row for _, row in part.iterrows()}
        last = by_frames[max(by_frames)]
        true = float(last["true_diameter_mm"])
        cells: list[str | Cell] = [str(hole), inches(true).replace(" in", '"'), f"{true:.2f}"]
        for n in frames:
            row = by_frames.get(n)
            found = row is not None and Cell(f"{row['detected']}/{row['n']}", TONES[str(row["status"])])
            cells.append(found or UNKNOWN_TEXT)
        for measure in ("extent", "model"):
            mean, std = (float(last[f"{measure}_diameter_{name}_mm"]) for name in ("mean", "std"))
            cells.append(f"{mm(mean)} ± {std:.2f}" if mean == mean and std == std else mm(mean))
        rows.append(cells)
    heads = ("hole", "drill", "mm", *(f"N={n}" for n in frames), "extent mm", "model mm")
    return Grid.of(heads, rows, 0, "holes detected of trials, by number of averaged frames (N)")


def set_ups_grid(compared: pd.DataFrame, layout: Layout) -> Grid:
    """Return holes found by several set-ups and the smallest of them, for the least and the greatest number of frames.

    ``compared``: of `harness.evaluation.set_ups.compare_set_ups`.
    """
    table = {(row["variant"], row["frames"]): row for _, row in compared.iterrows()}
    rows = []
    for title, variants in layout.rows.items():
        for place, variant in enumerate(variants):
            cells = [title, *([layout.columns[place]] if layout.columns else [])]
            for n in layout.shown_frames:
                row = table.get((variant, n))
                unknown = (UNKNOWN_TEXT, UNKNOWN_TEXT)
                found = (
                    unknown if row is None else (f"{count_text(row)} {found_text(row)}".strip(), mm(row["limit_mm"]))
                )
                cells += found
            rows.append(cells)
    heads = ["set-up", *([layout.column_name] if layout.columns else [])]
    heads += [f"N={n}{part}" for n in layout.shown_frames for part in ("", " from mm")]
    title = "holes found, and the smallest diameter from which on all are (mm), by number of averaged frames (N)"
    return Grid.of(heads, rows, len(heads), title)


def maps_grid(compared: pd.DataFrame, ways: Ways) -> Grid:
    """Return holes found for each way of registering and merging (down) and number of views (across), with the least
    and the most frames a view. ``compared``: of `harness.evaluation.maps.compare_maps`."""

    def count(row: Mapping[str, Any] | None) -> str:
        if row is None:
            return UNKNOWN_TEXT
        undecided = f"+{len(row['undecided'])}" if row["undecided"] else ""
        return f"{len(row['found'])}{undecided}"

    by_frames = [[row["cells"] for row in ways.table(compared, n, count)] for n in ways.shown_frames]
    rows = [
        (name, *(" / ".join(counts) for counts in zip(*(table[place] for table in by_frames), strict=True)))
        for place, name in enumerate(ways.rows)
    ]
    heads = ["registration, merge", *(f"{n} view{'s' if n > 1 else ''}" for n in ways.views)]
    frames = " / ".join(f"N={n}" for n in ways.shown_frames)
    of_holes = f" of {int(compared['holes'].max())}" if len(compared) else ""
    title = f"holes found{of_holes} with {frames} frames a view (+: undecided)"
    return Grid.of(heads, rows, len(heads), title)
