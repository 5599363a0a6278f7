"""The verdict whether a detection limit has become worse: a factor *and* a paired test, as asv judges benchmarks.

Worse is a set-up whose a90 has grown by more than `MARGIN` and by more than chance explains, or that calls falsely that
much oftener than chance explains; or that has no limit any more. The test is by Holm's step-down over both questions of
all set-ups at `ALPHA`, so a comparison of many set-ups raises no more false alarms than one of few. The margin covers
what no test here does: each set-up draws its own calibration of the threshold.

On the same boards two tests answer the question of the limit, and its p is twice the smaller one's (Bonferroni): that
of hits (`harness.evaluation.study.paired.hits_change`), which is strong where the whole curve moves, and that of a90
itself (`swap_change`, there), which sees a curve that flattens. The second takes seconds, and is asked only where a90
has changed by more than the margin and the first does not decide; unasked, its p is taken as 1. On other boards the
bootstrap of a90 answers (`limit_change`, there).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.paired import (
    CallsChange,
    HitsChange,
    LimitChange,
    SwapChange,
    Tails,
    calls_change,
    hits_change,
    limit_change,
    swap_change,
)
from harness.evaluation.study.record import SetUpRecord, StudyRecord
from harness.vocabulary.seeds import canonical_json

MARGIN = 1.10
"""Growth of a90, or of the rate of false calls, up to which nothing is worse (and shrinkage, nothing better)."""
ALPHA = 0.001
"""Level of a gate's tests, for a whole comparison. As low as this because each set-up's luck with the calibration of
its threshold is in no test over boards; see `harness.check` for how often the rule fails with it."""
LIMIT_TESTS = 2
"""Two tests, of hits and of a90: each p is multiplied by their number."""
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
OTHER_DAMAGE_P = 0.001
"""Boards drawn anew from one family differ by chance; less likely than this, they are taken for another family."""
Pair = tuple[SetUpRecord | None, SetUpRecord | None]


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
    limit_p: Tails = (1.0, 1.0)
    calls_p: Tails = (1.0, 1.0)
    mark: Mark = "as good"
    why: str = ""

    @property
    def label(self) -> str:
        """Set-up and frames, of both where they differ."""
        labels = [limit.record.label for limit in (self.first, self.second) if limit is not None]
        return " → ".join(dict.fromkeys(labels))

    def limit_test(self, side: int) -> Literal["hits", "a90", "bootstrap", ""]:
        """Name the test that ``limit_p[side]`` is of: the one with the smaller p; empty where there is none."""
        if self.limit is None:
            return ""
        if self.hits is None:
            return "bootstrap"
        of_a90 = 1.0 if self.swap is None else self.swap.sides[side]
        return "a90" if of_a90 < self.hits.sides[side] else "hits"

    @property
    def is_worse(self) -> bool:
        """Return whether a gate fails on it."""
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
    """Compare ``second`` with ``first``. Deterministic."""
    rows = []
    for one, other in paired_set_ups(first, second):
        limits = (limit_of(one) if one else None, limit_of(other) if other else None)
        row = ComparedSetUps(*limits, (), None, None, None, mark="only in second" if one is None else "only in first")
        if one is not None and other is not None and limits[0] is not None and limits[1] is not None:
            changed = differences(one, other)
            if why := not_comparable(first, second, one, other):
                row = replace(row, changed=changed, mark="not comparable", why=why)
            else:
                same = one.targets_digest == other.targets_digest
                row = ComparedSetUps(
                    *limits,
                    changed,
                    limit=limit_change(limits[0], limits[1], same),
                    hits=hits_change(one.inspected, other.inspected) if same else None,
                    calls=calls_change(one, other, first.false_calls_per_m2),
                )
        rows.append(row)
    questions = sum(p is not None for row in rows for p in _p_values(row))
    rows = [_with_swap(row, questions, alpha) for row in rows]
    # A question that was not asked is no member of the family.
    asked = [p for row in rows for p in _p_values(row)]
    sides = []
    for side in (0, 1):
        adjusted = iter(holm(p[side] for p in asked if p is not None))
        sides.append([1.0 if p is None else float(next(adjusted)) for p in asked])
    p = list(zip(*sides, strict=True))
    rows = [replace(row, limit_p=p[2 * k], calls_p=p[2 * k + 1]) for k, row in enumerate(rows)]
    return Comparison(first, second, tuple(_judged(row, alpha) for row in rows), alpha)


def holm(p_values: Iterable[float]) -> np.ndarray:
    """Adjusted p (n,) by Holm's step-down (1979): those below a level hold together at that level."""
    p = np.asarray(list(p_values), float)
    order = np.argsort(p, kind="stable")
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted


