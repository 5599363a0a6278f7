"""Two studies compared: the tests against enumeration and by hand, the pairing, every mark, the
program."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterator
from dataclasses import replace
from itertools import count, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from harness.evaluation.intervals import threshold_for_rate
from harness.evaluation.pod.hit_miss import fit_hit_miss
from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.record import (
    Calibrated,
    Inspected,
    SetUpRecord,
    StudyRecord,
    Unflawed,
    record_text,
)
from harness.programs.gate import compare, verdict
from harness.programs.gate.page import COMPARED, compare_html, compare_parts
from harness.programs.gate.paired import (
    _threshold_variance,
    calls_change,
    found_from,
    hits_change,
    limit_change,
    shared_rows,
    sign_flip,
    signal_change,
)
from harness.programs.gate.verdict import (
    ALPHA,
    Comparison,
    compare_studies,
    fewest_boards,
    holm,
    not_comparable,
    paired_set_ups,
)
from harness.vocabulary.text import text_of
from tests.support.synthetic_study import SetUp, Study, study_record
from tests.validation import gate_power

FRAMES = count()
SMALL = {"boards": 24, "hole_free_boards": 24, "holes": 6}


@pytest.fixture(scope="module", autouse=True)
def each_limit_once() -> Iterator[None]:
    """The limit of a set-up that several tests compare is computed once; half of these tests' time
    went there."""
    reference: dict[bytes, SetUpLimit] = {}

    def limit(record: SetUpRecord) -> SetUpLimit:
        key = pickle.dumps(replace(record, variant=""))
        if key not in reference:
            reference[key] = limit_of(record, draws=200)
        return replace(reference[key], record=record)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verdict, "limit_of", limit)
        yield


def small(*set_ups: SetUp, **changed: object) -> StudyRecord:
    return study_record(Study(set_ups or (SetUp(),), **{**SMALL, **changed}))  # type: ignore[arg-type]


def first_set_up(study: StudyRecord, **changed: object) -> StudyRecord:
    return replace(study, set_ups=(replace(study.set_ups[0], **changed), *study.set_ups[1:]))  # type: ignore[arg-type]


def only_row(first: StudyRecord, second: StudyRecord):
    (row,) = compare_studies(first, second).rows
    return row


# --- tests over boards
# -----------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(-4, 4), min_size=1, max_size=9))
def test_sign_flip_is_the_enumeration_of_all_signs(gained):
    sums = [
        sum(s * g for s, g in zip(signs, gained, strict=True))
        for signs in product((-1, 1), repeat=len(gained))
    ]
    observed = sum(gained)
    fewer, additional = sign_flip(np.array(gained))
    assert fewer == pytest.approx(np.mean([possible <= observed for possible in sums]), abs=1e-12)
    assert additional == pytest.approx(
        np.mean([possible >= observed for possible in sums]), abs=1e-12
    )


def test_sign_flip_by_hand():
    # three boards lose one hit each: of eight ways to toss the signs one is as bad
    assert sign_flip(np.array([-1, -1, -1, 0])) == (pytest.approx(1 / 8), 1.0)


def inspected(board, hit) -> Inspected:
    n = len(board)
    zero = np.zeros(n)
    names = np.array([str(k) for k in range(n)])
    return Inspected(
        np.array(board),
        names,
        np.zeros(n, int),
        zero + 5,
        zero,
        zero,
        zero,
        np.array(hit, bool),
        zero,
    )


def test_boards_are_the_unit_where_damages_are_lost_together():
    """Two boards that lose eight damages each are two losses, not sixteen."""
    board = np.repeat([0, 1, 2], 8)
    before = inspected(board, [True] * 24)
    now = inspected(board, [False] * 16 + [True] * 8)
    change = hits_change(before, now)
    assert change is not None
    assert (change.only_first, change.only_second, change.boards, change.inspections) == (
        16,
        0,
        3,
        24,
    )
    assert change.fewer_p == pytest.approx(0.25)


def only(inspected: Inspected, rows: np.ndarray) -> Inspected:
    """The inspections of these rows."""
    columns = {}
    for name, column in vars(inspected).items():
        if isinstance(column, np.ndarray):
            columns[name] = column[rows]
    return replace(inspected, **columns)


def test_only_shared_inspections_are_compared_in_any_order():
    complete = inspected([0, 0, 1, 1], [True, False, True, True])
    order = np.array([2, 0, 3])
    part = only(complete, order)
    rows, two = shared_rows(complete, part)
    assert [(complete.hole[a], part.hole[b]) for a, b in zip(rows, two, strict=True)] == [
        ("0",) * 2,
        ("2",) * 2,
        ("3",) * 2,
    ]
    change = hits_change(complete, part)
    assert change is not None and (change.only_first, change.only_second, change.inspections) == (
        0,
        0,
        3,
    )


def test_no_shared_inspection_is_no_test():
    assert hits_change(inspected([0], [True]), inspected([7], [True])) is None


# --- limits
# ----------------------------------------------------------------------------------------------------------


def test_paired_draws_make_the_interval_narrower_than_independent_ones():
    first = small(SetUp(boards_mm=1.5, own_noise=0.2)).set_ups[0]
    second = small(SetUp(boards_mm=1.5, own_noise=0.2, variant="other", a50_mm=6.3)).set_ups[0]
    limits = limit_of(first), limit_of(second)
    paired = limit_change(*limits, True)
    separation = limit_change(*limits, False)
    assert paired.paired and not separation.paired
    assert paired.difference_mm == separation.difference_mm == limits[1].a90_mm - limits[0].a90_mm
    widths = [change.interval_mm.high - change.interval_mm.low for change in (paired, separation)]
    assert widths[0] < 0.7 * widths[1]


def test_boards_missing_in_one_unpair_the_draws():
    study = small().set_ups[0]
    kept = study.inspected.board != study.inspected.board[0]
    without_one = replace(study, inspected=only(study.inspected, kept))
    assert not limit_change(limit_of(study), limit_of(without_one), True).paired


# --- false calls
# -----------------------------------------------------------------------------------------------------


def unflawed(calls: np.ndarray, area_m2: float = 0.07) -> SetUpRecord:
    n = len(calls)
    table = Unflawed(np.arange(n), np.zeros(n, int), np.asarray(calls, int), np.full(n, area_m2))
    return replace(
        small().set_ups[0], unflawed=table, calibration_runs=60, frames_digest=str(next(FRAMES))
    )


def test_given_thresholds_leave_fishers_exact_test():
    first = replace(unflawed(np.arange(20) < 2), calibration_runs=0)
    second = replace(unflawed(np.arange(20) < 8), calibration_runs=0)
    change = calls_change(first, second, None)
    assert change is not None and change.calling == (2, 8)
    table = [[8, 12], [2, 18]]
    assert change.more_p == pytest.approx(stats.fisher_exact(table, alternative="greater").pvalue)
    assert change.fewer_p == pytest.approx(stats.fisher_exact(table, alternative="less").pvalue)


def test_no_call_anywhere_says_nothing():
    change = calls_change(unflawed(np.zeros(9)), unflawed(np.zeros(9)), 1.0)
    assert change is not None
    assert (change.ratio, change.more_p, change.fewer_p) == (1.0, 1.0, 1.0)


def test_on_identical_frames_the_signs_of_boards_are_tossed():
    """All 16 boards call where 5 did: with a threshold that is the second highest of 20 scores
    such luck has 0.2 %, on identical frames it has 2^-11."""
    first = replace(unflawed(np.arange(16) < 5), calibration_runs=20)
    second = replace(unflawed(np.arange(16) < 16), calibration_runs=20)
    separation = calls_change(first, second, 2.0)
    is_equal = calls_change(
        replace(first, frames_digest="same"), replace(second, frames_digest="same"), 2.0
    )
    assert separation is not None and is_equal is not None
    assert (separation.way, is_equal.way) == ("calibrations", "signs")
    assert is_equal.more_p == pytest.approx(2.0**-11) and is_equal.fewer_p == 1.0
    assert 0.0005 < separation.more_p < 0.005


def test_luck_with_the_calibration_is_the_same_only_where_the_threshold_is():
    studies = [
        replace(unflawed(np.arange(16) < k), calibration_runs=20, frames_digest="same")
        for k in (5, 16)
    ]
    first, second = studies
    signs = calls_change(first, replace(second, threshold=first.threshold * 1.0), 2.0)
    pair = calls_change(first, replace(second, threshold=first.threshold * 1.01), 2.0)
    arguments = calls_change(
        *(replace(u, calibration_runs=0) for u in (first, replace(second, threshold=9.0))), None
    )
    assert signs is not None and pair is not None and arguments is not None
    assert (signs.way, pair.way, arguments.way) == ("signs", "both", "signs")
    separation = calls_change(first, replace(second, frames_digest="others"), 2.0)
    assert (
        separation is not None
        and pair.more_p == separation.more_p > signs.more_p == arguments.more_p
    )


@pytest.mark.slow
def test_two_detectors_on_identical_frames_are_not_called_for_their_luck():
    """800 pairs of equally good detectors that score independently: signs alone are called at 1 %
    far oftener; the test that decides no oftener than 1 % (this test's own alpha 1e-4)."""
    rng = np.random.default_rng(6)
    base = replace(unflawed(np.zeros(240)), frames_digest="same")
    decided = by_signs = 0
    for _ in range(800):
        pair = []
        for _ in range(2):
            threshold = threshold_for_rate(rng.standard_normal(60), 0.07, 1.0).value
            calls = (rng.standard_normal(240) > threshold).astype(int)
            pair.append(
                replace(base, threshold=threshold, unflawed=replace(base.unflawed, calls=calls))
            )
        change = calls_change(*pair, 1.0)
        assert change is not None and change.way == "both"
        decided += change.more_p < 0.01
        by_signs += sign_flip(pair[1].unflawed.calls - pair[0].unflawed.calls)[1] < 0.01
    assert decided <= stats.binom.ppf(1 - 1e-4, 800, 0.01)
    assert by_signs > 48


def test_counts_are_compared_by_area():
    change = calls_change(unflawed(np.ones(10), 0.1), unflawed(np.ones(10), 0.2), 1.0)
    assert change is not None
    assert change.rates_per_m2 == (pytest.approx(10.0), pytest.approx(5.0))


@pytest.mark.slow
def test_calibration_draws_are_in_the_false_calls_test_and_not_in_that_of_counts():
    """2,000 pairs of honest studies, 60 boards to calibrate and 240 to judge: the test that
    decides is called at 5 % no oftener than 5 % (this test's own alpha 1e-4); that of counts,
    which takes thresholds as known, four times as often.
    """
    rng = np.random.default_rng(5)
    base = unflawed(np.zeros(240))
    decided = counted = 0
    for _ in range(2000):
        pair = []
        for _ in range(2):
            threshold = threshold_for_rate(rng.standard_normal(60), 0.07, 1.0).value
            calls = (rng.standard_normal(240) > threshold).astype(int)
            table = replace(base.unflawed, calls=calls)
            pair.append(replace(base, unflawed=table, frames_digest=str(next(FRAMES))))
        change = calls_change(*pair, 1.0)
        assert change is not None
        decided += change.more_p < 0.05
        counts = (
            change.calls[1],
            max(sum(change.calls), 1),
            change.areas_m2[1] / sum(change.areas_m2),
        )
        counted += stats.binomtest(*counts).pvalue / 2 < 0.05 and change.ratio > 1
    assert 40 < decided <= stats.binom.ppf(1 - 1e-4, 2000, 0.05)
    assert counted > 300


# --- pairs
# -----------------------------------------------------------------------------------------------------------


def labels(pairs) -> list[tuple[str | None, str | None]]:
    return [
        (
            first and f"{first.variant} {first.frames}",
            second and f"{second.variant} {second.frames}",
        )
        for first, second in pairs
    ]


def test_pairs_by_name_then_by_axes_then_alone():
    axes = {"source.target.distance_m": 0.7}
    first = small(SetUp("a", 1), SetUp("b", 1, axes), SetUp("c", 5))
    second = small(SetUp("renamed", 1, axes), SetUp("a", 1), SetUp("d", 5, {"x": 2}))
    assert labels(paired_set_ups(first, second)) == [
        ("a 1", "a 1"), ("b 1", "renamed 1"), ("c 5", None), (None, "d 5"),
    ]  # fmt: skip
    single = small(SetUp("thesis", 1)), small(SetUp("other", 50))
    assert labels(paired_set_ups(*single)) == [("thesis 1", "other 50")]


@pytest.mark.parametrize(
    ("study", "set_up", "word"),
    [
        ({"hit_radius_mm": 10.0}, {}, "within 10 mm here"),
        ({"false_calls_per_m2": 2.0}, {}, "2 false calls per m²"),
        ({}, {"calibration_runs": 0}, "given"),
    ],
)
def test_another_measuring_stick_is_not_compared(study, set_up, word):
    first = small()
    second = replace(first_set_up(first, **set_up), **study)
    row = only_row(first, second)
    assert row.mark == "not comparable" and word in row.why
    assert not row.is_worse and row.limit is None


def test_another_family_of_damage_is_not_compared_and_other_boards_of_the_same_are():
    first = small()
    same = small(seed=2)
    larger = small(seed=2, sizes_mm=(12.0, 20.0))
    assert not_comparable(first, same, first.set_ups[0], same.set_ups[0]) == ""
    assert "sizes" in not_comparable(first, larger, first.set_ups[0], larger.set_ups[0])
    deeper = replace(same.set_ups[0].inspected, depth_mm=same.set_ups[0].inspected.depth_mm + 3)
    assert "depths" in only_row(first, first_set_up(same, inspected=deeper)).why


# --- verdicts
# --------------------------------------------------------------------------------------------------------


def test_a_study_is_as_good_as_itself():
    row = only_row(small(), small())
    assert (row.mark, row.changed, row.limit.difference_mm, row.hits.fewer_p) == (
        "as good",
        (),
        0.0,
        1.0,
    )


def test_worse_one_way_is_better_the_other():
    first = small(SetUp(a50_mm=5))
    second = small(SetUp(a50_mm=7, detector_version=2, frames_digest="b"))
    row = only_row(first, second)
    back = only_row(second, first)
    assert (row.mark, back.mark) == ("worse", "better")
    assert row.limit.ratio == pytest.approx(1 / back.limit.ratio)
    assert (row.hits.only_first, row.hits.only_second) == (
        back.hits.only_second,
        back.hits.only_first,
    )
    assert row.hits.fewer_p == pytest.approx(back.hits.more_p)
    assert row.changed == ("plane 1 → plane 2", "other frames of the same boards")
    assert row.is_worse and not back.is_worse


def test_a_larger_limit_that_may_be_chance_is_not_worse():
    """Of one board alone all hits are lost: the limit grows, and one board is no evidence."""
    first = small(boards=3, holes=16)
    inspected = first.set_ups[0].inspected
    row = only_row(
        first,
        first_set_up(
            first, inspected=replace(inspected, hit=inspected.hit & (inspected.board != 0))
        ),
    )
    assert row.limit.ratio > 1.1 and row.hits.only_first > row.hits.only_second
    assert row.hits.fewer_p == pytest.approx(0.5) and row.mark == "not significant"


def test_the_test_of_hits_answers_for_the_limit():
    first = small(SetUp(a50_mm=5))
    lost = only_row(first, small(SetUp(a50_mm=8)))
    equal = only_row(first, small(SetUp(a50_mm=5)))
    assert lost.mark == "worse"
    # of Holm's three questions the smaller of two equal p, and of two tests of the limit the
    # stronger
    assert lost.limit_p[0] == pytest.approx(2 * 2 * min(lost.hits.fewer_p, lost.limit.grown_p))
    assert equal.limit_p[0] == 1.0


def test_a_significant_loss_within_the_margin_is_as_good():
    first = study_record(Study((SetUp(a50_mm=8.0, own_noise=0.0),), boards=120))
    row = only_row(first, study_record(Study((SetUp(a50_mm=8.5, own_noise=0.0),), boards=120)))
    assert row.limit_p[0] < ALPHA and 1.0 < row.limit.ratio < 1.1 and row.mark == "as good"


def weaker(study: StudyRecord, by: float, above: float = 1.0, **changed: Any) -> StudyRecord:
    """The study with all signals times ``by``, found from ``above`` times as much on."""
    record = study.set_ups[0]
    signal = by * record.inspected.signal
    index = above * record.threshold
    return first_set_up(
        study, inspected=replace(record.inspected, signal=signal, hit=signal > index), **changed
    )


@pytest.mark.slow  # a Monte Carlo campaign
def test_weaker_signals_and_a_higher_threshold_are_worse_though_a90_is_not():
    """Signals grow so fast with size that the limit moves by less than the margin."""
    first = small(SetUp(a50_mm=7.0, width_mm=0.2), boards=20)
    inspected = first.set_ups[0].inspected
    first = first_set_up(
        first,
        inspected=replace(
            inspected,
            signal=5.0 * (inspected.diameter_mm / 7.0) ** 5,
            hit=inspected.diameter_mm > 7,
        ),
    )
    for key, threshold in ((1 / 1.4, 1.0), (1.0, 1.2)):
        row = only_row(first, weaker(first, key, threshold))
        assert (
            row.limit.ratio < 1.1
            and row.mark == "worse"
            and row.why.startswith("signals over what is needed")
        )
        assert (
            row.signal.ratio == pytest.approx(key / threshold, rel=0.06) and row.signal_p[0] < ALPHA
        )
    assert only_row(first, weaker(first, 0.95)).mark == "as good", "within the margin"
    second = weaker(first, 1 / 1.4, detector="another")
    assert only_row(first, second).signal is None, "other scores are in other units"


def test_the_luck_of_both_calibrations_is_in_the_test_of_signals():
    """Scores of 48 runs scatter by 7 %, so a threshold that was calibrated anew is known to some
    per cent only."""
    one_study = small(boards=20)
    scores = 5.0 * np.exp(0.07 * np.random.default_rng(1).standard_normal(48))
    runs = Calibrated(np.arange(48), np.zeros(48, int), scores, np.zeros(48), np.zeros(48))
    threshold = float(np.sort(scores)[-9])
    first = first_set_up(one_study, calibrated=runs, threshold=threshold)
    again = replace(runs, score=1.13 * runs.score)
    lucky = weaker(first, 1.0, 1.13, threshold=1.13 * threshold, calibrated=again)
    assert only_row(first, weaker(first, 1 / 1.13)).signal.less_p < 1e-6
    draws = np.sort(
        5.0 * np.exp(0.07 * np.random.default_rng(2).standard_normal((4000, 48))), axis=1
    )[:, -9]
    deviation = np.sqrt(_threshold_variance(first.set_ups[0])[0])
    assert deviation == pytest.approx(np.log(draws).std(), rel=0.3)
    assert only_row(first, lucky).signal.error > 1.2 * deviation


@pytest.mark.parametrize("slip", [pytest.param(0.0, marks=pytest.mark.slow), 0.1])
def test_signals_under_another_draw_of_the_noise_are_as_rarely_weaker_as_the_test_says(slip):
    """``slip``: deviation by which hits do not follow the signals, as a score over several pixels
    does not."""
    random = np.random.default_rng(3)

    def drawn(size: gate_power.Size, boards: int, noise: int) -> list[SetUpRecord]:
        records = []
        for record in gate_power.study(size, boards, noise).set_ups:
            inspected = record.inspected
            factor = np.exp(slip * random.standard_normal(len(record.inspected.signal)))
            hit = inspected.signal * factor > record.threshold
            records.append(replace(record, inspected=replace(inspected, hit=hit)))
        return records

    size = gate_power.Size()
    pairs = [
        zip(drawn(size, boards, 1), drawn(size, boards, 2), strict=True) for boards in range(60)
    ]
    p = np.array([signal_change(*pair).less_p for each in pairs for pair in each])
    # of 240 uniform p-values, 2.4 are below 0.01, and none is below 1e-4 in 41 of 42 cases
    assert (p < 0.01).sum() <= 8 and p.min() > 1e-4
    assert 0.35 < np.median(p) < 0.65


@pytest.mark.parametrize("seed", range(20))
def test_the_effective_threshold_is_where_half_of_the_signals_are_found(seed):
    random = np.random.default_rng(seed)
    n = 40
    signal = random.lognormal(size=n)
    hit = random.random(n) < 1 / (1 + np.exp(-2 * np.log(signal)))
    record = replace(small().set_ups[0], threshold=1.1)

    def effective(hit: np.ndarray) -> tuple[float, float]:
        ones = np.ones(n)
        inspected = Inspected(
            board=np.arange(n),
            hole=np.full(n, "1"),
            repeat=np.zeros(n, int),
            diameter_mm=ones,
            depth_mm=ones,
            x_mm=ones,
            y_mm=ones,
            hit=hit,
            signal=signal,
        )
        return found_from(replace(record, inspected=inspected))

    assert effective(signal > 1.1) == (1.1, 0.0), "hits follow the threshold"
    lower = signal > np.sort(signal)[10]
    level, variance = effective(lower)
    assert ((signal > level) == lower).all() and variance > 0, "between two signals"
    ends = effective(signal > 0)[0], effective(signal < 0)[0]
    assert ends == pytest.approx((signal.min(), signal.max()), rel=1e-12)
    level, variance = effective(hit)
    fit = fit_hit_miss(signal, hit, log_size=True)
    b0 = fit.b0
    b1 = fit.b1
    assert b0 + b1 * np.log(level) == pytest.approx(0, abs=1e-9) and 0 < variance < 1
    assert np.isnan(effective(signal < 1.1)).all(), "hits fall as signals grow"


def test_more_false_calls_are_worse_whatever_the_limit():
    first = small(SetUp(a50_mm=6))
    second = small(SetUp(a50_mm=4.5, frames_digest="b"))
    table = second.set_ups[0].unflawed
    row = only_row(
        first, first_set_up(second, unflawed=replace(table, calls=np.full(len(table.calls), 3)))
    )
    assert row.limit.ratio < 0.9 and row.mark == "worse" and "false calls" in row.why


def test_lost_limits_and_failed_trials_fail_and_the_way_back_is_newly_working():
    first = small()
    inspected = first.set_ups[0].inspected
    blind = first_set_up(
        first, inspected=replace(inspected, hit=np.zeros(len(inspected.hit), bool))
    )
    assert (only_row(first, blind).mark, only_row(blind, first).mark) == (
        "newly failing",
        "newly working",
    )
    assert only_row(blind, blind).mark == "no limit"
    broken = only_row(first, first_set_up(first, failed=2))
    assert broken.mark == "newly failing" and broken.why == "2 trials failed, 0 before"
    assert only_row(first_set_up(first, failed=2), first).mark == "as good"


def test_everything_found_is_no_failure():
    first = small()
    inspected = first.set_ups[0].inspected
    perfect = first_set_up(
        first, inspected=replace(inspected, hit=np.ones(len(inspected.hit), bool))
    )
    assert only_row(first, perfect).mark == "better"
    assert only_row(perfect, first).mark == "worse"


def test_other_boards_are_compared_by_their_limits():
    first = small(SetUp(a50_mm=5))
    same = only_row(first, small(SetUp(a50_mm=5), seed=3))
    worse = only_row(first, small(SetUp(a50_mm=8), seed=3))
    assert same.hits is None and worse.hits is None and not worse.limit.paired
    assert (same.mark, worse.mark) == ("as good", "worse") and worse.changed == ("other boards",)


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03]).tolist() == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.9, 0.5]).tolist() == [1.0, 1.0] and holm([]).tolist() == []


