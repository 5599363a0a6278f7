"""Figures of damage as a detector sees it: the residuals of whole clouds and of single damages,
from stored trials.

All residuals share a colour scale: linear within 1 mm, logarithmic beyond, red behind the surface,
blue before it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

import numpy as np

from harness.records.examples import ExampleCloud, StudyExample, Where
from harness.report.blocks import DAMAGE, INK, svg
from harness.vocabulary.text import many

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import SymLogNorm
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.image import AxesImage

NOTHING = "#b9bec4"  # grey, for pixels without a valid point
LEAST_MM = 10.0
MOST_DOWN = 3
SMALLEST_RING_PX = 2.5
WIDTH_IN = 10.0
TITLES: dict[Where, str] = {
    "below": "Below the limit",
    "at": "At the limit",
    "above": "Above the limit",
}
SIZES: dict[Where, str] = {"below": "Smaller", "at": "Middle", "above": "Larger"}
"""Titles for set-ups without a limit within the sizes inspected."""


class Cut(NamedTuple):
    """A crop of a pixel grid around a damage: residual and findings (h, w), rim (k, 2), a pixel's
    width, and texts."""

    residual_mm: np.ndarray
    detected: np.ndarray
    rim_px: np.ndarray
    pitch_mm: float
    title: str
    below: str
    colour: str = INK


def residual_figure(clouds: Sequence[ExampleCloud]) -> str:
    """Draw each cloud's residuals, the pixels of findings, and rings at the true holes (dashed if
    not found)."""
    norm = residual_norm(np.concatenate([cloud.residual_mm[cloud.inside] for cloud in clouds]))
    boxes = []
    for cloud in clouds:
        v, u = np.nonzero(cloud.inside if cloud.inside.any() else np.ones_like(cloud.inside))
        boxes.append((u.min() - 0.5, u.max() + 0.5, v.max() + 0.5, v.min() - 0.5))
    heights = [
        min(max(0.92 * WIDTH_IN * (low - top) / (right - left), 1.1), 7.0)
        for left, right, low, top in boxes
    ]

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(clouds), 1, squeeze=False)[:, 0]
        for axes, cloud, (left, right, low, top) in zip(panels, clouds, boxes, strict=True):
            picture = _image(
                axes, np.where(cloud.inside, cloud.residual_mm, np.nan), cloud.detected, norm
            )
            found = 0
            for hole in cloud.truth:
                v, u = np.indices(cloud.detected.shape)
                near = np.hypot(u - hole.u_px, v - hole.v_px) <= max(hole.radius_px, 0.75)
                is_found = bool(cloud.detected[near].any())
                found += is_found
                radius = max(hole.radius_px, SMALLEST_RING_PX)
                turn = np.linspace(0, 2 * np.pi, 65)
                ring = hole.u_px + radius * np.cos(turn), hole.v_px + radius * np.sin(turn)
                axes.plot(*ring, color=INK, lw=1.2, ls="-" if is_found else (0, (2.5, 1.8)))
                above = (hole.u_px, hole.v_px - radius)
                axes.annotate(
                    hole.hole, above, (0, 2.5), textcoords="offset points", ha="center", fontsize=9
                )
            axes.set(xlim=(left, right), ylim=(low, top), ylabel="row (pixels)")
            marked = f"{found} of {len(cloud.truth)} holes marked"
            axes.set_title(
                f"{many(cloud.frames, 'frame')}, distance behind the fitted surface: {marked}"
            )
            residual_bar(figure, picture, "mm", cax=axes.inset_axes((1.012, 0.0, 0.013, 1.0)))
        panels[-1].set_xlabel("column (pixels)")

    alt = "Range residual of each pixel in millimetres, with detected pixels and a ring at each true hole."
    return svg("residual", (WIDTH_IN, sum(heights) + 0.75 * len(clouds)), alt, draw)


def examples_figure(
    name: str, examples: Sequence[StudyExample], title: str, *, by_limit: bool = True
) -> str:
    """Draw a set-up's examples. The columns are below, at and above the limit, or sizes if not
    ``by_limit``."""
    titles = TITLES if by_limit else SIZES
    columns = []
    for where in get_args(Where):
        alike = [example for example in examples if example.where == where]
        columns.append(sorted(alike, key=lambda item: (item.diameter_mm, item.board))[:MOST_DOWN])
    every = [example for line in columns for example in line]
    cuts = ([_example_cut(example, titles) for example in line] for line in columns)
    rows = list(zip_longest(*cuts))
    captions = "; ".join(
        f"{each.diameter_mm:.1f} mm, {titles[each.where].lower()}, {_outcome(each)}"
        for each in every
    )
    return _cuts(name, rows, f"{title}: {captions}.")


def _outcome(example: StudyExample) -> str:
    word = "hit" if example.hit else "missed"
    if not np.isfinite(example.score):
        return f"{word}: no pixel was judged"
    return f"{word}: score {example.score:.3g}, threshold {example.threshold:.3g}"


def _example_cut(example: StudyExample, titles: Mapping[Where, str]) -> Cut:
    pod = f", POD {example.pod:.2f}" if np.isfinite(example.pod) else ""
    title = f"{titles[example.where]}\n{example.diameter_mm:.1f} × {example.depth_mm:.3g} mm{pod}"
    below = _outcome(example).replace(", threshold", "\nthreshold")
    colour = "#005b96" if example.hit else "#b34700"
    return Cut(
        example.residual_mm,
        example.detected,
        example.outline_px,
        example.pitch_mm,
        title,
        below,
        colour,
    )


def _cuts(name: str, rows: Sequence[Sequence[Cut | None]], alt: str) -> str:
    """Draw damages with a common colour scale; the axes are in mm from the middle of each crop."""
    cuts = [cut for line in rows for cut in line if cut is not None]
    norm = residual_norm(np.concatenate([cut.residual_mm.ravel() for cut in cuts]))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(rows), len(rows[0]), squeeze=False)
        for axes, cut in zip(panels.ravel(), (cut for line in rows for cut in line), strict=True):
            if cut is None:
                axes.set_visible(False)
                continue
            picture = _image(
                axes, cut.residual_mm, cut.detected, norm, dot=60 / max(cut.residual_mm.shape)
            )
            axes.plot(*np.vstack([cut.rim_px, cut.rim_px[:1]]).T, color=INK, lw=1.3)
            height, width = cut.residual_mm.shape
            axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), yticks=[])
            middle = (width - 1) / 2
            step = 10 / cut.pitch_mm
            axes.set_xticks(
                [middle - step, middle, middle + step], ["−10", "0", "10 mm"], fontsize=8
            )
            axes.set_title(cut.title, fontsize=9.5)
            axes.set_xlabel(cut.below, color=cut.colour, fontsize=9)
        residual_bar(
            figure, picture, "distance behind the surface (mm)", ax=panels, shrink=0.8, pad=0.02
        )

    return svg(name, (2.5 * len(rows[0]) + 1.4, 3.2 * len(rows) + 0.3), alt, draw)


def residual_norm(residual_mm: np.ndarray) -> SymLogNorm:
    """Return the colour scale for residuals (any shape): linear within 1 mm, logarithmic beyond."""
    from matplotlib.colors import SymLogNorm

    finite = np.abs(residual_mm[np.isfinite(residual_mm)])
    limit = max(LEAST_MM, float(np.quantile(finite, 0.9995)) if finite.size else 0.0)
    return SymLogNorm(linthresh=1, linscale=1.2, vmin=-limit, vmax=limit, base=10)


def _image(
    axes: Axes, residual_mm: np.ndarray, detected: np.ndarray, norm: SymLogNorm, dot: float = 1.1
) -> AxesImage:
    """Draw residuals (h, w) with a dot of ``dot`` points on each pixel of a finding."""
    axes.set_facecolor(NOTHING)
    axes.grid(visible=False)
    picture = axes.imshow(residual_mm, norm=norm, cmap="RdBu_r", aspect="equal")
    v, u = np.nonzero(detected)
    axes.plot(u, v, "o", color=DAMAGE, ms=dot, mew=0)
    return picture


def residual_bar(
    figure: Figure | SubFigure, picture: ScalarMappable, label: str, **place: Any
) -> None:
    """Draw the colour bar with round numbers; ``place`` is passed to `Figure.colorbar`."""
    limit = picture.get_clim()[1] or LEAST_MM
    bar = figure.colorbar(picture, extend="both", **place)
    bar.set_label(label)
    ticks = [t for t in (-100, -10, -1, 0, 1, 10, 100) if abs(t) <= limit]
    bar.set_ticks(ticks, labels=[f"{t:+d}".replace("-", "−") if t else "0" for t in ticks])
    bar.minorticks_off()
