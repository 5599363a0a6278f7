"""The plan of a study: one set of tables for terminal and page, the figure, and JSON's types."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.intervals import SITES_PER_TARGET
from harness.evaluation.pod import design as planned
from harness.evaluation.pod.curve import PodCurve
from harness.report import blocks
from harness.report.pod import axis_text, plain
from harness.tables.schema import Column, Table, jsonable
from harness.tables.text import Grid

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

MEDIANS = (
    'Median of the simulated studies, and their 10 % and 90 % quantiles; "none" where so many demonstrate none. '
    "*: recommended."
)
WIDE = 110
PLACED = {"uniform": "evenly spread", "concentrated": "concentrated"}
SIZE_IN = (11.5, 4.9)
LOOKS = {"uniform": (blocks.BLUE, "o"), "concentrated": (blocks.ORANGE, "s")}


@dataclass(frozen=True, eq=False)
class StudyDesign:
    """All that was found out about a study to be made. Sizes are in ``unit``; ``origin``: of the guess; ``goal``: the
    bound that was wanted, if any."""

    guess: PodCurve
    origin: str
    unit: str
    range_of_sizes: tuple[float, float]
    plans: tuple[planned.StudyPlan, ...]
    recommended: planned.Recommendation
    goal: float | None
    hole_free: planned.HoleFree | None

    @property
    def size_name(self) -> str:
        """a90 and its like."""
        return f"a{100 * self.plans[0].pod:g}"

    @property
    def limit_name(self) -> str:
        """a90/95 and its like."""
        return f"{self.size_name}/{100 * self.plans[0].confidence:g}"

    @property
    def in_unit(self) -> str:
        """The unit in brackets, where there is one."""
        return f" ({self.unit})" if self.unit else ""

    def text(self, size: float) -> str:
        """A size with its unit."""
        return f"{size:.4g}" + (f" {self.unit}" if self.unit else "") if np.isfinite(size) else "no size at all"


def design_html(design: StudyDesign, command: str) -> str:
    """The page as text: answer, figure, plans and sizes, hole-free area; it needs no network."""
    caption = (
        f"Left: the {design.limit_name} that simulated studies demonstrate, with the guess's own size, below which a "
        "limit should not fall. Right: the guessed curve and the sizes of the recommended number of targets."
    )
    body = [
        blocks.heading("What to expect"),
        blocks.figure({"design": blocks.svg("design", SIZE_IN, answer(design), _drawing(design))}, "design", caption),
        plans_grid(design).html(),
        blocks.note(MEDIANS),
        blocks.subheading(f"Sizes to make{design.in_unit}"),
    ]
    for plan in design.plans:
        chosen = plan is design.recommended.plan
        name = f"{plan.targets} targets, {PLACED[plan.placement]}{' (recommended)' if chosen else ''}"
        body.append(
            blocks.fold(name, blocks.tag("pre", " ".join(f"{size:.4g}" for size in plan.sizes)), is_open=chosen)
        )
    body += [
        blocks.heading("Where nothing is"),
        blocks.bullets(hole_free_lines(design)),
        blocks.heading("Notes"),
        blocks.bullets(notes(design)),
    ]
    under = [blocks.note(f"Guess: {guess_text(design)}.")]
    return blocks.page(
        "Planning a study of detection limits", answer(design), [*body, *blocks.command_of(command)], under
    )


def design_parts(design: StudyDesign) -> list[str | Grid]:
    """Return what a terminal shows: the page's tables and sentences."""
    sizes = wrap(" ".join(f"{size:.4g}" for size in design.recommended.plan.sizes), WIDE)
    parts: list[str | Grid] = [f"guess: {guess_text(design)}", "", plans_grid(design), *wrap(MEDIANS, WIDE), ""]
    parts += [f"sizes of the recommended plan (*){design.in_unit}:", *sizes]
    parts += ["", *(f"where nothing is: {line}" for line in hole_free_lines(design))]
    return [*parts, "", *(f"note: {line}" for line in notes(design)), "", answer(design)]


def answer(design: StudyDesign) -> str:
    """The recommendation in a sentence."""
    plan, wish = design.recommended.plan, ""
    if design.goal is not None:
        reached = "nine of ten studies demonstrate" if design.recommended.reaches else "no plan listed is sure to show"
        wish = f"; {reached} the {design.text(design.goal)} that is wanted"
    if not np.isfinite(plan.bound):
        expects = f"even so most studies would demonstrate no {design.limit_name}"
    else:
        spread = f"between {design.text(plan.low)} and {design.text(plan.high)} in eight of ten studies"
        expects = f"expect {design.limit_name} at {design.text(plan.bound)}, {spread}"
    low, high = map(design.text, design.range_of_sizes)
    return f"Make {plan.targets} targets, {PLACED[plan.placement]} from {low} to {high}: {expects}{wish}."


