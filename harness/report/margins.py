"""Figures of what averaging buys: each hole's margin over the threshold against the number of
averaged frames, and the threshold in millimetres beside the noise that sets it.

A margin is the highest score within the hit radius of a damage, divided by the threshold: above 1
the damage exceeds the threshold, below 1 it is missed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from harness.report import blocks
from harness.report.margin_panels import LABELLED, ROOM, margin_panels

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_PANELS = 11
"""Most sizes with a panel each; one further panel counts the holes found."""
LABEL_ROOM = 1.5
"""Factor below the lowest value for the name of its line."""
STATUS_COLOURS = {"found": blocks.BLUE, "missed": blocks.RED, "undecided": blocks.GREY}


def margin_figure(main: pd.DataFrame) -> str | None:
    """Draw the margins of the main set-up's holes (``main``: rows of `SUMMARY`): against the
    number of frames, with a panel for each size; against the size if there is one number of frames
    or there are more than `MOST_PANELS` sizes. Return SVG text; None if no margin was stored."""
    rows_with_margins = main[main["margin_mean"] > 0]
    if not len(rows_with_margins):
        return None
    sizes_mm = rows_with_margins["true_diameter_mm"].unique()
    if rows_with_margins["frames"].nunique() > 1 and len(sizes_mm) <= MOST_PANELS:
        return margin_panels(main, rows_with_margins)
    return _by_size(rows_with_margins)


def _by_size(rows_with_margins: pd.DataFrame) -> str:
    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for _, group in rows_with_margins.groupby("frames"):
            _draw_margins(axes, group.sort_values("true_diameter_mm"), "true_diameter_mm")
        _margin_axis(axes, rows_with_margins)
        axes.set(xlabel="true diameter (mm)", ylabel="score / threshold")

    return blocks.svg(
        "margins", (5.4, 4.0), "Score over threshold of each hole against its diameter.", draw
    )


def _draw_margins(axes: Axes, group: pd.DataFrame, column: str) -> None:
    """Draw mean, lowest and highest margin over the repeats against a column of `SUMMARY`."""
    positions = group[column].to_numpy(float)
    mean = group["margin_mean"].to_numpy(float)
    low = group["margin_lowest"].to_numpy(float)
    high = group["margin_highest"].to_numpy(float)
    colours = [STATUS_COLOURS[status] for status in group["status"]]
    axes.axhline(1, color=blocks.INK, lw=0.8, ls=(0, (4, 2)))
    axes.plot(positions, mean, color=blocks.GREY, lw=1, label="score / threshold")
    axes.vlines(positions, np.maximum(low, LABELLED[0]), high, colors=colours, lw=2)
    axes.scatter(positions, mean, c=colours, s=16, zorder=3)


def _margin_axis(axes: Axes, rows_with_margins: pd.DataFrame) -> None:
    """Give an axis of margins the ends that hold all of them."""
    lowest = max(min(rows_with_margins["margin_lowest"].min(), 1) / ROOM, LABELLED[0])
    highest = max(rows_with_margins["margin_highest"].max(), 1) * ROOM
    axes.set_yscale("log")
    axes.set_ylim(lowest, highest)
    ticks = [tick for tick in LABELLED if lowest <= tick <= highest]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()


def _frames_axis(axes: Axes, table: pd.DataFrame) -> None:
    """Give an axis of frames a logarithmic scale with a tick at each number."""
    frames = sorted(table["frames"].unique())
    axes.set_xscale("log")
    axes.set_xticks(frames, [f"{n:g}" for n in frames])
    axes.minorticks_off()


def threshold_figure(calls: pd.DataFrame, noise: pd.DataFrame) -> str | None:
    """Draw the threshold in millimetres (``calls``: rows of `FALSE_CALLS`) and the noise that sets
    it (``noise``: rows of `NOISE_BY_FRAMES`) against the number of frames, of one variant. Return
    SVG text; None if there are fewer than two numbers of frames."""
    damaged = calls[calls["role"] == "damaged"]
    table = damaged.merge(noise, on="frames")
    table = table.sort_values("frames")
    if len(table) < 2:
        return None
    lines: tuple[tuple[str, str, str], ...] = (
        ("threshold_mm", blocks.INK, "threshold"),
        ("pattern_mm", blocks.GREEN, "fixed pattern"),
        ("temporal_rms_mm", blocks.BLUE, "noise of the average"),
    )

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        frames = table["frames"].to_numpy(float)
        for column, colour, label in lines:
            values_mm = table[column].to_numpy(float)
            axes.plot(frames, values_mm, color=colour, marker="o", ms=4, label=label)
            _label_line(axes, frames, values_mm, label)
        axes.set_yscale("log")
        _frames_axis(axes, table)
        low_mm, high_mm = axes.get_ylim()
        low_mm /= LABEL_ROOM
        axes.set_ylim(low_mm, high_mm)
        ticks: list[Any] = [tick for tick in LABELLED if low_mm <= tick <= high_mm]
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.set(xlabel="frames averaged", ylabel="millimetres of range")

    alt = "Threshold, fixed pattern and noise in millimetres against the number of averaged frames."
    return blocks.svg("threshold", (4.4, 4.0), alt, draw)


def _label_line(axes: Axes, frames: np.ndarray, values_mm: np.ndarray, label: str) -> None:
    """Write a line's name and its first and last value below its right end."""
    ends = dict.fromkeys(f"{value_mm:.2f}" for value_mm in (values_mm[0], values_mm[-1]))
    axes.annotate(
        f"{label}: {' to '.join(ends)} mm",
        (frames[-1], values_mm[-1]),
        (4, -14),
        textcoords="offset points",
        ha="right",
        fontsize=9,
    )
