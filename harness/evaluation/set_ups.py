"""Set-ups of one experiment side by side: what each finds, how well it measures, and what its camera gives it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.limits import Ladder, found_limit_mm, ladder_of
from harness.evaluation.noise import noise_against_frames
from harness.evaluation.summary import false_calls
from harness.tables.trials import ResultTables

if TYPE_CHECKING:
    import pandas as pd

MEASURES = ("extent", "model")


def set_ups_of(tables: ResultTables) -> list[str]:
    """The labels of the experiment's set-ups, variations left out, in their order."""
    return [str(name) for name in tables.variants["variant"][~tables.variants["is_variation"].astype(bool)]]


def compare_set_ups(
    tables: ResultTables, summary: pd.DataFrame, variants: list[str], *, half_sizes: bool = True
) -> pd.DataFrame:
    """One row per (variant, frames) that was finished, variants in the given order, with the axes' columns.

    ``holes``; ``found`` and ``undecided`` (lists of names); ``limit_mm`` and ``half_mm`` with ``half_low_mm``,
    ``half_high_mm`` (`harness.evaluation.limits`; without ``half_sizes`` left out, which saves a bootstrap); for each
    measure ``<measure>_bias_mm``, ``_std_mm``, ``_n`` of all single diameters of found holes against the truth, and
    ``<measure>_place_*`` likewise of the distances from the largest hole (none where several are the largest);
    ``threshold``, ``threshold_mm``, ``false_calls``, ``runs``; ``temporal_mm``, ``offset_mm``, ``pattern_mm`` of the
    averaged z on probe pixels; ``surface_mm``: robust deviation from the fitted surface on undamaged face; and means
    over hole-free runs of the columns of ``tables.noise``, where it has any.
    """
    import pandas as pd

    summary = summary[summary["variant"].isin(variants)]
    rows = [_row(tables, part, half_sizes) for _, part in summary.groupby(["variant", "frames"], sort=False)]
    table = pd.DataFrame(rows)
    if table.empty:
        return table
    table = table.merge(_noise(tables), "left", ["variant", "frames"]).merge(_calls(tables), "left", KEYS)
    if len(tables.noise):  # empty for maps, whose pixels are no camera's
        table = table.merge(_boards(tables), "left", KEYS)
    order = {variant: place for place, variant in enumerate(variants)}
    return table.sort_values(KEYS, key=lambda c: c.map(order) if c.name == "variant" else c, ignore_index=True)


KEYS = ["variant", "frames"]


def ladders(tables: ResultTables, variants: list[str]) -> dict[tuple[str, int], Ladder]:
    """The ladder of each (variant, frames)."""
    holes = tables.holes[tables.holes["variant"].isin(variants)]
    groups = holes.groupby(KEYS, sort=False)
    return {(str(part["variant"].iloc[0]), int(part["frames"].iloc[0])): ladder_of(part) for _, part in groups}


def _row(tables: ResultTables, part: pd.DataFrame, half_sizes: bool) -> dict[str, Any]:
    """What the holes of one set-up at one number of frames say; ``part``: their summary rows."""
    first = part.iloc[0]
    trials = tables.holes[(tables.holes["variant"] == first["variant"]) & (tables.holes["frames"] == first["frames"])]
    found = list(part["hole"][part["status"] == "found"])
    row: dict[str, Any] = {
        "variant": first["variant"],
        "frames": int(first["frames"]),
        **{path: first[path] for path in tables.axes["path"]},
        "holes": len(part),
        "repeats": int(part["n"].max()),
        "found": found,
        "undecided": list(part["hole"][part["status"] == "undecided"]),
        "limit_mm": found_limit_mm(part),
    }
    if half_sizes:
        row |= _half(ladder_of(trials))
    of_found = trials[trials["hole"].isin(found)]
    largest = int((part["true_diameter_mm"] == part["true_diameter_mm"].max()).sum())
    for measure in MEASURES:
        size = of_found[f"{measure}_diameter_mm"] - of_found["true_diameter_mm"]
        # the largest hole is where distances count from; of several as large, any may be the largest cluster
        away = of_found[(of_found["true_offset_mm"] > 0) & (largest == 1)]
        place = away[f"{measure}_offset_mm"] - away["true_offset_mm"]
        row |= _spread(f"{measure}", size) | _spread(f"{measure}_place", place)
    return row


def _half(ladder: Ladder) -> dict[str, float]:
    interval = ladder.half_interval
    return {"half_mm": ladder.half_mm, "half_low_mm": interval.low, "half_high_mm": interval.high}


def _spread(name: str, errors: pd.Series) -> dict[str, float]:
    known = errors.dropna()
    return {
        f"{name}_bias_mm": float(known.mean()) if len(known) else np.nan,
        f"{name}_std_mm": float(known.std()) if len(known) > 1 else np.nan,
        f"{name}_n": len(known),
    }


def _noise(tables: ResultTables) -> pd.DataFrame:
    noise = noise_against_frames(tables.probes)
    return noise[[*KEYS, "temporal_rms_mm", "offset_mm", "pattern_mm"]].rename(
        columns={"temporal_rms_mm": "temporal_mm"}
    )


def _calls(tables: ResultTables) -> pd.DataFrame:
    calls = false_calls(tables.runs)
    calls = calls[calls["role"] == "damaged"]
    calls = calls[[*KEYS, "runs", "false_calls", "threshold", "threshold_mm", "surface_noise_mm"]]
    return calls.rename(columns={"surface_noise_mm": "surface_mm"})


def _boards(tables: ResultTables) -> pd.DataFrame:
    left_out = {"repeat", *tables.axes["path"]}
    columns = [column for column in tables.noise.columns if column not in left_out]
    return tables.noise[columns].groupby(KEYS, as_index=False).mean()
