"""POD over diameter and depth, where a study varies both: blind holes and dents.

F^-1(POD) = b0 + b1 ln a + b2 ln d, and with b3 ln a ln d where a likelihood ratio test at 5 % asks for it and POD still
grows with both everywhere inside what was inspected: few damages can bend a surface so that it falls where there are
none. Logit or probit, whichever has less deviance. a = diameter, d = depth of removed material. Extrapolation beyond
the sizes and depths inspected is not meant. Not modelled: floor and ceiling; a bound by likelihood ratio (intervals are
over boards).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.evaluation.intervals import UNKNOWN, Interval, percentiles
from harness.evaluation.pod.curve import link_cdf, link_ppf
from harness.evaluation.pod.likelihood import HitsAndMisses, maxima
from harness.evaluation.study.over_boards import DRAWS, row_weights
from harness.evaluation.study.record import SetUpRecord

LINKS = ("logit", "probit")
LEAST_RATIO = 1.2
"""Deepest over shallowest damage below which a coefficient of depth would be guesswork."""
DEPTHS = 25
"""Depths at which a90 is drawn, in equal ratios over those inspected."""


@dataclass(frozen=True, eq=False)
class PodSurface:
    """``b`` (3,) or (4,): coefficients of 1, ln a, ln d and ln a ln d, sizes in mm; ``interaction_p``: p-value of the
    last. ``depth_mm`` (k,), ``a90_mm`` (k,) with ``a90_low_mm``, ``a90_high_mm`` (k,) 95 % percentiles over boards,
    which hold the truth in some 87 % of studies of 30 boards; infinite where none. ``depth_slope``: minus d ln a90 /
    d ln depth (b2 / b1, with an interaction at mean ln a and ln d), with its interval. ``diameter_range_mm``,
    ``depth_range_mm``: inspected. ``note``: what to know beside it, "" where there is nothing."""

    link: str
    b: np.ndarray
    interaction_p: float
    deviance: float
    depth_mm: np.ndarray
    a90_mm: np.ndarray
    a90_low_mm: np.ndarray
    a90_high_mm: np.ndarray
    depth_slope: float
    depth_slope_interval: Interval
    diameter_range_mm: tuple[float, float]
    depth_range_mm: tuple[float, float]
    note: str = ""

    def pod(self, diameter_mm: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
        """POD at diameters and depths of a common shape."""
        a, d = np.broadcast_arrays(np.log(diameter_mm), np.log(depth_mm))
        return link_cdf(self.link, _design(a, d, len(self.b) > 3) @ self.b)


def depth_varies(depth_mm: np.ndarray) -> bool:
    """Return whether depths (n,) differ enough to matter."""
    return bool(len(depth_mm) and depth_mm.max() >= LEAST_RATIO * depth_mm.min())


def surface_of(record: SetUpRecord, draws: int = DRAWS) -> tuple[PodSurface | None, str]:
    """Fit the surface; None, and why, where there is none."""
    from scipy.stats import chi2

    seen = record.inspected
    hit = seen.hit
    if not len(hit) or hit.all() or not hit.any():
        return None, "every damage fared alike: there is no surface to fit"
    if seen.depth_mm.min() <= 0 or not depth_varies(seen.depth_mm):
        return None, f"depth does not vary: {seen.depth_mm.min():g} to {seen.depth_mm.max():g} mm"
    if np.ptp(seen.diameter_mm) == 0:
        return None, f"diameter does not vary: {seen.diameter_mm[0]:g} mm"
    a, d = np.log(seen.diameter_mm), np.log(seen.depth_mm)
    if _separated(_design(a, d, False), hit):
        return None, "hits and misses do not overlap over diameter and depth (separation): no maximum likelihood"
    repeats = len(hit) / len({*zip(seen.board.tolist(), seen.hole.tolist(), strict=True)})

    def fit(link: str, crossed: bool) -> tuple[float, np.ndarray, str]:
        """Deviance, coefficients and link."""
        design, hits = _design(a, d, crossed), hit.astype(float)
        b = _coefficients(design, hits[None], 1 - hits[None], link)[0]
        return float(-2 * HitsAndMisses(design, hits, 1 - hits, link).value(b)), b, link

    deviance, b, link = min((fit(link, False) for link in LINKS), key=lambda one: one[0])
    p, note = np.nan, "POD falls with depth" if b[2] < 0 else ""
    rises = b[1] > 0
    if not _separated(_design(a, d, True), hit):
        less, bent, _ = fit(link, True)
        p = float(chi2.sf(max(deviance - less, 0.0) / repeats, 1))
        if p < 0.05:
            # The slope along the one is linear in the other, so its ends tell.
            along = min(_slopes(bent[None], 0.0, end)[0][0] for end in (d.min(), d.max()))
            across = min(_slopes(bent[None], end, 0.0)[1][0] for end in (a.min(), a.max()))
            falling = " and ".join(name for name, slope in (("diameter", along), ("depth", across)) if slope < 0)
            if falling:
                note = f"with an interaction POD would fall with {falling} inside what was inspected: fitted without"
            else:
                deviance, b, note, rises = less, bent, "", True
    if not rises:
        return None, "the chance of detection does not grow with diameter"

    weights = row_weights(seen.board, draws)
    drawn = _coefficients(_design(a, d, len(b) > 3), weights * hit, weights * ~hit, link, b)
    depths = np.geomspace(seen.depth_mm.min(), seen.depth_mm.max(), DEPTHS)
    along, across = _slopes(np.vstack([b, drawn]), a.mean(), d.mean())
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(along > 0, across / along, np.nan)
    many = len(np.unique(seen.board)) > 1
    edges = [percentiles(column) if many else UNKNOWN for column in _a90(drawn, link, np.log(depths)).T]
    return PodSurface(
        link=link,
        b=b,
        interaction_p=p,
        deviance=deviance,
        depth_mm=depths,
        a90_mm=_a90(b[None], link, np.log(depths))[0],
        a90_low_mm=np.array([edge.low for edge in edges]),
        a90_high_mm=np.array([edge.high for edge in edges]),
        depth_slope=float(slope[0]),
        depth_slope_interval=percentiles(slope[1:]) if many else UNKNOWN,
        diameter_range_mm=(float(seen.diameter_mm.min()), float(seen.diameter_mm.max())),
        depth_range_mm=(float(seen.depth_mm.min()), float(seen.depth_mm.max())),
        note=note,
    ), ""


def _coefficients(
    design: np.ndarray, hits: np.ndarray, misses: np.ndarray, link: str, start: np.ndarray | None = None
) -> np.ndarray:
    """(draws, p) coefficients; columns are centred and scaled for the search, whose first column is the constant."""
    centre, scale = design[:, 1:].mean(axis=0), design[:, 1:].std(axis=0)
    back = np.eye(design.shape[1])
    back[1:, 1:] = np.diag(1 / scale)
    back[0, 1:] = -centre / scale
    z = np.column_stack([np.ones(len(design)), (design[:, 1:] - centre) / scale])
    first = np.zeros(design.shape[1]) if start is None else np.linalg.solve(back, start)
    return maxima(HitsAndMisses(z, hits, misses, link), first) @ back.T


def _design(a: np.ndarray, d: np.ndarray, crossed: bool) -> np.ndarray:
    """(..., 3) or (..., 4) columns 1, ln a, ln d and their product."""
    return np.stack([np.ones_like(a), a, d, *([a * d] if crossed else [])], axis=-1)


def _slopes(b: np.ndarray, a: float, d: float) -> tuple[np.ndarray, np.ndarray]:
    """(draws,) slopes of the predictor along ln a and ln d at one point."""
    product = b[:, 3] if b.shape[1] > 3 else np.zeros(len(b))
    return b[:, 1] + product * d, b[:, 2] + product * a


def _a90(b: np.ndarray, link: str, log_depth: np.ndarray) -> np.ndarray:
    """(draws, k) diameters with a POD of 90 % at each depth; infinite where POD does not grow with diameter there."""
    product = b[:, 3:4] if b.shape[1] > 3 else np.zeros((len(b), 1))
    along = b[:, 1:2] + product * log_depth
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        size = np.exp((float(link_ppf(link, np.array(0.9))) - b[:, :1] - b[:, 2:3] * log_depth) / along)
    return np.where(along > 0, size, np.inf)


def _separated(design: np.ndarray, hit: np.ndarray) -> bool:
    """Return whether a plane parts hits from misses (Albert and Anderson, Biometrika 71 (1984), 1), by linear
    programming: the largest sum of one-sided margins, which is 0 where hits and misses overlap."""
    from scipy.optimize import linprog

    scaled = np.column_stack([np.ones(len(design)), (design[:, 1:] - design[:, 1:].mean(0)) / design[:, 1:].std(0)])
    signed = np.where(hit, 1.0, -1.0)[:, None] * scaled
    found = linprog(-signed.sum(axis=0), A_ub=-signed, b_ub=np.zeros(len(signed)), bounds=(-1, 1), method="highs")
    return bool(-found.fun > 1e-7 * len(signed))
