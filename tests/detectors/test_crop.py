"""Crops on clouds whose answer is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from detectors import load_detector
from detectors.crop import (
    CENTRE_SPREAD,
    AutoCrop,
    BoxCrop,
    Candidate,
    CropConfig,
    NoCrop,
    PolygonCrop,
    _OutlineComparison,
    choice_of,
    crop,
)
from detectors.pixels.masks import holes_filled
from detectors.surfaces.smooth_surfaces import smooth_surfaces
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud, Lens, Region
from tests.support.plain_clouds import cloud_of_points
from tests.support.target_scenes import SCENES, Scene

LENS = Lens(200, 150, 250.0, 250.0, 99.5, 74.5)


def cloud_of(z_m: np.ndarray, region: Region | None = None, z_step_m: float = 0.0) -> Cloud:
    region = region or Region(0, z_m.shape[0], 0, z_m.shape[1])
    slopes = LENS.region_slopes(region)
    points = np.concatenate([slopes * z_m[..., None], z_m[..., None]], axis=-1)
    nothing = np.full(z_m.shape, np.nan)
    zeros = np.zeros(z_m.shape, dtype=np.uint8)
    return Cloud(
        points,
        zeros,
        zeros.astype(int) + 1,
        nothing,
        region,
        z_step_m,
        1,
        lens=LENS,
    )


def board_before_wall(noise_m: float = 5e-4) -> tuple[Cloud, np.ndarray]:
    """A board at 0.7 m, tilted, with a 30 mm deep hole, 0.5 m before a wall; and where the board
    is."""
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
    assert mask.sum() == mask.size - 1
    assert not mask[3, 4]


def test_the_default_box_is_the_thesis() -> None:
    cloud, _ = board_before_wall()
    x, y, z = np.moveaxis(cloud.points_m, -1, 0)
    expected = (
        (z > 0)
        & (z < 1.1)
        & (x > -0.5)
        & (x < 0.4)
        & (np.sqrt(x**2 + z**2) < 1)
        & (y < 0.19)
        & (y > -0.3)
    )
    np.testing.assert_array_equal(crop(cloud, BoxCrop()), expected)


def test_polygon_takes_pixel_centres_inside_in_sensor_coordinates() -> None:
    region = Region(20, 60, 30, 90)
    cloud = cloud_of(np.full(region.shape, 0.8), region)
    mask = crop(
        cloud, PolygonCrop(vertices_px=((34.5, 24.5), (44.5, 24.5), (44.5, 30.5), (34.5, 30.5)))
    )
    rows, columns = np.nonzero(mask)
    assert (rows.min() + 20, rows.max() + 20, columns.min() + 30, columns.max() + 30) == (
        25,
        30,
        35,
        44,
    )
    assert mask.sum() == 60


def test_a_triangle_has_half_the_area_of_its_box() -> None:
    cloud = cloud_of(np.full((150, 200), 0.8))
    mask = crop(cloud, PolygonCrop(vertices_px=((10.2, 10.3), (110.2, 10.3), (10.2, 90.3))))
    assert abs(mask.sum() - 4000) < 60


def test_the_target_is_the_board_and_not_the_wall() -> None:
    cloud, board = board_before_wall()
    np.testing.assert_array_equal(crop(cloud, AutoCrop(inset_px=0)), board)
    within = np.zeros_like(board)
    within[33:117, 43:167] = True
    np.testing.assert_array_equal(crop(cloud, AutoCrop()), within)
    nearer = cloud_of(np.where(board, cloud.points_m[..., 2], np.nan))
    np.testing.assert_array_equal(crop(nearer, AutoCrop()), within)


def test_the_wall_can_be_asked_for_and_is_taken_without_the_board() -> None:
    cloud, board = board_before_wall()
    choice = choice_of(cloud, AutoCrop(target=2, inset_px=0))
    first, second = choice.candidates
    assert choice.taken == 2
    assert not choice.warnings
    assert first.depths_m[1] == pytest.approx(0.7, abs=0.01)
    assert second.depths_m[1] == pytest.approx(1.2, abs=0.001)
    # 130 x 90 pixels of 2.8 mm, and 200 x 150 of 4.8 mm
    assert first.extent_m == pytest.approx((0.364, 0.252), abs=0.01)
    assert second.extent_m == pytest.approx((0.96, 0.72), abs=0.01)
    assert first.share == pytest.approx(board.mean(), abs=0.01)
    slope = np.degrees(np.arctan(np.hypot(2e-4, 1e-4) * 250 / 0.7))
    assert first.tilt_deg == pytest.approx(slope, abs=0.5)
    assert second.tilt_deg < 0.5
    assert not (choice.mask & board).any()
    assert choice.mask.sum() > 0.8 * (~board).sum()
    with pytest.raises(UserError, match="--target 3: there are 2") as caught:
        crop(cloud, AutoCrop(target=3))
    assert "--target 1: 0.70 m" in str(caught.value)
    assert "--target 2: 1.20 m" in str(caught.value)


def compared(z_m: np.ndarray) -> _OutlineComparison:
    """The surfaces of a picture of two, the nearer one first."""
    cloud = cloud_of(z_m + 3e-4 * np.random.default_rng(0).standard_normal(z_m.shape))
    comparison = _OutlineComparison(smooth_surfaces(cloud, 35.0, 9), cloud)
    assert len(comparison.numbers) == 2
    return comparison


def nearer_first(comparison: _OutlineComparison) -> list[int]:
    return sorted(comparison.numbers, key=lambda number: comparison.described[number].depths_m[1])


def test_two_surfaces_apart_are_compared_by_weight_tilt_and_nearness() -> None:
    z_m = np.full((150, 200), np.nan)
    z_m[30:120, 10:80] = 0.6
    columns = np.arange(200)
    z_m[30:120, 100:190] = 0.9 + 3e-3 * (columns[100:190] - 145)
    comparison = compared(z_m)
    first, second = nearer_first(comparison)
    this = comparison.described[first]
    that = comparison.described[second]
    facing = np.cos(np.radians(this.tilt_deg)) / np.cos(np.radians(that.tilt_deg))
    nearness = that.depths_m[1] / this.depths_m[1]
    odds = (np.sqrt(this.weight / that.weight) * facing**2 * nearness) ** 2
    probability, why = comparison.judged(first, second)
    assert probability == pytest.approx(odds / (1 + odds), rel=1e-6)
    assert facing > 1.1
    assert this.weight < 0.9 * that.weight
    sizes = [
        f"{candidate.extent_m[0] * 1e3:.0f} x {candidate.extent_m[1] * 1e3:.0f} mm"
        for candidate in (that, this)
    ]
    expected = (
        f"a surface of {sizes[0]} at 0.90 m may be the target instead of that of {sizes[1]} at"
        " 0.60 m"
    )
    assert why == expected


# ---------------------------------------------------------------- scenes of all kinds


def judged(kind: str, seed: int, camera: str, flat: bool = False) -> tuple[bool, bool, Scene]:
    """Whether the crop of a random scene is its target, and whether it warned.

    Right: at most 3 % of the crop lie more than two pixels outside of the target's outline, and 80
    % of the target's inside, without a rim of twice the inset, are kept. Noise of 0.3 to 3 mm, up
    to 30 % dropouts.
    """
    random = np.random.default_rng(seed)
    scene = Scene(camera)
    SCENES[kind](random, scene)
    noise_m = float(np.exp(random.uniform(np.log(3e-4), np.log(3e-3))))
    dropouts = float(random.choice([0.0, random.uniform(0.0, 0.3)]))
    cloud = scene.cloud(
        random,
        noise_m,
        dropouts,
        random.choice([0.0, 1e-4, 1e-3]),
        int(random.choice([1, 3, 5])),
    )
    choice = choice_of(without_grid(cloud.points_m.reshape(-1, 3)) if flat else cloud, AutoCrop())
    mask = np.zeros(cloud.valid.shape, dtype=bool)
    mask[cloud.valid] = choice.mask[0] if flat else choice.mask[cloud.valid]
    target = scene.name == 1
    full_mask = holes_filled(target).astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    outside = cv2.dilate(full_mask, kernel, iterations=2) == 0
    inside = target & (cv2.erode(full_mask, kernel, iterations=10 if flat else 6) > 0) & cloud.valid
    right = (mask & outside).sum() <= 0.03 * mask.sum() and (
        mask & inside
    ).sum() >= 0.8 * inside.sum()
    return bool(right), bool(choice.warnings), scene


SURE = [
    kind
    for kind in SCENES
    if kind not in ("hand_in_front", "two_boards", "board_close_before_wall")
]


QUICK = "board_before_wall", "board_on_floor", "pipe", "plate_with_large_holes", "bent_sheet"
"""Scenes that `make test` runs; `make test-all` runs the others too."""


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[] if kind in QUICK else [pytest.mark.slow]) for kind in SURE]
)
def test_the_target_of_a_random_scene_is_taken(kind: str) -> None:
    """A warning is no answer here: these scenes have one target."""
    for seed, camera in ((1, "phone"), (2, "l515"), (3, "azure wfov binned")):
        right, warned, _ = judged(kind, seed, camera)
        assert right and not warned, (kind, seed, camera)


@pytest.mark.parametrize(
    "kind", ["board_before_wall", "object_on_plate", "pipe", "plate_with_large_holes"]
)
def test_the_target_is_taken_without_a_pixel_grid_too(kind: str) -> None:
    right, warned, _ = judged(kind, 4, "phone", flat=True)
    assert right
    assert not warned


def test_two_boards_side_by_side_are_a_doubt() -> None:
    for seed in (1, 2, 3):
        assert judged("two_boards", seed, "phone")[1]


@pytest.mark.parametrize(
    ("squares", "is_told"),
    [
        (4, False),
        (5, True),
    ],
)
def test_a_crowd_of_like_surfaces_may_hold_no_target(squares: int, is_told: bool) -> None:
    """Squares side by side, each 20 cm farther than the one before, so that the first is preferred
    to all others."""
    z_m = np.full((150, 200), np.nan)
    for number in range(squares):
        z_m[60:92, 4 + 40 * number : 36 + 40 * number] = 0.5 + 0.2 * number
    doubts = choice_of(cloud_of(z_m), AutoCrop()).warnings
    assert any("may hold no target" in doubt for doubt in doubts) == is_told


def test_a_board_close_before_a_wall_is_taken_with_or_without_a_doubt() -> None:
    """Seen from the front it may as well be a thing that lies on the wall."""
    for seed, camera in ((1, "phone"), (2, "l515"), (3, "azure wfov binned")):
        assert judged("board_close_before_wall", seed, camera)[0]


def test_a_hand_before_the_board_is_right_or_a_doubt() -> None:
    for seed in (1, 2, 3):
        right, warned, _ = judged("hand_in_front", seed, "phone")
        assert right or warned


def test_the_fingers_of_a_hand_before_the_board_leave_with_it() -> None:
    cloud, _ = board_before_wall()
    z = cloud.points_m[..., 2].copy()
    z[80:120, 110:150] = 0.4
    fingers = np.zeros(z.shape, dtype=bool)
    fingers[84:90, 90:110] = fingers[96:102, 90:110] = fingers[108:114, 90:110] = True
    z[fingers] = 0.43  # 30 mm behind the palm: no part of one smooth surface with it
    bump = (np.arange(200) - 65) ** 2 + (np.arange(150)[:, None] - 75) ** 2 < 64
    z[bump] -= 0.02
    mask = crop(cloud_of(z), AutoCrop())
    assert mask[fingers].mean() < 0.02
    assert mask[bump].all()


def test_what_lies_on_a_plate_stays_in_its_outline() -> None:
    right, _, scene = judged("object_on_plate", 1, "phone")
    assert right
    assert (scene.name == 1).all()


def test_the_board_is_found_before_a_broken_background_with_its_damage_inside() -> None:
    cloud, board = board_before_wall()
    z = cloud.points_m[..., 2].copy()
    behind = ~board
    z[behind] += np.random.default_rng(1).uniform(0, 0.5, behind.sum())
    mask = crop(cloud_of(z), AutoCrop(inset_px=0))
    assert (mask & board).sum() == board.sum()
    assert (mask & ~board).sum() == 0
    assert mask[70, 90]


def test_a_deep_hole_at_the_edge_stays_in_the_outline() -> None:
    z = np.full((150, 200), 1.2)
    board = np.zeros(z.shape, dtype=bool)
    board[30:120, 40:170] = True
    z[board] = 0.7
    v, u = np.mgrid[:150, :200]
    hole = (u - 100) ** 2 + (v - 41) ** 2 < 100  # its rim is two pixels from the edge
    z[hole] += 0.03
    z += 5e-4 * np.random.default_rng(0).standard_normal(z.shape)
    mask = crop(cloud_of(z), AutoCrop())
    assert mask[hole & (v > 34)].mean() > 0.95  # the inset takes the opening's rim
    assert not mask[~board].any()


@pytest.mark.parametrize("between_m", [0.4, 1.2])
def test_pieces_behind_a_strip_are_one_target_and_beside_a_gap_are_two(between_m: float) -> None:
    z = np.full((150, 200), 1.2)
    z[30:120, 20:180] = 0.7
    z[:, 120:128] = between_m
    z += 5e-4 * np.random.default_rng(0).standard_normal(z.shape)
    choice = choice_of(cloud_of(z), AutoCrop(inset_px=0))
    assert choice.mask[34:116, 24:116].all()
    assert choice.mask[34:116, 132:176].all() == (between_m < 0.7)
    assert not choice.mask[:, 121:127].any()
    in_plane = any("lies in the plane of target 1" in warning for warning in choice.warnings)
    assert in_plane == (between_m > 0.7)


def test_a_crease_ends_the_surface() -> None:
    u = np.arange(200)
    floor_and_wall = np.broadcast_to(
        np.where(u < 120, 0.8, 0.8 + 0.006 * (u - 120)), (150, 200)
    ).copy()
    noisy = floor_and_wall + 3e-4 * np.random.default_rng(2).standard_normal((150, 200))
    mask = crop(cloud_of(noisy), AutoCrop(inset_px=0))
    assert mask[:, :115].all()
    assert not mask[:, 126:].any()


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


def drilled_board_before_a_wall(
    noise_m: float = 5e-4, seed: int = 5
) -> tuple[Cloud, np.ndarray, np.ndarray]:
    """A frontal board at 0.7 m, half an inch thick, right of the axis, with through-holes of 14
    and 25 mm to a backing 33 mm behind its face, and a wall 0.2 m behind; which pixels see the
    board or into its holes, and which hole (1, 2; else 0) each sees into.

    A ray that leaves a hole's cylinder within the thickness ends on its wall; the camera's own
    blur is left out. Only 30 mm of the wall are seen around the board: a wall that fills more of
    the picture would be the largest surface.
    """
    slopes = LENS.region_slopes(LENS.whole)
    x, y = np.moveaxis(0.7 * slopes, -1, 0)
    target = (x > 0.03) & (x < 0.27) & (np.abs(y) < 0.12)
    z = np.where(target, 0.7, 0.9)
    hole = np.zeros(z.shape, dtype=int)
    for number, centre_x, diameter in ((1, 0.1, 0.014), (2, 0.19, 0.025)):
        from_axis_m = np.stack([x - centre_x, y - 0.02], axis=-1)
        a = (slopes**2).sum(-1)
        b = (from_axis_m * slopes).sum(-1)
        c = (from_axis_m**2).sum(-1) - diameter**2 / 4
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
    none = np.full((1, n), np.nan)
    zeros = np.zeros((1, n), dtype=np.uint8)
    return Cloud(
        points[None],
        zeros,
        zeros.astype(int) + 1,
        none,
        Region(0, 1, 0, n),
        0.0,
        1,
        organised=False,
    )


@pytest.mark.parametrize("recorded_from_origin", [True, False])
def test_without_a_grid_holes_with_a_backing_are_found_and_the_wall_past_the_rim_is_not(
    recorded_from_origin: bool,
) -> None:
    cloud, target, hole = drilled_board_before_a_wall()
    order = np.random.default_rng(6).permutation(np.flatnonzero(cloud.valid))
    points = cloud.points_m.reshape(-1, 3)[order]
    target = target.ravel()[order]
    hole = hole.ravel()[order]
    if not recorded_from_origin:
        points = points - [0.15, 0.02, 0.7]
    flat = without_grid(points)
    detector = load_detector("thesis", {"crop": {"kind": "auto"}})
    evidence = detector.analyse(flat)
    kept = np.isfinite(evidence.score[0])
    # of 85 x 86 pixels at most 6 on each side go: 3 of rim, 3 for the raster's cells
    assert not kept[~target].any()
    assert kept[target].mean() > 0.73
    in_findings = np.zeros(len(points), dtype=bool)
    for detection in detector.find(flat, evidence, 5.0):
        in_findings[detection.pixels] = True
    assert not in_findings[hole == 0].any()
    assert in_findings[hole == 1].mean() > 0.8
    assert in_findings[hole == 2].mean() > 0.8


def test_without_a_grid_the_crop_is_the_grids_but_for_the_rim() -> None:
    cloud, target, _ = drilled_board_before_a_wall()
    flat = without_grid(cloud.points_m.reshape(-1, 3))
    full_mask = crop(flat, AutoCrop(inset_px=0))[0]
    assert full_mask[target[cloud.valid]].all()
    # a cell on the rim may hold a point of the wall too
    nearer = cv2.dilate(target.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert not full_mask[~nearer[cloud.valid]].any()
    for inset in (1, 2, 3, 5, 8):
        mask = crop(flat, AutoCrop(inset_px=inset))[0]
        assert not (mask & ~crop(cloud, AutoCrop(inset_px=inset))[cloud.valid]).any()
        # the raster's cells are 1.5 px wide: up to 3 px more than asked
        assert not (~mask & crop(cloud, AutoCrop(inset_px=inset + 3))[cloud.valid]).any()


def test_points_in_no_order_at_all_still_make_a_surface() -> None:
    random = np.random.default_rng(3)
    plate = np.column_stack(
        [random.uniform(-0.2, 0.2, (3000, 2)), 0.8 + 1e-3 * random.standard_normal(3000)]
    )
    clutter = np.column_stack([random.uniform(0.5, 0.9, (400, 2)), random.uniform(1.2, 1.4, 400)])
    mask = crop(without_grid(np.concatenate([clutter, plate])), AutoCrop(inset_px=0))[0]
    assert mask[400:].mean() > 0.99
    assert not mask[:400].any()


def test_the_pixel_grids_of_several_views_over_one_another_make_a_surface() -> None:
    """Grids of nearly one pitch beat: their points gather in bands, and the gaps between these
    part nothing."""
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
    assert kept[inner].all()
    assert not kept.all()


def test_a_polygon_needs_a_grid() -> None:
    cloud, *_ = drilled_board_before_a_wall()
    with pytest.raises(UserError, match="without a pixel grid"):
        crop(
            without_grid(cloud.points_m.reshape(-1, 3)),
            PolygonCrop(vertices_px=((0, 0), (1, 0), (1, 1))),
        )


def test_an_empty_crop_names_the_box_and_the_cloud() -> None:
    cloud = cloud_of(np.full((150, 200), 1.5))
    with pytest.raises(UserError) as caught:
        crop(cloud, BoxCrop())
    assert "z 0 to 1100" in str(caught.value)
    assert "z 1500 to 1500 mm" in str(caught.value)
    with pytest.raises(UserError, match="unit"):
        crop(cloud_of(np.full((150, 200), 250.0)), BoxCrop())
    with pytest.raises(UserError, match="polygon"):
        crop(cloud, PolygonCrop(vertices_px=((300, 300), (310, 300), (310, 310))))
    with pytest.raises(UserError, match="no valid point"):
        crop(cloud_of(np.full((150, 200), np.nan)), NoCrop())


def test_the_kind_chooses_the_declaration() -> None:
    adapter: TypeAdapter[NoCrop | BoxCrop | PolygonCrop | AutoCrop] = TypeAdapter(CropConfig)
    assert isinstance(adapter.validate_json('{"kind": "auto", "inset_px": 2}'), AutoCrop)
    assert adapter.validate_json('{"kind": "auto"}').inset_px == 3
    assert NoCrop().inset_px == 0
    assert adapter.validate_json('{"kind": "box", "x_mm": [-10, 20]}') == BoxCrop(
        x_mm=(-10.0, 20.0)
    )
    for wrong in (
        '{"kind": "bix"}',
        '{"kind": "box", "x_mm": [20, 10]}',
        '{"kind": "none", "x_mm": [0, 1]}',
    ):
        with pytest.raises(ValidationError):
            adapter.validate_json(wrong)


# --- what is known of a candidate ---


def flat_candidate(mask: np.ndarray, slope: float = 0.0, organised: bool = True) -> Candidate:
    """Pixels of a plane z = 0.8 + slope x, seen through a lens of 200 pixels."""
    height, width = mask.shape
    lens = Lens(width, height, 200.0, 200.0, (width - 1) / 2, (height - 1) / 2)
    slopes = lens.region_slopes(lens.whole)
    z_m = 0.8 / (1.0 - slope * slopes[..., 0])
    points_m = np.concatenate([slopes * z_m[..., None], z_m[..., None]], axis=-1)
    cloud = cloud_of_points(points_m, organised=organised, lens=lens)
    return Candidate(mask=mask, filled=holes_filled(mask), outline=mask, grid=cloud)


@pytest.mark.parametrize(
    ("rows", "columns", "on_edge"),
    [
        ((0, 30), (0, 40), 1.0),
        ((1, 29), (1, 39), 0.0),
        # one side along the picture's edge
        ((0, 11), (5, 25), 20),
        ((19, 30), (5, 25), 20),
        ((5, 25), (0, 11), 20),
        ((5, 25), (29, 40), 20),
        # a corner: both sides share a pixel
        ((0, 11), (0, 21), 11 + 21 - 1),
        ((1, 12), (1, 22), 0.0),
    ],
)
def test_the_part_of_an_outline_that_the_picture_cuts_off(rows, columns, on_edge) -> None:
    mask = np.zeros((30, 40), bool)
    mask[slice(*rows), slice(*columns)] = True
    mask[(rows[0] + rows[1]) // 2, (columns[0] + columns[1]) // 2] = False  # a hole has no outline
    height = rows[1] - rows[0]
    width = columns[1] - columns[0]
    length = 2 * (height + width) - 4
    expected = on_edge if isinstance(on_edge, float) else on_edge / length
    assert flat_candidate(mask).cut_off == pytest.approx(expected)


@pytest.mark.parametrize("slope", [0.0, 0.5, 1.2, 2.5])
def test_a_candidate_s_tilt_extent_depths_and_weight(slope: float) -> None:
    """A rectangle around the middle of a picture: sides on the plane, percentiles of z, and the
    share of the pixels under a bell about the middle, less at a grazing angle."""
    mask = np.zeros((61, 81), bool)
    mask[20:41, 30:51] = True
    candidate = flat_candidate(mask, slope)
    assert candidate.share == pytest.approx(21 * 21 / (61 * 81))
    tilt = np.arctan(slope)
    assert candidate.tilt_deg == pytest.approx(np.degrees(tilt), abs=1e-3)
    points = candidate.grid.points_m[mask]
    x, y, z = points.T
    assert candidate.depths_m == pytest.approx(tuple(np.quantile(z, (0.01, 0.5, 0.99))))
    long, short = candidate.extent_m
    sides = sorted([np.ptp(x) / np.cos(tilt), np.ptp(y)])
    if slope == 0.0:
        assert (short, long) == pytest.approx(tuple(sides), rel=0.02)
    else:
        assert long == pytest.approx(sides[1], rel=0.06)
    bell_rows = np.exp(-0.5 * (((np.arange(61) + 0.5) / 61 - 0.5) / CENTRE_SPREAD) ** 2)
    bell_columns = np.exp(-0.5 * (((np.arange(81) + 0.5) / 81 - 0.5) / CENTRE_SPREAD) ** 2)
    weight = bell_rows[20:41].sum() * bell_columns[30:51].sum()
    weight /= bell_rows.sum() * bell_columns.sum()
    assert candidate.weight == pytest.approx(weight * min(1.0, (np.cos(tilt) / 0.5) ** 2), rel=1e-4)


@pytest.mark.parametrize(("step_m", "is_one_plane"), [(0.0, True), (0.0019, True), (0.0021, False)])
def test_surfaces_continue_each_other_if_they_lie_in_one_plane(step_m, is_one_plane) -> None:
    """Nine tenths of the points of both within 2 mm of the first one's plane."""
    left = np.zeros((40, 80), bool)
    left[:, :30] = True
    right = np.zeros((40, 80), bool)
    right[:, 40:] = True
    first = flat_candidate(left)
    second = flat_candidate(right)
    second.grid.points_m[..., 2] += step_m
    assert first.continues(second, 0.002) == is_one_plane
    # a tenth may be off
    second.grid.points_m[:4, :, 2] -= 0.5
    assert not first.continues(second, 0.0001) or step_m == 0.0
