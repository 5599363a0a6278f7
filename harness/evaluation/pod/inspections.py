"""Reads tables of inspections in common forms: CSV in several encodings and number formats, or a
sheet of Excel.

A row is a flaw, or an inspection of a flaw. Several response columns (one for each inspector, the
handbook's own layout) are inspections of the row's flaw. `Inspections.notes` says how unclear
cells were interpreted."""

import contextlib
import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TABLE_BYTES, bounded_bytes, limited_memory

# rows for two parameters and a bound; MIL-HDBK-1823A asks for 60 targets (hit/miss) or 40 (signal)
FEWEST_ROWS = 10
SEPARATORS = (",", ";", "\t")
HITS = dict.fromkeys(("1", "yes", "y", "true", "t", "hit", "h", "found", "detected"), 1.0)
HITS |= dict.fromkeys(
    ("0", "no", "n", "false", "f", "miss", "m", "missed", "not found", "not detected"), 0.0
)
"""Words for a hit and a miss, in upper or lower case."""
NOTHING = (
    "",
    "na",
    "n/a",
    "nan",
    "null",
    "none",
    "-",
    "#n/a",
)  # cells that mean "no value", in upper or lower case
NUMBER = re.compile(r"[+-]?(\d[\d.,'\u2019\u00a0\u202f ]*|[.,]\d+)([eE][+-]?\d+)?")
GROUPED = re.compile(r"[+-]?\d{1,3}([.,])\d{3}")
LEGAL = "a header row with column names, then one row per inspection"
MARKS = ".,"
Rows = list[tuple[int, list[str]]]


@dataclass(frozen=True)
class Inspections:
    """One inspection per row. ``size`` (n,): in the file's unit. ``response`` (n,): hits as 0/1,
    or signals. ``target`` (n,): names of what was inspected; None if every row is a target of its
    own. ``line`` (n,): in the file, from 1. ``unflawed`` (m,): responses at sites without a flaw,
    whose size is 0 or missing. ``notes``: sentences on rows that were left out, and on the reading
    of unclear cells."""

    path: Path
    size_column: str
    response_column: str
    size: np.ndarray
    response: np.ndarray
    target: np.ndarray | None
    line: np.ndarray
    unflawed: np.ndarray = field(default_factory=lambda: np.zeros(0))
    notes: tuple[str, ...] = ()

    @property
    def targets(self) -> int:
        """Number of different targets."""
        return len(self.size) if self.target is None else len(set(self.target.tolist()))


def read_inspections(
    path: Path, size: str, responses: Sequence[str], target: str | None = None, *, hits: bool = True
) -> Inspections:
    """Read the named columns. ``responses``: one column, or one per inspector. ``hits``: whether
    responses are words or 0/1 rather than signals. Raises UserError, with the line, for cells that
    cannot be read."""
    (_, header), *rows = _rows(path, size)
    notes: list[str] = []
    header = [name.strip() for name in header]
    columns = [
        _column(path, header, name, (size, *responses, target))
        for name in (size, *responses, target)
        if name
    ]
    for line, row in rows:
        if len(row) != len(header):
            fix = "put text that holds a separator in double quotes"
            raise UserError(
                f"{path}, line {line}: {len(row)} fields, and the header has {len(header)}", fix=fix
            )
    lines = np.array([line for line, _ in rows], int)
    texts = [[row[column].strip() for _, row in rows] for column in columns]
    sizes = _numbers(path, size, lines, texts[0], notes)
    read_one = _hits if hits else _numbers
    parts = [
        read_one(path, name, lines, text, notes)
        for name, text in zip(responses, texts[1:], strict=False)
    ]
    names = np.array(texts[-1]) if target else (lines.astype(str) if len(responses) > 1 else None)
    for line, name in zip(lines, names if target and names is not None else (), strict=False):
        if not name:
            raise UserError(
                f"{path}, line {line}: {target} is empty", fix="name the target, or remove the row"
            )
    # from here on, one inspection per row: all of the first inspector, then all of the second ...
    response = np.concatenate(parts)
    count = len(responses)
    sizes = np.tile(sizes, count)
    lines = np.tile(lines, count)
    names = None if names is None else np.tile(names, count)
    if missing := int(np.isnan(response).sum()):
        notes.append(f"{missing} of {len(response)} inspections state no result and are left out")
    if (below := sizes < 0).any():
        what = f"{path}, line {lines[below][0]}: {size} is {sizes[below][0]:g}, but a size cannot be below 0"
        raise UserError(what, fix="give the sizes, not their logarithms: --log takes these")
    seen = ~np.isnan(response)
    flawed = np.nan_to_num(sizes) != 0
    if sites := int((seen & ~flawed).sum()):
        notes.append(
            f"{sites} of {len(response)} inspections are of unflawed sites (no size, or 0): not in the curve"
        )
    kept = seen & flawed
    if kept.sum() < FEWEST_ROWS:
        legal = (
            f"at least {FEWEST_ROWS}; the standard asks for 60 targets (hit/miss) or 40 (signal)"
        )
        raise UserError(f"{path}: {int(kept.sum())} rows are too few for a POD curve", legal=legal)
    read = Inspections(
        path, size, ", ".join(responses), sizes[kept], response[kept], None, lines[kept]
    )
    if names is not None:
        read = replace(read, target=names[kept])
        _require_one_size(read)
    return replace(read, unflawed=response[seen & ~flawed], notes=tuple(notes))


