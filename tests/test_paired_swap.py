"""The test of a90 on the same boards: tosses against the enumeration of all exchanges, its level, what it sees."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy import stats

from harness.evaluation.study.paired import TIE, exchange, hits_change, swap_change
from harness.evaluation.study.record import Inspected
from tests.synthetic_study import SetUp, Study, study_record


def inspected(board, hit) -> Inspected:
    n = len(board)
    zero = np.zeros(n)
    names = np.array([str(k) for k in range(n)])
    return Inspected(np.array(board), names, np.zeros(n, int), zero + 5, zero, zero, zero, np.array(hit, bool), zero)


def two_detectors(boards: int, second: SetUp, *, seed: int = 1, holes: int = 10) -> tuple[Inspected, Inspected]:
    """On the same boards of 2 to 8 mm: a50 3.6 mm and width 0.4 mm, and another's."""
    whole = Study((SetUp(a50_mm=3.6, width_mm=0.4), replace(second, variant="other")), boards, 1, holes, 1, (2.0, 8.0))
    one, other = study_record(replace(whole, seed=seed)).set_ups
    return one.inspected, other.inspected


FLATTER, ALIKE = SetUp(a50_mm=3.6, width_mm=0.8), SetUp(a50_mm=3.6, width_mm=0.4)


def every_exchange(boards: int) -> np.ndarray:
    return np.array(list(product((False, True), repeat=boards)))


def test_tosses_estimate_the_enumeration_of_all_exchanges():
    pair = exchange(*two_detectors(9, FLATTER))
    assert pair is not None
    ratios = pair.log_ratios(every_exchange(9))
    assert np.sort(ratios) == pytest.approx(np.sort(-ratios), abs=1e-6), "symmetric: all may be exchanged at once"
    assert ratios[0] > 0
    exact = float(np.mean(ratios >= ratios[0] - TIE))
    assert 0.005 < exact < 0.2, "else the tosses say little"
    tossed = swap_change(*two_detectors(9, FLATTER))
    assert tossed is not None and tossed.ratio == pytest.approx(np.exp(ratios[0]))
    # stopped at the tenth toss as far out: a relative error of 1 / sqrt(10); four of them
    assert abs(tossed.grown_p - exact) < 4 * exact / np.sqrt(10) and tossed.shrunk_p == 1.0


def test_whichever_exchange_is_observed_the_null_distribution_is_the_same():
    """So of the exchanges of one pair of studies a share of at most alpha has p up to alpha."""
    first, second = two_detectors(7, FLATTER, seed=4)
    pair = exchange(first, second)
    assert pair is not None
    whole = np.sort(pair.log_ratios(every_exchange(7)))
    assert len(np.unique(whole.round(5))) > 30, "hits differ on too few boards to tell"
    for exchanged in every_exchange(7)[[3, 40, 90, 127]]:
        swapped = exchanged[first.board]
        one, two = (
            replace(seen, hit=np.where(swapped, other.hit, seen.hit))
            for seen, other in ((first, second), (second, first))
        )
        again = exchange(one, two)
        assert again is not None
        assert np.sort(again.log_ratios(every_exchange(7))) == pytest.approx(whole, abs=1e-6)
        assert again.log_ratios(np.zeros((1, 7), bool)) == pytest.approx(pair.log_ratios(exchanged[None]), abs=1e-6)


@pytest.mark.slow
def test_equal_detectors_are_called_no_oftener_than_the_level():
    """120 pairs at 5 %, both sides at 2.5 % each (this test's own alpha 1e-4)."""
    changes = [swap_change(*two_detectors(16, ALIKE, seed=seed, holes=6)) for seed in range(120)]
    called = sum(min(change.grown_p, change.shrunk_p) <= 0.025 for change in changes if change is not None)
    assert 1 <= called <= stats.binom.ppf(1 - 1e-4, 120, 0.05)


def test_a_flatter_curve_is_seen_where_hits_tell_nothing():
    by_a90, by_hits = [], []
    for seed in range(8):
        pair = two_detectors(40, FLATTER, seed=seed)
        swap, hits = swap_change(*pair, 999), hits_change(*pair)
        assert swap is not None and hits is not None
        by_a90.append(swap.grown_p)
        by_hits.append(hits.fewer_p)
    assert sum(p < 0.002 for p in by_a90) >= 6
    assert min(by_hits) > 0.01


def test_the_swap_test_reads_the_same_both_ways():
    for second in (FLATTER, ALIKE, SetUp(a50_mm=4.0, width_mm=0.4)):
        first, other = two_detectors(20, second, holes=6)
        there, back = swap_change(first, other), swap_change(other, first)
        assert there is not None and back is not None
        assert (there.grown_p, there.shrunk_p) == (back.shrunk_p, back.grown_p) and there.tosses == back.tosses
        assert there.ratio == pytest.approx(1 / back.ratio)


def test_no_hit_at_all_is_no_size_and_no_evidence_where_it_is_both():
    first, _ = two_detectors(12, ALIKE)
    blind = replace(first, hit=np.zeros(len(first.hit), bool))
    both, lost = swap_change(blind, blind), swap_change(first, blind)
    assert both is not None and lost is not None
    assert np.isnan(both.ratio) and (both.grown_p, both.shrunk_p, both.tosses) == (1.0, 1.0, 0)
    # All exchanges have an infinite a90 on one side at most: only with all boards on one side, or all but few, is
    # there none, and that is 1 in 2^11 of them.
    assert lost.ratio == np.inf and lost.grown_p < 0.01 and lost.shrunk_p == 1.0


def test_hits_and_misses_that_do_not_overlap_have_the_middle_of_the_gap():
    """Ten boards of eight holes, found from 3.5 mm by the first and from 5.5 mm by the second: every exchange that is
    neither all nor none has nearer limits, so p is 2^-10 exactly."""
    board, size = np.repeat(np.arange(10), 8), np.tile(np.arange(1.0, 9.0), 10)
    first, second = (replace(inspected(board, size > limit), diameter_mm=size) for limit in (3.5, 5.5))
    pair = exchange(first, second)
    assert pair is not None
    ratios = pair.log_ratios(every_exchange(10))
    assert np.exp(ratios[0]) == pytest.approx(5.5 / 3.5)
    assert np.sum(ratios >= ratios[0] - TIE) == 1
    tossed = swap_change(first, second)
    assert tossed is not None and 2**-12 < tossed.grown_p < 2**-8
    assert swap_change(first, first).tosses == 0  # type: ignore[union-attr]


def test_repeats_of_a_damage_are_exchanged_with_its_board():
    board = np.repeat([0, 1], 4)
    first = replace(inspected(board, [True] * 4 + [False] * 4), repeat=np.tile([0, 1], 4))
    first = replace(first, hole=np.repeat(["1", "2", "1", "2"], 2), diameter_mm=np.repeat([3.0, 5.0, 3.0, 5.0], 2))
    pair = exchange(first, first)
    assert pair is not None and pair.boards == 2
    assert (pair.inspections.tolist(), pair.first.tolist()) == ([2.0] * 4, [2.0, 2.0, 0.0, 0.0])
