"""Presents a comparison of two studies as a table for terminal and page, as a sentence, and as
data for programs."""

from collections.abc import Callable
from typing import Any

import numpy as np

from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.record import StudyRecord
from harness.programs.gate.verdict import MARGIN, SIGNS, ComparedSetUps, Comparison, Mark
from harness.records.schema import Column, Table
from harness.report.blocks import command_of, fold, heading, note, page
from harness.vocabulary.files import jsonable
from harness.vocabulary.text import Grid, Tone, mm, p_value

COMPARISON_VERSION = 1
EXPLAINED: tuple[Mark, ...] = ("newly failing", "newly working", "no limit", "not comparable")
TONES: dict[Mark, Tone] = {
    "worse": "bad",
    "newly failing": "bad",
    "better": "good",
    "newly working": "good",
}
TONES |= {"only in first": "open", "not comparable": "open"}


def _both(row: ComparedSetUps, size_mm: Callable[[SetUpLimit], float]) -> str:
    return " → ".join(
        "–" if limit is None else mm(size_mm(limit)) for limit in (row.first, row.second)
    )


def _change(row: ComparedSetUps) -> str:
    ratio = row.limit.ratio if row.limit else np.nan
    return f"{100 * (ratio - 1):+.1f} %" if np.isfinite(ratio) else "–"


def _interval(row: ComparedSetUps) -> str:
    ends = row.limit.interval_mm if row.limit and np.isfinite(row.limit.ratio) else None
    return (
        f"{ends.low:+.2f} to {ends.high:+.2f}".replace("inf", "∞") if ends and ends.known else "–"
    )


def _tone(row: ComparedSetUps) -> Tone:
    return TONES.get(row.mark, "")


COMPARED = Table(
    "compared",
    "one row per set-up of either study",
    (
        Column("", "±", lambda row: SIGNS[row.mark], tone=_tone),
        Column("", "set-up", "label"),
        Column("", "verdict", "mark", tone=_tone),
        Column("", "a90 mm", lambda row: _both(row, lambda limit: limit.a90_mm)),
        Column("", "change", _change, tone=_tone),
        Column("", "95 % mm", _interval),
        Column("", "a90/95 mm", lambda row: _both(row, lambda limit: limit.a90_95.value)),
        Column(
            "",
            "lost, won",
            lambda row: f"-{row.hits.only_first} +{row.hits.only_second}" if row.hits else "–",
        ),
        Column("", "p", lambda row: p_value(row.limit_p[0]) if row.limit else "–"),
        Column(
            "",
            "false calls/m²",
            lambda row: (
                " → ".join(f"{rate:.2f}" for rate in row.calls.rates_per_m2) if row.calls else "–"
            ),
        ),
        Column("", "p of calls", lambda row: p_value(row.calls_p[0]) if row.calls else "–"),
        Column(
            "",
            "signal",
            lambda row: f"{100 * (row.signal.ratio - 1):+.1f} %" if row.signal else "–",
        ),
        Column("", "p of signal", lambda row: p_value(row.signal_p[0]) if row.signal else "–"),
    ),
    formats=(),
    left=3,
    kind="limits compared",
)
TESTS = (
    "Lost, won: inspections with a hit in the first study only, and in the second only. The "
    "p beside them is the smallest "
    "p-value times their number: of a sign-flip test of hits with boards (not damages) as "
    "units, of "
    "Student's t of the change of a90 over 500 draws of boards and, where signals contradict "
    "no assumption, of a90 from signals over boards and both calibrations. If the studies have "
    "different boards, it is the share "
    "of draws of a90. The p of false calls is that of a sign-flip test if frames and "
    "threshold are the same; otherwise "
    "it allows for the error of each calibration. Signal: median change of the damages' "
    "signals relative to the signal "
    "at which damage is found; its p is that of a normal test with the scatter over boards "
    "and of both calibrations. "
    "All p are one-sided (for being worse) and adjusted. 95 %: interval of the change of "
    "a90 over draws of boards."
)


def compare_html(comparison: Comparison, command: str) -> str:
    """Return the page as text: answer, table, and the origin of both studies."""
    names = " and ".join(dict.fromkeys((comparison.first.name, comparison.second.name)))
    origins = zip(
        ("study", "commit", "seed"),
        _origin(comparison.first),
        _origin(comparison.second),
        strict=True,
    )
    words = fold("Meaning of verdicts and columns", note(rule(comparison)), note(TESTS))
    body = [heading("Set-ups"), COMPARED.grid(comparison.rows).html(), words, heading("Origin")]
    body += [Grid.of(("", "first", "second"), origins, left=3).html(), *command_of(command)]
    under = [note(f"{remark[0].upper()}{remark[1:]}.") for remark in remarks(comparison)]
    return page(f"Comparison: {names}", answer(comparison), body, under)


def compare_parts(comparison: Comparison) -> list[str | Grid]:
    """Return the parts for a terminal: table, remarks and answer."""
    return [COMPARED.grid(comparison.rows), "", *remarks(comparison), answer(comparison)]


