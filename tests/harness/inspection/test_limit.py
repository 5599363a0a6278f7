"""The sizes that would have been missed: discs pressed into a cloud by hand-computable geometry,
and a detector whose limit is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from detectors.interface import Detection, Evidence, Measurement
from harness.inspection.limit import (
    APART_PX,
    Disc,
    SizeCount,
    fitted,
    found_at,
    free_area,
    limit_of,
    next_step,
    places_for,
    pressed_in,
)
from harness.report.findings import Judged
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud
from tests.support.plain_clouds import cloud_of_points

PITCH_M = 0.002
SHAPE = (120, 160)


def plane_cloud(slope: float = 0.0, reach_px: float = 0.0) -> Cloud:
    """A plane at 1 m with pixels of 2 mm in the middle; z grows by ``slope`` a metre in x."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    across = (u - 79.5) * PITCH_M
    down = (v - 59.5) * PITCH_M
    z = 1.0 / (1 - slope * across)
    points = np.stack([across * z, down * z, z], axis=-1)
    return cloud_of_points(points, noise_reach_px=reach_px)


@dataclass(frozen=True)
class WidthDetector:
    """Finds everything behind the plane of which at least ``least_px`` pixels are half as deep as
    its deepest."""

    slope: float = 0.0
    least_px: int = 1
    name: str = "width"
    version: int = 1

    def analyse(self, cloud: Cloud) -> Evidence:
        surface_z_m = 1.0 / (1 - self.slope * cloud.points_m[..., 0] / cloud.points_m[..., 2])
        residual_m = cloud.points_m[..., 2] - surface_z_m
        return Evidence(residual_m / 1e-3, residual_m, surface_z_m, 1e-3)

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        from scipy import ndimage

        scores = np.nan_to_num(evidence.score)
        labels, count = ndimage.label(scores >= threshold)
        detections = []
        for number in range(1, count + 1):
            pixels = np.flatnonzero(labels.ravel() == number)
            if len(pixels) >= self.least_px:
                detections.append(
                    Detection(float(scores.ravel()[pixels].max()), pixels, np.zeros(3))
                )
        return tuple(detections)

    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        return 0.0

    def measure(self, cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
        raise NotImplementedError


def judged_of(detector: Any, cloud: Cloud, pixels: np.ndarray | None = None) -> Judged:
    detections: tuple[Detection, ...] = ()
    if pixels is not None:
        detections = (Detection(9.0, pixels, np.zeros(3)),)
    return Judged(cloud, detector.analyse(cloud), detections, ())


@pytest.mark.parametrize("slope", [0.0, 1.0])
def test_a_disc_is_as_deep_across_the_surface_as_it_says_and_as_wide(slope: float) -> None:
    detector = WidthDetector(slope)
    cloud = plane_cloud(slope)
    centre = 60 * SHAPE[1] + 70
    disc = Disc(diameter_m=0.03, depth_m=0.004)
    pressed, (floor,) = pressed_in(judged_of(detector, cloud), np.array([centre]), disc)
    normal = np.array([-slope, 0.0, 1.0]) / math.sqrt(1 + slope**2)
    moved = pressed.points_m - cloud.points_m
    depth_m = moved @ normal
    assert depth_m.ravel()[centre] == pytest.approx(0.004, rel=1e-3)
    # points stay on their rays
    rays = cloud.points_m / cloud.points_m[..., 2:]
    np.testing.assert_allclose(moved, rays * moved[..., 2:], atol=1e-12)
    # a pixel sees sqrt(1 + slope^2) z^2 times as much of the surface as in the middle of the image
    seen_m2 = PITCH_M**2 * cloud.points_m[..., 2].ravel()[centre] ** 2 * math.sqrt(1 + slope**2)
    if slope:
        seen_m2 *= cloud.points_m[..., 2].ravel()[centre]
    assert len(floor) * seen_m2 == pytest.approx(math.pi * 0.015**2, rel=0.06)


def test_the_filter_blurs_the_rim_and_leaves_the_volume() -> None:
    disc = Disc(diameter_m=0.03, depth_m=0.004)
    volumes = []
    for reach_px in (0.0, 5.0):
        cloud = plane_cloud(reach_px=reach_px)
        judged = judged_of(WidthDetector(), cloud)
        pressed, _ = pressed_in(judged, np.array([60 * SHAPE[1] + 70]), disc)
        moved_m = (pressed.points_m - cloud.points_m)[..., 2]
        volumes.append(moved_m.sum())
        steepest_m = np.abs(np.diff(moved_m, axis=1)).max()
        assert steepest_m == pytest.approx(0.004 / max(reach_px, 1.0), rel=0.1)
    assert volumes[1] == pytest.approx(volumes[0], rel=1e-6)


def test_centres_lie_apart_from_one_another_from_the_rim_and_from_findings() -> None:
    finding = (50 + np.arange(10))[:, None] * SHAPE[1] + np.arange(70, 80)
    judged = judged_of(WidthDetector(), plane_cloud(), finding.ravel())

    disc = Disc(diameter_m=0.02, depth_m=0.004)
    centres = places_for(judged, free_area(judged), disc)
    rows, columns = np.divmod(centres, SHAPE[1])
    assert len(centres) >= 4
    distances_px = np.hypot(rows[:, None] - rows, columns[:, None] - columns)
    assert distances_px[np.triu_indices(len(centres), 1)].min() >= 10 + APART_PX
    assert rows.min() >= 5 and columns.min() >= 5
    assert rows.max() <= SHAPE[0] - 6 and columns.max() <= SHAPE[1] - 6
    from_finding = np.hypot(rows[:, None] - 54.5, columns[:, None] - 74.5)
    assert from_finding.min() > 5 + 5 + APART_PX / 2 - 2
    assert (centres == places_for(judged, free_area(judged), disc)).all()


def test_the_limit_is_the_detectors_own() -> None:
    """Discs of 4 mm depth and at least 80 pixels, which are 10.1 pixels or 20.2 mm wide."""
    judged = judged_of(WidthDetector(), plane_cloud())
    limit = limit_of(WidthDetector(least_px=80), judged, threshold=2.0, depth_m=0.004)
    assert limit.a90_mm == pytest.approx(20.2, rel=0.2)
    assert limit.bound_mm > limit.a90_mm
    shares = [size.hits / size.places for size in limit.sizes]
    assert shares[0] == 0.0 and shares[-1] == 1.0
    widths = [size.diameter_mm for size in limit.sizes]
    assert widths == sorted(widths) and {size.depth_mm for size in limit.sizes} == {4.0}
    assert limit.text.startswith("damage 4 mm deep is found in 90 % of places from ")
    assert limit.facts["sizes"][0]["hits"] == 0


def test_discs_that_uncertain_steps_explain_are_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in an inspection, where such findings are left out."""
    detector = WidthDetector()
    result = judged_of(detector, plane_cloud())
    size = {"diameter_m": 0.02, "depth_m": 0.004}
    count = found_at(detector, result, 1.0, **size)
    assert count is not None
    assert count.hits == count.places > 10

    def all_but_the_first(
        cloud: Cloud, evidence: Evidence, detections: tuple[Detection, ...], threshold: float
    ) -> tuple[int, ...]:
        assert evidence.score.shape == cloud.valid.shape
        assert threshold == 1.0
        return tuple(range(1, len(detections)))

    monkeypatch.setattr("harness.inspection.limit.at_steps", all_but_the_first)
    explained = found_at(detector, result, 1.0, **size)
    assert explained is not None
    # one in each of the clouds that together have as many places
    assert 0 < explained.hits < count.hits / 2
    assert explained.places == count.places


def test_without_a_depth_discs_are_half_as_deep_as_wide() -> None:
    judged = judged_of(WidthDetector(), plane_cloud())
    limit = limit_of(WidthDetector(), judged, threshold=1e-6)
    assert all(size.depth_mm == pytest.approx(size.diameter_mm / 2) for size in limit.sizes)
    assert limit.text.startswith("all implanted damage half as deep as wide was found, down to 2.")
    nothing = limit_of(WidthDetector(), judged, threshold=1e6)
    assert nothing.text.startswith("no implanted damage half as deep as wide was found, up to ")
    assert math.isnan(nothing.a90_mm)


def test_a_limit_beyond_the_largest_disc_is_not_stated() -> None:
    sizes = [
        SizeCount(diameter_mm=10.0, depth_mm=1.0, hits=2, places=40, low=0.0, high=0.2),
        SizeCount(diameter_mm=20.0, depth_mm=1.0, hits=20, places=40, low=0.3, high=0.7),
    ]
    text = fitted(sizes, 1e-3).text
    assert text.startswith("damage 1 mm deep is not found in 90 % of places up to 20 mm wide")


def test_points_without_a_grid_and_areas_without_room_are_refused() -> None:
    judged = judged_of(WidthDetector(), plane_cloud())
    with pytest.raises(UserError, match="grid of pixels"):
        limit_of(WidthDetector(), replace(judged, cloud=replace(judged.cloud, organised=False)), 2)
    everywhere = judged_of(WidthDetector(), plane_cloud(), np.arange(SHAPE[0] * SHAPE[1]))
    with pytest.raises(UserError, match="no room for a disc"):
        limit_of(WidthDetector(), everywhere, 2.0)


def test_sizes_go_down_until_few_are_found_and_up_until_nearly_all_are() -> None:
    def size(hits: int) -> SizeCount:
        return SizeCount(diameter_mm=1.0, depth_mm=1.0, hits=hits, places=40, low=0.0, high=1.0)

    assert next_step({0: size(40)}) == -1
    assert next_step({0: size(10)}) == 1
    assert next_step({-1: size(10), 0: size(39)}) == 1
    # one mixed size determines no curve: sizes between what is missed and what is found
    assert next_step({-1: size(10), 0: size(40)}) == -0.5
    assert next_step({-1: size(10), -0.5: size(40), 0: size(40)}) == -0.75
    assert next_step({-1: size(10), -0.5: size(20), 0: size(40)}) is None
    assert next_step({-1: size(10), -0.85: size(40)}) is None
    # 4 pixels / 1.4^4 = 1.04 is the smallest size of a pixel and more
    assert next_step({-3: size(40)}) == -4
    assert next_step({-4: size(40)}) is None


def test_the_curve_is_over_the_logarithm_of_the_width() -> None:
    """Hits of 1, 5 and 9 in 10 at 5, 10 and 20 mm: a logistic curve with odds of 1 at 10 mm and of
    9 at 20 mm, by symmetry of the logarithms."""
    sizes = []
    for diameter_mm, hits in ((5.0, 1), (10.0, 5), (20.0, 9)):
        sizes.append(
            SizeCount(
                diameter_mm=diameter_mm, depth_mm=1.0, hits=hits, places=10, low=0.0, high=1.0
            )
        )
    assert fitted(sizes, 1e-3).a90_mm == pytest.approx(20.0, rel=1e-6)
