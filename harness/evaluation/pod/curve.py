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
from typing import Any

import numpy as np
from scipy import optimize, special

LARGEST_PREDICTOR = 500.0
"""Limit of |b0 + b1 z|: beyond it, every link is 0 or 1 to the last bit; exp() of the limit does
not overflow."""

_F_AND_INVERSE: dict[
    str, tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]
] = {
    "logit": (special.expit, special.logit),
    "probit": (special.ndtr, special.ndtri),
    "cloglog": (lambda t: -np.expm1(-np.exp(t)), lambda p: np.log(-np.log1p(-p))),
    "loglog": (lambda t: np.exp(-np.exp(-t)), lambda p: -np.log(-np.log(p))),
}
LINKS = tuple(_F_AND_INVERSE)
CELLS = (
    2**17
)  # curves times targets, or resampled boards times their targets, in one block: 1 MB per array


def link_cdf(link: str, t: np.ndarray) -> np.ndarray:
    """Return F(t) for one of `LINKS`: logistic, normal, 1 - exp(-exp(t)) (cloglog), exp(-exp(-t))
    (loglog)."""
    with np.errstate(over="ignore"):
        return np.asarray(_F_AND_INVERSE[link][0](np.asarray(t, float)))


def link_ppf(link: str, p: np.ndarray) -> np.ndarray:
    """Return F^-1(p) for one of `LINKS`."""
    return np.asarray(_F_AND_INVERSE[link][1](np.asarray(p, float)))


