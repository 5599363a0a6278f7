"""Several views of one target, registered and merged into one cloud, with what is said of it."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.crop import Choice
from detectors.views.view import PreparedView, View
from harness.inspection import output
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from harness.vocabulary.provenance import RESULTS_VERSION

if TYPE_CHECKING:
    from detectors.recordings import Recording
    from detectors.views.mapping.merge import Mapped
    from detectors.views.mapping.settings import MappingConfig
    from detectors.views.registration.registered import Registration

START_FROM_MARKS = ("icp", "cpd")
"""Methods that need a start; `joint` finds its own, `odometry` goes view to view."""
FRAMES = {
    "T_reference_view": "from a view's camera to the first view's camera"
    " (x right, y down, z away), metres",
    "T_reference_cloud": "from the merged cloud's frame to the first view's camera, metres",
    "covariance": "of the error of T_reference_view: turn about covariance_about_mm, rad,"
    " then shift, metres, both in the first view's frame",
}
"""What the matrices in registrations.json mean."""


@contextmanager
def mistakes_named(view: View | None) -> Iterator[None]:
    """Name the view, if there are several, in a UserError from one of its steps."""
    try:
        yield
    except UserError as mistake:
        prefix = "" if view is None else f"view {view.name}: "
        message = f"{prefix}{mistake.message}"
        raise UserError(message, legal=mistake.legal, fix=mistake.fix) from mistake


def merged_views(
    arguments: argparse.Namespace,
    config: MappingConfig,
    recordings: Sequence[Recording],
    views: Sequence[View],
    choices: Sequence[Choice | None],
) -> Mapped:
    """Find targets and marks (printed at once, as they explain later failures), register and
    merge. Raises UserError if a view has no target, or for all views that cannot be placed."""
    from detectors.views.mapping.merge import Mapped, merge
    from detectors.views.registration.register import register

    prepared = _prepared(arguments, config, recordings, views, choices)
    if config.registration.method in START_FROM_MARKS and arguments.poses is None:
        prepared = _started_from_marks(prepared)
    registrations = register(prepared, config.registration)
    _refuse_failed(registrations, has_poses=arguments.poses is not None)
    return Mapped(prepared, registrations, merge(prepared, registrations, config.merge))


def _prepared(
    arguments: argparse.Namespace,
    config: MappingConfig,
    recordings: Sequence[Recording],
    views: Sequence[View],
    choices: Sequence[Choice | None],
) -> tuple[PreparedView, ...]:
    """Find the target and the marks of each view, and print them."""
    from detectors.views.mapping.merge import prepare

    for view, choice in zip(views, choices, strict=True):
        warnings = choice.warnings if choice else ()
        output.print_warnings(f"view {view.name}: {warning}" for warning in warnings)
    prepared_views = []
    for recording, view, choice in zip(recordings, views, choices, strict=True):
        with mistakes_named(view):
            prepared = prepare(view, config)
        output.print_choice(choice)
        output.print_capture(recording, view.cloud, view.name, prepared.inside, arguments.crop)
        output.print_marks(prepared)
        prepared_views.append(prepared)
    return tuple(prepared_views)


def _started_from_marks(prepared_views: Sequence[PreparedView]) -> tuple[PreparedView, ...]:
    """Give each view the pose by its marks as a start, or the first view's pose without marks."""
    from detectors.views.registration.by_marks import register_by_marks

    reference = prepared_views[0]
    started = []
    for number, prepared in enumerate(prepared_views):
        guess = np.eye(4)
        if number > 0:
            by_marks = register_by_marks(reference, prepared)
            if by_marks.failure:
                start = f"{prepared.view.name} starts from the pose of {reference.view.name}"
                print(f"note: {start}: {by_marks.failure}")
            else:
                guess = by_marks.T_reference_view
        view = replace(prepared.view, T_reference_view_guess=guess)
        started.append(replace(prepared, view=view))
    return tuple(started)


def _refuse_failed(registrations: Sequence[Registration], *, has_poses: bool) -> None:
    """Raise UserError with every view that could not be placed, and why."""
    failed = [registration for registration in registrations if registration.failure]
    if not failed:
        return
    reasons = []
    for registration in failed:
        name = registration.view
        reasons.append(f"{name}: {registration.failure.removeprefix(f'{name}: ')}")
    count = f"{len(failed)} of {len(registrations)} views" if len(failed) > 1 else "one view"
    cannot = f"{count} cannot be registered to {registrations[0].view} by {failed[0].method}"
    pose = "correct --poses" if has_poses else "state their poses (--poses)"
    fix = f"leave such views out, {pose}, or choose another --register or --marks"
    listed = "\n  ".join(reasons)
    raise UserError(f"{cannot}:\n  {listed}", fix=fix)


def registration_data(mapped: Mapped) -> dict[str, Any]:
    """Return registrations as plain data (metres in matrices, else millimetres), and checks that
    need no truth."""
    from detectors.views.registration.registered import plane_through, thinned

    reference = mapped.views[0]
    points_m = thinned(reference.points_m)
    _, normal = plane_through(points_m)
    rows = []
    for view, registration in zip(mapped.views, mapped.registrations, strict=True):
        rows.append(_view_data(reference, view, registration, points_m, normal))
    return {
        "results_version": RESULTS_VERSION,
        "reference": reference.view.name,
        "frames": FRAMES,
        "T_reference_cloud": np.asarray(mapped.merged.T_reference_cloud).tolist(),
        "views": rows,
    }


def _view_data(
    reference: PreparedView,
    view: PreparedView,
    registration: Registration,
    points_m: np.ndarray,
    normal: np.ndarray,
) -> dict[str, Any]:
    """Return one view's registration; ``points_m`` (n, 3) and ``normal`` (3,) of the target in the
    first view's frame."""
    from detectors.views.registration.by_marks import held_out_error_m
    from detectors.views.registration.registered import predicted_error_m

    in_plane_m, across_m = predicted_error_m(registration, points_m, normal)
    held_out_m = None if view is reference else held_out_error_m(reference, view)
    return {
        "view": registration.view,
        "method": registration.method,
        "T_reference_view": registration.T_reference_view.tolist(),
        "covariance": registration.covariance.tolist(),
        "covariance_about_mm": (registration.centre_m / MM).tolist(),
        "residual_mm": registration.residual_m / MM,
        "overlap": registration.overlap,
        "predicted_in_plane_mm": in_plane_m / MM,
        "predicted_across_mm": across_m / MM,
        "held_out_mark_mm": None if held_out_m is None else held_out_m / MM,
        "marks": len(view.marks.trusted),
        "marks_doubtful": len(view.marks.marks) - len(view.marks.trusted),
        "pairs": registration.pairs,
        "notes": registration.notes,
    }
