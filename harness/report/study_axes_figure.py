"""Figure: a detection limit against one swept axis, everything else held."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill, shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.study.axes import AxisLine
from harness.evaluation.study.limit import SetUpLimit
from harness.report.canvas import GREY, svg
from harness.report.pod import plain
from harness.report.set_ups_figures import COLOURS, MARKERS
from harness.tables import text
from harness.tables.limits import is_within_sizes
from harness.tables.study import AxisGroup, axis_value
from harness.vocabulary.path_names import value_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


ROOM = 1.3
"""Height of the figure over the largest size inspected."""
WIDTH_CHARACTERS = 75
"""Characters of labels that fit beside each other under the figure."""
MOST_IN_A_ROW = 8
"""Words above the figure."""


def axis_figure(axis: AxisGroup, name: str) -> str:
    """a90 with its interval over boards, a90/95 as a dash above it, for each value of the axis; an arrow for what lies
    beyond `ROOM` times the largest size inspected."""
    shown = list(axis.lines.items())[: len(COLOURS)]
    every = [limit for _, line in shown for limit in line.limits]
    top_mm = ROOM * max((limit.largest_mm for limit in every if limit.inspections), default=np.inf)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        places = np.array(axis.values, float) if axis.numeric else np.arange(len(axis.values), dtype=float)
        logarithmic = axis.numeric and places.min() > 0 and places.max() / places.min() >= 8
        beside = _steps_aside(places, len(shown), logarithmic)
        beyond = 0
        for number, (label, line) in enumerate(shown):
            at = [axis.values.index(value) for value in line.values]
            x = beside[number][at]
            _line(axes, x, line.limits, number, label, "-" if axis.numeric else "none", top_mm)
            beyond += _arrows(axes, x, line.limits, COLOURS[number], top_mm)
        axes.plot([], [], "_", color=GREY, ms=11, mew=2.2, label="a90/95")
        if beyond:
            axes.plot([], [], marker="^", ls="none", color=GREY, ms=6, label="goes on beyond")
        if np.isfinite(top_mm):
            axes.axhline(top_mm / ROOM, color=GREY, lw=1.0, ls=":", label="largest size inspected")
        _missing(axes, list(zip(axis.values, places, strict=True)), [line for _, line in shown])
        if logarithmic:
            axes.set_xscale("log")
            axes.minorticks_off()
        _ticks(axes, axis, places)
        axes.set(xlabel=plain(axis.title), ylabel="diameter found 90 % of the time, a90 (mm)")
        axes.margins(x=0.08)
        axes.set_ylim(0, top_mm if np.isfinite(top_mm) else None)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)

    return svg(name, (8.6, 4.4 + 0.13 * len(shown)), _alt(axis), draw)


def _ticks(axes: Axes, axis: AxisGroup, places: np.ndarray) -> None:
    """Values at their places; words in lines of about 18 characters, slanted where they would still run together."""
    if axis.numeric:
        labels = [f"{value:g}" for value in axis.values]
    else:
        texts = [value_text(axis.path, value) for value in axis.values]
        labels = [plain(fill(shorten(text, 40, placeholder=" …"), 18, break_long_words=False)) for text in texts]
    longest = max(len(line) for label in labels for line in label.split("\n"))
    slanted: dict[str, Any] = {"rotation": 25, "ha": "right"} if longest * len(labels) > WIDTH_CHARACTERS else {}
    axes.set_xticks(places, labels, **slanted)


def _steps_aside(places: np.ndarray, lines: int, logarithmic: bool) -> np.ndarray:
    """(lines, n) the places moved a little, so that intervals of several lines stand beside each other: by 2.5 % of the
    axis each, less where places are closer."""
    scale = np.log(places) if logarithmic else places
    reach = float(np.ptp(scale)) or 1.0
    nearest = float(np.diff(np.sort(scale)).min()) if len(scale) > 1 else reach
    step = min(0.025 * reach, 0.6 * nearest / lines)
    moved = scale + step * (np.arange(lines) - (lines - 1) / 2)[:, None]
    return np.asarray(np.exp(moved) if logarithmic else moved)


def _line(
    axes: Axes, x: np.ndarray, limits: Sequence[SetUpLimit], number: int, label: str, joined: str, top_mm: float
) -> None:
    colour, marker = COLOURS[number], MARKERS[number]
    ends_of = [limit.a90_interval_mm for limit in limits]
    rows = [(one.a90_mm, ends.low, ends.high, one.a90_95.value) for one, ends in zip(limits, ends_of, strict=True)]
    a90, low, high, bound = np.array(rows).T
    a90 = np.where(a90 <= top_mm, a90, np.nan)
    ends = np.clip([a90 - low, np.minimum(high, top_mm) - a90], 0, None)
    axes.errorbar(
        x,
        a90,
        np.nan_to_num(ends),
        fmt=marker,
        ls=joined,
        lw=1.2,
        ms=5.5,
        capsize=3,
        color=colour,
        label=plain(label or "a90, 95 % over boards"),
    )
    shown = bound <= top_mm
    axes.plot(x[shown], bound[shown], "_", color=colour, ms=13, mew=2.4)


def _arrows(axes: Axes, x: np.ndarray, limits: Sequence[SetUpLimit], colour: str, top_mm: float) -> int:
    """An arrow up from the lowest of estimate, interval and bound that the figure has no room for; how many."""
    count = 0
    for place, limit in zip(x, limits, strict=True):
        if np.isnan(limit.a90_mm) or max(limit.a90_interval_mm.high, limit.a90_mm, limit.a90_95.value) <= top_mm:
            continue
        inside = [size for size in (limit.a90_mm, limit.a90_interval_mm.low) if size <= top_mm]
        axes.plot([place, place], [max(inside, default=0.92 * top_mm), top_mm], color=colour, lw=1.2)
        axes.plot([place], [top_mm], marker="^", color=colour, ms=6.5, clip_on=False, zorder=6)
        count += 1
    return count


def _missing(axes: Axes, places: Sequence[tuple[Any, float]], lines: Sequence[AxisLine]) -> None:
    """A word above the figure where no limit lies within the sizes inspected; in two rows where places are close."""
    close = len(places) > MOST_IN_A_ROW
    for number, (value, x) in enumerate(places):
        here = [limit for line in lines for at, limit in zip(line.values, line.limits, strict=True) if at == value]
        without = sum(not is_within_sizes(limit) for limit in here)
        if without:
            said = "no limit" + (f"\n({without} of {len(here)})" if len(here) > 1 else "")
            above = (0, 6 + (24 if close and number % 2 else 0))
            at_top: Any = axes.get_xaxis_transform()
            axes.annotate(
                said, (x, 1.0), above, at_top, "offset points", ha="center", va="bottom", fontsize=8, color=GREY
            )


def _alt(axis: AxisGroup) -> str:
    said = []
    for label, line in axis.lines.items():
        sizes = (
            f"{axis_value(axis.path, value)}: {text.size(limit.a90_mm, limit.largest_mm)} mm"
            for value, limit in zip(line.values, line.limits, strict=True)
        )
        said.append(f"{f'{label}: ' if label else ''}{', '.join(sizes)}")
    return f"a90 against {axis.title}. {'; '.join(said)}."
