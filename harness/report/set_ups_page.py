"""The page of several set-ups: what each of them finds, and the loss due to each effect."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from markupsafe import Markup

from harness.evaluation.set_ups import LIMIT_RULE
from harness.records import trials
from harness.records.examples import ExampleCloud
from harness.records.trials import ERRORS, FALSE_CALLS, SET_UPS, ResultTables
from harness.report import blocks, sections
from harness.report.blocks import COLOURS, MARKERS
from harness.report.summaries import Summaries, of_set_ups, summaries, verdicts_of
from harness.tables.study import axis_value
from harness.vocabulary.path_names import in_words
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.text import Grid, many

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_ROWS = 4
"""Most rows of set-ups that the answer lists individually."""
CAMERA = (
    "set-up",
    "frames",
    "mm per pixel",
    "valid",
    "one frame (mm)",
    "average (mm)",
    "offset (mm)",
    "pattern (mm)",
    "surface noise (mm)",
)
"""Columns of the table of each camera's errors."""


def set_ups_html(
    tables: ResultTables,
    examples: Sequence[ExampleCloud],
    about: sections.About,
    computed: Summaries | None = None,
) -> str:
    """Return the page of several set-ups as text; see `harness.report.page.write_report`."""
    computed = computed or summaries(tables, examples, about.claim_set)
    compared = of_set_ups(computed[SET_UPS], tables)
    costs = computed[trials.EFFECTS]
    verdicts = verdicts_of(computed)
    layout = Layout.of(tables)
    frames = sections.shown_frames(compared)
    figures: dict[str, str] = {}
    if len(compared) and layout.column_values and len(layout.rows) <= 2 * len(COLOURS):
        figures["limits"] = limits_figure(compared, layout, frames)
    if len(costs):
        figures["effects"] = effects_figure(costs)
    answer = set_ups_answer(compared, layout, costs)
    posterior_section = Markup("")
    claims_title = ""
    if about.claim_set is not None:
        claims_title = about.claim_set.title_of_set_ups
        posterior = computed.get(trials.POSTERIOR)
        if posterior is not None:
            answer = about.claim_set.posterior_answer(posterior)
            posterior_section = blocks.joined(about.claim_set.posterior_section(posterior))
    shown = [row for row in sections.records(compared) if row["frames"] in frames]
    calls = of_set_ups(computed[FALSE_CALLS], tables)
    calls = calls[(calls["role"] == "damaged") & calls["frames"].isin(frames)]
    repeats = int(compared["repeats"].max()) if len(compared) else 0
    own_threshold = "Each set-up has its own hole-free runs and threshold."
    return sections.sweep_page(
        "set_ups.html",
        tables,
        about,
        answer,
        figures,
        rule=sections.rule_note(repeats, LIMIT_RULE, own_threshold),
        posterior=posterior_section,
        found=sections.set_ups_grid(compared).html(),
        rows=len(shown),
        costs=_costs_grid(costs).html() if len(costs) else "",
        errors=SET_UPS.grid(shown, only=("set-up", "frames", *ERRORS.values())).html(),
        cameras=SET_UPS.grid(shown, only=CAMERA).html(),
        claims=sections.claims_section(claims_title, verdicts),
        varied=sections.varied_section(tables, computed[SET_UPS], frames),
        calls=FALSE_CALLS.grid(sections.records(calls)).html(),
    )


def averaged_text(frames: int) -> str:
    """Return ``50 averaged frames``."""
    return "one frame" if frames == 1 else f"{frames} averaged frames"


def set_ups_answer(compared: pd.DataFrame, layout: Layout, costs: pd.DataFrame) -> str:
    """State the loss due to effects or else each row's holes found with the most frames."""
    if compared.empty:
        return "No trial of any set-up finished, so there is no answer."
    frames = sections.shown_frames(compared)
    if len(costs):
        sentences = [
            _loss_sentence(conditions, count, by_effect)
            for (conditions, count), by_effect in costs_by_place(costs).items()
            if count in frames and ("all", "nothing") in by_effect
        ]
    else:
        sentences = [_found_sentence(compared, layout, frames[-1])]
    return " ".join(sentences)


def _found_sentence(compared: pd.DataFrame, layout: Layout, frames: int) -> str:
    """State the number of holes that each row of set-ups finds, or the least and the most of many
    rows."""
    holes_found = {
        row["variant"]: len(row["found"])
        for row in sections.records(compared[compared["frames"] == frames])
    }
    rows = []
    if len(layout.rows) > MOST_ROWS:
        worst = min(holes_found, key=holes_found.__getitem__)
        best = max(holes_found, key=holes_found.__getitem__)
        ends = [f"{holes_found[variant]} ({in_words(variant)})" for variant in (worst, best)]
        rows.append(" to ".join(ends))
    else:
        for row, variants in layout.rows.items():
            counts = [str(holes_found.get(variant, "–")) for variant in variants]
            rows.append(f"{row}: {', '.join(counts)}")
    columns = f" at {', '.join(layout.columns)}" if layout.columns else ""
    holes = int(compared["holes"].max())
    return f"Found of {holes} holes{columns} with {averaged_text(frames)}: {'; '.join(rows)}."


