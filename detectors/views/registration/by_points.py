"""Registration of clouds: iterative closest point, rigid coherent point drift, RGB-D odometry.

ICP goes from coarse to fine, starting at the guess, point to point, as MATLAB's `pcregistericp`
does by default. Unlike MATLAB's, its pairs are limited in distance.

Coherent point drift (Myronenko & Song, TPAMI 32:2262, 2010, figure 2), without scale: the fixed
cloud is drawn from Gaussians of one width about the moving cloud's points, and a uniform component
for outliers. As in MATLAB's `pcregistercpd`, both clouds are set to zero mean and the initial
width is that of all pairs; the clouds share one unit of length, and only the rotation of the guess
matters.

Odometry (Open3D's hybrid term; Park, Zhou & Koltun, ICCV 2017) aligns each view with the one
before it by colour and depth together, starting from no motion, so that errors add up. It uses
only the target: on a turntable the room does not move with the target. No loop is closed, no map
is kept."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from detectors.open3d_library import open3d_on_one_thread
from detectors.rigid_motion import displacement_jacobian, kabsch
from detectors.views.registration import registered
from detectors.views.registration.settings import CpdRegistration, IcpRegistration
from detectors.views.view import PreparedView
from harness.vocabulary.geometry import MM, Lens, rays_of, transform_points

GUESS_ERROR_M = 10 * MM
GUESS_ERROR_RAD = np.deg2rad(3.0)
"""Usual error of a nominal pose; the first pairs may be twice as far apart as it moves the
outermost point."""
FINEST_PITCHES = 3.0
"""Limit of the last stage: a mark's rim is known to a pixel in either view; noise and shared
errors add a third."""
STAGE_ITERATIONS = 100
LEAST_CHANGE = 1e-8
"""A stage ends after this many steps, or once the paired points' share and their distance (m)
change by less."""
CONVERGED_PITCHES = 0.05


def register_by_icp(
    reference: PreparedView,
    view: PreparedView,
    config: IcpRegistration,
) -> registered.Registration:
    """Return the registration of a view to the reference by ICP of their fiducial clouds or
    targets."""
    fixed, moving, start, notes, shortage = registered.clouds_of(reference, view, config.points)
    if shortage:
        return registered.failed(view, "icp", start, shortage, *notes)
    sampling = registered.sampling_of(view)
    tree = cKDTree(fixed)
    T = np.eye(4) if start is None else start
    moved = moving
    iterations = 0
    step_m = np.inf
    for limit_m in stages_m(sampling.pitch_m, sampling.extent_m):
        last = np.full(2, np.inf)
        for _ in range(STAGE_ITERATIONS):
            moved = transform_points(T, moving)
            distances, paired = _pairs(tree, moved, limit_m)
            if paired.sum() < 3:
                failure = (
                    f"no pairs: {paired.sum()} points lie within {limit_m / MM:.1f} mm of the "
                    "reference's"
                )
                return registered.failed(view, "icp", start, failure, *notes)
            change = kabsch(moved[paired], (moved - distances)[paired], np.ones(paired.sum()))
            T = change @ T
            step_m = registered.moved_m(change, moved)
            iterations += 1
            now = np.array([paired.mean(), np.sqrt(np.mean(distances[paired] ** 2))])
            if np.abs(now - last).max() < LEAST_CHANGE:
                break
            last = now
    u, _, right = np.linalg.svd(T[:3, :3])
    T[:3, :3] = u @ right
    moved = transform_points(T, moving)
    distances, paired = _pairs(tree, moved, limit_m)
    covariance = _covariance(tree, moved, limit_m, sampling.pitch_m)
    residual_m = float(np.sqrt(np.sum(distances**2) / max(paired.sum(), 1)))
    failure = registered.still_moving(step_m, sampling.pitch_m)
    if not failure and not np.isfinite(covariance).all():
        failure = registered.SLIDES
    return registered.Registration(
        view=view.view.name,
        method="icp",
        T_reference_view=T,
        covariance=covariance,
        centre_m=moved.mean(axis=0),
        residual_m=residual_m,
        pairs=int(paired.sum()),
        iterations=iterations,
        converged=bool(step_m <= CONVERGED_PITCHES * sampling.pitch_m),
        failure=failure,
        notes=notes,
    )


def stages_m(pitch_m: float, extent_m: float) -> tuple[float, ...]:
    """Return each stage's largest distance of a pair: twice a guess's usual error, halved down to
    three pitches."""
    finest = FINEST_PITCHES * pitch_m
    limits = [max(2 * (GUESS_ERROR_M + GUESS_ERROR_RAD * extent_m), finest)]
    while limits[-1] > finest:
        limits.append(max(limits[-1] / 2, finest))
    return tuple(limits)


def _pairs(
    tree: Any,
    moved_m: np.ndarray,
    limit_m: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return vectors (n, 3) to the partners, zero without one, and the mask (n,) of points that
    have a partner."""
    distances, nearest = tree.query(moved_m, distance_upper_bound=limit_m)
    paired = np.isfinite(distances)
    partners = tree.data[np.where(paired, nearest, 0)]
    return np.where(paired[:, None], moved_m - partners, 0.0), paired


