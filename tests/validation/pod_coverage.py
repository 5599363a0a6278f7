"""How often the bound on a90 lies above the true a90: ``python tests/validation/pod_coverage.py``.

Each study draws hits for sizes spread evenly over 0.5 to 10 mm from a known curve and bounds a90
from above: by a fit of the true link and scale with each method; then, as programs do, without
that knowledge: by the model with the least deviance ("best of 8"), and by the average of the models near it ("as
used"). A bound that is not demonstrated claims nothing false, so it counts
as above. Studies without a rising curve are counted apart. Nominal: 95 %.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2])]

from harness.evaluation.pod.averaged import ModelAverage
from harness.evaluation.pod.curve import PodCurve
from harness.evaluation.pod.hit_miss import (
    METHOD,
    bound,
    choose_model,
    fit_hit_miss,
    near_models,
)
from harness.vocabulary.errors import UserError

UNKNOWN = np.zeros((2, 2))
TRUTH = PodCurve("logit", False, 4.0, 0.8, UNKNOWN)
TRUTHS = (
    TRUTH,
    PodCurve("loglog", False, 4.0, 1.0, UNKNOWN),
    PodCurve("probit", False, 5.0, 1.2, UNKNOWN),
    PodCurve("cloglog", False, 5.0, 1.5, UNKNOWN),
    PodCurve("logit", True, float(np.log(3.5)), 0.25, UNKNOWN),
)
SMALLEST_MM = 0.5
LARGEST_MM = 10.0
CHOSEN = ("best of 8", "as used")


@dataclass(frozen=True)
class Coverage:
    """How often a bound holds the true a90."""

    method: str
    """Name of the bound."""
    studies: int
    """Number of studies with a rising curve."""
    above: int
    """Studies whose bound is at or over the true a90."""
    undemonstrated: int
    """Studies of these without a finite bound."""
    separated: int
    """Studies fitted by Firth's penalty."""
    refused: int
    """Studies without a rising curve, left out."""
    median_mm: float
    """Median bound."""

    @property
    def share(self) -> float:
        """Coverage."""
        return self.above / self.studies

    @property
    def standard_error(self) -> float:
        """Monte Carlo standard error of `share`."""
        return float(np.sqrt(self.share * (1.0 - self.share) / self.studies))


def coverage(
    studies: int,
    targets: int,
    methods: tuple[str, ...] = (METHOD, *CHOSEN),
    seed: int = 1823,
    truth: PodCurve = TRUTH,
) -> list[Coverage]:
    """Coverage of each method's a90/95 on the same simulated studies."""
    random = np.random.default_rng(seed)
    sizes = np.linspace(SMALLEST_MM, LARGEST_MM, targets)
    chance = truth.pod(sizes)
    limits: dict[str, list[float]] = {method: [] for method in methods}
    separated = 0
    refused = 0
    for _ in range(studies):
        try:
            hits = random.random(targets) < chance
            fit = fit_hit_miss(sizes, hits, link=truth.link, log_size=truth.log_size)
        except UserError:
            refused += 1
            continue
        separated += fit.method == "Firth"
        fits = {METHOD: (fit,)}
        if set(CHOSEN) & set(methods):
            tried = choose_model(sizes, hits)
            fits |= {CHOSEN[0]: tried[:1], CHOSEN[1]: near_models(tried)}
        for method in methods:
            if method == CHOSEN[1]:
                limits[method].append(ModelAverage(fits[method]).bound().value)
            else:
                limits[method].append(bound(fits[method][0]).value)
    true = truth.size_at(0.9)
    return [
        Coverage(
            method=method,
            studies=studies - refused,
            above=int(np.sum(np.array(values) >= true)),
            undemonstrated=int(np.isinf(values).sum()),
            separated=separated,
            refused=refused,
            median_mm=float(np.median(values)),
        )
        for method, values in limits.items()
    ]


def main() -> None:
    """Print the coverage of every method for every curve."""
    parser = argparse.ArgumentParser(description="Coverage of the bounds on a90, by simulation.")
    parser.add_argument("--studies", type=int, default=1000)
    parser.add_argument("--targets", type=int, default=60)
    wanted = parser.parse_args()
    for truth in TRUTHS:
        x = "ln a" if truth.log_size else "a"
        counts = f"{wanted.studies} studies, {wanted.targets} targets"
        print(f"{truth.link} of {x}, a90 {truth.size_at(0.9):.2f} mm: {counts}")
        for row in coverage(wanted.studies, wanted.targets, truth=truth):
            print(
                f"  {row.method:17s} {row.share:6.1%} +- {row.standard_error:.1%} "
                "(Monte Carlo, 1 s.e.), "
                f"median a90/95 {row.median_mm:.2f} mm, not demonstrated {row.undemonstrated}, "
                f"separated {row.separated}, refused {row.refused}"
            )


if __name__ == "__main__":
    main()
