"""Pictures of averaged clouds: points with the damage in magenta, residuals in mm, the same hole as set-ups see it,
depth profiles through holes. Residuals have one colour scale: linear within 1 mm, logarithmic beyond, red behind the
surface, blue before it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.profile import HoleInView, hole_shape, relative_radius, true_residual_mm
from harness.report.canvas import BLUE, DAMAGE, GREY, INK, ORANGE, svg
from harness.report.examples import ExampleCloud
from harness.tables.text import inches

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import SymLogNorm
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.image import AxesImage

NOTHING = "#b9bec4"
"""Grey: no valid point."""
LEAST_MM = 10.0
"""Both ends of the scale are at least this far out."""
BOX: dict[str, Any] = {"facecolor": "#ffffff", "alpha": 0.75, "edgecolor": "none", "pad": 1.5}
"""The box behind words in a picture."""
AROUND_MM = 9.0
"""Undamaged face shown beyond the rim: more than any of the cameras' filters reaches."""
MOST_HOLES = 4
PANEL_IN = 1.9
SIDE_IN = 1.9
"""Room for axes, titles and the colour bar."""
PROFILES = 6
"""Holes shown in profile, the largest ones."""
SMALLEST_RING_PX = 2.5
"""Rings are drawn no smaller than this, or those of the smallest holes could not be seen."""
WIDTH_IN = 10.0
LOOKS = {"bowl": "like a bowl", "cylinder": "like a cylinder", "neither": "neither clearly"}

Paint = Callable[["Axes", ExampleCloud, "_Frame"], None]


@dataclass(frozen=True)
class _Frame:
    """The searched part of a cloud and the map from pixels to mm in the camera's frame: zero + step * pixel."""

    rows: slice
    cols: slice
    x_zero: float
    x_step: float
    y_zero: float
    y_step: float

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """left, right, bottom, top of the picture in mm; y points down, as in the camera's frame."""
        u0, u1 = self.cols.start - 0.5, self.cols.stop - 0.5
        v0, v1 = self.rows.start - 0.5, self.rows.stop - 0.5
        x, y = (lambda u: self.x_zero + self.x_step * u), (lambda v: self.y_zero + self.y_step * v)
        return x(u0), x(u1), y(v1), y(v0)

    @property
    def aspect(self) -> float:
        """Height over width."""
        left, right, bottom, top = self.extent
        return abs((bottom - top) / (right - left))


def cloud_figure(clouds: Sequence[ExampleCloud]) -> str:
    """The points of each cloud in their colours, damage in magenta, rings at the true holes (dashed: not found)."""

    def paint(axes: Axes, cloud: ExampleCloud, frame: _Frame) -> None:
        axes.imshow(_coloured(cloud)[frame.rows, frame.cols], extent=frame.extent, aspect="equal")
        for hole in cloud.truth:
            _ring(axes, frame, hole, found=_touched(cloud, hole))
        axes.set_title(
            f"{_frames(cloud)}: {sum(_touched(cloud, h) for h in cloud.truth)} of {len(cloud.truth)} holes marked"
        )

    alt = (
        "Front view of the averaged cloud in its colours with detected damage in magenta and a ring at each true hole."
    )
    return _stacked("cloud", clouds, alt, paint)


def residual_figure(clouds: Sequence[ExampleCloud]) -> str:
    """Distance behind (+) or before (-) the fitted surface, mm; linear within 1 mm, logarithmic beyond, grey: none."""
    finite = [np.abs(c.residual_mm[c.inside & np.isfinite(c.residual_mm)]) for c in clouds]
    pooled = np.concatenate(finite) if finite else np.zeros(0)
    norm = residual_norm(float(np.quantile(pooled, 0.9995)) if pooled.size else 0.0)

    def paint(axes: Axes, cloud: ExampleCloud, frame: _Frame) -> None:
        shown = np.where(cloud.inside, cloud.residual_mm, np.nan)[frame.rows, frame.cols]
        picture = residual_image(axes, shown, norm, extent=frame.extent)
        axes.set_title(f"{_frames(cloud)}: distance behind the fitted surface")
        residual_bar(axes.figure, picture, "mm", cax=axes.inset_axes((1.012, 0.0, 0.013, 1.0)))

    alt = "Range residual of each pixel in millimetres: noise and pattern of the face near zero, holes far behind it."
    return _stacked("residual", clouds, alt, paint)


