"""Rows of the tables on the page of several set-ups, as text."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.intervals import wilson
from harness.evaluation.set_ups import compare_set_ups
from harness.evaluation.summary import hole_list
from harness.report.page_parts import call_row, shade
from harness.tables.text import inches, mm
from harness.tables.trials import ResultTables
from harness.thesis.cameras import claim_c11
from harness.vocabulary.path_names import value_text

if TYPE_CHECKING:
    import pandas as pd

MOST_NAMES = 15
"""Holes up to which a cell lists them by name; beyond it their number and the limit say more."""
MOST_WIDE = 12
"""Sizes up to which a table has room for wide cells."""
LAGS = (1, 2, 3)
ERRORS = ("extent", "model", "extent_place", "model_place")


@dataclass(frozen=True)
class Layout:
    """Which set-up stands where: the last axis across, all others down; of a single axis, all down.

    ``rows``: text of a row -> its set-ups, one a column. ``columns``: text of the last axis' values; ``column_values``
    those values where they are numbers, and ``column_name`` what they are. ``shown_frames``: the least and the most.
    """

    rows: Mapping[str, Sequence[str]]
    columns: tuple[str, ...]
    column_name: str
    column_values: tuple[float, ...]
    shown_frames: tuple[int, ...]

    @property
    def variants(self) -> list[str]:
        """All set-ups, row by row."""
        return [name for names in self.rows.values() for name in names]

    @property
    def middle_column(self) -> int:
        """The column of the pictures: the middle one, the lower of two."""
        return max(0, (len(self.columns) - 1) // 2)

    @staticmethod
    def of(tables: ResultTables, compared: pd.DataFrame) -> Layout:
        """The layout of an experiment's set-ups."""
        set_ups = tables.variants[~tables.variants["is_variation"].astype(bool)]
        paths = [str(path) for path in tables.axes["path"]]
        units = dict(zip(paths, tables.axes["unit"], strict=True))
        names = dict(zip(paths, tables.axes["name"], strict=True))
        frames = sorted(int(n) for n in compared["frames"].unique()) if len(compared) else []
        shown = tuple(dict.fromkeys([*frames[:1], *frames[-1:]]))
        values = list(dict.fromkeys(set_ups[paths[-1]])) if len(paths) > 1 else []
        if not values or len(set_ups) % len(values):
            return Layout({str(name): [str(name)] for name in set_ups["variant"]}, (), "", (), shown)
        rows: dict[str, list[str]] = {}
        for _, row in set_ups.iterrows():
            title = ", ".join(value_text(path, row[path]) for path in paths[:-1])
            rows.setdefault(title, []).append(str(row["variant"]))
        last = paths[-1]
        numbers = tuple(float(v) for v in values) if all(isinstance(v, int | float) for v in values) else ()
        unit = f" ({units[last]})" if units[last] else ""
        return Layout(rows, tuple(value_text(last, v) for v in values), names[last] + unit, numbers, shown)


def count_text(row: pd.Series) -> str:
    """``9 of 11``."""
    return f"{len(row['found'])} of {row['holes']}"


def found_text(row: pd.Series) -> str:
    """The names of the holes found, with those undecided; empty where there are too many to read."""
    if row["holes"] > MOST_NAMES:
        return f"{len(row['undecided'])} undecided" if row["undecided"] else ""
    undecided = f"; undecided {hole_list(row['undecided'])}" if row["undecided"] else ""
    return hole_list(row["found"]) + undecided


def limit_text(row: pd.Series) -> str:
    """The smallest diameter found, with all larger ones."""
    return f"{row['limit_mm']:.2f} mm" if np.isfinite(row["limit_mm"]) else "none found"


def half_text(row: pd.Series) -> str:
    """The 50 % size with its interval; a bound where it lies off the ladder."""
    if not np.isfinite(row["half_mm"]):
        return "above the largest"
    high = f"{row['half_high_mm']:.2f}" if np.isfinite(row["half_high_mm"]) else "∞"
    return f"{row['half_mm']:.2f} ({row['half_low_mm']:.2f} to {high})"


