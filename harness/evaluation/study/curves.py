"""Curves over all thresholds: ROC over sites, free-response curve, per-region overlap and pixels' ROC.

- ROC: signals of damages against signals of the same places on boards without damage. Signals are the highest scores
  within the hit radius, so a larger radius raises both.
- Free-response curve (FROC): share of the damages of damaged boards that were found, against false calls per square
  metre of hole-free boards (Chakraborty, Medical Physics 16 (1989), 561, counts them on all images). Beside damage
  there are second findings and rims of it, which hole-free face does not have: the rate is the table's and the gate's.
- AU-PRO: mean share of each damage's pixels above a threshold against the share of undamaged pixels above it,
  integrated to a false-positive rate of 0.3 and divided by it (Bergmann et al., Int. J. Computer Vision 129 (2021),
  1038, section 4.3); and the area under the ROC of pixels. Judged pixels only.

Areas are trapezoids on the thresholds that were counted; their intervals draw whole boards again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.intervals import UNKNOWN, Interval, percentiles
from harness.evaluation.study.over_boards import DRAWS, board_weights, row_weights

if TYPE_CHECKING:
    import pandas as pd

PRO_LIMIT = 0.3
"""False-positive rate to which per-region overlap is integrated, as MVTec AD does."""


@dataclass(frozen=True, eq=False)
class Roc:
    """``false``, ``true`` (k,): shares of ``unflawed`` sites and of ``damages`` (inspections) with a signal as high,
    from (0, 0) to (1, 1); ``at``: the two at the threshold in use. ``name``: which sizes."""

    name: str
    false: np.ndarray
    true: np.ndarray
    at: tuple[float, float]
    area: float
    area_interval: Interval
    damages: int
    unflawed: int


@dataclass(frozen=True, eq=False)
class FreeResponse:
    """Shares and rates at ``threshold`` (k,), descending: ``false_calls_per_m2`` (k,), ``found`` (k,) share of all
    damages with ``found_low``, ``found_high`` (k,) over boards. ``large_found`` (k,): share of those of a50 and more
    whose signal is above it, None without them. ``at``: (false calls per m2, found) at the threshold in use;
    ``area_m2`` of hole-free boards inspected.
    """

    threshold: np.ndarray
    false_calls_per_m2: np.ndarray
    found: np.ndarray
    found_low: np.ndarray
    found_high: np.ndarray
    large_found: np.ndarray | None
    at: tuple[float, float]
    area_m2: float


@dataclass(frozen=True, eq=False)
class PixelCurves:
    """``false`` (k,): share of undamaged pixels above each threshold, ascending from 0; ``overlap`` (k,): mean over
    damages of the share of their pixels above; ``true`` (k,): share of all damaged pixels. ``pro`` is the area under
    ``overlap`` up to `PRO_LIMIT`, divided by it; ``auroc`` that under ``true``. NaN, and ``why``, where the thresholds
    counted do not reach so far, unless no pixel of damage is left to be gained beyond them."""

    false: np.ndarray
    overlap: np.ndarray
    true: np.ndarray
    pro: float
    pro_interval: Interval
    auroc: float
    auroc_interval: Interval
    why: str


def roc_curves(
    holes: pd.DataFrame, sites: pd.DataFrame, threshold: float, a50_mm: float, a90_mm: float, draws: int = DRAWS
) -> tuple[Roc, ...]:
    """Draw the ROC of all damages, and of those below a50, from a50 to a90 and above, where there are any."""
    if holes.empty or sites.empty:
        return ()
    size = holes["true_diameter_mm"].to_numpy(float)
    classes = {
        "all sizes": np.ones(len(size), bool),
        "below a50": size < a50_mm,
        "a50 to a90": (size >= a50_mm) & (size < a90_mm),
        "a90 and above": size >= a90_mm,
    }
    negative, found = _signal(sites), []
    of_free = row_weights(sites["board"].to_numpy(), draws, "hole-free")
    for name, of in classes.items():
        damages, positive = holes[of], _signal(holes[of])
        if not len(damages):
            continue
        levels = np.unique(np.concatenate([positive, negative]))[::-1]
        false, true = (1 - np.searchsorted(np.sort(s), levels, "left") / len(s) for s in (negative, positive))
        area = _rank_area(positive, negative, np.ones((1, len(positive))), np.ones((1, len(negative))))
        interval = UNKNOWN
        if min(len(np.unique(table["board"])) for table in (damages, sites)) > 1:
            of_damaged = row_weights(damages["board"].to_numpy(), draws)
            interval = percentiles(_rank_area(positive, negative, of_damaged, of_free))
        found.append(
            Roc(
                name=name,
                false=np.concatenate([[0.0], false]),
                true=np.concatenate([[0.0], true]),
                at=(float((negative > threshold).mean()), float((positive > threshold).mean())),
                area=float(area[0]),
                area_interval=interval,
                damages=len(positive),
                unflawed=len(negative),
            )
        )
    return tuple(found)


def free_response(
    operating: pd.DataFrame,
    runs: pd.DataFrame,
    holes: pd.DataFrame,
    a50_mm: float,
    draws: int = DRAWS,
) -> FreeResponse | None:
    """Draw the free-response curve of one set-up; None where no damage or no hole-free board was inspected, or no other
    threshold was counted.

    Thresholds with fewer false calls than a higher one has are left out: that far down findings run into one another,
    to one that covers the board, and the curve would fold back.
    """
    free = runs[runs["role"] == "hole_free"] if len(runs) else runs
    if operating.empty or holes.empty or free.empty:
        return None
    area_m2 = float(free["inspected_m2"].sum())
    flawless = operating[operating["role"] == "hole_free"].groupby("threshold", sort=True)["findings"].sum().iloc[::-1]
    calls = flawless.to_numpy(float)
    kept = calls >= np.maximum.accumulate(calls)
    thresholds = flawless.index.to_numpy(float)[kept]
    damaged = operating[operating["role"] == "damaged"]
    of_board = holes.groupby("board", sort=True).size()
    # A board that was too full for any damage has runs, and no inspections.
    counted = damaged.pivot_table("hits", "board", "threshold", "sum", sort=True).reindex(of_board.index, fill_value=0)
    hits, inspections = counted[thresholds].to_numpy(float), of_board.to_numpy(float)
    weights = board_weights(len(inspections), draws)
    edges = [percentiles(column) for column in ((weights @ hits) / (weights @ inspections)[:, None]).T]
    size, signal = holes["true_diameter_mm"].to_numpy(float), _signal(holes)
    large = signal[size >= a50_mm]
    return FreeResponse(
        threshold=thresholds,
        false_calls_per_m2=calls[kept] / area_m2,
        found=hits.sum(axis=0) / inspections.sum(),
        found_low=np.array([edge.low for edge in edges]),
        found_high=np.array([edge.high for edge in edges]),
        large_found=(large[:, None] > thresholds).mean(axis=0) if len(large) else None,
        at=(int(free["false_calls"].sum()) / area_m2, float(holes["detected"].mean())),
        area_m2=area_m2,
    )


def pixel_curves(pixels: pd.DataFrame, draws: int = DRAWS) -> PixelCurves | None:
    """Compute per-region overlap and ROC of pixels of one set-up; None without damaged or without undamaged pixels."""
    if pixels.empty:
        return None
    of_damage = pixels["hole"] != ""
    face = _per_board(pixels[~of_damage].assign(share=0.0))
    seen = pixels[of_damage & (pixels["pixels"] > 0)]
    damage = _per_board(seen.assign(share=seen["above"] / seen["pixels"]))
    if face is None or damage is None:
        return None
    false, overlap, true = _rates(face, damage, np.ones((1, len(face.board))), np.ones((1, len(damage.board))))
    why = (
        ""
        if false[0, -2] >= PRO_LIMIT or overlap[0, -2] == 1
        else f"the thresholds counted end at a false-positive rate of {false[0, -2]:.3g}"
    )
    weights = board_weights(len(damage.board), draws)
    same = len(face.board) == len(damage.board) and bool(np.all(face.board == damage.board))
    if same:
        drawn = _rates(face, damage, weights, weights)
    else:
        drawn = _rates(face, damage, board_weights(len(face.board), draws, "hole-free"), weights)
    many = len(damage.board) > 1 and len(face.board) > 1
    pro, areas = _area(false, overlap, PRO_LIMIT) / PRO_LIMIT, _area(drawn[0], drawn[1], PRO_LIMIT) / PRO_LIMIT
    return PixelCurves(
        false=false[0],
        overlap=overlap[0],
        true=true[0],
        pro=np.nan if why else float(pro[0]),
        pro_interval=UNKNOWN if why or not many else percentiles(areas),
        auroc=float(_area(false, true, 1.0)[0]),
        auroc_interval=percentiles(_area(drawn[0], drawn[2], 1.0)) if many else UNKNOWN,
        why=why,
    )


def _signal(table: pd.DataFrame) -> np.ndarray:
    """Signals; where no pixel was judged nothing can be found at any threshold."""
    signal = table["signal"].to_numpy(float)
    return np.where(np.isnan(signal), -np.inf, signal)


def _rank_area(positive: np.ndarray, negative: np.ndarray, weights: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(draws,) chance that a positive signal exceeds a negative one, ties half (Mann and Whitney), under weights."""
    order = np.argsort(negative, kind="stable")
    ranked = negative[order]
    below = np.concatenate([np.zeros((len(others), 1)), np.cumsum(others[:, order], axis=1)], axis=1)
    lower, upper = np.searchsorted(ranked, positive, "left"), np.searchsorted(ranked, positive, "right")
    won = (weights * 0.5 * (below[:, lower] + below[:, upper])).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(won / (weights.sum(axis=1) * others.sum(axis=1)))


