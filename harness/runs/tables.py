"""Converts records of trials into tables: one row per trial and damage, per trial, per probe
pixel, and per variant."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from itertools import islice
from pathlib import Path
from sys import intern
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from harness.experiment.schema import MAIN, Experiment, LabelledVariation, Point
from harness.experiment.unfold import FRAMES
from harness.records import trials
from harness.records.rows import ProbeRow
from harness.records.schema import Table, write_table
from harness.vocabulary.geometry import MM
from harness.vocabulary.path_names import names_of, unit_of

StoredRow = Mapping[str, Any]
"""A row as a trial's record holds it: one value for each column that the row has."""
Columns = dict[str, Any]
"""Values of several rows by column."""
Grids = dict[tuple[float, ...], np.ndarray]
"""Each grid of thresholds once, because many rows have the same."""
RECORDED: dict[str, Table] = {
    "holes": trials.TRIALS,
    "runs": trials.RUNS,
    "noise": trials.NOISE,
    "registrations": trials.REGISTRATIONS,
    **{table.name: table for table in trials.STUDY_ONLY},
}
"""Tables by the names of their rows in records (`harness.records.rows.TrialRecord`); probes are
separate, because they are combined over repeats."""
# records held as mappings before they become columns, which need a tenth of the memory
RECORDS_AT_ONCE = 100
UNKNOWN = np.iinfo(np.int32).min  # marks an unknown value among whole numbers
TENTH_UM = 1e-7  # metres
IDENTIFIES_RUN = (
    "results_version",
    "experiment",
    "digest",
    "seed",
    "commit",
    "dirty",
    "versions",
    "digests",
)
"""Keys of a run's provenance that each of its Parquet files repeats, where there are such."""


class _Probes(NamedTuple):
    """Errors of the sample pixels in one hole-free trial of one point; they sort by the first
    three."""

    variant: str
    """Name of the set-up."""
    frames: int
    """Number of averaged frames."""
    repeat: int
    """Number of the trial."""
    error_tenth_um: np.ndarray
    """Error (p,) of z of each pixel in tenths of a micrometre, or `UNKNOWN`."""


def tables_of(
    records: Iterable[Mapping[str, Sequence[StoredRow]]], experiment: Experiment
) -> trials.ResultTables:
    """Collect records into tables in a fixed order. Every axis but frames is a column, except in a
    study's tables."""
    parts: dict[str, list[Columns]] = {name: [] for name in RECORDED}
    grids: Grids = {}
    probes: list[_Probes] = []
    remaining = iter(records)
    while chunk := list(islice(remaining, RECORDS_AT_ONCE)):
        for record in chunk:
            probes += [_probes_of(row) for row in record.get("probes", ())]
        for name, collected in parts.items():
            rows = [row for record in chunk for row in record.get(name, ())]
            if rows:
                collected.append(columns_of(rows, grids))
    axes = _axes(experiment)
    variants = _variants(experiment)
    values_on_axes = variants.set_index("variant")[list(axes["path"])]

    def with_axes(table: pd.DataFrame) -> pd.DataFrame:
        """Add the values of a row's set-up on the axes."""
        if table.empty or axes.empty:
            return table
        return table.join(values_on_axes, on="variant")

    frames = {}
    for name, table in RECORDED.items():
        frame = _joined(parts.pop(name), table.order)
        frames[name] = frame if table in trials.STUDY_ONLY else with_axes(frame)
    return trials.ResultTables(
        **frames,
        probes=with_axes(_probe_table(probes)),
        variants=variants,
        axes=axes,
    )


def columns_of(rows: Sequence[StoredRow], grids: Grids) -> Columns:
    """Convert rows to columns: numbers and None to floats with NaN, equal lists of thresholds to
    one of ``grids``."""
    columns: Columns = {}
    for name, values in pd.DataFrame(rows).items():
        columns[str(name)] = _column(str(name), values, grids).array.copy()
    return columns


