"""Decides whether a registration can be trusted, and says why not.

The limits follow from the sampling and from a stated blur, not from results.

Real cameras err by what a whole view shares: an offset, wiggling, the lens. Such errors show as a distance between
registered views that noise does not explain. They widen the covariance and are noted; a view is refused only where they
would blur the merged map by more than `BLUR_M`, or by more than a pixel where pixels are coarser.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from detectors.registration.agreement import Agreement, ReferenceTarget
from detectors.registration.points import guess_of
from detectors.registration.registered import Registration, predicted_error_m
from detectors.registration.sampling import Sampling, independent, sampling_of, thinned
from detectors.views import PreparedView
from harness.vocabulary.geometry import invert, transform_points
from harness.vocabulary.units import MM

MIN_OVERLAP = 0.1
"""Share of the view beside the reference's target below which nothing is left to judge the rest by."""
FALSE_ALARM_SIGMAS = 3.09
"""Of the residual's own scatter: a good registration is refused once in a thousand."""
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


def judge(registration: Registration, reference: ReferenceTarget, view: PreparedView) -> Registration:
    """The registration with its overlap and, where it cannot be trusted, its ``failure`` or, for baselines, a note.

    A failure that the method has found itself stands.
    """
    broken = _not_rigid(registration)
    if broken:
        return replace(registration, overlap=0.0, failure=registration.failure or broken)
    sampling = sampling_of(view)
    agreement = reference.compare(view, sampling, registration.T_reference_view)
    judged = replace(registration, overlap=agreement.overlap)
    if judged.failure:
        return judged
    nowhere = _no_overlap(agreement) or _jump(judged, reference.view, view)
    if nowhere:
        return replace(judged, failure=nowhere)
    open_ = _undetermined(judged, reference)
    both = (agreement, reference.sampling, sampling)
    apart = _surfaces_apart(*both) or _marks_apart(*both)
    if judged.method in UNJUDGED_AGREEMENT:
        return replace(judged, failure=open_, notes=(*judged.notes, *([apart] if apart else [])))
    failure = "; ".join(reason for reason in (open_, apart) if reason)
    return replace(judged, failure=failure) if failure else _widened(judged, reference, agreement, sampling)


def still_moving(step_m: float, pitch_m: float) -> str:
    """Why an iteration that ended with a step of ``step_m`` over the target has failed, empty where it has not."""
    if step_m <= MOVING_PITCHES * pitch_m:
        return ""
    return f"did not converge: the last step still moved the target by {step_m / MM:.2f} mm"


def too_few_points(points: int, of_reference: int, kind: str) -> str:
    """Why a cloud of points cannot be registered: fewer than three in either view."""
    where = [
        f"{count} in {name}" for name, count in (("the reference", of_reference), ("the view", points)) if count < 3
    ]
    what = "points of the fiducial colour" if kind == "marks" else "points of the target"
    return f"too few {what}: {' and '.join(where)}, 3 needed" if where else ""


def _not_rigid(registration: Registration) -> str:
    T_reference_view = registration.T_reference_view
    rotation = T_reference_view[:3, :3]
    if np.isfinite(T_reference_view).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
        return "" if np.linalg.det(rotation) > 0 else "mirrored: the transform is a reflection, not a rotation"
    return "no transform was found"


def _no_overlap(agreement: Agreement) -> str:
    if agreement.beside >= MIN_OVERLAP:
        return ""
    return (
        f"the views do not overlap: {100 * agreement.beside:.0f} % of this view's target lies beside the reference's"
        f" ({100 * MIN_OVERLAP:.0f} % needed)"
    )


def _undetermined(registration: Registration, reference: ReferenceTarget) -> str:
    if not np.isfinite(registration.covariance).all():
        return ""
    sampling = reference.sampling
    points = thinned(reference.points_m, 200)
    error = float(np.hypot(*predicted_error_m(registration, points, sampling.normal)))
    limit = max(UNDETERMINED_PITCHES * sampling.pitch_m, BLUR_M)
    if error <= limit:
        return ""
    return (
        f"not determined: {_weakest_motion(registration, points, sampling.normal)}; the predicted error over the target"
        f" is {error / MM:.1f} mm, which would blur the map (up to {limit / MM:.1f} mm are merged)"
    )


def _weakest_motion(registration: Registration, points_m: np.ndarray, normal: np.ndarray) -> str:
    """In words the motion that the points leave open, from the greatest principal part of the predicted error."""
    values, vectors = np.linalg.eigh(registration.covariance)
    arm = float(np.sqrt(np.mean(np.sum((points_m - registration.centre_m) ** 2, axis=1))))
    shown = values[:, None] * (vectors.T * np.array([arm, arm, arm, 1.0, 1.0, 1.0])) ** 2
    motion = vectors[:, int(np.argmax(shown.sum(axis=1)))]
    turn, shift = arm * motion[:3], motion[3:]
    if np.linalg.norm(turn) <= np.linalg.norm(shift):
        along = abs(shift @ normal) <= np.linalg.norm(shift) / np.sqrt(2)
        return "the points slide along the surface" if along else "the points do not hold the distance"
    if abs(turn @ normal) > np.linalg.norm(turn) / np.sqrt(2):
        return "the points do not hold the turn within the surface"
    return "the points lie on a line, or nearly so, about which the target can turn"


