"""Pictures of trials as plain records: what the jobs that draw them return and what pages show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Where = Literal["below", "at", "above"]
"""The size of a damage compared with the detection limit."""
CircleKind = Literal["found", "missed", "finding", "false call"]
"""The first two are true damages, the last two are findings."""

# ---------------------------------------------------------------- a cloud on its pixel grid


@dataclass(frozen=True)
class HoleInView:
    """The true place of one round damage on the cloud's pixel grid."""

    hole: str
    """Number of the damage."""
    u_px: float
    """Column of its centre; 0 is the centre of the first pixel."""
    v_px: float
    """Row of its centre; 0 is the centre of the first pixel."""
    radius_px: float
    """Radius of its outline."""
    diameter_mm: float
    """True diameter."""
    depth_mm: float
    """True depth; NaN or infinite without a floor."""


@dataclass(frozen=True)
class ExampleCloud:
    """One averaged cloud of one variant, on its pixel grid (h, w)."""

    frames: int
    """Number of averaged frames."""
    variant: str
    """Name of the set-up or variation."""
    residual_mm: np.ndarray
    """(h, w): distance behind (+) or before (-) the fitted surface, NaN if unknown."""
    detected: np.ndarray
    """(h, w) bool: pixels of the detector's clusters."""
    inside: np.ndarray
    """(h, w) bool: pixels of the crop."""
    truth: tuple[HoleInView, ...]
    """The true holes."""
    z_truth_mm: np.ndarray
    """(h, w): true z on each pixel's central ray, NaN where it meets nothing."""


# ---------------------------------------------------------------- one damage of a study


@dataclass(frozen=True, eq=False)
class StudyExample:
    """A crop (h, w) of a run's pixel grid around a damage."""

    variant: str
    """Name of the set-up."""
    frames: int
    """Number of averaged frames."""
    board: int
    """Number of the board."""
    hole: str
    """Number of the damage on the board."""
    where: Where
    """The damage's size compared with the set-up's limit."""
    diameter_mm: float
    """True diameter."""
    depth_mm: float
    """True depth."""
    pod: float
    """Probability of detection by the curve at that size; NaN without a curve."""
    hit: bool
    """True if the damage was found."""
    score: float
    """Highest score on the damage, in the threshold's unit; NaN if no pixel there was judged."""
    threshold: float
    """The run's threshold."""
    residual_mm: np.ndarray
    """(h, w): distance behind (+) or before (-) the fitted surface, NaN if unknown."""
    detected: np.ndarray
    """(h, w) bool: pixels of the detector's clusters."""
    outline_px: np.ndarray
    """(k, 2): the true rim as (column, row) from the first pixel."""
    pitch_mm: float
    """Width of a pixel on the board."""


# ---------------------------------------------------------------- a cloud that can be turned


@dataclass(frozen=True)
class Circle3d:
    """A damage or a finding, as a ring in a scene."""

    centre_mm: np.ndarray
    """(3,): centre in the scene's frame."""
    normal: np.ndarray
    """(3,): unit vector across the ring, in the scene's frame."""
    diameter_mm: float
    """Diameter; a finding's is by the thesis' measure."""
    label: str
    """Text beside the ring."""
    kind: CircleKind
    """The marked thing; decides the ring's colour."""


@dataclass(frozen=True)
class Scene3d:
    """A cloud to turn in the browser."""

    points_mm: np.ndarray
    """(n, 3): the points in the scene's frame."""
    frame: Literal["board", "camera"]
    """The frame: "board" has x right, y up, z to the viewer; "camera" has x right, y down, z away.
    """
    rgb: np.ndarray | None = None
    """(n, 3) uint8: colours of the points."""
    residual_mm: np.ndarray | None = None
    """(n,): distance behind (+) or before (-) the fitted surface, NaN if not judged."""
    view_of: np.ndarray | None = None
    """(n,): index into ``view_names``, or -1 for several views."""
    view_names: tuple[str, ...] = ()
    """Names of the merged views."""
    detected: np.ndarray | None = None
    """(n,) bool: points of findings."""
    circles: tuple[Circle3d, ...] = ()
    """Rings at the damages and findings."""
    facts: tuple[tuple[str, str], ...] = ()
    """(name, value) of what stands beside the picture."""
    shown: str = "camera's colours"
    """Meaning of ``rgb``."""
    key: tuple[tuple[str, str], ...] = ()
    """(words, colour) that explain ``rgb``."""


@dataclass(frozen=True)
class MappedExample:
    """A merged cloud of a variant with the true holes and the findings, in the board's true
    frame."""

    variant: str
    """Name of the set-up or variation."""
    frames: int
    """Number of averaged frames of each view."""
    views: int
    """Number of views."""
    registration: str
    """Method of registering the views."""
    merge: str
    """Method of merging the views."""
    scene: Scene3d
    """The cloud with its rings."""
    is_variation: bool = False
    """True if the variant is a variation of a set-up."""