# ---------------------------------------------------------------- how set-ups are laid out


@dataclass(frozen=True)
class Layout:
    """The layout of set-ups in a table: the last of several axes across, the others down."""

    rows: Mapping[str, Sequence[str]]
    """The set-ups of each row, by the row's text."""
    columns: tuple[str, ...] = ()
    """The last axis's values as text; empty if set-ups fill no grid."""
    column_name: str = ""
    """Name and unit of the last axis."""
    column_values: tuple[float, ...] = ()
    """The last axis's values; empty if they are no numbers."""

    @staticmethod
    def of(tables: ResultTables) -> Layout:
        """Return the layout of an experiment's set-ups."""
        set_ups = tables.variants[~tables.variants["is_variation"].astype(bool)]
        paths = [str(path) for path in tables.axes["path"]]
        values = list(dict.fromkeys(set_ups[paths[-1]])) if len(paths) > 1 else []
        rows = _rows_of(set_ups, paths[:-1])
        if any(len(variants) != len(values) for variants in rows.values()):
            # set-ups that are drawn at random form no grid
            return Layout({in_words(str(name)): [str(name)] for name in set_ups["variant"]})
        numbers: tuple[float, ...] = ()
        if all(isinstance(value, int | float) for value in values):
            numbers = tuple(float(value) for value in values)
        last = tables.axes.iloc[-1]
        unit = f" ({last['unit']})" if last["unit"] else ""
        return Layout(
            rows=rows,
            columns=tuple(axis_value(paths[-1], value) for value in values),
            column_name=last["name"] + unit,
            column_values=numbers,
        )


def _rows_of(set_ups: pd.DataFrame, paths: Sequence[str]) -> dict[str, list[str]]:
    """Return the set-ups that agree on all ``paths``, by the values as text."""
    columns = []
    for path in paths:
        # a column that is empty for variations holds no integers; a fact may be null
        column = set_ups[path].convert_dtypes().astype(object)
        columns.append(column.where(column.notna(), None).tolist())
    rows: dict[str, list[str]] = {}
    for variant, *values in zip(set_ups["variant"], *columns, strict=True):
        settings = zip(paths, values, strict=True)
        labels = [in_words(f"{path}={canonical_json(value)}") for path, value in settings]
        rows.setdefault(", ".join(labels), []).append(str(variant))
    return rows


def limits_figure(compared: pd.DataFrame, layout: Layout, frames: Sequence[int]) -> str:
    """Draw the smallest diameter found against the last axis, with a panel for each number of
    frames."""
    top_mm = 1.15 * float(np.nanmax([*compared["limit_mm"], 1.0]))
    width_in = 1 + 3.2 * len(frames)
    height_in = 3.2 + 0.1 * len(layout.rows)
    # about 15 letters per inch
    legend_columns = int(15 * width_in / (6 + max(map(len, layout.rows))))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(frames), squeeze=False)[0]
        for axes, n in zip(panels, frames, strict=True):
            limits_mm = compared[compared["frames"] == n].set_index("variant")["limit_mm"]
            _draw_limits(axes, limits_mm, layout)
            axes.set_ylim(0, top_mm)
            axes.set_title(many(n, "frame"))
        figure.legend(
            *panels[0].get_legend_handles_labels(),
            loc="outside lower center",
            ncols=max(legend_columns, 1),
        )

    alt = "Smallest diameter found by each set-up."
    return blocks.svg("limits", (width_in, height_in), alt, draw)


def _draw_limits(axes: Axes, limits_mm: pd.Series, layout: Layout) -> None:
    """Draw a line for each row of set-ups. ``limits_mm`` is by set-up."""
    styles = product(("-", "--"), zip(MARKERS, COLOURS, strict=True))
    for (label, variants), (line, (marker, colour)) in zip(
        layout.rows.items(), styles, strict=False
    ):
        axes.plot(
            layout.column_values,
            [float(limits_mm.get(variant, np.nan)) for variant in variants],
            line,
            marker=marker,
            ms=5,
            color=colour,
            label=label,
            alpha=0.9,
        )
    axes.set_xticks(layout.column_values, [f"{value:g}" for value in layout.column_values])
    axes.set(ylabel="smallest diameter found (mm)", xlabel=layout.column_name)


# ---------------------------------------------------------------- loss due to effects

CostsOfEffects = dict[tuple[str, str], sections.Row]
"""Rows of the table of effects by (effect, other effects that are on)."""


def costs_by_place(costs: pd.DataFrame) -> dict[tuple[str, int], CostsOfEffects]:
    """Return the rows of the table of effects by (place, frames)."""
    by_place: dict[tuple[str, int], CostsOfEffects] = {}
    for row in sections.records(costs):
        by_effect = by_place.setdefault((row["place"], int(row["frames"])), {})
        by_effect[row["effect"], row["against"]] = row
    return by_place