def _jump(registration: Registration, reference: PreparedView, view: PreparedView) -> str:
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


def _surfaces_apart(agreement: Agreement, reference: Sampling, view: Sampling) -> str:
    scatter = MEDIAN_SCATTER / np.sqrt(2 * independent(agreement.apart_points))
    limit = _blur_m(reference, view) * (1 + FALSE_ALARM_SIGMAS * scatter)
    if not agreement.apart_m > limit:
        return ""
    return (
        f"the surfaces lie {agreement.apart_m / MM:.1f} mm apart where the views overlap, which would blur the map (up"
        f" to {limit / MM:.1f} mm are merged): a wrong registration, or different targets"
    )


def _marks_apart(agreement: Agreement, reference: Sampling, view: Sampling) -> str:
    limit = float(np.hypot(_blur_m(reference, view), _between_grids_m(reference, view)))
    limit *= 1 + FALSE_ALARM_SIGMAS / np.sqrt(2 * independent(agreement.marks_points))
    if not agreement.marks_apart_m > limit:
        return ""
    return (
        f"the marks of the views do not coincide: their points lie {agreement.marks_apart_m / MM:.1f} mm apart, which"
        f" would blur the map (up to {limit / MM:.1f} mm are merged): a wrong registration, or different targets"
    )


def _blur_m(reference: Sampling, view: Sampling) -> float:
    """Distance between views that may be merged: their noise beside `BLUR_M`, or a pixel where it is larger."""
    return float(np.hypot(_noise_m(reference, view), max(BLUR_M, reference.pitch_m, view.pitch_m)))


def _noise_m(reference: Sampling, view: Sampling) -> float:
    """Standard deviation, by noise, of the distance between two surfaces that are where they should be."""
    return float(np.hypot(reference.noise_m, view.noise_m))


def _between_grids_m(reference: Sampling, view: Sampling) -> float:
    """Root mean square distance between the nearest points of two grids of one pitch, where neither has an edge."""
    return max(reference.pitch_m, view.pitch_m) / float(np.sqrt(6))


def _widened(
    registration: Registration, reference: ReferenceTarget, agreement: Agreement, sampling: Sampling
) -> Registration:
    """The registration whose covariance also holds what the views show of errors that a whole view shares, with a note
    where there are such errors.

    Their mean square is what the distances between the views have beyond noise and beyond the covariance as it is; it
    is added to the shift, across the surface and within it, because one pair of views does not tell an error of the
    level from a turn or a bend. An offset of a whole view does not show: the registration takes it up.
    """
    if not np.isfinite(registration.covariance).all():
        return registration
    normal, noise = reference.sampling.normal, _noise_m(reference.sampling, sampling)
    within, across = predicted_error_m(registration, thinned(reference.points_m, 200), normal)
    scatter = FALSE_ALARM_SIGMAS * MEDIAN_SCATTER / np.sqrt(2 * independent(agreement.apart_points))
    more_across = _beyond_m(agreement.apart_m, float(np.hypot(noise, across)), scatter)
    explained = float(np.sqrt(noise**2 + across**2 + within**2 + _between_grids_m(reference.sampling, sampling) ** 2))
    scatter = FALSE_ALARM_SIGMAS / np.sqrt(2 * independent(agreement.marks_points))
    more_within = _beyond_m(agreement.marks_apart_m, float(np.hypot(explained, more_across)), scatter)
    if not more_across and not more_within:
        return registration
    along = np.outer(normal, normal)
    covariance = registration.covariance.copy()
    # an error within the plane has two axes to share its mean square
    covariance[3:, 3:] += more_across**2 * along + 0.5 * more_within**2 * (np.eye(3) - along)
    told = [f"{m / MM:.2g} mm {way}" for m, way in ((more_across, "across"), (more_within, "along")) if m]
    note = (
        f"the views disagree by {' and '.join(told)} the surface beyond what noise explains: an error that each view"
        " shares (offset, wiggling, lens); the covariance is widened by it"
    )
    return replace(registration, covariance=covariance, notes=(*registration.notes, note))


def _beyond_m(measured_m: float, explained_m: float, scatter: float) -> float:
    """What must stand beside the explained part to give the measured root mean square; 0 within its own scatter."""
    if not measured_m > explained_m * (1 + scatter):
        return 0.0
    return float(np.sqrt(measured_m**2 - explained_m**2))


def moved_m(change: np.ndarray, points_m: np.ndarray) -> float:
    """Root mean square way that the 4x4 transform ``change`` moves points (n, 3)."""
    return float(np.sqrt(np.mean(np.sum((transform_points(change, points_m) - points_m) ** 2, axis=1))))
