"""The scorecard from beginning to end: measure, judge, write the tables and the page, say what fell behind."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from harness.report.blocks import template
from harness.scorecard.bench import FULL, QUICK
from harness.scorecard.figures import (
    BASELINE_FILE,
    FIGURES_FILE,
    Figure,
    Score,
    judged,
    read_baseline,
    read_figures,
    write_baseline,
)
from harness.scorecard.measure import FULL_GRIDS, QUICK_GRIDS, Request, curve_points, measured, requests_of
from harness.scorecard.plots import Curves, all_figures
from harness.scorecard.quantities import QUANTITIES
from harness.scorecard.tables import CURVES, SCORES, MeasuredPoint
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.provenance import record
from harness.vocabulary.versions import RESULTS_VERSION
from scenes.sensor.camera import camera_digest, camera_names, load_camera

METHOD = (
    "Each quantity is measured on simulated frames like that of a real camera, under the conditions that the source "
    "states. A figure passes where the simulated value lies within the published tolerance or bound; tolerances were "
    "fixed beforehand, and where one was changed after a first run its note says so. Figures marked as calibration are "
    "no test: the camera's file was, or may be, fitted to them. Tags: R read in the named public source, D derived "
    "from such, S one secondary source, W measured on public captures, M a guess."
)
PICTURES = {
    "noise": (
        "Temporal noise",
        "Temporal deviation: standard deviation over frames of one pixel's z, rms over pixels about the axis, noise "
        "alone, with 95 % intervals of a jackknife over frames; a rare wild range counts in full. Hollow: published. "
        "Fourth panel: the points of the other three against the amplitude; where they fall on one line, the amplitude "
        "alone decides.",
    ),
    "correlation": (
        "Spatial correlation of the noise",
        "Correlation of the temporal noise of pixels so far apart, at 1.5 m and albedo 80 %. Hollow: published "
        "figures, some for other distances and angles (see the table).",
    ),
    "bias": (
        "Bias, multipath off and on",
        "Left: mean error of z of unit 1 an hour after power-on on a plane without multipath. Right: a board of "
        "400 x 300 mm on a table with a wall behind, without noise and without traits of a unit; bars are what the "
        "render's Monte Carlo leaves.",
    ),
    "edges": (
        "Edges",
        "A straight edge, its front at 0.75 m, slightly off the pixel grid; albedo 60 %. Widths in pixels across the "
        "edge. Flying: with a range that is off both surfaces by more than four deviations of the noise and a tenth of "
        "the step; not told where noise hides the step. Eroded: the pixel's central ray meets the surface and the "
        "camera does not show it; shadow included.",
    ),
    "survival": (
        "The smallest step that survives the camera's filter",
        "Round plateaus before a plane, each at another place within its pixel: the lowest step of which at least half "
        "is seen in the middle, in most of them. Crosses: none of those tried, up to 500 mm.",
    ),
    "valid": (
        "Valid pixels",
        "Pixels about the axis that have a range, in percent, with every gate of the camera.",
    ),
}
"""Title and caption of each picture, in the page's order."""


def run_scorecard(options: argparse.Namespace, command: str) -> int:
    """Measure, print and write the scorecard. Returns 1 where a figure that passed in the baseline fails, else 0.

    Raises UserError for an unknown camera, a faulty figures file or baseline, and a folder that cannot be written.
    """
    began = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.quick and options.update_baseline:
        raise UserError("--quick and --update-baseline: a baseline needs the whole effort", fix="leave one of them out")
    figures_file = options.figures or FIGURES_FILE
    # a quick look is judged by a baseline that is named only
    baseline_file = options.baseline or (None if options.quick else BASELINE_FILE)
    every = read_figures(figures_file)
    titles = {name: load_camera(name).title for name in (dict.fromkeys(options.camera) or camera_names())}
    figures = tuple(figure for figure in every if figure.entry.camera in titles)
    baseline = read_baseline(baseline_file) if baseline_file else {}
    points = tuple(curve_points(QUICK_GRIDS if options.quick else FULL_GRIDS))
    effort = QUICK if options.quick else FULL
    wanted = requests_of(tuple(titles), figures, points)
    found = measured(wanted, effort, options.out / ".cache" / "renders", options.jobs)
    simulated = {each.name: found[Request(each.entry.camera, each.quantity.name, each.conditions)] for each in figures}
    scores = judged(figures, simulated, baseline)
    provenance = {
        "results_version": RESULTS_VERSION,
        **record(command),
        "cameras": {name: camera_digest(load_camera(name)) for name in titles},
        "figures": str(figures_file),
        "baseline": str(baseline_file),
        "effort": "quick" if options.quick else "full",
        "seconds": round(time.perf_counter() - began, 1),
    }
    pictures = all_figures(Curves(titles, points, found), scores)
    curves = [
        MeasuredPoint(camera, point, found[Request(camera, point.quantity, point.conditions)])
        for camera in titles
        for point in points
    ]
    SCORES.write(options.out, scores)
    CURVES.write(options.out, curves)
    write_text(options.out / "provenance.json", json.dumps(provenance, indent=2) + "\n")
    write_text(options.out / "scorecard.html", scorecard_html(titles, scores, pictures, provenance, options.quick))
    SCORES.show(scores, but="note", style=lambda score, text: _colour(score) if text == score.verdict else "")
    print(answer(scores, options.quick))
    print(f"wrote {options.out / 'scorecard.html'}")
    if options.update_baseline and baseline_file:
        write_baseline(baseline_file, scores, [figure.name for figure in every])
        print(f"wrote {baseline_file}")
        return 0
    return _said_what_fell_behind(scores, baseline, every) if baseline_file else 0


