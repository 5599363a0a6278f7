"""The bound a90/95 over the models of hits and misses that fit about equally well: a weighted
average instead of the largest of their bounds.

Each model's curves POD(a) = F(t), with x = a or ln a, are weighted by their likelihood and by a
weight that all models share. It is even in the middle of a curve, up to one range of the sizes
outside them, and in the logarithm of its width, the distance from 10 to 90 %, between `NARROWEST`
mean spacings of the sizes and their range; beyond the range it falls as width^-2. (For location
and scale, these are the weights whose quantiles cover as stated: Datta and Ghosh, JASA 90 (1995),
1357.) The spacing matters where hits and misses do not overlap: such data do not bound a curve's
steepness. The bound is the size at which the weight of curves with a larger a90 falls to a tail.

The tail is calibrated (C): by the number of targets, it is the largest with which the bound
covers the true a90 in at least 97 % of simulated studies on average over 20 curves, steep and
flat, and in 90 % for every curve (``tests/validation/pod_levels.py``, which also measures curves
and sizes that set nothing). Not modelled: a curve with floor or ceiling; a width above the range
of the sizes is covered less often."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from harness.evaluation.pod.curve import CELLS, Bound, link_cdf, link_ppf
from harness.evaluation.pod.hit_miss import HitMissFit, criterion

METHOD = "average over models"
CONFIDENCE = 0.95
NARROWEST = 4.0  # mean spacings of the sizes
WIDEST = 8.0  # ranges of the sizes
BEYOND = 2.0  # power by which the weight falls with widths above the range
TAILS = {
    10: 0.15,
    15: 0.12,
    20: 0.12,
    30: 0.05,
    40: 0.035,
    60: 0.025,
    100: 0.02,
}
"""Tail by number of targets; in between, linear in the logarithm of the number."""
MIDDLES = 40
WIDTHS = 32
ZOOMS = 5  # most grids, each narrowed to the curves that matter in the one before
NARROW = 0.5  # largest share of a grid that the next covers; above it, the grid is kept
NEGLIGIBLE = 12.0  # curves are left out whose weight is below exp(-12) of the largest


@dataclass(frozen=True, eq=False)
class WeightedCurves:
    """Curves of several models, each with its weight."""

    links: tuple[str, ...]
    """Link of each model."""
    log_sizes: tuple[bool, ...]
    """Whether x is the logarithm of the size, for each model."""
    model: np.ndarray
    """Number (m,) of each curve's model."""
    mu: np.ndarray
    """Middle (m,) of the predictor, t = (x - mu) / sigma."""
    sigma: np.ndarray
    """Width (m,) of the predictor."""
    weight: np.ndarray
    """Weight (m,); their sum is 1."""

    def sizes_at(self, pod: float) -> np.ndarray:
        """Return the size (m,) with this POD on each curve."""
        sizes = np.empty(len(self.mu))
        for number, link in enumerate(self.links):
            chosen = self.model == number
            level = float(link_ppf(link, np.array(pod)))
            x = self.mu[chosen] + self.sigma[chosen] * level
            with np.errstate(over="ignore"):
                sizes[chosen] = np.exp(x) if self.log_sizes[number] else x
        return sizes

    def pods(self, size: float) -> np.ndarray:
        """Return the POD (m,) at a size above 0 on each curve."""
        pods = np.empty(len(self.mu))
        for number, link in enumerate(self.links):
            chosen = self.model == number
            x = np.log(size) if self.log_sizes[number] else size
            pods[chosen] = link_cdf(link, (x - self.mu[chosen]) / self.sigma[chosen])
        return pods


