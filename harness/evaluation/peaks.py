"""The threshold for a rate of false calls from the strongest findings of hole-free boards, and its
uncertainty.

The number of findings with a score above t on a board is a Poisson count with mean
(1 + shape (t^2 - place) / scale)^(-1 / shape): a generalised Pareto tail of the square, whose r
highest scores of a board have the density of Coles, An Introduction to Statistical Modeling of
Extreme Values (2001), section 3.5. So ten scores of a board count, where the order statistics of
`intervals.threshold_for_rate` use the highest alone. The squares of Gaussian scores have an
exponential tail, shape 0; heavier tails are above 0, and `SHAPE` penalises the distance from 0.
With 60 simulated boards of 2,000 or 300 Gaussian places, the logarithm of the true rate at the
threshold scatters by 0.41 and 0.32 (order statistics: 0.57 and 0.61); for Student's distribution
with 12 degrees of freedom, by 0.29 (0.45), with a mean rate of 1.27 where 1 is wanted. Standard
errors are sandwiches over boards.
Not modelled: boards that differ in area or noise, and findings that are two above a lower
threshold and one above it. If the boards' highest scores contradict the tail at `LEVEL`, the
threshold is that of order statistics."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import optimize, special

from harness.evaluation.intervals import (
    UPPER,
    Interval,
    threshold_for_rate,
)

LEVEL = 0.01
SHAPE = 0.1  # standard deviation of the shape's penalty
FEWEST_BOARDS = 12
FEWEST_SCORES = 4  # mean number of scores of a board below which no tail is fitted
STEP = 1e-4  # of numeric derivatives, in units of the parameters
FLAT = 1e-6  # a shape so near 0 counts as 0: an exponential tail


@dataclass(frozen=True)
class RateThreshold:
    """A threshold for a rate of false calls, and its uncertainty."""

    value: float
    """Findings above it are calls."""
    error: float
    """Standard error of the threshold at which the rate is as wanted."""
    interval_per_m2: Interval
    """95 % interval of the true rate at ``value``."""
    method: str
    """``tail of the strongest findings`` or ``order statistics``."""


def threshold_from_peaks(
    peaks: Sequence[Sequence[float]], area_m2: float, rate_per_m2: float
) -> RateThreshold:
    """Return the threshold at which so many false calls per square metre are expected.

    ``peaks``: the highest scores of each hole-free run, highest first; ``area_m2``: its area.
    Raises `UserError` if the runs are too few for the rate."""
    return _threshold(tuple(map(tuple, peaks)), area_m2, rate_per_m2)


@lru_cache
def _threshold(
    peaks: tuple[tuple[float, ...], ...], area_m2: float, rate_per_m2: float
) -> RateThreshold:
    """Return the threshold, fitted once for equal scores: set-ups that differ only in their damage
    share the boards that set it, and a run asks when it judges and when it records."""
    highest = np.array([scores[0] for scores in peaks])
    by_order = threshold_for_rate(highest, area_m2, rate_per_m2)
    wanted = rate_per_m2 * area_m2
    tail = fitted_tail(peaks)
    if tail is not None:
        value = tail.score_at(wanted)
        error = tail.error_of_log_count(value)
        half = float(special.ndtri(UPPER)) * error
        low, high = (rate_per_m2 * np.exp([-half, half])).tolist()
        return RateThreshold(
            value=value,
            error=error / tail.hazard(value),
            interval_per_m2=Interval(low, high),
            method="tail of the strongest findings",
        )
    return _by_order(highest, area_m2, by_order.value, by_order.calling_runs)


def _by_order(highest: np.ndarray, area_m2: float, value: float, above: int) -> RateThreshold:
    """Return a threshold of order statistics. The true probability that a run exceeds it is
    Beta(above + 1, runs - above) distributed (Wilks 1941); its standard error is a quarter of the
    distance between the scores with two standard errors more and fewer runs above."""
    runs = len(highest)
    shares = np.array([1 - UPPER, UPPER])
    probabilities = special.betaincinv(above + 1, max(runs - above, 1), shares)
    low, high = -np.log1p(-probabilities) / area_m2
    falling = np.sort(highest)[::-1]
    spread = 2 * np.sqrt(above + 1)
    ranks = np.clip([above - spread, above + spread], 0, runs - 1)
    upper, lower = np.interp(ranks, np.arange(runs), falling)
    return RateThreshold(
        value=value,
        error=float(upper - lower) / 4,
        interval_per_m2=Interval(float(low), float(high)),
        method="order statistics",
    )


@dataclass(frozen=True, eq=False)
class ScoreTail:
    """The mean number of findings of a board above a score, a tail of the scores' squares."""

    location: float
    """Square of the score above which one finding is expected."""
    log_scale: float
    """Logarithm of the scale."""
    shape: float
    """Shape: 0 for an exponential tail, negative for one with an end."""
    covariance: np.ndarray
    """Covariance (3, 3) of these parameters."""

    @property
    def parameters(self) -> np.ndarray:
        """Location, logarithm of the scale, shape."""
        return np.array([self.location, self.log_scale, self.shape])

    def score_at(self, count: float) -> float:
        """Return the score above which so many findings of a board are expected."""
        scale = np.exp(self.log_scale)
        square = self.location - scale * np.log(count)
        if abs(self.shape) >= FLAT:
            square = self.location + scale * np.expm1(-self.shape * np.log(count)) / self.shape
        return float(np.sqrt(max(square, 0.0)))

    def log_count(self, score: float) -> float:
        """Return the logarithm of the number of findings above a score; -inf beyond the end."""
        return float(_log_counts(self.parameters, np.array(score**2)))

    def hazard(self, score: float) -> float:
        """Return the slope by which that logarithm falls with the score."""
        scale = np.exp(self.log_scale)
        return float(2 * score / (scale + self.shape * (score**2 - self.location)))

    def error_of_log_count(self, score: float) -> float:
        """Return the standard error of that logarithm, by the delta method."""
        gradient = []
        for step in np.eye(3) * STEP:
            above = _log_counts(self.parameters + step, np.array(score**2))
            below = _log_counts(self.parameters - step, np.array(score**2))
            gradient.append(float(above - below) / (2 * STEP))
        slope = np.array(gradient)
        return float(np.sqrt(slope @ self.covariance @ slope))


