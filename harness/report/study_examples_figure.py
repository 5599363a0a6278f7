"""Pictures of damage just below, at and above a set-up's limit: what the detector had before it, hit or missed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, get_args

import numpy as np

from harness.report.canvas import DAMAGE, INK, svg
from harness.report.clouds import BOX, residual_bar, residual_image, residual_norm
from harness.report.examples import StudyExample, Where

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import SymLogNorm
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

WHERES: tuple[Where, ...] = get_args(Where)
MOST_DOWN = 3
"""Examples of one place under each other."""
TITLES: dict[Where, str] = {"below": "Below the limit", "at": "At the limit", "above": "Above the limit"}
SIZES: dict[Where, str] = {"below": "Smaller", "at": "Middle", "above": "Larger"}
"""Titles where no limit lies within the sizes inspected."""
SCALE_BAR_MM = (1, 2, 5, 10, 20, 50)
PANEL_IN = 2.5


def examples_figure(name: str, examples: Sequence[StudyExample], title: str, *, by_limit: bool = True) -> str:
    """One set-up's examples: places below, at and above the limit across (smaller, middle and larger ones where there
    is no limit to go by, not ``by_limit``), those of a place down."""
    titles = TITLES if by_limit else SIZES
    columns = [(where, _chosen(examples, where)) for where in WHERES]
    down = max(len(line) for _, line in columns)
    norm = residual_norm(max(_deepest(one) for _, line in columns for one in line))

    def draw(figure: Figure) -> None:
        figure.get_layout_engine().set(h_pad=0.08)  # type: ignore[union-attr, call-arg]
        panels = figure.subplots(down, len(columns), squeeze=False)
        for across, (where, line) in enumerate(columns):
            for axes, one in zip(panels[:, across], line, strict=False):
                picture = _panel(axes, one, norm)
            for axes in panels[len(line) :, across]:
                axes.set_visible(False)
            if line:
                panels[0, across].set_title(f"{titles[where]}\n{_size_text(line[0])}", fontsize=9.5)
        residual_bar(figure, picture, "distance behind the surface (mm)", ax=panels, shrink=0.8, pad=0.02)

    size = (PANEL_IN * len(columns) + 1.4, (PANEL_IN + 0.62) * down + 0.3)
    said = "; ".join(_words(one, titles[one.where]) for _, line in columns for one in line)
    return svg(name, size, f"{title}: {said}.", draw)


def example_text(example: StudyExample) -> str:
    """``hit: score 6.1, threshold 4.2``, or why there is no score."""
    word = "hit" if example.hit else "missed"
    if not np.isfinite(example.score):
        return f"{word}: no pixel was judged"
    return f"{word}: score {example.score:.3g}, threshold {example.threshold:.3g}"


def _chosen(examples: Sequence[StudyExample], where: Where) -> list[StudyExample]:
    """The first few of a place, by size."""
    return sorted((e for e in examples if e.where == where), key=lambda e: (e.diameter_mm, e.board))[:MOST_DOWN]


def _words(example: StudyExample, title: str) -> str:
    return f"{example.diameter_mm:.1f} mm, {title.lower()}, {example_text(example)}"


def _panel(axes: Axes, example: StudyExample, norm: SymLogNorm) -> AxesImage:
    """The residual, pixels of findings framed, the true rim, a scale bar, and in words what came of it."""
    from matplotlib.collections import LineCollection
    from matplotlib.patheffects import withStroke

    picture = residual_image(axes, example.residual_mm, norm)
    axes.add_collection(LineCollection(framed_pixels(example.detected), colors=DAMAGE, linewidths=1.6))
    rim = np.vstack([example.outline_px, example.outline_px[:1]])
    axes.plot(*rim.T, color=INK, lw=1.2, path_effects=[withStroke(linewidth=2.4, foreground="white")])
    height, width = example.residual_mm.shape
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    _scale_bar(axes, example.pitch_mm, width, height)
    axes.set_title(_size_text(example), fontsize=9.5)
    colour = "#005b96" if example.hit else "#b34700"
    axes.set_xlabel(example_text(example).replace(", threshold", "\nthreshold"), color=colour, fontsize=9)
    return picture


def _size_text(example: StudyExample) -> str:
    """``6.2 × 12.7 mm, POD 0.71``: diameter and depth of removed material."""
    pod = f", POD {example.pod:.2f}" if np.isfinite(example.pod) else ""
    return f"{example.diameter_mm:.1f} × {example.depth_mm:.3g} mm{pod}"


def _scale_bar(axes: Axes, pitch_mm: float, width: int, height: int) -> None:
    """A bar of a round length, no longer than 40 % of the picture, at the lower left."""
    length_mm = max((mm for mm in SCALE_BAR_MM if mm <= 0.4 * width * pitch_mm), default=SCALE_BAR_MM[0])
    left, low = -0.5 + 0.06 * width, height - 0.5 - 0.06 * height
    axes.plot([left, left + length_mm / pitch_mm], [low, low], color="#000000", lw=2.6, solid_capstyle="butt")
    middle = left + length_mm / pitch_mm / 2
    axes.annotate(
        f"{length_mm} mm", (middle, low), (0, 4), textcoords="offset points", ha="center", fontsize=8, bbox=BOX
    )


def framed_pixels(mask: np.ndarray) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """The border of a mask (h, w) as line segments along pixel edges: ((column, row), (column, row)) each."""
    padded = np.pad(np.asarray(mask, bool), 1)
    segments = []
    for row, column in np.argwhere(padded[1:, :] != padded[:-1, :]):
        segments.append(((column - 1.5, row - 0.5), (column - 0.5, row - 0.5)))
    for row, column in np.argwhere(padded[:, 1:] != padded[:, :-1]):
        segments.append(((column - 0.5, row - 1.5), (column - 0.5, row - 0.5)))
    return segments


def _deepest(example: StudyExample) -> float:
    """The largest residual in size, mm; 0 where there is none."""
    finite = np.abs(example.residual_mm[np.isfinite(example.residual_mm)])
    return float(np.quantile(finite, 0.995)) if finite.size else 0.0
