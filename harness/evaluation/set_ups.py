"""Compares the set-ups of one experiment: each one's smallest hole, measures and camera, and the
cost of each effect. The smallest hole that a set-up finds is given as a step on its ladder of
sizes, and as the size found in half of the trials: a point on a monotone curve through the rates,
not a probability of detection in the sense of the handbooks."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import isotonic_regression

from harness.evaluation.intervals import percentiles
from harness.evaluation.summary import false_calls, noise_against_frames
from harness.records.trials import EFFECTS, ResultTables

MEASURES = ("extent", "model")
KEYS = ["variant", "frames"]
# the 2.5 % quantile is then the 25th smallest, stable to about 5 % of the interval's width
RESAMPLES = 1000
HALF = 0.5
LIMIT_RULE = (
    "The detection limit is the smallest true diameter for which every hole as large or larger counts as found. "
    "The 50 % size is where the detection rate, made monotone in the diameter by isotonic regression and interpolated "
    "linearly between sizes, reaches one half; its 95 % interval is a bootstrap over the holes of each size (where "
    "there are several) and over the repeats."
)


@dataclass(frozen=True)
class Ladder:
    """Detections of one set-up. ``diameters_mm`` (h,): of the holes, ascending. ``detected``:
    (repeats, h) bool."""

    diameters_mm: np.ndarray
    detected: np.ndarray

    @cached_property
    def half_mm(self) -> float:
        """The 50 % size; the least size if it is found more often than not, infinity if no size
        is."""
        repeats, holes = self.detected.shape
        return float(self._half_sizes(np.ones((1, repeats)), np.ones((1, holes)))[0])

    @property
    def at_the_end(self) -> bool:
        """Return whether the 50 % size lies off the ladder, so that only a bound is known."""
        return not self.diameters_mm[0] < self.half_mm < np.inf

    @cached_property
    def half_draws_mm(self) -> np.ndarray:
        """The 50 % sizes (`RESAMPLES`,) of the two-way bootstrap, drawn alike for equal holes and
        repeats."""
        rng = np.random.default_rng(0)
        repeats, holes = self.detected.shape
        of_repeats = rng.multinomial(repeats, np.full(repeats, 1 / repeats), RESAMPLES)
        of_holes = np.empty((RESAMPLES, holes))
        for size in np.unique(self.diameters_mm):
            alike = self.diameters_mm == size
            of_holes[:, alike] = rng.multinomial(
                alike.sum(), np.full(alike.sum(), 1 / alike.sum()), RESAMPLES
            )
        return self._half_sizes(of_repeats, of_holes)

    def _half_sizes(self, of_repeats: np.ndarray, of_holes: np.ndarray) -> np.ndarray:
        """Return 50 % sizes (n,), with repeats (n, repeats) and holes (n, h) weighted by how often
        they were drawn."""
        by_hole = of_repeats @ self.detected / of_repeats.sum(axis=1, keepdims=True) * of_holes
        sizes, starts = np.unique(self.diameters_mm, return_index=True)
        hits = np.add.reduceat(by_hole, starts, axis=1)
        drawn = np.add.reduceat(of_holes, starts, axis=1)
        return half_size(sizes, hits / drawn)


def ladder_of(holes: pd.DataFrame) -> Ladder:
    """Return the ladder of the rows of one set-up and one number of frames in the table of holes."""
    table = holes.pivot(index="repeat", columns="hole", values="detected").astype(bool)
    sizes = holes.groupby("hole")["true_diameter_mm"].first()
    order = sorted(table.columns, key=lambda hole: (sizes[hole], str(hole)))
    return Ladder(sizes[order].to_numpy(float), table[order].to_numpy(bool))


def found_limit_mm(summary: pd.DataFrame) -> float:
    """Return the limit by `LIMIT_RULE` from rows of one set-up and frames; NaN if it misses the
    largest hole."""
    # NaN if there is none
    missed = summary["true_diameter_mm"][summary["status"] != "found"].max()
    return float(summary["true_diameter_mm"][~(summary["true_diameter_mm"] <= missed)].min())


def half_size(sizes_mm: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return the sizes (n,) in mm at which monotone rates (n, s) first reach one half,
    interpolated linearly; the least size if its rate does already, infinity if none does."""
    monotone = np.array([isotonic_regression(row).x for row in np.asarray(rates, float)])
    reached = monotone >= HALF - 1e-12
    last = np.argmax(reached, axis=1)
    before = np.maximum(last - 1, 0)
    rows = np.arange(len(monotone))
    low = monotone[rows, before]
    high = monotone[rows, last]
    share = np.where(last > 0, (HALF - low) / np.where(high > low, high - low, 1.0), 0.0)
    found = sizes_mm[before] + share * (sizes_mm[last] - sizes_mm[before])
    return np.where(reached.any(axis=1), found, np.inf)


