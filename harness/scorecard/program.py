"""The scorecard from beginning to end: measure, judge, draw, write the tables and the page, say what fell behind."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from harness.report.blocks import COLOURS, MARKERS, plain, plain_decades, svg, template
from harness.scorecard.bench import FULL, QUICK
from harness.scorecard.figures import (
    BASELINE_FILE,
    CONDITIONS,
    CURVES,
    FIGURES_FILE,
    FULL_GRIDS,
    QUICK_GRIDS,
    SCORES,
    MeasuredPoint,
    Score,
    curve_points,
    judged,
    measured,
    read_baseline,
    read_figures,
    requests_of,
    write_baseline,
)
from harness.scorecard.quantities import QUANTITIES
from harness.tables.schema import write_table
from harness.tables.text import show
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.provenance import RESULTS_VERSION, record
from scenes.sensor.camera import camera_digest, camera_names, load_camera

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

DASHES = ("-", "--", ":")


class Panel(NamedTuple):
    """A quantity against the condition ``key``. ``lines``: curves by their meaning, each with conditions of points."""

    title: str
    quantity: str
    key: str
    label: str
    lines: Mapping[str, tuple[str, Mapping[str, Any]]]
    scales: tuple[str, str] = ("linear", "linear")


def _edge_panel(title: str, quantity: str) -> Panel:
    lines = {"front away from the emitter": "edge_lit", "front on its side, shadow": "edge_shadowed"}
    curves: dict[str, tuple[str, Mapping[str, Any]]] = {meaning: (curve, {}) for meaning, curve in lines.items()}
    return Panel(title, quantity, "step_mm", "step (mm), front at 0.75 m", curves, ("log", "linear"))


SIGMA = "temporal_sigma_mm"
ROOM = {f"multipath {word}": ("room", {"multipath": word == "on"}) for word in ("on", "off")}
FIGURES: dict[str, tuple[str, str, str, tuple[Panel, ...]]] = {
    "noise": (
        "Temporal noise",
        "Standard deviation over frames of one pixel's z, rms over pixels about the axis, noise alone, with 95 % "
        "intervals of a jackknife over frames. Hollow: published.",
        "temporal deviation (mm)",
        (
            Panel("albedo 0.8", SIGMA, "distance_m", "distance (m)", {"": ("distance", {})}, ("linear", "log")),
            Panel("1.5 m", SIGMA, "albedo", "albedo", {"": ("albedo", {})}, ("log", "log")),
            Panel("1.5 m, albedo 0.8", SIGMA, "angle_deg", "incidence (°)", {"": ("angle", {})}, ("linear", "log")),
        ),
    ),
    "correlation": (
        "Spatial correlation of the noise",
        "Correlation of the temporal noise of pixels so far apart, at 1.5 m and albedo 0.8. Hollow: published.",
        "correlation of the noise",
        tuple(
            Panel(f"along {axis}", "noise_correlation", f"lag_{axis}_px", "lag (pixels)", {"": (curve, {})})
            for axis, curve in (("x", "correlation_x"), ("y", "correlation_y"))
        ),
    ),
    "bias": (
        "Bias, multipath off and on",
        "Left: mean error of z of unit 1 an hour after power-on on a plane without multipath. Right: a board of "
        "400 x 300 mm on a table with a wall behind, without noise and traits of a unit; bars: the render's noise.",
        "bias of z (mm)",
        (
            Panel("one unit, plane, direct light", "bias_mm", "distance_m", "distance (m)", {"": ("bias", {})}),
            Panel("board in a room", "board_bias_mm", "distance_m", "distance (m)", ROOM),
        ),
    ),
    "edges": (
        "Edges",
        "A straight edge, its front at 0.75 m, slightly off the pixel grid; albedo 0.6. Flying: off both surfaces by "
        "more than four deviations of the noise and a tenth of the step; not told where noise hides the step. Eroded: "
        "the pixel's central ray meets the surface and the camera does not show it; shadow included.",
        "width (px)",
        (
            _edge_panel("without a range", "edge_gap_px"),
            _edge_panel("flying", "flying_pixels_px"),
            _edge_panel("front eroded", "front_erosion_px"),
            _edge_panel("back eroded", "back_erosion_px"),
        ),
    ),
    "survival": (
        "The smallest step that survives the camera's filter",
        "Round plateaus before a plane, each at another place within its pixel: the lowest step of which at least half "
        "is seen in the middle, in most of them. No point: none of those tried, up to 500 mm.",
        "smallest surviving step (mm)",
        (Panel("at 0.75 m", "smallest_step_mm", "diameter_px", "⌀ (px)", {"": ("survival", {})}, ("linear", "log")),),
    ),
    "valid": (
        "Valid pixels",
        "Share of the pixels about the axis that have a range, with every gate of the camera.",
        "valid fraction",
        tuple(
            Panel(f"albedo {a:g}", "valid_fraction", "distance_m", "distance (m)", {"": ("valid", {"albedo": a})})
            for a in (0.1, 0.6)
        ),
    ),
}
"""Title, caption, label of the vertical axis and panels of each figure, in the page's order."""