def guess_text(design: StudyDesign) -> str:
    """The guess, and where it is from."""
    guess = design.guess
    sizes = ", ".join(f"{name} {design.text(guess.size_at(pod))}" for name, pod in (("a50", 0.5), ("a90", 0.9)))
    return f"{sizes} ({guess.link}, {'ln size' if guess.log_size else 'size'}); {design.origin}"


def _size(value: float) -> str:
    return f"{value:#.4g}".rstrip(".") if np.isfinite(value) else "none"


PLANS = Table(
    "plans",
    "one row per number of targets and placement",
    (
        Column("", "targets", lambda row: f"{'* ' * row[1]}{row[0].targets}"),
        Column("", "sizes", lambda row: PLACED[row[0].placement]),
        Column("", "limit", lambda row: row[0].bound, text=_size, tone=lambda row: "key" if row[1] else ""),
        Column("", "10 %", lambda row: row[0].low, text=_size),
        Column("", "90 %", lambda row: row[0].high, text=_size),
        Column("", "demonstrated", lambda row: f"{100 * row[0].demonstrated:.1f} %"),
    ),
    formats=(),
    left=2,
)
"""Its rows are pairs: a plan, and whether it is the one recommended."""


def plans_grid(design: StudyDesign) -> Grid:
    """Every plan, the recommended one with a star, and what its studies demonstrate."""
    rows = [(plan, plan is design.recommended.plan) for plan in design.plans]
    return PLANS.grid(rows, heads={"limit": f"{design.limit_name}{design.in_unit}"})


def hole_free_lines(design: StudyDesign) -> list[str]:
    """The unflawed sites and areas that go with the recommended targets."""
    sites = SITES_PER_TARGET * design.recommended.plan.targets
    lines = [f"{sites} unflawed sites: MIL-HDBK-1823A asks for {SITES_PER_TARGET} a target at least"]
    area = design.hole_free
    if area is None:
        return lines
    sure = f"{area.confidence:.0%} confidence".replace("%", " %")
    lines.append(
        f"a threshold for {area.rate_per_m2:g} false calls per m2 needs {area.calibration_boards} hole-free boards of "
        f"{area.board_m2:g} m2 at least; from as few its rate is no more than {area.upper_per_m2:.3g} with {sure}"
    )
    lines += [
        f"to show at most {area.rate_per_m2:g} per m2 with {sure}: {('no', 'one', 'two')[calls]} false "
        f"call{'s' * (calls == 2)} on {square_metres:.4g} m2, which is {area.boards(square_metres)} other boards"
        for calls, square_metres in zip(planned.CALLS, area.areas_m2, strict=True)
    ]
    return lines


def notes(design: StudyDesign) -> list[str]:
    """Return the handbook's minima, Monte Carlo error, and what the plan rests on."""
    plan, high = design.recommended.plan, design.range_of_sizes[1]
    found = [f"the recommended plan: {line}" for line in plan.notes if str(planned.LEAST_TARGETS) not in line]
    if design.goal is not None and not design.recommended.reaches and np.isfinite(plan.high):
        # The bound's distance from the truth is a multiple of a standard error.
        wanted = plan.targets * ((plan.high - plan.true_size) / (design.goal - plan.true_size)) ** 2
        found.append(
            f"the limit nears the guess's own {design.size_name} about as one over the root of the targets: for "
            f"{design.text(design.goal)} some {float(f'{wanted:.2g}'):.0f} would be needed"
        )
    if high < plan.bound < np.inf:
        found.append(
            f"the {design.limit_name} to expect lies beyond the largest target of {design.text(high)}: it rests on the "
            "curve's shape there; make larger ones"
        )
    if not design.recommended.enough:
        found.append(f"no plan listed has the {planned.LEAST_TARGETS} targets that MIL-HDBK-1823A asks for")
    return [
        *found,
        f"MIL-HDBK-1823A: {planned.LEAST_TARGETS} independent targets at least for hits and misses, "
        f"{planned.LEAST_SIGNALS} where signals are recorded (a-hat)",
        f"medians and quantiles of {plan.studies} simulated studies, bound by {plan.method}; the share that "
        f"demonstrates any is known to {50 / np.sqrt(plan.studies):.1f} points or better (one standard error)",
        "repeats of the noise are no further targets: 50 inspections of each of 8 holes are worth 8 targets",
        "the plan is as good as the guess: a study whose sizes miss the rise of the true curve demonstrates less",
    ]