def test_many_set_ups_ask_for_more():
    """A loss that convicts a single set-up does not convict one of forty."""
    first = small(boards=14, hole_free_boards=4)
    observed = replace(
        first.set_ups[0].inspected, signal=np.full(len(first.set_ups[0].inspected.hit), np.nan)
    )
    first = first_set_up(first, inspected=observed)  # of hits alone
    worse = first_set_up(
        first, inspected=replace(observed, hit=observed.hit & (observed.diameter_mm > 10))
    )
    alone = only_row(first, worse)
    assert alone.mark == "worse" and min(alone.hits.fewer_p, alone.limit.grown_p) > ALPHA / 160
    remaining = tuple(replace(first.set_ups[0], variant=str(k)) for k in range(39))
    among = compare_studies(
        *(replace(study, set_ups=study.set_ups + remaining) for study in (first, worse))
    )
    assert (
        among.rows[0].mark == "not significant" and among.rows[0].limit.ratio == alone.limit.ratio
    )


# --- pages and the program
# -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    first = small(SetUp(frames=1), SetUp(frames=5, a50_mm=4), SetUp("gone", 5))
    second = small(
        SetUp(frames=1, a50_mm=8, frames_digest="b"),
        SetUp(frames=5, a50_mm=4),
        SetUp("new", 9, {"x": 1}),
    )
    return compare_studies(first, second)


