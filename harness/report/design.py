"""The plan of a study: one set of tables for terminal and page, the figure, and JSON's types."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.pod.curve import PodCurve
from harness.evaluation.pod.design import (
    CALLS,
    LEAST_SIGNALS,
    LEAST_TARGETS,
    FramesPlan,
    HoleFree,
    Recommendation,
    RepeatedStudies,
    StudyPlan,
)
from harness.evaluation.pod.false_calls import SITES_PER_TARGET
from harness.evaluation.pod.statement import finite
from harness.report.blocks import bullets, command_of, figure, fold, heading, note, page, subheading, tag
from harness.report.canvas import BLUE, GREEN, GREY, INK, ORANGE, RED, save_png, svg
from harness.report.pod import axis_text, plain
from harness.tables.grid import Cell, Grid

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDE = 110
"""Characters of a line on the terminal, where words have to be broken."""
PLACED = {"uniform": "evenly spread", "concentrated": "concentrated"}
SIZE_IN = (11.5, 4.9)
LOOKS: dict[str, dict[str, Any]] = {
    "uniform": {"color": BLUE, "marker": "o"},
    "concentrated": {"color": ORANGE, "marker": "s"},
}
APART = 0.11
"""Half the distance between the placements of one number of targets, whose places are 1 apart."""
ROOM = 1.25
"""Height of the panel over that of the highest thing in it; what is higher ends there, with an arrow."""
FARTHEST = 2.0
"""Quantiles are drawn up to this many times the largest target, medians wherever they are: where POD hardly rises a
quantile of a thousand millimetres would leave nothing to be seen of the others."""


@dataclass(frozen=True, eq=False)
class StudyDesign:
    """All that was found out about a study to be made. Sizes are in ``unit``; ``origin`` says where the guess is from;
    ``goal``: the bound that was wanted, None without a wish; ``guessed_with``: frames of the guess, where carried."""

    guess: PodCurve
    origin: str
    unit: str
    range_of_sizes: tuple[float, float]
    plans: tuple[StudyPlan, ...]
    recommended: Recommendation
    goal: float | None
    guessed_with: int | None
    frames: tuple[FramesPlan, ...]
    repeats: tuple[RepeatedStudies, ...]
    hole_free: HoleFree | None

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
    """The page as text: answer, figure, plans and sizes, frames, repeats, hole-free area; it needs no network."""
    caption = (
        f"Left: the {design.limit_name} that simulated studies demonstrate, with the guess's own size, below which a "
        "limit should not fall. Right: the guessed curve and the sizes of the recommended number of targets."
    )
    medians = (
        'Median of the simulated studies, and their 10 % and 90 % quantiles; "none" where so many demonstrate none. '
        "*: recommended."
    )
    body = [
        heading("What to expect"),
        figure({"design": svg("design", SIZE_IN, answer(design), _drawing(design))}, "design", caption),
        plans_grid(design).html(),
        note(medians),
        subheading(f"Sizes to make{design.in_unit}"),
    ]
    for plan in design.plans:
        chosen = plan is design.recommended.plan
        name = f"{plan.targets} targets, {PLACED[plan.placement]}{' (recommended)' if chosen else ''}"
        body.append(fold(name, tag("pre", _sizes_text(plan)), is_open=chosen))
    if design.frames:
        body += [heading("Averaged frames"), frames_grid(design).html(), note(_frames_note(design))]
    if design.repeats:
        body += [heading("Repeats are not targets"), repeats_grid(design).html(), note(_repeats_note(design))]
        body.append(bullets(_repeats_examples(design)))
    body += [heading("Where nothing is"), bullets(hole_free_lines(design)), heading("Notes"), bullets(notes(design))]
    under = [note(f"Guess: {guess_text(design)}.")]
    return page("Planning a study of detection limits", answer(design), [*body, *command_of(command)], under)


def design_parts(design: StudyDesign) -> list[str | Grid]:
    """Return what a terminal shows: the page's tables and sentences."""
    parts: list[str | Grid] = [f"guess: {guess_text(design)}", "", plans_grid(design)]
    parts += [
        "",
        f"sizes of the recommended plan (*){design.in_unit}:",
        *wrap(_sizes_text(design.recommended.plan), WIDE),
    ]
    if design.frames:
        parts += ["", frames_grid(design), *wrap(_frames_note(design), WIDE)]
    if design.repeats:
        parts += ["", repeats_grid(design), *_repeats_examples(design), *wrap(_repeats_note(design), WIDE)]
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


