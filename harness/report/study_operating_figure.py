"""Figures over all thresholds: damages against unflawed places, free-response curve, overlap of regions."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.study.curves import PRO_LIMIT
from harness.evaluation.study.result import SetUpResult
from harness.report.canvas import GREY, svg
from harness.report.pod import plain, plain_numbers
from harness.report.set_ups_figures import COLOURS
from harness.report.study_rows import name_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLES = ("-", "--", ":", "-.")
LONGEST_NAME = 60
"""Characters of a set-up on one line of the legend."""


def operating_figure(results: Sequence[SetUpResult]) -> str:
    """One colour a set-up in each of three panels; of a single one the ROC by classes of size."""

    def draw(figure: Figure) -> None:
        left, middle, right = figure.subplots(1, 3)
        for number, result in enumerate(results):
            label = plain(fill(name_of(result.limit), LONGEST_NAME))
            _roc(left, result, COLOURS[number], label, by_size=len(results) == 1)
            _free_response(middle, result, COLOURS[number], label)
            _overlap(right, result, COLOURS[number], label)
        has_large = any(one.free_response and one.free_response.large_found is not None for one in results)
        _finish(left, middle, right, by_size=len(results) == 1, has_large=has_large)
        figure.legend(*middle.get_legend_handles_labels(), loc="outside lower center", ncols=2)

    lines = sum(-(-len(name_of(one.limit)) // LONGEST_NAME) for one in results)
    return svg("operating", (10.6, 4.3 + 0.13 * lines), _alt(results), draw)


def _roc(axes: Axes, result: SetUpResult, colour: str, label: str, *, by_size: bool) -> None:
    for curve, style in zip(result.roc if by_size else result.roc[:1], STYLES, strict=False):
        name = curve.name if by_size else label
        axes.plot(curve.false, curve.true, color=colour, ls=style, lw=1.5, label=f"{name}: {curve.area:.3f}")
        axes.plot(*curve.at, "o", color=colour, ms=5.5, mec="white", mew=0.8, zorder=5)


def _free_response(axes: Axes, result: SetUpResult, colour: str, label: str) -> None:
    """Thresholds without a false call have no place on a logarithmic axis: their share stands at its left end."""
    curve = result.free_response
    if curve is None:
        return
    least = 0.5 / curve.area_m2
    calls = np.maximum(curve.false_calls_per_m2, least)
    axes.fill_between(calls, curve.found_low, curve.found_high, color=colour, alpha=0.13, lw=0)
    axes.plot(calls, curve.found, color=colour, lw=1.6, label=label)
    if curve.large_found is not None:
        axes.plot(calls, curve.large_found, color=colour, lw=1.2, ls="--")
    axes.plot(max(curve.at[0], least), curve.at[1], "o", color=colour, ms=6.5, mec="white", mew=0.9, zorder=5)


def _overlap(axes: Axes, result: SetUpResult, colour: str, label: str) -> None:
    curve = result.pixels
    if curve is None:
        return
    kept = curve.false <= PRO_LIMIT
    end = np.interp(PRO_LIMIT, curve.false, curve.overlap)
    x, y = np.append(curve.false[kept], PRO_LIMIT), np.append(curve.overlap[kept], end)
    area = f"AU-PRO {curve.pro:.3f}" if np.isfinite(curve.pro) else "AU-PRO not reached"
    axes.plot(x, y, color=colour, lw=1.6, label=area)


def _finish(left: Axes, middle: Axes, right: Axes, *, by_size: bool, has_large: bool) -> None:
    left.plot([0, 1], [0, 1], color=GREY, lw=0.8, ls=":")
    left.set(xlabel="share of unflawed places above", ylabel="share of damages above", xlim=(-0.02, 1), ylim=(0, 1.02))
    left.set_title("ROC over places" + ("" if by_size else ", all sizes"))
    handles, labels = left.get_legend_handles_labels()
    if handles:
        # Beside a colour that the figure's legend names the number alone will do.
        texts = labels if by_size else [label.rpartition(": ")[2] for label in labels]
        title = "area under the curve"
        left.legend(handles, texts, loc="lower right", fontsize=8, title=title, title_fontsize=8)
    middle.set(xscale="log", ylim=(0, 1.02), xlabel="false calls per m², hole-free", ylabel="share of damages found")
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


def _alt(results: Sequence[SetUpResult]) -> str:
    said = []
    for result in results:
        parts = [f"area under the ROC {result.roc[0].area:.3f}"] if result.roc else []
        if result.free_response is not None:
            calls, found = result.free_response.at
            parts.append(f"{100 * found:.0f} % found at {calls:.2g} false calls per square metre")
        if result.pixels is not None and np.isfinite(result.pixels.pro):
            parts.append(f"AU-PRO {result.pixels.pro:.3f}")
        said.append(f"{name_of(result.limit)}: {', '.join(parts) or 'no curve'}")
    return f"Operating curves. {'; '.join(said)}."
