"""Links, components, normals and turns of the automatic crop against plain ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from detectors.pixels.masks import components
from detectors.surfaces.smooth_surfaces import links, turns, unit_normals


def rough_points(seed: int, h: int = 23, w: int = 31) -> np.ndarray:
    """A surface with steps, creases, noise and pixels without a point."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[:h, :w]
    z = 0.7 + 0.01 * np.abs(u - 15) + 0.02 * (v > 11) + 2e-3 * random.standard_normal((h, w))
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
    graph = coo_array((np.ones(len(starts)), (starts, ends)), shape=(nodes.size, nodes.size))
    labels = connected_components(graph, directed=False)[1].reshape(nodes.shape)
    return np.where(nodes, labels, -1)


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
