"""The detection limit of one set-up: a90/95, and its bound over resampled boards.

The quoted limit is the bound of the hit/miss curves that fit about equally well, averaged
(`harness.evaluation.pod.averaged`). It takes damages as independent targets, which damages of one
board are not quite; so a second bound, and the intervals of a50 and a90, are of curves that are
shifted from board to board (`harness.evaluation.pod.clustered`). Percentiles over resampled boards
do not replace them: with few targets, flat curves or boards that differ they cover in 75 to 92 %
of studies. Resampled boards serve comparisons, in which what two set-ups share cancels.
``tofpod audit`` measures how often all of these cover."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import special

from harness.evaluation.intervals import (
    UNKNOWN,
    UPPER,
    FalseCallRate,
    Interval,
    false_call_rate,
    percentiles,
)
from harness.evaluation.pod.clustered import ClusterAverage
from harness.evaluation.pod.curve import Bound
from harness.evaluation.pod.hit_miss import METHOD
from harness.evaluation.pod.inspections import Inspections
from harness.evaluation.pod.statement import CONFIDENCE, POD, PodStatement, state_hits
from harness.evaluation.study.boards import (
    DRAWS,
    Targets,
    design_effect,
    refitted_sizes,
    size_per_error,
    targets_of,
    units_effect,
    weights_in_blocks,
)
from harness.evaluation.study.record import Inspected, SetUpRecord, Unflawed
from harness.evaluation.study.signals import SignalSizes, sizes_from_signals
from harness.evaluation.study.surface import depth_varies
from harness.evaluation.study.units import OverUnits, over_units
from harness.vocabulary.errors import UserError

ALL_FOUND = int(np.ceil(np.log(1 - CONFIDENCE) / np.log(POD)))
"""29: with a POD below 90 %, this many targets are all found in less than 5 % of studies (0.9^29 =
0.047)."""
ONE_SIDED = float(special.ndtri(CONFIDENCE))
TWO_SIDED = float(special.ndtri(UPPER))
WIDER = 1.1  # boards matter if the limit over boards exceeds a90/95 by more than this factor


@dataclass(frozen=True, eq=False)
class SetUpLimit:
    """The detection limit of one set-up, and the counts behind it.

    If everything is found, the estimates are upper bounds: the smallest size inspected. If nothing
    is, or POD does not grow with size, they are NaN and their draws infinite."""

    record: SetUpRecord
    """The inspections."""
    statement: PodStatement | None
    """Curve, band and bounds from hits; None if no curve can be fitted."""
    why: str
    """Reason why there is no curve; empty if there is one."""
    a90_95: Bound
    """The limit to quote, of diameters or depths in mm (`Inspected.limit_of`); infinite if not
    demonstrated. Of a study whose sizes were chosen, it is ``over_boards``."""
    a50_mm: float
    """Size found 50 % of the time."""
    a90_mm: float
    """Size found 90 % of the time."""
    a90_draws_mm: np.ndarray
    """``a90_mm`` (draws,) over resampled boards (and units), in one order for all set-ups with
    equally many boards."""
    a50_interval_mm: Interval
    """95 % interval of a50 over boards, units and thresholds; unknown without a curve."""
    a90_interval_mm: Interval
    """95 % interval of a90, likewise."""
    over_boards: Bound
    """a90/95 with damages of one board as alike as they are found to be."""
    design_effect: float
    """Variance of a90 with boards as units over that with damages as units; NaN if unknown."""
    boards: int
    """Number of damaged boards."""
    targets: int
    """Number of damages."""
    hits: int
    """Number of inspections that found their damage."""
    inspections: int
    """Number of inspections: damages times repeats."""
    false_calls: FalseCallRate | None
    """Findings on hole-free boards; None without such boards."""
    false_calls_interval_per_m2: Interval
    """95 % percentiles of their rate over resampled boards."""
    largest_mm: float
    """Largest size inspected; NaN if none was."""
    over_units: OverUnits | None
    """Limits over several units of the camera; None for a single unit."""
    beside: FalseCallRate | None
    """Findings on damaged boards that match no damage."""
    from_signals: SignalSizes
    """a50 and a90 from the damages' signals, to stand beside those from hits and misses."""
    size_error_mm: float = np.nan
    """Median error of the size of the hits that a model measured."""
    sized: int = 0
    """Number of these hits."""
    seconds_detect: float = np.nan
    """Median time to detect and measure damage in a cloud of a damaged board."""

    @property
    def is_at_most(self) -> bool:
        """True if everything was found, so that ``a50_mm`` and ``a90_mm`` are upper bounds."""
        return self.statement is None and bool(np.isfinite(self.a90_mm))

    def beyond(self, size_mm: float) -> bool:
        """Return whether a size lies beyond ``largest_mm``, where only the curve gives a POD."""
        return bool(size_mm > self.largest_mm)

    @property
    def boards_matter(self) -> bool:
        """Return whether the limit over boards exceeds a90/95 by more than 10 %, with a design
        effect above 1."""
        wider = self.over_boards.value > WIDER * self.a90_95.value
        return bool(self.design_effect > 1 and wider)


