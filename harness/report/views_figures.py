"""Figures over the number of views: holes found, noise, shadow, sizes with one view and several; and merged clouds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.maps import LARGE_MM, AgainstOne
from harness.report.canvas import BLUE, GREY, INK, ORANGE, PALE, svg
from harness.report.examples import MappedExample
from harness.report.registration_figures import colour_of, method_text
from harness.report.view3d import SEVERAL, VIEW_COLOURS
from harness.tables.text import inches

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = "osD^vP"
GUIDE = "#cfd6dd"
LEAST_SPAN = 4.0
"""Highest over lowest value of a logarithmic axis: with less there may be no round number on it."""
ASIDE = 0.07
"""Registrations side by side at one number of views, or equal counts would hide each other."""


def found_figure(compared: pd.DataFrame, frames: Sequence[int]) -> str:
    """Holes found against views: a panel for each merge and number of frames, a line for each registration.

    ``compared``: set-ups of `harness.evaluation.maps.compare_maps`.
    """
    merges = list(dict.fromkeys(compared["merge"]))
    holes = int(compared["holes"].max())

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(frames), len(merges), squeeze=False, sharex=True, sharey=True)
        for row, n in enumerate(frames):
            for column, merge in enumerate(merges):
                axes = panels[row, column]
                part = compared[(compared["frames"] == n) & (compared["merge"] == merge)]
                _lines(axes, part.assign(count=part["found"].map(len)), "count", aside=True)
                axes.set_ylim(-0.4, holes + 0.5)
                axes.set_yticks(range(0, holes + 1, 2 if holes > 6 else 1))
                if row == 0:
                    axes.set_title(f"merge: {merge}" if merge else "merge as declared")
            panels[row, 0].set_ylabel(f"holes found of {holes}\n({n} frame{'s' if n > 1 else ''} a view)")
        for axes in panels[-1]:
            axes.set_xlabel("views")
        _legend(figure, panels)

    alt = "Number of holes found against the number of views, for each way of registering and merging."
    return svg("found", (10, 2.3 * len(frames) + 1.0), alt, draw)


def noise_views_figure(compared: pd.DataFrame, frames: int) -> str:
    """Temporal noise and systematic error of the map against views, with the guide 1/sqrt(views), for each merge."""
    rows = compared[compared["frames"] == frames]
    rows = rows.assign(systematic_mm=np.hypot(rows["offset_mm"], rows["pattern_mm"]))
    merges = list(dict.fromkeys(rows["merge"]))
    parts = (("temporal_mm", "temporal noise"), ("systematic_mm", "systematic error"))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(parts), len(merges), squeeze=False, sharex=True, sharey="row")
        for row, (column, name) in enumerate(parts):
            for place, merge in enumerate(merges):
                axes = panels[row, place]
                part = rows[rows["merge"] == merge]
                start = part.loc[part["views"] == part["views"].min(), column].median()
                views = np.array(sorted(part["views"].unique()), float)
                if row == 0 and np.isfinite(start):
                    guide = start * np.sqrt(views[0] / views)
                    axes.plot(views, guide, color=GUIDE, lw=7, solid_capstyle="round", label="1/√views")
                _lines(axes, part, column)
                axes.set_xscale("log")
                axes.set_yscale("log")
                axes.set_xticks(views, [f"{n:g}" for n in views])
                if row == 0:
                    axes.set_title(f"merge: {merge}" if merge else "merge as declared")
            _mm_ticks(panels[row])
            panels[row, 0].set_ylabel(f"{name} (mm)")
        for axes in panels[-1]:
            axes.set_xlabel("views")
        _legend(figure, panels)

    alt = "Temporal noise and systematic error of the map in millimetres against views, with the guide 1/sqrt(views)."
    return svg("map_noise", (10, 5.4), alt, draw)


def shadow_figure(walls: pd.DataFrame) -> str:
    """Share of each hole's wall that no view sees, or sees lit, against views."""
    import matplotlib

    sizes = sorted(walls["true_diameter_mm"].unique())
    shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.92, len(sizes)))
    kinds = (("unseen_share", "seen by no lens"), ("shadowed_share", "not both seen and lit by any view"))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, (column, name) in zip(panels, kinds, strict=True):
            for size, shade in zip(sizes, shades, strict=True):
                rows = walls[walls["true_diameter_mm"] == size].groupby("views")[column].mean()
                hole = walls.loc[walls["true_diameter_mm"] == size, "hole"].iloc[0]
                label = f"hole {hole}, {size:.1f} mm"
                axes.plot(rows.index, 100 * rows, marker="o", ms=4, color=shade, label=label)
            axes.set_xticks(sorted(walls["views"].unique()))
            axes.set(xlabel="views", ylim=(0, 100))
            axes.set_title(f"Wall {name}")
        panels[0].set_ylabel("share of the hole's wall (%)")
        panels[1].legend(loc="center left", bbox_to_anchor=(1.01, 0.5))

    alt = "Share of each hole's wall in shadow against the number of views, in per cent."
    return svg("shadow", (10, 4.0), alt, draw)


