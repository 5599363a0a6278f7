"""The page of an experiment with several set-ups: what each finds, side by side, and why they differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.set_ups import LIMIT_RULE, EffectCosts, compare_set_ups, effect_costs, set_ups_of
from harness.evaluation.summary import false_calls, found_rule, summarise_holes
from harness.report.clouds import residual_figure
from harness.report.effects_figure import cost_text, effects_figure
from harness.report.examples import ExampleCloud
from harness.report.page_parts import closing, template
from harness.report.set_ups_figures import grain_figure, limits_figure
from harness.report.set_ups_rows import (
    Layout,
    accuracy_rows,
    board_rows,
    call_rows,
    matrix_rows,
    size_table,
    variation_rows,
)
from harness.report.sights import one_hole_figure, sights_figure
from harness.tables.trials import ResultTables
from harness.thesis.cameras import claim_c11
from harness.thesis.verdicts import Verdict

if TYPE_CHECKING:
    import pandas as pd

MOST_PICTURES = 6
"""Set-ups side by side in one picture; more would be too small to see a hole in."""


def set_ups_html(
    tables: ResultTables,
    examples: Sequence[ExampleCloud],
    provenance: Mapping[str, Any],
    experiment_yaml_text: str,
    title: str,
) -> str:
    """The page as text; the arguments are those of `harness.report.page.write_report`."""
    axes = [str(path) for path in tables.axes["path"]]
    summary = summarise_holes(tables.holes, axes)
    compared = compare_set_ups(tables, summary, set_ups_of(tables))
    layout = Layout.of(tables, compared)
    costs = effect_costs(tables)
    verdict = claim_c11(summary[summary["variant"].isin(layout.variants)], axes)
    return template("set_ups.html").render(
        title=title,
        answer=answer_sentence(compared, layout, costs, verdict),
        found_rule=found_rule(int(compared["repeats"].max()) if len(compared) else 0),
        limit_rule=LIMIT_RULE,
        repeats=int(compared["repeats"].max()) if len(compared) else 0,
        layout=layout,
        matrix=matrix_rows(compared, layout),
        sizes=[size_table(summary, layout, frames) for frames in layout.shown_frames],
        figures=_figures(compared, layout, examples, costs),
        accuracy=accuracy_rows(compared, layout),
        boards=board_rows(compared, layout),
        costs=[_cost_rows(one) for one in costs],
        verdicts=[verdict] if verdict else [],
        variations=variation_rows(tables, summary, layout),
        calls=call_rows(false_calls(tables.runs), layout),
        most_frames=layout.shown_frames[-1] if layout.shown_frames else 0,
        **closing(tables, provenance, experiment_yaml_text),
    )


def answer_sentence(
    compared: pd.DataFrame, layout: Layout, costs: Sequence[EffectCosts], verdict: Verdict | None
) -> str:
    """What the experiment says in a few sentences: each row's holes with the most frames, the dearest effect, C11."""
    if compared.empty:
        return "No trial of any set-up finished, so there is no answer."
    many = compared[compared["frames"] == layout.shown_frames[-1]]
    found = {row["variant"]: len(row["found"]) for _, row in many.iterrows()}
    said = []
    if costs:
        said = [_costs_sentence(one) for one in costs if one.frames in layout.shown_frames]
    else:
        for row, names in layout.rows.items():
            said.append(f"{row} {', '.join(str(found.get(name, '–')) for name in names)}")
        where = f" at {', '.join(layout.columns)}" if layout.columns else ""
        holes = int(compared["holes"].max())
        said = [f"Found of {holes} holes{where} with {_frames(layout.shown_frames[-1])}: {'; '.join(said)}."]
    if verdict:
        said.append(f"{verdict.claim} ({verdict.text.rstrip('.')}) is {verdict.verdict}.")
    return " ".join(said)


def _costs_sentence(costs: EffectCosts) -> str:
    place = f"{costs.place}, " if costs.place else ""
    text = (
        f"With {place}{_frames(costs.frames)}, all effects together move the 50 % size by {cost_text(costs.together)}"
    )
    dearest = max(costs.effects, key=lambda one: np.nan_to_num(one.alone.mm, nan=-np.inf), default=None)
    return f"{text}; alone, {dearest.effect} does most: {cost_text(dearest.alone)}." if dearest else f"{text}."


def _cost_rows(costs: EffectCosts) -> dict[str, Any]:
    return {
        "head": ", ".join(part for part in (costs.place, _frames(costs.frames)) if part),
        "rows": [(one.effect, cost_text(one.alone), cost_text(one.last)) for one in costs.effects],
        "together": cost_text(costs.together),
    }


def _frames(frames: int) -> str:
    return "one frame" if frames == 1 else f"{frames} averaged frames"


def _figures(
    compared: pd.DataFrame, layout: Layout, examples: Sequence[ExampleCloud], costs: Sequence[EffectCosts]
) -> dict[str, str]:
    """The figures that the data allow, as SVG text by name."""
    figures: dict[str, str] = {}
    if compared.empty:
        return figures
    if layout.column_values and len(layout.rows) <= MOST_PICTURES:
        figures["limits"] = limits_figure(compared, layout)
        figures["grain"] = grain_figure(compared, layout)
    if costs:
        figures["effects"] = effects_figure(costs)
    clouds = {cloud.variant: cloud for cloud in sorted(examples, key=lambda cloud: cloud.frames)}
    grid = {row: [clouds[name] for name in names if name in clouds] for row, names in layout.rows.items()}
    whole = all(len(grid[row]) == len(names) for row, names in layout.rows.items())
    if costs or not whole or not 1 < len(grid) <= MOST_PICTURES:
        last = [clouds[name] for name in layout.variants[-1:] if name in clouds]
        return figures | ({"board": residual_figure(last)} if last else {})
    column = layout.middle_column
    figures["sights"] = sights_figure({row: line[column] for row, line in grid.items()})
    if 1 < len(layout.columns) <= MOST_PICTURES:
        figures["one_hole"] = one_hole_figure(grid, layout.columns)
    return figures