@dataclass(frozen=True, eq=False)
class _Sizes:
    """The fields of a `SetUpLimit` on sizes; these have the same names and meanings."""

    statement: PodStatement | None
    a90_95: Bound
    a50_mm: float
    a90_mm: float
    a90_draws_mm: np.ndarray
    over_boards: Bound
    a50_interval_mm: Interval = UNKNOWN
    a90_interval_mm: Interval = UNKNOWN
    design_effect: float = np.nan
    over_units: OverUnits | None = None


def limit_of(
    record: SetUpRecord,
    *,
    draws: int = DRAWS,
    tested: bool = False,
) -> SetUpLimit:
    """Return the limit of ``record``. ``tested``: whether to test for a floor and a ceiling, with
    a note. Deterministic. Data without a curve are not an error: ``why`` gives the reason."""
    inspected = record.inspected
    targets = targets_of(inspected.board, inspected.hole, inspected.size_mm, inspected.hit)
    statement, why = _statement(record, tested)
    if statement is not None:
        sizes = _sizes_of_curve(record, targets, statement, draws)
    elif len(inspected.hit) and inspected.hit.all():
        sizes = _sizes_if_all_found(targets, draws)
    else:
        sizes = _no_sizes(why, draws)
    hits = None if statement is None else statement.fits[0]
    false_calls, false_calls_interval = _false_calls(record.unflawed, draws, "hole-free")
    beside, _ = _false_calls(record.beside, draws, "damaged")
    return SetUpLimit(
        record=record,
        statement=sizes.statement,
        why=why,
        # chosen sizes bring more damages of each board to where POD rises, all with its own shift
        a90_95=sizes.over_boards if record.sizes_chosen else sizes.a90_95,
        a50_mm=sizes.a50_mm,
        a90_mm=sizes.a90_mm,
        a90_draws_mm=sizes.a90_draws_mm,
        a50_interval_mm=sizes.a50_interval_mm,
        a90_interval_mm=sizes.a90_interval_mm,
        over_boards=sizes.over_boards,
        design_effect=sizes.design_effect,
        boards=len(np.unique(targets.board)),
        targets=len(targets.board),
        hits=int(inspected.hit.sum()),
        inspections=len(inspected.hit),
        false_calls=false_calls,
        false_calls_interval_per_m2=false_calls_interval,
        largest_mm=float(inspected.size_mm.max()) if len(inspected.hit) else np.nan,
        over_units=sizes.over_units,
        beside=beside,
        from_signals=sizes_from_signals(record, hits),
    )


