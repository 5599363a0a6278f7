"""Intervals, two-sided at `CONFIDENCE` unless stated otherwise; false calls per area, and the
threshold for a rate.

Sources: Wilson 1927 and Clopper and Pearson 1934 (proportions), Garwood 1936 (Poisson), Student
and Welch (means), Efron and Tibshirani 1993 (percentile bootstrap). Not covered: repeats of one
set-up are repeats of the noise."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from harness.vocabulary.errors import UserError

CONFIDENCE = 0.95  # two-sided confidence of every interval in tables and reports
UPPER = 0.5 + CONFIDENCE / 2
# the 2.5 % quantile is then the 50th smallest, stable to about 3 % of the interval's width
RESAMPLES = 2000


@dataclass(frozen=True)
class Interval:
    """A closed interval; both ends are NaN if the data cannot support one."""

    low: float
    """Lower end."""
    high: float
    """Upper end."""

    @property
    def known(self) -> bool:
        """Return whether both ends are numbers (infinity counts)."""
        return not (np.isnan(self.low) or np.isnan(self.high))

    def above(self, value: float) -> bool:
        """Return whether the whole interval lies above ``value``; False if it is unknown."""
        return bool(self.low > value)

    def below(self, value: float) -> bool:
        """Return whether the whole interval lies below ``value``; False if it is unknown."""
        return bool(self.high < value)

    def over(self, value: float) -> bool | None:
        """Return whether the estimated quantity certainly exceeds ``value``; None if the interval
        includes both."""
        if self.low > value:
            return True
        return False if self.high <= value else None

    def within(self, low: float, high: float) -> bool:
        """Return whether the whole interval lies in [low, high]; False if it is unknown."""
        return bool(self.low >= low and self.high <= high)


UNKNOWN = Interval(np.nan, np.nan)


def _floats(*values: ArrayLike) -> tuple[np.ndarray, ...]:
    """Return values as arrays of numbers of one shape."""
    return np.broadcast_arrays(*(np.asarray(value, float) for value in values))


def _ends_where(
    is_defined: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of intervals, NaN where they are not defined."""
    return np.where(is_defined, low, np.nan), np.where(is_defined, high, np.nan)


