"""Presents the plan of a study: tables for terminal and page, the figure, and JSON data."""

from __future__ import annotations

from dataclasses import dataclass
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.intervals import SITES_PER_TARGET
from harness.evaluation.pod.averaged import METHOD
from harness.evaluation.pod.curve import PodCurve
from harness.evaluation.pod.statement import LEAST_TARGETS, POD
from harness.programs.inspections import design_statistics as planned
from harness.records.schema import Column, Table
from harness.report import blocks
from harness.report.pod import axis_text, plain
from harness.vocabulary.files import jsonable
from harness.vocabulary.text import Grid

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

MEDIANS = (
    'Median and 10 % and 90 % quantiles of the simulated studies; "none" means that so many '
    "studies demonstrate no limit. *: recommended."
)
WIDE = 110
SIZE_IN = (11.5, 4.9)


@dataclass(frozen=True, eq=False)
class StudyDesign:
    """Plans for a study."""

    guess: PodCurve
    origin: str
    """Origin of the guessed curve."""
    unit: str
    """Unit of all sizes; may be empty."""
    range_of_sizes: tuple[float, float]
    """Smallest and largest size to choose from."""
    plans: tuple[planned.StudyPlan, ...]
    recommended: planned.StudyPlan
    reaches: bool | None
    """Whether nine of ten studies by the recommended plan demonstrate the goal; None without."""
    goal: float | None
    """The wanted a90/95, if any."""
    hole_free: planned.HoleFree | None
    """Hole-free area for the wanted rate of false calls, if any."""

    @property
    def in_unit(self) -> str:
        """The unit in brackets, if there is one."""
        return f" ({self.unit})" if self.unit else ""

    def text(self, size: float) -> str:
        """Return a size with its unit."""
        if not np.isfinite(size):
            return "no size at all"
        return f"{size:.3g} {self.unit}" if self.unit else f"{size:.3g}"


def design_html(design: StudyDesign, command: str) -> str:
    """Return the page as text: answer, figure, plans and sizes, hole-free area; it needs no
    network."""
    caption = (
        "Left: the a90/95 that simulated studies demonstrate, and the guess's own a90, below "
        "which a limit should not fall. Right: the guessed curve and the sizes of the recommended "
        "plan."
    )
    drawn = blocks.svg("design", SIZE_IN, answer(design), lambda canvas: _draw(canvas, design))
    body = [blocks.heading("What to expect"), blocks.figure({"design": drawn}, "design", caption)]
    body += [
        plans_grid(design).html(),
        blocks.note(MEDIANS),
        blocks.subheading(f"Sizes to make{design.in_unit}"),
    ]
    for plan in design.plans:
        chosen = plan is design.recommended
        name = f"{plan.targets} targets{' (recommended)' if chosen else ''}"
        body.append(blocks.fold(name, blocks.tag("pre", _sizes(plan)), is_open=chosen))
    body += [blocks.heading("Hole-free area"), blocks.bullets(hole_free_lines(design))]
    body += [blocks.heading("Notes"), blocks.bullets(notes(design)), *blocks.command_of(command)]
    under = [blocks.note(f"Guess: {guess_text(design)}.")]
    return blocks.page("Planning a study of detection limits", answer(design), body, under)


def design_parts(design: StudyDesign) -> list[str | Grid]:
    """Return what a terminal shows: the page's tables and sentences."""
    parts: list[str | Grid] = [
        f"guess: {guess_text(design)}",
        "",
        plans_grid(design),
        *wrap(MEDIANS, WIDE),
        "",
    ]
    parts += [
        f"sizes of the recommended plan (*){design.in_unit}:",
        *wrap(_sizes(design.recommended), WIDE),
    ]
    parts += ["", *(f"hole-free: {line}" for line in hole_free_lines(design))]
    return [*parts, "", *(f"note: {line}" for line in notes(design)), "", answer(design)]


def _sizes(plan: planned.StudyPlan) -> str:
    return " ".join(f"{size:.4g}" for size in plan.sizes)


def answer(design: StudyDesign) -> str:
    """State the recommendation in a sentence."""
    plan = design.recommended
    wish = ""
    if design.goal is not None:
        reached = (
            "nine of ten studies demonstrate"
            if design.reaches
            else "no plan listed is sure to show"
        )
        wish = f"; {reached} the {design.text(design.goal)} that is wanted"
    if not np.isfinite(plan.bound):
        expects = "even then, most studies would demonstrate no a90/95"
    else:
        spread = (
            f"between {design.text(plan.low)} and {design.text(plan.high)} in eight of ten studies"
        )
        expects = f"expect a90/95 at {design.text(plan.bound)}, {spread}"
    low, high = map(design.text, design.range_of_sizes)
    return f"Make {plan.targets} targets, evenly spread from {low} to {high}: {expects}{wish}."