def _covariance(
    tree: Any,
    moved_m: np.ndarray,
    limit_m: float,
    pitch_m: float,
) -> np.ndarray:
    """Return the covariance (6, 6) of the pose, as in `Registration`, about the moved points'
    centroid: H^-1 S H^-1. H is the cost's curvature with new pairs, by differences over one pitch
    (Bengtsson & Baerveldt, Robotics and Autonomous Systems 44:29, 2003); with fixed pairs, the
    inside of a flat mark would seem to resist sliding. S is the scatter of the gradients, summed
    within cubes of 5 pixels whose errors are common. It ignores that the iteration may stop at one
    of many near minima. NaN if a motion costs nothing."""
    arm = moved_m - moved_m.mean(axis=0)
    jacobian = displacement_jacobian(arm, np.zeros(3))
    off, _ = _pairs(tree, moved_m, limit_m)
    scores = np.einsum("nij,ni->nj", jacobian, off)

    def half_cost(motion: np.ndarray) -> float:
        # a point without a partner counts as one at the limit
        off, has = _pairs(tree, moved_m + jacobian @ motion, limit_m)
        return float(np.sum(off**2) + limit_m**2 * np.sum(~has)) / 2

    # a step moves the points by a pitch, root mean square; a turn about an axis moves points by
    # their distance from it
    squares = np.mean(arm**2, axis=0)
    moved_per_unit = np.ones(6)
    moved_per_unit[:3] = squares.sum() - squares
    sizes = pitch_m / np.sqrt(np.maximum(moved_per_unit, 1e-12))
    sizes = np.minimum(sizes, [0.1] * 3 + [pitch_m] * 3)
    steps = np.diag(sizes)
    curvature = np.empty((6, 6))
    for i in range(6):
        for j in range(i + 1):
            part = 0.5 if i == j else 1.0
            product = part * (steps[i] + steps[j])
            across = part * (steps[i] - steps[j])
            mixed = (
                half_cost(product) + half_cost(-product) - half_cost(across) - half_cost(-across)
            )
            curvature[i, j] = mixed / (4 * part**2 * sizes[i] * sizes[j])
            curvature[j, i] = curvature[i, j]
    centred_scores = scores - scores.mean(axis=0)
    return registered.clustered_sandwich(curvature, centred_scores, moved_m, pitch_m)


LEAST_VARIANCE = 10 * float(np.finfo(np.float64).eps)
"""Variance in squared normalised units at which the clouds coincide (the authors' own criterion).
"""
PAIRS_AT_ONCE = 1 << 20  # pairs of points whose distances are held in memory


@dataclass(frozen=True)
class Drift:
    """The result of coherent point drift."""

    T_fixed_moving: np.ndarray
    """(4, 4): rigid."""
    sigma_m: float
    """Width of the Gaussians."""
    matched: float
    """Expected number of fixed points that are not outliers."""
    iterations: int
    """Number of iterations."""
    converged: bool
    """Whether they ended by the tolerance or because the clouds coincide."""
    step_m: float
    """How far the last iteration moved the points."""
    background: float
    """The uniform component, as in `posterior_moments`."""


