"""How the views were registered, told: what each method knows of itself, and checks that need no truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.inspection import printed
from harness.vocabulary.units import MM

if TYPE_CHECKING:
    from detectors.mapping.merge import Mapped
    from detectors.mapping.settings import MappingConfig
    from detectors.registration.register import LoopError
    from detectors.registration.registered import Registration

LOOPING = ("marks", "icp", "cpd")
"""Methods that register any two views to each other by themselves, so that going round a loop can be wrong."""


@dataclass(frozen=True)
class Checks:
    """``held_out_m``: for each view the root mean square miss of a mark that the registration did not use, None where
    there are too few marks. ``predicted_m``: (in the plane, across it) over the target. ``loops``: of three views."""

    held_out_m: tuple[float | None, ...]
    predicted_m: tuple[tuple[float, float], ...]
    loops: tuple[LoopError, ...]


def checks_of(mapped: Mapped, config: MappingConfig) -> Checks:
    """Marks held out, errors predicted over the reference's target, and loops."""
    from detectors.registration.by_marks import held_out_error_m
    from detectors.registration.registered import predicted_error_m
    from detectors.registration.sampling import plane_through, thinned

    reference, *others = mapped.views
    points_m = thinned(reference.points_m)
    _, normal = plane_through(points_m)
    loops: tuple[LoopError, ...] = ()
    if config.registration.method in LOOPING and len(mapped.views) > 2:
        from detectors.registration.register import loop_errors

        loops = loop_errors(mapped.views, config.registration)
    return Checks(
        held_out_m=(None, *(held_out_error_m(reference, view) for view in others)),
        predicted_m=tuple(predicted_error_m(each, points_m, normal) for each in mapped.registrations),
        loops=loops,
    )


def print_registrations(mapped: Mapped, checks: Checks) -> None:
    """A table with a view a line, then notes, loops and held-out marks."""
    titles = (
        "view", "method", "residual mm", "overlap %", "in plane mm", "across mm", "held out mm", "pairs", "steps", "s",
    )  # fmt: skip
    rows = [_cells(*each) for each in zip(mapped.registrations, checks.predicted_m, checks.held_out_m, strict=True)]
    print("registration to the first view (in plane, across: predicted root mean square error over the target)")
    printed.print_table(titles, rows)
    for each in mapped.registrations:
        for note in each.notes:
            print(f"note: {each.view}: {note}")
    closed = [loop for loop in checks.loops if not loop.failure]
    if closed:
        worst = max(closed, key=lambda loop: loop.translation_m)
        print(
            f"loops: {len(closed)} of three views; the worst, {' - '.join(worst.views)}, ends"
            f" {printed.mm(worst.translation_m)} and {worst.rotation_deg:.3f} degrees from where it began"
        )
    for loop in checks.loops:
        if loop.failure:
            print(f"note: the loop {' - '.join(loop.views)} is open: {loop.failure}")


def _cells(each: Registration, predicted_m: tuple[float, float], held_out_m: float | None) -> tuple[str, ...]:
    return (
        each.view,
        each.method,
        printed.number(each.residual_m / MM, 3),
        printed.number(100 * each.overlap, 0),
        *(printed.number(error / MM, 3) for error in predicted_m),
        "-" if held_out_m is None else printed.number(held_out_m / MM, 3),
        str(each.pairs),
        str(each.iterations),
        printed.number(each.seconds, 3),
    )


def registration_rows(mapped: Mapped, checks: Checks) -> dict[str, Any]:
    """The same as plain data, with the transforms: metres in matrices, millimetres elsewhere."""
    rows = [
        {
            "view": each.view,
            "method": each.method,
            "T_reference_view": each.T_reference_view.tolist(),
            "covariance": each.covariance.tolist(),
            "covariance_about_mm": (each.centre_m / MM).tolist(),
            "residual_mm": each.residual_m / MM,
            "overlap": each.overlap,
            "predicted_in_plane_mm": in_plane / MM,
            "predicted_across_mm": across / MM,
            "held_out_mark_mm": None if held_out is None else held_out / MM,
            "marks": len(view.marks.trusted),
            "marks_doubtful": len(view.marks.marks) - len(view.marks.trusted),
            "pairs": each.pairs,
            "iterations": each.iterations,
            "converged": each.converged,
            "seconds": round(each.seconds, 4),
            "notes": each.notes,
        }
        for view, each, (in_plane, across), held_out in zip(
            mapped.views, mapped.registrations, checks.predicted_m, checks.held_out_m, strict=True
        )
    ]
    loops = [
        {
            "views": loop.views,
            "rotation_deg": loop.rotation_deg,
            "translation_mm": loop.translation_m / MM,
            "failure": loop.failure,
        }
        for loop in checks.loops
    ]
    return {
        "reference": mapped.views[0].view.name,
        "frames": {
            "T_reference_view": "from a view's camera to the first view's camera (x right, y down, z away), metres",
            "T_reference_cloud": "from the merged cloud's frame to the first view's camera, metres",
            "covariance": "of the error of T_reference_view: turn about covariance_about_mm, rad, then shift, metres,"
            " both in the first view's frame",
        },
        "T_reference_cloud": np.asarray(mapped.merged.T_reference_cloud).tolist(),
        "merge_seconds": round(mapped.merged.seconds, 4),
        "views": rows,
        "loops": loops,
    }
