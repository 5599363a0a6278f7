"""Iterative closest point by Open3D, coarse to fine from the guess, with a covariance of our own.

Point to point is what MATLAB's `pcregistericp` does by default; Open3D's pairs are limited in distance, MATLAB's not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from detectors.average import CORRELATED_PIXELS
from detectors.marks.placing import kabsch
from detectors.open3d_library import open3d_on_one_thread
from detectors.registration.judged import moved_m, still_moving, too_few_points
from detectors.registration.registered import (
    NO_GUESS,
    Registration,
    cloud_of,
    clustered_sandwich,
    displacement_jacobian,
    failed,
    guess_of,
)
from detectors.registration.sampling import local_normals, sampling_of, thinned
from detectors.registration.settings import IcpRegistration
from detectors.surface import SurfaceConfig, fit_surface
from detectors.views import PreparedView
from harness.vocabulary.geometry import transform_points
from harness.vocabulary.units import MM

GUESS_ERROR_M, GUESS_ERROR_RAD = 10 * MM, np.deg2rad(3.0)
"""Usual error of a nominal pose; first pairs may lie twice as far apart as it moves the outermost point."""
FINEST_PITCHES = 3.0
"""Limit of the last stage: a mark's rim is known to a pixel in either view, and noise and shared errors add one."""
STAGE_ITERATIONS, CALL_ITERATIONS = 100, 10
"""Most of a stage, and of one call: Open3D does not tell how many it took."""
LEAST_CHANGE = 1e-8
"""Relative change of fitness and residual below which Open3D stops a stage."""
CONVERGED_PITCHES = 0.05
MAX_POINTS = 10_000
SLOPE_STEP_M = 1 * MM
SLIDES = (
    "not determined: the points can slide or turn without lying farther apart (flat marks hold nothing along their"
    " plane when distances are taken across it)"
)


