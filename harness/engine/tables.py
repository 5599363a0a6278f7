"""Records of trials as tables: one row per trial and hole, one per trial, one per probe pixel, one per variant."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from harness.experiment.points import MAIN, Experiment, Point
from harness.experiment.schema import LabelledVariation
from harness.vocabulary.units import MM

HOLE_ORDER = ["variant", "frames", "repeat", "true_diameter_mm", "hole"]
RUN_ORDER = ["variant", "role", "frames", "repeat"]


@dataclass(frozen=True)
class Tables:
    """All results of an experiment as pandas frames; the columns are those of `harness.engine.trial`'s rows.

    ``holes``: one row per variant, frames, repeat and hole. ``runs``: per variant, frames, repeat and role.
    ``probes``: per variant, frames and probe pixel, over repeats. ``variants``: label, reason, settings.
    """

    holes: pd.DataFrame
    runs: pd.DataFrame
    probes: pd.DataFrame
    variants: pd.DataFrame


def tables_of(records: Iterable[Mapping[str, Any]], experiment: Experiment) -> Tables:
    """Collect records, in any order, into tables in a fixed order."""
    rows: dict[str, list[dict[str, Any]]] = {"holes": [], "runs": [], "probes": []}
    for record in records:
        for name, collected in rows.items():
            collected.extend(record[name])
    holes, runs = pd.DataFrame(rows["holes"]), pd.DataFrame(rows["runs"])
    if not holes.empty:
        holes = holes.sort_values(HOLE_ORDER, kind="stable", ignore_index=True)
    if not runs.empty:
        runs = runs.sort_values(RUN_ORDER, kind="stable", ignore_index=True)
    return Tables(_numbers(holes), _numbers(runs), _probes(rows["probes"]), _variants(experiment))


def _numbers(table: pd.DataFrame) -> pd.DataFrame:
    """Columns that JSON filled with None hold numbers with NaN."""
    for column in table.columns:
        if table[column].dtype == object and not table[column].map(lambda v: isinstance(v, str)).any():
            table[column] = table[column].astype(float)
    return table


def _probes(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """Mean error and temporal deviation of each probe over the hole-free repeats."""
    grouped: dict[tuple[str, int], list[list[Any]]] = {}
    for row in sorted(rows, key=lambda r: (r["variant"], r["frames"], r["repeat"])):
        grouped.setdefault((row["variant"], row["frames"]), []).append(row["error_tenth_um"])
    tables = []
    for (variant, frames), errors in grouped.items():
        mm = np.array(errors, dtype=float) * 1e-7 / MM
        with np.errstate(invalid="ignore"):
            std = mm.std(axis=0, ddof=1) if len(mm) > 1 else np.full(mm.shape[1], np.nan)
        tables.append(
            pd.DataFrame(
                {
                    "variant": variant,
                    "frames": frames,
                    "pixel": np.arange(mm.shape[1]),
                    "mean_error_mm": mm.mean(axis=0),
                    "temporal_std_mm": std,
                    "repeats": len(mm),
                }
            )
        )
    columns = ["variant", "frames", "pixel", "mean_error_mm", "temporal_std_mm", "repeats"]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=columns)


def _variants(experiment: Experiment) -> pd.DataFrame:
    """What each variant changes, and why it is plausible."""
    seen: dict[str, dict[str, str]] = {}
    for point in experiment.points:
        values = {k: v for k, v in point.values.items() if k != "capture.frames"}
        settings = "" if point.variant == MAIN else json.dumps(values, sort_keys=True)
        row = {"variant": point.variant, "reason": _reason(experiment, point), "settings": settings}
        seen.setdefault(point.variant, row)
    return pd.DataFrame(list(seen.values()), columns=["variant", "reason", "settings"])


def _reason(experiment: Experiment, point: Point) -> str:
    """The reason that the experiment's file gives for a variation; empty for the main points."""
    study = experiment.config.sensitivity
    if study is None or point.variant == MAIN:
        return ""
    changed = set(point.values) - {"capture.frames"}
    for variation in study.vary:
        if isinstance(variation, LabelledVariation):
            named = variation.label == point.variant
        else:
            named = changed == {variation.path} and point.variant.startswith(f"{variation.path}=")
        if named:
            return variation.reason
    return ""
