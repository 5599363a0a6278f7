"""The comparison with a capture as text, CSV and a page."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.report import canvas
from harness.report.blocks import template
from harness.scorecard.capture import Beside, Captured, Twin
from harness.scorecard.page import told
from harness.scorecard.plots import COLOURS
from harness.scorecard.tables import interval, number
from harness.vocabulary.units import MM
from harness.vocabulary.versions import RESULTS_VERSION

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

HEADS = ("where", "quantity", "at", "pixels", "measured", "95 %", "simulated", "95 %", "ratio", "unit")


def cells(row: Beside) -> tuple[str, ...]:
    """One comparison as texts under `HEADS`."""
    ratio = f"{row.ratio:.2f}" if np.isfinite(row.ratio) else "–"
    return (
        row.where,
        row.quantity,
        row.at,
        str(row.pixels),
        number(row.measured.value),
        interval(row.measured.interval),
        number(row.simulated.value),
        interval(row.simulated.interval),
        ratio,
        row.unit or "–",
    )


def plain_rows(rows: Sequence[Beside]) -> str:
    """All comparisons as aligned lines."""
    lines = [HEADS, *(cells(row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(HEADS))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def capture_csv(rows: Sequence[Beside]) -> str:
    """All comparisons with numbers at full precision; empty where unknown."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    names = "where quantity at unit pixels measured measured_low measured_high simulated simulated_low simulated_high"
    writer.writerow([*names.split(), "results_version"])
    for row in rows:
        values = [
            value
            for estimate in (row.measured, row.simulated)
            for value in (estimate.value, estimate.interval.low, estimate.interval.high)
        ]
        texts = ["" if np.isnan(value) else f"{value:.9g}" for value in values]
        writer.writerow([row.where, row.quantity, row.at, row.unit, row.pixels, *texts, RESULTS_VERSION])
    return buffer.getvalue()


def capture_html(captured: Captured, twin: Twin, rows: Sequence[Beside], provenance: Mapping[str, Any]) -> str:
    """The page as text."""
    return template("capture.html", Path(__file__).parent).render(
        name=captured.name,
        camera=twin.camera.title,
        frames=len(captured.z_m),
        albedo=f"{twin.albedo:g}",
        answer=_answer(rows),
        heads=HEADS,
        rows=[cells(row) for row in rows],
        figure=_figure(captured, rows),
        edges=any("edge" in row.where for row in rows),
        provenance=told(provenance),
    )


def _answer(rows: Sequence[Beside]) -> str:
    """The ratios of temporal deviation over whole planes in one sentence."""
    whole = [row for row in rows if row.quantity == "temporal deviation" and row.at == "all"]
    if not whole:
        return "The simulation sees none of the planes of this capture."
    ratios = ", ".join(f"{row.ratio:.2f} ({row.where})" for row in whole)
    return f"Temporal deviation, simulated by measured: {ratios}."


def _figure(captured: Captured, rows: Sequence[Beside]) -> str:
    """Which planes were found, temporal deviation against range, and the noise's correlation."""

    def draw(figure: Canvas) -> None:
        left, middle, right = figure.subplots(1, 3)
        _draw_planes(left, captured)
        names = list(dict.fromkeys(row.where for row in rows if row.where.startswith("plane")))
        for number_, name in enumerate(names):
            colour = COLOURS[number_ % len(COLOURS)]
            own = [row for row in rows if row.where == name]
            _draw_sigma(middle, [r for r in own if r.quantity == "temporal deviation" and r.at != "all"], colour, name)
            _draw_correlation(right, [row for row in own if row.quantity == "noise correlation"], colour)
        middle.set(title="temporal deviation", xlabel="z (m)", ylabel="deviation (mm)", ylim=(0, None))
        right.set(title="correlation, along x", xlabel="lag (pixels)", ylabel="correlation of the noise")
        right.axhline(0, color=canvas.GREY, linewidth=0.8)
        handles, labels = middle.get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside upper right", ncols=len(handles), columnspacing=1.4)

    return canvas.svg("capture", (12.0, 4.2), "Planes found, temporal deviation and correlation", draw)


def _draw_planes(axis: Axes, captured: Captured) -> None:
    """The median depth, with each plane's pixels in its colour."""
    from matplotlib.colors import to_rgb

    shade = np.nan_to_num(captured.median_m, nan=np.nan)
    low, high = np.nanpercentile(shade, [2, 98])
    grey = np.nan_to_num(np.clip((high - shade) / max(high - low, MM), 0, 1) * 0.5 + 0.45, nan=0.05)
    picture = np.repeat(grey[..., None], 3, axis=-1)
    for number_, found in enumerate(captured.planes):
        tint = np.array(to_rgb(COLOURS[number_ % len(COLOURS)]))
        picture[found.mask] = 0.45 * picture[found.mask] + 0.55 * tint
    axis.imshow(picture)
    axis.set(title="planes found", xticks=[], yticks=[])
    axis.grid(False)


def _draw_sigma(axis: Axes, rows: Sequence[Beside], colour: str, name: str) -> None:
    at = [float(row.at.split(" ")[0]) + 0.05 for row in rows]
    for which, marker, dash in (("measured", "o", "-"), ("simulated", "s", "--")):
        values = np.array([getattr(row, which).value for row in rows])
        ends = np.array([[getattr(row, which).interval.low, getattr(row, which).interval.high] for row in rows])
        errors = np.nan_to_num(np.abs(ends.reshape(-1, 2).T - values))
        label = f"{name}, {which}"
        axis.errorbar(at, values, yerr=errors, color=colour, marker=marker, markersize=4, linestyle=dash, label=label)


def _draw_correlation(axis: Axes, rows: Sequence[Beside], colour: str) -> None:
    own = [row for row in rows if row.at.startswith("x")]
    lags = [int(row.at.split(" ")[-1]) for row in own]
    axis.plot(lags, [row.measured.value for row in own], color=colour, marker="o", markersize=4)
    axis.plot(lags, [row.simulated.value for row in own], color=colour, marker="s", markersize=4, linestyle="--")
