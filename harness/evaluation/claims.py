"""Scoring the thesis' claims: for the main variant, and for every plausible value of each fact that it leaves open."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from harness.evaluation.claim_rules import (
    FEW,
    MANY,
    Answer,
    Case,
    Example,
    Verdict,
    claim_c1,
    claim_c2,
    claim_c3,
    claim_c4,
    claim_c5,
    claim_c6,
    claim_c9,
    hole_list,
)
from harness.evaluation.summary import MAIN, ResultTables, summarise_holes, with_columns

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["RULES", "Answer", "Verdict", "hole_list", "score_claims", "verdicts_by_variant"]

RULES: dict[str, Callable[[Case], Verdict]] = {
    "C1": claim_c1,
    "C2": claim_c2,
    "C3": claim_c3,
    "C4": claim_c4,
    "C5": claim_c5,
    "C6": claim_c6,
    "C9": claim_c9,
}


def score_claims(
    tables: ResultTables,
    variant: str = MAIN,
    examples: Sequence[Example] = (),
    summary: pd.DataFrame | None = None,
) -> list[Verdict]:
    """A verdict for each of `RULES` on one variant. ``summary`` saves making `summarise_holes` again."""
    case = _case(tables, variant, examples, summarise_holes(tables.holes) if summary is None else summary)
    return [rule(case) for rule in RULES.values()]


def verdicts_by_variant(
    tables: ResultTables, examples: Sequence[Example] = (), summary: pd.DataFrame | None = None
) -> pd.DataFrame:
    """One row per variant: ``variant``, ``reason``, ``settings``, ``found_1``, ``found_50`` (holes as text, with those
    undecided), and a column per claim with its verdict. The main variant first, the others in the table's order."""
    import pandas as pd

    summary = summarise_holes(tables.holes) if summary is None else summary
    rows = []
    for _, row in tables.variants.sort_values("variant", key=lambda c: c != MAIN, kind="stable").iterrows():
        case = _case(tables, row["variant"], examples, summary)
        verdicts = {name: rule(case).verdict for name, rule in RULES.items()}
        found = {f"found_{frames}": _found_text(case.summary, frames) for frames in (FEW, MANY)}
        rows.append({key: row[key] for key in ("variant", "reason", "settings")} | found | verdicts)
    columns = ["variant", "reason", "settings", f"found_{FEW}", f"found_{MANY}", *RULES]
    return pd.DataFrame(rows, columns=columns)


def _case(tables: ResultTables, variant: str, examples: Sequence[Example], summary: pd.DataFrame) -> Case:
    holes = with_columns(tables.holes)
    return Case(
        variant=variant,
        summary=summary[summary["variant"] == variant],
        holes=holes[holes["variant"] == variant],
        runs=tables.runs[tables.runs["variant"] == variant],
        probes=tables.probes[tables.probes["variant"] == variant],
        examples=[example for example in examples if example.variant == variant],
    )


def _found_text(summary: pd.DataFrame, frames: int) -> str:
    rows = summary[summary["frames"] == frames]
    if rows.empty:
        return "not run"
    text = hole_list(rows["hole"][rows["status"] == "found"])
    undecided = rows["hole"][rows["status"] == "undecided"]
    return f"{text}; undecided {hole_list(undecided)}" if len(undecided) else text
