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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.extras import load_extra
from harness.vocabulary.files import TABLE_BYTES, bounded_bytes, limited_memory

# rows for two parameters and a bound; MIL-HDBK-1823A asks for 60 targets (hit/miss) or 40 (signal)
FEWEST_ROWS = 10
SEPARATORS = (",", ";", "\t")
HITS = dict.fromkeys(("1", "yes", "y", "true", "t", "hit", "h", "found", "detected"), 1.0)
HITS |= dict.fromkeys(
    ("0", "no", "n", "false", "f", "miss", "m", "missed", "not found", "not detected"), 0.0
)
"""Words for a hit and a miss, in upper or lower case."""
# cells that mean "no value", in upper or lower case
NOTHING = ("", "na", "n/a", "nan", "null", "none", "-", "#n/a")
NUMBER = re.compile(r"[+-]?(\d[\d.,'\u2019\u00a0\u202f ]*|[.,]\d+)([eE][+-]?\d+)?")
GROUPED = re.compile(r"[+-]?\d{1,3}([.,])\d{3}")
LEGAL = "a header row with column names, then one row per inspection"
MARKS = ".,"
Rows = list[tuple[int, list[str]]]


@dataclass(frozen=True)
class Inspections:
    """One inspection per row."""

    path: Path
    """The file."""
    size_column: str
    """Name of the column of sizes."""
    response_column: str
    """Names of the columns of responses."""
    size: np.ndarray
    """Sizes (n,) in the file's unit."""
    response: np.ndarray
    """Hits (n,) as 0/1, or signals."""
    target: np.ndarray | None
    """Names (n,) of what was inspected; None if every row is a target of its own."""
    line: np.ndarray
    """Line (n,) in the file, from 1."""
    unflawed: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Responses (m,) at sites without a flaw, whose size is 0 or missing."""
    notes: tuple[str, ...] = ()
    """Sentences on rows that were left out, and on the reading of unclear cells."""

    @property
    def targets(self) -> int:
        """Number of different targets."""
        if self.target is None:
            return len(self.size)
        return len(set(self.target.tolist()))


def read_inspections(
    path: Path,
    size: str,
    responses: Sequence[str],
    target: str | None = None,
    *,
    hits: bool = True,
) -> Inspections:
    """Read the named columns. ``responses``: one column, or one per inspector. ``hits``: whether
    responses are words or 0/1 rather than signals. Raises UserError, with the line, for cells that
    cannot be read."""
    (_, header), *rows = _rows(path, size)
    header = [name.strip() for name in header]
    chosen = (size, *responses, target)
    columns = [_column(path, header, name, chosen) for name in chosen if name]
    for line, row in rows:
        if len(row) != len(header):
            counts = f"{len(row)} fields, and the header has {len(header)}"
            fix = "put text that holds a separator in double quotes"
            raise UserError(f"{path}, line {line}: {counts}", fix=fix)
    lines = np.array([line for line, _ in rows], int)
    texts = [[row[column].strip() for _, row in rows] for column in columns]

    notes: list[str] = []
    sizes = _numbers(path, size, lines, texts[0], notes)
    read_column = _hits if hits else _numbers
    parts = [
        read_column(path, name, lines, text, notes)
        for name, text in zip(responses, texts[1:], strict=False)
    ]
    names = None
    if target:
        names = np.array(texts[-1])
        _require_names(path, target, lines, names)
    elif len(responses) > 1:
        names = lines.astype(str)
    # from here on, one inspection per row: all of the first inspector, then all of the second ...
    response = np.concatenate(parts)
    count = len(responses)
    sizes = np.tile(sizes, count)
    lines = np.tile(lines, count)
    _require_no_negative(path, size, lines, sizes)
    stated = ~np.isnan(response)
    flawed = np.nan_to_num(sizes) != 0
    kept = stated & flawed
    notes += _notes(stated, flawed)
    if kept.sum() < FEWEST_ROWS:
        legal = (
            f"at least {FEWEST_ROWS}; the standard asks for 60 targets (hit/miss) or 40 (signal)"
        )
        raise UserError(f"{path}: {int(kept.sum())} rows are too few for a POD curve", legal=legal)
    read = Inspections(
        path=path,
        size_column=size,
        response_column=", ".join(responses),
        size=sizes[kept],
        response=response[kept],
        target=None if names is None else np.tile(names, count)[kept],
        line=lines[kept],
        unflawed=response[stated & ~flawed],
        notes=tuple(notes),
    )
    if read.target is not None:
        _require_one_size(read, read.target)
    return read


def _require_names(
    path: Path,
    column: str,
    lines: np.ndarray,
    names: np.ndarray,
) -> None:
    """Refuse a row whose target has no name."""
    for line, name in zip(lines, names, strict=True):
        if not name:
            fix = "name the target, or remove the row"
            raise UserError(f"{path}, line {line}: {column} is empty", fix=fix)


def _require_no_negative(
    path: Path,
    column: str,
    lines: np.ndarray,
    sizes: np.ndarray,
) -> None:
    """Refuse a size below 0."""
    below = sizes < 0
    if below.any():
        where = f"{path}, line {lines[below][0]}"
        raise UserError(
            f"{where}: {column} is {sizes[below][0]:g}, but a size cannot be below 0",
            fix="give the sizes, not their logarithms: --log takes these",
        )


def _notes(stated: np.ndarray, flawed: np.ndarray) -> list[str]:
    """Return sentences on inspections that state no result, and on those of unflawed sites."""
    notes = []
    total = len(stated)
    missing = int((~stated).sum())
    if missing:
        notes.append(f"{missing} of {total} inspections state no result and are left out")
    sites = int((stated & ~flawed).sum())
    if sites:
        of_sites = f"{sites} of {total} inspections are of unflawed sites"
        notes.append(f"{of_sites} (no size, or 0): not in the curve")
    return notes


def texts_of(read: Inspections, column: str) -> np.ndarray:
    """Return the text (n,) of another column in the rows that were read. Raises UserError if there
    is none."""
    (_, header), *rows = _rows(read.path, read.size_column)
    header = [name.strip() for name in header]
    index = _column(read.path, header, column, (column,))
    row_of_line = dict(rows)
    texts = [row_of_line[line][index].strip() for line in read.line.tolist()]
    return np.array(texts, dtype=str)


def _require_one_size(read: Inspections, names: np.ndarray) -> None:
    """Refuse a target with two sizes in the file."""
    first_row: dict[str, int] = {}
    for row, name in enumerate(names.tolist()):
        first = first_row.setdefault(name, row)
        if read.size[first] != read.size[row]:
            before = f"size {read.size[first]:g} in line {read.line[first]}"
            after = f"{read.size[row]:g} in line {read.line[row]}"
            fix = "give each target one size (its true size), and different targets different names"
            raise UserError(f"{read.path}: target {name!r} has {before} and {after}", fix=fix)


def require_positive(
    read: Inspections,
    response: bool,
    why: str,
) -> None:
    """Refuse a size (or a response) that has no logarithm; ``why`` names the option that asks for
    it."""
    values = read.response if response else read.size
    column = read.response_column if response else read.size_column
    wrong = values <= 0
    if wrong.any():
        where = f"{read.path}, line {read.line[wrong][0]}"
        raise UserError(
            f"{where}: {column} is {values[wrong][0]:g}, which has no logarithm",
            legal=f"values above 0 with {why}",
            fix=f"leave out {why}, or remove the rows",
        )


def _column(
    path: Path,
    header: list[str],
    name: str,
    chosen: tuple[str | None, ...],
) -> int:
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
        from harness.vocabulary.words import nearest

        meant = nearest(name, header)
        legal = ", ".join(map(repr, header))
        fix = f"did you mean {meant!r}?" if meant else "name one of these columns"
        raise UserError(f"{path}: no column {name!r}", legal=legal, fix=fix)
    return header.index(name)


def _hits(
    path: Path,
    name: str,
    lines: np.ndarray,
    texts: list[str],
    notes: list[str],
) -> np.ndarray:
    """Return (n,): 1 for a hit, 0 for a miss, NaN where nothing is stated."""
    hits = np.full(len(texts), np.nan)
    for row, text in enumerate(texts):
        word = re.sub(r"^([01])[.,]0*$", r"\1", text.casefold())
        if word in HITS:
            hits[row] = HITS[word]
        elif word not in NOTHING:
            legal = (
                "1, yes, true, hit or found; 0, no, false, miss or missed; "
                "NA or an empty cell for none"
            )
            raise UserError(
                f"{path}, line {lines[row]}: {name} is {text!r}, which is neither hit nor miss",
                legal=legal,
                fix="a column of signals is analysed with --ahat and --decision",
            )
    return hits


def _numbers(
    path: Path,
    name: str,
    lines: np.ndarray,
    texts: list[str],
    notes: list[str],
) -> np.ndarray:
    """Return the numbers (n,), NaN where nothing is stated."""
    thousands, unclear = _thousands(path, name, texts)
    numbers = np.full(len(texts), np.nan)
    for row, text in enumerate(texts):
        if text.casefold() in NOTHING:
            continue
        with contextlib.suppress(ValueError):
            numbers[row] = float(_plain(text, thousands))
        if not np.isfinite(numbers[row]):
            raise UserError(
                f"{path}, line {lines[row]}: {name} is {text!r}, not a number",
                legal="a finite number, or NA",
                fix="correct the row, or remove it",
            )
    if unclear:
        value = numbers[texts.index(unclear)]
        reading = f"{name}: {unclear!r} was read as {value:g}"
        notes.append(f"{reading}; write thousands without a mark if it is more")
    return numbers


def _plain(text: str, thousands: set[str]) -> str:
    """Return a number without thousands separators and with a decimal point."""
    plain = text
    if NUMBER.fullmatch(text):
        plain = re.sub(r"['\u2019\u00a0\u202f ]", "", text)
    for mark in MARKS:
        plain = plain.replace(mark, "" if mark in thousands else ".")
    return plain


def _thousands(
    path: Path,
    name: str,
    texts: list[str],
) -> tuple[set[str], str]:
    """Return the thousands separators of a column, and an ambiguous number ("" if there is none).
    The last of two marks in a number is the decimal mark. A mark that occurs twice in a number is
    a thousands separator, and so is a mark that occurs only before three digits if another mark is
    the decimal one."""
    thousands = set[str]()
    decimals = set[str]()
    grouped = dict[str, str]()
    for text in texts:
        marks = [mark for mark in text if mark in MARKS] if NUMBER.fullmatch(text) else []
        if len(marks) > 1:
            last = marks[-1]
            thousands |= {mark for mark in marks if marks.count(mark) > 1 or mark != last}
            decimals |= {last} - thousands
        elif GROUPED.fullmatch(text):
            grouped.setdefault(marks[0], text)
        else:
            decimals |= set(marks)
    if thousands & decimals or len(decimals) > 1:
        marks_used = " and ".join(sorted(thousands | decimals))
        raise UserError(
            f"{path}: {name} has numbers with the decimal marks {marks_used}",
            legal="one decimal mark in a column",
            fix="write thousands without a mark",
        )
    thousands |= {mark for mark in grouped if decimals - {mark}}
    unclear = [text for mark, text in grouped.items() if mark not in thousands | decimals]
    return thousands, unclear[0] if unclear else ""


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
    if content.startswith(b"PK\x03\x04"):
        rows = _sheet_rows(path, content)
    else:
        rows = _text_rows(path, content, column)
    if not rows:
        raise UserError(f"{path}: is empty", legal=LEGAL)
    for index, (_, row) in enumerate(rows):
        if column in map(str.strip, row):
            return rows[index:]
    return rows


def _text_rows(
    path: Path,
    content: bytes,
    column: str,
) -> Rows:
    """Return the rows of a CSV file in UTF-8, UTF-16 or Latin-1, separated as ``sep=`` says or to
    fit the header."""
    utf_16 = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    try:
        text = content.decode("utf-16" if utf_16 else "utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("cp1252", errors="replace")
    if "\0" in text:
        legal = "CSV in UTF-8, UTF-16 or Latin-1, or an Excel file (.xlsx)"
        raise UserError(f"{path}: is not a text file", legal=legal, fix="export it as CSV")
    lines = text.splitlines(keepends=True)
    skipped = 0
    while skipped < len(lines) and not lines[skipped].strip():
        skipped += 1
    stated = None
    if skipped < len(lines):
        stated = re.fullmatch(r"\"?sep=(.)\"?", lines[skipped].strip("\r\n"))
    if stated:
        skipped += 1
    filled = [line for line in lines[skipped:] if line.strip()]
    if not filled:
        return []
    if stated:
        separator = stated.group(1)
    else:
        separator = _separator(next((line for line in filled if column in line), filled[0]))
    reader = csv.reader(lines[skipped:], delimiter=separator)
    rows = []
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                rows.append((reader.line_num + skipped, row))
    except csv.Error as error:
        raise UserError(
            f"{path}, line {reader.line_num + skipped}: {error}", fix="save the file as CSV"
        ) from error
    return rows


def _separator(header: str) -> str:
    """Return the separator that gives the header the most fields."""

    def fields(mark: str) -> int:
        return len(next(csv.reader([header], delimiter=mark)))

    return max(SEPARATORS, key=fields)


def _sheet_rows(path: Path, content: bytes) -> Rows:
    """Return the rows of an Excel file's only sheet with content. Raises UserError if openpyxl is
    missing."""
    openpyxl = load_extra("openpyxl", f"{path}: reading an Excel file")
    try:
        with limited_memory():
            book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True)
            sheets: dict[str, Rows] = {}
            for sheet in book.worksheets:
                sheets[sheet.title] = []
                for number, row in enumerate(sheet.values, 1):
                    texts = [_cell_text(value) for value in row]
                    if any(texts):
                        sheets[sheet.title].append((number, texts))
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
    padded = [(line, row + [""] * (width - len(row))) for line, row in rows]
    used = [k for k in range(width) if any(row[k] for _, row in padded)]
    return [(line, row[used[0] : used[-1] + 1]) for line, row in padded]


def _cell_text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return str(value)
