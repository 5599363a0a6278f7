"""``tofpod score rank FOLDER FOLDER ...``: a leaderboard of methods on the same data set."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.program import Program

if TYPE_CHECKING:
    from harness.evaluation.study.limit import SetUpLimit
    from harness.records.schema import Table

PAGE = "leaderboard.html"
OWN = """\
# a detector of your package writes its maps; any other method writes them itself
tofpod score detector NAME --dataset DIR --out maps/NAME
tofpod score maps/NAME --dataset DIR --name NAME --out scores/NAME
tofpod score rank scores/*"""
"""How to add a method."""


@dataclass(frozen=True, eq=False)
class Ranked:
    """A method on a category."""

    rank: int
    """1 for the smallest a90; methods without a limit come last."""
    limit: SetUpLimit
    """Its detection limit."""
    areas: Mapping[Any, Any]
    """Its areas under curves: the row of ``scores.csv``."""


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folders", nargs="+", type=Path, metavar="SCORES", help="folders that tofpod score wrote")
    add(
        "--out",
        type=Path,
        default=Path("results/leaderboard"),
        metavar="DIR",
        help="default: results/leaderboard",
    )


def _run(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake."""
    from harness.records.schema import write_table
    from harness.vocabulary.provenance import record
    from harness.vocabulary.text import show

    rows = ranked(options.folders)
    table = leaderboard()
    write_table(options.out, table, table.frame(rows), record(command))
    write_text(options.out / PAGE, leaderboard_html(rows, command))
    show([table.grid(rows, terminal=True), "", answer(rows)])
    print(f"page: {options.out / PAGE}")
    return 0


def ranked(folders: Sequence[Path]) -> list[Ranked]:
    """Return the methods of each category by a90. Raises UserError for methods that were judged on
    different boards, and for two of one name."""
    import pandas as pd

    from harness.evaluation.study.limit import limit_of
    from harness.evaluation.study.record import read_record

    by_category: dict[str, list[Ranked]] = {}
    boards: dict[str, tuple[str, Path]] = {}
    for folder in folders:
        study = read_record(folder)
        scores = folder / "scores.csv"
        if not scores.is_file():
            raise UserError(f"{folder}: has no scores.csv", fix="name folders of tofpod score")
        areas = pd.read_csv(scores).set_index("category").to_dict("index")
        for set_up in study.set_ups:
            category = set_up.variant
            first_digest, first = boards.setdefault(category, (set_up.frames_digest, folder))
            if set_up.frames_digest != first_digest:
                fix = "judge both on the same data set"
                raise UserError(f"{folder} and {first}: show other boards of {category}", fix=fix)
            same = by_category.setdefault(category, [])
            if any(row.limit.record.detector == set_up.detector for row in same):
                problem = f"{folder}: a second method called {set_up.detector!r}"
                raise UserError(problem, fix="score one of them with another --name")
            same.append(Ranked(0, limit_of(set_up), areas[category]))
    rows = []
    for same in by_category.values():
        same.sort(key=_known_a90_mm)
        rows += [replace(row, rank=number) for number, row in enumerate(same, start=1)]
    return rows


def _known_a90_mm(row: Ranked) -> float:
    """Return a90 for sorting; infinity if it is unknown or beyond the sizes."""
    a90_mm = row.limit.a90_mm
    if np.isnan(a90_mm) or row.limit.beyond(a90_mm):
        return np.inf
    return a90_mm


def leaderboard() -> Table:
    """Return the declaration of the table."""
    from harness.records.schema import Column, Table
    from harness.tables.limits import CALLS, FOUND_90, a90_of, bound_estimate, bound_text

    def area(name: str, label: str) -> Column:
        return Column(name, label, lambda row: row.areas[name], "as in scores.csv", "{:.3f}".format)

    return Table(
        "leaderboard",
        "one row per method and category of a data set, by a90",
        (
            Column("category", "category", "limit.record.variant", "name of the category"),
            Column("method", "method", "limit.record.detector", "name of the method"),
            Column("rank", "rank", "rank", "place by a90"),
            Column("a90_mm", "a90 (mm)", lambda row: a90_of(row.limit), FOUND_90, interval=True),
            Column(
                "a90_95_mm",
                "a90/95 (mm)",
                lambda row: bound_estimate(row.limit, row.limit.a90_95),
                "upper bound of a90 at 95 % confidence",
                bound_text,
            ),
            replace(
                CALLS[0],
                value=("limit.false_calls.rate_per_m2", "limit.false_calls.interval_per_m2"),
            ),
            area("au_pro", "AU-PRO"),
            area("pixel_auroc", "AUROC of pixels"),
            area("board_auroc", "AUROC of boards"),
        ),
        title="methods by the smallest damage found nine times out of ten",
        left=2,
    )


def answer(rows: Sequence[Ranked]) -> str:
    """State the best method of each category in a sentence."""
    from harness.tables.limits import a90_of

    several = len({row.limit.record.variant for row in rows}) > 1
    sentences = []
    for row in rows:
        if row.rank > 1:
            continue
        record = row.limit.record
        place = f"{record.variant}: " if several else ""
        if np.isinf(_known_a90_mm(row)):
            sentences.append(f"{place}no method has a limit within the sizes inspected.")
            continue
        size = a90_of(row.limit).text()
        found = f"{record.detector} finds the smallest damage nine times out of ten: {size} mm"
        sentences.append(f"{place}{found}.")
    return " ".join(sentences)


def leaderboard_html(rows: Sequence[Ranked], command: str) -> str:
    """Return the page as text; it needs no network."""
    from harness.report.blocks import command_of, figure, heading, note, page, subheading, tag
    from harness.report.limits_figure import limits_figure
    from harness.vocabulary.text import many

    caption = "a90 with its 95 % interval over boards, and a90/95 (bar), by method."
    several = len({row.limit.record.variant for row in rows}) > 1
    limits = []
    for row in rows:
        record = row.limit.record
        label = f"{record.detector}, {record.variant}" if several else record.detector
        limits.append(replace(row.limit, record=replace(record, variant=label)))
    drawn = figure({"limits": limits_figure(limits)}, "limits", caption)
    body = [
        drawn,
        heading("Methods"),
        leaderboard().grid(rows).html(),
        subheading("Add a method"),
        tag("pre", OWN),
        *command_of(command),
    ]
    boards = rows[0].limit.boards
    conditions = (
        f"Maps of {many(boards, 'damaged board')} in the first category, judged by a90. All methods"
        " see the same boards: tofpod compare tests two of them damage by damage."
    )
    return page("Leaderboard", answer(rows), body, [note(conditions)])


RANK = Program(
    name="score rank",
    options=_options,
    run=_run,
    description="Rank methods that tofpod score judged on the same data set by a90, with AU-PRO "
    f"and AUROC beside it. Write {PAGE} and a table.",
    examples=(
        "tofpod score rank scores/thesis scores/matched",
        "tofpod score rank scores/thesis scores/matched scores/mine --out ranking",
    ),
)
