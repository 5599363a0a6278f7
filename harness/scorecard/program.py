"""The scorecard from beginning to end: measure, judge, draw, write the tables and the page, say what fell behind."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from harness.report.blocks import COLOURS, MARKERS, plain, plain_decades, svg, template
from harness.scorecard import figures as scoring
from harness.scorecard.bench import FULL, NOTHING, Reading
from harness.scorecard.quantities import QUANTITIES
from harness.tables.schema import write_table
from harness.tables.text import show
from harness.vocabulary.config import Config
from harness.vocabulary.declaration.yaml_source import read_yaml
from harness.vocabulary.files import write_text
from harness.vocabulary.provenance import RESULTS_VERSION, record
from scenes.sensor.camera import camera_digest, load_camera

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

DASHES = ("-", "--", ":")


class Panel(Config):
    """A quantity against the condition ``key`` at some ``values``. ``lines``: by their meaning, the other conditions of
    each that differ from the defaults; ``scales`` of x and y."""

    title: str
    quantity: str
    key: str
    label: str
    values: tuple[int | float, ...]
    lines: dict[str, dict[str, Any]] = Field(default_factory=lambda: dict[str, dict[str, Any]]({"": {}}))
    scales: tuple[str, str] = ("linear", "linear")

    def points(self, line: str) -> list[Config]:
        """The conditions of a line's points."""
        kind = QUANTITIES[self.quantity].conditions
        return [kind.from_data({**self.lines[line], self.key: value}) for value in self.values]


class Picture(Config):
    """A figure of the page; ``label``: of the vertical axis."""

    title: str
    caption: str
    label: str
    panels: tuple[Panel, ...]


@lru_cache
def pictures() -> dict[str, Picture]:
    """The figures by name, in the page's order."""
    source = read_yaml(Path(__file__).with_name("pictures.yaml"))
    return {name: Picture.from_data(data) for name, data in source.data.items()}


def curves_of(cameras: Iterable[str]) -> list[scoring.CurvePoint]:
    """All points of all curves, not yet measured."""
    return [
        scoring.CurvePoint(name, camera, QUANTITIES[panel.quantity], conditions, NOTHING)
        for camera in cameras
        for name, picture in pictures().items()
        for panel in picture.panels
        for line in panel.lines
        for conditions in panel.points(line)
    ]


def all_figures(
    cameras: Mapping[str, str], found: Mapping[scoring.Request, Reading], scores: Sequence[scoring.Score]
) -> dict[str, str]:
    """Every figure as SVG text by name. ``cameras``: titles by name, in the order of colours."""
    looks = zip(cameras, cycle(COLOURS), cycle(MARKERS), strict=False)
    styles = {one: {"color": colour, "marker": marker, "markersize": 4} for one, colour, marker in looks}

    def drawn(name: str, picture: Picture) -> str:
        def draw(figure: Canvas) -> None:
            axes = figure.subplots(1, len(picture.panels), squeeze=False)[0]
            for axis, panel in zip(axes, picture.panels, strict=True):
                _draw_panel(axis, panel, cameras, styles, found)
                for score in scores:
                    _draw_published(axis, panel, score, styles)
                axis.set(title=panel.title, xlabel=panel.label, ylabel=picture.label)
                axis.set(xscale=panel.scales[0], yscale=panel.scales[1])
                for scale, ticks in zip(panel.scales, (axis.xaxis, axis.yaxis), strict=True):
                    if scale == "log":
                        plain_decades(ticks)
            handles, labels = axes[0].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside upper left", ncols=3, columnspacing=1.2, fontsize=8)

        return svg(name, (10.5, 4.2), picture.title, draw)

    return {name: drawn(name, picture) for name, picture in pictures().items()}


def _draw_panel(
    axis: Any,
    panel: Panel,
    cameras: Mapping[str, str],
    styles: Mapping[str, Any],
    found: Mapping[scoring.Request, Reading],
) -> None:
    """Draw the measured points of a panel's lines, with their intervals."""
    there = False
    for camera, title in cameras.items():
        for dash, line in zip(DASHES, panel.lines, strict=False):
            known = [
                (getattr(c, panel.key), found.get((camera, panel.quantity, c), NOTHING)) for c in panel.points(line)
            ]
            known = [(x, reading) for x, reading in known if np.isfinite(reading.value)]
            there |= bool(known)
            y = [reading.value for _, reading in known]
            ends = [(one.value - one.interval.low, one.interval.high - one.value) for _, one in known]
            errors = np.nan_to_num(np.array(ends, float).reshape(-1, 2).T, posinf=0.0)
            named = f"{title}{', ' if line else ''}{line}"
            drawn_as = {"linestyle": dash, "elinewidth": 1, "label": named, **styles[camera]}
            axis.errorbar([x for x, _ in known], y, yerr=errors, **drawn_as)
    if not there:
        axis.text(0.5, 0.5, "not measured", transform=axis.transAxes, ha="center")


def _draw_published(axis: Any, panel: Panel, score: scoring.Score, styles: Mapping[str, Any]) -> None:
    """Mark a published value hollow if it is of the panel's quantity, under the conditions of one of its lines."""
    camera, quantity, conditions = score.figure.request
    if quantity != panel.quantity or score.figure.published.value is None or camera not in styles:
        return
    x = getattr(conditions, panel.key)
    if any(type(conditions).from_data({**fixed, panel.key: x}) == conditions for fixed in panel.lines.values()):
        hollow = {"markersize": 11, "markerfacecolor": "none", "linestyle": "none", "markeredgewidth": 1.6}
        axis.plot(x, score.figure.published.value, **{**styles[camera], **hollow})


