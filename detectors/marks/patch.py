"""The plane under a mark, and the mark's place on it.

Depth noise averages over the patch: its slope is fitted to the mark and its surroundings together, its offset to the
mark alone, so that a thick mark, or one whose colour the camera ranges differently, is placed where it is measured. The
centroid is that of the pixels' rays cut by this plane, each weighted by the surface that it covers and by how much of
the mark's colour it has. Not modelled: a surface that bends within the mark.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from detectors.average import CORRELATED_PIXELS
from harness.vocabulary.capture import Cloud

PATCH_POINTS = 512
"""Points of the slope's fit: more share their noise with these, and only take time."""
LAR_STEPS, BISQUARE_STEPS = 5, 3
LEAST_SCALE_M = 1e-6


@dataclass(frozen=True)
class Patch:
    """The plane z = ``slope_x`` x + ``slope_y`` y + ``offset_m``, and the deviation of one point's z about it."""

    slope_x: float
    slope_y: float
    offset_m: float
    sigma_m: float

    @property
    def normal(self) -> np.ndarray:
        """Unit normal (3,) towards the camera (z points away from it)."""
        steep = np.array([self.slope_x, self.slope_y, -1.0])
        return np.asarray(steep / np.linalg.norm(steep))

    def above_m(self, points_m: np.ndarray) -> np.ndarray:
        """Return z of points (n, 3) less the plane's: positive behind it."""
        x, y, z = points_m.T
        return np.asarray(z - self.slope_x * x - self.slope_y * y - self.offset_m)

    def cut(self, points_m: np.ndarray, projection: str) -> np.ndarray:
        """Return the places (n, 3) at which the rays of points (n, 3) meet the plane."""
        x, y, z = points_m.T
        if projection == "parallel":
            return np.stack([x, y, z - self.above_m(points_m)], axis=1)
        scale = self.offset_m / (z - self.slope_x * x - self.slope_y * y)
        return np.asarray(points_m * scale[:, None])


@dataclass(frozen=True)
class Spot:
    """A mark's place: ``centre_m`` (3,), ``area_m2``, ``length_m`` and ``breadth_m`` of the rectangle with its second
    moments, ``pitch_m`` between pixels there, and ``behind_m``: how far its mean lies behind its surroundings, with the
    standard deviation ``behind_sigma_m``. ``range_covariance_m2`` (3, 3): of the centre by the mean range alone;
    ``grid_steps_m`` (3, 2): how the centre moves with the grid's co-ordinates."""

    centre_m: np.ndarray
    range_covariance_m2: np.ndarray
    grid_steps_m: np.ndarray
    normal: np.ndarray
    area_m2: float
    length_m: float
    breadth_m: float
    pitch_m: float
    behind_m: float
    behind_sigma_m: float

    def covariance_m2(self, grid_covariance: np.ndarray) -> np.ndarray:
        """Return the covariance (3, 3) of the centre: by the mean range along the ray, by the centroid's on the grid
        (2, 2) in the plane."""
        covariance = self.range_covariance_m2 + self.grid_steps_m @ grid_covariance @ self.grid_steps_m.T
        return np.asarray((covariance + covariance.T) / 2)


