"""Converts records of trials into tables: one row per trial and damage, per trial, per probe
pixel, and per variant."""

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from pathlib import Path
from sys import intern
from typing import Any

import numpy as np
import pandas as pd

from harness.experiment.schema import MAIN, Experiment, LabelledVariation, Point
from harness.experiment.unfold import FRAMES
from harness.records import trials
from harness.records.schema import Table, write_table
from harness.vocabulary.geometry import MM
from harness.vocabulary.path_names import names_of, unit_of

RECORDED = {
    "holes": trials.TRIALS,
    "runs": trials.RUNS,
    "noise": trials.NOISE,
    "registrations": trials.REGISTRATIONS,
}
"""Tables by the names of their rows in records; probes are separate, because they are combined
over repeats."""
OF_STUDY = {table.name: table for table in trials.STUDY_ONLY}
RECORDS_AT_ONCE = (
    100  # records held as mappings before they become columns, which need a tenth of the memory
)
UNKNOWN = np.iinfo(np.int32).min  # marks an unknown value among whole numbers


def tables_of(records: Iterable[Mapping[str, Any]], experiment: Experiment) -> trials.ResultTables:
    """Collect records into tables in a fixed order. Every axis but frames is a column, except in a
    study's tables."""
    parts: dict[str, list[dict[str, Any]]] = {name: [] for name in (*RECORDED, *OF_STUDY)}
    grids: dict[tuple[float, ...], np.ndarray] = {}
    probes: list[
        tuple[str, int, int, np.ndarray]
    ] = []  # set-up, number of frames, repeat, errors by pixel
    waiting = iter(records)
    while chunk := list(islice(waiting, RECORDS_AT_ONCE)):
        for row in (row for record in chunk for row in record.get("probes", ())):
            errors = np.array(
                [UNKNOWN if value is None else value for value in row["error_tenth_um"]], np.int32
            )
            probes.append((intern(row["variant"]), row["frames"], row["repeat"], errors))
        for name, made in parts.items():
            rows = [row for record in chunk for row in record.get(name, ())]
            if rows:
                made.append(columns_of(rows, grids))
    paths = list(experiment.points[0].axes)
    names = names_of(paths)
    rows_of_axes = [{"path": path, "name": names[path], "unit": unit_of(path)} for path in paths]
    axes = pd.DataFrame(rows_of_axes, columns=["path", "name", "unit"])
    variants = _variants(experiment)
    placed = variants.set_index("variant")[paths]

    def with_axes(table: pd.DataFrame) -> pd.DataFrame:
        return table if table.empty or axes.empty else table.join(placed, on="variant")

    def ordered(name: str, declared: Table) -> pd.DataFrame:
        """Join the parts of a table column by column, so that only one column at a time is held
        twice."""
        own = parts.pop(name)
        sizes = [len(next(iter(part.values()))) for part in own]
        names = dict.fromkeys(column for part in own for column in part)

        def joined(column: str) -> pd.DataFrame:
            present = ({column: part.pop(column)} if column in part else {} for part in own)
            return pd.concat(
                pd.DataFrame(column, range(size))
                for column, size in zip(present, sizes, strict=True)
            )

        if not own:
            return pd.DataFrame()
        order = {
            column: joined(column)[column].array for column in declared.order if column in names
        }
        places = pd.DataFrame(order).sort_values(list(order), kind="stable").index.to_numpy()
        held = (
            (column, order[column] if column in order else joined(column)[column].array)
            for column in names
        )
        return pd.DataFrame({name: values.take(places) for name, values in held}, copy=False)

    return trials.ResultTables(
        **{name: with_axes(ordered(name, table)) for name, table in RECORDED.items()},
        **{name: ordered(name, table) for name, table in OF_STUDY.items()},
        probes=with_axes(_probes(probes)),
        variants=variants,
        axes=axes,
    )


def columns_of(
    rows: Sequence[Mapping[str, Any]], grids: dict[tuple[float, ...], np.ndarray]
) -> dict[str, Any]:
    """Convert rows to columns: numbers and None to floats with NaN, equal lists of thresholds to
    one of ``grids``."""
    found = {}
    for name, column in pd.DataFrame(rows).items():
        if isinstance(column.iloc[0], list):
            if name == "threshold":
                kept = [grids.setdefault(tuple(grid), np.array(grid)) for grid in column]
            else:
                kept = [np.array(counts, np.int32) for counts in column]
            column = pd.Series(kept, dtype=object)
        elif column.dtype == object and column.map(lambda value: isinstance(value, str)).any():
            # equal texts of all records share one object in memory
            column = column.map(lambda value: intern(value) if isinstance(value, str) else value)
        elif column.dtype == object:
            column = column.astype(float)
        found[str(name)] = column.array.copy()
    return found