def coherent_point_drift(
    fixed_m: np.ndarray,
    moving_m: np.ndarray,
    config: CpdRegistration,
    T_start: np.ndarray | None = None,
) -> Drift:
    """Register points ``moving_m`` (m, 3) to ``fixed_m`` (n, 3), each at least three, from
    ``T_start`` (4, 4)."""
    start = np.eye(4) if T_start is None else T_start
    centre = fixed_m.mean(axis=0)
    scale = max(float(np.sqrt(np.sum(np.var(fixed_m, axis=0)))), 1e-12)
    fixed = (fixed_m - centre) / scale
    turned = transform_points(start, moving_m)
    moving = (turned - turned.mean(axis=0)) / scale
    turn = np.eye(3)
    shift = np.zeros(3)
    # a third of the mean squared distance of all pairs; both clouds have zero mean
    fixed_square = np.sum(fixed**2) / len(fixed)
    moving_square = np.sum(moving**2) / len(moving)
    variance = float((fixed_square + moving_square) / 3)
    outliers = config.outlier_ratio / (1 - config.outlier_ratio) * len(moving) / len(fixed)
    last = 0.0
    change = np.inf
    step = np.inf
    matched = 0.0
    iterations = 0
    while (
        iterations < config.max_iterations
        and change > config.tolerance
        and variance > LEAST_VARIANCE
    ):
        iterations += 1
        background = outliers * (2 * np.pi * variance) ** 1.5
        moments, objective = posterior_moments(fixed, moving, variance, background)
        objective += 1.5 * len(fixed) * np.log(variance)
        change = abs((objective - last) / objective)
        last = objective
        # the maximisation, with the scale held at 1
        weight = moments[:, 3, 3]
        total = moments.sum(axis=0)
        matched = float(total[3, 3])
        mean_x = weight @ fixed / matched
        mean_y = total[:3, 3] / matched
        cross = fixed.T @ moments[:, :3, 3] - matched * np.outer(mean_x, mean_y)
        u, _, right = np.linalg.svd(cross)
        d_turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ right)]) @ right
        d_shift = mean_x - d_turn @ mean_y
        spread_x = float(weight @ np.sum(fixed**2, axis=1)) - matched * float(mean_x @ mean_x)
        spread_y = float(np.trace(total[:3, :3])) - matched * float(mean_y @ mean_y)
        variance = (spread_x + spread_y - 2 * float(np.sum(cross * d_turn))) / (3 * matched)
        variance = max(variance, LEAST_VARIANCE / 2)
        moved = moving @ d_turn.T + d_shift
        squares = np.sum((moved - moving) ** 2, axis=1)
        step = float(np.sqrt(np.mean(squares))) * scale
        moving = moved
        turn = d_turn @ turn
        shift = d_turn @ shift + d_shift
    T = np.eye(4)
    T[:3, :3] = turn
    T[:3, 3] = centre + scale * shift - turn @ turned.mean(axis=0)
    background = outliers * (2 * np.pi * variance) ** 1.5
    converged = bool(change <= config.tolerance or variance <= LEAST_VARIANCE)
    return Drift(
        T_fixed_moving=T @ start,
        sigma_m=float(np.sqrt(variance)) * scale,
        matched=matched,
        iterations=iterations,
        converged=converged,
        step_m=step,
        background=background,
    )


def register_by_cpd(
    reference: PreparedView,
    view: PreparedView,
    config: CpdRegistration,
) -> registered.Registration:
    """Return the registration of a view to the reference by coherent point drift of their fiducial
    clouds or targets. At the limit of iterations it fails only if its last step still moved the
    points."""
    fixed, moving, start, notes, shortage = registered.clouds_of(reference, view, config.points)
    if shortage:
        return registered.failed(view, "cpd", start, shortage, *notes)
    drift = coherent_point_drift(fixed, moving, config, start)
    pitch = registered.sampling_of(view).pitch_m
    moved = transform_points(drift.T_fixed_moving, moving)
    covariance = drift_covariance(fixed, moved, drift, pitch)
    failure = ""
    if not drift.converged:
        failure = registered.still_moving(drift.step_m, pitch)
        notes += (f"stopped after {drift.iterations} iterations, the limit in the settings",)
    if not failure and not np.isfinite(covariance).all():
        failure = registered.SLIDES
    return registered.Registration(
        view=view.view.name,
        method="cpd",
        T_reference_view=drift.T_fixed_moving,
        covariance=covariance,
        centre_m=fixed.mean(axis=0),
        residual_m=drift.sigma_m * np.sqrt(3.0),
        pairs=round(drift.matched),
        iterations=drift.iterations,
        converged=drift.converged,
        failure=failure,
        notes=notes,
    )