def two_views_figure(found: AgainstOne, summary: pd.DataFrame) -> str:
    """Mean sizes with one and with several views beside the truth, and the change of |size error| by hole.

    ``summary``: of `summarise_holes`.
    """
    names = {found.one.variant: "one view", found.several.variant: f"{found.several.views} views"}
    rows = summary[(summary["frames"] == found.one.frames) & summary["variant"].isin(names)]

    def draw(figure: Figure) -> None:
        above, below = figure.subplots(2, 1, height_ratios=[1.15, 1])
        _size_bars(above, rows, names)
        _changes(below, found)

    alt = "Hole sizes measured with one and with two views, and the change of the size error by hole in millimetres."
    return svg("two_views", (10, 7.0), alt, draw)


def merged_figure(examples: Sequence[MappedExample]) -> str:
    """Merged clouds from the front, coloured by the view that each point came from, with rings at the true holes."""

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(examples), 1, squeeze=False, sharex=True)[:, 0]
        for axes, example in zip(panels, examples, strict=True):
            _cloud(axes, example)
        panels[-1].set_xlabel("x along the face (mm)")
        most = max(example.views for example in examples)
        for view, colour in enumerate(VIEW_COLOURS[:most]):
            again = " and on" if view + len(VIEW_COLOURS) < most else ""
            panels[0].plot([], [], "o", ms=5, color=colour, label=f"view {view + 1}{again}")
        panels[0].plot([], [], "o", ms=5, color=SEVERAL, label="several views")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=min(most + 1, 6))

    alt = "Front view of merged clouds, each point in the colour of the view that it came from."
    return svg("merged", (10, 2.35 * len(examples) + 0.7), alt, draw)


def _cloud(axes: Axes, example: MappedExample) -> None:
    palette = np.array([*(VIEW_COLOURS[n % len(VIEW_COLOURS)] for n in range(example.views)), SEVERAL])
    chosen = palette[np.where(example.view_of < 0, example.views, np.minimum(example.view_of, example.views))]
    x, y = example.points_mm[:, 0], example.points_mm[:, 1]
    axes.scatter(x, y, s=1.1, c=chosen, lw=0, rasterized=True)
    turn = np.linspace(0, 2 * np.pi, 49)
    for hole in example.holes:
        radius = max(hole.diameter_mm / 2, 2.5)
        axes.plot(
            hole.x_mm + radius * np.cos(turn),
            hole.y_mm + radius * np.sin(turn),
            color=INK,
            lw=1.1,
            ls="-" if hole.found else (0, (2, 1.5)),
        )
    for finding in example.findings:
        if not finding.hole:
            axes.plot(finding.x_mm, finding.y_mm, "x", ms=7, mew=1.6, color="#e0201b")
    axes.set_aspect("equal")
    axes.set_ylabel("y (mm)")
    axes.grid(visible=False)
    found = sum(hole.found for hole in example.holes)
    way = ", ".join(part for part in (method_text(example.registration), example.merge) if part)
    views = f"{example.views} view{'s' if example.views > 1 else ''}"
    frames = f"{example.frames} frame{'s' if example.frames > 1 else ''} each"
    axes.set_title(f"{views} ({way}), {frames}: {found} of {len(example.holes)} holes found in this repeat")


