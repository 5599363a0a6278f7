"""The efficiency page: detectors compared with the ideal observer in a table and a figure."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from harness.programs.efficiency.ideal_observer import SHARES
from harness.programs.efficiency.statistics import Efficiency
from harness.programs.efficiency.tables import EFFICIENCY
from harness.report.blocks import (
    COLOURS,
    GREY,
    INK,
    MARKERS,
    command_of,
    figure,
    heading,
    note,
    page,
    svg,
)
from harness.report.pod import hits_in_view, plain, plain_numbers
from harness.tables.limits import name_of
from harness.vocabulary.text import Grid, percent, size

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLES = ("-", "--", "-.", ":")
# number of classes of d', with equal numbers of damages, whose shares of hits are drawn
CLASSES = 8
LEFT = 0.5  # left end of the axis of d'; damage with a lower d' is found only by chance
READ = (
    "Efficiency: the squared ratio of two d', that at which the ideal observer finds the "
    "share and that at which the "
    "detector finds it by depth alone. d' is the ideal observer's signal at a damage "
    "divided by the standard deviation "
    "of its statistic. The ideal observer knows the damage's exact signature and the "
    "noise's covariance over units, "
    "but neither the place nor the surface. Intervals are over boards."
)


def answer(rows: Sequence[Efficiency]) -> str:
    """State the best and the worst detector in one sentence."""
    ranked_rows = sorted(
        (row for row in rows if np.isfinite(row.most.efficiency)),
        key=lambda row: row.most.efficiency,
    )
    if not ranked_rows:
        return "No detector has a curve against the ideal observer's d', so there is no efficiency."
    sentences = []
    for row in (ranked_rows[-1], ranked_rows[0])[: len(ranked_rows)]:
        sentences.append(
            f"{row.limit.record.detector} ({row.limit.record.label}) has "
            f"{percent(row.most.efficiency)} % at a90: "
            f"{size(row.limit.a90_mm, row.limit.largest_mm)} mm, and the ideal observer "
            f"{size(row.most.ideal_mm)} mm"
        )
    return f"Highest efficiency: {sentences[0]}." + (
        f" Lowest: {sentences[1]}." if len(sentences) > 1 else ""
    )


def efficiency_figure(rows: Sequence[Efficiency]) -> str:
    """Draw each set-up's curve against d' with the shares of hits in classes of d', and the ideal
    observer's POD."""
    detectors = list(dict.fromkeys(row.limit.record.detector for row in rows))
    conditions = list(
        dict.fromkeys((row.limit.record.frames, row.limit.largest_mm) for row in rows)
    )
    index = np.concatenate([row.index for row in rows])
    pod = np.concatenate([row.pod for row in rows])
    order = np.argsort(index)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot(index[order], pod[order], color=INK, lw=2.2, label="ideal observer")
        for row in rows:
            colour = COLOURS[detectors.index(row.limit.record.detector) % len(COLOURS)]
            style = conditions.index((row.limit.record.frames, row.limit.largest_mm))
            index_found = np.sort(row.index[row.index > 0])
            if row.curve is not None and len(index_found):
                x = np.geomspace(LEFT, max(index_found[-1], 2 * LEFT), 200)
                name = plain(fill(f"{row.limit.record.detector}: {name_of(row.limit)}", 100))
                axes.plot(
                    x,
                    row.curve.pod(x),
                    color=colour,
                    ls=STYLES[style % len(STYLES)],
                    lw=1.4,
                    label=name,
                )
            for members in np.array_split(np.argsort(row.index), CLASSES):
                if len(members):
                    share = row.hits[members].sum() / row.inspections[members].sum()
                    middle = max(float(np.median(row.index[members])), LEFT)
                    axes.plot(
                        middle, share, MARKERS[style % len(MARKERS)], color=colour, ms=4, alpha=0.6
                    )
        for share in SHARES:
            axes.axhline(share, color=GREY, lw=0.8, ls=":")
        hits_in_view(axes, 0.03)
        axes.set(
            xscale="log",
            xlabel="d' of the ideal observer",
            ylabel="share found",
            title="All damages against d'",
        )
        axes.set_xlim(left=LEFT)
        plain_numbers(axes.xaxis, (1, 2, 5))
        figure.legend(
            *axes.get_legend_handles_labels(), loc="outside lower center", ncols=1, fontsize=8
        )

    return svg(
        "against-d", (8.0, 4.6 + 0.17 * len(rows)), "Probability of detection against d'.", draw
    )


def efficiency_parts(
    rows: Sequence[Efficiency], first: str, warnings: Sequence[str]
) -> list[str | Grid]:
    """Return the parts for a terminal: the conditions, warnings, the table and the answer."""
    return [
        first,
        *(f"warning: {text}" for text in warnings),
        EFFICIENCY.grid(rows, terminal=True),
        "",
        answer(rows),
    ]


def efficiency_html(
    rows: Sequence[Efficiency], first: str, warnings: Sequence[str], name: str, command: str
) -> str:
    """Return the page as text; it needs no network."""
    caption = (
        "Share of damages found against d'. Lines are probit curves of ln d'; points are "
        "classes with equal numbers of "
        "damages. A detector that loses the same share everywhere has the same curve for "
        "all sizes and kinds."
    )
    drawn = figure({"against-d": efficiency_figure(rows)}, "against-d", caption)
    body = [
        heading("Set-ups"),
        EFFICIENCY.grid(rows).html(),
        note(READ),
        drawn,
        *command_of(command),
    ]
    return page(f"Efficiency: {name}", answer(rows), body, [note(first)], warnings)
