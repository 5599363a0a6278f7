"""The page of a study: its detection limits, their basis and validity, and its figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from textwrap import fill, shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.study.curves import PRO_LIMIT
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.result import SetUpResult, StudyResult
from harness.evaluation.study.surface import depth_varies
from harness.records.schema import Table
from harness.report.blocks import COLOURS, GREY, MARKERS, PALE, closing, joined, svg, template
from harness.report.clouds import StudyExample, examples_figure
from harness.report.pod import MOST_MARKS, plain, plain_numbers
from harness.report.scene import scene_svg
from harness.tables import study
from harness.tables.limits import (
    is_within_sizes,
    limit_notes,
    limit_sentence,
    limits_grid,
    name_of,
    study_answer,
)
from harness.vocabulary.text import Grid, unbroken

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_CURVES = 6
STYLES = ("-", "--", ":", "-.")
LONGEST_NAME = 60
ROW = 0.035  # height of a set-up's rows of hits above 1 and of misses below 0, in units of POD


def with_room(set_ups: Sequence[SetUpResult]) -> list[SetUpResult]:
    """Return the set-ups for figures: all, or `MOST_CURVES` spread evenly from the smallest limit
    to the largest."""
    by_limit = sorted(set_ups, key=lambda set_up: set_up.limit.a90_95.value)
    places = np.linspace(0, len(by_limit) - 1, min(MOST_CURVES, len(by_limit))).round().astype(int)
    chosen = {id(by_limit[place]) for place in places}
    return [set_up for set_up in set_ups if id(set_up) in chosen]


def overlay_figure(limits: Sequence[SetUpLimit]) -> str:
    """Return the figure of `draw_overlay` for a page."""
    names = [name_of(limit) for limit in limits]
    lines = sum(-(-len(name) // LONGEST_NAME) for name in names) / _names_across(names)
    sentences = " ".join(limit_sentence(limit) for limit in limits)
    return svg(
        "overlay", (5.4, 3.4 + 0.2 * lines), sentences, lambda figure: draw_overlay(figure, limits)
    )


def _names_across(names: Sequence[str]) -> int:
    return 2 if max(map(len, names)) <= LONGEST_NAME // 2 else 1


def draw_overlay(figure: Figure, limits: Sequence[SetUpLimit]) -> None:
    """Draw the curves and bands of all set-ups over a common axis of sizes, a mark at each a90/95
    within it, and each inspection as a stroke at its true size: hits above 1, misses below 0, with
    a row for each set-up."""
    axes = figure.subplots()
    names = [name_of(limit) for limit in limits]
    axes.axhspan(1, 2, color=PALE, lw=0)
    axes.axhspan(-1, 0, color=PALE, lw=0)
    for number, limit in enumerate(limits):
        statement = limit.statement
        colour = COLOURS[number % len(COLOURS)]
        seen = limit.record.inspected
        name = plain(fill(names[number], LONGEST_NAME))
        if statement is not None:
            line = STYLES[number // len(COLOURS) % len(STYLES)]
            axes.fill_between(statement.sizes, *statement.band, color=colour, alpha=0.1, lw=0)
            axes.plot(
                statement.sizes,
                statement.curve.pod(statement.sizes),
                line,
                color=colour,
                label=name,
            )
        else:
            axes.plot([], [], color=colour, label=f"{name}: no curve")
        if is_within_sizes(limit):
            axes.plot(limit.a90_95.value, 0.9, "o", color=colour, ms=6, mec="white", zorder=5)
        style: dict[str, Any] = {
            "marker": "|",
            "s": 16,
            "lw": 0.7,
            "alpha": min(0.7, 150 / max(len(seen.hit), 1)),
        }
        height = np.where(seen.hit, 1 + ROW * (number + 0.5), -ROW * (number + 0.5))
        axes.scatter(
            seen.size_mm, height, color=colour, rasterized=len(height) > MOST_MARKS, **style
        )
    axes.axhline(0.9, color=GREY, lw=0.8, ls=":")
    room = ROW * len(limits)
    axes.set(xlim=_span(limits), ylim=(-room, 1 + room), yticks=np.linspace(0, 1, 6))
    axes.set(
        xlabel=f"{limits[0].record.inspected.limit_of} (mm)", ylabel="probability of detection"
    )
    figure.legend(
        *axes.get_legend_handles_labels(), loc="outside lower center", ncols=_names_across(names)
    )


def depth_limits_figure(results: Sequence[SetUpResult]) -> str:
    """Draw the depth found 90 % of the time with its interval against diameter, with a line for
    each set-up."""
    surfaces = [(result.limit, result.surface) for result in results if result.surface is not None][
        : len(COLOURS)
    ]
    deepest = max(surface.depth_range_mm[1] for _, surface in surfaces)
    shallowest = min(surface.depth_range_mm[0] for _, surface in surfaces)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for (limit, surface), colour in zip(surfaces, COLOURS, strict=False):
            low = np.nan_to_num(surface.d90_low_mm)
            high = np.nan_to_num(surface.d90_high_mm, nan=np.inf)
            inside = (surface.d90_mm >= surface.depth_range_mm[0]) & (
                surface.d90_mm <= surface.depth_range_mm[1]
            )
            band = np.clip(low, shallowest, deepest), np.clip(high, shallowest, deepest)
            axes.fill_between(
                surface.diameter_mm, *band, where=inside, color=colour, alpha=0.15, lw=0
            )
            name = plain(fill(name_of(limit), LONGEST_NAME))
            axes.plot(
                surface.diameter_mm,
                np.where(inside, surface.d90_mm, np.nan),
                color=colour,
                label=name,
            )
        sizes = " or ".join(dict.fromkeys(limit.record.inspected.size_of for limit, _ in surfaces))
        axes.set(
            xlabel=f"{sizes} (mm)", ylabel="depth found 90 % of the time (mm)", ylim=(0, deepest)
        )
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center")

    lines = sum(-(-len(name_of(limit)) // LONGEST_NAME) for limit, _ in surfaces)
    alt = "Smallest depth found 90 % of the time against size, as depth_limits.csv says."
    return svg("depth-limits", (7.0, 4.0 + 0.17 * lines), alt, draw)


def _span(limits: Sequence[SetUpLimit]) -> tuple[float, float]:
    """Return the range of sizes inspected with a margin of 4 % of it, or a tenth of the size if
    there is only one."""
    sizes = np.concatenate([limit.record.inspected.size_mm for limit in limits])
    if not len(sizes):
        return 0.0, 1.0
    low = float(sizes.min())
    high = float(sizes.max())
    margin = 0.04 * (high - low) or 0.1 * abs(high) or 0.5
    return (max(low - margin, 0.5 * low) if low > 0 else low - margin), high + margin


def operating_figure(results: Sequence[SetUpResult]) -> str:
    """Draw the ROC, the free-response curve and the overlap of regions of each set-up."""

    def draw(figure: Figure) -> None:
        left, middle, right = figure.subplots(1, 3)
        for result, colour in zip(results, COLOURS, strict=False):
            if (roc := result.roc) is not None:
                left.plot(roc.false, roc.true, color=colour, lw=1.5, label=f"{roc.area:.3f}")
                left.plot(*roc.in_use, "o", color=colour, ms=5.5, mec="white", mew=0.8, zorder=5)
            if (curve := result.free_response) is not None:
                # thresholds without false calls have no place on a logarithmic axis; they are
                # drawn at its left end
                least = 0.5 / curve.area_m2
                calls = np.maximum(curve.false_calls_per_m2, least)
                middle.fill_between(
                    calls, curve.found_low, curve.found_high, color=colour, alpha=0.13, lw=0
                )
                name = plain(fill(name_of(result.limit), LONGEST_NAME))
                middle.plot(calls, curve.found_share, color=colour, lw=1.6, label=name)
                at = (max(curve.in_use[0], least), curve.in_use[1])
                middle.plot(*at, "o", color=colour, ms=6.5, mec="white", mew=0.9, zorder=5)
            if (pixels := result.pixels) is not None:
                kept = pixels.false <= PRO_LIMIT
                end = np.interp(PRO_LIMIT, pixels.false, pixels.overlap)
                area = (
                    f"AU-PRO {pixels.pro:.3f}" if np.isfinite(pixels.pro) else "AU-PRO not reached"
                )
                x = np.append(pixels.false[kept], PRO_LIMIT)
                y = np.append(pixels.overlap[kept], end)
                right.plot(x, y, color=colour, lw=1.6, label=area)
        left.plot([0, 1], [0, 1], color=GREY, lw=0.8, ls=":")
        left.set(
            xlabel="share of unflawed places above",
            ylabel="share of damages above",
            xlim=(-0.02, 1),
        )
        left.set_title("ROC over places")
        middle.set(
            xscale="log", xlabel="false calls per m², undamaged", ylabel="share of damages found"
        )
        plain_numbers(middle.xaxis, (1,))
        middle.plot([], [], "o", color=GREY, ms=6, label="threshold in use")
        middle.set_title("Free-response curve")
        right.set(
            xlabel="share of undamaged pixels above", ylabel="mean share of a damage's pixels above"
        )
        right.set(xlim=(0, PRO_LIMIT), title="Overlap of regions")
        for axes in (left, middle, right):
            axes.set_ylim(0, 1.02)
        for axes in (left, right):
            if axes.get_legend_handles_labels()[0]:
                axes.legend(
                    loc="lower right",
                    fontsize=8,
                    title="area under the curve" if axes is left else None,
                )
        figure.legend(*middle.get_legend_handles_labels(), loc="outside lower center", ncols=2)

    lines = sum(-(-len(name_of(result.limit)) // LONGEST_NAME) for result in results)
    return svg(
        "operating", (10.6, 4.3 + 0.13 * lines), "Operating curves, a colour for each set-up.", draw
    )


ROOM = 1.3
WIDTH_CHARACTERS = 60


def axis_figure(axis: study.AxisGroup, name: str) -> str:
    """Draw a90 with its interval over boards and a90/95 for each value of the axis; arrows mark
    sizes far beyond."""
    shown = list(axis.lines.items())[: len(COLOURS)]
    every = [limit for _, line in shown for limit in line.limits]
    top_mm = ROOM * max((limit.largest_mm for limit in every if limit.inspections), default=np.inf)
    places = (
        np.array(axis.values, float) if axis.numeric else np.arange(len(axis.values), dtype=float)
    )
    logarithmic = axis.numeric and places.min() > 0 and places.max() / places.min() >= 8

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        # intervals of several lines are drawn side by side, 2.5 % of the axis apart, or less if
        # places are close
        scale = np.log(places) if logarithmic else places
        nearest = float(np.diff(np.sort(scale)).min()) if len(scale) > 1 else 1.0
        step = min(0.025 * (float(np.ptp(scale)) or 1.0), 0.6 * nearest / len(shown))
        beyond = False
        for number, (label, line) in enumerate(shown):
            moved = scale + step * (number - (len(shown) - 1) / 2)
            x = (np.exp(moved) if logarithmic else moved)[
                [axis.values.index(value) for value in line.values]
            ]
            ends_of = [limit.a90_interval_mm for limit in line.limits]
            sizes = (
                [limit.a90_mm for limit in line.limits],
                [limit.a90_95.value for limit in line.limits],
            )
            a90, bound = np.array(sizes)
            low, high = np.array([(ends.low, ends.high) for ends in ends_of]).T
            inside = np.where(a90 <= top_mm, a90, np.nan)
            ends = np.nan_to_num(
                np.clip([inside - low, np.minimum(high, top_mm) - inside], 0, None)
            )
            style: dict[str, Any] = {
                "ls": "-" if axis.numeric else "none",
                "lw": 1.2,
                "ms": 5.5,
                "capsize": 3,
            }
            style |= {"label": plain(label or "a90, 95 % over boards"), "color": COLOURS[number]}
            axes.errorbar(x, inside, ends, fmt=MARKERS[number], **style)
            axes.plot(
                x[bound <= top_mm],
                bound[bound <= top_mm],
                "_",
                color=COLOURS[number],
                ms=13,
                mew=2.4,
            )
            far = np.isfinite(a90) & (np.fmax(np.fmax(high, a90), bound) > top_mm) | np.isinf(a90)
            axes.plot(
                x[far],
                np.full(far.sum(), top_mm),
                "^",
                color=COLOURS[number],
                ms=6.5,
                clip_on=False,
            )
            beyond |= bool(far.any())
        axes.plot([], [], "_", color=GREY, ms=11, mew=2.2, label="a90/95")
        if beyond:
            axes.plot(
                [], [], marker="^", ls="none", color=GREY, ms=6, label="continues beyond the axis"
            )
        if np.isfinite(top_mm):
            axes.axhline(top_mm / ROOM, color=GREY, lw=1.0, ls=":", label="largest size inspected")
        for value, place in zip(axis.values, places, strict=True):
            pairs = [
                pair for _, line in shown for pair in zip(line.values, line.limits, strict=True)
            ]
            without = sum(at == value and not is_within_sizes(limit) for at, limit in pairs)
            if without:
                words = "no limit" if len(shown) == 1 else f"no limit\n({without})"
                style = {"ha": "center", "va": "bottom", "fontsize": 8, "color": GREY}
                axes.text(place, 1.02, words, transform=axes.get_xaxis_transform(), **style)
        if logarithmic:
            axes.set_xscale("log")
            axes.minorticks_off()
        labels = [f"{value:g}" for value in axis.values] if axis.numeric else [
            plain(fill(shorten(axis.words(value), 60, placeholder=" …"), 18, break_long_words=False))
            for value in axis.values
        ]  # fmt: skip
        axes.set_xticks(places, labels)
        if (
            max(len(line) for label in labels for line in label.split("\n")) * len(labels)
            > WIDTH_CHARACTERS
        ):
            axes.tick_params(axis="x", labelrotation=25)
        axes.set(xlabel=plain(axis.title), ylabel="a90 (mm)")
        axes.margins(x=0.08)
        axes.set_ylim(0, top_mm if np.isfinite(top_mm) else None)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)

    alt = f"Diameter found 90 % of the time (a90) against {axis.title}, as the table says."
    return svg(name, (7.0, 4.4 + 0.13 * len(shown)), alt, draw)


def study_parts(result: StudyResult) -> list[str | Grid]:
    """Return the parts of a study for a terminal: warnings, limits, notes on them, and the answer."""
    warnings = [f"warning: {text}" for text in study.threshold_warnings(result.limits)]
    notes = limit_notes(result.limits)
    grid = limits_grid(result.limits, terminal=True)
    return [*warnings, grid, *([""] if notes else []), *notes, "", study_answer(result.limits)]


def study_html(
    result: StudyResult,
    examples: Iterable[StudyExample],
    provenance: Mapping[str, Any],
    resolved_yaml: str,
    title: str,
) -> str:
    """Return the page as text; the same input gives the same bytes. ``examples`` are used after
    the other figures."""
    limits = result.limits
    rows = study.study_tables(result)
    inspections = [limit.record.inspected for limit in limits]
    groups = {
        f"axis-{number}": group for number, group in enumerate(study.axis_groups(result.axes), 1)
    }
    shown = with_room(result.set_ups)
    inspected = [set_up.limit for set_up in shown if set_up.limit.inspections]
    curved = [set_up for set_up in shown if set_up.roc or set_up.free_response or set_up.pixels]
    figures = {name: axis_figure(group, name) for name, group in groups.items()}
    if (
        len({set_up.record.inspected.limit_of for set_up in inspected}) == 1
    ):  # depths and diameters need separate axes
        figures["overlay"] = overlay_figure(inspected)
    figures |= (
        {"depth-limits": depth_limits_figure(shown)}
        if any(set_up.surface for set_up in shown)
        else {}
    )
    figures |= {"operating": operating_figure(curved)} if curved else {}
    named = list[tuple[str, str]]()
    examples = list(examples)
    for limit in (set_up.limit for set_up in shown):
        record = limit.record
        own = [
            example
            for example in examples
            if (example.variant, example.frames) == (record.variant, record.frames)
        ]
        if own:
            title_of = name_of(limit)
            name = f"examples-{len(named) + 1}"
            named.append((title_of, name))
            figures[name] = examples_figure(name, own, title_of, by_limit=is_within_sizes(limit))

    def table(declared: Table) -> Any:
        return declared.grid(rows[declared]).html() if rows[declared] else None

    return template("study.html").render(
        title=title,
        answer=unbroken(study_answer(limits)),
        conditions=result.conditions,
        rule=f"Fixed in advance: a damage is found {result.record.hit_rule}, and no finding counts twice. Repeats of "
        "the noise on a board are not additional targets.",
        limits=limits_grid(limits).html() if limits else None,
        limit_notes=[unbroken(note) for note in limit_notes(limits)],
        set_ups=len(limits),
        most_curves=MOST_CURVES,
        scene=scene_svg(result.facts),
        axes=[
            {
                "title": group.name,
                "figure": name,
                "caption": _axis_caption(group),
                "table": study.axis_grid(group).html(),
                "note": study.axis_note(group),
            }
            for name, group in groups.items()
        ],
        has_depths=any(
            seen.limit_of != "depth" and depth_varies(seen.depth_mm) for seen in inspections
        ),
        size_of=" or ".join(dict.fromkeys(seen.size_of for seen in inspections)),
        surface_notes=_surface_notes(result),
        judged=any(limit.false_calls is not None for limit in limits),
        chance=table(study.CHANCE),
        thresholds=table(study.THRESHOLDS),
        threshold_note=study.threshold_note(result.record),
        warnings=[
            *provenance.get("warnings", ()),
            *map(unbroken, study.threshold_warnings(limits)),
        ],
        operating=table(study.OPERATING),
        operating_notes=study.operating_notes(result.set_ups),
        examples=named,
        validity=result.validity,
        figures=figures,
        closing=joined(closing(provenance, resolved_yaml)),
    )


def _axis_caption(group: study.AxisGroup) -> str:
    caption = (
        "The size found 90 % of the time with its 95 % interval over boards. A dash is a90/95. An arrow marks a value "
        "far beyond the largest size inspected (dotted)."
    )
    if len(group.lines) > len(COLOURS):
        caption += (
            f" The first {len(COLOURS)} of {len(group.lines)} lines are drawn; the table holds all."
        )
    return caption if group.numeric else f"{caption} The values have no order."


def _surface_notes(result: StudyResult) -> list[str]:
    """Return the reasons why there is no surface over diameter and depth, or notes on it, with
    their set-ups."""
    reasons: dict[str, list[str]] = {}
    for set_up in result.set_ups:
        why = f"No surface: {set_up.surface_why}" if set_up.surface is None else set_up.surface.note
        if why:
            reasons.setdefault(why, []).append(name_of(set_up.limit))
    every = len(result.set_ups)
    notes = {
        why: "" if len(names) == every else f" ({', '.join(names)})"
        for why, names in reasons.items()
    }
    return [f"{why}{where}." for why, where in notes.items()]
