"""Detection limits in words: the answer, and the rows of their table."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.evaluation.intervals import Interval
from harness.evaluation.pod.curve import Bound
from harness.evaluation.pod.false_calls import FalseCallRate
from harness.evaluation.pod.statement import PodStatement
from harness.evaluation.study.limit import SetUpLimit

MOST_ANSWERS = 3
"""Set-ups that the first words of a page name one by one; of more they give the span."""
NOT_DEMONSTRATED = "not demonstrated"


@dataclass(frozen=True)
class LimitRow:
    """One set-up's limits as text; ``why``: what keeps a limit from being demonstrated, or what to know beside it."""

    name: str
    a50: str
    a90: str
    a90_95: str
    over_boards: str
    false_calls: str
    found: str
    targets: str
    boards: str
    effect: str
    demonstrated: bool
    why: str


def limit_rows(limits: Sequence[SetUpLimit]) -> list[LimitRow]:
    """One row for each set-up and number of frames."""
    return [_row(limit) for limit in limits]


def study_answer(limits: Sequence[SetUpLimit]) -> str:
    """What the study says: a sentence for each set-up, or of many the span of their limits."""
    if not limits:
        return "No set-up was inspected, so there is no answer."
    if len(limits) <= MOST_ANSWERS:
        return " ".join(limit_sentence(limit) for limit in limits)
    shown = sorted((one for one in limits if one.a90_95.demonstrated), key=lambda one: one.a90_95.value)
    without = len(limits) - len(shown)
    none = f"{without} of {len(limits)} set-ups demonstrate{'s' if without == 1 else ''} no limit" if without else ""
    if not shown:
        return f"None of {len(limits)} set-ups demonstrates a limit (a90/95)."
    best, worst = shown[0], shown[-1]
    span = (
        f"Of {len(limits)} set-ups, the smallest limit (a90/95) is {mm_text(best.a90_95.value)} mm "
        f"({best.record.label}), the largest {mm_text(worst.a90_95.value)} mm ({worst.record.label})"
    )
    return f"{span}; {none}." if none else f"{span}."


def name_of(limit: SetUpLimit) -> str:
    """The set-up and its frames, for places where lines break."""
    return unbroken(limit.record.label)


def unbroken(text: str) -> str:
    """``text`` with numbers held to the words after them: ``0.7 m``, ``50 frames``."""
    return re.sub(r"(?<=\d) (?=[^\W\d])", "\u00a0", text)


def limit_sentence(limit: SetUpLimit) -> str:
    """``50 frames: damage of 5.31 mm is found 90 % of the time with 95 % confidence (a90/95), at ...``."""
    return f"{limit.record.label}: {_found_phrase(limit)}{_at_rate(limit.false_calls)}."


def bound_text(bound: Bound) -> str:
    """A bound in mm without its unit, or that there is none."""
    return mm_text(bound.value) if bound.demonstrated else NOT_DEMONSTRATED


def mm_text(value: float) -> str:
    """Two decimals below 100 mm, as many as a drill's size has; words where it is no size."""
    if np.isnan(value):
        return "none"
    if np.isinf(value):
        return "∞"
    return f"{value:.2f}" if abs(value) < 100 else f"{value:.3g}"


def percent_text(share: float) -> str:
    """``93``; beside the ends with a decimal, since a whole number would there say impossible or certain."""
    value = 100 * share
    if np.isnan(value):
        return "–"
    if 1 <= value <= 99:
        return f"{value:.0f}"
    return "< 0.1" if value < 0.05 else "> 99.9" if value > 99.95 else f"{value:.1f}"


def interval_text(interval: Interval, digits: int = 2) -> str:
    """``4.80 to 5.62``; ``unknown`` where there is none."""
    if not interval.known:
        return "unknown"
    return " to ".join(f"{end:.{digits}f}" if np.isfinite(end) else "∞" for end in (interval.low, interval.high))


def with_interval(value: float, interval: Interval, digits: int = 2) -> str:
    """``5.10 (4.80 to 5.62)``; the estimate alone where the interval is unknown."""
    text = f"{value:.{digits}f}" if np.isfinite(value) else mm_text(value)
    return f"{text} ({interval_text(interval, digits)})" if interval.known and not np.isnan(value) else text


def estimate_text(limit: SetUpLimit, size_mm: float, interval: Interval) -> str:
    """a50 or a90 with its interval; ``≤ 2.05`` where everything was found, so that neither is known to be larger."""
    return f"≤\u00a0{mm_text(size_mm)}" if limit.is_at_most else with_interval(size_mm, interval)


def rate_text(calls: FalseCallRate | None) -> str:
    """False calls per square metre with their exact Poisson interval."""
    return "none inspected" if calls is None else with_interval(calls.rate_per_m2, calls.interval_per_m2)


def _row(limit: SetUpLimit) -> LimitRow:
    return LimitRow(
        name=limit.record.label,
        a50=estimate_text(limit, limit.a50_mm, limit.a50_interval_mm),
        a90=estimate_text(limit, limit.a90_mm, limit.a90_interval_mm),
        a90_95=bound_text(limit.a90_95),
        over_boards=bound_text(limit.over_boards),
        false_calls=rate_text(limit.false_calls),
        found=f"{limit.hits} of {limit.inspections}",
        targets=str(limit.targets),
        boards=str(limit.boards),
        effect=f"{limit.design_effect:.2f}" if np.isfinite(limit.design_effect) else "–",
        demonstrated=limit.a90_95.demonstrated,
        why=_beside(limit),
    )


def _beside(limit: SetUpLimit) -> str:
    """Why there is no limit, or what makes it a cautious or a doubtful one; empty where there is nothing to add."""
    said = [] if limit.a90_95.demonstrated else [_reason(limit)]
    if limit.statement is None:
        said += [limit.a90_95.method] if limit.a90_95.demonstrated else []
    else:
        said += [note.partition(": see --")[0] for note in limit.statement.notes]
        said += _repeats(limit.statement)
    if limit.boards_matter:
        effect = f"design effect {limit.design_effect:.1f}"
        said.append(f"damages of one board fare alike ({effect}): the limit over boards is the one to quote")
    if limit.record.failed:
        said.append(f"{limit.record.failed} trials failed and are missing")
    return "; ".join(said)


def _repeats(statement: PodStatement) -> list[str]:
    """The limit that repeats would give were they targets of their own, beside what they are."""
    wrong = statement.independent
    if wrong is None:
        return []
    claimed = f"would be {mm_text(wrong.value)} mm" if wrong.demonstrated else "would not be demonstrated either"
    return [
        f"were every inspection a target of its own, a90/95 {claimed}: wrong, they share {statement.targets} targets"
    ]


def _reason(limit: SetUpLimit) -> str:
    return limit.a90_95.why.removeprefix(f"{NOT_DEMONSTRATED}: ")


def _found_phrase(limit: SetUpLimit) -> str:
    if not limit.a90_95.demonstrated:
        return f"a90/95 is {NOT_DEMONSTRATED} ({_reason(limit)})"
    size, confidence = mm_text(limit.a90_95.value), f"{100 * limit.a90_95.confidence:.0f} %"
    return f"damage of {size} mm is found 90 % of the time with {confidence} confidence (a90/95)"


def _at_rate(calls: FalseCallRate | None) -> str:
    if calls is None:
        return ""
    low, high = (f"{end:.2g}" for end in (calls.interval_per_m2.low, calls.interval_per_m2.high))
    return f", at {calls.rate_per_m2:.2g} false calls per m² ({low} to {high})"