def matrix_rows(compared: pd.DataFrame, layout: Layout) -> list[dict[str, Any]]:
    """A row of cells for each row of the layout; each cell has what was found with each shown number of frames."""
    table = {(row["variant"], row["frames"]): row for _, row in compared.iterrows()}
    return [
        {"name": name, "cells": [[_cell(table.get((v, n)), n) for n in layout.shown_frames] for v in variants]}
        for name, variants in layout.rows.items()
    ]


def _cell(row: pd.Series | None, frames: int) -> dict[str, str]:
    head = "1 frame" if frames == 1 else f"{frames} frames"
    if row is None:
        return {"frames": head, "count": "–", "found": "not finished", "limit": "–", "half": "–", "style": ""}
    return {
        "frames": head,
        "count": count_text(row),
        "found": found_text(row),
        "limit": limit_text(row),
        "half": half_text(row),
        "style": shade(len(row["found"]) / row["holes"]),
    }


def size_table(summary: pd.DataFrame, layout: Layout, frames: int) -> dict[str, Any]:
    """Detections of trials by set-up and true diameter, holes of one size together."""
    rows = summary[(summary["frames"] == frames) & summary["variant"].isin(layout.variants)]
    sizes = sorted(rows["true_diameter_mm"].unique())
    heads = []
    for size in sizes:
        names = list(dict.fromkeys(rows["hole"][rows["true_diameter_mm"] == size]))
        holes = hole_list(names) if len(names) == 1 else f"×{len(names)}"
        heads.append({"holes": holes, "mm": f"{size:.2f}", "drill": inches(float(size))})
    counted = rows.groupby(["variant", "true_diameter_mm"])[["detected", "n"]].sum()
    lines = [head | {"cells": [_rate(counted, variant, size) for size in sizes]} for variant, head in _heads(layout)]
    dense = len(sizes) > MOST_WIDE
    return {"frames": frames, "heads": heads, "rows": lines, "by_column": bool(layout.columns), "dense": dense}


def _rate(counted: pd.DataFrame, variant: str, size: float) -> dict[str, str]:
    if (variant, size) not in counted.index:
        return {"count": "–", "style": "", "title": "not finished"}
    row = counted.loc[[(variant, size)]]
    detected, n = int(row["detected"].iloc[0]), int(row["n"].iloc[0])
    low, high = (float(end) for end in wilson(detected, n))
    return {
        "count": f"{detected}/{n}",
        "style": shade(detected / n),
        "title": f"rate {detected / n:.2f}, 95 % Wilson interval {low:.2f} to {high:.2f}",
    }


def accuracy_rows(compared: pd.DataFrame, layout: Layout) -> list[dict[str, Any]]:
    """Errors of size and position of the found holes: a row for each set-up, a list over the shown numbers of frames
    in each cell."""
    cells = {"count": count_text} | {name: partial(_error, name=name) for name in ERRORS}
    return _rows(compared, layout, cells)


def board_rows(compared: pd.DataFrame, layout: Layout) -> list[dict[str, Any]]:
    """What the camera gives each set-up, in the same form: pitch, valid pixels, noise and its grain."""
    cells: dict[str, Callable[[pd.Series], str]] = {
        "pitch": lambda row: f"{mm(row['pitch_u_mm'])} × {mm(row['pitch_v_mm'])}",
        "valid": lambda row: f"{100 * row['valid_share']:.1f}" if np.isfinite(row["valid_share"]) else "–",
        "single": lambda row: mm(row["single_frame_mm"]),
        "temporal": lambda row: mm(row["temporal_mm"]),
        "offset": lambda row: _signed(row["offset_mm"]),
        "pattern": lambda row: mm(row["pattern_mm"]),
        "surface": lambda row: mm(row["surface_mm"]),
        "threshold": lambda row: f"{mm(row['threshold_mm'])}; {row['threshold']:.2f}",
        "along_u": partial(_grain, way="u"),
        "along_v": partial(_grain, way="v"),
    }
    return _rows(compared, layout, cells)


