"""The statement on one set of inspections, from hits and misses or from signals: curve, bounds,
and their basis."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from scipy import stats
from threadpoolctl import ThreadpoolController

from harness.evaluation.pod import hit_miss
from harness.evaluation.pod.ahat import LEVEL, AhatFit, ahat_band, ahat_bound, choose_axes, diagnose
from harness.evaluation.pod.curve import Bound, PodCurve
from harness.evaluation.pod.hit_miss import NEAR_DEVIANCE, Beyond, HitMissFit
from harness.evaluation.pod.inspections import Inspections
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import jsonable

# the field's usual statement, a90/95
POD = 0.9
CONFIDENCE = 0.95
DRAWN = 241  # number of sizes at which the curve and the band are drawn
LEAST_TARGETS = 60  # fewest independent targets of a hit/miss study, by MIL-HDBK-1823A
# largest relative difference between the a90/95 of models that fit about equally well without a
# warning
APART = 0.05
DOUBTED = ": do not trust its limit"
# finds the libraries that compute in threads, which takes 2 ms
POOLS = cache(ThreadpoolController)
FEWEST_SITES = 5  # fewest unflawed sites whose signals can be fitted by a distribution
TESTED: dict[Beyond, str] = {
    "floor": "a floor: hits by chance at any size",
    "ceiling": "a ceiling: misses at any size",
    "both": "floor and ceiling",
}


@dataclass(frozen=True)
class ModelRow:
    """A model that was tried. ``deviance``: a smaller one fits better. ``in_bound``: whether its bound
    is among those of which the statement's bound is the largest."""

    name: str
    deviance: float
    a50: float
    a90: float
    bound: Bound
    chosen: bool
    in_bound: bool


