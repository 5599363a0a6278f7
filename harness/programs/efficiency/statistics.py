"""A detector's efficiency: the share of the ideal observer's signal that it uses.

Hits are fitted against the ideal observer's index d' of each damage instead of its size, by a
probit curve of ln d'. If a detector needs d'_p to find a share p and the ideal observer
d'_p,ideal, its efficiency is (d'_p,ideal / d'_p)^2: the share of independent pixels, or of frames
without a fixed pattern, that the ideal observer needs for the same result (Tanner and Birdsall, J.
Acoust. Soc. Am. 30 (1958), 922). It is unknown if d'_p was not inspected. Hits by missing returns
are left out, as the ideal observer does not use these."""

from dataclasses import dataclass

import numpy as np

from harness.evaluation.intervals import UNKNOWN, Interval, percentiles
from harness.evaluation.pod.curve import HitsAndMisses, PodCurve, maxima
from harness.evaluation.pod.hit_miss import fit_hit_miss
from harness.evaluation.study.boards import (
    DRAWS,
    Targets,
    crossings,
    refitted_sizes,
    weights_in_blocks,
)
from harness.evaluation.study.limit import SetUpLimit
from harness.programs.efficiency.ideal_observer import SHARES, IdealDamages
from harness.vocabulary.errors import UserError

LINK = "probit"
# least d'; smaller ones are raised to it: such damage is never found and must not decide the curve
LEAST_INDEX = 0.05
HARDLY = 0.5  # fewest expected hits, and misses, for a curve
HEAVY = 1.0  # excess kurtosis from which the noise no longer counts as Gaussian
# largest share of a board's pixels within damage that may return nothing without a warning
MOST_LOST = 0.01


@dataclass(frozen=True)
class Level:
    """Both observers at one share of damages found."""

    # Size that the ideal observer needs, millimetres; the smallest inspected if none is missed
    ideal_mm: float
    # Its 95 % interval
    ideal_mm_interval: Interval
    # Whether the ideal observer misses none, so that its size is an upper bound
    at_most: bool
    # d' that the ideal observer needs
    ideal_index: float
    # d' that the detector needs; NaN if unknown
    index: float
    # Its 95 % interval
    index_interval: Interval
    # (ideal_index / index)^2; NaN if unknown
    efficiency: float
    # Its 95 % interval
    interval: Interval


@dataclass(frozen=True, eq=False)
class Efficiency:
    """A set-up's detector and the ideal observer on n damages."""

    # The set-up and its limit
    limit: SetUpLimit
    # The ideal observer on all damages of the set-up
    ideal: IdealDamages
    # Both observers where 50 % of the damages are found
    half: Level
    # Both observers where 90 % of the damages are found
    most: Level
    # Number (n,) of each damage's board
    board: np.ndarray
    # Name (n,) of each damage
    hole: np.ndarray
    # Size (n,), millimetres
    size_mm: np.ndarray
    # d' (n,)
    index: np.ndarray
    # The ideal observer's threshold (n,); NaN if d' is 0
    threshold: np.ndarray
    # The ideal observer's probability of detection (n,)
    pod: np.ndarray
    # The detector's hits (n,)
    hits: np.ndarray
    # Number of inspections (n,)
    inspections: np.ndarray
    # The detector's POD against d'; None if no curve fits
    curve: PodCurve | None
    # Why the efficiency is unknown; empty if it is known
    why: str


