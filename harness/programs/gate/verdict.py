"""The verdict whether a detection limit has become worse: a factor *and* a paired test, as asv
judges benchmarks. A set-up is worse if its a90 or its rate of false calls has grown (or its
signals over the threshold have fallen) by more than `MARGIN` and by more than chance explains, by
Holm's step-down method over the three questions of all set-ups at `ALPHA`; or if it has lost its
limit. On the same boards, the tests of hits, of a90 and, where signals contradict no assumption, of
a90 from signals decide on the limit; on other boards, the bootstrap of a90 does. See
`harness.programs.gate.paired`."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from scipy.stats import ks_2samp, kstwobign

from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.record import SetUpRecord, StudyRecord
from harness.programs.gate import paired
from harness.programs.gate.paired import Tails
from harness.vocabulary.seeds import canonical_json

# largest growth of a90, rate of false calls, or threshold over signals that is neither worse nor
# better
MARGIN = 1.10
ALPHA = 0.001
"""Level of a gate's tests, for a whole comparison. It is low because the test of hits does not
include the scatter of each set-up's calibration of the threshold; `tofpod check` says how often the
rule fails because of it."""
QUESTIONS = 3  # the questions about a set-up: its limit, false calls and signals

Mark = Literal[
    "worse", "better", "as good", "not significant", "newly failing", "newly working", "no limit",
    "not comparable", "only in first", "only in second",
]  # fmt: skip
SIGNS: dict[Mark, str] = dict(zip(get_args(Mark), "+- ~!* x<>", strict=True))
"""Signs of the marks, as in asv where it has them: + means a larger number, which is worse."""
OTHER_DAMAGE_P = 0.001
"""Boards of one family that are drawn again differ by chance; with a smaller p-value they count as
another family."""
Pair = tuple[SetUpRecord | None, SetUpRecord | None]


@dataclass(frozen=True, eq=False)
class ComparedSetUps:
    """One set-up of two studies."""

    # The first study's set-up and its limit; None if only the second has the set-up
    first: SetUpLimit | None
    # The second study's; None if only the first has the set-up
    second: SetUpLimit | None
    # Differences between the set-ups that may be the cause of a change
    changed: tuple[str, ...] = ()
    # Change of a90; None if the two are not comparable
    limit: paired.LimitChange | None = None
    # Change of a90 from signals; None on other boards, or where they are not stated
    by_signals: paired.SignalLimitChange | None = None
    # Change of hits; None on other boards
    hits: paired.HitsChange | None = None
    # Change of false calls; None without hole-free boards
    calls: paired.CallsChange | None = None
    # Change of signals; None on other boards or with another detector
    signal: paired.SignalChange | None = None
    # Adjusted p-values of the limit for (worse, better); 1 without a test
    limit_p: Tails = (1.0, 1.0)
    # Adjusted p-values of false calls for (worse, better)
    calls_p: Tails = (1.0, 1.0)
    # Adjusted p-values of signals for (worse, better)
    signal_p: Tails = (1.0, 1.0)
    # The verdict
    mark: Mark = "as good"
    # The verdict's reason; empty if it needs none
    why: str = ""

    @property
    def label(self) -> str:
        """Set-up and frames, of both if they differ."""
        labels = [limit.record.label for limit in (self.first, self.second) if limit is not None]
        return " → ".join(dict.fromkeys(labels))

    @property
    def is_worse(self) -> bool:
        """True if a gate fails on this set-up."""
        return self.mark in ("worse", "newly failing")


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two studies, set-up by set-up. ``alpha``: level of all tests together."""

    first: StudyRecord
    second: StudyRecord
    rows: tuple[ComparedSetUps, ...]
    alpha: float = ALPHA

    def marked(self, *marks: Mark) -> tuple[ComparedSetUps, ...]:
        """Return the rows with one of these marks."""
        return tuple(row for row in self.rows if row.mark in marks)


def fewest_boards(set_ups: int) -> int:
    """Return the fewest shared boards with which the tests can show that one of the set-ups is
    worse by its hits. If it is worse on every board, the p-value is 1 in 2^boards, multiplied by
    the questions of all set-ups and the limit's two tests; signals need fewer."""
    return int(np.floor(np.log2(2 * QUESTIONS * set_ups / ALPHA))) + 1


