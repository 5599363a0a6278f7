"""Marks and the common surface of all views, adjusted together: in the plane the marks decide, across it the surface.

A bundle adjustment (Triggs et al., "Bundle adjustment: a modern synthesis", 2000) with one smooth surface in place of
many points. Unknown are the poses of all views but the first, the surface z(x, y) (a cubic), the marks' places on it,
and each view's own smooth error across it:

    across:  z(T_v p) - S(x, y) - b_v(x, y) = noise    for some 2000 target points p of each view v
    within:  P (T_v c - M)                  = noise    for each mark c of each view that is one of the reference's

in the surface's frame. Noise across is that of the sampling, with one independent value in 25 pixels; Tukey's weights
keep holes out. b_v is what all pixels of a view share smoothly (wiggling, multipath, residual distortion): the ten
terms of a cubic, all with one prior deviation. A level or a tilt of it cannot be told from the pose's, but the seven
terms of higher order can: their scatter between views gives the deviation (by expectation maximisation), and the poses'
covariance holds the three terms that it cannot see. Where a camera's level wanders by more than its curvature, that is
too little.

Not modelled: errors of a view within the plane; a surface that no cubic follows, which enters b_v and widens
everything; gross errors of marks, which their own registration judges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from detectors.marks.mark import Mark
from detectors.marks.pairing import SHARED_M
from detectors.registration.by_marks import register_by_marks
from detectors.registration.registered import Registration, displacement_jacobian
from detectors.registration.sampling import MEDIAN_TO_SIGMA, independent, sampling_of, thinned
from detectors.surface import BISQUARE_TUNING
from detectors.views import PreparedView
from harness.vocabulary.geometry import invert, transform_points
from harness.vocabulary.units import MM

MAX_STEPS = 40
CONVERGED_M, CONVERGED_SHARED = 1e-6, 0.02
"""The adjustment ends with a step that moves no unknown by more than a micrometre, and changes the deviation of the
views' own errors by no more than a fiftieth."""
LEAST_SHARED_M = 1e-6

DEGREE = 3
TERMS = tuple((k - j, j) for k in range(DEGREE + 1) for j in range(k + 1))
"""Chebyshev orders in x and y by total degree: a level, two tilts, then seven that no pose can imitate."""
POSE_TERMS = 3
MARK_GATE = 16.3
"""Chi-square limit of a mark's position, three degrees of freedom: a true mark is missed once in a thousand."""
START_STEPS = 10


@dataclass(frozen=True)
class SurfaceFrame:
    """The frame in which the surface is z(x, y): z along the mean normal of the reference's target, towards the camera;
    x and y are scaled to -1..1 by ``half_m`` (2,)."""

    T_surface_reference: np.ndarray
    half_m: np.ndarray

    def basis(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """(n, 10) terms of the cubic."""
        in_x = np.polynomial.chebyshev.chebvander(x_m / self.half_m[0], DEGREE)
        in_y = np.polynomial.chebyshev.chebvander(y_m / self.half_m[1], DEGREE)
        return np.stack([in_x[:, i] * in_y[:, j] for i, j in TERMS], axis=1)

    def normals(self, x_m: np.ndarray, y_m: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        """(n, 3) directions (-dz/dx, -dz/dy, 1), by differences over a thousandth of the extent."""
        dx, dy = 1e-3 * self.half_m
        along_x = (self.basis(x_m + dx, y_m) - self.basis(x_m - dx, y_m)) @ coefficients / (2 * dx)
        along_y = (self.basis(x_m, y_m + dy) - self.basis(x_m, y_m - dy)) @ coefficients / (2 * dy)
        return np.stack([-along_x, -along_y, np.ones(len(x_m))], axis=1)


@dataclass(frozen=True)
class ViewData:
    """One view's part, in its camera frame: thinned target points (n, 3), marks, and ``labels`` (m,) which of the
    reference's marks they are. ``noise_m``: of one point across the surface. ``sigma_m``: the same, so inflated that
    the points count as if they were independent."""

    points_m: np.ndarray
    marks: tuple[Mark, ...]
    labels: np.ndarray
    noise_m: float
    sigma_m: float


@dataclass(frozen=True)
class Across:
    """A view's points against the surface: residuals (n,), basis (n, 10), derivatives (n, 6) by the pose's motion about
    the surface frame's origin, and robust weights (n,) in 1/m^2."""

    residual_m: np.ndarray
    basis: np.ndarray
    by_pose: np.ndarray
    weight: np.ndarray


def surface_frame(reference: PreparedView) -> SurfaceFrame:
    """The frame of the reference's target."""
    sampling = sampling_of(reference)
    z = sampling.normal
    # x of the frame is the camera's x as far as the surface allows, its y where the surface stands edge-on to that
    along = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = along - (along @ z) * z
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z])
    T[:3, 3] = -T[:3, :3] @ sampling.centre_m
    reach = np.abs(transform_points(T, reference.points_m)[:, :2]).max(axis=0)
    return SurfaceFrame(T, np.maximum(reach, 1e-6))


