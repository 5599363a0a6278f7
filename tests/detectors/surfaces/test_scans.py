"""Captures as references: a part is placed on them, with errors as large as stated, and what is
expected of it is the surface that was recorded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from detectors import load_detector
from detectors.surfaces import expected
from detectors.surfaces.expected import KnownPose
from detectors.surfaces.scans import _scatter, good_parts, laid_under, placed, scan_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, invert, transform_points
from tests.support import made_parts
from tests.support.made_parts import MadePart, cloud_of, depth_m, pose

TURNED = pose((4.0, -3.0, 5.0), (4.0, -3.0))
EARLIER, EARLIER_MASK = cloud_of(MadePart(), pose(), seed=1)
SCAN = scan_of(EARLIER, EARLIER_MASK, "earlier")
T_EARLIER_NOW = pose() @ invert(TURNED)


def test_a_part_is_placed_within_the_stated_error() -> None:
    cloud, mask = cloud_of(MadePart(), TURNED, seed=2)
    pose = placed(SCAN, cloud.points_m[mask], 1.0, True, None)
    middle_m = transform_points(invert(T_EARLIER_NOW), pose.middle_m)
    error_m = transform_points(pose.T_part_camera, middle_m) - pose.middle_m
    stated_m = np.sqrt(np.diag(pose.covariance))[3:]
    assert (np.abs(error_m) < 4 * stated_m).all()
    # a hundredth of a pixel along the plate, less than a tenth of the noise across it
    assert (stated_m[:2] < 0.02 * MM).all() and stated_m[2] < 0.004 * MM
    assert (stated_m > 0.001 * MM).all()


def test_a_part_upside_down_is_found() -> None:
    cloud, mask = cloud_of(MadePart(), pose((2.0, 1.0, 178.0)), seed=2)
    laid = laid_under(SCAN, cloud, mask)
    assert laid.facts["median_off_mm"] < 0.15


def test_a_part_turned_far_is_found() -> None:
    """From the chosen start, 150 points find the part, and 4,000 do not."""
    turned = pose((-6.0, 5.0, 75.0), (4.0, -3.0))
    cloud, mask = cloud_of(MadePart(), turned, seed=2)
    points_m = cloud.points_m[mask]
    placed_m = transform_points(placed(SCAN, points_m, 1.0, True, None).T_part_camera, points_m)
    true_m = transform_points(pose() @ invert(turned), points_m)
    assert np.linalg.norm(placed_m - true_m, axis=1).max() < 0.1 * MM


def test_what_is_expected_is_what_was_recorded() -> None:
    cloud, mask = cloud_of(MadePart(), TURNED, seed=2)
    laid = laid_under(SCAN, cloud, mask)
    points_m = cloud.points_m[mask]
    off_m = laid.z_at(points_m) - depth_m(MadePart(), TURNED)[mask]
    spread_m = laid.spread_at(points_m)
    assert np.nanmedian(spread_m) == pytest.approx(0.12 * MM, rel=0.15)
    total_m = np.hypot(spread_m, laid.registration_at(points_m))
    # between three corners, noise is less than theirs; walls of ribs are covered as well
    assert 1.0 < np.nanquantile(np.abs(off_m / total_m), 0.95) < 2.0
    assert np.nanmax(np.abs(off_m)) > 1.0 * MM
    assert np.nanquantile(np.abs(off_m / total_m), 0.997) < 3.0


def test_a_flat_plate_is_known_to_a_pixel_along_itself() -> None:
    flat = MadePart(has_ribs=False)
    earlier, mask = cloud_of(flat, pose(), seed=3)
    cloud, now = cloud_of(flat, TURNED, seed=4)
    by_outline = placed(scan_of(earlier, mask, "flat"), cloud.points_m[now], 1.0, True, None)
    stated_m = np.sqrt(np.diag(by_outline.covariance))[3:]
    pixel_m = made_parts.DISTANCE_M / made_parts.LENS.fx
    assert stated_m[:2] == pytest.approx([pixel_m] * 2, rel=0.2)
    assert stated_m[2] < 0.005 * MM


def test_marks_place_what_the_surface_does_not() -> None:
    flat = MadePart(has_ribs=False)
    earlier, mask = cloud_of(flat, pose(), seed=3)
    cloud, now = cloud_of(flat, TURNED, seed=4)
    covariance = np.diag([1e-3**2] * 3 + [(0.1 * MM) ** 2] * 3)
    marks = KnownPose(T_EARLIER_NOW, covariance, earlier.points_m[mask].mean(axis=0))
    by_marks = placed(scan_of(earlier, mask, "flat"), cloud.points_m[now], 1.0, True, marks)
    stated_m = np.sqrt(np.diag(by_marks.covariance))[3:]
    assert stated_m[:2] == pytest.approx([0.1 * MM] * 2, rel=0.1)
    assert stated_m[2] < 0.005 * MM  # by the surface
    shift_m = (by_marks.T_part_camera @ invert(T_EARLIER_NOW))[:3, 3]
    assert np.abs(shift_m).max() < 0.2 * MM


def test_pixels_that_share_their_noise_place_a_part_less_well() -> None:
    """Of nine pixels that share their noise, one counts."""
    cloud, mask = cloud_of(MadePart(), TURNED, seed=2)
    points_m = cloud.points_m[mask]
    alone_m = laid_under(SCAN, cloud, mask).registration_at(points_m)
    shared = replace(cloud, noise_reach_px=3.0)
    shared_m = laid_under(SCAN, shared, mask).registration_at(points_m)
    assert np.nanmedian(shared_m / alone_m) == pytest.approx(3.0, rel=0.1)


def test_the_scatter_of_a_place_is_drawn_towards_that_of_all_places() -> None:
    """Two parts beyond the first differ by 1 mm, but in a block of 9 x 9 places not at all. In its
    middle, the usual scatter counts like three further parts."""
    rows, columns = np.mgrid[:30, :30]
    rays = 0.01 * np.column_stack([rows.ravel(), columns.ravel()])
    is_equal = ((np.abs(rows - 15) <= 4) & (np.abs(columns - 15) <= 4)).ravel()
    squares_m2 = np.where(is_equal, 0.0, 2.0 * MM**2)
    variance_m2 = _scatter(rays, squares_m2, np.full(900, 2.0)).reshape(30, 30)
    typical_mm2 = 1 - 81 / 900
    assert variance_m2[15, 15] / MM**2 == pytest.approx(3 / 5 * typical_mm2)
    assert variance_m2[5, 5] / MM**2 == pytest.approx((2 + 3 * typical_mm2) / 5)


def test_good_parts_state_where_parts_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expected, "SAMPLE", 1000)  # places parts a little less well, in a third
    rng = np.random.default_rng(5)
    ribs_mm = rng.normal(0.0, 0.5, 8)
    scans = []
    for number, rib_mm in enumerate(ribs_mm):
        T = pose(tuple(rng.uniform(-3, 3, 3)), tuple(rng.uniform(-3, 3, 2)))
        cloud, mask = cloud_of(MadePart(rib_mm=rib_mm), T, seed=10 + number)
        scans.append(scan_of(cloud, mask, f"part {number}"))
    parts = good_parts(scans[0], [(scan, None) for scan in scans[1:]], central=True)
    mean = parts.mean("the parts")
    cloud, mask = cloud_of(MadePart(), pose(), seed=30)
    laid = laid_under(mean, cloud, mask)
    x_m, y_m = (cloud.points_m[mask] - pose()[:3, 3]).T[:2]
    on_rib = (np.abs(x_m + 0.045) < 0.002) & (np.abs(y_m) < 0.025)
    on_face = (np.abs(x_m - 0.0) < 0.015) & (np.abs(y_m) < 0.015)
    spread_m = laid.spread_at(cloud.points_m[mask])
    true_m = float(ribs_mm.std(ddof=1)) * MM
    assert np.nanmedian(spread_m[on_rib]) == pytest.approx(true_m * np.sqrt(1 + 1 / 8), rel=0.2)
    # the mean of eight averages, and less than one of them would have
    assert 0.12 / np.sqrt(8) * 0.8 < np.nanmedian(spread_m[on_face]) / MM < 0.12
    left_out = parts.mean("the others", left_out=0)
    assert (mean.parts, left_out.parts) == (8, 7)


def test_a_placement_on_good_parts_has_converged() -> None:
    scans = []
    for number, roll_deg in enumerate((0.0, 15.0, -30.0)):
        part = MadePart(bend_mm=0.3 * (number - 2), rib_mm=0.15 * (number - 1))
        cloud, mask = cloud_of(part, pose((number - 2.0, 1.0, roll_deg)), seed=10 + number)
        scans.append(scan_of(cloud, mask, f"part {number}"))
    mean = good_parts(scans[0], [(scan, None) for scan in scans[1:]], central=True).mean("parts")
    cloud, mask = cloud_of(MadePart(), TURNED, seed=2)
    points_m = cloud.points_m[mask]
    once = placed(mean, points_m, 1.0, True, None)
    again = expected.refined(mean.triangles, once, expected.sampled(points_m), central=True)
    moved_m = transform_points(again.T_part_camera, points_m)
    moved_m -= transform_points(once.T_part_camera, points_m)
    # less than a hundredth of a pixel, 1.5 mm
    assert np.linalg.norm(moved_m, axis=1).max() < 0.01 * MM


def test_mistakes_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    # an arched part is searched for in all orientations: few points show that it fits in none
    monkeypatch.setattr(expected, "SAMPLE", 600)
    flat, mask = cloud_of(MadePart(has_ribs=False), pose(), seed=7)
    arched, arched_mask = cloud_of(MadePart(has_ribs=False, bend_mm=20.0), pose(), seed=7)
    with pytest.raises(UserError, match="is not this part: after the best placement 80 % of it"):
        laid_under(SCAN, arched, arched_mask)
    with pytest.raises(UserError, match="part 1: is not like earlier"):
        arched_scan = scan_of(arched, arched_mask, "part 1")
        good_parts(SCAN, [(arched_scan, None)], central=True)
    corner = mask.copy()
    corner[:, 90:] = False
    corner[72:] = False
    with pytest.raises(UserError, match=r"corner: shows \d+ % of the part"):
        laid_under(scan_of(flat, corner, "corner"), flat, mask)
    line = np.zeros_like(mask)
    line[60, 26:123] = True
    small_mask = np.zeros_like(mask)
    small_mask[60:63, 60:100] = True
    for seen_part in (line, small_mask):
        with pytest.raises(UserError, match=r"piece: \d+ points of the part span no surface"):
            scan_of(flat, seen_part, "piece")
    in_metres = replace(EARLIER, points_m=1e3 * EARLIER.points_m)
    with pytest.raises(UserError, match=r"metres: is 1\.7\d*e\+05 mm large, and this part 17\d mm"):
        laid_under(scan_of(in_metres, EARLIER_MASK, "metres"), flat, mask)
    detector = load_detector("local", {"crop": {"kind": "none"}, "surface": {"shape": "expected"}})
    with pytest.raises(UserError, match="the cloud has none"):
        detector.analyse(flat)
