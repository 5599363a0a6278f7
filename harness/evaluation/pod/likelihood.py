"""The likelihood of hits and misses under a link: its value, its slope, and the flat and the steep ends of it.

P(hit) = floor + (ceiling - floor) F(b0 + b1 z). Sizes enter as z, centred and scaled to unit spread, so that no unit of
size makes the maximisation ill-conditioned. For all four links ln F and ln(1 - F) are concave, so without floor and
ceiling the log-likelihood is concave in (b0, b1) and has one maximum wherever hits and misses overlap.

Sources: McCullagh and Nelder, Generalized Linear Models (1989), sections 2.5 and 4.3; Firth, Biometrika 80 (1993), 27;
that the penalised estimate is finite for these links: Kosmidis and Firth, Biometrika 108 (2021), 71.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from harness.evaluation.pod.curve import link_ppf

LARGEST_PREDICTOR = 500.0
"""|b0 + b1 z| beyond which every link is 0 or 1 to the last bit; exp() of it does not overflow."""


@dataclass(frozen=True)
class Links:
    """ln F, ln(1 - F) and ln f (the density) at the linear predictor, each of its shape."""

    log_hit: np.ndarray
    log_miss: np.ndarray
    log_density: np.ndarray


def logs_of_link(link: str, predictor: np.ndarray) -> Links:
    """The logarithms that a likelihood is made of, exact in both tails."""
    t = np.clip(predictor, -LARGEST_PREDICTOR, LARGEST_PREDICTOR)
    if link == "logit":
        log_hit, log_miss = -np.logaddexp(0.0, -t), -np.logaddexp(0.0, t)
        return Links(log_hit, log_miss, log_hit + log_miss)
    if link == "probit":
        return Links(special.log_ndtr(t), special.log_ndtr(-t), -0.5 * t * t - 0.5 * np.log(2.0 * np.pi))
    sign = 1.0 if link == "cloglog" else -1.0
    hazard = np.exp(sign * t)
    nearer, other = -hazard, np.log(-np.expm1(-hazard))
    density = sign * t - hazard
    return Links(other, nearer, density) if link == "cloglog" else Links(nearer, other, density)


@dataclass(frozen=True)
class HitsAndMisses:
    """``z`` (n,) standardised sizes, ``hit`` (n,) booleans, ``link`` one of `LINKS`; ``penalty``: how often
    Jeffreys' prior (half the logarithm of the information's determinant) is added: 0 for none, 1 for Firth's penalty, k
    where every target has k rows. ``floor`` and ``ceiling`` are held fixed and counted by `value` alone."""

    z: np.ndarray
    hit: np.ndarray
    link: str
    penalty: float = 0.0
    floor: float = 0.0
    ceiling: float = 1.0

    def value(self, b0: np.ndarray | float, b1: np.ndarray | float) -> np.ndarray:
        """(Penalised) log-likelihood at intercepts and slopes of any common shape."""
        predictor = np.asarray(b0, float)[..., None] + np.asarray(b1, float)[..., None] * self.z
        logs = logs_of_link(self.link, predictor)
        found, missed = self._bounded(logs.log_hit, self.floor), self._bounded(logs.log_miss, 1.0 - self.ceiling)
        value = np.where(self.hit, found, missed).sum(axis=-1)
        return np.asarray(value + self.penalty * self._jeffreys(logs) if self.penalty else value)

    def information(self, b0: float, b1: float) -> np.ndarray:
        """(2, 2) expected information of (b0, b1)."""
        weight = _weight(logs_of_link(self.link, b0 + b1 * self.z))
        cross = float(weight @ self.z)
        return np.array([[weight.sum(), cross], [cross, weight @ self.z**2]])

    def slope_and_weight(self, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivative of each row's log-likelihood by its predictor, and its expected information."""
        logs = logs_of_link(self.link, predictor)
        toward = np.where(self.hit, logs.log_hit, logs.log_miss)
        slope = np.where(self.hit, 1.0, -1.0) * np.exp(logs.log_density - toward)
        return slope, _weight(logs)

    def _bounded(self, log_share: np.ndarray, least: float) -> np.ndarray:
        """ln(least + (ceiling - floor) share), which for floor 0 and ceiling 1 is the link's own."""
        if self.floor == 0 and self.ceiling == 1:
            return log_share
        with np.errstate(divide="ignore"):
            return np.asarray(np.logaddexp(np.log(least), np.log(self.ceiling - self.floor) + log_share))

    def _jeffreys(self, logs: Links) -> np.ndarray:
        weight = _weight(logs)
        total, cross, square = weight.sum(-1), (weight * self.z).sum(-1), (weight * self.z**2).sum(-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            centred = square - cross**2 / total
            penalty = 0.5 * (np.log(total) + np.log(np.maximum(centred, 0.0)))
        return np.asarray(np.where(np.isfinite(penalty), penalty, -np.inf))


def _weight(logs: Links) -> np.ndarray:
    return np.asarray(np.exp(2.0 * logs.log_density - logs.log_hit - logs.log_miss))


def maximum(data: HitsAndMisses) -> tuple[float, float]:
    """(b0, b1) of the largest likelihood by Fisher scoring with halved steps; hits and misses must overlap."""
    design = np.column_stack([np.ones_like(data.z), data.z])
    place = np.array([float(link_ppf(data.link, np.mean(data.hit))), 0.0])
    value = float(data.value(*place))
    for _ in range(200):
        slope, weight = data.slope_and_weight(design @ place)
        step = np.linalg.solve(design.T @ (weight[:, None] * design), design.T @ slope)
        while (better := float(data.value(*(place + step)))) < value and np.abs(step).max() > 1e-13:
            step = step / 2.0
        if better < value:
            break
        place, value = place + step, better
        if np.abs(step).max() <= 1e-11 * (1.0 + np.abs(place).max()):
            break
    return float(place[0]), float(place[1])


def penalised_maximum(data: HitsAndMisses) -> tuple[float, float]:
    """(b0, b1) of the largest penalised likelihood, which is finite for separated data too (`data.penalty`). Under
    cloglog and loglog it can have several maxima: the higher one is taken from a flat start, from the first and from
    the best of `steep_starts`."""
    flat = np.array([float(link_ppf(data.link, np.mean(data.hit))), 1.0])
    steep = steep_starts(float(data.z[~data.hit].max()), float(data.z[data.hit].min()))
    best_steep = steep[int(np.argmax([data.value(*one) for one in steep]))]
    found = [
        optimize.minimize(
            lambda place: -float(data.value(place[0], place[1])),
            start,
            method="Nelder-Mead",
            options={"xatol": 1e-10, "fatol": 1e-12, "maxiter": 5000, "maxfev": 5000},
        )
        for start in (flat, steep[0], best_steep)
    ]
    best = min(found, key=lambda one: float(one.fun))
    return float(best.x[0]), float(best.x[1])


def steep_starts(below: np.ndarray | float, above: np.ndarray | float) -> np.ndarray:
    """(k, 2, ...) intercepts and slopes of curves that rise between the largest miss ``below`` and the smallest hit
    ``above``, in sizes of unit spread: the first with predictors -1.5 and 1.5 there (where they are not too close), the
    others of several widths through both ends and the middle."""
    gap = np.asarray(above, float) - below
    fitting = np.clip(3.0 / np.maximum(gap, 1e-9), 1.0, 100.0)
    widths = [(slope * np.ones_like(gap), share) for slope in np.geomspace(1.5, 150.0, 9) for share in (0.0, 0.5, 1.0)]
    return np.array([(-slope * (below + share * gap), slope) for slope, share in ((fitting, 0.5), *widths)])


def slope_of_log_density(link: str, predictor: np.ndarray) -> np.ndarray:
    """d ln f / dt at t = ``predictor``, f the link's density."""
    t = np.clip(predictor, -LARGEST_PREDICTOR, LARGEST_PREDICTOR)
    if link == "logit":
        return np.asarray(-np.tanh(0.5 * t))
    if link == "probit":
        return np.asarray(-t)
    return np.asarray(1.0 - np.exp(t) if link == "cloglog" else np.exp(-t) - 1.0)


def profile(data: HitsAndMisses, z0: float, predictor: float) -> float:
    """Largest (penalised) log-likelihood of the rising curves (b1 >= 0) whose predictor is ``predictor`` at ``z0``."""
    return _penalised_profile(data, z0, predictor) if data.penalty else _plain_profile(data, z0, predictor)


def _plain_profile(data: HitsAndMisses, z0: float, predictor: float) -> float:
    """Newton on the concave function of b1 alone, kept inside a bracket of its slope's change of sign."""
    away = data.z - z0

    def slope_of(b1: float) -> tuple[float, float]:
        slope, weight = data.slope_and_weight(predictor + b1 * away)
        return float(slope @ away), float(weight @ away**2)

    low, high, b1 = 0.0, np.inf, 0.0
    for _ in range(200):
        slope, curvature = slope_of(b1)
        if slope <= 0 and b1 == 0.0:
            break
        low, high = (b1, high) if slope > 0 else (low, b1)
        step = b1 + slope / curvature if curvature > 0 else np.inf
        if not low < step < high:
            step = 0.5 * (low + high) if np.isfinite(high) else 2.0 * low + 1.0
        if not np.isfinite(high):
            step = min(step, 4.0 * low + 10.0)
        if abs(step - b1) <= 1e-11 * (1.0 + b1):
            break
        b1 = step
    return float(data.value(predictor - b1 * z0, b1))


def _penalised_profile(data: HitsAndMisses, z0: float, predictor: float) -> float:
    """The penalised function of b1 alone, searched over ln b1 from a coarse grid: it is not proved to be concave."""

    def value(log_b1: np.ndarray | float) -> np.ndarray:
        b1 = np.exp(log_b1)
        return data.value(predictor - b1 * z0, b1)

    grid = np.linspace(np.log(1e-8), np.log(1e4), 140)
    best = int(np.argmax(value(grid)))
    found = optimize.minimize_scalar(
        lambda log_b1: -float(value(log_b1)),
        bounds=(grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return float(max(-found.fun, data.value(predictor, 0.0)))


def flat_maximum(data: HitsAndMisses, highest: float) -> float:
    """Largest (penalised) log-likelihood of curves that do not rise at all, with a predictor of at most ``highest``:
    what `profile` tends to as ``z0`` grows without end."""
    if not data.penalty:
        return float(data.value(min(highest, float(link_ppf(data.link, np.mean(data.hit)))), 0.0))
    levels = np.linspace(highest - 12.0, highest, 400)
    best = int(np.argmax(data.value(levels, 0.0)))
    found = optimize.minimize_scalar(
        lambda level: -float(data.value(level, 0.0)),
        bounds=(levels[max(best - 1, 0)], levels[min(best + 1, len(levels) - 1)]),
        method="bounded",
    )
    return float(max(-found.fun, data.value(highest, 0.0)))
