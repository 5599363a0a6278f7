"""The page of a comparison of two studies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from harness.evaluation.study.record import StudyRecord
from harness.evaluation.study.verdict import ComparedSetUps, Comparison
from harness.report.compare_figure import compare_svg
from harness.report.compare_rows import HEADS, LEFT, TESTS, answer, cells, remarks, rule
from harness.report.page_parts import template
from harness.tables.limits import estimate_of
from harness.tables.text import mm

CLASSES: Mapping[str, str] = {"worse": "no", "newly failing": "no", "better": "yes", "newly working": "yes"}


def compare_html(comparison: Comparison, command: str) -> str:
    """The page as text: answer, figure, table, what differs, rule, where both come from. It needs no network."""
    return template("compare.html").render(
        title=f"Comparison: {_title(comparison)}",
        answer=answer(comparison),
        remarks=remarks(comparison),
        figure=compare_svg(comparison),
        heads=HEADS,
        left=LEFT,
        rows=[(CLASSES.get(row.mark, "open"), cells(row)) for row in comparison.rows],
        sizes=[_sizes(row) for row in comparison.rows],
        rule=rule(comparison),
        tests=TESTS,
        origins=list(
            zip(("study", "commit", "seed"), _origin(comparison.first), _origin(comparison.second), strict=True)
        ),
        command=command,
    )


def _title(comparison: Comparison) -> str:
    return " and ".join(dict.fromkeys((comparison.first.name, comparison.second.name)))


def _sizes(row: ComparedSetUps) -> tuple[str, ...]:
    """a50, a90 with interval and a90/95 of both."""
    texts = [row.label]
    for limit in (row.first, row.second):
        if limit is None:
            texts += ["–", "–", "–", "–"]
            continue
        texts += [
            estimate_of(limit, limit.a50_mm).text(),
            estimate_of(limit, limit.a90_mm, limit.a90_interval_mm).text(),
            mm(limit.a90_95.value) if limit.a90_95.demonstrated else "not demonstrated",
            f"{limit.hits}/{limit.inspections}",
        ]
    return tuple(texts)


def _origin(study: StudyRecord) -> tuple[str, ...]:
    commit: Any = study.provenance.get("commit")
    changed = ", with changes" if study.provenance.get("dirty") else ""
    return (
        f"{study.name}, {study.digest}",
        f"{str(commit)[:12]}{changed}" if commit else "not recorded",
        str(study.provenance.get("seed", "not recorded")),
    )
