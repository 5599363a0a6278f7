"""Quotations of artefacts in documents: a table from its data, a printed answer, and its age.

A quotation stands between two comments, ``<!-- artefact: NAME -->`` and ``<!-- end: NAME -->``,
and is written by `tofpod artefacts`, not by hand."""

import csv
import io
import json
import math
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from string import Formatter
from typing import Any

from harness.programs.artefacts.declaration import (
    QuotedTable,
    artefact_named,
    data_file,
    declared_artefacts,
)
from harness.programs.artefacts.ledger import Ledger, age_sentence
from harness.vocabulary import provenance
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.path_names import value_text
from scenes.sensor.camera import guessed_precision, load_camera

BLOCK = re.compile(r"<!-- artefact: (\w+) -->\n(.*?)<!-- end: \1 -->", re.DOTALL)
Row = Mapping[str, Any]


class _Missing(Exception):
    """A value that a format names is missing."""


class _Formats(Formatter):
    """Formats cells from columns whose names may contain dots."""

    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Return a column's value. Raises _Missing if there is none."""
        if field_name not in kwargs:
            raise _Missing(field_name)
        return kwargs[field_name], field_name

    def format_field(self, value: Any, format_spec: str) -> Any:
        """Return a formatted value. Raises _Missing if a number is asked for and there is none."""
        is_number = isinstance(value, float) and math.isfinite(value)
        if format_spec and not is_number:
            raise _Missing(value)
        return super().format_field(value, format_spec)

    def convert_field(self, value: Any, conversion: str | None) -> Any:
        """Return a camera's title for ``!t``, the kind of a damage for ``!k``, the drawing's shape
        of a target for ``!s``, and a reference, which may be absent, in words for ``!r``."""
        if conversion == "t":
            return _title(value)
        if conversion == "k":
            return json.loads(value)["kind"]
        if conversion == "s":
            shape = json.loads(value)
            drawn = shape.get("shape", shape)
            return value_text("shape", {"kind": drawn["kind"]})
        if conversion == "r":
            reference = json.loads(value) if isinstance(value, str) and value else None
            return value_text("compared_with", reference)
        return super().convert_field(value, conversion)


def quotation(name: str, document: str, ledger: Ledger) -> str:
    """Return the text that a document has between an artefact's markers. A table stands in the
    first of the artefact's documents only."""
    artefact = artefact_named(name)
    parts = []
    if name in ledger and artefact.table is not None and document == artefact.documents[0]:
        parts.append(table_text(artefact.table, read_rows(name)))
    if artefact.prints:
        parts.append(_printed(artefact.commands[0]))
    else:
        parts.append(age_sentence(name, ledger))
    return "".join(f"\n{part}\n" for part in parts if part) + "\n"


def quoted_in(text: str) -> list[tuple[str, str]]:
    """Return (artefact, text between its markers) of each quotation of a document."""
    return [(block[1], block[2]) for block in BLOCK.finditer(text)]


def write_quotations(ledger: Ledger) -> list[str]:
    """Write what documents quote again. Returns the documents that changed."""
    changed = []
    for document in documents():
        path = provenance.ROOT / document
        text = path.read_text(encoding="utf-8")
        new = _rewritten(text, document, ledger)
        if new != text:
            write_text(path, new)
            changed.append(document)
    return changed


def documents() -> list[str]:
    """Return the documents that quote artefacts, each once."""
    names: dict[str, None] = {}
    for artefact in declared_artefacts().values():
        names |= dict.fromkeys(artefact.documents)
    return list(names)


def _rewritten(text: str, document: str, ledger: Ledger) -> str:
    """Return a document's text with what stands between markers as it is to be."""

    def rewritten_block(block: re.Match[str]) -> str:
        name = block[1]
        inside = quotation(name, document, ledger)
        return f"<!-- artefact: {name} -->\n{inside}<!-- end: {name} -->"

    return BLOCK.sub(rewritten_block, text)


def read_rows(name: str) -> list[Row]:
    """Return the stored rows of an artefact's table; numbers as float, texts as they stand."""
    path = provenance.ROOT / data_file(name)
    with path.open(encoding="utf-8", newline="") as stream:
        texts = list(csv.DictReader(stream))
    return [{column: _number(value) for column, value in row.items()} for row in texts]


