"""Units, transforms, regions and lenses against SciPy, OpenCV and small cases by hand."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from harness.vocabulary import geometry
from harness.vocabulary.geometry import (
    Cloud,
    Lens,
    OtherLens,
    Region,
    invert,
    rays_of,
    rotate_vectors,
    rotation_xyz_deg,
    transform_points,
)

DISTORTION = (0.5, -2.0, 1e-3, -5e-4, 1.2, 0.4, -1.8, 1.1)
LENS = Lens(640, 576, 505.0, 504.0, 322.0, 331.0, DISTORTION)
PLAIN = Lens(640, 480, 500.0, 400.0, 320.0, 240.0)


def pose() -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [10, -20, 30], degrees=True).as_matrix()
    T[:3, 3] = [0.1, -0.2, 0.7]
    return T


def test_units() -> None:
    assert geometry.MM == 0.001
    assert pytest.approx(0.0254) == geometry.INCH
    # 1e-6 W over 1e-4 m2
    assert pytest.approx(1e-6 / 1e-4) == geometry.UW_CM2
    assert geometry.SPEED_OF_LIGHT_VACUUM == 299_792_458.0
    # air slows light by 0.27 per mille
    assert pytest.approx(299_792_458.0 * (1 - 2.7e-4), rel=1e-7) == geometry.SPEED_OF_LIGHT_AIR


def test_transforms_of_points_and_directions() -> None:
    T = pose()
    points = np.random.default_rng(1).standard_normal((4, 5, 3))
    homogeneous = np.concatenate([points, np.ones((4, 5, 1))], axis=-1)
    assert transform_points(T, points) == pytest.approx((homogeneous @ T.T)[..., :3])
    assert rotate_vectors(T, points) == pytest.approx(points @ T[:3, :3].T)
    assert invert(T) == pytest.approx(np.linalg.inv(T))


@pytest.mark.parametrize(
    "angles", [(30.0, 0.0, 0.0), (0.0, 30.0, 0.0), (0.0, 0.0, 30.0), (5.0, -40.0, 70.0)]
)
def test_rotations_are_about_x_first(angles: tuple[float, float, float]) -> None:
    expected = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    assert rotation_xyz_deg(*angles) == pytest.approx(expected)


def test_regions_by_hand() -> None:
    region = Region(10, 30, 5, 45)
    assert region.shape == (20, 40)
    assert region.area == 800
    assert region.grown(3, 100, 100) == Region(7, 33, 2, 48)
    assert region.grown(8, 35, 50) == Region(2, 35, 0, 50)
    assert region.grown(12, 41, 60) == Region(0, 41, 0, 57)
    assert region.joined(Region(20, 25, 40, 60)) == Region(10, 30, 5, 60)
    assert region.joined(Region(2, 50, 7, 9)) == Region(2, 50, 5, 45)
    rows, columns = region.within(Region(8, 40, 1, 60))
    assert (rows, columns) == (slice(2, 22), slice(4, 44))


@pytest.mark.parametrize("lens", [PLAIN, LENS])
def test_slopes_and_pixels_are_inverse(lens: Lens) -> None:
    assert lens.whole == Region(0, lens.height, 0, lens.width)
    u = np.array([[10.0, 320.5, 600.0], [100.0, 200.0, 500.0]])
    v = np.array([[300.0, 240.0, 20.0], [400.0, 100.25, 350.0]])
    slopes = lens.slopes(u, v)
    z_m = np.array([0.5, 1.0, 3.0])
    points = rays_of(slopes) * z_m[:, None]
    assert lens.project(points) == pytest.approx(np.stack([u, v], axis=-1), abs=1e-4)
    unmoved = np.zeros(3)
    by_cv, _ = cv2.projectPoints(
        points.reshape(-1, 1, 3), unmoved, unmoved, lens.matrix, np.array(lens.distortion)
    )
    assert lens.project(points).reshape(-1, 2) == pytest.approx(by_cv[:, 0])


def test_slopes_of_a_plain_lens_by_hand() -> None:
    slopes = PLAIN.slopes(np.array(370.0), np.array(200.0))
    assert slopes.tolist() == [0.1, -0.1]
    assert rays_of(slopes).tolist() == [0.1, -0.1, 1.0]
    assert PLAIN.matrix.tolist() == [[500.0, 0.0, 320.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]]
    region = Region(238, 242, 319, 324)
    slopes = PLAIN.region_slopes(region)
    assert slopes.shape == (4, 5, 2)
    assert slopes[1, 3] == pytest.approx([2 / 500, -1 / 400])
    beside = PLAIN.region_slopes(region, 0.5)
    assert beside - slopes == pytest.approx(np.broadcast_to([0.5 / 500, 0.5 / 400], (4, 5, 2)))


def test_slopes_are_equal_whichever_regions_were_asked_for() -> None:
    """They are kept, and grown when another region is asked for."""
    lens = Lens(640, 480, 501.0, 401.0, 320.0, 240.0)
    regions = (
        Region(200, 220, 300, 330),
        Region(190, 215, 310, 350),
        Region(0, 480, 0, 640),
        Region(470, 480, 0, 10),
        Region(0, 5, 630, 640),
    )
    for shift_px in (0.0, 0.5):
        for region in regions:
            v, u = np.mgrid[region.row0 : region.row1, region.col0 : region.col1] + shift_px
            expected = np.stack([(u - 320.0) / 501.0, (v - 240.0) / 401.0], axis=-1)
            slopes = lens.region_slopes(region, shift_px)
            np.testing.assert_allclose(slopes, expected, atol=1e-12)
    for number in range(10):
        Lens(8, 8, 5.0 + number, 5.0, 4.0, 4.0).region_slopes(Region(0, 8, 0, 8))
    assert len(geometry._slopes) <= geometry.MOST_LENSES


def test_points_have_an_image_in_front_within_the_sensor() -> None:
    """The outermost pixels' centres are the last that count."""
    u = np.array([0.0, 639.0, 0.0, 639.0, -0.01, 639.01, 320.0, 320.0])
    v = np.array([0.0, 0.0, 479.0, 479.0, 100.0, 100.0, -0.01, 479.01])
    slopes = PLAIN.slopes(u, v)
    points = np.concatenate([slopes, np.ones((8, 1))], axis=-1) * 2.0
    inside = [True] * 4 + [False] * 4
    # a hundred-millionth of a pixel inside, against rounding
    points[:4, :2] *= 1 - 1e-10
    assert PLAIN.images(points).tolist() == inside
    assert not PLAIN.images(-points).any()
    assert not PLAIN.images(np.array([0.1, 0.1, 0.0]))


