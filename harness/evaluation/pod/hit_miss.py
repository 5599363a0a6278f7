"""Probability of detection from hits and misses: a binomial regression on size, by MIL-HDBK-1823A appendix G.

A target that was inspected k times is one target: rows that share an identity in ``inspections`` are taken as fully
dependent (the handbook's conservative reading), so covariance and likelihood ratio criterion are scaled by k, the mean
number of inspections a target. Curves may start above 0 (chance hits) or end below 1 (targets that no size makes
visible): P(hit) = f + (c - f) F(b0 + b1 z) with 0 <= f <= 1/2 <= c <= 1. That likelihood is not concave: it is
maximised from several starts. Not modelled: targets that differ in anything but size, inspectors as a factor, a floor
above or a ceiling below one half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from scipy import optimize, stats
from scipy.special import xlogy

from harness.evaluation.pod.curve import LINKS, PodCurve, link_ppf, logs_of_link
from harness.evaluation.pod.likelihood import HitsAndMisses, maxima, penalised_maxima
from harness.vocabulary.errors import UserError

Between = Literal["none", "floor", "ceiling", "both"]
BOUNDED = ("none", "floor", "ceiling", "both")
EXACT = 1e-9
"""Tolerance of the coefficients of a single study."""
STEEPEST = 1e3
"""Largest slope in standardised sizes: a curve that rises within a thousandth of the sizes' spread is a step."""
STARTS = 10
"""Places of a coarse grid from which the maximum with floor or ceiling is sought."""
NEAR_EDGE = 1e-6
"""Distance of floor and ceiling from 0 and 1, and from the POD that a profile holds, that counts as none."""


@dataclass(frozen=True, eq=False)
class HitMissFit:
    """A fitted curve and its basis.

    ``b0``, ``b1``: POD = floor + (ceiling - floor) F(b0 + b1 x), x = size or ln size; ``covariance`` (2, 2) of the two,
    scaled for repeats. ``deviance``, ``null_deviance``, ``log_likelihood`` count every row, as the handbook's tables
    do; where ``method`` is "Firth" they are those of the likelihood without its penalty. ``n`` rows, ``hits`` of them
    hits, ``targets`` different ones, ``repeats`` = n / targets. ``x`` (n,), ``hit`` (n,): the data, for the bounds.
    """

    curve: PodCurve
    b0: float
    b1: float
    covariance: np.ndarray
    deviance: float
    null_deviance: float
    log_likelihood: float
    n: int
    hits: int
    targets: int
    separated: bool
    method: Literal["ML", "Firth"]
    notes: tuple[str, ...]
    bounded: Between
    x: np.ndarray
    hit: np.ndarray

    @property
    def repeats(self) -> float:
        """Mean number of inspections of a target."""
        return self.n / self.targets

    @property
    def covariance_of_rows(self) -> np.ndarray:
        """(2, 2) of (b0, b1) as if every row were a target of its own: the number that is too small."""
        return self.covariance / self.repeats

    @property
    def centre(self) -> float:
        """Mean of ``x``, from which `data` counts."""
        return float(self.x.mean())

    @property
    def spread(self) -> float:
        """Standard deviation of ``x``, the unit of `data`."""
        return float(self.x.std())

    @property
    def place(self) -> np.ndarray:
        """(4,) intercept and slope in standardised sizes, floor and ceiling."""
        slope = self.b1 * self.spread
        return np.array([self.b0 + self.b1 * self.centre, slope, self.curve.floor, self.curve.ceiling])

    @property
    def data(self) -> HitsAndMisses:
        """The likelihood that was maximised, in standardised sizes z = (x - centre) / spread."""
        penalty = self.repeats if self.method == "Firth" else None
        floor, ceiling = self.curve.floor, self.curve.ceiling
        return _data(self.x, self.hit, self.curve.link, penalty=penalty, floor=floor, ceiling=ceiling)


@dataclass(frozen=True)
class FloorCeilingTest:
    """A test whether floor or ceiling are needed: ``statistic`` = fall in deviance over ``repeats``; ``p_value`` from
    the mixture of chi-squares of a parameter on its boundary; ``needed`` at 5 %; ``fit`` the fit with them."""

    bounded: Between
    statistic: float
    p_value: float
    fit: HitMissFit

    @property
    def needed(self) -> bool:
        """Return whether two parameters do not suffice at the 5 % level."""
        return self.p_value < 0.05


