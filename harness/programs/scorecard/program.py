"""Runs the scorecard: it measures, judges and draws, writes the table and the page, and names
failures."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.programs.scorecard import figures as scoring
from harness.programs.scorecard.bench import FULL
from harness.programs.scorecard.quantities import QUANTITIES
from harness.records.schema import write_table
from harness.report.blocks import (
    BLUE,
    GREY,
    RED,
    command_of,
    figure,
    heading,
    note,
    page,
    plain,
    svg,
    tag,
)
from harness.vocabulary.files import write_json, write_text
from harness.vocabulary.path_names import camera_title
from harness.vocabulary.provenance import RESULTS_VERSION, record
from harness.vocabulary.seeds import digest
from harness.vocabulary.text import show
from scenes.sensor.camera import load_camera

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

HOW = (
    "Each quantity is measured on simulated frames as it was on the real camera, under the "
    "conditions of the source. A figure of a real camera passes if the simulated value lies "
    "within 25 % of the published value; if the source states a wider tolerance, that applies, "
    "and the verdict says so. A bound must hold. Blind: nothing was fitted to the figure. "
    "Calibration: the camera file was, or may have been, fitted to it, so it is not a test. Tags "
    "of sources: R read for this project in the named public source, D derived from such a "
    "source, S a single secondary source, W measured on public captures, M from memory or a guess."
)
CHECKS = (
    "These checks compare the program with the arithmetic of a stated filter, gate or limit of "
    "the camera file. They say nothing about real cameras and pass only within their tolerance."
)
CAPTION = (
    "Simulated divided by published value with its 95 % interval; the band extends 25 % to either "
    "side. Blue passes, red fails; hollow marks are figures to which the camera file was fitted. "
    "Bounds and values of 0 have no ratio."
)
FAMILIES = {
    "azure": "Azure Kinect",
    "femto": "Femto",
    "kinect": "Kinect v2",
    "realsense": "RealSense L515",
}
"""Families of cameras by the first word of their names; the other cameras are counted together."""


def run_scorecard(options: argparse.Namespace, command: str) -> int:
    """Measure, print and write the scorecard. Returns 1 if a figure fails and its entry gives no
    reason, else 0. Raises UserError for an unknown camera, a faulty file of figures, or a folder
    that cannot be written."""
    began = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    all_figures = scoring.read_figures(options.figures or scoring.FIGURES_FILE)
    names = dict.fromkeys(options.camera) or dict.fromkeys(figure.camera for figure in all_figures)
    titles = {name: load_camera(name).title for name in names}
    figures = [figure for figure in all_figures if figure.camera in titles]
    readings = scoring.measured(
        dict.fromkeys(figure.request for figure in figures), FULL, options.jobs
    )
    scores = [scoring.Score(figure, readings[figure.request]) for figure in figures]
    provenance = {
        "results_version": RESULTS_VERSION,
        **record(command),
        "cameras": {name: digest(load_camera(name).to_data()) for name in titles},
        "figures": str(options.figures or scoring.FIGURES_FILE),
        "seconds": round(time.perf_counter() - began, 1),
    }
    answer = _answer(scores)
    write_table(options.out, scoring.SCORES, scoring.SCORES.frame(scores))
    write_json(options.out / "provenance.json", provenance)
    write_text(options.out / "scorecard.html", _page(answer, scores, titles, provenance, command))
    show([scoring.SCORES.grid(scores, terminal=True)])
    print(answer)
    print(f"wrote {options.out / 'scorecard.html'}")
    for score in scores:
        if score.passes and score.figure.fails:
            print(f"{score.figure.name} passes now: remove `fails` from its entry", file=sys.stderr)
        if score.fell_behind:
            text = "simulated {:.4g}, passes from {:g} to {:g}".format(
                score.simulated.value, *score.figure.limits
            )
            print(f"{score.figure.name} ({score.figure.what()}) fails: {text}", file=sys.stderr)
    return int(any(score.fell_behind for score in scores))


def _page(
    answer: str,
    scores: Sequence[scoring.Score],
    titles: dict[str, str],
    provenance: dict[str, object],
    command: str,
) -> str:
    """Return the page: the figure of ratios, figures of cameras, checks of the code, and the
    quantities' meanings."""
    body = [heading("Simulated and published values")]
    real = [score for score in scores if score.figure.kind == "reality"]
    ratios = [
        score for score in real if score.figure.published.value is not None and score.ratio > 0
    ]
    if ratios:
        size = (9.5, 1.2 + 0.17 * len(ratios))
        name = "ratios"
        drawn = {
            name: svg(
                name, size, "Simulated over published value", lambda canvas: _draw(canvas, ratios)
            )
        }
        body.append(figure(drawn, name, CAPTION))
    if failing := [score for score in real if not score.passes]:
        body += [heading("Failures and their reasons"), scoring.SCORES.grid(failing).html()]
    without = [
        title
        for camera, title in titles.items()
        if all(score.figure.camera != camera for score in real)
    ]
    body += [heading("Figures of real cameras"), scoring.SCORES.grid(real).html()] if real else []
    body += [note(f"The file has no published figure for {'; '.join(without)}.")] if without else []
    code = [score for score in scores if score.figure.kind == "code"]
    if code:
        body += [heading("Checks of the code"), note(CHECKS), scoring.SCORES.grid(code).html()]
    meanings = [
        (f"{q.title} ({q.unit})" if q.unit else q.title, q.says) for q in QUANTITIES.values()
    ]
    for title, rows in (("Quantities", meanings), ("Provenance", provenance.items())):
        lines = [
            tag("tr", tag("th", key, scope="row"), tag("td", plain(value))) for key, value in rows
        ]
        body += [heading(title), tag("table", tag("tbody", *lines), kind="prov")]
    return page(
        "Scorecard of the simulated cameras", answer, [*body, *command_of(command)], [note(HOW)]
    )


