"""The statement on one set of inspections, from hits and misses or from signals: curve, bounds, and their basis."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.evaluation.pod.ahat import AhatFit, ahat_band, ahat_bound, choose_axes, diagnose
from harness.evaluation.pod.curve import Bound, PodCurve
from harness.evaluation.pod.hit_miss import Between, HitMissFit, choose_model, fit_hit_miss, floor_ceiling_test
from harness.evaluation.pod.inspection_file import Inspections
from harness.evaluation.pod.likelihood_bounds import METHODS, band, bound
from harness.vocabulary.errors import UserError

POD, CONFIDENCE = 0.9, 0.95
"""The field's customary statement, a90/95."""
DRAWN = 241
"""Sizes at which curve and band are drawn."""
LEAST_TARGETS = 60
"""MIL-HDBK-1823A: independent targets that a hit/miss study should have at least."""
TESTED: dict[Between, str] = {
    "floor": "a floor: hits by chance at any size",
    "ceiling": "a ceiling: misses at any size",
    "both": "floor and ceiling",
}


@dataclass(frozen=True)
class ModelRow:
    """One model that was tried: its name, how far from the data (``criterion``, smaller is better), its sizes."""

    name: str
    criterion: float
    a50: float
    a90: float
    bound: Bound
    chosen: bool


@dataclass(frozen=True)
class SignalModel:
    """The straight line behind a curve from signals: y = b0 + b1 x with deviation ``tau``; y, x logarithms if so said.
    ``left``, ``right``, ``decision`` are signals as read, None where nothing is censored."""

    b0: float
    b1: float
    tau: float
    log_signal: bool
    left: float | None
    right: float | None
    decision: float


@dataclass(frozen=True)
class PodStatement:
    """Sizes are in ``unit`` of the file. ``size``, ``response`` (n,) as read; ``sizes``, ``lower``, ``upper`` (m,) the
    band of POD to be drawn; ``independent``: the bound had every row been a target of its own, None where it was.
    ``numbers``: whatever else the fit says, by name; ``tests``: (what, p-value, how it reads)."""

    path: Path
    kind: str
    unit: str
    size_column: str
    response_column: str
    size: np.ndarray
    response: np.ndarray
    targets: int
    curve: PodCurve
    model: str
    criterion: str
    models: tuple[ModelRow, ...]
    bound: Bound
    others: tuple[Bound, ...]
    independent: Bound | None
    sizes: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    numbers: dict[str, float]
    notes: tuple[str, ...]
    signal: SignalModel | None = None
    tests: tuple[tuple[str, float, str], ...] = ()

    @property
    def a50(self) -> float:
        """The size found half the time."""
        return self.curve.size_at(0.5)

    @property
    def a90(self) -> float:
        """The size found 90 % of the time: an estimate, no bound."""
        return self.curve.size_at(POD)

    @property
    def counts(self) -> str:
        """Numbers of rows, targets and hits of the statement."""
        rows = f"{len(self.size)} inspections of {self.targets} targets"
        return rows if self.signal else f"{rows}, {int(self.response.sum())} hits"

    def to_data(self) -> dict[str, Any]:
        """The statement as JSON's types; an infinite size becomes None, and ``why`` says so."""
        curve = self.curve
        return {
            "file": str(self.path),
            "kind": self.kind,
            "unit": self.unit,
            "size_column": self.size_column,
            "response_column": self.response_column,
            "inspections": len(self.size),
            "targets": self.targets,
            "hits": None if self.signal else int(self.response.sum()),
            "model": self.model,
            "curve": {
                "link": curve.link,
                "log_size": curve.log_size,
                "mu": curve.mu,
                "sigma": curve.sigma,
                "covariance_mu_sigma": np.asarray(curve.covariance).tolist(),
                "floor": curve.floor,
                "ceiling": curve.ceiling,
            },
            "a50": finite(self.a50),
            "a90": finite(self.a90),
            "a90_95": _bound_data(self.bound),
            "other_bounds": [_bound_data(one) for one in self.others],
            "if_every_inspection_were_a_target": None if self.independent is None else _bound_data(self.independent),
            "models": [
                {
                    "model": row.name,
                    self.criterion: finite(row.criterion),
                    "a50": finite(row.a50),
                    "a90": finite(row.a90),
                    "a90_95": _bound_data(row.bound),
                    "chosen": row.chosen,
                }
                for row in self.models
            ],
            "numbers": {name: finite(value) for name, value in self.numbers.items()},
            "tests": [{"test": what, "p": finite(p), "reads": reads} for what, p, reads in self.tests],
            "notes": list(self.notes),
        }


