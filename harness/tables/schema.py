"""Declarations of result tables: a new column is one line.

A `Table` is a name, what a row is, and its columns. A `Column` says how it is called in data files (``name``, whose
ending is its unit) and on pages and terminals (``label``); either may be empty. Its ``value`` is a dotted path of a
row's attributes (a pair of paths for an estimate and its interval), or a function of the row; without it, the entry of
the same name in a mapping. Its ``note`` says what it means, its ``text`` how a value reads. An estimate with an
interval fills three columns of a file (``speed_m``, ``speed_low_m``, ``speed_high_m``) and one of a page.

    SPEEDS = Table(
        "speeds",
        "one row per animal",
        (
            Column("animal", "animal", "species.name", "name of the species"),
            Column("speed_m", "speed (m/s)", ("speed", "interval"), "metres in a second"),
        ),
    )
    SPEEDS.frame(animals)        # a DataFrame; write_table(folder, SPEEDS, frame) makes speeds.csv, speeds.parquet
    SPEEDS.grid(animals).html()  # a page's table; .lines() and .rich() for terminals; harness.tables.grid.show prints
    SPEEDS.data(animals)         # JSON's types

Declared are: tables of trials (`harness.tables.trials`), of limits (`harness.tables.limits`) and of a study's other
results (`harness.tables.study`); `harness.tables.outputs` lists every file that a program leaves in `results/`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.tables import text
from harness.tables.grid import Cell, Grid, Tone
from harness.vocabulary.files import atomic_path, write_text
from harness.vocabulary.seeds import canonical_json

if TYPE_CHECKING:
    import pandas as pd

UNITS = {
    "_per_m2": "1/m²",
    "_m2": "m²",
    "_mm": "mm",
    "_m": "m",
    "_s": "s",
    "_mb": "MB",
    "_px": "pixels",
    "_bytes": "bytes",
}
"""Endings of a column's name that name its unit, longer ones first."""


@dataclass(frozen=True)
class Estimate:
    """A number with the ends of its interval, NaN where unknown. It reads as ``> most`` beyond ``most``, and as an
    upper limit where it is only known to be ``at_most`` the value."""

    value: float
    low: float = np.nan
    high: float = np.nan
    most: float = np.inf
    at_most: bool = False

    def text(self, digits: int = 2) -> str:
        """Return ``3.20 (2.90 to 3.60)``, ``> 15.9``, ``≤ 2.05`` or ``none``."""
        if self.at_most:
            return f"≤\u00a0{text.size(self.value)}"
        return text.with_interval(self.value, self.low, self.high, digits, self.most)


def _share(share: float | Estimate) -> str:
    """``0.12 % (0.05 to 0.2 %)``."""
    one = share if isinstance(share, Estimate) else Estimate(share)
    ends = f" ({100 * one.low:.2g} to {100 * one.high:.2g} %)" if np.isfinite(one.low) else ""
    return text.UNKNOWN_TEXT if np.isnan(one.value) else f"{100 * one.value:.2g} %{ends}"


def _area(area: Estimate) -> str:
    return text.UNKNOWN_TEXT if np.isnan(area.value) else area.text(3)


def _size(size: float | Estimate) -> str:
    return size.text() if isinstance(size, Estimate) else text.mm(size)


FORMATS: dict[str, Callable[[Any], str]] = {"_mm": _size, "_share": _share, "_area": _area, "_p": text.p_value}
"""Default texts of numbers by the endings of columns' names."""
Value = str | tuple[str, str] | Callable[[Any], Any] | None


@dataclass(frozen=True)
class Column:
    """A column of a result table; see the module's first lines. ``interval``: its values are `Estimate` (understood of
    a pair of paths); ``spread``: they are mappings, each key a column of its own. ``tone``: how a row's cell is meant;
    ``brief``: how a terminal shows it, False where it does not."""

    name: str
    label: str = ""
    value: Value = None
    note: str = ""
    text: Callable[[Any], str] | None = None
    interval: bool = False
    spread: bool = False
    tone: Callable[[Any], Tone] | None = None
    brief: Callable[[Any], str] | bool = True

    @property
    def unit(self) -> str:
        """The unit that the name's ending says, or empty."""
        return next((unit for ending, unit in UNITS.items() if self.name.endswith(ending)), "")

    @property
    def names(self) -> tuple[str, ...]:
        """The column's names in files: of an interval three."""
        if not (self.interval or isinstance(self.value, tuple)):
            return (self.name,)
        ending = next((ending for ending in UNITS if self.name.endswith(ending)), "")
        stem = self.name.removesuffix(ending)
        return (self.name, f"{stem}_low{ending}", f"{stem}_high{ending}")

    def of(self, row: Any) -> Any:
        """Return the row's value; None where an attribute on its path is None."""
        if self.value is None:
            return row[self.name]
        if isinstance(self.value, str):
            return _attribute(row, self.value)
        if isinstance(self.value, tuple):
            value, ends = (_attribute(row, path) for path in self.value)
            return Estimate(np.nan) if value is None else Estimate(value, ends.low, ends.high)
        return self.value(row)

    def cell(self, row: Any, *, terminal: bool = False) -> Cell:
        """Return the row's value as text."""
        value = self.of(row)
        how = self.brief if terminal and not isinstance(self.brief, bool) else self.text
        how = how or next((one for ending, one in FORMATS.items() if self.name.endswith(ending)), text.plain)
        shown = value.text() if how is text.plain and isinstance(value, Estimate) else how(value)
        return Cell(shown, self.tone(row) if self.tone else "")


