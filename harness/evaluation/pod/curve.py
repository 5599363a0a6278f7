"""A probability of detection curve: what every way of fitting one ends in, and its four links.

POD(a) = F((x - mu) / sigma), x = a or ln a, F the link's distribution function. So mu is the size (or its logarithm)
at which F is F(0), which is the 50 % size for logit and probit only, and sigma is the curve's width.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import special

LARGEST_PREDICTOR = 500.0
"""|b0 + b1 z| beyond which every link is 0 or 1 to the last bit; exp() of it does not overflow."""

_CDF: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "logit": special.expit,
    "probit": special.ndtr,
    "cloglog": lambda t: -np.expm1(-np.exp(t)),
    "loglog": lambda t: np.exp(-np.exp(-t)),
}
_PPF: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "logit": special.logit,
    "probit": special.ndtri,
    "cloglog": lambda p: np.log(-np.log1p(-p)),
    "loglog": lambda p: -np.log(-np.log(p)),
}
LINKS = tuple(_CDF)


def link_cdf(link: str, t: np.ndarray) -> np.ndarray:
    """F(t) of one of `LINKS`: logistic, normal, 1 - exp(-exp(t)) (cloglog), exp(-exp(-t)) (loglog)."""
    with np.errstate(over="ignore"):
        return np.asarray(_CDF[link](np.asarray(t, float)))


def link_ppf(link: str, p: np.ndarray) -> np.ndarray:
    """F^-1(p) of one of `LINKS`."""
    return np.asarray(_PPF[link](np.asarray(p, float)))


def logs_of_link(link: str, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ln F, ln(1 - F) and ln f (the density) at the predictor, each of its shape and exact in both tails."""
    t = np.clip(predictor, -LARGEST_PREDICTOR, LARGEST_PREDICTOR)
    if link == "logit":
        log_hit, log_miss = -np.logaddexp(0.0, -t), -np.logaddexp(0.0, t)
        return log_hit, log_miss, log_hit + log_miss
    if link == "probit":
        return special.log_ndtr(t), special.log_ndtr(-t), -0.5 * t * t - 0.5 * np.log(2.0 * np.pi)
    signed = t if link == "cloglog" else -t
    hazard = np.exp(signed)
    nearer, other = -hazard, np.log(-np.expm1(-hazard))
    return (other, nearer, signed - hazard) if link == "cloglog" else (nearer, other, signed - hazard)


def slopes_of_link(link: str, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """f / F, f / (1 - F) and d ln f / dt at t = predictor, each of its shape."""
    t = np.clip(predictor, -LARGEST_PREDICTOR, LARGEST_PREDICTOR)
    if link == "logit":  # the commonest, and the ratios are the shares themselves
        hit, miss = special.expit(t), special.expit(-t)
        return miss, hit, miss - hit
    log_hit, log_miss, log_density = logs_of_link(link, t)
    bend = {"probit": lambda: -t, "cloglog": lambda: 1.0 - np.exp(t), "loglog": lambda: np.exp(-t) - 1.0}[link]()
    return np.exp(log_density - log_hit), np.exp(log_density - log_miss), bend


@dataclass(frozen=True)
class PodCurve:
    """``mu``, ``sigma`` in the unit of x (size, or its natural logarithm where ``log_size``); ``covariance`` (2, 2) of
    the two; ``floor`` and ``ceiling``: POD of the smallest and the largest, 0 and 1 unless fitted."""

    link: str
    log_size: bool
    mu: float
    sigma: float
    covariance: np.ndarray
    floor: float = 0.0
    ceiling: float = 1.0

    def pod(self, size: np.ndarray) -> np.ndarray:
        """POD at sizes of any shape."""
        x = np.log(size) if self.log_size else np.asarray(size, float)
        return self.floor + (self.ceiling - self.floor) * link_cdf(self.link, (x - self.mu) / self.sigma)

    def size_at(self, pod: float) -> float:
        """The size with this POD; infinite or 0 where floor or ceiling keep the curve from it."""
        share = (pod - self.floor) / (self.ceiling - self.floor)
        if not 0 < share < 1:
            return float("inf") if share >= 1 else 0.0
        x = self.mu + self.sigma * float(link_ppf(self.link, np.array(share)))
        return float(np.exp(x)) if self.log_size else x


@dataclass(frozen=True)
class Bound:
    """An upper confidence bound on a size, such as a90/95. ``value`` is infinite where the data demonstrate none, and
    ``why`` then says so in words."""

    pod: float
    confidence: float
    method: str
    value: float
    why: str = ""

    @property
    def demonstrated(self) -> bool:
        """Return whether there is a finite bound."""
        return bool(np.isfinite(self.value))
