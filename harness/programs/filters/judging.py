"""Judges the filters of a finished study, and writes their table and page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from harness.programs.filters.costs import AXIS, FilterCost, costs_of
from harness.vocabulary.errors import UserError

if TYPE_CHECKING:
    from harness.experiment.schema import Experiment


def filter_axis(filters: Sequence[str]) -> str:
    """Return the ``--set`` of the axis: no filter, then each of these, which are names or YAML."""
    declared = [text if text.startswith("{") else f"{{name: {text}}}" for text in filters]
    return f"sweep.{AXIS}=[{', '.join(['null', *declared])}]"


def refuse_other_studies(experiment: Experiment) -> None:
    """Raise UserError for an experiment that does not compare filters."""
    name = experiment.config.name
    if experiment.config.study is None:
        raise UserError(f"{name}: is no study", fix="add study: {boards: 24, hole_free_boards: 24}")
    axis = experiment.config.sweep.get(AXIS, ())
    if None not in axis or len(axis) < 2:
        fix = f"add the axis {AXIS}: [null, {{name: median}}], or --filter median"
        raise UserError(f"{name}: its sweep does not compare filters with none", fix=fix)


def judged_filters(folder: Path, command: str) -> list[FilterCost]:
    """Write and show what each filter of a finished study costs. Returns the costs."""
    import pandas as pd

    from harness.evaluation.study.limit import limit_of
    from harness.evaluation.study.record import read_record
    from harness.programs.filters.page import filters_html, filters_parts
    from harness.programs.filters.tables import FILTER_COSTS
    from harness.records.outputs import FILTERS_PAGE
    from harness.records.trials import RUNS, TRIALS
    from harness.runs.tables import write_tables
    from harness.vocabulary.files import write_text
    from harness.vocabulary.provenance import RESULTS_VERSION, record
    from harness.vocabulary.text import show

    study = read_record(folder)
    holes = pd.read_parquet(folder / f"{TRIALS.name}.parquet")
    runs = pd.read_parquet(folder / f"{RUNS.name}.parquet")
    costs = costs_of([limit_of(set_up) for set_up in study.set_ups], holes, runs)
    provenance = {
        **record(command),
        "results_version": RESULTS_VERSION,
        "experiment": study.name,
        "digest": study.digest,
        "seed": study.provenance.get("seed"),
    }
    write_tables(folder, {FILTER_COSTS: FILTER_COSTS.frame(costs)}, provenance)
    write_text(folder / FILTERS_PAGE.name, filters_html(study, costs, command))
    show(filters_parts(costs))
    print(f"page: {folder / FILTERS_PAGE.name}")
    return costs
