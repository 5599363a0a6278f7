"""The tail of noise: how often its peaks exceed a threshold, and the false calls that follow.

The tail is exponential in (s^q - 1) / q of the score s, minus the logarithm by which maxima of
normal noise in two dimensions are more frequent. The data weigh the exponents q, starting from
`PRIOR`; rates and scales are integrated out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

EXPONENTS = np.array([3.0, 2.0, 1.5, 1.0, 0.5, 0.0])
PRIOR = np.array([0.40, 0.45, 0.07, 0.04, 0.02, 0.02])
"""Prior weights of exponents: averages of a camera's noise are near normal. From simulated boards
of three cameras."""
NORMAL_PEAKS = 10.0
"""Weight of the theory, in peaks: maxima of normal noise with the deviation that a unit of score
is meant to be. Ten peaks show that deviation to 16 %; robust scales of heavy-tailed noise err by
as much."""
DRAWS = 4000  # of the interval
TAIL_SHARE = 0.025  # probability of fewer false calls than its lower end; as much lies above
HALVINGS = 48  # of the interval that holds a threshold: to rounding error


@dataclass(frozen=True)
class Tail:
    """The law by which noise exceeds a threshold, from its peaks above a floor."""

    floor: float
    """Units of score."""
    peaks: int
    """Number of peaks above it."""
    sums: np.ndarray
    """(e,): for each exponent, the sum of the peaks' transformed excesses, and the theory's."""
    weights: np.ndarray
    """(e,): of the exponents, which sum to 1."""
    theory: float = NORMAL_PEAKS
    """Weight of the theory of normal noise, in peaks."""
    area_ratio: float = 1.0
    """Area where calls are expected, over the area of the peaks."""
    scale: float = 1.0
    """Scores in the evidence over those of the peaks."""

    @property
    def number(self) -> float:
        """Expected number of calls above the floor; that of half a peak if there is none."""
        return max(self.peaks, 0.5) * self.area_ratio

    @property
    def facts(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "floor": self.floor,
            "peaks": self.peaks,
            "sums": self.sums.tolist(),
            "weights": self.weights.tolist(),
            "theory": self.theory,
            "area_ratio": self.area_ratio,
            "scale": self.scale,
        }

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any]) -> Tail:
        """Return the tail with these `facts`."""
        return cls(
            floor=facts["floor"],
            peaks=facts["peaks"],
            sums=np.array(facts["sums"]),
            weights=np.array(facts["weights"]),
            theory=facts["theory"],
            area_ratio=facts["area_ratio"],
            scale=facts["scale"],
        )

    @classmethod
    def of(cls, peaks: np.ndarray, floor: float, theory: float = NORMAL_PEAKS) -> Tail:
        """Weigh the exponents by the scores (n,) of the peaks above a floor, which is positive."""
        ratios = np.maximum(np.asarray(peaks, float) / floor, 1.0 + 1e-9)
        count = len(ratios)
        excesses = [_excess(ratios, exponent, floor).sum() for exponent in EXPONENTS]
        sums = theory + np.array(excesses)
        # the likelihood with the scale integrated out under its prior, a Gamma distribution
        slopes = ratios[:, None] ** (EXPONENTS - 1.0) - _crowd(floor) / ratios[:, None]
        log_slopes = np.log(slopes).sum(axis=0)
        log_likelihoods = log_slopes - (count + theory) * np.log(sums)
        log_weights = log_likelihoods + np.log(PRIOR)
        weights = np.exp(log_weights - log_weights.max())
        weights = weights / weights.sum()
        return cls(floor, count, sums, weights, theory)

    def _excesses(self, threshold: float) -> np.ndarray:
        """Return the excess (e,) of a threshold by each exponent."""
        ratio = np.array([threshold / (self.scale * self.floor)])
        return np.array([float(_excess(ratio, exponent, self.floor)[0]) for exponent in EXPONENTS])

    def expected(self, threshold: float) -> float:
        """Return the mean number of peaks above a threshold, over all rates and scales that the
        peaks allow."""
        beyond = 1.0 + self._excesses(threshold) / self.sums
        shares = beyond ** -(self.peaks + self.theory)
        return float((self.weights * self.number * shares).sum())

    def threshold(self, number: float) -> float:
        """Return the threshold at which this number of peaks is expected; the floor if fewer are
        expected there."""
        floor = self.scale * self.floor
        if number >= self.number:
            return floor

        return _falls_to(number, self.expected, floor)

    def laws(self, count: int) -> Laws:
        """Draw ``count`` laws that the peaks allow, the same ones every time."""
        random = np.random.default_rng(20201102)
        chosen = random.choice(len(EXPONENTS), count, p=self.weights)
        steepness = random.gamma(self.peaks + self.theory, 1.0, count)
        numbers = self.area_ratio * random.gamma(max(self.peaks, 0.5), 1.0, count)
        return Laws(
            floor=self.floor,
            exponents=EXPONENTS[chosen],
            numbers=numbers,
            rates=steepness / self.sums[chosen],
            scale=self.scale,
        )


@dataclass(frozen=True)
class Laws:
    """Laws that the peaks allow, drawn at random, each with one exponent."""

    floor: float
    """Units of score."""
    exponents: np.ndarray
    """(k,)."""
    numbers: np.ndarray
    """(k,): expected number of calls above the floor."""
    rates: np.ndarray
    """(k,): by which the logarithm of the number falls with the excess."""
    scale: float
    """Scores in the evidence over those of the law."""

    def expected(self, threshold: float) -> np.ndarray:
        """Return the expected number (k,) of calls above a threshold."""
        ratio = np.array([threshold / (self.scale * self.floor)])
        excesses = np.zeros(len(self.numbers))
        for exponent in EXPONENTS:
            excesses[self.exponents == exponent] = _excess(ratio, exponent, self.floor)[0]
        return self.numbers * np.exp(-self.rates * excesses)

    def densities(self, scores: np.ndarray) -> np.ndarray:
        """Return the expected number (k, n) of calls per unit of score, at scores (n,) above the
        floor."""
        floor = self.scale * self.floor
        ratios = scores / floor
        falls = np.zeros((len(self.numbers), len(scores)))
        for exponent in EXPONENTS:
            excess = _excess(ratios, exponent, self.floor)
            slope = self.floor * (ratios ** (exponent - 1.0) - _crowd(self.floor) / ratios)
            chosen = self.exponents == exponent
            rates = self.rates[chosen, None]
            falls[chosen] = rates * slope / self.scale * np.exp(-rates * excess)
        return self.numbers[:, None] * falls


def _excess(
    ratios: np.ndarray,
    exponent: float,
    floor: float,
) -> np.ndarray:
    """Return how far scores, as ratios (n,) to the floor, lie above it, in factors of e by which
    peaks become fewer.

    The exponent 2 is that of normal noise, whose maxima in two dimensions fall as s exp(-s^2 / 2)
    (Adler 1981)."""
    power = np.log(ratios) if exponent == 0.0 else (ratios**exponent - 1.0) / exponent
    return floor**2 * (power - _crowd(floor) * np.log(ratios))


def _crowd(floor: float) -> float:
    """Return the logarithmic part of the excess; at most half of it for low floors, where that law
    does not hold."""
    return min(floor**-2.0, 0.5)


# --- several tails together ---


def calls_at(tails: Mapping[str, Tail], threshold: float) -> float:
    """Return the number of false calls that all laws together expect above a threshold, on both
    sides of the surface."""
    return 2.0 * sum(tail.expected(threshold) for tail in tails.values())


def threshold_at(tails: Mapping[str, Tail], calls: float, least: float) -> float:
    """Return the threshold, at least ``least``, above which all laws together expect so many false
    calls (above 0), on both sides of the surface."""
    if calls_at(tails, least) <= calls:
        return least
    return _falls_to(calls, lambda threshold: calls_at(tails, threshold), least)


def _falls_to(number: float, expected: Callable[[float], float], least: float) -> float:
    """Return the threshold above ``least`` (above 0) at which a falling expectation is this
    number."""
    low = least
    high = 2.0 * least
    while expected(high) > number:
        low = high
        high *= 2.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if expected(middle) > number:
            low = middle
        else:
            high = middle
    return low


def counts_of(tails: Mapping[str, Tail], threshold: float) -> tuple[float, float]:
    """Return the fewest and the most false calls of the central 95 % of their number above a
    threshold, on both sides of the surface and by all laws together.

    The number is Poisson, with the expectation of each of `DRAWS` laws that the peaks allow. So it
    contains that the law is uncertain and that calls come by chance."""
    expected = np.zeros(DRAWS)
    for tail in tails.values():
        expected += 2.0 * tail.laws(DRAWS).expected(threshold)
    return _count_reaching(TAIL_SHARE, expected), _count_reaching(1.0 - TAIL_SHARE, expected)


def _count_reaching(share: float, expected: np.ndarray) -> float:
    """Return the smallest count that a Poisson number, with one of equally likely expectations
    (k,), does not exceed with a probability of at least ``share``."""
    low = -1
    high = 1
    while special.pdtr(high, expected).mean() < share:
        low = high
        high *= 2
    while high - low > 1:
        middle = (low + high) // 2
        if special.pdtr(middle, expected).mean() < share:
            low = middle
        else:
            high = middle
    return float(high)
