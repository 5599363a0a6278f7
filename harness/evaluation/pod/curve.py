"""A probability of detection curve, its four links, and the likelihood of hits and misses under
them.

POD(a) = F((x - mu) / sigma), x = a or ln a. So mu is the 50 % size for logit and probit only;
sigma is the width. For all links, ln F and ln(1 - F) are concave, so the likelihood has one
maximum if hits and misses overlap; if they do not, Firth's penalty makes the estimate finite.
Sources: McCullagh and Nelder, Generalized Linear Models (1989), 2.5 and 4.3; Firth, Biometrika 80
(1993), 27, in the form of Kosmidis and Firth, 96 (2009), 793."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import optimize, special

LARGEST_PREDICTOR = 500.0
"""Limit of |b0 + b1 z|: beyond it, every link is 0 or 1 to the last bit; exp() of the limit does
not overflow."""

Function = Callable[[np.ndarray], np.ndarray]
_CDF: dict[str, Function] = {
    "logit": special.expit,
    "probit": special.ndtr,
    "cloglog": lambda t: -np.expm1(-np.exp(t)),
    "loglog": lambda t: np.exp(-np.exp(-t)),
}
_INVERSE: dict[str, Function] = {
    "logit": special.logit,
    "probit": special.ndtri,
    "cloglog": lambda p: np.log(-np.log1p(-p)),
    "loglog": lambda p: -np.log(-np.log(p)),
}
_LOG_CDF: dict[str, Function] = {
    "logit": lambda t: np.minimum(t, 0.0) - np.log1p(np.exp(-np.abs(t))),
    "probit": special.log_ndtr,
    "cloglog": lambda t: np.log(-np.expm1(-np.exp(t))),
    "loglog": lambda t: -np.exp(-t),
}
_MIRRORED = {"logit": "logit", "probit": "probit", "cloglog": "loglog", "loglog": "cloglog"}
LINKS = tuple(_CDF)
# Curves times targets, or resampled boards times their targets, in one block: arrays of 256 kB,
# whose memory is used again. Arrays of 1 MB get new memory, which takes three times as long.
CELLS = 2**15


def link_cdf(link: str, t: np.ndarray) -> np.ndarray:
    """Return F(t) for one of `LINKS`: logistic, normal, 1 - exp(-exp(t)) (cloglog), exp(-exp(-t))
    (loglog)."""
    with np.errstate(over="ignore"):
        return np.asarray(_CDF[link](np.asarray(t, float)))


def link_ppf(link: str, p: np.ndarray) -> np.ndarray:
    """Return F^-1(p) for one of `LINKS`."""
    return np.asarray(_INVERSE[link](np.asarray(p, float)))


def _limited(predictor: np.ndarray) -> np.ndarray:
    """Return predictors within `LARGEST_PREDICTOR`; `np.clip` takes five times as long."""
    return np.asarray(np.minimum(np.maximum(predictor, -LARGEST_PREDICTOR), LARGEST_PREDICTOR))


def logs_of_link(link: str, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ln F, ln(1 - F) and ln f (the density), each of the predictor's shape and accurate in
    both tails."""
    t = _limited(predictor)
    if link == "logit":
        tail = np.log1p(np.exp(-np.abs(t)))
        log_hit = np.minimum(t, 0.0) - tail
        log_miss = np.minimum(-t, 0.0) - tail
        return log_hit, log_miss, log_hit + log_miss
    if link == "probit":
        return special.log_ndtr(t), special.log_ndtr(-t), -0.5 * t * t - 0.5 * np.log(2.0 * np.pi)
    signed = t if link == "cloglog" else -t
    hazard = np.exp(signed)
    log_none = -hazard
    log_any = np.log(-np.expm1(-hazard))
    log_density = signed - hazard
    if link == "cloglog":
        return log_any, log_none, log_density
    return log_none, log_any, log_density


