"""Records of trials as tables: one row per trial and hole, one per trial, one per probe pixel, one per variant."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from harness.engine.walls import wall_rows
from harness.evaluation.maps import compare_maps, map_cases, maps_of
from harness.evaluation.noise import noise_against_frames
from harness.evaluation.registration import by_views
from harness.evaluation.set_ups import compare_set_ups, set_ups_of
from harness.evaluation.summary import false_calls, summarise_holes
from harness.experiment.points import MAIN, Experiment, Point
from harness.experiment.schema import LabelledVariation
from harness.experiment.unfold import FRAMES
from harness.tables.schema import Table, write_table
from harness.tables.trials import (
    CLAIMS,
    FALSE_CALLS,
    NOISE,
    NOISE_BY_FRAMES,
    PROBES,
    REGISTRATION_ERRORS,
    REGISTRATIONS,
    RUNS,
    SET_UPS,
    STUDY_ONLY,
    SUMMARY,
    TRIALS,
    ResultTables,
)
from harness.vocabulary.path_names import names_of, unit_of
from harness.vocabulary.units import MM
from harness.vocabulary.versions import RESULTS_VERSION

RECORDED = {"holes": TRIALS, "runs": RUNS, "noise": NOISE, "registrations": REGISTRATIONS}
"""Tables by the name that records call their rows by; probes apart, which are taken together over repeats."""
OF_STUDY = {table.name: table for table in STUDY_ONLY}

ROWS_AT_ONCE = 2000
"""Rows that are held as mappings, some 3 MB, before they become a frame."""
UNKNOWN = np.iinfo(np.int32).min
"""Stands among whole numbers for a value that is not known."""
PIXELS_AT_ONCE = 64


def tables_of(records: Iterable[Mapping[str, Any]], experiment: Experiment) -> ResultTables:
    """Collect records into tables in a fixed order; equal for equal records in equal order. The number of frames apart,
    every axis is a column of all tables but those of a study alone."""
    collected = {name: _Rows() for name in (*RECORDED, *OF_STUDY)}
    probes: list[dict[str, Any]] = []
    for record in records:
        for row in record.get("probes", ()):
            errors = np.array([UNKNOWN if value is None else value for value in row["error_tenth_um"]], np.int32)
            probes.append({**row, "error_tenth_um": errors})
        for name, rows in collected.items():
            rows.add(record.get(name, ()))
    paths = list(experiment.points[0].axes)
    names = names_of(paths)
    axes = pd.DataFrame(
        [{"path": path, "name": names[path], "unit": unit_of(path)} for path in paths],
        columns=["path", "name", "unit"],
    )
    variants = _variants(experiment)
    placed = variants.set_index("variant")[paths]

    def with_axes(table: pd.DataFrame) -> pd.DataFrame:
        return table if table.empty or axes.empty else table.join(placed, on="variant")

    ordered = {name: with_axes(_ordered(collected[name].table(), table)) for name, table in RECORDED.items()}
    of_study = {name: _ordered(collected[name].table(), table) for name, table in OF_STUDY.items()}
    walls = wall_rows(experiment) if experiment.config.study is None else pd.DataFrame()
    return ResultTables(
        **ordered, **of_study, probes=with_axes(_probes(probes)), variants=variants, axes=axes, walls=walls
    )


class _Rows:
    """Rows on their way into a table: a row as a mapping takes ten times the memory that it takes in a frame."""

    def __init__(self) -> None:
        self._frames: list[pd.DataFrame] = []
        self._rows: list[Mapping[str, Any]] = []

    def add(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Some more rows."""
        self._rows.extend(rows)
        if len(self._rows) >= ROWS_AT_ONCE:
            self._flush()

    def table(self) -> pd.DataFrame:
        """All rows; nothing is left here."""
        self._flush()
        frames, self._frames = self._frames, []
        return pd.concat(frames, ignore_index=True) if len(frames) > 1 else frames[0]

    def _flush(self) -> None:
        if self._rows or not self._frames:
            frame = pd.DataFrame(_one_a_threshold(self._rows))
            for column in [name for name in frame.columns if frame[name].dtype == object]:
                # each word once: every record brings its own copy
                frame[column] = [sys.intern(value) if type(value) is str else value for value in frame[column]]
            self._frames.append(frame)
        self._rows = []