def texts_of(read: Inspections, column: str) -> np.ndarray:
    """Return the text (n,) of another column in the rows that were read. Raises UserError if there
    is none."""
    (_, header), *rows = _rows(read.path, read.size_column)
    header = [name.strip() for name in header]
    at = _column(read.path, header, column, (column,))
    row_of = dict(rows)
    return np.array([row_of[line][at].strip() for line in read.line.tolist()], dtype=str)


def _require_one_size(read: Inspections) -> None:
    """Refuse a target with two sizes in the file."""
    assert read.target is not None
    first: dict[str, int] = {}
    for k, name in enumerate(read.target.tolist()):
        j = first.setdefault(name, k)
        if read.size[j] != read.size[k]:
            where = f"size {read.size[j]:g} in line {read.line[j]} and {read.size[k]:g} in line {read.line[k]}"
            fix = "give each target one size (its true size), and different targets different names"
            raise UserError(f"{read.path}: target {name!r} has {where}", fix=fix)


def require_positive(read: Inspections, response: bool, why: str) -> None:
    """Refuse a size (or a response) that has no logarithm; ``why`` names the option that asks for
    it."""
    values, column = (
        (read.response, read.response_column) if response else (read.size, read.size_column)
    )
    wrong = values <= 0
    if wrong.any():
        what = f"{read.path}, line {read.line[wrong][0]}: {column} is {values[wrong][0]:g}, which has no logarithm"
        raise UserError(
            what, legal=f"values above 0 with {why}", fix=f"leave out {why}, or remove the rows"
        )


def _column(path: Path, header: list[str], name: str, chosen: tuple[str | None, ...]) -> int:
    """Return the index of a column. Raises UserError if there is none, or more than one, of this
    name."""
    if chosen.count(name) > 1:
        raise UserError(
            f"column {name!r} is chosen twice", fix="name a different column for each option"
        )
    if header.count(name) > 1:
        raise UserError(
            f"{path}: {header.count(name)} columns are called {name!r}", fix="rename all but one"
        )
    if name not in header:
        from harness.vocabulary.declaration.diagnose import nearest

        near = nearest(name, header)
        legal = ", ".join(map(repr, header))
        fix = f"did you mean {near!r}?" if near else "name one of these columns"
        raise UserError(f"{path}: no column {name!r}", legal=legal, fix=fix)
    return header.index(name)


def _hits(
    path: Path, name: str, lines: np.ndarray, texts: list[str], notes: list[str]
) -> np.ndarray:
    """Return (n,): 1 for a hit, 0 for a miss, NaN where nothing is stated."""
    found = np.full(len(texts), np.nan)
    for k, text in enumerate(texts):
        word = re.sub(r"^([01])[.,]0*$", r"\1", text.casefold())
        if word in HITS:
            found[k] = HITS[word]
        elif word not in NOTHING:
            what = f"{path}, line {lines[k]}: {name} is {text!r}, which is neither hit nor miss"
            legal = "1, yes, true, hit or found; 0, no, false, miss or missed; NA or an empty cell for none"
            raise UserError(
                what, legal=legal, fix="a column of signals is analysed with --ahat and --decision"
            )
    return found


def _numbers(
    path: Path, name: str, lines: np.ndarray, texts: list[str], notes: list[str]
) -> np.ndarray:
    """Return the numbers (n,), NaN where nothing is stated."""
    thousands, note = _thousands(path, name, texts)
    found = np.full(len(texts), np.nan)
    for k, text in enumerate(texts):
        if text.casefold() in NOTHING:
            continue
        plain = re.sub(r"['\u2019\u00a0\u202f ]", "", text) if NUMBER.fullmatch(text) else text
        for mark in MARKS:
            plain = plain.replace(mark, "" if mark in thousands else ".")
        with contextlib.suppress(ValueError):
            found[k] = float(plain)
        if not np.isfinite(found[k]):
            what = f"{path}, line {lines[k]}: {name} is {text!r}, not a number"
            raise UserError(
                what, legal="a finite number, or NA", fix="correct the row, or remove it"
            )
    if note:
        value = found[texts.index(note)]
        notes.append(
            f"{name}: {note!r} was read as {value:g}; write thousands without a mark if it is more"
        )
    return found


