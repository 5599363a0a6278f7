"""Declarations of result tables: a new column is one line.

A `Table` has a name, a note on what a row is, and columns. A `Column` has a ``name`` for data
files, whose ending is its unit, and a ``label`` for pages and terminals; either may be empty. Its
``value`` is a dotted path of a row's attributes (a pair of paths for an estimate and its interval)
or a function of the row; without it, the row is a mapping with an entry of the same name. The
``note`` gives the column's meaning; ``text`` formats a value. An estimate with an interval fills
three columns of a file (``speed_m``, ``speed_low_m``, ``speed_high_m``) and one column of a page.

    name = Column("animal", "animal", "species.name", "name of the species")
    speed = Column("speed_m", "speed (m/s)", ("speed", "interval"), "metres in a second")
    SPEEDS = Table("speeds", "one row per animal", (name, speed))
    SPEEDS.frame(animals)        # a DataFrame; write_table(folder, SPEEDS, frame) makes speeds.csv, speeds.parquet
    SPEEDS.grid(animals).html()  # a page's table; .lines() and .rich() for terminals; harness.vocabulary.text.show prints
    SPEEDS.data(animals)         # JSON's types
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

import numpy as np

from harness.vocabulary import text
from harness.vocabulary.files import atomic_path, jsonable
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.text import Cell, Grid, Tone

if TYPE_CHECKING:
    import pandas as pd

# number of rows whose lists are expanded to rows of a file at a time; they take about 5 MB
LISTS_AT_ONCE = 1_000
UNITS = {
    "_per_m2": "1/m²",
    "_m2": "m²",
    "_mm3": "mm³",
    "_mm": "mm",
    "_m": "m",
    "_s": "s",
    "_mb": "MB",
    "_px": "pixels",
}


@dataclass(frozen=True)
class Estimate:
    """A number with its interval, NaN if unknown; shown as ``> most`` beyond ``most``, with ``≤``
    if ``at_most``."""

    value: float
    low: float = np.nan
    high: float = np.nan
    most: float = np.inf
    at_most: bool = False

    def text(self, digits: int = 2) -> str:
        """Return ``3.20 (2.90 to 3.60)``, ``> 15.9``, ``≤ 2.05`` or ``none``."""
        if self.at_most:
            return f"≤\u00a0{self.value:#.3g}".removesuffix(".")
        return text.with_interval(self.value, self.low, self.high, digits, self.most)


def _share(share: float | Estimate) -> str:
    """Return a share as text, such as ``0.12 % (0.05 to 0.2 %)``."""
    estimate = share if isinstance(share, Estimate) else Estimate(share)
    value = f"{100 * estimate.value:.{(2 if estimate.value < 0.995 else 3)}g}"
    low = f"{100 * estimate.low:.{(2 if estimate.low < 0.995 else 3)}g}"
    high = f"{100 * estimate.high:.{(2 if estimate.high < 0.995 else 3)}g}"
    ends = f" ({low} to {high} %)" if np.isfinite(estimate.low) else ""
    return text.UNKNOWN_TEXT if np.isnan(estimate.value) else f"{value} %{ends}"


FORMATS: dict[str, Callable[[Any], str]] = {
    "_mm": lambda size: (
        size.text() if isinstance(size, Estimate) else text.mm(np.nan if size is None else size)
    ),
    "_share": _share,
    "_area": lambda area: text.UNKNOWN_TEXT if area is None or np.isnan(area) else f"{area:.3f}",
    "_p": text.p_value,
    "": lambda value: value.text() if isinstance(value, Estimate) else text.plain(value),
}
"""Default formats of numbers, by the endings of column names."""


@dataclass(frozen=True)
class Column:
    """A column of a result table, as the module's docstring describes it. ``interval``: its values
    are `Estimate`. ``spread``: they are mappings, and each key becomes a column. ``brief``: text
    at a terminal, False to hide it."""

    name: str = ""
    label: str = ""
    value: str | tuple[str, str] | Callable[[Any], Any] | None = None
    note: str = ""
    text: Callable[[Any], str] | None = None
    interval: bool = False
    spread: bool = False
    tone: Callable[[Any], Tone] | None = None
    brief: Callable[[Any], str] | bool = True

    @property
    def unit(self) -> str:
        """The unit that the ending of the name states, or an empty text."""
        return next((unit for ending, unit in UNITS.items() if self.name.endswith(ending)), "")

    @property
    def names(self) -> tuple[str, ...]:
        """The column's names in files; an interval has three."""
        if not (self.interval or isinstance(self.value, tuple)):
            return (self.name,)
        ending = next((ending for ending in UNITS if self.name.endswith(ending)), "")
        stem = self.name.removesuffix(ending)
        return (self.name, f"{stem}_low{ending}", f"{stem}_high{ending}")

    def of(self, row: Any) -> Any:
        """Return the row's value; None if a mapping lacks it or an attribute on its path is None."""
        if self.value is None:
            values = [row.get(name) for name in self.names]
            return values[0] if len(values) == 1 or values[0] is None else Estimate(*values)
        if isinstance(self.value, str):
            return _attribute(row, self.value)
        if isinstance(self.value, tuple):
            value, ends = (_attribute(row, path) for path in self.value)
            return Estimate(np.nan) if value is None else Estimate(value, ends.low, ends.high)
        return self.value(row)

    def cell(self, row: Any, *, terminal: bool = False) -> Cell:
        """Return the row's value as text."""
        value = self.of(row)
        if isinstance(value, Cell):
            return replace(value, text=value.text.replace("\n", " ")) if terminal else value
        how = self.brief if terminal and callable(self.brief) else self.text
        how = how or next(form for ending, form in FORMATS.items() if self.name.endswith(ending))
        return Cell(how(value), self.tone(row) if self.tone else "")