def profile_figure(clouds: Sequence[ExampleCloud]) -> str:
    """Depth along a row of pixels through the largest holes, with the true geometry and the best-fitting bowl."""
    last = clouds[-1]
    holes = sorted(last.truth, key=lambda hole: hole.diameter_mm)[-PROFILES:]
    columns = min(3, len(holes))
    rows = -(-len(holes) // columns)

    def draw(figure: Figure) -> None:
        grid = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
        for axes, hole in zip(grid, holes, strict=False):
            _profile(axes, list(clouds), hole)
        for axes in grid[len(holes) :]:
            axes.set_visible(False)
        for axes in grid[max(0, len(holes) - columns) : len(holes)]:
            axes.set_xlabel("across the hole (mm)")
        for axes in grid[::columns]:
            axes.set_ylabel("depth (mm)")
        handles, labels = grid[-1 if len(holes) == len(grid) else 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)

    alt = "Depth profiles through the largest holes: measured points, the true cylinder, and a scaled hemisphere."
    return svg("profile", (WIDTH_IN, 2.7 * rows + 0.4), alt, draw)


def _profile(axes: Axes, clouds: list[ExampleCloud], hole: HoleInView) -> None:
    radius_mm, last = hole.diameter_mm / 2, clouds[-1]
    across = (np.arange(last.residual_mm.shape[1]) - hole.u_px) / hole.radius_px * radius_mm
    row = int(np.clip(round(hole.v_px), 0, last.residual_mm.shape[0] - 1))
    near = np.abs(across) < max(2 * radius_mm, radius_mm + 6)
    true = true_residual_mm(last, hole)[row]
    axes.plot(across[near], true[near], color=INK, lw=1.3, drawstyle="steps-mid", label="true geometry on these pixels")
    deepest = 1.0
    for cloud in clouds[:1] + clouds[-1:] if len(clouds) > 1 else clouds:
        z = cloud.residual_mm[row]
        colour, marker, line = (BLUE, "o", "-") if cloud is last else (GREY, "^", "none")
        axes.plot(
            across[near], z[near], ls=line, color=colour, marker=marker, ms=4, lw=1, label=f"measured, {_frames(cloud)}"
        )
        finite = z[near & np.isfinite(z)]
        deepest = max(deepest, float(finite.max()) if finite.size else 0.0)
    shape = hole_shape(last, hole)
    if shape is not None:
        x = np.linspace(-radius_mm, radius_mm, 101)
        y = shape.bowl_depth_mm * np.sqrt(1 - (x / radius_mm) ** 2)
        axes.plot(x, y, "--", color=ORANGE, label="hemisphere, depth fitted")
        deepest = max(deepest, shape.bowl_depth_mm)
    floor = float(np.nanmax(true[near])) if np.isfinite(true[near]).any() else deepest
    shown = floor if floor <= 3 * deepest else 1.6 * deepest
    if shown < floor:
        axes.annotate(f"true floor at {floor:.0f} mm", (0, 1.5 * deepest), ha="center", fontsize=8.5, color=INK)
    axes.set_ylim(1.12 * max(shown, deepest), -0.15 * max(shown, deepest))
    axes.set_title(
        f"Hole {hole.hole}, {inches(hole.diameter_mm) or f'{hole.diameter_mm:.1f} mm'}"
        + (f": {LOOKS[shape.looks]}" if shape else "")
    )


def _stacked(name: str, clouds: Sequence[ExampleCloud], alt: str, paint: Paint) -> str:
    """One picture under the other, each with its axes in mm."""
    frames = [_framed(cloud) for cloud in clouds]
    height = sum(min(max(0.92 * WIDTH_IN * frame.aspect, 1.1), 7.0) + 0.75 for frame in frames)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(clouds), 1, squeeze=False)[:, 0]
        for axes, cloud, frame in zip(panels, clouds, frames, strict=True):
            paint(axes, cloud, frame)
            axes.grid(visible=False)
            axes.set_ylabel("y down (mm)")
        panels[-1].set_xlabel("x in the camera's frame (mm)")

    return svg(name, (WIDTH_IN, height), alt, draw)


