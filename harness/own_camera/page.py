"""The page of one's own camera: what its captures show beside what its camera file simulates, with the data files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.own_camera.measure import Characteristics
from harness.report.blocks import BLUE, COLOURS, GREY, ORANGE, RED, command_of, figure, heading, page, paragraph, svg
from harness.scorecard.bench import Reading
from harness.tables.characteristics import (
    CORRELATIONS,
    DROPOUTS,
    NOISE_CELLS,
    OWN_FIGURES,
    OWN_FRAMES,
    OwnFigure,
)
from harness.tables.schema import Estimate, write_table
from harness.vocabulary.files import write_text
from harness.vocabulary.geometry import MM

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEASURED, SIMULATED, KNOWN = "measured", "simulated", "known camera"
LOOKS = {MEASURED: (BLUE, "o"), SIMULATED: (ORANGE, "x"), KNOWN: (GREY, "+")}
SHOWN_LAGS, SHOWN_PATTERN_LAGS = (1, 2, 3, 5), (1, 3, 5, 10)
CAPTION = (
    "Upper row: the surfaces that were found; temporal noise against range, the dots in cells of like angle and "
    "brightness; its correlation between neighbours. Lower row: displacement of whole frames; dropouts against "
    "amplitude; correlation of the fixed pattern. The camera file's simulation is orange."
)


def own_figures(found: Characteristics) -> Iterator[tuple[str, str, str, Reading, str]]:
    """Yield name, place, unit, value and meaning of each figure; the same of every source, in the same order."""
    for one in found.surfaces:
        relief = "the surface's own shape and the lens' error included, which no simulation has"
        yield "temporal noise", one.where, "mm", one.temporal, "deviation of single pixels over frames, of z"
        for name, value, meaning in (
            ("plane-fit rms, one frame", one.frame_rms_mm, f"spatial noise of points about their own plane; {relief}"),
            ("plane-fit rms, average", one.average_rms_mm, f"the same of the average of all frames; {relief}"),
            ("form, 95 %", one.form95_mm, f"width that 95 % of one frame's points need; {relief}"),
        ):
            yield name, one.where, "mm", Reading(value), meaning
        yield "fill rate", one.where, "1", Reading(one.fill_rate), "share of pixels and frames with a return"
    for axis, name in enumerate("xy"):
        for lag in SHOWN_LAGS:
            alike = Reading(float(found.correlation[axis, lag]))
            yield "noise correlation", f"{name}, lag {lag}", "1", alike, "of neighbours' temporal noise"
    yield "frame jitter", "all", "mm", Reading(found.jitter_m / MM), "deviation of whole frames' displacement"
    share = Reading(found.jumped / found.frames)
    yield "displaced frames", "all", "1", share, "share of frames that are displaced as a whole"
    if found.pattern is not None and found.pattern_correlation is not None:
        rms = Reading(found.pattern.field.rms_m / MM)
        yield "fixed pattern", "all", "mm", rms, "error of range that all frames share, less a smooth fit"
        for axis, name in enumerate("xy"):
            for lag in SHOWN_PATTERN_LAGS:
                alike = Reading(float(found.pattern_correlation[axis, lag]))
                yield "pattern correlation", f"{name}, lag {lag}", "1", alike, "of neighbours' fixed pattern"
    if found.edge is not None:
        where = "steps of depth"
        yield "gap at an edge", where, "px", Reading(found.edge.gap_px), "pixels without a return across an edge"
        yield "flying pixels", where, "px", Reading(found.edge.flying_px), "pixels with a range on neither surface"


def beside(found: Characteristics, twin: Characteristics, known: Characteristics | None) -> list[OwnFigure]:
    """Return each figure of the captures beside those of the simulations; surfaces go by their numbers."""
    every = (found, twin, known)
    places = [{one.where: (one.capture, one.number) for one in each.surfaces} if each else {} for each in every]
    values = [
        {(row[0], place.get(row[1], row[1])): row[3].value for row in own_figures(each)} if each else {}
        for each, place in zip(every, places, strict=True)
    ]
    rows = []
    for name, where, unit, value, meaning in own_figures(found):
        key = name, places[0].get(where, where)
        simulated, of_known = (value_of.get(key, float("nan")) for value_of in values[1:])
        measured = Estimate(value.value, value.interval.low, value.interval.high)
        rows.append(OwnFigure(name, where, unit, measured, simulated, of_known, meaning))
    return rows


def write_page(
    folder: Path,
    sources: Mapping[str, Characteristics],
    rows: list[OwnFigure],
    title: str,
    answer: str,
    known: str,
    command: str,
) -> None:
    """Write the tables' files and ``characterise.html`` into a folder. ``sources``: what was measured, simulated and,
    where there is one, the ``known`` camera's by their names. Raises UserError where the folder cannot be written."""
    found = sources[MEASURED]
    write_table(folder, OWN_FIGURES, OWN_FIGURES.frame(rows))
    write_table(folder, NOISE_CELLS, NOISE_CELLS.frame(_cells(sources)))
    write_table(folder, CORRELATIONS, CORRELATIONS.frame(_correlations(sources)))
    write_table(folder, OWN_FRAMES, OWN_FRAMES.frame(_frames(found)))
    drops = found.dropouts
    levels = zip(drops.amplitude, drops.share, drops.pixels, strict=True)
    steps = [dict(zip(("amplitude", "share", "pixels"), each, strict=True)) for each in levels]
    write_table(folder, DROPOUTS, DROPOUTS.frame(steps))
    drawn = svg("captures", (10.5, 6.4), title, lambda canvas: _draw(canvas, sources))
    heads = {"known camera": known, "its ratio": "its ratio" if known else ""}
    body = [
        figure({"captures": drawn}, "captures", CAPTION),
        heading("Measured and simulated"),
        paragraph(
            "The simulation is of the camera file, before the same surfaces as fitted planes, and is analysed like"
            " the captures. A ratio of 1 says that the file repeats the camera."
        ),
        OWN_FIGURES.grid(rows, heads=heads).html(),
        *command_of(command),
    ]
    write_text(folder / "characterise.html", page(title, answer, body, warnings=found.doubts()))


