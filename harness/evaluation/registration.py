"""Errors of registrations of views by method against the truth and against what the method itself predicts.

The target registration error (Fitzpatrick, West and Maurer 1998) is that of places on the board, not of the marks.
Repeats vary the noise and the error of the nominal pose; the poses, the board and the camera stay the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.intervals import bootstrap, mean_t, wilson
from harness.evaluation.maps import VIEWS

if TYPE_CHECKING:
    import pandas as pd

PARTS = ("in_plane", "across")
UNIT = ["frames", "repeat", "role"]
"""One draw of noise and of nominal poses: what intervals resample."""
MOST_REASONS = 3


def of_map(registrations: pd.DataFrame, method: str, views: int) -> pd.DataFrame:
    """Select the registrations that a map of so many views rests on.

    A method that registers each view by itself gives the same for any number of views, so that a row may stand under
    another number: those of exactly ``views`` come first, else those of the nearest.
    """
    import pandas as pd

    rows = registrations[(registrations["method"] == method) & (registrations["view"] < views)]
    if VIEWS not in rows:
        return rows
    # "all views" counts as more than any number.
    apart = pd.to_numeric(rows[VIEWS], errors="coerce").fillna(np.inf).sub(views).abs()
    order = rows.assign(_apart=apart).sort_values("_apart", kind="stable")
    return order.drop_duplicates([*UNIT, "view"]).drop(columns="_apart").sort_index()


def summarise_registrations(registrations: pd.DataFrame, by: Sequence[str] = ("method", "frames")) -> pd.DataFrame:
    """Make one row per group, in order of appearance: numbers, failures, and the errors of those that did not fail.

    ``n``, ``failed`` with ``failed_share`` and Wilson's ``failed_low``/``failed_high``, ``reasons`` (the commonest);
    for both `PARTS`: ``<part>_median_mm``, ``_q90_mm``, ``_rms_mm``, ``_predicted_mm`` (root mean square of what the
    covariances say) and ``_ratio`` of the actual to the predicted root mean square (1: honest, above 1: too sure) with
    ``_ratio_low``/``_ratio_high`` by bootstrap over repeats; ``guess_mm`` (median error of the starting guess); medians
    ``seconds``, ``iterations``, ``overlap``, ``pairs``, ``marks``; ``converged_share``.
    """
    import pandas as pd

    if registrations.empty:
        return pd.DataFrame(columns=[*by, "n", "failed"])
    groups = registrations.groupby(list(by), sort=False)
    return pd.DataFrame([dict(zip(by, key, strict=True)) | _summary(part) for key, part in groups])


def by_views(registrations: pd.DataFrame, counts: Sequence[int]) -> pd.DataFrame:
    """Summarise registrations by method and frames for each number of views, which the column ``views`` tells."""
    import pandas as pd

    parts = []
    for method in dict.fromkeys(registrations["method"]):
        for views in counts:
            rows = of_map(registrations, method, views)
            if len(rows):
                parts.append(summarise_registrations(rows).assign(views=views))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=["method", "frames", "views"])


def trusted(registrations: pd.DataFrame) -> pd.DataFrame:
    """Select those that did not fail."""
    return registrations[registrations["failure"] == ""]


def per_unit(registrations: pd.DataFrame, column: str) -> pd.Series:
    """Root mean square over the views of each repeat and role of one column, of the registrations that did not fail."""
    rows = trusted(registrations)
    squares = (rows[column] ** 2).groupby([rows[key] for key in UNIT]).mean()
    return squares.pow(0.5)


def paired_ratio(first: pd.DataFrame, second: pd.DataFrame, column: str) -> tuple[float, float, float, int]:
    """Geometric mean over repeats of second / first of one column's `per_unit`, with its Student interval of the
    logarithm, and how many pairs there were; NaN below two."""
    both = per_unit(first, column).to_frame("first").join(per_unit(second, column).rename("second"), how="inner")
    both = both[(both > 0).all(axis=1)]
    if len(both) < 2:
        return np.nan, np.nan, np.nan, len(both)
    logs = np.log((both["second"] / both["first"]).to_numpy(float))
    low, high = mean_t(logs.mean(), logs.std(ddof=1), len(logs))
    return float(np.exp(logs.mean())), float(np.exp(low)), float(np.exp(high)), len(logs)


def _summary(part: pd.DataFrame) -> dict[str, Any]:
    good = trusted(part)
    failed = len(part) - len(good)
    low, high = wilson(failed, len(part))
    reasons = part.loc[part["failure"] != "", "failure"].value_counts(sort=False)
    order = sorted(reasons.items(), key=lambda item: (-int(item[1]), str(item[0])))
    row: dict[str, Any] = {
        "n": len(part),
        "failed": failed,
        "failed_share": failed / len(part),
        "failed_low": float(low),
        "failed_high": float(high),
        "reasons": [f"{reason} ({count})" for reason, count in order[:MOST_REASONS]],
        "converged_share": float(part["converged"].astype(float).mean()),
        "guess_mm": float(part["guess_tre_mm"].median()),
    }
    for name in ("seconds", "iterations", "overlap", "pairs", "marks"):
        row[name] = float(part[name].astype(float).median())
    for name in PARTS:
        actual, predicted = (good[f"{kind}_{name}_mm"].astype(float) for kind in ("tre", "predicted"))
        actual, predicted = (errors.where(np.isfinite(errors)) for errors in (actual, predicted))
        known = actual.notna() & predicted.notna()
        both = _rms(actual[known]), _rms(predicted[known])
        ends = bootstrap_ratio(good[known], name)
        row |= {
            f"{name}_median_mm": float(actual.median()),
            f"{name}_q90_mm": float(actual.quantile(0.9)),
            f"{name}_rms_mm": _rms(actual.dropna()),
            f"{name}_predicted_mm": both[1],
            f"{name}_ratio": both[0] / both[1] if both[1] > 0 else np.nan,
            f"{name}_ratio_low": ends[0],
            f"{name}_ratio_high": ends[1],
        }
    return row


def bootstrap_ratio(rows: pd.DataFrame, part: str) -> tuple[float, float]:
    """95 % interval of the ratio of actual to predicted root mean square, units of `UNIT` resampled."""
    squares = rows[[f"tre_{part}_mm", f"predicted_{part}_mm"]] ** 2
    sums = np.asarray(squares.groupby([rows[key] for key in UNIT]).sum(), float)
    if len(sums) < 2 or not (sums[:, 1] > 0).any():
        return np.nan, np.nan

    def ratio(chosen: np.ndarray) -> np.ndarray:
        total = sums[chosen].sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.sqrt(total[:, 0] / total[:, 1]))

    interval = bootstrap(ratio, len(sums))
    return interval.low, interval.high


def _rms(values: pd.Series) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else np.nan
