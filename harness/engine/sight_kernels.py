"""Compiled passes over a cloud's grid beside the truth: one for all damages, without copies of the grid."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

PLAIN: dict[str, Any] = {"cache": True, "nogil": True}


@numba.njit(**PLAIN)
def highest_within(places_m: np.ndarray, score: np.ndarray, centres_m: np.ndarray, radius_m: float) -> np.ndarray:
    """(n,) the highest of the finite scores (h, w) within a radius of each centre (n, 2); NaN where there is none.

    ``places_m`` (h, w, 2): where each pixel lies, NaN where it lies nowhere.
    """
    highest = np.full(len(centres_m), np.nan)
    for r in range(score.shape[0]):
        for c in range(score.shape[1]):
            if not np.isfinite(score[r, c]):
                continue
            for n in range(len(centres_m)):
                dx = places_m[r, c, 0] - centres_m[n, 0]
                if not abs(dx) <= radius_m:
                    continue
                dy = places_m[r, c, 1] - centres_m[n, 1]
                if np.sqrt(dx * dx + dy * dy) <= radius_m and not score[r, c] <= highest[n]:
                    highest[n] = score[r, c]
    return highest


@numba.njit(**PLAIN)
def pixel_areas(places_m: np.ndarray) -> np.ndarray:
    """(h, w) area that each pixel covers of the plane on which the pixels lie at ``places_m`` (h, w, 2): of the
    parallelogram of the central differences, at the grid's edge of the one-sided ones. NaN beside a pixel that lies
    nowhere; h and w are 2 at least."""
    h, w = places_m.shape[:2]
    areas = np.empty((h, w))
    for r in range(h):
        up, down = max(r - 1, 0), min(r + 1, h - 1)
        for c in range(w):
            left, right = max(c - 1, 0), min(c + 1, w - 1)
            ax = (places_m[r, right, 0] - places_m[r, left, 0]) / (right - left)
            ay = (places_m[r, right, 1] - places_m[r, left, 1]) / (right - left)
            bx = (places_m[down, c, 0] - places_m[up, c, 0]) / (down - up)
            by = (places_m[down, c, 1] - places_m[up, c, 1]) / (down - up)
            areas[r, c] = abs(ax * by - ay * bx)
    return areas
