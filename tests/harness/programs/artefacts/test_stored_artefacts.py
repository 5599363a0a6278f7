"""Nothing stored is older than the code that made it without saying so.

What fails here after a change of code is repaired by `make ages`, which takes seconds, or by
`make artefacts`, which makes the answers again."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import pytest

from harness.__main__ import main
from harness.programs.artefacts.declaration import data_file, declared_artefacts
from harness.programs.artefacts.ledger import edited_files, read_ledger
from harness.programs.artefacts.quoted import documents, quotation, quoted_in, read_rows
from harness.programs.audit.rows import AUDIT
from harness.programs.dataset.score_rank import leaderboard
from harness.programs.filters.tables import FILTER_COSTS
from harness.programs.scorecard.figures import SCORES
from harness.records.trials import SUMMARISED
from harness.tables.study import STUDY_TABLES
from tests.benchmarks import jobs
from tests.benchmarks.peers import PeerRow
from tests.benchmarks.study_steps import GrowthRow, StepRow

ROOT = Path(__file__).resolve().parents[4]
TEXTS = ["README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]
MADE_BY_MAKE_DOCS = {"docs/index.md", "docs/reference.md", "docs/contributing.md"}
WHOLE_PAGES = {"docs/azure_walls.md", "docs/mutants.md"}
"""Documents that are one artefact; their markers stand at the beginning."""
OF_FACTS = {
    "| | Azure Kinect NFOV | Kinect v2 | RealSense L515 |",
    "| files | basis |",
    "| what | size |",
    "| platform | light | `sim` | `open3d` | `cluster` | `excel` | `peers` |",
}
"""First lines of tables whose numbers no code of tofpod computes: of camera files, of sizes of
files, and of packages in the index."""
SHARE_OF_NUMBERS = 0.4
MEASURED = {
    "jobs": jobs.Row,
    "quick": jobs.QuickRow,
    "steps": StepRow,
    "growth": GrowthRow,
    "peers": PeerRow,
}
"""Rows of the tables that benchmarks write, by table."""
AXES = ("source.", "compared_with")  # columns of axes are named as their keys
REPAIR = "declare it in artefacts.yaml and put markers around or after it; see CONTRIBUTING.md"


def text_of(document: str) -> str:
    return (ROOT / document).read_text(encoding="utf-8")


@pytest.mark.parametrize("document", documents())
def test_a_document_quotes_what_is_stored_and_says_what_is_older(document: str):
    ledger = read_ledger()
    for name, text in quoted_in(text_of(document)):
        assert text == quotation(name, document, ledger), f"{name}: run `make ages`"


def test_what_is_declared_is_quoted_and_what_is_quoted_is_declared():
    quoted = {
        (name, document)
        for document in TEXTS
        if document not in MADE_BY_MAKE_DOCS
        for name, _ in quoted_in(text_of(document))
    }
    declared = {
        (name, document)
        for name, artefact in declared_artefacts().items()
        for document in artefact.documents
    }
    assert quoted == declared


def test_every_marker_has_its_end():
    for document in TEXTS:
        text = text_of(document)
        assert text.count("<!-- artefact: ") == len(quoted_in(text)), document
        assert text.count("<!-- end: ") == len(quoted_in(text)), document


@pytest.mark.parametrize("name", declared_artefacts())
def test_stored_files_are_as_they_were_made(name: str):
    assert edited_files(name, read_ledger()) == []


def test_every_picture_and_table_of_data_is_an_artefacts():
    stored = {file for artefact in declared_artefacts().values() for file in artefact.writes}
    stored |= {file for artefact in declared_artefacts().values() for file in artefact.stores}
    pictures = [*(ROOT / "docs").glob("*.png"), *(ROOT / "docs").glob("*.svg")]
    assert {path.relative_to(ROOT).as_posix() for path in pictures} <= stored
    data = {data_file(name) for name, artefact in declared_artefacts().items() if artefact.table}
    kept = (ROOT / "results/baselines/tables").glob("*")
    assert {path.relative_to(ROOT).as_posix() for path in kept} == data


def tables_of(text: str) -> list[tuple[int, str]]:
    """(index, text) of every table in Markdown."""
    return [(match.start(), match[0]) for match in re.finditer(r"(?m)^(?:\|.*\n){3,}", text)]


def share_of_numbers(table: str) -> float:
    cells = [cell.strip() for line in table.splitlines()[2:] for cell in line.split("|")[2:-1]]
    return sum(bool(re.match(r"[-+*(−]*\.?\d", cell)) for cell in cells) / max(len(cells), 1)


@pytest.mark.parametrize("document", sorted({*TEXTS} - MADE_BY_MAKE_DOCS - WHOLE_PAGES))
def test_every_table_of_numbers_states_its_age(document: str):
    """A table is an artefact's if it stands between markers, or if markers follow it."""
    text = text_of(document)
    for start, table in tables_of(text):
        before = text[:start]
        is_inside = before.count("<!-- artefact: ") > before.count("<!-- end: ")
        is_followed = text[start + len(table) :].lstrip().startswith("<!-- artefact: ")
        head = table.partition("\n")[0]
        is_computed = share_of_numbers(table) >= SHARE_OF_NUMBERS and head not in OF_FACTS
        assert is_inside or is_followed or not is_computed, f"{head}: {REPAIR}"


def test_ls_lists_every_artefact_with_what_has_changed(capsys: pytest.CaptureFixture[str]):
    assert main(["ls", "artefacts"]) == 0
    printed = capsys.readouterr().out
    for name in declared_artefacts():
        assert re.search(rf"^{name} ", printed, re.MULTILINE)


def test_the_columns_that_tables_quote_are_written():
    """So that a renamed column is noticed before an artefact has been computed for an hour."""
    declared = (*STUDY_TABLES, *SUMMARISED, SCORES, FILTER_COSTS, AUDIT, leaderboard())
    tables = {table.name: table for table in declared}
    for name, artefact in declared_artefacts().items():
        if artefact.table is None:
            continue
        written = {"experiment", "frames"}
        for rows in artefact.rows:
            table = Path(rows).stem
            if table in MEASURED:
                written |= {field.name for field in fields(MEASURED[table])}
            else:
                columns = tables[table].stored
                written |= {column for stored in columns for column in stored.names}
        quoted = {column for column in read_rows(name)[0] if not column.startswith(AXES)}
        assert quoted <= written, name
