"""The next size to inspect: the one after which a90 is expected to be known best.

All curves that the hits and misses so far allow have a weight (`harness.evaluation.pod.averaged`).
Over these curves, a90 and the probability p(x) of a hit at each size x vary together, and the
outcome at x, a hit or a miss, has the variance of p(x) and the mean of p (1 - p) besides. So it
leaves of a90 the variance Var(a90) - Cov(a90, p(x))^2 / (Var p(x) + E p (1 - p)), and variances and
covariances after it are those of linear regression on it (Bayes linear statistics: Goldstein and
Wooff 2007, chapter 3). Simulated studies of three curves end with 12 to 25 % fewer boards than
with a third of the sizes about a50 and two thirds about a90.

Not modelled: boards that differ, whose damages tell less than as many of other boards."""

import numpy as np

from harness.evaluation.study.limit import SetUpLimit

CANDIDATES = 121  # sizes, evenly over the range: a twelfth of a rise of a tenth of the range
WIDEST = 10.0  # wanted widths: as wide counts an interval without an end
DECIMALS = 3  # sizes are rounded to micrometres: no board hangs on the last digit of an interval


def candidates_mm(range_mm: tuple[float, float]) -> np.ndarray:
    """Return the sizes (`CANDIDATES`,) that are chosen from."""
    return np.round(np.linspace(*range_mm, CANDIDATES), DECIMALS)


class ExpectedWidth:
    """The width of the interval of a90 of one set-up, expected with further damages. Sizes are
    named by their numbers among the `candidates_mm`."""

    def __init__(self, limit: SetUpLimit, range_mm: tuple[float, float], excess: float) -> None:
        """``excess``: the width now over the wanted one."""
        assert limit.statement is not None
        assert limit.statement.average is not None  # only a model that a user states has none
        curves = limit.statement.average.curves
        # no outcome within the range tells sizes beyond it from each other
        a90_mm = np.clip(curves.sizes_at(0.9), *range_mm)
        pods = np.array([curves.pods(size_mm) for size_mm in candidates_mm(range_mm)])
        a90_mm = a90_mm - curves.weight @ a90_mm
        differences = pods - (pods @ curves.weight)[:, None]
        weighted = differences * curves.weight
        self._of_a90 = float(curves.weight @ a90_mm**2)
        self._with_a90 = weighted @ a90_mm
        self._of_pods = weighted @ differences.T
        self._of_luck = (pods * (1.0 - pods)) @ curves.weight
        self._of_a90_now = self._of_a90
        self._excess_now = min(excess, WIDEST)

    @property
    def excess(self) -> float:
        """The expected width over the wanted one."""
        return float(self._excess_now * np.sqrt(self._of_a90 / self._of_a90_now))

    def best(self) -> int:
        """Return the size of the damage that would narrow the interval most."""
        of_outcomes = np.diagonal(self._of_pods) + self._of_luck
        return int(np.argmax(self._with_a90**2 / of_outcomes))

    def add(self, candidate: int) -> None:
        """Add a damage of this size."""
        of_outcome = self._of_pods[candidate, candidate] + self._of_luck[candidate]
        slopes = self._of_pods[candidate] / of_outcome
        with_a90 = self._with_a90[candidate]
        self._of_a90 -= with_a90**2 / of_outcome
        self._with_a90 = self._with_a90 - slopes * with_a90
        self._of_pods = self._of_pods - np.outer(slopes, self._of_pods[candidate])


def even_candidate(number: int) -> int:
    """Return candidate ``number`` of those that are spread evenly over the range in any run of
    consecutive numbers (multiples of the golden section; Weyl 1916)."""
    golden = (np.sqrt(5.0) - 1.0) / 2.0
    return int(number * golden % 1.0 * CANDIDATES)
