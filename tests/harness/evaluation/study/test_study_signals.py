"""a50 and a90 from signals: known truth, assumptions that do not hold, and the parts of the
variance."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import special, stats

from harness.evaluation.pod.hit_miss import fit_hit_miss
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import SetUpRecord, ThresholdError
from harness.evaluation.study.signals import (
    SATURATED,
    SignalSizes,
    _fit,
    _line,
    sandwich,
    sizes_from_signals,
)
from harness.programs.audit.studies import StudyCase, drawn_threshold, recorded
from harness.programs.gate.paired import signal_limit_change
from harness.vocabulary.seeds import random_stream

A50_MM = 6.0
SCATTER_MM = 1.2
CASE = StudyCase("signals", 1.0, boards=30)
NORMAL_90 = float(special.ndtri(0.9))


def studied(
    number: int, *, boards_mm: float = 0.0, plateau_mm: float = np.inf, shrinks: float = 0.0
) -> SetUpRecord:
    """Return a set-up whose signals grow in a straight line with normal scatter, and lie above
    noise; or to a plateau, or with scatter that ``shrinks`` with size."""
    random = random_stream(0, "test of signals", number)
    threshold = drawn_threshold(CASE, random)
    count = CASE.boards * CASE.holes
    size_mm = random.permutation(np.linspace(1.0, 14.0, count))
    shift_mm = np.repeat(boards_mm * random.standard_normal(CASE.boards), CASE.holes)
    scatter_mm = SCATTER_MM * np.exp(-shrinks * (size_mm - A50_MM)) * random.standard_normal(count)
    above_mm = np.minimum(size_mm - A50_MM, plateau_mm) - shift_mm + scatter_mm
    record = recorded(CASE, threshold, size_mm=size_mm, above_mm=above_mm, calls=np.zeros(60, int))
    floor = 2.6 + 0.2 * random.gumbel(size=count)
    return with_signal(record, np.maximum(record.inspected.signal, floor))


def with_signal(record: SetUpRecord, signal: np.ndarray) -> SetUpRecord:
    return dataclasses.replace(
        record, inspected=dataclasses.replace(record.inspected, signal=signal)
    )


def sizes(record: SetUpRecord) -> SignalSizes:
    inspected = record.inspected
    return sizes_from_signals(
        record, fit_hit_miss(inspected.size_mm, inspected.hit, link="probit", log_size=False)
    )


def test_it_covers_the_truth_and_scatters_less_than_hits():
    """In 60 studies each of boards that differ by 0 to 1 mm, 95 to 97 % cover."""
    a90_mm = A50_MM + NORMAL_90 * float(np.hypot(SCATTER_MM, 0.5))
    covers = []
    by_signals = []
    by_hits = []
    for number in range(24):
        record = studied(number, boards_mm=0.5)
        stated = sizes(record)
        if stated.why:
            continue
        interval = stated.a90_interval_mm
        covers.append(interval.low <= a90_mm <= interval.high)
        by_signals.append(stated.a90_mm - a90_mm)
        fit = fit_hit_miss(record.inspected.size_mm, record.inspected.hit, link="probit")
        by_hits.append(fit.curve.size_at(0.9) - a90_mm)
    assert len(covers) >= 21
    assert np.mean(covers) >= 0.86
    assert abs(np.mean(by_signals)) < 0.12
    assert np.var(by_signals) < 0.7 * np.var(by_hits)


def test_what_is_missed_says_nothing_but_that():
    record = studied(0)
    hit = record.inspected.hit
    fainter = with_signal(record, np.where(hit, record.inspected.signal, 0.1))
    assert sizes(fainter).a50_mm == sizes(record).a50_mm


def test_what_is_found_by_missing_returns_lies_above_the_threshold():
    record = studied(1)
    inspected = record.inspected
    saturated = inspected.signal > SATURATED * record.threshold
    without = with_signal(record, np.where(saturated, np.nan, inspected.signal))
    assert abs(sizes(without).a50_mm - sizes(record).a50_mm) < 0.05


def test_boards_that_differ_widen_the_interval_as_a_jackknife_does():
    record = studied(2, boards_mm=1.5)
    (line, *_) = sizes(record).lines
    assert not line.fit.log_size
    board = record.inspected.board
    sizes_mm = []
    for name in np.unique(board):
        kept = board != name
        columns = {
            key: column[kept]
            for key, column in vars(record.inspected).items()
            if isinstance(column, np.ndarray)
        }
        without = dataclasses.replace(record.inspected, **columns)
        lines = sizes(dataclasses.replace(record, inspected=without)).lines
        axes = {
            (candidate.fit.log_size, candidate.fit.log_signal): candidate for candidate in lines
        }
        same = axes[(line.fit.log_size, line.fit.log_signal)]
        sizes_mm.append(same.fit.curve.size_at(0.9))
    jackknife = (CASE.boards - 1) * np.var(sizes_mm)
    assert sandwich(line.influence_at(0.9)) == pytest.approx(jackknife, rel=0.2)
    of_boards = sandwich(line.influence_at(0.5))
    assert line.variance(0.5) == pytest.approx(of_boards + line.of_threshold**2)
    of_damages = line.fit.curve.covariance
    assert of_boards > 1.3 * of_damages[0, 0]


def test_boards_that_cancel_leave_the_variance_of_damages():
    """Boards' influences may be small by chance; damages are no more certain for it."""
    record = studied(2)
    (line, *_) = sizes(record).lines
    cancelled = dataclasses.replace(line, influence=1e-3 * line.influence)
    expected = line.fit.curve.covariance[0, 0] + line.of_threshold**2
    assert cancelled.variance(0.5) == pytest.approx(expected)


