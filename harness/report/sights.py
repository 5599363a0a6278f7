"""Pictures of the same hole as each set-up sees it: the residual in mm around it, on one colour scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.profile import HoleInView
from harness.report.canvas import DAMAGE, INK, svg
from harness.report.examples import ExampleCloud
from harness.report.residual_scale import BOX, residual_bar, residual_image, residual_norm
from harness.tables.text import inches

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import SymLogNorm
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

AROUND_MM = 9.0
"""Undamaged face shown beyond the rim: more than any of the cameras' filters reaches."""
MOST_HOLES = 4
PANEL_IN = 1.9
SIDE_IN = 1.9
"""For axes, titles and the colour bar."""


def chosen_holes(cloud: ExampleCloud) -> list[str]:
    """Every second hole from the fourth smallest on (of the thesis' board 4, 6, 8 and 10), at most `MOST_HOLES`."""
    names = [hole.hole for hole in sorted(cloud.truth, key=lambda hole: hole.diameter_mm)]
    return names[min(3, len(names) - 1) :: 2][:MOST_HOLES]


def sights_figure(clouds: Mapping[str, ExampleCloud]) -> str:
    """Holes down, set-ups across."""
    titles = list(clouds)
    holes = chosen_holes(clouds[titles[0]])
    grid = [[(clouds[title], hole) for title in titles] for hole in holes]
    first = clouds[titles[0]]
    sides = [_hole_title(first, hole) for hole in holes]
    return _grid("sights", grid, titles, sides, "The same holes as each set-up sees them: residual in millimetres.")


def one_hole_figure(rows: Mapping[str, Sequence[ExampleCloud]], columns: Sequence[str]) -> str:
    """One hole, the second of `chosen_holes`, in every set-up: rows of the layout down, its columns across."""
    first = next(iter(rows.values()))[0]
    hole = chosen_holes(first)[:2][-1]
    grid = [[(cloud, hole) for cloud in line] for line in rows.values()]
    sides = [f"{row}\n{_hole_title(first, hole)}" for row in rows]
    return _grid("one_hole", grid, list(columns), sides, f"Hole {hole} in every set-up: residual in millimetres.")


def _grid(
    name: str, grid: Sequence[Sequence[tuple[ExampleCloud, str]]], titles: Sequence[str], sides: Sequence[str], alt: str
) -> str:
    norm = residual_norm(max(_deepest(cloud, hole) for line in grid for cloud, hole in line))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(grid), len(titles), squeeze=False)
        for row, line in enumerate(grid):
            for column, (cloud, hole) in enumerate(line):
                axes = panels[row, column]
                picture = _panel(axes, cloud, hole, norm)
                if row == 0:
                    axes.set_title(titles[column])
                if row == len(grid) - 1:
                    axes.set_xlabel("x from the hole (mm)")
            panels[row, 0].set_ylabel(f"{sides[row]}\ny down (mm)")
        residual_bar(figure, picture, "distance behind the fitted surface (mm)", ax=panels, shrink=0.8, pad=0.02)

    size = (PANEL_IN * len(titles) + SIDE_IN + 0.8, PANEL_IN * len(grid) + 0.9)
    return svg(name, size, alt, draw)


def _panel(axes: Axes, cloud: ExampleCloud, name: str, norm: SymLogNorm) -> AxesImage:
    """One hole in one cloud: residuals, the true rim, dots on pixels of detected clusters."""
    index = next(i for i, hole in enumerate(cloud.truth) if hole.hole == name)
    hole, rim = cloud.truth[index], cloud.outlines_px[index]
    step = hole.diameter_mm / np.ptp(rim, axis=0)  # mm a pixel, across and down, through the lens as it is here
    half = hole.diameter_mm / 2 + AROUND_MM
    reach = np.ceil(half / step).astype(int) + 1
    centre = np.array([hole.u_px, hole.v_px])
    low = np.maximum(np.floor(centre - reach).astype(int), 0)
    high = np.minimum(np.ceil(centre + reach).astype(int) + 1, cloud.residual_mm.shape[::-1])
    cut = (slice(low[1], high[1]), slice(low[0], high[0]))
    left, top = (low - 0.5 - centre) * step
    right, bottom = (high - 0.5 - centre) * step
    picture = residual_image(axes, cloud.residual_mm[cut], norm, extent=(left, right, bottom, top))
    axes.plot(*((rim - centre) * step).T, color=INK, lw=1.1)
    v, u = np.nonzero(cloud.detected[cut])
    axes.plot((u + low[0] - centre[0]) * step[0], (v + low[1] - centre[1]) * step[1], ".", color=DAMAGE, ms=2.2, mew=0)
    axes.set(xlim=(-half, half), ylim=(half, -half))
    axes.text(0.03, 0.03, f"{step[0]:.2f} mm/px", transform=axes.transAxes, fontsize=8, bbox=BOX)
    return picture


def _deepest(cloud: ExampleCloud, name: str) -> float:
    """The largest residual inside a hole's outline, mm; 0 where none is known."""
    hole: HoleInView = next(one for one in cloud.truth if one.hole == name)
    v, u = np.indices(cloud.residual_mm.shape)
    inside = np.abs(cloud.residual_mm[np.hypot(u - hole.u_px, v - hole.v_px) < hole.radius_px])
    return float(np.nanmax(inside)) if np.isfinite(inside).any() else 0.0


def _hole_title(cloud: ExampleCloud, name: str) -> str:
    hole = next(one for one in cloud.truth if one.hole == name)
    return f"hole {name}, {inches(hole.diameter_mm) or f'{hole.diameter_mm:.1f} mm'}"
