"""The picture of a run: the colour image and the range residual, each finding circled and numbered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.interface import Detection, Evidence, MissingReturns
from harness.vocabulary.capture import Cloud
from harness.vocabulary.units import MM

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH_IN, DPI = 11.0, 150
LABEL_IN = 3.4
"""Length of the colour bar's label on one line."""
FONT_PT = 7.0
CIRCLE = "#ff00ff"
OUTSIDE_GREY = 0.82
SHOWN_SCORES = 8.0
DIRECTIONS = 16
"""Places round a circle at which its number may stand, tried at growing distance."""


@dataclass(frozen=True)
class DrawnMark:
    """A circle and its number, in the axes' units."""

    text: str
    u: float
    v: float
    radius: float


def save_picture(path: Path, cloud: Cloud, evidence: Evidence, detections: Sequence[Detection], title: str) -> None:
    """Write the PNG: colour image (where known) above the residual in mm; without a pixel grid a plan view in mm."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = 2 if cloud.organised and cloud.rgb is not None else 1
    left, right, bottom, top = _shown(cloud, evidence)
    across, down = max(right - left, 1e-9), max(bottom - top, 1e-9)
    height_in = min(panels * (WIDTH_IN * 0.82 * down / across + 0.5) + 0.4, 30.0)
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="compressed")
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=10, parse_math=False)  # a file may be called $x$
    axes = figure.subplots(panels, 1, squeeze=False)[:, 0]
    if panels == 2:
        axes[0].imshow(_colours(cloud), extent=_edges(cloud), interpolation="nearest")
    shown = _draw_residual(axes[-1], cloud, evidence)
    # a low picture has no room for the whole of it on one line
    label = "behind (+) or before (-) the fitted surface, mm"
    low = height_in * 0.6 < LABEL_IN
    bar = figure.colorbar(shown, ax=list(axes), shrink=1.0 if low else 0.6, extend="both")
    bar.set_label("behind (+) or\nbefore (-) the\nsurface, mm" if low else label, fontsize=8 if low else None)
    marks = _marks(cloud, detections)
    for axis in axes:
        unit = "cell" if cloud.projection == "parallel" else "px"
        axis.set_xlabel(f"u, {unit}" if cloud.organised else "x, mm", fontsize=8)
        axis.set_ylabel(f"v, {unit}" if cloud.organised else "y, mm", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", autoscale_on=False)
    canvas.draw()  # the layout is known only now, and with it what a letter measures in the axes' units
    for axis in axes:
        _draw_marks(axis, marks)
    figure.set_layout_engine("none")
    canvas.print_png(str(path))


def save_blind_map(path: Path, cloud: Cloud, missing: MissingReturns, detections: Sequence[Detection]) -> None:
    """Write the PNG: the share of the frames in which each pixel returned nothing (of a map, whether a cell was seen),
    the target's outline, and the numbered circles of findings without return."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    left, right, bottom, top = _around(cloud, missing.outline)
    height_in = min(WIDTH_IN * 0.82 * (bottom - top) / (right - left) + 0.9, 30.0)
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="compressed")
    canvas = FigureCanvasAgg(figure)
    unit = "cell" if cloud.projection == "parallel" else "px"
    figure.suptitle(f"{100 * missing.blind:.2g} % of the target's pixels returned nothing", fontsize=10)
    axis = figure.subplots()
    shown = axis.imshow(
        100 * missing.unseen, extent=_edges(cloud), interpolation="nearest", cmap="Greys", vmin=0, vmax=100
    )
    figure.colorbar(shown, ax=axis, shrink=0.6).set_label("frames without a return, %", fontsize=8)
    rows, columns = (
        np.arange(n) + first
        for n, first in zip(missing.outline.shape, (cloud.region.row0, cloud.region.col0), strict=True)
    )
    if min(missing.outline.shape) > 1 and not missing.outline.all():
        axis.contour(columns, rows, missing.outline, levels=[0.5], colors="#0070c0", linewidths=0.8)
    axis.set(xlabel=f"u, {unit}", ylabel=f"v, {unit}", xlim=(left, right), ylim=(bottom, top), aspect="equal")
    canvas.draw()
    marks = (m for m, one in zip(_marks(cloud, detections), detections, strict=True) if one.kind == "no return")
    _draw_marks(axis, tuple(marks))
    figure.set_layout_engine("none")
    canvas.print_png(str(path))


def _shown(cloud: Cloud, evidence: Evidence) -> tuple[float, float, float, float]:
    """(left, right, bottom, top) of the axes: what was judged and a twelfth of it around, within the picture."""
    return _around(cloud, np.isfinite(evidence.residual_m))


def _around(cloud: Cloud, part: np.ndarray) -> tuple[float, float, float, float]:
    """Return the same of a part (h, w) bool of the cloud's grid."""
    left, right, bottom, top = _edges(cloud)
    rows, columns = np.nonzero(part)
    if not cloud.organised or not len(rows):
        return left, right, bottom, top
    region = cloud.region
    u0, u1, v0, v1 = (float(n) for n in (columns.min(), columns.max() + 1, rows.min(), rows.max() + 1))
    margin = max(u1 - u0, v1 - v0) / 12.0
    return (
        max(left, region.col0 + u0 - 0.5 - margin),
        min(right, region.col0 + u1 - 0.5 + margin),
        min(bottom, region.row0 + v1 - 0.5 + margin),
        max(top, region.row0 + v0 - 0.5 - margin),
    )


