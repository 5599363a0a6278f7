"""Presents a probability of detection curve: tables for terminal and page, and a figure with the
inspections."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.pod.ahat import AhatFit
from harness.evaluation.pod.curve import Bound
from harness.evaluation.pod.hit_miss import NEAR_DEVIANCE
from harness.evaluation.pod.statement import POD, ModelRow, PodStatement
from harness.records.schema import Column, Table
from harness.report import blocks
from harness.report.blocks import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, RED
from harness.vocabulary.text import ROUGH, Grid

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

MOST_MARKS = 2000
"""Most inspections that a figure draws as vector marks; more are rasterised."""
STRIPE = 0.10
"""Height of the stripes above 1 and below 0 with hits and misses, in units of POD."""
GOLDEN = 0.6180339887498949
"""Multiples of the golden ratio spread strokes evenly without random numbers."""
VALIDITY = (
    "The limit holds for inspections like these: the same kind of flaws and parts, the same"
    " procedure, and the sizes inspected. Targets are assumed to be independent. Sizes beyond the"
    " largest target are extrapolated."
)

# ---------------------------------------------------------------- page and terminal


def pod_html(statement: PodStatement, command: str) -> str:
    """Return the page as text: limit, figure, models, tests, notes; it needs no network."""
    caption = (
        "The curve with its pointwise band, the inspections, and the sizes at POD 0.5 and 0.9."
        " a90/95 is the size at which the band's lower edge reaches 0.9."
    )
    size_in, draw = _plan(statement)
    drawn = blocks.svg("pod", size_in, f"{answer(statement)} {statement.counts}.", draw)
    body = [
        blocks.heading("Curve"),
        blocks.figure({"pod": drawn}, "pod", caption),
        blocks.heading("Sizes"),
        sizes_grid(statement).html(),
        blocks.heading("Models"),
        blocks.note(_choice_note(statement)),
        models_grid(statement).html(),
        blocks.heading("Fit"),
        fit_grid(statement).html(),
    ]
    if statement.tests:
        body += [blocks.subheading("Tests"), _tests_grid(statement).html()]
    body += [
        blocks.heading("Notes"),
        blocks.bullets((*statement.notes, VALIDITY)),
        *blocks.command_of(command),
    ]
    basis = f"{statement.kind.capitalize()}: {statement.counts}. Model: {statement.model}."
    title = f"Probability of detection: {statement.read.path.name}"
    return blocks.page(title, answer(statement), body, [blocks.note(basis)], statement.doubts)


def _choice_note(statement: PodStatement) -> str:
    """Say how the curve was chosen, and which models its bound covers."""
    text = (
        "The models are sorted by deviance; a smaller deviance means a better fit. Unless a model"
        " was requested, the deviance selects the curve, but never the limit."
    )
    if statement.average:
        text += (
            f" {len(statement.fits)} of the models are within {NEAR_DEVIANCE:g} of the least (for"
            " each inspection of a target), too little to distinguish them: a90/95 and the band are"
            " those of their average, weighted by likelihood."
        )
    return text


def _tests_grid(statement: PodStatement) -> Grid:
    rows = []
    for test, p, meaning in statement.tests:
        rows.append((test, "< 0.001" if p < 0.001 else f"{p:.3f}", meaning))
    return Grid.of(("test", "p", "reads"), rows, left=3)


def pod_parts(statement: PodStatement) -> list[str | Grid]:
    """Return the parts for a terminal: the page's tables and sentences."""
    parts: list[str | Grid] = [f"warning: {doubt}" for doubt in statement.doubts]
    parts += [
        f"{statement.read.path}: {statement.kind}, {statement.counts}",
        f"model: {statement.model}",
        "",
        models_grid(statement),
        "",
        sizes_grid(statement),
        "",
        fit_grid(statement),
    ]
    if statement.tests:
        parts.append("")
        parts += [f"{test}: p = {p:.3g}, {meaning}" for test, p, meaning in statement.tests]
    if statement.notes:
        parts.append("")
        parts += [f"note: {line}" for line in statement.notes]
    return [*parts, "", answer(statement)]


def sizes_grid(statement: PodStatement) -> Grid:
    """Return the table of a50, a90 and a90/95 with the method of each."""
    models = len(statement.fits)
    of_models = f" ({models} of {len(statement.models)})" if statement.average else ""
    digits = _digits(statement)
    unit = statement.unit
    rows = [
        ("a50", sized(statement.a50, unit, digits), "estimate"),
        ("a90", sized(statement.a90, unit, digits), "estimate"),
        (
            "a90/95",
            _bound_text(statement.bound, unit, digits),
            f"{statement.bound.method}{of_models}: the limit to quote",
        ),
    ]
    return Grid.of(("", "size", "how"), rows, left=3)


def _model_name(row: ModelRow) -> str:
    if row.chosen:
        return f"{row.name} (used)"
    return f"{row.name} (compared)" if row.in_bound else row.name


