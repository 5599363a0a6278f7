"""Curves of many draws whose hits and misses do not overlap: Firth's penalised likelihood, as one such study is fitted.

Penalised score U(b) + (k / 2) sum_i h_i (d ln w_i / d t_i) x_i, h_i the leverage of row i and w_i its expected
information at the predictor t_i (Firth, Biometrika 80 (1993), 27, in the form of Kosmidis and Firth, Biometrika 96
(2009), 793); k the mean number of inspections of a target, as in `harness.evaluation.pod.hit_miss`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.evaluation.pod.curve import link_ppf
from harness.evaluation.pod.likelihood import logs_of_link, slope_of_log_density, steep_starts

STEPS = 200
"""Scoring steps and halvings of a draw; some twenty do."""
TOLERANCE = 1e-6
"""A step smaller than this share of the coefficients has arrived."""


@dataclass(frozen=True, eq=False)
class _Draws:
    """Draws of hits and misses (d, n) of targets at ``z`` (n,), with ``penalty`` (d,) times Jeffreys' prior."""

    z: np.ndarray
    hits: np.ndarray
    misses: np.ndarray
    penalty: np.ndarray
    link: str

    def of(self, rows: np.ndarray) -> _Draws:
        return _Draws(self.z, self.hits[rows], self.misses[rows], self.penalty[rows], self.link)

    def value_and_step(self, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Penalised log-likelihood (d,) and scoring step (d, 2) at coefficients ``b`` (d, 2)."""
        t = b[:, :1] + b[:, 1:] * self.z
        logs = logs_of_link(self.link, t)
        up, down = np.exp(logs.log_density - logs.log_hit), np.exp(logs.log_density - logs.log_miss)
        weight = (self.hits + self.misses) * up * down
        total, cross, square = weight.sum(axis=1), weight @ self.z, weight @ self.z**2
        with np.errstate(divide="ignore", invalid="ignore"):
            determinant = total * (square - cross**2 / total)
            prior = 0.5 * np.log(np.maximum(determinant, 0.0))
            z = self.z
            leverage = weight * (square[:, None] - 2 * cross[:, None] * z + total[:, None] * z**2)
            leverage /= determinant[:, None]
            bend = 2.0 * slope_of_log_density(self.link, t) - up + down
            slope = self.hits * up - self.misses * down + 0.5 * self.penalty[:, None] * leverage * bend
            first, second = slope.sum(axis=1), slope @ z
            step = np.stack([square * first - cross * second, total * second - cross * first], 1) / determinant[:, None]
        value = (self.hits * logs.log_hit + self.misses * logs.log_miss).sum(axis=1) + self.penalty * prior
        return np.where(np.isfinite(value), value, -np.inf), step


def penalised_maxima(z: np.ndarray, hits: np.ndarray, misses: np.ndarray, link: str, repeats: np.ndarray) -> np.ndarray:
    """(draws, 2) intercepts and slopes with the largest penalised likelihood of ``hits`` and ``misses`` (draws, n) at
    ``z`` (n,) of unit spread, no miss larger than any hit; ``repeats`` (draws,) the mean number of inspections of a
    target. Under cloglog and loglog the higher of the maxima that `penalised_maximum` starts for; logit and probit
    have one."""
    draws = _Draws(z, hits, misses, repeats, link)
    below, above = np.where(misses > 0, z, -np.inf).max(axis=1), np.where(hits > 0, z, np.inf).min(axis=1)
    starts = steep_starts(below, above).transpose(0, 2, 1)
    rows = np.arange(len(hits))
    if link in ("logit", "probit"):
        return _climbed(draws, starts[0])[0]
    share = hits.sum(axis=1) / (hits + misses).sum(axis=1)
    flat = np.column_stack([np.asarray(link_ppf(link, share)), np.ones(len(hits))])
    heights = np.array([draws.value_and_step(start)[0] for start in starts])
    found = [_climbed(draws, start) for start in (flat, starts[0], starts[heights.argmax(axis=0), rows])]
    return np.array([place for place, _ in found])[np.argmax([height for _, height in found], axis=0), rows]


def _climbed(draws: _Draws, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The maxima (d, 2) that scoring reaches from ``start`` (d, 2) and their values (d,). A step that lowers the
    likelihood is halved, a draw that has arrived rests."""
    place = start.copy()
    best, step = draws.value_and_step(place)
    moving = np.arange(len(place))
    for _ in range(STEPS):
        if not len(moving):
            break
        trial = place[moving] + step[moving]
        value, following = draws.of(moving).value_and_step(trial)
        better = value >= best[moving] - 1e-13 * np.abs(value)
        ahead = moving[better]
        place[ahead], best[ahead], step[ahead] = trial[better], value[better], following[better]
        step[moving[~better]] *= 0.5
        moving = moving[np.abs(step[moving]).max(axis=1) > TOLERANCE * (1.0 + np.abs(place[moving]).max(axis=1))]
    return place, best
