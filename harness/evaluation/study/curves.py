"""Hits by chance, and curves over all thresholds, with areas by trapezoids between the counted
thresholds.

- ROC: signals of damages (highest scores within the hit radius) against those of the same places
  without damage.
- Free-response curve (FROC): share of damages found against false calls per square metre of
  hole-free boards (Chakraborty, Medical Physics 16 (1989), 561, counts them on all images).
- AU-PRO: mean share of each damage's pixels above a threshold against that of undamaged pixels,
  integrated to 0.3 and divided by it (Bergmann et al., Int. J. Computer Vision 129 (2021), 1038,
  4.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.intervals import FalseCallRate, Interval, clopper_pearson, percentiles
from harness.evaluation.study.boards import DRAWS, weights_in_blocks

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ChanceHits:
    """Probability that a finding which has nothing to do with a damage hits it."""

    probability: float
    """Share of ``laid`` pairs with an unmatched finding near the damage, by shuffling."""
    laid: int
    """Number of pairs of a damage and another board's run."""
    expected: float
    """1 - exp(-rate pi r^2), for evenly spread false calls at the measured rate; NaN without
    hole-free boards."""
    sites: int
    """Number of unflawed sites."""
    of_sites: float
    """Share of these that were found; repeats count as shares."""
    sites_interval: Interval
    """Clopper and Pearson's interval of that share."""


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
    damages = holes.drop_duplicates(["board", "hole"])
    probability, laid = _shuffled(damages, runs, findings, radius_mm)
    per_m2 = np.nan if rate is None else rate.rate_per_m2
    calls_within_radius = per_m2 * np.pi * (radius_mm / 1000) ** 2
    count = 0
    found_sites = 0.0
    if not sites.empty:
        share = sites.groupby(["board", "hole"])["detected"].mean()
        count = len(share)
        found_sites = float(share.sum())
    low, high = clopper_pearson(found_sites, count)
    return ChanceHits(
        probability=probability,
        laid=laid,
        expected=float(-np.expm1(-calls_within_radius)),
        sites=count,
        of_sites=found_sites / count if count else np.nan,
        sites_interval=Interval(float(low), float(high)),
    )


def _shuffled(
    damages: pd.DataFrame,
    runs: pd.DataFrame,
    findings: pd.DataFrame,
    radius_mm: float,
) -> tuple[float, int]:
    """Return the share of damages, moved to runs of other boards, that have an unmatched finding
    within the radius, and the number of these pairs."""
    centre_mm = damages[["true_x_mm", "true_y_mm"]].to_numpy(float)
    board_of_damage = damages["board"]
    roles = ("damaged", "hole_free")
    judged = runs[runs["role"].isin(roles)]
    damaged_boards = judged.loc[judged["role"] == "damaged", "board"]
    on_their_board = damaged_boards.map(board_of_damage.value_counts()).sum()
    laid = int(len(damages) * len(judged) - on_their_board)
    hits = 0
    if not findings.empty:
        unmatched = findings[findings["role"].isin(roles) & (findings["hole"] == "")]
        for (role, board, _), calls in unmatched.groupby(["role", "board", "repeat"]):
            offset_mm = centre_mm[:, None] - calls[["x_mm", "y_mm"]].to_numpy(float)
            hit = ((offset_mm**2).sum(axis=2) <= radius_mm**2).any(axis=1)
            elsewhere = (board_of_damage.to_numpy() != board) | (role != "damaged")
            hits += int((hit & elsewhere).sum())
    return hits / laid if laid else np.nan, laid


PRO_LIMIT = 0.3  # false-positive rate up to which per-region overlap is integrated, as in MVTec AD


@dataclass(frozen=True, eq=False)
class Roc:
    """Shares of unflawed sites and of damages with at least a given signal, from (0, 0) to
    (1, 1)."""

    false: np.ndarray
    """Share (k,) of unflawed sites."""
    true: np.ndarray
    """Share (k,) of damages."""
    in_use: tuple[float, float]
    """Both at the threshold in use."""
    area: float
    """Area under the curve."""
    damages: int
    """Number of inspections of damages."""
    unflawed: int
    """Number of inspections of unflawed sites."""


@dataclass(frozen=True, eq=False)
class FreeResponse:
    """Share of damages found against the rate of false calls."""

    threshold: np.ndarray
    """Thresholds (k,), descending."""
    false_calls_per_m2: np.ndarray
    """Rate (k,) of false calls on hole-free boards."""
    found_share: np.ndarray
    """Share (k,) of all damages that were found."""
    found_low: np.ndarray
    """Lower ends (k,) of its interval over boards."""
    found_high: np.ndarray
    """Upper ends (k,) of its interval over boards."""
    in_use: tuple[float, float]
    """Rate and share at the threshold in use."""
    area_m2: float
    """Inspected area of hole-free boards."""