def all_figures(cameras: Mapping[str, str], points: Sequence[MeasuredPoint], scores: Sequence[Score]) -> dict[str, str]:
    """Every figure as SVG text by name. ``cameras``: titles by name, in the order of colours."""

    shown = ("curve", "quantity", "camera", "simulated", "low", "high", *CONDITIONS)
    table = CURVES.frame(points).reindex(columns=shown)
    looks = zip(cycle(COLOURS), cycle(MARKERS), strict=False)
    styles = {one: {"color": c, "marker": m, "markersize": 4} for one, (c, m) in zip(cameras, looks, strict=False)}

    def drawn(name: str, title: str, label: str, panels: Sequence[Panel]) -> str:
        def draw(figure: Canvas) -> None:
            rows = 1 if len(panels) < 4 else 2
            axes = figure.subplots(rows, len(panels) // rows, squeeze=False).ravel()
            for axis, panel in zip(axes, panels, strict=True):
                of_panel = table[table["quantity"] == panel.quantity]
                for camera in cameras:
                    for dash, (meaning, (curve, fixed)) in zip(DASHES, panel.lines.items(), strict=False):
                        part = of_panel[(of_panel["camera"] == camera) & (of_panel["curve"] == curve)]
                        part = part[np.isfinite(part["simulated"])]
                        for key, value in fixed.items():
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
                axis.set(title=panel.title, xlabel=panel.label, ylabel=label)
                axis.set(xscale=panel.scales[0], yscale=panel.scales[1])
                for scale, ticks in zip(panel.scales, (axis.xaxis, axis.yaxis), strict=True):
                    if scale == "log":
                        plain_decades(ticks)
                if not (of_panel["curve"].isin([curve for curve, _ in panel.lines.values()])).any():
                    axis.text(0.5, 0.5, "not measured", transform=axis.transAxes, ha="center")
            handles, labels = axes[-1].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside upper left", ncols=3, columnspacing=1.2, fontsize=8)

        return svg(name, (10.5, 4.2 if len(panels) < 4 else 7.6), title, draw)

    return {name: drawn(name, title, label, panels) for name, (title, _, label, panels) in FIGURES.items()}


def _draw_published(axis: Any, panel: Panel, score: Score, styles: Mapping[str, Any]) -> None:
    """Mark a published value hollow if it is of the panel's quantity, under the conditions of the panel's curve."""
    entry, conditions = score.figure.entry, score.figure.conditions.to_data()
    usual = {**type(score.figure.conditions)().to_data(), "lag_x_px": 0, "lag_y_px": 0}
    differs = {key for key, value in conditions.items() if value != usual[key]}
    if entry.quantity == panel.quantity and entry.published.value is not None and differs <= {panel.key}:
        hollow = {"markersize": 11, "markerfacecolor": "none", "linestyle": "none", "markeredgewidth": 1.6}
        axis.plot(conditions[panel.key], entry.published.value, **{**styles[entry.camera], **hollow})


METHOD = (
    "Each quantity is measured on simulated frames like that of a real camera, under the conditions that the source "
    "states. A figure passes where the simulated value lies within the published tolerance or bound; tolerances were "
    "fixed beforehand, and where one was changed after a first run its note says so. Figures marked as calibration are "
    "no test: the camera's file was, or may be, fitted to them. Tags: R read in the named public source, D derived "
    "from such, S one secondary source, W measured on public captures, M a guess."
)


def run_scorecard(options: argparse.Namespace, command: str) -> int:
    """Measure, print and write the scorecard. Returns 1 where a figure that passed in the baseline fails, else 0.
    Raises UserError for an unknown camera, a faulty figures file or baseline, and a folder that cannot be written."""
    began = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.quick and options.update_baseline:
        raise UserError("--quick and --update-baseline: a baseline needs the whole effort", fix="leave one of them out")
    # a quick look is judged by a baseline that is named only
    baseline_file = options.baseline or (None if options.quick else BASELINE_FILE)
    every = read_figures(options.figures or FIGURES_FILE)
    titles = {name: load_camera(name).title for name in (dict.fromkeys(options.camera) or camera_names())}
    figures = tuple(figure for figure in every if figure.entry.camera in titles)
    baseline = read_baseline(baseline_file) if baseline_file else {}
    points = tuple(curve_points(QUICK_GRIDS if options.quick else FULL_GRIDS))
    wanted = requests_of(tuple(titles), figures, points)
    found = measured(wanted, QUICK if options.quick else FULL, options.out / ".cache" / "renders", options.jobs)
    simulated = {each.name: found[each.entry.camera, each.quantity.name, each.conditions] for each in figures}
    scores = judged(figures, simulated, baseline)
    curves = [
        MeasuredPoint(camera, point, found[camera, point.quantity, point.conditions])
        for camera in titles
        for point in points
    ]
    provenance = {
        "results_version": RESULTS_VERSION,
        **record(command),
        "cameras": {name: camera_digest(load_camera(name)) for name in titles},
        "figures": str(options.figures or FIGURES_FILE),
        "baseline": str(baseline_file or "none"),
        "effort": "quick" if options.quick else "full",
        "seconds": round(time.perf_counter() - began, 1),
    }
    answer = _answer(scores, options.quick)
    groups = [
        (title, SCORES.grid(own, heads={"camera": ""}).html() if own else "")
        for camera, title in titles.items()
        for own in [[score for score in scores if score.figure.entry.camera == camera]]
    ]
    drawn = all_figures(titles, curves, scores)
    page = template("scorecard.html", Path(__file__).parent).render(
        answer=answer,
        method=METHOD,
        groups=groups,
        figures=[(title, name, drawn[name], caption) for name, (title, caption, *_) in FIGURES.items()],
        quantities=QUANTITIES.values(),
        provenance=[(key, plain(value)) for key, value in provenance.items()],
    )
    write_table(options.out, SCORES, SCORES.frame(scores))
    write_table(options.out, CURVES, CURVES.frame(curves))
    write_text(options.out / "provenance.json", json.dumps(provenance, indent=2) + "\n")
    write_text(options.out / "scorecard.html", page)
    show([SCORES.grid(scores, terminal=True)])
    print(answer)
    print(f"wrote {options.out / 'scorecard.html'}")
    names = [figure.name for figure in every]
    if options.update_baseline and baseline_file:
        write_baseline(baseline_file, scores, names)
        print(f"wrote {baseline_file}")
        return 0
    return _said_what_fell_behind(scores, baseline, names) if baseline_file else 0


def _said_what_fell_behind(scores: Sequence[Score], baseline: Mapping[str, bool], every: Sequence[str]) -> int:
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
        low, high = score.figure.entry.published.limits
        told = f"{score.figure.what()}): simulated {score.simulated.value:.4g}, passes from {low:g} to {high:g}"
        print(f"passed in the baseline and fails now: {score.figure.name} ({told}", file=sys.stderr)
    return 1 if fallen or gone else 0


def _answer(scores: Sequence[Score], quick: bool) -> str:
    """One sentence: how many figures pass, apart for those that test and those that calibrate."""
    test, fitted = ([one.passes for one in scores if one.figure.entry.calibration == of] for of in (False, True))
    text = "A quick look, with too few frames for a judgement: " if quick else ""
    text += f"{sum(test)} of {len(test)} published figures that the models were not fitted to hold"
    text += f", and {sum(fitted)} of {len(fitted)} that they were or may be fitted to."
    regressed = [score.figure.name for score in scores if score.regressed]
    return text + (f" Passed before and fail now: {', '.join(regressed)}." if regressed else "")
