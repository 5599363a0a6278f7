"""Figures of one camera set-up or several: noise against frames, the smallest hole found, grain, costs of effects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.noise import fit_floor
from harness.evaluation.set_ups import EffectCosts, SwitchCost
from harness.report.canvas import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, RED, SKY, svg

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from harness.report.set_ups import Layout

GUIDE = "#cfd6dd"
LAGS = (1, 2, 3)
"""Distances in pixels at which the noise's correlation is told."""
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


def noise_figure(noise: pd.DataFrame) -> str:
    """Temporal, systematic and total error against frames (log-log) with the 1/sqrt(N) guide and the fitted floor.

    ``noise``: rows of one variant of `harness.evaluation.noise.noise_against_frames`.
    """
    frames = noise["frames"].to_numpy(float)
    fit = fit_floor(frames, noise["total_rms_mm"].to_numpy(float))

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot(frames, noise["guide_mm"], color=GUIDE, lw=7, solid_capstyle="round", label="1/√N guide")
        for column, colour, marker, label in (
            ("temporal_rms_mm", BLUE, "o", "temporal noise, rms"),
            ("systematic_mm", ORANGE, "s", "systematic error (offset and pattern)"),
            ("pattern_mm", GREEN, "v", "of it, pattern over pixels"),
            ("total_rms_mm", INK, "D", "total error, rms"),
        ):
            values = noise[column].where(noise[column] > 0)
            axes.plot(frames, values, marker=marker, ms=5, lw=1.4, color=colour, label=label)
        if fit is not None:
            dense = np.geomspace(frames.min(), frames.max(), 60)
            axes.plot(dense, fit.at(dense), ":", color=INK, lw=1.2, label=f"fit: {fit.white_mm:.2f} mm/√N and floor")
            if fit.floor_mm > 0:
                axes.axhline(fit.floor_mm, color=INK, lw=0.8, ls=(0, (6, 3)), label=f"floor {fit.floor_mm:.2f} mm")
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(frames, [f"{n:g}" for n in frames])
        axes.minorticks_off()
        low, high = axes.get_ylim()
        ticks = [t for t in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if low <= t <= high]
        axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
        axes.set(xlabel="frames averaged", ylabel="range error (mm)")
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))

    alt = "Range error in millimetres against the number of averaged frames: noise falls, the systematic error stays."
    return svg("noise", (10, 4.2), alt, draw)


def cost_text(cost: SwitchCost) -> str:
    """``+0.42 mm (0.30 to 0.55)``; a bound where a size lies off the ladder."""
    if not np.isfinite(cost.mm):
        return "off the ladder of sizes" if np.isnan(cost.mm) else f"{'+' if cost.mm > 0 else '−'}∞"
    low, high = (f"{end:+.2f}" if np.isfinite(end) else "∞" for end in (cost.interval.low, cost.interval.high))
    bound = "" if cost.certain else ", a bound: a size lies off the ladder"
    return f"{cost.mm:+.2f} mm ({low} to {high}{bound})".replace("-", "−")


def effects_figure(costs: Sequence[EffectCosts]) -> str:
    """Bars of every effect's cost with 95 % intervals, one panel for each place and number of frames."""
    names = [one.effect for one in costs[0].effects]

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(costs), squeeze=False, sharex=True, sharey=True)[0]
        for axes, one in zip(panels, costs, strict=True):
            _bars(axes, one)
            axes.set_title("1 frame" if one.frames == 1 else f"{one.frames} frames averaged")
            axes.set_xlabel("loss of the 50 % size (mm)")
            axes.axvline(0, color=GREY, lw=1)
            axes.grid(axis="y", visible=False)
        panels[0].set_yticks(range(len(names) + 1), [*names, "all together"])
        panels[0].invert_yaxis()
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)

    alt = "Loss of the 50 per cent detectable diameter in millimetres to each effect, alone and on top of the others."
    return svg("effects", (10, 0.42 * (len(names) + 1) + 1.6), alt, draw)


def _bars(axes: Axes, costs: EffectCosts) -> None:
    places = np.arange(len(costs.effects), dtype=float)
    alone = [one.alone for one in costs.effects]
    last = [one.last for one in costs.effects]
    for shift, colour, label, chosen, where in (
        (-0.2, BLUE, "alone, against nothing on", [*alone, costs.together], [*places, float(len(places))]),
        (0.2, ORANGE, "on top of all the others", last, list(places)),
    ):
        sizes = np.array([one.mm if np.isfinite(one.mm) else 0.0 for one in chosen])
        ends = np.array([[one.interval.low, one.interval.high] for one in chosen])
        ends = np.where(np.isfinite(ends), ends, sizes[:, None])
        errors = np.abs(ends - sizes[:, None]).T
        axes.barh(np.array(where) + shift, sizes, 0.36, xerr=errors, color=colour, label=label, ecolor=INK, capsize=2)
        for place, one in zip(where, chosen, strict=True):
            if not np.isfinite(one.mm):
                axes.text(0, place + shift, " off the ladder", va="center", fontsize=8, color=GREY)