def logs_of_link(link: str, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ln F, ln(1 - F) and ln f (the density), each of the predictor's shape and accurate in
    both tails."""
    t = np.minimum(
        np.maximum(predictor, -LARGEST_PREDICTOR), LARGEST_PREDICTOR
    )  # `np.clip` takes five times as long
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
    return (
        (log_any, log_none, signed - hazard)
        if link == "cloglog"
        else (log_none, log_any, signed - hazard)
    )


def slopes_of_link(link: str, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return f / F, f / (1 - F) and d ln f / dt at t = predictor, each of the predictor's shape."""
    t = np.minimum(np.maximum(predictor, -LARGEST_PREDICTOR), LARGEST_PREDICTOR)
    if link == "logit":  # the most common link: the ratios are the probabilities themselves
        hit = special.expit(t)
        miss = special.expit(-t)
        return miss, hit, miss - hit
    log_hit, log_miss, log_density = logs_of_link(link, t)
    bend = {
        "probit": lambda: -t,
        "cloglog": lambda: 1.0 - np.exp(t),
        "loglog": lambda: np.exp(-t) - 1.0,
    }[link]()
    return np.exp(log_density - log_hit), np.exp(log_density - log_miss), bend


@dataclass(frozen=True)
class PodCurve:
    """``mu`` and ``sigma``: in the unit of x (size, or ln size if ``log_size``). ``covariance``:
    (2, 2)."""

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
    """An upper confidence bound on a size, such as a90/95; infinite if there is none, and ``why``
    gives the reason."""

    pod: float
    confidence: float
    method: str
    value: float
    why: str = ""

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


@dataclass(frozen=True, eq=False)
class HitsAndMisses:
    """Hits and misses of one or several (d) studies on the same rows. ``design`` (n, p): columns
    of the predictor. ``hits``, ``misses``: (n,) or (d, n) counts. ``penalty`` (a number, or (d,)):
    multiple of Jeffreys' prior, with p = 2 only: None for no penalty, 1 for Firth's, k if every
    target has k rows."""

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
        """Return the (penalised) log-likelihood (...) at coefficients (..., p); for several
        studies (d,) at (d, p)."""
        found, missed, density = logs = logs_of_link(self.link, b @ self.design.T + self.offset)
        value = (self.hits * found + self.misses * missed).sum(axis=-1)
        if self.penalty is not None:
            weight = (self.hits + self.misses) * np.exp(2.0 * density - logs[0] - logs[1])
            total = weight.sum(-1)
            cross = weight @ self.z
            square = weight @ self.z**2
            with np.errstate(divide="ignore", invalid="ignore"):
                prior = 0.5 * (np.log(total) + np.log(np.maximum(square - cross**2 / total, 0.0)))
            value = value + self.penalty * np.where(np.isfinite(prior), prior, -np.inf)
        return np.asarray(value)

    def step(self, b: np.ndarray) -> np.ndarray:
        """Return Newton steps (d, p) of (d,) studies at b (d, p); with a penalty, scoring steps.
        They are meaningless if the information is singular, in studies that diverge to infinity.
        """
        up, down, bend = slopes_of_link(self.link, b @ self.design.T + self.offset)
        slope = self.hits * up - self.misses * down
        with np.errstate(all="ignore"):
            if self.penalty is not None:
                z = self.z
                weight = (self.hits + self.misses) * up * down
                total = weight.sum(axis=1)
                cross = weight @ z
                square = weight @ z**2
                determinant = total * (square - cross**2 / total)
                leverage = weight * (
                    square[:, None] - 2 * cross[:, None] * z + total[:, None] * z**2
                )
                leverage /= determinant[:, None]
                slope = slope + 0.5 * np.asarray(self.penalty)[:, None] * leverage * (
                    2.0 * bend - up + down
                )
                first = slope.sum(axis=1)
                second = slope @ z
                along = np.stack(
                    [square * first - cross * second, total * second - cross * first], axis=1
                )
                return np.asarray(along / determinant[:, None])
            if self.link == "logit":  # the same in fewer operations
                weight = (self.hits + self.misses) * up * down
            else:
                weight = self.hits * up * np.maximum(
                    up - bend, 0.0
                ) + self.misses * down * np.maximum(down + bend, 0.0)
            p = self.design.shape[1]
            if p == 1:
                return np.asarray((slope @ self.design) / (weight @ self.design**2))
            products = (self.design[:, :, None] * self.design[:, None, :]).reshape(-1, p * p)
            information = (weight @ products).reshape(-1, p, p)
            ridge = (
                1e-12 * np.trace(information, axis1=1, axis2=2)[:, None, None] + 1e-300
            ) * np.eye(p)
            return np.asarray(
                np.linalg.solve(information + ridge, (slope @ self.design)[:, :, None])[:, :, 0]
            )

    def of(self, rows: np.ndarray) -> HitsAndMisses:
        """Return the studies ``rows``."""
        penalty = (
            None if self.penalty is None else np.broadcast_to(self.penalty, len(self.hits))[rows]
        )
        return replace(self, hits=self.hits[rows], misses=self.misses[rows], penalty=penalty)

    def climb(self, places: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values and steps of the studies ``which``, for `ascend`."""
        chosen = self if self.penalty is None and len(which) == len(self.hits) else self.of(which)
        value = chosen.value(places)
        return np.where(np.isfinite(value), value, -np.inf), chosen.step(places)


def ascend(
    value_and_step: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    start: np.ndarray,
    tolerance: float = TOLERANCE,
) -> tuple[np.ndarray, np.ndarray]:
    """Climb from ``start`` (d, p) to maxima (d, p) and their values (d,), by
    ``value_and_step(places (k, p), which (k,))``. A step that lowers the value is halved. A
    problem without a maximum ends at its last step."""
    place = start.copy()
    moving = np.arange(len(start))
    best, step = value_and_step(place, moving)
    for _ in range(STEPS):
        moving = moving[
            np.abs(step[moving]).max(axis=1) > tolerance * (1.0 + np.abs(place[moving]).max(axis=1))
        ]
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
    """Return the coefficients (d, p) with the largest likelihood of several studies, from
    ``start`` (p,); without a penalty. If hits and misses of a study do not overlap, its
    coefficients are those of the last step. Plain Newton steps need no values and nearly always
    reach the maximum. The other studies are searched again, and so are those that end lower than
    they began: where probabilities are rounded to 0 or 1, steps can be small without a maximum."""
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
    """Return the intercepts and slopes (d, 2) with the largest penalised likelihood of several
    studies; they are finite for separated data too. Logit and probit have one maximum. For cloglog
    and loglog, the highest of those is returned that are reached from a flat start, the gap
    between largest miss and smallest hit, and the best `CLIMBED` others."""
    z = data.z
    hits = data.hits
    below = np.where(data.misses > 0, z, -np.inf).max(axis=1)
    gap = np.where(hits > 0, z, np.inf).min(axis=1) - below
    # Predictors of -1.5 and 1.5 at the ends of the gap, if these are not too close; then several
    # widths through both its ends and its middle.
    widths = [(np.clip(3.0 / np.maximum(gap, 1e-9), 1.0, 100.0), 0.5)]
    widths += [
        (np.full_like(gap, slope), share)
        for slope in np.geomspace(1.5, 150.0, 9)
        for share in (0.0, 0.5, 1.0)
    ]
    steep = np.array(
        [np.stack([-slope * (below + share * gap), slope], axis=1) for slope, share in widths]
    )
    if data.link in ("logit", "probit"):
        return ascend(data.climb, steep[0], tolerance)[0]
    share = hits.sum(axis=1) / (hits + data.misses).sum(axis=1)
    flat = np.stack([link_ppf(data.link, share), np.ones(len(hits))], axis=1)
    rows = np.arange(len(hits))
    # the start with the highest value can lie in the basin of a lower maximum, so several of the
    # best are climbed
    order = np.argsort([-data.value(start) for start in steep], axis=0, kind="stable")
    starts = (flat, steep[0], *(steep[k, rows] for k in order[:CLIMBED]))
    places, values = zip(*(ascend(data.climb, start, tolerance) for start in starts), strict=True)
    return np.asarray(np.array(places)[np.argmax(values, axis=0), rows])


def profile(
    data: HitsAndMisses, z0: float, level: float, slope: float = 1.0
) -> tuple[float, float]:
    """Return the largest (penalised) log-likelihood of one study's rising curves (slope >= 0)
    whose predictor is ``level`` at ``z0``, and the slope there. ``slope``: start of the search,
    such as that of a neighbour."""
    if data.penalty is not None:  # concavity is not proved, so the search begins with a grid

        def rising(s: np.ndarray) -> np.ndarray:
            return data.value(np.stack([level - np.exp(s) * z0, np.exp(s)], axis=-1))

        return max(
            _largest(rising, PENALISED_SLOPES), float(data.value(np.array([level, 0.0])))
        ), slope
    line = replace(
        data,
        design=data.z[:, None] - z0,
        offset=level,
        hits=data.hits[None],
        misses=data.misses[None],
    )
    # far out, only slopes near that of the line through the mean probability have a likelihood
    # that is not tiny
    rate = link_ppf(data.link, data.hits.sum() / (data.hits + data.misses).sum())
    starts = np.array([[slope], [(level - float(rate)) / max(z0, 1.0)]])
    best, _ = ascend(
        line.climb, starts[[np.argmax(np.concatenate([line.value(s[None]) for s in starts]))]], 1e-5
    )
    best = np.maximum(best, 0.0)
    return float(line.value(best)[0]), float(best[0, 0])


def flat_maximum(data: HitsAndMisses, highest: float) -> float:
    """Return the largest (penalised) log-likelihood of one study's flat curves, with a predictor
    of at most ``highest``: the limit of `profile` as ``z0`` grows to infinity."""
    if data.penalty is None:
        rate = data.hits.sum() / (data.hits + data.misses).sum()
        return float(data.value(np.array([min(highest, float(link_ppf(data.link, rate))), 0.0])))
    levels = np.linspace(highest - 12.0, highest, 400)
    largest = _largest(lambda level: data.value(np.stack([level, 0.0 * level], axis=-1)), levels)
    return max(largest, float(data.value(np.array([highest, 0.0]))))


def _largest(function: Callable[[np.ndarray], np.ndarray], grid: np.ndarray) -> float:
    """Return the largest value of a function of one number, refined around the best point of a
    grid."""
    best = int(np.argmax(function(grid)))
    ends = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    how: dict[str, Any] = {"bounds": ends, "method": "bounded", "options": {"xatol": 1e-9}}
    return -float(optimize.minimize_scalar(lambda at: -float(function(np.asarray(at))), **how).fun)
