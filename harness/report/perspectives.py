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
from harness.evaluation.set_ups import set_ups_of
from harness.records.examples import MappedExample
from harness.records.outputs import MAPS
from harness.records.schema import Table
from harness.records.trials import REGISTRATION_ERRORS, SET_UPS, SUMMARY, ResultTables
from harness.report import blocks, sections
from harness.report.claims import ClaimSet, Verdict
from harness.report.summaries import Summaries, summaries, verdicts_of
from harness.vocabulary.text import many

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

MAPS_SHOWN = (
    *(
        "registration",
        "merge",
        "views",
        "found",
        "from (mm)",
        "average (mm)",
        "offset (mm)",
        "pattern (mm)",
    ),
    *("surface noise (mm)", "threshold (mm)", "false calls", "views left out", "time (s)"),
)


def perspectives_html(
    tables: ResultTables,
    examples: Sequence[MappedExample],
    about: sections.About,
    found: Summaries | None = None,
) -> str:
    """Return the page as text; see `harness.report.page.write_report`."""
    found = found or summaries(tables, claim_set=about.claim_set)
    compared = found[SET_UPS]
    errors = found[REGISTRATION_ERRORS]
    verdicts = verdicts_of(found)
    cases = maps.map_cases(tables, found[SUMMARY])
    set_ups = compared[~compared["is_variation"]] if len(compared) else compared
    own = tables.registrations[tables.registrations["variant"].isin(set_ups_of(tables))]
    frames = sections.shown_frames(set_ups)[::-1]
    figures: dict[str, str] = {}
    if len(own):
        figures["tre"] = tre_figure(own, frames[::-1])
    if len(set_ups):
        figures["found"] = found_figure(sections.records(set_ups[set_ups["frames"] == frames[0]]))
    rule = (
        "Each set-up has its own hole-free runs and threshold. All set-ups use the same frames; repeats also vary "
        "the error of the nominal poses. A single view needs no registration."
    )

    def by_frames(table: Table, rows: pd.DataFrame, only: Sequence[str] = ()) -> Markup:
        grids = [
            (n, table.grid(sections.records(rows[rows["frames"] == n]), only=only).html())
            for n in frames
        ]
        return blocks.joined(blocks.folded([(maps.frames_text(n), grid) for n, grid in grids]))

    title = "" if about.claim_set is None else about.claim_set.title_of_views
    return sections.sweep_page(
        "views.html",
        tables,
        about,
        answer_sentence(cases, about.claim_set, verdicts),
        figures,
        rule=sections.rule_note(int(set_ups["repeats"].max()) if len(set_ups) else 0, rule),
        claims=sections.claims_section(title, verdicts),
        ways=sections.ways_grid(compared).html(),
        errors=by_frames(REGISTRATION_ERRORS, errors),
        maps=[(name, map_text(example)) for name, example in map_files(examples).items()],
        each=by_frames(SET_UPS, set_ups, MAPS_SHOWN),
        varied=sections.varied_section(tables, compared),
    )


