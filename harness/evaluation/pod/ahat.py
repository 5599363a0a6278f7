"""Signal against size (a-hat against a), MIL-HDBK-1823A (2009) appendix G and ASTM E3023: regression, then POD.

y = b0 + b1 x + tau * normal, x = size or ln size, y = signal or ln signal, censored at the noise floor and at
saturation. A target is found where y > decision: POD = Phi((x - mu) / sigma), mu = (decision - b0) / b1 and
sigma = tau / b1, with the covariance of both by the delta method.

Repeated measures: k signals of one target are not k targets. The fit treats rows as independent, which leaves
(mu, sigma) consistent for the whole scatter (between targets and within), and multiplies the covariance by k, the mean
number of signals per target: right where a target's signals are all alike, too cautious where they are not. No mixed
model is fitted; its split of the scatter would not change the POD of a new target seen once. Both covariances stand in
the fit. Not modelled: scatter that grows with size, curvature (`harness.evaluation.pod.diagnostics` tests both).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from harness.evaluation.pod.censored import CensoredFit, fit_censored
from harness.evaluation.pod.curve import Bound, PodCurve
from harness.vocabulary.errors import UserError

LEAST_TARGETS = 40
"""MIL-HDBK-1823A: independent targets that an a-hat study should have at least."""
SAME = 1e-9
"""Share of the largest signal within which signals differ by rounding alone."""


@dataclass(frozen=True, eq=False)
class AhatFit:
    """A regression of signals and the POD curve that it implies.

    ``x``, ``y`` (n,): size and signal on the axes of the fit (logarithms where ``log_size``, ``log_signal``), with
    censored signals at their limit; ``below``, ``above`` (n,) bool: which are; ``left``, ``right``, ``decision`` in the
    signal's own unit. ``covariance`` (3, 3) of (b0, b1, tau) holds for independent targets, ``covariance_of_rows`` were
    each row one; ``curve.covariance`` derives from the first, ``rows_curve.covariance`` from the second.
    ``log_likelihood`` is that of the signals in their own unit on either axis, so fits of one data set compare.
    """

    curve: PodCurve
    rows_curve: PodCurve
    b0: float
    b1: float
    tau: float
    covariance: np.ndarray
    covariance_of_rows: np.ndarray
    log_likelihood: float
    x: np.ndarray
    y: np.ndarray
    below: np.ndarray
    above: np.ndarray
    target: np.ndarray
    log_size: bool
    log_signal: bool
    decision: float
    left: float | None
    right: float | None
    notes: tuple[str, ...]

    @property
    def n(self) -> int:
        """Rows."""
        return len(self.x)

    @property
    def targets(self) -> int:
        """Independent targets."""
        return len(np.unique(self.target))

    @property
    def per_target(self) -> float:
        """Mean number of signals per target."""
        return self.n / self.targets

    @property
    def deviance(self) -> float:
        """-2 ln likelihood, comparable between axes: the Jacobian of a logarithm is in it."""
        return -2 * self.log_likelihood


def fit_ahat(
    size: ArrayLike,
    signal: ArrayLike,
    *,
    decision: float,
    left: float | None = None,
    right: float | None = None,
    log_size: bool = False,
    log_signal: bool = False,
    inspections: ArrayLike | None = None,
) -> AhatFit:
    """Censored regression of ``signal`` (n,) on ``size`` (n,), and POD of signals above ``decision``.

    Signals <= ``left`` are at the noise floor, signals >= ``right`` saturated. ``inspections`` (n,): which target a row
    inspects, where a target was measured more than once. UserError: not finite, sizes or signals <= 0 under a
    logarithm, a decision outside the limits, too few signals between them, signals that are all alike or do not grow
    with size.
    """
    sizes, signals = _finite("sizes", size), _finite("signals", signal)
    target = _targets(sizes, signals, inspections)
    _check_limits(decision, left, right)
    below = np.zeros(len(signals), bool) if left is None else signals <= left
    above = np.zeros(len(signals), bool) if right is None else signals >= right
    _check_variation(signals[~(below | above)])
    at_limit = np.clip(signals, -np.inf if left is None else left, np.inf if right is None else right)
    x = _axis("sizes", sizes, log_size)
    y = _axis("signals", at_limit, log_signal)
    threshold = float(_axis("decision", np.array([decision]), log_signal)[0])
    line = fit_censored(np.column_stack([np.ones_like(x), x]), y, below, above)
    per_target = len(x) / len(np.unique(target))
    curve = _curve(line, line.covariance * per_target, threshold, log_size)
    jacobian = float(y[~(below | above)].sum()) if log_signal else 0.0
    return AhatFit(
        curve=curve,
        rows_curve=_curve(line, line.covariance, threshold, log_size),
        b0=float(line.coefficients[0]),
        b1=float(line.coefficients[1]),
        tau=line.tau,
        covariance=line.covariance * per_target,
        covariance_of_rows=line.covariance,
        log_likelihood=line.log_likelihood - jacobian,
        x=x,
        y=y,
        below=below,
        above=above,
        target=target,
        log_size=log_size,
        log_signal=log_signal,
        decision=decision,
        left=left,
        right=right,
        notes=_notes(curve, sizes, len(np.unique(target)), per_target),
    )


def choose_axes(
    size: ArrayLike,
    signal: ArrayLike,
    *,
    decision: float,
    left: float | None = None,
    right: float | None = None,
    inspections: ArrayLike | None = None,
) -> tuple[AhatFit, ...]:
    """Fits on all pairs of axes that the data allow, best (smallest deviance) first; never chosen by the limit.

    A logarithm is left out where there are sizes, or signals, floor or decision, that have none. All have three
    parameters, so the deviances compare as they stand.
    """
    sizes, signals = _finite("sizes", size), _finite("signals", signal)
    lowest = signals.min(initial=np.inf) if left is None else left
    log_sizes = (False, True) if np.all(sizes > 0) else (False,)
    log_signals = (False, True) if min(lowest, decision) > 0 else (False,)
    fits = [
        fit_ahat(
            sizes,
            signals,
            decision=decision,
            left=left,
            right=right,
            log_size=log_size,
            log_signal=log_signal,
            inspections=inspections,
        )
        for log_size, log_signal in product(log_sizes, log_signals)
    ]
    return tuple(sorted(fits, key=lambda fit: fit.deviance))


def ahat_bound(fit: AhatFit, pod: float = 0.9, confidence: float = 0.95, *, rows_are_targets: bool = False) -> Bound:
    """One-sided upper bound of the size found with probability ``pod``, the handbook's way: delta method on x.

    x = mu + z sigma + z_confidence sqrt(V11 + 2 z V12 + z^2 V22), z = Phi^-1(pod). ``rows_are_targets``: the wrong
    bound that takes each row for a target of its own. Infinite where the width sigma itself is not told from 0 at this
    confidence: the curve's band is then open, and no size is demonstrated.
    """
    curve = fit.rows_curve if rows_are_targets else fit.curve
    z, quantile = float(stats.norm.ppf(pod)), float(stats.norm.ppf(confidence))
    if curve.sigma**2 <= quantile**2 * curve.covariance[1, 1]:
        why = "the signal's growth with size is too uncertain at this confidence (band open at large sizes)"
        return Bound(pod, confidence, "delta", float("inf"), why)
    gradient = np.array([1.0, z])
    x = curve.mu + z * curve.sigma + quantile * float(np.sqrt(gradient @ curve.covariance @ gradient))
    return Bound(pod, confidence, "delta", float(np.exp(x)) if curve.log_size else x)


def ahat_band(fit: AhatFit, sizes: ArrayLike, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """(lower, upper) POD at ``sizes`` (any shape), each one-sided: the curves through the bounds of all sizes a_p.

    So the lower one passes 0.9 at `ahat_bound`. (x - mu - z sigma)^2 = z_confidence^2 (V11 + 2 z V12 + z^2 V22) solved
    for z; 0 and 1 where the band is open.
    """
    at = np.asarray(sizes, float)
    curve, c = fit.curve, float(stats.norm.ppf(confidence)) ** 2
    (v11, v12), (_, v22) = curve.covariance
    leading = curve.sigma**2 - c * v22
    if leading <= 0:
        return np.zeros_like(at), np.ones_like(at)
    d = (np.log(np.maximum(at, np.finfo(float).tiny)) if curve.log_size else at) - curve.mu
    half = curve.sigma * d + c * v12
    root = np.sqrt(np.maximum(half**2 - leading * (d**2 - c * v11), 0))
    return np.asarray(stats.norm.cdf((half - root) / leading)), np.asarray(stats.norm.cdf((half + root) / leading))


def _curve(line: CensoredFit, covariance: np.ndarray, threshold: float, log_size: bool) -> PodCurve:
    b0, b1 = line.coefficients
    if b1 <= 0:
        raise UserError(
            f"the signal does not grow with size (slope {b1:.4g}): there is no detection limit",
            fix="check the columns of size and signal, or take the signal with the other sign",
        )
    mu, sigma = (threshold - b0) / b1, line.tau / b1
    jacobian = np.array([[-1.0, -mu, 0.0], [0.0, -sigma, 1.0]]) / b1
    return PodCurve("probit", log_size, float(mu), float(sigma), jacobian @ covariance @ jacobian.T)


def _finite(name: str, values: ArrayLike) -> np.ndarray:
    array = np.asarray(values, float).ravel()
    if bad := int((~np.isfinite(array)).sum()):
        raise UserError(f"{bad} of {len(array)} {name} are not finite numbers", fix="leave these rows out")
    return array


def _targets(sizes: np.ndarray, signals: np.ndarray, inspections: ArrayLike | None) -> np.ndarray:
    """Number (n,) of the target that each row inspects; one target has one size."""
    names = np.arange(len(sizes)) if inspections is None else np.asarray(inspections).astype(str)
    if not len(sizes) == len(signals) == len(names):
        raise UserError(f"{len(sizes)} sizes, {len(signals)} signals and {len(names)} targets: one of each a row")
    _, first, target = np.unique(names, return_index=True, return_inverse=True)
    if np.any(other := sizes != sizes[first][target]):
        raise UserError(f"target {names[other][0]} has more than one size", legal="one size for a target")
    return np.asarray(target)


def _axis(name: str, values: np.ndarray, log: bool) -> np.ndarray:
    if not log:
        return values
    if np.any(values <= 0):
        raise UserError(f"{name} <= 0 have no logarithm (smallest {values.min():.6g})", legal="values above 0")
    return np.log(values)


def _check_variation(signals: np.ndarray) -> None:
    """Signals between the limits that differ by rounding alone have no slope and no scatter."""
    if len(signals) > 1 and np.ptp(signals) <= SAME * np.abs(signals).max():
        raise UserError(
            f"the signals do not vary: all {len(signals)} between the limits are {signals[0]:.6g}",
            fix="take hits and misses instead: signals that are all alike say nothing of size",
        )


def _check_limits(decision: float, left: float | None, right: float | None) -> None:
    low, high = -np.inf if left is None else left, np.inf if right is None else right
    if not low < high:
        raise UserError(f"noise floor {low:g} is not below saturation {high:g}")
    if not low <= decision <= high:
        raise UserError(
            f"decision {decision:g} lies outside the signals that can be told apart",
            legal=f"between the noise floor {low:g} and saturation {high:g}",
        )


def _notes(curve: PodCurve, sizes: np.ndarray, targets: int, per_target: float) -> tuple[str, ...]:
    notes = []
    if targets < LEAST_TARGETS:
        notes.append(f"{targets} independent targets; MIL-HDBK-1823A asks for at least {LEAST_TARGETS}")
    if per_target > 1:
        notes.append(f"{per_target:.3g} signals per target: covariance multiplied by that, {targets} targets count")
    if not sizes.min() <= (a90 := curve.size_at(0.9)) <= sizes.max():
        notes.append(f"a90 = {a90:.4g} lies outside the sizes inspected ({sizes.min():.4g} to {sizes.max():.4g})")
    return tuple(notes)
