"""Summaries of an experiment that is not a study, computed once for files, pages and the terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from harness.evaluation.maps import by_views, compare_maps, map_cases, maps_of
from harness.evaluation.set_ups import compare_set_ups, effect_costs, set_ups_of
from harness.evaluation.summary import false_calls, noise_against_frames, summarise_holes
from harness.records import trials
from harness.records.schema import Table
from harness.report.claims import ClaimSet, Verdict
from harness.vocabulary.provenance import RESULTS_VERSION

Summaries = Mapping[Table, pd.DataFrame]
LISTS = (
    "found",
    "undecided",
    "reasons",
)  # columns whose values are lists in memory and text in files


def summaries(
    tables: trials.ResultTables,
    examples: Sequence[Any] = (),
    claim_set: ClaimSet | None = None,
) -> Summaries:
    """Return all tables for a page. Claims, which use the pictures ``examples``, and the
    posterior need a ``claim_set``."""
    paths = [str(path) for path in tables.axes["path"]]
    set_ups = set_ups_of(tables)
    summary = summarise_holes(tables.holes, paths)
    everything = [str(name) for name in tables.variants["variant"]]
    found = {trials.SUMMARY: summary, trials.FALSE_CALLS: false_calls(tables.runs)}
    found[trials.NOISE_BY_FRAMES] = noise_against_frames(tables.probes)
    verdicts: Sequence[Verdict] = ()
    if not tables.registrations.empty:
        own = tables.registrations[tables.registrations["variant"].isin(set_ups)]
        found[trials.SET_UPS] = compare_maps(tables, summary)
        found[trials.REGISTRATION_ERRORS] = by_views(
            own, sorted({set_up.views for set_up in maps_of(tables)})
        )
        if claim_set is not None:
            verdicts = claim_set.judge_views(map_cases(tables, summary))
    else:
        several = len(set_ups) > 1
        compared = compare_set_ups(tables, summary, everything, half_sizes=several)
        if len(compared):
            compared["is_variation"] = ~compared["variant"].isin(set_ups)
        found[trials.SET_UPS] = compared
        found[trials.EFFECTS] = effect_costs(tables)
        if claim_set is not None and several:
            verdicts = claim_set.judge_set_ups(summary, paths)
            posterior = claim_set.posterior_of(of_set_ups(summary, tables), paths)
            if posterior is not None:
                found[trials.POSTERIOR] = posterior
        elif claim_set is not None:
            verdicts = claim_set.judge_sweep(tables, examples, summary)
    return {**found, trials.CLAIMS: trials.CLAIMS.frame(map(vars, verdicts))}


def of_set_ups(rows: pd.DataFrame, tables: trials.ResultTables) -> pd.DataFrame:
    """Select the rows of the experiment's set-ups, without variations."""
    return rows[rows["variant"].isin(set_ups_of(tables))] if len(rows) else rows


def verdicts_of(found: Summaries) -> list[Verdict]:
    """Return the claims that were scored."""
    return [Verdict(*row) for row in found[trials.CLAIMS].itertuples(index=False)]


def as_files(found: Summaries) -> dict[Table, pd.DataFrame]:
    """Return the tables as files hold them, with lists converted to text."""
    written = {
        table: frame.assign(**{name: frame[name].map("; ".join) for name in LISTS if name in frame})
        for table, frame in found.items()
    }
    return written | {
        trials.SUMMARY: written[trials.SUMMARY].assign(results_version=RESULTS_VERSION)
    }
