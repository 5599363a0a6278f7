"""A measured number with its interval, from frames that repeat one another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from harness.evaluation.intervals import CONFIDENCE, UNKNOWN, Interval, wilson

GROUPS = 10
"""Groups of frames of the jackknife: 9 degrees of freedom, Student's factor 2.26."""


@dataclass(frozen=True)
class Estimate:
    """A value and its two-sided 95 % interval (unknown where nothing repeats); ``nan`` where there was no data."""

    value: float
    interval: Interval = UNKNOWN


NOTHING = Estimate(float("nan"))
"""What is told of a condition in which the camera sees nothing."""


def jackknifed(frames: np.ndarray, statistic: Callable[[np.ndarray], float], groups: int = GROUPS) -> Estimate:
    """``statistic`` of ``frames`` (n, ...) with Student's interval from the delete-a-group jackknife over frames.

    Frames must be independent, pixels need not be: what neighbours or a whole frame share is in the interval. Groups
    are interleaved. The interval is unknown below 4 frames. Source: Efron and Tibshirani 1993, chapter 11.
    """
    from scipy.stats import t

    value = float(statistic(frames))
    g = min(groups, len(frames) // 2)
    if g < 2 or not np.isfinite(value):
        return Estimate(value)
    number = np.arange(len(frames)) % g
    without = np.array([statistic(frames[number != group]) for group in range(g)])
    half = float(t.ppf(0.5 + CONFIDENCE / 2, g - 1) * np.sqrt((g - 1) / g * ((without - without.mean()) ** 2).sum()))
    return Estimate(value, Interval(value - half, value + half) if np.isfinite(half) else UNKNOWN)


def mean_of(values: ArrayLike) -> Estimate:
    """The mean of independent values with Student's interval; values that are NaN are left out."""
    from harness.evaluation.intervals import mean_t

    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    if known.size == 0:
        return NOTHING
    if known.size == 1:
        return Estimate(float(known[0]))
    low, high = mean_t(known.mean(), known.std(ddof=1), known.size)
    return Estimate(float(known.mean()), Interval(float(low), float(high)))


def share_of(hits: np.ndarray, pixels_each: float) -> Estimate:
    """The share of true values among ``hits`` with Wilson's interval, ``pixels_each`` neighbours counting as one."""
    trials = hits.size / pixels_each
    low, high = wilson(hits.mean() * trials, trials)
    return Estimate(float(hits.mean()), Interval(float(low), float(high)))
