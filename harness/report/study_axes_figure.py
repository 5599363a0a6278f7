"""Figure: a detection limit against one swept axis, everything else held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.study.axes import FRAMES, AxisLine
from harness.evaluation.study.limit import SetUpLimit
from harness.report.canvas import GREY, svg
from harness.report.pod_figure import plain
from harness.report.set_ups_figures import COLOURS, MARKERS
from harness.report.study_rows import mm_text
from harness.vocabulary.path_names import names_of, on_one_line, unit_of, value_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class AxisGroup:
    """One axis: its ``values``, ascending where they are numbers, and its ``lines`` by what tells them apart."""

    path: str
    name: str
    values: tuple[Any, ...]
    lines: dict[str, AxisLine]

    @property
    def numeric(self) -> bool:
        """Whether the values have places on a scale."""
        return all(line.numeric for line in self.lines.values())

    @property
    def title(self) -> str:
        """The axis with its unit."""
        unit = unit_of(self.path)
        return f"{self.name} ({unit})" if unit else self.name


def axis_groups(lines: Sequence[AxisLine]) -> list[AxisGroup]:
    """The lines axis by axis, in their order; a line is called by those of its other axes that differ among lines."""
    names = names_of(dict.fromkeys(path for line in lines for path in (line.axis, *line.held)))
    groups = []
    for path in dict.fromkeys(line.axis for line in lines):
        of_axis = [line for line in lines if line.axis == path]
        others = dict.fromkeys(other for line in of_axis for other in line.held)
        varied = [other for other in others if len({on_one_line(line.held.get(other)) for line in of_axis}) > 1]
        labels = [
            ", ".join(axis_value(other, line.held[other]) for other in varied if other in line.held) for line in of_axis
        ]
        every = [value for line in of_axis for value in line.values]
        values = [value for at, value in enumerate(every) if value not in every[:at]]
        if all(line.numeric for line in of_axis):
            values.sort()
        groups.append(AxisGroup(path, names[path], tuple(values), dict(zip(labels, of_axis, strict=True))))
    return groups


def axis_value(path: str, value: Any) -> str:
    """A value in words: ``50 frames``, ``0.7 m``, ``kinect_v2``."""
    if path == FRAMES:
        return f"{value} frame{'s' if value > 1 else ''}"
    return value_text(path, value)


def axis_figure(axis: AxisGroup, name: str) -> str:
    """a90 with its interval over boards, a90/95 as a dash above it, for each value of the axis."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        shown = list(axis.lines.items())[: len(COLOURS)]
        places = np.array(axis.values, float) if axis.numeric else np.arange(len(axis.values), dtype=float)
        logarithmic = axis.numeric and places.min() > 0 and places.max() / places.min() >= 8
        for number, (label, line) in enumerate(shown):
            x = _beside(places, number - (len(shown) - 1) / 2, logarithmic)
            at = [axis.values.index(value) for value in line.values]
            _line(axes, x[at], line.limits, number, label, "-" if axis.numeric else "none")
        axes.plot([], [], "_", color=GREY, ms=11, mew=2.2, label="a90/95")
        _missing(axes, dict(zip(axis.values, places, strict=True)), [line for _, line in shown])
        if logarithmic:
            axes.set_xscale("log")
            axes.minorticks_off()
        labels = [shorten(value_text(axis.path, value), 24, placeholder="…") for value in axis.values]
        axes.set_xticks(places, [f"{value:g}" for value in axis.values] if axis.numeric else [plain(t) for t in labels])
        axes.set(xlabel=plain(axis.title), ylabel="diameter found 90 % of the time, a90 (mm)")
        axes.margins(x=0.08)
        axes.set_ylim(bottom=0)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)

    return svg(name, (8.6, 4.2 + 0.13 * min(len(axis.lines), len(COLOURS))), _alt(axis), draw)


def _beside(places: np.ndarray, steps: float, logarithmic: bool) -> np.ndarray:
    """The places moved a little, so that intervals of several lines stand beside each other."""
    if logarithmic:
        return np.asarray(places * (places.max() / places.min()) ** (0.008 * steps))
    return np.asarray(places + 0.012 * steps * float(np.ptp(places)))


def _line(axes: Axes, x: np.ndarray, limits: Sequence[SetUpLimit], number: int, label: str, joined: str) -> None:
    colour, marker = COLOURS[number], MARKERS[number]
    ends_of = [limit.a90_interval_mm for limit in limits]
    rows = [(one.a90_mm, ends.low, ends.high, one.a90_95.value) for one, ends in zip(limits, ends_of, strict=True)]
    a90, low, high, bound = np.array(rows).T
    there = np.isfinite(a90)
    ends = np.clip([a90 - low, np.where(np.isfinite(high), high, a90) - a90], 0, None)[:, there]
    axes.errorbar(
        x[there],
        a90[there],
        np.nan_to_num(ends),
        fmt=marker,
        ls=joined,
        lw=1.2,
        ms=5.5,
        capsize=3,
        color=colour,
        label=plain(label or "a90, 95 % over boards"),
    )
    shown = np.isfinite(bound)
    axes.plot(x[shown], bound[shown], "_", color=colour, ms=13, mew=2.4)


def _missing(axes: Axes, places: Mapping[Any, float], lines: Sequence[AxisLine]) -> None:
    """A word at the top where a limit is not demonstrated."""
    for value, x in places.items():
        here = [limit for line in lines for at, limit in zip(line.values, line.limits, strict=True) if at == value]
        without = sum(not limit.a90_95.demonstrated for limit in here)
        if without:
            text = f"a90/95 not\ndemonstrated{f' ({without} of {len(here)})' if len(here) > 1 else ''}"
            at_top = axes.get_xaxis_transform()
            axes.annotate(text, (x, 1.0), xycoords=at_top, ha="center", va="bottom", fontsize=8, color=GREY)


def _alt(axis: AxisGroup) -> str:
    said = []
    for label, line in axis.lines.items():
        sizes = (
            f"{axis_value(axis.path, value)}: {mm_text(limit.a90_mm)} mm"
            for value, limit in zip(line.values, line.limits, strict=True)
        )
        said.append(f"{f'{label}: ' if label else ''}{', '.join(sizes)}")
    return f"a90 against {axis.title}. {'; '.join(said)}."
