"""Two sheets to print and sign: the decision on the tolerances, and its evidence; as a page and as
data."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from harness.inspection import output
from harness.inspection.tolerance import (
    DECISIONS,
    GUARD,
    KINDS,
    RISK,
    FindingDecision,
    PartDecision,
)
from harness.report.blocks import joined, paragraph, template
from harness.report.findings import Judged
from harness.report.inspection_page import best_view, definitions, numbered_picture
from harness.vocabulary.text import Grid, many

HEADS = ("place", "decision", "why", "tolerance", "measured", "uncertainty", "guard band")
MOST_ROWS = 24
"""Most decisions on the first sheet."""
MOST_COLUMNS = 6
"""Most decisions whose uncertainties the second sheet divides."""
SIGNED = ("decided by", "date", "signature")
"""What is filled in by hand."""


@dataclass(frozen=True)
class Sheets:
    """A decision with what it is signed for."""

    decision: PartDecision
    about: Sequence[tuple[str, str]]
    """Part, reference, conditions and version: names and values."""
    files: Sequence[Mapping[str, str]]
    """The files that were read, with their digests."""

    @property
    def facts(self) -> dict[str, Any]:
        """Return it as plain data, for the JSON."""
        return {**dict(self.about), **self.decision.facts, "files": list(self.files)}

    def html(self, result: Judged) -> str:
        """Return the page as text; it needs no network."""
        name, view = best_view(result)
        limits = " and ".join(tolerance.text for tolerance in self.decision.tolerances)
        rows = [*self.about[:2], ("tolerance", limits), *self.about[2:]]
        missed = self.decision.missed.text
        return template("decision.html").render(
            title=f"Decision on {self.about[0][1]}",
            answer=f"{self.decision.verdict}.",
            about=definitions(rows),
            decisions=decisions_table(self.decision),
            rule=rule_text(),
            signature=definitions((name, "") for name in SIGNED),
            picture=numbered_picture(result, view, name),
            missed=f"{missed[0].upper()}{missed[1:]}.",
            budget=_budget(self.decision),
            files=definitions(_by_folder(self.files)),
        )


def _by_folder(files: Sequence[Mapping[str, str]]) -> list[tuple[str, str]]:
    """Return each folder that was read, with one digest of its files: decision.json has those of
    all."""
    digests: dict[str, list[str]] = {}
    for entry in files:
        digests.setdefault(str(Path(entry["path"]).parent), []).append(entry["sha256"])
    rows = []
    for folder, of_files in digests.items():
        joint = hashlib.sha256("".join(of_files).encode()).hexdigest()
        rows.append((folder, f"{many(len(of_files), 'file')}, SHA-256 of their digests {joint}"))
    return rows


def _worst_first(decision: PartDecision) -> list[FindingDecision]:
    return sorted(decision.findings, key=lambda entry: DECISIONS.index(entry.decision))


def decisions_table(decision: PartDecision) -> Markup:
    """Return each decision with its size, uncertainty and guard band, the worst first."""
    limits = {tolerance.kind: tolerance.limit for tolerance in decision.tolerances}
    entries = _worst_first(decision)
    rows = []
    for entry in entries[:MOST_ROWS]:
        unit = KINDS[entry.kind]
        rows.append(
            (
                entry.place,
                entry.decision,
                entry.reason,
                f"{entry.kind} {limits[entry.kind]:g} {unit}",
                f"{output.number(entry.value, 2)} {unit}",
                output.number(entry.uncertainty, 2),
                output.number(entry.guard, 2),
            )
        )
    if not rows:
        return Markup("")
    parts = [Grid.of(HEADS, rows, left=4).html()]
    unshown = len(entries) - MOST_ROWS
    if unshown > 0:
        parts.append(paragraph(f"{unshown} more are in decision.json."))
    return joined(parts)


def rule_text() -> str:
    """Return the rule of the decisions in words."""
    risk = f"{100 * RISK:g} %"
    return (
        "A size conforms if it lies below the limit by the guard band, and does not conform if it"
        f" lies above the limit by it (ISO 14253-1); the band is {GUARD:.3g} standard"
        f" uncertainties, so that at most {risk} of sizes at the limit are accepted and at most"
        f" {risk} are rejected."
    )


def _budget(decision: PartDecision) -> Markup:
    """Return each contribution to the uncertainties."""
    entries = _worst_first(decision)[:MOST_COLUMNS]
    names: list[str] = []
    for entry in entries:
        names += [part.name for part in entry.contributions if part.name not in names]
    rows = []
    for name in names:
        row = [name]
        for entry in entries:
            sizes = {part.name: part.size for part in entry.contributions}
            row.append(f"{sizes[name]:.3f}" if name in sizes else "-")
        rows.append(row)
    if not rows:
        return Markup("")
    heads = [f"{entry.place}: {entry.kind} ({KINDS[entry.kind]})" for entry in entries]
    return Grid.of(("standard uncertainty from", *heads), rows, left=1).html()
