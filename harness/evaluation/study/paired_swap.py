"""Whether a90 differs between two set-ups on the same boards: their results exchanged board by board, curves refitted.

The total of hits cannot tell alone: where luck grows and a50 stays, small damages are won and large ones lost, and a90
grows with as many hits. Nor can boards drawn again: of 500 draws none says less than 1/501.

Fisher's randomisation test for pairs: were the set-ups alike, each board's two results might as well be exchanged, and
so might all of them at once. The distribution of ln(a90 / a90) is therefore symmetric, and a one-sided p is half of the
two-sided one. Tosses are drawn until `ENOUGH` of them are as far out as what was observed (Besag and Clifford,
Biometrika 78 (1991), 301: the p is exact whatever the number of tosses), so that a p that is small is known well and
one that is large costs little. Not in the test: that each set-up drew its own calibration of the threshold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from harness.evaluation.pod.curve import link_ppf
from harness.evaluation.pod.statement import POD
from harness.evaluation.study.over_boards import Targets, targets_of, weighted_maxima
from harness.evaluation.study.paired import shared_rows
from harness.evaluation.study.record import Inspected
from harness.vocabulary.seeds import random_stream

LINK = "logit"
"""On size itself, for all: the choice of a curve must not depend on which result is whose."""
LEVEL = float(link_ppf(LINK, np.array(POD)))
"""The linear predictor at a90."""
TOSSES = 19_999
ENOUGH = 10
"""Tosses as far out after which p is known to about a third of itself and no more are drawn."""
FIRST_TOSSES = 64
CELLS = 200_000
"""Tosses times damages at a time: a few MB."""
STEPS = 12
ARRIVED = 1e-5
"""Newton's errors are squared with every step."""
TIE = 1e-6
"""Newton's method leaves errors of this order in ln a90: closer ones are ties, and ties count against."""


@dataclass(frozen=True)
class SwapChange:
    """``ratio``: a90 of the second set-up over that of the first, by curves of `LINK` on size for both, NaN where
    neither has one. ``grown_p``, ``shrunk_p``: one-sided, 1 on the side on which it does not lie; of ``tosses``."""

    ratio: float
    grown_p: float
    shrunk_p: float
    tosses: int

    @property
    def sides(self) -> tuple[float, float]:
        """p of (worse, better)."""
        return self.grown_p, self.shrunk_p


@dataclass(frozen=True, eq=False)
class Exchange:
    """Damages that both set-ups inspected, one a row: ``board`` (n,) as 0, 1, ...; ``z`` (n,) sizes in ``spread_mm``
    from ``centre_mm``; ``first``, ``second`` (n,) hits of ``inspections`` (n,); ``start`` (2,): the pooled curve."""

    board: np.ndarray
    z: np.ndarray
    centre_mm: float
    spread_mm: float
    first: np.ndarray
    second: np.ndarray
    inspections: np.ndarray
    start: np.ndarray

    @property
    def boards(self) -> int:
        """Boards that both inspected."""
        return int(self.board.max()) + 1

    def log_ratios(self, exchanged: np.ndarray) -> np.ndarray:
        """ln(a90 of the second / a90 of the first), (draws,), with the results of boards ``exchanged`` (draws, boards)
        exchanged. NaN where neither has an a90."""
        swapped = exchanged[:, self.board]
        with np.errstate(invalid="ignore"):
            return self._log_a90(np.where(swapped, self.first, self.second)) - self._log_a90(
                np.where(swapped, self.second, self.first)
            )

    def _log_a90(self, hits: np.ndarray) -> np.ndarray:
        """(draws,) of ``hits`` (draws, n).

        Infinite where nothing is found or the chance does not grow with size; the middle of the gap where hits and
        misses do not overlap; at least the smallest damage, which is it where everything is found. Any rule would do
        that does not ask whose results they are; a90 of a limit is estimated with more care.
        """
        misses = self.inspections - hits
        largest_miss = np.where(misses > 0, self.z, -np.inf).max(axis=1)
        smallest_hit = np.where(hits > 0, self.z, np.inf).min(axis=1)
        overlap = largest_miss > smallest_hit
        b0, b1 = _maxima(self.z, hits[overlap], misses[overlap], self.inspections, self.start).T
        at = 0.5 * (largest_miss + smallest_hit)
        with np.errstate(divide="ignore", invalid="ignore"):
            at[overlap] = np.where(b1 > 0, (LEVEL - b0) / b1, np.inf)
        return np.asarray(np.log(self.centre_mm + self.spread_mm * np.maximum(at, self.z.min())))


