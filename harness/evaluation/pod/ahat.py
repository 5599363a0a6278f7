"""Signal against size (a-hat against a), MIL-HDBK-1823A (2009) appendix G and ASTM E3023:
regression, then POD. The model is y = b0 + b1 x + tau * normal, x = size or ln size, y = signal or
ln signal, censored at the noise floor and at saturation. A target is found if y > decision, so POD
= Phi((x - mu) / sigma), mu = (decision - b0) / b1 and sigma = tau / b1; the delta method gives
their covariance. k signals of one target are not k targets: the fit treats rows as independent and
multiplies the covariance by k, the mean number of signals per target. That is right if a target's
signals are equal, else cautious. Not modelled: scatter that grows with size, curvature (`diagnose`
tests both)."""

from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special, stats

from harness.evaluation.pod.curve import Bound, PodCurve, ascend
from harness.evaluation.pod.hit_miss import rows_of_target
from harness.vocabulary.errors import UserError

LEAST_TARGETS = 40  # least number of independent targets of an a-hat study, by MIL-HDBK-1823A
SAME = 1e-9
"""Relative difference to the largest signal that is only rounding. A scatter below this share of
the signals' largest deviation is a line drawn by rounding, which has no likelihood."""
LEVEL = 0.05  # a diagnostic with a smaller p-value rejects its assumption
LEAST = (
    # fewest signals between the limits for which Anderson and Darling's approximation of p holds
    8
)


@dataclass(frozen=True, eq=False)
class AhatFit:
    """A regression of signals and the POD curve that it implies. ``covariance`` (3, 3): of (b0,
    b1, tau) for independent targets; divided by ``per_target`` it is that for independent rows.
    ``log_likelihood``: of signals in their own unit. ``x``, ``y`` (n,): size and signal on the
    axes of the fit, censored signals at their limit. ``below``, ``above`` (n,) bool: censored
    signals. ``decision``, ``left``, ``right``: in the signal's own unit."""

    curve: PodCurve
    b0: float
    b1: float
    tau: float
    covariance: np.ndarray
    log_likelihood: float
    deviance: float
    x: np.ndarray
    y: np.ndarray
    below: np.ndarray
    above: np.ndarray
    n: int
    targets: int
    per_target: float
    log_size: bool
    log_signal: bool
    decision: float
    left: float | None
    right: float | None
    notes: tuple[str, ...]


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
    """Regress ``signal`` (n,) on ``size`` (n,) with censoring, and derive the POD of signals above
    ``decision``. Signals <= ``left`` are at the noise floor, signals >= ``right`` are saturated.
    ``inspections`` (n,): the target of each row. Raises UserError for data that allow no such
    regression, or a signal that does not grow with size."""
    sizes = _finite("sizes", size)
    signals = _finite("signals", signal)
    n = len(sizes)
    names = np.arange(n) if inspections is None else np.asarray(inspections).astype(str)
    if not n == len(signals) == len(names):
        raise UserError(
            f"{n} sizes, {len(signals)} signals and {len(names)} targets: each row needs one of each"
        )
    rows_each = rows_of_target(sizes, names)
    targets = round(float((1 / rows_each).sum()))
    low = -np.inf if left is None else left
    high = np.inf if right is None else right
    if not low < high:
        raise UserError(f"noise floor {low:g} is not below saturation {high:g}")
    if not low <= decision <= high:
        legal = f"between the noise floor {low:g} and saturation {high:g}"
        raise UserError(
            f"decision {decision:g} lies outside the signals that can be distinguished", legal=legal
        )
    below = signals <= low
    above = signals >= high
    between = signals[~(below | above)]
    if len(between) > 1 and np.ptp(between) <= SAME * np.abs(between).max():
        fix = "use hits and misses instead: signals that are all equal say nothing about size"
        raise UserError(
            f"the signals do not vary: all {len(between)} between the limits are {between[0]:.6g}",
            fix=fix,
        )
    x = _axis("sizes", sizes, log_size)
    y = _axis("signals", np.clip(signals, low, high), log_signal)
    threshold = float(_axis("decision", np.array([decision]), log_signal)[0])
    line = fit_censored(np.column_stack([np.ones_like(x), x]), y, below, above)
    b0, b1 = line.coefficients
    if b1 <= 0:
        fix = "check the columns of size and signal, or reverse the sign of the signal"
        raise UserError(
            f"the signal does not grow with size (slope {b1:.4g}): there is no detection limit",
            fix=fix,
        )
    per_target = float(
        rows_each.mean()
    )  # the design effect of rows that are equal within a target (Kish)
    mu = float((threshold - b0) / b1)
    sigma = float(line.tau / b1)
    covariance = line.covariance * per_target
    jacobian = np.array([[-1.0, -mu, 0.0], [0.0, -sigma, 1.0]]) / b1
    curve = PodCurve("probit", log_size, mu, sigma, jacobian @ covariance @ jacobian.T)
    notes = []
    if targets < LEAST_TARGETS:
        notes.append(
            f"{targets} independent targets; MIL-HDBK-1823A asks for at least {LEAST_TARGETS}"
        )
    if per_target > 1:
        notes.append(
            f"{per_target:.3g} signals per target multiply the covariance: {targets} targets count"
        )
    if not sizes.min() <= (a90 := curve.size_at(0.9)) <= sizes.max():
        notes.append(
            f"a90 = {a90:.3g} lies outside the sizes inspected ({sizes.min():.4g} to {sizes.max():.4g})"
        )
    log_likelihood = line.log_likelihood - (
        float(y[~(below | above)].sum()) if log_signal else 0.0
    )  # the Jacobian
    numbers = (float(b0), float(b1), line.tau, covariance, log_likelihood, -2 * log_likelihood)
    axes = (log_size, log_signal, decision, left, right, tuple(notes))
    return AhatFit(curve, *numbers, x, y, below, above, n, targets, per_target, *axes)