def _column(name: str, values: pd.Series, grids: Grids) -> pd.Series:
    """Return the values of a column in their type for tables."""
    if isinstance(values.iloc[0], list):
        if name == "threshold":
            arrays = [grids.setdefault(tuple(grid), np.array(grid)) for grid in values]
        elif name == "peaks":
            arrays = [np.array(scores, float) for scores in values]
        else:
            arrays = [np.array(counts, np.int32) for counts in values]
        return pd.Series(arrays, dtype=object)
    if values.dtype != object:
        return values
    if values.map(lambda value: isinstance(value, str)).any():
        # equal texts of all records share one object in memory
        return values.map(lambda value: intern(value) if isinstance(value, str) else value)
    return values.astype(float)


def _joined(parts: list[Columns], order: Sequence[str]) -> pd.DataFrame:
    """Join the parts of a table in the order of its rows, column by column, so that only one
    column at a time is held twice. Empties the parts."""
    if not parts:
        return pd.DataFrame()
    sizes = [len(next(iter(part.values()))) for part in parts]
    names = dict.fromkeys(name for part in parts for name in part)

    def joined(name: str) -> Any:
        """Return the values of a column of all parts; NaN for rows of parts that lack it."""
        frames = []
        for part, size in zip(parts, sizes, strict=True):
            present = {name: part.pop(name)} if name in part else {}
            frames.append(pd.DataFrame(present, range(size)))
        return pd.concat(frames)[name].array

    keys = {name: joined(name) for name in order if name in names}
    sorted_rows = pd.DataFrame(keys).sort_values(list(keys), kind="stable").index.to_numpy()
    table = {}
    for name in names:
        values = keys[name] if name in keys else joined(name)
        table[name] = values.take(sorted_rows)
    return pd.DataFrame(table, copy=False)


def _probes_of(row: StoredRow) -> _Probes:
    """Return a row of probes with its errors as an array."""
    errors = [UNKNOWN if value is None else value for value in row["error_tenth_um"]]
    return _Probes(
        variant=intern(row["variant"]),
        frames=row["frames"],
        repeat=row["repeat"],
        error_tenth_um=np.array(errors, np.int32),
    )


def _in_mm(error_tenth_um: np.ndarray) -> np.ndarray:
    return np.where(error_tenth_um == UNKNOWN, np.nan, error_tenth_um) * TENTH_UM / MM


def _probe_table(probes: list[_Probes]) -> pd.DataFrame:
    """Return each probe's mean error and temporal deviation over hole-free repeats, without
    repeats' displacements."""
    by_set_up: dict[tuple[str, int], list[np.ndarray]] = {}
    for row in sorted(probes, key=lambda row: row[:3]):
        by_set_up.setdefault((row.variant, row.frames), []).append(row.error_tenth_um)
    if not by_set_up:
        return pd.DataFrame(columns=[field.name for field in fields(ProbeRow)])
    tables = []
    for (variant, frames), repeats in by_set_up.items():
        tables.append(pd.DataFrame(_probe_columns(variant, frames, repeats)))
    return pd.concat(tables, ignore_index=True)


def _probe_columns(variant: str, frames: int, repeats: Sequence[np.ndarray]) -> Columns:
    """Return the columns of `ProbeRow` of one set-up, from the errors of its repeats. Errors
    become millimetres repeat by repeat: all at once would take four times the memory of the
    rows."""
    medians_mm = np.array([_median_mm(errors) for errors in repeats])
    is_known = np.isfinite(medians_mm)
    middle_mm = np.median(medians_mm[is_known]) if is_known.any() else 0.0
    displacement_mm = np.where(is_known, medians_mm - middle_mm, 0.0)
    count = len(repeats)
    mean_mm = np.zeros(len(repeats[0]))
    for errors, displaced_mm in zip(repeats, displacement_mm, strict=True):
        mean_mm = mean_mm + (_in_mm(errors) - displaced_mm)
    mean_mm = mean_mm / count
    temporal_mm: Any = np.nan
    displacement_std_mm = np.nan
    if count > 1:
        squares_mm2 = np.zeros(len(mean_mm))
        for errors, displaced_mm in zip(repeats, displacement_mm, strict=True):
            squares_mm2 = squares_mm2 + (_in_mm(errors) - displaced_mm - mean_mm) ** 2
        temporal_mm = np.sqrt(squares_mm2 / (count - 1))
        displacement_std_mm = displacement_mm.std(ddof=1)
    return {
        "variant": variant,
        "frames": frames,
        "pixel": np.arange(len(mean_mm)),
        "mean_error_mm": mean_mm,
        "temporal_std_mm": temporal_mm,
        "displacement_std_mm": displacement_std_mm,
        "repeats": count,
    }


