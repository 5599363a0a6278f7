"""One map against another on the same repeats: the same frames feed both, so that differences are paired.

Intervals are over repeats, which vary the noise and the error of the nominal poses. Thresholds were calibrated once
for each set-up, and the draw of that calibration is in no interval.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.intervals import UNKNOWN, Interval, bootstrap, mean_t
from harness.evaluation.limits import isotonic
from harness.evaluation.summary import Measure

if TYPE_CHECKING:
    import pandas as pd

FEWEST_BOTH = 2
"""Repeats in which a hole must be measured in both maps to be compared."""


@dataclass(frozen=True)
class Change:
    """A mean difference (second less first) with its interval over ``n`` repeats."""

    mean: float
    interval: Interval
    n: int

    @property
    def is_above(self) -> bool | None:
        """True where surely above zero, False where surely not, None where the interval has room for both."""
        if self.interval.above(0):
            return True
        return False if self.interval.high <= 0 else None

    @property
    def is_below(self) -> bool | None:
        """Likewise below zero."""
        if self.interval.below(0):
            return True
        return False if self.interval.low >= 0 else None


NO_CHANGE_KNOWN = Change(np.nan, UNKNOWN, 0)


@dataclass(frozen=True)
class SizeErrors:
    """|measured - true diameter| in mm of holes measured in both of two maps, repeat by repeat.

    ``holes`` (h,) names and ``diameters_mm`` (h,), ascending; ``first_mm`` and ``second_mm`` (repeats, h), NaN where
    either map lacks the hole.
    """

    holes: tuple[str, ...]
    diameters_mm: np.ndarray
    first_mm: np.ndarray
    second_mm: np.ndarray

    @property
    def differences_mm(self) -> np.ndarray:
        """(repeats, h) second less first."""
        return np.asarray(self.second_mm - self.first_mm)

    def change(self, of: np.ndarray | None = None) -> Change:
        """Over the holes ``of`` (h,) bool: the mean over repeats of each repeat's mean difference."""
        chosen = self.differences_mm[:, of] if of is not None else self.differences_mm
        there = np.isfinite(chosen)
        usable = there.any(axis=1)
        sums = np.where(there, chosen, 0.0).sum(axis=1)[usable]
        return change_of(sums / there.sum(axis=1)[usable])

    def by_hole(self) -> list[Change]:
        """The same for each hole alone."""
        return [change_of(column[np.isfinite(column)]) for column in self.differences_mm.T]

    @property
    def crossing_mm(self) -> float:
        """The diameter above which the second map sizes better, see `crossing_of`."""
        return float(self._crossings(np.arange(len(self.first_mm))[None])[0])

    @property
    def crossing_interval(self) -> Interval:
        """Its 95 % interval by bootstrap over repeats; unknown where most draws have no crossing."""
        return bootstrap(self._crossings, len(self.first_mm))

    def _crossings(self, chosen: np.ndarray) -> np.ndarray:
        drawn = self.differences_mm[chosen]
        there = np.isfinite(drawn)
        with np.errstate(invalid="ignore"):
            means = np.where(there, drawn, 0.0).sum(axis=1) / there.sum(axis=1)
        # a hole that a draw lacks leaves that draw without an answer
        return crossing_of(self.diameters_mm, means)


def change_of(differences: np.ndarray) -> Change:
    """A change from one difference for each repeat, by Student."""
    n = len(differences)
    if n < 2:
        return NO_CHANGE_KNOWN
    mean, std = float(differences.mean()), float(differences.std(ddof=1))
    low, high = mean_t(mean, std, n)
    return Change(mean, Interval(float(low), float(high)), n)


def crossing_of(diameters_mm: np.ndarray, changes_mm: np.ndarray) -> np.ndarray:
    """(n,) where changes (n, h) of the error against ascending diameters (h,) turn from above zero to below.

    The changes are made falling by isotonic regression and interpolated linearly; NaN where they do not cross zero.
    """
    if changes_mm.shape[1] < 2:
        return np.full(len(changes_mm), np.nan)
    bad = ~np.isfinite(changes_mm).all(axis=1)
    falling = -isotonic(-np.where(bad[:, None], 0.0, changes_mm))
    after = np.argmax(falling < 0, axis=1)
    crosses = (falling[:, 0] > 0) & (falling[:, -1] < 0) & ~bad
    rows, before = np.arange(len(falling)), np.maximum(after - 1, 0)
    high, low = falling[rows, before], falling[rows, after]
    share = np.where(crosses, high / np.where(high > low, high - low, 1.0), 0.0)
    found = diameters_mm[before] + share * (diameters_mm[after] - diameters_mm[before])
    return np.where(crosses, found, np.nan)


def size_errors(first: pd.DataFrame, second: pd.DataFrame, measure: Measure = "extent") -> SizeErrors:
    """From the table of holes' rows of two maps, each of one set-up and one number of frames; holes that both measure
    in `FEWEST_BOTH` repeats at least."""
    tables = [_errors(rows, measure) for rows in (first, second)]
    holes = [hole for hole in tables[0].columns if hole in tables[1].columns]
    repeats = tables[0].index.intersection(tables[1].index)
    one, two = (table.loc[repeats, holes].to_numpy(float) for table in tables)
    both = np.isfinite(one) & np.isfinite(two)
    enough = both.sum(axis=0) >= FEWEST_BOTH
    diameters = first.groupby("hole")["true_diameter_mm"].first()
    order = [place for place in range(len(holes)) if enough[place]]
    order.sort(key=lambda place: float(diameters[holes[place]]))
    return SizeErrors(
        tuple(str(holes[place]) for place in order),
        np.array([float(diameters[holes[place]]) for place in order]),
        np.where(both, one, np.nan)[:, order],
        np.where(both, two, np.nan)[:, order],
    )


def run_change(first: pd.DataFrame, second: pd.DataFrame, column: str) -> Change:
    """Paired change of a column of the table of runs on the damaged board; ``threshold_mm`` is k times the scale."""
    one, two = (_by_repeat(rows, column) for rows in (first, second))
    return change_of((two - one).dropna().to_numpy(float))


def run_ratio(first: pd.DataFrame, second: pd.DataFrame, column: str) -> Change:
    """The same of the natural logarithm: ``exp`` of it is a ratio."""
    one, two = (np.log(_by_repeat(rows, column)) for rows in (first, second))
    return change_of((two - one).dropna().to_numpy(float))


def _by_repeat(runs: pd.DataFrame, column: str) -> pd.Series:
    damaged = runs[runs["role"] == "damaged"]
    values = damaged["threshold"] * damaged["scale_mm"] if column == "threshold_mm" else damaged[column]
    return values.set_axis(damaged["repeat"])


def _errors(rows: pd.DataFrame, measure: Measure) -> pd.DataFrame:
    """|measured - true| by repeat and hole, NaN where not detected."""
    rows = rows.assign(_error=(rows[f"{measure}_diameter_mm"] - rows["true_diameter_mm"]).abs())
    return rows.pivot(index="repeat", columns="hole", values="_error")
