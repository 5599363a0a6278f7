"""Decides whether a registration can be trusted, from the agreement of the two targets, and says why not.

The limits follow from the sampling and from a stated blur, not from results.

Real cameras have errors that a whole view shares: an offset, wiggling, the lens. Such errors show as a distance between
registered views that noise does not explain. They widen the covariance and are noted; a view is refused only where they
would blur the merged map by more than `BLUR_M`, or by more than a pixel where pixels are coarser.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from detectors.average import CORRELATED_PIXELS
from detectors.registration.registered import Registration, guess_of, predicted_error_m
from detectors.registration.sampling import MEDIAN_TO_SIGMA, Sampling, independent, local_normals, sampling_of, thinned
from detectors.views import PreparedView
from harness.vocabulary.geometry import invert, transform_points
from harness.vocabulary.units import MM

MIN_OVERLAP = 0.1
"""Share of the view beside the reference's target below which nothing is left to judge the rest by."""
FALSE_ALARM_SIGMAS = 3.09
"""Multiple of the residual's own scatter: a good registration is refused once in a thousand."""
MEDIAN_SCATTER = 1.65
"""Relative error of a standard deviation from the median, over that from the mean square (1 / sqrt(0.37))."""
BLUR_M = 2.0 * MM
"""Distance between registered views beyond which a map of them is blurred too much to judge: with two views each lies
1 mm from their mean, which is a time-of-flight camera's noise in a single frame, and a third of the blur of a rim by a
5 x 5 window over pixels of 1.4 mm."""
UNDETERMINED_PITCHES = 3.0
"""A predicted error over the target beyond this, and beyond `BLUR_M`, puts every point on a wrong pixel: the points do
not fix the pose."""
MOVING_PITCHES = 0.5
"""An iteration that still moves the target by more has not found its place."""
MAX_JUMP_DEG, MAX_JUMP_M = 30.0, 0.1
"""Ten times the error that a nominal pose usually has (some degrees, about 10 mm)."""
UNJUDGED_AGREEMENT = ("nominal", "odometry")
"""Methods that never look at the reference's surface: what they leave is their result, and is noted, not refused."""
TRIMMED = 0.9
"""Share of the fiducial points, the nearest ones, that must agree: a colour rule lets stray pixels through."""


@dataclass(frozen=True)
class Agreement:
    """Agreement of a registered view with the reference target.

    ``beside`` and ``overlap``: share of the view's target points beside which the reference has a point within a
    pitch along the surface, at any distance across it, and at no more than a pitch (or three sigma of noise) across.
    ``apart_m``: robust root mean square distance across the surfaces where they lie beside each other, and
    ``apart_points`` how many that rests on. ``marks_apart_m``: root mean square distance of the fiducial points to the
    nearest of the reference, the farthest tenth left out; NaN where either has fewer than three; ``marks_points`` how
    many they are."""

    beside: float
    overlap: float
    apart_m: float
    apart_points: int
    marks_apart_m: float
    marks_points: int


