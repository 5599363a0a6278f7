"""The sections of an inspection's page that a reference adds."""

from __future__ import annotations

from markupsafe import Markup

from harness.inspection import output
from harness.inspection.changes import Changes, DamageSize
from harness.inspection.sheets import decisions_table, rule_text
from harness.inspection.tolerance import PartDecision
from harness.records import outputs
from harness.report.blocks import joined, paragraph
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
    explanation = (
        "All sizes are in mm. Then and now: what each capture shows there against a smooth surface;"
        " a dash where it shows no damage. Change: distance between both captures at the middle"
        " of the damage, averaged over a cylinder along the normal, with its level of detection at"
        " 95 % (M3C2) in brackets; it holds the noise of both captures, the placement, and what"
        " unchanged places differ by."
    )
    parts.append(paragraph(explanation))
    unshown = len(changes.damage) - MOST_ROWS
    if unshown > 0:
        parts.append(paragraph(f"{unshown} more are in findings.json."))
    return joined(parts)


def _size_texts(size: DamageSize | None) -> tuple[str, str]:
    """Return width and depth, or dashes."""
    if size is None:
        return "-", "-"
    depth = output.number(size.depth_mm, 2)
    if size.depth_se_mm == size.depth_se_mm:
        depth += f"\u00a0±\u00a0{size.depth_se_mm:.2f}"
    return output.number(size.diameter_mm, 1), depth


def decision_section(decision: PartDecision) -> Markup:
    """Return the decision with its findings, and where the sheets to sign are."""
    where = f"{outputs.DECISION.name} is the page to print and sign, with the evidence."
    return joined(
        [
            paragraph(decision.sentence),
            decisions_table(decision),
            paragraph(rule_text()),
            paragraph(where),
        ]
    )
