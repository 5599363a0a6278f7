"""The report of a sweep: result tables in, one self-contained HTML page out. It needs no network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from harness.evaluation.set_ups import LIMIT_RULE, set_ups_of
from harness.evaluation.summary import MAIN, fit_floor, found_holes
from harness.records import trials
from harness.records.examples import ExampleCloud, MappedExample
from harness.records.outputs import REPORT
from harness.records.trials import (
    ERRORS,
    FALSE_CALLS,
    NOISE_BY_FRAMES,
    SET_UPS,
    SUMMARY,
    ResultTables,
    hole_list,
)
from harness.report import blocks, sections
from harness.report.blocks import COLOURS, MARKERS
from harness.report.claims import Verdict, claim_set_of
from harness.report.clouds import residual_figure
from harness.report.perspectives import map_files, map_text, perspectives_html
from harness.report.summaries import Summaries, of_set_ups, summaries, verdicts_of
from harness.report.view3d import write_view3d
from harness.tables.study import axis_value
from harness.vocabulary.files import write_text
from harness.vocabulary.path_names import in_words
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.text import Grid, inches, many

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

GUIDE = "#cfd6dd"
MOST_ROWS = 4  # Most rows of set-ups that the answer lists individually


def rates_figure(main: pd.DataFrame) -> str:
    """Draw each hole's share of repeats that detected it (with Wilson intervals) against its
    diameter, by frames."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for (frames, rows), colour, marker in zip(
            main.groupby("frames"), COLOURS, MARKERS, strict=False
        ):
            by_size = rows.groupby("true_diameter_mm")[["rate", "rate_low", "rate_high"]].mean()
            axes.fill_between(
                by_size.index,
                by_size["rate_low"],
                by_size["rate_high"],
                color=colour,
                alpha=0.1,
                lw=0,
            )
            label = many(int(str(frames)), "frame")
            style: dict[str, Any] = {"marker": marker, "ms": 4, "color": colour, "label": label}
            axes.plot(by_size.index, by_size["rate"], **style)
        axes.axhline(0.5, color=blocks.GREY, lw=0.8, ls=":")
        axes.set(
            xlabel="true diameter (mm)",
            ylabel="share of repeats that detected it",
            ylim=(-0.03, 1.03),
        )
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)

    return blocks.svg(
        "rates", (5.4, 4.0), "Detection rate of each hole against its diameter, by frames.", draw
    )


def limits_figure(compared: pd.DataFrame, layout: Layout, frames: Sequence[int]) -> str:
    """Draw the smallest diameter found against the last axis, with a panel for each number of
    frames."""

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(frames), squeeze=False)[0]
        top = 1.15 * float(np.nanmax([*compared["limit_mm"], 1.0]))
        for axes, n in zip(panels, frames, strict=True):
            limits = compared[compared["frames"] == n].set_index("variant")["limit_mm"]
            styles = product(("-", "--"), zip(MARKERS, COLOURS, strict=True))
            for (title, variants), (line, (marker, colour)) in zip(
                layout.rows.items(), styles, strict=False
            ):
                values = [float(limits.get(variant, np.nan)) for variant in variants]
                axes.plot(
                    layout.column_values,
                    values,
                    line,
                    marker=marker,
                    ms=5,
                    color=colour,
                    label=title,
                    alpha=0.9,
                )
            axes.set_xticks(layout.column_values, [f"{value:g}" for value in layout.column_values])
            axes.set(
                ylim=(0, top), ylabel="smallest diameter found (mm)", xlabel=layout.column_name
            )
            axes.set_title(many(n, "frame"))
        # about 15 letters per inch
        columns = int(15 * width_in / (6 + max(map(len, layout.rows))))
        figure.legend(
            *panels[0].get_legend_handles_labels(),
            loc="outside lower center",
            ncols=max(columns, 1),
        )

    width_in = 1 + 3.2 * len(frames)
    height_in = 3.2 + 0.1 * len(layout.rows)
    return blocks.svg(
        "limits", (width_in, height_in), "Smallest diameter found by each set-up.", draw
    )


