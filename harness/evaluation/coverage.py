"""The smallest damage found nine times in ten at each patch of a part, and the poses that cover most of it.

The logarithm of a damage's strength (d' of the ideal observer at a noise of 1 m) is a quadratic of the logarithms of
its size and of the cosine of the angle of incidence, and linear in that of the range. Over the noise at a place it is
d'. A patch's limit is the smallest size with the d' from which the detector finds damage nine times in ten."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.evaluation.pod.hit_miss import fit_hit_miss
from harness.evaluation.pod.statement import POD
from harness.vocabulary.errors import UserError

SIZES = 400
"""Sizes between the smallest and the largest inspected, in equal ratios, at which a patch is asked."""
BEYOND_DEG = 3.0
"""Angle by which a patch may be steeper than every damage that was inspected."""
LOOSE = 2.0
"""d' found nine times in ten over that found half the time, beyond which hits do not follow d' (noise makes 1.28)."""
FEWEST = 20
"""Damages without which nothing is learnt."""


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of a part's face: ``points_m`` and unit ``normals`` (n, 3), board frame, and ``areas_m2`` (n,)."""

    points_m: np.ndarray
    normals: np.ndarray
    areas_m2: np.ndarray

    def share(self, some: np.ndarray) -> float:
        """Return the share of the area that some patches (n,) bool have."""
        return float(self.areas_m2[some].sum() / self.areas_m2.sum())


@dataclass(frozen=True, eq=False)
class Seen:
    """Places, (n,): noise ``deviation_m``, infinite where not judged; ``cosine`` of incidence, ``range_m``."""

    deviation_m: np.ndarray
    cosine: np.ndarray
    range_m: np.ndarray


@dataclass(frozen=True, eq=False)
class Damages:
    """Damages that a detector inspected, (n,) each: ``size_mm`` of what ``size_of`` names, how they are ``seen``, their
    ``strength`` in 1/m, and in how many of the ``inspections`` they were found, ``hits``."""

    size_of: str
    size_mm: np.ndarray
    seen: Seen
    strength: np.ndarray
    hits: np.ndarray
    inspections: np.ndarray


@dataclass(frozen=True, eq=False)
class Findable:
    """Law by which damage shows and is found. ``index``, ``index_50``: d' found nine times in ten, half the time;
    ``scatter``: rms of ln strength about the quadratic of ``coefficients``; ``steepest``: least cosine inspected."""

    size_of: str
    coefficients: np.ndarray
    scatter: float
    index: float
    index_50: float
    sizes_mm: tuple[float, float]
    steepest: float
    damages: int

    @property
    def said(self) -> str:
        """Return what was learnt, in a sentence."""
        return (
            f"Learnt from {self.damages} damages, whose strength scatters by {100 * self.scatter:.0f} % about what "
            f"size, angle and distance say; found nine times in ten from a d' of {self.index:.3g} on. The limit of a "
            "single patch may be wrong by a third."
        )

    @property
    def doubt(self) -> str:
        """Return why the limits are rough; empty where hits follow the predicted d' about as well as noise allows."""
        if self.index <= LOOSE * self.index_50:
            return ""
        return (
            "what is found depends on more than the predicted signal: damage is found half the time from a d' of "
            f"{self.index_50:.3g} on, but nine times in ten from {self.index:.3g} on only (noise alone makes 1.3 times "
            "as much). Limits are rough and may be far too large: run a study in these poses before you rely on them"
        )

    def limits_mm(self, seen: Seen) -> np.ndarray:
        """Return a90 (n,) of places: the size from which on all up to the largest inspected are found, infinite where
        there is none; NaN where nothing is judged, and where the angle is steeper than all inspected."""
        sizes_mm = np.geomspace(*self.sizes_mm, SIZES)
        places = (np.maximum(seen.cosine, self.steepest)[:, None], seen.range_m[:, None])
        log = _features(*np.broadcast_arrays(sizes_mm, *places)) @ self.coefficients
        found = log - np.log(seen.deviation_m)[:, None] >= np.log(self.index)
        found = np.logical_and.accumulate(found[:, ::-1], axis=1)[:, ::-1]
        beyond = np.cos(min(np.arccos(self.steepest) + np.deg2rad(BEYOND_DEG), np.pi / 2))
        limits_mm = np.where(found.any(axis=1), sizes_mm[found.argmax(axis=1)], np.inf)
        return np.where(np.isfinite(seen.deviation_m) & (seen.cosine >= beyond), limits_mm, np.nan)


def _features(size_mm: np.ndarray, cosine: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """(..., 7): what the logarithm of strength is linear in."""
    a, c, r = (np.log(each) for each in (size_mm, cosine, range_m))
    return np.stack([np.ones_like(a), a, a**2, c, c**2, a * c, r], axis=-1)


def findable(damages: Damages) -> Findable:
    """Learn from the damages that were judged and show anything. Raises UserError where that is not enough."""
    judged = np.isfinite(damages.seen.deviation_m) & (damages.strength > 0)
    if judged.sum() < FEWEST:
        said = f"only {judged.sum()} of {len(judged)} damages were judged and show in the distances"
        raise UserError(f"{said}: no limit can be learnt", fix="check the detector's crop, and the sizes of the damage")
    size_mm, strength, cosine = damages.size_mm[judged], np.log(damages.strength[judged]), damages.seen.cosine[judged]
    noise, features = np.log(damages.seen.deviation_m[judged]), _features(size_mm, cosine, damages.seen.range_m[judged])
    hits, inspections = (each[judged].astype(int) for each in (damages.hits, damages.inspections))
    each = np.repeat(np.arange(len(hits)), inspections)
    hit = np.concatenate([np.arange(n) < k for n, k in zip(inspections, hits, strict=True)])
    weights, needed, half = np.ones(len(hits)), np.nan, np.nan
    for _ in range(2):
        root = np.sqrt(weights)
        coefficients = np.linalg.lstsq(features * root[:, None], strength * root, rcond=None)[0]
        fitted = features @ coefficients
        scatter = float(np.sqrt((weights * (strength - fitted) ** 2).sum() / weights.sum()))
        index = np.exp(fitted - noise)
        fit = fit_hit_miss(index[each], hit, link="probit", log_size=True, inspections=each)
        needed, half = fit.curve.size_at(POD), fit.curve.size_at(0.5)
        weights = 1 / (1 + np.log(index / needed) ** 2)  # damages found now and then decide the limit
    sizes_mm = (float(size_mm.min()), float(size_mm.max()))
    return Findable(damages.size_of, coefficients, scatter, needed, half, sizes_mm, float(cosine.min()), len(hits))


def in_turn(patches: Patches, found: Sequence[np.ndarray], given: int, further: int) -> list[tuple[int, float, float]]:
    """Return the first ``given`` of some poses, in which damage is ``found`` on patches (n,) bool, then up to
    ``further`` of the others, ever the one that adds most: each pose's place among them, the share of the area that it
    adds to those before it, and the share that all cover until then."""
    covered, rows = np.zeros(len(patches.areas_m2), bool), list[tuple[int, float, float]]()
    for turn in range(given + further):
        gains = [patches.share(some & ~covered) for some in found]
        best = turn if turn < given else int(np.argmax(gains))
        if turn >= given and gains[best] <= 0:
            break
        covered = covered | found[best]
        rows.append((best, gains[best], patches.share(covered)))
    return rows
