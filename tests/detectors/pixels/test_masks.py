"""Masks against SciPy's morphology; links, components, normals and turns of the automatic crop
against plain ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from detectors.pixels.masks import (
    components,
    grown,
    holes_filled,
    inset,
    nearest_pixel,
    notches_filled,
    on_grid,
    parts_with,
    shrunk,
)
from detectors.surfaces.smooth_surfaces import (
    WIDEST_SLOPE,
    _before_lens,
    links,
    turns,
    unit_normals,
)


def rough_points(seed: int, h: int = 23, w: int = 31) -> np.ndarray:
    """A surface with steps, creases, noise and pixels without a point."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[:h, :w]
    crease = 0.01 * np.abs(u - 15)
    step = 0.02 * (v > 11)
    z = 0.7 + crease + step + 2e-3 * random.standard_normal((h, w))
    z[random.random((h, w)) < 0.05] = np.nan
    return np.stack([u * 1.4e-3 * z, v * 1.4e-3 * z, z], axis=-1)


def by_graph(nodes: np.ndarray, right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Number the components by scipy's search of the graph whose edges are the links; -1 off the
    nodes."""
    pixels = np.arange(nodes.size).reshape(nodes.shape)
    across = right[:, :-1] & nodes[:, :-1] & nodes[:, 1:]
    below = down[:-1] & nodes[:-1] & nodes[1:]
    starts = np.concatenate([pixels[:, :-1][across], pixels[:-1][below]])
    ends = np.concatenate([pixels[:, 1:][across], pixels[1:][below]])
    links = np.ones(len(starts))
    graph = coo_array((links, (starts, ends)), shape=(nodes.size, nodes.size))
    _, labels = connected_components(graph, directed=False)
    return np.where(nodes, labels.reshape(nodes.shape), -1)


@pytest.mark.parametrize("central", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_links_are_steps_within_tilt_and_noise(seed: int, central: bool) -> None:
    points = rough_points(seed)
    right, down = links(points, 6.0, 3e-3, central)
    for result, neighbours, pixels in (
        (right[:, :-1], points[:, 1:], points[:, :-1]),
        (down[:-1], points[1:], points[:-1]),
    ):
        x, y, z = np.moveaxis(pixels, -1, 0)
        next_x, next_y, next_z = np.moveaxis(neighbours, -1, 0)
        with np.errstate(invalid="ignore"):
            across = np.hypot(next_x - x, next_y - y)
            if central:
                nearer_z = np.minimum(next_z, z)
                between_rays_x = next_x / next_z - x / z
                between_rays_y = next_y / next_z - y / z
                across = np.hypot(nearer_z * between_rays_x, nearer_z * between_rays_y)
            expected = np.abs(next_z - z) <= 6.0 * across + 3e-3
        np.testing.assert_array_equal(result, expected)
        assert expected.any()
        assert not expected.all()
    assert not right[:, -1].any()
    assert not down[-1].any()


def test_a_step_far_off_the_axis_is_a_step() -> None:
    """The ray to the farther point leads away from the axis: that is no way across the surface."""
    z = np.array([[0.7, 1.3]])
    points = np.stack([z * [[0.400, 0.402]], 0 * z, z], axis=-1)
    assert links(points, 6.0, 3e-3, central=False)[0][0, 0]
    assert not links(points, 6.0, 3e-3, central=True)[0][0, 0]


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), share=st.sampled_from([0.3, 0.6, 0.9]))
def test_the_components_are_those_of_a_graph(seed: int, share: float) -> None:
    random = np.random.default_rng(seed)
    nodes, right, down = random.random((3, 9, 13)) < share
    result, sizes = components(nodes, right, down)
    expected = by_graph(nodes, right, down)
    counts = np.bincount(expected[nodes]) if nodes.any() else np.zeros(1, int)
    assert sizes.tolist() == sorted((n for n in counts.tolist() if n), reverse=True)
    assert not result[~nodes].any()
    firsts = [int(np.flatnonzero(result == number)[0]) for number in range(1, len(sizes) + 1)]
    # of equal sizes the first in the order of the pixels is the first
    order = list(zip((-sizes).tolist(), firsts, strict=True))
    assert order == sorted(order)
    for number, size in enumerate(sizes, start=1):
        assert (result == number).sum() == size
        assert len(set(expected[result == number].tolist())) == 1


def test_no_node_has_no_component() -> None:
    nothing = np.zeros((4, 5), dtype=bool)
    result, sizes = components(nothing, ~nothing, ~nothing)
    assert not result.any()
    assert not len(sizes)


@pytest.mark.parametrize("half", [1, 4])
def test_normals_and_their_turns_equal_plain_ones(half: int) -> None:
    surface = np.nan_to_num(rough_points(3), nan=0.7)
    du = np.gradient(surface, axis=1)
    dv = np.gradient(surface, axis=0)
    normals = np.cross(du, dv)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-15)
    np.testing.assert_allclose(unit_normals(surface), normals, atol=1e-13)
    expected = np.zeros(surface.shape[:2], dtype=bool)
    for axis in (0, 1):
        n = np.moveaxis(normals, axis, 0)
        cosine = np.einsum("ijk,ijk->ij", n[2 * half :], n[: -2 * half])
        np.moveaxis(expected, axis, 0)[half:-half] |= cosine < 0.8
    np.testing.assert_array_equal(turns(normals, half, 0.8), expected)
    assert expected.any()
    assert not expected.all()


def test_a_line_of_points_has_no_normal() -> None:
    assert not unit_normals(rough_points(0, h=1)).any()


def blotches(seed: int, shape: tuple[int, int] = (40, 53)) -> np.ndarray:
    """A mask of smooth parts with holes, some of them cut by the edge of the picture."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2.5)
    return np.asarray(noise > 0.0)


def ellipse(radius_px: int) -> np.ndarray:
    """OpenCV's round structuring element, by its definition: each row is a circle's chord."""
    side = 2 * radius_px + 1
    offset = np.arange(side) - radius_px
    half = np.rint(np.sqrt(radius_px**2 - offset**2))
    return np.asarray(np.abs(offset)[None, :] <= half[:, None])


def test_values_stand_at_the_pixels_of_their_mask_in_order() -> None:
    mask = np.array([[True, False, True], [False, True, False]])
    image = on_grid(np.array([1.0, 2.0, 3.0]), mask)
    np.testing.assert_array_equal(image, [[1.0, np.nan, 2.0], [np.nan, 3.0, np.nan]])


@pytest.mark.parametrize("seed", [3, 7, 9])
def test_filled_holes_are_those_of_scipy(seed: int) -> None:
    mask = blotches(seed)
    filled = ndimage.binary_fill_holes(mask)
    assert (filled != mask).any()
    np.testing.assert_array_equal(holes_filled(mask), filled)
    np.testing.assert_array_equal(holes_filled(mask, 1), np.pad(filled, 1))


@pytest.mark.parametrize("pixels", [1, 3])
def test_masks_grow_and_shrink_as_those_of_scipy(pixels: int) -> None:
    mask = blotches(7)
    square = np.ones((2 * pixels + 1, 2 * pixels + 1), dtype=bool)
    np.testing.assert_array_equal(grown(mask, pixels), ndimage.binary_dilation(mask, square))
    round_one = grown(mask, pixels, cv2.MORPH_ELLIPSE)
    np.testing.assert_array_equal(round_one, ndimage.binary_dilation(mask, ellipse(pixels)))
    smaller = ndimage.binary_erosion(mask, square, border_value=1)
    np.testing.assert_array_equal(shrunk(mask, 2 * pixels + 1), smaller)
    assert smaller.any()


@pytest.mark.parametrize("pixels", [0, 1, 3])
def test_an_inset_takes_the_outer_rim_alone(pixels: int) -> None:
    mask = blotches(9)
    filled = ndimage.binary_fill_holes(mask)
    within = ndimage.binary_erosion(filled, ellipse(pixels), border_value=1)
    np.testing.assert_array_equal(inset(mask, pixels), mask & within)
    if pixels:
        assert (inset(mask, pixels) != mask).any()
        assert (within & ~mask).any()


@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("least", [0, 1, 12])
def test_parts_with_a_seed_are_those_of_scipy(connectivity: int, least: int) -> None:
    random = np.random.default_rng(9)
    mask = random.random((40, 53)) < 0.4
    seeds = random.random(mask.shape) < 0.1
    structure = ndimage.generate_binary_structure(2, connectivity // 4)
    labels, count = ndimage.label(mask, structure)
    expected = np.zeros(mask.shape, dtype=bool)
    for number in range(1, count + 1):
        part = labels == number
        if (part & seeds).any() and part.sum() >= least:
            expected |= part
    assert expected.any()
    assert (mask & ~expected).any()
    np.testing.assert_array_equal(parts_with(mask, seeds, connectivity, least), expected)


def test_a_part_of_just_enough_pixels_counts_and_one_of_fewer_does_not() -> None:
    mask = np.zeros((5, 9), dtype=bool)
    mask[1:3, 1:4] = True  # 6 pixels
    mask[1:3, 6:8] = True  # 4 pixels
    for least, expected in ((4, [True, True]), (5, [True, False]), (6, [True, False])):
        kept = parts_with(mask, mask, least=least)
        assert [kept[1, 1], kept[1, 6]] == expected
    assert not parts_with(mask, mask, least=7).any()
    # by default parts touch at corners, and no part is too small
    mask[3, 4] = True
    seeds = np.zeros_like(mask)
    seeds[3, 4] = True
    assert parts_with(mask, seeds)[1, 1]
    assert not parts_with(mask, seeds, connectivity=4)[1, 1]
    assert parts_with(mask, seeds, connectivity=4)[3, 4]


def test_the_nearest_pixel_is_that_of_scipy() -> None:
    mask = np.random.default_rng(10).random((30, 41)) < 0.02
    distance_px, nearest = nearest_pixel(mask)
    exact_px = ndimage.distance_transform_edt(~mask)
    rows, columns = np.indices(mask.shape)
    nearest_rows, nearest_columns = np.divmod(nearest, mask.shape[1])
    assert mask[nearest_rows, nearest_columns].all()
    np.testing.assert_array_equal(nearest[mask], np.flatnonzero(mask))
    to_nearest_px = np.hypot(nearest_rows - rows, nearest_columns - columns)
    # OpenCV's distances by masks of 3 x 3 err by up to 10 %
    np.testing.assert_allclose(to_nearest_px, exact_px, rtol=0.1)
    np.testing.assert_allclose(distance_px, exact_px, rtol=0.1)


def plate_without_discs(seed: int) -> np.ndarray:
    """A plate without holes in a picture, of which discs at its edge and a corner are cut out."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[:100, :120]
    plate = (v >= 20) & (v < 80) & (u >= 8) & (u < 88)
    plate[20:30, 8:23] = False
    outline = [(20, 48), (80, 38), (45, 8), (55, 88), (80, 73), (20, 73)]
    for row, column in outline:
        towards_middle = np.sign([50 - row, 48 - column]) * random.uniform(0.0, 6.0)
        point = np.array([row, column]) + towards_middle
        plate &= np.hypot(v - point[0], u - point[1]) > random.uniform(2.0, 14.0)
    return np.asarray(ndimage.binary_fill_holes(plate))


@pytest.mark.parametrize("radius_px", [8, 13])
def test_filled_notches_are_those_of_scipy(radius_px: int) -> None:
    """A closing with a disc, and the parts of what it adds that hold a disc of a quarter of its
    radius."""
    filled_sizes = []
    for seed in range(12):
        mask = plate_without_discs(seed)
        padded = np.pad(mask, radius_px + 1)
        closed = ndimage.binary_closing(padded, ellipse(radius_px))
        closed = closed[radius_px + 1 : -radius_px - 1, radius_px + 1 : -radius_px - 1]
        gaps = ndimage.binary_fill_holes(closed) & ~mask
        # the distance to the middle of the next pixel is half a pixel more than that to its edge
        deep = ndimage.distance_transform_edt(np.pad(gaps, 1))[1:-1, 1:-1] > 1 + radius_px / 4
        expected = mask | ndimage.binary_propagation(deep, mask=gaps)
        np.testing.assert_array_equal(notches_filled(mask, radius_px), expected)
        filled_sizes.append((expected & ~mask).sum())
        assert (gaps & ~expected).any()
    assert np.count_nonzero(filled_sizes) > 4


@pytest.mark.parametrize("radius_px", [8, 16, 24])
def test_a_notch_counts_from_a_disc_of_a_quarter_of_the_radius_on(radius_px: int) -> None:
    """The widest disc in a half-open gap of square sides has half the gap's width."""
    for width_px, is_filled in ((radius_px // 2 - 1, False), (radius_px // 2 + 3, True)):
        mask = np.pad(np.ones((60, 80), dtype=bool), 20)
        mask[20:50, 60 : 60 + width_px] = False
        filled = notches_filled(mask, radius_px)
        assert filled[40, 60 : 60 + width_px].all() == is_filled
        assert (filled != mask).any() == is_filled


def test_no_pixel_has_no_notch() -> None:
    assert not notches_filled(np.zeros((9, 9), dtype=bool), 3).any()


def test_a_notch_may_touch_the_edge_of_the_picture() -> None:
    mask = np.ones((50, 60), dtype=bool)
    mask[:12, 20:32] = False
    filled = notches_filled(mask, 10)
    assert filled[5:12, 20:32].all()


@pytest.mark.parametrize(
    ("point", "is_before"),
    [
        ((0.0, 0.0, 1.0), True),
        ((WIDEST_SLOPE - 0.01, 0.0, 1.0), True),
        ((0.0, -WIDEST_SLOPE + 0.01, 1.0), True),
        ((WIDEST_SLOPE, 0.0, 1.0), False),
        ((-WIDEST_SLOPE, 0.0, 1.0), False),
        ((0.0, 2 * WIDEST_SLOPE, 2.0), False),
        ((0.0, 0.0, 0.0), False),
        ((0.0, 0.0, -1.0), False),
    ],
)
def test_a_camera_at_the_origin_sees_points_before_it_at_less_than_80_degrees(
    point, is_before
) -> None:
    assert np.degrees(np.arctan(WIDEST_SLOPE)) == pytest.approx(80.0, abs=0.1)
    second_draw = rough_points(2)
    assert _before_lens(second_draw)
    second_draw[4, 5] = point
    assert _before_lens(second_draw) == is_before
    assert not _before_lens(np.full((3, 4, 3), np.nan))
