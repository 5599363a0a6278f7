"""Products of a few rows against matrices, box filters and sums one by one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from detectors.findings.products import correlated_products, products_of


def test_products_equal_those_of_matrices() -> None:
    rows = np.random.default_rng(1).standard_normal((7, 1001))
    np.testing.assert_allclose(products_of(rows), rows @ rows.T, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    "window",
    [
        (5, 5),
        (1, 1),
        (3, 7),
    ],
)
def test_correlated_products_equal_box_filters(window: tuple[int, int]) -> None:
    across, down = window
    images = np.random.default_rng(1).standard_normal((6, 19, 23))
    padded = np.pad(images, ((0, 0), (down - 1, down - 1), (across - 1, across - 1)))
    filtered = [
        cv2.boxFilter(
            image,
            -1,
            window,
            normalize=False,
            borderType=cv2.BORDER_CONSTANT,
        )
        for image in padded
    ]
    summed = np.stack(filtered).reshape(6, -1)
    products = correlated_products(images, across, down)
    np.testing.assert_allclose(products, summed @ summed.T, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize(("across", "down"), [(1, 1), (3, 2), (2, 5)])
def test_products_of_images_count_their_sums_over_windows(across: int, down: int) -> None:
    """Beside the sums of each window that overlaps the images, one by one."""
    images = np.random.default_rng(9).standard_normal((3, 7, 6))
    padded = np.pad(images, ((0, 0), (down - 1, down - 1), (across - 1, across - 1)))
    sums = []
    for row in range(7 + down - 1):
        for column in range(6 + across - 1):
            window = padded[:, row : row + down, column : column + across]
            sums.append(window.sum(axis=(1, 2)))
    stacked = np.array(sums)
    result = correlated_products(images, across, down)
    np.testing.assert_allclose(result, stacked.T @ stacked, rtol=1e-12)
