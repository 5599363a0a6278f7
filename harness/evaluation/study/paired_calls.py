"""False calls of two set-ups whose thresholds were each calibrated on a draw of hole-free boards of their own.

Two honest calibrations for one wanted rate give two different true rates: with the 4th highest of 60 scores as
threshold, the chance that a new board calls is Beta(4, 57) distributed (Wilks 1941), half its mean to either side. A
test of two Poisson counts that ignores it is called at 5 % in 20 % of honest pairs with 240 hole-free boards each. So
the test that decides gives each set-up its own draw of that distribution, and asks how many of all boards that called
are the second's. On identical frames with the same threshold both had the same luck: there the signs of each board's
difference are tossed instead, and smaller changes show. Identical frames alone are not enough: a detector that scores
otherwise has luck of its own on them, and of two equally good ones with 240 boards each, that toss alone calls 6 % at
0.1 %. So where detector, version, settings or anything else moved the threshold, both tests must agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from harness.evaluation.study.paired import sign_flip
from harness.evaluation.study.record import SetUpRecord, Unflawed

SAME = 1e-6
"""Relative difference of one threshold from machine to machine."""


@dataclass(frozen=True)
class CallsChange:
    """``calls`` on ``areas_m2`` of hole-free boards, ``calling`` of ``boards`` with a call (first repeat of each), each
    (first, second).

    ``counts_p``: conditional binomial test of two Poisson counts, two-sided (Przyborowski and Wilenski 1940), as if
    thresholds were known. ``more_p``, ``fewer_p``: one-sided, they decide. They toss the signs of boards where frames
    and threshold are the same (``way`` "signs"); allow for two draws of the calibration on different frames
    ("calibrations"); and are the larger of both on identical frames with calibrated thresholds that differ ("both").
    """

    calls: tuple[int, int]
    areas_m2: tuple[float, float]
    boards: tuple[int, int]
    calling: tuple[int, int]
    counts_p: float
    more_p: float
    fewer_p: float
    way: Literal["signs", "calibrations", "both"]

    @property
    def sides(self) -> tuple[float, float]:
        """p of (worse, better)."""
        return self.more_p, self.fewer_p

    @property
    def rates_per_m2(self) -> tuple[float, float]:
        """False calls per square metre, (first, second)."""
        return self.calls[0] / self.areas_m2[0], self.calls[1] / self.areas_m2[1]

    @property
    def ratio(self) -> float:
        """Second rate over first: infinite where only the second has calls, 1 where neither has."""
        before, now = self.rates_per_m2
        return now / before if before else (np.inf if now else 1.0)


def calls_change(first: SetUpRecord, second: SetUpRecord, wanted_per_m2: float | None) -> CallsChange | None:
    """None where either has no hole-free board. ``wanted_per_m2``: the rate that both were calibrated to, None where
    the threshold is the lowest without a false call, or was given (no calibration runs)."""
    from scipy.stats import binomtest

    tables = (first.unflawed, second.unflawed)
    areas = tuple(float(table.area_m2.sum()) for table in tables)
    if not min(areas) > 0:
        return None
    calls = tuple(int(table.calls.sum()) for table in tables)
    ranks = tuple(_rank(record, wanted_per_m2) for record in (first, second))
    boards, calling = zip(*(_calling(table) for table in tables), strict=True)
    counts = float(binomtest(calls[1], sum(calls), areas[1] / sum(areas)).pvalue) if sum(calls) else 1.0
    way = _way(first, second)
    by_signs = sign_flip(_gained(*tables)) if way != "calibrations" else (0.0, 0.0)
    by_draws = _tails(_share(boards, sum(calling), ranks), calling[1], sum(calling)) if way != "signs" else (0.0, 0.0)
    fewer, more = (max(pair) for pair in zip(by_signs, by_draws, strict=True))
    return CallsChange(calls, areas, boards, calling, counts, more, fewer, way)  # type: ignore[arg-type]


def _way(first: SetUpRecord, second: SetUpRecord) -> Literal["signs", "calibrations", "both"]:
    """Scores on identical frames are alike if the calibration took the same number for threshold, which two ways of
    scoring do by chance only where scores are few whole numbers. A given threshold had no luck."""
    if first.frames_digest != second.frames_digest:
        return "calibrations"
    given = not first.calibration_runs and not second.calibration_runs
    return "signs" if given or np.isclose(first.threshold, second.threshold, rtol=SAME, atol=0.0) else "both"


def _gained(first: Unflawed, second: Unflawed) -> np.ndarray:
    """(boards,) how many more calls of the second, on the boards that both have; all repeats together."""
    shared, at, there = np.intersect1d(np.unique(first.board), np.unique(second.board), return_indices=True)
    sums = [np.bincount(np.unique(one.board, return_inverse=True)[1], one.calls) for one in (first, second)]
    return np.asarray((sums[1][there] - sums[0][at]).round().astype(int)) if len(shared) else np.zeros(0, int)


def _calling(table: Unflawed) -> tuple[int, int]:
    """(boards, those of them that called), in the first repeat of each: repeats of one board are not independent."""
    first = table.repeat == table.repeat.min()
    return int(first.sum()), int((table.calls[first] > 0).sum())


def _rank(record: SetUpRecord, wanted_per_m2: float | None) -> tuple[int, int] | None:
    """(r, n + 1 - r): the threshold is the r-th highest of n calibration runs' scores, as
    `harness.evaluation.pod.false_calls.threshold_for_rate` takes it; None where it was given."""
    n = record.calibration_runs
    if not n:
        return None
    silent = -np.expm1(-wanted_per_m2 * float(record.unflawed.area_m2.mean())) if wanted_per_m2 else 0.0
    r = int(np.clip(np.floor((n + 1) * silent * (1 + 1e-12)), 1, n))
    return r, n + 1 - r


def _share(boards: tuple[int, ...], total: int, ranks: tuple[tuple[int, int] | None, ...]) -> np.ndarray:
    """Chance (total + 1,) that the second set-up has 0, 1, ... of all ``total`` boards that called."""
    from scipy.stats import betabinom, hypergeom

    of_second = np.arange(total + 1)
    if ranks[0] is None or ranks[1] is None:
        return np.asarray(hypergeom.pmf(of_second, sum(boards), total, boards[1]))
    logs = betabinom.logpmf(total - of_second, boards[0], *ranks[0]) + betabinom.logpmf(of_second, boards[1], *ranks[1])
    chance = np.exp(logs - logs.max())
    return np.asarray(chance / chance.sum())


def _tails(chance: np.ndarray, observed: int, total: int) -> tuple[float, float]:
    if not total:
        return 1.0, 1.0
    return min(1.0, float(chance[: observed + 1].sum())), min(1.0, float(chance[observed:].sum()))
