"""The plan of a study in words and cells, for the terminal and for the page; and as JSON's types."""

from __future__ import annotations

from dataclasses import dataclass
from textwrap import wrap
from typing import Any

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
from harness.tables.grid import aligned

WIDE = 110
"""Characters of a line on the terminal, where words have to be broken."""
PLACED = {"uniform": "evenly spread", "concentrated": "concentrated"}


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


def answer(design: StudyDesign) -> str:
    """The recommendation in a sentence."""
    plan, wish = design.recommended.plan, ""
    if design.goal is not None:
        reached = "nine of ten studies demonstrate" if design.recommended.reaches else "no plan listed is sure to show"
        wish = f"; {reached} the {size_text(design.goal, design)} that is wanted"
    if not np.isfinite(plan.bound):
        expects = f"even so most studies would demonstrate no {design.limit_name}"
    else:
        spread = f"between {size_text(plan.low, design)} and {size_text(plan.high, design)} in eight of ten studies"
        expects = f"expect {design.limit_name} at {size_text(plan.bound, design)}, {spread}"
    low, high = (size_text(one, design) for one in design.range_of_sizes)
    return f"Make {plan.targets} targets, {PLACED[plan.placement]} from {low} to {high}: {expects}{wish}."


def guess_text(design: StudyDesign) -> str:
    """The guess, and where it is from."""
    guess = design.guess
    sizes = ", ".join(f"{name} {size_text(guess.size_at(pod), design)}" for name, pod in (("a50", 0.5), ("a90", 0.9)))
    return f"{sizes} ({guess.link}, {'ln size' if guess.log_size else 'size'}); {design.origin}"


def plan_heads(design: StudyDesign) -> tuple[str, ...]:
    """Of `plan_rows`."""
    return (
        "targets",
        f"{design.limit_name}{_in(design)}",
        "10 %",
        "90 %",
        "demonstrated",
        f"sizes to make{_in(design)}",
    )


def plan_rows(design: StudyDesign) -> list[tuple[bool, tuple[str, ...]]]:
    """(recommended, cells) of every plan."""
    return [
        (
            plan is design.recommended.plan,
            (
                f"{plan.targets} {PLACED[plan.placement]}",
                *(_number(one) for one in (plan.bound, plan.low, plan.high)),
                f"{100 * plan.demonstrated:.1f} %",
                placing(plan),
            ),
        )
        for plan in design.plans
    ]


def placing(plan: StudyPlan) -> str:
    """Where the sizes lie, in a few words: quartiles say how they crowd."""
    least, quarter, middle, three, most = np.quantile(plan.sizes, [0, 0.25, 0.5, 0.75, 1])
    if plan.placement == "uniform":
        return f"{least:.4g} to {most:.4g}, every {(most - least) / max(len(plan.sizes) - 1, 1):.3g}"
    return f"{least:.4g} to {most:.4g}, half from {quarter:.3g} to {three:.3g}, middle {middle:.3g}"


def sizes_text(plan: StudyPlan) -> str:
    """Every size of the plan."""
    return " ".join(f"{size:.4g}" for size in plan.sizes)


def frames_heads(design: StudyDesign) -> tuple[str, ...]:
    """Of `frames_rows`."""
    return (
        "frames",
        f"a50{_in(design)}",
        f"a90{_in(design)}",
        f"{design.limit_name}{_in(design)}",
        "10 %",
        "90 %",
        "demonstrated",
    )


def frames_rows(design: StudyDesign) -> list[tuple[str, ...]]:
    """The guess and its study for each number of frames."""
    return [
        (
            str(one.frames),
            _number(one.curve.size_at(0.5)),
            _number(one.curve.size_at(0.9)),
            *(_number(value) for value in (one.plan.bound, one.plan.low, one.plan.high)),
            f"{100 * one.plan.demonstrated:.1f} %",
        )
        for one in design.frames
    ]


