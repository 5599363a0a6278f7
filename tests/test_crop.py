"""Crops on clouds whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

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
    np.testing.assert_array_equal(crop(near, AutoCrop()), board)


def test_the_board_is_found_before_a_broken_background_with_its_damage_inside() -> None:
    cloud, board = board_before_wall()
    z = cloud.points_m[..., 2].copy()
    behind = ~board
    z[behind] += np.random.default_rng(1).uniform(0, 0.5, behind.sum())
    mask = crop(cloud_of(z), AutoCrop())
    assert (mask & board).sum() == board.sum()
    assert (mask & ~board).sum() == 0
    assert mask[70, 90]


def test_a_crease_ends_the_surface() -> None:
    u = np.arange(200)
    floor_and_wall = np.broadcast_to(np.where(u < 120, 0.8, 0.8 + 0.006 * (u - 120)), (150, 200)).copy()
    noisy = floor_and_wall + 3e-4 * np.random.default_rng(2).standard_normal((150, 200))
    mask = crop(cloud_of(noisy), AutoCrop())
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


def test_without_a_grid_the_largest_cluster_is_taken() -> None:
    random = np.random.default_rng(3)
    plate = np.column_stack([random.uniform(-0.2, 0.2, (3000, 2)), 0.8 + 0 * random.random(3000)])
    clutter = np.column_stack([random.uniform(-0.2, 0.2, (400, 2)), np.full(400, 1.3)])
    points = np.concatenate([clutter, plate])[None]
    n = points.shape[1]
    none, zeros = np.full((1, n), np.nan), np.zeros((1, n), dtype=np.uint8)
    cloud = Cloud(points, zeros, zeros.astype(int) + 1, none, Region(0, 1, 0, n), 0.0, 1, organised=False)
    mask = crop(cloud, AutoCrop(link_distance_mm=30.0))[0]
    assert mask[400:].all() and not mask[:400].any()
    with pytest.raises(UserError, match="without a pixel grid"):
        crop(cloud, PolygonCrop(vertices_px=((0, 0), (1, 0), (1, 1))))


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
    assert adapter.validate_json('{"kind": "box", "x_mm": [-10, 20]}') == BoxCrop(x_mm=(-10.0, 20.0))
    for wrong in ('{"kind": "bix"}', '{"kind": "box", "x_mm": [20, 10]}', '{"kind": "none", "x_mm": [0, 1]}'):
        with pytest.raises(ValidationError):
            adapter.validate_json(wrong)
