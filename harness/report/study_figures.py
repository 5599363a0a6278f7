"""The figures of a study's page: detection curves, limits against axes, operating curves."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill, shorten
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from harness.evaluation.study.curves import PRO_LIMIT, FreeResponse, PixelCurves, Roc
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.result import AxisLine, SetUpResult
from harness.report.blocks import COLOURS, GREY, MARKERS, PALE, svg
from harness.report.pod import MOST_MARKS, plain, plain_numbers
from harness.tables import study
from harness.tables.limits import is_within_sizes, limit_sentence, name_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_CURVES = 6
"""Most set-ups whose curves are drawn."""
STYLES = ("-", "--", ":", "-.")
LONGEST_NAME = 60
"""Characters of a set-up's name on a line of a legend."""
ROW_POD = 0.035
"""Height of a set-up's rows of hits above 1 and of misses below 0, in units of POD."""


def with_room(set_ups: Sequence[SetUpResult]) -> list[SetUpResult]:
    """Return the set-ups for figures: all, or `MOST_CURVES` spread evenly from the smallest limit
    to the largest."""
    by_limit = sorted(set_ups, key=lambda set_up: set_up.limit.a90_95.value)
    count = min(MOST_CURVES, len(by_limit))
    ranks = np.linspace(0, len(by_limit) - 1, count).round().astype(int)
    chosen = {id(by_limit[rank]) for rank in ranks}
    return [set_up for set_up in set_ups if id(set_up) in chosen]


def _legend_name(limit: SetUpLimit) -> str:
    return plain(fill(name_of(limit), LONGEST_NAME))


