"""What the report draws of several views: one repeat of one variant, everything in the board's true frame, millimetres.

Board frame: x along the row of holes, y up the face, z out of the face to the camera; the undamaged face is z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PlacedView:
    """One view as different methods place it.

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
    """One merged cloud with what was found in it, of one variant.

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
    placed: tuple[PlacedView, ...]
    is_variation: bool = False
