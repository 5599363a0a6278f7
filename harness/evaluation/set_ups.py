"""Compares the set-ups of one experiment: each one's smallest hole, measures and camera, and the
cost of each effect. The smallest hole that a set-up finds is given as a step on its ladder of
sizes, and as the size found in half of the trials: a point on a monotone curve through the rates,
not a probability of detection in the sense of the handbooks."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

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
    "The detection limit is the smallest true diameter for which every hole as large or larger "
    "counts as found. The 50 % size is where the detection rate, made monotone in the diameter by "
    "isotonic regression and interpolated linearly between sizes, reaches one half; its 95 % "
    "interval is a bootstrap over the holes of each size (where there are several) and over the "
    "repeats."
)


@dataclass(frozen=True)
class Ladder:
    """Detections of one set-up."""

    diameters_mm: np.ndarray
    """True diameters (h,) of the holes, ascending."""
    detected: np.ndarray
    """Detections (repeats, h) bool."""

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
            of_size = self.diameters_mm == size
            count = of_size.sum()
            of_holes[:, of_size] = rng.multinomial(count, np.full(count, 1 / count), RESAMPLES)
        return self._half_sizes(of_repeats, of_holes)

    def _half_sizes(self, of_repeats: np.ndarray, of_holes: np.ndarray) -> np.ndarray:
        """Return 50 % sizes (n,), with repeats (n, repeats) and holes (n, h) weighted by how often
        they were drawn."""
        rates = of_repeats @ self.detected / of_repeats.sum(axis=1, keepdims=True)
        by_hole = rates * of_holes
        sizes, starts = np.unique(self.diameters_mm, return_index=True)
        hits = np.add.reduceat(by_hole, starts, axis=1)
        drawn = np.add.reduceat(of_holes, starts, axis=1)
        return half_size(sizes, hits / drawn)


def ladder_of(holes: pd.DataFrame) -> Ladder:
    """Return the ladder of the rows of one set-up and number of frames in the table of holes."""
    table = holes.pivot(index="repeat", columns="hole", values="detected").astype(bool)
    sizes = holes.groupby("hole")["true_diameter_mm"].first()
    order = sorted(table.columns, key=lambda hole: (sizes[hole], str(hole)))
    return Ladder(sizes[order].to_numpy(float), table[order].to_numpy(bool))


def found_limit_mm(summary: pd.DataFrame) -> float:
    """Return the limit by `LIMIT_RULE` from rows of one set-up and frames; NaN if it misses the
    largest hole."""
    diameters_mm = summary["true_diameter_mm"]
    # NaN if there is none
    largest_missed = diameters_mm[summary["status"] != "found"].max()
    return float(diameters_mm[~(diameters_mm <= largest_missed)].min())


def half_size(sizes_mm: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return the sizes (n,) in mm at which monotone rates (n, s) first reach one half,
    interpolated linearly; the least size if its rate does already, infinity if none does."""
    monotone = np.array([isotonic_regression(row).x for row in np.asarray(rates, float)])
    reached = monotone >= HALF - 1e-12
    first = np.argmax(reached, axis=1)
    before = np.maximum(first - 1, 0)
    rows = np.arange(len(monotone))
    low = monotone[rows, before]
    high = monotone[rows, first]
    rise = np.where(high > low, high - low, 1.0)
    share = np.where(first > 0, (HALF - low) / rise, 0.0)
    half_mm = sizes_mm[before] + share * (sizes_mm[first] - sizes_mm[before])
    return np.where(reached.any(axis=1), half_mm, np.inf)


def set_ups_of(tables: ResultTables) -> list[str]:
    """Return the labels of the experiment's set-ups in their order, without variations."""
    is_variation = tables.variants["is_variation"].astype(bool)
    return [str(name) for name in tables.variants["variant"][~is_variation]]


