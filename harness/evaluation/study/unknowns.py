"""The effect of each unknown alone on a90, from boards of which each has unknowns of its own.

One model is fitted to all drawn boards: logit POD = (ln a - mu) / s, where mu and ln s are linear
in the unknowns, each coded with mean 0 over its values. So every board tells of every unknown; an
unknown multiplies a50 by a factor, and the width of the curve by another. a90 at one value of an
unknown has the others at the middle of their effects: their average, not their stated values. Weak
priors keep what hardly any board tells finite. Intervals are percentiles over resampled boards,
stretched for the coefficients; with 36 boards they hold the truth in 85 to 98 % of studies.

Not modelled: interactions (blur may matter more where nothing stands behind), and effects that
are not linear over a range, of which a monotone one is still seen."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from scipy.special import ndtri, stdtrit

from harness.evaluation.intervals import CONFIDENCE, UPPER, Interval, percentiles
from harness.evaluation.pod.curve import ascend, link_ppf, logs_of_link, slopes_of_link
from harness.evaluation.pod.statement import POD
from harness.evaluation.study.boards import DRAWS, Targets, targets_of, weights_in_blocks
from harness.evaluation.study.record import DrawnUnknown, SetUpRecord

LINK = "logit"
SHIFT = 1.0
"""Standard deviation of the prior of what an unknown adds to mu: a factor of 2.7 of a50."""
WIDTH = 0.5
"""Standard deviation of the prior of what an unknown adds to ln s, and of ln s about its usual
value. Curves of through-holes have widths of 0.05 (backing 20 mm) to 0.1 (1 m), a factor of two."""
USUAL_WIDTH = float(np.log(0.1))
"""ln s of a usual curve."""
LEAST_BOARDS = 3
"""Fewest boards for each coefficient of mu."""


@dataclass(frozen=True, eq=False)
class UnknownEffect:
    """The effect of one unknown on a90."""

    unknown: DrawnUnknown
    """The unknown."""
    levels: tuple[Any, ...]
    """Its values (m,), or the ends of its range."""
    a90_mm: np.ndarray
    """a90 (m,) at each of them, averaged over the other unknowns."""
    intervals_mm: tuple[Interval, ...]
    """95 % interval (m,) of each of these over boards."""
    lowest_level: int
    """The index of the level with the smallest a90."""
    highest_level: int
    """The index of the level with the largest a90."""
    factor: float
    """The largest a90 over the smallest."""
    factor_interval: Interval
    """95 % interval over boards of the ratio of these two, whose lower end may lie below 1."""
    beyond_chance: bool
    """True if its interval excludes 1 at a confidence that allows for all pairs of levels."""


@dataclass(frozen=True, eq=False)
class OverUnknowns:
    """The effects of all unknowns of one set-up on a90."""

    effects: tuple[UnknownEffect, ...]
    """The unknowns, that with the largest factor first."""
    lowest_mm: float
    """Smallest a90 over all levels of the unknowns that move it beyond chance; without such an
    unknown, a90 at the average of all."""
    highest_mm: float
    """Largest a90, likewise."""
    why: str = ""
    """Reason why there are no effects; else empty."""

    @property
    def deciding(self) -> tuple[UnknownEffect, ...]:
        """The unknowns that move a90 beyond chance, largest first."""
        return tuple(effect for effect in self.effects if effect.beyond_chance)


@dataclass(frozen=True, eq=False)
class _Coded:
    """An unknown as columns of a design."""

    unknown: DrawnUnknown
    """The unknown."""
    levels: tuple[Any, ...]
    """Its values (m,), or the ends of its range."""
    codes: np.ndarray
    """Codes (m, k) of the levels, whose mean over all values is 0."""
    columns: np.ndarray
    """Codes (n, k) of the targets."""


def over_unknowns(record: SetUpRecord, draws: int = DRAWS) -> OverUnknowns | None:
    """Return what the unknowns of a set-up do to a90; None for a set-up that draws none.
    Deterministic."""
    if not record.drawn:
        return None
    inspected = record.inspected
    targets = targets_of(inspected.board, inspected.hole, inspected.size_mm, inspected.hit)
    coded_unknowns = [_coded(unknown, targets.board) for unknown in record.drawn]
    why = _no_effects(targets, coded_unknowns)
    if why:
        return OverUnknowns(effects=(), lowest_mm=np.nan, highest_mm=np.nan, why=why)
    constant = np.ones((len(targets.board), 1))
    design = np.hstack([constant, *[coded.columns for coded in coded_unknowns]])
    every_target_once = np.ones((1, len(targets.board)))
    fitted = _fitted(targets, design, every_target_once, None)
    resampled = _resampled(targets, design, fitted, draws)

    pairs = sum(math.comb(len(coded.levels), 2) for coded in coded_unknowns)
    effects = []
    first_column = 1
    for coded in coded_unknowns:
        end_column = first_column + coded.codes.shape[1]
        rows = np.zeros((len(coded.levels), design.shape[1]))
        rows[:, 0] = 1.0
        rows[:, first_column:end_column] = coded.codes
        first_column = end_column
        effects.append(_effect(coded, _a90_mm(fitted, rows), _a90_mm(resampled, rows), pairs))
    lowest_mm, highest_mm = _range_mm(fitted, coded_unknowns, effects)
    effects.sort(key=lambda effect: -effect.factor)
    return OverUnknowns(tuple(effects), lowest_mm, highest_mm)


def _resampled(targets: Targets, design: np.ndarray, fitted: np.ndarray, draws: int) -> np.ndarray:
    """Return the coefficients (draws, 2 k) of resampled boards, stretched about those of all boards
    ``fitted`` (1, 2 k)."""
    blocks = []
    for (weights,) in weights_in_blocks(draws, (targets.board, "damaged")):
        blocks.append(_fitted(targets, design, weights, fitted))
    stretch = _stretch(len(np.unique(targets.board)), fitted.shape[1])
    return np.asarray(fitted + stretch * (np.concatenate(blocks) - fitted))


def _coded(unknown: DrawnUnknown, board: np.ndarray) -> _Coded:
    """Return an unknown's columns for targets on these boards (n,)."""
    row_of_board = {number: row for row, number in enumerate(unknown.board.tolist())}
    rows = [row_of_board[number] for number in board.tolist()]
    drawn = unknown.level[rows]
    if unknown.range is not None:
        low, high = unknown.range
        middle = (low + high) / 2
        shares = (drawn - middle) / (high - low)
        return _Coded(
            unknown=unknown,
            levels=unknown.range,
            codes=np.array([[-0.5], [0.5]]),
            columns=shares[:, None],
        )
    levels = unknown.values or ()
    # one column for each level but the last, whose code is minus the sum of the others
    of_last = -np.ones(len(levels) - 1)
    codes = np.vstack([np.eye(len(levels) - 1), of_last])
    return _Coded(unknown=unknown, levels=levels, codes=codes, columns=codes[drawn.astype(int)])


