"""Records of trials as tables: one row per trial and hole, one per trial, one per probe pixel, one per variant."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from harness.engine.walls import wall_rows
from harness.experiment.points import MAIN, Experiment, Point
from harness.experiment.schema import LabelledVariation
from harness.experiment.unfold import FRAMES
from harness.vocabulary.path_names import names_of, unit_of
from harness.vocabulary.units import MM

STUDY_ORDERS = {
    "sites": ["variant", "frames", "board", "repeat", "true_diameter_mm", "hole"],
    "findings": ["variant", "frames", "role", "board", "repeat"],
    "operating": ["variant", "frames", "role", "board", "repeat"],
    "pixels": ["variant", "frames", "board", "repeat"],
}
ORDERS = {
    "holes": ["variant", "frames", "board", "repeat", "true_diameter_mm", "hole"],
    "runs": ["variant", "role", "frames", "board", "repeat"],
    "noise": ["variant", "frames", "repeat"],
    "registrations": ["variant", "role", "frames", "repeat", "view"],
}

ROWS_AT_ONCE = 2000
"""Rows that are kept as mappings, some 3 MB."""
UNKNOWN = np.iinfo(np.int32).min
"""Stands among whole numbers for a value that is not known."""
PIXELS_AT_ONCE = 64


@dataclass(frozen=True)
class Tables:
    """All results of an experiment as pandas frames; the columns are those of `harness.engine.trial`'s rows.

    ``holes``: one row per variant, frames, repeat and hole. ``runs``: per variant, frames, repeat and role.
    ``probes``: per variant, frames and probe pixel, over repeats. ``noise``: per variant, frames and hole-free repeat
    (columns of `harness.engine.trial`). ``registrations``: per registration that was made, under the first
    variant that shares it (columns of `harness.engine.maps`); empty where there are no maps. All five carry a column
    per axis other than the number of frames, named by its path, where there are any. ``variants``: one row per set-up,
    then per variation: variant, reason, settings, is_variation, reference (the set-up to compare with, or empty),
    switches (JSON, or empty), and the axes. ``axes``: path, name, unit of each of those axes, in their order.
    ``walls``: what of each hole's wall is shadowed, by number of views (`harness.evaluation.walls`); empty likewise.
    Of a study all have a column ``board``, probes and noise are empty, and ``sites``, ``findings``, ``operating``,
    ``pixels`` are those of `harness.evaluation.study.tables.StudyTables`; of any other experiment these are empty.
    """

    holes: pd.DataFrame
    runs: pd.DataFrame
    probes: pd.DataFrame
    variants: pd.DataFrame
    noise: pd.DataFrame
    axes: pd.DataFrame
    registrations: pd.DataFrame = field(default_factory=pd.DataFrame)
    walls: pd.DataFrame = field(default_factory=pd.DataFrame)
    sites: pd.DataFrame = field(default_factory=pd.DataFrame)
    findings: pd.DataFrame = field(default_factory=pd.DataFrame)
    operating: pd.DataFrame = field(default_factory=pd.DataFrame)
    pixels: pd.DataFrame = field(default_factory=pd.DataFrame)


def tables_of(records: Iterable[Mapping[str, Any]], experiment: Experiment) -> Tables:
    """Collect records into tables in a fixed order; equal for equal records in equal order."""
    collected = {name: _Rows() for name in (*ORDERS, *STUDY_ORDERS)}
    probes: list[dict[str, Any]] = []
    for record in records:
        for row in record.get("probes", ()):
            errors = np.array([UNKNOWN if value is None else value for value in row["error_tenth_um"]], np.int32)
            probes.append({**row, "error_tenth_um": errors})
        for name, rows in collected.items():
            rows.add(record.get(name, ()))
    axes, variants = _axes(experiment), _variants(experiment)
    placed = variants.set_index("variant")[list(axes["path"])]

    def with_axes(table: pd.DataFrame) -> pd.DataFrame:
        return table if table.empty or axes.empty else table.join(placed, on="variant")

    ordered = {name: with_axes(_ordered(collected[name].table(), order)) for name, order in ORDERS.items()}
    of_study = {name: _ordered(collected[name].table(), order) for name, order in STUDY_ORDERS.items()}
    walls = wall_rows(experiment) if experiment.config.study is None else pd.DataFrame()
    return Tables(**ordered, **of_study, probes=with_axes(_probes(probes)), variants=variants, axes=axes, walls=walls)


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


def _ordered(table: pd.DataFrame, order: list[str]) -> pd.DataFrame:
    order = [name for name in order if name in table]
    return _numbers(table if table.empty else table.sort_values(order, kind="stable", ignore_index=True))


def _axes(experiment: Experiment) -> pd.DataFrame:
    """The axes that tell set-ups apart; switches first, then in the file's order."""
    paths = list(experiment.points[0].axes)
    names = names_of(paths)
    rows = [{"path": path, "name": names[path], "unit": unit_of(path)} for path in paths]
    return pd.DataFrame(rows, columns=["path", "name", "unit"])


def _numbers(table: pd.DataFrame) -> pd.DataFrame:
    """Columns that JSON filled with None hold numbers with NaN."""
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
    columns = ["variant", "frames", "pixel", "mean_error_mm", "temporal_std_mm", "displacement_std_mm", "repeats"]
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
