"""Figures of damage as a detector sees it: the residuals of whole clouds and of single damages,
from stored trials.

All residuals share a colour scale: linear within 1 mm, logarithmic beyond, red behind the surface,
blue before it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from harness.records.examples import ExampleCloud, HoleInView, StudyExample, Where
from harness.report.blocks import DAMAGE, HIT, MISS, ON_IMAGE, svg
from harness.vocabulary.text import many

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import SymLogNorm
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.image import AxesImage

NOTHING = "#b9bec4"
"""Grey, for pixels without a valid point."""
LEAST_MM = 10.0
"""Least end of the colour scale."""
MOST_DOWN = 3
"""Most examples below one another."""
SMALLEST_RING_PX = 2.5
WIDTH_IN = 10.0
SIGHT_IN = (3.7, 3.9)
"""Width and height of the picture of one damage."""
TITLES: dict[Where, str] = {
    "below": "Below the limit",
    "at": "At the limit",
    "above": "Above the limit",
}
SIZES: dict[Where, str] = {"below": "Smaller", "at": "Middle", "above": "Larger"}
"""Titles for set-ups without a limit within the sizes inspected."""

# ---------------------------------------------------------------- whole clouds


def residual_figure(clouds: Sequence[ExampleCloud]) -> str:
    """Draw each cloud's residuals, the pixels of findings, and rings at the true holes (dashed if
    not found)."""
    norm = residual_norm(np.concatenate([cloud.residual_mm[cloud.inside] for cloud in clouds]))
    boxes = [_box(cloud.inside) for cloud in clouds]
    heights_in = [_height_in(box) for box in boxes]

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(clouds), 1, squeeze=False)[:, 0]
        for axes, cloud, box in zip(panels, clouds, boxes, strict=True):
            residual_mm = np.where(cloud.inside, cloud.residual_mm, np.nan)
            picture = _image(axes, residual_mm, cloud.detected, norm)
            marked = 0
            for hole in cloud.truth:
                is_marked = _is_marked(cloud, hole)
                marked += is_marked
                _ring(axes, hole, is_marked)
            left, right, low, top = box
            axes.set(xlim=(left, right), ylim=(low, top), ylabel="row (pixels)")
            axes.set_title(
                f"{many(cloud.frames, 'frame')}, distance behind the fitted surface:"
                f" {marked} of {len(cloud.truth)} holes marked"
            )
            residual_bar(figure, picture, "mm", cax=axes.inset_axes((1.012, 0.0, 0.013, 1.0)))
        panels[-1].set_xlabel("column (pixels)")

    alt = (
        "Range residual of each pixel in millimetres, with detected pixels and a ring at each true"
        " hole."
    )
    return svg("residual", (WIDTH_IN, sum(heights_in) + 0.75 * len(clouds)), alt, draw)


def _box(inside: np.ndarray) -> tuple[float, float, float, float]:
    """Return the ends (left, right, low, top) of a crop (h, w) bool, or of all pixels if it is
    empty."""
    v, u = np.nonzero(inside if inside.any() else np.ones_like(inside))
    return u.min() - 0.5, u.max() + 0.5, v.max() + 0.5, v.min() - 0.5


def _height_in(box: tuple[float, float, float, float]) -> float:
    left, right, low, top = box
    return min(max(0.92 * WIDTH_IN * (low - top) / (right - left), 1.1), 7.0)


def _is_marked(cloud: ExampleCloud, hole: HoleInView) -> bool:
    """Return whether a finding has a pixel on the hole."""
    v, u = np.indices(cloud.detected.shape)
    on_hole = np.hypot(u - hole.u_px, v - hole.v_px) <= max(hole.radius_px, 0.75)
    return bool(cloud.detected[on_hole].any())


def _ring(axes: Axes, hole: HoleInView, is_marked: bool) -> None:
    """Draw a ring around a hole, dashed if it is not marked, with its number above."""
    radius = max(hole.radius_px, SMALLEST_RING_PX)
    turn = np.linspace(0, 2 * np.pi, 65)
    u = hole.u_px + radius * np.cos(turn)
    v = hole.v_px + radius * np.sin(turn)
    axes.plot(u, v, color=ON_IMAGE, lw=1.2, ls="-" if is_marked else (0, (2.5, 1.8)))
    above = (hole.u_px, hole.v_px - radius)
    axes.annotate(
        hole.hole,
        above,
        (0, 2.5),
        color=ON_IMAGE,
        textcoords="offset points",
        ha="center",
        fontsize=9,
    )


# ---------------------------------------------------------------- single damages


def examples_figure(
    name: str, examples: Sequence[StudyExample], title: str, *, by_limit: bool = True
) -> str:
    """Draw a set-up's examples with a common colour scale, in mm from the middle of each crop. The
    columns are below, at and above the limit, or sizes if not ``by_limit``."""
    titles = TITLES if by_limit else SIZES
    columns = [_column(examples, where) for where in get_args(Where)]
    rows = list(zip_longest(*columns))
    shown = [example for column in columns for example in column]
    captions = "; ".join(_caption(example, titles) for example in shown)
    norm = residual_norm(
        np.concatenate([example.residual_mm.ravel() for row in rows for example in row if example])
    )

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(rows), len(rows[0]), squeeze=False)
        in_order = [example for row in rows for example in row]
        for axes, example in zip(panels.ravel(), in_order, strict=True):
            if example is None:
                axes.set_visible(False)
            else:
                picture = _draw_example(axes, example, norm, titles)
        label = "distance behind the surface (mm)"
        residual_bar(figure, picture, label, ax=panels, shrink=0.8, pad=0.02)

    size_in = (2.5 * len(rows[0]) + 1.4, 3.2 * len(rows) + 0.3)
    return svg(name, size_in, f"{title}: {captions}.", draw)


def sight_figure(name: str, examples: Sequence[StudyExample], title: str) -> str:
    """Draw the example that is nearest to a set-up's limit: what the camera saw of damage that it
    can just find."""
    in_order = sorted(examples, key=lambda example: example.where != "at")
    example = in_order[0]
    norm = residual_norm(example.residual_mm)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        picture = _draw_example(axes, example, norm, TITLES)
        residual_bar(figure, picture, "mm", ax=axes, shrink=0.8)

    return svg(name, SIGHT_IN, f"{title}: {_caption(example, TITLES)}.", draw)


def _column(examples: Sequence[StudyExample], where: Where) -> list[StudyExample]:
    """Return the first examples of a column, smallest first."""
    chosen = [example for example in examples if example.where == where]
    chosen.sort(key=lambda example: (example.diameter_mm, example.board))
    return chosen[:MOST_DOWN]


def _caption(example: StudyExample, titles: Mapping[Where, str]) -> str:
    column = titles[example.where].lower()
    return f"{example.diameter_mm:.1f} mm, {column}, {_outcome(example)}"


def _outcome(example: StudyExample) -> str:
    word = "hit" if example.hit else "missed"
    if not np.isfinite(example.score):
        return f"{word}: no pixel was judged"
    return f"{word}: score {example.score:.3g}, threshold {example.threshold:.3g}"


def _draw_example(
    axes: Axes, example: StudyExample, norm: SymLogNorm, titles: Mapping[Where, str]
) -> AxesImage:
    """Draw the crop around a damage with its rim, its size above and its outcome below."""
    height, width = example.residual_mm.shape
    dot = 60 / max(height, width)
    picture = _image(axes, example.residual_mm, example.detected, norm, dot)
    rim_px = np.vstack([example.outline_px, example.outline_px[:1]])
    axes.plot(rim_px[:, 0], rim_px[:, 1], color=ON_IMAGE, lw=1.3)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), yticks=[])
    middle = (width - 1) / 2
    step = 10 / example.pitch_mm
    ticks = [middle - step, middle, middle + step]
    axes.set_xticks(ticks, ["−10", "0", "10 mm"], fontsize=8)
    pod = f", POD {example.pod:.2f}" if np.isfinite(example.pod) else ""
    size = f"{example.diameter_mm:.1f} × {example.depth_mm:.3g} mm{pod}"
    axes.set_title(f"{titles[example.where]}\n{size}", fontsize=9.5)
    outcome = _outcome(example).replace(", threshold", "\nthreshold")
    colour = HIT if example.hit else MISS
    axes.set_xlabel(outcome, color=colour, fontsize=9)
    return picture


# ---------------------------------------------------------------- the common colour scale


def residual_norm(residual_mm: np.ndarray) -> SymLogNorm:
    """Return the colour scale for residuals (any shape): linear within 1 mm, logarithmic beyond."""
    from matplotlib.colors import SymLogNorm

    finite_mm = np.abs(residual_mm[np.isfinite(residual_mm)])
    limit_mm = LEAST_MM
    if finite_mm.size:
        limit_mm = max(LEAST_MM, float(np.quantile(finite_mm, 0.9995)))
    return SymLogNorm(
        linthresh=1,
        linscale=1.2,
        vmin=-limit_mm,
        vmax=limit_mm,
        base=10,
    )


def _image(
    axes: Axes,
    residual_mm: np.ndarray,
    detected: np.ndarray,
    norm: SymLogNorm,
    dot: float = 1.1,
) -> AxesImage:
    """Draw residuals (h, w) with a dot of ``dot`` points on each pixel of a finding."""
    axes.set_facecolor(NOTHING)
    axes.grid(visible=False)
    picture = axes.imshow(residual_mm, norm=norm, cmap="RdBu_r", aspect="equal")
    v, u = np.nonzero(detected)
    axes.plot(u, v, "o", color=DAMAGE, ms=dot, mew=0)
    return picture


def residual_bar(
    figure: Figure | SubFigure, picture: ScalarMappable, label: str, **position: Any
) -> None:
    """Draw the colour bar with round numbers; ``position`` is passed to `Figure.colorbar`."""
    limit_mm = picture.get_clim()[1] or LEAST_MM
    bar = figure.colorbar(picture, extend="both", **position)
    bar.set_label(label)
    ticks_mm = [mm for mm in (-100, -10, -1, 0, 1, 10, 100) if abs(mm) <= limit_mm]
    labels = [f"{mm:+d}".replace("-", "−") if mm else "0" for mm in ticks_mm]
    bar.set_ticks(ticks_mm, labels=labels)
    bar.minorticks_off()
