"""Compares two folders of results, file by file: ``python tests/compare_results.py OLD NEW``.

Files should be equal to the last byte. Where they are not, tables are compared by row and column,
JSON by key, arrays by element and everything else by line, so that the first differences can be
listed. What may differ without being a result stands in `EXCEPTIONS`, each with its reason. The
exit code is 1 if anything else differs, or if a file is missing or additional.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow.parquet as pq

SHOWN_DIFFERENCES = 8  # of each file, unless --all
SHOWN_CHARACTERS = 60  # of each value or line, from shortly before the first difference
DIGEST = re.compile(r"[0-9a-f]{16}")
FILE_WITH_DIGEST = re.compile(r"(?P<start>.+-)[0-9a-f]{16}(?P<suffix>\.\w+)")
ABSENT = "(absent)"
TABLE = re.compile(r"<table.*?</table>", re.DOTALL)  # of a page
CELL = re.compile(r"<t[hd][^>]*>(.*?)</t[hd]>")


@dataclass(frozen=True)
class ExpectedDifference:
    """What may differ between two folders although their results are equal."""

    # "file": whole files; "value": columns of tables and keys of JSON; "text": parts of any text
    kind: Literal["file", "value", "text"]
    # pattern of paths, in which * stands for any characters
    files: str
    # "value": pattern of a column (on pages, of its title) or of a dotted key; "text": regular
    # expression; "file": nothing
    what: str
    # why it is no result
    reason: str


PROGRAM = (
    "ask|characterise|check|clean|compare|coverage|dataset|design|detect|efficiency|export_noise|filters"
    "|export|flatfield|gauge|implant|ls|merge|pod|prepare|score|sweep|target|validate"
)
PROVENANCE_ROWS = "commit|dirty|started|machine|renders|trials|peak mb|versions"
EXCEPTIONS = (
    ExpectedDifference("file", "*renders/*", "", "stored renders: names hold digests of the code"),
    ExpectedDifference("file", "*/journal/*", "", "trials in order of time; keys hold digests"),
    ExpectedDifference("file", "*.lock*", "", "locks have no content"),
    ExpectedDifference("file", "*written.json", "", "digests of the code and of other files"),
    ExpectedDifference("file", "*sources.json", "", "digests of the code"),
    ExpectedDifference("file", "times.txt", "", "durations of the runs to compare"),
    ExpectedDifference("value", "*", "*seconds*", "durations"),
    ExpectedDifference("value", "*.html", "time (s)", "durations"),
    ExpectedDifference("value", "*.html", "ms a cloud", "durations"),
    ExpectedDifference("value", "*", "*commit", "the commit of the code"),
    ExpectedDifference("value", "*", "*dirty", "the state of the checkout"),
    ExpectedDifference("value", "*", "*started", "the time of the run"),
    ExpectedDifference("value", "*", "*command", "the words by which a program was called"),
    ExpectedDifference("value", "*", "*versions.tofpod", "the version of the code"),
    ExpectedDifference(
        "value", "*provenance.json", "renders.*", "stored renders are not made anew"
    ),
    ExpectedDifference("value", "*study.json", "*frames_digest", "a digest of the code as well"),
    ExpectedDifference("value", "*dataset.json", "content", "a digest of the code as well"),
    ExpectedDifference("value", "*score*/study.json", "digest", "a digest of the code as well"),
    ExpectedDifference("value", "*provenance.json", "peak_mb", "memory of the code"),
    ExpectedDifference(
        "text",
        "*.html",
        f'<th scope="row">({PROVENANCE_ROWS})</th><td[^>]*>[^<]*</td>',
        "the origin on a page: the code, the machine and the time",
    ),
    ExpectedDifference(
        "text",
        "*.html",
        "<h3>Command</h3>\n<pre>[^<]*</pre>",
        "the words by which a program was called",
    ),
    ExpectedDifference(
        "text", "*.stderr", r"(?m)(?:^renders \d+/\d+.*\n)+", "progress, every 10 s"
    ),
    ExpectedDifference(
        "text",
        "*.stderr",
        r"(?m)^\S+[.]py:\d+: \w+Warning:.*\n.*\n",
        "warnings quote lines of code",
    ),
    ExpectedDifference("text", "*.stdout", r"\b[\d.]+ [kM]iB\b", "sizes on disk, with journals"),
    ExpectedDifference("text", "*", r"\b20\d\d-\d\d-\d\d\b", "dates of the runs"),
    ExpectedDifference(
        "text", "help/*", r"[\s-]+", "lines are broken by the length of a program's name"
    ),
    ExpectedDifference(
        "text",
        "*",
        rf"(python[\s…-]+m[\s…]harness[.\s…]|\btofpod[\s…]|\bharness\.)(?=({PROGRAM})\b)",
        "a program has several names: tofpod sweep, python -m harness.sweep",
    ),
)


@dataclass
class FolderComparison:
    """The differences between two folders."""

    # lines that state the differences, by path
    differences: dict[str, list[str]] = field(default_factory=dict)
    # number of files that differ and to which an exception applies
    exceptions_used: Counter[ExpectedDifference] = field(default_factory=Counter)
    # number of files in both folders that no exception leaves out
    compared: int = 0
    # number of these files that are equal to the last byte
    equal_bytes: int = 0


@dataclass(frozen=True)
class Expectations:
    """The exceptions that apply to one file."""

    # those whose pattern the file's path matches
    exceptions: Sequence[ExpectedDifference]
    # those that were applied so far
    used: set[ExpectedDifference] = field(default_factory=set)

    def cover(self, name: str) -> bool:
        """Return whether a column or key may differ."""
        for exception in self.exceptions:
            if exception.kind == "value" and fnmatchcase(name, exception.what):
                self.used.add(exception)
                return True
        return False

    def differ(self, name: str, old: str, new: str) -> bool:
        """Return whether two values of a column or key differ although they should not."""
        if old == new or self.cover(name):
            return False
        return self.without_expected(old) != self.without_expected(new)

    def without_expected(self, text: str) -> str:
        """Return a text in which parts that may differ are replaced by an ellipsis."""
        for exception in self.exceptions:
            if exception.kind == "text":
                text, count = re.subn(exception.what, "…", text)
                if count:
                    self.used.add(exception)
        return text


# ---- folders and files ---------------------------------------------------------------------------


def compare_folders(
    old_folder: Path,
    new_folder: Path,
    parts: Sequence[str] = (),
    exceptions: Sequence[ExpectedDifference] = EXCEPTIONS,
) -> FolderComparison:
    """Compare all files of two folders, or only those in folders named ``parts`` in both."""
    comparison = FolderComparison()
    old_files = result_files(old_folder)
    new_files = result_files(new_folder)
    for path in sorted(old_files.keys() | new_files.keys()):
        if parts and path.partition("/")[0] not in parts:
            continue
        matching = [item for item in exceptions if fnmatchcase(path, item.files)]
        left_out = [item for item in matching if item.kind == "file"]
        if left_out:
            comparison.exceptions_used[left_out[0]] += 1
        elif path not in new_files:
            comparison.differences[path] = ["the file is missing"]
        elif path not in old_files:
            comparison.differences[path] = ["the file is additional"]
        else:
            expected = Expectations(matching)
            _compare_file(path, old_files[path], new_files[path], expected, comparison)
    return comparison


def result_files(folder: Path) -> dict[str, Path]:
    """Return the files below a folder by their path in it, in which digests are replaced.

    A digest as the name of a folder becomes ``latest`` where a link of this name leads to it, or
    ``only``. At the end of a file's name, it becomes the digest of the file's content.
    """
    files: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.is_symlink():
            continue
        if path.is_dir():
            name = _name_without_digest(path)
            for below, file in result_files(path).items():
                files[f"{name}/{below}"] = file
        else:
            files[_name_by_content(path, files)] = path
    return files


def _name_by_content(path: Path, taken: Container[str]) -> str:
    match = FILE_WITH_DIGEST.fullmatch(path.name)
    if match is None:
        return path.name
    content = hashlib.blake2b(path.read_bytes(), digest_size=8).hexdigest()
    name = f"{match['start']}{content}{match['suffix']}"
    while name in taken:
        name += "+"
    return name


def _name_without_digest(folder: Path) -> str:
    if not DIGEST.fullmatch(folder.name):
        return folder.name
    if (folder.parent / "latest").resolve() == folder.resolve():
        return "latest"
    siblings = [path for path in folder.parent.iterdir() if DIGEST.fullmatch(path.name)]
    return "only" if len(siblings) == 1 else folder.name


def _compare_file(
    path: str,
    old_file: Path,
    new_file: Path,
    expected: Expectations,
    comparison: FolderComparison,
) -> None:
    comparison.compared += 1
    old_content = old_file.read_bytes()
    new_content = new_file.read_bytes()
    if old_content == new_content:
        comparison.equal_bytes += 1
        return
    compare = COMPARED_BY_SUFFIX.get(Path(path).suffix, text_differences)
    differences = list(compare(old_content, new_content, expected))
    if not differences and not expected.used:
        differences = ["the same values are written in other bytes"]
    if differences:
        comparison.differences[path] = differences
    comparison.exceptions_used.update(expected.used)


# ---- tables --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Table:
    """A table, each of whose values is a text that represents it exactly."""

    # values by column, in order
    columns: dict[str, list[str]]
    # types and descriptions of the columns, and the origin, by dotted key
    facts: dict[str, str]

    @property
    def row_count(self) -> int:
        """Return the number of rows."""
        return max(map(len, self.columns.values()), default=0)


def csv_table(content: bytes) -> Table:
    """Return a table from CSV; cells beyond the header belong to columns without a name."""
    rows = list(csv.reader(io.StringIO(content.decode())))
    header = rows[0] if rows else []
    width = max(map(len, rows), default=0)
    names = header + [f"column {number}" for number in range(len(header), width)]
    columns: dict[str, list[str]] = {name: [] for name in names}
    for row in rows[1:]:
        for name, cell in zip_longest(names, row, fillvalue=ABSENT):
            columns[name].append(cell)
    return Table(columns, facts={})


def parquet_table(content: bytes) -> Table:
    """Return a table from Parquet, with its schema."""
    stored = pq.read_table(io.BytesIO(content))
    columns = {name: list(map(repr, values)) for name, values in stored.to_pydict().items()}
    facts: dict[str, str] = {}
    for column in stored.schema:
        facts[f"type of {column.name}"] = str(column.type)
        facts[f"metadata of {column.name}"] = str(column.metadata)
    for key, value in (stored.schema.metadata or {}).items():
        facts.update(flat_json(value, prefix=key.decode()))
    return Table(columns, facts)


def table_differences(old: Table, new: Table, expected: Expectations) -> Iterator[str]:
    """Yield the differences of two tables: columns and their order, rows, values, facts."""
    yield from key_differences("column", old.columns, new.columns, expected)
    if old.row_count != new.row_count:
        yield f"{old.row_count} rows became {new.row_count}"
    for column in old.columns:
        if column not in new.columns:
            continue
        pairs = list(zip_longest(old.columns[column], new.columns[column], fillvalue=ABSENT))
        changed = [row for row, pair in enumerate(pairs) if expected.differ(column, *pair)]
        if changed:
            old_cell, new_cell = pairs[changed[0]]
            rows = f"{len(changed)} of {len(pairs)} rows differ, first row {changed[0]}"
            yield f"column {column}: {rows}: {excerpts(old_cell, new_cell)}"
    yield from mapping_differences(old.facts, new.facts, expected)


def csv_differences(old: bytes, new: bytes, expected: Expectations) -> Iterator[str]:
    """Yield the differences of two tables in CSV."""
    yield from table_differences(csv_table(old), csv_table(new), expected)


def parquet_differences(old: bytes, new: bytes, expected: Expectations) -> Iterator[str]:
    """Yield the differences of two tables in Parquet."""
    yield from table_differences(parquet_table(old), parquet_table(new), expected)


# ---- JSON and arrays -----------------------------------------------------------------------------


def flat_json(content: bytes, prefix: str = "") -> dict[str, str]:
    """Return the values of a JSON text by dotted key; of another text, only the text itself."""
    flat: dict[str, str] = {}

    def add(key: str, value: Any) -> None:
        if isinstance(value, dict) and value:
            for name, item in value.items():
                add(f"{key}.{name}" if key else name, item)
        elif isinstance(value, list) and value:
            for number, item in enumerate(value):
                add(f"{key}[{number}]", item)
        else:
            flat[key] = json.dumps(value)

    try:
        add(prefix, json.loads(content))
    except ValueError:
        flat[prefix] = repr(content)
    return flat


def json_differences(old: bytes, new: bytes, expected: Expectations) -> Iterator[str]:
    """Yield the differences of two JSON texts."""
    yield from mapping_differences(flat_json(old), flat_json(new), expected)


def mapping_differences(
    old: Mapping[str, str], new: Mapping[str, str], expected: Expectations
) -> Iterator[str]:
    """Yield the differences of two mappings: keys and their order, values."""
    yield from key_differences("key", old, new, expected)
    for key in old:
        if key in new and expected.differ(key, old[key], new[key]):
            yield f"key {key}: {excerpts(old[key], new[key])}"


def key_differences(
    kind: str, old: Mapping[str, Any], new: Mapping[str, Any], expected: Expectations
) -> Iterator[str]:
    """Yield which columns or keys are missing, additional or in another order."""
    for key in old:
        if key not in new and not expected.cover(key):
            yield f"{kind} {key} is missing"
    for key in new:
        if key not in old and not expected.cover(key):
            yield f"{kind} {key} is additional"
    if [key for key in old if key in new] != [key for key in new if key in old]:
        yield f"the {kind}s stand in another order"


def array_differences(old: bytes, new: bytes, expected: Expectations) -> Iterator[str]:
    """Yield the differences of the arrays in two .npz files."""
    old_arrays = dict(np.load(io.BytesIO(old)))
    new_arrays = dict(np.load(io.BytesIO(new)))
    yield from key_differences("array", old_arrays, new_arrays, expected)
    for name in old_arrays:
        if name not in new_arrays:
            continue
        old_text = _array_text(old_arrays[name])
        new_text = _array_text(new_arrays[name])
        if expected.differ(name, old_text, new_text):
            yield f"array {name}: {excerpts(old_text, new_text)}"


def _array_text(array: np.ndarray) -> str:
    """Return type, shape and all elements as a text that represents them exactly."""
    return f"{array.dtype} {array.shape} {array.tolist()}"


# ---- other files ---------------------------------------------------------------------------------


def text_differences(old: bytes, new: bytes, expected: Expectations) -> Iterator[str]:
    """Yield the lines in which two files differ. Files that are not UTF-8 are read as Latin-1."""
    old_lines = expected.without_expected(_decoded(old)).splitlines()
    new_lines = expected.without_expected(_decoded(new)).splitlines()
    if len(old_lines) != len(new_lines):
        yield f"{len(old_lines)} lines became {len(new_lines)}"
    pairs = zip_longest(old_lines, new_lines, fillvalue=ABSENT)
    for number, (old_line, new_line) in enumerate(pairs, start=1):
        if old_line != new_line:
            yield f"line {number}: {excerpts(old_line, new_line)}"


def page_differences(old: bytes, new: bytes, expected: Expectations) -> Iterator[str]:
    """Yield the lines in which two pages differ beyond the columns of tables that may differ."""
    old_page = TABLE.sub(lambda table: _without_expected_columns(table[0], expected), old.decode())
    new_page = TABLE.sub(lambda table: _without_expected_columns(table[0], expected), new.decode())
    yield from text_differences(old_page.encode(), new_page.encode(), expected)


def _without_expected_columns(table: str, expected: Expectations) -> str:
    """Return a table of a page in which cells that may differ are replaced by an ellipsis."""
    head, *rows = table.split("</tr>")
    if "<thead>" not in head:
        return table
    is_expected = [expected.cover(title) for title in CELL.findall(head)]
    return "</tr>".join([head, *(_without_cells(row, is_expected) for row in rows)])


def _without_cells(row: str, is_left_out: Sequence[bool]) -> str:
    columns = iter(is_left_out)
    return CELL.sub(lambda cell: "…" if next(columns, False) else cell[0], row)


def _decoded(content: bytes) -> str:
    try:
        return content.decode()
    except UnicodeDecodeError:
        return content.decode("latin-1")


def excerpts(old: str, new: str) -> str:
    """Return the parts of two different texts where they begin to differ, as ``OLD -> NEW``."""
    pairs = zip_longest(old, new)
    first = next(position for position, (before, after) in enumerate(pairs) if before != after)
    start = max(first - SHOWN_CHARACTERS // 3, 0)
    shown = slice(start, start + SHOWN_CHARACTERS)
    return f"{old[shown]!r} -> {new[shown]!r}"


Compare = Callable[[bytes, bytes, Expectations], Iterator[str]]
COMPARED_BY_SUFFIX: dict[str, Compare] = {
    ".csv": csv_differences,
    ".parquet": parquet_differences,
    ".json": json_differences,
    ".npz": array_differences,
    ".html": page_differences,
}


# ---- the program ---------------------------------------------------------------------------------


def report_lines(comparison: FolderComparison, shown: int | None) -> Iterator[str]:
    """Yield the report; ``shown`` limits the differences of a file."""
    for path, differences in comparison.differences.items():
        yield path
        for difference in differences[:shown]:
            yield f"    {difference}"
        if shown is not None and len(differences) > shown:
            yield f"    and {len(differences) - shown} more"
    if comparison.exceptions_used:
        yield "exceptions that were applied:"
    for exception, count in comparison.exceptions_used.most_common():
        content = exception.what[:SHOWN_CHARACTERS]
        yield f"    {count} files: {exception.reason} ({exception.files} {content!r})"
    equal_bytes = f"{comparison.equal_bytes} of them equal to the last byte"
    yield f"{comparison.compared} files compared, {equal_bytes}"
    yield f"{len(comparison.differences)} files with differences that no exception covers"


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare two folders and print the differences. Returns 1 if there are any."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("old", type=Path, help="folder of results")
    parser.add_argument("new", type=Path, help="folder of results to compare with it")
    only = "compare only these folders in OLD and NEW"
    parser.add_argument("--only", nargs="+", metavar="FOLDER", default=[], help=only)
    parser.add_argument("--all", action="store_true", help="list all differences of each file")
    options = parser.parse_args(arguments)
    for folder in (options.old, options.new):
        for part in ("", *options.only):
            if not (folder / part).is_dir():
                parser.error(f"{folder / part}: no such folder")
    comparison = compare_folders(options.old, options.new, options.only)
    for line in report_lines(comparison, None if options.all else SHOWN_DIFFERENCES):
        print(line)
    return 1 if comparison.differences or not comparison.compared else 0


if __name__ == "__main__":
    raise SystemExit(main())
