"""Sizes over clusters of targets, such as boards: the average over models of `averaged`, in which
the curves of clusters are shifted against each other.

On one cluster POD(a) = F((x - mu - shift) / s) with x = a or ln a, and shifts are normal, one for
each cluster. The curve over clusters is the mean over shifts, and a size with a POD is where that
curve has it. A cluster's likelihood is the mean over shifts of the product over its targets. The
curves over clusters, by middle and width, have the weights that `averaged` gives to curves; the
share of shifts in their variance has an even weight from 0 to 1. So few clusters, which hardly
tell the share, make wide intervals, and many clusters that differ make the wider the more they do:
an estimated design effect is too small just where the estimated a90 is.

An interval leaves 2.5 % of the weight beyond each of its ends, and the bound the same tail as that
without clusters; nothing else is calibrated, and ``tofpod audit`` measures how often they cover.
Not modelled: clusters that differ in the width of their curves; shifts that are not normal."""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy import optimize

from harness.evaluation.intervals import UPPER, Interval
from harness.evaluation.pod.averaged import (
    CONFIDENCE,
    NARROWEST,
    WIDEST,
    ModelAverage,
    log_weights,
    weighted_quantile,
)
from harness.evaluation.pod.curve import CELLS, Bound, link_cdf, link_ppf, log_likelihoods
from harness.evaluation.pod.hit_miss import HitMissFit

METHOD = "average over models and clusters"
DEVIATIONS = {
    "logit": np.pi / np.sqrt(3.0),
    "probit": 1.0,
    "cloglog": np.pi / np.sqrt(6.0),
    "loglog": np.pi / np.sqrt(6.0),
}
"""Standard deviation of the distribution F of each link."""
RATIO = 1.3
"""Ratio of neighbouring widths. A curve over clusters is wider than those on clusters by
RATIO^k, so that both lie on one grid."""
STEPS = 7  # values of k from 0: shares of shifts in the variance of 0 to 96 %
MIDDLES = 40
REACH = 2.5  # standard deviations of shifts to which clusters' middles are computed
FARTHEST = 150  # most middles beyond either end
WIDER_MIDDLES = 2.0  # clusters that differ add to the variances of middle and width
WIDER_WIDTHS = 1.5
LEAST = 0.3  # middles' spacings: shifts with a smaller deviation count as none
SHIFTS = np.linspace(-6.0, 6.0, 601)  # in standard deviations, for curves over clusters
SHARES = 1.0 - RATIO ** (-2.0 * np.arange(STEPS))


@dataclass(frozen=True, eq=False)
class _Curves:
    """Curves over clusters of one model, each with its weight."""

    fit: HitMissFit
    """The model."""
    mu: np.ndarray
    """Middle (m,) of the predictor, in standardised sizes."""
    sigma: np.ndarray
    """Width (m,), likewise, as if clusters did not differ."""
    step: np.ndarray
    """Number (m,) of the share of shifts."""
    log_weight: np.ndarray
    """Logarithm (m,) of the weight."""

    def sizes_at(self, pod: float) -> np.ndarray:
        """Return the size (m,) with this POD over clusters."""
        link = self.fit.curve.link
        levels = np.array([_level(link, pod, step) for step in range(STEPS)])
        z = self.mu + self.sigma * levels[self.step]
        x = self.fit.centre + self.fit.spread * z
        if not self.fit.curve.log_size:
            return np.asarray(x)
        with np.errstate(over="ignore"):
            return np.asarray(np.exp(x))


