"""Figures over the numeric last axis of several set-ups: what is found, and the noise with its grain."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harness.report.canvas import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, svg
from harness.report.set_ups_rows import LAGS, Layout

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (BLUE, ORANGE, GREEN, RED, SKY, PURPLE)
MARKERS = "osD^vP"


def limits_figure(compared: pd.DataFrame, layout: Layout) -> str:
    """The smallest diameter found and the pixels' pitch, against the last axis."""

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(layout.shown_frames) + 1, squeeze=False)[0]
        top = 1.15 * float(np.nanmax([*compared["limit_mm"], 1.0]))
        for axes, frames in zip(panels, layout.shown_frames, strict=False):
            rows = compared[compared["frames"] == frames]
            _lines(axes, rows, layout, "limit_mm")
            axes.set(ylim=(0, top), ylabel="smallest diameter found (mm)")
            axes.set_title("1 frame" if frames == 1 else f"{frames} frames averaged")
        _lines(panels[-1], compared[compared["frames"] == layout.shown_frames[-1]], layout, "pitch_u_mm")
        panels[-1].set_ylim(bottom=0)
        panels[-1].set_ylabel("between columns, on the board (mm)")
        panels[-1].set_title("Pitch of the pixels")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(layout.rows))

    alt = "Smallest diameter found by each camera, and the pitch of its pixels on the board, in millimetres."
    return svg("limits", (10, 3.8), alt, draw)


def grain_figure(compared: pd.DataFrame, layout: Layout) -> str:
    """One frame's temporal noise against the last axis, and its correlation with neighbours in the middle column."""
    many = compared[compared["frames"] == layout.shown_frames[-1]]

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        _lines(left, many, layout, "single_frame_mm")
        left.set_ylim(bottom=0)
        left.set_ylabel("temporal noise of one frame, std of z (mm)")
        left.set_title("Noise")
        for place, variants in enumerate(layout.rows.values()):
            row = many[many["variant"] == variants[layout.middle_column]]
            if row.empty:
                continue
            for way, style in (("u", "-"), ("v", ":")):
                values = [1.0, *(float(row.iloc[0][f"correlation_{way}{lag}"]) for lag in LAGS)]
                right.plot([0, *LAGS], values, style, marker=MARKERS[place], ms=5, color=COLOURS[place])
        right.axhline(0, color=GREY, lw=0.8)
        right.set_xticks([0, *LAGS])
        right.set(xlabel="lag (pixels)", ylabel="correlation of one frame's noise", ylim=(-0.3, 1.05))
        right.set_title(f"Grain at {layout.columns[layout.middle_column]}: along rows (line), columns (dots)")
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=len(layout.rows))

    alt = "Temporal noise of each camera in millimetres, and the correlation of its noise between neighbouring pixels."
    return svg("grain", (10, 4.0), alt, draw)


def _lines(axes: Axes, rows: pd.DataFrame, layout: Layout, column: str) -> None:
    """One line a row of the layout, over its columns."""
    table = rows.set_index("variant")[column]
    for place, (title, variants) in enumerate(layout.rows.items()):
        values = [float(table.get(variant, np.nan)) for variant in variants]
        axes.plot(
            layout.column_values, values, marker=MARKERS[place], ms=5, color=COLOURS[place], label=title, alpha=0.9
        )
    axes.set_xticks(layout.column_values, [f"{value:g}" for value in layout.column_values])
    axes.set_xlabel(layout.column_name)