def log_likelihoods(
    link: str, predictor: np.ndarray, hits: np.ndarray, misses: np.ndarray
) -> np.ndarray:
    """Return hits ln F + misses ln(1 - F) (n, m) from the predictors (n, m) of n rows on m curves
    and the counts (n,). Most rows were only hit or only missed, so this takes half the logarithms
    of `logs_of_link`."""
    t = _limited(predictor)
    values = np.zeros_like(t)
    has_hits = hits > 0
    values[has_hits] = hits[has_hits, None] * _LOG_CDF[link](t[has_hits])
    missed = misses > 0
    # 1 - F(t) is the mirrored link at -t
    values[missed] += misses[missed, None] * _LOG_CDF[_MIRRORED[link]](-t[missed])
    return values


def slopes_of_link(link: str, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return f / F, f / (1 - F) and d ln f / dt at t = predictor, each of the predictor's shape."""
    t = _limited(predictor)
    if link == "logit":  # the most common link: the ratios are the probabilities themselves
        # both from one exponential, in a quarter of the time of two of SciPy's `expit`
        small = np.exp(-np.abs(t))
        large_share = 1.0 / (1.0 + small)
        small_share = small * large_share
        hit = np.where(t > 0, large_share, small_share)
        miss = np.where(t > 0, small_share, large_share)
        return miss, hit, miss - hit
    log_hit, log_miss, log_density = logs_of_link(link, t)
    return np.exp(log_density - log_hit), np.exp(log_density - log_miss), _bend(link, t)


def _log_density(link: str, t: np.ndarray) -> np.ndarray:
    """Return ln f of any link but logit, at limited predictors."""
    if link == "probit":
        return np.asarray(-0.5 * t * t - 0.5 * np.log(2.0 * np.pi))
    signed = t if link == "cloglog" else -t
    return np.asarray(signed - np.exp(signed))


def _bend(link: str, t: np.ndarray) -> np.ndarray:
    """Return d ln f / dt of any link but logit, at limited predictors."""
    if link == "probit":
        return -t
    if link == "cloglog":
        return np.asarray(1.0 - np.exp(t))
    return np.asarray(np.exp(-t) - 1.0)


@dataclass(frozen=True)
class PodCurve:
    """A curve POD(a) = F((x - mu) / sigma)."""

    link: str
    """Name of F, one of `LINKS`."""
    log_size: bool
    """True if x is the logarithm of the size."""
    mu: float
    """Middle of the curve, in the unit of x."""
    sigma: float
    """Width of the curve, in the unit of x."""
    covariance: np.ndarray
    """Covariance (2, 2) of mu and sigma."""

    def pod(self, size: np.ndarray) -> np.ndarray:
        """Return the POD at sizes of any shape."""
        x = np.log(size) if self.log_size else np.asarray(size, float)
        return link_cdf(self.link, (x - self.mu) / self.sigma)

    def size_at(self, pod: float) -> float:
        """Return the size with this POD."""
        x = self.mu + self.sigma * float(link_ppf(self.link, np.array(pod)))
        return float(np.exp(x)) if self.log_size else x


@dataclass(frozen=True)
class Bound:
    """An upper confidence bound on a size, such as a90/95."""

    pod: float
    """The POD of that size."""
    confidence: float
    """One-sided confidence."""
    method: str
    """Method by which the bound was computed, in words."""
    value: float
    """The bound, in the unit of sizes; infinite if there is none."""
    why: str = ""
    """Reason why there is none; else empty."""

    @property
    def demonstrated(self) -> bool:
        """Return whether there is a finite bound."""
        return bool(np.isfinite(self.value))


STEPS = 200
PLAIN_STEPS = 12
"""Most steps, with halvings, of a problem; number of plain Newton steps before: five or six
usually suffice."""
TOLERANCE = 1e-7  # a search ends with a smaller step: every Newton step squares the error
CLIMBED = 6  # number of steep starts that are tried in the search for a penalised maximum
PENALISED_SLOPES = np.linspace(np.log(1e-8), np.log(1e4), 140)
"""Natural logarithms of the slopes at which the search of a penalised profile starts."""


class _Outcome(NamedTuple):
    """Hits, or misses: their probability is F(t) of a link, with t the predictor times a sign."""

    # rows (k,) that have this outcome in any study
    rows: np.ndarray
    # how often (..., k) they have it
    counts: np.ndarray
    # the study's link for hits, the mirrored link for misses
    link: str
    # 1 for hits, -1 for misses
    sign: float

    def of_rows(self, predictor: np.ndarray) -> np.ndarray:
        """Return t (..., k) from the predictors (..., n) of all rows."""
        return np.asarray(self.sign * predictor[..., self.rows])


@dataclass(frozen=True, eq=False)
class HitsAndMisses:
    """Hits and misses of one or several (d) studies on the same rows, and their likelihood."""

    design: np.ndarray
    """Columns (n, p) of the predictor; the second holds the sizes."""
    hits: np.ndarray
    """Counts of hits (n,) or (d, n)."""
    misses: np.ndarray
    """Counts of misses (n,) or (d, n)."""
    link: str
    """Name of F, one of `LINKS`."""
    penalty: np.ndarray | float | None = None
    """Multiple of Jeffreys' prior, a number or (d,), with p = 2 only: None for no penalty, 1 for
    Firth's, k if every target has k rows."""
    offset: float = 0.0
    """A number that is added to every predictor."""

    @property
    def z(self) -> np.ndarray:
        """The sizes (n,): the design's second column."""
        return np.asarray(self.design[:, 1])

    def value(self, b: np.ndarray) -> np.ndarray:
        """Return the (penalised) log-likelihood (...) at coefficients (..., p); for several
        studies (d,) at (d, p)."""
        if self.penalty is None and self.hits.ndim == 1 and b.ndim == 2:
            by_row = self.design @ b.T + self.offset
            rows = log_likelihoods(self.link, by_row, self.hits, self.misses)
            return np.asarray(rows.sum(axis=0))
        predictor = _limited(b @ self.design.T + self.offset)
        if self.penalty is None:
            return self._plain_value(predictor, self._outcome_logs(predictor))
        log_hit, log_miss, log_density = logs_of_link(self.link, predictor)
        weight = (self.hits + self.misses) * np.exp(2.0 * log_density - log_hit - log_miss)
        total = weight.sum(-1)
        cross = weight @ self.z
        square = weight @ self.z**2
        with np.errstate(divide="ignore", invalid="ignore"):
            scatter = np.maximum(square - cross**2 / total, 0.0)
            prior = 0.5 * (np.log(total) + np.log(scatter))
        value = (self.hits * log_hit + self.misses * log_miss).sum(axis=-1)
        return np.asarray(value + self.penalty * np.where(np.isfinite(prior), prior, -np.inf))

    @cached_property
    def _outcomes(self) -> tuple[_Outcome, _Outcome]:
        """The hits and the misses. Most rows have one outcome only, in all studies."""
        outcomes = []
        sides = ((self.hits, self.link, 1.0), (self.misses, _MIRRORED[self.link], -1.0))
        for counts, link, sign in sides:
            rows = np.flatnonzero(counts.reshape(-1, counts.shape[-1]).any(axis=0))
            outcomes.append(_Outcome(rows, counts[..., rows], link, sign))
        return outcomes[0], outcomes[1]

    def _outcome_logs(self, predictor: np.ndarray) -> list[np.ndarray]:
        """Return the logarithms (..., k) of the probability of each of the `_outcomes`."""
        logs = []
        for outcome in self._outcomes:
            logs.append(_LOG_CDF[outcome.link](outcome.of_rows(predictor)))
        return logs

    def _plain_value(self, predictor: np.ndarray, logs: list[np.ndarray]) -> np.ndarray:
        """Return the log-likelihood (...) without a penalty, from the `_outcome_logs`."""
        of_rows = np.zeros_like(predictor)
        for outcome, log_probability in zip(self._outcomes, logs, strict=True):
            of_rows[..., outcome.rows] += outcome.counts * log_probability
        return np.asarray(of_rows.sum(axis=-1))

    def step(self, b: np.ndarray) -> np.ndarray:
        """Return Newton steps (d, p) of (d,) studies at b (d, p); with a penalty, scoring steps.
        They are meaningless if the information is singular, in studies that diverge to infinity.
        """
        with np.errstate(all="ignore"):
            if self.penalty is not None:
                return self._penalised_step(b)
            predictor = _limited(b @ self.design.T + self.offset)
            return self._newton_step(predictor, self._outcome_logs(predictor))

    def _newton_step(self, predictor: np.ndarray, logs: list[np.ndarray]) -> np.ndarray:
        """Solve the observed information for the gradient of the log-likelihood at limited
        predictors (d, n), of which ``logs`` are the `_outcome_logs`."""
        if self.link == "logit":  # the same in fewer operations
            up, down, _ = slopes_of_link(self.link, predictor)
            slope = self.hits * up - self.misses * down
            weight = (self.hits + self.misses) * up * down
        else:
            slope = np.zeros_like(predictor)
            weight = np.zeros_like(predictor)
            for outcome, log_probability in zip(self._outcomes, logs, strict=True):
                t = outcome.of_rows(predictor)
                ratio = np.exp(_log_density(outcome.link, t) - log_probability)
                scaled = outcome.counts * ratio
                slope[..., outcome.rows] += outcome.sign * scaled
                bend = _bend(outcome.link, t)
                weight[..., outcome.rows] += scaled * np.maximum(ratio - bend, 0.0)
        columns = self.design.shape[1]
        if columns == 1:
            return np.asarray((slope @ self.design) / (weight @ self.design**2))
        products = self.design[:, :, None] * self.design[:, None, :]
        information = weight @ products.reshape(-1, columns * columns)
        information = information.reshape(-1, columns, columns)
        trace = np.trace(information, axis1=1, axis2=2)[:, None, None]
        ridge = (1e-12 * trace + 1e-300) * np.eye(columns)
        gradient = (slope @ self.design)[:, :, None]
        return np.asarray(np.linalg.solve(information + ridge, gradient)[:, :, 0])

    def _penalised_step(self, b: np.ndarray) -> np.ndarray:
        """Solve the expected information (total, cross; cross, square) for the gradient of the
        penalised log-likelihood, whose penalty adds half of each row's leverage times
        d ln(weight) / dt."""
        up, down, bend = slopes_of_link(self.link, b @ self.design.T + self.offset)
        slope = self.hits * up - self.misses * down
        z = self.z
        weight = (self.hits + self.misses) * up * down
        total = weight.sum(axis=1)
        cross = weight @ z
        square = weight @ z**2
        determinant = total * (square - cross**2 / total)
        leverage = weight * (square[:, None] - 2 * cross[:, None] * z + total[:, None] * z**2)
        leverage /= determinant[:, None]
        half_penalty = 0.5 * np.asarray(self.penalty)[:, None]
        slope = slope + half_penalty * leverage * (2.0 * bend - up + down)
        by_intercept = slope.sum(axis=1)
        by_slope = slope @ z
        adjugate_times_gradient = [
            square * by_intercept - cross * by_slope,
            total * by_slope - cross * by_intercept,
        ]
        return np.asarray(np.stack(adjugate_times_gradient, axis=1) / determinant[:, None])

    def select(self, studies: np.ndarray) -> HitsAndMisses:
        """Return the data of these ``studies`` (indices or (d,) bool)."""
        penalty = self.penalty
        if penalty is not None:
            penalty = np.broadcast_to(penalty, len(self.hits))[studies]
        return replace(self, hits=self.hits[studies], misses=self.misses[studies], penalty=penalty)

    def climb(self, b: np.ndarray, studies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values (k,) and steps (k, p) of k ``studies`` at b (k, p), for `ascend`."""
        is_all = self.penalty is None and len(studies) == len(self.hits)
        chosen = self if is_all else self.select(studies)
        if self.penalty is not None:
            value = chosen.value(b)
            step = chosen.step(b)
        else:
            predictor = _limited(b @ self.design.T + self.offset)
            logs = chosen._outcome_logs(predictor)
            value = chosen._plain_value(predictor, logs)
            with np.errstate(all="ignore"):
                step = chosen._newton_step(predictor, logs)
        return np.where(np.isfinite(value), value, -np.inf), step


def ascend(
    value_and_step: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    start: np.ndarray,
    tolerance: float = TOLERANCE,
) -> tuple[np.ndarray, np.ndarray]:
    """Climb from ``start`` (d, p) to maxima (d, p) and their values (d,), by
    ``value_and_step(b (k, p), problems (k,))``. A step that lowers the value is halved. A
    problem without a maximum ends at its last step."""
    b = start.copy()
    moving = np.arange(len(start))
    best, step = value_and_step(b, moving)
    for _ in range(STEPS):
        length = np.abs(step[moving]).max(axis=1)
        moving = moving[length > tolerance * (1.0 + np.abs(b[moving]).max(axis=1))]
        if not len(moving):
            break
        trial = b[moving] + step[moving]
        value, next_step = value_and_step(trial, moving)
        better = value >= best[moving] - 1e-13 * np.abs(value)
        ahead = moving[better]
        b[ahead] = trial[better]
        step[ahead] = next_step[better]
        best[ahead] = np.maximum(value[better], best[ahead])
        step[moving[~better]] *= 0.5
    return b, best


def maxima(
    data: HitsAndMisses,
    start: np.ndarray,
    tolerance: float = TOLERANCE,
) -> np.ndarray:
    """Return the coefficients (d, p) with the largest likelihood of several studies, from
    ``start`` (p,); without a penalty. If hits and misses of a study do not overlap, its
    coefficients are those of the last step.

    Plain Newton steps need no values and nearly always reach the maximum. The other studies are
    searched again, and so are those that end lower than they began: where probabilities are
    rounded to 0 or 1, steps can be small without a maximum."""
    begin = np.tile(np.asarray(start, float), (len(data.hits), 1))
    b = begin.copy()
    moving = np.arange(len(b))
    for _ in range(PLAIN_STEPS):
        if not len(moving):
            break
        chosen = data if len(moving) == len(b) else data.select(moving)
        with np.errstate(all="ignore"):
            step = chosen.step(b[moving])
            b[moving] += step
        moving = moving[~(np.abs(step).max(axis=1) <= tolerance)]
    with np.errstate(all="ignore"):
        lower = np.flatnonzero(~(data.value(b) >= data.value(begin)))
        again = np.union1d(moving, lower)
    b[again], _ = ascend(data.select(again).climb, begin[again], tolerance)
    return b


def penalised_maxima(data: HitsAndMisses, tolerance: float = TOLERANCE) -> np.ndarray:
    """Return the intercepts and slopes (d, 2) with the largest penalised likelihood of several
    studies; they are finite for separated data too. Logit and probit have one maximum. For cloglog
    and loglog, the highest of those is returned that are reached from a flat start, the gap
    between largest miss and smallest hit, and the best `CLIMBED` others."""
    z = data.z
    hits = data.hits
    largest_miss = np.where(data.misses > 0, z, -np.inf).max(axis=1)
    gap = np.where(hits > 0, z, np.inf).min(axis=1) - largest_miss

    def crossing_gap(slope: np.ndarray, share: float) -> np.ndarray:
        """Return curves (d, 2) whose predictor is 0 after this share of the gap."""
        return np.stack([-slope * (largest_miss + share * gap), slope], axis=1)

    # predictors of -1.5 and 1.5 at the ends of the gap, if these are not too close
    through_gap = crossing_gap(np.clip(3.0 / np.maximum(gap, 1e-9), 1.0, 100.0), 0.5)
    if data.link in ("logit", "probit"):
        return ascend(data.climb, through_gap, tolerance)[0]
    # several widths through both ends of the gap and its middle
    steep = [through_gap]
    for slope in np.geomspace(1.5, 150.0, 9):
        for share in (0.0, 0.5, 1.0):
            steep.append(crossing_gap(np.full_like(gap, slope), share))
    hit_rate = hits.sum(axis=1) / (hits + data.misses).sum(axis=1)
    flat = np.stack([link_ppf(data.link, hit_rate), np.ones(len(hits))], axis=1)
    # the start with the highest value can lie in the basin of a lower maximum, so several of the
    # best are climbed
    order = np.argsort([-data.value(start) for start in steep], axis=0, kind="stable")
    studies = np.arange(len(hits))
    starts = [flat, through_gap]
    for rank in range(CLIMBED):
        starts.append(np.array(steep)[order[rank], studies])
    ends = []
    values = []
    for start in starts:
        end, value = ascend(data.climb, start, tolerance)
        ends.append(end)
        values.append(value)
    return np.asarray(np.array(ends)[np.argmax(values, axis=0), studies])


def profile(
    data: HitsAndMisses,
    z0: float,
    level: float,
    slope: float = 1.0,
) -> tuple[float, float]:
    """Return the largest (penalised) log-likelihood of one study's rising curves (slope >= 0)
    whose predictor is ``level`` at ``z0``, and the slope there. ``slope``: start of the search,
    such as that of a neighbour."""
    if data.penalty is not None:
        return _penalised_profile(data, z0, level), slope
    line = replace(
        data,
        design=data.z[:, None] - z0,
        offset=level,
        hits=data.hits[None],
        misses=data.misses[None],
    )
    # far out, only slopes near that of the line through the mean probability have a likelihood
    # that is not tiny
    mean_level = float(link_ppf(data.link, _hit_rate(data)))
    starts = np.array([[slope], [(level - mean_level) / max(z0, 1.0)]])
    values = np.concatenate([line.value(start[None]) for start in starts])
    best, _ = ascend(line.climb, starts[[np.argmax(values)]], 1e-5)
    best = np.maximum(best, 0.0)
    return float(line.value(best)[0]), float(best[0, 0])


def _hit_rate(data: HitsAndMisses) -> np.ndarray:
    """Return the share of hits in one study, a scalar array."""
    return np.asarray(data.hits.sum() / (data.hits + data.misses).sum())


def _penalised_profile(
    data: HitsAndMisses,
    z0: float,
    level: float,
) -> float:
    """Return the profile of a penalised likelihood; concavity is not proved, so the search begins
    with a grid."""

    def value_at(log_slope: np.ndarray) -> np.ndarray:
        slope = np.exp(log_slope)
        return data.value(np.stack([level - slope * z0, slope], axis=-1))

    flat = float(data.value(np.array([level, 0.0])))
    return max(_largest(value_at, PENALISED_SLOPES), flat)


def flat_maximum(data: HitsAndMisses, highest: float) -> float:
    """Return the largest (penalised) log-likelihood of one study's flat curves, with a predictor
    of at most ``highest``: the limit of `profile` as ``z0`` grows to infinity."""
    if data.penalty is None:
        mean_level = float(link_ppf(data.link, _hit_rate(data)))
        return float(data.value(np.array([min(highest, mean_level), 0.0])))

    def value_at(level: np.ndarray) -> np.ndarray:
        return data.value(np.stack([level, 0.0 * level], axis=-1))

    largest = _largest(value_at, np.linspace(highest - 12.0, highest, 400))
    return max(largest, float(value_at(np.array(highest))))


def _largest(function: Callable[[np.ndarray], np.ndarray], grid: np.ndarray) -> float:
    """Return the largest value of a function of one number, refined around the best point of a
    grid."""
    best = int(np.argmax(function(grid)))
    low = grid[max(best - 1, 0)]
    high = grid[min(best + 1, len(grid) - 1)]
    lowest = optimize.minimize_scalar(
        lambda point: -float(function(np.asarray(point))),
        bounds=(low, high),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return -float(lowest.fun)
