"""A comparison of two studies: one table for terminal and page, one sentence for all, a figure, data for programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.pod.statement import finite
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.record import StudyRecord
from harness.evaluation.study.verdict import MARGIN, SIGNS, ComparedSetUps, Comparison, Mark
from harness.report.blocks import command_of, figure, heading, note, page
from harness.report.canvas import BLUE, GREEN, GREY, PALE, RED, svg
from harness.tables.grid import Cell, Grid, Tone
from harness.tables.limits import estimate_of
from harness.tables.text import mm, p_value

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COMPARISON_VERSION = 1
"""Version of compare.json, raised when a key changes its meaning."""
HEADS = ("", "set-up", "verdict", "a90 mm", "change", "95 % mm", "a90/95 mm", "lost, won", "p", "false calls/m²", "p")
LEFT = 3
"""Columns flush left."""
SAID: tuple[Mark, ...] = ("newly failing", "newly working", "no limit", "not comparable")
"""Marks that the table does not explain by its numbers."""
TONES: dict[Mark, Tone] = {
    "worse": "bad",
    "newly failing": "bad",
    "only in first": "open",
    "not comparable": "open",
    "better": "good",
    "newly working": "good",
}
COLOURS = {"bad": RED, "good": GREEN}
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


def compare_html(comparison: Comparison, command: str) -> str:
    """The page as text: answer, table, figure, sizes, where both come from. It needs no network."""
    names = " and ".join(dict.fromkeys((comparison.first.name, comparison.second.name)))
    origins = zip(("study", "commit", "seed"), _origin(comparison.first), _origin(comparison.second), strict=True)
    caption = (
        "Change of a90, with 95 % intervals over boards drawn again (the same for both studies where they have the "
        "same). Within the grey band nothing is worse or better."
    )
    drawn = compare_svg(comparison)
    body = [
        heading("Set-ups"),
        compare_grid(comparison).html(),
        note(rule(comparison)),
        note(TESTS),
        *([figure({"change": drawn}, "change", caption)] if drawn else []),
        heading("Sizes"),
        _sizes(comparison).html(),
        heading("Origin"),
        Grid.of(("", "first", "second"), origins, left=3).html(),
        *command_of(command),
    ]
    under = [note(f"{remark[0].upper()}{remark[1:]}.") for remark in remarks(comparison)]
    return page(f"Comparison: {names}", answer(comparison), body, under)


def compare_parts(comparison: Comparison) -> list[str | Grid]:
    """Return what a terminal shows: table, remarks, the answer."""
    return [compare_grid(comparison), "", *remarks(comparison), answer(comparison)]


def compare_grid(comparison: Comparison) -> Grid:
    """A row of cells for each set-up, under `HEADS`."""
    rows = []
    for row in comparison.rows:
        change = row.limit if row.limit and np.isfinite(row.limit.ratio) else None
        interval, test = "–", row.limit_test(0)
        if change and change.interval_mm.known:
            low, high = (f"{end:+.2f}" for end in (change.interval_mm.low, change.interval_mm.high))
            interval = f"{low} to {high}".replace("inf", "∞")
        cells = (
            SIGNS[row.mark],
            row.label,
            row.mark,
            _both(row, lambda limit: limit.a90_mm),
            f"{100 * (change.ratio - 1):+.1f} %" if change else "–",
            interval,
            _both(row, lambda limit: limit.a90_95.value),
            f"-{row.hits.only_first} +{row.hits.only_second}" if row.hits else "–",
            f"{p_value(row.limit_p[0])}{' (a90)' if test == 'a90' else ''}" if test else "–",
            " → ".join(f"{rate:.2f}" for rate in row.calls.rates_per_m2) if row.calls else "–",
            p_value(row.calls_p[0]) if row.calls else "–",
        )
        rows.append([Cell(text, TONES.get(row.mark, "")) for text in cells])
    return Grid.of(HEADS, rows, left=LEFT)


def rule(comparison: Comparison) -> str:
    """Return what the marks mean."""
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


def remarks(comparison: Comparison) -> list[str]:
    """Reasons of the marks in `SAID`, and what differs between the studies, with the set-ups where it does not concern
    all."""
    said = [f"{row.label}: {row.mark}, {row.why}" for row in comparison.rows if row.mark in SAID and row.why]
    pairs = [row for row in comparison.rows if row.first is not None and row.second is not None]
    by_change: dict[str, list[str]] = {}
    for row in pairs:
        for change in row.changed:
            by_change.setdefault(change, []).append(row.label)
    differs = [what + ("" if len(at) == len(pairs) else f" ({'; '.join(at)})") for what, at in by_change.items()]
    return [*said, *([f"what differs: {'; '.join(differs)}"] if differs else [])]


def compare_svg(comparison: Comparison) -> str:
    """One bar a set-up that both studies have: ratio of a90 and the 95 % interval; empty where there is none."""
    rows = [row for row in comparison.rows if row.limit is not None and np.isfinite(row.limit.ratio)]
    if not rows:
        return ""

    def draw(canvas: Figure) -> None:
        axes = canvas.subplots()
        axes.axvspan(1 / MARGIN, MARGIN, color=PALE, zorder=0)
        axes.axvline(1, color=GREY, lw=1)
        for place, row in enumerate(rows):
            assert row.limit is not None and row.first is not None
            before, interval = row.first.a90_mm, row.limit.interval_mm
            colour = COLOURS.get(TONES.get(row.mark, ""), BLUE)
            if interval.known:
                low = 1 + max(interval.low / before, -0.9)
                high = 1 + min(interval.high / before, 9.0)  # an open interval runs out of the picture
                axes.plot([low, high], [place, place], color=colour, lw=2, solid_capstyle="butt")
            axes.plot([row.limit.ratio], [place], "o", color=colour, ms=6)
        axes.set_yticks(range(len(rows)), [row.label for row in rows])
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlabel("a90 of the second study over a90 of the first")
        axes.grid(axis="y", visible=False)

    alt = "Ratio of a90 of the second study to the first, with 95 per cent intervals, for each set-up."
    return svg("compare", (9, 0.38 * len(rows) + 1.1), alt, draw)


def compare_data(comparison: Comparison) -> dict[str, Any]:
    """The comparison as JSON's types; what is not a number is None."""
    studies = {
        name: {"name": study.name, "digest": study.digest, "commit": study.provenance.get("commit")}
        for name, study in (("first", comparison.first), ("second", comparison.second))
    }
    return {
        "comparison_version": COMPARISON_VERSION,
        **studies,
        "rule": {"margin": MARGIN, "alpha": comparison.alpha},
        "worse": [row.label for row in comparison.rows if row.is_worse],
        "set_ups": [_row_data(row) for row in comparison.rows],
    }