def _colour(score: Score) -> str:
    return "green" if score.passes else "bold red" if score.regressed else "yellow"


def _said_what_fell_behind(scores: Sequence[Score], baseline: Mapping[str, bool], every: Sequence[Figure]) -> int:
    """The exit code; names the figures that passed before and fail now, and what the baseline does not know."""
    gone = sorted({name for name, passed in baseline.items() if passed} - {figure.name for figure in every})
    new = [score.figure.name for score in scores if score.passed_before is None]
    mended = [score.figure.name for score in scores if score.passed_before is False and score.passes]
    for names, what in ((new, "not in the baseline"), (mended, "pass now, not before")):
        if names:
            print(f"{what}: {', '.join(names)}; --update-baseline takes note", file=sys.stderr)
    for name in gone:
        print(f"passed in the baseline and is no longer among the figures: {name}", file=sys.stderr)
    fallen = [score for score in scores if score.regressed]
    for score in fallen:
        low, high = score.figure.entry.published.limits
        print(
            f"passed in the baseline and fails now: {score.figure.name} ({score.figure.what()}): simulated "
            f"{score.simulated.value:.4g}, passes from {low:g} to {high:g}",
            file=sys.stderr,
        )
    return 1 if fallen or gone else 0


def answer(scores: Sequence[Score], quick: bool = False) -> str:
    """One sentence: how many figures pass, apart for those that test and those that calibrate."""

    def passing(calibration: bool) -> str:
        own = [score.passes for score in scores if score.figure.entry.calibration == calibration]
        return f"{sum(own)} of {len(own)}"

    text = "A quick look, with too few frames for a judgement: " if quick else ""
    text += f"{passing(False)} published figures that the models were not fitted to hold"
    if any(score.figure.entry.calibration for score in scores):
        text += f", and {passing(True)} that they were or may be fitted to"
    regressed = [score.figure.name for score in scores if score.regressed]
    return f"{text}." + (f" Passed before and fail now: {', '.join(regressed)}." if regressed else "")


def scorecard_html(
    cameras: Mapping[str, str],
    scores: Sequence[Score],
    pictures: Mapping[str, str],
    provenance: Mapping[str, Any],
    quick: bool = False,
) -> str:
    """The page as text; ``pictures`` are SVG texts by name, ``cameras`` titles by name."""
    groups = [
        (title, [(score, SCORES.cells(score, but="camera")) for score in scores if score.figure.entry.camera == camera])
        for camera, title in cameras.items()
    ]
    return template("scorecard.html", Path(__file__).parent).render(
        answer=answer(scores, quick),
        method=METHOD,
        heads=SCORES.heads(but="camera"),
        groups=groups,
        figures=[(title, name, pictures[name], text) for name, (title, text) in PICTURES.items() if name in pictures],
        quantities=QUANTITIES.values(),
        provenance=told(provenance),
    )


def told(provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return recorded values as texts by name."""

    def text(value: Any) -> str:
        if isinstance(value, Mapping):
            return ", ".join(f"{key} {part}" for key, part in value.items())
        return "not recorded" if value is None else str(value)

    return [(key, text(value)) for key, value in provenance.items()]
