"""Hits by chance, and curves over all thresholds: areas are trapezoids on those counted, intervals draw boards again.

- ROC: signals of damages (highest scores within the hit radius) against those of the same places without damage.
- Free-response curve (FROC): share of damages found against false calls per square metre of hole-free boards
  (Chakraborty, Medical Physics 16 (1989), 561, counts them on all images).
- AU-PRO: mean share of each damage's pixels above a threshold against that of undamaged pixels, integrated to 0.3 and
  divided by it (Bergmann et al., Int. J. Computer Vision 129 (2021), 1038, 4.3); area under the ROC of pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array

from harness.evaluation.intervals import UNKNOWN, FalseCallRate, Interval, clopper_pearson, percentiles
from harness.evaluation.study.limit import DRAWS, weights_in_blocks

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ChanceHits:
    """``probability`` by shuffling, from ``laid`` pairs of a place and another board's run. ``expected``,
    ``expected_upper``: 1 - exp(-rate pi r^2) at the false-call rate and its bound, were calls spread evenly; NaN
    without hole-free boards. ``found`` of ``sites`` unflawed places (repeats as shares) were found: ``of_sites``."""

    probability: float
    interval: Interval
    laid: int
    expected: float
    expected_upper: float
    found: float
    sites: int
    of_sites: float
    sites_interval: Interval

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
    rates = (np.nan, np.nan) if rate is None else (rate.rate_per_m2, rate.upper_per_m2)
    expected, upper = (-np.expm1(-np.array(rates) * np.pi * (radius_mm / 1000) ** 2)).tolist()
    n, found = 0, 0.0
    if not sites.empty:
        share = sites.groupby(["board", "hole"])["detected"].mean()
        n, found = len(share), float(share.sum())
    # Boards drawn again from boards without one have none either, which is no certainty.
    interval = percentiles(drawn) if probability > 0 else Interval(0.0, upper)
    of_sites, ends = found / n if n else np.nan, Interval(*map(float, clopper_pearson(found, n)))
    return ChanceHits(probability, interval, laid, expected, upper, found, n, of_sites, ends)


def _shuffled(
    places: pd.DataFrame, runs: pd.DataFrame, findings: pd.DataFrame, radius_mm: float, draws: int
) -> tuple[float, int, np.ndarray]:
    """The share of places with a finding near, the number of places laid, and the share of boards drawn again. A
    board's places are not laid over its own runs; damaged boards without places have no weight among boards drawn."""
    names, of_place, size = np.unique(places["board"].to_numpy(), return_inverse=True, return_counts=True)
    at = places[["true_x_mm", "true_y_mm"]].to_numpy(float)
    near, runs_of, boards_of = [], [], []
    for role in ("damaged", "hole_free"):
        boards, counted = np.unique(runs["board"][runs["role"] == role].to_numpy(), return_counts=True)
        pairs = np.zeros((0, 2), int)  # of a place's board and a board with a finding near it
        if not findings.empty:
            unmatched = findings[(findings["role"] == role) & (findings["hole"] == "")]
            for _, here in unmatched.groupby(["board", "repeat"], sort=True):
                board = here["board"].iloc[0]
                offset = at[:, None] - here[["x_mm", "y_mm"]].to_numpy(float)
                hit = ((offset**2).sum(axis=2) <= radius_mm**2).any(axis=1)
                hit &= (names[of_place] != board) | (role != "damaged")
                over = np.full(hit.sum(), np.searchsorted(boards, board))
                pairs = np.vstack([pairs, np.column_stack([of_place[hit], over])])
        near.append(coo_array((np.ones(len(pairs)), pairs.T), (len(names), len(boards))).tocsr())
        runs_of.append(counted)
        boards_of.append(boards)
    _, own, there = np.intersect1d(names, boards_of[0], return_indices=True)
    of_own = size[own] * runs_of[0][there]
    laid = int(size.sum() * sum(map(np.sum, runs_of)) - of_own.sum())
    if not laid:
        return np.nan, 0, np.full(draws, np.nan)
    drawn = []
    for w, free in weights_in_blocks(draws, (names, "damaged"), (boards_of[1], "hole-free")):
        damaged = np.zeros((len(w), len(boards_of[0])))
        damaged[:, there] = w[:, own]
        both = [(damaged, near[0], runs_of[0]), (free, near[1], runs_of[1])]
        hits = sum(((pairs.T @ w.T).T * weights).sum(axis=1) for weights, pairs, _ in both)
        with np.errstate(invalid="ignore", divide="ignore"):
            over = (w @ size) * sum(weights @ counted for weights, _, counted in both) - w[:, own] ** 2 @ of_own
            drawn.append(hits / over)
    return float(sum(pairs.sum() for pairs in near) / laid), laid, np.concatenate(drawn)


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
    damages with ``found_low``, ``found_high`` (k,) over boards. ``at``: (false calls per m2, found) at the threshold in
    use; ``area_m2`` of hole-free boards inspected."""

    threshold: np.ndarray
    false_calls_per_m2: np.ndarray
    found: np.ndarray
    found_low: np.ndarray
    found_high: np.ndarray
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
    holes: pd.DataFrame,
    sites: pd.DataFrame,
    threshold: float,
    a50_mm: float,
    a90_mm: float,
    draws: int = DRAWS,
    *,
    by: str = "diameter",
) -> tuple[Roc, ...]:
    """Draw the ROC of all damages, and of those whose size, ``by`` its name, lies below a50, from a50 to a90 and above,
    where there are any."""
    if holes.empty or sites.empty:
        return ()
    size, negative, found = holes[f"true_{by}_mm"].to_numpy(float), _signal(sites), []
    for name, of in (
        ("all sizes", np.ones(len(size), bool)),
        ("below a50", size < a50_mm),
        ("a50 to a90", (size >= a50_mm) & (size < a90_mm)),
        ("a90 and above", size >= a90_mm),
    ):
        damages, positive = holes[of], _signal(holes[of])
        if not len(damages):
            continue
        levels = np.unique(np.concatenate([positive, negative]))[::-1]
        false, true = (
            np.append(0.0, 1 - np.searchsorted(np.sort(s), levels, "left") / len(s)) for s in (negative, positive)
        )
        area = _rank_area(positive, negative, np.ones((1, len(positive))), np.ones((1, len(negative))))
        interval = UNKNOWN
        if min(len(np.unique(table["board"])) for table in (damages, sites)) > 1:
            boards = (damages["board"].to_numpy(), "damaged"), (sites["board"].to_numpy(), "hole-free")
            blocks = weights_in_blocks(draws, *boards)
            interval = percentiles(np.concatenate([_rank_area(positive, negative, *weights) for weights in blocks]))
        at = (float((negative > threshold).mean()), float((positive > threshold).mean()))
        found.append(Roc(name, false, true, at, float(area[0]), interval, len(positive), len(negative)))
    return tuple(found)


def free_response(
    operating: pd.DataFrame, runs: pd.DataFrame, holes: pd.DataFrame, draws: int = DRAWS
) -> FreeResponse | None:
    """Draw the free-response curve of one set-up; None where no damage or no hole-free board was inspected, or no other
    threshold was counted. Thresholds with fewer false calls than a higher one has are left out: that far down findings
    run into one another, to one that covers the board, and the curve would fold back."""
    free = runs[runs["role"] == "hole_free"] if len(runs) else runs
    if operating.empty or holes.empty or free.empty:
        return None
    area_m2 = float(free["inspected_m2"].sum())
    thresholds = np.asarray(operating["threshold"].iloc[0], float)[::-1]
    calls = _counts(operating.loc[operating["role"] == "hole_free", "findings"]).sum(axis=0)[::-1].astype(float)
    kept = calls >= np.maximum.accumulate(calls)
    damaged = operating[operating["role"] == "damaged"]
    of_board = holes.groupby("board", sort=True).size()
    # A board that was too full for any damage has runs, and no inspections.
    counted = _over_rows(damaged, _counts(damaged["hits"])).reindex(of_board.index, fill_value=0)
    hits, inspections = counted.to_numpy(float)[:, ::-1][:, kept], of_board.to_numpy(float)
    blocks = weights_in_blocks(draws, (of_board.index.to_numpy(), "damaged"))
    drawn = np.concatenate([(weights @ hits) / (weights @ inspections)[:, None] for (weights,) in blocks])
    edges = [percentiles(column) for column in drawn.T]
    low, high = np.array([(edge.low, edge.high) for edge in edges]).reshape(-1, 2).T
    at = (int(free["false_calls"].sum()) / area_m2, float(holes["detected"].mean()))
    found = hits.sum(axis=0) / inspections.sum()
    return FreeResponse(thresholds[kept], calls[kept] / area_m2, found, low, high, at, area_m2)


def pixel_curves(pixels: pd.DataFrame, draws: int = DRAWS) -> PixelCurves | None:
    """Compute per-region overlap and ROC of pixels of one set-up; None without damaged or without undamaged pixels."""
    if pixels.empty:
        return None
    of_damage = (pixels["hole"] != "") & (pixels["pixels"] > 0)
    face, damage = pixels[pixels["hole"] == ""], pixels[of_damage]
    if face.empty or damage.empty:
        return None
    one, two = _per_board(face), _per_board(damage)
    boards = len(one[0]), len(two[0])
    false, overlap, true = _rates(one, two, np.ones((1, boards[0])), np.ones((1, boards[1])))
    why = ""
    if false[0, -2] < PRO_LIMIT and overlap[0, -2] != 1:
        why = f"the thresholds counted end at a false-positive rate of {false[0, -2]:.3g}"
    of_face = "damaged" if np.array_equal(one[0], two[0]) else "hole-free"
    blocks = weights_in_blocks(draws, (one[0], of_face), (two[0], "damaged"))
    drawn = [np.concatenate(parts) for parts in zip(*(_rates(one, two, *weights) for weights in blocks), strict=True)]
    pro, areas = (_area(x, y, PRO_LIMIT) / PRO_LIMIT for x, y in ((false, overlap), drawn[:2]))
    of_pro = UNKNOWN if why or min(boards) < 2 else percentiles(areas)
    auroc = float(_area(false, true, 1.0)[0])
    of_auroc = UNKNOWN if min(boards) < 2 else percentiles(_area(drawn[0], drawn[2], 1.0))
    value = np.nan if why else float(pro[0])
    return PixelCurves(false[0], overlap[0], true[0], value, of_pro, auroc, of_auroc, why)


def _signal(table: pd.DataFrame) -> np.ndarray:
    """Signals; where no pixel was judged nothing can be found at any threshold."""
    return table["signal"].fillna(-np.inf).to_numpy(float)


def _rank_area(positive: np.ndarray, negative: np.ndarray, weights: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(draws,) chance that a positive signal exceeds a negative one, ties half (Mann and Whitney), under weights."""
    order = np.argsort(negative, kind="stable")
    ranked = negative[order]
    below = np.pad(np.cumsum(others[:, order], axis=1), ((0, 0), (1, 0)))
    lower, upper = np.searchsorted(ranked, positive, "left"), np.searchsorted(ranked, positive, "right")
    won = (weights * 0.5 * (below[:, lower] + below[:, upper])).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(won / (weights.sum(axis=1) * others.sum(axis=1)))