def fit_hit_miss(
    size: Sequence[float] | np.ndarray,
    hit: Sequence[float] | np.ndarray,
    *,
    link: str = "logit",
    log_size: bool = False,
    inspections: Sequence[object] | np.ndarray | None = None,
    bounded: Between = "none",
) -> HitMissFit:
    """Fit the POD curve of hits (0/1, (n,)) at sizes ((n,), any unit); ``inspections`` (n,): the target of each row.

    Where hits and misses do not overlap there is no maximum of the likelihood: Firth's penalised one is fitted, with
    a note. `UserError` for values that cannot be fitted and for a chance of detection that does not grow with size.
    """
    x, hits = _checked(size, hit, link, log_size, bounded)
    targets = _number_of_targets(x, inspections)
    repeats = len(x) / targets
    # Complete and quasi-complete separation on a line, either way round: Albert and Anderson, Biometrika 71 (1984).
    separated = bool(x[~hits].max() <= x[hits].min() or x[hits].max() <= x[~hits].min())
    data = _data(x, hits, link, several=True, penalty=repeats if separated else None)
    notes: tuple[str, ...] = ()
    rate = float(hits.mean())
    if separated:
        if x[hits].mean() < x[~hits].mean():
            raise _not_rising()
        place = np.append(penalised_maxima(data, EXACT)[0], [0.0, 1.0])
        notes = ("no miss is larger than any hit (separation): no maximum likelihood; Firth's penalised likelihood",)
        if bounded != "none":
            notes += (f"no {'floor or ceiling' if bounded == 'both' else bounded} fitted: separated data hold none",)
    else:
        start = np.array([float(link_ppf(link, np.array(rate))), 0.0])
        place = np.append(maxima(data, start, EXACT)[0], [0.0, 1.0])
        if bounded != "none" and place[1] > 0:
            place, notes = _bounded_maximum(_data(x, hits, link), place, bounded)
    if place[1] <= 0:
        raise _not_rising()
    single = _data(x, hits, link, floor=place[2], ceiling=place[3])
    log_likelihood = float(single.value(place[:2]))
    unscale = np.array([[1.0, -x.mean() / x.std()], [0.0, 1.0 / x.std()]])
    b0, b1 = unscale @ place[:2]
    covariance = unscale @ (_covariance(single, place) * repeats) @ unscale.T
    slopes = np.array([[-1.0 / b1, b0 / b1**2], [0.0, -1.0 / b1**2]])  # of mu = -b0 / b1 and sigma = 1 / b1
    of_curve = slopes @ covariance @ slopes.T
    if targets < len(x):
        notes += (f"{len(x)} inspections of {targets} targets count as {targets}: variance times {repeats:.4g}",)
    return HitMissFit(
        curve=PodCurve(link, log_size, float(-b0 / b1), float(1.0 / b1), of_curve, float(place[2]), float(place[3])),
        b0=float(b0),
        b1=float(b1),
        covariance=covariance,
        deviance=-2.0 * log_likelihood,
        null_deviance=float(-2.0 * len(x) * (rate * np.log(rate) + (1.0 - rate) * np.log1p(-rate))),
        log_likelihood=log_likelihood,
        n=len(x),
        hits=int(hits.sum()),
        targets=targets,
        separated=separated,
        method="Firth" if separated else "ML",
        notes=notes,
        bounded="none" if separated else bounded,
        x=x,
        hit=hits,
    )


def choose_model(
    size: Sequence[float] | np.ndarray,
    hit: Sequence[float] | np.ndarray,
    *,
    links: Sequence[str] = LINKS,
    inspections: Sequence[object] | np.ndarray | None = None,
    bounded: Between = "none",
) -> tuple[HitMissFit, ...]:
    """Fit every link with a and (where all sizes are positive) ln a, least deviance first. The order knows nothing of
    the limits: a model chosen because its limit is small has no coverage."""
    logs = (False, True) if np.all(np.asarray(size, float) > 0) else (False,)
    fits = [
        fit_hit_miss(size, hit, link=link, log_size=log_size, inspections=inspections, bounded=bounded)
        for log_size, link in product(logs, links)
    ]
    return tuple(sorted(fits, key=lambda fit: fit.deviance))


