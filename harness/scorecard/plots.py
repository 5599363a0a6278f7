"""The scorecard's figures, one function each: SVG text from the measured curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.report import canvas
from harness.scorecard.curves import CurvePoint
from harness.scorecard.estimate import Estimate
from harness.scorecard.judge import Score
from harness.scorecard.run import Request

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

COLOURS = (canvas.BLUE, canvas.ORANGE, canvas.GREEN, canvas.PURPLE, canvas.RED, canvas.SKY)
MARKERS = ("o", "s", "^", "D", "v", "P")
EDGE_KINDS: dict[str, tuple[Any, str]] = {
    "edge_lit": ("-", "front away from the emitter"),
    "edge_shadowed": ("--", "front on its side, shadow"),
}
EDGE_PANELS = (
    ("edge_gap_px", "without a range"),
    ("flying_pixels_px", "flying"),
    ("front_erosion_px", "front eroded"),
    ("back_erosion_px", "back eroded"),
)


@dataclass(frozen=True)
class Curves:
    """Everything measured: cameras in order with their titles, the points, and the estimates."""

    cameras: Mapping[str, str]
    points: Sequence[CurvePoint]
    found: Mapping[Request, Estimate]

    def along(
        self, curve: str, quantity: str, camera: str, key: str, **fixed: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(x, values, intervals (2, n)) of one camera's points of a curve, ordered by the condition ``key``."""
        rows = []
        for point in self.points:
            data = point.conditions.to_data()
            if (point.curve, point.quantity) == (curve, quantity) and all(data[k] == v for k, v in fixed.items()):
                estimate = self.found[Request(camera, quantity, point.conditions)]
                rows.append((float(data[key]), estimate.value, estimate.interval.low, estimate.interval.high))
        table = np.array(sorted(rows)).reshape(-1, 4)
        return table[:, 0], table[:, 1], table[:, 2:].T

    def style(self, camera: str) -> dict[str, Any]:
        """Colour and marker of a camera, the same in every figure."""
        at = list(self.cameras).index(camera) % len(COLOURS)
        return {"color": COLOURS[at], "marker": MARKERS[at], "markersize": 4}


def all_figures(curves: Curves, scores: Sequence[Score]) -> dict[str, str]:
    """Every figure for which there are points, by name."""
    drawn = {
        "noise": ("distance", lambda: noise_figure(curves, scores)),
        "correlation": ("correlation_x", lambda: correlation_figure(curves, scores)),
        "valid": ("valid", lambda: valid_figure(curves)),
        "edges": ("edge_lit", lambda: edges_figure(curves)),
        "survival": ("survival", lambda: survival_figure(curves)),
        "bias": ("bias", lambda: bias_figure(curves)),
    }
    known = {point.curve for point in curves.points}
    return {name: draw() for name, (curve, draw) in drawn.items() if curve in known}


def noise_figure(curves: Curves, scores: Sequence[Score]) -> str:
    """Temporal deviation against distance, albedo, angle and amplitude, with published values beside the first."""

    def draw(figure: Canvas) -> None:
        axes = figure.subplots(2, 2).ravel()
        for camera in curves.cameras:
            for axis, curve, key, factor in (
                (axes[0], "distance", "distance_m", 1.0),
                (axes[1], "albedo", "albedo", 100.0),
                (axes[2], "angle", "angle_deg", 1.0),
            ):
                x, y, low_high = curves.along(curve, "temporal_sigma_mm", camera, key)
                _line(axis, factor * x, y, low_high, curves, camera)
            _against_amplitude(axes[3], curves, camera)
        _published_sigma(axes[0], curves, scores)
        _sigma_axes(axes)
        _legend(figure, axes[0])

    return canvas.svg("noise", (10.5, 7.4), "Temporal deviation of all cameras in four panels", draw)