def cost_text(cost: sections.Row) -> str:
    """Return a loss in the table of effects as ``+0.42 mm (0.30 to 0.55)``, or as a bound if a
    size is out of range."""
    loss_mm = cost["loss_mm"]
    if np.isnan(loss_mm):
        return "outside the range of sizes"
    if np.isinf(loss_mm):
        return "+∞" if loss_mm > 0 else "−∞"
    low = f"{cost['loss_low_mm']:+.2f}" if np.isfinite(cost["loss_low_mm"]) else "∞"
    high = f"{cost['loss_high_mm']:+.2f}" if np.isfinite(cost["loss_high_mm"]) else "∞"
    bound = "" if cost["on_ladder"] else ", a bound: a size lies outside the range"
    return f"{loss_mm:+.2f} mm ({low} to {high}{bound})".replace("-", "−")


def _loss_sentence(conditions: str, frames: int, by_effect: CostsOfEffects) -> str:
    """State the loss due to all effects together, and the effect with the largest loss alone."""
    beginning = f"{conditions}, " if conditions else ""
    together = cost_text(by_effect["all", "nothing"])
    single = [
        row
        for (effect, against), row in by_effect.items()
        if against == "nothing" and effect != "all"
    ]
    largest = ""
    if single:
        row = max(single, key=lambda row: np.nan_to_num(row["loss_mm"], nan=-np.inf))
        largest = f"; the largest single effect is {row['effect']}: {cost_text(row)}"
    return (
        f"With {beginning}{averaged_text(frames)}, all effects together change the 50 % size by"
        f" {together}{largest}."
    )


def _costs_grid(costs: pd.DataFrame) -> Grid:
    """Return the table of effects (down) at each place, alone and on top of all others (across)."""
    by_place = costs_by_place(costs)
    heads = ["effect"]
    for conditions, frames in by_place:
        name = ", ".join(part for part in (conditions, many(frames, "frame")) if part)
        heads += [f"{name}: alone", f"{name}: on top of all others"]
    rows = []
    for effect in dict.fromkeys(costs["effect"]):
        cells = [effect.replace("all", "all together")]
        for by_effect in by_place.values():
            for against in ("nothing", "all others"):
                row = by_effect.get((effect, against))
                cells.append("–" if row is None else cost_text(row))
        rows.append(cells)
    return Grid.of(heads, rows)


def effects_figure(costs: pd.DataFrame) -> str:
    """Draw bars of every effect's cost with 95 % intervals, one panel for each place and number of
    frames."""
    effects = list(dict.fromkeys(costs["effect"]))
    by_place = costs_by_place(costs)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(by_place), squeeze=False, sharex=True, sharey=True)[0]
        for axes, ((_, frames), by_effect) in zip(panels, by_place.items(), strict=True):
            alone = list(_bars(effects, by_effect, "nothing", -0.2))
            on_top = list(_bars(effects, by_effect, "all others", 0.2))
            _draw_losses(axes, alone, blocks.BLUE, "alone")
            _draw_losses(axes, on_top, blocks.ORANGE, "on top of all the others")
            axes.set(title=many(frames, "frame"), xlabel="loss of the 50 % size (mm)")
            axes.axvline(0, color=blocks.GREY, lw=1)
            axes.grid(axis="y", visible=False)
        names = [effect.replace("all", "all together") for effect in effects]
        panels[0].set_yticks(range(len(effects)), names)
        panels[0].invert_yaxis()
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)

    alt = (
        "Loss of the 50 % diameter in millimetres due to each effect, alone and on top of the"
        " others."
    )
    return blocks.svg("effects", (10, 0.42 * len(effects) + 1.6), alt, draw)


def _bars(
    effects: Sequence[str], by_effect: CostsOfEffects, against: str, shift: float
) -> Iterator[tuple[float, sections.Row]]:
    """Yield the position and the row of each bar."""
    for (effect, background), row in by_effect.items():
        if background == against:
            yield effects.index(effect) + shift, row


def _draw_losses(
    axes: Axes, bars: Sequence[tuple[float, sections.Row]], colour: str, label: str
) -> None:
    """Draw bars with error bars; a loss that is no number is a word instead."""
    positions = [position for position, _ in bars]
    losses_mm = np.array([np.nan_to_num(row["loss_mm"], posinf=0.0, neginf=0.0) for _, row in bars])
    ends_mm = np.array([[row["loss_low_mm"], row["loss_high_mm"]] for _, row in bars])
    ends_mm = np.where(np.isfinite(ends_mm), ends_mm, losses_mm[:, None])
    errors_mm = np.abs(ends_mm - losses_mm[:, None]).T
    axes.barh(
        positions,
        losses_mm,
        0.36,
        xerr=errors_mm,
        color=colour,
        label=label,
        ecolor=blocks.INK,
        capsize=2,
    )
    for position, row in bars:
        if not np.isfinite(row["loss_mm"]):
            axes.text(0, position, " out of range", va="center", fontsize=8, color=blocks.GREY)