def set_ups_of(tables: ResultTables) -> list[str]:
    """Return the labels of the experiment's set-ups in their order, without variations."""
    return [
        str(name)
        for name in tables.variants["variant"][~tables.variants["is_variation"].astype(bool)]
    ]


def compare_set_ups(
    tables: ResultTables, summary: pd.DataFrame, variants: list[str], *, half_sizes: bool = True
) -> pd.DataFrame:
    """Return one row per finished (variant, frames), variants in the given order, with the axes'
    columns. ``half_*``: only for set-ups, and with ``half_sizes``, as they need a bootstrap.
    ``<measure>_*``: for each measure, of all single diameters of found holes against the truth.
    ``<measure>_place_*``: of distances from the largest hole (none if several are largest). Also:
    noise of averaged z on probes, means over hole-free runs of ``tables.noise``."""
    summary = summary[summary["variant"].isin(variants)]
    halved = set_ups_of(tables) if half_sizes else []
    groups = summary.groupby(KEYS, sort=False)
    table = pd.DataFrame([_row(tables, part, variant in halved) for (variant, _), part in groups])
    if table.empty:
        return table
    noise = noise_against_frames(tables.probes)[
        [*KEYS, "temporal_rms_mm", "offset_mm", "pattern_mm"]
    ]
    calls = false_calls(tables.runs)
    calls = calls[calls["role"] == "damaged"]
    calls = calls[[*KEYS, "runs", "false_calls", "threshold", "threshold_mm", "surface_noise_mm"]]
    for part in (noise, calls):
        table = table.merge(part, "left", KEYS)
    table = table.rename(
        columns={"temporal_rms_mm": "temporal_mm", "surface_noise_mm": "surface_mm"}
    )
    if len(tables.noise):  # empty for maps: their pixels are not those of a camera
        columns = [
            name for name in tables.noise.columns if name not in ("repeat", *tables.axes["path"])
        ]
        table = table.merge(
            tables.noise[columns].groupby(KEYS, as_index=False).mean(), "left", KEYS
        )
    order = {variant: place for place, variant in enumerate(variants)}
    return table.sort_values(
        KEYS, key=lambda c: c.map(order) if c.name == "variant" else c, ignore_index=True
    )


