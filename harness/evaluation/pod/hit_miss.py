"""Probability of detection from hits and misses: a binomial regression on size, by MIL-HDBK-1823A appendix G.

A target that was inspected k times is one target: rows that share an identity in ``inspections`` are taken as fully
dependent (the handbook's conservative reading), so covariance and likelihood ratio criterion are scaled by k, the mean
number of inspections a target. Not modelled: targets that differ in anything but size, and inspectors as a factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import stats

from harness.evaluation.pod.curve import LINKS, PodCurve
from harness.evaluation.pod.floor_ceiling import BOUNDED, Bounded, bounded_covariance, bounded_maximum
from harness.evaluation.pod.likelihood import HitsAndMisses, maximum, penalised_maximum
from harness.vocabulary.errors import UserError

Between = Literal["none", "floor", "ceiling", "both"]


@dataclass(frozen=True, eq=False)
class HitMissFit:
    """A fitted curve and what it rests on.

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
    def data(self) -> HitsAndMisses:
        """The likelihood that was maximised, in standardised sizes z = (x - centre) / spread."""
        z = (self.x - self.centre) / self.spread
        penalty = self.repeats if self.method == "Firth" else 0.0
        return HitsAndMisses(z, self.hit, self.curve.link, penalty, self.curve.floor, self.curve.ceiling)


@dataclass(frozen=True)
class FloorCeilingTest:
    """Whether a floor or a ceiling is needed: ``statistic`` = fall in deviance over ``repeats``; ``p_value`` from the
    mixture of chi-squares of a parameter on its boundary; ``needed`` at 5 %; ``fit`` the one with them."""

    bounded: Between
    statistic: float
    p_value: float
    fit: HitMissFit

    @property
    def needed(self) -> bool:
        """Whether two parameters do not suffice at the 5 % level."""
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
    """The POD curve of hits (0/1, (n,)) at sizes ((n,), any unit); ``inspections`` (n,): which target a row inspects.

    Where hits and misses do not overlap there is no maximum of the likelihood: Firth's penalised one is fitted, with
    a note. `UserError` for values that cannot be fitted and for a chance of detection that does not grow with size.
    """
    x, hits = _checked(size, hit, link, log_size, bounded)
    targets = _number_of_targets(x, inspections)
    data = HitsAndMisses((x - x.mean()) / x.std(), hits, link)
    separated = _separated(x, hits)
    place, notes = _maximum(data, bounded, separated, len(x) / targets)
    if place.b1 <= 0:
        raise _not_rising()
    method: Literal["ML", "Firth"] = "Firth" if separated else "ML"
    covariance = bounded_covariance(data, place) * len(x) / targets
    unscale = np.array([[1.0, -x.mean() / x.std()], [0.0, 1.0 / x.std()]])
    b0, b1 = unscale @ np.array([place.b0, place.b1])
    covariance = unscale @ covariance @ unscale.T
    rate = float(hits.mean())
    log_likelihood = place.log_likelihood
    null = len(x) * (rate * np.log(rate) + (1.0 - rate) * np.log1p(-rate))
    if targets < len(x):
        notes += (
            f"{len(x)} inspections of {targets} targets count as {targets}: variance times {len(x) / targets:.4g}",
        )
    return HitMissFit(
        curve=_curve(link, log_size, b0, b1, covariance, place),
        b0=float(b0),
        b1=float(b1),
        covariance=covariance,
        deviance=-2.0 * log_likelihood,
        null_deviance=float(-2.0 * null),
        log_likelihood=log_likelihood,
        n=len(x),
        hits=int(hits.sum()),
        targets=targets,
        separated=separated,
        method=method,
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
    """Every link with a and (where all sizes are positive) ln a, least deviance first. The order knows nothing of the
    limits: a model chosen because its limit is small has no coverage."""
    logs = (False, True) if np.all(np.asarray(size, float) > 0) else (False,)
    fits = [
        fit_hit_miss(size, hit, link=link, log_size=log_size, inspections=inspections, bounded=bounded)
        for log_size in logs
        for link in links
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
    """Likelihood ratio test of three or four parameters against two.

    A floor of 0 and a ceiling of 1 lie on the boundary, so the statistic is distributed as 1/2 chi2(0) + 1/2 chi2(1)
    for one of them and 1/4, 1/2, 1/4 of chi2(0), chi2(1), chi2(2) for both (Self and Liang, JASA 82 (1987), 605, cases
    5 and 7, with the correlation of floor and ceiling neglected: they are fed by opposite ends of the sizes).
    """
    if bounded == "none":
        raise UserError("a test of floor and ceiling needs one of them", legal="floor, ceiling, both")
    plain = fit_hit_miss(size, hit, link=link, log_size=log_size, inspections=inspections)
    fit = fit_hit_miss(size, hit, link=link, log_size=log_size, inspections=inspections, bounded=bounded)
    statistic = max((plain.deviance - fit.deviance) / plain.repeats, 0.0)
    one, two = float(stats.chi2.sf(statistic, 1)), float(stats.chi2.sf(statistic, 2))
    tail = 0.5 * one if bounded != "both" else 0.5 * one + 0.25 * two
    return FloorCeilingTest(bounded, statistic, tail if statistic > 1e-9 else 1.0, fit)


def _maximum(data: HitsAndMisses, bounded: Between, separated: bool, repeats: float) -> tuple[Bounded, tuple[str, ...]]:
    """Where the likelihood is largest, in standardised sizes, and what is to be said of it."""
    if not separated:
        b0, b1 = maximum(data)
        plain = Bounded(b0, b1, 0.0, 1.0, float(data.value(b0, b1)))
        if bounded == "none" or b1 <= 0:
            return plain, ()
        return bounded_maximum(data, plain, bounded)
    if data.z[data.hit].mean() < data.z[~data.hit].mean():
        raise _not_rising()
    b0, b1 = penalised_maximum(replace(data, penalty=repeats))
    notes: tuple[str, ...] = (
        "no miss is larger than any hit (separation): no maximum likelihood; Firth's penalised likelihood",
    )
    if bounded != "none":
        notes += (f"no {'floor or ceiling' if bounded == 'both' else bounded} fitted: separated data hold none",)
    return Bounded(b0, b1, 0.0, 1.0, float(data.value(b0, b1))), notes


def _separated(x: np.ndarray, hit: np.ndarray) -> bool:
    """Complete and quasi-complete separation on a line, either way round: Albert and Anderson, Biometrika 71 (1984)."""
    misses, hits = x[~hit], x[hit]
    return bool(misses.max() <= hits.min() or hits.max() <= misses.min())


def _curve(link: str, log_size: bool, b0: float, b1: float, covariance: np.ndarray, place: Bounded) -> PodCurve:
    """mu = -b0 / b1, sigma = 1 / b1, with the covariance of the two by the delta method."""
    slopes = np.array([[-1.0 / b1, b0 / b1**2], [0.0, -1.0 / b1**2]])
    return PodCurve(
        link, log_size, float(-b0 / b1), float(1.0 / b1), slopes @ covariance @ slopes.T, place.floor, place.ceiling
    )


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
    """How many different targets the rows inspect; one target has one size."""
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
