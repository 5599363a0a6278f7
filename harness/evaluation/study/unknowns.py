"""How far each unknown alone moves a90, from the boards of which each has unknowns of its own.

One curve is fitted to all drawn boards: logit POD = b0 + b1 ln a + c x, where x (k,) codes the
unknowns, each with mean 0 over its values. So every board tells of every unknown, and a90 at one
value of an unknown is (logit 0.9 - b0 - c x) / b1 with the others at the middle of their effects:
their average, not their stated values. Where hits say so, an unknown also changes the slope
(a surface far behind a hole makes the curve flat as well as late). Intervals are percentiles over
resampled boards.

Not modelled: interactions (blur may matter more where nothing stands behind), and effects that
are not linear over a range, of which a monotone one is still seen."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from scipy.stats import chi2

from harness.evaluation.intervals import CONFIDENCE, Interval, percentiles
from harness.evaluation.pod.curve import HitsAndMisses, link_ppf, maxima
from harness.evaluation.pod.statement import POD
from harness.evaluation.study.boards import DRAWS, Targets, targets_of, weights_in_blocks
from harness.evaluation.study.record import DrawnUnknown, SetUpRecord

LINK = "logit"
LEVEL = 0.05
"""An unknown has a slope of its own below this p-value, over the number of unknowns."""
WEAK = 0.1
"""Size of a column in its pseudo-observation, which is half a hit: a prior of standard deviation
2 / 0.1 = 20 for a coefficient, which keeps those of separated data finite. A backing 1 m away
instead of 20 mm moves the logit by some 9."""
LEAST_BOARDS = 3
"""Fewest boards for each coefficient."""


@dataclass(frozen=True, eq=False)
class UnknownEffect:
    """What one unknown does to a90."""

    unknown: DrawnUnknown
    """The unknown."""
    levels: tuple[Any, ...]
    """Its values (m,), or the ends of its range."""
    a90_mm: np.ndarray
    """a90 (m,) at each of them, averaged over the other unknowns; infinite if none."""
    intervals_mm: tuple[Interval, ...]
    """95 % interval (m,) of each of these over boards."""
    least: int
    """The level with the smallest a90."""
    most: int
    """The level with the largest a90."""
    factor: float
    """The largest a90 over the smallest."""
    factor_interval: Interval
    """95 % interval of that ratio over boards; it can lie below 1."""
    beyond_chance: bool
    """True if its interval excludes 1 at a confidence that allows for all pairs of levels."""


@dataclass(frozen=True, eq=False)
class OverUnknowns:
    """What all unknowns of one set-up do to a90."""

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
    levels: tuple[Any, ...]
    codes: np.ndarray
    """Codes (m, k) of the levels, whose mean over all values is 0."""
    columns: np.ndarray
    """Codes (n, k) of the targets."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """Curves (d,) of targets and unknowns."""

    b: np.ndarray
    """Coefficients (d, p)."""
    shift: Sequence[np.ndarray]
    """Of each unknown, its coefficients (d, k)."""
    turn: Sequence[np.ndarray]
    """Of each unknown, the coefficients (d, k) of its columns times z; 0 without a slope of its
    own."""
    middle: float
    """Mean of ln a."""
    spread: float
    """Standard deviation of ln a."""

    def a90_mm(self, codes: dict[int, np.ndarray]) -> np.ndarray:
        """Return a90 (d,) at these codes (k,) of unknowns, by number, and the others at 0."""
        level = float(link_ppf(LINK, np.array(POD)))
        rise = level - self.b[:, 0]
        slope = self.b[:, 1]
        for number, code in codes.items():
            rise = rise - self.shift[number] @ code
            slope = slope + self.turn[number] @ code
        with np.errstate(all="ignore"):
            size_mm = np.exp(self.middle + self.spread * rise / slope)
        return np.where(slope > 0, size_mm, np.inf)


def over_unknowns(record: SetUpRecord, draws: int = DRAWS) -> OverUnknowns | None:
    """Return what the unknowns of a set-up do to a90; None for a set-up that draws none.
    Deterministic."""
    if not record.drawn:
        return None
    inspected = record.inspected
    targets = targets_of(inspected.board, inspected.hole, inspected.size_mm, inspected.hit)
    coded = [_coded(unknown, targets.board) for unknown in record.drawn]
    if why := _no_effects(targets, coded):
        return OverUnknowns((), np.nan, np.nan, why)
    sloped = _with_own_slope(targets, coded)
    one = np.ones((1, len(targets.board)))
    fit = _fitted(targets, coded, sloped, one)
    redrawn = []
    for (weights,) in weights_in_blocks(draws, (targets.board, "damaged")):
        redrawn.append(_fitted(targets, coded, sloped, weights))
    pairs = sum(len(of.levels) * (len(of.levels) - 1) // 2 for of in coded)
    effects = []
    for number, of in enumerate(coded):
        effects.append(_effect(of, number, fit, redrawn, pairs))
    lowest_mm, highest_mm = _range_mm(fit, coded, effects)
    effects.sort(key=lambda effect: -effect.factor)
    return OverUnknowns(tuple(effects), lowest_mm, highest_mm)


def _coded(unknown: DrawnUnknown, board: np.ndarray) -> _Coded:
    """Return an unknown's columns for targets on these boards (n,)."""
    row_of_board = {number: row for row, number in enumerate(unknown.board.tolist())}
    drawn = unknown.level[[row_of_board[number] for number in board.tolist()]]
    if unknown.range is not None:
        low, high = unknown.range
        columns = ((drawn - (low + high) / 2) / (high - low))[:, None]
        return _Coded(unknown, unknown.range, np.array([[-0.5], [0.5]]), columns)
    levels = unknown.values or ()
    codes = np.vstack([np.eye(len(levels) - 1), -np.ones(len(levels) - 1)])
    return _Coded(unknown, levels, codes, codes[drawn.astype(int)])