def view_data(view: PreparedView, reference: PreparedView, T_reference_view: np.ndarray) -> ViewData:
    """Return the data of a view; its marks are those of the reference to which ``T_reference_view`` brings them."""
    points = thinned(view.points_m)
    noise = max(sampling_of(view).noise_m, 1e-9)
    inflation = max(len(points) / independent(int(view.inside.sum())), 1.0)
    marks, labels = _labelled(view.marks.trusted, reference.marks.trusted, T_reference_view)
    return ViewData(points, marks, labels, noise, noise * float(np.sqrt(inflation)))


def across(
    data: ViewData, T_surface_view: np.ndarray, frame: SurfaceFrame, surface: np.ndarray, own: np.ndarray
) -> Across:
    """A view's points against the common surface (10,) plus the view's own smooth error (10,)."""
    points = transform_points(T_surface_view, data.points_m)
    basis = frame.basis(points[:, 0], points[:, 1])
    residual = points[:, 2] - basis @ (surface + own)
    normals = frame.normals(points[:, 0], points[:, 1], surface)
    by_pose = np.einsum("ni,nij->nj", normals, displacement_jacobian(points, np.zeros(3)))
    scale = max(data.noise_m, float(np.median(np.abs(residual))) * MEDIAN_TO_SIGMA)
    return Across(residual, basis, by_pose, tukey(residual / scale) / data.sigma_m**2)


def first_surface(frame: SurfaceFrame, points_m: np.ndarray) -> np.ndarray:
    """(10,) coefficients of the robust cubic through points (n, 3) of the surface's frame."""
    basis = frame.basis(points_m[:, 0], points_m[:, 1])
    surface: np.ndarray = np.zeros(len(TERMS))
    root: np.ndarray = np.ones(len(points_m))
    for _ in range(START_STEPS):
        surface = np.linalg.lstsq(basis * root[:, None], points_m[:, 2] * root, rcond=None)[0]
        residual = points_m[:, 2] - basis @ surface
        root = np.sqrt(tukey(residual / max(float(np.median(np.abs(residual))) * MEDIAN_TO_SIGMA, 1e-9)))
    return surface


def tukey(scaled: np.ndarray) -> np.ndarray:
    """Tukey's bisquare weights of residuals in standard deviations."""
    inside = np.clip(1 - (scaled / BISQUARE_TUNING) ** 2, 0.0, None)
    weights: np.ndarray = inside**2
    return weights


def _labelled(
    marks: Sequence[Mark], reference: Sequence[Mark], T_reference_view: np.ndarray
) -> tuple[tuple[Mark, ...], np.ndarray]:
    """Marks that are one of the reference's, each at most once, the best fit first; and which."""
    turn = T_reference_view[:3, :3]
    fits = []
    for i, mark in enumerate(marks):
        for j, other in enumerate(reference):
            if mark.code != other.code:
                continue
            apart = transform_points(T_reference_view, mark.centre_m) - other.centre_m
            spread = turn @ mark.covariance_m2 @ turn.T + other.covariance_m2 + 2 * SHARED_M**2 * np.eye(3)
            fits.append((float(apart @ np.linalg.solve(spread, apart)), i, j))
    chosen: dict[int, int] = {}
    for chi2, i, j in sorted(fits):
        if chi2 <= MARK_GATE and i not in chosen and j not in chosen.values():
            chosen[i] = j
    return tuple(marks[i] for i in sorted(chosen)), np.array([chosen[i] for i in sorted(chosen)], dtype=int)


