"""The scorecard's figures, one function each: SVG text from the measured curves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.report import canvas
from harness.scorecard.bench import Reading
from harness.scorecard.figures import Score
from harness.scorecard.measure import CurvePoint, Request

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

COLOURS = (canvas.BLUE, canvas.ORANGE, canvas.GREEN, canvas.PURPLE, canvas.RED, canvas.SKY)
MARKERS = ("o", "s", "^", "D", "v", "P")
LIT = ("-", "front away from the emitter")
SHADOWED = ("--", "front on its side, shadow")
EDGE_PANELS = (
    ("edge_gap_px", "without a range"),
    ("flying_pixels_px", "flying"),
    ("front_erosion_px", "front eroded"),
    ("back_erosion_px", "back eroded"),
)
NOISE_PANELS = (
    ("distance", "distance_m", 1.0, "distance, albedo 80 %", "distance (m)"),
    ("albedo", "albedo", 100.0, "albedo, 1.5 m", "albedo (%)"),
    ("angle", "angle_deg", 1.0, "angle of incidence, 1.5 m, albedo 80 %", "angle of incidence (°)"),
)
"""Curve, condition, factor of the axis, title, label."""


@dataclass(frozen=True)
class Curves:
    """Everything measured: cameras in order with their titles, the points, and the readings."""

    cameras: Mapping[str, str]
    points: Sequence[CurvePoint]
    found: Mapping[Request, Reading]

    def along(
        self, curve: str, quantity: str, camera: str, key: str, **fixed: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(x, values, intervals (2, n)) of one camera's points of a curve, ordered by the condition ``key``."""
        rows = []
        for point in self.points:
            data = point.conditions.to_data()
            if (point.curve, point.quantity) == (curve, quantity) and all(data[k] == v for k, v in fixed.items()):
                reading = self.found[Request(camera, quantity, point.conditions)]
                rows.append((float(data[key]), reading.value, reading.interval.low, reading.interval.high))
        table = np.array(sorted(rows)).reshape(-1, 4)
        return table[:, 0], table[:, 1], table[:, 2:].T

    def style(self, camera: str) -> dict[str, Any]:
        """Colour and marker of a camera, the same in every figure."""
        at = list(self.cameras).index(camera) % len(COLOURS)
        return {"color": COLOURS[at], "marker": MARKERS[at], "markersize": 4}

    def published(self, scores: Sequence[Score], quantity: str) -> Iterator[tuple[Mapping[str, Any], float, Any]]:
        """Conditions, published value and hollow marker of every figure of a quantity that is a value."""
        for score in scores:
            entry = score.figure.entry
            if entry.quantity == quantity and entry.published.value is not None and entry.camera in self.cameras:
                style = {**self.style(entry.camera), "markersize": 11, "markerfacecolor": "none", "linestyle": "none"}
                yield score.figure.conditions.to_data(), entry.published.value, style


Draw = Callable[[Any, Curves, Sequence[Score]], None]


def all_figures(curves: Curves, scores: Sequence[Score]) -> dict[str, str]:
    """Every figure for which there are points, as SVG text by name."""
    tall, flat = (10.5, 7.4), (10.5, 3.9)
    wide = (max(3.7 * len(curves.cameras), 5.0), 3.9)
    plans: dict[str, tuple[str, tuple[float, float], str, Draw]] = {
        "noise": ("distance", tall, "Temporal deviation of all cameras in four panels", _noise),
        "correlation": ("correlation_x", flat, "Correlation of the noise along both axes", _correlation),
        "valid": ("valid", wide, "Share of valid pixels against distance and albedo", _valid),
        "edges": ("edge_lit", tall, "Edge behaviour against the step in four panels", _edges),
        "survival": ("survival", flat, "Smallest surviving step against the plateau's size", _survival),
        "bias": ("bias", (10.5, 4.3), "Bias against distance, and with multipath", _bias),
    }
    known = {point.curve for point in curves.points}
    return {
        name: canvas.svg(name, size, title, lambda figure, draw=draw: draw(figure, curves, scores))  # type: ignore[misc]
        for name, (curve, size, title, draw) in plans.items()
        if curve in known
    }


