"""Figures: fiducial clouds before and after registration, and the target registration error by method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.registration import PARTS, trusted
from harness.report.canvas import BLUE, GREEN, GREY, INK, ORANGE, PALE, PURPLE, RED, SKY, svg
from harness.report.examples import MappedExample, PlacedView

if TYPE_CHECKING:
    import pandas as pd
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


def colour_of(method: str) -> str:
    """One colour for each way of registering on all figures."""
    return METHOD_COLOURS.get(method, SKY)


def method_text(method: str) -> str:
    """What a method is called on axes."""
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


def methods_of(view: PlacedView) -> list[str]:
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
    """What the marks mean, for the legend."""
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


def _marks(view: PlacedView, method: str) -> np.ndarray:
    """(m, 3) the fiducial points in the board's frame as this method places them, mm."""
    T_board_view = view.T_board_view[method]
    return np.asarray(view.marks_mm @ T_board_view[:3, :3].T + T_board_view[:3, 3])


def _one_mark(view: PlacedView) -> np.ndarray:
    """(2,) the middle of the points about the mark farthest to the upper right."""
    points = _marks(view, "truth")[:, :2]
    corner = points[np.argmax(points.sum(axis=1))]
    near = points[np.linalg.norm(points - corner, axis=1) < 2 * ZOOM_MM[0]]
    return np.asarray(np.median(near, axis=0))


def _limits(points: np.ndarray) -> tuple[float, float]:
    """Of z, with the face at 0 among it and a margin."""
    low, high = min(0.0, float(points[:, 2].min())), max(0.0, float(points[:, 2].max()))
    margin = 0.08 * max(high - low, 0.1)
    return low - margin, high + margin
