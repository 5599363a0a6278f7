"""Boards drawn again: a study draws boards at random, not damages, so whole boards are resampled
with replacement (cluster bootstrap; Davison and Hinkley 1997, section 3.8).

All draws of a study are refitted at once: row d of an array (draws, n) holds how often draw d has
the board of each of the n rows, which multiplies that row's hits and misses in the likelihood."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from harness.evaluation.pod.curve import (
    CELLS,
    HitsAndMisses,
    PodCurve,
    link_ppf,
    maxima,
    penalised_maxima,
    slopes_of_link,
)
from harness.vocabulary.seeds import random_stream

DRAWS = 500  # the 95 % percentile is then the 475th smallest, known to about one percentile


@dataclass(frozen=True, eq=False)
class Targets:
    """Damages, one per row."""

    board: np.ndarray
    """Board (n,) of each damage."""
    size_mm: np.ndarray
    """Size (n,) that the limit is of."""
    hits: np.ndarray
    """Number of hits (n,) among the inspections."""
    inspections: np.ndarray
    """Number of inspections (n,)."""
    unit: np.ndarray | None = None
    """Unit (n,) of the camera, if each unit's inspections of a damage are a separate row."""
    excess: np.ndarray | None = None
    """If each inspection is a row: its signal (n,) above the threshold, in standard errors of the
    threshold; infinite for a damage that is found at any threshold."""
    threshold: float = np.nan
    """The threshold: equal ones are drawn again alike, as from one calibration, and others
    independently."""


def targets_of(
    board: np.ndarray,
    hole: np.ndarray,
    size_mm: np.ndarray,
    hit: np.ndarray,
) -> Targets:
    """Combine rows (n,) of inspections into targets: repeats of one damage of one board are one
    target."""
    _, board_index = np.unique(board, return_inverse=True)
    _, hole_index = np.unique(hole, return_inverse=True)
    holes = hole_index.max(initial=0) + 1
    _, first_row, target_index = np.unique(
        board_index * holes + hole_index, return_index=True, return_inverse=True
    )
    return Targets(
        board=board[first_row],
        size_mm=size_mm[first_row],
        hits=np.bincount(target_index, np.asarray(hit, float)),
        inspections=np.bincount(target_index).astype(float),
    )


