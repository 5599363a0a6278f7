"""Presents a model-assisted probability of detection: the simulated curve, real hits and misses,
and both combined."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.pod.statement import POD
from harness.programs.inspections.mapod import ENOUGH, FREEDOM, PRIOR_SIZE, PRIOR_WIDTH, Mapod
from harness.records.schema import Column, Table
from harness.report import blocks
from harness.report.blocks import BLUE, GREY, ORANGE, PURPLE, RED
from harness.report.pod import VALIDITY, draw_hits, hits_in_view, sized
from harness.vocabulary.text import Grid

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

SIZE_IN = (8.6, 5.2)
BOARDS = Table(
    "boards",
    "one row before any board, and one after each",
    (
        Column("", "after board", lambda row: row.board),
        Column("", "targets", lambda row: f"{row.targets}"),
        Column("", "hits", lambda row: f"{row.hits}"),
        Column("", "a50 (mm)", lambda row: sized(row.a50, "")),
        Column("", "a90 (mm)", lambda row: sized(row.a90, "")),
        Column("", "a90/95 (mm)", lambda row: sized(row.a90_95, "")),
        Column("", "stop", lambda row: "enough" if row.enough else "go on"),
    ),
    formats=(),
)


def answer(mapod: Mapod) -> str:
    """State in two sentences whether simulation and reality agree, and the limit to quote."""
    agrees = f"(p = {mapod.agrees:.2g})"
    first = f"The real hits and misses do not contradict the simulation {agrees}."
    if mapod.contradicted:
        first = (
            f"The real hits and misses contradict the simulation {agrees}: the larger of the two "
            "limits counts."
        )
    if not np.isfinite(mapod.a90_95):
        return f"{first} The real targets do not demonstrate a90/95, so no limit is stated."
    return (
        f"{first} A flaw of {sized(mapod.a90_95, 'mm')} is found 90 % of the time, with 95 % "
        "confidence (a90/95)."
    )


def sizes_grid(mapod: Mapod) -> Grid:
    """Return the table of simulated, measured and combined sizes."""
    last = mapod.steps[-1]
    rows = list[tuple[str, ...]]()
    for name, sizes in (("simulated", mapod.simulated), ("measured", mapod.measured)):
        if sizes is not None:
            bound = sized(sizes.bound.value, "") if sizes.bound.demonstrated else "not demonstrated"
            rows.append((name, sized(sizes.a50, ""), sized(sizes.a90, ""), bound, sizes.counts))
        else:
            rows.append((name, "-", "-", "not demonstrated", mapod.why))
    a50 = sized(last.a50, "")
    a90 = sized(last.a90, "")
    corrected = f"{mapod.set_up}, corrected by {last.targets} real targets"
    rows.append(("combined", a50, a90, sized(last.a90_95, ""), corrected))
    return Grid.of(("", "a50 (mm)", "a90 (mm)", "a90/95 (mm)", "from"), rows, left=1)


def notes(mapod: Mapod) -> list[str]:
    """Return sentences on the prior, the tests and the stopping rule."""
    lines = [
        "Transfer function: real damage of size k a is found as easily as simulated damage of "
        "size a, and the rise of the curve is w times as wide. Prior: ln k and ln w follow "
        f"Student's distribution about 0 with {FREEDOM:g} degrees of freedom and scales of a "
        f"factor {PRIOR_SIZE:g} in k and {PRIOR_WIDTH:g} in w, plus the simulated curve's own "
        "uncertainty; w is below 1 only within that uncertainty.",
        "Combined: medians of the posterior, and its 97.5 % quantile for a90/95 (for simulated "
        "and for measured hits alone, a90/95 is averaged over models); the largest "
        "over the models that fit the simulated hits about equally well. If the simulation is "
        "contradicted, the larger of combined and measured limit counts.",
        "If the simulated curve were right, hits and misses at least as far from it would occur "
        f"with probability {mapod.agrees:.2g}; a probability below 0.05 counts as a "
        "contradiction.",
        f"Stopping rule: stop when a90/95 is at most {ENOUGH:g} times a90. The rule was fixed "
        "before any board.",
    ]
    return [*lines, *mapod.read.notes, VALIDITY]


def doubts(mapod: Mapod) -> list[str]:
    """Return the reasons to doubt the combined limit."""
    texts = []
    if mapod.unlike:
        texts.append(f"{mapod.unlike}: a difference counts as an error of the simulation")
    if mapod.contradicted:
        texts.append("the real hits and misses contradict the simulation")
    return texts


def mapod_parts(mapod: Mapod) -> list[str | Grid]:
    """Return the parts for a terminal; reasons to doubt the limit come first."""
    shown: list[str | Grid] = [f"warning: {text}" for text in doubts(mapod)]
    shown += [
        sizes_grid(mapod),
        "",
        BOARDS.grid(mapod.steps),
        "",
        *(f"note: {text}" for text in notes(mapod)),
    ]
    return [*shown, "", answer(mapod)]


def mapod_html(mapod: Mapod, command: str) -> str:
    """Return the page as text; it needs no network."""
    caption = (
        "The simulated curve, the curve of the real hits (above) and misses (below) alone, and "
        "the combined curve with its 95 % credible band, the widest over all simulated models."
    )
    drawn = blocks.svg("mapod", SIZE_IN, answer(mapod), lambda figure: _draw(figure, mapod))
    body = [blocks.heading("Simulated, measured, combined"), sizes_grid(mapod).html()]
    body += [blocks.figure({"mapod": drawn}, "mapod", caption)]
    body += [blocks.heading("After each board"), BOARDS.grid(mapod.steps).html()]
    body += [blocks.heading("Notes"), blocks.bullets(notes(mapod)), *blocks.command_of(command)]
    title = f"Model-assisted probability of detection: {mapod.read.path.name}"
    return blocks.page(title, answer(mapod), body, warnings=doubts(mapod))


def save_mapod_png(path: Path, mapod: Mapod) -> None:
    """Write the figure as a PNG to ``path``."""
    blocks.save_png(path, SIZE_IN, lambda figure: _draw(figure, mapod))


def _draw(figure: Figure, mapod: Mapod) -> None:
    curves = figure.subplots()
    middle, low, high = mapod.band
    curves.fill_between(mapod.sizes, low, high, color=BLUE, alpha=0.16, lw=0)
    curves.plot(mapod.sizes, middle, color=BLUE, lw=2.2, label="combined")
    pod = mapod.simulated.curve.pod(mapod.sizes)
    curves.plot(mapod.sizes, pod, color=PURPLE, ls="--", label="simulated")
    if mapod.measured is not None:
        pod = mapod.measured.curve.pod(mapod.sizes)
        curves.plot(mapod.sizes, pod, color=ORANGE, ls=":", lw=2, label="measured")
    draw_hits(curves, mapod.read.size, mapod.read.response == 1)
    curves.axhline(POD, color=GREY, lw=0.8, ls=":")
    if mapod.sizes[0] < mapod.a90_95 < mapod.sizes[-1]:
        label = f"a90/95: {sized(mapod.a90_95, 'mm')}"
        curves.plot([mapod.a90_95], [POD], "o", color=RED, label=label)
    hits_in_view(curves)
    curves.set(
        xlim=(mapod.sizes[0], mapod.sizes[-1]),
        xlabel="size (mm)",
        ylabel="probability of detection",
    )
    curves.legend(loc="upper left", bbox_to_anchor=(0, -0.16), ncols=3, borderaxespad=0)
