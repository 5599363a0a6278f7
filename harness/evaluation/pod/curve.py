"""A probability of detection curve, its four links, and the likelihood of hits and misses under them.

POD(a) = F((x - mu) / sigma), x = a or ln a. So mu is the 50 % size for logit and probit only; sigma is the width. For
all links ln F and ln(1 - F) are concave, so there is one maximum wherever hits and misses overlap; where they do not,
Firth's penalty makes the estimate finite. Sources: McCullagh and Nelder, Generalized Linear Models (1989), 2.5 and 4.3;
Firth, Biometrika 80 (1993), 27, in the form of Kosmidis and Firth, 96 (2009), 793."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize, special

LARGEST_PREDICTOR = 500.0
"""|b0 + b1 z| beyond which every link is 0 or 1 to the last bit; exp() of it does not overflow."""

_F_AND_INVERSE: dict[str, tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]] = {
    "logit": (special.expit, special.logit),
    "probit": (special.ndtr, special.ndtri),
    "cloglog": (lambda t: -np.expm1(-np.exp(t)), lambda p: np.log(-np.log1p(-p))),
    "loglog": (lambda t: np.exp(-np.exp(-t)), lambda p: -np.log(-np.log(p))),
}
LINKS = tuple(_F_AND_INVERSE)
CELLS = 2**17
"""Number of curves times targets at a time, or of boards drawn again times theirs: 1 MB an array."""


def link_cdf(link: str, t: np.ndarray) -> np.ndarray:
    """Return F(t) of one of `LINKS`: logistic, normal, 1 - exp(-exp(t)) (cloglog), exp(-exp(-t)) (loglog)."""
    with np.errstate(over="ignore"):
        return np.asarray(_F_AND_INVERSE[link][0](np.asarray(t, float)))


def link_ppf(link: str, p: np.ndarray) -> np.ndarray:
    """Return F^-1(p) of one of `LINKS`."""
    return np.asarray(_F_AND_INVERSE[link][1](np.asarray(p, float)))


def logs_of_link(link: str, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ln F, ln(1 - F) and ln f (the density) at the predictor, each of its shape and exact in both tails."""
    t = np.clip(predictor, -LARGEST_PREDICTOR, LARGEST_PREDICTOR)
    if link == "logit":
        tail = np.log1p(np.exp(-np.abs(t)))
        log_hit, log_miss = np.minimum(t, 0.0) - tail, np.minimum(-t, 0.0) - tail
        return log_hit, log_miss, log_hit + log_miss
    if link == "probit":
        return special.log_ndtr(t), special.log_ndtr(-t), -0.5 * t * t - 0.5 * np.log(2.0 * np.pi)
    signed = t if link == "cloglog" else -t
    hazard = np.exp(signed)
    nearer, other = -hazard, np.log(-np.expm1(-hazard))
    return (other, nearer, signed - hazard) if link == "cloglog" else (nearer, other, signed - hazard)