def noise_figure(noise: pd.DataFrame) -> str:
    """Draw a variant's temporal, systematic and total error against frames, with the 1/sqrt(N)
    guide and the floor."""
    frames = noise["frames"].to_numpy(float)
    floor_mm = fit_floor(frames, noise["total_rms_mm"].to_numpy(float))

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot(
            frames, noise["guide_mm"], color=GUIDE, lw=7, solid_capstyle="round", label="1/√N guide"
        )
        for column, colour, marker, label in (
            ("temporal_rms_mm", blocks.BLUE, "o", "temporal noise, rms"),
            ("systematic_mm", blocks.ORANGE, "s", "systematic error (offset and pattern)"),
            ("pattern_mm", blocks.GREEN, "v", "its pattern over pixels"),
            ("total_rms_mm", blocks.INK, "D", "total error, rms"),
        ):
            values = noise[column].where(noise[column] > 0)
            axes.plot(frames, values, marker=marker, ms=5, lw=1.4, color=colour, label=label)
        if floor_mm > 0:
            axes.axhline(
                floor_mm, color=blocks.INK, lw=0.8, ls=(0, (6, 3)), label=f"floor {floor_mm:.2f} mm"
            )
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(frames, [f"{n:g}" for n in frames])
        axes.minorticks_off()
        low, high = axes.get_ylim()
        ticks = [
            t
            for t in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100)
            if low <= t <= high
        ]
        axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
        axes.set(xlabel="frames averaged", ylabel="range error (mm)")
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))

    alt = "Range error in millimetres against the number of averaged frames: noise falls, the systematic error stays."
    return blocks.svg("noise", (10, 4.2), alt, draw)


def cost_text(cost: sections.Row) -> str:
    """Return a loss in the table of effects as ``+0.42 mm (0.30 to 0.55)``, or as a bound if a
    size is out of range."""
    if not np.isfinite(cost["loss_mm"]):
        return (
            "outside the range of sizes"
            if np.isnan(cost["loss_mm"])
            else f"{'+' if cost['loss_mm'] > 0 else '−'}∞"
        )
    low = f"{cost['loss_low_mm']:+.2f}" if np.isfinite(cost["loss_low_mm"]) else "∞"
    high = f"{cost['loss_high_mm']:+.2f}" if np.isfinite(cost["loss_high_mm"]) else "∞"
    bound = "" if cost["on_ladder"] else ", a bound: a size lies outside the range"
    return f"{cost['loss_mm']:+.2f} mm ({low} to {high}{bound})".replace("-", "−")


def costs_by_place(
    costs: pd.DataFrame,
) -> dict[tuple[str, int], dict[tuple[str, str], sections.Row]]:
    """Return the rows of the table of effects by (place, frames), then by (effect, other effects
    that are on)."""
    found: dict[tuple[str, int], dict[tuple[str, str], sections.Row]] = {}
    for row in sections.records(costs):
        found.setdefault((row["place"], int(row["frames"])), {})[row["effect"], row["against"]] = (
            row
        )
    return found


def effects_figure(costs: pd.DataFrame) -> str:
    """Draw bars of every effect's cost with 95 % intervals, one panel for each place and number of
    frames."""
    names = list(dict.fromkeys(costs["effect"]))
    places = costs_by_place(costs)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(places), squeeze=False, sharex=True, sharey=True)[0]
        for axes, ((_, frames), at) in zip(panels, places.items(), strict=True):
            for shift, colour, label, against in (
                (-0.2, blocks.BLUE, "alone", "nothing"),
                (0.2, blocks.ORANGE, "on top of all the others", "all others"),
            ):
                chosen = [
                    (names.index(effect) + shift, row)
                    for (effect, on), row in at.items()
                    if on == against
                ]
                sizes = np.array(
                    [np.nan_to_num(row["loss_mm"], posinf=0.0, neginf=0.0) for _, row in chosen]
                )
                ends = np.array([[row["loss_low_mm"], row["loss_high_mm"]] for _, row in chosen])
                errors = np.abs(
                    np.where(np.isfinite(ends), ends, sizes[:, None]) - sizes[:, None]
                ).T
                style: dict[str, Any] = {
                    "color": colour,
                    "label": label,
                    "ecolor": blocks.INK,
                    "capsize": 2,
                }
                axes.barh([place for place, _ in chosen], sizes, 0.36, xerr=errors, **style)
                for place, row in chosen:
                    if not np.isfinite(row["loss_mm"]):
                        axes.text(
                            0, place, " out of range", va="center", fontsize=8, color=blocks.GREY
                        )
            axes.set(title=many(frames, "frame"), xlabel="loss of the 50 % size (mm)")
            axes.axvline(0, color=blocks.GREY, lw=1)
            axes.grid(axis="y", visible=False)
        panels[0].set_yticks(
            range(len(names)), [name.replace("all", "all together") for name in names]
        )
        panels[0].invert_yaxis()
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)

    alt = "Loss of the 50 % diameter in millimetres due to each effect, alone and on top of the others."
    return blocks.svg("effects", (10, 0.42 * len(names) + 1.6), alt, draw)


