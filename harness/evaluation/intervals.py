"""Intervals: what stands beside every estimate. All are two-sided at `CONFIDENCE` unless told otherwise.

Sources: Wilson 1927 and Clopper and Pearson 1934 (proportions), Garwood 1936 (Poisson), Student and Welch (means),
Efron and Tibshirani 1993 (percentile bootstrap).
Not covered: repeats of one set-up are repeats of the noise. No interval here speaks of other boards, places or cameras.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

CONFIDENCE = 0.95
"""Two-sided confidence of every interval in tables and reports."""
RESAMPLES = 2000
"""Bootstrap resamples: the 2.5 % quantile is then the 50th smallest, stable to about 3 % of the interval's width."""


@dataclass(frozen=True)
class Interval:
    """A closed interval; both ends NaN where the data cannot support one."""

    low: float
    high: float

    @property
    def known(self) -> bool:
        """Return whether both ends are numbers (infinity counts)."""
        return not (np.isnan(self.low) or np.isnan(self.high))

    def above(self, value: float) -> bool:
        """Return whether the whole interval lies above ``value``; False where unknown."""
        return bool(self.low > value)

    def below(self, value: float) -> bool:
        """Return whether the whole interval lies below ``value``; False where unknown."""
        return bool(self.high < value)

    def within(self, low: float, high: float) -> bool:
        """Return whether the whole interval lies in [low, high]; False where unknown."""
        return bool(self.low >= low and self.high <= high)


UNKNOWN = Interval(np.nan, np.nan)


def wilson(successes: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE) -> tuple[np.ndarray, np.ndarray]:
    """Wilson's score interval of a proportion, element by element: (low, high), NaN where ``trials`` is 0.

    Coverage is near nominal on average over the proportion; `clopper_pearson` is never below nominal and wider.
    """
    from scipy.stats import norm

    k, n = np.broadcast_arrays(np.asarray(successes, float), np.asarray(trials, float))
    z2 = norm.ppf(0.5 + confidence / 2) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = (k + z2 / 2) / (n + z2)
        half = np.sqrt(z2) / (n + z2) * np.sqrt(k * (n - k) / n + z2 / 4)
    # Rounding would leave 1e-17 where the end is exactly 0 or 1.
    low = np.where(k == 0, 0.0, centre - half)
    high = np.where(k == n, 1.0, centre + half)
    return np.where(n > 0, low, np.nan), np.where(n > 0, high, np.nan)


def clopper_pearson(
    successes: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE
) -> tuple[np.ndarray, np.ndarray]:
    """Clopper and Pearson's exact interval of a proportion, element by element; NaN where ``trials`` is 0."""
    from scipy.stats import beta

    k, n = np.broadcast_arrays(np.asarray(successes, float), np.asarray(trials, float))
    tail = (1 - confidence) / 2
    low = np.where(k == 0, 0.0, beta.ppf(tail, k, n - k + 1))
    high = np.where(k == n, 1.0, beta.ppf(1 - tail, k + 1, n - k))
    return np.where(n > 0, low, np.nan), np.where(n > 0, high, np.nan)


def poisson_rate(
    count: ArrayLike, exposure: ArrayLike, confidence: float = CONFIDENCE
) -> tuple[np.ndarray, np.ndarray]:
    """Garwood's exact interval of a Poisson rate, ``count`` events in ``exposure`` (runs, areas), NaN where 0."""
    from scipy.stats import chi2

    k, time = np.broadcast_arrays(np.asarray(count, float), np.asarray(exposure, float))
    tail = (1 - confidence) / 2
    low = np.where(k == 0, 0.0, chi2.ppf(tail, 2 * k) / 2)
    high = chi2.ppf(1 - tail, 2 * k + 2) / 2
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(time > 0, low / time, np.nan), np.where(time > 0, high / time, np.nan)


def mean_t(
    mean: ArrayLike, std: ArrayLike, n: ArrayLike, confidence: float = CONFIDENCE
) -> tuple[np.ndarray, np.ndarray]:
    """Student's interval from a sample's mean, standard deviation (n - 1) and size; NaN below two values."""
    from scipy.stats import t

    m, s, k = np.broadcast_arrays(np.asarray(mean, float), np.asarray(std, float), np.asarray(n, float))
    enough = k >= 2
    freedom = np.where(enough, k - 1, 1.0)
    half = t.ppf(0.5 + confidence / 2, freedom) * s / np.sqrt(np.where(enough, k, 1.0))
    return np.where(enough, m - half, np.nan), np.where(enough, m + half, np.nan)


def mean_difference(first: ArrayLike, second: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Welch's interval of mean(first) - mean(second); a point where neither varies, unknown below two values each."""
    from scipy.stats import t

    a, b = np.asarray(first, float), np.asarray(second, float)
    if len(a) < 2 or len(b) < 2:
        return UNKNOWN
    va, vb = a.var(ddof=1) / len(a), b.var(ddof=1) / len(b)
    difference = float(a.mean() - b.mean())
    if va + vb == 0:
        return Interval(difference, difference)
    freedom = (va + vb) ** 2 / (va**2 / (len(a) - 1) + vb**2 / (len(b) - 1))
    half = float(t.ppf(0.5 + confidence / 2, freedom) * np.sqrt(va + vb))
    return Interval(difference - half, difference + half)


def standardised_bias(bias: float, std: float, n: int, confidence: float = CONFIDENCE) -> Interval:
    """Interval of bias / standard deviation (an effect size) from ``n`` normal values.

    Large-sample variance 1/n + d^2/(2n) (Hedges and Olkin 1985, one sample). Where the values do not vary the ratio is
    0 or infinite and known exactly; unknown below two values.
    """
    from scipy.stats import norm

    if n < 2 or not (np.isfinite(bias) and np.isfinite(std)):
        return UNKNOWN
    if std == 0:
        ratio = 0.0 if bias == 0 else float(np.copysign(np.inf, bias))
        return Interval(ratio, ratio)
    ratio = bias / std
    half = float(norm.ppf(0.5 + confidence / 2)) * float(np.sqrt(1 / n + ratio**2 / (2 * n)))
    return Interval(ratio - half, ratio + half)


def bootstrap(
    statistic: Callable[[np.ndarray], np.ndarray],
    n: int,
    *,
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """Percentile bootstrap over ``n`` exchangeable units (repeats, or blocks of pixels).

    ``statistic`` maps indices (resamples, n) to values (resamples,). Resamples whose value is NaN are left out; unknown
    below two units, or where more than half of the values are NaN. The fixed ``seed`` makes reports repeatable.
    """
    if n < 2:
        return UNKNOWN
    indices = np.random.default_rng(seed).integers(0, n, size=(resamples, n))
    return percentiles(np.asarray(statistic(indices), float), confidence)


def percentiles(draws: np.ndarray, confidence: float = CONFIDENCE) -> Interval:
    """Central interval of bootstrap draws (B,); infinite ends stay. NaN draws (such as differences of two infinities)
    are left out, and where they are more than half the interval is unknown."""
    known = draws[~np.isnan(draws)]
    if len(known) < 2 or len(known) < 0.5 * len(draws):
        return UNKNOWN
    low, high = np.quantile(known, [(1 - confidence) / 2, (1 + confidence) / 2], method="inverted_cdf")
    return Interval(float(low), float(high))