def _statement(record: SetUpRecord, tested: bool) -> tuple[PodStatement | None, str]:
    """State the curve of all hits; None, and the reason, if there is none."""
    inspected = record.inspected
    if not len(inspected.hit):
        return None, "no damage was inspected"
    try:
        statement = state_hits(_rows(record), unit="mm", tested=tested, each_test=False)
    except UserError as error:
        return None, error.message
    if inspected.limit_of == "depth" or not depth_varies(inspected.depth_mm):
        return statement, ""
    depths = f"{inspected.depth_mm.min():.3g} to {inspected.depth_mm.max():.3g} mm"
    note = f"depths from {depths}: one curve over all depths"
    return replace(statement, notes=(*statement.notes, note)), ""


def _rows(record: SetUpRecord) -> Inspections:
    """Return the inspections as a table of the library; repeats are rows of one target."""
    inspected = record.inspected
    names = target_names(inspected)
    repeated = len(np.unique(names)) < len(names)
    return Inspections(
        path=Path(record.label),
        size_column=inspected.limit_of,
        response_column="hit",
        size=inspected.size_mm,
        response=inspected.hit.astype(float),
        target=names if repeated else None,
        line=np.arange(1, len(names) + 1),
    )


def target_names(inspected: Inspected) -> np.ndarray:
    """Return a name (n,) of what each row inspects; repeats of one damage share it."""
    pairs = zip(inspected.board, inspected.hole, strict=True)
    return np.array([f"{board}:{hole}" for board, hole in pairs], dtype=str)


def _sizes_of_curve(
    record: SetUpRecord,
    targets: Targets,
    statement: PodStatement,
    draws: int,
) -> _Sizes:
    """Return the sizes of a curve."""
    inspected = record.inspected
    unit = inspected.repeat % record.units
    rows = targets
    excess = _excess(record)
    if record.units > 1 or excess is not None:
        rows = Targets(
            board=inspected.board,
            size_mm=inspected.size_mm,
            hits=inspected.hit.astype(float),
            inspections=np.ones(len(inspected.hit)),
            unit=unit if record.units > 1 else None,
            excess=excess,
            threshold=record.threshold,
        )
    (a90_draws_mm,) = np.maximum(refitted_sizes(rows, statement.curve, (POD,), draws), 0.0)
    assert statement.average is not None  # only a model that a user states has none
    clustered = ClusterAverage(statement.average, inspected.board)
    over_boards = clustered.bound(POD)
    margin = ONE_SIDED * size_per_error(rows, statement.curve, POD)
    over_boards = _with_margin(over_boards, statement.a90, margin)
    units: OverUnits | None = None
    if record.units > 1:
        units = over_units(
            size_mm=inspected.size_mm,
            hit=inspected.hit,
            target=target_names(inspected),
            unit=unit,
            curve=statement.curve,
            limit=over_boards,
        )
    return _Sizes(
        statement=statement,
        a90_95=_with_margin(statement.bound, statement.a90, margin),
        a50_mm=statement.a50,
        a90_mm=statement.a90,
        a90_draws_mm=a90_draws_mm,
        over_boards=over_boards,
        a50_interval_mm=_interval(clustered, rows, 0.5),
        a90_interval_mm=_interval(clustered, rows, POD),
        design_effect=_effect_of_boards(statement, targets),
        over_units=units,
    )


def _interval(clustered: ClusterAverage, rows: Targets, pod: float) -> Interval:
    """Return the 95 % interval of the size with this POD, wider by what units add, and joined with
    the threshold's as in `_with_margin`."""
    first = clustered.average.fits[0]
    curve = first.curve
    if rows.unit is not None and first.method == "ML":
        clustered = replace(clustered, effect=units_effect(rows, curve, pod))
    interval = clustered.interval(pod)
    estimate = curve.size_at(pod)
    margin = TWO_SIDED * size_per_error(rows, curve, pod)
    if not margin or not interval.low > 0:
        return Interval(max(interval.low, 0.0), max(interval.high, 0.0))
    below = np.hypot(np.log(estimate / interval.low), margin)
    above = np.hypot(np.log(interval.high / estimate), margin)
    return Interval(estimate * float(np.exp(-below)), estimate * float(np.exp(above)))