def drift_covariance(
    fixed_m: np.ndarray,
    moved_m: np.ndarray,
    drift: Drift,
    pitch_m: float,
) -> np.ndarray:
    """Return the covariance (6, 6) of the pose, as in `Registration`, about the fixed cloud's
    centroid: H^-1 S H^-1. H is the observed information (Louis, JRSS B 44:226, 1982); S is the
    scatter of the scores, summed within cubes of 5 pixels whose errors are common (Liang & Zeger,
    Biometrika 73:13, 1986). The moving cloud's noise is assumed equal. The Gaussian width is at
    least a pitch, below which the likelihood shows the moire of two grids. NaN if H is not
    positive definite."""
    centre = fixed_m.mean(axis=0)
    x = fixed_m - centre
    variance = max(drift.sigma_m, pitch_m) ** 2
    background = drift.background * (variance / drift.sigma_m**2) ** 1.5
    moments, _ = posterior_moments(x, moved_m - centre, variance, background)
    # the score of a pair is J'(x - y) / variance = (y x x, x - y) / variance, linear in (y, 1)
    linear = np.zeros((len(x), 6, 4))
    linear[:, :3, :3] = np.swapaxes(np.cross(np.eye(3)[None], x[:, None]), 1, 2)
    linear[:, 3:, :3] = -np.eye(3)
    linear[:, 3:, 3] = x
    scores = np.einsum("nij,nj->ni", linear, moments[:, :, 3]) / variance
    within = (linear @ moments @ np.swapaxes(linear, 1, 2)).sum(axis=0) / variance**2
    # the complete information is the weighted sum of J'J, with J linear in (y, 1) too
    parts = displacement_jacobian(np.vstack([np.eye(3), np.zeros(3)]), np.zeros(3))
    parts[:3] -= parts[3]
    complete = np.einsum("ab,aki,bkj->ij", moments.sum(axis=0), parts, parts) / variance
    information = complete - (within - scores.T @ scores)
    error_factor = 1 + len(fixed_m) / len(moved_m)
    centred = scores - scores.mean(axis=0)
    covariance = registered.clustered_sandwich(information, centred, fixed_m, pitch_m)
    return covariance * error_factor