def _row(tables: ResultTables, part: pd.DataFrame, half_sizes: bool) -> dict[str, Any]:
    """Return a summary of the holes of one set-up at one number of frames, from its summary rows
    ``part``."""
    first = part.iloc[0]
    trials = tables.holes[
        (tables.holes["variant"] == first["variant"]) & (tables.holes["frames"] == first["frames"])
    ]
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
        ladder = ladder_of(trials)
        interval = percentiles(ladder.half_draws_mm)
        row |= {
            "half_mm": ladder.half_mm,
            "half_low_mm": interval.low,
            "half_high_mm": interval.high,
        }
    of_found = trials[trials["hole"].isin(found)]
    largest = int((part["true_diameter_mm"] == part["true_diameter_mm"].max()).sum())
    # Distances count from the largest hole; if several are largest, any may be the largest
    # cluster.
    away = of_found[(of_found["true_offset_mm"] > 0) & (largest == 1)]
    for measure in MEASURES:
        size = of_found[f"{measure}_diameter_mm"] - of_found["true_diameter_mm"]
        place = away[f"{measure}_offset_mm"] - away["true_offset_mm"]
        for name, errors in ((measure, size.dropna()), (f"{measure}_place", place.dropna())):
            row[f"{name}_bias_mm"] = float(errors.mean()) if len(errors) else np.nan
            row[f"{name}_std_mm"] = float(errors.std()) if len(errors) > 1 else np.nan
            row[f"{name}_n"] = len(errors)
    return row


def effect_costs(tables: ResultTables) -> pd.DataFrame:
    """Return the table of effects: the cost of each effect alone (nothing else on) and last (all
    others on), and of all together, for each place on the experiment's other axes and number of
    frames. Costs are paired changes of the 50 % size; those of set-ups that were not finished with
    the same repeats are left out."""
    set_ups = tables.variants[tables.variants["switches"] != ""]
    if set_ups.empty:
        return EFFECTS.frame([])
    names = dict(zip(tables.axes["path"], tables.axes["name"], strict=True))
    axes = list(tables.axes["path"])[1:]
    nothing = frozenset[str]()
    found = list[dict[str, Any]]()
    for values, part in (
        set_ups.groupby(axes, sort=False, dropna=False) if axes else [((), set_ups)]
    ):
        place = ", ".join(
            f"{names[path]}={value}" for path, value in zip(axes, values, strict=True)
        )
        switches = {str(row["variant"]): json.loads(row["switches"]) for _, row in part.iterrows()}
        by_switches = {
            frozenset(name for name, is_on in row.items() if is_on): name
            for name, row in switches.items()
        }
        everything = max(by_switches, key=len)
        effects = [
            (name.replace("_", " "), frozenset([name]))
            for name in switches[by_switches[everything]]
        ]
        wanted = [(effect, "nothing", nothing, alone) for effect, alone in effects]
        wanted += [
            (effect, "all others", everything - alone, everything) for effect, alone in effects
        ]
        wanted.append(("all", "nothing", nothing, everything))
        for frames, rows in tables.holes[
            tables.holes["variant"].isin(by_switches.values())
        ].groupby("frames"):
            by_variant = {str(name): ladder_of(part) for name, part in rows.groupby("variant")}
            ladders = {
                on: by_variant[variant]
                for on, variant in by_switches.items()
                if variant in by_variant
            }
            for effect, against, off, on in wanted:
                if cost := _cost(ladders, off, on):
                    found.append(
                        {
                            "place": place,
                            "frames": frames,
                            "effect": effect,
                            "against": against,
                            **cost,
                        }
                    )
    return EFFECTS.frame(found)


def _cost(
    ladders: Mapping[frozenset[str], Ladder], off: frozenset[str], on: frozenset[str]
) -> dict[str, Any]:
    """Return the paired difference of two set-ups with its interval, and whether both sizes lie on
    the ladder (else it is only a bound); empty if either was not finished, or not with the same
    repeats."""
    if (
        off not in ladders
        or on not in ladders
        or ladders[off].detected.shape != ladders[on].detected.shape
    ):
        return {}
    before = ladders[off]
    after = ladders[on]
    with np.errstate(
        invalid="ignore"
    ):  # both off the ladder: a difference of infinities is unknown
        ends = percentiles(after.half_draws_mm - before.half_draws_mm)
        mm = float(np.subtract(after.half_mm, before.half_mm))
    on_ladder = not (before.at_the_end or after.at_the_end)
    return {
        "loss_mm": mm,
        "loss_low_mm": ends.low,
        "loss_high_mm": ends.high,
        "on_ladder": on_ladder,
    }