def _framed(cloud: ExampleCloud) -> _Frame:
    """The searched rectangle and its scale by least squares on the valid points (a board seen nearly frontally)."""
    searched = cloud.inside if cloud.inside.any() else np.ones_like(cloud.inside)
    v_all, u_all = np.nonzero(searched)
    valid = searched & np.isfinite(cloud.points_m[..., 2])
    if valid.sum() < 3:
        valid = np.zeros_like(searched)
    v, u = np.nonzero(valid)
    x, y = cloud.points_m[valid][:, 0] * 1e3, cloud.points_m[valid][:, 1] * 1e3
    x_step, x_zero = np.polyfit(u, x, 1) if len(set(u)) > 1 else (1.0, 0.0)
    y_step, y_zero = np.polyfit(v, y, 1) if len(set(v)) > 1 else (1.0, 0.0)
    rows, cols = slice(int(v_all.min()), int(v_all.max()) + 1), slice(int(u_all.min()), int(u_all.max()) + 1)
    return _Frame(rows, cols, float(x_zero), float(x_step), float(y_zero), float(y_step))


def _coloured(cloud: ExampleCloud) -> np.ndarray:
    """(h, w, 3) uint8: the cloud's colours, grey where no point is, paler outside the crop, magenta for damage."""
    picture = cloud.rgb.astype(float)
    picture[~cloud.inside] = 0.4 * picture[~cloud.inside] + 0.6 * 255
    picture[~np.isfinite(cloud.points_m[..., 2])] = 185
    picture[cloud.detected] = tuple(int(DAMAGE[i : i + 2], 16) for i in (1, 3, 5))
    return np.clip(picture, 0, 255).astype(np.uint8)


def _touched(cloud: ExampleCloud, hole: HoleInView) -> bool:
    """Return whether a pixel of the hole (at least the central one) belongs to a cluster that this cloud shows."""
    radius = relative_radius(cloud, hole)
    return bool(cloud.detected[radius <= max(1.0, 0.75 / hole.radius_px)].any())


def _ring(axes: Axes, frame: _Frame, hole: HoleInView, *, found: bool) -> None:
    from matplotlib.patches import Circle

    centre = (frame.x_zero + frame.x_step * hole.u_px, frame.y_zero + frame.y_step * hole.v_px)
    radius = max(hole.radius_px, SMALLEST_RING_PX) * abs(frame.x_step)
    style = {"ls": "-", "ec": INK, "lw": 1.0} if found else {"ls": (0, (2.5, 1.8)), "ec": "#000000", "lw": 1.4}
    axes.add_patch(Circle(centre, radius, fill=False, **style))
    axes.annotate(
        hole.hole,
        (centre[0], centre[1] - radius),
        (0, 2.5),
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize=9,
        color="#000000",
    )


def _frames(cloud: ExampleCloud) -> str:
    return "1 frame" if cloud.frames == 1 else f"{cloud.frames} frames averaged"


def residual_norm(deepest_mm: float) -> SymLogNorm:
    """The scale for residuals up to ``deepest_mm`` in size."""
    from matplotlib.colors import SymLogNorm

    limit = max(LEAST_MM, deepest_mm)
    return SymLogNorm(linthresh=1, linscale=1.2, vmin=-limit, vmax=limit, base=10)


def residual_image(axes: Axes, residual_mm: np.ndarray, norm: SymLogNorm, **place: Any) -> AxesImage:
    """``residual_mm`` (h, w) as a picture without grid lines; ``place``: what `Axes.imshow` needs to put it there."""
    axes.set_facecolor(NOTHING)
    axes.grid(visible=False)
    return axes.imshow(residual_mm, norm=norm, cmap="RdBu_r", aspect="equal", **place)


def residual_bar(figure: Figure | SubFigure, picture: AxesImage, label: str, **place: Any) -> None:
    """The colour bar with round numbers; ``place``: what `Figure.colorbar` needs (``ax`` or ``cax``, ``shrink``)."""
    limit = picture.get_clim()[1] or LEAST_MM
    bar = figure.colorbar(picture, extend="both", **place)
    bar.set_label(label)
    ticks = [t for t in (-100, -30, -10, -3, -1, 0, 1, 3, 10, 30, 100) if abs(t) <= limit]
    bar.set_ticks(ticks, labels=[f"{t:+d}".replace("-", "−") if t else "0" for t in ticks])
    bar.minorticks_off()


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