def posterior_moments(
    fixed: np.ndarray,
    moving: np.ndarray,
    variance: float,
    background: float,
) -> tuple[np.ndarray, float]:
    """Return posterior sums (n, 4, 4) of (y, 1)(y, 1)' over the moving points y (m, 3) for each
    fixed point (n, 3); and the negative sum of the log likelihood over fixed points, up to the
    Gaussians' factor. ``background``: the uniform component as in equation 6 of Myronenko & Song:
    (2 pi variance)^(3/2) w / (1 - w) m / n. The nearest component's weight is divided out, so that
    nothing underflows at w = 0."""
    design = np.column_stack([moving, np.ones(len(moving))])
    products = np.einsum("mi,mj->mij", design, design).reshape(-1, 16)
    moments = []
    objective = 0.0
    for part in np.array_split(fixed, 1 + len(fixed) * len(moving) // PAIRS_AT_ONCE):
        exponents = cdist(part, moving, "sqeuclidean") / (-2.0 * variance)
        greatest = exponents.max(axis=1, keepdims=True)
        weights = np.exp(exponents - greatest)
        with np.errstate(divide="ignore", over="ignore"):
            log_sum = np.log(weights.sum(axis=1))
            full = np.logaddexp(log_sum, np.log(background) - greatest[:, 0])
            moments.append(weights @ products / np.exp(full)[:, None])
        objective -= float((full + greatest[:, 0]).sum())
    return np.concatenate(moments).reshape(-1, 4, 4), objective


DEPTH_DIFFERENCE_M = 0.03  # largest difference in depth of a pair of pixels (Open3D's own default)
DRIFTS = "no covariance: that of Open3D's odometry counts its pairs and ignores how far it slid"


def register_by_odometry(views: Sequence[PreparedView]) -> list[registered.Registration]:
    """Register all views but the first to the first, in the order given, which is that of the
    walk. A view that odometry loses (according to Open3D, or with pairs for less than a tenth of
    the target's pixels) fails, and so does every view after it. ``residual_m`` and ``covariance``
    are NaN. Every view needs colour, a pixel grid and a lens."""
    T = np.eye(4)
    lost = ""
    registrations = []
    # one pinhole camera for all: the first lens's focal lengths, and room for every target's
    # points
    first = views[0].view.cloud.lens
    assert first is not None
    slopes = np.concatenate([view.points_m[:, :2] / view.points_m[:, 2:] for view in views])
    plane_px = slopes * (first.fx, first.fy)
    low = np.floor(plane_px.min(axis=0)) - 1
    width, height = (np.ceil(plane_px.max(axis=0)) + 2 - low).astype(int).tolist()
    canvas = Lens(
        width=width,
        height=height,
        fx=first.fx,
        fy=first.fy,
        cx=-float(low[0]),
        cy=-float(low[1]),
    )
    with open3d_on_one_thread() as o3d:
        methods = o3d.pipelines.odometry
        camera = o3d.camera.PinholeCameraIntrinsic(
            width,
            height,
            canvas.fx,
            canvas.fy,
            canvas.cx,
            canvas.cy,
        )
        option = methods.OdometryOption(
            depth_diff_max=DEPTH_DIFFERENCE_M,
            depth_min=0.0,
            depth_max=1e3,
        )
        term = methods.RGBDOdometryJacobianFromHybridTerm()
        images = [_image(o3d, view, canvas) for view in views]
        for before, now, view in zip(images, images[1:], views[1:], strict=False):
            if not lost:
                success, step, information = methods.compute_rgbd_odometry(
                    now,
                    before,
                    camera,
                    np.eye(4),
                    term,
                    option,
                )
                # the information's last diagonal element is the sum of 1 over pairs
                pairs = 0
                if success and np.isfinite(step).all():
                    pairs = round(float(information[5, 5]))
                pixels = max(
                    int(np.count_nonzero(np.asarray(image.depth))) for image in (now, before)
                )
                if pairs < registered.MIN_OVERLAP * pixels:
                    lost = (
                        f"odometry failed at {view.view.name}: only {pairs} pixels match the "
                        "view before it"
                    )
            if lost:
                registrations.append(registered.failed(view, "odometry", None, lost))
                continue
            T = T @ step
            registrations.append(
                registered.Registration(view.view.name, "odometry", T, pairs=pairs, notes=(DRIFTS,))
            )
    return registrations


def _image(
    o3d: Any,
    view: PreparedView,
    canvas: Lens,
) -> Any:
    """Return the view's target as Open3D's intensity and depth on the canvas, both without
    distortion."""
    cloud = view.view.cloud
    lens = cloud.lens
    assert lens is not None and cloud.rgb is not None
    slopes = canvas.region_slopes(canvas.whole)
    corner_px = (cloud.region.col0, cloud.region.row0)
    pixels = (lens.project(rays_of(slopes)) - corner_px).astype(np.float32)
    u, v = pixels.transpose(2, 0, 1)
    z = np.where(view.inside, cloud.points_m[..., 2], 0.0).astype(np.float32)
    # depth is not interpolated: a mean of target and background is neither of them
    depth = cv2.remap(z, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    colour = cv2.remap(cloud.rgb, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    images = (o3d.geometry.Image(np.ascontiguousarray(image)) for image in (colour, depth))
    return o3d.geometry.RGBDImage.create_from_color_and_depth(
        *images,
        depth_scale=1.0,
        depth_trunc=float(depth.max()) + 1.0,
        convert_rgb_to_intensity=True,
    )
