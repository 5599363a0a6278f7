"""The page of one set of inspections, and the same in plain lines for a terminal."""

from __future__ import annotations

from harness.evaluation.pod.curve import Bound
from harness.evaluation.pod.statement import ModelRow, PodStatement
from harness.report.page_parts import template
from harness.report.pod_figure import answer, pod_svg, sized
from harness.tables.grid import aligned

VALIDITY = (
    "The limit speaks of inspections like these: the same kind of flaws and parts, the same procedure, the sizes that "
    "were tried. Targets are taken as independent of each other. Sizes beyond the largest target are extrapolation."
)


def pod_html(statement: PodStatement, command: str) -> str:
    """The page as text: limit, figure, table of models, tests, notes; it needs no network."""
    return template("pod.html").render(
        title=f"Probability of detection: {statement.path.name}",
        answer=answer(statement),
        counts=statement.counts,
        kind=statement.kind,
        model=statement.model,
        figure=pod_svg(statement),
        sizes=size_rows(statement),
        model_heads=_model_heads(statement),
        models=[(row.chosen, _model_cells(row, statement)) for row in statement.models],
        criterion=statement.criterion,
        numbers=[(name, f"{value:.5g}") for name, value in statement.numbers.items()],
        tests=[(what, f"{p:.3f}" if p >= 0.001 else "< 0.001", reads) for what, p, reads in statement.tests],
        notes=(*statement.notes, VALIDITY),
        command=command,
    )


def pod_text(statement: PodStatement) -> str:
    """The same as plain lines, columns aligned."""
    parts = [f"{statement.path}: {statement.kind}, {statement.counts}", f"model: {statement.model}", ""]
    parts += [*aligned([["", statement.criterion, "a50", "a90", "a90/95"], *_marked(statement)]), ""]
    parts += [*aligned([list(row) for row in size_rows(statement)], left=3), ""]
    parts += aligned([[name, f"{value:.5g}"] for name, value in statement.numbers.items()])
    if statement.tests:
        parts += ["", *(f"{what}: p = {p:.3g}, {reads}" for what, p, reads in statement.tests)]
    parts += ["", *(f"note: {note}" for note in statement.notes)] if statement.notes else []
    return "\n".join([*parts, "", answer(statement)])


def size_rows(statement: PodStatement) -> list[tuple[str, str, str]]:
    """(name, size, how it was found) of a50, a90 and every bound."""
    rows = [
        ("a50", sized(statement.a50, statement.unit), "estimate"),
        ("a90", sized(statement.a90, statement.unit), "estimate"),
        ("a90/95", _bound_text(statement.bound, statement.unit), f"{statement.bound.method}: the limit to quote"),
    ]
    rows += [("a90/95", _bound_text(one, statement.unit), one.method) for one in statement.others]
    if statement.independent is not None:
        wrong = "WRONG here: as if every inspection were a target of its own"
        rows.append(("a90/95", _bound_text(statement.independent, statement.unit), wrong))
    return rows


def _bound_text(bound: Bound, unit: str) -> str:
    return sized(bound.value, unit) if bound.demonstrated else "not demonstrated"


def _model_heads(statement: PodStatement) -> tuple[str, ...]:
    of_unit = f" ({statement.unit})" if statement.unit else ""
    return ("model", statement.criterion, f"a50{of_unit}", f"a90{of_unit}", f"a90/95{of_unit}")


def _model_cells(row: ModelRow, statement: PodStatement) -> tuple[str, ...]:
    return (row.name, f"{row.criterion:.2f}", sized(row.a50, ""), sized(row.a90, ""), _bound_text(row.bound, ""))


def _marked(statement: PodStatement) -> list[list[str]]:
    """The models' cells, the chosen one with a star."""
    cells = [(row.chosen, _model_cells(row, statement)) for row in statement.models]
    return [[f"{'*' if chosen else ' '} {first}", *others] for chosen, (first, *others) in cells]
