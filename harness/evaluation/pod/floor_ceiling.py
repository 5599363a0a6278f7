"""POD curves that start above 0 (chance hits) or end below 1 (targets that no size makes visible).

P(hit) = f + (c - f) F(b0 + b1 z) with 0 <= f <= 1/2 <= c <= 1. This likelihood is not concave: it is maximised from
several starts. Not modelled: a floor above or a ceiling below one half.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy import optimize
from scipy.special import xlogy

from harness.evaluation.pod.curve import link_ppf
from harness.evaluation.pod.likelihood import HitsAndMisses, logs_of_link

BOUNDED = ("none", "floor", "ceiling", "both")
STEEPEST = 1e3
"""Largest slope in standardised sizes: a curve that rises within a thousandth of the sizes' spread is a step."""
STARTS = 10
"""From how many places of a coarse grid the maximum is sought."""
NEAR_EDGE = 1e-6
"""Distance of floor and ceiling from 0 and 1, and from the POD that a profile holds, that counts as none."""


@dataclass(frozen=True)
class Bounded:
    """Four parameters in standardised sizes, and the log-likelihood there."""

    b0: float
    b1: float
    floor: float
    ceiling: float
    log_likelihood: float


def bounded_value(data: HitsAndMisses, place: np.ndarray) -> tuple[float, np.ndarray]:
    """Log-likelihood and its gradient (4,) at (b0, b1, floor, ceiling)."""
    b0, b1, floor, ceiling = place
    logs = logs_of_link(data.link, b0 + b1 * data.z)
    share, density = np.exp(logs.log_hit), np.exp(logs.log_density)
    p_hit = np.maximum(floor + (ceiling - floor) * share, 1e-300)
    p_miss = np.maximum((1.0 - ceiling) + (ceiling - floor) * np.exp(logs.log_miss), 1e-300)
    slope = np.where(data.hit, 1.0 / p_hit, -1.0 / p_miss)
    along = slope * (ceiling - floor) * density
    gradient = np.array([along.sum(), along @ data.z, slope @ (1.0 - share), slope @ share])
    return float(np.log(np.where(data.hit, p_hit, p_miss)).sum()), gradient


def bounded_maximum(data: HitsAndMisses, plain: Bounded, bounded: str) -> tuple[Bounded, tuple[str, ...]]:
    """The largest likelihood with a floor, a ceiling or both, and notes; ``plain`` is that without them."""
    floor = (0.0, 0.5) if bounded in ("floor", "both") else (0.0, 0.0)
    ceiling = (0.5, 1.0) if bounded in ("ceiling", "both") else (1.0, 1.0)
    best = _search(data, plain, floor, ceiling)
    share = np.exp(logs_of_link(data.link, best.b0 + best.b1 * data.z).log_hit)
    if len(np.unique(data.z[(share > 0.01) & (share < 0.99)])) < 2:
        return best, ("fewer than two sizes lie on the curve's rise: it is a step, whose width means nothing",)
    return best, ()


def most_likely_below(data: HitsAndMisses, plain: Bounded, bounded: str, pod: float) -> float:
    """Largest log-likelihood of the curves whose ceiling is at most ``pod``; -inf where the ceiling is fixed at 1."""
    if bounded not in ("ceiling", "both") or pod < 0.5:
        return float("-inf")
    floor = (0.0, 0.5) if bounded == "both" else (0.0, 0.0)
    return _search(data, plain, floor, (0.5, pod), contains_plain=False).log_likelihood


def bounded_profile(data: HitsAndMisses, fit: Bounded, bounded: str, z0: float, pod: float) -> float:
    """Largest log-likelihood of the curves with floor < ``pod`` < ceiling that are ``pod`` at ``z0``."""
    floor = (0.0, min(0.5, pod - NEAR_EDGE)) if bounded in ("floor", "both") else (0.0, 0.0)
    ceiling = (max(0.5, pod + NEAR_EDGE), 1.0) if bounded in ("ceiling", "both") else (1.0, 1.0)

    def loss(place: np.ndarray) -> tuple[float, np.ndarray]:
        b1, between = float(np.exp(place[0])), place[2] - place[1]
        share = float(np.clip((pod - place[1]) / between, 1e-12, 1.0 - 1e-12))
        predictor = float(link_ppf(data.link, np.array(share)))
        value, by = bounded_value(data, np.array([predictor - b1 * z0, b1, place[1], place[2]]))
        by_share = by[0] / np.exp(float(logs_of_link(data.link, np.array(predictor)).log_density)) / between
        slopes = [b1 * (by[1] - z0 * by[0]), by[2] - by_share * (1.0 - share), by[3] - by_share * share]
        return -value, -np.array(slopes)

    steepness = (np.log(1e-6), np.log(STEEPEST))
    slopes, floors = (fit.b1, 0.3 * fit.b1), {float(np.clip(f, *floor)) for f in (fit.floor, 0.01)}
    ceilings = {float(np.clip(c, *ceiling)) for c in (fit.ceiling, 0.5 * (1.0 + pod))}
    return -min(
        float(optimize.minimize(loss, start, jac=True, method="L-BFGS-B", bounds=(steepness, floor, ceiling)).fun)
        for start in ([np.log(b1), f, c] for b1, f, c in product(slopes, sorted(floors), sorted(ceilings)))
    )


