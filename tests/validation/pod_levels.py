"""The tails of the averaged bound, and how it covers: ``python tests/validation/pod_levels.py``.

Simulated studies draw hits at evenly spread sizes of 0.5 to 10 mm from known curves. A bound with
tail t covers the true a90 where the weight of curves with a larger a90 is at least t, so that one
pass shows the coverage of every tail. The tail of a number of targets is the largest with which
coverage is at least `MEAN` on average over `CURVES` and `LEAST` for each. With ``--unused``,
coverage and bound of the library's tails are printed for curves and sizes that set nothing.

The likelihoods of all studies are taken on one grid; ``tests/harness/evaluation/pod/
test_pod_averaged.py`` compares them with the library's.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2])]

from harness.evaluation.pod.averaged import NARROWEST, WIDEST, curves_of, log_weights, tail_of
from harness.evaluation.pod.curve import LINKS, PodCurve, link_ppf, logs_of_link
from harness.evaluation.pod.hit_miss import NEAR_DEVIANCE, criterion

MEAN = 0.97
LEAST = 0.90
TARGETS = (10, 15, 20, 30, 40, 60, 100, 200)
TAILS = (0.02, 0.025, 0.03, 0.035, 0.04, 0.05, 0.06, 0.07, 0.08, 0.1, 0.12, 0.15)
UNKNOWN = np.zeros((2, 2))


def _curve(link: str, log_size: bool, mu: float, sigma: float) -> PodCurve:
    return PodCurve(link, log_size, float(mu), sigma, UNKNOWN)


CURVES = (
    _curve("logit", False, 4.0, 0.8),
    _curve("loglog", False, 4.0, 1.0),
    _curve("probit", False, 5.0, 1.2),
    _curve("cloglog", False, 5.0, 1.5),
    _curve("logit", True, np.log(3.5), 0.25),
    _curve("logit", False, 4.0, 0.2),
    _curve("probit", False, 4.3, 0.3),
    _curve("logit", False, 5.0, 1.5),
    _curve("probit", True, np.log(4.0), 0.15),
    _curve("loglog", True, np.log(3.0), 0.3),
    _curve("cloglog", True, np.log(5.0), 0.4),
    _curve("probit", False, 3.0, 0.6),
    _curve("logit", False, 6.0, 0.7),
    _curve("probit", False, 6.0, 2.0),
    _curve("loglog", False, 3.5, 0.5),
    _curve("probit", False, 6.0, 3.0),
    _curve("logit", False, 4.5, 2.0),
    _curve("logit", False, 2.0, 0.4),
    _curve("cloglog", False, 7.0, 1.5),
    _curve("loglog", True, np.log(4.0), 0.15),
)
UNUSED = (
    _curve("logit", False, 5.5, 0.5),
    _curve("probit", False, 3.5, 1.5),
    _curve("loglog", False, 4.5, 0.8),
    _curve("cloglog", False, 4.0, 0.7),
    _curve("probit", True, np.log(4.5), 0.3),
    _curve("cloglog", True, np.log(3.5), 0.2),
    _curve("logit", False, 6.5, 0.3),
    _curve("loglog", True, np.log(5.0), 0.08),
)


@dataclass(frozen=True, eq=False)
class Studies:
    """Weights of curves by a90, of several simulated studies."""

    sizes_mm: np.ndarray
    """a90 (m,) of the curves, ascending."""
    weight: np.ndarray
    """Their weights (s, m); the sum of each study is 1."""
    constant: np.ndarray
    """Whether (s,) a constant probability is not rejected."""

    def beyond(self, size_mm: float) -> np.ndarray:
        """Return the weight (s,) of curves with a larger a90; 1 where nothing is demonstrated."""
        beyond = self.weight[:, self.sizes_mm > size_mm].sum(axis=1)
        return np.where(self.constant, 1.0, beyond)

    def bounds(self, tail: float) -> np.ndarray:
        """Return the bounds (s,)."""
        below = np.cumsum(self.weight, axis=1) - self.weight / 2
        bounds = [np.interp(1.0 - tail, shares, self.sizes_mm) for shares in below]
        return np.where(self.constant, np.inf, bounds)


def weighted(
    sizes_mm: np.ndarray, hits: np.ndarray, middles: int = 72, widths: int = 28
) -> Studies:
    """Weigh curves by the hits (s, n) of studies with the same sizes (n,)."""
    targets = len(sizes_mm)
    least = min(NARROWEST / (targets - 1), 1.0)
    log_width = np.linspace(np.log(least), np.log(WIDEST), widths)
    hit_weights = hits.astype(np.float32)
    values = []
    cells = []
    a90_mm = []
    for log_size, link in product((False, True), LINKS):
        x = np.log(sizes_mm) if log_size else sizes_mm
        range_x = float(np.ptp(x))
        inside = np.linspace(x.min(), x.max(), middles)
        step = inside[1] - inside[0]
        steps = np.arange(1, middles + 1)
        middle = np.concatenate([x.min() - step * steps[::-1], inside, x.max() + step * steps])
        middle_grid, width_grid = np.meshgrid(middle, np.exp(log_width))
        all_middles = middle_grid.ravel()
        all_widths = width_grid.ravel()
        mu, sigma = curves_of(link, all_middles, all_widths * range_x)
        log_hit, log_miss, _ = logs_of_link(link, (x[:, None] - mu) / sigma)
        log_hit = np.maximum(log_hit, -1e6).astype(np.float32)
        log_miss = np.maximum(log_miss, -1e6).astype(np.float32)
        values.append(hit_weights @ log_hit + (1 - hit_weights) @ log_miss)
        cells.append(log_weights(all_widths, targets))
        x90 = mu + sigma * float(link_ppf(link, np.array(0.9)))
        with np.errstate(over="ignore"):
            a90_mm.append(np.exp(x90) if log_size else x90)
    deviance = np.array([-2.0 * value.max(axis=1) for value in values])
    near = deviance <= deviance.min(axis=0) + NEAR_DEVIANCE
    top = np.max([value.max(axis=1) for value in values], axis=0)
    weights = []
    for value, cell, is_near in zip(values, cells, near, strict=True):
        weights.append(np.exp(value - top[:, None] + cell) * is_near[:, None])
    weight = np.concatenate(weights, axis=1)
    sizes = np.concatenate(a90_mm)
    order = np.argsort(sizes, kind="stable")
    share = hits.mean(axis=1)
    null = -2.0 * targets * (share * np.log(share) + (1 - share) * np.log1p(-share))
    return Studies(
        sizes_mm=sizes[order],
        weight=weight[:, order] / weight.sum(axis=1, keepdims=True),
        constant=null - deviance.min(axis=0) <= criterion(0.95),
    )


def drawn(
    curve: PodCurve, sizes_mm: np.ndarray, studies: int, random: np.random.Generator
) -> np.ndarray:
    """Draw hits (s, n); studies that find all or nothing are left out."""
    hits = random.random((studies, len(sizes_mm))) < curve.pod(sizes_mm)
    return hits[hits.any(axis=1) & ~hits.all(axis=1)]


def coverage(targets: int, studies: int, seed: int = 1) -> np.ndarray:
    """Return the coverage (curves, tails) of `TAILS` for `CURVES`."""
    random = np.random.default_rng([seed, targets])
    sizes_mm = np.linspace(0.5, 10.0, targets)
    rows = []
    for curve in CURVES:
        beyond = weighted(sizes_mm, drawn(curve, sizes_mm, studies, random)).beyond(
            curve.size_at(0.9)
        )
        rows.append([float((beyond >= tail).mean()) for tail in TAILS])
    return np.array(rows)


def print_unused(targets: int, studies: int) -> None:
    """Print coverage and bounds for curves that set nothing, at even and at random sizes."""
    random = np.random.default_rng([2, targets])
    tail = tail_of(targets)
    even_mm = np.linspace(0.5, 10.0, targets)
    random_mm = np.sort(random.uniform(1.0, 12.0, targets))
    dense_mm = np.sort(np.concatenate([even_mm[::2], random.uniform(3, 7, targets // 2)]))
    for name, sizes_mm in (("even", even_mm), ("random", random_mm), ("near the rise", dense_mm)):
        for curve in UNUSED:
            true_mm = curve.size_at(0.9)
            judged = weighted(sizes_mm, drawn(curve, sizes_mm, studies, random))
            covered = float((judged.beyond(true_mm) >= tail).mean())
            ratio = float(np.median(judged.bounds(tail))) / true_mm
            x = "ln a" if curve.log_size else "a"
            print(
                f"{targets:4d} targets, {name:13s} {curve.link:7s} of {x:4s} sigma "
                f"{curve.sigma:.2f}: covered {covered:.3f}, median {ratio:.2f} times a90",
                flush=True,
            )


def main() -> None:
    """Print the tails, or the coverage for unused curves."""
    parser = argparse.ArgumentParser(description="Tails of the bound averaged over models.")
    parser.add_argument("--studies", type=int, default=400)
    parser.add_argument("--targets", type=int, nargs="+", default=TARGETS)
    parser.add_argument("--unused", action="store_true", help="curves that set nothing")
    wanted = parser.parse_args()
    for targets in wanted.targets:
        if wanted.unused:
            print_unused(targets, wanted.studies)
            continue
        covered = coverage(targets, wanted.studies)
        kept = (covered.mean(axis=0) >= MEAN) & (covered.min(axis=0) >= LEAST)
        tail = max(np.array(TAILS)[kept], default=float("nan"))
        print(f"{targets} targets: tail {tail:g}")
        for number, level in enumerate(TAILS):
            column = covered[:, number]
            print(
                f"    {level:.3f}  mean {column.mean():.3f}  least {column.min():.3f}", flush=True
            )


if __name__ == "__main__":
    main()