def _no_effects(targets: Targets, coded: Sequence[_Coded]) -> str:
    """Return why the boards allow no effects; empty if they do."""
    hits = targets.hits.sum()
    if hits in (0, targets.inspections.sum()):
        return "all damages had the same outcome"
    if np.ptp(targets.size_mm) == 0:
        return "the size does not vary"
    coefficients = 2 + sum(of.codes.shape[1] for of in coded)
    boards = len(np.unique(targets.board))
    if boards < LEAST_BOARDS * coefficients:
        needed = LEAST_BOARDS * coefficients
        return f"{boards} boards are too few to tell the unknowns apart; {needed} are needed"
    return ""


def _with_own_slope(targets: Targets, coded: Sequence[_Coded]) -> list[int]:
    """Return the numbers of the unknowns that change the slope, by likelihood ratio."""
    repeats = float(targets.inspections.mean())
    one = np.ones((1, len(targets.board)))
    data, start = _data(targets, coded, [], one)
    plain = float(data.value(maxima(data, start))[0])
    sloped = []
    for number, of in enumerate(coded):
        data, start = _data(targets, coded, [number], one)
        ratio = 2 * (float(data.value(maxima(data, start))[0]) - plain) / repeats
        if chi2.sf(ratio, of.codes.shape[1]) < LEVEL / len(coded):
            sloped.append(number)
    return sloped


def _data(
    targets: Targets, coded: Sequence[_Coded], sloped: Sequence[int], weights: np.ndarray
) -> tuple[HitsAndMisses, np.ndarray]:
    """Return the likelihood of targets with ``weights`` (d, n), and the start of a search. A
    pseudo-observation of half a hit and half a miss, with all else 0, stands for each column but
    the constant."""
    log_size = np.log(targets.size_mm)
    z = (log_size - log_size.mean()) / log_size.std()
    columns = [np.ones_like(z)[:, None], z[:, None]]
    columns += [of.columns for of in coded]
    columns += [coded[number].columns * z[:, None] for number in sloped]
    design = np.hstack(columns)
    weak = WEAK * np.eye(design.shape[1])[1:]
    half = np.full((len(weights), len(weak)), 0.5)
    misses = targets.inspections - targets.hits
    data = HitsAndMisses(
        design=np.vstack([design, weak]),
        hits=np.hstack([weights * targets.hits, half]),
        misses=np.hstack([weights * misses, half]),
        link=LINK,
    )
    start = np.zeros(design.shape[1])
    start[1] = 1.0
    return data, start


def _fitted(
    targets: Targets, coded: Sequence[_Coded], sloped: Sequence[int], weights: np.ndarray
) -> _Fit:
    """Fit the curves of targets with ``weights`` (d, n)."""
    data, start = _data(targets, coded, sloped, weights)
    b = maxima(data, start)
    shift = []
    column = 2
    for of in coded:
        shift.append(b[:, column : column + of.codes.shape[1]])
        column += of.codes.shape[1]
    turn = [np.zeros_like(part) for part in shift]
    for number in sloped:
        width = coded[number].codes.shape[1]
        turn[number] = b[:, column : column + width]
        column += width
    log_size = np.log(targets.size_mm)
    return _Fit(b, shift, turn, float(log_size.mean()), float(log_size.std()))


def _effect(
    of: _Coded, number: int, fit: _Fit, redrawn: Sequence[_Fit], pairs: int
) -> UnknownEffect:
    """Return the effect of the unknown of this number, one of several with so many ``pairs`` of
    levels."""
    a90_mm = []
    draws_mm = []
    for code in of.codes:
        a90_mm.append(fit.a90_mm({number: code})[0])
        draws_mm.append(np.concatenate([part.a90_mm({number: code}) for part in redrawn]))
    least = int(np.argmin(a90_mm))
    most = int(np.argmax(a90_mm))
    with np.errstate(invalid="ignore"):
        factor = float(np.divide(a90_mm[most], a90_mm[least]))
        factors = draws_mm[most] / draws_mm[least]
    cautious = percentiles(factors, 1 - (1 - CONFIDENCE) / pairs)
    return UnknownEffect(
        unknown=of.unknown,
        levels=of.levels,
        a90_mm=np.array(a90_mm),
        intervals_mm=tuple(percentiles(draws) for draws in draws_mm),
        least=least,
        most=most,
        factor=factor if least != most else 1.0,
        factor_interval=percentiles(factors),
        beyond_chance=cautious.above(1.0),
    )


def _range_mm(
    fit: _Fit, coded: Sequence[_Coded], effects: Sequence[UnknownEffect]
) -> tuple[float, float]:
    """Return the smallest and largest a90 over all levels of the unknowns that move it beyond
    chance."""
    deciding = [number for number, effect in enumerate(effects) if effect.beyond_chance]
    sizes_mm = []
    for codes in product(*(coded[number].codes for number in deciding)):
        sizes_mm.append(float(fit.a90_mm(dict(zip(deciding, codes, strict=True)))[0]))
    return min(sizes_mm), max(sizes_mm)
