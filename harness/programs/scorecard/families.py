"""Families of figures that differ in one condition: whether the model is off as a whole, and
whether its error follows the condition.

Each figure alone may be off by 25 %, so an error that grows with the condition can hide in a family
whose figures all pass. The logarithm of simulated over published value is therefore regressed on
the logarithm of the condition."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import stats

from harness.evaluation.intervals import Interval
from harness.programs.scorecard.figures import Family, Figure, Score, number
from harness.records.schema import Column, Table
from harness.vocabulary.path_names import camera_title
from harness.vocabulary.provenance import RESULTS_VERSION

OFF = 0.10
"""Largest share by which a family's mean ratio may differ from 1, and by which its ratio may change
along the family."""


@dataclass(frozen=True)
class FamilyScore:
    """A family and the scores of its figures."""

    family: Family
    """The family, as the file declares it."""
    scores: Sequence[Score]
    """In the order of the family's figures."""

    @property
    def figure(self) -> Figure:
        """The first figure, whose camera, quantity and use are those of all."""
        return self.scores[0].figure

    @cached_property
    def conditions(self) -> np.ndarray:
        """Values (n,) of the condition, in its unit."""
        values = []
        for score in self.scores:
            conditions = score.figure.request.conditions.to_data()
            values.append(conditions[self.family.over])
        return np.array(values, float)

    @cached_property
    def log_conditions(self) -> np.ndarray:
        """Their logarithms (n,); of 1 / cos for an angle in degrees."""
        if self.family.over.endswith("_deg"):
            cosines = np.cos(np.radians(self.conditions))
            return np.asarray(-np.log(cosines))
        return np.log(self.conditions)

    @cached_property
    def log_ratios(self) -> np.ndarray:
        """Logarithms (n,) of simulated over published value; NaN without a simulated value."""
        ratios = np.array([score.ratio for score in self.scores])
        positive = np.where(ratios > 0, ratios, np.nan)
        return np.log(positive)

    @property
    def mean(self) -> float:
        """Geometric mean of the ratios."""
        return float(np.exp(self.log_ratios.mean()))

    @cached_property
    def line(self) -> Any:
        """Regression line of the logarithms of ratios on those of conditions."""
        return stats.linregress(self.log_conditions, self.log_ratios)

    @property
    def slope(self) -> float:
        """Slope of the regression line."""
        return float(self.line.slope)

    @cached_property
    def slope_half_width(self) -> float:
        """Half of the slope's 95 % interval, by Student's t."""
        freedom = len(self.scores) - 2
        quantile = stats.t.ppf(0.975, freedom)
        return float(quantile * self.line.stderr)

    @property
    def slope_interval(self) -> Interval:
        """The slope's 95 % interval."""
        low = self.slope - self.slope_half_width
        high = self.slope + self.slope_half_width
        return Interval(low, high)

    @property
    def change(self) -> float:
        """Ratio at the greatest condition over that at the least, on the regression line."""
        log_change = self.slope * np.ptp(self.log_conditions)
        return float(np.exp(log_change))

    @property
    def has_trend(self) -> bool:
        """True if the slope's interval excludes 0 and the ratio changes by more than `OFF`."""
        excludes_0 = abs(self.slope) > self.slope_half_width
        changes = abs(np.log(self.change)) > np.log(1 + OFF)
        return bool(excludes_0 and changes)

    @property
    def is_off(self) -> bool:
        """True unless the mean ratio lies within `OFF` of 1."""
        is_near_1 = abs(np.log(self.mean)) <= np.log(1 + OFF)
        return not is_near_1

    @property
    def passes(self) -> bool:
        """True if the family is not off and has no trend."""
        return not self.is_off and not self.has_trend

    @property
    def fell_behind(self) -> bool:
        """True if it does not pass and the file gives no reason."""
        return not self.passes and not self.family.fails

    @property
    def verdict(self) -> str:
        """The faults, with ``(new)`` if the file gives no reason; ``agrees`` without any."""
        faults = []
        if self.is_off:
            faults.append("off")
        if self.has_trend:
            faults.append("trend")
        if not faults:
            return "agrees"
        verdict = " and ".join(faults)
        return f"{verdict} (new)" if self.fell_behind else verdict


def family_scores(families: Sequence[Family], scores: Sequence[Score]) -> list[FamilyScore]:
    """Return the families all of whose figures were scored, with their scores."""
    by_name = {score.figure.name: score for score in scores}
    return [
        FamilyScore(family, [by_name[name] for name in family.figures])
        for family in families
        if set(family.figures) <= by_name.keys()
    ]


def _span(row: FamilyScore) -> str:
    least = row.conditions.min()
    greatest = row.conditions.max()
    return f"{row.family.over} {least:g} to {greatest:g}"


def _remarks(row: FamilyScore) -> str:
    why = f"Why: {row.family.fails}. " if row.family.fails else ""
    return why + row.family.note


FAMILIES = Table(
    "families",
    "one row per family of figures",
    (
        Column("name", "family", "family.name", "name in the file of figures"),
        Column("camera", "", "figure.camera", "simulated camera"),
        Column("", "camera", lambda row: camera_title(row.figure.camera)),
        Column("quantity", "quantity", "figure.measures.title", "quantity that is measured"),
        Column("over", "over", _span, "the condition and its ends"),
        Column("figures", "figures", lambda row: len(row.scores), "number of figures"),
        Column("mean", "mean ratio", "mean", "geometric mean of the ratios", number),
        Column("slope", "slope", "slope", "of log ratio on log condition", number),
        Column("slope_low", "", "slope_interval.low", "lower end of its 95 % interval"),
        Column("slope_high", "", "slope_interval.high", "upper end of its 95 % interval"),
        Column("change", "last / first", "change", "change of the ratio along the family", number),
        Column(
            "verdict",
            "verdict",
            "verdict",
            "whether it is off, and whether it has a trend",
            tone=lambda row: "good" if row.passes else "bad",
        ),
        Column("use", "use", "figure.use", "blind or calibration"),
        Column("", "note", _remarks, brief=False),
        Column("results_version", "", lambda row: RESULTS_VERSION, "version of the format"),
    ),
    left=5,
    formats=("csv",),
    kind="scores",
)
