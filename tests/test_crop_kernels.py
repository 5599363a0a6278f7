"""The automatic crop's compiled passes against plain ones, and the medians that the detectors take."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detectors.crop_kernels import largest_component, links, turns, unit_normals
from detectors.median import median_of, median_size_of, quantile_of


def rough_points(seed: int, h: int = 23, w: int = 31) -> np.ndarray:
    """A surface with steps, creases, noise and pixels without a point."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[:h, :w]
    z = 0.7 + 0.01 * np.abs(u - 15) + 0.02 * (v > 11) + 2e-3 * random.standard_normal((h, w))
    z[random.random((h, w)) < 0.05] = np.nan
    return np.stack([u * 1.4e-3 * z, v * 1.4e-3 * z, z], axis=-1)


def by_picture(nodes: np.ndarray, right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """The largest component by labelling a picture in which every link is a pixel of its own."""
    h, w = nodes.shape
    picture = np.zeros((2 * h - 1, 2 * w - 1), dtype=np.uint8)
    picture[::2, ::2] = nodes
    picture[::2, 1::2] = right[:, :-1] & nodes[:, :-1] & nodes[:, 1:]
    picture[1::2, ::2] = down[:-1] & nodes[:-1] & nodes[1:]
    labels = cv2.connectedComponents(picture, connectivity=4)[1][::2, ::2]
    sizes = np.bincount(labels[nodes], minlength=2)
    sizes[0] = 0
    return (labels == int(np.argmax(sizes))) & nodes


@pytest.mark.parametrize("seed", range(5))
def test_links_are_steps_within_tilt_and_noise(seed: int) -> None:
    points = rough_points(seed)
    right, down = links(points, 6.0, 3e-3)
    for found, there, here in (
        (right[:, :-1], points[:, 1:], points[:, :-1]),
        (down[:-1], points[1:], points[:-1]),
    ):
        step = there - here
        with np.errstate(invalid="ignore"):
            expected = np.abs(step[..., 2]) <= 6.0 * np.hypot(step[..., 0], step[..., 1]) + 3e-3
        np.testing.assert_array_equal(found, expected)
        assert expected.any() and not expected.all()
    assert not right[:, -1].any() and not down[-1].any()


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), share=st.sampled_from([0.3, 0.6, 0.9]))
def test_the_largest_component_is_that_of_a_labelled_picture(seed: int, share: float) -> None:
    random = np.random.default_rng(seed)
    nodes, right, down = random.random((3, 9, 13)) < share
    found, expected = largest_component(nodes, right, down), by_picture(nodes, right, down)
    # of two that are equally large either may be called the largest
    assert found.sum() == expected.sum()
    if not np.array_equal(found, expected):
        assert not (found & expected).any()


def test_no_node_has_no_component() -> None:
    nothing = np.zeros((4, 5), dtype=bool)
    assert not largest_component(nothing, ~nothing, ~nothing).any()


@pytest.mark.parametrize("half", [1, 4])
def test_normals_and_their_turns_equal_plain_ones(half: int) -> None:
    surface = np.nan_to_num(rough_points(3), nan=0.7)
    du, dv = (np.gradient(surface, axis=axis) for axis in (1, 0))
    normals = np.cross(du, dv)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-15)
    np.testing.assert_allclose(unit_normals(surface), normals, atol=1e-13)
    expected = np.zeros(surface.shape[:2], dtype=bool)
    for axis in (0, 1):
        n = np.moveaxis(normals, axis, 0)
        cosine = np.einsum("ijk,ijk->ij", n[2 * half :], n[: -2 * half])
        np.moveaxis(expected, axis, 0)[half:-half] |= cosine < 0.8
    np.testing.assert_array_equal(turns(normals, half, 0.8), expected)
    assert expected.any() and not expected.all()


def test_a_line_of_points_has_no_normal() -> None:
    assert not unit_normals(rough_points(0, h=1)).any()


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 60), part=st.sampled_from([0.0, 0.25, 0.5, 0.9, 1.0]))
def test_medians_and_quantiles_are_numpys_bit_by_bit(seed: int, n: int, part: float) -> None:
    values = np.random.default_rng(seed).standard_normal(n).round(2)
    assert median_of(values) == np.median(values)
    assert median_size_of(values) == np.median(np.abs(values))
    assert quantile_of(values, part) == np.quantile(values, part)
