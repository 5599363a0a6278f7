"""The page of an experiment with several set-ups: what each finds, side by side, and why they differ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from harness.evaluation.intervals import wilson
from harness.evaluation.set_ups import LIMIT_RULE, EffectCosts, compare_set_ups, effect_costs, set_ups_of
from harness.evaluation.summary import false_calls, found_rule, hole_list, summarise_holes
from harness.report.blocks import closing, figure, heading, note, page, paragraph, subheading
from harness.report.claims import claims_section
from harness.report.clouds import one_hole_figure, residual_figure, sights_figure
from harness.report.examples import ExampleCloud
from harness.report.set_ups_figures import LAGS, cost_text, effects_figure, grain_figure, limits_figure
from harness.tables.grid import Cell, Grid
from harness.tables.text import bounded, inches, mm
from harness.tables.trials import ResultTables
from harness.thesis.cameras import claim_c11
from harness.thesis.verdicts import Verdict
from harness.vocabulary.path_names import value_text

if TYPE_CHECKING:
    import pandas as pd

Row = Mapping[str, Any]

MOST_PICTURES = 6
"""Set-ups side by side in one picture; more would be too small to see a hole in."""
MOST_NAMES = 15
"""Holes up to which a cell lists them by name; beyond it their number and the limit say more."""
MOST_WIDE = 12
"""Sizes up to which a table has room for drills."""
ERRORS = {
    "extent": "size, extent (mm)",
    "model": "size, model (mm)",
    "extent_place": "position, extent (mm)",
    "model_place": "position, model (mm)",
}
CALLS_NOTE = (
    "Detections that belong to no hole, with exact 95 % Poisson intervals. Where the threshold is calibrated, it is "
    "the highest of the quiet thresholds of R hole-free runs with other noise (the lowest k without a false cluster in "
    "each); one more such run would exceed it with probability 1/(R + 1)."
)


@dataclass(frozen=True)
class Layout:
    """The places of set-ups in tables: the last axis across, all others down; of a single axis, all down.

    ``rows``: text of a row -> its set-ups, one a column. ``columns``: text of the last axis' values; ``column_values``
    those values where they are numbers, and ``column_name`` what they are. ``shown_frames``: the least and the most.
    """

    rows: Mapping[str, Sequence[str]]
    columns: tuple[str, ...]
    column_name: str
    column_values: tuple[float, ...]
    shown_frames: tuple[int, ...]

    @property
    def variants(self) -> list[str]:
        """All set-ups, row by row."""
        return [name for names in self.rows.values() for name in names]

    @property
    def middle_column(self) -> int:
        """The column of the pictures: the middle one, the lower of two."""
        return max(0, (len(self.columns) - 1) // 2)

    @property
    def heads(self) -> tuple[str, ...]:
        """The heads of the columns that name a set-up."""
        return ("set-up", self.column_name) if self.columns else ("set-up",)

    def names(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """Each set-up with the cells that name it; a row's text stands once."""
        for title, variants in self.rows.items():
            for place, variant in enumerate(variants):
                yield variant, ("" if place else title, self.columns[place]) if self.columns else (title,)

    @staticmethod
    def of(tables: ResultTables, compared: pd.DataFrame) -> Layout:
        """The layout of an experiment's set-ups."""
        set_ups = tables.variants[~tables.variants["is_variation"].astype(bool)]
        paths = [str(path) for path in tables.axes["path"]]
        frames = sorted(int(n) for n in compared["frames"].unique()) if len(compared) else []
        shown = tuple(dict.fromkeys([*frames[:1], *frames[-1:]]))
        values = list(dict.fromkeys(set_ups[paths[-1]])) if len(paths) > 1 else []
        if not values or len(set_ups) % len(values):
            return Layout({str(name): [str(name)] for name in set_ups["variant"]}, (), "", (), shown)
        rows: dict[str, list[str]] = {}
        for _, row in set_ups.iterrows():
            title = ", ".join(value_text(path, row[path]) for path in paths[:-1])
            rows.setdefault(title, []).append(str(row["variant"]))
        numbers = tuple(float(v) for v in values) if all(isinstance(v, int | float) for v in values) else ()
        last = tables.axes.iloc[-1]
        unit = f" ({last['unit']})" if last["unit"] else ""
        return Layout(rows, tuple(value_text(paths[-1], v) for v in values), last["name"] + unit, numbers, shown)


