"""Point spacing and noise of a view's target: the scale of residuals, overlaps and tolerances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from detectors.average import CORRELATED_PIXELS
from detectors.views import PreparedView
from harness.vocabulary.capture import Cloud

NOISE_LAG = 6
"""Pixels between the three points of a second difference: one more than the 5 x 5 window of the widest depth filter, so
that their errors are independent."""
MEDIAN_TO_SIGMA = 1 / 0.6745
"""Standard deviation of a Gaussian over its median absolute deviation."""
THINNED_POINTS = 2000
"""Points of a view on which overlap and agreement are judged: a share is then known to 1 %."""


@dataclass(frozen=True)
class Sampling:
    """One view's target, camera frame of the view, metres.

    ``pitch_m``: median distance between neighbouring points, the longer way of the grid. ``noise_m``: standard
    deviation of one point across the surface, fixed pattern included, smooth errors not. ``centre_m`` (3,), ``normal``
    (3,): of the plane through the points, towards the camera. ``extent_m``: half the diagonal of the points' box.
    """

    pitch_m: float
    noise_m: float
    centre_m: np.ndarray
    normal: np.ndarray
    extent_m: float


def sampling_of(view: PreparedView) -> Sampling:
    """Measure a view's target. A target of fewer than three points has no plane: its normal is the optical axis'."""
    points = view.points_m
    centre, normal = plane_through(points)
    organised = view.view.cloud.organised and view.view.cloud.points_m.shape[0] > 1
    pitch = _grid_pitch(view.view.cloud, view.inside) if organised else float("nan")
    if not np.isfinite(pitch):
        pitch = _nearest_pitch(points)
    noise = _grid_noise(view.view.cloud, view.inside) if organised else float("nan")
    if not np.isfinite(noise):
        noise = _local_noise(points)
    extent = float(np.linalg.norm(np.ptp(points, axis=0))) / 2 if len(points) else 0.0
    least = view.view.cloud.z_step_m / np.sqrt(12.0 * max(view.view.cloud.n_frames, 1))
    return Sampling(pitch, max(noise, least), centre, normal, extent)


def plane_through(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroid (3,) of points (n, 3) and the unit normal (3,) of their least-squares plane, towards the origin."""
    if len(points_m) < 3:
        middle = points_m.mean(axis=0) if len(points_m) else np.zeros(3)
        return middle, np.array([0.0, 0.0, -1.0])
    centre = points_m.mean(axis=0)
    arm = points_m - centre
    normal = np.linalg.eigh(arm.T @ arm)[1][:, 0]
    return centre, normal if normal @ centre <= 0 else -normal


def thinned(points_m: np.ndarray, most: int = THINNED_POINTS) -> np.ndarray:
    """Return at most ``most`` of points (n, 3), evenly strided in the order of the grid."""
    return points_m[:: max(1, -(-len(points_m) // most))]


def independent(points: int) -> float:
    """Return the number of independent values among correlated pixels, for the widest depth filter; at least 1."""
    return max(points / CORRELATED_PIXELS, 1.0)


def _grid_pitch(cloud: Cloud, inside: np.ndarray) -> float:
    grid = np.where(inside[..., None], cloud.points_m, np.nan)
    steps = []
    for axis in (0, 1):
        lengths = np.linalg.norm(np.diff(grid[..., :2], axis=axis), axis=-1)
        lengths = lengths[np.isfinite(lengths)]
        if len(lengths):
            # the way along a tilted surface, from x and y and the median step in z: noise in z is no distance
            steep = np.diff(grid[..., 2], axis=axis)
            steps.append(float(np.hypot(np.median(lengths), np.median(steep[np.isfinite(steep)]))))
    return max(steps) if steps else float("nan")


def _grid_noise(cloud: Cloud, inside: np.ndarray) -> float:
    z = np.where(inside, cloud.points_m[..., 2], np.nan)
    bends = []
    for grid in (z, z.T):
        if grid.shape[1] > 2 * NOISE_LAG:
            bend = grid[:, 2 * NOISE_LAG :] - 2 * grid[:, NOISE_LAG:-NOISE_LAG] + grid[:, : -2 * NOISE_LAG]
            bends.append(bend[np.isfinite(bend)])
    values = np.concatenate(bends) if bends else np.empty(0)
    # fewer values say nothing; a second difference of white noise has sqrt(6) of its sigma
    return float(np.median(np.abs(values))) * MEDIAN_TO_SIGMA / np.sqrt(6.0) if len(values) >= 100 else float("nan")


def _in_plane(points_m: np.ndarray) -> np.ndarray:
    """(n, 2) places of points (n, 3) along the plane through them all."""
    arm = points_m - points_m.mean(axis=0)
    places: np.ndarray = arm @ np.linalg.eigh(arm.T @ arm)[1][:, 1:]
    return places


def _nearest_pitch(points_m: np.ndarray) -> float:
    from scipy.spatial import cKDTree

    if len(points_m) < 2:
        return 0.0
    places = _in_plane(points_m)
    return float(np.median(cKDTree(places).query(thinned(places), k=2)[0][:, 1]))


def _local_noise(points_m: np.ndarray) -> float:
    """Return the noise from the distances of points to the plane through their 25 nearest points, which removes 3 of
    25 parts of the variance."""
    from scipy.spatial import cKDTree

    count = min(CORRELATED_PIXELS, len(points_m))
    if count < 4:
        return 0.0
    # neighbours along the surface: those in space would be chosen by their noise
    places = _in_plane(points_m)
    near = points_m[cKDTree(places).query(thinned(places), k=count)[1]]
    normals = local_normals(near)
    across = np.einsum("ij,ij->i", thinned(points_m) - near.mean(axis=1), normals)
    return float(np.median(np.abs(across))) * MEDIAN_TO_SIGMA / np.sqrt(1 - 3 / count)


def local_normals(near_m: np.ndarray) -> np.ndarray:
    """(n, 3) unit normals of the planes through sets of points (n, k, 3); their sign is not fixed."""
    arm = near_m - near_m.mean(axis=1, keepdims=True)
    normals: np.ndarray = np.linalg.eigh(np.einsum("nki,nkj->nij", arm, arm))[1][:, :, 0]
    return normals
