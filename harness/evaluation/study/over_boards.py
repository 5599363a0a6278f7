"""What boards have in common: curves refitted to boards drawn again, and the design effect of damages sharing boards.

Damages of one board share its shape, its pose and its render, so boards, not damages, are what a study draws at random.
Whole boards are therefore resampled with replacement (the cluster bootstrap; Davison and Hinkley 1997, section 3.8).
Weights depend on the number of boards alone: two set-ups of the same boards get the same draws, and the differences of
their limits are paired. Not modelled: boards drawn from another family than the study's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.evaluation.intervals import CONFIDENCE, UNKNOWN, Interval
from harness.evaluation.pod.curve import PodCurve, link_ppf
from harness.evaluation.pod.likelihood import logs_of_link, slope_of_log_density
from harness.evaluation.study.penalised import penalised_maxima
from harness.vocabulary.seeds import random_stream

DRAWS = 500
"""The 95 % percentile is then the 475th smallest, known to about one percentile."""
STEPS = 60
"""Newton steps and halvings of a draw; from the study's own fit five or six do."""


@dataclass(frozen=True, eq=False)
class Targets:
    """Damages, one a row: ``board`` (n,), ``size_mm`` (n,), ``hits`` of ``inspections`` (n,)."""

    board: np.ndarray
    size_mm: np.ndarray
    hits: np.ndarray
    inspections: np.ndarray

    @property
    def boards(self) -> int:
        """Different boards."""
        return len(np.unique(self.board))


def targets_of(board: np.ndarray, hole: np.ndarray, size_mm: np.ndarray, hit: np.ndarray) -> Targets:
    """Rows (n,) of inspections as targets: repeats of one damage of one board are one target."""
    _, boards = np.unique(board, return_inverse=True)
    _, holes = np.unique(hole, return_inverse=True)
    _, first, which = np.unique(boards * (holes.max(initial=0) + 1) + holes, return_index=True, return_inverse=True)
    return Targets(
        board[first], size_mm[first], np.bincount(which, np.asarray(hit, float)), np.bincount(which).astype(float)
    )


def board_weights(boards: int, draws: int = DRAWS, population: str = "damaged") -> np.ndarray:
    """(draws, boards) how often each board is in each draw: the same for the same number of boards of a population, so
    that set-ups are paired; boards of two populations ("damaged", "hole-free") are drawn independently."""
    stream = random_stream(0, "boards drawn again", population, boards)
    return stream.multinomial(boards, np.full(boards, 1.0 / boards), size=draws).astype(float)


def row_weights(board: np.ndarray, draws: int = DRAWS, population: str = "damaged") -> np.ndarray:
    """(draws, n) `board_weights` laid on rows that belong to ``board`` (n,)."""
    names, which = np.unique(board, return_inverse=True)
    return board_weights(len(names), draws, population)[:, which]


def percentiles(values: np.ndarray, confidence: float = CONFIDENCE) -> Interval:
    """The percentile interval of draws (B,); NaN ones are left out, and where they are more than half it is unknown."""
    known = values[~np.isnan(values)]
    if len(known) < 2 or len(known) < 0.5 * len(values):
        return UNKNOWN
    low, high = np.quantile(known, [(1 - confidence) / 2, (1 + confidence) / 2], method="inverted_cdf")
    return Interval(float(low), float(high))


def refitted_sizes(targets: Targets, curve: PodCurve, pods: tuple[float, ...], draws: int = DRAWS) -> np.ndarray:
    """(len(pods), draws) sizes in mm with these PODs, ``curve``'s link and axis refitted to boards drawn again as
    `harness.evaluation.pod.hit_miss` fits one study: by Firth's penalty where hits and misses do not overlap."""
    x = np.log(targets.size_mm) if curve.log_size else targets.size_mm
    centre, spread = float(x.mean()), float(x.std()) or 1.0
    z = (x - centre) / spread
    weights = row_weights(targets.board, draws)
    hits, misses = weights * targets.hits, weights * (targets.inspections - targets.hits)
    start = np.array([(centre - curve.mu) / curve.sigma, spread / curve.sigma])
    repeats = (weights @ targets.inspections) / weights.sum(axis=1)
    at = fitted_sizes(z, hits, misses, curve.link, start, pods, repeats)
    back = centre + spread * at
    with np.errstate(over="ignore"):
        return np.exp(back) if curve.log_size else back


def fitted_sizes(
    z: np.ndarray,
    hits: np.ndarray,
    misses: np.ndarray,
    link: str,
    start: np.ndarray,
    pods: tuple[float, ...],
    repeats: np.ndarray | None = None,
) -> np.ndarray:
    """(len(pods), draws) sizes with these PODs, by curves fitted to each draw's ``hits`` and ``misses`` (draws, n) at
    sizes ``z`` (n,); ``start`` (2,): coefficients that the search begins with.

    Without an estimate in a draw: infinite where nothing is found or the chance does not grow with size; the smallest
    size inspected where everything is found. Where hits and misses do not overlap, the curve by Firth's penalised
    likelihood with ``repeats`` (draws,) inspections of a target; the middle of the gap, for all PODs, without them.
    """
    largest_miss = np.where(misses > 0, z, -np.inf).max(axis=1)
    smallest_hit = np.where(hits > 0, z, np.inf).min(axis=1)
    at: np.ndarray = np.full((len(pods), len(hits)), np.inf)
    at[:, largest_miss == -np.inf] = z.min()
    apart = np.isfinite(largest_miss) & np.isfinite(smallest_hit) & (largest_miss <= smallest_hit)
    levels = np.asarray(link_ppf(link, np.array(pods)))[:, None]
    if repeats is None:
        at[:, apart] = 0.5 * (largest_miss + smallest_hit)[apart]
    elif apart.any():
        at[:, apart] = _crossings(penalised_maxima(z, hits[apart], misses[apart], link, repeats[apart]), levels)
    overlap = (largest_miss > smallest_hit).nonzero()[0]
    design = np.column_stack([np.ones_like(z), z])
    at[:, overlap] = _crossings(weighted_maxima(design, hits[overlap], misses[overlap], link, start), levels)
    return at