def _per_board(rows: pd.DataFrame) -> tuple[np.ndarray, ...]:
    """Boards (b,); ``above`` and ``share`` (b, k) per descending threshold; ``pixels`` and number of regions (b,)."""
    above, pixels = _counts(rows["above"]), rows["pixels"].to_numpy()
    with np.errstate(invalid="ignore"):  # face of which no pixel was judged has no share, and none is asked for
        tables = [_over_rows(rows, values) for values in (above, above / pixels[:, None], pixels[:, None])]
    regions = rows.groupby("board", sort=True).size()
    above, share, total = (table.to_numpy(float)[:, ::-1] for table in tables)
    return regions.index.to_numpy(), above, share, total[:, 0], regions.to_numpy(float)


def _counts(column: pd.Series) -> np.ndarray:
    """Lists (n, k) over the thresholds, ascending, of one set-up."""
    return np.stack(list(column.to_numpy()))


def _over_rows(rows: pd.DataFrame, values: np.ndarray) -> pd.DataFrame:
    """Sums of ``values`` (n, k), one row a board in ascending order."""
    import pandas as pd

    return pd.DataFrame(values).groupby(rows["board"].to_numpy(), sort=True).sum()


def _rates(
    face: tuple[np.ndarray, ...], damage: tuple[np.ndarray, ...], face_weights: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(draws, k + 2) false-positive rate, overlap and true-positive rate, from (0, 0, 0) to (1, 1, 1)."""
    (_, false, _, face_pixels, _), (_, above, share, pixels, regions) = face, damage

    def rate(of: np.ndarray, total: np.ndarray, drawn: np.ndarray) -> np.ndarray:
        share = (drawn @ of) / (drawn @ total)[:, None]
        return np.column_stack([np.zeros(len(drawn)), share, np.ones(len(drawn))])

    return rate(false, face_pixels, face_weights), rate(share, regions, weights), rate(above, pixels, weights)


def _area(x: np.ndarray, y: np.ndarray, limit: float) -> np.ndarray:
    """(draws,) trapezoids of y over x (draws, k), x ascending, up to ``limit`` with y interpolated there."""
    x0, x1, y0, y1 = x[:, :-1], x[:, 1:], y[:, :-1], y[:, 1:]
    end = np.clip(x1, None, limit)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(x1 > x0, (end - x0) / (x1 - x0), 0.0)
    return np.asarray(np.where(x0 < limit, (end - x0) * (y0 + 0.5 * share * (y1 - y0)), 0.0).sum(axis=1))
