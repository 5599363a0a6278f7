"""What each switch of an experiment costs: the detection limit with it and without it, alone and beside all others."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.intervals import Interval
from harness.evaluation.limits import Ladder, ladder_of, percentile
from harness.tables.trials import ResultTables

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Cost:
    """Change of the 50 % size in mm when a switch goes on (positive: only larger holes are found then).

    ``certain``: whether both sizes lie on the ladder, so that the number is no mere bound.
    """

    mm: float
    interval: Interval
    certain: bool


@dataclass(frozen=True)
class EffectCost:
    """One switch: ``alone`` against nothing on, ``last`` against all others on.

    The two differ where effects add as squares or mask each other.
    """

    effect: str
    alone: Cost
    last: Cost


@dataclass(frozen=True)
class EffectCosts:
    """All switches at one place (values of the experiment's other axes, as text) and number of frames, and everything
    together against nothing."""

    place: str
    frames: int
    effects: tuple[EffectCost, ...]
    together: Cost


def effect_costs(tables: ResultTables) -> list[EffectCosts]:
    """The costs of every switch, for each place on the other axes and each number of frames; [] without switches."""
    set_ups = tables.variants[tables.variants["switches"] != ""]
    if set_ups.empty:
        return []
    return [costs for place, by_switches in _places(set_ups, tables) for costs in _costs(place, by_switches, tables)]


def _places(set_ups: pd.DataFrame, tables: ResultTables) -> Iterator[tuple[str, dict[frozenset[str], str]]]:
    """For each place on the other axes: its text, and the set-up for each set of switches that are on."""
    switched = tables.axes["path"].iloc[0]
    others = [path for path in tables.axes["path"] if path != switched]
    groups = set_ups.groupby(others, sort=False, dropna=False) if others else [((), set_ups)]
    names = dict(zip(tables.axes["path"], tables.axes["name"], strict=True))
    for values, part in groups:
        place = ", ".join(f"{names[path]}={value}" for path, value in zip(others, values, strict=True))
        on = {frozenset(_on(row["switches"])): str(row["variant"]) for _, row in part.iterrows()}
        yield place, on


def _on(switches_json: str) -> list[str]:
    return [name for name, is_on in json.loads(switches_json).items() if is_on]


def _costs(place: str, by_switches: Mapping[frozenset[str], str], tables: ResultTables) -> Iterator[EffectCosts]:
    everything = max(by_switches, key=len)
    names = list(json.loads(tables.variants.set_index("variant")["switches"][by_switches[everything]]))
    holes = tables.holes[tables.holes["variant"].isin(by_switches.values())]
    for frames in sorted(int(n) for n in holes["frames"].unique()):
        part = holes[holes["frames"] == frames]
        there = {str(variant): ladder_of(rows) for variant, rows in part.groupby("variant")}
        ladders = {on: there[variant] for on, variant in by_switches.items() if variant in there}
        found = [
            EffectCost(name.replace("_", " "), alone, last)
            for name in names
            if (alone := _cost(ladders, frozenset(), frozenset([name])))
            and (last := _cost(ladders, everything - {name}, everything))
        ]
        together = _cost(ladders, frozenset(), everything)
        if together is not None:
            yield EffectCosts(place, frames, tuple(found), together)


def _cost(ladders: Mapping[frozenset[str], Ladder], off: frozenset[str], on: frozenset[str]) -> Cost | None:
    """The paired difference of two set-ups; None where either was not finished, or not with the same repeats."""
    if off not in ladders or on not in ladders:
        return None
    before, after = ladders[off], ladders[on]
    if before.detected.shape != after.detected.shape:
        return None
    with np.errstate(invalid="ignore"):  # both off the ladder: a difference of infinities is unknown
        draws = after.half_draws_mm - before.half_draws_mm
        mm = float(np.subtract(after.half_mm, before.half_mm))
    return Cost(mm, percentile(draws), certain=not (before.at_the_end or after.at_the_end))
