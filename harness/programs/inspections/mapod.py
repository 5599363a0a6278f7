"""Model-assisted probability of detection (MAPOD): a simulated curve, corrected by real hits and
misses.

The transfer function says that real damage of size a is found as easily as simulated damage of
size a / k, and that the curve's rise is w times as wide. Prior: ln k and ln w have a bivariate
Student distribution about 0 with `FREEDOM` degrees of freedom. Its heavy tails let data that
contradict the simulation overrule it (O'Hagan and Pericchi, Brazilian J. Probability and
Statistics 26 (2012), 372); its scale matrix includes the simulated curve's own covariance. Real
targets differ in more ways than simulated ones, so w < 1 is allowed only within the study's own
uncertainty. Posterior: prior times the likelihood of the real hits and misses, on a grid; the
limit is the largest over all models of the simulated curve that fit about equally well. Sources:
MIL-HDBK-1823A, appendix H; Thompson et al., Review of Progress in QNDE 28 (2009), 1685. If
simulations are wrong by factors of 1 to 2 in size and 0.6 to 1.6 in width, and 24 holes correct
them, the limit covers the true a90 in 98 to 100 % of 300 campaigns (``tests/validation``).

Not modelled: a floor or a ceiling of real inspections, real targets that share a part. The test of
agreement looks for other errors of the simulation."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import stats

from harness.evaluation.pod.curve import CELLS, PodCurve, link_ppf, logs_of_link
from harness.evaluation.pod.hit_miss import criterion
from harness.evaluation.pod.inspections import Inspections
from harness.evaluation.pod.statement import CONFIDENCE, POD, PodStatement, drawn_sizes, state_hits
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import jsonable
from harness.vocabulary.seeds import random_stream

FREEDOM = 3.0
PRIOR_SIZE = 1.5  # factor by which a simulation may well be wrong in size
PRIOR_WIDTH = 2.0  # factor by which it may well be wrong in the width of the rise
# half the grid's side in scales, and its nodes along ln k and ln w
REACH = 8.0
NODES = (241, 61)
# simulated campaigns for the p-values of the tests of agreement: 5 % is then known to 0.7 %
DRAWS = 999
# stop rule: ratio of a90/95 to a90 at which no further board can lower a90/95 by more than this
# factor
ENOUGH = 1.2
# 0.975: the quantile at which the handbook's likelihood ratio has its bound
LIMIT_AT = float(stats.norm.cdf(np.sqrt(criterion(CONFIDENCE))))


@dataclass(frozen=True)
class BoardStep:
    """The estimates after some boards; sizes are in the curve's unit."""

    board: str
    """The last board; none before the first."""
    targets: int
    hits: int
    a50: float
    """Posterior median."""
    a90: float
    """Posterior median."""
    a90_95: float
    """Posterior quantile `LIMIT_AT` of a90."""

    @property
    def enough(self) -> bool:
        """Return whether the stop rule holds: further boards would hardly lower the limit."""
        return self.a90_95 <= ENOUGH * self.a90


