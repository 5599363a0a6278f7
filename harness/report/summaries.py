"""Summaries of an experiment that is not a study, computed once for files, pages and terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from harness.evaluation.maps import by_views, compare_maps, map_cases, maps_of
from harness.evaluation.set_ups import compare_set_ups, effect_costs, set_ups_of
from harness.evaluation.summary import false_calls, noise_against_frames, summarise_holes
from harness.records import trials
from harness.records.examples import ExampleCloud, MappedExample
from harness.records.schema import Table
from harness.report.claims import ClaimSet, Verdict
from harness.vocabulary.provenance import RESULTS_VERSION

Summaries = Mapping[Table, pd.DataFrame]
LISTS = ("found", "undecided", "reasons")
"""Columns whose values are lists in memory and text in files."""
IN_FILES = {"conditions": "place"}
"""Columns that have another name in files."""


def summaries(
    tables: trials.ResultTables,
    examples: Sequence[ExampleCloud | MappedExample] = (),
    claim_set: ClaimSet | None = None,
) -> Summaries:
    """Return all tables for a page. Claims, which use the pictures ``examples``, and the posterior
    need a ``claim_set``."""
    paths = [str(path) for path in tables.axes["path"]]
    summary = summarise_holes(tables.holes, paths)
    computed: dict[Table, pd.DataFrame] = {
        trials.SUMMARY: summary,
        trials.FALSE_CALLS: false_calls(tables.runs),
        trials.NOISE_BY_FRAMES: noise_against_frames(tables.probes),
    }
    verdicts: Sequence[Verdict] = ()
    if not tables.registrations.empty:
        computed[trials.SET_UPS] = compare_maps(tables, summary)
        computed[trials.REGISTRATION_ERRORS] = _registration_errors(tables)
        if claim_set is not None:
            verdicts = claim_set.judge_views(map_cases(tables, summary))
    else:
        has_several = len(set_ups_of(tables)) > 1
        computed[trials.SET_UPS] = _compared(tables, summary, half_sizes=has_several)
        computed[trials.EFFECTS] = effect_costs(tables)
        if claim_set is not None and has_several:
            verdicts = claim_set.judge_set_ups(summary, paths)
            posterior = claim_set.posterior_of(of_set_ups(summary, tables), paths)
            if posterior is not None:
                computed[trials.POSTERIOR] = posterior
        elif claim_set is not None:
            clouds = [example for example in examples if isinstance(example, ExampleCloud)]
            verdicts = claim_set.judge_sweep(tables, clouds, summary)
    computed[trials.CLAIMS] = trials.CLAIMS.frame(map(vars, verdicts))
    return computed


def _registration_errors(tables: trials.ResultTables) -> pd.DataFrame:
    """Return the errors of the set-ups' registrations for each number of views that occurs."""
    counts = sorted({set_up.views for set_up in maps_of(tables)})
    return by_views(of_set_ups(tables.registrations, tables), counts)


def _compared(tables: trials.ResultTables, summary: pd.DataFrame, half_sizes: bool) -> pd.DataFrame:
    """Return the comparison of all set-ups and variations."""
    variants = [str(name) for name in tables.variants["variant"]]
    compared = compare_set_ups(tables, summary, variants, half_sizes=half_sizes)
    if len(compared):
        compared["is_variation"] = ~compared["variant"].isin(set_ups_of(tables))
    return compared


def of_set_ups(rows: pd.DataFrame, tables: trials.ResultTables) -> pd.DataFrame:
    """Select the rows of the experiment's set-ups, without variations."""
    return rows[rows["variant"].isin(set_ups_of(tables))] if len(rows) else rows


def verdicts_of(computed: Summaries) -> list[Verdict]:
    """Return the claims that were scored."""
    rows: list[Any] = computed[trials.CLAIMS].to_dict("records")
    return [Verdict(**row) for row in rows]


def as_files(computed: Summaries) -> dict[Table, pd.DataFrame]:
    """Return the tables as files hold them, with lists converted to text."""
    written = {}
    for table, frame in computed.items():
        texts = {name: frame[name].map("; ".join) for name in LISTS if name in frame}
        written[table] = frame.assign(**texts).rename(columns=IN_FILES)
    written[trials.SUMMARY] = written[trials.SUMMARY].assign(results_version=RESULTS_VERSION)
    return written