def choose_axes(
    size: ArrayLike,
    signal: ArrayLike,
    *,
    decision: float,
    left: float | None = None,
    right: float | None = None,
    inspections: ArrayLike | None = None,
) -> tuple[AhatFit, ...]:
    """Fit all pairs of axes that the data allow, least deviance first, whatever their limits. A
    logarithm is left out if some sizes, signals, floor or decision have none. All fits have three
    parameters."""
    sizes = _finite("sizes", size)
    signals = _finite("signals", signal)
    lowest = signals.min(initial=np.inf) if left is None else left
    log_sizes = (False, True) if np.all(sizes > 0) else (False,)
    log_signals = (False, True) if min(lowest, decision) > 0 else (False,)
    fit = partial(
        fit_ahat, sizes, signals, decision=decision, left=left, right=right, inspections=inspections
    )
    fits = [
        fit(log_size=of_size, log_signal=of_signal)
        for of_size, of_signal in product(log_sizes, log_signals)
    ]
    return tuple(sorted(fits, key=lambda each: each.deviance))


def ahat_bound(fit: AhatFit, pod: float = 0.9, confidence: float = 0.95) -> Bound:
    """Return the one-sided upper bound on the size found with probability ``pod``, by the delta
    method on x: mu + z sigma + z_confidence sqrt(V11 + 2 z V12 + z^2 V22), z = Phi^-1(pod). It is
    infinite if sigma may be 0."""
    curve = fit.curve
    v = fit.curve.covariance
    z = float(stats.norm.ppf(pod))
    quantile = float(stats.norm.ppf(confidence))
    if curve.sigma**2 <= quantile**2 * v[1, 1]:
        why = "the signal's growth with size is too uncertain at this confidence (the band is open at large sizes)"
        return Bound(pod, confidence, "delta", float("inf"), why)
    x = (
        curve.mu
        + z * curve.sigma
        + quantile * float(np.sqrt(v[0, 0] + 2 * z * v[0, 1] + z**2 * v[1, 1]))
    )
    return Bound(pod, confidence, "delta", float(np.exp(x)) if curve.log_size else x)


def ahat_band(
    fit: AhatFit, sizes: ArrayLike, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray]:
    """Return (lower, upper) POD at ``sizes`` (any shape), each one-sided, through the bounds of
    all sizes a_p: (x - mu
    - z sigma)^2 = z_confidence^2 (V11 + 2 z V12 + z^2 V22), solved for z; 0 and 1 where the band is open.
    """
    at = np.asarray(sizes, float)
    curve = fit.curve
    c = float(stats.norm.ppf(confidence)) ** 2
    (v11, v12), (_, v22) = curve.covariance
    leading = curve.sigma**2 - c * v22
    if leading <= 0:
        return np.zeros_like(at), np.ones_like(at)
    d = (np.log(np.maximum(at, np.finfo(float).tiny)) if curve.log_size else at) - curve.mu
    half = curve.sigma * d + c * v12
    root = np.sqrt(np.maximum(half**2 - leading * (d**2 - c * v11), 0))
    return np.asarray(stats.norm.cdf((half - root) / leading)), np.asarray(
        stats.norm.cdf((half + root) / leading)
    )