def frames_note(design: StudyDesign) -> str:
    """What carrying the guess takes for granted."""
    return (
        f"The guess is for {design.guessed_with} averaged frames. The others take sizes of equal chance to shrink with "
        "the noise's standard deviation: so for the depth of damage of one diameter, about so for a diameter, the more "
        "so the larger it is than the camera's blur. Each row is a study of the recommended number of targets, evenly "
        "spread, with the same luck."
    )


def repeats_heads(design: StudyDesign) -> tuple[str, ...]:
    """Of `repeats_rows`."""
    name = design.limit_name
    return (
        "luck of the target's own",
        f"right: {name}{_in(design)}",
        "too small",
        f"WRONG: {name}{_in(design)}",
        "too small",
    )


def repeats_rows(design: StudyDesign) -> list[tuple[str, ...]]:
    """The right and the wrong limit for each share of luck."""
    return [
        (
            {0.0: "none", 0.5: "half", 1.0: "all"}.get(row.share, f"{100 * row.share:g} %"),
            *(_number(row.right), f"{100 * row.right_too_small:.1f} %"),
            *(_number(row.wrong), f"{100 * row.wrong_too_small:.1f} %"),
        )
        for row in design.repeats
    ]


def repeats_note(design: StudyDesign) -> str:
    """What the rows of repeats say."""
    row, plan = design.repeats[0], design.plans[0]
    return (
        f"{row.repeats} repeats of {row.targets} targets are {row.targets} targets. {row.studies} simulated studies of "
        f"{row.repeats * row.targets} inspections each; medians, and the share of limits below the guess's "
        f"{design.size_name} of {size_text(row.true_size, design)}, which may be {100 * (1 - plan.confidence):.3g} %. "
        "The right limit counts targets, the wrong one inspections, which is safe only where no target has luck of its "
        "own: its place, its edges, the pixels that fall on it. No repeat draws that again."
    )


def repeats_examples(design: StudyDesign) -> list[str]:
    """One simulated study a row, in words."""
    return [
        f"for example, with {cells[0]} of the luck its own: {row.text}"
        for row, cells in zip(design.repeats, repeats_rows(design), strict=True)
        if row.text
    ]


def hole_free_lines(design: StudyDesign) -> list[str]:
    """The unflawed sites and areas that go with the recommended targets."""
    targets = design.recommended.plan.targets
    lines = [
        f"{SITES_PER_TARGET * targets} unflawed sites: MIL-HDBK-1823A asks for {SITES_PER_TARGET} a target at least"
    ]
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
    """What to keep in mind: the handbook's minima, Monte Carlo error, and what the plan rests on."""
    plan, (low, high) = design.recommended.plan, design.range_of_sizes
    error = 100 * np.sqrt(max(plan.demonstrated * (1 - plan.demonstrated), 0.25 / plan.studies) / plan.studies)
    found = [f"the recommended plan: {note}" for note in plan.notes if str(LEAST_TARGETS) not in note]
    if design.goal is not None and not design.recommended.reaches and np.isfinite(plan.high):
        # The bound's distance from the truth is a multiple of a standard error.
        wanted = plan.targets * ((plan.high - plan.true_size) / (design.goal - plan.true_size)) ** 2
        found.append(
            f"the limit nears the guess's own {design.size_name} about as one over the root of the targets: for "
            f"{size_text(design.goal, design)} some {float(f'{wanted:.2g}'):.0f} would be needed"
        )
    if high < plan.bound < np.inf:
        found.append(
            f"the {design.limit_name} to expect lies beyond the largest target of {size_text(high, design)}: it "
            "rests on the curve's shape there; make larger ones"
        )
    for one in design.frames:
        at = f"the guess for {one.frames} frame{'s' * (one.frames > 1)} has"
        if not low <= one.plan.true_size <= high:
            size = size_text(one.plan.true_size, design)
            found.append(f"{at} {design.size_name} = {size} outside the sizes: its limit is extrapolated")
        elif one.curve.size_at(0.5) < low:
            size = size_text(one.curve.size_at(0.5), design)
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


