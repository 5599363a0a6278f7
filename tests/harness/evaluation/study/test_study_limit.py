"""Limits of set-ups: against the library, by hand, and over boards."""

from __future__ import annotations

import dataclasses
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.evaluation.intervals import Interval, percentiles
from harness.evaluation.pod.averaged import ModelAverage
from harness.evaluation.pod.clustered import ClusterAverage
from harness.evaluation.pod.curve import CELLS, LINKS, PodCurve
from harness.evaluation.pod.hit_miss import choose_model, fit_hit_miss
from harness.evaluation.study.boards import (
    design_effect,
    refitted_sizes,
    targets_of,
    weights_in_blocks,
)
from harness.evaluation.study.limit import ALL_FOUND, limit_of
from harness.evaluation.study.record import Inspected, SetUpRecord, Unflawed
from harness.tables.limits import limit_sentence
from tests.support.synthetic_study import SetUp, Study, study_record


def set_up(study: Study) -> SetUpRecord:
    return study_record(study).set_ups[0]


def with_hits(record: SetUpRecord, hit: np.ndarray) -> SetUpRecord:
    return dataclasses.replace(record, inspected=dataclasses.replace(record.inspected, hit=hit))


def first_rows(record: SetUpRecord, n: int) -> SetUpRecord:
    columns = {
        name: column[:n] for name, column in vars(record.inspected).items() if column is not None
    }
    return dataclasses.replace(record, inspected=Inspected(**columns))


@pytest.fixture(scope="module")
def small() -> SetUpRecord:
    return set_up(Study(boards=15, hole_free_boards=12))


@pytest.fixture(scope="module")
def repeated() -> SetUpRecord:
    return set_up(Study(boards=15, repeats=3))


class TestDepth:
    def test_of_one_diameter_the_limit_is_of_depth(self, small):
        """The same numbers as if the depths were diameters; words and axes say depth."""
        inspected = small.inspected
        sizes = small.inspected.diameter_mm
        turned = dataclasses.replace(
            inspected, diameter_mm=np.full(len(sizes), 10.0), depth_mm=sizes
        )
        of_depth = limit_of(dataclasses.replace(small, inspected=turned), draws=20)
        of_diameter = limit_of(small, draws=20)
        assert turned.limit_of == "depth"
        assert inspected.limit_of == "diameter"
        assert of_depth.a90_95 == of_diameter.a90_95
        assert of_depth.largest_mm == sizes.max()
        assert np.array_equal(of_depth.a90_draws_mm, of_diameter.a90_draws_mm)
        assert "mm deep is found" in limit_sentence(of_depth)
        assert "deep" not in limit_sentence(of_diameter)
        assert of_depth.statement.read.size_column == "depth"
        assert not any("one curve over all depths" in note for note in of_depth.statement.notes)

    def test_without_several_depths_it_is_of_diameter(self, small):
        single_size = dataclasses.replace(small.inspected, diameter_mm=np.full(120, 10.0))
        assert single_size.limit_of == "diameter"