def register_jointly(views: Sequence[PreparedView]) -> list[Registration]:
    """Views but the first to the first, from all views together.

    ``covariance`` is each view's marginal, smooth errors of the views included; ``residual_m`` the root mean square
    across the surface of the points that count. A view whose marks fail keeps that failure and takes no part.
    """
    by_marks = [register_by_marks(views[0], view) for view in views[1:]]
    usable = [i for i, found in enumerate(by_marks) if not found.failure]
    joint: dict[int, Registration] = {}
    if usable:
        adjusted = _adjust([views[0], *(views[i + 1] for i in usable)], [by_marks[i] for i in usable])
        joint = dict(zip(usable, adjusted, strict=True))
    return [replace(joint.get(i, found), method="joint") for i, found in enumerate(by_marks)]


@dataclass(frozen=True)
class _State:
    """``T`` (v, 4, 4) views to the surface's frame; ``surface`` (10,) and ``own`` (v, 10) coefficients, metres;
    ``marks_m`` (m, 2) places in the plane; ``shared_m`` prior deviation of each term of ``own``."""

    T: np.ndarray
    surface: np.ndarray
    own: np.ndarray
    marks_m: np.ndarray
    shared_m: float


@dataclass(frozen=True)
class _Layout:
    """The index of each unknown: the poses of views 1.., the surface, the marks, the own errors of views 0.."""

    views: int
    marks: int

    def pose(self, v: int) -> np.ndarray:
        return np.arange(6 * (v - 1), 6 * v) if v else np.empty(0, dtype=int)

    @property
    def surface(self) -> np.ndarray:
        return 6 * (self.views - 1) + np.arange(len(TERMS))

    def mark(self, label: int) -> np.ndarray:
        return 6 * (self.views - 1) + len(TERMS) + 2 * label + np.arange(2)

    def own(self, v: int) -> np.ndarray:
        return 6 * (self.views - 1) + 2 * self.marks + len(TERMS) * (v + 1) + np.arange(len(TERMS))

    @property
    def size(self) -> int:
        return 6 * (self.views - 1) + 2 * self.marks + len(TERMS) * (self.views + 1)


class _Normal:
    """Normal equations N d = g of one Gauss-Newton step."""

    def __init__(self, size: int) -> None:
        self.matrix = np.zeros((size, size))
        self.right = np.zeros(size)

    def add(self, columns: np.ndarray, rows: np.ndarray, residual: np.ndarray, weight: np.ndarray) -> None:
        """Residuals (n,) with derivatives ``rows`` (n, c) by the unknowns ``columns``, weighted (n,) or (n, n)."""
        weighted = rows * weight[:, None] if weight.ndim == 1 else weight @ rows
        self.matrix[np.ix_(columns, columns)] += rows.T @ weighted
        self.right[columns] -= weighted.T @ residual


def _adjust(views: Sequence[PreparedView], by_marks: Sequence[Registration]) -> list[Registration]:
    """Registrations of views 1.. adjusted from those by their marks, none of which failed."""
    frame = surface_frame(views[0])
    T_reference = [np.eye(4), *(found.T_reference_view for found in by_marks)]
    data = [view_data(view, views[0], T) for view, T in zip(views, T_reference, strict=True)]
    layout = _Layout(len(views), len(views[0].marks.trusted))
    T = np.stack([frame.T_surface_reference @ each for each in T_reference])
    points = np.concatenate([transform_points(T[v], each.points_m) for v, each in enumerate(data)])
    places = transform_points(T[0], np.stack([mark.centre_m for mark in views[0].marks.trusted]))
    noise = float(np.median([each.noise_m for each in data]))
    state = _State(T, first_surface(frame, points), np.zeros((len(data), len(TERMS))), places[:, :2], noise)
    steps, converged = 0, False
    while steps < MAX_STEPS and not converged:
        steps += 1
        normal = _equations(frame, data, layout, state)
        covariance = np.linalg.inv(normal.matrix)
        motion = covariance @ normal.right
        shared = _shared_deviation(layout, state.own + _own_motion(layout, motion), covariance)
        settled = abs(shared - state.shared_m) <= CONVERGED_SHARED * state.shared_m
        converged = settled and bool(np.abs(motion).max() <= CONVERGED_M)
        state = _moved(layout, state, motion, shared)
    covariance = np.linalg.inv(_equations(frame, data, layout, state).matrix)
    return [
        _registration(v, found, frame, data[v], layout, state, covariance, steps, converged)
        for v, found in enumerate(by_marks, start=1)
    ]