@dataclass(frozen=True)
class Table:
    """A result table. ``note``: what a row is; ``order``: the columns that its rows are sorted by; ``formats``: the
    files that it is written as; ``title``: what a terminal writes above it; ``always``: it is written without rows
    too."""

    name: str
    note: str
    columns: tuple[Column, ...]
    order: tuple[str, ...] = ()
    formats: tuple[str, ...] = ("csv", "parquet")
    title: str = ""
    always: bool = False

    @property
    def stored(self) -> tuple[Column, ...]:
        """Columns of data files."""
        return tuple(column for column in self.columns if column.name)

    @property
    def files(self) -> tuple[str, ...]:
        """The names of its files."""
        return tuple(f"{self.name}.{ending}" for ending in self.formats)

    def records(self, rows: Iterable[Any]) -> list[dict[str, Any]]:
        """Return the rows as mappings from the columns' names in files to their values."""
        found = []
        for row in rows:
            record: dict[str, Any] = {}
            for column in self.stored:
                value = column.of(row)
                if column.spread:
                    record |= {name: _scalar(one) for name, one in value.items()}
                elif len(column.names) > 1:
                    record |= dict(zip(column.names, (value.value, value.low, value.high), strict=True))
                else:
                    record[column.name] = value.value if isinstance(value, Estimate) else value
            found.append(record)
        return found

    def frame(self, rows: Iterable[Any]) -> pd.DataFrame:
        """Return the rows as a DataFrame; columns that hold numbers and text are text."""
        import pandas as pd

        records = self.records(rows)
        names = dict.fromkeys(name for record in records for name in record)
        empty = [name for column in self.stored if not column.spread for name in column.names]
        frame = pd.DataFrame(records, columns=list(names) or empty)
        for name in frame.columns[frame.dtypes.map(str) == "object"]:
            kinds = {type(value) for value in frame[name][frame[name].notna()]}
            if kinds and kinds <= {bool, np.bool_}:
                frame[name] = frame[name].astype("boolean")
            elif kinds <= {int, float, np.int64, np.float64}:
                frame[name] = frame[name].astype(float)
            else:
                frame[name] = frame[name].map(_text, na_action="ignore")
        return frame

    def data(self, rows: Iterable[Any]) -> list[dict[str, Any]]:
        """Return the rows as JSON's types; what is no finite number is None."""
        return [{name: _json(value) for name, value in record.items()} for record in self.records(rows)]

    def grid(self, rows: Sequence[Any], *, terminal: bool = False, heads: Mapping[str, str] | None = None) -> Grid:
        """Return the labelled columns as text, for a page or in brief for a ``terminal``. ``heads``: other labels in
        place of those declared; empty for a column to be left out."""
        shown = [column for column in self.columns if column.label and not (terminal and column.brief is False)]
        labels = {column: (heads or {}).get(column.label, column.label) for column in shown}
        shown = [column for column in shown if labels[column]]
        cells = [[column.cell(row, terminal=terminal) for column in shown] for row in rows]
        return Grid.of([labels[column] for column in shown], cells, title=self.title)


def write_table(folder: Path, table: Table, frame: pd.DataFrame, about: Mapping[str, Any] | None = None) -> None:
    """Write a table's files: CSV with six digits; Parquet with all, the units and notes in its schema and ``about`` as
    JSON under the key "tofpod". A table without rows is not written, and files of an earlier run are removed. Raises
    UserError where the folder cannot be written."""
    for ending, name in zip(table.formats, table.files, strict=True):
        if frame.empty and not table.always:
            (Path(folder) / name).unlink(missing_ok=True)
            continue
        if ending == "csv":
            write_text(Path(folder) / name, frame.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
            continue
        import pyarrow as pa
        import pyarrow.parquet as pq

        noted = {name: column for column in table.stored for name in column.names}
        stored = pa.Table.from_pandas(frame, preserve_index=False)
        fields = []
        for one in stored.schema:
            column = noted.get(one.name)
            said = {} if column is None else {"unit": column.unit, "note": column.note}
            fields.append(one.with_metadata({key: value for key, value in said.items() if value}))
        metadata = dict(stored.schema.metadata or {})
        if about is not None:
            metadata[b"tofpod"] = json.dumps(about, sort_keys=True).encode()
        with atomic_path(Path(folder) / name) as path:
            pq.write_table(stored.cast(pa.schema(fields, metadata=metadata)), path)


def _attribute(row: Any, path: str) -> Any:
    for name in path.split("."):
        row = None if row is None else getattr(row, name)
    return row


def _scalar(value: Any) -> Any:
    return value if value is None or isinstance(value, str | int | float) else canonical_json(value)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else canonical_json(value)


def _json(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
