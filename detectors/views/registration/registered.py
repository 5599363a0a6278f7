"""The result of a registration, and the sampling of a view: the scale of residuals, overlaps and
tolerances."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from detectors.averages.average import CORRELATED_PIXELS
from detectors.pixels.noise import sigma_of
from detectors.rigid_motion import displacement_jacobian
from detectors.views.view import PreparedView
from harness.vocabulary.geometry import MM, Cloud, invert, transform_points

# side of the cubes within which errors count as common: the window of the widest depth filter
CLUSTER_PITCHES = 5.0
UNKNOWN_COVARIANCE = np.full((6, 6), np.nan)
SLIDES = (
    "not determined: the points can slide or rotate without matching worse, as on a flat or "
    "smooth surface"
)


@dataclass(frozen=True)
class Registration:
    """The pose of a view relative to the reference view."""

    view: str
    """Name of the view."""
    method: str
    """Method of the settings."""
    T_reference_view: np.ndarray
    """(4, 4): rigid, no scale."""
    covariance: np.ndarray = field(default_factory=UNKNOWN_COVARIANCE.copy)
    """(6, 6): of a small error (w, t), by which a point p of the reference frame is off by
    w x (p - ``centre_m``) + t, radians and metres; NaN if the method has no estimate. It holds the
    noise of the method's points, not an error that a whole view shares."""
    centre_m: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,): centre of the small rotation, reference frame."""
    residual_m: float = float("nan")
    """Root mean square of the minimised distances."""
    overlap: float = float("nan")
    """Share of the view's target points within a pixel's pitch of the reference's target."""
    pairs: int = 0
    """Number of marks or points that were matched."""
    iterations: int = 0
    """Number of steps of the method."""
    converged: bool = True
    """Whether these steps came to an end."""
    seconds: float = 0.0
    """Time taken (an equal share if joint)."""
    failure: str = ""
    """Why the view must not be merged, else empty."""
    notes: tuple[str, ...] = ()
    """Further remarks."""


def reference_registration(view: str, method: str) -> Registration:
    """Return the registration of the first view to itself: the identity."""
    return Registration(
        view=view,
        method=method,
        T_reference_view=np.eye(4),
        covariance=np.zeros((6, 6)),
        residual_m=0.0,
        overlap=1.0,
    )


def failed(
    view: PreparedView, method: str, T_guess: np.ndarray | None, failure: str, *notes: str
) -> Registration:
    """Return a failed registration: its pose is the guess, or else the reference's own pose."""
    T = np.eye(4) if T_guess is None else T_guess
    return Registration(view.view.name, method, T, converged=False, failure=failure, notes=notes)


def guess_of(reference: PreparedView, view: PreparedView) -> np.ndarray | None:
    """Return ``T_reference_view`` (4, 4) from both guesses; the reference need not be the first
    view."""
    reference_guess = reference.view.T_reference_view_guess
    view_guess = view.view.T_reference_view_guess
    if reference_guess is None or view_guess is None:
        return None
    return invert(reference_guess) @ view_guess


def predicted_error_m(
    registration: Registration,
    points_m: np.ndarray,
    normal: np.ndarray,
) -> tuple[float, float]:
    """Return the root mean square target registration error over points (n, 3) of the reference
    frame that the covariance predicts, in the plane normal to the unit vector ``normal`` (3,) and
    across it; or NaN."""
    jacobian = displacement_jacobian(points_m, registration.centre_m)
    spread = (jacobian @ registration.covariance @ np.swapaxes(jacobian, 1, 2)).mean(axis=0)
    across = float(normal @ spread @ normal)
    within = max(np.trace(spread) - across, 0.0)
    return float(np.sqrt(within)), float(np.sqrt(max(across, 0.0)))


