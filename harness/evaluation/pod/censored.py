"""Linear regression with normal scatter where some values are only known to lie beyond a limit (maximum likelihood).

Tobin 1958; solved in Olsen's 1978 parameters (coefficients / tau, 1 / tau), in which the log-likelihood is concave, so
that Newton's method finds the one maximum. Rows are taken as independent with one scatter: neither is tested here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from harness.vocabulary.errors import UserError

_STEPS = 100
"""Newton needs about six steps; a hundred that do not converge are a bug, and said to be one."""
_TOLERANCE = 1e-10
"""Newton decrement (log-likelihood still to gain, doubled) at which the fit stands."""
_EXACT = 1e-9
"""Scatter below this share of the signals' largest deviation is a line drawn by rounding, with no likelihood."""


@dataclass(frozen=True, eq=False)
class CensoredFit:
    """``coefficients`` (p,), scatter ``tau`` (maximum likelihood: no correction for degrees of freedom), inverse
    observed information ``covariance`` (p + 1, p + 1) of (coefficients, tau), ``log_likelihood`` of the rows."""

    coefficients: np.ndarray
    tau: float
    covariance: np.ndarray
    log_likelihood: float


def fit_censored(design: np.ndarray, y: np.ndarray, below: np.ndarray, above: np.ndarray) -> CensoredFit:
    """Maximum likelihood of y = design @ coefficients + tau * normal.

    ``design`` (n, p); ``y`` (n,): the value, or the limit where ``below`` or ``above`` (n,) say that the value lies
    beyond it. Raises UserError where the exact values do not determine the line or its scatter.
    """
    exact = ~(below | above)
    if exact.sum() <= design.shape[1] or np.linalg.matrix_rank(design[exact]) < design.shape[1]:
        raise UserError(
            f"{exact.sum()} of {len(y)} signals lie between the limits: too few, or at too few sizes, for a regression",
            legal=f"more than {design.shape[1]} signals that are not censored, at different sizes",
        )
    start = np.linalg.lstsq(design[exact], y[exact], rcond=None)[0]
    rest = y - design @ start
    scale = float(np.sqrt(np.mean(rest[exact] ** 2)))
    if scale <= _EXACT * float(np.max(np.abs(y[exact] - y[exact].mean()), initial=0.0)) or scale == 0:
        raise UserError("the signals lie exactly on a line: there is no scatter to estimate", fix="check the column")
    # Orthonormal columns and residuals of unit scatter: Newton's system is then well conditioned in any unit.
    q, r = np.linalg.qr(design)
    q, r = q * np.sqrt(len(y)), r / np.sqrt(len(y))
    sign = np.where(above, -1.0, 1.0)[:, None]
    rows = sign * np.column_stack([-q, rest / scale])
    parameters, information = _newton(rows, exact)
    log_likelihood = _log_likelihood(parameters, rows, exact) - float(exact.sum() * np.log(scale))
    return _in_the_users_units(start, scale, r, parameters, information, log_likelihood)


def _newton(rows: np.ndarray, exact: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Olsen's parameters (p + 1,) at the maximum, and the observed information there."""
    parameters = np.zeros(rows.shape[1])
    parameters[-1] = 1.0
    value = _log_likelihood(parameters, rows, exact)
    for _ in range(_STEPS):
        gradient, information = _derivatives(parameters, rows, exact)
        step = np.linalg.solve(information, gradient)
        decrement = float(gradient @ step)
        if decrement < _TOLERANCE:
            return parameters, information
        share = 1.0
        while (new := _log_likelihood(parameters + share * step, rows, exact)) < value + 1e-4 * share * decrement:
            share /= 2
            if share < 1e-8:  # Rounding hides what is left to gain.
                return parameters, information
        parameters, value = parameters + share * step, new
    raise RuntimeError(f"censored regression: no maximum after {_STEPS} Newton steps")


def _log_likelihood(parameters: np.ndarray, rows: np.ndarray, exact: np.ndarray) -> float:
    inverse_tau = parameters[-1]
    if inverse_tau <= 0:
        return -np.inf
    s = rows @ parameters
    density = np.log(inverse_tau) - 0.5 * s[exact] ** 2 - 0.5 * np.log(2 * np.pi)
    return float(density.sum() + special.log_ndtr(s[~exact]).sum())


def _derivatives(parameters: np.ndarray, rows: np.ndarray, exact: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and negative Hessian: every row's term depends on s = row @ parameters alone, but for n ln(1 / tau)."""
    s = rows @ parameters
    mills = np.exp(-0.5 * s**2 - 0.5 * np.log(2 * np.pi) - special.log_ndtr(s))
    first = np.where(exact, -s, mills)
    weight = np.where(exact, 1.0, mills * (mills + s))
    gradient = rows.T @ first
    information = rows.T @ (weight[:, None] * rows)
    gradient[-1] += exact.sum() / parameters[-1]
    information[-1, -1] += exact.sum() / parameters[-1] ** 2
    return gradient, information


def _in_the_users_units(
    start: np.ndarray,
    scale: float,
    r: np.ndarray,
    parameters: np.ndarray,
    information: np.ndarray,
    log_likelihood: float,
) -> CensoredFit:
    p = len(start)
    tau = 1 / parameters[-1]
    slopes = parameters[:-1] * tau
    to_user = np.linalg.inv(r) * scale
    jacobian = np.zeros((p + 1, p + 1))
    jacobian[:p, :p] = to_user * tau
    jacobian[:p, -1] = -(to_user @ slopes) * tau
    jacobian[-1, -1] = -(tau**2) * scale
    covariance = jacobian @ np.linalg.solve(information, jacobian.T)
    return CensoredFit(start + to_user @ slopes, float(tau * scale), (covariance + covariance.T) / 2, log_likelihood)
