"""The detection limit of one set-up: a90/95 and what stands beside it.

The headline is the likelihood ratio bound of the hit/miss curve (`harness.evaluation.pod.statement.state_hits`), in
which damages are the independent targets. Damages of one board are not quite that; beside it stands the same bound with
its criterion multiplied by the boards' design effect (`harness.evaluation.study.over_boards`). Where the a50 of boards
scatters by 2 mm about 6 mm, a90/95 covers 88 % (60 boards) and 91 % (20), that bound 93 % and 95 %; where boards do not
matter both cover 95 to 97 %. The upper percentile of boards drawn again is no substitute: estimates of a90 are
skewed, and it covers 86 % with 20 boards and 94 % with 60 even there (300 studies,
``tests/validation/study_coverage.py``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from harness.evaluation.intervals import UNKNOWN, Interval, clopper_pearson, percentiles
from harness.evaluation.pod.curve import Bound
from harness.evaluation.pod.false_calls import FalseCallRate, false_call_rate
from harness.evaluation.pod.hit_miss import HitMissFit, fit_hit_miss
from harness.evaluation.pod.inspection_file import Inspections
from harness.evaluation.pod.likelihood_bounds import band, bound
from harness.evaluation.pod.statement import CONFIDENCE, POD, PodStatement, state_hits, state_signals
from harness.evaluation.study.over_boards import DRAWS, design_effect, refitted_sizes, row_weights, targets_of
from harness.evaluation.study.record import Inspected, SetUpRecord
from harness.evaluation.study.surface import depth_varies
from harness.vocabulary.errors import UserError

ALL_FOUND = int(np.ceil(np.log(1 - CONFIDENCE) / np.log(POD)))
"""29: with a POD below 90 % as many targets are all found in less than 5 % of studies (0.9^29 = 0.047)."""
NEAR = 0.1
"""Targets whose diameter differs by at most this share are near."""
WIDER = 1.1
"""Boards matter where the limit over boards is larger than a90/95 by more than this factor."""


@dataclass(frozen=True, eq=False)
class SetUpLimit:
    """Sizes in mm. ``statement``: curve, band and bounds from hits, None where none can be fitted, and ``why``.

    ``a90_95``: the limit to quote; infinite where not demonstrated. ``a50_mm``, ``a90_mm``: estimates;
    ``*_draws_mm`` (B,): the same of boards drawn again, in the same order for all set-ups of as many boards (infinite
    where a draw has none); ``*_interval_mm``: their 95 % percentiles. ``over_boards``: a90/95 were damages of one
    board as alike as the data say, never below ``a90_95``.
    Where everything is found both estimates are the smallest size inspected, which they do not exceed
    (``is_at_most``); where nothing is found, or the chance of detection does not grow with size, they are NaN and their
    draws infinite. Boards drawn again from boards that all fared alike do so too, which is no certainty: intervals are
    then unknown.
    ``design_effect``: variance of a90 with boards as units over that with damages as units. ``rate`` = ``hits`` /
    ``inspections`` with an interval over boards. ``false_calls`` on hole-free boards (None: none inspected) as a
    Poisson count, ``false_calls_interval_per_m2`` over boards. ``signals``: a second opinion, the signal's regression
    on size with the threshold as decision; None, and ``signals_why``, where it cannot be fitted.
    """

    record: SetUpRecord
    statement: PodStatement | None
    why: str
    a90_95: Bound
    a50_mm: float
    a90_mm: float
    a50_draws_mm: np.ndarray
    a90_draws_mm: np.ndarray
    a50_interval_mm: Interval
    a90_interval_mm: Interval
    over_boards: Bound
    design_effect: float
    boards: int
    targets: int
    hits: int
    inspections: int
    rate: float
    rate_interval: Interval
    false_calls: FalseCallRate | None
    false_calls_interval_per_m2: Interval
    signals: PodStatement | None
    signals_why: str

    @property
    def is_at_most(self) -> bool:
        """Return whether ``a50_mm`` and ``a90_mm`` are sizes that both do not exceed, everything having been found."""
        return self.statement is None and bool(np.isfinite(self.a90_mm))

    @property
    def largest_mm(self) -> float:
        """The largest diameter inspected, NaN without any. Of what lies beyond it the curve alone speaks."""
        seen = self.record.inspected.diameter_mm
        return float(seen.max()) if len(seen) else np.nan

    def beyond(self, size_mm: float) -> bool:
        """Return whether a size (an estimate, a bound or the end of an interval) lies beyond ``largest_mm``."""
        return bool(size_mm > self.largest_mm)

    @property
    def over_boards_mm(self) -> float:
        """The size of ``over_boards``."""
        return self.over_boards.value

    @property
    def boards_matter(self) -> bool:
        """Return whether the limit over boards is more than 10 % above a90/95 by a design effect: where that is
        unknown, as of boards that were all found, the number of boards is to blame and not what they have in common."""
        return bool(np.isfinite(self.design_effect) and self.over_boards_mm > WIDER * self.a90_95.value)


def limit_of(record: SetUpRecord, *, draws: int = DRAWS, noise_floor: float = np.nan) -> SetUpLimit:
    """Judge ``record``. ``noise_floor``: signals up to this are what unflawed places give too, so they enter the
    regression of signals as censored; NaN where unknown. Deterministic. No error for data without a curve: ``why``."""
    seen = record.inspected
    targets = targets_of(seen.board, seen.hole, seen.diameter_mm, seen.hit)
    statement: PodStatement | None = None
    why = "no damage was inspected"
    if len(seen.hit):
        try:
            statement, why = state_hits(_rows(record, seen.hit, np.ones(len(seen.hit), bool)), unit="mm"), ""
        except UserError as error:
            why = error.message

    effect = np.nan
    if statement is not None:
        if depth_varies(seen.depth_mm):
            low, high = seen.depth_mm.min(), seen.depth_mm.max()
            note = f"depths from {low:.3g} to {high:.3g} mm: one curve over all depths"
            statement = replace(statement, notes=(*statement.notes, note))
        a90_95, a50, a90 = statement.bound, statement.a50, statement.a90
        of_a50, of_a90 = refitted_sizes(targets, statement.curve, (0.5, POD), draws)
        fit = fit_of(record, statement)
        if not fit.separated:
            effect = design_effect(targets, statement.curve, POD)
        over_boards = bound(fit, design_effect=effect) if effect > 1 else a90_95
    elif len(seen.hit) and seen.hit.all():
        # Were the POD of the 29th smallest target below 90 %, so would those of the 28 smaller ones be, and all 29
        # would be found in less than 5 % of studies. So a90 lies below its size, with no assumption but that POD grows.
        a50 = a90 = float(targets.size_mm.min())
        a90_95 = _all_found(targets.size_mm, "targets")
        smallest = [targets.size_mm[targets.board == board].min() for board in np.unique(targets.board)]
        over_boards = _all_found(np.array(smallest), "targets, one a board")  # independent for certain
        of_a50 = of_a90 = np.full(draws, a90)
    else:
        a50 = a90 = np.nan
        a90_95 = over_boards = Bound(POD, CONFIDENCE, "likelihood ratio", np.inf, f"not demonstrated: {why}")
        of_a50 = of_a90 = np.full(draws, np.inf)

    rate_interval = UNKNOWN
    if targets.boards > 1 and targets.hits.sum() not in (0.0, targets.inspections.sum()):
        weights = row_weights(targets.board, draws)
        rate_interval = percentiles((weights @ targets.hits) / (weights @ targets.inspections))

    unflawed = record.unflawed
    area, calls_interval = float(unflawed.area_m2.sum()), UNKNOWN
    calls: FalseCallRate | None = None
    if area > 0:
        calls = false_call_rate(int(unflawed.calls.sum()), area)
        if len(np.unique(unflawed.board)) > 1 and calls.calls:
            weights = row_weights(unflawed.board, draws, "hole-free")
            with np.errstate(invalid="ignore", divide="ignore"):
                calls_interval = percentiles((weights @ unflawed.calls) / (weights @ unflawed.area_m2))

    judged = np.isfinite(seen.signal)  # where no pixel was judged there is no signal
    signals: PodStatement | None = None
    signals_why = f"{int(judged.sum())} signals"
    if judged.sum() > 2:
        decision = record.threshold
        left = None if np.isnan(noise_floor) else min(noise_floor, decision)
        try:
            read = _rows(record, seen.signal, judged)
            signals, signals_why = state_signals(read, decision=decision, left=left, unit="mm"), ""
        except UserError as error:
            signals_why = error.message
    return SetUpLimit(
        record=record,
        statement=statement,
        why=why,
        a90_95=a90_95,
        a50_mm=a50,
        a90_mm=a90,
        a50_draws_mm=of_a50,
        a90_draws_mm=of_a90,
        a50_interval_mm=UNKNOWN if statement is None else percentiles(of_a50),
        a90_interval_mm=UNKNOWN if statement is None else percentiles(of_a90),
        over_boards=over_boards,
        design_effect=effect,
        boards=targets.boards,
        targets=len(targets.board),
        hits=int(seen.hit.sum()),
        inspections=len(seen.hit),
        rate=float(seen.hit.mean()) if len(seen.hit) else np.nan,
        rate_interval=rate_interval,
        false_calls=calls,
        false_calls_interval_per_m2=calls_interval,
        signals=signals,
        signals_why=signals_why,
    )


def fit_of(record: SetUpRecord, statement: PodStatement) -> HitMissFit:
    """Fit the curve of a statement on the record's hits again, for bounds and bands at further sizes."""
    seen, curve = record.inspected, statement.curve
    names = target_names(seen)
    return fit_hit_miss(seen.diameter_mm, seen.hit, link=curve.link, log_size=curve.log_size, inspections=names)