class TestHeadline:
    def test_is_the_average_of_the_models_near_the_one_of_least_deviance(self):
        record = set_up(Study(boards=15, hole_free_boards=12, seed=6))
        limit = limit_of(record)
        inspected = record.inspected
        best, *worse = fits = choose_model(inspected.diameter_mm, inspected.hit)
        near_fits = [best, *(fit for fit in worse if fit.deviance - best.deviance <= 2)]
        assert [fit.curve.link for fit in limit.statement.fits] == [
            fit.curve.link for fit in near_fits
        ]
        assert 1 < len(near_fits) < len(fits)
        assert limit.a90_95 == ModelAverage(near_fits).bound()
        assert limit.a50_mm == best.curve.size_at(0.5)
        assert limit.a90_mm == best.curve.size_at(0.9)
        assert limit.why == ""
        assert limit.targets == limit.inspections == 120
        assert limit.boards == 15

    def test_repeats_of_one_damage_are_one_target(self, repeated):
        limit = limit_of(repeated)
        inspected = repeated.inspected
        assert limit.targets == 120
        assert limit.inspections == 360
        assert limit.statement.read.targets == 120
        by_hand = choose_model(
            inspected.diameter_mm,
            inspected.hit,
            inspections=inspected.board * 100 + inspected.hole.astype(int),
        )
        near_fits = [
            fit for fit in by_hand if fit.deviance <= by_hand[0].deviance + 2 * 3
        ]  # every target counts thrice
        assert limit.a90_95 == ModelAverage(near_fits).bound()

    def test_is_near_the_truth(self):
        answers = SetUp()
        limit = limit_of(set_up(Study((answers,))))
        # 480 targets: standard error of a90 about 0.25 mm
        assert abs(limit.a50_mm - answers.a50_mm) < 0.5
        assert abs(limit.a90_mm - answers.a90_mm) < 0.75
        assert limit.a90_mm < limit.a90_95.value < answers.a90_mm + 1.0
        assert limit.a50_interval_mm.low < answers.a50_mm < limit.a50_interval_mm.high

    def test_same_record_same_bits(self, small):
        first = limit_of(small)
        second = limit_of(small)
        assert np.array_equal(first.a90_draws_mm, second.a90_draws_mm)


class TestWithoutACurve:
    def test_all_found_is_bounded_by_the_29th_smallest(self, small):
        limit = limit_of(with_hits(small, np.ones(120, bool)))
        assert ALL_FOUND == 29
        assert 0.9**29 < 0.05 < 0.9**28
        assert limit.statement is None
        assert "found" in limit.why
        assert limit.a90_95.value == np.sort(small.inspected.diameter_mm)[28]
        assert "all found" in limit.a90_95.method
        assert not limit.over_boards.demonstrated
        assert limit.a90_mm == limit.a50_mm == small.inspected.diameter_mm.min()
        assert np.all(limit.a90_draws_mm == small.inspected.diameter_mm.min())
        assert limit.is_at_most
        assert not limit_of(small).is_at_most

    def test_boards_that_all_fared_alike_give_no_interval(self, small):
        """Boards drawn again from them fare so too: an interval without width would say that all
        is known."""
        for is_hit in (True, False):
            limit = limit_of(with_hits(small, np.full(120, is_hit)))
            for interval in (limit.a50_interval_mm, limit.a90_interval_mm):
                assert not interval.known

    def test_28_found_of_28_demonstrate_nothing(self, small):
        record = first_rows(small, 28)
        limit = limit_of(with_hits(record, np.ones(28, bool)))
        assert not limit.a90_95.demonstrated
        assert "29 are needed" in limit.a90_95.why
        for bound_of_all in (limit.a90_95, limit.over_boards):
            assert (bound_of_all.pod, bound_of_all.confidence) == (0.9, 0.95)

    def test_nothing_found(self, small):
        limit = limit_of(with_hits(small, np.zeros(120, bool)))
        assert limit.statement is None
        assert "missed" in limit.why
        assert limit.why in limit.a90_95.why
        assert not limit.a90_95.demonstrated
        assert np.isnan(limit.a90_mm)
        assert np.isnan(limit.a50_mm)
        assert np.all(np.isinf(limit.a90_draws_mm))
        assert np.isinf(limit.over_boards.value)
        assert limit.hits == 0
        assert not limit.boards_matter

    def test_a_chance_that_falls_with_size(self, small):
        limit = limit_of(
            with_hits(small, small.inspected.diameter_mm < np.median(small.inspected.diameter_mm))
        )
        assert limit.statement is None
        assert "does not grow" in limit.why
        assert not limit.a90_95.demonstrated
        assert np.all(np.isinf(limit.a90_draws_mm))

    def test_no_damage_at_all(self, small):
        limit = limit_of(first_rows(small, 0))
        assert limit.why == "no damage was inspected"
        assert limit.targets == 0
        assert not limit.a90_95.demonstrated

    def test_hits_and_misses_apart(self, small):
        size = small.inspected.diameter_mm
        limit = limit_of(with_hits(small, size > 6.0), draws=100)
        gap = (size[size <= 6].max(), size[size > 6].min())
        assert limit.statement is not None
        assert np.isfinite(limit.a90_draws_mm).all()
        assert gap[0] - 0.6 < limit.a50_interval_mm.low < limit.a50_interval_mm.high < gap[1] + 0.6
        assert np.median(limit.a90_draws_mm) > limit.a50_mm

    @pytest.mark.parametrize(
        "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))]
    )
    def test_apart_too_estimates_lie_inside_their_intervals(self, seed):
        """Draws are fitted as the study is; with the middle of the gap for a90 its interval lies
        below it in every one of these."""
        record = set_up(Study(boards=10, hole_free_boards=0, seed=seed))
        limit = limit_of(with_hits(record, record.inspected.diameter_mm > 5.5), draws=200)
        for size, interval in (
            (limit.a50_mm, limit.a50_interval_mm),
            (limit.a90_mm, limit.a90_interval_mm),
        ):
            assert interval.low <= size <= interval.high

    def test_few_boards_that_were_all_found_are_no_boards_that_matter(self, small):
        """20 boards cannot demonstrate what takes 29; that says nothing of what damages of one
        board share."""
        limit = limit_of(with_hits(small, np.ones(120, bool)))
        assert np.isinf(limit.over_boards.value)
        assert np.isnan(limit.design_effect)
        assert not limit.boards_matter


