"""Signal against size (a-hat against a), MIL-HDBK-1823A (2009) appendix G and ASTM E3023:
regression, then POD. The model is y = b0 + b1 x + tau * normal, x = size or ln size, y = signal or
ln signal, censored at the noise floor and at saturation. A target is found if y > decision, so POD
= Phi((x - mu) / sigma), mu = (decision - b0) / b1 and sigma = tau / b1; the delta method gives
their covariance. k signals of one target are not k targets: the fit treats rows as independent and
multiplies the covariance by k, the mean number of signals per target. That is right if a target's
signals are equal, else cautious. Not modelled: scatter that grows with size, curvature (`diagnose`
tests both)."""

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from harness.evaluation.pod.curve import Bound, PodCurve, ascend
from harness.evaluation.pod.hit_miss import rows_of_target
from harness.vocabulary.errors import UserError

LEAST_TARGETS = 40  # least number of independent targets of an a-hat study, by MIL-HDBK-1823A
SAME = 1e-9
"""Relative difference to the largest signal that is only rounding. A scatter below this share of
the signals' largest deviation is a line drawn by rounding, which has no likelihood."""
LEVEL = 0.05  # a diagnostic with a smaller p-value rejects its assumption
# fewest signals between the limits for which Anderson and Darling's approximation of p holds
LEAST = 8


@dataclass(frozen=True, eq=False)
class AhatFit:
    """A regression of signals and the POD curve that it implies."""

    curve: PodCurve
    """POD of signals above ``decision``."""
    b0: float
    """Intercept."""
    b1: float
    """Slope, above 0."""
    tau: float
    """Scatter of signals about the line."""
    covariance: np.ndarray
    """Covariance (3, 3) of (b0, b1, tau) for independent targets; divided by ``per_target`` it is
    that for independent rows."""
    log_likelihood: float
    """Log-likelihood of signals in their own unit."""
    deviance: float
    """-2 times the log-likelihood."""
    x: np.ndarray
    """Sizes (n,) on the axis of the fit."""
    y: np.ndarray
    """Signals (n,) on the axis of the fit, censored ones at their limit."""
    below: np.ndarray
    """Signals (n,) bool at the noise floor."""
    above: np.ndarray
    """Signals (n,) bool that are saturated."""
    n: int
    """Number of rows."""
    targets: int
    """Number of targets."""
    per_target: float
    """Mean number of signals of a target, over rows."""
    log_size: bool
    """True if x is ln size."""
    log_signal: bool
    """True if y is ln signal."""
    decision: float
    """Threshold of signals, in their own unit."""
    left: float | None
    """Noise floor in the signal's unit, if any."""
    right: float | None
    """Saturation in the signal's unit, if any."""
    notes: tuple[str, ...]
    """Remarks on the data."""

    @property
    def exact(self) -> np.ndarray:
        """Signals (n,) bool between the limits."""
        return np.asarray(~(self.below | self.above))


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
    found: ArrayLike | None = None,
) -> AhatFit:
    """Regress ``signal`` (n,) on ``size`` (n,) with censoring, and derive the POD of signals above
    ``decision``.

    Signals <= ``left`` are at the noise floor, signals >= ``right`` are saturated. ``inspections``
    (n,): the target of each row. ``found`` (n,) bool: what was found, where ``left`` is the
    ``decision``; whatever its signal, a miss lies below it, and a find is only known to lie above
    it if its signal does not. Raises UserError for data that allow no such regression, or a
    signal that does not grow with size."""
    sizes = _finite("sizes", size)
    signals = _finite("signals", signal)
    n = len(sizes)
    names = np.arange(n) if inspections is None else np.asarray(inspections).astype(str)
    if not n == len(signals) == len(names):
        counts = f"{n} sizes, {len(signals)} signals and {len(names)} targets"
        raise UserError(f"{counts}: each row needs one of each")
    rows_each = rows_of_target(sizes, names)
    low = -np.inf if left is None else left
    high = np.inf if right is None else right
    _check_limits(low, decision, high)
    below = signals <= low
    above = signals >= high
    if found is not None:
        above = np.asarray(found, bool) & (below | above)
        below = ~np.asarray(found, bool)
        signals = np.where(below, low, signals)
    _check_that_signals_vary(signals[~(below | above)])
    x = _axis("sizes", sizes, log_size)
    y = _axis("signals", np.clip(signals, low, high), log_signal)
    threshold = float(_axis("decision", np.array([decision]), log_signal)[0])

    line = fit_censored(np.column_stack([np.ones_like(x), x]), y, below, above)
    b0, b1 = line.coefficients.tolist()
    if b1 <= 0:
        fix = "check the columns of size and signal, or reverse the sign of the signal"
        raise UserError(
            f"the signal does not grow with size (slope {b1:.4g}): there is no detection limit",
            fix=fix,
        )
    # the design effect of rows that are equal within a target (Kish)
    per_target = float(rows_each.mean())
    covariance = line.covariance * per_target
    mu = float((threshold - b0) / b1)
    sigma = float(line.tau / b1)
    # slopes of mu = (threshold - b0) / b1 and sigma = tau / b1 by (b0, b1, tau)
    jacobian = np.array([[-1.0, -mu, 0.0], [0.0, -sigma, 1.0]]) / b1
    curve = PodCurve("probit", log_size, mu, sigma, jacobian @ covariance @ jacobian.T)
    # of ln signal: the Jacobian turns its density into that of the signal
    jacobian_of_log = float(y[~(below | above)].sum()) if log_signal else 0.0
    log_likelihood = line.log_likelihood - jacobian_of_log
    targets = round(float((1 / rows_each).sum()))
    return AhatFit(
        curve=curve,
        b0=b0,
        b1=b1,
        tau=line.tau,
        covariance=covariance,
        log_likelihood=log_likelihood,
        deviance=-2 * log_likelihood,
        x=x,
        y=y,
        below=below,
        above=above,
        n=n,
        targets=targets,
        per_target=per_target,
        log_size=log_size,
        log_signal=log_signal,
        decision=decision,
        left=left,
        right=right,
        notes=_notes(targets, per_target, curve.size_at(0.9), sizes),
    )


