"""Finds what departs from a profile no more than the profile's own steps are uncertain.

A camera's pixels meet a groove that is hardly wider than they are, or a rib's edge, here on one
side and there on the other, by where their grid lies. Along the step, this changes slowly: a row of
pixels departs alike, so that a filter which averages over them as over noise finds slots. Such an
error is one number for the whole row, and what it explains is no evidence of damage.

Not modelled: damage within a step that is no deeper than this; it remains unseen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from detectors.interface import Detection
from detectors.pixels.masks import grown

MOSTLY = 0.5  # share of what departs that lies beside uncertain pixels
SIGMAS = 3.0  # of the profile's own deviation that it explains


def explained_by_steps(
    spread_m: np.ndarray,
    residual_m: np.ndarray,
    detections: Sequence[Detection],
    threshold: float,
) -> tuple[int, ...]:
    """Return the numbers of the findings by depth, but joints, that lie mostly at or beside
    uncertain pixels of a profile, and on these depart by no more than `SIGMAS` of its own deviation
    on average. As one error, and not one of each pixel, makes a score larger by up to the root of
    the number of these pixels, what exceeds the ``threshold`` by more is not explained.

    Args:
        spread_m: (h, w), standard deviation of the surface itself; 0 or NaN where it is certain.
        residual_m: (h, w), z minus the surface.
        detections: the findings."""
    own_m = np.nan_to_num(spread_m).ravel()
    if not own_m.any():
        return ()
    is_beside = grown(own_m.reshape(spread_m.shape) > 0, 1).ravel()
    explained = []
    for number, detection in enumerate(detections):
        if detection.kind != "depth" or detection.count > 1:
            continue
        residuals_m = residual_m.ravel()[detection.pixels]
        departing_m = residuals_m * np.sign(residuals_m.sum())
        beside = is_beside[detection.pixels]
        own = own_m[detection.pixels]
        if departing_m[beside].sum() < MOSTLY * departing_m.sum() or not own.any():
            continue
        if detection.score > threshold * np.sqrt(np.count_nonzero(own)):
            continue
        deviation_m = float(np.sqrt((own[own > 0] ** 2).mean()))
        if departing_m[own > 0].mean() <= SIGMAS * deviation_m:
            explained.append(number)
    return tuple(explained)
