"""Registration by marks: matched by code or by their mutual distances, placed by weighted least squares.

`detectors.marks.pairing` matches, `detectors.marks.placing` places. Two views of one target disagree by more than the
marks' noise where range or lens are wrong by what the marks of one view do not share; `SHARED_M` allows for that when
it is judged whether the views belong together. The covariance that is given holds the noise, widened where the marks
disagree by more than chance allows (Birge's ratio).
"""

from __future__ import annotations

import numpy as np

from detectors.marks.mark import Mark, off_line_problem
from detectors.marks.pairing import SHARED_M, Pairing, pair_marks
from detectors.marks.placing import Placement, place
from detectors.registration.registered import Registration, failed, guess_of
from detectors.views import PreparedView
from harness.vocabulary.geometry import transform_points
from harness.vocabulary.units import MM

Marks = tuple[Mark, ...]
WIDEN_BELOW = 0.01
"""Chance of marks that disagree so much by their noise alone, below which the covariance is widened."""
REFUSE_BELOW = 1e-4
"""The same with `SHARED_M` for each mark and axis allowed for, below which the views do not fit."""


def register_by_marks(reference: PreparedView, view: PreparedView) -> Registration:
    """Return the pose of a view relative to the reference, from their trusted marks. ``overlap`` stays NaN.

    ``covariance`` is the closed form of the weighted fit. Never raises for the content of the views: too few marks,
    marks on a line, marks that fit nowhere, in several ways, or badly, are its ``failure``; the transform is then the
    best known, or else the guess, or else the identity.
    """
    from scipy.special import gammaincc

    guess = guess_of(reference, view)
    problem = _problem_of_sets(reference, view)
    if problem:
        return failed(view, "marks", guess, problem)
    pairing = pair_marks(reference.marks.trusted, view.marks.trusted, guess)
    notes = pairing.notes
    if len(pairing.pairs) < 3:
        return failed(view, "marks", guess, pairing.problem, *notes)
    ours, theirs = _matched(reference, view, pairing)
    problem = pairing.problem or off_line_problem(ours) or off_line_problem(theirs)
    try:
        placement = _placed(ours, theirs, 0.0)
    except np.linalg.LinAlgError:
        return failed(view, "marks", guess, problem or "the matched marks do not determine the rotation")
    freedom = 3 * len(ours) - 6
    residual = float(np.sqrt((placement.residuals_m**2).sum(axis=1).mean()))
    if not problem and gammaincc(freedom / 2, _placed(ours, theirs, SHARED_M).chi2 / 2) < REFUSE_BELOW:
        problem = (
            f"the marks do not fit: {residual / MM:.1f} mm left over {len(ours)} marks, more than noise and"
            f" {SHARED_M / MM:.0f} mm of each view's own error explain; other targets, or a mark that moved"
        )
    covariance = placement.covariance
    if gammaincc(freedom / 2, placement.chi2 / 2) < WIDEN_BELOW:
        ratio = float(np.sqrt(placement.chi2 / freedom))
        covariance = covariance * ratio**2
        notes += (f"the marks disagree by {ratio:.1f} times their noise; the covariance is widened to match",)
    return Registration(
        view=view.view.name,
        method="marks",
        T_reference_view=placement.T_to_from,
        covariance=covariance,
        centre_m=placement.centre_m,
        residual_m=residual,
        pairs=len(ours),
        iterations=placement.iterations,
        converged=placement.converged,
        failure=problem,
        notes=notes,
    )


def held_out_error_m(reference: PreparedView, view: PreparedView) -> float | None:
    """Root mean square distance between each matched mark and where the registration by the others puts it, metres.

    None where fewer than four marks match, or where leaving one out leaves the rest on a line.
    """
    if _problem_of_sets(reference, view):
        return None
    pairing = pair_marks(reference.marks.trusted, view.marks.trusted, guess_of(reference, view))
    if pairing.problem or len(pairing.pairs) < 4:
        return None
    ours, theirs = _matched(reference, view, pairing)
    squares = []
    for left_out in range(len(ours)):
        kept = [i for i in range(len(ours)) if i != left_out]
        our_rest, their_rest = tuple(ours[i] for i in kept), tuple(theirs[i] for i in kept)
        if off_line_problem(our_rest):
            return None
        T_reference_view = _placed(our_rest, their_rest, 0.0).T_to_from
        miss = transform_points(T_reference_view, theirs[left_out].centre_m) - ours[left_out].centre_m
        squares.append(float(miss @ miss))
    return float(np.sqrt(np.mean(squares)))


def _problem_of_sets(reference: PreparedView, view: PreparedView) -> str:
    return "; ".join(f"{each.view.name}: {each.marks.problem}" for each in (reference, view) if each.marks.problem)


def _matched(reference: PreparedView, view: PreparedView, pairing: Pairing) -> tuple[Marks, Marks]:
    ours, theirs = reference.marks.trusted, view.marks.trusted
    return tuple(ours[i] for i, _ in pairing.pairs), tuple(theirs[j] for _, j in pairing.pairs)


def _placed(ours: Marks, theirs: Marks, shared_m: float) -> Placement:
    """Place the view's marks on the reference's, with ``shared_m`` added to the error of each axis of each mark."""
    extra = shared_m**2 * np.eye(3)
    our_places, their_places = (np.stack([mark.centre_m for mark in marks]) for marks in (ours, theirs))
    our_spread, their_spread = (np.stack([mark.covariance_m2 for mark in marks]) for marks in (ours, theirs))
    return place(their_places, their_spread + extra, our_places, our_spread + extra)
