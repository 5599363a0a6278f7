"""Chance hits, curves over thresholds, the surface over diameter and depth, POD in a table, and
lines over axes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from scipy import special, stats

from harness.evaluation.intervals import false_call_rate, percentiles
from harness.evaluation.study.boards import weights_in_blocks
from harness.evaluation.study.curves import chance_hits, free_response, pixel_curves, roc_curve
from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.record import SetUpRecord
from harness.evaluation.study.result import FRAMES, axis_lines, difference
from harness.evaluation.study.surface import surface_of
from harness.records.trials import ResultTables
from tests.support.synthetic_study import (
    PIXEL_GRID,
    RADIUS_MM,
    THRESHOLD,
    SetUp,
    Study,
    study_record,
    study_tables,
)

LOUD = 20.0
"""False calls per square metre of a study in which chance hits are frequent enough to be counted.
"""


@pytest.fixture(scope="module")
def loud() -> ResultTables:
    return study_tables(Study((SetUp(false_calls_per_m2=LOUD),), boards=30, hole_free_boards=30))


def two_boards(findings: list[tuple[str, int, float, float, str]]) -> ResultTables:
    """Boards 0 and 1 with a damage at (0, 0) and (50, 0), hole-free board 9; findings (role,
    board, x, y, hole)."""
    damages = {"hole": ["a", "b"], "true_x_mm": [0.0, 50.0], "true_y_mm": [0.0, 0.0]}
    holes = pd.DataFrame({"board": [0, 1], "repeat": 0, **damages})
    runs = pd.DataFrame(
        {"role": ["damaged", "damaged", "hole_free"], "board": [0, 1, 9], "repeat": 0}
    )
    rows = [(role, board, 0, x, y, hole) for role, board, x, y, hole in findings]
    table = pd.DataFrame(rows, columns=["role", "board", "repeat", "x_mm", "y_mm", "hole"])
    none = pd.DataFrame()
    return ResultTables(holes, runs, none, none, none, none, findings=table)


class TestChance:
    def test_places_are_laid_over_other_boards_only(self):
        """a lies near board 1's stray finding and on the hole-free board's; b near neither; b's
        own is not counted."""
        tables = two_boards(
            [
                ("damaged", 1, 3.0, 0.0, ""),
                ("damaged", 1, 52.0, 0.0, ""),
                ("hole_free", 9, 0.0, -4.9, ""),
            ]
        )
        chance = chance_hits(tables.holes, tables.sites, tables.runs, tables.findings, 5.0)
        # a over board 1: hit; b over board 0: not; a, b over board 9: one of two
        assert chance.laid == 4
        assert chance.probability == 0.5

    def test_findings_that_count_for_damage_are_no_chance(self):
        tables = two_boards([("damaged", 1, 0.0, 0.0, "b")])
        chance = chance_hits(tables.holes, tables.sites, tables.runs, tables.findings, 5.0)
        assert chance.probability == 0

    def test_the_radius_is_included(self):
        tables = two_boards([("hole_free", 9, 0.0, 5.0, "")])
        assert (
            chance_hits(tables.holes, tables.sites, tables.runs, tables.findings, 5.0).probability
            == 0.25
        )
        assert (
            chance_hits(tables.holes, tables.sites, tables.runs, tables.findings, 4.999).probability
            == 0
        )

    def test_findings_spread_evenly_hit_as_their_rate_says(self, loud):
        rate = false_call_rate(int(LOUD * 7.5), 7.5)
        chance = chance_hits(loud.holes, loud.sites, loud.runs, loud.findings, RADIUS_MM, rate)
        expected = -np.expm1(-LOUD * np.pi * (RADIUS_MM / 1000) ** 2)
        assert chance.expected == pytest.approx(expected, rel=1e-12)
        assert chance.probability == pytest.approx(expected, rel=0.3)
        assert chance.laid == 240 * 59
        assert chance.sites == 240
        assert chance.sites_interval.low < expected < chance.sites_interval.high
        assert chance.of_sites == loud.sites["detected"].mean()

    def test_repeats_of_a_site_are_shares_of_it(self):
        tables = two_boards([])
        sites = pd.DataFrame(
            {"board": [9, 9, 8], "hole": "a", "repeat": [0, 1, 0], "detected": [True, False, False]}
        )
        chance = chance_hits(tables.holes, sites, tables.runs, tables.findings, 5.0)
        assert chance.sites == 2
        assert chance.of_sites == 0.25


class TestRoc:
    def test_area_is_that_of_the_rank_test(self, loud):
        curve = roc_curve(loud.holes, loud.sites, THRESHOLD)
        positive = loud.holes["signal"].to_numpy()
        negative = loud.sites["signal"].to_numpy()
        ranks = stats.mannwhitneyu(positive, negative).statistic / (len(positive) * len(negative))
        assert curve.area == pytest.approx(ranks, rel=1e-12)
        assert np.trapezoid(curve.true, curve.false) == pytest.approx(ranks, rel=1e-9)
        assert curve.in_use == ((negative > THRESHOLD).mean(), (positive > THRESHOLD).mean())

    def test_ties_and_unjudged_places_by_hand(self):
        """Signals 2, 1, none against 1, none: won 2 + 1.5 + 0.5 of 6."""
        holes = pd.DataFrame(
            {"board": [0, 1, 1], "true_diameter_mm": 5.0, "signal": [2.0, 1.0, np.nan]}
        )
        sites = pd.DataFrame({"board": [8, 9], "signal": [1.0, np.nan]})
        curve = roc_curve(holes, sites, 0.5)
        assert curve.area == pytest.approx(4 / 6)
        assert curve.in_use == (0.5, pytest.approx(2 / 3))
        assert curve.false[0] == 0
        assert curve.true[0] == 0
        assert curve.false[-1] == 1
        assert curve.true[-1] == 1

    def test_none_without_sites(self, loud):
        assert roc_curve(loud.holes, loud.sites.iloc[:0], THRESHOLD) is None


class TestFreeResponse:
    def test_the_threshold_in_use_lies_on_the_curve(self, loud):
        curve = free_response(loud.operating, loud.runs, loud.holes)
        index = np.flatnonzero(curve.threshold == THRESHOLD)[0]
        assert curve.in_use == (curve.false_calls_per_m2[index], curve.found_share[index])
        assert curve.in_use[1] == loud.holes["detected"].mean()
        assert curve.found_low[index] < curve.in_use[1] < curve.found_high[index]
        assert curve.area_m2 == pytest.approx(30 * 0.25)

    def test_the_rate_is_that_of_hole_free_boards_alone(self, loud):
        """So it is the table's, though damaged boards have false calls of their own."""
        curve = free_response(loud.operating, loud.runs, loud.holes)
        runs = loud.runs[loud.runs["role"] == "hole_free"]
        assert curve.in_use[0] == runs["false_calls"].sum() / runs["inspected_m2"].sum()
        operating = loud.operating.copy()
        operating.loc[operating["role"] == "damaged", "findings"] = operating["findings"] + 7
        again = free_response(operating, loud.runs, loud.holes)
        assert np.array_equal(again.false_calls_per_m2, curve.false_calls_per_m2)

    def test_what_folds_back_is_left_out(self):
        """Calls 0, 2, 1, 2, 3, 1 as the threshold falls from 6 to 1: at 4 and at 1 there are fewer
        than before."""
        grid = np.arange(1.0, 7.0)
        calls = np.array([1, 3, 2, 1, 2, 0])
        none = np.zeros(6, int)
        free = pd.DataFrame(
            {
                "role": "hole_free",
                "board": 9,
                "threshold": [grid],
                "findings": [calls],
                "hits": [none],
            }
        )
        hits = free.assign(role="damaged", board=0, hits=[np.array([0, 2, 1, 1, 1, 0])])
        runs = pd.DataFrame(
            {"role": ["hole_free", "damaged"], "inspected_m2": 0.5, "false_calls": [2, 8]}
        )
        holes = pd.DataFrame(
            {"board": 0, "true_diameter_mm": 5.0, "signal": [7.0, 2.5], "detected": [True, False]}
        )
        curve = free_response(pd.concat([free, hits]), runs, holes, draws=10)
        assert curve.threshold.tolist() == [6.0, 5.0, 3.0, 2.0]
        assert curve.false_calls_per_m2.tolist() == [0.0, 4.0, 4.0, 6.0]
        assert curve.found_share.tolist() == [0.0, 0.5, 0.5, 1.0]
        assert curve.in_use == (4.0, 0.5)

    def test_none_without_hole_free_boards(self, loud):
        runs = loud.runs[loud.runs["role"] == "damaged"]
        assert free_response(loud.operating, runs, loud.holes) is None

    def test_false_calls_fall_as_their_scores_do(self, loud):
        """Scores are exponential: the logarithm of the rate falls by 1 in a unit of threshold."""
        curve = free_response(loud.operating, loud.runs, loud.holes)
        expected = LOUD * np.exp(THRESHOLD - curve.threshold)
        scatter = np.sqrt(expected / curve.area_m2)
        assert np.all(np.abs(curve.false_calls_per_m2 - expected) < 4 * scatter)
        assert np.all(np.diff(curve.found_share) >= 0)
        assert np.all(np.diff(curve.threshold) < 0)


