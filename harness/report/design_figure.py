"""Figure of a planned study: the limit to expect against the number of targets, and the sizes on the guessed curve."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.pod.design import StudyPlan
from harness.report.canvas import BLUE, GREEN, GREY, INK, ORANGE, RED, save_png, svg
from harness.report.design_rows import PLACED, StudyDesign, answer, size_text
from harness.report.pod_figure import axis_text, plain

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE_IN = (11.5, 4.9)
COLOUR_OF = {"uniform": BLUE, "concentrated": ORANGE}
MARKER_OF = {"uniform": "o", "concentrated": "s"}
APART = 0.11
"""Half the distance between the placements of one number of targets, whose places are 1 apart."""
ROOM = 1.25
"""Height of the panel over that of the highest thing in it; what is higher ends there, with an arrow."""
FARTHEST = 2.0
"""Quantiles are drawn up to this many times the largest target, medians wherever they are: where POD hardly rises a
quantile of a thousand millimetres would leave nothing to be seen of the others."""


def design_svg(design: StudyDesign) -> str:
    """The figure as text of an inline ``<svg>``."""
    return svg("design", SIZE_IN, answer(design), _drawing(design))


def save_design_png(path: Path, design: StudyDesign) -> None:
    """The figure as a PNG of 160 dots an inch at ``path``; the same bytes for the same design."""
    save_png(path, SIZE_IN, _drawing(design))


def _drawing(design: StudyDesign) -> Callable[[Figure], None]:
    def draw(figure: Figure) -> None:
        expected, curve = figure.subplots(1, 2)
        _expected(expected, design)
        _guess(curve, design)

    return draw


def _expected(axes: Axes, design: StudyDesign) -> None:
    """Median and the 10-90 % bar of every plan, the guess's own size as a line."""
    numbers = sorted({plan.targets for plan in design.plans})
    true_size = design.plans[0].true_size
    floor, top = _heights(design)
    for placement in dict.fromkeys(plan.placement for plan in design.plans):
        side = APART * (-1 if placement == "uniform" else 1)
        plans = [plan for plan in design.plans if plan.placement == placement]
        style: dict[str, Any] = {"color": COLOUR_OF[placement]}
        for plan in plans:
            _bar(axes, numbers.index(plan.targets) + side, plan, top, style)
        axes.plot([], [], MARKER_OF[placement], label=f"{PLACED[placement]}: median, 10–90 %", **style)
    if any(plan.low < np.inf and plan.high > top for plan in design.plans):
        axes.plot([], [], "^", color=GREY, label="goes on, or has no end")
    own = f"the guess's {design.size_name}: {size_text(true_size, design)}"
    axes.axhline(true_size, color=RED, lw=1.2, label=plain(own))
    if design.goal is not None:
        axes.axhline(
            design.goal, color=GREEN, lw=1.2, ls="--", label=plain(f"wanted: {size_text(design.goal, design)}")
        )
    axes.set_ylim(floor - 0.1 * (top - floor), max(top, 1.02 * (design.goal or 0)))
    axes.set_xlim(-0.6, len(numbers) - 0.4)
    axes.set_xticks(range(len(numbers)), [str(number) for number in numbers])
    axes.grid(axis="x", visible=False)
    axes.set_xlabel("targets")
    axes.set_ylabel(axis_text(f"{design.limit_name} to expect", design.unit))
    axes.set_title(f"{design.plans[0].studies} simulated studies each")
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.16), ncols=2, borderaxespad=0)


def _heights(design: StudyDesign) -> tuple[float, float]:
    """Where the panel's contents begin, and where the panel ends."""
    farthest = FARTHEST * design.range_of_sizes[1]
    marks = [design.plans[0].true_size, *(plan.bound for plan in design.plans)]
    ends = [min(plan.high, farthest) for plan in design.plans if np.isfinite(plan.high)]
    finite = [value for value in (*marks, *ends, *(plan.low for plan in design.plans)) if np.isfinite(value)]
    floor = min(finite)
    return floor, floor + ROOM * max(max(finite) - floor, 0.05 * floor)


def _bar(axes: Axes, place: float, plan: StudyPlan, top: float, style: dict[str, Any]) -> None:
    if not np.isfinite(plan.low):
        axes.text(place, top, "none", ha="center", va="top", rotation=90, **style)
        return
    axes.plot([place, place], [plan.low, min(plan.high, top)], lw=2.2, solid_capstyle="butt", **style)
    if plan.high > top:
        axes.plot([place], [top], "^", ms=7, clip_on=False, **style)
    if np.isfinite(plan.bound):
        axes.plot([place], [plan.bound], MARKER_OF[plan.placement], ms=7, mec="white", mew=0.8, zorder=3, **style)


def _guess(axes: Axes, design: StudyDesign) -> None:
    """The guessed curve, and below it the sizes of the recommended number of targets, a stroke each."""
    low, high = design.range_of_sizes
    sizes = np.linspace(low, high, 241) if low > 0 else np.linspace(high / 240, high, 240)
    targets = design.recommended.plan.targets
    axes.plot(sizes, design.guess.pod(sizes), color=INK, label=f"guessed POD, {design.guess.link}")
    plans = [plan for plan in design.plans if plan.targets == targets]
    for row, plan in enumerate(plans):
        chosen = ", recommended" if plan is design.recommended.plan else ""
        style: dict[str, Any] = {"color": COLOUR_OF[plan.placement], "clip_on": False}
        label = f"{targets} targets, {PLACED[plan.placement]}{chosen}"
        axes.plot(plan.sizes, np.full(targets, -0.08 - 0.08 * row), "|", ms=9, mew=1.0, label=label, **style)
    for pod in (0.5, design.plans[0].pod):
        at = design.guess.size_at(pod)
        axes.plot([at, at], [0, pod], color=GREY, lw=0.9, ls=":")
        axes.plot([at], [pod], "o", color=GREY, ms=5)
    axes.set_ylim(-0.08 - 0.08 * len(plans), 1.04)
    axes.set_xlim(low, high)
    axes.set_yticks(np.linspace(0, 1, 6))
    axes.set_xlabel(axis_text("size", design.unit))
    axes.set_ylabel("probability of detection")
    axes.set_title("Sizes to make")
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.16), ncols=1, borderaxespad=0)
