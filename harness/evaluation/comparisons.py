"""Comparisons that the claims need: does one quantity fall with another, does one scatter more than another?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.intervals import Interval, bootstrap

if TYPE_CHECKING:
    import pandas as pd


def falling_rank(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Spearman's rho of (x, y) and the one-sided p of "y falls as x grows".

    Exact permutation test up to 8 pairs, 20000 fixed random permutations beyond. A constant input has rho 0, p 1.
    """
    from scipy.stats import permutation_test, rankdata

    ranks, other = rankdata(x), rankdata(y)
    if np.ptp(ranks) == 0 or np.ptp(other) == 0:
        return 0.0, 1.0
    a, b = ranks - ranks.mean(), other - other.mean()
    norm = np.sqrt((a @ a) * (b @ b))

    def rho(permuted: np.ndarray, axis: int = -1) -> np.ndarray:
        return np.sum(permuted * b, axis=axis) / norm

    test = permutation_test(
        (a,),
        rho,
        permutation_type="pairings",
        alternative="less",
        vectorized=True,
        n_resamples=50_000 if len(a) <= 8 else 20_000,
        rng=np.random.default_rng(0),
        batch=10_000,
    )
    return float(a @ b / norm), float(test.pvalue)


def scatter_ratio(holes: pd.DataFrame, first: str, second: str) -> tuple[float, Interval]:
    """Median over holes of var(first) / var(second) over repeats, with its interval by bootstrap over repeats.

    ``holes``: one row per repeat and hole. Repeats in which a hole lacks either value are left out of that hole's two
    variances; infinite where no hole's second column varies.
    """
    top, bottom = (holes.pivot(index="repeat", columns="hole", values=c).to_numpy(float) for c in (first, second))
    both = np.isfinite(top) & np.isfinite(bottom)
    top, bottom = np.where(both, top, np.nan), np.where(both, bottom, np.nan)

    def ratio(chosen: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore", divide="ignore"):
            ratios = _variance(top[chosen]) / _variance(bottom[chosen])
        return np.nanmedian(np.where(np.isnan(ratios).all(axis=1, keepdims=True), np.inf, ratios), axis=1)

    everything = np.arange(len(top))[None]
    return float(ratio(everything)[0]), bootstrap(ratio, len(top))


def _variance(values: np.ndarray) -> np.ndarray:
    """Variance (n - 1) over axis 1 of (resamples, n, holes), NaN left out; NaN below two values."""
    there = np.isfinite(values)
    count = there.sum(axis=1)
    mean = np.where(there, values, 0).sum(axis=1) / count
    squares = np.where(there, (values - mean[:, None]) ** 2, 0).sum(axis=1)
    return np.where(count >= 2, squares / (count - 1), np.nan)
