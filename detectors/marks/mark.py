"""A fiducial mark as a registration sees it: a position in the view's frame, with its covariance; and the marks that
suffice for a registration: three or more, trusted, and not on a line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.vocabulary.units import MM

LEAST_MARKS = 3
OFF_LINE_SIGMAS = 5.0
"""Marks lie on a line where their root mean square distance from it is less than so many standard deviations of one
mark's place: the turn about the line would be wrong by a fifth of a radian."""
OFF_LINE_SHARE = 0.02
"""... or less than this part of their root mean square distance along it: each millimetre that a view is wrong at a
mark would become 50 mm at the same distance across the line."""


@dataclass(frozen=True)
class Mark:
    """One mark in one view, camera frame, metres.

    ``centre_m`` (3,): its centroid on the surface. ``covariance_m2`` (3, 3): of that centroid; systematic errors that
    all pixels of the mark share (a range offset, a distortion of the lens) are not in it. ``normal`` (3,): unit normal
    of the surface there, towards the camera. ``pixels`` (n,): flat indices into the cloud's grid. ``area_m2``: on the
    surface. ``code``: of a coded mark its identity, None of a piece of tape. ``doubt``: why it should not be relied on
    (cut by the crop's edge, no range in parts of it, a shape unlike the others); empty for none.
    """

    centre_m: np.ndarray
    covariance_m2: np.ndarray
    normal: np.ndarray
    pixels: np.ndarray
    area_m2: float
    code: int | None = None
    doubt: str = ""


@dataclass(frozen=True)
class MarkSet:
    """All marks of one view. ``points`` (n,): flat indices of every pixel of the fiducial colour within the crop, the
    thesis' fiducial cloud, marks or not. ``problem``: why no registration can rest on these marks (too few, on a line),
    with what is missing; empty where one can. ``notes``: what else a user should know."""

    marks: tuple[Mark, ...]
    points: np.ndarray
    problem: str = ""
    notes: tuple[str, ...] = ()

    @property
    def trusted(self) -> tuple[Mark, ...]:
        """The marks without a doubt."""
        return tuple(mark for mark in self.marks if not mark.doubt)


def problem_of(marks: Sequence[Mark], missing: str = "") -> str:
    """Return the reason why no registration can rest on these marks, else empty. ``missing`` says why there are not
    more."""
    trusted = [mark for mark in marks if not mark.doubt]
    doubtful = [mark for mark in marks if mark.doubt]
    if len(trusted) < LEAST_MARKS:
        found = f"{len(trusted)} {'mark' if len(trusted) == 1 else 'marks'} found, {LEAST_MARKS} needed"
        counted = sorted(Counter(mark.doubt for mark in doubtful).items())
        each = "; ".join(doubt if n == 1 else f"{doubt} ({n} times)" for doubt, n in counted)
        doubts = f"; {len(doubtful)} more in doubt: {each}" if doubtful else ""
        return found + doubts + (f"; {missing}" if missing else "")
    return off_line_problem(trusted)


def off_line_problem(marks: Sequence[Mark]) -> str:
    """Return the problem that the marks lie on a line, with their distance from it, else empty."""
    places = np.stack([mark.centre_m for mark in marks])
    sizes = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) / np.sqrt(len(marks))
    error = float(np.sqrt(np.mean([np.linalg.eigvalsh(mark.covariance_m2)[-1] for mark in marks])))
    if sizes[1] >= max(OFF_LINE_SIGMAS * error, OFF_LINE_SHARE * sizes[0]):
        return ""
    return (
        f"the {len(marks)} marks lie on a line, {sizes[1] / MM:.1f} mm off it, which leaves the turn about it open;"
        " a mark beside the line is missing"
    )
