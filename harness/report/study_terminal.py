"""A study's limits for a terminal, and as plain lines where there is none."""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.evaluation.study.result import StudyResult
from harness.report.page_parts import aligned
from harness.report.study_rows import LimitRow, limit_notes, limit_rows, study_answer
from harness.report.study_tables import threshold_warnings

if TYPE_CHECKING:
    from rich.console import Group

HEADS = (
    "set-up",
    "a50 (mm)",
    "a90 (mm)",
    "a90/95 (mm)",
    "over boards (mm)",
    "calls/m² (95 %)",
    "targets",
    "boards",
)


def study_table(result: StudyResult) -> Group:
    """Warnings, then the limits of every set-up and number of frames in mm, with their rates of false calls."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    # No box, and no wrapping but of names: eight columns then fit a terminal of 100.
    title = "detection limits: found 50 and 90 % of the time, and 90 % with 95 % confidence"
    table = Table(title=title, box=None, pad_edge=False, collapse_padding=True)
    for head in HEADS:
        first = head == HEADS[0]
        table.add_column(head, justify="left" if first else "right", no_wrap=not first, overflow="fold")
    for row in limit_rows(result.limits):
        colours = {HEADS.index("a90/95 (mm)"): "bold green" if row.demonstrated else "bold red"}
        table.add_row(*(Text(text, style=colours.get(at, "")) for at, text in enumerate(_cells(row))))
    return Group(*(Text(line) for line in _warnings(result)), table)


def study_text(result: StudyResult) -> str:
    """Warnings, `study_table` as plain lines, then what to know beside it, then the answer."""
    rows = limit_rows(result.limits)
    table = aligned([list(HEADS), *(list(_cells(row)) for row in rows)])
    notes = limit_notes(rows)
    return "\n".join([*_warnings(result), *table, *([""] if notes else []), *notes, "", study_answer(result.limits)])


def _warnings(result: StudyResult) -> list[str]:
    return [f"warning: {text}" for text in threshold_warnings(result.limits)]


def _cells(row: LimitRow) -> tuple[str, ...]:
    """In the order of `HEADS`; sizes without their intervals, which the report has."""
    estimates = (row.a50.partition(" ")[0], row.a90.partition(" ")[0])
    return (row.name, *estimates, row.a90_95, row.over_boards, row.false_calls, row.targets, row.boards)
