"""Two set-ups on the same boards, compared board by board; and on boards of their own, compared by their limits.

Boards are the unit: damages of one board share its render, its pose and its surface, so they are not exchanged one by
one. Not in any test here: that each set-up drew its own calibration of the threshold. A gate needs a margin for that
(`harness.evaluation.study.verdict`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.evaluation.intervals import Interval
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.over_boards import percentiles
from harness.evaluation.study.record import Inspected


@dataclass(frozen=True)
class HitsChange:
    """Hits of two set-ups on the same inspections, ``inspections`` of them on ``boards``.

    ``only_first``, ``only_second``: found by one alone. ``mcnemar_p``: McNemar's exact test (two-sided), which takes
    inspections as independent. ``fewer_p``, ``more_p``: one-sided sign-flip test over boards: how likely so few (many)
    hits of the second are if each board's two sums of hits might as well be exchanged.
    """

    boards: int
    inspections: int
    only_first: int
    only_second: int
    mcnemar_p: float
    fewer_p: float
    more_p: float

    @property
    def sides(self) -> tuple[float, float]:
        """p of (worse, better)."""
        return self.fewer_p, self.more_p

    @property
    def boards_p(self) -> float:
        """The test over boards, two-sided: what decides."""
        return min(1.0, 2 * min(self.fewer_p, self.more_p))


@dataclass(frozen=True)
class LimitChange:
    """a90 of the second set-up over and less that of the first.

    ``interval_mm``: 95 % percentiles of the difference over boards drawn again: the same boards for both where
    ``paired``, else independently. ``grown_p``, ``shrunk_p``: share of draws in which it has not grown (shrunk), and
    with 500 draws never below 1/501 where paired. Unpaired it is a share of all 250,000 pairs of draws; of a share
    below 1/501 each the tails of both are no more than their few outermost draws: significance there is a matter of
    the two distributions hardly overlapping, not of a p known to its digits.
    """

    ratio: float
    difference_mm: float
    interval_mm: Interval
    grown_p: float
    shrunk_p: float
    paired: bool

    @property
    def sides(self) -> tuple[float, float]:
        """p of (worse, better)."""
        return self.grown_p, self.shrunk_p


def hits_change(first: Inspected, second: Inspected) -> HitsChange | None:
    """On the inspections (board, hole, repeat) that both have; None where there are none."""
    one, two = shared_rows(first, second)
    if not len(one):
        return None
    found, now = first.hit[one], second.hit[two]
    only_first, only_second = int((found & ~now).sum()), int((now & ~found).sum())
    names, board = np.unique(first.board[one], return_inverse=True)
    gained = np.bincount(board, now.astype(float) - found.astype(float)).round().astype(int)
    fewer, more = sign_flip(gained)
    p = mcnemar(only_first, only_second)
    return HitsChange(len(names), len(one), only_first, only_second, p, fewer, more)


def shared_rows(first: Inspected, second: Inspected) -> tuple[np.ndarray, np.ndarray]:
    """Rows (k,) of ``first`` and of ``second`` that are the same inspection."""
    keys = (zip(t.board.tolist(), t.hole.tolist(), t.repeat.tolist(), strict=True) for t in (first, second))
    at, there = ({key: row for row, key in enumerate(one)} for one in keys)
    shared = [key for key in at if key in there]
    return np.array([at[key] for key in shared], int), np.array([there[key] for key in shared], int)


def mcnemar(only_first: int, only_second: int) -> float:
    """Exact two-sided p: discordant pairs fall on either side with equal chance (McNemar 1947, exact by Liddell)."""
    from scipy.stats import binomtest

    discordant = only_first + only_second
    return float(binomtest(only_first, discordant, 0.5).pvalue) if discordant else 1.0


def sign_flip(gained: np.ndarray) -> tuple[float, float]:
    """(P(sum <= observed), P(sum >= observed)) of integer differences (n,) whose signs are tossed independently.

    Fisher's randomisation test for pairs, exact: the distribution of the sum is built up board by board. Its null is
    that the two set-ups are exchangeable on each board, whatever the boards have in themselves.
    """
    sizes = np.abs(gained[gained != 0]).astype(int)
    chance = np.zeros(int(sizes.sum()) + 1)  # of the sum of those that come out positive
    chance[0] = 1.0
    for size in sizes:
        tossed = 0.5 * chance
        tossed[size:] += 0.5 * chance[: len(chance) - size]
        chance = tossed
    observed = int(gained[gained > 0].sum())
    return min(1.0, float(chance[: observed + 1].sum())), min(1.0, float(chance[observed:].sum()))


def limit_change(first: SetUpLimit, second: SetUpLimit, same_boards: bool) -> LimitChange:
    """``same_boards``: of equal numbers and damage. Paired only if both were inspected on the same of them."""
    one, two = first.a90_draws_mm, second.a90_draws_mm
    paired = same_boards and bool(np.array_equal(_boards(first), _boards(second))) and len(one) == len(two)
    differences = _less(two, one) if paired else _less(two[:, None], one[None, :]).ravel()
    tie = 0.5 * float(np.mean(np.isnan(differences) | (differences == 0)))
    weight = 1.0 / (1 + len(one))  # no share of so few draws is evidence below this
    shares = (float(np.mean(differences < 0)) + tie, float(np.mean(differences > 0)) + tie)
    grown, shrunk = ((1 - weight) * share + weight for share in shares) if paired else shares
    before, now = first.a90_mm, second.a90_mm
    return LimitChange(now / before, now - before, percentiles(differences), grown, shrunk, paired)


def _less(second: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Second less first; NaN (no evidence either way) where both are infinite."""
    with np.errstate(invalid="ignore"):
        return np.asarray(second - first)


def _boards(limit: SetUpLimit) -> np.ndarray:
    return np.unique(limit.record.inspected.board)
