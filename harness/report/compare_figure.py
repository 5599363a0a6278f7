"""Figure: how a90 of each set-up changed from one study to another, with the margin within which nothing is worse."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.study.verdict import MARGIN, ComparedSetUps, Comparison
from harness.report.canvas import BLUE, GREEN, GREY, PALE, RED, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {"worse": RED, "newly failing": RED, "better": GREEN, "newly working": GREEN}


def compare_svg(comparison: Comparison) -> str:
    """One bar a set-up that both studies have: ratio of a90 and the 95 % interval; empty where there is none."""
    rows = [row for row in comparison.rows if row.limit is not None and np.isfinite(row.limit.ratio)]
    if not rows:
        return ""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.axvspan(1 / MARGIN, MARGIN, color=PALE, zorder=0)
        axes.axvline(1, color=GREY, lw=1)
        for place, row in enumerate(rows):
            _bar(axes, place, row)
        axes.set_yticks(range(len(rows)), [row.label for row in rows])
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlabel("a90 of the second study over a90 of the first")
        axes.grid(axis="y", visible=False)

    alt = "Ratio of a90 of the second study to the first, with 95 per cent intervals, for each set-up."
    return svg("compare", (9, 0.38 * len(rows) + 1.1), alt, draw)


def _bar(axes: Axes, place: int, row: ComparedSetUps) -> None:
    """The interval of the difference, as a ratio to the first study's a90."""
    if row.limit is None or row.first is None:
        return
    before, interval, colour = row.first.a90_mm, row.limit.interval_mm, COLOURS.get(row.mark, BLUE)
    if interval.known:
        low = 1 + max(interval.low / before, -0.9)
        high = 1 + min(interval.high / before, 9.0)  # an open interval runs out of the picture
        axes.plot([low, high], [place, place], color=colour, lw=2, solid_capstyle="butt")
    axes.plot([row.limit.ratio], [place], "o", color=colour, ms=6)