class ReferenceTarget:
    """The target of the first view, prepared for comparisons; everything in that view's camera frame."""

    def __init__(self, view: PreparedView) -> None:
        self.view = view
        self.sampling: Sampling = sampling_of(view)
        self.points_m = view.points_m
        """Target points (n, 3)."""

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points_m)

    @cached_property
    def _mark_tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.view.mark_points_m)

    def nearest(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return signed distances (n,) along and (n,) across the surface from points (n, 3) to the nearest target
        point; the surface there is the plane through the target's 25 nearest points."""
        count = min(CORRELATED_PIXELS, len(self.points_m))
        near = self.points_m[self._tree.query(points_m, k=count)[1]].reshape(len(points_m), count, 3)
        normals = local_normals(near)
        normals *= np.where(normals @ self.sampling.normal < 0, -1.0, 1.0)[:, None]
        across = np.einsum("ni,ni->n", points_m - near.mean(axis=1), normals)
        foot = points_m - across[:, None] * normals
        return np.linalg.norm(foot - near[:, 0], axis=1), across

    def compare(self, view: PreparedView, sampling: Sampling, T_reference_view: np.ndarray) -> Agreement:
        """Measure the agreement of a view placed by ``T_reference_view`` with this target."""
        if len(self.points_m) < 3 or not view.inside.any():
            return Agreement(0.0, 0.0, float("nan"), 0, float("nan"), 0)
        along, across = self.nearest(transform_points(T_reference_view, thinned(view.points_m)))
        pitch = max(self.sampling.pitch_m, sampling.pitch_m)
        noise = np.hypot(self.sampling.noise_m, sampling.noise_m)
        beside = along <= pitch
        together = beside & (np.abs(across) <= max(pitch, 3 * noise))
        apart = float(np.median(np.abs(across[beside]))) * MEDIAN_TO_SIGMA if beside.any() else float("nan")
        fiducial = transform_points(T_reference_view, view.mark_points_m)
        marks_apart = float("nan")
        if len(fiducial) >= 3 and len(self.view.mark_points_m) >= 3:
            distances = np.sort(self._mark_tree.query(fiducial)[0])[: max(int(TRIMMED * len(fiducial)), 1)]
            marks_apart = float(np.sqrt(np.mean(distances**2)))
        shares = float(beside.mean()), float(together.mean())
        return Agreement(*shares, apart, int(beside.sum()), marks_apart, len(fiducial))


def judge(registration: Registration, reference: ReferenceTarget, view: PreparedView) -> Registration:
    """Return the registration with its overlap and, where it cannot be trusted, its ``failure`` or, for baselines, a
    note. A failure that the method itself found stays as it is."""
    rotation = registration.T_reference_view[:3, :3]
    broken = ""
    finite = np.isfinite(registration.T_reference_view).all()
    if not (finite and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)):
        broken = "no transform was found"
    elif np.linalg.det(rotation) < 0:
        broken = "mirrored: the transform is a reflection, not a rotation"
    if broken:
        return replace(registration, overlap=0.0, failure=registration.failure or broken)
    sampling = sampling_of(view)
    agreement = reference.compare(view, sampling, registration.T_reference_view)
    judged = replace(registration, overlap=agreement.overlap)
    if judged.failure:
        return judged
    if not agreement.beside >= MIN_OVERLAP:
        elsewhere = (
            f"the views do not overlap: {100 * agreement.beside:.0f} % of this view's target lies beside the"
            f" reference's ({100 * MIN_OVERLAP:.0f} % needed)"
        )
    else:
        elsewhere = _jump(judged, reference.view, view)
    if elsewhere:
        return replace(judged, failure=elsewhere)
    undetermined = _undetermined(judged, reference)
    apart = _apart(agreement, reference.sampling, sampling)
    if judged.method in UNJUDGED_AGREEMENT:
        return replace(judged, failure=undetermined, notes=(*judged.notes, *([apart] if apart else [])))
    failure = "; ".join(reason for reason in (undetermined, apart) if reason)
    return replace(judged, failure=failure) if failure else _widened(judged, reference, agreement, sampling)


def still_moving(step_m: float, pitch_m: float) -> str:
    """Return the reason why an iteration whose last step moved the target by ``step_m`` failed; empty if it did not."""
    if step_m <= MOVING_PITCHES * pitch_m:
        return ""
    return f"did not converge: the last step still moved the target by {step_m / MM:.2f} mm"


def too_few_points(points: int, of_reference: int, kind: str) -> str:
    """Return the reason why point clouds cannot be registered: fewer than three points in either view; else empty."""
    where = [
        f"{count} in {name}" for name, count in (("the reference", of_reference), ("the view", points)) if count < 3
    ]
    what = "points of the fiducial colour" if kind == "marks" else "points of the target"
    return f"too few {what}: {' and '.join(where)}, 3 needed" if where else ""


def moved_m(change: np.ndarray, points_m: np.ndarray) -> float:
    """Return the root mean square distance by which the 4x4 transform ``change`` moves points (n, 3)."""
    return float(np.sqrt(np.mean(np.sum((transform_points(change, points_m) - points_m) ** 2, axis=1))))


def _undetermined(registration: Registration, reference: ReferenceTarget) -> str:
    """Return the reason why the points do not determine the pose, naming the weakest motion; empty where they do."""
    if not np.isfinite(registration.covariance).all():
        return ""
    normal, pitch_m = reference.sampling.normal, reference.sampling.pitch_m
    points = thinned(reference.points_m, 200)
    error = float(np.hypot(*predicted_error_m(registration, points, normal)))
    limit = max(UNDETERMINED_PITCHES * pitch_m, BLUR_M)
    if error <= limit:
        return ""
    # the motion left open is the greatest principal part of the predicted error
    values, vectors = np.linalg.eigh(registration.covariance)
    arm = float(np.sqrt(np.mean(np.sum((points - registration.centre_m) ** 2, axis=1))))
    shown = values[:, None] * (vectors.T * np.array([arm, arm, arm, 1.0, 1.0, 1.0])) ** 2
    motion = vectors[:, int(np.argmax(shown.sum(axis=1)))]
    turn, shift = arm * motion[:3], motion[3:]
    if np.linalg.norm(turn) <= np.linalg.norm(shift):
        along = abs(shift @ normal) <= np.linalg.norm(shift) / np.sqrt(2)
        weakest = "the points slide along the surface" if along else "the points do not hold the distance"
    elif abs(turn @ normal) > np.linalg.norm(turn) / np.sqrt(2):
        weakest = "the points do not hold the turn within the surface"
    else:
        weakest = "the points lie on a line, or nearly so, about which the target can turn"
    return (
        f"not determined: {weakest}; the predicted error over the target"
        f" is {error / MM:.1f} mm, which would blur the map (up to {limit / MM:.1f} mm are merged)"
    )


