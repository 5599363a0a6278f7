"""The sections of an inspection's page that a reference adds."""

from __future__ import annotations

from collections.abc import Sequence

from markupsafe import Markup

from harness.inspection import output
from harness.inspection.changes import Changes, DamageSize
from harness.inspection.tolerance import GUARD, RISK, PartDecision
from harness.report.blocks import fold, joined, paragraph
from harness.report.inspection_page import definitions
from harness.vocabulary.text import Grid

CHANGE_HEADS = ("no.", "state", "width then", "depth then", "width now", "depth now", "change")
MOST_ROWS = 30


def changes_section(changes: Changes) -> Markup:
    """Return what changed since an earlier capture: a sentence and a table, in millimetres."""
    sentence = changes.sentence
    parts = [paragraph(f"{sentence[0].upper()}{sentence[1:]}.")]
    rows = []
    for change in changes.damage[:MOST_ROWS]:
        sizes = (*_size_texts(change.then), *_size_texts(change.now))
        distance = f"{output.number(change.distance_mm, 2)} ({output.number(change.lod_mm, 2)})"
        rows.append((str(change.id), change.state, *sizes, distance))
    if rows:
        parts.append(Grid.of(CHANGE_HEADS, rows, left=2).html())
    how = (
        "All sizes are in mm. Then and now: what each capture shows there against a smooth surface;"
        " a dash where it shows no damage. Change: distance between both captures at the middle"
        " of the damage, averaged over a cylinder along the normal, with its level of detection at"
        " 95 % (M3C2) in brackets; it holds the noise of both captures, the placement, and what"
        " unchanged places differ by."
    )
    parts.append(paragraph(how))
    further = len(changes.damage) - MOST_ROWS
    if further > 0:
        parts.append(paragraph(f"{further} more are in findings.json."))
    return joined(parts)


def _size_texts(size: DamageSize | None) -> tuple[str, str]:
    """Return width and depth, or dashes."""
    if size is None:
        return "-", "-"
    depth = output.number(size.depth_mm, 2)
    if size.depth_se_mm == size.depth_se_mm:
        depth += f"\u00a0±\u00a0{size.depth_se_mm:.2f}"
    return output.number(size.diameter_mm, 1), depth


DECISION_HEADS = ("no.", "decision", "why", "tolerance", "measured", "uncertainty", "guard band")
LINE = "_" * 30
"""What is filled in by hand."""


def decision_section(decision: PartDecision, about: Sequence[tuple[str, str]]) -> Markup:
    """Return the decision with its evidence, to be signed. ``about``: part, reference and version
    as names and values."""
    parts = [paragraph(decision.sentence), definitions(about)]
    limits = {tolerance.kind: tolerance.limit_mm for tolerance in decision.tolerances}
    rows = []
    for finding in decision.findings:
        uncertainty_mm = finding.uncertainty_mm
        rows.append(
            (
                str(finding.id),
                finding.decision,
                finding.reason,
                f"{finding.kind} {limits[finding.kind]:g}",
                output.number(finding.value_mm, 2),
                output.number(uncertainty_mm, 2),
                output.number(GUARD * uncertainty_mm, 2),
            )
        )
    if rows:
        parts.append(Grid.of(DECISION_HEADS, rows, left=4).html())
        parts.append(paragraph(_rule_text()))
        parts.append(_budget(decision))
    signed = [("decided by", LINE), ("date", LINE), ("signature", LINE)]
    parts.append(definitions(signed))
    return joined(parts)


def _rule_text() -> str:
    """Return the rule of the decisions in words."""
    risk = f"{100 * RISK:g} %"
    return (
        "All sizes are in mm. A size conforms if it lies below the limit by the guard band, and"
        f" does not conform if it lies above the limit by it (ISO 14253-1); the band is {GUARD:.3g}"
        f" standard uncertainties, so that at most {risk} of sizes at the limit are accepted and at"
        f" most {risk} are rejected."
    )


def _budget(decision: PartDecision) -> Markup:
    """Return each contribution to the uncertainties, in mm."""
    names = []
    for finding in decision.findings:
        names += [entry.name for entry in finding.contributions if entry.name not in names]
    rows = []
    for name in names:
        row = [name]
        for finding in decision.findings:
            sizes = {entry.name: entry.mm for entry in finding.contributions}
            row.append(f"{sizes[name]:.3f}" if name in sizes else "-")
        rows.append(row)
    heads = [f"{finding.id}: {finding.kind}" for finding in decision.findings]
    table = Grid.of(("standard uncertainty from", *heads), rows, left=1).html()
    return fold("Contributions to the uncertainty", table, is_open=True)