def guess_text(design: StudyDesign) -> str:
    """Describe the guessed curve and its origin."""
    guess = design.guess
    sizes = ", ".join(
        f"{name} {design.text(guess.size_at(pod))}" for name, pod in (("a50", 0.5), ("a90", 0.9))
    )
    return f"{sizes} ({guess.link}, {'ln size' if guess.log_size else 'size'}); {design.origin}"


def _size(value: float) -> str:
    return f"{value:#.3g}".rstrip(".") if np.isfinite(value) else "none"


PLANS = Table(
    "plans",
    "one row per number of targets",
    (
        Column("", "targets", lambda row: f"{'* ' * row[1]}{row[0].targets}"),
        Column(
            "",
            "limit",
            lambda row: row[0].bound,
            text=_size,
            tone=lambda row: "key" if row[1] else "",
        ),
        Column("", "10 %", lambda row: row[0].low, text=_size),
        Column("", "90 %", lambda row: row[0].high, text=_size),
        Column("", "demonstrated", lambda row: f"{100 * row[0].demonstrated:.1f} %"),
    ),
    formats=(),
)
"""Its rows are pairs of a plan and whether it is the recommended plan."""


def plans_grid(design: StudyDesign) -> Grid:
    """Return the table of all plans and what their studies demonstrate; a star marks the
    recommended plan."""
    rows = [(plan, plan is design.recommended) for plan in design.plans]
    return PLANS.grid(rows, heads={"limit": f"a90/95{design.in_unit}"})


def hole_free_lines(design: StudyDesign) -> list[str]:
    """Return the unflawed sites and areas that the recommended number of targets requires."""
    sites = SITES_PER_TARGET * design.recommended.targets
    lines = [
        f"{sites} unflawed sites: MIL-HDBK-1823A asks for at least {SITES_PER_TARGET} per target"
    ]
    area = design.hole_free
    if area is None:
        return lines
    sure = f"{area.confidence:.0%} confidence".replace("%", " %")
    return [
        *lines,
        f"a threshold for {area.rate_per_m2:g} false calls per m2 needs at least "
        f"{area.calibration_boards} hole-free boards of {area.board_m2:g} m2; its rate is then at "
        f"most {area.upper_per_m2:.3g} with {sure}",
        f"to show at most {area.rate_per_m2:g} per m2 with {sure}, no false call may occur on "
        f"{area.silent_m2:.4g} m2, which is {area.silent_boards} other boards",
    ]


def notes(design: StudyDesign) -> list[str]:
    """Return the handbook's minima, the Monte Carlo error, and the assumptions of the plan."""
    texts = []
    plan = design.recommended
    low, high = design.range_of_sizes
    if not low <= plan.true_size <= high:
        texts.append("the guess's own a90 lies outside the range: it is extrapolated")
    if design.reaches is False and design.goal is not None and np.isfinite(plan.high):
        # The bound's distance from the truth is a multiple of a standard error.
        wanted = plan.targets * ((plan.high - plan.true_size) / (design.goal - plan.true_size)) ** 2
        texts.append(
            "the limit approaches the guess's own a90 roughly with the inverse square root of "
            f"the number of targets: {design.text(design.goal)} needs about "
            f"{float(f'{wanted:.2g}'):.0f} targets"
        )
    if high < plan.bound < np.inf:
        texts.append(
            f"the expected a90/95 lies beyond the largest target of {design.text(high)}, where it "
            "depends on the assumed shape of the curve; make larger targets"
        )
    if plan.targets < LEAST_TARGETS:
        texts.append(
            f"no plan listed has the {LEAST_TARGETS} targets that MIL-HDBK-1823A asks for (40 of "
            "signals)"
        )
    return [
        *texts,
        f"medians and quantiles are over {plan.studies} simulated studies, with bounds by the "
        f"{METHOD}; the standard error of the share that demonstrates a limit is at most "
        f"{50 / np.sqrt(plan.studies):.1f} percentage points",
        "repeats of the noise are not additional targets: 50 inspections of each of 8 holes count "
        "as 8 targets",
        "the plan is only as good as the guess: a study whose sizes miss the rise of the true "
        "curve demonstrates less",
    ]