def _stretch(boards: int, coefficients: int) -> float:
    """Return by how much resampled coefficients scatter too little: a fit takes up as many degrees
    of freedom as it has coefficients, and the rest follow Student's t."""
    degrees = boards - coefficients
    wider = float(stdtrit(degrees, UPPER) / ndtri(UPPER))
    return wider * float(np.sqrt(boards / degrees))


def _no_effects(targets: Targets, coded_unknowns: Sequence[_Coded]) -> str:
    """Return why the boards allow no effects; empty if they do."""
    hits = targets.hits.sum()
    if hits in (0, targets.inspections.sum()):
        return "all damages had the same outcome"
    if np.ptp(targets.size_mm) == 0:
        return "the size does not vary"
    columns = 1 + sum(coded.codes.shape[1] for coded in coded_unknowns)
    boards = len(np.unique(targets.board))
    needed = LEAST_BOARDS * columns
    if boards < needed:
        return f"{boards} boards are too few to tell the unknowns apart; {needed} are needed"
    return ""


def _fitted(
    targets: Targets, design: np.ndarray, weights: np.ndarray, start: np.ndarray | None
) -> np.ndarray:
    """Return the likeliest middles and widths (d, 2 k) of targets with ``weights`` (d, n), given
    the columns (n, k) of their unknowns: coefficients of mu, then of ln s. ``start``: those of all
    targets (1, 2 k), from which the search begins."""
    log_size = np.log(targets.size_mm)
    hits = weights * targets.hits
    misses = weights * (targets.inspections - targets.hits)
    columns = design.shape[1]
    expected = np.zeros(2 * columns)
    expected[columns] = USUAL_WIDTH
    precision = np.full(2 * columns, 1 / SHIFT**2)
    precision[0] = 0.0
    precision[columns:] = 1 / WIDTH**2
    precision *= targets.inspections.mean()  # repeats of the noise are no further targets

    def climb(b: np.ndarray, studies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return log-posteriors and scoring steps at b (d, 2 k), for `ascend`."""
        of_hits = hits[studies]
        of_misses = misses[studies]
        steepness = np.exp(-b[:, columns:] @ design.T)
        middle = b[:, :columns] @ design.T
        predictor = (log_size - middle) * steepness
        log_hit, log_miss, _ = logs_of_link(LINK, predictor)
        log_likelihood = (of_hits * log_hit + of_misses * log_miss).sum(axis=1)
        departure = b - expected
        value = log_likelihood - 0.5 * departure**2 @ precision

        up, down, _ = slopes_of_link(LINK, predictor)
        residual = of_hits * up - of_misses * down
        weight = (of_hits + of_misses) * up * down
        by_middle = -steepness[:, :, None] * design
        by_log_width = -predictor[:, :, None] * design
        slopes = np.concatenate([by_middle, by_log_width], axis=2)
        gradient = (residual[:, None, :] @ slopes)[:, 0] - precision * departure
        information = slopes.transpose(0, 2, 1) @ (weight[:, :, None] * slopes)
        information = information + np.diag(precision)
        step = np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
        return value, step

    if start is None:
        start = expected[None].copy()
        start[0, 0] = log_size.mean()
        start[0, columns] = 0.0  # wide: every target tells something
    begin = np.repeat(start, len(weights), axis=0)
    fitted, _ = ascend(climb, begin, 1e-5)
    return fitted


def _a90_mm(fitted: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return a90 (m, d) of fits (d, 2 k) at rows (m, k) of the design."""
    columns = rows.shape[1]
    middle = rows @ fitted[:, :columns].T
    width = np.exp(rows @ fitted[:, columns:].T)
    level = float(link_ppf(LINK, np.array(POD)))
    return np.asarray(np.exp(middle + width * level))


def _effect(coded: _Coded, a90_mm: np.ndarray, draws_mm: np.ndarray, pairs: int) -> UnknownEffect:
    """Return the effect of an unknown from a90 (m, 1) at its levels, and that of resampled boards
    (m, draws); all unknowns together have so many ``pairs`` of levels."""
    sizes_mm = a90_mm[:, 0]
    lowest = int(np.argmin(sizes_mm))
    highest = int(np.argmax(sizes_mm))
    factors = draws_mm[highest] / draws_mm[lowest]
    cautious_confidence = 1 - (1 - CONFIDENCE) / pairs
    cautious_interval = percentiles(factors, cautious_confidence)
    return UnknownEffect(
        unknown=coded.unknown,
        levels=coded.levels,
        a90_mm=sizes_mm,
        intervals_mm=tuple(percentiles(draws) for draws in draws_mm),
        lowest_level=lowest,
        highest_level=highest,
        factor=float(sizes_mm[highest] / sizes_mm[lowest]),
        factor_interval=percentiles(factors),
        beyond_chance=cautious_interval.above(1.0),
    )


def _range_mm(
    fitted: np.ndarray, coded_unknowns: Sequence[_Coded], effects: Sequence[UnknownEffect]
) -> tuple[float, float]:
    """Return the smallest and largest a90 over all levels of the unknowns that move it beyond
    chance."""
    choices = []
    for coded, effect in zip(coded_unknowns, effects, strict=True):
        no_shift = np.zeros((1, coded.codes.shape[1]))
        choices.append(coded.codes if effect.beyond_chance else no_shift)
    combinations = []
    for codes in product(*choices):
        combinations.append(np.concatenate([[1.0], *codes]))
    sizes_mm = _a90_mm(fitted, np.array(combinations))
    return float(sizes_mm.min()), float(sizes_mm.max())