def slopes_of_link(link: str, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return f / F, f / (1 - F) and d ln f / dt at t = predictor, each of its shape."""
    t = np.clip(predictor, -LARGEST_PREDICTOR, LARGEST_PREDICTOR)
    if link == "logit":  # the most usual link, for which the ratios are the shares themselves
        hit, miss = special.expit(t), special.expit(-t)
        return miss, hit, miss - hit
    log_hit, log_miss, log_density = logs_of_link(link, t)
    bend = {"probit": lambda: -t, "cloglog": lambda: 1.0 - np.exp(t), "loglog": lambda: np.exp(-t) - 1.0}[link]()
    return np.exp(log_density - log_hit), np.exp(log_density - log_miss), bend


@dataclass(frozen=True)
class PodCurve:
    """``mu``, ``sigma`` in the unit of x (size, or ln size where ``log_size``); ``covariance`` (2, 2) of the two."""

    link: str
    log_size: bool
    mu: float
    sigma: float
    covariance: np.ndarray

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
    """An upper confidence bound on a size, such as a90/95. Infinite, with ``why``, where there is none."""

    pod: float
    confidence: float
    method: str
    value: float
    why: str = ""

    @property
    def demonstrated(self) -> bool:
        """Return whether there is a finite bound."""
        return bool(np.isfinite(self.value))


STEPS, PLAIN_STEPS = 200, 12
"""Most steps and halvings of a problem, and Newton steps that are tried first; five or six are usual."""
TOLERANCE = 1e-7
"""The search has arrived at a step below this: Newton's errors are squared with every step."""
CLIMBED = 6
"""Number of steep starts from which the search for a penalised maximum climbs."""
PENALISED_SLOPES = np.linspace(np.log(1e-8), np.log(1e4), 140)
"""Natural logarithms of the slopes with which the search of a penalised profile begins."""


@dataclass(frozen=True, eq=False)
class HitsAndMisses:
    """Hits and misses of one study or of several (d) on the same rows. ``design`` (n, p): columns of the predictor;
    ``hits``, ``misses`` (n,) or (d, n) counts. ``penalty`` (a number, or (d,)): how often Jeffreys' prior is added:
    None for never, 1 for Firth's, k where every target has k rows; for p = 2 only."""

    design: np.ndarray
    hits: np.ndarray
    misses: np.ndarray
    link: str
    penalty: np.ndarray | float | None = None
    offset: float = 0.0

    @property
    def z(self) -> np.ndarray:
        """The sizes (n,): the design's second column."""
        return np.asarray(self.design[:, 1])

    def value(self, b: np.ndarray) -> np.ndarray:
        """Return the (penalised) log-likelihood (...) at coefficients (..., p); of several studies (d,) at (d, p)."""
        found, missed, density = logs = logs_of_link(self.link, b @ self.design.T + self.offset)
        value = (self.hits * found + self.misses * missed).sum(axis=-1)
        if self.penalty is not None:
            weight = (self.hits + self.misses) * np.exp(2.0 * density - logs[0] - logs[1])
            total, cross, square = weight.sum(-1), weight @ self.z, weight @ self.z**2
            with np.errstate(divide="ignore", invalid="ignore"):
                prior = 0.5 * (np.log(total) + np.log(np.maximum(square - cross**2 / total, 0.0)))
            value = value + self.penalty * np.where(np.isfinite(prior), prior, -np.inf)
        return np.asarray(value)

    def step(self, b: np.ndarray) -> np.ndarray:
        """Return Newton steps (d, p) of (d,) studies at b (d, p), scoring steps under a penalty; they mean nothing
        where the information is singular, in studies that have run off to infinity."""
        up, down, bend = slopes_of_link(self.link, b @ self.design.T + self.offset)
        slope = self.hits * up - self.misses * down
        with np.errstate(all="ignore"):
            if self.penalty is not None:
                z, weight = self.z, (self.hits + self.misses) * up * down
                total, cross, square = weight.sum(axis=1), weight @ z, weight @ z**2
                determinant = total * (square - cross**2 / total)
                leverage = weight * (square[:, None] - 2 * cross[:, None] * z + total[:, None] * z**2)
                leverage /= determinant[:, None]
                slope = slope + 0.5 * np.asarray(self.penalty)[:, None] * leverage * (2.0 * bend - up + down)
                first, second = slope.sum(axis=1), slope @ z
                along = np.stack([square * first - cross * second, total * second - cross * first], axis=1)
                return np.asarray(along / determinant[:, None])
            if self.link == "logit":  # the same in fewer operations
                weight = (self.hits + self.misses) * up * down
            else:
                weight = self.hits * up * np.maximum(up - bend, 0.0) + self.misses * down * np.maximum(down + bend, 0.0)
            p = self.design.shape[1]
            if p == 1:
                return np.asarray((slope @ self.design) / (weight @ self.design**2))
            products = (self.design[:, :, None] * self.design[:, None, :]).reshape(-1, p * p)
            information = (weight @ products).reshape(-1, p, p)
            ridge = (1e-12 * np.trace(information, axis1=1, axis2=2)[:, None, None] + 1e-300) * np.eye(p)
            return np.asarray(np.linalg.solve(information + ridge, (slope @ self.design)[:, :, None])[:, :, 0])

    def of(self, rows: np.ndarray) -> HitsAndMisses:
        """Return some of several studies."""
        penalty = None if self.penalty is None else np.broadcast_to(self.penalty, len(self.hits))[rows]
        return replace(self, hits=self.hits[rows], misses=self.misses[rows], penalty=penalty)

    def climb(self, places: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values and steps of the studies ``which``, for `ascend`."""
        some = self.of(which)
        value = some.value(places)
        return np.where(np.isfinite(value), value, -np.inf), some.step(places)


def ascend(
    value_and_step: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    start: np.ndarray,
    tolerance: float = TOLERANCE,
) -> tuple[np.ndarray, np.ndarray]:
    """Climb from ``start`` (d, p) to maxima (d, p) and their values (d,), by ``value_and_step(places (k, p), which
    (k,))``. A step that lowers the value is halved; one without a maximum ends where the steps ran out."""
    place, moving = start.copy(), np.arange(len(start))
    best, step = value_and_step(place, moving)
    for _ in range(STEPS):
        moving = moving[np.abs(step[moving]).max(axis=1) > tolerance * (1.0 + np.abs(place[moving]).max(axis=1))]
        if not len(moving):
            break
        trial = place[moving] + step[moving]
        value, following = value_and_step(trial, moving)
        better = value >= best[moving] - 1e-13 * np.abs(value)
        ahead = moving[better]
        place[ahead], step[ahead] = trial[better], following[better]
        best[ahead] = np.maximum(value[better], best[ahead])
        step[moving[~better]] *= 0.5
    return place, best


def maxima(data: HitsAndMisses, start: np.ndarray, tolerance: float = TOLERANCE) -> np.ndarray:
    """(d, p) coefficients with the largest likelihood of several studies, from ``start`` (p,); without a penalty. Hits
    and misses of every study must overlap, else its coefficients end where the steps ran out. Plain Newton steps need
    no values and nearly always arrive at the maximum; the others are searched again, and so are those that end lower
    than they began: far out, where probabilities are rounded to 0 or 1, steps can be small without a maximum."""
    place = np.tile(np.asarray(start, float), (len(data.hits), 1))
    moving = np.arange(len(place))
    for _ in range(PLAIN_STEPS):
        if not len(moving):
            break
        with np.errstate(all="ignore"):
            step = (data if len(moving) == len(place) else data.of(moving)).step(place[moving])
            place[moving] += step
        moving = moving[~(np.abs(step).max(axis=1) <= tolerance)]
    begin = np.tile(np.asarray(start, float), (len(place), 1))
    with np.errstate(all="ignore"):
        again = np.union1d(moving, np.flatnonzero(~(data.value(place) >= data.value(begin))))
    place[again], _ = ascend(data.of(again).climb, begin[again], tolerance)
    return place


def penalised_maxima(data: HitsAndMisses, tolerance: float = TOLERANCE) -> np.ndarray:
    """Find (d, 2) intercepts and slopes with the largest penalised likelihood of several studies, finite for separated
    data too. Logit and probit have one maximum; under cloglog and loglog the highest is taken that is reached from a
    flat start, from the gap between largest miss and smallest hit, and from the best `CLIMBED` others."""
    z, hits = data.z, data.hits
    below = np.where(data.misses > 0, z, -np.inf).max(axis=1)
    gap = np.where(hits > 0, z, np.inf).min(axis=1) - below
    # Predictors of -1.5 and 1.5 at the ends of the gap, where these are not too close; then several widths through
    # both its ends and its middle.
    widths = [(np.clip(3.0 / np.maximum(gap, 1e-9), 1.0, 100.0), 0.5)]
    widths += [(np.full_like(gap, slope), share) for slope in np.geomspace(1.5, 150.0, 9) for share in (0.0, 0.5, 1.0)]
    steep = np.array([np.stack([-slope * (below + share * gap), slope], axis=1) for slope, share in widths])
    if data.link in ("logit", "probit"):
        return ascend(data.climb, steep[0], tolerance)[0]
    share = hits.sum(axis=1) / (hits + data.misses).sum(axis=1)
    flat = np.stack([link_ppf(data.link, share), np.ones(len(hits))], axis=1)
    rows = np.arange(len(hits))
    # the start with the highest value can lie in the basin of a lower maximum, so several of the best are climbed
    order = np.argsort([-data.value(start) for start in steep], axis=0, kind="stable")
    starts = (flat, steep[0], *(steep[k, rows] for k in order[:CLIMBED]))
    places, values = zip(*(ascend(data.climb, start, tolerance) for start in starts), strict=True)
    return np.asarray(np.array(places)[np.argmax(values, axis=0), rows])


def profile(data: HitsAndMisses, z0: float, level: float, slope: float = 1.0) -> tuple[float, float]:
    """Largest (penalised) log-likelihood of one study's rising curves (slope >= 0) whose predictor is ``level`` at
    ``z0``, and the slope there; ``slope``: where the search begins, such as the slope at a neighbouring ``z0``."""
    if data.penalty is not None:  # not proved to be concave, so the search begins with a grid

        def rising(s: np.ndarray) -> np.ndarray:
            return data.value(np.stack([level - np.exp(s) * z0, np.exp(s)], axis=-1))

        return max(_largest(rising, PENALISED_SLOPES), float(data.value(np.array([level, 0.0])))), slope
    line = replace(data, design=data.z[:, None] - z0, offset=level, hits=data.hits[None], misses=data.misses[None])
    # far out only slopes near that of the line through the mean chance have a likelihood that is not tiny
    rate = link_ppf(data.link, data.hits.sum() / (data.hits + data.misses).sum())
    starts = np.array([[slope], [(level - float(rate)) / max(z0, 1.0)]])
    best, _ = ascend(line.climb, starts[[np.argmax(np.concatenate([line.value(one[None]) for one in starts]))]], 1e-5)
    best = np.maximum(best, 0.0)
    return float(line.value(best)[0]), float(best[0, 0])


def flat_maximum(data: HitsAndMisses, highest: float) -> float:
    """Largest (penalised) log-likelihood of one study's curves that do not rise at all, with a predictor of at most
    ``highest``: the limit of `profile` as ``z0`` grows without end."""
    if data.penalty is None:
        rate = data.hits.sum() / (data.hits + data.misses).sum()
        return float(data.value(np.array([min(highest, float(link_ppf(data.link, rate))), 0.0])))
    levels = np.linspace(highest - 12.0, highest, 400)
    largest = _largest(lambda level: data.value(np.stack([level, 0.0 * level], axis=-1)), levels)
    return max(largest, float(data.value(np.array([highest, 0.0]))))


def _largest(function: Callable[[np.ndarray], np.ndarray], grid: np.ndarray) -> float:
    """Return the largest value of a function of a number, refined between the best of a grid and its neighbours."""
    best = int(np.argmax(function(grid)))
    ends = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    how: dict[str, Any] = {"bounds": ends, "method": "bounded", "options": {"xatol": 1e-9}}
    return -float(optimize.minimize_scalar(lambda at: -float(function(np.asarray(at))), **how).fun)