def state_hits(
    read: Inspections,
    *,
    link: str | None = None,
    log_size: bool | None = None,
    bounded: Between = "none",
    method: str = "likelihood ratio",
    unit: str = "",
) -> PodStatement:
    """State the curve of hits and misses.

    Of all links and sizes or their logarithms (of those that ``link``, ``log_size`` leave) the fit with the least
    deviance, with a floor or ceiling where ``bounded``; bounds by all `METHODS` that it has, ``method``'s first. Where
    targets were inspected more than once, both the limit for that many targets and the limit as if every inspection had
    a target of its own.
    """
    from threadpoolctl import threadpool_limits

    # L-BFGS-B hands systems of four unknowns to LAPACK, whose threads wait for each other: 9 s, not 0.6 s, on two
    # busy cores.
    with threadpool_limits(1, user_api="blas"):
        size, hit = read.size, read.response
        tried = choose_model(size, hit, inspections=read.target, bounded=bounded)
        fit = next(one for one in tried if link in (None, one.curve.link) and log_size in (None, one.curve.log_size))
        curve = fit.curve
        limit = bound(fit, POD, CONFIDENCE, method)
        sizes = drawn_sizes(size, curve.log_size, (curve.size_at(POD), limit.value))
        lower, upper = band(fit, sizes, CONFIDENCE, method)
        independent = None
        if fit.targets < fit.n:
            # A fit of its own, because where hits and misses separate the penalty counts targets.
            rows = fit_hit_miss(size, hit, link=curve.link, log_size=curve.log_size, bounded=fit.bounded)
            independent = bound(rows, POD, CONFIDENCE, method)
        tests = [
            floor_ceiling_test(
                size, hit, bounded=one, link=curve.link, log_size=curve.log_size, inspections=read.target
            )
            for one in TESTED
            if bounded == "none" and not fit.separated
        ]
        models = tuple(_row(one, bound(one, POD, CONFIDENCE, method), one is fit) for one in tried)
        others = tuple(
            bound(fit, POD, CONFIDENCE, one)
            for one in METHODS
            if one != method and (bounded == "none" or one != "wald")
        )

    notes = []
    if fit.targets < LEAST_TARGETS:
        notes.append(f"{fit.targets} independent targets; MIL-HDBK-1823A asks for at least {LEAST_TARGETS}")
    if limit.demonstrated and limit.value > (largest := float(size.max())):
        notes.append(f"a90/95 = {limit.value:.4g} lies beyond the largest size inspected, {largest:.4g}")
    if any(test.needed for test in tests):
        likeliest = min(tests, key=lambda test: test.p_value)
        notes.append(
            f"the curve has neither floor nor ceiling, and the data speak for {TESTED[likeliest.bounded]} "
            f"(p = {likeliest.p_value:.2g}): see --bounded {likeliest.bounded}"
        )
    return PodStatement(
        path=read.path,
        kind="hit/miss",
        unit=unit,
        size_column=read.size_column,
        response_column=read.response_column,
        size=size,
        response=hit,
        targets=read.targets,
        curve=curve,
        model=_name(fit),
        criterion="deviance",
        models=models,
        bound=limit,
        others=others,
        independent=independent,
        sizes=sizes,
        lower=lower,
        upper=upper,
        numbers={
            "b0": fit.b0,
            "b0's standard error": float(fit.covariance[0, 0]) ** 0.5,
            "b1": fit.b1,
            "b1's standard error": float(fit.covariance[1, 1]) ** 0.5,
            "mu": curve.mu,
            "sigma": curve.sigma,
            "floor": curve.floor,
            "ceiling": curve.ceiling,
            "deviance": fit.deviance,
            "deviance of a constant": fit.null_deviance,
            "log likelihood": fit.log_likelihood,
            "inspections": float(fit.n),
            "targets": float(fit.targets),
            "hits": float(fit.hits),
        },
        notes=(*fit.notes, *notes),
        tests=tuple(
            (
                TESTED[one.bounded],
                one.p_value,
                f"{'needed' if one.needed else 'not needed'} "
                f"(floor {one.fit.curve.floor:.3f}, ceiling {one.fit.curve.ceiling:.3f})",
            )
            for one in tests
        ),
    )


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
    """State the curve of signals against sizes.

    Of all pairs of axes the data allow (of those with ``log_size``, ``log_signal`` where not None) the one with the
    least deviance; bounds by the delta method on x. UserErrors as of `harness.evaluation.pod.ahat.fit_ahat`.
    """
    tried = choose_axes(read.size, read.response, decision=decision, left=left, right=right, inspections=read.target)
    fits = [fit for fit in tried if log_size in (None, fit.log_size) and log_signal in (None, fit.log_signal)]
    if not fits:
        raise UserError(
            f"{read.path}: the axes asked for need logarithms of values <= 0", fix="leave out --log or --log-signal"
        )
    fit, curve = fits[0], fits[0].curve
    limit = ahat_bound(fit, POD, CONFIDENCE)
    sizes = drawn_sizes(read.size, fit.log_size, (curve.size_at(POD), limit.value))
    lower, upper = ahat_band(fit, sizes, CONFIDENCE)
    rows = ahat_bound(fit, POD, CONFIDENCE, rows_are_targets=True) if fit.targets < fit.n else None
    return PodStatement(
        path=read.path,
        kind="signal against size",
        unit=unit,
        size_column=read.size_column,
        response_column=read.response_column,
        size=read.size,
        response=read.response,
        targets=read.targets,
        curve=curve,
        model=_name(fit),
        criterion="deviance",
        models=tuple(_row(one, ahat_bound(one, POD, CONFIDENCE), one is fit) for one in tried),
        bound=limit,
        others=(),
        independent=rows,
        sizes=sizes,
        lower=lower,
        upper=upper,
        numbers={
            "b0": fit.b0,
            "b1": fit.b1,
            "tau": fit.tau,
            "mu": curve.mu,
            "sigma": curve.sigma,
            "variance of mu": float(curve.covariance[0, 0]),
            "covariance of mu, sigma": float(curve.covariance[0, 1]),
            "variance of sigma": float(curve.covariance[1, 1]),
            "signals at or below --left": float(fit.below.sum()),
            "signals at or above --right": float(fit.above.sum()),
            "decision": fit.decision,
        },
        notes=fit.notes,
        signal=SignalModel(fit.b0, fit.b1, fit.tau, fit.log_signal, left, right, decision),
        tests=tuple((one.name, one.p_value, one.text) for one in diagnose(fit)),
    )


