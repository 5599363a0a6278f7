"""Common effects of boards: curves refitted to boards drawn again, and the design effect of damages sharing boards.

Damages of one board share its shape, its pose and its render, so boards, not damages, are what a study draws at random.
Whole boards are therefore resampled with replacement (the cluster bootstrap; Davison and Hinkley 1997, section 3.8).
Weights depend on the number of boards alone: two set-ups of the same boards get the same draws, and the differences of
their limits are paired. Not modelled: boards drawn from another family than the study's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.evaluation.pod.curve import PodCurve, link_ppf, slopes_of_link
from harness.evaluation.pod.likelihood import HitsAndMisses, maxima, penalised_maxima
from harness.vocabulary.seeds import random_stream

DRAWS = 500
"""The 95 % percentile is then the 475th smallest, known to about one percentile."""


@dataclass(frozen=True, eq=False)
class Targets:
    """Damages, one a row: ``board`` (n,), ``size_mm`` (n,), ``hits`` of ``inspections`` (n,)."""

    board: np.ndarray
    size_mm: np.ndarray
    hits: np.ndarray
    inspections: np.ndarray

    @property
    def boards(self) -> int:
        """Number of different boards."""
        return len(np.unique(self.board))


def targets_of(board: np.ndarray, hole: np.ndarray, size_mm: np.ndarray, hit: np.ndarray) -> Targets:
    """Join rows (n,) of inspections to targets: repeats of one damage of one board are one target."""
    _, boards = np.unique(board, return_inverse=True)
    _, holes = np.unique(hole, return_inverse=True)
    _, first, which = np.unique(boards * (holes.max(initial=0) + 1) + holes, return_index=True, return_inverse=True)
    hits, inspections = np.bincount(which, np.asarray(hit, float)), np.bincount(which).astype(float)
    return Targets(board[first], size_mm[first], hits, inspections)


def board_weights(boards: int, draws: int = DRAWS, population: str = "damaged") -> np.ndarray:
    """Draw boards again: (draws, boards) how often each is in each draw; the same for the same number of boards of a
    population, so that set-ups are paired; two populations ("damaged", "hole-free") are drawn independently."""
    stream = random_stream(0, "boards drawn again", population, boards)
    return stream.multinomial(boards, np.full(boards, 1.0 / boards), size=draws).astype(float)


def row_weights(board: np.ndarray, draws: int = DRAWS, population: str = "damaged") -> np.ndarray:
    """Lay `board_weights` on rows that belong to ``board`` (n,): (draws, n)."""
    names, which = np.unique(board, return_inverse=True)
    return board_weights(len(names), draws, population)[:, which]


def refitted_sizes(targets: Targets, curve: PodCurve, pods: tuple[float, ...], draws: int = DRAWS) -> np.ndarray:
    """Refit ``curve``'s link and axis to boards drawn again: (len(pods), draws) sizes in mm with these PODs.

    A draw is fitted as `harness.evaluation.pod.hit_miss` fits a study: by Firth's penalised likelihood where its hits
    and misses do not overlap. Without an estimate in a draw: infinite where nothing is found or the chance does not
    grow with size; the smallest size inspected where everything is found.
    """
    x = np.log(targets.size_mm) if curve.log_size else targets.size_mm
    centre, spread = float(x.mean()), float(x.std()) or 1.0
    z = (x - centre) / spread
    weights = row_weights(targets.board, draws)
    hits, misses = weights * targets.hits, weights * (targets.inspections - targets.hits)
    largest_miss = np.where(misses > 0, z, -np.inf).max(axis=1)
    smallest_hit = np.where(hits > 0, z, np.inf).min(axis=1)
    repeats = (weights @ targets.inspections) / weights.sum(axis=1)
    data = HitsAndMisses(np.column_stack([np.ones_like(z), z]), hits, misses, curve.link)
    start = np.array([(centre - curve.mu) / curve.sigma, spread / curve.sigma])
    b = np.full((draws, 2), np.nan)
    overlap = largest_miss > smallest_hit
    b[overlap] = maxima(data.of(overlap), start)
    apart = np.isfinite(largest_miss) & np.isfinite(smallest_hit) & ~overlap
    if apart.any():
        some = HitsAndMisses(data.design, hits[apart], misses[apart], curve.link, repeats[apart])
        b[apart] = penalised_maxima(some, 1e-6)
    at = crossings(b, curve.link, pods)
    at[:, largest_miss == -np.inf] = z.min()
    with np.errstate(over="ignore"):
        return np.asarray(np.exp(centre + spread * at) if curve.log_size else centre + spread * at)


def crossings(b: np.ndarray, link: str, pods: tuple[float, ...]) -> np.ndarray:
    """Sizes (len(pods), draws) at which curves ``b`` (draws, 2) have these PODs; infinite where flat or unknown."""
    levels = link_ppf(link, np.array(pods))[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(b[:, 1] > 0, (levels - b[:, 0]) / b[:, 1], np.inf)


def design_effect(targets: Targets, curve: PodCurve, pod: float) -> float:
    """Variance of the size with this POD when boards are the units over that when damages are: 1 where damages of one
    board are no more alike than those of two, more where boards matter.

    Both are sandwich variances (Liang and Zeger, Biometrika 73 (1986), 13) with G / (G - 1) for G units, so that the
    model's own errors are in both. From G boards the ratio itself is known to about sqrt(2 / G). NaN below two boards.
    """
    if targets.boards < 2 or len(targets.board) < 3:
        return np.nan
    x = np.log(targets.size_mm) if curve.log_size else targets.size_mm
    up, down, _ = slopes_of_link(curve.link, (x - curve.mu) / curve.sigma)
    slope = targets.hits * up - (targets.inspections - targets.hits) * down
    design = np.column_stack([np.ones_like(x), x])
    # x_p = (level - b0) / b1: its slopes by b0 and b1.
    gradient = -curve.sigma * np.array([1.0, curve.mu + curve.sigma * float(link_ppf(curve.link, np.array(pod)))])
    information = design.T @ ((targets.inspections * up * down)[:, None] * design)
    influence = (design * slope[:, None]) @ np.linalg.solve(information, gradient)
    _, which = np.unique(targets.board, return_inverse=True)
    of_boards, of_targets = (
        float((one**2).sum() * len(one) / (len(one) - 1)) for one in (np.bincount(which, influence), influence)
    )
    return of_boards / of_targets if of_targets > 0 else np.nan