CAMERA = (
    *(
        "set-up",
        "frames",
        "mm per pixel",
        "valid",
        "one frame (mm)",
        "average (mm)",
        "offset (mm)",
        "pattern (mm)",
    ),
    "surface noise (mm)",
)


@dataclass(frozen=True)
class Layout:
    """The layout of set-ups in a table: the last of several axes across, the others down. ``rows``
    maps the text of a row to its set-ups. ``columns`` are the last axis's values,
    ``column_values`` the same as numbers."""

    rows: Mapping[str, Sequence[str]]
    columns: tuple[str, ...] = ()
    column_name: str = ""
    column_values: tuple[float, ...] = ()

    @staticmethod
    def of(tables: ResultTables) -> Layout:
        """Return the layout of an experiment's set-ups."""
        set_ups = tables.variants[~tables.variants["is_variation"].astype(bool)]
        paths = [str(path) for path in tables.axes["path"]]
        values = list(dict.fromkeys(set_ups[paths[-1]])) if len(paths) > 1 else []
        rows: dict[str, list[str]] = {}
        # a column that is empty for variations holds no integers
        held = [set_ups[path].convert_dtypes().tolist() for path in paths[:-1]]
        for variant, *places in zip(set_ups["variant"], *held, strict=True):
            labels = map("{}={}".format, paths, map(canonical_json, places))
            rows.setdefault(", ".join(map(in_words, labels)), []).append(str(variant))
        if any(
            len(names) != len(values) for names in rows.values()
        ):  # set-ups that are drawn at random form no grid
            return Layout({in_words(str(name)): [str(name)] for name in set_ups["variant"]})
        numbers = (
            tuple(float(v) for v in values)
            if all(isinstance(v, int | float) for v in values)
            else ()
        )
        last = tables.axes.iloc[-1]
        unit = f" ({last['unit']})" if last["unit"] else ""
        return Layout(
            rows, tuple(axis_value(paths[-1], v) for v in values), last["name"] + unit, numbers
        )


def set_ups_html(
    tables: ResultTables,
    examples: Sequence[ExampleCloud],
    about: sections.About,
    found: Summaries | None = None,
) -> str:
    """Return the page of several set-ups as text; see `write_report`."""
    found = found or summaries(tables, examples, about.claim_set)
    compared = of_set_ups(found[SET_UPS], tables)
    costs = found[trials.EFFECTS]
    posterior = found.get(trials.POSTERIOR)
    verdicts = verdicts_of(found)
    layout = Layout.of(tables)
    frames = sections.shown_frames(compared)
    figures: dict[str, str] = {}
    if len(compared) and layout.column_values and len(layout.rows) <= 2 * len(COLOURS):
        figures["limits"] = limits_figure(compared, layout, frames)
    figures |= {} if costs.empty else {"effects": effects_figure(costs)}
    shown = [row for row in sections.records(compared) if row["frames"] in frames]
    calls = of_set_ups(found[FALSE_CALLS], tables)
    calls = calls[(calls["role"] == "damaged") & calls["frames"].isin(frames)]
    rule = "Each set-up has its own hole-free runs and threshold."
    answer = set_ups_answer(compared, layout, costs, verdicts)
    section: str | Markup = ""
    if posterior is not None and about.claim_set is not None:
        answer = about.claim_set.posterior_answer(posterior)
        section = blocks.joined(about.claim_set.posterior_section(posterior))
    title = "" if about.claim_set is None else about.claim_set.title_of_set_ups
    return sections.sweep_page(
        "set_ups.html",
        tables,
        about,
        answer,
        figures,
        rule=sections.rule_note(
            int(compared["repeats"].max()) if len(compared) else 0, LIMIT_RULE, rule
        ),
        posterior=section,
        found=sections.set_ups_grid(compared).html(),
        rows=len(shown),
        costs="" if costs.empty else _costs_grid(costs).html(),
        errors=SET_UPS.grid(shown, only=("set-up", "frames", *ERRORS.values())).html(),
        cameras=SET_UPS.grid(shown, only=CAMERA).html(),
        claims=sections.claims_section(title, verdicts),
        varied=sections.varied_section(tables, found[SET_UPS], frames),
        calls=FALSE_CALLS.grid(sections.records(calls)).html(),
    )