def call_rows(calls: pd.DataFrame, layout: Layout) -> list[dict[str, Any]]:
    """False calls on the damaged board: a row for each set-up, with the shown numbers of frames.

    ``calls``: of `harness.evaluation.summary.false_calls`.
    """
    calls = calls[(calls["role"] == "damaged") & calls["frames"].isin(layout.shown_frames)]
    return [
        head | {"calls": [call_row(row) for _, row in calls[calls["variant"] == variant].iterrows()]}
        for variant, head in _heads(layout)
    ]


def _rows(
    compared: pd.DataFrame, layout: Layout, cells: Mapping[str, Callable[[pd.Series], str]]
) -> list[dict[str, Any]]:
    table = {(row["variant"], row["frames"]): row for _, row in compared.iterrows()}
    rows = []
    for variant, head in _heads(layout):
        found = [table.get((variant, frames)) for frames in layout.shown_frames]
        texts = {name: [text(row) if row is not None else "–" for row in found] for name, text in cells.items()}
        rows.append(head | texts)
    return rows


def _heads(layout: Layout) -> Iterator[tuple[str, dict[str, Any]]]:
    """Each set-up with what stands before its row: the name (once), the column, whether a new name begins."""
    for title, variants in layout.rows.items():
        for place, variant in enumerate(variants):
            first = place == 0 or not layout.columns
            column = layout.columns[place] if layout.columns else ""
            yield variant, {"name": title if first else "", "column": column, "first": first}


def variation_rows(tables: ResultTables, summary: pd.DataFrame, layout: Layout) -> list[dict[str, Any]]:
    """The sensitivity study: each variation beside the set-up that it changes, and C11 with it in that one's place."""
    study = tables.variants[tables.variants["is_variation"].astype(bool)]
    names = [str(name) for name in study["variant"]]
    if not names:
        return []
    axes = [str(path) for path in tables.axes["path"]]
    compared = compare_set_ups(tables, summary, [*layout.variants, *names])
    table = {(row["variant"], row["frames"]): row for _, row in compared.iterrows()}
    usual = _c11(summary, axes, layout.variants)
    rows = []
    for _, variation in study.iterrows():
        name, reference = str(variation["variant"]), str(variation["reference"])
        lines = []
        for frames in layout.shown_frames:
            row, other = table.get((name, frames)), table.get((reference, frames))
            if row is not None:
                lines.append(_compared_line(row, other))
        swapped = [name if one == reference else one for one in layout.variants]
        rows.append(
            {
                "name": name,
                "reason": variation["reason"],
                "settings": variation["settings"],
                "reference": reference or "none of the set-ups",
                "lines": lines,
                "c11": _c11(summary, axes, swapped) if reference else "",
                "c11_changed": bool(reference) and _c11(summary, axes, swapped) != usual,
            }
        )
    return rows


def _compared_line(row: pd.Series, other: pd.Series | None) -> dict[str, Any]:
    return {
        "frames": row["frames"],
        "count": count_text(row),
        "found": found_text(row),
        "threshold": mm(row["threshold_mm"]),
        "changed": other is not None and (row["found"], row["undecided"]) != (other["found"], other["undecided"]),
        "usual": "" if other is None else count_text(other),
        "usual_found": "" if other is None else found_text(other),
        "usual_threshold": "" if other is None else mm(other["threshold_mm"]),
    }


def _c11(summary: pd.DataFrame, axes: Sequence[str], variants: Sequence[str]) -> str:
    verdict = claim_c11(summary[summary["variant"].isin(variants)], axes)
    return verdict.verdict if verdict else ""


def _error(row: pd.Series, *, name: str) -> str:
    n = int(row[f"{name}_n"])
    if not n:
        return "–"
    std = f" ± {row[f'{name}_std_mm']:.2f}" if np.isfinite(row[f"{name}_std_mm"]) else ""
    return f"{_signed(row[f'{name}_bias_mm'])}{std} ({n})"


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "−") if np.isfinite(value) else "–"


def _grain(row: pd.Series, *, way: str) -> str:
    values = [row[f"correlation_{way}{lag}"] for lag in LAGS]
    # + 0.0 turns -0.0 into 0.0
    texts = (f"{round(value, 2) + 0.0:.2f}" if np.isfinite(value) else "–" for value in values)
    return ", ".join(text.replace("-", "−") for text in texts)