def bounded_covariance(data: HitsAndMisses, place: Bounded) -> np.ndarray:
    """(2, 2) covariance of (b0, b1): inverse expected information over the parameters off their boundaries."""
    logs = logs_of_link(data.link, place.b0 + place.b1 * data.z)
    if place.floor <= 0 and place.ceiling >= 1:
        return np.asarray(np.linalg.inv(data.information(place.b0, place.b1)))
    share, density = np.exp(logs.log_hit), np.exp(logs.log_density)
    between = place.ceiling - place.floor
    p = np.clip(place.floor + between * share, 1e-12, 1.0 - 1e-12)
    slopes = [between * density, between * density * data.z]
    slopes += [1.0 - share] if place.floor > NEAR_EDGE else []
    slopes += [share] if place.ceiling < 1.0 - NEAR_EDGE else []
    design = np.column_stack(slopes)
    return np.asarray(np.linalg.pinv(design.T @ (design / (p * (1.0 - p))[:, None]))[:2, :2])


def _search(
    data: HitsAndMisses,
    plain: Bounded,
    floor: tuple[float, float],
    ceiling: tuple[float, float],
    contains_plain: bool = True,
) -> Bounded:
    best = plain if contains_plain else replace(plain, log_likelihood=float("-inf"))
    for start in _starts(data, plain, floor, ceiling):
        found = optimize.minimize(
            lambda place: tuple(-part for part in bounded_value(data, place)),
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=((-STEEPEST * 10, STEEPEST * 10), (1e-6, STEEPEST), floor, ceiling),
            options={"ftol": 1e-13, "gtol": 1e-8, "maxiter": 500},
        )
        if -found.fun > best.log_likelihood + 1e-9:
            b0, b1, low, high = (float(part) for part in found.x)
            best = Bounded(b0, b1, low, high, -float(found.fun))
    return best


def _starts(
    data: HitsAndMisses, plain: Bounded, floor: tuple[float, float], ceiling: tuple[float, float]
) -> list[np.ndarray]:
    """The `STARTS` likeliest places of a coarse grid, each with a middle and a slope of its own: floor and ceiling free
    the curve to rise steeply anywhere, and each such place can hold a maximum."""
    floors = sorted({float(np.clip(f, *floor)) for f in (0.02, 0.1, 0.25)})
    ceilings = sorted({float(np.clip(c, *ceiling)) for c in (0.75, 0.9, 0.98)})
    middles = np.unique(np.append(np.quantile(data.z, np.linspace(0.04, 0.96, 16)), -plain.b0 / plain.b1))
    likeliest = []
    for middle, b1 in product(middles, (plain.b1, 3.0 * plain.b1, 12.0 * plain.b1, 50.0 * plain.b1)):
        places = [np.array([-b1 * middle, min(b1, STEEPEST), f, c]) for f, c in product(floors, ceilings)]
        values = [bounded_value(data, place)[0] for place in places]
        best = int(np.argmax(values))
        likeliest.append((values[best], places[best]))
    likeliest.sort(key=lambda pair: -pair[0])
    return [place for _, place in likeliest[:STARTS]] + _steps(data, floor, ceiling)


def _steps(data: HitsAndMisses, floor: tuple[float, float], ceiling: tuple[float, float]) -> list[np.ndarray]:
    """The three likeliest steps between neighbouring sizes, where the chance jumps from the share of hits below to that
    above, as curves that rise within a gap of the sizes: the limit that a steep slope tends to."""
    sizes, first = np.unique(np.sort(data.z), return_index=True)
    below = np.append(0, np.cumsum(data.hit[np.argsort(data.z, kind="stable")]))[first[1:]]
    low = np.clip(below / first[1:], *floor)
    rest, hits = len(data.z) - first[1:], data.hit.sum() - below
    high = np.clip(hits / rest, *ceiling)
    value = xlogy(below, low) + xlogy(first[1:] - below, 1.0 - low) + xlogy(hits, high) + xlogy(rest - hits, 1.0 - high)
    slope, middle = np.minimum(6.0 / np.diff(sizes), STEEPEST), 0.5 * (sizes[1:] + sizes[:-1])
    likeliest = np.argsort(-value, kind="stable")[:3]
    return [np.array([-slope[at] * middle[at], slope[at], low[at], high[at]]) for at in likeliest]
