"""Whether a detection limit has become worse: a factor *and* a paired test, as asv judges benchmarks.

Worse is a set-up whose a90 has grown by more than `MARGIN` and by more than chance explains, or that calls falsely that
much oftener than chance explains; or that has no limit any more. The test is by Holm's step-down over both questions of
all set-ups at `ALPHA`, so a comparison of many set-ups raises no more false alarms than one of few. The margin covers
what no test here does: each set-up draws its own calibration of the threshold.

On the same boards two tests answer the question of the limit, and its p is twice the smaller one's (Bonferroni): that
of hits (`harness.evaluation.study.paired`), which is strong where the whole curve moves, and that of a90 itself
(`harness.evaluation.study.paired_swap`), which sees a curve that flattens. The second takes seconds, and is asked only
where a90 has changed by more than the margin and the first does not decide; unasked, its p is taken as 1. On other
boards the bootstrap of a90 answers (`harness.evaluation.study.paired.LimitChange`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from harness.evaluation.pod.curve import Bound
from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.paired import HitsChange, LimitChange, hits_change, limit_change
from harness.evaluation.study.paired_calls import CallsChange, calls_change
from harness.evaluation.study.paired_set_ups import Pair, differences, not_comparable, paired_set_ups
from harness.evaluation.study.paired_swap import SwapChange, swap_change
from harness.evaluation.study.record import StudyRecord

MARGIN = 1.10
"""Growth of a90, or of the rate of false calls, up to which nothing is worse (and shrinkage, nothing better)."""
ALPHA = 0.001
"""Level of a gate's tests, for a whole comparison. As low as this because each set-up's luck with the calibration of
its threshold is in no test over boards; see `harness.check` for how often the rule fails with it."""
LIMIT_TESTS = 2
"""Of hits and of a90: by so much each one's p is multiplied."""
TOSSES_PER_QUESTION, MOST_TOSSES = 5_000, 50_000
"""So many that four tosses as far out still convict one of that many questions. Of more than 50 questions, those of 25
set-ups, none is decided by the test of a90: it would take a minute for each."""

Mark = Literal[
    "worse", "better", "as good", "not significant", "newly failing", "newly working", "no limit",
    "not comparable", "only in first", "only in second",
]  # fmt: skip
SIGNS: dict[Mark, str] = {
    "worse": "+",
    "better": "-",
    "as good": " ",
    "not significant": "~",
    "newly failing": "!",
    "newly working": "*",
    "no limit": " ",
    "not comparable": "x",
    "only in first": "<",
    "only in second": ">",
}
"""asv's signs, where it has one: + is a larger number, which is worse."""


@dataclass(frozen=True, eq=False)
class ComparedSetUps:
    """One set-up of two studies. ``why``: the reason of ``mark``, in words; ``changed``: what differs between the two.

    ``swap``: the test of a90 on the same boards, None where it was not asked. ``limit_p``, ``calls_p``: adjusted p of
    (worse, better), of a90 and of false calls; 1 where there is no test.
    """

    first: SetUpLimit | None
    second: SetUpLimit | None
    changed: tuple[str, ...]
    limit: LimitChange | None
    hits: HitsChange | None
    calls: CallsChange | None
    swap: SwapChange | None = None
    limit_p: tuple[float, float] = (1.0, 1.0)
    calls_p: tuple[float, float] = (1.0, 1.0)
    mark: Mark = "as good"
    why: str = ""

    @property
    def label(self) -> str:
        """Set-up and frames, of both where they differ."""
        labels = [limit.record.label for limit in (self.first, self.second) if limit is not None]
        return " → ".join(dict.fromkeys(labels))

    def limit_test(self, side: int) -> Literal["hits", "a90", "bootstrap", ""]:
        """Which test ``limit_p[side]`` is of: the one with the smaller p; empty where there is none."""
        if self.limit is None:
            return ""
        if self.hits is None:
            return "bootstrap"
        of_a90 = 1.0 if self.swap is None else self.swap.sides[side]
        return "a90" if of_a90 < self.hits.sides[side] else "hits"

    @property
    def is_worse(self) -> bool:
        """Whether a gate fails on it."""
        return self.mark in ("worse", "newly failing")


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two studies, set-up by set-up; ``alpha``: level of the tests for all of them together."""

    first: StudyRecord
    second: StudyRecord
    rows: tuple[ComparedSetUps, ...]
    alpha: float = ALPHA

    def marked(self, *marks: Mark) -> tuple[ComparedSetUps, ...]:
        """Rows with one of these marks."""
        return tuple(row for row in self.rows if row.mark in marks)


def fewest_boards(set_ups: int, alpha: float = ALPHA) -> int:
    """Shared boards from which on the tests can convict one of so many set-ups at all: if every board is worse, one
    toss in 2^boards says as much, and that p is multiplied by the tests of a limit and by all set-ups' questions."""
    return int(np.floor(np.log2(LIMIT_TESTS * 2 * set_ups / alpha))) + 1


def compare_studies(first: StudyRecord, second: StudyRecord, alpha: float = ALPHA) -> Comparison:
    """``second`` against ``first``. Deterministic."""
    rows = [_measured(first, second, pair) for pair in paired_set_ups(first, second)]
    questions = sum(p is not None for row in rows for p in _p_values(row))
    rows = [_with_swap(row, questions, alpha) for row in rows]
    worse, better = (_adjusted(rows, side) for side in (0, 1))
    judged = []
    for row in rows:
        limits, calls = ((next(worse), next(better)) for _ in range(2))
        judged.append(_judged(replace(row, limit_p=limits, calls_p=calls), alpha))
    return Comparison(first, second, tuple(judged), alpha)


