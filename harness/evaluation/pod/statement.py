"""The statement on one set of inspections, from hits and misses or from signals: curve, bounds,
and their basis."""

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from scipy import special
from threadpoolctl import ThreadpoolController

from harness.evaluation.pod import hit_miss
from harness.evaluation.pod.ahat import (
    LEVEL,
    AhatFit,
    Diagnostic,
    ahat_band,
    ahat_bound,
    choose_axes,
    diagnose,
)
from harness.evaluation.pod.averaged import ModelAverage
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
    """A model that was tried."""

    name: str
    """Link and axis, such as ``logit, ln size``."""
    deviance: float
    """-2 times the log-likelihood; a smaller one fits better."""
    a50: float
    """Size found 50 % of the time."""
    a90: float
    """Size found 90 % of the time."""
    bound: Bound
    """Its a90/95."""
    chosen: bool
    """True if it is the curve that is stated."""
    in_bound: bool
    """True if the statement's bound and band are of this model, alone or among others."""


@dataclass(frozen=True)
class PodStatement:
    """The statement on one set of inspections."""

    read: Inspections
    """The inspections."""
    kind: str
    """``hit/miss`` or ``signal against size``."""
    unit: str
    """Unit of sizes; may be empty."""
    fits: tuple[HitMissFit, ...]
    """Models of hits that fit about equally well, that of the curve first; empty for signals."""
    average: ModelAverage | None
    """Their average, of which bound and band are; None for a model that the user states, and for
    signals."""
    signal: AhatFit | None
    """The regression of signals; None for hits."""
    tried: tuple[HitMissFit | AhatFit, ...]
    """All models that were tried, the likeliest first."""
    bound: Bound
    """a90/95."""
    numbers: dict[str, float]
    """Further results of the fit, by name."""
    notes: tuple[str, ...]
    """Remarks on rows and fit."""
    tests: tuple[tuple[str, float, str], ...]
    """Tests of the model: subject, p-value, reading."""

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
        if self.average:
            return self.average.band(self.sizes)
        return hit_miss.band(self.fits[0], self.sizes)

    @property
    def model(self) -> str:
        """Name of the model of the curve."""
        return _model_name(self.signal or self.fits[0])

    @cached_property
    def models(self) -> tuple[ModelRow, ...]:
        """All models that were tried, with their bounds; computed when needed, as studies do not
        show them."""
        close_fits = self.fits or (self.signal,)
        rows = []
        for fit in self.tried:
            row = ModelRow(
                name=_model_name(fit),
                deviance=fit.deviance,
                a50=fit.curve.size_at(0.5),
                a90=fit.curve.size_at(POD),
                bound=_bound_of(fit),
                chosen=fit is close_fits[0],
                in_bound=any(fit is close_fit for close_fit in close_fits),
            )
            rows.append(row)
        return tuple(rows)

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
        least = min(row.deviance for row in self.models)
        rows_per_target = len(self.read.size) / self.read.targets
        near_deviance = least + NEAR_DEVIANCE * rows_per_target
        limits = [row.bound.value for row in self.models if row.deviance <= near_deviance]
        if max(limits) <= (1 + APART) * min(limits):
            return doubts
        span = f"{_limit_text(min(limits))} to {_limit_text(max(limits))}"
        differ = f"{len(limits)} models fit about equally well, and their a90/95 differ: {span}"
        return [differ, *doubts]

    def to_data(self) -> dict[str, Any]:
        """Return the statement as JSON's types; an infinite size becomes None, and ``why`` gives
        the reason."""
        curve = self.curve
        read = self.read
        data = {
            "file": read.path.as_posix(),
            "kind": self.kind,
            "unit": self.unit,
            "size_column": read.size_column,
            "response_column": read.response_column,
            "targets": read.targets,
            "model": self.model,
            "inspections": len(read.size),
            "hits": None if self.signal else int(read.response.sum()),
            "curve": {
                "link": curve.link,
                "log_size": curve.log_size,
                "mu": curve.mu,
                "sigma": curve.sigma,
                "covariance_mu_sigma": curve.covariance,
            },
            "a50": self.a50,
            "a90": self.a90,
            "a90_95": _bound_data(self.bound),
            "models": [_model_data(row) for row in self.models],
            "numbers": self.numbers,
            "tests": [
                {"test": subject, "p": p, "reads": reads} for subject, p, reads in self.tests
            ],
            "notes": self.notes,
            "warnings": self.doubts,
        }
        return dict(jsonable(data))