def _jump(registration: Registration, reference: PreparedView, view: PreparedView) -> str:
    """Return the reason why a pose is too far from its guess to be credible; empty where it is credible."""
    guess = guess_of(reference, view)
    if guess is None or not view.inside.any():
        return ""
    change = registration.T_reference_view @ invert(guess)
    turn = np.rad2deg(np.arccos(np.clip((np.trace(change[:3, :3]) - 1) / 2, -1.0, 1.0)))
    centre = view.points_m.mean(axis=0)
    shift = np.linalg.norm(transform_points(registration.T_reference_view, centre) - transform_points(guess, centre))
    if turn <= MAX_JUMP_DEG and shift <= MAX_JUMP_M:
        return ""
    return (
        f"stands {turn:.0f} degrees and {shift / MM:.0f} mm from its guess (up to {MAX_JUMP_DEG:.0f} degrees and"
        f" {MAX_JUMP_M / MM:.0f} mm are credible): marks matched wrongly, another target, or a wrong guess"
    )


def _apart(agreement: Agreement, reference: Sampling, view: Sampling) -> str:
    """Return the reason why surfaces or marks are too far apart to be merged; empty where they are not."""
    # views may differ by their noise beside BLUR_M, or a pixel where it is larger
    blur = float(np.hypot(_noise_m(reference, view), max(BLUR_M, reference.pitch_m, view.pitch_m)))
    limit = blur * (1 + FALSE_ALARM_SIGMAS * MEDIAN_SCATTER / np.sqrt(2 * independent(agreement.apart_points)))
    if agreement.apart_m > limit:
        return (
            f"the surfaces lie {agreement.apart_m / MM:.1f} mm apart where the views overlap, which would blur the map"
            f" (up to {limit / MM:.1f} mm are merged): a wrong registration, or different targets"
        )
    limit = float(np.hypot(blur, _between_grids_m(reference, view)))
    limit *= 1 + FALSE_ALARM_SIGMAS / np.sqrt(2 * independent(agreement.marks_points))
    if agreement.marks_apart_m > limit:
        return (
            f"the marks of the views do not coincide: their points lie {agreement.marks_apart_m / MM:.1f} mm apart,"
            f" which would blur the map (up to {limit / MM:.1f} mm are merged): a wrong registration, or different"
            " targets"
        )
    return ""


def _noise_m(reference: Sampling, view: Sampling) -> float:
    """Return the standard deviation, by noise, of the distance between two correctly placed surfaces."""
    return float(np.hypot(reference.noise_m, view.noise_m))


def _between_grids_m(reference: Sampling, view: Sampling) -> float:
    """Return the root mean square distance between the nearest points of two grids of one pitch, without edges."""
    return max(reference.pitch_m, view.pitch_m) / float(np.sqrt(6))


def _widened(
    registration: Registration, reference: ReferenceTarget, agreement: Agreement, sampling: Sampling
) -> Registration:
    """Return the registration with a covariance that includes the errors that a whole view shares, with a note where
    the views show such errors.

    Their mean square is the part of the distances between the views that neither noise nor the covariance explains. It
    is added to the shift, across the surface and within it, because one pair of views cannot distinguish an error of
    the level from a turn or a bend. An offset of a whole view does not show: the registration absorbs it.
    """
    if not np.isfinite(registration.covariance).all():
        return registration
    normal, noise = reference.sampling.normal, _noise_m(reference.sampling, sampling)
    within, across = predicted_error_m(registration, thinned(reference.points_m, 200), normal)

    def beyond_m(measured_m: float, explained_m: float, scatter: float) -> float:
        """Return the root mean square error beside the explained part; 0 within its own scatter."""
        beyond = measured_m > explained_m * (1 + scatter)
        return float(np.sqrt(measured_m**2 - explained_m**2)) if beyond else 0.0

    scatter = FALSE_ALARM_SIGMAS * MEDIAN_SCATTER / np.sqrt(2 * independent(agreement.apart_points))
    more_across = beyond_m(agreement.apart_m, float(np.hypot(noise, across)), scatter)
    explained = float(np.sqrt(noise**2 + across**2 + within**2 + _between_grids_m(reference.sampling, sampling) ** 2))
    scatter = FALSE_ALARM_SIGMAS / np.sqrt(2 * independent(agreement.marks_points))
    more_within = beyond_m(agreement.marks_apart_m, float(np.hypot(explained, more_across)), scatter)
    if not more_across and not more_within:
        return registration
    along = np.outer(normal, normal)
    covariance = registration.covariance.copy()
    # an error within the plane has two axes to share its mean square
    covariance[3:, 3:] += more_across**2 * along + 0.5 * more_within**2 * (np.eye(3) - along)
    parts = [f"{m / MM:.2g} mm {way}" for m, way in ((more_across, "across"), (more_within, "along")) if m]
    note = (
        f"the views disagree by {' and '.join(parts)} the surface beyond what noise explains: an error that each view"
        " shares (offset, wiggling, lens); the covariance is widened by it"
    )
    return replace(registration, covariance=covariance, notes=(*registration.notes, note))