def _excess(record: SetUpRecord) -> np.ndarray | None:
    """Return the signals (n,) above the threshold in its standard errors, infinite for damage that
    is found by missing returns; None if the threshold has no error."""
    error = record.threshold_error
    if error is None or not error.error > 0:
        return None
    inspected = record.inspected
    excess = (np.nan_to_num(inspected.signal, nan=-np.inf) - record.threshold) / error.error
    # a hit's own finding can lie outside the radius within which the signal is taken
    excess = np.where(inspected.hit & ~(excess > 0), np.inf, excess)
    if inspected.by_no_return is None:
        return excess
    return np.where(inspected.by_no_return, np.inf, excess)


def _with_margin(bound: Bound, a90: float, margin: float) -> Bound:
    """Return a bound on a90 with the ``margin`` of its logarithm that the threshold leaves open:
    both are independent and combined as the root of the sum of squares (see `units`)."""
    if not margin or not bound.demonstrated or not 0 < a90 < bound.value:
        return bound
    of_hits = np.log(bound.value / a90)
    return replace(bound, value=a90 * float(np.exp(np.hypot(of_hits, margin))))


def _effect_of_boards(statement: PodStatement, targets: Targets) -> float:
    """Return the curve's design effect at a90; NaN for separated data."""
    if statement.fits[0].method != "ML":
        return np.nan
    return design_effect(targets, statement.curve, POD)


def _sizes_if_all_found(targets: Targets, draws: int) -> _Sizes:
    """Return the sizes if every damage was found.

    If the POD of the 29th smallest target were below 90 %, so would that of the 28 smaller ones,
    and all 29 would be found in less than 5 % of studies. So a90 lies below its size, provided
    that POD grows with size."""
    smallest_mm = float(targets.size_mm.min())
    # one damage a board: these are independent for certain
    smallest_of_boards = [
        targets.size_mm[targets.board == board].min() for board in np.unique(targets.board)
    ]
    return _Sizes(
        statement=None,
        a90_95=_all_found(targets.size_mm, "targets"),
        a50_mm=smallest_mm,
        a90_mm=smallest_mm,
        a90_draws_mm=np.full(draws, smallest_mm),
        over_boards=_all_found(np.array(smallest_of_boards), "targets, one a board"),
    )


def _all_found(size_mm: np.ndarray, noun: str) -> Bound:
    method = f"all found: binomial on the {ALL_FOUND} smallest {noun}"
    if len(size_mm) >= ALL_FOUND:
        return Bound(POD, CONFIDENCE, method, float(np.sort(size_mm)[ALL_FOUND - 1]))
    outcome = f"all of {len(size_mm)} {noun} were found"
    why = f"not demonstrated: {outcome}, but {ALL_FOUND} are needed"
    return Bound(POD, CONFIDENCE, method, np.inf, why)


def _no_sizes(why: str, draws: int) -> _Sizes:
    """Return the sizes if there is neither a curve nor a bound."""
    bound = Bound(POD, CONFIDENCE, METHOD, np.inf, f"not demonstrated: {why}")
    return _Sizes(
        statement=None,
        a90_95=bound,
        a50_mm=np.nan,
        a90_mm=np.nan,
        a90_draws_mm=np.full(draws, np.inf),
        over_boards=bound,
    )


def _false_calls(
    runs: Unflawed | None,
    draws: int,
    population: str,
) -> tuple[FalseCallRate | None, Interval]:
    """Return the rate of false calls in runs, and its interval over boards; unknown without runs
    or calls."""
    if runs is None or not len(runs.board):
        return None, UNKNOWN
    rate = false_call_rate(int(runs.calls.sum()), float(runs.area_m2.sum()))
    if not rate.calls or len(np.unique(runs.board)) < 2:
        return rate, UNKNOWN
    blocks = weights_in_blocks(draws, (runs.board, population))
    rates = [(weights @ runs.calls) / (weights @ runs.area_m2) for (weights,) in blocks]
    return rate, percentiles(np.concatenate(rates))