@dataclass(frozen=True, eq=False)
class ClusterAverage:
    """The average over the models of ``average`` and over how much clusters differ."""

    average: ModelAverage
    """The average without clusters."""
    cluster: np.ndarray
    """Number (n,) of the cluster of each row that was fitted. A single cluster counts as none."""
    effect: float = 1.0
    """Further factor of the variance; it divides the log-likelihoods."""

    @cached_property
    def _models(self) -> list[_Curves]:
        numbers = range(len(self.average.fits))
        return [_curves_of(self.average, number, self.cluster, self.effect) for number in numbers]

    @cached_property
    def _weight(self) -> np.ndarray:
        """The weights (m,) of all models' curves; their sum is 1."""
        logs = np.concatenate([curves.log_weight for curves in self._models])
        weight = np.exp(logs - logs.max())
        return np.asarray(weight / weight.sum())

    def quantile(self, pod: float, share: float) -> float:
        """Return the size below which this share of the weight of sizes with this POD lies."""
        sizes = np.concatenate([curves.sizes_at(pod) for curves in self._models])
        return weighted_quantile(sizes, self._weight, share)

    def interval(self, pod: float) -> Interval:
        """Return the central 95 % interval of the size with this POD, which contains that of the
        first model's curve; without an upper end where no bound is demonstrated."""
        low = self.quantile(pod, 1.0 - UPPER)
        high = self.quantile(pod, UPPER)
        if not self.average.bound(pod).demonstrated:
            high = float("inf")
        estimate = self.average.fits[0].curve.size_at(pod)
        return Interval(min(low, estimate), max(high, estimate))

    def bound(self, pod: float = 0.9) -> Bound:
        """Return the upper bound on the size with this POD, at least that without clusters."""
        without = self.average.bound(pod)
        if not without.demonstrated:
            return without
        value = self.quantile(pod, 1.0 - self.average.tail)
        return Bound(pod, CONFIDENCE, METHOD, max(value, without.value))


@cache
def _level(link: str, pod: float, step: int) -> float:
    """Return the predictor at which a curve over clusters has this POD, with the share of shifts
    ``step``, if its width is 1."""
    density = np.exp(-0.5 * SHIFTS**2)
    density /= density.sum()
    width = RATIO**-step
    shifts = DEVIATIONS[link] * np.sqrt(SHARES[step]) * SHIFTS

    def excess(predictor: float) -> float:
        pods = link_cdf(link, (predictor - shifts) / width)
        return float(density @ pods) - pod

    return float(optimize.brentq(excess, -50.0, 50.0))


def _curves_of(average: ModelAverage, number: int, cluster: np.ndarray, effect: float) -> _Curves:
    """Return the curves over clusters of model ``number`` that can matter."""
    fit = average.fits[number]
    link = fit.curve.link
    low, half, high = link_ppf(link, np.array([0.1, 0.5, 0.9]))
    middles, widths = _grid(average, number)
    spacing = middles[1] - middles[0]
    widths_on_clusters = widths[0] * RATIO ** np.arange(1.0 - STEPS, len(widths))
    farthest_shift = REACH * DEVIATIONS[link] * widths[-1] / (high - low)
    beyond = int(min(np.ceil(farthest_shift / spacing), FARTHEST))
    line = middles[0] + spacing * np.arange(-beyond, MIDDLES + beyond)
    of_clusters = _of_clusters(fit, cluster, line, widths_on_clusters) / effect
    highest = of_clusters.max(axis=2, keepdims=True)
    likelihoods = np.exp(of_clusters - highest)
    range_z = float(np.ptp(fit.data.z))
    log_even = log_weights(widths / range_z, max(fit.targets, 3))
    log_cell = np.log(spacing * np.log(RATIO) / range_z)
    mu = []
    sigma = []
    steps = []
    logs = []
    shares = _share_weights() if likelihoods.shape[1] > 1 else np.ones(1)
    for step, share in enumerate(shares):
        for place, width in enumerate(widths):
            on_clusters = place + STEPS - 1 - step
            width_of_f = width / (high - low)
            deviation = DEVIATIONS[link] * np.sqrt(SHARES[step]) * width_of_f
            mean = _over_shifts(likelihoods[on_clusters], line, beyond, deviation)
            with np.errstate(divide="ignore"):
                log_likelihood = np.log(mean).sum(axis=0) + highest[on_clusters].sum()
            logs.append(log_likelihood + log_even[place] + np.log(share) + log_cell)
            mu.append(middles - half * width_of_f * RATIO**-step)
            sigma.append(np.full(MIDDLES, width_of_f))
            steps.append(np.full(MIDDLES, step))
    return _Curves(
        fit=fit,
        mu=np.concatenate(mu),
        sigma=np.concatenate(sigma),
        step=np.concatenate(steps),
        log_weight=np.concatenate(logs),
    )


