"""Anybody's inspection results from a text file: one row an inspection, columns chosen by name."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.limits import TABLE_BYTES, bounded_bytes

FEWEST_ROWS = 10
"""Too few below this for two parameters and a bound; MIL-HDBK-1823A asks for 60 targets (hit/miss) or 40 (signal)."""
SEPARATORS = (",", ";", "\t")


@dataclass(frozen=True)
class Inspections:
    """One inspection a row: ``size`` (n,) in the file's unit, ``response`` (n,) hits as 0/1 or signals, ``target`` (n,)
    the name of what was inspected, None where every row is a target of its own; ``line`` (n,) of the file, from 1."""

    path: Path
    size_column: str
    response_column: str
    size: np.ndarray
    response: np.ndarray
    target: np.ndarray | None
    line: np.ndarray

    @property
    def targets(self) -> int:
        """Number of different targets."""
        return len(self.size) if self.target is None else len(set(self.target.tolist()))


def read_inspections(path: Path, size: str, response: str, target: str | None = None) -> Inspections:
    """Read the named columns of a file with a header row; UTF-8 with or without a byte order mark; comma, semicolon or
    tab between columns (with the latter two a comma within a number is its decimal mark).

    Raises UserError: no such file, one larger than `limits.TABLE_BYTES`, not UTF-8, a column that is missing, named
    twice or chosen twice, a row of another length, what is no finite number (with its line), fewer than `FEWEST_ROWS`
    rows, a target with two sizes.
    """
    header, rows, separator = _table(path)
    chosen = [name for name in (size, response, target) if name is not None]
    for name in chosen:
        if chosen.count(name) > 1:
            raise UserError(f"column {name!r} is chosen twice", fix="name a different column for each option")
    places = [_column(path, header, name) for name in chosen]
    for line, row in rows:
        if len(row) != len(header):
            raise UserError(
                f"{path}, line {line}: {len(row)} fields, and the header has {len(header)}",
                fix="put text that holds a separator in double quotes",
            )
    if len(rows) < FEWEST_ROWS:
        raise UserError(
            f"{path}: {len(rows)} rows are too few for a POD curve",
            legal=f"at least {FEWEST_ROWS}; 60 targets (hit/miss) or 40 (signal) are what the standard asks for",
        )
    sizes, responses = (
        np.array([_number(path, line, header[place], row[place], separator) for line, row in rows])
        for place in places[:2]
    )
    lines, names = np.array([line for line, _ in rows]), None
    if target is not None:
        texts = [row[places[2]].strip() for _, row in rows]
        seen: dict[str, int] = {}
        for k, name in enumerate(texts):
            if not name:
                fix = "name the target, or take the row out"
                raise UserError(f"{path}, line {lines[k]}: {target} is empty", fix=fix)
            first = seen.setdefault(name, k)
            if sizes[first] != sizes[k]:
                raise UserError(
                    f"{path}: target {name!r} has size {sizes[first]:g} in line {lines[first]} and "
                    f"{sizes[k]:g} in line {lines[k]}",
                    fix="give every target one size (the true one), or different targets different names",
                )
        names = np.array(texts)
    return Inspections(path, size, response, sizes, responses, names, lines)


def require_hits(read: Inspections) -> None:
    """Raises UserError where a response is neither 0 nor 1, or all are the same."""
    wrong = ~np.isin(read.response, (0.0, 1.0))
    if wrong.any():
        first = int(np.argmax(wrong))
        raise UserError(
            f"{read.path}, line {read.line[first]}: {read.response_column} is {read.response[first]:g}, "
            f"which is neither hit nor miss ({int(wrong.sum())} such rows)",
            legal="1 for a hit, 0 for a miss",
            fix="a column of signals is analysed with --ahat and --decision",
        )
    if len(set(read.response.tolist())) == 1:
        kind = "hits" if read.response[0] == 1 else "misses"
        raise UserError(
            f"{read.path}: all {len(read.response)} rows of {read.response_column} are {kind}, "
            "and a curve needs both hits and misses",
            fix="add targets so small that some are missed" if kind == "hits" else "add larger targets",
        )


def require_positive(read: Inspections, response: bool, why: str) -> None:
    """Raises UserError where a size (or a response) has no logarithm; ``why`` names the option that asks for it."""
    values, column = (read.response, read.response_column) if response else (read.size, read.size_column)
    wrong = values <= 0
    if wrong.any():
        first = int(np.argmax(wrong))
        raise UserError(
            f"{read.path}, line {read.line[first]}: {column} is {values[first]:g}, which has no logarithm "
            f"({int(wrong.sum())} such rows)",
            legal=f"values above 0 with {why}",
            fix=f"leave out {why}, or take out rows that are no flaws: they belong to the false calls",
        )


def _table(path: Path) -> tuple[list[str], list[tuple[int, list[str]]], str]:
    """Header, rows that are not blank with their lines, and the separator: the one that parts the header most."""
    try:
        text = bounded_bytes(path, TABLE_BYTES).decode("utf-8-sig")
    except OSError as error:
        reason = (error.strerror or "no reason given").lower()
        raise UserError(f"{path}: cannot be read ({reason})", fix="name a CSV file") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is not UTF-8 text", fix="save it as CSV in UTF-8") from error
    first = next((line for line in text.splitlines() if line.strip()), "")
    if not first:
        raise UserError(f"{path}: is empty", legal="a header row with column names, then one row an inspection")
    separator = max(SEPARATORS, key=lambda one: len(next(csv.reader([first], delimiter=one))))
    reader = csv.reader(text.splitlines(keepends=True), delimiter=separator)
    try:
        lines = [(reader.line_num, row) for row in reader if any(field.strip() for field in row)]
    except csv.Error as error:
        raise UserError(f"{path}, line {reader.line_num}: {error}", fix="save the file as CSV") from error
    return [name.strip() for name in lines[0][1]], lines[1:], separator


def _column(path: Path, header: Sequence[str], name: str) -> int:
    if header.count(name) > 1:
        raise UserError(f"{path}: {header.count(name)} columns are called {name!r}", fix="rename all but one")
    if name in header:
        return list(header).index(name)
    from harness.vocabulary.declaration.diagnose import nearest

    near = nearest(name, header)
    raise UserError(
        f"{path}: no column {name!r}",
        legal=", ".join(repr(one) for one in header),
        fix=f"did you mean {near!r}?" if near else "name one of these columns",
    )


def _number(path: Path, line: int, column: str, text: str, separator: str) -> float:
    plain = text.strip() if separator == "," else text.strip().replace(",", ".")
    try:
        number = float(plain)
    except ValueError:
        number = float("nan")
    if not np.isfinite(number):
        what = repr(text.strip()) if text.strip() else "empty"
        raise UserError(
            f"{path}, line {line}: {column} is {what}, not a number",
            legal="a finite number in every row",
            fix="mend the row, or take it out",
        )
    return number
