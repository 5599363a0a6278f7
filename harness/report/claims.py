"""The thesis' part of a report: its claims with their verdicts. Pages of other targets hold none of it."""

from __future__ import annotations

from collections.abc import Sequence

from markupsafe import Markup

from harness.report.blocks import badge, heading, joined, paragraph, tag
from harness.tables.grid import Cell
from harness.thesis.verdicts import Verdict

KINDS = {"borne out": "yes", "not borne out": "no", "undecided": "open"}
RULES_NOTE = (
    "Each criterion is written in the program and is the same for every run. Where the data leave room for both "
    "answers, the claim is undecided."
)


def claims_section(title: str, verdicts: Sequence[Verdict]) -> list[Markup]:
    """A heading and the table of claims; nothing without verdicts."""
    if not verdicts:
        return []
    heads = joined((tag("th", head) for head in ("claim", "verdict", "evidence", "criterion")), "")
    rows = (
        tag(
            "tr",
            tag("td", tag("b", verdict.claim), f" {verdict.text}"),
            tag("td", badge(verdict.verdict)),
            tag("td", verdict.evidence, data_name="Evidence"),
            tag("td", verdict.rule, data_name="Criterion", kind="note"),
            kind=KINDS[verdict.verdict],
        )
        for verdict in verdicts
    )
    table = tag("table", tag("thead", tag("tr", heads)), tag("tbody", joined(rows)), kind="claims")
    return [heading(title), paragraph(RULES_NOTE), table]


def verdict_cell(answer: str, usual: str) -> Cell:
    """A verdict as a mark, marked as well where it differs from the ``usual``."""
    return Cell(Markup("≠ " if answer != usual else "") + badge(answer, brief=True))


def counted_verdicts(verdicts: Sequence[Verdict]) -> str:
    """Return ``Of the 7 claims scored, 5 are borne out (...) and 2 are undecided (...).``; empty without verdicts."""
    answers = [
        f"{len(names)} {'is' if len(names) == 1 else 'are'} {answer} ({', '.join(names)})"
        for answer in KINDS
        if (names := [verdict.claim for verdict in verdicts if verdict.verdict == answer])
    ]
    if not answers:
        return ""
    listed = answers[0] if len(answers) == 1 else f"{', '.join(answers[:-1])} and {answers[-1]}"
    return f" Of the {len(verdicts)} claims scored, {listed}."