def _against_amplitude(axis: Axes, curves: Curves, camera: str) -> None:
    """All points of the three other panels, against the amplitude by its value at 1.5 m and albedo 0.8."""
    parts = []
    for curve, key in (("distance", "distance_m"), ("albedo", "albedo"), ("angle", "angle_deg")):
        _, sigma, _ = curves.along(curve, "temporal_sigma_mm", camera, key)
        _, amplitude, _ = curves.along(curve, "amplitude", camera, key)
        parts.append(np.column_stack([amplitude, sigma]))
    table = np.concatenate(parts)
    x, y, _ = curves.along("distance", "amplitude", camera, "distance_m")
    middle = float(np.interp(1.5, x, y))
    table = table[np.isfinite(table).all(axis=1)]
    if table.size and middle > 0:
        axis.plot(table[:, 0] / middle, table[:, 1], linestyle="none", **curves.style(camera))


def _published_sigma(axis: Axes, curves: Curves, scores: Sequence[Score]) -> None:
    """Published deviations with a value, hollow, at their distances; those of a matte light wall only."""
    for score in scores:
        entry, data = score.figure.entry, score.figure.conditions.to_data()
        plain = entry.quantity == "temporal_sigma_mm" and data["albedo"] == 0.8 and data["angle_deg"] == 0
        if plain and entry.published.value is not None and entry.camera in curves.cameras:
            style = {**curves.style(entry.camera), "markersize": 11, "markerfacecolor": "none", "markeredgewidth": 1.6}
            axis.plot(data["distance_m"], entry.published.value, linestyle="none", **style)


def _sigma_axes(axes: Sequence[Axes]) -> None:
    titles = ("distance, albedo 80 %", "albedo, 1.5 m", "angle of incidence, 1.5 m, albedo 80 %", "amplitude")
    labels = ("distance (m)", "albedo (%)", "angle of incidence (°)", "amplitude by that at 1.5 m, 80 %")
    for axis, title, label in zip(axes, titles, labels, strict=True):
        axis.set_title(f"against {title}")
        axis.set_xlabel(label)
        axis.set_ylabel("temporal deviation (mm)")
        _logarithmic(axis, "y")
    for axis in (axes[1], axes[3]):
        _logarithmic(axis, "x")


def correlation_figure(curves: Curves, scores: Sequence[Score]) -> str:
    """Correlation of the temporal noise along x and y, with published values of frontal planes hollow."""

    def draw(figure: Canvas) -> None:
        axes = figure.subplots(1, 2, sharey=True)
        for axis, along in zip(axes, "xy", strict=True):
            for camera in curves.cameras:
                x, y, low_high = curves.along(f"correlation_{along}", "noise_correlation", camera, f"lag_{along}_px")
                _line(axis, x, y, low_high, curves, camera)
            for score in scores:
                entry, data = score.figure.entry, score.figure.conditions.to_data()
                other = "y" if along == "x" else "x"
                if entry.quantity != "noise_correlation" or data[f"lag_{other}_px"] or entry.published.value is None:
                    continue
                style = {**curves.style(entry.camera), "markersize": 11, "markerfacecolor": "none"}
                axis.plot(data[f"lag_{along}_px"], entry.published.value, linestyle="none", **style)
            axis.axhline(0, color=canvas.GREY, linewidth=0.8)
            axis.set_title(f"along {along}")
            axis.set_xlabel("lag (pixels)")
        axes[0].set_ylabel("correlation of the noise")
        _legend(figure, axes[0])

    return canvas.svg("correlation", (10.5, 3.9), "Correlation of the noise along both axes", draw)


def valid_figure(curves: Curves) -> str:
    """Valid fraction over distance and albedo, one map a camera."""

    def draw(figure: Canvas) -> None:
        axes = figure.subplots(1, len(curves.cameras), squeeze=False, sharey=True)[0]
        for axis, (camera, title) in zip(axes, curves.cameras.items(), strict=True):
            table = {}
            for point in curves.points:
                if point.curve == "valid":
                    data = point.conditions.to_data()
                    table[data["albedo"], data["distance_m"]] = curves.found[
                        Request(camera, point.quantity, point.conditions)
                    ].value
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

    size = (max(3.7 * len(curves.cameras), 5.0), 3.9)
    return canvas.svg("valid", size, "Share of valid pixels against distance and albedo", draw)


