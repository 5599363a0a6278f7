"""Registration by marks, matched by code or by distances: weighted least squares for each view, or
all views jointly.

To judge whether views belong together, `SHARED_M` allows for errors of range or lens in a single
view. The covariance holds the noise, widened if the marks disagree by more than chance allows
(Birge's ratio).

The joint adjustment is a bundle adjustment (Triggs et al., 2000) with one smooth surface instead
of many points. Its unknowns are the poses of all views but the first, the surface z(x, y) (a
cubic), the marks' places on it, and each view's own smooth error across it:

z(T_v p) - S(x, y) - b_v(x, y) = noise for about 2000 target points p of each view v, and P (T_v c
- M) = noise for each mark c of each view that is one of the reference's, in the surface's frame.
Noise across the surface is that of the sampling, with one independent value in 25 pixels; Tukey's
weights exclude holes. b_v is the smooth error that all pixels of a view share (wiggling,
multipath): a cubic, whose level and tilts are indistinguishable from those of the pose. The
scatter of its seven other terms between views gives their common deviation (by expectation
maximisation), which also widens the level and tilts. Not modelled: errors within the plane; other
surfaces; gross errors of marks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaincc

from detectors.pixels.noise import sigma_of
from detectors.rigid_motion import displacement_jacobian, moved_by
from detectors.surfaces.surface import BISQUARE_TUNING, SurfaceConfig, fit_surface
from detectors.views.marks.mark import Mark, off_line_problem
from detectors.views.registration import registered
from detectors.views.registration.pairing import SHARED_M, Placement, pair_marks, place
from detectors.views.view import PreparedView
from harness.vocabulary.geometry import MM, invert, transform_points

WIDEN_BELOW = 0.01
"""Probability of so large a disagreement of marks by noise alone, below which the covariance is
widened."""
REFUSE_BELOW = 1e-4
"""The same probability, with `SHARED_M` for each mark and axis, below which the views do not fit
together."""


def register_by_marks(reference: PreparedView, view: PreparedView) -> registered.Registration:
    """Return the pose of a view relative to the reference, from their trusted marks; ``overlap``
    stays NaN. Its ``failure`` reports too few marks, marks on a line, and marks that fit nowhere,
    badly or in several ways; the transform is then the best known, or else the guess, or else the
    identity."""
    guess = registered.guess_of(reference, view)
    fixed, moved, problem, notes = _matched(reference, view)
    if len(fixed) < 3:
        return registered.failed(view, "marks", guess, problem, *notes)
    problem = problem or off_line_problem(fixed) or off_line_problem(moved)
    try:
        placement = _placed(fixed, moved, 0.0)
    except np.linalg.LinAlgError:
        return registered.failed(
            view,
            "marks",
            guess,
            problem or "the matched marks do not determine the rotation",
        )
    half_freedom = (3 * len(fixed) - 6) / 2
    residual = float(np.sqrt((placement.residuals_m**2).sum(axis=1).mean()))
    if not problem:
        tolerant = _placed(fixed, moved, SHARED_M)
        if gammaincc(half_freedom, tolerant.chi2 / 2) < REFUSE_BELOW:
            problem = (
                f"the marks do not fit: {residual / MM:.1f} mm remain over {len(fixed)} marks, "
                f"more than noise and {SHARED_M / MM:.0f} mm of each view's own error "
                "explain; the "
                "targets differ, or a mark moved"
            )
    covariance = placement.covariance
    if gammaincc(half_freedom, placement.chi2 / 2) < WIDEN_BELOW:
        ratio = float(np.sqrt(placement.chi2 / (2 * half_freedom)))
        covariance = covariance * ratio**2
        note = (
            f"the marks disagree by {ratio:.1f} times their noise; the covariance is widened "
            "to match"
        )
        notes += (note,)
    return registered.Registration(
        view=view.view.name,
        method="marks",
        T_reference_view=placement.T_to_from,
        covariance=covariance,
        centre_m=placement.centre_m,
        residual_m=residual,
        pairs=len(fixed),
        iterations=placement.iterations,
        converged=placement.converged,
        failure=problem,
        notes=notes,
    )


def held_out_error_m(reference: PreparedView, view: PreparedView) -> float | None:
    """Return the root mean square distance (m) of each matched mark from its place by a
    registration with the others; None if fewer than four marks match, or if leaving one out leaves
    the rest on a line."""
    fixed, moved, problem, _ = _matched(reference, view)
    if problem or len(fixed) < 4:
        return None
    squares = []
    for i, (fixed_mark, moved_mark) in enumerate(zip(fixed, moved, strict=True)):
        remaining = fixed[:i] + fixed[i + 1 :]
        if off_line_problem(remaining):
            return None
        T_reference_view = _placed(remaining, moved[:i] + moved[i + 1 :], 0.0).T_to_from
        mapped = transform_points(T_reference_view, moved_mark.centre_m)
        squares.append(np.sum((mapped - fixed_mark.centre_m) ** 2))
    return float(np.sqrt(np.mean(squares)))


def _matched(
    reference: PreparedView, view: PreparedView
) -> tuple[tuple[Mark, ...], tuple[Mark, ...], str, tuple[str, ...]]:
    """Return the pairs of trusted marks of both views, the reason why they must not be used (or
    ""), and notes."""
    problems = []
    for prepared in (reference, view):
        if prepared.marks.problem:
            problems.append(f"{prepared.view.name}: {prepared.marks.problem}")
    if problems:
        return (), (), "; ".join(problems), ()
    fixed = reference.marks.trusted
    moved = view.marks.trusted
    pairing = pair_marks(fixed, moved, registered.guess_of(reference, view))
    i, j = pairing.pairs.T
    return tuple(fixed[k] for k in i), tuple(moved[k] for k in j), pairing.problem, pairing.notes


def _placed(
    fixed: Sequence[Mark],
    moved: Sequence[Mark],
    shared_m: float,
) -> Placement:
    """Place the view's marks on the reference's, with ``shared_m`` added to the error of each axis
    of each mark."""
    extra = shared_m**2 * np.eye(3)
    return place(
        from_m=np.stack([mark.centre_m for mark in moved]),
        from_spread_m2=np.stack([mark.covariance_m2 for mark in moved]) + extra,
        to_m=np.stack([mark.centre_m for mark in fixed]),
        to_spread_m2=np.stack([mark.covariance_m2 for mark in fixed]) + extra,
    )


MAX_STEPS = 40
CONVERGED_M = 1e-6
CONVERGED_SHARED = 0.02
"""Largest last move of an unknown, and largest last relative change of the deviation of the views'
own errors."""
LEAST_SHARED_M = 1e-6
DEGREE = 3
TERMS = tuple((k - j, j) for k in range(DEGREE + 1) for j in range(k + 1))
"""Orders of the Chebyshev terms in x and y by total degree: a level, two tilts, then seven that no
pose can imitate."""
POSE_TERMS = 3


@dataclass(frozen=True)
class ViewData:
    """The part of one view in the adjustment, in its camera frame."""

    points_m: np.ndarray
    """(n, 3): thinned points of the target."""
    marks: tuple[tuple[Mark, int], ...]
    """Matched marks, each with its index among the reference's."""
    noise_m: float
    """Standard deviation of a point across the surface."""
    sigma_m: float
    """The same, inflated to make the points independent."""


