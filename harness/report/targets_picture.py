"""The picture to choose the target by: every candidate outlined and numbered."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from harness.vocabulary.capture import Cloud

DPI, WIDTH_IN = 120, 10.0
TAKEN, OTHERS = "#ff00ff", ("#ff9f1c", "#2ec4b6", "#ffee32", "#4cc9f0", "#f94144", "#90be6d", "#bdb2ff")
"""Colours that stand apart from grey and from one another, also for people who see red and green alike."""


def save_targets(path: Path, grid: Cloud, outlines: Sequence[np.ndarray], texts: Sequence[str], taken: int) -> None:
    """Write the PNG: the colour picture, else the amplitude, else the depth of a grid, with each outline (h, w) and its
    number, counted from 1 as ``taken`` is. The legend holds each one's text and the option that takes it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patheffects import withStroke

    height, width = grid.valid.shape
    rows = len(outlines)
    figure = Figure(
        figsize=(WIDTH_IN, min(WIDTH_IN * 0.97 * height / width, 24.0) + 0.26 * rows + 0.6),
        dpi=DPI,
        layout="compressed",
    )
    canvas = FigureCanvasAgg(figure)
    axis = figure.subplots()
    axis.imshow(_shown(grid), interpolation="nearest")
    axis.set_axis_off()
    colours = iter(OTHERS * 2)
    for number, (outline, text) in enumerate(zip(outlines, texts, strict=True), start=1):
        chosen = number == taken
        colour = TAKEN if chosen else next(colours)
        padded = np.pad(outline, 1).astype(float)
        axis.contour(
            np.arange(-1, width + 1), np.arange(-1, height + 1), padded, [0.5], colors=colour,
            linewidths=2.4 if chosen else 1.4,
        )  # fmt: skip
        u, v = _label_place(outline)
        stroke = [withStroke(linewidth=4, foreground="black")]
        axis.text(u, v, str(number), color=colour, fontsize=22, weight="bold", ha="center", va="center",
                  path_effects=stroke)  # fmt: skip
        how = "taken" if chosen else f"--target {number}"
        axis.plot([], [], color=colour, linewidth=3, label=f"{number} ({how}): {text}")
    figure.legend(loc="outside lower center", fontsize=9, frameon=False)
    canvas.print_png(str(path))


def _shown(grid: Cloud) -> np.ndarray:
    """(h, w, 3) bytes."""
    if grid.rgb is not None and np.isfinite(grid.rgb).any():
        return np.clip(np.nan_to_num(np.asarray(grid.rgb)), 0, 255).astype(np.uint8)
    if grid.amplitude is not None and np.isfinite(grid.amplitude).any():
        values = np.sqrt(np.maximum(grid.amplitude, 0.0))
    else:
        values = -grid.points_m[..., 2]
    known = values[np.isfinite(values)]
    low, high = np.quantile(known, (0.02, 0.98)) if len(known) else (0.0, 1.0)
    grey = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0) * 190.0 + 50.0
    return np.repeat(np.nan_to_num(grey)[..., None], 3, axis=-1).astype(np.uint8)


def _label_place(outline: np.ndarray) -> tuple[float, float]:
    """The pixel of the outline that lies deepest inside."""
    depth = cv2.distanceTransform(np.pad(outline, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    return float(column), float(row)
