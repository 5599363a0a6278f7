"""Figure: probability of detection over diameter and depth, with the damage it was fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.surface import PodSurface
from harness.report.canvas import BLUE, GREEN, INK, ORANGE, SKY, svg
from harness.report.pod import plain
from harness.report.study_rows import mm_text, name_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEVELS = {0.1: SKY, 0.5: GREEN, 0.9: ORANGE}
"""Lines of equal POD that are drawn."""
GRID = 121


def surface_figure(surfaces: Sequence[tuple[SetUpLimit, PodSurface]]) -> str:
    """A panel for each set-up: lines of equal POD, the interval of that of 90 %, every damage found or missed."""
    across = min(2, len(surfaces))
    down = -(-len(surfaces) // across)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(down, across, squeeze=False).ravel()
        for axes, (limit, surface) in zip(grid, surfaces, strict=False):
            _panel(axes, limit, surface)
            axes.set_title(plain(fill(name_of(limit), 46 if across > 1 else 80)))
        for axes in grid[len(surfaces) :]:
            axes.set_visible(False)
        figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)

    size = (5.2 * across, 3.9 * down + 0.7) if across > 1 else (8.6, 5.2)
    said = "; ".join(
        f"{name_of(limit)}: a90 {mm_text(surface.a90_mm[0], limit.largest_mm)} mm at {surface.depth_mm[0]:.3g} mm "
        f"depth, {mm_text(surface.a90_mm[-1], limit.largest_mm)} mm at {surface.depth_mm[-1]:.3g} mm"
        for limit, surface in surfaces
    )
    return svg("surface", size, f"Probability of detection over diameter and depth. {said}.", draw)


def _panel(axes: Axes, limit: SetUpLimit, surface: PodSurface) -> None:
    (left, right), (low, high) = surface.diameter_range_mm, surface.depth_range_mm
    diameter, depth = np.linspace(left, right, GRID), np.geomspace(low, high, GRID)
    pod = surface.pod(*np.meshgrid(diameter, depth))
    shade = axes.contourf(diameter, depth, pod, levels=np.linspace(0, 1, 11), cmap="Greys", alpha=0.28)
    shade.set_rasterized(True)
    inside = [np.clip(edge, left, right) for edge in (surface.a90_low_mm, surface.a90_high_mm)]
    axes.fill_betweenx(surface.depth_mm, *inside, color=ORANGE, alpha=0.3, lw=0, label="90 %, interval over boards")
    for level, colour in LEVELS.items():
        if pod.min() < level < pod.max():
            axes.contour(diameter, depth, pod, levels=[level], colors=[colour], linewidths=2)
        axes.plot([], [], color=colour, lw=2, label=f"POD {100 * level:.0f} %")
    seen = limit.record.inspected
    hit = np.asarray(seen.hit, bool)
    axes.scatter(seen.diameter_mm[hit], seen.depth_mm[hit], s=9, color=BLUE, lw=0, alpha=0.8, label="found")
    missed: dict[str, Any] = {"s": 11, "facecolor": "white", "edgecolor": INK, "lw": 0.6, "alpha": 0.8}
    axes.scatter(seen.diameter_mm[~hit], seen.depth_mm[~hit], label="missed", **missed)
    axes.set(xlabel="diameter (mm)", ylabel="depth of removed material (mm)", xlim=(left, right), ylim=(low, high))