def compare_studies(first: StudyRecord, second: StudyRecord, alpha: float = ALPHA) -> Comparison:
    """Compare ``second`` with ``first``. Deterministic."""
    rows = []
    for old, new in paired_set_ups(first, second):
        if old is None or new is None:
            row = ComparedSetUps(
                limit_of(old) if old else None,
                limit_of(new) if new else None,
                mark="only in second" if old is None else "only in first",
            )
            rows.append(row)
            continue
        before = limit_of(old)
        now = limit_of(new)
        changed = differences(old, new)
        if why := not_comparable(first, second, old, new):
            rows.append(ComparedSetUps(before, now, changed, mark="not comparable", why=why))
            continue
        same = old.targets_digest == new.targets_digest
        hits = paired.hits_change(old.inspected, new.inspected) if same else None
        calls = paired.calls_change(old, new, first.false_calls_per_m2)
        signal = paired.signal_change(old, new) if same else None
        rows.append(
            ComparedSetUps(
                first=before,
                second=now,
                changed=changed,
                limit=paired.limit_change(before, now, same),
                by_signals=paired.signal_limit_change(before, now) if same else None,
                hits=hits,
                calls=calls,
                signal=signal,
            )
        )
    # only questions that were asked belong to the family of tests
    p_values = [p for row in rows for p in _p_values(row)]
    sides = []
    for side in (0, 1):
        adjusted = iter(holm(p[side] for p in p_values if p is not None))
        sides.append([1.0 if p is None else float(next(adjusted)) for p in p_values])
    worse_p, better_p = sides
    p = list(zip(worse_p, better_p, strict=True))
    judged = []
    for k, row in enumerate(rows):
        row = replace(row, limit_p=p[3 * k], calls_p=p[3 * k + 1], signal_p=p[3 * k + 2])
        mark, why = (row.mark, row.why) if row.limit is None else _verdict(row, alpha)
        judged.append(replace(row, mark=mark, why=why))
    return Comparison(first, second, tuple(judged), alpha)


def holm(p_values: Iterable[float]) -> np.ndarray:
    """Return adjusted p-values (n,) by Holm's step-down method (1979): those below a level hold
    jointly at it."""
    p = np.asarray(list(p_values), float)
    order = np.argsort(p, kind="stable")
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted


def paired_set_ups(first: StudyRecord, second: StudyRecord) -> tuple[Pair, ...]:
    """Pair set-ups by variant and frames, then the rest by place on the axes and frames; two
    single set-ups are a pair. In the order of ``first``; set-ups of only one study are paired with
    None, those of the second at the end."""
    if len(first.set_ups) == len(second.set_ups) == 1:
        return ((first.set_ups[0], second.set_ups[0]),)
    partner: dict[int, SetUpRecord] = {}
    free = list(second.set_ups)
    for by_name in (True, False):
        keys = [
            (o.variant if by_name else canonical_json(dict(o.axes)), o.frames)
            for o in (*first.set_ups, *free)
        ]
        of_free = keys[len(first.set_ups) :]
        for first_index, key in enumerate(keys[: len(first.set_ups)]):
            if first_index not in partner and of_free.count(key) == 1:
                free_index = of_free.index(key)
                partner[first_index] = free.pop(free_index)
                of_free.pop(free_index)
    pairs: list[Pair] = [
        (record, partner.get(first_index)) for first_index, record in enumerate(first.set_ups)
    ]
    return (*pairs, *((None, record) for record in free))


def not_comparable(
    first: StudyRecord, second: StudyRecord, first_set_up: SetUpRecord, second_set_up: SetUpRecord
) -> str:
    """Return why the two were not measured in the same way (hit radius, wanted false calls,
    damage), empty if they were. Damage of other boards is compared by Kolmogorov and Smirnov's
    test with the boards' number as sample size: cautious unless damages of a board are alike."""
    if first.hit_radius_mm != second.hit_radius_mm:
        return (
            f"hits within {first.hit_radius_mm:g} mm there, within {second.hit_radius_mm:g} mm here"
        )
    if first.hit_overlap != second.hit_overlap:
        return f"hits {first.hit_rule} there, {second.hit_rule} here"
    if first.false_calls_per_m2 != second.false_calls_per_m2:
        return f"thresholds for {_wanted_calls(first)} there, for {_wanted_calls(second)} here"
    if bool(first_set_up.calibration_runs) != bool(second_set_up.calibration_runs):
        return "one threshold is calibrated, the other is given"
    boards = [len(np.unique(record.inspected.board)) for record in (first_set_up, second_set_up)]
    if first_set_up.targets_digest == second_set_up.targets_digest or not min(boards):
        return ""
    for column, noun in (("diameter_mm", "sizes"), ("depth_mm", "depths")):
        first_mm = getattr(first_set_up.inspected, column)
        second_mm = getattr(second_set_up.inspected, column)
        distance = float(ks_2samp(first_mm, second_mm, method="asymp").statistic)
        if kstwobign.sf(distance / np.sqrt(1 / boards[0] + 1 / boards[1])) < OTHER_DAMAGE_P:
            return f"the damage is of other {noun}"
    return ""


def _wanted_calls(study: StudyRecord) -> str:
    rate = study.false_calls_per_m2
    return "no stated rate" if rate is None else f"{rate:g} false calls per m²"


