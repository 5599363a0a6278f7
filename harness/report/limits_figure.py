"""The first figure of a study's page: the limit of each set-up, with its name beside it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.study.limit import SetUpLimit
from harness.report.blocks import BLUE, GREY, svg
from harness.report.pod import plain
from harness.tables.limits import is_within_sizes, limit_sentence, short_names
from harness.vocabulary import text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_ROWS = 24
"""Most set-ups that are drawn; a table holds all."""
WIDTH_IN = 4.6
"""Its text is then as large as the page's on a screen of 400 pixels."""
ROW_IN = 0.36
"""Height of a set-up: its name, and below it its sizes."""
MOST_LETTERS = 76
"""Longest name that fits into the width."""
AXIS_IN = 0.75
"""Height of an axis with its title."""


def limits_figure(limits: Sequence[SetUpLimit]) -> str:
    """Draw a90 with its interval and a90/95 of each set-up, a row each, in the order of ``limits``;
    diameters, depths and lengths in panels of their own."""
    drawn = limits[:MOST_ROWS]
    names = _drawn_names(short_names(limits))
    panels = {
        kind: [limit for limit in drawn if limit.record.inspected.limit_of == kind]
        for kind in dict.fromkeys(limit.record.inspected.limit_of for limit in drawn)
    }

    def draw(figure: Figure) -> None:
        heights = [len(rows) for rows in panels.values()]
        grid = figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights)
        for axes, (kind, rows) in zip(grid[:, 0], panels.items(), strict=True):
            _draw_panel(axes, kind, rows, names)

    height_in = ROW_IN * len(drawn) + AXIS_IN * len(panels)
    alt = " ".join(limit_sentence(limit) for limit in drawn)
    return svg("limits", (WIDTH_IN, height_in), alt, draw)


def _drawn_names(names: dict[str, str]) -> dict[str, str]:
    """Return names without what all of several share, such as the number of frames, and cut to
    `MOST_LETTERS`."""
    parts_of = {label: name.split(", ") for label, name in names.items()}
    shared = set.intersection(*(set(parts) for parts in parts_of.values()))
    drawn = {}
    for label, parts in parts_of.items():
        own = [part for part in parts if part not in shared] or parts
        name = ", ".join(own)
        is_long = len(name) > MOST_LETTERS
        drawn[label] = f"{name[: MOST_LETTERS - 1]}…" if is_long else name
    return drawn


def _draw_panel(axes: Axes, kind: str, limits: Sequence[SetUpLimit], names: dict[str, str]) -> None:
    largest_mm = max(limit.largest_mm for limit in limits)
    for row, limit in enumerate(limits):
        name = plain(names[limit.record.label])
        _draw_row(axes, row, limit, name, largest_mm)
        axes.text(0, row - 0.38, name, fontsize=9, va="center")
    axes.set(xlim=(0, 1.02 * largest_mm), ylim=(len(limits) - 0.4, -0.8), yticks=[])
    axes.spines["left"].set_visible(False)
    axes.set_xlabel(f"{kind} found nine times out of ten (mm)")


def _draw_row(axes: Axes, row: int, limit: SetUpLimit, name: str, largest_mm: float) -> None:
    """Draw a90, its interval and a90/95, or words where no limit lies within the sizes."""
    if not is_within_sizes(limit):
        words = f"no limit up to {text.size(limit.largest_mm)} mm"
        axes.text(largest_mm, row, words, ha="right", va="center", fontsize=9, color=GREY)
        return
    interval_mm = limit.a90_interval_mm
    ends_mm = np.clip([interval_mm.low, interval_mm.high], 0, largest_mm)
    axes.plot(ends_mm, [row, row], color=BLUE, lw=1.4, label=name)
    axes.plot(limit.a90_mm, row, "o", color=BLUE, ms=5)
    bound_mm = limit.a90_95.value
    axes.plot(bound_mm, row, "|", color=BLUE, ms=11, mew=2.4)
    right_mm = max(bound_mm, float(ends_mm[1]))
    position = (right_mm, row)
    label = text.size(bound_mm)
    axes.annotate(label, position, (5, 0), textcoords="offset points", va="center", fontsize=9)
