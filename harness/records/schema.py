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
    SPEEDS.frame(animals)  # a DataFrame, which write_table makes into speeds.csv, speeds.parquet
    SPEEDS.grid(animals).html()  # a page's table; .lines() and .rich() are for terminals
    SPEEDS.data(animals)  # JSON's types

A class of rows may declare its columns with its fields (`declared_columns`):

    @dataclass(frozen=True)
    class Run:
        speed_m: Annotated[float, "metres in a second"]

    RUNS = Table("runs", "one row per run", declared_columns(Run))
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
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
    """A number with its interval."""

    value: float
    """The number; NaN if unknown."""
    low: float = np.nan
    """Lower end of the interval; NaN if unknown."""
    high: float = np.nan
    """Upper end of the interval; NaN if unknown."""
    most: float = np.inf
    """Largest number that is known; beyond it, the text is ``> most``."""
    at_most: bool = False
    """True for a bound, which the text marks with ``≤``."""

    def text(self, digits: int = 2) -> str:
        """Return ``3.20 (2.90 to 3.60)``, ``> 15.9``, ``≤ 2.05`` or ``none``."""
        if self.at_most:
            return f"≤\u00a0{self.value:#.3g}".removesuffix(".")
        return text.with_interval(self.value, self.low, self.high, digits, self.most)


def _share(share: float | Estimate) -> str:
    """Return a share as text, such as ``0.12 % (0.05 to 0.2 %)``."""
    estimate = share if isinstance(share, Estimate) else Estimate(share)
    if np.isnan(estimate.value):
        return text.UNKNOWN_TEXT
    value = _percent(estimate.value)
    if not np.isfinite(estimate.low):
        return f"{value} %"
    return f"{value} % ({_percent(estimate.low)} to {_percent(estimate.high)} %)"


def _percent(share: float) -> str:
    """Return a share in per cent with two digits, or three from 99.5 % on."""
    digits = 2 if share < 0.995 else 3
    return f"{100 * share:.{digits}g}"


def _size(size: float | Estimate | None) -> str:
    """Return a size in millimetres as text."""
    if isinstance(size, Estimate):
        return size.text()
    return text.mm(np.nan if size is None else size)


def _area(area: float | None) -> str:
    """Return an area under a curve as text."""
    if area is None or np.isnan(area):
        return text.UNKNOWN_TEXT
    return f"{area:.3f}"


def _plain(value: Any) -> str:
    """Return any value as text."""
    return value.text() if isinstance(value, Estimate) else text.plain(value)


FORMATS: dict[str, Callable[[Any], str]] = {
    "_mm": _size,
    "_share": _share,
    "_area": _area,
    "_p": text.p_value,
    "": _plain,
}
"""Default formats of numbers, by the endings of column names."""


@dataclass(frozen=True)
class Column:
    """A column of a result table."""

    name: str = ""
    """Its name in data files, whose ending is its unit; empty for a column of pages only."""
    label: str = ""
    """Its head on pages and terminals; empty for a column of files only."""
    value: str | tuple[str, str] | Callable[[Any], Any] | None = None
    """Path of a row's attributes, paths of an estimate and its interval, or a function of the row;
    None: the entry of a mapping with the column's name."""
    note: str = ""
    """Its meaning."""
    text: Callable[[Any], str] | None = None
    """Format of a value; None: that of its name's ending (`FORMATS`)."""
    interval: bool = False
    """True if its values are `Estimate`."""
    spread: bool = False
    """True if its values are mappings, each key of which becomes a column."""
    tone: Callable[[Any], Tone] | None = None
    """Colour of a row's cell."""
    brief: Callable[[Any], str] | bool = True
    """Format at a terminal; False hides the column there."""

    @property
    def unit(self) -> str:
        """The unit that the ending of the name states, or an empty text."""
        return UNITS.get(self._ending, "")

    @property
    def names(self) -> tuple[str, ...]:
        """The column's names in files; an interval has three."""
        if not self.interval and not isinstance(self.value, tuple):
            return (self.name,)
        stem = self.name.removesuffix(self._ending)
        return (self.name, f"{stem}_low{self._ending}", f"{stem}_high{self._ending}")

    @property
    def _ending(self) -> str:
        """The ending of the name that states its unit, or an empty text."""
        return next((ending for ending in UNITS if self.name.endswith(ending)), "")

    def of(self, row: Any) -> Any:
        """Return the row's value; None if a mapping lacks it or an attribute on its path is
        None."""
        if self.value is None:
            value = row.get(self.name)
            if value is None or len(self.names) == 1:
                return value
            _, low_name, high_name = self.names
            return Estimate(value, row.get(low_name), row.get(high_name))
        if isinstance(self.value, str):
            return _attribute(row, self.value)
        if isinstance(self.value, tuple):
            value_path, interval_path = self.value
            value = _attribute(row, value_path)
            if value is None:
                return Estimate(np.nan)
            interval = _attribute(row, interval_path)
            return Estimate(value, interval.low, interval.high)
        return self.value(row)

    def cell(self, row: Any, *, terminal: bool = False) -> Cell:
        """Return the row's value as text."""
        value = self.of(row)
        if isinstance(value, Cell):
            return replace(value, text=value.text.replace("\n", " ")) if terminal else value
        as_text = self.text
        if terminal and callable(self.brief):
            as_text = self.brief
        if as_text is None:
            as_text = next(FORMATS[ending] for ending in FORMATS if self.name.endswith(ending))
        return Cell(as_text(value), self.tone(row) if self.tone else "")