def _sizes(comparison: Comparison) -> Grid:
    """a50, a90 with interval, a90/95 and hits of both."""
    heads = ("a50 mm", "a90 mm (95 %)", "a90/95 mm", "found")
    rows = []
    for row in comparison.rows:
        cells = [row.label]
        for limit in (row.first, row.second):
            cells += ["–"] * len(heads) if limit is None else [
                estimate_of(limit, limit.a50_mm).text(),
                estimate_of(limit, limit.a90_mm, limit.a90_interval_mm).text(),
                mm(limit.a90_95.value) if limit.a90_95.demonstrated else "not demonstrated",
                f"{limit.hits}/{limit.inspections}",
            ]  # fmt: skip
        rows.append(cells)
    return Grid.of(("set-up", *(f"{which}: {head}" for which in ("first", "second") for head in heads)), rows)


def _origin(study: StudyRecord) -> tuple[str, ...]:
    commit: Any = study.provenance.get("commit")
    changed = ", with changes" if study.provenance.get("dirty") else ""
    return (
        f"{study.name}, {study.digest}",
        f"{str(commit)[:12]}{changed}" if commit else "not recorded",
        str(study.provenance.get("seed", "not recorded")),
    )


def _both(row: ComparedSetUps, size_mm: Callable[[SetUpLimit], float]) -> str:
    return " → ".join("–" if limit is None else mm(size_mm(limit)) for limit in (row.first, row.second))


def _row_data(row: ComparedSetUps) -> dict[str, Any]:
    data: dict[str, Any] = {"set_up": row.label, "mark": row.mark, "why": row.why, "changed": list(row.changed)}
    data |= {"first": _limit_data(row.first), "second": _limit_data(row.second)}
    sides = ("worse", "better")
    if row.limit is not None:
        data["a90_change"] = {
            "ratio": finite(row.limit.ratio),
            "difference_mm": finite(row.limit.difference_mm),
            "interval_mm": [finite(row.limit.interval_mm.low), finite(row.limit.interval_mm.high)],
            "paired": row.limit.paired,
            "bootstrap_p": {"grown": row.limit.grown_p, "shrunk": row.limit.shrunk_p},
            "decides": dict(zip(sides, row.limit_p, strict=True)),
            "decided_by": {side: row.limit_test(at) for at, side in enumerate(sides)},
        }
    if row.swap is not None:
        data["a90_swap"] = {**vars(row.swap), "ratio": finite(row.swap.ratio)}
    if row.hits is not None:
        data["hits"] = {**vars(row.hits), "boards_p": row.hits.boards_p}
    if row.calls is not None:
        decides = dict(zip(sides, row.calls_p, strict=True))
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