def _thousands(path: Path, name: str, texts: list[str]) -> tuple[set[str], str]:
    """Return the thousands separators of a column, and an ambiguous number ("" if there is none).
    The last of two marks in a number is the decimal mark. A mark that occurs twice in a number is
    a thousands separator, and so is a mark that occurs only before three digits if another mark is
    the decimal one."""
    parts = set[str]()
    decimals = set[str]()
    grouped = dict[str, str]()
    for text in texts:
        marks = [mark for mark in text if mark in MARKS] if NUMBER.fullmatch(text) else []
        if len(marks) > 1:
            parts |= {mark for mark in marks if marks.count(mark) > 1 or mark != marks[-1]}
            decimals |= {marks[-1]} - parts
        elif GROUPED.fullmatch(text):
            grouped.setdefault(marks[0], text)
        else:
            decimals |= set(marks)
    if parts & decimals or len(decimals) > 1:
        what = f"{path}: {name} has numbers with the decimal marks {' and '.join(sorted(parts | decimals))}"
        raise UserError(
            what, legal="one decimal mark in a column", fix="write thousands without a mark"
        )
    parts |= {mark for mark in grouped if decimals - {mark}}
    return parts, next((text for mark, text in grouped.items() if mark not in parts | decimals), "")


def _rows(path: Path, column: str) -> Rows:
    """Return (line, fields) of every row that is not blank. The header is the first row with
    ``column``."""
    try:
        content = bounded_bytes(path, TABLE_BYTES)
    except OSError as error:
        reason = (error.strerror or "no reason given").lower()
        raise UserError(
            f"{path}: cannot be read ({reason})", fix="name a CSV or Excel file"
        ) from error
    rows = (
        _sheet_rows(path, content)
        if content.startswith(b"PK\x03\x04")
        else _text_rows(path, content, column)
    )
    if not rows:
        raise UserError(f"{path}: is empty", legal=LEGAL)
    heads = (k for k, (_, row) in enumerate(rows) if column in map(str.strip, row))
    return rows[next(heads, 0) :]


def _text_rows(path: Path, content: bytes, column: str) -> Rows:
    """Return the rows of a CSV file in UTF-8, UTF-16 or Latin-1, separated as ``sep=`` says or to
    fit the header."""
    try:
        text = content.decode(
            "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
        )
    except UnicodeDecodeError:
        text = content.decode("cp1252", errors="replace")
    if "\0" in text:
        legal = "CSV in UTF-8, UTF-16 or Latin-1, or an Excel file (.xlsx)"
        raise UserError(f"{path}: is not a text file", legal=legal, fix="export it as CSV")
    lines = text.splitlines(keepends=True)
    skipped = next((k for k, line in enumerate(lines) if line.strip()), len(lines))
    stated = (
        re.fullmatch(r"\"?sep=(.)\"?", lines[skipped].strip("\r\n"))
        if skipped < len(lines)
        else None
    )
    skipped += stated is not None
    filled = [line for line in lines[skipped:] if line.strip()]
    if not filled:
        return []
    first = next((line for line in filled if column in line), filled[0])
    separator = (
        stated.group(1)
        if stated
        else max(SEPARATORS, key=lambda mark: len(next(csv.reader([first], delimiter=mark))))
    )
    reader = csv.reader(lines[skipped:], delimiter=separator)
    try:
        return [
            (reader.line_num + skipped, row)
            for row in reader
            if any(field.strip() for field in row)
        ]
    except csv.Error as error:
        raise UserError(
            f"{path}, line {reader.line_num + skipped}: {error}", fix="save the file as CSV"
        ) from error


def _sheet_rows(path: Path, content: bytes) -> Rows:
    """Return the rows of an Excel file's only sheet with content. Raises UserError if openpyxl is
    missing."""
    try:
        import openpyxl
    except ImportError as error:
        fix = "pip install openpyxl, or save the sheet as CSV"
        raise UserError(
            f"{path}: reading an Excel file needs the package openpyxl", fix=fix
        ) from error
    try:
        with limited_memory():
            book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True)
            sheets: dict[str, Rows] = {}
            for sheet in book.worksheets:
                cells = (
                    (number, [_cell_text(value) for value in row])
                    for number, row in enumerate(sheet.values, 1)
                )
                sheets[sheet.title] = [(number, row) for number, row in cells if any(row)]
    except Exception as error:
        raise UserError(
            f"{path}: cannot be read as an Excel file ({error})"[:300], fix="save it as CSV"
        ) from error
    filled = {title: rows for title, rows in sheets.items() if rows}
    if len(filled) > 1:
        legal = "one sheet with inspections"
        fix = "save the intended sheet as CSV"
        raise UserError(
            f"{path}: has {len(filled)} sheets with data: {', '.join(filled)}", legal=legal, fix=fix
        )
    rows = next(iter(filled.values()), [])
    # a table may begin in any column, and rows end at their last cell
    width = max((len(row) for _, row in rows), default=0)
    used = [k for k in range(width) if any(k < len(row) and row[k] for _, row in rows)]
    return [
        (line, [row[k] if k < len(row) else "" for k in range(used[0], used[-1] + 1)])
        for line, row in rows
    ]


def _cell_text(value: Any) -> str:
    return (
        ""
        if value is None
        else str(int(value))
        if isinstance(value, float) and value.is_integer()
        else str(value)
    )