@dataclass(frozen=True)
class _Cost:
    """The sum of squared distances of moved points (n, 3) to their nearest of ``fixed_m``, at most ``limit_m`` each.

    ``normals`` (k, 3) of the fixed points where distances are taken along them (point to plane), else None.
    """

    fixed_m: np.ndarray
    normals: np.ndarray | None
    tree: Any
    limit_m: float

    def residuals(self, moved_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the vectors (n, 3) to the partners that the method minimises (zero without a partner), the mask (n,)
        of points that have a partner, and the partners' indices (n,)."""
        distances, nearest = self.tree.query(moved_m, distance_upper_bound=self.limit_m)
        paired = np.isfinite(distances)
        nearest = np.where(paired, nearest, 0)
        apart = np.where(paired[:, None], moved_m - self.fixed_m[nearest], 0.0)
        if self.normals is not None:
            normals = self.normals[nearest]
            apart = np.einsum("ni,ni->n", apart, normals)[:, None] * normals
        return apart, paired, nearest

    def value(self, moved_m: np.ndarray) -> float:
        """Return the sum; a point without a partner counts as if it were at the limit."""
        apart, paired, _ = self.residuals(moved_m)
        return float(np.sum(apart**2) + self.limit_m**2 * np.sum(~paired))


def register_by_icp(reference: PreparedView, view: PreparedView, config: IcpRegistration) -> Registration:
    """Return the registration of a view to the reference by ICP of their fiducial clouds or targets.

    ``covariance``: see `icp_covariance`.
    """
    from scipy.spatial import cKDTree

    fixed, moving = (thinned(cloud_of(each, config.points), MAX_POINTS) for each in (reference, view))
    start = guess_of(reference, view)
    notes: tuple[str, ...] = () if start is not None else (NO_GUESS,)
    few = too_few_points(len(moving), len(fixed), config.points)
    if few:
        return failed(view, "icp", start, few, *notes)
    sampling = sampling_of(view)
    limits = stages_m(sampling.pitch_m, sampling.extent_m)
    normals = _normals(reference, fixed) if config.estimation == "point_to_plane" else None
    cost = _Cost(fixed, None if normals is None else normals.local, cKDTree(fixed), limits[-1])
    T_start = np.eye(4) if start is None else start
    T_coarse, iterations = _open3d_icp(fixed, cost.normals, moving, T_start, limits)
    T_reference_view, step_m = _last_step(cost, moving, T_coarse)
    moved = transform_points(T_reference_view, moving)
    apart, paired, _ = cost.residuals(moved)
    if paired.sum() < 3:
        failure = f"no pairs: {paired.sum()} points lie within {limits[-1] / MM:.1f} mm of the reference's"
        return failed(view, "icp", start, failure, *notes)
    real = replace(cost, normals=None if normals is None else normals.real)
    covariance = icp_covariance(real, moved, sampling.pitch_m)
    return Registration(
        view=view.view.name,
        method="icp",
        T_reference_view=T_reference_view,
        covariance=covariance,
        centre_m=moved.mean(axis=0),
        residual_m=float(np.sqrt(np.sum(apart**2) / paired.sum())),
        pairs=int(paired.sum()),
        iterations=iterations + 1,
        converged=bool(step_m <= CONVERGED_PITCHES * sampling.pitch_m),
        failure=still_moving(step_m, sampling.pitch_m) or ("" if np.isfinite(covariance).all() else SLIDES),
        notes=notes,
    )


def stages_m(pitch_m: float, extent_m: float) -> tuple[float, ...]:
    """Return the greatest distance of a pair in each stage: from twice a usual guess error at the target's end, halved
    down to three pitches."""
    finest = FINEST_PITCHES * pitch_m
    limits = [max(2 * (GUESS_ERROR_M + GUESS_ERROR_RAD * extent_m), finest)]
    while limits[-1] > finest:
        limits.append(max(limits[-1] / 2, finest))
    return tuple(limits)


def icp_covariance(cost: _Cost, moved_m: np.ndarray, pitch_m: float) -> np.ndarray:
    """Return the (6, 6) covariance of the pose, as `Registration` means it, about the moved points' centroid.

    H^-1 S H^-1. Point to point: H is the cost's curvature with pairs found anew, by differences over one pitch
    (Bengtsson & Baerveldt, Robotics and Autonomous Systems 44:29, 2003), because with pairs held fixed the inside of a
    flat mark would seem to resist sliding. Point to plane: sliding changes no pair that counts, so H is the closed form
    with pairs held fixed (Censi, ICRA 2007). S is the scatter of the gradients, summed within cubes of 5 pixels whose
    errors are common. Not in it: that the iteration may stop at one of many near minima. NaN where H is not positive
    definite: a motion costs nothing.
    """
    centre = moved_m.mean(axis=0)
    jacobian = displacement_jacobian(moved_m, centre)
    apart, paired, nearest = cost.residuals(moved_m)
    scores = np.einsum("nij,ni->nj", jacobian, apart)
    if cost.normals is None:
        curvature = _curvature(lambda motion: cost.value(moved_m + jacobian @ motion), moved_m - centre, pitch_m) / 2
    else:
        rows = np.einsum("ni,nij->nj", cost.normals[nearest[paired]], jacobian[paired])
        curvature = rows.T @ rows
    return clustered_sandwich(curvature, scores - scores.mean(axis=0), moved_m, pitch_m)


def _curvature(value: Any, arm_m: np.ndarray, pitch_m: float) -> np.ndarray:
    """(6, 6) second derivatives by central differences; a step moves the points by a pitch, root mean square."""
    # a turn about an axis moves points by their distance from it
    squares = np.mean(arm_m**2, axis=0)
    steps = pitch_m / np.sqrt(np.maximum([*(squares.sum() - squares), 1.0, 1.0, 1.0], 1e-12))
    steps = np.diag(np.minimum(steps, [0.1] * 3 + [pitch_m] * 3))
    sizes = np.diag(steps)
    middle = value(np.zeros(6))
    curvature = np.empty((6, 6))
    for i in range(6):
        curvature[i, i] = (value(steps[i]) + value(-steps[i]) - 2 * middle) / sizes[i] ** 2
        for j in range(i):
            both, across = steps[i] + steps[j], steps[i] - steps[j]
            mixed = value(both) + value(-both) - value(across) - value(-across)
            curvature[i, j] = curvature[j, i] = mixed / (4 * sizes[i] * sizes[j])
    return curvature


@dataclass(frozen=True)
class _Normals:
    """Normals (n, 3) of the reference's target at its points. ``local``: of the 25 nearest points, with their noise, as
    ICP uses them. ``real``: what holds the pose, of the robust cubic through the target; the local one only where it
    departs from that by more than noise makes any of them depart (one cloud in a thousand). A noisy normal seems to
    hold a flat mark in its plane, where nothing does."""

    local: np.ndarray
    real: np.ndarray


def _normals(reference: PreparedView, fixed_m: np.ndarray) -> _Normals:
    from scipy.spatial import cKDTree

    target = reference.points_m
    smooth = _cubic_normals(target, fixed_m)
    count = min(CORRELATED_PIXELS, len(target))
    local = local_normals(target[cKDTree(target).query(fixed_m, k=count)[1]].reshape(len(fixed_m), count, 3))
    local *= np.where(np.einsum("ni,ni->n", local, smooth) < 0, -1.0, 1.0)[:, None]
    squared = np.sum((local - smooth) ** 2, axis=1)
    # two axes: a squared length has a median of 2 ln 2 variances and exceeds 2 ln(1 / p) with chance p
    variance = float(np.median(squared)) / (2 * np.log(2))
    real = squared > 2 * np.log(len(fixed_m) / 1e-3) * variance
    return _Normals(local, np.where(real[:, None], local, smooth))


def _cubic_normals(target_m: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """(n, 3) unit normals, towards the camera, of the robust cubic z(x, y) through the target."""
    x, y, z = target_m.T
    surface = fit_surface(x, y, z, SurfaceConfig(method="bisquare", degree=3 if len(target_m) >= 100 else 1))
    px, py, _ = points_m.T
    slopes = [
        (surface.evaluate(px + dx, py + dy) - surface.evaluate(px - dx, py - dy)) / (2 * SLOPE_STEP_M)
        for dx, dy in ((SLOPE_STEP_M, 0.0), (0.0, SLOPE_STEP_M))
    ]
    normals = np.stack([*slopes, -np.ones(len(px))], axis=1)
    unit: np.ndarray = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return unit


def _open3d_icp(
    fixed_m: np.ndarray,
    normals: np.ndarray | None,
    moving_m: np.ndarray,
    start: np.ndarray,
    limits_m: tuple[float, ...],
) -> tuple[np.ndarray, int]:
    """Stages of Open3D's ICP: ``T_fixed_moving`` (4, 4) and the number of iterations, to the next `CALL_ITERATIONS`."""
    T_fixed_moving, iterations = start, 0
    with open3d_on_one_thread() as o3d:
        methods = o3d.pipelines.registration
        fixed, moving = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (fixed_m, moving_m))
        estimation = methods.TransformationEstimationPointToPoint(with_scaling=False)
        if normals is not None:
            fixed.normals = o3d.utility.Vector3dVector(normals)
            estimation = methods.TransformationEstimationPointToPlane()
        criteria = methods.ICPConvergenceCriteria(LEAST_CHANGE, LEAST_CHANGE, CALL_ITERATIONS)
        for limit in limits_m:
            last = (np.nan, np.nan)
            for _ in range(STAGE_ITERATIONS // CALL_ITERATIONS):
                found = methods.registration_icp(moving, fixed, limit, T_fixed_moving, estimation, criteria)
                T_fixed_moving = np.array(found.transformation)
                iterations += CALL_ITERATIONS
                now = (found.fitness, found.inlier_rmse)
                if np.allclose(now, last, rtol=LEAST_CHANGE, atol=0.0):
                    break
                last = now
    return T_fixed_moving, iterations


def _last_step(cost: _Cost, moving_m: np.ndarray, T_fixed_moving: np.ndarray) -> tuple[np.ndarray, float]:
    """One more step, by which it is judged whether the iteration has ended, and how far it moved the points."""
    moved = transform_points(T_fixed_moving, moving_m)
    apart, paired, _ = cost.residuals(moved)
    if paired.sum() < 3:
        return T_fixed_moving, 0.0
    change = np.eye(4)
    if cost.normals is None:
        change = kabsch(moved[paired], moved[paired] - apart[paired], np.ones(paired.sum()))
    else:
        change = _plane_step(apart[paired], moved[paired])
    T = change @ T_fixed_moving
    left, _, right = np.linalg.svd(T[:3, :3])
    T[:3, :3] = left @ right
    return T, moved_m(change, moved)


def _plane_step(apart_m: np.ndarray, moved_m: np.ndarray) -> np.ndarray:
    """One Gauss-Newton step along the normals, which are those of the vectors ``apart_m`` (n, 3) themselves."""
    from scipy.spatial.transform import Rotation

    size = np.linalg.norm(apart_m, axis=1)
    some = size > 0
    normals = apart_m[some] / size[some, None]
    centre = moved_m.mean(axis=0)
    rows = np.einsum("ni,nij->nj", normals, displacement_jacobian(moved_m[some], centre))
    motion = np.linalg.lstsq(rows, -size[some], rcond=1e-6)[0]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(motion[:3]).as_matrix()
    T[:3, 3] = centre + motion[3:] - T[:3, :3] @ centre
    return T
