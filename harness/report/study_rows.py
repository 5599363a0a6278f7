"""Detection limits in words: the answer, and the rows of their table.

A curve says nothing of sizes that nobody inspected: what lies beyond the largest is written ``> 15.9``.
"""

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
BEYOND = "lies beyond the largest size inspected"
"""How a statement's note on an extrapolated bound reads; this page has words of its own for it."""


@dataclass(frozen=True)
class LimitRow:
    """One set-up's limits as text. ``demonstrated``, ``over_demonstrated``: whether ``a90_95`` and ``over_boards`` are
    sizes within those inspected. ``notes``: what keeps a limit from being demonstrated, or what to know beside it."""

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
    over_demonstrated: bool
    notes: tuple[str, ...]

    @property
    def why(self) -> str:
        """The notes as one sentence."""
        return "; ".join(self.notes)


def limit_rows(limits: Sequence[SetUpLimit]) -> list[LimitRow]:
    """One row for each set-up and number of frames."""
    return [_row(limit) for limit in limits]


def limit_notes(rows: Sequence[LimitRow]) -> list[str]:
    """What to know beside the limits: a line for each set-up, and first one for what all of them have in common."""
    shared = [note for note in rows[0].notes if all(note in row.notes for row in rows)] if len(rows) > 1 else []
    own = [(row.name, [note for note in row.notes if note not in shared]) for row in rows]
    every = [f"every set-up: {'; '.join(shared)}"] if shared else []
    return every + [f"{name}: {'; '.join(notes)}" for name, notes in own if notes]


def study_answer(limits: Sequence[SetUpLimit]) -> str:
    """What the study says: a sentence for each set-up, or of many the span of their limits."""
    if not limits:
        return "No set-up was inspected, so there is no answer."
    if len(limits) <= MOST_ANSWERS:
        return " ".join(limit_sentence(limit) for limit in limits)
    shown = sorted((one for one in limits if is_within_sizes(one)), key=lambda one: one.a90_95.value)
    without = len(limits) - len(shown)
    few = f"{without} of {len(limits)} set-ups demonstrate{'s' if without == 1 else ''}"
    none = f"{few} no limit within the sizes inspected" if without else ""
    if not shown:
        return (
            f"None of {len(limits)} set-ups demonstrates a limit (a90/95) within the sizes inspected"
            f"{_in_brackets(sizes_text(*limits))}."
        )
    best, worst = shown[0], shown[-1]
    span = (
        f"Of {len(limits)} set-ups, the smallest limit (a90/95) is {mm_text(best.a90_95.value)} mm "
        f"({best.record.label}), the largest {mm_text(worst.a90_95.value)} mm ({worst.record.label})"
    )
    return f"{span}; {none}." if none else f"{span}."


def is_within_sizes(limit: SetUpLimit) -> bool:
    """Whether a90/95 is demonstrated by sizes that were inspected, not by the curve beyond them."""
    return limit.a90_95.demonstrated and not limit.beyond(limit.a90_95.value)


def sizes_text(*limits: SetUpLimit) -> str:
    """``4.3 to 15.9 mm``: the diameters inspected; empty without any."""
    sizes = np.concatenate([limit.record.inspected.diameter_mm for limit in limits])
    return f"{sizes.min():.3g} to {sizes.max():.3g} mm" if len(sizes) else ""


def name_of(limit: SetUpLimit) -> str:
    """The set-up and its frames, for places where lines break."""
    return unbroken(limit.record.label)


def unbroken(text: str) -> str:
    """``text`` with numbers held to the words after them: ``0.7 m``, ``50 frames``."""
    return re.sub(r"(?<=\d) (?=[^\W\d])", "\u00a0", text)


def unmeasured(note: str) -> str:
    """A statement's note without the number of a size that nobody inspected."""
    return re.sub(r" = \S+ (?=lies (outside|beyond) the)", " ", note)


def limit_sentence(limit: SetUpLimit) -> str:
    """``50 frames: damage of 5.31 mm is found 90 % of the time with 95 % confidence (a90/95), at ...``."""
    joint = ", at " if is_within_sizes(limit) else "; "
    rate = _rate_phrase(limit.false_calls)
    return f"{limit.record.label}: {_found_phrase(limit)}{joint + rate if rate else ''}."


def bound_text(bound: Bound, most_mm: float = np.inf) -> str:
    """A bound in mm without its unit, or that there is none; beyond ``most_mm`` as `mm_text`."""
    return mm_text(bound.value, most_mm) if bound.demonstrated else NOT_DEMONSTRATED


def mm_text(value: float, most_mm: float = np.inf) -> str:
    """Two decimals below 100 mm, as many as a drill's size has; ``> 15.9`` beyond ``most_mm``, the largest size
    inspected; words where it is no size."""
    if np.isnan(value):
        return "none"
    if value > most_mm:
        return f">\u00a0{most_mm:.3g}"
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


def interval_text(interval: Interval, digits: int = 2, most: float = np.inf) -> str:
    """``4.80 to 5.62``, ``4.80 to > 15.9`` with an end beyond ``most``; ``unknown`` where there is none."""
    if not interval.known:
        return "unknown"
    return " to ".join(_number_text(end, digits, most) for end in (interval.low, interval.high))