@dataclass(frozen=True, eq=False)
class _Counted:
    """Counts per board (b,) and threshold (k,), descending: ``above`` and ``share`` (b, k) summed over its regions;
    ``pixels``, ``regions`` (b,)."""

    board: np.ndarray
    above: np.ndarray
    share: np.ndarray
    pixels: np.ndarray
    regions: np.ndarray


def _per_board(rows: pd.DataFrame) -> _Counted | None:
    if rows.empty:
        return None
    table = rows.pivot_table(["above", "share", "pixels"], "board", "threshold", "sum", sort=True)
    regions = rows.groupby(["board", "threshold"], sort=True).size().unstack().to_numpy(float)
    above, share = (table[name].to_numpy(float)[:, ::-1] for name in ("above", "share"))
    return _Counted(table.index.to_numpy(), above, share, table["pixels"].to_numpy(float)[:, 0], regions[:, 0])


def _rates(
    face: _Counted, damage: _Counted, face_weights: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(draws, k + 2) false-positive rate, overlap and true-positive rate, from (0, 0, 0) to (1, 1, 1)."""

    def ends(share: np.ndarray) -> np.ndarray:
        return np.pad(np.pad(share, ((0, 0), (1, 0))), ((0, 0), (0, 1)), constant_values=1.0)

    return (
        ends((face_weights @ face.above) / (face_weights @ face.pixels)[:, None]),
        ends((weights @ damage.share) / (weights @ damage.regions)[:, None]),
        ends((weights @ damage.above) / (weights @ damage.pixels)[:, None]),
    )


def _area(x: np.ndarray, y: np.ndarray, limit: float) -> np.ndarray:
    """(draws,) trapezoids of y over x (draws, k), x ascending, up to ``limit`` with y interpolated there."""
    x0, x1, y0, y1 = x[:, :-1], x[:, 1:], y[:, :-1], y[:, 1:]
    end = np.clip(x1, None, limit)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(x1 > x0, (end - x0) / (x1 - x0), 0.0)
    return np.asarray(np.where(x0 < limit, (end - x0) * (y0 + 0.5 * share * (y1 - y0)), 0.0).sum(axis=1))