def clustered_sandwich(
    curvature: np.ndarray,
    scores: np.ndarray,
    points_m: np.ndarray,
    pitch_m: float,
) -> np.ndarray:
    """Return the covariance (6, 6) H^-1 S H^-1; S is the sum over cubes of points (n, 3) of the
    outer square of their summed scores (n, 6). ``curvature`` H (6, 6) and ``scores`` belong to the
    same objective, in any unit. NaN if H is not positive definite, or with too few cubes."""
    # compare rotations and shifts at the points' own arm, so that definiteness does not depend on
    # units
    arm = max(float(np.sqrt(np.sum(np.var(points_m, axis=0)))), 1e-12)
    unit = np.array([1 / arm] * 3 + [1.0] * 3)
    scaled = curvature * np.outer(unit, unit)
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    side_m = max(CLUSTER_PITCHES * pitch_m, 1e-9)
    cubes = np.floor((points_m - points_m.min(axis=0)) / side_m).astype(np.int64)
    _, cluster = np.unique(cubes, axis=0, return_inverse=True)
    summed = np.zeros((int(cluster.max()) + 1, 6))
    np.add.at(summed, cluster.ravel(), scores * unit)
    definite = np.isfinite(values).all() and values[0] > 1e-9 * max(values[-1], 0.0)
    if len(summed) < 7 or not definite:
        return UNKNOWN_COVARIANCE.copy()
    # the scores sum to zero at the optimum, which removes the scatter of one cube
    scatter = summed.T @ summed * len(summed) / (len(summed) - 1)
    inverse = (vectors / values) @ vectors.T
    covariance = inverse @ scatter @ inverse * np.outer(unit, unit)
    return np.asarray((covariance + covariance.T) / 2)


NOISE_LAG = 6
"""Pixels between the points of a second difference: beyond the widest depth filter, errors are
independent."""
# least share of the view beside the reference's target: with less, nothing can be judged
MIN_OVERLAP = 0.1
MOVING_PITCHES = 0.5  # an iteration whose last step moves the target by more has not converged
MAX_POINTS = 10_000
"""Most points of a cloud to register: the time of coherent point drift grows with the product of
both numbers."""
# points on which overlap and agreement are judged: a share is then known to 1 %
THINNED_POINTS = 2000


@dataclass(frozen=True)
class Sampling:
    """One view's target, camera frame."""

    pitch_m: float
    """Median distance between neighbouring points along the coarser axis of the grid."""
    noise_m: float
    """Standard deviation of a point across the surface, with the fixed pattern."""
    centre_m: np.ndarray
    """(3,): centroid of the points."""
    normal: np.ndarray
    """(3,): unit normal of their plane, towards the camera."""
    extent_m: float
    """Half the diagonal of their box."""


def sampling_of(view: PreparedView) -> Sampling:
    """Measure a view's target. A target of fewer than three points has no plane: its normal is the
    optical axis'."""
    points = view.points_m
    cloud = view.view.cloud
    pitch = float("nan")
    noise = float("nan")
    if cloud.organised and cloud.points_m.shape[0] > 1:
        pitch, noise = _on_grid(cloud, view.inside)
    if not np.isfinite(pitch + noise):
        loose_pitch, loose_noise = _without_grid(points)
        if not np.isfinite(pitch):
            pitch = loose_pitch
        if not np.isfinite(noise):
            noise = loose_noise
    extent = 0.0
    if len(points):
        extent = float(np.linalg.norm(np.ptp(points, axis=0))) / 2
    least = cloud.z_step_m / np.sqrt(12.0 * max(cloud.n_frames, 1))
    centre, normal = plane_through(points)
    return Sampling(
        pitch_m=pitch,
        noise_m=max(noise, least),
        centre_m=centre,
        normal=normal,
        extent_m=extent,
    )


