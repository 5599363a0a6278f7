"""Distances between two scans of a part with their level of detection: M3C2 (Lague, Brodu and
Leroux, ISPRS J. 82 (2013), 10), as py4dgeo defines it.

At a core point, the points of each scan within a cylinder along the normal are averaged; the
distance is the difference of both means along the normal. Its level of detection at 95 % is
1.96 (sqrt(s1^2 / n1 + s2^2 / n2) + registration). Where neighbours share their noise, n counts
independent ones, and what unchanged places differ by beyond all of this (a unit's fixed pattern, a
part that bends) is added: both are 0 in py4dgeo. Not modelled: a rim inside a cylinder, which
counts as its scatter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from detectors.pixels.noise import median_of, sigma_of

LOD_SIGMAS = 1.96
"""Standard deviations in a level of detection of 95 %."""
LEAST_SAMPLES = 4
"""Fewest points of a cylinder in each scan: fewer do not show the scatter."""


@dataclass(frozen=True, eq=False)
class Distances:
    """Distances at core points (n,), NaN where a cylinder holds too few points."""

    distance_m: np.ndarray
    """(n,): how far the later scan lies along the normals from the earlier one."""
    noise_m: np.ndarray
    """(n,): standard deviation of the distance by the scatter in both cylinders."""
    registration_m: np.ndarray
    """(n,): standard deviation by the placement."""
    common_m: float
    """Standard deviation of what unchanged places differ by beyond noise and placement."""

    @property
    def lod_m(self) -> np.ndarray:
        """The level of detection at 95 % (n,)."""
        random_m = np.hypot(self.noise_m, self.common_m)
        return np.asarray(LOD_SIGMAS * (random_m + self.registration_m))

    @property
    def is_significant(self) -> np.ndarray:
        """True where distances (n,) exceed their level of detection."""
        return np.abs(self.distance_m) > self.lod_m


def distances(
    earlier_m: np.ndarray,
    later_m: np.ndarray,
    *,
    cores_m: np.ndarray,
    normals: np.ndarray,
    radius_m: float,
    reach_m: float,
    registration_m: np.ndarray,
    shared: tuple[float, float] = (1.0, 1.0),
) -> Distances:
    """Return the distances of points ``later_m`` (k, 3) from ``earlier_m`` (m, 3) at core points
    (n, 3) along unit normals (n, 3).

    ``radius_m`` of the cylinders, ``reach_m`` half of their length; ``registration_m`` (n,);
    ``shared``: how many points of the earlier and of the later scan share their noise."""
    means_m = []
    variances_m2 = []
    for points_m, share in zip((earlier_m, later_m), shared, strict=True):
        mean_m, variance_m2, count = _along(points_m, cores_m, normals, radius_m, reach_m)
        means_m.append(mean_m)
        # all points of a cylinder may share one value of the noise, no more
        variances_m2.append(variance_m2 * np.minimum(share, count) / np.maximum(count, 1))
    distance_m = means_m[1] - means_m[0]
    noise_m = np.sqrt(variances_m2[0] + variances_m2[1])
    is_known = np.isfinite(distance_m)
    common_m2 = 0.0
    if is_known.any():
        scatter_m = sigma_of(distance_m[is_known] - median_of(distance_m[is_known]))
        explained_m2 = noise_m[is_known] ** 2 + registration_m[is_known] ** 2
        common_m2 = max(scatter_m**2 - median_of(explained_m2), 0.0)
    return Distances(
        distance_m=distance_m,
        noise_m=noise_m,
        registration_m=np.where(is_known, registration_m, np.nan),
        common_m=float(np.sqrt(common_m2)),
    )


def _along(
    points_m: np.ndarray,
    cores_m: np.ndarray,
    normals: np.ndarray,
    radius_m: float,
    reach_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean and variance (n,) of the points' distances along the normals in the cylinder of
    each core, NaN with fewer than `LEAST_SAMPLES`; and their number (n,)."""
    tree = cKDTree(points_m)
    means_m = np.full(len(cores_m), np.nan)
    variances_m2 = np.full(len(cores_m), np.nan)
    counts = np.zeros(len(cores_m))
    neighbours = tree.query_ball_point(cores_m, np.hypot(radius_m, reach_m))
    for number, members in enumerate(neighbours):
        arms = points_m[members] - cores_m[number]
        along = arms @ normals[number]
        across = arms - along[:, None] * normals[number]
        inside = ((across**2).sum(axis=1) <= radius_m**2) & (np.abs(along) <= reach_m)
        counts[number] = inside.sum()
        if counts[number] >= LEAST_SAMPLES:
            means_m[number] = along[inside].mean()
            variances_m2[number] = along[inside].var(ddof=1)
    return means_m, variances_m2, counts
