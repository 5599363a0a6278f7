"""Comparison of two set-ups by hits, a90, signals and false calls. Boards are the units, because
damages of one board share its render, its pose and its surface. The tests of hits and limits
ignore that each set-up drew its own calibration of the threshold; those of signals and false calls
do not. The first of two p-values means worse."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import betabinom, hypergeom, t

from harness.evaluation.intervals import Interval, percentiles
from harness.evaluation.pod.hit_miss import fit_hit_miss
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.record import Inspected, SetUpRecord, Unflawed
from harness.vocabulary.errors import UserError

Tails = tuple[float, float]


@dataclass(frozen=True)
class HitsChange:
    """Hits of two set-ups on the same ``inspections`` of ``boards``. ``only_first``,
    ``only_second``: found by only one. ``fewer_p``, ``more_p``: one-sided sign-flip test over
    boards: the probability of so few (many) hits of the second if each board's two sums of hits
    are exchangeable."""

    boards: int
    inspections: int
    only_first: int
    only_second: int
    fewer_p: float
    more_p: float


def hits_change(first: Inspected, second: Inspected) -> HitsChange | None:
    """Compare hits on the inspections (board, hole, repeat) that both have; None if there are
    none."""
    rows_1, rows_2 = shared_rows(first, second)
    if not len(rows_1):
        return None
    first_hits = first.hit[rows_1]
    now = second.hit[rows_2]
    only_first = int((first_hits & ~now).sum())
    only_second = int((now & ~first_hits).sum())
    names, board = np.unique(first.board[rows_1], return_inverse=True)
    gained = np.bincount(board, now.astype(float) - first_hits.astype(float)).round().astype(int)
    return HitsChange(len(names), len(rows_1), only_first, only_second, *sign_flip(gained))


def shared_rows(first: Inspected, second: Inspected) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (k,) of ``first`` and of ``second`` that are the same inspection."""
    keys = (
        zip(t.board.tolist(), t.hole.tolist(), t.repeat.tolist(), strict=True)
        for t in (first, second)
    )
    row_1, row_2 = ({key: row for row, key in enumerate(inspections)} for inspections in keys)
    shared = [key for key in row_1 if key in row_2]
    return np.array([row_1[key] for key in shared], int), np.array(
        [row_2[key] for key in shared], int
    )


def sign_flip(gained: np.ndarray) -> Tails:
    """Return (P(sum <= observed), P(sum >= observed)) of integer differences (n,) with random
    signs: Fisher's randomisation test for pairs. It is exact: the distribution of the sum is built
    up board by board."""
    chance = np.ones(1)  # of the sum of the differences with a positive sign
    for size in np.abs(gained[gained != 0]).tolist():
        chance = 0.5 * (np.pad(chance, (0, size)) + np.pad(chance, (size, 0)))
    return _tails(chance, int(gained[gained > 0].sum()))


def _tails(chance: np.ndarray, observed: int) -> Tails:
    """Return (P(<= observed), P(>= observed)) for a distribution over 0, 1, ..."""
    return min(1.0, float(chance[: observed + 1].sum())), min(1.0, float(chance[observed:].sum()))


@dataclass(frozen=True)
class LimitChange:
    """Ratio and difference of the second set-up's a90 to the first's. ``interval_mm``: 95 %
    percentiles of the difference over resampled boards, the same for both if ``paired``.
    ``grown_p``, ``shrunk_p``: one-sided, by Student's t of the change's logarithm over its
    deviation in paired draws. If unpaired, or if many draws have no a90, they are the share of
    draws in which it has not grown (shrunk)."""

    ratio: float
    difference_mm: float
    interval_mm: Interval
    grown_p: float
    shrunk_p: float
    paired: bool


KNOWN = 0.9  # least share of draws with an a90 whose deviation counts as that of the change


def limit_change(first: SetUpLimit, second: SetUpLimit, same_boards: bool) -> LimitChange:
    """Compare two a90 by resampled boards. ``same_boards``: boards with equal damage; paired if
    both saw the same."""
    draws_1 = first.a90_draws_mm
    draws_2 = second.a90_draws_mm
    boards = [np.unique(limit.record.inspected.board) for limit in (first, second)]
    paired = (
        same_boards and bool(np.array_equal(boards[0], boards[1])) and len(draws_1) == len(draws_2)
    )
    with np.errstate(invalid="ignore"):  # infinity minus infinity is NaN: no evidence
        differences = draws_2 - draws_1 if paired else (draws_2[:, None] - draws_1[None, :]).ravel()
    tie = 0.5 * float(np.mean(np.isnan(differences) | (differences == 0)))
    weight = (
        1.0 / (1 + len(draws_1)) if paired else 0.0
    )  # the least p-value that so few draws can support
    shares = (float(np.mean(differences < 0)) + tie, float(np.mean(differences > 0)) + tie)
    grown, shrunk = ((1 - weight) * share + weight for share in shares)
    before = first.a90_mm
    now = second.a90_mm
    with np.errstate(all="ignore"):
        change = float(np.log(now / before))
        logs = np.log(draws_2 / draws_1) if paired else np.empty(0)
    finite_logs = logs[np.isfinite(logs)]
    if len(finite_logs) > KNOWN * len(logs) and finite_logs.std() > 0 and np.isfinite(change):
        grown, shrunk = t.sf(
            [change, -change], len(boards[0]) - 1, scale=finite_logs.std()
        ).tolist()
    return LimitChange(now / before, now - before, percentiles(differences), grown, shrunk, paired)