@dataclass(frozen=True, eq=False)
class PixelCurves:
    """Overlap with damage against the share of false pixels."""

    false: np.ndarray
    """Share (k,) of undamaged pixels above each threshold, ascending from 0."""
    overlap: np.ndarray
    """Mean over damages (k,) of the share of their pixels above it."""
    pro: float
    """Area under the curve up to `PRO_LIMIT`, divided by that. NaN if the counted thresholds do
    not reach so far and pixels of damage remain below them."""
    why: str
    """Reason why ``pro`` is NaN; else empty."""


def roc_curve(
    holes: pd.DataFrame,
    sites: pd.DataFrame,
    threshold: float,
) -> Roc | None:
    """Return the ROC of all damages; None without damages or places. Damage without judged pixels
    cannot be found."""
    if holes.empty or sites.empty:
        return None
    positive = holes["signal"].fillna(-np.inf).to_numpy(float)
    negative = sites["signal"].fillna(-np.inf).to_numpy(float)
    levels = np.unique(np.concatenate([positive, negative]))[::-1]
    true = _share_from(positive, levels)
    false = _share_from(negative, levels)
    return Roc(
        false=false,
        true=true,
        in_use=(float((negative > threshold).mean()), float((positive > threshold).mean())),
        area=float(np.trapezoid(true, false)),
        damages=len(positive),
        unflawed=len(negative),
    )


def _share_from(signals: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Return 0, then the share (k,) of signals of at least each of the ``levels``."""
    below = np.searchsorted(np.sort(signals), levels, "left") / len(signals)
    return np.append(0.0, 1 - below)


def free_response(
    operating: pd.DataFrame,
    runs: pd.DataFrame,
    holes: pd.DataFrame,
    draws: int = DRAWS,
) -> FreeResponse | None:
    """Return the free-response curve of one set-up; None if no damage or no hole-free board was
    inspected, or no other threshold was counted. Thresholds with fewer false calls than a higher
    threshold are left out: there, findings merge until one covers the board, and the curve would
    turn back."""
    import pandas as pd

    hole_free = runs[runs["role"] == "hole_free"] if len(runs) else runs
    if operating.empty or holes.empty or hole_free.empty:
        return None
    area_m2 = float(hole_free["inspected_m2"].sum())
    thresholds = np.asarray(operating["threshold"].iloc[0], float)[::-1]
    findings = _counts(operating.loc[operating["role"] == "hole_free", "findings"])
    calls = findings.sum(axis=0)[::-1].astype(float)
    kept = calls >= np.maximum.accumulate(calls)
    damaged = operating[operating["role"] == "damaged"]
    inspections_of_board = holes.groupby("board", sort=True).size()
    boards = inspections_of_board.index
    # A board without room for damage has runs but no inspections.
    hits_of_run = pd.DataFrame(_counts(damaged["hits"]), damaged["board"].to_numpy())
    hits_of_board = hits_of_run.groupby(level=0).sum().reindex(boards, fill_value=0)
    hits = hits_of_board.to_numpy(float)[:, ::-1][:, kept]
    inspections = inspections_of_board.to_numpy(float)
    drawn = []
    for (weights,) in weights_in_blocks(draws, (boards.to_numpy(), "damaged")):
        drawn.append((weights @ hits) / (weights @ inspections)[:, None])
    intervals = [percentiles(column) for column in np.concatenate(drawn).T]
    return FreeResponse(
        threshold=thresholds[kept],
        false_calls_per_m2=calls[kept] / area_m2,
        found_share=hits.sum(axis=0) / inspections.sum(),
        found_low=np.array([interval.low for interval in intervals]),
        found_high=np.array([interval.high for interval in intervals]),
        in_use=(int(hole_free["false_calls"].sum()) / area_m2, float(holes["detected"].mean())),
        area_m2=area_m2,
    )


def pixel_curves(pixels: pd.DataFrame) -> PixelCurves | None:
    """Return the per-region overlap of one set-up; None without damaged or without undamaged
    pixels."""
    if pixels.empty:
        return None
    face = pixels[pixels["hole"] == ""]
    damage = pixels[(pixels["hole"] != "") & (pixels["pixels"] > 0)]
    if face.empty or damage.empty:
        return None
    face_share = _counts(face["above"]).sum(axis=0) / face["pixels"].sum()
    of_damages = _counts(damage["above"]) / damage["pixels"].to_numpy()[:, None]
    damage_share = of_damages.mean(axis=0)
    false = np.concatenate([[0.0], face_share[::-1], [1.0]])
    overlap = np.concatenate([[0.0], damage_share[::-1], [1.0]])
    if false[-2] < PRO_LIMIT and overlap[-2] != 1:
        why = f"the thresholds counted end at a false-positive rate of {false[-2]:.3g}"
        return PixelCurves(false, overlap, np.nan, why)
    inside = false < PRO_LIMIT
    x = np.append(false[inside], PRO_LIMIT)
    y = np.append(overlap[inside], np.interp(PRO_LIMIT, false, overlap))
    return PixelCurves(false, overlap, float(np.trapezoid(y, x) / PRO_LIMIT), "")


def _counts(column: pd.Series) -> np.ndarray:
    """Return the lists (n, k) over ascending thresholds of one set-up."""
    return np.stack(list(column.to_numpy()))