def exchange(first: Inspected, second: Inspected) -> Exchange | None:
    """The inspections that both have; None where there are none."""
    one, two = shared_rows(first, second)
    if not len(one):
        return None
    before, now = (
        targets_of(first.board[one], first.hole[one], first.diameter_mm[one], hit)
        for hit in (first.hit[one], second.hit[two])
    )
    centre, spread = float(before.size_mm.mean()), float(before.size_mm.std()) or 1.0
    z = (before.size_mm - centre) / spread
    return Exchange(
        board=np.unique(before.board, return_inverse=True)[1],
        z=z,
        centre_mm=centre,
        spread_mm=spread,
        first=before.hits,
        second=now.hits,
        inspections=before.inspections,
        start=_pooled(z, before, now),
    )


def swap_change(first: Inspected, second: Inspected, tosses: int = TOSSES) -> SwapChange | None:
    """The test on the inspections that both have; None where there are none. No more than ``tosses``; deterministic,
    and the studies exchanged give the same p on the other side."""
    pair = exchange(first, second)
    if pair is None:
        return None
    observed = float(pair.log_ratios(np.zeros((1, pair.boards), bool))[0])
    ratio = float(np.exp(observed))
    if np.isnan(observed) or abs(observed) <= TIE:
        return SwapChange(ratio, 1.0, 1.0, 0)
    p, drawn = _two_sided(pair, abs(observed) - TIE, tosses)
    grown, shrunk = (0.5 * p, 1.0) if observed > 0 else (1.0, 0.5 * p)
    return SwapChange(ratio, grown, shrunk, drawn)


def _maxima(
    z: np.ndarray, hits: np.ndarray, misses: np.ndarray, inspections: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """What `weighted_maxima` gives for the logit, (draws, 2), in a quarter of its time: the likelihood knows hits by
    their number and their sum of sizes alone, and from the pooled curve plain Newton steps nearly always arrive."""
    design = np.column_stack([np.ones_like(z), z])
    known, products = hits @ design, np.column_stack([np.ones_like(z), z, z * z])
    place = np.tile(start, (len(hits), 1))
    moving = np.arange(len(hits))
    for _ in range(STEPS):
        if not len(moving):
            return place
        chance = expit(place[moving] @ design.T)
        expected = inspections * chance
        slope = known[moving] - expected @ design
        total, cross, square = ((expected * (1.0 - chance)) @ products).T
        with np.errstate(all="ignore"):
            toward = square * slope[:, 0] - cross * slope[:, 1], total * slope[:, 1] - cross * slope[:, 0]
            step = np.column_stack(toward) / (total * square - cross**2)[:, None]
            place[moving] += step
            moving = moving[~(np.abs(step).max(axis=1) < ARRIVED)]
    place[moving] = weighted_maxima(design, hits[moving], misses[moving], LINK, start)
    return place


def _two_sided(pair: Exchange, observed: float, tosses: int) -> tuple[float, int]:
    """(p of |ln ratio| being as large as ``observed``, tosses drawn)."""
    stream = random_stream(0, "set-ups exchanged", pair.boards)
    most = max(1, CELLS // len(pair.z))
    drawn = as_far = 0
    while drawn < tosses:
        count = min(max(FIRST_TOSSES, drawn), most, tosses - drawn)
        far = ~(np.abs(pair.log_ratios(stream.random((count, pair.boards)) < 0.5)) < observed)  # NaN is as far
        reached = np.flatnonzero(as_far + np.cumsum(far) >= ENOUGH)
        if len(reached):
            drawn += int(reached[0]) + 1
            return ENOUGH / drawn, drawn
        as_far += int(far.sum())
        drawn += count
    return (as_far + 1) / (tosses + 1), tosses


def _pooled(z: np.ndarray, before: Targets, now: Targets) -> np.ndarray:
    """(2,) coefficients of one curve for both, the same whichever is first. Without meaning where the hits of both do
    not overlap the misses of both: then no exchange has a curve to be searched."""
    hits = before.hits + now.hits
    misses = before.inspections + now.inspections - hits
    if not (hits.any() and misses.any()) or z[misses > 0].max() <= z[hits > 0].min():
        return np.array([0.0, 1.0])
    design = np.column_stack([np.ones_like(z), z])
    return np.asarray(weighted_maxima(design, hits[None, :], misses[None, :], LINK, np.array([0.0, 1.0]))[0])