SAME = 1e-6  # relative difference of equal thresholds between machines


@dataclass(frozen=True)
class SignalChange:
    """Change of the signals of ``damages``, each divided by the least signal that is found
    (``found_from``: first, second). ``ratio``: median, as a factor. ``error``: of its logarithm,
    over boards, calibrations. p: one-sided, by Student's t, as these errors are estimates too
    (Satterthwaite, Biometrics Bulletin 2 (1946), 110)."""

    damages: int
    ratio: float
    found_from: tuple[float, float]
    error: float
    less_p: float
    more_p: float


def signal_change(first: SetUpRecord, second: SetUpRecord) -> SignalChange | None:
    """Compare signals on the inspections that both have. This is more sensitive than hits: signals
    change with all noise and with the threshold, hits only near the limit. A damage counts if the
    geometric mean of its two signals, each over ``found_from``, exceeds 1; smaller signals are
    noise. None for two detectors or fewer than two boards."""
    rows_1, rows_2 = shared_rows(first.inspected, second.inspected)
    if first.detector != second.detector or not len(rows_1):
        return None
    needed = found_from(first), found_from(second)
    with np.errstate(divide="ignore", invalid="ignore"):
        before, now = (
            np.log(record.inspected.signal[rows] / needed_signal)
            for record, rows, (needed_signal, _) in zip(
                (first, second), (rows_1, rows_2), needed, strict=True
            )
        )
        clear = np.isfinite(before + now) & (before + now > 0)
    change = (now - before)[clear]
    board = first.inspected.board[rows_1][clear]
    names, board_index = np.unique(board, return_inverse=True)
    if len(names) < 2:
        return None
    of_boards = np.bincount(board_index, change) / np.bincount(board_index)
    parts = [(of_boards.var(ddof=1) / len(names), len(names) - 1.0)]
    if not np.isclose(first.threshold, second.threshold, rtol=SAME, atol=0.0):
        parts += [_threshold_variance(first), _threshold_variance(second)]
    variances, freedoms = np.array([*parts, *((unsure, np.inf) for _, unsure in needed)]).T
    error = float(np.sqrt(variances.sum()))
    median = float(np.median(change))
    p = [float(median >= 0), float(median <= 0)]
    if error > 0:
        p = t.cdf(
            np.array([median, -median]) / error, error**4 / (variances**2 / freedoms).sum()
        ).tolist()
    return SignalChange(len(change), float(np.exp(median)), (needed[0][0], needed[1][0]), error, *p)


def found_from(record: SetUpRecord) -> tuple[float, float]:
    """Return the effective threshold and the variance of its logarithm: the set-up's threshold
    (variance 0) if it divides hits from misses without exception; else the middle between the
    strongest miss and the weakest hit, if they do not overlap; else the signal at which half is
    found, by logistic regression. Hits by missing returns alone do not count; NaN without signals,
    or if hits do not grow with them."""
    inspected = record.inspected
    has_signal = inspected.signal > 0
    signal = inspected.signal[has_signal]
    hit = (inspected.hit if inspected.by_depth is None else inspected.by_depth)[has_signal]
    if not len(signal):
        return np.nan, np.nan
    if (hit == (signal > record.threshold)).all():
        return record.threshold, 0.0
    logs = np.log(signal)
    strongest_miss = logs[~hit].max(initial=logs.min())
    weakest_hit = logs[hit].min(initial=logs.max())
    if strongest_miss <= weakest_hit:
        return float(np.exp((strongest_miss + weakest_hit) / 2)), float(
            (weakest_hit - strongest_miss) ** 2 / 12
        )
    try:
        curve = fit_hit_miss(signal, hit, log_size=True).curve
    except UserError:
        return np.nan, np.nan
    return float(np.exp(curve.mu)), float(curve.covariance[0, 0])


def _threshold_variance(record: SetUpRecord) -> tuple[float, float]:
    """Return the variance of a calibrated threshold's logarithm, and its degrees of freedom.
    Scores above the median are taken to have an exponential tail on a logarithmic scale: the mean
    excess of so many determines it, where the distance of neighbouring scores would scatter by 40
    %."""
    if record.calibrated is None or len(record.calibrated.score) < 2:
        return 0.0, np.inf
    falling = np.sort(np.log(np.maximum(record.calibrated.score, 1e-9)))[::-1]
    n = len(falling)
    rank = max(int((falling >= np.log(record.threshold)).sum()), 1)
    upper = n // 2
    scale = (falling[:upper] - falling[upper]).mean()
    return float(scale**2 * max(1 / rank - 1 / n, 1 / n**2)), upper / 2