@dataclass(frozen=True, eq=False)
class Transfer:
    """A simulated curve, and real inspections that correct it."""

    curve: PodCurve
    size: np.ndarray
    """Sizes (n,) of the real targets in the curve's unit."""
    hit: np.ndarray
    """Which targets were found, (n,) bool."""
    board: np.ndarray
    """Names (n,) of the targets' boards."""

    @cached_property
    def own_covariance(self) -> np.ndarray:
        """The covariance (2, 2) of the simulated curve's ln a50 and ln w, from that of mu, sigma
        (delta method)."""
        curve = self.curve
        half = float(link_ppf(self.curve.link, np.array(0.5)))
        middle = curve.mu + half * curve.sigma
        slopes = np.array([[1.0, half], [0.0, 1.0 / curve.sigma]])
        if not curve.log_size:
            slopes = np.array([[1.0, half], [-1.0, 1.0 / curve.sigma * middle - half]]) / middle
        return np.asarray(slopes @ curve.covariance @ slopes.T)

    @cached_property
    def scale(self) -> np.ndarray:
        """The scale matrix (2, 2) of the prior of ln k and ln w."""
        return np.diag([np.log(PRIOR_SIZE) ** 2, np.log(PRIOR_WIDTH) ** 2]) + self.own_covariance

    @cached_property
    def grid(self) -> np.ndarray:
        """The nodes (g, 2) of ln k and ln w."""
        log_k_end, log_w_end = REACH * np.sqrt(np.diag(self.scale))
        log_k = np.linspace(-log_k_end, log_k_end, NODES[0])
        log_w = np.linspace(-log_w_end, log_w_end, NODES[1])
        all_log_k, all_log_w = np.meshgrid(log_k, log_w, indexing="ij")
        return np.stack([all_log_k.ravel(), all_log_w.ravel()], axis=1)

    @cached_property
    def logs(self) -> tuple[np.ndarray, np.ndarray]:
        """The logarithms (g, n) of POD and of 1 - POD for each target at each node."""
        return self._logs(self.grid, self.size)

    def _logs(self, nodes: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        half = float(link_ppf(self.curve.link, np.array(0.5)))
        scaled = np.log if self.curve.log_size else np.positive
        k, w = np.exp(nodes.T)[..., None]
        above = scaled(sizes / k) - scaled(self.curve.size_at(0.5))
        log_hit, missed, _ = logs_of_link(self.curve.link, half + above / (self.curve.sigma * w))
        return log_hit, missed

    def sizes_at(self, pod: float) -> np.ndarray:
        """Return the size (g,) with this POD at each node."""
        link = self.curve.link
        shift = float(link_ppf(link, np.array(pod)) - link_ppf(link, np.array(0.5)))
        k, w = np.exp(self.grid.T)
        middle = self.curve.size_at(0.5)
        if self.curve.log_size:
            with np.errstate(over="ignore"):
                return np.asarray(k * middle * np.exp(self.curve.sigma * w * shift))
        return np.asarray(k * np.maximum(middle + self.curve.sigma * w * shift, 0.0))

    @cached_property
    def own_spread(self) -> np.ndarray:
        """The covariance (2, 2) of ln k and ln w from the study's own uncertainty and the distance
        of the nodes."""
        return self.own_covariance + np.diag(np.diff(self.grid, axis=0).max(axis=0) ** 2 / 12)

    @cached_property
    def log_prior(self) -> np.ndarray:
        """The logarithms (g,) of the nodes' weights before any real inspection, minus a
        constant."""
        steeper = stats.norm.logcdf(self.grid[:, 1] / np.sqrt(self.own_spread[1, 1]))
        student = stats.multivariate_t(np.zeros(2), self.scale, df=FREEDOM)
        return np.asarray(student.logpdf(self.grid) + steeper)

    def posterior(self, rows: np.ndarray) -> np.ndarray:
        """Return the weights (g,) of the nodes after the inspections ``rows`` (n,) bool; their sum
        is 1."""
        log_hit, missed = self.logs
        value = log_hit @ (rows & self.hit) + missed @ (rows & ~self.hit) + self.log_prior
        weight = np.exp(value - value.max())
        return np.asarray(weight / weight.sum())

    def steps(self) -> tuple[BoardStep, ...]:
        """Return the estimates before any board and after each, in the order of the rows."""
        steps = []
        is_used = np.zeros(len(self.size), bool)
        for board in ("none", *dict.fromkeys(self.board.tolist())):
            is_used = is_used | (self.board == board)
            weight = self.posterior(is_used)
            a90 = self.sizes_at(POD)
            step = BoardStep(
                board=board,
                targets=int(is_used.sum()),
                hits=int(self.hit[is_used].sum()),
                a50=quantile(self.sizes_at(0.5), weight, 0.5),
                a90=quantile(a90, weight, 0.5),
                a90_95=quantile(a90, weight, LIMIT_AT),
            )
            steps.append(step)
        return tuple(steps)

    def band(self, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the posterior's median POD at ``sizes`` (m,), and its quantiles 1 - `LIMIT_AT`
        and `LIMIT_AT`."""
        weight = self.posterior(np.ones(len(self.size), bool))
        kept = weight > weight.max() * 1e-6
        columns = np.exp(self._logs(self.grid[kept], sizes)[0]).T

        def quantiles(share: float) -> np.ndarray:
            return np.array([quantile(column, weight[kept], share) for column in columns])

        return quantiles(0.5), quantiles(1 - LIMIT_AT), quantiles(LIMIT_AT)

    def agreement(self, seed: int = 1) -> float:
        """Return the probability, if the simulated curve is right, of real hits and misses at
        least as far from it as these. The statistic is the largest likelihood over the grid
        divided by the mean likelihood over the curves that the study's own uncertainty allows; its
        distribution is simulated at the same sizes."""
        log_hit, missed = self.logs
        weight = stats.multivariate_normal(np.zeros(2), self.own_spread).pdf(self.grid)
        weight /= weight.sum()
        stream = random_stream(seed, "agreement", len(self.size))
        nodes = stream.choice(len(weight), DRAWS, p=weight)
        simulated_hits = stream.random((DRAWS, len(self.size))) < np.exp(log_hit[nodes])
        campaigns = np.vstack([self.hit, simulated_hits])
        statistic = []
        blocks = -(-len(campaigns) * len(weight) // (CELLS * 256))  # bounds the memory
        for block in np.array_split(campaigns, blocks):
            value = block @ log_hit.T + ~block @ missed.T
            relative = np.exp(value - value.max(axis=1, keepdims=True))
            statistic.append(-np.log(relative @ weight))
        values = np.concatenate(statistic)
        is_as_far = values[1:] >= values[0] - 1e-9
        return float((1 + is_as_far.sum()) / (1 + DRAWS))


def quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """Return the interpolated value at which the cumulated weights (n,) of values (n,) reach a
    share of their sum."""
    order = np.argsort(values, kind="stable")
    sorted_weights = weights[order]
    below = np.cumsum(sorted_weights) - sorted_weights / 2
    return float(np.interp(share * sorted_weights.sum(), below, values[order]))


DISAGREES = 0.05  # probability of agreement below which the real hits contradict the simulation


@dataclass(frozen=True, eq=False)
class Mapod:
    """A study's curve, real hits and misses, and the combination of both."""

    set_up: str
    """Name of the set-up in the study."""
    simulated: PodStatement
    """The study's curve."""
    read: Inspections
    """The real hits and misses."""
    measured: PodStatement | None
    """The curve of the real hits and misses alone; None if no curve fits them."""
    why: str
    """Why no curve fits the real hits and misses; empty if one does."""
    transfers: tuple[Transfer, ...]
    """Corrections of all simulated models that fit about equally well."""
    steps: tuple[BoardStep, ...]
    """Estimates before any board and after each; limits are the largest over ``transfers``."""
    agrees: float
    """Probability as in `Transfer.agreement`."""
    unlike: str
    """How the counting of the real hits differs from the study's, or that this is unknown; empty
    if they agree."""

    @classmethod
    def of(
        cls,
        set_up: str,
        simulated: PodStatement | None,
        why: str,
        read: Inspections,
        boards: np.ndarray | None = None,
        unlike: str = "",
    ) -> Mapod:
        """Correct a study's curve. Raises UserError if the study has no curve, with the reason
        ``why``."""
        if simulated is None:
            problem = f"set-up {set_up} has no curve to correct: {why}"
            raise UserError(problem, fix="name another set-up with --set-up")
        measured = None
        no_measured_curve = ""
        try:
            measured = state_hits(read, unit="mm", tested=False)
        except UserError as error:
            no_measured_curve = error.message
        names = np.full(len(read.size), "all") if boards is None else boards
        curves = [fit.curve for fit in simulated.fits if fit.curve.size_at(0.5) > 0]
        if not curves:
            raise UserError("the simulated curve's a50 is not above 0: its sizes cannot be scaled")
        transfers = tuple(Transfer(curve, read.size, read.response == 1, names) for curve in curves)
        steps = []
        for same_board in zip(*(transfer.steps() for transfer in transfers), strict=True):
            largest = max(step.a90_95 for step in same_board)
            steps.append(replace(same_board[0], a90_95=largest))
        return cls(
            set_up=set_up,
            simulated=simulated,
            read=read,
            measured=measured,
            why=no_measured_curve,
            transfers=transfers,
            steps=tuple(steps),
            agrees=transfers[0].agreement(),
            unlike=unlike,
        )

    @property
    def contradicted(self) -> bool:
        """Return whether the real hits and misses contradict the simulated curve."""
        return self.agrees < DISAGREES

    @property
    def a90_95(self) -> float:
        """The combined limit; if the simulation is contradicted, at least the measured one, which
        may be infinite."""
        combined = self.steps[-1].a90_95
        if not self.contradicted:
            return combined
        if self.measured is None:
            return float("inf")
        return max(combined, self.measured.bound.value)

    @cached_property
    def sizes(self) -> np.ndarray:
        """Sizes at which the curves are drawn."""
        sizes = np.append(self.read.size, self.simulated.sizes[[0, -1]])
        return drawn_sizes(sizes, self.simulated.curve.log_size, ())

    @cached_property
    def band(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The combined curve at ``sizes``, and the widest band over the simulated models."""
        bands = [transfer.band(self.sizes) for transfer in self.transfers]
        middle, _, _ = bands[0]
        low = np.min([low for _, low, _ in bands], axis=0)
        high = np.max([high for _, _, high in bands], axis=0)
        return middle, low, high

    def to_data(self) -> dict[str, Any]:
        """Return the statement as JSON's types; an infinite size becomes None."""
        middle, low, high = self.band
        combined = {"size": self.sizes, "pod": middle, "low": low, "high": high}
        data = {
            "set_up": self.set_up,
            "file": self.read.path.as_posix(),
            "prior": {"size": PRIOR_SIZE, "width": PRIOR_WIDTH, "freedom": FREEDOM},
            "simulated": self.simulated.to_data(),
            "measured": None if self.measured is None else self.measured.to_data(),
            "no_measured_curve": self.why,
            "after_each_board": [{**asdict(step), "enough": step.enough} for step in self.steps],
            "p_simulation_right": self.agrees,
            "counted_otherwise": self.unlike,
            "a90_95": self.a90_95,
            "combined": combined,
        }
        return dict(jsonable(data))