MODELS = Table(
    "models",
    "one row per model that was tried",
    (
        Column("", "model", _model_name),
        Column("", "deviance", lambda row: f"{row.deviance:.2f}"),
        Column("", "a50", lambda row: sized(row.a50, "")),
        Column("", "a90", lambda row: sized(row.a90, "")),
        Column(
            "",
            "a90/95",
            lambda row: _bound_text(row.bound, ""),
            tone=lambda row: "key" if row.chosen else "",
        ),
    ),
    formats=(),
)


def models_grid(statement: PodStatement) -> Grid:
    """Return the table of models; it marks the model of the curve, and the models whose bounds are
    compared with it."""
    of_unit = f" ({statement.unit})" if statement.unit else ""
    heads = {name: f"{name}{of_unit}" for name in ("a50", "a90", "a90/95")}
    return MODELS.grid(statement.models, heads=heads)


def fit_grid(statement: PodStatement) -> Grid:
    """Return the table with the numbers of the fit."""
    rows = [(name, f"{value:.5g}") for name, value in statement.numbers.items()]
    return Grid.of(("of the fit", "value"), rows)


def _bound_text(bound: Bound, unit: str, digits: int = 2) -> str:
    return sized(bound.value, unit, digits) if bound.demonstrated else "not demonstrated"


def _digits(statement: PodStatement) -> int:
    """Return 3 digits if a90 and its bound are so close that a third digit is needed, or else 2."""
    gap = statement.bound.value - statement.a90
    return 3 if 2 * gap <= ROUGH * statement.a90 else 2


def save_pod_png(path: Path, statement: PodStatement) -> None:
    """Write the figure as a PNG to ``path``; the same statement gives the same bytes."""
    size_in, draw = _plan(statement)
    blocks.save_png(path, size_in, draw)


def answer(statement: PodStatement) -> str:
    """State the limit in one sentence."""
    bound = statement.bound
    if not bound.demonstrated:
        reason = bound.why.removeprefix("not demonstrated: ")
        return f"a90/95 is not demonstrated: {reason}."
    limit = sized(bound.value, statement.unit, _digits(statement))
    return (
        f"A flaw of {limit} is found 90 % of the time, with {_confidence(bound)} confidence"
        f" (a90/95, {bound.method})."
    )


def _confidence(bound: Bound) -> str:
    return f"{bound.confidence:.0%}".replace("%", " %")


def sized(value: float, unit: str, digits: int = 2) -> str:
    """Return a size with that many significant digits and its unit, or "not reached" if it is not
    finite."""
    if not np.isfinite(value):
        return "not reached"
    _, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    decimals = max(0, digits - 1 - int(exponent))
    number = f"{value:.{decimals}f}"
    return f"{number} {unit}" if unit else number


def axis_text(column: str, unit: str) -> str:
    """Return ``column`` with its unit in brackets, if it has a unit."""
    return plain(f"{column} ({unit})" if unit else column)


def plain(text: str) -> str:
    """Escape the user's text for Matplotlib, which would typeset text between dollar signs."""
    return text.replace("$", r"\$")


# ---------------------------------------------------------------- figure


def _plan(statement: PodStatement) -> tuple[tuple[float, float], Callable[[Figure], None]]:
    """Return the figure's size and the function that draws it: a second panel shows signals, if
    there are any."""

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, 2 if statement.signal else 1, squeeze=False)[0]
        if statement.signal:
            draw_signals(panels[0], statement, statement.signal)
            panels[0].set(ylabel=plain(statement.read.response_column), title="Signals")
        draw_pod(panels[-1], statement)
        if statement.curve.log_size:
            _log_sizes(panels[-1], statement.sizes)
        panels[-1].set_ylabel("probability of detection")
        panels[-1].set_title(f"Probability of detection, {statement.read.targets} targets")
        for axes in panels:
            axes.set_xlim(statement.sizes[0], statement.sizes[-1])
            axes.set_xlabel(axis_text(statement.read.size_column, statement.unit))
            axes.legend(
                loc="upper left",
                bbox_to_anchor=(0, -0.16),
                ncols=2,
                borderaxespad=0,
            )

    return ((11.0, 4.8) if statement.signal else (8.6, 5.2)), draw


def draw_pod(axes: Axes, statement: PodStatement) -> None:
    """Draw the curve, the band, the data and the sizes to quote."""
    sizes = statement.sizes
    lower, upper = statement.band
    band = f"{_confidence(statement.bound)} band, {statement.bound.method}"
    axes.fill_between(sizes, lower, upper, color=BLUE, alpha=0.16, lw=0)
    axes.plot(
        sizes,
        lower,
        color=BLUE,
        lw=0.9,
        ls="--",
        label=band,
    )
    axes.plot(sizes, upper, color=BLUE, lw=0.9, ls="--")
    pod = statement.curve.pod(sizes)
    axes.plot(sizes, pod, color=BLUE, lw=2.0, label=f"POD, {statement.model}")
    axes.axhline(POD, color=GREY, lw=0.8, ls=":")
    if statement.signal is None:
        draw_hits(axes, statement.read.size, statement.read.response == 1)
    digits = _digits(statement)
    bound = statement.bound.value
    bound_text = "not demonstrated"
    if np.isfinite(bound):
        bound_text = sized(bound, statement.unit, digits)
    a50_text = sized(statement.a50, statement.unit, digits)
    a90_text = sized(statement.a90, statement.unit, digits)
    _draw_size(axes, sizes, statement.a50, 0.5, GREEN, f"a50: {a50_text}")
    _draw_size(axes, sizes, statement.a90, POD, ORANGE, f"a90: {a90_text}")
    _draw_size(axes, sizes, bound, POD, RED, f"a90/95: {bound_text}")
    hits_in_view(axes, STRIPE + 0.06 if statement.signal is None else 0.03)