def _median_mm(error_tenth_um: np.ndarray) -> float:
    """Return the median error in millimetres; NaN if none is known."""
    error_mm = _in_mm(error_tenth_um)
    return float(np.nanmedian(error_mm)) if np.isfinite(error_mm).any() else float("nan")


def _axes(experiment: Experiment) -> pd.DataFrame:
    """Return path, name and unit of every axis but the number of frames."""
    paths = list(experiment.points[0].axes)
    names = names_of(paths)
    rows = [{"path": path, "name": names[path], "unit": unit_of(path)} for path in paths]
    return pd.DataFrame(rows, columns=["path", "name", "unit"])


def _variants(experiment: Experiment) -> pd.DataFrame:
    """Return the changes of each set-up and variation, their reasons, and their values on the
    axes."""
    paths = list(experiment.points[0].axes)
    rows: dict[str, dict[str, Any]] = {}
    for point in experiment.points:
        rows.setdefault(point.variant, _variant_row(experiment, point))
    columns = ["variant", "reason", "settings", "is_variation", "reference", "switches", *paths]
    table = pd.DataFrame(list(rows.values()), columns=columns)
    for path in paths:
        table[path] = _axis_values(table[path])
    return table


def _variant_row(experiment: Experiment, point: Point) -> dict[str, Any]:
    """Return the row of a point's set-up or variation."""
    values = {path: value for path, value in point.values.items() if path != FRAMES}
    switches = values.get(experiment.config.switches or "")
    return {
        "variant": point.variant,
        "reason": _reason(experiment, point),
        "settings": "" if point.variant == MAIN else json.dumps(values, sort_keys=True),
        "is_variation": point.is_variation,
        "reference": point.reference,
        "switches": json.dumps(switches) if switches and not point.is_variation else "",
        **point.axes,
    }


def _axis_values(values: pd.Series) -> pd.Series:
    """Return the values on an axis as numbers or, if any is none, as text: a column of Parquet has
    one type."""
    is_number = values.map(
        lambda value: isinstance(value, int | float) and not isinstance(value, bool)
    )
    if is_number.all():
        return values.astype(float)
    return values.map(
        lambda value: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
    )


def _reason(experiment: Experiment, point: Point) -> str:
    """Return the reason that the experiment's file gives for a variation; empty for set-ups."""
    sensitivity = experiment.config.sensitivity
    if sensitivity is None or not point.is_variation:
        return ""
    changed = set(point.values) - {FRAMES}
    for variation in sensitivity.vary:
        if isinstance(variation, LabelledVariation):
            is_declared = variation.label == point.variant
        else:
            varies_path = changed == {variation.path}
            is_declared = varies_path and point.variant.startswith(f"{variation.path}=")
        if is_declared:
            return variation.reason
    return ""


def write_tables(
    folder: Path, tables: Mapping[Table, pd.DataFrame], provenance: Mapping[str, Any]
) -> None:
    """Write tables; the schema of every Parquet file identifies the run."""
    about = {key: provenance[key] for key in IDENTIFIES_RUN if key in provenance}
    for table, frame in tables.items():
        write_table(folder, table, frame, about)