def test_points_that_distortion_folds_back_have_no_image() -> None:
    """With a strong barrel distortion, r (1 - 0.5 r^2) falls beyond 0.816: far points appear at
    pixels of nearer ones."""
    lens = Lens(640, 480, 300.0, 300.0, 320.0, 240.0, (-0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    points = np.array([[0.5, 0.0, 1.0], [1.2, 0.0, 1.0]])
    u = lens.project(points)[:, 0]
    assert u.tolist() == pytest.approx([320 + 300 * 0.5 * 0.875, 320 + 300 * 1.2 * 0.28])
    assert lens.images(points).tolist() == [True, False]


def test_a_lens_of_another_camera_without_its_remarks() -> None:
    second_lens = OtherLens(640, 576, 505.0, 504.0, 322.0, 331.0, DISTORTION, note="n", warning="w")
    assert second_lens.plain == LENS
    assert type(second_lens.plain) is Lens


def test_pixels_with_a_point_are_valid() -> None:
    points = np.zeros((1, 3, 3))
    points[0, 1, 2] = np.nan
    points[0, 2, 0] = np.nan
    grid = np.zeros((1, 3))
    cloud = Cloud(points, grid, grid, grid, Region(0, 1, 0, 3), 0.0, 1)
    assert cloud.valid.tolist() == [[True, False, True]]
    assert cloud.organised
    assert cloud.projection == "central"
    assert cloud.crops is cloud.crops