def declared_columns(row_type: type) -> tuple[Column, ...]:
    """Return the columns that the fields of a class of rows declare, in order. A field is annotated
    with its note or its `Column`; a field that is itself a dataclass adds the columns of that
    class."""
    columns: list[Column] = []
    for name, hint in get_type_hints(row_type, include_extras=True).items():
        if isinstance(hint, type) and is_dataclass(hint):
            columns += declared_columns(hint)
            continue
        _, declared = get_args(hint)
        column = Column(note=declared) if isinstance(declared, str) else declared
        columns.append(replace(column, name=name))
    return tuple(columns)


@dataclass(frozen=True)
class Table:
    """A result table. ``note`` says what a row is, ``order`` names the columns that sort rows,
    ``formats`` its files, ``digits`` the precision of CSV, ``title`` the title at a terminal.
    ``always`` writes it even without rows; ``left`` columns hold text on a page; ``lists`` names
    columns whose list elements become rows of the files."""

    name: str
    note: str
    columns: tuple[Column, ...]
    order: tuple[str, ...] = ()
    formats: tuple[str, ...] = ("csv", "parquet")
    title: str = ""
    always: bool = False
    lists: tuple[str, ...] = ()
    left: int = 1
    digits: str = "%.6g"
    kind: str = "limits"

    def column(self, name: str) -> Column:
        """Return a column by its name in files. Raises KeyError."""
        return {column.name: column for column in self.columns}[name]

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
                    record |= {name: _scalar(part) for name, part in value.items()}
                elif len(column.names) > 1:
                    record |= dict(
                        zip(column.names, (value.value, value.low, value.high), strict=True)
                    )
                else:
                    record[column.name] = value.value if isinstance(value, Estimate) else value
            found.append(record)
        return found

    def frame(self, rows: Iterable[Any]) -> pd.DataFrame:
        """Return the rows as a DataFrame; columns with both numbers and text become text."""
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
        """Return the rows as JSON types; numbers that are not finite become None."""
        return [jsonable(record) for record in self.records(rows)]

    def grid(
        self,
        rows: Sequence[Any],
        *,
        terminal: bool = False,
        heads: Mapping[str, str] | None = None,
        only: Collection[str] = (),
    ) -> Grid:
        """Return the labelled columns as text, for a page or in brief for a ``terminal``. ``only``
        lists the labels to show; ``heads`` replaces declared labels, and an empty label hides its
        column."""
        shown = [
            column
            for column in self.columns
            if column.label and not (terminal and column.brief is False)
        ]
        labels = {
            col: (heads or {}).get(col.label, col.label)
            for col in shown
            if not only or col.label in only
        }
        shown = [column for column, label in labels.items() if label]
        cells = [[column.cell(row, terminal=terminal) for column in shown] for row in rows]
        return Grid.of(
            [labels[column] for column in shown], cells, self.left, self.title, self.kind
        )


def write_table(
    folder: Path, table: Table, frame: pd.DataFrame, about: Mapping[str, Any] | None = None
) -> None:
    """Write a table's files: CSV, and Parquet with units and notes in its schema and ``about`` as
    JSON under "tofpod". Without rows, the files of an earlier run are removed. Raises UserError if
    the folder cannot be written."""
    for ending, name in zip(table.formats, table.files, strict=True):
        if frame.empty and not table.always:
            (Path(folder) / name).unlink(missing_ok=True)
            continue
        if ending == "csv":
            with atomic_path(Path(folder) / name) as path:
                frame.to_csv(path, index=False, float_format=table.digits, lineterminator="\n")
            continue
        import pyarrow as pa
        import pyarrow.parquet as pq

        noted = {name: column for column in table.stored for name in column.names}
        at_once = LISTS_AT_ONCE if table.lists and len(frame) else max(len(frame), 1)
        starts = range(0, max(len(frame), 1), at_once)
        parts = (_unfolded(frame.iloc[start : start + at_once], table.lists) for start in starts)
        blocks = (pa.Table.from_pandas(part, preserve_index=False) for part in parts)
        block = next(blocks)
        fields = []
        for field in block.schema:
            column = noted.get(field.name)
            facts = {} if column is None else {"unit": column.unit, "note": column.note}
            fields.append(
                field.with_metadata({key: value for key, value in facts.items() if value})
            )
        metadata = dict(block.schema.metadata or {})
        if about is not None:
            metadata[b"tofpod"] = json.dumps(about, sort_keys=True).encode()
        schema = pa.schema(fields, metadata=metadata)
        with atomic_path(Path(folder) / name) as path, pq.ParquetWriter(path, schema) as writer:
            for stored in chain([block], blocks):
                writer.write_table(stored.cast(schema))


def _unfolded(frame: pd.DataFrame, lists: Sequence[str]) -> pd.DataFrame:
    """Return a row for each element of the rows' ``lists``."""
    if not lists or frame.empty:
        return frame
    rows = np.repeat(np.arange(len(frame)), frame[lists[0]].map(len))
    whole = np.zeros(0, int)  # makes counts 64-bit integers
    elements = {name: np.concatenate([*frame[name].to_numpy(), whole]) for name in lists}
    return frame.drop(columns=list(lists)).iloc[rows].assign(**elements)[list(frame.columns)]


def _attribute(row: Any, path: str) -> Any:
    for name in path.split("."):
        row = None if row is None else getattr(row, name)
    return row


def _scalar(value: Any) -> Any:
    return value if value is None or isinstance(value, str | int | float) else canonical_json(value)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else canonical_json(value)
