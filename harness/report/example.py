"""An averaged cloud kept for the report's pictures, with the truth on the same pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.evaluation.profile import HoleInView

__all__ = ["ExampleCloud", "HoleInView"]


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
