"""The smallest hole that a set-up finds: a step on its ladder of sizes, and the size found in half of the trials.

The second is a point on a curve drawn through the rates, monotone and otherwise free. It is no probability of detection
in the handbooks' sense: that needs a model, its goodness of fit and a bound for the 90 % point over many targets.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.intervals import CONFIDENCE, Interval

if TYPE_CHECKING:
    import pandas as pd

RESAMPLES = 1000
"""Of the two-way bootstrap: its 2.5 % quantile is the 25th smallest, stable to about 5 % of the interval's width."""
HALF = 0.5
LIMIT_RULE = (
    "The detection limit is the smallest true diameter from which on every hole as large or larger counts as found. "
    "The 50 % size is where the detection rate, made monotone in the diameter by isotonic regression and interpolated "
    "linearly between sizes, reaches one half; its 95 % interval is a bootstrap over the holes of each size (where "
    "there are several) and over the repeats."
)


@dataclass(frozen=True)
class Ladder:
    """Detections of one set-up at one number of frames.

    ``diameters_mm`` (h,) of the holes, ascending; ``detected`` (repeats, h) bool.
    """

    diameters_mm: np.ndarray
    detected: np.ndarray

    @cached_property
    def sizes_mm(self) -> np.ndarray:
        """(s,) the distinct diameters, ascending."""
        return np.unique(self.diameters_mm)

    @cached_property
    def half_mm(self) -> float:
        """The 50 % size; the ladder's least size where that is found more often than not, infinity where none is."""
        repeats, holes = self.detected.shape
        return float(half_size(self.sizes_mm, self._rates(np.ones((1, repeats)), np.ones((1, holes))))[0])

    @property
    def at_the_end(self) -> bool:
        """Whether the 50 % size lies off the ladder, so that only a bound is known."""
        return not self.sizes_mm[0] < self.half_mm < np.inf

    @cached_property
    def half_draws_mm(self) -> np.ndarray:
        """(`RESAMPLES`,) 50 % sizes of the two-way bootstrap.

        Ladders of the same holes and repeats are resampled alike, so that differences of draws are paired.
        """
        rng = np.random.default_rng(0)
        repeats, holes = self.detected.shape
        of_repeats = rng.multinomial(repeats, np.full(repeats, 1 / repeats), RESAMPLES)
        of_holes = np.empty((RESAMPLES, holes))
        for size in self.sizes_mm:
            alike = self.diameters_mm == size
            of_holes[:, alike] = rng.multinomial(alike.sum(), np.full(alike.sum(), 1 / alike.sum()), RESAMPLES)
        return half_size(self.sizes_mm, self._rates(of_repeats, of_holes))

    @property
    def half_interval(self) -> Interval:
        """95 % percentile interval of the 50 % size."""
        return percentile(self.half_draws_mm)

    def _rates(self, of_repeats: np.ndarray, of_holes: np.ndarray) -> np.ndarray:
        """(n, s) detection rate of each size, repeats (n, repeats) and holes (n, h) weighted by how often drawn."""
        by_hole = of_repeats @ self.detected / of_repeats.sum(axis=1, keepdims=True) * of_holes
        starts = np.searchsorted(self.diameters_mm, self.sizes_mm)
        return np.asarray(np.add.reduceat(by_hole, starts, axis=1) / np.add.reduceat(of_holes, starts, axis=1))


def ladder_of(holes: pd.DataFrame) -> Ladder:
    """From the table of holes' rows of one set-up and one number of frames."""
    table = holes.pivot(index="repeat", columns="hole", values="detected").astype(bool)
    sizes = holes.groupby("hole")["true_diameter_mm"].first()
    order = sorted(table.columns, key=lambda hole: (sizes[hole], str(hole)))
    return Ladder(sizes[order].to_numpy(float), table[order].to_numpy(bool))


def found_limit_mm(summary: pd.DataFrame) -> float:
    """The detection limit by `LIMIT_RULE` from summary rows of one set-up and one number of frames; NaN where even the
    largest hole is not found."""
    limit = float("nan")
    for diameter in sorted(summary["true_diameter_mm"].unique(), reverse=True):
        if not (summary["status"][summary["true_diameter_mm"] == diameter] == "found").all():
            break
        limit = float(diameter)
    return limit


def half_size(sizes_mm: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """(n,) where rates (n, s), made monotone, first reach one half: by linear interpolation between sizes, in mm.

    The least size where its rate does already, infinity where none does.
    """
    monotone = isotonic(np.asarray(rates, float))
    reached = monotone >= HALF - 1e-12
    last = np.argmax(reached, axis=1)
    before, rows = np.maximum(last - 1, 0), np.arange(len(monotone))
    low, high = monotone[rows, before], monotone[rows, last]
    share = np.where(last > 0, (HALF - low) / np.where(high > low, high - low, 1.0), 0.0)
    found = sizes_mm[before] + share * (sizes_mm[last] - sizes_mm[before])
    return np.where(reached.any(axis=1), found, np.inf)


def isotonic(rates: np.ndarray) -> np.ndarray:
    """Isotonic regression with equal weights of each row of (n, s), all rows at once.

    By the max-min formula (Robertson, Wright and Dykstra 1988): at i the largest over a <= i of the least over b >= i
    of the mean from a to b.
    """
    n, s = rates.shape
    sums = np.concatenate([np.zeros((n, 1)), np.cumsum(rates, axis=1)], axis=1)
    a, b = np.indices((s, s))
    means = np.where(b >= a, (sums[:, None, 1:] - sums[:, :-1, None]) / np.maximum(b - a + 1, 1), np.inf)
    least = np.minimum.accumulate(means[..., ::-1], axis=2)[..., ::-1]
    return np.asarray(np.where(a <= b, least, -np.inf).max(axis=1))


def percentile(draws: np.ndarray) -> Interval:
    """The central interval of bootstrap draws; infinite ends stay, differences of two infinities are left out."""
    known = draws[~np.isnan(draws)]
    if len(known) < len(draws) / 2:
        return Interval(float("nan"), float("nan"))
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(known, [tail, 1 - tail], method="inverted_cdf")
    return Interval(float(low), float(high))
