"""The effect of each unknown alone on a90, from boards of which each has unknowns of its own.

One model is fitted to all drawn boards: logit POD = (ln a - mu) / s, where mu and ln s are linear
in the unknowns, each coded with mean 0 over its values. So every board tells of every unknown; an
unknown multiplies a50 by a factor, and the width of the curve by another. a90 at one value of an
unknown has the others at the middle of their effects: their average, not their stated values. Weak
priors keep what hardly any board tells finite. Intervals are percentiles over resampled boards,
stretched for the coefficients; with 36 boards they hold the truth in 85 to 98 % of studies.

Not modelled: interactions (blur may matter more where nothing stands behind), and effects that
are not linear over a range, of which a monotone one is still seen."""

from __future__ import annotations

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


@dataclass(frozen=True, eq=False)
class _Boards:
    """Targets as a grid, one column for each board. All targets of a board have the same unknowns
    and are drawn together, so that sums over them need their sizes and outcomes alone, and only
    sums over boards the coefficients: a tenth of the time of a design with a row for each target.
    """

    design: np.ndarray
    """Columns (boards, k): a constant and the codes of the unknowns."""
    log_size: np.ndarray
    """Logarithm (rows, boards) of the sizes; that of the first target where a board has fewer."""
    hits: np.ndarray
    """Number of hits (rows, boards); 0 where a board has fewer targets."""
    misses: np.ndarray
    """Number of misses (rows, boards); 0 likewise."""

    @staticmethod
    def of(targets: Targets, coded_unknowns: Sequence[_Coded]) -> _Boards:
        """Return the grid of targets, which are sorted by their boards."""
        _, first, board, counts = np.unique(
            targets.board, return_index=True, return_inverse=True, return_counts=True
        )
        constant = np.ones((len(first), 1))
        columns = [coded.columns[first] for coded in coded_unknowns]
        row = np.arange(len(board)) - first[board]
        log_size = np.tile(np.log(targets.size_mm[first]), (counts.max(), 1))
        log_size[row, board] = np.log(targets.size_mm)
        hits = np.zeros_like(log_size)
        hits[row, board] = targets.hits
        misses = np.zeros_like(log_size)
        misses[row, board] = targets.inspections - targets.hits
        return _Boards(
            design=np.hstack([constant, *columns]), log_size=log_size, hits=hits, misses=misses
        )

    def likelihood(
        self, b: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the log-likelihood (d,), its gradient (d, 2 k) and the expected information
        (d, 2 k, 2 k) of studies with these ``weights`` (d, boards) at b (d, 2 k)."""
        columns = self.design.shape[1]
        middle = b[:, :columns] @ self.design.T
        steepness = np.exp(-b[:, columns:] @ self.design.T)
        predictor = (self.log_size - middle[:, None]) * steepness[:, None]

        def of_boards(of_targets: np.ndarray) -> np.ndarray:
            """Return the weighted sums (d, boards) of values (d, rows, boards)."""
            return np.asarray(weights * of_targets.sum(axis=1))

        log_hit, log_miss, _ = logs_of_link(LINK, predictor)
        value = of_boards(self.hits * log_hit + self.misses * log_miss).sum(axis=1)

        # the predictor falls by steepness with the middle, and by itself with the logarithm of the
        # width
        up, down, _ = slopes_of_link(LINK, predictor)
        residual = self.hits * up - self.misses * down
        by_middle = -(of_boards(residual) * steepness) @ self.design
        by_log_width = -of_boards(residual * predictor) @ self.design
        gradient = np.concatenate([by_middle, by_log_width], axis=1)

        weight = (self.hits + self.misses) * up * down
        weighted = weight * predictor
        middles = self._squares(of_boards(weight) * steepness**2)
        both = self._squares(of_boards(weighted) * steepness)
        widths = self._squares(of_boards(weighted * predictor))
        upper = np.concatenate([middles, both], axis=2)
        lower = np.concatenate([both, widths], axis=2)
        return value, gradient, np.concatenate([upper, lower], axis=1)

    def _squares(self, weights: np.ndarray) -> np.ndarray:
        """Return the design's weighted squares (d, k, k) for weights (d, boards)."""
        columns = self.design.shape[1]
        products = self.design[:, :, None] * self.design[:, None, :]
        flat = weights @ products.reshape(len(self.design), -1)
        return np.asarray(flat.reshape(-1, columns, columns))


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
    boards = _Boards.of(targets, coded_unknowns)
    every_board_once = np.ones((1, len(boards.design)))
    fitted = _fitted(boards, every_board_once, None)
    resampled = _resampled(targets, boards, fitted, draws)
    columns = boards.design.shape[1]

    pairs = sum(math.comb(len(coded.levels), 2) for coded in coded_unknowns)
    effects = []
    first_column = 1
    for coded in coded_unknowns:
        end_column = first_column + coded.codes.shape[1]
        rows = np.zeros((len(coded.levels), columns))
        rows[:, 0] = 1.0
        rows[:, first_column:end_column] = coded.codes
        first_column = end_column
        effects.append(_effect(coded, _a90_mm(fitted, rows), _a90_mm(resampled, rows), pairs))
    lowest_mm, highest_mm = _range_mm(fitted, coded_unknowns, effects)
    effects.sort(key=lambda effect: -effect.factor)
    return OverUnknowns(tuple(effects), lowest_mm, highest_mm)


def _resampled(targets: Targets, boards: _Boards, fitted: np.ndarray, draws: int) -> np.ndarray:
    """Return the coefficients (draws, 2 k) of resampled boards, stretched about those of all boards
    ``fitted`` (1, 2 k)."""
    _, first_target = np.unique(targets.board, return_index=True)
    blocks = []
    for (weights,) in weights_in_blocks(draws, (targets.board, "damaged")):
        blocks.append(_fitted(boards, weights[:, first_target], fitted))
    stretch = _stretch(len(boards.design), fitted.shape[1])
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


def _fitted(boards: _Boards, weights: np.ndarray, start: np.ndarray | None) -> np.ndarray:
    """Return the likeliest middles and widths (d, 2 k) of boards with ``weights`` (d, boards):
    coefficients of mu, then of ln s. ``start``: those of all boards (1, 2 k), from which the search
    begins."""
    columns = boards.design.shape[1]
    inspections = boards.hits + boards.misses
    expected = np.zeros(2 * columns)
    expected[columns] = USUAL_WIDTH
    precision = np.full(2 * columns, 1 / SHIFT**2)
    precision[0] = 0.0
    precision[columns:] = 1 / WIDTH**2
    # repeats of the noise are no further targets
    precision *= inspections[inspections > 0].mean()

    def climb(b: np.ndarray, studies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return log-posteriors and scoring steps at b (d, 2 k), for `ascend`."""
        value, gradient, information = boards.likelihood(b, weights[studies])
        departure = b - expected
        value = value - 0.5 * departure**2 @ precision
        gradient = gradient - precision * departure
        information = information + np.diag(precision)
        step = np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
        return value, step

    if start is None:
        start = expected[None].copy()
        start[0, 0] = boards.log_size[inspections > 0].mean()
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