def set_ups_html(
    tables: ResultTables,
    examples: Sequence[ExampleCloud],
    provenance: Mapping[str, Any],
    experiment_yaml_text: str,
    title: str,
    with_claims: bool = False,
) -> str:
    """The page as text; the arguments are those of `harness.report.page.write_report`."""
    axes = [str(path) for path in tables.axes["path"]]
    summary = summarise_holes(tables.holes, axes)
    compared = compare_set_ups(tables, summary, set_ups_of(tables))
    layout = Layout.of(tables, compared)
    costs = effect_costs(tables)
    verdict = claim_c11(summary[summary["variant"].isin(layout.variants)], axes) if with_claims else None
    figures = _figures(compared, layout, examples, costs)
    repeats = int(compared["repeats"].max()) if len(compared) else 0
    draws = "The one repeat is one draw" if repeats == 1 else f"The repeats are {repeats} draws"
    under = note(
        f"{found_rule(repeats)} {LIMIT_RULE} Each set-up has hole-free runs and a threshold of its own. {draws} of the "
        "noise before the same board in the same place with one unit of each camera: the intervals speak of these "
        "set-ups, not of other boards, places or units."
    )
    body = [
        heading("Holes found"),
        paragraph(
            "For each set-up: the number of holes found, which, and the smallest diameter from which on all are "
            "found. The bluer, the more."
        ),
        found_grid(compared, layout).html(),
        *_effects_section(figures, costs),
        heading("Detections by hole"),
        paragraph(
            "Detections of trials, by hole or, where there are several of one size (×), by size; point at a cell for "
            "the 95 % Wilson interval of its rate."
        ),
    ]
    for frames in layout.shown_frames:
        body += [subheading(_frames(frames)), _sizes(summary, layout, frames).html()]
    body += _pictures(figures, layout)
    body += [
        heading("Sizes and positions"),
        paragraph(
            "Over all single measurements of the holes found: mean error ± standard deviation (number of "
            "measurements), in mm. Positions are distances from the largest hole, which has none of its own; where "
            "several holes are the largest there are none. The sets of holes differ between rows: a set-up that finds "
            "small holes is judged by them too."
        ),
        _by_set_up(
            compared,
            layout,
            {"found": count_text} | {label: partial(error_text, name=name) for name, label in ERRORS.items()},
        ).html(),
        heading("What each camera gives"),
    ]  # fmt: skip
    if "grain" in figures:
        body.append(
            figure(
                figures,
                "grain",
                "Left: standard deviation over undamaged pixels of one frame's temporal noise, from differences of two "
                "frames. Right: its correlation with the noise of pixels some columns or rows on; white noise would "
                "fall to zero at once.",
            )
        )
    body += [_cameras(compared, layout).html(), note(_CAMERAS_NOTE)]
    body += claims_section("The thesis' claim", [verdict] if verdict else [])
    everything = [*layout.variants, *_variations(tables)]
    varied = compare_set_ups(tables, summary, everything, half_sizes=False)
    body += varied_section(tables, varied, layout.shown_frames)
    if verdict:
        body += _c11_with_variations(tables, summary, layout, verdict)
    calls = false_calls(tables.runs)
    calls = calls[(calls["role"] == "damaged") & calls["variant"].isin(layout.variants)]
    body += [heading("Thresholds and false calls"), paragraph(CALLS_NOTE)]
    body.append(calls_grid(calls[calls["frames"].isin(layout.shown_frames)], by_set_up=True).html())
    end = closing(provenance, experiment_yaml_text, left_out(tables.runs))
    return page(title, answer_sentence(compared, layout, costs, verdict), [*body, *end], [under])


