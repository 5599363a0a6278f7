"""Figures of a study's curves: probability of detection with its data, and signals against size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.result import SetUpResult
from harness.report.canvas import GREY, PURPLE, svg
from harness.report.pod import draw_hits, draw_pod, draw_signals, hits_in_view, plain
from harness.report.study_rows import limit_sentence, name_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_PANELS = 6
"""Set-ups shown with their curves; the tables have all."""
PANEL_IN = (5.2, 4.5)
ONE_IN = (8.6, 5.2)
Draw = Callable[["Axes", SetUpLimit], None]


def with_room(set_ups: Sequence[SetUpResult]) -> list[SetUpResult]:
    """Those shown in figures, in their order: all, or `MOST_PANELS` evenly from the smallest limit to the largest."""
    by_limit = sorted(set_ups, key=lambda one: one.limit.a90_95.value)
    places = np.linspace(0, len(by_limit) - 1, min(MOST_PANELS, len(by_limit))).round().astype(int)
    chosen = {id(by_limit[place]) for place in places}
    return [one for one in set_ups if id(one) in chosen]


def curves_figure(limits: Sequence[SetUpLimit]) -> str:
    """A panel for each set-up: hits and misses, the curve with its band, a50, a90 and a90/95, on one scale of sizes."""
    span = _span(limits)

    def draw(axes: Axes, limit: SetUpLimit) -> None:
        if limit.statement is None:
            _without_curve(axes, limit)
        else:
            strength = min(0.6, 150 / max(limit.inspections, 1))
            draw_pod(axes, limit.statement, limit.a90_95, strength, most=limit.largest_mm)
        axes.set(xlim=span, xlabel="diameter (mm)", ylabel="probability of detection")

    return _panels("curves", limits, draw, " ".join(limit_sentence(limit) for limit in limits))


def signals_figure(limits: Sequence[SetUpLimit]) -> str:
    """A panel for each set-up with a regression of its signals: signals against size, the line, the threshold."""

    def draw(axes: Axes, limit: SetUpLimit) -> None:
        assert limit.signals is not None
        draw_signals(axes, limit.signals)
        axes.set(xlim=_span([limit]), xlabel="diameter (mm)", ylabel="highest score at the damage")

    names = "; ".join(name_of(limit) for limit in limits)
    return _panels("signals", limits, draw, f"Score of each damage against its diameter, with the threshold: {names}.")


def _panels(name: str, limits: Sequence[SetUpLimit], draw_one: Draw, alt: str) -> str:
    across = min(2, len(limits))
    down = -(-len(limits) // across)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(down, across, squeeze=False).ravel()
        for axes, limit in zip(grid, limits, strict=False):
            draw_one(axes, limit)
            axes.set_title(plain(fill(name_of(limit), 46 if across > 1 else 80)))
            axes.legend(loc="upper left", bbox_to_anchor=(0, -0.17), ncols=2, borderaxespad=0, fontsize=8)
        for axes in grid[len(limits) :]:
            axes.set_visible(False)

    size = (PANEL_IN[0] * across, PANEL_IN[1] * down) if across > 1 else ONE_IN
    return svg(name, size, alt, draw)


def _without_curve(axes: Axes, limit: SetUpLimit) -> None:
    """Hits and misses alone, and why there is no curve; the bound where one needs no curve."""
    seen = limit.record.inspected
    draw_hits(axes, seen.diameter_mm, seen.hit, strength=min(0.6, 150 / max(limit.inspections, 1)))
    hits_in_view(axes)
    if limit.a90_95.demonstrated:
        axes.plot([limit.a90_95.value], [0.9], "o", color=PURPLE, label=f"a90/95: {limit.a90_95.value:.2f} mm")
    words = fill(f"no curve: {limit.why}", 44)
    axes.text(0.5, 0.5, plain(words), transform=axes.transAxes, ha="center", va="center", color=GREY, fontsize=9)


def _span(limits: Sequence[SetUpLimit]) -> tuple[float, float]:
    """The sizes inspected with 4 % of them on either side; of a single size a tenth of it."""
    sizes = np.concatenate([limit.record.inspected.diameter_mm for limit in limits])
    if not len(sizes):
        return 0.0, 1.0
    low, high = float(sizes.min()), float(sizes.max())
    margin = 0.04 * (high - low) or 0.1 * abs(high) or 0.5
    return (max(low - margin, 0.5 * low) if low > 0 else low - margin), high + margin