def declared_columns(row_type: type) -> tuple[Column, ...]:
    """Return the columns that the fields of a class of rows declare, in order. A field is
    annotated with its note or its `Column`; a field that is itself a dataclass adds the columns of
    that class."""
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
    """A result table."""

    name: str
    """Name of its files, without their endings."""
    note: str
    """Meaning of a row."""
    columns: tuple[Column, ...]
    """Its columns, in order."""
    order: tuple[str, ...] = ()
    """Columns that sort the rows."""
    formats: tuple[str, ...] = ("csv", "parquet")
    """Endings of its files."""
    title: str = ""
    """Title at a terminal."""
    always: bool = False
    """True if its files are written even without rows."""
    lists: tuple[str, ...] = ()
    """Columns of lists whose elements become rows of the files."""
    left: int = 1
    """Number of columns that hold text on a page and are flush left."""
    digits: str = "%.6g"
    """Format of numbers in CSV."""
    kind: str = "limits"
    """Class of the table on a page."""

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
        records = []
        for row in rows:
            record: dict[str, Any] = {}
            for column in self.stored:
                value = column.of(row)
                if column.spread:
                    record.update({name: _scalar(part) for name, part in value.items()})
                elif len(column.names) > 1:
                    ends = (value.value, value.low, value.high)
                    record.update(zip(column.names, ends, strict=True))
                else:
                    record[column.name] = value.value if isinstance(value, Estimate) else value
            records.append(record)
        return records

    def frame(self, rows: Iterable[Any]) -> pd.DataFrame:
        """Return the rows as a DataFrame; columns with both numbers and text become text."""
        import pandas as pd

        records = self.records(rows)
        names = list(dict.fromkeys(name for record in records for name in record))
        if not names:
            names = [name for column in self.stored if not column.spread for name in column.names]
        frame = pd.DataFrame(records, columns=names)
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
        shown: dict[Column, str] = {}
        for column in self.columns:
            is_hidden = terminal and column.brief is False
            label = (heads or {}).get(column.label, column.label)
            if label and not is_hidden and (not only or column.label in only):
                shown[column] = label
        cells = [[column.cell(row, terminal=terminal) for column in shown] for row in rows]
        return Grid.of(list(shown.values()), cells, self.left, self.title, self.kind)


def write_table(
    folder: Path, table: Table, frame: pd.DataFrame, about: Mapping[str, Any] | None = None
) -> None:
    """Write a table's files: CSV, and Parquet with units and notes in its schema and ``about`` as
    JSON under "tofpod". Without rows, the files of an earlier run are removed. Raises UserError if
    the folder cannot be written."""
    for ending, name in zip(table.formats, table.files, strict=True):
        file = Path(folder) / name
        if frame.empty and not table.always:
            file.unlink(missing_ok=True)
        elif ending == "csv":
            with atomic_path(file) as path:
                frame.to_csv(path, index=False, float_format=table.digits, lineterminator="\n")
        else:
            _write_parquet(file, table, frame, about)


def _write_parquet(
    file: Path, table: Table, frame: pd.DataFrame, about: Mapping[str, Any] | None
) -> None:
    """Write a table as Parquet, some rows at a time if their lists become rows."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    count = max(len(frame), 1)
    at_once = LISTS_AT_ONCE if table.lists and len(frame) else count
    schema = None
    with atomic_path(file) as path, contextlib.ExitStack() as stack:
        for start in range(0, count, at_once):
            part = _unfolded(frame.iloc[start : start + at_once], table.lists)
            block = pa.Table.from_pandas(part, preserve_index=False)
            if schema is None:
                schema = _noted_schema(block.schema, table, about)
                writer = stack.enter_context(pq.ParquetWriter(path, schema))
            writer.write_table(block.cast(schema))


def _noted_schema(schema: Any, table: Table, about: Mapping[str, Any] | None) -> Any:
    """Return a schema of Parquet with the columns' units and notes, and ``about``."""
    import pyarrow as pa

    columns = {name: column for column in table.stored for name in column.names}
    fields = []
    for field in schema:
        notes = {}
        if field.name in columns:
            column = columns[field.name]
            notes = {"unit": column.unit, "note": column.note}
        fields.append(field.with_metadata({key: value for key, value in notes.items() if value}))
    metadata = dict(schema.metadata or {})
    if about is not None:
        metadata[b"tofpod"] = json.dumps(about, sort_keys=True).encode()
    return pa.schema(fields, metadata=metadata)


def _unfolded(frame: pd.DataFrame, lists: Sequence[str]) -> pd.DataFrame:
    """Return a row for each element of the rows' ``lists``."""
    if not lists or frame.empty:
        return frame
    rows = np.repeat(np.arange(len(frame)), frame[lists[0]].map(len))
    as_int64 = np.zeros(0, int)  # makes counts 64-bit integers
    elements = {name: np.concatenate([*frame[name].to_numpy(), as_int64]) for name in lists}
    return frame.drop(columns=list(lists)).iloc[rows].assign(**elements)[list(frame.columns)]


def _attribute(row: Any, path: str) -> Any:
    """Return the attribute at a dotted path; None if an attribute on the way is None."""
    value = row
    for name in path.split("."):
        value = None if value is None else getattr(value, name)
    return value


def _scalar(value: Any) -> Any:
    """Return a value of a file's cell: numbers and texts as they are, other data as JSON."""
    if value is None or isinstance(value, str | int | float):
        return value
    return canonical_json(value)


def _text(value: Any) -> str:
    """Return a value of a column of texts."""
    return value if isinstance(value, str) else canonical_json(value)
