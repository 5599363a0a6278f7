"""The page of the user's camera, which compares measured figures with those simulated from its
camera file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.intervals import UNKNOWN
from harness.programs.camera.measure import Characteristics
from harness.programs.camera.tables import OWN_CURVES, OWN_FIGURES, OwnFigure
from harness.records.schema import Estimate, write_table
from harness.report.blocks import (
    BLUE,
    GREY,
    ORANGE,
    command_of,
    figure,
    heading,
    page,
    paragraph,
    svg,
)
from harness.vocabulary.files import write_json, write_text
from harness.vocabulary.geometry import MM
from harness.vocabulary.provenance import RESULTS_VERSION, record
from harness.vocabulary.text import show

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEASURED = "measured"
SIMULATED = "simulated"
KNOWN = "known camera"
LOOKS = {MEASURED: (BLUE, "o"), SIMULATED: (ORANGE, "x"), KNOWN: (GREY, "+")}
RANGE = f"noise, mm against {'range, m'}"
ANGLE = f"noise, mm against {'angle, deg'}"
AMPLITUDE = f"noise, mm against {'amplitude'}"
NEIGHBOURS = f"correlation of {'noise'} against pixels apart"
PATTERN = f"correlation of {'fixed pattern'} against pixels apart"
SPECTRUM = f"spectrum of {'noise'} against cycles per pixel"
OF_PATTERN = f"spectrum of {'fixed pattern'} against cycles per pixel"
FRAMES = "displacement, mm against frame"
DROPPED = "share without return against amplitude"
SHOWN = (RANGE, ANGLE, AMPLITUDE, NEIGHBOURS, PATTERN, SPECTRUM, OF_PATTERN, FRAMES, DROPPED)
FREQUENCIES = np.linspace(0, 0.5, 41)
SHOWN_LAGS = (1, 2, 3, 5)
SHOWN_PATTERN_LAGS = (1, 3, 5, 10)
CAPTION = (
    "The surfaces that were found; temporal noise against range, angle and amplitude (a dot "
    "stands for pixels with similar values of all three); correlation of noise and of fixed "
    "pattern along x and y, and their spectra (1 for white noise); displacement of whole frames; "
    "dropouts. Orange is the simulation from the camera file."
)
FigureRow = tuple[str, str, str, float, str]  # name, place, unit, value and meaning of a figure


def own_figures(measured: Characteristics) -> Iterator[FigureRow]:
    """Yield the figures of each surface and of the camera; all sources give the same figures in
    the same order."""
    for face in measured.surfaces:
        relief = "includes the surface's own shape and the lens's error"
        yield (
            "temporal noise",
            face.where,
            "mm",
            face.temporal.value,
            "standard deviation of a pixel's z over frames",
        )
        forms = (
            (
                "plane-fit rms, one frame",
                face.frame_rms_mm,
                "spatial noise of points about their own plane",
            ),
            (
                "plane-fit rms, average",
                face.average_rms_mm,
                "the same for the average of all frames",
            ),
            (
                "flat-form dispersion, 95 %",
                face.form95_mm,
                "layer with 95 % of the points, as in ISO 10360-13",
            ),
            (
                "flatness, 99.7 %",
                face.form997_mm,
                "layer with 99.7 % of the points, as in VDI/VDE 2634-2",
            ),
        )
        for name, value, meaning in forms:
            yield name, face.where, "mm", value, f"{meaning}; {relief}"
        yield (
            "fill rate",
            face.where,
            "1",
            face.fill_rate,
            "share of pixels and frames with a return",
        )
    yield from shared_figures(measured)


def shared_figures(measured: Characteristics) -> Iterator[FigureRow]:
    """Yield the figures that do not belong to a single surface."""
    for axis, name in enumerate("xy"):
        for lag in SHOWN_LAGS:
            pattern_correlation = float(measured.correlation[axis, lag])
            yield (
                "noise correlation",
                f"{name}, lag {lag}",
                "1",
                pattern_correlation,
                "correlation of neighbours' noise",
            )
        power = np.cumsum(density_of(measured.correlation[axis]))
        half = float(np.interp(0.5 * power[-1], power, FREQUENCIES))
        yield (
            "noise spectrum",
            f"along {name}",
            "1/px",
            half,
            "frequency below which half of its power lies",
        )
    yield (
        "frame jitter",
        "all",
        "mm",
        measured.jitter_m / MM,
        "standard deviation of frames' displacement",
    )
    for capture in measured.captures:
        yield (
            "drift",
            capture.name,
            "mm",
            capture.drift_m / MM,
            "change of the distance from first to last frame",
        )
    yield "rounding step", "all", "mm", measured.captures[0].step_m / MM, "step of the stored z"
    share = len(measured.jumps_m) / measured.frames
    yield "displaced frames", "all", "1", share, "share of frames that are displaced as a whole"
    if measured.pattern is not None:
        rms_mm = measured.pattern.field.rms_m / MM
        yield (
            "fixed pattern",
            "all",
            "mm",
            rms_mm,
            "error of range that all frames share, minus a smooth fit",
        )
    if measured.pattern_correlation is not None:
        for axis, name in enumerate("xy"):
            for lag in SHOWN_PATTERN_LAGS:
                pattern_correlation = float(measured.pattern_correlation[axis, lag])
                yield (
                    "pattern correlation",
                    f"{name}, lag {lag}",
                    "1",
                    pattern_correlation,
                    "correlation of the pattern",
                )
    if measured.edge is not None:
        where = "steps of depth"
        yield (
            "gap at an edge",
            where,
            "px",
            measured.edge.gap_px,
            "pixels without a return across an edge",
        )
        yield (
            "flying pixels",
            where,
            "px",
            measured.edge.flying_px,
            "pixels with a range on neither surface",
        )


def beside(
    captured: Characteristics, twin: Characteristics, nearest_known: Characteristics | None
) -> list[OwnFigure]:
    """Return each figure of the captures with those of the simulations; surfaces are matched by
    their numbers."""
    sources = (captured, twin, nearest_known)
    positions = [
        {face.where: (face.capture, face.number) for face in source.surfaces} if source else {}
        for source in sources
    ]
    values = [
        {(row[0], position.get(row[1], row[1])): row[3] for row in own_figures(source)}
        if source
        else {}
        for source, position in zip(sources, positions, strict=True)
    ]
    ends = {("temporal noise", face.where): face.temporal.interval for face in captured.surfaces}
    rows = []
    for name, where, unit, value, meaning in own_figures(captured):
        key = name, positions[0].get(where, where)
        simulated, of_known = (value_of.get(key, float("nan")) for value_of in values[1:])
        interval = ends.get((name, where), UNKNOWN)
        measured = Estimate(value, interval.low, interval.high)
        rows.append(OwnFigure(name, where, unit, measured, simulated, of_known, meaning))
    return rows


def write_page(
    path: Path,
    sources: Mapping[str, Characteristics],
    rows: list[OwnFigure],
    title: str,
    answer: str,
    known_title: str,
    command: str,
    facts: Mapping[str, Any],
    warnings: Sequence[str],
) -> None:
    """Print the figures; write a page, its tables and provenance.json with further ``facts``.
    ``sources`` are measured, simulated, and perhaps those of the ``known`` camera. Raises
    UserError if they cannot be written."""
    measured = sources[MEASURED]
    folder = path.parent
    heads = {"known camera": known_title, "its ratio": known_title and "its ratio"}
    show([OWN_FIGURES.grid(rows, terminal=True, heads=heads)])
    print(answer)
    write_table(folder, OWN_FIGURES, OWN_FIGURES.frame(rows))
    curves = [row for source, figures in sources.items() for row in _curves(source, figures)]
    write_table(folder, OWN_CURVES, OWN_CURVES.frame(curves))
    drawn = svg("captures", (8.6, 15.5), title, lambda canvas: _draw(canvas, measured, curves))
    notes = (
        "The simulated frames show the same surfaces, with the smooth shape of the captures, by "
        "the camera file; they are analysed like the captures. A ratio of 1 means that the file "
        "reproduces the camera."
    )
    body = [
        figure({"captures": drawn}, "captures", CAPTION),
        heading("Measured and simulated"),
        paragraph(notes),
    ]
    body += [OWN_FIGURES.grid(rows, heads=heads).html(), *command_of(command)]
    write_text(path, page(title, answer, body, warnings=warnings))
    origin = {"results_version": RESULTS_VERSION, **record(command), **facts, "warnings": warnings}
    write_json(folder / "provenance.json", origin)
    print(f"wrote {path} and the tables")


def _curves(source: str, measured: Characteristics) -> Iterator[dict[str, Any]]:
    """Yield the points of all diagrams for a source."""

    def point(diagram: str, series: str, x: float, y: float) -> dict[str, Any]:
        return {"diagram": diagram, "source": source, "series": series, "x": x, "y": y}

    for cell in measured.cells:
        for diagram, x in (
            (RANGE, cell.range_m),
            (ANGLE, cell.angle_deg),
            (AMPLITUDE, cell.amplitude),
        ):
            if np.isfinite(x):
                yield point(diagram, cell.capture, x, cell.sigma_m / MM)
    pairs = (
        (NEIGHBOURS, SPECTRUM, measured.correlation),
        (PATTERN, OF_PATTERN, measured.pattern_correlation),
    )
    for diagram, spectrum, correlations in pairs:
        for axis, along in zip("xy", [] if correlations is None else correlations, strict=False):
            yield from (
                point(diagram, axis, *lag_and_value) for lag_and_value in enumerate(along.tolist())
            )
            yield from (
                point(spectrum, axis, *frequency_and_density)
                for frequency_and_density in zip(FREQUENCIES, density_of(along), strict=True)
            )
    for capture in measured.captures:
        yield from (
            point(FRAMES, capture.name, k, off / MM)
            for k, off in enumerate(capture.offsets_m.tolist())
        )
    for level, share in zip(
        measured.dropouts.amplitude.tolist(), measured.dropouts.share.tolist(), strict=True
    ):
        if np.isfinite(level):
            yield point(DROPPED, "all", level, share)


def density_of(correlation: np.ndarray) -> np.ndarray:
    """Return the spectral density at `FREQUENCIES` along an axis, relative to white noise of the
    same variance, from the correlation (lags,) with Parzen's window (Blackman and Tukey)."""
    from scipy.signal.windows import parzen  # whose package takes a third of a second to load

    faded = correlation * parzen(2 * len(correlation) - 1)[len(correlation) - 1 :]
    return np.asarray(
        2 * np.cos(2 * np.pi * np.outer(FREQUENCIES, np.arange(len(faded)))) @ faded - faded[0]
    )