def design_data(design: StudyDesign) -> dict[str, Any]:
    """Return the plan as JSON types; an infinite size becomes None."""
    guess = design.guess
    data: dict[str, Any] = {
        "recommendation": answer(design),
        "unit": design.unit,
        "guess": {
            "link": guess.link,
            "log_size": guess.log_size,
            "mu": float(guess.mu),
            "sigma": float(guess.sigma),
            "a50": guess.size_at(0.5),
            "a90": guess.size_at(0.9),
            "origin": design.origin,
        },
        "range_of_sizes": design.range_of_sizes,
        "goal": design.goal,
        "reaches_goal": design.reaches,
        "plans": [
            {**vars(plan), "recommended": plan is design.recommended} for plan in design.plans
        ],
        "unflawed_sites": SITES_PER_TARGET * design.recommended.targets,
        "hole_free": vars(design.hole_free) if design.hole_free else None,
        "notes": notes(design),
    }
    return dict(jsonable(data))


def save_design_png(path: Path, design: StudyDesign) -> None:
    """Write the figure as a PNG to ``path``; the same design gives the same bytes."""
    blocks.save_png(path, SIZE_IN, lambda canvas: _draw(canvas, design))


def _draw(canvas: Figure, design: StudyDesign) -> None:
    """Draw the expected limit against the number of targets (median, 10-90 %), and the sizes on
    the guessed curve."""
    limits_axes, curve_axes = canvas.subplots(1, 2)
    low, high = design.range_of_sizes
    plan = design.recommended
    plan_rows = np.arange(len(design.plans))
    true_size = plan.true_size
    # a bound that is not demonstrated is infinite
    lows, bounds, ends = np.array([(plan.low, plan.bound, plan.high) for plan in design.plans]).T
    top = max([1.5 * high, *(1.1 * bounds[np.isfinite(bounds)])])
    shown_lows = np.minimum(lows, top)
    shown_ends = np.minimum(ends, top)
    limits_axes.vlines(plan_rows, shown_lows, shown_ends, color=blocks.BLUE, lw=2.2)
    style: dict[str, Any] = {"color": blocks.BLUE, "ms": 7, "mec": "white"}
    label = "median, 10–90 %"
    limits_axes.plot(plan_rows, np.minimum(bounds, 9 * top), "o", label=label, **style)
    for position, bound, end in zip(plan_rows, bounds, ends, strict=True):
        label = "↑" if end > top else ""
        if not np.isfinite(bound):
            label = "none"
        limits_axes.text(position, top, label, ha="center", va="top", color=blocks.BLUE)
    label = plain(f"the guess's a90: {design.text(true_size)}")
    limits_axes.axhline(true_size, color=blocks.RED, lw=1.2, label=label)
    if design.goal is not None:
        label = plain(f"wanted: {design.text(design.goal)}")
        limits_axes.axhline(design.goal, color=blocks.GREEN, lw=1.2, ls="--", label=label)
    limits_axes.set(
        xlim=(-0.6, len(plan_rows) - 0.4),
        ylim=(0.95 * min(true_size, *lows), max(top, 1.02 * (design.goal or 0))),
    )
    limits_axes.set_xticks(plan_rows, [str(plan.targets) for plan in design.plans])
    limits_axes.set(xlabel="targets", ylabel=axis_text("expected a90/95", design.unit))
    limits_axes.set_title(f"{plan.studies} simulated studies each")
    sizes = np.linspace(low, high, 241)[1:]
    label = f"guessed POD, {design.guess.link}"
    curve_axes.plot(sizes, design.guess.pod(sizes), color=blocks.INK, label=label)
    style = {"ms": 9, "mew": 1.0, "color": blocks.BLUE, "clip_on": False}
    label = f"{plan.targets} targets"
    curve_axes.plot(plan.sizes, np.full(plan.targets, -0.08), "|", label=label, **style)
    for pod in (0.5, POD):
        size = design.guess.size_at(pod)
        curve_axes.plot([size, size], [0, pod], color=blocks.GREY, lw=0.9, ls=":")
    curve_axes.set(ylim=(-0.16, 1.04), xlim=(low, high), yticks=np.linspace(0, 1, 6))
    curve_axes.set(
        xlabel=axis_text("size", design.unit),
        ylabel="probability of detection",
        title="Sizes to make",
    )
    for axes in (limits_axes, curve_axes):
        axes.legend(loc="upper left", bbox_to_anchor=(0, -0.16), ncols=1, borderaxespad=0)