def wilson(successes: ArrayLike, trials: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return Wilson's score interval of a proportion, element by element: (low, high), NaN where
    ``trials`` is 0. Its average coverage over the proportion is near nominal; `clopper_pearson` is
    never below nominal and wider."""
    k, n = _floats(successes, trials)
    z2 = special.ndtri(UPPER) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = (k + z2 / 2) / (n + z2)
        half = np.sqrt(z2) / (n + z2) * np.sqrt(k * (n - k) / n + z2 / 4)
    # rounding would give 1e-17 instead of exactly 0 or 1
    low = np.where(k == 0, 0.0, centre - half)
    high = np.where(k == n, 1.0, centre + half)
    return _ends_where(n > 0, low, high)


def clopper_pearson(successes: ArrayLike, trials: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return Clopper and Pearson's exact interval of a proportion, element by element; NaN where
    ``trials`` is 0."""
    k, n = _floats(successes, trials)
    low = np.where(k == 0, 0.0, special.betaincinv(k, n - k + 1, 1 - UPPER))
    high = np.where(k == n, 1.0, special.betaincinv(k + 1, n - k, UPPER))
    return _ends_where(n > 0, low, high)


def poisson_rate(count: ArrayLike, exposure: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return Garwood's exact interval of a Poisson rate: ``count`` in ``exposure``, NaN where that
    is 0."""
    k, time = _floats(count, exposure)
    low = np.where(k == 0, 0.0, special.gammaincinv(k, 1 - UPPER))
    high = special.gammaincinv(k + 1, UPPER)
    with np.errstate(invalid="ignore", divide="ignore"):
        return _ends_where(time > 0, low / time, high / time)


def mean_t(
    mean: ArrayLike,
    std: ArrayLike,
    n: ArrayLike,
) -> tuple[np.ndarray, np.ndarray]:
    """Return Student's interval from a sample's mean, standard deviation (n - 1) and size; NaN
    below two values."""
    centre, deviation, count = _floats(mean, std, n)
    size = np.where(count >= 2, count, np.nan)
    half = special.stdtrit(size - 1, UPPER) * deviation / np.sqrt(size)
    return centre - half, centre + half


def mean_difference(first: ArrayLike, second: ArrayLike) -> Interval:
    """Return Welch's interval of mean(first) - mean(second); a point if neither varies, unknown
    below two values."""
    a = np.asarray(first, float)
    b = np.asarray(second, float)
    if min(len(a), len(b)) < 2:
        return UNKNOWN
    if np.ptp(a) == np.ptp(b) == 0:
        difference = float(a[0] - b[0])
        return Interval(difference, difference)
    of_a = a.var(ddof=1) / len(a)
    of_b = b.var(ddof=1) / len(b)
    variance = of_a + of_b
    # Welch and Satterthwaite's degrees of freedom
    freedom = variance**2 / (of_a**2 / (len(a) - 1) + of_b**2 / (len(b) - 1))
    half = float(special.stdtrit(freedom, UPPER) * np.sqrt(variance))
    middle = float(a.mean() - b.mean())
    return Interval(middle - half, middle + half)


def standardised_bias(
    bias: float,
    std: float,
    n: int,
) -> Interval:
    """Return the interval of bias / standard deviation (an effect size) from ``n`` normal values,
    by the large-sample variance 1/n + d^2/(2n) (Hedges and Olkin 1985). Exact if they do not vary;
    unknown below two values."""
    if n < 2 or not (np.isfinite(bias) and np.isfinite(std)):
        return UNKNOWN
    if std == 0:
        ratio = 0.0 if bias == 0 else float(np.copysign(np.inf, bias))
        return Interval(ratio, ratio)
    ratio = bias / std
    half = float(special.ndtri(UPPER) * np.sqrt(1 / n + ratio**2 / (2 * n)))
    return Interval(ratio - half, ratio + half)


def bootstrap(
    statistic: Callable[[np.ndarray], np.ndarray],
    n: int,
    *,
    resamples: int = RESAMPLES,
) -> Interval:
    """Return the percentile bootstrap over ``n`` exchangeable units (repeats, or blocks of
    pixels), with the same draws every time. ``statistic`` maps indices (resamples, n) to values
    (resamples,); NaN are left out."""
    if n < 2:
        return UNKNOWN
    indices = np.random.default_rng(0).integers(0, n, size=(resamples, n))
    return percentiles(np.asarray(statistic(indices), float))


def percentiles(draws: np.ndarray, confidence: float = CONFIDENCE) -> Interval:
    """Return the central interval of bootstrap draws (B,); infinite ends remain. NaN draws (such
    as differences of two infinities) are left out; if they are more than half, the interval is
    unknown."""
    numbers = draws[~np.isnan(draws)]
    if len(numbers) < 2 or len(numbers) < 0.5 * len(draws):
        return UNKNOWN
    shares = [(1 - confidence) / 2, (1 + confidence) / 2]
    low, high = np.quantile(numbers, shares, method="inverted_cdf")
    return Interval(float(low), float(high))


SITES_PER_TARGET = 3  # fewest unflawed sites per flawed one, by MIL-HDBK-1823A


@dataclass(frozen=True)
class FalseCallRate:
    """False calls per square metre."""

    rate_per_m2: float
    """Estimate."""
    interval_per_m2: Interval
    """Garwood's interval."""
    calls: int
    """Number of false calls."""
    area_m2: float
    """Unflawed surface inspected."""


def false_call_rate(calls: int, area_m2: float) -> FalseCallRate:
    """Return the rate of ``calls`` false calls on ``area_m2`` of unflawed surface, a Poisson
    count; exact limits."""
    if calls < 0 or not area_m2 > 0:
        raise UserError(
            f"{calls} false calls on {area_m2:g} m2", legal="0 calls or more, an area above 0"
        )
    low, high = poisson_rate(calls, area_m2)
    return FalseCallRate(calls / area_m2, Interval(float(low), float(high)), calls, area_m2)


@dataclass(frozen=True)
class Threshold:
    """A threshold of scores that keeps to a rate of false calls."""

    value: float
    """Findings *above* it are calls (-inf: every finding is)."""
    rate_per_m2: float
    """Expected false calls on new runs."""
    upper_per_m2: float
    """Bound on the true rate at one-sided ``confidence``."""
    confidence: float
    """Confidence of that bound."""
    runs: int
    """Number of hole-free runs that set the threshold."""
    calling_runs: int
    """Number of these with a score above it."""


def threshold_for_rate(
    highest_scores_per_run: ArrayLike,
    area_m2: float,
    rate_per_m2: float,
    confidence: float = 0.95,
) -> Threshold:
    """Return the lowest observed score whose rate of false calls is at most the wanted rate, from
    hole-free runs of ``area_m2`` each. ``highest_scores_per_run`` (runs,): -inf without a finding.
    Calls are a Poisson process. A new run's score exceeds the (k + 1)-th highest of n with
    probability (k + 1) / (n + 1); the true rate is Beta(k + 1, n - k) distributed (Wilks 1941).
    Use other runs for judging. Raises UserError if the runs are too few."""
    scores = np.asarray(highest_scores_per_run, float).ravel()
    if not (area_m2 > 0 and rate_per_m2 > 0):
        raise UserError(
            f"area {area_m2:g} m2, wanted rate {rate_per_m2:g} per m2", legal="both above 0"
        )
    if np.any(np.isnan(scores)) or np.any(np.isposinf(scores)):
        raise UserError(
            "not every highest score is a number", legal="a finite score, or -inf for no finding"
        )
    n = len(scores)
    wanted = -float(np.expm1(-rate_per_m2 * area_m2))
    # the margin is for rounding where (n + 1) * wanted is a whole number
    k = min(int(np.floor((n + 1) * wanted * (1 + 1e-12))) - 1, n - 1)
    if k < 0:
        runs = f"{n} hole-free runs of {area_m2:.2g} m²"
        fewest = int(np.ceil(1 / wanted * (1 - 1e-12))) - 1
        raise UserError(
            f"{runs} are too few for a rate of {rate_per_m2:g} per m² of false calls",
            legal=f"at least {fewest} runs",
            fix="simulate more hole-free boards, or ask for a higher rate",
        )
    value = float(np.sort(scores)[n - 1 - k])
    above = int(np.sum(scores > value))
    bound = float(special.betaincinv(above + 1, n - above, confidence))
    probabilities = np.array([(above + 1) / (n + 1), bound])
    rate, upper = -np.log1p(-probabilities) / area_m2
    return Threshold(
        value=value,
        rate_per_m2=float(rate),
        upper_per_m2=float(upper),
        confidence=confidence,
        runs=n,
        calling_runs=above,
    )