def weights_in_blocks(
    draws: int, *rows: tuple[np.ndarray, str]
) -> Iterator[tuple[np.ndarray, ...]]:
    """Resample boards for one or several (board (n,), population).

    Yields how often each draw has the board of each row, (draws, n) for each of ``rows``, in
    blocks of draws to limit the memory. Draws are the same for equal numbers of boards of a
    population, so set-ups are paired; two populations ("damaged", "hole-free") are drawn
    independently."""
    populations = []
    for board, population in rows:
        names, board_index = np.unique(board, return_inverse=True)
        stream = random_stream(0, "boards drawn again", population, len(names))
        populations.append((stream, len(names), board_index))
    most_rows = max(len(board_index) for _, _, board_index in populations)
    block = max(1, CELLS // max(1, most_rows))
    for first in range(0, draws, block):
        count = min(block, draws - first)
        weights = []
        for stream, boards, board_index in populations:
            weights.append(_times_drawn(stream, boards, count)[:, board_index])
        yield tuple(weights)


def _times_drawn(
    stream: np.random.Generator,
    boards: int,
    draws: int,
) -> np.ndarray:
    """Return how often each draw has each board, (draws, boards)."""
    if not boards:
        return np.zeros((draws, 0))
    return stream.multinomial(boards, np.full(boards, 1.0 / boards), size=draws).astype(float)


def refitted_sizes(
    targets: Targets,
    curve: PodCurve,
    pods: tuple[float, ...],
    draws: int = DRAWS,
) -> np.ndarray:
    """Refit ``curve``'s link and axis to resampled boards (and units, and drawn thresholds, where
    targets have them).

    Returns sizes (len(pods), draws) in mm, by Firth's likelihood if hits and misses are separated.
    Infinite if nothing is found or POD does not grow; smallest if all is found."""
    rows = [(targets.board, "damaged")]
    if targets.unit is not None:
        rows.append((targets.unit, "units"))
    sizes = []
    stream = random_stream(0, "thresholds drawn again", f"{targets.threshold:.5g}")
    for weights in weights_in_blocks(draws, *rows):
        product = np.multiply.reduce(weights)
        hits = hits_at(targets, stream.standard_normal(len(product)))
        sizes.append(_refitted(targets, curve, pods, weights=product, hits=hits))
    return np.concatenate(sizes, axis=1)


def hits_at(targets: Targets, shift: np.ndarray) -> np.ndarray:
    """Return the hits (d, n) at thresholds that are higher by ``shift`` (d,) standard errors; all
    rows of d are the hits in use if ``excess`` is not known.

    A finding beside a damage can be a signal that is no hit; it becomes none at a higher threshold
    and a hit at a lower one only if its signal lies between both."""
    hits = np.broadcast_to(targets.hits, (len(shift), len(targets.hits)))
    if targets.excess is None:
        return hits
    above = targets.excess > shift[:, None]
    gained = above & (targets.excess <= 0)
    return np.where(above, np.maximum(hits, gained), 0.0)


def size_per_error(targets: Targets, curve: PodCurve, pod: float) -> float:
    """Return by how much the logarithm of the size with this POD grows if the threshold is higher
    by one standard error, from thresholds 1.645 standard errors below and above; at least 0, and 0
    where a curve cannot be fitted to either."""
    if targets.excess is None:
        return 0.0
    shift = np.array([-1.645, 1.645])
    weights = np.ones((2, len(targets.hits)))
    hits = hits_at(targets, shift)
    low, high = _refitted(targets, curve, (pod,), weights=weights, hits=hits)[0]
    if not (0 < low < high < np.inf):
        return 0.0
    return float(np.log(high / low) / (shift[1] - shift[0]))


def _refitted(
    targets: Targets,
    curve: PodCurve,
    pods: tuple[float, ...],
    *,
    weights: np.ndarray,
    hits: np.ndarray,
) -> np.ndarray:
    """Refit the curve to targets with ``weights`` and ``hits``, both (draws, n)."""
    x = np.log(targets.size_mm) if curve.log_size else targets.size_mm
    centre = float(x.mean())
    spread = float(x.std()) or 1.0
    z = (x - centre) / spread
    design = np.column_stack([np.ones_like(z), z])
    misses = weights * (targets.inspections - hits)
    hits = weights * hits
    largest_miss = np.where(misses > 0, z, -np.inf).max(axis=1)
    smallest_hit = np.where(hits > 0, z, np.inf).min(axis=1)
    coefficients = np.full((len(weights), 2), np.nan)

    overlap = largest_miss > smallest_hit
    start = np.array([(centre - curve.mu) / curve.sigma, spread / curve.sigma])
    data = HitsAndMisses(design, hits, misses, curve.link)
    coefficients[overlap] = maxima(data.select(overlap), start)

    separated = np.isfinite(largest_miss) & np.isfinite(smallest_hit) & ~overlap
    if separated.any():
        repeats = (weights @ targets.inspections) / weights.sum(axis=1)
        data = HitsAndMisses(
            design=design,
            hits=hits[separated],
            misses=misses[separated],
            link=curve.link,
            penalty=repeats[separated],
        )
        coefficients[separated] = penalised_maxima(data, 1e-6)

    z_at_pods = crossings(coefficients, curve.link, pods)
    nothing_missed = largest_miss == -np.inf
    z_at_pods[:, nothing_missed] = z.min()
    x_at_pods = centre + spread * z_at_pods
    if not curve.log_size:
        return x_at_pods
    with np.errstate(over="ignore"):
        return np.asarray(np.exp(x_at_pods))


def crossings(
    b: np.ndarray,
    link: str,
    pods: tuple[float, ...],
) -> np.ndarray:
    """Return the sizes (len(pods), draws) at which curves ``b`` (draws, 2) have these PODs;
    infinite if none."""
    levels = link_ppf(link, np.array(pods))[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(b[:, 1] > 0, (levels - b[:, 0]) / b[:, 1], np.inf)


def design_effect(
    targets: Targets,
    curve: PodCurve,
    pod: float,
) -> float:
    """Return the variance of the size with this POD with boards as units over that with damages as
    units: 1 if damages of one board are no more alike than those of two; NaN below two boards.

    Both are sandwich variances (Liang and Zeger, Biometrika 73 (1986), 13): G / (G - 1) times the
    sum of squares of the damages' influences, summed within each of G units."""
    board_names, board_index = np.unique(targets.board, return_inverse=True)
    if len(board_names) < 2 or len(targets.board) < 3:
        return np.nan
    influence = _influence(targets, curve, pod)
    of_boards = _sandwich(np.bincount(board_index, influence))
    of_targets = _sandwich(influence)
    return of_boards / of_targets if of_targets > 0 else np.nan


def units_effect(rows: Targets, curve: PodCurve, pod: float) -> float:
    """Return the variance of the size with this POD with boards and units drawn over that with
    boards alone, at least 1, and 1 where it is not known; ``rows``: each unit's inspections of a
    damage.

    The variances of boards and of units add up, less that of their combinations, which both
    contain (Cameron, Gelbach and Miller, J. Business & Economic Statistics 29 (2011), 238)."""
    assert rows.unit is not None
    influence = _influence(rows, curve, pod)
    _, board = np.unique(rows.board, return_inverse=True)
    _, unit = np.unique(rows.unit, return_inverse=True)
    if min(board.max(), unit.max()) < 1:
        return 1.0  # a single board or unit tells nothing
    units = int(unit.max()) + 1
    _, combination = np.unique(board * units + unit, return_inverse=True)
    of_boards = _sandwich(np.bincount(board, influence))
    of_units = _sandwich(np.bincount(unit, influence))
    of_both = _sandwich(np.bincount(combination, influence))
    return 1.0 + max(of_units - of_both, 0.0) / of_boards if of_boards > 0 else 1.0


def _influence(targets: Targets, curve: PodCurve, pod: float) -> np.ndarray:
    """Return by how much each row (n,) moves the size with this POD, on the curve's axis.

    With the score s_i (2,) of a row and the information I (2, 2) of all, the size x_p moves by
    g' I^-1 s_i, where g (2,) holds the slopes of x_p = (level - b0) / b1 by b0 and b1."""
    x = np.log(targets.size_mm) if curve.log_size else targets.size_mm
    up, down, _ = slopes_of_link(curve.link, (x - curve.mu) / curve.sigma)
    score = targets.hits * up - (targets.inspections - targets.hits) * down
    design = np.column_stack([np.ones_like(x), x])
    x_at_pod = curve.mu + curve.sigma * float(link_ppf(curve.link, np.array(pod)))
    gradient = -curve.sigma * np.array([1.0, x_at_pod])
    information = design.T @ ((targets.inspections * up * down)[:, None] * design)
    return np.asarray((design * score[:, None]) @ np.linalg.solve(information, gradient))


def _sandwich(influence: np.ndarray) -> float:
    """Return the variance from the influence (G,) of each of G units."""
    units = len(influence)
    return float((influence**2).sum() * units / (units - 1))
