"""The thesis' extents, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from detectors.findings.extents import extents


def test_extents_of_a_hand_made_cluster() -> None:
    points = np.array(
        [[0.0, 0.1, 1.0], [0.3, 0.1, 1.4], [0.1, 0.0, 1.0], [0.1, 0.2, 1.0], [0.15, 0.1, 1.0]]
    )
    diameter, centre = extents(points)
    # in x: 0.3 across and 0.4 deep make 0.5; in y: 0.2
    assert diameter == pytest.approx(0.35, abs=1e-15)
    np.testing.assert_allclose(centre, [0.125, 0.1, 1.1], atol=1e-15)


def test_of_equal_extremes_the_first_counts() -> None:
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.5, 2.0], [1.0, 0.5, 1.0], [1.0, 0.0, 3.0]])
    diameter, _ = extents(points)
    west_east = np.hypot(1.0, 0.5)
    north_south = np.hypot(0.5, 1.0)
    assert diameter == pytest.approx((west_east + north_south) / 2, abs=1e-15)
