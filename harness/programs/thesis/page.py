"""Parts of pages about the thesis: the section of the posterior, and the lead of several views."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING

from harness.programs.thesis.inference import SET_UP
from harness.records import trials
from harness.report import blocks, sections
from harness.report.claims import Answer, Verdict

if TYPE_CHECKING:
    import pandas as pd
    from markupsafe import Markup
    from matplotlib.figure import Figure

LIKELIEST = 10  # set-ups that the posterior's table shows
MOST_ACROSS = 4  # diagrams in a row of the posterior's figure
ROW_IN = 2.4  # height of such a row, inches
PROPOSAL = "H1"
LEADS: dict[Answer, str] = {
    "borne out": "Yes",
    "not borne out": "Not in every respect",
    "undecided": "That is undecided",
}
"""The answer whether several views are better than one, by the verdict on the proposal."""


def posterior_section(posterior: pd.DataFrame) -> list[Markup]:
    """Return a heading, a small diagram for each axis, and the likeliest set-ups, from the result
    of `posterior_of`."""
    of_set_ups = posterior["axis"] == SET_UP
    figures = {"posterior": _posterior_figure(posterior[~of_set_ups])}
    caption = "Posterior (bars) and prior (line) probability of each fact."
    likeliest = sections.records(posterior[of_set_ups].head(LIKELIEST))
    return [
        blocks.heading("What would make the thesis true"),
        blocks.figure(figures, "posterior", caption),
        trials.POSTERIOR.grid(likeliest).html(),
    ]


def _posterior_figure(rows: pd.DataFrame) -> str:
    """Draw the probability of each value, with a diagram for each axis."""
    names = list(dict.fromkeys(rows["axis"]))
    rows_down = -(-len(names) // MOST_ACROSS)
    columns = min(MOST_ACROSS, len(names))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(rows_down, columns, squeeze=False, sharey=True).ravel()
        for panel, name in zip(panels, names, strict=False):
            of_axis = rows[rows["axis"] == name]
            values = of_axis["value"]
            posterior = of_axis["posterior_share"]
            prior = of_axis["prior_share"]
            panel.bar(values, posterior, color=blocks.BLUE, label="posterior")
            panel.step(values, prior, where="mid", color=blocks.GREY, label="prior")
            panel.set_title(fill(name, 24), fontsize=8)
            panel.tick_params(axis="x", labelsize=8)
            panel.set(ylim=(0, 1))
        for panel in panels[len(names) :]:
            panel.set_axis_off()
        panels[0].legend()

    return blocks.svg("posterior", (9, ROW_IN * rows_down), "posterior of each fact", draw)


def lead_of_views(verdicts: Sequence[Verdict]) -> str:
    """Return the answer to the question whether several views are better than one, from the
    verdicts on the proposal at each place."""
    on_proposal = [verdict for verdict in verdicts if verdict.claim == PROPOSAL]
    answers = dict.fromkeys(LEADS[verdict.verdict] for verdict in on_proposal)
    return f"Are several views better than one? {' / '.join(answers)}."
