"""Presents a probability of detection curve: tables for terminal and page, and a figure with the
inspections."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.pod.curve import Bound
from harness.evaluation.pod.hit_miss import NEAR_DEVIANCE
from harness.evaluation.pod.statement import POD, PodStatement
from harness.records.schema import Column, Table
from harness.report import blocks
from harness.report.blocks import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, RED
from harness.vocabulary.text import ROUGH, Grid

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

# most inspections that a figure draws as vector marks; if there are more, they are rasterised
MOST_MARKS = 2000
# height of the stripes above 1 and below 0 in which hits and misses are spread, in units of POD
STRIPE = 0.10
VALIDITY = (
    "The limit holds for inspections like these: the same kind of flaws and parts, the same procedure, and the sizes "
    "inspected. Targets are assumed to be independent. Sizes beyond the largest target are extrapolated."
)


def pod_html(statement: PodStatement, command: str) -> str:
    """Return the page as text: limit, figure, table of models, tests, notes; it needs no network."""
    caption = (
        "The curve with its pointwise band, the inspections, and the sizes at POD 0.5 and 0.9. a90/95 is the size at "
        "which the band's lower edge reaches 0.9."
    )
    chosen_by = (
        "The models are sorted by deviance; a smaller deviance means a better fit. Unless a model was requested, "
        "the deviance selects the curve, but never the limit."
    )
    if len(statement.fits) > 1:
        chosen_by += (
            f" {len(statement.fits)} models are within {NEAR_DEVIANCE:g} of the least (for each inspection of a "
            "target), too little to distinguish them: each a90/95 to quote is the largest of these models, and the "
            "band covers all their bands."
        )
    size_in, draw = _plan(statement)
    drawn = blocks.svg("pod", size_in, f"{answer(statement)} {statement.counts}.", draw)
    body = [blocks.heading("Curve"), blocks.figure({"pod": drawn}, "pod", caption)]
    body += [blocks.heading("Sizes"), sizes_grid(statement).html(), blocks.heading("Models")]
    body += [blocks.note(chosen_by), models_grid(statement).html()]
    body += [blocks.heading("Fit"), fit_grid(statement).html()]
    if statement.tests:
        rows = [
            (what, "< 0.001" if p < 0.001 else f"{p:.3f}", reads)
            for what, p, reads in statement.tests
        ]
        body += [blocks.subheading("Tests"), Grid.of(("test", "p", "reads"), rows, left=3).html()]
    body += [
        blocks.heading("Notes"),
        blocks.bullets((*statement.notes, VALIDITY)),
        *blocks.command_of(command),
    ]
    under = [
        blocks.note(f"{statement.kind.capitalize()}: {statement.counts}. Model: {statement.model}.")
    ]
    title = f"Probability of detection: {statement.read.path.name}"
    return blocks.page(title, answer(statement), body, under, statement.doubts)


def pod_parts(statement: PodStatement) -> list[str | Grid]:
    """Return the parts for a terminal: the page's tables and sentences."""
    parts: list[str | Grid] = [f"warning: {doubt}" for doubt in statement.doubts]
    parts += [
        f"{statement.read.path}: {statement.kind}, {statement.counts}",
        f"model: {statement.model}",
    ]
    parts += ["", models_grid(statement), "", sizes_grid(statement), "", fit_grid(statement)]
    if statement.tests:
        parts += ["", *(f"{what}: p = {p:.3g}, {reads}" for what, p, reads in statement.tests)]
    parts += ["", *(f"note: {line}" for line in statement.notes)] if statement.notes else []
    return [*parts, "", answer(statement)]


def sizes_grid(statement: PodStatement) -> Grid:
    """Return the table of a50, a90 and a90/95 with the method of each."""
    of_models = f", the largest of {len(statement.fits)} models" if len(statement.fits) > 1 else ""
    digits = _digits(statement)
    unit = statement.unit
    rows = [
        (name, sized(getattr(statement, name), unit, digits), "estimate") for name in ("a50", "a90")
    ]
    how = f"{statement.bound.method}{of_models}: the limit to quote"
    rows.append(("a90/95", _bound_text(statement.bound, unit, digits), how))
    return Grid.of(("", "size", "how"), rows, left=3)


