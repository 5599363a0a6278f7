"""What the methods that work on points start from, and how they say that they could not."""

from __future__ import annotations

from time import perf_counter
from typing import Literal

import numpy as np

from detectors.registration.registered import Registration
from detectors.views import PreparedView
from harness.vocabulary.geometry import invert

NO_GUESS = "no guess: started from the reference's own place"


def cloud_of(view: PreparedView, points: Literal["marks", "target"]) -> np.ndarray:
    """(n, 3) the fiducial cloud or the whole target, camera frame of the view."""
    return view.mark_points_m if points == "marks" else view.points_m


def guess_of(reference: PreparedView, view: PreparedView) -> np.ndarray | None:
    """``T_reference_view`` (4, 4) as far as the guesses of both tell; the reference need not be the first view."""
    ours, theirs = reference.view.T_reference_view_guess, view.view.T_reference_view_guess
    return None if ours is None or theirs is None else invert(ours) @ theirs


def unplaced(
    view: str, method: str, T_reference_view: np.ndarray | None, failure: str, started: float, *notes: str
) -> Registration:
    """A registration that found nothing: it stands at its guess, or at the reference's place, with no covariance."""
    place = np.eye(4) if T_reference_view is None else T_reference_view
    nan, nothing = float("nan"), np.full((6, 6), np.nan)
    spent = perf_counter() - started
    return Registration(view, method, place, nothing, np.zeros(3), nan, nan, 0, 0, False, spent, failure, notes)