@pytest.mark.parametrize("log_size", [False, True])
def test_sizes_have_students_quantiles_with_a_degree_for_each_board_but_one(log_size):
    line = _line(studied(2), _fit(studied(2), log_size=log_size, log_signal=False))
    curve = line.fit.curve
    deviation = np.sqrt(line.variance(0.9))
    middle = curve.mu + NORMAL_90 * curve.sigma
    shares = (np.arange(400) + 0.5) / 400
    expected = stats.t.ppf(shares, CASE.boards - 1, loc=middle, scale=deviation)
    assert line.quantiles(0.9) == pytest.approx(np.exp(expected) if log_size else expected)


def test_on_an_axis_of_logarithms_the_thresholds_error_is_relative():
    error = ThresholdError(error=0.4, low_per_m2=0.5, high_per_m2=2.0, method="test")
    record = dataclasses.replace(studied(3), threshold_error=error)
    plain = _line(record, _fit(record, log_size=False, log_signal=False))
    logarithmic = _line(record, _fit(record, log_size=False, log_signal=True))
    assert plain.error == 0.4
    assert logarithmic.error == pytest.approx(0.4 / record.threshold)


def test_the_thresholds_error_is_error_over_slope():
    record = studied(3)
    exact = dataclasses.replace(record, threshold_error=None)
    error = ThresholdError(error=0.4, low_per_m2=0.5, high_per_m2=2.0, method="test")
    loose = dataclasses.replace(record, threshold_error=error)
    (line, *_) = sizes(exact).lines
    (same, *_) = sizes(loose).lines
    assert not line.fit.log_signal
    added = same.variance(0.9) - line.variance(0.9)
    assert added == pytest.approx((0.4 / line.fit.b1) ** 2)
    # the signal grows by 0.8 with each mm
    assert np.sqrt(added) == pytest.approx(0.5, rel=0.15)


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"plateau_mm": 3.0}, "straight line"), ({"shrinks": 0.2}, "signals")],
)
def test_an_assumption_that_does_not_hold_is_named(changes, words):
    stated = sizes(studied(4, **changes))
    assert words in stated.why
    assert not stated.lines
    assert np.isnan(stated.a90_mm)
    assert np.isnan(stated.a90_95_mm)
    assert not stated.a90_interval_mm.known


def test_hits_that_signals_do_not_decide_contradict_them():
    record = studied(5)
    inspected = record.inspected
    missed = inspected.size_mm < 9.0
    hit = inspected.hit & ~missed
    record = dataclasses.replace(record, inspected=dataclasses.replace(inspected, hit=hit))
    assert sizes(record).why


def test_without_data_it_says_so():
    record = studied(6)
    assert "no curve" in sizes_from_signals(record, None).why
    assert "several units" in sizes(dataclasses.replace(record, units=2)).why
    high = with_signal(record, np.where(record.inspected.hit, 1e3, 0.0))
    assert "0 signals lie between" in sizes(high).why


class TestChange:
    """The change of a90 from signals between two set-ups."""

    def test_weaker_signals_raise_it_and_boards_cancel(self):
        record = studied(7, boards_mm=1.5)
        weaker = record.inspected.signal - 0.8
        lost = record.inspected.hit & (weaker > record.threshold)
        inspected = dataclasses.replace(record.inspected, signal=weaker, hit=lost)
        first = limit_of(record, draws=2)
        second = limit_of(dataclasses.replace(record, inspected=inspected), draws=2)
        change = signal_limit_change(first, second)
        assert change is not None
        before_mm, now_mm = change.a90_mm
        # 0.8 for each mm; a90 itself is uncertain by 0.5
        assert now_mm - before_mm == pytest.approx(1.0, abs=0.25)
        assert change.ratio == now_mm / before_mm
        assert change.grown_p < 1e-6
        assert change.grown_p + change.shrunk_p == pytest.approx(1.0)
        backwards = signal_limit_change(second, first)
        assert backwards is not None
        assert backwards.shrunk_p == pytest.approx(change.grown_p)

    def test_errors_of_two_thresholds_count_and_of_one_do_not(self):
        record = studied(8)
        error = ThresholdError(error=0.4, low_per_m2=0.5, high_per_m2=2.0, method="test")
        record = dataclasses.replace(record, threshold_error=error)
        same = limit_of(record, draws=2)
        change = signal_limit_change(same, same)
        assert change is not None
        assert (change.ratio, change.grown_p, change.shrunk_p) == (1.0, 1.0, 1.0)
        threshold = record.threshold + 0.4
        hit = record.inspected.hit & (record.inspected.signal > threshold)
        inspected = dataclasses.replace(record.inspected, hit=hit)
        second = limit_of(
            dataclasses.replace(record, threshold=threshold, inspected=inspected), draws=2
        )
        moved = signal_limit_change(same, second)
        assert moved is not None
        assert moved.ratio > 1.03
        # one of two standard errors, with a little of the boards besides
        assert 0.2 < moved.grown_p < 0.3

    def test_it_needs_the_same_boards_and_lines(self):
        record = studied(9)
        inspected = dataclasses.replace(record.inspected, board=record.inspected.board + 1)
        second = dataclasses.replace(record, inspected=inspected)
        limit = limit_of(record, draws=2)
        assert signal_limit_change(limit, limit_of(second, draws=2)) is None
        without = dataclasses.replace(limit, from_signals=SignalSizes(why="none"))
        assert signal_limit_change(limit, without) is None
