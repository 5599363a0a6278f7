"""The one colour scale of residuals: linear within 1 mm, logarithmic beyond, red behind the surface, blue before it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

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
"""Behind words in a picture."""


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