@dataclass(frozen=True, eq=False)
class ModelAverage:
    """The curves of models that were fitted to the same hits."""

    fits: Sequence[HitMissFit]
    """The models."""

    @cached_property
    def curves(self) -> WeightedCurves:
        """The curves whose weight is not negligible."""
        grids = [_narrowed(fit) for fit in self.fits]
        largest = max(float(log_weight.max()) for _, _, log_weight in grids)
        models = []
        kept_mu = []
        kept_sigma = []
        weights = []
        for number, (mu, sigma, log_weight) in enumerate(grids):
            kept = log_weight > largest - NEGLIGIBLE
            models.append(np.full(int(kept.sum()), number))
            kept_mu.append(mu[kept])
            kept_sigma.append(sigma[kept])
            weights.append(np.exp(log_weight[kept] - largest))
        weight = np.concatenate(weights)
        return WeightedCurves(
            links=tuple(fit.curve.link for fit in self.fits),
            log_sizes=tuple(fit.curve.log_size for fit in self.fits),
            model=np.concatenate(models),
            mu=np.concatenate(kept_mu),
            sigma=np.concatenate(kept_sigma),
            weight=weight / weight.sum(),
        )

    @property
    def tail(self) -> float:
        """The weight beyond the bound."""
        return tail_of(self.fits[0].targets)

    def bound(self, pod: float = 0.9) -> Bound:
        """Return the upper bound on the size with this POD, at least that of the first model's
        curve; infinite, with the reason, where a constant probability is not rejected."""
        why = self._constant()
        if why:
            return Bound(pod, CONFIDENCE, METHOD, float("inf"), f"not demonstrated: {why}")
        sizes = self.curves.sizes_at(pod)
        value = weighted_quantile(sizes, self.curves.weight, 1.0 - self.tail)
        value = max(value, self.fits[0].curve.size_at(pod))
        return Bound(pod, CONFIDENCE, METHOD, value)

    def band(self, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper POD at ``sizes`` (n,), each one-sided as in `bound`: a curve's
        POD at a size is below 90 % where its a90 is larger, so that the lower edge crosses 90 % at
        a90/95."""
        edges = np.empty((2, len(sizes)))
        shares = [self.tail, 1.0 - self.tail]
        order = np.arange(len(self.curves.weight))
        for number, size in enumerate(np.maximum(sizes, np.finfo(float).tiny)):
            pods = self.curves.pods(float(size))
            # nearly sorted as at the size before, which takes a fifth of the time to sort
            order = order[np.argsort(pods[order], kind="stable")]
            edges[:, number] = _quantiles_in(order, pods, self.curves.weight, shares)
        return edges[0], edges[1]

    def _constant(self) -> str:
        """Return why a constant probability is not rejected; empty if it is."""
        fit = min(self.fits, key=lambda fit: fit.deviance)
        ratio = (fit.null_deviance - fit.deviance) / fit.repeats
        allowed = criterion(CONFIDENCE)
        if ratio > allowed:
            return ""
        numbers = f"ratio {ratio:.2f} <= {allowed:.2f}"
        return f"a constant probability is not rejected ({numbers})"


def tail_of(targets: int) -> float:
    """Return the calibrated tail for a number of targets."""
    numbers = np.log(list(TAILS))
    return float(np.interp(np.log(targets), numbers, list(TAILS.values())))


def weighted_quantile(values: np.ndarray, weight: np.ndarray, share: float) -> float:
    """Return the value below which this share of the weight (n,) lies, whose sum is 1."""
    return float(weighted_quantiles(values, weight, [share])[0])


def weighted_quantiles(
    values: np.ndarray,
    weight: np.ndarray,
    shares: Sequence[float],
) -> np.ndarray:
    """Return the values (s,) below which these shares of the weight (n,) lie, whose sum is 1."""
    order = np.argsort(values, kind="stable")
    return _quantiles_in(order, values, weight, shares)


def _quantiles_in(
    order: np.ndarray, values: np.ndarray, weight: np.ndarray, shares: Sequence[float]
) -> np.ndarray:
    """Return `weighted_quantiles` of values (n,) whose ascending order (n,) is known."""
    sorted_weight = weight[order]
    below = np.cumsum(sorted_weight) - sorted_weight / 2
    return np.asarray(np.interp(shares, below, values[order]))


def log_weights(width: np.ndarray, targets: int) -> np.ndarray:
    """Return the logarithm of the weight that all models share, per unit of the middle and of the
    logarithm of the ``width``, a multiple of the sizes' range."""
    narrowest = min(NARROWEST / (targets - 1), 1.0)
    inside = np.where(width < narrowest * (1 - 1e-9), -np.inf, 0.0)
    return np.asarray(inside - BEYOND * np.log(np.maximum(width, 1.0)))


def curves_of(link: str, middle: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mu and sigma of curves with this ``middle``, where POD is 50 %, and ``width`` from
    10 to 90 %."""
    low, half, high = link_ppf(link, np.array([0.1, 0.5, 0.9]))
    sigma = width / (high - low)
    return middle - sigma * half, sigma


def _narrowed(fit: HitMissFit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mu, sigma and the logarithm of the weight of a model's curves on a grid that covers
    those that matter."""
    z = fit.data.z
    range_z = float(np.ptp(z))
    targets = max(fit.targets, 3)
    least = np.log(min(NARROWEST / (targets - 1), 1.0))
    middle_ends = np.array([z.min() - range_z, z.max() + range_z])
    width_ends = np.array([least, np.log(WIDEST)])
    for _ in range(ZOOMS):
        middles = np.linspace(middle_ends[0], middle_ends[1], MIDDLES)
        log_widths = np.linspace(width_ends[0], width_ends[1], WIDTHS)
        middle_grid, log_width_grid = np.meshgrid(middles, log_widths)
        middle = middle_grid.ravel()
        log_width = log_width_grid.ravel()
        width = np.exp(log_width)
        mu, sigma = curves_of(fit.curve.link, middle, width * range_z)
        log_likelihood = _log_likelihoods(fit, mu, sigma) / fit.repeats
        log_weight = log_likelihood + log_weights(width, targets)
        matters = log_weight > log_weight.max() - NEGLIGIBLE
        narrower_middle = _ends_of(middle[matters], middles)
        narrower_width = _ends_of(log_width[matters], log_widths)
        area = np.ptp(middle_ends) * np.ptp(width_ends)
        if np.ptp(narrower_middle) * np.ptp(narrower_width) > NARROW * area:
            break
        middle_ends = narrower_middle
        width_ends = narrower_width
    # each curve stands for a cell of the grid
    log_cell = np.log(middles[1] - middles[0]) + np.log(log_widths[1] - log_widths[0])
    log_cell -= np.log(range_z)
    return fit.centre + fit.spread * mu, fit.spread * sigma, log_weight + log_cell


def _log_likelihoods(fit: HitMissFit, mu: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return the log-likelihoods (m,) of curves in standardised sizes."""
    coefficients = np.stack([-mu / sigma, 1.0 / sigma], axis=-1)
    data = replace(fit.data, penalty=None)
    block = max(1, CELLS // len(data.z))
    values = []
    for first in range(0, len(mu), block):
        values.append(data.value(coefficients[first : first + block]))
    return np.concatenate(values)


def _ends_of(values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return the ends (2,) of ``values``, one step of the ``grid`` farther out if it has one."""
    step = grid[1] - grid[0]
    low = max(float(values.min()) - step, float(grid[0]))
    high = min(float(values.max()) + step, float(grid[-1]))
    return np.array([low, high])
