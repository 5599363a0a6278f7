"""The tables of the scorecard and of a comparison with a capture, each column declared once."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from harness.evaluation.intervals import Interval
from harness.scorecard.bench import Reading
from harness.scorecard.measure import CurvePoint
from harness.scorecard.quantities import QUANTITIES
from harness.vocabulary.config import Config
from harness.vocabulary.files import write_text
from harness.vocabulary.versions import RESULTS_VERSION

CONDITIONS = tuple(dict.fromkeys(name for each in QUANTITIES.values() for name in each.conditions.model_fields))
"""Every condition of any quantity."""


@dataclass(frozen=True)
class ScoreColumn:
    """A column: ``name`` in files and ``label`` on pages and terminals, either may be empty. ``value``: a path of a
    row's attributes, or a function of the row; ``text``: a value on a page; ``spread``: values are mappings, each key a
    column of its own."""

    name: str
    label: str
    value: str | Callable[[Any], Any]
    note: str = ""
    text: Callable[[Any], str] = str
    spread: bool = False

    def of(self, row: Any) -> Any:
        """Return the row's value."""
        return attrgetter(self.value)(row) if isinstance(self.value, str) else self.value(row)


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class ScoreTable:
    """A result table. ``note``: the meaning of a row."""

    name: str
    note: str
    columns: tuple[ScoreColumn, ...]

    def write(self, folder: Path, rows: Sequence[Any]) -> None:
        """Write the table as CSV; empty where a value is unknown, floats with nine digits."""
        records: list[dict[str, str]] = []
        for row in rows:
            values: dict[str, Any] = {}
            for column in self.columns:
                if column.name:
                    values |= column.of(row) if column.spread else {column.name: column.of(row)}
            records.append({name: _cell(value) for name, value in values.items()})
        text = pd.DataFrame(records).to_csv(index=False, lineterminator="\n") if records else ""
        write_text(folder / f"{self.name}.csv", text)

    def heads(self, but: str = "") -> list[str]:
        """Return the labels of the columns but one."""
        return [column.label for column in self.columns if column.label and column.label != but]

    def cells(self, row: Any, but: str = "") -> list[str]:
        """Return a row's texts below `heads`."""
        return [column.text(column.of(row)) for column in self.columns if column.label and column.label != but]

    def lines(self, rows: Sequence[Any], but: str = "") -> list[str]:
        """Return aligned lines without colour, the heads first."""
        listed = [self.heads(but), *(self.cells(row, but) for row in rows)]
        widths = [max(map(len, texts)) for texts in zip(*listed, strict=True)]
        return ["  ".join(map(str.ljust, texts, widths)).rstrip() for texts in listed]

    def show(self, rows: Sequence[Any], but: str = "", style: Callable[[Any, str], str] = lambda row, text: "") -> None:
        """Print the table: wrapped and with the style of each text on a terminal, plain lines elsewhere."""
        if not sys.stdout.isatty():
            print("\n".join(self.lines(rows, but)))
            return
        from rich.box import SIMPLE_HEAD
        from rich.console import Console
        from rich.table import Table as RichTable
        from rich.text import Text

        table = RichTable(*self.heads(but), box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for row in rows:
            table.add_row(*(Text(text, style=style(row, text)) for text in self.cells(row, but)))
        Console().print(table)


@dataclass(frozen=True)
class MeasuredPoint:
    """One point of one curve of one camera."""

    camera: str
    point: CurvePoint
    simulated: Reading


@dataclass(frozen=True)
class Beside:
    """One number of the capture and of the simulation. ``at`` says under which condition, ``unit`` may be empty."""

    where: str
    quantity: str
    at: str
    unit: str
    pixels: int
    measured: Reading
    simulated: Reading

    @property
    def ratio(self) -> float:
        """Simulated by measured; NaN for what may be 0."""
        return self.simulated.value / self.measured.value if self.unit == "mm" and self.measured.value else float("nan")


def number(value: float) -> str:
    """Three significant digits; ``none`` where there is no value."""
    if np.isnan(value):
        return "none"
    if np.isinf(value):
        return "none survives" if value > 0 else "-inf"
    if 0.0995 <= abs(value) < 99.95:
        return f"{value:#.3g}"
    return f"{value:.3g}" if abs(value) >= 99.95 or value == 0 else f"{value:.2g}"


def interval(between: Interval) -> str:
    """``0.87 to 0.90``, or a dash where unknown."""
    if not between.known:
        return "–"
    return f"{number(between.low)} to {number(between.high) if np.isfinite(between.high) else 'inf'}"


def _conditions(conditions: Config) -> dict[str, Any]:
    return {key: conditions.to_data().get(key) for key in CONDITIONS}


def _or_dash(text: str) -> str:
    return text or "–"


def _reading(
    name: str, label: str, low: str, high: str, note: str, head: str = "95 % interval"
) -> tuple[ScoreColumn, ...]:
    """A reading: its value and its interval's ends in three columns of a file, and in two of a page."""
    return (
        ScoreColumn(name, label, f"{name}.value", note, number),
        ScoreColumn(low, "", f"{name}.interval.low", "lower end of its 95 % interval"),
        ScoreColumn(high, "", f"{name}.interval.high", "upper end of its 95 % interval"),
        ScoreColumn("", head, f"{name}.interval", "", interval),
    )


_VERSION = ScoreColumn("results_version", "", lambda row: RESULTS_VERSION, "version of the tables' meaning")

SCORES = ScoreTable(
    "scorecard",
    "one row per published figure",
    (
        ScoreColumn("name", "", "figure.name", "name in the file of figures"),
        ScoreColumn("camera", "camera", "figure.entry.camera", "simulated camera"),
        ScoreColumn("", "figure", lambda score: score.figure.what()),
        ScoreColumn("quantity", "", "figure.entry.quantity", "quantity that is measured"),
        ScoreColumn("unit", "", "figure.quantity.unit", "unit of all values"),
        ScoreColumn("conditions", "", lambda score: _conditions(score.figure.conditions), "conditions", spread=True),
        *_reading("simulated", "simulated", "low", "high", "simulated value"),
        ScoreColumn("published", "published", lambda score: score.figure.entry.published.in_words(), "published value"),
        ScoreColumn(
            "tolerance",
            "tolerance",
            "figure.entry.published.tolerance",
            "how far beyond it the simulated value may lie",
            lambda tolerance: f"±{tolerance:g}" if tolerance else "–",
        ),
        ScoreColumn("", "unit", "figure.quantity.unit", "", _or_dash),
        ScoreColumn(
            "passes_from", "", lambda score: score.figure.entry.published.limits[0], "lowest value that passes"
        ),
        ScoreColumn("passes_to", "", lambda score: score.figure.entry.published.limits[1], "highest value that passes"),
        ScoreColumn(
            "verdict",
            "verdict",
            "verdict",
            "whether the simulated value passes",
        ),
        ScoreColumn(
            "passed_before",
            "",
            "passed_before",
            "whether it passed in the baseline, empty where that does not know it",
        ),
        ScoreColumn(
            "calibration", "", "figure.entry.calibration", "whether the camera's file was, or may be, fitted to it"
        ),
        ScoreColumn("", "use", lambda score: "calibration" if score.figure.entry.calibration else "test"),
        ScoreColumn("tag", "", "figure.entry.tag", "R read, D derived, S secondary, W measured on captures, M a guess"),
        ScoreColumn("source", "", "figure.entry.source", "source of the published value"),
        ScoreColumn("", "source", lambda score: f"[{score.figure.entry.tag}] {score.figure.entry.source}"),
        ScoreColumn("note", "note", "figure.entry.note", "what was assumed"),
        _VERSION,
    ),
)
CURVES = ScoreTable(
    "curves",
    "one row per point of a curve",
    (
        ScoreColumn("curve", "", "point.curve", "picture that it belongs to"),
        ScoreColumn("camera", "", "camera", "simulated camera"),
        ScoreColumn("quantity", "", "point.quantity", "quantity that is measured"),
        ScoreColumn("unit", "", lambda row: QUANTITIES[row.point.quantity].unit, "unit of the value"),
        ScoreColumn("conditions", "", lambda row: _conditions(row.point.conditions), "conditions", spread=True),
        *_reading("simulated", "", "low", "high", "simulated value")[:3],
        _VERSION,
    ),
)
BESIDE = ScoreTable(
    "capture",
    "one row per number of a capture beside its simulation",
    (
        ScoreColumn("where", "where", "where", "plane or edge"),
        ScoreColumn("quantity", "quantity", "quantity", "quantity that is measured"),
        ScoreColumn("at", "at", "at", "condition"),
        ScoreColumn("unit", "", "unit", "unit of the values"),
        ScoreColumn("pixels", "pixels", "pixels", "pixels, or lines across an edge"),
        *_reading("measured", "measured", "measured_low", "measured_high", "measured on the capture", "95 %"),
        *_reading("simulated", "simulated", "simulated_low", "simulated_high", "measured on its simulation", "95 %"),
        ScoreColumn("", "ratio", "ratio", "", lambda ratio: f"{ratio:.2f}" if np.isfinite(ratio) else "–"),
        ScoreColumn("", "unit", "unit", "", _or_dash),
        _VERSION,
    ),
)