def compare_set_ups(
    tables: ResultTables,
    summary: pd.DataFrame,
    variants: list[str],
    *,
    half_sizes: bool = True,
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
    noise = noise_against_frames(tables.probes)
    noise = noise[[*KEYS, "temporal_rms_mm", "offset_mm", "pattern_mm"]]
    calls = false_calls(tables.runs)
    calls = calls[calls["role"] == "damaged"]
    calls = calls[[*KEYS, "runs", "false_calls", "threshold", "threshold_mm", "surface_noise_mm"]]
    table = table.merge(noise, "left", KEYS).merge(calls, "left", KEYS)
    shorter = {"temporal_rms_mm": "temporal_mm", "surface_noise_mm": "surface_mm"}
    table = table.rename(columns=shorter)
    if len(tables.noise):  # empty for maps: their pixels are not those of a camera
        left_out = ("repeat", *tables.axes["path"])
        columns = [name for name in tables.noise.columns if name not in left_out]
        means = tables.noise[columns].groupby(KEYS, as_index=False).mean()
        table = table.merge(means, "left", KEYS)
    order = {variant: position for position, variant in enumerate(variants)}
    return table.sort_values(
        KEYS,
        key=lambda column: column.map(order) if column.name == "variant" else column,
        ignore_index=True,
    )


def _row(
    tables: ResultTables,
    part: pd.DataFrame,
    half_sizes: bool,
) -> dict[str, Any]:
    """Return a summary of the holes of one set-up at one number of frames, from its summary rows
    ``part``."""
    first = part.iloc[0]
    holes = tables.holes
    trials = holes[(holes["variant"] == first["variant"]) & (holes["frames"] == first["frames"])]
    found_holes = list(part["hole"][part["status"] == "found"])
    row: dict[str, Any] = {
        "variant": first["variant"],
        "frames": int(first["frames"]),
        **{path: first[path] for path in tables.axes["path"]},
        "holes": len(part),
        "repeats": int(part["n"].max()),
        "found": found_holes,
        "undecided": list(part["hole"][part["status"] == "undecided"]),
        "limit_mm": found_limit_mm(part),
    }
    if half_sizes:
        ladder = ladder_of(trials)
        interval = percentiles(ladder.half_draws_mm)
        row["half_mm"] = ladder.half_mm
        row["half_low_mm"] = interval.low
        row["half_high_mm"] = interval.high
    of_found = trials[trials["hole"].isin(found_holes)]
    largest = int((part["true_diameter_mm"] == part["true_diameter_mm"].max()).sum())
    # Distances count from the largest hole; if several are largest, any may be the largest
    # cluster.
    away = of_found[(of_found["true_offset_mm"] > 0) & (largest == 1)]
    for measure in MEASURES:
        size = of_found[f"{measure}_diameter_mm"] - of_found["true_diameter_mm"]
        row.update(_errors(measure, size.dropna()))
        offset = away[f"{measure}_offset_mm"] - away["true_offset_mm"]
        row.update(_errors(f"{measure}_place", offset.dropna()))
    return row


def _errors(name: str, errors: pd.Series) -> dict[str, float]:
    """Return the columns ``<name>_*`` of errors in mm; NaN where there are too few."""
    return {
        f"{name}_bias_mm": float(errors.mean()),
        f"{name}_std_mm": float(errors.std()),
        f"{name}_n": len(errors),
    }


class _Cost(NamedTuple):
    """A cost that is wanted: of turning on one effect, or all."""

    effect: str
    """Words for the effect, or ``all``."""
    against: str
    """Words for what else is on: ``nothing`` or ``all others``."""
    effects_before: frozenset[str]
    """Effects of the set-up without it."""
    effects_after: frozenset[str]
    """Effects of the set-up with it."""


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
    groups: Iterable[tuple[Any, pd.DataFrame]] = [((), set_ups)]
    if axes:
        groups = set_ups.groupby(axes, sort=False, dropna=False)
    rows = list[dict[str, Any]]()
    for values, part in groups:
        named_values = zip(axes, values, strict=True)
        conditions = ", ".join(f"{names[path]}={value}" for path, value in named_values)
        variant_of = {}
        for _, row in part.iterrows():
            variant_of[_switched_on(str(row["switches"]))] = str(row["variant"])
        most_on = max(variant_of, key=len)
        order = _effects_in_order(part, variant_of[most_on])
        holes = tables.holes[tables.holes["variant"].isin(variant_of.values())]
        for frames, of_frames in holes.groupby("frames"):
            by_variant = {
                str(variant): ladder_of(trials) for variant, trials in of_frames.groupby("variant")
            }
            ladders = {
                effects: by_variant[variant]
                for effects, variant in variant_of.items()
                if variant in by_variant
            }
            for wanted in _wanted_costs(order, most_on):
                if cost := _cost(ladders, wanted.effects_before, wanted.effects_after):
                    rows.append(
                        {
                            "place": conditions,
                            "frames": frames,
                            "effect": wanted.effect,
                            "against": wanted.against,
                            **cost,
                        }
                    )
    return EFFECTS.frame(rows)


def _switched_on(switches: str) -> frozenset[str]:
    """Return the effects that are on, from the JSON text of a set-up's switches."""
    return frozenset(effect for effect, is_on in json.loads(switches).items() if is_on)


def _effects_in_order(set_ups: pd.DataFrame, variant: str) -> list[str]:
    """Return all effects in the order of this set-up's switches."""
    switches = set_ups["switches"][set_ups["variant"] == variant].iloc[0]
    return list(json.loads(switches))


def _wanted_costs(effects: list[str], most_on: frozenset[str]) -> list[_Cost]:
    """Return the costs of each effect alone, then of each last, then of all together."""
    nothing = frozenset[str]()
    words = {effect: effect.replace("_", " ") for effect in effects}
    costs = [_Cost(words[name], "nothing", nothing, frozenset([name])) for name in effects]
    for name in effects:
        costs.append(_Cost(words[name], "all others", most_on - {name}, most_on))
    costs.append(_Cost("all", "nothing", nothing, most_on))
    return costs


def _cost(
    ladders: Mapping[frozenset[str], Ladder],
    effects_before: frozenset[str],
    effects_after: frozenset[str],
) -> dict[str, Any]:
    """Return the paired difference of two set-ups with its interval, and whether both sizes lie on
    the ladder (else it is only a bound); empty if either was not finished, or not with the same
    repeats."""
    if effects_before not in ladders or effects_after not in ladders:
        return {}
    before = ladders[effects_before]
    after = ladders[effects_after]
    if before.detected.shape != after.detected.shape:
        return {}
    # both off the ladder: a difference of infinities is unknown
    with np.errstate(invalid="ignore"):
        interval = percentiles(after.half_draws_mm - before.half_draws_mm)
        loss_mm = float(np.subtract(after.half_mm, before.half_mm))
    return {
        "loss_mm": loss_mm,
        "loss_low_mm": interval.low,
        "loss_high_mm": interval.high,
        "on_ladder": not (before.at_the_end or after.at_the_end),
    }
