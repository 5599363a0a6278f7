"""Figures over the number of views: holes found, noise, shadow, sizes with one view and several; merged clouds; marks
before and after registration, and the target registration error by method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.maps import LARGE_MM, AgainstOne
from harness.evaluation.registration import PARTS, trusted
from harness.report.canvas import BLUE, GREEN, GREY, INK, ORANGE, PALE, PURPLE, RED, SKY, svg
from harness.report.examples import MappedExample, ShownView
from harness.report.view3d import SEVERAL, VIEW_COLOURS
from harness.tables.text import inches

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

METHOD_COLOURS = {
    "nominal": GREY,
    "icp": ORANGE,
    "cpd": BLUE,
    "marks": GREEN,
    "joint": RED,
    "odometry": PURPLE,
}
BEFORE = "guess"
MOST_METHODS = 6
ZOOM_MM = (34.0, 16.0)
"""Half the size of the picture of one mark: a strip of 40 x 12 mm, displaced by up to a centimetre."""
PART_NAMES = {"in_plane": "in the plane of the board", "across": "across it"}
MARKERS = "osD^vP"
GUIDE = "#cfd6dd"
LEAST_SPAN = 4.0
"""Highest over lowest value of a logarithmic axis: with less there may be no round number on it."""
ASIDE = 0.07
"""Registrations side by side at one number of views, or equal counts would hide each other."""


def colour_of(method: str) -> str:
    """One colour for each way of registering on all figures."""
    return METHOD_COLOURS.get(method, SKY)


def method_text(method: str) -> str:
    """Return the name of a method on axes."""
    return {"icp": "ICP", "cpd": "CPD", BEFORE: "before"}.get(method, method)


def fiducials_figure(example: MappedExample) -> str:
    """The marks of the first two views before and after registration: the whole face, one mark, and edge-on."""
    first, second = example.placed[:2]
    methods = methods_of(second)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(3, len(methods), squeeze=False, height_ratios=[0.45, 0.75, 1.2])
        centre = _one_mark(first)
        own = _marks(first, "truth")
        after = np.concatenate([own, *(_marks(second, method) for method in methods if method != BEFORE)])
        for column, method in enumerate(methods):
            whole, near, edge = panels[:, column]
            for view, place, colour in ((first, "truth", ORANGE), (second, method, BLUE)):
                points = _marks(view, place)
                look = {"ls": "none", "marker": "o", "color": colour, "mew": 0, "rasterized": True}
                whole.plot(points[:, 0], points[:, 1], ms=1.0, **look)
                near.plot(points[:, 0], points[:, 1], ms=2.6, alpha=0.75, **look)
                edge.plot(points[:, 0], points[:, 2], ms=1.5, alpha=0.75, label=view.name, **look)
            failed = second.failures.get(method, "")
            whole.set_title(method_text(method) + (" (failed)" if failed else ""))
            whole.set(ylim=(-75, 75), yticks=(-50, 0, 50))
            whole.set_aspect("equal")
            near.set(xlim=centre[0] + np.array([-1, 1]) * ZOOM_MM[0], ylim=centre[1] + np.array([-1, 1]) * ZOOM_MM[1])
            near.set_aspect("equal")
            edge.set_ylim(*_limits(after if method != BEFORE else np.concatenate([own, _marks(second, BEFORE)])))
            edge.set_xlabel("x (mm)")
        for row, name in enumerate(("y (mm)", "y, one mark (mm)", "height z (mm)")):
            panels[row, 0].set_ylabel(name)
        handles, labels = panels[2, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2, markerscale=4)

    alt = "Fiducial points of two views in the board's frame before and after registration by each method, in mm."
    return svg("fiducials", (10, 4.9), alt, draw)


def methods_of(view: ShownView) -> list[str]:
    """Ways in which a view is placed, the guess first, without the truth; at most `MOST_METHODS`."""
    named = [name for name in view.T_board_view if name not in ("truth", BEFORE, "nominal")]
    return ([BEFORE] if BEFORE in view.T_board_view else []) + named[: MOST_METHODS - 1]


def tre_figure(registrations: pd.DataFrame, frames: Sequence[int]) -> str:
    """Every registration's error by method, in the plane and across it, with the median and the predicted value."""
    methods = list(dict.fromkeys(registrations["method"]))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(PARTS), sharey=True)
        for axes, part in zip(panels, PARTS, strict=True):
            for place, method in enumerate(methods):
                for side, n in enumerate(frames):
                    rows = registrations[(registrations["method"] == method) & (registrations["frames"] == n)]
                    _strip(axes, rows, part, place + 0.36 * (side - (len(frames) - 1) / 2), method, side)
            axes.set_yscale("log")
            axes.set_xticks(range(len(methods)), [method_text(method) for method in methods])
            axes.set_xlim(-0.6, len(methods) - 0.4)
            axes.grid(axis="x", visible=False)
            axes.set_title(PART_NAMES[part][0].upper() + PART_NAMES[part][1:])
        _log_ticks(panels[0])
        panels[0].set_ylabel("target registration error (mm)")
        counted = " and ".join(f"{n} frame{'s' if n > 1 else ''}" for n in frames)
        heads = f"left to right: {counted} a view" if len(frames) > 1 else f"{counted} a view"
        panels[0].set_xlabel(f"method ({heads})", loc="left")
        _key(panels[-1])
        figure.legend(*panels[-1].get_legend_handles_labels(), loc="outside lower center", ncols=4)

    alt = "Target registration error of every registration in millimetres by method, in the plane and across it."
    return svg("tre", (10, 4.4), alt, draw)


