"""Result tables: declared once, and rendered alike as files, as text and as a page."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from harness.evaluation.intervals import UNKNOWN, Interval
from harness.programs.keeping.readme import results_readme
from harness.programs.keeping.written_files import outputs
from harness.records.schema import Column, Estimate, Table, write_table
from harness.records.trials import STORED, SUMMARISED
from harness.tables.study import STUDY_TABLES
from harness.vocabulary.errors import UserError
from harness.vocabulary.text import Cell, Grid, show, text_of

ROOT = Path(__file__).resolve().parents[3]


@dataclass(frozen=True)
class Animal:
    name: str
    size_m: float
    ends: Interval = UNKNOWN
    axes: dict[str, object] = field(default_factory=dict)
    parent: Animal | None = None


ANIMALS = Table(
    "animals",
    "one row per animal",
    (
        Column("name", "animal", "name", "name of the <species>"),
        Column("axes", "", "axes", "where it lives", spread=True),
        Column(
            "size_m",
            "size (m)",
            ("size_m", "ends"),
            "length",
            tone=lambda one: "bad" if one.size_m > 3 else "",
        ),
        Column("parent", "", "parent.name", "its parent"),
        Column(
            "is_large",
            "",
            lambda one: None if np.isnan(one.size_m) else one.size_m > 1,
            "larger than a metre",
        ),
        Column("", "in words", lambda one: f"{one.name}!", brief=False),
    ),
)
CAT = Animal("cat <small>", 0.46, Interval(0.4, 0.5), {"room.kind": "house", "room.size": {"m": 3}})
WHALE = Animal("whale", 30.0, axes={"room.kind": "sea", "room.size": 7}, parent=CAT)
GHOST = Animal("ghost", np.nan)


@pytest.mark.parametrize(
    ("share", "said"),
    [
        (0.123, "12 %"),
        (1.234, "123 %"),
        (Estimate(1.2, 0.9, 1.55), "120 % (90 to 155 %)"),
        (np.nan, "–"),
    ],
)
def test_shares_are_percentages(share: float | Estimate, said: str) -> None:
    assert Column("found_share", "found").cell({"found_share": share}).text == said


def test_one_declaration_gives_rows_for_all_renderings() -> None:
    (row,) = ANIMALS.data([WHALE])
    assert row == {
        "name": "whale",
        "room.kind": "sea",
        "room.size": 7,
        "size_m": 30.0,
        "size_low_m": None,
        "size_high_m": None,
        "parent": "cat <small>",
        "is_large": True,
    }
    grid = ANIMALS.grid([CAT, WHALE, GHOST])
    assert grid.heads == ("animal", "size (m)", "in words")
    assert [row[1] for row in grid.rows] == [
        Cell("0.46 (0.40 to 0.50)"),
        Cell("30.00", "bad"),
        Cell("none"),
    ]
    brief = ANIMALS.grid([CAT], terminal=True, heads={"animal": "beast"})
    assert brief.lines() == ["beast                   size (m)", "cat <small>  0.46 (0.40 to 0.50)"]
    assert ANIMALS.grid([CAT], heads={"animal": ""}).heads == ("size (m)", "in words")


def test_files_hold_every_row_with_units_and_notes(tmp_path: Path) -> None:
    frame = ANIMALS.frame([CAT, WHALE, GHOST])
    write_table(tmp_path, ANIMALS, frame, {"commit": "abc"})
    lines = (tmp_path / "animals.csv").read_text().splitlines()
    assert lines[0] == "name,room.kind,room.size,size_m,size_low_m,size_high_m,parent,is_large"
    assert lines[1:] == [
        'cat <small>,house,"{""m"":3}",0.46,0.4,0.5,,False',
        "whale,sea,7,30,,,cat <small>,True",
        "ghost,,,,,,,",
    ]
    schema = pq.read_schema(tmp_path / "animals.parquet")
    assert schema.field("size_low_m").metadata == {b"unit": b"m", b"note": b"length"}
    assert json.loads(schema.metadata[b"tofpod"]) == {"commit": "abc"}
    assert pd.read_parquet(tmp_path / "animals.parquet")["size_m"].tolist()[:2] == [0.46, 30.0]
    first = (tmp_path / "animals.parquet").read_bytes()
    write_table(tmp_path, ANIMALS, ANIMALS.frame([CAT, WHALE, GHOST]), {"commit": "abc"})
    assert (tmp_path / "animals.parquet").read_bytes() == first
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError):
        write_table(tmp_path / "file", ANIMALS, frame)


def test_a_table_without_rows_keeps_its_columns() -> None:
    assert list(ANIMALS.frame([]).columns) == [
        "name",
        "size_m",
        "size_low_m",
        "size_high_m",
        "parent",
        "is_large",
    ]


def test_the_page_escapes_and_stands_an_interval_below_its_estimate() -> None:
    html = str(ANIMALS.grid([CAT]).html())
    assert '<th scope="row">cat &lt;small&gt;</th>' in html
    assert '<td class="n">0.46 <small>(0.40 to 0.50)</small></td>' in html
    assert '<th>animal</th><th class="n">size (m)</th>' in html


def test_estimates_as_text() -> None:
    assert Estimate(3.2, 2.9, 3.6).text() == "3.2 (2.9 to 3.6)"
    assert Estimate(20.0, 8.0, np.inf, most=9.0).text() == ">\u00a09 (8.00 to >\u00a09)"
    assert Estimate(20.0, 12.0, np.inf, most=9.0).text() == ">\u00a09"
    assert Estimate(2.05, at_most=True).text() == "≤\u00a02.05"
    assert Estimate(np.nan).text() == "none"


def test_tables_and_sentences_are_printed_plainly_without_a_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    parts = [
        "warning: [red]",
        Grid.of(("a", "b"), [("x", Cell("1", "bad")), ("yy", "22")], title="t"),
        "end",
    ]
    show(parts)
    assert (
        capsys.readouterr().out
        == text_of(parts) + "\n"
        == "warning: [red]\na    b\nx    1\nyy  22\nend\n"
    )


def test_every_declared_column_has_a_name_of_its_own_and_says_what_it_is() -> None:
    for table in (*STORED, *SUMMARISED, *STUDY_TABLES):
        names = [name for column in table.stored for name in column.names]
        assert len(set(names)) == len(names), table.name
        assert all(column.note for column in table.stored), table.name
        assert set(table.order) <= set(names), table.name
    files = [
        output.name for output in outputs() if output.place == "results" and output.of != "capture"
    ]
    assert len(set(files)) == len(files)


def test_the_description_of_results_is_current() -> None:
    written = (ROOT / "results" / "README.md").read_text()
    assert written == "\n".join(results_readme()), (
        "python -m harness.programs.keeping.readme > results/README.md writes it anew"
    )
