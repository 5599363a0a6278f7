"""The page of an experiment with several views: the gain of more views, and the effects of
registering and merging."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import count
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from harness.evaluation import maps
from harness.evaluation.summary import HoleState
from harness.records.examples import MappedExample
from harness.records.outputs import MAPS
from harness.records.schema import Table
from harness.records.trials import REGISTRATION_ERRORS, SET_UPS, SUMMARY, ResultTables
from harness.report import blocks, sections
from harness.report.claims import ClaimSet, Verdict
from harness.report.summaries import Summaries, of_set_ups, summaries, verdicts_of
from harness.vocabulary.text import many

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAPS_SHOWN = (
    "registration",
    "merge",
    "views",
    "found",
    "from (mm)",
    "average (mm)",
    "offset (mm)",
    "pattern (mm)",
    "surface noise (mm)",
    "threshold (mm)",
    "false calls",
    "views left out",
    "time (s)",
)
"""Columns of the table of each map's results."""


def perspectives_html(
    tables: ResultTables,
    examples: Sequence[MappedExample],
    about: sections.About,
    computed: Summaries | None = None,
) -> str:
    """Return the page as text; see `harness.report.page.write_report`."""
    computed = computed or summaries(tables, claim_set=about.claim_set)
    compared = computed[SET_UPS]
    verdicts = verdicts_of(computed)
    cases = maps.map_cases(tables, computed[SUMMARY])
    set_ups = compared[~compared["is_variation"]] if len(compared) else compared
    registrations = of_set_ups(tables.registrations, tables)
    frames = sections.shown_frames(set_ups)
    frames_falling = frames[::-1]
    figures: dict[str, str] = {}
    if len(registrations):
        figures["tre"] = tre_figure(registrations, frames)
    if len(set_ups):
        with_most = set_ups[set_ups["frames"] == frames[-1]]
        figures["found"] = found_figure(sections.records(with_most))
    repeats = int(set_ups["repeats"].max()) if len(set_ups) else 0
    rule = (
        "Each set-up has its own hole-free runs and threshold. All set-ups use the same frames;"
        " repeats also vary the error of the nominal poses. A single view needs no registration."
    )
    claims_title = about.claim_set.title_of_views if about.claim_set else ""
    return sections.sweep_page(
        "views.html",
        tables,
        about,
        answer_sentence(cases, about.claim_set, verdicts),
        figures,
        rule=sections.rule_note(repeats, rule),
        claims=sections.claims_section(claims_title, verdicts),
        ways=sections.ways_grid(compared).html(),
        errors=_by_frames(REGISTRATION_ERRORS, computed[REGISTRATION_ERRORS], frames_falling),
        maps=[(name, map_text(example)) for name, example in map_files(examples).items()],
        each=_by_frames(SET_UPS, set_ups, frames_falling, MAPS_SHOWN),
        varied=sections.varied_section(tables, compared),
    )


def _by_frames(
    table: Table, rows: pd.DataFrame, frames: Sequence[int], only: Sequence[str] = ()
) -> Markup:
    """Return a fold with the rows of each number of frames."""
    folds = []
    for n in frames:
        grid = table.grid(sections.records(rows[rows["frames"] == n]), only=only)
        folds.append((maps.frames_text(n), grid.html()))
    return blocks.joined(blocks.folded(folds))


# ---------------------------------------------------------------- the answer


def answer_sentence(
    cases: Sequence[maps.MapCase],
    claim_set: ClaimSet | None = None,
    verdicts: Sequence[Verdict] = (),
) -> str:
    """State how many holes one view finds, and how many the most views find by the best method."""
    sentences = []
    for case in cases:
        sentence = _case_sentence(case)
        if sentence:
            sentences.append(f"{case.conditions}: {sentence}" if len(cases) > 1 else sentence)
    if not sentences:
        return "No trial of any set-up finished, so there is no answer."
    if verdicts and claim_set is not None:
        sentences.insert(0, claim_set.lead_of_views(verdicts))
    return " ".join(sentences)


def _case_sentence(case: maps.MapCase) -> str:
    """State the holes found by one view and by the best map of the most views; empty without a
    single view."""
    single = case.single()
    if single is None:
        return ""
    status = case.status(single)
    text = f"one view finds {_found(status)} of {len(status)} holes{_undecided(status)}"
    candidates = []
    for set_up in case.set_ups:
        mapped = case.named(set_up.views, set_up.registration, set_up.merge, single.frames)
        if mapped is not None and set_up.views > 1:
            candidates.append((set_up, case.status(mapped)))
    if candidates:
        best, status = min(candidates, key=lambda pair: (-pair[0].views, -_found(pair[1])))
        method = maps.label_of(method_text(best.registration), best.merge)
        text += f", {best.views} views ({method}) {_found(status)}{_undecided(status)}"
    return f"With {maps.frames_text(single.frames)} {text}."


def _found(status: dict[str, HoleState]) -> int:
    return list(status.values()).count("found")


def _undecided(status: dict[str, HoleState]) -> str:
    undecided = list(status.values()).count("undecided")
    return f" ({undecided} undecided)" if undecided else ""


# ---------------------------------------------------------------- pages of maps


def map_files(examples: Sequence[MappedExample]) -> dict[str, MappedExample]:
    """Return the file of each browser map beside the report, sorted by frames (most first), views
    and method."""
    in_order = sorted(
        examples,
        key=lambda example: (
            -example.frames,
            example.views,
            example.registration,
            example.merge,
            example.variant,
        ),
    )
    files: dict[str, MappedExample] = {}
    for example in in_order:
        words = (
            f"{example.views} views {example.registration} {example.merge} {example.frames} frames"
        )
        if example.is_variation:
            words += f" {example.variant}"
        stem = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
        name = MAPS.name.replace("*", stem)
        numbers = count(2)
        while name in files:
            name = MAPS.name.replace("*", f"{stem}-{next(numbers)}")
        files[name] = example
    return files