def _lines(axes: Axes, rows: pd.DataFrame, column: str, aside: bool = False) -> None:
    """One line a registration over views."""
    methods = list(dict.fromkeys(rows["registration"]))
    for place, method in enumerate(methods):
        part = rows[(rows["registration"] == method)].sort_values("views")
        x = part["views"] + (ASIDE * (place - (len(methods) - 1) / 2) * 2 if aside else 0.0)
        values = part[column].where(part[column] > 0) if not aside else part[column]
        axes.plot(
            x,
            values,
            marker=MARKERS[place % len(MARKERS)],
            ms=5,
            lw=1.3,
            color=colour_of(method),
            label=method_text(method) or "as declared",
        )
    if aside:
        axes.set_xticks(sorted(rows["views"].unique()))


def _legend(figure: Figure, panels: np.ndarray) -> None:
    entries: dict[str, Artist] = {}
    for axes in panels.ravel():
        handles, labels = axes.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=min(len(entries), 7))


def _mm_ticks(panels: np.ndarray) -> None:
    low, high = panels[0].get_ylim()
    if high < LEAST_SPAN * low:
        middle = float(np.sqrt(low * high))
        low, high = middle / LEAST_SPAN**0.5, middle * LEAST_SPAN**0.5
        panels[0].set_ylim(low, high)
    ticks = [m * 10.0**e for e in range(-4, 3) for m in (1, 2, 5) if low <= m * 10.0**e <= high]
    for axes in panels:
        axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
        axes.minorticks_off()


def _size_bars(axes: Axes, rows: pd.DataFrame, names: dict[str, str]) -> None:
    holes = rows.drop_duplicates("hole")
    places = {hole: place for place, hole in enumerate(holes["hole"])}
    true = holes["true_diameter_mm"].to_numpy(float)
    for side, colour, (variant, name) in zip((-0.2, 0.2), (ORANGE, BLUE), names.items(), strict=True):
        part = rows[(rows["variant"] == variant) & rows["extent_diameter_mean_mm"].notna()]
        x = np.array([places[hole] for hole in part["hole"]]) + side
        std = part["extent_diameter_std_mm"].fillna(0.0)
        axes.bar(x, part["extent_diameter_mean_mm"], 0.38, yerr=std, color=colour, label=name, ecolor=INK, capsize=2.5)
    places_x = np.arange(len(true), dtype=float)
    axes.hlines(true, places_x - 0.44, places_x + 0.44, color=INK, lw=2, label="true diameter")
    labels = [f"{hole}\n{inches(d) or f'{d:.1f} mm'}" for hole, d in zip(holes["hole"], true, strict=True)]
    axes.set_xticks(places_x, labels)
    axes.set(xlabel="hole and its drill", ylabel="diameter, thesis' measure (mm)")
    axes.grid(axis="x", visible=False)
    axes.set_title("Mean size ±1 standard deviation")
    axes.legend(loc="upper left")


def _changes(axes: Axes, found: AgainstOne) -> None:
    sizes = found.sizes
    changes = sizes.by_hole()
    means = np.array([one.mean for one in changes])
    ends = np.array([[one.interval.low, one.interval.high] for one in changes]).reshape(-1, 2)
    errors = np.abs(np.nan_to_num(ends - means[:, None])).T
    axes.axhline(0, color=GREY, lw=1)
    axes.axvline(LARGE_MM, color=GREY, lw=1, ls=(0, (5, 3)), label="3/8 in, where the thesis has the turn")
    if np.isfinite(sizes.crossing_mm):
        span = sizes.crossing_interval
        if span.known:
            axes.axvspan(span.low, span.high, color=PALE, label="its 95 % interval")
        axes.axvline(sizes.crossing_mm, color=BLUE, lw=1.4, label=f"turn at {sizes.crossing_mm:.1f} mm")
    axes.errorbar(
        sizes.diameters_mm, means, errors, fmt="o", color=INK, capsize=3, label="change of each hole, 95 % interval"
    )
    axes.set(xlabel="true diameter (mm)", ylabel="change of |size error| (mm)")
    axes.set_title("Above zero: worse with more views; below: better")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=4)
