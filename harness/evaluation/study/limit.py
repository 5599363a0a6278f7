"""The detection limit of one set-up: a90/95 and what stands beside it.

The headline is the likelihood ratio bound of the hit/miss curve (`harness.evaluation.pod.state_hits`), in which damages
are the independent targets. Damages of one board are not quite that; beside it stands the same bound with its criterion
multiplied by the boards' design effect (`harness.evaluation.study.over_boards`). Where the a50 of boards scatters by
2 mm about 6 mm, a90/95 covers 88 % (60 boards) and 91 % (20), that bound 93 % and 95 %; where boards do not matter both
cover 95 to 97 %. The upper percentile of boards drawn again is no substitute: estimates of a90 are skewed, and it
covers 86 % with 20 boards and 94 % with 60 even there (300 studies, ``tests/validation/study_coverage.py``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from harness.evaluation.intervals import UNKNOWN, Interval
from harness.evaluation.pod.curve import Bound
from harness.evaluation.pod.false_calls import FalseCallRate, false_call_rate
from harness.evaluation.pod.hit_miss import HitMissFit, fit_hit_miss
from harness.evaluation.pod.inspection_file import Inspections
from harness.evaluation.pod.likelihood_bounds import bound
from harness.evaluation.pod.state_hits import state_hits
from harness.evaluation.pod.state_signals import state_signals
from harness.evaluation.pod.statement import CONFIDENCE, POD, PodStatement
from harness.evaluation.study.over_boards import (
    DRAWS,
    Targets,
    design_effect,
    percentiles,
    refitted_sizes,
    row_weights,
    targets_of,
)
from harness.evaluation.study.record import Inspected, SetUpRecord, Unflawed
from harness.evaluation.study.surface import depth_varies
from harness.vocabulary.errors import UserError

ALL_FOUND = int(np.ceil(np.log(1 - CONFIDENCE) / np.log(POD)))
"""29: with a POD below 90 % as many targets are all found in less than 5 % of studies (0.9^29 = 0.047)."""
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
        """Whether ``a50_mm`` and ``a90_mm`` are sizes that both do not exceed, everything having been found."""
        return self.statement is None and bool(np.isfinite(self.a90_mm))

    @property
    def largest_mm(self) -> float:
        """The largest diameter inspected, NaN without any. Of what lies beyond it the curve alone speaks."""
        seen = self.record.inspected.diameter_mm
        return float(seen.max()) if len(seen) else np.nan

    def beyond(self, size_mm: float) -> bool:
        """Whether a size (an estimate, a bound or the end of an interval) lies beyond ``largest_mm``."""
        return bool(size_mm > self.largest_mm)

    @property
    def over_boards_mm(self) -> float:
        """The size of ``over_boards``."""
        return self.over_boards.value

    @property
    def boards_matter(self) -> bool:
        """Whether the limit over boards is more than 10 % above a90/95 by a design effect: where that is unknown, as of
        boards that were all found, the number of boards is to blame and not what they have in common."""
        return bool(np.isfinite(self.design_effect) and self.over_boards_mm > WIDER * self.a90_95.value)


def limit_of(record: SetUpRecord, *, draws: int = DRAWS, noise_floor: float = np.nan) -> SetUpLimit:
    """The limit of ``record``. ``noise_floor``: signals up to this are what unflawed places give too, so they enter the
    regression of signals as censored; NaN where unknown. Deterministic. No error for data without a curve: ``why``."""
    seen = record.inspected
    targets = targets_of(seen.board, seen.hole, seen.diameter_mm, seen.hit)
    statement, why = _statement(record)
    if statement is None:
        a90_95, estimate = _without_curve(targets, why)
        of_a50 = of_a90 = np.full(draws, np.inf if np.isnan(estimate) else estimate)
        a50, a90, effect, over_boards = estimate, estimate, np.nan, _boards_without_curve(targets, a90_95)
    else:
        a90_95, a50, a90 = statement.bound, statement.a50, statement.a90
        of_a50, of_a90 = refitted_sizes(targets, statement.curve, (0.5, POD), draws)
        fit = fit_of(record, statement)
        effect = np.nan if fit.separated else design_effect(targets, statement.curve, POD)
        over_boards = bound(fit, design_effect=effect) if effect > 1 else a90_95
    signals, signals_why = _signals(record, noise_floor)
    calls, calls_interval = _false_calls(record.unflawed, draws)
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
        rate_interval=_rate_interval(targets, draws),
        false_calls=calls,
        false_calls_interval_per_m2=calls_interval,
        signals=signals,
        signals_why=signals_why,
    )


def fit_of(record: SetUpRecord, statement: PodStatement) -> HitMissFit:
    """The fit behind a statement on the record's hits, for bounds and bands at further sizes."""
    seen, curve = record.inspected, statement.curve
    names = target_names(seen)
    return fit_hit_miss(seen.diameter_mm, seen.hit, link=curve.link, log_size=curve.log_size, inspections=names)