def _draw_size(
    axes: Axes,
    sizes: np.ndarray,
    size: float,
    pod: float,
    colour: str,
    label: str,
) -> None:
    """Draw a size with its plumb line; one outside ``sizes`` stands in the legend alone."""
    x: list[float] = []
    y: list[float] = []
    if sizes[0] <= size <= sizes[-1]:
        axes.plot([size, size], [0, pod], color=colour, lw=1.1)
        x.append(size)
        y.append(pod)
    axes.plot(
        x,
        y,
        "o",
        label=plain(label),
        color=colour,
        ms=6,
        mec="white",
        mew=0.8,
        zorder=5,
    )


def draw_hits(axes: Axes, size: np.ndarray, hit: np.ndarray) -> None:
    """Draw each inspection of ``size`` (n,), ``hit`` (n,) bool, as a stroke; equal sizes are
    spread in height."""
    spread = STRIPE * np.asarray((np.arange(len(size)) * GOLDEN) % 1.0)
    style: dict[str, Any] = {
        "marker": "|",
        "s": 26,
        "lw": 0.8,
        "color": INK,
        "alpha": 0.6,
        "clip_on": False,
        "rasterized": len(size) > MOST_MARKS,
    }
    axes.scatter(size[hit], 1.03 + spread[hit], **style)
    label = f"hits above ({int(hit.sum())}), misses below ({int((~hit).sum())})"
    axes.scatter(size[~hit], -0.03 - spread[~hit], label=label, **style)


def hits_in_view(axes: Axes, beside: float = STRIPE + 0.06) -> None:
    """Set the axis of POD, with room below 0 and above 1."""
    axes.set_ylim(-beside, 1 + beside)
    axes.set_yticks(np.linspace(0, 1, 6))


def draw_signals(axes: Axes, statement: PodStatement, model: AhatFit) -> None:
    """Draw signals against sizes, the fitted line with one standard deviation, the decision, and
    censored signals."""
    sizes = statement.sizes
    x = np.log(sizes) if statement.curve.log_size else sizes
    line = model.b0 + model.b1 * x
    back = np.exp if model.log_signal else np.asarray
    low = back(line - model.tau)
    high = back(line + model.tau)
    axes.fill_between(sizes, low, high, color=BLUE, alpha=0.14, lw=0)
    axes.plot(sizes, back(line), color=BLUE, label="fit ± one standard deviation")
    axes.axhline(model.decision, color=RED, lw=1.2, label=f"decision {model.decision:.4g}")
    for end in (model.left, model.right):
        if end is not None:
            axes.axhline(end, color=GREY, lw=1.0, ls="--")
    _draw_responses(axes, statement, model)
    if model.log_signal:
        axes.set_yscale("log")
        plain_numbers(axes.yaxis)
    if statement.curve.log_size:
        _log_sizes(axes, sizes)
    axes.set_xlim(sizes[0], sizes[-1])


def _draw_responses(axes: Axes, statement: PodStatement, model: AhatFit) -> None:
    """Draw signals as dots, and those at the ends of the instrument's range as crosses."""
    size = statement.read.size
    signal = statement.read.response
    is_read = np.ones(len(signal), bool)
    ends = []
    if model.left is not None:
        is_read &= signal > model.left
        ends.append(f"≤ {model.left:.4g}")
    if model.right is not None:
        is_read &= signal < model.right
        ends.append(f"≥ {model.right:.4g}")
    axes.scatter(
        size[is_read],
        signal[is_read],
        s=14,
        color=INK,
        alpha=0.7,
        lw=0,
        label="signals",
        rasterized=len(signal) > MOST_MARKS,
    )
    if ends:
        axes.scatter(
            size[~is_read],
            signal[~is_read],
            s=18,
            lw=1,
            marker="x",
            color=PURPLE,
            label=f"censored, {' or '.join(ends)}",
            rasterized=len(signal) > MOST_MARKS,
        )


def _log_sizes(axes: Axes, sizes: np.ndarray) -> None:
    """Set a logarithmic axis with plain numbers."""
    axes.set_xscale("log")
    plain_numbers(axes.xaxis, (1, 2, 5) if sizes[-1] / sizes[0] < 1000 else (1,))


def plain_numbers(axis: Axis, multiples: tuple[float, ...] = (1, 2, 5)) -> None:
    """Label an axis with 20 instead of 2 x 10^1, at these ``multiples`` of each decade."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis.set_major_locator(LogLocator(subs=multiples))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())