class TestWhatWasInspected:
    def test_sizes_beyond_the_largest_are_told(self, small):
        limit = limit_of(small)
        assert limit.largest_mm == small.inspected.diameter_mm.max() == 14.0
        assert limit.beyond(14.0) is False
        assert limit.beyond(14.01) is True
        assert limit.beyond(np.inf) is True
        assert np.isnan(limit_of(first_rows(small, 0)).largest_mm)

    def test_depths_that_share_a_curve_are_noted(self, small):
        note = "mm: one curve over all depths"
        assert not any(note in statement_note for statement_note in limit_of(small).statement.notes)
        deep = set_up(Study(boards=15, hole_free_boards=0, depths_mm=(0.65, 5.0)))
        depths = deep.inspected.depth_mm
        expected = f"depths from {depths.min():.3g} to {depths.max():.3g} {note}"
        assert limit_of(deep).statement.notes.count(expected) == 1


class TestFalseCalls:
    def test_counts_and_area(self, small):
        limit = limit_of(small)
        assert limit.false_calls.calls == small.unflawed.calls.sum()
        assert limit.false_calls.area_m2 == pytest.approx(12 * 0.25)
        assert limit.false_calls_interval_per_m2.low <= limit.false_calls.rate_per_m2

    def test_none_without_hole_free_boards(self):
        limit = limit_of(set_up(Study(boards=8, hole_free_boards=0)))
        assert limit.false_calls is None
        assert not limit.false_calls_interval_per_m2.known

    def test_no_call_gives_no_interval_over_boards_but_poisson_s(self, small):
        silent = dataclasses.replace(
            small, unflawed=dataclasses.replace(small.unflawed, calls=np.zeros(12, int))
        )
        limit = limit_of(silent)
        assert not limit.false_calls_interval_per_m2.known
        assert limit.false_calls.interval_per_m2.high == pytest.approx(-np.log(0.025) / 3.0)

    def test_calls_that_come_in_clusters_widen_the_interval_over_boards(self, small):
        calls = np.zeros(12, int)
        calls[3] = 24
        clustered = dataclasses.replace(
            small, unflawed=dataclasses.replace(small.unflawed, calls=calls)
        )
        limit = limit_of(clustered)
        over = limit.false_calls_interval_per_m2
        poisson = limit.false_calls.interval_per_m2
        assert over.high - over.low > 1.5 * (poisson.high - poisson.low)

    def test_the_rate_of_drawn_boards_is_over_their_own_area(self, small):
        """A call on 1 m² and none on 3 m²: draws have a rate of 1, 1/4 or 0 per m²."""
        unflawed = dataclasses.replace(
            small.unflawed,
            board=np.array([0, 1]),
            repeat=np.array([0, 0]),
            calls=np.array([1, 0]),
            area_m2=np.array([1.0, 3.0]),
        )
        limit = limit_of(dataclasses.replace(small, unflawed=unflawed))
        assert limit.false_calls.rate_per_m2 == 1 / 4
        assert limit.false_calls_interval_per_m2 == Interval(0.0, 1.0)

    def test_calls_beside_damage_are_those_of_damaged_boards(self, small):
        beside = Unflawed(
            board=np.arange(4),
            repeat=np.zeros(4, int),
            calls=np.array([0, 5, 0, 2]),
            area_m2=np.full(4, 0.5),
        )
        limit = limit_of(dataclasses.replace(small, beside=beside))
        assert (limit.beside.calls, limit.beside.rate_per_m2) == (7, 3.5)
        assert limit.false_calls.calls == small.unflawed.calls.sum()


