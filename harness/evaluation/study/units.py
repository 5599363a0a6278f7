"""Limits over units of a camera: each unit's own, and the limit of a new, randomly drawn unit.

All units inspect the same boards, so their limits differ only by unit and noise. The logarithms of
the units' a90 are assumed to be normal (a random effect of the unit). With 95 % confidence, that
of a new unit lies less than t(0.95, U - 1) s sqrt(1 + 1 / U) above their mean, where s is the
standard deviation of U units. The mean has an error from the boards, which all units share: that
of a90/95 over boards, ln(a90/95) - ln(a90). Both are independent, and their margins are combined
as the root of the sum of squares (Zou and Donner, Statistics in Medicine 27 (2008), 1693).
``tests/validation/units_coverage.py`` measures how often a new unit is within the limit. Not
modelled: units that differ in more than their fixed pattern (temperature, age, a maker's change of
parts)."""

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from harness.evaluation.pod.curve import Bound, PodCurve
from harness.evaluation.pod.hit_miss import bound, fit_hit_miss
from harness.evaluation.pod.statement import CONFIDENCE, POD
from harness.vocabulary.errors import UserError

METHOD = "prediction of a new unit over units and boards"


@dataclass(frozen=True, eq=False)
class OverUnits:
    """Limits of each unit, and of a new one."""

    a90_mm: np.ndarray
    """a90 (u,) of each unit alone, with the link and axis of all units; infinite for a unit
    without one."""
    a90_95_mm: np.ndarray
    """a90/95 (u,) of each unit alone, likewise."""
    spread: float
    """Standard deviation of ln a90 between units, including the noise of their hits."""
    new_unit: Bound
    """Upper bound, at 95 % confidence, on the a90 of a new unit."""

    @property
    def units(self) -> int:
        """The number of units."""
        return len(self.a90_mm)


def over_units(
    size_mm: np.ndarray,
    hit: np.ndarray,
    target: np.ndarray,
    unit: np.ndarray,
    curve: PodCurve,
    limit: Bound,
) -> OverUnits:
    """Judge inspections, one per row (n,): ``hit`` bool, names of ``target``, numbers of ``unit``.
    ``curve``: of all units; ``limit``: its a90/95 over boards. If a unit found all or nothing, no
    limit of a new unit is demonstrated."""
    a90_of_units = []
    a90_95_of_units = []
    for number in np.unique(unit):
        rows = unit == number
        a90 = np.inf
        a90_95 = np.inf
        try:
            fit = fit_hit_miss(
                size_mm[rows],
                hit[rows],
                link=curve.link,
                log_size=curve.log_size,
                inspections=target[rows],
            )
            a90 = fit.curve.size_at(POD)
            a90_95 = bound(fit).value
        except UserError:
            pass  # the unit found all or nothing
        a90_of_units.append(a90)
        a90_95_of_units.append(a90_95)
    a90_mm = np.array(a90_of_units, float)
    spread = np.inf
    if np.isfinite(a90_mm).all():
        with np.errstate(invalid="ignore"):
            spread = float(np.log(a90_mm).std(ddof=1))
    return OverUnits(
        a90_mm=a90_mm,
        a90_95_mm=np.array(a90_95_of_units, float),
        spread=spread,
        new_unit=_new_unit(len(a90_mm), spread, float(curve.size_at(POD)), limit),
    )


def _new_unit(
    units: int,
    spread: float,
    a90: float,
    limit: Bound,
) -> Bound:
    """Return the bound on the a90 of a new unit: ln a90 plus the root of the sum of squares of the
    margin of boards, ln(limit / a90), and that of units."""
    if not np.isfinite(spread):
        why = "a unit found every damage or none, so that units cannot be compared"
        return Bound(POD, CONFIDENCE, METHOD, np.inf, f"not demonstrated: {why}")
    if not limit.demonstrated:
        why = limit.why.removeprefix("not demonstrated: ")
        return Bound(POD, CONFIDENCE, METHOD, np.inf, f"not demonstrated: {why}")
    of_units = float(stdtrit(units - 1, CONFIDENCE)) * spread * np.sqrt(1 + 1 / units)
    of_boards = np.log(limit.value / a90)
    value = a90 * float(np.exp(np.hypot(of_boards, of_units)))
    return Bound(POD, CONFIDENCE, METHOD, value)
