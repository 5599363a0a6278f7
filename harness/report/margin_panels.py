"""Small panels: each hole's margin over the threshold against the number of averaged frames, and
the number of holes found. It is a template, because Matplotlib would take most of a second for a
dozen panels, a third of what the page costs."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from math import log
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.report.blocks import template
from harness.vocabulary.text import many

if TYPE_CHECKING:
    import pandas as pd

ACROSS = 4
"""Panels side by side."""
WIDTH_PX = 490
LEFT_PX = 38
"""Left of the first panel, for the title and the texts of its axis."""
TOP_PX = 16
"""Above the first panel, for its title."""
STEP_PX = (118, 106)
"""Distance of panels, to the right and down."""
PANEL_PX = (92, 82)
"""Width and height of a panel."""
BELOW_PX = 8
"""Below the last panels, for the title of their axis."""
MARGIN_PX = 5
"""Distance of the first and the last number of frames from the ends of a panel."""
LABELLED = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100)
"""Margins that may stand beside a panel."""
ROOM = 1.25
"""Factor between the highest margin and the upper end of its axis."""
COUNT_ROOM = 1.15
"""The same of the number of holes."""
COLOURS = {"found": "blue", "missed": "red", "undecided": "grey"}
"""Names of the page's colours, by the state of a hole."""


@dataclass(frozen=True)
class _LogScale:
    """The places of a logarithmic axis' values in a panel."""

    ends: tuple[float, float]
    """The values at its ends; others are drawn there."""
    ends_px: tuple[float, float]
    """Where these stand."""

    def px(self, value: float) -> float:
        """Return where a value stands."""
        low, high = self.ends
        start_px, end_px = self.ends_px
        share = 0.0
        if high > low:
            share = log(min(max(value, low), high) / low) / log(high / low)
        return round(start_px + share * (end_px - start_px), 1)


@dataclass(frozen=True)
class _Axes:
    """The axes of all panels of margins."""

    frames: _LogScale
    """Of the numbers of frames, from left to right."""
    margins: _LogScale
    """Of the margins, from the lower end up."""

    @staticmethod
    def of(rows: pd.DataFrame) -> _Axes:
        """Return the axes that hold all rows of `SUMMARY`."""
        width_px, height_px = PANEL_PX
        frames = rows["frames"].astype(float)
        lowest = max(min(rows["margin_lowest"].min(), 1) / ROOM, LABELLED[0])
        highest = max(rows["margin_highest"].max(), 1) * ROOM
        return _Axes(
            frames=_LogScale((frames.min(), frames.max()), (MARGIN_PX, width_px - MARGIN_PX)),
            margins=_LogScale((float(lowest), float(highest)), (height_px, 0)),
        )


def margin_panels(main: pd.DataFrame, rows_with_margins: pd.DataFrame) -> str:
    """Return the figure as SVG text. ``main``: rows of `SUMMARY` of the only set-up;
    ``rows_with_margins``: those of them that have a margin."""
    axes = _Axes.of(rows_with_margins)
    panels: list[dict[str, Any]] = []
    for size_mm, of_size in rows_with_margins.groupby("true_diameter_mm"):
        panel = _margin_panel(of_size.sort_values("frames"), axes)
        holes = ", ".join(of_size["hole"].unique()[:3])
        panel["title"] = f"no. {holes}: {size_mm:.1f} mm"
        panel["y_title"] = "" if len(panels) % ACROSS else "score / threshold"
        panels.append(panel)
    panels.append(_count_panel(main, axes))
    for number, panel in enumerate(panels):
        panel["x"] = LEFT_PX + STEP_PX[0] * (number % ACROSS)
        panel["y"] = TOP_PX + STEP_PX[1] * (number // ACROSS)
        # the last of each column
        panel["has_frames"] = number + ACROSS >= len(panels)
    frames = sorted(rows_with_margins["frames"].unique())
    rows = -(-len(panels) // ACROSS)
    return template("margins.svg").render(
        alt=(
            "Score over threshold of each hole against the number of averaged frames, and the "
            "number of holes found."
        ),
        values=json.dumps([_values(panel) for panel in panels], separators=(",", ":")),
        width=WIDTH_PX,
        height=TOP_PX + STEP_PX[1] * rows + BELOW_PX,
        panel_width=PANEL_PX[0],
        panel_height=PANEL_PX[1],
        columns=[(axes.frames.px(count), f"{count:g}") for count in frames],
        panels=panels,
    )


def _margin_panel(of_size: pd.DataFrame, axes: _Axes) -> dict[str, Any]:
    """Return what the template shows of one size: at each number of frames, the mean margin over
    the repeats, and a bar from the lowest to the highest."""
    marks = []
    points = []
    rows: list[dict[str, Any]] = of_size.to_dict("records")  # type: ignore[assignment]
    for row in rows:
        frames = float(row["frames"])
        mean = float(row["margin_mean"])
        x_px = axes.frames.px(frames)
        y_px = axes.margins.px(mean)
        bar_px = (axes.margins.px(row["margin_lowest"]), axes.margins.px(row["margin_highest"]))
        colour = COLOURS[row["status"]]
        marks.append({"x": x_px, "y": y_px, "bar": bar_px, "colour": colour, "text": ""})
        points.append((x_px, y_px, frames, mean))
    lowest, highest = axes.margins.ends
    ticks = [tick for tick in LABELLED if lowest <= tick <= highest]
    return {
        "rows": [(axes.margins.px(tick), f"{tick:g}") for tick in ticks],
        "threshold": axes.margins.px(1),
        "name": "score / threshold",
        "line": _path(points),
        "line_colour": "grey",
        "points": points,
        "marks": marks,
    }


def _count_panel(main: pd.DataFrame, axes: _Axes) -> dict[str, Any]:
    """Return what the template shows of the number of holes found."""
    height_px = PANEL_PX[1]
    is_found = main["status"] == "found"
    counts = is_found.groupby(main["frames"]).sum()
    holes = main["hole"].nunique()
    px_per_hole = height_px / (COUNT_ROOM * holes)
    marks = []
    points = []
    for frames, count in counts.items():
        x_px = axes.frames.px(float(str(frames)))
        y_px = round(height_px - px_per_hole * float(count), 1)
        marks.append({"x": x_px, "y": y_px, "bar": None, "colour": "ink", "text": str(count)})
        points.append((x_px, y_px, float(str(frames)), float(count)))
    return {
        "title": f"found, of {many(holes, 'hole')}",
        "y_title": "",
        "rows": [(height_px, "0"), (round(height_px - px_per_hole * holes, 1), str(holes))],
        "threshold": None,
        "name": "holes found",
        "line": _path(points),
        "line_colour": "ink",
        "points": points,
        "marks": marks,
    }


def _path(points: Iterable[tuple[float, ...]]) -> str:
    """Return the line through points, of which the first two numbers say where they stand."""
    places = [f"{x_px} {y_px}" for x_px, y_px, *_ in points]
    return f"M{'L'.join(places)}"


def _values(panel: dict[str, Any]) -> dict[str, Any]:
    """Return a panel's line as `harness.report.blocks.svg` does, for the values under the
    pointer."""
    width_px, height_px = PANEL_PX
    x_px = panel["x"]
    y_px = panel["y"]
    places = np.array(panel["points"]) + np.array([x_px, y_px, 0.0, 0.0])
    numbers = [float(f"{value:.4g}") for value in places.ravel()]
    return {
        "box": [x_px, y_px, x_px + width_px, y_px + height_px],
        "x": "",
        "lines": [[panel["name"], *numbers]],
    }