def stored_rows(table: QuotedTable, sources: Iterable[str]) -> str:
    """Return the data of a table as CSV: the columns that it names, from tables of results. The
    column ``experiment`` names the experiment of each, where a table has none. Raises UserError if
    a column is missing."""
    columns = list(dict.fromkeys(_columns(table)))
    stream = io.StringIO()
    writer = csv.DictWriter(stream, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for source in sources:
        path = provenance.ROOT / source
        with path.open(encoding="utf-8-sig", newline="") as lines:
            for row in csv.DictReader(lines):
                row.setdefault("experiment", path.parent.parent.name)
                missing = [column for column in columns if column not in row]
                if missing:
                    raise UserError(f"{source}: has no column {', '.join(missing)}")
                writer.writerow(row)
    return stream.getvalue()


def _columns(table: QuotedTable) -> Iterable[str]:
    """Yield the columns of the data that a table names."""
    yield from table.where
    if table.across is not None:
        yield table.across.column
    for text in (*table.labels.values(), *table.cells.values(), table.absent):
        for _, column, _, _ in Formatter().parse(text):
            if column:
                yield column


def table_text(table: QuotedTable, rows: Iterable[Row]) -> str:
    """Return a table in Markdown. Rows with equal labels are one row, in the order of the data."""
    chosen = [row for row in rows if _belongs(row, table)]
    by_labels: dict[tuple[str, ...], list[Row]] = {}
    for row in chosen:
        labels = tuple(_cell(text, row, table) for text in table.labels.values())
        by_labels.setdefault(labels, []).append(row)
    values = list(dict.fromkeys(_value_across(row, table) for row in chosen))
    heads = list(table.labels)
    for value in values:
        heads += [_head(cell, value, table) for cell in table.cells]
    lines = [_line(heads), "|" + "---|" * len(heads)]
    for labels, rows_with_labels in by_labels.items():
        by_value = {_value_across(row, table): row for row in rows_with_labels}
        cells = [
            _cell(text, by_value.get(value, {}), table)
            for value in values
            for text in table.cells.values()
        ]
        lines.append(_line([*labels, *cells]))
    return "\n".join(lines)


def _belongs(row: Row, table: QuotedTable) -> bool:
    """Return whether a table shows a row of its data."""
    return all(row[column] == value for column, value in table.where.items())


def _value_across(row: Row, table: QuotedTable) -> Any:
    """Return a row's value that runs along the table; None in a table without."""
    return None if table.across is None else row[table.across.column]


def _head(cell: str, value: Any, table: QuotedTable) -> str:
    """Return the head of a column: that of the cell, and that of the value along the table."""
    if table.across is None:
        return cell
    head_across = table.across.head.format(value)
    return f"{cell}, {head_across}" if cell else head_across


def _cell(text: str, row: Row, table: QuotedTable) -> str:
    """Return a formatted cell; if a number is missing, the text for that."""
    for form in (text, table.absent):
        try:
            return _Formats().vformat(form, (), row).replace("|", "\\|")
        except _Missing:
            continue
    return "–"


def _line(cells: Iterable[str]) -> str:
    """Return a row of a table in Markdown."""
    return f"| {' | '.join(cells)} |".replace("|  |", "| |")


def _number(text: str) -> Any:
    """Return a text as a number if it is one."""
    try:
        return float(text)
    except ValueError:
        return text


def _title(camera: str) -> str:
    """Return a camera's title, with a remark if its precision is a guess."""
    facts = load_camera(camera)
    return f"{facts.title} (gain guessed)" if guessed_precision(facts) else facts.title


def _printed(command: str) -> str:
    """Return a command of tofpod with what it prints, as an indented block. Raises UserError if it
    fails."""
    words = [sys.executable, "-m", "harness", *shlex.split(command)[1:]]
    ended = subprocess.run(words, cwd=provenance.ROOT, capture_output=True, text=True, check=False)
    if ended.returncode:
        raise UserError(f"{command}: fails: {ended.stderr.strip()}")
    lines = [f"$ {command}", *ended.stdout.splitlines()]
    return "\n".join(f"    {line}" for line in lines)