def _name(fit: HitMissFit | AhatFit) -> str:
    size = "ln size" if fit.curve.log_size else "size"
    if isinstance(fit, AhatFit):
        return f"{'ln signal' if fit.log_signal else 'signal'} against {size}"
    asymptotes = {"none": "", "both": ", floor and ceiling"}.get(fit.bounded, f", {fit.bounded}")
    return f"{fit.curve.link}, {size}{asymptotes}"


def _row(fit: HitMissFit | AhatFit, limit: Bound, chosen: bool) -> ModelRow:
    return ModelRow(_name(fit), fit.deviance, fit.curve.size_at(0.5), fit.curve.size_at(POD), limit, chosen)


def finite(value: float) -> float | None:
    """The number, or None where JSON has none for it."""
    return float(value) if np.isfinite(value) else None


def drawn_sizes(size: np.ndarray, log_size: bool, marks: tuple[float, ...]) -> np.ndarray:
    """Sizes (`DRAWN`,) from just below the smallest to just above the largest, and past those of ``marks`` that are no
    more than twice the largest size away; in equal steps, or in equal ratios where ``log_size``."""
    low, high = float(size.min()), float(size.max())
    high = max([high, *(one for one in marks if np.isfinite(one) and high < one < 2 * high)])
    if log_size:
        margin = (high / low) ** 0.04
        return np.geomspace(low / margin, high * margin, DRAWN)
    margin = 0.04 * (high - low)
    start = max(low - margin, 0.0) if low >= 0 else low - margin
    return np.linspace(start, high + margin, DRAWN)


def _bound_data(bound: Bound) -> dict[str, Any]:
    return {
        "pod": bound.pod,
        "confidence": bound.confidence,
        "method": bound.method,
        "size": finite(bound.value),
        "demonstrated": bound.demonstrated,
        "why": bound.why,
    }
