"""The thesis' measure of a detection: its extents in x and y, and their centre."""

from __future__ import annotations

import math

import numba
import numpy as np

from detectors.interface import Detection, Measurement
from detectors.pixels.clusters import PLAIN
from harness.vocabulary.geometry import Cloud


def extents(points_m: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the thesis' size and centre (3,) of a cluster (n, 3), metres. The size is the mean of
    the distances between the two extreme points in x and between those in y; the centre is the
    mean of these four. Of equals, the first counts."""
    ends = _extremes(points_m, np.zeros(len(points_m), np.int64), 1)[0]
    west, east, north, south = points_m[ends]
    diameter = 0.5 * (math.dist(east, west) + math.dist(south, north))
    return diameter, (west + east + north + south) / 4.0


def centres_of(
    points_m: np.ndarray,
    labels: np.ndarray,
    count: int,
) -> np.ndarray:
    """Return the centres (count, 3) by `extents` of clusters of points (n, 3). ``labels`` (n,): -1
    for no cluster."""
    return points_m[_extremes(points_m, labels, count)].mean(axis=1)


@numba.njit(**PLAIN)
def _extremes(
    points: np.ndarray,
    labels: np.ndarray,
    count: int,
) -> np.ndarray:
    """Return the indices (count, 4) of each cluster's points with the least and greatest x, and
    with the least and greatest y."""
    extremes = np.full((count, 4), -1)
    for i in range(len(labels)):
        if labels[i] < 0:
            continue
        for end in range(4):
            axis = end // 2
            sign = 1.0 if end % 2 else -1.0
            best = extremes[labels[i], end]
            if best < 0 or sign * points[i, axis] > sign * points[best, axis]:
                extremes[labels[i], end] = i
    return extremes


def measure_extents(
    cloud: Cloud,
    detection: Detection,
    note: str,
) -> Measurement:
    """Measure the thesis' extents and the position on the sensor, if any. ``note`` says why
    nothing else is measured."""
    points_m = cloud.points_m.reshape(-1, 3)[detection.pixels]
    diameter_m, centre_m = extents(points_m)
    u = np.nan
    v = np.nan
    if cloud.organised:
        rows, columns = np.unravel_index(detection.pixels, cloud.points_m.shape[:2])
        u = float(columns.mean()) + cloud.region.col0
        v = float(rows.mean()) + cloud.region.row0
    return Measurement(
        u_px=u,
        v_px=v,
        points=len(points_m),
        score=detection.score,
        extent_diameter_m=diameter_m,
        extent_centre_m=centre_m,
        model_note=note,
    )