def plane_through(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the centroid (3,) of points (n, 3) and the unit normal (3,) of their plane, towards
    the origin."""
    centre = points_m.mean(axis=0) if len(points_m) else np.zeros(3)
    if len(points_m) < 3:
        return centre, np.array([0.0, 0.0, -1.0])
    normal = local_normals(points_m[None])[0]
    return centre, normal if normal @ centre <= 0 else -normal


def thinned(points_m: np.ndarray, limit: int = THINNED_POINTS) -> np.ndarray:
    """Return at most ``limit`` of points (n, 3), evenly strided in the order of the grid."""
    stride = max(1, -(-len(points_m) // limit))
    return points_m[::stride]


def clouds_of(
    reference: PreparedView,
    view: PreparedView,
    points: Literal["marks", "target"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, tuple[str, ...], str]:
    """Return the points to register, of the fiducials or of the whole target: the reference's and
    the view's, each (n, 3) with at most `MAX_POINTS`; the guess (4, 4); a note without one; and
    why they cannot be registered, else ""."""
    if points == "marks":
        described = "fiducial colour"
        fixed = thinned(reference.mark_points_m, MAX_POINTS)
        moving = thinned(view.mark_points_m, MAX_POINTS)
    else:
        described = "target"
        fixed = thinned(reference.points_m, MAX_POINTS)
        moving = thinned(view.points_m, MAX_POINTS)
    guess = guess_of(reference, view)
    notes = tuple[str, ...]()
    if guess is None:
        notes = ("no guess: registration started from the reference's pose",)
    shortage = ""
    if min(len(fixed), len(moving)) < 3:
        shortage = (
            f"too few points of the {described}: {len(fixed)} in the reference and {len(moving)} "
            "in the view, 3 needed in each"
        )
    return fixed, moving, guess, notes, shortage


def independent(points: int) -> float:
    """Return the number of independent values among correlated pixels, for the widest depth
    filter; at least 1."""
    return max(points / CORRELATED_PIXELS, 1.0)


def local_normals(near_m: np.ndarray) -> np.ndarray:
    """Return unit normals (n, 3) of the planes through sets of points (n, k, 3); their sign is not
    fixed."""
    arm = near_m - near_m.mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.swapaxes(arm, 1, 2) @ arm)
    return np.asarray(axes[:, :, 0])


def _on_grid(cloud: Cloud, inside: np.ndarray) -> tuple[float, float]:
    """Return pitch and noise; NaN if too few neighbours are known."""
    grid = np.where(inside[..., None], cloud.points_m, np.nan)
    steps = [0.0]
    bends = []
    for axis in (0, 1):
        step = np.diff(grid, axis=axis)
        step = step[np.isfinite(step[..., 2])]
        if len(step):
            # the distance along a tilted surface, from x and y and the median step in z, without
            # noise in z
            lengths = np.linalg.norm(step[:, :2], axis=-1)
            steps.append(float(np.hypot(np.median(lengths), np.median(step[:, 2]))))
        z = np.moveaxis(grid[..., 2], axis, 0)
        bend = z[2 * NOISE_LAG :] - 2 * z[NOISE_LAG:-NOISE_LAG] + z[: -2 * NOISE_LAG]
        bends.append(bend.ravel())
    values = np.concatenate(bends)
    values = values[np.isfinite(values)]
    # fewer values do not suffice; a second difference of white noise has sqrt(6) of its sigma
    noise = sigma_of(values) / np.sqrt(6.0) if len(values) >= 100 else float("nan")
    return max(steps) or float("nan"), noise


def _without_grid(points_m: np.ndarray) -> tuple[float, float]:
    """Return pitch, and noise by the distances of points to the plane through their 25 nearest; 0
    if too few."""
    if len(points_m) < 2:
        return 0.0, 0.0
    # neighbours along the surface: in space, noise would select them
    arm = points_m - points_m.mean(axis=0)
    _, axes = np.linalg.eigh(arm.T @ arm)
    plan = arm @ axes[:, 1:]
    count = min(CORRELATED_PIXELS, len(points_m))
    distances, nearest = cKDTree(plan).query(thinned(plan), k=count)
    pitch = float(np.median(distances[:, 1]))
    if count < 4:
        return pitch, 0.0
    neighbours = points_m[nearest]
    off = thinned(points_m) - neighbours.mean(axis=1)
    across = np.einsum("ij,ij->i", off, local_normals(neighbours))
    return pitch, sigma_of(across) / np.sqrt(1 - 3 / count)


def still_moving(step_m: float, pitch_m: float) -> str:
    """Return the reason why an iteration whose last step moved the target by ``step_m`` failed,
    else ""."""
    if step_m <= MOVING_PITCHES * pitch_m:
        return ""
    return f"did not converge: the last step still moved the target by {step_m / MM:.2f} mm"


def moved_m(change: np.ndarray, points_m: np.ndarray) -> float:
    """Return the root mean square distance by which the 4x4 transform ``change`` moves points (n,
    3)."""
    steps = transform_points(change, points_m) - points_m
    return float(np.sqrt(np.mean(np.sum(steps**2, axis=1))))