def run_scorecard(options: argparse.Namespace, command: str) -> int:
    """Measure, print and write the scorecard. Returns 1 where a figure that passed in the baseline fails, else 0.
    Raises UserError for an unknown camera, a faulty figures file or baseline, and a folder that cannot be written."""
    began = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    # figures of one's own are no figures of the committed baseline
    baseline_file = options.baseline or (None if options.figures else scoring.BASELINE_FILE)
    every = scoring.read_figures(options.figures or scoring.FIGURES_FILE)
    published = dict.fromkeys(figure.camera for figure in every)
    titles = {name: load_camera(name).title for name in (dict.fromkeys(options.camera) or published)}
    figures = tuple(figure for figure in every if figure.camera in titles)
    drawn = {name: title for name, title in titles.items() if options.camera or name in scoring.DRAWN}
    baseline = scoring.read_baseline(baseline_file) if baseline_file else {}
    points = curves_of(drawn)
    wanted = [figure.request for figure in figures]
    wanted += [(point.camera, point.quantity.name, point.conditions) for point in points]
    found = scoring.measured(dict.fromkeys(wanted), FULL, options.out / ".cache" / "renders", options.jobs)
    simulated = {figure.name: found[figure.request] for figure in figures}
    scores = scoring.judged(figures, simulated, baseline)
    curves = [
        replace(point, simulated=found[request]) for point, request in zip(points, wanted[len(figures) :], strict=True)
    ]
    provenance = {
        "results_version": RESULTS_VERSION,
        **record(command),
        "cameras": {name: camera_digest(load_camera(name)) for name in titles},
        "figures": str(options.figures or scoring.FIGURES_FILE),
        "baseline": str(baseline_file or "none"),
        "seconds": round(time.perf_counter() - began, 1),
    }
    answer = _answer(scores)
    real = [score for score in scores if score.figure.kind == "reality"]
    code = [score for score in scores if score.figure.kind == "code"]
    groups = [
        (title, scoring.SCORES.grid(own, heads={"camera": ""}).html() if own else "")
        for camera, title in titles.items()
        for own in [[score for score in real if score.figure.camera == camera]]
    ]
    images = all_figures(drawn, found, scores)
    page = template("scorecard.html", Path(__file__).parent).render(
        answer=answer,
        groups=groups,
        checks=scoring.SCORES.grid(code).html() if code else "",
        figures=[(each.title, name, images[name], each.caption) for name, each in pictures().items()],
        quantities=QUANTITIES.values(),
        provenance=[(key, plain(value)) for key, value in provenance.items()],
    )
    write_table(options.out, scoring.SCORES, scoring.SCORES.frame(scores))
    write_table(options.out, scoring.CURVES, scoring.CURVES.frame(curves))
    write_text(options.out / "provenance.json", json.dumps(provenance, indent=2) + "\n")
    write_text(options.out / "scorecard.html", page)
    show([scoring.SCORES.grid(scores, terminal=True)])
    print(answer)
    print(f"wrote {options.out / 'scorecard.html'}")
    names = [figure.name for figure in every]
    if options.update_baseline and baseline_file:
        scoring.write_baseline(baseline_file, scores, names)
        print(f"wrote {baseline_file}")
        return 0
    return _said_what_fell_behind(scores, baseline, names) if baseline_file else 0


def _said_what_fell_behind(scores: Sequence[scoring.Score], baseline: Mapping[str, bool], every: Sequence[str]) -> int:
    """The exit code; names the figures that passed before and fail now, and what the baseline does not know."""
    new = [score.figure.name for score in scores if score.passed_before is None]
    mended = [score.figure.name for score in scores if score.passed_before is False and score.passes]
    for names, what in ((new, "not in the baseline"), (mended, "pass now, not before")):
        if names:
            print(f"{what}: {', '.join(names)}; --update-baseline takes note", file=sys.stderr)
    gone = sorted(name for name, passed in baseline.items() if passed and name not in every)
    for name in gone:
        print(f"passed in the baseline and is no longer among the figures: {name}", file=sys.stderr)
    fallen = [score for score in scores if score.regressed]
    for score in fallen:
        low, high = score.figure.limits
        told = f"{score.figure.what()}): simulated {score.simulated.value:.4g}, passes from {low:g} to {high:g}"
        print(f"passed in the baseline and fails now: {score.figure.name} ({told}", file=sys.stderr)
    return 1 if fallen or gone else 0


FAMILIES = {"azure": "Azure Kinect", "femto": "Femto", "kinect": "Kinect v2", "realsense": "RealSense L515"}
"""Families of cameras by the first word of their names; all others are counted together."""


def _answer(scores: Sequence[scoring.Score]) -> str:
    """Tell how many blind figures hold, in all and by family, and how many of the others."""

    def share(chosen: Sequence[scoring.Score]) -> str:
        return f"{sum(score.passes for score in chosen)} of {len(chosen)}"

    by_use = {use: [score for score in scores if score.figure.use == use] for use in ("blind", "calibration", "code")}
    blind = by_use["blind"]
    families: dict[str, list[scoring.Score]] = {}
    for score in blind:
        first = score.figure.camera.partition("_")[0]
        families.setdefault(FAMILIES.get(first, "other cameras"), []).append(score)
    each = ", ".join(f"{name} {share(own)}" for name, own in families.items())
    text = f"{share(blind)} blind figures are within 25 %{f' ({each})' if len(families) > 1 else ''}; "
    text += f"of figures that calibrated a camera {share(by_use['calibration'])}; "
    text += f"of checks of the code {share(by_use['code'])}."
    regressed = [score.figure.name for score in scores if score.regressed]
    return text + (f" Passed before and fail now: {', '.join(regressed)}." if regressed else "")