def _draw(canvas: Figure, measured: Characteristics, curves: list[dict[str, Any]]) -> None:
    axes = canvas.subplots(5, 2).ravel()
    first = measured.captures[0]
    labels = np.full(first.stretch.shape, np.nan)
    for number, (_, mask) in enumerate(first.planes):
        labels[mask] = number
    axes[0].imshow(first.mean_m, cmap="gray_r")
    axes[0].imshow(labels, cmap="tab10", vmin=0, vmax=9, alpha=0.5, interpolation="nearest")
    axes[0].set(title=f"{len(first.planes)} flat surfaces, {first.name[:24]}", xticks=[], yticks=[])
    for axis, diagram in zip(axes[1:], SHOWN, strict=True):
        diagram_rows = [row for row in curves if row["diagram"] == diagram]
        for source, (colour, marker) in LOOKS.items():
            points = [(row["x"], row["y"]) for row in diagram_rows if row["source"] == source]
            if points and not (diagram == FRAMES and source != MEASURED):
                axis.plot(
                    *zip(*points, strict=True), marker, color=colour, markersize=4, label=source
                )
        x, y = diagram.split(" against ")[::-1]
        axis.set(
            xlabel=x, ylabel=y, yscale="log" if diagram in (SPECTRUM, OF_PATTERN) else "linear"
        )
        if not diagram_rows:
            axis.text(
                0.5,
                0.5,
                "not determined by the captures",
                transform=axis.transAxes,
                ha="center",
                color=GREY,
            )
    axes[1].legend(fontsize=8)
    axes[1].set(ylim=(0, None))
