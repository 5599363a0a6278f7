"""Comparison of two set-ups by hits, a90, signals and false calls. Boards are the units, because
damages of one board share its render, its pose and its surface. The test of hits ignores that each
set-up drew its own calibration of the threshold; those of limits, signals and false calls do not.
The first of two p-values means worse."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import betabinom, hypergeom, t

from harness.evaluation.intervals import Interval, percentiles
from harness.evaluation.pod.hit_miss import fit_hit_miss
from harness.evaluation.pod.statement import POD
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.record import Inspected, SetUpRecord, Unflawed
from harness.evaluation.study.signals import SignalLine, sandwich
from harness.vocabulary.errors import UserError

Tails = tuple[float, float]


@dataclass(frozen=True)
class HitsChange:
    """Hits of two set-ups on the same inspections, by a one-sided sign-flip test over boards."""

    # Number of boards
    boards: int
    # Number of inspections that both have
    inspections: int
    # Inspections found by the first set-up only
    only_first: int
    # Inspections found by the second set-up only
    only_second: int
    # Probability of so few hits of the second if each board's two sums of hits are exchangeable
    fewer_p: float
    # Probability of so many hits of the second, likewise
    more_p: float


def hits_change(first: Inspected, second: Inspected) -> HitsChange | None:
    """Compare hits on the inspections (board, hole, repeat) that both have; None if there are
    none."""
    rows_1, rows_2 = shared_rows(first, second)
    if not len(rows_1):
        return None
    first_hits = first.hit[rows_1]
    second_hits = second.hit[rows_2]
    only_first = int((first_hits & ~second_hits).sum())
    only_second = int((second_hits & ~first_hits).sum())
    names, board = np.unique(first.board[rows_1], return_inverse=True)
    gained = np.bincount(board, second_hits.astype(float) - first_hits.astype(float))
    gained = gained.round().astype(int)
    fewer_p, more_p = sign_flip(gained)
    return HitsChange(
        boards=len(names),
        inspections=len(rows_1),
        only_first=only_first,
        only_second=only_second,
        fewer_p=fewer_p,
        more_p=more_p,
    )


def shared_rows(first: Inspected, second: Inspected) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (k,) of ``first`` and of ``second`` that are the same inspection."""
    row_1 = _row_of_inspection(first)
    row_2 = _row_of_inspection(second)
    shared = [key for key in row_1 if key in row_2]
    rows_1 = np.array([row_1[key] for key in shared], int)
    rows_2 = np.array([row_2[key] for key in shared], int)
    return rows_1, rows_2


def _row_of_inspection(table: Inspected) -> dict[tuple[int, str, int], int]:
    keys = zip(table.board.tolist(), table.hole.tolist(), table.repeat.tolist(), strict=True)
    return {key: row for row, key in enumerate(keys)}


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
    at_most = float(chance[: observed + 1].sum())
    at_least = float(chance[observed:].sum())
    return min(1.0, at_most), min(1.0, at_least)


@dataclass(frozen=True)
class LimitChange:
    """Change of a90 from the first set-up to the second.

    The p-values are one-sided, by Student's t of the change's logarithm over its deviation in
    paired draws. If unpaired, or if many draws have no a90, they are the share of draws in which
    it has not grown (shrunk)."""

    # Second a90 over the first
    ratio: float
    # Second a90 minus the first, millimetres
    difference_mm: float
    # 95 % percentiles of the difference over resampled boards
    interval_mm: Interval
    # p-value of growth
    grown_p: float
    # p-value of shrinkage
    shrunk_p: float
    # Whether both set-ups are resampled with the same boards
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
    # the least p-value that so few draws can support
    weight = 1.0 / (1 + len(draws_1)) if paired else 0.0
    share_shrunk = float(np.mean(differences < 0)) + tie
    share_grown = float(np.mean(differences > 0)) + tie
    grown_p = (1 - weight) * share_shrunk + weight
    shrunk_p = (1 - weight) * share_grown + weight
    before = first.a90_mm
    now = second.a90_mm
    with np.errstate(all="ignore"):
        change = float(np.log(now / before))
        logs = np.log(draws_2 / draws_1) if paired else np.empty(0)
    finite_logs = logs[np.isfinite(logs)]
    if len(finite_logs) > KNOWN * len(logs) and finite_logs.std() > 0 and np.isfinite(change):
        tails = t.sf([change, -change], len(boards[0]) - 1, scale=finite_logs.std())
        grown_p, shrunk_p = tails.tolist()
    return LimitChange(
        ratio=now / before,
        difference_mm=now - before,
        interval_mm=percentiles(differences),
        grown_p=grown_p,
        shrunk_p=shrunk_p,
        paired=paired,
    )