def target_names(seen: Inspected) -> np.ndarray:
    """(n,) what each row inspects: repeats of one damage of one board have the same name."""
    return np.array([f"{board}:{hole}" for board, hole in zip(seen.board, seen.hole, strict=True)], dtype=str)


def _statement(record: SetUpRecord) -> tuple[PodStatement | None, str]:
    seen = record.inspected
    if not len(seen.hit):
        return None, "no damage was inspected"
    try:
        stated = state_hits(_rows(record, seen.hit, np.ones(len(seen.hit), bool)), unit="mm")
    except UserError as error:
        return None, error.message
    return replace(stated, notes=(*stated.notes, *_over_depths(seen))), ""


def _over_depths(seen: Inspected) -> tuple[str, ...]:
    if not depth_varies(seen.depth_mm):
        return ()
    return (f"depths from {seen.depth_mm.min():.3g} to {seen.depth_mm.max():.3g} mm: one curve over all depths",)


def _signals(record: SetUpRecord, noise_floor: float) -> tuple[PodStatement | None, str]:
    """The regression of signals; rows where no pixel was judged have none."""
    seen, decision = record.inspected, record.threshold
    judged = np.isfinite(seen.signal)
    left = None if np.isnan(noise_floor) else min(noise_floor, decision)
    if judged.sum() < 3:
        return None, f"{int(judged.sum())} signals"
    try:
        return state_signals(_rows(record, seen.signal, judged), decision=decision, left=left, unit="mm"), ""
    except UserError as error:
        return None, error.message


def _rows(record: SetUpRecord, response: np.ndarray, kept: np.ndarray) -> Inspections:
    seen: Inspected = record.inspected
    names = target_names(seen)[kept]
    repeated = len(np.unique(names)) < len(names)
    return Inspections(
        path=Path(record.label),
        size_column="diameter",
        response_column="hit" if response.dtype == bool else "signal",
        size=seen.diameter_mm[kept],
        response=np.asarray(response[kept], float),
        target=names if repeated else None,
        line=np.flatnonzero(kept) + 1,
    )


def _without_curve(targets: Targets, why: str) -> tuple[Bound, float]:
    """The bound and the estimate where no curve can be fitted.

    All found: were the POD of the 29th smallest target below 90 %, so would those of the 28 smaller ones be, and all 29
    would be found in less than 5 % of studies. So a90 lies below its size, with no assumption but that POD grows.
    """
    found = targets.hits == targets.inspections
    if not len(found) or not found.all():
        return Bound(POD, CONFIDENCE, "likelihood ratio", np.inf, f"not demonstrated: {why}"), np.nan
    smallest = float(targets.size_mm.min())
    return _all_found(targets.size_mm, "targets"), smallest


def _all_found(size_mm: np.ndarray, what: str) -> Bound:
    method = f"all found: binomial on the {ALL_FOUND} smallest {what}"
    if len(size_mm) >= ALL_FOUND:
        return Bound(POD, CONFIDENCE, method, float(np.sort(size_mm)[ALL_FOUND - 1]))
    reason = f"not demonstrated: all of {len(size_mm)} {what} were found, and it takes {ALL_FOUND}"
    return Bound(POD, CONFIDENCE, method, np.inf, reason)


def _boards_without_curve(targets: Targets, a90_95: Bound) -> Bound:
    """Where all was found: the smallest damage of every board, one target a board and so independent for certain."""
    if not len(targets.hits) or not np.all(targets.hits == targets.inspections):
        return a90_95
    smallest = [targets.size_mm[targets.board == board].min() for board in np.unique(targets.board)]
    return _all_found(np.array(smallest), "targets, one a board")


def _rate_interval(targets: Targets, draws: int) -> Interval:
    if targets.boards < 2 or targets.hits.sum() in (0.0, targets.inspections.sum()):
        return UNKNOWN
    weights = row_weights(targets.board, draws)
    return percentiles((weights @ targets.hits) / (weights @ targets.inspections))


def _false_calls(unflawed: Unflawed, draws: int) -> tuple[FalseCallRate | None, Interval]:
    area = float(unflawed.area_m2.sum())
    if not area > 0:
        return None, UNKNOWN
    rate = false_call_rate(int(unflawed.calls.sum()), area)
    if len(np.unique(unflawed.board)) < 2 or not rate.calls:
        return rate, UNKNOWN
    weights = row_weights(unflawed.board, draws, "hole-free")
    with np.errstate(invalid="ignore", divide="ignore"):
        return rate, percentiles((weights @ unflawed.calls) / (weights @ unflawed.area_m2))