def answer_sentence(
    compared: pd.DataFrame, layout: Layout, costs: Sequence[EffectCosts], verdict: Verdict | None
) -> str:
    """Say what the experiment found in a few sentences: each row's holes with the most frames, the dearest
    effect, C11."""
    if compared.empty:
        return "No trial of any set-up finished, so there is no answer."
    most = layout.shown_frames[-1]
    many = compared[compared["frames"] == most]
    found = {row["variant"]: len(row["found"]) for _, row in many.iterrows()}
    rows = [f"{row} {', '.join(str(found.get(name, '–')) for name in names)}" for row, names in layout.rows.items()]
    where = f" at {', '.join(layout.columns)}" if layout.columns else ""
    said = [f"Found of {int(compared['holes'].max())} holes{where} with {_counted(most)}: {'; '.join(rows)}."]
    if costs:
        said = []
    for each in (costs_at for costs_at in costs if costs_at.frames in layout.shown_frames):
        place = f"{each.place}, " if each.place else ""
        moved = f"all effects together move the 50 % size by {cost_text(each.together)}"
        dearest = max(each.effects, key=lambda one: np.nan_to_num(one.alone.mm, nan=-np.inf), default=None)
        alone = f"; alone, {dearest.effect} does most: {cost_text(dearest.alone)}" if dearest else ""
        said.append(f"With {place}{_counted(each.frames)}, {moved}{alone}.")
    if verdict:
        said.append(f"{verdict.claim} ({verdict.text.rstrip('.')}) is {verdict.verdict}.")
    return " ".join(said)


def found_grid(compared: pd.DataFrame, layout: Layout) -> Grid:
    """Holes found and their limit: rows of the layout and numbers of frames down, columns of the layout across."""
    there = {(row["variant"], row["frames"]): row for row in records(compared)}
    if not layout.columns:
        heads = ("found", "50 % size in mm (95 %)")
        rows = [
            [name, *(cell for n in layout.shown_frames for cell in _found_cells(there.get((variants[0], n))))]
            for name, variants in layout.rows.items()
        ]
        return Grid.of(("set-up", *(f"{_frames(n)}: {head}" for n in layout.shown_frames for head in heads)), rows)
    rows = [
        ["" if at else name, _frames(n), *(_found_cells(there.get((variant, n)))[0] for variant in variants)]
        for name, variants in layout.rows.items()
        for at, n in enumerate(layout.shown_frames)
    ]
    return Grid.of(("", "", *layout.columns), rows, left=2)


def _found_cells(row: Row | None) -> tuple[Cell, Cell]:
    """Return what one set-up finds, and its 50 % size with the interval; a bound where it lies off the ladder."""
    if row is None:
        return Cell("–\nnot finished"), Cell("–")
    half = "above the largest"
    if np.isfinite(row["half_mm"]):
        high = f"{row['half_high_mm']:.2f}" if np.isfinite(row["half_high_mm"]) else "∞"
        half = f"{row['half_mm']:.2f} ({row['half_low_mm']:.2f} to {high})"
    names = ", ".join(part for part in (found_text(row), f"from {limit_text(row)}") if part)
    return Cell(f"{count_text(row)}\n{names}", share=len(row["found"]) / row["holes"]), Cell(half)


def count_text(row: Row | pd.Series) -> str:
    """``9 of 11``."""
    return f"{len(row['found'])} of {row['holes']}"


def found_text(row: Row | pd.Series) -> str:
    """The names of the holes found, with those undecided; empty where there are too many to read."""
    if row["holes"] > MOST_NAMES:
        return f"{len(row['undecided'])} undecided" if row["undecided"] else ""
    undecided = f"; undecided {hole_list(row['undecided'])}" if row["undecided"] else ""
    return hole_list(row["found"]) + undecided


def limit_text(row: Row) -> str:
    """The smallest diameter found, with all larger ones."""
    return f"{row['limit_mm']:.2f} mm" if np.isfinite(row["limit_mm"]) else "none found"


def error_text(row: Row, name: str) -> str:
    """Mean error ± standard deviation (number) of one measure."""
    n = int(row[f"{name}_n"])
    std = f" ± {row[f'{name}_std_mm']:.2f}" if np.isfinite(row[f"{name}_std_mm"]) else ""
    return f"{signed(row[f'{name}_bias_mm'])}{std} ({n})" if n else "–"


def signed(value: float) -> str:
    """A difference with its sign, or a dash."""
    return f"{value:+.2f}".replace("-", "−") if np.isfinite(value) else "–"