def fit_patch(points_m: np.ndarray) -> Patch | None:
    """Fit the plane of most of some points (n, 3): least absolute residuals, then bisquare. None where they are too few
    or on a line. Up to a third of them may lie off it."""
    points = points_m[:: max(1, len(points_m) // PATCH_POINTS)]
    if len(points) < 6:
        return None
    middle = np.median(points, axis=0)
    basis = np.column_stack([points[:, :2] - middle[:2], np.ones(len(points))])
    z = points[:, 2] - middle[2]
    if np.linalg.matrix_rank(basis[:, :2], tol=1e-9) < 2:
        return None
    weight = np.ones(len(points))
    for step in range(LAR_STEPS + BISQUARE_STEPS + 1):
        weighted = basis * weight[:, None]
        solved = np.linalg.solve(weighted.T @ basis, weighted.T @ z)
        size = np.abs(z - basis @ solved)
        scale = max(float(np.median(size)) / 0.6745, LEAST_SCALE_M)
        if step < LAR_STEPS:
            weight = 1.0 / np.maximum(size, 0.1 * scale)
        else:
            weight = np.maximum(1.0 - (size / (4.685 * scale)) ** 2, 0.0) ** 2
    a, b, c = solved.tolist()
    # the median of all sizes counts the points off the plane too
    sigma = float(np.sqrt(np.mean(size[size <= 3.0 * scale] ** 2)))
    return Patch(a, b, middle[2] + c - a * middle[0] - b * middle[1], max(sigma, LEAST_SCALE_M))


def place_spot(cloud: Cloud, pixels: np.ndarray, weights: np.ndarray, grid: np.ndarray, patch: Patch) -> Spot:
    """Return a mark's place from its pixels (n,) flat indices of points, ``weights`` (n,) 0..1 of its colour, and their
    positions ``grid`` (n, 2) on a grid of unit step."""
    points = cloud.points_m.reshape(-1, 3)[pixels]
    own = weights > 0.5
    # the mean height of those points within four scales of the median
    height = patch.above_m(points[own])
    middle = float(np.median(height))
    scale = max(float(np.median(np.abs(height - middle))) / 0.6745, LEAST_SCALE_M)
    kept = height[np.abs(height - middle) <= 4.0 * scale]
    behind, sigma = float(kept.mean()), float(max(kept.std(), scale))
    settled = replace(patch, offset_m=patch.offset_m + behind)
    on_plane = settled.cut(points, cloud.projection)
    covers = weights * (on_plane[:, 2] ** 3 if cloud.projection == "central" else 1.0)
    centre = np.average(on_plane, axis=0, weights=covers)
    jacobian = np.linalg.lstsq(grid - grid.mean(axis=0), on_plane - centre, rcond=None)[0].T
    mean_sigma = mean_sigma_m(cloud, pixels[own], sigma)
    ray = centre / centre[2] if cloud.projection == "central" else np.array([0.0, 0.0, 1.0])
    # a plane shifted along z by d is met further along the ray by d n_z / n.ray of it
    along = ray * settled.normal[2] / (settled.normal @ ray)
    scatter = np.cov((on_plane - centre).T, aweights=covers, ddof=0)
    _, minor, major = np.sqrt(12.0 * np.maximum(np.linalg.eigvalsh(scatter), 0.0))
    pixel_area = float(np.linalg.norm(np.cross(jacobian[:, 0], jacobian[:, 1])))
    return Spot(
        centre_m=centre,
        range_covariance_m2=mean_sigma**2 * np.outer(along, along),
        grid_steps_m=jacobian,
        normal=settled.normal,
        area_m2=pixel_area * float(weights.sum()),
        length_m=float(major),
        breadth_m=float(minor),
        pitch_m=float(np.sqrt(pixel_area)),
        behind_m=behind,
        # of a flat mark: a hole's own depths differ, which must not excuse it
        behind_sigma_m=patch.sigma_m * float(np.sqrt(2.0 * min(1.0, CORRELATED_PIXELS / len(pixels)))),
    )


def mean_sigma_m(cloud: Cloud, pixels: np.ndarray, sigma_m: float) -> float:
    """Return the standard deviation of the pixels' mean z: of what is left about the plane, or of the averaged frames'
    noise if that is more, `CORRELATED_PIXELS` sharing one value; and of no less than the maker of a map states."""
    count = np.maximum(cloud.count.ravel()[pixels], 1)
    frames = cloud.variance_m2.ravel()[pixels] / count
    known = frames[np.isfinite(frames)]
    variance = max(sigma_m**2, float(known.mean()) if len(known) else 0.0)
    if cloud.mean_variance_m2 is not None:
        stated = cloud.mean_variance_m2.ravel()[pixels]
        variance = max(variance, float(np.nanmean(stated)) if np.isfinite(stated).any() else 0.0)
    return float(np.sqrt(variance * min(1.0, CORRELATED_PIXELS / len(pixels))))
