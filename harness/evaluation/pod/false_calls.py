"""False calls: their rate per area, and the threshold for a wanted rate.

All bounds are one-sided upper bounds unless an interval is named; runs are taken as independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from harness.evaluation.intervals import Interval, poisson_rate
from harness.vocabulary.errors import UserError

SITES_PER_TARGET = 3
"""MIL-HDBK-1823A: unflawed sites for each flawed one, at least."""


@dataclass(frozen=True)
class FalseCallRate:
    """False calls per square metre: estimate, Garwood's two-sided ``interval`` and one-sided ``upper`` bound."""

    rate_per_m2: float
    interval_per_m2: Interval
    upper_per_m2: float
    confidence: float
    calls: int
    area_m2: float


def false_call_rate(calls: int, area_m2: float, confidence: float = 0.95) -> FalseCallRate:
    """State the rate of ``calls`` false calls on ``area_m2`` of unflawed surface as a Poisson count; limits exact."""
    if calls < 0 or not area_m2 > 0:
        raise UserError(f"{calls} false calls on {area_m2:g} m2", legal="no fewer than 0 calls, an area above 0")
    low, high = poisson_rate(calls, area_m2, confidence)
    upper = poisson_rate(calls, area_m2, 2 * confidence - 1)[1]
    return FalseCallRate(calls / area_m2, Interval(float(low), float(high)), float(upper), confidence, calls, area_m2)


@dataclass(frozen=True)
class Threshold:
    """A score's threshold: findings *above* ``value`` are calls (-inf: every finding is).

    ``rate_per_m2``: false calls to expect on new runs; ``upper_per_m2``: bound of the true rate at one-sided
    ``confidence``; ``calling_runs`` of ``runs`` lie above.
    """

    value: float
    rate_per_m2: float
    upper_per_m2: float
    confidence: float
    runs: int
    calling_runs: int


def threshold_for_rate(
    highest_scores_per_run: ArrayLike, area_m2: float, rate_per_m2: float, confidence: float = 0.95
) -> Threshold:
    """Lowest observed score whose false-call rate is at most the one wanted, from hole-free runs of ``area_m2`` each.

    Calls are a Poisson process, so a run stays silent with probability exp(-rate * area); the highest score of each run
    (runs,), -inf where it had no finding, tells which were. Above the (k + 1)-th highest of n lies a new run's score
    with probability (k + 1) / (n + 1), whatever the scores' distribution: k is the largest for which that is small
    enough, and the true probability is Beta(k + 1, n - k) distributed (Wilks 1941), which gives the bound. Judge on
    other runs than these. UserError where the runs are too few for so low a rate: it says how many would do.
    """
    scores = np.asarray(highest_scores_per_run, float).ravel()
    if not (area_m2 > 0 and rate_per_m2 > 0):
        raise UserError(f"area {area_m2:g} m2, wanted rate {rate_per_m2:g} per m2", legal="both above 0")
    if np.any(np.isnan(scores)) or np.any(np.isposinf(scores)):
        raise UserError("highest scores that are no numbers", legal="a finite score, or -inf for a run without finding")
    n, wanted = len(scores), -float(np.expm1(-rate_per_m2 * area_m2))
    # The margin is for rounding where (n + 1) * wanted is a whole number.
    k = min(int(np.floor((n + 1) * wanted * (1 + 1e-12))) - 1, n - 1)
    if k < 0:
        raise UserError(
            f"{n} hole-free runs of {area_m2:.4g} m2 are too few for {rate_per_m2:g} false calls per m2",
            legal=f"at least {int(np.ceil(1 / wanted * (1 - 1e-12))) - 1} runs",
            fix="simulate more hole-free boards, or ask for a higher rate",
        )
    value = float(np.sort(scores)[n - 1 - k])
    above = int(np.sum(scores > value))
    bound = float(stats.beta.ppf(confidence, above + 1, n - above))
    rate, upper = -np.log1p(-np.array([(above + 1) / (n + 1), bound])) / area_m2
    return Threshold(value, float(rate), float(upper), confidence, n, above)