def floor_ceiling_test(
    size: Sequence[float] | np.ndarray,
    hit: Sequence[float] | np.ndarray,
    *,
    bounded: Between = "both",
    link: str = "logit",
    log_size: bool = False,
    inspections: Sequence[object] | np.ndarray | None = None,
) -> FloorCeilingTest:
    """Test three or four parameters against two by the likelihood ratio.

    A floor of 0 and a ceiling of 1 lie on the boundary, so the statistic is distributed as 1/2 chi2(0) + 1/2 chi2(1)
    for one of them and 1/4, 1/2, 1/4 of chi2(0), chi2(1), chi2(2) for both (Self and Liang, JASA 82 (1987), 605, cases
    5 and 7, with the correlation of floor and ceiling neglected: they are fed by opposite ends of the sizes).
    """
    if bounded == "none":
        raise UserError("a test of floor and ceiling needs one of them", legal="floor, ceiling, both")
    plain = fit_hit_miss(size, hit, link=link, log_size=log_size, inspections=inspections)
    fit = fit_hit_miss(size, hit, link=link, log_size=log_size, inspections=inspections, bounded=bounded)
    statistic = max((plain.deviance - fit.deviance) / plain.repeats, 0.0)
    one, two = stats.chi2.sf(statistic, [1, 2])
    tail = float(0.5 * one if bounded != "both" else 0.5 * one + 0.25 * two)
    return FloorCeilingTest(bounded, statistic, tail if statistic > 1e-9 else 1.0, fit)


# floor and ceiling


def value_and_gradient(data: HitsAndMisses, place: np.ndarray) -> tuple[float, np.ndarray]:
    """Log-likelihood of one study and its gradient (4,) at (b0, b1, floor, ceiling)."""
    b0, b1, floor, ceiling = place
    share, miss, density = np.exp(logs_of_link(data.link, b0 + b1 * data.z))
    p_hit = np.maximum(floor + (ceiling - floor) * share, 1e-300)
    p_miss = np.maximum((1.0 - ceiling) + (ceiling - floor) * miss, 1e-300)
    hit = data.hits > 0
    slope = np.where(hit, 1.0 / p_hit, -1.0 / p_miss)
    along = slope * (ceiling - floor) * density
    gradient = np.array([along.sum(), along @ data.z, slope @ (1.0 - share), slope @ share])
    return float(np.log(np.where(hit, p_hit, p_miss)).sum()), gradient


def most_likely_below(data: HitsAndMisses, place: np.ndarray, bounded: str, pod: float) -> float:
    """Largest log-likelihood of the curves whose ceiling is at most ``pod``; -inf where the ceiling is fixed at 1.
    ``place`` (4,): the best curve of all, which guides the search."""
    if bounded not in ("ceiling", "both") or pod < 0.5:
        return float("-inf")
    return _search(data, place, (0.0, 0.5) if bounded == "both" else (0.0, 0.0), (0.5, pod))[1]


def bounded_profile(data: HitsAndMisses, place: np.ndarray, bounded: str, z0: float, pod: float) -> float:
    """Largest log-likelihood of the curves with floor < ``pod`` < ceiling that are ``pod`` at ``z0``; ``place`` (4,):
    the best curve of all, from which the search starts."""
    floor = (0.0, min(0.5, pod - NEAR_EDGE)) if bounded in ("floor", "both") else (0.0, 0.0)
    ceiling = (max(0.5, pod + NEAR_EDGE), 1.0) if bounded in ("ceiling", "both") else (1.0, 1.0)

    def loss(at: np.ndarray) -> tuple[float, np.ndarray]:
        b1, between = float(np.exp(at[0])), at[2] - at[1]
        share = float(np.clip((pod - at[1]) / between, 1e-12, 1.0 - 1e-12))
        predictor = float(link_ppf(data.link, np.array(share)))
        value, by = value_and_gradient(data, np.array([predictor - b1 * z0, b1, at[1], at[2]]))
        by_share = by[0] / np.exp(float(logs_of_link(data.link, np.array(predictor))[2])) / between
        return -value, -np.array(
            [b1 * (by[1] - z0 * by[0]), by[2] - by_share * (1.0 - share), by[3] - by_share * share]
        )

    floors = sorted({float(np.clip(f, *floor)) for f in (place[2], 0.01)})
    ceilings = sorted({float(np.clip(c, *ceiling)) for c in (place[3], 0.5 * (1.0 + pod))})
    limits = ((np.log(1e-6), np.log(STEEPEST)), floor, ceiling)
    return -min(
        float(optimize.minimize(loss, [np.log(b1), f, c], jac=True, method="L-BFGS-B", bounds=limits).fun)
        for b1, f, c in product((place[1], 0.3 * place[1]), floors, ceilings)
    )