def _limit_text(limit: float) -> str:
    return f"{limit:.3g}" if np.isfinite(limit) else "not demonstrated"


def _model_data(row: ModelRow) -> dict[str, Any]:
    return {
        "model": row.name,
        "deviance": row.deviance,
        "a50": row.a50,
        "a90": row.a90,
        "a90_95": _bound_data(row.bound),
        "chosen": row.chosen,
        "in_a90_95": row.in_bound,
    }


def _bound_data(bound: Bound) -> dict[str, Any]:
    return {
        "pod": bound.pod,
        "confidence": bound.confidence,
        "method": bound.method,
        "demonstrated": bound.demonstrated,
        "why": bound.why,
        "size": bound.value,
    }


def state_hits(
    read: Inspections,
    *,
    link: str | None = None,
    log_size: bool | None = None,
    unit: str = "",
    tested: bool = True,
    each_test: bool = True,
) -> PodStatement:
    """State the curve of hits and misses: the fit with the least deviance, over all links and over
    sizes or their logarithms, unless ``link`` or ``log_size`` restricts them. The bound is that of
    the average over the `near_models` among these fits, or the handbook's likelihood ratio bound
    if the user states both. ``tested``: whether to test for hits by chance and misses at any size,
    which takes most of the time. Not ``each_test``: tests that cannot
    lead to a note may be left out."""
    size = read.size
    # L-BFGS-B solves tiny systems with LAPACK, whose threads wait for each other: 9 s instead of
    # 0.6 s on busy cores
    with POOLS().limit(limits=1, user_api="blas"):
        tried = hit_miss.choose_model(size, read.response, inspections=read.target)
        allowed = [
            fit
            for fit in tried
            if link in (None, fit.curve.link) and log_size in (None, fit.curve.log_size)
        ]
        fit = allowed[0]
        close_fits = hit_miss.near_models(allowed)
        tests = hit_miss.floor_ceiling_tests(fit, each=each_test) if tested else ()
        average: ModelAverage | None = None
        if len(allowed) > 1:
            average = ModelAverage(close_fits)
        limit = average.bound(POD) if average else _bound_of(fit)

    notes = [*read.notes, *fit.notes]
    if fit.targets < LEAST_TARGETS:
        notes.append(
            f"{fit.targets} independent targets; MIL-HDBK-1823A asks for at least {LEAST_TARGETS}"
        )
    largest = float(size.max())
    if limit.demonstrated and limit.value > largest:
        notes.append(
            f"a90/95 = {limit.value:.3g} lies beyond the largest size inspected, {largest:.4g}"
        )
    if any(test.needed for test in tests):
        likeliest = min(tests, key=lambda test: test.p_value)
        suggests = f"the data suggest {TESTED[likeliest.beyond]} (p = {likeliest.p_value:.2g})"
        notes.append(f"the curve has no floor or ceiling, and {suggests}{DOUBTED}")
    error_of_b0, error_of_b1 = np.sqrt(np.diag(fit.covariance)).tolist()
    numbers = {
        "b0": fit.b0,
        "b0's standard error": error_of_b0,
        "b1": fit.b1,
        "b1's standard error": error_of_b1,
        "mu": fit.curve.mu,
        "sigma": fit.curve.sigma,
        "deviance": fit.deviance,
        "deviance of a constant": fit.null_deviance,
        "log likelihood": fit.log_likelihood,
        "inspections": float(fit.n),
        "targets": float(fit.targets),
        "hits": float(fit.hits),
        **false_positives(read),
    }
    return PodStatement(
        read=read,
        kind="hit/miss",
        unit=unit,
        fits=close_fits,
        average=average,
        signal=None,
        tried=tried,
        bound=limit,
        numbers=numbers,
        notes=tuple(notes),
        tests=tuple(_test_row(test) for test in tests),
    )


