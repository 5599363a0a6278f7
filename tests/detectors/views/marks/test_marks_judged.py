"""Limits at which spots count as marks, holes, stains or parts of the target, and a blob's colour
and error, on plain pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from detectors.views.marks.blobs import (
    RING_PX,
    SHARE_SIGMA,
    Blob,
    _evenly_lit,
    find_blobs,
    region_covariance_px2,
)
from detectors.views.marks.find import (
    CORNER_PX,
    Patch,
    Spot,
    _coded_mark,
    _mark,
    _marks,
    fit_patch,
    place_spot,
)
from detectors.views.marks.mark import MarkSet
from harness.vocabulary.geometry import MM, Cloud, Lens
from tests.support.plain_clouds import cloud_of_points

LENS = Lens(200, 160, 500.0, 500.0, 99.5, 79.5)
V, U = np.mgrid[: LENS.height, : LENS.width]
BOARD = 60
"""Grey value of the board."""


def pictured(rgb: np.ndarray, tilt: float = 0.0) -> Cloud:
    """A plane z = 0.7 + tilt x without noise."""
    slopes = LENS.region_slopes(LENS.whole)
    z_m = 0.7 / (1.0 - tilt * slopes[..., 0])
    points_m = np.concatenate([slopes * z_m[..., None], z_m[..., None]], axis=-1)
    return cloud_of_points(points_m, lens=LENS, rgb=np.clip(np.rint(rgb), 0, 255).astype(np.uint8))


def plain_board() -> np.ndarray:
    return np.full((LENS.height, LENS.width, 3), float(BOARD))


def within(u: float, v: float, width: float, height: float) -> np.ndarray:
    """Pixels of a rectangle around (u, v)."""
    return (np.abs(U - u) < width / 2) & (np.abs(V - v) < height / 2)


def marks_of(spots: list[tuple[np.ndarray, np.ndarray]]) -> MarkSet:
    """The marks of spots (mask, logarithm of the colour over the board's) on the board."""
    rgb = plain_board()
    coloured = np.zeros(rgb.shape[:2], bool)
    for mask, contrast in spots:
        # a count is added to both colours
        rgb[mask] = (BOARD + 1.0) * np.exp(contrast) - 1.0
        coloured |= mask
    cloud = pictured(rgb)
    return _marks(cloud, cloud.valid, coloured, "")


FOUR = [(40, 40), (160, 40), (40, 120), (160, 120)]
RED = np.array([1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("other", "is_same"),
    [
        (np.array([0.69, 0.0, 0.0]), True),
        (np.array([0.61, 0.0, 0.0]), False),
        (np.array([1.31, 0.0, 0.0]), True),
        (np.array([1.39, 0.0, 0.0]), False),
        (np.array([1.0, -0.31, 0.0]), True),
        (np.array([1.0, 0.0, 0.39]), False),
    ],
)
def test_spots_whose_contrasts_differ_by_less_than_a_third_have_one_colour(other, is_same) -> None:
    """The limit is 0.35 of the first one's contrast; a lone spot of another colour is in doubt."""
    spots = [(within(u, v, 24, 16), RED) for u, v in FOUR]
    spots.append((within(100, 80, 20, 12), other))
    marks = marks_of(spots)
    assert len(marks.marks) == 5
    doubts = [mark.doubt for mark in marks.marks if mark.doubt]
    if is_same:
        assert doubts == []
    else:
        assert doubts == ["fewer than 3 marks have its colour; enough have another"]


@pytest.mark.parametrize(("contrast", "is_weak"), [(0.31, True), (0.36, False)])
def test_spots_with_a_third_of_the_strongest_contrast_are_no_stains(contrast, is_weak) -> None:
    spots = [(within(u, v, 24, 16), RED) for u, v in FOUR]
    weak = np.array([0.0, 0.0, contrast])
    spots += [(within(u, v, 20, 12), weak) for u, v in ((100, 20), (100, 140), (70, 80))]
    marks = marks_of(spots)
    doubts = [mark.doubt for mark in marks.marks if mark.doubt]
    expected = ["its colour contrast is weak compared with the others"] * 3
    assert doubts == (expected if is_weak else [])
    assert len(marks.trusted) == (4 if is_weak else 7)


def test_two_spots_of_a_weak_colour_are_no_measure_for_the_others() -> None:
    """Two vivid spots are too few marks, beside which others are not weak."""
    spots = [(within(u, v, 24, 16), np.array([0.4, 0.0, 0.0])) for u, v in FOUR]
    spots += [(within(u, v, 20, 12), np.array([0.0, 1.4, 0.0])) for u, v in ((100, 20), (100, 140))]
    marks = marks_of(spots)
    assert len(marks.trusted) == 4
    doubts = [mark.doubt for mark in marks.marks if mark.doubt]
    assert len(doubts) == 2
    assert all("fewer than 3" in doubt for doubt in doubts)


@pytest.mark.parametrize(("hole", "is_kept"), [((36, 23), True), ((44, 33), False)])
def test_a_colour_most_of_whose_area_lies_behind_is_that_of_holes(hole, is_kept) -> None:
    """Four flat spots of 1092 pixels in all, and a hole of the same colour, 10 mm deep, with 43 or
    57 % of their area."""
    flat = [within(u, v, 22, 14) for u, v in FOUR]
    deep = within(100, 80, *hole)
    rgb = plain_board()
    coloured = np.zeros(deep.shape, bool)
    for mask in (*flat, deep):
        rgb[mask] = (200.0, 60.0, 60.0)
        coloured |= mask
    cloud = pictured(rgb)
    points = cloud.points_m.copy()
    points[deep] *= 0.71 / 0.7
    marks = _marks(replace(cloud, points_m=points), cloud.valid, coloured, "")
    assert len(marks.marks) == (4 if is_kept else 0)
    count = 1 if is_kept else 5
    assert marks.notes == (
        f"{count} spots of another colour lie behind the surface and count as holes, not marks",
    )


BLOB = Blob(
    pixels=np.arange(300),
    weights=np.r_[np.ones(250), np.full(50, 0.4)],
    grid=np.zeros((300, 2)),
    grid_covariance=np.eye(2),
    surroundings=np.arange(400),
    contrast=RED,
)
SPOT = Spot(
    blob=BLOB,
    centre_m=np.array([0.1, 0.2, 0.7]),
    covariance_m2=np.diag([1.0, 2.0, 3.0]) * 1e-8,
    normal=np.array([0.0, 0.0, -1.0]),
    area_m2=4e-4,
    sizes_m=np.array([0.040, 0.012, 0.011]),
    pitch_m=1e-3,
    behind_m=0.0,
    behind_sigma_m=1e-5,
)


@pytest.mark.parametrize(
    ("behind_mm", "sigma_mm", "is_hole"),
    [
        (1.9, 0.01, False),
        (2.1, 0.01, True),
        (-30.0, 0.01, False),
        # five deviations, if they are more
        (4.9, 1.0, False),
        (5.1, 1.0, True),
    ],
)
def test_a_spot_behind_the_surface_is_a_hole(behind_mm, sigma_mm, is_hole) -> None:
    spot = replace(SPOT, behind_m=behind_mm * MM, behind_sigma_m=sigma_mm * MM)
    assert spot.is_hole == is_hole


@pytest.mark.parametrize(
    ("behind_mm", "sigma_mm", "is_raised"),
    [
        (-2.9, 0.01, False),  # a quarter of the breadth of 12 mm
        (-3.1, 0.01, True),
        (-4.9, 1.0, False),
        (-5.1, 1.0, True),
        (9.0, 0.01, False),
    ],
)
def test_a_spot_far_in_front_of_the_surface_is_in_doubt(behind_mm, sigma_mm, is_raised) -> None:
    spot = replace(SPOT, behind_m=behind_mm * MM, behind_sigma_m=sigma_mm * MM)
    mark = _mark(spot, None, 10_000)
    assert ("in front of the surface" in mark.doubt) == is_raised
    if is_raised:
        assert mark.doubt == f"it stands {-behind_mm:.0f} mm in front of the surface"


@pytest.mark.parametrize(
    ("change_mm", "is_unlike"),
    [
        # 30 % of 40, 12 and 11 mm and 1.5 pixels: 13.5, 5.1 and 4.8 mm
        ((13.4, 0.0, 0.0), False),
        ((-13.4, 5.0, -4.7), False),
        ((13.6, 0.0, 0.0), True),
        ((-13.6, 0.0, 0.0), True),
        ((0.0, 5.2, 0.0), True),
        ((0.0, 0.0, -4.9), True),
    ],
)
def test_a_spot_of_another_size_is_unlike_the_others(change_mm, is_unlike) -> None:
    usual_m = SPOT.sizes_m
    spot = replace(SPOT, sizes_m=usual_m + np.array(change_mm) * MM)
    mark = _mark(spot, usual_m, 10_000)
    assert bool(mark.doubt) == is_unlike
    if is_unlike:
        length, breadth, _ = spot.sizes_m / MM
        stated = f"{length:.0f} x {breadth:.0f} mm, not 40 x 12"
        assert mark.doubt == f"unlike the others: {stated}"
    assert _mark(spot, None, 10_000).doubt == ""


@pytest.mark.parametrize(("target", "is_part"), [(1680, False), (1650, True)])
def test_a_large_spot_is_a_part_of_the_target(target, is_part) -> None:
    """250 pixels with more than half of its colour are 15 % of 1667."""
    mark = _mark(SPOT, None, target)
    assert mark.doubt == ("15 % of the target: a part of it rather than a mark" if is_part else "")
    np.testing.assert_array_equal(mark.pixels, np.arange(250))
    np.testing.assert_array_equal(mark.centre_m, SPOT.centre_m)
    np.testing.assert_array_equal(mark.covariance_m2, SPOT.covariance_m2)
    np.testing.assert_array_equal(mark.normal, SPOT.normal)
    assert mark.area_m2 == SPOT.area_m2
    cut = replace(SPOT, blob=replace(BLOB, doubt="cut by the crop's edge"))
    assert _mark(cut, None, target).doubt == "cut by the crop's edge"


# --- blobs ---


@pytest.mark.parametrize("pattern", ["none", "checkerboard", "halves"])
def test_the_error_of_a_blob_with_mixed_rims_has_its_rim_and_the_strays_around(pattern) -> None:
    """A red rectangle of 40 x 24 pixels whose rim is 45 % red. Far around it, the board's red
    differs by 5 % of the mark's: from pixel to pixel it counts once, together in all 25 pixels of
    a square 25 times in the square."""
    red = np.zeros(V.shape)
    if pattern == "checkerboard":
        red += np.where((U + V) % 2 == 0, 0.05, -0.05)
    elif pattern == "halves":
        # two sides brighter, two darker: no slope of the light
        red += np.where(np.abs(U - 99.5) / 26 > np.abs(V - 79.5) / 18, 0.05, -0.05)
    red[within(99.5, 79.5, 40 + 10, 24 + 10)] = 0.0
    red[within(99.5, 79.5, 42, 26)] = 0.45
    core = within(99.5, 79.5, 40, 24)
    red[core] = 1.0
    rgb = plain_board()
    rgb[..., 0] += 100.0 * red
    cloud = pictured(rgb)
    (blob,) = find_blobs(cloud, cloud.valid, core)
    square = np.ones((3, 3), bool)
    outer = ndimage.binary_dilation(core, square)
    rim = outer & ~ndimage.binary_erosion(core, square)
    far = np.ones((2 * RING_PX + 1, 2 * RING_PX + 1), bool)
    ring = ndimage.binary_dilation(core, far) & ~within(99.5, 79.5, 40 + 8, 24 + 8)
    backdrop = np.median(red[ring])
    stray = red - backdrop
    wide = ndimage.uniform_filter(stray, 5)
    strays = np.sqrt(max(np.mean(stray[ring] ** 2), 25.0 * np.mean(wide[ring] ** 2)))
    area_px = 40 * 24 + 0.45 * (2 * (40 + 24) + 4)
    arms = np.argwhere(rim)[:, ::-1] - [99.5, 79.5]
    expected = (SHARE_SIGMA**2 + strays**2) * arms.T @ arms / area_px**2
    if pattern == "none":
        assert blob.weights.sum() == pytest.approx(area_px, rel=1e-9)
        np.testing.assert_allclose(blob.grid_covariance, expected, rtol=1e-9, atol=1e-15)
        contrast = [np.log((BOARD + 101.0) / (BOARD + 1.0)), 0.0, 0.0]
        np.testing.assert_allclose(blob.contrast, contrast, atol=1e-9)
        positions = np.stack([blob.pixels % LENS.width, blob.pixels // LENS.width], axis=1)
        np.testing.assert_allclose(
            positions - blob.grid, (positions - blob.grid)[0] + 0 * positions
        )
        np.testing.assert_array_equal(
            np.sort(blob.pixels[blob.weights > 1e-9]), np.flatnonzero(outer)
        )
    else:
        assert strays > 0.02
        np.testing.assert_allclose(blob.grid_covariance, expected, rtol=0.05, atol=1e-6)
    assert blob.doubt == ""


def test_a_blob_with_sharp_rims_has_the_error_of_its_lattice() -> None:
    mark = within(99.5, 79.5, 31, 12)
    rgb = plain_board()
    rgb[mark] = (200.0, 30.0, 90.0)
    cloud = pictured(rgb)
    (blob,) = find_blobs(cloud, cloud.valid, mark)
    np.testing.assert_array_equal(np.sort(blob.pixels), np.flatnonzero(mark))
    assert (blob.weights == 1.0).all()
    rows, columns = np.nonzero(mark)
    expected = region_covariance_px2(np.stack([columns, rows], axis=1).astype(float))
    np.testing.assert_allclose(blob.grid_covariance, expected, rtol=1e-6, atol=1e-9)
    contrast = np.log(np.array([201.0, 31.0, 91.0]) / (BOARD + 1.0))
    np.testing.assert_allclose(blob.contrast, contrast, atol=1e-9)


def test_groups_are_sorted_by_size_and_small_ones_are_none() -> None:
    rgb = plain_board()
    coloured = np.zeros(V.shape, bool)
    for u, side in ((30, 3), (70, 2), (110, 9), (160, 6)):
        spot = (u <= U) & (u + side > U) & (V >= 80) & (80 + side > V)
        rgb[spot] = (200.0, 30.0, 90.0)
        coloured |= spot
    cloud = pictured(rgb)
    blobs = find_blobs(cloud, cloud.valid, coloured)
    assert [len(blob.pixels) for blob in blobs] == [81, 36, 9]


@pytest.mark.parametrize("slope", [(0.4, 0.0), (0.0, -0.3), (0.2, 0.15)])
def test_uneven_light_is_taken_out_of_the_colours(slope) -> None:
    """Colours under a light that changes along a plane are those under the light at the group's
    middle."""
    group = within(70.0, 60.0, 41, 21)
    ring = within(70.0, 60.0, 61, 41) & ~within(70.0, 60.0, 49, 29)
    colours = np.where(group[..., None], [50.0, 90.0, 20.0], [100.0, 80.0, 40.0])
    light = 1.0 + slope[0] * (U - 70.0) / 100.0 + slope[1] * (V - 60.0) / 100.0
    window = np.s_[20:120, 10:150]
    lit = colours * light[..., None]
    even = _evenly_lit(lit[window], ring[window], group[window])
    blob = within(70.0, 60.0, 61, 41)[window]
    np.testing.assert_allclose(even[blob], colours[window][blob], rtol=1e-9)


def test_light_is_taken_to_change_by_a_factor_of_two_at_most() -> None:
    group = within(100.0, 80.0, 21, 21)
    ring = within(100.0, 80.0, 41, 41) & ~within(100.0, 80.0, 29, 29)
    light = 1.0 + 0.02 * (U - 100.0)
    colours = np.full((*V.shape, 3), 100.0) * light[..., None]
    even = _evenly_lit(colours, ring, group)
    expected = 100.0 * light / np.clip(light, 0.5, 2.0)
    np.testing.assert_allclose(even[..., 0], expected, rtol=1e-9, atol=1e-9)


# --- places ---


def test_the_patch_of_points_states_their_mean_and_scatter() -> None:
    random = np.random.default_rng(1)
    x, y = random.uniform(-0.05, 0.05, (2, 400))
    off = np.tile([1.0, -1.0, 2.0, -2.0], 100) * 1e-4
    points = np.stack([x, y, 0.8 - 0.2 * x + 0.1 * y + off], axis=1)
    points[:20, 2] += 0.05  # points behind shift the plane, but do not count for its offset
    patch = fit_patch(points)
    assert patch is not None
    assert (patch.slope_x, patch.slope_y) == pytest.approx((-0.2, 0.1), abs=2e-3)
    above = patch.above_m(points)[20:]
    assert above.mean() == pytest.approx(0.0, abs=1e-12)
    assert patch.sigma_m == pytest.approx(above.std(), rel=1e-9)
    assert patch.sigma_m == pytest.approx(np.sqrt(2.5) * 1e-4, rel=0.05)


@pytest.mark.parametrize("tilt", [0.0, 0.4, -0.3])
def test_a_spot_has_the_place_area_and_sides_of_its_rectangle(tilt: float) -> None:
    """On a tilted plane, 2 mm behind its surroundings: the centroid of the surface under the
    pixels, its area, and the sides of a rectangle with the same second moments."""
    mark = within(130.5, 60.0, 30, 17)
    cloud = pictured(plain_board(), tilt)
    points = cloud.points_m.copy()
    shifted = 0.002 / (1.0 - tilt * LENS.region_slopes(LENS.whole)[..., 0])
    points[mark] *= (1.0 + shifted / points[..., 2])[mark][:, None]
    cloud = replace(cloud, points_m=points, variance_m2=np.full(V.shape, 4e-8))
    rows, columns = np.nonzero(mark)
    pixels = np.flatnonzero(mark)
    blob = replace(
        BLOB,
        pixels=pixels,
        weights=np.ones(len(pixels)),
        grid=np.stack([columns, rows], axis=1).astype(float),
        grid_covariance=np.diag([0.04, 0.09]),
    )
    patch = Patch(slope_x=tilt, slope_y=0.0, offset_m=0.7, sigma_m=1e-3)
    spot = place_spot(cloud, blob, patch)
    assert spot.behind_m == pytest.approx(0.002, rel=1e-9)
    assert spot.behind_sigma_m == pytest.approx(1e-3 * np.sqrt(2 * 25 / len(pixels)))
    # fine samples over the pixels' area, weighted by the surface that each covers
    fine = (np.arange(10) + 0.5) / 10 - 0.5
    du, dv = np.meshgrid(fine, fine)
    u = (columns[:, None] + du.ravel()).ravel()
    v = (rows[:, None] + dv.ravel()).ravel()
    slopes = LENS.slopes(u, v)
    z_m = 0.702 / (1.0 - tilt * slopes[:, 0])
    surface = np.column_stack([slopes * z_m[:, None], z_m])
    steep = np.sqrt(1.0 + tilt**2)
    # dx dy = z^3 / 0.702 du dv / f^2 for z = 0.702 + tilt x
    covered = z_m**3 / 0.702 * steep / (100 * 500.0**2)
    assert spot.area_m2 == pytest.approx(covered.sum(), rel=2e-3)
    np.testing.assert_allclose(
        spot.centre_m, np.average(surface, axis=0, weights=covered), atol=2e-6
    )
    normal = np.array([tilt, 0.0, -1.0]) / steep
    np.testing.assert_allclose(spot.normal, normal, atol=1e-12)
    spread = np.cov(surface.T, aweights=covered, ddof=0)
    sides = np.sqrt(12.0 * np.linalg.eigvalsh(spread)[:0:-1])
    # the second moments are those of the pixels' centres
    np.testing.assert_allclose(spot.sizes_m[:2], sides, rtol=3e-3)
    assert spot.sizes_m[2] == pytest.approx(spot.area_m2 / spot.sizes_m[0])
    assert spot.pitch_m == pytest.approx(np.sqrt(covered.sum() / len(pixels)), rel=2e-3)
    # within the surface by the grid, along the ray by the frames' noise of 0.2 mm
    step_u = LENS.slopes(np.array([131.0, 130.0]), np.array([60.0, 60.0]))
    ray = spot.centre_m / spot.centre_m[2]
    along = ray * normal[2] / (normal @ ray)
    across_m2 = 4e-8 * 25 / len(pixels) * (normal @ along) ** 2
    assert normal @ spot.covariance_m2 @ normal == pytest.approx(across_m2, rel=1e-6)
    pitch_x = (step_u[0, 0] - step_u[1, 0]) * spot.centre_m[2] / (1.0 - tilt * ray[0])
    in_x = 0.04 * pitch_x**2 + 4e-8 * 25 / len(pixels) * along[0] ** 2
    in_y = 0.09 * (spot.centre_m[2] / 500.0) ** 2
    in_y += 0.04 * (pitch_x * tilt * ray[1]) ** 2 + 4e-8 * 25 / len(pixels) * along[1] ** 2
    assert spot.covariance_m2[0, 0] == pytest.approx(in_x, rel=0.02)
    assert spot.covariance_m2[1, 1] == pytest.approx(in_y, rel=0.02)


def test_the_range_error_is_the_largest_of_three_and_shared_by_25_pixels() -> None:
    cloud = pictured(plain_board())
    patch = Patch(slope_x=0.3, slope_y=-0.2, offset_m=0.7, sigma_m=2e-4)
    centre = np.array([0.1, -0.05, 0.74])
    normal = np.array([0.3, -0.2, -1.0]) / np.sqrt(1.13)
    ray = centre / centre[2]
    along = ray * normal[2] / (normal @ ray)
    pixels = np.arange(500, 600)
    by_scatter = patch.range_covariance_m2(centre, cloud, pixels)
    np.testing.assert_allclose(by_scatter, 4e-8 * 0.25 * np.outer(along, along), rtol=1e-12)
    of_few = patch.range_covariance_m2(centre, cloud, pixels[:10])
    np.testing.assert_allclose(of_few, 4e-8 * np.outer(along, along), rtol=1e-12)
    frames = replace(cloud, variance_m2=np.full(V.shape, 5e-7), count=np.full(V.shape, 5))
    by_frames = patch.range_covariance_m2(centre, frames, pixels)
    np.testing.assert_allclose(by_frames, 1e-7 * 0.25 * np.outer(along, along), rtol=1e-12)
    stated = replace(frames, mean_variance_m2=np.full(V.shape, 3e-7))
    by_map = patch.range_covariance_m2(centre, stated, pixels)
    np.testing.assert_allclose(by_map, 3e-7 * 0.25 * np.outer(along, along), rtol=1e-12)
    small = replace(frames, mean_variance_m2=np.full(V.shape, 3e-8))
    np.testing.assert_allclose(patch.range_covariance_m2(centre, small, pixels), by_frames)
    # in a parallel projection rays run along z
    parallel = replace(cloud, projection="parallel")
    by_z = patch.range_covariance_m2(centre, parallel, pixels)
    np.testing.assert_allclose(by_z, np.diag([0.0, 0.0, 4e-8 * 0.25]), atol=1e-20)


def test_a_tag_is_as_certain_as_the_mean_of_its_four_corners() -> None:
    """On a plane at 0.7 m, 500 pixels of focal length: 1.4 mm a pixel."""
    cloud = pictured(np.zeros((LENS.height, LENS.width, 3), np.uint8))
    cloud = replace(cloud, variance_m2=np.full(cloud.valid.shape, 1e-12))
    corners = np.array([[60.0, 50.0], [100.0, 50.0], [100.0, 90.0], [60.0, 90.0]])
    mark = _coded_mark(cloud, cloud.valid, 7, corners, False)
    assert mark is not None
    assert mark.centre_m == pytest.approx([(80 - 99.5) * 1.4e-3, (70 - 79.5) * 1.4e-3, 0.7])
    assert mark.area_m2 == pytest.approx((40 * 1.4e-3) ** 2)
    across_m2 = (1.4e-3 * CORNER_PX) ** 2 / 4
    assert np.diag(mark.covariance_m2)[:2] == pytest.approx([across_m2, across_m2], rel=1e-3)
    assert abs(mark.covariance_m2[0, 1]) < 1e-3 * across_m2
    assert (mark.code, mark.doubt) == (7, "")
