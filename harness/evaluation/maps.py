"""Set-ups that make a map of several views: how many, how they are registered, how they are merged."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.set_ups import compare_set_ups
from harness.tables.trials import ResultTables
from harness.vocabulary.path_names import value_text

if TYPE_CHECKING:
    import pandas as pd

VIEWS, REGISTRATION, MERGE = "mapping.views", "mapping.registration.method", "mapping.merge.kind"
"""The axes that this room knows by name."""


@dataclass(frozen=True)
class MapSetUp:
    """One set-up or variation. ``views`` is 0 where the axis says "all" and no run was finished; ``registration`` and
    ``merge`` are empty where no axis tells; ``place``: the other axes' values as text; ``reference``: of a variation
    the set-up to compare it with, or empty."""

    variant: str
    views: int
    registration: str
    merge: str
    place: str
    is_variation: bool
    reference: str


def maps_of(tables: ResultTables) -> list[MapSetUp]:
    """All set-ups and variations in the table's order. Where the axis says "all views" the runs tell their number."""
    paths = [str(path) for path in tables.axes["path"]]
    others = [path for path in paths if path not in (VIEWS, REGISTRATION, MERGE)]
    seen = _views_seen(tables.runs)
    return [
        MapSetUp(
            variant=str(row["variant"]),
            views=_views(row.get(VIEWS), seen.get(str(row["variant"]), 0)),
            registration=_word(row.get(REGISTRATION)),
            merge=_word(row.get(MERGE)),
            place=", ".join(value_text(path, row[path]) for path in others),
            is_variation=bool(row["is_variation"]),
            reference=str(row["reference"]),
        )
        for _, row in tables.variants.iterrows()
    ]


def compare_maps(tables: ResultTables, summary: pd.DataFrame) -> pd.DataFrame:
    """Rows of `compare_set_ups` for all set-ups and variations that have a map, with the fields of `MapSetUp`, and over
    the runs on the damaged board: ``views_left_out`` (mean of a run), ``seconds_map`` (median), ``surface_std_mm`` (of
    the surface noise over runs)."""
    import pandas as pd

    maps = pd.DataFrame([asdict(one) for one in maps_of(tables)])
    compared = compare_set_ups(tables, summary, [str(name) for name in maps["variant"]], half_sizes=False)
    if compared.empty:
        return compared
    runs = tables.runs[tables.runs["role"] == "damaged"].groupby(["variant", "frames"], as_index=False)
    means = runs.agg(
        views_left_out=("views_left_out", "mean"),
        seconds_map=("seconds_map", "median"),
        surface_std_mm=("surface_noise_mm", "std"),
    )
    return compared.merge(maps, "left", "variant").merge(means, "left", ["variant", "frames"])


def label_of(registration: str, merge: str, place: str = "") -> str:
    """A way to make a map in words: ``cpd, grid``."""
    return ", ".join(part for part in (registration, merge, place) if part) or "as declared"


def _views_seen(runs: pd.DataFrame) -> dict[str, int]:
    if runs.empty or "views_used" not in runs:
        return {}
    there = (runs["views_used"] + runs["views_left_out"]).groupby(runs["variant"]).max()
    return {str(variant): int(count) for variant, count in there.items() if np.isfinite(count)}


def _views(value: Any, seen: int) -> int:
    try:
        number = float(value)
    except (TypeError, ValueError):
        return seen
    return int(number) if np.isfinite(number) else seen


def _word(value: Any) -> str:
    return value if isinstance(value, str) and value != "null" else ""
