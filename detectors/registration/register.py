"""Registration of views by the method that its settings name, and its consistency around loops of three views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from time import perf_counter

import numpy as np

from detectors.registration.judged import ReferenceTarget, judge, moved_m
from detectors.registration.registered import Registration, failed, guess_of, reference_registration
from detectors.registration.sampling import thinned
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
from harness.vocabulary.geometry import invert

LOOP_POINTS = 500
"""Number of points of the first view's target over which the error of a loop is averaged."""


def register(views: Sequence[PreparedView], config: AnyRegistration) -> tuple[Registration, ...]:
    """Return one registration for each view; the first is that of the reference.

    Never raises for the content of the views: a registration that cannot be trusted has a ``failure``. Raises
    UserError where the method needs something that these views never have (colour, a pixel grid, a guess).
    """
    if not views:
        raise UserError("no views to register", legal="one or more views, the first being the reference")
    check_views(views, config)
    of_reference = reference_registration(views[0].view.name, config.method)
    if len(views) == 1:
        return (of_reference,)
    reference = ReferenceTarget(views[0])
    if config.method in PAIRWISE:
        found = [_pair(views[0], view, config) for view in views[1:]]
    else:
        started = perf_counter()
        if isinstance(config, OdometryRegistration):
            from detectors.registration.odometry import register_by_odometry

            found = register_by_odometry(views)
        else:
            from detectors.registration.joint import register_jointly

            found = register_jointly(views)
        share = (perf_counter() - started) / len(found)
        found = [replace(each, seconds=share) for each in found]
    return (of_reference, *(judge(each, reference, view) for each, view in zip(found, views[1:], strict=True)))


def check_views(views: Sequence[PreparedView], config: AnyRegistration) -> None:
    """Raise UserError where the method needs something that a view does not have."""
    by_colour = isinstance(config, OdometryRegistration | MarksRegistration | JointRegistration) or (
        isinstance(config, CpdRegistration | IcpRegistration) and config.points == "marks"
    )
    for view in views:
        cloud = view.view.cloud
        if by_colour and cloud.rgb is None:
            missing = "colour, and this capture has none"
            legal = "captures with colour for every point"
            fix = "record colour, or use registration.method: icp or cpd with points: target"
        elif isinstance(config, OdometryRegistration) and (not cloud.organised or cloud.lens is None):
            missing = "a pixel grid and the lens, and this capture has none"
            legal = "organised captures of a camera whose intrinsics are known"
            fix = "give the intrinsics, or use another registration.method"
        elif isinstance(config, NominalRegistration) and view.view.T_reference_view_guess is None:
            missing = "the nominal pose of every view, and this view has none"
            legal = "a guess of the pose of each view relative to the first"
            fix = "give the guesses, or use registration.method: marks"
        else:
            continue
        raise UserError(f"{view.view.name}: registration by {config.method} needs {missing}", legal=legal, fix=fix)


def _pair(reference: PreparedView, view: PreparedView, config: AnyRegistration) -> Registration:
    """Return the registration of a view to a reference that need not be the first view, not judged yet."""
    started = perf_counter()
    if isinstance(config, NominalRegistration):
        # nobody has said how good the guess is
        guess = guess_of(reference, view)
        if guess is None:
            return failed(view, "nominal", None, "no nominal pose is known")
        found = Registration(view.view.name, "nominal", guess)
    elif isinstance(config, IcpRegistration):
        from detectors.registration.icp import register_by_icp

        found = register_by_icp(reference, view, config)
    elif isinstance(config, CpdRegistration):
        from detectors.registration.cpd import register_by_cpd

        found = register_by_cpd(reference, view, config)
    else:
        from detectors.registration.by_marks import register_by_marks

        found = register_by_marks(reference, view)
    return replace(found, seconds=perf_counter() - started)


@dataclass(frozen=True)
class LoopError:
    """The closure error of a loop of three views, each step of which was registered separately.

    ``views``: names, in the order of the loop. ``rotation_deg``: of the composed transform; ``translation_m``: root
    mean square displacement of the first view's target by it. NaN where a step failed; ``failure`` names the step.
    """

    views: tuple[str, str, str]
    rotation_deg: float
    translation_m: float
    failure: str = ""


def loop_errors(views: Sequence[PreparedView], config: AnyRegistration, most: int = 40) -> tuple[LoopError, ...]:
    """Return the closure errors of loops i -> j -> k -> i, at most ``most`` of them, evenly taken from all.

    Every pair is registered directly, with the guess that those of both views imply. The errors of the three steps add,
    so a loop shows about sqrt(3) times the error of a step; an error that a view brings equally into both of its
    registrations is not seen. Empty for fewer than three views. Raises UserError as `register` does, and for methods
    that do not register pairs.
    """
    if config.method in ("nominal", "joint", "odometry"):
        raise UserError(
            f"loops cannot be closed with {config.method}: it does not register pairs of views separately",
            legal="icp, cpd, marks",
        )
    check_views(views, config)
    loops = list(combinations(range(len(views)), 3))
    loops = loops[:: max(1, -(-len(loops) // most))]
    sides = sorted({pair for i, j, k in loops for pair in ((i, j), (j, k), (i, k))})
    placed = {(i, j): judge(_pair(views[i], views[j], config), ReferenceTarget(views[i]), views[j]) for i, j in sides}
    errors = []
    for i, j, k in loops:
        names = (views[i].view.name, views[j].view.name, views[k].view.name)
        steps = [((a, b), placed[a, b]) for a, b in ((i, j), (j, k), (i, k))]
        failures = [
            f"{views[b].view.name} to {views[a].view.name}: {step.failure}" for (a, b), step in steps if step.failure
        ]
        if failures:
            errors.append(LoopError(names, float("nan"), float("nan"), "; ".join(failures)))
            continue
        T_ij, T_jk, T_ik = (step.T_reference_view for _, step in steps)
        closed = T_ij @ T_jk @ invert(T_ik)
        turn = np.rad2deg(np.linalg.norm(closed[:3, :3] - np.eye(3)) / np.sqrt(2))
        errors.append(LoopError(names, float(turn), moved_m(closed, thinned(views[i].points_m, LOOP_POINTS))))
    return tuple(errors)
