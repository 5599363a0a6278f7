"""Each statistic of a pair of set-ups, and each edge of the verdict, worked out by hand or by
enumeration."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy import special, stats

from harness.evaluation.pod.curve import Bound
from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.record import Calibrated, Inspected, SetUpRecord, Unflawed
from harness.programs.gate.paired import (
    CallsChange,
    LimitChange,
    SignalChange,
    SignalLimitChange,
    _rank,
    _threshold_variance,
    calls_change,
    found_from,
    hits_change,
    limit_change,
    sign_flip,
    signal_change,
)
from harness.programs.gate.verdict import (
    ComparedSetUps,
    _p_values,
    _verdict,
    compare_studies,
    fewest_boards,
    limit_margin,
    not_comparable,
)
from tests.support.synthetic_study import SetUp, Study, study_record

AREA_M2 = 0.07


@cache
def a_record() -> SetUpRecord:
    return study_record(Study(boards=24, hole_free_boards=24, holes=6)).set_ups[0]


@cache
def a_limit() -> SetUpLimit:
    return limit_of(a_record(), draws=20)


def inspected_of(
    board: list[int],
    signal: list[float],
    hit: list[bool] | np.ndarray,
    **changes: Any,
) -> Inspected:
    """Inspections whose damages are numbered in order."""
    n = len(board)
    facts: dict[str, Any] = {
        "board": np.array(board),
        "hole": np.array([str(k) for k in range(n)]),
        "repeat": np.zeros(n, int),
        "diameter_mm": np.full(n, 5.0),
        "depth_mm": np.full(n, 2.0),
        "x_mm": np.zeros(n),
        "y_mm": np.zeros(n),
        "hit": np.array(hit, bool),
        "signal": np.array(signal, float),
        **changes,
    }
    return Inspected(**facts)


def record_of(inspected: Inspected, **changes: Any) -> SetUpRecord:
    return replace(a_record(), inspected=inspected, calibrated=None, **changes)


def signals(threshold: float, signal: list[float], **changes: Any) -> SetUpRecord:
    """Five damages on boards 0, 0, 1, 1, 1, found from the threshold on."""
    hit = np.array(signal) > threshold
    table = inspected_of([0, 0, 1, 1, 1], signal, hit)
    return record_of(table, threshold=threshold, **changes)


# --- hits and signs


def test_hits_on_equal_inspections_are_summed_over_boards() -> None:
    """Board 4 gains two and loses one, board 6 loses two, board 9 gains one."""
    board = [4, 4, 4, 6, 6, 9]
    before = inspected_of(board, [1.0] * 6, [False, False, True, True, True, False])
    now = inspected_of(board, [1.0] * 6, [True, True, False, False, False, True])
    change = hits_change(before, now)
    assert change is not None
    assert (change.only_first, change.only_second) == (3, 3)
    assert (change.boards, change.inspections) == (3, 6)
    # of the sums of +-1, +-2, +-1 with equal chance, 0 is observed: 5 of 8 are at most that
    assert change.fewer_p == pytest.approx(5 / 8)
    assert change.more_p == pytest.approx(5 / 8)
    fewer_p, more_p = sign_flip(np.array([3, 1]))
    assert (fewer_p, more_p) == (1.0, 0.25)


# --- limits


def limit_with(a90_mm: float, draws_mm: list[float], **changes: Any) -> SetUpLimit:
    return replace(a_limit(), a90_mm=a90_mm, a90_draws_mm=np.array(draws_mm), **changes)


def test_the_change_of_a_limit_is_judged_by_the_scatter_of_paired_draws() -> None:
    """Students' t with boards less one degrees of freedom, of the logarithm's change."""
    growth = np.array([1.1, 1.2, 1.3, 1.5])
    first = limit_with(5.0, [5.0, 5.2, 4.9, 5.1])
    second = limit_with(6.2, (growth * first.a90_draws_mm).tolist())
    change = limit_change(first, second, True)
    assert change.paired
    assert change.ratio == pytest.approx(1.24)
    assert change.difference_mm == pytest.approx(1.2)
    score = np.log(1.24) / np.log(growth).std()
    assert change.grown_p == pytest.approx(stats.t.sf(score, 23))
    assert change.shrunk_p == pytest.approx(stats.t.cdf(score, 23))
    # the percentiles of so few draws are their extremes
    assert change.interval_mm.low == pytest.approx(0.1 * 5.0)
    assert change.interval_mm.high == pytest.approx(0.5 * 5.1)


def test_draws_without_a_limit_are_counted() -> None:
    """Grown, shrunk, equal and lost: of four draws, a tie counts half, and no p-value is below
    one in five."""
    first = limit_with(5.0, [5.0, 5.0, 5.0, 5.0])
    second = limit_with(5.5, [6.0, 4.0, 5.0, np.inf])
    change = limit_change(first, second, True)
    assert change.grown_p == pytest.approx(0.8 * (1 / 4 + 1 / 8) + 0.2)
    assert change.shrunk_p == pytest.approx(0.8 * (2 / 4 + 1 / 8) + 0.2)
    lost = limit_change(limit_with(5.0, [np.inf, 5.0]), limit_with(5.0, [np.inf, 6.0]), True)
    assert lost.grown_p == pytest.approx((2 / 3) * (1 / 4) + 1 / 3)
    assert lost.shrunk_p == pytest.approx((2 / 3) * (1 / 2 + 1 / 4) + 1 / 3)


@pytest.mark.parametrize(("known", "by_deviation"), [(9, False), (10, True)])
def test_more_than_nine_of_ten_draws_are_needed_for_a_deviation(
    known: int, by_deviation: bool
) -> None:
    draws = 10 if known == 9 else 11
    ratios = np.linspace(1.1, 1.2, draws)
    ratios[known:] = np.inf
    first = limit_with(5.0, [5.0] * draws)
    change = limit_change(first, limit_with(6.0, (5.0 * ratios).tolist()), True)
    by_t = float(stats.t.sf(np.log(1.2) / np.log(ratios[:known]).std(), 23))
    assert (change.grown_p == pytest.approx(by_t)) is by_deviation
    if not by_deviation:
        assert change.grown_p == pytest.approx(1 / (1 + draws))


def test_independent_draws_are_compared_each_with_each() -> None:
    first = limit_with(5.0, [4.0, 6.0])
    second = limit_with(6.0, [5.0, 6.0, 7.0])
    for change in (limit_change(first, second, False), limit_change(first, second, True)):
        assert not change.paired
        # six differences: 1, 2, 3 and -1, 0, 1
        assert change.grown_p == pytest.approx(1 / 6 + 1 / 12)
        assert change.shrunk_p == pytest.approx(4 / 6 + 1 / 12)


# --- signals


def test_signals_are_compared_over_the_threshold_with_boards_as_units() -> None:
    """Changes of 0.1 and 0.3 on a board, 0.4 on the other: means 0.2 and 0.4, so an error of 0.1
    with one degree of freedom. Noise and a damage without a signal do not count."""
    before = [8.0, 9.0, 10.0, 1.0, np.nan]
    changes = [0.1, 0.3, 0.4, 0.2, 0.1]
    now = (np.array(before) * np.exp(changes)).tolist()
    change = signal_change(signals(4.0, before), signals(4.0, now))
    assert change is not None
    assert change.damages == 3
    assert change.ratio == pytest.approx(np.exp(0.3))
    assert change.found_from == (4.0, 4.0)
    assert change.error == pytest.approx(0.1)
    assert change.less_p == pytest.approx(stats.t.cdf(3.0, 1))
    assert change.more_p == pytest.approx(stats.t.sf(3.0, 1))


def test_a_damage_counts_if_the_mean_of_both_signals_exceeds_the_threshold() -> None:
    """Geometric means over the threshold of 1.1, 0.9, 1.1, 1.1 and 1.1; the thresholds differ."""
    means = np.array([1.1, 0.9, 1.1, 1.1, 1.1])
    half_changes = np.array([0.2, 0.2, 0.2, -0.1, -0.1])
    before = 4.0 * means * np.exp(-half_changes)
    now = 6.0 * means * np.exp(half_changes)
    change = signal_change(signals(4.0, before.tolist()), signals(6.0, now.tolist()))
    assert change is not None
    assert change.damages == 4
    # board 0 changes by 0.4, board 1 by (0.4 - 0.2 - 0.2) / 3
    assert change.error == pytest.approx(0.4 / 2)
    assert change.ratio == pytest.approx(np.exp((0.4 - 0.2) / 2))


@pytest.mark.parametrize(
    ("by", "less_p", "more_p"), [(2.0, 1.0, 0.0), (1.0, 1.0, 1.0), (0.5, 0.0, 1.0)]
)
def test_signals_that_change_without_scatter_are_certain(
    by: float, less_p: float, more_p: float
) -> None:
    change = signal_change(signals(4.0, 5 * [8.0]), signals(4.0, 5 * [by * 8.0]))
    assert change is not None
    assert change.error == 0.0
    assert (change.less_p, change.more_p) == (less_p, more_p)


def test_the_scatter_of_thresholds_and_of_effective_thresholds_adds() -> None:
    """Satterthwaite's degrees of freedom, from the variances of both calibrations; the second's
    effective threshold lies between its strongest miss and weakest hit."""
    scores = np.exp([5.0, 4.0, 3.0, 2.0, 1.0, 0.0])
    columns = np.zeros(6)
    runs = Calibrated(np.arange(6), np.zeros(6, int), scores, columns, columns)
    before = [8.0, 9.0, 10.0, 11.0, 3.0]
    first = replace(signals(4.0, before), calibrated=runs)
    table = inspected_of([0, 0, 1, 1, 1], [9.0, 12.0, 9.5, 16.0, 2.0], [True] * 4 + [False])
    second = record_of(table, threshold=11.5)
    change = signal_change(first, replace(second, calibrated=replace(runs, score=2 * scores)))
    assert change is not None
    needed = np.sqrt(2.0 * 9.0)
    assert change.found_from == pytest.approx((4.0, needed))
    changes = np.log([9.0 / 8.0, 12.0 / 9.0, 9.5 / 10.0, 16.0 / 11.0]) - np.log(needed / 4.0)
    # the fifth damage lies below the thresholds
    assert change.damages == 4
    of_boards = np.array([changes[:2].mean(), changes[2:].mean()])
    variances = np.array(
        [
            of_boards.var(ddof=1) / 2,
            _threshold_variance(first)[0],
            _threshold_variance(replace(second, calibrated=replace(runs, score=2 * scores)))[0],
            np.log(9.0 / 2.0) ** 2 / 12,
        ]
    )
    freedom = variances.sum() ** 2 / (variances[0] ** 2 / 1 + (variances[1:3] ** 2 / 1.5).sum())
    error = np.sqrt(variances.sum())
    assert change.error == pytest.approx(error)
    assert change.ratio == pytest.approx(np.exp(np.median(changes)))
    assert change.less_p == pytest.approx(stats.t.cdf(np.median(changes) / error, freedom))


def test_signals_of_one_board_or_of_two_detectors_are_not_compared() -> None:
    alone = inspected_of([0, 0], [8.0, 9.0], [True, True])
    record = record_of(alone, threshold=4.0)
    assert signal_change(record, record) is None
    pair = signals(4.0, [8.0] * 5)
    assert signal_change(pair, replace(pair, detector="another")) is None
    elsewhere = replace(pair.inspected, board=pair.inspected.board + 7)
    assert signal_change(pair, replace(pair, inspected=elsewhere)) is None


@pytest.mark.parametrize(
    ("scores", "threshold", "variance", "freedom"),
    [
        # mean excess over the fourth highest logarithm: (3 + 2 + 1) / 3
        ([5, 4, 3, 2, 1, 0], np.exp(4.0), 4 * (1 / 2 - 1 / 6), 1.5),
        ([5, 4, 3, 2, 1, 0], np.exp(4.5), 4 * (1 / 1 - 1 / 6), 1.5),
        ([5, 4, 3, 2, 1, 0], np.exp(9.0), 4 * (1 / 1 - 1 / 6), 1.5),
        ([5, 4, 3, 2, 1, 0], np.exp(-1.0), 4 / 36, 1.5),
        # five scores: two are above the median
        ([4, 3, 2, 1, 0], np.exp(3.5), 1.5**2 * (1 / 1 - 1 / 5), 1.0),
        ([4, 1], np.exp(2.0), 9 * (1 / 1 - 1 / 2), 0.5),
        ([4], np.exp(2.0), 0.0, np.inf),
    ],
)
def test_the_variance_of_a_threshold_by_hand(
    scores: list[float], threshold: float, variance: float, freedom: float
) -> None:
    n = len(scores)
    order = np.random.default_rng(1).permutation(n)
    runs = Calibrated(
        np.arange(n), np.zeros(n, int), np.exp(scores)[order], np.zeros(n), np.zeros(n)
    )
    record = replace(a_record(), calibrated=runs, threshold=threshold)
    assert _threshold_variance(record) == pytest.approx((variance, freedom))
    assert _threshold_variance(replace(record, calibrated=None)) == (0.0, np.inf)


def test_the_effective_threshold_counts_hits_by_depth_and_real_signals() -> None:
    """Hits by missing returns alone and damages without a signal do not count."""
    table = inspected_of(
        [0, 0, 1, 1, 2, 2],
        [2.0, 8.0, 9.0, 1.5, np.nan, 0.0],
        [True, True, True, False, True, True],
        by_depth=np.array([False, True, True, False, True, True]),
    )
    record = record_of(table, threshold=1.0)
    needed, variance = found_from(record)
    assert needed == pytest.approx(4.0)
    assert variance == pytest.approx(np.log(4.0) ** 2 / 12)
    assert found_from(replace(record, threshold=5.0)) == (5.0, 0.0)
    nothing = replace(table, signal=np.array([np.nan, 0.0, np.nan, 0.0, np.nan, np.nan]))
    assert np.isnan(found_from(record_of(nothing))).all()


# --- false calls


def unflawed(calls: list[int] | np.ndarray, **changes: Any) -> SetUpRecord:
    n = len(calls)
    table = Unflawed(np.arange(n), np.zeros(n, int), np.array(calls, int), np.full(n, AREA_M2))
    facts: dict[str, Any] = {"unflawed": table, "frames_digest": "a", "calibration_runs": 0}
    return replace(a_record(), **{**facts, **changes})


def beta_binomial(boards: int, rank: tuple[int, int]) -> np.ndarray:
    """Chances of 0 to ``boards`` calling boards, if the rate is drawn by the calibration."""
    calls = np.arange(boards + 1)
    logs = special.betaln(calls + rank[0], boards - calls + rank[1]) - special.betaln(*rank)
    return special.comb(boards, calls) * np.exp(logs)


def test_false_calls_are_compared_under_both_calibrations() -> None:
    """The chance of each split of four calling boards, from both Beta distributions."""
    first = unflawed([1, 0, 0, 0, 0], calibration_runs=10, frames_digest="a")
    second = unflawed([2, 0, 1, 0, 1, 0, 0], calibration_runs=20, frames_digest="b")
    wanted_per_m2 = 3.0
    quiet = np.exp(-wanted_per_m2 * AREA_M2)
    # 0.1894 of 11 scores and of 21: the second highest and the third
    assert np.floor(11 * (1 - quiet)) == 2
    assert np.floor(21 * (1 - quiet)) == 3
    of_first = beta_binomial(5, (2, 9))
    of_second = beta_binomial(7, (3, 18))
    joint = np.array([of_first[4 - k] * of_second[k] for k in range(5)])
    joint /= joint.sum()
    change = calls_change(first, second, wanted_per_m2)
    assert change is not None
    assert change.way == "calibrations"
    assert (change.calls, change.boards, change.calling) == ((1, 4), (5, 7), (1, 3))
    assert change.areas_m2 == pytest.approx((5 * AREA_M2, 7 * AREA_M2))
    assert change.more_p == pytest.approx(joint[3:].sum())
    assert change.fewer_p == pytest.approx(joint[:4].sum())
    assert change.ratio == pytest.approx((4 / 7) / (1 / 5))


def test_chances_too_small_for_a_number_still_have_p_values() -> None:
    """With 3,000 scores and one wanted call, half of the boards never call."""
    calls = np.arange(1000) < 500
    first = unflawed(calls, calibration_runs=3000, frames_digest="a")
    second = unflawed(calls, calibration_runs=3000, frames_digest="b")
    change = calls_change(first, second, None)
    assert change is not None
    assert change.more_p == pytest.approx(change.fewer_p)
    assert 0.5 < change.more_p < 0.6


def test_signs_are_those_of_the_shared_boards_sums_over_repeats() -> None:
    """Boards 3 and 7 are shared: 3 gains two calls, 7 loses one. Calling boards are counted in the
    first repeat alone."""
    board = np.array([7, 3, 7, 3, 5, 5])
    repeat = np.array([1, 1, 2, 2, 1, 2])
    first = Unflawed(board, repeat, np.array([1, 0, 1, 1, 0, 1]), np.full(6, AREA_M2))
    renamed = np.where(board == 5, 9, board)
    second = Unflawed(renamed, repeat, np.array([0, 2, 1, 1, 3, 0]), np.full(6, 2 * AREA_M2))
    change = calls_change(unflawed([], unflawed=first), unflawed([], unflawed=second), None)
    assert change is not None
    assert change.way == "signs"
    assert change.calls == (4, 7)
    assert change.boards == (3, 3)
    assert change.calling == (1, 2)
    # of the sums of +-2 and +-1, 1 is observed
    assert change.more_p == pytest.approx(2 / 4)
    assert change.fewer_p == pytest.approx(3 / 4)
    assert change.rates_per_m2 == pytest.approx((4 / (6 * AREA_M2), 7 / (12 * AREA_M2)))
    nothing = Unflawed(
        board=board[:0], repeat=repeat[:0], calls=board[:0], area_m2=first.area_m2[:0]
    )
    for empty in (first, nothing):
        pair = (unflawed([], unflawed=nothing), unflawed([], unflawed=empty))
        assert calls_change(*pair, None) is None
        assert calls_change(*pair[::-1], None) is None


def test_on_equal_frames_with_other_thresholds_the_larger_p_value_counts() -> None:
    calls = np.arange(16)
    first = unflawed(calls < 5, calibration_runs=20)
    second = unflawed(calls < 9, calibration_runs=20, threshold=1.01 * first.threshold)
    change = calls_change(first, second, 2.0)
    signs = calls_change(first, replace(second, threshold=first.threshold), 2.0)
    draws = calls_change(first, replace(second, frames_digest="b"), 2.0)
    assert change is not None and signs is not None and draws is not None
    assert (change.way, signs.way, draws.way) == ("both", "signs", "calibrations")
    assert change.more_p == max(signs.more_p, draws.more_p) == draws.more_p > signs.more_p
    assert change.fewer_p == max(signs.fewer_p, draws.fewer_p)


def test_the_ratio_of_rates_without_calls() -> None:
    def ratio(*calls: int) -> float:
        pair = (calls[0], calls[1])
        return CallsChange(pair, (2.0, 4.0), (1, 1), pair, 1.0, 1.0, "signs").ratio

    assert [ratio(1, 3), ratio(0, 1), ratio(0, 0), ratio(2, 0)] == [1.5, np.inf, 1.0, 0.0]


@pytest.mark.parametrize(
    ("runs", "quiet_share", "rank"),
    [
        (19, 0.9, (2, 18)),  # exactly the second of 20 intervals
        (20, 0.87, (2, 19)),
        (20, 0.99, (1, 20)),
        (20, 1e-9, (20, 1)),
    ],
)
def test_the_rank_of_a_threshold(runs: int, quiet_share: float, rank: tuple[int, int]) -> None:
    record = unflawed([0, 0], calibration_runs=runs)
    wanted_per_m2 = float(-np.log(quiet_share) / AREA_M2)
    assert _rank(record, wanted_per_m2) == rank
    assert _rank(record, None) == (1, runs)
    assert _rank(replace(record, calibration_runs=0), wanted_per_m2) is None


# --- the verdict


def test_the_fewest_boards_that_can_show_a_loss() -> None:
    """Of 2^13 = 8192 signs one is as bad: 6 / 8192 is below 0.001, 6 / 4096 is not."""
    for set_ups in (1, 2, 5, 40):
        boards = fewest_boards(set_ups)
        assert 2.0**-boards * 6 * set_ups < 0.001 <= 2.0 ** -(boards - 1) * 6 * set_ups


def signal_of(ratio: float, error: float = 0.0) -> SignalChange:
    return SignalChange(5, ratio, (1.0, 1.2), error, 0.5, 0.5)


def row_of(growth: float, **changes: Any) -> ComparedSetUps:
    first = replace(a_limit(), a90_mm=5.0, a90_95=Bound(0.9, 0.95, "m", 6.0))
    second = replace(first, a90_mm=5.0 * growth)
    return ComparedSetUps(first, second, **changes)


def by_signals(ratio: float) -> SignalLimitChange:
    return SignalLimitChange(ratio, (5.0, 5.0 * ratio), grown_p=0.002, shrunk_p=0.5)


SURE = (1e-4, 1e-4)
UNSURE = (0.001, 0.001)


@pytest.mark.parametrize(
    ("growth", "changes", "mark"),
    [
        (1.11, {"limit_p": SURE}, "worse"),
        (1.11, {"limit_p": UNSURE}, "not significant"),
        (1.09, {"limit_p": SURE}, "as good"),
        (1 / 1.11, {"limit_p": SURE}, "better"),
        (1 / 1.11, {"limit_p": UNSURE}, "not significant"),
        (1 / 1.09, {"limit_p": SURE}, "as good"),
        (1.11, {"limit_p": (1e-4, 1.0)}, "worse"),
        (1.11, {"limit_p": (1.0, 1e-4)}, "not significant"),
        (1 / 1.11, {"limit_p": (1e-4, 1.0)}, "not significant"),
        (1.0, {"limit_p": SURE, "by_signals": by_signals(1.11)}, "worse"),
        (1.0, {"limit_p": SURE, "by_signals": by_signals(1.09)}, "as good"),
        (1.0, {"limit_p": UNSURE, "by_signals": by_signals(1.11)}, "as good"),
        # two standard errors of 5 % widen the margin to 1.1 exp(0.1) = 1.216
        (1.21, {"limit_p": SURE, "signal": signal_of(1.0, 0.05)}, "not significant"),
        (1.22, {"limit_p": SURE, "signal": signal_of(1.0, 0.05)}, "worse"),
        (1 / 1.21, {"limit_p": SURE, "signal": signal_of(1.0, 0.05)}, "not significant"),
        (1 / 1.22, {"limit_p": SURE, "signal": signal_of(1.0, 0.05)}, "better"),
        (1.0, {"signal_p": SURE, "signal": signal_of(1 / 1.11)}, "worse"),
        (1.0, {"signal_p": UNSURE, "signal": signal_of(1 / 1.11)}, "as good"),
        (1.0, {"signal_p": SURE, "signal": signal_of(1 / 1.09)}, "as good"),
        (1.0, {"signal_p": (1.0, 1e-4), "signal": signal_of(1 / 1.11)}, "as good"),
    ],
)
def test_a_mark_needs_margin_and_significance(
    growth: float, changes: dict[str, Any], mark: str
) -> None:
    assert _verdict(row_of(growth, **changes), 0.001)[0] == mark


def test_more_false_calls_need_margin_and_significance() -> None:
    def mark(second_calls: int, p_value: float) -> tuple[str, str]:
        calls = CallsChange(
            calls=(100, second_calls),
            areas_m2=(50.0, 50.0),
            boards=(9, 9),
            calling=(9, 9),
            more_p=1.0,
            fewer_p=1.0,
            way="signs",
        )
        return _verdict(row_of(1.0, calls=calls, calls_p=(p_value, 1.0)), 0.001)

    assert mark(111, 1e-4) == ("worse", "false calls 2.00 → 2.22 per m²")
    assert mark(111, 0.001)[0] == mark(109, 1e-4)[0] == "as good"


def test_a_bound_that_is_lost_grows_without_limit_and_the_way_back_shrinks() -> None:
    row = row_of(1.05, limit_p=SURE)
    assert row.second is not None
    lost = replace(row.second, a90_95=Bound(0.9, 0.95, "m", np.inf, "why"))
    assert _verdict(replace(row, second=lost), 0.001) == (
        "worse",
        "a90/95 6.00 mm → not demonstrated",
    )
    back = replace(row, first=lost, second=row.first)
    assert _verdict(back, 0.001) == ("better", "a90/95 not demonstrated → 6.00 mm")


def test_the_margin_widens_with_the_error_of_signals() -> None:
    assert limit_margin(None) == 1.1
    assert limit_margin(signal_of(1.0, 0.1)) == pytest.approx(1.1 * np.exp(0.2))


def test_the_best_of_several_tests_of_a_limit_counts_as_often() -> None:
    limit = limit_change(a_limit(), a_limit(), True)
    limit = replace(limit, grown_p=0.2, shrunk_p=0.03)
    hits = hits_change(a_record().inspected, a_record().inspected)
    assert hits is not None
    hits = replace(hits, fewer_p=0.01, more_p=0.7)

    def of_limit(limit: LimitChange, **changes: Any) -> tuple[float, float]:
        p_values = _p_values(row_of(1.0, limit=limit, **changes))
        assert p_values[1:] == (None, None)
        assert p_values[0] is not None
        return p_values[0]

    assert of_limit(limit) == (0.2, 0.03)
    assert of_limit(limit, hits=hits) == pytest.approx((0.02, 0.06))
    assert of_limit(replace(limit, paired=False), hits=hits) == (0.2, 0.03)
    three = of_limit(limit, hits=hits, by_signals=by_signals(1.2))
    assert three == pytest.approx((0.006, 0.09))
    assert of_limit(replace(limit, grown_p=0.9), hits=replace(hits, fewer_p=0.8))[0] == 1.0
    signal = replace(signal_of(1.0), less_p=0.1, more_p=0.6)
    assert _p_values(row_of(1.0, signal=signal)) == (None, None, (0.1, 0.6))


def test_pairs_that_cannot_be_compared_keep_their_order() -> None:
    first = study_record(Study((SetUp(a50_mm=5.0),), boards=12, hole_free_boards=4))
    second = study_record(Study((SetUp(a50_mm=7.0),), boards=12, hole_free_boards=4))
    (row,) = compare_studies(first, replace(second, hit_radius_mm=3.0)).rows
    assert row.mark == "not comparable"
    assert row.first is not None and row.second is not None
    assert row.first.record is first.set_ups[0]
    assert row.second.record is second.set_ups[0]
    untested = ComparedSetUps(row.first, row.second)
    assert untested.limit_p == untested.calls_p == untested.signal_p == (1.0, 1.0)


@pytest.mark.parametrize(
    ("boards", "alike"),
    [
        # Kolmogorov: P(K > 1.9495) = 0.001, times sqrt(1 / n1 + 1 / n2)
        ((20, 20), 1.9495 * np.sqrt(1 / 20 + 1 / 20)),
        ((20, 10), 1.9495 * np.sqrt(1 / 20 + 1 / 10)),
    ],
)
def test_damage_counts_as_other_by_kolmogorov_and_smirnov_over_boards(
    boards: tuple[int, int], alike: float
) -> None:
    """Of 200 damages, a share is replaced by larger ones: that share is the distance."""
    study = study_record()
    for moved, differs in ((alike - 0.02, False), (alike + 0.02, True)):
        sizes_mm = np.linspace(1.0, 2.0, 200)
        larger_mm = sizes_mm + np.where(np.arange(200) < round(200 * moved), 5.0, 0.0)
        for column, noun in (("diameter_mm", "sizes"), ("depth_mm", "depths")):
            first, second = [
                record_of(
                    inspected_of(
                        (np.arange(200) % count).tolist(),
                        [1.0] * 200,
                        [True] * 200,
                        **{column: column_mm},
                    ),
                    targets_digest=f"{count} {column_mm[0]}",
                )
                for count, column_mm in zip(boards, (sizes_mm, larger_mm), strict=True)
            ]
            why = not_comparable(study, study, first, second)
            assert why == (f"the damage is of other {noun}" if differs else "")
