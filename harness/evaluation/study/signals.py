"""a50 and a90 from signals (a-hat, MIL-HDBK-1823A appendix G), beside those from hits and misses.

A damage's signal is its highest score within the hit radius. A miss says only that its signal lies
below the threshold: what is lower is the highest noise within the radius, which does not grow with
size. With its value, a50 came out .07 to .41 mm below that from hits in seven of eight set-ups; as
it is here, -.15 to .06 mm from it, median 0. Signals above `SATURATED` thresholds say only that
they lie above: the line has to hold where detection rises. So the regression contains all that hits
and misses contain, and how far a signal exceeds the threshold besides. What is hit although its
signal is too low (missing returns, a finding's own place) counts as above the threshold.

The line is fitted on all pairs of axes (size, signal, or their logarithms). Those are left out
whose data contradict an assumption: a straight line, equal scatter, normal scatter, or a curve that
agrees with hits and misses. The rest are averaged by likelihood. Variances are of boards (Liang and
Zeger, Biometrika 73 (1986), 13), at least those of independent damages, with Student's t for so few
boards; the threshold's error, which moves sizes by error over slope, is added. Not modelled:
several units of a camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from harness.evaluation.intervals import UNKNOWN, UPPER, Interval
from harness.evaluation.pod.ahat import AhatFit, diagnose, fit_ahat
from harness.evaluation.pod.averaged import weighted_quantiles
from harness.evaluation.pod.hit_miss import HitMissFit
from harness.evaluation.study.record import SetUpRecord
from harness.vocabulary.errors import UserError

SATURATED = 4.0  # thresholds: 12 dB
LEAST_BETWEEN = 20  # signals between the limits below which the tests cannot be trusted
LEVEL = 0.05  # of all tests of one line together
AXES = ((False, False), (False, True), (True, False), (True, True))
QUANTILES = (np.arange(400) + 0.5) / 400
ASSUMPTIONS = ("linearity", "equal scatter", "normality")
CONTRADICTED = {
    "linearity": "signals do not grow in a straight line with size",
    "equal scatter": "the scatter of signals changes with size",
    "normality": "the scatter of signals is not normal",
    "agreement": "hits and misses contradict the curve",
}


@dataclass(frozen=True, eq=False)
class SignalLine:
    """A line of signals against size that contradicts no assumption."""

    fit: AhatFit
    """The regression, and the curve that it implies."""
    influence: np.ndarray
    """Influence (boards, 2) of each board on the curve's mu and sigma, on the axis of sizes."""
    error: float
    """Standard error of the threshold on the axis of signals."""

    @property
    def axes(self) -> tuple[bool, bool]:
        """True for an axis of the logarithm, of size and of signal."""
        return self.fit.log_size, self.fit.log_signal

    def influence_at(self, pod: float) -> np.ndarray:
        """Return by how much each board (boards,) moves the size with this POD, on its axis."""
        return np.asarray(self.influence @ _weights(pod))

    @property
    def of_threshold(self) -> float:
        """Change of every size, on its axis, by one standard error of the threshold."""
        return self.error / self.fit.b1

    def log_influence_at(self, pod: float) -> tuple[np.ndarray, float]:
        """Return by how much each board (boards,), and one standard error of the threshold, move
        the logarithm of that size."""
        curve = self.fit.curve
        unit = 1.0 if curve.log_size else curve.size_at(pod)
        return self.influence_at(pod) / unit, self.of_threshold / unit

    def variance(self, pod: float) -> float:
        """Return the variance of that size on its axis."""
        weights = _weights(pod)
        of_damages = float(weights @ self.fit.curve.covariance @ weights)
        of_boards = sandwich(self.influence_at(pod))
        return max(of_damages, of_boards) + self.of_threshold**2

    def quantiles(self, pod: float) -> np.ndarray:
        """Return evenly spaced quantiles of that size."""
        curve = self.fit.curve
        x = curve.mu + curve.sigma * float(special.ndtri(pod))
        deviation = np.sqrt(self.variance(pod))
        degrees = max(len(self.influence) - 1, 1)
        values = x + deviation * special.stdtrit(degrees, QUANTILES)
        with np.errstate(over="ignore"):
            return np.asarray(np.exp(values) if curve.log_size else values)


@dataclass(frozen=True, eq=False)
class SignalSizes:
    """a50 and a90 from signals; NaN, with the reason, where an assumption does not hold."""

    lines: tuple[SignalLine, ...] = ()
    """The lines, the likeliest first."""
    why: str = ""
    """Reason why there is none; else empty."""

    @property
    def a50_mm(self) -> float:
        """Size found 50 % of the time."""
        return self._size_at(0.5)

    @property
    def a90_mm(self) -> float:
        """Size found 90 % of the time."""
        return self._size_at(0.9)

    @property
    def a50_interval_mm(self) -> Interval:
        """95 % interval of a50 over boards and thresholds."""
        return self._interval(0.5)

    @property
    def a90_interval_mm(self) -> Interval:
        """95 % interval of a90 likewise."""
        return self._interval(0.9)

    @property
    def a90_95_mm(self) -> float:
        """Upper bound of a90 at 95 % confidence."""
        return float(self._quantiles(0.9, (0.95,))[0])

    def _size_at(self, pod: float) -> float:
        return self.lines[0].fit.curve.size_at(pod) if self.lines else np.nan

    def _interval(self, pod: float) -> Interval:
        if not self.lines:
            return UNKNOWN
        low, high = self._quantiles(pod, (1.0 - UPPER, UPPER)).tolist()
        return Interval(low, high)

    def _quantiles(self, pod: float, shares: Sequence[float]) -> np.ndarray:
        """Return quantiles of a size by all lines, each weighted by its likelihood."""
        if not self.lines:
            return np.full(len(shares), np.nan)
        logs = np.array([line.fit.log_likelihood for line in self.lines])
        weight = np.exp(logs - logs.max())
        sizes = np.concatenate([line.quantiles(pod) for line in self.lines])
        quantile_weights = np.repeat(weight / weight.sum() / len(QUANTILES), len(QUANTILES))
        return weighted_quantiles(sizes, quantile_weights, shares)