def _edges(cloud: Cloud) -> tuple[float, float, float, float]:
    """(left, right, bottom, top) of the axes: sensor pixels, or millimetres without a grid; down is positive."""
    if cloud.organised:
        region = cloud.region
        return region.col0 - 0.5, region.col1 - 0.5, region.row1 - 0.5, region.row0 - 0.5
    x, y = (cloud.points_m[..., axis][cloud.valid] / MM for axis in (0, 1))
    return float(x.min()), float(x.max()), float(y.max()), float(y.min())


def _colours(cloud: Cloud) -> np.ndarray:
    return np.clip(np.nan_to_num(np.asarray(cloud.rgb)), 0, 255).astype(np.uint8)


def _draw_residual(axis: Axes, cloud: Cloud, evidence: Evidence) -> Any:
    """The residual in mm, to `SHOWN_SCORES` units of score; beyond them the colour no longer changes."""
    residual_mm = evidence.residual_m / MM
    limit = SHOWN_SCORES * evidence.scale_m / MM
    style: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    axis.set_facecolor(str(OUTSIDE_GREY))
    if cloud.organised:
        return axis.imshow(residual_mm, extent=_edges(cloud), interpolation="nearest", **style)
    judged = np.isfinite(residual_mm)
    x, y = (cloud.points_m[..., k][judged] / MM for k in (0, 1))
    return axis.scatter(x, y, c=residual_mm[judged], s=2, linewidths=0, **style)


def _marks(cloud: Cloud, detections: Sequence[Detection]) -> tuple[DrawnMark, ...]:
    """One circle round each cluster."""
    marks = []
    for number, detection in enumerate(detections, start=1):
        if cloud.organised:
            rows, columns = np.unravel_index(detection.pixels, cloud.valid.shape)
            u, v, margin = columns + cloud.region.col0, rows + cloud.region.row0, 3.0
        else:
            points = cloud.points_m.reshape(-1, 3)[detection.pixels] / MM
            u, v, margin = points[:, 0], points[:, 1], 2.0
        centre = 0.5 * (u.min() + u.max()), 0.5 * (v.min() + v.max())
        radius = 0.5 * float(max(np.ptp(u), np.ptp(v))) + margin
        marks.append(DrawnMark(str(number), float(centre[0]), float(centre[1]), radius))
    return tuple(marks)


def _draw_marks(axis: Axes, marks: Sequence[DrawnMark]) -> None:
    from matplotlib.patches import Circle

    width, height = _letter(axis)
    for mark, (x, y) in zip(marks, label_places(marks, width, height, _limits(axis)), strict=True):
        axis.add_patch(Circle((mark.u, mark.v), mark.radius, fill=False, color=CIRCLE, linewidth=0.9))
        if np.hypot(x - mark.u, y - mark.v) > mark.radius + 1.5 * height:
            axis.plot([mark.u, x], [mark.v, y], color=CIRCLE, linewidth=0.4)
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.4}
        axis.text(x, y, mark.text, fontsize=FONT_PT, ha="center", va="center", color="black", bbox=box, clip_on=True)


def _letter(axis: Axes) -> tuple[float, float]:
    """Width and height of one digit with its margin, in the axes' units."""
    box = axis.get_window_extent()
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    per_unit = box.width / abs(right - left), box.height / abs(top - bottom)
    height_px = FONT_PT * DPI / 72.0
    # A digit of the default font is 0.64 em wide; a fifth of an em of margin each way.
    return 0.68 * height_px / per_unit[0], 1.4 * height_px / per_unit[1]


def _limits(axis: Axes) -> tuple[float, float, float, float]:
    (left, right), (bottom, top) = sorted(axis.get_xlim()), sorted(axis.get_ylim())
    return left, right, bottom, top


def label_places(
    marks: Sequence[DrawnMark], digit_width: float, height: float, limits: tuple[float, float, float, float]
) -> list[tuple[float, float]]:
    """A centre for each mark's number, so that no number covers another or a small circle, within the limits.

    Greedy: the nearest free place round its own circle, in the marks' order. Where the picture is too full, the last
    place tried.
    """
    left, right, low, high = limits
    taken = [_box(m.u, m.v, 2 * m.radius, 2 * m.radius) for m in marks if m.radius < 5 * height]
    places = []
    for mark in marks:
        width = digit_width * (len(mark.text) + 0.6)
        for x, y in _candidates(mark, width, height):
            box = _box(x, y, width, height)
            inside = left <= box[0] and box[1] <= right and low <= box[2] and box[3] <= high
            if inside and not any(_overlap(box, other) for other in taken):
                break
        taken.append(_box(x, y, width, height))
        places.append((x, y))
    return places


def _candidates(mark: DrawnMark, width: float, height: float) -> list[tuple[float, float]]:
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS - np.pi / 4
    # Large circles are labelled on their rim first: beyond it the number would lie far from what it names.
    gaps = [0.6 * height * step for step in range(1, 40)]
    reach = mark.radius + np.array(gaps)
    places = [(mark.u + (r + 0.4 * width) * np.cos(a), mark.v + r * np.sin(a)) for r in reach for a in angles]
    return [*places, (mark.u, mark.v)]


def _box(x: float, y: float, width: float, height: float) -> tuple[float, float, float, float]:
    return x - width / 2, x + width / 2, y - height / 2, y + height / 2


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[1] and b[0] < a[1] and a[2] < b[3] and b[2] < a[3]