def _effects_section(figures: Mapping[str, str], costs: Sequence[EffectCosts]) -> list[Markup]:
    if not costs:
        return []
    places = [", ".join(part for part in (each.place, _frames(each.frames)) if part) for each in costs]
    heads = ("effect", *(f"{place}: {which}" for place in places for which in ("alone", "on top of all others")))
    rows = [
        [
            effect.effect,
            *(cost_text(cost) for each in costs for cost in (each.effects[at].alone, each.effects[at].last)),
        ]
        for at, effect in enumerate(costs[0].effects)
    ]
    rows.append(["all together", *(cell for each in costs for cell in (cost_text(each.together), "–"))])
    return [
        heading("What each effect costs"),
        paragraph(
            "The loss is the change of the 50 % size when an effect goes on: alone, where no other acts, and on top of "
            "all others, where they act already. The same noise and the same holes stand behind both sides of each "
            "difference. A gain (a negative loss) is possible. Without noise the repeats are alike, and the rounding "
            "of the output is the only error left: steps that noise would blur decide which hole is found."
        ),
        figure(
            figures,
            "effects",
            "Bars to the right: only larger holes are found with the effect. Error bars are 95 % bootstrap intervals "
            "over holes of one size and over repeats, paired.",
        ),
        Grid.of(heads, rows).html(),
    ]


def _sizes(summary: pd.DataFrame, layout: Layout, frames: int) -> Grid:
    """Detections of trials by set-up and true diameter, holes of one size together."""
    rows = summary[(summary["frames"] == frames) & summary["variant"].isin(layout.variants)]
    sizes = sorted(rows["true_diameter_mm"].unique())
    heads = []
    for size in sizes:
        names = list(dict.fromkeys(rows["hole"][rows["true_diameter_mm"] == size]))
        holes = hole_list(names) if len(names) == 1 else f"×{len(names)}"
        drill = inches(float(size)) if len(sizes) <= MOST_WIDE else ""
        heads.append(", ".join(part for part in (holes, drill, f"{size:.2f} mm") if part))
    counted = rows.groupby(["variant", "true_diameter_mm"])[["detected", "n"]].sum()
    counts = {(str(key[0]), float(key[1])): (int(d), int(n)) for key, d, n in counted.itertuples()}
    lines = [[*named, *(_rate(counts.get((variant, size))) for size in sizes)] for variant, named in layout.names()]
    return Grid.of((*layout.heads, *heads), lines, left=len(layout.heads))


def _rate(counts: tuple[int, int] | None) -> Cell:
    if counts is None:
        return Cell("–", hover="not finished")
    detected, n = counts
    low, high = (float(end) for end in wilson(detected, n))
    hover = f"rate {detected / n:.2f}, 95 % Wilson interval {low:.2f} to {high:.2f}"
    return Cell(f"{detected}/{n}", share=detected / n, hover=hover)


def _pictures(figures: Mapping[str, str], layout: Layout) -> list[Markup]:
    body = []
    if "limits" in figures:
        caption = (
            "The smallest diameter from which on every hole is found, and how far apart neighbouring pixels look at "
            "the board. A missing point: not even the largest hole is found, or a larger hole is missed."
        )
        body.append(figure(figures, "limits", caption))
    if "sights" in figures:
        at = f" at {layout.columns[layout.middle_column]}" if layout.columns else ""
        caption = (
            f"Distance behind (+) or before (−) the fitted surface{at}, averaged over the most frames, first damaged "
            "repeat. Circle: the true rim. Dots: pixels of detected clusters. Grey: no valid point. One colour scale, "
            "linear within ±1 mm and logarithmic beyond."
        )
        body += [heading("The same hole, as each sees it"), figure(figures, "sights", caption)]
    if "one_hole" in figures:
        body.append(figure(figures, "one_hole", "One hole in every set-up, drawn in the same way."))
    if "board" in figures:
        caption = (
            f"The set-up “{layout.variants[-1]}”, averaged over the most frames: distance behind (+) or before (−) the "
            "fitted surface. The scale is linear within ±1 mm and logarithmic beyond. Grey: no valid point, or outside "
            "the crop."
        )
        body += [heading("The board"), figure(figures, "board", caption)]
    return body


