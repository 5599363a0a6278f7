"""Several views of one target: each a cloud in its own camera's frame, the first being the
reference."""

from dataclasses import dataclass

import numpy as np

from detectors.views.marks.mark import MarkSet
from harness.vocabulary.geometry import Cloud


@dataclass(frozen=True)
class View:
    """One view of the target."""

    name: str
    """Name of the view in notes and tables."""
    cloud: Cloud
    """Its cloud, camera frame."""
    T_reference_view_guess: np.ndarray | None
    """(4, 4): rough pose, its camera frame to the first view's; None: unknown."""


@dataclass(frozen=True)
class PreparedView:
    """A view with its target cut out and its marks found."""

    view: View
    inside: np.ndarray
    """(h, w) bool: valid pixels of the target."""
    marks: MarkSet
    """The marks on the target, in doubt or not."""

    @property
    def points_m(self) -> np.ndarray:
        """The target's points (n, 3), camera frame of this view, in the order of the grid."""
        return np.asarray(self.view.cloud.points_m[self.inside])

    @property
    def mark_points_m(self) -> np.ndarray:
        """The fiducial cloud (m, 3): valid points of the fiducial colour."""
        points = self.view.cloud.points_m.reshape(-1, 3)
        return np.asarray(points[self.marks.points])