@dataclass(frozen=True)
class PodStatement:
    """The statement on the inspections ``read``. ``unit``: of sizes. ``fits``: for hits, the
    models whose largest bound and widest band are stated, that of the curve first. ``signal``: the
    regression, None for hits. ``models``: all that were tried. ``numbers``: further results of the
    fit. ``tests``: (subject, p-value, text)."""

    read: Inspections
    kind: str
    unit: str
    fits: tuple[HitMissFit, ...]
    signal: AhatFit | None
    models: tuple[ModelRow, ...]
    bound: Bound
    numbers: dict[str, float]
    notes: tuple[str, ...]
    tests: tuple[tuple[str, float, str], ...]

    @property
    def curve(self) -> PodCurve:
        """The curve that is stated."""
        return (self.signal or self.fits[0]).curve

    @property
    def a50(self) -> float:
        """Size found 50 % of the time."""
        return self.curve.size_at(0.5)

    @property
    def a90(self) -> float:
        """Size found 90 % of the time."""
        return self.curve.size_at(POD)

    @cached_property
    def sizes(self) -> np.ndarray:
        """Sizes (`DRAWN`,) at which the curve and its band are drawn."""
        return drawn_sizes(self.read.size, self.curve.log_size, (self.a90, self.bound.value))

    @cached_property
    def band(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper edges (`DRAWN`,) of the band; computed when needed, because it takes
        long."""
        if self.signal:
            return ahat_band(self.signal, self.sizes, CONFIDENCE)
        # the envelope of the models: its lower edge crosses 90 % at their `largest_bound`
        low, high = zip(*(hit_miss.band(fit, self.sizes) for fit in self.fits), strict=True)
        return np.min(low, axis=0), np.max(high, axis=0)

    @property
    def model(self) -> str:
        """Name of the model of the curve."""
        return next(row.name for row in self.models if row.chosen)

    @property
    def counts(self) -> str:
        """Numbers of inspections, targets and hits."""
        rows = f"{len(self.read.size)} inspections of {self.read.targets} targets"
        return rows if self.signal else f"{rows}, {int(self.read.response.sum())} hits"

    @property
    def doubts(self) -> list[str]:
        """Return warnings: near models with a90/95 more than `APART` apart; data that suggest a
        floor or ceiling."""
        doubts = [note for note in self.notes if note.endswith(DOUBTED)]
        most = (
            min(row.deviance for row in self.models)
            + NEAR_DEVIANCE * len(self.read.size) / self.read.targets
        )
        limits = [row.bound.value for row in self.models if row.deviance <= most]
        if max(limits) <= (1 + APART) * min(limits):
            return doubts
        texts = [
            f"{limit:.3g}" if np.isfinite(limit) else "not demonstrated"
            for limit in (min(limits), max(limits))
        ]
        return [
            f"{len(limits)} models fit about equally well, and their a90/95 differ: {' to '.join(texts)}",
            *doubts,
        ]

    def to_data(self) -> dict[str, Any]:
        """Return the statement as JSON's types; an infinite size becomes None, and ``why`` gives
        the reason."""
        curve = self.curve
        read = self.read
        of_curve = {name: getattr(curve, name) for name in ("link", "log_size", "mu", "sigma")}
        models = [
            {"model": row.name, **{name: getattr(row, name) for name in ("deviance", "a50", "a90")}}
            | {"a90_95": _bound_data(row.bound), "chosen": row.chosen, "in_a90_95": row.in_bound}
            for row in self.models
        ]
        data = {
            "file": str(read.path),
            **{"kind": self.kind, "unit": self.unit, "size_column": read.size_column},
            **{
                "response_column": read.response_column,
                "targets": read.targets,
                "model": self.model,
            },
            "inspections": len(read.size),
            "hits": None if self.signal else int(read.response.sum()),
            "curve": {**of_curve, "covariance_mu_sigma": curve.covariance},
            **{"a50": self.a50, "a90": self.a90},
            "a90_95": _bound_data(self.bound),
            "models": models,
            "numbers": self.numbers,
            "tests": [{"test": what, "p": p, "reads": reads} for what, p, reads in self.tests],
            **{"notes": self.notes, "warnings": self.doubts},
        }
        return dict(jsonable(data))


def state_hits(
    read: Inspections,
    *,
    link: str | None = None,
    log_size: bool | None = None,
    unit: str = "",
    tested: bool = True,
) -> PodStatement:
    """State the curve of hits and misses: the fit with the least deviance, over all links and over
    sizes or their logarithms, unless ``link`` or ``log_size`` restricts them. The bound is the
    largest over the `near_models` among these fits. ``tested``: whether to test for hits by chance
    and misses at any size, which takes most of the time."""
    # L-BFGS-B solves tiny systems with LAPACK, whose threads wait for each other: 9 s instead of
    # 0.6 s on busy cores
    with POOLS().limit(limits=1, user_api="blas"):
        size = read.size
        hit = read.response
        tried = hit_miss.choose_model(size, hit, inspections=read.target)
        left = [
            fit
            for fit in tried
            if link in (None, fit.curve.link) and log_size in (None, fit.curve.log_size)
        ]
        fit = left[0]
        near = hit_miss.near_models(left)
        curve = fit.curve
        notes = [*read.notes, *fit.notes]
        tests = hit_miss.floor_ceiling_tests(fit) if tested else ()
        models = [(fit, hit_miss.bound(fit, POD, CONFIDENCE)) for fit in tried]
        limit = max((limit for fit, limit in models if fit in near), key=lambda limit: limit.value)

    if fit.targets < LEAST_TARGETS:
        notes.append(
            f"{fit.targets} independent targets; MIL-HDBK-1823A asks for at least {LEAST_TARGETS}"
        )
    if limit.demonstrated and limit.value > (largest := float(size.max())):
        notes.append(
            f"a90/95 = {limit.value:.3g} lies beyond the largest size inspected, {largest:.4g}"
        )
    if any(test.needed for test in tests):
        likeliest = min(tests, key=lambda test: test.p_value)
        suggests = f"the data suggest {TESTED[likeliest.beyond]} (p = {likeliest.p_value:.2g})"
        notes.append(f"the curve has no floor or ceiling, and {suggests}{DOUBTED}")
    texts = []
    for test in tests:
        fitted = f"(floor {test.floor:.3f}, ceiling {test.ceiling:.3f})"
        texts.append(
            (
                TESTED[test.beyond],
                test.p_value,
                f"{'needed' if test.needed else 'not needed'} {fitted}",
            )
        )
    errors = np.sqrt(np.diag(fit.covariance)).tolist()
    numbers = {
        "b0": fit.b0,
        "b0's standard error": errors[0],
        "b1": fit.b1,
        "b1's standard error": errors[1],
    }
    numbers |= {"mu": curve.mu, "sigma": curve.sigma, "deviance": fit.deviance}
    numbers |= {"deviance of a constant": fit.null_deviance, "log likelihood": fit.log_likelihood}
    numbers |= {"inspections": float(fit.n), "targets": float(fit.targets), "hits": float(fit.hits)}
    numbers |= false_positives(read)
    what = (read, "hit/miss", unit, near, None, _models(models, near), limit)
    return PodStatement(*what, numbers, tuple(notes), tuple(texts))


def state_signals(
    read: Inspections,
    *,
    decision: float,
    left: float | None = None,
    right: float | None = None,
    log_size: bool | None = None,
    log_signal: bool | None = None,
    unit: str = "",
) -> PodStatement:
    """State the curve of signals against sizes: the fit with the least deviance over all pairs of
    axes that the data allow, unless ``log_size`` or ``log_signal`` restricts them. Bounds are by
    the delta method on x."""
    tried = choose_axes(
        read.size, read.response, decision=decision, left=left, right=right, inspections=read.target
    )
    fits = [
        fit
        for fit in tried
        if log_size in (None, fit.log_size) and log_signal in (None, fit.log_signal)
    ]
    if not fits:
        fix = "leave out --log or --log-signal"
        raise UserError(f"{read.path}: the requested axes need logarithms of values <= 0", fix=fix)
    fit = fits[0]
    curve = fits[0].curve
    limit = ahat_bound(fit, POD, CONFIDENCE)
    (of_mu, common), (_, of_sigma) = curve.covariance.tolist()
    numbers = {"b0": fit.b0, "b1": fit.b1, "tau": fit.tau, "mu": curve.mu, "sigma": curve.sigma}
    numbers |= {
        "variance of mu": of_mu,
        "covariance of mu, sigma": common,
        "variance of sigma": of_sigma,
    }
    numbers |= {"signals at or below --left": float(fit.below.sum())}
    numbers |= {"signals at or above --right": float(fit.above.sum()), "decision": fit.decision}
    numbers |= false_positives(read, fit)
    models = [(fit, ahat_bound(fit, POD, CONFIDENCE)) for fit in tried]
    reads = {True: f"doubtful at {LEVEL:.0%}", False: f"not rejected at {LEVEL:.0%}"}
    tests = [
        (f"{test.assumption} ({test.test})", test.p_value, reads[test.p_value < LEVEL])
        for test in diagnose(fit)
    ]
    what = (read, "signal against size", unit, (), fit, _models(models, (fit,)), limit)
    return PodStatement(*what, numbers, (*read.notes, *fit.notes), tuple(tests))


def _models(tried: Sequence[tuple[Any, Bound]], near: Sequence[Any]) -> tuple[ModelRow, ...]:
    """Return rows of fits with their limits; the first of the ``near`` fits is that of the curve."""

    def name(fit: HitMissFit | AhatFit) -> str:
        size = "ln size" if fit.curve.log_size else "size"
        if isinstance(fit, AhatFit):
            return f"{'ln signal' if fit.log_signal else 'signal'} against {size}"
        return f"{fit.curve.link}, {size}"

    return tuple(
        ModelRow(
            *(name(fit), fit.deviance, fit.curve.size_at(0.5), fit.curve.size_at(POD)),
            *(limit, fit is near[0], any(fit is each for each in near)),
        )
        for fit, limit in tried
    )


def false_positives(read: Inspections, fit: AhatFit | None = None) -> dict[str, float]:
    """Return the probability of a false positive at unflawed sites, by name; empty if there are no
    sites. It is the share of calls with its upper bound (Clopper and Pearson); for signals, also
    by the normal distribution that fits the noise best on the fit's axis, with signals up to the
    left limit censored (MIL-HDBK-1823A, 4.5.4 and G.3.4)."""
    sites = read.unflawed
    if not sites.size:
        return {}
    calls = int((sites > (0.5 if fit is None else fit.decision)).sum())
    upper = stats.beta.ppf(CONFIDENCE, calls + 1, len(sites) - calls) if calls < len(sites) else 1.0
    found = {"unflawed sites": float(len(sites)), "false positives": float(calls)}
    found |= {"PFP": calls / len(sites), f"PFP's {100 * CONFIDENCE:g} % upper bound": float(upper)}
    if fit is None or (fit.log_signal and not (sites > 0).all()) or len(sites) < FEWEST_SITES:
        return found
    limit = -np.inf if fit.left is None else fit.left
    below = sites <= limit
    if len(np.unique(sites[~below])) < FEWEST_SITES:
        return found
    put: np.ufunc = np.log if fit.log_signal else np.positive
    noise = stats.CensoredData(put(sites[~below]), left=put(np.full(int(below.sum()), limit)))
    law = stats.norm(*stats.norm.fit(noise))
    return found | {"PFP by the noise's normal law": float(law.sf(put(fit.decision)))}


def drawn_sizes(size: np.ndarray, log_size: bool, marks: tuple[float, ...]) -> np.ndarray:
    """Return sizes (`DRAWN`,) from just below the smallest to just above the largest, and beyond
    those ``marks`` that are at most twice the largest size; in equal steps, or in equal ratios if
    ``log_size``."""
    low = float(size.min())
    high = float(size.max())
    high = max([high, *(mark for mark in marks if np.isfinite(mark) and high < mark < 2 * high)])
    if log_size:
        margin = (high / low) ** 0.04
        return np.geomspace(low / margin, high * margin, DRAWN)
    margin = 0.04 * (high - low)
    start = max(low - margin, 0.0) if low >= 0 else low - margin
    return np.linspace(start, high + margin, DRAWN)


def _bound_data(bound: Bound) -> dict[str, Any]:
    facts = {
        name: getattr(bound, name)
        for name in ("pod", "confidence", "method", "demonstrated", "why")
    }
    return {**facts, "size": bound.value}
