"""How well a registered view agrees with the reference, measured on the two targets themselves, whatever the method."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from detectors.average import CORRELATED_PIXELS
from detectors.registration.sampling import MEDIAN_TO_SIGMA, Sampling, local_normals, sampling_of, thinned
from detectors.views import PreparedView
from harness.vocabulary.geometry import transform_points

TRIMMED = 0.9
"""Share of the fiducial points, the nearest ones, that must agree: a colour rule lets stray pixels through."""


@dataclass(frozen=True)
class Agreement:
    """``beside`` and ``overlap``: share of the view's target points beside which the reference has a point within a
    pitch along the surface, at any distance across it, and at no more than a pitch (or three sigma of noise) across.
    ``apart_m``: robust root mean square distance across the surfaces where they lie beside each other, and
    ``apart_points`` how many that rests on. ``marks_apart_m``: root mean square distance of the fiducial points to the
    nearest of the reference, the farthest tenth left out; NaN where either has fewer than three; ``marks_points`` how
    many they are."""

    beside: float
    overlap: float
    apart_m: float
    apart_points: int
    marks_apart_m: float
    marks_points: int


class ReferenceTarget:
    """The first view's target, made ready for comparisons; all in its camera frame."""

    def __init__(self, view: PreparedView) -> None:
        self.view = view
        self.sampling: Sampling = sampling_of(view)

    @cached_property
    def points_m(self) -> np.ndarray:
        """(n, 3) target points."""
        return self.view.points_m

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points_m)

    @cached_property
    def _mark_tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.view.mark_points_m)

    def nearest(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance (n,) along and (n,) across the surface, signed, from points (n, 3) to the nearest target point; the
        surface there is the plane through the target's 25 nearest points."""
        count = min(CORRELATED_PIXELS, len(self.points_m))
        near = self.points_m[self._tree.query(points_m, k=count)[1]].reshape(len(points_m), count, 3)
        normals = local_normals(near)
        normals *= np.where(normals @ self.sampling.normal < 0, -1.0, 1.0)[:, None]
        across = np.einsum("ni,ni->n", points_m - near.mean(axis=1), normals)
        foot = points_m - across[:, None] * normals
        return np.linalg.norm(foot - near[:, 0], axis=1), across

    def compare(self, view: PreparedView, sampling: Sampling, T_reference_view: np.ndarray) -> Agreement:
        """How a view placed by ``T_reference_view`` agrees with this target."""
        if len(self.points_m) < 3 or not view.inside.any():
            return Agreement(0.0, 0.0, float("nan"), 0, float("nan"), 0)
        along, across = self.nearest(transform_points(T_reference_view, thinned(view.points_m)))
        pitch = max(self.sampling.pitch_m, sampling.pitch_m)
        noise = np.hypot(self.sampling.noise_m, sampling.noise_m)
        beside = along <= pitch
        together = beside & (np.abs(across) <= max(pitch, 3 * noise))
        apart = float(np.median(np.abs(across[beside]))) * MEDIAN_TO_SIGMA if beside.any() else float("nan")
        fiducial = transform_points(T_reference_view, view.mark_points_m)
        marks = self._marks_apart(fiducial)
        return Agreement(float(beside.mean()), float(together.mean()), apart, int(beside.sum()), marks, len(fiducial))

    def _marks_apart(self, points_m: np.ndarray) -> float:
        if len(points_m) < 3 or len(self.view.mark_points_m) < 3:
            return float("nan")
        distances = np.sort(self._mark_tree.query(points_m)[0])[: max(int(TRIMMED * len(points_m)), 1)]
        return float(np.sqrt(np.mean(distances**2)))