def test_every_row_is_said_in_text_and_on_the_page(comparison):
    text = text_of(compare_parts(comparison))
    page = compare_html(comparison, "tofpod compare a b")
    assert [row.mark for row in comparison.rows] == [
        "worse",
        "as good",
        "only in first",
        "only in second",
    ]
    for row in comparison.rows:
        assert row.label in text and row.label in page and row.mark in text
    assert text.splitlines()[-1].startswith("1 of 4 set-ups is worse. 1 frame: a90 ")
    assert "what differs: other frames of the same boards (1 frame)" in text
    assert page.count("<tr") == 1 + 4 + 1 + 3 and 'none">worse</td>' in page
    assert COMPARED.grid(comparison.rows).rich().row_count == 4
    assert compare_html(comparison, "x") == compare_html(comparison, "x")


def test_the_program_prints_writes_and_returns_0(tmp_path, capsys):
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder, a50 in zip(folders, (5.0, 8.0), strict=True):
        folder.mkdir()
        (folder / "study.json").write_text(record_text(small(SetUp(a50_mm=a50))))
    assert compare.main([*map(str, folders), "--out", str(tmp_path / "out")]) == 0
    assert "worse" in capsys.readouterr().out
    data = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert data["worse"] == ["1 frame"] and data["set_ups"][0]["mark"] == "worse"
    assert data["set_ups"][0]["a90_change"]["paired"] is True
    assert (tmp_path / "out" / "compare.html").read_text().startswith("<!doctype html>")
    assert compare.main([str(folders[0] / "study.json"), str(folders[0])]) == 0
    assert capsys.readouterr().out.rstrip().endswith("No set-up is worse: 1 as good.")