def _noise(figure: Canvas, curves: Curves, scores: Sequence[Score]) -> None:
    """Temporal deviation against distance, albedo, angle and amplitude, with published values beside the first.

    The last panel holds the points of the others, against the amplitude by its value at 1.5 m and albedo 0.8.
    """
    axes = figure.subplots(2, 2).ravel()
    for camera in curves.cameras:
        parts = []
        for axis, (curve, key, factor, _, _) in zip(axes, NOISE_PANELS, strict=False):
            x, sigma, low_high = curves.along(curve, "temporal_sigma_mm", camera, key)
            _line(axis, factor * x, sigma, low_high, curves, camera)
            parts.append(np.column_stack([curves.along(curve, "amplitude", camera, key)[1], sigma]))
        table = np.concatenate(parts)
        x, y, _ = curves.along("distance", "amplitude", camera, "distance_m")
        middle = float(np.interp(1.5, x, y))
        table = table[np.isfinite(table).all(axis=1)]
        if table.size and middle > 0:
            axes[3].plot(table[:, 0] / middle, table[:, 1], linestyle="none", **curves.style(camera))
    for data, value, style in curves.published(scores, "temporal_sigma_mm"):
        if data["albedo"] == 0.8 and data["angle_deg"] == 0:  # a matte light wall, as in the first panel
            axes[0].plot(data["distance_m"], value, markeredgewidth=1.6, **style)
    titles = [(title, label) for *_, title, label in NOISE_PANELS]
    for axis, (title, label) in zip(axes, [*titles, ("amplitude", "amplitude by that at 1.5 m, 80 %")], strict=True):
        axis.set(title=f"against {title}", xlabel=label, ylabel="temporal deviation (mm)")
        _logarithmic(axis, "y")
    for axis in (axes[1], axes[3]):
        _logarithmic(axis, "x")
    _legend(figure, axes[0])


def _correlation(figure: Canvas, curves: Curves, scores: Sequence[Score]) -> None:
    """Correlation of the temporal noise along x and y, with published values of frontal planes hollow."""
    axes = figure.subplots(1, 2, sharey=True)
    for axis, along, other in zip(axes, "xy", "yx", strict=True):
        for camera in curves.cameras:
            x, y, low_high = curves.along(f"correlation_{along}", "noise_correlation", camera, f"lag_{along}_px")
            _line(axis, x, y, low_high, curves, camera)
        for data, value, style in curves.published(scores, "noise_correlation"):
            if not data[f"lag_{other}_px"]:
                axis.plot(data[f"lag_{along}_px"], value, **style)
        axis.axhline(0, color=canvas.GREY, linewidth=0.8)
        axis.set(title=f"along {along}", xlabel="lag (pixels)")
    axes[0].set_ylabel("correlation of the noise")
    _legend(figure, axes[0])


def _valid(figure: Canvas, curves: Curves, scores: Sequence[Score]) -> None:
    """Valid fraction over distance and albedo, one map a camera."""
    axes = figure.subplots(1, len(curves.cameras), squeeze=False, sharey=True)[0]
    for axis, (camera, title) in zip(axes, curves.cameras.items(), strict=True):
        table = {}
        for point in curves.points:
            if point.curve == "valid":
                data = point.conditions.to_data()
                reading = curves.found[Request(camera, point.quantity, point.conditions)]
                table[data["albedo"], data["distance_m"]] = reading.value
        albedos, distances = (sorted({key[k] for key in table}) for k in (0, 1))
        shares = np.array([[table[a, d] for d in distances] for a in albedos])
        axis.imshow(100 * shares, origin="lower", aspect="auto", cmap="Blues", vmin=0, vmax=100)
        for (row, column), share in np.ndenumerate(shares):
            ink = "white" if share > 0.55 else canvas.INK
            axis.text(column, row, f"{100 * share:.0f}", ha="center", va="center", color=ink, fontsize=8)
        axis.set_xticks(range(len(distances)), [f"{d:g}" for d in distances])
        axis.set_yticks(range(len(albedos)), [f"{100 * a:g}" for a in albedos])
        axis.grid(False)
        axis.set_title(title, fontsize=9.5)
        axis.set_xlabel("distance (m)")
    axes[0].set_ylabel("albedo (%)")


