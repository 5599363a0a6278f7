"""Figures of a study: curves with their data, signals, depths, false calls, and curves over all thresholds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.study.curves import PRO_LIMIT
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.result import SetUpResult
from harness.evaluation.study.surface import PodSurface
from harness.report.canvas import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, RED, SKY, svg
from harness.report.pod import draw_hits, draw_pod, draw_signals, hits_in_view, plain, plain_numbers
from harness.report.set_ups_figures import COLOURS
from harness.tables import text
from harness.tables.limits import limit_sentence, name_of, rate_estimate, rate_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_PANELS = 6
"""Set-ups shown with their curves; the tables have all."""
MOST_ROWS = 40
"""Set-ups up to which the figure of false calls can be read; the table has all."""
PANEL_IN = (5.2, 4.5)
ONE_IN = (8.6, 5.2)
LEVELS = {0.1: SKY, 0.5: GREEN, 0.9: ORANGE}
"""Lines of equal POD that are drawn over diameter and depth."""
GRID = 121
STYLES = ("-", "--", ":", "-.")
LONGEST_NAME = 60
"""Characters of a set-up on one line of a legend."""


def with_room(set_ups: Sequence[SetUpResult]) -> list[SetUpResult]:
    """Return those shown in figures: all, or `MOST_PANELS` evenly from the smallest limit to the largest, in order."""
    by_limit = sorted(set_ups, key=lambda one: one.limit.a90_95.value)
    places = np.linspace(0, len(by_limit) - 1, min(MOST_PANELS, len(by_limit))).round().astype(int)
    chosen = {id(by_limit[place]) for place in places}
    return [one for one in set_ups if id(one) in chosen]


# ---------------------------------------------------------------- a panel for each set-up


def curves_figure(limits: Sequence[SetUpLimit]) -> str:
    """Draw hits and misses, the curve with its band, a50, a90 and a90/95, on one scale of sizes."""
    span = _span(limits)

    def draw(axes: Axes, limit: SetUpLimit) -> None:
        strength = min(0.6, 150 / max(limit.inspections, 1))
        if limit.statement is not None:
            draw_pod(axes, limit.statement, limit.a90_95, strength, most=limit.largest_mm)
        else:
            seen = limit.record.inspected
            draw_hits(axes, seen.diameter_mm, seen.hit, strength=strength)
            hits_in_view(axes)
            if limit.a90_95.demonstrated:
                axes.plot([limit.a90_95.value], [0.9], "o", color=PURPLE, label=f"a90/95: {limit.a90_95.value:.2f} mm")
            words, place = plain(fill(f"no curve: {limit.why}", 44)), axes.transAxes
            axes.text(0.5, 0.5, words, transform=place, ha="center", va="center", color=GREY, fontsize=9)
        axes.set(xlim=span, xlabel="diameter (mm)", ylabel="probability of detection")

    return _panels("curves", limits, draw, " ".join(limit_sentence(limit) for limit in limits))


def signals_figure(limits: Sequence[SetUpLimit]) -> str:
    """Draw signals against size, their regression and the threshold, of set-ups that have a regression."""

    def draw(axes: Axes, limit: SetUpLimit) -> None:
        assert limit.signals is not None
        draw_signals(axes, limit.signals)
        axes.set(xlim=_span([limit]), xlabel="diameter (mm)", ylabel="highest score at the damage")

    names = "; ".join(name_of(limit) for limit in limits)
    return _panels("signals", limits, draw, f"Score of each damage against its diameter, with the threshold: {names}.")


def surface_figure(surfaces: Sequence[tuple[SetUpLimit, PodSurface]]) -> str:
    """Draw lines of equal POD over diameter and depth, the interval of that of 90 %, every damage found or missed."""
    of_limit = {id(limit): surface for limit, surface in surfaces}

    def draw(axes: Axes, limit: SetUpLimit) -> None:
        surface = of_limit[id(limit)]
        (left, right), (low, high) = surface.diameter_range_mm, surface.depth_range_mm
        diameter, depth = np.linspace(left, right, GRID), np.geomspace(low, high, GRID)
        pod = surface.pod(*np.meshgrid(diameter, depth))
        shade = axes.contourf(diameter, depth, pod, levels=np.linspace(0, 1, 11), cmap="Greys", alpha=0.28)
        shade.set_rasterized(True)
        inside = [np.clip(edge, left, right) for edge in (surface.a90_low_mm, surface.a90_high_mm)]
        axes.fill_betweenx(surface.depth_mm, *inside, color=ORANGE, alpha=0.3, lw=0, label="90 %, interval over boards")
        for level, colour in LEVELS.items():
            if pod.min() < level < pod.max():
                axes.contour(diameter, depth, pod, levels=[level], colors=[colour], linewidths=2)
            axes.plot([], [], color=colour, lw=2, label=f"POD {100 * level:.0f} %")
        seen = limit.record.inspected
        hit = np.asarray(seen.hit, bool)
        axes.scatter(seen.diameter_mm[hit], seen.depth_mm[hit], s=9, color=BLUE, lw=0, alpha=0.8, label="found")
        missed: dict[str, Any] = {"s": 11, "facecolor": "white", "edgecolor": INK, "lw": 0.6, "alpha": 0.8}
        axes.scatter(seen.diameter_mm[~hit], seen.depth_mm[~hit], label="missed", **missed)
        axes.set(xlabel="diameter (mm)", ylabel="depth of removed material (mm)", xlim=(left, right), ylim=(low, high))

    said = "; ".join(
        f"{name_of(limit)}: a90 {text.size(surface.a90_mm[0], limit.largest_mm)} mm at {surface.depth_mm[0]:.3g} mm "
        f"depth, {text.size(surface.a90_mm[-1], limit.largest_mm)} mm at {surface.depth_mm[-1]:.3g} mm"
        for limit, surface in surfaces
    )
    alt = f"Probability of detection over diameter and depth. {said}."
    return _panels("surface", [limit for limit, _ in surfaces], draw, alt, one_legend=True)


def _panels(
    name: str,
    limits: Sequence[SetUpLimit],
    draw_one: Callable[[Axes, SetUpLimit], None],
    alt: str,
    *,
    one_legend: bool = False,
) -> str:
    across = min(2, len(limits))
    down = -(-len(limits) // across)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(down, across, squeeze=False).ravel()
        for axes, limit in zip(grid, limits, strict=False):
            draw_one(axes, limit)
            axes.set_title(plain(fill(name_of(limit), 46 if across > 1 else 80)))
            if not one_legend:
                axes.legend(loc="upper left", bbox_to_anchor=(0, -0.17), ncols=2, borderaxespad=0, fontsize=8)
        for axes in grid[len(limits) :]:
            axes.set_visible(False)
        if one_legend:
            figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)

    high = 3.9 * down + 0.7 if one_legend else PANEL_IN[1] * down
    return svg(name, (PANEL_IN[0] * across, high) if across > 1 else ONE_IN, alt, draw)


def _span(limits: Sequence[SetUpLimit]) -> tuple[float, float]:
    """The sizes inspected with 4 % of them on either side; of a single size a tenth of it."""
    sizes = np.concatenate([limit.record.inspected.diameter_mm for limit in limits])
    if not len(sizes):
        return 0.0, 1.0
    low, high = float(sizes.min()), float(sizes.max())
    margin = 0.04 * (high - low) or 0.1 * abs(high) or 0.5
    return (max(low - margin, 0.5 * low) if low > 0 else low - margin), high + margin


# ---------------------------------------------------------------- all set-ups together


def calls_figure(limits: Sequence[SetUpLimit], wanted_per_m2: float | None) -> str:
    """Draw the rate of false calls of each set-up with hole-free boards, with the exact Poisson interval and that over
    boards, beside the rate that thresholds were calibrated to."""
    shown = [limit for limit in limits if limit.false_calls is not None][:MOST_ROWS]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for row, limit in enumerate(shown):
            calls = limit.false_calls
            assert calls is not None
            ends = calls.interval_per_m2
            axes.plot([ends.low, ends.high], [row - 0.12] * 2, color=BLUE, lw=2.2, solid_capstyle="butt")
            axes.plot([calls.rate_per_m2], [row - 0.12], "o", color=BLUE, ms=6)
            over = limit.false_calls_interval_per_m2
            if over.known:
                axes.plot([over.low, over.high], [row + 0.16] * 2, color=ORANGE, lw=2.2, solid_capstyle="butt")
        axes.plot([], [], "o-", color=BLUE, ms=6, lw=2.2, label="found, exact Poisson interval (95 %)")
        axes.plot([], [], color=ORANGE, lw=2.2, label="interval over boards (95 %)")
        if wanted_per_m2 is not None:
            axes.axvline(wanted_per_m2, color=RED, lw=1.4, ls="--", label=f"wanted: {wanted_per_m2:g} per m²")
        names = [plain(fill(name_of(limit), 40, break_long_words=False)) for limit in shown]
        axes.set_yticks(np.arange(len(shown)), names)
        axes.set(ylim=(len(shown) - 0.4, -0.6), xlabel="false calls per m²")
        axes.set_xlim(left=0)
        axes.grid(axis="y", visible=False)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)

    said = "; ".join(f"{name_of(limit)}: {rate_text(rate_estimate(limit.false_calls))}" for limit in shown)
    return svg("calls", (8.6, 1.3 + 0.5 * len(shown)), f"False calls per square metre of hole-free face. {said}.", draw)


def operating_figure(results: Sequence[SetUpResult]) -> str:
    """Draw damages against unflawed places, the free-response curve and the overlap of regions, in a colour for each
    set-up; of a single set-up the ROC by classes of size."""
    by_size = len(results) == 1

    def draw(figure: Figure) -> None:
        left, middle, right = figure.subplots(1, 3)
        has_large = False
        for result, colour in zip(results, COLOURS, strict=False):
            label = plain(fill(name_of(result.limit), LONGEST_NAME))
            for roc, style in zip(result.roc if by_size else result.roc[:1], STYLES, strict=False):
                name = roc.name if by_size else label
                left.plot(roc.false, roc.true, color=colour, ls=style, lw=1.5, label=f"{name}: {roc.area:.3f}")
                left.plot(*roc.at, "o", color=colour, ms=5.5, mec="white", mew=0.8, zorder=5)
            if (curve := result.free_response) is not None:
                # thresholds without a false call have no place on a logarithmic axis: they stand at its left end
                least = 0.5 / curve.area_m2
                calls = np.maximum(curve.false_calls_per_m2, least)
                middle.fill_between(calls, curve.found_low, curve.found_high, color=colour, alpha=0.13, lw=0)
                middle.plot(calls, curve.found, color=colour, lw=1.6, label=label)
                if curve.large_found is not None:
                    has_large = True
                    middle.plot(calls, curve.large_found, color=colour, lw=1.2, ls="--")
                at = (max(curve.at[0], least), curve.at[1])
                middle.plot(*at, "o", color=colour, ms=6.5, mec="white", mew=0.9, zorder=5)
            if (pixels := result.pixels) is not None:
                kept = pixels.false <= PRO_LIMIT
                end = np.interp(PRO_LIMIT, pixels.false, pixels.overlap)
                area = f"AU-PRO {pixels.pro:.3f}" if np.isfinite(pixels.pro) else "AU-PRO not reached"
                x, y = np.append(pixels.false[kept], PRO_LIMIT), np.append(pixels.overlap[kept], end)
                right.plot(x, y, color=colour, lw=1.6, label=area)
        left.plot([0, 1], [0, 1], color=GREY, lw=0.8, ls=":")
        left.set(xlabel="share of unflawed places above", ylabel="share of damages above")
        left.set(xlim=(-0.02, 1), ylim=(0, 1.02))
        left.set_title("ROC over places" + ("" if by_size else ", all sizes"))
        handles, labels = left.get_legend_handles_labels()
        if handles:
            # the number alone will do beside a colour that the figure's legend names
            texts = labels if by_size else [label.rpartition(": ")[2] for label in labels]
            title = "area under the curve"
            left.legend(handles, texts, loc="lower right", fontsize=8, title=title, title_fontsize=8)
        middle.set(
            xscale="log", ylim=(0, 1.02), xlabel="false calls per m², hole-free", ylabel="share of damages found"
        )
        plain_numbers(middle.xaxis, (1,))
        if has_large:
            middle.plot([], [], color=GREY, lw=1.2, ls="--", label="damages of a50 and more")
        middle.plot([], [], "o", color=GREY, ms=6, label="threshold in use")
        middle.set_title("Free-response curve")
        right.set(xlim=(0, PRO_LIMIT), ylim=(0, 1.02))
        right.set(xlabel="share of undamaged pixels above", ylabel="mean share of a damage's pixels above")
        right.set_title("Overlap of regions")
        if right.get_legend_handles_labels()[0]:
            right.legend(loc="lower right", fontsize=8)
        figure.legend(*middle.get_legend_handles_labels(), loc="outside lower center", ncols=2)

    said = []
    for result in results:
        parts = [f"area under the ROC {result.roc[0].area:.3f}"] if result.roc else []
        if result.free_response is not None:
            calls, found = result.free_response.at
            parts.append(f"{100 * found:.0f} % found at {calls:.2g} false calls per square metre")
        if result.pixels is not None and np.isfinite(result.pixels.pro):
            parts.append(f"AU-PRO {result.pixels.pro:.3f}")
        said.append(f"{name_of(result.limit)}: {', '.join(parts) or 'no curve'}")
    lines = sum(-(-len(name_of(one.limit)) // LONGEST_NAME) for one in results)
    return svg("operating", (10.6, 4.3 + 0.13 * lines), f"Operating curves. {'; '.join(said)}.", draw)