def set_ups_answer(
    compared: pd.DataFrame, layout: Layout, costs: pd.DataFrame, verdicts: Sequence[Verdict] = ()
) -> str:
    """State each row's holes found with the most frames, the effect with the largest loss, and the
    verdicts."""
    if compared.empty:
        return "No trial of any set-up finished, so there is no answer."
    frames = sections.shown_frames(compared)
    found = {
        row["variant"]: len(row["found"])
        for row in sections.records(compared[compared["frames"] == frames[-1]])
    }
    rows = [
        f"{row}: {', '.join(str(found.get(name, '–')) for name in names)}"
        for row, names in layout.rows.items()
    ]
    where = f" at {', '.join(layout.columns)}" if layout.columns else ""
    if len(rows) > MOST_ROWS:
        ends = (min(found, key=found.__getitem__), max(found, key=found.__getitem__))
        rows = [" to ".join(f"{found[name]} ({in_words(name)})" for name in ends)]
    parts = [
        f"Found of {int(compared['holes'].max())} holes{where} with {_averaged(frames[-1])}: {'; '.join(rows)}."
    ]
    parts = parts if costs.empty else []
    for (named, count), at in costs_by_place(costs).items():
        together = at.get(("all", "nothing"))
        if together is None or count not in frames:
            continue
        place = f"{named}, " if named else ""
        moved = f"all effects together change the 50 % size by {cost_text(together)}"
        each = [
            row for (effect, against), row in at.items() if against == "nothing" and effect != "all"
        ]
        dearest = max(
            each, key=lambda row: np.nan_to_num(row["loss_mm"], nan=-np.inf), default=None
        )
        alone = (
            f"; the largest single effect is {dearest['effect']}: {cost_text(dearest)}"
            if dearest
            else ""
        )
        parts.append(f"With {place}{_averaged(count)}, {moved}{alone}.")
    for verdict in verdicts:
        parts.append(f"{verdict.claim} ({verdict.text.rstrip('.')}) is {verdict.verdict}.")
    return " ".join(parts)


def _averaged(frames: int) -> str:
    return "one frame" if frames == 1 else f"{frames} averaged frames"


def _costs_grid(costs: pd.DataFrame) -> Grid:
    places = costs_by_place(costs)
    named = [
        ", ".join(part for part in (place, many(frames, "frame")) if part)
        for place, frames in places
    ]
    heads = (
        "effect",
        *(f"{place}: {which}" for place in named for which in ("alone", "on top of all others")),
    )
    rows = []
    for effect in dict.fromkeys(costs["effect"]):
        cells = [
            at.get((effect, against))
            for at in places.values()
            for against in ("nothing", "all others")
        ]
        rows.append(
            [
                effect.replace("all", "all together"),
                *("–" if row is None else cost_text(row) for row in cells),
            ]
        )
    return Grid.of(heads, rows)