def _by_set_up(compared: pd.DataFrame, layout: Layout, columns: Mapping[str, Any]) -> Grid:
    """A row for each set-up and shown number of frames; ``columns``: label -> text of a record."""
    there = {(row["variant"], row["frames"]): row for row in records(compared)}
    rows = []
    for variant, named in layout.names():
        for at, frames in enumerate(layout.shown_frames):
            row = there.get((variant, frames))
            cells = [text(row) if row is not None else "–" for text in columns.values()]
            rows.append([*(("",) * len(named) if at else named), str(frames), *cells])
    return Grid.of((*layout.heads, "frames", *columns), rows, left=len(layout.heads))


def _cameras(compared: pd.DataFrame, layout: Layout) -> Grid:
    """Return what the camera gives each set-up: pitch, valid pixels, noise and its grain."""

    def number(name: str, digits: int = 2) -> Any:
        return lambda row: mm(row[name], digits)

    def grain(way: str) -> Any:
        # + 0.0 turns -0.0 into 0.0
        return lambda row: ", ".join(mm(round(row[f"correlation_{way}{lag}"], 2) + 0.0) for lag in LAGS).replace(
            "-", "−"
        )

    columns = {
        "mm per pixel": lambda row: f"{mm(row['pitch_u_mm'])} × {mm(row['pitch_v_mm'])}",
        "valid (%)": lambda row: mm(100 * row["valid_share"], 1),
        "one frame (mm)": number("single_frame_mm"),
        "average (mm)": number("temporal_mm"),
        "offset (mm)": lambda row: signed(row["offset_mm"]),
        "pattern (mm)": number("pattern_mm"),
        "surface (mm)": number("surface_mm"),
        "threshold (mm; k)": lambda row: f"{mm(row['threshold_mm'])}; {row['threshold']:.2f}",
        "correlation along rows": grain("u"),
        "along columns": grain("v"),
    }
    return _by_set_up(compared, layout, columns)


_CAMERAS_NOTE = (
    "From hole-free runs, but the surface. Mm per pixel: across × down. Valid pixels: of all that look at the board. "
    "One frame: standard deviation of its temporal noise, displacements of whole frames taken out; of the average: "
    "scatter over repeats, likewise. Offset and pattern: mean and spread over probe pixels of what all repeats share, "
    "multipath included. Surface: robust deviation from the fitted surface on undamaged face beside the holes (a dash: "
    "there is none far enough from holes and rim). Correlation of one frame's noise at lags of 1, 2 and 3 pixels. "
    "Rounding of the output is in all of them."
)


def varied_section(tables: ResultTables, compared: pd.DataFrame, frames: Sequence[int], of: str = "") -> list[Markup]:
    """The sensitivity study: each variation beside the set-up that it changes, else beside ``of``; nothing without
    variations. ``compared``: of `compare_set_ups`, variations among them."""
    there = {(row["variant"], row["frames"]): row for row in records(compared)}
    rows = []
    for variation in records(tables.variants[tables.variants["is_variation"].astype(bool)]):
        name, reference = str(variation["variant"]), str(variation["reference"] or of)
        lines = [(row, there.get((reference, n))) for n in frames if (row := there.get((name, n))) is not None]
        why = str(variation["reason"] or "as declared") + (
            f"\n{variation['settings']}" if variation["settings"] else ""
        )
        for at, (row, other) in enumerate(lines):
            named = ["", "", ""] if at else [name, why, reference or "none of the set-ups"]
            rows.append([*named, *_beside(row, other)])
        if not lines:
            rows.append([name, why, reference, "no trial of it finished", *[""] * 4])
    if not rows:
        return []
    heads = ("variation", "why", "changes", "frames", "found", "there", "threshold (mm)", "there (mm)")
    said = (
        "Each row changes something in the one set-up that it names, and is compared with it. What is found is marked "
        "with ≠ where it differs. A variation with fewer repeats and hole-free runs has a lower threshold."
    )
    return [heading("If facts were otherwise"), paragraph(said), Grid.of(heads, rows, left=3).html()]


def _beside(row: Row, other: Row | None) -> list[str | Cell]:
    differs = other is not None and (row["found"], row["undecided"]) != (other["found"], other["undecided"])
    found = Cell(f"{'≠ ' if differs else ''}{count_text(row)}\n{found_text(row)}", "changed" if differs else "")
    usual = "–" if other is None else f"{count_text(other)}\n{found_text(other)}"
    return [
        str(row["frames"]),
        found,
        usual,
        mm(row["threshold_mm"]),
        "–" if other is None else mm(other["threshold_mm"]),
    ]