def _legend_lines(limits: Sequence[SetUpLimit]) -> int:
    """Return the number of lines of all names in a legend."""
    return sum(-(-len(name_of(limit)) // LONGEST_NAME) for limit in limits)


# ---------------------------------------------------------------- detection curves


def overlay_figure(limits: Sequence[SetUpLimit]) -> str:
    """Return the figure of `draw_overlay` for a page."""
    lines = _legend_lines(limits) / _names_across(limits)
    sentences = " ".join(limit_sentence(limit) for limit in limits)
    size_in = (5.4, 3.4 + 0.2 * lines)
    return svg("overlay", size_in, sentences, lambda figure: draw_overlay(figure, limits))


def _names_across(limits: Sequence[SetUpLimit]) -> int:
    longest = max(len(name_of(limit)) for limit in limits)
    return 2 if longest <= LONGEST_NAME // 2 else 1


def draw_overlay(figure: Figure, limits: Sequence[SetUpLimit]) -> None:
    """Draw the curves and bands of all set-ups over a common axis of sizes, a mark at each a90/95
    within it, and each inspection as a stroke at its true size: hits above 1, misses below 0, with
    a row for each set-up."""
    axes = figure.subplots()
    axes.axhspan(1, 2, color=PALE, lw=0)
    axes.axhspan(-1, 0, color=PALE, lw=0)
    for number, limit in enumerate(limits):
        colour = COLOURS[number % len(COLOURS)]
        line = STYLES[number // len(COLOURS) % len(STYLES)]
        _draw_curve(axes, limit, colour, line)
        _draw_inspections(axes, limit, number, colour)
    axes.axhline(0.9, color=GREY, lw=0.8, ls=":")
    room = ROW_POD * len(limits)
    axes.set(xlim=_span(limits), ylim=(-room, 1 + room), yticks=np.linspace(0, 1, 6))
    axes.set_xlabel(f"{limits[0].record.inspected.limit_of} (mm)")
    axes.set_ylabel("probability of detection")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=_names_across(limits))


def _draw_curve(axes: Axes, limit: SetUpLimit, colour: str, line: str) -> None:
    name = _legend_name(limit)
    if limit.statement is None:
        axes.plot([], [], color=colour, label=f"{name}: no curve")
    else:
        sizes_mm = limit.statement.sizes
        lower, upper = limit.statement.band
        axes.fill_between(sizes_mm, lower, upper, color=colour, alpha=0.1, lw=0)
        axes.plot(sizes_mm, limit.statement.curve.pod(sizes_mm), line, color=colour, label=name)
    if is_within_sizes(limit):
        axes.plot(
            limit.a90_95.value,
            0.9,
            "o",
            color=colour,
            ms=6,
            mec="white",
            zorder=5,
        )


def _draw_inspections(axes: Axes, limit: SetUpLimit, number: int, colour: str) -> None:
    inspected = limit.record.inspected
    inspections = len(inspected.hit)
    rise = ROW_POD * (number + 0.5)
    axes.scatter(
        inspected.size_mm,
        np.where(inspected.hit, 1 + rise, -rise),
        color=colour,
        rasterized=inspections > MOST_MARKS,
        marker="|",
        s=16,
        lw=0.7,
        alpha=min(0.7, 150 / max(inspections, 1)),
    )


def _span(limits: Sequence[SetUpLimit]) -> tuple[float, float]:
    """Return the range of sizes inspected with a margin of 4 % of it, or a tenth of the size if
    there is only one."""
    sizes_mm = np.concatenate([limit.record.inspected.size_mm for limit in limits])
    if not len(sizes_mm):
        return 0.0, 1.0
    low_mm = float(sizes_mm.min())
    high_mm = float(sizes_mm.max())
    margin_mm = 0.04 * (high_mm - low_mm) or 0.1 * abs(high_mm) or 0.5
    start_mm = low_mm - margin_mm
    if low_mm > 0:
        start_mm = max(start_mm, 0.5 * low_mm)
    return start_mm, high_mm + margin_mm


def depth_limits_figure(results: Sequence[SetUpResult]) -> str:
    """Draw the depth found 90 % of the time with its interval against diameter, with a line for
    each set-up."""
    drawn = [result for result in results if result.surface is not None][: len(COLOURS)]
    limits = [result.limit for result in drawn]
    surfaces = [result.surface for result in drawn if result.surface is not None]
    deepest_mm = max(surface.depth_range_mm[1] for surface in surfaces)
    shallowest_mm = min(surface.depth_range_mm[0] for surface in surfaces)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for limit, surface, colour in zip(limits, surfaces, COLOURS, strict=False):
            least_mm, most_mm = surface.depth_range_mm
            inside = (surface.d90_mm >= least_mm) & (surface.d90_mm <= most_mm)
            low_mm = np.nan_to_num(surface.d90_low_mm)
            high_mm = np.nan_to_num(surface.d90_high_mm, nan=np.inf)
            axes.fill_between(
                surface.diameter_mm,
                np.clip(low_mm, shallowest_mm, deepest_mm),
                np.clip(high_mm, shallowest_mm, deepest_mm),
                where=inside,
                color=colour,
                alpha=0.15,
                lw=0,
            )
            d90_mm = np.where(inside, surface.d90_mm, np.nan)
            axes.plot(surface.diameter_mm, d90_mm, color=colour, label=_legend_name(limit))
        sizes = dict.fromkeys(limit.record.inspected.size_of for limit in limits)
        axes.set_xlabel(f"{' or '.join(sizes)} (mm)")
        axes.set_ylabel("depth found 90 % of the time (mm)")
        axes.set_ylim(0, deepest_mm)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center")

    alt = "Smallest depth found 90 % of the time against size, as depth_limits.csv says."
    return svg("depth-limits", (7.0, 4.0 + 0.17 * _legend_lines(limits)), alt, draw)


# ---------------------------------------------------------------- operating curves


def operating_figure(results: Sequence[SetUpResult]) -> str:
    """Draw the ROC, the free-response curve and the overlap of regions of each set-up."""

    def draw(figure: Figure) -> None:
        left, middle, right = figure.subplots(1, 3)
        for result, colour in zip(results, COLOURS, strict=False):
            if result.roc is not None:
                _draw_roc(left, result.roc, colour)
            if result.free_response is not None:
                name = _legend_name(result.limit)
                _draw_free_response(middle, result.free_response, colour, name)
            if result.pixels is not None:
                _draw_overlap(right, result.pixels, colour)
        left.plot([0, 1], [0, 1], color=GREY, lw=0.8, ls=":")
        left.set_xlabel("share of unflawed places above")
        left.set_ylabel("share of damages above")
        left.set(xlim=(-0.02, 1), title="ROC over places")
        middle.set_xscale("log")
        middle.set_xlabel("false calls per m², undamaged")
        middle.set_ylabel("share of damages found")
        plain_numbers(middle.xaxis, (1,))
        middle.plot([], [], "o", color=GREY, ms=6, label="threshold in use")
        middle.set_title("Free-response curve")
        right.set_xlabel("share of undamaged pixels above")
        right.set_ylabel("mean share of a damage's pixels above")
        right.set(xlim=(0, PRO_LIMIT), title="Overlap of regions")
        for axes in (left, middle, right):
            axes.set_ylim(0, 1.02)
        _draw_areas(left, "area under the curve")
        _draw_areas(right, None)
        figure.legend(*middle.get_legend_handles_labels(), loc="outside lower center", ncols=2)

    lines = _legend_lines([result.limit for result in results])
    alt = "Operating curves, a colour for each set-up."
    return svg("operating", (10.6, 4.3 + 0.13 * lines), alt, draw)


def _draw_roc(axes: Axes, roc: Roc, colour: str) -> None:
    axes.plot(roc.false, roc.true, color=colour, lw=1.5, label=f"{roc.area:.3f}")
    false, true = roc.in_use
    axes.plot(
        false,
        true,
        "o",
        color=colour,
        ms=5.5,
        mec="white",
        mew=0.8,
        zorder=5,
    )


def _draw_free_response(axes: Axes, curve: FreeResponse, colour: str, name: str) -> None:
    # thresholds without false calls have no place on a logarithmic axis: they are drawn at its
    # left end
    least = 0.5 / curve.area_m2
    calls = np.maximum(curve.false_calls_per_m2, least)
    axes.fill_between(calls, curve.found_low, curve.found_high, color=colour, alpha=0.13, lw=0)
    axes.plot(calls, curve.found_share, color=colour, lw=1.6, label=name)
    calls_in_use, found_in_use = curve.in_use
    axes.plot(
        max(calls_in_use, least),
        found_in_use,
        "o",
        color=colour,
        ms=6.5,
        mec="white",
        mew=0.9,
        zorder=5,
    )


def _draw_overlap(axes: Axes, pixels: PixelCurves, colour: str) -> None:
    """Draw the curve up to `PRO_LIMIT`, where it is interpolated."""
    inside = pixels.false <= PRO_LIMIT
    overlap_at_end = np.interp(PRO_LIMIT, pixels.false, pixels.overlap)
    area = "AU-PRO not reached"
    if np.isfinite(pixels.pro):
        area = f"AU-PRO {pixels.pro:.3f}"
    axes.plot(
        np.append(pixels.false[inside], PRO_LIMIT),
        np.append(pixels.overlap[inside], overlap_at_end),
        color=colour,
        lw=1.6,
        label=area,
    )


def _draw_areas(axes: Axes, title: str | None) -> None:
    """Draw the legend with the areas, if there are any."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower right", fontsize=8, title=title)


# ---------------------------------------------------------------- limits against an axis

ROOM = 1.3
"""Upper end of the axis over the largest size inspected."""
WIDTH_CHARACTERS = 60
"""Characters of labels side by side; more are turned."""


class AxisScale(NamedTuple):
    """The horizontal axis of a figure of limits."""

    positions: np.ndarray
    """(v,): position of each value."""
    is_logarithmic: bool
    """True for a logarithmic axis."""

    @property
    def even(self) -> np.ndarray:
        """Positions (v,) on a scale on which equal distances look equal."""
        return np.log(self.positions) if self.is_logarithmic else self.positions

    def moved(self, step: float) -> np.ndarray:
        """Positions (v,) that lie ``step`` farther on the even scale."""
        moved = self.even + step
        return np.exp(moved) if self.is_logarithmic else moved


def axis_figure(axis: study.AxisGroup, name: str) -> str:
    """Draw a90 with its interval over boards and a90/95 for each value of the axis; arrows mark
    sizes far beyond."""
    shown = list(axis.lines.items())[: len(COLOURS)]
    limits = [limit for _, line in shown for limit in line.limits]
    largest_mm = max((limit.largest_mm for limit in limits if limit.inspections), default=np.inf)
    top_mm = ROOM * largest_mm
    scale = _scale_of(axis)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        # intervals of several lines are drawn side by side, 2.5 % of the axis apart, or less if
        # positions are close
        even = scale.even
        nearest = float(np.diff(np.sort(even)).min()) if len(even) > 1 else 1.0
        step = min(0.025 * (float(np.ptp(even)) or 1.0), 0.6 * nearest / len(shown))
        is_any_beyond = False
        for number, (label, line) in enumerate(shown):
            moved = scale.moved(step * (number - (len(shown) - 1) / 2))
            x = moved[[axis.values.index(value) for value in line.values]]
            style: dict[str, Any] = {
                "ls": "-" if axis.numeric else "none",
                "label": plain(label or "a90, 95 % over boards"),
                "color": COLOURS[number],
                "fmt": MARKERS[number],
            }
            is_any_beyond |= _draw_line(axes, x, line.limits, top_mm, style)
        axes.plot(
            [],
            [],
            "_",
            color=GREY,
            ms=11,
            mew=2.2,
            label="a90/95",
        )
        if is_any_beyond:
            words = "continues beyond the axis"
            axes.plot(
                [],
                [],
                marker="^",
                ls="none",
                color=GREY,
                ms=6,
                label=words,
            )
        if np.isfinite(top_mm):
            axes.axhline(
                top_mm / ROOM,
                color=GREY,
                lw=1.0,
                ls=":",
                label="largest size inspected",
            )
        _name_missing(axes, axis, scale, dict(shown))
        if scale.is_logarithmic:
            axes.set_xscale("log")
            axes.minorticks_off()
        _label_values(axes, axis, scale)
        axes.set(xlabel=plain(axis.title), ylabel="a90 (mm)")
        axes.margins(x=0.08)
        axes.set_ylim(0, top_mm if np.isfinite(top_mm) else None)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)

    alt = f"Diameter found 90 % of the time (a90) against {axis.title}, as the table says."
    return svg(name, (7.0, 4.4 + 0.13 * len(shown)), alt, draw)


def _scale_of(axis: study.AxisGroup) -> AxisScale:
    """Return the scale of an axis; values that are no numbers stand one step apart."""
    if not axis.numeric:
        return AxisScale(np.arange(len(axis.values), dtype=float), is_logarithmic=False)
    positions = np.array(axis.values, float)
    is_wide = positions.min() > 0 and positions.max() / positions.min() >= 8
    return AxisScale(positions, is_logarithmic=bool(is_wide))


def _draw_line(
    axes: Axes,
    x: np.ndarray,
    limits: Sequence[SetUpLimit],
    top_mm: float,
    style: dict[str, Any],
) -> bool:
    """Draw a line of limits at ``x`` (n,); return whether a size lies beyond ``top_mm``."""
    a90_mm = np.array([limit.a90_mm for limit in limits])
    bound_mm = np.array([limit.a90_95.value for limit in limits])
    low_mm = np.array([limit.a90_interval_mm.low for limit in limits])
    high_mm = np.array([limit.a90_interval_mm.high for limit in limits])
    inside_mm = np.where(a90_mm <= top_mm, a90_mm, np.nan)
    ends_mm = [inside_mm - low_mm, np.minimum(high_mm, top_mm) - inside_mm]
    errors_mm = np.nan_to_num(np.clip(ends_mm, 0, None))
    axes.errorbar(
        x,
        inside_mm,
        errors_mm,
        lw=1.2,
        ms=5.5,
        capsize=3,
        **style,
    )
    is_bound_inside = bound_mm <= top_mm
    axes.plot(
        x[is_bound_inside],
        bound_mm[is_bound_inside],
        "_",
        color=style["color"],
        ms=13,
        mew=2.4,
    )
    largest_mm = np.fmax(np.fmax(high_mm, a90_mm), bound_mm)
    is_beyond = (np.isfinite(a90_mm) & (largest_mm > top_mm)) | np.isinf(a90_mm)
    axes.plot(
        x[is_beyond],
        np.full(is_beyond.sum(), top_mm),
        "^",
        color=style["color"],
        ms=6.5,
        clip_on=False,
    )
    return bool(is_beyond.any())


def _name_missing(
    axes: Axes, axis: study.AxisGroup, scale: AxisScale, shown: dict[str, AxisLine]
) -> None:
    """Write above each value how many lines have no limit there."""
    for value, position in zip(axis.values, scale.positions, strict=True):
        missing = 0
        for line in shown.values():
            pairs = zip(line.values, line.limits, strict=True)
            missing += sum(x == value and not is_within_sizes(limit) for x, limit in pairs)
        if missing:
            words = "no limit" if len(shown) == 1 else f"no limit\n({missing})"
            axes.text(
                position,
                1.02,
                words,
                transform=axes.get_xaxis_transform(),
                ha="center",
                va="bottom",
                fontsize=8,
                color=GREY,
            )


def _label_values(axes: Axes, axis: study.AxisGroup, scale: AxisScale) -> None:
    """Set the labels of the values; long labels are turned."""
    labels = []
    for value in axis.values:
        if axis.numeric:
            labels.append(f"{value:g}")
        else:
            words = shorten(axis.words(value), 60, placeholder=" …")
            labels.append(plain(fill(words, 18, break_long_words=False)))
    axes.set_xticks(scale.positions, labels)
    longest = max(len(line) for label in labels for line in label.split("\n"))
    if longest * len(labels) > WIDTH_CHARACTERS:
        axes.tick_params(axis="x", labelrotation=25)