def _share_weights() -> np.ndarray:
    """Return the even weight (STEPS,) of each share of shifts, from 0 to 1."""
    ends = np.concatenate([[0.0], (SHARES[1:] + SHARES[:-1]) / 2, [1.0]])
    return np.asarray(np.diff(ends))


def _grid(average: ModelAverage, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return middles (`MIDDLES`,) and widths (w,) of the curves over clusters that can matter, in
    standardised sizes: those of the average without clusters, and farther out."""
    fit = average.fits[number]
    low, half, high = link_ppf(fit.curve.link, np.array([0.1, 0.5, 0.9]))
    chosen = average.curves.model == number
    sigma = average.curves.sigma[chosen] / fit.spread
    middle = (average.curves.mu[chosen] - fit.centre) / fit.spread + half * sigma
    log_width = np.log(sigma * (high - low))
    z = fit.data.z
    range_z = float(np.ptp(z))
    first, last = _stretched(middle, WIDER_MIDDLES)
    middles = np.linspace(max(first, z.min() - range_z), min(last, z.max() + range_z), MIDDLES)
    narrowest, widest = _stretched(log_width, WIDER_WIDTHS)
    narrowest = max(narrowest, np.log(range_z * min(NARROWEST / max(fit.targets - 1, 2), 1.0)))
    widest = min(widest, np.log(WIDEST * range_z))
    widths = np.exp(np.arange(narrowest, widest + np.log(RATIO), np.log(RATIO)))
    return middles, widths


def _stretched(values: np.ndarray, factor: float) -> tuple[float, float]:
    """Return the ends of values, farther from their middle by this factor."""
    middle = (values.min() + values.max()) / 2
    half_range = factor * (values.max() - values.min()) / 2
    return float(middle - half_range), float(middle + half_range)


def _of_clusters(
    fit: HitMissFit, cluster: np.ndarray, middles: np.ndarray, widths: np.ndarray
) -> np.ndarray:
    """Return the log-likelihoods (widths, clusters, middles) of curves on each cluster, per
    target."""
    low, half, high = link_ppf(fit.curve.link, np.array([0.1, 0.5, 0.9]))
    z = fit.data.z
    rows, row = np.unique(np.column_stack([cluster, z]), axis=0, return_inverse=True)
    hits = np.bincount(row, fit.data.hits) / fit.repeats
    misses = np.bincount(row, fit.data.misses) / fit.repeats
    _, starts = np.unique(rows[:, 0], return_index=True)
    values = np.empty((len(widths), len(starts), len(middles)))
    block = max(1, CELLS // len(rows))
    for first in range(0, len(middles), block):
        part = slice(first, first + block)
        distances = (high - low) * (rows[:, 1:] - middles[part])
        for number, width in enumerate(widths):
            predictor = half + distances / width
            of_rows = log_likelihoods(fit.curve.link, predictor, hits, misses)
            values[number, :, part] = np.add.reduceat(of_rows, starts)
    return values


def _over_shifts(
    likelihoods: np.ndarray, line: np.ndarray, beyond: int, deviation: float
) -> np.ndarray:
    """Return the means (clusters, m) of likelihoods (clusters, line) over normal shifts with this
    deviation, about the middles of the ``line`` that are not ``beyond`` them."""
    inner = slice(beyond, beyond + MIDDLES)
    spacing = line[1] - line[0]
    if deviation < LEAST * spacing:
        return likelihoods[:, inner]
    kernel = np.exp(-0.5 * ((line - line[inner, None]) / deviation) ** 2)
    kernel /= kernel.sum(axis=1, keepdims=True)
    return np.asarray(likelihoods @ kernel.T)