class TestPixels:
    def test_equal_normal_scores(self, loud):
        """Face N(0, 1), damage N(2, 1): overlap = Phi(2 - z) where the face's rate is f."""
        curves = pixel_curves(loud.pixels)
        rate = np.linspace(1e-9, 0.3, 200_001)
        assert curves.pro == pytest.approx(
            np.trapezoid(stats.norm.sf(stats.norm.isf(rate) - 2), rate) / 0.3, abs=1e-3
        )
        assert curves.why == ""

    def test_by_hand(self):
        """Two damages of 1 and 9 pixels: at a rate of 0.1 the small one is covered, the large one
        not; then both."""
        rows = [
            ("", 100, np.array([50, 10])),
            ("small", 1, np.array([1, 1])),
            ("large", 9, np.array([9, 0])),
        ]
        pixels = pd.DataFrame(rows, columns=["hole", "pixels", "above"]).assign(board=0)
        curves = pixel_curves(pixels)
        # overlap: 0 -> 0.5 over 0.1, then 0.5 -> 1 over 0.4, cut at 0.3 where it is 0.75
        assert curves.pro == pytest.approx((0.1 * 0.25 + 0.2 * 0.625) / 0.3)

    def test_thresholds_that_end_early_give_no_overlap_score(self, loud):
        above = [counts[PIXEL_GRID > 1.0] for counts in loud.pixels["above"]]
        curves = pixel_curves(loud.pixels.assign(above=above))
        assert np.isnan(curves.pro)
        assert "0.1" in curves.why

    def test_none_without_damage(self, loud):
        assert pixel_curves(loud.pixels[loud.pixels["hole"] == ""]) is None
        assert pixel_curves(loud.pixels.iloc[:0]) is None


