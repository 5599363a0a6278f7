"""What a fiducial mark is to a registration: a place in the view's frame, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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
