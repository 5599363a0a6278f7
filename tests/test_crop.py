"""Crops on clouds whose answer is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from detectors import load_detector
from detectors.crop import AutoCrop, BoxCrop, CropConfig, NoCrop, PolygonCrop, crop
from harness.vocabulary.capture import Cloud
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens

LENS = Lens(200, 150, 250.0, 250.0, 99.5, 74.5)


def cloud_of(z_m: np.ndarray, region: Region | None = None, z_step_m: float = 0.0) -> Cloud:
    region = region or Region(0, z_m.shape[0], 0, z_m.shape[1])
    slopes = LENS.region_slopes(region)
    points = np.concatenate([slopes * z_m[..., None], z_m[..., None]], axis=-1)
    nothing = np.full(z_m.shape, np.nan)
    zeros = np.zeros(z_m.shape, dtype=np.uint8)
    return Cloud(points, zeros, zeros.astype(int) + 1, nothing, region, z_step_m, 1, lens=LENS)


def board_before_wall(noise_m: float = 5e-4) -> tuple[Cloud, np.ndarray]:
    """A board at 0.7 m, tilted, with a 30 mm deep hole, 0.5 m before a wall; and where the board is."""
    z = np.full((150, 200), 1.2)
    board = np.zeros(z.shape, dtype=bool)
    board[30:120, 40:170] = True
    v, u = np.mgrid[:150, :200]
    z[board] = (0.7 + 2e-4 * (u - 100) + 1e-4 * (v - 75))[board]
    z[(u - 90) ** 2 + (v - 70) ** 2 < 64] += 0.03
    z += noise_m * np.random.default_rng(0).standard_normal(z.shape)
    return cloud_of(z), board


def test_none_keeps_every_valid_pixel() -> None:
    cloud, _ = board_before_wall()
    cloud.points_m[3, 4] = np.nan
    mask = crop(cloud, NoCrop())
    assert mask.sum() == mask.size - 1 and not mask[3, 4]


def test_the_default_box_is_the_thesis() -> None:
    cloud, _ = board_before_wall()
    x, y, z = np.moveaxis(cloud.points_m, -1, 0)
    expected = (z > 0) & (z < 1.1) & (x > -0.5) & (x < 0.4) & (np.sqrt(x**2 + z**2) < 1) & (y < 0.19) & (y > -0.3)
    np.testing.assert_array_equal(crop(cloud, BoxCrop()), expected)


def test_keep_fraction_multiplies_the_extremes_like_the_script() -> None:
    cloud, _ = board_before_wall()
    whole = crop(cloud, BoxCrop())
    x, y = cloud.points_m[..., 0], cloud.points_m[..., 1]
    kept = whole.copy()
    for v in (x, y):
        kept &= (v < 0.75 * v[whole].max()) & (v > 0.75 * v[whole].min())
    np.testing.assert_array_equal(crop(cloud, BoxCrop(keep_fraction=0.75)), kept)
    assert 0.5 < kept.sum() / whole.sum() < 0.6


def test_polygon_takes_pixel_centres_inside_in_sensor_coordinates() -> None:
    region = Region(20, 60, 30, 90)
    cloud = cloud_of(np.full(region.shape, 0.8), region)
    mask = crop(cloud, PolygonCrop(vertices_px=((34.5, 24.5), (44.5, 24.5), (44.5, 30.5), (34.5, 30.5))))
    rows, columns = np.nonzero(mask)
    assert (rows.min() + 20, rows.max() + 20, columns.min() + 30, columns.max() + 30) == (25, 30, 35, 44)
    assert mask.sum() == 60


def test_a_triangle_has_half_the_area_of_its_box() -> None:
    cloud = cloud_of(np.full((150, 200), 0.8))
    mask = crop(cloud, PolygonCrop(vertices_px=((10.2, 10.3), (110.2, 10.3), (10.2, 90.3))))
    assert abs(mask.sum() - 4000) < 60


def test_the_largest_surface_is_the_wall_or_the_board() -> None:
    cloud, board = board_before_wall()
    np.testing.assert_array_equal(crop(cloud, AutoCrop()), np.ones(board.shape, dtype=bool))
    near = cloud_of(np.where(board, cloud.points_m[..., 2], np.nan))
    np.testing.assert_array_equal(crop(near, AutoCrop(inset_px=0)), board)
    within = np.zeros_like(board)
    within[33:117, 43:167] = True
    np.testing.assert_array_equal(crop(near, AutoCrop()), within)


def test_the_board_is_found_before_a_broken_background_with_its_damage_inside() -> None:
    cloud, board = board_before_wall()
    z = cloud.points_m[..., 2].copy()
    behind = ~board
    z[behind] += np.random.default_rng(1).uniform(0, 0.5, behind.sum())
    mask = crop(cloud_of(z), AutoCrop(inset_px=0))
    assert (mask & board).sum() == board.sum()
    assert (mask & ~board).sum() == 0
    assert mask[70, 90]


def test_a_crease_ends_the_surface() -> None:
    u = np.arange(200)
    floor_and_wall = np.broadcast_to(np.where(u < 120, 0.8, 0.8 + 0.006 * (u - 120)), (150, 200)).copy()
    noisy = floor_and_wall + 3e-4 * np.random.default_rng(2).standard_normal((150, 200))
    mask = crop(cloud_of(noisy), AutoCrop(inset_px=0))
    assert mask[:, :115].all() and not mask[:, 126:].any()


def test_inset_takes_the_rim_but_leaves_holes_and_the_image_edge() -> None:
    z = np.full((150, 200), np.nan)
    z[30:120, :170] = 0.8
    z[60:70, 60:70] = np.nan
    mask = crop(cloud_of(z), NoCrop(inset_px=3))
    expected = np.isfinite(z)
    expected[:33] = expected[117:] = False
    expected[:, 167:] = False
    np.testing.assert_array_equal(mask, expected)


# ---------------------------------------------------------------- without a pixel grid


def drilled_board_before_a_wall(noise_m: float = 5e-4, seed: int = 5) -> tuple[Cloud, np.ndarray, np.ndarray]:
    """A frontal board at 0.7 m, half an inch thick, right of the axis, with through-holes of 14 and 25 mm to a backing
    33 mm behind its face, and a wall 0.2 m behind; which pixels see the board or into its holes, and which hole
    (1, 2; else 0) each sees into.

    A ray that leaves a hole's cylinder within the thickness ends on its wall; the camera's own blur is left out. Only
    30 mm of the wall are seen around the board: a wall that fills more of the picture would be the largest surface.
    """
    slopes = LENS.region_slopes(LENS.whole)
    x, y = np.moveaxis(0.7 * slopes, -1, 0)
    target = (x > 0.03) & (x < 0.27) & (np.abs(y) < 0.12)
    z = np.where(target, 0.7, 0.9)
    hole = np.zeros(z.shape, dtype=int)
    for number, centre_x, diameter in ((1, 0.1, 0.014), (2, 0.19, 0.025)):
        apart = np.stack([x - centre_x, y - 0.02], axis=-1)
        a, b = (slopes**2).sum(-1), (apart * slopes).sum(-1)
        c = (apart**2).sum(-1) - diameter**2 / 4
        inside = c < 0
        wall = (np.sqrt(np.where(inside, b * b - a * c, 0.0)) - b) / a
        hole[inside] = number
        z[inside] = 0.7 + np.where(wall < 0.0127, wall, 0.033)[inside]
    z += noise_m * np.random.default_rng(seed).standard_normal(z.shape)
    z[(x < 0) | (x > 0.3) | (np.abs(y) > 0.15)] = np.nan
    return cloud_of(z), target, hole


def without_grid(points: np.ndarray) -> Cloud:
    """The points of (n, 3) that are none NaN, as a cloud without a grid."""
    points = points[np.isfinite(points[:, 2])]
    n = len(points)
    none, zeros = np.full((1, n), np.nan), np.zeros((1, n), dtype=np.uint8)
    return Cloud(points[None], zeros, zeros.astype(int) + 1, none, Region(0, 1, 0, n), 0.0, 1, organised=False)


@pytest.mark.parametrize("recorded_from_origin", [True, False])
def test_without_a_grid_holes_with_a_backing_are_found_and_the_wall_past_the_rim_is_not(
    recorded_from_origin: bool,
) -> None:
    cloud, target, hole = drilled_board_before_a_wall()
    order = np.random.default_rng(6).permutation(np.flatnonzero(cloud.valid))
    points, target, hole = cloud.points_m.reshape(-1, 3)[order], target.ravel()[order], hole.ravel()[order]
    if not recorded_from_origin:
        points = points - [0.15, 0.02, 0.7]
    flat = without_grid(points)
    detector = load_detector("thesis", {"crop": {"kind": "auto"}})
    evidence = detector.analyse(flat)
    kept = np.isfinite(evidence.score[0])
    # of 85 x 86 pixels at most 6 on each side go: 3 of rim, 3 for the raster's cells
    assert not kept[~target].any() and kept[target].mean() > 0.73
    found = np.zeros(len(points), dtype=bool)
    for detection in detector.find(flat, evidence, 5.0):
        found[detection.pixels] = True
    assert not found[hole == 0].any()
    assert found[hole == 1].mean() > 0.8 and found[hole == 2].mean() > 0.8


def test_without_a_grid_the_crop_is_the_grids_but_for_the_rim() -> None:
    cloud, target, _ = drilled_board_before_a_wall()
    flat = without_grid(cloud.points_m.reshape(-1, 3))
    whole = crop(flat, AutoCrop(inset_px=0))[0]
    assert whole[target[cloud.valid]].all()
    # a cell on the rim may hold a point of the wall too
    near = cv2.dilate(target.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert not whole[~near[cloud.valid]].any()
    for inset in (1, 2, 3, 5, 8):
        mask = crop(flat, AutoCrop(inset_px=inset))[0]
        assert not (mask & ~crop(cloud, AutoCrop(inset_px=inset))[cloud.valid]).any()
        # the raster's cells are 1.5 px wide: up to 3 px more than asked
        assert not (~mask & crop(cloud, AutoCrop(inset_px=inset + 3))[cloud.valid]).any()


def test_points_in_no_order_at_all_still_make_a_surface() -> None:
    random = np.random.default_rng(3)
    plate = np.column_stack([random.uniform(-0.2, 0.2, (3000, 2)), 0.8 + 1e-3 * random.standard_normal(3000)])
    clutter = np.column_stack([random.uniform(0.5, 0.9, (400, 2)), random.uniform(1.2, 1.4, 400)])
    mask = crop(without_grid(np.concatenate([clutter, plate])), AutoCrop(inset_px=0))[0]
    assert mask[400:].mean() > 0.99 and not mask[:400].any()


def test_the_pixel_grids_of_several_views_over_one_another_make_a_surface() -> None:
    """Grids of nearly one pitch beat: their points gather in bands, and the gaps between these part nothing."""
    random = np.random.default_rng(7)
    clouds = []
    for number in range(9):
        pitch = 1.4e-3 * (1.0 + 0.004 * number)
        x, y = np.meshgrid(np.arange(-0.15, 0.15, pitch), np.arange(-0.05, 0.05, pitch))
        z = 0.7 + 0.05 * x + 3e-4 * random.standard_normal(x.shape)
        z[np.hypot(x - 0.02, y - 0.01) < 8e-3] += 0.02
        clouds.append(np.stack([x, y, z], axis=-1).reshape(-1, 3))
    points = np.concatenate(clouds)
    assert crop(without_grid(points), AutoCrop(inset_px=0)).all()
    kept = crop(without_grid(points), AutoCrop())[0]
    inner = (np.abs(points[:, :2]) < [0.145, 0.045]).all(axis=1)
    assert kept[inner].all() and not kept.all()


def test_a_polygon_needs_a_grid() -> None:
    cloud, *_ = drilled_board_before_a_wall()
    with pytest.raises(UserError, match="without a pixel grid"):
        crop(without_grid(cloud.points_m.reshape(-1, 3)), PolygonCrop(vertices_px=((0, 0), (1, 0), (1, 1))))


def test_an_empty_crop_names_the_box_and_the_cloud() -> None:
    cloud = cloud_of(np.full((150, 200), 1.5))
    with pytest.raises(UserError) as caught:
        crop(cloud, BoxCrop())
    assert "z 0 to 1100" in str(caught.value) and "z 1500 to 1500 mm" in str(caught.value)
    with pytest.raises(UserError, match="unit"):
        crop(cloud_of(np.full((150, 200), 250.0)), BoxCrop())
    with pytest.raises(UserError, match="polygon"):
        crop(cloud, PolygonCrop(vertices_px=((300, 300), (310, 300), (310, 310))))
    with pytest.raises(UserError, match="no valid point"):
        crop(cloud_of(np.full((150, 200), np.nan)), NoCrop())


def test_the_kind_chooses_the_declaration() -> None:
    adapter: TypeAdapter[NoCrop | BoxCrop | PolygonCrop | AutoCrop] = TypeAdapter(CropConfig)
    assert isinstance(adapter.validate_json('{"kind": "auto", "inset_px": 2}'), AutoCrop)
    assert adapter.validate_json('{"kind": "auto"}').inset_px == 3 and NoCrop().inset_px == 0
    assert adapter.validate_json('{"kind": "box", "x_mm": [-10, 20]}') == BoxCrop(x_mm=(-10.0, 20.0))
    for wrong in ('{"kind": "bix"}', '{"kind": "box", "x_mm": [20, 10]}', '{"kind": "none", "x_mm": [0, 1]}'):
        with pytest.raises(ValidationError):
            adapter.validate_json(wrong)
