"""Registers views by the method in the settings, and judges whether each registration can be
trusted.

Errors that a whole view shares (an offset, wiggling, the lens) show as a distance between
registered views that noise does not explain. They widen the covariance and are noted; a view is
refused only if they would blur the merged map by more than `BLUR_M`, or by more than a pixel if
pixels are coarser."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from scipy.spatial import cKDTree

from detectors.averages.average import CORRELATED_PIXELS
from detectors.pixels.noise import sigma_of
from detectors.views.registration import registered
from detectors.views.registration.by_marks import register_by_marks, register_jointly
from detectors.views.registration.by_points import (
    register_by_cpd,
    register_by_icp,
    register_by_odometry,
)
from detectors.views.registration.settings import (
    PAIRWISE,
    AnyRegistration,
    CpdRegistration,
    IcpRegistration,
)
from detectors.views.view import PreparedView
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, invert, transform_points

FALSE_ALARM_SIGMAS = 3.09
"""A view is refused beyond this multiple of the residual's own scatter: a good view once in a
thousand."""
MEDIAN_SCATTER = 1.65
"""Ratio of a standard deviation's relative error from the median to that from the mean square: 1 /
sqrt(0.37)."""
BLUR_M = (
    2.0 * MM
)  # distance between registered views that blurs a map too much: twice the noise of a single frame
UNDETERMINED_PITCHES = 3.0
"""A larger predicted error over the target, in pitches, and above `BLUR_M`, puts every point on a
wrong pixel."""
# ten times the usual error of a nominal pose (some degrees, about 10 mm)
MAX_JUMP_DEG = 30.0
MAX_JUMP_M = 0.1
UNJUDGED_AGREEMENT = ("nominal", "odometry")
"""Methods that never use the reference's surface: their remaining distance is noted, not refused.
"""
# share of the fiducial points, nearest first, that must agree: a colour rule also accepts stray
# pixels
TRIMMED = 0.9


@dataclass(frozen=True)
class Agreement:
    """Agreement of a registered view with the reference target."""

    beside: float
    """Share of the view's target points with a reference point within a pitch along the surface,
    at any distance across it."""
    overlap: float
    """The same, and within a pitch (or three sigma of noise) across it."""
    apart_m: float
    """Robust root mean square distance across the surfaces where both exist."""
    marks_m: float
    """Root mean square distance of the fiducial points to the nearest of the reference, without
    the farthest tenth; NaN if either has fewer than three."""
    pitch_m: float
    """Larger pitch of the two views."""
    noise_m: float
    """Distance that noise explains."""
    grids_m: float
    """Distance that two grids of one pitch explain."""
    scatter: float
    """Relative error of ``apart_m``, times `FALSE_ALARM_SIGMAS`."""
    marks_scatter: float
    """Relative error of ``marks_m``, times `FALSE_ALARM_SIGMAS`."""


def _agreement(
    reference: PreparedView,
    sampling: registered.Sampling,
    view: PreparedView,
    T_reference_view: np.ndarray,
) -> Agreement:
    """Return the agreement of a view placed by ``T_reference_view`` with the reference's target,
    sampled as ours."""
    of_view = registered.sampling_of(view)
    points = reference.points_m
    marks = reference.mark_points_m
    pitch = max(sampling.pitch_m, of_view.pitch_m)
    noise = float(np.hypot(sampling.noise_m, of_view.noise_m))
    beside = np.zeros(1, bool)
    together = np.zeros(1, bool)
    apart_m = float("nan")
    marks_m = float("nan")
    fiducial = transform_points(T_reference_view, view.mark_points_m)
    if len(points) >= 3 and view.inside.any():
        # the reference's surface at a point is the plane through its 25 nearest points
        placed = transform_points(T_reference_view, registered.thinned(view.points_m))
        count = min(CORRELATED_PIXELS, len(points))
        _, nearest = cKDTree(points).query(placed, k=count)
        neighbours = points[nearest].reshape(len(placed), count, 3)
        normals = registered.local_normals(neighbours)
        across = np.einsum("ni,ni->n", placed - neighbours.mean(axis=1), normals)
        along = np.linalg.norm(placed - across[:, None] * normals - neighbours[:, 0], axis=1)
        beside = along <= pitch
        together = beside & (np.abs(across) <= max(pitch, 3 * noise))
        apart_m = sigma_of(across[beside]) if beside.any() else apart_m
        if min(len(fiducial), len(marks)) >= 3:
            distances = np.sort(cKDTree(marks).query(fiducial)[0])
            distances = distances[: max(int(TRIMMED * len(fiducial)), 1)]
            marks_m = float(np.sqrt(np.mean(distances**2)))
    count_beside = registered.independent(int(beside.sum()))
    count_marks = registered.independent(len(fiducial))
    return Agreement(
        beside=float(beside.mean()),
        overlap=float(together.mean()),
        apart_m=apart_m,
        marks_m=marks_m,
        pitch_m=pitch,
        noise_m=noise,
        grids_m=pitch / float(np.sqrt(6)),
        scatter=FALSE_ALARM_SIGMAS * MEDIAN_SCATTER / float(np.sqrt(2 * count_beside)),
        marks_scatter=FALSE_ALARM_SIGMAS / float(np.sqrt(2 * count_marks)),
    )


def judge(
    registration: registered.Registration,
    reference: PreparedView,
    view: PreparedView,
) -> registered.Registration:
    """Return the registration with its overlap and, if it cannot be trusted, a ``failure`` or
    note."""
    T = registration.T_reference_view
    R = T[:3, :3]
    is_rigid = np.isfinite(T).all() and np.allclose(R @ R.T, np.eye(3), atol=1e-6)
    if not is_rigid or np.linalg.det(R) < 0:
        broken = "no transform was found"
        if is_rigid:
            broken = "mirrored: the transform is a reflection, not a rotation"
        return replace(registration, overlap=0.0, failure=registration.failure or broken)
    sampling = registered.sampling_of(reference)
    points = registered.thinned(reference.points_m, 200)
    agreement = _agreement(reference, sampling, view, T)
    judged = replace(registration, overlap=agreement.overlap)
    if judged.failure:
        return judged
    if not agreement.beside >= registered.MIN_OVERLAP:
        elsewhere = (
            f"the views do not overlap: {100 * agreement.beside:.0f} % of the view lies "
            "beside the "
            f"reference ({100 * registered.MIN_OVERLAP:.0f} % needed)"
        )
    else:
        elsewhere = _jump(judged, reference, view)
    if elsewhere:
        return replace(judged, failure=elsewhere)
    within, across = registered.predicted_error_m(judged, points, sampling.normal)
    error_m = float(np.hypot(within, across))
    limit_m = max(UNDETERMINED_PITCHES * sampling.pitch_m, BLUR_M)
    undetermined = ""
    separation = _apart(agreement)
    if error_m > limit_m:
        undetermined = (
            "not determined: the points let the target slide or rotate (they lie on a line, or "
            f"the surface slides in itself); the predicted error over it is {error_m / MM:.1f} "
            f"mm, which would blur the map (up to {limit_m / MM:.1f} mm are merged)"
        )
    if judged.method in UNJUDGED_AGREEMENT:
        notes = judged.notes
        if separation:
            notes += (separation,)
        return replace(judged, failure=undetermined, notes=notes)
    failure = "; ".join(reason for reason in (undetermined, separation) if reason)
    if failure:
        return replace(judged, failure=failure)
    return _widened(judged, sampling.normal, within, across, agreement)


def _jump(
    registration: registered.Registration,
    reference: PreparedView,
    view: PreparedView,
) -> str:
    """Return the reason why a pose is too far from its guess to be credible; empty if it is
    credible."""
    guess = registered.guess_of(reference, view)
    if guess is None:
        return ""
    change = registration.T_reference_view @ invert(guess)
    # the trace of a rotation is 1 + 2 cos of its angle
    cosine = (np.trace(change[:3, :3]) - 1) / 2
    turn_deg = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
    centre = view.points_m.mean(axis=0)
    placed = transform_points(registration.T_reference_view, centre)
    shift = np.linalg.norm(placed - transform_points(guess, centre))
    if turn_deg <= MAX_JUMP_DEG and shift <= MAX_JUMP_M:
        return ""
    return (
        f"is {turn_deg:.0f} degrees and {shift / MM:.0f} mm away from its guess (up to "
        f"{MAX_JUMP_DEG:.0f} degrees and {MAX_JUMP_M / MM:.0f} mm are credible): marks matched "
        "wrongly, another target, or a wrong guess"
    )


def _apart(agreement: Agreement) -> str:
    """Return the reason why surfaces or marks are too far apart to be merged; empty if they are
    not."""
    # views may differ by their noise and BLUR_M, or by a pixel if that is larger
    blur = float(np.hypot(agreement.noise_m, max(BLUR_M, agreement.pitch_m)))
    limit = blur * (1 + agreement.scatter)
    marks_limit = float(np.hypot(blur, agreement.grids_m)) * (1 + agreement.marks_scatter)
    if agreement.apart_m > limit:
        text = f"the surfaces lie {agreement.apart_m / MM:.1f} mm apart where the views overlap"
    elif agreement.marks_m > marks_limit:
        text = (
            "the marks of the views do not coincide: their points lie "
            f"{agreement.marks_m / MM:.1f} mm apart"
        )
        limit = marks_limit
    else:
        return ""
    blurred = f"which would blur the map (up to {limit / MM:.1f} mm are merged)"
    return f"{text}, {blurred}: a wrong registration, or different targets"


def _widened(
    registration: registered.Registration,
    normal: np.ndarray,
    within: float,
    across: float,
    agreement: Agreement,
) -> registered.Registration:
    """Return the registration with a note and a covariance that includes the errors that a whole
    view shares, if the views show such errors. Their mean square, which neither noise nor the
    covariance explains, is added to the shift, across the surface and within it. An offset of a
    whole view does not show."""

    def beyond_m(
        measured_m: float,
        explained_m: float,
        scatter: float,
    ) -> float:
        if not measured_m > explained_m * (1 + scatter):
            return 0.0
        return float(np.sqrt(measured_m**2 - explained_m**2))

    noise_m = agreement.noise_m
    explained_across = float(np.hypot(noise_m, across))
    more_across = beyond_m(agreement.apart_m, explained_across, agreement.scatter)
    parts_m = [noise_m, across, within, agreement.grids_m, more_across]
    explained_within = float(np.linalg.norm(parts_m))
    more_within = beyond_m(agreement.marks_m, explained_within, agreement.marks_scatter)
    if not more_across and not more_within:
        return registration
    along = np.outer(normal, normal)
    covariance = registration.covariance.copy()
    # an error within the plane has two axes to share its mean square
    covariance[3:, 3:] += more_across**2 * along + 0.5 * more_within**2 * (np.eye(3) - along)
    parts = []
    if more_across:
        parts.append(f"{more_across / MM:.2g} mm across")
    if more_within:
        parts.append(f"{more_within / MM:.2g} mm along")
    note = (
        f"the views disagree by {' and '.join(parts)} the surface beyond what noise explains: "
        "each view's own error (offset, wiggling, lens); the covariance is widened by it"
    )
    return replace(registration, covariance=covariance, notes=(*registration.notes, note))


def register(
    views: Sequence[PreparedView], config: AnyRegistration
) -> tuple[registered.Registration, ...]:
    """Return one registration for each view; the first is that of the reference. A registration
    that cannot be trusted has a ``failure``. Raises UserError if a view lacks an input of the
    method (colour, a pixel grid, a guess)."""
    if not views:
        raise UserError(
            "no views to register", legal="one or more views, the first being the reference"
        )
    _check_views(views, config)
    of_reference = registered.reference_registration(views[0].view.name, config.method)
    if len(views) == 1:
        return (of_reference,)
    if config.method in PAIRWISE:
        registrations = [_pair(views[0], view, config) for view in views[1:]]
    else:
        started = perf_counter()
        if config.method == "odometry":
            registrations = register_by_odometry(views)
        else:
            registrations = register_jointly(views)
        share = (perf_counter() - started) / len(registrations)
        registrations = [replace(registration, seconds=share) for registration in registrations]
    judged = [of_reference]
    for registration, view in zip(registrations, views[1:], strict=True):
        judged.append(judge(registration, views[0], view))
    return tuple(judged)


def _check_views(views: Sequence[PreparedView], config: AnyRegistration) -> None:
    by_colour = config.method != "nominal" and getattr(config, "points", "marks") == "marks"
    of_odometry = config.method == "odometry"
    for view in views:
        cloud = view.view.cloud
        guess = view.view.T_reference_view_guess
        no_grid = not cloud.organised or cloud.lens is None
        by_points = "registration.method: icp or cpd with points: target"
        for lacks, requirement, fix in (
            (
                by_colour and cloud.rgb is None,
                "colour for every point",
                f"record colour, or use {by_points}",
            ),
            (
                of_odometry and no_grid,
                "a pixel grid and the lens",
                "give the intrinsics, or use another method",
            ),
            (
                config.method == "nominal" and guess is None,
                "the nominal pose of every view",
                "give the guesses",
            ),
        ):
            if lacks:
                raise UserError(
                    f"{view.view.name}: registration by {config.method} needs {requirement}",
                    fix=fix,
                )


def _pair(
    reference: PreparedView,
    view: PreparedView,
    config: AnyRegistration,
) -> registered.Registration:
    """Return the registration of a view to the reference, not judged yet."""
    started = perf_counter()
    if isinstance(config, IcpRegistration):
        registration = register_by_icp(reference, view, config)
    elif isinstance(config, CpdRegistration):
        registration = register_by_cpd(reference, view, config)
    elif config.method == "marks":
        registration = register_by_marks(reference, view)
    else:
        # the quality of the guess is unknown
        guess = registered.guess_of(reference, view)
        registration = registered.Registration(
            view.view.name,
            "nominal",
            np.eye(4) if guess is None else guess,
        )
    return replace(registration, seconds=perf_counter() - started)