def with_interval(value: float, interval: Interval, digits: int = 2, most: float = np.inf) -> str:
    """``5.10 (4.80 to 5.62)``; the estimate alone where the interval is unknown, or wholly beyond ``most`` as it is."""
    text = _number_text(value, digits, most)
    if not interval.known or np.isnan(value) or min(value, interval.low) > most:
        return text
    return f"{text} ({interval_text(interval, digits, most)})"


def estimate_text(limit: SetUpLimit, size_mm: float, interval: Interval) -> str:
    """a50 or a90 with its interval; ``≤ 2.05`` where everything was found, so that neither is known to be larger, and
    ``> 15.9`` beyond the sizes inspected."""
    if limit.is_at_most:
        return f"≤\u00a0{mm_text(size_mm)}"
    return with_interval(size_mm, interval, most=limit.largest_mm)


def rate_text(calls: FalseCallRate | None) -> str:
    """False calls per square metre with their exact Poisson interval."""
    return "none inspected" if calls is None else with_interval(calls.rate_per_m2, calls.interval_per_m2)


def _number_text(value: float, digits: int, most: float) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) and not value > most else mm_text(value, most)


def _in_brackets(text: str) -> str:
    return f" ({text})" if text else ""


def _row(limit: SetUpLimit) -> LimitRow:
    most_mm = limit.largest_mm
    return LimitRow(
        name=limit.record.label,
        a50=estimate_text(limit, limit.a50_mm, limit.a50_interval_mm),
        a90=estimate_text(limit, limit.a90_mm, limit.a90_interval_mm),
        a90_95=bound_text(limit.a90_95, most_mm),
        over_boards=bound_text(limit.over_boards, most_mm),
        false_calls=rate_text(limit.false_calls),
        found=_found(limit),
        targets=str(limit.targets),
        boards=str(limit.boards),
        effect=f"{limit.design_effect:.2f}" if np.isfinite(limit.design_effect) else "–",
        demonstrated=is_within_sizes(limit),
        over_demonstrated=limit.over_boards.demonstrated and not limit.beyond(limit.over_boards.value),
        notes=tuple(_beside(limit)),
    )


def _found(limit: SetUpLimit) -> str:
    """Hits, and in brackets those by each kind of finding."""
    seen, text = limit.record.inspected, f"{limit.hits} of {limit.inspections}"
    if seen.by_depth is None or seen.by_no_return is None:
        return text
    return f"{text} ({int(seen.by_depth.sum())} by depth, {int(seen.by_no_return.sum())} by missing returns)"


def _beside(limit: SetUpLimit) -> list[str]:
    """Why there is no limit, or what makes it a cautious or a doubtful one."""
    said = [] if limit.a90_95.demonstrated else [_reason(limit)]
    if limit.statement is None:
        said += [limit.a90_95.method] if limit.a90_95.demonstrated else []
    else:
        if limit.a90_95.demonstrated and not is_within_sizes(limit):
            said.append(f"a90/95 {BEYOND}, {limit.largest_mm:.3g} mm, and no inspection bears it out")
        said += [note.partition(": see --")[0] for note in limit.statement.notes if BEYOND not in note]
        said += _repeats(limit.statement, limit.largest_mm)
    if limit.boards_matter:
        effect = f"design effect {limit.design_effect:.1f}"
        said.append(f"damages of one board fare alike ({effect}): the limit over boards is the one to quote")
    only = limit.hits if limit.record.inspected.by_depth is None else int(limit.record.inspected.by_depth.sum())
    if only < limit.hits:
        said.append(f"{limit.hits - only} of {limit.hits} hits by missing returns alone: nothing came back to measure")
    if limit.record.failed:
        said.append(f"{limit.record.failed} trials failed and are missing")
    return said


def _repeats(statement: PodStatement, most_mm: float) -> list[str]:
    """The limit that repeats would give were they targets of their own, beside what they are."""
    wrong = statement.independent
    if wrong is None:
        return []
    claimed = (
        f"would be {mm_text(wrong.value, most_mm)} mm" if wrong.demonstrated else "would not be demonstrated either"
    )
    return [
        f"were every inspection a target of its own, a90/95 {claimed}: wrong, they share {statement.targets} targets"
    ]


def _reason(limit: SetUpLimit) -> str:
    return limit.a90_95.why.removeprefix(f"{NOT_DEMONSTRATED}: ")


def _found_phrase(limit: SetUpLimit) -> str:
    if not limit.a90_95.demonstrated:
        return f"a90/95 is {NOT_DEMONSTRATED}: {_in_short(_reason(limit))}"
    if not is_within_sizes(limit):
        return f"no limit (a90/95) within the sizes inspected{_in_brackets(sizes_text(limit))}"
    size, confidence = mm_text(limit.a90_95.value), f"{100 * limit.a90_95.confidence:.0f} %"
    return f"damage of {size} mm is found 90 % of the time with {confidence} confidence (a90/95)"


def _in_short(reason: str) -> str:
    """A reason without its statistics, which stand in the notes."""
    if reason.startswith("a chance that does not grow with size"):
        return "the hits do not grow clearly with diameter"
    return re.sub(r" \([^()]*[<>=][^()]*\)", "", reason)


def _rate_phrase(calls: FalseCallRate | None) -> str:
    if calls is None:
        return ""
    ends = (calls.rate_per_m2, calls.interval_per_m2.low, calls.interval_per_m2.high)
    rate, low, high = (f"{end:.2g}" if end < 99.5 else f"{end:.0f}" for end in ends)
    return f"{rate} false call{'' if rate == '1' else 's'} per m² ({low} to {high})"