def design_data(design: StudyDesign) -> dict[str, Any]:
    """Return the plan as JSON's types; an infinite size becomes None."""
    area, chosen, guess = design.hole_free, design.recommended, design.guess
    curve = {"link": guess.link, "log_size": guess.log_size, "mu": float(guess.mu), "sigma": float(guess.sigma)}
    said: dict[str, Any] = {
        "recommendation": answer(design),
        "unit": design.unit,
        "guess": {**curve, "a50": guess.size_at(0.5), "a90": guess.size_at(0.9), "origin": design.origin},
        "range_of_sizes": design.range_of_sizes,
        "goal": design.goal,
        "reaches_goal": chosen.reaches,
        "enough_targets": chosen.enough,
        "plans": [{**vars(plan), "recommended": plan is chosen.plan} for plan in design.plans],
        "unflawed_sites": SITES_PER_TARGET * chosen.plan.targets,
        "hole_free": None,
        "notes": notes(design),
    }
    if area is not None:
        said["hole_free"] = {name: value for name, value in vars(area).items() if name != "areas_m2"}
        said["hole_free"]["upper_bound"] = [
            {"false_calls": calls, "area_m2": size, "boards": area.boards(size)}
            for calls, size in zip(planned.CALLS, area.areas_m2, strict=True)
        ]
    return dict(jsonable(said))


def save_design_png(path: Path, design: StudyDesign) -> None:
    """The figure as a PNG at ``path``; the same bytes for the same design."""
    blocks.save_png(path, SIZE_IN, _drawing(design))


def _drawing(design: StudyDesign) -> Callable[[Figure], None]:
    """The limit to expect against the number of targets (median, 10-90 %), and the sizes on the guessed curve."""
    numbers = sorted({plan.targets for plan in design.plans})
    low, high = design.range_of_sizes
    targets = design.recommended.plan.targets

    def draw(canvas: Figure) -> None:
        left, right = canvas.subplots(1, 2)
        top = max([1.5 * high, *(1.1 * plan.bound for plan in design.plans if np.isfinite(plan.bound))])
        for plan in design.plans:
            (colour, marker), side = LOOKS[plan.placement], -1 if plan.placement == "uniform" else 1
            place = numbers.index(plan.targets) + 0.11 * side
            label = f"{PLACED[plan.placement]}: median, 10–90 %" if plan.targets == numbers[0] else None
            left.plot([], [], marker, color=colour, label=label)
            if np.isfinite(plan.low):
                left.plot([place] * 2, [plan.low, min(plan.high, top)], lw=2.2, solid_capstyle="butt", color=colour)
            said = "none" if not np.isfinite(plan.bound) else "↑" if plan.high > top else ""
            left.text(place, top, said, ha="center", va="top", color=colour)
            left.plot([place], [min(plan.bound, 9 * top)], marker, ms=7, mec="white", color=colour)
        true_size = design.plans[0].true_size
        said = plain(f"the guess's {design.size_name}: {design.text(true_size)}")
        left.axhline(true_size, color=blocks.RED, lw=1.2, label=said)
        if design.goal is not None:
            left.axhline(
                design.goal, color=blocks.GREEN, lw=1.2, ls="--", label=plain(f"wanted: {design.text(design.goal)}")
            )
        least = min([true_size, *(plan.low for plan in design.plans)])
        left.set_ylim(0.95 * least, max(top, 1.02 * (design.goal or 0)))
        left.set_xlim(-0.6, len(numbers) - 0.4)
        left.set_xticks(range(len(numbers)), [str(number) for number in numbers])
        left.set(xlabel="targets", ylabel=axis_text(f"{design.limit_name} to expect", design.unit))
        left.set_title(f"{design.plans[0].studies} simulated studies each")
        sizes = np.linspace(low, high, 241)[1:]
        right.plot(sizes, design.guess.pod(sizes), color=blocks.INK, label=f"guessed POD, {design.guess.link}")
        for row, plan in enumerate(plan for plan in design.plans if plan.targets == targets):
            chosen = ", recommended" if plan is design.recommended.plan else ""
            label = f"{targets} targets, {PLACED[plan.placement]}{chosen}"
            y, colour = np.full(targets, -0.08 - 0.08 * row), LOOKS[plan.placement][0]
            right.plot(plan.sizes, y, "|", ms=9, mew=1.0, label=label, color=colour, clip_on=False)
        for pod in (0.5, design.plans[0].pod):
            at = design.guess.size_at(pod)
            right.plot([at, at], [0, pod], color=blocks.GREY, lw=0.9, ls=":")
        right.set(ylim=(-0.24, 1.04), xlim=(low, high), yticks=np.linspace(0, 1, 6))
        right.set(xlabel=axis_text("size", design.unit), ylabel="probability of detection", title="Sizes to make")
        for axes in (left, right):
            axes.legend(loc="upper left", bbox_to_anchor=(0, -0.16), ncols=1, borderaxespad=0)

    return draw