def plans_grid(design: StudyDesign) -> Grid:
    """Every plan, the recommended one with a star: what its studies demonstrate, and where its sizes lie (quartiles say
    how they crowd)."""
    heads = ("targets", f"{design.limit_name}{design.in_unit}", "10 %", "90 %", "demonstrated")
    rows = []
    for plan in design.plans:
        chosen = plan is design.recommended.plan
        least, quarter, middle, three, most = np.quantile(plan.sizes, [0, 0.25, 0.5, 0.75, 1])
        placing = f"half from {quarter:.3g} to {three:.3g}, middle {middle:.3g}"
        if plan.placement == "uniform":
            placing = f"every {(most - least) / max(len(plan.sizes) - 1, 1):.3g}"
        cells = [f"{'* ' if chosen else ''}{plan.targets} {PLACED[plan.placement]}", *_expected(plan)]
        cells.append(f"{least:.4g} to {most:.4g}, {placing}")
        rows.append([Cell(text, "key" if chosen else "") for text in cells])
    return Grid.of((*heads, f"sizes to make{design.in_unit}"), rows)


def frames_grid(design: StudyDesign) -> Grid:
    """The guess and its study for each number of frames."""
    unit = design.in_unit
    heads = ("frames", f"a50{unit}", f"a90{unit}", f"{design.limit_name}{unit}", "10 %", "90 %", "demonstrated")
    rows = [
        (str(each.frames), *(_number(each.curve.size_at(pod)) for pod in (0.5, 0.9)), *_expected(each.plan))
        for each in design.frames
    ]
    return Grid.of(heads, rows, left=0)


def _expected(plan: StudyPlan) -> list[str]:
    return [*(_number(size) for size in (plan.bound, plan.low, plan.high)), f"{100 * plan.demonstrated:.1f} %"]


def _sizes_text(plan: StudyPlan) -> str:
    return " ".join(f"{size:.4g}" for size in plan.sizes)


def _frames_note(design: StudyDesign) -> str:
    return (
        f"The guess is for {design.guessed_with} averaged frames. The others take sizes of equal chance to shrink with "
        "the noise's standard deviation: so for the depth of damage of one diameter, about so for a diameter, the more "
        "so the larger it is than the camera's blur. Each row is a study of the recommended number of targets, evenly "
        "spread, with the same luck."
    )


def repeats_grid(design: StudyDesign) -> Grid:
    """The right and the wrong limit for each share of luck."""
    limit = f"{design.limit_name}{design.in_unit}"
    heads = ("luck of the target's own", f"right: {limit}", "too small", f"WRONG: {limit}", "too small")
    rows = [
        (
            _share_text(row),
            *(_number(row.right), f"{100 * row.right_too_small:.1f} %"),
            *(_number(row.wrong), f"{100 * row.wrong_too_small:.1f} %"),
        )
        for row in design.repeats
    ]
    return Grid.of(heads, rows)


def _share_text(row: RepeatedStudies) -> str:
    return {0.0: "none", 0.5: "half", 1.0: "all"}.get(row.share, f"{100 * row.share:g} %")


def _repeats_note(design: StudyDesign) -> str:
    row, plan = design.repeats[0], design.plans[0]
    return (
        f"{row.repeats} repeats of {row.targets} targets are {row.targets} targets. {row.studies} simulated studies of "
        f"{row.repeats * row.targets} inspections each; medians, and the share of limits below the guess's "
        f"{design.size_name} of {design.text(row.true_size)}, which may be {100 * (1 - plan.confidence):.3g} %. "
        "The right limit counts targets, the wrong one inspections, which is safe only where no target has luck of its "
        "own: its place, its edges, the pixels that fall on it. No repeat draws that again."
    )


def _repeats_examples(design: StudyDesign) -> list[str]:
    """One simulated study a row, in words."""
    return [
        f"for example, with {_share_text(row)} of the luck its own: {row.text}" for row in design.repeats if row.text
    ]


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
        f"{area.board_m2:g} m2 at least; from as few its rate is {area.expected_per_m2:.3g} per m2 on average, and no "
        f"more than {area.upper_per_m2:.3g} with {sure}"
    )
    lines += [
        f"to show at most {area.rate_per_m2:g} per m2 with {sure}: {('no', 'one', 'two')[calls]} false "
        f"call{'s' * (calls == 2)} on {square_metres:.4g} m2, which is {area.boards(square_metres)} other boards"
        for calls, square_metres in zip(CALLS, area.areas_m2, strict=True)
    ]
    return lines


