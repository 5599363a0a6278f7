"""Virtual holes: their places, their image through a camera, and a part of a picture."""

from __future__ import annotations

import numpy as np
import pytest

from detectors.findings.virtual_holes import (
    UPSAMPLED,
    VirtualHoles,
    hole_image,
    places_apart,
    squares_px,
    with_holes,
)


@pytest.mark.parametrize("squares", [(1.0,), (5.0,), (12.0, 8.0), (2.5,)])
@pytest.mark.parametrize("width_px", [3.0, 8.0, 20.0])
def test_a_hole_keeps_its_volume_and_centre_through_the_blur(width_px, squares):
    image = hole_image(width_px, squares)
    assert image.sum() == pytest.approx(np.pi * width_px**2 / 4, rel=0.03)
    rows, columns = np.indices(image.shape)
    middle = len(image) // 2
    # a square of an even number of sub-pixels lies half a sub-pixel beside its middle
    assert (image * rows).sum() / image.sum() == pytest.approx(middle, abs=0.13 * len(squares))
    assert (image * columns).sum() / image.sum() == pytest.approx(middle, abs=0.13 * len(squares))
    # the second moment of a disc, w^2 / 16, and of each square, s^2 / 12, add up
    spread = ((columns - middle) ** 2 * image).sum() / image.sum()
    lens = 0.6**2 + 1 / 12
    expected = width_px**2 / 16 + sum(side**2 / 12 for side in squares) + lens
    assert spread == pytest.approx(expected, rel=0.05)


def test_a_wide_hole_is_as_deep_as_stated_in_its_middle():
    assert hole_image(20.0, (5.0,)).max() == pytest.approx(1.0, abs=1e-6)
    assert hole_image(3.0, (5.0,)).max() < 0.3


def test_only_upsampled_depth_is_blurred_twice():
    assert squares_px(0.0) == (1.0,)
    assert squares_px(5.0) == (5.0,)
    assert squares_px(8.0) == (8.0 * UPSAMPLED[0], 8.0 * UPSAMPLED[1])


def test_places_are_free_and_apart():
    free = np.zeros((100, 200), bool)
    free[20:80, 30:170] = True
    centres = places_apart(free, 12, 20.0, np.random.default_rng(1))
    assert free[tuple(centres.T)].all()
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    assert distances[~np.eye(len(centres), dtype=bool)].min() > 20.0
    assert len(centres) == 12
    # no more fit, and the same stream draws the same places
    crowded = places_apart(free, 1000, 20.0, np.random.default_rng(1))
    assert len(crowded) < 60
    np.testing.assert_array_equal(crowded[:12], centres)
    assert places_apart(np.zeros((5, 5), bool), 3, 2.0, np.random.default_rng(1)).shape == (0, 2)


def test_holes_are_added_and_cut_at_the_edge():
    residual_m = np.full((60, 80), 1e-3)
    residual_m[30, 40] = np.nan
    holes = VirtualHoles(
        rows=np.array([30, 0]),
        columns=np.array([40, 79]),
        widths_px=np.array([12.0, 12.0]),
        depths_m=np.array([2e-3, 5e-3]),
    )
    changed_m = with_holes(residual_m, holes, (3.0,))
    assert np.isnan(changed_m[30, 40])
    assert changed_m[30, 42] == pytest.approx(3e-3, abs=1e-6)
    assert changed_m[0, 79] == pytest.approx(6e-3, abs=1e-6)
    assert changed_m[50, 20] == 1e-3
    assert residual_m[0, 79] == 1e-3