def found_figure(rows: Sequence[sections.Row]) -> str:
    """Draw the number of holes found against the number of views, with a line per registration and
    merging method."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        ways = dict.fromkeys((row["registration"], row["merge"]) for row in rows)
        for number, way in enumerate(ways):
            of_way = [row for row in rows if (row["registration"], row["merge"]) == way]
            own = sorted((row["views"], len(row["found"])) for row in of_way)
            colour = blocks.COLOURS[number % len(blocks.COLOURS)]
            marker = blocks.MARKERS[number % len(blocks.MARKERS)]
            shift = 0.04 * (number - len(ways) / 2)  # separates equal counts
            views, counts = np.array(sorted(own), float).T
            label = maps.label_of(method_text(way[0]), way[1])
            axes.plot(views + shift, counts, marker=marker, ms=5, lw=1.2, color=colour, label=label)
        most = max(row["holes"] for row in rows)
        axes.set(xlabel="views", ylabel=f"holes found, of {most}", ylim=(-0.3, most + 0.3))
        axes.set_xticks(sorted({row["views"] for row in rows}))
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)

    return blocks.svg(
        "found", (5.4, 4.4), "Number of holes found against views, by method of merging.", draw
    )


def answer_sentence(
    cases: Sequence[maps.MapCase],
    claim_set: ClaimSet | None = None,
    verdicts: Sequence[Verdict] = (),
) -> str:
    """State how many holes one view finds, how many the most views find by the best method, and
    the verdicts."""
    sentences = []
    for case in cases:
        alone = case.single()
        if alone is None:
            continue
        finds = [
            (map_, case.named(map_.views, map_.registration, map_.merge, alone.frames))
            for map_ in case.set_ups
        ]
        ways = [
            (map_, list(case.status(found).values()))
            for map_, found in finds
            if found and map_.views > 1
        ]
        ways.sort(key=lambda way: (-way[0].views, -way[1].count("found")))
        counts: list[str] = []
        for way, states in [("one view finds", list(case.status(alone).values()))] + [
            (
                f"{map_.views} views ({maps.label_of(method_text(map_.registration), map_.merge)})",
                states,
            )
            for map_, states in ways[:1]
        ]:
            open_ = f" ({states.count('undecided')} undecided)" if "undecided" in states else ""
            counts.append(
                f"{way} {states.count('found')}{'' if counts else f' of {len(states)} holes'}{open_}"
            )
        where = f"{case.conditions}: " if len(cases) > 1 else ""
        sentences.append(f"{where}With {maps.frames_text(alone.frames)} {', '.join(counts)}.")
    if not sentences:
        return "No trial of any set-up finished, so there is no answer."
    if verdicts and claim_set is not None:
        sentences.insert(0, claim_set.lead_of_views(verdicts))
        sentences.append(
            f"{', '.join(f'{verdict.claim} is {verdict.verdict}' for verdict in verdicts)}."
        )
    return " ".join(sentences)


def map_files(examples: Sequence[MappedExample]) -> dict[str, MappedExample]:
    """Return the file of each browser map beside the report, sorted by frames (most first), views
    and method."""
    files: dict[str, MappedExample] = {}
    for example in sorted(
        examples, key=lambda e: (-e.frames, e.views, e.registration, e.merge, e.variant)
    ):
        words = (
            f"{example.views} views {example.registration} {example.merge} {example.frames} frames"
        )
        words += f" {example.variant}" if example.is_variation else ""
        stem = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
        names = (
            MAPS.name.replace("*", f"{stem}{f'-{number}' if number > 1 else ''}")
            for number in count(1)
        )
        files[next(name for name in names if name not in files)] = example
    return files


def map_text(example: MappedExample) -> str:
    """Describe one map in words."""
    variation = f": {example.variant}" if example.is_variation else ""
    way = method_text(example.registration)
    way = maps.label_of(way, example.merge)
    return f"{many(example.views, 'view')} ({way}), {maps.frames_text(example.frames)}{variation}"


METHOD_COLOURS = {
    "nominal": blocks.GREY,
    "icp": blocks.ORANGE,
    "cpd": blocks.BLUE,
    "marks": blocks.GREEN,
    "joint": blocks.RED,
    "odometry": blocks.PURPLE,
}
PART_NAMES = {"in_plane": "In the plane of the board", "across": "Across it"}


def method_text(method: str) -> str:
    """Return the name of a method as axes and sentences show it."""
    return {"icp": "ICP", "cpd": "CPD"}.get(method, method)


def tre_figure(registrations: pd.DataFrame, frames: Sequence[int]) -> str:
    """Draw the error of each registration by method, in the plane and across it, with the median."""
    methods = list(dict.fromkeys(registrations["method"]))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(maps.PARTS), sharey=True)
        for axes, part in zip(panels, maps.PARTS, strict=True):
            for place, method in enumerate(methods):
                for side, n in enumerate(frames):
                    rows = registrations[
                        (registrations["method"] == method) & (registrations["frames"] == n)
                    ]
                    x = place + 0.36 * (side - (len(frames) - 1) / 2)
                    good = maps.trusted(rows)
                    bad = rows[rows["failure"] != ""]
                    colour = METHOD_COLOURS.get(method, blocks.SKY)
                    for chosen, marker, shade, size in (
                        (good, "o", colour, 2.2),
                        (bad, "x", blocks.INK, 4),
                    ):
                        values = chosen[f"tre_{part}_mm"].to_numpy(float)
                        values = values[np.isfinite(values) & (values > 0)]
                        # points are spread evenly by rank, so that the picture is reproducible
                        spread = x + 0.26 * (
                            np.modf(np.arange(len(values)) * 0.6180339887)[0] - 0.5
                        )
                        axes.plot(
                            spread,
                            values,
                            ls="none",
                            marker=marker,
                            ms=size,
                            color=shade,
                            alpha=0.45,
                        )
                    median = good[f"tre_{part}_mm"].median()
                    axes.plot(
                        [x - 0.16, x + 0.16],
                        [median] * 2,
                        color=blocks.INK,
                        lw=2,
                        solid_capstyle="butt",
                    )
            axes.set_yscale("log")
            blocks.plain_decades(axes.yaxis)
            axes.set_xticks(range(len(methods)), [method_text(method) for method in methods])
            axes.set_xlim(-0.6, len(methods) - 0.4)
            axes.grid(axis="x", visible=False)
            axes.set_title(PART_NAMES[part])
            heads = " and ".join(many(n, "frame") for n in frames)
            axes.set_xlabel(f"method ({heads}, left to right)", loc="left")
        panels[0].set_ylabel("target registration error (mm)")
        panels[-1].plot([], [], "o", ms=4, color=blocks.GREY, label="one registration")
        panels[-1].plot([], [], color=blocks.INK, lw=2, label="median")
        panels[-1].plot([], [], "x", ms=5, color=blocks.INK, label="failed, not merged")
        figure.legend(*panels[-1].get_legend_handles_labels(), loc="outside lower center", ncols=4)

    alt = "Target registration error of every registration in millimetres by method, in the plane and across it."
    return blocks.svg("tre", (10, 4.4), alt, draw)