def map_text(example: MappedExample) -> str:
    """Describe one map in words."""
    variation = f": {example.variant}" if example.is_variation else ""
    method = maps.label_of(method_text(example.registration), example.merge)
    views = many(example.views, "view")
    return f"{views} ({method}), {maps.frames_text(example.frames)}{variation}"


def method_text(method: str) -> str:
    """Return the name of a method as axes and sentences show it."""
    return {"icp": "ICP", "cpd": "CPD"}.get(method, method)


# ---------------------------------------------------------------- figures

METHOD_COLOURS = {
    "nominal": blocks.GREY,
    "icp": blocks.ORANGE,
    "cpd": blocks.BLUE,
    "marks": blocks.GREEN,
    "joint": blocks.RED,
    "odometry": blocks.PURPLE,
}
PART_NAMES = {"in_plane": "In the plane of the board", "across": "Across it"}
GOLDEN = 0.6180339887
"""Multiples of the golden ratio spread points evenly without random numbers."""


def found_figure(rows: Sequence[sections.Row]) -> str:
    """Draw the number of holes found against the number of views, with a line per registration and
    merging method."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        ways = dict.fromkeys((row["registration"], row["merge"]) for row in rows)
        for number, (registration, merge) in enumerate(ways):
            points = [
                (row["views"], len(row["found"]))
                for row in rows
                if (row["registration"], row["merge"]) == (registration, merge)
            ]
            views, holes = np.array(sorted(points), float).T
            shift = 0.04 * (number - len(ways) / 2)  # separates equal counts
            axes.plot(
                views + shift,
                holes,
                marker=blocks.MARKERS[number % len(blocks.MARKERS)],
                ms=5,
                lw=1.2,
                color=blocks.COLOURS[number % len(blocks.COLOURS)],
                label=maps.label_of(method_text(registration), merge),
            )
        all_holes = max(row["holes"] for row in rows)
        axes.set(
            xlabel="views", ylabel=f"holes found, of {all_holes}", ylim=(-0.3, all_holes + 0.3)
        )
        axes.set_xticks(sorted({row["views"] for row in rows}))
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)

    alt = "Number of holes found against views, by method of merging."
    return blocks.svg("found", (5.4, 4.4), alt, draw)


def tre_figure(registrations: pd.DataFrame, frames: Sequence[int]) -> str:
    """Draw the error of each registration by method, in the plane and across it, and the median."""
    methods = list(dict.fromkeys(registrations["method"]))
    frames_text = " and ".join(many(n, "frame") for n in frames)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(maps.PARTS), sharey=True)
        for axes, part in zip(panels, maps.PARTS, strict=True):
            for position, method in enumerate(methods):
                of_method = registrations[registrations["method"] == method]
                for side, n in enumerate(frames):
                    rows = of_method[of_method["frames"] == n]
                    x = position + 0.36 * (side - (len(frames) - 1) / 2)
                    colour = METHOD_COLOURS.get(method, blocks.SKY)
                    _draw_method(axes, rows, f"tre_{part}_mm", x, colour)
            axes.set_yscale("log")
            blocks.plain_decades(axes.yaxis)
            axes.set_xticks(range(len(methods)), [method_text(method) for method in methods])
            axes.set_xlim(-0.6, len(methods) - 0.4)
            axes.grid(axis="x", visible=False)
            axes.set_title(PART_NAMES[part])
            axes.set_xlabel(f"method ({frames_text}, left to right)", loc="left")
        panels[0].set_ylabel("target registration error (mm)")
        panels[-1].plot([], [], "o", ms=4, color=blocks.GREY, label="one registration")
        panels[-1].plot([], [], color=blocks.INK, lw=2, label="median")
        panels[-1].plot([], [], "x", ms=5, color=blocks.INK, label="failed, not merged")
        figure.legend(*panels[-1].get_legend_handles_labels(), loc="outside lower center", ncols=4)

    alt = (
        "Target registration error of every registration in millimetres by method, in the plane"
        " and across it."
    )
    return blocks.svg("tre", (10, 4.4), alt, draw)


def _draw_method(
    axes: Axes,
    rows: pd.DataFrame,
    column: str,
    x: float,
    colour: str,
) -> None:
    """Draw the errors in a column around ``x``: a dot for each registration, a cross where it
    failed, and the median."""
    trusted = maps.trusted(rows)
    failed = rows[rows["failure"] != ""]
    _draw_points(axes, trusted[column], x, "o", 2.2, colour)
    _draw_points(axes, failed[column], x, "x", 4, blocks.INK)
    median_mm = trusted[column].median()
    ends = [x - 0.16, x + 0.16]
    axes.plot(ends, [median_mm] * 2, color=blocks.INK, lw=2, solid_capstyle="butt")


def _draw_points(
    axes: Axes,
    errors: pd.Series,
    x: float,
    marker: str,
    size: float,
    colour: str,
) -> None:
    """Draw positive errors, spread evenly by rank, so that the picture is reproducible."""
    errors_mm = errors.to_numpy(float)
    errors_mm = errors_mm[np.isfinite(errors_mm) & (errors_mm > 0)]
    fractions = np.modf(np.arange(len(errors_mm)) * GOLDEN)[0]
    axes.plot(
        x + 0.26 * (fractions - 0.5),
        errors_mm,
        ls="none",
        marker=marker,
        ms=size,
        color=colour,
        alpha=0.45,
    )