def _in_mm(tenth_um: np.ndarray) -> np.ndarray:
    return np.where(tenth_um == UNKNOWN, np.nan, tenth_um) * 1e-7 / MM


def _probes(rows: list[tuple[str, int, int, np.ndarray]]) -> pd.DataFrame:
    """Return each probe's mean error and temporal deviation over hole-free repeats, without
    repeats' displacements."""
    grouped: dict[tuple[str, int], list[np.ndarray]] = {}
    for variant, frames, _, errors in sorted(rows, key=lambda row: row[:3]):
        grouped.setdefault((variant, frames), []).append(errors)
    tables = []
    for (variant, frames), repeats in grouped.items():
        # repeat by repeat, as all in millimetres would take four times the memory of the rows
        medians = np.array(
            [np.nanmedian(mm) if np.isfinite(mm).any() else np.nan for mm in map(_in_mm, repeats)]
        )
        known = np.isfinite(medians)
        displacement = np.where(
            known, medians - (np.median(medians[known]) if known.any() else 0.0), 0.0
        )
        several = len(repeats) > 1
        centred = [*zip(repeats, displacement, strict=True)]
        mean = sum(_in_mm(each) - moved for each, moved in centred) / len(repeats)
        squares = sum((_in_mm(each) - moved - mean) ** 2 for each, moved in centred)
        columns = {
            "variant": variant,
            "frames": frames,
            "pixel": np.arange(len(mean)),
            "mean_error_mm": mean,
            "temporal_std_mm": np.sqrt(squares / (len(repeats) - 1)) if several else np.nan,
            "displacement_std_mm": displacement.std(ddof=1) if several else np.nan,
            "repeats": len(repeats),
        }
        tables.append(pd.DataFrame(columns))
    empty = pd.DataFrame(columns=[column.name for column in trials.PROBES.columns])
    return pd.concat(tables, ignore_index=True) if tables else empty


def _variants(experiment: Experiment) -> pd.DataFrame:
    """Return the changes of each set-up and variation, their reasons, and their values on the
    axes."""
    paths = list(experiment.points[0].axes)
    seen: dict[str, dict[str, Any]] = {}
    for point in experiment.points:
        values = {k: v for k, v in point.values.items() if k != FRAMES}
        switches = values.get(experiment.config.switches or "")
        row = {
            "variant": point.variant,
            "reason": _reason(experiment, point),
            "settings": "" if point.variant == MAIN else json.dumps(values, sort_keys=True),
            "is_variation": point.is_variation,
            "reference": point.reference,
            "switches": json.dumps(switches) if switches and not point.is_variation else "",
            **point.axes,
        }
        seen.setdefault(point.variant, row)
    columns = ["variant", "reason", "settings", "is_variation", "reference", "switches", *paths]
    table = pd.DataFrame(list(seen.values()), columns=columns)
    for path in paths:
        numbers = table[path].map(lambda v: isinstance(v, int | float) and not isinstance(v, bool))
        # a column of Parquet has one type
        texts = table[path].map(
            lambda value: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
        )
        table[path] = table[path].astype(float) if numbers.all() else texts
    return table


def _reason(experiment: Experiment, point: Point) -> str:
    """Return the reason that the experiment's file gives for a variation; empty for set-ups."""
    study = experiment.config.sensitivity
    changed = set(point.values) - {FRAMES}
    for variation in study.vary if study is not None and point.is_variation else ():
        if isinstance(variation, LabelledVariation):
            named = variation.label == point.variant
        else:
            named = changed == {variation.path} and point.variant.startswith(f"{variation.path}=")
        if named:
            return variation.reason
    return ""


def write_tables(
    folder: Path, tables: Mapping[Table, pd.DataFrame], provenance: Mapping[str, Any]
) -> None:
    """Write tables; the schema of every Parquet file identifies the run."""
    keys = ("results_version", "experiment", "digest", "seed", "commit", "dirty", "versions")
    for table, frame in tables.items():
        write_table(folder, table, frame, {key: provenance[key] for key in keys})