def expected_sizes(x: np.ndarray, pod: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the values (2, d) of x (n,) with POD of 50 and 90 % on probit curves of ln x through
    shares ``pod`` (n,) with weights (d, n); infinite if hardly any is found, the smallest x if
    hardly any is missed."""
    log = np.log(x)
    centre = float(log.mean())
    spread = float(log.std()) or 1.0
    design = np.column_stack([np.ones_like(log), (log - centre) / spread])
    hits = weights * pod
    misses = weights * (1.0 - pod)
    sizes_mm = np.full((2, len(weights)), np.inf)
    has_curve = (hits.sum(axis=1) > HARDLY) & (misses.sum(axis=1) > HARDLY)
    fitted = maxima(
        HitsAndMisses(design, hits[has_curve], misses[has_curve], LINK), np.array([0.0, 1.0])
    )
    sizes_mm[:, has_curve] = np.exp(centre + spread * crossings(fitted, LINK, SHARES))
    sizes_mm[:, misses.sum(axis=1) <= HARDLY] = x.min()
    return sizes_mm


def efficiency_of(limit: SetUpLimit, ideal: IdealDamages) -> Efficiency:
    """Compare a detector's hits with the ideal observer on the damages that both judged."""
    inspected = limit.record.inspected
    hit = inspected.hit if inspected.by_depth is None else inspected.by_depth
    row_of_damage = {
        key: number
        for number, key in enumerate(zip(ideal.board.tolist(), ideal.hole.tolist(), strict=True))
    }
    rows = np.array(
        [
            row_of_damage[key]
            for key in zip(inspected.board.tolist(), inspected.hole.tolist(), strict=True)
        ]
    )
    kept, first, damage_index = np.unique(rows, return_index=True, return_inverse=True)
    size_mm = inspected.diameter_mm[first]
    pod = ideal.pod[kept]
    index = np.maximum(ideal.index[kept], LEAST_INDEX)
    hits = np.bincount(damage_index, hit)
    inspections = np.bincount(damage_index).astype(float)
    again = weights_in_blocks(DRAWS, (ideal.board[kept], "damaged"))
    weights = np.vstack([np.ones(len(kept)), *(weights for (weights,) in again)])
    ideal_mm = expected_sizes(size_mm, pod, weights)
    is_known = np.isfinite(ideal.needed[:, kept])
    with np.errstate(invalid="ignore"):
        ideal_index = (np.where(is_known, ideal.needed[:, kept], 0.0) @ weights.T) / (
            is_known @ weights.T
        )
    curve = None
    why = ""
    needed = np.full((2, 1 + DRAWS), np.nan)
    try:
        curve = fit_hit_miss(
            index[damage_index], hit, link=LINK, log_size=True, inspections=damage_index
        ).curve
        targets = Targets(ideal.board[kept], index, hits, inspections)
        needed[:, 0] = [curve.size_at(share) for share in SHARES]
        needed[:, 1:] = refitted_sizes(targets, curve, SHARES)
        inside = (needed[:, 0] >= index.min()) & (needed[:, 0] <= index.max())
        needed[~inside] = np.nan
        if not inside.all():
            wanted = " and ".join(f"{100 * share:.0f} %" for share in np.array(SHARES)[~inside])
            why = (
                f"the d' at which {wanted} are found was not inspected ({index.min():.2g} to "
                f"{index.max():.3g})"
            )
    except UserError as error:
        why = error.message
    all_found = bool((1.0 - pod).sum() <= HARDLY)
    return Efficiency(
        limit=limit,
        ideal=ideal,
        half=_level(ideal_mm[0], ideal_index[0], needed[0], all_found),
        most=_level(ideal_mm[1], ideal_index[1], needed[1], all_found),
        board=ideal.board[kept],
        hole=ideal.hole[kept],
        size_mm=size_mm,
        index=ideal.index[kept],
        threshold=ideal.threshold[kept],
        pod=pod,
        hits=hits,
        inspections=inspections,
        curve=curve,
        why=why,
    )


def _level(
    ideal_mm: np.ndarray, ideal_index: np.ndarray, needed: np.ndarray, all_found: bool
) -> Level:
    """Return one share of damages found, from arrays (1 + draws,) that begin with the estimate."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        share = (ideal_index / needed) ** 2
    of_index = percentiles(needed[1:]) if np.isfinite(needed[0]) else UNKNOWN
    of_share = percentiles(share[1:]) if np.isfinite(needed[0]) else UNKNOWN
    return Level(
        ideal_mm=float(ideal_mm[0]),
        ideal_mm_interval=percentiles(ideal_mm[1:]),
        at_most=all_found,
        ideal_index=float(ideal_index[0]),
        index=float(needed[0]),
        index_interval=of_index,
        efficiency=float(share[0]),
        interval=of_share,
    )


def warnings_of(rows: list[Efficiency]) -> list[str]:
    """Return sentences on reasons why the ideal observer's figures are unreliable."""
    warnings = []
    for row in rows:
        name = row.limit.record.label
        ideal = row.ideal
        if ideal.kurtosis > HEAVY:
            warnings.append(
                f"{name}: the noise has heavier tails than a Gaussian (excess kurtosis "
                f"{ideal.kurtosis:.2g}): the ideal"
                " observer for Gaussian noise is not the best detector there, and its rate "
                "of false calls differs"
            )
        if ideal.lost > MOST_LOST:
            warnings.append(
                f"{name}: up to {100 * ideal.lost:.2g} % of the pixels within a board's "
                "damage return nothing, which"
                " the ideal observer does not use: with missing returns more can be found"
            )
        if row.why:
            warnings.append(f"{name}: efficiency is not known: {row.why}")
    return warnings
