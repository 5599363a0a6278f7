"""Hits by chance: how often a damage would be found though the detector saw nothing of it.

Positions are shuffled: the places of one board's damage are laid over the findings of every other run that count for no
damage, on damaged boards and on hole-free ones. The share of places with one within the hit radius is the probability
of a chance hit, and the floor that a POD curve must be read against. Shuffling keeps where on a board damage and false
calls tend to be, which a rate per area does not. Not modelled: false calls that real damage brings about.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.intervals import UNKNOWN, Interval, clopper_pearson
from harness.evaluation.pod.false_calls import FalseCallRate
from harness.evaluation.study.over_boards import DRAWS, board_weights, percentiles, row_weights

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ChanceHits:
    """``probability`` by shuffling, from ``laid`` pairs of a place and another board's run, with ``interval`` over
    boards (where none was seen, up to ``expected_upper``). ``expected``, ``expected_upper``: 1 - exp(-rate pi r^2) at
    the false-call rate and its upper bound, were calls spread evenly; NaN without hole-free boards. ``found`` of
    ``sites`` unflawed places (repeats of a place as shares of it) were found: ``of_sites`` with Clopper and Pearson's
    ``sites_interval`` and ``sites_over_boards`` (unknown where none was)."""

    probability: float
    interval: Interval
    laid: int
    expected: float
    expected_upper: float
    found: float
    sites: int
    of_sites: float
    sites_interval: Interval
    sites_over_boards: Interval

    def without(self, pod: float) -> float:
        """POD by sight alone: (POD - chance) / (1 - chance), 0 where chance explains all."""
        return max(0.0, (pod - self.probability) / (1 - self.probability)) if self.probability < 1 else 0.0


def chance_hits(
    holes: pd.DataFrame,
    sites: pd.DataFrame,
    runs: pd.DataFrame,
    findings: pd.DataFrame,
    radius_mm: float,
    rate: FalseCallRate | None = None,
    draws: int = DRAWS,
) -> ChanceHits:
    """Chance hits of one set-up at one number of frames, from its rows of the study's tables."""
    places = holes.drop_duplicates(["board", "hole"])
    damaged, flawless = (_hit_counts(places, runs, findings, role, radius_mm) for role in ("damaged", "hole_free"))
    probability, laid, drawn = _shuffled(places, damaged, flawless, draws)
    area_m2 = np.pi * (radius_mm / 1000) ** 2
    found, n, over_boards = _sites(sites, draws)
    low, high = clopper_pearson(found, n)
    expected_upper = np.nan if rate is None else float(-np.expm1(-rate.upper_per_m2 * area_m2))
    return ChanceHits(
        probability=probability,
        # Boards drawn again from boards without one have none either, which is no certainty.
        interval=percentiles(drawn) if probability > 0 else Interval(0.0, expected_upper),
        laid=laid,
        expected=np.nan if rate is None else float(-np.expm1(-rate.rate_per_m2 * area_m2)),
        expected_upper=expected_upper,
        found=found,
        sites=n,
        of_sites=found / n if n else np.nan,
        sites_interval=Interval(float(low), float(high)),
        sites_over_boards=over_boards,
    )


@dataclass(frozen=True, eq=False)
class _Counts:
    """``hits`` (i, j): places of damaged board i that have a finding of board j near, over all j's ``runs`` (j,)."""

    boards: np.ndarray
    runs: np.ndarray
    hits: np.ndarray


def _hit_counts(
    places: pd.DataFrame, runs: pd.DataFrame, findings: pd.DataFrame, role: str, radius_mm: float
) -> _Counts:
    ran = runs[runs["role"] == role]
    boards, runs_of = np.unique(ran["board"].to_numpy(), return_counts=True)
    names, of_place = np.unique(places["board"].to_numpy(), return_inverse=True)
    counts = np.zeros((len(names), len(boards)))
    if findings.empty:
        return _Counts(boards, runs_of.astype(float), counts)
    unmatched = findings[(findings["role"] == role) & (findings["hole"] == "")]
    at = places[["true_x_mm", "true_y_mm"]].to_numpy(float)
    for _, here in unmatched.groupby(["board", "repeat"], sort=True):
        offset = at[:, None] - here[["x_mm", "y_mm"]].to_numpy(float)
        near = ((offset**2).sum(axis=2) <= radius_mm**2).any(axis=1)
        column = int(np.searchsorted(boards, here["board"].iloc[0]))
        counts[:, column] += np.bincount(of_place, near, len(names))
    return _Counts(boards, runs_of.astype(float), counts)


def _shuffled(places: pd.DataFrame, damaged: _Counts, flawless: _Counts, draws: int) -> tuple[float, int, np.ndarray]:
    """The share of places with a finding near, the number of places laid, and the share of boards drawn again."""
    names, size = np.unique(places["board"].to_numpy(), return_counts=True)
    other = (names[:, None] != damaged.boards).astype(float)
    hits, laid = damaged.hits * other, size[:, None] * damaged.runs * other
    hits_free, laid_free = flawless.hits, size[:, None] * flawless.runs
    total = laid.sum() + laid_free.sum()
    if not total:
        return np.nan, 0, np.full(draws, np.nan)
    w, v = board_weights(len(names), draws), _weights_of(len(flawless.boards), draws)
    of_damaged = np.column_stack([_laid_weights(w, names, damaged.boards), v])
    both, all_laid = np.column_stack([hits, hits_free]), np.column_stack([laid, laid_free])
    with np.errstate(invalid="ignore", divide="ignore"):
        drawn = ((w @ both) * of_damaged).sum(axis=1) / ((w @ all_laid) * of_damaged).sum(axis=1)
    return float((hits.sum() + hits_free.sum()) / total), int(total), drawn


def _weights_of(boards: int, draws: int) -> np.ndarray:
    return board_weights(boards, draws, "hole-free") if boards else np.zeros((draws, 0))


def _laid_weights(weights: np.ndarray, names: np.ndarray, boards: np.ndarray) -> np.ndarray:
    """(draws, boards) weights of the boards whose runs are laid on; a damaged board without places has none."""
    at = np.minimum(np.searchsorted(names, boards), len(names) - 1)
    return np.where(names[at] == boards, weights[:, at], 0.0)


def _sites(sites: pd.DataFrame, draws: int) -> tuple[float, int, Interval]:
    """Sites found (a site's repeats count as shares of one), sites, and the share's interval over boards."""
    if sites.empty:
        return 0.0, 0, UNKNOWN
    share = sites.groupby(["board", "hole"], sort=True)["detected"].mean()
    board, found = share.index.get_level_values("board").to_numpy(), share.to_numpy(float)
    if len(np.unique(board)) < 2 or not found.any():
        return float(found.sum()), len(found), UNKNOWN
    weights = row_weights(board, draws, "hole-free")
    return float(found.sum()), len(found), percentiles((weights @ found) / weights.sum(axis=1))