def _check_limits(
    low: float,
    decision: float,
    high: float,
) -> None:
    """Refuse limits that are not in order, and a decision beyond them."""
    if not low < high:
        raise UserError(f"noise floor {low:g} is not below saturation {high:g}")
    if not low <= decision <= high:
        legal = f"between the noise floor {low:g} and saturation {high:g}"
        raise UserError(
            f"decision {decision:g} lies outside the signals that can be distinguished", legal=legal
        )


def _check_that_signals_vary(between: np.ndarray) -> None:
    """Refuse signals between the limits that are all equal."""
    if len(between) > 1 and np.ptp(between) <= SAME * np.abs(between).max():
        fix = "use hits and misses instead: signals that are all equal say nothing about size"
        raise UserError(
            f"the signals do not vary: all {len(between)} between the limits are {between[0]:.6g}",
            fix=fix,
        )


def _notes(
    targets: int,
    per_target: float,
    a90: float,
    sizes: np.ndarray,
) -> tuple[str, ...]:
    notes = []
    if targets < LEAST_TARGETS:
        notes.append(
            f"{targets} independent targets; MIL-HDBK-1823A asks for at least {LEAST_TARGETS}"
        )
    if per_target > 1:
        notes.append(
            f"{per_target:.3g} signals per target multiply the covariance: {targets} targets count"
        )
    if not sizes.min() <= a90 <= sizes.max():
        inspected = f"{sizes.min():.4g} to {sizes.max():.4g}"
        notes.append(f"a90 = {a90:.3g} lies outside the sizes inspected ({inspected})")
    return tuple(notes)


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
    fits = []
    for log_size, log_signal in product(log_sizes, log_signals):
        fit = fit_ahat(
            sizes,
            signals,
            decision=decision,
            left=left,
            right=right,
            log_size=log_size,
            log_signal=log_signal,
            inspections=inspections,
        )
        fits.append(fit)
    return tuple(sorted(fits, key=lambda fit: fit.deviance))


