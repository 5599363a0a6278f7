"""The tornado chart: its bars, lines and values stand where its axis says."""

import re
from dataclasses import replace

import numpy as np
import pytest

from harness.evaluation.intervals import Interval
from harness.evaluation.study.result import evaluate_study
from harness.report.tornado import tornado_figure
from tests.support.drawn_unknowns import drawn_set_up
from tests.support.synthetic_study import study_record, study_tables


@pytest.fixture(scope="module")
def judged():
    record = replace(study_record(), set_ups=(drawn_set_up(boards=60),))
    return evaluate_study(record, study_tables(), {}, draws=40).set_ups[0]


def _sizes_mm(figure, places_px):
    """Return the sizes at places (px) by the axis' own texts."""
    ticks = re.findall(r'<text x="([\d.]+)" y="[\d.]+">([\d.]+)</text>', figure)
    px, mm = np.array(ticks, float).T
    assert len(px) >= 3
    slope, start = np.polyfit(px, mm, 1)
    return start + slope * np.array(places_px, float)


def test_bars_reach_from_the_smallest_to_the_largest_a90(judged):
    figure = tornado_figure(judged, 5.0)
    bars = re.findall(r'<rect x="([\d.]+)" y="[\d.]+" width="([\d.]+)"[^>]*--(\w+)\)', figure)
    effects = judged.unknowns.effects
    assert len(bars) == len(effects)
    for (left_px, width_px, colour), effect in zip(bars, effects, strict=True):
        ends_mm = _sizes_mm(figure, [float(left_px), float(left_px) + float(width_px)])
        assert ends_mm == pytest.approx([effect.a90_mm.min(), effect.a90_mm.max()], abs=0.02)
        assert (colour == "blue") == effect.beyond_chance


def test_intervals_stand_at_their_ends_and_stop_at_the_axis(judged):
    unknowns = judged.unknowns
    first = unknowns.effects[0]
    endless = [*first.intervals_mm]
    endless[first.highest_level] = Interval(5.0, 1e6)
    changed = replace(first, intervals_mm=tuple(endless))
    effects = (changed, *unknowns.effects[1:])
    figure = tornado_figure(replace(judged, unknowns=replace(unknowns, effects=effects)), 5.0)
    lines = re.findall(
        r'<path d="M([\d.]+) [\d.]+H([\d.]+)" style="stroke:var\(--grey\)"/>', figure
    )
    (axis_left_px, axis_right_px), first_low, first_high, *_ = np.array(lines, float)
    lowest = first.intervals_mm[first.lowest_level]
    assert _sizes_mm(figure, first_low) == pytest.approx([lowest.low, lowest.high], abs=0.02)
    assert _sizes_mm(figure, first_high[:1]) == pytest.approx([5.0], abs=0.02)
    assert first_high[1] == axis_right_px > axis_left_px


def test_lines_stand_at_the_stated_values_and_over_all_unknowns(judged):
    figure = tornado_figure(judged, 5.0)
    both = re.findall(r'<path d="M([\d.]+) 6V[\d.]+" style="stroke:var\(--grey\)"', figure)
    assert _sizes_mm(figure, both) == pytest.approx([5.0, judged.limit.a90_mm], abs=0.02)
    without = tornado_figure(judged, float("nan"))
    assert "at the stated values" in figure and "at the stated values" not in without