def _c11_with_variations(tables: ResultTables, summary: pd.DataFrame, layout: Layout, usual: Verdict) -> list[Markup]:
    """C11 with each variation in the place of the set-up that it changes."""
    rows = []
    for variation in records(tables.variants[tables.variants["is_variation"].astype(bool)]):
        if not variation["reference"]:
            continue
        swapped = [variation["variant"] if one == variation["reference"] else one for one in layout.variants]
        verdict = claim_c11(summary[summary["variant"].isin(swapped)], list(tables.axes["path"]))
        said = verdict.verdict if verdict else "–"
        rows.append([str(variation["variant"]), Cell(("≠ " if said != usual.verdict else "") + said)])
    return [Grid.of(("variation", "C11 with it"), rows, left=2).html()] if rows else []


def _variations(tables: ResultTables) -> list[str]:
    return [str(name) for name in tables.variants["variant"][tables.variants["is_variation"].astype(bool)]]


def calls_grid(calls: pd.DataFrame, *, by_set_up: bool = False) -> Grid:
    """Thresholds and false calls, of `harness.evaluation.summary.false_calls`."""
    heads = (
        *("frames", "runs on", "false calls in runs", "per run (95 %)", "threshold (k)", "threshold (mm)"),
        *("highest quiet k of hole-free runs", "surface noise (mm)"),
    )
    rows = [
        [
            *([row["variant"]] if by_set_up else []),
            str(row["frames"]),
            "damaged board" if row["role"] == "damaged" else "hole-free board",
            f"{row['false_calls']} in {row['runs']}",
            bounded(row["per_run"], row["per_run_low"], row["per_run_high"], 3),
            f"{row['threshold']:.2f}",
            mm(row["threshold_mm"]),
            f"{mm(row['quiet_highest'])} ({row['quiet_runs']:.0f} runs)" if row["quiet_runs"] > 0 else "–",
            mm(row["surface_noise_mm"], 3),
        ]
        for row in records(calls)
    ]
    return Grid.of((*(["set-up"] if by_set_up else []), *heads), rows)


def left_out(runs: pd.DataFrame) -> str:
    """Say how many frames averaging left out as disturbed, over all runs; empty where it left out none."""
    out, used = int(runs["left_out"].sum()), int(runs["frames_used"].sum())
    return f"{out} of {out + used} frames were left out of an average as disturbed." if out else ""


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a table as mappings."""
    return [{str(key): value for key, value in row.items()} for row in table.to_dict("records")]


def _frames(frames: int) -> str:
    return "1 frame" if frames == 1 else f"{frames} frames"


def _counted(frames: int) -> str:
    return "one frame" if frames == 1 else f"{frames} averaged frames"


def _figures(
    compared: pd.DataFrame, layout: Layout, examples: Sequence[ExampleCloud], costs: Sequence[EffectCosts]
) -> dict[str, str]:
    """The figures that the data allow, as SVG text by name."""
    figures: dict[str, str] = {}
    if compared.empty:
        return figures
    if layout.column_values and len(layout.rows) <= MOST_PICTURES:
        figures |= {"limits": limits_figure(compared, layout), "grain": grain_figure(compared, layout)}
    if costs:
        figures["effects"] = effects_figure(costs)
    clouds = {cloud.variant: cloud for cloud in sorted(examples, key=lambda cloud: cloud.frames)}
    grid = {row: [clouds[name] for name in names if name in clouds] for row, names in layout.rows.items()}
    whole = all(len(grid[row]) == len(names) for row, names in layout.rows.items())
    if costs or not whole or not 1 < len(grid) <= MOST_PICTURES:
        last = [clouds[name] for name in layout.variants[-1:] if name in clouds]
        return figures | ({"board": residual_figure(last)} if last else {})
    figures["sights"] = sights_figure({row: line[layout.middle_column] for row, line in grid.items()})
    if 1 < len(layout.columns) <= MOST_PICTURES:
        figures["one_hole"] = one_hole_figure(grid, layout.columns)
    return figures