def target_names(seen: Inspected) -> np.ndarray:
    """Name (n,) what each row inspects: repeats of one damage of one board have the same name."""
    return np.array([f"{board}:{hole}" for board, hole in zip(seen.board, seen.hole, strict=True)], dtype=str)


def _rows(record: SetUpRecord, response: np.ndarray, kept: np.ndarray) -> Inspections:
    seen = record.inspected
    names = target_names(seen)[kept]
    return Inspections(
        path=Path(record.label),
        size_column="diameter",
        response_column="hit" if response.dtype == bool else "signal",
        size=seen.diameter_mm[kept],
        response=np.asarray(response[kept], float),
        target=names if len(np.unique(names)) < len(names) else None,
        line=np.flatnonzero(kept) + 1,
    )


def _all_found(size_mm: np.ndarray, what: str) -> Bound:
    method = f"all found: binomial on the {ALL_FOUND} smallest {what}"
    if len(size_mm) >= ALL_FOUND:
        return Bound(POD, CONFIDENCE, method, float(np.sort(size_mm)[ALL_FOUND - 1]))
    reason = f"not demonstrated: all of {len(size_mm)} {what} were found, and it takes {ALL_FOUND}"
    return Bound(POD, CONFIDENCE, method, np.inf, reason)


@dataclass(frozen=True)
class SizeRow:
    """POD of one diameter: ``pod`` from the curve, ``lower`` and ``upper`` each one-sided at 95 % by the likelihood
    ratio (NaN without a curve). ``extrapolated``: the diameter lies outside the sizes inspected. ``near`` targets are
    within 10 % of it; ``near_rate`` is their share of hits, with Clopper and Pearson's ``near_interval`` (95 %,
    two-sided; repeats of a target count as shares of it): what the data say without a curve."""

    diameter_mm: float
    pod: float
    lower: float
    upper: float
    extrapolated: bool
    near: int
    near_rate: float
    near_interval: Interval


def pod_at(limit: SetUpLimit, diameters_mm: Sequence[float]) -> tuple[SizeRow, ...]:
    """State POD at given diameters, such as those of a board that one has: one row each, in the given order."""
    sizes, seen = np.asarray(diameters_mm, float), limit.record.inspected
    of_curve = np.full((3, len(sizes)), np.nan)
    if limit.statement is not None and len(sizes):
        of_curve = np.array([limit.statement.curve.pod(sizes), *band(fit_of(limit.record, limit.statement), sizes)])
    low, high = seen.diameter_mm.min(initial=np.inf), seen.diameter_mm.max(initial=-np.inf)
    names, rows = target_names(seen), []
    for size, (pod, lower, upper) in zip(sizes.tolist(), of_curve.T.tolist(), strict=True):
        near = np.abs(seen.diameter_mm / size - 1) <= NEAR
        targets = len(np.unique(names[near]))
        rate = float(seen.hit[near].mean()) if near.any() else np.nan
        ends = clopper_pearson(rate * targets if near.any() else 0, targets)
        interval = Interval(float(ends[0]), float(ends[1]))
        rows.append(SizeRow(size, pod, lower, upper, not low <= size <= high, targets, rate, interval))
    return tuple(rows)