MODELS = Table(
    "models",
    "one row per model that was tried",
    (
        Column(
            "",
            "model",
            lambda row: (
                f"{row.name}{' (used)' if row.chosen else ' (compared)' if row.in_bound else ''}"
            ),
        ),
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
    return MODELS.grid(
        statement.models, heads={name: f"{name}{of_unit}" for name in ("a50", "a90", "a90/95")}
    )


def fit_grid(statement: PodStatement) -> Grid:
    """Return the table with the numbers of the fit."""
    return Grid.of(
        ("of the fit", "value"),
        ((name, f"{value:.5g}") for name, value in statement.numbers.items()),
    )


def _bound_text(bound: Bound, unit: str, digits: int = 2) -> str:
    return sized(bound.value, unit, digits) if bound.demonstrated else "not demonstrated"


def _digits(statement: PodStatement) -> int:
    """Return 3 digits if a90 and its bound are so close that a third digit is needed, or else 2."""
    return 3 if 2 * (statement.bound.value - statement.a90) <= ROUGH * statement.a90 else 2


def save_pod_png(path: Path, statement: PodStatement) -> None:
    """Write the figure as a PNG to ``path``; the same statement gives the same bytes."""
    size_in, draw = _plan(statement)
    blocks.save_png(path, size_in, draw)


def answer(statement: PodStatement) -> str:
    """State the limit in one sentence."""
    size = f"{statement.bound.confidence:.0%} confidence".replace("%", " %")
    if statement.bound.demonstrated:
        limit = sized(statement.bound.value, statement.unit, _digits(statement))
        return f"A flaw of {limit} is found 90 % of the time, with {size} (a90/95, {statement.bound.method})."
    return f"a90/95 is not demonstrated: {statement.bound.why.removeprefix('not demonstrated: ')}."


def sized(value: float, unit: str, digits: int = 2) -> str:
    """Return a size with that many significant digits and its unit, or "not reached" if it is not
    finite."""
    if not np.isfinite(value):
        return "not reached"
    decimals = max(0, digits - 1 - int(f"{value:.{digits - 1}e}".partition("e")[2]))
    return f"{value:.{decimals}f}" + (f" {unit}" if unit else "")


def axis_text(column: str, unit: str) -> str:
    """Return ``column`` with its unit in brackets, if it has a unit."""
    return plain(f"{column} ({unit})" if unit else column)


def plain(text: str) -> str:
    """Escape the user's text for Matplotlib, which would typeset text between dollar signs."""
    return text.replace("$", r"\$")


def _plan(statement: PodStatement) -> tuple[tuple[float, float], Callable[[Figure], None]]:
    """Return the figure's size and the function that draws it: a second panel shows signals, if
    there are any."""

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, 2 if statement.signal else 1, squeeze=False)[0]
        if statement.signal:
            draw_signals(panels[0], statement)
            panels[0].set(ylabel=plain(statement.read.response_column), title="Signals")
        draw_pod(panels[-1], statement)
        if statement.curve.log_size:
            _log_sizes(panels[-1], statement.sizes)
        panels[-1].set_ylabel("probability of detection")
        panels[-1].set_title(f"Probability of detection, {statement.read.targets} targets")
        for axes in panels:
            axes.set_xlim(statement.sizes[0], statement.sizes[-1])
            axes.set_xlabel(axis_text(statement.read.size_column, statement.unit))
            axes.legend(loc="upper left", bbox_to_anchor=(0, -0.16), ncols=2, borderaxespad=0)

    return ((11.0, 4.8) if statement.signal else (8.6, 5.2)), draw


def draw_pod(axes: Axes, statement: PodStatement) -> None:
    """Draw the curve, the band, the data and the sizes to quote."""
    curve, sizes, (lower, upper) = statement.curve, statement.sizes, statement.band
    confidence = f"{statement.bound.confidence:.0%}".replace("%", " %")
    axes.fill_between(sizes, lower, upper, color=BLUE, alpha=0.16, lw=0)
    axes.plot(
        sizes,
        lower,
        color=BLUE,
        lw=0.9,
        ls="--",
        label=f"{confidence} band, {statement.bound.method}",
    )
    axes.plot(sizes, upper, color=BLUE, lw=0.9, ls="--")
    axes.plot(sizes, curve.pod(sizes), color=BLUE, lw=2.0, label=f"POD, {statement.model}")
    axes.axhline(POD, color=GREY, lw=0.8, ls=":")
    if statement.signal is None:
        draw_hits(axes, statement.read.size, statement.read.response == 1)
    for name, value, pod, colour in (
        ("a50", statement.a50, 0.5, GREEN),
        ("a90", statement.a90, POD, ORANGE),
        ("a90/95", statement.bound.value, POD, RED),
    ):
        text = sized(value, statement.unit, _digits(statement))
        text = text if name != "a90/95" or np.isfinite(value) else "not demonstrated"
        inside = sizes[0] <= value <= sizes[-1]
        if inside:
            axes.plot([value, value], [0, pod], color=colour, lw=1.1)
        at = ([value], [pod]) if inside else ([], [])
        axes.plot(
            *at,
            "o",
            color=colour,
            ms=6,
            mec="white",
            mew=0.8,
            label=plain(f"{name}: {text}"),
            zorder=5,
        )
    hits_in_view(axes, STRIPE + 0.06 if statement.signal is None else 0.03)


def draw_hits(axes: Axes, size: np.ndarray, hit: np.ndarray) -> None:
    """Draw each inspection of ``size`` (n,), ``hit`` (n,) bool, as a stroke; equal sizes are
    spread in height."""
    # multiples of the golden ratio spread the strokes without random numbers
    spread = STRIPE * np.asarray((np.arange(len(size)) * 0.6180339887498949) % 1.0)
    style: dict[str, Any] = {
        "marker": "|",
        "s": 26,
        "lw": 0.8,
        "color": INK,
        "alpha": 0.6,
        "clip_on": False,
    }
    style["rasterized"] = len(size) > MOST_MARKS
    axes.scatter(size[hit], 1.03 + spread[hit], **style)
    label = f"hits above ({int(hit.sum())}), misses below ({int((~hit).sum())})"
    axes.scatter(size[~hit], -0.03 - spread[~hit], label=label, **style)


def hits_in_view(axes: Axes, beside: float = STRIPE + 0.06) -> None:
    """Set the axis of POD, with room below 0 and above 1."""
    axes.set_ylim(-beside, 1 + beside)
    axes.set_yticks(np.linspace(0, 1, 6))


def draw_signals(axes: Axes, statement: PodStatement) -> None:
    """Draw signals against sizes, the fitted line with one standard deviation, the decision, and
    censored signals."""
    model = statement.signal
    assert model is not None
    sizes = statement.sizes
    x = np.log(sizes) if statement.curve.log_size else sizes
    line = model.b0 + model.b1 * x
    back = np.exp if model.log_signal else np.asarray
    axes.fill_between(
        sizes, back(line - model.tau), back(line + model.tau), color=BLUE, alpha=0.14, lw=0
    )
    axes.plot(sizes, back(line), color=BLUE, label="fit ± one standard deviation")
    axes.axhline(model.decision, color=RED, lw=1.2, label=f"decision {model.decision:.4g}")
    ends = [
        f"{sign} {value:.4g}"
        for sign, value in (("≤", model.left), ("≥", model.right))
        if value is not None
    ]
    for value in (model.left, model.right):
        if value is not None:
            axes.axhline(value, color=GREY, lw=1.0, ls="--")
    left = -np.inf if model.left is None else model.left
    right = np.inf if model.right is None else model.right
    kept = (statement.read.response > left) & (statement.read.response < right)
    many = len(kept) > MOST_MARKS
    marks: dict[str, Any] = {
        "s": 14,
        "color": INK,
        "alpha": 0.7,
        "lw": 0,
        "label": "signals",
        "rasterized": many,
    }
    axes.scatter(statement.read.size[kept], statement.read.response[kept], **marks)
    if ends:
        censored: dict[str, Any] = {
            "marker": "x",
            "color": PURPLE,
            "label": f"censored, {' or '.join(ends)}",
        }
        size = statement.read.size[~kept]
        signal = statement.read.response[~kept]
        axes.scatter(size, signal, s=18, lw=1, rasterized=many, **censored)
    if model.log_signal:
        axes.set_yscale("log")
        plain_numbers(axes.yaxis)
    if statement.curve.log_size:
        _log_sizes(axes, sizes)
    axes.set_xlim(sizes[0], sizes[-1])


def _log_sizes(axes: Axes, sizes: np.ndarray) -> None:
    """Set a logarithmic axis with plain numbers."""
    axes.set_xscale("log")
    plain_numbers(axes.xaxis, (1, 2, 5) if sizes[-1] / sizes[0] < 1000 else (1,))


def plain_numbers(axis: Axis, at: tuple[float, ...] = (1, 2, 5)) -> None:
    """Label an axis with 20 instead of 2 x 10^1, ``at`` these multiples of each decade."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis.set_major_locator(LogLocator(subs=at))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())
