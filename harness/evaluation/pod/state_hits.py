"""The statement on hits and misses: model by deviance, curve and bounds by `harness.evaluation.pod.hit_miss`."""

from __future__ import annotations

import numpy as np

from harness.evaluation.pod.curve import Bound
from harness.evaluation.pod.hit_miss import (
    Between,
    FloorCeilingTest,
    HitMissFit,
    choose_model,
    fit_hit_miss,
    floor_ceiling_test,
)
from harness.evaluation.pod.inspection_file import Inspections
from harness.evaluation.pod.likelihood_bounds import band, bound
from harness.evaluation.pod.statement import (
    CONFIDENCE,
    POD,
    ModelRow,
    PodStatement,
    drawn_sizes,
)

TESTED: dict[Between, str] = {
    "floor": "a floor: hits by chance at any size",
    "ceiling": "a ceiling: misses at any size",
    "both": "floor and ceiling",
}
LEAST_TARGETS = 60
"""MIL-HDBK-1823A: independent targets that a hit/miss study should have at least."""
METHODS = ("likelihood ratio", "profile", "wald")


def state_hits(
    read: Inspections,
    *,
    link: str | None = None,
    log_size: bool | None = None,
    bounded: Between = "none",
    method: str = "likelihood ratio",
    unit: str = "",
) -> PodStatement:
    """Of all links and sizes or their logarithms (of those that ``link``, ``log_size`` leave) the fit with the least
    deviance, with a floor or ceiling where ``bounded``; bounds by all `METHODS` that it has, ``method``'s first. Where
    targets were inspected more than once, both the limit for that many targets and the one as if every inspection had
    a target of its own."""
    from threadpoolctl import threadpool_limits

    # L-BFGS-B hands systems of four unknowns to LAPACK, whose threads wait for each other: 9 s, not 0.6 s, on two
    # busy cores.
    with threadpool_limits(1, user_api="blas"):
        return _stated(read, link, log_size, bounded, method, unit)


def _stated(
    read: Inspections, link: str | None, log_size: bool | None, bounded: Between, method: str, unit: str
) -> PodStatement:
    tried = choose_model(read.size, read.response, inspections=read.target, bounded=bounded)
    fit = next(one for one in tried if link in (None, one.curve.link) and log_size in (None, one.curve.log_size))
    limit = bound(fit, POD, CONFIDENCE, method)
    sizes = drawn_sizes(read.size, fit.curve.log_size, (fit.curve.size_at(POD), limit.value))
    lower, upper = band(fit, sizes, CONFIDENCE, method)
    needed = () if bounded != "none" or fit.separated else _needed(read, fit)
    return PodStatement(
        path=read.path,
        kind="hit/miss",
        unit=unit,
        size_column=read.size_column,
        response_column=read.response_column,
        size=read.size,
        response=read.response,
        targets=read.targets,
        curve=fit.curve,
        model=_name(fit),
        criterion="deviance",
        models=tuple(_row(one, method, chosen=one is fit) for one in tried),
        bound=limit,
        others=tuple(
            bound(fit, POD, CONFIDENCE, other)
            for other in METHODS
            if other != method and (bounded == "none" or other != "wald")
        ),
        independent=_taken_for_targets(read, fit, method) if fit.targets < fit.n else None,
        sizes=sizes,
        lower=lower,
        upper=upper,
        numbers=_numbers(fit),
        notes=(*fit.notes, *_notes(fit, limit, needed)),
        tests=tuple((TESTED[one.bounded], one.p_value, _reads(one)) for one in needed),
    )


def _taken_for_targets(read: Inspections, fit: HitMissFit, method: str) -> Bound:
    """The wrong limit, as if every inspection had a target of its own: a fit of its own, because where hits and misses
    separate the penalty counts targets."""
    curve = fit.curve
    rows = fit_hit_miss(read.size, read.response, link=curve.link, log_size=curve.log_size, bounded=fit.bounded)
    return bound(rows, POD, CONFIDENCE, method)


def _name(fit: HitMissFit) -> str:
    asymptotes = {"none": "", "both": ", floor and ceiling"}.get(fit.bounded, f", {fit.bounded}")
    return f"{fit.curve.link}, {'ln size' if fit.curve.log_size else 'size'}{asymptotes}"


def _row(fit: HitMissFit, method: str, chosen: bool) -> ModelRow:
    curve = fit.curve
    limit = bound(fit, POD, CONFIDENCE, method)
    return ModelRow(_name(fit), fit.deviance, curve.size_at(0.5), curve.size_at(POD), limit, chosen)


def _numbers(fit: HitMissFit) -> dict[str, float]:
    return {
        "b0": fit.b0,
        "b0's standard error": float(fit.covariance[0, 0]) ** 0.5,
        "b1": fit.b1,
        "b1's standard error": float(fit.covariance[1, 1]) ** 0.5,
        "mu": fit.curve.mu,
        "sigma": fit.curve.sigma,
        "floor": fit.curve.floor,
        "ceiling": fit.curve.ceiling,
        "deviance": fit.deviance,
        "deviance of a constant": fit.null_deviance,
        "log likelihood": fit.log_likelihood,
        "inspections": float(fit.n),
        "targets": float(fit.targets),
        "hits": float(fit.hits),
    }


def _needed(read: Inspections, fit: HitMissFit) -> tuple[FloorCeilingTest, ...]:
    """Whether chance hits (a floor), misses at any size (a ceiling), or both need parameters of their own."""
    link, log_size = fit.curve.link, fit.curve.log_size
    return tuple(
        floor_ceiling_test(read.size, read.response, bounded=one, link=link, log_size=log_size, inspections=read.target)
        for one in TESTED
    )


def _reads(test: FloorCeilingTest) -> str:
    curve = test.fit.curve
    return f"{'needed' if test.needed else 'not needed'} (floor {curve.floor:.3f}, ceiling {curve.ceiling:.3f})"


def _notes(fit: HitMissFit, limit: Bound, tests: tuple[FloorCeilingTest, ...]) -> tuple[str, ...]:
    """What the reader must know before quoting the limit."""
    notes = []
    if fit.targets < LEAST_TARGETS:
        notes.append(f"{fit.targets} independent targets; MIL-HDBK-1823A asks for at least {LEAST_TARGETS}")
    largest = float(np.exp(fit.x.max())) if fit.curve.log_size else float(fit.x.max())
    if limit.demonstrated and limit.value > largest:
        notes.append(f"a90/95 = {limit.value:.4g} lies beyond the largest size inspected, {largest:.4g}")
    if any(test.needed for test in tests):
        likeliest = min(tests, key=lambda test: test.p_value)
        notes.append(
            f"the curve has neither floor nor ceiling, and the data speak for {TESTED[likeliest.bounded]} "
            f"(p = {likeliest.p_value:.2g}): see --bounded {likeliest.bounded}"
        )
    return tuple(notes)
