"""Several views of one target: each a cloud in its own camera's frame, the first being the
reference."""

from dataclasses import dataclass

import numpy as np

from detectors.views.marks.mark import MarkSet
from harness.vocabulary.geometry import Cloud


@dataclass(frozen=True)
class View:
    """A view. ``T_reference_view_guess`` (4, 4): rough pose, its camera frame to the first view's;
    None: unknown."""

    name: str
    cloud: Cloud
    T_reference_view_guess: np.ndarray | None


@dataclass(frozen=True)
class PreparedView:
    """A view with its target cut out and its marks found. ``inside`` (h, w) bool: valid pixels of
    the target."""

    view: View
    inside: np.ndarray
    marks: MarkSet

    @property
    def points_m(self) -> np.ndarray:
        """The target's points (n, 3), camera frame of this view, in the order of the grid."""
        return np.asarray(self.view.cloud.points_m[self.inside])

    @property
    def mark_points_m(self) -> np.ndarray:
        """The fiducial cloud (m, 3): valid points of the fiducial colour."""
        return np.asarray(self.view.cloud.points_m.reshape(-1, 3)[self.marks.points])
