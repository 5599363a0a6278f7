"""Tables of inspections: what is read from the cells, and which tables are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.evaluation.pod.inspections import (
    Inspections,
    read_inspections,
    require_positive,
    texts_of,
)
from harness.vocabulary.errors import UserError

SIZES = [0.5 * row for row in range(1, 13)]


def written(
    folder: Path,
    rows: list[str],
    head: str = "a,hit,t",
) -> Path:
    path = folder / "table.csv"
    path.write_text("\n".join([head, *rows]), encoding="utf-8")
    return path


def good_rows() -> list[str]:
    """Twelve rows: size, hit, name."""
    return [f"{size},{int(size > 3)},t{row}" for row, size in enumerate(SIZES)]


def read_text(
    folder: Path,
    text: str | bytes,
    **options: object,
) -> Inspections:
    path = folder / "table.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8"))
    return read_inspections(path, "a", ["hit"], **options)  # type: ignore[arg-type]


def test_rows_are_read_with_their_lines(tmp_path: Path) -> None:
    read = read_inspections(written(tmp_path, good_rows()), "a", ["hit"])
    assert read.size.tolist() == SIZES
    assert read.response.tolist() == 6 * [0.0] + 6 * [1.0]
    assert read.line.tolist() == list(range(2, 14))
    assert read.target is None
    assert read.targets == 12
    assert read.unflawed.size == 0
    assert read.notes == ()
    assert texts_of(read, "t").tolist() == [f"t{row}" for row in range(12)]


def test_rows_without_a_size_are_unflawed_sites_and_without_a_result_left_out(
    tmp_path: Path,
) -> None:
    rows = [*good_rows(), "0,1,x", ",0,y", "NA,,z", "9,-,w"]
    read = read_inspections(written(tmp_path, rows), "a", ["hit"])
    assert read.unflawed.tolist() == [1.0, 0.0]
    assert read.size.tolist() == SIZES
    assert read.notes == (
        "2 of 16 inspections state no result and are left out",
        "2 of 16 inspections are of unflawed sites (no size, or 0): not in the curve",
    )


def test_inspectors_are_inspections_of_the_same_target(tmp_path: Path) -> None:
    rows = [f"{size},1,0" for size in SIZES]
    rows[4] = "2.5,1,"
    read = read_inspections(written(tmp_path, rows, "a,first,second"), "a", ["first", "second"])
    assert read.size.tolist() == [*SIZES, *SIZES[:4], *SIZES[5:]]
    assert read.response.tolist() == 12 * [1.0] + 11 * [0.0]
    assert read.line.tolist() == [*range(2, 14), *range(2, 6), *range(7, 14)]
    assert read.targets == 12
    assert read.response_column == "first, second"


def test_named_targets_are_kept_for_every_inspector(tmp_path: Path) -> None:
    rows = [f"{size},1,0,n{row // 2}" for row, size in enumerate(np.repeat(SIZES[:6], 2))]
    path = written(tmp_path, rows, "a,first,second,name")
    read = read_inspections(path, "a", ["first", "second"], "name")
    names = np.repeat([f"n{number}" for number in range(6)], 2).tolist()
    assert read.target is not None
    assert read.target.tolist() == 2 * names
    assert read.targets == 6


@pytest.mark.parametrize(
    ("word", "value"),
    [("1", 1), ("1.0", 1), ("1,", 1), ("Yes", 1), ("HIT", 1), ("0.00", 0), ("miss", 0), ("F", 0)],
)
def test_words_for_hits_and_misses(
    tmp_path: Path,
    word: str,
    value: int,
) -> None:
    rows = [f"{size};{word}" for size in SIZES]
    read = read_text(tmp_path, "\n".join(["a;hit", *rows]))
    assert read.response.tolist() == 12 * [value]


@pytest.mark.parametrize(
    ("texts", "values", "notes"),
    [
        (["1.5", "2.25"], [1.5, 2.25], 0),
        (["1,5", "2,25"], [1.5, 2.25], 0),
        (["1.250,5", "3"], [1250.5, 3.0], 0),
        (["1,250.5", "3"], [1250.5, 3.0], 0),
        (["1,250", "3.5"], [1250.0, 3.5], 0),
        (["1.250", "3.5"], [1.25, 3.5], 0),
        (["1.250", "3"], [1.25, 3.0], 1),
        (["1.250.000", "3"], [1.25e6, 3.0], 0),
        (["1'250.5", "+3"], [1250.5, 3.0], 0),
        (["1.5e3", "2E-1"], [1500.0, 0.2], 0),
        ([".5", "5."], [0.5, 5.0], 0),
    ],
)
def test_numbers_with_marks(
    tmp_path: Path,
    texts: list[str],
    values: list[float],
    notes: int,
) -> None:
    rows = [f"{texts[row % 2]};{row % 2}" for row in range(12)]
    read = read_text(tmp_path, "\n".join(["a;hit", *rows]))
    assert read.size.tolist() == 6 * values
    assert len(read.notes) == notes


@pytest.mark.parametrize("separator", [",", ";", "\t", "|"])
def test_separators(tmp_path: Path, separator: str) -> None:
    head = "sep=|\n" if separator == "|" else ""
    rows = [f"{size}{separator}1" for size in SIZES]
    read = read_text(tmp_path, "\n".join([f"\n{head}a{separator}hit", *rows]))
    assert read.size.tolist() == SIZES
    first_line = 4 if head else 3
    assert read.line[0] == first_line


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_encodings_and_lines_before_the_header(tmp_path: Path, encoding: str) -> None:
    rows = ["Prüfung 7", "", "größe;hit", *(f"{size};1" for size in SIZES)]
    path = tmp_path / "table.csv"
    path.write_bytes("\n".join(rows).encode(encoding))
    read = read_inspections(path, "größe", ["hit"])
    assert read.size.tolist() == SIZES
    assert read.line.tolist() == list(range(4, 16))


def test_a_sheet_may_begin_in_any_column(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append([None])
    book.active.append([None, None, "a", None, "hit"])
    for size in SIZES:
        book.active.append([None, None, size, None, 1])
    path = tmp_path / "table.xlsx"
    book.save(path)
    read = read_inspections(path, "a", ["hit"])
    assert read.size.tolist() == SIZES
    assert read.line.tolist() == list(range(3, 15))
    book.create_sheet("second").append(["a"])
    book.save(path)
    with pytest.raises(UserError, match="has 2 sheets with data: Sheet, second"):
        read_inspections(path, "a", ["hit"])


@pytest.mark.parametrize(
    ("row", "text", "message"),
    [
        (5, "3.0,2,t", "line 7: hit is '2', which is neither hit nor miss"),
        (5, "3 mm,0,t", "line 7: a is '3 mm', not a number"),
        (5, "inf,0,t", "line 7: a is 'inf', not a number"),
        (5, "3.0,0", "line 7: 2 fields, and the header has 3"),
        (5, "-1,0,t", "line 7: a is -1, but a size cannot be below 0"),
        (3, "2,0,", "line 5: t is empty"),
        (3, "2,0,t1", "target 't1' has size 1 in line 3 and 2 in line 5"),
        (3, '"1,234.5",0,t', None),
        (3, '"3,5",0,t', "a has numbers with the decimal marks , and ."),
    ],
)
def test_rows_that_are_refused(
    tmp_path: Path,
    row: int,
    text: str,
    message: str | None,
) -> None:
    rows = good_rows()
    rows[row] = text
    path = written(tmp_path, rows)
    if message is None:
        assert read_inspections(path, "a", ["hit"], "t").size[row] == 1234.5
        return
    with pytest.raises(UserError, match=message):
        read_inspections(path, "a", ["hit"], "t")


def test_nine_rows_are_too_few(tmp_path: Path) -> None:
    assert len(read_text(tmp_path, "\n".join(["a,hit,t", *good_rows()[:10]])).size) == 10
    with pytest.raises(UserError, match="9 rows are too few"):
        read_text(tmp_path, "\n".join(["a,hit,t", *good_rows()[:9]]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("\n \n", "is empty"),
        (bytes(100), "is not a text file"),
        (b"PK\x03\x04" + bytes(50), "cannot be read as an Excel file"),
        ("hit,b\n1,2\n", "no column 'a'"),
        ("a,a,hit\n1,2,1\n", "2 columns are called 'a'"),
    ],
)
def test_files_that_are_refused(
    tmp_path: Path,
    text: str | bytes,
    message: str,
) -> None:
    with pytest.raises(UserError, match=message):
        read_text(tmp_path, text)


def test_columns_are_named_or_suggested(tmp_path: Path) -> None:
    path = written(tmp_path, good_rows())
    with pytest.raises(UserError, match="no column 'Hit'") as caught:
        read_inspections(path, "a", ["Hit"])
    assert "did you mean 'hit'?" in str(caught.value.fix)
    with pytest.raises(UserError, match="column 'a' is chosen twice"):
        read_inspections(path, "a", ["a"])
    with pytest.raises(UserError, match="cannot be read"):
        read_inspections(tmp_path / "none.csv", "a", ["hit"])


def test_values_without_a_logarithm_are_refused(tmp_path: Path) -> None:
    read = read_inspections(written(tmp_path, good_rows()), "a", ["hit"])
    require_positive(read, False, "--log")
    with pytest.raises(UserError, match="line 2: hit is 0, which has no logarithm"):
        require_positive(read, True, "--log-signal")
