"""How often a new unit of the camera keeps to the limit over units: ``python
tests/validation/units_coverage.py``.

Each study has boards of eight holes with diameters uniform over 2 to 8 mm, all inspected by the
same units. A hole is found where ln a plus what is its own (normal, shared by all units) plus
noise exceeds the unit's ln a50, normal about that of 4 mm with the spread stated. Hits of two
units correlate as on simulated boards: 0.82 of the variance is the hole's. Coverage is the share
of new units whose a90 lies below the limit, by the normal distribution of units, averaged over
studies; nominal 95 %. "one unit": the same for a90/95 of one unit alone.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2])]

from scipy.stats import norm

from harness.evaluation.pod.hit_miss import bound, fit_hit_miss
from harness.evaluation.study.units import over_units

A50_MM = 4.0
WIDTH = 0.116
OF_HOLE = 0.82
"""``WIDTH``: standard deviation of what is the hole's and of noise together, on the scale of ln a:
a90 is 4.64 mm."""
SIZES_MM = (2.0, 8.0)
HOLES = 8


def coverage(
    units: int, boards: int, spread: float, studies: int, seed: int
) -> tuple[float, float, float, float]:
    """Return the coverage of the limit over units and of that of one unit, and the medians of both
    in mm."""
    rng = np.random.default_rng([seed, units, boards, round(1e4 * spread)])
    ln_a90 = np.log(A50_MM) + norm.ppf(0.9) * WIDTH
    limits_mm = []
    for _ in range(studies):
        size_mm = np.tile(rng.uniform(*SIZES_MM, boards * HOLES), units)
        of_damage = np.tile(rng.standard_normal(boards * HOLES), units) * WIDTH * np.sqrt(OF_HOLE)
        unit = np.repeat(np.arange(units), boards * HOLES)
        ln_a50 = (np.log(A50_MM) + spread * rng.standard_normal(units))[unit]
        noise = WIDTH * np.sqrt(1 - OF_HOLE) * rng.standard_normal(len(unit))
        hit = np.log(size_mm) + of_damage + noise > ln_a50
        target = np.tile(np.arange(boards * HOLES), units)
        fit = fit_hit_miss(size_mm, hit, link="probit", log_size=True, inspections=target)
        limits = over_units(size_mm, hit, target, unit, fit.curve, bound(fit))
        limits_mm.append((limits.new_unit.value, limits.a90_95_mm[0]))
    above = np.log(limits_mm) - ln_a90
    covered = norm.cdf(above / spread) if spread else (above >= 0).astype(float)
    new, of_one_unit = covered.mean(axis=0).tolist()
    median_new, median_one = np.median(limits_mm, axis=0).tolist()
    return new, of_one_unit, median_new, median_one


def main(arguments: list[str] | None = None) -> int:
    """Print one line a setting."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--studies", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    print("units  boards  spread  covered: over units  one unit  median/mm: over units  one unit")
    for units, boards in ((8, 24), (8, 60), (3, 60)):
        for spread in (0.0, 0.02, 0.05, 0.1):
            new, of_one_unit, *medians = coverage(
                units, boards, spread, options.studies, options.seed
            )
            text = f"{units:5d}  {boards:6d}  {spread:6.2f}  {new:19.3f}  {of_one_unit:8.3f}"
            print(f"{text}  {medians[0]:21.2f}  {medians[1]:8.2f}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
