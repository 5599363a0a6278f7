"""The drilling template of a gauge board at a scale of 1:1: tiles of a paper size (PDF) and a
whole drawing (SVG)."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.report.blocks import GREY, INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MM_PER_INCH = 25.4
PAPER_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4)}
MARGIN_MM = 10.0  # unprinted margin of a sheet
FOOT_MM = 12.0  # height of the line with the scale bar
OVERLAP_MM = 10.0  # overlap of neighbouring tiles
SCALE_MM = 100.0  # length of the scale bar


def tiles_of(
    width_mm: float, height_mm: float, paper: str
) -> tuple[tuple[float, float], list[tuple[float, float]]]:
    """Return the sheet's size (width, height) in mm, in the orientation that takes fewer sheets,
    and the point of the board (x, y from its lower left) at the lower left of each sheet's printed
    area, row by row from the top."""
    best: tuple[tuple[float, float], list[tuple[float, float]]] | None = None
    for sheet in (PAPER_MM[paper], PAPER_MM[paper][::-1]):
        room = (sheet[0] - 2 * MARGIN_MM, sheet[1] - 2 * MARGIN_MM - FOOT_MM)
        axes_of_tiles = []
        for size, has in zip((width_mm, height_mm), room, strict=True):
            count = max(1, int(np.ceil((size - OVERLAP_MM) / (has - OVERLAP_MM))))
            # the board lies in the middle of all sheets
            beside = (count * (has - OVERLAP_MM) + OVERLAP_MM - size) / 2
            axes_of_tiles.append([k * (has - OVERLAP_MM) - beside for k in range(count)])
        xs, ys = axes_of_tiles
        corners = [(x, y) for y in reversed(ys) for x in xs]
        if best is None or len(corners) < len(best[1]):
            best = (sheet, corners)
    assert best is not None
    return best


def draw_board(axes: Axes, board: Any, dictionary: str) -> None:
    """Draw a `GaugeBoard` in millimetres about its centre: outline, coded marks, holes with centre
    marks, and names."""
    from matplotlib.patches import Circle, Rectangle

    corner = (-board.width_mm / 2, -board.height_mm / 2)
    axes.add_patch(Rectangle(corner, board.width_mm, board.height_mm, fill=False, ec=INK, lw=0.6))
    draw_marks(axes, board.marks, dictionary)
    for hole in board.holes:
        x = hole.x_mm
        y = hole.y_mm
        reach = hole.diameter_mm / 2 + 2
        axes.add_patch(Circle((x, y), hole.diameter_mm / 2, fill=False, ec=INK, lw=0.4))
        axes.plot([x - reach, x + reach], [y, y], color=INK, lw=0.3)
        axes.plot([x, x], [y - reach, y + reach], color=INK, lw=0.3)
        deep = "" if hole.depth_mm is None else f", {hole.depth_mm:g} deep"
        text = f"{hole.id}: Ø {hole.diameter_mm:g}{deep}"
        style: dict[str, Any] = {"ha": "center", "va": "top", "fontsize": 5.5, "color": INK}
        axes.annotate(text, (x, y - reach - 0.5), **style)


def draw_marks(axes: Axes, marks: Any, dictionary: str) -> None:
    """Draw coded marks with a code, a centre and a side in millimetres."""
    import cv2
    from matplotlib.patches import Rectangle

    marker_codes = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    for mark in marks:
        modules = marker_codes.markerSize + 2
        picture = cv2.aruco.generateImageMarker(marker_codes, mark.code, modules)
        step = mark.side_mm / modules
        for row, column in np.argwhere(picture == 0).tolist():
            corner = (
                mark.x_mm - mark.side_mm / 2 + column * step,
                mark.y_mm + mark.side_mm / 2 - (row + 1) * step,
            )
            # without edges, hairlines would show between neighbouring modules
            axes.add_patch(Rectangle(corner, step, step, fc="black", ec="black", lw=0.1))


def template_svg(board: Any, dictionary: str) -> bytes:
    """Return a board as a drawing of the same size."""
    wide = board.width_mm + 2
    high = board.height_mm + 2
    figure, axes = sheet((-wide / 2, -high / 2, wide, high), board.name)
    draw_board(axes, board, dictionary)
    return svg_of(figure)


def svg_of(figure: Figure) -> bytes:
    """Return a figure as SVG text without a date."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def template_pdf(boards: Any, dictionary: str, paper: str) -> bytes:
    """Return all boards with one tile per sheet; each sheet has a scale bar and the place of its
    tile."""
    from matplotlib.backends.backend_pdf import PdfPages

    buffer = io.BytesIO()
    with PdfPages(buffer, metadata={"CreationDate": None}) as pages:
        for board in boards:
            (sheet_wide, sheet_high), tile_corners = tiles_of(
                board.width_mm, board.height_mm, paper
            )
            wide = sheet_wide - 2 * MARGIN_MM
            high = sheet_high - 2 * MARGIN_MM - FOOT_MM
            for number, (x, y) in enumerate(tile_corners, start=1):
                left_mm = x - board.width_mm / 2
                low = y - board.height_mm / 2
                sheet_mm = (left_mm - MARGIN_MM, low - MARGIN_MM - FOOT_MM, sheet_wide, sheet_high)
                figure, axes = sheet(sheet_mm, board.name)
                draw_board(axes, board, dictionary)
                title = f"{board.name}, tile {number} of {len(tile_corners)}: print at 100 %"
                _frame(axes, (left_mm, low, wide, high), title)
                pages.savefig(figure)
    return buffer.getvalue()


def _frame(axes: Axes, box_mm: tuple[float, float, float, float], title: str) -> None:
    """Clip what lies beyond a tile, and draw its crop marks, scale bar and name."""
    from matplotlib.patches import Rectangle

    left_mm, low, wide, high = box_mm
    clip = Rectangle((left_mm - 0.5, low - 0.5), wide + 1, high + 1, transform=axes.transData)
    for artist in (*axes.patches, *axes.lines, *axes.texts):
        artist.set_clip_path(clip)
        artist.set_clip_on(True)
    for x in (left_mm, left_mm + wide):
        for y in (low, low + high):
            axes.plot([x - 4, x + 4], [y, y], color=GREY, lw=0.4)
            axes.plot([x, x], [y - 4, y + 4], color=GREY, lw=0.4)
    bar = low - FOOT_MM + 3
    axes.plot([left_mm, left_mm + SCALE_MM], [bar, bar], color=INK, lw=0.8)
    for tick in np.arange(0, SCALE_MM + 1, 10):
        axes.plot([left_mm + tick] * 2, [bar, bar + 2], color=INK, lw=0.5)
    text = f"{SCALE_MM:g} mm   {title}"
    axes.annotate(text, (left_mm + SCALE_MM + 3, bar), fontsize=7, color=INK, va="center")


def sheet(view_mm: tuple[float, float, float, float], name: str) -> tuple[Figure, Axes]:
    """Return a figure that shows a box (left, low, width, height) in mm at a scale of 1:1; its
    axes fill it."""
    from matplotlib import rcParams
    from matplotlib.figure import Figure

    rcParams["svg.hashsalt"] = name
    left_mm, low, wide, high = view_mm
    figure = Figure(figsize=(wide / MM_PER_INCH, high / MM_PER_INCH))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set(xlim=(left_mm, left_mm + wide), ylim=(low, low + high))
    return figure, axes
