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
            view, "marks", guess, problem or "the matched marks do not determine the rotation"
        )
    freedom = 3 * len(fixed) - 6
    residual = float(np.sqrt((placement.residuals_m**2).sum(axis=1).mean()))
    if (
        not problem
        and gammaincc(freedom / 2, _placed(fixed, moved, SHARED_M).chi2 / 2) < REFUSE_BELOW
    ):
        problem = (
            f"the marks do not fit: {residual / MM:.1f} mm remain over {len(fixed)} marks, more "
            "than noise and"
        )
        problem += (
            f" {SHARED_M / MM:.0f} mm of each view's own error explain; the targets differ, or "
            "a mark moved"
        )
    covariance = placement.covariance
    if gammaincc(freedom / 2, placement.chi2 / 2) < WIDEN_BELOW:
        ratio = float(np.sqrt(placement.chi2 / freedom))
        covariance = covariance * ratio**2
        notes += (
            (
                f"the marks disagree by {ratio:.1f} times their noise; the covariance is "
                "widened to match"
            ),
        )
    where = placement.T_to_from, covariance, placement.centre_m
    registration = registered.Registration(
        view.view.name, "marks", *where, residual, failure=problem, notes=notes
    )
    return replace(
        registration,
        pairs=len(fixed),
        iterations=placement.iterations,
        converged=placement.converged,
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
        squares.append(
            np.sum(
                (transform_points(T_reference_view, moved_mark.centre_m) - fixed_mark.centre_m) ** 2
            )
        )
    return float(np.sqrt(np.mean(squares)))


def _matched(
    reference: PreparedView, view: PreparedView
) -> tuple[tuple[Mark, ...], tuple[Mark, ...], str, tuple[str, ...]]:
    """Return the pairs of trusted marks of both views, the reason why they must not be used (or
    ""), and notes."""
    problem = "; ".join(
        f"{prepared.view.name}: {prepared.marks.problem}"
        for prepared in (reference, view)
        if prepared.marks.problem
    )
    if problem:
        return (), (), problem, ()
    fixed = reference.marks.trusted
    moved = view.marks.trusted
    pairing = pair_marks(fixed, moved, registered.guess_of(reference, view))
    i, j = pairing.pairs.T
    return tuple(fixed[k] for k in i), tuple(moved[k] for k in j), pairing.problem, pairing.notes


def _placed(fixed: Sequence[Mark], moved: Sequence[Mark], shared_m: float) -> Placement:
    """Place the view's marks on the reference's, with ``shared_m`` added to the error of each axis
    of each mark."""
    extra = shared_m**2 * np.eye(3)
    fixed_m, moved_m = (np.stack([mark.centre_m for mark in marks]) for marks in (fixed, moved))
    fixed_spread, moved_spread = (
        np.stack([mark.covariance_m2 for mark in marks]) for marks in (fixed, moved)
    )
    return place(moved_m, moved_spread + extra, fixed_m, fixed_spread + extra)


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
    """One view's part: thinned target points (n, 3), and marks in its camera frame, each with its
    index among the reference's. ``noise_m``: of a point across the surface. ``sigma_m``: inflated
    to make points independent."""

    points_m: np.ndarray
    marks: tuple[tuple[Mark, int], ...]
    noise_m: float
    sigma_m: float


@dataclass(frozen=True)
class JointState:
    """Estimates. ``T`` (v, 4, 4): from the views to the surface's frame. ``surface`` (10,) and
    ``own`` (v, 10): coefficients, metres. ``marks_m`` (m, 2): places in the plane. ``shared_m``:
    prior deviation of each term of ``own``. ``half_m`` (2,): scales x, y to -1..1. Vectors of all
    unknowns hold poses 1.., surface, marks, own."""

    T: np.ndarray
    surface: np.ndarray
    own: np.ndarray
    marks_m: np.ndarray
    shared_m: float
    half_m: np.ndarray

    def split(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the parts (v - 1, 6), (10,), (m, 2) and (v, 10) of a vector of all unknowns, or
        of their indices."""
        poses, surface, marks, view_terms = np.split(
            values, np.cumsum([6 * (len(self.T) - 1), len(TERMS), self.marks_m.size])
        )
        return (
            poses.reshape(-1, 6),
            surface,
            marks.reshape(-1, 2),
            view_terms.reshape(-1, len(TERMS)),
        )

    def moved(self, motion: np.ndarray, shared_m: float) -> JointState:
        """Return the state after a motion of all unknowns; poses move about the frame's origin."""
        poses, surface, marks, view_terms = self.split(motion)
        turned = (moved_by(w, np.zeros(3)) @ T for w, T in zip(poses, self.T[1:], strict=True))
        T = np.stack([self.T[0], *turned])
        return JointState(
            T,
            self.surface + surface,
            self.own + view_terms,
            self.marks_m + marks,
            shared_m,
            self.half_m,
        )

    def basis(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return the (n, 10) terms of the cubic."""
        products = np.polynomial.chebyshev.chebvander2d(
            x_m / self.half_m[0], y_m / self.half_m[1], [DEGREE, DEGREE]
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
        residual = z - basis @ (self.surface + self.own[v])
        dx, dy = 1e-3 * self.half_m
        by_x = (self.basis(x + dx, y) - self.basis(x - dx, y)) @ self.surface / (2 * dx)
        by_y = (self.basis(x, y + dy) - self.basis(x, y - dy)) @ self.surface / (2 * dy)
        normals = np.stack([-by_x, -by_y, np.ones(len(x))], axis=1)
        by_pose = np.einsum("ni,nij->nj", normals, displacement_jacobian(points, np.zeros(3)))
        scale = max(data.noise_m, sigma_of(residual))
        tukey = np.clip(1 - (residual / scale / BISQUARE_TUNING) ** 2, 0.0, None) ** 2
        return residual, basis, by_pose, tukey / data.sigma_m**2

    def equations(self, data: Sequence[ViewData]) -> tuple[np.ndarray, np.ndarray]:
        """Return matrix and right side of the normal equations of one Gauss-Newton step."""
        size = 6 * (len(self.T) - 1) + len(TERMS) * (len(self.T) + 1) + self.marks_m.size
        matrix = np.zeros((size, size))
        right = np.zeros(size)
        poses, surface, marks, view_terms = self.split(np.arange(size))

        def add(
            columns: np.ndarray, rows: np.ndarray, residual: np.ndarray, weight: np.ndarray
        ) -> None:
            weighted = rows * weight[:, None] if weight.ndim == 1 else weight @ rows
            matrix[np.ix_(columns, columns)] += rows.T @ weighted
            right[columns] -= weighted.T @ residual

        for v, view in enumerate(data):
            # the first view's pose is not an unknown
            pose, moves = (poses[v - 1], 6) if v else (np.empty(0, dtype=int), 0)
            residual, basis, by_pose, weight = self.across(view, v)
            rows = np.concatenate([-basis, -basis, by_pose[:, :moves]], axis=1)
            add(np.concatenate([surface, view_terms[v], pose]), rows, residual, weight)
            turn = self.T[v][:2, :3]
            for mark, label in view.marks:
                centre = transform_points(self.T[v], mark.centre_m)
                within = displacement_jacobian(centre[None], np.zeros(3))[0, :2, :moves]
                rows = np.concatenate([-np.eye(2), within], axis=1)
                weight = np.linalg.inv(turn @ mark.covariance_m2 @ turn.T)
                add(
                    np.concatenate([marks[label], pose]),
                    rows,
                    centre[:2] - self.marks_m[label],
                    weight,
                )
            add(
                view_terms[v],
                np.eye(len(TERMS)),
                self.own[v],
                np.full(len(TERMS), self.shared_m**-2),
            )
        return matrix, right


def register_jointly(views: Sequence[PreparedView]) -> list[registered.Registration]:
    """Register all views but the first to the first, jointly. ``covariance``: each view's
    marginal. ``residual_m``: across the surface, of the points that count. A view whose marks fail
    keeps that failure."""
    registrations = [register_by_marks(views[0], view) for view in views[1:]]
    usable = [i for i, registration in enumerate(registrations) if not registration.failure]
    if usable:
        adjusted = _adjust(
            [views[0], *(views[i + 1] for i in usable)], [registrations[i] for i in usable]
        )
        for i, registration in zip(usable, adjusted, strict=True):
            registrations[i] = registration
    return [replace(registration, method="joint") for registration in registrations]


def _adjust(
    views: Sequence[PreparedView], marked: Sequence[registered.Registration]
) -> list[registered.Registration]:
    """Return registrations of views 1.., adjusted from those by their marks, none of which
    failed."""
    T_reference = [np.eye(4), *(registration.T_reference_view for registration in marked)]
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
    T = np.stack([T_surface_reference @ T_reference_view for T_reference_view in T_reference])
    half_m = np.maximum(np.abs(transform_points(T[0], views[0].points_m)[:, :2]).max(axis=0), 1e-6)
    x, y, z = np.concatenate(
        [transform_points(T[v], part.points_m) for v, part in enumerate(data)]
    ).T
    marks_m = transform_points(T[0], np.stack([mark.centre_m for mark in views[0].marks.trusted]))[
        :, :2
    ]
    noise = float(np.median([part.noise_m for part in data]))
    state = JointState(
        T, np.zeros(len(TERMS)), np.zeros((len(data), len(TERMS))), marks_m, noise, half_m
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
        squares = (state.own + state.split(motion)[3]) ** 2 + state.split(np.diag(covariance))[3]
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
        where = T_reference_surface @ state.T[v], spread, T_reference_surface[:3, 3]
        joint = registered.Registration(
            registration.view, registration.method, *where, residual_m, pairs=len(data[v].marks)
        )
        adjusted.append(
            replace(
                joint,
                iterations=steps,
                converged=converged,
                failure=lost,
                notes=(*registration.notes, note),
            )
        )
    return adjusted


def _view_data(view: PreparedView, reference: PreparedView) -> ViewData:
    points = registered.thinned(view.points_m)
    noise = max(registered.sampling_of(view).noise_m, 1e-9)
    inflation = max(len(points) / registered.independent(int(view.inside.sum())), 1.0)
    fixed, moved = (
        (reference.marks.trusted,) * 2 if view is reference else _matched(reference, view)[:2]
    )
    label = {id(mark): number for number, mark in enumerate(reference.marks.trusted)}
    marks = tuple(
        (moved_mark, label[id(fixed_mark)])
        for fixed_mark, moved_mark in zip(fixed, moved, strict=True)
    )
    return ViewData(points, marks, noise, noise * float(np.sqrt(inflation)))
