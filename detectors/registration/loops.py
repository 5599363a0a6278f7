"""How consistent registrations are where no truth is known: around loops of three views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from detectors.registration.failure import moved_m
from detectors.registration.register import check_views, register_one
from detectors.registration.registered import Registration
from detectors.registration.sampling import thinned
from detectors.registration.settings import AnyRegistration
from detectors.views import PreparedView
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import invert

LOOP_POINTS = 500
"""Of the first view's target, over which a loop's error is averaged."""


@dataclass(frozen=True)
class LoopError:
    """What is left after going around three views, each step registered by itself.

    ``views``: names, in the order of the walk. ``rotation_deg``: of the composed transform; ``translation_m``: root
    mean square way that it moves the first view's target. NaN where a step failed, and ``failure`` says which and why.
    """

    views: tuple[str, str, str]
    rotation_deg: float
    translation_m: float
    failure: str = ""


def loop_errors(views: Sequence[PreparedView], config: AnyRegistration, most: int = 40) -> tuple[LoopError, ...]:
    """Errors around loops i -> j -> k -> i of views, evenly taken from all of them where there are more than ``most``.

    Every pair is registered directly, with the guess that those of both views imply. The errors of the three steps add,
    so a loop shows about sqrt(3) of one; an error that a view brings into both of its registrations alike is not seen.
    Empty for fewer than three views. Raises UserError as `register` does, and for methods that do not register pairs.
    """
    if config.method in ("nominal", "joint", "odometry"):
        raise UserError(
            f"loops cannot be closed with {config.method}: it does not register pairs of views by themselves",
            legal="icp, cpd, marks",
        )
    check_views(views, config)
    loops = list(combinations(range(len(views)), 3))
    loops = loops[:: max(1, -(-len(loops) // most))]
    sides = sorted({pair for i, j, k in loops for pair in ((i, j), (j, k), (i, k))})
    placed = {(i, j): register_one(views[i], views[j], config) for i, j in sides}
    return tuple(_around(views, loop, placed) for loop in loops)


def _around(
    views: Sequence[PreparedView], loop: tuple[int, int, int], placed: dict[tuple[int, int], Registration]
) -> LoopError:
    i, j, k = loop
    names = (views[i].view.name, views[j].view.name, views[k].view.name)
    failures = [
        f"{views[b].view.name} to {views[a].view.name}: {placed[a, b].failure}"
        for a, b in ((i, j), (j, k), (i, k))
        if placed[a, b].failure
    ]
    if failures:
        return LoopError(names, float("nan"), float("nan"), "; ".join(failures))
    T_ij, T_jk, T_ik = (placed[side].T_reference_view for side in ((i, j), (j, k), (i, k)))
    closed = T_ij @ T_jk @ invert(T_ik)
    turn = np.rad2deg(np.linalg.norm(closed[:3, :3] - np.eye(3)) / np.sqrt(2))
    return LoopError(names, float(turn), moved_m(closed, thinned(views[i].points_m, LOOP_POINTS)))