def _one_a_threshold(rows: list[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Rows with lists over thresholds, as one row for each threshold."""
    if not rows or not isinstance(rows[0].get("threshold"), list):
        return rows
    lists = [name for name, value in rows[0].items() if isinstance(value, list)]
    return [{**row, **{name: row[name][k] for name in lists}} for row in rows for k in range(len(row["threshold"]))]


def _ordered(table: pd.DataFrame, declared: Table) -> pd.DataFrame:
    """The rows in the declared order; columns that JSON filled with None hold numbers with NaN."""
    order = [name for name in declared.order if name in table]
    table = table if table.empty else table.sort_values(order, kind="stable", ignore_index=True)
    for column in table.columns:
        if table[column].dtype == object and not table[column].map(lambda v: isinstance(v, str)).any():
            table[column] = table[column].astype(float)
    return table


def _probes(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """Mean error and temporal deviation of each probe over the hole-free repeats, and how clouds move as a whole.

    A frame that jumps moves its whole cloud, which no detector on a fitted surface notices; what a repeat's median
    error differs from the median repeat's is told as ``displacement_std_mm`` and taken out of the other two.
    """
    grouped: dict[tuple[str, int], list[list[Any]]] = {}
    for row in sorted(rows, key=lambda r: (r["variant"], r["frames"], r["repeat"])):
        grouped.setdefault((row["variant"], row["frames"]), []).append(row["error_tenth_um"])
    tables = []
    for (variant, frames), errors in grouped.items():
        tenth_um = np.array(errors)
        displacement = _displacements(tenth_um)
        mean, std = np.empty((2, tenth_um.shape[1]))
        for pixels in np.array_split(np.arange(tenth_um.shape[1]), -(-tenth_um.shape[1] // PIXELS_AT_ONCE) or 1):
            mm = _in_mm(tenth_um[:, pixels]) - displacement[:, None]
            mean[pixels] = mm.mean(axis=0)
            with np.errstate(invalid="ignore"):
                std[pixels] = mm.std(axis=0, ddof=1) if len(mm) > 1 else np.nan
        tables.append(
            pd.DataFrame(
                {
                    "variant": variant,
                    "frames": frames,
                    "pixel": np.arange(tenth_um.shape[1]),
                    "mean_error_mm": mean,
                    "temporal_std_mm": std,
                    "displacement_std_mm": displacement.std(ddof=1) if len(displacement) > 1 else np.nan,
                    "repeats": len(displacement),
                }
            )
        )
    columns = [column.name for column in PROBES.columns]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=columns)


def _in_mm(tenth_um: np.ndarray) -> np.ndarray:
    """Errors in mm; NaN where they are not known."""
    return np.where(tenth_um == UNKNOWN, np.nan, tenth_um) * 1e-7 / MM


def _displacements(tenth_um: np.ndarray) -> np.ndarray:
    """(repeats,) mm: each repeat's median error over the probes, less the median repeat's; 0 where none is known."""
    known = (tenth_um != UNKNOWN).any(axis=1)
    medians = np.zeros(len(tenth_um))
    for repeat in np.flatnonzero(known):
        medians[repeat] = np.nanmedian(_in_mm(tenth_um[repeat]))
    if known.any():
        medians[known] -= np.median(medians[known])
    return medians


def _variants(experiment: Experiment) -> pd.DataFrame:
    """The changes of each set-up and variation, their reasons, and their places on the axes."""
    paths = list(experiment.points[0].axes)
    seen: dict[str, dict[str, Any]] = {}
    for point in experiment.points:
        if point.variant in seen:
            continue
        values = {k: v for k, v in point.values.items() if k != FRAMES}
        switches = values.get(experiment.config.switches or "")
        seen[point.variant] = {
            "variant": point.variant,
            "reason": _reason(experiment, point),
            "settings": "" if point.variant == MAIN else json.dumps(values, sort_keys=True),
            "is_variation": point.is_variation,
            "reference": point.reference,
            "switches": json.dumps(switches) if switches and not point.is_variation else "",
            **point.axes,
        }
    columns = ["variant", "reason", "settings", "is_variation", "reference", "switches", *paths]
    table = pd.DataFrame(list(seen.values()), columns=columns)
    for path in paths:
        numbers = table[path].map(lambda v: isinstance(v, int | float) and not isinstance(v, bool))
        # a column of Parquet has one type
        table[path] = table[path].astype(float) if numbers.all() else table[path].map(_text)
    return table


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)


def _reason(experiment: Experiment, point: Point) -> str:
    """The reason that the experiment's file gives for a variation; empty for its set-ups."""
    study = experiment.config.sensitivity
    if study is None or not point.is_variation:
        return ""
    changed = set(point.values) - {FRAMES}
    for variation in study.vary:
        if isinstance(variation, LabelledVariation):
            named = variation.label == point.variant
        else:
            named = changed == {variation.path} and point.variant.startswith(f"{variation.path}=")
        if named:
            return variation.reason
    return ""


# ---------------------------------------------------------------- files


def origin_of(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return what stands in the schema of every Parquet file."""
    keys = ("results_version", "experiment", "digest", "seed", "commit", "dirty", "versions")
    return {key: provenance[key] for key in keys}


def write_tables(folder: Path, tables: ResultTables, provenance: Mapping[str, Any]) -> None:
    """Write the tables of trials."""
    for table, frame in tables.stored().items():
        write_table(folder, table, frame, origin_of(provenance))


def summaries(tables: ResultTables, examples: Sequence[Any] = ()) -> dict[Table, pd.DataFrame]:
    """Return the summaries of an experiment that is no study: all that its page shows. ``examples``: pictures that
    claims are scored with."""
    from harness.thesis.cameras import claim_c11
    from harness.thesis.claims import score_claims
    from harness.thesis.verdicts import claims_table
    from harness.thesis.views import score_views

    paths, variants = list(tables.axes["path"]), set_ups_of(tables)
    summary = summarise_holes(tables.holes, paths)
    found = {NOISE_BY_FRAMES: noise_against_frames(tables.probes), FALSE_CALLS: false_calls(tables.runs)}
    if not tables.registrations.empty:
        own = tables.registrations[tables.registrations["variant"].isin(variants)]
        found[SET_UPS] = compare_maps(tables, summary)
        found[REGISTRATION_ERRORS] = by_views(own, sorted({one.views for one in maps_of(tables)}))
        found[CLAIMS] = claims_table(score_views(map_cases(tables, summary)))
    elif len(variants) > 1:
        verdict = claim_c11(summary[summary["variant"].isin(variants)], paths)
        found[SET_UPS] = compare_set_ups(tables, summary, variants)
        found[CLAIMS] = claims_table([verdict] if verdict else [])
    else:
        found[CLAIMS] = claims_table(score_claims(tables, MAIN, examples, summary))
    for frame in found.values():
        for name in {"found", "undecided", "reasons"} & set(frame.columns):
            frame[name] = frame[name].map("; ".join)
    return {SUMMARY: summary.assign(results_version=RESULTS_VERSION), **found}