def _crossings(b: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """(levels, draws) sizes at which curves ``b`` (draws, 2) reach predictors ``levels`` (k, 1); infinite if flat."""
    b0, b1 = b.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(b1 > 0, (levels - b0) / b1, np.inf)


def design_effect(targets: Targets, curve: PodCurve, pod: float) -> float:
    """Variance of the size with this POD when boards are the units over that when damages are: 1 where damages of one
    board are no more alike than those of two, more where boards matter.

    Both are sandwich variances (Liang and Zeger, Biometrika 73 (1986), 13) with G / (G - 1) for G units, so that the
    model's own errors are in both. From G boards the ratio itself is known to about sqrt(2 / G). NaN below two boards.
    """
    if targets.boards < 2 or len(targets.board) < 3:
        return np.nan
    x = np.log(targets.size_mm) if curve.log_size else targets.size_mm
    slope, weight = _score(curve.link, (x - curve.mu) / curve.sigma, targets.hits, targets.inspections - targets.hits)
    design = np.column_stack([np.ones_like(x), x])
    # x_p = (level - b0) / b1: its slopes by b0 and b1.
    gradient = -curve.sigma * np.array([1.0, curve.mu + curve.sigma * float(link_ppf(curve.link, np.array(pod)))])
    toward = np.linalg.solve(design.T @ (weight[:, None] * design), gradient)
    influence = (design * slope[:, None]) @ toward
    _, which = np.unique(targets.board, return_inverse=True)
    of_boards, of_targets = (_sandwich(one) for one in (np.bincount(which, influence), influence))
    return of_boards / of_targets if of_targets > 0 else np.nan


def _sandwich(influence: np.ndarray) -> float:
    units = len(influence)
    return float((influence**2).sum() * units / (units - 1))


def _score(link: str, predictor: np.ndarray, hits: np.ndarray, misses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slope of the log-likelihood by the predictor, and its expected information, of rows of counts."""
    logs = logs_of_link(link, predictor)
    slope = hits * np.exp(logs.log_density - logs.log_hit) - misses * np.exp(logs.log_density - logs.log_miss)
    return slope, (hits + misses) * np.exp(2.0 * logs.log_density - logs.log_hit - logs.log_miss)


def weighted_maxima(
    design: np.ndarray, hits: np.ndarray, misses: np.ndarray, link: str, start: np.ndarray
) -> np.ndarray:
    """(draws, p) coefficients of ``design`` (n, p) with the largest likelihood of ``hits`` and ``misses`` (draws, n).

    Newton's method on all draws at once from ``start`` (p,), on a likelihood that is concave for all four links; a step
    that lowers it is halved, a draw that has arrived rests. Hits and misses of every draw must overlap, else its
    coefficients end where the steps ran out.
    """
    place = np.tile(np.asarray(start, float), (len(hits), 1))
    best = np.full(len(hits), -np.inf)
    step = np.zeros_like(place)
    moving = np.arange(len(hits))
    for _ in range(STEPS):
        if not len(moving):
            break
        trial = place[moving] + step[moving]
        predictor = trial @ design.T
        logs = logs_of_link(link, predictor)
        k, m = hits[moving], misses[moving]
        value = (k * logs.log_hit + m * logs.log_miss).sum(axis=1)
        better = value >= best[moving] - 1e-13 * np.abs(value)
        step[moving[~better]] *= 0.5
        ahead = moving[better]
        place[ahead], best[ahead] = trial[better], np.maximum(value[better], best[ahead])
        up, down = np.exp(logs.log_density - logs.log_hit), np.exp(logs.log_density - logs.log_miss)
        bend = slope_of_log_density(link, predictor)
        slope = k * up - m * down
        weight = k * up * np.maximum(up - bend, 0.0) + m * down * np.maximum(down + bend, 0.0)
        step[ahead] = _steps(design, slope[better], weight[better])
        moving = moving[np.abs(step[moving]).max(axis=1) > 1e-7 * (1.0 + np.abs(place[moving]).max(axis=1))]
    return place


def _steps(design: np.ndarray, slope: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(draws, p) Newton steps; a singular information, of draws that have run off to infinity, gives none."""
    p = design.shape[1]
    products = (design[:, :, None] * design[:, None, :]).reshape(len(design), p * p)
    information = (weight @ products).reshape(-1, p, p)
    ridge = 1e-12 * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(p) + 1e-300 * np.eye(p)
    return np.asarray(np.linalg.solve(information + ridge, (slope @ design)[:, :, None])[:, :, 0])