def ahat_bound(
    fit: AhatFit,
    pod: float = 0.9,
    confidence: float = 0.95,
) -> Bound:
    """Return the one-sided upper bound on the size found with probability ``pod``, by the delta
    method on x: mu + z sigma + z_confidence sqrt(V11 + 2 z V12 + z^2 V22), z = Phi^-1(pod). It is
    infinite if sigma may be 0."""
    curve = fit.curve
    v = curve.covariance
    z = float(special.ndtri(pod))
    quantile = float(special.ndtri(confidence))
    if curve.sigma**2 <= quantile**2 * v[1, 1]:
        why = (
            "the signal's growth with size is too uncertain at this confidence "
            "(the band is open at large sizes)"
        )
        return Bound(pod, confidence, "delta", float("inf"), why)
    standard_error = float(np.sqrt(v[0, 0] + 2 * z * v[0, 1] + z**2 * v[1, 1]))
    x = curve.mu + z * curve.sigma + quantile * standard_error
    return Bound(pod, confidence, "delta", float(np.exp(x)) if curve.log_size else x)


def ahat_band(
    fit: AhatFit,
    sizes: ArrayLike,
    confidence: float = 0.95,
) -> tuple[np.ndarray, np.ndarray]:
    """Return (lower, upper) POD at ``sizes`` (any shape), each one-sided, through the bounds of
    all sizes a_p: (x - mu - z sigma)^2 = z_confidence^2 (V11 + 2 z V12 + z^2 V22), solved for z; 0
    and 1 where the band is open."""
    sizes = np.asarray(sizes, float)
    curve = fit.curve
    c = float(special.ndtri(confidence)) ** 2
    (v11, v12), (_, v22) = curve.covariance
    leading = curve.sigma**2 - c * v22
    if leading <= 0:
        return np.zeros_like(sizes), np.ones_like(sizes)
    x = np.log(np.maximum(sizes, np.finfo(float).tiny)) if curve.log_size else sizes
    d = x - curve.mu
    half = curve.sigma * d + c * v12
    root = np.sqrt(np.maximum(half**2 - leading * (d**2 - c * v11), 0))
    low = np.asarray(special.ndtr((half - root) / leading))
    high = np.asarray(special.ndtr((half + root) / leading))
    return low, high


def _finite(name: str, values: ArrayLike) -> np.ndarray:
    array = np.asarray(values, float).ravel()
    bad = int((~np.isfinite(array)).sum())
    if bad:
        raise UserError(
            f"{bad} of {len(array)} {name} are not finite numbers", fix="leave these rows out"
        )
    return array


def _axis(
    name: str,
    values: np.ndarray,
    log: bool,
) -> np.ndarray:
    if log and np.any(values <= 0):
        raise UserError(
            f"{name} <= 0 have no logarithm (smallest {values.min():.6g})", legal="values above 0"
        )
    return np.log(values) if log else values


class CensoredFit(NamedTuple):
    """A regression with normal scatter, by maximum likelihood."""

    coefficients: np.ndarray
    """Coefficients (p,) of the design."""
    tau: float
    """Scatter, without a correction for degrees of freedom."""
    covariance: np.ndarray
    """Inverse observed information (p + 1, p + 1) of (coefficients, tau)."""
    log_likelihood: float
    """Log-likelihood of the values and the censored rows."""


def fit_censored(
    design: np.ndarray,
    y: np.ndarray,
    below: np.ndarray,
    above: np.ndarray,
) -> CensoredFit:
    """Fit y = design @ coefficients + tau * normal by maximum likelihood (Tobin 1958).

    ``design`` (n, p). ``y`` (n,): the value, or the limit if ``below`` or ``above`` (n,) says that
    the value lies beyond it. Solved in Olsen's 1978 parameters (coefficients / tau, 1 / tau),
    which make the log-likelihood concave. Raises UserError without a line or scatter."""
    exact = ~(below | above)
    p = design.shape[1]
    if exact.sum() <= p or np.linalg.matrix_rank(design[exact]) < p:
        message = (
            f"{exact.sum()} of {len(y)} signals lie between the limits: "
            "too few, or at too few sizes, for a line"
        )
        raise UserError(
            message, legal=f"more than {p} signals that are not censored, at different sizes"
        )
    start = np.linalg.lstsq(design[exact], y[exact], rcond=None)[0]
    residual = y - design @ start
    scale = float(np.sqrt(np.mean(residual[exact] ** 2)))
    largest_deviation = float(np.max(np.abs(y[exact] - y[exact].mean()), initial=0.0))
    if scale <= SAME * largest_deviation or scale == 0:
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
    sign = np.where(above, -1.0, 1.0)[:, None]
    rows = sign * np.column_stack([-q, residual / scale])
    parameters = _olsen_maximum(rows, exact)
    value, _, information = _olsen_likelihood(rows, exact, parameters)

    # back to coefficients = start + inv(r) scale slopes and scale tau
    tau = 1 / parameters[-1]
    slopes = parameters[:-1] * tau
    to_user = np.linalg.inv(r) * scale
    jacobian = np.zeros((p + 1, p + 1))
    jacobian[:p, :p] = to_user * tau
    jacobian[:p, -1] = -(to_user @ slopes) * tau
    jacobian[-1, -1] = -(tau**2) * scale
    covariance = jacobian @ np.linalg.solve(information, jacobian.T)
    return CensoredFit(
        coefficients=start + to_user @ slopes,
        tau=float(tau * scale),
        covariance=(covariance + covariance.T) / 2,
        log_likelihood=value - float(exact.sum() * np.log(scale)),
    )