def differences(first_set_up: SetUpRecord, second_set_up: SetUpRecord) -> tuple[str, ...]:
    """Return differences that may be the cause."""
    changes = []
    first_detector = f"{first_set_up.detector} {first_set_up.detector_version}"
    second_detector = f"{second_set_up.detector} {second_set_up.detector_version}"
    if first_detector != second_detector:
        changes.append(f"{first_detector} → {second_detector}")
    if first_set_up.frames != second_set_up.frames:
        changes.append(f"frames {first_set_up.frames} → {second_set_up.frames}")
    for axis in sorted({*first_set_up.axes, *second_set_up.axes}):
        before = first_set_up.axes.get(axis, "default")
        now = second_set_up.axes.get(axis, "default")
        if before != now:
            changes.append(f"{axis} {before} → {now}")
    if first_set_up.targets_digest != second_set_up.targets_digest:
        changes.append("other boards")
    elif first_set_up.frames_digest != second_set_up.frames_digest:
        changes.append("other frames of the same boards")
    return tuple(changes)


def _p_values(row: ComparedSetUps) -> tuple[Tails | None, Tails | None, Tails | None]:
    """Return (worse, better) p-values of the limit, of false calls and of signals."""
    calls = None if row.calls is None else (row.calls.more_p, row.calls.fewer_p)
    signal = None if row.signal is None else (row.signal.less_p, row.signal.more_p)
    if row.limit is None:
        return None, calls, signal
    tests = [(row.limit.grown_p, row.limit.shrunk_p)]
    if row.hits is not None and row.limit.paired:
        tests.append((row.hits.fewer_p, row.hits.more_p))
    if row.by_signals is not None:
        tests.append((row.by_signals.grown_p, row.by_signals.shrunk_p))
    # the best of several tests counts as often as there are tests
    worse = min(1.0, len(tests) * min(worse_p for worse_p, _ in tests))
    better = min(1.0, len(tests) * min(better_p for _, better_p in tests))
    return (worse, better), calls, signal


def _verdict(row: ComparedSetUps, alpha: float) -> tuple[Mark, str]:
    """Return mark and reason; failures come first. Growth in either direction must exceed margin
    and chance."""
    first = row.first
    second = row.second
    calls = row.calls
    assert first is not None and second is not None
    growth = _growth(first, second)
    grown = f"a90 {first.a90_mm:.2f} → {second.a90_mm:.2f} mm"
    if first.a90_95.demonstrated != second.a90_95.demonstrated:
        grown = f"a90/95 {_bound(first)} → {_bound(second)}"
    if why := _lost(first, second):
        return "newly failing", why
    margin = limit_margin(row.signal)
    if row.limit_p[0] < alpha:
        if growth > margin:
            return "worse", grown
        if row.by_signals is not None and row.by_signals.ratio > MARGIN:
            before_mm, now_mm = row.by_signals.a90_mm
            return "worse", f"a90 by signals {before_mm:.2f} → {now_mm:.2f} mm"
    if calls is not None and calls.ratio > MARGIN and row.calls_p[0] < alpha:
        calls_before, calls_now = calls.rates_per_m2
        return "worse", f"false calls {calls_before:.2f} → {calls_now:.2f} per m²"
    if row.signal is not None and row.signal.ratio < 1 / MARGIN and row.signal_p[0] < alpha:
        needed_before, needed_now = row.signal.found_from
        return (
            "worse",
            f"signals over what is needed {100 * (row.signal.ratio - 1):+.0f} % "
            f"(needed {needed_before:.3g} → {needed_now:.3g})",
        )
    if np.isnan(growth):
        why = _lost(second, first)
        return ("newly working", f"before: {why}") if why else ("no limit", second.why)
    if growth < 1 / margin and row.limit_p[1] < alpha:
        return "better", grown
    return ("as good", "") if 1 / MARGIN <= growth <= MARGIN else ("not significant", grown)


def _bound(limit: SetUpLimit) -> str:
    bound = limit.a90_95
    return f"{bound.value:.2f} mm" if bound.demonstrated else "not demonstrated"


def limit_margin(signal: paired.SignalChange | None) -> float:
    """Return the margin of a90, widened by two standard errors of the signals over the threshold,
    if known: a depth limit changes with them, and no test of hits includes the scatter of two
    calibrations."""
    return MARGIN * float(np.exp(2 * signal.error)) if signal else MARGIN


def _lost(before: SetUpLimit, now: SetUpLimit) -> str:
    """Return what ``before`` had and ``now`` lacks; empty if nothing."""
    if now.record.failed > before.record.failed:
        return f"{now.record.failed} trials failed, {before.record.failed} before"
    if np.isfinite(before.a90_mm) and not np.isfinite(now.a90_mm):
        return f"no limit: {now.why or now.a90_95.why}"
    return ""


def _growth(first: SetUpLimit, second: SetUpLimit) -> float:
    """Return the ratio of a90; infinite (0) if a90/95 is no longer (newly) demonstrated; NaN
    without a limit."""
    before = first.a90_95.demonstrated
    now = second.a90_95.demonstrated
    ratio = second.a90_mm / first.a90_mm
    if before == now or not np.isfinite(ratio):
        return ratio if np.isfinite(ratio) else np.nan
    return np.inf if before else 0.0
