"""The scorecard from beginning to end: measure, judge, draw, write the tables and the page, say what fell behind."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from harness.report.blocks import COLOURS, MARKERS, plain, plain_decades, svg, template
from harness.scorecard import figures as scoring
from harness.scorecard.bench import FULL, QUICK
from harness.scorecard.quantities import QUANTITIES
from harness.tables.schema import write_table
from harness.tables.text import show
from harness.vocabulary.config import Config
from harness.vocabulary.declaration.yaml_source import read_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.provenance import RESULTS_VERSION, record
from scenes.sensor.camera import camera_digest, load_camera

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

DASHES = ("-", "--", ":")


class Line(Config):
    """A curve in a panel, of the points with ``fixed`` conditions."""

    curve: str
    fixed: dict[str, Any] = Field(default_factory=dict)


class Panel(Config):
    """A quantity against the condition ``key``. ``lines``: curves by their meaning; ``scales`` of x and y."""

    title: str
    quantity: str
    key: str
    label: str
    lines: dict[str, Line]
    scales: tuple[str, str] = ("linear", "linear")


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


def all_figures(
    cameras: Mapping[str, str], points: Sequence[scoring.MeasuredPoint], scores: Sequence[scoring.Score]
) -> dict[str, str]:
    """Every figure as SVG text by name. ``cameras``: titles by name, in the order of colours."""

    shown = ("curve", "quantity", "camera", "simulated", "low", "high", *scoring.CONDITIONS)
    table = scoring.CURVES.frame(points).reindex(columns=shown)
    looks = zip(cycle(COLOURS), cycle(MARKERS), strict=False)
    styles = {one: {"color": c, "marker": m, "markersize": 4} for one, (c, m) in zip(cameras, looks, strict=False)}

    def drawn(name: str, picture: Picture) -> str:
        panels = picture.panels

        def draw(figure: Canvas) -> None:
            rows = 1 if len(panels) < 4 else 2
            axes = figure.subplots(rows, len(panels) // rows, squeeze=False).ravel()
            for axis, panel in zip(axes, panels, strict=True):
                of_panel = table[table["quantity"] == panel.quantity]
                for camera in cameras:
                    for dash, (meaning, line) in zip(DASHES, panel.lines.items(), strict=False):
                        part = of_panel[(of_panel["camera"] == camera) & (of_panel["curve"] == line.curve)]
                        part = part[np.isfinite(part["simulated"])]
                        for key, value in line.fixed.items():
                            part = part[part[key] == value]
                        part = part.sort_values(panel.key)
                        errors = np.nan_to_num(
                            np.abs(part[["low", "high"]].to_numpy().T - part["simulated"].to_numpy())
                        )
                        named = f"{cameras[camera]}{', ' if meaning else ''}{meaning}"
                        drawn_as = {"linestyle": dash, "elinewidth": 1, "label": named, **styles[camera]}
                        axis.errorbar(part[panel.key].to_numpy(), part["simulated"].to_numpy(), yerr=errors, **drawn_as)
                for score in scores:
                    _draw_published(axis, panel, score, styles)
                axis.set(title=panel.title, xlabel=panel.label, ylabel=picture.label)
                axis.set(xscale=panel.scales[0], yscale=panel.scales[1])
                for scale, ticks in zip(panel.scales, (axis.xaxis, axis.yaxis), strict=True):
                    if scale == "log":
                        plain_decades(ticks)
                if not (of_panel["curve"].isin([curve for curve, _ in panel.lines.values()])).any():
                    axis.text(0.5, 0.5, "not measured", transform=axis.transAxes, ha="center")
            handles, labels = axes[-1].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside upper left", ncols=3, columnspacing=1.2, fontsize=8)

        return svg(name, (10.5, 4.2 if len(panels) < 4 else 7.6), picture.title, draw)

    return {name: drawn(name, picture) for name, picture in pictures().items()}


def _draw_published(axis: Any, panel: Panel, score: scoring.Score, styles: Mapping[str, Any]) -> None:
    """Mark a published value hollow if it is of the panel's quantity, under the conditions of the panel's curve."""
    entry, conditions = score.figure.entry, score.figure.conditions.to_data()
    usual = {**type(score.figure.conditions)().to_data(), "lag_x_px": 0, "lag_y_px": 0}
    differs = {key for key, value in conditions.items() if value != usual[key]}
    if entry.quantity == panel.quantity and entry.published.value is not None and differs <= {panel.key}:
        hollow = {"markersize": 11, "markerfacecolor": "none", "linestyle": "none", "markeredgewidth": 1.6}
        axis.plot(conditions[panel.key], entry.published.value, **{**styles[entry.camera], **hollow})


def run_scorecard(options: argparse.Namespace, command: str) -> int:
    """Measure, print and write the scorecard. Returns 1 where a figure that passed in the baseline fails, else 0.
    Raises UserError for an unknown camera, a faulty figures file or baseline, and a folder that cannot be written."""
    began = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.quick and options.update_baseline:
        raise UserError("--quick and --update-baseline: a baseline needs the whole effort", fix="leave one of them out")
    # a quick look is judged by a baseline that is named only
    baseline_file = options.baseline or (None if options.quick else scoring.BASELINE_FILE)
    every = scoring.read_figures(options.figures or scoring.FIGURES_FILE)
    published = dict.fromkeys(figure.entry.camera for figure in every)
    titles = {name: load_camera(name).title for name in (dict.fromkeys(options.camera) or published)}
    figures = tuple(figure for figure in every if figure.entry.camera in titles)
    drawn = {name: title for name, title in titles.items() if options.camera or name in scoring.DRAWN}
    baseline = scoring.read_baseline(baseline_file) if baseline_file else {}
    points = tuple(scoring.curve_points(scoring.QUICK_GRIDS if options.quick else scoring.FULL_GRIDS))
    wanted = scoring.requests_of(tuple(drawn), figures, points)
    found = scoring.measured(wanted, QUICK if options.quick else FULL, options.out / ".cache" / "renders", options.jobs)
    simulated = {each.name: found[each.entry.camera, each.quantity.name, each.conditions] for each in figures}
    scores = scoring.judged(figures, simulated, baseline)
    curves = [
        scoring.MeasuredPoint(camera, point, found[camera, point.quantity, point.conditions])
        for camera in drawn
        for point in points
    ]
    provenance = {
        "results_version": RESULTS_VERSION,
        **record(command),
        "cameras": {name: camera_digest(load_camera(name)) for name in titles},
        "figures": str(options.figures or scoring.FIGURES_FILE),
        "baseline": str(baseline_file or "none"),
        "effort": "quick" if options.quick else "full",
        "seconds": round(time.perf_counter() - began, 1),
    }
    answer = _answer(scores, options.quick)
    real = [score for score in scores if score.figure.entry.kind == "reality"]
    code = [score for score in scores if score.figure.entry.kind == "code"]
    groups = [
        (title, scoring.SCORES.grid(own, heads={"camera": ""}).html() if own else "")
        for camera, title in titles.items()
        for own in [[score for score in real if score.figure.entry.camera == camera]]
    ]
    images = all_figures(drawn, curves, scores)
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
        low, high = score.figure.entry.limits
        told = f"{score.figure.what()}): simulated {score.simulated.value:.4g}, passes from {low:g} to {high:g}"
        print(f"passed in the baseline and fails now: {score.figure.name} ({told}", file=sys.stderr)
    return 1 if fallen or gone else 0


FAMILIES = {"azure": "Azure Kinect", "femto": "Femto", "kinect": "Kinect v2", "realsense": "RealSense L515"}
"""Families of cameras by the first word of their names; all others are counted together."""


def _answer(scores: Sequence[scoring.Score], quick: bool) -> str:
    """Tell how many blind figures hold, in all and by family, and how many of the others."""

    def share(chosen: Sequence[scoring.Score]) -> str:
        return f"{sum(score.passes for score in chosen)} of {len(chosen)}"

    blind = [score for score in scores if score.figure.entry.blind]
    fitted = [score for score in scores if score.figure.entry.kind == "reality" and not score.figure.entry.blind]
    families: dict[str, list[scoring.Score]] = {}
    for score in blind:
        first = score.figure.entry.camera.partition("_")[0]
        families.setdefault(FAMILIES.get(first, "other cameras"), []).append(score)
    each = ", ".join(f"{name} {share(own)}" for name, own in families.items())
    text = "A quick look, with too few frames for a judgement: " if quick else ""
    text += f"{share(blind)} blind figures are within 25 %{f' ({each})' if len(families) > 1 else ''}; "
    text += f"of figures that calibrated a camera {share(fitted)}; "
    text += f"of checks of the code {share([score for score in scores if score.figure.entry.kind == 'code'])}."
    regressed = [score.figure.name for score in scores if score.regressed]
    return text + (f" Passed before and fail now: {', '.join(regressed)}." if regressed else "")