def _olsen_likelihood(
    rows: np.ndarray,
    exact: np.ndarray,
    parameters: np.ndarray,
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the log-likelihood, its gradient and its negative Hessian at Olsen's parameters.

    With s = row @ parameters, an exact row gives ln(1 / tau) - s^2 / 2 - ln(2 pi) / 2, and a
    censored one ln Phi(s)."""
    inverse_tau = parameters[-1]
    if inverse_tau <= 0:
        return -np.inf, np.zeros(len(parameters)), np.eye(len(parameters))
    s = rows @ parameters
    log_tail = special.log_ndtr(s)
    mills = np.exp(-0.5 * s**2 - 0.5 * np.log(2 * np.pi) - log_tail)
    gradient = rows.T @ np.where(exact, -s, mills)
    curvature = np.where(exact, 1.0, mills * (mills + s))
    information = rows.T @ (curvature[:, None] * rows)
    gradient[-1] += exact.sum() / inverse_tau
    information[-1, -1] += exact.sum() / inverse_tau**2
    of_exact = (np.log(inverse_tau) - 0.5 * s[exact] ** 2 - 0.5 * np.log(2 * np.pi)).sum()
    value = of_exact + log_tail[~exact].sum()
    return float(value), gradient, information


def _olsen_maximum(rows: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return Olsen's parameters (p + 1,) of the largest likelihood, by Newton's steps."""

    def value_and_step(
        parameters: np.ndarray, problems: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        value, gradient, information = _olsen_likelihood(rows, exact, parameters[0])
        return np.array([value]), np.linalg.solve(information, gradient)[None]

    start = np.append(np.zeros(rows.shape[1] - 1), 1.0)
    maximum, _ = ascend(value_and_step, start[None])
    return np.asarray(maximum[0])


class Diagnostic(NamedTuple):
    """A test of one assumption."""

    assumption: str
    """The assumption that is tested."""
    test: str
    """Name of the test."""
    statistic: float
    """The test's statistic."""
    p_value: float
    """Probability of a statistic at least as large if the assumption holds."""


def diagnose(fit: AhatFit) -> tuple[Diagnostic, ...]:
    """Test the assumptions of MIL-HDBK-1823A: linearity, equal scatter, normality, independence of
    rows in their order. Do not trust it below 20 signals; it returns nothing with fewer than
    `LEAST` between the limits."""
    if fit.exact.sum() < LEAST:
        return ()
    z = residual_scores(fit)
    bend = _bend(fit)
    scatter = _scatter_trend(fit.x[fit.exact], z)
    normality, p_of_normality = _anderson_darling(z)
    ratio, score = _von_neumann(z)
    p_of_bend = float(special.chdtrc(1, bend))
    p_of_scatter = float(special.chdtrc(1, scatter))
    p_of_ratio = float(2 * special.ndtr(-abs(score)))
    return (
        Diagnostic("linearity", "quadratic term, likelihood ratio", bend, p_of_bend),
        Diagnostic("equal scatter", "Breusch-Pagan", scatter, p_of_scatter),
        Diagnostic("normality", "Anderson-Darling", normality, p_of_normality),
        Diagnostic("independence of rows", "Durbin-Watson", ratio, p_of_ratio),
    )


def _bend(fit: AhatFit) -> float:
    """Return the likelihood ratio of a quadratic term, with censored signals; 0 at two sizes."""
    x = (fit.x - fit.x.mean()) / fit.x.std()
    if len(np.unique(x)) <= 2:
        return 0.0
    columns = np.column_stack([np.ones_like(x), x, x**2])
    line = fit_censored(columns[:, :2], fit.y, fit.below, fit.above)
    bent = fit_censored(columns[:, :3], fit.y, fit.below, fit.above)
    return max(float(2 * (bent.log_likelihood - line.log_likelihood)), 0.0)


def _scatter_trend(x: np.ndarray, z: np.ndarray) -> float:
    """Return Breusch and Pagan's 1979 statistic in Koenker's 1981 studentised form: n R^2 of z^2
    on x."""
    if x.std() == 0 or (z**2).std() == 0:
        return 0.0
    return len(z) * float(np.corrcoef(x, z**2)[0, 1]) ** 2


def _von_neumann(z: np.ndarray) -> tuple[float, float]:
    """Return von Neumann's ratio of successive differences in the order of rows (Durbin-Watson's
    statistic), and its standard score. With divisor n in both sums, its mean is 2 and its variance
    4 (n - 2) / ((n - 1)(n + 1)) for independent normal values."""
    n = len(z)
    ratio = float(np.sum(np.diff(z) ** 2) / np.sum((z - z.mean()) ** 2))
    variance = 4 * (n - 2) / ((n - 1) * (n + 1))
    return ratio, float((ratio - 2) / np.sqrt(variance))


def residual_scores(fit: AhatFit) -> np.ndarray:
    """Return the residuals of the signals between the limits as scores that are standard normal
    under the model. Their distribution, which the limits truncate, maps them: u = (F(r) - F(low))
    / (F(high) - F(low)), z = Phi^-1(u)."""
    line = (fit.b0 + fit.b1 * fit.x)[fit.exact]
    r = (fit.y[fit.exact] - line) / fit.tau
    low = np.full(len(line), -np.inf)
    if fit.left is not None:
        low = (_on_axis(fit, fit.left) - line) / fit.tau
    high = np.full(len(line), np.inf)
    if fit.right is not None:
        high = (_on_axis(fit, fit.right) - line) / fit.tau
    # Mirrored if the interval lies in the upper tail, so that differences of F keep their digits.
    mirror = np.where(np.minimum(low, r) > 0, -1.0, 1.0)
    f_low = special.ndtr(mirror * low)
    f_high = special.ndtr(mirror * high)
    u = np.abs(special.ndtr(mirror * r) - f_low) / np.abs(f_high - f_low)
    unlimited = np.isneginf(low) & np.isposinf(high)
    return np.asarray(np.clip(np.where(unlimited, r, special.ndtri(u)), -38.0, 38.0))


def _on_axis(fit: AhatFit, signal: float) -> float:
    return float(np.log(signal)) if fit.log_signal else signal


# p = exp(c0 + c1 a + c2 a^2): (statistic above which it holds, c0, c1, c2, whether it gives 1 - p)
ANDERSON_DARLING = (
    (0.6, 1.2937, -5.709, 0.0186, False),
    (0.34, 0.9177, -4.279, -1.38, False),
    (0.2, -8.318, 42.796, -59.938, True),
    (-np.inf, -13.436, 101.14, -223.73, True),
)


def _anderson_darling(z: np.ndarray) -> tuple[float, float]:
    """Return the statistic for an estimated mean and variance, and p by D'Agostino and Stephens
    1986, table 4.9."""
    ordered = np.sort((z - z.mean()) / z.std(ddof=1))
    n = len(z)
    logs = special.log_ndtr(ordered) + special.log_ndtr(-ordered[::-1])
    mean = float(np.mean((2 * np.arange(1, n + 1) - 1) * logs))
    a = (-n - mean) * (1 + 0.75 / n + 2.25 / n**2)
    if a >= 13:
        return a, 0.0
    _, c0, c1, c2, is_upper = next(piece for piece in ANDERSON_DARLING if a > piece[0])
    tail = np.exp(min(c0 + c1 * a + c2 * a**2, 700.0))
    return a, float(np.clip(1 - tail if is_upper else tail, 0, 1))