def fitted_tail(peaks: Sequence[Sequence[float]]) -> ScoreTail | None:
    """Return the likeliest tail; None if there are too few scores or the runs' highest scores
    contradict it."""
    boards = len(peaks)
    counts = np.array([len(scores) for scores in peaks])
    scores = np.concatenate([np.asarray(values, float) ** 2 for values in peaks])
    if boards < FEWEST_BOARDS or counts.mean() < FEWEST_SCORES or not np.ptp(scores) > 0:
        return None
    board = np.repeat(np.arange(boards), counts)
    lowest = np.array([values[-1] ** 2 for values in peaks])

    def of_boards(parameters: np.ndarray) -> np.ndarray:
        """Return the log-likelihood (boards,), each with its part of the penalty."""
        log_scale, shape = parameters[1:]
        log_counts = _log_counts(parameters, scores)
        density = (1.0 + shape) * log_counts - log_scale
        penalty = 0.5 * (shape / SHAPE) ** 2 / boards
        none_above = np.exp(_log_counts(parameters, lowest))
        return np.asarray(np.bincount(board, density, boards) - none_above - penalty)

    def loss(parameters: np.ndarray) -> float:
        value = -float(of_boards(parameters).sum())
        return value if np.isfinite(value) else 1e12

    highest = np.array([values[0] ** 2 for values in peaks])
    excess = max(float((scores - lowest[board]).mean()), 1e-6)
    start = np.array([float(np.median(highest)), np.log(excess / 2), 0.0])
    end = optimize.minimize(
        loss, start, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-6, "maxiter": 2000}
    )
    covariance = _sandwich(of_boards, end.x)
    if not end.success or covariance is None:
        return None
    # the probability that a board's highest score is at most as high: even, if the tail is right
    below = np.exp(-np.exp(_log_counts(end.x, highest)))
    if is_uneven(below):
        return None
    location, log_scale, shape = end.x.tolist()
    return ScoreTail(location, log_scale, shape, covariance)


def is_uneven(values: np.ndarray) -> bool:
    """Return whether values (n,) contradict an even distribution from 0 to 1 at `LEVEL`, by
    Kolmogorov's test. Its p-value lies between that of one side, by Smirnov's law, and twice as
    much, which nearly always decides: SciPy's own test needs a package that takes a third of a
    second to load."""
    ordered = np.sort(values)
    shares = np.arange(len(ordered) + 1) / len(ordered)
    distance = max((shares[1:] - ordered).max(), (ordered - shares[:-1]).max())
    one_sided = float(special.smirnov(len(ordered), distance))
    if one_sided >= LEVEL:
        return False
    if 2 * one_sided < LEVEL:
        return True
    from scipy import stats

    return bool(stats.kstest(values, "uniform").pvalue < LEVEL)


def _log_counts(parameters: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Return the logarithm of the mean number of findings above scores with these squares; -inf
    beyond the end."""
    location, log_scale, shape = parameters
    z = (square - location) / np.exp(log_scale)
    if abs(shape) < FLAT:
        return np.asarray(-z)
    with np.errstate(invalid="ignore", divide="ignore"):
        logs = -np.log1p(shape * z) / shape
    return np.where(1.0 + shape * z > 0, logs, -np.inf)


def _sandwich(of_boards: Callable[[np.ndarray], np.ndarray], best: np.ndarray) -> np.ndarray | None:
    """Return the covariance (3, 3) of the parameters, from the boards' own gradients; None where
    the likelihood has no maximum."""
    steps = np.eye(3) * STEP
    scores = np.stack(
        [(of_boards(best + step) - of_boards(best - step)) / (2 * STEP) for step in steps], axis=1
    )
    hessian = np.empty((3, 3))
    for row, first in enumerate(steps):
        for column, second in enumerate(steps):
            corners = (
                of_boards(best + first + second).sum()
                - of_boards(best + first - second).sum()
                - of_boards(best - first + second).sum()
                + of_boards(best - first - second).sum()
            )
            hessian[row, column] = corners / (4 * STEP**2)
    if not np.isfinite(hessian).all() or np.linalg.eigvalsh(-hessian).min() <= 0:
        return None
    inverse = np.linalg.inv(-hessian)
    boards = len(scores)
    return np.asarray(inverse @ (scores.T @ scores) @ inverse * boards / (boards - 1))