@dataclass(frozen=True)
class SignalLimitChange:
    """Change of a90 from signals on the same boards, by Student's t with boards as units."""

    # Second a90 over the first
    ratio: float
    # Both a90, millimetres
    a90_mm: tuple[float, float]
    # p-value of growth
    grown_p: float
    # p-value of shrinkage
    shrunk_p: float


def signal_limit_change(first: SetUpLimit, second: SetUpLimit) -> SignalLimitChange | None:
    """Compare a90 from signals on the likeliest pair of axes that neither set-up contradicts; None
    if there is none, or the boards are not the same.

    A board moves both limits, so its influences are subtracted; each set-up has a threshold of its
    own, whose errors add up."""
    boards = [np.unique(limit.record.inspected.board) for limit in (first, second)]
    if not np.array_equal(boards[0], boards[1]):
        return None
    lines_1 = {line.axes: line for line in first.from_signals.lines}
    lines_2 = {line.axes: line for line in second.from_signals.lines}
    shared = [axes for axes in lines_1 if axes in lines_2]
    if not shared:
        return None
    axes = max(shared, key=lambda of: _log_likelihood(lines_1[of]) + _log_likelihood(lines_2[of]))
    before = lines_1[axes].fit.curve.size_at(POD)
    now = lines_2[axes].fit.curve.size_at(POD)
    if not min(before, now) > 0:
        return None
    moved_1, by_threshold_1 = lines_1[axes].log_influence_at(POD)
    moved_2, by_threshold_2 = lines_2[axes].log_influence_at(POD)
    variance = sandwich(moved_2 - moved_1)
    if not np.isclose(first.record.threshold, second.record.threshold, rtol=SAME, atol=0.0):
        variance += by_threshold_1**2 + by_threshold_2**2
    change = float(np.log(now / before))
    grown_p = float(change <= 0)
    shrunk_p = float(change >= 0)
    if variance > 0:
        score = change / np.sqrt(variance)
        grown_p, shrunk_p = t.sf([score, -score], len(moved_1) - 1).tolist()
    return SignalLimitChange(
        ratio=now / before,
        a90_mm=(before, now),
        grown_p=grown_p,
        shrunk_p=shrunk_p,
    )


def _log_likelihood(line: SignalLine) -> float:
    return line.fit.log_likelihood


SAME = 1e-6  # relative difference of equal thresholds between machines


@dataclass(frozen=True)
class SignalChange:
    """Change of the signals of damages, each divided by the least signal that is found.

    The p-values are one-sided, by Student's t, as the errors are estimates too (Satterthwaite,
    Biometrics Bulletin 2 (1946), 110)."""

    # Number of damages
    damages: int
    # Median change, as a factor
    ratio: float
    # Least signal that is found: (first, second)
    found_from: tuple[float, float]
    # Standard error of the ratio's logarithm, over boards and calibrations
    error: float
    # p-value of weaker signals
    less_p: float
    # p-value of stronger signals
    more_p: float