def _edges(figure: Canvas, curves: Curves, scores: Sequence[Score]) -> None:
    """Widths at an edge across x against the step."""
    axes = figure.subplots(2, 2, sharex=True).ravel()
    for axis, (quantity, title) in zip(axes, EDGE_PANELS, strict=True):
        for camera in curves.cameras:
            for curve, (dash, _) in (("edge_lit", LIT), ("edge_shadowed", SHADOWED)):
                _line(axis, *curves.along(curve, quantity, camera, "step_mm"), curves, camera, dash)
        axis.set(title=title, ylabel="width (px)")
        axis.set_ylim(bottom=0)
        _logarithmic(axis, "x")
    for axis in axes[2:]:
        axis.set_xlabel("step (mm), front at 0.75 m")
    _legend(figure, axes[0], (LIT, SHADOWED))


def _survival(figure: Canvas, curves: Curves, scores: Sequence[Score]) -> None:
    """Smallest surviving step against the plateau's size; crosses where none of those tried survives."""
    axis = figure.subplots()
    for number, (camera, title) in enumerate(curves.cameras.items()):
        x, y, _ = curves.along("survival", "smallest_step_mm", camera, "diameter_px")
        style, lost = curves.style(camera), ~np.isfinite(y)
        axis.plot(x[~lost], y[~lost], label=title, **style)
        crosses = {**style, "marker": "x", "markersize": 8, "linestyle": "none"}
        axis.plot(x[lost], np.full(lost.sum(), 580 * 1.17**number), **crosses)
    axis.axhline(500, color=canvas.GREY, linewidth=0.8, linestyle=":")
    axis.set(xlabel="diameter of the plateau (px), at 0.75 m", ylabel="smallest surviving step (mm)", ylim=(1.5, 1300))
    _logarithmic(axis, "y")
    _legend(figure, axis)


def _bias(figure: Canvas, curves: Curves, scores: Sequence[Score]) -> None:
    """Bias of one unit against distance, and bias of a board in a room with multipath off and on."""
    left, right = figure.subplots(1, 2)
    for camera in curves.cameras:
        _line(left, *curves.along("bias", "bias_mm", camera, "distance_m"), curves, camera)
        for on, dash in ((False, ":"), (True, "-")):
            x, y, low_high = curves.along("room", "board_bias_mm", camera, "distance_m", multipath=on)
            if x.size:
                _line(right, x, y, low_high, curves, camera, dash)
    if not right.get_lines():
        right.text(0.5, 0.6, "not measured", transform=right.transAxes, ha="center", color=canvas.GREY)
    for axis, title in ((left, "one unit, plane, direct light"), (right, "board in a room, no unit's traits")):
        axis.axhline(0, color=canvas.GREY, linewidth=0.8)
        axis.set(title=title, xlabel="distance (m)", ylabel="bias of z (mm)")
    _legend(figure, left, (("-", "multipath on"), (":", "multipath off")))


def _line(
    axis: Axes, x: np.ndarray, y: np.ndarray, low_high: np.ndarray, curves: Curves, camera: str, dash: str = "-"
) -> None:
    """One camera's curve with its 95 % intervals as bars."""
    known = np.isfinite(y)
    style = curves.style(camera)
    errors = np.nan_to_num(np.abs(low_high - y))[:, known]
    axis.errorbar(x[known], y[known], yerr=errors, linestyle=dash, elinewidth=1, label=curves.cameras[camera], **style)


def _logarithmic(axis: Axes, which: str) -> None:
    """A logarithmic axis with plain numbers at 1, 2 and 5."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    getattr(axis, f"set_{which}scale")("log")
    ticks = axis.xaxis if which == "x" else axis.yaxis
    low, high = axis.dataLim.intervalx if which == "x" else axis.dataLim.intervaly
    ticks.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 300 * max(low, 1e-9) else (1,)))
    ticks.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ticks.set_minor_formatter(NullFormatter())


def _legend(figure: Canvas, axis: Axes, dashes: Sequence[tuple[Any, str]] = ()) -> None:
    """Cameras, and the meaning of dashes, in one row above the panels."""
    from matplotlib.lines import Line2D

    handles, labels = axis.get_legend_handles_labels()
    once = {label: handle for handle, label in reversed(list(zip(handles, labels, strict=True)))}
    once = dict(reversed(once.items()))
    once |= {meaning: Line2D([], [], color=canvas.GREY, linestyle=dash) for dash, meaning in dashes}
    figure.legend(once.values(), once.keys(), loc="outside upper left", ncols=len(once), columnspacing=1.4)
