"""A comparison of two studies in words and numbers: cells of a table, one sentence for all, and data for programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from harness.evaluation.pod.statement import finite
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.verdict import MARGIN, SIGNS, ComparedSetUps, Comparison, Mark
from harness.tables.grid import Cell, Grid, Tone
from harness.tables.text import mm, p_value

COMPARISON_VERSION = 1
"""Of compare.json; raised when a key changes its meaning."""
HEADS = ("", "set-up", "verdict", "a90 mm", "change", "95 % mm", "a90/95 mm", "lost, won", "p", "false calls/m²", "p")
LEFT = 3
"""Columns flush left."""
SAID: tuple[Mark, ...] = ("newly failing", "newly working", "no limit", "not comparable")
"""Marks that the table does not explain by its numbers."""
TONES: Mapping[Mark, Tone] = {
    "worse": "bad",
    "newly failing": "bad",
    "only in first": "open",
    "not comparable": "open",
    "better": "good",
    "newly working": "good",
}
TESTS = (
    "Lost, won: inspections that the first alone, and the second alone, found. The p beside them is twice the smaller "
    "of two, with boards, not damages, as the units: of a sign-flip test of hits, and, where a90 has changed by more "
    f"than {100 * (MARGIN - 1):.0f} % and hits do not decide, of a test of a90 itself, for which the two results of "
    "each board are exchanged or not and both curves are fitted again; (a90) marks where that one is the smaller. It "
    "alone sees a curve that flattens: small damages won, large ones lost. Where the studies have different boards, p "
    "is of boards drawn again for each (500 draws), and below 0.002 a matter of their outermost draws. The p of false "
    "calls is of a sign-flip test where frames and threshold are the same; else it allows for the luck that each study "
    "had with the calibration of its threshold, and where the frames are the same and the thresholds are not, both "
    "tests must agree. All are one-sided, of being worse, and adjusted. 95 %: interval of the change of a90 over "
    "boards drawn again."
)


def rule(comparison: Comparison) -> str:
    """What the marks mean."""
    return (
        f"Worse (+): a90, or the rate of false calls, has grown by more than {100 * (MARGIN - 1):.0f} %, and a test "
        f"says that it is not by chance (p < {comparison.alpha:g} by Holm over all set-ups and both questions). Better "
        "(-): likewise for a90. ~: beyond that margin, but it may be chance. !: no limit any more, or more failed "
        "trials. *: a limit for the first time. x: measured with another stick. < and >: in the first, in the second "
        "study only."
    )


def answer(comparison: Comparison) -> str:
    """The comparison in one sentence."""
    rows = comparison.rows
    worse = [row for row in rows if row.is_worse]
    if worse:
        said = "; ".join(f"{row.label}: {row.why}" for row in worse[:3])
        verb = "is" if len(worse) == 1 else "are"
        return f"{len(worse)} of {len(rows)} set-ups {verb} worse. {said}{'; ...' if len(worse) > 3 else '.'}"
    counts = {mark: len(comparison.marked(mark)) for mark in SIGNS}
    return f"No set-up is worse: {', '.join(f'{n} {mark}' for mark, n in counts.items() if n) or 'there is none'}."


def cells(row: ComparedSetUps) -> tuple[str, ...]:
    """One row's cells, as many as `HEADS`."""
    return (
        SIGNS[row.mark],
        row.label,
        row.mark,
        _both(row, lambda limit: limit.a90_mm),
        _percent(row),
        _interval(row),
        _both(row, lambda limit: limit.a90_95.value),
        f"-{row.hits.only_first} +{row.hits.only_second}" if row.hits else "–",
        _limit_p(row),
        " → ".join(f"{rate:.2f}" for rate in row.calls.rates_per_m2) if row.calls else "–",
        p_value(row.calls_p[0]) if row.calls else "–",
    )


def remarks(comparison: Comparison) -> list[str]:
    """What the table leaves open: reasons of the marks in `SAID`, and what differs between the studies."""
    said = [f"{row.label}: {row.mark}, {row.why}" for row in comparison.rows if row.mark in SAID and row.why]
    differs = _changed(comparison)
    return [*said, *([f"what differs: {'; '.join(differs)}"] if differs else [])]


def comparison_grid(comparison: Comparison) -> Grid:
    """Return the table of a comparison; the colour is that of the mark."""
    rows = ([Cell(text, TONES.get(row.mark, "")) for text in cells(row)] for row in comparison.rows)
    return Grid.of(HEADS, rows, LEFT)


