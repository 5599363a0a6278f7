"""The page of filters: the change of a90 of each in a figure, and the table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.study.record import StudyRecord
from harness.programs.filters.costs import FilterCost
from harness.programs.filters.tables import FILTER_COSTS
from harness.report.blocks import (
    BLUE,
    GREY,
    RED,
    command_of,
    figure,
    heading,
    note,
    page,
    svg,
)
from harness.vocabulary.text import Grid, many, size

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN = 5.4
ROW_IN = 0.36
"""Height of a filter in the figure."""
PANEL_IN = 0.7
"""Height of a panel's title and axis."""
READ = (
    "Each filter acts on the same frames of the same boards, with a threshold of its own that is "
    "learned on hole-free boards for the same rate of false calls. Changes of a90 have 95 % "
    "intervals over boards, which both set-ups share. Calls at the old threshold are those of a "
    "user who adds the filter and keeps the threshold. Biases are means over hits, which differ "
    "from filter to filter."
)


def clear_changes(costs: Sequence[FilterCost]) -> tuple[list[FilterCost], list[FilterCost]]:
    """Return the costs whose interval lies above 0, largest first, and those below, likewise."""
    lost = [cost for cost in costs if cost.change_interval_mm.low > 0]
    won = [cost for cost in costs if cost.change_interval_mm.high < 0]
    lost.sort(key=lambda cost: -cost.change_mm)
    won.sort(key=lambda cost: cost.change_mm)
    return lost, won


def answer(costs: Sequence[FilterCost]) -> str:
    """State the largest clear loss and gain of a90 in a sentence each."""
    filtered = [cost for cost in costs if cost.is_filtered]
    lost, won = clear_changes(filtered)
    if not lost and not won:
        return "No filter changes the smallest hole found beyond the study's precision."
    sentences = []
    if won:
        sentences.append(f"Largest gain: {_clause(won[0])}.")
    else:
        sentences.append("No filter finds smaller holes.")
    if lost:
        sentences.append(f"Largest loss: {_clause(lost[0])}.")
    unclear = len(filtered) - len(lost) - len(won)
    if unclear:
        sentences.append(f"Of {many(len(filtered), 'change')}, {unclear} cannot be told from none.")
    return " ".join(sentences)


def _clause(cost: FilterCost) -> str:
    """Return filter, place and change as the end of a sentence."""
    before = size(cost.without.a90_mm, cost.without.largest_mm)
    now = size(cost.limit.a90_mm, cost.limit.largest_mm)
    return f"{cost.filter_name}, a90 from {before} to {now} mm ({cost.place})"


def changes_figure(costs: Sequence[FilterCost]) -> str:
    """Draw the change of a90 of each filter with its interval, one panel for each place."""
    filtered = [cost for cost in costs if cost.is_filtered]
    set_ups = list(dict.fromkeys(cost.place for cost in filtered))
    widest_mm = max((_reach_mm(cost) for cost in filtered), default=1.0)

    def draw(drawing: Figure) -> None:
        rows = [[cost for cost in filtered if cost.place == set_up] for set_up in set_ups]
        heights = [len(of_place) for of_place in rows]
        panels = drawing.subplots(len(set_ups), 1, squeeze=False, height_ratios=heights)
        for axes, set_up, of_place in zip(panels[:, 0], set_ups, rows, strict=True):
            _draw_panel(axes, of_place, widest_mm)
            axes.set_title(set_up, loc="left", fontsize=10)
        panels[-1, 0].set_xlabel("change of a90 against no filter (mm); right: larger holes only")

    height_in = ROW_IN * len(filtered) + PANEL_IN * len(set_ups)
    alt = " ".join(f"{_clause(cost)}." for cost in filtered)
    return svg("changes", (WIDTH_IN, height_in), alt, draw)


def _reach_mm(cost: FilterCost) -> float:
    """Return how far a change and its interval reach from 0, as far as inspections support."""
    interval = cost.change_interval_mm
    ends_mm = np.minimum([cost.change_mm, interval.low, interval.high], cost.most_mm)
    return float(np.abs(ends_mm[np.isfinite(ends_mm)]).max(initial=0.1))


def _draw_panel(axes: Axes, costs: Sequence[FilterCost], widest_mm: float) -> None:
    """Draw the filters of one place, each in a row with its name."""
    axes.axvline(0, color=GREY, lw=1)
    for row, cost in enumerate(costs):
        interval = cost.change_interval_mm
        colour = GREY
        if interval.low > 0:
            colour = RED
        elif interval.high < 0:
            colour = BLUE
        if not np.isfinite(cost.change_mm):
            axes.text(0, row, " no limit", va="center", fontsize=9)
            continue
        ends_mm = np.clip([interval.low, interval.high], -widest_mm, cost.most_mm)
        axes.plot(ends_mm, [row, row], color=colour, lw=1.6, label=cost.filter_name)
        is_known = cost.change_mm <= cost.most_mm
        marker = "o" if is_known else ">"
        axes.plot(min(cost.change_mm, cost.most_mm), row, marker, color=colour, ms=5)
    axes.set_yticks(range(len(costs)), [cost.filter_name for cost in costs])
    axes.set(xlim=(-1.05 * widest_mm, 1.05 * widest_mm), ylim=(len(costs) - 0.5, -0.5))
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)


def filters_parts(costs: Sequence[FilterCost]) -> list[str | Grid]:
    """Return the parts for a terminal: the table and the answer."""
    return [FILTER_COSTS.grid(costs, terminal=True), "", answer(costs)]


def filters_html(study: StudyRecord, costs: Sequence[FilterCost], command: str) -> str:
    """Return the page as text; it needs no network."""
    detectors = ", ".join(dict.fromkeys(set_up.detector for set_up in study.set_ups))
    conditions = (
        f"Study {study.name}: {many(costs[0].limit.targets, 'hole')} on "
        f"{many(costs[0].limit.boards, 'board')} for each row, detector {detectors}."
    )
    caption = (
        "Change of a90, the size found nine times out of ten, with its 95 % interval over "
        "boards. Red: clearly worse; blue: clearly better; arrow: beyond the sizes."
    )
    drawn = figure({"changes": changes_figure(costs)}, "changes", caption)
    body = [
        drawn,
        heading("Filters"),
        FILTER_COSTS.grid(costs).html(),
        note(READ),
        *command_of(command),
    ]
    return page("What does a filter cost?", answer(costs), body, [note(conditions)])