def _bounded_maximum(data: HitsAndMisses, plain: np.ndarray, bounded: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """The largest likelihood with a floor, a ceiling or both, and notes; ``plain`` (4,) that without them."""
    floor = (0.0, 0.5) if bounded in ("floor", "both") else (0.0, 0.0)
    ceiling = (0.5, 1.0) if bounded in ("ceiling", "both") else (1.0, 1.0)
    best, value = _search(data, plain, floor, ceiling)
    best = best if value > float(data.value(plain[:2])) + 1e-9 else plain
    share = np.exp(logs_of_link(data.link, best[0] + best[1] * data.z)[0])
    if len(np.unique(data.z[(share > 0.01) & (share < 0.99)])) < 2:
        return best, ("fewer than two sizes lie on the curve's rise: it is a step, whose width means nothing",)
    return best, ()


def _search(
    data: HitsAndMisses, plain: np.ndarray, floor: tuple[float, float], ceiling: tuple[float, float]
) -> tuple[np.ndarray, float]:
    """The likeliest curve (4,) with floor and ceiling in these ranges, and its log-likelihood.

    Floor and ceiling free the curve to rise steeply anywhere, and each such place can hold a maximum. So the search
    starts from the likeliest places of a coarse grid, each with a middle and a slope of its own, and from the three
    likeliest steps between neighbouring sizes, where the chance jumps from the share of hits below to that above: the
    limit that a steep slope tends to.
    """
    z = data.z
    floors = sorted({float(np.clip(f, *floor)) for f in (0.02, 0.1, 0.25)})
    ceilings = sorted({float(np.clip(c, *ceiling)) for c in (0.75, 0.9, 0.98)})
    middles = np.unique(np.append(np.quantile(z, np.linspace(0.04, 0.96, 16)), -plain[0] / plain[1]))
    likeliest = []
    for middle, b1 in product(middles, plain[1] * np.array([1.0, 3.0, 12.0, 50.0])):
        places = [np.array([-b1 * middle, min(b1, STEEPEST), f, c]) for f, c in product(floors, ceilings)]
        values = [value_and_gradient(data, place)[0] for place in places]
        best = int(np.argmax(values))
        likeliest.append((values[best], places[best]))
    likeliest.sort(key=lambda pair: -pair[0])
    starts = [place for _, place in likeliest[:STARTS]]

    order = np.argsort(z, kind="stable")
    sizes, first = np.unique(z[order], return_index=True)
    below, hits = np.append(0.0, np.cumsum(data.hits[order]))[first[1:]], data.hits.sum()
    low, high = np.clip(below / first[1:], *floor), np.clip((hits - below) / (len(z) - first[1:]), *ceiling)
    value = xlogy(below, low) + xlogy(first[1:] - below, 1.0 - low) + xlogy(hits - below, high)
    value += xlogy(len(z) - first[1:] - (hits - below), 1.0 - high)
    slope, middle = np.minimum(6.0 / np.diff(sizes), STEEPEST), 0.5 * (sizes[1:] + sizes[:-1])
    starts += [
        np.array([-slope[k] * middle[k], slope[k], low[k], high[k]]) for k in np.argsort(-value, kind="stable")[:3]
    ]

    found, largest = plain, float("-inf")
    for start in starts:
        end = optimize.minimize(
            lambda place: tuple(-part for part in value_and_gradient(data, place)),
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=((-STEEPEST * 10, STEEPEST * 10), (1e-6, STEEPEST), floor, ceiling),
            options={"ftol": 1e-13, "gtol": 1e-8, "maxiter": 500},
        )
        if -end.fun > largest + 1e-9:
            found, largest = end.x, -float(end.fun)
    return found, largest


def _covariance(data: HitsAndMisses, place: np.ndarray) -> np.ndarray:
    """(2, 2) covariance of (b0, b1): inverse expected information over the parameters off their boundaries."""
    b0, b1, floor, ceiling = place
    if floor <= 0 and ceiling >= 1:
        return np.asarray(np.linalg.inv(data.information(place[:2])))
    share, _, density = np.exp(logs_of_link(data.link, b0 + b1 * data.z))
    p = np.clip(floor + (ceiling - floor) * share, 1e-12, 1.0 - 1e-12)
    slopes = [(ceiling - floor) * density, (ceiling - floor) * density * data.z]
    slopes += [1.0 - share] if floor > NEAR_EDGE else []
    slopes += [share] if ceiling < 1.0 - NEAR_EDGE else []
    design = np.column_stack(slopes)
    return np.asarray(np.linalg.pinv(design.T @ (design / (p * (1.0 - p))[:, None]))[:2, :2])


# what is given


def _data(
    x: np.ndarray,
    hit: np.ndarray,
    link: str,
    *,
    several: bool = False,
    penalty: float | None = None,
    floor: float = 0.0,
    ceiling: float = 1.0,
) -> HitsAndMisses:
    """The study in standardised sizes, or as the only one of several."""
    design = np.column_stack([np.ones_like(x), (x - x.mean()) / x.std()])
    found = hit.astype(float)[None] if several else hit.astype(float)
    return HitsAndMisses(design, found, 1.0 - found, link, penalty, floor=floor, ceiling=ceiling)


def _checked(
    size: Sequence[float] | np.ndarray, hit: Sequence[float] | np.ndarray, link: str, log_size: bool, bounded: Between
) -> tuple[np.ndarray, np.ndarray]:
    """x (n,) and hits (n,) as booleans, or the user's mistake."""
    sizes, hits = np.asarray(size, float), np.asarray(hit, float)
    if link not in LINKS:
        raise UserError(f"link {link!r} is not known", legal=", ".join(LINKS))
    if bounded not in BOUNDED:
        raise UserError(f"bounded {bounded!r} is not known", legal=", ".join(BOUNDED))
    if sizes.ndim != 1 or sizes.shape != hits.shape:
        raise UserError(f"sizes {sizes.shape} and hits {hits.shape} differ in shape", legal="one hit for each size")
    if not np.isfinite(sizes).all():
        raise UserError(f"size {np.flatnonzero(~np.isfinite(sizes))[0]} is not a finite number")
    if not np.isin(hits, (0.0, 1.0)).all():
        at = int(np.flatnonzero(~np.isin(hits, (0.0, 1.0)))[0])
        raise UserError(f"hit {at} is {hits[at]:g}", legal="0 (missed) or 1 (found)")
    if hits.all() or not hits.any():
        every = "found" if len(hits) and hits.all() else "missed"
        raise UserError(f"every target was {every}: there is no curve to fit", fix="inspect sizes on both sides of it")
    if log_size and sizes.min() <= 0:
        raise UserError(f"size {sizes.min():g} has no logarithm", legal="sizes > 0", fix="fit size itself")
    if np.ptp(sizes) == 0:
        raise UserError(f"all sizes are {sizes[0]:g}: POD against size needs more than one")
    return np.log(sizes) if log_size else sizes, hits == 1.0


def _number_of_targets(x: np.ndarray, inspections: Sequence[object] | np.ndarray | None) -> int:
    """Count the different targets that the rows inspect; a target has one size."""
    if inspections is None:
        return len(x)
    names = [str(name) for name in inspections]
    if len(names) != len(x):
        raise UserError(f"{len(names)} identities of targets for {len(x)} rows", legal="one for each row")
    size_of: dict[str, float] = {}
    for name, value in zip(names, x, strict=True):
        if size_of.setdefault(name, float(value)) != value:
            raise UserError(f"target {name} has more than one size", legal="one size for each target")
    return len(size_of)


def _not_rising() -> UserError:
    return UserError(
        "the chance of detection does not grow with size: the slope is not positive",
        fix="check that hits are 1 and misses 0, and that size is what detection depends on",
    )
