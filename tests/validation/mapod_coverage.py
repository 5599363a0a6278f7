"""How often a study's corrected limit lies above the true a90: ``python
tests/validation/mapod_coverage.py``.

Studies of a simulated camera are drawn from a curve with a50 = 4 and a90 = 5 mm, at places of
their sizes that differ. The real curve is ``k`` times as far to the right and its rise ``w`` times
as wide. Each campaign draws hits of real holes spread evenly over the drills from it, and corrects
a study of its own, of which nothing but hits is known: campaigns that share a study miss together,
so that 100 of 10 studies would tell the share to 0.04, not to 0.02. ``covered``: share of
campaigns whose combined a90/95 is at or over the true a90, with its exact 95 % interval; the
quoted one, of a contradicted study the larger of combined and measured, is never smaller. Nominal:
95 %. Beside it stand the combined limit as a multiple of the true a90, and that of the real hits
alone.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2])]

from harness.evaluation.intervals import clopper_pearson
from harness.evaluation.pod.curve import PodCurve
from harness.evaluation.pod.inspections import Inspections
from harness.evaluation.pod.statement import PodStatement, state_hits
from harness.programs.inspections.design_statistics import curve_through, even_sizes
from harness.programs.inspections.mapod import LIMIT_AT, Transfer
from harness.vocabulary.errors import UserError

DRILLS_MM = 2.0, 12.0
MEASURED = 40
"""Campaigns of a case, at most, of which the real hits alone are fitted."""


@dataclass(frozen=True)
class Coverage:
    """A case: factors ``k`` and ``w``, real ``holes``; ``covered``: share of ``campaigns``. Limits
    as multiples of the true a90: ``median`` and 90 % quantile ``high`` of the combined ones;
    median of the ``measured`` ones, infinite where half of the campaigns demonstrate none."""

    k: float
    w: float
    holes: int
    campaigns: int
    covered: float
    median: float
    high: float
    measured: float


def wrong_by(curve: PodCurve, k: float, w: float) -> PodCurve:
    """The true curve of a simulation that is wrong by factors k in size and w in the width of the
    rise."""
    half = curve.size_at(0.5)
    if curve.log_size:
        shift = np.log(half) - curve.mu
        return replace(curve, mu=np.log(k * half) - w * shift, sigma=curve.sigma * w)
    return replace(curve, mu=k * (half - w * (half - curve.mu)), sigma=curve.sigma * k * w)


def of_hits(size: np.ndarray, hit: np.ndarray) -> Inspections:
    """Inspections as a file would give them."""
    return Inspections(
        Path("drawn"), "size", "hit", size, hit.astype(float), None, np.arange(len(size))
    )


def drawn_studies(
    curve: PodCurve, number: int, targets: int, random: np.random.Generator
) -> list[PodStatement]:
    """Statements of studies of ``targets`` simulated holes; those without a rising curve are drawn
    again."""
    studies: list[PodStatement] = []
    while len(studies) < number:
        size = random.uniform(*DRILLS_MM, targets)
        try:
            studies.append(
                state_hits(of_hits(size, random.random(targets) < curve.pod(size)), tested=False)
            )
        except UserError:
            continue
    return studies


def combined_limits(study: PodStatement, size: np.ndarray, hits: np.ndarray) -> np.ndarray:
    """(c,) combined a90/95 of campaigns ``hits`` (c, n), as `Mapod` has it."""
    limits = []
    for fit in study.fits:
        if fit.curve.size_at(0.5) > 0:
            transfer = Transfer(fit.curve, size, hits[0], np.full(len(size), "all"))
            result, missed = transfer.logs
            value = hits @ result.T + ~hits @ missed.T + transfer.log_prior
            sizes = transfer.sizes_at(0.9)
            order = np.argsort(sizes, kind="stable")
            weights = np.exp(value - value.max(axis=1, keepdims=True))[:, order]
            below = np.cumsum(weights, axis=1)
            shares = zip(below, weights, strict=True)
            limits.append(
                [
                    np.interp(LIMIT_AT * sums[-1], sums - own_share / 2, sizes[order])
                    for sums, own_share in shares
                ]
            )
    return np.max(limits, axis=0)


def coverage(
    curve: PodCurve,
    cases: Sequence[tuple[float, float]],
    holes: int,
    *,
    campaigns: int,
    targets: int = 64,
) -> list[Coverage]:
    """Coverage of each case (k, w) with so many real ``holes``; each campaign corrects another
    study of ``targets``."""
    random = np.random.default_rng(1823)
    size = even_sizes(holes, DRILLS_MM)
    truths = [wrong_by(curve, *case) for case in cases]
    chances = np.array([truth.pod(size) for truth in truths])
    hits = random.random((campaigns, len(cases), holes)) < chances
    studies = drawn_studies(curve, campaigns, targets, random)
    limits = np.stack(
        [combined_limits(study, size, hit) for study, hit in zip(studies, hits, strict=True)]
    )
    rows = []
    for number, (case, truth) in enumerate(zip(cases, truths, strict=True)):
        true_mm = truth.size_at(0.9)
        alone = [measured_limit(size, hit) for hit in hits[:MEASURED, number]]
        scaled = limits[:, number] / true_mm
        k, w = case
        row = Coverage(
            k=k,
            w=w,
            holes=holes,
            campaigns=campaigns,
            covered=float((scaled >= 1).mean()),
            median=float(np.median(scaled)),
            high=float(np.quantile(scaled, 0.9)),
            measured=float(np.median(alone)) / true_mm,
        )
        rows.append(row)
    return rows


def measured_limit(size: np.ndarray, hit: np.ndarray) -> float:
    """Return a90/95 of real hits alone, infinite where they demonstrate none."""
    try:
        return state_hits(of_hits(size, hit), tested=False).bound.value
    except UserError:
        return float("inf")


def main() -> int:
    """Print a table for each number of holes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--holes", type=int, nargs="+", default=[24, 60])
    parser.add_argument("--targets", type=int, default=64, help="simulated holes of each study")
    parser.add_argument(
        "--campaigns", type=int, default=300, help="of each case, each with a study of its own"
    )
    parser.add_argument("--link", default="logit")
    parser.add_argument("--log", action=argparse.BooleanOptionalAction, default=True)
    args = parser.parse_args()
    curve = curve_through(4.0, 5.0, args.link, log_size=args.log)
    print("   k    w  holes  covered (95 % interval)  median  90 %  measured", flush=True)
    for holes in args.holes:
        cases = list(product((1.0, 1.25, 1.5, 2.0), (0.6, 1.0, 1.6)))
        for row in coverage(curve, cases, holes, campaigns=args.campaigns, targets=args.targets):
            low, high = clopper_pearson(round(row.covered * row.campaigns), row.campaigns)
            share = f"{row.covered:8.3f} ({low:.3f} to {high:.3f})"
            sizes = f"{row.median:7.2f} {row.high:5.2f} {row.measured:9.2f}"
            print(f"{row.k:4g} {row.w:4g} {row.holes:6d} {share} {sizes}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
