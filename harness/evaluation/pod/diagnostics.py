"""Whether a regression of signal on size may be believed: the four assumptions of MIL-HDBK-1823A, each with a p-value.

Residuals are those of the signals between the limits. Near a limit their distribution is cut off, so they are mapped
through it first: u = (F(r) - F(low)) / (F(high) - F(low)), z = Phi^-1(u), which is standard normal under the model
whatever was censored. The parameters are estimated, so z are a little too regular; below 20 signals trust none of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special, stats

from harness.evaluation.pod.ahat import AhatFit
from harness.evaluation.pod.censored import fit_censored

LEVEL = 0.05
"""p-value below which a diagnostic speaks against an assumption."""
LEAST = 8
"""Signals between the limits below which Anderson and Darling's approximation of p does not hold."""


@dataclass(frozen=True)
class Diagnostic:
    """One test of one assumption: ``p_value`` of a statistic at least as large while the assumption holds."""

    assumption: str
    test: str
    statistic: float
    p_value: float

    @property
    def doubtful(self) -> bool:
        """Whether the data speak against the assumption at `LEVEL`."""
        return self.p_value < LEVEL

    @property
    def name(self) -> str:
        """Assumption and test."""
        return f"{self.assumption} ({self.test})"

    @property
    def text(self) -> str:
        """What the test says, in words."""
        return f"doubtful at {LEVEL:.0%}" if self.doubtful else f"nothing against it at {LEVEL:.0%}"


def diagnose(fit: AhatFit) -> tuple[Diagnostic, ...]:
    """Linearity, equal scatter, normality, independence; and of targets measured repeatedly, independence of repeats.

    The order of rows counts for independence only. Nothing with fewer than `LEAST` signals between the limits.
    """
    exact = ~(fit.below | fit.above)
    if exact.sum() < LEAST:
        return ()
    z = residual_scores(fit)
    tests = [_linearity(fit), _equal_scatter(z, fit.x[exact]), _normality(z), _independence(z)]
    if fit.per_target > 1 and (repeats := _repeats(z, fit.target[exact])):
        tests.append(repeats)
    return tuple(tests)


def residual_scores(fit: AhatFit) -> np.ndarray:
    """Residuals (signals between the limits,) as scores that are standard normal under the model."""
    exact = ~(fit.below | fit.above)
    line = (fit.b0 + fit.b1 * fit.x)[exact]

    def standard(limit: float | None, none: float) -> np.ndarray:
        if limit is None:
            return np.full(len(line), none)
        return ((np.log(limit) if fit.log_signal else limit) - line) / fit.tau

    r, low, high = (fit.y[exact] - line) / fit.tau, standard(fit.left, -np.inf), standard(fit.right, np.inf)
    # Mirrored where the interval lies in the upper tail: the differences of F then keep their digits.
    mirror = np.where(np.minimum(low, r) > 0, -1.0, 1.0)
    ends = special.ndtr(mirror * low), special.ndtr(mirror * high)
    z = special.ndtri(np.abs(special.ndtr(mirror * r) - ends[0]) / np.abs(ends[1] - ends[0]))
    return np.clip(np.where(np.isneginf(low) & np.isposinf(high), r, z), -38.0, 38.0)


def _linearity(fit: AhatFit) -> Diagnostic:
    """Likelihood ratio of a quadratic term: it takes the censored signals in."""
    spread = (fit.x - fit.x.mean()) / fit.x.std()
    if len(np.unique(spread)) < 3:
        return Diagnostic("linearity", "quadratic term, likelihood ratio", 0.0, 1.0)
    line = fit_censored(np.column_stack([np.ones_like(spread), spread]), fit.y, fit.below, fit.above)
    bent = fit_censored(np.column_stack([np.ones_like(spread), spread, spread**2]), fit.y, fit.below, fit.above)
    ratio = max(float(2 * (bent.log_likelihood - line.log_likelihood)), 0.0)
    return Diagnostic("linearity", "quadratic term, likelihood ratio", ratio, float(stats.chi2.sf(ratio, 1)))


def _equal_scatter(z: np.ndarray, x: np.ndarray) -> Diagnostic:
    """Breusch and Pagan 1979 with Koenker's 1981 studentised statistic n R^2 of z^2 on x."""
    squares = z**2
    share = 0.0 if x.std() == 0 or squares.std() == 0 else float(np.corrcoef(x, squares)[0, 1]) ** 2
    statistic = len(z) * share
    return Diagnostic("equal scatter", "Breusch-Pagan", statistic, float(stats.chi2.sf(statistic, 1)))


def _normality(z: np.ndarray) -> Diagnostic:
    """Anderson and Darling, mean and variance estimated; p by D'Agostino and Stephens 1986, table 4.9."""
    ordered = np.sort((z - z.mean()) / z.std(ddof=1))
    n = len(z)
    weights = 2 * np.arange(1, n + 1) - 1
    logs = special.log_ndtr(ordered) + special.log_ndtr(-ordered[::-1])
    a = (-n - float(np.mean(weights * logs))) * (1 + 0.75 / n + 2.25 / n**2)
    if a >= 0.6:
        p = np.exp(1.2937 - 5.709 * a + 0.0186 * a**2)
    elif a > 0.34:
        p = np.exp(0.9177 - 4.279 * a - 1.38 * a**2)
    elif a > 0.2:
        p = 1 - np.exp(-8.318 + 42.796 * a - 59.938 * a**2)
    else:
        p = 1 - np.exp(-13.436 + 101.14 * a - 223.73 * a**2)
    return Diagnostic("normality", "Anderson-Darling", a, float(np.clip(p, 0, 1)) if a < 13 else 0.0)


def _independence(z: np.ndarray) -> Diagnostic:
    """Von Neumann's ratio of successive differences in the order of rows (Durbin-Watson's statistic), two-sided."""
    n = len(z)
    deviation = z - z.mean()
    ratio = float(np.sum(np.diff(z) ** 2) / np.sum(deviation**2))
    # Ratio with divisor n in both: mean 2, variance 4 (n - 2) / ((n - 1)(n + 1)) for independent normal values.
    score = (ratio - 2) / np.sqrt(4 * (n - 2) / ((n - 1) * (n + 1)))
    return Diagnostic("independence of rows", "Durbin-Watson", ratio, float(2 * stats.norm.sf(abs(score))))


def _repeats(z: np.ndarray, target: np.ndarray) -> Diagnostic | None:
    """One-way analysis of variance of the residuals over targets: alike within a target, repeats are no targets."""
    _, group, size = np.unique(target, return_inverse=True, return_counts=True)
    groups, n = len(size), len(z)
    if groups < 2 or n <= groups:
        return None
    mean = np.bincount(group, z) / size
    between = float(np.sum(size * (mean - z.mean()) ** 2)) / (groups - 1)
    within = float(np.sum((z - mean[group]) ** 2)) / (n - groups)
    f = between / within if within > 0 else np.inf
    return Diagnostic("independence of repeats", "ANOVA over targets", f, float(stats.f.sf(f, groups - 1, n - groups)))