def rule(comparison: Comparison) -> str:
    """Explain the marks."""
    return (
        "Worse (+): a90, the rate of false calls, or the threshold over the signals has "
        "grown by more than "
        f"{100 * (MARGIN - 1):.0f} %, and a test shows that this is not by chance (p < "
        f"{comparison.alpha:g}, adjusted "
        "by Holm's method over all set-ups). Better (-): the opposite for a90. ~: the "
        "change exceeds that margin, but "
        "may be due to chance. !: the limit is lost, or more trials failed. *: a limit for "
        "the first time. x: not "
        "comparable. <: only in the first study. >: only in the second study."
    )


def answer(comparison: Comparison) -> str:
    """Return the comparison in one sentence."""
    rows = comparison.rows
    worse = [row for row in rows if row.is_worse]
    if worse:
        reasons = "; ".join(f"{row.label}: {row.why}" for row in worse[:3])
        verb = "is" if len(worse) == 1 else "are"
        return (
            f"{len(worse)} of {len(rows)} set-ups {verb} worse. "
            f"{reasons}{'; ...' if len(worse) > 3 else '.'}"
        )
    counts = {mark: len(comparison.marked(mark)) for mark in SIGNS}
    return (
        "No set-up is worse: "
        f"{', '.join(f'{n} {mark}' for mark, n in counts.items() if n) or 'there is none'}."
    )


def remarks(comparison: Comparison) -> list[str]:
    """Return the reasons for the marks in `EXPLAINED`, and the differences between the studies."""
    reasons = [
        f"{row.label}: {row.mark}, {row.why}"
        for row in comparison.rows
        if row.mark in EXPLAINED and row.why
    ]
    pairs = [row for row in comparison.rows if row.first is not None and row.second is not None]
    by_change: dict[str, list[str]] = {}
    for row in pairs:
        for change in row.changed:
            by_change.setdefault(change, []).append(row.label)
    differs = [
        change + ("" if len(labels) == len(pairs) else f" ({'; '.join(labels)})")
        for change, labels in by_change.items()
    ]
    return [*reasons, *([f"what differs: {'; '.join(differs)}"] if differs else [])]


def compare_data(comparison: Comparison) -> dict[str, Any]:
    """Return the comparison as JSON types; numbers that are not finite become None."""
    data: dict[str, Any] = {"comparison_version": COMPARISON_VERSION}
    for name, study in (("first", comparison.first), ("second", comparison.second)):
        data[name] = {
            "name": study.name,
            "digest": study.digest,
            "commit": study.provenance.get("commit"),
        }
    data["rule"] = {"margin": MARGIN, "alpha": comparison.alpha}
    data["worse"] = [row.label for row in comparison.rows if row.is_worse]
    return dict(jsonable(data | {"set_ups": [_row_data(row) for row in comparison.rows]}))


def _origin(study: StudyRecord) -> tuple[str, ...]:
    commit = str(study.provenance.get("commit") or "not recorded")[:12]
    changed = ", with changes" if study.provenance.get("dirty") else ""
    return (
        f"{study.name}, {study.digest}",
        commit + changed,
        str(study.provenance.get("seed", "not recorded")),
    )


def _row_data(row: ComparedSetUps) -> dict[str, Any]:
    data: dict[str, Any] = {
        "set_up": row.label,
        "mark": row.mark,
        "why": row.why,
        "changed": list(row.changed),
    }
    data |= {"first": _limit_data(row.first), "second": _limit_data(row.second)}
    sides = ("worse", "better")
    if row.limit is not None:
        data["a90_change"] = {
            "ratio": row.limit.ratio,
            "difference_mm": row.limit.difference_mm,
            "interval_mm": [row.limit.interval_mm.low, row.limit.interval_mm.high],
            "paired": row.limit.paired,
            "bootstrap_p": {"grown": row.limit.grown_p, "shrunk": row.limit.shrunk_p},
            "decides": dict(zip(sides, row.limit_p, strict=True)),
        }
    if row.by_signals is not None:
        data["a90_change_by_signals"] = vars(row.by_signals)
    if row.hits is not None:
        data["hits"] = vars(row.hits)
    if row.signal is not None:
        data["signal"] = {
            **vars(row.signal),
            "decides": dict(zip(sides, row.signal_p, strict=True)),
        }
    if row.calls is not None:
        data["false_calls"] = {
            **vars(row.calls),
            "ratio": row.calls.ratio,
            "rates_per_m2": row.calls.rates_per_m2,
        }
        data["false_calls"]["decides"] = dict(zip(sides, row.calls_p, strict=True))
    return data


def _limit_data(limit: SetUpLimit | None) -> dict[str, Any] | None:
    if limit is None:
        return None
    names = ("a50_mm", "a90_mm", "hits", "inspections", "boards", "why")
    return {**{name: getattr(limit, name) for name in names}, "a90_95_mm": limit.a90_95.value}