def _draw(canvas: Canvas, scores: Sequence[scoring.Score]) -> None:
    """Draw each score's ratio with its interval, with the first at the top."""
    axis = canvas.subplots()
    axis.axvspan(1 - scoring.NEAR, 1 + scoring.NEAR, color=BLUE, alpha=0.12)
    axis.axvline(1, color=BLUE, linewidth=0.8)
    for row, score in enumerate(scores):
        interval = score.simulated.interval
        value = score.figure.published.value
        colour = BLUE if score.passes else RED
        if interval.known and value:
            axis.plot(
                np.maximum([interval.low / value, interval.high / value], 1e-3),
                [row, row],
                color=colour,
                linewidth=1,
            )
        face = colour if score.figure.use == "blind" else "none"
        axis.plot(score.ratio, row, "o", color=colour, markerfacecolor=face, markersize=4)
    axis.set(
        xscale="log", xlim=(0.05, 5), ylim=(len(scores) - 0.5, -0.5), xlabel="simulated / published"
    )
    axis.set_xticks([0.1, 0.25, 0.5, 1, 2, 4], ["0.1", "0.25", "0.5", "1", "2", "4"])
    axis.minorticks_off()
    axis.set_yticks(
        range(len(scores)),
        [score.figure.what().partition(", stored")[0] for score in scores],
        fontsize=6,
    )
    cameras = [camera_title(score.figure.camera) for score in scores]
    for row, title in enumerate(cameras):
        if row == 0 or title != cameras[row - 1]:
            axis.axhline(row - 0.5, color=GREY, linewidth=0.6)
            axis.text(4.8, row, title, ha="right", va="center", fontsize=7, weight="bold")


def _answer(scores: Sequence[scoring.Score]) -> str:
    """Return how many blind figures pass, in total and by family, and how many of the others."""

    def share(chosen: Sequence[scoring.Score]) -> str:
        return f"{sum(score.passes for score in chosen)} of {len(chosen)}"

    by_use = {
        use: [score for score in scores if score.figure.use == use]
        for use in ("blind", "calibration", "code")
    }
    blind = by_use["blind"]
    families: dict[str, list[scoring.Score]] = {}
    for score in blind:
        families.setdefault(
            FAMILIES.get(score.figure.camera.partition("_")[0], "other cameras"), []
        ).append(score)
    by_family = ", ".join(f"{name} {share(family)}" for name, family in families.items())
    values = [score for score in blind if score.figure.published.value is not None]
    bounds = [score for score in blind if score.figure.published.value is None]
    wide = sum(score.passes_by_tolerance for score in blind)
    text = (
        f"{share(blind)} blind figures pass{f' ({by_family})' if len(families) > 1 else ''}: "
        f"{share(values)} values "
    )
    text += (
        f"within 25 %{f' ({wide} by a wider tolerance of the source)' if wide else ''}, "
        f"{share(bounds)} bounds; "
    )
    text += f"{share(by_use['calibration'])} figures that calibrated a camera pass; "
    text += f"{share(by_use['code'])} checks of the code pass."
    new = [score.figure.name for score in scores if score.fell_behind]
    return text + (f" Failures without a stated reason: {', '.join(new)}." if new else "")
