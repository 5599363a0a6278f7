"""The thesis' merge: all points, those of overlapping views averaged within the boxes of a grid (MATLAB's pcmerge).

Of two clouds exactly that: the overlap of their axis-parallel bounding boxes is divided into boxes from its lowest
corner; each box with points becomes their plain mean, in place and in colour; points beyond the overlap stay as they
are, and colour is dropped where one cloud has none. Of more clouds pcmerge would be called again with the result so
far, which weights a late cloud more; here all go into one grid, over the union of the pairwise overlaps.

At the thesis' 0.1 mm hardly two points share a box: such a merge lays points side by side and averages nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from detectors.mapping.chosen_views import ChosenView
from harness.vocabulary.capture import Cloud
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region

MAX_BOXES = 1 << 21
"""Boxes along one axis: three axes in a 63-bit key."""


def merge_on_grid(views: Sequence[ChosenView], step_m: float) -> Cloud:
    """An unorganised cloud in the first view's frame: boxes in the order of x, then y, then z; then what stayed alone.

    ``count`` is the number of samples of all points of a box and ``variance_m2`` their mean variance (of one frame's z
    in its own camera), so that their quotient is the variance of the point where its pixels err independently.
    ``n_frames`` is that of the view with the fewest: most points are still those of one view.

    Raises UserError where the overlap holds more boxes along an axis than can be numbered.
    """
    clouds = [view.points_reference_m for view in views]
    points, values = np.concatenate(clouds), np.concatenate([_values(view) for view in views])
    shared, corner = _overlap(clouds)
    order, starts = _by_box(points[shared], corner, step_m)
    columns = np.column_stack([points, values, np.ones(len(points))])
    boxes = np.add.reduceat(columns[shared][order], starts, axis=0) if len(starts) else columns[:0]
    return _cloud(views, np.concatenate([boxes, columns[~shared]]))


def _values(view: ChosenView) -> np.ndarray:
    """(n, 6): red, green, blue, amplitude, samples, samples times variance; NaN where unknown."""
    cloud, inside = view.cloud, view.inside
    count = cloud.count[inside].astype(np.float64)
    unknown = np.full(len(count), np.nan)
    colour = [unknown] * 3 if cloud.rgb is None else list(cloud.rgb[inside].T)
    amplitude = unknown if cloud.amplitude is None else cloud.amplitude[inside]
    return np.column_stack([*colour, amplitude, count, count * cloud.variance_m2[inside]])


def _overlap(clouds: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(n,) bool over all points of clouds (n_i, 3): inside the bounding boxes of at least two; the overlap's lowest
    corner (3,)."""
    limits = [(points.min(axis=0), points.max(axis=0)) for points in clouds]
    points = np.concatenate(clouds)
    boxes = np.zeros(len(points), dtype=np.int64)
    for low, high in limits:
        boxes += ((points >= low) & (points <= high)).all(axis=1)
    corner = np.full(3, np.inf)
    for (low_a, high_a), (low_b, high_b) in combinations(limits, 2):
        low, high = np.maximum(low_a, low_b), np.minimum(high_a, high_b)
        if (low <= high).all():
            corner = np.minimum(corner, low)
    shared = boxes > 1
    return shared, corner


def _by_box(points: np.ndarray, corner: np.ndarray, step_m: float) -> tuple[np.ndarray, np.ndarray]:
    """The order that puts points (n, 3) box by box, and where in it each box starts."""
    if len(points) == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    boxes = np.floor((points - corner) / step_m)
    if boxes.max() >= MAX_BOXES:
        raise UserError(
            f"{np.ptp(points, axis=0).max():.3g} m of points hold too many boxes of {step_m * 1e3:.3g} mm",
            legal=f"up to {MAX_BOXES} boxes along an axis",
            fix="crop the views to the target, or raise merge.step_mm",
        )
    x, y, z = boxes.astype(np.int64).T
    keys = (x << 42) | (y << 21) | z
    order = np.argsort(keys, kind="stable")
    return order, np.flatnonzero(np.diff(keys[order], prepend=-1))


def _cloud(views: Sequence[ChosenView], sums: np.ndarray) -> Cloud:
    """Build the cloud from rows of sums (m, 10): points, what `_values` gives, number of points."""
    clouds = [view.cloud for view in views]
    n, samples = sums[:, 9:], sums[:, 7]
    # MATLAB rounds the mean colour
    colour = np.floor(sums[:, 3:6] / n + 0.5)
    return Cloud(
        points_m=(sums[:, :3] / n)[None],
        reason=np.zeros((1, len(sums)), dtype=np.uint8),
        count=np.round(samples).astype(np.int32)[None],
        variance_m2=(sums[:, 8] / samples)[None],
        region=Region(0, 1, 0, len(sums)),
        z_step_m=max(cloud.z_step_m for cloud in clouds),
        n_frames=min(cloud.n_frames for cloud in clouds),
        organised=False,
        rgb=None if any(cloud.rgb is None for cloud in clouds) else colour.astype(np.uint8)[None],
        amplitude=None if any(c.amplitude is None for c in clouds) else (sums[:, 6] / n[:, 0])[None],
        left_out=tuple(left for cloud in clouds for left in cloud.left_out),
    )
