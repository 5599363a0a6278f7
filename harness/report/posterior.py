"""The section of a page on set-ups that are compatible with the thesis' result."""

from __future__ import annotations

from textwrap import fill
from typing import TYPE_CHECKING

from markupsafe import Markup

from harness.report import blocks, sections
from harness.tables.trials import POSTERIOR
from harness.thesis.inference import SET_UP

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SHOWN = 10


def posterior_section(posterior: pd.DataFrame) -> list[Markup]:
    """Return a heading, a small diagram for each axis, and the likeliest set-ups, from the result of `posterior_of`."""
    axes = posterior[posterior["axis"] != SET_UP]
    names = list(dict.fromkeys(axes["axis"]))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(-(-len(names) // 4), min(4, len(names)), squeeze=False, sharey=True).ravel()
        for panel, name in zip(panels, names, strict=False):
            rows = axes[axes["axis"] == name]
            panel.bar(rows["value"], rows["posterior_share"], color=blocks.BLUE, label="posterior")
            panel.step(rows["value"], rows["prior_share"], where="mid", color=blocks.GREY, label="prior")
            panel.set_title(fill(name, 24), fontsize=8)
            panel.tick_params(axis="x", labelsize=8)
            panel.set(ylim=(0, 1))
        for panel in panels[len(names) :]:
            panel.set_axis_off()
        panels[0].legend()

    figures = {"posterior": blocks.svg("posterior", (9, 2.4 * -(-len(names) // 4)), "posterior of each fact", draw)}
    best = posterior[posterior["axis"] == SET_UP].head(SHOWN)
    return [
        blocks.heading("What would make the thesis true"),
        blocks.figure(figures, "posterior", "Posterior (bars) and prior (line) probability of each fact."),
        POSTERIOR.grid(sections.records(best)).html(),
    ]
