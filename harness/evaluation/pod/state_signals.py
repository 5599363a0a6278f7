"""The statement on signals: regression, curve and bounds by `harness.evaluation.pod.ahat`."""

from __future__ import annotations

from harness.evaluation.pod.ahat import AhatFit, ahat_band, ahat_bound, choose_axes
from harness.evaluation.pod.diagnostics import diagnose
from harness.evaluation.pod.inspection_file import Inspections
from harness.evaluation.pod.statement import (
    CONFIDENCE,
    POD,
    ModelRow,
    PodStatement,
    SignalModel,
    drawn_sizes,
)
from harness.vocabulary.errors import UserError


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
    """Of all pairs of axes the data allow (of those with ``log_size``, ``log_signal`` where not None) the one with the
    least deviance; bounds by the delta method on x. UserErrors as of `harness.evaluation.pod.ahat.fit_ahat`."""
    tried = choose_axes(read.size, read.response, decision=decision, left=left, right=right, inspections=read.target)
    fits = [fit for fit in tried if log_size in (None, fit.log_size) and log_signal in (None, fit.log_signal)]
    if not fits:
        raise UserError(
            f"{read.path}: the axes asked for need logarithms of values <= 0", fix="leave out --log or --log-signal"
        )
    fit = fits[0]
    bound = ahat_bound(fit, POD, CONFIDENCE)
    repeated = fit.targets < fit.n
    sizes = drawn_sizes(read.size, fit.log_size, (fit.curve.size_at(POD), bound.value))
    lower, upper = ahat_band(fit, sizes, CONFIDENCE)
    return PodStatement(
        path=read.path,
        kind="signal against size",
        unit=unit,
        size_column=read.size_column,
        response_column=read.response_column,
        size=read.size,
        response=read.response,
        targets=read.targets,
        curve=fit.curve,
        model=_name(fit),
        criterion="deviance",
        models=tuple(_row(one, chosen=one is fit) for one in tried),
        bound=bound,
        others=(),
        independent=ahat_bound(fit, POD, CONFIDENCE, rows_are_targets=True) if repeated else None,
        sizes=sizes,
        lower=lower,
        upper=upper,
        numbers=_numbers(fit),
        notes=fit.notes,
        signal=SignalModel(fit.b0, fit.b1, fit.tau, fit.log_signal, left, right, decision),
        tests=tuple((one.name, one.p_value, one.text) for one in diagnose(fit)),
    )


def _name(fit: AhatFit) -> str:
    return f"{'ln signal' if fit.log_signal else 'signal'} against {'ln size' if fit.log_size else 'size'}"


def _row(fit: AhatFit, chosen: bool) -> ModelRow:
    curve = fit.curve
    bound = ahat_bound(fit, POD, CONFIDENCE)
    return ModelRow(_name(fit), fit.deviance, curve.size_at(0.5), curve.size_at(POD), bound, chosen)


def _numbers(fit: AhatFit) -> dict[str, float]:
    return {
        "b0": fit.b0,
        "b1": fit.b1,
        "tau": fit.tau,
        "mu": fit.curve.mu,
        "sigma": fit.curve.sigma,
        "variance of mu": float(fit.curve.covariance[0, 0]),
        "covariance of mu, sigma": float(fit.curve.covariance[0, 1]),
        "variance of sigma": float(fit.curve.covariance[1, 1]),
        "signals at or below --left": float(fit.below.sum()),
        "signals at or above --right": float(fit.above.sum()),
        "decision": fit.decision,
    }