def notes(design: StudyDesign) -> list[str]:
    """Return what to keep in mind: the handbook's minima, Monte Carlo error, and what the plan rests on."""
    plan, (low, high) = design.recommended.plan, design.range_of_sizes
    error = 100 * np.sqrt(max(plan.demonstrated * (1 - plan.demonstrated), 0.25 / plan.studies) / plan.studies)
    found = [f"the recommended plan: {line}" for line in plan.notes if str(LEAST_TARGETS) not in line]
    if design.goal is not None and not design.recommended.reaches and np.isfinite(plan.high):
        # The bound's distance from the truth is a multiple of a standard error.
        wanted = plan.targets * ((plan.high - plan.true_size) / (design.goal - plan.true_size)) ** 2
        found.append(
            f"the limit nears the guess's own {design.size_name} about as one over the root of the targets: for "
            f"{design.text(design.goal)} some {float(f'{wanted:.2g}'):.0f} would be needed"
        )
    if high < plan.bound < np.inf:
        found.append(
            f"the {design.limit_name} to expect lies beyond the largest target of {design.text(high)}: it "
            "rests on the curve's shape there; make larger ones"
        )
    for each in design.frames:
        at = f"the guess for {each.frames} frame{'s' * (each.frames > 1)} has"
        if not low <= each.plan.true_size <= high:
            size = design.text(each.plan.true_size)
            found.append(f"{at} {design.size_name} = {size} outside the sizes: its limit is extrapolated")
        elif each.curve.size_at(0.5) < low:
            size = design.text(each.curve.size_at(0.5))
            found.append(f"{at} a50 = {size} below the sizes: much of the rise is not inspected; make smaller targets")
    if not design.recommended.enough:
        found.append(f"no plan listed has the {LEAST_TARGETS} targets that MIL-HDBK-1823A asks for")
    return [
        *found,
        f"MIL-HDBK-1823A: {LEAST_TARGETS} independent targets at least for hits and misses, {LEAST_SIGNALS} where "
        "signals are recorded (a-hat)",
        f"medians and quantiles of {plan.studies} simulated studies, bound by {plan.method}; the share that "
        f"demonstrates any is known to {error:.1f} points (one standard error)",
        "the plan is as good as the guess: a study whose sizes miss the rise of the true curve demonstrates less; "
        "evenly spread sizes suffer less from that than concentrated ones",
    ]


def design_data(design: StudyDesign) -> dict[str, Any]:
    """Return the plan as JSON's types; an infinite size becomes None."""
    area = design.hole_free
    told = ("rate_per_m2", "board_m2", "confidence", "calibration_boards", "expected_per_m2", "upper_per_m2")
    return {
        "recommendation": answer(design),
        "unit": design.unit,
        "guess": {**_curve_data(design.guess), "origin": design.origin},
        "range_of_sizes": list(design.range_of_sizes),
        "goal": design.goal,
        "reaches_goal": design.recommended.reaches,
        "enough_targets": design.recommended.enough,
        "plans": [{**_plan_data(plan), "recommended": plan is design.recommended.plan} for plan in design.plans],
        "guessed_with_frames": design.guessed_with,
        "frames": [
            {"frames": each.frames, "guess": _curve_data(each.curve), "plan": _plan_data(each.plan)}
            for each in design.frames
        ],
        "repeats": [_repeats_data(row) for row in design.repeats],
        "unflawed_sites": SITES_PER_TARGET * design.recommended.plan.targets,
        "hole_free": area
        and {
            **{name: getattr(area, name) for name in told},
            "upper_bound": [
                {"false_calls": calls, "area_m2": size, "boards": area.boards(size)}
                for calls, size in zip(CALLS, area.areas_m2, strict=True)
            ],
        },
        "notes": notes(design),
    }


def _curve_data(curve: PodCurve) -> dict[str, Any]:
    sizes = {"a50": finite(curve.size_at(0.5)), "a90": finite(curve.size_at(0.9))}
    return {"link": curve.link, "log_size": curve.log_size, "mu": float(curve.mu), "sigma": float(curve.sigma)} | sizes


def _plan_data(plan: StudyPlan) -> dict[str, Any]:
    sizes = {name: finite(getattr(plan, name)) for name in ("true_size", "bound", "low", "high", "demonstrated")}
    told = {name: getattr(plan, name) for name in ("targets", "placement", "pod", "confidence", "method", "studies")}
    return {**told, **sizes, "sizes": plan.sizes.tolist(), "notes": list(plan.notes)}