def _finite(name: str, values: ArrayLike) -> np.ndarray:
    array = np.asarray(values, float).ravel()
    if bad := int((~np.isfinite(array)).sum()):
        raise UserError(
            f"{bad} of {len(array)} {name} are not finite numbers", fix="leave these rows out"
        )
    return array


def _axis(name: str, values: np.ndarray, log: bool) -> np.ndarray:
    if log and np.any(values <= 0):
        raise UserError(
            f"{name} <= 0 have no logarithm (smallest {values.min():.6g})", legal="values above 0"
        )
    return np.log(values) if log else values


class CensoredFit(NamedTuple):
    """``coefficients`` (p,). ``tau``: scatter, by maximum likelihood without a correction for
    degrees of freedom. ``covariance`` (p + 1, p + 1): inverse observed information of
    (coefficients, tau). ``log_likelihood``."""

    coefficients: np.ndarray
    tau: float
    covariance: np.ndarray
    log_likelihood: float


def fit_censored(
    design: np.ndarray, y: np.ndarray, below: np.ndarray, above: np.ndarray
) -> CensoredFit:
    """Fit y = design @ coefficients + tau * normal by maximum likelihood (Tobin 1958). ``design``
    (n, p). ``y`` (n,): the value, or the limit if ``below`` or ``above`` (n,) says that the value
    lies beyond it. Solved in Olsen's 1978 parameters (coefficients / tau, 1 / tau), which make the
    log-likelihood concave. Raises UserError without a line or scatter."""
    exact = ~(below | above)
    p = design.shape[1]
    if exact.sum() <= p or np.linalg.matrix_rank(design[exact]) < p:
        what = f"{exact.sum()} of {len(y)} signals lie between the limits: too few, or at too few sizes, for a line"
        raise UserError(
            what, legal=f"more than {p} signals that are not censored, at different sizes"
        )
    start = np.linalg.lstsq(design[exact], y[exact], rcond=None)[0]
    rest = y - design @ start
    scale = float(np.sqrt(np.mean(rest[exact] ** 2)))
    if scale <= SAME * float(np.max(np.abs(y[exact] - y[exact].mean()), initial=0.0)) or scale == 0:
        raise UserError(
            "the signals lie exactly on a line: there is no scatter to estimate",
            fix="check the column",
        )
    # Orthonormal columns and residuals of unit scatter make Newton's system well conditioned in
    # any unit.
    q, r = np.linalg.qr(design)
    q = q * np.sqrt(len(y))
    r = r / np.sqrt(len(y))
    # Except for n ln(1 / tau), every row's term depends only on s = row @ parameters.
    rows = np.where(above, -1.0, 1.0)[:, None] * np.column_stack([-q, rest / scale])

    def value_and_information(at: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the log-likelihood, its gradient and its negative Hessian."""
        if at[-1] <= 0:
            return -np.inf, np.zeros(p + 1), np.eye(p + 1)
        s = rows @ at
        tail = special.log_ndtr(s)
        mills = np.exp(-0.5 * s**2 - 0.5 * np.log(2 * np.pi) - tail)
        gradient = rows.T @ np.where(exact, -s, mills)
        information = rows.T @ (np.where(exact, 1.0, mills * (mills + s))[:, None] * rows)
        gradient[-1] += exact.sum() / at[-1]
        information[-1, -1] += exact.sum() / at[-1] ** 2
        value = (np.log(at[-1]) - 0.5 * s[exact] ** 2 - 0.5 * np.log(2 * np.pi)).sum() + tail[
            ~exact
        ].sum()
        return float(value), gradient, information

    def value_and_step(places: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, gradient, information = value_and_information(places[0])
        return np.array([value]), np.linalg.solve(information, gradient)[None]

    at = ascend(value_and_step, np.append(np.zeros(p), 1.0)[None])[0][0]
    value, _, information = value_and_information(at)
    tau = 1 / at[-1]
    slopes = at[:-1] * tau
    to_user = np.linalg.inv(r) * scale
    jacobian = np.zeros((p + 1, p + 1))
    jacobian[:p, :p] = to_user * tau
    jacobian[:p, -1] = -(to_user @ slopes) * tau
    jacobian[-1, -1] = -(tau**2) * scale
    covariance = jacobian @ np.linalg.solve(information, jacobian.T)
    log_likelihood = value - float(exact.sum() * np.log(scale))
    return CensoredFit(
        start + to_user @ slopes,
        float(tau * scale),
        (covariance + covariance.T) / 2,
        log_likelihood,
    )


class Diagnostic(NamedTuple):
    """A test of one assumption. ``p_value``: probability of a statistic at least as large if the
    assumption holds."""

    assumption: str
    test: str
    statistic: float
    p_value: float


def diagnose(fit: AhatFit) -> tuple[Diagnostic, ...]:
    """Test the assumptions of MIL-HDBK-1823A: linearity, equal scatter, normality, independence of
    rows in their order. Do not trust it below 20 signals; it returns nothing with fewer than
    `LEAST` between the limits."""
    exact = ~(fit.below | fit.above)
    if exact.sum() < LEAST:
        return ()
    z = residual_scores(fit)
    x = fit.x[exact]
    n = len(z)

    bend = 0.0  # likelihood ratio of a quadratic term, with the censored signals
    spread = (fit.x - fit.x.mean()) / fit.x.std()
    if len(np.unique(spread)) > 2:
        columns = np.column_stack([np.ones_like(spread), spread, spread**2])
        line = fit_censored(columns[:, :2], fit.y, fit.below, fit.above)
        bent = fit_censored(columns[:, :3], fit.y, fit.below, fit.above)
        bend = max(float(2 * (bent.log_likelihood - line.log_likelihood)), 0.0)
    # Breusch and Pagan 1979 with Koenker's 1981 studentised statistic n R^2 of z^2 on x.
    share = 0.0 if x.std() == 0 or (z**2).std() == 0 else n * float(np.corrcoef(x, z**2)[0, 1]) ** 2
    # Von Neumann's ratio of successive differences in the order of rows (Durbin-Watson's
    # statistic), two-sided; with divisor n in both: mean 2, variance 4 (n - 2) / ((n - 1)(n + 1))
    # for independent normal
    # values.
    ratio = float(np.sum(np.diff(z) ** 2) / np.sum((z - z.mean()) ** 2))
    score = (ratio - 2) / np.sqrt(4 * (n - 2) / ((n - 1) * (n + 1)))
    return (
        Diagnostic(
            "linearity", "quadratic term, likelihood ratio", bend, float(stats.chi2.sf(bend, 1))
        ),
        Diagnostic("equal scatter", "Breusch-Pagan", share, float(stats.chi2.sf(share, 1))),
        Diagnostic("normality", "Anderson-Darling", *_anderson_darling(z)),
        Diagnostic(
            "independence of rows", "Durbin-Watson", ratio, float(2 * stats.norm.sf(abs(score)))
        ),
    )


def residual_scores(fit: AhatFit) -> np.ndarray:
    """Return the residuals of the signals between the limits as scores that are standard normal
    under the model. Their distribution, which the limits truncate, maps them: u = (F(r) - F(low))
    / (F(high) - F(low)), z = Phi^-1(u)."""
    exact = ~(fit.below | fit.above)
    line = (fit.b0 + fit.b1 * fit.x)[exact]

    def standard(limit: float | None, none: float) -> np.ndarray:
        if limit is None:
            return np.full(len(line), none)
        return ((np.log(limit) if fit.log_signal else limit) - line) / fit.tau

    r = (fit.y[exact] - line) / fit.tau
    low = standard(fit.left, -np.inf)
    high = standard(fit.right, np.inf)
    # Mirrored if the interval lies in the upper tail, so that differences of F keep their digits.
    mirror = np.where(np.minimum(low, r) > 0, -1.0, 1.0)
    ends = special.ndtr(mirror * low), special.ndtr(mirror * high)
    z = special.ndtri(np.abs(special.ndtr(mirror * r) - ends[0]) / np.abs(ends[1] - ends[0]))
    return np.clip(np.where(np.isneginf(low) & np.isposinf(high), r, z), -38.0, 38.0)


def _anderson_darling(z: np.ndarray) -> tuple[float, float]:
    """Return the statistic for an estimated mean and variance, and p by D'Agostino and Stephens
    1986, table 4.9."""
    ordered = np.sort((z - z.mean()) / z.std(ddof=1))
    n = len(z)
    logs = special.log_ndtr(ordered) + special.log_ndtr(-ordered[::-1])
    a = (-n - float(np.mean((2 * np.arange(1, n + 1) - 1) * logs))) * (1 + 0.75 / n + 2.25 / n**2)
    pieces = [(0.6, 1.2937, -5.709, 0.0186, 0), (0.34, 0.9177, -4.279, -1.38, 0)]
    pieces += [(0.2, -8.318, 42.796, -59.938, 1), (-np.inf, -13.436, 101.14, -223.73, 1)]
    _, c0, c1, c2, upper = next(piece for piece in pieces if a > piece[0])
    tail = np.exp(min(c0 + c1 * a + c2 * a**2, 700.0))
    return a, float(np.clip(1 - tail if upper else tail, 0, 1)) if a < 13 else 0.0
