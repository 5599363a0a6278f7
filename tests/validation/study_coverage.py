"""How often bounds on a90 hold where boards matter: ``python tests/validation/study_coverage.py``.

Each study has boards of eight damages with diameters spread over 1 to 14 mm; a damage is found
with probability logistic((a - 6 mm - shift of its board) / 0.8 mm), shifts normal with the
deviation stated. The true a90 is that of damage on a board drawn at random. Beside the likelihood
ratio bound, which takes damages as independent, stand the same with its criterion multiplied by
the boards' design effect where that is above 1, and the 95 % percentile of boards drawn again.
Nominal coverage: 95 %.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2])]

from scipy import optimize, special

from harness.evaluation.intervals import percentiles
from harness.evaluation.pod.averaged import ModelAverage
from harness.evaluation.pod.hit_miss import bound, fit_hit_miss
from harness.evaluation.study.boards import design_effect, refitted_sizes, targets_of
from harness.vocabulary.errors import UserError

A50_MM = 6.0
WIDTH_MM = 0.8
SIZES_MM = (1.0, 14.0)
HOLES = 8
DRAWS = 300


@dataclass(frozen=True)
class Coverage:
    """How often bounds of simulated studies hold the true a90."""

    boards: int
    """Number of boards of a study."""
    shift_mm: float
    """Standard deviation of a50 between boards."""
    studies: int
    """Number of studies with a rising curve."""
    refused: int
    """Studies without a rising curve, left out."""
    by_ratio: float
    """Share of studies whose a90/95 is at or over the true a90."""
    over_boards: float
    """The same of the bound with the boards' design effect."""
    by_percentile: float
    """The same of the upper percentile over resampled boards."""
    median_ratio_mm: float
    """Median a90/95."""
    median_boards_mm: float
    """Median bound with the design effect."""
    median_effect: float
    """Median design effect."""
    true_mm: float
    """The true a90 of damage on a board drawn at random."""


def true_a90(shift_mm: float) -> float:
    """a90 of damage on a board drawn at random: the mean of the boards' curves, by Gauss and
    Hermite."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(80)

    def excess(a: float) -> float:
        pods = special.expit((a - A50_MM - shift_mm * nodes) / WIDTH_MM)
        return float(weights @ pods / weights.sum()) - 0.9

    return float(optimize.brentq(excess, A50_MM, A50_MM + 50.0))


def coverage(boards: int, shift_mm: float, studies: int, seed: int) -> Coverage:
    """Draw and judge ``studies`` studies of so many boards."""
    rng = np.random.default_rng(seed)
    true_mm = true_a90(shift_mm)
    rows = []
    refused = 0
    board = np.repeat(np.arange(boards), HOLES)
    hole = np.tile(np.arange(HOLES), boards)
    for _ in range(studies):
        size = rng.permutation(np.linspace(*SIZES_MM, boards * HOLES))
        shift = shift_mm * rng.standard_normal(boards)[board]
        hit = rng.random(len(size)) < special.expit((size - A50_MM - shift) / WIDTH_MM)
        try:
            fit = fit_hit_miss(size, hit)
        except UserError:
            refused += 1
            continue
        targets = targets_of(board, hole, size, hit)
        drawn = refitted_sizes(targets, fit.curve, (0.9,), DRAWS)[0]
        effect = design_effect(targets, fit.curve, 0.9)
        with_effect = ModelAverage([fit], max(effect, 1.0)).bound()
        rows.append((bound(fit).value, with_effect.value, percentiles(drawn, 0.9).high, effect))
    ratio, of_boards, percentile, effects = np.array(rows).T
    return Coverage(
        boards=boards,
        shift_mm=shift_mm,
        studies=len(rows),
        refused=refused,
        by_ratio=float((ratio >= true_mm).mean()),
        over_boards=float((of_boards >= true_mm).mean()),
        by_percentile=float((percentile >= true_mm).mean()),
        median_ratio_mm=float(np.median(ratio)),
        median_boards_mm=float(np.median(of_boards)),
        median_effect=float(np.median(effects)),
        true_mm=true_mm,
    )


def main(arguments: list[str] | None = None) -> int:
    """Print one line a setting."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--studies", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    print(
        "boards  shift/mm  a90/mm  covered: ratio  with effect  percentile  "
        "median/mm: ratio  with effect  effect"
    )
    for boards in (20, 60):
        for shift_mm in (0.0, 1.0, 2.0):
            result = coverage(boards, shift_mm, options.studies, options.seed)
            print(
                f"{boards:6d}  {shift_mm:8.1f}  {result.true_mm:6.2f}  {result.by_ratio:14.3f}  "
                f"{result.over_boards:11.3f}  {result.by_percentile:10.3f}  "
                f"{result.median_ratio_mm:16.2f}  {result.median_boards_mm:11.2f}  "
                f"{result.median_effect:6.2f}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