def test_units_that_found_the_same_of_what_is_apart_widen_nothing(repeated):
    """The likelihood of a step says nothing of how much units differ."""
    apart = with_hits(repeated, repeated.inspected.size_mm > 6.0)
    of_one = limit_of(apart, draws=20)
    of_three = limit_of(dataclasses.replace(apart, units=3), draws=20)
    assert of_three.statement.fits[0].method == "Firth"
    assert of_three.a90_interval_mm == of_one.a90_interval_mm


def row_weights(
    board: np.ndarray,
    draws: int,
    population: str = "damaged",
) -> np.ndarray:
    return np.concatenate([weights for (weights,) in weights_in_blocks(draws, (board, population))])


class TestBoardsDrawnAgain:
    def test_weights_are_the_same_for_as_many_boards_and_differ_between_populations(self):
        assert np.array_equal(row_weights(np.arange(7), 20), row_weights(np.arange(7), 20))
        assert np.all(row_weights(np.arange(7), 20).sum(axis=1) == 7)
        assert not np.array_equal(
            row_weights(np.arange(7), 20), row_weights(np.arange(7), 20, "hole-free")
        )
        rows = row_weights(np.array([9, 4, 9]), 20)
        assert np.array_equal(rows[:, 0], rows[:, 2])
        assert np.array_equal(rows[:, 1], row_weights(np.arange(2), 20)[:, 0])

    def test_weights_come_in_blocks(self):
        boards = np.arange(CELLS // 30) % 50, np.arange(40) % 9
        blocks = list(weights_in_blocks(100, (boards[0], "damaged"), (boards[1], "hole-free")))
        assert len(blocks) == 4
        assert max(block[0].size for block in blocks) <= CELLS
        for joined, board, population in zip(
            zip(*blocks, strict=True), boards, ("damaged", "hole-free"), strict=True
        ):
            assert np.array_equal(np.concatenate(joined), row_weights(board, 100, population))

    def test_more_boards_need_little_more_memory(self):
        """Sizes refitted on 250 boards, of 8 damages each, rather than on 100: less than 5 kB for
        each more."""
        peaks = []
        for boards in (100, 250):
            inspected = set_up(Study(boards=boards, hole_free_boards=0)).inspected
            targets = targets_of(
                inspected.board, inspected.hole, inspected.diameter_mm, inspected.hit
            )
            tracemalloc.start()
            refitted_sizes(targets, PodCurve("logit", False, 6.0, 1.0, np.eye(2)), (0.5, 0.9))
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        assert peaks[1] - peaks[0] < 150 * 5000

    @pytest.mark.parametrize("link", LINKS)
    @pytest.mark.parametrize("log_size", [False, True])
    def test_a_draw_is_the_fit_of_its_boards(
        self,
        small,
        link,
        log_size,
    ):
        inspected = small.inspected
        targets = targets_of(inspected.board, inspected.hole, inspected.diameter_mm, inspected.hit)
        curve = fit_hit_miss(
            inspected.diameter_mm, inspected.hit, link=link, log_size=log_size
        ).curve
        drawn = refitted_sizes(targets, curve, (0.5, 0.9), 6)
        for k, weight in enumerate(row_weights(inspected.board, 6)):
            again = np.repeat(np.arange(120), weight.astype(int))
            fit = fit_hit_miss(
                inspected.diameter_mm[again], inspected.hit[again], link=link, log_size=log_size
            )
            assert drawn[0, k] == pytest.approx(fit.curve.size_at(0.5), rel=1e-5)
            assert drawn[1, k] == pytest.approx(fit.curve.size_at(0.9), rel=1e-5)

    @pytest.mark.parametrize("link", LINKS)
    @pytest.mark.parametrize("repeats", [1, 3])
    def test_a_draw_whose_hits_and_misses_are_apart_is_the_penalised_fit_of_its_boards(
        self,
        small,
        link,
        repeats,
    ):
        """cloglog and loglog have two maxima in some draws, and the fit as the draw takes the
        higher one."""
        size = np.repeat(small.inspected.diameter_mm, repeats)
        board = np.repeat(small.inspected.board, repeats)
        hole = np.repeat(small.inspected.hole, repeats)
        hit = size > 5.5
        curve = fit_hit_miss(size, hit, link=link).curve
        drawn = refitted_sizes(targets_of(board, hole, size, hit), curve, (0.5, 0.9), 6)
        for k, weight in enumerate(row_weights(board, 6).astype(int)):
            again = np.repeat(np.arange(len(size)), weight)
            copy = np.concatenate([np.arange(times) for times in weight])
            names = [
                f"{board[row]}:{hole[row]}:{number}"
                for row, number in zip(again, copy, strict=True)
            ]
            fit = fit_hit_miss(size[again], hit[again], link=link, inspections=names)
            assert fit.method == "Firth"
            assert fit.repeats == repeats
            assert drawn[0, k] == pytest.approx(fit.curve.size_at(0.5), rel=1e-4)
            assert drawn[1, k] == pytest.approx(fit.curve.size_at(0.9), rel=1e-4)

    def test_a_draw_of_repeats_is_the_fit_of_their_rows(self, repeated):
        inspected = repeated.inspected
        targets = targets_of(inspected.board, inspected.hole, inspected.diameter_mm, inspected.hit)
        assert np.all(targets.inspections == 3)
        assert targets.hits.sum() == inspected.hit.sum()
        curve = fit_hit_miss(inspected.diameter_mm, inspected.hit).curve
        again = np.repeat(np.arange(360), row_weights(inspected.board, 1)[0].astype(int))
        fit = fit_hit_miss(inspected.diameter_mm[again], inspected.hit[again])
        assert refitted_sizes(targets, curve, (0.9,), 1)[0, 0] == pytest.approx(
            fit.curve.size_at(0.9), rel=1e-5
        )

    @pytest.mark.slow
    @pytest.mark.parametrize("boards_mm, low, high", [(0.0, 0.9, 1.1), (2.5, 1.7, 3.5)])
    def test_design_effect_is_one_of_independent_damage_and_more_where_boards_matter(
        self,
        boards_mm,
        low,
        high,
    ):
        """Means over 100 studies of 30 boards; of one study the ratio is known to about 25 %."""
        effects = []
        for seed in range(100):
            inspected = set_up(
                Study((SetUp(boards_mm=boards_mm),), boards=30, hole_free_boards=0, seed=seed)
            ).inspected
            targets = targets_of(
                inspected.board, inspected.hole, inspected.diameter_mm, inspected.hit
            )
            effects.append(
                design_effect(
                    targets, fit_hit_miss(inspected.diameter_mm, inspected.hit).curve, 0.9
                )
            )
        assert low < np.mean(effects) < high

    @pytest.mark.slow
    def test_the_spread_of_draws_is_the_estimates_standard_error(self):
        """Over 100 studies of 30 boards that matter: the standard deviation of a90 against the
        mean of the draws'."""
        estimates = []
        spreads = []
        for seed in range(100):
            inspected = set_up(
                Study((SetUp(boards_mm=1.5),), boards=30, hole_free_boards=0, seed=seed)
            ).inspected
            curve = fit_hit_miss(inspected.diameter_mm, inspected.hit).curve
            targets = targets_of(
                inspected.board, inspected.hole, inspected.diameter_mm, inspected.hit
            )
            estimates.append(curve.size_at(0.9))
            spreads.append(refitted_sizes(targets, curve, (0.9,), 100)[0].std())
        assert np.mean(spreads) == pytest.approx(np.std(estimates), rel=0.25)

    def test_bound_over_boards_and_intervals_are_of_curves_shifted_from_board_to_board(self):
        limit = limit_of(set_up(Study((SetUp(boards_mm=3.0),), boards=30)), draws=20)
        inspected = limit.record.inspected
        targets = targets_of(inspected.board, inspected.hole, inspected.diameter_mm, inspected.hit)
        effect = design_effect(targets, limit.statement.curve, 0.9)
        assert effect == limit.design_effect > 1.3
        clustered = ClusterAverage(limit.statement.average, inspected.board)
        assert limit.over_boards == clustered.bound()
        assert limit.over_boards.value > limit.a90_95.value
        assert limit.a50_interval_mm == clustered.interval(0.5)
        assert limit.a90_interval_mm == clustered.interval(0.9)
        calm = limit_of(set_up(Study(boards=30, hole_free_boards=0, seed=3)), draws=20)
        assert calm.design_effect <= 1
        assert calm.over_boards.value == pytest.approx(calm.a90_95.value, rel=0.02)

    def test_all_found_counts_one_damage_a_board(self):
        record = set_up(Study(boards=30, hole_free_boards=0))
        limit = limit_of(with_hits(record, np.ones(240, bool)))
        smallest = [
            record.inspected.diameter_mm[record.inspected.board == board].min()
            for board in range(30)
        ]
        assert limit.over_boards.value == np.sort(smallest)[28] > limit.a90_95.value

    def test_design_effect_of_boards_with_one_damage_is_one(self, small):
        inspected = small.inspected
        targets = targets_of(np.arange(120), inspected.hole, inspected.diameter_mm, inspected.hit)
        curve = fit_hit_miss(inspected.diameter_mm, inspected.hit).curve
        assert design_effect(targets, curve, 0.9) == pytest.approx(1.0, rel=1e-12)

    def test_design_effect_of_copied_damage_is_the_number_of_copies(self, small):
        """Every damage eight times on a board of its own: 8, but for G / (G - 1) of 120 boards and
        of 960 targets."""
        inspected = small.inspected
        size = np.repeat(inspected.diameter_mm, 8)
        hit = np.repeat(inspected.hit, 8)
        targets = targets_of(np.repeat(np.arange(120), 8), np.tile(np.arange(8), 120), size, hit)
        curve = fit_hit_miss(inspected.diameter_mm, inspected.hit).curve
        assert design_effect(targets, curve, 0.9) == pytest.approx(
            8 * (120 / 119) / (960 / 959), rel=1e-9
        )

    @settings(max_examples=20, deadline=None)
    @given(st.integers(0, 10_000), st.floats(0.1, 10.0))
    def test_another_unit_of_size_scales_every_draw(self, seed, unit):
        rng = np.random.default_rng(seed)
        size = rng.uniform(1, 10, 60)
        board = np.repeat(np.arange(12), 5)
        hit = rng.random(60) < 1 / (1 + np.exp(-(size - 5)))
        curve = PodCurve("logit", False, 5.0, 1.0, np.zeros((2, 2)))
        scaled = PodCurve("logit", False, 5.0 * unit, unit, np.zeros((2, 2)))
        hole = np.arange(60)
        sizes = refitted_sizes(targets_of(board, hole, size, hit), curve, (0.5,), 10)
        scaled_sizes = refitted_sizes(targets_of(board, hole, size * unit, hit), scaled, (0.5,), 10)
        assert np.allclose(scaled_sizes, sizes * unit, rtol=1e-4)

    def test_percentiles(self):
        values = np.arange(1.0, 101.0)
        assert percentiles(values) == type(percentiles(values))(3.0, 98.0)
        assert percentiles(np.array([np.nan, np.nan, 1.0])).known is False
        assert percentiles(np.r_[values, np.full(100, np.inf)]).high == np.inf