def _cells(sources: Mapping[str, Characteristics]) -> list[dict[str, Any]]:
    return [
        {"source": source, **vars(cell), "sigma_mm": cell.sigma_m / MM}
        for source, found in sources.items()
        for cell in found.cells
    ]


def _correlations(sources: Mapping[str, Characteristics]) -> list[dict[str, Any]]:
    return [
        {"source": source, "of": of, "axis": axis, "lag_px": lag, "correlation": value}
        for source, found in sources.items()
        for of, both in (("noise", found.correlation), ("fixed pattern", found.pattern_correlation))
        if both is not None
        for axis, along in zip("xy", both.tolist(), strict=True)
        for lag, value in enumerate(along)
    ]


def _frames(found: Characteristics) -> list[dict[str, Any]]:
    return [
        {"capture": capture.name, "frame": number, "displacement_mm": offset / MM, "kept": bool(kept)}
        for capture in found.captures
        for number, (offset, kept) in enumerate(zip(capture.offsets_m, capture.kept, strict=True))
    ]


def _draw(canvas: Figure, sources: Mapping[str, Characteristics]) -> None:
    from matplotlib.colors import to_rgb

    found = sources[MEASURED]
    axes = canvas.subplots(2, 3).ravel()
    largest = found.captures[0]
    low, high = np.nanpercentile(largest.mean_m, [2, 98])
    shade = np.clip((high - largest.mean_m) / max(high - low, MM), 0, 1) * 0.5 + 0.45
    picture = np.repeat(np.nan_to_num(shade, nan=0.05)[..., None], 3, axis=-1)
    for number, (_, mask) in enumerate(largest.planes):
        picture[mask] = 0.45 * picture[mask] + 0.55 * np.array(to_rgb(COLOURS[number % len(COLOURS)]))
    axes[0].imshow(picture)
    axes[0].set(title=f"{len(largest.planes)} flat surfaces, {largest.name[:24]}", xticks=[], yticks=[])
    for source, one in sources.items():
        colour, marker = LOOKS[source]
        points = [(cell.range_m, cell.sigma_m / MM) for cell in one.cells]
        axes[1].plot(*zip(*points, strict=True), marker, color=colour, markersize=4, label=source)
        axes[2].plot(one.correlation.mean(axis=0), marker + "-", color=colour, markersize=4)
        if one.pattern_correlation is not None:
            axes[5].plot(one.pattern_correlation.mean(axis=0), marker + "-", color=colour, markersize=4)
        if len(one.dropouts.amplitude) > 1:
            axes[4].semilogx(one.dropouts.amplitude, one.dropouts.share, marker + "-", color=colour, markersize=4)
    axes[1].set(title="Noise against range", xlabel="range, m", ylabel="temporal noise, mm", ylim=(0, None))
    axes[1].legend(fontsize=8)
    axes[2].set(title="Noise of neighbours", xlabel="pixels apart", ylabel="correlation")
    for capture in found.captures:
        numbers = np.arange(len(capture.offsets_m))
        axes[3].plot(numbers, capture.offsets_m / MM, color=BLUE, linewidth=0.8)
        axes[3].plot(numbers[~capture.kept], capture.offsets_m[~capture.kept] / MM, "x", color=RED)
    axes[3].set(title="Whole frames", xlabel="frame", ylabel="displacement, mm")
    axes[4].set(title="Dropouts", xlabel="amplitude", ylabel="share without return", ylim=(-0.02, 1.02))
    axes[5].set(title="Fixed pattern of neighbours", xlabel="pixels apart", ylabel="correlation")
    for axis, empty, words in (
        (axes[4], len(found.dropouts.amplitude) < 2, "one brightness only"),
        (axes[5], found.pattern_correlation is None, "no flat surface"),
    ):
        if empty:
            axis.text(0.5, 0.5, words, transform=axis.transAxes, ha="center", color=GREY)