def _strip(axes: Axes, rows: pd.DataFrame, part: str, place: float, method: str, side: int) -> None:
    """One method with one number of frames: points spread evenly by rank, so that the picture is always the same."""
    column = f"tre_{part}_mm"
    good, bad = trusted(rows), rows[rows["failure"] != ""]
    for chosen, marker, colour in ((good, "o", colour_of(method)), (bad, "x", INK)):
        values = chosen[column].to_numpy(float)
        values = values[np.isfinite(values) & (values > 0)]
        x = place + 0.26 * (np.modf(np.arange(len(values)) * 0.6180339887)[0] - 0.5)
        axes.plot(x, values, ls="none", marker=marker, ms=2.2 if marker == "o" else 4, color=colour, alpha=0.45)
    known = good[column].dropna()
    if len(known):
        axes.plot([place - 0.16, place + 0.16], [known.median()] * 2, color=INK, lw=2, solid_capstyle="butt")
    predicted = np.sqrt((good[f"predicted_{part}_mm"].dropna() ** 2).mean())
    if np.isfinite(predicted) and predicted > 0:
        axes.plot([place], [predicted], marker="D", ms=6, mfc="white", mec=INK, mew=1.2, ls="none")


def _key(axes: Axes) -> None:
    """Add the meaning of the marks to the legend."""
    axes.plot([], [], "o", ms=4, color=GREY, label="one registration")
    axes.plot([], [], color=INK, lw=2, label="median")
    axes.plot([], [], marker="D", ms=6, mfc="white", mec=INK, mew=1.2, ls="none", label="predicted, rms")
    axes.plot([], [], "x", ms=5, color=INK, label="failed, not merged")


def _log_ticks(axes: Axes) -> None:
    low, high = axes.get_ylim()
    ticks = [m * 10.0**e for e in range(-4, 4) for m in (1, 2, 5) if low <= m * 10.0**e <= high]
    if len(ticks) > 8:
        ticks = [10.0**e for e in range(-4, 4) if low <= 10.0**e <= high]
    axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.tick_params(axis="y", color=PALE)


def _marks(view: ShownView, method: str) -> np.ndarray:
    """(m, 3) the fiducial points in the board's frame as this method places them, mm."""
    T_board_view = view.T_board_view[method]
    return np.asarray(view.marks_mm @ T_board_view[:3, :3].T + T_board_view[:3, 3])


def _one_mark(view: ShownView) -> np.ndarray:
    """(2,) the middle of the points about the mark farthest to the upper right."""
    points = _marks(view, "truth")[:, :2]
    corner = points[np.argmax(points.sum(axis=1))]
    near = points[np.linalg.norm(points - corner, axis=1) < 2 * ZOOM_MM[0]]
    return np.asarray(np.median(near, axis=0))


def _limits(points: np.ndarray) -> tuple[float, float]:
    """Return the limits of z, with the face at 0 among it and a margin."""
    low, high = min(0.0, float(points[:, 2].min())), max(0.0, float(points[:, 2].max()))
    margin = 0.08 * max(high - low, 0.1)
    return low - margin, high + margin


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
    axes.set(xlabel="hole and its drill", ylabel="diameter, extent (mm)")
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
    axes.axvline(LARGE_MM, color=GREY, lw=1, ls=(0, (5, 3)), label="3/8 in")
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
