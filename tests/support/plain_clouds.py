"""Clouds of points of which nothing is known but the points."""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.vocabulary.geometry import Cloud, Region


def cloud_of_points(points_m: np.ndarray, **fields: Any) -> Cloud:
    """A cloud of valid points (h, w, 3) of a single frame that is not rounded, but for
    ``fields``."""
    shape = points_m.shape[:2]
    plain: dict[str, Any] = {
        "points_m": points_m,
        "reason": np.zeros(shape, np.uint8),
        "count": np.ones(shape, int),
        "variance_m2": np.full(shape, np.nan),
        "region": Region(0, shape[0], 0, shape[1]),
        "z_step_m": 0.0,
        "n_frames": 1,
    }
    return Cloud(**{**plain, **fields})
