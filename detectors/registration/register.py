"""Registering views by whichever method its settings name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from time import perf_counter

import numpy as np

from detectors.registration.agreement import ReferenceTarget
from detectors.registration.failure import judge
from detectors.registration.points import guess_of, unplaced
from detectors.registration.registered import Registration, reference_registration
from detectors.registration.settings import (
    PAIRWISE,
    AnyRegistration,
    CpdRegistration,
    IcpRegistration,
    JointRegistration,
    MarksRegistration,
    NominalRegistration,
    OdometryRegistration,
)
from detectors.views import PreparedView
from harness.vocabulary.errors import UserError


def register(views: Sequence[PreparedView], config: AnyRegistration) -> tuple[Registration, ...]:
    """One registration for each view, the first that of the reference.

    Never raises for what the views show: a registration that cannot be trusted says so in its ``failure``. Raises
    UserError where the method needs what these views never have (colour, a pixel grid, a guess).
    """
    if not views:
        raise UserError("no views to register", legal="one or more views, the first being the reference")
    check_views(views, config)
    if len(views) == 1:
        return (reference_registration(views[0].view.name, config.method),)
    reference = ReferenceTarget(views[0])
    together = config.method not in PAIRWISE
    found = _all_together(views, config) if together else map(partial(_pairwise(config), views[0]), views[1:])
    judged = [judge(each, reference, view) for each, view in zip(found, views[1:], strict=True)]
    return (reference_registration(views[0].view.name, config.method), *judged)


def register_one(reference: PreparedView, view: PreparedView, config: AnyRegistration) -> Registration:
    """One view to a reference that need not be the first, by a method that registers pairs; judged as `register` does.

    The guess is what those of both views imply. Does not check that the views have what the method needs.
    """
    return judge(_pairwise(config)(reference, view), ReferenceTarget(reference), view)


def check_views(views: Sequence[PreparedView], config: AnyRegistration) -> None:
    """Raises UserError where a method needs what some view never has."""
    for view in views:
        missing = _missing(view, config)
        if missing:
            raise UserError(
                f"{view.view.name}: registration by {config.method} needs {missing[0]}",
                legal=missing[1],
                fix=missing[2],
            )


def _missing(view: PreparedView, config: AnyRegistration) -> tuple[str, str, str] | None:
    """What the view lacks for the method, what would be legal, and what to do; None where it lacks nothing."""
    cloud = view.view.cloud
    by_colour = isinstance(config, OdometryRegistration | MarksRegistration | JointRegistration) or (
        isinstance(config, CpdRegistration | IcpRegistration) and config.points == "marks"
    )
    if by_colour and cloud.rgb is None:
        return (
            "colour, and this capture has none",
            "captures with colour for every point",
            "record colour, or use registration.method: icp or cpd with points: target",
        )
    if isinstance(config, OdometryRegistration) and (not cloud.organised or cloud.lens is None):
        return (
            "a pixel grid and the lens, and this capture has none",
            "organised captures of a camera whose intrinsics are known",
            "give the intrinsics, or use another registration.method",
        )
    if isinstance(config, NominalRegistration) and view.view.T_reference_view_guess is None:
        return (
            "the nominal pose of every view, and this one has none",
            "a guess of where each view stands to the first",
            "give the guesses, or use registration.method: marks",
        )
    return None


def _pairwise(config: AnyRegistration) -> Callable[[PreparedView, PreparedView], Registration]:
    """The method that registers a view to a reference, both given."""
    if isinstance(config, NominalRegistration):
        return _nominal
    if isinstance(config, IcpRegistration):
        from detectors.registration.icp import register_by_icp

        return lambda reference, view: register_by_icp(reference, view, config)
    if isinstance(config, CpdRegistration):
        from detectors.registration.cpd import register_by_cpd

        return lambda reference, view: register_by_cpd(reference, view, config)
    from detectors.registration.by_marks import register_by_marks

    return register_by_marks


def _all_together(views: Sequence[PreparedView], config: AnyRegistration) -> list[Registration]:
    """Methods in which one view's place depends on the others."""
    if isinstance(config, OdometryRegistration):
        from detectors.registration.odometry import register_by_odometry

        return register_by_odometry(views)
    from detectors.registration.joint import register_jointly

    return register_jointly(views)


def _nominal(reference: PreparedView, view: PreparedView) -> Registration:
    """The guess itself; how good it is, nobody has said."""
    started = perf_counter()
    guess = guess_of(reference, view)
    unknown, nan = np.full((6, 6), np.nan), float("nan")
    if guess is None:
        return unplaced(view.view.name, "nominal", None, "no nominal pose is known", started)
    spent = perf_counter() - started
    return Registration(view.view.name, "nominal", guess, unknown, np.zeros(3), nan, nan, 0, 0, True, spent)
