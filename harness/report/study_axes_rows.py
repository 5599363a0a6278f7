"""Rows of tables over what was varied: limits along an axis, over depth, and at the sizes of a known board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from harness.evaluation.intervals import Interval
from harness.evaluation.study.axes import AxisLine, Difference
from harness.evaluation.study.limit import SetUpLimit, SizeRow
from harness.evaluation.study.surface import PodSurface
from harness.report.measures import inches
from harness.report.study_axes_figure import AxisGroup, axis_value
from harness.report.study_rows import (
    bound_text,
    estimate_text,
    interval_text,
    name_of,
    percent_text,
    with_interval,
)

SURFACE_HEADS = (
    "set-up",
    "depths (mm)",
    "a90 at the least (mm)",
    "a90 at the most (mm)",
    "a90 ~ depth to the power of",
    "interaction, p",
)
MOST_COLUMNS = 4
"""Set-ups side by side in one table of holes."""
SHOWN_ROWS = 60


@dataclass(frozen=True)
class SizeCell:
    """POD of one hole by one set-up as text: ``pod`` with its bounds, what was found ``near`` that size."""

    pod: str
    near: str
    outside: bool


@dataclass(frozen=True)
class SizeTable:
    """Holes down, ``heads`` (set-ups) across. ``rows``: (number, drill, diameter, cells)."""

    heads: tuple[str, ...]
    rows: tuple[tuple[str, str, str, tuple[SizeCell, ...]], ...]


def axis_heads(group: AxisGroup) -> tuple[str, ...]:
    """The columns of `axis_rows`."""
    first = (group.title,) if list(group.lines) == [""] else ("set-ups", group.title)
    return (*first, "a50 (mm)", "a90 (mm)", "a90/95 (mm)", "a90 over that above")


def axis_rows(group: AxisGroup) -> list[tuple[str, ...]]:
    """The limits at each value of each line, and the change of a90 from the value before."""
    return [row for label, line in group.lines.items() for row in _line_rows(group, label, line)][:SHOWN_ROWS]


def axis_note(group: AxisGroup) -> str:
    """How the changes are to be read."""
    steps = [step for line in group.lines.values() for step in line.steps]
    paired = "same boards, drawn again together" if all(step.paired for step in steps) else "not all of the same boards"
    beyond = sum(step.beyond_chance for step in steps)
    rows = sum(len(line.values) for line in group.lines.values())
    cut = f" The first {SHOWN_ROWS} of {rows} rows are shown." if rows > SHOWN_ROWS else ""
    return (
        f"Ratio of a90 with its 95 % interval over boards ({paired}); {beyond} of {len(steps)} leave out 1 (*). Each "
        f"interval is taken for itself and a little narrow: of ratios that are 1, 8 to 9 % get a *, not 5 %.{cut}"
    )


def surface_rows(surfaces: Sequence[tuple[SetUpLimit, PodSurface]]) -> Sequence[tuple[str, ...]]:
    """What depth does to the diameter found 90 % of the time."""
    rows = []
    for limit, surface in surfaces:
        low, high = surface.depth_range_mm
        power = surface.depth_slope_interval
        rows.append(
            (
                name_of(limit),
                f"{low:.3g} to {high:.3g}",
                _of_depth(surface, 0),
                _of_depth(surface, -1),
                with_interval(-surface.depth_slope, Interval(-power.high, -power.low)).replace("-", "−"),
                "–" if np.isnan(surface.interaction_p) else f"{surface.interaction_p:.2g}",
            )
        )
    return rows


def size_tables(limits: Sequence[SetUpLimit], rows: Sequence[Sequence[SizeRow]]) -> list[SizeTable]:
    """POD at given sizes, `MOST_COLUMNS` set-ups a table; ``rows`` (set-ups, sizes), the same sizes for all.
    None without sizes."""
    tables: list[SizeTable] = []
    if not any(rows):
        return tables
    for first in range(0, len(limits), MOST_COLUMNS):
        part = slice(first, first + MOST_COLUMNS)
        lines = tuple(
            (
                str(number + 1),
                inches(line[0].diameter_mm) or "–",
                f"{line[0].diameter_mm:.2f}",
                tuple(_cell(one) for one in line),
            )
            for number, line in enumerate(zip(*rows[part], strict=True))
        )
        tables.append(SizeTable(tuple(name_of(limit) for limit in limits[part]), lines))
    return tables


def _line_rows(group: AxisGroup, label: str, line: AxisLine) -> Iterator[tuple[str, ...]]:
    steps = (None, *line.steps)
    for value, limit, step in zip(line.values, line.limits, steps, strict=True):
        first = () if list(group.lines) == [""] else (label if step is None else "",)
        yield (
            *first,
            axis_value(group.path, value),
            estimate_text(limit, limit.a50_mm, limit.a50_interval_mm),
            estimate_text(limit, limit.a90_mm, limit.a90_interval_mm),
            bound_text(limit.a90_95, limit.largest_mm),
            "" if step is None else _step(step),
        )


def _step(step: Difference) -> str:
    beyond = " *" if step.beyond_chance else ""
    if not np.isfinite(step.ratio):
        return f"no a90 {'here' if np.isnan(step.to.a90_mm) else 'above'}{beyond}"
    if all(one.beyond(one.a90_mm) for one in (step.frm, step.to)):
        return f"both beyond{beyond}"
    return f"× {step.ratio:.2f} ({interval_text(step.interval)}){beyond}"


def _of_depth(surface: PodSurface, at: int) -> str:
    low, high = float(surface.a90_low_mm[at]), float(surface.a90_high_mm[at])
    return with_interval(float(surface.a90_mm[at]), Interval(low, high), most=surface.diameter_range_mm[1])


def _cell(row: SizeRow) -> SizeCell:
    near = f"{100 * row.near_rate:.0f} % of {row.near} near" if row.near else "none near"
    if np.isnan(row.pod):
        return SizeCell("no curve", near, row.extrapolated)
    return SizeCell(
        f"{percent_text(row.pod)} % ({percent_text(row.lower)} to {percent_text(row.upper)})", near, row.extrapolated
    )