def signal_change(first: SetUpRecord, second: SetUpRecord) -> SignalChange | None:
    """Compare signals on the inspections that both have. This is more sensitive than hits: signals
    change with all noise and with the threshold, hits only near the limit. A damage counts if the
    geometric mean of its two signals, each over ``found_from``, exceeds 1; smaller signals are
    noise. None for two detectors or fewer than two boards."""
    rows_1, rows_2 = shared_rows(first.inspected, second.inspected)
    if first.detector != second.detector or not len(rows_1):
        return None
    needed_1, variance_1 = found_from(first)
    needed_2, variance_2 = found_from(second)
    with np.errstate(divide="ignore", invalid="ignore"):
        before = np.log(first.inspected.signal[rows_1] / needed_1)
        now = np.log(second.inspected.signal[rows_2] / needed_2)
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
    parts += [(variance_1, np.inf), (variance_2, np.inf)]
    variances, freedoms = np.array(parts).T
    error = float(np.sqrt(variances.sum()))
    median = float(np.median(change))
    less_p = float(median >= 0)
    more_p = float(median <= 0)
    if error > 0:
        freedom = error**4 / (variances**2 / freedoms).sum()
        less_p, more_p = t.cdf(np.array([median, -median]) / error, freedom).tolist()
    return SignalChange(
        damages=len(change),
        ratio=float(np.exp(median)),
        found_from=(needed_1, needed_2),
        error=error,
        less_p=less_p,
        more_p=more_p,
    )


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
        middle = float(np.exp((strongest_miss + weakest_hit) / 2))
        # of a uniform distribution between the two
        variance = float((weakest_hit - strongest_miss) ** 2 / 12)
        return middle, variance
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
    variance = float(scale**2 * max(1 / rank - 1 / n, 1 / n**2))
    return variance, upper / 2


@dataclass(frozen=True)
class CallsChange:
    """Change of false calls on hole-free boards; each pair is (first, second)."""

    # Number of false calls
    calls: tuple[int, int]
    # Area of the hole-free boards, square metres
    areas_m2: tuple[float, float]
    # Number of hole-free boards
    boards: tuple[int, int]
    # Number of boards with a call in their first repeat
    calling: tuple[int, int]
    # One-sided p-value of more calls
    more_p: float
    # One-sided p-value of fewer calls
    fewer_p: float
    # "signs": the signs of boards are randomised (same frames and threshold); "calibrations": two
    # draws of the calibration (different frames); "both": the larger p
    way: Literal["signs", "calibrations", "both"]

    @property
    def rates_per_m2(self) -> tuple[float, float]:
        """False calls per square metre: (first, second)."""
        before = self.calls[0] / self.areas_m2[0]
        now = self.calls[1] / self.areas_m2[1]
        return before, now

    @property
    def ratio(self) -> float:
        """The second rate over the first: infinite if only the second has calls, 1 if neither
        has."""
        before, now = self.rates_per_m2
        if before:
            return now / before
        return np.inf if now else 1.0


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
    boards_1, calling_1 = _calling(unflawed_1)
    boards_2, calling_2 = _calling(unflawed_2)
    # on identical frames, an equal calibrated threshold means equal scores: two scorings give the
    # same number by chance only if scores are few whole numbers; a given threshold has no scatter
    is_given = not (first.calibration_runs or second.calibration_runs)
    method: Literal["signs", "calibrations", "both"] = "both"
    if first.frames_digest != second.frames_digest:
        method = "calibrations"
    elif is_given or np.isclose(first.threshold, second.threshold, rtol=SAME, atol=0.0):
        method = "signs"
    by_signs = (0.0, 0.0)
    by_draws = (0.0, 0.0)
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
        rank_1 = _rank(first, wanted_per_m2)
        rank_2 = _rank(second, wanted_per_m2)
        of_second = np.arange(total + 1)  # number of the second's boards among all that called
        if rank_1 is None or rank_2 is None:
            chance = hypergeom.pmf(of_second, boards_1 + boards_2, total, boards_2)
        else:
            alpha_1, beta_1 = rank_1
            alpha_2, beta_2 = rank_2
            logs = betabinom.logpmf(total - of_second, boards_1, alpha_1, beta_1)
            logs = logs + betabinom.logpmf(of_second, boards_2, alpha_2, beta_2)
            chance = np.exp(logs - logs.max())
            chance = chance / chance.sum()
        by_draws = _tails(chance, calling_2) if total else (1.0, 1.0)
    return CallsChange(
        calls=calls,
        areas_m2=areas,
        boards=(boards_1, boards_2),
        calling=(calling_1, calling_2),
        more_p=max(by_signs[1], by_draws[1]),
        fewer_p=max(by_signs[0], by_draws[0]),
        way=method,
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
    silent = 0.0
    if wanted_per_m2:
        silent = -np.expm1(-wanted_per_m2 * float(record.unflawed.area_m2.mean()))
    r = int(np.clip(np.floor((n + 1) * silent * (1 + 1e-12)), 1, n))
    return r, n + 1 - r