def test_nothing_paired_is_said_with_what_there_is(tmp_path, capsys):
    first = small(SetUp("a", 1), SetUp("b", 1, {"x": 1}))
    second = small(SetUp("c", 5), SetUp("d", 9))
    for name, study in (("one.json", first), ("other.json", second)):
        (tmp_path / name).write_text(record_text(study))
    assert (
        compare.main(
            [
                str(tmp_path / "one.json"),
                str(tmp_path / "other.json"),
                "--out",
                str(tmp_path / "out"),
            ]
        )
        == 2
    )
    captured = capsys.readouterr()
    assert (
        "no set-ups can be paired" in captured.err
        and "a, 1 frame; b, 1 frame / c, 5 frames; d, 9 frames" in captured.err
    )
    assert not captured.out and not (tmp_path / "out").exists()


def test_the_program_names_a_users_mistakes(tmp_path, capsys):
    (tmp_path / "old.json").write_text(json.dumps({"record_version": 0}))
    (tmp_path / "no.json").write_text("[]")
    for name, word in (
        ("none", "cannot be read"),
        ("old.json", "version 0"),
        ("no.json", "not the record of a study"),
    ):
        assert compare.main([str(tmp_path / name), str(tmp_path)]) == 2
        assert word in capsys.readouterr().err


@pytest.mark.parametrize("set_ups", [1, 2, 6])
def test_so_many_boards_and_no_fewer_can_convict(set_ups):
    """Of a study in which every board has lost, the smallest p that the rule can give."""
    for boards, convicts in ((fewest_boards(set_ups), True), (fewest_boards(set_ups) - 1, False)):
        hits_p, _ = sign_flip(np.full(boards, -1))
        assert (2 * hits_p * 3 * set_ups < ALPHA) == convicts