def comparison_parts(comparison: Comparison) -> list[str | Grid]:
    """Return what a terminal shows of a comparison: table, remarks, the answer."""
    return [comparison_grid(comparison), "", *remarks(comparison), answer(comparison)]


def compare_data(comparison: Comparison) -> dict[str, Any]:
    """The comparison as JSON's types; what is not a number is None."""
    return {
        "comparison_version": COMPARISON_VERSION,
        "first": _study(comparison.first),
        "second": _study(comparison.second),
        "rule": {"margin": MARGIN, "alpha": comparison.alpha},
        "worse": [row.label for row in comparison.rows if row.is_worse],
        "set_ups": [_row_data(row) for row in comparison.rows],
    }


def _changed(comparison: Comparison) -> list[str]:
    """What differs between the studies, each thing once, with the set-ups where it does not concern all."""
    pairs = [row for row in comparison.rows if row.first is not None and row.second is not None]
    by_change: dict[str, list[str]] = {}
    for row in pairs:
        for change in row.changed:
            by_change.setdefault(change, []).append(row.label)
    return [f"{what}" + ("" if len(at) == len(pairs) else f" ({'; '.join(at)})") for what, at in by_change.items()]


def _both(row: ComparedSetUps, size_mm: Callable[[SetUpLimit], float]) -> str:
    return " → ".join("–" if limit is None else mm(size_mm(limit)) for limit in (row.first, row.second))


def _limit_p(row: ComparedSetUps) -> str:
    test = row.limit_test(0)
    return f"{p_value(row.limit_p[0])}{' (a90)' if test == 'a90' else ''}" if test else "–"


def _percent(row: ComparedSetUps) -> str:
    """Growth of a90 in per cent; a dash where either has none."""
    return f"{100 * (row.limit.ratio - 1):+.1f} %" if row.limit and np.isfinite(row.limit.ratio) else "–"


def _interval(row: ComparedSetUps) -> str:
    if not (row.limit and np.isfinite(row.limit.ratio) and row.limit.interval_mm.known):
        return "–"
    low, high = (f"{end:+.2f}" for end in (row.limit.interval_mm.low, row.limit.interval_mm.high))
    return f"{low} to {high}".replace("inf", "∞")


def _study(study: Any) -> dict[str, Any]:
    return {"name": study.name, "digest": study.digest, "commit": study.provenance.get("commit")}


def _row_data(row: ComparedSetUps) -> dict[str, Any]:
    data: dict[str, Any] = {"set_up": row.label, "mark": row.mark, "why": row.why, "changed": list(row.changed)}
    data |= {"first": _limit_data(row.first), "second": _limit_data(row.second)}
    if row.limit is not None:
        low, high = row.limit.interval_mm.low, row.limit.interval_mm.high
        data["a90_change"] = {
            "ratio": finite(row.limit.ratio),
            "difference_mm": finite(row.limit.difference_mm),
            "interval_mm": [finite(low), finite(high)],
            "paired": row.limit.paired,
            "bootstrap_p": {"grown": row.limit.grown_p, "shrunk": row.limit.shrunk_p},
            "decides": dict(zip(("worse", "better"), row.limit_p, strict=True)),
            "decided_by": {side: row.limit_test(at) for at, side in enumerate(("worse", "better"))},
        }
    if row.swap is not None:
        data["a90_swap"] = {**vars(row.swap), "ratio": finite(row.swap.ratio)}
    if row.hits is not None:
        data["hits"] = {**vars(row.hits), "boards_p": row.hits.boards_p}
    if row.calls is not None:
        decides = dict(zip(("worse", "better"), row.calls_p, strict=True))
        data["false_calls"] = {**vars(row.calls), "ratio": finite(row.calls.ratio), "decides": decides}
    return data


def _limit_data(limit: SetUpLimit | None) -> dict[str, Any] | None:
    if limit is None:
        return None
    return {
        "detector": f"{limit.record.detector} {limit.record.detector_version}",
        "threshold": finite(limit.record.threshold),
        "failed": limit.record.failed,
        "a50_mm": finite(limit.a50_mm),
        "a90_mm": finite(limit.a90_mm),
        "a90_interval_mm": [finite(limit.a90_interval_mm.low), finite(limit.a90_interval_mm.high)],
        "a90_95_mm": finite(limit.a90_95.value),
        "hits": limit.hits,
        "inspections": limit.inspections,
        "boards": limit.boards,
        "false_calls": None if limit.false_calls is None else limit.false_calls.calls,
        "why": limit.why,
    }