def edges_figure(curves: Curves) -> str:
    """What a step across x makes of the pixels at an edge, against the step."""

    def draw(figure: Canvas) -> None:
        axes = figure.subplots(2, 2, sharex=True).ravel()
        for axis, (quantity, title) in zip(axes, EDGE_PANELS, strict=True):
            for camera in curves.cameras:
                for kind, (dash, _) in EDGE_KINDS.items():
                    x, y, low_high = curves.along(kind, quantity, camera, "step_mm")
                    _line(axis, x, y, low_high, curves, camera, dash)
            axis.set_title(title)
            axis.set_ylabel("width (px)")
            axis.set_ylim(bottom=0)
            _logarithmic(axis, "x")
        for axis in axes[2:]:
            axis.set_xlabel("step (mm), front at 0.75 m")
        _legend(figure, axes[0], EDGE_KINDS)

    return canvas.svg("edges", (10.5, 7.4), "Edge behaviour against the step in four panels", draw)


def survival_figure(curves: Curves) -> str:
    """Smallest surviving step against the plateau's size; arrows where none of those tried survives."""

    def draw(figure: Canvas) -> None:
        axis = figure.subplots()
        for number, camera in enumerate(curves.cameras):
            x, y, _ = curves.along("survival", "smallest_step_mm", camera, "diameter_px")
            style = curves.style(camera)
            lost = ~np.isfinite(y)
            axis.plot(x[~lost], y[~lost], label=curves.cameras[camera], **style)
            axis.plot(
                x[lost],
                np.full(lost.sum(), 580 * 1.17**number),
                linestyle="none",
                **{**style, "marker": "x", "markersize": 8},
            )
        axis.axhline(500, color=canvas.GREY, linewidth=0.8, linestyle=":")
        axis.set_xlabel("diameter of the plateau (px), at 0.75 m")
        axis.set_ylabel("smallest surviving step (mm)")
        axis.set_ylim(1.5, 1300)
        _logarithmic(axis, "y")
        _legend(figure, axis)

    return canvas.svg("survival", (10.5, 3.9), "Smallest surviving step against the plateau's size", draw)


def bias_figure(curves: Curves) -> str:
    """Bias of one unit against distance, and bias of a board in a room with multipath off and on."""

    def draw(figure: Canvas) -> None:
        left, right = figure.subplots(1, 2)
        for camera in curves.cameras:
            x, y, low_high = curves.along("bias", "bias_mm", camera, "distance_m")
            _line(left, x, y, low_high, curves, camera)
            for on, dash in ((False, ":"), (True, "-")):
                x, y, low_high = curves.along("room", "board_bias_mm", camera, "distance_m", multipath=on)
                if x.size:
                    _line(right, x, y, low_high, curves, camera, dash)
        for axis, title in ((left, "one unit, plane, direct light"), (right, "board in a room, no unit's traits")):
            axis.axhline(0, color=canvas.GREY, linewidth=0.8)
            axis.set_title(title)
            axis.set_xlabel("distance (m)")
            axis.set_ylabel("bias of z (mm)")
        if not right.get_lines()[:-1]:
            right.text(0.5, 0.6, "not measured", transform=right.transAxes, ha="center", color=canvas.GREY)
        _legend(figure, left, {"on": ("-", "multipath on"), "off": (":", "multipath off")})

    return canvas.svg("bias", (10.5, 4.3), "Bias against distance, and with multipath", draw)


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


def _legend(figure: Canvas, axis: Axes, dashes: Mapping[str, tuple[Any, str]] | None = None) -> None:
    """Cameras, and what dashes mean, in one row above the panels."""
    from matplotlib.lines import Line2D

    handles, labels = axis.get_legend_handles_labels()
    once = dict(zip(reversed(labels), reversed(handles), strict=True))
    once = dict(reversed(once.items()))
    for dash, meaning in (dashes or {}).values():
        once[meaning] = Line2D([], [], color=canvas.GREY, linestyle=dash)
    figure.legend(once.values(), once.keys(), loc="outside upper left", ncols=len(once), columnspacing=1.4)
