"""POD at given diameters, such as those of a board that one has: curve, bounds and what was inspected near by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.evaluation.intervals import Interval, clopper_pearson
from harness.evaluation.pod.likelihood_bounds import band
from harness.evaluation.study.limit import SetUpLimit, fit_of, target_names

NEAR = 0.1
"""Targets whose diameter differs by at most this share are near."""


@dataclass(frozen=True)
class SizeRow:
    """POD of one diameter: ``pod`` from the curve, ``lower`` and ``upper`` each one-sided at 95 % by the likelihood
    ratio (NaN without a curve). ``extrapolated``: the diameter lies outside the sizes inspected. ``near`` targets are
    within 10 % of it; ``near_rate`` is their share of hits, with Clopper and Pearson's ``near_interval`` (95 %,
    two-sided; repeats of a target count as shares of it): what the data say without a curve."""

    diameter_mm: float
    pod: float
    lower: float
    upper: float
    extrapolated: bool
    near: int
    near_rate: float
    near_interval: Interval


def pod_at(limit: SetUpLimit, diameters_mm: Sequence[float]) -> tuple[SizeRow, ...]:
    """One row a diameter, in the given order."""
    sizes = np.asarray(diameters_mm, float)
    pod, lower, upper = _of_curve(limit, sizes)
    seen = limit.record.inspected
    inside = (seen.diameter_mm.min(initial=np.inf), seen.diameter_mm.max(initial=-np.inf))
    rows = []
    for k, size in enumerate(sizes.tolist()):
        outside = not inside[0] <= size <= inside[1]
        rows.append(SizeRow(size, float(pod[k]), float(lower[k]), float(upper[k]), outside, *_near(limit, size)))
    return tuple(rows)


def _of_curve(limit: SetUpLimit, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if limit.statement is None or not len(sizes):
        nothing = np.full(len(sizes), np.nan)
        return nothing, nothing, nothing
    return (limit.statement.curve.pod(sizes), *band(fit_of(limit.record, limit.statement), sizes))


def _near(limit: SetUpLimit, size: float) -> tuple[int, float, Interval]:
    """Targets near a size, their share of hits and its interval."""
    seen = limit.record.inspected
    near = np.abs(seen.diameter_mm / size - 1) <= NEAR
    rows, targets = int(near.sum()), len(np.unique(target_names(seen)[near]))
    rate = float(seen.hit[near].mean()) if rows else np.nan
    low, high = clopper_pearson(rate * targets if rows else 0, targets)
    return targets, rate, Interval(float(low), float(high))