@dataclass(frozen=True)
class JointState:
    """Estimates for v views and m marks. Vectors of all unknowns hold poses 1.., surface, marks,
    ``view_terms``."""

    T: np.ndarray
    """(v, 4, 4): from the views to the surface's frame."""
    surface: np.ndarray
    """(10,): coefficients of the common surface, metres."""
    view_terms: np.ndarray
    """(v, 10): coefficients of each view's own smooth error, metres."""
    marks_m: np.ndarray
    """(m, 2): places of the marks in the plane."""
    shared_m: float
    """Prior deviation of each of the ``view_terms``."""
    half_m: np.ndarray
    """(2,): scales x and y to -1..1."""

    def split(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the parts (v - 1, 6), (10,), (m, 2) and (v, 10) of a vector of all unknowns, or
        of their indices."""
        sizes = [6 * (len(self.T) - 1), len(TERMS), self.marks_m.size]
        poses, surface, marks, view_terms = np.split(values, np.cumsum(sizes))
        return (
            poses.reshape(-1, 6),
            surface,
            marks.reshape(-1, 2),
            view_terms.reshape(-1, len(TERMS)),
        )

    def moved(self, motion: np.ndarray, shared_m: float) -> JointState:
        """Return the state after a motion of all unknowns; poses move about the frame's origin."""
        poses, surface, marks, view_terms = self.split(motion)
        T = self.T.copy()
        for v, pose in enumerate(poses, start=1):
            T[v] = moved_by(pose, np.zeros(3)) @ self.T[v]
        return JointState(
            T=T,
            surface=self.surface + surface,
            view_terms=self.view_terms + view_terms,
            marks_m=self.marks_m + marks,
            shared_m=shared_m,
            half_m=self.half_m,
        )

    def basis(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return the (n, 10) terms of the cubic."""
        products = np.polynomial.chebyshev.chebvander2d(
            x_m / self.half_m[0],
            y_m / self.half_m[1],
            [DEGREE, DEGREE],
        )
        return np.asarray(products[:, [i * (DEGREE + 1) + j for i, j in TERMS]])

    def across(
        self, data: ViewData, v: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return a view's points against the surface: residuals (n,), basis (n, 10), derivatives
        (n, 6) by the pose's motion, and robust weights (n,) in 1/m^2."""
        points = transform_points(self.T[v], data.points_m)
        x, y, z = points.T
        basis = self.basis(x, y)
        residual = z - basis @ (self.surface + self.view_terms[v])
        # the surface's slopes by central differences
        dx, dy = 1e-3 * self.half_m
        basis_change_x = self.basis(x + dx, y) - self.basis(x - dx, y)
        basis_change_y = self.basis(x, y + dy) - self.basis(x, y - dy)
        by_x = basis_change_x @ self.surface / (2 * dx)
        by_y = basis_change_y @ self.surface / (2 * dy)
        normals = np.stack([-by_x, -by_y, np.ones(len(x))], axis=1)
        displacements = displacement_jacobian(points, np.zeros(3))
        by_pose = np.einsum("ni,nij->nj", normals, displacements)
        scale = max(data.noise_m, sigma_of(residual))
        tukey = np.clip(1 - (residual / scale / BISQUARE_TUNING) ** 2, 0.0, None) ** 2
        return residual, basis, by_pose, tukey / data.sigma_m**2

    def equations(self, data: Sequence[ViewData]) -> tuple[np.ndarray, np.ndarray]:
        """Return matrix and right side of the normal equations of one Gauss-Newton step."""
        views = len(self.T)
        size = 6 * (views - 1) + len(TERMS) * (views + 1) + self.marks_m.size
        matrix = np.zeros((size, size))
        right = np.zeros(size)
        poses, surface, marks, view_terms = self.split(np.arange(size))

        def add(
            columns: np.ndarray,
            rows: np.ndarray,
            residual: np.ndarray,
            weight: np.ndarray,
        ) -> None:
            weighted = rows * weight[:, None] if weight.ndim == 1 else weight @ rows
            matrix[np.ix_(columns, columns)] += rows.T @ weighted
            right[columns] -= weighted.T @ residual

        for v, view in enumerate(data):
            # the first view's pose is not an unknown
            pose = poses[v - 1] if v else np.empty(0, dtype=int)
            moves = len(pose)
            residual, basis, by_pose, weight = self.across(view, v)
            rows = np.concatenate([-basis, -basis, by_pose[:, :moves]], axis=1)
            add(np.concatenate([surface, view_terms[v], pose]), rows, residual, weight)
            turn = self.T[v][:2, :3]
            for mark, label in view.marks:
                centre = transform_points(self.T[v], mark.centre_m)
                within = displacement_jacobian(centre[None], np.zeros(3))[0, :2, :moves]
                rows = np.concatenate([-np.eye(2), within], axis=1)
                weight = np.linalg.inv(turn @ mark.covariance_m2 @ turn.T)
                columns = np.concatenate([marks[label], pose])
                add(columns, rows, centre[:2] - self.marks_m[label], weight)
            prior = np.full(len(TERMS), self.shared_m**-2)
            add(view_terms[v], np.eye(len(TERMS)), self.view_terms[v], prior)
        return matrix, right


def register_jointly(views: Sequence[PreparedView]) -> list[registered.Registration]:
    """Register all views but the first to the first, jointly. ``covariance``: each view's
    marginal. ``residual_m``: across the surface, of the points that count. A view whose marks fail
    keeps that failure."""
    registrations = [register_by_marks(views[0], view) for view in views[1:]]
    usable = [i for i, registration in enumerate(registrations) if not registration.failure]
    if usable:
        chosen = [views[i + 1] for i in usable]
        by_marks = [registrations[i] for i in usable]
        adjusted = _adjust([views[0], *chosen], by_marks)
        for i, registration in zip(usable, adjusted, strict=True):
            registrations[i] = registration
    return [replace(registration, method="joint") for registration in registrations]


def _adjust(
    views: Sequence[PreparedView], marked: Sequence[registered.Registration]
) -> list[registered.Registration]:
    """Return registrations of views 1.., adjusted from those by their marks, none of which
    failed."""
    data = [_view_data(view, views[0]) for view in views]
    # the frame of the surface z(x, y): z along its mean normal, towards the camera
    sampling = registered.sampling_of(views[0])
    T_surface_reference = np.eye(4)
    along = np.array([1.0, 0.0, 0.0]) - sampling.normal[0] * sampling.normal
    along /= np.linalg.norm(along)
    T_surface_reference[:3, :3] = np.stack(
        [along, np.cross(sampling.normal, along), sampling.normal]
    )
    T_surface_reference[:3, 3] = -T_surface_reference[:3, :3] @ sampling.centre_m
    T = np.stack(
        [T_surface_reference]
        + [T_surface_reference @ registration.T_reference_view for registration in marked]
    )
    reference_m = transform_points(T[0], views[0].points_m)
    points = [transform_points(T[v], part.points_m) for v, part in enumerate(data)]
    x, y, z = np.concatenate(points).T
    centres = np.stack([mark.centre_m for mark in views[0].marks.trusted])
    state = JointState(
        T=T,
        surface=np.zeros(len(TERMS)),
        view_terms=np.zeros((len(data), len(TERMS))),
        marks_m=transform_points(T[0], centres)[:, :2],
        shared_m=float(np.median([part.noise_m for part in data])),
        half_m=np.maximum(np.abs(reference_m[:, :2]).max(axis=0), 1e-6),
    )
    start = fit_surface(x, y, z, SurfaceConfig(degree=DEGREE)).evaluate(x, y)
    state = replace(state, surface=np.linalg.lstsq(state.basis(x, y), start, rcond=None)[0])
    steps = 0
    converged = False
    while steps < MAX_STEPS and not converged:
        steps += 1
        matrix, right = state.equations(data)
        covariance = np.linalg.inv(matrix)
        motion = covariance @ right
        # the maximisation step of EM: the squares of the terms that no pose can imitate, plus
        # their variance
        moved_terms = state.view_terms + state.split(motion)[3]
        squares = moved_terms**2 + state.split(np.diag(covariance))[3]
        shared = max(float(np.sqrt(squares[:, POSE_TERMS:].mean())), LEAST_SHARED_M)
        settled = abs(shared - state.shared_m) <= CONVERGED_SHARED * state.shared_m
        converged = settled and bool(np.abs(motion).max() <= CONVERGED_M)
        state = state.moved(motion, shared)
    covariance = np.linalg.inv(state.equations(data)[0])
    T_reference_surface = invert(T_surface_reference)
    turn = np.kron(np.eye(2), T_reference_surface[:3, :3])
    note = (
        f"each view's smooth error is {state.shared_m / MM:.2f} mm per term of a cubic; the "
        "covariance includes it"
    )
    lost = "" if converged else f"did not converge in {steps} steps of the joint adjustment"
    adjusted = []
    for v, registration in enumerate(marked, start=1):
        residual, _, _, weight = state.across(data[v], v)
        residual_m = float(np.sqrt(np.average(residual**2, weights=weight)))
        pose = slice(6 * (v - 1), 6 * v)
        spread = turn @ covariance[pose, pose] @ turn.T
        joint = registered.Registration(
            view=registration.view,
            method=registration.method,
            T_reference_view=T_reference_surface @ state.T[v],
            covariance=spread,
            centre_m=T_reference_surface[:3, 3],
            residual_m=residual_m,
            pairs=len(data[v].marks),
            iterations=steps,
            converged=converged,
            failure=lost,
            notes=(*registration.notes, note),
        )
        adjusted.append(joint)
    return adjusted


def _view_data(view: PreparedView, reference: PreparedView) -> ViewData:
    points = registered.thinned(view.points_m)
    noise = max(registered.sampling_of(view).noise_m, 1e-9)
    inflation = max(len(points) / registered.independent(int(view.inside.sum())), 1.0)
    trusted = reference.marks.trusted
    fixed = trusted
    moved = trusted
    if view is not reference:
        fixed, moved, _, _ = _matched(reference, view)
    label = {id(mark): number for number, mark in enumerate(trusted)}
    marks = tuple(
        (moved_mark, label[id(fixed_mark)])
        for fixed_mark, moved_mark in zip(fixed, moved, strict=True)
    )
    return ViewData(points, marks, noise, noise * float(np.sqrt(inflation)))