def design_text(design: StudyDesign) -> str:
    """All of it as plain lines, columns aligned."""
    rows = [(("* " if chosen else "  ") + cells[0], *cells[1:]) for chosen, cells in plan_rows(design)]
    parts = [f"guess: {guess_text(design)}", ""]
    heads = plan_heads(design)
    parts += aligned([(f"  {heads[0]}", *heads[1:]), *rows])
    parts += ["", f"sizes of the recommended plan (*){_in(design)}:"]
    parts += wrap(sizes_text(design.recommended.plan), WIDE)
    if design.frames:
        parts += ["", *aligned([frames_heads(design), *frames_rows(design)], left=0), *wrap(frames_note(design), WIDE)]
    if design.repeats:
        parts += ["", *aligned([repeats_heads(design), *repeats_rows(design)]), *repeats_examples(design)]
        parts += wrap(repeats_note(design), WIDE)
    parts += ["", *(f"where nothing is: {line}" for line in hole_free_lines(design))]
    parts += ["", *(f"note: {note}" for note in notes(design)), "", answer(design)]
    return "\n".join(parts)


def design_data(design: StudyDesign) -> dict[str, Any]:
    """As JSON's types; an infinite size becomes None."""
    guess = design.guess
    area = design.hole_free
    return {
        "recommendation": answer(design),
        "unit": design.unit,
        "guess": {**_curve_data(guess), "origin": design.origin},
        "range_of_sizes": list(design.range_of_sizes),
        "goal": design.goal,
        "reaches_goal": design.recommended.reaches,
        "enough_targets": design.recommended.enough,
        "plans": [{**_plan_data(plan), "recommended": plan is design.recommended.plan} for plan in design.plans],
        "guessed_with_frames": design.guessed_with,
        "frames": [
            {"frames": one.frames, "guess": _curve_data(one.curve), "plan": _plan_data(one.plan)}
            for one in design.frames
        ],
        "repeats": [_repeats_data(row) for row in design.repeats],
        "unflawed_sites": SITES_PER_TARGET * design.recommended.plan.targets,
        "hole_free": None
        if area is None
        else {
            **{name: getattr(area, name) for name in ("rate_per_m2", "board_m2", "confidence", "calibration_boards")},
            **{name: getattr(area, name) for name in ("expected_per_m2", "upper_per_m2")},
            "upper_bound": [
                {"false_calls": calls, "area_m2": size, "boards": area.boards(size)}
                for calls, size in zip(CALLS, area.areas_m2, strict=True)
            ],
        },
        "notes": notes(design),
    }


def _curve_data(curve: PodCurve) -> dict[str, Any]:
    return {
        "link": curve.link,
        "log_size": curve.log_size,
        "mu": float(curve.mu),
        "sigma": float(curve.sigma),
        "a50": finite(curve.size_at(0.5)),
        "a90": finite(curve.size_at(0.9)),
    }


def _plan_data(plan: StudyPlan) -> dict[str, Any]:
    sizes = {name: finite(getattr(plan, name)) for name in ("true_size", "bound", "low", "high", "demonstrated")}
    plain = {name: getattr(plan, name) for name in ("targets", "placement", "pod", "confidence", "method", "studies")}
    return {**plain, **sizes, "sizes": plan.sizes.tolist(), "notes": list(plan.notes)}


def _repeats_data(row: RepeatedStudies) -> dict[str, Any]:
    counts = {name: getattr(row, name) for name in ("share", "targets", "repeats", "studies", "text")}
    numbers = ("true_size", "right", "wrong", "right_demonstrated", "wrong_demonstrated")
    shares = ("right_too_small", "wrong_too_small")
    return {**counts, **{name: finite(getattr(row, name)) for name in (*numbers, *shares)}, "sizes": row.sizes.tolist()}


def _number(value: float) -> str:
    return f"{value:#.4g}".rstrip(".") if np.isfinite(value) else "none"


def size_text(value: float, design: StudyDesign) -> str:
    """A size with its unit."""
    return f"{value:.4g}" + (f" {design.unit}" if design.unit else "") if np.isfinite(value) else "no size at all"


def _in(design: StudyDesign) -> str:
    return f" ({design.unit})" if design.unit else ""