# set-ups of two studies


def paired_set_ups(first: StudyRecord, second: StudyRecord) -> tuple[Pair, ...]:
    """Pair set-ups by variant and frames; those left by place on the axes and frames; a single one of each is a pair.

    In the order of ``first``; what only one study has stands with None, the second's at the end.
    """
    if len(first.set_ups) == len(second.set_ups) == 1:
        return ((first.set_ups[0], second.set_ups[0]),)
    ways: tuple[Callable[[SetUpRecord], Hashable], ...] = (
        lambda one: (one.variant, one.frames),
        lambda one: (canonical_json(dict(one.axes)), one.frames),
    )
    partner: dict[int, SetUpRecord] = {}
    free = list(second.set_ups)
    for way in ways:
        for place, one in enumerate(first.set_ups):
            found = [other for other in free if way(other) == way(one)] if place not in partner else []
            if len(found) == 1:
                partner[place] = found[0]
                free.remove(found[0])
    pairs: list[Pair] = [(one, partner.get(place)) for place, one in enumerate(first.set_ups)]
    return (*pairs, *((None, one) for one in free))


def not_comparable(first: StudyRecord, second: StudyRecord, one: SetUpRecord, other: SetUpRecord) -> str:
    """Say why the two were not measured in the same way: another hit radius, wanted false calls, or damage.

    Empty where they were: another detector, camera, number of frames or noise is what is to be compared. Damage of
    other boards is compared by Kolmogorov and Smirnov's test of two samples with as many values as there are boards,
    since damages of one board may be alike: cautious where they are not.
    """
    from scipy.stats import kstwobign

    if first.hit_radius_mm != second.hit_radius_mm:
        return f"hits within {first.hit_radius_mm:g} mm there, within {second.hit_radius_mm:g} mm here"
    if first.false_calls_per_m2 != second.false_calls_per_m2:
        there, here = (
            "no stated rate of false calls" if rate is None else f"{rate:g} false calls per m²"
            for rate in (first.false_calls_per_m2, second.false_calls_per_m2)
        )
        return f"thresholds for {there} there, for {here} here"
    if bool(one.calibration_runs) != bool(other.calibration_runs):
        return "the threshold of one is calibrated, that of the other given"
    if one.targets_digest == other.targets_digest:
        return ""
    boards = [len(np.unique(record.inspected.board)) for record in (one, other)]
    if not min(boards):
        return ""
    for column, what in (("diameter_mm", "sizes"), ("depth_mm", "depths")):
        values = [np.sort(getattr(record.inspected, column)) for record in (one, other)]
        at = np.concatenate(values)
        shares = [np.searchsorted(sample, at, side="right") / len(sample) for sample in values]
        distance = float(np.abs(shares[0] - shares[1]).max())
        if kstwobign.sf(distance / np.sqrt(1 / boards[0] + 1 / boards[1])) < OTHER_DAMAGE_P:
            return f"the damage is of other {what}"
    return ""


def differences(one: SetUpRecord, other: SetUpRecord) -> tuple[str, ...]:
    """List what differs and may be the cause, in words."""
    said = []
    if (one.detector, one.detector_version) != (other.detector, other.detector_version):
        said.append(f"{one.detector} {one.detector_version} → {other.detector} {other.detector_version}")
    if one.frames != other.frames:
        said.append(f"frames {one.frames} → {other.frames}")
    for axis in sorted({*one.axes, *other.axes}):
        before, now = one.axes.get(axis, "default"), other.axes.get(axis, "default")
        if before != now:
            said.append(f"{axis} {before} → {now}")
    if one.targets_digest != other.targets_digest:
        said.append("other boards")
    elif one.frames_digest != other.frames_digest:
        said.append("other frames of the same boards")
    return tuple(said)


# the verdict on a set-up


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


def _p_values(row: ComparedSetUps) -> tuple[Tails | None, Tails | None]:
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
    """Say what ``before`` had and ``now`` has not; empty where nothing."""
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
    if before.demonstrated == now.demonstrated:
        return f"a90 {first.a90_mm:.2f} → {second.a90_mm:.2f} mm"
    there, here = (f"{one.value:.2f} mm" if one.demonstrated else "not demonstrated" for one in (before, now))
    return f"a90/95 {there} → {here}"