class TestSurface:
    def study(self, **changes: float) -> Study:
        return Study((SetUp(**changes),), depths_mm=(2.0, 10.0), hole_free_boards=0)

    def test_agrees_with_statsmodels(self):
        sm = pytest.importorskip("statsmodels.api")
        inspected = (record := study_record(self.study(mm_per_depth_mm=0.4)).set_ups[0]).inspected
        surface, _ = surface_of(record)
        columns = [
            np.ones(len(inspected.hit)),
            np.log(inspected.diameter_mm),
            np.log(inspected.depth_mm),
        ]
        link = {"logit": sm.families.links.Logit(), "probit": sm.families.links.Probit()}[
            surface.link
        ]
        fit = sm.GLM(
            inspected.hit.astype(float), np.column_stack(columns), family=sm.families.Binomial(link)
        ).fit()
        assert surface.b[:3] == pytest.approx(fit.params, rel=1e-5)
        assert surface.b[3] == 0
        assert surface.deviance == pytest.approx(fit.deviance, rel=1e-9)

    def drawn(self, predictor: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> SetUpRecord:
        """Hits of chance expit(predictor(ln a, ln d)) on the study's damage."""
        record = study_record(self.study()).set_ups[0]
        inspected = record.inspected
        chance = special.expit(predictor(np.log(inspected.diameter_mm), np.log(inspected.depth_mm)))
        hit = np.random.default_rng(5).random(len(chance)) < chance
        return dataclasses.replace(record, inspected=dataclasses.replace(inspected, hit=hit))

    def test_an_interaction_that_the_data_show_is_fitted(self):
        sm = pytest.importorskip("statsmodels.api")
        record = self.drawn(lambda a, d: -8.0 + 1.0 * a + 0.5 * d + 2.5 * a * d)
        surface, why = surface_of(record, draws=50)
        assert why == surface.note == ""
        assert surface.interaction_p < 0.05
        a = np.log(record.inspected.diameter_mm)
        d = np.log(record.inspected.depth_mm)
        link = {"logit": sm.families.links.Logit(), "probit": sm.families.links.Probit()}[
            surface.link
        ]
        columns = np.column_stack([np.ones_like(a), a, d, a * d])
        fit = sm.GLM(
            record.inspected.hit.astype(float), columns, family=sm.families.Binomial(link)
        ).fit()
        assert surface.b == pytest.approx(fit.params, rel=1e-4)
        assert surface.deviance == pytest.approx(fit.deviance, rel=1e-9)

    def test_on_the_contour_the_pod_is_as_stated(self):
        """The depths fall as the diameter grows."""
        surface, _ = surface_of(
            self.drawn(lambda a, d: -8.0 + 1.0 * a + 0.5 * d + 2.5 * a * d), draws=50
        )
        reached = np.isfinite(surface.d90_mm)
        assert surface.pod(surface.diameter_mm, surface.d90_mm)[reached] == pytest.approx(
            0.9, abs=1e-9
        )
        assert reached.sum() > 15
        assert np.all(np.diff(surface.d90_mm[reached]) < 0)
        assert np.all(surface.d90_low_mm <= surface.d90_mm)
        assert np.all(surface.d90_mm <= surface.d90_high_mm)

    @pytest.mark.slow
    def test_the_depth_found_holds_the_truth(self):
        """Drawn 15 times from logit = -18 + 9 ln a + 3 ln d: percentiles of so few boards
        hold the truth in some 87 % of studies, so fewer than 11 of 15 in 4 % of such tests."""
        record = study_record(Study(boards=30, depths_mm=(2.0, 10.0), hole_free_boards=0)).set_ups[
            0
        ]
        covered = 0
        inspected = record.inspected
        chance = special.expit(
            -18.0 + 9.0 * np.log(inspected.diameter_mm) + 3.0 * np.log(inspected.depth_mm)
        )
        for seed in range(15):
            hit = np.random.default_rng(seed).random(len(chance)) < chance
            again = dataclasses.replace(record, inspected=dataclasses.replace(inspected, hit=hit))
            surface, _ = surface_of(again, draws=100)
            index = int(np.abs(surface.diameter_mm - 5.0).argmin())
            true = np.exp(
                (special.logit(0.9) + 18.0 - 9.0 * np.log(surface.diameter_mm[index])) / 3.0
            )
            covered += surface.d90_low_mm[index] < true < surface.d90_high_mm[index]
        assert covered >= 11

    def test_a_chance_that_falls_with_diameter_has_none(self):
        surface, why = surface_of(self.drawn(lambda a, d: 3.0 - 2.0 * a + 0.5 * d))
        assert surface is None
        assert why == "the probability of detection does not grow with diameter"

    def test_a_chance_that_falls_with_depth_is_said(self):
        surface, _ = surface_of(self.drawn(lambda a, d: -3.0 + 4.0 * a - 2.0 * d), draws=50)
        assert surface.note.startswith("POD falls with depth")

    def test_refused_where_depth_does_not_vary(self):
        surface, why = surface_of(study_record(Study(hole_free_boards=0)).set_ups[0])
        assert surface is None
        assert why == "depth does not vary: 5 to 5 mm"

    def test_refused_where_a_plane_parts_hits_from_misses(self):
        record = study_record(self.study()).set_ups[0]
        inspected = record.inspected
        hit = np.log(inspected.diameter_mm) + 0.3 * np.log(inspected.depth_mm) > 2.2
        surface, why = surface_of(
            dataclasses.replace(record, inspected=dataclasses.replace(inspected, hit=hit))
        )
        assert surface is None
        assert "separation" in why


@pytest.fixture(scope="module")
def limits() -> list[SetUpLimit]:
    """Two distances, two cameras and two numbers of frames, but not all of them together."""
    study = Study(
        (
            SetUp("far", 1, {"distance": 1.2, "camera": "b"}, a50_mm=7.0),
            SetUp("far", 20, {"distance": 1.2, "camera": "b"}, a50_mm=7.0),
            SetUp("near", 1, {"distance": 0.6, "camera": "b"}, a50_mm=4.0),
            SetUp("other", 1, {"distance": 0.6, "camera": "a"}, a50_mm=4.0),
        ),
        boards=30,
        hole_free_boards=0,
    )
    return [limit_of(record, draws=200) for record in study_record(study).set_ups]


class TestAxes:
    def test_lines_differ_in_one_axis_alone(self, limits):
        lines = axis_lines(limits)
        assert [(line.axis, line.values) for line in lines] == [
            ("distance", (0.6, 1.2)),
            ("camera", ("b", "a")),
            (FRAMES, (1, 20)),
        ]
        assert lines[0].fixed == {"camera": "b", FRAMES: 1}
        assert lines[0].numeric
        assert not lines[1].numeric
        assert lines[0].limits == (limits[2], limits[0])

    def test_what_differs_is_told_from_what_does_not(self, limits):
        distance, camera, _ = axis_lines(limits)
        assert distance.steps[0].paired
        assert distance.steps[0].beyond_chance
        assert distance.steps[0].interval.low > 1
        assert not camera.steps[0].beyond_chance
        assert camera.steps[0].interval.low < 1 < camera.steps[0].interval.high
        assert distance.steps[0].ratio == limits[0].a90_mm / limits[2].a90_mm
        assert len(distance.steps) == 1

    def test_pairing_cancels_what_boards_do_to_both(self):
        study = Study(
            (
                SetUp(boards_mm=2.0, own_noise=0.1),
                SetUp("b", boards_mm=2.0, own_noise=0.1, a50_mm=5.9),
            ),
            boards=30,
            hole_free_boards=0,
        )
        records = study_record(study).set_ups
        first = limit_of(records[0], draws=300)
        second = limit_of(records[1], draws=300)
        paired = difference(first, second)
        elsewhere = dataclasses.replace(
            second.record.inspected, x_mm=second.record.inspected.x_mm + 1
        )
        moved = dataclasses.replace(second.record, targets_digest="others", inspected=elsewhere)
        unpaired = difference(first, dataclasses.replace(second, record=moved))
        assert paired.paired
        assert not unpaired.paired
        assert unpaired.ratio == paired.ratio
        assert unpaired.interval.high - unpaired.interval.low > 1.5 * (
            paired.interval.high - paired.interval.low
        )


class TestEdges:
    """What curves hold where one of their tables is empty or ends early."""

    def test_free_response_needs_every_table(self, loud):
        runs = loud.runs
        assert free_response(loud.operating.iloc[:0], runs, loud.holes) is None
        assert free_response(loud.operating, runs, loud.holes.iloc[:0]) is None
        assert free_response(loud.operating, pd.DataFrame(), loud.holes) is None

    def test_intervals_of_a_free_response_are_over_boards(self, loud):
        curve = free_response(loud.operating, loud.runs, loud.holes, draws=30)
        index = np.flatnonzero(curve.threshold == THRESHOLD)[0]
        boards = np.unique(loud.holes["board"])
        hits = loud.holes.groupby("board")["detected"].sum().to_numpy(float)
        count = loud.holes.groupby("board").size().to_numpy(float)
        (weights,) = next(iter(weights_in_blocks(30, (boards, "damaged"))))
        expected = percentiles((weights @ hits) / (weights @ count))
        assert curve.found_low[index] == pytest.approx(expected.low)
        assert curve.found_high[index] == pytest.approx(expected.high)

    def test_pixels_that_end_early_keep_their_curves(self):
        rows = [("", 100, np.array([20, 10])), ("a", 4, np.array([3, 1]))]
        pixels = pd.DataFrame(rows, columns=["hole", "pixels", "above"])
        curves = pixel_curves(pixels)
        assert curves.false.tolist() == [0.0, 0.1, 0.2, 1.0]
        assert curves.overlap.tolist() == [0.0, 0.25, 0.75, 1.0]
        assert np.isnan(curves.pro)
        assert curves.why == "the thresholds counted end at a false-positive rate of 0.2"

    def test_pixels_that_are_all_found_early_have_an_area(self):
        rows = [("", 100, np.array([20, 10])), ("a", 4, np.array([4, 2]))]
        pixels = pd.DataFrame(rows, columns=["hole", "pixels", "above"])
        curves = pixel_curves(pixels)
        # 0 -> 0.5 over 0.1, then 0.5 -> 1 over 0.1, then 1 over 0.1
        assert curves.pro == pytest.approx((0.1 * 0.25 + 0.1 * 0.75 + 0.1) / 0.3)
        assert curves.why == ""

    def test_chance_without_sites_and_without_a_rate(self, loud):
        chance = chance_hits(loud.holes, pd.DataFrame(), loud.runs, loud.findings, RADIUS_MM)
        assert chance.sites == 0
        assert np.isnan(chance.of_sites)
        assert np.isnan(chance.expected)
        assert not chance.sites_interval.known
        only = loud.runs.iloc[:0]
        assert np.isnan(chance_hits(loud.holes, pd.DataFrame(), only, only, RADIUS_MM).probability)