def _equations(frame: SurfaceFrame, data: Sequence[ViewData], layout: _Layout, state: _State) -> _Normal:
    normal = _Normal(layout.size)
    for v, each in enumerate(data):
        seen = across(each, state.T[v], frame, state.surface, state.own[v])
        columns = np.concatenate([layout.surface, layout.own(v), layout.pose(v)])
        rows = np.concatenate([-seen.basis, -seen.basis, *([seen.by_pose] if v else [])], axis=1)
        normal.add(columns, rows, seen.residual_m, seen.weight)
        turn = state.T[v][:2, :3]
        for mark, label in zip(each.marks, each.labels, strict=True):
            place = transform_points(state.T[v], mark.centre_m)
            by_pose = displacement_jacobian(place[None], np.zeros(3))[0, :2]
            columns = np.concatenate([layout.mark(label), layout.pose(v)])
            rows = np.concatenate([-np.eye(2), *([by_pose] if v else [])], axis=1)
            weight = np.linalg.inv(turn @ mark.covariance_m2 @ turn.T)
            normal.add(columns, rows, place[:2] - state.marks_m[label], weight)
        normal.add(layout.own(v), np.eye(len(TERMS)), state.own[v], np.full(len(TERMS), state.shared_m**-2))
    return normal


def _own_motion(layout: _Layout, motion: np.ndarray) -> np.ndarray:
    return np.stack([motion[layout.own(v)] for v in range(layout.views)])


def _shared_deviation(layout: _Layout, own: np.ndarray, covariance: np.ndarray) -> float:
    """Deviation of the views' own terms, from those that no pose can imitate: the maximisation step of EM, in which
    their own uncertainty (the surface's included) stands beside their squares."""
    variances = np.stack([np.diag(covariance)[layout.own(v)] for v in range(layout.views)])
    squares = own[:, POSE_TERMS:] ** 2 + variances[:, POSE_TERMS:]
    return max(float(np.sqrt(squares.mean())), LEAST_SHARED_M)


def _moved(layout: _Layout, state: _State, motion: np.ndarray, shared_m: float) -> _State:
    from scipy.spatial.transform import Rotation

    T = state.T.copy()
    for v in range(1, layout.views):
        step, pose = np.eye(4), motion[layout.pose(v)]  # a small motion (w, t) about the origin
        step[:3, :3], step[:3, 3] = Rotation.from_rotvec(pose[:3]).as_matrix(), pose[3:]
        T[v] = step @ T[v]
    marks = np.stack([place + motion[layout.mark(k)] for k, place in enumerate(state.marks_m)])
    own = state.own + _own_motion(layout, motion)
    return _State(T, state.surface + motion[layout.surface], own, marks, shared_m)


def _registration(
    v: int,
    by_marks: Registration,
    frame: SurfaceFrame,
    data: ViewData,
    layout: _Layout,
    state: _State,
    covariance: np.ndarray,
    steps: int,
    converged: bool,
) -> Registration:
    seen = across(data, state.T[v], frame, state.surface, state.own[v])
    T_reference_surface = invert(frame.T_surface_reference)
    both = np.kron(np.eye(2), T_reference_surface[:3, :3])
    note = (
        f"each view's own smooth error is {state.shared_m / MM:.2f} mm (deviation of each term of a cubic), as the"
        " views disagree; the covariance holds it"
    )
    return replace(
        by_marks,
        T_reference_view=T_reference_surface @ state.T[v],
        covariance=both @ covariance[np.ix_(layout.pose(v), layout.pose(v))] @ both.T,
        centre_m=T_reference_surface[:3, 3],
        residual_m=float(np.sqrt(np.average(seen.residual_m**2, weights=seen.weight))),
        pairs=len(data.labels),
        iterations=steps,
        converged=converged,
        failure="" if converged else f"did not converge in {steps} steps of the joint adjustment",
        notes=(*by_marks.notes, note),
    )