def holm(p_values: Iterable[float]) -> np.ndarray:
    """Adjusted p (n,) by Holm's step-down (1979): those below a level hold together at that level."""
    p = np.asarray(list(p_values), float)
    order = np.argsort(p, kind="stable")
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted


def _measured(first: StudyRecord, second: StudyRecord, pair: Pair) -> ComparedSetUps:
    one, other = pair
    limits = (limit_of(one) if one else None, limit_of(other) if other else None)
    if one is None or other is None or limits[0] is None or limits[1] is None:
        mark: Mark = "only in second" if one is None else "only in first"
        return ComparedSetUps(*limits, (), None, None, None, mark=mark)
    changed = differences(one, other)
    if why := not_comparable(first, second, one, other):
        return ComparedSetUps(*limits, changed, None, None, None, mark="not comparable", why=why)
    same = one.targets_digest == other.targets_digest
    return ComparedSetUps(
        *limits,
        changed,
        limit=limit_change(limits[0], limits[1], same),
        hits=hits_change(one.inspected, other.inspected) if same else None,
        calls=calls_change(one, other, first.false_calls_per_m2),
    )


def _with_swap(row: ComparedSetUps, questions: int, alpha: float) -> ComparedSetUps:
    """The row with the test of a90 where it is asked, as one of so many ``questions``."""
    if row.hits is None or row.first is None or row.second is None:
        return row
    growth = _growth(row.first, row.second)
    # Comparisons with NaN are false: without both limits there is nothing to ask.
    beyond = (growth > MARGIN, growth < 1 / MARGIN)
    if not any(beyond) or LIMIT_TESTS * questions * row.hits.sides[beyond.index(True)] < alpha:
        return row
    tosses = min(TOSSES_PER_QUESTION * questions, MOST_TOSSES) - 1
    return replace(row, swap=swap_change(row.first.record.inspected, row.second.record.inspected, tosses))


def _adjusted(rows: list[ComparedSetUps], side: int) -> Iterator[float]:
    """Adjusted p of each row's limit and false calls in turn; ``side`` 0: worse, 1: better. A question that was not
    asked is no member of the family."""
    asked = [p for row in rows for p in _p_values(row)]
    adjusted = iter(holm(p[side] for p in asked if p is not None))
    return iter([1.0 if p is None else float(next(adjusted)) for p in asked])


def _p_values(row: ComparedSetUps) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
    """(worse, better) of the limit and of false calls."""
    calls = None if row.calls is None else row.calls.sides
    if row.hits is not None:
        of_a90 = row.swap.sides if row.swap else (1.0, 1.0)
        worse, better = (min(1.0, LIMIT_TESTS * min(pair)) for pair in zip(row.hits.sides, of_a90, strict=True))
        return (worse, better), calls
    return None if row.limit is None else row.limit.sides, calls


def _judged(row: ComparedSetUps, alpha: float) -> ComparedSetUps:
    """The row with its mark. What fails comes first: a better limit does not excuse more false calls."""
    if row.limit is None or row.first is None or row.second is None:
        return row
    if why := _lost(row.first, row.second):
        return replace(row, mark="newly failing", why=why)
    growth = _growth(row.first, row.second)
    # One rule both ways: more than the margin, and not by chance.
    if growth > MARGIN and row.limit_p[0] < alpha:
        return replace(row, mark="worse", why=_grown(row.first, row.second))
    if row.calls is not None and row.calls.ratio > MARGIN and row.calls_p[0] < alpha:
        before, now = row.calls.rates_per_m2
        return replace(row, mark="worse", why=f"false calls {before:.2f} → {now:.2f} per m²")
    if np.isnan(growth):
        if why := _lost(row.second, row.first):
            return replace(row, mark="newly working", why=f"before: {why}")
        return replace(row, mark="no limit", why=row.second.why)
    if growth < 1 / MARGIN and row.limit_p[1] < alpha:
        return replace(row, mark="better", why=_grown(row.first, row.second))
    if not 1 / MARGIN <= growth <= MARGIN:
        return replace(row, mark="not significant", why=_grown(row.first, row.second))
    return row


def _lost(before: SetUpLimit, now: SetUpLimit) -> str:
    """What ``before`` had and ``now`` has not, in words; empty where nothing."""
    if now.record.failed > before.record.failed:
        return f"{now.record.failed} trials failed, {before.record.failed} before"
    if np.isfinite(before.a90_mm) and not np.isfinite(now.a90_mm):
        return f"no limit: {now.why or now.a90_95.why}"
    return ""


def _growth(first: SetUpLimit, second: SetUpLimit) -> float:
    """a90 over a90; infinite (0) where a90/95 is demonstrated no more (for the first time); NaN where a limit lacks."""
    before, now = first.a90_95.demonstrated, second.a90_95.demonstrated
    ratio = second.a90_mm / first.a90_mm
    if before == now or not np.isfinite(ratio):
        return ratio if np.isfinite(ratio) else np.nan
    return np.inf if before else 0.0


def _grown(first: SetUpLimit, second: SetUpLimit) -> str:
    before, now = first.a90_95, second.a90_95
    if before.demonstrated != now.demonstrated:
        return f"a90/95 {_bound_text(before)} → {_bound_text(now)}"
    return f"a90 {first.a90_mm:.2f} → {second.a90_mm:.2f} mm"


def _bound_text(bound: Bound) -> str:
    return f"{bound.value:.2f} mm" if bound.demonstrated else "not demonstrated"
