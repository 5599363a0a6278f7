"""Parts of trials kept for the pictures of a report: averaged clouds, merged clouds, single damages of a study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from harness.evaluation.profile import HoleInView

Where = Literal["below", "at", "above"]


@dataclass(frozen=True)
class ExampleCloud:
    """One averaged cloud of one variant, on its pixel grid (h, w).

    ``points_m`` (h, w, 3) float: camera frame, NaN where invalid. ``rgb`` (h, w, 3) uint8. ``residual_mm`` (h, w):
    distance behind (+) or before (-) the fitted surface, NaN where there is none. ``detected`` (h, w) bool: pixels of
    the detector's clusters. ``inside`` (h, w) bool: pixels of the crop that was searched. ``truth``: the holes on it.
    ``z_truth_mm`` (h, w): true z along each pixel's central ray, NaN where it meets nothing. ``outlines_px``: of each
    of ``truth`` the rim as (k, 2) columns and rows on the grid.
    """

    frames: int
    variant: str
    points_m: np.ndarray
    rgb: np.ndarray
    residual_mm: np.ndarray
    detected: np.ndarray
    inside: np.ndarray
    truth: tuple[HoleInView, ...]
    z_truth_mm: np.ndarray
    outlines_px: tuple[np.ndarray, ...] = ()


@dataclass(frozen=True, eq=False)
class StudyExample:
    """A cut-out (h, w) of one run's pixel grid around one damage. ``where``: its size against the set-up's limit.

    ``diameter_mm``, ``depth_mm`` are true; ``pod``: what the curve says of that size. ``score``: the damage's signal,
    NaN where no pixel there was judged; ``threshold`` in the same units. ``residual_mm`` (h, w): distance behind (+) or
    before (-) the fitted surface, NaN where there is none. ``detected`` (h, w) bool: pixels of findings.
    ``outline_px`` (k, 2): the true rim, columns and rows in the cut-out, the centre of its first pixel being (0, 0).
    ``pitch_mm``: a pixel's width at the board.
    """

    variant: str
    frames: int
    board: int
    hole: str
    where: Where
    diameter_mm: float
    depth_mm: float
    pod: float
    hit: bool
    score: float
    threshold: float
    residual_mm: np.ndarray
    detected: np.ndarray
    outline_px: np.ndarray
    pitch_mm: float


@dataclass(frozen=True)
class ShownView:
    """One view as different methods place it. The board's frame is in millimetres: x along the row of holes, y up the
    face, z out of the face to the camera; the undamaged face is z = 0.

    ``points_mm`` (n, 3) and ``rgb`` (n, 3) uint8: the target's points (thinned out), and ``marks_mm`` (m, 3) the
    fiducial cloud, all in this view's own camera frame. ``T_board_view``: by name ("truth", "guess", then methods) the
    4x4 that brings them into the board's frame, translation in mm; where the guess is known and no registration
    failed. ``failures``: by method, why not.
    """

    name: str
    points_mm: np.ndarray
    rgb: np.ndarray
    marks_mm: np.ndarray
    T_board_view: dict[str, np.ndarray]
    failures: dict[str, str]


@dataclass(frozen=True)
class HoleSeen:
    """One hole: its number, centre (x, y), diameter, and whether it was found in this repeat."""

    hole: str
    x_mm: float
    y_mm: float
    diameter_mm: float
    found: bool


@dataclass(frozen=True)
class FindingSeen:
    """One finding: centre (x, y) and diameter by the thesis' measure, its score, and the hole it was matched with ("")
    for a false call."""

    x_mm: float
    y_mm: float
    diameter_mm: float
    score: float
    hole: str


@dataclass(frozen=True)
class MappedExample:
    """One merged cloud of one variant with what was found in it, in the board's true frame, in millimetres.

    ``views``, ``registration``, ``merge``: the set-up in words. ``points_mm`` (k, 3), ``rgb`` (k, 3) uint8,
    ``residual_mm`` (k,) behind (+) or before (-) the fitted surface (NaN where not judged), ``detected`` (k,) bool.
    ``view_of`` (k,): index of the view that a point came from, -1 where it is of several. ``is_variation``: whether
    ``variant`` is the label of a variation.
    """

    variant: str
    frames: int
    views: int
    registration: str
    merge: str
    points_mm: np.ndarray
    rgb: np.ndarray
    residual_mm: np.ndarray
    detected: np.ndarray
    view_of: np.ndarray
    holes: tuple[HoleSeen, ...]
    findings: tuple[FindingSeen, ...]
    placed: tuple[ShownView, ...]
    is_variation: bool = False
