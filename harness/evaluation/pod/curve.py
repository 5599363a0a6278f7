"""A probability of detection curve: what every way of fitting one ends in.

POD(a) = F((x - mu) / sigma), x = a or ln a, F the link's distribution function. So mu is the size (or its logarithm)
at which F is F(0), which is the 50 % size for logit and probit only, and sigma is the curve's width.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special, stats

LINKS = ("logit", "probit", "cloglog", "loglog")


def link_cdf(link: str, t: np.ndarray) -> np.ndarray:
    """F(t) of one of `LINKS`: logistic, normal, 1 - exp(-exp(t)) (cloglog), exp(-exp(-t)) (loglog)."""
    t = np.asarray(t, float)
    with np.errstate(over="ignore"):
        if link == "logit":
            return np.asarray(special.expit(t))
        if link == "probit":
            return np.asarray(stats.norm.cdf(t))
        if link == "cloglog":
            return np.asarray(-np.expm1(-np.exp(t)))
        return np.asarray(np.exp(-np.exp(-t)))


def link_ppf(link: str, p: np.ndarray) -> np.ndarray:
    """F^-1(p) of one of `LINKS`."""
    p = np.asarray(p, float)
    if link == "logit":
        return np.asarray(special.logit(p))
    if link == "probit":
        return np.asarray(stats.norm.ppf(p))
    if link == "cloglog":
        return np.asarray(np.log(-np.log1p(-p)))
    return np.asarray(-np.log(-np.log(p)))


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
        """Whether there is a finite bound."""
        return bool(np.isfinite(self.value))