def _test_row(test: hit_miss.FloorCeilingTest) -> tuple[str, float, str]:
    """Return a test of a floor or a ceiling as subject, p-value and reading."""
    verdict = "needed" if test.needed else "not needed"
    reading = f"{verdict} (floor {test.floor:.3f}, ceiling {test.ceiling:.3f})"
    return TESTED[test.beyond], test.p_value, reading


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
    curve = fit.curve
    (variance_of_mu, covariance), (_, variance_of_sigma) = curve.covariance.tolist()
    numbers = {
        "b0": fit.b0,
        "b1": fit.b1,
        "tau": fit.tau,
        "mu": curve.mu,
        "sigma": curve.sigma,
        "variance of mu": variance_of_mu,
        "covariance of mu, sigma": covariance,
        "variance of sigma": variance_of_sigma,
        "signals at or below --left": float(fit.below.sum()),
        "signals at or above --right": float(fit.above.sum()),
        "decision": fit.decision,
        **false_positives(read, fit),
    }
    return PodStatement(
        read=read,
        kind="signal against size",
        unit=unit,
        fits=(),
        average=None,
        signal=fit,
        tried=tried,
        bound=_bound_of(fit),
        numbers=numbers,
        notes=(*read.notes, *fit.notes),
        tests=tuple(_diagnostic_row(test) for test in diagnose(fit)),
    )


def _diagnostic_row(test: Diagnostic) -> tuple[str, float, str]:
    """Return a test of an assumption as subject, p-value and reading."""
    reading = "doubtful" if test.p_value < LEVEL else "not rejected"
    return f"{test.assumption} ({test.test})", test.p_value, f"{reading} at {LEVEL:.0%}"


def _bound_of(fit: HitMissFit | AhatFit) -> Bound:
    """Return a90/95 by one model alone."""
    if isinstance(fit, HitMissFit):
        return hit_miss.bound(fit, POD, CONFIDENCE)
    return ahat_bound(fit, POD, CONFIDENCE)


def _model_name(fit: HitMissFit | AhatFit) -> str:
    size = "ln size" if fit.curve.log_size else "size"
    if isinstance(fit, HitMissFit):
        return f"{fit.curve.link}, {size}"
    signal = "ln signal" if fit.log_signal else "signal"
    return f"{signal} against {size}"


def false_positives(read: Inspections, fit: AhatFit | None = None) -> dict[str, float]:
    """Return the probability of a false positive at unflawed sites, by name; empty if there are no
    sites. It is the share of calls with its upper bound (Clopper and Pearson); for signals, also
    by the normal distribution that fits the noise best on the fit's axis, with signals up to the
    left limit censored (MIL-HDBK-1823A, 4.5.4 and G.3.4)."""
    sites = read.unflawed
    if not sites.size:
        return {}
    decision = 0.5 if fit is None else fit.decision
    calls = int((sites > decision).sum())
    upper = 1.0
    if calls < len(sites):
        upper = float(special.betaincinv(calls + 1, len(sites) - calls, CONFIDENCE))
    numbers = {
        "unflawed sites": float(len(sites)),
        "false positives": float(calls),
        "PFP": calls / len(sites),
        f"PFP's {100 * CONFIDENCE:g} % upper bound": upper,
    }
    by_noise = None if fit is None else _false_positives_by_noise(sites, fit)
    if by_noise is not None:
        numbers["PFP by the noise's normal law"] = by_noise
    return numbers


def _false_positives_by_noise(sites: np.ndarray, fit: AhatFit) -> float | None:
    """Return the probability that a normal law of the ``sites``' noise exceeds the decision; None
    if there are too few to fit it, or some have no logarithm."""
    from scipy import stats

    if fit.log_signal and not (sites > 0).all():
        return None
    limit = -np.inf if fit.left is None else fit.left
    below = sites <= limit
    if len(np.unique(sites[~below])) < FEWEST_SITES:
        return None
    on_axis: np.ufunc = np.log if fit.log_signal else np.positive
    at_limit = np.full(int(below.sum()), limit)
    noise = stats.CensoredData(on_axis(sites[~below]), left=on_axis(at_limit))
    mean, std = stats.norm.fit(noise)
    return float(stats.norm(mean, std).sf(on_axis(fit.decision)))


def drawn_sizes(
    size: np.ndarray,
    log_size: bool,
    marks: tuple[float, ...],
) -> np.ndarray:
    """Return sizes (`DRAWN`,) from just below the smallest to just above the largest, and beyond
    those ``marks`` that are at most twice the largest size; in equal steps, or in equal ratios if
    ``log_size``."""
    low = float(size.min())
    high = float(size.max())
    shown = [mark for mark in marks if np.isfinite(mark) and high < mark < 2 * high]
    high = max([high, *shown])
    if log_size:
        margin = (high / low) ** 0.04
        return np.geomspace(low / margin, high * margin, DRAWN)
    margin = 0.04 * (high - low)
    start = low - margin
    if low >= 0:
        start = max(start, 0.0)
    return np.linspace(start, high + margin, DRAWN)