def write_report(
    folder: Path,
    tables: ResultTables,
    examples: Sequence[ExampleCloud | MappedExample],
    provenance: Mapping[str, Any],
    experiment_yaml_text: str,
    title: str,
    facts: Mapping[str, Any] | None = None,
    found: Summaries | None = None,
) -> Path:
    """Write ``folder/report.html`` and return its path: the page of a set-up, of several set-ups,
    or of maps, with a page for each map of ``examples`` beside it. `harness.report.blocks.closing`
    describes ``provenance``; ``facts`` is the resolved experiment as plain data, ``found`` the
    result of `summaries`. Claims are judged for a target that has
    some. The same input gives the same bytes.
    Raises UserError if the folder cannot be written."""
    about = sections.About(
        provenance, experiment_yaml_text, title, claim_set_of(facts or {}), facts or {}
    )
    clouds = [example for example in examples if isinstance(example, ExampleCloud)]
    maps = [example for example in examples if isinstance(example, MappedExample)]
    if len(tables.registrations):
        text = perspectives_html(tables, maps, about, found)
    else:
        text = (set_ups_html if len(set_ups_of(tables)) > 1 else report_html)(
            tables, clouds, about, found
        )
    for name, example in map_files(maps).items():
        write_view3d(Path(folder) / name, example.scene, map_text(example))
    path = Path(folder) / REPORT.name
    write_text(path, text)
    return path


def report_html(
    tables: ResultTables,
    examples: Sequence[ExampleCloud],
    about: sections.About,
    found: Summaries | None = None,
) -> str:
    """Return the page of an experiment with one set-up as text; see `write_report`."""
    found = found or summaries(tables, examples, about.claim_set)
    main = found[SUMMARY][found[SUMMARY]["variant"] == MAIN]
    noise = found[NOISE_BY_FRAMES][found[NOISE_BY_FRAMES]["variant"] == MAIN]
    calls = found[FALSE_CALLS][found[FALSE_CALLS]["variant"] == MAIN]
    verdicts = verdicts_of(found)
    frames = sorted(int(n) for n in main["frames"].unique())
    clouds = sorted((e for e in examples if e.variant == MAIN), key=lambda e: e.frames)
    last = main[main["frames"] == main["frames"].max()]
    figures = {"rates": rates_figure(main)} if frames else {}
    figures |= {"residual": residual_figure(clouds)} if clouds else {}
    figures |= (
        {"noise": noise_figure(noise)}
        if len(noise) and (noise["temporal_rms_mm"] > 0).all()
        else {}
    )
    title = "" if about.claim_set is None else about.claim_set.title
    return sections.sweep_page(
        "sweep.html",
        tables,
        about,
        answer_sentence(main, verdicts),
        figures,
        rule=sections.rule_note(int(main["n"].max()) if len(main) else 0),
        holes=sections.holes_grid(main).html(),
        sizes=SUMMARY.grid(sections.records(last)).html(),
        noise=NOISE_BY_FRAMES.grid(sections.records(noise)).html(),
        claims=sections.claims_section(title, verdicts),
        varied=sections.varied_section(
            tables, found[SET_UPS], (*frames[:1], *frames[-1:]), of=MAIN
        ),
        calls=FALSE_CALLS.grid(sections.records(calls), heads={"set-up": ""}).html(),
    )


def answer_sentence(main: pd.DataFrame, verdicts: Sequence[Verdict] = ()) -> str:
    """State which holes were found with the most and the fewest frames (``main``: summary rows),
    and the verdicts."""
    if main.empty:
        return "No trial of the main experiment finished, so there is no answer."
    frames = sorted(int(n) for n in main["frames"].unique())
    parts: list[str] = []
    for n in dict.fromkeys((frames[-1], frames[0])):
        status = found_holes(main, MAIN, n)
        found = [hole for hole, state in status.items() if state == "found"]
        open_ = [hole for hole, state in status.items() if state == "undecided"]
        text = f"{len(found)} of {len(status)} holes"
        if found:
            least = float(main["true_diameter_mm"][main["hole"].isin(found)].min())
            drill = f", {inches(least)}" if inches(least) else ""
            text += f" (no. {hole_list(found)}; the smallest is {least:.2f} mm{drill})"
        text += f", with {hole_list(open_)} undecided" if open_ else ""
        parts.append(
            f"with {_averaged(n)} {text}"
            if parts
            else f"With {_averaged(n)} the camera finds {text}"
        )
    return f"{'; '.join(parts)}.{sections.counted_verdicts(verdicts)}"
