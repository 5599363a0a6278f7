"""Hits by chance, and curves over all thresholds, with areas by trapezoids between the counted
thresholds.

- ROC: signals of damages (highest scores within the hit radius) against those of the same places without damage.
- Free-response curve (FROC): share of damages found against false calls per square metre of hole-free boards
  (Chakraborty, Medical Physics 16 (1989), 561, counts them on all images).
- AU-PRO: mean share of each damage's pixels above a threshold against that of undamaged pixels, integrated to 0.3 and
  divided by it (Bergmann et al., Int. J. Computer Vision 129 (2021), 1038, 4.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.intervals import FalseCallRate, Interval, clopper_pearson, percentiles
from harness.evaluation.study.limit import DRAWS, weights_in_blocks

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ChanceHits:
    """``probability``: by shuffling, from ``laid`` pairs of a place and another board's run.
    ``expected``: 1 - exp(-rate pi r^2) for evenly spread false calls at the measured rate; NaN
    without hole-free boards. ``of_sites``: share of ``sites`` unflawed places (repeats count as
    shares) that were found."""

    probability: float
    laid: int
    expected: float
    sites: int
    of_sites: float
    sites_interval: Interval


def chance_hits(
    holes: pd.DataFrame,
    sites: pd.DataFrame,
    runs: pd.DataFrame,
    findings: pd.DataFrame,
    radius_mm: float,
    rate: FalseCallRate | None = None,
) -> ChanceHits:
    """Count chance hits of one set-up at one number of frames, from its rows of the study's
    tables."""
    probability, laid = _shuffled(
        holes.drop_duplicates(["board", "hole"]), runs, findings, radius_mm
    )
    per_m2 = np.nan if rate is None else rate.rate_per_m2
    n = 0
    found = 0.0
    if not sites.empty:
        share = sites.groupby(["board", "hole"])["detected"].mean()
        n = len(share)
        found = float(share.sum())
    ends = Interval(*map(float, clopper_pearson(found, n)))
    expected = float(-np.expm1(-per_m2 * np.pi * (radius_mm / 1000) ** 2))
    return ChanceHits(probability, laid, expected, n, found / n if n else np.nan, ends)


def _shuffled(
    places: pd.DataFrame, runs: pd.DataFrame, findings: pd.DataFrame, radius_mm: float
) -> tuple[float, int]:
    """Return the share of places, moved to runs of other boards, with an unmatched finding near,
    and their number."""
    at = places[["true_x_mm", "true_y_mm"]].to_numpy(float)
    own = places["board"]
    judged = runs[runs["role"].isin(("damaged", "hole_free"))]
    on_own = judged.loc[judged["role"] == "damaged", "board"].map(own.value_counts()).sum()
    laid = int(len(own) * len(judged) - on_own)
    near = 0
    if not findings.empty:
        unmatched = findings[
            findings["role"].isin(("damaged", "hole_free")) & (findings["hole"] == "")
        ]
        for (role, board, _), calls in unmatched.groupby(["role", "board", "repeat"]):
            offset = at[:, None] - calls[["x_mm", "y_mm"]].to_numpy(float)
            hit = ((offset**2).sum(axis=2) <= radius_mm**2).any(axis=1)
            near += int((hit & ((own.to_numpy() != board) | (role != "damaged"))).sum())
    return near / laid if laid else np.nan, laid


PRO_LIMIT = 0.3  # false-positive rate up to which per-region overlap is integrated, as in MVTec AD


@dataclass(frozen=True, eq=False)
class Roc:
    """``false``, ``true`` (k,): shares of ``unflawed`` sites and of ``damages`` (inspections) with
    at least a given signal, from (0, 0) to (1, 1). ``in_use``: both at the threshold in use."""

    false: np.ndarray
    true: np.ndarray
    in_use: tuple[float, float]
    area: float
    damages: int
    unflawed: int


@dataclass(frozen=True, eq=False)
class FreeResponse:
    """Shares and rates at descending values of ``threshold`` (k,). ``found_share`` (k,): share of all
    damages, with ``found_low`` and ``found_high`` (k,) over boards. ``in_use``: (false calls per m2,
    found) at the threshold in use. ``area_m2``: inspected area of hole-free boards."""

    threshold: np.ndarray
    false_calls_per_m2: np.ndarray
    found_share: np.ndarray
    found_low: np.ndarray
    found_high: np.ndarray
    in_use: tuple[float, float]
    area_m2: float


@dataclass(frozen=True, eq=False)
class PixelCurves:
    """``false`` (k,): share of undamaged pixels above each threshold, ascending from 0.
    ``overlap`` (k,): mean over damages of the share of their pixels above it. ``pro``: the area
    under it up to `PRO_LIMIT`, divided by that. If the counted thresholds do not reach so far, and
    pixels of damage remain below them, it is NaN, and ``why`` says so."""

    false: np.ndarray
    overlap: np.ndarray
    pro: float
    why: str


def roc_curve(holes: pd.DataFrame, sites: pd.DataFrame, threshold: float) -> Roc | None:
    """Return the ROC of all damages; None without damages or places. Damage without judged pixels
    cannot be found."""
    if holes.empty or sites.empty:
        return None
    positive = holes["signal"].fillna(-np.inf).to_numpy(float)
    negative = sites["signal"].fillna(-np.inf).to_numpy(float)
    levels = np.unique(np.concatenate([positive, negative]))[::-1]
    both = (negative, positive)
    false, true = (
        np.append(0.0, 1 - np.searchsorted(np.sort(s), levels, "left") / len(s)) for s in both
    )
    at = (float((negative > threshold).mean()), float((positive > threshold).mean()))
    return Roc(false, true, at, float(np.trapezoid(true, false)), len(positive), len(negative))


def free_response(
    operating: pd.DataFrame, runs: pd.DataFrame, holes: pd.DataFrame, draws: int = DRAWS
) -> FreeResponse | None:
    """Return the free-response curve of one set-up; None if no damage or no hole-free board was
    inspected, or no other threshold was counted. Thresholds with fewer false calls than a higher
    threshold are left out: there, findings merge until one covers the board, and the curve would
    turn back."""
    import pandas as pd

    free = runs[runs["role"] == "hole_free"] if len(runs) else runs
    if operating.empty or holes.empty or free.empty:
        return None
    area_m2 = float(free["inspected_m2"].sum())
    thresholds = np.asarray(operating["threshold"].iloc[0], float)[::-1]
    calls = (
        _counts(operating.loc[operating["role"] == "hole_free", "findings"])
        .sum(axis=0)[::-1]
        .astype(float)
    )
    kept = calls >= np.maximum.accumulate(calls)
    damaged = operating[operating["role"] == "damaged"]
    of_board = holes.groupby("board", sort=True).size()
    # A board without room for damage has runs but no inspections.
    of_run = pd.DataFrame(_counts(damaged["hits"]), damaged["board"].to_numpy())
    counted = of_run.groupby(level=0).sum().reindex(of_board.index, fill_value=0)
    hits = counted.to_numpy(float)[:, ::-1][:, kept]
    inspections = of_board.to_numpy(float)
    blocks = weights_in_blocks(draws, (of_board.index.to_numpy(), "damaged"))
    drawn = np.concatenate(
        [(weights @ hits) / (weights @ inspections)[:, None] for (weights,) in blocks]
    )
    edges = [percentiles(column) for column in drawn.T]
    low, high = np.array([(edge.low, edge.high) for edge in edges]).reshape(-1, 2).T
    at = (int(free["false_calls"].sum()) / area_m2, float(holes["detected"].mean()))
    found = hits.sum(axis=0) / inspections.sum()
    return FreeResponse(thresholds[kept], calls[kept] / area_m2, found, low, high, at, area_m2)


def pixel_curves(pixels: pd.DataFrame) -> PixelCurves | None:
    """Return the per-region overlap of one set-up; None without damaged or without undamaged
    pixels."""
    if pixels.empty:
        return None
    face = pixels[pixels["hole"] == ""]
    damage = pixels[(pixels["hole"] != "") & (pixels["pixels"] > 0)]
    if face.empty or damage.empty:
        return None
    false = _counts(face["above"]).sum(axis=0) / face["pixels"].sum()
    overlap = (_counts(damage["above"]) / damage["pixels"].to_numpy()[:, None]).mean(axis=0)
    false = np.concatenate([[0.0], false[::-1], [1.0]])
    overlap = np.concatenate([[0.0], overlap[::-1], [1.0]])
    if false[-2] < PRO_LIMIT and overlap[-2] != 1:
        why = f"the thresholds counted end at a false-positive rate of {false[-2]:.3g}"
        return PixelCurves(false, overlap, np.nan, why)
    x = np.append(false[false < PRO_LIMIT], PRO_LIMIT)
    area = np.trapezoid(
        np.append(overlap[false < PRO_LIMIT], np.interp(PRO_LIMIT, false, overlap)), x
    )
    return PixelCurves(false, overlap, float(area / PRO_LIMIT), "")


def _counts(column: pd.Series) -> np.ndarray:
    """Return the lists (n, k) over ascending thresholds of one set-up."""
    return np.stack(list(column.to_numpy()))