def sizes_from_signals(record: SetUpRecord, hits: HitMissFit | None) -> SignalSizes:
    """Return the sizes of a set-up. ``hits``: the likeliest curve from hits and misses, without
    which there is nothing to stand beside. Data that allow none are no error."""
    inspected = record.inspected
    if hits is None:
        return SignalSizes(why="hits and misses have no curve")
    if record.units > 1:
        return SignalSizes(why="several units of the camera are not modelled")
    above = inspected.hit & (inspected.signal > record.threshold)
    between = int((above & (inspected.signal < SATURATED * record.threshold)).sum())
    if between < LEAST_BETWEEN:
        range_words = f"between the threshold and {SATURATED:g} times it"
        return SignalSizes(
            why=f"{between} signals lie {range_words}, and {LEAST_BETWEEN} are needed"
        )
    lines = []
    refused: list[tuple[float, str]] = []
    for log_size, log_signal in AXES:
        try:
            fit = _fit(record, log_size=log_size, log_signal=log_signal)
        except UserError as error:
            refused.append((-np.inf, error.message))
            continue
        why = contradiction(fit, hits)
        if why:
            refused.append((fit.log_likelihood, why))
        else:
            lines.append(_line(record, fit))
    lines.sort(key=lambda line: -line.fit.log_likelihood)
    if not lines:
        return SignalSizes(why=max(refused)[1])
    return SignalSizes(lines=tuple(lines))


def _fit(record: SetUpRecord, *, log_size: bool, log_signal: bool) -> AhatFit:
    """Regress the signals of a set-up on size."""
    inspected = record.inspected
    return fit_ahat(
        inspected.size_mm,
        np.nan_to_num(inspected.signal),
        decision=record.threshold,
        left=record.threshold,
        right=SATURATED * record.threshold,
        log_size=log_size,
        log_signal=log_signal,
        found=inspected.hit,
    )


def contradiction(fit: AhatFit, hits: HitMissFit) -> str:
    """Return the assumption that the data contradict most clearly, in words; empty if none."""
    p_values = {
        test.assumption: test.p_value for test in diagnose(fit) if test.assumption in ASSUMPTIONS
    }
    p_values["agreement"] = _agreement(fit, hits)
    worst = min(p_values, key=lambda name: p_values[name])
    if p_values[worst] * len(p_values) > LEVEL:
        return ""
    return f"{CONTRADICTED[worst]} (p = {p_values[worst]:.2g})"


def _agreement(fit: AhatFit, hits: HitMissFit) -> float:
    """Return the p-value of the curve's likelihood of hits and misses against the largest that the
    fitted curve gives them, as if the curve were not of the same data, which is cautious."""
    curve = fit.curve
    t = (fit.x - curve.mu) / curve.sigma
    by_signal = np.where(fit.below, special.log_ndtr(-t), special.log_ndtr(t)).sum()
    ratio = 2 * (hits.log_likelihood - float(by_signal)) / hits.repeats
    return float(special.chdtrc(2, max(ratio, 0.0)))


def _line(record: SetUpRecord, fit: AhatFit) -> SignalLine:
    """Return a line with the influence of its boards."""
    of_parameters = _scores(fit) @ fit.covariance
    curve = fit.curve
    jacobian = np.array([[-1.0, -curve.mu, 0.0], [0.0, -curve.sigma, 1.0]]) / fit.b1
    _, board = np.unique(record.inspected.board, return_inverse=True)
    of_boards = np.zeros((int(board.max()) + 1, 2))
    np.add.at(of_boards, board, of_parameters @ jacobian.T)
    stated = record.threshold_error
    error = 0.0 if stated is None else stated.error
    on_axis = error / record.threshold if fit.log_signal else error
    return SignalLine(fit=fit, influence=of_boards, error=on_axis)


def _scores(fit: AhatFit) -> np.ndarray:
    """Return the slopes (n, 3) of each row's log-likelihood by intercept, slope and scatter."""
    s = (fit.y - fit.b0 - fit.b1 * fit.x) / fit.tau
    log_density = -0.5 * s**2 - 0.5 * np.log(2 * np.pi)
    of_below = -np.exp(log_density - special.log_ndtr(s))
    of_above = np.exp(log_density - special.log_ndtr(-s))
    by_level = np.where(fit.below, of_below, np.where(fit.above, of_above, s))
    by_scatter = np.where(fit.exact, s**2 - 1.0, by_level * s)
    return np.column_stack([by_level, by_level * fit.x, by_scatter]) / fit.tau


def _weights(pod: float) -> np.ndarray:
    """Return the weights of mu and sigma in the size with this POD."""
    return np.array([1.0, float(special.ndtri(pod))])


def sandwich(influence: np.ndarray) -> float:
    """Return the variance from the influence (G,) of each of G boards; infinite for one."""
    boards = len(influence)
    if boards < 2:
        return float("inf")
    return float((influence**2).sum() * boards / (boards - 1))
