"""A row of the audit: how often one statement held."""

from dataclasses import dataclass

import numpy as np

from harness.evaluation.intervals import Interval, clopper_pearson
from harness.records.schema import Column, Estimate, Table


@dataclass(frozen=True)
class Audited:
    """Counts of a statement that held or not, in one case."""

    quantity: str
    """What was stated."""
    case: str
    """Studies or boards of which it was stated."""
    nominal: float
    """Nominal coverage; NaN of a row that states none."""
    held: int
    """Number of statements that held."""
    stated: int
    """Number of statements."""
    ratio: float
    """Median of the upper end, or of the stated size, over the truth; counted rate for rates."""

    @property
    def coverage(self) -> float:
        """Share of statements that held."""
        return self.held / self.stated

    @property
    def interval(self) -> Interval:
        """Clopper and Pearson's interval of that share."""
        low, high = clopper_pearson(self.held, self.stated)
        return Interval(float(low), float(high))

    @property
    def verdict(self) -> str:
        """``as stated``, ``too seldom``, ``more often``; ``no coverage`` if none is nominal."""
        if np.isnan(self.nominal):
            return "no coverage"
        if self.interval.below(self.nominal):
            return "too seldom"
        if self.interval.above(self.nominal):
            return "more often"
        return "as stated"


def audited(
    quantity: str, case: str, *, nominal: float, holds: np.ndarray, ratio: np.ndarray
) -> Audited:
    """Return the row of statements that hold or not (n,), with their ratios (n,)."""
    return Audited(
        quantity=quantity,
        case=case,
        nominal=nominal,
        held=int(holds.sum()),
        stated=len(holds),
        ratio=float(np.median(ratio)),
    )


def _coverage(row: Audited) -> Estimate:
    return Estimate(row.coverage, row.interval.low, row.interval.high)


AUDIT = Table(
    "audit",
    "one row per quantity and case: how often what is stated covers the truth",
    (
        Column("quantity", "quantity", "quantity", "what is stated"),
        Column("case", "case", "case", "studies or boards of which it is stated"),
        Column("nominal", "nominal", "nominal", "nominal coverage"),
        Column(
            "coverage",
            "coverage (95 %)",
            _coverage,
            "share of statements that hold, with the exact 95 % interval",
            lambda estimate: estimate.text(3),
            interval=True,
        ),
        Column("held", "", "held", "number of statements that hold"),
        Column("stated", "of", "stated", "number of statements"),
        Column(
            "ratio",
            "median ratio",
            "ratio",
            "median of upper end or stated size over the truth; for counted rates the median "
            "rate per m², for precisions the median number of damaged boards",
        ),
        Column("verdict", "verdict", "verdict", "whether the interval holds the nominal coverage"),
    ),
)
