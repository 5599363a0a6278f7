"""The tornado chart: how far each unknown alone moves a90, largest first."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.study.result import SetUpResult
from harness.evaluation.study.unknowns import UnknownEffect
from harness.report.blocks import BLUE, GREY, PALE, svg
from harness.report.pod import plain
from harness.tables.unknowns import level_text, unknown_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BAR = 0.55
"""Height of a bar, of the distance between two."""
ROOM = 1.3
"""Right end of the axis over the largest size inspected."""


def tornado_figure(name: str, result: SetUpResult, stated_mm: float) -> str:
    """Draw a bar for each unknown of a set-up from its smallest a90 to its largest, with the
    interval of each end, and a line at a90 at the stated values."""
    unknowns = result.unknowns
    assert unknowns is not None
    names = unknown_names(unknowns.effects)
    most_mm = ROOM * result.limit.largest_mm

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for row, effect in enumerate(unknowns.effects):
            _draw_bar(axes, row, effect, most_mm)
        if np.isfinite(stated_mm):
            axes.axvline(stated_mm, color=GREY, lw=1.0, ls="--", label="at the stated values")
        if np.isfinite(result.limit.a90_mm):
            label = "over all unknowns"
            axes.axvline(result.limit.a90_mm, color=GREY, lw=1.0, label=label)
        labels = [plain(names[effect.unknown.key]) for effect in unknowns.effects]
        axes.set_yticks(range(len(labels)), labels)
        axes.set_ylim(len(labels) - 0.4, -0.6)
        right_mm = min(axes.get_xlim()[1], most_mm)
        axes.set_xlim(right=right_mm)
        axes.set_xlabel("a90 (mm)")
        handles, texts = axes.get_legend_handles_labels()
        figure.legend(handles, texts, loc="outside lower center", ncols=2)

    alt = f"How far each unknown moves a90 of {result.limit.record.label}, as unknowns.csv says."
    return svg(name, (7.0, 1.4 + 0.45 * len(unknowns.effects)), alt, draw)


def _draw_bar(axes: Axes, row: int, effect: UnknownEffect, most_mm: float) -> None:
    """Draw the bar of an unknown in a row; pale if its effect may be chance."""
    colour = BLUE if effect.beyond_chance else PALE
    sizes_mm = np.minimum(effect.a90_mm, most_mm)
    least_mm = sizes_mm[effect.least]
    length_mm = sizes_mm[effect.most] - least_mm
    axes.barh(row, length_mm, BAR, left=least_mm, color=colour)
    for level, side in ((effect.least, -1), (effect.most, 1)):
        ends = effect.intervals_mm[level]
        low_mm = min(ends.low, most_mm)
        high_mm = min(ends.high, most_mm)
        axes.plot([low_mm, high_mm], [row + side * 0.2] * 2, color=GREY, lw=1.0)
        axes.annotate(
            plain(level_text(effect, level)),
            (sizes_mm[level], row),
            (6 * side, 0),
            textcoords="offset points",
            ha="left" if side > 0 else "right",
            va="center",
            fontsize=8,
        )