def _repeats_data(row: RepeatedStudies) -> dict[str, Any]:
    counts = {name: getattr(row, name) for name in ("share", "targets", "repeats", "studies", "text")}
    numbers = ("true_size", "right", "wrong", "right_demonstrated", "wrong_demonstrated")
    shares = ("right_too_small", "wrong_too_small")
    return {**counts, **{name: finite(getattr(row, name)) for name in (*numbers, *shares)}, "sizes": row.sizes.tolist()}


def _number(value: float) -> str:
    return f"{value:#.4g}".rstrip(".") if np.isfinite(value) else "none"


def save_design_png(path: Path, design: StudyDesign) -> None:
    """The figure as a PNG of 160 dots an inch at ``path``; the same bytes for the same design."""
    save_png(path, SIZE_IN, _drawing(design))


def _drawing(design: StudyDesign) -> Callable[[Figure], None]:
    """The limit to expect against the number of targets, and the sizes on the guessed curve."""

    def draw(canvas: Figure) -> None:
        expected, curve = canvas.subplots(1, 2)
        _draw_expected(expected, design)
        _draw_guess(curve, design)

    return draw


def _draw_expected(axes: Axes, design: StudyDesign) -> None:
    """Median and the 10-90 % bar of every plan, the guess's own size as a line."""
    numbers = sorted({plan.targets for plan in design.plans})
    true_size = design.plans[0].true_size
    # where the panel's contents begin, and where the panel ends
    farthest = FARTHEST * design.range_of_sizes[1]
    ends = [min(plan.high, farthest) for plan in design.plans if np.isfinite(plan.high)]
    marks = [true_size, *ends, *(size for plan in design.plans for size in (plan.bound, plan.low) if np.isfinite(size))]
    floor = min(marks)
    top = floor + ROOM * max(max(marks) - floor, 0.05 * floor)
    for placement in dict.fromkeys(plan.placement for plan in design.plans):
        colour, marker = LOOKS[placement]["color"], LOOKS[placement]["marker"]
        for plan in (plan for plan in design.plans if plan.placement == placement):
            place = numbers.index(plan.targets) + APART * (-1 if placement == "uniform" else 1)
            if not np.isfinite(plan.low):
                axes.text(place, top, "none", ha="center", va="top", rotation=90, color=colour)
                continue
            axes.plot([place] * 2, [plan.low, min(plan.high, top)], lw=2.2, solid_capstyle="butt", color=colour)
            if plan.high > top:
                axes.plot([place], [top], "^", ms=7, clip_on=False, color=colour)
            if np.isfinite(plan.bound):
                axes.plot([place], [plan.bound], marker, ms=7, mec="white", mew=0.8, zorder=3, color=colour)
        axes.plot([], [], marker, label=f"{PLACED[placement]}: median, 10–90 %", color=colour)
    if any(plan.low < np.inf and plan.high > top for plan in design.plans):
        axes.plot([], [], "^", color=GREY, label="goes on, or has no end")
    axes.axhline(true_size, color=RED, lw=1.2, label=plain(f"the guess's {design.size_name}: {design.text(true_size)}"))
    if design.goal is not None:
        axes.axhline(design.goal, color=GREEN, lw=1.2, ls="--", label=plain(f"wanted: {design.text(design.goal)}"))
    axes.set_ylim(floor - 0.1 * (top - floor), max(top, 1.02 * (design.goal or 0)))
    axes.set_xlim(-0.6, len(numbers) - 0.4)
    axes.set_xticks(range(len(numbers)), [str(number) for number in numbers])
    axes.grid(axis="x", visible=False)
    axes.set_xlabel("targets")
    axes.set_ylabel(axis_text(f"{design.limit_name} to expect", design.unit))
    axes.set_title(f"{design.plans[0].studies} simulated studies each")
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.16), ncols=2, borderaxespad=0)


def _draw_guess(axes: Axes, design: StudyDesign) -> None:
    """The guessed curve, and below it the sizes of the recommended number of targets, a stroke each."""
    low, high = design.range_of_sizes
    sizes = np.linspace(low, high, 241) if low > 0 else np.linspace(high / 240, high, 240)
    targets = design.recommended.plan.targets
    axes.plot(sizes, design.guess.pod(sizes), color=INK, label=f"guessed POD, {design.guess.link}")
    plans = [plan for plan in design.plans if plan.targets == targets]
    for row, plan in enumerate(plans):
        chosen = ", recommended" if plan is design.recommended.plan else ""
        style: dict[str, Any] = {"color": LOOKS[plan.placement]["color"], "clip_on": False}
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
