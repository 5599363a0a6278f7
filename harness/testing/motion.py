"""A detector sees surfaces, not coordinates: what it finds moves with the cloud and is the same otherwise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from harness.testing.contract import Look, Make, no_crash, require
from harness.vocabulary.capture import Cloud, MapViews
from harness.vocabulary.geometry import Region, transform_points
from harness.vocabulary.lens import Lens

SCORE_TOLERANCE = 0.01
"""Share of the highest score: robust fits stop at a tolerance of their own; sums in another order round otherwise."""
CROP_TOLERANCE = 0.01
"""Share of the pixels: a crop may come to another decision at the target's rim."""
PLACE_TOLERANCE_M = 1e-4
SHIFT_M = 0.037
QUARTER_TURN = np.array([[0.0, 1.0, 0, 0], [-1.0, 0.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
"""T_turned_cloud: what `numpy.rot90` makes of a picture with x right and y down."""


def turns_with_the_cloud(make: Make, cloud: Cloud) -> None:
    """The camera turned about its optical axis by 90 and by 180 degrees, grid and lens with it."""
    look = Look.at(make(), cloud)
    pixels = np.arange(cloud.valid.size).reshape(cloud.valid.shape)
    turned, T_turned_cloud = cloud, np.eye(4)
    for degrees in (90, 180):
        turned, pixels, T_turned_cloud = turned_once(turned), _grid_turned(cloud, pixels), QUARTER_TURN @ T_turned_cloud
        _compare(look, Look.at(make(), turned), pixels, T_turned_cloud, f"turned by {degrees} degrees")


def moves_with_the_cloud(make: Make, cloud: Cloud) -> None:
    """The cloud moved away by 37 mm along its axis, as a map (whose grid samples space in parallel) can be."""
    base = replace(cloud, projection="parallel", lens=None, map_views=None)
    step = cloud.z_step_m
    shift = np.eye(4)
    shift[2, 3] = round(SHIFT_M / step) * step if step > 0 else SHIFT_M
    moved = replace(base, points_m=transform_points(shift, base.points_m))
    pixels = np.arange(cloud.valid.size).reshape(cloud.valid.shape)
    _compare(Look.at(make(), base), Look.at(make(), moved), pixels, shift, f"moved by {1e3 * shift[2, 3]:.0f} mm")


def turned_once(cloud: Cloud) -> Cloud:
    """The cloud that the same camera gives when it is turned by 90 degrees about its optical axis."""
    names = ("reason", "count", "variance_m2", "rgb", "amplitude", "mean_variance_m2")
    images = {name: getattr(cloud, name) for name in names}
    turned = {name: _grid_turned(cloud, image) for name, image in images.items() if image is not None}
    turned["points_m"] = _grid_turned(cloud, transform_points(QUARTER_TURN, cloud.points_m))
    lens, region, views = cloud.lens, cloud.region, cloud.map_views
    if cloud.organised:
        width = lens.width if lens is not None else region.col1
        region = Region(width - region.col1, width - region.col0, region.row0, region.row1)
    if lens is not None:
        k1, k2, p1, p2, *further = lens.distortion
        distortion = (k1, k2, -p2, p1, *further)
        lens = Lens(lens.height, lens.width, lens.fy, lens.fx, lens.cy, lens.width - 1 - lens.cx, distortion)
    if views is not None:
        views = MapViews(QUARTER_TURN @ views.T_cloud_cameras, views.shares, views.pixel_m[::-1])
    more: dict[str, Any] = {"lens": lens if cloud.organised else None, "map_views": views, "region": region, **turned}
    return replace(cloud, **more)


def _grid_turned(cloud: Cloud, image: np.ndarray) -> np.ndarray:
    """A cloud without a grid keeps the order of its points."""
    return np.ascontiguousarray(np.rot90(image)) if cloud.organised else image


def _compare(before: Look, after: Look, pixels: np.ndarray, T_after_before: np.ndarray, how: str) -> None:
    """Compare scores and findings; ``pixels`` (h, w): of each pixel afterwards, its flat index before."""
    was, now = before.evidence.score.reshape(-1)[pixels], after.evidence.score
    changed = int((np.isfinite(was) != np.isfinite(now)).sum())
    require(changed <= CROP_TOLERANCE * now.size, f"{how}, {changed} of {now.size} pixels gained or lost their score")
    tolerance = SCORE_TOLERANCE * max(float(np.nanmax(was)), 1e-12)
    difference = float(np.nanmax(np.abs(was - now)))
    require(difference <= tolerance, f"{how}, a score changed by {difference:g} (allowed {tolerance:g})")
    quiet = abs(before.quiet - after.quiet)
    require(quiet <= tolerance, f"{how}, the quiet threshold changed by {quiet:g} (allowed {tolerance:g})")

    # findings in the middle of the widest gap between scores from a fifth of the quiet threshold to it; where none is
    # wider than the tolerance on both sides, a tolerable change of a score can change findings
    scores = np.unique(before.evidence.score[np.isfinite(before.evidence.score)])
    scores = scores[(scores >= 0.2 * before.quiet) & (scores <= before.quiet)]
    if len(scores) < 2:
        return
    widest = int(np.argmax(np.diff(scores)))
    low, high = scores[widest], scores[widest + 1]
    if high - low > 2 * tolerance:
        _compare_findings(before, after, float(low + high) / 2, pixels.reshape(-1), T_after_before, how)


def _compare_findings(
    before: Look, after: Look, threshold: float, flat: np.ndarray, T_after_before: np.ndarray, how: str
) -> None:
    was = {frozenset(finding.pixels.tolist()): finding for finding in before.find(threshold)}
    now = {frozenset(flat[finding.pixels].tolist()): finding for finding in after.find(threshold)}
    there, lost = len(was), len(was.keys() - now.keys())
    require(was.keys() == now.keys(), f"{how}, {lost} of {there} findings have other pixels, and there are {len(now)}")
    for key, finding in was.items():
        moved_to = transform_points(T_after_before, finding.centre_m)
        apart = float(np.linalg.norm(np.asarray(moved_to) - np.asarray(now[key].centre_m)))
        require(apart <= PLACE_TOLERANCE_M, f"{how}, a finding's centre lies {1e3 * apart:.2f} mm off")
        with no_crash("`measure`"):
            sizes = [
                float(look.detector.measure(look.cloud, look.evidence, found).extent_diameter_m)
                for look, found in ((before, finding), (after, now[key]))
            ]
        grown = abs(sizes[1] - sizes[0])
        require(grown <= PLACE_TOLERANCE_M, f"{how}, a finding's extent changed by {1e3 * grown:.2f} mm")
