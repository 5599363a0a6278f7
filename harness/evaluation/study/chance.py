"""Hits by chance: the rate at which damage would be found though the detector saw nothing of it.

Positions are shuffled: the places of one board's damage are laid over the findings of every other run that count for no
damage, on damaged boards and on hole-free ones. The share of places with one within the hit radius is the probability
of a chance hit, and the floor that a POD curve must be read against. Shuffling keeps where on a board damage and false
calls tend to be, which a rate per area does not. Not modelled: false calls that real damage brings about.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.intervals import UNKNOWN, Interval, clopper_pearson, percentiles
from harness.evaluation.pod.false_calls import FalseCallRate
from harness.evaluation.study.over_boards import DRAWS, board_weights, row_weights

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
        """Return POD by sight alone: (POD - chance) / (1 - chance), 0 where chance explains all."""
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
    """Count chance hits of one set-up at one number of frames, from its rows of the study's tables."""
    places = holes.drop_duplicates(["board", "hole"])
    probability, laid, drawn = _shuffled(places, runs, findings, radius_mm, draws)
    area_m2 = np.pi * (radius_mm / 1000) ** 2
    n, found, over_boards = 0, 0.0, UNKNOWN
    if not sites.empty:
        share = sites.groupby(["board", "hole"], sort=True)["detected"].mean()
        board, shares = share.index.get_level_values("board").to_numpy(), share.to_numpy(float)
        n, found = len(shares), float(shares.sum())
        if len(np.unique(board)) > 1 and found:
            weights = row_weights(board, draws, "hole-free")
            over_boards = percentiles((weights @ shares) / weights.sum(axis=1))
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


def _shuffled(
    places: pd.DataFrame, runs: pd.DataFrame, findings: pd.DataFrame, radius_mm: float, draws: int
) -> tuple[float, int, np.ndarray]:
    """The share of places with a finding near, the number of places laid, and the share of boards drawn again."""
    names, of_place, size = np.unique(places["board"].to_numpy(), return_inverse=True, return_counts=True)
    at = places[["true_x_mm", "true_y_mm"]].to_numpy(float)
    w = board_weights(len(names), draws)
    hits, laid, weights = [], [], []
    for role in ("damaged", "hole_free"):
        boards, runs_of = np.unique(runs["board"][runs["role"] == role].to_numpy(), return_counts=True)
        counts = np.zeros((len(names), len(boards)))  # places of board i that have a finding of board j near
        if not findings.empty:
            unmatched = findings[(findings["role"] == role) & (findings["hole"] == "")]
            for _, here in unmatched.groupby(["board", "repeat"], sort=True):
                offset = at[:, None] - here[["x_mm", "y_mm"]].to_numpy(float)
                near = ((offset**2).sum(axis=2) <= radius_mm**2).any(axis=1)
                counts[:, np.searchsorted(boards, here["board"].iloc[0])] += np.bincount(of_place, near, len(names))
        other = np.ones_like(counts)
        if role == "damaged":  # a board's places are not laid over its own runs
            other = (names[:, None] != boards).astype(float)
            where = np.minimum(np.searchsorted(names, boards), len(names) - 1)
            weights.append(np.where(names[where] == boards, w[:, where], 0.0))  # none without places
        else:
            weights.append(board_weights(len(boards), draws, "hole-free") if len(boards) else np.zeros((draws, 0)))
        hits.append(counts * other)
        laid.append(size[:, None] * runs_of * other)
    all_hits, all_laid, of_runs = (np.column_stack(parts) for parts in (hits, laid, weights))
    if not all_laid.sum():
        return np.nan, 0, np.full(draws, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        drawn = ((w @ all_hits) * of_runs).sum(axis=1) / ((w @ all_laid) * of_runs).sum(axis=1)
    return float(all_hits.sum() / all_laid.sum()), int(all_laid.sum()), drawn
