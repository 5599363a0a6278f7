"""Figures of measured against true: sizes (the thesis' figure 8) and positions (its figure 7)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.summary import Measure
from harness.report.canvas import BLUE, GREY, INK, ORANGE, PALE, RED, SKY, svg
from harness.tables.text import inches

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RULER_MM = 25.4 / 16
"""One graduation of a ruler in 1/16 in, to compare positions with."""
MEASURES: tuple[tuple[Measure, str, str], ...] = (
    ("extent", "extent of the cluster", ORANGE),
    ("model", "model of the blurred hole", BLUE),
)


def sizes_figure(summary: pd.DataFrame, few: int, many: int) -> str:
    """Mean sizes with one standard deviation: bars by hole, and both measures against the true diameter.

    ``summary``: rows of one variant. ``few`` and ``many``: the numbers of frames shown; the bars show ``many``.
    """

    def draw(figure: Figure) -> None:
        grid = figure.add_gridspec(2, 2, height_ratios=[1, 1.15])
        _size_bars(figure.add_subplot(grid[0, :]), summary[summary["frames"] == many], many)
        for column, (measure, name, colour) in enumerate(MEASURES):
            _size_scatter(figure.add_subplot(grid[1, column]), summary, measure, name, colour, (few, many))

    alt = (
        "Measured hole diameters with one standard deviation beside the true ones, by the extent of the cluster and "
        f"the model, with {few} and {many} frames."
    )
    return svg("sizes", (10, 7.4), alt, draw)


def positions_figure(summary: pd.DataFrame, frames: int) -> str:
    """Mean positions against the truth with the line of equality, and their differences from it."""
    rows = summary[summary["frames"] == frames]

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2, width_ratios=[1, 1.25])
        seen = rows[rows["detected"] > 0]
        top = max([1.0, *seen["true_offset_mm"]]) * 1.06
        left.plot([0, top], [0, top], color=GREY, lw=1, label="line of equality")
        right.axhspan(-RULER_MM, RULER_MM, color=PALE, label="one ruler graduation, ±1/16 in")
        right.axhline(0, color=GREY, lw=1)
        for side, marker, size, (measure, name, colour) in zip((-1, 1), "os", (9, 4), MEASURES, strict=True):
            shown = rows[rows[f"{measure}_offset_mean_mm"].notna()]
            x, std = shown["true_offset_mm"], shown[f"{measure}_offset_std_mm"].fillna(0)
            look = {"fmt": marker, "color": colour, "capsize": 2.5}
            mean, bias = shown[f"{measure}_offset_mean_mm"], shown[f"{measure}_offset_bias_mm"]
            left.errorbar(x, mean, std, ms=size, mfc="none" if side < 0 else colour, label=name, **look)
            right.errorbar(x + side * top / 150, bias, std, ms=5, label=name, **look)
        left.set(xlabel="true distance from the largest hole (mm)", ylabel="measured distance (mm)", aspect="equal")
        left.set_title(f"Positions, {_frames(frames)}")
        left.legend(loc="upper left")
        right.set(xlabel="true distance from the largest hole (mm)", ylabel="measured − true (mm)")
        right.set_title("Difference from the truth, ±1 std")
        figure.legend(*right.get_legend_handles_labels(), loc="outside lower right", ncols=3)

    alt = f"Measured against true distance of each hole from the largest with {frames} frames, and the differences."
    return svg("positions", (10, 4.6), alt, draw)


def _size_bars(axes: Axes, rows: pd.DataFrame, frames: int) -> None:
    place = np.arange(len(rows), dtype=float)
    true = rows["true_diameter_mm"].to_numpy(float)
    for side, (measure, name, colour) in zip((-0.2, 0.2), MEASURES, strict=True):
        mean = rows[f"{measure}_diameter_mean_mm"].to_numpy(float)
        std = np.nan_to_num(rows[f"{measure}_diameter_std_mm"].to_numpy(float))
        there = np.isfinite(mean)
        axes.bar(
            place[there] + side, mean[there], 0.38, yerr=std[there], color=colour, label=name, capsize=2.5, ecolor=INK
        )
    axes.hlines(true, place - 0.44, place + 0.44, color=INK, lw=2, label="true diameter")
    gone = place[rows["detected"].to_numpy() == 0]
    for x in gone:
        axes.annotate(
            "never\ndetected",
            (x, true[int(x)]),
            (0, 4),
            textcoords="offset points",
            ha="center",
            fontsize=8,
            color=GREY,
        )
    labels = [f"{hole}\n{inches(d) or f'{d:.1f} mm'}" for hole, d in zip(rows["hole"], true, strict=True)]
    axes.set_xticks(place, labels)
    axes.set(ylabel="diameter (mm)", xlabel="hole and its drill")
    axes.grid(axis="x", visible=False)
    axes.set_title(f"Mean size ±1 std of each hole, {_frames(frames)}")
    axes.legend(loc="upper left")


def _size_scatter(
    axes: Axes, summary: pd.DataFrame, measure: Measure, name: str, colour: str, frames: tuple[int, int]
) -> None:
    top = float(summary["true_diameter_mm"].max()) * 1.12
    axes.plot([0, top], [0, top], color=GREY, lw=1, label="line of equality")
    lowest, pale = 0.0, {ORANGE: RED, BLUE: SKY}[colour]
    for n, marker, shade, shift in ((frames[0], "^", pale, 0.18), (frames[1], "o", colour, -0.18)):
        rows = summary[(summary["frames"] == n) & summary[f"{measure}_diameter_mean_mm"].notna()]
        x, mean = rows["true_diameter_mm"] + shift, rows[f"{measure}_diameter_mean_mm"]
        std = rows[f"{measure}_diameter_std_mm"].fillna(0)
        axes.errorbar(x, mean, std, fmt=marker, ms=4.5, color=shade, capsize=2.5, label=_frames(n))
        lowest = min([lowest, *(mean - 1.1 * std)])
    axes.set(xlabel="true diameter (mm)", ylabel="measured diameter (mm)", xlim=(0, top))
    axes.set_ylim(bottom=min(0.0, lowest))
    axes.set_title(name[0].upper() + name[1:])
    axes.legend(loc="upper left")


def _frames(n: int) -> str:
    return "1 frame" if n == 1 else f"{n} frames averaged"