@dataclass(frozen=True)
class CallsChange:
    """False calls, each as (first, second): ``calls`` on ``areas_m2`` of hole-free boards, and
    ``calling`` of ``boards`` with a call in their first repeat. ``more_p``, ``fewer_p``:
    one-sided. ``way``: "signs", the signs of boards are randomised (same frames and threshold);
    "calibrations", two draws of the calibration (different frames); "both", the larger p."""

    calls: tuple[int, int]
    areas_m2: tuple[float, float]
    boards: tuple[int, int]
    calling: tuple[int, int]
    more_p: float
    fewer_p: float
    way: Literal["signs", "calibrations", "both"]

    @property
    def rates_per_m2(self) -> tuple[float, float]:
        """False calls per square metre: (first, second)."""
        return self.calls[0] / self.areas_m2[0], self.calls[1] / self.areas_m2[1]

    @property
    def ratio(self) -> float:
        """The second rate over the first: infinite if only the second has calls, 1 if neither
        has."""
        before, now = self.rates_per_m2
        return now / before if before else (np.inf if now else 1.0)


def calls_change(
    first: SetUpRecord, second: SetUpRecord, wanted_per_m2: float | None
) -> CallsChange | None:
    """Compare false calls of two set-ups whose thresholds were calibrated on hole-free boards of
    their own. Two correct calibrations for one rate give two different true rates (Beta
    distributed, Wilks 1941): at a level of 5 %, a test of two Poisson counts rejects 20 % of equal
    pairs with 240 boards each. So each set-up gets its own draw of that distribution. On identical
    frames with the same threshold, the signs of each board's difference are randomised, which
    shows smaller changes; if the threshold differs on identical frames, both tests must agree.
    None if either set-up has no hole-free board. ``wanted_per_m2``: None without a wanted rate."""
    unflawed_1 = first.unflawed
    unflawed_2 = second.unflawed
    areas = (float(unflawed_1.area_m2.sum()), float(unflawed_2.area_m2.sum()))
    if not min(areas) > 0:
        return None
    calls = (int(unflawed_1.calls.sum()), int(unflawed_2.calls.sum()))
    (boards_1, calling_1), (boards_2, calling_2) = _calling(unflawed_1), _calling(unflawed_2)
    # on identical frames, an equal calibrated threshold means equal scores: two scorings give the
    # same number by chance only if scores are few whole numbers; a given threshold has no scatter
    is_given = not (first.calibration_runs or second.calibration_runs)
    method: Literal["signs", "calibrations", "both"] = "both"
    if first.frames_digest != second.frames_digest:
        method = "calibrations"
    elif is_given or np.isclose(first.threshold, second.threshold, rtol=SAME, atol=0.0):
        method = "signs"
    by_signs = by_draws = (0.0, 0.0)
    if method != "calibrations":
        _, row_1, row_2 = np.intersect1d(
            np.unique(unflawed_1.board), np.unique(unflawed_2.board), return_indices=True
        )
        sums = [
            np.bincount(np.unique(t.board, return_inverse=True)[1], t.calls)
            for t in (unflawed_1, unflawed_2)
        ]
        by_signs = sign_flip((sums[1][row_2] - sums[0][row_1]).round().astype(int))
    if method != "signs":
        total = calling_1 + calling_2
        ranks = _rank(first, wanted_per_m2), _rank(second, wanted_per_m2)
        of_second = np.arange(total + 1)  # number of the second's boards among all that called
        if ranks[0] is None or ranks[1] is None:
            chance = hypergeom.pmf(of_second, boards_1 + boards_2, total, boards_2)
        else:
            logs = betabinom.logpmf(total - of_second, boards_1, *ranks[0])
            logs = logs + betabinom.logpmf(of_second, boards_2, *ranks[1])
            chance = np.exp(logs - logs.max())
            chance = chance / chance.sum()
        by_draws = _tails(chance, calling_2) if total else (1.0, 1.0)
    fewer, more = (max(pair) for pair in zip(by_signs, by_draws, strict=True))
    return CallsChange(
        calls, areas, (boards_1, boards_2), (calling_1, calling_2), more, fewer, method
    )


def _calling(table: Unflawed) -> tuple[int, int]:
    """Return (boards, boards with a call) in the first repeat of each: repeats of one board are
    not independent."""
    first = table.repeat == table.repeat.min()
    return int(first.sum()), int((table.calls[first] > 0).sum())


def _rank(record: SetUpRecord, wanted_per_m2: float | None) -> tuple[int, int] | None:
    """Return (r, n + 1 - r): the threshold is the r-th highest of n calibration scores; None if it
    was given."""
    n = record.calibration_runs
    if not n:
        return None
    silent = (
        -np.expm1(-wanted_per_m2 * float(record.unflawed.area_m2.mean())) if wanted_per_m2 else 0.0
    )
    r = int(np.clip(np.floor((n + 1) * silent * (1 + 1e-12)), 1, n))
    return r, n + 1 - r
